"""The measurements behind settings run, and leave their tables."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tsmlib import runs, store

ARM = ["--env", "tsm/Reacher-v0"]
TRIES = [("half the batch",), ("twice the batch, half the updates",)]
TINY = {  # options, the columns that tell tries apart, and the tries
    "samples": ([*ARM, "--samples", "2", "4", "--episodes", "4"], ("samples",), [(2,), (4,)]),
    "learning_rates": ([*ARM, "--models", "onestep", "--share", "0.1"], ("rate",), [(2e-3,), (4e-3,), (8e-3,)]),
    "budget": ([*ARM, "--stages", "1"], ("condition",), TRIES),
    "starts": (
        ["--targets", "2", "--iterations", "1", "--weights", "1"],
        ("prior", "start"),
        [("actions", 0), ("actions", 0.1), ("actions", 0.5), ("codes", 1)],
    ),
}


@pytest.mark.parametrize("name", TINY)
def test_the_measurement_behind_a_setting_leaves_a_row_for_each_try(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path))
    script, table = runs.ROOT / "benchmarks" / "choices" / f"{name}.py", tmp_path / "table.csv"
    options, columns, tries = TINY[name]
    command = [sys.executable, script, "--scale", "smoke", "--out", str(table), *options]
    subprocess.run(command, capture_output=True, text=True, check=True)
    rows = store.load_table(table)
    assert sorted({tuple(row[column] for column in columns) for row in rows}) == tries
    assert len({row["metric"] for row in rows}) * len(tries) == len(rows)
