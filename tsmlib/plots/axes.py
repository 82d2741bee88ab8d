"""Axes, lines and marks of figures of methods; a diverged model does not squeeze the others.

Nothing is cut off in silence: an axis ends before what lies far from the rest, an arrow points to it, and its value
stands in words below the panel.
"""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from tsmlib.plots.method import Method
from tsmlib.plots.style import DASHED, Props, entry, legend, tint
from tsmlib.statistics import interval

REFERENCES = {
    "oracle": "-",
    "zero": "--",
    "random": ":",
}  # models drawn as lines: none of them could gain or lose
YOURS: Props = {"marker": "D", "ms": 3.4, "mfc": "white", "mew": 0.9, "ls": ""}  # the reader's own
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def looks(*panels: Mapping[str, Collection[Method]]) -> dict[Method, Props]:
    """How the line of each method in some panels is drawn, in the order in which they come.

    A second method of the same model is open and dashed.
    """
    found: dict[Method, Props] = {}
    for method in (method for given in panels for methods in given.values() for method in methods):
        again, main = sum(other.model == method.model for other in found), method.look.colour
        if method not in found:
            found[method] = {
                "color": main,
                "mfc": "white" if again % 2 else main,
                "marker": method.look.marker,
                "ls": ("-", DASHED, (0, (1, 1)))[again % 3],
                "ms": 3,
                "mew": 0.7,
            }
    if not found:
        raise ValueError("no panel holds a method: nothing to draw")
    return found


def entries(look_of: Mapping[Method, Props], **more: Any) -> list[Line2D]:
    """The lines of a legend."""
    return [entry(method.label, **{**look, **more}) for method, look in look_of.items()]


def references(values: Mapping[Method, float]) -> dict[Method, float]:
    """The references among some methods; of several of one model that in the latent search space, which tables divide
    by, else the best."""
    ordered = sorted(values, key=lambda method: (method.search_space == "latent", values[method]))
    best = {method.model: method for method in ordered}
    return {best[model]: values[best[model]] for model in REFERENCES if model in best}


def reference_look(method: Method) -> Props:
    """How the line of a reference is drawn."""
    return {"color": method.look.colour, "ls": REFERENCES[method.model], "lw": 1}


def spell(value: float) -> str:
    """A number as it is printed: three digits, and a power of ten where it is far from one."""
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        text = f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
    else:
        digits, power = f"{value:.1e}".split("e")
        text = f"{digits}×10{str(int(power)).translate(SUPERSCRIPT)}".replace("1.0×", "")
    return text.replace("-", "−")


STATES = {
    "joint0": "shoulder",
    "joint1": "elbow",
    "tip": "fingertip",
    "block": "object",
    "vel": "velocity",
    "vx": "velocity x",
    "vy": "velocity y",
}


def dimension(word: str) -> str:
    """A state dimension in words: ``joint0_vel`` -> ``shoulder velocity``."""
    return " ".join(STATES.get(part, part) for part in word.split("_"))


def limits(
    points: np.ndarray, bars: np.ndarray, also: Sequence[float] = (), log: bool = False
) -> tuple[float, float]:
    """The range to draw: ``points`` but for those far from their median, ``bars`` near these, and ``also``.

    Far is beyond ten times the median distance, and in any case beyond thrice the median (on a logarithmic axis four
    decades).
    """
    place = np.log10 if log else np.asarray
    at, bars = place(points), place(bars[bars > 0] if log else bars)
    away = np.abs(at - np.median(at))
    seen = at[away <= max(10 * np.median(away), 4 if log else 3 * abs(np.median(at)))]
    room = (0.3 if log else 1) * np.ptp(seen) or 0.1 * abs(seen[0])
    bars = bars[(bars >= seen.min() - room) & (bars <= seen.max() + room)]
    seen = np.concatenate([seen, bars, place(np.array(also, float))])
    pad = 0.05 * np.ptp(seen) or max(0.05 * abs(seen[0]), 1e-3)
    low, high = float(seen.min() - pad), float(seen.max() + pad)
    return (10.0**low, 10.0**high) if log else (low, high)


def log_axis(ax: Axes, low: float, high: float, along: str = "y") -> None:
    """A logarithmic axis, by default y, with numbers in words, and enough of them however little it spans."""
    ax.set(**{f"{along}scale": "log"})
    axis = {"x": ax.xaxis, "y": ax.yaxis}[along]
    subs = (1.0, 2.0, 5.0) if high < 100 * low else (1.0,)
    axis.set_major_locator(MaxNLocator(4) if high < 4 * low else LogLocator(subs=subs, numticks=9))
    axis.set_major_formatter(FuncFormatter(lambda value, _: spell(value)))
    axis.set_minor_locator(NullLocator())


def arrow(ax: Axes, along: str, at: float, side: int, main: str) -> None:
    """An arrow out of the axis ``along``, at its lower end (side -1) or its upper (1)."""
    edge = (ax.get_xlim() if along == "x" else ax.get_ylim())[max(side, 0)]
    marker = {"x": "<>", "y": "v^"}[along][max(side, 0)]
    ax.plot(
        *((edge, at) if along == "x" else (at, edge)),
        marker,
        color=main,
        ms=3.5,
        mew=0,
        clip_on=False,
        zorder=6,
    )


