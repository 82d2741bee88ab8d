"""What ships is of every seed there is, and nothing ships of a run that did not come to its end."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tsmlib.storage import files, manifest
from tsmlib.storage import tables as tables_storage
from tsmlib.study import publish
from tsmlib.study.runs import Run, RunError


def seed(base: Path, k: int, state: str = "complete") -> Run:
    """A paper-scale run of one seed with a row in every table that is pooled."""
    run = Run("publish", "paper", k, base / f"seed{k}")
    for notebook in publish.POOLED:
        row: dict[str, Any] = dict(metric="kl", value=k, seed=k, scale="paper", env="tsm/Reacher-v0")
        more = {"dimension": 1} if notebook == "04_latent" else {}
        tables_storage.save(run.metrics / f"{notebook}.csv", [row | more])
    entries = {notebook: {"state": state, "files": {}} for notebook in publish.POOLED}
    manifest.write_json(run.dir / files.STATUS, {name: manifest.sealed(entry) for name, entry in entries.items()})
    return run


def test_tables_ship_with_the_rows_of_every_seed_and_all_their_columns(tmp_path: Path) -> None:
    run = seed(tmp_path, 0)
    seed(tmp_path, 1)
    tables = publish.pooled(run)
    assert set(tables) == set(publish.POOLED)
    for notebook, rows in tables.items():
        assert rows["seed"].tolist() == [0, 1]
        assert ("dimension" in rows) == (notebook == "04_latent")


def test_a_seed_that_did_not_come_to_its_end_stops_publishing(tmp_path: Path) -> None:
    run = seed(tmp_path, 0)
    seed(tmp_path, 1, state="failed")
    with pytest.raises(RunError, match="seed1 is failed, expected complete"):
        publish.pooled(run)


def test_nothing_is_written_before_all_notebooks_have_come_to_their_end(tmp_path: Path) -> None:
    before = publish.README.read_text()
    with pytest.raises(RunError, match="01_collect in .* is not run, expected complete"):
        publish.publish(seed(tmp_path, 0))
    assert publish.README.read_text() == before
