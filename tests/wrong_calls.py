"""The frame of the fuzz of wrong calls: a correct call, and each argument replaced by nonsense.

A wrong value is refused by an error of this package that names the argument, or it is one that the
table of the call allows, since it has a meaning there. Anything else is a finding: an error of
torch, numpy or Python, an error that names another thing, or a result in silence.
"""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

import tsmlib

WRONG: dict[str, Any] = {
    "None": None,
    "NaN": float("nan"),
    "negative": -1,
    "zero": 0,
    "a fraction": 0.5,
    "infinite": float("inf"),
    "huge": 10**30,
    "text": "nonsense",
    "a list": [1, "a"],
    "an object": object(),
    "a class": int,
    "a shape": np.zeros((1, 2, 3, 4, 5), np.float32),
    "NaN in it": torch.full((2, 2), float("nan")),
    "complex": np.ones((2, 2), complex),
}
# What a kind of argument allows of these.
COUNT: frozenset[str] = frozenset()
COUNT_OR_ZERO = frozenset({"zero"})
POSITIVE = frozenset({"a fraction", "huge"})
NOT_NEGATIVE = POSITIVE | {"zero"}
OPTIONAL = frozenset({"None"})
PACKAGE = Path(tsmlib.__file__).parent


@dataclass(frozen=True)
class Call:
    """A correct call of a public name.

    Args:
        name: of what is called.
        run: the function or class.
        arguments: by name, all correct; what is ``Made`` is made anew for every call.
        allowed: of an argument, the words of WRONG that it takes, and why is in its docstring.
        also: of an argument, more wrong values by words of their own.
        words: of an argument, what its errors may call it beside its name.
    """

    name: str
    run: Callable[..., Any]
    arguments: Mapping[str, Any]
    allowed: Mapping[str, frozenset[str]] = field(default_factory=dict)
    also: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    words: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def cases(self) -> list[tuple[str, str, Any]]:
        """Argument, word and wrong value."""
        return [
            (argument, word, value)
            for argument in self.arguments
            for word, value in (WRONG | dict(self.also.get(argument, {}))).items()
        ]


class Made:
    """An argument that is made anew for every call, such as a model that is trained."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self.make = make


def call(case: Call, **changes: Any) -> Any:
    """The call with some arguments changed."""
    made = {n: v.make() if isinstance(v, Made) else v for n, v in case.arguments.items()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return case.run(**made | changes)


def finding(case: Call, argument: str, word: str, value: Any) -> str:
    """What is wrong with how a wrong call ends; '' where nothing is."""
    about = f"{case.name}({argument}={word})"
    try:
        result = call(case, **{argument: value})
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        names = (argument, *case.words.get(argument, ()))
        ours = Path(last.filename).is_relative_to(PACKAGE) and str(last.line).startswith("raise")
        if ours and any(name in str(error) for name in names):
            return ""
        where = f"{Path(last.filename).name}:{last.lineno}"
        return f"{about}: {type(error).__name__} at {where}: {error!s:.100}"
    if word in case.allowed.get(argument, COUNT):
        return ""
    return f"{about}: silent, {str(result)!s:.60}"
