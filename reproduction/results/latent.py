"""Results of 04_latent: rows from codes and sampled futures; panels, tables and thresholds from rows.

Rows of single segments from the true past have the execution "segments", those of contacts and deflections, which are
sampled over 30 steps, "open loop".
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import cast

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from tsmlib.envs.spec import EnvSpec
from tsmlib.evaluation.contacts import EVENTS, Deflections, contacts, deflections, recall, touched
from tsmlib.evaluation.futures import HORIZON, STARTS, Coded, SampledFutures
from tsmlib.evaluation.latent import (
    active_units,
    deviations,
    directions,
    kl_by_dimension,
    reconstruction,
    root_mean,
    total_effects,
)
from tsmlib.plots.method import Method
from tsmlib.models.tsm import TSM
from tsmlib.rewards import BLOCK
from tsmlib.statistics import spearman
from reproduction.results import table
from reproduction.results.prediction import NAMES, select, values
from reproduction.results.table import Row
from tsmlib.zoo import look, method

THRESHOLDS = {  # set before any of it was measured: metric, subset, environment -> bound
    ("kl", "", "tsm/Reacher-v0"): ("at most", 0.1),
    ("spread", "", "tsm/Reacher-v0"): ("at most", 0.01),
    ("spread_ratio", "", "tsm/ReacherPush-v1"): ("at least", 2.0),
    ("recall", "object", "tsm/ReacherPush-v1"): ("at least", 0.8),
    ("recall", "wall", "tsm/ReacherPush-v1"): ("at least", 0.7),
}
SOURCES = {
    "error_posterior": "code from the encoder",
    "error_prior": "from the prior",
    "error_zero": "z = 0",
}
PARTS = {
    "": "all segments",
    "free": "no touch",
    "contact": "with a touch",
}  # subsets, as readers meet them
STRETCHES = tuple(
    range(10, HORIZON + 1, 10)
)  # last steps of the stretches of ten in which contacts are counted


# Rows ----------------------------------------------------------------------------------------------------------------


def rows(
    model: Coded,
    seen: SampledFutures,
    swings: SampledFutures | None = None,
    /,
    *,
    seed: int,
    **common: object,
) -> list[Row]:
    """All rows of a model. swings: where the arm pushes an object, windows before its first touch."""
    common["seed"] = seed
    found = code_rows(model, seen, torch.Generator().manual_seed(seed), **common)
    if swings is not None:
        found += contact_rows(seen, **common) + deflection_rows(
            deflections(swings), swings.env, **common
        )
    return found


def code_rows(
    model: Coded, seen: SampledFutures, generator: torch.Generator, /, **common: object
) -> list[Row]:
    """Use of the code and spread of the next segment. common: model, seed, scale. The encoder's part for tsm alone:
    the energy score trains a decoder without it."""
    seen = seen.first(model.code_len)
    after = touched(seen).cummax(1).values
    found = (
        list(_encoded(cast(TSM, model), seen, after[:, -1], generator))
        if common["model"] == "tsm"
        else []
    )
    for i, value in enumerate(total_effects(model, seen.window, generator)):
        found.append(dict(metric="importance", value=float(value), dimension=i))
    found += _spread(model, seen, after)
    common |= table.place(seen.env) | dict(planner="none", execution="segments", n=len(after))
    return [common | row for row in found if math.isfinite(cast(float, row["value"]))]


def _encoded(
    model: TSM, seen: SampledFutures, ever: Tensor, generator: torch.Generator
) -> Iterator[Row]:
    """KL, active units and reconstruction, for all segments and for those with (``ever``) and without a touch."""
    past, future = seen.window.past, seen.window.future
    with torch.no_grad():
        mean, log_variance = model.encode(future.states)
        again = torch.stack([model.decode(past, future.actions, mean) for _ in range(2)])
    yield dict(metric="fixed_code_variance", value=float(again.var(0, correction=0).mean()))
    kl = kl_by_dimension(mean, log_variance)
    yield dict(metric="active_units", value=float(active_units(mean).sum()))
    for i, value in enumerate(kl.mean(0)):
        yield dict(metric="kl_dimension", value=float(value), unit="nat", dimension=i)
    if EnvSpec.parse(seen.env).task == "push":
        way = future.states[:, -1, BLOCK] - past.states[:, -1, BLOCK]
        moved = way.norm(dim=1) > 0.01
        if moved.sum() > 2 * model.latent_dim:
            yield dict(
                metric="direction_told",
                value=directions(mean[moved], way[moved])[1],
                subset="object moves",
                unit="share",
                n=int(moved.sum()),
            )
    errors = reconstruction(model, seen.window, generator)
    spec, subsets = EnvSpec.parse(seen.env), {"": torch.ones_like(ever)}
    subsets |= {"free": ~ever, "contact": ever} if spec.has_block else {}
    for subset, chosen in subsets.items():
        if chosen.any():
            here: Row = dict(subset=subset, n=int(chosen.sum()))
            yield dict(here, metric="kl", value=float(kl[chosen].sum(1).mean()), unit="nat")
            for word, each in errors.items():
                yield dict(here, metric=f"error_{word}", value=float(each[chosen].mean()))


def _spread(model: Coded, seen: SampledFutures, after: Tensor) -> Iterator[Row]:
    """Spread and error of samples, over all steps and before and after the first touch (``after``, (N, T))."""
    variance, squared = deviations(seen, model.features)
    ever = after[:, -1]
    yield dict(metric="spread", value=root_mean(variance), unit="share")
    yield dict(metric="error", value=root_mean(squared), unit="share")
    yield dict(metric="spearman", value=spearman(variance.mean(1), squared.mean(1)))
    if EnvSpec.parse(seen.env).has_block and ever.any():
        both = after.any(0) & (~after).any(0)  # steps at which some have ever and some have not
        before, since = (root_mean(variance[:, both], where[:, both]) for where in (~after, after))
        yield dict(
            metric="spread", value=before, subset="before touch", unit="share", n=int((~ever).sum())
        )
        yield dict(
            metric="spread", value=since, subset="after touch", unit="share", n=int(ever.sum())
        )
        yield dict(metric="spread_ratio", value=since / before, unit="ratio", n=int(ever.sum()))
        inside = spearman(variance.mean(1)[ever], squared.mean(1)[ever])
        yield dict(metric="spearman", value=inside, subset="contact", n=int(ever.sum()))


def contact_rows(seen: SampledFutures, **common: object) -> list[Row]:
    """Recall and precision of contacts: of all within the horizon, and in each stretch of ten, by its last step."""
    common |= table.place(seen.env) | dict(planner="none", execution="open loop", unit="share")
    steps = seen.samples.shape[2]
    stretches: dict[int | None, range] = {None: range(steps)}
    stretches |= {end: range(end - 10, end) for end in range(10, steps + 1, 10)}
    found = []
    for event, (truth, samples) in contacts(seen).items():
        others = samples.roll(len(STARTS), 1)  # the same stretch of another episode
        for end, stretch in stretches.items():
            shares = recall(truth, samples, stretch)
            here = dict(common, subset=event, steps_ahead=end, n=shares.pop("n"))
            shares["chance"] = recall(truth, others, stretch)["recall"]
            found += [
                dict(here, metric=metric, value=v)
                for metric, v in shares.items()
                if math.isfinite(v)
            ]
    return found


def deflection_rows(found: Deflections, env: str, **common: object) -> list[Row]:
    """Directions and distances after the first touch; no rows where no object was moved."""
    if not len(found.travel):
        return []
    about = dict(planner="none", execution="open loop", subset="first touch", n=len(found.travel))
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
        "travel_coverage80": (
            float(((found.travel >= low) & (found.travel <= high)).float().mean()),
            "share",
        ),
    }
    common |= table.place(env) | about
    return [
        dict(common, metric=metric, value=value, unit=unit)
        for metric, (value, unit) in measured.items()
    ]


# Reading rows --------------------------------------------------------------------------------------------------------


def use_panels(
    found: pd.DataFrame, envs: Sequence[str]
) -> dict[str, dict[str, dict[Method, np.ndarray]]]:
    """What ``figures.code_use`` draws: title -> environment and subset -> method -> one value per seed."""
    panels: dict[str, dict[str, dict[Method, np.ndarray]]] = {
        "KL per segment": {},
        "spread of samples": {},
    }
    parts = ((", no touch", "free", "before touch"), (", with a touch", "contact", "after touch"))
    for env in envs:
        spec = EnvSpec.parse(env)
        for words, kl, spread in parts if spec.has_block else (("", "", ""),):
            title = spec.name + words
            for panel, metric, subset in zip(
                panels.values(), ("kl", "spread"), (kl, spread), strict=True
            ):
                if seeds := values(found, metric, env=env, execution="segments", subset=subset):
                    panel[title] = table.methods(seeds)
    return panels


def recall_panels(found: pd.DataFrame, env: str) -> dict[str, dict[Method, dict[str, np.ndarray]]]:
    """What ``figures.contact_recall`` draws: title -> method -> metric -> (seeds, 3), where all of it was measured."""
    panels: dict[str, dict[Method, dict[str, np.ndarray]]] = {}
    metrics = ("recall", "precision", "chance")
    for event, title in zip(EVENTS, ("arm touches object", "object hits wall"), strict=True):
        own = select(found, metrics, env=env, subset=event, steps_ahead=STRETCHES)
        for model, part in table.groups(own, "model"):
            wide = part.pivot(index="seed", columns=["metric", "steps_ahead"], values="value")
            wide = wide.reindex(columns=pd.MultiIndex.from_product([metrics, STRETCHES]))
            if wide.notna().all(axis=None):
                panels.setdefault(title, {})[method(model)] = {
                    metric: wide[metric].to_numpy() for metric in metrics
                }
    return panels


@table.sourced
def codes_table(found: pd.DataFrame, env: str) -> pd.DataFrame:
    """The KL and the importance of each unit of the code, in Markdown, from the rows of ``one_training``."""
    lines = []
    for metric, title in {"kl_dimension": "KL", "importance": "moves"}.items():
        own = select(found, metric, env=env, execution="segments")
        for model, part in table.groups(own, "model"):
            units = {
                f"$z_{i + 1}$": f"{value:.3f}"
                for i, value in zip(part["dimension"], part["value"], strict=True)
            }
            lines.append({"model": look(model).name, "what": title, "n": part["n"].max()} | units)
    return pd.DataFrame(lines)


def one_training(found: pd.DataFrame) -> pd.DataFrame:
    """The rows of the first training seed of each source: units of different trainings have nothing in common."""
    if "source" not in found:
        return table.select(found, seed=found["seed"].min())
    return found[found["seed"] == found.groupby("source")["seed"].transform("min")]


@table.sourced
def errors_table(found: pd.DataFrame, envs: Sequence[str], model: str) -> pd.DataFrame:
    """Errors of the next segment by where its code is from, and by subset, in Markdown: means over seeds."""
    own = table.select(found, env=list(envs), model=model, metric=list(SOURCES), subset=list(PARTS))
    if own.empty:
        return own
    own = own.assign(what=own["subset"].fillna("").map(PARTS))
    wide = table.means(own, ["env", "what"])
    counts = own.groupby(["env", "what"])["n"].max().reindex(wide.index).rename("n")
    texts = table.printed(wide, {metric: (title, "{:.3f}") for metric, title in SOURCES.items()})
    return texts.assign(n=counts.to_numpy())


@table.told
def directions_told(found: pd.DataFrame, env: str) -> Iterator[str]:
    """A sentence per model on how much of where a moving object goes is linear in the encoder's code."""
    for model, shares in values(
        found, "direction_told", env=env, execution="segments", subset="object moves"
    ).items():
        yield (
            f"{look(model).name}: a linear function of the encoder's code explains {shares.mean():.0%} of where a "
            "moving object goes."
        )


@table.sourced
def thresholds_table(found: pd.DataFrame, models: Sequence[str]) -> pd.DataFrame:
    """THRESHOLDS and what was measured, in Markdown: mean over seeds, and for contacts by how far ahead they lie.

    Thresholds of what was not measured are left out.
    """
    lines = []
    for (metric, subset, env), (word, bound) in THRESHOLDS.items():
        contact = metric == "recall"
        for steps in (10, None) if contact else (None,):
            where: Row = dict(
                subset=subset, execution="open loop" if contact else "segments", steps_ahead=steps
            )
            measured = values(found, metric, env=env, **where)
            texts = {
                look(model).name: f"{measured[model].mean():.3g}"
                for model in models
                if model in measured
            }
            which = f" ({subset}), {'the next 10' if steps else 'all 30'} steps" if contact else ""
            line = {
                "what": f"{EnvSpec.parse(env).name}: {NAMES[metric]}{which}",
                "threshold": f"{word} {bound:g}",
            }
            if texts:
                lines.append(line | texts)
    return pd.DataFrame(lines)
