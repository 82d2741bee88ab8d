"""Rows say what the scores say, and pairs, curves and tables say what the rows say."""

from __future__ import annotations

import math
import re

import numpy as np
import pandas as pd
import pytest
import torch

from tsmlib import study
from tsmlib.evaluation import contacts, prediction
from tsmlib.storage import tables
from tsmlib import zoo
from reproduction.results import prediction as prediction_results

ENV = "tsm/ReacherPush-v1"
N, T, D = 6, 90, 4
TSM, LSTM = zoo.method("tsm"), zoo.method("lstm")


def scores(n: int, steps: int, level: float = 0.0) -> prediction.Scores:
    """Scores that grow by one per step, from ``level`` on; the truth lies at the median."""
    ramp = level + torch.arange(1.0, steps + 1).expand(n, -1)
    values = {metric: ramp.clone() for metric in ("ll_paper", "ll_own", "energy_score_noise")} | {
        "squared_error": ramp.square()
    }
    fitted = prediction.Fitted(0.1, 0.1, torch.ones(steps, D), torch.ones(steps, D), 0.1)
    outside = torch.zeros(n)
    outside[0] = 0.5
    return prediction.Scores(values, torch.full((n, steps, D), 0.5), outside, fitted)


@pytest.fixture(scope="module")
def found() -> pd.DataFrame:
    test = study.random_data(ENV, N, seed=0)
    rows = []
    for seed in (0, 1, 2):
        for model, level in (("tsm", 0.0), ("lstm", 10.0 + seed)):
            pair = scores(N, T, level), scores(N * len(prediction_results.SEGMENTS), 10, level)
            rows += prediction_results.rows(ENV, model, *pair, test, seed=seed, scale="smoke")
    return tables.frame(rows)


def test_a_row_without_steps_ahead_is_the_mean_over_all_steps(found: pd.DataFrame) -> None:
    assert prediction_results.values(found, "ll_paper", env=ENV)["tsm"] == pytest.approx([45.5] * 3)
    steps = torch.arange(1.0, 91)
    assert prediction_results.values(found, "nrmse", env=ENV)["tsm"][0] == pytest.approx(
        steps.square().mean().sqrt().item()
    )
    assert prediction_results.values(found, "ll_paper", env=ENV, execution="segments")[
        "tsm"
    ] == pytest.approx([5.5] * 3)


def test_a_log_score_stands_with_and_without_the_episodes_in_which_it_is_worst() -> None:
    test, n = study.random_data(ENV, 40, seed=0), 40
    missed = scores(n, T)
    missed.values["ll_own"][:2] = -1000.0  # two of forty
    pair = missed, scores(n * len(prediction_results.SEGMENTS), 10)
    rows = tables.frame(prediction_results.rows(ENV, "tsm", *pair, test, seed=0, scale="smoke"))
    whole = prediction_results.values(rows, "ll_own", env=ENV)["tsm"]
    assert whole == pytest.approx([(38 * 45.5 - 2 * 1000) / 40])
    trimmed = prediction_results.select(rows, "ll_own", env=ENV, subset=prediction_results.TRIMMED)
    assert trimmed[["value", "n"]].to_numpy().tolist() == [[45.5, 38]]
    titles, _, line = prediction_results.own_density_table(rows, [ENV]).splitlines()
    assert [cell.strip() for cell in titles.split("|")[2:4]] == [
        "ReacherPush: all episodes",
        "ReacherPush: without the worst 5 %",
    ]
    assert [cell.strip() for cell in line.split("|")[1:4]] == ["tsm", "-6.78", "45.5"]


def test_a_row_with_steps_ahead_is_the_score_at_that_step(found: pd.DataFrame) -> None:
    for h in prediction_results.HORIZONS:
        assert prediction_results.values(found, "ll_paper", env=ENV, steps_ahead=h)[
            "lstm"
        ] == pytest.approx([10 + h, 11 + h, 12 + h])


def test_contact_rows_average_from_the_first_touch_on(found: pd.DataFrame) -> None:
    test = study.random_data(ENV, N, seed=0)
    after = contacts.after_first(contacts.contact_steps(test.states, ENV))[
        :, 10:
    ]  # also touches before step 10
    assert after.any()
    assert not after.all()
    expected = torch.arange(1.0, 91).expand(N, -1)[after].mean().item()
    assert prediction_results.values(found, "ll_paper", env=ENV, subset="contact")[
        "tsm"
    ] == pytest.approx([expected] * 3)
    where = dict(env=ENV, subset="contact", steps_ahead=[None, 1, 90])
    contact = prediction_results.select(found, "ll_paper", **where).drop_duplicates("steps_ahead")
    n = dict(zip(contact["steps_ahead"].fillna(0), contact["n"], strict=True))
    assert n[0] == n[90] == int(after.any(1).sum())
    assert n.get(1, 0) == int(after[:, 0].sum())


def test_a_touch_before_the_prediction_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    test, steps = study.random_data(ENV, 2, seed=0), torch.zeros(2, 100, dtype=torch.bool)
    steps[0, 3], steps[1, 50] = True, True
    monkeypatch.setattr(prediction_results, "contact_steps", lambda *_: steps)
    assert prediction_results.since_touch(test, scores(2, T)).sum(1).tolist() == [90, 50]


