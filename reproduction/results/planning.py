"""Results of 05_control: rows from trials; figures' input, tables and thresholds from rows.

``execution`` is "open loop" (as in the paper) or "closed loop" (planned again every few steps). Rows with an
``iteration`` are of plans before their planner was done; rows with a ``target`` of single targets.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from typing import cast

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from tsmlib.collection import smooth_torques
from tsmlib.envs.spec import EnvSpec
from tsmlib.evaluation.actions import novelty, roughness
from tsmlib.evaluation.exploitation import shares, worst
from tsmlib.plots.method import PLANNERS, Method
from tsmlib.planning.base import Plan
from tsmlib.planning.execution import Trial
from tsmlib.planning.planners import iterations_to
from tsmlib.planning.tasks import TOLERANCE, Task
from tsmlib.statistics import random_effects
from tsmlib import zoo
from reproduction.results import table
from reproduction.results.table import Columns, Row
from reproduction.runs import Run

OPEN, CLOSED = "open loop", "closed loop"
REACH, PUSH = "tsm/Reacher-v0", "tsm/ReacherPush-v1"
ARRIVED = f"within {TOLERANCE['reach']} m (push: {TOLERANCE['push']} m)"
ORACLE, NOTHING = zoo.method("oracle", "latent", "cem"), zoo.method("none", "", "zero")
PAPER = tuple(word for word, spec in zoo.ZOO.items() if spec.planned)  # rows of figure 6, and ours
BASELINES = ("onestep", "multistep", "lstm", "ensemble+mse")
VIOLATIONS = ("moves_untouched", "penetrates", "violations")
NOT_YET = "Not measured yet."

Trials = Mapping[Method, Trial]
Number = tuple[float, str]  # value and unit


# Rows ----------------------------------------------------------------------------------------------------------------


def numbers(task: Task, trial: Trial, execution: str = OPEN) -> dict[str, tuple[Tensor, str]]:
    """What a trial measured for each target: metric -> values (B,) and unit. ``violations``: see ``exploitation``."""
    found = {
        "return_true": (trial.executed_return, "m"),
        "final_distance": (trial.final_distance, "m"),
    }
    if trial.plan is not None:
        found["return_predicted"] = (trial.plan.predicted_return, "m")
        if (
            EnvSpec.parse(task.env).task == "push" and execution == OPEN
        ):  # else every plan starts from another state
            violated = shares(task.start, trial.plan.states.numpy(), task.env)
            found |= {name: (torch.from_numpy(share), "share") for name, share in violated.items()}
    return found


def means(task: Task, trial: Trial, among: Trials, execution: str = OPEN) -> dict[str, Number]:
    """Means over the targets, and what only makes sense over all of them: metric -> value and unit.

    among: all methods' trials of the task. With ORACLE in it, ``cost_over_oracle`` is the mean cost over the oracle's;
    with zero torque as well, ``gain_share`` is the part of the oracle's gain over doing nothing. ``_worst`` is the mean
    over the tenth of the plans with the largest gaps.
    """
    each = numbers(task, trial, execution)
    found: dict[str, Number] = {
        metric: (float(values.mean()), unit) for metric, (values, unit) in each.items()
    }
    found["success"] = (float((trial.final_distance <= task.tolerance).float().mean()), "share")
    executed, oracle, nothing = trial.executed_return, among.get(ORACLE), among.get(NOTHING)
    if oracle is not None:
        found["cost_over_oracle"] = (
            float(executed.mean() / oracle.executed_return.mean()),
            "ratio",
        )
    if oracle is not None and nothing is not None:
        idle = nothing.executed_return
        found["gain_share"] = (
            float((executed - idle).mean() / (oracle.executed_return - idle).mean()),
            "share",
        )
    if trial.plan is not None:
        found["exploitation_gap"] = (float(trial.gap.mean()), "m")
        found["gap_absolute"] = (float(trial.gap.abs().mean()), "m")
        found["relative_gap_median"] = (
            float((trial.gap.abs() / executed.abs()).quantile(0.5)),
            "share",
        )
        found["plan_seconds"] = (trial.plan.seconds, "s")
        most = worst(trial.gap.numpy())
        found |= {
            f"{name}_worst": (float(each[name][0][most].mean()), "share")
            for name in VIOLATIONS
            if name in each
        }
    shape = roughness(trial.actions)
    found["torque_change"] = (float(shape["change"].mean()), "share")
    found["torque_fast"] = (float(shape["fast"].mean()), "share")
    new = novelty(trial.actions, _known_torques(), segment_len=min(10, task.horizon))
    found["torque_novelty"] = (float(new.mean()), "std")
    return found


def by_final_distance(task: Task, trial: Trial, *, least: float = 0.1) -> list[int]:
    """Targets that a film can be of, the nearest end first: those from which what has to arrive begins ``least`` m
    away, or all where there is none. The first is the best of them, the one in the middle the median."""
    away = (torch.from_numpy(task.start[:, task.position]) - task.target).norm(dim=1) >= least
    order = trial.final_distance.argsort().tolist()
    return [target for target in order if away[target]] or order


@cache
def _known_torques() -> Tensor:
    """Torques like the training data's, to measure the novelty of others against."""
    return smooth_torques(1000, 100, generator=torch.Generator().manual_seed(7))


