"""Rows say what trials measured, tables say what rows say, and a bar is reached or it is not."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from tsmlib import study
from tsmlib.envs import imperfect
from tsmlib.envs.spec import DELAY, NOISE
from tsmlib.planning import tasks
from tsmlib.planning.base import Plan
from tsmlib.planning.execution import Trial, execute
from tsmlib.planning.tasks import Task, random_torques, zero_torques
from tsmlib.study import media, runs
from tsmlib.study.results import planning as planning_results

REACHER, PUSH = "tsm/Reacher-v0", "tsm/ReacherPush-v0"
RUN = runs.resolve("05_control", scale="smoke", seed=2, run_dir="/nowhere")


def some_task(env: str = PUSH, n: int = 10) -> Task:
    return dataclasses.replace(study.draw_task(env, seed=3, n=n), horizon=20)


def dreamt(task: Task, torques: Any, promised: float = 0.0) -> Trial:
    """A trial of torques whose model saw the truth coming, and promised so much more."""
    seen = execute(task, torques)
    states = seen.states[None, :, 1:].clone()
    plan = Plan(torques, torques, states, seen.executed_return + promised, seen.executed_return[None], seconds=1.0)
    return dataclasses.replace(seen, plan=plan)


def value(rows: Any, metric: str, **wanted: Any) -> float:
    (found,) = (row["value"] for row in rows if row["metric"] == metric and all(row[k] == v for k, v in wanted.items()))
    return float(found)


# Rows ----------------------------------------------------------------------------------------------------------------


def test_a_table_holds_what_the_trials_measured() -> None:
    task = some_task(REACHER, 4)
    trial = execute(task, zero_torques(task))
    summary, per_target = planning_results.tables([task], {REACHER: {"zero": trial}}, RUN)
    assert value(summary, "return_true") == pytest.approx(float(trial.executed_return.mean()))
    near = trial.final_distance <= tasks.TOLERANCE
    assert value(summary, "success") == pytest.approx(float(near.float().mean()))
    assert {(row["model"], row["planner"], row["seed"], row["n"]) for row in summary} == {("none", "zero", 2, 4)}
    np.testing.assert_allclose(
        planning_results.by_target(per_target, "return_true")["zero"], trial.executed_return, rtol=1e-6
    )


def test_costs_are_held_against_the_oracle_and_gains_against_doing_nothing() -> None:
    task = some_task(REACHER, 4)
    nothing, random = (execute(task, torques(task)) for torques in (zero_torques, random_torques))
    oracle = dataclasses.replace(nothing, executed_return=nothing.executed_return / 2)
    trials = {REACHER: {"zero": nothing, "oracle codes cem": oracle, "random": random}}
    rows, _ = planning_results.tables([task], trials, RUN)
    assert value(rows, "cost_over_oracle", model="oracle") == pytest.approx(1)
    assert value(rows, "gain_share", model="oracle") == pytest.approx(1)
    assert value(rows, "cost_over_oracle", planner="zero") == pytest.approx(2)
    assert value(rows, "gain_share", planner="zero") == pytest.approx(0)


def test_a_dream_that_breaks_an_invariant_is_in_the_rows_and_the_truth_breaks_none() -> None:
    task = some_task()
    torques = random_torques(task)
    sound, careless = dreamt(task, torques), dreamt(task, torques)
    assert careless.plan is not None
    jump = torch.zeros(10)
    jump[3] = 0.05
    careless.plan.states[0, :, 10:, 6] += jump[:, None]  # one object of ten, for half the time
    careless.plan.predicted_return[3] += 1.0
    rows, per_target = planning_results.tables(
        [task], {PUSH: {"tsm codes cem": sound, "lstm codes cem": careless}}, RUN
    )
    assert value(rows, "broken", model="tsm") == 0
    assert value(rows, "broken", model="lstm") == pytest.approx(0.05, abs=0.006)
    assert value(rows, "broken_worst", model="lstm") == pytest.approx(0.5, abs=0.06)  # the worst tenth is that one
    assert planning_results.by_target(per_target, "broken")["lstm codes cem"].argmax() == 3
    closed, _ = planning_results.tables(
        [task], {PUSH: {"tsm codes cem": sound}}, RUN, condition=planning_results.CLOSED
    )
    assert not any(row["metric"].startswith("broken") for row in closed)  # each plan dreams from another start


def test_rough_torques_are_told_from_smooth_ones() -> None:
    task = some_task(REACHER)
    rough = 0.1 * torch.randn(10, 20, 2, generator=torch.Generator().manual_seed(0))
    trials = {REACHER: {"random": execute(task, random_torques(task)), "tsm actions cem": dreamt(task, rough)}}
    rows, _ = planning_results.tables([task], trials, RUN)
    for metric in ("torque_change", "torque_fast", "torque_novelty"):
        assert value(rows, metric, model="tsm") > 1.5 * value(rows, metric, model="none"), metric


def test_plans_along_the_way_are_told_by_their_iteration() -> None:
    task = some_task(REACHER)
    rows = []
    for iteration, promised in ((0, 0.0), (5, 0.5), (20, 2.0)):
        trials = {REACHER: {"tsm codes adam": dreamt(task, zero_torques(task), promised)}}
        rows += planning_results.tables([task], trials, RUN, condition=planning_results.ALONG, iteration=iteration)[0]
    (curve,) = planning_results.along_the_way(rows, REACHER).values()
    np.testing.assert_array_equal(curve["iterations"], [0, 5, 20])
    np.testing.assert_allclose(curve["predicted"] - curve["true"], [0.0, 0.5, 2.0], atol=1e-5)
    assert planning_results.along_the_way(rows, PUSH) == {}


def test_how_soon_a_plan_was_nearly_done_is_counted_target_by_target() -> None:
    task = some_task(n=3)
    plan = dreamt(task, zero_torques(task)).plan
    assert plan is not None
    curve = torch.arange(200.0)[:, None] * torch.tensor([0.0, 1.0, 1.0])
    curve[60:, 2] = 199
    rows = planning_results.convergence(
        task, dataclasses.replace(plan, curve=curve), RUN, model="tsm", planner="adam", prior="codes"
    )
    assert [(row["target"], row["value"]) for row in rows] == [(0, 0), (1, 190), (2, 60)]
    assert {(row["condition"], row["horizon"], row["metric"]) for row in rows} == {("clean", 20, "iterations_to_95")}
    assert "| 3 | 60 | 66.7 % | 66.7 % |" in planning_results.by_convergence(rows)


def test_seeds_are_averaged_target_by_target() -> None:
    rows = [
        dict(model="tsm", prior="codes", planner="cem", metric="return_true", target=i, seed=seed, value=i + seed)
        for seed in (0, 2)
        for i in range(3)
    ]  # fmt: skip
    np.testing.assert_array_equal(planning_results.by_target(rows, "return_true")["tsm codes cem"], [1.0, 2.0, 3.0])


# Tables --------------------------------------------------------------------------------------------------------------


def made_up(**changed: float) -> list[dict[str, Any]]:
    """Rows of a study in which every bar is reached, but for what is ``changed``."""
    given = {
        "near": 1.05, "relative": 0.02, "far": 1.1, "size": 0.1, "rival_size": 0.3, "earned": -7.0, "rival": -7.5,
        "success": 0.5, "oracle_success": 0.4, "broken": 0.01,
    } | changed  # fmt: skip
    ours, oracle, rival = ("tsm", "codes"), ("oracle", "codes"), ("lstm", "actions")
    numbers = [
        (REACHER, *ours, planning_results.OPEN, "cost_over_oracle", given["near"]),
        (REACHER, *ours, planning_results.OPEN, "relative_gap_median", given["relative"]),
        (PUSH, *ours, planning_results.OPEN, "cost_over_oracle", given["far"]),
        (PUSH, *ours, planning_results.OPEN, "gap_absolute", given["size"]),
        (PUSH, *ours, planning_results.OPEN, "exploitation_gap", given["size"]),
        (PUSH, *ours, planning_results.OPEN, "return_true", given["earned"]),
        (PUSH, *ours, planning_results.OPEN, "broken", given["broken"]),
        (PUSH, *rival, planning_results.OPEN, "gap_absolute", given["rival_size"]),
        (PUSH, *rival, planning_results.OPEN, "exploitation_gap", given["rival_size"]),
        (PUSH, *rival, planning_results.OPEN, "return_true", given["rival"]),
        (PUSH, *ours, planning_results.CLOSED, "success", given["success"]),
        (PUSH, *oracle, planning_results.CLOSED, "success", given["oracle_success"]),
    ]
    return [
        dict(env=env, model=model, prior=prior, planner="cem", condition=condition, metric=metric, value=value, n=100)
        for env, model, prior, condition, metric, value in numbers
    ]


def test_every_bar_can_be_reached_and_missed() -> None:
    found = planning_results.bars(made_up(), "tsm")
    assert all(met for _, _, met in found.values())
    for changed in (
        {"near": 1.2}, {"relative": 0.06}, {"far": 1.16}, {"size": 0.2}, {"rival": -6.9}, {"success": 0.3},
        {"broken": 0.06},
    ):  # fmt: skip
        missed = [what for what, (_, _, met) in planning_results.bars(made_up(**changed), "tsm").items() if not met]
        assert len(missed) == 1, changed
    assert "| no |" in planning_results.verdicts(planning_results.bars(made_up(near=1.2), "tsm"))
    assert planning_results.bars(made_up(success=0.8, oracle_success=0.9), "tsm")["push, closed loop: within 0.03 m"][2]


def test_tables_keep_models_planners_and_loops_apart() -> None:
    rows = made_up()
    rows += [dict(row, planner="mppi", value=-1.0) for row in rows if row["condition"] == planning_results.OPEN]
    assert "-1.00" not in planning_results.report(rows)
    assert "| TSM | codes |" in planning_results.report(rows)
    lines = planning_results.by_planner([row for row in rows if row["env"] == PUSH]).splitlines()
    assert lines[0].endswith("| CEM | MPPI |")
    assert "| -7.00 (+0.10) | -1.00 (-1.00) |" in lines[2]
    (line,) = (line for line in planning_results.by_loop(rows).splitlines() if "| TSM |" in line)
    assert "50.0 %" in line
    assert "| 1.0 % |" in planning_results.by_invariant(rows)


def test_what_the_prior_changes_is_paired_by_target() -> None:
    draw = np.random.default_rng(0)
    hard = draw.normal(size=50)  # targets differ much, the two methods little
    rows = []
    for prior, more in (("codes", 0.1), ("actions", 0.0)):
        for metric, extra in (("return_true", 0.0), ("return_predicted", 2 * more)):
            rows += [
                dict(env=PUSH, model="tsm", prior=prior, planner="cem", condition=planning_results.OPEN, metric=metric,
                     target=i, value=value)
                for i, value in enumerate(hard + more + extra)
            ]  # fmt: skip
    line = planning_results.by_prior(rows).splitlines()[2]
    assert line == f"| `{PUSH}` | TSM | CEM | 50 | +0.100 ± 0.000 | +0.200 ± 0.000 |"


def test_the_shipped_rows_make_tables() -> None:
    rows = study.table(dataclasses.replace(RUN, scale="laptop"), "05_control.csv")
    if not rows:
        pytest.skip("nothing is published")
    for table in (
        planning_results.report,
        planning_results.by_planner,
        planning_results.by_invariant,
        planning_results.by_loop,
    ):
        assert table(rows).count("\n") >= 1


# Pictures ------------------------------------------------------------------------------------------------------------


def test_a_film_of_actions_that_nobody_planned_is_refused() -> None:
    task = some_task(REACHER, 2)
    with pytest.raises(ValueError, match="not planned"):
        media.strip(task, execute(task, zero_torques(task)), 0)


def test_a_film_of_an_arm_behind_noisy_sensors_shows_what_they_say_beside_what_it_did() -> None:
    task = dataclasses.replace(some_task("tsm/PymunkReacher-v0", 2), horizon=3)
    noisy = dataclasses.replace(task, env=imperfect(task.env, noise=NOISE))
    trial = execute(noisy, torch.full((2, 3, 2), 0.3))
    film = media.film(noisy, trial, 1)
    seen, done = np.split(film, 2, axis=2)
    assert len(film) == 4  # the start and three steps
    assert (seen[:, 40:] != done[:, 40:]).any((1, 2, 3)).all()  # below the words, in every frame
    perfect = dataclasses.replace(trial, observed=trial.states)
    seen, again = np.split(media.film(noisy, perfect, 1), 2, axis=2)
    np.testing.assert_array_equal(seen[:, 40:], again[:, 40:])
    np.testing.assert_array_equal(again, done)


def test_a_film_of_late_actions_that_nobody_planned_is_refused() -> None:
    task = dataclasses.replace(some_task(REACHER, 2), env=imperfect(REACHER, delay=DELAY))
    with pytest.raises(ValueError, match="not planned"):
        media.film(task, execute(task, zero_torques(task)), 0)
