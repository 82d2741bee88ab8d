"""Intervals in rows: comparisons, and what held."""

from __future__ import annotations

from typing import Literal

from matplotlib.figure import Figure

from tsmlib import zoo
from tsmlib.plots.style import (
    BLUE,
    NOTE,
    PALE,
    RED,
    WIDTH,
    Panels,
    grid,
    looks,
    numbers,
    styled,
)


@styled
def forest(
    panels: Panels,
    *,
    x_label: str = "",
    reference: float | None = 0.0,
    better: Literal["", "left", "right"] = "",
    columns: int = 3,
) -> Figure:
    """Intervals as rows, side by side in panels that share their rows.

    A row whose label is a model has the model's hue. Any other row is blue where the whole interval
    lies on the better side of the reference, red where it lies on the other, and grey across it.

    Args:
        panels: title -> row -> low, middle and high (3,).
        x_label: what stands along x, with its unit.
        reference: where neither side is ahead; None draws no line.
        better: the side of the reference that is good.
        columns: panels in a row.

    Returns:
        The figure.

    Raises:
        ValueError: a row that is not three numbers in order.
    """
    known = looks(panels)
    rows = list(dict.fromkeys(row for intervals in panels.values() for row in intervals))
    figure, axes = grid(panels, columns, 0.45 + 0.16 * len(rows), share="y")
    for ax, (title, intervals) in zip(axes, panels.items(), strict=True):
        if reference is not None:
            ax.axvline(reference, color=PALE, lw=0.8, ls="--", zorder=1)
        for row, given in intervals.items():
            low, middle, high = numbers(f"row {row!r} of panel {title!r}", given, "3")
            if not low <= middle <= high:
                raise ValueError(
                    f"row {row!r} of panel {title!r} is {low:g}, {middle:g}, {high:g}; expected "
                    "low, middle and high in this order"
                )
            look, _ = known[row]
            is_model = row.partition(", ")[0] in zoo.ZOO
            hue = look.colour if is_model else _side(low, high, reference, better)
            place = rows.index(row)
            ax.plot((low, high), (place, place), color=hue, lw=1.6, solid_capstyle="butt", zorder=2)
            ax.plot(middle, place, look.marker if is_model else "o", color=hue, ms=4, zorder=3)
        ax.set(xlabel=x_label, ylim=(len(rows) - 0.4, -0.6))
        ax.set_yticks(range(len(rows)), [known[row][0].name for row in rows])
        ax.spines["left"].set_visible(False)
        ax.tick_params(axis="y", length=0)
        ax.locator_params(axis="x", nbins=5)
    figure.set_figwidth(WIDTH)
    return figure


def _side(low: float, high: float, reference: float | None, better: str) -> str:
    """The hue of an interval beside the reference."""
    if reference is None or not better or low <= reference <= high:
        return NOTE
    right = low > reference
    return BLUE if right == (better == "right") else RED
