"""One function per figure: arrays in, a matplotlib figure out.

Every function draws in the style of ``tsm.mplstyle`` and returns its ``Figure`` with nothing left open in pyplot: as
the last line of a notebook cell it shows once, and ``save`` writes it. Here are the figures of data and of learning;
those of predictions are in ``tsmlib.predict_figures``, of codes in ``tsmlib.latent_figures``, of plans and policies in
``tsmlib.plan_figures`` and ``tsmlib.policy_figures``, of the action prior in ``tsmlib.prior_figures``, the diagrams of
the paper's figures 1-3 in ``tsmlib.diagrams``, films in ``tsmlib.film``, colours and labels in ``tsmlib.style``: all
are reached from here.

Letters in shapes: n episodes, T steps, S samples, dx state size, H and W pixels.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from tsmlib.diagrams import figure1, figure2, figure3  # noqa: F401
from tsmlib.film import embed, side_by_side, video  # noqa: F401
from tsmlib.gallery import gallery  # noqa: F401
from tsmlib.latent_figures import (  # noqa: F401
    around_touch,
    code_grid,
    code_use,
    contact_recall,
    deflection_intervals,
    embedding,
    figure9,
    one_code,
    spread_against_error,
    walk,
)
from tsmlib.plan_figures import (  # noqa: F401
    along_the_way,
    figure6,
    final_distances,
    plan_actions,
    plan_paths,
    plan_strip,
    predicted_vs_true,
)
from tsmlib.policy_figures import figure7  # noqa: F401
from tsmlib.predict_figures import against_horizon, calibration, differences, figure5  # noqa: F401
from tsmlib.prior_figures import cost_of_prior, figure10, prior_walks, spectra  # noqa: F401
from tsmlib.robust_figures import advantage_map, figure8, filtering, imperfect_episode  # noqa: F401
from tsmlib.style import (  # noqa: F401
    COLOURS,
    WIDTH,
    colour,
    joint_legend,
    legend,
    name,
    panels,
    save,
    shaped,
    styled,
    tint,
    torques,
    use_style,
    words,
)

LINES = ("-", "--", "-.", ":")


def _spell(word: str) -> str:
    """A state dimension in words: ``joint0_vel`` -> ``joint0 velocity``."""
    return word.replace("_", " ").replace(" vel", " velocity")


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


@styled
def ll_against_horizon(curves: Mapping[str, np.ndarray], ylabel: str = "log-likelihood per step") -> Figure:
    """A score at every step ahead, label -> (T,); a second label of the same model is drawn dashed."""
    figure, ax = plt.subplots(figsize=(3.6, 2.3))
    drawn: dict[str, int] = {}
    for label, curve in curves.items():
        values, model = shaped(label, curve, "T"), words(label)[0]
        line = LINES[drawn.get(model, 0) % len(LINES)]
        drawn[model] = drawn.get(model, 0) + 1
        ax.plot(np.arange(1, len(values) + 1), values, ls=line, color=colour(label), label=name(label))
    ax.set(xlabel="steps ahead", ylabel=ylabel)
    legend(figure, ax.get_legend_handles_labels()[0], columns=3)  # type: ignore[arg-type]
    return figure


@styled
def rollouts(
    true: np.ndarray, predicted: np.ndarray, names: Sequence[str], units: Sequence[str] | None = None, *,
    dt: float = 0.02, label: str = "tsm",
) -> Figure:  # fmt: skip
    """Predicted samples over the truth, per state dimension against time and as paths in the plane.

    true: (T, dx); predicted: (S, T, dx); dt in s; label: whose prediction it is. Dimensions named ``<word>_x`` and
    ``<word>_y`` give a path in the plane.
    """
    true = shaped("true", true, f"T {len(names)}")
    predicted = shaped("predicted", predicted, f"S {len(true)} {len(names)}")
    seconds, main, rows = np.arange(1, len(true) + 1) * dt, colour(label), -(-len(names) // 2)
    faint: dict[str, Any] = {"color": main, "alpha": max(0.12, min(0.7, 3 / len(predicted))), "lw": 0.8}
    figure = plt.figure(figsize=(WIDTH, max(2.6, 0.82 * rows + 0.5)))
    grid = figure.add_gridspec(rows, 3, width_ratios=(1, 1, 1.25))
    for i, word in enumerate(names):
        ax = figure.add_subplot(grid[i // 2, i % 2])
        ax.plot(seconds, predicted[:, :, i].T, **faint)
        ax.plot(seconds, true[:, i], color=COLOURS["data"], lw=1.2)
        ax.set_ylabel(_spell(word) + (f"\n({units[i]})" if units else ""))
        ax.locator_params(axis="y", nbins=4)
        ax.set_xlim(0, seconds[-1])
        if i + 2 >= len(names):
            ax.set_xlabel("time (s)")
        else:
            ax.tick_params(labelbottom=False)
    figure.align_ylabels()
    plane = figure.add_subplot(grid[:, 2])
    paths = [word[:-2] for word in names if word.endswith("_x") and f"{word[:-2]}_y" in names]
    for word in paths:
        x, y = names.index(f"{word}_x"), names.index(f"{word}_y")
        plane.plot(predicted[:, :, x].T, predicted[:, :, y].T, **faint)
        plane.plot(true[:, x], true[:, y], color=COLOURS["data"], lw=1.4)
        plane.plot(true[0, x], true[0, y], "o", color=COLOURS["data"], ms=3)
        plane.annotate(word, (true[0, x], true[0, y]), (4, 4), textcoords="offset points", fontsize=6.5)
    plane.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", anchor="N")
    plane.margins(0.1)
    legend(figure, [Line2D([], [], color=COLOURS["data"], lw=1.2, label="simulator"),
                     Line2D([], [], color=main, lw=0.8, label=f"{name(label)}, {len(predicted)} samples")])  # fmt: skip
    return figure
