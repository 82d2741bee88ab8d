"""Scripts of benchmarks/: run as a person runs them but in this process, which has imported torch already, or started
in a process that has only what their requirements name."""

from __future__ import annotations

import importlib.util
import io
import os
import runpy
import subprocess
import sys
from collections.abc import Iterable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import ModuleType
from unittest.mock import patch

import pytest


def run_script(path: Path, *options: str) -> str:
    """What the script prints. Its folder has to be on sys.path."""
    printed = io.StringIO()
    with patch.object(sys, "argv", [str(path), *options]), redirect_stdout(printed):
        runpy.run_path(str(path), run_name="__main__")
    return printed.getvalue()


def refused(path: Path, *options: str) -> str:
    """What the script says to standard error as it refuses its options, with exit status 2."""
    said = io.StringIO()
    with redirect_stderr(said), pytest.raises(SystemExit, match="2"):
        run_script(path, *options)
    return said.getvalue()


def load_script(path: Path, name: str = "") -> ModuleType:
    """The script as a module, by its own name unless another is given, without running it."""
    spec = importlib.util.spec_from_file_location(name or path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses find their module, and scripts each other
    spec.loader.exec_module(module)
    return module


def pins(path: Path) -> dict[str, str]:
    """Package -> version of a file of requirements."""
    lines = path.read_text().splitlines()
    return dict(line.split("==") for line in lines if line and not line.startswith("#"))


REFUSING = """
import importlib.metadata as metadata, runpy, sys
from packaging.requirements import Requirement

installed = {found.name.lower().replace("_", "-"): found for found in metadata.distributions()}
allowed, left = {"tsmlib", "packaging", "setuptools"}, list(sys.argv[2:])
while left:
    if (name := left.pop().lower().replace("_", "-")) not in allowed and name in installed:
        wanted = map(Requirement, installed[name].requires or [])
        left += [other.name for other in wanted if not other.marker or other.marker.evaluate({"extra": ""})]
    allowed.add(name)
owners = {
    module: {name.lower().replace("_", "-") for name in names}
    for module, names in metadata.packages_distributions().items()
}


class Refuse:
    def find_spec(self, name, path=None, target=None):
        if (own := owners.get(name.split(".")[0])) and not own & allowed:
            raise ModuleNotFoundError(f"{name} is no requirement", name=name)


sys.meta_path.insert(0, Refuse())
runpy.run_path(sys.argv[1], run_name="imported")
"""


def start_with_only(path: Path, packages: Iterable[str]) -> tuple[int, str]:
    """Exit status and errors of a process that imports the script, and of what is installed only some packages and what
    they require."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(path.parent), str(path.parent.parent)])}
    command = [sys.executable, "-c", REFUSING, str(path), *packages]
    done = subprocess.run(command, capture_output=True, text=True, env=env, check=False)
    return done.returncode, done.stderr
