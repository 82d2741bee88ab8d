"""Wrong calls of planning and policies end in an error of ours that names the argument."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from wrong_calls import COUNT_OR_ZERO, NOT_NEGATIVE, OPTIONAL, POSITIVE, Call, Made, call, finding

import tsmlib
from reproduction.measures.planning import sampled_starts
from tsmlib import rewards
from tsmlib.policies.learning import episodes_from, learn_policy

B, T, ARM = 2, 10, "tsm/Reacher-v0"


def still(states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    return -states[..., 0].square() - actions.square().sum(-1)


DATA = tsmlib.collect_random(ARM, 4, horizon=20, rms=0.1)
TASK = tsmlib.Task.from_env(ARM, n=B, horizon=T, reward=still, seed=0)
OTHERS = tsmlib.Task.from_env(ARM, n=B, horizon=T, reward=still, seed=7)
MODEL = tsmlib.OneStep.for_data(DATA, hidden=4, layers=1)
PRIOR = tsmlib.ActionPrior.for_data(DATA, segment_len=5, channels=4, dilations=(1, 2))
PAST = TASK.past(MODEL.past_len)
PREDICT = tsmlib.model_predictor(MODEL, PAST)
SPACE = tsmlib.DirectActions(T, 2, rms=0.1)
FEW: dict[str, Any] = dict(candidates=4, iterations=1)
PLAN = tsmlib.cem(PREDICT, TASK.reward, SPACE, B, elites=2, **FEW)
SEARCH: dict[str, Any] = dict(predict=PREDICT, reward=TASK.reward, space=SPACE, start=B)
SEARCH_ALSO: dict[str, Any] = {
    "predict": {
        "a model": MODEL,
        "of another shape": lambda u: u,
        "without samples": lambda u: PREDICT(u)[0],
        "numpy": lambda u: PREDICT(u).detach().numpy(),
    },
    "reward": {
        "of states": lambda x: x,
        "one dimension more": lambda x, u: x,
        "a total": lambda x, u: x.sum(),
        "nan": lambda x, u: x[..., 0] * torch.nan,
        "infinite ": lambda x, u: x[..., 0] * 0 + torch.inf,
        "bool": lambda x, u: x[..., 0] > 0,
        "numpy": lambda x, u: np.zeros(3),
        "unmade": rewards.reach,
    },
    "space": {"a task": TASK, "its class": tsmlib.DirectActions},
    "start": {
        "too many": 5,
        "shape": torch.zeros(1, B, T - 1, 2),
        "nan": torch.full((1, B, T, 2), torch.nan),
    },
}
SEARCH_WORDS: dict[str, Any] = {"predict": ("predict",), "start": ("start", "targets")}
SEEDS: dict[str, Any] = {"seed": COUNT_OR_ZERO}


def made_task(**given: Any) -> tsmlib.Task:
    return tsmlib.Task.from_env(**given)


CALLS = [
    Call(
        "cem",
        tsmlib.cem,
        SEARCH | FEW | dict(elites=2, keep=0.1, screened=0.5, seed=0),
        SEEDS
        | {
            "keep": frozenset({"zero", "a fraction"}),
            "screened": frozenset({"zero", "a fraction"}),
        },
        SEARCH_ALSO | {"elites": {"too many": 5}},
        SEARCH_WORDS,
    ),
    Call(
        "mppi",
        tsmlib.mppi,
        SEARCH | FEW | dict(temperature=0.3, shrink=0.8, seed=0),
        SEEDS | {"temperature": POSITIVE, "shrink": frozenset({"a fraction"})},
        SEARCH_ALSO,
        SEARCH_WORDS,
    ),
    Call(
        "adam",
        tsmlib.adam,
        SEARCH | dict(iterations=1, lr=0.01),
        {"iterations": COUNT_OR_ZERO, "lr": POSITIVE},
        SEARCH_ALSO,
        SEARCH_WORDS | {"reward": ("reward",)},
    ),
    Call(
        "sampled_starts",
        sampled_starts,
        dict(
            predict=PREDICT,
            reward=TASK.reward,
            space=SPACE,
            n_targets=B,
            candidates=4,
            keep=2,
            seed=0,
        ),
        SEEDS,
        {"predict": SEARCH_ALSO["predict"], "reward": SEARCH_ALSO["reward"]},
    ),
    Call(
        "reevaluate",
        tsmlib.reevaluate,
        dict(plan=PLAN, predict=PREDICT, reward=TASK.reward),
        also={"predict": SEARCH_ALSO["predict"], "reward": SEARCH_ALSO["reward"]},
    ),
    Call(
        "model_predictor",
        tsmlib.model_predictor,
        dict(model=MODEL, past=PAST, samples=0, seed=0),
        {"samples": COUNT_OR_ZERO, "seed": COUNT_OR_ZERO},
        {"past": {"empty": tsmlib.Segment(PAST.states[:, :0], PAST.actions[:, :0])}},
        {"model": ("cannot predict",)},
    ),
    Call(
        "expected_predictor",
        tsmlib.expected_predictor,
        dict(model=MODEL, past=PAST, samples=2, seed=0),
        SEEDS,
        words={"model": ("cannot predict",)},
    ),
    Call(
        "fresh_predictor",
        tsmlib.fresh_predictor,
        dict(model=MODEL, past=PAST, seed=1, samples=2),
        SEEDS,
        words={"model": ("cannot predict",)},
    ),
    Call(
        "simulator_predictor",
        tsmlib.simulator_predictor,
        dict(env=TASK, start=TASK.start, done=torch.zeros(B, 0, 2)),
        {"start": OPTIONAL, "done": OPTIONAL},
        words={"env": ("env", "arm", "nonsense")},
    ),
    Call(
        "DirectActions",
        tsmlib.DirectActions,
        dict(horizon=T, action_dim=2, rms=0.1, smoothness=1.5),
        {"rms": POSITIVE, "smoothness": NOT_NEGATIVE},
    ),
    Call("DirectActions.for_data", tsmlib.DirectActions.for_data, dict(data=DATA, horizon=T)),
    Call(
        "LatentActions",
        tsmlib.LatentActions,
        dict(prior=PRIOR, horizon=T, past=torch.zeros(B, 5, 2)),
        {"past": OPTIONAL},
        {"horizon": {"no multiple": 7}, "past": {"short": torch.zeros(B, 2, 2)}},
    ),
    Call(
        "execute",
        tsmlib.execute,
        dict(task=TASK, plan=PLAN, past_len=10),
        also={
            "plan": {
                "longer": torch.zeros(B, T + 1, 2),
                "of others": torch.zeros(B + 1, T, 2),
                "beyond": 2 * torch.ones(B, T, 2),
                "nan": torch.full((B, T, 2), torch.nan),
                "a model": MODEL,
                "a policy": tsmlib.OneStepPolicy(6, 2),
            },
            "task": {"of other starts": OTHERS, "fewer": TASK.take(1)},
        },
        words={"plan": ("plan", "actions", "controller"), "task": ("task", "starts")},
    ),
    Call(
        "mpc",
        tsmlib.mpc,
        dict(task=TASK, model=MODEL, space=SPACE, planner=tsmlib.mppi, every=5, plan=PLAN, seed=0),
        {"model": OPTIONAL, "plan": OPTIONAL, "every": frozenset({"huge"})} | SEEDS,
        {"space": {"shorter": tsmlib.DirectActions(5, 2, rms=0.1)}},
        {"model": ("cannot predict", "model"), "plan": ("plan", "actions")},
    ),
    Call(
        "Task.from_env",
        made_task,
        dict(env=ARM, n=B, horizon=T, reward=still, seed=0, success=None, tolerance=None, name=""),
        SEEDS
        | {"success": OPTIONAL, "tolerance": OPTIONAL | NOT_NEGATIVE, "name": frozenset({"text"})},
        {"reward": SEARCH_ALSO["reward"], "success": {"a number": lambda x: 1.0}},
        {"n": ("n ", "episodes"), "env": ("env", "nonsense")},
    ),
    Call("Task.take", TASK.take, dict(chosen=1), words={"chosen": ("target", "chosen")}),
    Call("Task.past", TASK.past, dict(past_len=3), {"past_len": frozenset({"huge"})}),
    Call(
        "Task.with_reward",
        TASK.with_reward,
        dict(name="mine", reward=still, target=None, horizon=5),
        {"target": OPTIONAL, "horizon": OPTIONAL, "name": frozenset({"text"})},
        {"reward": SEARCH_ALSO["reward"]},
    ),
    Call(
        "rewards.reach",
        rewards.reach,
        dict(target=torch.zeros(B, 2), torque_weight=1.0),
        {"torque_weight": NOT_NEGATIVE},
    ),
    Call("rewards.until", rewards.until, dict(ended=lambda x: x[..., 0] > 9, reward=still)),
    Call(
        "OneStepPolicy",
        tsmlib.OneStepPolicy,
        dict(
            state_dim=6,
            action_dim=2,
            target_dim=2,
            angles=(0, 1),
            hidden=4,
            layers=1,
            target_std=0.1,
            seed=0,
        ),
        SEEDS | {"target_std": POSITIVE},
    ),
    Call(
        "SegmentPolicy",
        tsmlib.SegmentPolicy,
        dict(
            state_dim=6,
            prior=PRIOR,
            target_dim=2,
            angles=(0, 1),
            channels=4,
            target_std=0.1,
            seed=0,
        ),
        SEEDS | {"target_std": POSITIVE},
    ),
    Call(
        "LearningOptions",
        tsmlib.LearningOptions,
        dict(
            horizon=5,
            gamma=0.9,
            noise=0.01,
            episodes=2,
            iterations=1,
            lr=1e-3,
            lr_decay=0.9,
            lr_final=1e-4,
            clip=0.0,
            record_every=1,
        ),
        dict.fromkeys(("horizon", "episodes", "iterations", "record_every"), frozenset({"huge"}))
        | dict.fromkeys(("gamma", "lr_decay"), frozenset({"a fraction"}))
        | dict.fromkeys(("noise", "lr_final", "clip"), NOT_NEGATIVE)
        | {"lr": POSITIVE},
    ),
    Call(
        "learn_policy",
        partial(learn_policy, options=tsmlib.LearningOptions(horizon=3, episodes=2, iterations=1)),
        dict(
            policy=Made(lambda: tsmlib.OneStepPolicy(6, 2, angles=(0, 1), hidden=4)),
            model=MODEL,
            reward=rewards.reach,
            draw=episodes_from(torch.from_numpy(TASK.start)),
            seed=0,
            measure=None,
            callback=None,
        ),
        SEEDS | {"measure": OPTIONAL, "callback": OPTIONAL},
        {
            "reward": {"made": still, "nothing": lambda g: None},
            "draw": {
                "one": lambda n, g: torch.zeros(n, 6),
                "others": lambda n, g: (torch.zeros(n, 5), torch.zeros(n, 2)),
            },
            "policy": {"of another robot": tsmlib.OneStepPolicy(5, 2)},
        },
        {"model": ("cannot predict", "model")},
    ),
    Call(
        "score",
        tsmlib.score,
        dict(
            model=MODEL,
            features=MODEL.features,
            test=DATA,
            validation=DATA,
            samples=2,
            horizon=5,
            starts=(10,),
            seed=0,
        ),
        SEEDS,
        words={"model": ("cannot predict",), "starts": ("start",)},
    ),
    Call(
        "ExplorationOptions",
        tsmlib.ExplorationOptions,
        dict(
            model=tsmlib.TrainingOptions(),
            prior=None,
            rounds=1,
            every=5,
            candidates=4,
            elites=2,
            iterations=1,
            held_out=0.1,
            rms=None,
            judging=0,
            screened=0.5,
        ),
        dict.fromkeys(("rounds", "every", "candidates", "iterations"), frozenset({"huge"}))
        | {"prior": OPTIONAL, "rms": OPTIONAL | POSITIVE, "judging": COUNT_OR_ZERO | {"huge"}}
        | {"held_out": frozenset({"a fraction"}), "screened": frozenset({"zero", "a fraction"})},
        {"elites": {"too many": 9}},
    ),
]


@pytest.mark.parametrize("case", CALLS, ids=lambda case: case.name)
def test_a_wrong_call_is_refused_by_the_name_of_its_argument(case: Call) -> None:
    call(case)  # the correct one
    findings = [finding(case, *wrong) for wrong in case.cases()]
    assert not (found := [text for text in findings if text]), "\n".join(found)
