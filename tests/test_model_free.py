"""What stands between our arms and Stable-Baselines3. Where it is not installed, what needs it is skipped."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from scripts import load_script, pins, start_with_only

from tsmlib import study
from tsmlib.models.features import Features
from tsmlib.planning.execution import execute
from tsmlib.planning.tasks import Task
from tsmlib.storage import tables
from tsmlib import zoo
from reproduction.comparison import published
from reproduction.results.policies import finished_on_arms, gradients, learning_curves
from reproduction.results.table import select
from reproduction.runs import ROOT

FOLDER = ROOT / "benchmarks" / "model_free"
needs_sb3 = pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in ("stable_baselines3", "sb3_contrib")),
    reason="Stable-Baselines3 and sb3-contrib are not installed; benchmarks/model_free/README.md tells how",
)
needs_sbx = pytest.mark.skipif(
    not importlib.util.find_spec("sbx"),
    reason="SBX is not installed; benchmarks/model_free/README.md tells how",
)


model_free = load_script(FOLDER / "model_free.py")


def driven(episodes: Any, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What is observed after each of actions (n, T, du), and the rewards: one batch of whole episodes."""
    seen, rewards, over = zip(
        *(episodes.step(actions[:, step]) for step in range(actions.shape[1])), strict=True
    )
    assert over == (False,) * (actions.shape[1] - 1) + (True,)
    return np.stack(seen, axis=1), np.stack(rewards, axis=1)


def played(env: str, n: int = 4) -> tuple[Task, torch.Tensor, np.ndarray, np.ndarray]:
    """One batch of episodes with random torques: the task, the actions (n, T, 2), what was observed, the rewards."""
    episodes = model_free.Episodes(env, n, seed=3)
    episodes.reset()
    start, target = (
        episodes.robots._states.astype(np.float32),
        episodes.robots.target.astype(np.float32),
    )
    task = Task.standard(env, start, torch.from_numpy(target))
    episodes.robots.reset(
        options={"states": start, "target": target}
    )  # as a task keeps them, in single precision
    actions = np.random.default_rng(0).uniform(-1.5, 1.5, (n, task.horizon, 2)).astype(np.float32)
    seen, rewards = driven(episodes, actions)
    seen = np.concatenate([model_free.observed(start, target)[:, None], seen], axis=1)
    return task, torch.from_numpy(actions).clamp(-1, 1), seen, rewards


@pytest.mark.parametrize("env", model_free.ENVS)
def test_the_same_actions_give_the_states_and_rewards_of_execute(env: str) -> None:
    task, actions, seen, rewards = played(env)
    trial = execute(task, actions)
    states = trial.states.numpy()
    flat = model_free.observed(
        states.reshape(-1, states.shape[2]),
        np.repeat(task.target.numpy(), task.horizon + 1, axis=0),
    )
    np.testing.assert_allclose(seen.reshape(len(flat), -1), flat, rtol=1e-6, atol=1e-6)
    per_step = task.reward(trial.states[:, 1:], actions)
    np.testing.assert_allclose(rewards, per_step, atol=1e-6)
    np.testing.assert_allclose(rewards.sum(1), trial.executed_return, atol=1e-5)


def test_pendulums_do_and_earn_what_the_task_of_the_rounds_says() -> None:
    task, episodes = pendulum.swing_up(3, seed=7), model_free.Episodes(pendulum.PENDULUM, 3, seed=0)
    episodes.seed = [7, 8, 9]
    actions = np.random.default_rng(0).uniform(-1.5, 1.5, (3, task.horizon, 1)).astype(np.float32)
    first, (seen, rewards) = episodes.reset(), driven(episodes, actions)
    trial = execute(task, torch.from_numpy(actions).clamp(-1, 1))
    np.testing.assert_allclose(
        np.concatenate([first[:, None], seen], axis=1), trial.states, atol=1e-5
    )
    np.testing.assert_allclose(rewards.sum(1), trial.executed_return, atol=1e-4)


