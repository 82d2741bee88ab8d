"""The measurements behind settings run, and leave their tables."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tsmlib import runs, store

TINY = {
    "samples": ["--samples", "2", "4", "--episodes", "4"],
    "learning_rates": ["--models", "onestep", "--share", "0.1"],
}


@pytest.mark.parametrize("name", TINY)
def test_the_measurement_behind_a_setting_leaves_a_row_for_each_try(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path))
    script, table = runs.ROOT / "benchmarks" / "choices" / f"{name}.py", tmp_path / "table.csv"
    options = ["--env", "tsm/Reacher-v0", "--scale", "smoke", "--out", str(table), *TINY[name]]
    subprocess.run([sys.executable, script, *options], capture_output=True, text=True, check=True)
    column, tries = {"samples": ("samples", [2, 4]), "learning_rates": ("rate", [2e-3, 4e-3, 8e-3])}[name]
    rows = store.load_table(table)
    assert sorted({row[column] for row in rows}) == tries
    assert len({row["metric"] for row in rows}) * len(tries) == len(rows)
