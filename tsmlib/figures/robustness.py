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

from tsmlib.figures.axes import arrow, checked_panels, finish, finite, foot, handles, looks, spell
from tsmlib.figures.policies import LearningCurves, draw_policies
from tsmlib.figures.style import COLOURS, WIDTH, legend, name, styled, tint
from tsmlib.statistics import interval


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
    clean = finite("clean", clean, f"T {len(titles)}")
    noisy = finite("noisy", noisy, f"{len(clean)} {len(titles)}")
    taken, applied = (finite(word, torque, f"{len(clean) - 1}") for word, torque in
                      (("taken", taken), ("applied", applied)))  # fmt: skip
    figure, axes = plt.subplots(1, len(titles) + 1, figsize=(WIDTH, 1.7), layout="constrained")
    at = np.arange(len(clean)) * dt
    for ax, title, truth, seen in zip(axes[:-1], titles, clean.T, noisy.T, strict=True):
        ax.plot(at, seen, ".", ms=3, color=tint(COLOURS["tsm"], 0.6), mew=0)
        ax.plot(at, truth, color=COLOURS["data"], lw=1.1)
        ax.set(title=title, xlabel="time (s)")
    ax = axes[-1]
    ax.step(at[:-1], taken, where="post", color=COLOURS["onestep"], lw=1.0)
    ax.step(at[:-1], applied, where="post", color=COLOURS["data"], lw=1.1)
    ax.set(title="shoulder torque (of full)", xlabel="time (s)")
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
    the error of what it takes the present state for, at 0 steps; raw: panel -> the raw observation's. One scale for
    all panels; what leaves it has an arrow, and its value stands in words below.
    """
    for word, given in (("now", now), ("raw", raw)):
        if set(given) != set(ahead):
            raise ValueError(f"{word} has the panels {', '.join(given)}; expected {', '.join(ahead)}")
    checked = checked_panels(ahead, "k K")
    look = looks(label for rows in checked.values() for label in rows)
    means = np.concatenate([row.mean(0) for rows in checked.values() for row in rows.values()])
    top = max(1.25 * max(raw.values()), 1.05 * float(np.quantile(means, 0.9)))
    figure, axes = plt.subplots(1, len(ahead), figsize=(WIDTH, 2.1), sharey=True, squeeze=False)
    axes[0][0].set_ylim(0, top)
    for ax, (title, rows) in zip(axes[0], checked.items(), strict=True):
        ax.axhline(raw[title], color=COLOURS["zero"], ls="--", lw=1, zorder=1)
        notes = []
        for label, row in rows.items():
            mean, half = np.array([interval(values) for values in row.T]).T
            at = np.arange(1, len(mean) + 1)
            ax.fill_between(at, mean - half, mean + half, color=look[label]["color"], alpha=0.12, lw=0)
            if label in now[title]:
                at, mean = np.append(0, at), np.append(now[title][label], mean)
            ax.plot(at, mean, **look[label], zorder=3)
            if (mean > top).any():
                arrow(ax, "y", at[(mean > top).argmax()], 1, look[label]["color"])
                notes.append(f"{name(label)} to {spell(mean.max())}")
        for label, value in now[title].items():
            if label not in rows:
                ax.plot(0, value, "o", ms=4, color=COLOURS["filter"], mfc="white", zorder=4)
        ax.set(title=title.capitalize(), xticks=range(0, max(row.shape[1] for row in rows.values()) + 1, 2))
        foot(ax, "steps ahead", notes, WIDTH / len(ahead) - 0.2)
    axes[0][0].set_ylabel("error to the clean state\n(half ranges)")
    entries = [
        *handles(look),
        Line2D([], [], color=COLOURS["filter"], ls="", marker="o", ms=4, mfc="white", label="exponential filter"),
        Line2D([], [], color=COLOURS["zero"], ls="--", label="raw observation"),
    ]
    return finish(figure, axes, entries, 4)


@styled
def advantage_map(
    differences: Mapping[str, np.ndarray], *, noise: Sequence[float], delay: Sequence[int], unit: str
) -> Figure:
    """How far ahead a model is, over a grid of noise and delay, one panel per place and rival.

    differences: panel -> (noise, delay), NaN where there is none, which is hatched; above zero the model is ahead.
    """
    if not differences:
        raise ValueError("differences holds no panel: nothing to draw")
    grids = {title: np.asarray(values, float) for title, values in differences.items()}
    for title, values in grids.items():
        if values.shape != (len(noise), len(delay)):
            raise ValueError(f"{title} is {values.shape}, expected ({len(noise)}, {len(delay)}): noise by delay")
    far = max((float(abs(value)) for values in grids.values() for value in values.flat if np.isfinite(value)),
              default=0.0) or 1.0  # fmt: skip
    figure, axes = plt.subplots(
        1, len(grids), figsize=(WIDTH, 2.2), squeeze=False, sharey=True, layout="constrained"
    )  # fmt: skip
    for ax, (title, values) in zip(axes[0], grids.items(), strict=True):
        image = ax.imshow(values, cmap="PuOr", norm=TwoSlopeNorm(0.0, -far, far), origin="lower", aspect="auto")
        for (row, column), value in np.ndenumerate(values):
            text = "" if np.isnan(value) else f"{value:+.1f}".replace("-", "\u2212")
            ax.text(column, row, text, ha="center", va="center", fontsize=8,
                    color="white" if abs(value) > 0.6 * far else "black")  # fmt: skip
        ax.set(title=title.replace(": ", ":\n"), xlabel="delay (steps)", xticks=range(len(delay)),
               yticks=range(len(noise)))  # fmt: skip
        ax.patch.set(hatch="////", edgecolor="#C8C8C8")
        ax.spines[:].set_visible(False)
        ax.set_xticklabels([f"{value}" for value in delay])
        ax.set_yticklabels([f"{value:g}" for value in noise])
        ax.tick_params(length=0)
    axes[0][0].set_ylabel("noise (half ranges)")
    figure.colorbar(image, ax=list(axes[0]), label=unit, shrink=0.9)
    return figure