def test_what_touches_is_told_by_true_states() -> None:
    noisy = study.random_data("tsm/ReacherPush-noise0.25-v1", 2, seed=0)
    with pytest.raises(
        ValueError, match=r"noisy states of tsm/ReacherPush-noise0.25-v1 do not tell what touches"
    ):
        prediction_results.rows(
            noisy.env,
            "tsm",
            scores(2, T),
            scores(2 * len(prediction_results.SEGMENTS), 10),
            noisy,
            seed=0,
        )


def test_the_share_of_diverged_rollouts_is_a_row(found: pd.DataFrame) -> None:
    assert prediction_results.values(found, "diverged", env=ENV)["tsm"] == pytest.approx(
        [0.5 / N] * 3
    )


def test_differences_are_paired_by_seed(found: pd.DataFrame) -> None:
    difference = prediction_results.paired(found, "tsm", "ll_paper", env=ENV)
    assert list(difference) == [LSTM]
    np.testing.assert_allclose(difference[LSTM], [-10, -11, -12])
    fewer = found[(found["model"] != "tsm") | (found["seed"] != 1)]
    np.testing.assert_allclose(
        prediction_results.paired(fewer, "tsm", "ll_paper", env=ENV)[LSTM], [-10, -12]
    )


def test_a_score_stands_over_that_of_the_best_other_model_of_the_same_seed() -> None:
    scored = {
        (0, "rtsm"): 1.0,
        (0, "lstm"): 2.0,
        (0, "onestep"): 4.0,
        (1, "rtsm"): 3.0,
        (1, "lstm"): 4.0,
        (2, "lstm"): 1.0,
    }
    rows = [
        dict(
            env=ENV,
            model=model,
            seed=seed,
            metric="crps",
            execution="open loop",
            steps_ahead=10,
            value=value,
        )
        for (seed, model), value in scored.items()
    ]
    told = prediction_results.over_the_best(
        tables.frame(rows), "rtsm", "crps", env=ENV, steps_ahead=[10]
    )
    assert told.to_dict("list") == {"seed": [0, 1], "at 10 steps": ["0.50 (LSTM)", "0.75 (LSTM)"]}


def test_curves_pass_through_the_rows(found: pd.DataFrame) -> None:
    curves = prediction_results.curves(found, "ll_paper", env=ENV)
    assert curves[LSTM].shape == (3, 90)
    np.testing.assert_allclose(curves[TSM][0], np.arange(1, 91), rtol=1e-6)


def test_a_truth_at_the_median_is_within_every_central_interval(found: pd.DataFrame) -> None:
    np.testing.assert_allclose(prediction_results.calibration(found, env=ENV)[TSM], 1.0)


def test_the_table_gives_mean_and_half_of_the_interval(found: pd.DataFrame) -> None:
    def lines(rows: pd.DataFrame) -> list[str]:
        text = prediction_results.scores_table(rows, ("ll_paper",), env=ENV, steps_ahead=(10,))
        return [re.sub(" +", " ", line) for line in text.splitlines()]

    half = 4.303 * 1 / math.sqrt(3)
    assert lines(found)[0] == "| model | ll_paper at 10 |"
    assert f"| lstm | 21 ± {half:.2g} |" in lines(found)
    assert "| lstm | 20 |" in lines(found[found["seed"] == 0])
    assert "| tsm (seeds: 1) | 10 |" in lines(
        found[(found["model"] == "lstm") | (found["seed"] == 0)]
    )


def test_a_number_that_stands_twice_is_refused(found: pd.DataFrame) -> None:
    with pytest.raises(ValueError, match="ll_paper of tsm stands twice for seed 0"):
        prediction_results.values(pd.concat([found, found]), "ll_paper", env=ENV)


def test_rows_of_an_imperfect_arm_are_told_from_those_of_the_plain_one() -> None:
    late = "tsm/Reacher-delay5-v0"
    test = study.random_data(late, N, seed=0)
    rows = []
    for env, level in (("tsm/Reacher-v0", 0.0), (late, 1.0)):
        pair = scores(N, T, level), scores(N * len(prediction_results.SEGMENTS), 10, level)
        rows += prediction_results.rows(env, "tsm", *pair, test, seed=0, scale="smoke")
    found = tables.frame(rows)
    assert set(found["env"]) == {"tsm/Reacher-v0"}
    assert prediction_results.values(found, "ll_paper", env="tsm/Reacher-v0")[
        "tsm"
    ] == pytest.approx([45.5])
    assert prediction_results.values(found, "ll_paper", env=late)["tsm"] == pytest.approx([46.5])


def test_an_arm_alone_has_no_rows_of_contact() -> None:
    env = "tsm/Reacher-v0"
    test = study.random_data(env, 2, seed=0)
    rows = prediction_results.rows(
        env,
        "tsm",
        scores(2, T),
        scores(2 * len(prediction_results.SEGMENTS), 10),
        test,
        seed=0,
        scale="smoke",
    )
    assert {(row["execution"], row.get("subset", "")) for row in rows} == {
        ("open loop", ""),
        ("segments", ""),
        ("open loop", prediction_results.TRIMMED),
    }
