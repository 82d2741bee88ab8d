"""Films and strips of executed plans."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from matplotlib.figure import Figure

from tsmlib import figures
from tsmlib.envs.render import draw_scene
from tsmlib.planning.execution import Trial
from tsmlib.planning.tasks import Task

# Pictures ------------------------------------------------------------------------------------------------------------


def film(task: Task, trial: Trial, target: int) -> np.ndarray:
    """Frames (T, height, width, 3) of one target: what the model dreamt beside what the arm did.

    Of a trial behind noisy sensors that was not planned: what the sensors said beside what the arm did.
    """
    title = "what the model dreamt"
    if trial.plan is None and trial.observed is not None:
        title, dreamt, done = "what the sensors say", trial.observed[target].numpy(), trial.states[target].numpy()
    else:
        dreamt, done = _dreamt_and_done(trial, target)
    env: Any = gymnasium.make_vec(task.env, num_envs=1).unwrapped
    goal = task.target[target].numpy()
    left, right = (np.stack([env.image(state, goal) for state in states]) for states in (dreamt, done))
    env.close()
    return figures.side_by_side(left, right, (title, "what the arm did"))


def strip(task: Task, trial: Trial, target: int, *, frames: int = 6) -> Figure:
    """The same as a filmstrip."""
    dreamt, done = _dreamt_and_done(trial, target)
    times = [round(step) for step in np.linspace(0, len(done) - 1, frames)]
    return figures.plan_strip(
        lambda ax, state, goal: draw_scene(ax, state, task.env, goal), dreamt, done, task.target[target].numpy(), times
    )


def _dreamt_and_done(trial: Trial, target: int) -> tuple[np.ndarray, np.ndarray]:
    if trial.plan is None:
        raise ValueError("these actions were not planned, so there is nothing that a model dreamt")
    return trial.plan.states[0, target].numpy(), trial.states[target, 1:].numpy()
