"""The measurements behind settings run, and leave their tables."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from threading import Event, Thread
from typing import Any

import as_published
import decoders
import judge
import numpy as np
import pandas as pd
import pytest
import quality
import rows
import spent
import torch
from scripts import refused, run_script
from untrained import in_units

from tsmlib import study
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.planning.execution import execute
from tsmlib.planning.search_spaces import DirectActions
from tsmlib.planning.tasks import zero_torques
from tsmlib.storage import artifacts, manifest, tables
from tsmlib.study import runs
from tsmlib.study.results import exploration, policies
from tsmlib.study.results.exploration import PUSH
from tsmlib.training import fit as fit_module
from tsmlib.training.fit import TrainingHistory
from tsmlib.trajectory import initial_past

ARM = ["--env", "tsm/Reacher-v0"]
TRIES = [("half the batch",), ("twice the batch, half the updates",)]
TINY = {  # options, the columns that tell tries apart, and the tries
    "samples": ([*ARM, "--samples", "2", "4", "--episodes", "4"], ("samples",), [(2,), (4,)]),
    "learning_rates": ([*ARM, "--models", "onestep", "--share", "0.1"], ("rate",), [(0.005,), (0.01,), (0.02,)]),
    "budget": ([*ARM, "--stages", "1"], ("configuration",), TRIES),
    "starts": (
        ["--targets", "2", "--iterations", "1", "--weights", "1"],
        ("search_space", "start"),
        [("direct", 0), ("direct", 0.1), ("direct", 0.5), ("latent", 1)],
    ),
}


@pytest.mark.parametrize("name", TINY)
def test_the_measurement_behind_a_setting_leaves_a_row_for_each_try(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path))
    script, table = runs.ROOT / "benchmarks" / "settings" / f"{name}.py", tmp_path / "table.csv"
    options, columns, tries = TINY[name]
    run_script(script, "--scale", "smoke", "--out", str(table), *options)
    rows = tables.records(tables.load(table))
    assert sorted({tuple(row[column] for column in columns) for row in rows}) == tries
    assert len({row["metric"] for row in rows}) * len(tries) == len(rows)


def test_tries_are_trained_on_the_data_that_the_study_trains_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path))
    seen = list[int]()

    def episodes(model: Any, loss: Any, data: Any, held_out: Any, options: Any, **more: Any) -> Any:
        seen.append(len(data))
        return TrainingHistory(seconds=[0.0], step=[1], train=[0.0], validation=[0.0])

    monkeypatch.setattr(fit_module, "fit", episodes)
    for name, options in (("budget", ["--model", "rtsm", "--stages", "3"]), ("learning_rates", ["--models", "rtsm"])):
        script = runs.ROOT / "benchmarks" / "settings" / f"{name}.py"
        run_script(
            script, "--scale", "smoke", "--env", "tsm/ReacherPush-v1", "--out", str(tmp_path / "t.csv"), *options
        )
    run = runs.resolve("02_train", scale="smoke")
    assert len(study.dataset(run, "tsm/ReacherPush-v1", "train")) == 20
    assert seen == [8 * 20] * (2 * 3 + 3 * 3)
    assert len(study.training_data(run, "tsm/ReacherObstacle-v0", "prior")[0]) == 20


def table(path: Path, *values: tuple[int, float], **columns: Any) -> as_published.Found:
    row = dict(env="e", sim="mujoco", task="", model="tsm", planner="none", execution="open loop")
    rows = [row | dict(n=1, unit="", scale="paper", seed=seed, value=value) | columns for seed, value in values]
    tables.save(path, rows)
    return as_published.read(path)


def test_a_run_is_held_against_the_published_seeds_that_are_not_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    published = table(tmp_path / "all.csv", (0, 0.8), (1, 99.0), (2, 1.2), (3, 1.0), metric="ll_paper")
    for value, said in ((1.98, "0 of 1 outside"), (2.01, "1 of 1 outside"), (0.5, "of 1, 0 better")):  # 1 + 0.99
        as_published.compare(table(tmp_path / "own.csv", (1, value), metric="ll_paper"), published)
        assert said in capsys.readouterr().out
    as_published.compare(table(tmp_path / "own.csv", (1, 1.0), metric="nrmse"), published)
    assert "1 not compared" in capsys.readouterr().out


def test_returns_are_those_of_plans_and_of_policies_when_they_are_learned(tmp_path: Path) -> None:
    path, returns = tmp_path / "own.csv", dict(metric="return_true")
    assert not table(path, (1, -4.0), **returns, iteration=3)
    assert not table(path, (1, -4.0), **returns, model="oracle", planner="cem")
    rows = [
        dict(env="e", sim="mujoco", task="", model="tsm", planner="policy", search_space="latent", n=1,
             iteration=updates, execution="policy", unit="", scale="paper", seed=1, value=value, copy=copy, **returns)
        for updates, copy, value in ((0, 0, -9.0), (0, 1, -9.0), (20, 0, -4.0), (20, 1, -2.0))
    ]  # fmt: skip
    tables.save(path, rows, extra=["copy"])
    assert [list(seeds.values()) for seeds in as_published.read(path).values()] == [[-3.0]]


def test_what_a_run_has_spent_is_told_by_headers_and_a_closed_loop_counts_its_own_seconds(tmp_path: Path) -> None:
    def kept(file: str, seconds: float, **header: Any) -> None:
        path = tmp_path / f"{file}.safetensors"
        artifacts.save(path, {"x": np.zeros(1, np.float32)}, kind="any", header={"seconds": seconds, **header})

    arm = {"env": "tsm/Reacher-delay5-v0"}
    kept("models/Reacher-delay5/lstm", 1.0, fingerprint=arm, model="lstm")
    kept("models/Reacher-delay5/policy-ensemble+mse-latent", 2.0, fingerprint=arm, model="ensemble+mse",
         search_space="latent")  # fmt: skip
    for file, seconds, posed in (
        ("Reacher-delay5-oracle-latent-cem", 3.0, dict(every=0, iterations=10)),
        ("Reacher-delay5-ensemble+mse-latent-adam+starts", 4.0, dict(every=0, iterations=100)),
        ("Reacher-delay5-ensemble+mse-latent-adam+starts-every10", 10.0, dict(every=10, iterations=20)),
        ("Reacher-delay5-tsm-latent-adam-500", 5.0, dict(every=0, iterations=500)),
    ):
        kept(f"plans/{file}", seconds, made_from=arm | posed)
    assert sorted(spent.costs(tmp_path)) == [
        ("models", "Reacher-delay5", 1.0),
        ("plans", "adam", 5.0),
        ("plans", "adam+starts", 4.0),
        ("plans", "adam+starts, every 10 steps", 6.0),
        ("plans", "oracle", 3.0),
        ("policies", "ensemble+mse, latent", 2.0),
    ]


@pytest.mark.parametrize(("options", "said"), [
    (["--scale", "foo"], "scale is 'foo', expected one of smoke, laptop, paper"),
    (["--envs", "foo"], "'foo' is none of tsm/Reacher-v0"),
    (["--models", "prior"], "invalid choice: 'prior' (choose from 'tsm', 'rtsm'"),
    (["--model-seed", "1000002"], "seed 1000002 draws held-out episodes or targets"),
])  # fmt: skip
def test_judges_are_refused_models_that_cannot_be_before_any_work(
    options: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path))
    assert said in refused(runs.ROOT / "benchmarks" / "settings" / "judge.py", *options)
    assert not list(tmp_path.iterdir())


def test_what_a_candidate_is_judged_by_is_measured_open_and_closed_loop(tmp_path: Path) -> None:
    torch.manual_seed(0)
    task = dataclasses.replace(study.load_task("tsm/ReacherPush-v1", "validation").take(2), horizon=20)
    model, space = RecurrentTSM(10, 2, hidden=8), DirectActions(20)
    model.features.step_std.fill_(0.01)
    rows = []
    names = ("mode", "mean of 2", "fresh mean of 2", "median of 6", "mode and mean of 2", "screened mean of 4")
    for name in names:
        way = judge.Way(name, seed=0, candidates=4, iterations=2, again=1)
        rows += [
            {"env": task.env, "model": "rtsm", "model_seed": "0"} | row
            for row in judge.measured(task, model, space, way, closed=True)
        ]
    judge.write(tmp_path / "judge.csv", judge.with_differences(rows))
    found = judge.read(tmp_path / "judge.csv")
    assert [row["closed"] for row in found] == 6 * ["0", "1"]
    shown = judge.summary(found, 2)
    assert shown["judge"].tolist() == list(names)
    assert float(shown["minus the mode's"][1]) == pytest.approx(float(found[2]["more_than_mode"]), abs=0.006)
    mode, other = (np.array(found[i]["costs"].split(), float) for i in (0, 2))
    assert float(found[2]["more_than_mode"]) == pytest.approx(float((other - mode).mean()), rel=0.01, abs=1e-3)
    study_way = [row | {"judge": judge.STUDY} for row in found if row["judge"] == "mean of 2"]
    (line,) = judge.against([*found, *study_way], 2).to_dict("records")
    assert (line["model"], line["minus"], line["seeds"]) == ("rtsm", "rtsm", 1)
    assert float(line["cost (m)"].split()[0]) == pytest.approx(float(found[2]["more_than_mode"]), abs=0.006)
    with pytest.raises(ValueError, match="no open-loop lines of 100 targets; there are lines of 2"):
        judge.summary(found, 100)
    (zero,) = judge.reference("zero", task, space, way)
    still = execute(task, zero_torques(task))
    assert [float(cost) for cost in zero["costs"].split()] == pytest.approx((-still.executed_return).tolist(), abs=1e-3)
    (tmp_path / "judge.csv").write_text("model,judge\nrtsm,mode\n")
    with pytest.raises(ValueError, match="has no columns .*; name another table with --out"):
        judge.read(tmp_path / "judge.csv")


def test_fresh_samples_are_common_to_a_population_and_new_in_the_next() -> None:
    torch.manual_seed(0)
    model, past = in_units(RecurrentTSM(10, 2, hidden=8)), initial_past(torch.zeros(2, 10), 10, 2)
    fresh = judge.judged_by("fresh mean of 2", 3)(model, past, seed=0)
    actions = torch.zeros(1, 2, 20, 2)
    start, *first = (fresh(actions) for _ in range(5))  # the start, three candidates and their mean
    again = fresh(actions)
    for states in first[1:]:
        assert torch.equal(states, first[0])
    assert not torch.equal(start, first[0])
    assert not torch.equal(again, first[0])


def test_rows_take_the_place_of_those_of_the_same_model_and_method() -> None:
    row = dict(env="e", sim="mujoco", model="tsm", planner="cem", execution="open loop", seed=0, scale="paper")
    row |= dict(metric="cost", value=1.0, n=2)
    published = tables.frame([row, {**row, "model": "lstm"}, {**row, "seed": 1}])
    found = rows.merged(published, [{**row, "value": 2.0}, {**row, "value": 3.0, "metric": "gap"}])
    kept = {(line["model"], line["seed"], line["metric"]): line["value"] for line in tables.records(found)}
    assert kept == {("tsm", 0, "cost"): 2, ("tsm", 0, "gap"): 3, ("lstm", 0, "cost"): 1, ("tsm", 1, "cost"): 1}


def test_commands_that_publish_side_by_side_lose_no_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows, "RESULTS", tmp_path / "results")
    row, read = dict(env="e", model="tsm", metric="cost", value=1.0, n=2, scale="paper"), Event()

    def slow(table: pd.DataFrame) -> pd.DataFrame:
        read.set()
        time.sleep(0.3)
        return table

    other = Thread(target=lambda: rows.publish("some", [dict(row, seed=1)], told=slow))
    other.start()
    assert read.wait(20)
    rows.publish("some", [dict(row, seed=0)])
    other.join()
    assert sorted(tables.load(tmp_path / "results" / "some.csv")["seed"]) == [0, 1]
    assert manifest.verify(tmp_path) == [tmp_path / "results" / "some.csv", tmp_path / "MANIFEST.json"]


def test_rows_of_a_metric_leave_those_of_another_and_a_learning_curve_is_replaced_as_a_whole() -> None:
    plan = dict(env="e", model="tsm", planner="adam", execution="open loop", seed=0, scale="paper", value=1.0, n=2)
    policy = dict(plan, planner="policy", metric="return_true")
    published = tables.frame([dict(plan, metric="cost"), *(dict(policy, iteration=i) for i in (220, 440))])
    new = [dict(plan, metric="gradient_snr"), *(dict(policy, iteration=i) for i in (88, 176))]
    found = [(line["metric"], line["iteration"]) for line in tables.records(rows.merged(published, new))]
    assert found == [("cost", ""), ("gradient_snr", ""), ("return_true", 88), ("return_true", 176)]


def test_early_records_stand_beside_their_curve() -> None:
    policy = dict(env="e", model="tsm", planner="policy", metric="return_true", seed=0, scale="paper", value=1.0, n=2)
    published = tables.frame([dict(policy, iteration=220), dict(policy, iteration=10, subset="early")])
    new = [dict(policy, iteration=22, subset="early", value=2.0)]
    found = [(line["iteration"], line["value"]) for line in tables.records(rows.merged(published, new))]
    assert found == [(220, 1.0), (22, 2.0)]
    longer = [dict(policy, iteration=i, value=3.0) for i in (220, 440)]  # another curve, of which they tell nothing
    found = [(line["iteration"], line["value"]) for line in tables.records(rows.merged(published, longer))]
    assert found == [(220, 3.0), (440, 3.0)]


@pytest.mark.parametrize("seed", range(5))
def test_what_ships_of_plateaus_is_what_the_curves_that_ship_say(seed: int) -> None:
    published = tables.load(runs.RESULTS / "05_control.csv")
    run = runs.resolve("05_control", scale="paper", seed=seed)
    again = rows.with_plateaus(published, run, ["tsm/Reacher-v0", PUSH])
    assert len(again) == len(published)
    key = ["env", "model", "search_space", "seed", "metric"]
    before, after = (
        table[table["metric"].isin(policies.SOONEST)].set_index(key)["value"].sort_index()
        for table in (published, again)
    )
    pd.testing.assert_series_equal(before, after)


def test_rows_without_a_configuration_replace_those_without_one_in_a_table_that_has_some() -> None:
    row = dict(env="e", model="tsm", metric="cost", value=1.0, n=2, seed=0, scale="paper")
    published = tables.frame([row, dict(row, configuration="codes")])
    found = tables.records(rows.merged(published, [dict(row, value=2.0)]))
    assert [(line["configuration"], line["value"]) for line in found] == [("codes", 1.0), ("", 2.0)]


def test_a_loop_of_rounds_that_is_made_again_takes_the_place_of_all_its_former_rows() -> None:
    loop = dict(env=PUSH, model="rtsm", configuration=exploration.PLANNED, seed=0, scale="paper", n=2)
    closed = dict(loop, planner="cem", execution="closed loop")
    adapted = dict(loop, planner="none", execution="open loop", configuration="all", env_steps=2000, metric="nrmse")
    former = [
        *(dict(closed, iteration=k, env_steps=500 + 100 * k, metric="return_true", value=1.0) for k in range(3)),
        dict(loop, planner="none", subset="data", iteration=2, env_steps=700, metric="contact_share", value=1.0),
        dict(closed, execution="open loop", subset=exploration.LAST_PRIOR, iteration=4, env_steps=700,
             metric="return_true", value=1.0),
    ]  # fmt: skip
    others = [
        dict(adapted, value=1.0), *(dict(former[0], **{name: other}) for name, other in (
            ("seed", 1), ("model", "lstm"), ("configuration", exploration.RANDOM), ("env", "Pendulum-v1"),
        )),
    ]  # fmt: skip
    steps = {0: 500, 1: 590, 2: 690}  # round 1 lost an episode, and after round 2 all that measure were lost
    new = [dict(closed, iteration=k, env_steps=n, metric="success", value=0.0) for k, n in steps.items()]
    new += [dict(closed, iteration=k, env_steps=steps[k], metric="return_true", value=2.0) for k in (0, 1)]
    published = tables.frame([*former, *others])
    found = tables.frame(rows.merged(rows.without_loops(published, new), new))
    assert len(found) == len(others) + len(new)
    assert sorted(found["value"]) == [0, 0, 0, *[1] * len(others), 2, 2]
    assert "+0.0" in exploration.differences_table(found)
    with pytest.raises(ValueError, match="duplicate"):
        exploration.differences_table(tables.frame(rows.merged(published, new)))


def test_lines_are_compared_target_by_target_with_the_same_targets_only() -> None:
    about = {"env": "e", "within_5cm": "0.5", "cost_sem": "1", "gap_judge": "0", "split": "validation"}
    lines = pd.DataFrame([
        {"name": "ours", "cost": "10.0", "costs": "9 11", **about},
        {"name": "worse", "cost": "13.0", "costs": "12 14", **about},
        {"name": "better", "cost": "9.5", "costs": "8.5 10.5", **about},
        {"name": "other targets", "cost": "1", "costs": "1", **about},
        {"name": "frozen targets", "cost": "1", "costs": "1 1", **about, "split": "test"},
    ])  # fmt: skip
    found = decoders.compared(lines, "ours").set_index("judged by")["cost of ours minus this"]
    assert found.to_dict() == {"better": "+0.50", "ours": "", "worse": "-3.00"}


def test_a_doubling_of_the_training_time_is_read_from_neighbouring_lines_of_a_model() -> None:
    about = {"env": "e", "model": "ours"}
    values = {400: 1.0, 100: 4.0}
    lines = pd.DataFrame([about | {"seconds": s} | dict.fromkeys(quality.MEASURES, v) for s, v in values.items()])
    found = quality.doublings(lines)
    assert (found["from"].item(), found["to"].item()) == (100, 400)
    assert np.allclose(found[list(quality.MEASURES)], -0.5)


def test_what_doublings_bring_is_continued_by_the_factor_by_which_it_fell() -> None:
    values = {100: 16.0, 400: 4.0, 1600: 2.0}  # halved by each doubling, then by the root of a half
    lines = pd.DataFrame([{"model": "slower", "seconds": s, "energy": v} for s, v in values.items()])
    steady = pd.DataFrame([{"model": "steady", "seconds": s, "energy": 1 / s} for s in values])
    found = quality.further(pd.concat([lines, steady]), "energy", times=(4, 16))
    assert found["model"].tolist() == ["slower", "slower"]
    assert found["seconds"].tolist() == [6400, 25600]
    assert np.allclose(found[quality.MEASURES["energy"]], [2**0.5, 2**0.25])
    assert np.allclose(found["a doubling there"], [2**-0.25 - 1, 2**-0.125 - 1])


def test_a_line_without_violations_is_spelled_without_them() -> None:
    line = {"env": "e", "model": "tsm", "seconds": 80, "cpu_seconds": 70, "updates": 9, "coverage80": 0.8}
    line |= {"muon": 0.0, "decay": 0.0}
    whole = pd.DataFrame([line | dict.fromkeys([*quality.MEASURES, "within"], 0.5)])
    violations = quality.MEASURES["violations"]
    assert violations in quality.spelled(whole)
    assert violations not in quality.spelled(whole.assign(violations=float("nan")))


def test_models_with_codes_are_set_against_the_best_baseline_that_was_trained_as_long() -> None:
    trained = [("tsm", 580, 0.3), ("lstm", 580, 0.4), ("onestep", 580, 0.2), ("tsm", 2320, 0.1), ("lstm", 2320, 0.2)]
    about = [{"env": "e", "model": model, "seconds": s} | dict.fromkeys(quality.SCORES, x) for model, s, x in trained]
    found = quality.over_the_best(pd.DataFrame(about))
    for name in quality.SCORES:
        assert found[quality.MEASURES[name]].tolist() == ["1.50 (onestep)", "0.50 (lstm)"]


def test_the_stamp_of_the_figure_says_its_seeds_networks_episodes_and_targets() -> None:
    about = {"env": "tsm/ReacherPush-v1", "targets": 100, "muon": 0.01, "decay": 0.0}
    trained = [("lstm", 580, 0), ("tsm", 580, 0), ("lstm", 2320, 0), *(("tsm", 2320, seed) for seed in (0, 2, 1))]
    lines = pd.DataFrame([about | {"model": model, "seconds": s, "seed": seed} for model, s, seed in trained])
    rest = "; one network each; predictions: n = 200 fresh episodes, plans and violations: n = 100 validation targets"
    assert quality.stamp(lines) == (
        f"ReacherPush, training seed 0; small marks: the other training seeds of 0, 1, 2, after 2320 s, of TSM{rest}"
    )
    assert quality.stamp(lines[lines["seed"] == 0]) == f"ReacherPush, training seed 0{rest}"


def test_networks_that_judge_together_are_set_against_the_same_networks_one_by_one() -> None:
    about = {
        "env": "e", "within_5cm": "0.5", "gap_judge": "0.3", "costs": "1 2", "split": "validation", "decoders": "2",
        "seconds": "580 580", "muons": "0.02 0.02",
    }  # fmt: skip
    lines = pd.DataFrame([
        {"models": "lstm lstm", "seeds": "0 1", **about},
        {"models": "lstm tsm", "seeds": "0 0", **about},  # of two kinds
        {"models": "lstm lstm", "seeds": "1 1", **about},  # one training twice
        {"models": "lstm lstm", "seeds": "0 1", **about, "split": "test"},
        {"models": "lstm lstm", "seeds": "0 1", **about, "costs": "1 2 3"},  # of other targets
        {"models": None, "seeds": None, **about},
    ])  # fmt: skip
    kind = {"env": "e", "model": "lstm", "seconds": 580, "muon": 0.02, "decay": 0.0, "within": 0.5}
    singles = pd.DataFrame([
        kind | {"seed": seed, "costs": costs}
        for seed, costs in ((0, "2 3"), (1, "4 7"))
    ])  # fmt: skip
    (line,) = decoders.alone(lines, singles).to_dict("records")
    assert (line["model"], line["networks"], line["one by one"], line["together"]) == ("lstm", 2, "4.00", "1.50")
    assert line["difference"].startswith("-2.50 ± ")
    with pytest.raises(ValueError, match=r"quality.csv has no line of .*'lstm', 2, 580"):
        decoders.alone(lines[:1].assign(seeds="0 2"), singles)


def test_trainings_of_several_seeds_are_told_apart_seed_by_seed() -> None:
    scores = {
        ("tsm", 0): 1.0,
        ("tsm", 1): 2.0,
        ("lstm", 0): 2.0,
        ("lstm", 1): 4.0,
        ("lstm", 2): 9.0,
        ("onestep", 0): 7.0,
    }
    columns = [*quality.MEASURES, "coverage80", "within"]
    lines = quality.several(pd.DataFrame([
        {"env": "e", "model": model, "seconds": 580, "muon": 0.01, "decay": 0.0, "seed": seed}
        | dict.fromkeys(columns, score)
        for (model, seed), score in scores.items()
    ]))  # fmt: skip
    assert quality.over_seeds(lines)["seeds"].tolist() == [3, 2]  # the one-step model was trained once
    (pair,) = quality.against_baselines(lines).to_dict("records")
    assert (pair["model"], pair["against"], pair["seeds"]) == ("tsm", "lstm", 2)
    assert pair["gap (m), ratio"] == "0.50"
    assert pair["cost, difference"].startswith("-1.50 ± ")


def test_a_shipped_model_gets_one_line_of_quality_however_often_it_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path))
    script = runs.ROOT / "benchmarks/settings/quality.py"
    model = runs.ROOT / "data/pretrained/Reacher/onestep.safetensors"
    options = ["--targets", "2", "--episodes", "4", "--out", str(tmp_path / "quality.csv")]
    for _ in range(2):
        run_script(script, "measure", str(model), *options)
    line = pd.read_csv(tmp_path / "quality.csv")
    assert line[["model", "seconds"]].to_numpy().tolist() == [["onestep", 320]]
    assert np.isfinite(line[["energy_10", "nrmse_80", "cost", "gap"]].to_numpy()).all()
    assert "| onestep" in run_script(script, "table", *options)
