"""Plugin of papermill, for command lines that name a notebook of tsmlib: ``papermill notebooks/05_control.ipynb``.

papermill warns of a parameter that the notebook does not have, and runs it all the same; here it is refused. And
papermill refuses a command without an output path before it asks any of its engines, translators or handlers of paths.
What is left is the command line itself, read and edited when papermill imports its entry points, before it reads it.
A notebook and its parameters, typed in a terminal, get the path where ``python -m tsmlib run control`` would put it;
other commands, a pipe included, keep theirs, and other people's notebooks are left alone. It imports little, since
papermill loads this always.
"""

import argparse
import base64
import os
import stat
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn

from reproduction import parameters, runs

handler = None  # papermill registers what the entry point names; this one handles no paths


class _NotOurs(Exception):
    """A command line that this plugin does not read; papermill says what is wrong with it."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise _NotOurs(message)


def check(argv: list[str], *, terminal: bool) -> None:
    """Refuse parameters that a notebook of tsmlib does not have; append its output path where there is none.

    terminal: whether the command was typed in one, where papermill would ask for an output path. Raises ParameterError.
    """
    if not argv or Path(argv[0]).stem != "papermill":
        return
    parser = _Parser(add_help=False, allow_abbrev=False)
    for short, long in (("-p", "--parameters"), ("-r", "--parameters_raw")):
        parser.add_argument(short, long, nargs=2, action="append", default=[])
    for short, word in (("-f", "file"), ("-y", "yaml"), ("-b", "base64")):
        parser.add_argument(short, f"--parameters_{word}", action="append", default=[])
    try:
        given, rest = parser.parse_known_args(argv[1:])
    except _NotOurs:
        return
    notebook = next((Path(word).resolve() for word in rest if word.endswith(".ipynb")), None)
    if notebook is None or not _is_ours(notebook):
        return
    written = dict(given.parameters)
    elsewhere = {name for name, _ in given.parameters_raw} | _names_in(given)
    parameters.require_known(notebook, [*written, *sorted(elsewhere)])
    if terminal and len(rest) == 1 and not elsewhere:
        folder = _run(notebook, written).folder()
        argv.append(str(folder / notebook.name).replace("{", "{{").replace("}", "}}"))


def _is_ours(notebook: Path) -> bool:
    """Whether it is a notebook that ships, or a copy of one."""
    if not notebook.is_file():
        return False
    if notebook.parent == runs.NOTEBOOKS:
        return True
    return (runs.NOTEBOOKS / notebook.name).is_file() and "tsmlib" in notebook.read_text(
        encoding="utf-8"
    )


def _names_in(given: argparse.Namespace) -> set[str]:
    """Parameters that are given as YAML; none where papermill will say that it is not."""
    import yaml  # which papermill needs too

    try:
        texts = [
            Path(name).read_text(encoding="utf-8") for name in given.parameters_file
        ] + given.parameters_yaml
        texts += [base64.b64decode(text).decode() for text in given.parameters_base64]
        read = [yaml.safe_load(text) for text in texts]
    except (OSError, ValueError, yaml.YAMLError):
        return set()
    return {str(name) for values in read if isinstance(values, dict) for name in values}


def _run(notebook: Path, written: Mapping[str, str]) -> runs.Run:
    return runs.resolve(notebook.stem, **parameters.typed(notebook, written))  # type: ignore[arg-type]  # it checks them


def _in_terminal() -> bool:
    try:
        return sys.stdout.isatty() and not stat.S_ISFIFO(os.fstat(0).st_mode)
    except (OSError, ValueError, AttributeError):  # closed
        return False


try:
    check(sys.argv, terminal=_in_terminal())
except parameters.ParameterError as error:
    sys.exit(f"error: {error}")
