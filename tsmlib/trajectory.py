"""Trajectories, segments and windows, and the one time convention that all of tsmlib shares.

In state x_t the environment receives action u_t and moves to x_{t+1}. A segment pairs every state
with the action that led to it:

    states[:, k] = x_{t+k+1}        actions[:, k] = u_{t+k}

so H actions give H states, consecutive segments join without overlap, and a predicted future
appended to the past is the next past. Before t = 0 the state is x_0 repeated and the action is zero
(the paper's U_0 = 0, section 4.2).

Letters in shapes: N trajectories, T steps, B batch, L past length, H segment length, K future
length, dx state size, du action size.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, NamedTuple, NoReturn

import numpy as np
import torch
from torch import Tensor

from tsmlib.checks import require_count, require_number

Arrays = np.ndarray | Tensor | Sequence[np.ndarray] | Sequence[Tensor]


class TrajectoryError(ValueError):
    """Data that cannot be trajectories; the message names the array, episode, step and field."""


class Segment(NamedTuple):
    """States (B, L, dx), in physical units, with the actions (B, L, du) that led to them."""

    states: Tensor
    actions: Tensor

    def then(self, following: Segment) -> Segment:
        """This segment with ``following`` appended: (B, L, .) and (B, K, .) give (B, L + K, .)."""
        return Segment(*(torch.cat(pair, dim=1) for pair in zip(self, following, strict=True)))

    def last(self, length: int) -> Segment:
        """The last ``length`` steps, as the past of what follows."""
        return Segment(self.states[:, -length:], self.actions[:, -length:])

    def to(self, device: torch.device | str) -> Segment:
        """The same segment on ``device``."""
        return Segment(self.states.to(device), self.actions.to(device))


class Window(NamedTuple):
    """A past segment X-, U- (B, L, .) and the future X+, U+ (B, K, .) that followed it."""

    past: Segment
    future: Segment


@dataclass(frozen=True)
class Robot:
    """What the numbers of states and actions mean; data, models and tasks are compared by it.

    Args:
        env: id of the environment, with its arguments where it has some; any name for a log.
        dt: seconds per step.
        names: one word per state dimension.
        units: one unit per state dimension, '' where unknown.
        angles: state dimensions that are angles in radians, by index or by name.
        action_dim: number of actions, du.
    """

    env: str
    dt: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    angles: tuple[int, ...]
    action_dim: int

    def __post_init__(self) -> None:
        names, units = _words("names", self.names), _words("units", self.units)
        if not isinstance(self.env, str) or not self.env:
            raise TrajectoryError(f"env is {self.env!r:.80}; expected the name of an environment")
        if not names or len(set(names)) < len(names) or len(units) != len(names):
            raise TrajectoryError(
                f"names are {names!r:.200} and units {units!r:.200}; expected one of each per "
                "state dimension, and no name twice"
            )
        angles = _columns(self.angles, names)
        for angle in angles:
            if units[angle].lower() in ("deg", "degree", "degrees", "°"):
                raise TrajectoryError(
                    f"the angle '{names[angle]}' has the unit {units[angle]!r}; expected radians: "
                    "convert it by np.radians(...) and name its unit 'rad'"
                )
        require_count("action_dim", self.action_dim)
        dt = require_number("dt", self.dt, 0, above=True)
        self.__dict__.update(names=names, units=units, angles=angles, dt=dt)

    @property
    def state_dim(self) -> int:
        """Number of state dimensions, dx."""
        return len(self.names)

    def require_same(self, other: Robot, what: str, *, but: Collection[str] = ()) -> None:
        """Compare two robots; time steps within 0.1 % of each other count as the same.

        Args:
            other: the robot to compare with.
            what: what the two are of, such as "training and validation data".
            but: names of fields that may differ.

        Raises:
            TrajectoryError: they differ; it names both sides of every field that does.
        """
        differing = []
        for name in (field.name for field in fields(Robot) if field.name not in but):
            ours, theirs = getattr(self, name), getattr(other, name)
            alike = math.isclose(ours, theirs, rel_tol=1e-3) if name == "dt" else ours == theirs
            if not alike:
                differing.append(f"{name} is {ours!r:.200} and {theirs!r:.200}")
        if differing:
            raise TrajectoryError(
                f"{what} are not of one robot: {'; '.join(differing)}. Expected the same robot on "
                "both sides: check where each of the two comes from"
            )


class Episodes(NamedTuple):
    """Episodes one after the other, without padding, as tensors.

    Args:
        states: (sum of T_i + 1, dx).
        actions: (sum of T_i, du).
        lengths: (N,), the steps T_i of each episode; always on the CPU.
    """

    states: Tensor
    actions: Tensor
    lengths: Tensor

    def to(self, device: torch.device | str) -> Episodes:
        """The same episodes on ``device``."""
        return Episodes(self.states.to(device), self.actions.to(device), self.lengths)

    def window(self, episodes: Tensor, starts: Tensor, past_len: int, future_len: int) -> Window:
        """The windows of Trajectories.windows, without its checks."""
        first = (self.lengths.cumsum(0) - self.lengths)[episodes]  # action of each episode
        at = starts[:, None] + torch.arange(-past_len, future_len)  # t of u_t, which led to x_{t+1}
        states = self.states[(first + episodes)[:, None] + (at + 1).clamp_min(0)]
        actions = self.actions[first[:, None] + at.clamp_min(0)]
        actions = actions.where((at >= 0)[..., None].to(actions.device), 0.0)
        return Window(
            Segment(states[:, :past_len], actions[:, :past_len]),
            Segment(states[:, past_len:], actions[:, past_len:]),
        )


@dataclass(frozen=True, init=False, repr=False, eq=False)
class Trajectories:
    """Episodes of one robot: cast and checked once, and kept without padding.

    ``states`` (N, T + 1, dx) and ``actions`` (N, T, du) are there where all episodes have one
    length; ``episode(i)``, ``flat_states`` and ``flat_actions`` always are.

    Args:
        states: (N, T + 1, dx) or a list of (T_i + 1, dx), physical units; they become float32.
        actions: (N, T, du) or a list of (T_i, du), within [-1, 1].
        env: id of the environment, with its arguments where it has some; any name for a log.
        dt: seconds per step.
        names: one word per state dimension; x0, x1, ... by default.
        units: one unit per state dimension; '' by default.
        angles: state dimensions that are angles in radians, by index or by name; models see their
            cosine and sine.
        lengths: steps of each episode, where arrays are padded beyond them.
        terminated: whether the environment ended each episode, as opposed to a limit of time.
        unwrap: take the jumps out of angles that were wrapped.

    Raises:
        TrajectoryError: shapes that do not fit, values that are no finite numbers or that float32
            cannot tell apart, angles that jump by more than pi, actions beyond [-1, 1].
    """

    states: np.ndarray
    actions: np.ndarray
    env: str
    dt: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    angles: tuple[int, ...]
    lengths: tuple[int, ...]
    terminated: tuple[bool, ...]
    if TYPE_CHECKING:
        robot: Robot
        flat_states: np.ndarray  # (sum of T_i + 1, dx), one episode after the other
        flat_actions: np.ndarray  # (sum of T_i, du)

    def __init__(
        self,
        states: Arrays,
        actions: Arrays,
        env: str,
        dt: float,
        names: Sequence[str] | None = None,
        units: Sequence[str] | None = None,
        angles: Sequence[int | str] = (),
        lengths: Sequence[int] | None = None,
        terminated: Sequence[bool] | None = None,
        *,
        unwrap: bool = False,
    ) -> None:
        x, u = _episodes("states", states), _episodes("actions", actions)
        if len(x) != len(u):
            raise TrajectoryError(f"{len(x)} episodes of states, but {len(u)} of actions")
        if lengths is not None:
            ends = _one_each("lengths", lengths, len(u), np.integer)
            if any(not 1 <= n <= len(part) for n, part in zip(ends, u, strict=True)):
                raise TrajectoryError(
                    f"lengths is {lengths!r:.80}; expected at least 1, and no more than the "
                    f"{max(map(len, u))} steps of the arrays"
                )
            x = [part[: n + 1] for n, part in zip(ends, x, strict=True)]
            u = [part[:n] for n, part in zip(ends, u, strict=True)]
        for i, (a, b) in enumerate(zip(x, u, strict=True)):
            if len(a) != len(b) + 1 or not len(b):
                raise TrajectoryError(
                    f"states {a.shape} and actions {b.shape} of episode {i} do not fit: expected "
                    "(T + 1, dx) and (T, du), one state more than actions and at least one action"
                )
        dx, du = x[0].shape[1], u[0].shape[1]
        names = [f"x{d}" for d in range(dx)] if names is None else names
        units = [""] * dx if units is None else units
        robot = Robot(env, dt, names, units, angles, du)  # type: ignore[arg-type] # it casts them
        if robot.state_dim != dx:
            raise TrajectoryError(
                f"there are {dx} state dimensions, but {robot.state_dim} names "
                f"{robot.names!r:.200}; expected one per state dimension"
            )
        if unwrap:
            x = [_unwrapped(part, robot.angles) for part in x]
        ended = [False] * len(u) if terminated is None else terminated
        self._fill(
            robot,
            _float32("states", x, robot.names),
            _float32("actions", u, tuple(f"action {k}" for k in range(du))),
            tuple(map(len, u)),
            tuple(map(bool, _one_each("terminated", ended, len(u), np.bool_))),
        )
        self._require_bounds()

    @classmethod
    def from_rows(
        cls,
        states: np.ndarray,
        actions: np.ndarray,
        lengths: Sequence[int],
        robot: Robot,
        terminated: Sequence[bool] | None = None,
    ) -> Trajectories:
        """Episodes that lie one after the other.

        Args:
            states: (sum of T_i + 1, dx).
            actions: (sum of T_i, du).
            lengths: the steps T_i of each episode.
            robot: what the numbers mean.
            terminated: whether the environment ended each episode.
        """
        steps = np.asarray(_one_each("lengths", lengths, len(lengths), np.integer))
        ends = np.cumsum(steps)
        x = np.split(states, ends[:-1] + np.arange(1, len(ends)))
        u = np.split(actions, ends[:-1])
        about = (robot.env, robot.dt, robot.names, robot.units, robot.angles)
        return cls(x, u, *about, terminated=terminated)

    def _fill(
        self,
        robot: Robot,
        flat_states: np.ndarray,
        flat_actions: np.ndarray,
        lengths: tuple[int, ...],
        terminated: tuple[bool, ...],
    ) -> Trajectories:
        fill = self.__dict__
        fill.update(robot=robot, env=robot.env, dt=robot.dt, names=robot.names, units=robot.units)
        fill.update(angles=robot.angles, lengths=lengths, terminated=terminated)
        fill.update(flat_states=flat_states, flat_actions=flat_actions)
        if len(set(lengths)) == 1:
            fill["states"] = flat_states.reshape(len(lengths), -1, robot.state_dim)
            fill["actions"] = flat_actions.reshape(len(lengths), -1, robot.action_dim)
        return self

    def __getattr__(self, name: str) -> NoReturn:
        if name in ("states", "actions"):
            self.require_equal_lengths(f"data.{name}")
        raise AttributeError(f"Trajectories have no attribute {name!r}")

    def __repr__(self) -> str:
        least, most = min(self.lengths), max(self.lengths)
        steps = f"{least}" if least == most else f"{least} to {most}"
        episodes = f"{len(self)} episodes, {steps} steps"
        return f"Trajectories({self.env!r}, {episodes}, {len(self.names)} states)"

    def __len__(self) -> int:
        return len(self.lengths)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Trajectories):
            return NotImplemented
        about = ("robot", "lengths", "terminated")
        return all(getattr(self, name) == getattr(other, name) for name in about) and all(
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ("flat_states", "flat_actions")
        )

    __hash__ = None  # type: ignore[assignment] # arrays can be changed

    @property
    def horizon(self) -> int:
        """Steps of the longest episode, T."""
        return max(self.lengths)

    @property
    def steps(self) -> np.ndarray:
        """Steps of each episode (N,)."""
        return np.array(self.lengths, np.int64)

    @property
    def offsets(self) -> np.ndarray:
        """Row of ``flat_states`` at which each episode begins (N,)."""
        return np.cumsum(self.steps + 1) - self.steps - 1

    def episode(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """States (T_i + 1, dx) and actions (T_i, du) of episode ``i``."""
        if not -len(self) <= i < len(self):
            raise IndexError(f"there is no episode {i}; expected one of the {len(self)} from 0 on")
        i, row = i % len(self), int(self.offsets[i])
        steps = self.lengths[i]
        return self.flat_states[row : row + steps + 1], self.flat_actions[row - i : row - i + steps]

    def take(self, index: slice | Sequence[int] | np.ndarray) -> Trajectories:
        """Some of the episodes: a slice, their numbers, or one bool for each."""
        try:
            chosen = np.arange(len(self))[index].ravel()
        except IndexError as error:
            raise TrajectoryError(f"there are {len(self)} episodes: {error}") from error
        return self._parts([(int(i), 0, self.lengths[i]) for i in chosen])

    def _parts(self, parts: Sequence[tuple[int, int, int]]) -> Trajectories:
        """The parts of episodes that begin and end at (episode, first, last) as new episodes."""
        if not parts:
            raise TrajectoryError(f"no episode is left of {self}; expected at least one")
        x, u = self.flat_states, self.flat_actions
        begins = self.offsets.tolist()
        return object.__new__(Trajectories)._fill(
            self.robot,
            np.concatenate([x[begins[i] + a : begins[i] + b + 1] for i, a, b in parts]),
            np.concatenate([u[begins[i] - i + a : begins[i] - i + b] for i, a, b in parts]),
            tuple(b - a for _, a, b in parts),
            tuple(self.terminated[i] and b == self.lengths[i] for i, _, b in parts),
        )

    def split(self, share: float = 0.9, *, seed: int = 0) -> tuple[Trajectories, Trajectories]:
        """Training and held-out data: episodes in random order, divided.

        Args:
            share: of the episodes that are for training, above 0 and below 1; both sides get one.
            seed: of the order.

        Returns:
            Training data and held-out data.
        """
        share = require_number("share", share, 0, 1, above=True)
        if len(self) < 2 or share == 1:
            raise TrajectoryError(
                f"{len(self)} episode(s) cannot be split with a share of {share:g}; expected two "
                "or more episodes, and a share below 1. data.pieces(steps) cuts long episodes"
            )
        order = np.random.default_rng(seed).permutation(len(self))
        n = min(len(self) - 1, max(1, round(share * len(self))))
        return self.take(np.sort(order[:n])), self.take(np.sort(order[n:]))

    def cut(self, steps: int) -> Trajectories:
        """The first ``steps`` steps of every episode that has as many; the others are left out."""
        counts = self.window_counts(require_count("steps", steps), "cut(steps)")
        return self._parts([(i, 0, steps) for i in np.flatnonzero(counts).tolist()])

    def pieces(self, steps: int) -> Trajectories:
        """Every episode in consecutive pieces of ``steps`` steps; the last one may be shorter."""
        require_count("steps", steps)
        return self._parts(
            [
                (i, a, min(a + steps, n))
                for i, n in enumerate(self.lengths)
                for a in range(0, n, steps)
            ]
        )

    def joined(self, other: Trajectories) -> Trajectories:
        """The episodes of both; TrajectoryError where they are not of one robot."""
        self.robot.require_same(other.robot, "the episodes to be joined")
        return object.__new__(Trajectories)._fill(
            self.robot,
            np.concatenate([self.flat_states, other.flat_states]),
            np.concatenate([self.flat_actions, other.flat_actions]),
            self.lengths + other.lengths,
            self.terminated + other.terminated,
        )

    def padded(self, horizon: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """States (N, T + 1, dx) and actions (N, T, du) of one length: the last state repeats.

        Args:
            horizon: steps T; those of the longest episode by default.

        Returns:
            States, and actions, which are zero after the end of an episode.
        """
        horizon = self.horizon if horizon is None else horizon
        at, ends = np.arange(horizon + 1), self.steps[:, None]
        states = self.flat_states[self.offsets[:, None] + np.minimum(at, ends)]
        first = (self.offsets - np.arange(len(self)))[:, None]
        actions = self.flat_actions[first + np.minimum(at[:-1], ends - 1)]
        return states, np.where((at[:-1] < ends)[..., None], actions, np.float32(0))

    def segment(self, past_len: int = 0) -> Segment:
        """All episodes, of one length, as one segment (N, L + T, .), at rest for ``past_len`` steps.

        Column past_len + t holds u_t and x_{t+1}.
        """
        self.require_equal_lengths("data.segment(...)")
        every = torch.arange(len(self))
        window = self.windows(every, torch.zeros_like(every), past_len, self.horizon)
        return window.past.then(window.future)

    def increments(self) -> np.ndarray:
        """x_{t+1} - x_t of all steps (sum of T_i, dx), in float64."""
        steps = np.diff(self.flat_states.astype(np.float64), axis=0)
        return np.delete(steps, self.offsets[1:] - 1, axis=0)

    def tensors(self) -> Episodes:
        """The episodes as tensors, which share the memory of the arrays."""
        arrays = (self.flat_states, self.flat_actions, self.steps)
        return Episodes(*(torch.from_numpy(array) for array in arrays))

    def windows(self, episodes: Tensor, starts: Tensor, past_len: int, future_len: int) -> Window:
        """One window per pair of an episode and a start.

        Args:
            episodes: (B,) numbers of episodes.
            starts: (B,) steps t; the past ends with x_t, and is at rest before the episode.
            past_len: L, steps of the past.
            future_len: K, steps of the future, u_t to u_{t+K-1}; they end within the episode.

        Returns:
            The past (B, L, .) and the future (B, K, .).
        """
        lengths = torch.from_numpy(self.steps)[episodes]
        if not bool(((starts >= 0) & (starts + future_len <= lengths)).all()):
            raise TrajectoryError(
                f"windows of {future_len} steps from steps {starts.tolist()!s:.80} leave their "
                f"episodes of {lengths.tolist()!s:.80} steps; expected them to end within"
            )
        return self.tensors().window(episodes, starts, past_len, future_len)

    def window_counts(self, future_len: int, what: str) -> np.ndarray:
        """Windows of ``future_len`` steps in each episode (N,); a warning counts those left out."""
        return _window_counts(
            torch.from_numpy(self.steps), future_len, f"{what} of {self.env}"
        ).numpy()

    def require_equal_lengths(self, purpose: str) -> None:
        """TrajectoryError where episodes differ in length, for a ``purpose`` that needs it."""
        if len(set(self.lengths)) > 1:
            raise TrajectoryError(
                f"{purpose} needs episodes of equal length; those of {self.env} have "
                f"{min(self.lengths)} to {self.horizon} steps. data.cut(steps) takes the beginning "
                "of those that are long enough, data.episode(i) gives one, data.padded() pads them"
            )

    def _require_bounds(self) -> None:
        """Actions within [-1, 1], and angles that do not jump."""
        beyond = np.abs(self.flat_actions) > 1 + 1e-6
        if beyond.any():
            most = np.abs(self.flat_actions).max()
            raise TrajectoryError(
                f"actions of {self.env} go up to {most:g}; expected them within [-1, 1]. "
                "Scale them by their bounds: 2 * (u - low) / (high - low) - 1"
            )
        jumps = np.abs(self.increments()[:, list(self.angles)]) > math.pi
        if jumps.any():
            row, column = np.argwhere(jumps)[0]
            ends = np.cumsum(self.steps)
            episode = int(np.searchsorted(ends, row, side="right"))
            step = row - ends[episode] + self.lengths[episode]
            raise TrajectoryError(
                f"the angle '{self.names[self.angles[column]]}' jumps by more than pi at "
                f"{jumps.sum()} step(s), the first in episode {episode} after step {step}; "
                "expected an angle that goes on. unwrap=True takes the jumps out of a wrapped one"
            )


def initial_past(states: Tensor, past_len: int, action_dim: int) -> Segment:
    """The past of an episode that starts in ``states`` (B, dx): x_0 repeated, zero actions."""
    return Segment(
        states[:, None].expand(-1, past_len, -1),
        states.new_zeros(len(states), past_len, action_dim),
    )


def states_before(window: Window) -> Tensor:
    """x_t .. x_{t+K-1}, the states in which the future's actions are taken: (B, K, dx)."""
    return torch.cat([window.past.states[:, -1:], window.future.states[:, :-1]], dim=1)


