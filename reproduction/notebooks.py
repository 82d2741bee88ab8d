"""Execution of notebooks, and the status of what they made."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import json
import os
import signal
import socket
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm.auto import tqdm

from tsmlib.storage.files import STATUS, Json, StoreError, alive, writer_lock
from reproduction import parameters
from reproduction.parameters import Value
from reproduction.runs import Notebook, Run, RunError, find, home, resolve

if TYPE_CHECKING:
    from reproduction.jobs import Job

TOOLS = (
    "papermill",
    "ipykernel",
    "pandas",
    "tabulate",
    "sklearn",
    "ipywidgets",
    "imageio_ffmpeg",
)  # extra "study"


@dataclass(frozen=True)
class Execution:
    """A notebook to be executed, into the folder of its run, with values of its parameters that were checked."""

    notebook: Notebook
    run: Run
    values: Mapping[str, Value]


def prepare(
    notebook: Notebook,
    *,
    scale: str = "",
    seed: Value = 0,
    device: str = "",
    given: Mapping[str, str] | None = None,
    elsewhere: bool = False,
) -> Execution:
    """Check all that a notebook is executed with, before any file exists. given: parameter -> text, as typed.
    elsewhere: other machines will execute it, so that this one need not have the device.

    Raises ParameterError for bad parameters.
    """
    asked = {"scale": scale, "seed": seed, **parameters.typed(notebook.path, given or {})}
    values = {name: asked[name] for name in parameters.declared(notebook.path) if name in asked}
    run = resolve(notebook.stem, device=device, elsewhere=elsewhere, **values)  # type: ignore[arg-type]  # which it checks
    return Execution(notebook, run, values | ({"scale": run.scale} if "scale" in values else {}))


def code_sha256(notebook: Path) -> str:
    """SHA-256 of a notebook's code cells as they are typed, without prose, outputs and metadata."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    typed = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    return hashlib.sha256(json.dumps(typed).encode()).hexdigest()


def codes(run: Run) -> dict[str, str]:
    """Notebook -> the version of the code that made what a run holds of it, where its status states one."""
    from tsmlib.storage import manifest

    made = {
        name: entry.get("provenance", {}).get("code")
        for name, entry in manifest.statuses(run.dir).items()
        if isinstance(entry, dict)
    }
    return {name: str(code) for name, code in made.items() if code is not None}


def other_code(run: Run) -> str:
    """A sentence where another version of the code made what a run holds; empty otherwise."""
    from tsmlib.storage.provenance import provenance

    now = provenance()["code"]
    for name, code in codes(run).items():
        if code != now:
            return (
                f"note: {name} in {run.dir} was made by tsmlib {code}, this is {now}; TSM_RUN_DIR names another "
                "folder, and every file states the version that made it"
            )
    return ""


def require_tools() -> None:
    """RunError naming what the notebooks need and a plain installation lacks."""
    missing = [name for name in TOOLS if importlib.util.find_spec(name) is None]
    if missing:
        raise RunError(
            f"notebooks need {', '.join(missing)}, missing here: {sys.executable} -m pip install 'tsmlib[study]'"
        )


def execute(execution: Execution, *, progress: bool = True, wait: bool = False) -> Path:
    """Execute a notebook into its run's folder and return the executed copy.

    Raises RunError if another process executes it there (or waits for that) or the notebook does not reach its end.
    """
    from tsmlib.storage import manifest  # heavy, and not needed to refuse a parameter
    from reproduction.needed import needs

    run, hold, jobs = execution.run, contextlib.ExitStack(), needs(execution.run)
    try:
        hold.enter_context(writer_lock(run.dir, run.notebook, name=run.notebook, wait=wait))
    except StoreError as error:
        raise RunError(str(error)) from None
    record = run.dir / f".{run.notebook}.written"
    record.unlink(missing_ok=True)
    with hold, terminable(), environment(TSM_DEVICE=run.device, TSM_WRITTEN=str(record)):
        began = time.monotonic()
        status: dict[str, Json] = {
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "started": _now(),
            "scale": run.scale,
            "seed": run.seed,
            **_asked(execution),
        }
        _note(run, {**status, "state": "running"})
        before = _files(
            run, jobs
        )  # of a file that is replaced meanwhile the first counts: it is outdated then
        ended: dict[str, Json] = {"state": "interrupted", "error": "stopped before its end"}
        try:
            executed = _papermill(execution, progress)
            files = manifest.listing(run.dir, _made(run, record))
            ended = {"state": "complete", "files": files, "made_from": _files(run, jobs) | before}
        except RunError as error:
            ended = {"state": "failed", "error": str(error)}
            raise
        finally:
            seconds = round(time.monotonic() - began, 1)
            _note(run, {**status, **ended, "finished": _now(), "seconds": seconds})
            record.unlink(missing_ok=True)
    return executed


