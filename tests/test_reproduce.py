"""Every published row has a command that makes it, and one command makes those of a table or a claim again."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tsmlib.study.claims.ledger import claims, questions
from tsmlib.study.runs import ROOT

sys.path.insert(0, str(ROOT / "benchmarks" / "settings"))

import reproduce
import rows as rows_script

SHIPPED, PAGE = reproduce.shipped, ROOT / "docs" / "reproducing.md"


@pytest.fixture(scope="module")
def read() -> dict[str, pd.DataFrame]:
    return SHIPPED()


@pytest.fixture(autouse=True)
def shipped(read: dict[str, pd.DataFrame], monkeypatch: pytest.MonkeyPatch) -> dict[str, pd.DataFrame]:
    """The tables, read once for all tests."""
    monkeypatch.setattr(reproduce, "shipped", lambda folder=None: read)
    return read


def ended(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *given: str) -> str:
    """What the command says as it refuses what is given."""
    monkeypatch.setattr(sys, "argv", ["reproduce.py", *given])
    with pytest.raises(SystemExit) as end:
        reproduce.main()
    assert end.value.code == 2
    return capsys.readouterr().err


def listed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *given: str) -> list[str]:
    """The commands that it would run."""
    monkeypatch.setattr(sys, "argv", ["reproduce.py", *given, "--list"])
    reproduce.main()
    return capsys.readouterr().out.splitlines()


def test_some_command_makes_every_row_that_ships(shipped: dict[str, pd.DataFrame]) -> None:
    tables = {path.name.partition(".")[0] for path in Path(reproduce.RESULTS).glob("*.csv*")}
    assert tables - set(shipped) == {reproduce.JUDGED}
    for name, table in shipped.items():
        made = {row for recipe in reproduce.RECIPES if name in recipe.tables for row in recipe.made(table).index}
        assert table.drop([*made]).empty, name


def test_every_command_is_one_that_its_script_takes(shipped: dict[str, pd.DataFrame]) -> None:
    lines = [shlex.split(line) for line in reproduce.commands(shipped)]
    assert {line[1] for line in lines} > {reproduce.ROWS}
    for _, script, *given in lines:
        assert script == "-m" or (ROOT / script).is_file()
        if script == reproduce.ROWS:
            rows_script.parser().parse_args(given)


def test_the_commands_of_a_claim_make_each_row_that_it_asks_for(shipped: dict[str, pd.DataFrame]) -> None:
    for name, wanted in reproduce.rows_of_claims(claims(), shipped).items():
        given = [
            rows_script.parser().parse_args(shlex.split(line)[2:])
            for line in reproduce.commands({name: wanted}) if reproduce.ROWS in line and "--seed" in line
        ]  # fmt: skip
        named = {(one.seed, env, model) for one in given for env in one.envs for model in one.models}
        triples = set(wanted[["seed", "env", "model"]].itertuples(index=False, name=None))
        assert {found for found in triples if found[2] in reproduce.FIVE} <= named, name


def test_a_claim_asks_for_fewer_rows_than_its_tables_have(shipped: dict[str, pd.DataFrame]) -> None:
    (one,) = (claim for claim in claims() if claim.id == "C46")
    ((name, found),) = reproduce.rows_of_claims([one], shipped).items()
    assert name == "04_latent"
    assert set(found["model"]) == {"tsm"}
    assert 0 < len(found) < len(shipped[name]) / 10


def test_a_plateau_is_told_anew_with_all_that_it_is_told_from(shipped: dict[str, pd.DataFrame]) -> None:
    (one,) = (claim for claim in claims() if claim.id == "C39")  # of tsm alone
    lines = reproduce.commands(reproduce.with_sources(reproduce.rows_of_claims([one], shipped), shipped))
    free, first, early = "model_free.py --seeds 10", "policies --scale paper --seed 0", "early --scale paper --seed 0"
    at = [next(i for i, line in enumerate(lines) if what in line) for what in (free, first, early)]
    assert at == sorted(at)
    learned = [line for line in lines if first in line and reproduce.REACH in line]
    assert {word for line in learned for word in shlex.split(line)} >= {"tsm", "rtsm"}


def test_the_first_records_of_a_policy_are_made_again_with_it(shipped: dict[str, pd.DataFrame]) -> None:
    for one in claims():
        found = reproduce.with_sources(reproduce.rows_of_claims([one], shipped), shipped).get(
            "05_control", pd.DataFrame()
        )
        if found.empty:
            continue
        first = "policies --scale paper --seed 0 --envs tsm/Reacher-v0 --models tsm"
        lines = reproduce.commands({"05_control": found})
        assert any(first in line for line in lines) == any("early --scale paper --seed 0" in line for line in lines)


def test_a_stopped_command_keeps_the_rows_before_and_says_at_its_end_how_far_the_new_ones_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path,
    shipped: dict[str, pd.DataFrame],
) -> None:  # fmt: skip
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path))
    kept = tmp_path / "reproduce"
    monkeypatch.setattr(sys, "argv", ["reproduce.py", "02_train", "C46", "--seeds", "0"])
    ran, codes, there = [], iter([0, 1, 0, 0, 0]), dict(shipped)

    def run(line: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        ran.append(line)
        if line[2] == "gradients":  # of seed 0, of two models
            new = there["02_train"].copy()
            new.loc[(new["seed"] == 0) & (new["model"] == "tsm"), "value"] += 1
            there["02_train"] = new
        return subprocess.CompletedProcess(line, next(codes))

    monkeypatch.setattr(reproduce, "shipped", lambda folder=None: shipped if folder == kept else dict(there))
    monkeypatch.setattr(subprocess, "run", run)
    with pytest.raises(SystemExit, match="ended with status 1; what was made before it stays"):
        reproduce.main()
    there_too = {path.name for path in Path(reproduce.RESULTS).iterdir()}
    assert {path.name for path in kept.iterdir()} == {*there_too, reproduce.REQUEST}
    assert "keeps the tables from before a command that was stopped" in ended(monkeypatch, capsys, "C46")
    monkeypatch.setattr(sys, "argv", ["reproduce.py", "02_train", "C46", "--seeds", "0"])
    reproduce.main()
    assert [line[2] for line in ran] == ["gradients", "latent", "gradients", "latent", "tsmlib"]
    said = capsys.readouterr().out
    assert f"compared with the tables in {kept}" in said
    assert "C46: REPLICATED, again REPLICATED" in said
    ((rows, again, equal),) = re.findall(r"02_train +gradient_error +(\d+) +(\d+) +(\d+)", said)
    assert (rows, again, equal) == ("2", "2", "1")
    assert not kept.exists()


def test_a_table_of_a_script_is_published_as_a_whole_and_no_other(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    results = tmp_path / "data" / "results"
    results.mkdir(parents=True)
    monkeypatch.setattr(rows_script, "RESULTS", results)
    table = Path(reproduce.RESULTS) / "07_starts.csv"
    monkeypatch.setattr(sys, "argv", ["rows.py", "whole", str(table)])
    rows_script.main()
    assert (results / table.name).read_bytes() == table.read_bytes()
    assert "07_starts" in (tmp_path / "data" / "MANIFEST.json").read_text()
    monkeypatch.setattr(sys, "argv", ["rows.py", "whole", str(table.with_name("09_your_own.csv"))])
    with pytest.raises(SystemExit):
        rows_script.main()
    assert "whole takes 03_samples.csv and 07_starts.csv; got 09_your_own.csv" in capsys.readouterr().err


def test_a_table_of_one_seed_has_no_commands_of_another(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert listed(monkeypatch, capsys, "02_train", "--seeds", "3") == [
        f"python {reproduce.ROWS} gradients --scale paper --seed 3 --envs tsm/ReacherPush-v1 --models tsm rtsm",
        reproduce.CLAIMS,
    ]


def test_an_unknown_name_and_seeds_without_rows_are_refused_with_those_that_there_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "05_control, 05_control_rows" in ended(monkeypatch, capsys, "05_controls")
    assert "there are seeds 0, 1, 2, 3, 4, 6, 7, 8, 9" in ended(monkeypatch, capsys, "02_train", "--seeds", "0", "12")
    assert "all" in ended(monkeypatch, capsys)


def test_what_needs_another_environment_is_refused_before_anything_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(reproduce, "ROOT", tmp_path)
    said = ended(monkeypatch, capsys, "peers_pets")
    assert "build/peers/bin/python" in said
    assert "benchmarks/peers/README.md" in said


def test_the_page_says_how_other_environments_are_installed_and_what_needs_them(
    shipped: dict[str, pd.DataFrame],
) -> None:
    page = PAGE.read_text()
    for folder in ("model_free", "peers"):
        readme = (ROOT / "benchmarks" / folder / "README.md").read_text()
        steps = re.findall(rf"^(?:python3 -m venv )?build/{folder}(?:/bin/pip .*)?$", readme, re.MULTILINE)
        assert len(steps) == 3
        assert " && ".join(steps) in page
    needing = {name: {name: table} for name, table in shipped.items()}
    for one in (*claims(), *questions()):
        needing[one.id] = reproduce.with_sources(reproduce.rows_of_claims([one], shipped), shipped)
    others = {name for name, rows in needing.items() if "build/" in " ".join(reproduce.commands(rows))}
    said = page[page.index("Without `build/model_free`") : page.index("without either `all` does")]
    assert others == {*re.findall(r"`(\w+)`", said), *re.findall(r"\b[CQ]\d+\b", said)}


def test_rows_that_came_out_the_same_are_no_difference_and_others_are_told(shipped: dict[str, pd.DataFrame]) -> None:
    before = {"02_train": shipped["02_train"]}
    same = reproduce.differences(before, before)
    assert (same["equal"] == same["rows"]).all()
    assert (same["largest difference"] == 0).all()
    moved = before["02_train"].copy()
    unit = moved["value"].std()
    moved.loc[moved.index[0], "value"] += 2 * unit
    found = reproduce.differences(before, {"02_train": moved.iloc[:-1]}).iloc[0]
    assert found["equal"] == found["there again"] - 1 == found["rows"] - 2
    assert np.isclose(found["largest difference"], 2 * unit)
    assert np.isclose(found["mean / deviation"], 2 / found["there again"])


def test_the_page_on_reproducing_has_the_commands_and_the_seeds_of_the_rows_that_ship() -> None:
    again = "docs/reproducing.md lacks commands; run: python benchmarks/settings/reproduce.py --page"
    assert reproduce.page() in PAGE.read_text(), again