def test_training_seeds_share_no_start_of_the_pendulum() -> None:
    several = [model_free.Episodes(pendulum.PENDULUM, 20, seed=seed) for seed in (0, 1)]
    one, other = (np.concatenate([episodes.reset() for _ in range(3)]) for episodes in several)
    assert not (one[:, None] == other).all(2).any()


def test_the_pendulum_is_measured_from_the_starts_of_its_rounds_and_chosen_from_others() -> None:
    tested, chosen = (
        model_free.SETUPS[pendulum.PENDULUM].task(split) for split in ("test", "validation")
    )
    np.testing.assert_array_equal(tested.start, pendulum.swing_up(8, seed=pendulum.TESTED).start)
    assert not (tested.start[:, None] == chosen.start).all(2).any()
    found = model_free.measured(tested, lambda seen: np.zeros((len(seen), 1)))
    trial = execute(tested, torch.zeros(8, tested.horizon, 1))
    assert found == {
        "return_true": pytest.approx(float(trial.executed_return.mean()), abs=1e-4),
        "success": 0.0,
    }


def test_a_policy_sees_what_ours_see_and_the_target() -> None:
    states, target = np.random.default_rng(0).normal(size=(5, 10)), np.arange(10.0).reshape(5, 2)
    ours = Features(10, (0, 1))(torch.from_numpy(states).float())
    np.testing.assert_allclose(
        model_free.observed(states, target), np.concatenate([ours, target], axis=1), rtol=1e-6
    )


def test_new_episodes_have_other_starts_and_targets_within_the_disc() -> None:
    episodes = model_free.Episodes("tsm/ReacherPush-v1", 50, seed=0)
    first, second = episodes.reset(), episodes.reset()
    assert not np.isclose(first, second).all(axis=1).any()
    targets = np.concatenate([first, second])[:, -2:]
    distance = np.linalg.norm(targets, axis=1)
    assert distance.max() <= 0.2
    assert 0.4 < np.mean(distance < 0.2 / 2**0.5) < 0.6  # uniform over the area
    again = model_free.Episodes("tsm/ReacherPush-v1", 50, seed=0)
    np.testing.assert_array_equal(again.reset(), first)


def test_doing_nothing_has_the_return_of_zero_torque() -> None:
    task = study.load_task("tsm/Reacher-v0").take(10)
    found = model_free.measured(task, lambda seen: np.zeros((len(seen), 2)))
    trial = execute(task, torch.zeros(10, task.horizon, 2))
    assert found["return_true"] == pytest.approx(float(trial.executed_return.mean()), abs=1e-5)
    assert found["final_distance"] == pytest.approx(float(trial.final_distance.mean()), abs=1e-6)


def test_the_first_configurations_try_each_pair_of_values_once() -> None:
    for settings in model_free.SETTINGS.values():
        assert len({model_free.named(setting) for setting in settings}) == len(settings) == 6
        for pair in (list(settings[0])[:2], list(settings[0])[1:], list(settings[0])[::2]):
            assert len({tuple(setting[name] for name in pair) for setting in settings[:4]}) == 4
        for setting in settings:
            assert (
                setting["episodes"]
                * model_free.SETUPS["tsm/Reacher-v0"].horizon
                % model_free.MINIBATCH
                == 0
            )


def records(*steps: int) -> list[dict[str, float]]:
    return [
        dict.fromkeys(model_free.UNITS, -1.0 - i) | {"steps": step} for i, step in enumerate(steps)
    ]


def test_a_finished_run_is_found_again_and_replaces_a_shorter_one(tmp_path: Path) -> None:
    path, task = tmp_path / "model_free.csv", study.load_task("tsm/Reacher-v0")
    key = dict(env=task.env, model="ppo", subset="", configuration="std=0.14", seed=1)
    for other in (
        {"seed": 2},
        {"model": "trpo"},
        {"subset": "search"},
        {"configuration": "std=0.37"},
    ):
        model_free.Table(path).put(key | other, task, records(0, 500))
    table = model_free.Table(path)
    assert table.kept(key, 1) == []
    table.put(key, task, records(0, 500))
    assert model_free.Table(path).kept(key, 600) == []
    model_free.Table(path).put(key, task, records(0, 500, 1000))
    kept = model_free.Table(path).kept(key, 1000)
    assert [row["value"] for row in kept if row["metric"] == "return_true"] == [-1.0, -2.0, -3.0]
    assert len(tables.records(tables.load(path))) == (4 * 2 + 3) * len(model_free.UNITS)


