"""Gives ``papermill notebooks/05_control.ipynb``, typed in a terminal, an output path in runs/."""

import sys
from pathlib import Path

handler = None  # what the entry point names; it handles no paths


def completed(argv: list[str]) -> list[str]:
    """A command line that names our notebook and parameters alone, with an output path."""
    given, rest = {"scale": "laptop", "seed": "0"}, argv[1:]
    while len(rest) > 2 and "-p" in rest[:-2]:
        at = rest.index("-p")
        given[rest[at + 1]] = rest[at + 2]
        del rest[at : at + 3]
    notebook = Path(rest[0]).resolve() if len(rest) == 1 else Path()
    root = notebook.parent.parent
    if not notebook.match("notebooks/*.ipynb") or not (root / "reproduction").is_dir():
        return argv
    if unknown := [
        name for name in given if f'"{name} = ' not in notebook.read_text(encoding="utf-8")
    ]:
        sys.exit(f"error: {notebook.name} has no parameter {unknown[0]!r}")
    folder = root / "runs" / given["scale"] / f"seed{given['seed']}"
    folder.mkdir(parents=True, exist_ok=True)
    return [*argv, str(folder / notebook.name)]


if Path(sys.argv[0]).stem == "papermill" and sys.stdout.isatty():
    sys.argv[:] = completed(sys.argv)
    print(
        "A warning about encryption is harmless: the kernel runs on this machine.", file=sys.stderr
    )
