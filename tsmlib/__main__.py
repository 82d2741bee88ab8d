"""Command line: ``tsmlib`` and ``python -m tsmlib`` are the same.

``notebooks FOLDER`` copies the notebooks out, to be opened, changed and run by their paths. All
other commands are those of the reproduction that comes beside the library.
"""

from __future__ import annotations

import importlib
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import tsmlib
from tsmlib.shipped import ROOT

USAGE = """usage: python -m tsmlib COMMAND ...

  run NOTEBOOK       execute a notebook into runs/<scale>/seed<seed>/; run --help
  control            the same as run control, and so on
  notebooks FOLDER   copy the notebooks into a folder
  explore            serve the explorer, a page in the browser, on 127.0.0.1
  make TARGET ...    make data, models, scores, plans, policies or tables; make --help
  claims             judge the paper's claims by data/results and write docs/claims.md
  test               run the tests of a checkout
  --version"""
REPRODUCTION = "reproduction.__main__"


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: its words; those of the command line where it is None.

    Returns:
        0 done, 1 it failed, 2 bad arguments, 130 interrupted.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help"):
        print(USAGE)
        return 0 if words else 2
    if words[0] == "--version":
        print(f"tsmlib {tsmlib.__version__}")
        return 0
    if words[0] == "notebooks":
        return _copy_notebooks(words[1:])
    try:
        return importlib.import_module(REPRODUCTION).main(words)
    except ModuleNotFoundError as error:  # such as pandas
        again = f"{sys.executable} -m pip install 'tsmlib[study]'"
        print(f"error: {words[0]} needs {error.name}, missing here; type: {again}", file=sys.stderr)
        return 1


def _copy_notebooks(words: Sequence[str]) -> int:
    """Copy the notebooks that ship; refused where one would replace another file."""
    if len(words) != 1 or words[0].startswith("-"):
        print("usage: python -m tsmlib notebooks FOLDER", file=sys.stderr)
        return 2
    folder, shipped = Path(words[0]), sorted((ROOT / "notebooks").glob("*.ipynb"))
    for path in shipped:
        there = folder / path.name
        if there.exists() and there.read_bytes() != path.read_bytes():
            print(
                f"error: {there} differs from the one that ships; name another folder",
                file=sys.stderr,
            )
            return 1
    folder.mkdir(parents=True, exist_ok=True)
    for path in shipped:
        print(shutil.copy(path, folder))
    return 0


if __name__ == "__main__":
    sys.exit(main())