def band(lines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and half the 95 % interval, (T,) each, of lines (k, T)."""
    mean, half = np.array([interval(values) for values in lines.T]).T
    return mean, half


def interval_ends(
    lines: np.ndarray, log: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean and ends of the 95 % interval, (T,) each, of lines (k, T); log: those of the logarithm."""
    mean, half = band(np.log(lines) if log else lines)
    found = mean, mean - half, mean + half
    return (np.exp(found[0]), np.exp(found[1]), np.exp(found[2])) if log else found


def curve(
    ax: Axes,
    at: np.ndarray,
    mean: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    look: Props,
    shift: float = 0,
    marks: Sequence[int] = (),
) -> None:
    """A line, or a single point above all lines, and its band from ``low`` to ``high``; shift: a share of the way from
    one marker to the next, so that those of lines part; marks: the places in ``at`` that markers stand at instead."""
    every = max(1, len(at) // 5)
    ax.plot(
        at,
        mean,
        **look,
        zorder=3 if len(at) > 1 else 4,
        markevery=list(marks) or (int(shift * every), every),
    )
    if (low < high).any():
        ax.fill_between(at, low, high, color=look["color"], alpha=0.11, lw=0, zorder=2)


def bars(ax: Axes, at: np.ndarray, mean: np.ndarray, half: np.ndarray, main: str) -> None:
    """Intervals as thin bars at ``at``; where one leaves its panel, an arrow."""
    low, high = ax.get_ylim()
    ends = np.clip(mean - half, low, high), np.clip(mean + half, low, high)
    ax.vlines(at, *ends, color=main, lw=0.8, zorder=2)
    for side, gone in ((-1, mean - half < low), (1, mean + half > high)):
        for x in at[gone]:
            arrow(ax, "y", x, side, main)


def outside(ax: Axes, at: np.ndarray, mean: np.ndarray, method: Method) -> list[str]:
    """Arrows where a line leaves its panel, and its furthest values in words."""
    low, high = ax.get_ylim()
    notes = []
    for side, gone in ((-1, mean < low), (1, mean > high)):
        if gone.any():
            arrow(ax, "y", at[gone.argmax()], side, method.look.colour)
            notes.append(f"{method.label} to {spell(side * (side * mean).max())}")
    return notes


def mark(
    ax: Axes, along: str, at: float, seeds: np.ndarray, look: Props, aside: float
) -> list[str]:
    """Mean and 95 % interval at ``at``, every seed as a dot ``aside`` of it; in words if some of it lies outside."""
    mean, half = interval(seeds)
    low, high = ax.get_xlim() if along == "x" else ax.get_ylim()

    def plot(
        values: Sequence[float] | np.ndarray, at: float, marker: str = "", **more: Any
    ) -> None:
        across = np.full(len(values), at)
        ax.plot(*((values, across) if along == "x" else (across, values)), marker, **more)

    if half:
        plot(
            [mean - half, mean + half],
            at,
            "-",
            color=look["color"],
            lw=1.1,
            zorder=2,
            solid_capstyle="butt",
        )
        plot(seeds, at + aside, "o", color=tint(look["color"], 0.7), ms=1.6, mew=0, zorder=3)
    plot([mean], at, **{**look, "ls": "", "ms": 4.2}, zorder=3.5)
    out = {-1: min(seeds.min(), mean - half) < low, 1: max(seeds.max(), mean + half) > high}
    for side in (side for side, beyond in out.items() if beyond):
        arrow(ax, along, at, side, look["color"])
    return [spell(mean) + (f" ± {spell(half)}" if half else "")] if any(out.values()) else []


def diamonds(ax: Axes, along: str, at: np.ndarray, values: np.ndarray, method: Method) -> list[str]:
    """The reader's own ``values`` of a method, hollow diamonds at ``at``; in words those outside the axis ``along``."""
    low, high = ax.get_xlim() if along == "x" else ax.get_ylim()
    seen = (values >= low) & (values <= high)
    places = (values[seen], at[seen]) if along == "x" else (at[seen], values[seen])
    if seen.any():
        ax.plot(*places, **YOURS, color=method.look.colour, zorder=5, clip_on=False)
    notes = []
    for side, gone in ((-1, values < low), (1, values > high)):
        if gone.any():
            arrow(ax, along, at[gone.argmax()], side, method.look.colour)
            notes.append(
                f"{method.label}, yours {'' if len(values) == 1 else 'to '}"
                f"{spell(side * (side * values).max())}"
            )
    return notes


def yours_entry(*given: Mapping[Any, Any] | None) -> list[Line2D]:
    """The line of a legend for the reader's own, where there are any."""
    return [entry("yours", color="#4A4A4A", **YOURS)] if any(given) else []


def wrapped(text: str, inches: float) -> str:
    """``text`` over as many lines as a width asks for."""
    return textwrap.fill(text, max(8, int(inches / 0.068)), break_on_hyphens=False)


def foot(ax: Axes, label: str, notes: Sequence[str], inches: float) -> None:
    """Name the x axis, and below it say what lies outside a panel of this width, one note a line."""
    lines = [label] if label else []
    for i, note in enumerate(notes):
        lines += textwrap.wrap(
            ("" if i else "outside: ") + note, int(inches / 0.056), break_on_hyphens=False
        )
    ax.set_xlabel("\n".join(lines))


def finish(
    figure: Figure, grid: Iterable[Iterable[Axes]], handles: Sequence[Line2D] = (), columns: int = 1
) -> Figure:
    """The figure with its legend, and as much higher as the legend and the words below its panels take."""
    lines = sum(max(ax.get_xlabel().count("\n") for ax in row) for row in grid)
    rows = legend(figure, handles, columns=columns) if handles else 0
    figure.set_figheight(
        figure.get_figheight() + 0.115 * lines + (0.14 * rows + 0.1 if handles else 0)
    )
    return figure


def ends(rows: Iterable[np.ndarray]) -> np.ndarray:
    """Both ends of the 95 % interval of each row of seeds."""
    return np.array([mean + sign * half for mean, half in map(interval, rows) for sign in (-1, 1)])
