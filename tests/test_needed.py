"""What notebooks need is declared once, and is what they then ask for."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from tsmlib import study
from tsmlib.study import jobs, needed, runs
from tsmlib.study.runs import resolve

STEMS = [notebook.stem for notebook in runs.notebooks().values()]


@pytest.mark.parametrize("scale", ["smoke", "laptop", "paper"])
@pytest.mark.parametrize("seed", [0, 1])
def test_every_job_comes_after_what_it_needs_and_says_what_decides_it(scale: str, seed: int, tmp_path: Path) -> None:
    for stem in STEMS:
        run, done = resolve(stem, scale=scale, seed=seed, run_dir=str(tmp_path)), set[str]()
        for job in study.needs(run):
            assert {other.name for other in job.needs(run)} <= done
            assert job.name not in done
            assert job.seconds(run) >= 0
            json.dumps(job.settings(run), allow_nan=False)
            done.add(job.name)
    assert not list(tmp_path.iterdir())


def test_parameters_of_a_notebook_say_what_it_needs(tmp_path: Path) -> None:
    env = "tsm/PymunkPush-v1"
    run = resolve("02_train", scale="smoke", run_dir=str(tmp_path), env=env, models="prior,tsm")
    assert needed.choice(run) == ([env], ["prior", "tsm"])
    found = {job for job in study.needs(run) if job.kind == "model"}
    assert found == {jobs.Model(env, "prior"), jobs.Model(env, "tsm")}
    run = resolve("05_control", scale="paper", run_dir=str(tmp_path), n_targets=7)
    assert {job.n for job in study.needs(run) if isinstance(job, jobs.Plan)} == {7}


def test_a_change_of_a_schedule_changes_the_settings_of_its_model_alone(tmp_path: Path) -> None:
    run = resolve("03_predict", scale="paper", run_dir=str(tmp_path))
    half = {job.name: job.settings(replace(run, scale="laptop")) for job in study.needs(run)}
    changed = {job.kind for job in study.needs(run) if job.settings(run) != half[job.name]}
    assert changed == {"model", "scores"}


@pytest.mark.parametrize(("scale", "asked"), [("smoke", [True, False]), ("laptop", [False] * 2), ("paper", [True] * 2)])
def test_every_seed_at_paper_scale_has_the_papers_choices_and_seed_0_alone_the_map(
    scale: str, asked: list[bool], tmp_path: Path
) -> None:
    found = [
        needed.ablations(resolve("03_predict", scale=scale, seed=seed, run_dir=str(tmp_path / scale)))
        for seed in (0, 1)
    ]
    assert [bool(pairs) for pairs in found] == asked
    assert scale != "paper" or found[0] == found[1]
    worlds = [resolve("06_robustness", scale="paper", seed=seed, run_dir=str(tmp_path)) for seed in (0, 1)]
    assert [bool(needed.robustness(run).cells) for run in worlds] == [True, False]


@pytest.mark.parametrize("seed", [0, 1])
def test_every_seed_learns_every_policy_and_those_that_take_long_for_fewer_iterations(
    seed: int, tmp_path: Path
) -> None:
    run = resolve("05_control", scale="paper", seed=seed, run_dir=str(tmp_path))
    asked = needed.control(run).policies
    for env in (needed.REACH, needed.PUSH):
        assert {way.model for own, way, _ in asked if own == env} >= {"tsm", "rtsm", "onestep", "multistep", "lstm"}
    assert {budget for env, _, budget in asked if env == needed.PUSH} == {needed.ON_IMPERFECT}
    assert {way.model for env, way, budget in asked if env == needed.REACH and budget == needed.ON_IMPERFECT} == {"tsm"}
    worlds = needed.robustness(resolve("06_robustness", scale="paper", seed=seed, run_dir=str(tmp_path)))
    assert {world for world, _ in worlds.policies} == {"clean", "noise", "delay"}
