"""A reader's own rows stand beside the published ones, and what they are made with shows in tables and figures."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from tsmlib import plots as figures, study
from tsmlib.planning.tasks import Task
from tsmlib.storage import tables
from tsmlib.storage.files import StoreError
from reproduction import comparison
from reproduction.results import latent, planning, prediction, table
from reproduction.runs import Run

REACH, PUSH = "tsm/Reacher-v0", "tsm/ReacherPush-v1"


def plans(
    n: int = 8,
    *,
    env: str = REACH,
    model: str = "tsm",
    planner: str = "cem",
    level: float = -4.4,
    **run: Any,
):
    """Rows of a method's plans and of the oracle's, per target and over all of them."""
    method = dict(
        env=env,
        sim="mujoco",
        task="reach",
        execution=planning.OPEN,
        search_space="latent",
        unit="m",
        **run,
    )
    found, means = [], []
    for word, way, value in ((model, planner, level), ("oracle", "cem", -4.0)):
        common = method | dict(model=word, planner=way)
        returns = value + 0.001 * np.arange(n)
        means += [
            dict(common, metric="return_true", value=returns.mean(), n=n),
            dict(common, metric="cost_over_oracle", value=value / -4.0, n=n),
            dict(common, metric="relative_gap_median", value=0.02, n=n),
        ]
        for metric, more in (("return_true", 0.0), ("return_predicted", 0.3)):
            found += [
                dict(common, metric=metric, value=float(v) + more, n=1, target=i)
                for i, v in enumerate(returns)
            ]
    return means, found


@pytest.fixture
def published(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of published results: TSM at reaching, training seed 0, 100 targets."""
    monkeypatch.setattr(comparison, "RESULTS", tmp_path / "results")
    means, targets = plans(100, seed=0, scale="paper")
    tables.save(tmp_path / "results" / "05_control.csv", means)
    tables.save(tmp_path / "results" / "05_control_rows.csv", targets)
    return tmp_path


def run(folder: Path, scale: str = "laptop", seed: int = 7) -> Run:
    return Run("05_control", scale, seed, folder / "runs" / scale / f"seed{seed}")


def lines(markdown: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in markdown.splitlines()[2:]]


def diamonds(figure: Figure) -> list[tuple[float, float]]:
    """Where the hollow diamonds of a figure stand."""
    return [
        (float(x), float(y))
        for ax in figure.axes
        for line in ax.lines
        if line.get_marker() == "D"
        for x, y in zip(line.get_xdata(), line.get_ydata(), strict=True)
    ]


def shown(own: Run, **made: Any) -> tuple[str, list[tuple[float, float]], str]:
    """The table, the diamonds of figure 6 and the stamp of a run's plans."""
    means, targets = plans(**{"seed": own.seed, "scale": own.scale} | made)
    evidence, by_target = study.evidence(own, means), study.evidence(own, targets, "_rows")
    reach = study.draw_task(REACH, seed=3, n=2)
    first, second = table.pair(by_target, partial(planning.return_panels, tasks=[reach]))
    return (
        planning.plans_table(evidence),
        diamonds(figures.figure6(first, second)),
        table.stamp(evidence),
    )


@pytest.mark.parametrize("scale", ["smoke", "laptop"])
def test_a_table_has_the_published_line_and_yours_below_it(published: Path, scale: str) -> None:
    text, _, stamp = shown(run(published, scale))
    own = f"**yours, n = 8, seed 7, scale {scale}**"
    assert [line[:3] for line in lines(text)][:2] == [
        [f"`{REACH}`", "TSM, latent, CEM", "published, n = 100"],
        [f"`{REACH}`", "TSM, latent, CEM", own],
    ]
    assert stamp == f"published: scale paper, seed 0, n = 100; yours: scale {scale}, seed 7, n = 8"


@pytest.mark.parametrize(
    ("changed", "seed"),
    [
        ({"planner": "adam"}, 7),
        ({"model": "lstm"}, 7),
        ({"n": 9}, 7),
        ({"level": -5.0}, 7),
        ({}, 8),
    ],
    ids=["planner", "model", "targets", "plans", "seed"],
)
def test_another_planner_model_seed_or_set_of_targets_is_seen(
    published: Path, changed: Any, seed: int
) -> None:
    before, after = shown(run(published)), shown(run(published, seed=seed), **changed)
    assert [line for line in lines(before[0]) if "published" in line[2]] == [
        line for line in lines(after[0]) if "published" in line[2]
    ]
    assert before[0] != after[0]
    if changed:
        assert before[1] != after[1] or changed.keys() == {"planner"}
    if seed != 7 or "n" in changed:
        assert before[2] != after[2]


