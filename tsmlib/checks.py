"""Small checks of arguments, whose errors say what was found, what was expected, what to type."""

from __future__ import annotations

import math
from collections.abc import Iterable
from numbers import Real
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

T = TypeVar("T")


def require_count(name: str, value: object, *, least: int = 1) -> int:
    """``value`` as an int of at least ``least``; else a TypeError or ValueError that names it."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name} is {value!r:.80}; expected a whole number of at least {least}")
    if value < least:
        raise ValueError(f"{name} is {value}; expected a whole number of at least {least}")
    return int(value)


def require_number(
    name: str, value: object, low: float = -math.inf, high: float = math.inf, *, above: bool = False
) -> float:
    """``value`` as a finite float within [low, high], with ``above`` (low, high]; else an error."""
    between = f"a number {'above' if above else 'of at least'} {low:g} and at most {high:g}"
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} is {value!r:.80}; expected {between}")
    number = float(value)
    if not math.isfinite(number) or not low <= number <= high or (above and number == low):
        raise ValueError(f"{name} is {value}; expected {between}")
    return number


def require_choice(name: str, value: T, choices: Iterable[T]) -> T:
    """``value`` where it is one of ``choices``; ValueError that lists them otherwise."""
    if value not in (known := tuple(choices)):
        raise ValueError(f"{name} is {value!r:.80}; expected one of {', '.join(map(repr, known))}")
    return value


def as_tensor(name: str, value: object, shape: tuple[int | str, ...]) -> Tensor:
    """A tensor, array or nested list as a finite float32 tensor of ``shape``.

    Args:
        name: of the argument, for the error.
        value: what was given.
        shape: sizes; a letter stands for any size.

    Returns:
        The tensor; the one that was given where nothing had to change.

    Raises:
        TypeError: it holds no numbers.
        ValueError: another shape, or a value that is not finite.
    """
    try:
        tensor = value if isinstance(value, Tensor) else torch.as_tensor(np.asarray(value))
        tensor = tensor.to(torch.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        found = type(value).__name__
        raise TypeError(f"{name} is a {found}; expected numbers {_words(shape)}") from error
    sizes = zip(shape, tensor.shape, strict=False)
    fits = len(shape) == tensor.ndim and all(isinstance(s, str) or s == n for s, n in sizes)
    if not fits:
        raise ValueError(f"{name} has shape {tuple(tensor.shape)}; expected {_words(shape)}")
    if not torch.isfinite(tensor.detach()).all():
        where = torch.nonzero(~torch.isfinite(tensor.detach()))[0].tolist()
        raise ValueError(
            f"{name} is {tensor[tuple(where)].item()} at index {where}; expected finite numbers"
        )
    return tensor


def _words(shape: tuple[int | str, ...]) -> str:
    return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"


def require_type(name: str, value: object, kind: type | tuple[type, ...], expected: str) -> None:
    """TypeError unless ``value`` is of a kind; ``expected`` says in words what to give."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} is {described(value)}; expected {expected}")


def require_callable(name: str, value: object, expected: str) -> None:
    """TypeError unless ``value`` can be called; ``expected`` says in words what to give."""
    if not callable(value) or isinstance(value, type):
        raise TypeError(f"{name} is {described(value)}; expected {expected}")


def described(value: object) -> str:
    """A value as errors name it: its type, and where it has one its shape."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    shape = getattr(value, "shape", None)
    kind = "tensor" if isinstance(value, Tensor) else type(value).__name__
    if isinstance(shape, tuple):
        return f"a {kind} {tuple(shape)}"
    shown = f" {value!r:.60}" if isinstance(value, str | int | float | list | tuple) else ""
    return f"a {kind}{shown}"
