"""Everything of a release into dist/, and tried: ``make release``, which builds explorer and docs.

``--draft`` allows uncommitted changes and a changelog without a date.
``check`` says at once what would be refused. ``try`` tries dist/ again.
``address https://github.com/OWNER/tsmlib`` writes where the repository lies to the files that
state it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import urllib.request
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent
DIST = ROOT / "dist"
PAGE, SITE = ROOT / "explorer" / "dist", ROOT / "docs" / "_build" / "html"
PLAIN = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
ON_COLAB = ("00_quickstart", "11_pusht")
COLAB = "[Open in Colab](https://colab.research.google.com/github/{}/blob/main/notebooks/{}.ipynb)"
MODELS = """
[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "tsmlib-models"
version = "{version}"
description = "The models, published tables and explorer of tsmlib {version}"
readme = "README.md"
license = "MIT AND Apache-2.0"
license-files = ["LICENSE*"]
authors = [{{ name = "The tsmlib authors" }}]
requires-python = ">=3.11"

[tool.setuptools]
packages = ["tsmlib_models"]

[tool.setuptools.package-data]
tsmlib_models = ["data/**/*", "explorer/**/*"]
"""


class ReleaseError(RuntimeError):
    """What keeps a release from being made, and what to type."""


def version() -> str:
    """The version, from the one place that states it."""
    return re.search(r'__version__ = "(.+)"', (ROOT / "tsmlib/__init__.py").read_text())[1]


def notes(*, draft: bool) -> tuple[str, str]:
    """The date of the version and what the changelog says of it, of a tree that is committed."""
    text, number = (ROOT / "CHANGELOG.md").read_text(), version()
    section = re.search(rf"^## {re.escape(number)}, (.+?)\n(.*?)(?=^## |\Z)", text, re.M | re.S)
    if section is None:
        raise ReleaseError(f"CHANGELOG.md has no section '## {number}, DATE': write one")
    date = section[1]
    if not draft and not re.fullmatch(r"\d{4}-\d\d-\d\d", date):
        raise ReleaseError(
            f"CHANGELOG.md dates {number} {date!r}: expected YYYY-MM-DD; or type: "
            "make release ARGS=--draft"
        )
    if not draft and run("git", "status", "--porcelain"):
        raise ReleaseError(
            "files are not committed: commit them, or type: make release ARGS=--draft"
        )
    return date, section[2].strip() + "\n"


def run(*command: str | Path, cwd: Path = ROOT) -> str:
    done = subprocess.run(
        [*map(str, command)], cwd=cwd, env=PLAIN, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise ReleaseError(
            f"{' '.join(map(str, command))} failed:\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
        )
    return done.stdout.strip()


def wheel(source: Path, folder: Path) -> None:
    """The wheel of a source tree, from what is installed here."""
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "-q"]
    run(*pip, "--no-build-isolation", "--no-deps", "--no-index", "-w", folder, source)


def core(source: Path, folder: Path) -> None:
    """The source distribution of a tree, and the wheel that it builds."""
    call = "import sys; from setuptools import build_meta; build_meta.build_sdist(sys.argv[1])"
    run(sys.executable, "-c", call, folder, cwd=source)
    (archive,) = folder.glob("tsmlib-*.tar.gz")
    with tempfile.TemporaryDirectory() as place, tarfile.open(archive) as packed:
        packed.extractall(place, filter="data")
        wheel(next(Path(place).iterdir()), folder)


def models(source: Path, page: Path, folder: Path) -> None:
    """The wheel tsmlib-models: models and tables of data/, and the explorer's page."""
    licences = sorted((page / "vendor").glob("LICENSE*"))  # MuJoCo's
    if not (page / "index.html").exists() or not licences:
        raise ReleaseError(f"there is no page with its licences in {page}: type make explorer")
    for built in (page / "src").glob("*.js"):
        if built.read_bytes() != (source / "explorer" / "src" / built.name).read_bytes():
            raise ReleaseError(f"{built} is not of explorer/src as it is: type make explorer")
    with tempfile.TemporaryDirectory() as place:
        package = Path(place) / "tsmlib_models"
        shutil.copytree(
            source / "data", package / "data", ignore=shutil.ignore_patterns(".*", "tasks")
        )
        shutil.copytree(page, package / "explorer" / "dist")
        (package / "__init__.py").write_text(
            '"""Files of tsmlib, which ``tsmlib.shipped`` finds."""\n'
        )
        (Path(place) / "pyproject.toml").write_text(MODELS.format(version=version()))
        (Path(place) / "README.md").write_text(
            "Files of [tsmlib](https://pypi.org/project/tsmlib/).\n"
        )
        shutil.copy(source / "LICENSE", place)
        for path in licences:
            shutil.copy(path, Path(place) / f"{path.stem}-mujoco{path.suffix}")
        wheel(Path(place), folder)


def with_addresses(readme: str, url: str) -> str:
    """README with addresses in place of paths, as a package index shows it."""

    def address_of(found: re.Match[str]) -> str:
        kind = "raw" if found[2].startswith("figures/") else "blob"
        return f"{found[1]}{url}/{kind}/v{version()}/{found[2]}"

    return re.sub(r'(\]\(|src=")(?!https?:|#)([^)"\s]+)', address_of, readme)


def metadata(folder: Path, date: str, text: str) -> None:
    """What Zenodo and a citation need, and the notes of the release."""
    citation = (ROOT / "CITATION.cff").read_text()
    title = re.search(r'^title: "(.+)"', citation, re.M)[1]
    about = {
        "title": title,
        "upload_type": "software",
        "version": version(),
        "publication_date": date,
        "creators": [{"name": "The tsmlib authors"}],
        "license": "MIT",
        "description": text,
        "keywords": re.findall(r"^  - ([a-z].*)$", citation, re.M),
    }
    (folder / "zenodo.json").write_text(json.dumps({"metadata": about}, indent=1) + "\n")
    dated = f"version: {version()}\ndate-released: {date}\nlicense:"
    (folder / "CITATION.cff").write_text(citation.replace("license:", dated, 1))
    (folder / "NOTES.md").write_text(text)


def build(*, draft: bool = False) -> Path:
    """Make dist/ anew, and its checksums last."""
    date, text = notes(draft=draft)
    if not (SITE / "index.html").exists():
        raise ReleaseError(f"there is no documentation in {SITE}: type make docs")
    PLAIN["SOURCE_DATE_EPOCH"] = run("git", "log", "-1", "--format=%ct")  # the same bytes again
    shutil.rmtree(DIST, ignore_errors=True)
    DIST.mkdir()
    listed = run("git", "ls-files", "--cached", "--others", "--exclude-standard")
    with tempfile.TemporaryDirectory() as place:  # without what building leaves behind
        for name in listed.splitlines():
            (Path(place) / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, Path(place) / name)
        if stated := re.search(r'^Homepage = "(.+)"', (ROOT / "pyproject.toml").read_text(), re.M):
            readme = Path(place) / "README.md"
            readme.write_text(with_addresses(readme.read_text(), stated[1]))
        core(Path(place), DIST)
        models(Path(place), PAGE, DIST)
    shutil.make_archive(str(DIST / f"tsmlib-{version()}-site"), "zip", SITE)
    metadata(DIST, date, text)
    files = sorted(DIST.iterdir())
    sums = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in files]
    (DIST / "SHA256SUMS").write_text("".join(sums))
    for path in files:
        print(f"{path.stat().st_size / 1e6:8.2f} MB  {path.name}")
    return DIST


