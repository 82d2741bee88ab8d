"""Plugin of papermill: an output path for ``papermill notebooks/05_control.ipynb``, without which papermill refuses.

papermill refuses before it asks any of its engines, translators or handlers of paths. What is left is the command line
itself, edited when papermill imports its entry points, before it reads it. Exactly that command, typed in a terminal
for a notebook of this repository, gets the path where ``python -m tsmlib run control`` would put it; anything else,
other arguments or a pipe included, is left alone. It imports little, since papermill loads this always.
"""

import os
import stat
import sys
from pathlib import Path

from tsmlib.study import parameters, runs

handler = None  # papermill registers what the entry point names; this one handles no paths


def add_output_path(argv: list[str]) -> None:
    """Append the output path to ``argv`` if it is ``[papermill, notebook]`` with a notebook of this repository."""
    if len(argv) != 2 or Path(argv[0]).stem != "papermill" or not argv[1].endswith(".ipynb"):
        return
    notebook = Path(argv[1]).resolve()
    if notebook.parent != runs.NOTEBOOKS or not notebook.is_file():
        return
    try:
        folder = runs.resolve(notebook.stem).folder()
    except parameters.ParameterError as error:
        sys.exit(f"error: {error}")
    argv.append(str(folder / notebook.name).replace("{", "{{").replace("}", "}}"))


def _in_terminal() -> bool:
    try:
        return sys.stdout.isatty() and not stat.S_ISFIFO(os.fstat(0).st_mode)
    except (OSError, ValueError, AttributeError):  # closed
        return False


if _in_terminal():
    add_output_path(sys.argv)
