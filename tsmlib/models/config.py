"""Constructor arguments that travel with a module's weights."""

import functools
import inspect
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import nn

from tsmlib.storage.files import Json


class Configured(nn.Module):
    """A module that records the arguments of its constructor, defaults included, for the file of its weights.

    Not recorded: ``**options`` passed on to a part, which records them itself, and the seed of weights that are stored.
    """

    _config: dict[str, Json]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        init, signature = cls.__init__, inspect.signature(cls.__init__)
        passed_on = {name for name, p in signature.parameters.items() if p.kind is p.VAR_KEYWORD}

        @functools.wraps(init)
        def recording(self: Configured, *args: object, **options: object) -> None:
            init(self, *args, **options)
            given = signature.bind(self, *args, **options)
            given.apply_defaults()
            names = given.arguments.keys() - {"self", "seed"} - passed_on
            self._config = {
                name: _json(value) for name, value in given.arguments.items() if name in names
            }

        cls.__init__ = recording  # type: ignore[method-assign, assignment]

    def config(self) -> dict[str, Json]:
        return dict(self._config)


@contextmanager
def weights_from(seed: int) -> Iterator[None]:
    """First weights drawn from ``seed``: torch's layers draw theirs from the global generator, which is left alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


def _json(value: Json | Configured) -> Json:
    if isinstance(value, Configured):
        return value.config()
    if isinstance(value, Mapping):
        return dict(value)
    return list(value) if isinstance(value, tuple) else value
