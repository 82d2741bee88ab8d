"""Policies learned inside a model: back-propagation through time (section 4.3, A.3, Eq. 4).

    max over theta of eta = E[ sum_t gamma^t r(x_t, u_t) ],   u_t ~ pi_theta,   x_{t+1} ~ the model

    OneStepPolicy    u_t ~ N(pi(x_t, g), sd^2)            a fully connected network
    SegmentPolicy    Z ~ N(pi(X-, U-, g), sd^2)           acts by the first action that the action prior decodes from Z

g is the target, so one policy serves every instance of a task. The real environment is never asked while learning.
Copy m of a policy starts from weights and learns from noise drawn from ``seed + m`` alone, as it would on its own.

Letters in shapes: as in ``networks``; n episodes, T horizon.
"""

import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import ClassVar, Self

import torch
from torch import Tensor, nn

from tsmlib.models.base import Model, as_dynamics, stepper
from tsmlib.models.features import Features
from tsmlib.models.layers import on_device_of
from tsmlib.policies.networks import Policy
from tsmlib.rewards import Reward, rewarded
from tsmlib.sampling import Noise, SeparateNoise, standard_normal
from tsmlib.storage import artifacts
from tsmlib.training.callbacks import Callback, Progress
from tsmlib.training.checkpoint import Curve, TrainingState, resumable
from tsmlib.trajectory import Segment, initial_past

Draw = Callable[
    [int, torch.Generator], tuple[Tensor, Tensor]
]  # n -> starting states (n, dx), targets (n, dg)
Measure = Callable[[Policy], Mapping[str, Tensor]]  # named numbers, one per copy (M,)
NOT_FINITE = "the gradient of the return is not finite"


def imagine(
    policy: Policy,
    model: Model,
    start: Tensor,
    target: Tensor,
    *,
    horizon: int = 50,  # A.3
    noise: float = 0.01,  # standard deviation of the policy's output, A.3
    generator: Noise | None = None,
) -> Segment:
    """Predicted rollout of a policy from ``start`` (R, dx): states (R, T, dx) and actions.

    Differentiable in the policy's parameters. No generator: no noise, and the model's mode. Policy and model are on one
    device; ``start`` and ``target`` may be elsewhere, and what is returned is where ``start`` is.
    """
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}, expected a positive number of steps")
    home, (start, target) = start.device, on_device_of(policy, start, target)
    past = initial_past(start, max(policy.past_len, as_dynamics(model).past_len), policy.action_dim)
    drawn: Sequence[Tensor | None] = [None] * horizon
    if generator is not None:
        shape = (len(start), horizon, policy.output_dim)
        drawn = (noise * standard_normal(shape, generator, start)).unbind(1)
    act, step = policy.begin(past, target), stepper(model, past, generator=generator)
    x, u, states, actions = start, past.actions[:, -1], [], []
    for disturbance in drawn:
        u = act(x, u, disturbance)
        x = step(u)
        states.append(x)
        actions.append(u)
    return Segment(torch.stack(states, dim=1).to(home), torch.stack(actions, dim=1).to(home))


@dataclass(frozen=True)
class LearningOptions:
    """Schedule of ``learn_policy``; what the paper states is in A.3."""

    horizon: int = 50
    gamma: float = 0.99
    noise: float = 0.01  # standard deviation of the policy's output
    episodes: int = 20  # per update, of each copy
    iterations: int = 2200  # until the rate has decayed (A25)
    lr: float = 1e-3
    lr_decay: float = 0.9  # per 100 iterations
    lr_final: float = 1e-4
    clip: float = (
        0.0  # norm that each copy's gradient is shortened to; 0: never, the paper states none
    )
    record_every: int = 100  # iterations; a checkpoint is written as often

    def __post_init__(self) -> None:
        if min(self.horizon, self.episodes, self.iterations, self.record_every) < 1:
            raise ValueError(
                f"horizon {self.horizon}, episodes {self.episodes}, iterations {self.iterations}, "
                f"record_every {self.record_every}: expected positive numbers"
            )


@dataclass
class LearningCurve(Curve):
    """Record of ``learn_policy``: updates done, and one number per copy for each of the rest.

    predicted: undiscounted predicted return, mean over 50 episodes that are the same at every record; measured: what
    ``measure`` returned, such as the executed return. policies: the most that were learned as one at any time
    (``stacked``); seconds are of all of them.
    """

    unit: ClassVar[str] = "iteration"
    remedy: ClassVar[str] = "Check that the reward's gradient is finite everywhere, or clip"
    iteration: list[int] = field(default_factory=list)
    predicted: list[list[float]] = field(default_factory=list)
    measured: dict[str, list[list[float]]] = field(default_factory=dict)
    policies: int = 1


