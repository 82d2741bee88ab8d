"""Policies learned inside a model: back-propagation through time (section 4.3, A.3, Eq. 4).

    max over theta of eta = E[ sum_t gamma^t r(x_t, u_t) ],   u_t ~ pi_theta,   x_{t+1} ~ the model

    OneStepPolicy    u_t ~ N(pi(x_t, g), sd^2)            a fully connected network
    SegmentPolicy    Z ~ N(pi(X-, U-, g), sd^2)           acts by the first action that the action prior decodes from Z

g is the target, so one policy serves every instance of a task. The real environment is never asked while learning.

Copies. A policy holds M independent copies of itself as stacked weights (M, in, out), trained side by side by batched
products. Rows are laid out copy by copy, (M, B): the first B rows belong to copy 0. Copy m starts from weights and
learns from noise drawn from ``seed + m`` alone, so it learns as it would on its own.

Letters in shapes: M copies, B episodes of each, R = M B rows, T horizon, dx, du, dz, dg size of state, action, code,
target.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from tsmlib.models.base import DynamicsModel, stepper
from tsmlib.models.layers import on_device_of
from tsmlib.policies.networks import Policy
from tsmlib.rewards import Reward
from tsmlib.sampling import Noise, SeparateNoise, standard_normal
from tsmlib.storage import artifacts
from tsmlib.storage.files import only_writer
from tsmlib.training.checkpoint import TrainingState, TrainingStopped
from tsmlib.trajectory import Segment, initial_past

# The latest state x_t (R, dx), the action u_{t-1} (R, du) that led to it, noise (R, output_dim) -> u_t (R, du)
Draw = Callable[[int, torch.Generator], tuple[Tensor, Tensor]]  # n -> starting states (n, dx), targets (n, dg)
Measure = Callable[[Any], Mapping[str, Tensor]]  # policy -> named numbers, one per copy (M,)


def imagine(
    policy: Policy,
    model: DynamicsModel,
    start: Tensor,
    target: Tensor,
    *,
    horizon: int = 50,  # A.3
    noise: float = 0.01,  # standard deviation of the policy's output, A.3
    generator: Noise | None = None,
) -> Segment:
    """What the model says would happen if the policy acted from ``start`` (R, dx): states (R, T, dx), actions.

    Differentiable in the policy's parameters. No generator: no noise, and the model's mode. Policy and model are on one
    device; ``start`` and ``target`` may be elsewhere, and what is returned is where ``start`` is.
    """
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}, expected a positive number of steps")
    home, (start, target) = start.device, on_device_of(policy, start, target)
    past = initial_past(start, max(policy.past_len, model.past_len), policy.action_dim)
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


@dataclass
class LearningCurve:
    """What ``learn_policy`` recorded: updates done, processor seconds, and one number per copy for each of the rest.

    predicted: undiscounted return that the model promises, mean over 50 episodes that are the same at every record;
    measured: whatever ``measure`` returned, such as the true return in the environment. resumed: as in a Curve.
    """

    iteration: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    predicted: list[list[float]] = field(default_factory=list)
    measured: dict[str, list[list[float]]] = field(default_factory=dict)
    resumed: list[str] = field(default_factory=list)


@torch.enable_grad()  # see train.fit
def learn_policy(
    policy: Any,
    model: DynamicsModel,
    reward: Callable[[Tensor], Reward],
    draw: Draw,
    *,
    horizon: int = 50,  # A.3, as all that follows
    gamma: float = 0.99,
    noise: float = 0.01,  # standard deviation of the policy's output
    episodes: int = 20,  # per update, of each copy
    iterations: int = 2200,  # until the rate has decayed (A25)
    lr: float = 1e-3,
    lr_decay: float = 0.9,  # per 100 iterations
    lr_final: float = 1e-4,
    clip: float = 0.0,  # norm that each copy's gradient is shortened to; 0: never, the paper states none
    seed: int = 0,  # of copy 0; copy m has seed + m
    record_every: int = 100,  # iterations; a checkpoint is written as often
    measure: Measure | None = None,  # also before the first iteration
    checkpoint: Path | None = None,  # a folder of its own
    progress: str = "",  # title of the progress bar; none without
) -> LearningCurve:
    """Improve all copies of ``policy`` (a Policy and nn.Module) in ``model`` by Adam on the discounted return (Eq. 4).

    reward: target (R, dg) -> reward of states (R, T, dx) and actions, such as ``rewards.reach``. draw: where episodes
    start and what is to be reached. Episodes and noise are functions of (seed, iteration), so a run resumed from
    ``checkpoint`` continues as if it had not stopped. The model is left as it was.

    Raises ValueError, with the policy unchanged, for a reward of the wrong shape, that is not finite where states are,
    or that has no gradient; TrainingStopped, with the weights of the last record in ``policy``, where states or
    gradients are not finite; StoreError for a checkpoint of another run, or one that another process writes.
    """
    if min(horizon, episodes, iterations, record_every) < 1:
        raise ValueError(
            f"horizon {horizon}, episodes {episodes}, iterations {iterations}, record_every {record_every}: "
            "expected positive numbers"
        )
    trained = [p for p in policy.parameters() if p.requires_grad]
    optimizer = torch.optim.Adam(trained, lr=lr)
    state = TrainingState(policy, optimizer, LearningCurve())
    identity = dict(
        policy=type(policy).__name__, copies=policy.copies, model=_digest(model),
        reward=getattr(reward, "__name__", "reward"), horizon=horizon, gamma=gamma, noise=noise,
        episodes=episodes, iterations=iterations, lr=lr, lr_decay=lr_decay, lr_final=lr_final, clip=clip,
        seed=seed, record_every=record_every,
    )  # fmt: skip
    generators = tuple(torch.Generator() for _ in range(policy.copies))

    def earned(iteration: int, n: int) -> Tensor:
        """Reward of each step of n imagined episodes of each copy, a function of (seed, iteration): (M, n, T)."""
        for m, generator in enumerate(generators):
            generator.manual_seed((seed + m) * 1_000_003 + iteration)
        start, target = (torch.cat(part) for part in zip(*(draw(n, g) for g in generators), strict=True))
        noises = SeparateNoise(generators)
        seen = imagine(policy, model, start, target, horizon=horizon, noise=noise, generator=noises)
        if not torch.isfinite(seen.states).all():
            raise _stopped(state, "the model predicts states that are", iteration, iterations)
        return _checked(reward(target)(*seen), seen).unflatten(0, (policy.copies, n))

    def record() -> None:
        with torch.no_grad():
            promised = earned(iterations, 50).sum(-1).mean(1)  # the same episodes every time
        state.curve.iteration.append(state.step)
        state.curve.seconds.append(state.seconds)
        state.curve.predicted.append(promised.tolist())
        for name, values in (measure(policy) if measure else {}).items():
            state.curve.measured.setdefault(name, []).append(values.tolist())
        state.best = {name: tensor.detach().clone() for name, tensor in policy.state_dict().items()}
        state.best_step, state.best_loss = state.step, -promised.mean().item()
        if checkpoint is not None and state.step:
            state.save(checkpoint, identity)

    with ExitStack() as stack:
        if checkpoint is not None:
            stack.enter_context(only_writer(checkpoint, f"learning a policy, seed {seed}"))
            state.load(checkpoint, identity)
        bar = stack.enter_context(
            tqdm(total=iterations, initial=state.step, desc=progress, disable=not progress, mininterval=1.0)
        )
        stack.enter_context(_frozen(model))
        if not state.step:
            record()
        for iteration in range(state.step, iterations):
            began = time.process_time()
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(iteration, lr, lr_decay, lr_final)
            value = discounted(earned(iteration, episodes), gamma).mean(1)  # Eq. 4, (M,)
            optimizer.zero_grad(set_to_none=True)
            (-value.sum()).backward()
            if not torch.isfinite(_clip(trained, clip)).all():
                raise _stopped(state, "the gradient of the return is", iteration, iterations)
            optimizer.step()
            state.step, state.seconds = iteration + 1, state.seconds + time.process_time() - began
            bar.update()
            if state.step % record_every == 0 or state.step == iterations:
                record()
                bar.set_postfix(predicted=-state.best_loss)
    return state.curve


def discounted(rewards: Tensor, gamma: float) -> Tensor:
    """sum_t gamma^t r_t over the last dimension, the first step counted in full (Eq. 4 up to a factor gamma)."""
    return (rewards * gamma ** torch.arange(rewards.shape[-1], dtype=rewards.dtype, device=rewards.device)).sum(-1)


def learning_rate(iteration: int, lr: float = 1e-3, decay: float = 0.9, final: float = 1e-4) -> float:
    """``lr``, decayed every 100 iterations until it is ``final`` (A.3)."""
    return max(final, lr * decay ** (iteration // 100))


def episodes_from(starts: Tensor, *, radius: float = 0.2) -> Draw:
    """Episodes that start in one of ``starts`` (N, dx), with a target uniform in the disc of ``radius`` m (A21).

    With the first states of the model's own training data the environment need not be asked for any.
    """

    def draw(n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        index = torch.randint(len(starts), (n,), generator=generator)
        distance, angle = torch.rand(2, n, generator=generator, dtype=starts.dtype)
        angle = 2 * math.pi * angle
        target = radius * distance.sqrt()[:, None] * torch.stack([angle.cos(), angle.sin()], dim=1)
        return starts[index], target

    return draw


def _checked(rewards: Tensor, seen: Segment) -> Tensor:
    """Rewards (R, T) of finite states, if they can be learned from; ValueError says what is wrong with them."""
    expected = tuple(seen.states.shape[:2])
    if not isinstance(rewards, Tensor) or tuple(rewards.shape) != expected:
        found = tuple(rewards.shape) if isinstance(rewards, Tensor) else type(rewards).__name__
        raise ValueError(
            f"the reward of states {tuple(seen.states.shape)} and actions {tuple(seen.actions.shape)} is {found}; "
            f"expected one number per episode and step, {expected}"
        )
    bad = torch.nonzero(~torch.isfinite(rewards))
    if len(bad):
        episode, step = bad[0].tolist()
        raise ValueError(
            f"{len(bad)} of {rewards.numel()} rewards are not finite, the first in episode {episode}, step {step}: "
            f"{rewards[episode, step].item()}, though the state there is finite: {seen.states[episode, step].tolist()}"
        )
    if torch.is_grad_enabled() and not rewards.requires_grad:
        raise ValueError(
            "the reward has no gradient: write it with differentiable torch operations on the states or actions "
            "(no comparisons, rounding, .detach(), .item() or numpy)"
        )
    return rewards


def _stopped(state: TrainingState, what: str, iteration: int, iterations: int) -> TrainingStopped:
    """Go back to the weights of the last record; the error to raise."""
    state.restore_best()
    return TrainingStopped(
        f"{what} not finite at iteration {iteration} of {iterations}; the weights of iteration {state.best_step} are "
        "kept. Check that the reward's gradient is finite everywhere, or learn with a smaller lr, or clip"
    )


def _clip(parameters: Sequence[Tensor], norm: float) -> Tensor:
    """Shorten each copy's gradient to ``norm``; the norms before (M,)."""
    gradients = [p.grad for p in parameters if p.grad is not None]
    found = torch.stack([g.flatten(1).square().sum(1) for g in gradients]).sum(0).sqrt()
    if norm:
        for g in gradients:
            g *= (norm / found.clamp(min=norm)).reshape(-1, *[1] * (g.ndim - 1))
    return found


def _digest(model: Any) -> str:
    """Which model a policy was learned in, for its checkpoint."""
    return artifacts.digest(model.state_dict()) if isinstance(model, nn.Module) else type(model).__name__


@contextmanager
def _frozen(model: Any) -> Iterator[None]:
    """No gradients for the model's own weights."""
    weights = [p for p in model.parameters() if p.requires_grad] if isinstance(model, nn.Module) else []
    for p in weights:
        p.requires_grad_(False)
    try:
        yield
    finally:
        for p in weights:
            p.requires_grad_(True)
