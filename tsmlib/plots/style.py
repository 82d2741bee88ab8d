"""Style of all figures: the style file, one name and one hue per model, legends, and files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from io import BytesIO
from pathlib import Path
from typing import ParamSpec

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from tsmlib import zoo
from tsmlib.storage.files import write_bytes
from tsmlib.zoo import Look

P = ParamSpec("P")
Dashes = str | tuple[int, tuple[float, ...]]  # matplotlib's
Panels = Mapping[str, Mapping[str, ArrayLike]]  # title -> word -> array

STYLE = str(Path(__file__).with_name("tsmlib.mplstyle"))
WIDTH = 7.0  # inches, the text width of a two-column page
DARK, NOTE, PALE, GRID = "#222222", "#555555", "#B0B0B0", "#E6E6E6"
BLUE, ORANGE, RED = "#0072B2", "#E69F00", "#D55E00"  # Okabe and Ito's, where no model is drawn
TRUTH = ("simulator", "executed")  # words that are drawn in black, above everything else
LABELS = ("#8E5FBF", "#17807E", "#A05A2C", "#8C8C8C", "#C05C8E")  # of other words
DASHES: tuple[Dashes, ...] = ("-", (0, (4, 1.5)), (0, (1, 1.2)), (0, (5, 1.2, 1, 1.2)))


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Run ``draw`` in the package's style and leave no figure open in pyplot."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        before = set(plt.get_fignums())
        try:
            with plt.style.context(STYLE):
                return draw(*args, **kwargs)
        finally:
            for number in set(plt.get_fignums()) - before:
                plt.close(number)

    return drawn


def save(figure: Figure, path: str | Path) -> Path:
    """Write a figure in one step; the same figure gives the same bytes on any day.

    Args:
        figure: what a function of ``tsmlib.plots`` returned.
        path: the file, which ends in .png, .svg or .pdf.

    Returns:
        The path.

    Raises:
        ValueError: another ending.
    """
    path = Path(path)
    undated: dict[str, dict[str, None]] = {
        ".png": {"Software": None},
        ".svg": {"Date": None, "Creator": None},
        ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    }
    if path.suffix not in undated:
        raise ValueError(f"{path} ends in {path.suffix!r}; expected .png, .svg or .pdf")
    drawn = BytesIO()  # the disk may be full
    with plt.style.context(STYLE):
        figure.savefig(drawn, format=path.suffix[1:], metadata=undated[path.suffix])
    write_bytes(path, drawn.getvalue())
    return path


def looks(panels: Panels) -> dict[str, tuple[Look, Dashes]]:
    """Name, hue and dashes of each word of some panels, in the order in which they are met.

    A word of ``tsmlib.zoo`` has the look of its model everywhere. What follows a comma tells uses
    of one model apart, by dashes: ``"rtsm, without prior"``.
    """
    found: dict[str, tuple[Look, Dashes]] = {}
    labels = 0
    for word in dict.fromkeys(word for series in panels.values() for word in series):
        model, comma, use = word.partition(", ")
        if model in TRUTH:
            known = Look(model, DARK)
        elif model in zoo.ZOO or model in zoo.LOOKS:
            known = zoo.look(model)
        else:
            known = Look(model, LABELS[labels % len(LABELS)])
            labels += 1
        same = sum(other.colour == known.colour for other, _ in found.values())
        name = f"{known.name}, {use}" if comma else known.name
        found[word] = Look(name, known.colour, known.marker), DASHES[same % len(DASHES)]
    return found


def numbers(name: str, value: ArrayLike, *shapes: str) -> np.ndarray:
    """``value`` as an array of floats, of one of some shapes such as ``"T"`` and ``"S T 2"``.

    Raises:
        ValueError: another shape, nothing in it, or an infinite value; NaN is a gap.
    """
    array = np.asarray(value, float)
    fits = any(
        array.ndim == len(sizes)
        and all(s.isalpha() or int(s) == n for s, n in zip(sizes, array.shape, strict=False))
        for sizes in (shape.split() for shape in shapes)
    )
    if not fits or not array.size:
        expected = " or ".join(f"({', '.join(shape.split())})" for shape in shapes)
        raise ValueError(f"{name} has shape {array.shape}; expected {expected}")
    if np.isinf(array).any():
        raise ValueError(f"{name} holds infinite values; leave them out or replace them by NaN")
    return array


def grid(
    panels: Panels, columns: int, height: float, *, share: str = "", width: float | None = None
) -> tuple[Figure, list[Axes]]:
    """A figure with one titled panel for each of ``panels``, ``height`` inches each.

    share: axes that all panels have in common, "x", "y" or "xy". width: inches; a single panel is
    narrower than the page without.
    """
    if not panels or not all(len(series) for series in panels.values()):
        raise ValueError("there is nothing to draw: panels, or one of them, is empty")
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    width = width or (WIDTH if columns > 1 else 0.7 * WIDTH)
    figure, axes = plt.subplots(
        rows,
        columns,
        figsize=(width, rows * height + 0.3),
        sharex="x" in share,
        sharey="y" in share,
        squeeze=False,
    )
    for ax in axes.flat[len(panels) :]:
        ax.remove()
    for ax, title in zip(axes.flat, panels, strict=False):
        ax.set_title(title)
    return figure, list(axes.flat[: len(panels)])


def entry(label: str, colour: str, dashes: Dashes = "-", marker: str = "") -> Line2D:
    """A line of a legend."""
    return Line2D([], [], label=label, color=colour, ls=dashes, marker=marker, ms=6)


def legend(figure: Figure, handles: Sequence[Line2D]) -> None:
    """A legend above all panels, in as many rows as the figure's width asks for."""
    for rows in range(1, len(handles) + 1):
        drawn = figure.legend(
            handles=handles, loc="outside upper left", ncols=-(-len(handles) // rows)
        )
        if drawn.get_window_extent().width <= figure.bbox.width or rows == len(handles):
            figure.set_figheight(figure.get_figheight() + 0.14 * rows)
            return
        drawn.remove()


def scene(ax: Axes) -> None:
    """Make ``ax`` a picture of the plane: equal scales, a thin frame, no numbers."""
    ax.set(aspect="equal", xticks=(), yticks=())
    ax.set_axis_on()
    ax.spines[:].set(visible=True, color="#CCCCCC")


def outer(figure: Figure, axes: Iterable[Axes], x_label: str, y_label: str) -> None:
    """Name the axes once: x below the lowest panels, y beside the whole figure."""
    for ax in axes:
        place = ax.get_subplotspec()
        if place is not None and place.is_last_row():
            ax.set_xlabel(x_label)
    if y_label:
        figure.supylabel(y_label, fontsize=7)
