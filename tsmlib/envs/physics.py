"""Physical quantities in which variants of the arm differ: standard values, allowed ranges, and
spelling in an id.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import TypedDict, cast


class Changes(TypedDict, total=False):
    """Values of a variant, as keyword arguments of ``gymnasium.make``; see `Physics`."""

    mass: float
    damping: float
    link_lengths: tuple[float, float]
    object_radius: float
    torque_gain: float


@dataclass(frozen=True)
class Physics:
    """What can differ between two arms of the same task; the defaults are the standard arm's.

    mass: of the object that is pushed, kg. Its drag stays 20 N s/m, so a heavier object slides
    further.
    damping: viscous damping of both joints, N m s/rad.
    link_lengths: from shoulder to elbow, and from there to the centre of the fingertip, m.
    object_radius: of the object or obstacle, m.
    torque_gain: factor on the 200 N m that an action of 1 stands for. ValueError where a value is
    out of its range, within which bodies do not pass through each other.
    """

    mass: float = 1.0
    damping: float = 1.0
    link_lengths: tuple[float, float] = (0.1, 0.11)
    object_radius: float = 0.03
    torque_gain: float = 1.0

    def __post_init__(self) -> None:
        for name, (low, high, unit) in RANGES.items():
            (value,) = _numbers(name, (getattr(self, name),), "a number")
            if not low <= value <= high:
                raise ValueError(
                    f"{name} is {value:g}{unit}; expected {low:g} to {high:g}{unit} "
                    f"({_usual(name)})"
                )
            object.__setattr__(self, name, value)
        lengths = _numbers("link_lengths", self.link_lengths, "two numbers")
        if len(lengths) != 2 or min(lengths) < SHORTEST or sum(lengths) > LONGEST + 1e-9:
            raise ValueError(
                f"link_lengths are {lengths} m; expected two lengths of at least {SHORTEST:g} m, "
                "together at most "
                f"{LONGEST:g} m, where the walls are ({_usual('link_lengths')})"
            )
        object.__setattr__(self, "link_lengths", lengths)

    @property
    def changed(self) -> Changes:
        """The values that are not the standard arm's."""
        found = {
            name: getattr(self, name)
            for name, usual in STANDARD.items()
            if getattr(self, name) != usual
        }
        return cast(Changes, found)

    @property
    def word(self) -> str:
        """The changed values as they stand in an id: ``"-mass2-links0.12x0.11"``; '' for the
        standard arm.
        """
        return "".join(f"-{_WORDS[name]}{_spelled(value)}" for name, value in self.changed.items())


# m: a link; both together, so that the fingertip stays within the walls
SHORTEST, LONGEST = 0.06, 0.24
RANGES = {
    "mass": (0.25, 4.0, " kg"),
    "damping": (0.5, 4.0, " N m s/rad"),
    "object_radius": (0.02, 0.05, " m"),
    "torque_gain": (0.25, 1.25, ""),
}
STANDARD: dict[str, object] = {field.name: field.default for field in fields(Physics)}
_WORDS = {
    "mass": "mass",
    "damping": "damping",
    "link_lengths": "links",
    "object_radius": "radius",
    "torque_gain": "gain",
}
# Of ``Physics.word``, a group for each.
PATTERN = "".join(rf"(?:-{word}([0-9][0-9.x]*))?" for word in _WORDS.values())


def parse(groups: Iterable[str | None]) -> Changes:
    """The values in the groups of ``PATTERN``. ValueError where one is no number."""
    given = {name: text for name, text in zip(_WORDS, groups, strict=True) if text}
    values = {name: tuple(map(float, text.split("x"))) for name, text in given.items()}
    return cast(
        Changes,
        {name: value if name == "link_lengths" else value[0] for name, value in values.items()},
    )


def _spelled(value: object) -> str:
    return (
        "x".join(map(_spelled, value))
        if isinstance(value, tuple)
        else repr(value).removesuffix(".0")
    )


def _numbers(name: str, given: object, expected: str) -> tuple[float, ...]:
    """``given`` as floats; ValueError where it is not finite numbers."""
    try:
        found = tuple(float(part) for part in given if not isinstance(part, bool | str))  # type: ignore[attr-defined]
        if len(found) == len(given) and all(map(math.isfinite, found)):  # type: ignore[arg-type]
            return found
    except TypeError:
        pass
    raise ValueError(f"{name} is {given!r:.80}; expected {expected} ({_usual(name)})")


def _usual(name: str) -> str:
    return f"the standard arm has {STANDARD[name]}"
