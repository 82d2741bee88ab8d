"""Figure of cost against size, for docs/speed.md. Letters in shapes: R rounds, K sizes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from tsmlib.plots.style import BLUE, ORANGE, PALE, RED, entry, grid, legend, numbers, styled

LOOKS: dict[str, dict[str, Any]] = {  # a colour for each; black is the true simulator
    "train": dict(color=BLUE, marker="o"),
    "imagine": dict(color=RED, marker="s"),
    "plan": dict(color="#009E73", marker="^"),
    "score": dict(color="#882255", marker="D"),
    "learn": dict(color=ORANGE, marker="v"),
    "simulate": dict(color="#111111", marker="x"),
}
UNCLEAR = 0.5  # spread of exponents over rounds from which on none is printed
UNITS = {
    "segment length": "steps",
    "horizon": "steps",
    "batch": "windows",
    "seeds": "policies at once",
}
WORDS = {
    "train": "training update",
    "imagine": "predicting",
    "plan": "planning iteration",
    "score": "scoring",
    "learn": "policy update",
    "simulate": "MuJoCo",
}

Curve = tuple[np.ndarray, np.ndarray]  # sizes (K,), seconds (R, K)


def exponents(sizes: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Of sizes (K,) and seconds (R, K), the slope of log seconds over log size, round by round: (R,)."""
    return np.polyfit(np.log(sizes), np.log(seconds).T, 1)[0]


@styled
def growth(curves: Mapping[str, Mapping[str, Curve]]) -> Figure:
    """Cost against size, both logarithmic, one panel per size; cost is relative to that of the smallest size.

    curves: panel -> what is done, one of LOOKS -> sizes and seconds. Marks are medians over rounds, bars reach from the
    lowest to the highest; each line's exponent stands in the panel, with its spread over rounds, unless that is more
    than UNCLEAR. Grey: linear growth, or for threads a cost that falls in proportion.
    """
    lines_of = {title: dict.fromkeys(lines, ()) for title, lines in curves.items()}
    figure, axes = grid(lines_of, 4, 1.65)
    for ax, (title, lines) in zip(axes, curves.items(), strict=True):
        every = np.unique(np.concatenate([np.asarray(sizes, float) for sizes, _ in lines.values()]))
        slope = -1 if title == "threads" else 1
        lowest = np.array([min(sizes[0] for sizes, _ in lines.values()), every[-1]])
        ax.plot(lowest, (lowest / lowest[0]) ** slope, color=PALE, ls="--", lw=0.8, zorder=1)
        notes = []
        for word, (sizes, seconds) in lines.items():
            sizes = numbers(f"sizes of {title}, {word}", sizes, "K")
            seconds = numbers(f"seconds of {title}, {word}", seconds, f"R {len(sizes)}")
            relative = seconds / seconds[:, :1]
            middle = np.median(relative, axis=0)
            bars = np.stack([middle - relative.min(0), relative.max(0) - middle])
            ax.errorbar(sizes, middle, bars, **LOOKS[word], ms=3, lw=1, elinewidth=0.7, zorder=3)
            found = exponents(sizes, seconds)
            spread = f"{np.median(found):.2f} ({found.min():.2f} to {found.max():.2f})"
            told = f"slope {spread}" if np.ptp(found) < UNCLEAR else "rounds differ too much"
            notes.append((told, LOOKS[word]["color"]))
        unit = f" ({UNITS[title]})" if title in UNITS else ""
        ax.set(xscale="log", yscale="log", title=title.capitalize() + unit)
        ax.set_xticks(every, [f"{size:g}" for size in every])
        ax.yaxis.set_major_locator(
            FixedLocator([a * 10.0**b for b in range(-2, 4) for a in (1, 2, 5)])
        )
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_minor_locator(NullLocator())
        low, high = ax.get_ylim()
        room = (high / low) ** (
            0.13 * len(notes)
        )  # for the notes: below lines that rise, above those that should fall
        ax.set_ylim((low / room, high) if slope > 0 else (low, high * room))
        for i, (note, shade) in enumerate(reversed(notes) if slope > 0 else notes):
            y, anchor = (0.02 + 0.09 * i, "bottom") if slope > 0 else (0.98 - 0.09 * i, "top")
            ax.text(
                1.0,
                y,
                note.replace("-", "\u2212"),
                transform=ax.transAxes,
                ha="right",
                va=anchor,
                color=shade,
                fontsize=6,
            )
    for ax in axes[::4]:
        ax.set_ylabel("cost (of the smallest)")
    used = [word for word in LOOKS if any(word in lines for lines in curves.values())]
    entries = [
        entry(WORDS[word], LOOKS[word]["color"], marker=LOOKS[word]["marker"]) for word in used
    ]
    entries.append(entry("in proportion", PALE, "--"))
    legend(figure, entries)
    return figure
