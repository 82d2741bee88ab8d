"""What the figures of predictions share: the look of a model, axes that a diverged model does not squeeze, and marks.

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
from numpy.typing import ArrayLike

from tsmlib.figures.style import COLOURS, colour, legend, name, shaped, tint, words
from tsmlib.statistics import interval

Values = Mapping[str, Mapping[str, np.ndarray]]  # panel or environment -> label -> array

MARKERS = {"tsm": "o", "tsm+energy": "D", "tsm+energy+direct": "*", "tsm+teacher": "p", "onestep": "s",
           "multistep": "^", "lstm": "v", "ensemble": "P", "ensemble+mse": "X"}  # fmt: skip
DASHES: tuple[Any, ...] = ("-", (0, (4, 1.5)), (0, (1, 1)))
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def looks(labels: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Label -> how its line is drawn, in the order of COLOURS; a second label of a model is open and dashed."""
    order, drawn = list(COLOURS), dict.fromkeys(COLOURS, 0)
    found: dict[str, dict[str, Any]] = {}
    for label in sorted(dict.fromkeys(labels), key=lambda label: order.index(words(label)[0])):
        model, main = words(label)[0], colour(label)
        again = drawn[model]
        found[label] = {"color": main, "mfc": "white" if again % 2 else main, "marker": MARKERS.get(model, "o"),
                        "ls": DASHES[again % 3], "ms": 3, "mew": 0.7}  # fmt: skip
        drawn[model] += 1
    if not found:
        raise ValueError("no panel holds a model: nothing to draw")
    return found


def finite(field: str, values: ArrayLike, shape: str) -> np.ndarray:
    """``shaped``, and every value is a number."""
    array = shaped(field, values, shape)
    if bad := int(np.sum(~np.isfinite(array))):
        raise ValueError(
            f"{field}: {bad} of {array.size} values are not finite; a mean over them means nothing. "
            "Count such rollouts as worst before they are drawn"
        )
    return array


def spell(value: float) -> str:
    """A number as it is printed: three digits, and a power of ten where it is far from one."""
    if value == 0 or 1e-2 <= abs(value) < 1e4:
        text = f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
    else:
        digits, power = f"{value:.1e}".split("e")
        text = f"{digits}×10{str(int(power)).translate(SUPERSCRIPT)}".replace("1.0×", "")
    return text.replace("-", "−")


def checked_panels(values: Values, shape: str) -> dict[str, dict[str, np.ndarray]]:
    """Checked panels: title -> label -> array of ``shape``."""
    return {title: {label: finite(f"{title}, {label}", array, shape) for label, array in rows.items()}
            for title, rows in values.items()}  # fmt: skip


def per_panel(word: str, given: str | Mapping[str, str], titles: Collection[str]) -> Mapping[str, str]:
    """One text per panel, from one for all or a mapping."""
    texts = dict.fromkeys(titles, given) if isinstance(given, str) else given
    if missing := [title for title in titles if title not in texts]:
        raise ValueError(f"{word} names {', '.join(texts)}; panel '{missing[0]}' is missing")
    return texts


def known(word: str, given: Iterable[str], titles: Collection[str]) -> None:
    """Raise unless ``given`` names panels that are there."""
    if unknown := [title for title in given if title not in titles]:
        raise ValueError(f"{word} names a panel '{unknown[0]}'; there are {', '.join(titles)}")


def limits(points: np.ndarray, bars: np.ndarray, also: Sequence[float] = (), log: bool = False) -> tuple[float, float]:
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


def log_axis(ax: Axes, low: float, high: float) -> None:
    """A logarithmic y axis with numbers in words, and enough of them however little it spans."""
    ax.set_yscale("log")
    subs = (1.0, 2.0, 5.0) if high < 100 * low else (1.0,)
    ax.yaxis.set_major_locator(MaxNLocator(4) if high < 4 * low else LogLocator(subs=subs, numticks=9))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: spell(value)))
    ax.yaxis.set_minor_locator(NullLocator())


def arrow(ax: Axes, along: str, at: float, side: int, main: str) -> None:
    """An arrow out of the axis ``along``, at its lower end (side -1) or its upper (1)."""
    edge = (ax.get_xlim() if along == "x" else ax.get_ylim())[max(side, 0)]
    marker = {"x": "<>", "y": "v^"}[along][max(side, 0)]
    ax.plot(*((edge, at) if along == "x" else (at, edge)), marker, color=main, ms=3.5, mew=0, clip_on=False, zorder=6)


def mark(ax: Axes, along: str, at: float, seeds: np.ndarray, look: Mapping[str, Any], aside: float) -> list[str]:
    """Mean and 95 % interval at ``at``, every seed as a dot ``aside`` of it; in words if some of it lies outside."""
    mean, half = interval(seeds)
    low, high = ax.get_xlim() if along == "x" else ax.get_ylim()

    def plot(values: Sequence[float] | np.ndarray, at: float, *args: Any, **more: Any) -> None:
        across = np.full(len(values), at)
        ax.plot(*((values, across) if along == "x" else (across, values)), *args, **more)

    if half:
        plot([mean - half, mean + half], at, color=look["color"], lw=1.1, zorder=2, solid_capstyle="butt")
        plot(seeds, at + aside, "o", color=tint(look["color"], 0.7), ms=1.6, mew=0, zorder=3)
    plot([mean], at, **{**look, "ls": "", "ms": 4.2}, zorder=3.5)
    out = {-1: min(seeds.min(), mean - half) < low, 1: max(seeds.max(), mean + half) > high}
    for side in (side for side, beyond in out.items() if beyond):
        arrow(ax, along, at, side, look["color"])
    return [spell(mean) + (f" ± {spell(half)}" if half else "")] if any(out.values()) else []


def foot(ax: Axes, label: str, notes: Sequence[str], inches: float) -> None:
    """Name the x axis, and below it say what lies outside a panel of this width, one note a line."""
    lines = [label] if label else []
    for i, note in enumerate(notes):
        lines += textwrap.wrap(("" if i else "outside: ") + note, int(inches / 0.056), break_on_hyphens=False)
    ax.set_xlabel("\n".join(lines))


def finish(figure: Figure, grid: np.ndarray, entries: Sequence[Line2D] = (), columns: int = 1) -> Figure:
    """The figure with its legend, and as much higher as the legend and the words below its panels take."""
    lines = sum(max(ax.get_xlabel().count("\n") for ax in row) for row in grid)
    rows = -(-len(entries) // columns)
    figure.set_figheight(figure.get_figheight() + 0.115 * lines + (0.14 * rows + 0.1 if entries else 0))
    if entries:
        legend(figure, entries, columns=columns)
    return figure


def handles(look_of: Mapping[str, Mapping[str, Any]], **more: Any) -> list[Line2D]:
    """The entries of a legend."""
    return [Line2D([], [], **{**look, **more}, label=name(label)) for label, look in look_of.items()]


def ends(rows: Iterable[np.ndarray]) -> np.ndarray:
    """Both ends of the 95 % interval of each row of seeds."""
    return np.array([mean + sign * half for mean, half in map(interval, rows) for sign in (-1, 1)])
