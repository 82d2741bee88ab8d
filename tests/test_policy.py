"""Policies: what they see, what they may do, and that they learn what the model they learn in
rewards.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor
from untrained import in_units

import tsmlib
import tsmlib.envs  # noqa: F401 - registers the environments
from tsmlib.collection import collect
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import rollout, stepper
from tsmlib.models.baselines import LSTM, OneStep
from tsmlib.models.ensemble import Ensemble
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.models.tsm import TSM
from tsmlib.policies.learning import (
    LearningCurve,
    LearningOptions,
    discounted,
    episodes_from,
    imagine,
    learn_policy,
    learning_rate,
)
from tsmlib.policies.networks import OneStepPolicy, SegmentPolicy, controller
from tsmlib.policies.value import Bootstrap
from tsmlib.rewards import Reward
from tsmlib.sampling import Noise, standard_normal
from tsmlib.storage import artifacts, files
from tsmlib.training.callbacks import Progress
from tsmlib.training.checkpoint import TrainingStopped
from tsmlib.trajectory import Segment

DX, DU, H, DT = 6, 2, 4, 0.5
SMALL: dict[str, Any] = dict(segment_len=H, channels=8, dilations=(1, 2, 1))
MODELS: dict[str, Callable[[], Any]] = {
    "tsm": lambda: TSM(DX, DU, **SMALL),
    "onestep": lambda: OneStep(DX, DU, hidden=8, layers=1),
    "lstm": lambda: LSTM(DX, DU, hidden=8, past_len=H, segment_len=8),
    "rtsm": lambda: RecurrentTSM(
        DX, DU, hidden=8, latent_dim=3, past_len=H, code_len=H, segment_len=8
    ),
    "ensemble": lambda: Ensemble(DX, DU, members=3, hidden=8, layers=1, segment_len=8),
    "ensemble+mse": lambda: Ensemble(
        DX, DU, members=3, hidden=8, layers=1, segment_len=8, gaussian=False
    ),
}


class Sled:
    """Position and velocity in a plane, pushed by the action: x'' = u with friction. Known, and
    linear.
    """

    segment_len = past_len = 1

    def __init__(self, noise: float = 0.0) -> None:
        self.noise = noise

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        x, states = past.states[:, -1], []
        for u in actions.unbind(1):
            velocity = 0.8 * x[:, 2:] + DT * u
            if generator is not None:
                velocity = velocity + self.noise * standard_normal(
                    velocity.shape, generator, velocity
                )
            x = torch.cat([x[:, :2] + DT * velocity, velocity], dim=1)
            states.append(x)
        return torch.stack(states, dim=1)


def arrive(target: Tensor) -> Reward:
    """Minus the squared distance of the first two dimensions from the target, minus a little for
    the action.
    """
    return lambda states, actions: (
        -(states[..., :2] - target[:, None]).square().sum(-1) - 0.01 * actions.square().sum(-1)
    )


def model(name: str) -> Any:
    torch.manual_seed(1)
    made = in_units(MODELS[name]()).double()
    made.features.step_std.fill_(0.1)
    return made


def prior() -> ActionPrior:
    """An action prior of new weights, whose actions do not drift to their bounds."""
    torch.manual_seed(2)
    made = ActionPrior(DU, latent_dim=3, **SMALL).double()
    with torch.no_grad():
        made.std.fill_(0.5)
        made.decoder.head[-1].bias.zero_()
    return made


def policy(kind: str, state_dim: int = 4, *, seed: int = 0, **options: Any) -> Any:
    options = dict(angles=(), target_std=1.0, seed=seed) | options
    if kind == "onestep":
        return OneStepPolicy(state_dim, DU, hidden=16, **options).double()
    return SegmentPolicy(
        state_dim, prior(), **dict(channels=8, dilations=(1, 2)) | options
    ).double()


KINDS = pytest.mark.parametrize("kind", ["onestep", "segment"])


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def some_past(rows: int, dx: int = DX, steps: int = H) -> Segment:
    return Segment(normal(rows, steps, dx), normal(rows, steps, DU, seed=1).tanh())


def around(scale: float = 0.5) -> Callable[[int, torch.Generator], tuple[Tensor, Tensor]]:
    """Episodes of the sled at rest, a target anywhere in a disc."""
    return episodes_from(torch.zeros(1, 4, dtype=torch.float64), radius=scale)


def learn(learner: Any, world: Any = None, reward: Any = arrive, **settings: Any) -> LearningCurve:
    schedule = dict(horizon=5, episodes=4, iterations=4, record_every=2, lr=1e-2)
    schedule |= {
        name: settings.pop(name) for name in LearningOptions.__annotations__ if name in settings
    }
    return learn_policy(
        learner, world or Sled(), reward, around(), LearningOptions(**schedule), **settings
    )


def weights(learner: Any) -> dict[str, Tensor]:
    return {name: tensor.clone() for name, tensor in learner.state_dict().items()}


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


# Rolling out one action at a time


@pytest.mark.parametrize("sampled", [False, True], ids=["mode", "sample"])
@pytest.mark.parametrize("name", MODELS)
def test_states_met_one_by_one_are_those_of_a_rollout(name: str, sampled: bool) -> None:
    world, past, actions = model(name), some_past(7), normal(7, 16, DU, seed=2).tanh()
    draw = [torch.Generator().manual_seed(3) if sampled else None for _ in range(2)]
    step = stepper(world, past, generator=draw[0])
    seen = torch.stack([step(u) for u in actions.unbind(1)], dim=1)
    torch.testing.assert_close(seen, rollout(world, past, actions, generator=draw[1]))


def test_a_model_that_cannot_step_predicts_segments_of_one_action() -> None:
    whole, actions = model("tsm"), normal(3, 6, DU, seed=2).tanh()

    class Plain:
        segment_len, past_len, predict_segment = (
            whole.segment_len,
            whole.past_len,
            whole.predict_segment,
        )

    past = some_past(3)
    step, seen = stepper(Plain(), past), []  # type: ignore[arg-type]
    for u in actions.unbind(1):
        slow = whole.predict_segment(past.last(H), u[:, None])
        seen.append(step(u))
        torch.testing.assert_close(seen[-1], slow[:, 0], rtol=0, atol=0)
        past = past.then(Segment(slow, u[:, None]))


# Acting


@KINDS
def test_acting_on_is_acting_anew_on_the_last_steps(kind: str) -> None:
    actor, past, target = policy(kind), some_past(6, 4), normal(6, 2, seed=3)
    act, recent = actor.begin(past, target), past
    for k in range(7):
        x, u = recent.states[:, -1], recent.actions[:, -1]
        anew = actor.begin(recent.last(actor.past_len), target)(x, u, None)
        torch.testing.assert_close(act(x, u, None), anew)
        torch.testing.assert_close(controller(actor, target)(recent), anew[:, None])
        recent = recent.then(Segment(normal(6, 1, 4, seed=10 + k), anew[:, None].detach()))


@KINDS
def test_an_action_depends_on_the_target_and_on_the_states_of_its_own_episode(kind: str) -> None:
    actor, past, target = policy(kind), some_past(3, 4), normal(3, 2, seed=3)
    before = controller(actor, target)(past)
    other = target.clone()
    other[0] += 1
    moved = Segment(past.states.clone(), past.actions)
    moved.states[1] += 1
    assert (controller(actor, other)(past) != before).any(-1).flatten().tolist() == [
        True,
        False,
        False,
    ]
    assert (controller(actor, target)(moved) != before).any(-1).flatten().tolist() == [
        False,
        True,
        False,
    ]


@KINDS
def test_actions_stay_within_their_bounds(kind: str) -> None:
    actor = policy(kind)
    with torch.no_grad():
        for p in actor.parameters():
            p *= 100
    start, target = 10 * normal(20, 4), 10 * normal(20, 2, seed=1)
    seen = imagine(
        actor,
        Sled(),
        start,
        target,
        horizon=10,
        noise=3.0,
        generator=torch.Generator().manual_seed(0),
    )
    assert seen.actions.abs().max() <= 1
    assert seen.actions.abs().max() > 0.9


@KINDS
def test_a_policy_acts_in_an_environment_as_in_a_model_of_it(kind: str) -> None:
    class World:
        """The simulator, as a model without gradients."""

        segment_len = past_len = 1

        def __init__(self, env: Any) -> None:
            self.env = env.unwrapped

        def predict_segment(
            self, past: Segment, actions: Tensor, *, generator: Noise | None = None
        ) -> Tensor:
            return torch.from_numpy(self.env.rollout(actions.detach().numpy())).float()

    actor, target = (
        policy(kind, 6, angles=(0, 1), target_std=0.1).float(),
        0.1 * normal(4, 2).float(),
    )
    env = gymnasium.make_vec("tsm/Reacher-v0", num_envs=4)
    seen = collect(env, controller(actor, target), horizon=5, seed=0)
    start, _ = env.reset(seed=0)
    rollout_of_policy = imagine(
        actor, World(env), torch.from_numpy(start).float(), target, horizon=5
    )  # type: ignore[arg-type]
    torch.testing.assert_close(
        rollout_of_policy.actions, torch.from_numpy(seen.actions), rtol=1e-4, atol=1e-4
    )
    env.close()


# Learning


@KINDS
def test_a_policy_learned_through_the_true_model_arrives(kind: str) -> None:
    def distance(learner: Any) -> dict[str, Tensor]:
        end = imagine(learner, Sled(), start, target, horizon=10).states[:, -1]
        return {"distance": (end[:, :2] - target).norm(dim=1).mean()}

    actor, drawn = policy(kind), around()(50, torch.Generator().manual_seed(9))
    start, target = (part.double() for part in drawn)
    curve = learn(
        actor, Sled(0.01), horizon=10, episodes=20, iterations=90, record_every=45, measure=distance
    )
    before, _, after = curve.measured["distance"]
    assert after < 0.2 * before
    assert curve.iteration == [0, 45, 90]
    assert curve.predicted[2] > curve.predicted[1] > curve.predicted[0]


@KINDS
def test_short_pieces_and_a_value_teach_what_whole_episodes_do(kind: str) -> None:
    def distance(learner: Any) -> dict[str, Tensor]:
        end = imagine(learner, Sled(), start, target, horizon=20).states[:, -1]
        return {"distance": (end[:, :2] - target).norm(dim=1).mean()}

    actor, drawn = policy(kind), around()(50, torch.Generator().manual_seed(9))
    start, target = (part.double() for part in drawn)
    settings: dict[str, Any] = dict(horizon=20, bootstrap=3, gamma=0.9, noise=0.1, clip=1.0)
    settings |= dict(episodes=20, iterations=150, record_every=75)
    before, _, after = learn(actor, Sled(0.01), measure=distance, **settings).measured["distance"]
    assert after < 0.3 * before


def test_a_value_says_what_the_rest_of_an_episode_is_worth() -> None:
    options = LearningOptions(horizon=30, episodes=50, bootstrap=5, gamma=0.8, noise=0.2, clip=1.0)
    actor, world, random = policy("onestep"), Sled(), torch.Generator().manual_seed(0)
    ahead = Bootstrap(actor, world, options, seed=0)
    adam = torch.optim.Adam(ahead.value.parameters(), lr=3e-3)
    for _ in range(200):
        past, target = ahead.begin(*around()(50, random))
        seen = imagine(actor, world, past, target, horizon=5, noise=0.2, generator=random)
        rewards = arrive(target)(*seen)
        ahead.learn(ahead.objective(seen, rewards)[1], adam)
    start, target = (part.repeat_interleave(100, 0) for part in around()(30, random))
    whole = imagine(actor, world, start, target, horizon=40, noise=0.2, generator=random)
    worth = discounted(arrive(target)(*whole), 0.8).unflatten(0, (30, 100)).mean(1)
    said = ahead.value.output(start, target)[::100, 0]
    assert torch.corrcoef(torch.stack([said, worth]))[0, 1] > 0.9
    assert said.mean().item() == pytest.approx(worth.mean().item(), rel=0.2)


def test_a_policy_sees_how_far_and_which_way_each_place_is_from_the_next() -> None:
    actor = policy("onestep", 4, places=(0, 2))
    goals = normal(3, 2)
    states = torch.tensor([[0.0, 0.0, 3.0, 4.0]]).double().expand(3, -1)
    seen: list[Tensor] = []
    actor.net[0].register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    actor.output(states, goals)
    way = torch.tensor([3.0, 4.0, 5.0, 0.6, 0.8]).double()
    torch.testing.assert_close(seen[0][0, 6:11], way)
    with pytest.raises(ValueError, match=r"places is \(3,\); expected dimensions from 0 to 2"):
        policy("onestep", 4, places=(3,))


@pytest.mark.parametrize("name", ["tsm", "lstm", "ensemble"])
@KINDS
def test_the_gradient_of_the_return_is_that_of_finite_differences(kind: str, name: str) -> None:
    actor, world = policy(kind, DX), model(name)
    start, target = 0.1 * normal(4, DX), normal(4, 2, seed=1)

    def value() -> Tensor:
        seen = imagine(
            actor, world, start, target, horizon=9, generator=torch.Generator().manual_seed(5)
        )
        return discounted(arrive(target)(*seen), 0.9).sum()

    trained = [p for p in actor.parameters() if p.requires_grad]
    gradient = torch.autograd.grad(value(), trained)
    direction = [normal(*p.shape, seed=i) for i, p in enumerate(trained)]
    slope = sum((g * d).sum() for g, d in zip(gradient, direction, strict=True))
    ends, size = [], 1e-6
    with torch.no_grad():
        for sign in (1, -1):
            for p, d in zip(trained, direction, strict=True):
                p += sign * size * d
            ends.append(value())
            for p, d in zip(trained, direction, strict=True):
                p -= sign * size * d
    torch.testing.assert_close(slope, (ends[0] - ends[1]) / (2 * size), rtol=1e-5, atol=1e-8)
    assert abs(slope) > 1e-4


def test_what_is_learned_is_the_policy_alone_and_not_the_model_or_the_prior() -> None:
    world, actor = model("tsm"), policy("segment", DX)
    before, decoder, state = weights(world), weights(actor.prior), torch.get_rng_state()
    untouched = weights(actor)
    starts = episodes_from(torch.zeros(1, DX, dtype=torch.float64))
    learn_policy(actor, world, arrive, starts, LearningOptions(horizon=5, episodes=2, iterations=2))
    assert same(weights(world), before)
    assert same(weights(actor.prior), decoder)
    assert all(p.requires_grad and p.grad is None for p in world.parameters())
    assert not torch.equal(weights(actor)["head.weight"], untouched["head.weight"])
    assert torch.equal(torch.get_rng_state(), state)


@KINDS
def test_a_policy_sees_states_as_its_model_does_unless_it_was_fitted_before(kind: str) -> None:
    world, once = model("onestep"), LearningOptions(horizon=2, episodes=2, iterations=1)
    world.features.mean.fill_(0.3)
    starts = episodes_from(torch.zeros(1, DX, dtype=torch.float64))
    actor, fitted, before = policy(kind, DX), policy(kind, DX), normal(5, 8, DX)
    statistics = weights(fitted.features.fit(before))
    for each in (actor, fitted):
        learn_policy(each, world, arrive, starts, once)
    assert same(weights(actor.features), weights(world.features))
    assert same(weights(fitted.features), statistics)
    with pytest.warns(
        UserWarning, match=r"angles \[0\], the model \[\], .* raw units. Make it with angles=\(\)"
    ):
        learn_policy(policy(kind, DX, angles=(0,)), world, arrive, starts, once)


@pytest.mark.parametrize("bootstrap", [0, 2])
@KINDS
def test_learning_that_was_stopped_continues_as_if_it_had_not(
    kind: str, bootstrap: int, tmp_path: Path
) -> None:
    def stop_late(actor: Any) -> dict[str, float]:
        asked.append(weights(actor))
        if len(asked) == 4:  # at iterations 0, 2, 4 and 6
            raise KeyboardInterrupt
        return {"asked": float(len(asked))}

    asked: list[dict[str, Tensor]] = []
    whole, stopped = policy(kind), policy(kind)
    settings: dict[str, Any] = dict(
        iterations=8, bootstrap=bootstrap, checkpoint=tmp_path / "policy"
    )
    curve = learn(whole, measure=lambda _: {"asked": 1.0}, iterations=8, bootstrap=bootstrap)
    with pytest.raises(KeyboardInterrupt):
        learn(stopped, measure=stop_late, **settings)
    anew = policy(kind)
    again = learn(anew, measure=lambda _: {"asked": 1.0}, **settings)
    assert same(weights(anew), weights(whole))
    assert again.iteration == curve.iteration == [0, 2, 4, 6, 8]
    assert again.predicted == curve.predicted
    assert again.measured["asked"] == [1.0, 2.0, 3.0, 1.0, 1.0]
    others = (
        (policy(kind), {"horizon": 6}, "horizon is 5 in the file, expected 6; .*"),
        (policy(kind, seed=3), {}, "began with is '.*' in the file, expected '.*'"),
    )
    for other, given, said in others:
        with pytest.raises(files.StoreError, match=f"another run: {said}. Delete"):
            learn(other, **given, **settings)


def test_what_is_measured_may_be_no_number_and_comes_back_from_a_checkpoint(tmp_path: Path) -> None:
    def measure(_: Any) -> dict[str, Tensor]:
        return {"distance": torch.tensor(math.nan), "bound": torch.tensor(-math.inf)}

    curves = [
        learn(policy("onestep"), measure=measure, checkpoint=tmp_path / "policy") for _ in range(2)
    ]
    for curve in curves:
        assert np.isnan(curve.measured["distance"]).all()
        assert curve.measured["bound"] == [-math.inf] * 3


def test_a_checkpoint_of_other_starts_or_targets_is_refused(tmp_path: Path) -> None:
    def attempt(starts: Tensor, radius: float) -> None:
        options = LearningOptions(horizon=5, episodes=4, iterations=2, record_every=1)
        draw = episodes_from(starts, radius=radius)
        learn_policy(
            policy("onestep"), Sled(), arrive, draw, options, checkpoint=tmp_path / "policy"
        )

    starts = normal(50, 4)
    attempt(starts, 0.2)
    attempt(starts.clone(), 0.2)
    for other in ((starts + 0.1, 0.2), (2 * starts, 0.2), (starts, 0.25)):
        with pytest.raises(files.StoreError, match="another run: .*(starts|targets) is "):
            attempt(*other)


def test_a_callback_sees_every_record_of_learning_and_leaves_the_bits_alone() -> None:
    alone, watched, seen = policy("onestep"), policy("onestep"), list[Progress]()
    settings: dict[str, Any] = dict(measure=lambda _: {"asked": torch.tensor([2.0])})
    learn(alone, **settings)
    curve = learn(watched, callback=seen.append, **settings)
    assert same(weights(watched), weights(alone))
    assert [one.step for one in seen] == curve.iteration == [0, 2, 4]
    assert [one.values["predicted"] for one in seen] == curve.predicted
    assert [one.values["asked"] for one in seen] == [2.0] * 3


def test_targets_fill_the_disc_evenly_and_starts_are_among_those_given() -> None:
    given = torch.arange(12.0).reshape(3, 4)
    start, target = episodes_from(given, radius=0.2)(4000, torch.Generator().manual_seed(0))
    radius = target.norm(dim=1)
    assert radius.max() <= 0.2
    assert (radius < 0.1).float().mean() == pytest.approx(0.25, abs=0.03)
    torch.testing.assert_close(target.mean(0), torch.zeros(2), rtol=0, atol=0.01)
    assert torch.equal(start.unique(dim=0), given)


# Files


@KINDS
def test_a_policy_comes_back_from_its_file(kind: str, tmp_path: Path) -> None:
    actor, path = policy(kind), tmp_path / "policy.safetensors"
    actor.features.fit(normal(5, 8, 4))
    artifacts.save_model(path, actor.float(), {"fingerprint": {"env": "tsm/Reacher-v0"}})
    again = artifacts.load_model(path, type(actor), expect={"env": "tsm/Reacher-v0"})
    past, target = Segment(*(part.float() for part in some_past(4, 4))), torch.ones(4, 2)
    assert torch.equal(controller(again, target)(past), controller(actor, target)(past))
    with pytest.raises(
        files.StoreError, match="env is 'tsm/Reacher-v0' in the file, expected 'tsm/ReacherPush-v1'"
    ):
        artifacts.load_model(path, type(actor), expect={"env": "tsm/ReacherPush-v1"})


# What goes wrong


BAD: dict[str, tuple[Callable[[Tensor, Tensor], Any], str]] = {
    "per episode": (
        lambda x, u: -x.square().sum((1, 2)),
        r"is a tensor \(50,\); expected a tensor \(50, 5\), one number per step",
    ),
    "per dimension": (
        lambda x, u: -x.square(),
        r"is a tensor \(50, 5, 4\); expected a tensor \(50, 5\)",
    ),
    "a number": (lambda x, u: 1.0, "is a float 1.0; expected a tensor"),
    "nan": (
        lambda x, u: (x.sum(-1) - x.sum(-1)) / 0,
        "the reward is nan for target 0 at step 0, although the state there is finite",
    ),
    "infinite": (
        lambda x, u: x.square().sum(-1) / 0,
        r"the reward is inf for target \d+ at step 0, although the state there is finite",
    ),
    "no gradient": (lambda x, u: (x[..., 0] > 0).double(), "the reward has no gradient"),
}


@pytest.mark.parametrize(("reward", "message"), BAD.values(), ids=BAD.keys())
def test_a_reward_that_cannot_be_learned_from_is_refused(reward: Any, message: str) -> None:
    actor = policy("onestep")
    before = weights(actor)
    with pytest.raises((ValueError, FloatingPointError), match=message):
        learn(actor, reward=lambda target: reward, episodes=4)
    assert same(weights(actor), before)


@KINDS
def test_a_policy_of_another_environment_is_refused(kind: str) -> None:
    with pytest.raises(
        ValueError,
        match=r"states have 6 dimensions, this \w+ was made for 4; expected a policy of this",
    ):
        controller(policy(kind), torch.zeros(3, 2).double())(some_past(3))


def test_pasts_and_targets_that_do_not_fit_are_refused() -> None:
    past = some_past(4, 4)
    for actor, target, message in (
        (
            policy("onestep"),
            torch.zeros(3, 2),
            r"target has shape \(3, 2\); expected \(4, 2\)",
        ),
        (
            policy("segment"),
            torch.zeros(4, 3),
            r"target has shape \(4, 3\); expected \(4, 2\)",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            actor.begin(past, target)
    with pytest.raises(
        ValueError,
        match="the past holds 2 steps, SegmentPolicy needs 4; collect or execute with past_len=4",
    ):
        policy("segment").begin(past.last(2), torch.zeros(4, 2))
    with pytest.raises(ValueError, match="measure gave 2 values of 'both'; expected one"):
        learn(policy("onestep"), measure=lambda _: {"both": torch.zeros(2)})


@pytest.mark.parametrize("fault", ["states", "gradient"])
def test_what_is_not_finite_stops_learning_with_the_weights_of_the_last_record(fault: str) -> None:
    class Breaking(Sled):
        calls = 0

        def predict_segment(
            self, past: Segment, actions: Tensor, *, generator: Noise | None = None
        ) -> Tensor:
            states = super().predict_segment(past, actions, generator=generator)
            if not torch.is_grad_enabled():
                return states
            self.calls += 1
            if self.calls <= 15:  # three iterations of five steps
                return states
            return (
                states * math.nan
                if fault == "states"
                else states + (states - states.detach()).abs().sqrt()
            )

    actor, kept = policy("onestep"), []

    def keep(learner: Any) -> dict[str, Tensor]:
        kept.append(weights(learner))
        return {}

    message = (
        "the model predicts states that are not"
        if fault == "states"
        else "the gradient of the return is not"
    )
    with pytest.raises(
        TrainingStopped,
        match=f"{message} finite at iteration 3 of 4; the weights of iteration 2 are",
    ):
        learn(actor, Breaking(), measure=keep)
    assert same(weights(actor), kept[-1])
    assert len(kept) == 2


def test_later_rewards_count_less_and_the_rate_decays_to_a_tenth() -> None:
    assert discounted(torch.tensor([[1.0, 1.0, 1.0]]), 0.5).item() == 1.75
    rates = [learning_rate(i, 1e-3, 0.9, 1e-4) for i in (0, 99, 100, 2200, 5000)]
    assert rates == pytest.approx([1e-3, 1e-3, 9e-4, 1e-4, 1e-4])
