"""What holds of the repository: pins, layout, imports that point one way."""

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
from tsmlib.storage import manifest, tables
from reproduction.runs import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MODULES = sorted((ROOT / "tsmlib").rglob("*.py"))


def pins(lock: str = "environment.lock") -> dict[str, str]:
    lines = (ROOT / lock).read_text().splitlines()
    return dict(line.split("==") for line in lines if line and not line.startswith("#"))


def test_the_lock_holds_exact_versions_and_no_addresses() -> None:
    text = (ROOT / "environment.lock").read_text()
    for name, version in pins().items():
        assert re.fullmatch(r"[A-Za-z0-9._-]+", name)
        assert re.fullmatch(r"[0-9][0-9a-z.]*", version), f"{name}=={version}"
        assert not name.startswith(("nvidia", "triton", "cuda"))
    assert "://" not in text
    assert "--hash" not in text
    assert pins()["torch"] == "2.13.0"


def test_the_lock_covers_every_dependency() -> None:
    extras = {
        **PROJECT["optional-dependencies"],
        "mbrl": [],
        "cluster": [],
    }  # installed by hand, next to other pins
    wanted = [*PROJECT["dependencies"], *(line for lines in extras.values() for line in lines)]
    names = {re.split(r"[<>=!~\[ ]", line)[0].lower().replace("_", "-") for line in wanted}
    locked = pins() | pins("docs/requirements.lock")
    assert names <= {name.lower().replace("_", "-") for name in locked}
    assert not pins().keys() & pins("docs/requirements.lock").keys()


def test_what_ships_is_small_and_large_tables_are_compressed() -> None:
    sizes = {path: path.stat().st_size for path in (ROOT / "data").rglob("*") if path.is_file()}
    assert sum(sizes.values()) < 35e6
    large = [path.name for path in sizes if path.suffix == ".csv" and sizes[path] > tables.LARGE]
    assert not large, "python -m tsmlib publish --claims"


def test_version_and_licence_are_stated_once_and_alike() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert tsmlib.__version__ == PROJECT["version"] == citation["version"]
    assert PROJECT["license"] == citation["license"] == "MIT"
    authors = [author["family-names"] for author in citation["preferred-citation"]["authors"]]
    assert authors == ["Mishra", "Abbeel", "Mordatch"]


def imported(path: Path) -> set[str]:
    """Every module that a file imports, at its top or within a function."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module == "tsmlib":
            names |= {f"tsmlib.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    return names


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_nothing_can_execute_what_it_reads(path: Path) -> None:
    source = path.read_text()
    assert not {name.split(".")[0] for name in imported(path)} & {
        "pickle",
        "cloudpickle",
        "joblib",
        "dill",
        "shelve",
    }
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            assert called not in (
                "eval",
                "exec",
                "torch.load",
                "torch.save",
                "np.load",
                "np.save",
                "yaml.load",
            ), called


def test_imports_point_one_way() -> None:
    """The contracts of pyproject.toml: layers, figures that take arrays, models that know no physics."""
    done = subprocess.run(
        [str(Path(sys.executable).with_name("lint-imports"))],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout


@pytest.mark.skipif(not (ROOT / "data").exists(), reason="nothing ships")
def test_everything_that_ships_is_intact_and_listed() -> None:
    shipped = {
        path
        for path in (ROOT / "data").rglob("*")
        if path.is_file() and not path.name.startswith(".")
    }
    again = "python -c 'from tsmlib.storage import manifest; manifest.write_manifest(\"data\")'"
    assert not shipped or set(manifest.verify(ROOT / "data")) == shipped, (
        f"list what is new: {again}"
    )


def test_what_running_leaves_behind_is_ignored() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    made = [
        ".venv/x",
        "runs/laptop/seed0/x",
        "tsmlib.egg-info/x",
        "tsmlib/__pycache__/x",
        ".ruff_cache/x",
    ]
    made += [
        "notebooks/.ipynb_checkpoints/x",
        "MUJOCO_LOG.TXT",
        "data/.x.csv.tmp-12",
        "data/.lock",
        "data/.writer",
    ]
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
