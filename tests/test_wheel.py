"""A wheel, installed where no checkout is: all that ships is found, and runs go to the working
directory."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path
from types import ModuleType

import nbformat
import pytest

import tsmlib
from tsmlib.pretrained import INSTALLED, ROOT

SOURCES = ("tsmlib", "reproduction", "data", "notebooks", "pyproject.toml", "setup.py")
SOURCES += ("MANIFEST.in", "README.md", "LICENSE")
KERNEL = {"name": "python3", "display_name": "Python 3", "language": "python"}
LARGEST = 6e6  # bytes
ELSEWHERE = "import tsmlib; tsmlib.load_pretrained('tsm', env='tsm/Reacher-v0')"
PLAIN = {k: v for k, v in os.environ.items() if not k.startswith(("TSM_", "PYTHON"))}

pytestmark = pytest.mark.skipif(
    INSTALLED or not (ROOT / "setup.py").exists(), reason="built from a checkout"
)


@pytest.fixture(scope="module")
def release() -> ModuleType:
    """The script that makes a release."""
    spec = importlib.util.spec_from_file_location("release", ROOT / "release.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


@pytest.fixture(scope="module")
def dist(release: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both wheels of this checkout, made offline: one from a source distribution."""
    source, made = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            ignored = shutil.ignore_patterns("__pycache__", ".*")
            shutil.copytree(ROOT / name, source / name, ignore=ignored)
        else:
            shutil.copy(ROOT / name, source)
    page = tmp_path_factory.mktemp("page")
    (page / "index.html").write_text("the explorer")
    (page / "manifest.json").write_text("{}")
    with pytest.raises(release.ReleaseError, match="no page with its licences .* make explorer"):
        release.models(source, page, made)
    (page / "vendor").mkdir()
    (page / "vendor" / "LICENSE").write_text("MuJoCo's")
    release.core(source, made)
    release.models(source, page, made)
    return made


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    (path,) = dist.glob("tsmlib-*.whl")
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
    shipped = {name for name in held if name.startswith("tsmlib/_shipped/")}
    assert held == code | shipped
    own = {name.removeprefix("tsmlib/_shipped/") for name in shipped} - {"digests.json"}
    assert files(ROOT / "notebooks") | files(ROOT / "data" / "tasks") <= own
    assert own <= files(ROOT / "notebooks") | files(ROOT / "data")
    (other,) = wheel.parent.glob("tsmlib_models-*.whl")
    with zipfile.ZipFile(other) as archive:
        more = {name.removeprefix("tsmlib_models/") for name in archive.namelist()}
    assert any(name.endswith("/LICENSE-mujoco") for name in more)
    assert files(ROOT / "data") <= own | more
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
        "print(type(tsmlib.load_pretrained('rtsm', env='tsm/ReacherPush-v1')).__name__)\n"
        "print(len(tsmlib.load_task('tsm/Reacher-v0')), tables.COLUMNS[0])\n"
    )
    done = run(tmp_path, str(commands / "python"), "-c", program)
    package, place, model, found = done.stdout.splitlines()
    assert Path(package).is_relative_to(commands.parent), package
    assert Path(place) == tmp_path / "runs" / "laptop" / "seed0"
    assert (model, found) == ("RecurrentTSM", "100 env"), done.stderr
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
    assert str(folder / "01_own.ipynb") in done.stdout
    assert (folder / "made.txt").read_text() == "smoke"


def test_what_ships_in_the_other_wheel_is_found_and_compared_and_else_is_named(
    commands: Path, dist: Path, tmp_path: Path
) -> None:
    python = str(commands / "python")
    done = run(tmp_path, python, "-c", ELSEWHERE)
    assert "in the package tsmlib-models, which is not installed: type" in done.stderr
    folder = ["--no-deps", "--no-index", "--no-compile", "--find-links", str(dist)]
    pip("--python", python, "install", *folder, "tsmlib-models")
    assert run(tmp_path, python, "-c", ELSEWHERE).returncode == 0
    program = (
        "from reproduction import explorer, tables\n"
        "print(len(tables.published('05_control')) > 0, explorer.page().is_dir())\n"
    )
    assert run(tmp_path, python, "-c", program).stdout == "True True\n"
    (models,) = commands.parent.rglob("tsmlib_models/data/pretrained/Reacher/tsm.safetensors")
    data = models.read_bytes()
    models.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    done = run(tmp_path, python, "-c", ELSEWHERE)
    assert "has another content than the release" in done.stderr
    assert "--force-reinstall" in done.stderr
    models.write_bytes(data)
    (about,) = commands.parent.rglob("tsmlib_models-*.dist-info/METADATA")
    about.write_text(about.read_text().replace(f"Version: {tsmlib.__version__}", "Version: 0.0.9"))
    done = run(tmp_path, python, "-c", ELSEWHERE)
    assert f"tsmlib-models is 0.0.9, and tsmlib is {tsmlib.__version__}" in done.stderr


def test_a_command_whose_extra_is_missing_says_what_to_type(commands: Path, tmp_path: Path) -> None:
    program = (
        "import sys; sys.modules['pandas'] = None; import tsmlib.__main__ as m; m.main(['claims'])"
    )
    done = run(tmp_path, str(commands / "python"), "-c", program)
    assert "claims needs pandas, missing here; type" in done.stderr
    assert "pip install 'tsmlib[study]'" in done.stderr


def test_the_address_of_the_repository_is_written_once_where_it_is_stated(
    release: ModuleType, tmp_path: Path
) -> None:
    for name in ("pyproject.toml", "CITATION.cff", "README.md", "notebooks"):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, tmp_path / name)
    for owner in ("somebody", "another"):
        release.address(f"https://github.com/{owner}/tsmlib", tmp_path)
    for name in ("pyproject.toml", "CITATION.cff", "README.md", "notebooks/11_pusht.ipynb"):
        text = (tmp_path / name).read_text()
        assert "another/tsmlib" in text
        assert "somebody" not in text
    shown = release.with_addresses("[a](docs/b.md) ![c](figures/d.png) [e](https://f)", "https://g")
    tag = f"v{tsmlib.__version__}"
    assert shown == (
        f"[a](https://g/blob/{tag}/docs/b.md) ![c](https://g/raw/{tag}/figures/d.png) [e](https://f)"
    )
    with pytest.raises(release.ReleaseError, match="expected https://github.com/OWNER/NAME"):
        release.address("example.org", tmp_path)


def test_a_release_of_an_undated_or_unknown_version_is_refused(
    release: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(release, "ROOT", tmp_path)
    (tmp_path / "tsmlib").mkdir()
    (tmp_path / "tsmlib" / "__init__.py").write_text('__version__ = "2.0.0"\n')
    (tmp_path / "CHANGELOG.md").write_text("# Changelog\n\n## 2.0.0, unreleased\n\n- New\n")
    with pytest.raises(release.ReleaseError, match="expected YYYY-MM-DD"):
        release.notes(draft=False)
    assert release.notes(draft=True) == ("unreleased", "- New\n")
    (tmp_path / "CHANGELOG.md").write_text("# Changelog\n\n## 1.0.0, 2026-01-01\n")
    with pytest.raises(release.ReleaseError, match="has no section '## 2.0.0, DATE'"):
        release.notes(draft=True)
