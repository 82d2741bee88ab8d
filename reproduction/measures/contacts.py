"""Contacts of arm, object and walls: steps in contact, contact events, recall, and deflections
(figure 9).

Letters in shapes: S samples, N windows of test episodes, T steps, E first touches.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from reproduction.measures.exploitation import NEAR
from reproduction.measures.futures import HORIZON, Coded, SampledFutures
from tsmlib.envs.geometry import DT, closest_gap, room, slide_time
from tsmlib.envs.spec import EnvSpec
from tsmlib.models.base import rollout
from tsmlib.rewards import BLOCK
from tsmlib.trajectory import Trajectories


def contact_steps(states: np.ndarray, env: str, *, gap: float = 0.002) -> Tensor:
    """(N, T + 1, dx) -> (N, T) bool: the arm is within ``gap`` metres of the block before or after
    the step.

    Within 2 mm lie 99 % of the steps in which the arm speeds the object up.
    """
    near = torch.from_numpy(closest_gap(states, env) < gap)
    return near[:, 1:] | near[:, :-1]


def after_first(steps: Tensor) -> Tensor:
    """(N, T) bool -> (N, T) bool: there was one at this step or before."""
    return steps.cummax(1).values


WITHIN = 2  # steps by which a predicted contact may be early or late
# steps before the first touch at which the windows of figure 9 begin: the arm is about to swing
LEAD = 5
AHEAD = 5  # steps after the touch at which a deflection is read


@torch.no_grad()
def windows_before_contact(
    model: Coded, test: Trajectories, *, samples: int, horizon: int = HORIZON, seed: int = 0
) -> tuple[SampledFutures, np.ndarray]:
    """The windows of figure 9, which begin LEAD steps before the first touch of an episode, and
    whose they are.

    Column LEAD - 1 of the future holds the first state that touches. Episodes (N,) without a touch,
    or without room for past and horizon around it, are left out; ValueError where none is left.
    """
    near = closest_gap(test.states, test.env) < NEAR
    begin = near.argmax(1) - LEAD  # the state that is observed last
    episodes = np.flatnonzero(
        near.any(1) & (begin >= model.past_len) & (begin + horizon <= test.steps)
    )
    if not len(episodes):
        raise ValueError(
            f"none of the {len(test)} episodes of {test.env} has a first touch between "
            f"steps {model.past_len + LEAD} "
            f"and {test.horizon - horizon + LEAD}; take more episodes or a shorter horizon"
        )
    begins = torch.from_numpy(begin[episodes])
    window = test.windows(torch.from_numpy(episodes), begins, model.past_len, horizon)
    generator = torch.Generator().manual_seed(seed)
    drawn = [
        rollout(model, window.past, window.future.actions, generator=generator)
        for _ in range(samples)
    ]
    return SampledFutures(test.env, window, torch.stack(drawn)), episodes


def contacts(seen: SampledFutures) -> dict[str, tuple[Tensor, Tensor]]:
    """Where contacts begin: event -> truth (N, T) and samples (S, N, T), bool.

    Arm and object touch where they are within 5 mm. Object and wall touch where they are, or where
    the speed with which the object entered the step would have brought them: between two states 20
    ms apart it can have been there and back.
    """
    past, truth = seen.window.past.states[:, -2:], seen.window.future.states
    every = torch.cat([truth[None], seen.samples])  # (1 + S, N, T, dx)
    states = torch.cat(
        [past.expand(len(every), *past.shape), every], dim=2
    ).numpy()  # two states before the first step
    physics = EnvSpec.parse(seen.env).physics
    decay = slide_time(physics)
    slides = decay * (1 - math.exp(-DT / decay))
    position, velocity = states[..., 6:8], states[..., 8:10]
    reached = np.maximum(
        np.abs(position[..., 1:, :]).max(-1),
        np.abs(position[..., :-1, :] + slides * velocity[..., :-1, :]).max(-1),
    )
    near = {
        "object": closest_gap(states[..., 1:, :], seen.env) < NEAR,
        "wall": room(physics) - reached < NEAR,
    }
    begins = {event: torch.from_numpy(at[..., 1:] & ~at[..., :-1]) for event, at in near.items()}
    return {event: (at[0], at[1:]) for event, at in begins.items()}


def recall(truth: Tensor, samples: Tensor, steps: range) -> dict[str, float]:
    """Recall and precision of events that begin at ``steps`` ahead: truth (N, T) and samples (S, N,
    T) bool.

    ``recall``: share of events that a sample has too, up to WITHIN steps early or late, mean over
    samples; ``majority``: share that at least half of the samples have; ``precision``: share of the
    samples' events that are true. ``n`` events. What nothing can be said of is NaN.
    """
    at = torch.zeros(truth.shape[1], dtype=torch.bool)
    at[list(steps)] = True
    true, predicted, n = truth & at, samples & at, int((truth & at).sum())
    found, right = _around(samples) & true, _around(truth) & predicted
    return {
        "n": n,
        "recall": float(found.sum() / (n * len(samples))) if n else math.nan,
        "majority": float(((_around(samples).float().mean(0) >= 0.5) & true).sum() / n)
        if n
        else math.nan,
        "precision": float(right.sum() / predicted.sum()) if predicted.any() else math.nan,
    }


def _around(begins: Tensor) -> Tensor:
    """Bool (..., T): an event begins at most WITHIN steps from here."""
    padded = torch.nn.functional.pad(begins, (WITHIN, WITHIN))
    return padded.unfold(-1, 2 * WITHIN + 1, 1).any(-1)


@dataclass(frozen=True)
class Deflections:
    """Where an object goes that the arm hits: E first touches after which it moved by more than a
    centimetre.

    off (S, E): angle in radians between the sampled path and the true one, to the left positive,
    NaN for a sample whose object did not move; travel (E,) and travels (S, E): distance in metres
    between start and end of the window.
    """

    off: Tensor
    travel: Tensor
    travels: Tensor

    @property
    def error(self) -> Tensor:
        """(E,) degrees between the samples' mean direction and the true one."""
        return torch.rad2deg(self._mean.angle().abs())

    @property
    def spread(self) -> Tensor:
        """(E,) circular standard deviation of the sampled directions, degrees."""
        return torch.rad2deg((-2 * self._mean.abs().clamp(1e-6, 1).log()).sqrt())

    @property
    def still(self) -> float:
        """Share of samples whose object did not move."""
        return float(self.off.isnan().float().mean())

    def inside(self, level: float = 0.8) -> Tensor:
        """(E,) bool: the true direction is in the central interval of the sampled ones that should
        hold ``level``.
        """
        low, high = self.interval(level)
        return (low <= 0) & (high >= 0)

    def interval(self, level: float = 0.8) -> tuple[Tensor, Tensor]:
        """The central interval (E,) of the sampled directions around their mean, degrees off the
        true one.
        """
        if not len(self.travel):
            return self.travel, self.travel
        mean = self._mean.angle()
        around = torch.exp(1j * (self.off - mean)).angle()  # in (-pi, pi]
        edges = (
            torch.nanquantile(around, torch.tensor([(1 - level) / 2, (1 + level) / 2]), dim=0)
            + mean
        )
        return torch.rad2deg(edges[0]), torch.rad2deg(edges[1])

    @property
    def _mean(self) -> Tensor:
        return torch.polar(torch.ones_like(self.off), self.off.nan_to_num()).where(
            ~self.off.isnan(), 0
        ).sum(0) / (~self.off.isnan()).sum(0)


