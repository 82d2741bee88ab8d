"""mbrl-lib's models behind our planners; with stand-ins where it is not installed."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

import tsmlib
from tsmlib.contrib.mbrl_lib import MbrlModel
from tsmlib.models.base import rollout
from tsmlib.planning.predictors import model_predictor
from tsmlib.trajectory import Segment

DX, DU, MEMBERS, B = 3, 2, 5, 7


class Ensemble(torch.nn.Module):
    """A stand-in for ``GaussianMLP``: one linear layer for each member."""

    num_members, elite_models = MEMBERS, None

    def __init__(self, deterministic: bool, outputs: int = DX) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.weight = torch.nn.Parameter(
            0.1 * torch.randn(MEMBERS, DX + DU, outputs, generator=generator)
        )
        self.deterministic = deterministic

    def forward(self, x: Tensor, *, use_propagation: bool) -> tuple[Tensor, Tensor | None]:
        assert not use_propagation
        assert len(x) == MEMBERS
        mean = x @ self.weight
        return mean, None if self.deterministic else torch.full_like(mean, -6.0)


class Halved:
    """A stand-in for mbrl-lib's ``Normalizer``."""

    def normalize(self, val: Tensor) -> Tensor:
        return val / 2


def stand_in(**changes: Any) -> Any:
    """A stand-in for ``OneDTransitionRewardModel``."""
    usual = dict(
        model=Ensemble(deterministic=True),
        input_normalizer=None,
        obs_process_fn=None,
        target_is_delta=True,
        no_delta_list=[],
        learned_rewards=False,
    )
    return SimpleNamespace(**(usual | changes))


def theirs(**changes: Any) -> Any:
    """mbrl-lib's own, with new weights."""
    models = pytest.importorskip("mbrl.models")
    torch.manual_seed(0)
    deterministic, rewards = (
        changes.pop("deterministic", True),
        changes.get("learned_rewards", False),
    )
    inner = models.GaussianMLP(
        DX + DU,
        DX + rewards,
        "cpu",
        num_layers=2,
        hid_size=16,
        ensemble_size=MEMBERS,
        deterministic=deterministic,
        propagation_method="fixed_model",
    )
    return models.OneDTransitionRewardModel(inner, **({"learned_rewards": False} | changes))


def some_past(steps: int = 4) -> Segment:
    generator = torch.Generator().manual_seed(1)
    return Segment(torch.randn(B, steps, DX, generator=generator), torch.zeros(B, steps, DU))


def some_actions(steps: int = 6, rows: int = B) -> Tensor:
    return torch.rand(rows, steps, DU, generator=torch.Generator().manual_seed(2)) * 2 - 1


# Theirs behind ours


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"input_normalizer": Halved()},
        {"obs_process_fn": torch.tanh},
        {"target_is_delta": False},
        {"no_delta_list": [1]},
        {"model": Ensemble(True, DX + 1), "learned_rewards": True},
    ],
    ids=["delta", "normalised", "processed", "absolute", "mixed", "rewards"],
)
def test_its_mode_is_the_mean_of_the_members_at_every_step(changes: dict[str, Any]) -> None:
    model = stand_in(**changes)
    states = rollout(MbrlModel(model), some_past(), some_actions())
    x, expected = some_past().states[:, -1], []
    for u in some_actions().unbind(1):
        seen = model.obs_process_fn(x) if model.obs_process_fn else x
        inputs = torch.cat([seen, u], 1) / (2 if model.input_normalizer else 1)
        after = (inputs @ model.model.weight).mean(0)[:, :DX]
        delta = torch.full((DX,), model.target_is_delta)
        delta[model.no_delta_list] = False
        x = after + delta * x
        expected.append(x)
    torch.testing.assert_close(states, torch.stack(expected, 1))


def test_planners_see_the_mode_of_every_member() -> None:
    model = MbrlModel(stand_in())
    past = Segment(torch.ones(1, 1, DX), torch.zeros(1, 1, DU))
    modes = model_predictor(model, past)(torch.ones(1, 1, 4, DU))[:, 0, 0]  # (members, 4, dx)
    for member, states in enumerate(modes):
        x = torch.ones(DX)
        for step in states:
            x = x + torch.cat([x, torch.ones(DU)]) @ model.theirs.model.weight[member]
            torch.testing.assert_close(step, x)


def test_a_sample_keeps_its_member_and_elites_alone_predict() -> None:
    def row(member: int) -> Tensor:
        x, found = some_past().states[0, -1], []
        for u in some_actions()[0]:
            x = x + torch.cat([x, u]) @ model.model.weight[member]
            found.append(x)
        return torch.stack(found)

    for elite in (None, [1, 3]):
        model = stand_in()
        model.model.elite_models = elite
        ours, seen = MbrlModel(model), set()
        for seed in range(30):
            states = rollout(
                ours, some_past(), some_actions(), generator=torch.Generator().manual_seed(seed)
            )
            seen |= {m for m in range(MEMBERS) if torch.allclose(states[0], row(m), atol=1e-5)}
        assert seen == set(elite or range(MEMBERS))


@pytest.mark.parametrize("make", [stand_in, theirs])
@pytest.mark.parametrize("planner", [tsmlib.cem, tsmlib.adam])
def test_our_planners_plan_through_it(
    make: Callable[..., Any], planner: Callable[..., tsmlib.Plan]
) -> None:
    def nearer(states: Tensor, actions: Tensor) -> Tensor:
        return -states[..., :2].square().sum(-1) - 0.01 * actions.square().sum(-1)

    past = Segment(some_past().states[:2], some_past().actions[:2])
    predict = tsmlib.model_predictor(MbrlModel(make()), past)
    budget = {"candidates": 40, "iterations": 6} if planner is tsmlib.cem else {"iterations": 20}
    plan = planner(predict, nearer, tsmlib.DirectActions(8, DU, rms=0.1), 2, **budget)
    zero = torch.zeros(1, 2, 8, DU)
    nothing = nearer(predict(zero), zero).sum(-1).mean(0)[0]  # over the members
    assert (plan.predicted_return > nothing).all()


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"deterministic": False},
        {"target_is_delta": False},
        {"no_delta_list": [1]},
        {"learned_rewards": True},
        {"obs_process_fn": torch.tanh},
        {"num_elites": 5},
    ],
    ids=lambda changes: ",".join(changes) or "default",
)
def test_one_step_is_what_mbrl_libs_own_sample_gives(changes: dict[str, Any]) -> None:
    model = theirs(**changes)
    ours, x, u = MbrlModel(model), torch.randn(2 * MEMBERS, DX), some_actions(1, 2 * MEMBERS)[:, 0]
    state = model.reset(x, rng=torch.Generator())
    members = state["propagation_indices"].view(MEMBERS, -1)  # (M, R): which rows each member takes
    expected, *_ = model.sample(u, state, deterministic=True)
    increments, log_variance = ours.increments(x[members], u[members])
    torch.testing.assert_close(x[members] + increments, expected[members], atol=1e-5, rtol=1e-4)
    assert (log_variance is None) == changes.get("deterministic", True)


def test_another_object_is_refused_by_what_it_lacks() -> None:
    with pytest.raises(
        TypeError,
        match=r"SimpleNamespace has no input_normalizer, .*model.num_members; expected an mbrl",
    ):
        MbrlModel(SimpleNamespace(model=torch.nn.Linear(2, 2)))  # type: ignore[arg-type]
