"""How alike planned and training torques are, and what it costs to keep them alike (section 5.3.5, figure 10).

The paper shows one example each; here is what can be counted: roughness, spectrum, and whether a classifier that never
saw them tells planned torques from training ones. 0.5 of its AUC means that it cannot, 1 that it never errs.

Letters in shapes: B plans or episodes, T steps, F frequencies, q traits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tsmlib.control import Task, Trial, sim_of
from tsmlib.envs.base import DT
from tsmlib.invariants import novelty, roughness
from tsmlib.latent import spearman
from tsmlib.prior import ActionPrior

TRAITS = ("change", "centroid", "autocorrelation")  # of claim C51
BARS = {"codes": ("at most", 0.65), "actions": ("at least", 0.9)}  # of the AUC, set before it was measured
SHARPER = 3.0  # times the training data's mean change: claim C52's "sharp, discontinuous"


def traits(actions: Tensor, *, shape: bool = False) -> Tensor:
    """TRAITS of torques (B, T, du), (B, 3). shape: of each plan divided by its own root mean square."""
    if shape:
        actions = actions / actions.square().mean((1, 2), keepdim=True).sqrt().clamp_min(1e-9)
    found = roughness(actions)
    return torch.stack([found[name] for name in TRAITS], dim=1).double()


def spectrum(actions: Tensor, dt: float = DT) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (F,) in Hz and the mean power density (F,) of torques (B, T, du), per Hz; it integrates to the mean
    square torque (without the constant part, which is left out)."""
    steps = actions.shape[1]
    power = torch.fft.rfft(actions.double(), dim=1).abs().square().mean((0, 2)) * (2 * dt / steps)
    if steps % 2 == 0:
        power[-1] /= 2  # the highest frequency has no mirror image
    return torch.fft.rfftfreq(steps, dt).numpy()[1:], power.numpy()[1:]


def auc(positive: Tensor, negative: Tensor) -> float:
    """The chance that a score of ``positive`` (n,) is above one of ``negative`` (m,), ties counting half."""
    ordered = negative.sort().values
    below = torch.searchsorted(ordered, positive.contiguous())
    at_most = torch.searchsorted(ordered, positive.contiguous(), right=True)
    return float((below + at_most).double().mean() / (2 * len(negative)))


def told_apart(first: Tensor, second: Tensor, *, folds: int = 5, seed: int = 0) -> float:
    """AUC of a logistic regression between two samples of traits (B, q), each judged by one that never saw it.

    The regression reads each trait and its square, so that a sample that is only narrower is found too; both sides
    weigh alike however large. Cross-validated in ``folds`` parts: an AUC per part, then their mean, since scores of
    different regressions are not comparable. Below 0.5 by chance alone. ValueError with fewer than two rows a fold.
    """
    if min(len(first), len(second)) < 2 * folds:
        raise ValueError(f"{len(first)} and {len(second)} rows are too few for {folds} folds of at least 2 each")
    generator = torch.Generator().manual_seed(seed)
    parts = [torch.randperm(len(side), generator=generator) % folds for side in (first, second)]
    found = []
    for fold in range(folds):
        train = [side[part != fold] for side, part in zip((first, second), parts, strict=True)]
        known = torch.cat(train)
        middle, scale = known.mean(0), known.std(0).clamp_min(1e-9)
        weights = _logistic(*(_squared((side - middle) / scale) for side in train))
        test = (side[part == fold] for side, part in zip((first, second), parts, strict=True))
        found.append(auc(*(_squared((side - middle) / scale) @ weights for side in test)))
    return float(np.mean(found))


def _squared(x: Tensor) -> Tensor:
    """Traits, their squares and a one."""
    return torch.cat([x, x.square(), torch.ones(len(x), 1, dtype=x.dtype)], dim=1)


def _logistic(first: Tensor, second: Tensor, *, ridge: float = 1e-2, iterations: int = 30) -> Tensor:
    """Weights (q,) of the logistic regression that is above zero on ``first``, by Newton's method."""
    x = torch.cat([first, second])
    label = torch.cat([torch.ones(len(first)), torch.zeros(len(second))]).to(x)
    weigh = torch.where(label > 0, 0.5 / len(first), 0.5 / len(second)).to(x)
    shrink, weights = ridge * torch.eye(x.shape[1], dtype=x.dtype), x.new_zeros(x.shape[1])
    for _ in range(iterations):
        p = torch.sigmoid(x @ weights)
        slope = x.T @ (weigh * (p - label)) + shrink @ weights
        curvature = (x.T * (weigh * p * (1 - p))) @ x + shrink
        step = torch.linalg.solve(curvature, slope)
        weights = weights - step * min(1.0, 5 / float(step.norm().clamp_min(1e-12)))
    return weights


# The prior on its own ------------------------------------------------------------------------------------------------


@torch.no_grad()
def drawn(prior: ActionPrior, n: int, horizon: int, generator: torch.Generator) -> Tensor:
    """Torques (n, horizon, du) of codes from N(0, I), from rest (U_0 = 0)."""
    z = torch.randn(n, -(-horizon // prior.segment_len), prior.latent_dim, generator=generator)
    return prior.plan(_rest(prior, n), z)[:, :horizon]


@torch.no_grad()
def told_again(prior: ActionPrior, actions: Tensor) -> Tensor:
    """Torques (B, T, du) encoded segment by segment and decoded from the mean codes, T a multiple of H."""
    segments = actions.unflatten(1, (-1, prior.segment_len))  # (B, K, H, du)
    codes, _ = prior.encode(segments.flatten(0, 1))
    return prior.plan(_rest(prior, len(actions)), codes.unflatten(0, segments.shape[:2]))


def _rest(prior: ActionPrior, n: int) -> Tensor:
    return prior.std.new_zeros(n, prior.past_len, len(prior.std))


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
        "lost": over_actions.true - over_codes.true,
        "further": over_codes.final_distance - over_actions.final_distance,
        "peak": over_actions.actions.abs().amax((1, 2)),
        "novelty": novelty(over_actions.actions, train),
        "distance": (task.target - start).norm(dim=1),
    }
    usual = novelty(held_out[:, : task.horizon], train).quantile(0.95)
    common = dict(common, env=task.env, sim=sim_of(task.env), task=task.name, n=len(task))
    summary = {
        "lost": (float(values["lost"].mean()), "m"),
        "lost_share": (float(values["lost"].mean() / over_actions.true.mean().abs()), "share"),
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