def test_its_rows_are_curves_of_figure_7(tmp_path: Path) -> None:
    table, task = model_free.Table(tmp_path / "model_free.csv"), study.load_task("tsm/Reacher-v0")
    for seed in range(3):
        key = dict(env=task.env, model="trpo", subset="", configuration="std=0.14", seed=seed)
        table.put(key, task, [record | {"seconds": 99.0} for record in records(0, 500, 1000)])
    table.put(key | {"subset": "search"}, task, records(200))
    curves = learning_curves(tables.load(table.path))["reach"][zoo.method("trpo")]
    assert curves["return_true"].tolist() == [[-1.0, -2.0, -3.0]] * 3
    assert curves["samples"].tolist() == [0, 500, 1000]
    assert curves["seconds"].tolist() == [-1.0, -2.0, -3.0]  # the processor's
    assert "iterations" not in curves


def test_rows_of_the_pendulum_are_those_of_its_rounds_and_have_no_part_in_figure_7(
    tmp_path: Path,
) -> None:
    table, env = model_free.Table(tmp_path / "model_free.csv"), pendulum.PENDULUM
    key = dict(env=env, model="ppo", subset="", configuration="std=0.14", seed=0)
    found = [
        {name: value for name, value in one.items() if name != "final_distance"}
        for one in records(0, 2000)
    ]
    rows = tables.frame(table.put(key, model_free.SETUPS[env].task("test"), found))
    theirs = select(published("10_explore"), env=env, metric="return_true")
    own = select(tables.load(table.path), metric="return_true")
    assert len(rows) == 2 * (len(model_free.UNITS) - 1)
    for column in ("sim", "task", "unit", "n"):
        assert set(own[column].astype(str)) == set(theirs[column].astype(str)), column
    free = published("model_free")
    both = tables.frame(pd.concat([free[free["env"] != env], rows]))
    for kept in (finished_on_arms, gradients):
        assert env not in set(kept(both)["env"])
        assert len(kept(both)) == len(kept(free)) > 0


@pytest.mark.parametrize("arguments", [["--seeds", "0"], ["--steps", "-1"], ["--records", "0"]])
def test_numbers_that_make_no_run_are_refused(tmp_path: Path, arguments: list[str]) -> None:
    with pytest.raises(SystemExit, match="expected positive numbers"):
        model_free.main([*arguments, "--out", str(tmp_path / "runs" / "x.csv")])
    assert not (tmp_path / "runs").exists()


@needs_sb3
@pytest.mark.parametrize("algorithm", [*model_free.GRADIENTS, pytest.param("sac", marks=needs_sbx)])
def test_a_short_run_learns_from_the_first_to_the_last_record(algorithm: str) -> None:
    setting = dict(model_free.SETTINGS[algorithm][0], episodes=5)
    task = study.load_task("tsm/Reacher-v0", "validation").take(5)
    runs = [
        list(model_free.learn(algorithm, task, setting, steps=500, records=2, seed=0))
        for _ in range(2)
    ]
    assert [record["steps"] for record in runs[0]] == [0, 250, 500]
    returns = [[record["return_true"] for record in found] for found in runs]
    assert returns[0] == returns[1]
    assert len(set(returns[0])) == 3
    seconds = [record["seconds"] for record in runs[0]]
    assert seconds == sorted(seconds)


@needs_sb3
@needs_sbx
def test_sac_updates_as_often_per_step_as_its_configuration_says() -> None:
    for updates, episodes, each in ((0.25, 20, 5), (1, 40, 40)):
        setting = {"learning_rate": 3e-4, "episodes": episodes, "updates": updates}
        assert model_free.learner("sac", "tsm/Reacher-v0", setting, seed=0).gradient_steps == each


