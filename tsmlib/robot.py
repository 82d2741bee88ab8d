"""What the numbers of data mean: names, units, angles, the time step, the environment."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Collection, Iterable, Mapping, Set
from dataclasses import dataclass, fields

import numpy as np

from tsmlib.checks import require_count, require_number, require_type

RADIANS = ("", "rad", "rads", "radian", "radians")
DEGREES = re.compile(r"(?<![a-z])deg(ree)?s?(?![a-z])|°")


class TrajectoryError(ValueError):
    """Data that cannot be trajectories; the message names the array, episode, step and field."""


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
        angles = columns_of(self.angles, names)
        for angle in angles:
            if units[angle].lower() not in RADIANS or DEGREES.search(names[angle].lower()):
                raise TrajectoryError(
                    f"the angle '{names[angle]}' has the unit {units[angle]!r}; expected radians: "
                    "convert it by np.radians(...), and name it without degrees, its unit 'rad'"
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
        require_type("other", other, Robot, "a Robot, such as data.robot or model.robot")
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


def _words(field: str, words: object) -> tuple[str, ...]:
    ordered = isinstance(words, Iterable) and not isinstance(words, str | Set | Mapping)
    listed: tuple[object, ...] = tuple(words) if ordered else ()  # type: ignore[arg-type]
    if not listed or not all(isinstance(word, str) for word in listed):
        raise TrajectoryError(f"{field} is {words!r:.80}; expected a text per state dimension")
    return tuple(map(str, listed))


def columns_of(angles: object, names: tuple[str, ...]) -> tuple[int, ...]:
    """Angles, each an index or a name, as sorted indices."""
    listed = [] if isinstance(angles, str | Set) else list(np.asarray(angles, object).ravel())
    known: dict[object, int] = {name: d for d, name in enumerate(names)}
    known |= {d: d for d in range(len(names))}
    found = [
        known.get(a)
        for a in listed
        if type(a) is not bool and isinstance(a, int | np.integer | str)
    ]
    if isinstance(angles, str | Set) or None in found or len(set(found)) < len(listed):
        raise TrajectoryError(
            f"angles are {angles!r:.80}; expected a tuple of some of 0 to {len(names) - 1}, or of "
            f"{', '.join(names):.200}"
        )
    return tuple(sorted(column for column in found if column is not None))


def warn_of_other_env(one: Robot | None, other: Robot, what: str) -> None:
    """Say aloud that two robots whose states have the same names are of two environments."""
    if one is not None and one.env != other.env:
        warnings.warn(
            f"{what} are of two environments, {one.env} and {other.env}, whose states have the "
            "same names; predictions hold as far as the two are alike",
            stacklevel=4,
        )
