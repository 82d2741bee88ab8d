"""Results of 07_action_prior: rows from torques and trials; tables from rows.

Rows of executed plans have the execution "open loop". The ``subset`` of others is "data" (held-out torques),
"sampled" (of the prior) or "reconstructed" (the data, encoded and decoded by the prior).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from tsmlib.evaluation.actions import novelty, roughness, traits
from tsmlib.plots.method import Method
from tsmlib.planning.execution import Trial
from tsmlib.planning.tasks import Task
from tsmlib.statistics import interval, spearman, two_sample_auc
from tsmlib import zoo
from reproduction.results import table
from reproduction.results.table import Row
from reproduction.runs import Run

THRESHOLDS = {
    "latent": "at most 0.65",
    "direct": "at least 0.9",
}  # of the AUC, set before it was measured
SHARPER = 3.0  # times the training data's mean change: claim C52's "sharp, discontinuous"
TORQUES = (
    "rms",
    "peak",
    "change",
    "change_ratio",
    "centroid",
    "autocorrelation",
    "novelty",
    "auc",
    "auc_shape",
)
COSTS = ("lost", "lost_share", "further", "outside", "lost_with_distance", "lost_with_peak")
STARTS = ("change_ratio", "centroid", "novelty", "auc", "final_distance", "exploitation_gap")
_SUBSETS = {
    "data": "training data, held out",
    "sampled": "samples of the prior",
    "reconstructed": "the data, reconstructed by the prior",
}
_UNITS = {"change": "full torque", "centroid": "Hz", "fast": "share", "autocorrelation": ""}

Trials = Mapping[Method, Trial]


@dataclass(frozen=True)
class Torques:
    """Torques of a task's training and held-out episodes (N, T', du), and by ``subset`` those measured (B, T, du)."""

    task: Task
    train: Tensor
    held_out: Tensor
    subsets: dict[str, Tensor]


# Rows ----------------------------------------------------------------------------------------------------------------


def task_rows(own: Torques, trials: Trials, run: Run) -> list[Row]:
    """All rows of a task but its gradients': of the subsets, of executed plans, and of what the prior costs them."""
    common, rest = table.of_task(own.task, run), own.held_out[len(own.subsets["data"]) :]
    found: list[Row] = []
    for subset, actions in own.subsets.items():
        source = zoo.method("random") if subset == "data" else zoo.method("prior", "latent")
        found += rows(
            actions, rest, own.train, **common | table.fields(source) | dict(subset=subset)
        )
    for method, trial in trials.items():
        about = common | table.fields(method) | dict(execution="open loop")
        found += rows(trial.actions, own.held_out, own.train, **about)
        worth = {
            "return_true": trial.executed_return,
            "exploitation_gap": trial.gap,
            "final_distance": trial.final_distance,
        }
        found += [
            dict(about, metric=metric, value=float(each.mean()), unit="m", n=len(each))
            for metric, each in worth.items()
        ]
    for model, planner in dict.fromkeys((method.model, method.planner) for method in trials):
        found += cost_of_prior(own, trials, model, planner, seed=run.seed, scale=run.scale)[0]
    return found


def rows(actions: Tensor, held_out: Tensor, train: Tensor, **common: object) -> list[Row]:
    """Rows of action statistics of torques (B, T, du), against held-out and training torques of the data (N, T', du).

    The AUC takes all held-out torques, so it stays away where there are too few plans for five folds.
    """
    held_out = held_out[:, : actions.shape[1]]
    found = roughness(actions)
    usual = float(roughness(held_out)["change"].mean())
    values = {name: (float(each.mean()), _UNITS[name]) for name, each in found.items()}
    values["rms"] = (float(actions.square().mean().sqrt()), "full torque")
    values["peak"] = (float(actions.abs().amax((1, 2)).mean()), "full torque")
    values["change_ratio"] = (values["change"][0] / usual, "ratio")
    values["novelty"] = (float(novelty(actions, train).mean()), "s.d.")
    if len(actions) >= 10 and len(held_out) >= 10:
        for name, shape in (("auc", False), ("auc_shape", True)):
            values[name] = (
                two_sample_auc(traits(actions, shape=shape), traits(held_out, shape=shape)),
                "",
            )
    return [
        dict(common, metric=metric, value=value, unit=unit, n=len(actions))
        for metric, (value, unit) in values.items()
    ]


def cost_of_prior(
    own: Torques, trials: Trials, model: str, planner: str, **common: object
) -> tuple[list[Row], dict[str, Tensor]]:
    """Return lost by the latent against the direct search space, target by target, and where.

    ``lost``: return of the direct plan minus that of the latent one; ``further``: the same of the final distance (m);
    ``peak``: largest torque of the direct plan; ``novelty``: its distance from the data; ``distance``: metres that the
    fingertip or object has to go. ``outside``: the share of targets whose direct plan is further from the data than
    95 % of the data's own held-out episodes. Returns rows and the values per target (B,).
    """
    task, (latent, direct) = own.task, (trials[method] for method in zoo.methods([model], planner))
    start = torch.from_numpy(task.start)[:, task.position].float()
    values = {
        "lost": direct.executed_return - latent.executed_return,
        "further": latent.final_distance - direct.final_distance,
        "peak": direct.actions.abs().amax((1, 2)),
        "novelty": novelty(direct.actions, own.train),
        "distance": (task.target - start).norm(dim=1),
    }
    usual = novelty(own.held_out[:, : task.horizon], own.train).quantile(0.95)
    common |= table.place(task.env) | dict(
        task=task.name,
        model=model,
        planner=planner,
        search_space="latent",
        execution="open loop",
        n=len(task),
    )
    summary = {
        "lost": (float(values["lost"].mean()), "m"),
        "lost_share": (float(values["lost"].mean() / direct.executed_return.mean().abs()), "share"),
        "further": (float(values["further"].mean()), "m"),
        "outside": (float((values["novelty"] > usual).float().mean()), "share"),
        "lost_with_distance": (spearman(values["lost"], values["distance"]), ""),
        "lost_with_peak": (spearman(values["lost"], values["peak"]), ""),
    }
    return [
        dict(common, metric=metric, value=value, unit=unit)
        for metric, (value, unit) in summary.items()
    ], values


