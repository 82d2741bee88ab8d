"""Things made ahead, by other processes: all of them, in the run's folder, and no error is lost."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tsmlib import runs, study
from tsmlib.runs import Run


def write(run: Run, name: str) -> None:
    """What a study function does: keep something in the run's folder. Tells who made it, with how many threads."""
    if name == "impossible":
        raise ValueError("this cannot be made")
    (run.folder("made") / name).write_text(f"{os.getpid()} {torch.get_num_threads()}")


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return runs.resolve("02_train", scale="paper", run_dir=str(tmp_path))


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tsmlib.study.parallel._cores", lambda: 2)


def test_everything_is_made_by_other_processes_of_one_thread_each(run: Run) -> None:
    study.ahead(run, [(write, name) for name in "abc"])
    made = {path.name: path.read_text().split() for path in run.folder("made").iterdir()}
    assert set(made) == set("abc")
    assert all(pid != str(os.getpid()) and threads == "1" for pid, threads in made.values())


def test_an_error_reaches_the_notebook_and_what_was_made_beside_it_stays(run: Run) -> None:
    with pytest.raises(ValueError, match="this cannot be made"):
        study.ahead(run, [(write, "a"), (write, "impossible")])
    assert [path.name for path in run.folder("made").iterdir()] == ["a"]


def test_only_the_paper_scale_makes_anything_ahead(run: Run) -> None:
    study.ahead(replace(run, scale="laptop"), [(write, "a"), (write, "b")])
    assert not list(run.folder("made").iterdir())


def test_one_thing_alone_is_left_to_the_notebook(run: Run) -> None:
    study.ahead(run, [(write, "a")])
    assert not list(run.folder("made").iterdir())
