"""Rounds of exploration as the study measures them: rows, panels, tables, sentences."""

from __future__ import annotations

import io
import json
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from scripts import load_script, run_script

import tsmlib
from tsmlib import plots as figures
from tsmlib.envs.unstable import SimulationUnstable
from tsmlib.exploration import Exploration
from tsmlib.planning import execution
from tsmlib.statistics import interval
from tsmlib.storage import manifest, tables
from reproduction import adaptation, drawings, pendulum, rounds, runs, worlds
from reproduction.comparison import published
from reproduction.results import adaptation as adaptation_results
from reproduction.results import exploration as results
from reproduction.results import table
from reproduction.results.exploration import PENDULUM, PUSH
from reproduction.runs import ROOT, Run

RUN = Run("10_explore", "smoke", 0, ROOT / "runs" / "nowhere")


@pytest.mark.parametrize(
    ("word", "lacks"), [("lstm", set()), ("ensemble+mse", {"highest"})]
)  # what a prior does
def test_rounds_leave_a_row_for_each_round_and_metric_and_a_curve(
    word: str, lacks: set[str]
) -> None:
    rows = tables.frame(rounds.loop(RUN, word).rows)
    assert set(rows["metric"]) == set(results.ROUNDS[PENDULUM]) - lacks
    assert rows["env_steps"].unique().tolist() == [400, 600]
    titles = ["executed return", "size of the first plan's gap"]
    panels = results.round_panels(rows, titles)
    ((at, values),) = panels["executed return"].values()
    assert at.tolist() == [400, 600]
    assert values.shape == (1, 2)
    figures.rounds(panels, "", yours=panels)
    assert "own plans, round 0 -> 1: executed return" in results.sentences(rows)
    assert results.rounds_table(rows) == results.rounds_table(rows.iloc[::-1]), (
        "a line's place is that of its round"
    )


def test_a_pendulum_that_measures_starts_as_none_that_is_learned_from() -> None:
    measured = pendulum.swing_up(8, seed=pendulum.TESTED).start
    for seed in range(10):
        learned = pendulum.first_episodes(6, seed).states[:, 0]
        assert np.abs(learned[:, None] - measured[None]).max(-1).min() > 1e-3


def test_an_arm_pushes_by_rounds_of_its_own_plans_and_of_others(tmp_path: Path) -> None:
    sizes = worlds.WORLDS[PUSH].sizes["smoke"]
    found = [
        rounds.loop(RUN, "lstm", env=PUSH, data=data, folder=tmp_path) for data in results.DATA
    ]
    everything = tables.frame([row for part in found for row in part.rows])
    rows = table.select(everything, execution="closed loop")
    assert set(rows["metric"]) == set(results.ROUNDS[PUSH])
    assert set(rows["sim"]) == {"mujoco"}
    first, last = 100 * sizes.first, 100 * (sizes.first + sizes.episodes)
    for data, steps in zip(
        results.DATA, ([first, last], [first, last], [first, first]), strict=True
    ):
        assert (
            table.select(rows, configuration=data, metric="success")["env_steps"].tolist() == steps
        )
    before = table.select(rows, iteration=0, metric="return_true")["value"]
    assert len(before) == 3
    assert before.nunique() == 1  # all begin with one learner
    panels = results.round_panels(rows, ["share within 5 cm"], PUSH)["share within 5 cm"]
    assert [method.variant for method in panels] == [
        results.PLANNED,
        results.RANDOM,
    ]  # those that take steps
    assert results.round_panels(rows, ["share within 5 cm"]) == {}  # of the pendulum, nothing
    assert "share within 5 cm" in results.rounds_table(rows, PUSH)
    assert (
        f"`{PUSH}`, `lstm` on {results.NONE}, round 0 -> 1: executed return"
        in results.sentences(rows)
    )
    _check_episodes(everything, found, [first, last])
    _check_priors(everything)


def _check_episodes(rows: pd.DataFrame, loops: list[rounds.Loop], steps: list[int]) -> None:
    """Contacts are counted in the episodes of each round, and none where none were collected."""
    contacts = table.select(rows, metric="contacts_per_episode")
    for data, at, loop in zip(results.DATA, (steps, steps, steps[:1]), loops, strict=True):
        own = table.select(contacts, configuration=data)
        assert own["env_steps"].tolist() == at
        assert own["value"].tolist() == [
            rounds.of_pushes(each)["contacts_per_episode"] for each in loop.episodes if each
        ]
        assert own["n"].tolist() == [len(each) for each in loop.episodes if each]
    assert "contacts per episode" in results.rounds_table(rows, PUSH)
    assert "contacts per episode" not in results.rounds_table(
        table.select(rows, execution="closed loop"), PUSH
    )


def _check_priors(rows: pd.DataFrame) -> None:
    """Both priors are searched as long, and the search of the first comes to its own return."""
    curves = table.select(rows, execution="open loop", metric="return_true")
    assert curves.groupby(["configuration", "subset"])["iteration"].max().tolist() == [2] * 6
    first = table.select(curves, subset=results.FIRST_PRIOR)
    assert first.groupby("iteration")["value"].nunique().tolist() == [1, 1, 1]  # of one prior
    needed = table.select(rows, metric="iterations_to_same_return", subset=results.FIRST_PRIOR)
    assert len(needed) == 3
    assert needed["value"].max() <= 2
    assert adaptation_results.ways_table(rows) == ""  # which are open loop as well
    assert "iterations of the last prior" in results.priors_table(rows)


def test_a_prior_that_is_better_from_the_start_needs_no_iteration_and_a_worse_one_never_gets_there() -> (
    None
):
    better = {results.FIRST_PRIOR: [-9, -5, -5], results.LAST_PRIOR: [-4, -3, -2]}
    worse = {results.FIRST_PRIOR: [-9, -6, -5], results.LAST_PRIOR: [-9, -8, -7]}
    for curves, needed, said in ((better, [1, 0], "0.0"), (worse, [2], "> 2")):
        about = dict(
            env_steps=900,
            env=PUSH,
            data=results.PLANNED,
            torques=dict(zip(curves, (0.1, 0.07), strict=True)),
        )
        rows = tables.frame(results.prior_rows(RUN, "rtsm", curves, 25, **about))  # type: ignore[arg-type]
        assert table.select(rows, metric="iterations_to_same_return")["value"].tolist() == needed
        cells = [
            cell.strip()
            for cell in results.priors_table(rows).splitlines()[-1].strip("|").split("|")
        ]
        assert cells[4:] == [f"{needed[0]:.1f}", said, "0.1000", "0.0700", "25"]


def test_the_map_has_as_many_episodes_of_each_source() -> None:
    seen = {"few": worlds.world(PUSH).random(2, 0), "many": worlds.world(PUSH).random(5, 1)}
    found = rounds.places(seen)
    assert [*found] == ["fingertip: few", "fingertip: many", "object: few", "object: many"]
    assert {points.shape for points in found.values()} == {(2 * (rounds.HORIZON + 1), 2)}
    np.testing.assert_array_equal(found["object: few"], seen["few"].states[..., 6:8].reshape(-1, 2))
    assert {ax.get_aspect() for ax in figures.visited(found, ("x", "y"), {}, equal=True).axes} == {
        1.0
    }