@torch.enable_grad()  # see training.fit
def learn_policy(
    policy: Policy,
    model: Model,
    reward: Callable[[Tensor], Reward],
    draw: Draw,
    options: LearningOptions | None = None,
    *,
    seed: int = 0,  # of copy 0; copy m has seed + m
    measure: Measure | None = None,  # also before the first iteration
    checkpoint: Path | None = None,  # a folder of its own
    progress: str = "",  # title of the progress bar; none without
    callback: Callback | None = None,  # at every record, the one before the first iteration too
) -> LearningCurve:
    """Improve all copies of ``policy`` in ``model`` by Adam on the discounted return (Eq. 4).

    reward: target (R, dg) -> reward of states (R, T, dx) and actions, such as ``rewards.reach``. draw: starts and
    targets of episodes. Episodes and noise are functions of (seed, iteration), so a run resumed from ``checkpoint``
    continues as if it had not stopped; a checkpoint of other starts or targets, by ``summary``, is refused. The model
    is left as it was. A policy whose features have no statistics yet takes those of the model's features first, if it
    has any, and keeps them.

    Raises, with the policy's weights unchanged, ValueError for a reward of the wrong shape or without a gradient and
    FloatingPointError for one that is not finite where states are; TrainingStopped, with the weights of the last record
    in ``policy``, where states or gradients are not finite; StoreError for a checkpoint of another run or in use.
    """
    learner = Learner.of(
        policy,
        model,
        reward,
        draw,
        options or LearningOptions(),
        seed,
        measure=measure,
        callback=callback,
        checkpoint=checkpoint,
    )
    o, state, trained = learner.options, learner.state, learner.trained
    optimizer = state.optimizers["adam"]
    purpose = f"learning a policy, seed {seed}"
    with resumable(state, purpose=purpose, progress=progress) as bar, _frozen(model):
        if not state.step:
            learner.record()
        for iteration in range(state.step, o.iterations):
            began = time.process_time()
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(iteration, o.lr, o.lr_decay, o.lr_final)
            value = discounted(learner.rewards(iteration, o.episodes), o.gamma).mean(
                1
            )  # Eq. 4, (M,)
            optimizer.zero_grad(set_to_none=True)
            (-value.sum()).backward()
            if not torch.isfinite(
                clip_gradients([p.grad for p in trained if p.grad is not None], o.clip)
            ).all():
                raise state.stopped(NOT_FINITE, iteration)
            optimizer.step()
            state.step, state.seconds = iteration + 1, state.seconds + time.process_time() - began
            bar.update()
            if state.step % o.record_every == 0 or state.step == o.iterations:
                learner.record()
                state.save()
                bar.set_postfix(predicted=-state.best_loss)
    return state.curve


@dataclass(frozen=True)
class Learner:
    """Imagined episodes of a policy, functions of (seed, iteration), and what is recorded of them."""

    policy: Policy
    model: Model
    reward: Callable[[Tensor], Reward]
    draw: Draw
    options: LearningOptions
    seed: int
    state: TrainingState[LearningCurve]
    measure: Measure | None = None
    callback: Callback | None = None

    @classmethod
    def of(
        cls,
        policy: Policy,
        model: Model,
        reward: Callable[[Tensor], Reward],
        draw: Draw,
        options: LearningOptions,
        seed: int,
        *,
        measure: Measure | None = None,
        callback: Callback | None = None,
        checkpoint: Path | None = None,
    ) -> Self:
        """As learning starts: with statistics, and a new optimiser. Called by the two public functions, whose callers
        are shown a warning of ``_take_statistics``."""
        _take_statistics(policy, model)
        optimizer = torch.optim.Adam(
            [p for p in policy.parameters() if p.requires_grad], lr=options.lr
        )
        identity = asdict(options) | dict(
            policy=type(policy).__name__,
            copies=policy.copies,
            model=_digest(model),
            reward=getattr(reward, "__name__", "reward"),
            seed=seed,
        )
        if checkpoint is not None:
            identity["drawn"] = summary(draw)
        state = TrainingState(
            policy, {"adam": optimizer}, LearningCurve(), options.iterations, identity, checkpoint
        )
        return cls(policy, model, reward, draw, options, seed, state, measure, callback)

    @property
    def trained(self) -> list[nn.Parameter]:
        """The weights that are learned."""
        return [p for p in self.policy.parameters() if p.requires_grad]

    def episodes(self, iteration: int, n: int) -> tuple[Tensor, Tensor, SeparateNoise]:
        """Starts and targets (M n, .) of n episodes of each copy, and what draws their noise."""
        seeds = [(self.seed + m) * 1_000_003 + iteration for m in range(self.policy.copies)]
        generators = tuple(torch.Generator().manual_seed(seed) for seed in seeds)
        start, target = (
            torch.cat(part) for part in zip(*(self.draw(n, g) for g in generators), strict=True)
        )
        return start, target, SeparateNoise(generators)

    def rewards(self, iteration: int, n: int) -> Tensor:
        """Rewards of each step of n episodes of each copy: (M, n, T)."""
        start, target, noise = self.episodes(iteration, n)
        seen = imagine(
            self.policy,
            self.model,
            start,
            target,
            horizon=self.options.horizon,
            noise=self.options.noise,
            generator=noise,
        )
        return self.checked_rewards(target, seen, iteration)

    def checked_rewards(self, target: Tensor, seen: Segment, iteration: int) -> Tensor:
        """Rewards (M, n, T) of imagined episodes (M n, T, .); see ``learn_policy`` for what is raised."""
        if not torch.isfinite(seen.states).all():
            raise self.state.stopped("the model predicts states that are not finite", iteration)
        rewards = rewarded(self.reward(target), *seen)
        if rewards.isinf().any():
            raise FloatingPointError(
                "the reward is infinite, although the states are finite; look for a division in it"
            )
        if torch.is_grad_enabled() and not rewards.requires_grad:
            raise ValueError(
                "the reward has no gradient: write it with differentiable torch operations on the states or actions "
                "(no comparisons, rounding, .detach(), .item() or numpy)"
            )
        return rewards.unflatten(0, (self.policy.copies, -1))

    def record(self) -> None:
        """A point of the curve; the present weights are those to go back to."""
        with torch.no_grad():
            predicted = (
                self.rewards(self.options.iterations, 50).sum(-1).mean(1)
            )  # the same episodes every time
        curve = self.state.curve
        curve.iteration.append(self.state.step)
        curve.seconds.append(self.state.seconds)
        curve.predicted.append(predicted.tolist())
        for name, values in (self.measure(self.policy) if self.measure else {}).items():
            curve.measured.setdefault(name, []).append(values.tolist())
        self.state.keep(-predicted.mean().item())
        if self.callback is not None:
            newest = {"predicted": curve.predicted[-1]} | {
                name: rows[-1] for name, rows in curve.measured.items()
            }
            means = {name: sum(values) / len(values) for name, values in newest.items()}
            self.callback(Progress(self.state.step, self.state.seconds, means))


