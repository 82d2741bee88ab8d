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
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from copy import deepcopy
from dataclasses import dataclass, field
from functools import reduce
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm.auto import tqdm

from tsmlib import store
from tsmlib.checkpoint import Progress, TrainingStopped
from tsmlib.collect import Controller
from tsmlib.disk import only_writer
from tsmlib.dynamics import DynamicsModel, stepper
from tsmlib.nets import Features, Noise, SeparateNoise, beside, standard_normal
from tsmlib.prior import ActionPrior
from tsmlib.rewards import Reward
from tsmlib.trajectory import Segment, initial_past

Act = Callable[[Tensor, Tensor, Tensor | None], Tensor]
# The latest state x_t (R, dx), the action u_{t-1} (R, du) that led to it, noise (R, output_dim) -> u_t (R, du)
Draw = Callable[[int, torch.Generator], tuple[Tensor, Tensor]]  # n -> starting states (n, dx), targets (n, dg)
Measure = Callable[[Any], Mapping[str, Tensor]]  # policy -> named numbers, one per copy (M,)


class Policy(Protocol):
    """What ``improve`` trains: M copies of pi(. | past, target), asked one step at a time."""

    copies: int
    past_len: int
    action_dim: int
    output_dim: int  # of what is noisy: the action, or the code of a segment

    def begin(self, past: Segment, target: Tensor) -> Act:
        """Get ready to act after ``past`` (R, L, .), whose last step is the first that the result is given."""
        ...

    def parameters(self) -> Iterator[nn.Parameter]: ...