def test_contacts_beside_the_map_are_of_all_episodes_and_points_of_the_first() -> None:
    first, last = worlds.world(PUSH).random(5, 0), worlds.world(PUSH).random(3, 1)
    figure, n = drawings.places(first, last, n=2)
    assert n == 2
    titles = [ax.get_title(loc="left") or ax.get_title() for ax in figure.axes]
    found = rounds.of_pushes(first)["contact_share"]
    assert titles[2] == f"object: random\ncontact in {found:.0%}\nof 5 episodes"
    assert len(figure.axes[2].lines[0].get_xdata()) == 2 * (rounds.HORIZON + 1)


def test_states_of_random_episodes_of_both_priors_and_of_own_plans_are_drawn_beside_each_other() -> (
    None
):
    random, own = (pendulum.first_episodes(n, seed=n) for n in (3, 2))
    first, last = (tsmlib.ActionPrior.for_data(random, seed=seed, channels=4) for seed in (0, 1))
    figure, n = drawings.visited(random, own, first, last, n=4)
    assert n == 4
    drawn = [ax.lines[0].get_xydata() for ax in figure.axes]
    sources = (random, pendulum.walks(first, 4), pendulum.walks(last, 4), own)
    for points, data in zip(drawn, sources, strict=True):
        np.testing.assert_array_equal(points, pendulum.plane(data))
    assert f"2 episodes, highest {pendulum.highest(own):.2f}" in (
        figure.axes[3].get_title(loc="left") or ""
    )


def test_a_killed_loop_of_the_study_goes_on_with_the_same_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = rounds.loop(RUN, "rtsm", env=PUSH).rows

    def killed(*given: object, **named: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(rounds, "explore", killed)
        with pytest.raises(KeyboardInterrupt):
            rounds.loop(RUN, "rtsm", env=PUSH, folder=tmp_path)
    assert rounds.loop(RUN, "rtsm", env=PUSH, folder=tmp_path).rows == whole
    for name in ("measure", "search"):  # without any work
        monkeypatch.setattr(rounds, name, lambda *given: killed)
    assert rounds.loop(RUN, "rtsm", env=PUSH, folder=tmp_path).rows == whole


def test_plans_that_measure_are_those_of_mpc_and_begin_as_their_first_plan_does() -> None:
    few, model, prior = untrained()
    for judging in (0, 8):
        sizes = replace(worlds.world(PENDULUM).sizes["smoke"], judging=judging, every=50)
        judge = tsmlib.expected_predictor if judging else tsmlib.model_predictor
        found = rounds.planned(few, model, prior, sizes, 0).found
        again = tsmlib.mpc(
            few,
            model,
            rounds.space_of(prior),
            rounds.planner(sizes, 0),
            every=50,
            judge=judge,
            seed=1000,
        )
        assert found is not None
        assert found.first.found is not None
        assert torch.equal(found.closed.actions, again.actions)
        assert torch.equal(found.closed.gap, again.gap)
        assert torch.equal(found.first.found.actions[:, :50], again.actions[:, :50])


def test_rounds_that_were_measured_by_other_names_have_no_rows() -> None:
    record = {"round": 1.0, "env_steps": 8.0, "tested_success": 0.5, "success": 0.25}
    found = Exploration(
        *[pendulum.first_episodes(3, 0)] * 2, [record], seconds=[{"cpu_seconds": 2.0}]
    )
    assert rounds.tested_records(found) == [
        {"round": 1, "env_steps": 8, "success": 0.5, "cpu_seconds": 2}
    ]
    del record["tested_success"]
    with pytest.raises(
        ValueError, match=r"round 1 has round, env_steps, success, and nothing named tested_"
    ):
        rounds.tested_records(found)


@pytest.mark.parametrize("judging", [0, 1, 8])
def test_planner_judges_and_predicted_returns_draw_different_random_numbers(
    judging: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged, fresh = set[int](), set[int]()
    judge, predictor = rounds.expected_predictor, execution.fresh_predictor

    def judges(*given: Any, samples: int, seed: int) -> Any:
        judged.update(range(samples * seed, samples * (seed + 1)))
        return judge(*given, samples=samples, seed=seed)

    def predicts(*given: Any, seed: int) -> Any:
        fresh.add(seed)
        return predictor(*given, seed=seed)

    monkeypatch.setattr(rounds, "expected_predictor", judges)
    monkeypatch.setattr(execution, "fresh_predictor", predicts)
    few, model, prior = untrained()
    for seed in range(3):
        sizes = replace(worlds.world(PENDULUM).sizes["smoke"], judging=judging, every=25)
        searched = rounds.planner(sizes, seed).keywords["seed"]  # type: ignore[attr-defined]
        judged.clear(), fresh.clear()
        rounds.planned(few.take(1), model, prior, sizes, seed)
        assert (len(judged), len(fresh)) == (4 * judging, 4)
        assert not fresh & (judged | {searched})
        assert searched not in judged


def untrained() -> tuple[tsmlib.Task, tsmlib.RecurrentTSM, tsmlib.ActionPrior]:
    """Three starts of the pendulum, and a model and a prior that were never trained."""
    data = pendulum.first_episodes(3, 0)
    model = tsmlib.RecurrentTSM.for_data(data, hidden=8)
    return (
        pendulum.swing_up(3, seed=pendulum.TESTED),
        model,
        tsmlib.ActionPrior.for_data(data, channels=4),
    )


def unstable(bad: np.ndarray, run: Any) -> Any:
    """A stub of ``execute`` or ``mpc`` in which the episodes that start in ``bad`` (n, dx) become unstable."""

    def stub(task: tsmlib.Task, *given: Any, **named: Any) -> tsmlib.Trial:
        for i, start in enumerate(task.start):
            if (start == bad).all(1).any():
                raise SimulationUnstable(task.env, i, 3, "velocity")
        return run(task, *given, **named)

    return stub


def measured_everywhere(monkeypatch: pytest.MonkeyPatch) -> tuple[tsmlib.Task, worlds.Sizes]:
    """A task of three starts in which every episode that ends is a success, and sizes of a loop that measures there."""
    sizes = replace(worlds.world(PENDULUM).sizes["smoke"], starts=3, every=50)
    every = replace(untrained()[0], success=lambda x: x[:, -1, 0] < 2)
    here = replace(worlds.WORLDS[PENDULUM], tested=every.take)
    monkeypatch.setattr(rounds, "world", lambda env: here)
    return every, sizes


def test_an_unstable_episode_that_measures_has_failed_and_is_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    task, model, prior = untrained()
    every, sizes = measured_everywhere(monkeypatch)
    monkeypatch.setattr(rounds, "mpc", unstable(task.start[:1], rounds.mpc))
    found = rounds.measure(sizes, 0)(model, prior)
    others = rounds.planned(every.take([1, 2]), model, prior, sizes, 0).found
    assert others is not None
    assert (found["lost"], found["success"]) == (1, pytest.approx(2 / 3))
    assert found["return_true"] == float(others.closed.executed_return.mean())
    assert found["gap_absolute"] == float(others.closed.gap.abs().mean())
    monkeypatch.setattr(rounds, "mpc", unstable(task.start, rounds.mpc))
    none = rounds.measure(sizes, 0)(model, prior)
    assert {name: none[name] for name in ("lost", "success")} == {"lost": 3, "success": 0}
    assert "return_true" not in none
    rows = results.round_rows(RUN, "rtsm", [{"round": 0, "env_steps": 0, **none}], 3, first=400)
    assert {row["metric"]: row["value"] for row in rows}["lost"] == 3
    assert "unstable episodes" in results.rounds_table(tables.frame(rows))


def test_a_first_plan_that_is_unstable_open_loop_takes_no_success_from_its_closed_loop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    task, model, prior = untrained()
    every, sizes = measured_everywhere(monkeypatch)
    whole = rounds.measure(sizes, 0)(model, prior)
    gaps = rounds.planned(every, model, prior, sizes, 0).found
    assert gaps is not None
    assert gaps.first.found is not None
    assert gaps.closed.plan is not None
    apart = (gaps.closed.plan.predicted_return - gaps.first.found.executed_return).abs()
    assert whole["gap_open_loop"] == pytest.approx(float(apart.mean()))
    monkeypatch.setattr(rounds, "execute", unstable(task.start[:1], rounds.execute))
    found = rounds.measure(sizes, 0)(model, prior)
    assert found.pop("gap_open_loop") == pytest.approx(float(apart[1:].mean()))
    assert found == {name: value for name, value in whole.items() if name != "gap_open_loop"}
    monkeypatch.setattr(rounds, "execute", unstable(task.start, rounds.execute))
    assert rounds.measure(sizes, 0)(model, prior) == found


def test_a_measurement_that_lost_all_its_episodes_has_no_row_of_another_distance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rounds, "mpc", unstable(worlds.world(PUSH).tested(2).start, rounds.mpc))
    for _ in range(2):  # the second time from the folder
        rows = tables.frame(rounds.loop(RUN, "lstm", env=PUSH, folder=tmp_path).rows)
        closed = table.select(rows, execution="closed loop")
        assert set(closed["metric"]) == {"lost", "success"}
        assert table.select(closed, metric="lost")["value"].tolist() == [2, 2]
        assert table.select(closed, metric="success")["value"].tolist() == [0, 0]


def test_rows_say_what_a_round_took_and_by_what_its_candidates_were_judged() -> None:
    sizes = replace(worlds.world(PENDULUM).sizes["smoke"], every=50)
    found = rounds.loop(RUN, "rtsm", sizes=sizes)
    assert {row["samples"] for row in found.rows} == {8}
    assert [(row["metric"], row["iteration"]) for row in found.seconds] == [
        ("cpu_seconds", 1),
        ("wall_seconds", 1),
    ]
    assert all(float(str(row["value"])) > 0 for row in found.seconds)
    header = results.rounds_table(tables.frame([*found.rows, *found.seconds])).splitlines()[0]
    assert all(
        title in header for title in ("judge", "CPU s", "wall s", "the first plan's gap open loop")
    )
    by_rollout = rounds.loop(RUN, "lstm", sizes=sizes).rows  # which has no samples
    assert not any("samples" in row for row in by_rollout)
    assert "judge" not in results.rounds_table(tables.frame(by_rollout))


def test_a_table_of_rounds_says_of_every_learner_what_judged_its_plans() -> None:
    record = {"round": 0, "env_steps": 0, "return_true": 1.0}
    rows = results.round_rows(RUN, "rtsm", [record], 3, first=0, samples=8)
    rows += results.round_rows(RUN, "rtsm", [record | {"round": 1}], 3, first=0)  # by the mode
    for word in ("lstm", "ensemble+mse", "pets"):
        rows += results.round_rows(RUN, word, [record], 3, first=0)
    lines = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in results.rounds_table(tables.frame(rows)).splitlines()
    ]
    where = lines[0].index("judge")
    assert [(line[0], line[where]) for line in lines[2:]] == [
        ("`rtsm`", "mode, 8 samples"),
        ("`rtsm`", "mode"),
        ("`lstm`", "its rollout"),
        ("`ensemble+mse`", "members"),
        ("`pets`", ""),
    ]


