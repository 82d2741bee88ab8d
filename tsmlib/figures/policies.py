"""Figures of learned policies: what they earn along their learning, and what that has cost.

The paper's figure 7 and what surrounds it. Reached through ``tsmlib.figures``, where labels are explained; a policy is
named by its model and what it acts through (``"tsm codes"``, ``"lstm actions"``), a model-free one by its algorithm.
Letters in shapes: k copies or seeds, R records along a curve.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from tsmlib.figures.axes import arrow, finish, finite, foot, known, limits, looks, spell
from tsmlib.figures.planning import REFERENCES
from tsmlib.figures.style import COLOURS, WIDTH, name, styled, words
from tsmlib.statistics import interval

Curves = dict[str, np.ndarray]
LearningCurves = Mapping[str, Mapping[str, Mapping[str, np.ndarray]]]  # task -> label -> Curves
AXES = {"iterations": "optimiser iterations", "samples": "environment steps, the data set's counted",
        "seconds": "seconds, training of the model counted"}  # fmt: skip


@styled
def figure7(
    curves: LearningCurves, references: Mapping[str, Mapping[str, float]] | None = None,
    against: Sequence[str] = ("iterations", "samples", "seconds"),
) -> Figure:  # fmt: skip
    """Learning curves of policies (paper, figure 7): a column for each task, a row for each quantity of ``against``.

    curves: task -> label -> {"return_true": (k, R)}, mean undiscounted return over the task's targets, and of
    {"iterations", "samples", "seconds": (R,)} what is known of it, "return_predicted": (k, R) what the model promised.
    A label is drawn in the rows that it has numbers for. references: task -> label -> return, drawn as lines; labels
    start with oracle, zero or random.

    Lines are means, bands their 95 % t intervals over the k. Against iterations, dashes show the promise. A policy
    whose samples are a data set that never grows is a point there, at its end, and a faint line to the right of it.
    Seconds are on a logarithmic axis from 1 s.
    """
    return draw_policies(curves, references or {}, against)


def draw_policies(
    curves: LearningCurves, references: Mapping[str, Mapping[str, float]], against: Sequence[str], sharey: bool = False
) -> Figure:
    """``figure7``; sharey: one scale of returns for all columns."""
    known("against", against, list(AXES))
    known("references", references, list(curves))
    checked = {task: {label: _checked(f"{task}, {label}", given) for label, given in rows.items()}
               for task, rows in curves.items()}  # fmt: skip
    look_of = {label: _look(label, look) for label, look in looks(
        label for rows in checked.values() for label in rows).items()}  # fmt: skip
    figure, grid = plt.subplots(
        len(against), len(checked), figsize=(WIDTH if len(checked) > 1 else 3.8, 1.75 * len(against) + 0.1),
        squeeze=False, sharey=True if sharey else "col",
    )  # fmt: skip
    if sharey:
        means = np.concatenate([row["return_true"].mean(0) for rows in checked.values() for row in rows.values()])
        floors = [level for own in references.values() for level in own.values()]
        low, high = limits(means, means, also=floors)
        if floors:  # what falls far below doing nothing would squeeze the rest
            low = max(low, min(floors) - 0.35 * (high - min(floors)))
        shared = low, high
    banded = promised = False
    for column, (task, rows) in zip(grid.T, checked.items(), strict=True):
        levels = references.get(task, {})
        ends = [mean + sign * half for row in rows.values() for mean, half in [_band(row["return_true"])]
                for sign in (-1, 1)]  # fmt: skip
        means = np.concatenate([row["return_true"].mean(0) for row in rows.values()])
        low, high = shared if sharey else limits(means, np.concatenate(ends), also=list(levels.values()))
        column[0].set_ylim(low, high)
        for ax, word in zip(column, against, strict=True):
            _levels(ax, levels)
            drawn = {label: rows[label] for label in look_of if word in rows.get(label, {})}
            far = _scale(ax, word, [row[word] for row in drawn.values()])
            notes = []
            for i, (label, row) in enumerate(drawn.items()):
                look, at, (mean, half) = look_of[label], row[word], _band(row["return_true"])
                if word == "seconds":
                    at, mean, half = (part[at >= 1] for part in (at, mean, half))
                if word == "samples" and np.ptp(at) == 0:
                    ax.plot([at[-1], far], [mean[-1]] * 2, color=look["color"], lw=0.5, alpha=0.6, zorder=2)
                    ax.errorbar(at[-1], mean[-1], half[-1], elinewidth=0.9, **{**look, "ls": ""}, zorder=4)
                    at, mean, half = at[-1:], mean[-1:], half[-1:]
                else:
                    every = max(1, len(at) // 6)
                    ax.plot(at, mean, **look, zorder=3, markevery=((i * every) // len(drawn), every))
                    ax.fill_between(at, mean - half, mean + half, color=look["color"], alpha=0.11, lw=0, zorder=2)
                banded |= bool(half.any())
                if word == "iterations" and "return_predicted" in row:
                    promised = True
                    ax.plot(
                        at, row["return_predicted"].mean(0), color=look["color"], ls=(0, (3, 1.5)), lw=0.7, zorder=2.5
                    )
                for side, gone in ((-1, mean < low), (1, mean > high)):
                    if gone.any():
                        arrow(ax, "y", at[gone.argmax()], side, look["color"])
                        notes.append(f"{name(label)} to {spell(side * (side * mean).max())}")
            ax.grid(axis="y", color="#EEEEEE", lw=0.6)
            foot(ax, AXES[word], notes, WIDTH / len(checked) - 0.5)
        column[0].set_title(task.capitalize())
    for axes in grid:
        axes[0].set_ylabel("true return")
    entries = [Line2D([], [], **look, label=name(label)) for label, look in look_of.items()]
    used = {words(label)[0] for levels in references.values() for label in levels}
    entries += [
        Line2D([], [], color=COLOURS[r], ls=REFERENCES[r], lw=1, label=name(r)) for r in REFERENCES if r in used
    ]
    if promised:
        entries.append(Line2D([], [], color="#777777", ls=(0, (3, 1.5)), lw=0.7, label="what the model promised"))
    if banded:
        entries.append(Line2D([], [], color="#DDDDDD", lw=5, solid_capstyle="butt", label="95 % interval"))
    return finish(figure, grid, entries, 4 if len(checked) > 1 else 2)


def _checked(field: str, given: Mapping[str, np.ndarray]) -> Curves:
    """Curves of one label whose parts fit each other."""
    true = finite(f"{field}, return_true", given["return_true"], "k R")
    row = {"return_true": true}
    if "return_predicted" in given:
        row["return_predicted"] = finite(f"{field}, return_predicted", given["return_predicted"],
                                         f"{true.shape[0]} {true.shape[1]}")  # fmt: skip
    for word in AXES:
        if word in given:
            row[word] = finite(f"{field}, {word}", given[word], str(true.shape[1]))
            if (np.diff(row[word]) < 0).any():
                raise ValueError(f"{field}: {word} go backwards; records must be in the order of learning")
    return row


def _look(label: str, look: Mapping[str, Any]) -> dict[str, Any]:
    """Filled and thick where the policy acts through the action prior, open where it gives torques itself."""
    actions = "actions" in words(label)[1].split()
    return {
        **look,
        "ls": "-",
        "ms": 5 if look["marker"] == "*" else 3.2,
        "lw": 0.9 if actions else 1.3,
        "mfc": "white" if actions else look["color"],
    }


def _band(lines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and half its 95 % interval (R,) of lines (k, R)."""
    mean, half = np.array([interval(values) for values in lines.T]).T
    return mean, half


def _scale(ax: Axes, word: str, at: Sequence[np.ndarray]) -> float:
    """The x axis for everything in ``at``, logarithmic for seconds; where it ends."""
    every = np.concatenate(at) if at else np.ones(1)
    far = float(every.max())
    if word == "seconds" and far > 1:
        near = float(every[every >= 1].min())
        ax.set_xscale("log")
        ax.set_xlim(0.8 * near, 1.15 * far)
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if far < 100 * near else (1.0,)))
        ax.xaxis.set_minor_locator(NullLocator())
    else:
        ax.set_xlim(-0.015 * far, 1.02 * far)
        ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    return far


def _levels(ax: Axes, levels: Mapping[str, float]) -> None:
    """Reference lines, of several oracles the better one."""
    for reference, dashes in REFERENCES.items():
        values = [value for label, value in levels.items() if words(label)[0] == reference]
        if values:
            ax.axhline(max(values), color=COLOURS[reference], ls=dashes, lw=1, zorder=1)
