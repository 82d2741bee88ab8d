"""What stands between mbrl-lib's networks and our scores. Stand-ins take the networks' place: no mbrl-lib is needed."""

from __future__ import annotations

import importlib.util
import re
from dataclasses import replace
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scripts import load_script, pins, start_with_only
from torch import Tensor

from tsmlib import study
from tsmlib.models.base import rollout
from tsmlib.models.features import Features
from tsmlib.planning.execution import Trial, execute
from tsmlib.sampling import SharedNoise
from tsmlib.storage import tables
from reproduction import runs, worlds
from reproduction.runs import ROOT
from tsmlib.trajectory import Segment, Trajectories

FOLDER = ROOT / "benchmarks" / "peers"
MEMBERS, DX, DU, FIXED = 5, 8, 2, (6, 7)  # an arm and an obstacle, which never moves


pets = load_script(FOLDER / "pets.py")
speed = load_script(FOLDER / "speed.py")
loop = load_script(FOLDER / "loop.py")
needs_mbrl = pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in ("mbrl", "hydra")),
    reason="mbrl-lib is not installed; README.md",
)


@pytest.fixture
def data() -> Trajectories:
    generator = torch.Generator().manual_seed(0)
    walk = torch.randn(20, 31, DX, generator=generator).cumsum(1) * torch.logspace(-2, 0, DX)
    walk[..., FIXED] = walk[:, :1, FIXED]
    actions = torch.rand(20, 30, DU, generator=generator)
    return Trajectories(
        walk.numpy(), actions.numpy(), "arm", 0.02, ("x",) * DX, ("m",) * DX, (0, 1)
    )


@pytest.fixture
def features(data: Trajectories) -> Features:
    return Features(DX, data.angles).fit(torch.from_numpy(data.states))


def by_member(inputs: Tensor) -> tuple[Tensor, None]:
    """Member m moves every dimension by m + 1 units a step."""
    steps = torch.arange(1.0, MEMBERS + 1)[:, None, None]
    return steps.expand(MEMBERS, inputs.shape[1], DX), None


def future(
    data: Trajectories, model: Any, seed: int | None = 0, rows: int = 20, steps: int = 12
) -> tuple[Any, Tensor]:
    """Where each row starts (rows, 1, dx), and its rollout (rows, steps, dx)."""
    whole = data.segment(0)
    past = Segment(*(part[:rows, :10] for part in whole))
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    return past.states[:, -1:], rollout(
        model, past, whole.actions[:rows, 10 : 10 + steps], generator=generator
    )


def test_a_network_reads_features_of_the_last_state_and_the_action(
    data: Trajectories, features: Features
) -> None:
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


def test_targets_have_unit_variance_and_undo_themselves(
    data: Trajectories, features: Features
) -> None:
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


def test_a_row_keeps_its_member_for_the_whole_rollout(
    data: Trajectories, features: Features
) -> None:
    peer = pets.Peer(by_member, features)
    start, states = future(data, peer)
    steps = (
        torch.cat([start, states], dim=1).diff(dim=1)[..., features.moving]
        / features.step_std[features.moving]
    )
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


def test_without_a_generator_every_step_takes_the_mean_of_the_members(
    data: Trajectories, features: Features
) -> None:
    start, states = future(data, pets.Peer(by_member, features), seed=None)
    travelled = 3.0 * torch.arange(1, 13)[:, None] * features.step_std * features.moving
    assert torch.allclose(states, start + travelled, atol=1e-4)


@pytest.mark.parametrize("seed", [None, 0])
def test_an_obstacle_does_not_move(
    data: Trajectories, features: Features, seed: int | None
) -> None:
    start, states = future(data, pets.Peer(by_member, features), seed=seed)
    assert torch.equal(states[..., FIXED], start[..., FIXED].expand(-1, 12, -1))


def test_stated_noise_is_added_at_every_step(data: Trajectories, features: Features) -> None:
    def network(inputs: Tensor) -> tuple[Tensor, Tensor]:
        mean = torch.zeros(*inputs.shape[:2], DX)
        return mean, torch.full_like(mean, 2 * torch.tensor(3.0).log())

    model = pets.Peer(network, features)
    start, states = future(data, model, steps=20)
    steps = (
        torch.cat([start, states], dim=1).diff(dim=1)[..., features.moving]
        / features.step_std[features.moving]
    )
    assert abs(steps.std().item() - 3) < 0.15
    flat = steps.flatten(1)
    assert abs((flat[:, :-6] * flat[:, 6:]).mean().item()) < 0.5  # the next step's noise is another
    assert torch.equal(future(data, model, seed=None)[1], start.expand(-1, 12, -1))


