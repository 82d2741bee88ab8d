"""Figures of predictions: who predicts best, how far ahead, and how honestly.

The paper's figure 5 and what surrounds it; what they share is in ``tsmlib.figures.axes``, the rollouts are in
``tsmlib.gallery``. Reached through ``tsmlib.figures``, where labels are explained. What lies far outside an axis has an
arrow, and its value in words below the panel.

Letters in shapes: k seeds, T steps, L levels.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tsmlib.figures.axes import (
    Values,
    arrow,
    checked_panels,
    ends,
    finish,
    finite,
    foot,
    handles,
    known,
    limits,
    log_axis,
    looks,
    mark,
    per_panel,
    spell,
)
from tsmlib.figures.style import WIDTH, colour, legend, name, shaped, styled, tint, words
from tsmlib.statistics import interval


@styled
def figure5(
    values: Values | Mapping[str, Values], ylabel: str | Mapping[str, str] = "log-likelihood per step"
) -> Figure:  # fmt: skip
    """Prediction quality by environment (paper, figure 5): mean over seeds, 95 % t interval, each seed a small dot.

    values: environment -> label -> (k,), one value per seed; or title -> such a mapping, for panels side by side.
    ylabel: one for all, or title -> text.
    """
    nested = any(isinstance(row, Mapping) for rows in values.values() for row in rows.values())
    given: Mapping[str, Any] = values if nested else {"": values}
    checked = {title: checked_panels(panel, "k") for title, panel in given.items()}
    look_of = looks(label for panel in checked.values() for rows in panel.values() for label in rows)
    ylabels = per_panel("ylabel", ylabel, checked)
    slots, group = {label: i for i, label in enumerate(look_of)}, len(look_of) + 1.6
    width = WIDTH if len(checked) > 1 else 0.72 * WIDTH
    figure, grid = plt.subplots(1, len(checked), figsize=(width, 2.25), squeeze=False)
    several = False
    for ax, (title, panel) in zip(grid[0], checked.items(), strict=True):
        every = [seeds for rows in panel.values() for seeds in rows.values()]
        several |= any(len(seeds) > 1 for seeds in every)
        ax.set_ylim(limits(np.concatenate(every), ends(every)))
        ax.set_xlim(-1.3, len(panel) * group - 1.3)
        short = [re.sub(r"^tsm/|-v\d+$|Reacher(?=[A-Z])", "", env) for env in panel]
        notes = []
        for e, rows in enumerate(panel.values()):
            for label, seeds in rows.items():
                outside = mark(ax, "y", e * group + slots[label], seeds, look_of[label], aside=0.32)
                notes += [f"{short[e]}, {name(label)} {text}" for text in outside]
            if e:
                ax.axvline(e * group - 1.3, color="#CCCCCC", lw=0.6, zorder=1)
        ax.grid(axis="y", color="#EEEEEE", lw=0.6)
        ax.set_xticks([e * group + (len(look_of) - 1) / 2 for e in range(len(panel))], short)
        ax.tick_params(axis="x", length=0, labelsize=7)
        ax.set(title=title, ylabel=ylabels[title])
        foot(ax, "", notes, width / len(checked) - 0.5)
    entries = handles(look_of, ls="", ms=4.2)
    if several:
        entries.append(Line2D([], [], color="#777777", ls="", marker="o", ms=1.8, mew=0, label="one seed"))
    return finish(figure, grid, entries, 5 if len(checked) > 1 else 3)


@styled
def against_horizon(
    curves: Values, ylabel: str | Mapping[str, str], *, log: Collection[str] = (),
    reference: Mapping[str, float] | None = None, columns: int = 3,
) -> Figure:  # fmt: skip
    """Scores at every step ahead, one panel each: mean over seeds, and a band for its 95 % t interval.

    curves: title -> label -> (k, T); ylabel: one for all, or title -> text; log: the titles with a logarithmic axis;
    reference: title -> a value to draw a dashed line at, such as the nominal coverage.
    A band may run out of its panel; of a curve that does, the furthest value stands below.
    """
    reference = reference or {}
    checked = checked_panels(curves, "k T")
    known("log", log, curves)
    known("reference", reference, curves)
    look_of = looks(label for rows in curves.values() for label in rows)
    ylabels, titles = per_panel("ylabel", ylabel, curves), list(curves)
    columns = min(columns, len(titles))
    width, down = WIDTH if columns > 2 else 3.5 * columns, -(-len(titles) // columns)
    figure, grid = plt.subplots(down, columns, figsize=(width, 1.55 * down + 0.1), squeeze=False)
    for ax in grid.flat[len(titles) :]:
        ax.remove()
    banded = False
    for i, (title, ax) in enumerate(zip(titles, grid.flat, strict=False)):
        lines = {label: np.array([interval(column) for column in checked[title][label].T]).T
                 for label in look_of if label in checked[title]}  # fmt: skip
        points = np.concatenate([mean for mean, _ in lines.values()])
        if title in log and points.min() <= 0:
            raise ValueError(f"{title}: {spell(points.min())} cannot stand on a logarithmic axis")
        bands = np.concatenate([mean + sign * half for mean, half in lines.values() for sign in (-1, 1)])
        bands = np.maximum(bands, 0) if points.min() >= 0 else bands  # no room for what an error cannot be
        also = [reference[title]] if title in reference else []
        low, high = limits(points, bands, also, title in log)
        ax.locator_params(nbins=6)
        if title in log:
            log_axis(ax, low, high)
        ax.set_ylim(low, high)
        notes = []
        for j, (label, (mean, half)) in enumerate(lines.items()):
            look, steps = look_of[label], np.arange(1, len(mean) + 1)
            every = max(1, len(steps) // 5)
            ax.plot(steps, mean, **look, zorder=3, markevery=((j * every) // len(lines), every))
            if half.any():
                banded = True
                lower = np.maximum(mean - half, low / 10) if title in log else mean - half
                ax.fill_between(steps, lower, mean + half, color=look["color"], alpha=0.11, lw=0, zorder=2)
            for side, gone in ((-1, mean < low), (1, mean > high)):
                if gone.any():
                    arrow(ax, "y", steps[gone.argmax()], side, look["color"])
                    notes.append(f"{name(label)} to {spell(side * (side * mean).max())}")
        if also:
            ax.axhline(also[0], color="#777777", ls=(0, (4, 2)), lw=0.8, zorder=1)
        ax.set_xlim(0, max(mean.size for mean, _ in lines.values()) + 1)
        alike = i % columns and ylabels[title] == ylabels[titles[i - 1]]
        ax.set(title=title, ylabel="" if alike else ylabels[title])
        foot(ax, "steps ahead" if i + columns >= len(titles) else "", notes, width / columns - 0.4)
    entries = handles(look_of)
    if banded:
        entries.append(Line2D([], [], color="#DDDDDD", lw=5, solid_capstyle="butt", label="95 % interval over seeds"))
    return finish(figure, grid, entries, 5 if width == WIDTH else 2)


@styled
def calibration(levels: np.ndarray, curves: Values, columns: int = 3) -> Figure:
    """How often the truth lies within a model's central interval, against how often it should; ideal is the diagonal.

    levels: (L,) nominal coverages in [0, 1]; curves: title -> label -> (L,) observed shares in [0, 1].
    """
    nominal = finite("levels", levels, "L")
    checked = checked_panels(curves, str(len(nominal)))
    look_of = looks(label for rows in curves.values() for label in rows)
    shares = {f"{title}, {label}": row for title, rows in checked.items() for label, row in rows.items()}
    for word, array in {"levels": nominal, **shares}.items():
        if array.min() < 0 or array.max() > 1:
            raise ValueError(f"{word}: {array.min():g} to {array.max():g}, expected shares between 0 and 1")
    columns = min(columns, len(curves))
    down, size = -(-len(curves) // columns), min(2.2, WIDTH / columns)
    figure, grid = plt.subplots(down, columns, figsize=(size * columns + 0.2, size * down), squeeze=False,
                                sharex=True, sharey=True, layout="compressed")  # fmt: skip
    for ax in grid.flat[len(curves) :]:
        ax.remove()
    for i, (ax, (title, rows)) in enumerate(zip(grid.flat, checked.items(), strict=False)):
        ax.plot((0, 1), (0, 1), color="#999999", lw=0.7, zorder=1)
        for label in (label for label in look_of if label in rows):
            ax.plot(nominal, rows[label], **look_of[label], zorder=3, clip_on=False,
                    markevery=max(1, len(nominal) // 8))  # fmt: skip
        for text, at, ha, va in (("intervals too wide", (0.03, 0.97), "left", "top"),
                                 ("too narrow", (0.97, 0.03), "right", "bottom")):  # fmt: skip
            ax.annotate(text, at, ha=ha, va=va, fontsize=6.5, color="#777777", zorder=1)
        quarters = ((0, 0.25, 0.5, 0.75, 1), ("0", "0.25", "0.5", "0.75", "1"))
        ax.set_xticks(*quarters)
        ax.set_yticks(*quarters)
        ax.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", title=title)
        if i + columns >= len(curves):
            ax.tick_params(labelbottom=True)
            ax.set_xlabel("nominal coverage")
        if i % columns == 0:
            ax.set_ylabel("observed coverage")
    return finish(figure, grid, handles(look_of), (1, 3, 5, 5)[min(columns, 4) - 1])


@styled
def differences(
    values: Values, xlabel: str | Mapping[str, str], *, lower_is_better: Collection[str] = (), subject: str = "tsm"
) -> Figure:
    """``subject`` minus each other model, paired by seed, with 95 % t intervals and a line at zero (a forest plot).

    values: title -> label of the other model -> (k,) differences; xlabel: one for all, or title -> text;
    lower_is_better: the titles in which a negative difference favours ``subject``. A mark is filled and its row tinted
    where the interval excludes zero; it is open where it does not, and for a single seed, which has no interval.
    """
    checked = checked_panels(values, "k")
    known("lower_is_better", lower_is_better, values)
    look_of = looks(label for rows in checked.values() for label in rows)
    xlabels = per_panel("xlabel", xlabel, checked)
    heights = {label: y for y, label in enumerate(look_of)}
    width, height = WIDTH if len(checked) > 1 else 4.5, 0.21 * len(look_of) + 0.85
    figure, grid = plt.subplots(1, len(checked), figsize=(width, height), squeeze=False, sharey=True)
    for ax, (title, rows) in zip(grid[0], checked.items(), strict=True):
        ax.set_xlim(limits(np.concatenate(list(rows.values())), ends(rows.values()), also=[0.0]))
        ax.locator_params(axis="x", nbins=5)
        notes = []
        for label, seeds in rows.items():
            mean, half = interval(seeds)
            look, y = look_of[label], heights[label]
            if half and abs(mean) > half:
                ax.axhspan(y - 0.5, y + 0.5, color=tint(look["color"], 0.13), lw=0, zorder=0)
            else:
                look = {**look, "mfc": "white"}
            notes += [f"{name(label)} {text}" for text in mark(ax, "x", y, seeds, look, aside=0.27)]
        ax.axvline(0, color="#555555", lw=0.8, zorder=1)
        left, better = title in lower_is_better, f"{name(subject)} better"
        for text, x, ha in ((f"← {better if left else 'worse'}", 0, "left"),
                            (f"{'worse' if left else better} →", 1, "right")):  # fmt: skip
            ax.annotate(text, (x, 1), (0, 1), xycoords="axes fraction", textcoords="offset points", fontsize=6.5,
                        color="#555555", ha=ha, va="bottom")  # fmt: skip
        ax.set_title(title, pad=12)
        ax.spines["left"].set_visible(False)
        ax.tick_params(axis="y", length=0, pad=5)
        foot(ax, xlabels[title], notes, (width - 1.6) / len(checked))
    first = grid[0, 0]
    first.set_yticks(list(heights.values()), [name(label) for label in heights], fontsize=7)
    first.annotate(f"{name(subject)} minus", (0, 1), (-5, 1), xycoords="axes fraction", textcoords="offset points",
                   fontsize=7, ha="right", va="bottom", weight="bold", color=colour(subject))  # fmt: skip
    first.set_ylim(len(look_of) - 0.5, -0.5)
    return finish(figure, grid)


LINES = ("-", "--", "-.", ":")


@styled
def ll_against_horizon(curves: Mapping[str, np.ndarray], ylabel: str = "log-likelihood per step") -> Figure:
    """A score at every step ahead, label -> (T,); a second label of the same model is drawn dashed."""
    figure, ax = plt.subplots(figsize=(3.6, 2.3))
    drawn: dict[str, int] = {}
    for label, curve in curves.items():
        values, model = shaped(label, curve, "T"), words(label)[0]
        line = LINES[drawn.get(model, 0) % len(LINES)]
        drawn[model] = drawn.get(model, 0) + 1
        ax.plot(np.arange(1, len(values) + 1), values, ls=line, color=colour(label), label=name(label))
    ax.set(xlabel="steps ahead", ylabel=ylabel)
    legend(figure, ax.get_legend_handles_labels()[0], columns=3)  # type: ignore[arg-type]
    return figure
