"""What stands between mbrl-lib's networks and our scores. Stand-ins take the networks' place: no mbrl-lib is needed."""

from __future__ import annotations

import importlib.util
import re
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from tsmlib import store
from tsmlib.dynamics import rollout
from tsmlib.nets import Features, SharedNoise
from tsmlib.runs import ROOT
from tsmlib.trajectory import Segment, Trajectories

FOLDER = ROOT / "benchmarks" / "peers"
MEMBERS, DX, DU, FIXED = 5, 8, 2, (6, 7)  # an arm and an obstacle, which never moves


def load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("pets", FOLDER / "pets.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


pets = load()


@pytest.fixture
def data() -> Trajectories:
    generator = torch.Generator().manual_seed(0)
    walk = torch.randn(20, 31, DX, generator=generator).cumsum(1) * torch.logspace(-2, 0, DX)
    walk[..., FIXED] = walk[:, :1, FIXED]
    actions = torch.rand(20, 30, DU, generator=generator)
    return Trajectories(walk.numpy(), actions.numpy(), "arm", 0.02, ("x",) * DX, ("m",) * DX)


@pytest.fixture
def features(data: Trajectories) -> Features:
    return Features(DX, data.angles).fit(torch.from_numpy(data.states))


def by_member(inputs: Tensor) -> tuple[Tensor, None]:
    """Member m moves every dimension by m + 1 units a step."""
    steps = torch.arange(1.0, MEMBERS + 1)[:, None, None]
    return steps.expand(MEMBERS, inputs.shape[1], DX), None


def future(data: Trajectories, model: Any, seed: int | None = 0, rows: int = 20, steps: int = 12) -> tuple[Any, Tensor]:
    """Where each row starts (rows, 1, dx), and its rollout (rows, steps, dx)."""
    whole = data.padded(0)
    past = Segment(*(part[:rows, :10] for part in whole))
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    return past.states[:, -1:], rollout(model, past, whole.actions[:rows, 10 : 10 + steps], generator=generator)


def test_a_network_reads_features_of_the_last_state_and_the_action(data: Trajectories, features: Features) -> None:
    seen = []

    def network(inputs: Tensor) -> tuple[Tensor, None]:
        seen.append(inputs)
        return torch.zeros(*inputs.shape[:2], DX), None

    start, _ = future(data, pets.Peer(network, features), seed=None, steps=2)
    actions = torch.from_numpy(data.actions)
    for k, inputs in enumerate(seen):
        expected = torch.cat([features(start[:, 0]), actions[:, 10 + k]], dim=-1)
        assert torch.equal(inputs, expected.expand(MEMBERS, -1, -1))
    assert len(seen) == 2


def test_targets_have_unit_variance_and_undo_themselves(data: Trajectories, features: Features) -> None:
    before, actions, after = pets.transitions(data, pets.unit_of(features))
    target, moving = torch.from_numpy(after - before), features.moving
    assert before.shape == (600, DX)
    assert actions.shape == (600, DU)
    assert torch.allclose(target.std(0)[moving], torch.ones(DX - 2), atol=1e-3)
    assert (target[:, ~moving] == 0).all()

    class Rows:  # plays the recorded increments of episode 3 back, for every member
        steps = iter(target[3 * 30 + 10 :])

        def __call__(self, inputs: Tensor) -> tuple[Tensor, None]:
            return next(self.steps).expand(*inputs.shape[:2], DX), None

    _, states = future(data, pets.Peer(Rows(), features))
    assert torch.allclose(states[3], torch.from_numpy(data.states)[3, 11:23], atol=1e-4)


def test_a_row_keeps_its_member_for_the_whole_rollout(data: Trajectories, features: Features) -> None:
    peer = pets.Peer(by_member, features)
    start, states = future(data, peer)
    steps = torch.cat([start, states], dim=1).diff(dim=1)[..., features.moving] / features.step_std[features.moving]
    members = steps[:, 0, 0].round()
    assert torch.allclose(steps, members[:, None, None].expand_as(steps), atol=1e-2)
    assert set(members.tolist()) == {1.0, 2.0, 3.0, 4.0, 5.0}
    others = [future(data, peer, seed=seed)[1] for seed in (0, 1)]
    assert torch.equal(others[0], states)
    assert not torch.equal(others[1], states)


@pytest.mark.parametrize("rows", [1, 7])
def test_every_member_is_drawn_equally_often_whatever_the_number_of_rows(
    data: Trajectories, features: Features, rows: int
) -> None:
    drawn = []
    for seed in range(150):
        start, states = future(data, pets.Peer(by_member, features), seed=seed, rows=rows, steps=1)
        drawn.append((states - start)[-1, 0, 0] / features.step_std[0])
    shares = torch.stack(drawn).round().long().bincount(minlength=6)[1:] / 150
    assert ((shares - 0.2).abs() < 0.12).all()


def test_without_a_generator_every_step_takes_the_mean_of_the_members(data: Trajectories, features: Features) -> None:
    start, states = future(data, pets.Peer(by_member, features), seed=None)
    travelled = 3.0 * torch.arange(1, 13)[:, None] * features.step_std * features.moving
    assert torch.allclose(states, start + travelled, atol=1e-4)


@pytest.mark.parametrize("seed", [None, 0])
def test_an_obstacle_does_not_move(data: Trajectories, features: Features, seed: int | None) -> None:
    start, states = future(data, pets.Peer(by_member, features), seed=seed)
    assert torch.equal(states[..., FIXED], start[..., FIXED].expand(-1, 12, -1))


def test_stated_noise_is_added_at_every_step(data: Trajectories, features: Features) -> None:
    def network(inputs: Tensor) -> tuple[Tensor, Tensor]:
        mean = torch.zeros(*inputs.shape[:2], DX)
        return mean, torch.full_like(mean, 2 * torch.tensor(3.0).log())

    model = pets.Peer(network, features)
    start, states = future(data, model, steps=20)
    steps = torch.cat([start, states], dim=1).diff(dim=1)[..., features.moving] / features.step_std[features.moving]
    assert abs(steps.std().item() - 3) < 0.15
    flat = steps.flatten(1)
    assert abs((flat[:, :-6] * flat[:, 6:]).mean().item()) < 0.5  # the next step's noise is another
    assert torch.equal(future(data, model, seed=None)[1], start.expand(-1, 12, -1))


def test_shared_noise_gives_candidates_the_same_members(data: Trajectories, features: Features) -> None:
    past = Segment(*(part[:10, :10].repeat(2, 1, 1) for part in data.padded(0)))
    noise = SharedNoise(torch.Generator().manual_seed(0), period=10)
    states = pets.Peer(by_member, features).predict_segment(past, torch.zeros(20, 3, DU), generator=noise)
    assert torch.equal(states[:10], states[10:])


def test_parts_of_an_epoch_join_without_a_gap() -> None:
    passes = count()

    class Batches:
        def __iter__(self) -> Any:
            n = next(passes)
            return iter([(n, k) for k in range(5)])

    parts = pets.Parts(Batches(), 3)
    drawn = [batch for _ in range(4) for batch in parts]
    assert drawn == [(n, k) for n in range(3) for k in range(5)][:12]
    assert parts.drawn == 12


def test_rows_of_the_same_model_are_replaced(tmp_path: Path) -> None:
    path = tmp_path / "peers_pets.csv"
    for model, value in (("pets", 1.0), ("pets+mse", 2.0), ("pets", 3.0)):
        pets.table(path, [dict(env="arm", model=model, seed=0, metric="nrmse", value=value)])
    assert {row["model"]: row["value"] for row in store.load_table(path)} == {"pets": 3.0, "pets+mse": 2.0}


def pins(path: Path) -> dict[str, str]:
    lines = path.read_text().splitlines()
    return dict(line.split("==") for line in lines if line and not line.startswith("#"))


def test_pins_are_those_of_the_lock_where_both_name_a_package() -> None:
    own, lock = pins(FOLDER / "requirements.txt"), pins(ROOT / "environment.lock")
    assert {"torch", "hydra-core", "omegaconf", "antlr4-python3-runtime", "gymnasium", "mujoco"} <= set(own)
    assert "mbrl" not in own  # it would bring its own pins
    assert {name: lock[name] for name in own if name in lock} == {k: v for k, v in own.items() if k in lock}


def test_the_readme_names_the_pins_and_options_that_exist() -> None:
    readme, source = (FOLDER / "README.md").read_text(), (FOLDER / "pets.py").read_text()
    assert "--no-deps mbrl==0.2.0 -e ." in readme
    assert f"torch=={pins(FOLDER / 'requirements.txt')['torch']}" in readme
    for path in re.findall(r"benchmarks/peers/[\w.]+", readme):
        assert (ROOT / path).exists(), path
    for option in re.findall(r" (--(?!no-deps)[a-z-]+)", readme):
        assert f'add_argument("{option}"' in source, option
    assert f"{pets.LEARNING_RATE:g}, weight decay {pets.WEIGHT_DECAY:.5f}, batches of {pets.BATCH}" in readme
