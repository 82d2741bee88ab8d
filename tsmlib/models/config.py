"""Constructor arguments that travel with a module's weights."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Self

import numpy as np
import torch
from torch import nn

from tsmlib.checks import require_seed
from tsmlib.storage import hub
from tsmlib.storage.files import Json, PathLike


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

    @classmethod
    def from_pretrained(cls, name: PathLike) -> Self:
        """Read a model from a folder, or from the Hugging Face Hub.

        Args:
            name: a folder that ``save_pretrained`` wrote; or "owner/name", where no such folder is.

        Returns:
            The model, on the CPU.

        Raises:
            StoreError: it is missing, damaged or of another class.
            ImportError: the Hub is asked, and the extra "hub" is not installed.
        """
        return hub.from_pretrained(cls, name)

    def save_pretrained(
        self, folder: PathLike, *, scores: Mapping[str, float] | None = None
    ) -> None:
        """Write weights, arguments and a card into a folder.

        Args:
            folder: made if it is not there.
            scores: numbers for the card, by name.

        Raises:
            StoreError: weights that are not finite, or no room.
        """
        hub.save_pretrained(self, folder, scores=scores)

    def push_to_hub(
        self, name: str, *, private: bool = False, scores: Mapping[str, float] | None = None
    ) -> str:
        """Upload what ``save_pretrained`` writes to the Hugging Face Hub.

        Args:
            name: "owner/name" there; log in before: hf auth login.
            private: whether a new repository is private.
            scores: numbers for the card, by name.

        Returns:
            Its address.

        Raises:
            ImportError: the extra "hub" is not installed.
        """
        return hub.push_to_hub(self, name, private=private, scores=scores)

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
