"""Results of 09_your_own: rows from scores and trials of robots that are not arms; tables and sentences from rows.

Scores have ``steps_ahead`` and were taken open loop after ten observed steps; ``train_seconds`` are CPU seconds. Plans
are ``closed loop``; returns are by the environment's own reward, per episode and per step.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from tsmlib.evaluation.prediction import Scores
from tsmlib.planning.execution import Trial
from tsmlib.planning.tasks import Task
from tsmlib import zoo
from reproduction.results import table
from reproduction.results.planning import CLOSED, OPEN
from reproduction.results.table import Row
from reproduction.runs import Run
from tsmlib.zoo import OURS

AHEAD = (10, 50)  # steps
SCORES = {"energy_score_noise": "energy score", "nrmse": "nRMSE"}
PENDULUM, HOPPER, CHEETAH = "Pendulum-v1", "Hopper-v5", "HalfCheetah-v5"
ENVS = (PENDULUM, HOPPER, CHEETAH)
SOURCE = "https://github.com/DLR-RM/rl-baselines3-zoo/blob/master/benchmark.md"
MODEL_FREE = {  # of SOURCE, one run each: environment steps of training, steps of an episode, mean return
    PENDULUM: (
        ("PPO", "Pendulum-v1", 100_000, 200, -172.225),
        ("SAC", "Pendulum-v1", 20_000, 200, -156.995),
    ),
    HOPPER: (
        ("PPO", "Hopper-v3", 1_000_000, 1000, 2410.435),
        ("SAC", "Hopper-v3", 1_000_000, 1000, 2325.547),
    ),
    CHEETAH: (
        ("PPO", "HalfCheetah-v3", 1_000_000, 1000, 5819.099),
        ("SAC", "HalfCheetah-v3", 1_000_000, 1000, 9535.451),
    ),
}


# Rows ----------------------------------------------------------------------------------------------------------------


def score_rows(run: Run, env: str, model: str, scores: Scores, seconds: float) -> list[Row]:
    """One row per score and step ahead; and one of the training's CPU ``seconds``."""
    curves, n = scores.against_horizon(), len(scores.outside)
    common = dict(
        env=env, model=model, planner="none", execution=OPEN, n=n, seed=run.seed, scale=run.scale
    )
    found = [
        common
        | dict(metric=metric, steps_ahead=steps, value=float(curves[metric][steps - 1]), unit="1")
        for metric in SCORES
        for steps in AHEAD
    ]
    return [*found, common | dict(metric="train_seconds", value=seconds, unit="s")]


def plan_rows(run: Run, task: Task, model: str, trial: Trial) -> list[Row]:
    """Means over the starts of a task: returns by the environment's own reward, the task's return, and success.

    model: of the plans, or oracle, zero or random. The horizon is what the environment may take, ended early or not.
    """
    who = (
        {"model": "none", "planner": model}
        if model in ("zero", "random")
        else {"model": model, "planner": "cem"}
    )
    steps = np.array(trial.steps)
    own = np.full(len(task), np.nan) if trial.own_return is None else trial.own_return.numpy()
    found = {
        "own_return": own.mean(),
        "own_reward_per_step": (own / steps).mean(),
        "steps": steps.mean(),
        "return_true": float(trial.executed_return.mean()),
    }
    if trial.success is not None:
        found["success"] = float(trial.success.float().mean())
    common = dict(
        env=task.env,
        task=task.name,
        horizon=task.horizon,
        execution=CLOSED,
        n=len(task),
        seed=run.seed,
    )
    return [
        common | who | dict(metric=name, value=float(value), scale=run.scale)
        for name, value in found.items()
    ]


# Tables --------------------------------------------------------------------------------------------------------------


@table.sourced
def scores_table(rows: pd.DataFrame) -> pd.DataFrame:
    """A line for each robot and model: both scores at every step of AHEAD, and the CPU seconds of training."""
    lines = []
    for (env, model), own in table.groups(table.select(rows, execution=OPEN), ["env", "model"]):
        line: Row = {"env": env, "model": f"`{model}`"}
        for metric, title in SCORES.items():
            for steps in AHEAD:
                found = table.select(own, metric=metric, steps_ahead=steps)
                line[f"{title}, {steps} steps"] = table.spell(found["value"])
        line["CPU s"] = table.spell(table.select(own, metric="train_seconds")["value"], "{:.0f}")
        lines.append({**line, "n": int(own["n"].max())})
    return pd.DataFrame(lines)


@table.sourced
def plans_table(rows: pd.DataFrame) -> pd.DataFrame:
    """A line for each robot and method: return by the environment's own reward, per step, steps, and success."""
    lines = []
    for (env, model, planner), own in table.groups(
        table.select(rows, execution=CLOSED), ["env", "model", "planner"]
    ):
        seeds = {metric: part["value"] for metric, part in table.groups(own, "metric")}
        lines.append(
            {
                "env": env,
                "planner": zoo.look(model if model != "none" else planner).name,
                "own return": table.spell(seeds["own_return"], "{:.1f} ± {:.1f}"),
                "per step": table.spell(seeds["own_reward_per_step"], "{:.2f} ± {:.2f}"),
                "steps": f"{table.spell(seeds['steps'], '{:.0f} ± {:.0f}')} of {own['horizon'].max()}",
                "success": table.spell(100 * seeds["success"], "{:.0f} ± {:.0f}") + " %"
                if "success" in seeds
                else "",
                "n": int(own["n"].max()),
            }
        )
    return pd.DataFrame(lines)


def model_free_table() -> str:
    """What model-free learners reach, as others have published it."""
    lines = [
        {
            "env": env,
            "learner": learner,
            "trained on": name,
            "environment steps": f"{taken:,}",
            "own return": f"{value:.1f}",
            "per step": f"{value / episode:.2f}",
            "steps": f"{episode}",
        }
        for env, figures in MODEL_FREE.items()
        for learner, name, taken, episode, value in figures
    ]
    return table.markdown(pd.DataFrame(lines))


@table.told
def sentences(rows: pd.DataFrame) -> Iterator[str]:
    """How the segment model's energy score compares with the best of the others, robot by robot."""
    for env, own in table.groups(table.select(rows, metric="energy_score_noise"), "env"):
        said = []
        for steps, found in table.groups(own, "steps_ahead"):
            means = found.groupby("model")["value"].mean()
            others = means.drop(OURS, errors="ignore")
            if OURS in means and len(others):
                ratio = means[OURS] / others.min()
                said.append(
                    f"{ratio:.2f} times that of the best other, `{others.idxmin()}`, at {steps} steps"
                )
        if said:
            yield f"`{env}`: the energy score of `{OURS}` is {', and '.join(said)}."