def test_a_file_of_a_loop_by_the_mode_is_not_taken_for_one_by_an_expectation(
    tmp_path: Path,
) -> None:
    path, sizes = tmp_path / "round-0.json", asdict(worlds.world(PENDULUM).sizes["smoke"])
    old = {name: value for name, value in sizes.items() if name not in ("judging", "screened")}
    path.write_text(json.dumps({"made from": {"sizes": old, "seed": 0}, "found": 1.0}))
    mode = {"sizes": sizes | {"judging": 0, "screened": 1.0}, "seed": 0}
    assert rounds._once(path, mode, lambda: 2.0) == 1.0
    assert rounds._once(path, {"sizes": sizes, "seed": 0}, lambda: 3.0) == 3.0


def test_every_measure_of_rounds_that_is_drawn_has_a_unit() -> None:
    for env, drawn in results.DRAWN.items():
        assert set(drawn) <= set(results.ROUNDS[env].values()) & set(results.UNITS[env])


def test_the_training_of_the_pendulum_is_chosen_on_starts_that_no_published_row_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path))
    script, place, seen = (
        ROOT / "benchmarks" / "exploration" / "pendulum.py",
        tmp_path / "pendulum.csv",
        [],
    )
    row = dict(seed=10, iteration=0, env_steps=600)

    def measured(run: Run, word: str, *, sizes: worlds.Sizes) -> rounds.Loop:
        seen.append((run.seed, worlds.world(PENDULUM).tested(8).start))
        return rounds.Loop(
            [row | {"metric": m, "value": 1} for m in ("return_true", "success", "gap_absolute")],
            [],
        )

    monkeypatch.setattr(rounds, "loop", measured)
    published = worlds.world(PENDULUM).tested(8).start
    for updates in (2, 4, 2):  # the third takes the place of the first
        run_script(script, "rtsm", "--updates", str(updates), "--out", str(place))
    assert pd.read_csv(place)["updates"].tolist() == [4, 2]
    assert all(
        seed > 9 and not (starts[:, None] == published).all(-1).any() for seed, starts in seen
    )


def test_the_notebook_says_of_noise_and_disagreement_what_their_table_says() -> None:
    rows = pd.read_csv(ROOT / "benchmarks" / "exploration" / "table.csv")
    wide = rows[rows["round"] == 5].pivot(index="seed", columns="way", values="within_3cm")
    assert wide.index.tolist() == [0, 1, 2]
    found = {
        way: interval(100 * (wide["planned"] - wide[way])) for way in ("random", "bonus", "noise")
    }
    ends = {
        way: [round(float(end)) for end in (mean, mean - half, mean + half)]
        for way, (mean, half) in found.items()
    }
    assert ends == {"random": [21, 10, 31], "bonus": [11, 4, 19], "noise": [-4, -21, 13]}


