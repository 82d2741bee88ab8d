"""The page computes what the package does: the arm, the networks, and plans with them."""

from __future__ import annotations

import copy
import json
import os
import shutil
import subprocess
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

import gymnasium
import numpy as np
import pytest
import torch

from reproduction import explorer
from reproduction.runner import RunError
from tsmlib.collection import smooth_torques
from tsmlib.envs.geometry import HALF_RANGE
from tsmlib.models.base import rollout
from tsmlib.planning.execution import execute
from tsmlib.planning.planners import cem
from tsmlib.planning.predictors import model_predictor
from tsmlib.planning.search import evaluate
from tsmlib.planning.search_spaces import LatentActions
from tsmlib.planning.tasks import Task
from tsmlib.pretrained import ROOT, load_pretrained, load_task
from tsmlib.trajectory import Segment

NODE, BROWSER = shutil.which("node"), shutil.which("chromium") or shutil.which("google-chrome")
PAGE = ROOT / "explorer" / "dist"
ENVS = {
    "push": "tsm/ReacherPush-v1",
    "obstacle": "tsm/ReacherObstacle-v0",
    "reach": "tsm/Reacher-v0",
}
MODELS = ("rtsm", "tsm", "lstm", "onestep")
STEPS = (
    50  # further on, contacts and the one-step model amplify the rounding of float32, also in torch
)

pytestmark = [
    pytest.mark.skipif(NODE is None, reason="node is not installed"),
    pytest.mark.skipif(
        not (PAGE / "kernel.wasm").exists(), reason="the page is not built: make explorer"
    ),
]


def ask(*questions: dict[str, Any]) -> list[Any]:
    """The answers of explorer/test/engine.mjs."""
    command = [str(NODE), str(ROOT / "explorer" / "test" / "engine.mjs")]
    done = subprocess.run(
        command, input=json.dumps(questions), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def torques(n: int, steps: int = 100) -> torch.Tensor:
    return smooth_torques(n, steps, generator=torch.Generator().manual_seed(5))


def driven(task: Task, steps: int) -> tuple[torch.Tensor, np.ndarray]:
    """Smooth torques (N, T, 2), and the float64 states (N, T, dx) that they lead to."""
    actions = torques(len(task), steps)
    env = gymnasium.make_vec(task.env, num_envs=len(task)).unwrapped
    env.reset(options={"states": task.start})
    return actions, env.rollout(actions.numpy())


def as_pasts(past: Segment) -> list[dict[str, list[float]]]:
    rows = zip(*(part.flatten(1).tolist() for part in past), strict=True)
    return [{"states": states, "actions": actions} for states, actions in rows]


def assert_near(found: Any, states: np.ndarray | torch.Tensor, tolerance: float) -> None:
    """Angles and positions within ``tolerance`` rad and m, velocities in their range."""
    unit = np.maximum(1.0, np.insert(HALF_RANGE[2:], 0, (1.0, 1.0)))[: states.shape[-1]]
    np.testing.assert_allclose(
        np.array(found).reshape(states.shape) / unit, np.asarray(states) / unit, 0, tolerance
    )


@pytest.mark.parametrize("task", ENVS)
def test_the_arm_in_the_page_moves_as_in_python(task: str) -> None:
    frozen = load_task(ENVS[task])
    actions, states = driven(frozen, 100)
    starts = frozen.start.astype(float).tolist()
    (found,) = ask(
        {"what": "physics", "task": task, "starts": starts, "actions": actions.flatten(1).tolist()}
    )
    if task == "push":
        assert (
            np.abs(states[:, -1, 6:8] - frozen.start[:, 6:8]).max(1) > 1e-3
        ).sum() >= 30  # objects that were met
    assert_near(found, states, 1e-9)


@torch.no_grad()
@pytest.mark.parametrize("task", ENVS)
def test_networks_in_the_page_predict_as_in_torch(task: str) -> None:
    # Where the object is met, rounding grows, and torch's own float32 is as far from float64.
    frozen, questions, expected = load_task(ENVS[task]), [], []
    past = frozen.past(10)
    actions = torques(len(frozen), STEPS)
    exact = Segment(*(part.double() for part in past))
    for word in MODELS:
        model = load_pretrained(word, env=ENVS[task])
        states = rollout(model, past, actions)
        rounded = states - rollout(copy.deepcopy(model).double(), exact, actions.double())
        expected.append((states, rounded.abs().amax((1, 2)).numpy()))
        asked = {"what": "rollout", "task": task, "model": word, "pasts": as_pasts(past)}
        questions.append(asked | {"actions": actions.flatten(1).tolist()})
    for found, (states, rounding) in zip(ask(*questions), expected, strict=True):
        apart = np.array(found).reshape(states.shape) - states.numpy()
        assert (np.abs(apart).max((1, 2)) > 1e-4).sum() <= 1  # of 100 episodes
        for row, its in zip(apart, rounding, strict=True):
            assert_near(row, np.zeros_like(row), max(1e-4, 10 * its))


@torch.no_grad()
def test_a_candidate_is_worth_what_its_mode_returns() -> None:
    task, model = load_task(ENVS["push"]).take(20), load_pretrained("rtsm", env=ENVS["push"])
    space = LatentActions(load_pretrained("prior", env=task.env), task.horizon)  # type: ignore[arg-type]
    codes = torch.randn(1, 20, 10, 8, generator=torch.Generator().manual_seed(3))
    wanted = evaluate(model_predictor(model, task.past(10)), task.reward, space, codes)[0]
    asked = {"what": "judge", "task": "push", "model": "rtsm", "pasts": as_pasts(task.past(10))}
    (found,) = ask(asked | {"targets": task.target.tolist(), "codes": codes[0].flatten(1).tolist()})
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-3)