def test_figure_6_has_a_diamond_where_your_cost_and_your_gap_are(published: Path) -> None:
    _, points, _ = shown(run(published), level=-4.8)
    costs = -(-4.8 + 0.001 * np.arange(8)).mean() / -(-4.0 + 0.001 * np.arange(8)).mean()
    assert [x for x, _ in points] == pytest.approx([costs, 0.3])


def test_of_an_arm_that_nothing_is_published_of_yours_stand_alone_and_the_stamp_says_so(
    published: Path,
) -> None:
    means, _ = plans(env=PUSH, seed=7, scale="laptop")
    evidence = study.evidence(run(published), means)
    pushed = table.select(evidence, env=PUSH)
    assert {line[2] for line in lines(planning.plans_table(pushed))} == {
        "**yours, n = 8, seed 7, scale laptop**"
    }
    assert table.stamp(evidence).endswith("of ReacherPush nothing is published")


def test_at_scale_paper_figures_draw_the_run_alone_and_tables_both(published: Path) -> None:
    means, _ = plans(100, seed=0, scale="paper", level=-4.2)
    evidence = study.evidence(run(published, "paper", 0), means)
    assert set(table.drawn(evidence)["source"]) == {"yours"}
    assert table.own_rows(evidence).empty
    assert (
        table.stamp(evidence, figure=True)
        == "scale paper, seed 0, n = 100; no rows of recurrent TSM"
    )
    assert {line[2].split(",")[0] for line in lines(planning.plans_table(evidence))} == {
        "published",
        "**yours",
    }


def test_a_figure_that_will_be_published_does_not_say_that_nothing_is(published: Path) -> None:
    means, _ = plans(100, env=PUSH, seed=0, scale="paper")
    evidence = study.evidence(run(published, "paper", 0), means)
    assert (
        table.stamp(evidence, figure=True)
        == "scale paper, seed 0, n = 100; no rows of recurrent TSM"
    )


def test_what_is_written_says_nothing_of_sources(published: Path) -> None:
    own = run(published)
    means, _ = plans(seed=7, scale="laptop")
    evidence = study.save_evidence(own, means)
    assert "source" not in tables.load(own.metrics / "05_control.csv")
    with pytest.raises(StoreError, match="unknown columns \\['source'\\]"):
        tables.save(own.metrics / "05_control.csv", evidence)


def test_rows_without_a_source_make_the_table_that_they_always_made() -> None:
    means, _ = plans(seed=0, scale="paper")
    head = planning.plans_table(tables.frame(means)).splitlines()[0]
    assert [cell.strip() for cell in head.split("|")[1:4]] == ["environment", "method", "n"]


def test_sentences_are_of_the_rows_they_are_about(published: Path) -> None:
    means, _ = plans(seed=7, scale="laptop", level=-6.0)
    task: Task = study.draw_task(REACH, seed=3, n=2)
    text = planning.plans_told(study.evidence(run(published), means), [task])
    first, second = text.splitlines()
    assert first.startswith(
        "- Published: reach: plans through learned models cost 1.10 to 1.10 times the oracle's"
    )
    assert second.startswith(
        "- Yours: reach: plans through learned models cost 1.50 to 1.50 times the oracle's"
    )


def test_scores_of_yours_follow_the_published_ones_of_the_same_model() -> None:
    row = dict(env=REACH, execution="open loop", metric="nrmse")
    found = tables.frame(
        dict(row, model=model, source=source, seed=seed, scale=scale, n=n, value=seed + 1.0)
        for source, scale, n, seeds in (
            ("published", "paper", 1000, (0, 1)),
            ("yours", "laptop", 200, (7,)),
        )
        for model in ("tsm", "lstm")
        for seed in seeds
    )
    text = prediction.scores_table(found, prediction.named("nrmse"), env=REACH)
    own = "**yours, n = 200, seed 7, scale laptop**"
    assert [line[:2] for line in lines(text)] == [
        ["TSM", "published, n = 1,000"],
        ["TSM", own],
        ["LSTM", "published, n = 1,000"],
        ["LSTM", own],
    ]
    best = lines(prediction.best_table(found, {"nrmse": "error"}, [REACH]))
    assert [line[1].strip("*").split(",")[0] for line in best] == ["published", "yours"]


