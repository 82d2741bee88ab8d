"""Torques that are alike are not distinguished, torques that are not are; and what codes cost is counted per target."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tsmlib import study
from tsmlib.collection import smooth_torques
from tsmlib.evaluation import actions as actions_evaluation
from tsmlib.models.action_prior import ActionPrior
from tsmlib.planning.execution import Trial
from tsmlib.storage import tables
from reproduction.results import action_prior as action_prior_results


def smooth(n: int, seed: int, rms: float = 0.1) -> Tensor:
    return smooth_torques(n, 50, generator=torch.Generator().manual_seed(seed), rms=rms)


def test_a_spectrum_integrates_to_the_mean_square_and_peaks_where_a_sine_is() -> None:
    actions = smooth(300, 0)
    frequency, power = actions_evaluation.spectrum(actions - actions.mean(1, keepdim=True))
    total = (actions - actions.mean(1, keepdim=True)).square().mean()
    assert power.sum() * (frequency[1] - frequency[0]) == pytest.approx(float(total), rel=1e-3)
    sine = torch.sin(2 * torch.pi * 8 * 0.02 * torch.arange(50))[None, :, None]
    frequency, power = actions_evaluation.spectrum(sine)
    assert frequency[power.argmax()] == pytest.approx(8)


def test_data_are_like_data_and_sharp_torques_are_not() -> None:
    held_out, train = smooth(200, 1), smooth(200, 2)
    value = {
        r["metric"]: r["value"]
        for r in action_prior_results.rows(smooth(100, 4), held_out, train, env="e")
    }
    assert value["change_ratio"] == pytest.approx(1, abs=0.1)
    assert value["auc"] == pytest.approx(0.5, abs=0.12)
    sharp = 0.3 * torch.randn(100, 50, 2, generator=torch.Generator().manual_seed(0)).sign()
    found = {
        r["metric"]: r["value"] for r in action_prior_results.rows(sharp, held_out, train, env="e")
    }
    assert found["auc"] > 0.99
    assert found["change_ratio"] > action_prior_results.SHARPER
    assert found["novelty"] > 2 * value["novelty"]
    few = action_prior_results.rows(sharp[:5], held_out, train, env="e")
    assert "auc" not in {row["metric"] for row in few}


def test_gentle_torques_of_the_same_shape_differ_in_size_alone() -> None:
    held_out, train = smooth(200, 1), smooth(200, 2)
    value = {
        r["metric"]: r["value"]
        for r in action_prior_results.rows(smooth(100, 4, rms=0.03), held_out, train, env="e")
    }
    assert value["auc"] > 0.95
    assert value["auc_shape"] == pytest.approx(0.5, abs=0.12)


def test_torques_of_the_prior_begin_at_rest_and_stay_within_bounds() -> None:
    torch.manual_seed(0)
    prior = ActionPrior(2, channels=8).fit_scale(smooth(50, 0))
    drawn = actions_evaluation.sample_actions(prior, 7, 50, torch.Generator().manual_seed(0))
    assert drawn.shape == (7, 50, 2)
    assert drawn.abs().max() <= 1
    again = actions_evaluation.reconstruct(prior, smooth(7, 0))
    assert again.shape == (7, 50, 2)
    alone = actions_evaluation.reconstruct(prior, smooth(7, 0)[:1, :10])
    torch.testing.assert_close(again[:1, :10], alone)  # later segments do not matter


def test_what_codes_cost_is_counted_per_target() -> None:
    task = study.draw_task("tsm/Reacher-v0", seed=0, n=20)
    distance = (task.target - torch.from_numpy(task.start[:, 4:6])).norm(dim=1)
    plans = smooth(20, 5)
    over_actions = Trial(plans, torch.zeros(20, 51, 6), -torch.ones(20), torch.full((20,), 0.01))
    over_codes = Trial(
        plans, torch.zeros(20, 51, 6), -torch.ones(20) - distance, torch.full((20,), 0.03)
    )
    torques = action_prior_results.Torques(task, smooth(200, 2), smooth(100, 1), {})
    latent, direct = study.methods(["oracle"], "cem")
    trials = {latent: over_codes, direct: over_actions}
    rows, found = action_prior_results.cost_of_prior(torques, trials, "oracle", "cem", seed=0)
    value = {row["metric"]: row["value"] for row in rows}
    torch.testing.assert_close(found["lost"], distance, atol=1e-6, rtol=0)
    assert value["lost_with_distance"] == pytest.approx(1)
    assert value["further"] == pytest.approx(0.02)
    assert value["outside"] <= 0.3
    wild = Trial(
        torch.ones(20, 50, 2),
        over_actions.states,
        over_actions.executed_return,
        over_actions.final_distance,
    )
    rows, _ = action_prior_results.cost_of_prior(
        torques, {latent: over_codes, direct: wild}, "oracle", "cem", seed=0
    )
    assert {row["metric"]: row["value"] for row in rows}["outside"] == 1


def test_a_table_has_a_line_per_method_and_a_mean_over_seeds() -> None:
    row = dict(
        env="e",
        metric="change",
        model="tsm",
        planner="cem",
        search_space="latent",
        execution="open loop",
        n=100,
        task="reach",
    )
    rows = [dict(row, value=0.1, seed=0), dict(row, value=0.3, seed=1)]
    rows.append(
        dict(row, model="none", planner="random", search_space="", subset="data", value=1.0)
    )
    ours, data = action_prior_results.torques_table(tables.frame(rows), "e").splitlines()[2:]
    assert [cell.strip() for cell in ours.split("|")[1:-1]] == ["TSM, latent, CEM", "100", "0.2"]
    assert data.startswith("| training data, held out")


def test_gradients_of_both_search_spaces_are_paired_by_start() -> None:
    row = dict(
        env="e", metric="gradient_snr", model="tsm", planner="adam", execution="open loop", seed=0
    )
    given = enumerate((1.0, 10.0, 100.0))
    rows = [dict(row, search_space="direct", target=i, value=value) for i, value in given]
    rows += [row | {"search_space": "latent", "value": 2 * row["value"]} for row in rows]
    line = action_prior_results.gradients_table(tables.frame(rows)).splitlines()[2]
    assert [cell.strip() for cell in line.split("|")[1:-1]] == [
        "`e`",
        "TSM",
        "3",
        "20",
        "10",
        "2 [2, 2]",
    ]
