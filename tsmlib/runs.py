"""Where the results of a notebook live, which parameters it takes, and how it is executed.

Everything that a run makes is in one folder, ``runs/<scale>/seed<k>/``: ``data``, ``models``, ``metrics``, ``figures``,
the executed notebooks, and ``status.json``, which alone says whether a notebook ran to its end (an executed notebook
whose kernel was killed looks complete).
"""

from __future__ import annotations

import ast
import contextlib
import json
import math
import os
import re
import signal
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = ROOT / "notebooks"
SCALES = ("smoke", "laptop", "paper")

T = TypeVar("T")


class ParameterError(ValueError):
    """A parameter that is unknown, of the wrong type or out of range. Raised before any file exists."""


class RunError(RuntimeError):
    """A notebook that did not run to its end."""


# Where things live ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """One notebook at one scale with one seed, and the folders it reads and writes (made when first asked for)."""

    notebook: str
    scale: str
    seed: int
    dir: Path

    @property
    def data(self) -> Path:
        """Collected trajectories."""
        return self.folder("data")

    @property
    def models(self) -> Path:
        """Trained models."""
        return self.folder("models")

    @property
    def metrics(self) -> Path:
        """Tables: ``<notebook>.csv`` and ``<notebook>_rows.csv``."""
        return self.folder("metrics")

    @property
    def figures(self) -> Path:
        """Pictures and videos."""
        return self.folder("figures")

    @property
    def shipped(self) -> Path:
        """The pretrained models that come with the repository. Read only."""
        return ROOT / "data" / "pretrained"

    def pick(self, *, smoke: T, laptop: T, paper: T) -> T:
        """The value for this run's scale."""
        return {"smoke": smoke, "laptop": laptop, "paper": paper}[self.scale]

    def folder(self, name: str = ".") -> Path:
        """A folder of this run, made if need be."""
        folder = self.dir / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ParameterError(
                f"cannot make the folder {folder}: {error.strerror}. Name another place with TSM_RUN_DIR."
            ) from error
        return folder


def resolve(notebook: str, *, scale: str = "", seed: int = 0, run_dir: str = "") -> Run:
    """The run that a notebook belongs to. Touches no file.

    scale: smoke, laptop or paper; '' means TSM_SCALE, and without it laptop. seed: 0 .. 2**31 - 1.
    run_dir: the folder that holds all runs, relative to the repository; '' means TSM_RUN_DIR, and without it runs.
    Raises ParameterError naming the value and what is allowed.
    """
    if type(scale) is not str:
        raise ParameterError(f"scale is {scale!r}, expected a string: one of {', '.join(SCALES)}, or ''.")
    scale, origin = (scale, "scale") if scale else (os.environ.get("TSM_SCALE") or "laptop", "TSM_SCALE")
    if scale not in SCALES:
        raise ParameterError(f"{origin} is {scale!r:.80}, expected one of {', '.join(SCALES)}.")
    if type(seed) is not int or not 0 <= seed < 2**31:
        raise ParameterError(f"seed is {seed!r:.80}, expected a whole number from 0 to {2**31 - 1}.")
    if type(run_dir) is not str:
        raise ParameterError(f"run_dir is {run_dir!r:.80}, expected a folder name as a string.")
    run_dir, origin = (run_dir, "run_dir") if run_dir else (os.environ.get("TSM_RUN_DIR") or "runs", "TSM_RUN_DIR")
    if not run_dir.isprintable() or len(run_dir) > 1000 or run_dir.startswith("~") or ".." in Path(run_dir).parts:
        raise ParameterError(
            f"{origin} is {run_dir!r:.80}, expected an absolute path, or one inside the repository, without '..', a "
            "leading '~' or control characters."
        )
    base = ROOT / run_dir
    if base.exists() and not base.is_dir():
        raise ParameterError(f"{origin} is {base}, which is a file; expected a folder.")
    return Run(notebook, scale, seed, base / scale / f"seed{seed}")


# Notebooks and their parameters --------------------------------------------------------------------------------------


def notebooks() -> dict[str, Path]:
    """Word -> file, in order: 'control' is notebooks/05_control.ipynb."""
    return {path.stem[3:]: path for path in sorted(NOTEBOOKS.glob("[0-9][0-9]_*.ipynb"))}


def parameters(notebook: Path) -> dict[str, Any]:
    """Name -> default of every parameter: the literals in the cell tagged ``parameters``."""
    try:
        cells = json.loads(notebook.read_text())["cells"]
        tagged = [cell for cell in cells if "parameters" in cell["metadata"].get("tags", [])]
        sources = ["".join(cell["source"]) for cell in tagged]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ParameterError(f"{notebook} is not a notebook: {error}. Restore it.") from error
    if len(sources) != 1:
        raise ParameterError(f"{notebook.name} has {len(sources)} cells tagged 'parameters', expected one.")
    found: dict[str, Any] = {}
    try:
        for statement in ast.parse(sources[0]).body:
            match statement:
                case ast.Assign(targets=[ast.Name(id=name)], value=value):
                    found[name] = ast.literal_eval(value)
                case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value):
                    found[name] = ast.literal_eval(value)
                case _:
                    raise ValueError(f"line {statement.lineno} is not 'name = literal'")
    except (ValueError, SyntaxError) as error:
        raise ParameterError(f"{notebook.name}, parameters cell: {error}; expected 'name = literal' only.") from error
    return found


