"""What a notebook shows: figures, tables, and films and strips of executed plans."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
from IPython.display import Markdown, display
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tsmlib import figures, rewards
from tsmlib.envs.render import draw_scene
from tsmlib.figures.method import Method
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
    return figures.side_by_side(dict(zip(titles, _filmed(task, target, predicted, executed), strict=True)))


def compared_film(task: Task, trials: Mapping[Method, Trial], target: int) -> np.ndarray:
    """Frames of one target: a column for each method, its predicted rollout above, the executed one below."""
    rows: tuple[dict[str, np.ndarray], ...] = {}, {}
    for method, trial in trials.items():
        films = _filmed(task, target, *_rollouts(trial, target))
        for row, word, frames in zip(rows, ("predicted", "executed"), films, strict=True):
            row[f"{method.look.name}: {word}"] = frames
    return figures.stacked(*map(figures.side_by_side, rows))


def strip(task: Task, trials: Mapping[Method, Trial], target: int, *, frames: int = 6) -> Figure:
    """The same as a filmstrip, with the way of what has to arrive, and where it ends."""
    rollouts = {method: _rollouts(trial, target) for method, trial in trials.items()}
    ends = {method: 1000 * float(trial.final_distance[target]) for method, trial in trials.items()}
    notes = {method: f"ends {end:.0f} mm off" for method, end in ends.items()}
    times = [round(step) for step in np.linspace(0, task.horizon - 1, frames)]
    way = "block_path" if task.position == rewards.BLOCK else "tip_path"

    def draw(ax: Axes, states: np.ndarray, goal: np.ndarray) -> None:
        paths: dict[str, Any] = {way: states[:, task.position]}
        draw_scene(ax, states[-1], task.env, goal, **paths)

    return figures.plan_strip(draw, rollouts, task.target[target].numpy(), times, notes=notes)


def _filmed(task: Task, target: int, *rollouts: np.ndarray) -> list[np.ndarray]:
    """A film of each rollout (T, dx)."""
    env: Any = gymnasium.make_vec(task.env, num_envs=1).unwrapped
    goal = task.target[target].numpy()
    films = [np.stack([env.image(state, goal) for state in states]) for states in rollouts]
    env.close()
    return films


def _rollouts(trial: Trial, target: int) -> tuple[np.ndarray, np.ndarray]:
    if trial.plan is None:
        raise ValueError("these actions were not planned, so there is no predicted rollout")
    return trial.plan.states[0, target].numpy(), trial.states[target, 1:].numpy()