def rows(
    tasks: Sequence[Task],
    trials: Mapping[str, Trials],
    run: Run,
    *,
    execution: str = OPEN,
    iteration: int | None = None,
) -> tuple[list[Row], list[Row]]:
    """Rows of metrics/05_control.csv (one number per method) and of 05_control_rows.csv (one per target as well).

    trials: environment -> method -> trial. iteration: of a planner that was not done.
    """
    summary, per_target = [], []
    for task in tasks:
        common = table.of_task(task, run) | dict(execution=execution, iteration=iteration)
        for name, trial in trials[task.env].items():
            here = common | table.fields(name)
            summary += [
                dict(here, metric=metric, value=value, unit=unit, n=len(task))
                for metric, (value, unit) in means(task, trial, trials[task.env], execution).items()
            ]
            per_target += [
                dict(here, metric=metric, value=float(f"{value:.7g}"), unit=unit, n=1, target=i)
                for metric, (values, unit) in numbers(task, trial, execution).items()
                if metric not in VIOLATIONS[:2]
                for i, value in enumerate(values)
            ]
    return summary, per_target


def convergence(task: Task, plan: Plan, run: Run, method: Method) -> list[Row]:
    """Rows of 05_control_rows.csv that say how soon a long optimisation was nearly done (claim C15): for each target,
    the iterations until the predicted return has 95 % of all that it gains."""
    common = table.of_task(task, run) | table.fields(method)
    common |= dict(execution=OPEN, metric="iterations_to_95", unit="iterations", n=1)
    return [
        dict(common, value=value, target=i)
        for i, value in enumerate(iterations_to(plan.curve).tolist())
    ]


# Reading rows --------------------------------------------------------------------------------------------------------


def plans_of(
    found: pd.DataFrame, *, env: str = "", execution: str = OPEN, planners: Sequence[str] = ()
) -> pd.DataFrame:
    """Finished plans of an environment and some planners; the floors are always among them."""
    own = table.select(found, execution=execution, iteration=None, **({"env": env} if env else {}))
    return own[(own["model"] == "none") | own["planner"].isin(list(planners))] if planners else own


