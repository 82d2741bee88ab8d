"""Curves against time, steps or sizes, and the fan of futures that a model predicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from tsmlib.plots.style import (
    DARK,
    GRID,
    PALE,
    TRUTH,
    WIDTH,
    Dashes,
    Look,
    Panels,
    entry,
    grid,
    legend,
    looks,
    numbers,
    outer,
    styled,
)
from tsmlib.statistics import interval


@styled
def curves(
    panels: Panels,
    *,
    x: ArrayLike | None = None,
    x_label: str = "",
    y_label: str = "",
    log: Literal["", "x", "y", "xy"] = "",
    spread: Literal["band", "lines"] = "band",
    held: bool = False,
    reference: float | None = None,
    share: Literal["", "x", "y", "xy"] = "xy",
    columns: int = 3,
) -> Figure:
    """Lines in panels that share their axes.

    Args:
        panels: title -> word -> values (T,), or (n, T) for n seeds, episodes or samples.
        x: where the values stand (T,); 0, 1, 2, ... without.
        x_label: what stands along x, with its unit.
        y_label: what stands along y, with its unit.
        log: axes that are logarithmic.
        spread: of (n, T) draw the mean and its 95 % t interval, or every line.
        held: each value is kept until the next, as torques are.
        reference: a level that is drawn as a dashed line.
        share: axes that all panels have in common.
        columns: panels in a row.

    Returns:
        The figure.

    Raises:
        ValueError: an array of another shape, or infinite values.
    """
    known = looks(panels)
    figure, axes = grid(panels, columns, 1.6, share=share)
    for ax, (title, series) in zip(axes, panels.items(), strict=True):
        for word, given in series.items():
            values = numbers(f"{word} of panel {title!r}", given, "T", "n T")
            at = (
                np.arange(values.shape[-1]) if x is None else numbers("x", x, str(values.shape[-1]))
            )
            _lines(ax, at, values, *known[word], spread=spread, held=held, truth=word in TRUTH)
        if reference is not None:
            ax.axhline(reference, color=PALE, lw=0.8, ls="--", zorder=1)
        ax.set(xscale="log" if "x" in log else "linear", yscale="log" if "y" in log else "linear")
    outer(figure, axes, x_label, y_label)
    _legend(figure, known)
    return figure


@styled
def fan(
    rollouts: Mapping[str, ArrayLike],
    names: Sequence[str],
    units: Sequence[str],
    *,
    dt: float = 0.02,
) -> Figure:
    """Predicted futures over the true one, each state dimension against time and in the plane.

    Args:
        rollouts: word -> states (T, dx), or samples (S, T, dx); "simulator" is drawn in black.
        names: of the state dimensions; ``tip_x`` and ``tip_y`` are drawn as a path of the tip, too.
        units: of the state dimensions.
        dt: seconds per step.

    Returns:
        The figure.

    Raises:
        ValueError: an array of another shape, or infinite values.
    """
    known = looks({"": rollouts})
    states = {
        word: numbers(word, given, f"T {len(names)}", f"S T {len(names)}")
        for word, given in rollouts.items()
    }
    rows = -(-len(names) // 2)
    figure = plt.figure(figsize=(WIDTH, max(2.6, 0.8 * rows + 0.4)))
    places = figure.add_gridspec(rows, 3, width_ratios=(1, 1, 1.25))
    for i, (name, unit) in enumerate(zip(names, units, strict=True)):
        ax = figure.add_subplot(places[i // 2, i % 2])
        for word, values in states.items():
            at = dt * np.arange(1, values.shape[-2] + 1)
            _lines(ax, at, values[..., i], *known[word], spread="lines", truth=word in TRUTH)
        last = i + 2 >= len(names)
        ax.set(ylabel=f"{name.replace('_', ' ')}\n({unit})", xlabel="time (s)" if last else "")
        ax.tick_params(labelbottom=last)
        ax.locator_params(axis="y", nbins=4)
        ax.set_xlim(0, None)
    figure.align_ylabels()
    plane = figure.add_subplot(places[:, 2])
    for body in (name[:-2] for name in names if name.endswith("_x") and f"{name[:-2]}_y" in names):
        x, y = names.index(f"{body}_x"), names.index(f"{body}_y")
        for word, values in states.items():
            look, _ = known[word]
            truth = word in TRUTH
            plane.plot(
                values[..., x].T,
                values[..., y].T,
                color=look.colour,
                lw=1.4 if truth else 0.8,
                alpha=1 if truth else _faint(values, 2),
                zorder=3 if truth else 2,
            )
        start = values.reshape(-1, len(names))[0]
        plane.plot(start[x], start[y], "o", color=DARK, ms=3, zorder=4)
        plane.annotate(body, (start[x], start[y]), (4, 4), textcoords="offset points", fontsize=6.5)
    plane.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", anchor="N")
    plane.margins(0.1)
    _legend(figure, known)
    return figure


def _faint(values: np.ndarray, single: int) -> float:
    """How opaque each of many lines is; ``single``: dimensions of an array that is one line."""
    return 1.0 if values.ndim == single else float(np.clip(3 / len(values), 0.12, 0.7))


def _lines(
    ax: Axes,
    at: np.ndarray,
    values: np.ndarray,
    look: Look,
    dashes: Dashes,
    *,
    spread: str,
    held: bool = False,
    truth: bool = False,
) -> None:
    """One series (T,) or (n, T): a line, a line in its band, or n faint lines."""
    order = 3 if truth else 2
    style = "steps-post" if held else "default"
    if spread == "lines" and values.ndim == 2:
        faint = _faint(values, 1)
        ax.plot(at, values.T, color=look.colour, lw=0.8, alpha=faint, drawstyle=style, zorder=order)
        return
    if values.ndim == 2:
        mean, half = np.array([interval(column[~np.isnan(column)]) for column in values.T]).T
        ax.fill_between(at, mean - half, mean + half, color=look.colour, alpha=0.15, lw=0)
        values = mean
    marker = look.marker if len(at) <= 12 and not (held or truth) else ""
    ax.plot(
        at,
        values,
        color=look.colour,
        ls=dashes,
        marker=marker,
        lw=1.3,
        drawstyle=style,
        zorder=order,
    )
    ax.grid(axis="y", color=GRID, lw=0.5)


def _legend(figure: Figure, known: Mapping[str, tuple[Look, Dashes]]) -> None:
    """What each line is, unless there is one without a name."""
    named = [(look, dashes) for look, dashes in known.values() if look.name]
    if named:
        legend(figure, [entry(look.name, look.colour, dashes) for look, dashes in named])
