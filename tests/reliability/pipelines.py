"""R12, R14, R20, R21: whole runs: cells out of order, killed runners, other surroundings, other numbers of threads."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import nbformat
import numpy as np

from reliability.world import Outcome, folder, in_child, new_model, refusal, rng
from reproduction import notebooks, runs
from reproduction.runs import ROOT, RunError

TESTS = str(Path(__file__).resolve().parent.parent)


# The truth about a run -----------------------------------------------------------------------------------------------

SLEEPER = "import os, sys, time\nopen({mark!r}, 'w').write(str(os.getpid()))\ntime.sleep(3600)"
RUNNER = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "import sys; from pathlib import Path; from reproduction import notebooks, runs; from tsmlib.__main__ import main\n"
    "runs.NOTEBOOKS = notebooks.NOTEBOOKS = Path(sys.argv[1]); sys.exit(main(['run', 'first', '--scale', 'smoke']))"
)


def write_notebook(path: Path, *cells: str) -> None:
    """A notebook with a parameters cell and ``cells``."""
    notebook = nbformat.v4.new_notebook(
        metadata={"kernelspec": {"name": "python3", "display_name": "Python 3"}}
    )
    first = 'scale = ""\nseed = 0\nrun_dir = ""'
    notebook.cells = [nbformat.v4.new_code_cell(source) for source in (first, *cells)]
    notebook.cells[0].metadata["tags"] = ["parameters"]
    path.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, path)


def killed_runs(trials: int) -> Outcome:
    """R14: kernel SIGKILL, sys.exit(0), an error, SIGINT, SIGTERM, SIGKILL of the runner: never complete, refused."""
    found = Outcome()
    for trial in range(trials):
        how = ("kernel SIGKILL", "sys.exit(0)", "an error", "SIGINT", "SIGTERM", "SIGKILL")[
            trial % 6
        ]
        with folder() as place:
            mark = place / "inside"
            cells = {"sys.exit(0)": "import sys; sys.exit(0)", "an error": "1 / 0"}
            cell = cells.get(how, SLEEPER.format(mark=str(mark)))
            write_notebook(place / "notebooks" / "01_first.ipynb", cell, "print('after')")
            environment = {
                **os.environ,
                "TSM_RUN_DIR": str(place / "runs"),
                "PYTHONPATH": str(ROOT),
            }
            command = [sys.executable, "-c", RUNNER, str(place / "notebooks")]
            with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as process:
                if how not in ("sys.exit(0)", "an error"):
                    while not (mark.exists() and mark.read_text()):
                        time.sleep(0.05)
                    time.sleep(rng(14, trial).uniform(0, 0.3))
                    kernel = int(mark.read_text())
                    if how == "kernel SIGKILL":
                        os.kill(kernel, signal.SIGKILL)
                    else:
                        process.send_signal(getattr(signal, how))
                code = process.wait(600)
            state = json.loads((place / "runs/smoke/seed0/01_first.status.json").read_text())[
                "state"
            ]
            found.count(code != 0 and state != "complete", f"{how}: exit {code}, {state}")
            run = runs.resolve("02_second", scale="smoke", run_dir=str(place / "runs"))
            with patch.object(runs, "NOTEBOOKS", place / "notebooks"):
                said = refusal(lambda: notebooks.require(run, "01_first"), RunError)  # noqa: B023
            found.count("python -m tsmlib run first" in said, f"{how}: {said}")
            if how == "SIGKILL":
                with contextlib.suppress(ProcessLookupError):
                    os.kill(kernel, signal.SIGKILL)
    return found


# Out of order --------------------------------------------------------------------------------------------------------


def cells_out_of_order(trials: int) -> Outcome:
    """R12: each cell of a notebook alone, and its cells in random order: a table is said not to be the notebook's.

    A table that comes about in this way may say anything: the cell that writes it says so, and without a complete run
    in a status nothing downstream reads it. What a cell needs and does not find is a NameError or an error of ours.
    """
    from reliability.training import kernel, printed

    found, tables = Outcome(), 0
    for word, notebook in runs.notebooks().items():
        cells = [
            cell.source
            for cell in nbformat.read(notebook.path, 4).cells
            if cell.cell_type == "code"
        ]
        mixed = [
            random.Random(trial).sample(range(len(cells)), len(cells)) for trial in range(trials)
        ]
        with kernel(TSM_SCALE="smoke", TQDM_DISABLE="1") as (_, client):
            for order in [[index] for index in range(len(cells))] + mixed:
                with folder() as place:
                    anew = (
                        f"%reset -f\nimport os; os.environ['TSM_RUN_DIR'] = {str(place)!r}; del os"
                    )
                    printed(client, anew)
                    for index in order:
                        before = written(place)
                        reply, said = printed(client, cells[index])
                        if new := written(place) - before:
                            found.count(
                                "may differ from the notebook's" in said,
                                f"{word}, cell {index}: {new}",
                            )
                        ours = ("NameError", "StoreError", "ParameterError", "RunError")
                        known = reply["status"] == "ok" or reply["ename"] in ours
                        known = known or str(reply["evalue"]).startswith(
                            "the reward fails on"
                        )  # of another robot
                        found.count(
                            known,
                            f"{word}, cell {index} of {order}: {reply.get('ename')}: {reply.get('evalue')}",
                        )
                    tables += len(list(place.rglob("metrics/*.csv")))
                    run = runs.resolve(notebook.stem, scale="smoke", run_dir=str(place))
                    said = refusal(lambda: notebooks.require(run, notebook.stem), RunError)  # noqa: B023
                    found.count(
                        f"python -m tsmlib run {word} --scale smoke" in said, f"{word}: {said}"
                    )
    found.note = f"{tables} tables came about; each is said, none taken for a result"
    return found


def written(place: Path) -> set[tuple[str, int]]:
    """Each table below a folder, and when it was written."""
    return {(path.name, path.stat().st_mtime_ns) for path in place.rglob("metrics/*.csv")}


def notebooks_in_any_order(trials: int) -> Outcome:
    """R12: all notebooks in two orders, one of them twice: the same tables, but for what was measured in seconds."""
    found, first = Outcome(), {}
    for trial in range(trials):
        order = list(runs.notebooks().values())
        if trial:
            random.Random(trial).shuffle(order)
        with folder() as place:
            for _ in range(1 if trial else 2):  # the second time models, scores and plans are there
                for notebook in order:
                    done = subprocess.run(
                        [sys.executable, "-m", "tsmlib", "run", notebook.name, "--scale", "smoke"],
                        env={
                            **os.environ,
                            "TSM_RUN_DIR": str(place),
                            "OMP_NUM_THREADS": "1",
                            "PYTHONPATH": str(ROOT),
                        },
                        cwd=place,
                        capture_output=True,
                        text=True,
                        check=False,
                    )
                    found.count(done.returncode == 0, done.stderr[-500:])
                tables = {path.name: numbers(path) for path in place.rglob("metrics/*.csv")}
                first = first or tables
                for name in sorted(first):
                    found.count(
                        tables.get(name) == first[name],
                        f"{name} differs in order {[p.stem for p in order]}",
                    )
    found.note = f"{len(runs.notebooks())} notebooks, {len(first)} tables"
    return found


def notebooks_in_workflows(trials: int = 0) -> Outcome:
    """R12: all notebooks of two seeds by the pool and by Snakemake: the same tables, but for what a clock measured."""
    found, made = Outcome(), list[dict[str, list[Any]]]()
    if importlib.util.find_spec("snakemake") is None:
        return Outcome(note="no Snakemake: not done")
    for executor in ("pool", "local"):
        with folder() as place:
            command = [
                "-m",
                "tsmlib",
                "run",
                "all",
                "--scale",
                "smoke",
                "--seeds",
                "0,2",
                "--executor",
                executor,
            ]
            done = subprocess.run(
                [sys.executable, *command],
                env={
                    **os.environ,
                    "TSM_RUN_DIR": str(place),
                    "OMP_NUM_THREADS": "1",
                    "PYTHONPATH": str(ROOT),
                },
                cwd=place,
                capture_output=True,
                text=True,
                check=False,
            )
            found.count(done.returncode == 0, done.stderr[-500:])
            made.append(
                {
                    str(path.relative_to(place)): numbers(path)
                    for path in place.rglob("metrics/*.csv")
                }
            )
    pool, workflow = made
    found.count(pool, "no tables")
    for name in sorted(pool.keys() | workflow.keys()):
        found.count(pool.get(name) == workflow.get(name), f"{name} differs")
    found.note = f"{len(runs.notebooks())} notebooks, 2 seeds, {len(pool)} tables"
    return found


def numbers(table: Path) -> list[Any]:
    """The rows of a table without what a clock measured."""
    from tsmlib.storage import tables as tables_storage

    rows = tables_storage.records(tables_storage.load(table))
    return [row for row in rows if "second" not in f"{row['metric']} {row['unit']}"]


# Elsewhere -----------------------------------------------------------------------------------------------------------

WHOLE = """
import hashlib, json, os, sys
os.umask(int(sys.argv[2], 8))
import torch; torch.set_num_threads(int(sys.argv[3]))
from tsmlib import study
from tsmlib.storage import artifacts, manifest
from reproduction import runs
for seed in range(int(sys.argv[4])):
    run = runs.resolve("05_control", scale="smoke", seed=seed, run_dir=sys.argv[1])
    net, header = study.load_or_train(run, "tsm/Reacher-v0", "tsm")
    task = study.load_task("tsm/Reacher-v0", "validation").take(2)
    trial = study.trial(run, task, study.method("tsm", "direct", "cem"))
    data = {path.name: manifest.sha256(path) for path in sorted((run.data / "Reacher").glob("*.safetensors"))}
    curve = header["curves"]["loss"]
    print("made", json.dumps({
        "data": data, "weights": artifacts.digest(net.state_dict()), "plan": artifacts.digest({"u": trial.actions}),
        "losses": [curve["train"], curve["validation"]], "validation": curve["validation"][-1],
        "predicted": trial.plan.predicted_return.mean().item(),
    }))
