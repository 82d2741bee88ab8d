"""What noise and delay cost: tables of 06_robustness, and the input of its figures, from its rows.

Rows of policies are one per copy and record of learning; their condition is clean, noise or delay.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from tsmlib.envs import imperfect
from tsmlib.envs.spec import DELAY, NOISE, imperfections, sim_of
from tsmlib.evaluation.filtering import PARTS, rmse
from tsmlib.figures.style import name
from tsmlib.statistics import interval
from tsmlib.study.results.prediction import paired


def board(rows: Iterable[Mapping[str, Any]], last: int) -> str:
    """What policies earn in each condition, and what is lost against the clean arm, as a Markdown table.

    Means over copies with half their 95 % t interval, at the last record of at most ``last`` iterations.
    """
    found: dict[tuple[str, str, str], dict[int, list[float]]] = {}
    for row in rows:
        if row["planner"] == "policy" and row["horizon"] <= last:
            key = (f"{row['model']} {row['prior']}", row["condition"], row["metric"])
            found.setdefault(key, {}).setdefault(row["horizon"], []).append(row["value"])
    ends = {key: np.array(line[max(line)]) for key, line in found.items()}
    conditions = list(dict.fromkeys(key[1] for key in ends))
    shown = {"return_true": "earned", "final_distance": "final distance (m)", "success50": "within 0.05 m"}
    heads = [f"{condition}: {title}" for condition in conditions for title in shown.values()]
    lines = [f"| policy | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|"]
    for label in dict.fromkeys(key[0] for key in ends):
        cells = []
        for column in conditions:
            for metric in shown:
                values = ends.get((label, column, metric))
                mean, half = interval(values) if values is not None else (0.0, 0.0)
                cells.append("" if values is None else f"{mean:.3g}" + (f" ± {half:.2g}" if half else ""))
        lines.append(f"| {name(label)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def lost(rows: Iterable[Mapping[str, Any]], label: str, word: str, last: int, random: float) -> float:
    """Share of a policy's gain over random torques on the clean arm that ``word`` (noise or delay) takes away."""
    earned: dict[str, dict[int, list[float]]] = {}
    for row in rows:
        if row["metric"] == "return_true" and f"{row['model']} {row['prior']}" == label and row["horizon"] <= last:
            earned.setdefault(row["condition"], {}).setdefault(row["horizon"], []).append(row["value"])
    clean, other = (float(np.mean(earned[part][max(earned[part])])) for part in ("clean", word))
    return (clean - other) / (clean - random)


def learning_curves(rows: Iterable[Mapping[str, Any]], last: int) -> dict[str, dict[str, dict[str, np.ndarray]]]:
    """The input of ``figures.figure8``: condition -> label -> curves, a line per copy, of up to ``last`` iterations."""
    found: dict[str, dict[str, dict[Any, dict[int, float]]]] = {}
    for row in rows:
        if row["planner"] == "policy" and row["metric"] == "return_true" and row["horizon"] <= last:
            lines = found.setdefault(row["condition"], {}).setdefault(f"{row['model']} {row['prior']}", {})
            lines.setdefault((row["seed"], row.get("copy", "")), {})[row["horizon"]] = row["value"]
    return {
        condition: {
            label: {
                "iterations": np.array(sorted(next(iter(lines.values())))),
                "return_true": np.array([[line[at] for at in sorted(line)] for line in lines.values()]),
            }
            for label, lines in methods.items()
        }
        for condition, methods in found.items()
    }


def advantage(
    rows: Sequence[Mapping[str, Any]],
    subject: str,
    rivals: Sequence[str],
    noises: Sequence[float],
    delays: Sequence[int],
) -> dict[str, np.ndarray]:
    """``subject`` minus each rival in ``ll_horizon``, nats per step, over noise and delay: the input of the map.

    Panel -> (noises, delays); pairs of training seeds averaged; NaN where there are no rows. Beside the plain arm the
    one with the obstacle, from the first touch on.
    """
    found = {}
    for env, touched in (("tsm/Reacher-v0", ""), ("tsm/ReacherObstacle-v0", "contact")):
        for rival in rivals:
            grid = np.full((len(noises), len(delays)), np.nan)
            for i, noise in enumerate(noises):
                for j, delay in enumerate(delays):
                    word = condition(imperfect(env, noise=noise, delay=delay))
                    word = {"clean": touched}.get(word, f"{word}, {touched}") if touched else word
                    pairs = paired(rows, subject, "ll_horizon", env=env, condition=word)
                    if rival in pairs:
                        grid[i, j] = pairs[rival].mean()
            found[f"{'after contact' if touched else 'plain arm'}: minus {name(rival)}"] = grid
    return found