def deflections(seen: SampledFutures) -> Deflections:
    """From windows of ``windows_before_contact``: the way of the object until AHEAD steps after its
    first touch.
    """
    start, step = seen.window.past.states[:, -1, BLOCK], LEAD - 1 + AHEAD
    ways = [
        states[..., [step, -1], BLOCK] - start[:, None]
        for states in (seen.window.future.states, seen.samples)
    ]
    moves = [way[..., 0, :].norm(dim=-1) > 0.01 for way in ways]
    true, sampled = (torch.view_as_complex(way[..., 0, :].contiguous()) for way in ways)
    off = (sampled / true).angle().where(moves[1], torch.nan)
    known = moves[0] & moves[1].any(0)
    travel, travels = (way[..., 1, :].norm(dim=-1) for way in ways)
    return Deflections(off[:, known], travel[known], travels[:, known])


def touched(seen: SampledFutures) -> Tensor:
    """(N, T) bool: the arm touches the obstacle or object before or after the step; never where
    there is none.
    """
    future = seen.window.future.states
    if not EnvSpec.parse(seen.env).has_block:
        return torch.zeros(future.shape[:2], dtype=torch.bool)
    states = torch.cat([seen.window.past.states[:, -1:], future], dim=1)
    return contact_steps(states.numpy(), seen.env)
