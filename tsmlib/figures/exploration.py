"""Figures of exploration: what rounds of planning and learning bring, and where episodes go.

Letters in shapes: k seeds, R rounds, n states.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator

from tsmlib.figures import axes
from tsmlib.figures.checks import finite, per_panel, shaped
from tsmlib.figures.method import Method
from tsmlib.figures.style import DARK, GRID, WIDTH, entry, panels, styled, tint

Rounds = Mapping[str, Mapping[Method, tuple[np.ndarray, np.ndarray]]]  # title -> method -> steps (R,), values (k, R)

DENSE = 12  # marks of a line


@styled
def rounds(
    curves: Rounds, ylabel: str | Mapping[str, str], yours: Rounds | None = None,
    lowest: Mapping[str, float] | None = None,
) -> Figure:  # fmt: skip
    """What was measured after each round, against environment steps: mean over seeds, bars for the 95 % t interval.

    curves: title -> method -> environment steps (R,) and values (k, R); ylabel: one for all, or title -> text; yours:
    as curves, drawn over them as hollow diamonds; lowest: title -> where an axis ends, so that what falls below it does
    not squeeze the others (arrows and words say how far), unless most does. A line begins before the first round; a
    method of one round is a large pale mark, one of more than DENSE a line without marks, its bar at its end. Marks of
    methods at the same steps stand a little beside each other, so that their bars part. Steps are on a logarithmic axis
    where they span a factor of ten. Bars of what is never negative end at zero.
    """
    own, every = yours or {}, {title: {**(yours or {}).get(title, {}), **rows} for title, rows in curves.items()}
    look_of, ylabels = axes.looks(curves, own), per_panel("ylabel", ylabel, curves)
    for method in {method for rows in every.values() for method, (at, _) in rows.items() if len(at) == 1}:
        look_of[method] |= {"ls": "", "ms": 6.5, "mfc": tint(method.look.colour, 0.6)}
    for method in {method for rows in every.values() for method, (at, _) in rows.items() if len(at) > DENSE}:
        look_of[method] |= {"marker": ""}
    width = WIDTH if len(curves) > 1 else 3.8
    figure, grid = panels(len(curves), len(curves), 2.0, width=width, head=0)
    barred, steps = False, np.concatenate([at for rows in every.values() for at, _ in rows.values()])
    far, near = float(steps.max()), float(steps.min())
    log = 0 < near < far / 10
    for ax, (title, rows) in zip(grid, curves.items(), strict=True):
        values = np.concatenate([np.ravel(found) for _, found in every[title].values()])
        low, high = axes.limits(values, values)
        floor = (lowest or {}).get(title, low)
        low = max(low, floor) if np.median(values) > floor else low
        ax.set_ylim(0 if values.min() >= 0 and low < high / 5 else low, high)
        notes = []
        for method, given in rows.items():
            at, found = _checked(f"{title}, {method.label}", *given)
            mean, half = axes.band(found)
            dense, aside = len(at) > DENSE, [*look_of].index(method) - (len(look_of) - 1) / 2
            beside = at if dense else at * 1.02**aside if log else at + 0.012 * far * aside
            barred_at = slice(-1, None) if dense else slice(None)
            bottom = np.maximum(mean - half, 0) if values.min() >= 0 else mean - half
            middle, length = (bottom + mean + half) / 2, (mean + half - bottom) / 2
            axes.bars(ax, beside[barred_at], middle[barred_at], length[barred_at], method.look.colour)
            size = {"ms": 4.5 if len(at) > 1 else 6.5}
            ax.plot(beside, mean, **look_of[method] | size, zorder=3 if len(at) > 1 else 4)
            notes += axes.outside(ax, beside, mean, method)
            barred |= bool(half.any())
        for method, given in own.get(title, {}).items():
            at, found = _checked(f"{title}, {method.label}, yours", *given)
            notes += axes.diamonds(ax, "y", at, found.mean(0), method)
        if log:
            axes.log_axis(ax, near, far, "x")
            ax.set_xlim(near / 1.25, far * 1.25)
        else:
            ax.set_xlim(0, 1.05 * far)
            ax.locator_params(axis="x", nbins=5)
        ax.xaxis.set_major_formatter(FuncFormatter(lambda steps, _: f"{steps:,.0f}"))
        ax.grid(axis="y", color=GRID, lw=0.6)
        ax.set(title=title, ylabel=ylabels[title])
        axes.foot(ax, "environment steps", notes, width / len(curves) - 0.5)
    handles = axes.entries(look_of)
    if barred:
        handles.append(_bar())
    return axes.finish(figure, [grid], [*handles, *axes.yours_entry(*own.values())], 3 if len(curves) > 1 else 2)


@styled
def adapted(curves: Rounds, ylabel: str, yours: Rounds | None = None) -> Figure:
    """Errors of adapted models against the episodes that they know of the changed robot, on logarithmic axes.

    curves: title -> way -> episodes (R,) and errors (k, R), all above 0; yours: as curves, drawn over them as hollow
    diamonds. Mean over seeds, bars for the 95 % t interval; marks at the same number of episodes stand a little beside
    each other.
    """
    own, look_of = yours or {}, axes.looks(curves, yours or {})
    figure, grid = panels(len(curves), len(curves), 2.1, head=0, sharex=True, sharey=True)
    given = [found for rows in (*curves.values(), *own.values()) for found in rows.values()]
    every, ticks = [y for _, y in given], sorted({float(x) for at, _ in given for x in at})
    points = np.concatenate([np.ravel(found) for found in every])
    limits = axes.limits(points, axes.ends(column for found in every for column in found.T), log=True)
    for ax, (title, rows) in zip(grid, curves.items(), strict=True):
        axes.log_axis(ax, *limits)
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.set_ylim(limits)
        ax.set_xscale("symlog", linthresh=5)
        ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        ax.minorticks_off()
        for way, row in rows.items():
            at, found = _checked(f"{title}, {way.label}", *row)
            mean, half = axes.band(found)
            beside = at * 1.06 ** ([*look_of].index(way) - (len(look_of) - 1) / 2)
            axes.bars(ax, beside, mean, half, way.look.colour)
            ax.plot(beside, mean, **look_of[way] | {"ms": 5.5, "mew": 1}, zorder=3)
        for way, row in own.get(title, {}).items():
            at, found = _checked(f"{title}, {way.label}, yours", *row)
            axes.diamonds(ax, "y", at, found.mean(0), way)
        ax.grid(axis="y", color=GRID, lw=0.6)
        ax.set(title=title, xlabel="episodes of the changed arm")
    grid[0].set_ylabel(ylabel)
    bars = [_bar()] * any(len(found) > 1 for found in every)
    handles = [*axes.entries(look_of), *bars, *axes.yours_entry(*own.values())]
    return axes.finish(figure, [grid], handles, 4)


def _bar() -> Line2D:
    return entry("95 % interval over seeds", color=DARK, ls="", marker="|", ms=8, mew=0.8)


def _checked(word: str, at: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    steps = finite(f"{word}, steps", at, "R")
    return steps, finite(word, values, f"k {len(steps)}")


@styled
def visited(
    states: Mapping[str, np.ndarray], labels: tuple[str, str], notes: Mapping[str, str], *, equal: bool = False
) -> Figure:
    """States on a plane, a panel for each source: title -> (n, 2); labels: of both axes; notes: below a title; equal:
    axes of one scale."""
    figure, grid = panels(len(states), len(states), 1.75, head=0, sharex=True, sharey=True)
    for ax, (title, points) in zip(grid, states.items(), strict=True):
        ax.plot(*shaped(title, points, "n 2").T, ".", ms=1.6, mew=0, alpha=0.5, color=DARK)
        ax.set(title="\n".join(filter(None, (title, notes.get(title, "")))), xlabel=labels[0])
        ax.set_aspect("equal" if equal else "auto")
    grid[0].set_ylabel(labels[1])
    return figure
