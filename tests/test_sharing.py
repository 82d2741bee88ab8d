"""Models leave as folders, Hub repositories and graphs, and come back the same; predictions get
intervals that hold."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch

import tsmlib
from tsmlib.contrib.stable_worldmodel import Cost, Solver
from tsmlib.evaluation.conformal import Conformal
from tsmlib.storage.files import StoreError

ENV = "tsm/ReacherPush-v1"
STEPS = {"onestep": 3, "rtsm": 11, "tsm": 11}  # one more than a segment
ALL = STEPS | {"lstm": 3, "egocentric": 3}


def same(one: torch.nn.Module, other: torch.nn.Module) -> bool:
    pairs = zip(one.state_dict().items(), other.state_dict().items(), strict=True)
    return all(a == b and torch.equal(x, y) for (a, x), (b, y) in pairs)


def test_a_model_comes_back_from_a_folder_with_its_robot_and_a_card(tmp_path: Path) -> None:
    model = tsmlib.load_pretrained("onestep", env=ENV)
    model.save_pretrained(tmp_path / "mine", scores={"energy score": 0.25})
    again = tsmlib.OneStep.from_pretrained(tmp_path / "mine")
    assert same(model, again)
    assert again.robot == model.robot
    card = (tmp_path / "mine" / "README.md").read_text()
    assert "library_name: tsmlib" in card
    assert "| energy score | 0.25 |" in card
    assert f"| env | {ENV} |" in card
    about = json.loads((tmp_path / "mine" / "config.json").read_text())
    assert about["config"] == json.loads(json.dumps(model.config()))
    with pytest.raises(StoreError, match="holds a 'OneStep', expected a LSTM"):
        tsmlib.LSTM.from_pretrained(tmp_path / "mine")
    with pytest.raises(StoreError, match="does not exist"):
        tsmlib.LSTM.from_pretrained(tmp_path / "none")


def test_a_model_goes_to_the_hub_and_comes_from_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, uploaded = tsmlib.load_pretrained("prior", env=ENV), tmp_path / "hub"

    def upload_folder(repo_id: str, folder_path: str) -> str:
        uploaded.mkdir()
        for path in Path(folder_path).iterdir():
            (uploaded / path.name).write_bytes(path.read_bytes())
        return f"https://hub/{repo_id}"

    made: list[tuple[str, bool]] = []
    fake = SimpleNamespace(
        create_repo=lambda name, private, exist_ok: made.append((name, private)),
        upload_folder=upload_folder,
        hf_hub_download=lambda name, file: str(uploaded / file),
    )
    monkeypatch.setitem(sys.modules, "huggingface_hub", fake)
    assert model.push_to_hub("me/prior", private=True) == "https://hub/me/prior"
    assert made == [("me/prior", True)]
    assert same(tsmlib.ActionPrior.from_pretrained("me/prior"), model)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ImportError, match=r"pip install 'tsmlib\[hub\]'"):
        tsmlib.ActionPrior.from_pretrained("me/prior")


def rollout_of(word: str, steps: int) -> tuple[torch.nn.Module, tuple[torch.Tensor, ...]]:
    env = "tsm/PushT-v0" if word == "egocentric" else ENV
    model, task = tsmlib.load_pretrained(word, env=env), tsmlib.load_task(env).take(2)
    actions = 0.1 * torch.randn(2, steps, 2, generator=torch.Generator().manual_seed(0))
    return model, (*task.past(model.past_len), actions)


@pytest.mark.parametrize(("word", "steps"), STEPS.items())
def test_an_exported_program_predicts_what_the_model_does(
    word: str, steps: int, tmp_path: Path
) -> None:
    model, (states, moves, actions) = rollout_of(word, steps)
    tsmlib.export(model, tmp_path / "model.pt2", steps=steps, rows=2)
    program = torch.export.load(tmp_path / "model.pt2").module()
    expected = tsmlib.rollout(model, (states, moves), actions)
    torch.testing.assert_close(program(states, moves, actions), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("word", "steps"), ALL.items())
def test_an_onnx_file_predicts_what_the_model_does(word: str, steps: int, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    model, (states, moves, actions) = rollout_of(word, steps)
    tsmlib.export(model, tmp_path / "model.onnx", steps=steps, rows=2)
    session = runtime.InferenceSession(str(tmp_path / "model.onnx"))
    given = dict(past_states=states.numpy(), past_actions=moves.numpy(), actions=actions.numpy())
    (found,) = session.run(["states"], given)
    expected = tsmlib.rollout(model, (states, moves), actions)
    torch.testing.assert_close(torch.from_numpy(found), expected, rtol=1e-5, atol=1e-5)


def test_an_export_without_its_extra_or_with_another_ending_says_what_to_type(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, _ = rollout_of("onestep", 1)
    monkeypatch.setattr("tsmlib.models.export.NEEDED", ("no_such_module",))
    with pytest.raises(ImportError, match=r"pip install 'tsmlib\[onnx\]', or name model.pt2"):
        tsmlib.export(model, tmp_path / "model.onnx")
    with pytest.raises(ValueError, match="ends in .onnx or .pt2"):
        tsmlib.export(model, tmp_path / "model.bin")


def test_intervals_hold_what_they_promise_for_a_biased_prediction_and_any_noise() -> None:
    rng, held = np.random.default_rng(0), []
    for _ in range(400):
        predicted = rng.normal(size=(150, 3))
        actual = predicted - rng.exponential(size=(150, 3)) ** 2
        fitted = Conformal.fit(predicted[:50], actual[:50], 0.9)
        held.append(fitted.coverage(predicted[50:], actual[50:]))
    assert np.mean(held, axis=0) == pytest.approx(47 / 51, abs=0.01)  # 2 of 50 on each side


def test_intervals_of_too_few_pairs_or_of_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="18 pairs cannot calibrate .* expected at least 19"):
        Conformal.fit(np.zeros(18), np.ones(18))
    Conformal.fit(np.zeros(19), np.ones(19))
    with pytest.raises(ValueError, match="actual has shape"):
        Conformal.fit(np.zeros((30, 2)), np.ones(30))
    with pytest.raises(ValueError, match="level is 1"):
        Conformal.fit(np.zeros(30), np.ones(30), 1.0)


def costs(count: int, samples: int) -> tuple[Cost, dict[str, torch.Tensor], torch.Tensor]:
    """What a solver of stable-worldmodel hands over: histories and candidates of several starts."""
    task = tsmlib.load_task(ENV).take(count)
    start = torch.as_tensor(task.start)[:, None, None].expand(-1, samples, 3, -1)
    draw = torch.Generator().manual_seed(0)
    candidates = 0.2 * torch.randn(count, samples, 10, 2, generator=draw)
    model = tsmlib.load_pretrained("onestep", env=ENV)
    return Cost(model, task.reward), {"state": start}, candidates


def test_a_cost_for_stable_worldmodel_is_minus_the_return_that_our_search_maximises() -> None:
    cost, info, candidates = costs(3, 4)
    found = cost.get_cost(info, candidates.requires_grad_())
    task = tsmlib.load_task(ENV).take(3)
    predict = tsmlib.model_predictor(cost.model, task.past(cost.model.past_len))
    moves = candidates.detach().clamp(-1, 1).transpose(0, 1)  # (S, B, T, du)
    expected = -cost.reward(predict(moves)[0], moves).sum(-1).T
    torch.testing.assert_close(found, expected)
    (slope,) = torch.autograd.grad(found.sum(), candidates)
    assert slope.abs().sum() > 0
    with pytest.raises(KeyError, match="no 'state' among pixels"):
        cost.get_cost({"pixels": info["state"]}, candidates)


def test_a_search_of_ours_is_a_solver_that_their_policy_can_execute() -> None:
    cost, info, _ = costs(2, 1)
    space, block = tsmlib.DirectActions(10, 2, rms=0.1), 2

    def search(past: tsmlib.Segment) -> tsmlib.Plan:
        predict = tsmlib.model_predictor(cost.model, past)
        return tsmlib.cem(predict, cost.reward, space, 2, candidates=8, elites=2, iterations=1)

    solver = Solver(search, cost.model.past_len)
    config = SimpleNamespace(horizon=10 // block, action_block=block)
    solver.configure(
        action_space=gymnasium.spaces.Box(-1, 1, (2, 2), np.float32), n_envs=2, config=config
    )
    found = solver({"state": info["state"][:, 0]})["actions"]
    assert found.shape == (2, solver.horizon, solver.action_dim) == (2, 5, 4)
    wide = Cost(cost.model, cost.reward, action_block=block)
    actions = found.reshape(2, 1, 10, 2)  # each of theirs is two of ours, in turn
    torch.testing.assert_close(wide.get_cost(info, found[:, None]), cost.get_cost(info, actions))


def test_the_solver_of_stable_worldmodel_finds_cheaper_plans_by_our_cost() -> None:
    theirs = pytest.importorskip("stable_worldmodel")
    solvers = theirs.planning.solver if hasattr(theirs, "planning") else theirs.solver  # 0.1.1
    cost, info, _ = costs(2, 32)
    solver = solvers.CEMSolver(cost, batch_size=2, num_samples=32, n_steps=4, topk=6)
    space = gymnasium.spaces.Box(-1, 1, (2, 2), np.float32)
    config = SimpleNamespace(horizon=10, action_block=1)
    solver.configure(action_space=space, n_envs=2, config=config)
    found = solver.solve({"state": info["state"][:, 0]})["actions"]
    still = torch.zeros(2, 32, 10, 2)
    best = cost.get_cost(info, found[:, None].expand_as(still))
    assert (best < cost.get_cost(info, still)).all()
