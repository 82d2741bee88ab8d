"""What a notebook shows: figures, tables, and films and strips of executed plans."""

from typing import Any

import gymnasium
import numpy as np
import pandas as pd
from IPython.display import Markdown, display
from matplotlib.figure import Figure

from tsmlib import figures
from tsmlib.envs.render import draw_scene
from tsmlib.planning.execution import Trial
from tsmlib.planning.tasks import Task
from tsmlib.study.results import table
from tsmlib.study.runs import Run


def show(run: Run, figure: Figure, stem: str) -> None:
    """Save a figure as ``stem`` among the run's and display it."""
    figures.save(figure, run.figures / stem)
    display(figure)


def show_table(found: pd.DataFrame | str, title: str = "", form: str = "{:.3g}") -> None:
    """Display a table, or one that is Markdown already, below its title; nothing of an empty one. form: of floats."""
    if len(found) and isinstance(found, pd.DataFrame):
        found = found if found.index.names == [None] else found.reset_index()
        floats = found.select_dtypes("float")
        found = table.markdown(
            found.assign(**{str(name): floats[name].map(form.format, na_action="ignore") for name in floats})
        )
    if len(found):
        display(Markdown("\n\n".join(part for part in (title, found) if part)))


def film(task: Task, trial: Trial, target: int) -> np.ndarray:
    """Frames (T, height, width, 3) of one target: the predicted rollout beside the executed one.

    Of a trial behind noisy sensors that was not planned: the observed states beside the true ones.
    """
    titles = "predicted", "executed"
    if trial.plan is None and trial.observed is not None:
        titles = "observed", "true"
        predicted, executed = trial.observed[target].numpy(), trial.states[target].numpy()
    else:
        predicted, executed = _rollouts(trial, target)
    env: Any = gymnasium.make_vec(task.env, num_envs=1).unwrapped
    goal = task.target[target].numpy()
    left, right = (np.stack([env.image(state, goal) for state in states]) for states in (predicted, executed))
    env.close()
    return figures.side_by_side(left, right, titles)


def strip(task: Task, trial: Trial, target: int, *, frames: int = 6) -> Figure:
    """The same as a filmstrip."""
    predicted, executed = _rollouts(trial, target)
    times = [round(step) for step in np.linspace(0, len(executed) - 1, frames)]
    goal = task.target[target].numpy()
    return figures.plan_strip(
        lambda ax, state, goal: draw_scene(ax, state, task.env, goal), predicted, executed, goal, times
    )


def _rollouts(trial: Trial, target: int) -> tuple[np.ndarray, np.ndarray]:
    if trial.plan is None:
        raise ValueError("these actions were not planned, so there is no predicted rollout")
    return trial.plan.states[0, target].numpy(), trial.states[target, 1:].numpy()