@pytest.mark.parametrize("way", ["planned", "random"])
def test_a_loop_on_the_plain_arm_has_a_line_of_every_round(
    way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = load_script(ROOT / "benchmarks" / "exploration" / "run.py", "exploration_run")
    for name, size in (("FIRST", 10), ("ROUNDS", 1), ("EPISODES", 3), ("TARGETS", 2)):
        monkeypatch.setattr(module, name, size)
    monkeypatch.setattr(module, "SEARCH", dict(candidates=4, elites=2, iterations=1, screened=0.25))
    monkeypatch.setattr(
        module, "training", lambda past, future, _: tsmlib.TrainingOptions(past, future, 1)
    )
    lines = module.rounds(way, 0)
    assert [(line["round"], line["env_steps"]) for line in lines] == [(0, 500), (1, 650)]
    found = pd.read_csv(io.StringIO(pd.DataFrame(lines).to_csv()))
    assert np.isfinite(found[["cost", "within_3cm", "absolute_gap"]]).all(axis=None)
    assert "3 cm" in module.summary(found)


def test_rates_of_rounds_are_chosen_on_episodes_that_no_training_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script, place, judged = (
        ROOT / "benchmarks" / "exploration" / "rates.py",
        tmp_path / "rates.csv",
        [],
    )
    here = worlds.world(PUSH)
    monkeypatch.setitem(worlds.WORLDS, PUSH, replace(here, sizes={"paper": here.sizes["smoke"]}))

    def scored(
        model: tsmlib.DynamicsModel, env: str, data: tuple[tsmlib.Trajectories, tsmlib.Trajectories]
    ) -> Any:
        judged.append(data[0].states[:, 0])
        return SimpleNamespace(against_horizon=lambda: {"energy_score_noise": np.ones(80)})

    monkeypatch.setattr(adaptation, "scored", scored)
    for _ in range(2):  # the second time without any work
        run_script(script, "--models", "ensemble+mse", "--out", str(place))
    found = pd.read_csv(place)
    assert found["rate"].tolist() == [0.0] * 3 + [0.01] * 3 + [0.02] * 3
    assert found["stage"].tolist() == ["before the first round", results.NONE, results.RANDOM] * 3
    assert np.isfinite(found["loss"]).all()
    assert len(judged) == 9
    seen = np.concatenate(
        [here.first(200, 10).states[:, 0], here.random(150, 1_101_000).states[:, 0]]
    )
    assert not (judged[0][:, None] == seen).all(-1).any()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            ("rtsm", {"env": "tsm/Reacher-v0"}),
            "no rounds are measured on 'tsm/Reacher-v0'; there are Pendulum-v1, tsm/Re",
        ),
        (("tsm", {}), "'tsm' does not explore Pendulum-v1; there are rtsm, lstm, ensemble"),
        (
            ("rtsm", {"data": "none"}),
            "data is 'none'; expected one of own plans, random episodes, no new episodes",
        ),
    ],
)
def test_a_loop_that_nobody_knows_is_refused(given: tuple[str, dict[str, str]], said: str) -> None:
    word, named = given
    with pytest.raises(ValueError, match=said):
        rounds.loop(RUN, word, **named)


def test_steps_of_rounds_stand_beside_those_of_a_policy_to_the_same_return() -> None:
    common = dict(env=PUSH, metric="return_true", scale="paper")
    loop = common | dict(
        model="rtsm", planner="cem", execution="closed loop", configuration=results.PLANNED
    )
    policy = common | dict(model="sac", planner="policy", execution="policy", seed=0)
    rows = tables.frame(
        [
            loop | dict(seed=seed, iteration=k, env_steps=steps, value=value + seed)
            for seed in (0, 2)
            for k, (steps, value) in enumerate([(500, -21), (600, -16), (700, -11)])
        ]
    )
    free = tables.frame(
        [policy | dict(env_steps=steps, value=value) for steps, value in ((0, -30), (9000, -15))]
    )
    cells = [
        cell.strip()
        for cell in results.steps_table(rows, free).splitlines()[-1].strip("|").split("|")
    ]
    assert cells == [
        "SAC",
        "9,000",
        "-15.00",
        "`rtsm`",
        "600",
        "6.7%",
        "in round 1",
        "-10.00",
        "-",
        "1 / 2",
    ]
    falls_back = [(0, -30), (800, -10), (900, -12), (1000, -9)]  # below what the rounds end with
    free = tables.frame(
        [policy | dict(env_steps=steps, value=value) for steps, value in falls_back]
    )
    line = results.steps_table(rows, free).splitlines()[-1]
    assert [cell.strip() for cell in line.split("|")][-3:-1] == ["1,000", "1 / 2"]
    assert (
        results.steps_table(tables.frame([]), free)
        == results.steps_table(rows, tables.frame([]))
        == ""
    )


