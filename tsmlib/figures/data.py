"""Figures of the data and of learning: environments, torques, states, workspace coverage, loss curves (figure 4)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from tsmlib.figures.style import (
    COLOURS,
    _spell,
    colour,
    joint_legend,
    legend,
    name,
    panels,
    shaped,
    styled,
    tint,
    torques,
)


def _log_axis(ax: Axes, low: float, high: float) -> None:
    """A logarithmic y axis with plain numbers, and enough of them when it spans less than two decades."""
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 100 * low else (1.0,)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())


@styled
def figure4(images: Mapping[str, np.ndarray]) -> Figure:
    """The six environments (paper, figure 4): MuJoCo above, pymunk below.

    images: environment id -> picture (H, W, 3) uint8, three of each simulator, in the order they are to stand.
    """
    simulators = {"MuJoCo": [i for i in images if "pymunk" not in i.lower()],
                  "pymunk": [i for i in images if "pymunk" in i.lower()]}  # fmt: skip
    if any(len(ids) != 3 for ids in simulators.values()):
        raise ValueError(
            f"figure 4 shows three MuJoCo and three pymunk environments, got {', '.join(images) or 'none'}"
        )
    for env, image in images.items():
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(f"picture of {env} is {image.dtype} {image.shape}, expected uint8 (H, W, 3)")
    figure, axes = plt.subplots(2, 3, figsize=(5.2, 3.55), layout="compressed")
    for top, row, (simulator, ids) in zip((True, False), axes, simulators.items(), strict=True):
        for ax, env in zip(row, ids, strict=True):
            ax.imshow(images[env], interpolation="antialiased")
            ax.set(xticks=(), yticks=())
            ax.spines[:].set(visible=True, color="#BBBBBB")
            if top:
                ax.set_title(re.sub(r"^tsm/|-v\d+$|Reacher(?=[A-Z])", "", env))
        row[0].set_ylabel(simulator, fontsize=7.5)
    return figure


@styled
def torque_gallery(actions: np.ndarray, dt: float) -> Figure:
    """Smooth random torques, as the data were collected with: the first eight of ``actions`` (n, T, 2), dt in s."""
    actions = shaped("actions", actions, "n T 2")[:8]
    figure, axes = panels(len(actions), 4, 0.95, sharex=True, sharey=True)
    for ax, episode in zip(axes, actions, strict=True):
        torques(ax, episode, dt, COLOURS["data"], limit=float(np.abs(actions).max()) or 1.0)
    figure.supxlabel("time (s)", fontsize=7)
    figure.supylabel("torque (share of full)", fontsize=7)
    joint_legend(figure)
    return figure


@styled
def state_histograms(states: np.ndarray, names: Sequence[str], units: Sequence[str]) -> Figure:
    """What values the data hold: one histogram per state dimension of ``states`` (..., dx)."""
    flat = np.asarray(states, float).reshape(-1, np.shape(states)[-1])
    shaped("states", flat, f"n {len(names)}")
    if len(units) != len(names):
        raise ValueError(f"{len(names)} names and {len(units)} units, expected one of each per state dimension")
    figure, axes = panels(len(names), 5 if len(names) > 6 else 3, 1.05)
    for ax, values, word, unit in zip(axes, flat.T, names, units, strict=True):
        ax.hist(values, bins=int(np.clip(len(values) ** 0.5, 10, 60)), color=COLOURS["data"], alpha=0.75, linewidth=0)
        ax.set(xlabel=f"{_spell(word)} ({unit})", yticks=(), ylim=(0, None))
        ax.spines["left"].set_visible(False)
        ax.locator_params(axis="x", nbins=5)
    return figure


@styled
def workspace_coverage(tip: np.ndarray, reach: float | None = None) -> Figure:
    """Where the fingertip has been: ``tip`` (..., 2) in m, with the circle of radius ``reach`` (m) it cannot leave."""
    flat = shaped("tip", np.asarray(tip, float).reshape(-1, np.shape(tip)[-1]), "n 2")
    figure, ax = plt.subplots(figsize=(3.3, 2.8))
    edge = 1.08 * (reach or np.abs(flat).max())
    shades = ListedColormap(mpl.colormaps["Blues"](np.linspace(0.18, 1, 256)))  # one visit is not white
    bins = ax.hexbin(*flat.T, gridsize=60, mincnt=1, norm=LogNorm(), cmap=shades, linewidths=0.1, edgecolors="face",
                     extent=(-edge, edge, -edge, edge))  # fmt: skip
    if reach:
        ax.add_patch(Circle((0, 0), reach, fill=False, ec=COLOURS["data"], lw=0.7, ls="--"))
    ax.plot(0, 0, "+", color=COLOURS["oracle"], ms=5, mew=0.8)
    ax.set(xlabel="tip x (m)", ylabel="tip y (m)", aspect="equal", xlim=(-edge, edge), ylim=(-edge, edge))
    bar = figure.colorbar(bins, ax=ax, label="states per cell", shrink=0.8, aspect=25)
    bar.outline.set_visible(False)
    return figure


@styled
def loss_curves(curves: Mapping[str, Mapping[str, np.ndarray]]) -> Figure:
    """Training and validation loss, one panel per model.

    curves: label -> {"seconds" or "step": (n,), "train": (n,), "validation": (n,)}; NaN where nothing was
    measured. ``vars(curve)`` of what ``train.fit`` returned is one.
    """
    figure, axes = panels(len(curves), 4, 1.35)
    for ax, (label, curve) in zip(axes, curves.items(), strict=True):
        along = next((word for word in ("seconds", "step") if word in curve), None)
        if along is None:
            raise ValueError(f"loss curve of '{label}' has {', '.join(curve)}, expected 'seconds' or 'step' among them")
        x, main = shaped(f"{label}: {along}", curve[along], "n"), colour(label)
        losses = {key: shaped(f"{label}: {key}", curve[key], str(len(x))) for key in ("train", "validation")}
        for key, values in losses.items():
            seen = np.isfinite(values)
            shade, width = (tint(main), 0.8) if key == "train" else (main, 1.3)
            ax.plot(x[seen], values[seen], color=shade, lw=width)
        if np.isfinite(losses["validation"]).any():
            best = int(np.nanargmin(losses["validation"]))
            ax.plot(x[best], losses["validation"][best], "o", color=main, mec="white", mew=0.6, ms=4.5)
        if all(np.nanmin(values) > 0 for values in losses.values()):
            _log_axis(ax, min(np.nanmin(v) for v in losses.values()), max(np.nanmax(v) for v in losses.values()))
        ax.set(title=name(label), xlabel="training time (s)" if along == "seconds" else "training steps")
    axes[0].set_ylabel("loss")
    dark = COLOURS["data"]
    legend(figure, [Line2D([], [], color=tint(dark), lw=0.8, label="training"),
                     Line2D([], [], color=dark, lw=1.3, label="validation"),
                     Line2D([], [], color=dark, ls="", marker="o", mec="white", ms=4.5, label="kept")])  # fmt: skip
    return figure
