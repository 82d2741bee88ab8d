"""Small checks of arguments: an error says what was found, what was expected, what to type."""

from __future__ import annotations

import math
from collections.abc import Iterable
from numbers import Real
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

T = TypeVar("T")
LARGEST = 10_000  # size of a layer, a segment or an ensemble
MOST = 1_000_000  # candidates, iterations, steps of a plan: beyond is a slip, and never ends


def require_count(name: str, value: object, *, least: int = 1, most: int | None = None) -> int:
    """``value`` as an int from ``least`` to ``most``; else an error that names it."""
    between = f"of at least {least}" if most is None else f"from {least} to {most}"
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name} is {value!r:.80}; expected a whole number {between}")
    if value < least or (most is not None and value > most):
        raise ValueError(f"{name} is {value!s:.80}; expected a whole number {between}")
    return int(value)


def require_counts(**values: object) -> None:
    """``require_count`` of several values by their names."""
    for name, value in values.items():
        require_count(name, value, most=LARGEST)


def require_seed(name: str, value: object) -> int:
    """``value`` as a seed: torch's generators on a CPU keep its low 32 bits alone."""
    return require_count(name, value, least=0, most=2**32 - 1)


def require_number(
    name: str, value: object, low: float = -math.inf, high: float = math.inf, *, above: bool = False
) -> float:
    """``value`` as a finite float in [low, high], or (low, high] with ``above``; else an error."""
    between = f"a number {'above' if above else 'of at least'} {low:g}"
    between += "" if high == math.inf else f" and at most {high:g}"
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} is {value!r:.80}; expected {between}")
    number = float(value)
    if not math.isfinite(number) or not low <= number <= high or (above and number == low):
        raise ValueError(f"{name} is {value}; expected {between}")
    return number


def require_flag(name: str, value: object) -> bool:
    """``value`` where it is True or False; TypeError that names it otherwise."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} is {value!r:.80}; expected True or False")
    return bool(value)


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


def require_choice(name: str, value: T, choices: Iterable[T]) -> T:
    """``value`` where it is one of ``choices``; ValueError that lists them otherwise."""
    known = tuple(choices)
    if not isinstance(value, type(known[0])) or value not in known:
        raise ValueError(f"{name} is {value!r:.80}; expected one of {', '.join(map(repr, known))}")
    return value


def require_columns(name: str, value: object, n: int, of: int) -> tuple[int, ...]:
    """``value`` as ``n`` different columns of a state of ``of`` dimensions; else an error."""
    expected = f"{n} different columns of the {of} state dimensions, 0 to {of - 1}"
    if not isinstance(value, list | tuple) or any(type(column) is not int for column in value):
        raise TypeError(f"{name} is {value!r:.80}; expected {expected}")
    if len(value) != n or len({*value}) != n or not {*value} <= {*range(of)}:
        raise ValueError(f"{name} is {value!r:.80}; expected {expected}")
    return tuple(value)


def as_tensor(
    name: str,
    value: object,
    shape: tuple[int | str, ...],
    *,
    dtype: torch.dtype = torch.float32,
    device: torch.device | None = None,
) -> Tensor:
    """A tensor, array or nested list as a finite floating tensor of ``shape``.

    Args:
        name: of the argument, for the error.
        value: what was given.
        shape: sizes; a letter stands for any size.
        dtype: of the result.
        device: of the result; None: where it is.

    Returns:
        The tensor; the one that was given where nothing had to change.

    Raises:
        TypeError: it holds no numbers.
        ValueError: another shape, or a value that is not finite.
    """
    try:
        tensor = value if isinstance(value, Tensor) else _from_numpy(np.asarray(value))
        if tensor.is_complex() or tensor.dtype == torch.bool:
            raise TypeError(str(tensor.dtype))
        tensor = tensor.to(device=device, dtype=dtype)
    except (TypeError, ValueError, RuntimeError) as error:
        found = described(value)
        raise TypeError(f"{name} is {found}; expected numbers {_words(shape)}") from error
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


def _from_numpy(array: np.ndarray) -> Tensor:
    """A copy in torch's own byte order, with strides that torch has."""
    if array.dtype.kind not in "fiu":
        raise TypeError(str(array.dtype))
    return torch.from_numpy(array.astype(array.dtype.newbyteorder("="), order="C"))


def _words(shape: tuple[int | str, ...]) -> str:
    return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
