"""Results tables: pandas DataFrames, as CSV with fixed columns on disk."""

import csv
import io
import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tsmlib.storage.files import PathLike, StoreError, remedy, write_bytes
from tsmlib.storage.manifest import read_text

COLUMNS = (
    *("env", "sim", "task", "model", "planner", "search_space"),
    *("horizon", "steps_ahead", "iteration", "env_steps", "subset", "execution", "noise", "delay"),
    *("metric", "value", "unit", "n", "seed", "scale"),
)  # of every results table; a field that does not apply is empty
EXTRA = ("split", "lag", "samples", "dimension", "copy", "target", "start", "torque_weight", "configuration")
_COUNTS = ("horizon", "steps_ahead", "iteration", "env_steps", "delay", "n", "seed", "lag", "samples", "dimension",
           "copy", "target")  # fmt: skip
_NUMBERS = ("noise", "value", "start", "torque_weight")


def frame(rows: pd.DataFrame | Iterable[Mapping[str, object]]) -> pd.DataFrame:
    """Rows as a table: all of COLUMNS, then what else there is; texts, float64, and Int64 for counts.

    What a row lacks is an empty text, NaN or NA.
    """
    found = rows if isinstance(rows, pd.DataFrame) else pd.DataFrame(list(rows))
    columns = [*COLUMNS, *(name for name in found.columns if name not in COLUMNS)]
    return pd.DataFrame(
        {name: _typed(name, found[name].tolist() if name in found else [None] * len(found)) for name in columns}
    )


def save(
    path: PathLike, rows: pd.DataFrame | Iterable[Mapping[str, object]], *, extra: Sequence[str] = ()
) -> pd.DataFrame:
    """Write a results table as CSV in one step; floats as their shortest exact text. Returns it as ``load`` would.

    extra: columns beyond COLUMNS and EXTRA. Raises StoreError for any other column and for a number that is not finite.
    """
    path = Path(path)
    given = [] if isinstance(rows, pd.DataFrame) else list(rows)
    table = frame(given or rows)
    known = [*COLUMNS, *EXTRA, *extra]
    if unknown := sorted(set(table.columns) - set(known)):
        raise StoreError(
            f"rows for {path} have unknown columns {unknown}, expected some of {known}. Name others as extra."
        )
    numbers: Sequence[Mapping[Any, Any]] = given or table[["env", "model", "metric", "value"]].to_dict("records")
    for i, row in enumerate(numbers):
        for name, value in row.items():
            if isinstance(value, float | np.floating) and not math.isfinite(value):
                raise StoreError(
                    f"row {i} for {path} holds {name} = {value}, expected a finite number; leave it out, or count "
                    f"what diverged: {row}"
                )
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows(row.values() for row in records(table))
    write_bytes(path, text.getvalue().encode())
    return table


def load(path: PathLike) -> pd.DataFrame:
    """A results table, checked against the folder's manifest, if any; columns as ``frame`` makes them.

    Raises StoreError for a file that is missing, damaged, cut or no results table.
    """
    path = Path(path)
    reader = csv.reader(io.StringIO(read_text(path)), strict=True)
    try:
        columns, *rows = reader
    except (csv.Error, ValueError) as error:
        raise StoreError(f"{path} is not a table ({error}). {remedy(path)}") from error
    if missing := [name for name in COLUMNS if name not in columns]:
        raise StoreError(f"{path} is not a results table: it lacks the columns {missing}. {remedy(path)}")
    for line, row in enumerate(rows, start=2):
        if len(row) != len(columns):
            raise StoreError(f"{path}, line {line}: {len(row)} fields, expected {len(columns)}. {remedy(path)}")
    return frame(pd.DataFrame(rows, columns=columns, dtype=object))


def records(table: pd.DataFrame) -> list[dict[Hashable, object]]:
    """The rows of a table as dicts of Python's own values, empty ones as ''."""
    return table.astype(object).where(table.notna(), "").to_dict("records")


def _typed(name: str, values: Sequence[Any]) -> pd.Series:
    """One column: counts, numbers or texts, as its name says; of an unknown name, as its values are."""
    given = [None if value is None or value is pd.NA or value == "" or value != value else value for value in values]
    if name in COLUMNS and name not in _COUNTS and name not in _NUMBERS:
        return pd.Series(["" if value is None else str(value) for value in given], dtype="str")
    counts = name not in _NUMBERS and (name in COLUMNS or any(value is not None for value in given))
    for convert, dtype, wanted in ((_count, "Int64", counts), (float, "float64", name not in _COUNTS)):
        if wanted:
            try:
                return pd.Series([None if value is None else convert(value) for value in given], dtype=dtype)
            except (ValueError, TypeError, OverflowError):
                continue
    return pd.Series(["" if value is None else value for value in given], dtype=object)


def _count(value: Any) -> int:
    if int(value) != (value if not isinstance(value, str) else int(value)):
        raise ValueError(value)
    return int(value)
