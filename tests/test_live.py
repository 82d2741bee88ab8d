"""Cells executed by hand: of a table written out of order it is said, and no other notebook reads it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import nbformat
import pytest
from reliability.pipelines import write_notebook
from reliability.training import kernel, printed

from tsmlib import study
from tsmlib.storage import manifest, tables
from tsmlib.study import comparison, live, notebooks, runs
from tsmlib.study.results.table import YOURS
from tsmlib.study.runs import Notebook, Run, resolve

CELLS = (
    "from tsmlib.study.runs import resolve\nrun, rows = resolve('01_first', scale=scale, run_dir=run_dir), []",
    "rows += [1]",
    "rows += [2]\nassert not fail",
    "_ = (run.metrics / '01_first.csv').write_text(str(rows))",
    "rows += [3]",
    "_ = (run.metrics / '01_first.csv').write_text(str(rows))\n",
)
BEFORE = "from pathlib import Path\nfrom tsmlib.study import runs\nruns.NOTEBOOKS = Path({!r})"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a notebook that writes its table twice."""
    place = tmp_path_factory.mktemp("live")
    write_notebook(place / "notebooks" / "01_first.ipynb", *CELLS)
    return place


@pytest.fixture(scope="module")
def client(place: Path) -> Iterator[Any]:
    """A live kernel of that notebook."""
    with kernel(TSM_RUN_DIR=str(place / "runs"), TSM_SCALE="smoke") as (_, client):
        said(client, BEFORE.format(str(place / "notebooks")))
        said(client, 'scale, seed, run_dir, fail = "", 0, "", False')
        yield client


def said(client: Any, *cells: str) -> str:
    """What cells print, one after another."""
    return "".join(printed(client, cell)[1] for cell in cells)


@pytest.mark.parametrize("fewer", [4, 6])
def test_cells_that_run_from_top_to_bottom_say_nothing_a_second_time_either(client: Any, fewer: int) -> None:
    assert said(client, *CELLS[:fewer], *CELLS[:fewer]) == ""


@pytest.mark.parametrize(
    ("cells", "how"),
    [
        ((0, 1, 2, 4, 3), "cells of 01_first.ipynb ran in another order, twice, or with others between"),
        ((0, 1, 1, 2, 3), "in another order, twice"),
        ((0, "rows = [7]", 1, 2, 3), "with others between"),
        ((0, 1, "rows += [2.5]", 3), "code cell 4 has not run to the end, or not as in 01_first.ipynb"),
        ((0, 3), "code cells 3, 4 have not run"),
        ((0, 1, 2, 'scale = "laptop"', 3), "with others between"),
        ((0, 1, 2, "print(run.metrics)"), "this cell is not in 01_first.ipynb"),
        (("fail = True", 0, 1, 2, "fail = False", 3), "code cell 4 has not run to the end"),
    ],
)
def test_a_table_that_cells_write_otherwise_is_said_not_to_be_the_notebooks(
    client: Any, cells: tuple[int | str, ...], how: str
) -> None:
    said(client, "%reset -f in", 'scale, seed, run_dir, fail = "", 0, "", False')
    found = said(client, *(cell if isinstance(cell, str) else CELLS[cell] for cell in cells))
    assert how in found
    assert "may differ from the notebook's, and nothing else reads it" in found
    assert "or: python -m tsmlib run first --scale smoke --seed 0" in found


def test_a_run_of_the_whole_notebook_prints_nothing(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "NOTEBOOKS", place / "notebooks")
    monkeypatch.setenv("PYTHONPATH", str(runs.ROOT))
    cells = (BEFORE.format(str(place / "notebooks")), "fail = False", *CELLS)
    write_notebook(place / "whole" / "01_first.ipynb", *cells)
    monkeypatch.setattr(runs, "NOTEBOOKS", place / "whole")
    found = notebooks.prepare(runs.notebooks()["first"], scale="smoke", given={"run_dir": str(place / "whole")})
    cells = json.loads(notebooks.execute(found, progress=False).read_text())["cells"]
    assert [cell["outputs"] for cell in cells] == [[]] * len(cells)


def test_a_notebook_shows_another_ones_table_as_yours_only_if_that_came_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(comparison, "RESULTS", tmp_path / "results")
    run = resolve("06_robustness", scale="smoke", run_dir=str(tmp_path))
    assert study.evidence_of(run, "03_predict").empty
    assert capsys.readouterr().out == ""
    path = write_table(run, "03_predict")  # cells that ran by hand leave no status
    assert study.evidence_of(run, "03_predict").empty
    assert "your rows are left out: 03_predict in" in (said := capsys.readouterr().out)
    assert "Run it: python -m tsmlib run predict --scale smoke --seed 0" in said
    entry = manifest.sealed({"state": "complete", "files": manifest.listing(run.dir, [path])})
    manifest.write_json(run.dir / "03_predict.status.json", entry)
    assert set(study.evidence_of(run, "03_predict")["source"]) == {YOURS}
    assert capsys.readouterr().out == ""
    write_table(run, "03_predict", value=2.0)  # cells by hand, after a run
    assert study.evidence_of(run, "03_predict").empty
    assert "03_predict.csv is not what 03_predict made" in capsys.readouterr().out


def test_a_benchmarks_table_is_published_or_yours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparison, "RESULTS", tmp_path / "smoke" / "seed1" / "metrics")
    write_table(resolve("07_action_prior", scale="smoke", seed=1, run_dir=str(tmp_path)), "07_starts")
    run = resolve("07_action_prior", scale="smoke", run_dir=str(tmp_path))
    assert list(study.table(run, "07_starts")["source"]) == ["published"]
    write_table(run, "07_starts")
    assert list(study.table(run, "07_starts")["source"]) == ["yours"]


def write_table(run: Run, name: str, value: float = 1.0) -> Path:
    path = run.metrics / f"{name}.csv"
    tables.save(path, [dict(env="tsm/Reacher-v0", metric="nrmse", value=value, seed=run.seed, scale=run.scale)])
    return path


@pytest.mark.parametrize("notebook", runs.notebooks().values(), ids=lambda notebook: notebook.stem)
def test_the_cells_of_every_notebook_in_order_are_its_own(notebook: Notebook, monkeypatch: pytest.MonkeyPatch) -> None:
    cells = [cell.source for cell in nbformat.read(notebook.path, 4).cells if cell.cell_type == "code"]
    history = ["", cells[0], "# Parameters\nseed = 1\n"]
    monkeypatch.setattr(live, "shell", lambda: SimpleNamespace(history_manager=SimpleNamespace(input_hist_raw=history)))
    for cell in cells[1:]:
        history.append(cell)
        assert live.deviation(notebook.path) == ""
    del history[-2]
    assert live.deviation(notebook.path)