class Stacked(nn.Module):
    """M linear layers side by side: (M, B, in) -> (M, B, out). Drawn as torch draws one linear layer."""

    def __init__(self, inputs: int, outputs: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__()
        bound = inputs**-0.5

        def drawn(*shape: int) -> nn.Parameter:
            return nn.Parameter(torch.stack([torch.rand(shape, generator=g) * 2 * bound - bound for g in generators]))

        self.weight = drawn(inputs, outputs)  # (M, in, out)
        self.bias = drawn(1, outputs)  # (M, 1, out)

    def forward(self, x: Tensor) -> Tensor:
        return torch.baddbmm(self.bias, x, self.weight)


class OneStepPolicy(nn.Module):
    """pi(u_t | x_t, g): a fully connected network of the present state and target (A.3: 2 x 64, ReLU).

    state_dim, action_dim, target_dim: dx, du, dg. angles: state dimensions in radians. target_std: metres, what a
    target counts in. Its output is squashed to the action bounds by tanh and starts near no torque.
    """

    past_len = 1

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        target_dim: int = 2,
        *,
        angles: tuple[int, ...] = (0, 1),
        hidden: int = 64,
        layers: int = 2,
        target_std: float = 0.1,  # of a coordinate, uniform in the disc of radius 0.2 m
        copies: int = 1,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self._config = dict(
            state_dim=state_dim, action_dim=action_dim, target_dim=target_dim, angles=list(angles), hidden=hidden,
            layers=layers, target_std=target_std, copies=copies,
        )  # fmt: skip
        generators = _generators(copies, seed)
        self.state_dim, self.target_dim, self.copies, self.target_std = state_dim, target_dim, copies, target_std
        self.action_dim = self.output_dim = action_dim
        self.features = Features(state_dim, tuple(angles))
        widths = [self.features.dim + target_dim, *[hidden] * layers, action_dim]
        self.net = nn.ModuleList(Stacked(i, o, generators) for i, o in pairwise(widths))
        with torch.no_grad():
            for parameter in self.net[-1].parameters():
                parameter.mul_(0.1)

    def config(self) -> dict[str, Any]:
        """The constructor's arguments, as they travel with the weights."""
        return dict(self._config)

    def begin(self, past: Segment, target: Tensor) -> Act:
        """It has no memory: the past plays no part."""
        _require_fit(self, past, target)
        goal = _by_copy(self, target / self.target_std)

        def act(x: Tensor, u: Tensor, noise: Tensor | None) -> Tensor:
            s = torch.cat([_by_copy(self, self.features(x)), goal], dim=-1)  # (M, B, in)
            for i, layer in enumerate(self.net):
                s = layer(F.relu(s) if i else s)
            mean = s.tanh().flatten(0, 1)
            return mean if noise is None else (mean + noise).clamp(-1, 1)

        return act


class SegmentPolicy(nn.Module):
    """pi(Z | X-, U-, g) acting through an action prior, with the gated causal layers of the decoders (Eq. 1, A.3).

        h = tanh(W_f * s + V_f g) . sigmoid(W_g * s + V_g g)

    The target takes the place of the code. Positions are steps of the past, (x_t, u_{t-1}) each; the output at the
    last one is the mean of Z. Of the segment that the prior decodes from Z only the first action is executed; then the
    policy is asked again (A31). The receptive field, 1 + sum(dilations), is the past that the policy sees.

    prior: a trained ActionPrior, copied into the policy and never trained by it; or its configuration.
    """

    def __init__(
        self,
        state_dim: int,
        prior: ActionPrior | Mapping[str, Any],
        target_dim: int = 2,
        *,
        angles: tuple[int, ...] = (0, 1),
        channels: int = 32,
        dilations: tuple[int, ...] = (1, 2, 4, 2),  # receptive field 10 = H
        target_std: float = 0.1,
        copies: int = 1,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.prior = deepcopy(prior) if isinstance(prior, ActionPrior) else ActionPrior(**prior)
        self.prior.requires_grad_(False)
        self._config = dict(
            state_dim=state_dim, prior=self.prior.config(), target_dim=target_dim, angles=list(angles),
            channels=channels, dilations=list(dilations), target_std=target_std, copies=copies,
        )  # fmt: skip
        generators = _generators(copies, seed)
        self.state_dim, self.target_dim, self.copies, self.target_std = state_dim, target_dim, copies, target_std
        self.action_dim, self.output_dim = len(self.prior.std), self.prior.latent_dim
        self.dilations = tuple(dilations)
        self.past_len = max(1 + sum(dilations), self.prior.past_len)
        self.features = Features(state_dim, tuple(angles))
        self.inlet = Stacked(self.features.dim + self.action_dim, channels, generators)
        self.taps = nn.ModuleList(Stacked(2 * channels, 2 * channels, generators) for _ in dilations)  # W_f, W_g
        self.outs = nn.ModuleList(Stacked(channels, 2 * channels, generators) for _ in dilations)  # residual, skip
        self.goals = Stacked(target_dim, 2 * channels * len(dilations), generators)  # V_f, V_g of every layer
        self.head = Stacked(channels, self.output_dim, generators)

    def config(self) -> dict[str, Any]:
        """The constructor's arguments, as they travel with the weights."""
        return dict(self._config)

    def begin(self, past: Segment, target: Tensor) -> Act:
        """Read the past but for its last step; the layers' inputs are then carried from step to step."""
        _require_fit(self, past, target)
        past = past.last(self.past_len)
        goals = self.goals(_by_copy(self, target / self.target_std)).chunk(len(self.dilations), dim=-1)
        zeros = goals[0].new_zeros(*goals[0].shape[:2], self.inlet.bias.shape[-1])
        carried = [deque([zeros] * dilation) for dilation in self.dilations]
        for x, u in list(zip(past.states.unbind(1), past.actions.unbind(1), strict=True))[:-1]:
            self._read(x, u, goals, carried)
        actions = deque(past.actions[:, :-1].unbind(1), maxlen=self.prior.past_len)

        def act(x: Tensor, u: Tensor, noise: Tensor | None) -> Tensor:
            z = self.head(F.relu(self._read(x, u, goals, carried))).flatten(0, 1)  # (R, dz)
            actions.append(u)
            return self.prior.first(torch.stack(tuple(actions), dim=1), z if noise is None else z + noise)

        return act

    def _read(self, x: Tensor, u: Tensor, goals: Sequence[Tensor], carried: list[deque[Tensor]]) -> Tensor:
        """One position through all layers: the sum of their skips (M, B, C). Moves ``carried`` one position on."""
        s = self.inlet(_by_copy(self, torch.cat([self.features(x), u / self.prior.std], dim=-1)))
        skips = []
        for taps, out, goal, inputs in zip(self.taps, self.outs, goals, carried, strict=True):
            inputs.append(s)
            filtered, gate = (taps(torch.cat([inputs.popleft(), s], dim=-1)) + goal).chunk(2, dim=-1)
            residual, skip = out(torch.tanh(filtered) * torch.sigmoid(gate)).chunk(2, dim=-1)
            s = s + residual
            skips.append(skip)
        return reduce(torch.add, skips)


def controller(policy: Policy, target: Tensor, *, noise: float = 0.0, generator: Noise | None = None) -> Controller:
    """The policy at work in an environment, for ``collect``: one action, then asked again. target (R, dg).

    noise: standard deviation of its output, drawn from ``generator``; none without.
    """

    def control(past: Segment) -> Tensor:
        states, actions, goal = beside(policy, *past, target)
        shape = (len(goal), policy.output_dim)
        drawn = None if generator is None else noise * standard_normal(shape, generator, goal)
        with torch.no_grad():
            act = policy.begin(Segment(states, actions), goal)
            return act(states[:, -1], actions[:, -1], drawn)[:, None].to(past.states.device)

    return control


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
    home, (start, target) = start.device, beside(policy, start, target)
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
    """What ``improve`` recorded: updates done, processor seconds, and one number per copy for each of the rest.

    predicted: undiscounted return that the model promises, mean over 50 episodes that are the same at every record;
    measured: whatever ``measure`` returned, such as the true return in the environment. resumed: as in a Curve.
    """

    iteration: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    predicted: list[list[float]] = field(default_factory=list)
    measured: dict[str, list[list[float]]] = field(default_factory=dict)
    resumed: list[str] = field(default_factory=list)


@torch.enable_grad()  # see train.fit
def improve(
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
    state = Progress(policy, optimizer, LearningCurve())
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


def _generators(copies: int, seed: int) -> list[torch.Generator]:
    if copies < 1:
        raise ValueError(f"copies is {copies}, expected at least 1")
    return [torch.Generator().manual_seed(seed + m) for m in range(copies)]


def _require_fit(policy: Any, past: Segment, target: Tensor) -> None:
    """ValueError where ``past`` or ``target`` is not what the policy was made for."""
    (rows, steps, state_dim), name = past.states.shape, type(policy).__name__
    if state_dim != policy.state_dim:
        raise ValueError(
            f"states have {state_dim} dimensions, this {name} was made for {policy.state_dim}: it belongs to another "
            "environment"
        )
    if steps < policy.past_len:
        raise ValueError(
            f"the past holds {steps} steps, {name} needs {policy.past_len}; collect with past_len={policy.past_len}"
        )
    if rows % policy.copies:
        raise ValueError(
            f"{rows} episodes do not divide among {policy.copies} copies of the policy; expected a multiple"
        )
    if target.shape != (rows, policy.target_dim):
        raise ValueError(f"targets are {tuple(target.shape)}, expected one per episode, ({rows}, {policy.target_dim})")


def _by_copy(policy: Policy, rows: Tensor) -> Tensor:
    """(R, k) -> (M, B, k)."""
    return rows.unflatten(0, (policy.copies, -1))


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


def _stopped(state: Progress, what: str, iteration: int, iterations: int) -> TrainingStopped:
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
    return store.digest(model.state_dict()) if isinstance(model, nn.Module) else type(model).__name__


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
