"""Scripts of benchmarks/: what can be tried without the libraries that they measure against."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import tsmlib
from tsmlib.pretrained import ROOT

SCRIPTS = sorted((ROOT / "benchmarks").rglob("*.py"))


def loaded(path: Path) -> ModuleType:
    """A script as a module, without running it."""
    spec = importlib.util.spec_from_file_location(f"script_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_starts_without_the_libraries_that_it_measures(path: Path) -> None:
    assert "\nif __name__ == " in path.read_text()
    assert loaded(path)


@pytest.fixture(scope="module")
def free() -> ModuleType:
    return loaded(ROOT / "benchmarks" / "model_free" / "model_free.py")


@pytest.mark.parametrize("env", ["tsm/Reacher-v0", "tsm/ReacherPush-v1", "Pendulum-v1"])
def test_without_a_model_one_learns_for_the_same_reward(free: ModuleType, env: str) -> None:
    """What a step pays is what the task pays for the same states and actions."""
    episodes, rng = free.Episodes(env, 3, seed=1), np.random.default_rng(0)
    seen = episodes.reset()
    assert seen.dtype == np.float32
    total, steps, over = np.zeros(3), 0, False
    while not over:
        size = (3, episodes.task.action_dim)
        seen, reward, over = episodes.step(rng.uniform(-2, 2, size).astype(np.float32))
        total, steps = total + reward, steps + 1
        assert np.isfinite(seen).all()
        assert reward.shape == (3,)
    assert steps == episodes.task.horizon
    assert (total < steps).all()


def test_a_policy_that_does_nothing_is_measured_as_doing_nothing(free: ModuleType) -> None:
    episodes = free.Episodes("tsm/Reacher-v0", 1, seed=0)
    found = free.measured(episodes, lambda seen: np.zeros((len(seen), 2)))
    task = tsmlib.load_task("tsm/Reacher-v0")
    idle = tsmlib.execute(task, torch.zeros(len(task), task.horizon, 2))
    assert found["return_true"] == pytest.approx(float(idle.executed_return.mean()), abs=1e-5)
    assert found["final_distance"] == pytest.approx(float(idle.final_distance.mean()), abs=1e-5)
