"""What the codes of a segment model do: whether they are used, where, and what one of them means (section 5.3.4).

    is the code used?        KL(Q(Z | X+) || N(0, I)) per segment, active units; what each dimension moves
    what does it express?    spread of sampled futures: how large, when, and whether it tells the error
    what happens?            when the arm touches the object, when that hits a wall, where it goes then (figure 9)
    what is one code?        one future; codes in between are futures in between

At test time codes are drawn from N(0, I), and from the encoder where the future is known. Deviations and errors are in
units of the training data's deviation (the feature space of ``tsmlib.evaluate``). The paper gives no number for any of
it.

Letters in shapes: S samples, N windows of test episodes, T steps, H segment length, dz code size.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tsmlib import evaluate
from tsmlib.control import sim_of
from tsmlib.dynamics import rollout
from tsmlib.envs import closest_gap, has_block
from tsmlib.envs.base import BLOCK_DECAY, BLOCK_RADIUS, DT, WALL, task_of
from tsmlib.invariants import NEAR
from tsmlib.nets import Features, kl_from_standard_normal, sample_posterior, standard_normal
from tsmlib.rewards import BLOCK
from tsmlib.scoreboard import values
from tsmlib.trajectory import Segment, Trajectories, Window, windows
from tsmlib.tsm import TSM

STARTS = (10, 40, 70)  # steps at which the windows begin; with HORIZON they hold every step of an episode once
HORIZON = 30
ACTIVE = 0.01  # variance of a unit's posterior mean above which it counts as active (Burda et al., 2016)
WITHIN = 2  # steps by which a predicted contact may be early or late
LEAD = 5  # steps before the first touch at which the windows of figure 9 begin: the arm is about to swing
AHEAD = 5  # steps after the touch at which a deflection is read
EVENTS = ("object", "wall")  # the arm touches the object, the object touches a wall
BARS = {  # what the package set itself before any of it was measured: metric, condition, environment -> bound
    ("kl", "segments", "tsm/Reacher-v0"): ("at most", 0.1),
    ("spread", "segments", "tsm/Reacher-v0"): ("at most", 0.01),
    ("spread_ratio", "segments", "tsm/ReacherPush-v0"): ("at least", 2.0),
    ("recall", "object", "tsm/ReacherPush-v0"): ("at least", 0.8),
    ("recall", "wall", "tsm/ReacherPush-v0"): ("at least", 0.7),
}
Rows = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Seen:
    """Windows of test episodes, and what a model predicts for them with codes from N(0, I).

    window: past (N, L, .) and future (N, T, .); samples (S, N, T, dx), physical units.
    """

    env: str
    window: Window
    samples: Tensor

    @property
    def touched(self) -> Tensor:
        """(N, T) bool: the arm touches the obstacle or object before or after the step; never where there is none."""
        future = self.window.future.states
        if not has_block(self.env):
            return torch.zeros(future.shape[:2], dtype=torch.bool)
        states = torch.cat([self.window.past.states[:, -1:], future], dim=1)
        return evaluate.contact_steps(states.numpy(), self.env)

    def first(self, steps: int) -> Seen:
        """The same windows, cut after ``steps``."""
        past, future = self.window
        future = Segment(*(part[:, :steps] for part in future))
        return replace(self, window=Window(past, future), samples=self.samples[:, :, :steps])


def look(
    model: TSM, test: Trajectories, *, samples: int, horizon: int = HORIZON, seed: int = 0, progress: str = ""
) -> Seen:
    """Windows from STARTS of every test episode, episode by episode, and sampled futures under their true actions."""
    drawn = evaluate.sample_states(
        model, test, samples=samples, horizon=horizon, starts=STARTS, seed=seed, progress=progress
    )
    episodes = torch.arange(len(test)).repeat_interleave(len(STARTS))
    begin = torch.tensor(STARTS).repeat(len(test)) - model.past_len
    return Seen(test.env, windows(test.padded(0), episodes, begin, model.past_len, horizon), drawn)


@torch.no_grad()
def about_to_touch(
    model: TSM, test: Trajectories, *, samples: int, horizon: int = HORIZON, seed: int = 0
) -> tuple[Seen, np.ndarray]:
    """The windows of figure 9, which begin LEAD steps before the first touch of an episode, and whose they are.

    Column LEAD - 1 of the future holds the first state that touches. Episodes (N,) without a touch, or without room
    for past and horizon around it, are left out; ValueError where none is left.
    """
    near = closest_gap(test.states, test.env) < NEAR
    begin = near.argmax(1) - LEAD  # the state that is observed last
    episodes = np.flatnonzero(near.any(1) & (begin >= model.past_len) & (begin + horizon <= test.horizon))
    if not len(episodes):
        raise ValueError(
            f"none of the {len(test)} episodes of {test.env} has a first touch between steps {model.past_len + LEAD} "
            f"and {test.horizon - horizon + LEAD}; take more episodes or a shorter horizon"
        )
    first = torch.from_numpy(begin[episodes]) - model.past_len
    window = windows(test.padded(0), torch.from_numpy(episodes), first, model.past_len, horizon)
    generator = torch.Generator().manual_seed(seed)
    drawn = [rollout(model, window.past, window.future.actions, generator=generator) for _ in range(samples)]
    return Seen(test.env, window, torch.stack(drawn)), episodes


# Is the code used? ---------------------------------------------------------------------------------------------------


def kl_by_dimension(mean: Tensor, log_variance: Tensor) -> Tensor:
    """KL(Q(Z_i | X+) || N(0, 1)) in nats, (N, dz) for the encoder's mean and log variance (N, dz)."""
    return kl_from_standard_normal(mean[..., None], log_variance[..., None])


