"""Execution of the notebooks, into ``runs/<scale>/seed<seed>/``."""

from __future__ import annotations

import difflib
import importlib.util
import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from reproduction.runs import Run
from tsmlib.shipped import ROOT

if TYPE_CHECKING:
    import nbformat

NOTEBOOKS = ROOT / "notebooks"
TOOLS = ("papermill", "ipykernel", "pandas", "ipywidgets", "imageio_ffmpeg")  # extra "study"
Value = bool | int | float | str
_SPELLED = {"true": True, "false": False}


class RunError(RuntimeError):
    """A notebook that cannot be run, or did not come to its end."""


def notebooks() -> dict[str, Path]:
    """Name, such as "control", and path of every notebook that ships, in order."""
    return {path.stem[3:]: path for path in sorted(NOTEBOOKS.glob("[0-9][0-9]_*.ipynb"))}


def find(name: str) -> Path:
    """The notebook of a name such as "control", or the path of a copy.

    Raises:
        RunError: there is no such notebook; the message names those that there are.
    """
    path = Path(name)
    if path.suffix == ".ipynb" and path.is_file():
        return path.resolve()
    if name not in notebooks():
        raise RunError(f"no notebook is called {name!r:.80}; there are {', '.join(notebooks())}.")
    return notebooks()[name]


def defaults(notebook: Path) -> dict[str, Value]:
    """Name and default of every parameter of a notebook, as papermill reads them."""
    import ast

    import papermill

    declared = papermill.inspect_notebook(_literally(notebook))
    return {name: ast.literal_eval(entry["default"]) for name, entry in declared.items()}


def typed(notebook: Path, texts: Mapping[str, str]) -> dict[str, Value]:
    """Values of a notebook's parameters from their text.

    Args:
        notebook: its path.
        texts: text of each parameter that is given, as typed.

    Returns:
        The values, each of the type of its default.

    Raises:
        ValueError: a parameter that the notebook does not have, or text of another type.
    """
    known = defaults(notebook)
    values: dict[str, Value] = {}
    for name, text in texts.items():
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            hint = f"; the closest is {close[0]}" if close else ""
            raise ValueError(
                f"{notebook.name} has no parameter {name!r:.80}{hint}; it has {', '.join(known)}."
            )
        kind = type(known[name])
        try:
            values[name] = _SPELLED[text.lower()] if kind is bool else kind(text)
        except (ValueError, KeyError):
            raise ValueError(
                f"{name} is {text!r:.80}, expected {kind.__name__} as in {known[name]!r}."
            ) from None
    return values


def execute(
    notebook: Path,
    run: Run,
    more: Mapping[str, Value] | None = None,
    *,
    progress: bool = True,
) -> Path:
    """Execute a notebook in the folder of its run.

    Args:
        notebook: its path.
        run: scale and seed.
        more: values of the notebook's other parameters.
        progress: whether a bar is shown.

    Returns:
        The executed copy, in ``run.folder``, which is the kernel's working directory.

    Raises:
        RunError: a cell failed or the kernel died. The copy then holds what was done until there.
    """
    require_tools()
    import papermill
    from nbclient.exceptions import DeadKernelError
    from traitlets.config import Config

    values = {"scale": run.scale, "seed": run.seed, **(more or {})}
    known = defaults(notebook)
    run.folder.mkdir(parents=True, exist_ok=True)
    output = run.folder / notebook.name
    unfinished = output.with_name(f".{notebook.stem}.{os.getpid()}.ipynb")
    failure = ""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # shuts the kernel down
    try:
        papermill.execute_notebook(
            _literally(notebook),
            _literally(unfinished),
            {name: value for name, value in values.items() if name in known},
            kernel_name="python3",
            language="python",
            cwd=str(run.folder),
            progress_bar={"desc": notebook.stem} if progress else False,
            stdout_file=sys.stdout if progress else None,
            config=Config({"KernelManager": {"transport_encryption": "auto"}}),  # no warning of it
        )
    except papermill.PapermillExecutionError as error:
        failure = f"cell {error.exec_count}: {error.ename}: {error.evalue}"
    except DeadKernelError:
        failure = "its kernel died, perhaps for want of memory; run it again, trainings go on"
    finally:
        signal.signal(signal.SIGTERM, before)
        if unfinished.exists():
            os.replace(unfinished, output)
    if failure:
        raise RunError(f"{notebook.stem} failed: {failure}\nSee {output}")
    return output


def is_executed(notebook: Path, copy: Path) -> bool:
    """Whether a copy is of the notebook as it is stored now, executed to its end.

    Args:
        notebook: its path.
        copy: path of what a run wrote, which need not be there.
    """
    import nbformat

    if not copy.is_file():
        return False
    executed = nbformat.read(copy, 4)
    failed = executed.metadata.get("papermill", {}).get("exception")
    return not failed and _code(executed) == _code(nbformat.read(notebook, 4))


def _code(notebook: nbformat.NotebookNode) -> list[str]:
    """Cells of code but for the parameters, which a run has its own of."""
    cells = (cell for cell in notebook.cells if cell.cell_type == "code")
    given = {"parameters", "injected-parameters"}
    return [cell.source for cell in cells if not given & set(cell.metadata.get("tags", []))]


def require_tools() -> None:
    """Raises RunError naming what the notebooks need and a plain installation lacks."""
    if missing := [name for name in TOOLS if importlib.util.find_spec(name) is None]:
        raise RunError(
            f"notebooks need {', '.join(missing)}, missing here; type: "
            f"{sys.executable} -m pip install 'tsmlib[study]'"
        )


def _literally(path: Path) -> str:
    """papermill formats paths; this keeps braces in them as they are."""
    return str(path).replace("{", "{{").replace("}", "}}")