def attempt(folder: Path = DIST) -> None:
    """README's words in an empty environment, from that folder alone but for the dependencies."""
    readme = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.S | re.M)
    (example,) = [block for block in readme if "save_video" in block]
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        venv.create(place / "fresh", with_pip=True)
        scripts = place / "fresh" / ("Scripts" if os.name == "nt" else "bin")
        python, tsmlib = scripts / "python", scripts / "tsmlib"
        pip = [python, "-m", "pip", "--disable-pip-version-check", "install", "-q"]
        ours = ["--no-index", "--no-deps", "--find-links", folder, "tsmlib", "tsmlib-models"]
        for title, *command in [
            ("both packages", *pip, *ours),
            ("torch", *pip, "-r", ROOT / "torch.lock"),
            ("the other dependencies", *pip, "tsmlib"),
            ("the version", tsmlib, "--version"),
            ("README's example", python, "-c", example),
            ("the notebooks", tsmlib, "notebooks", "mine"),
        ]:
            begin = os.times()
            said = run(*command, cwd=place).splitlines()[-1:]
            wall, user, system = (os.times()[i] - begin[i] for i in (4, 2, 3))  # of children
            print(f"{wall:6.1f} s, {user + system:5.1f} of CPU  {title} {said}", flush=True)
        served = [tsmlib, "explore", "--port", "0"]
        with subprocess.Popen(served, cwd=place, stdout=subprocess.PIPE, text=True) as page:
            try:
                url = page.stdout.readline().split()[0]
                with urllib.request.urlopen(url + "manifest.json") as answer:
                    print(f"          the explorer: {len(json.load(answer)['tasks'])} tasks")
            finally:
                page.terminate()


def address(url: str, root: Path = ROOT) -> None:
    """State where the repository lies, in place of what was stated before."""
    if not (found := re.fullmatch(r"https://github\.com/([\w.-]+/[\w.-]+?)/?", url)):
        raise ReleaseError(f"{url} is no address: expected https://github.com/OWNER/NAME")
    url, urls = url.rstrip("/"), ""
    for name, path in [
        ("Homepage", ""),
        ("Issues", "/issues"),
        ("Changelog", "/blob/main/CHANGELOG.md"),
    ]:
        urls += f'{name} = "{url}{path}"\n'
    project, citation = root / "pyproject.toml", root / "CITATION.cff"
    text = re.sub(r"\[project\.urls\]\n(?:.+\n)*\n", "", project.read_text())
    project.write_text(
        text.replace("[project.scripts]", f"[project.urls]\n{urls}\n[project.scripts]")
    )
    text = re.sub(r"^repository-code: .*\n", "", citation.read_text(), flags=re.M)
    citation.write_text(text.replace("license:", f'repository-code: "{url}"\nlicense:', 1))
    readme = root / "README.md"
    cloned = re.sub(r"git clone (<.+?>|https:\S+)", f"git clone {url}", readme.read_text())
    readme.write_text(cloned)
    for name in ON_COLAB:
        path = root / "notebooks" / f"{name}.ipynb"
        notebook = json.loads(path.read_text())
        first = notebook["cells"][0]
        kept = [line for line in first["source"] if "colab.research" not in line]
        first["source"] = [kept[0], "\n", COLAB.format(found[1], name) + "\n", *kept[1:]]
        path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--draft", action="store_true")
    parser.add_argument("words", nargs="*", metavar="check | try | address URL")
    given = parser.parse_args()
    try:
        if not given.words:
            build(draft=given.draft)
            attempt()
        elif given.words == ["check"]:
            notes(draft=given.draft)
        elif given.words == ["try"]:
            attempt()
        elif len(given.words) == 2 and given.words[0] == "address":
            address(given.words[1])
        else:
            parser.error("expected nothing, or: check, try, address URL")
    except ReleaseError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