def outdated(execution: Execution) -> str:
    """Why a notebook is to be executed; '' where what the run holds of it is as it was left, and was made by this code,
    these cells and values, on this device and from the files of jobs that are there."""
    run = execution.run
    if not (entry := _complete(run)):
        return "it did not come to its end yet"
    asked, stated = _deciding(_asked(execution)), _deciding(entry)
    if differs := [name for name, value in asked.items() if stated[name] != value]:
        return f"its {' and '.join(differs)} changed"
    if files := replaced(run):
        return f"{files[0]} is not what it was made from"
    if not (run.dir / execution.notebook.path.name).exists():
        return f"{execution.notebook.path.name} is gone"
    try:
        _intact(run, run.notebook)
    except RunError as error:
        return str(error)
    return ""


def replaced(run: Run) -> list[str]:
    """Files of jobs, relative to the run's folder, that are others than those that its complete notebook was made
    from."""
    from reproduction.needed import needs

    if not (entry := _complete(run)):
        return []
    stated, found = dict(entry.get("made_from", {})), _files(run, needs(run))
    return [file for file in {**stated, **found} if stated.get(file) != found.get(file)]


def span(run: Run) -> tuple[str, str]:
    """When the execution of a complete notebook began and ended."""
    entry = _complete(run)
    return str(entry["started"]), str(entry["finished"])


def _complete(run: Run) -> Mapping[str, Any]:
    """The status of a run's notebook where it came to its end; else nothing."""
    from tsmlib.storage import manifest

    entry = manifest.statuses(run.dir).get(run.notebook)
    return entry if isinstance(entry, dict) and entry.get("state") == "complete" else {}


def _deciding(entry: Mapping[str, Any]) -> dict[str, Json]:
    """What of a status decides what a notebook makes, which the folder of the runs does not."""
    values = {
        name: value for name, value in entry.get("parameters", {}).items() if name != "run_dir"
    }
    code = entry.get("provenance", {}).get("code")
    return {
        "parameters": values,
        "device": entry.get("device"),
        "cells": entry.get("notebook"),
        "code": code,
    }


def _files(run: Run, jobs: Iterable[Job]) -> dict[str, Json]:
    """File -> SHA-256, as it says itself, of what jobs have made in a run's folder, or else ships in place of that."""
    from tsmlib.storage import artifacts

    found: dict[str, Json] = {}
    for job in jobs:
        path = run.dir / (file := f"{job.name}.safetensors")
        if not path.exists() and job.ships(run):
            path = run.shipped / path.parent.name / path.name
        if path.exists():
            found[file] = artifacts.checksum(path)
    return found


def _asked(execution: Execution) -> dict[str, Json]:
    """What a status states of what its notebook is executed with."""
    from tsmlib.storage.provenance import provenance

    cells, own = code_sha256(execution.notebook.path), find(execution.notebook.stem)
    return {
        "parameters": dict(execution.values),
        "device": execution.run.device,
        "provenance": provenance(),
        "notebook": cells,
        "changed_copy": own is not None and code_sha256(own.path) != cells,
    }


def require(run: Run, notebook: str, *, cells: str = "") -> Mapping[str, Json]:
    """The status entry of a notebook of ``run`` that is complete, whose results are as it left them, and which was no
    changed copy of the one that shipped then.

    cells: ``code_sha256`` of a changed copy that counts, too.
    Raises RunError naming the state and the command that makes what is missing.
    """
    entry, own = _intact(run, notebook), find(notebook)
    if own and entry.get("changed_copy") and entry.get("notebook") != cells:
        raise RunError(
            f"{notebook} in {run.dir} was executed from a copy with other cells than {own.path.name}, so nothing else "
            f"reads what it made. Run the notebook that ships, in place of it: {run.command(own.name)}"
        )
    return entry


