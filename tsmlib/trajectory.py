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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from tsmlib import casting
from tsmlib.casting import Arrays
from tsmlib.checks import require_count, require_number, require_type
from tsmlib.logs import FromLogs
from tsmlib.robot import Robot as Robot
from tsmlib.robot import TrajectoryError as TrajectoryError
from tsmlib.segments import Episodes as Episodes
from tsmlib.segments import Segment as Segment
from tsmlib.segments import Window as Window
from tsmlib.segments import batches as batches
from tsmlib.segments import initial_past as initial_past
from tsmlib.segments import real_steps as real_steps
from tsmlib.segments import states_before as states_before
from tsmlib.segments import window_at as window_at
from tsmlib.windows import Windows


@dataclass(frozen=True, init=False, repr=False, eq=False)
class Trajectories(FromLogs, Windows):
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
        jumps: whether angles may jump by more than pi, as those of noisy sensors do, and of an arm
            that spins; ``collect`` says so of our own arms, whose angles are never wrapped.
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
    jumps: bool
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
        jumps: bool = False,
        unwrap: bool = False,
    ) -> None:
        x, u = casting.pairs(states, actions, lengths)
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
            x = [casting.unwrapped(part, robot.angles) for part in x]
        ended = [False] * len(u) if terminated is None else terminated
        self._fill(
            robot,
            casting.float32("states", x, robot.names),
            casting.float32("actions", u, tuple(f"action {k}" for k in range(du))),
            tuple(map(len, u)),
            tuple(map(bool, casting.one_each("terminated", ended, len(u), np.bool_))),
            bool(jumps),
        )
        casting.require_bounds(self.flat_actions, env)
        if not jumps:
            casting.require_no_jumps(self.increments(), self.steps, robot)
            casting.doubt_degrees(self.flat_states, robot)

    @classmethod
    def ragged(cls, states: Arrays, actions: Arrays, **robot: Any) -> Trajectories:
        """Make episodes of unequal length, by the name that public scripts use for the constructor.

        Args:
            states: a list of (T_i + 1, dx), physical units.
            actions: a list of (T_i, du), within [-1, 1].
            robot: further arguments of the class by name, such as env and dt.

        Returns:
            The episodes.

        Raises:
            TrajectoryError: as of the class.
        """
        return cls(states, actions, **robot)

    @classmethod
    def from_rows(
        cls,
        states: np.ndarray,
        actions: np.ndarray,
        lengths: Sequence[int],
        robot: Robot,
        terminated: Sequence[bool] | None = None,
        *,
        jumps: bool = False,
    ) -> Trajectories:
        """Make episodes of rows that lie one after the other.

        Args:
            states: (sum of T_i + 1, dx), physical units.
            actions: (sum of T_i, du), within [-1, 1].
            lengths: the steps T_i of each episode.
            robot: what the numbers mean.
            terminated: whether the environment ended each episode.
            jumps: whether angles may jump by more than pi.

        Returns:
            The episodes.

        Raises:
            TrajectoryError: the rows are not as many as the lengths say, or as of the class.
        """
        steps = np.asarray(casting.one_each("lengths", lengths, len(lengths), np.integer))
        ends = np.cumsum(steps)
        if steps.min(initial=1) < 1 or [len(actions), len(states)] != [
            ends[-1],
            ends[-1] + len(ends),
        ]:
            raise TrajectoryError(
                f"{len(ends)} episodes of {ends[-1]} steps in all, but {len(states)} rows of "
                f"states and {len(actions)} of actions; expected one state more each"
            )
        x = np.split(states, ends[:-1] + np.arange(1, len(ends)))
        u = np.split(actions, ends[:-1])
        about = (robot.env, robot.dt, robot.names, robot.units, robot.angles)
        return cls(x, u, *about, terminated=terminated, jumps=jumps)

    def _fill(
        self,
        robot: Robot,
        flat_states: np.ndarray,
        flat_actions: np.ndarray,
        lengths: tuple[int, ...],
        terminated: tuple[bool, ...],
        jumps: bool,
    ) -> Trajectories:
        fill = self.__dict__
        fill.update(robot=robot, env=robot.env, dt=robot.dt, names=robot.names, units=robot.units)
        fill.update(angles=robot.angles, lengths=lengths, terminated=terminated)
        fill["jumps"] = jumps
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

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Trajectories):
            return NotImplemented
        about = ("robot", "lengths", "terminated")
        return all(getattr(self, name) == getattr(other, name) for name in about) and all(
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ("flat_states", "flat_actions")
        )

    __hash__ = None  # type: ignore[assignment] # arrays can be changed

    def take(self, index: slice | Sequence[int] | np.ndarray) -> Trajectories:
        """Take some of the episodes.

        Args:
            index: a slice, their numbers (n,), or one bool for each.

        Returns:
            The episodes in that order.

        Raises:
            TrajectoryError: there is no such episode, or none is left.
        """
        try:
            chosen = np.atleast_1d(np.arange(len(self))[index])
        except IndexError as error:
            raise TrajectoryError(f"there are {len(self)} episodes: {error}") from error
        if chosen.ndim > 1:
            raise TrajectoryError(f"episodes are {index!r:.80}; expected a slice, or numbers (n,)")
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
            self.jumps,
        )

    def split(self, share: float = 0.9, *, seed: int = 0) -> tuple[Trajectories, Trajectories]:
        """Divide episodes in random order into training and held-out data.

        Args:
            share: of the episodes that are for training, above 0 and below 1; both sides get one.
            seed: of the order.

        Returns:
            Training data and held-out data.

        Raises:
            TrajectoryError: there are fewer than two episodes, or the share is 1.
        """
        share = require_number("share", share, 0, 1, above=True)
        if len(self) < 2 or share == 1:
            raise TrajectoryError(
                f"{len(self)} episode(s) cannot be split with a share of {share:g}; expected two "
                "or more episodes, and a share below 1. data.pieces(steps) cuts long episodes"
            )
        order = np.random.default_rng(require_count("seed", seed, least=0)).permutation(len(self))
        n = min(len(self) - 1, max(1, round(share * len(self))))
        return self.take(np.sort(order[:n])), self.take(np.sort(order[n:]))

    def cut(self, steps: int) -> Trajectories:
        """Take the first steps of every episode that has as many; the others are left out.

        Args:
            steps: of each new episode.

        Returns:
            Episodes of equal length.

        Raises:
            TrajectoryError: no episode has as many; a warning counts those left out.
        """
        counts = self.window_counts(require_count("steps", steps), "cut(steps)")
        return self._parts([(i, 0, steps) for i in np.flatnonzero(counts).tolist()])

    def pieces(self, steps: int) -> Trajectories:
        """Cut every episode into consecutive pieces.

        Args:
            steps: of each piece; the last one of an episode may be shorter.

        Returns:
            The pieces as episodes.
        """
        require_count("steps", steps)
        return self._parts(
            [
                (i, a, min(a + steps, n))
                for i, n in enumerate(self.lengths)
                for a in range(0, n, steps)
            ]
        )

    def joined(self, other: Trajectories) -> Trajectories:
        """Join the episodes of two data sets of one robot.

        Args:
            other: the episodes that come last.

        Returns:
            The episodes of both.

        Raises:
            TrajectoryError: they are not of one robot.
        """
        require_type("other", other, Trajectories, "Trajectories")
        self.robot.require_same(other.robot, "the episodes to be joined")
        return object.__new__(Trajectories)._fill(
            self.robot,
            np.concatenate([self.flat_states, other.flat_states]),
            np.concatenate([self.flat_actions, other.flat_actions]),
            self.lengths + other.lengths,
            self.terminated + other.terminated,
            self.jumps or other.jumps,
        )

    def padded(self, horizon: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """States (N, T + 1, dx) and actions (N, T, du) of one length: the last state repeats.

        Args:
            horizon: steps T, no fewer than the longest episode has, which is the default.

        Returns:
            States, and actions, which are zero after the end of an episode.
        """
        if horizon is None:
            horizon = self.horizon
        require_count("horizon", horizon, least=self.horizon)
        at, ends = np.arange(horizon + 1), self.steps[:, None]
        states = self.flat_states[self.offsets[:, None] + np.minimum(at, ends)]
        first = (self.offsets - np.arange(len(self)))[:, None]
        actions = self.flat_actions[first + np.minimum(at[:-1], ends - 1)]
        return states, np.where((at[:-1] < ends)[..., None], actions, np.float32(0))

    def increments(self) -> np.ndarray:
        """Subtract from each state the one before it, x_{t+1} - x_t.

        Returns:
            Increments (sum of T_i, dx), physical units, in float64.
        """
        steps = np.diff(self.flat_states.astype(np.float64), axis=0)
        return np.delete(steps, self.offsets[1:] - 1, axis=0)
