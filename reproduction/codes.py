"""What the codes of segment models hold (table 04), and noise that is filtered (table 06)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress

import numpy as np
import torch

from reproduction.episodes import load_data, load_model
from reproduction.measures import filtering, latent
from reproduction.measures.contacts import (
    Deflections,
    contacts,
    deflections,
    recall,
    touched,
    windows_before_contact,
)
from reproduction.measures.futures import HORIZON, STARTS, SampledFutures, sample_futures
from reproduction.measures.statistics import spearman
from reproduction.runs import Run, env_id
from reproduction.scores import OPEN, SEGMENTS, sizes
from reproduction.tables import Row, place
from tsmlib.envs.spec import EnvSpec
from tsmlib.models.tsm import TSM
from tsmlib.rewards import BLOCK


def code_rows(run: Run, name: str, word: str) -> list[Row]:
    """KL, active dimensions, spread and error of codes; where an arm pushes, also contacts and
    deflections."""
    net, (n, samples) = load_model(run, name, word), sizes(run)
    test = load_data(run, name, "test").take(slice(n))
    pushes = EnvSpec.parse(env_id(name)).task == "push"
    steps = HORIZON if pushes else net.code_len
    seen = sample_futures(net, test, samples=samples, horizon=steps, seed=run.seed)
    about = place(env_id(name)) | {"model": word, "planner": "none"}
    first, draw = seen.first(net.code_len), torch.Generator().manual_seed(run.seed)
    after = touched(first).cummax(1).values
    found = list(_encoded(net, first, after[:, -1], draw)) if isinstance(net, TSM) else []
    for i, value in enumerate(latent.total_effects(net, first.window, draw).tolist()):
        found.append({"metric": "importance", "value": value, "dimension": i})
    found += _spread(first, after, net)
    rows = [about | {"execution": SEGMENTS, "n": len(after)} | row for row in found]
    if pushes:
        rows += [about | {"execution": OPEN} | row for row in _contacts(seen)]
        with suppress(ValueError):  # no episode of few has a first touch
            swings, _ = windows_before_contact(net, test, samples=samples, seed=run.seed)
            rows += [about | {"execution": OPEN} | row for row in _deflections(deflections(swings))]
    return [row for row in rows if math.isfinite(row["value"])]


def _encoded(
    model: TSM, seen: SampledFutures, ever: torch.Tensor, draw: torch.Generator
) -> Iterator[Row]:
    """KL, active dimensions and reconstruction, of all segments, without and with a touch."""
    past, future = seen.window.past, seen.window.future
    with torch.no_grad():
        mean, log_variance = model.encode(future.states)
        twice = torch.stack([model.decode(past, future.actions, mean) for _ in range(2)])
    yield {"metric": "fixed_code_variance", "value": float(twice.var(0, correction=0).mean())}
    kl = latent.kl_by_dimension(mean, log_variance)
    yield {"metric": "active_units", "value": float(latent.active_units(mean).sum())}
    for i, value in enumerate(kl.mean(0).tolist()):
        yield {"metric": "kl_dimension", "value": value, "dimension": i}
    if EnvSpec.parse(seen.env).task == "push":
        way = future.states[:, -1, BLOCK] - past.states[:, -1, BLOCK]
        moved = way.norm(dim=1) > 0.01  # m
        if moved.sum() > 2 * model.latent_dim:
            told = latent.directions(mean[moved], way[moved])[1]
            yield {"metric": "direction_told", "value": told, "subset": "object moves"}
    errors = latent.reconstruction(model, seen.window, draw)
    subsets = {"": torch.ones_like(ever)}
    if EnvSpec.parse(seen.env).has_block:
        subsets |= {"free": ~ever, "contact": ever}
    for subset, chosen in subsets.items():
        if chosen.any():
            about = {"subset": subset, "n": int(chosen.sum())}
            yield about | {"metric": "kl", "value": float(kl[chosen].sum(1).mean())}
            for source, each in errors.items():
                yield about | {"metric": f"error_{source}", "value": float(each[chosen].mean())}


def _spread(seen: SampledFutures, after: torch.Tensor, model: TSM) -> Iterator[Row]:
    """Spread and error of samples, over all steps, and before and after the first touch."""
    variance, squared = latent.deviations(seen, model.features)
    ever, mean = after[:, -1], variance.mean(1)
    yield {"metric": "spread", "value": latent.root_mean(variance)}
    yield {"metric": "error", "value": latent.root_mean(squared)}
    yield {"metric": "spearman", "value": spearman(mean, squared.mean(1))}
    if EnvSpec.parse(seen.env).has_block and ever.any():
        both = after.any(0) & (~after).any(0)  # steps at which some have ever and some have not
        before, since = (
            latent.root_mean(variance[:, both], where[:, both]) for where in (~after, after)
        )
        yield {"metric": "spread", "subset": "before touch", "value": before}
        yield {"metric": "spread", "subset": "after touch", "value": since}
        yield {"metric": "spread_ratio", "value": since / before, "n": int(ever.sum())}
        inside = spearman(mean[ever], squared.mean(1)[ever])
        yield {"metric": "spearman", "subset": "contact", "value": inside}


def _contacts(seen: SampledFutures) -> Iterator[Row]:
    """Recall and precision of contacts within the horizon, and in each stretch of ten steps."""
    steps = seen.samples.shape[2]
    stretches: dict[int | None, range] = {None: range(steps)}
    stretches |= {end: range(end - 10, end) for end in range(10, steps + 1, 10)}
    for event, (truth, samples) in contacts(seen).items():
        others = samples.roll(len(STARTS), 1)  # the same stretch of another episode
        for end, stretch in stretches.items():
            shares = recall(truth, samples, stretch)
            about = {"subset": event, "steps_ahead": end, "n": shares.pop("n")}
            shares["chance"] = recall(truth, others, stretch)["recall"]
            for metric, value in shares.items():
                yield about | {"metric": metric, "value": value, "unit": "share"}


def _deflections(found: Deflections) -> Iterator[Row]:
    """Directions and distances after the first touch."""
    if not len(found.travel):
        return
    low, high = torch.quantile(found.travels, torch.tensor([0.1, 0.9]), dim=0)
    miss, spread = (found.travels.mean(0) - found.travel).abs(), found.travels.std(0)
    inside = (found.travel >= low) & (found.travel <= high)
    for metric, value in {
        "deflection_error": float(found.error.median()),
        "deflection_spread": float(found.spread.median()),
        "deflection_spearman": spearman(found.spread, found.error),
        "deflection_coverage80": float(found.inside().float().mean()),
        "deflection_still": found.still,
        "travel_error": float(miss.median()),
        "travel_spread": float(spread.median()),
        "travel_spearman": spearman(spread, miss),
        "travel_coverage80": float(inside.float().mean()),
    }.items():
        yield {"metric": metric, "value": value, "subset": "first touch", "n": len(miss)}


def filter_rows(run: Run, name: str, word: str) -> list[Row]:
    """Errors to the true state where sensors are noisy: of a model, of ``none`` (the raw
    observation), of a tuned Kalman ``filter`` and of an ``exponential`` average (claim C44)."""
    clean_name, (n, samples) = name.partition("-")[0], sizes(run)
    test, truth = (load_data(run, each, "test").take(slice(n)) for each in (name, clean_name))
    held_out = [load_data(run, each, "validation") for each in (name, clean_name)]
    ahead: np.ndarray | None = None
    now: np.ndarray | None = None
    if word == "none":
        raw = filtering.errors(test.states[:, 1:], truth.states[:, 1:])
        ahead = np.repeat(raw[:, :, None], 10, 2).reshape(-1, 10, raw.shape[-1])
    elif word == "filter":
        noise = EnvSpec.parse(env_id(name)).noise
        kalman = filtering.KalmanFilter.fitted(load_data(run, clean_name, "train"), noise)
        now, ahead = filtering.filter_errors(kalman.tuned(*held_out), test, truth)
    elif word == "exponential":
        keep = filtering.tuned_exponential(*held_out)
        now = filtering.exponential_errors(keep, test, truth)
    else:
        ahead = filtering.model_errors(load_model(run, name, word), test, truth, samples=samples)
    about = place(env_id(name)) | {"model": word, "planner": "none", "execution": SEGMENTS}
    rows: list[Row] = []
    for part, dims in {"": slice(None), **filtering.PARTS}.items():
        here = about | {"metric": f"rmse_clean_{part}".rstrip("_"), "unit": "half range"}
        errors = {0: now} if now is not None else {}
        if ahead is not None:
            errors |= {None: ahead, **dict(enumerate(ahead.swapaxes(0, 1), start=1))}
        for step, each in errors.items():
            value = filtering.rmse(each[..., dims])
            rows.append(here | {"steps_ahead": step, "value": value, "n": len(each)})
    return rows
