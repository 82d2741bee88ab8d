"""Figures of the latent space: whether codes are used, what sampled futures look like, and what one code means.

The paper's figure 9 and what surrounds it. Reached through ``tsmlib.figures``, where labels are explained.

Letters in shapes: k seeds, S samples, E episodes, T steps, N points, g groups, n codes on a walk, dx state size.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import NullFormatter

from tsmlib.figures.axes import finite, handles, log_axis, looks
from tsmlib.figures.style import WIDTH, colour, legend, name, shaped, styled, tint
from tsmlib.statistics import interval

Draw = Callable[[Axes, np.ndarray], object]  # paints one state (dx,) into axes, in metres
WALK = mpl.colormaps["viridis"]
RADIUS = 0.03  # m, of the block


@styled
def code_use(
    values: Mapping[str, Mapping[str, Mapping[str, np.ndarray]]], xlabels: Mapping[str, str],
    bars: Mapping[str, Mapping[str, float]],
) -> Figure:  # fmt: skip
    """How much codes say, and how far sampled futures part: one row per environment and condition.

    values: title -> row -> label -> (k,), one value per seed, above zero; xlabels: title -> text; bars: title -> row ->
    a bound that was set beforehand, drawn as a tick.
    """
    rows = list(dict.fromkeys(row for panel in values.values() for row in panel))
    look_of = looks(label for panel in values.values() for row in panel.values() for label in row)
    figure, grid = plt.subplots(
        1, len(values), figsize=(WIDTH, 0.24 * len(rows) + 0.85), sharey=True, squeeze=False
    )  # fmt: skip
    for ax, (title, panel) in zip(grid[0], values.items(), strict=True):
        for y, row in enumerate(rows):
            ax.axhline(y, color="#EEEEEE", lw=0.6, zorder=0)
            for label, seeds in panel.get(row, {}).items():
                seeds = finite(f"{title}, {row}, {label}", seeds, "k")
                mean, half = interval(seeds)
                low = max(mean - half, seeds.min() / 2)
                if half:
                    ax.plot((low, mean + half), (y, y), color=look_of[label]["color"], lw=1, zorder=2)
                ax.plot(mean, y, **{**look_of[label], "ls": "", "ms": 4.5}, zorder=3, clip_on=False)
            if row in bars.get(title, {}):
                bound = bars[title][row]
                ax.plot((bound, bound), (y - 0.36, y + 0.36), color="#222222", lw=1.2, zorder=2.5)
        ax.set(xscale="log", xlabel=xlabels[title], title=title)
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.spines["left"].set_visible(False)
        ax.tick_params(axis="y", length=0)
    grid[0, 0].set_yticks(range(len(rows)), rows)
    grid[0, 0].set_ylim(len(rows) - 0.5, -0.5)
    entries = handles(look_of, ls="", ms=4.5)
    if any(bars.values()):
        entries.append(Line2D([], [], color="#222222", ls="", marker="|", ms=7, mew=1.2, label="bar set beforehand"))
    legend(figure, entries)
    return figure


@styled
def around_touch(curves: Mapping[str, Mapping[str, np.ndarray]], touch: int) -> Figure:
    """Spread and error before and after the first touch: label -> {"spread": (T,), "error": (T,)}, column ``touch`` the
    first state that touches. Solid: deviation of the samples; dashed: error of their mean."""
    figure, ax = plt.subplots(figsize=(3.6, 2.2))
    for label, pair in curves.items():
        steps = np.arange(len(pair["spread"])) - touch
        ax.plot(steps, shaped(f"{label}: spread", pair["spread"], "T"), color=colour(label), marker=".", ms=3)
        ax.plot(steps, shaped(f"{label}: error", pair["error"], str(len(steps))), color=colour(label), ls=(0, (3, 1.5)))
    ax.axvline(0, color="#999999", lw=0.7, zorder=0)
    ax.annotate("first touch", (0, 1), (2, -1), xycoords=("data", "axes fraction"), textcoords="offset points",
                fontsize=6.5, va="top", color="#555555")  # fmt: skip
    ax.set(xlabel="steps since the first touch", ylabel="share of the data's deviation", ylim=(0, None))
    entries = [Line2D([], [], color=colour(label), label=name(label)) for label in curves]
    entries.append(Line2D([], [], color="#555555", marker=".", ms=3, label="spread of samples"))
    entries.append(Line2D([], [], color="#555555", ls=(0, (3, 1.5)), label="error of their mean"))
    legend(figure, entries, columns=2)
    return figure


@styled
def spread_against_error(curves: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]]) -> Figure:
    """Does the spread tell the error? title -> label -> spread (g,) and error (g,) of segments, grouped by spread.

    On the diagonal the mean of the samples is as far from the truth as the samples are from it."""
    figure, grid = plt.subplots(
        1, len(curves), figsize=(min(WIDTH, 2.35 * len(curves) + 0.3), 2.2), squeeze=False, layout="compressed"
    )
    look_of = looks(label for panel in curves.values() for label in panel)
    for ax, (title, panel) in zip(grid[0], curves.items(), strict=True):
        every = np.concatenate([part for pair in panel.values() for part in pair])
        every = every[every > 0]
        limits = (every.min() / 1.3, every.max() * 1.3)
        ax.plot(limits, limits, color="#999999", lw=0.7, zorder=1)
        for label, (spread, error) in panel.items():
            ax.plot(finite(f"{title}, {label}: spread", spread, "g"), finite(f"{title}, {label}: error", error, "g"),
                    **{**look_of[label], "ms": 3.5})  # fmt: skip
        ax.set(xscale="log", yscale="log", xlim=limits, ylim=limits, aspect="equal", title=title, xlabel="spread")
    grid[0, 0].set_ylabel("error of the mean")
    legend(figure, handles(look_of, ms=3.5))
    return figure


@styled
def figure9(draw: Draw, starts: np.ndarray, true: np.ndarray, samples: Mapping[str, np.ndarray]) -> Figure:
    """Sampled ways of the object after a push (paper, figure 9): one column per episode, one row per model.

    draw paints the scene; starts (E, dx): the last observed states; true (E, T, 2): where the object went, in m;
    samples: label -> (S, E, T, 2), under the true actions.
    """
    true = finite("true", true, "E T 2")
    count, steps, _ = true.shape
    figure, grid = plt.subplots(
        len(samples), count, figsize=(WIDTH, (WIDTH / count) * len(samples) + 0.42), squeeze=False, layout="compressed"
    )
    for row, (label, ways) in zip(grid, samples.items(), strict=True):
        ways = finite(f"samples['{label}']", ways, f"S {count} {steps} 2")
        for ax, start, truth, fan in zip(row, starts, true, ways.transpose(1, 0, 2, 3), strict=True):
            draw(ax, start)
            faint = float(np.clip(6 / len(fan), 0.2, 0.7))
            fan = np.concatenate([np.broadcast_to(start[6:8], (len(fan), 1, 2)), fan], axis=1)
            ax.add_collection(LineCollection(list(fan), colors=colour(label), linewidths=0.7, alpha=faint, zorder=6))
            ax.plot(*fan[:, -1].T, ".", color=colour(label), ms=3, mew=0, zorder=6.2)
            ax.plot(*np.concatenate([start[None, 6:8], truth]).T, color="black", lw=1.3, zorder=7)
            ax.plot(*truth[-1], "o", color="black", ms=3, zorder=7)
            _framed(ax)
        row[0].set_ylabel(name(label), fontsize=7, color=colour(label), weight="bold")
    entries = [Line2D([], [], color="black", lw=1.3, marker="o", ms=3, label="where the object went, to the end")]
    entries.append(Line2D([], [], color="#999999", lw=0.9, marker=".", ms=3, label="samples, in the model's colour"))
    legend(figure, entries)
    return figure


@styled
def contact_recall(
    found: Mapping[str, Mapping[str, Mapping[str, np.ndarray]]], stretches: Sequence[str], bars: Mapping[str, float]
) -> Figure:
    """How well contacts are foretold, by how far ahead they lie.

    found: title -> label -> {"recall", "precision", "chance"}: (k, g) shares over seeds and stretches of steps;
    stretches (g,): their names; bars: title -> the recall that was aimed at.
    """
    figure, grid = plt.subplots(1, len(found), figsize=(2.9 * len(found), 2.1), sharey=True, squeeze=False)
    look_of = looks(label for panel in found.values() for label in panel)
    places = np.arange(len(stretches))
    for ax, (title, panel) in zip(grid[0], found.items(), strict=True):
        if title in bars:
            ax.axhline(bars[title], color="#222222", lw=1, ls=(0, (4, 2)), zorder=1)
        for i, (label, shares) in enumerate(panel.items()):
            aside = 0.12 * (i - (len(panel) - 1) / 2)
            for word, options in (("recall", {"lw": 1.1}), ("precision", {"mfc": "white", "lw": 0})):
                values = shaped(f"{title}, {label}: {word}", shares[word], f"k {len(stretches)}").mean(0)
                ax.plot(places + aside, values, **{**look_of[label], "ms": 4.5, **options}, zorder=3, clip_on=False)
            ax.plot(places, np.mean(shares["chance"], axis=0), color="#AAAAAA", lw=0.8, ls=":", zorder=1)
        ax.set(title=title, xlabel="steps ahead", ylim=(0, 1), xlim=(-0.3, len(stretches) - 0.7))
        ax.set_xticks(places, stretches)
    grid[0, 0].set_ylabel("share")
    entries = handles(look_of, ms=4.5)
    entries.append(Line2D([], [], ls="", marker="o", color="#555555", ms=4.5, label="recall"))
    entries.append(Line2D([], [], ls="", marker="o", color="#555555", mfc="white", ms=4.5, label="precision"))
    entries.append(Line2D([], [], color="#AAAAAA", lw=0.8, ls=":", label="by chance"))
    entries.append(Line2D([], [], color="#222222", lw=1, ls=(0, (4, 2)), label="bar set beforehand"))
    legend(figure, entries, columns=3)
    return figure


@styled
def deflection_intervals(found: Mapping[str, tuple[np.ndarray, np.ndarray]], level: float = 0.8) -> Figure:
    """Where sampled objects go after a touch, against where the true one goes: one bar per touch, the narrowest first.

    found: label -> low (E,) and high (E,) end of the central interval of sampled directions, degrees off the true one.
    Dark where it holds the truth, which is the line at zero; beyond 90 degrees it is cut off.
    """
    figure, grid = plt.subplots(1, len(found), figsize=(WIDTH, 1.9), sharey=True, squeeze=False)
    for ax, (label, pair) in zip(grid[0], found.items(), strict=True):
        low, high = (finite(f"{label}: {word}", part, "E") for word, part in zip(("low", "high"), pair, strict=True))
        order = np.argsort(high - low, kind="stable")
        holds = (low <= 0) & (high >= 0)
        shades = [colour(label) if inside else tint(colour(label), 0.4) for inside in holds[order]]
        thick = float(np.clip(180 / len(low), 0.8, 3))
        for x, i in enumerate(order):
            ax.plot((x, x), np.clip((low[i], high[i] + 0.6), -90, 90), color=shades[x], lw=thick, solid_capstyle="butt")
        ax.axhline(0, color="black", lw=0.8, zorder=3)
        ax.set(title=name(label), xlabel="first touches, narrowest interval first", xlim=(-1, len(low)), ylim=(-90, 90))
        ax.set_yticks((-90, -45, 0, 45, 90))
        ax.annotate(f"{holds.mean():.0%} hold the truth, {level:.0%} should", (0.02, 0.97), xycoords="axes fraction",
                    va="top", fontsize=6.5, color="#555555")  # fmt: skip
    grid[0, 0].set_ylabel("degrees off the true direction")
    return figure


@styled
def walk(draw: Draw, start: np.ndarray, paths: np.ndarray, jumps: Mapping[int, float]) -> Figure:
    """What the object does under codes on a walk from one code (dark) to another (light).

    start (dx,): the last observed state; paths (n, T, 2): the object's ways; jumps: number of codes on the same walk ->
    the largest distance in m between the ends of two neighbours.
    """
    paths = finite("paths", paths, "n T 2")
    shades = WALK(np.linspace(0, 0.92, len(paths)))
    figure, (scene, ends, refined) = plt.subplots(1, 3, figsize=(WIDTH, 2.2))
    draw(scene, start)
    full = np.concatenate([np.broadcast_to(start[6:8], (len(paths), 1, 2)), paths], axis=1)
    scene.add_collection(LineCollection(list(full), colors=shades, linewidths=1, zorder=6))
    scene.scatter(*paths[:, -1].T, c=shades, s=7, linewidths=0, zorder=6.2)
    _framed(scene)
    quarter = np.linspace(0, 90, len(paths))
    for axis, (word, line) in enumerate((("x", "-"), ("y", (0, (3, 1.5))))):
        ends.plot(quarter, 100 * (paths[:, -1, axis] - start[6 + axis]), color="#555555", ls=line, lw=0.9, zorder=1,
                  label=word)  # fmt: skip
        ends.scatter(quarter, 100 * (paths[:, -1, axis] - start[6 + axis]), c=shades, s=9, linewidths=0, zorder=2)
    ends.set(xlabel="angle between the codes (degrees)", ylabel="way of the object at the end (cm)")
    ends.set_xticks((0, 30, 60, 90))
    ends.legend(loc="best")
    counts = sorted(jumps)
    refined.plot(counts, [100 * jumps[n] for n in counts], color="#222222", marker="o", ms=3.5)
    first = jumps[counts[0]]
    refined.plot(counts, [100 * first * (counts[0] - 1) / (n - 1) for n in counts], color="#AAAAAA", lw=0.8,
                 ls=(0, (3, 1.5)), label="half as far with twice as many", zorder=1)  # fmt: skip
    refined.set(xscale="log", xlabel="codes on the walk", ylabel="largest jump of the end (cm)")
    log_axis(refined, 50 * min(jumps.values()), 200 * max(jumps.values()))
    refined.set_xticks(counts, [str(n) for n in counts])
    refined.minorticks_off()
    refined.legend(loc="lower left")
    return figure


@styled
def embedding(
    points: Mapping[str, np.ndarray], directions: Mapping[str, np.ndarray], labels: Mapping[str, tuple[str, str]]
) -> Figure:
    """Codes in the plane, coloured by which way the object goes; grey where it stays.

    points: title -> (N, 2) coordinates; directions: title -> (N,) radians in the plane of the table, NaN for an object
    that does not move; labels: title -> names of the two axes.
    """
    wheel = mpl.colormaps["twilight_shifted"]
    figure, grid = plt.subplots(1, len(points), figsize=(min(WIDTH, 3 * len(points) + 0.6), 2.55), squeeze=False)
    for ax, (title, at) in zip(grid[0], points.items(), strict=True):
        at = finite(f"points['{title}']", at, "N 2")
        way = shaped(f"directions['{title}']", directions[title], str(len(at)))
        still = ~np.isfinite(way)
        ax.plot(*at[still].T, ".", color="#C4C4C4", ms=2.5, mew=0, zorder=1, rasterized=True)
        ax.scatter(*at[~still].T, c=way[~still], cmap=wheel, vmin=-np.pi, vmax=np.pi, s=9, linewidths=0.3,
                   edgecolors="#444444", zorder=2, rasterized=True)  # fmt: skip
        ax.set(title=title, xlabel=labels[title][0], ylabel=labels[title][1])
        ax.locator_params(nbins=5)
    scale = figure.colorbar(
        mpl.cm.ScalarMappable(mpl.colors.Normalize(-180, 180), wheel), ax=grid[0, -1], shrink=0.85, aspect=22,
        ticks=(-180, -90, 0, 90, 180), label="direction of the object (degrees)",
    )  # fmt: skip
    scale.outline.set_visible(False)
    legend(figure, [Line2D([], [], ls="", marker=".", color="#C4C4C4", ms=5, label="the object stays")])
    return figure


@styled
def code_grid(start: np.ndarray, paths: np.ndarray, true: np.ndarray, values: Sequence[float], label: str,
              names: tuple[str, str] = ("first direction of the code", "second")) -> Figure:  # fmt: skip
    """The object's way under codes on a grid: paths (n, n, T, 2), rows from the highest value of the second direction.

    start (dx,): the last observed state; true (T, 2): where it really went; values (n,): of each direction.
    """
    n = len(values)
    paths = finite("paths", paths, f"{n} {n} T 2")
    true = finite("true", true, f"{paths.shape[2]} 2")
    seen = np.concatenate([paths.reshape(-1, 2), true, start[None, 6:8]])
    middle, span = (seen.max(0) + seen.min(0)) / 2, float(np.ptp(seen, axis=0).max()) + 2.4 * RADIUS
    figure, grid = plt.subplots(n, n, figsize=(4.4, 4.4), squeeze=False, sharex=True, sharey=True, layout="compressed")
    for row, second in zip(range(n), reversed(range(n)), strict=True):
        for first in range(n):
            ax, way = grid[row, first], np.concatenate([start[None, 6:8], paths[first, second]])
            ax.add_patch(Circle(tuple(start[6:8]), RADIUS, fc="#EEEEEE", ec="#BBBBBB", lw=0.5))
            ax.plot(*np.concatenate([start[None, 6:8], true]).T, color="#BBBBBB", lw=0.8)
            ax.plot(*way.T, color=colour(label), lw=1.1)
            ax.plot(*way[-1], "o", color=colour(label), ms=2.5)
            ax.set(xlim=middle[0] + np.array((-0.5, 0.5)) * span, ylim=middle[1] + np.array((-0.5, 0.5)) * span,
                   aspect="equal", xticks=(), yticks=())  # fmt: skip
            ax.spines[:].set(visible=True, color="#DDDDDD")
            if row == n - 1:
                ax.set_xlabel(f"{values[first]:+.1f}".replace("-", "−"), fontsize=6.5)
        grid[row, 0].set_ylabel(f"{values[second]:+.1f}".replace("-", "−"), fontsize=6.5)
    figure.supxlabel(names[0], fontsize=7)
    figure.supylabel(names[1], fontsize=7)
    entries = [Line2D([], [], color=colour(label), marker="o", ms=2.5, label="the object under this code")]
    legend(figure, [*entries, Line2D([], [], color="#BBBBBB", lw=0.8, label="where it really went")])
    return figure


@styled
def one_code(draw: Draw, start: np.ndarray, path: np.ndarray, fan: np.ndarray, true: np.ndarray, label: str) -> Figure:
    """The object's way under one code, path (T, 2), over those under many, fan (S, T, 2), and the true one (T, 2)."""
    figure, ax = plt.subplots(figsize=(3.4, 3.4), layout="compressed")
    draw(ax, start)
    ax.add_collection(LineCollection(list(finite("fan", fan, "S T 2")), colors=colour(label), linewidths=0.6,
                                     alpha=0.18, zorder=6))  # fmt: skip
    ax.plot(*finite("true", true, "T 2").T, color="black", lw=1.2, zorder=7)
    ax.plot(*finite("path", path, "T 2").T, color=colour(label), lw=2.2, zorder=8)
    ax.plot(*path[-1], "o", color=colour(label), ms=5, mec="white", zorder=8)
    _framed(ax)
    return figure


def _framed(ax: Axes) -> None:
    """A square picture without numbers."""
    ax.set(aspect="equal", xticks=(), yticks=())
    ax.set_axis_on()
    ax.spines[:].set(visible=True, color="#CCCCCC")
