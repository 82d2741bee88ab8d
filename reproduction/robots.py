"""Gymnasium's robots: models after equal training, plans beside the simulator's (table 09)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch

import tsmlib
from reproduction.measures.planning import random_torques
from reproduction.runs import Run
from reproduction.tables import Row
from tsmlib import rewards, zoo
from tsmlib.planning.tasks import Task
from tsmlib.trajectory import Trajectories

MODELS = {"rtsm": {"hidden": 96}, "onestep": {}, "lstm": {"hidden": 96}, "ensemble+mse": {}}
AHEAD = (10, 50)  # steps
FEWER = 4  # starts from which the simulator plans, which takes long


@dataclass(frozen=True)
class Robot:
    """What a robot is to do.

    Args:
        rms: size of its random actions; time_constant: seconds over which they change.
        reward: of states (..., dx) and actions (..., du).
        horizon: steps of an episode that is planned; recorded: of one of the data, 0 for the
            environment's own.
    """

    rms: float
    time_constant: float
    reward: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
    horizon: int = 50
    recorded: int = 0


ROBOTS = {
    "Pendulum-v1": Robot(
        0.6, 0.3, lambda x, u: x[..., 0] - 0.01 * x[..., 2].square(), horizon=100, recorded=200
    ),
    "Hopper-v5": Robot(
        0.15,
        0.2,
        rewards.until(
            lambda x: (x[..., 0] < 0.7) | (x[..., 1].abs() > 0.2),
            lambda x, u: 1 + x[..., 5] - 1e-3 * u.square().sum(-1),
        ),
    ),
    "HalfCheetah-v5": Robot(0.5, 0.1, lambda x, u: x[..., 8] - 0.1 * u.square().sum(-1)),
}


def robot_rows(run: Run, env: str, word: str) -> list[Row]:
    """Scores of a model of one robot; of the recurrent model plans too, closed loop."""
    robot = ROBOTS[env]
    train, held_out, test = _data(run, env)
    spec, updates = zoo.find(word), run.pick(4, 250, 800)
    net = spec.load().for_data(train, seed=run.seed, **MODELS[word])
    options = tsmlib.TrainingOptions(
        net.past_len, 10, updates, batch_size=128, lr=4e-3, muon=0.02, warmup=20
    )
    tsmlib.fit(net, train, held_out, options, seed=run.seed, progress=f"{env} {word}")
    scores = tsmlib.score(
        net, net.features, test, held_out, samples=32, horizon=max(AHEAD), starts=(10,)
    )
    curves = scores.against_horizon()
    about: Row = {"env": env, "model": word, "n": len(test)}
    rows = [
        about
        | {"planner": "none", "execution": "open loop", "metric": metric, "steps_ahead": h}
        | {"value": float(curves[metric][h - 1])}
        for metric in ("energy_score_noise", "nrmse")
        for h in AHEAD
    ]
    if word != "rtsm":
        return rows
    task = Task.from_env(
        env, n=run.pick(2, 4, 32), horizon=robot.horizon, seed=1000, reward=robot.reward
    )
    candidates, elites, iterations = run.pick((4, 2, 1), (32, 6, 3), (64, 8, 4))
    planner = partial(
        tsmlib.cem, candidates=candidates, elites=elites, iterations=iterations, seed=run.seed
    )
    space = tsmlib.DirectActions(task.horizon, task.action_dim, rms=robot.rms)
    few = task.take(min(FEWER, len(task)))
    trials = {
        (word, "cem"): tsmlib.mpc(task, net, space, planner, every=5),
        ("oracle", "cem"): tsmlib.mpc(few, None, space, planner, every=5),
        ("none", "zero"): tsmlib.execute(task, task.idle_actions()),
        ("none", "random"): tsmlib.execute(task, random_torques(task, seed=run.seed)),
    }
    for (model, how), trial in trials.items():
        steps = torch.tensor(trial.steps, dtype=torch.float)
        means = {"return_true": trial.executed_return.mean(), "steps": steps.mean()}
        if trial.own_return is not None:
            means["own_return"] = trial.own_return.mean()
            means["own_reward_per_step"] = (trial.own_return / steps).mean()
        about = {"env": env, "task": task.name, "model": model, "planner": how}
        about |= {"execution": "closed loop", "horizon": task.horizon, "n": len(trial.actions)}
        rows += [about | {"metric": k, "value": float(v)} for k, v in means.items()]
    return rows


def _data(run: Run, env: str) -> tuple[Trajectories, Trajectories, Trajectories]:
    """Random episodes: training, held out, test."""
    robot, n = ROBOTS[env], run.pick(150, 300, 600) if env != "Pendulum-v1" else 50
    how = {"rms": robot.rms, "time_constant": robot.time_constant}
    if robot.recorded:
        how["horizon"] = robot.recorded
    data, part = tsmlib.collect_random(env, n, seed=run.seed, **how), n // 5
    cuts = (slice(2 * part, None), slice(part), slice(part, 2 * part))
    return tuple(data.take(cut) for cut in cuts)
