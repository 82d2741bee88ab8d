"""Results tables: pandas DataFrames, as CSV with fixed columns on disk; ``*.csv.gz`` is the same, compressed."""

import csv
import io
import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tsmlib.storage.files import (
    PathLike,
    StoreError,
    packed,
    read_bytes,
    remedy,
    unpacked,
    write_bytes,
)
from tsmlib.storage.manifest import read_text

COLUMNS = (
    *("env", "sim", "task", "model", "planner", "search_space"),
    *("horizon", "steps_ahead", "iteration", "env_steps", "subset", "execution", "noise", "delay"),
    *("metric", "value", "unit", "n", "seed", "scale"),
)  # of every results table; a field that does not apply is empty
EXTRA = (
    "split",
    "lag",
    "samples",
    "dimension",
    "copy",
    "target",
    "start",
    "torque_weight",
    "configuration",
)
_COUNTS = (
    "horizon",
    "steps_ahead",
    "iteration",
    "env_steps",
    "delay",
    "n",
    "seed",
    "lag",
    "samples",
    "dimension",
    "copy",
    "target",
)
_NUMBERS = ("noise", "value", "start", "torque_weight")
LARGE = 900_000  # bytes; a table of more ships compressed


def frame(rows: pd.DataFrame | Iterable[Mapping[str, object]]) -> pd.DataFrame:
    """Rows as a table: all of COLUMNS, then what else there is; texts, float64, and Int64 for counts.

    What a row lacks is an empty text, NaN or NA.
    """
    found = rows if isinstance(rows, pd.DataFrame) else pd.DataFrame(list(rows))
    columns = [*COLUMNS, *(name for name in found.columns if name not in COLUMNS)]
    return pd.DataFrame(
        {
            name: _typed(name, found[name].tolist() if name in found else [None] * len(found))
            for name in columns
        }
    )


def save(
    path: PathLike,
    rows: pd.DataFrame | Iterable[Mapping[str, object]],
    *,
    extra: Sequence[str] = (),
) -> pd.DataFrame:
    """Write a results table in one step; floats as their shortest exact text. Returns it as ``load`` would.

    extra: columns beyond COLUMNS and EXTRA. Raises StoreError for any other column and for a number that is not finite.
    """
    path = Path(path)
    table, data = _written(path, rows, extra)
    write_bytes(path, packed(data) if path.suffix == ".gz" else data)
    return table


def ship(
    path: PathLike,
    rows: pd.DataFrame | Iterable[Mapping[str, object]],
    *,
    extra: Sequence[str] = (),
) -> pd.DataFrame:
    """``save`` a table ``*.csv`` where it ships, which is ``*.csv.gz`` where it is LARGE."""
    table, data = _written(Path(path), rows, extra)
    ship_bytes(path, data)
    return table


def ship_bytes(path: PathLike, data: bytes) -> None:
    """The bytes of a table ``*.csv`` where it ships; the other of its two forms goes."""
    plain, gz = _forms(Path(path))
    if len(data) <= LARGE:
        write_bytes(plain, data)
        gz.unlink(missing_ok=True)
        return
    if (
        not gz.exists() or unpacked(gz, read_bytes(gz)) != data
    ):  # another zlib may pack the same into other bytes
        write_bytes(gz, packed(data))
    plain.unlink(missing_ok=True)


def stored(path: PathLike) -> Path | None:
    """The file of a table ``*.csv``: as it is named, or compressed beside that; None where neither is there.

    Raises StoreError where both are.
    """
    found = [form for form in _forms(Path(path)) if form.exists()]
    if len(found) > 1:
        raise StoreError(
            f"{path} is there compressed as well, expected one of both: delete the one that is older."
        )
    return found[0] if found else None


def _forms(path: Path) -> tuple[Path, Path]:
    return path, path.with_name(f"{path.name}.gz")


def _written(
    path: Path, rows: pd.DataFrame | Iterable[Mapping[str, object]], extra: Sequence[str]
) -> tuple[pd.DataFrame, bytes]:
    """A table as ``load`` gives it, and as CSV."""
    given = [] if isinstance(rows, pd.DataFrame) else list(rows)
    table = frame(given or rows)
    known = [*COLUMNS, *EXTRA, *extra]
    if unknown := sorted(set(table.columns) - set(known)):
        raise StoreError(
            f"rows for {path} have unknown columns {unknown}, expected some of {known}. Name others as extra."
        )
    numbers: Sequence[Mapping[Any, Any]] = given or table[
        ["env", "model", "metric", "value"]
    ].to_dict("records")
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
    return table, text.getvalue().encode()


def load(path: PathLike) -> pd.DataFrame:
    """A results table, checked against the folder's manifest, if any; columns as ``frame`` makes them.

    Of ``*.csv`` the compressed form, where that is there alone.

    Raises StoreError for a file that is missing, damaged, cut or no results table.
    """
    path = stored(path) or Path(path)
    reader = csv.reader(io.StringIO(read_text(path)), strict=True)
    try:
        columns, *rows = reader
    except (csv.Error, ValueError) as error:
        raise StoreError(f"{path} is not a table ({error}). {remedy(path)}") from error
    if missing := [name for name in COLUMNS if name not in columns]:
        raise StoreError(
            f"{path} is not a results table: it lacks the columns {missing}. {remedy(path)}"
        )
    for line, row in enumerate(rows, start=2):
        if len(row) != len(columns):
            raise StoreError(
                f"{path}, line {line}: {len(row)} fields, expected {len(columns)}. {remedy(path)}"
            )
    return frame(pd.DataFrame(rows, columns=columns, dtype=object))


def records(table: pd.DataFrame) -> list[dict[Hashable, object]]:
    """The rows of a table as dicts of Python's own values, empty ones as ''."""
    return table.astype(object).where(table.notna(), "").to_dict("records")


def _typed(name: str, values: Sequence[Any]) -> pd.Series:
    """One column: counts, numbers or texts, as its name says; of an unknown name, as its values are."""
    given = [
        None if value is None or value is pd.NA or value == "" or value != value else value
        for value in values
    ]
    if name in COLUMNS and name not in _COUNTS and name not in _NUMBERS:
        return pd.Series(["" if value is None else str(value) for value in given], dtype="str")
    counts = name not in _NUMBERS and (name in COLUMNS or any(value is not None for value in given))
    for convert, dtype, wanted in (
        (_count, "Int64", counts),
        (float, "float64", name not in _COUNTS),
    ):
        if wanted:
            try:
                return pd.Series(
                    [None if value is None else convert(value) for value in given], dtype=dtype
                )
            except (ValueError, TypeError, OverflowError):
                continue
    return pd.Series(["" if value is None else value for value in given], dtype=object)


def _count(value: Any) -> int:
    if int(value) != (value if not isinstance(value, str) else int(value)):
        raise ValueError(value)
    return int(value)
