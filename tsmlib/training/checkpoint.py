"""Checkpoints: everything that a training needs to go on as if it had not stopped, in whole generations.

A generation is one artefact, ``<step>.safetensors``: arrays, what they are and the checksum over all of it appear with
one rename. The last two are kept. One that is cut, damaged or not what its name says is refused, and the one before it
is used.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from tsmlib.storage import artifacts
from tsmlib.storage.files import StoreError
from tsmlib.storage.provenance import provenance

KEPT = 2  # generations


class TrainingStopped(RuntimeError):
    """Loss or gradient were not finite; the model holds the best weights so far. The message names step and remedy."""


@dataclass
class TrainingHistory:
    """What a fit recorded at each validation: optimiser step, processor seconds, training and validation
    loss.

    resumed: for each time that the fit went on elsewhere, what differed from before, so that the result may differ in
    its last bits from an uninterrupted one.
    """

    step: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    train: list[float] = field(default_factory=list)
    validation: list[float] = field(default_factory=list)
    resumed: list[str] = field(default_factory=list)


class TrainingState:
    """All that a run needs to continue: weights, Adam's moments, the step, the best weights and the curve so far."""

    def __init__(self, model: nn.Module, optimizer: torch.optim.Optimizer, curve: Any = None) -> None:
        self.model, self.optimizer = model, optimizer
        self.step, self.seconds = 0, 0.0
        self.curve: Any = TrainingHistory() if curve is None else curve  # a dataclass of lists, with resumed
        self.best, self.best_step, self.best_loss = _copy(model.state_dict()), 0, math.inf

    def record(self, train: float, validation: float) -> None:
        """Add a point to the curve; keep the weights if they are the best so far."""
        self.curve.step.append(self.step)
        self.curve.seconds.append(self.seconds)
        self.curve.train.append(train)
        self.curve.validation.append(validation)
        if validation < self.best_loss:
            self.best, self.best_step, self.best_loss = _copy(self.model.state_dict()), self.step, validation

    def restore_best(self) -> None:
        """Put the weights with the best validation loss into the model."""
        self.model.load_state_dict(self.best)

    def stopped(self, what: str, value: float, at: str, lr: float) -> TrainingStopped:
        """Go back to the best weights; the error to raise."""
        self.restore_best()
        return TrainingStopped(
            f"the {what} became {value} at step {at}; the weights of step {self.best_step} are kept. "
            f"Check the data, or train with a smaller lr than {lr:g}"
        )

    def save(self, folder: Path, identity: dict[str, Any]) -> None:
        """Write the next generation into ``folder``."""
        adam = self.optimizer.state_dict()["state"]
        tensors = {f"model.{name}": tensor for name, tensor in self.model.state_dict().items()}
        tensors |= {f"best.{name}": tensor for name, tensor in self.best.items()}
        tensors |= {f"adam.{i}.{name}": tensor for i, moments in adam.items() for name, tensor in moments.items()}
        header = dict(
            identity=identity, step=self.step, seconds=self.seconds, curve=asdict(self.curve), made_by=self._made_by(),
            best_step=self.best_step, best_loss=self.best_loss,
        )  # fmt: skip
        save_generation(folder, self.step, tensors, header=header)

    def load(self, folder: Path, identity: dict[str, Any]) -> None:
        """Go on from the newest whole generation in ``folder``, if there is one.

        Says and records what differs in code, libraries, processor, threads or device. StoreError for another run's.
        """
        if (old := folder.with_name(f"{folder.name}.safetensors")).exists():
            raise StoreError(
                f"{old} is a checkpoint of an earlier tsmlib. Finish with that, or delete it to start anew."
            )
        if (found := load_generation(folder)) is None:
            return
        path, tensors, header = found
        anew = f"Delete {folder} to start anew, or go back to those settings"
        groups: dict[str, dict[str, Tensor]] = {"model": {}, "best": {}, "adam": {}}
        moments: dict[int, dict[str, Tensor]] = {}
        try:
            if differs := artifacts.differences(header["identity"], identity):
                raise StoreError(f"{path} is the checkpoint of another run: {'; '.join(differs)}. {anew}")
            for name, tensor in tensors.items():
                group, _, rest = name.partition(".")
                groups[group][rest] = tensor
            for group in ("model", "best"):
                if differs := artifacts.differences(
                    artifacts.layout(groups[group]), artifacts.layout(self.model.state_dict())
                ):
                    raise StoreError(f"{path} holds the weights of another model: {'; '.join(differs[:3])}. {anew}")
            for name, tensor in groups["adam"].items():
                index, _, moment = name.partition(".")
                moments.setdefault(int(index), {})[moment] = tensor
            curve, before, now = (
                type(self.curve)(**header["curve"]),
                {"device": "cpu", **header["made_by"]},
                self._made_by(),
            )
            step, best_step, best_loss = int(header["step"]), int(header["best_step"]), float(header["best_loss"])
            seconds = float(header["seconds"])
        except (KeyError, TypeError, ValueError) as error:
            if isinstance(error, StoreError):
                raise
            raise StoreError(f"{path} is no checkpoint of this tsmlib: {error!r:.200}. {anew}") from error
        self.model.load_state_dict(groups["model"])
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": moments})
        self.best, self.best_step, self.best_loss = groups["best"], best_step, best_loss
        self.step, self.seconds, self.curve = step, seconds, curve
        if changed := [
            f"{name} {before.get(name)} -> {value}" for name, value in now.items() if before.get(name) != value
        ]:
            self.curve.resumed.append(f"at step {step}: {', '.join(changed)}")
            warnings.warn(
                f"{path.parent.name} goes on {self.curve.resumed[-1]}. The result may differ in its last bits from an "
                "uninterrupted run; this is noted with the model.",
                stacklevel=3,
            )

    def _made_by(self) -> dict[str, Any]:
        device = next(self.model.parameters()).device
        return {**provenance(), "device": torch.cuda.get_device_name(device) if device.type == "cuda" else device.type}


def save_generation(folder: Path, number: int, tensors: Mapping[str, Tensor], *, header: Mapping[str, Any]) -> None:
    """Write generation ``number`` of a checkpoint into its folder; the one before stays, older ones go."""
    path = folder / f"{number:09d}.safetensors"
    artifacts.save(path, tensors, kind="checkpoint", header={**header, "generation": number})
    for old in sorted(folder.glob("*.safetensors"))[:-KEPT]:
        old.unlink(missing_ok=True)


def load_generation(folder: Path) -> tuple[Path, dict[str, Tensor], dict[str, Any]] | None:
    """Path, arrays and header of the newest generation that is whole; None where there is none at all.

    Warns, naming both, where a newer one was refused. Raises StoreError where every one was.
    """
    refused = []
    for path in sorted(folder.glob("*.safetensors"), reverse=True):
        try:
            tensors, header = artifacts.load(path, kind="checkpoint")
            if f"{header.get('generation'):09}" != path.stem:
                raise StoreError(
                    f"{path} is stale: it holds generation {header.get('generation')!r:.80}, expected its name's."
                )
        except (StoreError, TypeError, ValueError) as error:
            refused.append(str(error))
            continue
        if refused:
            warnings.warn(f"{' '.join(refused)} Going on from the generation before: {path}", stacklevel=2)
        return path, tensors, header
    if refused:
        raise StoreError(
            f"no generation in {folder} can be used. {' '.join(refused)} Delete that folder to start anew."
        )
    return None


def _copy(state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in state.items()}
