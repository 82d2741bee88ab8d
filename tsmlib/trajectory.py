"""Trajectories, segments and windows, and the one time convention that all of tsmlib shares.

In state x_t the environment receives action u_t and moves to x_{t+1}. A segment pairs every state with the action
that led to it:

    states[:, k] = x_{t+k+1}        actions[:, k] = u_{t+k}

so H actions give H states, consecutive segments join without overlap, and a predicted future appended to the past
is the next past. Before t = 0 the state is x_0 repeated and the action is zero (the paper's U_0 = 0, section 4.2).

Letters in shapes: N trajectories, T steps, B batch, L past length, H segment length, dx state size, du action size.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor


class Segment(NamedTuple):
    """States with the actions that led to them: ``states`` (B, L, dx) in physical units, ``actions`` (B, L, du)."""

    states: Tensor
    actions: Tensor

    def then(self, following: Segment) -> Segment:
        """This segment with ``following`` appended in time: (B, L, .) and (B, K, .) give (B, L + K, .)."""
        return Segment(*(torch.cat(pair, dim=1) for pair in zip(self, following, strict=True)))

    def last(self, length: int) -> Segment:
        """The last ``length`` steps, as the past of what follows."""
        return Segment(self.states[:, -length:], self.actions[:, -length:])

    def to(self, device: torch.device | str) -> Segment:
        return Segment(self.states.to(device), self.actions.to(device))


class Window(NamedTuple):
    """A past segment X-, U- (B, L, .) and the future X+, U+ (B, K, .) that followed it."""

    past: Segment
    future: Segment


class TrajectoryError(ValueError):
    """Data that cannot be a set of trajectories; the message names the array, episode, step and field."""


@dataclass(frozen=True)
class Trajectories:
    """Equally long episodes of one environment.

    states: (N, T + 1, dx) float32, physical units, joint angles not wrapped; actions: (N, T, du) float32 in [-1, 1].
    env: the ``gymnasium.make`` id; dt: seconds per step; names, units: one word per state dimension.
    angles: state dimensions that are angles in radians (models see their cosine and sine); none unless they are named.
    Raises TrajectoryError where shapes disagree or a value is not finite.
    """

    states: np.ndarray
    actions: np.ndarray
    env: str
    dt: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    angles: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        states, actions = self.states, self.actions
        if states.ndim != 3 or actions.ndim != 3 or states.shape[:2] != (actions.shape[0], actions.shape[1] + 1):
            raise TrajectoryError(
                f"states {states.shape} and actions {actions.shape} of {self.env} do not fit: "
                "expected (N, T + 1, dx) and (N, T, du)"
            )
        if not len(self.names) == len(self.units) == states.shape[2]:
            raise TrajectoryError(
                f"{self.env}: {states.shape[2]} state dimensions, {len(self.names)} names, {len(self.units)} units; "
                "expected one name and one unit per dimension"
            )
        for field, array, columns in (("states", states, self.names), ("actions", actions, None)):
            bad = np.argwhere(~np.isfinite(array))
            if len(bad):
                episode, step, column = bad[0]
                name = columns[column] if columns else f"action {column}"
                raise TrajectoryError(
                    f"{len(bad)} value(s) in {field} of {self.env} are not finite, the first in episode {episode}, "
                    f"step {step}, field '{name}': {array[episode, step, column]}. Collect this data again."
                )
        if (most := np.abs(actions).max(initial=0)) > 1 + 1e-6:
            raise TrajectoryError(
                f"actions of {self.env} go up to {most:g}; expected them within [-1, 1]. "
                "Divide them by the bounds of the action space first: actions / env.action_space.high"
            )

    def __len__(self) -> int:
        return len(self.states)

    @property
    def horizon(self) -> int:
        """Steps per episode, T."""
        return self.actions.shape[1]

    def take(self, index: slice | np.ndarray) -> Trajectories:
        return replace(self, states=self.states[index], actions=self.actions[index])

    def padded(self, past_len: int) -> Segment:
        """All episodes as one segment (N, past_len + T, .) whose column ``past_len + t`` holds x_{t+1} and u_t."""
        before_states = np.repeat(self.states[:, :1], past_len, axis=1)
        before_actions = np.zeros((len(self), past_len, self.actions.shape[2]), self.actions.dtype)
        states = np.concatenate([before_states, self.states[:, 1:]], axis=1)
        actions = np.concatenate([before_actions, self.actions], axis=1)
        return Segment(torch.from_numpy(states).float(), torch.from_numpy(actions).float())


def initial_past(states: Tensor, past_len: int, action_dim: int) -> Segment:
    """The past of an episode that starts in ``states`` (B, dx): x_0 repeated, zero actions."""
    return Segment(states[:, None].expand(-1, past_len, -1), states.new_zeros(len(states), past_len, action_dim))


def windows(segment: Segment, episodes: Tensor, starts: Tensor, past_len: int, future_len: int) -> Window:
    """Cut one window per pair (episode, start): the past is columns start .. start + past_len of ``segment``."""
    columns = starts[:, None] + torch.arange(past_len + future_len, device=starts.device)
    states, actions = (part[episodes[:, None], columns] for part in segment)
    return Window(
        Segment(states[:, :past_len], actions[:, :past_len]), Segment(states[:, past_len:], actions[:, past_len:])
    )


def batches(
    segment: Segment, *, past_len: int, future_len: int, batch_size: int, generator: torch.Generator
) -> Iterator[Window]:
    """Endless random windows: episode and start are uniform over everything ``segment`` (N, L + T, .) holds."""
    n, steps = segment.actions.shape[:2]
    last_start = steps - past_len - future_len
    if last_start < 0:
        raise TrajectoryError(
            f"episodes of {steps - past_len} steps are too short for windows of {future_len} future steps; "
            f"collect episodes of at least {future_len} steps"
        )
    while True:
        episodes = torch.randint(n, (batch_size,), generator=generator)
        starts = torch.randint(last_start + 1, (batch_size,), generator=generator)
        yield windows(segment, episodes, starts, past_len, future_len)


def states_before(window: Window) -> Tensor:
    """x_t .. x_{t+K-1}, the states in which the future's actions are taken: (B, K, dx)."""
    return torch.cat([window.past.states[:, -1:], window.future.states[:, :-1]], dim=1)
