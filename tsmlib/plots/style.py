"""Style of all figures: the style file, colours, legends, and files whose bytes do not change."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from functools import wraps
from io import BytesIO
from pathlib import Path
from typing import Any, ParamSpec

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tsmlib.storage.files import write_bytes

P = ParamSpec("P")
Props = dict[str, Any]  # keyword arguments of a matplotlib line

STYLE = str(Path(__file__).with_name("tsmlib.mplstyle"))
WIDTH = 7.0  # inches: the text width of a two-column journal page
BLUE, ORANGE, RED = "#0072B2", "#E69F00", "#D55E00"  # Okabe and Ito's, where no method is drawn
DARK, NOTE, PALE, GRID = (
    "#4A4A4A",
    "#555555",
    "#B0B0B0",
    "#EEEEEE",
)  # data and simulator, small words, lines behind
DASHED = (0, (3, 1.5))
JOINTS = ("shoulder", "elbow")


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Run ``draw`` in the package's style and leave no figure open in pyplot, whether it returns or raises."""

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


def save(figure: Figure, stem: str | Path) -> tuple[Path, Path]:
    """Write ``<stem>.pdf`` and ``<stem>.png``, each in one step; the same figure gives the same bytes, on any day."""
    pdf, png = Path(f"{stem}.pdf"), Path(f"{stem}.png")
    none: dict[Path, dict[str, None]] = {
        pdf: {"CreationDate": None, "Creator": None, "Producer": None},
        png: {"Software": None},
    }
    for path, metadata in none.items():
        _write(figure, path, metadata)
    return pdf, png


def save_svg(figure: Figure, path: Path) -> Path:
    """Write an SVG file in one step, its words as words; the same figure gives the same bytes, on any day."""
    _write(figure, path, {"Date": None, "Creator": None})
    return path


def _write(figure: Figure, path: Path, metadata: dict[str, None]) -> None:
    drawn = BytesIO()  # the disk may be full
    with plt.style.context(STYLE):
        figure.savefig(drawn, format=path.suffix[1:], metadata=metadata)
    write_bytes(path, drawn.getvalue())


def tint(colour: str, share: float = 0.5) -> tuple[float, float, float]:
    """``colour`` mixed with white; the elbow is drawn in the shoulder's colour, lighter."""
    red, green, blue = (1 - share * (1 - part) for part in to_rgb(colour))
    return red, green, blue


def panels(
    count: int,
    columns: int,
    height: float,
    *,
    width: float = WIDTH,
    head: float = 0.35,
    **options: Any,
) -> tuple[Figure, list[Axes]]:
    """A figure of ``count`` axes in rows of ``columns``, each ``height`` inches; unused places stay empty."""
    columns = min(columns, count)
    rows = -(-count // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(width, rows * height + head), squeeze=False, **options
    )
    for ax in axes.flat[count:]:
        ax.remove()
    return figure, list(axes.flat[:count])


def entry(label: str, **look: Any) -> Line2D:
    """A line of a legend."""
    return Line2D([], [], **look, label=label)


def legend(figure: Figure, handles: Sequence[Line2D], columns: int = 8) -> int:
    """A legend above all panels, where it covers nothing, of no more columns than its rows need and fewer where these
    are wider than the figure; the number of rows."""
    rows = max(1, -(-len(handles) // columns))
    while True:
        columns = -(-len(handles) // rows) or 1
        drawn = figure.legend(handles=handles, loc="outside upper left", ncols=columns)
        if columns == 1 or drawn.get_window_extent().width <= figure.bbox.width:
            return rows
        drawn.remove()
        rows += 1


def stamp(figure: Figure, text: str) -> Figure:
    """The figure with a line below everything that says where its numbers are from."""
    lines = textwrap.wrap(text, int(figure.get_figwidth() / 0.056))
    with plt.style.context(STYLE):
        if lines:
            figure.set_figheight(figure.get_figheight() + 0.12 * len(lines) + 0.06)
            told = entry("\n".join(lines), ls="")
            figure.legend(
                handles=[told],
                loc="outside lower left",
                handlelength=0,
                handletextpad=0,
                labelcolor=NOTE,
            )
    return figure


def joint_legend(figure: Figure, main: str = DARK) -> None:
    """Which line is the shoulder's and which the elbow's."""
    legend(figure, [entry(JOINTS[0], color=main), entry(JOINTS[1], color=tint(main))])


def note(ax: Axes, text: str, x: float, y: float) -> None:
    """Small words inside a panel, at shares of its width and height, set towards its middle."""
    ax.annotate(
        text,
        (x, y),
        xycoords="axes fraction",
        ha="left" if x < 0.5 else "right",
        va="bottom" if y < 0.5 else "top",
        fontsize=6.5,
        color=NOTE,
    )


def above(ax: Axes, text: str, x: float) -> None:
    """Small words on the upper edge of a panel, to the right of its left end (x = 0) or to the left of its right."""
    ax.annotate(
        text,
        (x, 1),
        (0, 1),
        xycoords="axes fraction",
        textcoords="offset points",
        fontsize=6.5,
        color=NOTE,
        ha="right" if x else "left",
        va="bottom",
    )


def scene(ax: Axes) -> None:
    """A picture of the plane, framed and without numbers."""
    ax.set(aspect="equal", xticks=(), yticks=())
    ax.set_axis_on()
    ax.spines[:].set(visible=True, color="#CCCCCC")


def rows_only(ax: Axes) -> None:
    """No line and no ticks on the left: the rows have names."""
    ax.spines["left"].set_visible(False)
    ax.tick_params(axis="y", length=0)


def torques(ax: Axes, actions: np.ndarray, dt: float, main: str, limit: float = 1.0) -> None:
    """Both torques of one episode, actions (T, 2), as the arm gets them: constant over each step."""
    seconds = np.arange(len(actions) + 1) * dt
    for joint, shade, order in ((1, tint(main), 2), (0, main, 3)):
        held = np.append(actions[:, joint], actions[-1, joint])
        ax.step(seconds, held, where="post", color=shade, zorder=order)
    ax.set(xlim=(0, seconds[-1]), ylim=(-1.08 * limit, 1.08 * limit))
    ax.locator_params(nbins=4)
    ax.axhline(0, color="#DDDDDD", lw=0.5, zorder=0)


def torque_labels(figure: Figure) -> None:
    """The axes that all panels of torques share; time below each of the lowest, not where the stamp stands."""
    for ax in figure.axes:
        if (place := ax.get_subplotspec()) and place.is_last_row():
            ax.set_xlabel("time (s)")
    figure.supylabel("torque (share of full)", fontsize=7)
