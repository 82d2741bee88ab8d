"""What ships is of every seed there is, and of no run that did not come to its end; figures follow rows."""

from __future__ import annotations

import ast
import builtins
from pathlib import Path
from typing import Any

import nbformat
import pandas as pd
import pytest

from tsmlib import figures
from tsmlib.storage import files, manifest
from tsmlib.storage import tables as tables_storage
from tsmlib.study import publish, runs
from tsmlib.study.drawings import Drawing
from tsmlib.study.results import table
from tsmlib.study.runs import Run, RunError


def seed(base: Path, k: int, state: str = "complete") -> Run:
    """A paper-scale run of one seed with a row in every table that is pooled."""
    run = Run("publish", "paper", k, base / f"seed{k}")
    for notebook in publish.POOLED:
        row: dict[str, Any] = dict(metric="kl", value=k, seed=k, scale="paper", env="tsm/Reacher-v0")
        more = {"dimension": 1} if notebook == "04_latent" else {}
        tables_storage.save(run.metrics / f"{notebook}.csv", [row | more])
    entries = {notebook: {"state": state, "files": {}} for notebook in publish.POOLED}
    manifest.write_json(run.dir / files.STATUS, {name: manifest.sealed(entry) for name, entry in entries.items()})
    return run


def test_tables_ship_with_the_rows_of_every_seed_and_all_their_columns(tmp_path: Path) -> None:
    run = seed(tmp_path, 0)
    seed(tmp_path, 1)
    tables = publish.pooled(run)
    assert set(tables) == set(publish.POOLED)
    for notebook, rows in tables.items():
        assert rows["seed"].tolist() == [0, 1]
        assert ("dimension" in rows) == (notebook == "04_latent")


def test_a_notebook_with_several_tables_ships_all_of_them_with_every_seed(tmp_path: Path) -> None:
    run, other = seed(tmp_path, 0), seed(tmp_path, 1)
    for each, name in ((run, "03_ablation"), (other, "03_ablation"), (run, "08_claims")):
        row = dict(metric="kl", value=1.0, seed=each.seed, scale="paper", env="tsm/Reacher-v0")
        tables_storage.save(each.metrics / f"{name}.csv", [row])
    assert publish.pooled(run)["03_ablation"]["seed"].tolist() == [0, 1]
    assert list(publish.pooled(run, ["03_predict"])) == ["03_ablation", "03_predict"]
    assert "08_claims" not in publish.pooled(run)


def test_publishing_a_run_of_fewer_seeds_loses_no_row_and_says_what_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(publish, "RESULTS", tmp_path / "data" / "results")
    monkeypatch.setattr(publish, "publish_claims", lambda: None)
    run, path = seed(tmp_path, 0), tmp_path / "data" / "results" / "03_predict.csv"
    row: dict[str, Any] = dict(metric="kl", value=9, scale="paper", env="tsm/Reacher-v0")
    stay = [dict(row, seed=1), dict(row, seed=2), dict(row, seed=0, env="tsm/ReacherPush-v1")]
    tables_storage.save(path, [dict(row, seed=0), *stay])
    publish.publish_table(run, "03_predict")
    said = "03_predict: 1 (seed 0) rows of runs in place of 1 (seed 0) that shipped; 3 (seeds 0, 1, 2) stay\n"
    assert capsys.readouterr().out == said
    assert tables_storage.load(path).equals(tables_storage.frame([*stay, dict(row, seed=0, value=0)]))


def test_rows_of_fewer_targets_never_take_the_place_of_those_that_ship(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publish, "RESULTS", tmp_path / "data" / "results")
    monkeypatch.setattr(publish, "publish_claims", lambda: None)
    run, path = seed(tmp_path, 0), tmp_path / "data" / "results" / "03_predict.csv"
    row: dict[str, Any] = dict(metric="kl", value=9, scale="paper", env="tsm/Reacher-v0", seed=0)
    of_few, of_many = [dict(row, n=n) for n in (20, 100)]
    drawn = [dict(row, metric="travel", n=n) for n in (29, 30)]  # however many episodes a model's samples hit something
    tables_storage.save(run.metrics / "03_predict.csv", [of_few])
    tables_storage.save(path, [of_many, drawn[1]])
    said = "of 20 targets or episodes, expected the 100 that ship, for env tsm/Reacher-v0, seed 0.*tsmlib run predict,"
    with pytest.raises(RunError, match=said):
        publish.publish_table(run, "03_predict")
    assert tables_storage.load(path).equals(tables_storage.frame([of_many, drawn[1]]))
    tables_storage.save(run.metrics / "03_predict.csv", [dict(of_few, env="tsm/ReacherPush-v1"), of_many, drawn[0]])
    publish.publish_table(run, "03_predict")
    assert tables_storage.load(path)["n"].tolist() == [20, 100, 29]


def test_publishing_compresses_a_large_table_once_and_changes_no_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publish, "RESULTS", tmp_path)
    rows = tables_storage.save(tmp_path / "05_control_rows.csv", rows_of(**{"Reacher-v0": [0]}).drop(columns="source"))
    manifest.write_manifest(tmp_path)
    monkeypatch.setattr(tables_storage, "LARGE", 10)
    publish.compress()
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["05_control_rows.csv.gz", "MANIFEST.json"]
    assert tables_storage.load(tmp_path / "05_control_rows.csv").equals(rows)


def test_a_seed_that_did_not_come_to_its_end_stops_publishing(tmp_path: Path) -> None:
    run = seed(tmp_path, 0)
    seed(tmp_path, 1, state="failed")
    with pytest.raises(RunError, match="seed1 is failed, expected complete"):
        publish.pooled(run)


