"""Plans made with trained models and their execution (tables 05 and 07)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch

import tsmlib
from reproduction.episodes import load_data, load_model, load_prior
from reproduction.measures import actions, gradients
from reproduction.measures.exploitation import shares, worst
from reproduction.measures.planning import iterations_to, random_torques, sampled_starts
from reproduction.measures.statistics import two_sample_auc
from reproduction.runs import Run, env_id
from reproduction.tables import Row, place
from tsmlib.envs.spec import EnvSpec
from tsmlib.planning.base import Plan
from tsmlib.planning.execution import Trial
from tsmlib.planning.predictors import JUDGING, expected_predictor, fresh_predictor
from tsmlib.planning.tasks import Task
from tsmlib.rewards import push, reach
from tsmlib.storage import artifacts

KEPT = 4  # samples of the predicted states that a file holds
SCREENED = 0.25  # of the candidates, which all samples judge
TORQUES: dict[str, Callable[[Task], torch.Tensor]] = {
    "random": random_torques,
    "zero": Task.idle_actions,
}
RMS = 0.1  # of the data's torques
NOISE = {  # of torques, by planner
    "cem+white": {"rms": RMS, "smoothness": 0.0},
    "adam+rough": {"rms": 0.5, "smoothness": 0.0},
}
OPEN, CLOSED = "open loop", "closed loop"


@dataclass(frozen=True)
class How:
    """How a plan is made, by its name in targets: ``tsm-latent-cem`` or ``tsm-latent-cem-every10``.

    Args:
        model: a word of the zoo, "oracle" (the simulator), "random" or "zero".
        space: "latent" (Eq. 3) or "direct" (Eq. 2).
        planner: "cem" (noise as smooth as the data, as iCEM), "cem+white", "mppi", "adam" (from
            zero), "adam+starts" (from sampled candidates) or "adam+rough" (from white noise of
            half of the full torque, or codes of N(0, I), without the penalty of torques).
        every: steps until the arm plans again; 0 executes the plan open loop, as the paper.
        iterations: of the planner; 0 is the scale's own number.
    """

    model: str
    space: str = ""
    planner: str = ""
    every: int = 0
    iterations: int = 0

    @classmethod
    def of(cls, name: str) -> How:
        """From the name of a plan."""
        words = name.split("-")
        counts = {word.rstrip("0123456789"): word for word in words[3:]}
        if set(counts) - {"every", "iterations"} or len(words[:3]) not in (1, 3):
            raise ValueError(
                f"no plan is called {name!r:.80}; expected such as tsm-latent-cem-every10"
            )
        numbers = {word: int(text.removeprefix(word)) for word, text in counts.items()}
        return cls(*words[:3], **numbers)

    @property
    def fields(self) -> Row:
        """Its columns in a table."""
        idle = self.model in TORQUES
        model, planner = ("none", self.model) if idle else (self.model, self.planner)
        way = CLOSED if self.every else OPEN
        return {"model": model, "search_space": self.space, "planner": planner, "execution": way}


def the_task(run: Run, name: str, how: How | None = None) -> Task:
    """The frozen test targets of an arm, fewer at smaller scales."""
    task = tsmlib.load_task(env_id(name))
    n = run.pick(2, 10, 25 if how and how.iterations else len(task))
    return task.take(min(n, len(task)))


def make_plan(run: Run, name: str, plan: str) -> Plan:
    """A plan for every target, by the budget of the scale."""
    how = How.of(plan)
    task = the_task(run, name, how)
    prior = load_prior(run, name) if how.space == "latent" else None
    net = None if how.model == "oracle" else load_model(run, name, how.model)
    space = tsmlib.LatentActions(prior, task.horizon) if prior else _direct(task, how.planner)
    planner = _planner(run, how)
    judge = expected_predictor if how.planner.startswith("cem") else None
    if how.every:
        first = load_plan(run, name, f"{how.model}-{how.space}-{how.planner}")
        keep = {"plan": first, "every": how.every, "seed": run.seed, "progress": f"{name} {plan}"}
        if net is not None and judge is not None:
            keep["judge"] = partial(judge, samples=JUDGING)
        done = tsmlib.mpc(task, net, space, planner, **keep).plan
        return replace(done, seconds=first.seconds + done.seconds)
    began, reward = time.perf_counter(), task.reward
    start: int | torch.Tensor = len(task)
    if net is None:
        predict = tsmlib.simulator_predictor(task)
    elif judge is not None and net.stochastic:
        predict = judge(net, task.past(net.past_len), samples=JUDGING, seed=run.seed)
    else:
        predict = tsmlib.model_predictor(net, task.past(net.past_len), seed=run.seed)
    rough = how.planner == "adam+rough"
    if rough or how.planner == "adam+starts":
        count, keep = (1, 1) if rough else (_candidates(run), 2)
        drawn = {"candidates": count, "keep": keep, "seed": run.seed}
        start = sampled_starts(predict, task.reward, space, len(task), **drawn)
    if rough:
        reward = (push if task.name == "push" else reach)(task.target, torque_weight=0.0)
    found = planner(predict, reward, space, start, progress=f"{name} {plan}")
    found = replace(found, seconds=time.perf_counter() - began)
    if net is None:
        return found
    fresh = fresh_predictor(net, task.past(net.past_len), seed=run.seed + 1)
    return tsmlib.reevaluate(found, fresh, task.reward)


def save_plan(path: str, plan: Plan) -> None:
    """Write a plan with few of its predicted states."""
    tensors = {name: getattr(plan, name) for name in ("actions", "parameters", "curve")}
    tensors |= {"states": plan.states[:KEPT], "predicted_return": plan.predicted_return}
    artifacts.save(path, tensors, kind="plan", header={"seconds": plan.seconds})


def load_plan(run: Run, name: str, plan: str) -> Plan:
    """A plan that is made."""
    tensors, header = artifacts.load(run.require(f"plans/{name}/{plan}"), kind="plan")
    return Plan(**tensors, seconds=header["seconds"])


def trial_of(run: Run, name: str, plan: str) -> tuple[Task, Trial]:
    """A plan executed in the true simulator; or random or zero torques."""
    how = How.of(plan)
    task = the_task(run, name, how)
    if how.model in TORQUES:
        return task, tsmlib.execute(task, TORQUES[how.model](task))
    return task, tsmlib.execute(task, load_plan(run, name, plan))


def trial_rows(run: Run, name: str, plan: str) -> list[Row]:
    """What a trial measured: means over the targets, and rows with a ``target`` of each."""
    how, (task, trial) = How.of(plan), trial_of(run, name, plan)
    about = place(task.env) | {"task": task.name, "horizon": task.horizon} | how.fields
    if how.iterations:  # how soon a long optimisation is nearly done (claim C15)
        about |= {"metric": "iterations_to_95", "unit": "iterations", "n": 1}
        counts = iterations_to(load_plan(run, name, plan).curve).tolist()
        return [about | {"value": value, "target": i} for i, value in enumerate(counts)]
    each = {"return_true": trial.executed_return, "final_distance": trial.final_distance}
    close = trial.final_distance <= task.tolerance
    means = {"success": float(close.float().mean())}
    if trial.plan is not None:
        each["return_predicted"] = trial.plan.predicted_return
        gap, cost = trial.gap.abs(), trial.executed_return.abs()
        means |= {"exploitation_gap": float(trial.gap.mean()), "gap_absolute": float(gap.mean())}
        means["relative_gap_median"] = float((gap / cost).quantile(0.5))
        means["plan_seconds"] = trial.plan.seconds
        if EnvSpec.parse(task.env).task == "push" and not how.every:
            violated = shares(task.start, trial.plan.states.numpy(), task.env)
            most = worst(trial.gap.numpy())
            each["violations"] = torch.from_numpy(violated["violations"])
            means |= {k: float(share.mean()) for k, share in violated.items()}
            means |= {f"{k}_worst": float(share[most].mean()) for k, share in violated.items()}
    means |= {metric: float(values.double().mean()) for metric, values in each.items()}
    rows = [about | {"metric": k, "value": v, "n": len(task)} for k, v in means.items()]
    return rows + [
        about | {"metric": k, "value": float(f"{v:.7g}"), "n": 1, "target": i}
        for k, values in each.items()
        for i, v in enumerate(values.tolist())
    ]


def torque_rows(run: Run, name: str, source: str) -> list[Row]:
    """How alike torques are to the data's (table 07): of a plan, the data, or the prior."""
    task = the_task(run, name)
    train, held_out = (
        torch.from_numpy(load_data(run, name, split).actions) for split in ("train", "test")
    )
    about = place(task.env) | {"task": task.name, "horizon": task.horizon}
    data, rest = held_out[: len(held_out) // 2, : task.horizon], held_out[len(held_out) // 2 :]
    if source == "data":
        about |= {"subset": "data", "model": "none", "planner": "random"}
        torques = data
    elif source in ("sampled", "reconstructed"):
        about |= {"subset": source, "model": "prior", "search_space": "latent"}
        prior, draw = load_prior(run, name), torch.Generator().manual_seed(run.seed)
        drawn = actions.sample_actions(prior, len(data), task.horizon, draw)
        torques = drawn if source == "sampled" else actions.reconstruct(prior, data)
    else:
        about |= How.of(source).fields
        torques, rest = trial_of(run, name, source)[1].actions, held_out
    return [
        about | {"metric": metric, "value": value, "n": len(torques)}
        for metric, value in _torques(torques, rest[:, : task.horizon], train[:500]).items()
    ]


def signal_rows(run: Run, name: str, word: str) -> list[Row]:
    """Signal to noise of the return's gradients in both search spaces (claim C13)."""
    task, prior = the_task(run, name), load_prior(run, name)
    task, samples = task.take(min(50, len(task))), run.pick(4, 16, 32)
    spaces = {"latent": tsmlib.LatentActions(prior, task.horizon), "direct": _direct(task)}
    rows: list[Row] = []
    for space, actions_of in spaces.items():
        about = place(task.env) | How(word, space, "adam").fields | {"metric": "gradient_snr"}
        about |= {"task": task.name, "horizon": task.horizon, "n": samples}
        net = load_model(run, name, word)
        found = gradients.signal(task, net, actions_of, samples=samples, seed=run.seed)
        rows += [about | {"value": value, "target": i} for i, value in enumerate(found.tolist())]
    return rows


def _torques(
    torques: torch.Tensor, held_out: torch.Tensor, train: torch.Tensor
) -> dict[str, float]:
    shape, usual = actions.roughness(torques), actions.roughness(held_out)["change"]
    values = {metric: float(each.mean()) for metric, each in shape.items()}
    values["rms"] = float(torques.square().mean().sqrt())
    values["peak"] = float(torques.abs().amax((1, 2)).mean())
    values["change_ratio"] = values["change"] / float(usual.mean())
    values["novelty"] = float(actions.novelty(torques, train).mean())
    if min(len(torques), len(held_out)) >= 10:  # five folds
        for metric, alone in (("auc", False), ("auc_shape", True)):
            pair = (actions.traits(each, shape=alone) for each in (torques, held_out))
            values[metric] = two_sample_auc(*pair)
    return values


def _candidates(run: Run) -> int:
    return run.pick(8, 96, 96)


def _planner(run: Run, how: How) -> Callable[..., Plan]:
    """The planner with its budget; a plan that is made again needs fewer iterations."""
    n = _candidates(run)
    if how.planner.startswith("adam"):
        usual = run.pick(2, 20, 20) if how.every else run.pick(3, 100, 100)
        return partial(tsmlib.adam, iterations=how.iterations or usual)
    usual = run.pick(1, 3, 4) if how.every else run.pick(2, 8, 10)
    budget = {"candidates": n, "iterations": how.iterations or usual, "seed": run.seed}
    if how.planner == "mppi":
        return partial(tsmlib.mppi, **budget)
    return partial(tsmlib.cem, elites=max(2, n // 10), screened=SCREENED, **budget)


def _direct(task: Task, planner: str = "") -> tsmlib.DirectActions:
    noise = NOISE.get(planner, {"rms": RMS})
    return tsmlib.DirectActions(task.horizon, task.action_dim, **noise)
