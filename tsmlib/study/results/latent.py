"""Results of 04_latent as rows, panels and thresholds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from tsmlib.envs.spec import has_block, sim_of, task_of
from tsmlib.evaluation.contacts import EVENTS, Deflections, contacts, recall, touched
from tsmlib.evaluation.futures import HORIZON, STARTS, SampledFutures
from tsmlib.evaluation.latent import (
    active_units,
    deviations,
    directions,
    importance,
    kl_by_dimension,
    reconstruction,
    root_mean,
)
from tsmlib.models.tsm import TSM
from tsmlib.rewards import BLOCK
from tsmlib.statistics import spearman
from tsmlib.study.results.prediction import values

BARS = {  # what the package set itself before any of it was measured: metric, condition, environment -> bound
    ("kl", "segments", "tsm/Reacher-v0"): ("at most", 0.1),
    ("spread", "segments", "tsm/Reacher-v0"): ("at most", 0.01),
    ("spread_ratio", "segments", "tsm/ReacherPush-v0"): ("at least", 2.0),
    ("recall", "object", "tsm/ReacherPush-v0"): ("at least", 0.8),
    ("recall", "wall", "tsm/ReacherPush-v0"): ("at least", 0.7),
}
Rows = Sequence[Mapping[str, Any]]


# Rows of metrics/04_latent.csv ---------------------------------------------------------------------------------------


def code_rows(model: TSM, seen: SampledFutures, generator: torch.Generator, /, **common: Any) -> list[dict[str, Any]]:
    """Use of the code and spread of the next segment. common: model, seed, scale. The encoder's part for tsm alone:
    the energy score trains a decoder without it."""
    seen = seen.first(model.segment_len)
    after = touched(seen).cummax(1).values
    n, ever = len(after), after[:, -1]
    common = dict(common, env=seen.env, sim=sim_of(seen.env), planner="none", n=n)
    subsets = {"segments": torch.ones(n, dtype=torch.bool)}
    if has_block(seen.env):
        subsets |= {"segments free": ~ever, "segments contact": ever}
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
    if has_block(seen.env) and ever.any():
        both = after.any(0) & (~after).any(0)  # steps at which some have ever and some have not
        before, since = (root_mean(variance[:, both], where[:, both]) for where in (~after, after))
        add("spread", before, "before touch", "share", n=int((~ever).sum()))
        add("spread", since, "after touch", "share", n=int(ever.sum()))
        add("spread_ratio", since / before, unit="ratio", n=int(ever.sum()))
        inside = variance.mean(1)[ever], squared.mean(1)[ever]
        add("spearman", spearman(*inside), "segments contact", n=int(ever.sum()))
    return rows


def contact_rows(seen: SampledFutures, **common: Any) -> list[dict[str, Any]]:
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