def discounted(rewards: Tensor, gamma: float) -> Tensor:
    """sum_t gamma^t r_t over the last dimension, the first step counted in full (Eq. 4 up to a factor gamma)."""
    return (
        rewards
        * gamma ** torch.arange(rewards.shape[-1], dtype=rewards.dtype, device=rewards.device)
    ).sum(-1)


def learning_rate(
    iteration: int, lr: float = 1e-3, decay: float = 0.9, final: float = 1e-4
) -> float:
    """``lr``, decayed every 100 iterations until it is ``final`` (A.3)."""
    return max(final, lr * decay ** (iteration // 100))


def episodes_from(starts: Tensor, *, radius: float = 0.2) -> Draw:
    """Episodes that start in one of ``starts`` (N, dx), with a target uniform in the disc of ``radius`` m (A21)."""

    def draw(n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        index = torch.randint(len(starts), (n,), generator=generator)
        distance, angle = torch.rand(2, n, generator=generator, dtype=starts.dtype)
        angle = 2 * math.pi * angle
        target = radius * distance.sqrt()[:, None] * torch.stack([angle.cos(), angle.sin()], dim=1)
        return starts[index], target

    return draw


def summary(draw: Draw, n: int = 1000) -> dict[str, list[list[float]]]:
    """Mean and standard deviation of ``n`` starts and targets, which tell one distribution of episodes from another.

    To four decimals, so that they are the same on every machine.
    """
    drawn = zip(("starts", "targets"), draw(n, torch.Generator().manual_seed(0)), strict=True)
    return {
        name: [
            [round(x, 4) for x in part.tolist()]
            for part in (values.double().mean(0), values.double().std(0))
        ]
        for name, values in drawn
    }


def clip_gradients(gradients: Sequence[Tensor], norm: float) -> Tensor:
    """Shorten each copy's gradients (M, ...) to ``norm``, in place, unless that is 0; the norms before (M,)."""
    found = torch.stack([g.flatten(1).square().sum(1) for g in gradients]).sum(0).sqrt()
    if norm:
        for g in gradients:
            g *= (norm / found).clamp(max=1).reshape(-1, *[1] * (g.ndim - 1))
    return found


def _take_statistics(policy: Policy, model: Model) -> None:
    """Those of the model's features, where the policy's have none."""
    own, known = policy.features, getattr(model, "features", None)
    if own.fitted or not isinstance(known, Features) or own.step_std.shape != known.step_std.shape:
        return
    if own.angles == known.angles:
        own.load_state_dict(known.state_dict())
    else:
        warnings.warn(
            f"the policy has the angles {own.angles}, the model {known.angles}, so that it learns on states in raw "
            f"units. Make it with angles={tuple(known.angles)}, or call policy.features.fit(torch.from_numpy(states))",
            stacklevel=5,
        )


def _digest(model: Model) -> str:
    """Which model a policy was learned in, for its checkpoint."""
    return (
        artifacts.digest(model.state_dict())
        if isinstance(model, nn.Module)
        else type(model).__name__
    )


@contextmanager
def _frozen(model: Model) -> Iterator[None]:
    """No gradients for the model's own weights."""
    weights = (
        [p for p in model.parameters() if p.requires_grad] if isinstance(model, nn.Module) else []
    )
    for p in weights:
        p.requires_grad_(False)
    try:
        yield
    finally:
        for p in weights:
            p.requires_grad_(True)