def test_a_seed_that_lost_an_episode_is_compared_with_the_others_round_by_round() -> None:
    loop = dict(
        env=PUSH,
        model="rtsm",
        planner="cem",
        execution="closed loop",
        configuration=results.PLANNED,
        n=4,
    )
    ends = {
        0: (500, 600, 700),
        1: (500, 580, 680),
    }  # of each round; seed 1 lost an episode in the first
    rows = tables.frame(
        [
            loop
            | dict(
                seed=seed,
                iteration=k,
                env_steps=steps,
                metric="return_true",
                value=-20 + 5 * k - 10 * seed,
            )
            for seed, of_round in ends.items()
            for k, steps in enumerate(of_round)
        ]
    )
    ((at, values),) = results.round_panels(rows, ["executed return"], PUSH)[
        "executed return"
    ].values()
    assert at.tolist() == [500, 590, 690]
    assert values.tolist() == [[-20, -15, -10], [-30, -25, -20]]
    lines = [
        line for line in str(results.rounds_table(rows, PUSH)).splitlines() if "`rtsm`" in line
    ]
    assert [
        line.count(steps) for line, steps in zip(lines, ("500", "590", "690"), strict=True)
    ] == [1, 1, 1]
    sac = dict(
        env=PUSH, metric="return_true", model="sac", planner="policy", execution="policy", seed=0
    )
    free = tables.frame([sac | dict(env_steps=9000, value=-20)])
    cells = [
        cell.strip()
        for cell in results.steps_table(rows, free).splitlines()[-1].strip("|").split("|")
    ]
    assert cells[4:8] == ["590", "6.6%", "in round 1", "-15.00"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ["rounds", "--envs", "tsm/Reacher-v0", "--models", "rtsm"],
            "no rounds are measured on 'tsm/Reacher-v0'",
        ),
        (
            ["rounds", "--envs", PUSH, "--models", "tsm"],
            "'tsm' does not explore tsm/ReacherPush-v1",
        ),
        (["predict", "--envs", PENDULUM, "--models", "rtsm"], "predict takes no Pendulum-v1"),
        (
            ["predict", "--envs", PUSH, "--models", "oracle"],
            "predict takes no oracle; --models are some of tsm, rtsm",
        ),
        (
            ["control", "--envs", PUSH, "--models", "oracle", "--planners", "adam"],
            "--planners of oracle are cem and mppi",
        ),
        (
            ["convergence", "--scale", "laptop", "--envs", PUSH, "--models", "tsm"],
            "nothing converges at scale laptop",
        ),
        (
            ["adaptation", "--models", "rtsm", "--variants", "mass2"],
            "cannot be chosen: it has no object",
        ),
        (["adaptation", "--models", "tsm"], "'tsm' is not adapted; there are rtsm, lstm, ensemble"),
        (
            ["adaptation", "--models", "ensemble+mse", "--envs", "tsm/PymunkPush-v1"],
            "no pretrained ensemble",
        ),
        (
            ["adaptation", "--models", "rtsm", "--episodes", "1"],
            "expected at least 2, since one is held out",
        ),
        (["adaptation", "--models", "rtsm", "--targets", "-1"], "--targets -1: expected 1 to 100"),
        (
            ["rounds", "--models", "rtsm", "--targets", "5"],
            "--targets 5: expected 1 to 100, and of adaptation alone",
        ),
        (
            ["rounds", "--models", "rtsm", "--seed", "1000001"],
            "seed 1000001 draws held-out episodes or targets",
        ),
        (
            ["rounds", "--models", "rtsm", "--seed", "-1"],
            "seed is -1, expected a whole number from 0 to 2147483647",
        ),
        (
            ["rounds", "--models", "rtsm", "--scale", "foo"],
            "scale is 'foo', expected one of smoke, laptop, paper",
        ),
        (
            ["policies", "--envs", PUSH, "--models", "rtsm", "--copies", "0"],
            "--copies 0, --iterations 880: expected",
        ),
        (["peers", str(ROOT / "README.md")], "README.md is not a results table"),
        (["peers"], "peers and whole, and nothing else, take tables that are there; got none"),
        (["peers", "nowhere.csv"], "take tables that are there; got ['nowhere.csv']"),
    ],
)
def test_rows_that_cannot_be_made_are_refused_before_any_work(
    options: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        run_script(ROOT / "benchmarks" / "settings" / "rows.py", "--scale", "smoke", *options)
    assert said in capsys.readouterr().err


def test_rows_of_other_libraries_are_published_beside_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runs, "RESULTS", tmp_path / "results")
    (tmp_path / "results").mkdir()
    row = dict(
        env=PUSH,
        metric="return_true",
        value=-9.0,
        n=4,
        seed=0,
        scale="paper",
        configuration="own plans",
    )
    made = {
        "loop": row
        | dict(model="pets", planner="cem", execution="closed loop", iteration=5, env_steps=75_000),
        "free": row | dict(model="sac", planner="policy", execution="policy", env_steps=1_000_000),
        "scores": row | dict(model="pets", planner="none", execution="open loop", metric="nrmse"),
    }
    for name, each in made.items():
        tables.save(tmp_path / f"{name}.csv", [each])
    for _ in range(2):  # once more changes nothing
        run_script(
            ROOT / "benchmarks" / "settings" / "rows.py",
            "peers",
            *(str(tmp_path / f"{n}.csv") for n in made),
        )
    names = ("10_explore", "model_free", "peers_pets")
    found = {name: tables.load(tmp_path / "results" / f"{name}.csv") for name in names}
    assert [rows["model"].tolist() for rows in found.values()] == [["pets"], ["sac"], ["pets"]]
    assert "75,000" in results.rounds_table(found["10_explore"], PUSH)
    ((method, (at, _)),) = results.round_panels(found["10_explore"], ["executed return"], PUSH)[
        "executed return"
    ].items()
    assert (method.model, at.tolist()) == ("pets", [75_000])


def test_every_loop_of_one_call_is_published_beside_those_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = dict(
        env=PUSH,
        metric="return_true",
        value=-9.0,
        seed=0,
        scale="smoke",
        iteration=0,
        env_steps=600,
    )
    (tmp_path / "results").mkdir()
    tables.save(
        tmp_path / "results" / "10_explore.csv",
        [row | dict(model="pets", configuration="own plans")],
    )
    manifest.write_manifest(tmp_path)  # from now on a table that is not as it says is refused
    monkeypatch.setattr(runs, "RESULTS", tmp_path / "results")
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path / "runs"))
    monkeypatch.setattr(
        rounds,
        "loop",
        lambda run, word, *, data, **_: rounds.Loop(
            [row | dict(model=word, configuration=data)], []
        ),
    )
    options = ["rounds", "--scale", "smoke", "--envs", PUSH, "--models", "rtsm", "lstm"]
    run_script(ROOT / "benchmarks" / "settings" / "rows.py", *options)
    found = tables.load(tmp_path / "results" / "10_explore.csv")
    assert found["model"].tolist() == ["pets", "rtsm", "rtsm", "lstm", "lstm"]


def test_own_plans_are_compared_in_the_seeds_that_both_have() -> None:
    rng = np.random.default_rng(0)
    loop = dict(env=PUSH, planner="cem", execution="closed loop", n=9, scale="paper")
    seeds_of = {results.PLANNED: (2, 0, 1), results.NONE: (0, 1, 2), results.RANDOM: (1, 2)}
    rows = [
        loop
        | dict(
            model=word,
            configuration=data,
            iteration=k,
            seed=seed,
            metric=metric,
            value=rng.uniform(),
        )
        for word in ("rtsm", "lstm")
        for data, seeds in seeds_of.items()
        for seed in seeds
        for k in range(3)
        for metric in ("return_true", "success")
        if (word, data) != ("lstm", results.NONE)
    ]
    value = {
        (r["model"], r["configuration"], r["iteration"], r["seed"], r["metric"]): r["value"]
        for r in rows
    }
    lines = results.differences_table(tables.frame(rows)).splitlines()
    found = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    expected = []
    for word, k in (("rtsm", 1), ("rtsm", 2), ("lstm", 1), ("lstm", 2)):
        cells = []
        for metric, form in (("return_true", "{:+.2f} ± {:.2f}"), ("success", "{:+.1f} ± {:.1f}")):
            for data, then in ((results.PLANNED, 0), (results.NONE, k), (results.RANDOM, k)):
                both = [
                    seed for seed in seeds_of[data] if (word, data, then, seed, metric) in value
                ]
                differences = [
                    value[word, results.PLANNED, k, seed, metric]
                    - value[word, data, then, seed, metric]
                    for seed in both
                ]
                scaled = [
                    (100 if metric == "success" else 1) * difference for difference in differences
                ]
                cells.append(form.format(*interval(scaled)) if both else "")
        expected.append([f"`{word}`", str(k), *cells, "2 to 3"])
    assert found[2:] == expected
    assert found[0][2] == "executed return minus round 0"
    assert results.differences_table(tables.frame(rows), PENDULUM) == ""


