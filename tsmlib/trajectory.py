"""Trajectories, segments and windows, and the one time convention that all of tsmlib shares.

In state x_t the environment receives action u_t and moves to x_{t+1}. A segment pairs every state with the action
that led to it:

    states[:, k] = x_{t+k+1}        actions[:, k] = u_{t+k}

so H actions give H states, consecutive segments join without overlap, and a predicted future appended to the past
is the next past. Before t = 0 the state is x_0 repeated and the action is zero (the paper's U_0 = 0, section 4.2).

Letters in shapes: N trajectories, T steps, B batch, L past length, H segment length, dx state size, du action size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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


@dataclass(frozen=True, repr=False)
class Trajectories:
    """Episodes of one environment.

    states: (N, T + 1, dx) float32, physical units, joint angles not wrapped; actions: (N, T, du) float32 in [-1, 1].
    env: the ``gymnasium.make`` id; dt: seconds per step; names, units: one word per state dimension.
    angles: state dimensions that are angles in radians (models see their cosine and sine); none unless they are named.
    lengths: steps of each episode, T of the longest; none: all have T. Beyond its end an episode is padded: its last
    state repeats, and actions are zero. terminated: whether the environment ended the episode, as opposed to a limit of
    time; none: it ended none of them. Both are empty where they would say just that, whatever was given.
    Raises TrajectoryError where shapes disagree, a value is not finite, or the padding is something else.
    """

    states: np.ndarray
    actions: np.ndarray
    env: str
    dt: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    angles: tuple[int, ...] = ()
    lengths: tuple[int, ...] = ()
    terminated: tuple[bool, ...] = ()

    def __repr__(self) -> str:
        n, steps = self.actions.shape[:2]
        return f"Trajectories({self.env!r}, {n} episodes, {steps} steps, {len(self.names)} states)"

    def __post_init__(self) -> None:
        states, actions = self.states, self.actions
        if (
            states.ndim != 3
            or actions.ndim != 3
            or states.shape[:2] != (actions.shape[0], actions.shape[1] + 1)
        ):
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
        self._check_ends()

    def __len__(self) -> int:
        return len(self.states)

    @classmethod
    def ragged(
        cls,
        states: Sequence[np.ndarray],
        actions: Sequence[np.ndarray],
        env: str,
        dt: float,
        names: tuple[str, ...],
        units: tuple[str, ...],
        angles: tuple[int, ...] = (),
        *,
        terminated: Sequence[bool] = (),
    ) -> Trajectories:
        """Episodes of states (T_i + 1, dx) and actions (T_i, du), padded to the longest of them."""
        for episode, (x, u) in enumerate(zip(states, actions, strict=True)):
            if x.ndim != 2 or u.ndim != 2 or len(x) != len(u) + 1:
                raise TrajectoryError(
                    f"states {x.shape} and actions {u.shape} of episode {episode} of {env} do not fit: expected "
                    "(T + 1, dx) and (T, du)"
                )
        lengths = tuple(len(u) for u in actions)
        longest = max(lengths, default=0)
        x = np.stack(
            [np.pad(part, ((0, longest + 1 - len(part)), (0, 0)), mode="edge") for part in states]
        )
        u = np.stack([np.pad(part, ((0, longest - len(part)), (0, 0))) for part in actions])
        return cls(x, u, env, dt, names, units, angles, lengths, tuple(map(bool, terminated)))

    @property
    def horizon(self) -> int:
        """Steps of the longest episode, T."""
        return self.actions.shape[1]

    @property
    def steps(self) -> np.ndarray:
        """Steps of each episode (N,)."""
        return np.array(self.lengths or [self.horizon] * len(self), np.int64)

    def take(self, index: slice | np.ndarray) -> Trajectories:
        """Some of the episodes, padded to the longest of them."""
        lengths = self.steps[index]
        longest = int(lengths.max(initial=0)) if self.lengths else self.horizon
        return replace(
            self,
            states=self.states[index][:, : longest + 1],
            actions=self.actions[index][:, :longest],
            lengths=tuple(lengths.tolist()),
            terminated=tuple(np.array(self.terminated)[index].tolist()) if self.terminated else (),
        )

    def joined(self, other: Trajectories) -> Trajectories:
        """The episodes of both, padded to the longest; TrajectoryError where they are not of one robot."""
        self.require_robot_of(other)
        both, longest = (self, other), max(self.horizon, other.horizon)
        states = [
            np.pad(t.states, ((0, 0), (0, longest - t.horizon), (0, 0)), mode="edge") for t in both
        ]
        actions = [np.pad(t.actions, ((0, 0), (0, longest - t.horizon), (0, 0))) for t in both]
        ended = [t.terminated or (False,) * len(t) for t in both]
        return replace(
            self,
            states=np.concatenate(states),
            actions=np.concatenate(actions),
            terminated=ended[0] + ended[1],
            lengths=tuple(np.concatenate([t.steps for t in both]).tolist()),
        )

    def require_robot_of(self, other: Trajectories) -> None:
        """TrajectoryError where the episodes of both are not of one robot."""
        for name in ("env", "dt", "names", "units", "angles"):
            if (ours := getattr(self, name)) != (theirs := getattr(other, name)):
                raise TrajectoryError(
                    f"episodes with {name} {ours} and {theirs} cannot be joined; expected one robot"
                )

    def cut(self, steps: int) -> Trajectories:
        """The first ``steps`` steps of every episode that has as many; TrajectoryError where none has."""
        among = np.flatnonzero(self.steps >= steps)
        if steps < 1 or not len(among):
            raise TrajectoryError(
                f"no episode of {self.env} has {steps} steps: {len(self)} episodes, the longest of {self.horizon}"
            )
        ended = [
            bool(self.terminated and self.terminated[i] and self.steps[i] == steps) for i in among
        ]
        states, actions = self.states[among][:, : steps + 1], self.actions[among][:, :steps]
        return replace(self, states=states, actions=actions, lengths=(), terminated=tuple(ended))

    def require_equal_lengths(self, purpose: str) -> None:
        """TrajectoryError where episodes differ in length, for a ``purpose`` that compares them step by step."""
        if self.lengths:
            raise TrajectoryError(
                f"{purpose} needs episodes of equal length; those of {self.env} have {min(self.lengths)} to "
                f"{self.horizon} steps. Take the beginning of those that are long enough: data.cut(steps)"
            )

    def _check_ends(self) -> None:
        """Lengths and terminations that fit the arrays, and padding that is what it has to be."""
        n, horizon = len(self), self.horizon
        for field, values, kind in (
            ("lengths", self.lengths, int),
            ("terminated", self.terminated, bool),
        ):
            if values and (len(values) != n or any(type(value) is not kind for value in values)):
                raise TrajectoryError(
                    f"{field} of {self.env} is {values!r:.80}; expected a tuple of {n} {kind.__name__}s, one each"
                )
        if self.lengths and not (min(self.lengths) >= 1 and max(self.lengths) == horizon):
            raise TrajectoryError(
                f"lengths of {self.env} go from {min(self.lengths)} to {max(self.lengths)}; expected at least 1, and "
                f"the longest to fill the {horizon} steps of the arrays"
            )
        after = (
            np.arange(horizon) >= self.steps[:, None]
        )  # (N, T), of actions and of the states that they lead to
        last = np.take_along_axis(self.states, self.steps[:, None, None], axis=1)
        wrong = after & ((self.states[:, 1:] != last).any(-1) | (self.actions != 0).any(-1))
        if wrong.any():
            episode, step = np.argwhere(wrong)[0]
            raise TrajectoryError(
                f"episode {episode} of {self.env} ends after {self.lengths[episode]} steps, but its arrays go on at "
                f"step {step}; expected its last state repeated and zero actions. Trajectories.ragged(...) pads them"
            )
        # One way to say that all are of equal length, and that none was ended.
        if all(length == horizon for length in self.lengths):
            object.__setattr__(self, "lengths", ())
        if not any(self.terminated):
            object.__setattr__(self, "terminated", ())

    def padded(self, past_len: int) -> Segment:
        """All episodes as one segment (N, past_len + T, .) whose column ``past_len + t`` holds x_{t+1} and u_t."""
        before_states = np.repeat(self.states[:, :1], past_len, axis=1)
        before_actions = np.zeros((len(self), past_len, self.actions.shape[2]), self.actions.dtype)
        states = np.concatenate([before_states, self.states[:, 1:]], axis=1)
        actions = np.concatenate([before_actions, self.actions], axis=1)
        return Segment(torch.from_numpy(states).float(), torch.from_numpy(actions).float())


def initial_past(states: Tensor, past_len: int, action_dim: int) -> Segment:
    """The past of an episode that starts in ``states`` (B, dx): x_0 repeated, zero actions."""
    return Segment(
        states[:, None].expand(-1, past_len, -1),
        states.new_zeros(len(states), past_len, action_dim),
    )


def windows(
    segment: Segment, episodes: Tensor, starts: Tensor, past_len: int, future_len: int
) -> Window:
    """Cut one window per pair (episode, start): the past is columns start .. start + past_len of ``segment``."""
    columns = starts[:, None] + torch.arange(past_len + future_len, device=starts.device)
    states, actions = (part[episodes[:, None], columns] for part in segment)
    return Window(
        Segment(states[:, :past_len], actions[:, :past_len]),
        Segment(states[:, past_len:], actions[:, past_len:]),
    )


def real_steps(lengths: Sequence[int], horizon: int) -> Tensor:
    """(N, T) bool: the steps of episodes of these lengths, as opposed to their padding."""
    return torch.arange(horizon) < torch.tensor(lengths)[:, None]


def window_at(index: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Episode and start of the windows ``index`` (B,), counted episode by episode; ``counts`` (N,) windows of each."""
    ends = counts.cumsum(0)
    episodes = torch.searchsorted(ends, index, right=True)
    return episodes, index - (ends - counts)[episodes]


