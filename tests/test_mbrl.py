"""mbrl-lib's models behind our planners and ours behind its ``ModelEnv``; with stand-ins where it
is not installed.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor

import tsmlib
from tsmlib.contrib.mbrl_lib import (
    ForModelEnv,
    MbrlModel,
    model_env,
    never,
    reward_function,
)
from tsmlib.models.base import rollout, stepper
from tsmlib.planning.predictors import model_predictor
from tsmlib.rewards import reach
from tsmlib.trajectory import Segment, initial_past

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
    increments, std = ours.step(x[members], u[members])
    torch.testing.assert_close(x[members] + increments, expected[members], atol=1e-5, rtol=1e-4)
    assert (std is None) == changes.get("deterministic", True)


def test_another_object_is_refused_by_what_it_lacks() -> None:
    with pytest.raises(
        TypeError,
        match=r"SimpleNamespace has no input_normalizer, .*model.num_members; expected an mbrl",
    ):
        MbrlModel(SimpleNamespace(model=torch.nn.Linear(2, 2)))  # type: ignore[arg-type]


# Ours behind theirs


class ModelEnv:
    """A stand-in for ``mbrl.models.ModelEnv``: what it asks of its dynamics model, in the same
    order.
    """

    def __init__(self, model: ForModelEnv, reward: Any, generator: torch.Generator) -> None:
        self.dynamics_model, self.reward, self.generator = model, reward, generator

    def returns(self, actions: Tensor, start: np.ndarray, particles: int) -> Tensor:
        tiled = np.tile(start, (particles * len(actions), 1)).astype(np.float32)
        state, total = (
            self.dynamics_model.reset(tiled, rng=self.generator),
            torch.zeros(len(tiled), 1),
        )
        for u in actions.unbind(1):
            u = u.repeat_interleave(particles, dim=0)
            x, rewards, ends, state = self.dynamics_model.sample(
                u, state, deterministic=False, rng=self.generator
            )
            assert rewards is None
            assert ends is None
            total += self.reward(u, x)
        return total.view(-1, particles).mean(1)


def an_arms(cls: Any, **arguments: Any) -> Any:
    """A model of the arm with new weights, made for a little data, and the data."""
    torques = tsmlib.smooth_torques(12, 40, generator=torch.Generator().manual_seed(0))
    data = tsmlib.collect(
        gymnasium.make_vec("tsm/Reacher-v0", num_envs=12),
        tsmlib.open_loop(torques),
        horizon=40,
        seed=0,
    )
    return cls.for_data(data, seed=0, **arguments), data


MODELS = [
    (tsmlib.OneStep, {}),
    (tsmlib.LSTM, {"hidden": 8}),
    (tsmlib.TSM, {}),
    (tsmlib.RecurrentTSM, {}),
    (tsmlib.Ensemble, {}),
]


@pytest.mark.parametrize(
    ("cls", "arguments"), MODELS, ids=lambda part: getattr(part, "__name__", "")
)
def test_stepped_by_mbrl_lib_a_model_predicts_its_rollout(
    cls: Any, arguments: dict[str, Any]
) -> None:
    model, data = an_arms(cls, **arguments)
    start, actions = torch.from_numpy(data.states[:4, 0]), torch.from_numpy(data.actions[:4, :25])
    past = initial_past(start, model.past_len, 2)
    for deterministic in (True, False):
        adapted, state = ForModelEnv(model, 2), None
        rng = torch.Generator().manual_seed(3)
        state, found = adapted.reset(start.numpy(), rng=rng), []
        for u in actions.unbind(1):
            x, _, _, state = adapted.sample(u, state, deterministic=deterministic, rng=rng)
            found.append(x)
        generator = (
            None if deterministic or not model.stochastic else torch.Generator().manual_seed(3)
        )
        step = stepper(model, past, generator=generator)
        with torch.no_grad():
            expected = torch.stack([step(u) for u in actions.unbind(1)], 1)
            torch.testing.assert_close(torch.stack(found, 1), expected)
            if deterministic:
                torch.testing.assert_close(
                    expected, rollout(model, past, actions), atol=1e-4, rtol=1e-4
                )


def test_what_happened_before_is_the_past_of_a_rollout() -> None:
    model, data = an_arms(tsmlib.LSTM, hidden=8)
    whole = data.take(slice(0, 1)).segment(model.past_len)
    past = Segment(*(part[:, 15 : 15 + model.past_len] for part in whole))
    adapted, actions = ForModelEnv(model, 2), torch.from_numpy(data.actions[:3, :5])
    adapted.saw(past)
    state, found = adapted.reset(past.states[:, -1].expand(3, -1).numpy()), []
    for u in actions.unbind(1):
        x, _, _, state = adapted.sample(u, state, deterministic=True)
        found.append(x)
    with torch.no_grad():
        expected = rollout(model, Segment(*(part.expand(3, -1, -1) for part in past)), actions)
    torch.testing.assert_close(torch.stack(found, 1), expected)
    with pytest.raises(ValueError, match="another state than the one in which the past"):
        adapted.reset(data.states[:3, 0])
    adapted.saw(None)
    adapted.reset(data.states[:3, 0])


def test_a_state_is_stepped_on_from_once() -> None:
    model, data = an_arms(tsmlib.OneStep)
    adapted, u = ForModelEnv(model, 2), torch.zeros(3, 2)
    first = adapted.reset(data.states[:3, 0])
    adapted.sample(u, first, deterministic=True)
    with pytest.raises(
        ValueError, match="0 steps after its reset, was stepped on before, to step 1"
    ):
        adapted.sample(u, first, deterministic=True)


def test_returns_by_model_env_are_those_of_a_rollout() -> None:
    model, data = an_arms(tsmlib.OneStep)
    task = tsmlib.Task.standard("tsm/Reacher-v0", data.states[:1, 0], torch.tensor([[0.1, 0.1]]))
    actions = torch.from_numpy(data.actions[:6, :20])
    found = ModelEnv(
        ForModelEnv(model, 2), reward_function(task.reward), torch.Generator()
    ).returns(actions, data.states[0, 0], particles=2)
    with torch.no_grad():
        states = rollout(
            model,
            initial_past(torch.from_numpy(data.states[:1, 0]).repeat(6, 1), model.past_len, 2),
            actions,
        )
    expected = reach(torch.tensor([[0.1, 0.1]]))(states[:, None], actions[:, None]).sum(-1)[:, 0]
    torch.testing.assert_close(found, expected)
    assert never(actions[:, 0], states[:, 0]).shape == (6, 1)


class Pushed:
    """A model with the least that one needs: the first two dimensions follow the actions."""

    segment_len = 4

    def predict_segment(self, past: Segment, actions: Tensor) -> Tensor:
        moved = torch.nn.functional.pad(0.2 * actions.cumsum(1), (0, 4))
        return past.states[:, -1:] + moved


def test_an_agent_of_mbrl_lib_plans_in_our_model() -> None:
    planning = pytest.importorskip("mbrl.planning")
    omegaconf = pytest.importorskip("omegaconf")
    start = np.zeros(6, np.float32)
    found = model_env(
        Pushed(),
        gymnasium.make("tsm/Reacher-v0"),
        lambda states, actions: -(states[..., :2] - 1).square().sum(-1),
        generator=torch.Generator().manual_seed(0),
    )
    assert found.action_space.high.tolist() == [1.0, 1.0]
    optimizer = {
        "_target_": "mbrl.planning.CEMOptimizer",
        "num_iterations": 5,
        "elite_ratio": 0.1,
        "population_size": 100,
        "alpha": 0.1,
        "device": "cpu",
        "lower_bound": "???",
        "upper_bound": "???",
        "return_mean_elites": True,
    }
    agent = {
        "_target_": "mbrl.planning.TrajectoryOptimizerAgent",
        "_recursive_": False,
        "optimizer_cfg": optimizer,
        "action_lb": "???",
        "action_ub": "???",
        "planning_horizon": 8,
        "replan_freq": 1,
        "verbose": False,
    }
    made = planning.create_trajectory_optim_agent_for_model(
        found, omegaconf.OmegaConf.create(agent), num_particles=1
    )
    torch.manual_seed(0)
    planned = torch.as_tensor(made.plan(start), dtype=torch.float32)[None]
    both = torch.cat([planned, torch.zeros_like(planned)])
    returns = found.evaluate_action_sequences(both, initial_state=start, num_particles=1)
    assert returns[0] > 0.5 * returns[1]
    assert returns[1] == -16.0


def test_without_mbrl_lib_it_is_said_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "mbrl.models", None)
    model, _ = an_arms(tsmlib.OneStep)
    with pytest.raises(
        ImportError, match=r"pip install 'tsmlib\[mbrl\]', then pip install --no-deps mbrl"
    ):
        model_env(model, gymnasium.make("tsm/Reacher-v0"), lambda states, actions: states[..., 0])
