"""Films and strips of executed plans beside what was predicted."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from gymnasium.spaces import Box
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from tsmlib import plots as figures
from tsmlib import rewards
from tsmlib.envs import drawing
from tsmlib.envs.geometry import DT
from tsmlib.envs.render import draw_scene, render_array
from tsmlib.envs.stepping import make, within_bounds
from tsmlib.evaluation import latent
from tsmlib.evaluation.futures import Coded
from tsmlib.planning.execution import Trial
from tsmlib.planning.tasks import Task
from tsmlib.plots.method import Method
from tsmlib.trajectory import Trajectories, Window

if TYPE_CHECKING:
    from ipywidgets import VBox


def film(task: Task, trial: Trial, target: int) -> np.ndarray:
    """Frames (T, height, width, 3) of one target: the predicted rollout beside the executed one.

    Of an arm, with the way so far of what has to arrive, the time and, for the paper's reward, how far the target is.
    Of a trial behind noisy sensors that was not planned: the observed states beside the true ones. Of a robot that
    cannot be drawn from its observations (``envs.drawing``): the execution alone, by its own ``render``.
    """
    if task.begins_by_seed and not drawing.drawable(task.env):
        return figures.side_by_side({"executed": _rendered(task, trial, target)})
    if trial.plan is None and trial.observed is not None:
        goal, seen = task.target[target].numpy(), {"observed": trial.observed, "true": trial.states}
        return figures.side_by_side(
            {title: _frames(task.env, x[target].numpy(), goal) for title, x in seen.items()}
        )
    return figures.side_by_side(
        dict(
            zip(
                ("predicted", "executed"),
                _filmed(task, target, *_rollouts(trial, target)),
                strict=True,
            )
        )
    )


def episode_film(data: Trajectories, episode: int) -> np.ndarray:
    """Frames (T + 1, height, width, 3) of one episode, without a target."""
    return _frames(data.env, data.states[episode])


def compared_film(task: Task, trials: Mapping[Method, Trial], target: int) -> np.ndarray:
    """Frames of one target: a column for each method, its predicted rollout above, the executed one below."""
    rows: tuple[dict[str, np.ndarray], ...] = {}, {}
    for method, trial in trials.items():
        films = _filmed(task, target, *_rollouts(trial, target))
        for row, word, frames in zip(rows, ("predicted", "executed"), films, strict=True):
            row[f"{method.look.name}: {word}"] = frames
    return figures.stacked(*map(figures.side_by_side, rows))


def _filmed(task: Task, target: int, *rollouts: np.ndarray) -> list[np.ndarray]:
    """A film of each rollout (T, dx), which begins with the state after the first step."""
    if task.begins_by_seed:  # not an arm
        return [drawing.frames(task.env, states) for states in rollouts]
    goal, told = None if task.position is None else task.target[target].numpy(), task.is_standard
    return [
        _frames(task.env, states, goal, mover=task.position, told=told, first=1)
        for states in rollouts
    ]


def _frames(
    env_id: str,
    states: np.ndarray,
    target: np.ndarray | None = None,
    *,
    mover: slice | None = None,
    told: bool = False,
    first: int = 0,
) -> np.ndarray:
    """Each of the states (T, dx) of an arm drawn, and the time.

    mover: what has to arrive, whose way so far is drawn; told: whether how far it is from the target is said. first:
    the step of the first state.
    """
    way, frames = "block_path" if mover == rewards.BLOCK else "tip_path", []
    for k, state in enumerate(states):
        note = f"{(first + k) * DT:.2f} s"
        if told and mover is not None and target is not None:
            note += f",  {1000 * float(np.linalg.norm(state[mover] - target)):.0f} mm away"
        paths: dict[str, Any] = {} if mover is None else {way: states[: k + 1, mover]}
        frames.append(render_array(state, env_id, target, note=note, **paths))
    return np.stack(frames)


def _rendered(task: Task, trial: Trial, target: int) -> np.ndarray:
    """The episode of one target stepped again, a picture after each step. RuntimeError where there are no pictures."""
    try:
        with closing(make(task.env, render_mode="rgb_array")) as env:
            env.reset(seed=task.seeds[target])
            frames: list[Any] = []
            for action in within_bounds(trial.actions[target].numpy(), cast(Box, env.action_space)):
                _, _, terminated, truncated, _ = env.step(action)
                frames.append(env.render())
                if terminated or truncated:
                    break
            return np.stack(frames)
    except Exception as error:  # of whatever library it renders with
        raise RuntimeError(
            f"{task.env} gives no pictures here: {error!s:.200}. It needs what its render_mode='rgb_array' needs; of "
            "MuJoCo's, without a screen, OpenGL by the environment variable MUJOCO_GL=egl or osmesa"
        ) from error


def _rollouts(trial: Trial, target: int) -> tuple[np.ndarray, np.ndarray]:
    """Predicted and executed states (T, dx), to the end of the episode."""
    if trial.plan is None:
        raise ValueError("these actions were not planned, so there is no predicted rollout")
    steps = trial.steps[target]
    return trial.plan.states[0, target, :steps].numpy(), trial.states[target, 1 : steps + 1].numpy()


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


def code_sliders(
    model: Coded, window: Window, codes: Tensor, plane: Tensor, *, env: str, method: Method
) -> VBox:
    """The object's futures of one moment under two sliders: how far all codes (n, dz) lie along two directions.

    window: N = 1, the moment; plane (2, dz): the directions, orthonormal. What else a code says stays as it is.
    """
    start, steps = window.past.states[0, -1].numpy(), window.future.actions.shape[1]

    def ways(codes: Tensor) -> np.ndarray:
        return latent.decode_codes(model, window, codes, steps)[..., rewards.BLOCK].numpy()

    scene, happened = (
        partial(draw_scene, env_id=env),
        window.future.states[0, :, rewards.BLOCK].numpy(),
    )
    picture = figures.code_fan(scene, start, ways(codes), happened, method)
    return figures.slider_panel(
        lambda first, second: picture(
            ways(latent.held(codes, plane, torch.tensor([first, second])))
        ),
        {
            "first direction of the code": (-3.0, 3.0, 0.25),
            "second direction of the code": (-3.0, 3.0, 0.25),
        },
    )
