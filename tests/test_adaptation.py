"""Few-shot adaptation as the study measures it: rows, tables, sentences."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scripts import run_script

import tsmlib
from tsmlib import plots as figures
from tsmlib.planning.predictors import JUDGING
from tsmlib.statistics import interval
from tsmlib.storage import tables
from tsmlib import zoo
from reproduction.comparison import published
from reproduction.models import Trained, load_pretrained
from reproduction.results import adaptation as adaptation_results
from reproduction.results import table
from reproduction.results.exploration import PUSH
from reproduction.runs import ROOT, Run

RUN = Run("10_explore", "smoke", 0, ROOT / "runs" / "nowhere")
WEAK = tsmlib.envs.variant("tsm/Reacher-v0", torque_gain=0.7)


def test_every_way_of_a_model_has_a_budget_and_a_look() -> None:
    assert set(adaptation_results.WAYS) == {*adaptation.WAYS, adaptation.REFERENCE}
    assert adaptation.ways("rtsm") == adaptation.WAYS
    assert "codes" not in adaptation.ways("lstm")


def test_the_few_episodes_are_divided_and_never_those_of_the_scores() -> None:
    train, validation = adaptation.few(WEAK, 5)
    assert (len(train), len(validation)) == (4, 1)
    test, held_out = adaptation.held_out(WEAK, 4)
    starts = [data.states[:, 0] for data in (train, validation, test, held_out)]
    assert len(np.unique(np.concatenate(starts), axis=0)) == 4 + 1 + 4 + 2


@pytest.mark.parametrize(("env", "copies"), [(tsmlib.envs.variant(PUSH, mass=2.0), 8), (WEAK, 1)])
@pytest.mark.parametrize("way", ["head", "scratch"])
def test_an_adapted_model_of_pushing_is_trained_on_symmetric_copies(
    way: adaptation.Way, env: str, copies: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def trained(
        net: Any,
        loss: Any,
        train: tsmlib.Trajectories,
        validation: tsmlib.Trajectories,
        *_: Any,
        **__: Any,
    ):
        seen.append((train, validation))

    seen = list[tuple[tsmlib.Trajectories, tsmlib.Trajectories]]()
    monkeypatch.setattr(adaptation, "fit", trained)
    monkeypatch.setattr(adaptation, "fine_tune", trained)
    train, validation = adaptation.few(env, 5)
    adaptation.adapted("lstm", env, way, (train, validation))
    ((on, held_out),) = seen
    assert (len(on), held_out) == (copies * len(train), validation)
    np.testing.assert_array_equal(on.states[: len(train)], train.states)


def test_a_fine_tuned_model_of_the_standard_arm_predicts_the_weak_one_better_than_a_new_one() -> (
    None
):
    data, test = adaptation.few(WEAK, 5), adaptation.held_out(WEAK, 8)
    errors = {}
    for way in ("zero-shot", "all", "scratch"):
        net, _ = adaptation.adapted("lstm", WEAK, way, data, share=0.2)  # type: ignore[arg-type]
        scores = adaptation.scored(net, WEAK, test)
        errors[way] = float(scores.against_horizon()["nrmse"][:20].mean())
    assert errors["all"] < errors["zero-shot"] < errors["scratch"]


def test_every_variant_changes_the_pushing_arm_and_those_of_the_mass_no_reacher() -> None:
    arms = {word: adaptation.changed(PUSH, word) for word in adaptation.VARIANTS}
    assert {word: arm for word, arm in arms.items() if word != "standard"} == {
        word: f"tsm/ReacherPush-{word}-v1" for word in adaptation.VARIANTS if word != "standard"
    }
    with pytest.raises(
        ValueError, match="no variant is called 'heavier'; there are standard, mass0.5"
    ):
        adaptation.changed(PUSH, "heavier")


def test_seconds_of_models_trained_as_one_are_seconds_of_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    net = load_pretrained("lstm", env="tsm/Reacher-v0")
    metrics = []
    for header in ({"seconds": 9.0, "copies": 3}, {"seconds": 9.0}):
        monkeypatch.setattr(adaptation, "load_or_train", lambda *_, h=header: Trained(net, h))
        full = adaptation.made(RUN, "lstm", WEAK, way="reference", episodes=5)
        rows = tables.frame(adaptation.score_rows(RUN, "lstm", WEAK, "reference", full, n_test=4))
        metrics.append(set(rows["metric"]))
        (_, _, line) = str(adaptation_results.ways_table(rows)).splitlines()
        assert ("| - " in line) == ("copies" in header)
    assert metrics[1] - metrics[0] == {"train_seconds"}
    assert metrics[0] == set(adaptation_results.SCORES)


def test_the_sentence_says_what_each_way_leaves_of_the_zero_shot_score() -> None:
    common = dict(
        env=WEAK, model="rtsm", planner="none", execution="open loop", n=9, seed=0, scale="smoke"
    )
    rows = tables.frame(
        [
            common
            | dict(configuration=way, env_steps=steps, metric=metric, steps_ahead=80, value=value)
            for way, steps, value in (
                ("zero-shot", 0, 2.0),
                ("all", 2000, 0.5),
                ("reference", 50_000, 0.4),
            )
            for metric in adaptation_results.SCORES
        ]
    )
    told = adaptation_results.sentences(rows)
    assert "is left, with n episodes, by all weights 25% (20); trained in full 20% (500)" in told
    assert "of what training in full takes off it is taken off by all weights 94% (20)" in told
    (curves,) = adaptation_results.way_curves(rows, 80).values()
    assert [
        (way.model, *map(float, at), float(values[0, 0])) for way, (at, values) in curves.items()
    ] == [
        ("zero-shot", 0, 2.0),
        ("all", 20, 0.5),
        ("reference", 500, 0.4),
    ]
    (ax,) = figures.adapted({"model": curves}, "score", yours={"model": curves}).axes
    assert [label.get_text() for label in ax.get_xticklabels()] == ["0", "20", "500"]


def test_what_an_adapted_model_recovers_is_a_share_of_what_its_own_seed_lost() -> None:
    common = dict(
        env=WEAK,
        model="rtsm",
        planner="none",
        execution="open loop",
        n=9,
        scale="paper",
        metric="energy_score_noise",
        steps_ahead=80,
    )
    given = {
        "zero-shot": {0: (2.0, 4.0, 3.0)},
        "reference": {50_000: (1.0, 2.0)},
        "all": {500: (1.5, 3.5, 2.0), 2000: (1.0, 3.0, 2.0)},
        "scratch": {2000: (3.0, 4.0, 3.0)},
    }
    rows = tables.frame(
        [
            common | dict(configuration=way, env_steps=steps, seed=seed, value=value)
            for way, each in given.items()
            for steps, values in each.items()
            for seed, value in enumerate(values)
        ]
    )
    lines = adaptation_results.recovered_table(rows).splitlines()
    found = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    shares = {
        "all": {5: (0.5, 0.25), 20: (1.0, 0.5)},
        "scratch": {20: (-1.0, 0.0)},
    }  # of the seeds with a reference
    assert found == [
        [
            f"`{WEAK}`",
            "`rtsm`",
            adaptation_results.WAYS[way].name,
            *("{:.1%} ± {:.1%}".format(*interval(each[n])) if n in each else "" for n in (5, 20)),
            "2",
            "9",
        ]
        for way, each in shares.items()
    ]
    assert adaptation_results.recovered_table(rows[rows["configuration"] != "reference"]) == ""


def test_where_a_model_trained_in_full_is_no_better_nothing_is_recovered() -> None:
    common = dict(
        env=WEAK,
        model="rtsm",
        planner="none",
        execution="open loop",
        n=9,
        scale="paper",
        metric="energy_score_noise",
        steps_ahead=80,
    )
    scores = {
        "zero-shot": (0, (2.0, 1.0, 1.0)),
        "reference": (50_000, (1.0, 1.0, 3.0)),
        "all": (500, (1.5, 0.5, 0.5)),
    }
    rows = tables.frame(
        [
            common | dict(configuration=way, env_steps=steps, seed=seed, value=value)
            for way, (steps, values) in scores.items()
            for seed, value in enumerate(values)
        ]
    )
    assert adaptation_results.recovered(rows)["all"].to_dict() == {500: {0: 0.5}}
    assert "50.0%" in adaptation_results.recovered_table(rows)
    assert adaptation_results.recovered_table(rows[rows["seed"] > 0]) == ""


def test_a_way_of_training_has_no_look_of_a_model() -> None:
    models = [
        *(spec.look for spec in zoo.ZOO.values() if spec.group != "choice"),
        *zoo.LOOKS.values(),
    ]
    ways = adaptation_results.WAYS.values()
    assert len({look.marker for look in ways}) == len({look.colour for look in ways}) == len(ways)
    assert not {look.colour for look in ways} & {look.colour for look in models}
    trained = [zoo.look(word) for word in zoo.words("dynamics", "ablation")]
    assert not {look.marker for look in ways} & {look.marker for look in trained}


def test_the_page_has_the_published_rows_and_nothing_without_them() -> None:
    assert pages.exploration_page(tables.frame([])) == ""
    rows = published("10_explore")
    if len(rows):
        page = pages.exploration_page(rows, published("model_free"))
        assert page in (ROOT / "docs" / "results.md").read_text()


def test_plans_of_an_adapted_model_are_rows_beside_its_predictions() -> None:
    adapted = adaptation.Adapted(load_pretrained("rtsm", env="tsm/Reacher-v0"), 20, 1.0)
    task, about = tsmlib.load_task(WEAK).take(2), (RUN, "rtsm", WEAK, "all", adapted)
    plans, scores = (
        adaptation.plan_rows(*about, n_targets=2),
        adaptation.score_rows(*about, n_test=4),
    )
    trial = adaptation.planned(RUN, adapted.model, WEAK, 2)
    assert {
        (row["configuration"], row["env_steps"], row["n"], row["samples"]) for row in plans
    } == {("all", 2000, 2, JUDGING)}
    assert {row["metric"]: row["value"] for row in plans} == {
        "return_true": pytest.approx(float(trial.executed_return.mean())),
        "gap_absolute": pytest.approx(float(trial.gap.abs().mean())),
        "success": float((trial.final_distance <= task.tolerance).float().mean()),
    }
    both = tables.frame([*plans, *scores])
    assert (
        adaptation_results.plans_table(both)
        == adaptation_results.plans_table(tables.frame(plans))
        != ""
    )
    assert (
        adaptation_results.ways_table(both)
        == adaptation_results.ways_table(tables.frame(scores))
        != ""
    )


@pytest.mark.parametrize("targets", [0, 2])
def test_rows_of_adaptation_are_of_predictions_or_of_plans(
    targets: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runs, "RESULTS", tmp_path / "results")
    (tmp_path / "results").mkdir()
    script = runs.ROOT / "benchmarks" / "settings" / "rows.py"
    options = [
        "--models",
        "lstm",
        "--ways",
        "zero-shot",
        "--scale",
        "smoke",
        "--targets",
        str(targets),
    ]
    run_script(script, "adaptation", *options)
    rows = tables.load(tmp_path / "results" / "10_explore.csv")
    scored = {*adaptation_results.SCORES, "train_seconds"}
    assert set(rows["metric"]) == ({*adaptation_results.PLANS} if targets else scored)
    assert set(rows["planner"]) == ({"cem"} if targets else {"none"})


def test_returns_of_adapted_models_are_predicted_by_samples_that_neither_planner_nor_judges_drew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn = dict[str, int]()

    def watched(name: str, whole: Any) -> Any:
        def call(*given: Any, **named: Any) -> Any:
            drawn[name] = named["seed"]
            return whole(*given, **named)

        return call

    for name in ("cem", "expected_predictor", "fresh_predictor"):
        monkeypatch.setattr(adaptation, name, watched(name, getattr(adaptation, name)))
    env = "tsm/Reacher-v0"
    trial = adaptation.planned(replace(RUN, seed=3), load_pretrained("rtsm", env=env), env, 2)
    judges = range(
        JUDGING * drawn["expected_predictor"], JUDGING * (drawn["expected_predictor"] + 1)
    )
    assert len({drawn["fresh_predictor"], drawn["cem"], *judges}) == JUDGING + 2
    assert (trial.gap.abs() > 0).all()


def test_what_plans_gain_by_adapting_is_paired_by_seed_and_of_as_many_targets() -> None:
    common = dict(env=WEAK, model="lstm", planner="cem", execution="open loop", scale="paper")
    rows = tables.frame(
        common
        | dict(metric=metric, configuration=way, env_steps=steps, seed=seed, value=value, n=n)
        for way, steps, found in (
            ("all", 2000, [(1, -12.0, 50), (0, -8.0, 50), (2, -1.0, 20)]),
            ("zero-shot", 0, [(0, -10.0, 50), (1, -14.0, 50), (2, -90.0, 50), (3, -90.0, 50)]),
        )
        for seed, value, n in found
        for metric, value in (("return_true", value), ("success", 0.5), ("gap_absolute", 1.0))
    )
    lines = adaptation_results.plans_table(rows).splitlines()
    names, _, zero, tuned = (
        [cell.strip() for cell in line.strip("|").split("|")] for line in lines
    )
    assert dict(zip(names, zero, strict=True))["minus zero-shot"] == ""
    found = dict(zip(names, tuned, strict=True))
    assert found["minus zero-shot"] == "+2.00"  # of seeds 0 and 1
    assert (found["episodes"], found["seeds"], found["n"]) == ("20", "3", "50")
    known = published("10_explore")
    page = pages.exploration_page(pd.concat([known[known["env"] != WEAK], rows]))
    assert f"{adaptation.PLAN_ITERATIONS} iterations, over codes" in page
    assert "".join(lines[-1].split()) in "".join(
        page.split()
    )  # beside published rows columns are wider


def test_the_share_left_is_of_the_same_seed_and_of_adapted_models_alone() -> None:
    common = dict(
        env=WEAK,
        model="lstm",
        planner="none",
        execution="open loop",
        metric="energy_score_noise",
        steps_ahead=10,
        scale="paper",
        n=8,
    )
    rows = tables.frame(
        common | dict(configuration=way, env_steps=steps, seed=seed, value=value)
        for way, steps, values in (
            ("zero-shot", 0, [1.0, 2.0]),
            ("all", 2000, [0.5, 1.5]),
            ("all", 500, [9.0, 9.0]),
            ("head", 2000, [2.0]),
            ("scratch", 2000, [3.0, 3.0]),
        )
        for seed, value in enumerate(values)
    )
    ((title, robots),) = adaptation_results.shares_left(rows, 20).items()
    assert (title, list(robots)) == ("LSTM, 10 steps", ["reach, torque × 0.7"])
    assert {way.model: share.tolist() for way, share in robots["reach, torque × 0.7"].items()} == {
        "all": [0.5, 0.75],
        "head": [2.0],
    }


def test_the_notebook_says_which_arms_are_adapted_to_in_vain_80_steps_ahead() -> None:
    shares = adaptation_results.shares_left(published("10_explore"), 20)
    in_vain, of_use = (
        ("push, mass × 0.5", "push, mass × 2", "push, upper link × 1.2"),
        ("damping", "torque"),
    )
    means = {
        (title, name, way.model): share.mean()
        for title, robots in shares.items()
        if title.endswith("80 steps")
        for name, ways in robots.items()
        for way, share in ways.items()
    }
    ends = [
        (title, way.model, mean - half, mean + half)
        for title, robots in shares.items()
        if title.endswith("80 steps")
        for name in in_vain
        for way, share in robots[name].items()
        for mean, half in [interval(share)]
    ]
    assert len(ends) == 3 * (
        3 + 2 + 2
    )  # arms; ways of the segment model, of the LSTM and of the ensemble
    assert [title for title, _, low, _ in ends if low > 1] == ["LSTM, 80 steps"] * 2
    assert [(title, way) for title, way, _, high in ends if high < 1] == [
        ("ensemble (squared error), 80 steps", "head")
    ]
    worse = [mean for (_, name, _), mean in means.items() if name in in_vain and mean >= 1]
    assert len(worse) == 17  # docs/howto/fine_tune.md
    assert (
        round(float(means["ensemble (squared error), 80 steps", "push, mass × 2", "head"]), 2)
        == 0.75
    )
    helped = [
        mean
        for (_, name, way), mean in means.items()
        if way != "codes" and any(w in name for w in of_use)
    ]
    assert len(helped) == 4 * 3 * 2  # arms, models, ways
    assert max(helped) < 1
    ours = {
        (name, way): mean
        for (title, name, way), mean in means.items()
        if title == "recurrent TSM, 80 steps"
    }
    pushed = [
        name
        for name, way in ours
        if way == "all" and name.startswith("push") and any(w in name for w in of_use)
    ]
    assert len(pushed) == 3
    assert all(ours[name, "head"] < ours[name, "all"] for name in pushed)
    codes = sorted(ours[name, "codes"] for name in pushed)
    assert [f"{codes[0]:.0%}", f"{codes[-1]:.0%}"] == ["78%", "100%"]
    rows = table.select(
        published("10_explore"),
        model="rtsm",
        planner="none",
        metric="energy_score_noise",
        steps_ahead=80,
    )
    for env, seeds, said in (
        (WEAK, 3, ["95%", "29%"]),
        ("tsm/ReacherPush-gain0.7-v1", 1, ["91%", "21%"]),
    ):
        recovered = adaptation_results.recovered(table.select(rows, env=env))
        assert len(recovered) == seeds
        assert [f"{recovered.mean()[way, 2000]:.0%}" for way in ("all", "codes")] == said


def test_shares_left_are_drawn_with_a_mark_for_the_mean_and_a_dot_for_each_seed() -> None:
    ((_, robots),) = list(adaptation_results.shares_left(published("10_explore"), 20).items())[:1]
    (ax,) = figures.arms({"LSTM": robots}, "share", ratio=True).axes
    ways = next(iter(robots.values()))
    dots = [line.get_xdata().tolist() for line in ax.lines if line.get_marker() == "."]
    assert [share.tolist() for share in ways.values()] == dots[: len(ways)]
    assert [text.get_text() for text in ax.get_yticklabels()] == [*robots]


def test_shares_left_of_three_models_stand_in_two_rows() -> None:
    way = next(
        iter(
            adaptation_results.shares_left(published("10_explore"), 20)["LSTM, 10 steps"][
                "reach, torque × 0.7"
            ]
        )
    )
    figure = figures.arms(
        {str(title): {"arm": {way: np.array([0.5, 2.0])}} for title in range(6)},
        "share",
        ratio=True,
    )
    assert {ax.get_subplotspec().get_gridspec().get_geometry() for ax in figure.axes} == {(2, 3)}
    assert [ax.get_xlabel() for ax in figure.axes] == [""] * 3 + ["share"] * 3


def test_what_plans_gain_is_minus_zero_shot_of_the_same_seed() -> None:
    common = dict(
        env=WEAK, model="lstm", planner="cem", execution="open loop", metric="return_true", n=8
    )
    rows = tables.frame(
        common | dict(configuration=way, env_steps=steps, seed=seed, value=value)
        for way, steps, values in (
            ("zero-shot", 0, [-4.0, -6.0]),
            ("all", 2000, [-3.0, -3.0]),
            ("all", 500, [9.0, 9.0]),
            ("scratch", 2000, [-5.0]),
        )
        for seed, value in enumerate(values)
    )
    gains = adaptation_results.gains(rows, 20)["LSTM"]["reach, torque × 0.7"]
    assert {way.model: gained.tolist() for way, gained in gains.items()} == {
        "all": [1.0, 3.0],
        "scratch": [-1.0],
    }
    fewer = rows.assign(n=rows["n"].where(rows["configuration"] != "all", 4))  # other targets
    assert [
        way.model for way in adaptation_results.gains(fewer, 20)["LSTM"]["reach, torque × 0.7"]
    ] == ["scratch"]
    (ax,) = figures.arms({"LSTM": {"arm": gains}}, "gained", ratio=False).axes
    assert next(line.get_xdata() for line in ax.lines) == [0, 0]
    assert [line.get_xdata().tolist() for line in ax.lines if line.get_marker() == "."] == [
        [1.0, 3.0],
        [-1.0],
    ]
    assert ax.get_xscale() == "linear"


def test_errors_of_adapted_models_are_drawn_with_every_seed() -> None:
    way = next(
        iter(
            adaptation_results.shares_left(published("10_explore"), 20)["LSTM, 10 steps"][
                "reach, torque × 0.7"
            ]
        )
    )
    (ax,) = figures.adapted(
        {"LSTM": {way: (np.array([5.0, 20.0]), np.array([[1.0, 2.0], [3.0, 4.0]]))}}, "error"
    ).axes
    marks = [line.get_ydata().tolist() for line in ax.lines]
    assert sorted(marks) == [[1.0, 2.0], [2.0, 3.0], [3.0, 4.0]]


def test_the_notebook_says_of_plans_from_five_and_from_eighty_episodes_what_the_published_rows_say() -> (
    None
):
    rows = published("10_explore")
    weak = table.select(rows, planner="cem", metric="return_true", env="tsm/ReacherPush-gain0.7-v1")
    five, eighty = (
        {
            (word, way.model): gained
            for word, arms in adaptation_results.gains(weak, n).items()
            for ways in arms.values()
            for way, gained in ways.items()
        }
        for n in (5, 80)
    )
    assert len(five) == len(eighty) == 10
    assert {len(gained) for gained in (*five.values(), *eighty.values())} == {3}
    ours = ("recurrent TSM", "all")
    assert f"{five[ours].mean():.1f}" == "2.4"
    mean, half = interval(eighty[ours] - five[ours])
    assert [round(float(end), 1) + 0.0 for end in (mean, mean - half, mean + half)] == [
        0.0,
        -0.1,
        0.2,
    ]
    assert all(
        gained[word, "scratch"].mean() < 0 for gained in (five, eighty) for word, _ in gained
    )
    elsewhere = table.select(rows, planner="cem", metric="return_true", env_steps=[500, 8000])
    assert set(elsewhere["env"][elsewhere["env"].str.startswith("tsm/ReacherPush-")]) == {
        "tsm/ReacherPush-gain0.7-v1"
    }


def test_the_notebook_says_of_plans_on_changed_arms_what_the_published_rows_say() -> None:
    rows = published("10_explore")
    pushed = rows["env"].str.startswith("tsm/ReacherPush-") & (rows["env"] != PUSH)
    of_twenty = (
        (rows["planner"] == "cem")
        & (rows["metric"] == "return_true")
        & rows["env_steps"].isin([0, 2000])
    )
    plans = rows[pushed & of_twenty]
    wide = plans.pivot(index=["env", "model", "seed"], columns="configuration", values="value")
    gained = (wide["all"] - wide["zero-shot"]).groupby(level=["env", "model"])
    assert gained.count().tolist() == [3] * 6 * 3  # arms and models
    means = gained.mean().xs("rtsm", level="model")
    assert [round(float(end), 1) for end in (means.min(), means.max())] == [0.1, 2.5]
    assert means.idxmax().split("-")[1] == "damping2"
    found = {key: interval(part) for key, part in gained}
    off = {key for key, (mean, half) in found.items() if mean - half > 0}
    changed = {
        word: {env.split("-")[1] for env, model in off if model == word}
        for word in ("rtsm", "lstm", "ensemble+mse")
    }
    assert changed == {
        "rtsm": {"damping0.5", "damping2", "links0.12x0.11", "gain0.7"},
        "lstm": {"damping2"},
        "ensemble+mse": {"damping0.5", "gain0.7"},
    }
    assert min(mean + half for mean, half in found.values()) > 0  # nowhere less
    ways = adaptation_results.gains(rows, 20)
    ours = [
        {way.model: gained for way, gained in arm.items()}
        for name, arm in ways["recurrent TSM"].items()
        if name.startswith("push")
    ]
    assert len(ours) == 6
    for arm in ours:
        for difference in (arm["head"] - arm["all"], arm["codes"]):
            mean, half = interval(difference)
            assert abs(mean) < half  # not shown
    anew = [
        gained.mean()
        for arms in ways.values()
        for name, arm in arms.items()
        if name.startswith("push")
        for way, gained in arm.items()
        if way.model == "scratch"
    ]
    assert len(anew) == 6 * 3
    assert [round(float(end), 1) for end in (min(anew), max(anew))] == [-5.9, -2.2]
    reached = table.select(
        rows, planner="cem", metric="success", configuration="scratch", env_steps=2000
    )
    means = (
        reached[reached["env"].str.startswith("tsm/ReacherPush-")]
        .groupby(["env", "model"])["value"]
        .mean()
    )
    assert [f"{end:.0%}" for end in (means.min(), means.max())] == ["9%", "17%"]