def test_nothing_is_written_before_all_notebooks_have_come_to_their_end(tmp_path: Path) -> None:
    before = publish.README.read_text()
    with pytest.raises(RunError, match="01_collect in .* is not run, expected complete"):
        publish.publish(seed(tmp_path, 0))
    assert publish.README.read_text() == before


def rows_of(**seeds: list[int]) -> pd.DataFrame:
    """Rows of the arms of some names, one for each of their training seeds."""
    common = dict(metric="kl", value=1.0, scale="paper", n=100)
    rows = [dict(common, env=f"tsm/{arm}", seed=k) for arm, each in seeds.items() for k in each]
    return tables_storage.frame(rows).assign(source=table.YOURS)


def test_a_figure_of_rows_is_drawn_again_and_what_needs_a_run_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("figure1.png", "figure1.pdf", "of_a_run.png"):
        (tmp_path / name).write_bytes(b"old")
    drawn = Drawing(figures.figure1(), "figure1", rows_of(**{"Reacher-v0": [0]}))
    monkeypatch.setattr(publish, "FIGURES", tmp_path)
    monkeypatch.setattr(publish, "drawings_of_rows", lambda: iter([drawn]))
    monkeypatch.setattr(runs, "notebooks", dict)
    assert publish.publish_figures() == [tmp_path / "of_a_run.png"]
    assert (tmp_path / "of_a_run.png").read_bytes() == b"old"
    assert b"old" not in [(tmp_path / name).read_bytes() for name in ("figure1.png", "figure1.pdf")]
    assert drawn.figure.legends[-1].get_texts()[0].get_text() == "scale paper, seed 0, n = 100"


def test_a_stamp_names_the_arms_of_which_there_are_fewer_seeds() -> None:
    rows = rows_of(**{"Reacher-v0": [0, 1, 2], "ReacherPush-v1": [0]})
    assert table.stamp(rows, figure=True) == "scale paper, seeds 0, 1, 2 (ReacherPush: 0), n = 100"


def test_a_stamp_names_the_worlds_and_the_models_of_which_there_are_fewer_seeds() -> None:
    common = dict(env="tsm/Reacher-v0", metric="kl", value=1.0, scale="paper", n=100)
    rows = [dict(common, model="tsm", seed=k) for k in range(3)]
    rows += [dict(common, model=word, seed=0) for word in ("onestep", "lstm")]
    rows += [dict(common, model="tsm", noise=0.1, seed=0), dict(common, model="tsm", noise=0.1, delay=5, seed=1)]
    assert table.stamp(tables_storage.frame(rows).assign(source=table.YOURS), figure=True) == (
        "scale paper, seeds 0, 1, 2 (Reacher with noise 0.1: 0; Reacher with noise 0.1 and delay 5: 1; "
        "one-step, LSTM: 0), n = 100; no rows of recurrent TSM"
    )


def test_a_stamp_names_models_that_have_fewer_seeds_in_one_world_than_elsewhere() -> None:
    common = dict(metric="kl", value=1.0, scale="paper", n=100)
    rows = [
        dict(common, env=f"tsm/{arm}", model=word, seed=k)
        for arm, word, n in (
            ("Reacher-v0", "rtsm", 3), ("Reacher-v0", "lstm", 2), ("Reacher-v0", "onestep", 2),
            ("ReacherPush-v1", "rtsm", 3), ("ReacherPush-v1", "lstm", 1), ("ReacherPush-v1", "onestep", 1),
        )
        for k in range(n)
    ]  # fmt: skip
    assert table.stamp(tables_storage.frame(rows).assign(source=table.YOURS), figure=True) == (
        "scale paper, seeds 0, 1, 2 (LSTM, one-step: 0, 1; LSTM and one-step on ReacherPush: 0), n = 100"
    )


@pytest.mark.parametrize(("models", "said"), [(["tsm"], True), (["tsm", "rtsm"], False), (["onestep"], False)])
def test_a_stamp_says_where_our_model_has_no_rows_beside_others_with_codes(models: list[str], said: bool) -> None:
    rows = tables_storage.frame(
        [dict(env="tsm/Reacher-v0", model=model, seed=0, scale="paper", n=1) for model in models]
    )
    stamp = table.stamp(rows.assign(source=table.YOURS), figure=True)
    assert stamp.endswith("; no rows of recurrent TSM") is said


@pytest.mark.parametrize("path", [each.path for each in runs.notebooks().values()], ids=lambda path: path.stem)
def test_cells_that_run_on_what_ships_use_no_name_of_another_cell(path: Path) -> None:
    known = set(dir(builtins))
    for cell in nbformat.read(path, 4).cells:
        if {"parameters", publish.SHIPPED} & set(cell.metadata.get("tags", ())):
            nodes = list(ast.walk(ast.parse(cell.source)))
            imports = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
            known |= {(each.asname or each.name).partition(".")[0] for node in imports for each in node.names}
            known |= {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
            known |= {node.arg for node in nodes if isinstance(node, ast.arg)}
            assert {node.id for node in nodes if isinstance(node, ast.Name)} <= known, cell.source


@pytest.mark.parametrize("held", ["<!-- a -->\nREST", "<!-- a -->\n<!-- b -->\n<!-- b -->\nREST"])
def test_a_page_without_both_its_marks_is_left_as_it_is(tmp_path: Path, held: str) -> None:
    page = tmp_path / "page.md"
    page.write_text(held)
    with pytest.raises(RunError, match="does not hold <!-- a --> and <!-- b --> once each"):
        publish.between(page, ("<!-- a -->", "<!-- b -->"), "written")
    assert page.read_text() == held