def test_shared_noise_gives_candidates_the_same_members(
    data: Trajectories, features: Features
) -> None:
    past = Segment(*(part[:10, :10].repeat(2, 1, 1) for part in data.segment(0)))
    noise = SharedNoise(torch.Generator().manual_seed(0), period=10)
    states = pets.Peer(by_member, features).predict_segment(
        past, torch.zeros(20, 3, DU), generator=noise
    )
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
    assert {row["model"]: row["value"] for row in tables.records(tables.load(path))} == {
        "pets": 3.0,
        "pets+mse": 2.0,
    }


# Beside ours: speed.py --------------------------------------------------------------------------------------------


def trainer(
    name: str, per_update: int = 100, parameters: int = 1000, run: Any = lambda updates: None
) -> Any:
    return speed.Trainer(name, True, run, per_update, parameters)


def test_a_turn_of_training_is_as_many_transitions_for_everyone() -> None:
    now = [0.0]

    def costs(seconds: float) -> Any:
        def run(updates: int) -> None:
            now[0] += seconds * updates

        return run

    both = [trainer("small", 100, run=costs(0.1)), trainer("large", 400, run=costs(0.2))]
    found = speed.speeds(both, lambda: now[0], transitions=1200, rounds=3)
    assert np.allclose(found["small"], [1000] * 3)
    assert np.allclose(found["large"], [2000] * 3)
    assert now[0] == pytest.approx(2 * 0.1 + 2 * 0.2 + 3 * (12 * 0.1 + 3 * 0.2))


