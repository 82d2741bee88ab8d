"""Figures of the data and of learning: environments, torques, states, workspace coverage, loss curves (figure 4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import NullLocator

from tsmlib.plots import style
from tsmlib.plots.axes import dimension, log_axis, wrapped
from tsmlib.plots.checks import shaped
from tsmlib.plots.method import Method
from tsmlib.plots.style import DARK, entry, legend, panels, styled, tint


@styled
def figure4(images: Mapping[str, Mapping[str, np.ndarray]]) -> Figure:
    """The environments (paper, figure 4), a row per simulator: simulator -> environment -> picture (H, W, 3) uint8."""
    if len({len(row) for row in images.values()}) != 1 or not all(images.values()):
        found = ", ".join(f"{len(row)} of {simulator}" for simulator, row in images.items())
        raise ValueError(
            f"figure 4 shows equally many environments of each simulator, got {found or 'none'}"
        )
    for simulator, row in images.items():
        for env, image in row.items():
            if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
                raise ValueError(
                    f"picture of {simulator}, {env} is {image.dtype} {image.shape}, expected uint8 (H, W, 3)"
                )
    down, across = len(images), len(next(iter(images.values())))
    figure, grid = plt.subplots(
        down,
        across,
        figsize=(0.1 + 1.7 * across, 0.15 + 1.7 * down),
        layout="compressed",
        squeeze=False,
    )
    for i, (axes, (simulator, row)) in enumerate(zip(grid, images.items(), strict=True)):
        for ax, (env, image) in zip(axes, row.items(), strict=True):
            ax.imshow(image, interpolation="antialiased")
            style.scene(ax)
            ax.set_title("" if i else env)
        axes[0].set_ylabel(simulator, fontsize=7.5)
    return figure


@styled
def torque_gallery(actions: np.ndarray, dt: float) -> Figure:
    """Smooth random torques, as the data were collected with: the first eight of ``actions`` (n, T, 2), dt in s."""
    actions = shaped("actions", actions, "n T 2")[:8]
    figure, axes = panels(len(actions), 4, 0.95, sharex=True, sharey=True)
    for ax, episode in zip(axes, actions, strict=True):
        style.torques(ax, episode, dt, DARK, limit=float(np.abs(actions).max()) or 1.0)
    style.torque_labels(figure)
    style.joint_legend(figure)
    return figure


@styled
def state_histograms(states: np.ndarray, names: Sequence[str], units: Sequence[str]) -> Figure:
    """Distribution of the data: one histogram per state dimension of ``states`` (..., dx), lengths in cm.

    Where one bin holds most states, heights are logarithmic."""
    flat = shaped(
        "states", np.asarray(states, float).reshape(-1, np.shape(states)[-1]), f"n {len(names)}"
    )
    if len(units) != len(names):
        raise ValueError(
            f"{len(names)} names and {len(units)} units, expected one of each per state dimension"
        )
    figure, axes = panels(len(names), 5 if len(names) > 6 else 3, 1.05)
    for ax, values, word, unit in zip(axes, flat.T, names, units, strict=True):
        values, unit = (100 * values, "cm") if unit == "m" else (values, unit)
        bins = int(np.clip(len(values) ** 0.5, 10, 60))
        ax.hist(values, bins=bins, color=DARK, alpha=0.75, linewidth=0)
        label, ylim = f"{dimension(word)} ({unit})", (0.0, None)
        if np.histogram(values, bins)[0].max() > len(values) / 2:  # else it would hide all others
            ax.set_yscale("log")
            ax.yaxis.set_minor_locator(NullLocator())
            label, ylim = f"{label}\nheights logarithmic", (0.5, None)
        ax.set(xlabel=label, yticks=(), ylim=ylim)
        style.rows_only(ax)
        ax.locator_params(axis="x", nbins=5)
    return figure


@styled
def workspace_coverage(tip: np.ndarray, reach: float | None = None) -> Figure:
    """Visits of the fingertip: ``tip`` (..., 2) in m, with the circle of radius ``reach`` (m) that it cannot leave;
    drawn in cm."""
    flat = 100 * shaped("tip", np.asarray(tip, float).reshape(-1, np.shape(tip)[-1]), "n 2")
    figure, ax = plt.subplots(figsize=(3.3, 2.95))
    edge = 1.08 * (100 * reach if reach else np.abs(flat).max())
    shades = ListedColormap(
        mpl.colormaps["Blues"](np.linspace(0.18, 1, 256))
    )  # one visit is not white
    bins = ax.hexbin(
        *flat.T,
        gridsize=60,
        mincnt=1,
        norm=LogNorm(),
        cmap=shades,
        linewidths=0.1,
        edgecolors="face",
        extent=(-edge, edge, -edge, edge),
    )
    if reach:
        ax.add_patch(Circle((0, 0), 100 * reach, fill=False, ec=DARK, lw=0.7, ls="--"))
    (shoulder,) = ax.plot(0, 0, "+", color="black", ms=5, mew=0.8, label="shoulder")
    legend(
        figure,
        [*([entry("reach of the arm", color=DARK, lw=0.7, ls="--")] if reach else []), shoulder],
    )
    ax.set(
        xlabel="fingertip x (cm)",
        ylabel="fingertip y (cm)",
        aspect="equal",
        xlim=(-edge, edge),
        ylim=(-edge, edge),
    )
    bar = figure.colorbar(bins, ax=ax, label="states per cell", shrink=0.8, aspect=25)
    bar.outline.set_visible(False)
    return figure


@styled
def loss_curves(curves: Mapping[Method, Mapping[str, np.ndarray]]) -> Figure:
    """Training and validation loss, one panel per method.

    curves: method -> {"seconds" or "step": (n,), "train": (n,), "validation": (n,)}; NaN where nothing was measured.
    ``vars(curve)`` of what ``training.fit`` returned is one.
    """
    across = min(
        len(curves), min((4, 3), key=lambda columns: -len(curves) % columns)
    )  # few places stay empty
    figure, axes = panels(len(curves), across, 1.5)
    for ax, (method, given) in zip(axes, curves.items(), strict=True):
        along = next((word for word in ("seconds", "step") if word in given), None)
        if along is None:
            raise ValueError(
                f"loss curve of '{method.label}' has {', '.join(given)}, expected 'seconds' or 'step' among them"
            )
        x, main = shaped(f"{method.label}: {along}", given[along], "n"), method.look.colour
        train, held = (
            shaped(f"{method.label}: {key}", given[key], str(len(x)))
            for key in ("train", "validation")
        )
        for values, shade, width in ((train, tint(main), 0.8), (held, main, 1.3)):
            ax.plot(x[np.isfinite(values)], values[np.isfinite(values)], color=shade, lw=width)
        if np.isfinite(held).any():
            best = int(np.nanargmin(held))
            ax.plot(x[best], held[best], "o", color=main, mec="white", mew=0.6, ms=4.5)
        both = np.concatenate([train, held])
        if np.nanmin(both) > 0:
            log_axis(ax, float(np.nanmin(both)), float(np.nanmax(both)))
        title = wrapped(method.label, style.WIDTH / across - 0.3)
        ax.set(title=title, xlabel="training time (s)" if along == "seconds" else "training steps")
    axes[0].set_ylabel("loss")
    legend(
        figure,
        [
            entry("training", color=tint(DARK), lw=0.8),
            entry("validation", color=DARK, lw=1.3),
            entry("kept", color=DARK, ls="", marker="o", mec="white", ms=4.5),
        ],
    )
    return figure
