"""Runs: scale, seed, device and folders of what a notebook makes.

Everything that a run makes is in one folder, ``runs/<scale>/seed<k>/``: ``data``, ``models``, ``metrics``, ``figures``,
the executed notebooks, and of each a status, ``05_control.status.json``, which alone says whether it ran to its end
(``notebooks.require``).

What ships lies in ``ROOT``, below ``data`` and ``notebooks``: in a checkout the repository, in an installed package
``tsmlib/_shipped``, which ``setup.py`` puts into a wheel. A checkout has its runs in the repository, an installed
package in the working directory.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from reproduction import live, parameters
from reproduction.parameters import ParameterError, Value

_PACKAGE = Path(__file__).resolve().parents[1]
INSTALLED = (_PACKAGE / "_shipped").is_dir()  # from a wheel
ROOT = _PACKAGE / "_shipped" if INSTALLED else _PACKAGE.parent
NOTEBOOKS = ROOT / "notebooks"
RESULTS = ROOT / "data" / "results"  # the published tables
FIGURES = ROOT / "figures"  # drawn of them; an installation has none
TESTED = range(
    401, 1032
)  # seeds whose episodes in 09_your_own, up to 600, begin by resets that are for its tests

T = TypeVar("T")


class RunError(RuntimeError):
    """A notebook that did not run to its end, or whose results are asked for all the same."""


@dataclass(frozen=True)
class Run:
    """One notebook at one scale with one seed, and the folders it reads and writes (made when first asked for)."""

    notebook: str
    scale: str
    seed: int
    dir: Path
    device: str = "cpu"  # where ``study`` trains, learns, plans and imagines
    parameters: Mapping[str, Value] = field(
        default_factory=dict, compare=False
    )  # the notebook's others, as given

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
        """Tables: ``<notebook>.csv`` and ``<notebook>_rows.csv``, to be written; ``notebooks.require`` before reading.

        A live kernel whose cells did not run as the notebook's do says so.
        """
        if (own := find(self.notebook)) and (how := live.deviation(own.path)):
            print(
                f"{how}: a table that this cell writes may differ from the notebook's, and nothing else reads it. Run "
                f"all cells from the first, or: {self.command(own.name)}"
            )
        return self.folder("metrics")

    @property
    def figures(self) -> Path:
        """Pictures and videos."""
        return self.folder("figures")

    @property
    def shipped(self) -> Path:
        """The pretrained models that come with the package. Read only."""
        return ROOT / "data" / "pretrained"

    def parameter(self, name: str) -> Value:
        """The value of another parameter of the notebook: as it was given, else its default there."""
        if name in self.parameters:
            return self.parameters[name]
        own = find(self.notebook)
        assert own
        return parameters.declared(own.path)[name]  # type: ignore[return-value]  # literals

    def pick(self, *, smoke: T, laptop: T, paper: T) -> T:
        """The value for this run's scale."""
        return {"smoke": smoke, "laptop": laptop, "paper": paper}[self.scale]

    def seeds(self) -> list[Run]:
        """The same with every seed of this scale that has a folder beside this one, itself included."""
        texts = (folder.name.removeprefix("seed") for folder in self.dir.parent.glob("seed*"))
        seeds = sorted(int(text) for text in texts if text.isdecimal())
        return [replace(self, seed=seed, dir=self.dir.with_name(f"seed{seed}")) for seed in seeds]

    def command(self, name: str) -> str:
        """The command line that executes a notebook in this run."""
        return f"python -m tsmlib run {name} --scale {self.scale} --seed {self.seed}"

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


@dataclass(frozen=True)
class Notebook:
    """One of the study: ``control`` is in notebooks/05_control.ipynb."""

    name: str
    path: Path

    @property
    def stem(self) -> str:
        """What its run, its tables and its status are called: ``05_control``."""
        return self.path.stem


def notebooks() -> dict[str, Notebook]:
    """Name -> notebook, in order."""
    return {
        path.stem[3:]: Notebook(path.stem[3:], path)
        for path in sorted(NOTEBOOKS.glob("[0-9][0-9]_*.ipynb"))
    }


def find(stem: str) -> Notebook | None:
    """The notebook of a file's stem, such as 05_control."""
    return next((notebook for notebook in notebooks().values() if notebook.stem == stem), None)


