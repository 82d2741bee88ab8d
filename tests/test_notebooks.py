"""Notebooks: stored clean, written to one pattern, and run in order at the smallest scale."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import nbformat
import pytest

from reproduction import runner, runs
from reproduction.runs import Run

NOTEBOOKS = list(runner.notebooks().values())
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def code(path: Path) -> list[Any]:
    """The code cells of a notebook."""
    return [cell for cell in nbformat.read(path, 4).cells if cell.cell_type == "code"]


@each_notebook
def test_a_notebook_is_stored_without_outputs_for_any_kernel(path: Path) -> None:
    nbformat.validate(json.loads(path.read_text()))
    metadata = nbformat.read(path, 4).metadata
    assert metadata.kernelspec.name == "python3"
    assert "papermill" not in metadata
    for cell in code(path):
        assert not cell.outputs
        assert cell.execution_count is None


@each_notebook
def test_a_notebook_defines_nothing_and_takes_a_scale_and_a_seed(path: Path) -> None:
    defaults = runner.defaults(path)
    assert defaults["scale"] == "laptop"
    assert defaults["seed"] == 0
    for cell in code(path):
        lines = [line for line in cell.source.splitlines() if not line.lstrip().startswith("%")]
        for node in ast.walk(ast.parse("\n".join(lines))):
            assert not isinstance(node, ast.FunctionDef | ast.ClassDef), cell.source


@each_notebook
def test_a_notebook_runs_to_its_end(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runs, "home", lambda: tmp_path)
    executed = runner.execute(path, Run("smoke"), progress=False)
    assert all(cell.execution_count for cell in code(executed) if cell.source.strip())
    assert not list(executed.parent.glob(".*.ipynb"))
