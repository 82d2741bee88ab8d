"""Things made ahead, by other processes: all of them, in the run's folder, and no error is lost."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tsmlib import study
from tsmlib.envs.spec import ENV_IDS
from tsmlib.study import runs
from tsmlib.study.runs import Run, RunError


def write(run: Run, name: str) -> None:
    """What a study function does: keep something in the run's folder. Tells who made it, with how many threads."""
    if name == "impossible":
        raise ValueError("this cannot be made")
    time.sleep(0.5)  # longer than to fail
    (run.folder("made") / name).write_text(f"{os.getpid()} {torch.get_num_threads()}")


def die(run: Run, name: str) -> None:
    """As where memory runs out."""
    os._exit(9)


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return runs.resolve("02_train", scale="paper", run_dir=str(tmp_path))


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tsmlib.study.parallel.cores", lambda: 2)


def test_everything_is_made_by_other_processes_of_one_thread_each(run: Run) -> None:
    study.precompute(run, [(write, name) for name in "abc"])
    made = {path.name: path.read_text().split() for path in run.folder("made").iterdir()}
    assert set(made) == set("abc")
    assert all(pid != str(os.getpid()) and threads == "1" for pid, threads in made.values())


def test_an_error_reaches_the_notebook_and_only_what_was_under_way_is_finished(run: Run) -> None:
    with pytest.raises(ValueError, match="this cannot be made"):
        study.precompute(run, [(write, name) for name in ("impossible", "a", "b", "c", "d", "e")])
    assert {"a"} <= {path.name for path in run.folder("made").iterdir()} <= {"a", "b"}


def test_a_worker_that_dies_is_told_of_and_what_to_do(run: Run) -> None:
    with pytest.raises(RunError, match="Run it again"):
        study.precompute(run, [(die, "a"), (die, "b")])


def test_a_prior_that_several_arms_share_is_trained_once(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, str]] = []
    monkeypatch.setattr(study.models, "precompute", lambda run, calls, **_: asked.extend(call[1:] for call in calls))
    study.precompute_models(run, [(env, model) for env in ENV_IDS for model in ("tsm", "prior")])
    assert len(asked) == len(set(asked)) == len(ENV_IDS) + 2


def test_the_longest_trainings_begin_first(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, str]] = []
    monkeypatch.setattr(study.models, "precompute", lambda run, calls, **_: asked.extend(call[1:] for call in calls))
    study.precompute_models(run, [(env, "tsm") for env in ENV_IDS])
    steps = [study.models.schedule(replace(run, scale="paper"), env, model)[0].steps for env, model in asked]
    assert len(asked) == len(ENV_IDS)
    assert asked[0][0] == "tsm/ReacherPush-v1"
    assert steps[0] == max(steps)


def test_only_the_paper_scale_makes_anything_ahead(run: Run) -> None:
    study.precompute(replace(run, scale="laptop"), [(write, "a"), (write, "b")])
    assert not list(run.folder("made").iterdir())


def test_one_thing_alone_is_left_to_the_notebook(run: Run) -> None:
    study.precompute(run, [(write, "a")])
    assert not list(run.folder("made").iterdir())