def bars(rows: Sequence[Mapping[str, Any]], label: str, last: int, random: float) -> dict[str, tuple[str, str, bool]]:
    """What a policy (``label``: model and prior) is to reach: what -> (bar, measured, whether it was reached)."""
    found = {}
    for word in ("noise", "delay"):
        share = lost(rows, label, word, last, random)
        found[f"{word}: lost of the clean gain over random torques"] = ("at most 20 %", f"{share:.1%}", share <= 0.2)
        reached = [row["value"] for row in rows if row["metric"] == "success50" and row["condition"] == word
                   and f"{row['model']} {row['prior']}" == label]  # fmt: skip
        found[f"{word}: targets reached within 0.05 m"] = (
            "at least 60 %", f"{np.mean(reached):.0%}", bool(np.mean(reached) >= 0.6)
        )  # fmt: skip
    return found


def condition(env: str) -> str:
    """How tables name an environment's imperfections: clean; noise, delay, or both, with numbers unless the paper's."""
    _, noise, delay = imperfections(env)
    words = [word if value == paper else f"{word} {value:g}"
             for word, value, paper in (("noise", noise, NOISE), ("delay", delay, DELAY)) if value]  # fmt: skip
    return ", ".join(words) or "clean"


def renamed(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of an imperfect environment as rows of the plain one, with what is imperfect as their condition.

    The open loop's ``clean`` becomes ``noise``, say, ``segments`` becomes ``noise, segments``. Those of the plain
    arm stay as they are, but that ``learning`` becomes ``clean``.
    """
    found = []
    for row in rows:
        word, subset = condition(row["env"]), row["condition"]
        kept = word if subset in ("clean", "learning") else subset if word == "clean" else f"{word}, {subset}"
        found.append({**row, "env": imperfections(row["env"])[0], "condition": kept})
    return found


# Rows ----------------------------------------------------------------------------------------------------------------


def error_rows(
    env: str, model: str, ahead: np.ndarray | None, now: np.ndarray | None = None, **common: Any
) -> list[dict[str, Any]]:
    """Rows ``rmse_clean``: of the steps ahead (N, K, dx) and over all of them (no horizon), and of now (horizon 0).

    Beside the whole state also angles, velocities and fingertip apart, in metrics of their own.
    """
    base, _, _ = imperfections(env)
    common = dict(
        env=base, sim=sim_of(env), model=model, planner="none", condition=condition(env), unit="half range", **common
    )
    rows = []
    for part, dims in {"": slice(None), **PARTS}.items():
        metric = f"rmse_clean_{part}".removesuffix("_")
        if now is not None:
            rows.append(dict(common, metric=metric, horizon=0, value=rmse(now[..., dims]), n=len(now)))
        if ahead is not None:
            rows.append(dict(common, metric=metric, value=rmse(ahead[..., dims]), n=len(ahead)))
            rows += [
                dict(common, metric=metric, horizon=k + 1, value=rmse(ahead[:, k, dims]), n=len(ahead))
                for k in range(ahead.shape[1])
            ]
    return rows


def policy_rows(header: Mapping[str, Any], distances: Tensor, *, level: float = 0.05) -> list[dict[str, Any]]:
    """Rows ``success50`` of a learned policy, one per copy: the share of targets within ``level`` metres at the end.

    distances (copies, targets): final distances in metres.
    """
    env = header["fingerprint"]["env"]
    common = dict(
        env=imperfections(env)[0], sim=sim_of(env), task=header["made_from"]["task"], model=header["model"],
        planner="policy", prior=header["prior"], condition=condition(env), horizon=header["curve"]["iteration"][-1],
        n=distances.shape[1], seed=header["seed"], scale=header["scale"], metric=f"success{1000 * level:.0f}",
        unit="share",
    )  # fmt: skip
    return [dict(common, value=float((own < level).float().mean()), copy=copy) for copy, own in enumerate(distances)]