def real_steps(lengths: Sequence[int], horizon: int) -> Tensor:
    """(N, T) bool: the steps of episodes of these lengths, as opposed to their padding."""
    return torch.arange(horizon) < torch.tensor(lengths)[:, None]


def window_at(index: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Episode and start of the windows ``index`` (B,), of which episodes have ``counts`` (N,)."""
    ends = counts.cumsum(0)
    episodes = torch.searchsorted(ends, index, right=True)
    return episodes, index - (ends - counts)[episodes]


def batches(
    data: Episodes,
    *,
    past_len: int,
    future_len: int,
    batch_size: int,
    generator: torch.Generator,
) -> Iterator[Window]:
    """Endless random windows, uniform over all that lie within an episode.

    Args:
        data: the episodes, ``Trajectories.tensors()``, on the device where windows are wanted.
        past_len: L, steps of the past.
        future_len: K, steps of the future.
        batch_size: B, windows in a batch.
        generator: of random numbers, on the CPU.

    Returns:
        An iterator over windows (B, L, .) and (B, K, .).

    Raises:
        TrajectoryError: no episode has ``future_len`` steps. A warning counts those that have not.
    """
    counts = _window_counts(data.lengths, future_len, "training")
    even = bool((counts == counts[0]).all())
    while True:
        if even:
            episodes = torch.randint(len(counts), (batch_size,), generator=generator)
            starts = torch.randint(int(counts[0]), (batch_size,), generator=generator)
        else:
            index = torch.randint(int(counts.sum()), (batch_size,), generator=generator)
            episodes, starts = window_at(index, counts)
        yield data.window(episodes, starts, past_len, future_len)


def _window_counts(lengths: Tensor, future_len: int, what: str) -> Tensor:
    counts = (lengths - future_len + 1).clamp_min(0)
    short = int((counts == 0).sum())
    if short == len(counts):
        raise TrajectoryError(
            f"{what}: {short} episodes of at most {int(lengths.max())} steps hold no window of "
            f"{future_len} future steps; expected episodes of at least {future_len} steps"
        )
    if short:
        warnings.warn(
            f"{what}: {short} of {len(counts)} episodes are shorter than {future_len} steps and "
            "are not used",
            stacklevel=3,
        )
    return counts


def _words(field: str, words: object) -> tuple[str, ...]:
    listed = tuple(words) if isinstance(words, Sequence | np.ndarray) else ()
    if isinstance(words, str) or not all(isinstance(word, str) for word in listed) or not listed:
        raise TrajectoryError(f"{field} is {words!r:.80}; expected a text per state dimension")
    return tuple(map(str, listed))


def _columns(angles: object, names: tuple[str, ...]) -> tuple[int, ...]:
    """Angles, each an index or a name, as sorted indices."""
    listed = [] if isinstance(angles, str) else list(np.asarray(angles, object).ravel())
    known = {name: d for d, name in enumerate(names)} | {d: d for d in range(len(names))}
    found = [known.get(a) for a in listed if not isinstance(a, bool | float)]
    if isinstance(angles, str) or None in found or len(set(found)) < len(listed):
        raise TrajectoryError(
            f"angles are {angles!r:.80}; expected a tuple of some of 0 to {len(names) - 1}, or of "
            f"{', '.join(names):.200}"
        )
    return tuple(sorted(column for column in found if column is not None))


def _episodes(name: str, values: Arrays) -> list[np.ndarray]:
    """Each episode as an array (T, d) of numbers, d the same in all."""
    if isinstance(values, Tensor):
        values = values.detach().cpu().numpy()
    episodes = [_numbers(f"{name} of episode {i}", part) for i, part in enumerate(values)]
    if not episodes:
        raise TrajectoryError(f"there are no {name}; expected at least one episode")
    for i, part in enumerate(episodes):
        if part.ndim != 2 or part.shape[1] != episodes[0].shape[-1] or not part.shape[1]:
            raise TrajectoryError(
                f"{name} of episode {i} have shape {part.shape}, those of episode 0 "
                f"{episodes[0].shape}; expected (N, T, d), or a list of (T, d) with the same d. "
                f"A single episode goes in a list: [{name}]"
            )
    return episodes


def _numbers(what: str, values: object) -> np.ndarray:
    if isinstance(values, Tensor):
        values = values.detach().cpu().numpy()
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise TrajectoryError(f"{what} are uneven: {error}") from error
    if array.dtype.kind not in "fiub":
        raise TrajectoryError(f"{what} are of type {array.dtype}; expected real numbers")
    if isinstance(values, np.ma.MaskedArray):
        return np.ma.filled(values.astype(np.float64), np.nan)
    return array


def _one_each(field: str, values: Sequence[object], n: int, kind: type) -> list:
    array = np.asarray(values)
    if array.shape != (n,) or not np.issubdtype(array.dtype, kind):
        raise TrajectoryError(
            f"{field} is {values!r:.80}; expected {n} values of type {kind.__name__}, one each"
        )
    return array.tolist()


def _unwrapped(states: np.ndarray, angles: tuple[int, ...]) -> np.ndarray:
    states = states.astype(np.float64)
    states[:, list(angles)] = np.unwrap(states[:, list(angles)], axis=0)
    return states


def _float32(name: str, episodes: list[np.ndarray], columns: tuple[str, ...]) -> np.ndarray:
    """All rows in float32, finite, and apart from each other where they are in ``episodes``."""
    exact = np.concatenate(episodes)
    with np.errstate(over="ignore"):
        flat = np.array(exact, np.float32, order="C")
    lengths = np.array([len(part) for part in episodes])
    begins = np.cumsum(lengths) - lengths
    bad = np.argwhere(~np.isfinite(flat))
    if len(bad):
        row, column = bad[0]
        episode = int(np.searchsorted(begins, row, side="right")) - 1
        raise TrajectoryError(
            f"{len(bad)} value(s) in {name} are not finite, the first in episode {episode}, "
            f"step {row - begins[episode]}, field '{columns[column]}': {exact[row, column]}. "
            "Expected finite numbers: mend or leave out what holds them"
        )
    if exact.dtype.itemsize > 4:
        exact = exact.astype(np.float64)
        means = np.add.reduceat(exact, begins) / lengths[:, None]
        spread = np.sqrt(np.square(exact - np.repeat(means, lengths, axis=0)).mean(0))
        size = np.abs(exact).max(0)
        lost = (np.square(exact - flat).mean(0) > np.square(1e-3 * spread)) & (
            spread > 1e-12 * size
        )
        for column in np.flatnonzero(lost)[:1]:
            kept = np.spacing(np.float32(size[column]))
            raise TrajectoryError(
                f"'{columns[column]}' goes up to {size[column]:g}, and within an episode it varies "
                f"by {spread[column]:g}: float32 keeps steps of {kept:g} there. "
                f"Take an offset off it: {name} - {name}.mean()"
            )
    return flat