@torch.no_grad()
@pytest.mark.parametrize("task", ENVS)
def test_codes_of_the_prior_are_the_same_torques_as_in_torch(task: str) -> None:
    prior, before = load_pretrained("prior", env=ENVS[task]), torques(1, 40)[:, 30:]
    codes = torch.randn(1, 20, 10, 8, generator=torch.Generator().manual_seed(2))
    wanted = LatentActions(prior, 100, past=before.expand(20, -1, -1)).decode(codes)[0]  # type: ignore[arg-type]
    asked = {"what": "decode", "task": task, "past": before.flatten().tolist()}
    (found,) = ask(asked | {"codes": codes[0].flatten(1).tolist()})
    np.testing.assert_allclose(
        np.array(found).reshape(wanted.shape), wanted.numpy(), rtol=0, atol=1e-5
    )


@torch.no_grad()
def test_a_plan_of_the_page_is_worth_what_it_is_in_python() -> None:
    """The same search with other random numbers gives a mean among those of Python's seeds."""
    frozen, word = load_task(ENVS["reach"]).take(6), "onestep"
    search, asked = (
        {"candidates": 32, "iterations": 4},
        {"what": "plan", "task": "reach", "model": word, "space": "latent"},
    )
    asked |= {
        "starts": frozen.start.astype(float).tolist(),
        "targets": frozen.target.tolist(),
        "seed": 1,
    }
    (found,) = ask(asked | {"first": search, "rounds": 1})
    model, prior = load_pretrained(word, env=frozen.env), load_pretrained("prior", env=frozen.env)
    space, predict = LatentActions(prior, frozen.horizon), model_predictor(model, frozen.past(10))  # type: ignore[arg-type]
    executed = torch.stack(
        [
            execute(
                frozen,
                cem(predict, frozen.reward, space, len(frozen), elites=3, seed=seed, **search),
            ).executed_return
            for seed in range(4)
        ]
    )
    mean, spread = float(executed.mean()), float(executed.mean(1).std())
    assert abs(np.mean([one["executed"] for one in found]) - mean) < 4 * spread
    assert all(one["success"] == (one["distance"] < frozen.tolerance) for one in found)


def test_searching_on_never_leaves_a_worse_plan_than_the_first_search() -> None:
    task = load_task(ENVS["push"]).take(3)
    asked = {"what": "plan", "task": "push", "model": "onestep", "space": "latent", "seed": 1}
    asked |= {"starts": task.start.astype(float).tolist(), "targets": task.target.tolist()}
    asked |= {"first": {"candidates": 16, "iterations": 2}}
    first, best = ask(asked | {"rounds": 1}, asked | {"rounds": 3})
    gains = [b["predicted"] - a["predicted"] for a, b in zip(first, best, strict=True)]
    assert min(gains) >= 0 < max(gains)


def test_a_link_that_was_edited_by_hand_is_refused_in_one_sentence() -> None:
    wrong = {
        "task=fly": "it names a task that is none of push, obstacle, reach",
        "model=pets": "it names a model that is none of rtsm, tsm, lstm, onestep",
        "space=both": "its search space is neither latent nor direct",
        "seed=1.5": "its seed is no whole number from 0 to 1,000,000,000",
        "target=nowhere": "its target is not two numbers",
        "target=0.1": "its target is not two numbers",
        "block=0.1,": "its block is not two numbers",
        "arm=0,9": "the arm does not bend that far",
        "target=0.1,7": "its target is out of reach",
        "block=0.1,-7": "its object lies outside the walls",
        "arm=0,0&block=0.1,0": "its object overlaps the arm",
    }
    (found,) = ask({"what": "link", "links": ["", "#task=reach&seed=7", *wrong]})
    assert found[:2] == ["", ""]
    said = "This link cannot be restored: {}. Here is the first scene instead."
    assert found[2:] == [said.format(what) for what in wrong.values()]


@pytest.fixture
def address() -> Iterator[str]:
    """The page, served as ``python -m tsmlib explore`` does."""
    with explorer.server(port=0) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{running.server_port}/"
        running.shutdown()
        thread.join()


def test_files_are_served_with_their_types_to_this_machine_alone(address: str) -> None:
    types = {
        "": "text/html",
        "src/app.js": "text/javascript",
        "vendor/mujoco.wasm": "application/wasm",
    }
    for path, kind in types.items():
        with urllib.request.urlopen(address + path) as answer:
            assert answer.headers["Content-Type"].partition(";")[0] == kind
            assert answer.headers["Cache-Control"] == "no-cache"
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(address + "src/")


def test_nothing_of_the_page_comes_from_elsewhere() -> None:
    for path in (ROOT / "explorer").glob("src/*.js"):
        assert "http://" not in path.read_text().replace("http://www.w3.org/", ""), path
        assert "https://" not in path.read_text(), path
    locked = json.loads((ROOT / "explorer" / "package-lock.json").read_text())["packages"].values()
    assert {urlparse(one["resolved"]).netloc for one in locked if "resolved" in one} <= {
        "registry.npmjs.org"
    }


def test_a_page_that_is_not_built_says_how(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="make explorer"):
        explorer.server(tmp_path)


@pytest.mark.skipif(BROWSER is None, reason="Chromium is not installed; the page is tried in it")
def test_a_person_can_use_the_page(address: str) -> None:
    """Drag, plan, switch, tour, link, keys, a small dark screen, what cannot work: page.mjs."""
    command = [str(NODE), str(ROOT / "explorer" / "test" / "page.mjs"), address]
    env = {**os.environ, "CHROMIUM": str(BROWSER)}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
