"""Policies learned inside a model: back-propagation through time (section 4.3, A.3, Eq. 4).

    max over theta of eta = E[ sum_t gamma^t r(x_t, u_t) ],   u_t ~ pi_theta,   x_{t+1} ~ the model

or, with ``LearningOptions.with_value``, of pieces of an episode and the value of what comes after
(``value``), which learns what whole episodes do not teach.

    OneStepPolicy    u_t ~ N(pi(x_t, g), sd^2)       a fully connected network
    SegmentPolicy    Z ~ N(pi(X-, U-, g), sd^2)      acts by the first action that the prior decodes

g is the target, so one policy serves every instance of a task. The real environment is never asked
while learning.

Letters in shapes: as in ``networks``; n episodes, T horizon.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn

from tsmlib.checks import (
    as_tensor,
    require_callable,
    require_number,
    require_seed,
    require_type,
)
from tsmlib.models.base import Model, as_dynamics
from tsmlib.policies.imagination import imagine
from tsmlib.policies.networks import Policy
from tsmlib.policies.options import LearningCurve, LearningOptions
from tsmlib.policies.value import RATE, Bootstrap, Lesson, discounted
from tsmlib.rewards import Reward, fingerprint, rewarded
from tsmlib.sampling import Noise
from tsmlib.storage import artifacts
from tsmlib.storage.files import Json, PathLike
from tsmlib.training.callbacks import Callback, Progress
from tsmlib.training.checkpoint import TrainingState, resumable
from tsmlib.training.fine_tune import frozen
from tsmlib.trajectory import Segment

RewardFor = Callable[[Tensor], Reward]  # targets (R, dg) -> reward
# n, generator -> starting states (n, dx), targets (n, dg)
Draw = Callable[[int, torch.Generator], tuple[Tensor, Tensor]]
Measure = Callable[[Policy], Mapping[str, float | Tensor]]  # named numbers


@torch.enable_grad()  # see training.fit
def learn_policy(
    policy: Policy,
    model: Model,
    reward: RewardFor,
    draw: Draw,
    options: LearningOptions | None = None,
    *,
    seed: int = 0,
    measure: Measure | None = None,
    checkpoint: PathLike | None = None,
    progress: str | bool = "",
    callback: Callback | None = None,
) -> LearningCurve:
    """Improve a policy inside a model, by Adam on the discounted return (Eq. 4).

    Episodes and noise are functions of (seed, iteration), so a run that is resumed from
    ``checkpoint`` continues as if it had not stopped. The model is left as it was. A policy whose
    features have no statistics yet takes those of the model's features first.

    Args:
        policy: improved in place.
        model: that predicts.
        reward: targets (R, dg) -> reward of states (R, T, dx) and actions (R, T, du), such as
            ``tsmlib.rewards.reach``.
        draw: (n, generator) -> starts (n, dx) and targets (n, dg) of episodes.
        options: the schedule; the paper's without.
        seed: of episodes and noise.
        measure: policy -> named numbers, at every record.
        checkpoint: a folder of its own; one of another run is refused.
        progress: whether to show a progress bar, or its title.
        callback: called with a ``Progress`` at every record, the one before the first update too.

    Returns:
        The learning curve.

    Raises:
        TypeError, ValueError: arguments that cannot be, or a reward of another shape or without a
            gradient; the weights are unchanged.
        FloatingPointError: a reward that is not finite where states are.
        TrainingStopped: states or gradients are not finite; the weights are the last record's.
        StoreError: ``checkpoint`` is of another run, or in use.
    """
    options = LearningOptions() if options is None else options
    _require_arguments(policy, model, reward, draw, options)
    seed = require_seed("seed", seed)
    for name, function in (("measure", measure), ("callback", callback)):
        if function is not None:
            require_callable(name, function, "a function, or None")
    policy.take_statistics(model)
    learner = _Learner(policy, model, reward, draw, options, seed)
    trained = [p for p in policy.parameters() if p.requires_grad]
    optimizer = torch.optim.Adam(trained, lr=options.lr)
    optimizers, learned = {"adam": optimizer}, cast(nn.Module, policy)
    if options.bootstrap:
        learned = learner.ahead = Bootstrap(policy, model, options, seed)
        optimizers["value"] = torch.optim.Adam(learner.ahead.value.parameters(), lr=options.lr)
    identity: dict[str, Json] = asdict(options) | {"seed": seed}
    if checkpoint is not None:
        checkpoint = Path(checkpoint)
        identity |= learner.identity()
    curve = LearningCurve()
    state = TrainingState(learned, optimizers, curve, options.iterations, identity, checkpoint)
    learner.state = state
    purpose = f"learning a policy, seed {seed}"
    with resumable(state, purpose=purpose, progress=progress) as bar, frozen(model):
        if not state.step:
            learner.record(measure, callback)
        for iteration in range(state.step, options.iterations):
            began = time.process_time()
            rate = learning_rate(iteration, options.lr, options.lr_decay, options.lr_final)
            for name, one in optimizers.items():
                for group in one.param_groups:
                    group["lr"] = rate * RATE if name == "value" else rate
            objective, lesson = learner.objective(iteration)
            optimizer.zero_grad(set_to_none=True)
            (-objective.mean()).backward()
            norm = nn.utils.clip_grad_norm_(trained, options.clip or torch.inf)
            if not torch.isfinite(norm):
                raise state.stopped("the gradient of the return is not finite", iteration)
            optimizer.step()
            if learner.ahead is not None and lesson is not None:
                learner.ahead.learn(lesson, optimizers["value"])
            state.step = iteration + 1
            state.seconds += time.process_time() - began
            bar.update()
            if state.step % options.record_every == 0 or state.step == options.iterations:
                learner.record(measure, callback)
                state.save()
                bar.set_postfix(predicted=-state.best_loss)
    return state.curve


def _require_arguments(
    policy: Policy, model: Model, reward: RewardFor, draw: Draw, options: LearningOptions
) -> None:
    """An error where what learns, or what it learns from, is of another kind or robot."""
    require_type("policy", policy, Policy, "tsmlib.OneStepPolicy(...) or SegmentPolicy(...)")
    require_type("options", options, LearningOptions, "tsmlib.LearningOptions(...)")
    require_callable("reward", reward, "a function of targets, such as tsmlib.rewards.reach")
    require_callable("draw", draw, "a function (n, generator) -> starts, targets of episodes")
    as_dynamics(model)
    for name in ("state_dim", "action_dim"):
        ours, theirs = getattr(policy, name), getattr(model, name, None)
        if theirs is not None and ours != theirs:
            raise ValueError(
                f"policy has {name} {ours}, the model {theirs}; expected those of one robot: "
                f"{type(policy).__name__}({name}={theirs}, ...)"
            )
    if not any(p.requires_grad for p in policy.parameters()):
        raise ValueError("policy has no weight to train; expected one with requires_grad")


@dataclass
class _Learner:
    """Imagined episodes of a policy, functions of (seed, iteration), and their record."""

    policy: Policy
    model: Model
    reward: RewardFor
    draw: Draw
    options: LearningOptions
    seed: int
    state: TrainingState[LearningCurve] = field(init=False)
    ahead: Bootstrap | None = None

    def drawn(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Starts (n, dx) and targets (n, dg), checked."""
        both = self.draw(n, generator)
        require_type("what draw gave", both, tuple, "two tensors, starts and targets")
        start, target = both
        dtype = next(self.policy.parameters()).dtype
        return (
            as_tensor("draw's starts", start, (n, self.policy.state_dim), dtype=dtype),
            as_tensor("draw's targets", target, (n, self.policy.target_dim), dtype=dtype),
        )

    def episodes(self, iteration: int, n: int) -> tuple[Tensor, Tensor, Noise]:
        """Starts (n, dx) and targets (n, dg) of n episodes, and their noise."""
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + iteration)
        return *self.drawn(n, generator), generator

    def objective(self, iteration: int) -> tuple[Tensor, Lesson | None]:
        """What the policy improves (R,), and what the value is to learn, if there is one."""
        o, (start, target, noise) = self.options, self.episodes(iteration, self.options.episodes)
        if self.ahead is None:
            _, rewards = self.imagined(start, target, noise, o.horizon, iteration)
            return discounted(rewards, o.gamma), None  # Eq. 4
        past, target = self.ahead.begin(start, target)
        seen, rewards = self.imagined(past, target, noise, o.bootstrap, iteration)
        return self.ahead.objective(seen, rewards)

    def imagined(
        self, start: Tensor | Segment, target: Tensor, noise: Noise, steps: int, iteration: int
    ) -> tuple[Segment, Tensor]:
        """Episodes, and the rewards (R, T) of each of their steps; a record's without noise."""
        spread = self.options.noise if torch.is_grad_enabled() else 0.0
        seen = imagine(
            self.policy,
            self.model,
            start,
            target,
            horizon=steps,
            noise=spread,
            generator=noise,
        )
        if not torch.isfinite(seen.states).all():
            raise self.state.stopped("the model predicts states that are not finite", iteration)
        rewards = rewarded(self.reward_for(target), *seen)
        if rewards.isinf().any():
            raise FloatingPointError(
                "the reward is infinite, although the states are finite; look for a division in it"
            )
        if torch.is_grad_enabled() and not rewards.requires_grad:
            raise ValueError(
                "the reward has no gradient: write it with differentiable torch operations on the "
                "states or actions (no comparisons, rounding, .detach(), .item() or numpy)"
            )
        return seen, rewards

    def reward_for(self, target: Tensor) -> Reward:
        """The reward of some targets (R, dg)."""
        hint = "a function of targets that gives a reward, such as tsmlib.rewards.reach"
        try:
            reward = self.reward(target)
        except TypeError as error:
            raise TypeError(
                f"reward fails on targets {tuple(target.shape)}: {error}; expected {hint}"
            ) from error
        require_callable("what reward gave", reward, hint)
        return reward

    @torch.no_grad()
    def identity(self) -> dict[str, Json]:
        """What a run is, by values: the model's weights, starts, targets, and rewards of chance."""
        start, target = self.drawn(200, torch.Generator().manual_seed(0))
        steps, du = self.options.horizon, self.policy.action_dim
        chance = fingerprint(self.reward_for(target), start, steps, du)
        model = self.model
        digest = artifacts.digest(model.state_dict()) if isinstance(model, nn.Module) else ""
        identity: dict[str, Json] = {
            "policy": type(self.policy).__name__,
            "model": f"{type(model).__name__} {digest}",
            "reward of chance": list(chance),
        }
        for name, part in {"starts": start, "targets": target}.items():
            moments = torch.stack([part.double().mean(0), part.double().std(0)])
            identity[name] = moments.flatten().tolist()
        return identity

    def record(self, measure: Measure | None, callback: Callback | None) -> None:
        """A point of the curve; the present weights are those to go back to."""
        with torch.no_grad():  # the same episodes every time
            at = self.options.iterations
            _, rewards = self.imagined(*self.episodes(at, 50), self.options.horizon, at)
        record = {"predicted": float(rewards.sum(-1).mean())}
        curve = self.state.curve
        curve.iteration.append(self.state.step)
        curve.seconds.append(self.state.seconds)
        curve.predicted.append(record["predicted"])
        for name, value in (measure(self.policy) if measure else {}).items():
            value = torch.as_tensor(value).detach()
            if value.numel() != 1:
                raise ValueError(f"measure gave {value.numel()} values of {name!r}; expected one")
            record[name] = float(value)  # may be no number
            curve.measured.setdefault(name, []).append(record[name])
        self.state.keep(-record["predicted"])
        if callback is not None:
            callback(Progress(self.state.step, self.state.seconds, record))


def learning_rate(iteration: int, lr: float, decay: float, final: float) -> float:
    """``lr``, decayed every 100 iterations until it is ``final`` (A.3)."""
    return max(final, lr * decay ** (iteration // 100))


def episodes_from(starts: Tensor, *, radius: float = 0.2) -> Draw:
    """Episodes that begin in one of some states, with a target uniform in a disc (A21).

    Args:
        starts: (N, dx).
        radius: of the disc around the shoulder, metres.

    Returns:
        The ``draw`` of ``learn_policy``.
    """
    starts = as_tensor("starts", starts, ("N", "dx"))
    radius = require_number("radius", radius, 0)

    def draw(n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        index = torch.randint(len(starts), (n,), generator=generator)
        distance, angle = torch.rand(2, n, generator=generator, dtype=starts.dtype)
        angle = 2 * math.pi * angle
        target = radius * distance.sqrt()[:, None] * torch.stack([angle.cos(), angle.sin()], dim=1)
        return starts[index], target

    return draw
