"""Benchmarks run, compare equal work, and leave their tables. How fast anything is, no test asserts."""

from __future__ import annotations

import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

from tsmlib import runs, store
from tsmlib.__main__ import main

TINY = {
    "collect": ["--episodes", "6", "--loop-episodes", "2", "--rounds", "2"],
    "plan": ["--targets", "2", "--iterations", "1", "--samples", "1", "--rounds", "2"],
    "trust": ["--steps", "4", "--loads", "1", "--rounds", "2"],
    "policy": ["--copies", "2", "--iterations", "1", "--rounds", "2"],
}

RATIOS = {"ratio_lowest", "ratio_median", "ratio_highest"}
SPEEDS = {"steps_per_second", "steps_per_core_second", *RATIOS}
ROWS = {  # condition -> metrics
    "collect": {"bulk": SPEEDS, "env.step": SPEEDS, "mj_step": SPEEDS, "": {"peak_bytes"}},
    "trust": {"checkpoints": RATIOS, "load": {"seconds"}, "checks": {"seconds"}},
    "plan": {
        "plan": {"plan_seconds", *RATIOS},
        **{
            part: {"seconds"}
            for part in ("simulate", "codes to torques", "torques to states", "gradients and the rest")
        },
    },
    "policy": {"extrapolated": {"seconds"}, "copies": {"peak_bytes", *RATIOS}},
}


@pytest.mark.parametrize("name", TINY)
def test_a_benchmark_states_ratios_with_their_spread(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path))
    script = runs.ROOT / "benchmarks" / f"{name}.py"
    # collect ends with an error where two ways reach states that differ in any bit
    printed = subprocess.run([sys.executable, script, *TINY[name]], capture_output=True, text=True, check=True).stdout
    assert "2 rounds" in printed
    values: dict[str, dict[str, float]] = defaultdict(dict)
    for row in store.load_table(tmp_path / "bench" / f"{name}.csv"):
        values[row["condition"]][row["metric"]] = row["value"]
    assert {condition: set(metrics) for condition, metrics in values.items()} == ROWS[name]
    for metrics in values.values():
        if set(metrics) >= RATIOS:
            assert metrics["ratio_lowest"] <= metrics["ratio_median"] <= metrics["ratio_highest"]


def test_a_benchmark_that_does_not_exist_is_refused_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "speed"]) == 2
    assert "there are collect, plan, policy, trust, or all" in capsys.readouterr().err
