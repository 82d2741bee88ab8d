"""Results of learned policies: rows of learning curves; figure 7's input and tables from rows.

A record stands at the optimiser ``iteration``; for the model-free policies of benchmarks/model_free, which have no
``search_space``, at ``env_steps``. All have the execution "policy".
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
import pandas as pd

from tsmlib.plots.method import Method
from tsmlib.planning.tasks import HORIZON
from reproduction.results import table
from reproduction.results.planning import ARRIVED, PUSH, REACH, ordered
from reproduction.results.table import PolicyHeader, Row

GRADIENTS = ("ppo", "trpo")  # the policy gradients of figure 7
EPISODES = {"smoke": 4, "laptop": 20, "paper": 20}  # of each copy, per iteration of learning (A.3)
UNITS = {
    "return_true": "m",
    "return_predicted": "m",
    "exploitation_gap": "m",
    "final_distance": "m",
    "success": "share",
}
EARLY = "early"  # subset: the first iterations of a policy learned again, with more records than its curve has there
SOONEST = {
    "samples_to_90": "steps of model or environment",
    "env_samples_to_90": "steps of the environment",
    "seconds_to_90": "seconds",
}

Curves = dict[str, np.ndarray]


# Rows ----------------------------------------------------------------------------------------------------------------


def learning_rows(
    header: PolicyHeader,
    *,
    samples: int,
    train_seconds: float | None,
    n: int = 100,
    within_data: Iterable[float] = (),
) -> list[Row]:
    """Rows of a learned policy, one per record, copy and metric; header: as ``study.learn`` returns it.

    samples: environment steps in the data set of its model; train_seconds: of the model and the prior, None where that
    is not known of one alone; n: the targets it is measured on. Both are rows too, so that the table says what a policy
    has cost in all; of a policy that was learned with others as one no seconds are. within_data: of the learned policy,
    one per copy (``study.within_data``).
    """
    common, curve = table.policy(header), header["curve"]
    measured = {
        metric: np.asarray(values) for metric, values in curve["measured"].items()
    }  # (records, copies) each
    measured["exploitation_gap"] = measured["return_predicted"] - measured["return_true"]
    rows = [
        dict(
            common,
            iteration=iteration,
            metric=metric,
            value=float(value),
            unit=unit,
            n=n,
            copy=copy,
        )
        for metric, unit in UNITS.items()
        for iteration, values in zip(curve["iteration"], measured[metric], strict=True)
        for copy, value in enumerate(values)
    ]
    if curve.get("policies", 1) == 1:
        rows += [
            dict(common, iteration=iteration, metric="seconds", value=seconds, unit="s")
            for iteration, seconds in zip(curve["iteration"], curve["seconds"], strict=True)
        ]
    common["iteration"] = curve["iteration"][-1]
    for metric, value, unit in (
        ("samples", samples, "steps"),
        ("train_seconds", train_seconds, "s"),
    ):
        if value is not None:
            rows.append(dict(common, metric=metric, value=value, unit=unit))
    return rows + [
        dict(common, metric="within_data", value=float(value), unit="share", n=n, copy=copy)
        for copy, value in enumerate(within_data)
    ]


def plateau_rows(
    curves: Mapping[Method, Curves],
    common: Row,
    *,
    steps: int,
    share: float = 0.9,
    early: Mapping[Method, Curves] | None = None,
) -> list[Row]:
    """Rows of what each policy needed to come to ``share`` of the common plateau (claims C37 and C39), one task's.

    curves: of one seed, of the policies that are compared. Their common plateau is what those learned inside models
    and the best of the model-free ones have all come to in the end; what counts is the gain over the best of all
    before learning. There are no rows where that is none. A model-free policy that never comes there counts with all
    that it took. steps: of its model that a policy takes per iteration. early: curves of the first iterations alone,
    with more records, which count in place of those of a whole curve as far as they go.

    ``samples_to_90``: steps of what it learned in, the model or else the environment, and no row where it was there by
    the first record, which does not tell when; ``env_samples_to_90``: steps of the environment, the data
    of its model included; ``seconds_to_90``: training of its model included, where seconds of all policies are known.
    """
    means = {method: own["return_true"].mean(0) for method, own in curves.items()}
    inside, free = (
        [mean[-1] for method, mean in means.items() if bool(method.search_space) is way]
        for way in (True, False)
    )
    ends = [*inside, *([max(free)] if free else [])]
    start = max((mean[0] for mean in means.values()), default=0.0)
    if not ends or not min(ends) > start:
        return []
    level, rows = start + share * (min(ends) - start), []
    timed = all("seconds" in own for own in curves.values())  # what is compared has the same seeds
    for method, own in curves.items():
        ways = {
            "samples_to_90": "iterations" if method.search_space else "samples",
            "env_samples_to_90": "samples",
            "seconds_to_90": "seconds",
        }
        finer = with_early(own, early[method]) if early and method in early else own
        if (
            finer["return_true"].mean(0)[1:2] >= level
        ).any():  # a line from the start would say it learned too late
            del ways["samples_to_90"]
        if not timed:
            del ways["seconds_to_90"]
        for metric, against in ways.items():
            spent = reached(finer if metric == "samples_to_90" else own, level, against)
            value = (float(own[against][-1]) if spent is None else spent) * (
                steps if against == "iterations" else 1
            )
            rows.append(
                dict(
                    common,
                    **table.fields(method) | {"planner": "policy"},
                    execution="policy",
                    metric=metric,
                    value=value,
                    unit="s" if against == "seconds" else "steps",
                    n=len(own["return_true"]),
                )
            )
    return rows


def with_early(curves: Curves, early: Curves) -> Curves:
    """Iterations and mean true return (1, R) of ``early``, and of a whole curve after the end of that."""
    later = curves["iterations"] > early["iterations"][-1]
    means = [early["return_true"].mean(0), curves["return_true"].mean(0)[later]]
    return {
        "iterations": np.concatenate([early["iterations"], curves["iterations"][later]]),
        "return_true": np.concatenate(means)[None],
    }


def reached(curves: Curves, level: float, against: str = "samples") -> float | None:
    """After how much of ``against`` (samples, iterations or seconds) the mean true return first reaches ``level``.

    Between two records along the straight line; None where it never does.
    """
    mean, spent = curves["return_true"].mean(0), curves[against]
    above = np.flatnonzero(mean >= level)
    if not len(above):
        return None
    i = int(above[0])
    if i == 0:
        return float(spent[0])
    share = (level - mean[i - 1]) / (mean[i] - mean[i - 1])
    return float(spent[i - 1] + share * (spent[i] - spent[i - 1]))


# Reading rows --------------------------------------------------------------------------------------------------------


def _records(found: pd.DataFrame, subset: str = "") -> pd.DataFrame:
    """Rows of learning curves, with the columns method and ``at``, where they stand on the curve."""
    own = table.select(found, execution="policy", subset=subset)
    own = own.assign(
        at=own["iteration"].fillna(own["env_steps"]),
        copy=own["copy"].fillna(0) if "copy" in own else 0,
    )
    return table.with_method(own[own["at"].notna()], "model", "search_space")


def learning_curves(found: pd.DataFrame, subset: str = "") -> dict[str, dict[Method, Curves]]:
    """The input of ``figures.figure7``: task -> method -> curves, from rows of policies, in the order of the zoo.

    subset: ``EARLY`` for those alone. A method's k lines are those of ``seed_means``. Seconds are the CPU's where a
    table has them, else the clock's, which are more on a busy machine; training of the model is counted. ValueError
    where lines were not measured at the same points, or where one task was learned in two environments.
    """
    curves: dict[str, dict[Method, Curves]] = {}
    for (task, method), own in table.groups(_one_env(_records(found, subset)), ["task", "method"]):
        try:
            curves.setdefault(task, {})[method] = _curves(own)
        except ValueError as error:
            raise ValueError(f"{task}, {method.label}: {error}") from None
    return {
        task: {method: rows[method] for method in ordered(rows)} for task, rows in curves.items()
    }


def _curves(own: pd.DataFrame) -> Curves:
    """The curves of one method."""
    clock = "cpu_seconds" if "cpu_seconds" in set(own["metric"]) else "seconds"
    records = own[own["metric"].isin([*UNITS, clock])]
    key = ["metric", "seed", "copy"]
    if len(doubled := records[records.duplicated([*key, "at"])]):
        metric, seed, _, at = doubled[[*key, "at"]].iloc[0]
        raise ValueError(f"{metric} of seed {seed} stands twice at {at}")
    wide = records.pivot(index=key, columns="at", values="value")
    if len(cut := wide[wide.isna().any(axis=1)]):
        (metric, seed, copy), points = cut.index[0], cut.iloc[0].dropna().index
        raise ValueError(
            f"{metric} of seed {seed}, copy {copy} was measured at {len(points)} points up to {points.max()}, expected "
            f"the {wide.shape[1]} up to {wide.columns.max()} of the others"
        )
    at, wide = wide.columns.to_numpy(dtype=int), seed_means(wide)
    curves: Curves = {"seeds": np.array(own["seed"].nunique())}
    curves |= {metric: wide.loc[metric].to_numpy() for metric in wide.index.unique("metric")}
    curves.pop(clock, None)
    curves |= _seconds(own, clock)
    if not own["search_space"].iloc[0]:
        return curves | {"steps": at, "samples": at}
    samples = own[own["metric"] == "samples"]["value"].mean()
    (task, scale), within = own[["task", "scale"]].iloc[0], own[own["metric"] == "within_data"]
    within = seed_means(within.set_index(["seed", "copy"])[["value"]])
    curves |= {"iterations": at, "steps": at * model_steps(task, scale)}
    return curves | {"samples": np.full(len(at), samples), "within_data": within.to_numpy()}


def _seconds(own: pd.DataFrame, clock: str) -> Curves:
    """Seconds at each record, training of the model included: means over the seeds of which both are known; none where
    there is none."""
    spent = own[own["metric"] == clock].pivot_table(index="seed", columns="at", values="value")
    if own["search_space"].iloc[0]:
        spent = spent.add(
            own[own["metric"] == "train_seconds"].groupby("seed")["value"].mean(), axis="index"
        )
    known = spent.dropna()
    return {} if known.empty else {"seconds": known.mean(axis="index").to_numpy()}


def seed_means(values: pd.DataFrame) -> pd.DataFrame:
    """Of values by seed and copy, levels of the index: each copy's, or, where there are several training seeds, the
    mean over the copies of each, since copies that learn in one model are no samples of training it."""
    if values.index.unique("seed").size < 2:
        return values
    return values.groupby(
        level=[name for name in values.index.names if name != "copy"], sort=False
    ).mean()


def model_steps(task: str, scale: str) -> int:
    """Steps of its model that a policy of a task takes per iteration of learning, each copy."""
    return HORIZON[task] * EPISODES[scale]


def finished(found: pd.DataFrame) -> pd.DataFrame:
    """The rows of a growing table without those of seeds that stopped before the longest one of their method."""
    own = _records(found)
    method = [own["env"], own["method"]]
    last = own.groupby([*method, own["seed"]], sort=False)["at"].transform("max")
    return found.loc[
        own.index[(last == last.groupby(method, sort=False).transform("max")).to_numpy(dtype=bool)]
    ]


def finished_on_arms(free: pd.DataFrame) -> pd.DataFrame:
    """``finished`` rows of model-free learners on the two arms."""
    return finished(table.select(free, env=[REACH, PUSH]))


def gradients(free: pd.DataFrame) -> pd.DataFrame:
    """``finished_on_arms`` rows of PPO and TRPO, the policy gradients of figure 7."""
    return table.select(finished_on_arms(free), model=GRADIENTS)


def references(found: pd.DataFrame) -> dict[str, dict[Method, float]]:
    """Task -> method -> mean true return of the oracle's plans and of no torque, from rows of 05_control.csv.

    ValueError where one task was done in two environments.
    """
    own = table.with_method(_one_env(table.select(found, metric="return_true", iteration=None)))
    wide = table.means(
        own[(own["model"] == "oracle") | (own["planner"] == "zero")], "method", "task"
    )
    return {
        str(task): dict(zip(column.dropna().index, column.dropna(), strict=True))
        for task, column in wide.items()
    }


def _one_env(own: pd.DataFrame) -> pd.DataFrame:
    for task, envs in own.groupby("task")["env"].unique().items():
        if len(envs) > 1:
            raise ValueError(
                f"rows of task {task} are of {envs[0]} and of {envs[1]}; give those of one of them"
            )
    return own


# Tables --------------------------------------------------------------------------------------------------------------


@table.sourced
def plateaus_table(found: pd.DataFrame) -> pd.DataFrame:
    """Rows of ``plateau_rows`` in Markdown: what each policy needed to come to 90 %, means over seeds."""
    own = table.with_method(table.select(found, metric=list(SOONEST)), "model", "search_space")
    titles = {metric: (title, "{:,.0f}") for metric, title in SOONEST.items()}
    return table.printed(table.means(own, ["task", "method"]), titles) if len(own) else own.iloc[:0]


def policies_table(curves: Mapping[str, Mapping[Method, Curves]]) -> str:
    """The end of every learning curve in Markdown: means over its lines, with half 95 % intervals."""
    return table.markdown(_ends(curves))


@table.sourced
def learned_table(found: pd.DataFrame) -> pd.DataFrame:
    """``policies_table`` of the ``learning_curves`` of rows."""
    return _ends(learning_curves(found))


@table.told
def learned_told(found: pd.DataFrame, plans: pd.DataFrame, models: Sequence[str]) -> Iterator[str]:
    """A sentence per task on policies of some models: where they end, and their returns beside open-loop plans'.

    plans: rows of the same table with those of plans, of which the same source counts.
    """
    same = plans[plans["source"].isin(found["source"].unique())] if "source" in found else plans
    for task, curves in learning_curves(found).items():
        inside = [own for method, own in curves.items() if method.model in models]
        free = [
            own["return_true"][:, -1].mean()
            for method, own in curves.items()
            if not method.search_space
        ]
        plans_of = table.select(
            same, task=task, metric="return_true", execution="open loop", iteration=None
        )
        planned = plans_of[~plans_of["model"].isin(["oracle", "none"])]["value"]
        if inside:
            ends = [own["final_distance"][:, -1].mean() for own in inside]
            returns = [own["return_true"][:, -1].mean() for own in inside]
            text = (
                f"{task}: policies learned inside the baselines end {min(ends):.3f} to {max(ends):.3f} m from "
                f"their targets on average and return {min(returns):.2f} to {max(returns):.2f}"
            )
            text += (
                f", open-loop plans {planned.min():.2f} to {planned.max():.2f}"
                if len(planned)
                else ""
            )
            text += f", model-free policies {min(free):.2f} to {max(free):.2f}" if free else ""
            yield text + "."


def _counted(seeds: int, lines: int) -> str:
    """What the lines of a method are."""
    return f"{seeds} seeds" if seeds > 1 else f"{lines} cop{'ies' if lines > 1 else 'y'} of 1 seed"


def _ends(curves: Mapping[str, Mapping[Method, Curves]]) -> pd.DataFrame:
    shown = {
        "return_true": "executed return",
        "return_predicted": "predicted return",
        "final_distance": "final distance (m)",
        "success": ARRIVED,
        "within_data": "steps within the data",
    }
    counts = {"iterations": "iterations", "samples": "environment steps", "seconds": "seconds"}
    ends = [
        {
            "task": task,
            "method": method,
            "means over": _counted(int(own["seeds"]), len(own["return_true"])),
        }
        | {
            title: table.spell(own[metric][:, -1], "{:.3f} ± {:.3f}")
            if len(own.get(metric, ()))
            else ""
            for metric, title in shown.items()
        }
        | {title: f"{own[word][-1]:,.0f}" if word in own else "" for word, title in counts.items()}
        for task, methods in curves.items()
        for method, own in methods.items()
    ]
    return pd.DataFrame(ends)
