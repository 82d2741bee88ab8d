"""A wheel, installed where no checkout is: all that ships is found, and runs go to the working
directory."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import nbformat
import pytest

import tsmlib
from tsmlib.pretrained import INSTALLED, ROOT

SOURCES = ("tsmlib", "reproduction", "data", "notebooks", "pyproject.toml", "setup.py")
SOURCES += ("MANIFEST.in", "README.md", "LICENSE")
KERNEL = {"name": "python3", "display_name": "Python 3", "language": "python"}
LARGEST = 25e6  # bytes
PLAIN = {k: v for k, v in os.environ.items() if not k.startswith(("TSM_", "PYTHON"))}

pytestmark = pytest.mark.skipif(
    INSTALLED or not (ROOT / "setup.py").exists(), reason="built from a checkout"
)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this checkout, built offline from a copy of it."""
    source, made = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            ignored = shutil.ignore_patterns("__pycache__", ".*")
            shutil.copytree(ROOT / name, source / name, ignore=ignored)
        else:
            shutil.copy(ROOT / name, source)
    pip("wheel", "--no-build-isolation", "--no-deps", "--no-index", "-w", str(made), str(source))
    (path,) = made.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def commands(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The commands of an environment with that wheel, and of this one all but the checkout."""
    place = tmp_path_factory.mktemp("environment")
    venv.create(place, with_pip=False, symlinks=os.name != "nt")
    python = place / Path(sys.executable).parent.name / Path(sys.executable).name
    folders = dict.fromkeys(sysconfig.get_path(name) for name in ("purelib", "platlib"))
    own = Path(sysconfig.get_path("purelib", vars={"base": str(place), "platbase": str(place)}))
    (own / "dependencies.pth").write_text("\n".join(folders))  # whose .pth files are not read
    pip("--python", str(python), "install", "--no-deps", "--no-index", "--no-compile", str(wheel))
    return python.parent


def pip(*arguments: str) -> None:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q", *arguments]
    done = subprocess.run(command, env=PLAIN, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def run(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """A command in a folder that is no checkout."""
    quiet = {**PLAIN, "TQDM_DISABLE": "1", "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        command, cwd=folder, env=quiet, capture_output=True, text=True, check=False
    )


def files(folder: Path) -> set[str]:
    """Files below a folder of the checkout, by their paths in it."""
    found = (path.relative_to(ROOT) for path in folder.rglob("*") if path.is_file())
    return {
        path.as_posix()
        for path in found
        if "__pycache__" not in path.parts and not any(part[0] == "." for part in path.parts)
    }


def test_a_wheel_holds_both_packages_and_all_that_ships(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    code = files(ROOT / "tsmlib") | files(ROOT / "reproduction")
    shipped = files(ROOT / "data") | files(ROOT / "notebooks")
    assert held == code | {f"tsmlib/_shipped/{name}" for name in shipped}
    assert {"tsmlib/py.typed", "reproduction/Snakefile"} <= held
    assert wheel.stat().st_size < LARGEST


def test_an_installed_package_finds_what_ships_and_writes_nothing(
    commands: Path, tmp_path: Path
) -> None:
    program = (
        "import tsmlib\n"
        "from reproduction import tables\n"
        "from reproduction.runs import Run\n"
        "print(tsmlib.__file__, Run().folder, sep='\\n')\n"
        "print(type(tsmlib.load_pretrained('tsm', env='tsm/Reacher-v0')).__name__)\n"
        "print(len(tsmlib.load_task('tsm/Reacher-v0')), len(tables.published('05_control')) > 0)\n"
    )
    done = run(tmp_path, str(commands / "python"), "-c", program)
    package, place, model, found = done.stdout.splitlines()
    assert Path(package).is_relative_to(commands.parent), package
    assert Path(place) == tmp_path / "runs" / "laptop" / "seed0"
    assert (model, found) == ("TSM", "100 True"), done.stderr
    assert not list(tmp_path.iterdir())


def test_the_command_copies_the_notebooks_out_and_runs_one_here(
    commands: Path, tmp_path: Path
) -> None:
    command = str(commands / "tsmlib")
    assert run(tmp_path, command, "--version").stdout == f"tsmlib {tsmlib.__version__}\n"
    assert run(tmp_path, command, "notebooks", "mine").returncode == 0
    copies = {path.name: path.read_bytes() for path in (tmp_path / "mine").iterdir()}
    assert copies == {path.name: path.read_bytes() for path in (ROOT / "notebooks").glob("*.ipynb")}
    own = nbformat.v4.new_notebook(metadata={"kernelspec": KERNEL})
    first = nbformat.v4.new_code_cell('scale = "laptop"', metadata={"tags": ["parameters"]})
    own.cells = [first, nbformat.v4.new_code_cell("open('made.txt', 'w').write(scale)")]
    nbformat.write(own, tmp_path / "01_own.ipynb")
    done = run(tmp_path, command, "run", "01_own.ipynb", "--scale", "smoke")
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "runs" / "smoke" / "seed0"
    assert Path(done.stdout.strip()) == folder / "01_own.ipynb"
    assert (folder / "made.txt").read_text() == "smoke"
