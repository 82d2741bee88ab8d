"""How cost grows with the size of things, for docs/speed.md. Letters in shapes: R rounds, K sizes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter, NullLocator

from tsmlib.axes import finite
from tsmlib.style import COLOURS, legend, panels, styled, tint

LOOKS: dict[str, dict[str, Any]] = {  # one blue throughout, the model's; black is the true simulator
    "train": dict(color=COLOURS["tsm"], marker="o"),
    "imagine": dict(color=COLOURS["tsm+energy"], marker="s"),
    "plan": dict(color=COLOURS["tsm+energy+direct"], marker="^"),
    "score": dict(color=COLOURS["tsm+energy"], marker="D"),
    "learn": dict(color=COLOURS["tsm"], marker="v"),
    "simulate": dict(color=COLOURS["oracle"], marker="x"),
}
WORDS = {
    "train": "one training update", "imagine": "imagined rollouts", "plan": "one planning iteration",
    "score": "scoring", "learn": "one policy update", "simulate": "MuJoCo itself",
}  # fmt: skip

Curve = tuple[np.ndarray, np.ndarray]  # sizes (K,), seconds (R, K)


def exponents(sizes: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Of sizes (K,) and seconds (R, K), the slope of log seconds over log size, round by round: (R,)."""
    return np.polyfit(np.log(sizes), np.log(seconds).T, 1)[0]


@styled
def growth(curves: Mapping[str, Mapping[str, Curve]]) -> Figure:
    """Cost against size, both logarithmic, one panel per size; cost is relative to that of the smallest size.

    curves: panel -> what is done, one of LOOKS -> sizes and seconds. Marks are medians over rounds, bars reach from the
    lowest to the highest; each line's exponent stands in the panel, with its spread over rounds. Grey: linear growth,
    or for threads a cost that falls in proportion.
    """
    figure, axes = panels(len(curves), 4, 1.65)
    for ax, (title, lines) in zip(axes, curves.items(), strict=True):
        every = np.unique(np.concatenate([np.asarray(sizes, float) for sizes, _ in lines.values()]))
        slope = -1 if title == "threads" else 1
        lowest = np.array([min(sizes[0] for sizes, _ in lines.values()), every[-1]])
        ax.plot(lowest, (lowest / lowest[0]) ** slope, color=COLOURS["zero"], ls="--", lw=0.8, zorder=1)
        notes = []
        for word, (sizes, seconds) in lines.items():
            sizes = finite(f"sizes of {title}, {word}", sizes, "K")
            seconds = finite(f"seconds of {title}, {word}", seconds, f"R {len(sizes)}")
            relative = seconds / seconds[:, :1]
            middle = np.median(relative, axis=0)
            bars = np.stack([middle - relative.min(0), relative.max(0) - middle])
            ax.errorbar(sizes, middle, bars, **LOOKS[word], ms=3, lw=1, elinewidth=0.7, zorder=3)
            found = exponents(sizes, seconds)
            notes.append((f"{np.median(found):.2f} ({found.min():.2f} to {found.max():.2f})", LOOKS[word]["color"]))
        ax.set(xscale="log", yscale="log", title=title.capitalize())
        ax.set_xticks(every, [f"{size:g}" for size in every])
        ax.xaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
        for i, (note, shade) in enumerate(reversed(notes) if slope > 0 else notes):
            if slope > 0:  # lines rise: the free corner is at the lower right
                ax.text(0.99, 0.03 + 0.11 * i, note, transform=ax.transAxes, ha="right", va="bottom", color=shade,
                        fontsize=6)  # fmt: skip
            else:
                ax.text(0.99, 0.97 - 0.11 * i, note, transform=ax.transAxes, ha="right", va="top", color=shade,
                        fontsize=6)  # fmt: skip
    for ax in axes[::4]:
        ax.set_ylabel("cost (of the smallest)")
    used = [word for word in LOOKS if any(word in lines for lines in curves.values())]
    entries = [Line2D([], [], **LOOKS[word], ms=3, label=WORDS[word]) for word in used]
    entries.append(Line2D([], [], color=tint(COLOURS["zero"], 1.0), ls="--", lw=0.8, label="in proportion"))
    legend(figure, entries)
    return figure
