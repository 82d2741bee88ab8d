"""Checkpoints: all that a training needs to go on as if it had not stopped, in whole generations.

A generation is one artefact, ``<step>.safetensors``: arrays, what they are and the checksum over
all of it appear with one rename. The last two are kept. One that is cut, damaged or not what its
name says is refused, and the one before it is used. Numbers that JSON does not have, such as a clip
that is infinite, are texts in it.
"""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar, cast

import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from tsmlib.models.config import Configured
from tsmlib.storage import artifacts
from tsmlib.storage.files import (
    Json,
    PathLike,
    StoreError,
    decode_nonfinite,
    encode_nonfinite,
    writer_lock,
)
from tsmlib.storage.provenance import provenance

KEPT = 2  # generations


class TrainingStopped(RuntimeError):
    """A value that is not finite; the model holds the best weights so far."""


@dataclass
class Curve:
    """Record of a training: lists with one entry per record.

    Attributes:
        unit: of the steps.
        remedy: where a value is not finite.
        seconds: CPU time so far.
        resumed: what differed each time that the training went on elsewhere, for which the last
            bits of the result may differ.
    """

    unit: ClassVar[str] = "step"
    remedy: ClassVar[str] = "Check the data"
    seconds: list[float] = field(default_factory=list)
    resumed: list[str] = field(default_factory=list)


C = TypeVar("C", bound=Curve)