def test_loops_whose_plans_were_judged_otherwise_are_not_compared() -> None:
    loop = dict(
        env=PUSH, model="rtsm", planner="cem", execution="closed loop", n=9, metric="return_true"
    )
    made_again = {(results.PLANNED, seed) for seed in range(3)} | {(results.RANDOM, 2)}
    rows = tables.frame(
        [
            loop
            | dict(
                configuration=data,
                iteration=k,
                seed=seed,
                value=float(k * seed),
                samples=8 if (data, seed) in made_again else None,
            )
            for data in results.DATA
            for seed in range(3)
            for k in range(2)
        ]
    )
    found = results.paired(rows, 1)
    assert found.notna().sum().to_dict() == {"round 0": 3, results.NONE: 0, results.RANDOM: 1}
    assert found["round 0"].tolist() == [0, 1, 2]
    (line,) = results.differences_table(rows).splitlines()[2:]
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert [cells[3], cells[4], cells[-1]] == ["", "+0.00", "1 to 3"]
    assert results.paired(rows.drop(columns="samples"), 1).notna().all(axis=None)


def test_published_loops_of_one_learner_and_seed_begin_alike_whatever_their_data() -> None:
    rows = table.select(
        published("10_explore"), planner="cem", execution="closed loop", iteration=0
    )
    first = rows[rows["metric"].isin(["return_true", "success"])]
    learners = first.groupby(["env", "model", "seed", "metric"])["value"]
    assert (learners.count() > 1).sum() > 20
    assert learners.nunique().max() == 1


def test_the_notebook_says_of_pushing_what_the_published_rows_say() -> None:
    rows = table.select(published("10_explore"), env=PUSH, model="rtsm", execution="closed loop")
    assert set(rows["samples"]) == {8}
    metrics = ("return_true", "success", "gap_absolute", "gap_open_loop")
    returns, shares, gaps, alone = (table.select(rows, metric=metric) for metric in metrics)
    for each in (returns, shares):
        ends = {what: interval(values.dropna()) for what, values in results.paired(each, 5).items()}
        assert ends.keys() == {"round 0", results.NONE, results.RANDOM}
        assert all(mean - half > 0 for mean, half in ends.values())  # shown
        own = table.select(each, configuration=results.PLANNED).pivot(
            index="iteration", columns="seed", values="value"
        )
        means = own.mean(axis=1)
        assert means[1] - means[0] > means[5] - means[1]  # most of it comes with the first round
        if each is shares:
            assert [f"{means[k]:.0%}" for k in (0, 5)] == ["57%", "82%"]
            assert own.columns.tolist() == [0, 1, 2, 3, 4]
            assert (own.loc[5] > own.max() - 0.025).all()
            others = {
                data: table.select(each, configuration=data, iteration=5)["value"].mean()
                for data in (results.RANDOM, results.NONE)
            }
            assert [f"{share:.0%}" for share in others.values()] == ["65%", "60%"]
            assert (
                min(mean - half for mean, half in ends.values()) > 0.1
            )  # ten points more than any
            three = results.paired(each[each["seed"] < 3], 5)[results.NONE]
            mean, half = interval(100 * three)
            assert [round(float(x), 1) for x in (mean, mean - half, mean + half)] == [
                21.3,
                4.4,
                38.2,
            ]
    free = table.select(published("model_free"), env=PUSH, metric="return_true", subset="")
    ends = free[free["env_steps"] == 1_000_000].groupby("model")["value"].mean()
    before = table.select(
        published("10_explore"),
        env=PUSH,
        execution="closed loop",
        metric="return_true",
        iteration=0,
        configuration=results.PLANNED,
        model=["rtsm", "lstm", "ensemble+mse"],
    )
    assert set(ends.index) == {"ppo", "trpo", "sac"}
    assert (before.groupby("model")["value"].mean() > ends.max()).tolist() == [True] * 3
    assert set(before["env_steps"]) == {20_000}
    mean, half = interval(results.paired(gaps, 5)["round 0"])
    assert 0 < mean < half  # not shown
    mean, half = interval(results.paired(gaps, 5)[results.NONE])
    assert mean - half > 0
    assert round(float(mean), 1) == 0.5
    searched = table.select(
        published("10_explore"),
        env=PUSH,
        model="rtsm",
        configuration=results.PLANNED,
        metric="iterations_to_same_return",
        subset=results.LAST_PRIOR,
    )
    assert sorted(searched["value"]) == [7, 9, 9]  # of five seeds
    found = table.select(
        published("10_explore"),
        env=PUSH,
        model="rtsm",
        metric="return_true",
        execution="open loop",
        subset=results.LAST_PRIOR,
        iteration=10,
    )
    wide = found.pivot(index="seed", columns="configuration", values="value")
    mean, half = interval(wide[results.PLANNED] - wide[results.RANDOM])
    assert (round(float(mean), 2), mean - half > 0) == (0.18, True)
    ends = {what: interval(values.dropna()) for what, values in results.paired(alone, 5).items()}
    mean, half = ends["round 0"]
    assert mean + half < 0
    mean, half = ends[results.NONE]
    assert mean + half > 0  # not shown


def test_the_notebook_says_of_contacts_what_the_published_rows_say() -> None:
    touched = table.select(
        published("10_explore"),
        env=PUSH,
        model="rtsm",
        metric="contact_share",
        configuration=results.PLANNED,
    )
    means = touched.groupby("iteration")["value"].mean()
    assert [f"{share:.0%}" for share in (means[0], means[1:].min(), means[1:].max())] == [
        "66%",
        "89%",
        "93%",
    ]


def test_the_notebook_says_of_the_loop_of_mbrl_lib_what_the_published_rows_say() -> None:
    rows = table.select(
        published("10_explore"),
        execution="closed loop",
        metric="return_true",
        model=["pets", "rtsm"],
    )
    last = {
        env: own[own["iteration"] == own["iteration"].max()]
        for env, own in table.groups(rows, "env")
    }
    own = {
        env: table.select(part, configuration=results.PLANNED)
        for env, part in last.items()
        if env in results.DRAWN
    }
    wide = {
        env: part.pivot(index="seed", columns="model", values="value").dropna()
        for env, part in own.items()
    }
    assert (wide[PENDULUM]["pets"] > wide[PENDULUM]["rtsm"]).tolist() == [True] * 3
    assert (wide[PUSH]["pets"] < wide[PUSH]["rtsm"] - 7).tolist() == [True] * 3
    plans = table.select(
        published("05_control"), env=PUSH, planner="zero", metric="return_true", seed=0
    )
    nothing = float(plans["value"].mean())
    assert ((wide[PUSH]["pets"] - nothing).abs() < 0.2).all()


