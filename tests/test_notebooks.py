"""Notebooks are lessons: short, stored clean, on the public interface; each runs by itself."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import nbformat
import pytest

from tsmlib import zoo
from tsmlib.pretrained import ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LESSONS = [path for path in NOTEBOOKS if not path.stem.startswith("00")]
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
each_lesson = pytest.mark.parametrize("path", LESSONS, ids=lambda path: path.stem)
OUTSIDE = {
    "dataclasses",
    "functools",
    "importlib",
    "tomllib",
    "gymnasium",
    "numpy",
    "pandas",
    "torch",
}


def cells(path: Path, kind: str) -> Iterator[nbformat.NotebookNode]:
    return (cell for cell in nbformat.read(path, 4).cells if cell.cell_type == kind)


def nodes(path: Path) -> Iterator[ast.AST]:
    return (node for cell in cells(path, "code") for node in ast.walk(ast.parse(cell.source)))


@each_notebook
def test_a_notebook_is_stored_without_outputs(path: Path) -> None:
    nbformat.validate(json.loads(path.read_text()))
    assert nbformat.read(path, 4).metadata.kernelspec.name == "python3"
    for cell in cells(path, "code"):
        assert not cell.outputs
        assert cell.execution_count is None


@each_notebook
def test_a_notebook_calls_the_library_and_defines_nothing(path: Path) -> None:
    for node in nodes(path):
        assert not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
        if isinstance(node, ast.Import):
            assert {name.name.partition(".")[0] for name in node.names} <= OUTSIDE | {"tsmlib"}
            assert all(name.asname in (None, "np", "pd") for name in node.names)
        if isinstance(node, ast.ImportFrom):
            assert node.module.partition(".")[0] in OUTSIDE | {"tsmlib"}


@each_notebook
def test_a_notebook_takes_a_scale_and_a_seed(path: Path) -> None:
    (cell,) = (c for c in cells(path, "code") if "parameters" in c.metadata.get("tags", []))
    assert cell.source.startswith('scale = "laptop"')
    assert "\nseed = 0" in cell.source


@each_lesson
def test_a_lesson_is_short_asks_one_question_and_ends_with_exercises(path: Path) -> None:
    prose = [cell.source for cell in cells(path, "markdown")]
    assert len(list(cells(path, "code"))) <= 14
    assert len(" ".join(prose).split()) <= 900
    text = "\n".join(prose)
    for words in (
        "**Question.**",
        "**Answer.**",
        "## Try it",
        "## Where this departs from the paper",
    ):
        assert text.count(words) == 1, words
    assert all(f"\n{k}. " in text for k in (1, 2, 3))
    assert any(isinstance(node, ast.Assert) for node in nodes(path))
    assert "plots." in "".join(cell.source for cell in cells(path, "code"))


def test_the_lessons_have_every_equation_of_the_paper() -> None:
    text = "".join(cell.source for path in LESSONS for cell in cells(path, "markdown"))
    assert all(rf"\tag{{{k}}}" in text for k in (1, 2, 3, 4))


@each_notebook
def test_what_a_notebook_links_to_is_there(path: Path) -> None:
    for cell in cells(path, "markdown"):
        for part in cell.source.split("](")[1:]:
            target = part.partition(")")[0].partition("#")[0]
            assert not target or (path.parent / target).exists() or "://" in target, target


@each_notebook
def test_words_of_models_in_a_notebook_are_those_of_the_zoo(path: Path) -> None:
    for node in nodes(path):
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "load_pretrained":
            word = node.args[0]
            assert not isinstance(word, ast.Constant) or word.value in {*zoo.ZOO, "egocentric"}


@pytest.mark.skipif(
    "config.option.nbval or config.option.nbval_lax", reason="this session runs them already"
)
@each_notebook
def test_a_notebook_runs_to_its_end(path: Path, tmp_path: Path) -> None:
    pytest.importorskip("papermill")
    out = tmp_path / path.name
    command = [sys.executable, "-m", "papermill", str(path), str(out), "-p", "scale", "smoke"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    shown = [output for cell in cells(out, "code") for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in shown)
    assert not any(output.output_type == "error" for output in shown)
    assert not any("%|" in output.get("text", "") for output in shown), "a progress bar stays"
