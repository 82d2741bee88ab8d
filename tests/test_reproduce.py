"""Every published row has a command that makes it, and one command makes those of a table or a claim again."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tsmlib.study.claims.ledger import claims
from tsmlib.study.runs import ROOT

sys.path.insert(0, str(ROOT / "benchmarks" / "settings"))

import reproduce
import rows as rows_script

PAGE = ROOT / "docs" / "reproducing.md"


@pytest.fixture(scope="module")
def read() -> dict[str, pd.DataFrame]:
    return reproduce.shipped()


@pytest.fixture(autouse=True)
def shipped(read: dict[str, pd.DataFrame], monkeypatch: pytest.MonkeyPatch) -> dict[str, pd.DataFrame]:
    """The tables, read once for all tests."""
    monkeypatch.setattr(reproduce, "shipped", lambda: read)
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
    for name, wanted in reproduce.asked(claims(), shipped).items():
        given = [
            rows_script.parser().parse_args(shlex.split(line)[2:])
            for line in reproduce.commands({name: wanted}) if reproduce.ROWS in line and "--seed" in line
        ]  # fmt: skip
        named = {(one.seed, env, model) for one in given for env in one.envs for model in one.models}
        triples = set(wanted[["seed", "env", "model"]].itertuples(index=False, name=None))
        assert {found for found in triples if found[2] in reproduce.FIVE} <= named, name


def test_a_claim_asks_for_fewer_rows_than_its_tables_have(shipped: dict[str, pd.DataFrame]) -> None:
    (one,) = (claim for claim in claims() if claim.id == "C46")
    ((name, found),) = reproduce.asked([one], shipped).items()
    assert name == "04_latent"
    assert set(found["model"]) == {"tsm"}
    assert 0 < len(found) < len(shipped[name]) / 10


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
    assert "there are seeds 0 to 4" in ended(monkeypatch, capsys, "02_train", "--seeds", "0", "12")
    assert "all" in ended(monkeypatch, capsys)


def test_what_needs_another_environment_is_refused_before_anything_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(reproduce, "ROOT", tmp_path)
    said = ended(monkeypatch, capsys, "peers_pets")
    assert "build/peers/bin/python" in said
    assert "benchmarks/peers/README.md" in said


def test_rows_that_came_out_the_same_are_no_difference_and_others_are_told(shipped: dict[str, pd.DataFrame]) -> None:
    before = {"02_train": shipped["02_train"]}
    same = reproduce.far(before, before)
    assert (same["equal"] == same["rows"]).all()
    assert (same["largest"] == 0).all()
    moved = before["02_train"].copy()
    unit = moved["value"].std()
    moved.loc[moved.index[0], "value"] += 2 * unit
    found = reproduce.far(before, {"02_train": moved.iloc[:-1]}).iloc[0]
    assert found["equal"] == found["there again"] - 1 == found["rows"] - 2
    assert np.isclose(found["largest"], 2)


def test_the_page_on_reproducing_has_the_commands_and_the_seeds_of_the_rows_that_ship() -> None:
    again = "docs/reproducing.md lacks commands; run: python benchmarks/settings/reproduce.py --page"
    assert reproduce.page() in PAGE.read_text(), again
