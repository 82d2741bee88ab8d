"""What makes each baseline the model it claims to be; test_axioms.py has what holds for all."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from untrained import in_units

from tsmlib.models.base import rollout
from tsmlib.models.baselines import LSTM, OneStep
from tsmlib.models.ensemble import Ensemble
from tsmlib.trajectory import Segment, Window, states_before

DX, DU, NOISE = 3, 2, 0.4


def world(n: int, steps: int, *, noise: float = 0.0, seed: int = 0) -> Segment:
    """x_{t+1} = 0.9 x_t + u_t pushed into three dimensions + noise; no angles."""
    draw = torch.Generator().manual_seed(seed)
    pull = torch.tensor([[1.0, 0.5, 0.0], [0.0, 0.5, -1.0]])
    x, states = torch.randn(n, DX, generator=draw), []
    actions = torch.rand(n, steps, DU, generator=draw) * 2 - 1
    for u in actions.unbind(1):
        x = 0.9 * x + u @ pull + noise * torch.randn(n, DX, generator=draw)
        states.append(x)
    return Segment(torch.stack(states, 1), actions)


def window(past_len: int, future_len: int, **options: float) -> Window:
    whole = world(256, past_len + future_len, **options)  # type: ignore[arg-type]
    parts = (part.split([past_len, future_len], 1) for part in whole)
    return Window(*(Segment(*pair) for pair in zip(*parts, strict=True)))


def trained(model: OneStep | LSTM | Ensemble, loss: str, seen: Window, steps: int = 300) -> None:
    model.features.fit(torch.cat([seen.past.states, seen.future.states], 1))
    optimizer, draw = (
        torch.optim.Adam(model.parameters(), lr=5e-3),
        torch.Generator().manual_seed(0),
    )
    for _ in range(steps):
        optimizer.zero_grad()
        getattr(model, loss)(seen, draw).backward()
        optimizer.step()


@pytest.fixture(scope="module")
def gaussian() -> Ensemble:
    torch.manual_seed(0)
    ensemble = Ensemble(DX, DU, hidden=32, layers=1)
    trained(ensemble, "loss", window(1, 20, noise=NOISE))
    return ensemble


def test_each_state_is_paired_with_the_action_taken_in_it() -> None:
    past, future = seen = window(4, 5)
    before = states_before(seen)
    assert torch.equal(before[:, 0], past.states[:, -1])
    assert torch.equal(before[:, 1:], future.states[:, :-1])
    pull = torch.tensor([[1.0, 0.5, 0.0], [0.0, 0.5, -1.0]])
    torch.testing.assert_close(0.9 * before + future.actions @ pull, future.states)


def test_a_one_step_model_has_no_memory() -> None:
    torch.manual_seed(0)
    model, (past, future) = in_units(OneStep(DX, DU)), window(10, 5)
    forgotten = Segment(past.states.clone(), torch.zeros_like(past.actions))
    forgotten.states[:, :-1] = 0
    assert torch.equal(
        rollout(model, past, future.actions), rollout(model, forgotten, future.actions)
    )


def test_over_one_step_both_losses_of_the_one_step_model_agree_but_for_units() -> None:
    torch.manual_seed(0)
    model, seen = OneStep(DX, DU), window(1, 1)
    model.features.fit(world(64, 30).states)
    model.features.std.copy_(model.features.step_std)  # the same units in both
    generator = torch.Generator()
    torch.testing.assert_close(model.loss(seen, generator), model.multi_step_loss(seen, generator))


def test_a_multi_step_loss_is_the_error_of_a_rollout() -> None:
    torch.manual_seed(0)
    for model, loss in ((OneStep(DX, DU), "multi_step_loss"), (LSTM(DX, DU), "loss")):
        past, future = seen = window(10, 20)
        model.features.fit(future.states)
        error = (rollout(model, past, future.actions) - future.states) / model.features.std
        torch.testing.assert_close(
            getattr(model, loss)(seen, torch.Generator()),
            error.square().sum((1, 2)).mean(),
            rtol=1e-5,
            atol=1e-5,
        )


def test_an_lstm_remembers_the_past_that_its_last_state_does_not_show() -> None:
    torch.manual_seed(0)
    model, (past, future) = in_units(LSTM(DX, DU, hidden=16)), window(10, 5)
    other = Segment(past.states.clone(), past.actions)
    other.states[:, :-1] += 1.0
    assert (rollout(model, past, future.actions) != rollout(model, other, future.actions)).any()


def test_an_lstm_learns_what_one_state_does_not_tell() -> None:
    """A world that shows each action one step late: the last state does not say what comes."""
    torch.manual_seed(0)
    actions = torch.rand(64, 14, DU) * 2 - 1
    late = torch.cat([torch.zeros(64, 1, DU), actions[:, :-1]], 1)
    parts = [part.split([4, 10], 1) for part in (late, actions)]
    seen = Window(Segment(parts[0][0], parts[1][0]), Segment(parts[0][1], parts[1][1]))
    errors = {}
    for model in (LSTM(DU, DU, hidden=32, past_len=4), OneStep(DU, DU, hidden=32)):
        trained(model, "loss", seen, steps=200)
        predicted = rollout(model, seen.past, seen.future.actions)
        errors[type(model)] = (predicted - seen.future.states).square().mean()
    assert errors[LSTM] < 0.3 * errors[OneStep]


def futures(ensemble: Ensemble, n: int = 200) -> Tensor:
    """(n, 20, DX): as many samples of one future."""
    past, future = window(1, 20)
    one = Segment(past.states[:1].expand(n, -1, -1), past.actions[:1].expand(n, -1, -1))
    return rollout(
        ensemble,
        one,
        future.actions[:1].expand(n, -1, -1),
        generator=torch.Generator().manual_seed(0),
    )


def test_an_ensemble_of_squared_errors_has_as_many_futures_as_members() -> None:
    torch.manual_seed(0)
    ensemble = in_units(Ensemble(DX, DU, gaussian=False, members=4, hidden=16, layers=1))
    distinct = futures(ensemble).mul(1e4).round().unique(dim=0)
    assert len(distinct) == 4  # one member from the first step to the last


def test_every_member_gets_its_share_of_samples() -> None:
    torch.manual_seed(0)
    ensemble = in_units(Ensemble(DX, DU, gaussian=False, members=4, hidden=16, layers=1))
    _, counts = futures(ensemble, 4000).mul(1e4).round().unique(dim=0, return_counts=True)
    assert (counts > 4000 / 4 * 0.85).all()


def test_a_gaussian_ensemble_states_the_noise_of_its_world(gaussian: Ensemble) -> None:
    seen = window(1, 20, noise=NOISE, seed=5)
    x, u = (
        part.flatten(0, 1).expand(5, -1, -1) for part in (states_before(seen), seen.future.actions)
    )
    _, log_variance = gaussian.increments(x, u)
    stated = (0.5 * log_variance).exp() * gaussian.features.step_std
    torch.testing.assert_close(stated.mean((0, 1)), torch.full((DX,), NOISE), rtol=0.1, atol=0)


def test_the_noise_of_a_gaussian_ensemble_builds_up_along_a_rollout(gaussian: Ensemble) -> None:
    spread = futures(gaussian, 1000).std(0).mean(-1)  # (20,)
    k = torch.arange(1, 21)
    expected = (NOISE**2 * (1 - 0.81**k) / (1 - 0.81)).sqrt()
    torch.testing.assert_close(spread, expected, rtol=0.2, atol=0)


def test_members_differ_where_there_were_no_data(gaussian: Ensemble) -> None:
    def disagreement(size: float) -> Tensor:
        x = size * torch.randn(5, 1, DX, generator=torch.Generator().manual_seed(1)).expand(
            5, 100, DX
        )
        mean, _ = gaussian.increments(x, torch.zeros(5, 100, DU))
        return mean.std(0).mean()

    assert disagreement(10.0) > 3 * disagreement(0.5)
