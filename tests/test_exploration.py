"""A model and a prior that collect the data they learn from: rounds, their files, and what is
refused.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import tsmlib
from tsmlib.envs.unstable import SimulationUnstable
from tsmlib.exploration import explore as exploration
from tsmlib.storage.artifacts import digest
from tsmlib.storage.files import StoreError
from tsmlib.training.fit import fixed_windows, validate

ARM, EPISODES, HORIZON = "tsm/Reacher-v0", 3, 20


@cache
def data(env: str = ARM) -> tsmlib.Trajectories:
    return tsmlib.collect_random(env, 8, horizon=HORIZON)


def tasks(k: int, n: int = EPISODES) -> tsmlib.Task:
    start = data().states[:n, k]
    return replace(tsmlib.Task.standard(ARM, start, torch.full((n, 2), 0.1)), horizon=HORIZON)


def learners(seed: int = 0) -> tuple[tsmlib.RecurrentTSM, tsmlib.ActionPrior]:
    train = data()
    return (
        tsmlib.RecurrentTSM.for_data(train, seed=seed, hidden=8),
        tsmlib.ActionPrior.for_data(train, seed=seed, channels=4, dilations=(1, 2)),
    )


def options(**changes: Any) -> tsmlib.ExplorationOptions:
    once = tsmlib.TrainingOptions(
        past_len=10, future_len=10, steps=4, batch_size=8, validate_every=2, lr=1e-3
    )
    usual = dict(model=once, prior=once, rounds=2, candidates=4, elites=2, iterations=1)
    return tsmlib.ExplorationOptions(**(usual | changes))


def one_step(**changes: Any) -> tsmlib.ExplorationOptions:
    return options(**({"model": replace(options().model, past_len=1)} | changes))


def explored(model: Any, prior: Any, **given: Any) -> tsmlib.Exploration:
    usual = dict(options=options(), tasks=tasks, seed=3)
    train, held_out = data().take(slice(2, None)), data().take(slice(2))
    return tsmlib.explore(model, prior, train, held_out, **(usual | given))


def bits(*parts: torch.nn.Module | None) -> list[str]:
    return [digest(part.state_dict()) for part in parts if part is not None]


def test_every_round_adds_its_episodes_and_trains_model_and_prior() -> None:
    model, prior = learners()
    before, seen = bits(model, prior), []
    found = explored(
        model, prior, measure=lambda model, prior: {"asked": 1.0}, callback=seen.append
    )
    assert len(found.train) == 6 + 2 * (EPISODES - 1)
    assert len(found.held_out) == 2 + 2
    assert [record["env_steps"] for record in found.records] == [
        EPISODES * HORIZON,
        2 * EPISODES * HORIZON,
    ]
    assert [each and len(each) for each in found.episodes] == [EPISODES, EPISODES]
    for record in found.records:
        assert record.keys() >= {
            "executed_return",
            "success",
            "final_distance",
            "predicted_return",
            "gap",
            "validation",
            "prior_validation",
            "asked",
        }
        assert record["lost"] == 0
        assert all(np.isfinite(list(record.values())))
    assert [progress.values for progress in seen] == found.records
    assert all(then != now for then, now in zip(before, bits(model, prior), strict=True))


@pytest.mark.parametrize("killed_at", ["episodes", "prior", "model", "record", "next"])
def test_a_killed_loop_goes_on_with_the_same_bits(
    killed_at: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = learners()
    expected = explored(*whole)

    class Killed(Exception):
        pass

    class Once:
        """A function that is interrupted when it is called the ``n``-th time."""

        def __init__(self, call: Any, n: int) -> None:
            self.call, self.left = call, n

        def __call__(self, *given: Any, **named: Any) -> Any:
            self.left -= 1
            if not self.left:
                raise Killed
            return self.call(*given, **named)

    where, n = {
        "episodes": ("mpc", 2),
        "prior": ("fine_tune", 3),
        "model": ("fine_tune", 4),
        "record": ("_trained", 2),
        "next": ("mpc", 1),
    }[killed_at]
    with monkeypatch.context() as patched:
        patched.setattr(exploration, where, Once(getattr(exploration, where), n))
        with pytest.raises(Killed):
            explored(*learners(), folder=tmp_path)
    again = learners()
    found = explored(*again, folder=tmp_path)
    assert bits(*again) == bits(*whole)
    assert found.records == expected.records
    np.testing.assert_array_equal(found.train.states, expected.train.states)
    finished = learners()
    assert explored(*finished, folder=tmp_path).records == expected.records  # without any work
    assert bits(*finished) == bits(*whole)


def test_what_is_no_number_comes_back_from_the_folder(tmp_path: Path) -> None:
    endless = options(rounds=1, model=replace(options().model, clip=math.inf))
    for _ in range(2):
        found = explored(
            *learners(), options=endless, folder=tmp_path, measure=lambda *_: {"unknown": math.nan}
        )
        assert math.isnan(found.records[0]["unknown"])


def test_the_folder_of_another_loop_is_refused(tmp_path: Path) -> None:
    explored(*learners(), options=options(rounds=1), folder=tmp_path)
    with pytest.raises(
        StoreError, match=r"is of another exploration: .*seed.*Delete .* to start anew"
    ):
        explored(*learners(), options=options(rounds=1), folder=tmp_path, seed=4)
    with pytest.raises(StoreError, match="began with"):
        explored(*learners(seed=1), options=options(rounds=1), folder=tmp_path)


def test_episodes_that_no_plan_made_take_the_place_of_plans(tmp_path: Path) -> None:
    def unasked(k: int) -> tsmlib.Task:
        raise AssertionError

    def given(k: int) -> tsmlib.Trajectories | None:
        return tsmlib.collect_random(ARM, EPISODES, horizon=HORIZON, seed=k) if k == 1 else None

    learned = learners()
    found = explored(*learned, tasks=unasked, episodes=given, folder=tmp_path)
    assert (len(found.train), len(found.held_out)) == (6 + EPISODES - 1, 2 + 1)
    assert [record["env_steps"] for record in found.records] == [EPISODES * HORIZON] * 2
    assert [each and len(each) for each in found.episodes] == [EPISODES, None]
    again = learners()
    assert explored(*again, tasks=unasked, episodes=given, folder=tmp_path).records == found.records
    assert bits(*again) == bits(*learned)
    with pytest.raises(StoreError, match="is of another exploration"):
        explored(*learners(), folder=tmp_path)


def test_training_that_makes_a_model_no_better_on_held_out_episodes_leaves_it_as_it_was() -> None:
    (model, prior), worse = learners(), replace(options().model, lr=1.0, warmup=0)
    tsmlib.fit(model, data(), data(), replace(options().model, steps=100, lr=1e-2))
    before = bits(model)
    found = explored(model, prior, options=options(rounds=1, model=worse))
    assert bits(model) == before
    windows = fixed_windows(found.held_out, worse.past_len, worse.future_len)
    assert found.records[0]["validation"] == validate(model.loss, windows, 3 + 1)
    other = learners()[0]
    other.load_state_dict(model.state_dict())
    tsmlib.fit(other, found.train, found.held_out, worse, seed=3 + 1)
    assert (
        validate(other.loss, windows, 3 + 1) > found.records[0]["validation"]
    )  # it was worse indeed


def test_a_model_is_trained_on_the_augmented_data_and_a_prior_on_the_episodes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fine_tune, seen = exploration.fine_tune, []

    def watched(part: Any, train: tsmlib.Trajectories, *given: Any, **named: Any) -> Any:
        seen.append((type(part), len(train)))
        return fine_tune(part, train, *given, **named)

    monkeypatch.setattr(exploration, "fine_tune", watched)
    explored(*learners(), options=options(rounds=1), augmented=lambda data: data.joined(data))
    n = 6 + EPISODES - 1
    assert seen == [(tsmlib.ActionPrior, n), (tsmlib.RecurrentTSM, 2 * n)]


def test_actions_themselves_are_searched_without_a_prior_and_any_robot_explores() -> None:
    train = data("Pendulum-v1")
    model = tsmlib.OneStep.for_data(train, hidden=8)

    def upright(states: Tensor, actions: Tensor) -> Tensor:
        return states[..., 0] - 0.001 * actions[..., 0].square()

    def swings(k: int) -> tsmlib.Task:
        return tsmlib.Task.from_env(
            "Pendulum-v1", n=3, horizon=HORIZON, reward=upright, seed=10 * k
        )

    once = replace(options().model, past_len=model.past_len)
    small, found = (
        tsmlib.explore(
            copy.deepcopy(model),
            None,
            train,
            train,
            swings,
            options(model=once, prior=None, rounds=1, rms=rms),
        )
        for rms in (0.01, 0.6)
    )
    sizes = [
        float(np.abs(each.episodes[0].actions).mean())
        for each in (small, found)
        if each.episodes[0]
    ]
    assert sizes[0] < 0.1 * sizes[1]
    assert found.train.states.shape == (10, HORIZON + 1, 3)
    assert "success" not in found.records[0]


def test_an_unstable_episode_is_left_out_and_counted_with_what_was_executed_until_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, asked = exploration.mpc, []

    def unstable(task: tsmlib.Task, *given: Any, **named: Any) -> tsmlib.Trial:
        asked.append(task.start)
        if len(asked) == 1:
            raise SimulationUnstable(ARM, 1, 7, "velocity")
        return whole(task, *given, **named)

    monkeypatch.setattr(exploration, "mpc", unstable)
    found = explored(*learners(), options=options(rounds=1), folder=tmp_path)
    assert found.records[0]["lost"] == 1
    assert (
        found.records[0]["env_steps"] == EPISODES * 8 + (EPISODES - 1) * HORIZON
    )  # step 7 is the eighth
    np.testing.assert_array_equal(asked[1], asked[0][[0, 2]])
    (tmp_path / "round-001" / "model.safetensors").unlink()  # as if killed before
    assert (
        explored(*learners(), options=options(rounds=1), folder=tmp_path).records == found.records
    )
    assert len(asked) == 2


def unstable_episode(episodes: set[int], env: str = ARM) -> Any:
    """A stub of ``mpc`` in which the episodes that start where these of round 1 do become unstable
    at step 7.
    """
    whole, bad = exploration.mpc, tasks(1).start[sorted(episodes)]

    def run(task: tsmlib.Task, *given: Any, **named: Any) -> tsmlib.Trial:
        for i, start in enumerate(task.start):
            if (start == bad).all(1).any():
                raise SimulationUnstable(env, i, 7, "velocity")
        return whole(task, *given, **named)

    return run


def test_a_round_whose_last_episode_is_stable_is_learned_from(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(exploration, "mpc", unstable_episode({0, 2}))
    found = explored(*learners(), options=options(rounds=1))
    assert (found.records[0]["lost"], len(found.train), len(found.held_out)) == (2, 6 + 1, 2)
    assert found.records[0]["env_steps"] == 8 * EPISODES + 8 * (EPISODES - 1) + HORIZON


def test_a_round_that_loses_all_its_episodes_stops_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exploration, "mpc", unstable_episode({0, 1, 2}))
    learned = learners()
    found = explored(*learned, folder=tmp_path)
    first, second = found.records
    assert (found.episodes[0], first["lost"], first["env_steps"]) == (None, 3, 8 * (3 + 2 + 1))
    means = ("executed_return", "success", "final_distance", "predicted_return", "gap")
    assert all(math.isnan(first[name]) for name in means)
    assert second["lost"] == 0
    assert len(found.train) == 6 + EPISODES - 1
    again = learners()
    np.testing.assert_equal(explored(*again, folder=tmp_path).records, found.records)  # NaN is NaN
    assert bits(*again) == bits(*learned)


def judged_by(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, Any]]:
    """Judge and planner of every ``mpc`` that is called."""
    whole, seen = exploration.mpc, list[tuple[Any, Any]]()

    def watched(
        task: tsmlib.Task, model: Any, space: Any, planner: Any, **named: Any
    ) -> tsmlib.Trial:
        seen.append((named["judge"], planner))
        return whole(task, model, space, planner, **named)

    monkeypatch.setattr(exploration, "mpc", watched)
    return seen


@pytest.mark.parametrize(
    ("changes", "judge", "samples", "screened"),
    [
        ({}, tsmlib.expected_predictor, 8, 0.25),
        ({"judging": 2, "screened": 0.5}, tsmlib.expected_predictor, 2, 0.5),
    ],
)
def test_candidates_are_judged_by_the_mode_and_samples(
    changes: Mapping[str, Any],
    judge: Any,
    samples: int,
    screened: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = judged_by(monkeypatch)
    explored(*learners(), options=options(rounds=1, **changes))
    ((found, planner),) = seen
    assert (found.func, found.keywords, planner.keywords["screened"]) == (
        judge,
        {"samples": samples},
        screened,
    )


def test_a_model_without_samples_is_judged_by_its_rollout_whatever_the_options(
    tmp_path: Path,
) -> None:
    def found(**changes: Any) -> list[dict[str, float]]:
        model = tsmlib.OneStep.for_data(data(), hidden=8)
        once = options(rounds=1, model=replace(options().model, past_len=1), **changes)
        return explored(model, learners()[1], options=once, folder=tmp_path).records

    assert found(judging=0, screened=1.0) == found()


def test_a_measure_by_a_name_that_the_record_has_is_refused() -> None:
    said = "measure gave 'lost', 'success', which the record of a round has.*'tested_lost'"
    with pytest.raises(ValueError, match=said):
        explored(*learners(), measure=lambda model, prior: {"success": 1.0, "lost": 0.0})


def test_some_episodes_of_a_round_are_always_trained_on() -> None:
    found = explored(*learners(), options=options(rounds=1, held_out=0.99))
    assert (len(found.train), len(found.held_out)) == (6 + 1, 2 + EPISODES - 1)