def _intact(run: Run, notebook: str) -> Mapping[str, Json]:
    """The same, whatever its cells were."""
    from tsmlib.storage import manifest

    own = find(notebook)
    command = run.command(own.name if own else "all")
    entries = manifest.statuses(run.dir)
    entry = entries.get(notebook, {"state": "not run"})
    state = entry.get("state") if isinstance(entry, dict) else "damaged"
    if state == "running" and not alive(entry.get("pid"), entry.get("host")):
        state = "interrupted: its process is gone"
    if state == "complete" and {"files", "sha256"} & set(entry) and not manifest.intact(entry):
        state = "damaged"  # older ones have neither
    if state != "complete":
        what = "Wait for it, or run it again" if state == "running" else "Run it"
        raise RunError(
            f"{notebook} in {run.dir} is {state!s:.80}, expected complete. {what}: {command}"
        )
    try:
        last = manifest.made_by(
            entries
        )  # a file that another notebook made again is no longer this one's
        changed = [
            file
            for file, stated in entry.get("files", {}).items()
            if last.get(file) == notebook
            and (
                not (run.dir / file).is_file()
                or manifest.sha256(run.dir / file) != stated["sha256"]
            )
        ]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        changed = [f"{STATUS} ({error!r:.80})"]
    if changed:
        raise RunError(
            f"{run.dir / changed[0]} is not what {notebook} made, or is gone. Run it again: {command}"
        )
    return entry


def _made(run: Run, record: Path) -> list[Path]:
    """Tables and pictures of a run that its notebook's kernel wrote (``runs.record_written``), those that are left."""
    written = {Path(line) for line in record.read_text().splitlines()} if record.exists() else set()
    folders = (run.dir / "metrics", run.dir / "figures")
    made = (path for path in written if path.parent in folders and not path.name.startswith("."))
    return sorted(path for path in made if path.is_file())


def _papermill(execution: Execution, progress: bool) -> Path:
    import papermill
    from nbclient.exceptions import DeadKernelError
    from traitlets.config import Config

    notebook = execution.notebook
    output = execution.run.dir / notebook.path.name
    unfinished = output.with_name(f".{notebook.stem}.running.ipynb")
    failure, seen = None, ""
    try:
        options = Config(
            {"KernelManager": {"transport_encryption": "auto"}}
        )  # keeps ipykernel >= 7.3 from warning
        bar = {"desc": notebook.stem} if progress else False
        executed = papermill.execute_notebook(
            _literally(notebook.path),
            _literally(unfinished),
            dict(execution.values),
            kernel_name="python3",
            language="python",
            cwd=str(home()),
            progress_bar=bar,
            config=options,
            stdout_file=_Terminal() if progress else None,
        )
        code = [cell for cell in executed.cells if cell.cell_type == "code" and cell.source.strip()]
        if any(cell.execution_count is None for cell in code):  # sys.exit(0) in a cell, for one
            failure = "it stopped before its last cell"
    except papermill.PapermillExecutionError as error:
        failure = f"cell {error.exec_count}: {error.ename}: {error.evalue}"
    except DeadKernelError:
        failure = "its kernel died, perhaps for want of memory. Run it again: trainings go on where they were"
    except Exception as error:  # no kernel, a full disk, ...
        failure = f"{type(error).__name__}: {error}"
    finally:
        if unfinished.exists() and _is_whole(unfinished):
            os.replace(unfinished, output)
            seen = f"\nSee {output}"
        unfinished.unlink(missing_ok=True)
    if failure:
        raise RunError(f"{notebook.stem} failed: {failure}{seen}")
    return output


class _Terminal:
    """What a notebook prints, above the progress bar as it comes: that a model is missing and is trained now, say."""

    def write(self, text: str) -> None:
        tqdm.write(text, file=sys.stderr, end="")

    def flush(self) -> None:
        sys.stderr.flush()


def _is_whole(notebook: Path) -> bool:
    """Whether papermill came to the end of writing it, which a full disk prevents."""
    try:
        return bool(json.loads(notebook.read_text())["cells"])
    except (OSError, ValueError, KeyError):
        return False


def _literally(path: Path) -> str:
    """papermill formats paths; this keeps braces in them as they are."""
    return str(path).replace("{", "{{").replace("}", "}}")


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _note(run: Run, entry: Mapping[str, Json]) -> None:
    """Write the status of this notebook."""
    from tsmlib.storage import manifest

    manifest.write_json(run.dir / f"{run.notebook}.{STATUS}", manifest.sealed(entry))


@contextlib.contextmanager
def environment(**values: str) -> Iterator[None]:
    """Processes that start meanwhile, a kernel for one, have ``values`` in their environment."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """SIGTERM ends a run as Ctrl-C does, so that its status is written and its kernel shut down."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    try:
        before = signal.signal(signal.SIGTERM, interrupt)
    except ValueError:  # not in the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
