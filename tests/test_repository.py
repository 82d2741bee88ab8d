"""What holds of the repository: pins, sizes, imports that point one way."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

import tsmlib
from tsmlib.pretrained import ROOT

SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = SETTINGS["project"]
MODULES = sorted(
    path for name in ("tsmlib", "reproduction") for path in (ROOT / name).rglob("*.py")
)
BY_HAND = ("cluster", "mbrl", "lerobot", "hub", "onnx")  # extras that are in uv.lock alone


def test_both_locks_hold_every_dependency_in_one_version_and_its_hashes() -> None:
    packages = tomllib.loads((ROOT / "uv.lock").read_text())["package"]
    locked = {(package["name"], package.get("version")) for package in packages}
    blocks = re.split(r"\n(?=\S)", (ROOT / "environment.lock").read_text())
    hashed = [block for block in blocks if not block.startswith("#")]
    found = [re.match(r"([\w.-]+)==(\S+) .*\\\n    --hash=sha256:\w{64}", b) for b in hashed]
    pins = {(pin[1], pin[2]) for pin in found if pin}
    assert all(found)
    torch = re.findall(r"^(torch)==(\S+)$", (ROOT / "torch.lock").read_text(), re.M)
    assert pins | set(torch) <= locked
    extras = {k: v for k, v in PROJECT["optional-dependencies"].items() if k not in BY_HAND}
    groups = [*extras.values(), *SETTINGS["dependency-groups"].values()]
    wanted = [*PROJECT["dependencies"], *(line for lines in groups for line in lines)]
    names = {re.split(r"[<>=!~\[ ]", line)[0].lower().replace("_", "-") for line in wanted}
    assert names <= {name for name, _ in [*pins, *torch]}


def test_what_ships_is_small() -> None:
    sizes = [path.stat().st_size for path in (ROOT / "data").rglob("*") if path.is_file()]
    assert sum(sizes) < 20e6
    assert max(sizes) < 2e6


def test_version_and_licence_are_stated_once_and_alike() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert "version" in PROJECT["dynamic"]
    assert "version" not in citation
    assert re.fullmatch(r"\d+\.\d+\.\d+", tsmlib.__version__)
    assert [author["name"] for author in citation["authors"]] == [
        author["name"] for author in PROJECT["authors"]
    ]
    assert PROJECT["license"] == citation["license"] == "MIT"
    authors = [author["family-names"] for author in citation["preferred-citation"]["authors"]]
    assert authors == ["Mishra", "Abbeel", "Mordatch"]


def imported(path: Path) -> set[str]:
    """Every module that a file imports, at its top or within a function."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add((node.module or "").split(".")[0])
    return names


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_nothing_can_execute_what_it_reads(path: Path) -> None:
    assert not imported(path) & {"pickle", "cloudpickle", "joblib", "dill", "shelve"}
    forbidden = {"eval", "exec", "torch.load", "torch.save", "np.load", "np.save", "yaml.load"}
    for node in ast.walk(ast.parse(path.read_text())):
        assert not isinstance(node, ast.Call) or ast.unparse(node.func) not in forbidden


def test_imports_point_one_way() -> None:
    """The contracts of pyproject.toml: the library below, the reproduction above it."""
    command = [str(Path(sys.executable).with_name("lint-imports"))]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    for path in MODULES:
        if path.is_relative_to(ROOT / "tsmlib"):
            assert "reproduction" not in imported(path), path


def test_what_running_leaves_behind_is_ignored() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    made = [".venv/x", "runs/laptop/seed0/x", "tsmlib.egg-info/x", "tsmlib/__pycache__/x"]
    made += [".ruff_cache/x", "notebooks/.ipynb_checkpoints/x", "MUJOCO_LOG.TXT", "data/.x.tmp-12"]
    done = subprocess.run(
        ["git", "check-ignore", *made], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == made


def test_importing_the_package_is_enough_to_make_an_environment() -> None:
    code = (
        "import sys, gymnasium, tsmlib\n"
        "assert not {'torch', 'mujoco', 'pymunk', 'matplotlib'} & set(sys.modules)\n"
        "print(gymnasium.make('tsm/ReacherPush-v1').observation_space.shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "(10,)"
    assert not done.stderr
