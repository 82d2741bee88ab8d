"""``--device``: models are trained, rolled out, planned with and learned in on an accelerator as on the processor."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from accelerator import DEVICE, Accelerator
from test_axioms import DU, MODELS, Case, motion, new_prior
from torch import Tensor

from tsmlib import evaluate, runs
from tsmlib.__main__ import main
from tsmlib.dynamics import rollout
from tsmlib.policy import OneStepPolicy, SegmentPolicy, controller, improve
from tsmlib.rewards import Reward
from tsmlib.train import fit
from tsmlib.trajectory import Segment, Trajectories, initial_past
from tsmlib.trajopt import DirectActions, LatentActions, Planner, Space, adam, cem, through_model

PROCESSOR, HORIZON, TARGETS = "cpu", 20, 3


@pytest.fixture(params=[DEVICE, *["cuda"] * torch.cuda.is_available()])
def device(request: pytest.FixtureRequest) -> Iterator[str]:
    """An accelerator: one that the processor imitates, and a real one where there is one."""
    if request.param != DEVICE:
        yield request.param
        return
    with Accelerator() as accelerator:
        yield DEVICE
    assert accelerator.count, "nothing ran on it"


@pytest.fixture(params=MODELS.values(), ids=MODELS.keys())
def case(request: pytest.FixtureRequest) -> Case:
    return request.param


def agree(found: Tensor, expected: Tensor) -> bool:
    """On the same device, and equal up to rounding."""
    return found.device == expected.device and torch.allclose(found, expected, rtol=1e-3, atol=1e-4)


def episodes(case: Case, n: int, seed: int) -> Trajectories:
    seen = motion(case, n, 31, seed=seed)
    names = tuple(f"x{i}" for i in range(case.state_dim))
    return Trajectories(
        seen.states.float().numpy(),
        seen.actions[:, 1:].float().numpy(),
        "tsm/Made-v0",
        0.02,
        names,
        ("m",) * len(names),
    )


def new_model(name: str = "tsm") -> Any:
    return MODELS[name].model(torch.float32)


def to_the_origin(states: Tensor, actions: Tensor) -> Tensor:
    return -states[..., :2].square().sum(-1) - actions.square().sum(-1)


def test_a_model_trained_on_it_comes_back_the_same(case: Case, device: str) -> None:
    data, held_out = episodes(case, 12, 0), episodes(case, 4, 1)
    for loss, _ in case.losses:
        trained = {}
        for place in (PROCESSOR, device):
            model = case.model(torch.float32)
            settings: dict[str, Any] = dict(steps=2, batch_size=4, validate_every=2, device=place)
            fit(model, getattr(model, loss), data, held_out, past_len=model.past_len, future_len=10, **settings)
            trained[place] = model.state_dict()
        for name, expected in trained[PROCESSOR].items():
            assert agree(trained[device][name], expected), (loss, name)


def test_a_training_that_stopped_on_it_goes_on_there_or_elsewhere(device: str, tmp_path: Path) -> None:
    data, held_out = episodes(MODELS["tsm"], 12, 0), episodes(MODELS["tsm"], 4, 1)

    def trained(*places: str) -> dict[str, Tensor]:
        """To its end on the last of ``places``, stopped once at step 2 on each other."""
        folder = tmp_path / "-".join(places)
        for place in places:
            model = new_model()
            calls = 0

            def loss(window: Any, generator: Any, model: Any = model, place: str = place) -> Tensor:
                nonlocal calls
                calls += 1
                if place != places[-1] and calls == 4:  # two updates, a validation
                    raise KeyboardInterrupt
                return model.loss(window, generator)

            settings: dict[str, Any] = dict(steps=4, batch_size=8, validate_every=2, device=place, checkpoint=folder)
            try:
                fit(model, loss, data, held_out, past_len=10, future_len=10, **settings)
            except KeyboardInterrupt:
                assert next(model.parameters()).device.type == PROCESSOR
        return model.state_dict()

    expected = trained(PROCESSOR)
    with pytest.warns(UserWarning, match="device"):
        moved = trained(device, PROCESSOR)
    for found in (trained(device, device), moved):
        assert all(agree(found[name], expected[name]) for name in expected)


def test_a_model_there_is_rolled_out_from_here(case: Case, device: str) -> None:
    model, seen = case.model(torch.float32), motion(case, 6, 40)
    past = Segment(*(part[:, :10].float() for part in seen)).last(model.past_len)
    actions = seen.actions[:, 10:].float()
    expected = [rollout(model, past, actions, generator=g) for g in (None, torch.Generator().manual_seed(0))]
    model.to(device)
    found = [rollout(model, past, actions, generator=g) for g in (None, torch.Generator().manual_seed(0))]
    assert all(agree(a, b) for a, b in zip(found, expected, strict=True))


def test_it_scores_as_the_processor_does(case: Case, device: str) -> None:
    data, held_out = episodes(case, 6, 2), episodes(case, 5, 3)
    model = case.model(torch.float32)
    features = case.model(torch.float32).features
    there, here = (
        evaluate.score(model.to(place), features, data, held_out, samples=3, horizon=20)
        for place in (device, PROCESSOR)
    )
    assert all(agree(there.values[metric], here.values[metric]) for metric in here.values)


@pytest.mark.parametrize("planner", [partial(adam, iterations=1), partial(cem, candidates=4, elites=2, iterations=1)])
@pytest.mark.parametrize("over", ["codes", "actions"])
def test_it_finds_the_same_plan(planner: Planner, over: str, device: str) -> None:
    start = motion(MODELS["tsm"], TARGETS, 2).states[:, 0].float()

    def found(place: str) -> tuple[Tensor, ...]:
        model, prior = new_model().to(place), new_prior().float().to(place)
        space: Space = LatentActions(prior, HORIZON) if over == "codes" else DirectActions(HORIZON)
        predict = through_model(model, initial_past(start, model.past_len, DU), samples=2)
        plan = planner(predict, to_the_origin, space, TARGETS)
        left, parameters = space.after(plan.parameters, 7)  # what a closed loop goes on from
        return plan.actions, plan.predicted, left.decode(parameters[None])

    assert all(agree(there, here) for there, here in zip(found(device), found(PROCESSOR), strict=True))


@pytest.mark.parametrize("through", ["codes", "actions"])
def test_a_policy_learned_there_is_the_same_and_acts_here(through: str, device: str) -> None:
    seen = motion(MODELS["tsm"], 8, 20)
    starts = seen.states[:, 0].float()

    def reward(target: Tensor) -> Reward:
        return lambda states, actions: -(states[..., :2] - target[:, None]).square().sum(-1)

    def learned(place: str) -> tuple[Any, Tensor]:
        if through == "codes":
            policy: Any = SegmentPolicy(6, new_prior().float(), channels=8, copies=2)
        else:
            policy = OneStepPolicy(6, DU, copies=2)

        def draw(n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
            return starts[torch.randint(8, (n,), generator=generator)], torch.randn(n, 2, generator=generator)

        model = new_model()
        improve(policy.to(place), model.to(place), reward, draw, horizon=12, iterations=2, episodes=3)
        past = Segment(*(part[:4, :10].float() for part in seen))
        return policy, controller(policy, torch.zeros(4, 2))(past)

    (there, act), (here, expected) = learned(device), learned(PROCESSOR)
    assert agree(act, expected)
    for a, b in zip(there.cpu().parameters(), here.parameters(), strict=True):
        assert agree(a, b)


def test_the_imitated_one_refuses_tensors_of_two_devices() -> None:
    with Accelerator():
        there = torch.ones(3).to(DEVICE)
        for on_it in (there + 1, there[torch.tensor([0, 2])]):
            assert on_it.device.type == DEVICE
        with pytest.raises(RuntimeError, match="a tensor of the processor"):
            there + torch.ones(3)


@pytest.mark.parametrize("word", ["tpu", "cuda:x", "gpu", "cuda:1234", "CUDA"])
def test_an_unknown_device_is_refused(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "collect", "--device", word]) == 2
    assert f"--device is '{word}', expected cpu, cuda" in capsys.readouterr().err


def test_a_device_that_is_not_there_is_refused_before_anything_starts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("TSM_DEVICE", "cpu")  # so that it is put back
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["run", "collect", "--device", "cuda"]) == 2
    assert "device is cuda, but torch" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_a_run_knows_its_device(monkeypatch: pytest.MonkeyPatch) -> None:
    assert runs.resolve("03_predict").device == "cpu"
    monkeypatch.setenv("TSM_DEVICE", "cuda:1")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert runs.resolve("03_predict").device == "cuda:1"
