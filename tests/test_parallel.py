"""Jobs made ahead, by other processes: all of them, each after what it needs, and no error is lost."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

from tsmlib import study
from tsmlib.envs.spec import ENV_IDS
from tsmlib.storage.files import Json
from tsmlib.study import runs
from tsmlib.study.jobs import Job, Model, complete
from tsmlib.study.parallel import cores
from tsmlib.study.parameters import ParameterError
from tsmlib.study.runs import Run, RunError


@dataclass(frozen=True)
class Write:
    """A job that keeps who made it, with how many threads, in the run's folder."""

    name: str
    after: tuple[str, ...] = ()
    kind = "data"

    def needs(self, run: Run) -> list[Job]:
        return [Write(name) for name in self.after]

    def settings(self, run: Run) -> Json:
        return None

    def seconds(self, run: Run) -> float:
        return 9.0 if self.after else 1.0

    def make(self, run: Run) -> None:
        if self.name == "impossible":
            raise ValueError("this cannot be made")
        if self.name == "deadly":
            os._exit(9)  # as where memory runs out
        assert all((run.folder("made") / name).exists() for name in self.after)
        time.sleep(0.5)  # longer than to fail
        (run.folder("made") / self.name).write_text(f"{os.getpid()} {torch.get_num_threads()}")


@dataclass(frozen=True)
class Keep(Write):
    """A job that finds its file again."""

    def make(self, run: Run) -> None:
        run.dir.mkdir(parents=True, exist_ok=True)
        with open(run.dir / "calls", "a") as file:
            file.write(self.name)
        (path := run.dir / f"{self.name}.safetensors").exists() or path.touch()


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return runs.resolve("02_train", scale="paper", run_dir=str(tmp_path))


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tsmlib.study.parallel.cores", lambda: 2)


def test_everything_is_made_by_other_processes_of_one_thread_each(run: Run) -> None:
    study.precompute(run, [Write("c", after=("a", "b"))])
    made = {path.name: path.read_text().split() for path in run.folder("made").iterdir()}
    assert set(made) == set("abc")
    assert all(pid != str(os.getpid()) and threads == "1" for pid, threads in made.values())


def test_no_process_is_started_where_nothing_is_left_to_make(run: Run) -> None:
    jobs, calls = [Keep("a"), Keep("b")], run.dir / "calls"
    study.precompute(run, jobs)
    study.precompute(run, jobs)
    assert sorted(calls.read_text()) == ["a", "b"]
    (run.dir / "b.safetensors").unlink()
    study.precompute(run, jobs)
    assert sorted(calls.read_text()) == ["a", "a", "b", "b"]


def test_the_processes_are_as_many_as_the_environment_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TSM_JOBS", raising=False)
    assert cores() >= 1
    monkeypatch.setenv("TSM_JOBS", "3")
    assert cores() == 3
    for wrong in ("0", "-1", "1.5", "many", "٣", " 2"):
        monkeypatch.setenv("TSM_JOBS", wrong)
        with pytest.raises(ParameterError, match=r"TSM_JOBS is '.*', expected a whole number"):
            cores()


def test_an_error_reaches_the_notebook_and_only_what_was_under_way_is_finished(run: Run) -> None:
    with pytest.raises(ValueError, match="this cannot be made"):
        study.precompute(run, [Write(name) for name in ("impossible", "a", "b", "c", "d", "e")])
    assert {"a"} <= {path.name for path in run.folder("made").iterdir()} <= {"a", "b"}


def test_a_worker_that_dies_is_told_of_and_what_to_do(run: Run) -> None:
    with pytest.raises(RunError, match="Run it again"):
        study.precompute(run, [Write("deadly"), Write("b")])


def test_a_prior_that_several_arms_share_is_trained_once(run: Run) -> None:
    jobs = complete(run, [Model(env, model) for env in ENV_IDS for model in ("tsm", "prior")]).values()
    assert len([job for job in jobs if isinstance(job, Model)]) == len(ENV_IDS) + 2


def test_a_model_takes_longer_where_its_training_has_more_updates(run: Run) -> None:
    longest = max((Model(env, "tsm") for env in ENV_IDS), key=lambda job: job.seconds(run))
    assert longest.env == "tsm/ReacherPush-v1"


def test_only_the_paper_scale_makes_anything_ahead(run: Run) -> None:
    study.precompute(replace(run, scale="laptop"), [Write("a"), Write("b")])
    assert not list(run.folder("made").iterdir())


def test_one_thing_alone_is_left_to_the_notebook(run: Run) -> None:
    study.precompute(run, [Write("a")])
    assert not list(run.folder("made").iterdir())
