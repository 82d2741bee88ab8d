"""Planning on systems whose best plan is known, and through the true simulator."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
import pytest
import torch
from torch import Tensor
from untrained import in_units

import tsmlib.envs  # noqa: F401 - registers the environments
from reproduction.measures.planning import iterations_to, sampled_starts
from tsmlib import rewards
from tsmlib.collection import collect_random, smooth_torques
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.baselines import LSTM, OneStep
from tsmlib.models.ensemble import Ensemble
from tsmlib.models.tsm import TSM
from tsmlib.planning.base import Plan, Planner, Predictor
from tsmlib.planning.execution import execute
from tsmlib.planning.planners import (
    adam,
    cem,
    mppi,
    reevaluate,
)
from tsmlib.planning.predictors import (
    EnsemblePredictor,
    expected_predictor,
    fresh_predictor,
    model_predictor,
    simulator_predictor,
)
from tsmlib.planning.search import evaluate, expected_return
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.planning.tasks import Task
from tsmlib.rewards import Reward
from tsmlib.sampling import Noise, standard_normal
from tsmlib.trajectory import Segment, Window, initial_past

T, B, DT = 10, 3, 0.5
PLANNERS = ("adam", "cem", "mppi")


@dataclass
class Cart:
    """A double integrator, state (position, velocity), with noise in its velocity."""

    noise: float = 0.0
    segment_len: int = 4
    past_len: int = 1

    def loss(self, window: Window, generator: Noise) -> Tensor:
        raise NotImplementedError

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        position, velocity = past.states[:, -1].unbind(-1)
        states = []
        for u in actions.unbind(1):
            velocity = velocity + DT * u[:, 0]
            if generator is not None:
                velocity = velocity + self.noise * standard_normal(
                    velocity.shape, generator, velocity
                )
            position = position + DT * velocity
            states.append(torch.stack([position, velocity], -1))
        return torch.stack(states, 1)


START = torch.tensor([[0.0, 0.0], [1.0, -0.5], [-0.3, 0.2]])
TARGET = torch.tensor([0.8, 0.5, -0.4])
PAST = initial_past(START, 1, 1)


def reward(states: Tensor, actions: Tensor) -> Tensor:
    """Minus the squared distance from TARGET and a little of the force."""
    return -(states[..., 0] - TARGET[:, None]).square() - 0.3 * actions.square().sum(-1)


def predictor(noise: float = 0.0, samples: int = 1) -> Predictor:
    return model_predictor(Cart(noise), PAST, samples=samples)


def optimum() -> tuple[Tensor, Tensor]:
    """The best forces (B, T) and their return (B,), by least squares."""
    predict = predictor()
    free = predict(torch.zeros(1, B, T, 1))[0, 0, ..., 0]  # (B, T)
    unit = torch.eye(T)[:, None, :, None].expand(-1, B, -1, -1)
    effect = predict(unit)[0, ..., 0] - free  # (T, B, T): of force j on position k
    best = []
    for b in range(B):
        m = effect[:, b]
        best.append(torch.linalg.solve(m @ m.T + 0.3 * torch.eye(T), m @ (TARGET[b] - free[b])))
    forces = torch.stack(best)
    assert (
        forces.abs().max() < 0.95
    )  # within the bounds, so that it is the optimum of the bounded problem too
    actions = forces[None, ..., None]
    return forces, expected_return(predict(actions), actions, reward)[0]


WHITE = DirectActions(T, 1, rms=0.5, smoothness=0)
SMOOTH = DirectActions(T, 1, rms=0.5)


def plan_by(
    planner: str, predict: Predictor, reward: Reward, iterations: int, **settings: Any
) -> Plan:
    space, start = settings.pop("space", SMOOTH), settings.pop("start", B)
    plan = {"adam": adam, "cem": cem, "mppi": mppi}[planner]
    usual = {
        "adam": {"lr": 0.05},
        "cem": {"candidates": 64, "elites": 8},
        "mppi": {"candidates": 64},
    }[planner]
    # type: ignore[operator]
    return plan(predict, reward, space, start, iterations=iterations, **{**usual, **settings})


# Optima


@pytest.mark.parametrize(
    ("planner", "settings", "missed"),
    [
        ("adam", {"iterations": 100, "lr": 0.1}, 0.01),
        ("cem", {"iterations": 20, "space": WHITE}, 0.01),
        (
            "cem",
            {"iterations": 10, "candidates": 256, "elites": 24},
            0.1,
        ),  # smooth noise finds no abrupt start
        (
            "mppi",
            {"iterations": 40, "candidates": 128, "shrink": 0.9, "space": WHITE},
            0.01,
        ),
        ("mppi", {"iterations": 20, "candidates": 256}, 0.1),
    ],
    ids=["adam", "cem", "cem, smooth", "mppi", "mppi, smooth"],
)
def test_the_planner_finds_the_known_optimum(
    planner: str, settings: dict[str, Any], missed: float
) -> None:
    forces, value = optimum()
    plan = plan_by(planner, predictor(), reward, **settings)
    nothing = expected_return(
        predictor()(torch.zeros(1, B, T, 1)), torch.zeros(1, B, T, 1), reward
    )[0]
    assert (plan.predicted_return <= value + 1e-5).all()
    assert (value - plan.predicted_return < missed * (value - nothing)).all()
    if missed < 0.05:
        assert (plan.actions[..., 0] - forces).abs().max() < 0.3


@pytest.mark.parametrize("planner", PLANNERS)
def test_more_iterations_never_make_the_predicted_return_worse(planner: str) -> None:
    plans = [plan_by(planner, predictor(0.1, 3), reward, n) for n in (1, 4, 12)]
    for fewer, more in itertools.pairwise(plans):
        assert (more.predicted_return >= fewer.predicted_return - 1e-5).all()
    assert (plans[-1].curve.diff(dim=0) >= 0).all()
    assert (plans[-1].predicted_return > plans[0].predicted_return).all()


@pytest.mark.parametrize("planner", PLANNERS)
def test_a_plan_returns_what_it_predicts(planner: str) -> None:
    predict, space = predictor(0.1, 5), DirectActions(T, 1, rms=0.5)
    plan = plan_by(planner, predict, reward, 5)
    assert plan.actions.shape == (B, T, 1)
    assert plan.states.shape == (5, B, T, 2)
    assert plan.parameters.shape == (B, T, 1)
    assert plan.seconds > 0
    torch.testing.assert_close(space.decode(plan.parameters[None])[0], plan.actions)
    torch.testing.assert_close(
        evaluate(predict, reward, space, plan.parameters[None])[0], plan.predicted_return
    )
    torch.testing.assert_close(plan.curve[-1], plan.predicted_return)
    torch.testing.assert_close(
        reward(plan.states, plan.actions).sum(-1).mean(0), plan.predicted_return
    )


@pytest.mark.parametrize("planner", PLANNERS)
def test_targets_are_planned_for_independently(planner: str) -> None:
    def greedy(states: Tensor, actions: Tensor) -> Tensor:
        """The first target's reward is as before; the others' is huge and means nothing."""
        return torch.cat(
            [reward(states, actions)[..., :1, :], 1e3 * reward(states, actions)[..., 1:, :]], -2
        )

    usual, odd = (plan_by(planner, predictor(), r, 8) for r in (reward, greedy))
    torch.testing.assert_close(usual.actions[0], odd.actions[0])


def test_the_bounds_hold_however_much_is_to_gain() -> None:
    def forwards(states: Tensor, actions: Tensor) -> Tensor:
        return 100 * states[..., 0]

    for planner, settings in (("adam", {"lr": 1.0}), ("cem", {}), ("mppi", {"shrink": 1.0})):
        plan = plan_by(planner, predictor(), forwards, 30, **settings)
        assert plan.actions.abs().max() <= 1
        assert plan.actions.max() > 0.9


def test_sampled_starts_are_the_best_of_the_candidates() -> None:
    space = DirectActions(T, 1, rms=0.5)
    starts = sampled_starts(predictor(), reward, space, B, candidates=100, keep=4)
    returns = evaluate(predictor(), reward, space, starts)
    assert starts.shape == (4, B, T, 1)
    assert (returns.diff(dim=0) <= 0).all()
    drawn = space.scale * space.noise(100, B, torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        evaluate(predictor(), reward, space, drawn).topk(4, dim=0).values, returns
    )


@pytest.mark.parametrize("planner", PLANNERS)
def test_a_model_that_diverges_on_everything_stops_the_planner(planner: str) -> None:
    def diverging(actions: Tensor) -> Tensor:
        return predictor()(actions) / 0.0

    with pytest.raises(
        FloatingPointError, match=r"no candidate for target 0 has a predicted return that is finite"
    ):
        plan_by(planner, diverging, reward, 2)


def test_planning_by_gradients_leaves_none_in_the_weights() -> None:
    model, prior = OneStep(2, 1, hidden=8), ActionPrior(1, channels=8)
    model.features.fit(torch.randn(4, 9, 2))
    predict = model_predictor(model, initial_past(START, model.past_len, 1))
    assert adam(predict, reward, LatentActions(prior, T), B, iterations=2).actions.shape == (
        B,
        T,
        1,
    )
    assert all(weight.grad is None for weight in (*model.parameters(), *prior.parameters()))


@pytest.mark.parametrize("planner", ["cem", "mppi"])
def test_a_start_on_which_the_model_diverges_is_left_for_candidates(planner: str) -> None:
    def fragile(actions: Tensor) -> Tensor:
        """Without any force the world ends."""
        return predictor()(actions) / (actions.abs().amax((2, 3)) > 0)[None, ..., None, None]

    plan = plan_by(planner, fragile, reward, 3)
    assert torch.isinf(plan.curve[0]).all()
    assert torch.isfinite(plan.curve[1:]).all()
    assert torch.isfinite(plan.predicted_return).all()


@pytest.mark.parametrize("planner", PLANNERS)
def test_a_plan_is_a_function_of_its_arguments_and_seed(planner: str) -> None:
    seeds = [{}, {}, {"seed": 7}] if planner != "adam" else [{}, {}]
    plans = [plan_by(planner, predictor(0.2, 2), reward, 3, **seed) for seed in seeds]
    assert torch.equal(plans[0].actions, plans[1].actions)
    assert torch.equal(plans[0].predicted_return, plans[1].predicted_return)
    assert planner == "adam" or not torch.equal(plans[0].actions, plans[2].actions)


@pytest.mark.parametrize("planner", PLANNERS)
def test_a_plan_is_never_worse_than_the_best_of_its_starts(planner: str) -> None:
    forces, value = optimum()
    start = torch.zeros(2, B, T, 1)
    start[1] = torch.atanh(forces)[..., None]  # nothing is better
    plan = plan_by(planner, predictor(), reward, 2, start=start)
    torch.testing.assert_close(plan.predicted_return, value)
    assert plan.curve.shape == (3, B)


def test_a_curve_is_nearly_done_when_it_has_95_of_100_of_its_gain() -> None:
    curve = torch.tensor(
        [[-10.0, -5.0, -1.0], [-2.0, -5.0, -1.0], [-0.4, -5.0, -1.0], [0.0, -5.0, 4.0]]
    )
    assert iterations_to(curve).tolist() == [2, 0, 3]
    assert iterations_to(curve, 0.5).tolist() == [1, 0, 3]
    late = torch.tensor([[-math.inf], [-5.0], [-3.0], [-1.0]])  # of a start without a finite return
    assert iterations_to(late).tolist() == [3]


def test_mppi_at_a_low_temperature_takes_the_best_candidate_and_at_a_high_one_their_mean() -> None:
    space, seen = WHITE, list[Tensor]()

    def watched(actions: Tensor) -> Tensor:
        seen.append(actions)
        return predictor()(actions)

    for temperature in (1e-4, 1e4):
        seen.clear()
        mppi(watched, reward, space, B, candidates=32, iterations=1, temperature=temperature)
        _, candidates, mean, _ = seen  # the start, the candidates, their weighted mean, the plan
        best = expected_return(predictor()(candidates), candidates, reward).argmax(0)
        drawn = torch.atanh(candidates)
        expected = drawn[best, torch.arange(B)] if temperature < 1 else drawn.mean(0)
        torch.testing.assert_close(torch.atanh(mean[0]), expected, rtol=1e-3, atol=1e-3)


# Ensembles


def counted(asked: list[int], predict: Predictor) -> Predictor:
    """``predict``, adding the number of its candidates to ``asked``."""

    def predicted(actions: Tensor) -> Tensor:
        asked.append(len(actions))
        return predict(actions)

    return predicted


def test_members_after_the_first_judge_only_the_share_of_the_candidates_that_it_likes_best() -> (
    None
):
    first, second = list[int](), list[int]()
    judge = EnsemblePredictor((counted(first, predictor()), counted(second, predictor())))
    planned = {
        share: cem(
            judge,
            reward,
            DirectActions(T, 1, rms=0.5),
            B,
            candidates=40,
            elites=4,
            iterations=2,
            screened=share,
        )
        for share in (1.0, 0.25)
    }
    assert (first.count(40), second.count(40), second.count(10)) == (4, 2, 2)
    torch.testing.assert_close(
        planned[0.25].actions, planned[1.0].actions
    )  # since they are of one opinion


def test_the_return_of_a_screened_plan_is_the_mean_of_what_all_members_predict() -> None:
    judge = EnsemblePredictor((predictor(), lambda actions: 0.9 * predictor()(actions)))
    plan = cem(
        judge,
        reward,
        DirectActions(T, 1, rms=0.5),
        B,
        candidates=40,
        elites=4,
        iterations=4,
        screened=0.25,
    )
    predicted = expected_return(judge(plan.actions[None]), plan.actions[None], reward)[0]
    torch.testing.assert_close(plan.curve[-1], predicted)


@pytest.mark.parametrize("planner", [cem, mppi])
@pytest.mark.parametrize("spoilt", [float("nan"), float("inf")])
def test_a_candidate_on_which_the_model_diverges_is_never_the_plan(
    planner: Planner, spoilt: float
) -> None:
    def predict(actions: Tensor) -> Tensor:
        states = predictor()(actions)
        return states.where(actions[None].abs().amax((-2, -1), keepdim=True) == 0, spoilt)

    plan = planner(predict, reward, DirectActions(T, 1, rms=0.5), B, iterations=2)
    assert (plan.actions == 0).all()
    torch.testing.assert_close(plan.curve[-1], plan.predicted_return)


# Common random numbers


def test_candidates_and_calls_meet_the_same_futures() -> None:
    actions = torch.zeros(1, B, T, 1)
    predict = predictor(0.3, samples=4)
    states = predict(actions.expand(5, -1, -1, -1))
    assert states.shape == (4, 5, B, T, 2)
    torch.testing.assert_close(states[:, 1:], states[:, :1].expand(-1, 4, -1, -1, -1))
    torch.testing.assert_close(predict(actions)[:, 0], states[:, 0])
    assert (states[0] - states[1]).abs().min(
        dim=-1
    ).values.max() > 0.01  # the samples themselves differ
    other = model_predictor(Cart(0.3), PAST, samples=4, seed=1)
    assert not torch.equal(other(actions), predict(actions))


def test_a_finished_plan_meets_futures_that_its_planner_did_not_see() -> None:
    plan = plan_by("cem", predictor(0.3, samples=4), reward, 3)
    past, actions = PAST, plan.actions[None]
    fresh = fresh_predictor(Cart(0.3), past, seed=1)
    assert fresh(actions).shape == (32, 1, B, T, 2)
    judged = reevaluate(plan, fresh, reward)
    torch.testing.assert_close(
        judged.predicted_return, expected_return(fresh(actions), actions, reward)[0]
    )
    assert not torch.isclose(judged.predicted_return, plan.predicted_return).any()


def test_an_expectation_is_over_the_mode_and_common_samples() -> None:
    past, actions = PAST, torch.full((2, B, T, 1), 0.3)
    judge = expected_predictor(Cart(0.3), past, samples=3, seed=1)
    assert isinstance(judge, EnsemblePredictor)
    states = judge(actions)
    assert states.shape == (4, 2, B, T, 2)
    torch.testing.assert_close(states[0], predictor(0.0)(actions)[0])
    assert torch.equal(states[:, 0], states[:, 1])  # common random numbers
    assert torch.equal(states, judge(actions))


def test_samples_by_which_plans_are_judged_are_none_of_the_fresh_ones() -> None:
    start = torch.zeros(20, 2)  # of fewer numbers torch draws in another order
    past, actions = initial_past(start, 1, 1), torch.zeros(1, 20, 4, 1)
    judged = expected_predictor(Cart(0.3), past, samples=3, seed=1)(actions)[
        1:, 0, :, 0
    ]  # the first step
    others = [expected_predictor(Cart(0.3), past, samples=3, seed=2)(actions)[1:]]
    others += [fresh_predictor(Cart(0.3), past, seed=seed)(actions) for seed in (0, 1, 2, 6, 7, 8)]
    assert not (torch.cat(others)[:, None, 0, :, 0] == judged).any()
    assert (
        fresh_predictor(Cart(0.3), past, seed=4)(actions)[:, None, 0, :, 0] == judged
    ).any()  # as it is said


def test_a_plan_by_expectation_keeps_away_from_an_edge_and_one_by_the_mode_does_not() -> None:
    def edge(states: Tensor, actions: Tensor) -> Tensor:
        """The nearer to 0.5 at the end the better, but 10 less beyond it."""
        end = states[..., -1:, 0]
        return (end.minimum(torch.tensor(0.5)) - 10.0 * (end > 0.5)) / states.shape[
            -2
        ] + 0 * states[..., 0]

    past, space = PAST, DirectActions(T, 1, rms=0.5)
    found = []
    for judge in (expected_predictor(Cart(0.1), past), model_predictor(Cart(0.1), past)):
        plan = cem(judge, edge, space, B, candidates=60, elites=6, iterations=8, screened=0.5)
        fresh = reevaluate(plan, fresh_predictor(Cart(0.1), past, seed=99, samples=400), edge)
        found.append(fresh.predicted_return)
    assert (found[0] > found[1] + 0.5).all()


@pytest.mark.parametrize("build", [OneStep, LSTM])
def test_a_deterministic_model_has_no_samples_and_says_so(build: Any) -> None:
    torch.manual_seed(0)
    model, past = in_units(build(6, 2, hidden=16)), initial_past(torch.zeros(B, 6), 10, 2)
    with pytest.raises(ValueError, match=f"samples is 2, but {build.__name__} is deterministic"):
        model_predictor(model, past, samples=2)
    actions = torch.full((1, B, T, 2), 0.3)
    fresh = fresh_predictor(model, past, seed=1)(actions)
    assert torch.equal(
        fresh, model_predictor(model, past)(actions)
    )  # one rollout, not 32 times the same


def test_a_batch_of_candidates_and_samples_is_laid_out_as_stated() -> None:
    torch.manual_seed(0)
    model = in_units(TSM(6, 2, channels=8))
    start = torch.randn(B, 6)
    actions = torch.randn(4, B, 15, 2).clamp(-1, 1)
    states = model_predictor(model, initial_past(start, 10, 2), samples=0)(actions)
    for c, b in itertools.product(range(4), range(B)):
        past = initial_past(start[b : b + 1], 10, 2)
        alone = model_predictor(model, past, samples=0)(actions[c : c + 1, b : b + 1])
        torch.testing.assert_close(states[0, c, b], alone[0, 0, 0], rtol=1e-4, atol=1e-5)


# Latent actions


@pytest.fixture
def prior() -> ActionPrior:
    torch.manual_seed(0)
    return ActionPrior(2, channels=8).fit_scale(0.1 * torch.randn(20, 30, 2)).requires_grad_(False)


def test_codes_decode_segment_by_segment_from_no_torque(prior: ActionPrior) -> None:
    space = LatentActions(prior, 30)
    codes = torch.randn(2, B, *space.shape)
    actions = space.decode(codes)
    assert space.shape == (3, 8)
    assert actions.shape == (2, B, 30, 2)
    for c, b in itertools.product(range(2), range(B)):
        past = torch.zeros(1, 10, 2)
        for k in range(3):
            past = prior.decode(past, codes[c, b, k][None])
            torch.testing.assert_close(
                actions[c, b, 10 * k : 10 * k + 10], past[0], rtol=1e-4, atol=1e-6
            )


def test_what_is_left_of_a_plan_over_codes_is_the_same_actions(prior: ActionPrior) -> None:
    space, codes = (
        LatentActions(prior, 30),
        torch.randn(B, 3, 8, generator=torch.Generator().manual_seed(0)),
    )
    actions = space.decode(codes[None])[0]
    for steps in (10, 20):
        rest, left = space.after(codes, steps)
        torch.testing.assert_close(
            rest.decode(left[None])[0], actions[:, steps:], rtol=1e-4, atol=1e-6
        )
    rest, left = rest.after(left, 4)  # not where a segment ends: the codes are those of the encoder
    assert left.shape == (B, *rest.shape)
    assert rest.decode(left[None]).shape == (1, B, 6, 2)
    padded = torch.cat([actions[:, 24:], actions[:, -1:].expand(-1, 4, -1)], 1)
    torch.testing.assert_close(left[:, 0], prior.encode(padded)[0], rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(rest.past, actions[:, 14:24], rtol=1e-4, atol=1e-6)


# Every model


def test_a_rollout_keeps_one_member_of_the_ensemble_and_candidates_share_it() -> None:
    torch.manual_seed(0)
    model, n = in_units(Ensemble(6, 2, hidden=16, gaussian=False)).requires_grad_(False), 40
    past = initial_past(torch.zeros(n, 6), 1, 2)
    actions = torch.full((3, n, 12, 2), 0.5)
    states = model_predictor(model, past, samples=2)(actions)  # (2, 3, n, 12, 6)
    torch.testing.assert_close(states[:, 1:], states[:, :1].expand(-1, 2, -1, -1, -1))
    apart = (states[:, 0].flatten(0, 1)[:, None] - states[:, 0].flatten(0, 1)[None]).abs().amax(
        (2, 3)
    ) > 1e-3
    futures = {tuple(row) for row in (~apart).tolist()}
    assert (
        len(futures) == 5
    )  # as many as there are members: none is mixed with another along the way


# Through the true simulator


def test_cem_through_the_simulator_beats_doing_nothing() -> None:
    env_id = "tsm/Reacher-v0"
    env = gymnasium.make_vec(env_id, num_envs=2)
    start, _ = env.reset(seed=0)
    predict = simulator_predictor(env_id, start)
    task = rewards.reach(torch.tensor([[0.1, 0.12], [0.15, -0.1]]))
    plan = cem(predict, task, DirectActions(20, rms=0.1), 2, candidates=24, elites=4, iterations=4)
    nothing = torch.zeros(1, 2, 20, 2)
    assert (plan.predicted_return > expected_return(predict(nothing), nothing, task)[0] + 0.1).all()
    env.reset(options={"states": start})
    by_hand = torch.from_numpy(env.unwrapped.rollout(plan.actions.numpy())).float()
    torch.testing.assert_close(
        plan.states[0], by_hand, rtol=0, atol=0
    )  # what it predicted is what happens
    env.close()


def test_candidates_in_the_simulator_do_not_mix() -> None:
    start = gymnasium.make_vec("tsm/ReacherPush-v1", num_envs=2).reset(seed=0)[0]
    predict = simulator_predictor("tsm/ReacherPush-v1", start)
    actions = 0.2 * torch.randn(3, 2, 12, 2, generator=torch.Generator().manual_seed(0)).clamp(
        -1, 1
    )
    states = predict(actions)
    assert states.shape == (1, 3, 2, 12, 10)
    for c in range(3):
        assert torch.equal(predict(actions[c : c + 1])[0, 0], states[0, c])


@pytest.mark.parametrize(
    ("env_id", "off"), [("tsm/ReacherPush-v1", 1e-3), ("tsm/PymunkPush-v1", 5e-2)]
)
def test_the_simulator_can_go_on_from_what_was_observed(env_id: str, off: float) -> None:
    env: Any = gymnasium.make_vec(env_id, num_envs=30).unwrapped
    env.reset(seed=0)
    actions = smooth_torques(30, 40, generator=torch.Generator().manual_seed(0))
    observed = env.rollout(actions[:, :20].numpy()).astype("float32")[:, -1]
    follows = torch.from_numpy(env.rollout(actions[:, 20:].numpy())).float()
    states = simulator_predictor(env_id, observed)(actions[None, :, 20:])[0, 0]
    assert (states - follows)[..., 4:8].abs().max() < off  # metres


def test_the_simulator_of_an_arms_task_goes_on_after_what_was_done() -> None:
    task = Task.from_env("tsm/Reacher-v0", n=2, horizon=15, reward=lambda x, u: x[..., 0], seed=0)
    done, rest = 0.3 * torch.ones(2, 10, 2), torch.zeros(2, 5, 2)
    states = simulator_predictor(task, done=done)(rest[None])[0, 0]
    torch.testing.assert_close(
        states, execute(task, torch.cat([done, rest], 1)).states[:, 11:], rtol=1e-4, atol=1e-5
    )
    at_start = simulator_predictor(task)(rest[None])
    assert torch.equal(simulator_predictor(task, done=done[:, :0])(rest[None]), at_start)
    assert torch.equal(
        simulator_predictor(task, task.start, done=done)(rest[None]), at_start
    )  # it is where it is


def test_every_planner_plans_through_every_model_over_actions_and_codes(prior: ActionPrior) -> None:
    torch.manual_seed(0)
    nets = [TSM(6, 2, channels=8), OneStep(6, 2, hidden=16), LSTM(6, 2, hidden=16)]
    nets += [Ensemble(6, 2, hidden=16), Ensemble(6, 2, hidden=16, gaussian=False)]
    task = rewards.reach(torch.tensor([[5.0, 0.0], [0.0, 5.0], [-5.0, 0.0]]), torque_weight=0)
    planners = (
        partial(adam, iterations=5, lr=0.1),
        partial(cem, iterations=3, candidates=12, elites=3),
        partial(mppi, iterations=3, candidates=12),
    )
    spaces = (LatentActions(prior, 20), DirectActions(20, rms=0.1))
    for net, planner, space in itertools.product(nets, planners, spaces):
        net.features.step_std.fill_(0.05)  # a tame world
        past = initial_past(torch.randn(B, 6), net.past_len, 2)
        samples = 2 if net.stochastic else 0
        plan = planner(model_predictor(net, past, samples=samples), task, space, B)
        assert plan.states.shape == (max(samples, 1), B, 20, 6)
        assert plan.actions.abs().max() <= 1
        assert (plan.predicted_return > plan.curve[0]).all()


# Noise


def test_noise_is_as_strong_at_every_step_and_as_smooth_as_is_said() -> None:
    for smoothness, correlation in ((0.0, 0.0), (1.5, 0.81), (4.0, 0.97)):
        space = DirectActions(50, 2, rms=0.1, smoothness=smoothness)
        noise = space.noise(2000, 2, torch.Generator().manual_seed(0))
        if smoothness < 2:  # else it has not settled
            torch.testing.assert_close(noise.std((0, 1)), torch.ones(50, 2), rtol=0, atol=0.06)
        product = (noise[:, :, 1:] * noise[:, :, :-1]).mean() / noise.square().mean()
        assert float(product) == pytest.approx(correlation, abs=0.02)


@pytest.mark.parametrize(("rms", "steps"), [(0.1, 1.5), (0.4, 3.0)])
def test_the_space_of_data_searches_actions_as_large_and_as_smooth_as_theirs(
    rms: float, steps: float
) -> None:
    data = collect_random(
        "tsm/Reacher-v0", 200, horizon=60, rms=rms, time_constant=steps * 0.02, seed=1
    )
    space = DirectActions.for_data(data, 30)
    assert space.shape == (30, 2)
    assert space.scale == pytest.approx(rms, rel=0.1)  # it starts at rest
    assert space.smoothness == pytest.approx(steps, rel=0.15)
    with pytest.raises(TypeError, match=r"rms is missing.* DirectActions.for_data"):
        DirectActions(30, 2)


# What cannot be


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (dict(predict=Cart()), "predict is a Cart, a model; .*tsmlib.model_predictor"),
        (dict(predict=lambda u: u), r"the predictor gave a tensor .*expected states"),
        (dict(predict=lambda u: predictor()(u)[0]), "the predictor gave a tensor"),
        (dict(reward=lambda x, u: x), r"the reward of .* is a tensor .*one number per step"),
        (dict(reward=lambda x, u: x[..., 0] / 0), "the reward is (inf|nan)"),
        (dict(reward=lambda x, u: x[..., 0] > 0), "the reward of .* is of torch.bool"),
        (dict(reward=lambda x: x), "the reward fails on"),
        (dict(reward="reach"), "reward is a str 'reach'"),
        (dict(space=DirectActions), "space is the class DirectActions"),
        (dict(start=2), "actions for 2 targets, but the past has 3"),
        (dict(start=0), "start, the number of targets, is 0"),
        (dict(start=torch.zeros(1, B, T - 1, 1)), r"start has shape \(1, 3, 9, 1\)"),
        (dict(start=torch.full((1, B, T, 1), math.nan)), "start is nan"),
        (dict(candidates=1), "candidates is 1"),
        (dict(elites=300), "elites is 300; expected at most the 256 candidates"),
        (dict(iterations=0), "iterations is 0"),
        (dict(screened=1.1), "screened is 1.1"),
        (dict(keep=math.nan), "keep is nan"),
        (dict(seed=1.5), "seed is 1.5"),
    ],
)
def test_what_cannot_be_searched_is_refused_by_name(wrong: dict[str, Any], said: str) -> None:
    usual = dict(predict=predictor(), reward=reward, space=SMOOTH, start=B)
    with pytest.raises((TypeError, ValueError, FloatingPointError), match=said):
        cem(**(usual | wrong))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            lambda prior: LatentActions(prior, 25),
            "horizon is 25 steps, .* of 10; choose 20",
        ),
        (lambda prior: LatentActions(prior, 0), "horizon is 0"),
        (lambda prior: DirectActions(-3, rms=0.1), "horizon is -3"),
        (lambda prior: DirectActions(3, rms=0.0), "rms is 0"),
        (lambda prior: expected_predictor(Cart(), PAST, samples=0), "the mode alone is|The mode"),
        (lambda prior: model_predictor(Cart(), PAST, samples=-1), "samples is -1"),
        (lambda prior: model_predictor(Cart(), START), "past is a tensor"),
        (lambda prior: simulator_predictor("tsm/Reacher-v0"), "no common start; give start"),
    ],
)
def test_what_cannot_be_made_is_refused_by_name(
    prior: ActionPrior, make: Callable[[ActionPrior], object], said: str
) -> None:
    with pytest.raises((TypeError, ValueError), match=said):
        make(prior)


def test_a_past_of_numpy_arrays_is_taken_and_a_short_one_named() -> None:
    arrays = Segment(*(part.double().numpy() for part in PAST))  # type: ignore[arg-type]
    actions = torch.full((1, B, T, 1), 0.3)
    assert torch.equal(model_predictor(Cart(), arrays)(actions), predictor()(actions))
    net = in_units(LSTM(2, 1, hidden=8))
    with pytest.raises(ValueError, match="past holds 1 steps of 3 targets; expected at least"):
        model_predictor(net, PAST)


def test_each_target_keeps_its_best_restart() -> None:
    starts = torch.zeros(3, B, T, 1)
    starts[0], starts[2] = -3.0, 3.0  # poor places to begin
    space = DirectActions(T, 1, rms=0.5)
    many = adam(predictor(), reward, space, starts, iterations=5)
    for start in starts:
        alone = adam(predictor(), reward, space, start[None], iterations=5)
        assert (many.predicted_return >= alone.predicted_return - 1e-5).all()


@pytest.mark.parametrize("planner", PLANNERS)
def test_a_model_that_diverges_on_some_candidates_is_planned_around(planner: str) -> None:
    def fragile(actions: Tensor) -> Tensor:
        """Any force above 0.4 ends the world."""
        return predictor()(actions) / (actions.amax((2, 3)) < 0.4)[None, ..., None, None]

    plan = plan_by(planner, fragile, reward, 30)
    assert torch.isfinite(plan.curve).all()
    assert (plan.predicted_return > plan.curve[0]).all()
    assert plan.actions.max() < 0.4
    assert plan.actions[0].max() > 0.2  # the first target needs force
