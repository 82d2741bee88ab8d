"""Films of executed plans beside what was predicted, and of collected episodes."""

from __future__ import annotations

from contextlib import closing
from typing import cast

import numpy as np
from gymnasium.spaces import Box

from tsmlib import plots, rewards
from tsmlib.envs import drawing
from tsmlib.envs.geometry import DT
from tsmlib.envs.pusht_field import pusht_frames, pusht_physics
from tsmlib.envs.render import render_frames
from tsmlib.envs.spec import is_arm
from tsmlib.envs.stepping import make, within_bounds
from tsmlib.planning.execution import Trial
from tsmlib.planning.tasks import Task
from tsmlib.trajectory import Trajectories


def film(task: Task, trial: Trial, target: int) -> np.ndarray:
    """Film one target: the predicted rollout beside the executed one.

    An arm is drawn with the way of what has to arrive, the time and, for the paper's reward, the
    distance to the target. Where nothing was planned the film shows what the sensors saw beside
    what happened, or what happened alone. A robot that cannot be drawn from its observations
    (``envs.drawing``) is filmed by its own ``render``.

    Args:
        task: what was planned for.
        trial: what was executed.
        target: which of the task's targets.

    Returns:
        Frames (T, H, W, 3) uint8.

    Raises:
        RuntimeError: the environment gives no pictures here.
    """
    if task.begins_by_seed and not drawing.drawable(task.env):
        return plots.side_by_side({"executed": _rendered(task, trial, target)})
    steps = trial.steps[target]
    rollouts = {"executed": trial.states[target, 1 : steps + 1].numpy()}
    if trial.plan is not None:
        predicted = trial.plan.states[0, target, :steps].numpy()
        rollouts = {"predicted": predicted} | rollouts
    elif trial.observed is not None:
        rollouts = {"observed": trial.observed[target, 1 : steps + 1].numpy()} | rollouts
    return plots.side_by_side({name: _drawn(task, x, target) for name, x in rollouts.items()})


def episode_film(data: Trajectories, episode: int) -> np.ndarray:
    """Film one collected episode.

    Args:
        data: episodes of an arm, or of a robot that can be drawn from its observations.
        episode: which of them.

    Returns:
        Frames (T + 1, H, W, 3) uint8.
    """
    states, _ = data.episode(episode)
    if data.env.startswith("tsm/PushT-"):
        return pusht_frames(states, None, pusht_physics(data.env))
    if not is_arm(data.env):
        return drawing.frames(data.env, states)
    seconds = DT * np.arange(len(states))
    return render_frames(states, data.env, notes=[f"{t:.2f} s" for t in seconds])


def _drawn(task: Task, states: np.ndarray, target: int) -> np.ndarray:
    """A film of a rollout (T, dx), which begins with the state after the first step."""
    if task.begins_by_seed:  # not an arm
        return drawing.frames(task.env, states)
    if task.env.startswith("tsm/PushT-"):
        return pusht_frames(states, task.target[target].numpy(), pusht_physics(task.env))
    mover = task.position
    goal = None if mover is None else task.target[target].numpy()
    notes = [f"{DT * (step + 1):.2f} s" for step in range(len(states))]
    if task.is_standard and goal is not None:
        away = 1000 * np.linalg.norm(states[:, mover] - goal, axis=-1)
        notes = [f"{note},  {mm:.0f} mm away" for note, mm in zip(notes, away, strict=True)]
    path = None if mover is None else states[:, mover]
    tip, block = (None, path) if mover == rewards.BLOCK else (path, None)
    return render_frames(states, task.env, goal, notes=notes, tip_path=tip, block_path=block)


def _rendered(task: Task, trial: Trial, target: int) -> np.ndarray:
    """The episode of one target stepped again, a picture after each step."""
    try:
        with closing(make(task.env, render_mode="rgb_array")) as env:
            env.reset(seed=task.seeds[target])
            frames: list[np.ndarray] = []
            bounds = cast(Box, env.action_space)
            for action in within_bounds(trial.actions[target].numpy(), bounds):
                _, _, terminated, truncated, _ = env.step(action)
                frames.append(cast(np.ndarray, env.render()))
                if terminated or truncated:
                    break
            return np.stack(frames)
    except Exception as error:  # of whatever library it renders with
        raise RuntimeError(
            f"{task.env} gives no pictures here: {error!r:.200}. It needs what its "
            "render_mode='rgb_array' needs; MuJoCo without a screen needs OpenGL by the "
            "environment variable MUJOCO_GL=egl or osmesa"
        ) from error