@pytest.mark.parametrize("form", ["gaussian", "mse"])
def test_every_member_of_ours_sees_as_many_transitions_as_are_counted(
    data: Trajectories, features: Features, form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, whole = [], speed.Ensemble.increments

    def spy(self: Any, x: Tensor, u: Tensor) -> Any:
        if torch.is_grad_enabled():  # not at validation
            seen.append(tuple(x.shape[:2]))
        return whole(self, x, u)

    monkeypatch.setattr(speed.Ensemble, "increments", spy)
    made = speed.ours(form, features, data, batch=64, bf16=False)
    made.run(3)
    assert seen == [(MEMBERS, made.per_update)] * 3
    widths = [
        DX + 2 + DU,
        200,
        200,
        200,
        200,
        DX * (2 if form == "gaussian" else 1),
    ]  # of mbrl-lib's GaussianMLP
    theirs = MEMBERS * sum((i + 1) * o for i, o in pairwise(widths)) + 2 * DX * (form == "gaussian")
    assert made.parameters == theirs


def test_a_batch_that_cannot_be_dealt_out_equally_is_refused(
    data: Trajectories, features: Features
) -> None:
    with pytest.raises(ValueError, match="not 63"):
        speed.ours("mse", features, data, batch=63, bf16=False)


def test_networks_of_another_size_are_not_compared() -> None:
    speed.same_size([trainer("a"), trainer("b", parameters=1010)])
    with pytest.raises(SystemExit, match="not equal in size"):
        speed.same_size([trainer("a"), trainer("b", parameters=1011)])


def test_theirs_earns_the_reward_of_the_task_step_by_step() -> None:
    task, unit = study.load_task(speed.ENV).take(3), torch.logspace(-1, 1, 10)
    generator = torch.Generator().manual_seed(0)
    states, actions = (
        torch.randn(7, 3, 4, 10, generator=generator),
        torch.randn(7, 3, 4, 2, generator=generator),
    )
    expected = task.reward(states, actions)  # (C, B, T)
    for b in range(3):
        single = speed.at(task, [b])
        for t in range(4):
            found = speed.stepwise(single, unit, actions[:, b, t], states[:, b, t] / unit)
            assert torch.allclose(found, expected[:, b, t, None], atol=1e-5)


class Still:
    """Nothing moves, whatever is done."""

    segment_len, past_len, stochastic = 100, 1, True

    def __init__(self) -> None:
        self.unit = torch.ones(10)

    def predict_segment(self, past: Segment, actions: Tensor, *, generator: Any = None) -> Tensor:
        return past.states[:, -1:] + 0 * actions[..., :1]


THEIRS = speed.Way("mbrl-cem", "direct", "pets", iterations=1, candidates=2, bound=1.0)
OURS = speed.Way("cem", "direct", "tsm", iterations=1, candidates=4)


def test_every_target_is_planned_for_once_by_theirs_and_in_every_round_by_ours(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    task = replace(study.load_task(speed.ENV).take(5), horizon=4)
    now, asked = [0.0], []

    def objective(model: Any, unit: Tensor, single: Any, samples: int) -> Any:
        asked.append(single.target)
        return lambda actions: actions.sum((1, 2))

    def search(value: Any, shape: tuple[int, ...], way: Any, *, seed: int) -> Tensor:
        now[0] += 3.0
        value(torch.zeros(2, *shape))
        return torch.full(shape, 0.01 * len(asked))

    monkeypatch.setattr(speed, "through_pets", objective)
    monkeypatch.setattr(speed, "search", search)
    models = speed.Models(None, {"pets": Still(), "tsm": Still()}, None)
    first, second = speed.outcomes([THEIRS, OURS], task, models, lambda: now[0], rounds=2)
    assert torch.equal(torch.cat(asked), task.target)
    assert torch.allclose(first.trial.actions[:, 0, 0], 0.01 * torch.arange(1.0, 6))
    assert first.seconds.tolist() == [3.0, 3.0]  # a target, however many are in a share
    assert second.trial.actions.shape == (5, 4, 2)
    assert len(second.seconds) == 2
    assert (
        first.trial.executed_return - first.predicted_return
    ).abs().max() < 0.1  # nothing was pushed


def outcome(way: Any, seconds: float, true: list[float]) -> Any:
    executed = torch.tensor(true)
    trial = Trial(
        torch.zeros(len(true), 4, 2),
        torch.zeros(len(true), 5, 10),
        executed,
        torch.zeros(len(true)),
    )
    return speed.Outcome(way, np.array([seconds, 2 * seconds]), trial, executed)


def test_only_what_earns_as_much_counts_as_faster(capsys: pytest.CaptureFixture[str]) -> None:
    subject = outcome(THEIRS, 10.0, [-3.0, -1.0])
    worse, slower, best = (
        outcome(replace(OURS, iterations=i), seconds, true)
        for i, (seconds, true) in enumerate(
            ((0.1, [-3.0, -2.0]), (5.0, [0.0, 0.0]), (2.0, [-2.0, -2.0])), start=1
        )
    )
    assert speed.as_good(subject, [worse, slower, best]) is best
    assert speed.as_good(subject, [worse]) is None
    assert speed.times_faster(best, subject).tolist() == [5.0, 5.0]
    gain, half = speed.compared(slower, subject)
    assert gain == pytest.approx(2.0)
    assert half == pytest.approx(
        12.706, rel=1e-3
    )  # differences 3 and 1: their deviation over the root of 2 is 1
    speed.verdicts([subject, worse, slower, best])
    printed = capsys.readouterr().out
    assert "5.00 (5.00 to 5.00) times faster" in printed
    assert re.search(rf"{re.escape(slower.way.name)} +none", printed)


def test_ways_of_both_are_compared_and_mixed_ones_are_told_apart() -> None:
    assert (THEIRS.origin, OURS.origin) == ("theirs", "ours")
    assert replace(OURS, model="pets").origin == replace(THEIRS, model="tsm").origin == "mixed"
    assert speed.WAYS[0].origin == "theirs"  # what the others are held against
    assert {way.origin for way in speed.WAYS} == {"theirs", "ours", "mixed"}
    assert len({way.name for way in speed.WAYS}) == len(speed.WAYS)
    for way in speed.WAYS:
        if way.planner == "mbrl-cem" and way.model == "pets":
            assert (
                way.candidates * way.samples % MEMBERS == 0
            )  # as mbrl-lib deals rows out among members


def test_the_trained_network_is_found_again_until_its_training_changes(
    data: Trajectories, features: Features, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    def train(*arguments: Any, **options: Any) -> tuple[Any, dict[str, float]]:
        made.append(torch.nn.Linear(2, 2))
        return made[-1], {"epochs": 1.0}

    monkeypatch.setattr(pets, "train", train)
    monkeypatch.setattr(pets, "initialise", lambda *_, **options: (torch.nn.Linear(2, 2), None))
    run = runs.Run("peers", "laptop", 0, tmp_path)
    first, again = (speed.trained(run, "mse", features, data, data, seconds=3.0) for _ in range(2))
    assert torch.equal(first.weight, again.weight)
    assert len(made) == 1
    speed.trained(run, "mse", features, data, data, seconds=4.0)
    speed.trained(run, "mse", features, data.take(slice(10)), data, seconds=4.0)
    assert len(made) == 3


def test_pins_are_those_of_the_lock_where_both_name_a_package() -> None:
    own, lock = pins(FOLDER / "requirements.txt"), pins(ROOT / "environment.lock")
    assert {
        "torch",
        "hydra-core",
        "omegaconf",
        "antlr4-python3-runtime",
        "gymnasium",
        "mujoco",
    } <= set(own)
    assert "mbrl" not in own  # it would bring its own pins
    assert {name: lock[name] for name in own if name in lock} == {
        k: v for k, v in own.items() if k in lock
    }


@pytest.mark.parametrize(
    ("script", "without", "starts"),
    [
        ("pets", "", True),
        ("loop", "", True),
        ("speed", "", True),
        ("pets", "lazy-loader", False),
    ],
)
def test_the_scripts_start_where_nothing_is_installed_but_the_requirements(
    script: str, without: str, starts: bool
) -> None:
    names = [name for name in pins(FOLDER / "requirements.txt") if name != without]
    code, said = start_with_only(FOLDER / f"{script}.py", names)
    assert (code == 0) is starts, said[-500:]
    assert starts or "lazy_loader is no requirement" in said


def test_the_readme_names_the_pins_and_options_that_exist() -> None:
    readme = (FOLDER / "README.md").read_text()
    source = "".join((FOLDER / name).read_text() for name in ("pets.py", "speed.py"))
    assert "--no-deps mbrl==0.2.0 -e ." in readme
    assert f"torch=={pins(FOLDER / 'requirements.txt')['torch']}" in readme
    for path in re.findall(r"benchmarks/peers/[\w.]+", readme):
        assert (ROOT / path).exists(), path
    for option in re.findall(r" (--(?!no-deps)[a-z-]+)", readme):
        assert f'add_argument("{option}"' in source, option
    assert (
        f"{pets.LEARNING_RATE:g}, weight decay {pets.WEIGHT_DECAY:.5f}, batches of {pets.BATCH}"
        in readme
    )


@pytest.mark.parametrize("env", loop.SETTINGS)
def test_a_robot_of_mbrl_lib_returns_what_the_same_actions_do_here(env: str) -> None:
    here = worlds.world(env)
    task, unit = here.drawn(2, 5), loop.unit_of(here.random(2, 3))
    robot = loop.Robot(lambda i: task.take([i]), unit, bound=1.0)
    actions = (
        np.random.default_rng(0).uniform(-0.3, 0.3, (2, 100, task.action_dim)).astype(np.float32)
    )
    returns, seen = [], []
    for episode in actions:
        first, _ = robot.reset()
        assert first.shape == unit.shape
        steps = [robot.step(action) for action in episode]
        assert [truncated for *_, truncated, _ in steps] == [False] * 99 + [True]
        assert not any(terminated for _, _, terminated, _, _ in steps)
        returns.append(sum(reward for _, reward, *_ in steps))
        seen.append(np.stack([observed for observed, *_ in steps]))
        predicted = robot.reward(torch.from_numpy(episode), torch.from_numpy(seen[-1]))
        np.testing.assert_allclose(predicted[:, 0], [reward for _, reward, *_ in steps], atol=1e-4)
    trial = execute(task, torch.from_numpy(actions))
    np.testing.assert_allclose(returns, trial.executed_return, atol=1e-3)
    assert loop.executed(task, torch.from_numpy(actions))["return_true"] == pytest.approx(
        np.mean(returns), abs=1e-3
    )


@needs_mbrl
def test_its_own_loop_leaves_rows_of_the_last_round(tmp_path: Path) -> None:
    out = tmp_path / "loop.csv"
    loop.main(["--env", "tsm/ReacherPush-v1", "--scale", "smoke", "--out", str(out)])
    rows = tables.load(out)
    assert set(rows["metric"]) == {"return_true", "success", "final_distance"}
    sizes = worlds.world("tsm/ReacherPush-v1").sizes["smoke"]
    assert set(rows["env_steps"]) == {100 * (sizes.first + sizes.rounds * sizes.episodes)}
    assert set(rows["model"]) == {"pets"}


@pytest.mark.skipif(importlib.util.find_spec("mbrl") is not None, reason="mbrl-lib is installed")
def test_without_mbrl_lib_the_loop_says_where_it_is_told_how(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"mbrl-lib cannot be imported .*README.md tells how"):
        loop.main(["--scale", "smoke", "--out", str(tmp_path / "x.csv")])
