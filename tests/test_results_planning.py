"""Rows say what trials measured, tables say what rows say, and a threshold is reached or it is not."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from tsmlib import study
from tsmlib.envs import imperfect
from tsmlib.envs.render import render_array
from tsmlib.envs.spec import DELAY, NOISE
from tsmlib.planning.base import Plan
from tsmlib.planning.execution import Trial, execute
from tsmlib.planning.tasks import Task, random_torques, zero_torques
from tsmlib.storage import tables
from tsmlib import zoo
from reproduction.results import planning as planning_results
from reproduction.results import table

REACHER, PUSH = "tsm/Reacher-v0", "tsm/ReacherPush-v1"
TSM, LSTM = (zoo.method(model, "latent", "cem") for model in ("tsm", "lstm"))
ZERO, RANDOM = (zoo.method("none", planner=word) for word in ("zero", "random"))
RUN = runs.resolve("05_control", scale="smoke", seed=2, run_dir="/nowhere")


def some_task(env: str = PUSH, n: int = 10) -> Task:
    return dataclasses.replace(study.draw_task(env, seed=3, n=n), horizon=20)


def foreseen(task: Task, torques: Any, gap: float = 0.0) -> Trial:
    """A trial of torques whose predicted states are the executed ones; its predicted return is more by ``gap``."""
    seen = execute(task, torques)
    states = seen.states[None, :, 1:].clone()
    plan = Plan(
        torques,
        torques,
        states,
        seen.executed_return + gap,
        seen.executed_return[None],
        seconds=1.0,
    )
    return dataclasses.replace(seen, plan=plan)


def value(rows: Any, metric: str, **wanted: Any) -> float:
    (found,) = (
        row["value"]
        for row in rows
        if row["metric"] == metric and all(row[k] == v for k, v in wanted.items())
    )
    return float(found)


# Rows ----------------------------------------------------------------------------------------------------------------


def test_a_table_holds_what_the_trials_measured() -> None:
    task = some_task(REACHER, 4)
    trial = execute(task, zero_torques(task))
    summary, per_target = planning_results.rows([task], {REACHER: {ZERO: trial}}, RUN)
    assert value(summary, "return_true") == pytest.approx(float(trial.executed_return.mean()))
    near = trial.final_distance <= task.tolerance
    assert value(summary, "success") == pytest.approx(float(near.float().mean()))
    assert {(row["model"], row["planner"], row["seed"], row["n"]) for row in summary} == {
        ("none", "zero", 2, 4)
    }
    np.testing.assert_allclose(
        planning_results.by_target(tables.frame(per_target), "return_true")[ZERO],
        trial.executed_return,
        rtol=1e-6,
    )


def test_costs_are_held_against_the_oracle_and_gains_against_doing_nothing() -> None:
    task = some_task(REACHER, 4)
    nothing, random = (execute(task, torques(task)) for torques in (zero_torques, random_torques))
    oracle = dataclasses.replace(nothing, executed_return=nothing.executed_return / 2)
    trials = {REACHER: {ZERO: nothing, planning_results.ORACLE: oracle, RANDOM: random}}
    rows, _ = planning_results.rows([task], trials, RUN)
    assert value(rows, "cost_over_oracle", model="oracle") == pytest.approx(1)
    assert value(rows, "gain_share", model="oracle") == pytest.approx(1)
    assert value(rows, "cost_over_oracle", planner="zero") == pytest.approx(2)
    assert value(rows, "gain_share", planner="zero") == pytest.approx(0)


def test_a_predicted_rollout_that_breaks_an_invariant_is_in_the_rows_and_the_truth_breaks_none() -> (
    None
):
    task = some_task()
    torques = random_torques(task)
    sound, careless = foreseen(task, torques), foreseen(task, torques)
    assert careless.plan is not None
    jump = torch.zeros(10)
    jump[3] = 0.05
    careless.plan.states[0, :, 10:, 6] += jump[:, None]  # one object of ten, for half the time
    careless.plan.predicted_return[3] += 1.0
    rows, per_target = planning_results.rows([task], {PUSH: {TSM: sound, LSTM: careless}}, RUN)
    assert value(rows, "violations", model="tsm") == 0
    assert value(rows, "violations", model="lstm") == pytest.approx(0.05, abs=0.006)
    assert value(rows, "violations_worst", model="lstm") == pytest.approx(
        0.5, abs=0.06
    )  # the worst tenth is that one
    assert planning_results.by_target(tables.frame(per_target), "violations")[LSTM].argmax() == 3
    closed, _ = planning_results.rows(
        [task], {PUSH: {TSM: sound}}, RUN, execution=planning_results.CLOSED
    )
    assert not any(
        row["metric"].startswith("violations") for row in closed
    )  # each plan predicts from another start


def test_rough_torques_are_told_from_smooth_ones() -> None:
    task = some_task(REACHER)
    rough = 0.1 * torch.randn(10, 20, 2, generator=torch.Generator().manual_seed(0))
    trials = {
        REACHER: {
            RANDOM: execute(task, random_torques(task)),
            zoo.method("tsm", "direct", "cem"): foreseen(task, rough),
        }
    }
    rows, _ = planning_results.rows([task], trials, RUN)
    for metric in ("torque_change", "torque_fast", "torque_novelty"):
        assert value(rows, metric, model="tsm") > 1.5 * value(rows, metric, model="none"), metric


def test_plans_along_the_way_are_told_by_their_iteration() -> None:
    task = some_task(REACHER)
    rows = []
    for iteration, gap in ((0, 0.0), (5, 0.5), (20, 2.0)):
        trials = {REACHER: {TSM: foreseen(task, zero_torques(task), gap)}}
        rows += planning_results.rows([task], trials, RUN, iteration=iteration)[0]
    (curve,) = planning_results.along_the_way(tables.frame(rows), REACHER).values()
    np.testing.assert_array_equal(curve["iterations"], [0, 5, 20])
    np.testing.assert_allclose(curve["predicted"] - curve["true"], [0.0, 0.5, 2.0], atol=1e-5)
    assert planning_results.along_the_way(tables.frame(rows), PUSH) == {}


def test_how_soon_a_plan_was_nearly_done_is_counted_target_by_target() -> None:
    task = some_task(n=3)
    plan = foreseen(task, zero_torques(task)).plan
    assert plan is not None
    curve = torch.arange(200.0)[:, None] * torch.tensor([0.0, 1.0, 1.0])
    curve[60:, 2] = 199
    rows = planning_results.convergence(
        task, dataclasses.replace(plan, curve=curve), RUN, zoo.method("tsm", "latent", "adam")
    )
    assert [(row["target"], row["value"]) for row in rows] == [(0, 0), (1, 190), (2, 60)]
    assert {(row["execution"], row["horizon"], row["metric"]) for row in rows} == {
        ("open loop", 20, "iterations_to_95")
    }
    assert cells(planning_results.convergence_table(tables.frame(rows)))[1][2:] == [
        "3",
        "60",
        "66.7%",
        "66.7%",
    ]


def test_the_size_of_a_gap_is_that_of_each_seed_before_seeds_are_averaged() -> None:
    given = dict(
        env="tsm/Reacher-v0",
        model="tsm",
        search_space="latent",
        planner="cem",
        execution="open loop",
    )
    predicted = {0: 3.0, 1: -1.0}  # of 1: two too much, and two too little
    rows = [
        dict(given, metric="return_true", target=i, seed=seed, value=1.0)
        for seed in predicted
        for i in range(3)
    ]
    rows += [
        dict(given, metric="return_predicted", target=i, seed=seed, value=value)
        for seed, value in predicted.items()
        for i in range(3)
    ]
    np.testing.assert_array_equal(
        planning_results.gap_sizes(tables.frame(rows))[TSM], [[2.0, 2.0, 2.0]] * 2
    )


def test_a_cost_that_is_paired_by_target_is_told_for_each_seed_and_over_seeds_as_well() -> None:
    given = dict(
        env="tsm/Reacher-v0",
        search_space="latent",
        planner="cem",
        execution="open loop",
        metric="return_true",
    )
    costs = {
        ("tsm", 0): [1.0, 2.0, 3.0],
        ("lstm", 0): [2.0, 3.0, 4.0],
        ("tsm", 1): [1.0, 2.0, 3.0],
        ("lstm", 1): [4.0, 5.0, 6.0],
    }
    rows = [
        dict(given, model=model, target=i, seed=seed, value=-cost)
        for (model, seed), each in costs.items()
        for i, cost in enumerate(each)
    ]
    _, line = planning_results.paired_table(tables.frame(rows), "tsm/Reacher-v0", "tsm").to_dict(
        "records"
    )
    assert (line["cost of tsm minus this"], line["in each seed"]) == (
        "-2.00 (12.71)",
        "-1.00, -3.00",
    )  # t of 2 seeds
    rows = [row for row in rows if row["seed"] == 0]
    _, line = planning_results.paired_table(tables.frame(rows), "tsm/Reacher-v0", "tsm").to_dict(
        "records"
    )
    assert line["cost of tsm minus this"] == "-1.00"


def test_targets_that_a_method_lacks_take_no_seed_away() -> None:
    given = dict(
        env=PUSH, search_space="latent", planner="cem", execution="open loop", metric="return_true"
    )
    rows = [
        dict(given, model=model, target=i, seed=seed, value=-cost - i)
        for model, cost, n in (("tsm", 1.0, 4), ("lstm", 2.0, 3))
        for seed in (0, 1)
        for i in range(n)
    ]
    _, line = planning_results.paired_table(tables.frame(rows), PUSH, "tsm").to_dict("records")
    assert (line["in each seed"], line["n"]) == ("-1.00, -1.00", 3)
    apart = [
        row for row in rows if (row["model"], row["seed"]) not in {("tsm", 0), ("lstm", 1)}
    ]  # no seed of both
    _, line = planning_results.paired_table(tables.frame(apart), PUSH, "tsm").to_dict("records")
    assert line["cost of tsm minus this"] == ""


def test_open_and_closed_loop_are_compared_in_the_seeds_that_were_executed_both_ways() -> None:
    given = dict(
        env=PUSH, search_space="latent", planner="cem", metric="final_distance", n=1, target=0
    )
    seeds = {
        ("tsm", "open loop"): (0, 1),
        ("tsm", "closed loop"): (1, 2),
        ("lstm", "closed loop"): (0, 1),
    }
    rows = tables.frame(
        [
            dict(given, model=model, execution=way, seed=seed, value=seed + (way == "open loop"))
            for (model, way), own in seeds.items()
            for seed in own
        ]
    )
    drawn = planning_results.final_distances(rows, PUSH)
    assert {way: values.tolist() for way, values in drawn[TSM].items()} == {
        "open": [2],
        "closed": [1],
    }
    assert {way: values.tolist() for way, values in drawn[LSTM].items()} == {
        "closed": [0, 1]
    }  # of no open loop
    _, ours, theirs = cells(planning_results.loops_table(rows))
    assert ours[-3:] == ["1", "2.000", "1.000"]
    assert theirs[-3:] == ["2", "", "0.500"]


def test_distances_that_are_drawn_are_those_of_every_seed() -> None:
    given = dict(
        env="tsm/Reacher-v0",
        model="tsm",
        search_space="latent",
        planner="cem",
        metric="final_distance",
    )
    rows = [
        dict(given, execution=way, target=i, seed=seed, value=i + seed)
        for way in ("open loop", "closed loop")
        for seed in (0, 10)
        for i in range(2)
    ]
    drawn = planning_results.final_distances(tables.frame(rows), "tsm/Reacher-v0")[TSM]
    assert sorted(drawn["closed"]) == sorted(drawn["open"]) == [0, 1, 10, 11]


def test_seeds_are_averaged_target_by_target() -> None:
    given = dict(model="tsm", search_space="latent", planner="cem", metric="return_true")
    rows = [dict(given, target=i, seed=seed, value=i + seed) for seed in (0, 2) for i in range(3)]
    np.testing.assert_array_equal(
        planning_results.by_target(tables.frame(rows), "return_true")[TSM], [1.0, 2.0, 3.0]
    )


# Tables --------------------------------------------------------------------------------------------------------------


def test_a_point_is_a_target_of_a_seed_and_every_model_is_searched_in_one_space() -> None:
    task = some_task(n=2)
    common = dict(
        env=task.env, task=task.name, planner="cem", execution="open loop", scale="paper", n=2
    )
    rows = tables.frame(
        [
            common
            | dict(
                model=model, search_space=space, metric=metric, value=-1.0 - k - i, seed=k, target=i
            )
            for model in (zoo.OURS, "lstm")
            for space in ("latent", "direct")
            for metric in ("return_true", "return_predicted")
            for k in range(3)
            for i in range(2)
        ]
    ).assign(source=table.YOURS)
    drawing = drawings.predicted_and_executed(rows, [task])
    assert [ax.get_title(loc="left") for ax in drawing.figure.axes] == [
        "recurrent TSM\nlatent, CEM",
        "LSTM\nlatent, CEM",
    ]
    assert all(len(ax.collections[-1].get_offsets()) == 3 * 2 for ax in drawing.figure.axes)
    assert table.stamp(drawing.rows, figure=True) == "scale paper, seeds 0, 1, 2, n = 2"


def cells(markdown: str) -> list[list[str]]:
    """Head and lines."""
    head, _, *lines = markdown.splitlines()
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in (head, *lines)]


def made_up(**changed: float) -> pd.DataFrame:
    """Rows of a study in which every threshold is reached, but for what is ``changed``."""
    given = {
        "near": 1.05,
        "relative": 0.02,
        "far": 1.1,
        "size": 0.1,
        "rival_size": 0.3,
        "executed": -7.0,
        "rival": -7.5,
        "success": 0.5,
        "oracle_success": 0.4,
        "violations": 0.01,
    } | changed
    ours, oracle, rival = ("tsm", "latent"), ("oracle", "latent"), ("lstm", "direct")
    numbers = [
        (REACHER, *ours, planning_results.OPEN, "cost_over_oracle", given["near"]),
        (REACHER, *ours, planning_results.OPEN, "relative_gap_median", given["relative"]),
        (PUSH, *ours, planning_results.OPEN, "cost_over_oracle", given["far"]),
        (PUSH, *ours, planning_results.OPEN, "gap_absolute", given["size"]),
        (PUSH, *ours, planning_results.OPEN, "exploitation_gap", given["size"]),
        (PUSH, *ours, planning_results.OPEN, "return_true", given["executed"]),
        (PUSH, *ours, planning_results.OPEN, "violations", given["violations"]),
        (PUSH, *rival, planning_results.OPEN, "gap_absolute", given["rival_size"]),
        (PUSH, *rival, planning_results.OPEN, "exploitation_gap", given["rival_size"]),
        (PUSH, *rival, planning_results.OPEN, "return_true", given["rival"]),
        (PUSH, *ours, planning_results.CLOSED, "success", given["success"]),
        (PUSH, *oracle, planning_results.CLOSED, "success", given["oracle_success"]),
    ]
    columns = ("env", "model", "search_space", "execution", "metric", "value")
    return tables.frame(
        dict(zip(columns, row, strict=True), planner="cem", n=100) for row in numbers
    )


def test_every_threshold_can_be_reached_and_missed() -> None:
    found = planning_results.thresholds(made_up(), "tsm")
    assert found["reached"].all()
    for changed in (
        {"near": 1.2},
        {"relative": 0.06},
        {"far": 1.16},
        {"size": 0.2},
        {"rival": -6.9},
        {"success": 0.3},
        {"violations": 0.06},
    ):
        missed = planning_results.thresholds(made_up(**changed), "tsm")
        assert (~missed["reached"]).sum() == 1, changed
        assert [line[-1] for line in cells(table.markdown(missed))].count("no") == 1
    most = planning_results.thresholds(made_up(success=0.8, oracle_success=0.9), "tsm").set_index(
        "what"
    )
    assert most["reached"]["push, closed loop: within 0.05 m, the oracle's or 80 %"]


def test_tables_keep_models_planners_and_loops_apart() -> None:
    rows = made_up()
    other = rows[rows["execution"] == planning_results.OPEN].assign(planner="mppi", value=-1.0)
    along = rows[rows["execution"] == planning_results.OPEN].assign(iteration=3, value=-2.0)
    rows = tables.frame(pd.concat([rows, other, along]))
    assert "-1.00" not in planning_results.plans_table(rows)
    assert "-2.00" not in planning_results.plans_table(rows)
    assert "| TSM, latent, CEM " in planning_results.plans_table(rows)
    head, ours, _ = cells(planning_results.planners_table(rows[rows["env"] == PUSH]))
    assert head == ["environment", "method", "CEM", "MPPI"]
    assert ours[1:] == ["TSM, latent", "-7.00 (+0.10)", "-1.00 (-1.00)"]
    (line,) = (
        line for line in planning_results.loops_table(rows).splitlines() if "| TSM, latent" in line
    )
    assert "50.0%" in line
    assert "| 1.0%" in planning_results.violations_table(rows)


def test_what_the_prior_changes_is_paired_by_target() -> None:
    hard = np.random.default_rng(0).normal(size=50)  # targets differ much, the two methods little
    given = dict(env=PUSH, model="tsm", planner="cem", execution=planning_results.OPEN, seed=0)
    rows = [
        dict(given, search_space=space, metric=metric, target=i, value=value)
        for space, more in (("latent", 0.1), ("direct", 0.0))
        for metric, extra in (("return_true", 0.0), ("return_predicted", 2 * more))
        for i, value in enumerate(hard + more + extra)
    ]
    _, line = cells(planning_results.spaces_table(tables.frame(rows)))
    assert line == [f"`{PUSH}`", "TSM, CEM", "50", "+0.100 ± 0.000", "+0.200 ± 0.000"]


def test_the_shipped_rows_make_tables() -> None:
    rows = study.published("05_control")
    if rows.empty:
        pytest.skip("nothing is published")
    for text in (planning_results.plans_table, planning_results.planners_table):
        assert len(text(rows).splitlines()) > 2
    for text in (planning_results.violations_table, planning_results.loops_table):
        assert len(text(rows).splitlines()) > 2 or text(rows) == planning_results.NOT_YET


def test_what_was_not_measured_is_said() -> None:
    reaching = made_up()
    reaching = reaching[reaching["env"] == REACHER]
    assert planning_results.violations_table(reaching) == planning_results.NOT_YET
    assert planning_results.loops_table(reaching) == planning_results.NOT_YET
    found = planning_results.thresholds(reaching, "tsm").set_index("what")
    assert found["reached"].tolist() == [True, True] + [False] * 5
    assert found["measured"].tolist()[2:] == ["not measured"] * 5


# Pictures ------------------------------------------------------------------------------------------------------------


def test_a_film_of_actions_that_nobody_planned_is_refused() -> None:
    task = some_task(REACHER, 2)
    with pytest.raises(ValueError, match="not planned"):
        media.strip(task, {ZERO: execute(task, zero_torques(task))}, 0)


def test_films_are_of_targets_that_have_to_be_pushed_far_the_nearest_end_first() -> None:
    task = some_task(PUSH, 10)
    trial = execute(task, zero_torques(task))
    order = planning_results.by_final_distance(task, trial)
    away = np.linalg.norm(task.start[:, 6:8] - task.target.numpy(), axis=1)
    assert sorted(order) == np.flatnonzero(away >= 0.1).tolist()
    assert (trial.final_distance[order].diff() >= 0).all()
    assert sorted(planning_results.by_final_distance(task, trial, least=9.0)) == list(range(10))


def test_a_film_of_two_methods_has_a_column_for_each_and_what_was_predicted_above() -> None:
    task = dataclasses.replace(some_task("tsm/PymunkPush-v1", 2), horizon=3)
    sound = foreseen(task, random_torques(task))
    assert sound.plan is not None
    careless = dataclasses.replace(
        sound, plan=dataclasses.replace(sound.plan, states=sound.plan.states + 0.05)
    )
    film = media.compared_film(task, {TSM: sound, LSTM: careless}, 1)
    above, below = np.split(film, 2, axis=1)
    (left, right), (done, again) = (np.split(row, 2, axis=2) for row in (above, below))
    assert len(film) == 3
    np.testing.assert_array_equal(left[:, 40:], done[:, 40:])  # below the words
    np.testing.assert_array_equal(done[:, 40:], again[:, 40:])
    assert (left[:, 40:] != right[:, 40:]).any((1, 2, 3)).all()


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


def test_a_film_says_the_time_of_each_frame_and_how_far_the_target_is() -> None:
    task = dataclasses.replace(some_task(REACHER, 1), horizon=3)
    start = torch.from_numpy(task.start)[:, None].expand(-1, 3, -1)
    still = foreseen(task, zero_torques(task))
    still = dataclasses.replace(
        still, states=torch.cat([start[:, :1], start], 1)
    )  # an arm that never moves
    _, frames = np.split(media.film(task, still, 0), 2, axis=2)
    away = np.linalg.norm(task.start[0, 4:6] - task.target[0].numpy())
    where = np.s_[440:470]  # the line of text, in pixels
    for k, frame in enumerate(frames):
        told = f"{0.02 * (k + 1):.2f} s,  {1000 * away:.0f} mm away"
        drawn = render_array(task.start[0], task.env, task.target[0].numpy(), note=told)
        np.testing.assert_array_equal(frame[-480:][where], drawn[where])
    assert (frames[0] != frames[1]).any()


def test_a_film_says_no_distance_where_the_reward_knows_none() -> None:
    own = Task.from_env(REACHER, n=1, horizon=2, reward=lambda x, u: -x[..., 3].abs())
    slow = some_task(REACHER, 1).with_reward("slow", lambda x, u: -x[..., 3].abs(), horizon=2)
    for task, goal in ((own, None), (slow, slow.target[0].numpy())):
        trial = foreseen(task, zero_torques(task))
        _, frames = np.split(media.film(task, trial, 0), 2, axis=2)
        drawn = render_array(trial.states[0, 1].numpy(), task.env, goal, note="0.02 s")
        np.testing.assert_array_equal(frames[0, -480:][440:470], drawn[440:470])


def test_a_film_of_late_actions_that_nobody_planned_is_refused() -> None:
    task = dataclasses.replace(some_task(REACHER, 2), env=imperfect(REACHER, delay=DELAY))
    with pytest.raises(ValueError, match="not planned"):
        media.film(task, execute(task, zero_torques(task)), 0)
