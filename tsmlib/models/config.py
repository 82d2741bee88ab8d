"""Constructor arguments that travel with a module's weights."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import numpy as np
import torch
from torch import nn

from tsmlib.checks import require_seed
from tsmlib.storage.files import Json


class Configured(nn.Module):
    """A module that records the arguments of its constructor, for the file of its weights.

    Defaults are recorded too; the seed is not, since the weights are stored.
    """

    _config: dict[str, Json]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        init, signature = cls.__init__, inspect.signature(cls.__init__)

        @functools.wraps(init)
        def recording(self: Configured, *args: object, **options: object) -> None:
            init(self, *args, **options)
            given = signature.bind(self, *args, **options)
            given.apply_defaults()
            names = given.arguments.keys() - {"self", "seed"}
            self._config = {
                name: _json(value) for name, value in given.arguments.items() if name in names
            }

        cls.__init__ = recording  # type: ignore[method-assign, assignment]

    def config(self) -> dict[str, Json]:
        """Tell the constructor's arguments, as they travel with the weights.

        Returns:
            The arguments by name, as JSON values.
        """
        return dict(self._config)

    def __repr__(self) -> str:
        """The class with its arguments, and how many weights it has."""
        arguments = ", ".join(f"{name}={value!r}" for name, value in self._config.items())
        weights = sum(weight.numel() for weight in self.parameters())
        return f"{type(self).__name__}({arguments}), {weights:,} weights"


@contextmanager
def weights_from(seed: int) -> Iterator[None]:
    """Draw first weights from ``seed``, and leave torch's global generator alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(require_seed("seed", seed))
        yield


def _json(value: object) -> Json:
    if isinstance(value, Configured):
        return value.config()
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple | list):
        return [_json(item) for item in value]
    return value  # type: ignore[return-value]
