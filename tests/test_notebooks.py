"""Notebooks: stored clean, written to one pattern, and run in order through papermill at the smallest scale."""

from __future__ import annotations

import ast
import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat
import pytest

from tsmlib import study
from tsmlib.storage import manifest, tables
from reproduction import notebooks, parameters, runs

NOTEBOOKS = [notebook.path for notebook in runs.notebooks().values()]
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def code(path: Path) -> Iterator[Any]:
    return (cell for cell in nbformat.read(path, 4).cells if cell.cell_type == "code")


def changed() -> dict[str, bytes]:
    """What differs from the last commit, with its content; nothing where this is no git checkout."""
    command = [
        "git",
        "status",
        "--porcelain",
        "--no-renames",
        "-z",
        "--",
        "README.md",
        "data",
        "docs",
        "figures",
    ]
    done = subprocess.run(command, cwd=runs.ROOT, capture_output=True, text=True, check=False)
    paths = [runs.ROOT / entry[3:] for entry in done.stdout.split("\0") if entry]
    return {str(path): path.read_bytes() if path.is_file() else b"" for path in paths}


def plain(source: str) -> str:
    """Python without the lines that only IPython understands."""
    return "\n".join(
        line for line in source.splitlines() if not line.lstrip().startswith(("%", "!"))
    )


@each_notebook
def test_a_notebook_names_the_kernel_that_every_environment_has(path: Path) -> None:
    metadata = nbformat.read(path, 4).metadata
    assert metadata.kernelspec.name == "python3"
    assert (
        metadata.kernelspec.get("language", metadata.get("language_info", {}).get("name"))
        == "python"
    )
    assert "papermill" not in metadata


@each_notebook
def test_a_notebook_is_stored_without_outputs(path: Path) -> None:
    nbformat.validate(json.loads(path.read_text()))
    for cell in code(path):
        assert not cell.outputs
        assert cell.execution_count is None


@each_notebook
def test_a_notebook_calls_the_library_and_defines_nothing(path: Path) -> None:
    for cell in code(path):
        for node in ast.walk(ast.parse(plain(cell.source))):
            assert not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef), (
                cell.source
            )


@each_notebook
def test_a_notebook_takes_a_scale_a_seed_and_a_folder(path: Path) -> None:
    defaults = parameters.declared(path)
    assert {"scale": "", "seed": 0, "run_dir": ""}.items() <= defaults.items()
    assert {type(value) for value in defaults.values()} <= {str, int, float, bool}


def test_what_notebooks_assert_of_a_seed_s_own_rows_holds_for_every_published_seed() -> None:
    """Other assertions on rows are on all that are shown, the published ones of every seed among them."""
    asserted = {  # notebook -> what the cell says, and what it says it of
        "01_collect": 'share["limit_share"].max()',
        "02_train": 'row["value"] <= 1e-5 for row in errors',
    }
    for stem, words in asserted.items():
        (cell,) = [cell for cell in code(runs.NOTEBOOKS / f"{stem}.ipynb") if words in cell.source]
        lines = [node for node in ast.walk(ast.parse(cell.source)) if isinstance(node, ast.Assert)]
        rows = study.published(stem)
        assert lines
        assert len(rows)
        for _, own in rows.groupby("seed"):
            shares, errors = (
                own[own["metric"].str.endswith("_share")],
                own[own["metric"] == "gradient_error"],
            )
            share = shares.pivot_table(index="env", columns="metric", values="value")
            names = dict(share=share, counted=tables.records(shares), errors=tables.records(errors))
            exec(compile(ast.Module(lines, []), stem, "exec"), names)


@pytest.mark.skipif(
    "config.option.nbval or config.option.nbval_lax", reason="this session runs them already"
)
@pytest.mark.skipif(not NOTEBOOKS, reason="no notebooks")
def test_all_notebooks_run_in_order_and_leave_their_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path))
    before = changed()
    for notebook in runs.notebooks().values():
        path = notebook.path
        notebooks.execute(notebooks.prepare(notebook, scale="smoke"), progress=False)
        if notebook.name == "quickstart":  # it teaches, and measures nothing
            continue
        rows = tables.records(
            tables.load(tmp_path / "smoke" / "seed0" / "metrics" / f"{path.stem}.csv")
        )
        assert rows
        assert {row["scale"] for row in rows} == {"smoke"}
        if notebook.name != "claims":  # it reads all others, which at this scale say nothing
            executed = (tmp_path / "smoke" / "seed0" / path.name).read_text()
            assert "yours: scale smoke, seed 0, n " in executed, path.stem  # below a table
    status = manifest.statuses(tmp_path / "smoke" / "seed0")
    assert {name: entry["state"] for name, entry in status.items()} == {
        path.stem: "complete" for path in NOTEBOOKS
    }
    manifest.verify(tmp_path)
    each = [runs.resolve(path.stem, scale="smoke", run_dir=str(tmp_path)) for path in NOTEBOOKS]
    declared = {f"{job.name}.safetensors" for run in each for job in study.needs(run)}
    folders = [each[0].dir / name for name in ("data", "models", "plans", "scores")]
    made = {
        path.relative_to(each[0].dir).as_posix()
        for place in folders
        for path in place.rglob("*.safetensors")
    }
    assert made == declared
    assert not list(tmp_path.rglob("*.tmp-*"))
    assert changed() == before  # only publish writes what is tracked