@pytest.fixture
def codes() -> pd.DataFrame:
    """Rows of 04_latent: published for two training seeds at reaching, yours for one at reaching and pushing."""
    found = []
    for source, scale, n, seeds in (
        ("published", "paper", 3000, (0, 1)),
        ("yours", "laptop", 600, (7,)),
    ):
        for env in (REACH, PUSH) if source == "yours" else (REACH,):
            row = dict(env=env, model="tsm", execution="segments", source=source, scale=scale, n=n)
            for seed in seeds:
                found += [
                    dict(row, seed=seed, metric=metric, value=0.01 * (1 + seed))
                    for metric in ("kl", "spread", "error_posterior", "error_prior", "error_zero")
                ]
                found += [
                    dict(row, seed=seed, metric=metric, value=seed + 0.1 * i, dimension=i)
                    for metric in ("kl_dimension", "importance")
                    for i in range(8)
                ]
            if env == PUSH:
                found.append(
                    dict(row, seed=7, metric="direction_told", value=0.5, subset="object moves")
                )
    return tables.frame(found)


def test_what_codes_say_stands_in_a_published_line_and_in_yours(codes: pd.DataFrame) -> None:
    published, own = "published, n = 3,000", "**yours, n = 600, seed 7, scale laptop**"
    errors = lines(latent.errors_table(codes, [REACH, PUSH], "tsm"))
    assert [line[:4] for line in errors] == [
        [f"`{REACH}`", "all segments", published, "0.015"],
        [f"`{REACH}`", "all segments", own, "0.080"],
        [f"`{PUSH}`", "all segments", own, "0.080"],
    ]
    thresholds = lines(latent.thresholds_table(codes, ["tsm"]))
    assert [line[0] for line in thresholds] == ["Reacher: KL (nats)"] * 2 + [
        "Reacher: spread of samples"
    ] * 2
    assert [line[-1] for line in thresholds] == ["0.015", "0.08"] * 2
    assert latent.directions_told(codes, REACH) == ""
    assert latent.directions_told(codes, PUSH).startswith(
        "- Yours: TSM: a linear function of the encoder's code explains 50%"
    )


def test_units_of_codes_are_those_of_one_training(codes: pd.DataFrame) -> None:
    one = latent.one_training(codes)
    assert set(zip(one["source"], one["seed"], strict=True)) == {("published", 0), ("yours", 7)}
    units = lines(latent.codes_table(one, REACH))
    assert [(line[1], line[2].strip("*").split(",")[0], line[3]) for line in units] == [
        ("KL", "published", "0.000"),
        ("KL", "yours", "7.000"),
        ("moves", "published", "0.000"),
        ("moves", "yours", "7.000"),
    ]


def test_panels_of_codes_are_those_of_either_source(codes: pd.DataFrame) -> None:
    first, second = table.pair(codes, partial(latent.use_panels, envs=[REACH, PUSH]))
    assert first["KL per segment"]["Reacher"][study.method("tsm")].tolist() == [0.01, 0.02]
    assert second["KL per segment"]["Reacher"][study.method("tsm")].tolist() == [0.08]


def test_a_panel_without_rows_is_left_out() -> None:
    row = dict(
        execution="open loop",
        model="tsm",
        metric="nrmse",
        value=1.0,
        seed=0,
        source="published",
        env=REACH,
    )
    found = tables.frame([row | {"steps_ahead": step} for step in (1, 90)])
    read = partial(prediction.horizon_panels, titles={"nrmse": "error"}, envs=[REACH, PUSH])
    first, second = table.pair(found, read)
    assert list(first) == ["Reacher: error"]
    assert second == {}


def test_a_stamp_stands_below_the_figure() -> None:
    task = {"reach": {study.method("tsm", "latent", "cem"): {"true": -np.arange(1.0, 4)}}}
    figure = figures.figure6(task)
    before = figure.get_figheight()
    figures.stamp(figure, "published: scale paper, seed 0")
    assert figure.legends[-1].get_texts()[0].get_text() == "published: scale paper, seed 0"
    assert figure.get_figheight() > before


def test_frames_of_no_rows_are_no_table(published: Path) -> None:
    assert planning.plans_table(study.evidence(run(published), pd.DataFrame()).iloc[:0]) == ""
