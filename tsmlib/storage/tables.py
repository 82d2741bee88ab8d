"""Results tables: CSV with fixed columns."""

from __future__ import annotations

import contextlib
import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tsmlib.storage.files import PathLike, StoreError, _again, write_bytes
from tsmlib.storage.manifest import _text

COLUMNS = (
    *("env", "sim", "task", "model", "planner", "prior", "horizon", "condition"),
    *("metric", "value", "unit", "n", "seed", "scale"),
)  # of every metrics table


# Tables and JSON -----------------------------------------------------------------------------------------------------


def save_table(path: PathLike, rows: Sequence[Mapping[str, Any]], *, extra: Sequence[str] = ()) -> None:
    """Write one metrics table as CSV: the columns COLUMNS, then ``extra``; a field that a row lacks stays empty.

    Raises StoreError for a column that is in neither and for a number that is not finite.
    """
    path, columns = Path(path), (*COLUMNS, *extra)
    for i, row in enumerate(rows):
        if unknown := sorted(set(row) - set(columns)):
            raise StoreError(
                f"row {i} for {path} has unknown columns {unknown}, expected some of {list(columns)}. "
                "Name others as extra."
            )
        for name, value in row.items():
            if isinstance(value, float | np.floating) and not math.isfinite(value):
                raise StoreError(
                    f"row {i} for {path} holds {name} = {value}, expected a finite number; leave it out, or count "
                    f"what diverged: {dict(row)}"
                )
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _plain(value) for name, value in row.items()} for row in rows)
    write_bytes(path, text.getvalue().encode())


def load_table(path: PathLike) -> list[dict[str, Any]]:
    """Rows of a table, numbers as int or float, empty fields as ''; checked against the folder's manifest, if any."""
    path = Path(path)
    reader = csv.reader(io.StringIO(_text(path)), strict=True)
    try:
        columns, *rows = reader
    except (csv.Error, ValueError) as error:
        raise StoreError(f"{path} is not a table ({error}). {_again(path)}") from error
    if missing := [name for name in COLUMNS if name not in columns]:
        raise StoreError(f"{path} is not a metrics table: it lacks the columns {missing}. {_again(path)}")
    for line, row in enumerate(rows, start=2):
        if len(row) != len(columns):
            raise StoreError(f"{path}, line {line}: {len(row)} fields, expected {len(columns)}. {_again(path)}")
    return [{name: _number(field) for name, field in zip(columns, row, strict=True)} for row in rows]


def _plain(value: Any) -> Any:
    """JSON and CSV know Python's own numbers only."""
    if isinstance(value, bool | np.bool_):
        return int(value)
    return value.item() if isinstance(value, np.generic) else value


def _number(field: str) -> Any:
    for convert in (int, float):
        with contextlib.suppress(ValueError):
            return convert(field)
    return field
