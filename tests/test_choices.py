"""The measurements behind settings run, and leave their tables."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsmlib.storage import artifacts, tables
from tsmlib.study import runs

sys.path.insert(0, str(runs.ROOT / "benchmarks" / "settings"))

import as_published
import spent

ARM = ["--env", "tsm/Reacher-v0"]
TRIES = [("half the batch",), ("twice the batch, half the updates",)]
TINY = {  # options, the columns that tell tries apart, and the tries
    "samples": ([*ARM, "--samples", "2", "4", "--episodes", "4"], ("samples",), [(2,), (4,)]),
    "learning_rates": ([*ARM, "--models", "onestep", "--share", "0.1"], ("rate",), [(2e-3,), (4e-3,), (8e-3,)]),
    "budget": ([*ARM, "--stages", "1"], ("configuration",), TRIES),
    "starts": (
        ["--targets", "2", "--iterations", "1", "--weights", "1"],
        ("search_space", "start"),
        [("direct", 0), ("direct", 0.1), ("direct", 0.5), ("latent", 1)],
    ),
}


@pytest.mark.parametrize("name", TINY)
def test_the_measurement_behind_a_setting_leaves_a_row_for_each_try(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path))
    script, table = runs.ROOT / "benchmarks" / "settings" / f"{name}.py", tmp_path / "table.csv"
    options, columns, tries = TINY[name]
    command = [sys.executable, script, "--scale", "smoke", "--out", str(table), *options]
    subprocess.run(command, capture_output=True, text=True, check=True)
    rows = tables.records(tables.load(table))
    assert sorted({tuple(row[column] for column in columns) for row in rows}) == tries
    assert len({row["metric"] for row in rows}) * len(tries) == len(rows)


def table(path: Path, *values: tuple[int, float], **columns: Any) -> as_published.Found:
    row = dict(env="e", sim="mujoco", task="", model="tsm", planner="none", execution="open loop")
    rows = [row | dict(n=1, unit="", scale="paper", seed=seed, value=value) | columns for seed, value in values]
    tables.save(path, rows)
    return as_published.read(path)


def test_a_run_is_held_against_the_published_seeds_that_are_not_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    published = table(tmp_path / "all.csv", (0, 0.8), (1, 99.0), (2, 1.2), (3, 1.0), metric="ll_paper")
    for value, said in ((1.98, "0 of 1 outside"), (2.01, "1 of 1 outside"), (0.5, "of 1, 0 better")):  # 1 + 0.99
        as_published.compare(table(tmp_path / "own.csv", (1, value), metric="ll_paper"), published)
        assert said in capsys.readouterr().out
    as_published.compare(table(tmp_path / "own.csv", (1, 1.0), metric="nrmse"), published)
    assert "1 not compared" in capsys.readouterr().out


def test_returns_are_those_of_plans_and_of_policies_when_they_are_learned(tmp_path: Path) -> None:
    path, earned = tmp_path / "own.csv", dict(metric="return_true")
    assert not table(path, (1, -4.0), **earned, iteration=3)
    assert not table(path, (1, -4.0), **earned, model="oracle", planner="cem")
    rows = [
        dict(env="e", sim="mujoco", task="", model="tsm", planner="policy", search_space="latent", n=1,
             iteration=updates, execution="policy", unit="", scale="paper", seed=1, value=value, copy=copy, **earned)
        for updates, copy, value in ((0, 0, -9.0), (0, 1, -9.0), (20, 0, -4.0), (20, 1, -2.0))
    ]  # fmt: skip
    tables.save(path, rows, extra=["copy"])
    assert [list(seeds.values()) for seeds in as_published.read(path).values()] == [[-3.0]]


def test_what_was_made_is_told_from_the_name_of_its_file() -> None:
    said = {
        "models/Reacher/tsm+energy.safetensors": "models, Reacher",
        "models/Reacher-delay5/lstm.safetensors": "models, Reacher-delay5",
        "models/Reacher/policy-tsm+energy+direct-latent.safetensors": "policies, tsm+energy+direct-latent",
        "plans/Reacher-oracle-latent-cem-every10.safetensors": "plans, oracle",
        "plans/Reacher-ensemble+mse-latent-cem-every10.safetensors": "plans, cem-every10",
    }
    assert {name: spent.kind(Path(name)) for name in said} == said


def test_the_plan_that_a_closed_loop_begins_with_is_counted_once(tmp_path: Path) -> None:
    for name, seconds in (("e-tsm-latent-cem", 3.0), ("e-tsm-latent-cem-every10", 10.0)):
        path = tmp_path / f"{name}.safetensors"
        artifacts.save(path, {"actions": np.zeros(1, np.float32)}, kind="plan", header={"seconds": seconds})
    assert spent.took(path) == 7.0