def batches(
    segment: Segment,
    *,
    past_len: int,
    future_len: int,
    batch_size: int,
    generator: torch.Generator,
    lengths: Sequence[int] = (),
) -> Iterator[Window]:
    """Endless random windows: uniform over everything that ``segment`` (N, L + T, .) holds.

    lengths: steps of each episode, as of ``Trajectories``. No window crosses an end, so an episode that is shorter than
    a window has none; TrajectoryError where all are.
    """
    n, steps = segment.actions.shape[:2]
    last_start = steps - past_len - future_len
    if last_start < 0:
        raise TrajectoryError(
            f"episodes of {steps - past_len} steps are too short for windows of {future_len} future steps; "
            f"collect episodes of at least {future_len} steps"
        )
    # Starts of each episode, for episodes of different length.
    counts = (
        (torch.tensor(lengths) + (1 + last_start - max(lengths))).clamp_min(0) if lengths else None
    )
    while True:
        if counts is None:
            episodes = torch.randint(n, (batch_size,), generator=generator)
            starts = torch.randint(last_start + 1, (batch_size,), generator=generator)
        else:
            index = torch.randint(int(counts.sum()), (batch_size,), generator=generator)
            episodes, starts = window_at(index, counts)
        yield windows(segment, episodes, starts, past_len, future_len)


def states_before(window: Window) -> Tensor:
    """x_t .. x_{t+K-1}, the states in which the future's actions are taken: (B, K, dx)."""
    return torch.cat([window.past.states[:, -1:], window.future.states[:, :-1]], dim=1)
