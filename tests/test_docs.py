"""What a person reads: each block of Python in README and docs runs, and links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
import yaml

import tsmlib
from tsmlib.pretrained import ROOT

README, DOCS = ROOT / "README.md", ROOT / "docs"
BUILT = DOCS / "_build" / "html"
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if "_build" not in page.parts]
PROGRAMS = [page for page in PAGES if BLOCK.search(page.read_text()) and page.stem != "logs"]
LOADED = re.compile(r"<(?:script|link|img|iframe|source)\b[^>]*\b(?:src|href)=[\"'](?:https?:)?//")


def run(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The Python blocks of a page as one program, in an empty folder: the names that it leaves."""
    monkeypatch.chdir(folder)
    names: dict[str, Any] = {"__name__": page.stem}
    exec(compile("\n".join(BLOCK.findall(page.read_text())), str(page), "exec"), names)
    return names


@pytest.mark.parametrize("page", PROGRAMS, ids=lambda page: page.stem)
def test_the_program_of_a_page_runs(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(page, tmp_path, monkeypatch)


def test_the_programs_of_the_readme_push_read_a_log_and_plan_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    _solve, push, logs, robot = BLOCK.findall(README.read_text())  # the first takes minutes
    names: dict[str, Any] = {}
    exec(push, names)
    assert float(names["trial"].final_distance[0]) < 0.05
    assert (tmp_path / "push.mp4").stat().st_size > 1000
    rows = (
        f"{run},{0.1 * k:.1f},{0.01 * k * run},{0.1 * run},0.5"
        for run in range(20)
        for k in range(40)
    )
    (tmp_path / "robot.csv").write_text("\n".join(["run,t,q,dq,torque", *rows]))
    for program in (logs, robot):
        exec(program.replace("steps=300", "steps=5"), names)


@pytest.mark.parametrize("page", [README, *PAGES, ROOT / "CONTRIBUTING.md"], ids=lambda p: p.stem)
def test_a_page_names_commands_and_files_that_exist(page: Path) -> None:
    text, makefile = page.read_text(), (ROOT / "Makefile").read_text()
    for target in re.findall(r"(?:^|`)make (\w+)", text, re.MULTILINE):
        assert re.search(rf"^NOTEBOOKS.*\b{target}\b|^{target}:", makefile, re.MULTILINE), target
    for name in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (page.parent / name).exists(), name


def test_every_public_name_has_an_entry_in_the_reference() -> None:
    listed = set(re.findall(r"^   (\w+)$", (DOCS / "api" / "index.md").read_text(), re.MULTILINE))
    assert listed == {
        name for name in tsmlib.__all__ if name not in ("plots", "rewards", "__version__")
    }


def test_every_page_is_within_reach_of_the_landing_page() -> None:
    index = (DOCS / "index.md").read_text()
    for page in PAGES:
        name = str(page.relative_to(DOCS).with_suffix(""))
        assert name in index or name == "index", name


def test_templates_and_workflows_are_yaml() -> None:
    files = sorted((ROOT / ".github").rglob("*.yml"))
    assert files
    for path in files:
        assert yaml.safe_load(path.read_text()), path


@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda p: p.stem)
def test_links_of_a_notebook_lead_to_files(path: Path) -> None:
    cells = [cell.source for cell in nbformat.read(path, 4).cells if cell.cell_type == "markdown"]
    for name in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", "\n".join(cells)):
        assert (path.parent / name).exists(), name


@pytest.mark.skipif(not BUILT.exists(), reason="make docs was not run")
def test_a_built_page_loads_nothing_from_elsewhere() -> None:
    pages = list(BUILT.rglob("*.html"))
    assert pages
    assert not [page.name for page in pages if LOADED.search(page.read_text())]