class TrainingState(Generic[C]):
    """All that a run needs to continue: weights, moments, the step, the best weights and the curve.

    Args:
        model: what is trained.
        optimizers: by the name of their moments in a checkpoint.
        curve: the record so far.
        total: steps of the whole run.
        identity: what the run is, as JSON values, its lr among them; the model's configuration and
            its weights, which are the first ones, are added. That of another run is refused.
        folder: of the checkpoints; None for none.
    """

    def __init__(
        self,
        model: nn.Module,
        optimizers: Mapping[str, torch.optim.Optimizer],
        curve: C,
        total: int,
        identity: Mapping[str, Json],
        folder: PathLike | None = None,
    ) -> None:
        self.model, self.optimizers, self.curve, self.total = model, optimizers, curve, total
        configuration = model.config() if isinstance(model, Configured) else {}
        began = artifacts.digest(model.state_dict())[:16]
        self.identity: dict[str, Json] = encode_nonfinite(
            {**identity, "configuration": configuration, "began with": began}
        )
        self.folder = None if folder is None else Path(folder)
        self.step, self.seconds = 0, 0.0
        self.keep(math.inf)

    def keep(self, loss: float) -> None:
        """Hold the present weights as the best."""
        state = self.model.state_dict().items()
        self.best = {name: tensor.detach().clone() for name, tensor in state}
        self.best_step, self.best_loss = self.step, loss

    def restore_best(self) -> None:
        """Put the best weights into the model."""
        self.model.load_state_dict(self.best)

    def stopped(self, what: str, at: int) -> TrainingStopped:
        """Go back to the best weights; the error to raise."""
        self.restore_best()
        unit, lr = self.curve.unit, self.identity["lr"]
        return TrainingStopped(
            f"{what} at {unit} {at} of {self.total}; the weights of {unit} {self.best_step} are "
            f"kept. {self.curve.remedy}, or take a smaller lr than {lr}"
        )

    def save(self) -> None:
        """Write the next generation."""
        if self.folder is None:
            return
        tensors = {f"model.{name}": tensor for name, tensor in self.model.state_dict().items()}
        tensors |= {f"best.{name}": tensor for name, tensor in self.best.items()}
        for name, optimizer in self.optimizers.items():
            for i, moments in optimizer.state_dict()["state"].items():
                tensors |= {f"{name}.{i}.{moment}": tensor for moment, tensor in moments.items()}
        header = dict[str, Json](
            identity=self.identity,
            step=self.step,
            seconds=self.seconds,
            curve=asdict(self.curve),
            made_by=self._made_by(),
            best_step=self.best_step,
            best_loss=self.best_loss,
        )
        save_generation(self.folder, self.step, tensors, header=encode_nonfinite(header))

    def load(self) -> None:
        """Go on from the newest whole generation, if there is one.

        Says and records what differs in code, libraries, CPU, threads or device.

        Raises:
            StoreError: it is another run's; both sides of what differs are named.
        """
        if self.folder is None or (found := load_generation(self.folder)) is None:
            return
        path, tensors, header = found[0], found[1], cast(dict[str, Any], found[2])
        anew = f"Delete {self.folder} to start anew, or go back to those settings"
        moments: dict[str, dict[int, dict[str, Tensor]]] = {name: {} for name in self.optimizers}
        groups: dict[str, dict[str, Tensor]] = {name: {} for name in ("model", "best", *moments)}
        try:
            if differs := differing(header["identity"], self.identity):
                raise StoreError(
                    f"{path} is the checkpoint of another run: {'; '.join(differs)}. {anew}"
                )
            for name, tensor in tensors.items():
                group, _, rest = name.partition(".")
                groups[group][rest] = tensor
            for group, held in moments.items():
                for name, tensor in groups[group].items():
                    index, _, moment = name.partition(".")
                    held.setdefault(int(index), {})[moment] = tensor
            curve = type(self.curve)(**decode_nonfinite(header["curve"]))
            step, best_step = int(header["step"]), int(header["best_step"])
            best_loss, seconds = float(header["best_loss"]), float(header["seconds"])
            made_by = header["made_by"]
        except (KeyError, TypeError, ValueError) as error:
            if isinstance(error, StoreError):
                raise
            raise StoreError(
                f"{path} is no checkpoint of this tsmlib: {error!r:.200}. {anew}"
            ) from error
        self.model.load_state_dict(groups["model"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict({**optimizer.state_dict(), "state": moments[name]})
        self.best, self.best_step, self.best_loss = groups["best"], best_step, best_loss
        self.step, self.seconds, self.curve = step, seconds, curve
        self._note_changes(made_by)

    def _note_changes(self, made_by: Mapping[str, object]) -> None:
        changed = [
            f"{name} {made_by.get(name)} -> {value}"
            for name, value in self._made_by().items()
            if made_by.get(name) != value
        ]
        if self.folder and changed:
            self.curve.resumed.append(f"at step {self.step}: {', '.join(changed)}")
            warnings.warn(
                f"{self.folder.name} goes on {self.curve.resumed[-1]}. The result may differ in "
                "its last bits from an uninterrupted run; this is noted with the model.",
                stacklevel=2,
            )

    def _made_by(self) -> dict[str, Json]:
        device = next(self.model.parameters()).device
        name = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
        return {**provenance(), "device": name}


def differing(stated: Mapping[str, Json], expected: Mapping[str, Json]) -> list[str]:
    """Both sides of what tells the run of a file from this one; numbers up to rounding."""
    differences = []
    for name in dict.fromkeys([*expected, *stated]):
        found, wanted = stated.get(name), encode_nonfinite(expected.get(name))
        if isinstance(found, dict) and isinstance(wanted, dict):
            differences += [f"{name}.{difference}" for difference in differing(found, wanted)]
        elif not (name in stated and name in expected and _alike(found, wanted)):
            differences.append(f"{name} is {found!r:.200} in the file, expected {wanted!r:.200}")
    return differences


def _alike(found: Json, expected: Json) -> bool:
    """Equal; numbers up to what another processor rounds, in lists too."""
    if isinstance(found, list) and isinstance(expected, list | tuple):
        return len(found) == len(expected) and all(map(_alike, found, expected))
    if isinstance(found, float) and isinstance(expected, float):
        return math.isclose(found, expected, rel_tol=1e-5, abs_tol=1e-12)
    return found == expected


@contextmanager
def resumable(state: TrainingState[C], *, purpose: str, progress: str | bool) -> Iterator[tqdm]:
    """A training that goes on from its checkpoints, as their only writer.

    Args:
        state: of the training.
        purpose: what a second writer is told.
        progress: title of the progress bar; '' or False for none.
    """
    with ExitStack() as stack:
        if state.folder is not None:
            stack.enter_context(writer_lock(state.folder, purpose))
            state.load()
        bar = tqdm(
            total=state.total,
            initial=state.step,
            desc=str(progress),
            disable=not progress,
            mininterval=1.0,
        )
        yield stack.enter_context(bar)


def save_generation(
    folder: Path, number: int, tensors: Mapping[str, Tensor], *, header: Mapping[str, Json]
) -> None:
    """Write generation ``number`` of a checkpoint; the one before stays, older ones go."""
    path = folder / f"{number:09d}.safetensors"
    artifacts.save(path, tensors, kind="checkpoint", header={**header, "generation": number})
    for old in sorted(folder.glob("*.safetensors"))[:-KEPT]:
        with contextlib.suppress(OSError):  # or after the next one
            old.unlink()


def load_generation(folder: Path) -> tuple[Path, dict[str, Tensor], dict[str, Json]] | None:
    """Path, arrays and header of the newest generation that is whole; None where there is none.

    Warns, naming both, where a newer one was refused.

    Raises:
        StoreError: every one was refused.
    """
    refused = []
    for path in sorted(folder.glob("*.safetensors"), reverse=True):
        try:
            tensors, header = artifacts.load(path, kind="checkpoint")
            if f"{header.get('generation'):09}" != path.stem:
                raise StoreError(
                    f"{path} is stale: it holds generation {header.get('generation')!r:.80}, "
                    "expected its name's."
                )
        except (StoreError, TypeError, ValueError) as error:
            refused.append(str(error))
            continue
        if refused:
            warnings.warn(
                f"{' '.join(refused)} Going on from the generation before: {path}", stacklevel=2
            )
        return path, tensors, header
    if refused:
        raise StoreError(
            f"no generation in {folder} can be used. {' '.join(refused)} Delete that folder to "
            "start anew."
        )
    return None
