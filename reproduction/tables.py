"""Tidy tables: one number a line, the same columns in all; CSV on disk, ``.gz`` where large."""

from __future__ import annotations

import gzip
import io
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import pandas as pd

from tsmlib import shipped
from tsmlib.envs.spec import EnvSpec
from tsmlib.shipped import ROOT

RESULTS = ROOT / "data" / "results"  # the published tables
Row = dict[str, object]
TEXTS = ("env", "sim", "task", "model", "planner", "search_space", "subset", "execution", "metric")
TEXTS += ("unit", "scale", "split", "configuration")
COUNTS = ("horizon", "steps_ahead", "iteration", "env_steps", "delay", "n", "seed", "lag")
COUNTS += ("samples", "dimension", "copy", "target", "episode")
NUMBERS = ("noise", "value", "start", "torque_weight")
COLUMNS = ("env", "sim", "task", "model", "planner", "search_space", "horizon", "steps_ahead")
COLUMNS += ("iteration", "env_steps", "subset", "execution", "noise", "delay", "metric", "value")
COLUMNS += ("unit", "n", "seed", "scale")  # of every table; an empty field does not apply
LARGE = 900_000  # bytes; a table of more is compressed


class TableError(ValueError):
    """A file that is no table of ours, or rows that cannot be one."""


def frame(rows: pd.DataFrame | Iterable[Mapping[str, object]]) -> pd.DataFrame:
    """Rows as a table with all COLUMNS: texts (empty where absent), Int64 counts, floats.

    Raises:
        TableError: an unknown column, or a value that is not finite.
    """
    given = rows if isinstance(rows, pd.DataFrame) else pd.DataFrame(list(rows))
    extra = [name for name in given.columns if name not in COLUMNS]
    if unknown := [name for name in extra if name not in (*TEXTS, *COUNTS, *NUMBERS)]:
        raise TableError(f"unknown columns {', '.join(unknown)}; expected {', '.join(COLUMNS)}")
    table = given.reindex(columns=[*COLUMNS, *extra])
    for name in table.columns:
        if name in TEXTS:
            table[name] = table[name].astype(object).where(table[name].notna(), "").astype(str)
        elif name in COUNTS:
            table[name] = pd.array(pd.to_numeric(table[name]), dtype="Int64")
        else:
            table[name] = pd.to_numeric(table[name]).astype(float)
    bad = [i for i, value in enumerate(table["value"]) if not math.isfinite(value)]
    if bad:
        row = {name: value for name, value in table.iloc[bad[0]].items() if not _empty(value)}
        raise TableError(f"row {bad[0]} has no finite value: {row}")
    return table


def write(path: Path, rows: pd.DataFrame | Iterable[Mapping[str, object]]) -> Path:
    """Write a table by renaming a whole file; a large one as ``.gz``. Returns where it is."""
    data = frame(rows).to_csv(index=False, lineterminator="\n").encode()
    large = path.with_name(f"{path.name}.gz")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp-{os.getpid()}")
    if len(data) <= LARGE or path.parent != RESULTS:
        temporary.write_bytes(data)
        os.replace(temporary, path)
        large.unlink(missing_ok=True)
        return path
    temporary.write_bytes(gzip.compress(data, mtime=0))
    os.replace(temporary, large)
    path.unlink(missing_ok=True)
    return large


def read(path: Path) -> pd.DataFrame:
    """A table as ``frame`` makes it; the compressed form where that is there alone.

    Raises:
        TableError: the file lacks columns of a table.
        FileNotFoundError: there is none.
    """
    large = path.with_name(f"{path.name}.gz")
    path = large if large.exists() and not path.exists() else path
    data = path.read_bytes()
    text = (gzip.decompress(data) if path.suffix == ".gz" else data).decode()
    try:
        table = pd.read_csv(io.StringIO(text), dtype=str, keep_default_na=False)
    except (ValueError, pd.errors.ParserError) as error:
        raise TableError(f"{path} is no table: {error}") from error
    if lacking := [name for name in COLUMNS if name not in table.columns]:
        raise TableError(
            f"{path} is a table of another schema, without {', '.join(lacking)}; restore it, or "
            "make it again"
        )
    return frame(table.replace("", None))


def published(name: str) -> pd.DataFrame:
    """A table of data/results, such as ``03_predict``."""
    return read(shipped.find("data/results") / f"{name}.csv")


def select(table: pd.DataFrame, **where: object) -> pd.DataFrame:
    """The rows in which each named column has the value, or one of a list; None is an empty one."""
    for name, value in where.items():
        column = table[name] if name in table else pd.Series(None, index=table.index, dtype=object)
        if value is None:
            table = table[(column == "") | column.isna()]
        elif isinstance(value, list | tuple | set):
            table = table[column.isin(list(value))]
        else:
            table = table[(column == value).fillna(False).astype(bool)]
    return table


def place(env: str) -> Row:
    """The columns that say where a row is from: the plain arm, its simulator, noise and delay."""
    if not env.startswith("tsm/"):
        return {"env": env}
    spec = EnvSpec.parse(env)
    imperfect = {"noise": spec.noise or None, "delay": spec.delay or None}
    return {"env": spec.arm.id, "sim": spec.simulator, **imperfect}


def markdown(table: pd.DataFrame, form: str = "{:.3g}") -> str:
    """A table in Markdown: numbers in one form, nothing for what is missing."""
    texts = table.map(lambda x: form.format(x) if isinstance(x, float) and x == x else x)
    texts = texts.astype(object).where(table.notna(), "")
    return texts.to_markdown(index=False, disable_numparse=True)


def _empty(value: object) -> bool:
    return value is pd.NA or value == "" or value != value
