"""Figure 7 shows what learned policies earned, what their models promised, and what both have cost."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from tsmlib.figures import style
from tsmlib.figures.policies import AXES, figure7
from tsmlib.statistics import interval
from tsmlib.study.results import policies as policies_results

LABELS = ("tsm codes", "tsm actions", "tsm+energy+direct codes", "onestep actions", "lstm actions")
FLOORS = {"reach": {"oracle codes cem": -4.2, "oracle actions cem": -4.1, "zero": -12.0}}


def learned(k: int = 3, end: float = -4.5, samples: float = 50_000) -> dict[str, np.ndarray]:
    """Curves from -12 to ``end`` over 11 records; the model promises 0.5 m more."""
    true = end + (-12 - end) * np.exp(-np.arange(11.0)) + 0.1 * np.random.default_rng(0).normal(size=(k, 11))
    return {"return_true": true, "return_predicted": true + 0.5, "iterations": 220.0 * np.arange(11),
            "samples": np.full(11, samples), "seconds": 400 + 100.0 * np.arange(11)}  # fmt: skip


def model_free(k: int = 3) -> dict[str, np.ndarray]:
    true = np.linspace(-12, -5, 26) + 0.1 * np.random.default_rng(1).normal(size=(k, 26))
    return {"return_true": true, "samples": np.linspace(0, 3e5, 26), "seconds": np.linspace(1e-5, 90, 26)}


def both_tasks() -> dict[str, dict[str, dict[str, np.ndarray]]]:
    own = {label: learned(end=-4.5 - i) for i, label in enumerate(LABELS)}
    return {"reach": {**own, "ppo": model_free(), "trpo": model_free()}, "push": dict(own)}


def lines(ax: Axes, label: str) -> list[Any]:
    return [line for line in ax.lines if to_hex(line.get_color()).lower() == style.colour(label).lower()]


def below(figure: Figure) -> str:
    return " ".join(ax.get_xlabel() for ax in figure.axes).replace("\n", " ")


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


EVERY: dict[str, Callable[[], Figure]] = {
    "two tasks": lambda: figure7(both_tasks(), FLOORS),
    "one task, iterations": lambda: figure7({"reach": {"tsm codes": learned()}}, against=["iterations"]),
    "one copy": lambda: figure7({"reach": {"tsm codes": learned(k=1)}}, FLOORS),
    "only model-free": lambda: figure7({"push": {"trpo": model_free()}}, against=["samples", "seconds"]),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", EVERY)
def test_figure_7_is_laid_out_without_warnings_and_not_left_open(name: str) -> None:
    figure = EVERY[name]()
    figure.draw_without_rendering()
    assert plt.get_fignums() == []
    assert min(text.get_fontsize() for text in figure.findobj(plt.Text) if text.get_text()) >= 6.5


def test_a_line_is_the_mean_and_its_band_the_interval_over_copies() -> None:
    given = learned()
    ax = figure7({"reach": {"lstm actions": given}}).axes[0]
    true, promised = lines(ax, "lstm")
    np.testing.assert_allclose(true.get_ydata(), given["return_true"].mean(0))
    np.testing.assert_array_equal(true.get_xdata(), given["iterations"])
    np.testing.assert_allclose(promised.get_ydata(), given["return_predicted"].mean(0))
    assert promised.is_dashed()
    assert not true.is_dashed()
    vertices = ax.collections[0].get_paths()[0].vertices
    mean, half = interval(given["return_true"][:, 4])
    assert sorted(set(np.round(vertices[vertices[:, 0] == given["iterations"][4], 1], 9))) == pytest.approx(
        [mean - half, mean + half]
    )


def test_tasks_stand_side_by_side_and_share_the_scale_of_their_column() -> None:
    figure = figure7(both_tasks(), FLOORS)
    reach, push = figure.axes[0], figure.axes[1]
    assert [reach.get_title(loc="left"), push.get_title(loc="left")] == ["Reach", "Push"]
    for column in (figure.axes[::2], figure.axes[1::2]):
        assert len({ax.get_ylim() for ax in column}) == 1
        assert [ax.get_xlabel().split("\n")[0] for ax in column] == list(AXES.values())


def test_a_model_s_data_set_is_a_point_and_a_model_free_run_a_line_against_samples() -> None:
    given = learned(samples=50_000)
    ax = figure7({"reach": {"tsm codes": given, "ppo": model_free()}}, against=["samples"]).axes[0]
    level, point = lines(ax, "tsm")[:2]
    assert point.get_xdata().tolist() == [50_000]
    assert point.get_ydata()[0] == pytest.approx(given["return_true"][:, -1].mean())
    assert level.get_xdata().tolist() == [50_000, 300_000]
    (curve,) = lines(ax, "ppo")
    assert len(curve.get_xdata()) == 26


def test_a_model_free_run_has_no_place_among_iterations_of_an_optimiser() -> None:
    figure = figure7({"reach": {"tsm codes": learned(), "ppo": model_free()}})
    assert [bool(lines(ax, "ppo")) for ax in figure.axes] == [False, True, True]
    assert {"PPO", "TSM, codes", "what the model promised", "95 % interval"} == set(legend(figure))


def test_seconds_are_logarithmic_and_leave_out_what_was_before_the_first() -> None:
    ax = figure7({"reach": {"tsm codes": learned(), "ppo": model_free()}}, against=["seconds"]).axes[0]
    assert ax.get_xscale() == "log"
    (curve,), (own,) = lines(ax, "ppo"), lines(ax, "tsm")
    assert len(curve.get_xdata()) == 25
    assert own.get_xdata()[0] == 400
    low, high = ax.get_xlim()
    assert low < 3.6 < 1400 < high


def test_a_policy_through_the_prior_is_filled_and_one_of_torques_open() -> None:
    ax = figure7({"reach": {"tsm codes": learned(), "tsm actions": learned(end=-6)}}, against=["iterations"]).axes[0]
    curves = [line for line in lines(ax, "tsm") if not line.is_dashed()]
    assert [to_hex(line.get_markerfacecolor()).upper() for line in curves] == [style.COLOURS["tsm"], "#FFFFFF"]


def test_references_are_lines_and_of_several_oracles_the_better_one() -> None:
    figure = figure7({"reach": {"tsm codes": learned()}}, FLOORS, against=["iterations"])
    flat = {line.get_ydata()[0] for line in figure.axes[0].lines if len(set(line.get_ydata())) == 1}
    assert flat == {-4.1, -12.0}
    assert {"oracle", "zero torque"} <= set(legend(figure))


def test_a_policy_that_fails_far_off_does_not_squeeze_the_others_and_is_told_in_words() -> None:
    rows = {label: learned() for label in LABELS} | {"multistep actions": learned(end=-900.0)}
    figure = figure7({"reach": rows}, against=["iterations"])
    assert figure.axes[0].get_ylim()[0] > -50
    assert "multi-step, actions to −900" in below(figure)


def wrong(**changed: Any) -> dict[str, Any]:
    return {"reach": {"tsm codes": learned() | changed}}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: figure7({}), "nothing to draw"),
        (lambda: figure7({"reach": {"alien codes": learned()}}), "starts with 'alien'"),
        (lambda: figure7(wrong(return_true=np.full((3, 11), np.nan))), "reach, tsm codes, return_true: 33 of 33"),
        (lambda: figure7(wrong(return_predicted=np.zeros((2, 11)))), r"expected \(3, 11\)"),
        (lambda: figure7(wrong(iterations=np.arange(10))), r"expected \(11\)"),
        (lambda: figure7(wrong(seconds=-np.arange(11))), "seconds go backwards"),
        (lambda: figure7(wrong(), against=["energy"]), "energy"),
        (lambda: figure7(wrong(), {"push": {"zero": -8.6}}), "push"),
        (lambda: figure7(wrong(), {"reach": {"none": -8.6}}), "starts with 'none'"),
    ],
)
def test_input_that_cannot_be_drawn_is_refused_in_words(call: Callable[[], Figure], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
    assert plt.get_fignums() == []


# Rows ----------------------------------------------------------------------------------------------------------------


def header(seed: int = 0, copies: int = 2, records: int = 3, **changed: Any) -> dict[str, Any]:
    """As ``study.learn`` gives it: record r of copy c earns -(r + c) - seed, and is promised 1 m more."""
    true = [[-float(r + c + seed) for c in range(copies)] for r in range(records)]
    return {
        "fingerprint": {"env": "tsm/Reacher-v0"}, "made_from": {"task": "reach"}, "model": "tsm", "prior": "codes",
        "seed": seed, "scale": "paper",
        "curve": {
            "iteration": [220 * r for r in range(records)], "seconds": [50.0 * r for r in range(records)],
            "measured": {
                "return_true": true, "return_predicted": [[value + 1 for value in row] for row in true],
                "final_distance": [[0.01] * copies] * records, "success": [[1.0] * copies] * records,
            },
        },
    } | changed  # fmt: skip


def rows(**options: Any) -> list[dict[str, Any]]:
    return policies_results.learning_rows(header(**options), samples=50_000, train_seconds=100.0)


def test_rows_hold_every_record_of_every_copy_and_the_cost() -> None:
    found = rows()
    gaps = [row for row in found if row["metric"] == "exploitation_gap"]
    assert [(row["horizon"], row["copy"]) for row in gaps] == [(i, c) for i in (0, 220, 440) for c in (0, 1)]
    assert {row["value"] for row in gaps} == {1.0}
    assert {row["metric"]: row["value"] for row in found if row["horizon"] == 440} == {
        "return_true": -3.0, "return_predicted": -2.0, "exploitation_gap": 1.0, "final_distance": 0.01, "success": 1.0,
        "seconds": 100.0, "samples": 50_000, "train_seconds": 100.0,
    }  # fmt: skip


def test_rows_become_curves_again_with_copies_and_seeds_as_lines() -> None:
    curves = policies_results.learning_curves([*rows(), *rows(seed=1), {"condition": "clean"}])["reach"]["tsm codes"]
    assert curves["return_true"].tolist() == [[0, -1, -2], [-1, -2, -3], [-1, -2, -3], [-2, -3, -4]]
    assert curves["iterations"].tolist() == [0, 220, 440]
    assert curves["seconds"].tolist() == [100, 150, 200]  # training of the model comes first
    assert curves["samples"].tolist() == [50_000] * 3
    figure7({"reach": {"tsm codes": curves}})


def test_rows_survive_a_table(tmp_path: Any) -> None:
    from tsmlib.storage import tables

    path = tmp_path / "learning.csv"
    tables.save_table(path, rows(), extra=policies_results.EXTRA)
    before, after = policies_results.learning_curves(rows()), policies_results.learning_curves(tables.load_table(path))
    for word, values in before["reach"]["tsm codes"].items():
        np.testing.assert_array_equal(after["reach"]["tsm codes"][word], values)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ([*rows(seed=1, records=2)], "seed 1, copy 0 was measured at 2 points up to 220, expected the 3 up to 440"),
        ([*rows()], "return_true of seed 0 stands twice at 0"),
        ([*rows(fingerprint={"env": "tsm/PymunkReacher-v0"}, seed=1)], "give those of one of them"),
    ],
)
def test_rows_that_do_not_belong_together_are_refused(more: list[dict[str, Any]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        policies_results.learning_curves([*rows(), *more])


def test_seeds_that_stopped_early_are_left_out_of_a_growing_table() -> None:
    growing = [*rows(), *rows(seed=1, records=2), *rows(seed=2, records=2, model="lstm")]
    curves = policies_results.learning_curves(policies_results.finished(growing))["reach"]
    assert {label: len(own["return_true"]) for label, own in curves.items()} == {"tsm codes": 2, "lstm codes": 2}
    assert policies_results.learning_curves(policies_results.finished(rows())).keys() == {"reach"}


def test_samples_to_reach_a_level_are_read_off_the_mean_curve() -> None:
    curves = {"return_true": np.array([[-10.0, -6.0, -4.0], [-10.0, -8.0, -4.0]]), "samples": np.array([0, 100, 200])}
    assert policies_results.reached(curves, -10.0) == 0
    assert policies_results.reached(curves, -8.5) == 50
    assert policies_results.reached(curves, -5.5) == 150
    assert policies_results.reached(curves, -3.0) is None


def ended(*means: float, prior: bool = True) -> dict[str, np.ndarray]:
    """Curves of two copies, 1 m apart, around means at records 100 iterations or samples apart."""
    true = np.array(means)[None] + np.array([[-0.5], [0.5]])
    at = 100.0 * np.arange(len(means))
    return {"return_true": true, "samples": np.full(len(at), 5000.0) if prior else at, "seconds": 7 + at / 10} | (
        {"iterations": at} if prior else {}
    )


def test_a_common_plateau_is_what_policies_of_models_and_the_best_other_have_all_come_to() -> None:
    curves = {"tsm codes": ended(-12, -4, -3), "ppo": ended(-13, -8, -2, prior=False)}
    curves |= {"trpo": ended(-13, -13, -9, prior=False)}
    rows = policies_results.plateau_rows(curves, steps=50, env="tsm/Reacher-v0")  # from -12 to -3: 90 % is -3.9
    found = {(row["model"], row["metric"]): row["value"] for row in rows}
    assert found["tsm", "samples_to_90"] == pytest.approx(50 * 110)
    assert found["tsm", "env_samples_to_90"] == 5000
    assert found["tsm", "seconds_to_90"] == pytest.approx(18)
    assert found["ppo", "samples_to_90"] == found["ppo", "env_samples_to_90"] == pytest.approx(100 + 410 / 6)
    assert found["trpo", "samples_to_90"] == 200  # never: all that it took
    assert {row["horizon"] for row in rows if "horizon" in row} == set()
    assert len(policies_results.plateaus([row | {"task": "reach"} for row in rows]).splitlines()) == 5


def test_policies_that_gain_nothing_have_no_plateau() -> None:
    assert (
        policies_results.plateau_rows({"tsm codes": ended(-4, -4.5), "ppo": ended(-9, -2, prior=False)}, steps=50) == []
    )
    assert policies_results.plateau_rows({}, steps=50) == []
    assert policies_results.plateaus([]) == ""


def test_what_belongs_to_no_point_of_a_curve_is_passed_over(tmp_path: Any) -> None:
    more = [{**rows()[0], "metric": "samples_to_90", "horizon": ""}]
    more += policies_results.learning_rows(header(), samples=50_000, train_seconds=100.0, within_data=[0.25, 0.75])
    assert [(row["copy"], row["value"], row["horizon"]) for row in more if row["metric"] == "within_data"] == [
        (0, 0.25, 440), (1, 0.75, 440),
    ]  # fmt: skip
    more.append({column: value for column, value in more[0].items() if column != "horizon"})  # not yet from a table
    curves = policies_results.learning_curves(more)["reach"]["tsm codes"]
    np.testing.assert_array_equal(
        curves["return_true"], policies_results.learning_curves(rows())["reach"]["tsm codes"]["return_true"]
    )


def test_the_report_has_one_line_per_policy_with_its_last_record() -> None:
    text = policies_results.report(policies_results.learning_curves([*rows(), *rows(seed=2)]))
    assert "| reach | TSM, codes | 4 | -3.500 ±" in text
    assert "| 50,000 | 200 |" in text
    assert len(text.splitlines()) == 3


def test_references_are_the_oracles_and_zero_torque() -> None:
    from tsmlib.storage import tables
    from tsmlib.study.runs import ROOT

    rows = tables.load_table(ROOT / "data" / "results" / "05_control.csv")
    found = policies_results.references(row for row in rows if row["sim"] == "mujoco")
    assert {"reach", "push"} <= set(found)
    for levels in (found["reach"], found["push"]):
        assert max(levels.values()) > levels["zero"]
        assert {label.split()[0] for label in levels} == {"oracle", "zero"}
    with pytest.raises(ValueError, match="of one of them"):
        policies_results.references([*rows, *(row | {"env": row["env"].replace("tsm/", "tsm/Pymunk")} for row in rows)])
