"""What a latent code says: one line per code, coloured along a walk through the codes."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from tsmlib.plots.style import grid, numbers, scene, styled


@styled
def codes(
    panels: Mapping[str, ArrayLike],
    values: ArrayLike,
    *,
    label: str = "",
    x_label: str = "",
    y_label: str = "",
    dt: float = 0.02,
    columns: int = 3,
) -> Figure:
    """What decoding a row of codes gives, from the first code (dark) to the last (light).

    Args:
        panels: title -> one line per code, (n, T) against time or (n, T, 2) in the plane.
        values: what the colour stands for, such as a coordinate of the code (n,).
        label: name of ``values``.
        x_label: what stands along x in panels against time.
        y_label: what stands along y in panels against time.
        dt: seconds per step.
        columns: panels in a row.

    Returns:
        The figure.

    Raises:
        ValueError: an array of another shape, or infinite values.
    """
    at = numbers("values", values, "n")
    figure, axes = grid({title: {"": lines} for title, lines in panels.items()}, columns, 1.9)
    scale = Normalize(at.min(), at.max() if at.max() > at.min() else at.min() + 1)
    hues = mpl.colormaps["viridis"](0.9 * scale(at))
    for ax, (title, given) in zip(axes, panels.items(), strict=True):
        lines = numbers(f"panel {title!r}", given, f"{len(at)} T", f"{len(at)} T 2")
        for line, hue in zip(lines, hues, strict=True):
            if lines.ndim == 2:
                held = np.append(line, line[-1])
                ax.step(dt * np.arange(len(held)), held, where="post", color=hue, lw=1.2)
            else:
                ax.plot(*line.T, color=hue, lw=1.2)
                ax.plot(*line[-1], "o", color=hue, ms=3, mew=0)
        if lines.ndim == 2:
            ax.set(xlabel=x_label or "time (s)", ylabel=y_label)
        else:
            scene(ax)
            ax.margins(0.1)
    bar = figure.colorbar(
        mpl.cm.ScalarMappable(
            scale, mpl.colors.ListedColormap(mpl.colormaps["viridis"](np.linspace(0, 0.9, 256)))
        ),
        ax=axes,
        label=label,
        aspect=30,
    )
    bar.outline.set_visible(False)
    return figure
