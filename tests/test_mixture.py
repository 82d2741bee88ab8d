"""Several models as one: its samples are rollouts of one of them, and planners judge by all."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor
from untrained import in_units

import tsmlib
from tsmlib.models.base import predict_segment, stepper
from tsmlib.planning.predictors import EnsemblePredictor
from tsmlib.sampling import Noise, SeparateNoise, SharedNoise
from tsmlib.trajectory import Segment

DX, DU, B, T = 6, 2, 5, 25


def drawn(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def one_step(seed: int) -> tsmlib.OneStep:
    torch.manual_seed(seed)
    return in_units(tsmlib.OneStep(DX, DU, angles=(0, 1), hidden=16, layers=2)).double().eval()


def recurrent(seed: int) -> tsmlib.RecurrentTSM:
    torch.manual_seed(seed)
    net = tsmlib.RecurrentTSM(DX, DU, angles=(0, 1), hidden=16)
    net.decoder.codes.weight.data.mul_(20)  # so that a code says much
    return in_units(net).double().eval()


def given(n: int = B, steps: int = T) -> tuple[Segment, Tensor]:
    noise = drawn(7)
    past = Segment(
        torch.randn(n, 10, DX, generator=noise).double(),
        torch.randn(n, 10, DU, generator=noise).double(),
    )
    return past, torch.randn(n, steps, DU, generator=noise).double()


def test_the_mode_is_the_mean_of_the_models_modes() -> None:
    models, (past, actions) = [one_step(0), recurrent(1)], given()
    found = tsmlib.rollout(tsmlib.Mixture(models), past, actions)
    assert torch.allclose(
        found, torch.stack([tsmlib.rollout(model, past, actions) for model in models]).mean(0)
    )


def test_a_sample_is_a_rollout_of_one_of_the_models_to_its_end() -> None:
    models, (past, actions) = [one_step(0), one_step(1), one_step(2)], given(60)
    found = tsmlib.rollout(tsmlib.Mixture(models), past, actions, generator=drawn(3))
    each = torch.stack([tsmlib.rollout(model, past, actions) for model in models])
    of = (found - each).abs().amax((2, 3))  # (models, rows)
    assert torch.allclose(of.amin(0), torch.zeros(60).double(), atol=1e-12)
    assert of.argmin(0).bincount(minlength=3).min() > 8


def test_planners_are_shown_the_mode_of_each_model() -> None:
    models, (past, actions) = [one_step(0), recurrent(1), recurrent(2)], given()
    candidates = torch.stack([actions, -actions])  # (C, B, T, du)
    judge = tsmlib.model_predictor(tsmlib.Mixture(models), past)
    assert isinstance(judge, EnsemblePredictor)
    assert judge(candidates).shape == (3, 2, B, T, DX)
    for one, found, model in zip(judge.each, judge(candidates), models, strict=True):
        alone = tsmlib.model_predictor(model, past)(candidates)
        assert torch.allclose(found, alone[0])
        assert torch.allclose(one(candidates), alone)


@pytest.mark.parametrize(
    "noise",
    [
        lambda: None,
        lambda: drawn(5),
        lambda: SharedNoise(drawn(5), 3),
        lambda: SeparateNoise((drawn(5), drawn(6))),
    ],
    ids=["mode", "generator", "shared", "separate"],
)
def test_a_step_at_a_time_gives_the_states_of_the_rollout(
    noise: Callable[[], Noise | None],
) -> None:
    mixture, (past, actions) = tsmlib.Mixture([recurrent(0), recurrent(1), one_step(2)]), given(6)
    step = stepper(mixture, past, generator=noise())
    found = torch.stack([step(u) for u in actions.unbind(1)], dim=1)
    assert torch.allclose(found, tsmlib.rollout(mixture, past, actions, generator=noise()))


def test_candidates_are_compared_in_the_same_futures() -> None:
    mixture, (past, actions) = tsmlib.Mixture([recurrent(0), recurrent(1)]), given()
    states = tsmlib.model_predictor(mixture, past, samples=6, seed=2)(
        actions[None].repeat(3, 1, 1, 1)
    )
    torch.testing.assert_close(
        states[:, 0], states[:, 1], rtol=0, atol=1e-12
    )  # some processors round rows differently
    torch.testing.assert_close(states[:, 0], states[:, 2], rtol=0, atol=1e-12)
    assert not torch.equal(states[0], states[1])


def test_rows_that_share_noise_share_the_model_and_what_it_draws() -> None:
    mixture, (past, actions) = tsmlib.Mixture([recurrent(0), recurrent(1), one_step(2)]), given()
    twice = Segment(*(part.repeat(2, 1, 1) for part in past))
    found = predict_segment(
        mixture, twice, actions.repeat(2, 1, 1), generator=SharedNoise(drawn(1), B)
    )
    torch.testing.assert_close(found[:B], found[B:], rtol=0, atol=1e-12)


def test_copies_draw_as_each_alone() -> None:
    mixture, (past, actions) = tsmlib.Mixture([recurrent(0), recurrent(1)]), given()
    twice = Segment(*(part.repeat(2, 1, 1) for part in past))
    both = predict_segment(
        mixture, twice, actions.repeat(2, 1, 1), generator=SeparateNoise((drawn(1), drawn(2)))
    )
    for part, seed in zip(both.split(B), (1, 2), strict=True):
        assert torch.allclose(part, predict_segment(mixture, past, actions, generator=drawn(seed)))


def test_gradients_reach_the_actions() -> None:
    mixture, (past, actions) = tsmlib.Mixture([one_step(0), recurrent(1)]), given()
    actions.requires_grad_()
    tsmlib.rollout(mixture, past, actions, generator=drawn(0))[:, -1].sum().backward()
    assert (actions.grad[:, 0] != 0).any(dim=1).all()


def test_shipped_models_of_any_kinds_plan_and_execute_together() -> None:
    env = "tsm/Reacher-v0"
    mixture = tsmlib.Mixture(
        [tsmlib.load_pretrained(word, env=env) for word in ("rtsm", "onestep", "tsm", "lstm")]
    )
    task, prior = tsmlib.load_task(env).take(2), tsmlib.load_pretrained("prior", env=env)
    past, space = task.past(mixture.past_len), tsmlib.LatentActions(prior, task.horizon)
    plan = tsmlib.cem(
        tsmlib.model_predictor(mixture, past),
        task.reward,
        space,
        len(task),
        candidates=8,
        elites=2,
        iterations=2,
    )
    plan = tsmlib.reevaluate(plan, tsmlib.fresh_predictor(mixture, past, seed=1), task.reward)
    trial = tsmlib.execute(task, plan)
    assert torch.isfinite(trial.executed_return).all()
    assert plan.states.shape == (32, 2, task.horizon, 6)


def test_what_is_no_models_of_one_environment_is_refused() -> None:
    with pytest.raises(ValueError, match="models is empty"):
        tsmlib.Mixture([])
    with pytest.raises(
        TypeError,
        match=r"models is a OneStep; expected a list of models, as in Mixture\(\[one, ",
    ):
        tsmlib.Mixture(one_step(0))  # type: ignore[arg-type]
    other = in_units(tsmlib.OneStep(10, DU, angles=(0, 1), hidden=16, layers=2))
    with pytest.raises(
        ValueError,
        match=r"10 dimensions with angles \[0, 1\] and 6 dim.*expected one robot",
    ):
        tsmlib.Mixture([one_step(0), other])


def test_a_mixture_is_neither_stored_nor_trained(tmp_path: Path) -> None:
    mixture = tsmlib.Mixture([one_step(0), one_step(1)])
    with pytest.raises(TypeError, match="a Mixture is not stored; save each of its models"):
        tsmlib.save_model(tmp_path / "m.safetensors", mixture, {})
    with pytest.raises(TypeError, match="a Mixture is not trained"):
        mixture.loss(None, None)
