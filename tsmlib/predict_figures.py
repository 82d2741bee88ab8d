"""Figures of predictions: who predicts best, how far ahead, how honestly, and what the rollouts look like.

The paper's figure 5 and what surrounds it. Reached through ``tsmlib.figures``, where labels are explained. Nothing is
cut off in silence: where a model that diverged would squeeze the others flat, the axis ends before it, and a grey
strip beyond the scale holds an arrow and the value in words.

Letters in shapes: k seeds, T steps, L levels, S samples, N episodes, dx state size.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator
from numpy.typing import ArrayLike

from tsmlib.style import COLOURS, WIDTH, colour, interval, legend, name, shaped, styled, tint, words

Values = Mapping[str, Mapping[str, np.ndarray]]  # panel or environment -> label -> array

MARKERS = {"tsm": "o", "tsm+energy": "D", "tsm+teacher": "p", "onestep": "s", "multistep": "^", "lstm": "v",
           "ensemble": "P", "ensemble+mse": "X"}  # fmt: skip
DASHES = ("-", (0, (4, 1.5)), (0, (1, 1)))
OFF = "#EFEFEF"  # the strip beyond the scale
LINE = 0.115  # inches: a line of small text
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class _Look(NamedTuple):
    """How a label is drawn: a second label of the same model is open and dashed."""

    label: str
    colour: str
    marker: str
    dashes: Any
    filled: bool

    def line(self, **more: Any) -> Line2D:
        """Its entry in a legend."""
        face = self.colour if self.filled else "white"
        return Line2D([], [], color=self.colour, marker=self.marker, mfc=face, mew=0.8, label=name(self.label), **more)


def _looks(labels: Iterable[str]) -> dict[str, _Look]:
    """The looks of all labels of a figure, in the order of COLOURS."""
    drawn: dict[str, int] = {}
    looks: dict[str, _Look] = {}
    order = list(COLOURS)
    for label in sorted(dict.fromkeys(labels), key=lambda label: order.index(words(label)[0])):
        model = words(label)[0]
        again = drawn[model] = drawn.get(model, -1) + 1
        looks[label] = _Look(label, colour(label), MARKERS.get(model, "o"), DASHES[again % 3], again % 2 == 0)
    if not looks:
        raise ValueError("no panel holds a model: nothing to draw")
    return looks


def _finite(field: str, values: ArrayLike, shape: str) -> np.ndarray:
    """``shaped``, and every value is a number."""
    array = shaped(field, values, shape)
    if bad := int(np.sum(~np.isfinite(array))):
        raise ValueError(
            f"{field}: {bad} of {array.size} values are not finite; a mean over them means nothing. "
            "Count such rollouts as worst before they are drawn"
        )
    return array


def _spell(value: float) -> str:
    """A number as it is printed: three digits, and a power of ten where it is far from one."""
    if value == 0 or 1e-2 <= abs(value) < 1e4:
        text = f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
    else:
        digits, power = f"{value:.1e}".split("e")
        digits = "" if digits == "1.0" else f"{digits}×"
        text = f"{digits}10{str(int(power)).translate(SUPERSCRIPT)}"
    return text.replace("-", "−")


def _window(points: np.ndarray, bars: np.ndarray, reach: float = 4.0, log: bool = False) -> tuple[float, float]:
    """The range to draw: all of ``points`` and the ends of ``bars``, less what lies far from where most points are.

    The shortest range that holds 60 % of the points is sure to be seen, and every point within ``reach`` times its
    width of it (on a logarithmic axis at least four decades); bars add at most as much again as the points span.
    """
    place = np.log10 if log else np.asarray
    points, bars = np.sort(points, axis=None), bars[bars > 0] if log else bars
    at, most = place(points), int(np.ceil(0.6 * len(points)))
    widths = at[most - 1 :] - at[: len(at) - most + 1]
    first = int(widths.argmin())
    reach = max(reach * widths[first], 4.0 if log else 0.5 * reach * abs(float(np.median(at))))
    seen = points[(at >= at[first] - reach) & (at <= at[first + most - 1] + reach)]
    low, high = place(seen[[0, -1]])
    margin = 0.3 * (high - low) if log else max(high - low, 0.1 * abs(low))
    seen = np.append(seen, bars[(place(bars) >= low - margin) & (place(bars) <= high + margin)])
    return float(seen.min()), float(seen.max())


def _padded(low: float, high: float, log: bool = False) -> tuple[float, float]:
    """A range with room at its ends."""
    if log:
        start, end = _padded(float(np.log10(low)), float(np.log10(high)))
        return 10.0**start, 10.0**end
    pad = 0.05 * (high - low) or max(0.05 * abs(low), 1e-3)
    return low - pad, high + pad


def _log_ticks(low: float, high: float) -> list[float]:
    """Round numbers between the exponents ``low`` and ``high``."""
    if high - low < 0.5:
        return [float(tick) for tick in MaxNLocator(4).tick_values(10.0**low, 10.0**high) if tick > 0]
    digits = (1, 2, 5) if high - low < 1.6 else (1, 3) if high - low < 2.6 else (1,)
    powers = range(int(np.floor(low)), int(np.ceil(high)) + 1, max(1, round((high - low) / 5)))
    return [digit * 10.0**power for power in powers for digit in digits]


def _scale(
    ax: Axes, along: str, scale: tuple[float, float], strips: tuple[float, float] = (0, 0), log: bool = False
) -> None:
    """Set the ``along`` ("x" or "y") axis to ``scale``, with grey strips of these shares of it below and above."""
    axis = ax.xaxis if along == "x" else ax.yaxis
    low, high = np.log10(scale) if log else scale
    length = (high - low) / (1 - sum(strips))
    outer = (low - strips[0] * length, high + strips[1] * length)
    ticks = _log_ticks(low, high) if log else list(MaxNLocator(6, steps=(1, 2, 2.5, 5, 10)).tick_values(low, high))
    if log:
        outer = (10.0 ** outer[0], 10.0 ** outer[1])
        (ax.set_xscale if along == "x" else ax.set_yscale)("log")
        axis.set_major_formatter(FuncFormatter(lambda value, _: _spell(value)))
    axis.set_ticks([tick for tick in ticks if scale[0] <= tick <= scale[1]])
    axis.set_minor_locator(NullLocator())
    (ax.set_xlim if along == "x" else ax.set_ylim)(*outer)
    for edges, strip in zip(((outer[0], scale[0]), (scale[1], outer[1])), strips, strict=True):
        if strip:
            (ax.axvspan if along == "x" else ax.axhspan)(*edges, color=OFF, lw=0, zorder=4)


def _off(scale: tuple[float, float], seeds: np.ndarray) -> tuple[int, str]:
    """Whether something of one mark lies off the scale, and which in words: (-1 below, 1 above or 0, text).

    The mean counts before a seed and a seed before the end of the interval, and of two seeds the further.
    """
    mean, half = interval(seeds)
    far = max(seeds, key=lambda seed: max(scale[0] - seed, seed - scale[1]))
    ends = max(mean - half, mean + half, key=lambda end: max(scale[0] - end, end - scale[1]))
    for word, value in (("mean ", mean), ("seed ", far), ("to ", ends)):
        if not scale[0] <= value <= scale[1]:
            return (-1 if value < scale[0] else 1), f"{word}{_spell(value)}"
    return 0, ""


def _mark(ax: Axes, along: str, at: float, seeds: np.ndarray, look: _Look, scale: tuple[float, float], *,
          filled: bool, aside: float, noted: int) -> None:  # fmt: skip
    """Mean and 95 % interval at ``at`` across the scale, every seed as a dot ``aside`` of it.

    An end of the interval beyond the scale has an arrow, unless a note stands on that side (``noted``: -1, 1 or 0).
    """
    mean, half = interval(seeds)
    ends = np.clip((mean - half, mean + half), *scale)

    def place(values: Any, across: Any) -> tuple[Any, Any]:
        return (values, across) if along == "x" else (across, values)

    if half and ends[1] > ends[0]:
        ax.plot(*place(ends, (at, at)), color=look.colour, lw=1.1, zorder=2, solid_capstyle="butt")
        for side, edge, beyond in ((-1, scale[0], mean - half < scale[0]), (1, scale[1], mean + half > scale[1])):
            if beyond and side != noted:
                _arrow(ax, along, at, edge, side, look.colour, inside=True)
    dots = seeds[(seeds >= scale[0]) & (seeds <= scale[1])]
    if len(seeds) > 1:
        ax.plot(*place(dots, np.full(len(dots), at + aside)), "o", color=tint(look.colour, 0.7), ms=1.6, mew=0,
                zorder=3)  # fmt: skip
    if scale[0] <= mean <= scale[1]:
        face = look.colour if filled else "white"
        ax.plot(*place([mean], [at]), look.marker, color=look.colour, mfc=face, ms=4.2, mew=0.8, zorder=3.5)


def _arrow(ax: Axes, along: str, at: float, edge: float, side: int, main: str, *, inside: bool = False) -> None:
    """An arrow out of the scale: from its end ``edge`` on, or ``inside`` up to it."""
    step = (-7 if inside else 7) * side
    ax.annotate("", (edge, at) if along == "x" else (at, edge), xytext=(step, 0) if along == "x" else (0, step),
                textcoords="offset points", zorder=6, arrowprops={
                    "arrowstyle": "-|>" if inside else "<|-", "color": main, "lw": 0.9, "mutation_scale": 5,
                    "shrinkA": 0, "shrinkB": 0})  # fmt: skip


def _strip(notes: Iterable[str]) -> float:
    """Inches that the longest of some notes takes with its arrow."""
    return max((0.052 * len(note) + 0.18 for note in notes), default=0.0)


def _legend(figure: Figure, handles: list[Line2D], columns: int) -> None:
    """The legend, and as much more height as its rows take."""
    rows = -(-len(handles) // columns)
    figure.set_figheight(figure.get_figheight() + 0.14 * rows + 0.1)
    legend(figure, handles, columns=columns)


def _per_panel(word: str, given: str | Mapping[str, str], titles: Iterable[str]) -> dict[str, str]:
    """One text per panel, from one for all or a mapping."""
    if isinstance(given, str):
        return dict.fromkeys(titles, given)
    if missing := [title for title in titles if title not in given]:
        raise ValueError(f"{word} names {', '.join(given)}; panel '{missing[0]}' is missing")
    return {title: given[title] for title in titles}


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
    checked = {title: {env: {label: _finite(f"{title} {env}, {label}".strip(), seeds, "k")
                             for label, seeds in rows.items()} for env, rows in panel.items()}
               for title, panel in given.items()}  # fmt: skip
    looks = _looks(label for panel in checked.values() for rows in panel.values() for label in rows)
    ylabels = _per_panel("ylabel", ylabel, checked)
    slots, group = {label: i for i, label in enumerate(looks)}, len(looks) + 1.6
    width, tall = WIDTH if len(checked) > 1 else 0.72 * WIDTH, 1.85
    figure, axes = plt.subplots(1, len(checked), figsize=(width, tall + 0.4), squeeze=False)
    drawn = []
    for panel in checked.values():
        rows = [(e * group + slots[label], label, seeds) for e, env in enumerate(panel.values())
                for label, seeds in env.items()]  # fmt: skip
        bars = np.array([mean + sign * half for mean, half in (interval(r[2]) for r in rows) for sign in (-1, 1)])
        scale = _padded(*_window(np.concatenate([seeds for _, _, seeds in rows]), bars))
        notes = [(x, label, *_off(scale, seeds)) for x, label, seeds in rows]
        strips = [_strip(note[3] for note in notes if note[2] == side) for side in (-1, 1)]
        drawn.append((rows, notes, scale, strips))
    total = tall + max(sum(strips) for *_, strips in drawn)
    figure.set_figheight(total + 0.4)
    for ax, (title, panel), (rows, notes, scale, strips) in zip(axes[0], checked.items(), drawn, strict=True):
        _scale(ax, "y", scale, (strips[0] / total, strips[1] / total))
        for (x, label, seeds), (_, _, side, text) in zip(rows, notes, strict=True):
            look = looks[label]
            _mark(ax, "y", x, seeds, look, scale, filled=look.filled, aside=0.32, noted=side)
            if side:
                edge = scale[0 if side < 0 else 1]
                _arrow(ax, "y", x, edge, side, look.colour)
                ax.annotate(text, (x, edge), (0, 9 * side), textcoords="offset points", rotation=90, fontsize=6.5,
                            ha="center", va="top" if side < 0 else "bottom", zorder=6)  # fmt: skip
        for e in range(1, len(panel)):
            ax.axvline(e * group - 1.3, color="#CCCCCC", lw=0.6, zorder=5)
        ax.grid(axis="y", color="#EEEEEE", lw=0.6)
        ax.set_xlim(-1.3, len(panel) * group - 1.3)
        ax.set_xticks([e * group + (len(looks) - 1) / 2 for e in range(len(panel))],
                      [re.sub(r"^tsm/|-v\d+$|Reacher(?=[A-Z])", "", env) for env in panel])  # fmt: skip
        ax.tick_params(axis="x", length=0, labelsize=7)
        ax.set(title=title, ylabel=ylabels[title])
    handles = [look.line(ls="", ms=4.2) for look in looks.values()]
    if any(len(seeds) > 1 for panel in checked.values() for rows in panel.values() for seeds in rows.values()):
        handles.append(Line2D([], [], color="#777777", ls="", marker="o", ms=1.8, mew=0, label="one seed"))
    _legend(figure, handles, 5 if len(checked) > 1 else 3)
    return figure


@styled
def against_horizon(
    curves: Values, ylabel: str | Mapping[str, str], *, log: Collection[str] = (),
    reference: Mapping[str, float] | None = None, columns: int = 3,
) -> Figure:  # fmt: skip
    """Scores at every step ahead, one panel each: mean over seeds, and a band for its 95 % t interval.

    curves: title -> label -> (k, T); ylabel: one for all, or title -> text; log: the titles with a logarithmic axis;
    reference: title -> a value to draw a dashed line at, such as the nominal coverage.
    """
    reference = reference or {}
    for word, given in (("log", log), ("reference", reference)):
        if unknown := [title for title in given if title not in curves]:
            raise ValueError(f"{word} names a panel '{unknown[0]}'; there are {', '.join(curves)}")
    looks = _looks(label for rows in curves.values() for label in rows)
    ylabels = _per_panel("ylabel", ylabel, curves)
    columns = min(columns, len(curves))
    lines: dict[str, dict[str, np.ndarray]] = {}  # mean, lower and upper end: (3, T)
    scales: dict[str, tuple[float, float]] = {}
    notes: dict[str, dict[int, list[str]]] = {}  # -1 below, 1 above
    wide = int((WIDTH / columns - 0.5) / 0.05)
    for title, rows in curves.items():
        lines[title] = {}
        for label in (label for label in looks if label in rows):
            array = _finite(f"{title}, {label}", rows[label], "k T")
            mean, half = np.array([interval(column) for column in array.T]).T
            if title in log and mean.min() <= 0:
                raise ValueError(f"{title}, {label}: {_spell(mean.min())} cannot stand on a logarithmic axis")
            lines[title][label] = np.stack([mean, mean - half, mean + half])
        means = np.concatenate([line[0] for line in lines[title].values()])
        ends = np.concatenate([line[1:].ravel() for line in lines[title].values()])
        low, high = _window(means, ends, 3.0, title in log)
        low = max(low, 0.0) if means.min() >= 0 else low  # no room for what an error cannot be
        line = reference.get(title, low)
        scales[title] = _padded(min(low, line), max(high, line), title in log)
        notes[title] = {-1: [], 1: []}
        for label, (mean, lower, upper) in lines[title].items():
            for side, line, end in ((-1, -mean, -lower), (1, mean, upper)):
                edge = side * scales[title][0 if side < 0 else 1]
                what, furthest = ("", line.max()) if line.max() > edge else (", band", end.max())
                if furthest > edge:
                    text = f"{name(label)}{what} to {_spell(side * furthest)}"
                    notes[title][side] += textwrap.wrap(text, wide)
    titles = list(curves)
    used = [max(len(n[-1]) + len(n[1]) for n in (notes[title] for title in titles[i : i + columns]))
            for i in range(0, len(titles), columns)]  # fmt: skip
    heights = [1.55 + LINE * count for count in used]
    width = WIDTH if columns > 2 else 3.5 * columns
    figure, grid = plt.subplots(len(heights), columns, figsize=(width, sum(heights) + 0.1), squeeze=False,
                                height_ratios=heights)  # fmt: skip
    for ax in grid.flat[len(titles) :]:
        ax.remove()
    for i, (title, ax) in enumerate(zip(titles, grid.flat, strict=False)):
        inches = [LINE * len(notes[title][side]) + 0.06 * bool(notes[title][side]) for side in (-1, 1)]
        below, above = (part / (heights[i // columns] - 0.4) for part in inches)
        scale = scales[title]
        _scale(ax, "y", scale, (below, above), title in log)
        for j, (label, (mean, lower, upper)) in enumerate(lines[title].items()):
            look, steps = looks[label], np.arange(1, len(mean) + 1)
            every = max(1, len(steps) // 5)
            ax.plot(steps, mean, color=look.colour, ls=look.dashes, marker=look.marker, ms=3, mew=0.6, zorder=3,
                    mfc=look.colour if look.filled else "white",
                    markevery=((j * every) // len(lines[title]), every))  # fmt: skip
            if (upper > lower).any():
                floor = scale[0] / 10 if title in log else -np.inf
                ax.fill_between(steps, np.maximum(lower, floor), upper, color=look.colour, alpha=0.11, lw=0, zorder=2)
            for side, edge in ((-1, scale[0]), (1, scale[1])):
                if (gone := side * mean > side * edge).any():
                    _arrow(ax, "y", steps[gone.argmax()], edge, side, look.colour, inside=True)
        if title in reference:
            ax.axhline(reference[title], color="#777777", ls=(0, (4, 2)), lw=0.8, zorder=1)
        for side, y, va in ((-1, 0.0, "bottom"), (1, 1.0, "top")):
            if notes[title][side]:
                ax.annotate("\n".join(notes[title][side]), (0.99, y), (0, -1.5 * side), xycoords="axes fraction",
                            textcoords="offset points", fontsize=6.5, ha="right", va=va, zorder=6,
                            linespacing=1.1)  # fmt: skip
        ax.set_xlim(0, max(line.shape[1] for line in lines[title].values()) + 1)
        ax.set_title(title)
        ax.set_xlabel("steps ahead" if i + columns >= len(titles) else "")
        alike = i % columns and ylabels[title] == ylabels[titles[i - 1]]
        ax.set_ylabel("" if alike else ylabels[title])
    handles = [look.line(ls=look.dashes, ms=3) for look in looks.values()]
    if any((line[2] > line[1]).any() for rows in lines.values() for line in rows.values()):
        handles.append(Line2D([], [], color="#DDDDDD", lw=5, solid_capstyle="butt", label="95 % interval over seeds"))
    _legend(figure, handles, 5 if width == WIDTH else 2)
    return figure


@styled
def calibration(levels: np.ndarray, curves: Values, columns: int = 3) -> Figure:
    """How often the truth lies within a model's central interval, against how often it should; ideal is the diagonal.

    levels: (L,) nominal coverages in [0, 1]; curves: title -> label -> (L,) observed shares in [0, 1].
    """
    nominal = _finite("levels", levels, "L")
    looks = _looks(label for rows in curves.values() for label in rows)
    columns = min(columns, len(curves))
    rows_of = -(-len(curves) // columns)
    size = min(2.2, WIDTH / columns)
    figure, grid = plt.subplots(rows_of, columns, figsize=(size * columns + 0.2, size * rows_of), squeeze=False,
                                sharex=True, sharey=True, layout="compressed")  # fmt: skip
    for ax in grid.flat[len(curves) :]:
        ax.remove()
    for i, (title, rows) in enumerate(curves.items()):
        ax = grid.flat[i]
        ax.plot((0, 1), (0, 1), color="#999999", lw=0.7, zorder=1)
        for label in (label for label in looks if label in rows):
            share, look = _finite(f"{title}, {label}", rows[label], str(len(nominal))), looks[label]
            for word, array in (("levels", nominal), (f"{title}, {label}", share)):
                if array.min() < 0 or array.max() > 1:
                    raise ValueError(f"{word}: {array.min():g} to {array.max():g}, expected shares between 0 and 1")
            ax.plot(nominal, share, color=look.colour, ls=look.dashes, marker=look.marker, ms=3, mew=0.6, zorder=3,
                    mfc=look.colour if look.filled else "white", clip_on=False,
                    markevery=max(1, len(nominal) // 8))  # fmt: skip
        for text, at, ha, va in (("intervals too wide", (0.03, 0.97), "left", "top"),
                                 ("too narrow", (0.97, 0.03), "right", "bottom")):  # fmt: skip
            ax.annotate(text, at, ha=ha, va=va, fontsize=6.5, color="#777777", zorder=1)
        ax.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", title=title)
        ax.set_xticks((0, 0.25, 0.5, 0.75, 1), ("0", "0.25", "0.5", "0.75", "1"))
        ax.set_yticks((0, 0.25, 0.5, 0.75, 1), ("0", "0.25", "0.5", "0.75", "1"))
        if i + columns >= len(curves):
            ax.tick_params(labelbottom=True)
            ax.set_xlabel("nominal coverage")
        if i % columns == 0:
            ax.set_ylabel("observed coverage")
    _legend(figure, [look.line(ls=look.dashes, ms=3) for look in looks.values()], (1, 3, 5, 5)[min(columns, 4) - 1])
    return figure


@styled
def differences(
    values: Values, xlabel: str | Mapping[str, str], *, lower_is_better: Collection[str] = (), subject: str = "tsm"
) -> Figure:
    """``subject`` minus each other model, paired by seed, with 95 % t intervals and a line at zero (a forest plot).

    values: title -> label of the other model -> (k,) differences; xlabel: one for all, or title -> text;
    lower_is_better: the titles in which a negative difference favours ``subject``. A mark is filled and its row tinted
    where the interval excludes zero; it is open where it does not, and for a single seed, which has no interval.
    """
    checked = {title: {label: _finite(f"{title}, {label}", seeds, "k") for label, seeds in rows.items()}
               for title, rows in values.items()}  # fmt: skip
    if unknown := [title for title in lower_is_better if title not in values]:
        raise ValueError(f"lower_is_better names a panel '{unknown[0]}'; there are {', '.join(values)}")
    looks = _looks(label for rows in checked.values() for label in rows)
    xlabels = _per_panel("xlabel", xlabel, checked)
    heights = {label: y for y, label in enumerate(looks)}
    columns = len(checked)
    height = 0.21 * len(looks) + 0.85
    figure, axes = plt.subplots(1, columns, figsize=(WIDTH if columns > 1 else 4.5, height), squeeze=False, sharey=True)
    for ax, (title, rows) in zip(axes[0], checked.items(), strict=True):
        bars = np.array([mean + sign * half for mean, half in map(interval, rows.values()) for sign in (-1, 1)])
        low, high = _window(np.concatenate(list(rows.values())), bars)
        scale = _padded(min(low, 0.0), max(high, 0.0))
        notes = {label: _off(scale, seeds) for label, seeds in rows.items()}
        inches = (WIDTH - 1.6) / columns if columns > 1 else 2.9
        strips = [min(0.42, _strip(text for where, text in notes.values() if where == side) / inches)
                  for side in (-1, 1)]  # fmt: skip
        _scale(ax, "x", scale, (strips[0], strips[1]))
        for label, seeds in rows.items():
            mean, half = interval(seeds)
            sure, y = bool(len(seeds) > 1 and abs(mean) > half), heights[label]
            if sure:
                ax.axhspan(y - 0.5, y + 0.5, color=tint(looks[label].colour, 0.13), lw=0, zorder=0)
            side, text = notes[label]
            _mark(ax, "x", y, seeds, looks[label], scale, filled=sure, aside=0.27, noted=side)
            if side:
                edge = scale[0 if side < 0 else 1]
                _arrow(ax, "x", y, edge, side, looks[label].colour)
                ax.annotate(text, (edge, y), (9 * side, 0), textcoords="offset points", fontsize=6.5, zorder=6,
                            ha="right" if side < 0 else "left", va="center_baseline")  # fmt: skip
        ax.axvline(0, color="#555555", lw=0.8, zorder=1)
        ax.set(title=title, xlabel=xlabels[title])
        left = title in lower_is_better
        for better, x, ha, text in ((left, 0.0, "left", "← {}"), (not left, 1.0, "right", "{} →")):
            who = f"{name(subject)} better" if better else "worse"
            ax.annotate(text.format(who), (x, 1), (0, 1), xycoords="axes fraction", textcoords="offset points",
                        fontsize=6.5, color="#555555", ha=ha, va="bottom")  # fmt: skip
        ax.set_title(title, pad=12)
        ax.spines["left"].set_visible(False)
        ax.tick_params(axis="y", length=0)
    first = axes[0, 0]
    first.set_yticks(list(heights.values()), [name(label) for label in heights], fontsize=7)
    first.annotate(f"{name(subject)} minus", (0, 1), (-4, 1), xycoords="axes fraction", textcoords="offset points",
                   fontsize=7, ha="right", va="bottom", weight="bold", color=colour(subject))  # fmt: skip
    first.set_ylim(len(looks) - 0.5, -0.5)
    return figure


def _pair(names: Sequence[str], word: str) -> list[int]:
    """The columns of a position in the plane."""
    known = [n[:-2] for n in names if n.endswith("_x") and f"{n[:-2]}_y" in names]
    if word not in known:
        raise ValueError(f"names hold no path of the {word}; there are {', '.join(known) or 'none'}")
    return [names.index(f"{word}_{axis}") for axis in "xy"]


def _leaves(ax: Axes, path: np.ndarray, low: np.ndarray, high: np.ndarray, main: str) -> bool:
    """Whether a path (T, 2) leaves the picture; an arrow head marks where."""
    outside = ((path < low) | (path > high)).any(-1)
    if not outside.any():
        return False
    gone = int(outside.argmax())
    out = path[gone] - path[gone - 1] if gone else path[0] - (low + high) / 2
    turn = float(np.degrees(np.arctan2(out[1], out[0]))) - 90
    ax.plot(*np.clip(path[gone], low, high), marker=(3, 0, turn), color=main, ms=5, mew=0, clip_on=False, zorder=6)
    return True


@styled
def gallery(
    true: np.ndarray, predicted: Mapping[str, np.ndarray], energy: Mapping[str, np.ndarray], names: Sequence[str], *,
    contact: np.ndarray | None = None, by: str | None = None, path: str = "block", radius: float = 0.03,
) -> Figure:  # fmt: skip
    """Rollouts over the truth in the plane: each model's best, median and worst episode, by energy score.

    true: (N, T, dx); predicted: label -> (S, N, T, dx), all S are drawn; energy: label -> (N,); contact: (N,) first
    step with contact, negative where there is none; by: the model whose scores choose the episodes for all columns
    (None: each its own). path: whose way is drawn thick, "block" (with the fingertip's thinner) or "tip" (with the
    block where it starts); radius: the block's, in m. Episodes in a row share a scale.
    Samples that leave the picture are marked and counted.
    """
    true = _finite("true", true, "N T dx")
    n, steps, size = true.shape
    shaped("names", np.zeros(len(names)), str(size))
    if n < 3:
        raise ValueError(f"true holds {n} episodes: best, median and worst need at least 3")
    looks = _looks(predicted)
    drawn = {label: _finite(f"predicted['{label}']", predicted[label], f"S {n} {steps} {size}") for label in looks}
    if missing := [label for label in (*looks, *([by] if by else [])) if label not in energy]:
        raise ValueError(f"energy holds {', '.join(energy) or 'nothing'}; '{missing[0]}' is missing")
    scores = {label: _finite(f"energy['{label}']", values, str(n)) for label, values in energy.items()}
    picks = {label: np.argsort(values, kind="stable")[[0, (n - 1) // 2, -1]] for label, values in scores.items()}
    first = None if contact is None else _finite("contact", contact, str(n)).astype(int)
    main, tip = _pair(names, path), _pair(names, "tip")
    block = _pair(names, "block") if "block_x" in names else None
    half = np.array([radius, radius])

    count, rows = len(looks), ("best", "median", "worst")
    size_in = min(1.75, (WIDTH - 0.25) / count)
    down, across = (3, count) if count > 1 else (1, 3)  # a single model lies on its side
    figure, grid = plt.subplots(down, across, squeeze=False,
                                figsize=(size_in * across + 0.25, down * (size_in + 0.42) + 0.45))  # fmt: skip
    grid = grid.reshape(3, count)
    for row, row_word in enumerate(rows):
        boxes, needed, wanted = {}, 0.05, 0.0
        for label in looks:
            episode = int(picks[by or label][row])
            seen = [true[episode][:, main]]
            if block:
                seen += [true[episode, :1][:, block] - half, true[episode, :1][:, block] + half]
            if first is not None and 0 <= first[episode] < steps:
                seen.append(true[episode, first[episode]][None, tip])
            everything = np.concatenate(seen)
            low, high = everything.min(0), everything.max(0)
            boxes[label] = (low + high) / 2
            needed = max(needed, float((high - low).max()))
            samples = drawn[label][:, episode][..., main]
            wanted = max(wanted, 2 * float(np.abs(samples - boxes[label]).max()))
        span = 1.12 * min(max(needed, wanted), 1.8 * needed)
        bar = max((b for b in (0.01, 0.02, 0.05, 0.1, 0.2) if b < 0.4 * span), default=0.01)
        for column, label in enumerate(looks):
            ax, look, episode = grid[row, column], looks[label], int(picks[by or label][row])
            samples, truth = drawn[label][:, episode], true[episode]
            faint = float(np.clip(4 / len(samples), 0.15, 0.7))
            low, high = boxes[label] - span / 2, boxes[label] + span / 2
            if block:
                ax.add_patch(Circle(tuple(truth[0, block]), radius, fc="#E4E4E4", ec="#8A8A8A", lw=0.7, zorder=1))
            if path != "tip":
                ax.plot(samples[..., tip[0]].T, samples[..., tip[1]].T, color=tint(look.colour, 0.6), lw=0.4,
                        alpha=faint, zorder=2)  # fmt: skip
                ax.plot(*truth[:, tip].T, color=COLOURS["data"], lw=0.6, zorder=3)
            ax.plot(samples[..., main[0]].T, samples[..., main[1]].T, color=look.colour, lw=0.9, alpha=faint, zorder=4)
            ax.plot(*samples[:, -1][:, main].T, ".", color=look.colour, ms=3, mew=0, zorder=4.2)
            ax.plot(*truth[:, main].T, color="black", lw=1.3, zorder=5)
            ax.plot(*truth[-1, main], "o", color="black", ms=3, zorder=5)
            if first is not None and 0 <= first[episode] < steps:
                ax.plot(*truth[first[episode], tip], "*", color="white", mec="black", mew=0.7, ms=6.5, zorder=5.5)
            gone = sum([_leaves(ax, sample[:, main], low, high, look.colour) for sample in samples])
            ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=(), yticks=())
            ax.spines[:].set(visible=True, color="#CCCCCC")
            score = _spell(float(scores[label][episode]))
            ax.set_title(f"energy score {score}" if size_in > 1.2 else f"score {score}", fontsize=6.5, color="#555555")
            if gone:
                far = float(np.linalg.norm(samples[..., main] - truth[:, main], axis=-1).max())
                text = f"{gone} of {len(samples)} leave,\nto {_spell(far)} m off"
                ax.annotate(text, (1, 0), (0, -2), xycoords="axes fraction", textcoords="offset points", fontsize=6.5,
                            ha="right", va="top", linespacing=1.1)  # fmt: skip
            if column == 0:
                ax.plot((0, bar / span), (-0.04, -0.04), color="#222222", lw=1.4, transform=ax.transAxes, clip_on=False,
                        solid_capstyle="butt")  # fmt: skip
                ax.annotate(f"{bar:g} m", (0, -0.04), (0, -2), xycoords="axes fraction", textcoords="offset points",
                            fontsize=6.5, va="top")  # fmt: skip
                ax.set_ylabel(row_word + (f" for {name(by)}" if by else ""), fontsize=7.5)
    for ax, label in zip(grid[0], looks, strict=True):
        heading = textwrap.fill(name(label), max(8, int(size_in / 0.068)))
        ax.annotate(heading, (0, 1), (0, 13), xycoords="axes fraction", textcoords="offset points", fontsize=7.5,
                    va="bottom", weight="bold", color=colour(label))  # fmt: skip
    dark = COLOURS["data"]
    simulator = f"simulator: {'fingertip' if path == 'tip' else path}, to its end"
    handles = [Line2D([], [], color="black", lw=1.3, marker="o", ms=3, label=simulator)]
    handles.append(Line2D([], [], color="#999999", lw=0.9, marker=".", ms=3, label="samples, in the model's colour"))
    if path != "tip":
        handles.append(Line2D([], [], color=dark, lw=0.6, label="simulator: fingertip"))
    if block:
        handles.append(
            Line2D([], [], ls="", marker="o", mfc="#E4E4E4", mec="#8A8A8A", ms=6, label="block at the start")
        )
    if first is not None:
        handles.append(Line2D([], [], ls="", marker="*", mfc="white", mec="black", mew=0.7, ms=6.5,
                              label="fingertip at first contact"))  # fmt: skip
    legend(figure, handles, columns=5 if size_in * across > 6.2 else 3)
    return figure
