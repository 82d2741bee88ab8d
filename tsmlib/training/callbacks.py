"""Callbacks of a training: what is called at every record, and two that write it down.

    fit(model, data, callback=CsvCallback("losses.csv"))

A callback sees numbers, not the model, and a training draws nothing from the global generators: its
bits are the same with and without one. A training that is stopped between a record and its
checkpoint makes that record again when it goes on, and one that starts anew makes all of them; what
is written down of a step therefore takes the place of what was there of this step and later ones.
"""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from tsmlib.checks import require_type
from tsmlib.storage import files
from tsmlib.storage.files import PathLike, StoreError


@dataclass(frozen=True)
class Progress:
    """A record of a training.

    Attributes:
        step: updates done.
        seconds: CPU time so far.
        values: of ``fit`` the losses ``train``, mean since the last record, and ``validation``; of
            ``learn_policy`` the ``predicted`` return and what ``measure`` gave.
    """

    step: int
    seconds: float
    values: Mapping[str, float]


class Callback(Protocol):
    """Called at every record of a training; what it raises ends the training."""

    def __call__(self, progress: Progress) -> None:
        """Take note of a record, before its checkpoint is written.

        Args:
            progress: the record.
        """
        ...


class CsvCallback:
    """A table of a training: a line for each record, with step, seconds and the values.

    Args:
        path: of the CSV file, one for each training.
    """

    def __init__(self, path: PathLike) -> None:
        require_type("path", path, (str, Path), "the path of a CSV file")
        self.path = Path(path)

    def __call__(self, progress: Progress) -> None:
        columns = ["step", "seconds", *progress.values]
        text = io.StringIO(newline="")
        table = csv.writer(text, lineterminator="\n")
        table.writerows([columns, *self._before(progress.step, columns)])
        table.writerow([progress.step, round(progress.seconds, 3), *progress.values.values()])
        files.write_bytes(self.path, text.getvalue().encode())

    def _before(self, step: int, columns: list[str]) -> list[list[str]]:
        """The lines of the file that are of earlier steps."""
        if not self.path.exists():
            return []
        found, *lines = list(csv.reader(files.read_bytes(self.path).decode().splitlines())) or [[]]
        if found != columns:
            raise StoreError(
                f"{self.path} has the columns {', '.join(found)}; expected {', '.join(columns)}. "
                "Name another file."
            )
        return [line for line in lines if line and int(line[0]) < step]


class TensorBoardCallback:
    """Curves for TensorBoard, a scalar for each value and one for ``seconds``.

    Args:
        folder: of the events, one for each training.

    Raises:
        ImportError: TensorBoard is not installed; before anything is trained.
    """

    def __init__(self, folder: PathLike) -> None:
        require_type("folder", folder, (str, Path), "the path of a folder")
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise ImportError(
                "TensorBoardCallback needs tensorboard, an optional extra: "
                'pip install "tsmlib[tensorboard]"'
            ) from error
        self.folder, self._last = Path(folder), -1
        self._open = SummaryWriter
        self._writer: SummaryWriter | None = None

    def __call__(self, progress: Progress) -> None:
        if self._writer is None or progress.step <= self._last:
            if self._writer is not None:
                self._writer.close()
            # Hides this step and later ones.
            self._writer = self._open(str(self.folder), purge_step=progress.step)
        for name, value in {**progress.values, "seconds": progress.seconds}.items():
            self._writer.add_scalar(name, value, progress.step)
        self._writer.flush()
        self._last = progress.step
