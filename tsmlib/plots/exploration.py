"""Figures of exploration: what rounds of planning and learning bring, and where episodes go.

Letters in shapes: k seeds, R rounds, n states.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator

from tsmlib.plots import axes
from tsmlib.plots.checks import finite, per_panel, shaped
from tsmlib.plots.method import Method
from tsmlib.plots.style import DARK, GRID, WIDTH, entry, panels, styled, tint

Rounds = Mapping[
    str, Mapping[Method, tuple[np.ndarray, np.ndarray]]
]  # title -> method -> steps (R,), values (k, R)
Levels = Mapping[str, Mapping[Method, np.ndarray]]  # title -> method -> values (k,)

DENSE = 12  # marks of a line


@styled
def rounds(
    curves: Rounds,
    ylabel: str | Mapping[str, str],
    yours: Rounds | None = None,
    lowest: Mapping[str, float] | None = None,
    levels: Levels | None = None,
) -> Figure:
    """What was measured after each round, against environment steps: mean over seeds, and thin lines of single seeds.

    curves: title -> method -> environment steps (R,) and values (k, R); ylabel: one for all, or title -> text; yours:
    as curves, drawn over them as hollow diamonds; lowest: title -> where an axis ends, so that what falls below it does
    not squeeze the others (arrows and words say how far), unless most does; levels: title -> method -> values (k,), of
    what takes no rounds, as a line across with all seeds within its shade. A line begins before the first round; a
    method of one round is a large pale mark, one of more than DENSE a line without marks, its seeds at its end. Steps
    are on a logarithmic axis where they span a factor of ten.
    """
    own, every = (
        yours or {},
        {title: {**(yours or {}).get(title, {}), **rows} for title, rows in curves.items()},
    )
    look_of, ylabels = axes.looks(curves, own), per_panel("ylabel", ylabel, curves)
    for method in {
        method for rows in every.values() for method, (at, _) in rows.items() if len(at) == 1
    }:
        look_of[method] |= {"ls": "", "ms": 6.5, "mfc": tint(method.look.colour, 0.6)}
    for method in {
        method for rows in every.values() for method, (at, _) in rows.items() if len(at) > DENSE
    }:
        look_of[method] |= {"marker": ""}
    across = levels or {}
    level_of = axes.looks(across, {}) if across else {}
    for look in level_of.values():
        look |= {"marker": "", "lw": 1.1, "ls": (0, (1, 1))}
    width = WIDTH if len(curves) > 1 else 3.8
    figure, grid = panels(len(curves), len(curves), 2.0, width=width, head=0)
    steps = np.concatenate([at for rows in every.values() for at, _ in rows.values()])
    log, single = 0 < steps.min() < steps.max() / 10, False
    for ax, (title, rows) in zip(grid, curves.items(), strict=True):
        values = np.concatenate([np.ravel(found) for _, found in every[title].values()])
        steps = np.concatenate([at for at, _ in every[title].values()])
        near, far = float(steps.min()), float(steps.max())
        beyond = [
            finite(f"{title}, {method.label}", at, "k")
            for method, at in across.get(title, {}).items()
        ]
        values = np.concatenate([values, *beyond])
        low, high = axes.limits(values, values)
        floor = (lowest or {}).get(title, low)
        low = max(low, floor) if np.median(values) > floor else low
        ax.set_ylim(0 if values.min() >= 0 and low < high / 5 else low, high)
        notes = []
        for method, seeds in zip(across.get(title, {}), beyond, strict=True):
            ax.axhspan(
                seeds.min(), seeds.max(), color=tint(method.look.colour, 0.2), lw=0, zorder=1
            )
            ax.axhline(float(seeds.mean()), **level_of[method], zorder=2)
        for method, given in rows.items():
            at, found = _checked(f"{title}, {method.label}", *given)
            mean, thin = found.mean(0), tint(method.look.colour, 0.5)
            if len(at) > DENSE or len(at) == 1:
                ax.plot(
                    np.full(len(found), at[-1]),
                    found[:, -1],
                    "_",
                    color=thin,
                    ms=5,
                    mew=0.9,
                    zorder=3,
                )
            else:
                ax.plot(at, found.T, color=thin, ls=look_of[method]["ls"], lw=0.6, zorder=2)
            size = {"ms": 4.5 if len(at) > 1 else 6.5}
            ax.plot(at, mean, **look_of[method] | size, zorder=3 if len(at) > 1 else 4)
            notes += axes.outside(ax, at, mean, method)
            single |= len(found) > 1
        for method, given in own.get(title, {}).items():
            at, found = _checked(f"{title}, {method.label}, yours", *given)
            notes += axes.diamonds(ax, "y", at, found.mean(0), method)
        if log:
            axes.log_axis(ax, near, far, "x")
            if len(curves) > 2 and near < far / 10:  # narrow panels
                ax.xaxis.set_major_locator(LogLocator())
            ax.set_xlim(near / 1.25, far * 1.25)
        else:
            ax.set_xlim(0, 1.05 * far)
            ax.locator_params(axis="x", nbins=5)
        ax.xaxis.set_major_formatter(FuncFormatter(lambda steps, _: f"{steps:,.0f}"))
        ax.grid(axis="y", color=GRID, lw=0.6)
        ax.set(title=title, ylabel=ylabels[title])
        axes.foot(ax, "environment steps", notes, width / len(curves) - 0.5)
    handles = [*axes.entries(look_of), *axes.entries(level_of)]
    if single:
        handles.append(entry("single seeds", color=tint(DARK, 0.5), lw=0.6))
    return axes.finish(
        figure, [grid], [*handles, *axes.yours_entry(*own.values())], 3 if len(curves) > 1 else 2
    )


@styled
def adapted(
    curves: Rounds, ylabel: str, yours: Rounds | None = None, *, robot: str = "the changed robot"
) -> Figure:
    """Errors of adapted models against the episodes that they know of the changed robot, on logarithmic axes.

    curves: title -> way -> episodes (R,) and errors (k, R), all above 0; yours: as curves, drawn over them as hollow
    diamonds. robot: what the axis of episodes calls it. A mark for the mean over seeds, a dot for each seed; marks at
    the same number of episodes stand a little beside each other.
    """
    own, look_of = yours or {}, axes.looks(curves, yours or {})
    figure, grid = panels(len(curves), len(curves), 2.1, head=0, sharex=True, sharey=True)
    given = [found for rows in (*curves.values(), *own.values()) for found in rows.values()]
    every, ticks = [y for _, y in given], sorted({float(x) for at, _ in given for x in at})
    points = np.concatenate([np.ravel(found) for found in every])
    limits = axes.limits(points, points, log=True)
    for ax, (title, rows) in zip(grid, curves.items(), strict=True):
        axes.log_axis(ax, *limits)
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.set_ylim(limits)
        ax.set_xscale("symlog", linthresh=5)
        ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        ax.minorticks_off()
        for way, row in rows.items():
            at, found = _checked(f"{title}, {way.label}", *row)
            beside = at * 1.06 ** ([*look_of].index(way) - (len(look_of) - 1) / 2)
            ax.plot(beside, found.T, ".", color=DARK, ms=2.5, mew=0, zorder=4)
            ax.plot(beside, found.mean(0), **look_of[way] | {"ms": 5.5, "mew": 1}, zorder=3)
        for way, row in own.get(title, {}).items():
            at, found = _checked(f"{title}, {way.label}, yours", *row)
            axes.diamonds(ax, "y", at, found.mean(0), way)
        ax.grid(axis="y", color=GRID, lw=0.6)
        ax.set(title=title, xlabel=f"episodes of {robot}")
    grid[0].set_ylabel(ylabel)
    dots = [_dots()] * any(len(found) > 1 for found in every)
    handles = [*axes.entries(look_of), *dots, *axes.yours_entry(*own.values())]
    return axes.finish(figure, [grid], handles, 4)


@styled
def arms(
    changes: Mapping[str, Mapping[str, Mapping[Method, np.ndarray]]], xlabel: str, *, ratio: bool
) -> Figure:
    """What a change brings, robot by robot: a mark for the mean over seeds, a dot for each seed.

    changes: title -> name of a robot, a line each -> way -> values (k,). ratio: they are what is left of a quantity, as
    a share of what it was, all above 0, on a logarithmic axis with a line at 1; else differences, with a line at 0.
    """
    names = [*dict.fromkeys(name for robots in changes.values() for name in robots)]
    look_of = axes.looks(*changes.values())
    columns = (
        len(changes) if len(changes) <= 4 else -(-len(changes) // 2)
    )  # two rows where one would be too narrow
    figure, grid = panels(
        len(changes), columns, 0.6 + 0.3 * len(names), head=0, sharex=True, sharey=True
    )
    every = np.concatenate(
        [
            np.ravel(finite(f"{title}, {name}", values, "k"))
            for title, robots in changes.items()
            for name, ways in robots.items()
            for values in ways.values()
        ]
    )
    low, high = axes.limits(every, every, log=ratio)
    apart = 0.66 / max(3, len(look_of))
    for ax, (title, robots) in zip(grid, changes.items(), strict=True):
        if ratio:
            axes.log_axis(ax, low, high, "x")
        ax.axvline(1 if ratio else 0, color=DARK, lw=0.8, zorder=1)
        for name, ways in robots.items():
            for way, seeds in ways.items():
                at = names.index(name) + apart * ([*look_of].index(way) - (len(look_of) - 1) / 2)
                ax.plot(seeds, np.full(len(seeds), at), ".", color=DARK, ms=2.5, mew=0, zorder=4)
                ax.plot(seeds.mean(), at, **look_of[way] | {"ls": "", "ms": 5, "mew": 1}, zorder=3)
        ax.set(title=title, xlim=(low, high), ylim=(len(names) - 0.5, -0.5))
        ax.set_yticks(range(len(names)), names)
        ax.grid(axis="x", color=GRID, lw=0.6)
    for ax in grid[-columns:]:
        ax.set_xlabel(xlabel)
    return axes.finish(figure, [grid], [*axes.entries(look_of, ls=""), _dots()], len(look_of) + 1)


def _dots() -> Line2D:
    return entry("single seeds", color=DARK, ls="", marker=".", ms=2.5)


def _checked(word: str, at: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    steps = finite(f"{word}, steps", at, "R")
    return steps, finite(word, values, f"k {len(steps)}")


@styled
def visited(
    states: Mapping[str, np.ndarray],
    labels: tuple[str, str],
    notes: Mapping[str, str],
    *,
    equal: bool = False,
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
