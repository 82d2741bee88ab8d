"""Results of 07_action_prior as rows and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tsmlib.envs.spec import sim_of
from tsmlib.evaluation.actions import novelty, roughness, traits
from tsmlib.planning.execution import Trial
from tsmlib.planning.tasks import Task
from tsmlib.statistics import spearman, told_apart

BARS = {"codes": ("at most", 0.65), "actions": ("at least", 0.9)}  # of the AUC, set before it was measured
SHARPER = 3.0  # times the training data's mean change: claim C52's "sharp, discontinuous"


# Rows of metrics/07_action_prior.csv ---------------------------------------------------------------------------------


def rows(actions: Tensor, held_out: Tensor, train: Tensor, **common: Any) -> list[dict[str, Any]]:
    """What torques (B, T, du) are like, against held-out and training torques of the data (N, T', du).

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
            values[name] = (told_apart(traits(actions, shape=shape), traits(held_out, shape=shape)), "")
    return [
        dict(common, metric=metric, value=value, unit=unit, n=len(actions)) for metric, (value, unit) in values.items()
    ]


_UNITS = {"change": "full torque", "centroid": "Hz", "fast": "share", "autocorrelation": ""}


def cost_of_prior(
    task: Task, over_codes: Trial, over_actions: Trial, held_out: Tensor, train: Tensor, **common: Any
) -> tuple[list[dict[str, Any]], dict[str, Tensor]]:
    """What searching over codes loses against the same search over torques, target by target, and where.

    ``lost``: return over torques minus return over codes; ``further``: the same of the final distance, in metres;
    ``peak``: largest torque of the plan over torques; ``novelty``: its distance from the data; ``distance``: metres
    that the fingertip or object has to go. ``outside``: the share of targets whose plan over torques is further from
    the data than 95 % of the data's own held-out episodes. Returns rows and the values per target (B,).
    """
    start = torch.from_numpy(task.start)[:, task.position].float()
    values = {
        "lost": over_actions.executed_return - over_codes.executed_return,
        "further": over_codes.final_distance - over_actions.final_distance,
        "peak": over_actions.actions.abs().amax((1, 2)),
        "novelty": novelty(over_actions.actions, train),
        "distance": (task.target - start).norm(dim=1),
    }
    usual = novelty(held_out[:, : task.horizon], train).quantile(0.95)
    common = dict(common, env=task.env, sim=sim_of(task.env), task=task.name, n=len(task))
    summary = {
        "lost": (float(values["lost"].mean()), "m"),
        "lost_share": (float(values["lost"].mean() / over_actions.executed_return.mean().abs()), "share"),
        "further": (float(values["further"].mean()), "m"),
        "outside": (float((values["novelty"] > usual).float().mean()), "share"),
        "lost_with_distance": (spearman(values["lost"], values["distance"]), ""),
        "lost_with_peak": (spearman(values["lost"], values["peak"]), ""),
    }
    return [dict(common, metric=metric, value=value, unit=unit) for metric, (value, unit) in summary.items()], values


def board(found: Sequence[Mapping[str, Any]], env: str) -> str:
    """Rows as a Markdown table, one line per method, mean over seeds, the data first."""
    columns = ("rms", "peak", "change", "change_ratio", "centroid", "autocorrelation", "novelty", "auc", "auc_shape")
    lines = ["| torques | n | " + " | ".join(columns) + " |", "|---" * (len(columns) + 2) + "|"]
    methods: dict[str, dict[str, list[float]]] = {}
    counts: dict[str, int] = {}
    for row in found:
        if row["env"] == env and row["metric"] in columns:
            label = title(row)
            methods.setdefault(label, {}).setdefault(row["metric"], []).append(row["value"])
            counts[label] = row["n"]
    for label, values in methods.items():
        cells = [f"{np.mean(values[column]):.3g}" if column in values else "" for column in columns]
        lines.append(f"| {label} | {counts[label]} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def same_method(row: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two rows are about one method under one condition, whatever their metric and seed."""
    fields = ("env", "model", "planner", "prior", "condition")
    return all(row[field] == other[field] for field in fields)


def title(row: Mapping[str, Any]) -> str:
    """Whose torques a row is about, in words."""
    known = {
        "data": "training data, held out",
        "samples": "samples of the prior",
        "again": "the data, told again by the prior",
    }
    return known.get(row["condition"]) or f"{row['model']}, {row['planner']} over {row['prior']}"
