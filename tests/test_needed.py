"""What notebooks need is declared once, and is what they then ask for."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from tsmlib import study
from tsmlib.study import jobs, needed, runs
from tsmlib.study.comparison import published
from tsmlib.study.results.table import select
from tsmlib.study.runs import ROOT, resolve

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


def test_a_policy_that_is_there_does_not_change_the_budget_that_is_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = resolve("05_control", scale="smoke", seed=1, run_dir=str(tmp_path))
    asked = needed.control(run).policies
    env, way, budget = asked[0]
    task = study.load_task(env).take(2)
    study.learn(run, task, way, study.Budget(iterations=1))
    assert needed.control(run).policies == asked
    assert study.learn(run, task, way, budget).header["budget"] == {"copies": 1, "iterations": 4}
    assert (
        "with Budget(copies=1, iterations=4), but one with Budget(copies=1, iterations=1), which is replaced"
        in capsys.readouterr().out
    )


def test_a_step_takes_about_as_long_as_the_rows_say_and_is_given_that_four_times(tmp_path: Path) -> None:
    run, rows = resolve("05_control", scale="paper", seed=1, run_dir=str(tmp_path)), published("05_control")
    spent, stated = [], []
    for job in study.needs(run):
        if not isinstance(job, jobs.Plan | jobs.Policy) or (isinstance(job, jobs.Plan) and job.iterations):
            continue
        about = {"env": job.env, "model": job.method.model, "search_space": job.method.search_space}
        if isinstance(job, jobs.Policy):
            found = select(rows, metric="seconds", **about)
        else:
            loop = "closed loop" if job.every else "open loop"
            found = select(rows, metric="plan_seconds", planner=job.method.planner, execution=loop, **about)
        if len(found):
            spent.append(found["value"].max())
            stated.append(job.seconds(run))
    assert len(spent) > 40
    assert all(seconds < 600 + 4 * each for seconds, each in zip(spent, stated, strict=True))
    assert 0.5 < sum(spent) / sum(stated) < 2


def test_the_hours_of_ten_seeds_are_those_of_the_estimates() -> None:
    hours = sum(
        {
            job.name: job.seconds(run) / 3600
            for run in (resolve(stem, scale="paper", seed=1) for stem in STEMS)
            for job in study.needs(run)
        }.values()
    )
    said = re.search(r"ten seeds are (\d+) hours of two cores", (ROOT / "docs" / "speed.md").read_text())
    assert said
    assert int(said.group(1)) == round(10 * hours / 2)
