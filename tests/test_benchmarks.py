"""Benchmarks run, compare equal work, and leave their tables."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tsmlib import runs, store
from tsmlib.__main__ import main

TINY = {
    "collect": ["--episodes", "6", "--loop-episodes", "2", "--rounds", "2"],
    "plan": ["--targets", "2", "--iterations", "1", "--samples", "1", "--rounds", "2"],
}


@pytest.mark.parametrize("name", TINY)
def test_a_benchmark_states_ratios_with_their_spread(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path))
    script = runs.ROOT / "benchmarks" / f"{name}.py"
    printed = subprocess.run([sys.executable, script, *TINY[name]], capture_output=True, text=True, check=True).stdout
    assert "2 rounds" in printed
    values = {row["metric"]: row["value"] for row in store.load_table(tmp_path / "bench" / f"{name}.csv")}
    assert 0 < values["ratio_lowest"] <= values["ratio_median"] <= values["ratio_highest"]


def test_a_benchmark_that_does_not_exist_is_refused_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "speed"]) == 2
    assert "there are collect, plan, or all" in capsys.readouterr().err
