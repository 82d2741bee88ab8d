"""Paths in the plane, and pictures in rows."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from tsmlib.plots.style import (
    DARK,
    RED,
    TRUTH,
    Panels,
    entry,
    grid,
    legend,
    looks,
    numbers,
    scene,
    styled,
)


@styled
def paths(
    panels: Panels,
    *,
    target: Mapping[str, ArrayLike] | ArrayLike | None = None,
    opacity: float | None = None,
    columns: int = 3,
) -> Figure:
    """Ways in the plane, one path or many for each word; a dot where each ends.

    Args:
        panels: title -> word -> positions in m, (T, 2) or (S, T, 2).
        target: where something should end (2,), in m; or title -> (2,).
        opacity: of each of many paths, from 0 to 1; by default the more there are the fainter.
        columns: panels in a row.

    Returns:
        The figure.

    Raises:
        ValueError: an array of another shape, or infinite values.
    """
    known = looks(panels)
    side = 7.0 / max(2, min(columns, len(panels)))
    figure, axes = grid(panels, columns, side, share="", width=side * min(columns, len(panels)))
    for ax, (title, series) in zip(axes, panels.items(), strict=True):
        for word, given in series.items():
            ways = numbers(f"{word} of panel {title!r}", given, "T 2", "S T 2").reshape(
                -1, np.shape(given)[-2], 2
            )
            look, dashes = known[word]
            truth = word in TRUTH
            faint = float(np.clip(4 / len(ways), 0.12, 0.8)) if opacity is None else opacity
            alpha = 1.0 if truth or len(ways) == 1 else faint
            width, order = (1.6, 6) if truth else (1.1, 5)
            lines = ax.plot(*ways.T, lw=width, ls=dashes)
            lines += ax.plot(*ways[:, -1].T, "o", ms=3.5 if truth else 2.5, mew=0)
            for line in lines:
                line.set(color=look.colour, alpha=alpha, zorder=order)
        goal = target.get(title) if isinstance(target, Mapping) else target
        if goal is not None:
            ax.plot(*numbers("target", goal, "2"), "+", color=RED, ms=9, mew=1.6, zorder=7)
        scene(ax)
        ax.set_aspect("equal", adjustable="datalim")  # all pictures are squares
    handles = [
        entry(look.name, look.colour, dashes) for look, dashes in known.values() if look.name
    ]
    if target is not None:
        handles.append(entry("target", RED, "", "+"))
    if handles:
        legend(figure, handles)
    return figure


@styled
def pictures(panels: Mapping[str, Mapping[str, ArrayLike]]) -> Figure:
    """Pictures in rows and columns: environments, or frames of a film.

    Args:
        panels: name of a row -> title of a column -> picture (H, W, 3) uint8.

    Returns:
        The figure.

    Raises:
        ValueError: rows of different lengths, or something else than a picture.
    """
    across = {row: len(images) for row, images in panels.items()}
    if len(set(across.values())) != 1 or not all(across.values()):
        raise ValueError(f"rows hold {across or 'nothing'}; expected equally many pictures in each")
    columns = next(iter(across.values()))
    side = min(1.9, 6.8 / columns)
    figure, axes = plt.subplots(
        len(panels),
        columns,
        figsize=(0.2 + side * columns, 0.2 + side * len(panels)),
        layout="compressed",
        squeeze=False,
    )
    for line, (row, images) in zip(axes, panels.items(), strict=True):
        for ax, (title, given) in zip(line, images.items(), strict=True):
            image = np.asarray(given)
            if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
                raise ValueError(
                    f"picture {title!r} of row {row!r} is {image.dtype} {image.shape}; expected "
                    "uint8 (H, W, 3)"
                )
            ax.imshow(image, interpolation="antialiased")
            scene(ax)
            ax.set_title(title, color=DARK)
        line[0].set_ylabel(row, fontsize=7.5)
    return figure