def both_ways(found: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Finished plans open and closed loop, of methods with closed loops and the seeds that were executed both ways; of
    a method without any such seed, its closed loops alone."""
    opened, closed = (table.with_method(plans_of(found, execution=way)) for way in (OPEN, CLOSED))

    def key(part: pd.DataFrame, *more: str) -> pd.MultiIndex:
        return pd.MultiIndex.from_frame(part[["env", "method", *more]])

    opened = opened[key(opened, "seed").isin(key(closed, "seed"))]
    return opened, closed[
        key(closed, "seed").isin(key(opened, "seed")) | ~key(closed).isin(key(opened))
    ]


def by_target(found: pd.DataFrame, metric: str, *, apart: bool = False) -> dict[Method, np.ndarray]:
    """Rows with a ``target`` as arrays: method -> (targets,), means over the seeds there are; apart: targets of each
    seed, (seeds * targets,)."""
    own = table.with_method(table.select(found, metric=metric))
    return table.arrays(
        table.means(own, ["seed", "target"] if apart else "target", "method").sort_index()
    )


def returns(
    found: pd.DataFrame,
    env: str,
    *,
    planner: str = "cem",
    execution: str = OPEN,
    apart: bool = False,
) -> dict[Method, dict[str, np.ndarray | None]]:
    """What ``figures.figure6`` draws of one task: method -> true and predicted returns, from rows with a ``target``.

    apart: of ``by_target``.
    """
    own = plans_of(found, env=env, execution=execution, planners=[planner])
    predicted = by_target(own, "return_predicted", apart=apart)
    return {
        method: {"true": true, "predicted": predicted.get(method)}
        for method, true in by_target(own, "return_true", apart=apart).items()
    }


def final_distances(found: pd.DataFrame, env: str) -> dict[Method, dict[str, np.ndarray]]:
    """What ``figures.final_distances`` draws of one task, from rows with a ``target``: open beside closed loop, the
    targets of every seed (``both_ways``)."""
    opened, closed = (
        {method: part["value"].to_numpy() for method, part in table.groups(own, "method")}
        for own in both_ways(table.select(found, env=env, metric="final_distance"))
    )
    ways = {
        method: {"open": opened.get(method), "closed": distances}
        for method, distances in closed.items()
    }
    return {
        method: {way: each for way, each in own.items() if each is not None}
        for method, own in ways.items()
    }


def return_panels(
    found: pd.DataFrame,
    tasks: Sequence[Task],
    *,
    planner: str = "cem",
    methods: Sequence[Method] = (),
    apart: bool = False,
) -> dict[str, dict[Method, dict[str, np.ndarray | None]]]:
    """The input of ``figures.figure6``: ``returns`` of each task, of some methods or of all."""
    every = {task.name: returns(found, task.env, planner=planner, apart=apart) for task in tasks}
    return {
        task: {m: rows[m] for m in methods or ordered(rows) if m in rows}
        for task, rows in every.items()
    }


def ordered(rows: Iterable[Method]) -> list[Method]:
    """Methods in the order of the zoo's models."""
    order = [*zoo.ZOO, *zoo.LOOKS]
    return sorted(rows, key=lambda method: order.index(method.model))


def distance_panels(
    found: pd.DataFrame, task: Task
) -> dict[str, dict[Method, dict[str, np.ndarray]]]:
    """The input of ``figures.final_distances``."""
    return {task.name: final_distances(found, task.env)}


def along_the_way(found: pd.DataFrame, env: str) -> dict[Method, dict[str, np.ndarray]]:
    """What ``figures.along_the_way`` draws: method -> iterations, true and predicted mean returns (I,) each."""
    own = table.with_method(
        table.select(found, env=env, execution=OPEN, metric=["return_true", "return_predicted"])
    )
    curves = {}
    for method, part in table.groups(own[own["iteration"].notna()], "method"):
        wide = table.means(part, "iteration").sort_index()
        curves[method] = {
            "iterations": wide.index.to_numpy(dtype=int),
            "true": wide["return_true"].to_numpy(),
            "predicted": wide["return_predicted"].to_numpy(),
        }
    return curves


# Tables --------------------------------------------------------------------------------------------------------------

MAIN: Columns = {
    "return_predicted": ("predicted return", "{:.2f}"),
    "return_true": ("executed return", "{:.2f}"),
    "exploitation_gap": ("gap", "{:+.2f}"),
    "gap_absolute": ("its mean size", "{:.2f}"),
    "relative_gap_median": ("median gap / executed", "{:.1%}"),
    "cost_over_oracle": ("cost / oracle's", "{:.3f}"),
    "gain_share": ("share of oracle's gain", "{:.2f}"),
    "final_distance": ("final distance (m)", "{:.3f}"),
    "success": (ARRIVED, "{:.1%}"),
    "plan_seconds": ("seconds, all targets", "{:.0f}"),
}
LOOP: Columns = {metric: MAIN[metric] for metric in ("return_true", "final_distance", "success")}
SIGNS: Columns = {
    "moves_untouched": ("moves untouched", "{:.1%}"),
    "penetrates": ("arm inside object", "{:.1%}"),
    "violations": ("either", "{:.1%}"),
    "violations_worst": ("either, worst tenth", "{:.1%}"),
    "torque_change": ("change of torque per step", "{:.3f}"),
    "torque_fast": ("power above 5 Hz", "{:.1%}"),
    "torque_novelty": ("distance to training torques", "{:.2f}"),
}


def _printed(plans: pd.DataFrame, columns: Columns) -> pd.DataFrame:
    """Means over training seeds as texts, and how many seeds there are."""
    own, by = table.with_method(plans), ["env", "method", "n"]
    seeds = own.groupby(by, sort=False)["seed"].nunique().rename("seeds")
    return seeds.reset_index().merge(table.printed(table.means(own, by), columns), on=by)


@table.sourced
def plans_table(found: pd.DataFrame, *, planner: str = "cem") -> pd.DataFrame:
    """Every model planned with by one planner, executed open loop, with floors and oracle, in Markdown."""
    return _printed(plans_of(found, planners=[planner]), MAIN)


def violations_table(found: pd.DataFrame, *, env: str = "", planner: str = "cem") -> str:
    """Signs of exploitation, in Markdown: shares of predicted steps that violate physics, and action statistics."""
    return _violations(found, env, planner) or NOT_YET


@table.sourced
def _violations(found: pd.DataFrame, env: str, planner: str) -> pd.DataFrame:
    own = _printed(plans_of(found, env=env, planners=[planner]), SIGNS)
    measured = "violations" in set(found["metric"])
    return (own if "source" in found else own.drop(columns="n")) if measured else own.iloc[:0]


def loops_table(found: pd.DataFrame) -> str:
    """Open loop beside closed loop, of the methods and seeds that were executed both ways (``both_ways``), in
    Markdown."""
    return _loops(found) or NOT_YET


@table.sourced
def _loops(found: pd.DataFrame) -> pd.DataFrame:
    opened, closed = (_printed(own, LOOP) for own in both_ways(found))
    return opened.merge(
        closed, "right", ["env", "method", "n", "seeds"], suffixes=(f", {OPEN}", f", {CLOSED}")
    )


@table.sourced
def planners_table(found: pd.DataFrame) -> pd.DataFrame:
    """Model and search space by planner, in Markdown: the mean executed return, and in brackets the gap.

    After it the number of training seeds where another planner of the line has more.
    """
    own = plans_of(found)
    own = table.with_method(own[own["model"] != "none"], "model", "search_space")
    wide = table.means(own, ["env", "method"], ["planner", "metric"])
    seeds = (
        own.groupby(["env", "method", "planner"], sort=False)["seed"].nunique().unstack(sort=False)
    )
    fewer = seeds.map("; {:.0f} seed(s)".format, na_action="ignore").where(
        seeds.lt(seeds.max(axis=1), axis=0), ""
    )
    fewer = fewer.reindex(wide.index)
    cells = {
        title: wide[word, "return_true"].map("{:.2f}".format, na_action="ignore")
        + wide[word, "exploitation_gap"].map(" ({:+.2f}".format, na_action="ignore")
        + fewer[word].map("{})".format)
        for word, title in PLANNERS.items()
        if (word, "return_true") in wide
    }
    return pd.DataFrame(cells, index=wide.index).reset_index()


@table.sourced
def spaces_table(found: pd.DataFrame) -> pd.DataFrame:
    """What the action prior changes, in Markdown: latent minus direct, paired by target, with half the 95 % t interval.
    found: rows with a ``target``."""
    own = table.select(
        plans_of(found),
        metric=["return_true", "return_predicted"],
        search_space=["latent", "direct"],
    )
    by = ["env", "model", "planner", "seed", "target"]
    wide = own.pivot_table("value", by, ["search_space", "metric"], sort=False)
    lines = []
    for (env, model, planner), part in table.groups(wide.dropna(), ["env", "model", "planner"]):
        latent, direct = part["latent"], part["direct"]
        gaps = [
            (space["return_predicted"] - space["return_true"]).abs() for space in (latent, direct)
        ]
        cells = {
            "executed return (m)": latent["return_true"] - direct["return_true"],
            "size of the gap (m)": gaps[0] - gaps[1],
        }
        over_seeds = {title: values.groupby("target").mean() for title, values in cells.items()}
        line = {
            "env": env,
            "method": zoo.method(model, "", planner),
            "n": len(over_seeds["size of the gap (m)"]),
        }
        lines.append(
            line
            | {
                title: table.spell(values, "{:+.3f} ± {:.3f}")
                for title, values in over_seeds.items()
            }
        )
    return pd.DataFrame(lines)


def paired_table(
    found: pd.DataFrame, env: str, subject: str, *, execution: str = OPEN
) -> pd.DataFrame:
    """Plans by CEM over codes beside those of ``subject``, target by target, the cheapest first: mean cost, and the
    subject's cost and size of the gap minus theirs (``spell_effect``), the cost also in each seed alone. Closed loop,
    the gap is that of the first plan. found: rows with a ``target``."""
    planned = plans_of(found, env=env, execution=execution, planners=["cem"])
    costs = {way: cost for way, cost in costs_of(planned).items() if way.search_space != "direct"}
    gaps, ours = gap_sizes(planned), next((way for way in costs if way.model == subject), None)
    lines = []
    for method, cost in sorted(costs.items(), key=lambda each: each[1].to_numpy().mean()):
        line, n = {"method": method, "cost (m)": f"{cost.to_numpy().mean():.2f}"}, cost.shape[1]
        if ours is not None and method is not ours:
            apart = paired_differences(costs[ours], cost)
            n = apart.shape[1]
            line[f"cost of {subject} minus this"] = spell_effect(apart)
            if apart.size and len(apart) > 1:
                line["in each seed"] = ", ".join(
                    table.spell(row, "{:+.2f} ± {:.2f}") for row in apart.to_numpy()
                )
            if method in gaps:
                line[f"size of the gap of {subject} minus this"] = spell_effect(
                    paired_differences(gaps[ours], gaps[method])
                )
        lines.append(line | {"n": n})
    return pd.DataFrame(lines)


def paired_differences(ours: pd.DataFrame, theirs: pd.DataFrame) -> pd.DataFrame:
    """Differences (seeds, targets), without targets that either lacks, and then without such seeds."""
    return (ours - theirs).dropna(axis="columns", how="all").dropna()


def spell_effect(values: pd.DataFrame) -> str:
    """Mean of paired differences (seeds, targets), half its 95 % interval over targets, and in brackets, where there
    are several seeds, that over seeds and targets (two-way random effects). '' where there are none."""
    if values.empty:
        return ""
    whole = f" ({random_effects(values.to_numpy()).half():.2f})" * (len(values) > 1)
    return table.spell(values.mean(), "{:+.2f} ± {:.2f}") + whole


def costs_of(found: pd.DataFrame) -> dict[Method, pd.DataFrame]:
    """Costs of plans: method -> (seeds, targets). found: rows with a ``target``."""
    own = table.with_method(table.select(found, metric="return_true"))
    return {
        method: -part.pivot(index="seed", columns="target", values="value")
        for method, part in table.groups(own, "method")
    }


def gap_sizes(found: pd.DataFrame) -> dict[Method, pd.DataFrame]:
    """Size of predicted minus executed return: method -> (seeds, targets). found: rows with a ``target``."""
    own = table.with_method(table.select(found, metric=["return_true", "return_predicted"]))
    sizes: dict[Method, pd.DataFrame] = {}
    for method, part in table.groups(own, "method"):
        predicted, executed = (
            own.pivot(index="seed", columns="target", values="value")
            for own in (
                part[part["metric"] == metric] for metric in ("return_predicted", "return_true")
            )
        )
        if len(predicted):
            sizes[method] = (predicted - executed).abs()
    return sizes


@table.sourced
def convergence_table(found: pd.DataFrame) -> pd.DataFrame:
    """Iterations of planners to 95 % of what they gain in the end, in Markdown, from rows with a ``target``."""
    own = table.with_method(table.select(found, metric="iterations_to_95"))
    lines = [
        {
            "env": env,
            "method": method,
            "n": len(values),
            "median": f"{values.median():.0f}",
            **{f"within {bound}": f"{(values <= bound).mean():.1%}" for bound in (100, 150)},
        }
        for (env, method), part in table.groups(own, ["env", "method"])
        for values in [part["value"]]
    ]
    return pd.DataFrame(lines)


@table.sourced
def thresholds_table(found: pd.DataFrame, model: str) -> pd.DataFrame:
    """``thresholds`` in Markdown."""
    return thresholds(found, model)


@table.told
def plans_told(
    found: pd.DataFrame, tasks: Sequence[Task], *, planner: str = "cem"
) -> Iterator[str]:
    """A sentence per task on plans through learned models: cost beside the oracle's, size of the gap."""
    for task in tasks:
        own = table.select(plans_of(found, env=task.env), planner=planner)
        own = own[~own["model"].isin(["oracle", "none"])]
        cost, gap = (
            own[own["metric"] == metric]["value"]
            for metric in ("cost_over_oracle", "relative_gap_median")
        )
        if len(cost):
            yield (
                f"{task.name}: plans through learned models cost {cost.min():.2f} to {cost.max():.2f} times the "
                f"oracle's; the median gap is {gap.min():.1%} to {gap.max():.1%} of the return."
            )


@table.told
def planners_told(
    found: pd.DataFrame, task: Task, model: str, planners: Sequence[str]
) -> Iterator[str]:
    """A sentence on the executed returns of a model by some planners, in both search spaces."""
    own = table.select(
        plans_of(found, env=task.env), metric="return_true", model=model, planner=list(planners)
    )
    own = table.with_method(own)
    if own["planner"].nunique() == len(planners):
        said = [
            f"{method.label} {part['value'].mean():.2f}"
            for method, part in table.groups(own, "method")
        ]
        yield f"{task.name}: {', '.join(said)}."


def thresholds(found: pd.DataFrame, model: str) -> pd.DataFrame:
    """Thresholds of planning with ``model`` in the latent search space by CEM; see ``table.thresholds``.

    The others are those of PAPER, in both search spaces; BASELINES among them are no segment models.
    """

    def measured(env: str, word: str, execution: str) -> Mapping[str, float]:
        own = table.select(plans[execution], env=env, model=word, search_space="latent")
        means = own.groupby("metric")["value"].mean()
        return defaultdict(
            lambda: math.nan, {str(metric): float(value) for metric, value in means.items()}
        )

    plans = {
        way: table.select(plans_of(found, execution=way), planner="cem") for way in (OPEN, CLOSED)
    }
    near, far = (measured(env, model, OPEN) for env in (REACH, PUSH))
    again, oracle = (measured(PUSH, word, CLOSED)["success"] for word in (model, "oracle"))
    others = table.select(plans[OPEN], env=PUSH, model=PAPER)
    others = others[(others["model"] != model) | (others["search_space"] != "latent")]
    wide = table.means(others, ["model", "search_space"]).reindex(
        columns=["return_true", "gap_absolute"]
    )
    executed, gaps = wide["return_true"].dropna(), wide["gap_absolute"]
    rival = (
        f", {zoo.method(*cast(tuple[str, str], executed.idxmax())).label}" if len(executed) else ""
    )
    gap = gaps[gaps.index.isin(BASELINES, level="model")].min() / 2
    low, high = "at most", "at least"
    return table.thresholds(
        [
            ("reach: cost over the oracle's", low, 1.1, near["cost_over_oracle"], "{:.3f}"),
            (
                "reach: median gap over executed return",
                low,
                0.05,
                near["relative_gap_median"],
                "{:.1%}",
            ),
            ("push: cost over the oracle's", low, 1.15, far["cost_over_oracle"], "{:.3f}"),
            (
                "push: mean size of the gap (m), half of any baseline's",
                low,
                gap,
                far["gap_absolute"],
                "{:.3f}",
            ),
            (
                f"push: executed return (m), that of the best other{rival}",
                high,
                executed.max(),
                far["return_true"],
                "{:.3f}",
            ),
            (
                f"push, closed loop: within {TOLERANCE['push']} m, the oracle's or 80 %",
                high,
                min(0.8, oracle),
                again,
                "{:.1%}",
            ),
            ("push: predicted steps that violate physics", low, 0.05, far["violations"], "{:.1%}"),
        ]
    )