def test_the_notebook_says_of_other_models_that_push_what_the_published_rows_say() -> None:
    rows = table.select(
        published("10_explore"), env=PUSH, execution="closed loop", configuration=results.PLANNED
    )
    assert rows["env_steps"].max() == 95_000
    returns, shares = (
        table.select(rows, metric=metric, model=["lstm", "ensemble+mse", "rtsm"])
        .pivot(index="seed", columns=["model", "iteration"], values="value")
        .dropna()
        for metric in ("return_true", "success")
    )
    assert len(returns) == len(shares) == 3
    means = shares.mean()
    said = {word: [f"{means[word, k]:.0%}" for k in (0, 5)] for word in ("lstm", "ensemble+mse")}
    assert said == {"lstm": ["47%", "74%"], "ensemble+mse": ["41%", "66%"]}
    ahead = {}
    for name, wide in (("returns", returns), ("arrives", shares)):
        for word in ("lstm", "ensemble+mse"):
            assert (wide[word, 5] > wide[word, 0]).all()
            ahead[name, word] = interval(wide["rtsm", 5] - wide[word, 5])
    shown = {what for what, (mean, half) in ahead.items() if mean - half > 0}
    assert shown == {("returns", "ensemble+mse"), ("arrives", "lstm"), ("arrives", "ensemble+mse")}
    ends = [ahead["arrives", word] for word in ("lstm", "ensemble+mse")]
    found = [
        [round(float(100 * end)) for end in (mean, mean - half, mean + half)] for mean, half in ends
    ]
    assert found == [[8, 5, 12], [16, 9, 23]]
    mean, half = ahead["returns", "lstm"]
    assert [round(float(end), 1) for end in (mean, mean - half, mean + half)] == [0.3, -0.7, 1.3]
    assert (returns["ensemble+mse", 5] < returns["rtsm", 1]).all()
    first = {
        word: interval(100 * (shares["rtsm", 0] - shares[word, 0]))
        for word in ("lstm", "ensemble+mse")
    }
    assert [round(float(mean)) for mean, _ in first.values()] == [11, 17]
    gaps = table.select(rows, metric="gap_absolute", model=["lstm", "ensemble+mse"])
    wide = gaps.pivot(index="seed", columns=["model", "iteration"], values="value")
    falls = {word: wide[word, 0] - wide[word, 5] for word in ("lstm", "ensemble+mse")}
    assert all((fall > 0).all() for fall in falls.values())
    assert [round(float(fall.mean()), 1) for fall in falls.values()] == [1.1, 0.3]
    assert all(mean < half for mean, half in map(interval, falls.values()))  # not shown


def test_the_notebook_says_of_policies_of_the_pendulum_what_the_published_rows_say() -> None:
    rows = table.select(published("10_explore"), execution="closed loop", env=PENDULUM)
    lines = results.steps_table(rows, published("model_free"), PENDULUM).splitlines()
    names, _, *found = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    compared = [dict(zip(names, line, strict=True)) for line in found]
    assert (
        len(compared) == 3 * 4
    )  # and of rounds the segment model, the LSTM, the ensemble and PETS
    for one in compared:
        steps = int(one["policy's steps to that"].replace(",", ""))
        assert steps == 12_000 if one["policy"] == "SAC" else 48_000 <= steps <= 68_000
        assert float(one["its return"]) > float(one["return after the last"])
        assert one["its steps"] == "100,000"
    assert rows["env_steps"].max() == 2_200


def test_the_notebook_says_of_torques_what_the_published_rows_say() -> None:
    rows = table.select(published("10_explore"), env=PUSH, model="rtsm", metric="torque_rms")
    last = table.select(rows, subset=results.LAST_PRIOR).pivot(
        index="seed", columns="configuration", values="value"
    )
    executed = table.select(rows, subset="data", configuration=results.PLANNED)
    plans = executed[executed["iteration"] > 0].groupby("seed")["value"].mean()
    assert (plans < last[results.PLANNED]).all()
    assert (last[results.PLANNED] < last[[results.RANDOM, results.NONE]].min(axis=1)).all()
    first = table.select(rows, subset=results.FIRST_PRIOR, configuration=results.PLANNED)["value"]
    assert [
        round(float(part.mean()), 3)
        for part in (first, plans, last[results.PLANNED], last[results.RANDOM])
    ] == [
        0.067,
        0.069,
        0.075,
        0.096,
    ]
    sizes = worlds.world(PUSH).sizes["paper"]
    assert (
        sizes.prior * 6 == sizes.prior + sizes.rounds * sizes.prior
    )  # updates of the first prior and of the last


def test_the_notebook_says_of_gaps_and_priors_of_the_pendulum_what_the_published_rows_say() -> None:
    rows = table.select(
        published("10_explore"), env=PENDULUM, model="rtsm", execution="closed loop"
    )
    gaps, heights = (
        table.select(rows, metric=metric).groupby(["configuration", "iteration"])["value"].mean()
        for metric in ("gap_open_loop", "highest")
    )
    assert gaps[results.RANDOM, 4] < gaps[results.PLANNED, 4] < gaps[results.PLANNED, 0]
    assert (
        heights[results.PLANNED, 0]
        < heights[results.PLANNED, 4]
        < heights[results.RANDOM, 4] + 0.01
    )


def test_the_notebook_says_of_rounds_of_the_pendulum_what_the_published_rows_say() -> None:
    rows = table.select(published("10_explore"), planner="cem", execution="closed loop")
    swung = table.select(rows, env=PENDULUM, model="rtsm", metric="success", iteration=4)
    own, random = (
        table.select(swung, configuration=data).set_index("seed")["value"]
        for data in (results.PLANNED, results.RANDOM)
    )
    assert own.tolist() == [1, 1, 1]
    swings = table.select(rows, env=PENDULUM, metric="success")
    means = swings.groupby(["model", "configuration", "iteration"])["value"].mean()
    before = [means[word, results.PLANNED, 0] for word in ("rtsm", "lstm", "ensemble+mse")]
    assert [f"{share:.0%}" for share in before] == ["29%", "12%", "92%"]
    assert {means[word, results.PLANNED, 4] for word in ("rtsm", "lstm", "ensemble+mse")} == {1}
    assert [f"{means['rtsm', data, 4]:.0%}" for data in (results.RANDOM, results.NONE)] == [
        "46%",
        "25%",
    ]
    ends = table.select(
        rows, env=PENDULUM, metric="return_true", iteration=4, configuration=results.PLANNED
    )
    means = ends.groupby("model")["value"].mean()
    assert [round(float(means[word])) for word in ("pets", "rtsm")] == [59, 50]
    assert (random.sort_index() < own.sort_index()).all()
    returns = table.select(
        rows, env=PENDULUM, model="rtsm", metric="return_true", configuration=results.NONE
    )
    means = returns.groupby("iteration")["value"].mean()
    assert means[4] < means[0]
    swung = table.select(rows, env=PENDULUM, model="ensemble+mse", metric="success", iteration=0)
    assert sorted(table.select(swung, configuration=results.PLANNED)["value"]) == [0.75, 1, 1]
    assert set(swung["n"]) == {8}
    pushed = table.select(rows, env=PUSH, model="lstm", metric="return_true")
    own, alone = (
        table.select(pushed, configuration=data).pivot(
            index="iteration", columns="seed", values="value"
        )
        for data in (results.PLANNED, results.NONE)
    )
    assert own.columns.tolist() == alone.columns.tolist() == [0, 1, 2]
    assert (own.loc[5] - own.loc[0] > 2).all()
    assert ((alone.loc[5] - alone.loc[0]).abs() < 1).all()  # where it was
    pushed = table.select(
        rows, env=PUSH, model="lstm", metric="success", configuration=results.NONE, iteration=5
    )
    assert f"{pushed['value'].mean():.0%}" == "46%"


