"""Few-shot adaptation and rounds of exploration as the study measures them: rows, panels, sentences, the benchmark."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scripts import run_script

import tsmlib
from tsmlib import figures
from tsmlib.storage import tables
from tsmlib.study import adaptation, publish, rounds, runs
from tsmlib.study.results import exploration as results
from tsmlib.study.runs import ROOT, Run

RUN = Run("10_explore", "smoke", 0, ROOT / "runs" / "nowhere")
WEAK = tsmlib.envs.variant("tsm/Reacher-v0", torque_gain=0.7)


def test_every_way_of_a_model_has_a_budget_and_a_look() -> None:
    assert set(results.WAYS) == {*adaptation.WAYS, adaptation.REFERENCE}
    assert adaptation.ways("rtsm") == adaptation.WAYS
    assert "codes" not in adaptation.ways("lstm")


def test_the_few_episodes_are_divided_and_never_those_of_the_scores() -> None:
    train, validation = adaptation.few(WEAK, 5)
    assert (len(train), len(validation)) == (4, 1)
    test, held_out = adaptation.held_out(WEAK, 4)
    starts = [data.states[:, 0] for data in (train, validation, test, held_out)]
    assert len(np.unique(np.concatenate(starts), axis=0)) == 4 + 1 + 4 + 2


def test_a_fine_tuned_model_of_the_standard_arm_predicts_the_weak_one_better_than_a_new_one() -> None:
    data, test = adaptation.few(WEAK, 5), adaptation.held_out(WEAK, 8)
    errors = {}
    for way in ("zero-shot", "all", "scratch"):
        net, _ = adaptation.adapted("lstm", WEAK, way, data, share=0.2)  # type: ignore[arg-type]
        scores = adaptation.scored(net, WEAK, test)
        errors[way] = float(scores.against_horizon()["nrmse"][:20].mean())
    assert errors["all"] < errors["zero-shot"] < errors["scratch"]


@pytest.mark.parametrize(("word", "lacks"), [("lstm", set()), ("ensemble+mse", {"highest"})])  # what a prior does
def test_rounds_leave_a_row_for_each_round_and_metric_and_a_curve(word: str, lacks: set[str]) -> None:
    sizes = rounds.Sizes(4, 1, 2, 2, 2, 4, 2, 1)
    rows = tables.frame(rounds.loop(RUN, word, sizes))
    assert set(rows["metric"]) == set(results.ROUNDS) - lacks
    assert rows["env_steps"].unique().tolist() == [400, 600]
    titles = ["executed return", "size of the gap"]
    panels = results.round_panels(rows, titles)
    ((at, values),) = panels["executed return"].values()
    assert at.tolist() == [400, 600]
    assert values.shape == (1, 2)
    figures.rounds(panels, "", yours=panels)
    assert "own plans, round 0 -> 1: executed return" in results.sentences(rows)


def test_the_sentence_says_what_each_way_leaves_of_the_zero_shot_score() -> None:
    common = dict(env=WEAK, model="rtsm", planner="none", execution="open loop", n=9, seed=0, scale="smoke")
    rows = tables.frame([
        common | dict(configuration=way, env_steps=steps, metric=metric, steps_ahead=80, value=value)
        for way, steps, value in (("zero-shot", 0, 2.0), ("all", 2000, 0.5), ("reference", 50_000, 0.4))
        for metric in results.SCORES
    ])  # fmt: skip
    assert "is left, with n episodes, by all weights 25% (20); trained in full 20% (500)" in results.sentences(rows)
    assert "of what training in full takes off it is taken off by all weights 94% (20)" in results.sentences(rows)
    (curves,) = results.way_curves(rows, 80).values()
    assert [(way.model, *map(float, at), float(values[0, 0])) for way, (at, values) in curves.items()] == [
        ("zero-shot", 0, 2.0), ("all", 20, 0.5), ("reference", 500, 0.4),
    ]  # fmt: skip
    (ax,) = figures.adapted({"model": curves}, "score", yours={"model": curves}).axes
    assert [label.get_text() for label in ax.get_xticklabels()] == ["0", "20", "500"]


def test_the_page_has_the_published_rows_and_nothing_without_them() -> None:
    assert publish.exploration_page(tables.frame([])) == ""
    published = ROOT / "data" / "results" / "10_explore.csv"
    if published.exists():
        assert publish.exploration_page(tables.load(published)) in (ROOT / "docs" / "results.md").read_text()


def test_the_benchmark_adds_lines_once_and_plans_when_they_are_asked_for(tmp_path: Path) -> None:
    script, out = runs.ROOT / "benchmarks" / "adaptation" / "run.py", tmp_path / "table.csv"
    options = ["--arm", "tsm/Reacher-v0", "--variants", "gain0.7", "--models", "lstm", "--ways", "zero-shot", "head",
               "--episodes", "5", "--test", "4", "--share", "0.01", "--out", str(out)]  # fmt: skip
    run_script(script, *options)
    first = pd.read_csv(out)
    assert first[["way", "episodes"]].to_numpy().tolist() == [["zero-shot", 0], ["head", 5]]
    assert "{" not in run_script(script, *options)  # nothing measured again
    run_script(script, *options, "--targets", "2")
    assert pd.read_csv(out)["cost"].notna().all()


def test_a_plane_shows_real_states_alone() -> None:
    data = rounds.random_episodes(2, seed=0)
    plane = rounds.plane(data)
    assert plane.shape == (2 * (rounds.HORIZON + 1), 2)
    np.testing.assert_allclose(np.cos(plane[:, 0]), data.states[..., 0].ravel(), atol=1e-5)
    with pytest.raises(ValueError, match="expected"):
        figures.visited({"one": plane[:, :1]}, ("", ""), {})