# Tables --------------------------------------------------------------------------------------------------------------


def _means(
    found: pd.DataFrame, index: Sequence[str], metrics: Sequence[str], form: str
) -> pd.DataFrame:
    own = table.with_method(table.select(found, metric=metrics))
    if "torques" in index:
        words = [_SUBSETS.get(subset, "") for subset in own["subset"]]
        own["torques"] = [
            word or made.label for word, made in zip(words, own["method"], strict=True)
        ]
    return table.printed(
        table.means(own, list(index)), {metric: (metric, form) for metric in metrics}
    )


@table.sourced
def torques_table(found: pd.DataFrame, env: str) -> pd.DataFrame:
    """Action statistics in Markdown: one line per method, mean over seeds, the data first."""
    return _means(table.select(found, env=env), ("torques", "n"), TORQUES, "{:.3g}")


@table.sourced
def thresholds_table(found: pd.DataFrame) -> pd.DataFrame:
    """THRESHOLDS beside what plans came to, in Markdown: means over seeds."""
    plans = table.select(found, execution="open loop")
    wide = _means(plans, ("task", "method", "search_space"), ("auc", "change_ratio"), "{:.3f}")
    return wide.assign(threshold=wide["search_space"].map(THRESHOLDS)).drop(columns="search_space")


@table.told
def plans_told(found: pd.DataFrame) -> Iterator[str]:
    """A sentence per task: how much plans change their torques beside the data, how surely they are told from it, and
    the same of samples of the prior."""
    for task, part in table.groups(found, "task"):
        plans = table.select(part, execution="open loop")
        for word, own in (
            ("direct plans", table.select(plans, search_space="direct")),
            ("latent plans", table.select(plans, search_space="latent")),
            ("samples of the prior", table.select(part, subset="sampled")),
        ):
            change, auc = (
                own[own["metric"] == metric]["value"] for metric in ("change_ratio", "auc")
            )
            if len(change):
                yield (
                    f"{task}, {word}: torques change {_range(change)} times as much as the data's"
                    + (f", AUC {_range(auc)}." if len(auc) else ".")
                )


def _range(values: pd.Series) -> str:
    low, high = values.min(), values.max()
    return f"{low:.2f}" if f"{low:.2f}" == f"{high:.2f}" else f"{low:.2f} to {high:.2f}"


@table.told
def costs_told(found: pd.DataFrame, model: str, planner: str) -> Iterator[str]:
    """A sentence per task on what searching codes costs a model, and on how many targets lie outside the data."""
    for task, part in table.groups(found, "task"):
        means = (
            table.select(part, model=model, planner=planner, search_space="latent")
            .groupby("metric")["value"]
            .mean()
        )
        if {"lost_share", "outside"} <= set(means.index):
            yield (
                f"{task}: plans by {zoo.look(model).name} lose {means['lost_share']:.1%} of their return in the "
                f"latent space; {means['outside']:.0%} of the targets need torques outside the data."
            )


@table.sourced
def costs_table(found: pd.DataFrame) -> pd.DataFrame:
    """Rows of ``cost_of_prior`` in Markdown: means over seeds."""
    return _means(found, ("task", "model", "planner", "n"), COSTS, "{:.3f}")


@table.sourced
def starts_table(found: pd.DataFrame) -> pd.DataFrame:
    """Plans from smooth and from noisy first torques (07_starts.csv), in Markdown."""
    return _means(found, ("torque_weight", "search_space", "start"), STARTS, "{:.3f}")


@table.sourced
def gradients_table(found: pd.DataFrame) -> pd.DataFrame:
    """Signal-to-noise ratio of gradients in Markdown: the geometric mean over starts, and by how much that of the
    latent search space is larger, with the 95 % t interval over starts (means over the seeds there are)."""
    own = table.select(found, metric="gradient_snr")
    own = own.assign(value=np.log(own["value"]))
    lines = []
    for (env, model), part in table.groups(own, ["env", "model"]):
        wide = table.means(part, "target", "search_space")
        mean, half = interval(wide["latent"] - wide["direct"])
        low, ratio, high = np.exp([mean - half, mean, mean + half])
        lines.append(
            {"env": env, "method": zoo.method(model), "n": len(wide)}
            | {space: f"{np.exp(wide[space].mean()):.3g}" for space in ("latent", "direct")}
            | {"latent / direct": f"{ratio:.3g} [{low:.3g}, {high:.3g}]"}
        )
    return pd.DataFrame(lines)