def active_units(mean: Tensor) -> Tensor:
    """(dz,) bool: dimensions whose posterior mean (N, dz) varies over segments with more than ACTIVE."""
    return mean.var(0) > ACTIVE


@torch.no_grad()
def importance(model: TSM, window: Window, generator: torch.Generator) -> Tensor:
    """How far each dimension of the code moves the next segment, (dz,), in deviations of the data.

    The root of E[(f(z) - f(z with z_i drawn anew))^2] / 2, the total effect of z_i, mean over features, steps and
    windows. Says what the decoder does with a code however it was trained; the encoder has no part in it.
    """
    past, actions = window.past, window.future.actions[:, : model.segment_len]
    z, again = (standard_normal((len(actions), model.latent_dim), generator, actions) for _ in range(2))
    states = model.decode(past, actions, z)
    moved = []
    for i in range(model.latent_dim):
        other = torch.where(torch.arange(model.latent_dim) == i, again, z)
        difference = model.features.difference(model.decode(past, actions, other), states)
        moved.append((difference.square().mean() / 2).sqrt())
    return torch.stack(moved)


@torch.no_grad()
def reconstruction(model: TSM, window: Window, generator: torch.Generator) -> dict[str, Tensor]:
    """Error (N,) of the next segment, root mean square over features and steps, by where its code comes from.

    ``posterior``: drawn from Q(Z | X+), which has seen the segment; ``prior``: drawn from N(0, I); ``zero``: z = 0.
    """
    future = Segment(*(part[:, : model.segment_len] for part in window.future))
    mean, log_variance = model.encode(future.states)
    codes = {
        "posterior": sample_posterior(mean, log_variance, generator),
        "prior": standard_normal(mean.shape, generator, mean),
        "zero": torch.zeros_like(mean),
    }
    errors = {}
    for word, z in codes.items():
        difference = model.features.difference(model.decode(window.past, future.actions, z), future.states)
        errors[word] = difference.square().mean((1, 2)).sqrt()
    return errors


# What does it express? -----------------------------------------------------------------------------------------------


def deviations(seen: Seen, features: Features) -> tuple[Tensor, Tensor]:
    """Variance of the samples, and squared error of their mean: (N, T) each, mean over the features that change."""
    samples = evaluate.scored(features, seen.samples)
    error = samples.mean(0) - evaluate.scored(features, seen.window.future.states)
    return evaluate.spread(samples).mean(-1), error.square().mean(-1)


def root_mean(squares: Tensor, where: Tensor | None = None) -> float:
    """The root of the mean of squares (N, T): over windows (at the places ``where``) first, then over steps.

    Every step counts alike, so that places which lie later than others do not look worse for it. NaN without a place.
    """
    where = torch.ones_like(squares, dtype=torch.bool) if where is None else where
    some = where.any(0)
    by_step = (squares * where).sum(0)[some] / where.sum(0)[some]
    return math.sqrt(by_step.mean()) if some.any() else math.nan