@needs_sb3
def test_the_library_is_told_how_an_episode_ended() -> None:
    robots = model_free.vectorised(model_free.Episodes("tsm/Reacher-v0", 3, seed=0))
    robots.reset()
    for _ in range(model_free.SETUPS["tsm/Reacher-v0"].horizon - 1):
        *_, done, infos = robots.step(np.zeros((3, 2), np.float32))
        assert not done.any()
        assert infos == [{}, {}, {}]
    seen, _, done, infos = robots.step(np.zeros((3, 2), np.float32))
    assert done.all()
    for row, info in zip(seen, infos, strict=True):
        assert info["TimeLimit.truncated"]
        assert not np.allclose(info["terminal_observation"], row)  # `seen` begins the next episode


@needs_sb3
def test_the_whole_study_is_not_repeated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "model_free.csv"
    command = [
        "--env",
        "tsm/Reacher-v0",
        "--algorithm",
        "trpo",
        "--steps",
        "50",
        "--seeds",
        "2",
        "--records",
        "1",
    ]
    for _ in range(2):
        model_free.main([*command, "--out", str(path)])
    first, second = capsys.readouterr().out.split(f"{path}\n")[:2]
    assert first == second
    rows = tables.records(tables.load(path))
    assert {row["seed"] for row in rows if row["subset"] == ""} == {0, 1}
    assert len({row["configuration"] for row in rows if row["subset"] == "search"}) == 6
    assert len({row["configuration"] for row in rows if row["subset"] == ""}) == 1


@pytest.mark.parametrize(("without", "starts"), [("", True), ("lazy-loader", False)])
def test_the_script_starts_where_nothing_is_installed_but_the_requirements(
    without: str, starts: bool
) -> None:
    names = [name for name in pins(FOLDER / "requirements.txt") if name != without]
    code, said = start_with_only(FOLDER / "model_free.py", names)
    assert (code == 0) is starts, said[-500:]
    assert starts or "lazy_loader is no requirement" in said


def test_pins_are_those_of_the_lock_where_both_name_a_package() -> None:
    own, lock = pins(FOLDER / "requirements.txt"), pins(ROOT / "environment.lock")
    assert {"stable-baselines3", "sb3-contrib", "torch", "gymnasium", "mujoco"} <= set(own)
    assert {name: lock[name] for name in own if name in lock} == {
        k: v for k, v in own.items() if k in lock
    }


def test_the_readme_states_what_is_run() -> None:
    readme, own = (FOLDER / "README.md").read_text(), pins(FOLDER / "requirements.txt")
    assert f"torch=={own['torch']}" in readme
    for name in ("stable-baselines3", "sb3-contrib"):
        assert own[name] in readme
    for path in re.findall(r"benchmarks/model_free/[\w.]+", readme):
        assert (ROOT / path).exists(), path
    known = {option for action in model_free.parser()._actions for option in action.option_strings}
    assert set(re.findall(r"`?(--(?!no-deps)[a-z]+)", readme)) <= known
    steps = model_free.STEPS
    assert (
        f"{steps['tsm/Reacher-v0']:,} steps reaching, {steps['tsm/ReacherPush-v1']:,} pushing"
        in readme
    )
    steps = model_free.SEARCH_STEPS
    assert (
        f"{steps['tsm/Reacher-v0']:,} steps each for reaching and {steps['tsm/ReacherPush-v1']:,} for"
        in readme
    )
    for name in ("learning_rate", "target_kl", "episodes", "std", "updates"):
        values = sorted(
            {s[name] for settings in model_free.SETTINGS.values() for s in settings if name in s}
        )
        assert all(re.search(rf"\b{value:g}\b", readme) for value in values), name
    assert f"minibatches of {model_free.MINIBATCH} steps" in readme
    assert f"gamma {model_free.GAMMA}" in readme
    assert f"{model_free.RECORDS} times along the way" in readme
