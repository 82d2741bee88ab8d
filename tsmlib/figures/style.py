"""How every figure looks: the style file, one colour per method, labels, and files whose bytes do not change.

A label names what was run in the words of the metrics table, model first: ``"tsm codes cem"``, ``"onestep actions
adam"``, ``"tsm+energy"``, ``"oracle"``. Its first word gives the colour.
"""

from __future__ import annotations

import re
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
from numpy.typing import ArrayLike

from tsmlib.storage.files import write_bytes

P = ParamSpec("P")

STYLE = str(Path(__file__).with_name("tsm.mplstyle"))
WIDTH = 7.0  # inches: the text width of a two-column journal page

# Okabe and Ito's colours, told apart with any colour vision; greys for what is no method.
COLOURS = {
    "tsm": "#0072B2",
    "tsm+energy": "#56B4E9",
    "tsm+energy+direct": "#003C8F",
    "tsm+teacher": "#1B2A5C",
    "onestep": "#E69F00",
    "multistep": "#D55E00",
    "lstm": "#009E73",
    "ensemble": "#CC79A7",
    "ensemble+mse": "#6A2BD9",
    "prior": "#882255",
    "ppo": "#999933",
    "trpo": "#7B4B2A",
    "oracle": "#111111",
    "random": "#7A7A7A",
    "zero": "#B0B0B0",
    "data": "#4A4A4A",
    "filter": "#B03A2E",
}
NAMES = {
    "tsm": "TSM",
    "tsm+energy": "TSM + energy",
    "tsm+energy+direct": "TSM + energy + direct",
    "tsm+teacher": "TSM, teacher forcing only",
    "onestep": "one-step",
    "multistep": "multi-step",
    "lstm": "LSTM",
    "ensemble": "ensemble (Gaussian)",
    "ensemble+mse": "ensemble (squared error)",
    "prior": "action prior",
    "ppo": "PPO",
    "trpo": "TRPO",
    "random": "random torques",
    "zero": "zero torque",
    "filter": "Kalman filter",
}
JOINTS = ("shoulder", "elbow")


def use_style() -> None:
    """Draw everything that follows, the caller's own plots too, in the style of the package."""
    plt.style.use(STYLE)


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
        pdf: {"CreationDate": None, "Creator": None, "Producer": None}, png: {"Software": None}
    }  # fmt: skip
    for path, metadata in none.items():
        drawn = BytesIO()  # the disk may be full
        with plt.style.context(STYLE):
            figure.savefig(drawn, format=path.suffix[1:], metadata=metadata)
        write_bytes(path, drawn.getvalue())
    return pdf, png


def words(label: str) -> tuple[str, str]:
    """Split a label into its model, a key of COLOURS, and the rest: ``"tsm codes cem"`` -> ``("tsm", "codes cem")``."""
    model, _, rest = re.sub(r"[\s,/|]+", " ", label.strip()).partition(" ")
    if model not in COLOURS:
        raise ValueError(f"label '{label}' starts with '{model}', expected one of {', '.join(COLOURS)}")
    return model, rest


def colour(label: str) -> str:
    """The colour of a method, from the first word of its label."""
    return COLOURS[words(label)[0]]


def name(label: str) -> str:
    """A label as the reader meets it: ``"onestep codes cem"`` -> ``"one-step, codes, CEM"``."""
    model, rest = words(label)
    return ", ".join([NAMES.get(model, model), *pretty(rest)])


def pretty(rest: str) -> list[str]:
    """The words after the model as they are printed: each known word alone, the others together."""
    known = {
        "codes": "codes",
        "actions": "actions",
        "adam": "Adam",
        "adam+starts": "Adam from samples",
        "cem": "CEM",
        "mppi": "MPPI",
        "policy": "policy",
    }
    parts = [known.get(word, word) for word in rest.split() if word in known]
    other = " ".join(word for word in rest.split() if word not in known)
    return [*parts, other] if other else parts


def shaped(field: str, values: ArrayLike, shape: str) -> np.ndarray:
    """``values`` as floats, checked against a shape written as in the docstrings: letters are free, numbers fixed."""
    array, want = np.asarray(values, dtype=float), shape.split()
    if array.ndim != len(want) or any(w.isdigit() and int(w) != s for w, s in zip(want, array.shape, strict=True)):
        raise ValueError(f"{field} has shape {array.shape}, expected ({', '.join(want)})")
    if 0 in array.shape:
        raise ValueError(f"{field} has shape {array.shape}: nothing to draw")
    return array


def tint(colour: str, share: float = 0.5) -> tuple[float, float, float]:
    """``colour`` mixed with white; the elbow is drawn in the shoulder's colour, lighter."""
    red, green, blue = (1 - share * (1 - part) for part in to_rgb(colour))
    return red, green, blue


def panels(count: int, columns: int, height: float, **options: Any) -> tuple[Figure, list[Axes]]:
    """A figure of ``count`` axes in rows of ``columns``, each ``height`` inches; unused places stay empty."""
    columns = min(columns, count)
    rows = -(-count // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(WIDTH, rows * height + 0.35), squeeze=False, **options)
    for ax in axes.flat[count:]:
        ax.remove()
    return figure, list(axes.flat[:count])


def legend(figure: Figure, handles: Sequence[Line2D], columns: int = 8) -> None:
    """A legend above all panels, where it covers nothing."""
    figure.legend(handles=handles, loc="outside upper left", ncols=min(columns, len(handles)))


def joint_legend(figure: Figure, main: str = COLOURS["data"]) -> None:
    """Which line is the shoulder's and which the elbow's."""
    legend(figure, [Line2D([], [], color=main, label=JOINTS[0]), Line2D([], [], color=tint(main), label=JOINTS[1])])


def torques(ax: Axes, actions: np.ndarray, dt: float, main: str, limit: float = 1.0) -> None:
    """Both torques of one episode, actions (T, 2), as the arm gets them: constant over each step."""
    seconds = np.arange(len(actions) + 1) * dt
    for joint, shade, order in ((1, tint(main), 2), (0, main, 3)):
        held = np.append(actions[:, joint], actions[-1, joint])
        ax.step(seconds, held, where="post", color=shade, zorder=order)
    ax.set(xlim=(0, seconds[-1]), ylim=(-1.08 * limit, 1.08 * limit))
    ax.locator_params(axis="y", nbins=4)
    ax.locator_params(axis="x", nbins=4)
    ax.axhline(0, color="#DDDDDD", lw=0.5, zorder=0)


def label(model: str, planner: str, prior: str) -> str:
    """A method in one line, as figures name it: ``tsm codes cem``, ``zero``."""
    return planner if model == "none" else f"{model} {prior} {planner}"


def _spell(word: str) -> str:
    """A state dimension in words: ``joint0_vel`` -> ``joint0 velocity``."""
    return word.replace("_", " ").replace(" vel", " velocity")
