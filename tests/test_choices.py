"""The measurements behind settings run, and leave their tables."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tsmlib import runs, store

sys.path.insert(0, str(runs.ROOT / "benchmarks" / "choices"))

import as_published
import spent

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


def test_a_run_is_held_against_the_spread_of_the_published_seeds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def table(name: str, *values: tuple[int, float], **columns: Any) -> Path:
        row = dict(env="e", sim="mujoco", task="", model="tsm", planner="none", prior="", horizon="", condition="clean")
        rows = [row | dict(n=1, unit="", scale="paper", seed=seed, value=value) | columns for seed, value in values]
        store.save_table(tmp_path / name, rows)
        return tmp_path / name

    score, earned = dict(metric="ll_paper"), dict(metric="return_true", planner="cem", horizon=50)
    published = as_published.read(table("three.csv", (0, 1.0), (1, 1.2), (2, 0.8), **score))
    for value, outside in ((1.5, 0), (9.0, 1)):
        as_published.compare(as_published.read(table("own.csv", (1, value), **score)), published)
        assert f"{outside} of 1 lie outside" in capsys.readouterr().out
    published = as_published.read(table("one.csv", (0, -4.0), **earned))
    for value, better in ((-3.0, 1), (-5.0, 0)):
        as_published.compare(as_published.read(table("own.csv", (1, value), **earned)), published)
        assert f"{better} of 1 returns are better" in capsys.readouterr().out


def test_what_was_made_is_told_from_the_name_of_its_file() -> None:
    said = {
        "models/Reacher/tsm+energy.safetensors": "models, Reacher",
        "models/Reacher-delay5/lstm.safetensors": "models, Reacher-delay5",
        "models/Reacher/policy-tsm+energy+direct-codes.safetensors": "policies, tsm+energy+direct-codes",
        "plans/Reacher-oracle-codes-cem-every10.safetensors": "plans, oracle",
        "plans/Reacher-ensemble+mse-codes-cem-every10.safetensors": "plans, cem-every10",
    }
    assert {name: spent.kind(Path(name)) for name in said} == said