def home() -> Path:
    """The folder that ``runs`` lies in: the repository, or the working directory where the package is installed."""
    return Path.cwd() if INSTALLED else ROOT


def resolve(
    notebook: str,
    *,
    scale: str = "",
    seed: int = 0,
    run_dir: str = "",
    device: str = "",
    elsewhere: bool = False,
    **others: Value,
) -> Run:
    """The run that a notebook belongs to. Touches no file.

    scale: smoke, laptop or paper; '' means TSM_SCALE, and without it laptop. seed: 0 .. 2**31 - 1.
    run_dir: the folder that holds all runs, relative to ``home``; '' means TSM_RUN_DIR, and without it runs.
    device: cpu, cuda or cuda:N; '' means TSM_DEVICE, and without it cpu. elsewhere: other machines execute the run, so
    that this one need not have the device.
    others: the notebook's other parameters. All are checked here and nowhere else, whichever way they came.
    Raises ParameterError naming the value and what is allowed.
    """
    if shell := live.shell():
        live.watch(shell)
        parameters.require_declared(shell.user_ns.get("In", []), notebook)
        _record_written()
    parameters.check("seed", seed)
    if notebook == "09_your_own" and seed in TESTED:
        raise ParameterError(
            f"seed is {seed}, with which 09_your_own may train on the resets that it is tested from (1000 to 1031); "
            f"expected one below {TESTED.start} or above {TESTED.stop - 1}."
        )
    scale = _setting("scale", scale, "TSM_SCALE", "laptop")
    device = _setting("device", device, "TSM_DEVICE", "cpu")
    if not elsewhere:
        _require_present(device)
    base = home() / _setting("run_dir", run_dir, "TSM_RUN_DIR", "runs")
    own = find(notebook) if others else None
    defaults = parameters.declared(own.path) if own else {}
    for name, value in others.items():
        parameters.check(name, value, default=defaults.get(name, value))
    try:
        if base.exists() and not base.is_dir():
            raise ParameterError(
                f"run_dir is {base}, which is a file; expected a folder. Name another."
            )
    except (OSError, ValueError) as error:
        if isinstance(error, ParameterError):
            raise
        raise ParameterError(
            f"run_dir is {str(base)[:80]!a}, expected the name of a folder: {error}."
        ) from None
    return Run(notebook, scale, seed, base / scale / f"seed{seed}", device, others)


def _record_written() -> None:
    """From now on, list in the file TSM_WRITTEN each file that this process opens for writing, or renames to.

    ``notebooks.execute`` asks a notebook's kernel for it: other notebooks of the run may write there at the same time.
    """
    if not (record := os.environ.pop("TSM_WRITTEN", "")):
        return
    seen, file = set[str](), os.open(record, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)

    def note(event: str, arguments: tuple[object, ...]) -> None:
        if event == "os.rename" or (
            event == "open" and isinstance(arguments[2], int) and arguments[2] & _WRITES
        ):
            path = arguments[1 if event == "os.rename" else 0]
            if isinstance(path, str | os.PathLike) and (name := os.path.abspath(path)) not in seen:
                seen.add(name)
                os.write(file, f"{name}\n".encode(errors="surrogateescape"))

    sys.addaudithook(note)


_WRITES = os.O_WRONLY | os.O_RDWR


def _setting(name: str, value: str, variable: str, default: str) -> str:
    """A parameter, else its environment variable, else ``default``."""
    parameters.check(name, value)
    if not value:
        parameters.check(name, value := os.environ.get(variable, ""), origin=variable)
    return value or default


def _require_present(device: str) -> None:
    """Raises ParameterError unless this machine has ``device``."""
    if device == "cpu":
        return
    import torch  # heavy, and not needed otherwise

    found, asked = (
        torch.cuda.device_count() if torch.cuda.is_available() else 0,
        torch.device(device).index or 0,
    )
    if asked >= found:
        raise ParameterError(
            f"device is {device}, but torch {torch.__version__} finds {found} such devices here. Leave --device (or "
            "TSM_DEVICE) out, or install a torch that is built for this machine's: https://pytorch.org/get-started"
        )
