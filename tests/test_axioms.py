"""What holds for every dynamics model and for the action prior, whatever their weights are.

A new model joins by one entry in MODELS. All of it runs in float64 unless a test says otherwise, so
that a disagreement is a mistake and not rounding. Letters in shapes: as in tsmlib.trajectory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from reproduction.measures import gradients
from tsmlib.collection import smooth_torques
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import predict_segment, rollout
from tsmlib.models.baselines import LSTM, OneStep
from tsmlib.models.ensemble import Ensemble
from tsmlib.models.layers import CausalDecoder
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.models.tsm import TSM
from tsmlib.sampling import SharedNoise
from tsmlib.trajectory import Segment, Window, initial_past

DU = 2
B = 5


@dataclass(frozen=True)
class Case:
    """An implementation under test.

    build: state size -> model with new weights. constant: state dimensions that never change.
    losses: its loss methods, each with the prefixes of the parameters that it leaves alone.
    stochastic: whether a generator makes a difference. recall: (model, window) -> its best account
    of a future that it has seen.
    """

    build: Callable[[int], Any]
    state_dim: int = 6
    constant: tuple[int, ...] = ()
    losses: tuple[tuple[str, tuple[str, ...]], ...] = (("loss", ()),)
    stochastic: bool = True
    recall: Callable[[Any, Window], Tensor] = lambda model, seen: predict_segment(
        model, seen.past, seen.future.actions
    )

    def model(self, dtype: torch.dtype = torch.float64) -> Any:
        """The model with the statistics of ``motion``, always the same weights."""
        torch.manual_seed(1)
        model = self.build(self.state_dim)
        model.features.fit(motion(self, 64, 30).states)
        return model.to(dtype)


def by_code(model: TSM, seen: Window) -> Tensor:
    return model.decode(seen.past, seen.future.actions, model.encode(seen.future.states)[0])


TSM_LOSSES = (
    ("loss", ()),
    ("teacher_forced_loss", ()),
    ("energy_loss", ("encoder",)),
    ("encoder_loss", ("decoder",)),
)
SAME = dict(losses=TSM_LOSSES, recall=by_code)
ANGLES = (0, 1)  # as the arm's
SMALL = dict(channels=8, segment_len=10, beta=0.1)

MODELS = {
    "tsm": Case(lambda dx: TSM(dx, DU, angles=ANGLES, **SMALL), **SAME),
    "tsm, push": Case(
        lambda dx: TSM(dx, DU, angles=ANGLES, head_channels=16, **SMALL), state_dim=10, **SAME
    ),
    "tsm, obstacle": Case(
        lambda dx: TSM(dx, DU, angles=ANGLES, head_channels=16, **SMALL),
        state_dim=10,
        constant=(6, 7, 8, 9),
        **SAME,
    ),
    "onestep": Case(
        lambda dx: OneStep(dx, DU, angles=ANGLES, hidden=16, layers=2),
        stochastic=False,
        losses=(("loss", ()), ("multi_step_loss", ())),
    ),
    "lstm": Case(
        lambda dx: LSTM(dx, DU, angles=ANGLES, hidden=16, segment_len=10), stochastic=False
    ),
    "rtsm": Case(
        lambda dx: RecurrentTSM(dx, DU, angles=ANGLES, hidden=16, segment_len=20),
        losses=(("loss", ()), ("point_loss", ("decoder.codes",))),
    ),
    "rtsm, obstacle": Case(
        lambda dx: RecurrentTSM(dx, DU, angles=ANGLES, hidden=16, segment_len=20),
        state_dim=10,
        constant=(6, 7, 8, 9),
        losses=(("loss", ()), ("point_loss", ("decoder.codes",))),
    ),
    "ensemble": Case(
        lambda dx: Ensemble(dx, DU, angles=ANGLES, hidden=16, layers=2, segment_len=10)
    ),
    "ensemble+mse, obstacle": Case(
        lambda dx: Ensemble(
            dx, DU, angles=ANGLES, gaussian=False, hidden=16, layers=2, segment_len=10
        ),
        state_dim=10,
        constant=(6, 7, 8, 9),
    ),
}


@pytest.fixture(params=MODELS.values(), ids=MODELS.keys())
def case(request: pytest.FixtureRequest) -> Case:
    return request.param


def motion(case: Case, n: int, steps: int, *, seed: int = 0) -> Segment:
    """A made-up world (n, steps, .): every dimension follows the actions with inertia."""
    draw = torch.Generator().manual_seed(seed)
    actions = (
        torch.randn(n, -(-steps // 5), DU, generator=draw)
        .clamp(-1, 1)
        .repeat_interleave(5, 1)[:, :steps]
    )
    pull = torch.randn(DU, case.state_dim, generator=draw)
    x = torch.randn(n, case.state_dim, generator=draw)
    states = []
    for u in actions.unbind(1):
        change = 0.2 * (u @ pull) - 0.1 * x + 0.02 * torch.randn(x.shape, generator=draw)
        change[:, list(case.constant)] = 0
        x = x + change
        states.append(x)
    return Segment(torch.stack(states, 1), actions)


def window(
    case: Case, past_len: int, future_len: int, *, n: int = B, dtype: torch.dtype = torch.float64
) -> Window:
    """A past and the future that followed it."""
    parts = (
        part.to(dtype).split([past_len, future_len], 1)
        for part in motion(case, n, past_len + future_len, seed=3)
    )
    return Window(*(Segment(*pair) for pair in zip(*parts, strict=True)))


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def rows(segment: Segment, index: Any) -> Segment:
    return Segment(*(part[index] for part in segment))


# Shape ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [1, 7, 10])
def test_as_many_states_come_out_as_actions_went_in(case: Case, steps: int) -> None:
    model = case.model(torch.float32)
    past, future = window(case, model.past_len, steps, dtype=torch.float32)
    for noise in (None, generator()):
        states = predict_segment(model, past, future.actions, generator=noise)
        assert states.shape == (B, steps, case.state_dim)
        assert states.dtype == torch.float32


@pytest.mark.parametrize("steps", [1, 10, 23])
def test_a_rollout_has_any_length(case: Case, steps: int) -> None:
    model = case.model()
    past, future = window(case, model.past_len, steps)
    assert rollout(model, past, future.actions).shape == (B, steps, case.state_dim)


def test_a_past_that_is_too_short_is_refused(case: Case) -> None:
    model = case.model()
    past, future = window(case, model.past_len, 5)
    expected = rf"holds {model.past_len - 1} steps, \w+ needs {model.past_len}.*initial_past"
    with pytest.raises(ValueError, match=expected):
        rollout(model, rows(past, (slice(None), slice(1, None))), future.actions)


def test_only_the_last_steps_of_a_long_past_count(case: Case) -> None:
    model = case.model()
    past, future = window(case, model.past_len + 9, 13)
    torch.testing.assert_close(
        rollout(model, past, future.actions),
        rollout(model, past.last(model.past_len), future.actions),
        rtol=0,
        atol=0,
    )


# Causality --------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [0, 4, 9, 10, 16, 22])
def test_an_action_changes_no_state_before_it(case: Case, k: int) -> None:
    model = case.model()
    past, future = window(case, model.past_len, 23)
    other = future.actions.clone()
    other[:, k] += 0.5
    before, after = (
        rollout(model, past, u, generator=generator()) for u in (future.actions, other)
    )
    assert torch.equal(before[:, :k], after[:, :k])
    moving = [d for d in range(case.state_dim) if d not in case.constant]
    assert (before[:, k] != after[:, k])[
        :, moving
    ].all()  # u_k moves x_{k+1}, which is states[:, k]


def test_a_decoder_output_sees_the_present_and_the_receptive_field_only() -> None:
    positions, dilations = 25, (1, 2, 4, 8, 4)
    torch.manual_seed(0)
    decoder = CausalDecoder(3, 2, 4, channels=8, dilations=dilations).double()
    inputs, z = torch.randn(1, positions, 3).double(), torch.randn(1, 4).double()
    jacobian = torch.autograd.functional.jacobian(lambda x: decoder(x, z).sum((0, 2)), inputs)[:, 0]
    seen = jacobian.abs().sum(-1) > 0  # (output position, input position)
    offset = torch.arange(positions)[:, None] - torch.arange(positions)
    assert torch.equal(seen, (offset >= 0) & (offset <= sum(dilations)))


# Composition ------------------------------------------------------------------------------------


def test_a_rollout_is_segments_chained_by_hand(case: Case) -> None:
    model = case.model()
    past, future = window(case, model.past_len, 23)
    for seed in (None, 0):
        noise = None if seed is None else generator(seed)
        whole, at = past, 0
        while at < 23:
            u = future.actions[:, at : at + model.segment_len]
            states = predict_segment(model, whole.last(model.past_len), u, generator=noise)
            whole = whole.then(Segment(states, u))  # the predicted future is the next past
            at += u.shape[1]
        by_rollout = rollout(
            model, past, future.actions, generator=None if seed is None else generator(seed)
        )
        assert torch.equal(whole.last(23).states, by_rollout)


def test_a_plan_of_the_prior_is_segments_chained_by_hand(prior: ActionPrior) -> None:
    past, z = torch.zeros(B, 10, DU).double(), torch.randn(B, 3, 8, generator=generator()).double()
    first = prior.decode(past, z[:, 0])
    second = prior.decode(first, z[:, 1])
    third = prior.decode(second, z[:, 2])
    assert torch.equal(prior.plan(past, z), torch.cat([first, second, third], 1))


# Two decoding paths -----------------------------------------------------------------------------

CODED = [
    name
    for name, case in MODELS.items()
    if hasattr(case.build(case.state_dim), "decode") and "three" not in name
]
TSMS = [name for name in CODED if isinstance(MODELS[name].build(6), TSM)]


@pytest.mark.parametrize("name", TSMS)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 2e-5)])
def test_all_positions_at_once_and_one_by_one_agree(
    name: str, dtype: torch.dtype, tolerance: float
) -> None:
    model, z = MODELS[name].model(dtype), torch.randn(B, 8, generator=generator()).to(dtype)
    past, future = seen = window(MODELS[name], model.past_len, 10, dtype=dtype)
    at_once = model.decode_teacher_forced(seen, z)
    cache = model.decoder.begin(model.inputs(past.states[:, :-1], past.actions[:, 1:]), z)
    x, codes, one_by_one = past.states[:, -1], model.decoder.codes(z), []
    for true, u in zip(future.states.unbind(1), future.actions.unbind(1), strict=True):
        one_by_one.append(
            x + model.features.step_std * model.decoder.step(model.inputs(x, u), codes, cache)
        )
        x = true
    torch.testing.assert_close(torch.stack(one_by_one, 1), at_once, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("name", TSMS)
def test_teacher_forcing_on_its_own_predictions_is_free_running(name: str) -> None:
    model, z = MODELS[name].model(), torch.randn(B, 8, generator=generator()).double()
    past, future = window(MODELS[name], model.past_len, 10)
    free = model.decode(past, future.actions, z)
    forced = model.decode_teacher_forced(Window(past, Segment(free, future.actions)), z)
    torch.testing.assert_close(forced, free, rtol=1e-10, atol=1e-10)


def test_both_paths_of_the_prior_agree(prior: ActionPrior) -> None:
    def decoded_at_once(future: Tensor) -> Tensor:
        """With the true actions as inputs."""
        before = torch.cat([past.actions, future[:, :-1]], dim=1)
        return (before[:, -10:] + prior.std * prior.decoder(before / prior.std, z, 10)).clamp(-1, 1)

    past, future = actions_window()
    z = torch.randn(B, 8, generator=generator()).double()
    at_once = decoded_at_once(future.actions)
    cache = prior.decoder.begin(past.actions[:, :-1] / prior.std, z)
    u, codes, one_by_one = past.actions[:, -1], prior.decoder.codes(z), []
    for true in future.actions.unbind(1):
        one_by_one.append(
            (u + prior.std * prior.decoder.step(u / prior.std, codes, cache)).clamp(-1, 1)
        )
        u = true
    torch.testing.assert_close(torch.stack(one_by_one, 1), at_once, rtol=1e-10, atol=1e-10)
    free = prior.decode(past.actions, z)
    torch.testing.assert_close(decoded_at_once(free), free, rtol=1e-10, atol=1e-10)


def test_a_cache_may_begin_with_nothing_known() -> None:
    torch.manual_seed(0)
    decoder = CausalDecoder(3, 2, 4, channels=8).double()
    inputs, z = torch.randn(B, 25, 3).double(), torch.randn(B, 4).double()
    cache, codes = decoder.begin(inputs[:, :0], z), decoder.codes(z)
    outputs = torch.stack([decoder.step(x, codes, cache) for x in inputs.unbind(1)], 1)
    torch.testing.assert_close(outputs, decoder(inputs, z), rtol=1e-10, atol=1e-10)
    for n in range(1, inputs.shape[1] + 1):
        torch.testing.assert_close(decoder(inputs, z, n), outputs[:, -n:], rtol=1e-10, atol=1e-10)


# Differentiability ------------------------------------------------------------------------------


def assert_gradient(
    value: Callable[[], Tensor], variables: Sequence[Tensor], *, tolerance: float = 1e-5
) -> None:
    """Each gradient agrees with a central difference along it plus a random direction."""
    assert max(gradients.relative_errors(value, variables)) <= tolerance


def test_a_return_is_differentiable_in_actions_and_past(case: Case) -> None:
    model = case.model()
    past, future = window(case, model.past_len, 23)
    weights = torch.randn(B, 23, case.state_dim, generator=generator(9)).double()
    variables = [past.states.requires_grad_(), future.actions.requires_grad_()]

    def value() -> Tensor:
        return (weights * rollout(model, past, future.actions, generator=generator())).sum()

    assert_gradient(value, variables)


@pytest.mark.parametrize("name", CODED)
def test_a_predicted_segment_is_differentiable_in_its_code(name: str) -> None:
    model, z = (
        MODELS[name].model(),
        torch.randn(B, 8, generator=generator()).double().requires_grad_(),
    )
    past, future = window(MODELS[name], model.past_len, 10)
    assert_gradient(
        lambda: model.decode(past, future.actions, z).square().sum(), [z], tolerance=5e-5
    )


def test_every_loss_is_differentiable_in_every_parameter_it_uses(case: Case) -> None:
    model = case.model()
    seen = window(case, model.past_len, 2 * model.segment_len)
    for loss, unused in case.losses:
        used = parameters(model, but=unused)
        assert_gradient(
            lambda loss=loss: getattr(model, loss)(seen, generator()), list(used.values())
        )


def test_every_parameter_is_trained_by_a_loss(case: Case) -> None:
    model = case.model()
    seen = window(case, model.past_len, 2 * model.segment_len)
    trained = set()
    for loss, unused in case.losses:
        model.zero_grad(set_to_none=True)
        getattr(model, loss)(seen, generator()).backward()
        touched = {
            name for name, p in model.named_parameters() if p.grad is not None and p.grad.any()
        }
        assert touched == set(parameters(model, but=unused)), loss
        trained |= touched
    assert trained == set(parameters(model))


def parameters(model: nn.Module, *, but: tuple[str, ...] = ()) -> dict[str, nn.Parameter]:
    return {name: p for name, p in model.named_parameters() if not name.startswith(but or ("-",))}


def test_the_prior_is_differentiable_in_codes_and_every_parameter(prior: ActionPrior) -> None:
    past, future = actions_window(20)
    z = torch.randn(B, 3, 8, generator=generator()).double().requires_grad_()
    assert (
        prior.plan(past.actions, z).abs().max() < 1
    )  # the bounds are not met, where the gradient would be zero
    assert_gradient(lambda: prior.plan(past.actions, z).square().sum(), [z])
    assert_gradient(lambda: prior.loss(Window(past, future), generator()), list(prior.parameters()))


# Batches ----------------------------------------------------------------------------------------


def test_a_row_does_not_depend_on_its_batch(case: Case) -> None:
    model = case.model()
    past, future = window(case, model.past_len, 23)

    def predicted(index: Any) -> Tensor:
        noise = SharedNoise(generator(), 1)  # the same codes for every row
        return rollout(model, rows(past, index), future.actions[index], generator=noise)

    together = predicted(slice(None))
    for i in range(B):
        torch.testing.assert_close(
            predicted(slice(i, i + 1))[0], together[i], rtol=1e-12, atol=1e-12
        )
    order = torch.randperm(B, generator=generator())
    torch.testing.assert_close(predicted(order), together[order], rtol=1e-12, atol=1e-12)


def test_a_row_of_the_prior_does_not_depend_on_its_batch(prior: ActionPrior) -> None:
    past, z = actions_window()[0].actions, torch.randn(B, 2, 8, generator=generator()).double()
    together = prior.plan(past, z)
    for i in range(B):
        torch.testing.assert_close(
            prior.plan(past[i : i + 1], z[i : i + 1])[0], together[i], rtol=1e-12, atol=1e-12
        )


@pytest.mark.parametrize("size", [1, 2, 4])
def test_a_wide_batch_is_decoded_in_blocks_and_nothing_shows_it(
    case: Case, prior: ActionPrior, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = case.model()
    past, future = window(case, model.past_len, 23)
    z = torch.randn(B, 2, 8, generator=generator()).double()

    def everything() -> list[Tensor]:
        actions = prior.plan(past.actions[:, :1].repeat(1, prior.past_len, 1), z)
        return [rollout(model, past, future.actions, generator=generator()), actions]

    at_once = everything()
    monkeypatch.setattr("tsmlib.models.layers.BLOCK", size)
    for blocks, whole in zip(everything(), at_once, strict=True):
        torch.testing.assert_close(blocks, whole, rtol=1e-12, atol=1e-12)


def test_candidates_with_shared_noise_meet_the_same_futures(case: Case) -> None:
    model, candidates = case.model(), 3
    past, future = window(case, model.past_len, 23)
    same = rows(past, [0] * B)
    pasts = Segment(*(part.repeat(candidates, 1, 1) for part in same))
    actions = future.actions[:1].expand(candidates * B, -1, -1)
    states = rollout(model, pasts, actions, generator=SharedNoise(generator(), B)).unflatten(
        0, (candidates, B)
    )
    torch.testing.assert_close(states[1:], states[:1].expand_as(states[1:]), rtol=1e-12, atol=1e-12)
    if case.stochastic:
        assert (
            states[0, 0] - states[0, 1]
        ).abs().max() > 1e-3  # but different targets meet different ones


# Determinism ------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_bits_and_no_generator_the_mode(case: Case) -> None:
    model = case.model()
    past, future = window(case, model.past_len, 23)
    futures = [rollout(model, past, future.actions, generator=g) for g in map(generator, (0, 0, 1))]
    assert torch.equal(futures[0], futures[1])
    assert torch.equal(futures[0], futures[2]) is not case.stochastic
    modes = [rollout(model, past, future.actions) for _ in range(2)]
    assert torch.equal(*modes)
    assert torch.equal(modes[0], futures[0]) is not case.stochastic


def test_a_model_leaves_the_global_generator_alone(case: Case) -> None:
    model = case.model()
    seen = window(case, model.past_len, 20)
    before = torch.get_rng_state()
    rollout(model, seen.past, seen.future.actions, generator=generator())
    for loss, _ in case.losses:
        getattr(model, loss)(seen, generator())
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize("name", CODED)
def test_one_code_is_one_future(name: str) -> None:
    model, z = MODELS[name].model(), torch.randn(2, 8, generator=generator()).double()
    past, future = window(MODELS[name], model.past_len, 10, n=1)
    past, actions = rows(past, [0] * 4), future.actions.expand(4, -1, -1)
    states = model.decode(past, actions, z[[0, 1, 0, 1]])
    torch.testing.assert_close(states[:2], states[2:], rtol=1e-12, atol=1e-12)
    assert (states[0] - states[1]).abs().max() > 1e-3
    mode = model.predict_segment(past, actions)
    assert torch.equal(mode, model.decode(past, actions, torch.zeros(4, 8).double()))


def test_what_never_moves_stays_exactly_where_it_is(case: Case) -> None:
    model = case.model()
    past, future = window(case, model.past_len, 23)
    states = rollout(model, past, future.actions, generator=generator())
    still = list(case.constant)
    assert torch.equal(states[..., still], past.states[:, -1:, still].expand(-1, 23, -1))
    assert model.features.scored.sum() == model.features.dim - len(case.constant)


# Learning ---------------------------------------------------------------------------------------


def test_one_window_is_learned_by_heart(case: Case) -> None:
    model = case.model(torch.float32)
    seen = window(case, model.past_len, 10, n=1, dtype=torch.float32)
    overfit(model, lambda noise: model.loss(seen, noise))
    error = case.recall(model, seen) - seen.future.states
    assert error.square().mean() < 2e-2 * seen.future.states.var(1).mean()


def test_the_prior_learns_one_segment_by_heart() -> None:
    torch.manual_seed(1)
    torques = smooth_torques(1, 30, generator=generator(1))
    prior = ActionPrior(DU, beta=0.01).fit_scale(torques)
    past, future = (Segment(part[..., :0], part) for part in torques[:, 10:].split(10, 1))
    overfit(prior, lambda noise: prior.loss(Window(past, future), noise), lr=1e-2)
    error = prior.decode(past.actions, prior.encode(future.actions)[0]) - future.actions
    assert error.square().mean() < 2e-2 * future.actions.var(1).mean()


def overfit(
    model: nn.Module, loss: Callable[[torch.Generator], Tensor], steps: int = 200, lr: float = 2e-2
) -> None:
    optimizer = torch.optim.Adam(model.parameters(), lr=lr)
    noise = generator()
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = lr * (1 - step / steps)
        optimizer.zero_grad()
        loss(noise).backward()
        optimizer.step()


# The prior --------------------------------------------------------------------------------------


def actions_window(steps: int = 10) -> Window:
    """Past and future actions within the bounds, never near them; their states are empty."""
    drawn = motion(Case(new_prior, state_dim=DU), B, 10 + steps, seed=4).states
    drawn = 0.2 * (drawn / drawn.abs().max()).double()
    none = drawn[..., :0]
    return Window(Segment(none[:, :10], drawn[:, :10]), Segment(none[:, 10:], drawn[:, 10:]))


def new_prior(action_dim: int = DU) -> ActionPrior:
    torch.manual_seed(1)
    return ActionPrior(action_dim, channels=8).fit_scale(0.02 * torch.randn(40, 20, DU)).double()


@pytest.fixture
def prior() -> ActionPrior:
    return new_prior()


@pytest.mark.parametrize("size", [0.1, 1.0, 30.0])
def test_decoded_actions_stay_within_the_bounds(prior: ActionPrior, size: float) -> None:
    start = initial_past(torch.zeros(B, 6).double(), 10, DU)
    actions = prior.plan(start.actions, size * torch.randn(B, 5, 8, generator=generator()).double())
    assert actions.shape == (B, 50, DU)
    assert actions.abs().max() <= 1


def test_one_code_is_one_action_segment(prior: ActionPrior) -> None:
    past, z = torch.zeros(4, 10, DU).double(), torch.randn(2, 8, generator=generator()).double()
    actions = prior.decode(past, z[[0, 1, 0, 1]])
    torch.testing.assert_close(actions[:2], actions[2:], rtol=1e-12, atol=1e-12)
    assert (actions[0] - actions[1]).abs().max() > 1e-4
