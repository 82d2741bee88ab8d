"""Rows of the scoreboard say what the scores say, and pairs, curves and tables say what the rows say."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from tsmlib import study
from tsmlib.evaluation import contacts, prediction
from tsmlib.storage import artifacts, manifest, tables
from tsmlib.study.results import prediction as prediction_results
from tsmlib.study.runs import Run, RunError

ENV = "tsm/ReacherPush-v0"
N, T, D = 6, 90, 4


def scores(n: int, steps: int, level: float = 0.0) -> prediction.Scores:
    """Scores that grow by one per step, from ``level`` on; the truth lies at the median."""
    ramp = level + torch.arange(1.0, steps + 1).expand(n, -1)
    values = {metric: ramp.clone() for metric in ("ll_paper", "energy_score_noise")} | {"squared_error": ramp.square()}
    fitted = prediction.Fitted(0.1, 0.1, torch.ones(steps, D), torch.ones(steps, D), 0.1)
    outside = torch.zeros(n)
    outside[0] = 0.5
    return prediction.Scores(values, torch.full((n, steps, D), 0.5), outside, fitted)


@pytest.fixture(scope="module")
def found() -> list[dict]:
    test = study.random_data(ENV, N, seed=0)
    rows = []
    for seed in (0, 1, 2):
        for model, level in (("tsm", 0.0), ("lstm", 10.0 + seed)):
            pair = scores(N, T, level), scores(N * len(prediction_results.SEGMENTS), 10, level)
            rows += prediction_results.rows(ENV, model, *pair, test, seed=seed, scale="smoke")
    return rows


def test_a_row_without_horizon_is_the_mean_over_all_steps(found: list[dict]) -> None:
    assert prediction_results.values(found, "ll_paper", env=ENV)["tsm"] == pytest.approx([45.5] * 3)
    steps = torch.arange(1.0, 91)
    assert prediction_results.values(found, "nrmse", env=ENV)["tsm"][0] == pytest.approx(
        steps.square().mean().sqrt().item()
    )
    assert prediction_results.values(found, "ll_paper", env=ENV, condition="segments")["tsm"] == pytest.approx(
        [5.5] * 3
    )


def test_a_row_with_a_horizon_is_the_score_at_that_step(found: list[dict]) -> None:
    for h in prediction_results.HORIZONS:
        assert prediction_results.values(found, "ll_paper", env=ENV, horizon=h)["lstm"] == pytest.approx(
            [10 + h, 11 + h, 12 + h]
        )


def test_contact_rows_average_from_the_first_touch_on(found: list[dict]) -> None:
    test = study.random_data(ENV, N, seed=0)
    after = contacts.after_first(prediction_results.touches(test, scores(N, T)))
    assert after.any()
    assert not after.all()
    expected = torch.arange(1.0, 91).expand(N, -1)[after].mean().item()
    assert prediction_results.values(found, "ll_paper", env=ENV, condition="contact")["tsm"] == pytest.approx(
        [expected] * 3
    )
    n = {row.get("horizon", ""): row["n"] for row in found if row["condition"] == "contact"}
    assert n[""] == n[90] == int(after.any(1).sum())
    assert n.get(1, 0) == int(after[:, 0].sum())


def test_what_touches_is_told_by_true_states() -> None:
    noisy = study.random_data("tsm/ReacherPush-noise0.25-v0", 2, seed=0)
    with pytest.raises(ValueError, match=r"noisy states of tsm/ReacherPush-noise0.25-v0 do not tell what touches"):
        prediction_results.rows(
            noisy.env, "tsm", scores(2, T), scores(2 * len(prediction_results.SEGMENTS), 10), noisy, seed=0
        )


def test_the_share_of_diverged_rollouts_is_a_row(found: list[dict]) -> None:
    assert prediction_results.values(found, "diverged", env=ENV)["tsm"] == pytest.approx([0.5 / N] * 3)


def test_differences_are_paired_by_seed(found: list[dict]) -> None:
    difference = prediction_results.paired(found, "tsm", "ll_paper", env=ENV)
    assert list(difference) == ["lstm"]
    np.testing.assert_allclose(difference["lstm"], [-10, -11, -12])
    fewer = [row for row in found if (row["model"], row["seed"]) != ("tsm", 1)]
    np.testing.assert_allclose(prediction_results.paired(fewer, "tsm", "ll_paper", env=ENV)["lstm"], [-10, -12])


def test_curves_pass_through_the_rows(found: list[dict]) -> None:
    curves = prediction_results.curves(found, "ll_paper", env=ENV)
    assert curves["lstm"].shape == (3, 90)
    np.testing.assert_allclose(curves["tsm"][0], np.arange(1, 91), rtol=1e-6)


def test_a_truth_at_the_median_is_within_every_central_interval(found: list[dict]) -> None:
    np.testing.assert_allclose(prediction_results.calibration(found, env=ENV)["tsm"], 1.0)


def test_the_table_gives_mean_and_half_of_the_interval(found: list[dict]) -> None:
    table = prediction_results.board(found, ("ll_paper",), env=ENV, horizons=(10,))
    half = 4.303 * 1 / math.sqrt(3)
    assert table.splitlines()[0] == "| model | ll_paper at 10 |"
    assert f"| lstm | 21 ± {half:.2g} |" in table
    one = [row for row in found if row["seed"] == 0]
    assert "| lstm | 20 |" in prediction_results.board(one, ("ll_paper",), env=ENV, horizons=(10,))


def test_an_arm_alone_has_no_rows_of_contact() -> None:
    env = "tsm/Reacher-v0"
    test = study.random_data(env, 2, seed=0)
    rows = prediction_results.rows(
        env, "tsm", scores(2, T), scores(2 * len(prediction_results.SEGMENTS), 10), test, seed=0, scale="smoke"
    )
    assert {row["condition"] for row in rows} == {"clean", "segments"}


# Scores at a scale ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return Run("03_predict", "smoke", 0, tmp_path_factory.mktemp("run"))


@pytest.mark.parametrize("model", ["lstm", "ensemble"])
@pytest.mark.parametrize("segments", [False, True])
def test_scores_are_found_again_as_they_were(run: Run, model: str, segments: bool, monkeypatch) -> None:
    first = study.scores(run, ENV, model, segments=segments)
    monkeypatch.setattr(prediction, "score", None)  # nothing is computed again
    second = study.scores(run, ENV, model, segments=segments)
    assert first.values.keys() == second.values.keys()
    assert all(torch.equal(first.values[metric], second.values[metric]) for metric in first.values)
    assert torch.equal(first.pit, second.pit)
    assert torch.equal(first.outside, second.outside)
    assert math.isclose(first.fitted.shared, second.fitted.shared, rel_tol=1e-6)
    assert torch.equal(first.fitted.own, second.fitted.own)


def test_scores_of_other_weights_are_not_taken(run: Run) -> None:
    before = study.scores(run, ENV, "lstm").values["ll_paper"]
    path = run.models / study.short(ENV) / "lstm.safetensors"
    net, header = study.load_or_train(run, ENV, "lstm")
    with torch.no_grad():
        net.out.bias += 0.1
    artifacts.save_model(
        path, net, {k: header[k] for k in ("fingerprint", "model", "seed", "scale", "curves", "seconds")}
    )
    assert not torch.equal(study.scores(run, ENV, "lstm").values["ll_paper"], before)


def test_scores_of_another_version_are_not_taken(run: Run, monkeypatch) -> None:
    study.scores(run, ENV, "ensemble")
    monkeypatch.setattr(prediction, "VERSION", prediction.VERSION + 1)
    monkeypatch.setattr(prediction, "score", None)
    with pytest.raises(TypeError):
        study.scores(run, ENV, "ensemble")


def test_at_scale_laptop_an_environment_that_is_not_published_shows_its_own_rows(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(study.predictions, "RESULTS", tmp_path)
    row = dict(sim="mujoco", model="tsm", metric="nrmse", condition="clean", value=1.0, n=1, seed=0, scale="paper")
    tables.save_table(tmp_path / "03_predict.csv", [dict(row, env="tsm/Reacher-v0")])
    own = [dict(row, env=env, value=2.0) for env in ("tsm/Reacher-v0", "tsm/PymunkPush-v0")]
    drawn = study.evidence(Run("03_predict", "laptop", 0, tmp_path / "seed0"), own)
    assert {r["env"]: r["value"] for r in drawn} == {"tsm/Reacher-v0": 1.0, "tsm/PymunkPush-v0": 2.0}
    assert study.evidence(Run("03_predict", "smoke", 0, tmp_path / "seed0"), own) == own


def test_at_scale_paper_the_other_seeds_are_drawn_too_once_they_are_complete(tmp_path) -> None:
    row = dict(env=ENV, sim="mujoco", model="tsm", metric="nrmse", condition="clean", value=1.0, n=1, scale="paper")
    tables.save_table(tmp_path / "seed1" / "metrics" / "03_predict.csv", [dict(row, seed=1)])
    run, own = Run("03_predict", "paper", 0, tmp_path / "seed0"), [dict(row, seed=0)]
    with pytest.raises(RunError, match="03_predict in .*seed1 is not run, expected complete. Run it: .* --seed 1"):
        study.evidence(run, own)
    manifest.write_json(tmp_path / "seed1" / "status.json", {"03_predict": {"state": "complete"}})
    assert [r["seed"] for r in study.evidence(run, own)] == [0, 1]
