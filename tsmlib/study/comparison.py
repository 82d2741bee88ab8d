"""What a notebook shows: the reader's own rows beside the published ones."""

from collections.abc import Iterable, Mapping

import pandas as pd

from tsmlib.storage import tables
from tsmlib.study import predictions
from tsmlib.study.notebooks import require
from tsmlib.study.results.table import PUBLISHED, YOURS
from tsmlib.study.runs import RESULTS, Run, RunError


def evidence(run: Run, rows: pd.DataFrame | Iterable[Mapping[str, object]], table: str = "") -> pd.DataFrame:
    """The published rows of a notebook's table and those of this run, told apart by the column ``source``.

    At scale paper the other seeds beside this run are its own too, those that are complete (``pooled_rows``). table:
    what follows the notebook's name in the table's, ``_rows`` for instance. What is written stays without the column:
    ``tables.save`` and ``publish`` know nothing of it.
    """
    own = predictions.pooled_rows(run, rows, f"{run.notebook}{table}", whole=False)
    return _sourced(published(f"{run.notebook}{table}"), own)


def published(table: str) -> pd.DataFrame:
    """A table that ships; without rows where there is none."""
    path = RESULTS / f"{table}.csv"
    return tables.load(path) if tables.stored(path) else tables.frame([])


def save_evidence(run: Run, rows: Iterable[Mapping[str, object]]) -> pd.DataFrame:
    """Write the table of a notebook's run, without the column ``source``. Returns its ``evidence``."""
    tables.save(run.metrics / f"{run.notebook}.csv", rows)
    return evidence(run, rows)


def evidence_of(run: Run, notebook: str) -> pd.DataFrame:
    """``evidence`` of another notebook's table; of this run's rows those of this seed.

    Where that notebook did not come to its end in this run, or its table was changed since, they are left out, and it
    is said.
    """
    own, path = tables.frame([]), run.dir / "metrics" / f"{notebook}.csv"
    if path.exists():
        try:
            require(run, notebook)
            own = tables.load(path)
        except RunError as error:
            print(f"your rows are left out: {error}")
    return _sourced(published(notebook), own)


def table(run: Run, name: str) -> pd.DataFrame:
    """A benchmark's table, which no notebook writes: this run's, else the published one; ``source`` says which."""
    none, path = tables.frame([]), run.dir / "metrics" / f"{name}.csv"
    return _sourced(none, tables.load(path)) if path.exists() else _sourced(published(name), none)


def _sourced(published: pd.DataFrame, own: pd.DataFrame) -> pd.DataFrame:
    parts = {PUBLISHED: published, YOURS: own}
    return tables.frame(pd.concat([part.assign(source=source) for source, part in parts.items()]))
