"""A wheel, installed where no checkout is: all that ships is found, and runs go to the working directory."""

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
from reproduction.runs import INSTALLED, ROOT

SOURCES = (
    "tsmlib",
    "data",
    "notebooks",
    "pyproject.toml",
    "setup.py",
    "MANIFEST.in",
    "README.md",
    "LICENSE",
)
LARGEST = 60e6  # bytes
PLAIN = {
    name: value for name, value in os.environ.items() if not name.startswith(("TSM_", "PYTHON"))
}

pytestmark = pytest.mark.skipif(
    INSTALLED or not (ROOT / "setup.py").exists(), reason="built from a checkout"
)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this checkout, built offline from a copy of it."""
    source, made = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__")
            )
        else:
            shutil.copy(ROOT / name, source)
    pip("wheel", "--no-build-isolation", "--no-deps", "--no-index", "-w", str(made), str(source))
    (path,) = made.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def bin_folder(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The commands of an environment with that wheel and, of the environment of these tests, all but the checkout."""
    place = tmp_path_factory.mktemp("environment")
    venv.create(place, with_pip=False, symlinks=os.name != "nt")
    python = place / Path(sys.executable).parent.name / Path(sys.executable).name
    folders = dict.fromkeys(sysconfig.get_path(name) for name in ("purelib", "platlib"))
    own = Path(sysconfig.get_path("purelib", vars={"base": str(place), "platbase": str(place)}))
    (own / "dependencies.pth").write_text(
        "\n".join(folders)
    )  # whose own .pth files, of the checkout, are not read
    pip("--python", str(python), "install", "--no-deps", "--no-index", "--no-compile", str(wheel))
    return python.parent


def pip(*arguments: str) -> None:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q", *arguments]
    done = subprocess.run(command, env=PLAIN, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def run(folder: Path, *command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A command in a folder that is no checkout."""
    quiet = {**PLAIN, "TQDM_DISABLE": "1", "OMP_NUM_THREADS": "1", **environment}
    return subprocess.run(
        command, cwd=folder, env=quiet, capture_output=True, text=True, check=False
    )


def test_a_wheel_holds_the_package_and_all_that_ships(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
    package = {p.relative_to(ROOT).as_posix() for p in (ROOT / "tsmlib").rglob("*") if p.is_file()}
    shipped = {
        p.relative_to(ROOT).as_posix()
        for name in ("data", "notebooks")
        for p in (ROOT / name).rglob("[!.]*.*")
    }
    files = {name for name in shipped if (ROOT / name).is_file() and "/." not in name}
    about = {name for name in held if name.startswith(f"tsmlib-{tsmlib.__version__}.dist-info/")}
    assert held - about == {name for name in package if ".pyc" not in name} | {
        f"tsmlib/_shipped/{f}" for f in files
    }
    assert "tsmlib/py.typed" in held
    assert wheel.stat().st_size < LARGEST


def test_an_installed_package_finds_what_ships_and_writes_nothing_beside_it(
    bin_folder: Path, tmp_path: Path
) -> None:
    program = (
        "import tsmlib\n"
        "from tsmlib.__main__ import main\n"
        "from tsmlib.storage import tables\n"
        "from reproduction import comparison, runs\n"
        "print(tsmlib.__file__, runs.resolve('05_control').dir, sep='\\n')\n"
        "print(type(tsmlib.load_pretrained('tsm', env='tsm/Reacher-v0')).__name__)\n"
        "found = tables.stored(comparison.RESULTS / '05_control.csv')\n"
        "print(len(tsmlib.load_task('tsm/Reacher-v0')), found is not None)\n"
        "print(main(['publish']), main(['verify']))\n"
    )
    done = run(tmp_path, str(bin_folder / "python"), "-c", program)
    package, place, model, found, *verified, status = done.stdout.splitlines()
    assert Path(package).is_relative_to(bin_folder.parent), package
    assert Path(place) == tmp_path / "runs" / "laptop" / "seed0"
    assert (model, found) == ("TSM", "100 True"), done.stderr
    assert status == "2 0"
    assert "clone it" in done.stderr
    assert len(verified) > 1
    assert not list(tmp_path.iterdir())


def test_the_command_copies_the_notebooks_out(bin_folder: Path, tmp_path: Path) -> None:
    command = str(bin_folder / "tsmlib")
    assert run(tmp_path, command, "--version").stdout == f"tsmlib {tsmlib.__version__}\n"
    assert run(tmp_path, command, "notebooks", "mine").returncode == 0
    copies = {path.name: path.read_bytes() for path in (tmp_path / "mine").iterdir()}
    assert copies == {path.name: path.read_bytes() for path in (ROOT / "notebooks").glob("*.ipynb")}


def test_a_run_is_written_to_the_working_directory(bin_folder: Path, tmp_path: Path) -> None:
    notebook = nbformat.v4.new_notebook(
        metadata={"kernelspec": {"name": "python3", "display_name": "Python 3"}}
    )
    notebook.cells = [
        nbformat.v4.new_code_cell(
            'scale = ""\nseed = 0\nrun_dir = ""', metadata={"tags": ["parameters"]}
        ),
        nbformat.v4.new_code_cell(
            "from reproduction.runs import resolve\n"
            "run = resolve('01_own', scale=scale, seed=seed, run_dir=run_dir)\n"
            "(run.metrics / 'made.txt').write_text(str(run.shipped.exists()))"
        ),
    ]
    nbformat.write(notebook, tmp_path / "01_own.ipynb")
    before = made(bin_folder.parent)
    done = run(tmp_path, str(bin_folder / "tsmlib"), "run", "01_own.ipynb", "--scale", "smoke")
    assert done.returncode == 0, done.stderr
    place = tmp_path / "runs" / "smoke" / "seed0"
    assert Path(done.stdout.strip()) == place / "01_own.ipynb"
    assert (place / "metrics" / "made.txt").read_text() == "True"
    assert made(bin_folder.parent) == before
    assert {path.name for path in tmp_path.iterdir()} == {"01_own.ipynb", "runs"}


def made(folder: Path) -> dict[Path, int]:
    """Every file below a folder but for compiled modules, and when it was written."""
    return {
        p: p.stat().st_mtime_ns
        for p in folder.rglob("*")
        if p.is_file() and "__pycache__" not in p.parts
    }