def test_rounds_are_drawn_with_their_task_their_units_and_single_seeds() -> None:
    common = dict(
        env=PUSH,
        model="lstm",
        planner="cem",
        execution="closed loop",
        configuration=results.PLANNED,
        n=9,
    )
    rows = tables.frame(
        [
            common
            | dict(
                metric=metric,
                env_steps=20_000 * k,
                iteration=k,
                value=low + 0.01 * seed + k / 5,
                seed=seed,
                scale="paper",
            )
            for metric, low in (("return_true", -9.0), ("success", 0.5))
            for k in range(3)
            for seed in range(3)
        ]
    ).assign(source=table.YOURS)
    (drawing,) = drawings.rounds(rows, PUSH, results.DRAWN[PUSH])
    first, second = drawing.figure.axes
    single = [line.get_ydata().tolist() for line in first.lines if line.get_lw() < 1]
    assert single == [
        pytest.approx([-9 + 0.01 * seed + k / 5 for k in range(3)]) for seed in range(3)
    ]
    assert [ax.get_title(loc="left") for ax in (first, second)] == [
        "Push: executed return",
        "Push: share within 5 cm",
    ]
    assert [ax.get_ylabel() for ax in (first, second)] == ["return (m)", "share of targets"]
    assert first.xaxis.get_major_formatter()(20_000) == "20,000"
    mean = next(line.get_ydata() for line in first.lines if line.get_marker() == "v")
    assert mean.tolist() == pytest.approx([-8.99, -8.79, -8.59])


def test_training_alone_and_the_oracle_are_lines_across_with_their_seeds() -> None:
    plans = tables.frame(
        [
            dict(
                env=PUSH,
                model="oracle",
                search_space="latent",
                planner="cem",
                execution="open loop",
                seed=seed,
                metric="return_true",
                value=-8.0 - seed,
            )
            for seed in range(2)
        ]
    ).assign(source=table.YOURS)
    (drawing,) = drawings.rounds(pushing_rows(-15.0), PUSH, results.DRAWN[PUSH], plans=plans)
    (ax,) = drawing.figure.axes
    level = sorted(float(line.get_ydata()[0]) for line in ax.lines if [*line.get_xdata()] == [0, 1])
    assert level == [pytest.approx(-12.9), pytest.approx(-8.5)]
    shades = sorted((patch.get_y(), patch.get_y() + patch.get_height()) for patch in ax.patches)
    assert shades == [pytest.approx((-13.0, -12.8)), pytest.approx((-9.0, -8.0))]
    told = {text.get_text() for text in drawing.figure.legends[0].texts}
    assert {
        "recurrent TSM, no new episodes, round 2",
        "oracle, open loop, 2 seeds",
        "single seeds",
    } <= told


def pushing_rows(low: float) -> pd.DataFrame:
    """Rounds of three learners, of which the LSTM falls to ``low``."""
    common = dict(
        env=PUSH, planner="cem", execution="closed loop", n=9, metric="return_true", scale="paper"
    )
    ends = {
        ("rtsm", results.PLANNED): -10.0,
        ("rtsm", results.NONE): -13.0,
        ("lstm", results.PLANNED): low,
    }
    return tables.frame(
        [
            common
            | dict(
                model=word,
                configuration=data,
                iteration=k,
                seed=seed,
                value=-12 + (end + 12) * k / 2 + 0.1 * seed,
                env_steps=20_000 + 15_000 * k * (data != results.NONE),
            )
            for (word, data), end in ends.items()
            for k in range(3)
            for seed in range(3)
        ]
    ).assign(source=table.YOURS)


def test_a_learner_that_falls_far_below_where_it_began_squeezes_no_other_and_its_return_stands_in_words() -> (
    None
):
    (drawing,) = drawings.rounds(pushing_rows(-30.0), PUSH, results.DRAWN[PUSH])
    (ax,) = drawing.figure.axes
    low = results.axis_ends(pushing_rows(-30.0), PUSH)["executed return"]
    assert low == pytest.approx(1.1 * -12.0)
    assert ax.get_ylim()[0] == low
    assert "outside: LSTM, own plans to −29.9" in ax.get_xlabel()
    all_below = pushing_rows(-30.0).assign(value=-25.0)
    (drawing,) = drawings.rounds(all_below, PUSH, results.DRAWN[PUSH])
    low, high = drawing.figure.axes[0].get_ylim()
    assert low < -25 < high


def test_a_learner_of_which_every_seed_lacks_a_round_is_not_drawn() -> None:
    rows = pushing_rows(-15.0)
    gone = {0: 0, 1: 1, 2: 2}  # seed -> round without a return
    lost = (rows["model"] == "lstm") & (rows["iteration"] == rows["seed"].map(gone))
    panel = results.round_panels(rows[~lost], ["executed return"], PUSH)["executed return"]
    assert {method.model for method in panel} == {"rtsm"}
    alone = table.select(rows[~lost], model="lstm")
    assert results.round_panels(alone, ["executed return"], PUSH) == {}


def test_training_alone_of_our_model_is_drawn_after_its_last_round_at_the_steps_of_the_first() -> (
    None
):
    rows = pushing_rows(-15.0)
    others = table.select(rows, model="rtsm", configuration=results.NONE).assign(model="lstm")
    rows = pd.concat([rows, others])
    panel = results.round_panels(rows, ["executed return"], PUSH, alone=True)["executed return"]
    drawn = {(method.model, method.variant): at.tolist() for method, (at, _) in panel.items()}
    alone = ("rtsm", "no new episodes, round 2")
    assert drawn == {
        ("rtsm", results.PLANNED): [20_000, 35_000, 50_000],
        alone: [20_000],
        ("lstm", results.PLANNED): [20_000, 35_000, 50_000],
    }
    ((_, values),) = (found for method, found in panel.items() if method.variant == alone[1])
    assert values.ravel().tolist() == pytest.approx([-13.0, -12.9, -12.8])


def test_a_plane_shows_real_states_alone() -> None:
    data = pendulum.random_episodes(2, seed=0)
    plane = pendulum.plane(data)
    assert plane.shape == (2 * (rounds.HORIZON + 1), 2)
    np.testing.assert_allclose(np.cos(plane[:, 0]), data.states[..., 0].ravel(), atol=1e-5)
    with pytest.raises(ValueError, match="expected"):
        figures.visited({"one": plane[:, :1]}, ("", ""), {})
