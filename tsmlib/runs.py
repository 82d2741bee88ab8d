"""Where the results of a notebook live, how it is executed, and what is known of a run afterwards.

Everything that a run makes is in one folder, ``runs/<scale>/seed<k>/``: ``data``, ``models``, ``metrics``, ``figures``,
the executed notebooks, and ``status.json``, which alone says whether a notebook ran to its end (an executed notebook
whose kernel was killed looks complete): running, complete, failed or interrupted, with what made it and the SHA-256 of
each table and picture. `require` refuses what is not complete.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from tsmlib import parameters as schema
from tsmlib.disk import alive, only_writer
from tsmlib.parameters import ParameterError

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = ROOT / "notebooks"

T = TypeVar("T")


class RunError(RuntimeError):
    """A notebook that did not run to its end, or whose results are asked for all the same."""


# Where things live ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """One notebook at one scale with one seed, and the folders it reads and writes (made when first asked for)."""

    notebook: str
    scale: str
    seed: int
    dir: Path
    device: str = "cpu"  # where ``study`` trains, learns, plans and imagines

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


def resolve(
    notebook: str, *, scale: str = "", seed: int = 0, run_dir: str = "", device: str = "", **others: Any
) -> Run:
    """The run that a notebook belongs to. Touches no file.

    scale: smoke, laptop or paper; '' means TSM_SCALE, and without it laptop. seed: 0 .. 2**31 - 1.
    run_dir: the folder that holds all runs, relative to the repository; '' means TSM_RUN_DIR, and without it runs.
    device: cpu, cuda or cuda:N; '' means TSM_DEVICE, and without it cpu.
    others: the notebook's other parameters, checked against the same schema.
    Raises ParameterError naming the value and what is allowed.
    """
    schema.check("seed", seed)
    scale = _setting("scale", scale, "TSM_SCALE", "laptop")
    device = _present(_setting("device", device, "TSM_DEVICE", "cpu"))
    base = ROOT / _setting("run_dir", run_dir, "TSM_RUN_DIR", "runs")
    defaults = schema.declared(notebooks()[notebook[3:]]) if others and notebook[3:] in notebooks() else {}
    for name, value in others.items():
        schema.check(name, value, default=defaults.get(name, value))
    try:
        if base.exists() and not base.is_dir():
            raise ParameterError(f"run_dir is {base}, which is a file; expected a folder. Name another.")
    except (OSError, ValueError) as error:
        if isinstance(error, ParameterError):
            raise
        raise ParameterError(f"run_dir is {str(base)[:80]!a}, expected the name of a folder: {error}.") from None
    return Run(notebook, scale, seed, base / scale / f"seed{seed}", device)


def _setting(name: str, value: str, variable: str, default: str) -> str:
    """A parameter, else its environment variable, else ``default``."""
    schema.check(name, value)
    return value or schema.check(name, os.environ.get(variable, ""), origin=variable) or default


def _present(device: str) -> str:
    """``device``, if this machine has it."""
    if device == "cpu":
        return device
    import torch  # heavy, and not needed otherwise

    found, asked = torch.cuda.device_count() if torch.cuda.is_available() else 0, torch.device(device).index or 0
    if asked >= found:
        raise ParameterError(
            f"device is {device}, but torch {torch.__version__} finds {found} such devices here. Leave --device (or "
            "TSM_DEVICE) out, or install a torch that is built for this machine's: https://pytorch.org/get-started"
        )
    return device


# Notebooks ------------------------------------------------------------------------------------------------------------


def notebooks() -> dict[str, Path]:
    """Word -> file, in order: 'control' is notebooks/05_control.ipynb."""
    return {path.stem[3:]: path for path in sorted(NOTEBOOKS.glob("[0-9][0-9]_*.ipynb"))}


# Execution -----------------------------------------------------------------------------------------------------------


def execute(
    notebook: Path,
    *,
    scale: str = "",
    seed: int = 0,
    device: str = "",
    given: Mapping[str, str] | None = None,
    progress: bool = True,
) -> Path:
    """Execute a notebook into its run's folder and return the executed copy.

    given: parameter name -> text, as typed on the command line. Everything is checked before any file exists.
    Raises ParameterError for bad parameters, RunError if another process writes to the same run or the notebook does
    not reach its end.
    """
    defaults = schema.declared(notebook)
    values = {"scale": scale, "seed": seed, **schema.typed(notebook, given or {})}
    values = {name: values[name] for name in defaults if name in values}
    own = {name: values[name] for name in ("scale", "seed", "run_dir") if name in values}
    run = resolve(notebook.stem, device=device, **own)
    if "scale" in values:
        values["scale"] = run.scale
    from tsmlib import store  # heavy, and not needed to refuse a parameter
    from tsmlib.provenance import provenance

    try:
        hold = contextlib.ExitStack()
        hold.enter_context(only_writer(run.dir, run.notebook))
    except store.StoreError as error:
        raise RunError(str(error)) from None
    with hold, _terminable(), _environment("TSM_DEVICE", run.device):
        began = time.monotonic()
        before = _stamps(run)
        status: dict[str, Any] = {"pid": os.getpid(), "started": _now(), "parameters": values}
        status |= {"scale": run.scale, "seed": run.seed, "device": run.device, "provenance": provenance()}
        _note(run, {**status, "state": "running"})
        ended: dict[str, Any] = {"state": "interrupted", "error": "stopped before its end"}
        try:
            executed = _papermill(notebook, run, values, progress)
            made = [path for path, stamp in _stamps(run).items() if before.get(path) != stamp]
            ended = {"state": "complete", "files": store.listing(run.dir, sorted(made))}
        except RunError as error:
            ended = {"state": "failed", "error": str(error)}
            raise
        finally:
            seconds = round(time.monotonic() - began, 1)
            _note(run, {**status, **ended, "finished": _now(), "seconds": seconds})
    return executed


def require(run: Run, notebook: str) -> dict[str, Any]:
    """The status entry of a notebook of ``run`` that is complete and whose results are as it left them.

    Raises RunError naming the state and the command that makes what is missing.
    """
    from tsmlib import store

    command = f"python -m tsmlib run {notebook[3:]} --scale {run.scale} --seed {run.seed}"
    path = run.dir / store.STATUS
    entry: Any = (
        store.read_own_json(path).get(notebook, {"state": "not run"}) if path.exists() else {"state": "not run"}
    )
    state = entry.get("state") if isinstance(entry, dict) else "damaged"
    if state == "running" and not alive(entry.get("pid")):
        state = "interrupted: its process is gone"
    if state == "complete" and {"files", "sha256"} & set(entry) and not store.intact(entry):  # older ones have neither
        state = "damaged"
    if state != "complete":
        what = "Wait for it, or run it again" if state == "running" else "Run it"
        raise RunError(f"{notebook} in {run.dir} is {state!s:.80}, expected complete. {what}: {command}")
    try:
        changed = [
            name
            for name, file in entry.get("files", {}).items()
            if not (run.dir / name).is_file() or store.sha256(run.dir / name) != file["sha256"]
        ]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        changed = [f"{store.STATUS} ({error!r:.80})"]
    if changed:
        raise RunError(f"{run.dir / changed[0]} is not what {notebook} made, or is gone. Run it again: {command}")
    return entry


def _stamps(run: Run) -> dict[Path, tuple[int, int]]:
    """Tables and pictures of a run, and when each was written."""
    found = [path for folder in ("metrics", "figures") for path in (run.dir / folder).glob("[!.]*") if path.is_file()]
    return {path: (path.stat().st_mtime_ns, path.stat().st_ino) for path in found}


def _papermill(notebook: Path, run: Run, values: dict[str, Any], progress: bool) -> Path:
    import papermill
    from nbclient.exceptions import DeadKernelError
    from traitlets.config import Config

    output = run.dir / notebook.name
    unfinished = output.with_name(f".{notebook.stem}.running.ipynb")
    failure, seen = None, ""
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


def _note(run: Run, entry: Mapping[str, Any]) -> None:
    """Write this notebook's entry of status.json. A file that it made again is no longer another's."""
    from tsmlib import store

    path = run.dir / store.STATUS
    entries: dict[str, Any] = store.read_own_json(path) if path.exists() else {}
    entries[run.notebook] = store.sealed(entry)
    for name, other in entries.items():
        if name != run.notebook and store.intact(other) and set(other.get("files", {})) & set(entry.get("files", {})):
            rest = {file: stated for file, stated in other["files"].items() if file not in entry["files"]}
            entries[name] = store.sealed({**other, "files": rest})
    store.write_json(path, entries)


@contextlib.contextmanager
def _environment(name: str, value: str) -> Iterator[None]:
    """Processes that start meanwhile, a kernel for one, have ``value`` in their environment."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        os.environ.pop(name)
        if before is not None:
            os.environ[name] = before


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