def typed(notebook: Path, given: Mapping[str, str]) -> dict[str, Any]:
    """Values for a notebook's parameters from their text, with the types of its defaults.

    Unknown names are refused here because papermill only warns about them, and executes them as code.
    """
    defaults = parameters(notebook)
    values: dict[str, Any] = {}
    for name, text in given.items():
        if name not in defaults:
            raise ParameterError(f"{notebook.stem} has no parameter {name!r:.80}; it has {', '.join(defaults)}.")
        values[name] = convert(f"{notebook.stem}: {name}", text, type(defaults[name]))
    return values


def convert(name: str, text: str, kind: type) -> Any:
    """``text`` as a bool, int, float or string; ParameterError, naming ``name``, if it is none."""
    if kind is bool and text.lower() in ("true", "false"):
        return text.lower() == "true"
    if kind is int and re.fullmatch(r"[+-]?[0-9]{1,18}", text):
        return int(text)
    if kind is float and re.fullmatch(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?", text):
        if math.isfinite(float(text)):
            return float(text)
    elif kind is str and text.isprintable() and len(text) <= 1000:
        return text
    kinds = {bool: "true or false", int: "a whole number", float: "a finite number", str: "text on one line"}
    expected = kinds.get(kind, "to be left as it is: edit the notebook to change it")
    raise ParameterError(f"{name} is {text!r:.80}, expected {expected}.")


# Execution -----------------------------------------------------------------------------------------------------------


def execute(
    notebook: Path, *, scale: str = "", seed: int = 0, given: Mapping[str, str] | None = None, progress: bool = True
) -> Path:
    """Execute a notebook into its run's folder and return the executed copy.

    given: parameter name -> text, as typed on the command line. Everything is checked before any file exists.
    Raises ParameterError for bad parameters, RunError if another process writes to the same run or the notebook does
    not reach its end.
    """
    values = {"scale": scale, "seed": seed, **typed(notebook, given or {})}
    values = {name: values[name] for name in parameters(notebook) if name in values}
    run = resolve(notebook.stem, **{name: values[name] for name in ("scale", "seed", "run_dir") if name in values})
    if "scale" in values:
        values["scale"] = run.scale
    with _only_writer(run), _terminable():
        began = time.monotonic()
        status: dict[str, Any] = {"pid": os.getpid(), "started": _now(), "parameters": values}
        _note(run, {**status, "state": "running"})
        ended = {"state": "interrupted", "error": "stopped before its end"}
        try:
            executed = _papermill(notebook, run, values, progress)
            ended = {"state": "complete"}
        except RunError as error:
            ended = {"state": "failed", "error": str(error)}
            raise
        finally:
            seconds = round(time.monotonic() - began, 1)
            _note(run, {**status, **ended, "finished": _now(), "seconds": seconds})
    return executed


def _papermill(notebook: Path, run: Run, values: dict[str, Any], progress: bool) -> Path:
    import papermill
    from traitlets.config import Config

    output = run.dir / notebook.name
    unfinished = output.with_name(f".{notebook.stem}.running.ipynb")
    failure = None
    try:
        executed = papermill.execute_notebook(
            _literally(notebook),
            _literally(unfinished),
            values,
            kernel_name="python3",
            language="python",
            cwd=str(NOTEBOOKS),
            progress_bar={"desc": notebook.stem} if progress else False,
            config=Config({"KernelManager": {"transport_encryption": "auto"}}),  # keeps ipykernel >= 7.3 from warning
        )
        code = [cell for cell in executed.cells if cell.cell_type == "code" and cell.source.strip()]
        if any(cell.execution_count is None for cell in code):  # sys.exit(0) in a cell, for one
            failure = "it stopped before its last cell"
    except papermill.PapermillExecutionError as error:
        failure = f"cell {error.exec_count}: {error.ename}: {error.evalue}"
    except Exception as error:  # a dead kernel, a full disk, ...
        failure = f"{type(error).__name__}: {error}"
    finally:
        if unfinished.exists():
            os.replace(unfinished, output)
    if failure:
        raise RunError(f"{notebook.stem} failed: {failure}\nSee {output}")
    return output


def _literally(path: Path) -> str:
    """papermill formats paths; this keeps braces in them as they are."""
    return str(path).replace("{", "{{").replace("}", "}}")


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _note(run: Run, entry: Mapping[str, Any]) -> None:
    """Write this notebook's entry of status.json."""
    from tsmlib import store

    path = run.dir / "status.json"
    entries: dict[str, Any] = {}
    with contextlib.suppress(store.StoreError):
        entries = dict(store.read_json(path))
    store.write_json(path, {**entries, run.notebook: entry})


@contextlib.contextmanager
def _only_writer(run: Run) -> Iterator[None]:
    """Hold the run's folder; the lock goes when this process does."""
    try:
        import fcntl
    except ImportError:  # no such locks on Windows
        yield
        return
    run.folder()
    with open(run.dir / ".lock", "a+") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.seek(0)
            raise RunError(
                f"{run.dir} is being written by another process ({lock.read().strip() or 'unknown'}). Wait for it, or "
                "take another seed, or another folder with TSM_RUN_DIR."
            ) from None
        lock.truncate(0)
        lock.write(f"pid {os.getpid()}, {run.notebook}, since {_now()}")
        lock.flush()
        yield


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM ends a run as Ctrl-C does, so that its status is written and its kernel shut down."""

    def interrupt(*_: Any) -> None:
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