"""


def whole(
    place: Path, *, umask: str = "022", threads: int = 1, seeds: int = 1, **environment: str
) -> list[Any]:
    """Data, a model and plans of each of the first seeds, made in a fresh process."""
    done = subprocess.run(
        [sys.executable, "-c", WHOLE, str(place / "runs"), umask, str(threads), str(seeds)],
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": str(threads), **environment},
        cwd=place,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line[5:]) for line in done.stdout.splitlines() if line.startswith("made ")]


ELSEWHERE: list[dict[str, str]] = [
    {"TZ": "UTC", "LANG": "C.UTF-8", "PYTHONHASHSEED": "0"},
    {
        "TZ": "Asia/Kathmandu",
        "LANG": "de_DE.UTF-8",
        "LC_ALL": "C",
        "PYTHONHASHSEED": "12345",
        "umask": "077",
    },
    {
        "TZ": "America/St_Johns",
        "LANG": "tr_TR.UTF-8",
        "PYTHONHASHSEED": "4294967295",
        "umask": "000",
        "HOME": "/none",
    },
]


def elsewhere(trials: int) -> Outcome:
    """R20: fresh processes with another folder, time zone, locale, hash seed, umask: the same data, weights, plans."""
    found, made = Outcome(), []
    for surroundings in ELSEWHERE[:trials]:
        with folder() as place:
            there = place / f"a folder ü {len(made)}"
            there.mkdir()
            made += whole(there, **surroundings)
            for name in made[0]:
                found.count(made[-1][name] == made[0][name], f"{name} differs with {surroundings}")
    return found


def threads(trials: int) -> Outcome:
    """R21: one and two threads over many seeds: the mean difference lies within half a seed's standard deviation."""
    found, values = Outcome(), []
    for count in (1, 2):
        with folder() as place:
            made = whole(place, threads=count, seeds=trials)
            values.append(np.array([[one["validation"], one["predicted"]] for one in made]))
    one, two = values
    deviation, difference = one.std(0, ddof=1), two - one
    mean, error = difference.mean(0), difference.std(0, ddof=1) / np.sqrt(trials)
    for i, name in enumerate(("validation loss", "predicted return")):
        reach = abs(mean[i]) + 1.729 * error[i]  # 90 %, 19 degrees of freedom
        said = f"{name}: {mean[i]:.3g} +- {error[i]:.3g}, deviation {deviation[i]:.3g}"
        found.count(deviation[i] > 0 and reach <= 0.5 * deviation[i], said)
    found.note = (
        f"largest difference {np.max(np.abs(mean) / deviation):.3f} of a seed's standard deviation"
    )
    return found


def another_thread_count(trials: int = 0) -> Outcome:
    """R21: a training that goes on with another number of threads says so and notes it with the model."""
    import warnings

    import torch

    from reliability.training import stopped_at
    from reliability.world import HELD_OUT, SIZES, TRAIN
    from tsmlib.training.fit import TrainingOptions, fit

    found = Outcome()

    def work(place: Path, count: int) -> tuple[list[str], list[str]]:
        torch.get_num_threads = lambda: count  # only said: a forked child cannot have more than one
        model = new_model()
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            curve = fit(
                model,
                model.loss,
                TRAIN,
                HELD_OUT,
                TrainingOptions(**SIZES),
                checkpoint=place / "run",
            )
        return curve.resumed, [str(warning.message) for warning in said]

    for count in (1, 2):
        with folder() as place:
            in_child(lambda: stopped_at(place / "run", 9))
            noted, said = in_child(lambda: work(place, count))  # noqa: B023
            if count == 1:
                found.count(not noted and not said, f"{noted} {said}")
            else:
                found.count(noted == ["at step 8: threads 1 -> 2"], str(noted))
                found.count(
                    said and "threads 1 -> 2" in said[0] and "last bits" in said[0], str(said)
                )
    return found