def spearman(a: Tensor, b: Tensor) -> float:
    """Rank correlation of two rows of numbers; 0 where one of them is constant. Ties count in the order they come."""
    ranks = torch.stack([x.flatten().argsort().argsort().double() for x in (a, b)])
    if len(ranks[0]) < 2 or a.min() == a.max() or b.min() == b.max():
        return 0.0
    return float(torch.corrcoef(ranks)[0, 1])


def by_spread(variance: Tensor, squared: Tensor, *, groups: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Spread and error (groups,) of windows sorted by their spread and cut into equal groups, smallest first."""
    spread, error = variance.mean(1), squared.mean(1)
    parts = [part for part in spread.argsort().tensor_split(groups) if len(part)]
    return tuple(np.array([math.sqrt(x[part].mean()) for part in parts]) for x in (spread, error))  # type: ignore


# What happens? -------------------------------------------------------------------------------------------------------


def contacts(seen: Seen) -> dict[str, tuple[Tensor, Tensor]]:
    """Where contacts begin: event -> truth (N, T) and samples (S, N, T), bool.

    Arm and object touch where they are within 5 mm. Object and wall touch where they are, or where the speed with which
    the object entered the step would have brought them: between two states 20 ms apart it can have been there and back.
    """
    past, truth = seen.window.past.states[:, -2:], seen.window.future.states
    every = torch.cat([truth[None], seen.samples])  # (1 + S, N, T, dx)
    states = torch.cat([past.expand(len(every), *past.shape), every], dim=2).numpy()  # two states before the first step
    slides = BLOCK_DECAY * (1 - math.exp(-DT / BLOCK_DECAY))
    position, velocity = states[..., 6:8], states[..., 8:10]
    reached = np.maximum(
        np.abs(position[..., 1:, :]).max(-1), np.abs(position[..., :-1, :] + slides * velocity[..., :-1, :]).max(-1)
    )
    near = {"object": closest_gap(states[..., 1:, :], seen.env) < NEAR, "wall": WALL - BLOCK_RADIUS - reached < NEAR}
    begins = {event: torch.from_numpy(at[..., 1:] & ~at[..., :-1]) for event, at in near.items()}
    return {event: (at[0], at[1:]) for event, at in begins.items()}


def recall(truth: Tensor, samples: Tensor, steps: range) -> dict[str, float]:
    """How well events are foretold that begin at ``steps`` ahead: truth (N, T) and samples (S, N, T) bool.

    ``recall``: share of events that a sample has too, up to WITHIN steps early or late, mean over samples;
    ``majority``: share that at least half of the samples have; ``precision``: share of the samples' events that are
    true. ``n`` events. What nothing can be said of is NaN.
    """
    at = torch.zeros(truth.shape[1], dtype=torch.bool)
    at[list(steps)] = True
    true, foretold, n = truth & at, samples & at, int((truth & at).sum())
    found, right = _around(samples) & true, _around(truth) & foretold
    return {
        "n": n,
        "recall": float(found.sum() / (n * len(samples))) if n else math.nan,
        "majority": float(((_around(samples).float().mean(0) >= 0.5) & true).sum() / n) if n else math.nan,
        "precision": float(right.sum() / foretold.sum()) if foretold.any() else math.nan,
    }


def _around(begins: Tensor) -> Tensor:
    """Bool (..., T): an event begins at most WITHIN steps from here."""
    padded = torch.nn.functional.pad(begins, (WITHIN, WITHIN))
    return padded.unfold(-1, 2 * WITHIN + 1, 1).any(-1)


@dataclass(frozen=True)
class Deflections:
    """Where an object goes that the arm hits: E first touches after which it moved by more than a centimetre.

    off (S, E): angle in radians between the sampled path and the true one, to the left positive, NaN for a sample
    whose object did not move; travel (E,) and travels (S, E): distance in metres between start and end of the window.
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
        """(E,) bool: the true direction is in the central interval of the sampled ones that should hold ``level``."""
        low, high = self.interval(level)
        return (low <= 0) & (high >= 0)

    def interval(self, level: float = 0.8) -> tuple[Tensor, Tensor]:
        """The central interval (E,) of the sampled directions around their mean, degrees off the true one."""
        if not len(self.travel):
            return self.travel, self.travel
        mean = self._mean.angle()
        around = torch.exp(1j * (self.off - mean)).angle()  # in (-pi, pi]
        edges = torch.nanquantile(around, torch.tensor([(1 - level) / 2, (1 + level) / 2]), dim=0) + mean
        return torch.rad2deg(edges[0]), torch.rad2deg(edges[1])

    @property
    def _mean(self) -> Tensor:
        return torch.polar(torch.ones_like(self.off), self.off.nan_to_num()).where(~self.off.isnan(), 0).sum(0) / (
            ~self.off.isnan()
        ).sum(0)


def deflections(seen: Seen) -> Deflections:
    """From windows of ``about_to_touch``: the way of the object until AHEAD steps after its first touch."""
    start, step = seen.window.past.states[:, -1, BLOCK], LEAD - 1 + AHEAD
    ways = [states[..., [step, -1], BLOCK] - start[:, None] for states in (seen.window.future.states, seen.samples)]
    moves = [way[..., 0, :].norm(dim=-1) > 0.01 for way in ways]
    true, sampled = (torch.view_as_complex(way[..., 0, :].contiguous()) for way in ways)
    off = (sampled / true).angle().where(moves[1], torch.nan)
    known = moves[0] & moves[1].any(0)
    travel, travels = (way[..., 1, :].norm(dim=-1) for way in ways)
    return Deflections(off[:, known], travel[known], travels[:, known])


# What is one code? ---------------------------------------------------------------------------------------------------


def between(first: Tensor, second: Tensor, n: int) -> Tensor:
    """n codes from ``first`` to ``second`` (..., dz) along cos(a) first + sin(a) second: (n, ..., dz).

    If both are drawn from N(0, I), so is every code in between, which is not true of a straight line.
    """
    if n < 2:
        raise ValueError(f"n is {n}; a walk from one code to another has at least 2 codes")
    angle = torch.linspace(0, math.pi / 2, n).reshape(n, *[1] * first.ndim)
    codes = angle.cos() * first + angle.sin() * second
    codes[0], codes[-1] = first, second  # exactly
    return codes


@torch.no_grad()
def futures(model: TSM, window: Window, codes: Tensor, steps: int) -> Tensor:
    """What each code (n, dz) makes of one window: states (n, T, dx). One code, then the mode (z = 0) in later segments.

    window: N = 1. steps: T, at most as long as its future.
    """
    n, actions = len(codes), window.future.actions[:, :steps]
    past = Segment(*(part.expand(n, -1, -1) for part in window.past))
    actions, first = actions.expand(n, -1, -1), min(steps, model.segment_len)
    states = model.decode(past, actions[:, :first], codes)
    if steps <= first:
        return states
    past = past.then(Segment(states, actions[:, :first])).last(model.past_len)
    return torch.cat([states, rollout(model, past, actions[:, first:])], dim=1)


def principal(codes: Tensor) -> tuple[Tensor, Tensor]:
    """The two directions of largest variance of codes (N, dz): coordinates (N, 2), and the share of variance (2,)."""
    centred = codes - codes.mean(0)
    _, sizes, axes = torch.linalg.svd(centred, full_matrices=False)
    return centred @ axes[:2].T, sizes[:2].square() / sizes.square().sum().clamp_min(1e-30)


def directions(codes: Tensor, outcome: Tensor) -> tuple[Tensor, float]:
    """The directions (2, dz) of codes (N, dz) along which an outcome (N, 2) changes most, orthonormal, most first.

    By least squares; also the share of the outcome's variance that a linear function of the code explains.
    """
    x, y = codes - codes.mean(0), outcome - outcome.mean(0)
    slope = torch.linalg.lstsq(x, y).solution  # (dz, 2)
    explained = 1 - float((y - x @ slope).square().sum() / y.square().sum().clamp_min(1e-30))
    return torch.linalg.svd(slope, full_matrices=False).U.T, explained


# Rows of metrics/04_latent.csv ---------------------------------------------------------------------------------------


def code_rows(model: TSM, seen: Seen, generator: torch.Generator, /, **common: Any) -> list[dict[str, Any]]:
    """Use of the code and spread of the next segment. common: model, seed, scale. The encoder's part for tsm alone:
    the energy score trains a decoder without it."""
    seen = seen.first(model.segment_len)
    n, after = len(seen.touched), seen.touched.cummax(1).values
    touched = after[:, -1]
    common = dict(common, env=seen.env, sim=sim_of(seen.env), planner="none", n=n)
    subsets = {"segments": torch.ones(n, dtype=torch.bool)}
    if has_block(seen.env):
        subsets |= {"segments free": ~touched, "segments contact": touched}
    rows: list[dict[str, Any]] = []

    def add(metric: str, value: float, condition: str = "segments", unit: str = "", **more: Any) -> None:
        if math.isfinite(value):
            rows.append(dict(common, metric=metric, value=float(value), condition=condition, unit=unit) | more)

    if common["model"] == "tsm":
        with torch.no_grad():
            mean, log_variance = model.encode(seen.window.future.states)
            past, actions = seen.window.past, seen.window.future.actions
            futures = torch.stack([model.decode(past, actions, mean) for _ in range(2)])
        add("fixed_code_variance", float(futures.var(0, correction=0).mean()))
        kl = kl_by_dimension(mean, log_variance)
        add("active_units", float(active_units(mean).sum()))
        for i, value in enumerate(kl.mean(0)):
            add("kl_dimension", float(value), unit="nat", dimension=i)
        if task_of(seen.env) == "push":
            way = seen.window.future.states[:, -1, BLOCK] - seen.window.past.states[:, -1, BLOCK]
            moved = way.norm(dim=1) > 0.01
            if moved.sum() > 2 * model.latent_dim:
                add(
                    "direction_told",
                    directions(mean[moved], way[moved])[1],
                    "object moves",
                    "share",
                    n=int(moved.sum()),
                )
        errors = reconstruction(model, seen.window, generator)
        for condition, chosen in subsets.items():
            if chosen.any():
                add("kl", float(kl[chosen].sum(1).mean()), condition, "nat", n=int(chosen.sum()))
                for word, each in errors.items():
                    add(f"error_{word}", float(each[chosen].mean()), condition, n=int(chosen.sum()))
    for i, value in enumerate(importance(model, seen.window, generator)):
        add("importance", float(value), dimension=i)
    variance, squared = deviations(seen, model.features)
    add("spread", root_mean(variance), unit="share")
    add("error", root_mean(squared), unit="share")
    add("spearman", spearman(variance.mean(1), squared.mean(1)))
    if has_block(seen.env) and touched.any():
        both = after.any(0) & (~after).any(0)  # steps at which some have touched and some have not
        before, since = (root_mean(variance[:, both], where[:, both]) for where in (~after, after))
        add("spread", before, "before touch", "share", n=int((~touched).sum()))
        add("spread", since, "after touch", "share", n=int(touched.sum()))
        add("spread_ratio", since / before, unit="ratio", n=int(touched.sum()))
        inside = variance.mean(1)[touched], squared.mean(1)[touched]
        add("spearman", spearman(*inside), "segments contact", n=int(touched.sum()))
    return rows


def contact_rows(seen: Seen, **common: Any) -> list[dict[str, Any]]:
    """Recall and precision of contacts: of all within the horizon, and by how far ahead they lie (column horizon: the
    last step of a stretch of ten)."""
    common = dict(common, env=seen.env, sim=sim_of(seen.env), planner="none")
    steps = seen.samples.shape[2]
    stretches: dict[Any, range] = {"": range(steps)}
    stretches |= {end: range(end - 10, end) for end in range(10, steps + 1, 10)}
    rows = []
    for event, (truth, samples) in contacts(seen).items():
        others = samples.roll(len(STARTS), 1)  # the same stretch of another episode
        for horizon, stretch in stretches.items():
            found = recall(truth, samples, stretch)
            chance = recall(truth, others, stretch)["recall"]
            for metric, value in (found | {"chance": chance}).items():
                if metric != "n" and math.isfinite(value):
                    rows.append(
                        dict(common, condition=event, metric=metric, value=value, unit="share", n=found["n"],
                             horizon=horizon)
                    )  # fmt: skip
    return rows


def deflection_rows(found: Deflections, env: str, **common: Any) -> list[dict[str, Any]]:
    """Directions and distances after the first touch; no rows where no object was moved."""
    if not len(found.travel):
        return []
    common = dict(common, env=env, sim=sim_of(env), planner="none", condition="first touch", n=len(found.travel))
    low, high = torch.quantile(found.travels, torch.tensor([0.1, 0.9]), dim=0)
    miss = (found.travels.mean(0) - found.travel).abs()
    measured = {
        "deflection_error": (float(found.error.median()), "deg"),
        "deflection_spread": (float(found.spread.median()), "deg"),
        "deflection_spearman": (spearman(found.spread, found.error), ""),
        "deflection_coverage80": (float(found.inside().float().mean()), "share"),
        "deflection_still": (found.still, "share"),
        "travel_error": (float(miss.median()), "m"),
        "travel_spread": (float(found.travels.std(0).median()), "m"),
        "travel_spearman": (spearman(found.travels.std(0), miss), ""),
        "travel_coverage80": (float(((found.travel >= low) & (found.travel <= high)).float().mean()), "share"),
    }
    return [dict(common, metric=metric, value=value, unit=unit) for metric, (value, unit) in measured.items()]


def use_panels(found: Rows, envs: Sequence[str]) -> dict[str, dict[str, dict[str, np.ndarray]]]:
    """What ``figures.code_use`` draws: title -> environment and condition -> model -> one value per seed."""
    panels: dict[str, dict[str, dict[str, np.ndarray]]] = {"KL per segment": {}, "spread of samples": {}}
    whole = ("", "segments", "segments")
    parts = ((", no touch", "segments free", "before touch"), (", with a touch", "segments contact", "after touch"))
    for env in envs:
        for words, kl, spread in parts if has_block(env) else (whole,):
            row = (env.partition("/")[2].partition("-")[0].replace("Reacher", "") or "Reacher") + words
            panels["KL per segment"][row] = values(found, "kl", env=env, condition=kl)
            panels["spread of samples"][row] = values(found, "spread", env=env, condition=spread)
    return panels


def recall_panels(found: Rows, env: str) -> dict[str, dict[str, dict[str, np.ndarray]]]:
    """What ``figures.contact_recall`` draws: title -> model -> metric -> (seeds, 3), where all of it was measured."""
    panels: dict[str, dict[str, dict[str, np.ndarray]]] = {}
    for event, title in zip(EVENTS, ("arm touches object", "object hits wall"), strict=True):
        by_metric = {
            metric: [values(found, metric, env=env, condition=event, horizon=end) for end in range(10, HORIZON + 1, 10)]
            for metric in ("recall", "precision", "chance")
        }
        for model in by_metric["recall"][0]:
            seeds = [part.get(model, np.zeros(0)) for parts in by_metric.values() for part in parts]
            if len({len(part) for part in seeds}) == 1:
                shares = {metric: np.stack([p[model] for p in parts], 1) for metric, parts in by_metric.items()}
                panels.setdefault(title, {})[model] = shares
    return panels


def reached(found: Rows, models: Sequence[str]) -> str:
    """BARS and what was measured, a Markdown table: mean over seeds, and for contacts by how far ahead they lie."""
    lines = ["| what | bar | " + " | ".join(models) + " |", "|---" * (len(models) + 2) + "|"]
    for (metric, condition, env), (word, bound) in BARS.items():
        horizons = [10, ""] if metric == "recall" else [""]
        for horizon in horizons:
            ahead = "" if metric != "recall" else f", {'the next 10' if horizon else 'all 30'} steps"
            cells = []
            for model in models:
                wanted = (metric, condition, env, model, horizon)
                seeds = [row["value"] for row in found if _key(row) == wanted]
                cells.append(f"{np.mean(seeds):.3g}" if seeds else "")
            what = f"`{env}`: {metric.replace('_', ' ')}{f' ({condition})' * (metric == 'recall')}{ahead}"
            lines.append(f"| {what} | {word} {bound:g} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _key(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return row["metric"], row["condition"], row["env"], row["model"], row.get("horizon", "")
