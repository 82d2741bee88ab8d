"""Figures of the latent space: the use of codes, sampled futures, and the meaning of a code (figure 9 of the paper).

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
from matplotlib.patches import Circle

from tsmlib.plots import style
from tsmlib.plots.axes import YOURS, entries, log_axis, looks, yours_entry
from tsmlib.plots.checks import Panels, finite, shaped
from tsmlib.plots.method import Method
from tsmlib.plots.style import WIDTH, Props, entry, legend, panels, styled, tint
from tsmlib.statistics import interval

Arrays = Mapping[str, np.ndarray]
Draw = Callable[[Axes, np.ndarray], object]  # paints one state (dx,) into axes, in metres
WALK = mpl.colormaps["viridis"]
BLOCK = slice(6, 8)  # of a state: where the object is
THRESHOLD: Props = {"color": "#222222", "lw": 1, "ls": (0, (4, 2))}


@styled
def code_use(
    values: Mapping[str, Panels],
    xlabels: Mapping[str, str],
    thresholds: Mapping[str, Mapping[str, float]],
    yours: Mapping[str, Panels] | None = None,
) -> Figure:
    """Information in the codes and spread of sampled futures: one row per environment and subset.

    values: title -> row -> method -> (k,), one value per seed, above zero; xlabels: title -> text; thresholds: title ->
    row -> a bound that was set beforehand, drawn as a tick; yours: as values, drawn below them as hollow diamonds.
    A model without values in a panel is named below it.
    """
    own = yours or {}
    rows = list(
        dict.fromkeys(row for part in (values, own) for panel in part.values() for row in panel)
    )
    look_of = looks(*values.values(), *own.values())
    figure, axes = panels(len(values), len(values), 0.24 * len(rows) + 0.85, head=0, sharey=True)
    for ax, (title, panel) in zip(axes, values.items(), strict=True):
        for y, row in enumerate(rows):
            ax.axhline(y, color=style.GRID, lw=0.6, zorder=0)
            for method, seeds in panel.get(row, {}).items():
                seeds = finite(f"{title}, {row}, {method.label}", seeds, "k")
                mean, half = interval(seeds)
                if half:
                    low = max(mean - half, seeds.min() / 2)
                    ax.plot(
                        (low, mean + half), (y, y), color=look_of[method]["color"], lw=1, zorder=2
                    )
                ax.plot(
                    mean, y, **{**look_of[method], "ls": "", "ms": 4.5}, zorder=3, clip_on=False
                )
            for method, seeds in own.get(title, {}).get(row, {}).items():
                seeds = finite(f"{title}, {row}, {method.label}, yours", seeds, "k")
                ax.plot(
                    seeds.mean(),
                    y + 0.25,
                    **YOURS,
                    color=method.look.colour,
                    zorder=3.5,
                    clip_on=False,
                )
            if bound := thresholds.get(title, {}).get(row):
                ax.plot((bound, bound), (y - 0.36, y + 0.36), color="#222222", lw=1.2, zorder=2.5)
        seen = {
            method
            for part in (panel, own.get(title, {}))
            for methods in part.values()
            for method in methods
        }
        none = ", ".join(method.label for method in look_of if method not in seen)
        label = xlabels[title] + (f"\nno values of {none}" if none else "")
        ax.margins(x=0.05)  # a threshold may be the least of all
        ax.set(xscale="log", xlabel=label, title=title)
        log_axis(ax, *ax.get_xlim(), along="x")
        style.rows_only(ax)
    axes[0].set_yticks(range(len(rows)), rows)
    axes[0].set_ylim(len(rows) - 0.5, -0.5)
    handles = [*entries(look_of, ls="", ms=4.5), *yours_entry(*own.values())]
    if any(
        len(seeds) > 1
        for panel in values.values()
        for row in panel.values()
        for seeds in row.values()
    ):
        handles.append(entry("95 % interval over seeds", color=style.DARK, lw=1))
    if any(thresholds.values()):
        handles.append(
            entry("threshold set beforehand", color="#222222", ls="", marker="|", ms=7, mew=1.2)
        )
    legend(figure, handles)
    return figure


@styled
def around_touch(curves: Mapping[Method, Sequence[np.ndarray]], touch: int) -> Figure:
    """Spread and error before and after the first touch: method -> spread (T,) and error (T,), column ``touch`` the
    first state that touches. Solid: deviation of the samples; dashed: error of their mean."""
    figure, ax = plt.subplots(figsize=(3.6, 2.2))
    kinds: dict[str, Props] = {"spread": {"marker": ".", "ms": 3}, "error": {"ls": style.DASHED}}
    for method, pair in curves.items():
        steps = np.arange(len(pair[0])) - touch
        for (word, look), values in zip(kinds.items(), pair, strict=True):
            values = shaped(f"{method.label}: {word}", values, str(len(steps)))
            ax.plot(steps, values, color=method.look.colour, **look)
    ax.axvline(0, color="#999999", lw=0.7, zorder=0)
    ax.annotate(
        "first touch",
        (0, 1),
        (2, -1),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        fontsize=6.5,
        va="top",
        color=style.NOTE,
    )
    ax.set(xlabel="steps since the first touch", ylabel="data's s.d.", ylim=(0, None))
    handles = [entry(method.label, color=method.look.colour) for method in curves]
    handles.append(entry("spread of samples", color=style.NOTE, **kinds["spread"]))
    legend(
        figure,
        [*handles, entry("error of their mean", color=style.NOTE, **kinds["error"])],
        columns=2,
    )
    return figure


@styled
def spread_against_error(
    curves: Mapping[str, Mapping[Method, tuple[np.ndarray, np.ndarray]]],
) -> Figure:
    """Error against spread: title -> method -> spread (g,) and error (g,) of segments, grouped by spread.

    On the diagonal the mean of the samples is as far from the truth as the samples are from it."""
    width = min(WIDTH, 2.2 * len(curves) + 0.3)
    figure, axes = panels(len(curves), len(curves), 2.5, width=width, head=0, layout="compressed")
    look_of = looks(curves)
    for ax, (title, panel) in zip(axes, curves.items(), strict=True):
        every = np.concatenate([part for pair in panel.values() for part in pair])
        every = every[every > 0]
        limits = (every.min() / 1.3, every.max() * 1.3)
        ax.plot(limits, limits, color="#999999", lw=0.7, zorder=1)
        for method, pair in panel.items():
            spread, error = (
                finite(f"{title}, {method.label}", part, str(len(pair[0]))) for part in pair
            )
            ax.plot(spread, error, **{**look_of[method], "ms": 3.5})
        ax.set(
            xscale="log",
            yscale="log",
            xlim=limits,
            ylim=limits,
            aspect="equal",
            title=title,
            xlabel="spread of samples (data's s.d.)",
        )
    axes[0].set_ylabel("error of their mean (data's s.d.)")
    legend(
        figure, [*entries(look_of, ms=3.5), entry("as far off as spread", color="#999999", lw=0.7)]
    )
    return figure


@styled
def figure9(
    draw: Draw, starts: np.ndarray, true: np.ndarray, samples: Mapping[Method, np.ndarray]
) -> Figure:
    """Sampled paths of the object after a push (paper, figure 9): one column per episode, one row per method.

    draw paints the scene; starts (E, dx): the last observed states; true (E, T, 2): where the object went, in m;
    samples: method -> (S, E, T, 2), under the true actions.
    """
    true = finite("true", true, "E T 2")
    count, steps, _ = true.shape
    size = (WIDTH, (WIDTH / count) * len(samples) + 0.42)
    figure, grid = plt.subplots(
        len(samples), count, figsize=size, squeeze=False, layout="compressed"
    )
    for row, (method, ways) in zip(grid, samples.items(), strict=True):
        ways, main = (
            finite(f"samples of {method.label}", ways, f"S {count} {steps} 2"),
            method.look.colour,
        )
        for ax, start, truth, fan in zip(
            row, starts, true, ways.transpose(1, 0, 2, 3), strict=True
        ):
            draw(ax, start)
            fan = _from(start, fan)
            faint = float(np.clip(6 / len(fan), 0.2, 0.7))
            ax.add_collection(
                LineCollection(list(fan), colors=main, linewidths=0.7, alpha=faint, zorder=6)
            )
            ax.plot(*fan[:, -1].T, ".", color=main, ms=3, mew=0, zorder=6.2)
            ax.plot(*_from(start, truth).T, color="black", lw=1.3, zorder=7)
            ax.plot(*truth[-1], "o", color="black", ms=3, zorder=7)
            style.scene(ax)
        row[0].set_ylabel(method.label, fontsize=7, color=main, weight="bold")
    legend(
        figure,
        [
            entry("true path of the object", color="black", lw=1.3, marker="o", ms=3),
            entry("samples, in the model's colour", color="#999999", lw=0.9, marker=".", ms=3),
        ],
    )
    return figure


def _from(start: np.ndarray, paths: np.ndarray) -> np.ndarray:
    """Paths (..., T, 2) of the object with its place in the state ``start`` before them."""
    return np.concatenate(
        [np.broadcast_to(start[BLOCK], (*paths.shape[:-2], 1, 2)), paths], axis=-2
    )


@styled
def contact_recall(
    found: Mapping[str, Mapping[Method, Arrays]],
    stretches: Sequence[str],
    thresholds: Mapping[str, float],
    yours: Mapping[str, Mapping[Method, Arrays]] | None = None,
) -> Figure:
    """Recall and precision of predicted contacts, by steps ahead.

    found: title -> method -> {"recall", "precision", "chance"}: (k, g) shares over seeds and stretches of steps;
    stretches (g,): their names; thresholds: title -> the recall that was aimed at; yours: as found, drawn beside it as
    hollow diamonds, small ones of precision.
    """
    figure, axes = panels(len(found), len(found), 2.1, width=2.9 * len(found), head=0, sharey=True)
    own = yours or {}
    look_of, places = looks(found, own), np.arange(len(stretches))
    chance: Props = {"color": "#AAAAAA", "lw": 0.8, "ls": ":"}

    def means(title: str, method: Method, shares: Arrays) -> dict[str, np.ndarray]:
        return {
            word: shaped(f"{title}, {method.label}: {word}", values, f"k {len(stretches)}").mean(0)
            for word, values in shares.items()
        }

    for ax, (title, panel) in zip(axes, found.items(), strict=True):
        if title in thresholds:
            ax.axhline(thresholds[title], **THRESHOLD, zorder=1)
        shift = {method: 0.12 * (i - (len(look_of) - 1) / 2) for i, method in enumerate(look_of)}
        for method, shares in panel.items():
            mean, at, look = (
                means(title, method, shares),
                places + shift[method],
                {**look_of[method], "ms": 4.5},
            )
            ax.plot(at, mean["recall"], **{**look, "lw": 1.1}, zorder=3, clip_on=False)
            ax.plot(
                at, mean["precision"], **{**look, "mfc": "white", "lw": 0}, zorder=3, clip_on=False
            )
            ax.plot(places, mean["chance"], **chance, zorder=1)
        for method, shares in own.get(title, {}).items():
            mean = means(title, method, shares)
            for word, size in (("recall", 3.4), ("precision", 2.2)):
                look = {**YOURS, "ms": size, "color": method.look.colour}
                ax.plot(places + shift[method] + 0.05, mean[word], **look, zorder=4, clip_on=False)
            if method not in panel:
                ax.plot(places, mean["chance"], **chance, zorder=1)
        ax.set(title=title, xlabel="steps ahead", ylim=(0, 1), xlim=(-0.3, len(stretches) - 0.7))
        ax.set_xticks(places, stretches)
    axes[0].set_ylabel("share")
    point: Props = {"ls": "", "marker": "o", "color": style.NOTE, "ms": 4.5}
    handles = [
        *entries(look_of, ms=4.5),
        entry("recall", **point),
        entry("precision", **point, mfc="white"),
    ]
    handles += [entry("by chance", **chance), entry("threshold set beforehand", **THRESHOLD)]
    if any(own.values()):
        handles += [
            *yours_entry(own),
            entry("yours, precision", **{**YOURS, "ms": 2.2}, color=style.DARK),
        ]
    legend(figure, handles, columns=3)
    return figure


@styled
def deflection_intervals(
    found: Mapping[Method, tuple[np.ndarray, np.ndarray]], level: float = 0.8
) -> Figure:
    """Central intervals of the object's sampled direction after a touch: one bar per touch, the narrowest first.

    found: method -> low (E,) and high (E,) end of the interval, degrees off the true direction. Dark where it holds
    the truth, which is the line at zero; beyond 90 degrees it is cut off.
    """
    figure, axes = panels(len(found), len(found), 1.9, head=0, sharey=True)
    for ax, (method, pair) in zip(axes, found.items(), strict=True):
        low, high = (
            finite(f"{method.label}: {w}", part, "E")
            for w, part in zip(("low", "high"), pair, strict=True)
        )
        order = np.argsort(high - low, kind="stable")
        holds = (low <= 0) & (high >= 0)
        shades = [
            method.look.colour if inside else tint(method.look.colour, 0.4)
            for inside in holds[order]
        ]
        thick = float(np.clip(180 / len(low), 0.8, 3))
        for x, i in enumerate(order):
            ax.plot(
                (x, x),
                np.clip((low[i], high[i] + 0.6), -90, 90),
                color=shades[x],
                lw=thick,
                solid_capstyle="butt",
            )
        ax.axhline(0, color="black", lw=0.8, zorder=3)
        ax.set(
            title=method.label,
            xlabel="first touches, narrowest interval first",
            xlim=(-1, len(low)),
            ylim=(-90, 90),
            yticks=(-90, -45, 0, 45, 90),
        )
        style.note(ax, f"{holds.mean():.0%} hold the truth, {level:.0%} should", 0.02, 0.97)
    axes[0].set_ylabel("degrees off the true direction")
    return figure


@styled
def walk(draw: Draw, start: np.ndarray, paths: np.ndarray, jumps: Mapping[int, float]) -> Figure:
    """The object's paths under codes on a walk from one code (dark) to another (light), cos(a) first + sin(a) last.

    start (dx,): the last observed state; paths (n, T, 2): the object's paths; jumps: number of codes on the same walk
    -> the largest distance in m between the ends of two neighbours. The middle panel shows the ends of the paths from
    that of the first code's, since all of them together may differ little.
    """
    paths = finite("paths", paths, "n T 2")
    shades = WALK(np.linspace(0, 0.92, len(paths)))
    figure, (picture, ends, refined) = panels(3, 3, 2.2, head=0)
    draw(picture, start)
    picture.add_collection(
        LineCollection(list(_from(start, paths)), colors=shades, linewidths=1, zorder=6)
    )
    picture.scatter(paths[:, -1, 0], paths[:, -1, 1], c=shades, s=7, linewidths=0, zorder=6.2)
    style.scene(picture)
    picture.set_title("paths of the object")
    picture.set_xlabel("dark: first code, light: last", fontsize=6.5, color=style.NOTE)
    angle, moved = np.linspace(0, 90, len(paths)), 100 * (paths[:, -1] - paths[0, -1])
    for values, word, line in zip(moved.T, "xy", ("-", style.DASHED), strict=True):
        ends.plot(angle, values, color=style.NOTE, ls=line, lw=0.9, zorder=1, label=word)
        ends.scatter(angle, values, c=shades, s=9, linewidths=0, zorder=2)
    ends.set(
        xlabel="angle from first to last code (degrees)",
        ylabel="distance (cm)",
        xticks=(0, 30, 60, 90),
        title="end of a path, minus the first's",
    )
    ends.legend(loc="best")
    counts = sorted(jumps)
    refined.plot(counts, [100 * jumps[n] for n in counts], color="#222222", marker="o", ms=3.5)
    halved = [100 * jumps[counts[0]] * (counts[0] - 1) / (n - 1) for n in counts]
    refined.plot(
        counts,
        halved,
        color="#AAAAAA",
        lw=0.8,
        ls=style.DASHED,
        label="half of it at twice the codes",
        zorder=1,
    )
    refined.set(
        xscale="log",
        xlabel="codes on the walk",
        ylabel="distance (cm)",
        title="largest distance of neighbours",
    )
    log_axis(refined, 50 * min(jumps.values()), 200 * max(jumps.values()))
    refined.set_xticks(counts, [str(n) for n in counts])
    refined.minorticks_off()
    refined.legend(loc="lower left")
    return figure


@styled
def embedding(codes: Mapping[str, tuple[np.ndarray, np.ndarray, tuple[str, str]]]) -> Figure:
    """Codes in the plane, coloured by the way the object goes; grey where it hardly does. A compass shows the colours.

    codes: title -> coordinates (N, 2); where the object goes (N, 2), in m, grey within a centimetre; names of the two
    axes.
    """
    wheel = mpl.colormaps["twilight_shifted"]
    figure, axes = panels(
        len(codes), len(codes), 2.9, width=min(WIDTH, 2.9 * len(codes) + 1.2), head=0.1
    )
    for ax, (title, (at, moved, labels)) in zip(axes, codes.items(), strict=True):
        at, moved = (
            finite(f"points of {title}", at, "N 2"),
            finite(f"ways of {title}", moved, f"{len(at)} 2"),
        )
        way, still = np.arctan2(moved[:, 1], moved[:, 0]), np.linalg.norm(moved, axis=1) <= 0.01
        ax.plot(*at[still].T, ".", color="#C4C4C4", ms=2.5, mew=0, zorder=1, rasterized=True)
        x, y = at[~still].T
        ax.scatter(
            x,
            y,
            c=way[~still],
            cmap=wheel,
            vmin=-np.pi,
            vmax=np.pi,
            s=11,
            linewidths=0.3,
            edgecolors="#444444",
            zorder=2,
            rasterized=True,
        )
        ax.set(title=title, xlabel=labels[0], ylabel=labels[1], box_aspect=1)
        ax.locator_params(nbins=5)
    _compass(figure, axes[-1], wheel)
    return figure


def _compass(figure: Figure, beside: Axes, wheel: mpl.colors.Colormap) -> None:
    """A ring of the colours to the right of a panel: each stands where its direction points."""
    room = figure.colorbar(
        mpl.cm.ScalarMappable(cmap=wheel), ax=beside, fraction=0.3, pad=0.04, aspect=1.2
    ).ax
    room.set_axis_off()
    room.clear()
    angle = np.linspace(-np.pi, np.pi, 181)
    ring = room.inset_axes((0, 0.3, 1, 0.5), projection="polar")
    ring.pcolormesh(
        angle, (0.62, 1), angle[None, :-1], cmap=wheel, vmin=-np.pi, vmax=np.pi, rasterized=True
    )
    ring.set(xticks=(), yticks=(), ylim=(0, 1))
    ring.spines[:].set_visible(False)
    ring.grid(visible=False)
    ring.plot(0, 0, ".", color="#C4C4C4", ms=5)
    for x, word in enumerate(("the object goes\nthis way", "grey: by less\nthan 1 cm")):
        room.annotate(
            word,
            (0.5, (0.82, 0.28)[x]),
            xycoords="axes fraction",
            ha="center",
            fontsize=6.5,
            va=("bottom", "top")[x],
            color=style.NOTE,
        )
    room.set_axis_off()


@styled
def code_grid(
    start: np.ndarray,
    paths: np.ndarray,
    true: np.ndarray,
    values: Sequence[float],
    method: Method,
    *,
    radius: float,
) -> Figure:
    """The object's way under codes on a grid: paths (n, n, T, 2), by the first and the second direction of the code.

    start (dx,): the last observed state; true (T, 2): the object's true way; values (n,): of each direction, the
    second's from below; radius: the object's, in m.
    """
    n, main = len(values), method.look.colour
    paths = _from(start, finite("paths", paths, f"{n} {n} T 2"))
    true = _from(start, finite("true", true, f"{paths.shape[2] - 1} 2"))
    seen = np.concatenate([paths.reshape(-1, 2), true])
    middle, span = (seen.max(0) + seen.min(0)) / 2, float(np.ptp(seen, axis=0).max()) + 2.4 * radius
    half = np.array((-0.5, 0.5)) * span
    figure, grid = plt.subplots(
        n, n, figsize=(4.4, 4.4), squeeze=False, sharex=True, sharey=True, layout="compressed"
    )
    for (row, first), ax in np.ndenumerate(grid):
        way = paths[first, n - 1 - row]
        ax.add_patch(Circle(tuple(way[0]), radius, fc=style.GRID, ec="#BBBBBB", lw=0.5))
        ax.plot(*true.T, color="#BBBBBB", lw=0.8)
        ax.plot(*way.T, color=main, lw=1.1)
        ax.plot(*way[-1], "o", color=main, ms=2.5)
        style.scene(ax)
        ax.set(xlim=middle[0] + half, ylim=middle[1] + half)
    for i, value in enumerate(values):
        grid[-1, i].set_xlabel(f"{value:+.1f}".replace("-", "−"), fontsize=6.5)
        grid[n - 1 - i, 0].set_ylabel(f"{value:+.1f}".replace("-", "−"), fontsize=6.5)
    middle_label = grid[
        -1, n // 2
    ].get_xlabel()  # not a label of the figure, which would stand where its stamp does
    grid[-1, n // 2].set_xlabel(f"{middle_label}\nfirst direction of the code", fontsize=6.5)
    figure.supylabel("second", fontsize=7)
    legend(
        figure,
        [
            entry("the object under this code", color=main, marker="o", ms=2.5),
            entry("its true way", color="#BBBBBB", lw=0.8),
        ],
    )
    return figure


def code_fan(
    draw: Draw, start: np.ndarray, every: np.ndarray, true: np.ndarray, method: Method
) -> Callable[[np.ndarray], Figure]:
    """A picture of the object's ways under some codes, over those under all: ways (S, T, 2) -> the figure.

    It is one figure in which the ways are replaced, so that it follows a slider; these, and what lies over them, are
    its animated artists. draw paints the scene;
    start (dx,): the last observed state; every (n, T, 2): the ways under all codes; true (T, 2): what happened.
    """
    figure = _code_scene(draw, start, every, true, method)
    (ax,) = figure.axes
    lines, ends = ax.collections[-1], ax.lines[-1]

    def drawn(ways: np.ndarray) -> Figure:
        ways = _from(start, finite("ways", ways, f"S {every.shape[1]} 2"))
        lines.set(segments=list(ways), alpha=float(np.clip(12 / len(ways), 0.25, 0.8)))
        ends.set_data(*ways[:, -1].T)
        return figure

    return drawn


@styled
def _code_scene(
    draw: Draw, start: np.ndarray, every: np.ndarray, true: np.ndarray, method: Method
) -> Figure:
    """What stays, and room for what moves: the last collection, and the last line for its ends."""
    every, true = (
        _from(start, finite("every", every, "n T 2")),
        _from(start, finite("true", true, "T 2")),
    )
    main, grey = method.look.colour, "#9A9A9A"
    figure = plt.figure(figsize=(4.6, 4.85), dpi=100, layout="none")
    ax = figure.add_axes((0.01, 0.01, 0.98, 0.98 * 4.6 / 4.85))
    draw(ax, start)
    ax.add_collection(
        LineCollection(list(every), colors=grey, linewidths=0.6, alpha=0.35, zorder=6)
    )
    ax.plot(*true.T, color="black", lw=1.4, zorder=8, animated=True)
    ax.plot(*true[-1], "o", color="black", ms=4, zorder=8, animated=True)
    ax.add_collection(LineCollection([], colors=main, linewidths=1, zorder=7, animated=True))
    ax.plot([], [], ".", color=main, ms=5, mew=0, zorder=7.5, animated=True)
    style.scene(ax)
    seen = np.concatenate([every.reshape(-1, 2), true])
    middle, span = (
        (seen.max(0) + seen.min(0)) / 2,
        min(0.55, 1.1 * float(np.ptp(seen, axis=0).max()) + 0.08),
    )
    ax.set(
        xlim=middle[0] + np.array((-0.5, 0.5)) * span, ylim=middle[1] + np.array((-0.5, 0.5)) * span
    )
    figure.legend(
        handles=[
            entry("all codes", color=grey, lw=0.8),
            entry("codes at the sliders", color=main, lw=1.2),
            entry("what happened", color="black", marker="o", ms=4),
        ],
        loc="upper left",
        ncols=3,
        fontsize=8,
    )
    return figure
