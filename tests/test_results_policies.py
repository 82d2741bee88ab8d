"""Rows of learned policies hold every record; curves, plateaus and tables say what the rows say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tsmlib.plots import figure7
from tsmlib.plots.method import Method
from tsmlib.storage import tables
from tsmlib import zoo
from reproduction.results import policies as policies_results
from reproduction.results import table
from reproduction.runs import ROOT

TSM, PPO = zoo.method("tsm", "latent"), zoo.method("ppo")


def header(seed: int = 0, copies: int = 2, records: int = 3, **changed: Any) -> dict[str, Any]:
    """As ``study.learn`` gives it: record r of copy c returns -(r + c) - seed, and 1 m more is predicted."""
    true = [[-float(r + c + seed) for c in range(copies)] for r in range(records)]
    return {
        "fingerprint": {"env": "tsm/Reacher-v0"},
        "made_from": {"task": "reach"},
        "model": "tsm",
        "search_space": "latent",
        "seed": seed,
        "scale": "paper",
        "curve": {
            "iteration": [220 * r for r in range(records)],
            "seconds": [50.0 * r for r in range(records)],
            "measured": {
                "return_true": true,
                "return_predicted": [[value + 1 for value in row] for row in true],
                "final_distance": [[0.01] * copies] * records,
                "success": [[1.0] * copies] * records,
            },
        },
    } | changed


def rows(**options: Any) -> list[dict[str, Any]]:
    return policies_results.learning_rows(header(**options), samples=50_000, train_seconds=100.0)


def curves_of(rows: list[dict[str, Any]]) -> dict[str, dict[Method, policies_results.Curves]]:
    return policies_results.learning_curves(tables.frame(rows))


def test_rows_hold_every_record_of_every_copy_and_the_cost() -> None:
    found = rows()
    gaps = [row for row in found if row["metric"] == "exploitation_gap"]
    assert [(row["iteration"], row["copy"]) for row in gaps] == [
        (i, c) for i in (0, 220, 440) for c in (0, 1)
    ]
    assert {row["value"] for row in gaps} == {1.0}
    assert {row["metric"]: row["value"] for row in found if row["iteration"] == 440} == {
        "return_true": -3.0,
        "return_predicted": -2.0,
        "exploitation_gap": 1.0,
        "final_distance": 0.01,
        "success": 1.0,
        "seconds": 100.0,
        "samples": 50_000,
        "train_seconds": 100.0,
    }


def test_rows_become_curves_again_with_the_copies_of_one_seed_or_else_seeds_as_lines() -> None:
    assert curves_of(rows())["reach"][TSM]["return_true"].tolist() == [[0, -1, -2], [-1, -2, -3]]
    curves = curves_of([*rows(), *rows(seed=1), {"execution": "open loop", "iteration": 1}])[
        "reach"
    ][TSM]
    assert curves["return_true"].tolist() == [
        [-0.5, -1.5, -2.5],
        [-1.5, -2.5, -3.5],
    ]  # means over two copies each
    assert curves["iterations"].tolist() == [0, 220, 440]
    assert curves["steps"].tolist() == [0, 220_000, 440_000]  # 20 episodes of 50 steps each
    assert curves["seconds"].tolist() == [100, 150, 200]  # training of the model comes first
    assert curves["samples"].tolist() == [50_000] * 3
    figure7({"reach": {TSM: curves}})


def learned_as_one(seed: int) -> list[dict[str, Any]]:
    return rows(seed=seed, curve=header(seed)["curve"] | {"policies": 2})


def test_seconds_of_several_are_no_seconds_of_one() -> None:
    shared = tables.frame([*learned_as_one(0), *learned_as_one(1)])
    assert "seconds" not in set(shared["metric"])
    curves = curves_of([*learned_as_one(0), *learned_as_one(1)])
    assert "seconds" not in curves["reach"][TSM]
    figure7(curves)
    line = policies_results.policies_table(curves).splitlines()[-1]
    assert "nan" not in line
    untimed = policies_results.learning_rows(
        header(), samples=50_000, train_seconds=None
    )  # models trained as one
    assert "seconds" not in curves_of(untimed)["reach"][TSM]
    three = curves_of([*rows(), *learned_as_one(1), *untimed_of(2)])["reach"][TSM]
    assert three["seconds"].tolist() == [100, 150, 200]  # of seed 0, which alone has both
    assert three["seeds"] == 3
    untimed_tsm = {name: part for name, part in ended(-12, -4, -3).items() if name != "seconds"}
    compared = {TSM: untimed_tsm, PPO: ended(-13, -8, -2, prior=False)}
    found = policies_results.plateau_rows(compared, {}, steps=50)
    metrics = {
        "samples_to_90",
        "env_samples_to_90",
    }  # nor of PPO, whose seeds are to be those of TSM
    assert {(row["model"], row["metric"]) for row in found} == {
        (m, what) for m in ("tsm", "ppo") for what in metrics
    }


def untimed_of(seed: int) -> list[dict[str, Any]]:
    return policies_results.learning_rows(header(seed), samples=50_000, train_seconds=None)


def test_rows_survive_a_table(tmp_path: Path) -> None:
    path = tmp_path / "learning.csv"
    tables.save(path, rows())
    before, after = curves_of(rows()), policies_results.learning_curves(tables.load(path))
    for word, values in before["reach"][TSM].items():
        np.testing.assert_array_equal(after["reach"][TSM][word], values)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (
            [*rows(seed=1, records=2)],
            "seed 1, copy 0 was measured at 2 points up to 220, expected the 3 up to 440",
        ),
        ([*rows()], "return_true of seed 0 stands twice at 0"),
        ([*rows(fingerprint={"env": "tsm/PymunkReacher-v0"}, seed=1)], "give those of one of them"),
    ],
)
def test_rows_that_do_not_belong_together_are_refused(
    more: list[dict[str, Any]], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        curves_of([*rows(), *more])


def test_seeds_that_stopped_early_are_left_out_of_a_growing_table() -> None:
    growing = tables.frame(
        [*rows(), *rows(seed=1, records=2), *rows(seed=2, records=2, model="lstm")]
    )
    curves = policies_results.learning_curves(policies_results.finished(growing))["reach"]
    assert {method.model: len(own["return_true"]) for method, own in curves.items()} == {
        "tsm": 2,
        "lstm": 2,
    }
    assert policies_results.learning_curves(
        policies_results.finished(tables.frame(rows()))
    ).keys() == {"reach"}


def test_samples_to_reach_a_level_are_read_off_the_mean_curve() -> None:
    curves = {
        "return_true": np.array([[-10.0, -6.0, -4.0], [-10.0, -8.0, -4.0]]),
        "samples": np.array([0, 100, 200]),
    }
    assert policies_results.reached(curves, -10.0) == 0
    assert policies_results.reached(curves, -8.5) == 50
    assert policies_results.reached(curves, -5.5) == 150
    assert policies_results.reached(curves, -3.0) is None


def ended(*means: float, prior: bool = True) -> dict[str, np.ndarray]:
    """Curves of two copies, 1 m apart, around means at records 100 iterations or samples apart."""
    true = np.array(means)[None] + np.array([[-0.5], [0.5]])
    at = 100.0 * np.arange(len(means))
    return {
        "return_true": true,
        "samples": np.full(len(at), 5000.0) if prior else at,
        "seconds": 7 + at / 10,
    } | ({"iterations": at} if prior else {})


def test_a_common_plateau_is_what_policies_of_models_and_the_best_other_have_all_come_to() -> None:
    curves = {TSM: ended(-12, -4, -3), PPO: ended(-13, -8, -2, prior=False)}
    curves |= {zoo.method("trpo"): ended(-13, -13, -9, prior=False)}
    rows = policies_results.plateau_rows(
        curves, {"env": "tsm/Reacher-v0"}, steps=50
    )  # from -12 to -3: 90 % is -3.9
    found = {(row["model"], row["metric"]): row["value"] for row in rows}
    assert found["tsm", "samples_to_90"] == pytest.approx(50 * 110)
    assert found["tsm", "env_samples_to_90"] == 5000
    assert found["tsm", "seconds_to_90"] == pytest.approx(18)
    assert (
        found["ppo", "samples_to_90"]
        == found["ppo", "env_samples_to_90"]
        == pytest.approx(100 + 410 / 6)
    )
    assert found["trpo", "samples_to_90"] == 200  # never: all that it took
    assert not any("iteration" in row for row in rows)
    found = tables.frame(row | {"task": "reach", "seed": 0} for row in rows)
    assert len(policies_results.plateaus_table(found).splitlines()) == 5


def test_a_policy_that_was_there_by_its_first_record_has_no_number_of_samples() -> None:
    curves = {TSM: ended(-12, -3, -3), PPO: ended(-13, -8, -2, prior=False)}
    found = {
        (row["model"], row["metric"]) for row in policies_results.plateau_rows(curves, {}, steps=50)
    }
    assert ("tsm", "samples_to_90") not in found
    assert {
        ("tsm", "env_samples_to_90"),
        ("tsm", "seconds_to_90"),
        ("ppo", "samples_to_90"),
    } <= found


def test_early_records_count_in_place_of_those_of_the_whole_curve_as_far_as_they_go() -> None:
    own, coarse = ended(-12, -3, -3), {PPO: ended(-13, -8, -2, prior=False)}
    early = ended(-12, -6, -4, -3.5, -3.2) | {"iterations": np.array([0.0, 20, 40, 60, 110])}
    early["return_true"] = early["return_true"][:1]  # of fewer copies: means count
    found = policies_results.with_early(own, early)
    assert found["iterations"].tolist() == [0, 20, 40, 60, 110, 200]
    assert found["return_true"].tolist() == [[-12.5, -6.5, -4.5, -4, -3.7, -3]]
    options = {"steps": 50, "early": {TSM: early}}
    rows = policies_results.plateau_rows({TSM: own} | coarse, {}, **options)  # 90 % is -3.9
    told = {(row["model"], row["metric"]): row["value"] for row in rows}
    assert told["tsm", "samples_to_90"] == pytest.approx(50 * (60 + 50 / 3))
    without = policies_results.plateau_rows({TSM: own} | coarse, {}, steps=50)
    assert [
        row for row in rows if row["metric"] != "samples_to_90" or row["model"] == "ppo"
    ] == without
    early["return_true"] = early["return_true"] + 4  # there by the first of these, too
    assert policies_results.plateau_rows({TSM: own} | coarse, {}, **options) == without


def test_early_records_are_no_part_of_a_curve() -> None:
    early = [
        row | {"subset": "early", "iteration": 22}
        for row in rows()
        if row["metric"] == "return_true"
    ][:2]
    both = tables.frame([*rows(), *early])
    curve = policies_results.learning_curves(both)["reach"][TSM]
    np.testing.assert_array_equal(
        curve["return_true"], curves_of(rows())["reach"][TSM]["return_true"]
    )
    assert policies_results.learning_curves(both, "early")["reach"][TSM]["iterations"].tolist() == [
        22
    ]


def test_policies_that_gain_nothing_have_no_plateau() -> None:
    assert (
        policies_results.plateau_rows(
            {TSM: ended(-4, -4.5), PPO: ended(-9, -2, prior=False)}, {}, steps=50
        )
        == []
    )
    assert policies_results.plateau_rows({}, {}, steps=50) == []
    assert policies_results.plateaus_table(tables.frame([])) == ""


def test_what_belongs_to_no_point_of_a_curve_is_passed_over() -> None:
    more = [{**rows()[0], "metric": "samples_to_90", "iteration": None}]
    more += policies_results.learning_rows(
        header(), samples=50_000, train_seconds=100.0, within_data=[0.25, 0.75]
    )
    assert [
        (row["copy"], row["value"], row["iteration"])
        for row in more
        if row["metric"] == "within_data"
    ] == [
        (0, 0.25, 440),
        (1, 0.75, 440),
    ]
    more.append({column: value for column, value in more[0].items() if column != "iteration"})
    np.testing.assert_array_equal(
        curves_of(more)["reach"][TSM]["return_true"], curves_of(rows())["reach"][TSM]["return_true"]
    )


def test_the_table_has_one_line_per_policy_with_its_last_record() -> None:
    _, _, line = policies_results.policies_table(curves_of([*rows(), *rows(seed=2)])).splitlines()
    cells = [cell.strip() for cell in line.split("|")[1:-1]]
    assert cells[:3] == ["reach", "TSM, latent", "2 seeds"]  # not the two copies of each
    _, _, line = policies_results.policies_table(curves_of(rows())).splitlines()
    assert line.split("|")[3].strip() == "2 copies of 1 seed"
    assert cells[3].startswith("-3.500 ±")
    assert cells[-2:] == ["50,000", "200"]


def test_references_are_the_oracles_and_zero_torque() -> None:
    found = tables.load(ROOT / "data" / "results" / "05_control.csv")
    references = policies_results.references(table.select(found, execution="open loop"))
    assert set(references) == set(found["task"])
    for levels in references.values():
        assert max(levels.values()) > levels[zoo.method("none", planner="zero")]
        assert {method.model for method in levels} == {"oracle", "zero"}
    other = found.assign(env=found["env"].str.replace("tsm/", "tsm/Pymunk"))
    with pytest.raises(ValueError, match="of one of them"):
        policies_results.references(pd.concat([found, other]))
