"""Figures of noisy sensors and delayed actions: the paper's figure 8 and what surrounds it (section 5.3.3).

Reached through ``tsmlib.figures``. Letters in shapes: k copies or seeds, R records of a learning curve, T steps,
K steps predicted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tsmlib.axes import finish, finite, looks
from tsmlib.policy_figures import LearningCurves, draw_policies
from tsmlib.style import COLOURS, WIDTH, interval, legend, name, styled, tint


@styled
def figure8(curves: LearningCurves, references: Mapping[str, float] | None = None) -> Figure:
    """Learning curves of policies with noise and with delay beside the clean arm (paper, figure 8), one scale for all.

    curves: condition -> label -> {"return_true": (k, R), "iterations": (R,)}; references: label -> return, drawn as
    lines in every panel, labels starting with zero or random. Lines are means, bands their 95 % t intervals.
    """
    return draw_policies(curves, dict.fromkeys(curves, references or {}), ("iterations",), sharey=True)


@styled
def imperfect_episode(
    clean: np.ndarray, noisy: np.ndarray, taken: np.ndarray, applied: np.ndarray, *, titles: Sequence[str], dt: float
) -> Figure:
    """What the sensors say and what arrives at the joints, in one episode.

    clean, noisy (T + 1, P): some dimensions of the true and of the observed state, one panel each, titled ``titles``
    (P,) with units; taken, applied (T,): the torque of one joint as it was sent and as it arrived; dt: s per step.
    """
    clean, noisy = finite("clean", clean, "T P"), finite("noisy", noisy, "T P")
    figure, axes = plt.subplots(1, len(titles) + 1, figsize=(WIDTH, 1.7), layout="constrained")
    at = np.arange(len(clean)) * dt
    for ax, title, truth, seen in zip(axes, titles, clean.T, noisy.T, strict=False):
        ax.plot(at, seen, ".", ms=3, color=tint(COLOURS["tsm"], 0.6), mew=0)
        ax.plot(at, truth, color=COLOURS["data"], lw=1.1)
        ax.set(title=title, xlabel="time (s)")
    ax = axes[-1]
    ax.step(at[:-1], taken, where="post", color=COLOURS["onestep"], lw=1.0)
    ax.step(at[:-1], applied, where="post", color=COLOURS["data"], lw=1.1)
    ax.set(title="shoulder torque (share of full)", xlabel="time (s)")
    entries = [
        Line2D([], [], color=COLOURS["data"], label="true state; torque that arrives"),
        Line2D([], [], color=tint(COLOURS["tsm"], 0.6), ls="", marker=".", label="what the sensors say"),
        Line2D([], [], color=COLOURS["onestep"], label="torque that is sent"),
    ]
    legend(figure, entries)
    return figure


@styled
def filtering(
    ahead: Mapping[str, Mapping[str, np.ndarray]], now: Mapping[str, Mapping[str, float]], raw: Mapping[str, float]
) -> Figure:
    """Errors to the clean state after a noisy past, against the raw observation's.

    ahead: panel -> label -> (k, K), the error of each seed 1 .. K steps ahead; now: panel -> filter or exponential ->
    the error of what it takes the present state for, at 0 steps; raw: panel -> the raw observation's.
    """
    look = looks(dict.fromkeys(label for rows in ahead.values() for label in rows))
    figure, axes = plt.subplots(1, len(ahead), figsize=(WIDTH, 2.1), sharey=True, squeeze=False)
    for ax, (title, rows) in zip(axes[0], ahead.items(), strict=True):
        checked = {label: finite(f"{title}, {label}", row, "k K") for label, row in rows.items()}
        means = np.concatenate([row.mean(0) for row in checked.values()])
        top = max(1.25 * raw[title], 1.05 * float(np.quantile(means, 0.9)))
        ax.axhline(raw[title], color=COLOURS["zero"], ls="--", lw=1, zorder=1)
        for label, row in checked.items():
            mean, half = np.array([interval(values) for values in row.T]).T
            at = np.arange(1, len(mean) + 1)
            ax.plot(at, mean, **look[label], zorder=3)
            ax.fill_between(at, mean - half, mean + half, color=look[label]["color"], alpha=0.12, lw=0)
        for label, value in now[title].items():
            ax.plot(0, value, marker="o", ms=4, ls="", color=COLOURS["filter"], mfc="white" if "exp" in label else None)
        ax.set(title=title, xlabel="steps ahead", ylim=(0, top), xticks=range(0, len(mean) + 1, 2))
    axes[0][0].set_ylabel("error to the clean state\n(half ranges)")
    entries = [Line2D([], [], **style, label=name(label)) for label, style in look.items()]
    entries += [
        Line2D([], [], color=COLOURS["zero"], ls="--", label="raw observation"),
        Line2D([], [], color=COLOURS["filter"], ls="", marker="o", ms=4, label="Kalman filter, present state"),
        Line2D([], [], color=COLOURS["filter"], ls="", marker="o", ms=4, mfc="white", label="exponential filter, same"),
    ]
    return finish(figure, axes, entries, 4)


@styled
def advantage_map(
    differences: Mapping[str, np.ndarray], *, noise: Sequence[float], delay: Sequence[int], unit: str
) -> Figure:
    """How far ahead a model is, over a grid of noise and delay, one panel per place and rival.

    differences: panel -> (noise, delay), NaN where there is none; above zero the model is ahead.
    """
    grids = {title: np.asarray(values, float) for title, values in differences.items()}
    for title, values in grids.items():
        if values.shape != (len(noise), len(delay)):
            raise ValueError(f"{title} is {values.shape}, expected ({len(noise)}, {len(delay)}): noise by delay")
    far = max(float(np.nanmax(np.abs(values))) for values in grids.values())
    figure, axes = plt.subplots(1, len(grids), figsize=(WIDTH, 2.2), squeeze=False, layout="constrained")
    for ax, (title, values) in zip(axes[0], grids.items(), strict=True):
        image = ax.imshow(values, cmap="PuOr", norm=TwoSlopeNorm(0.0, -far, far), origin="lower", aspect="auto")
        for (row, column), value in np.ndenumerate(values):
            text = "" if np.isnan(value) else f"{value:+.1f}".replace("-", "\u2212")
            ax.text(column, row, text, ha="center", va="center", fontsize=8,
                    color="white" if abs(value) > 0.6 * far else "black")  # fmt: skip
        ax.set(title=title, xlabel="delay (steps)", xticks=range(len(delay)), yticks=range(len(noise)))
        ax.set_xticklabels([f"{value}" for value in delay])
        ax.set_yticklabels([f"{value:g}" for value in noise])
        ax.tick_params(length=0)
    axes[0][0].set_ylabel("noise (half ranges)")
    figure.colorbar(image, ax=list(axes[0]), label=unit, shrink=0.9)
    return figure
