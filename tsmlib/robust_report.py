"""What noise and delay cost: tables of 06_robustness, and the input of its figures, from its rows.

Rows of policies are one per copy and record of learning; their condition is clean, noise or delay.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from tsmlib.envs import imperfect
from tsmlib.robustness import condition
from tsmlib.scoreboard import paired
from tsmlib.style import interval, name


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
