"""Gives ``papermill notebooks/05_control.ipynb`` an output path, in runs/laptop/seed0/.

papermill refuses a command without one before it asks plugins. Other commands are left alone.
"""

import sys
from pathlib import Path

handler = None  # what the entry point names; papermill registers it, and it handles no paths


def completed(argv: list[str]) -> list[str]:
    """A command line that names our notebook and parameters alone, with an output path."""
    given, rest = {"scale": "laptop", "seed": "0"}, argv[1:]
    while len(rest) > 2 and "-p" in rest[:-2]:
        at = rest.index("-p")
        given[rest[at + 1]] = rest[at + 2]
        del rest[at : at + 3]
    if len(rest) != 1 or not (notebook := Path(rest[0]).resolve()).match("notebooks/*.ipynb"):
        return argv
    root = notebook.parents[1]
    if not (root / "reproduction").is_dir():
        return argv
    if unknown := [name for name in given if f'"{name} = ' not in notebook.read_text()]:
        sys.exit(f"error: {notebook.name} has no parameter {unknown[0]!r}")
    folder = root / "runs" / given["scale"] / f"seed{given['seed']}"
    folder.mkdir(parents=True, exist_ok=True)
    return [*argv, str(folder / notebook.name)]


if Path(sys.argv[0]).stem == "papermill":
    sys.argv[:] = completed(sys.argv)
