"""A gallery of predictions: samples of each model over the truth, in the plane.

Reached through ``tsmlib.figures``, where labels are explained.
Letters in shapes: S samples, N episodes, T steps, dx state size.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from tsmlib.figures.axes import finite, looks, spell
from tsmlib.figures.style import COLOURS, WIDTH, _spell, colour, legend, name, shaped, styled, tint

ROWS = ("best", "median", "worst")


def _pair(names: Sequence[str], word: str) -> list[int]:
    """The columns of a position in the plane."""
    known = [n[:-2] for n in names if n.endswith("_x") and f"{n[:-2]}_y" in names]
    if word not in known:
        raise ValueError(f"names hold no path of the {word}; there are {', '.join(known) or 'none'}")
    return [names.index(f"{word}_{axis}") for axis in "xy"]


@styled
def gallery(
    true: np.ndarray, predicted: Mapping[str, np.ndarray], energy: Mapping[str, np.ndarray], names: Sequence[str], *,
    contact: np.ndarray | None = None, by: str | None = None, path: str = "block", radius: float = 0.03,
) -> Figure:  # fmt: skip
    """Rollouts over the truth in the plane: each model's best, median and worst episode, by energy score.

    true: (N, T, dx); predicted: label -> (S, N, T, dx), all S are drawn; energy: label -> (N,); contact: (N,) first
    step with contact, negative where there is none; by: the model whose scores choose the episodes for all columns
    (None: each its own). path: whose way is drawn thick, "block" (with the fingertip's thinner) or "tip" (with the
    block where it starts); radius: the block's, in m. Episodes in a row share a scale.
    Where a sample leaves the picture stands a cross; below, how many do, and the largest distance from the truth.
    """
    true = finite("true", true, "N T dx")
    n, steps, size = true.shape
    shaped("names", np.zeros(len(names)), str(size))
    if n < len(ROWS):
        raise ValueError(f"true holds {n} episodes: best, median and worst need at least 3")
    labels = list(looks(predicted))
    samples = {label: finite(f"predicted['{label}']", predicted[label], f"S {n} {steps} {size}") for label in labels}
    if missing := [label for label in (*labels, *([by] if by else [])) if label not in energy]:
        raise ValueError(f"energy holds {', '.join(energy) or 'nothing'}; '{missing[0]}' is missing")
    scores = {label: finite(f"energy['{label}']", values, str(n)) for label, values in energy.items()}
    picks = {label: np.argsort(values, kind="stable")[[0, (n - 1) // 2, -1]] for label, values in scores.items()}
    touch = np.full(n, -1) if contact is None else finite("contact", contact, str(n)).astype(int)
    main, tip = _pair(names, path), _pair(names, "tip")
    block = _pair(names, "block") if "block_x" in names else None

    inches = min(1.75, (WIDTH - 0.25) / len(labels))
    down, across = (3, len(labels)) if len(labels) > 1 else (1, 3)  # a single model lies on its side
    figure, grid = plt.subplots(down, across, squeeze=False,
                                figsize=(inches * across + 0.25, down * (inches + 0.42) + 0.45))  # fmt: skip
    grid = grid.reshape(3, len(labels))
    for row, word in enumerate(ROWS):
        chosen = {label: int(picks[by or label][row]) for label in labels}
        middles, span = _frame(true, samples, chosen, main, tip, block, touch, radius)
        for ax, (label, episode) in zip(grid[row], chosen.items(), strict=True):
            truth, drawn = true[episode], samples[label][:, episode]
            shade, faint = colour(label), float(np.clip(4 / len(drawn), 0.15, 0.7))
            low, high = middles[label] - span / 2, middles[label] + span / 2
            if block:
                ax.add_patch(Circle(tuple(truth[0, block]), radius, fc="#E4E4E4", ec="#8A8A8A", lw=0.7, zorder=1))
            if path != "tip":
                ax.plot(*drawn[..., tip].T, color=tint(shade, 0.6), lw=0.4, alpha=faint, zorder=2)
                ax.plot(*truth[:, tip].T, color=COLOURS["data"], lw=0.6, zorder=3)
            ax.plot(*drawn[..., main].T, color=shade, lw=0.9, alpha=faint, zorder=4)
            ax.plot(*drawn[:, -1][:, main].T, ".", color=shade, ms=3, mew=0, zorder=4.2)
            ax.plot(*truth[:, main].T, color="black", lw=1.3, zorder=5)
            ax.plot(*truth[-1, main], "o", color="black", ms=3, zorder=5)
            if 0 <= touch[episode] < steps:
                ax.plot(*truth[touch[episode], tip], "*", color="white", mec="black", mew=0.7, ms=6.5, zorder=5.5)
            ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=(), yticks=())
            ax.spines[:].set(visible=True, color="#CCCCCC")
            word_score = "energy score" if inches > 1.2 else "score"
            ax.set_title(f"{word_score} {spell(scores[label][episode])}", fontsize=6.5, color="#555555")

            paths = drawn[..., main]  # (S, T, 2)
            outside = np.any((paths < low) | (paths > high), axis=2)
            if gone := int(outside.any(1).sum()):
                leaving = [p[o.argmax()] for p, o in zip(paths, outside, strict=True) if o.any()]
                ax.plot(*np.clip(leaving, low, high).T, "x", color=shade, ms=3.5, mew=1, clip_on=False, zorder=6)
                far = float(np.linalg.norm(paths - truth[:, main], axis=-1).max())
                ax.annotate(f"{gone} of {len(drawn)} leave,\nto {spell(far)} m off", (1, 0), (0, -2), fontsize=6.5,
                            xycoords="axes fraction", textcoords="offset points", ha="right", va="top")  # fmt: skip
        first, bar = grid[row, 0], max((b for b in (0.01, 0.02, 0.05, 0.1, 0.2) if b < 0.4 * span), default=0.01)
        first.plot((0, bar / span), (-0.04, -0.04), color="#222222", lw=1.4, transform=first.transAxes, clip_on=False,
                   solid_capstyle="butt")  # fmt: skip
        first.annotate(f"{bar:g} m", (0, -0.04), (0, -2), xycoords="axes fraction", textcoords="offset points",
                       fontsize=6.5, va="top")  # fmt: skip
        first.set_ylabel(word + (f" for {name(by)}" if by else ""), fontsize=7.5)
    for ax, label in zip(grid[0], labels, strict=True):
        heading = textwrap.fill(name(label), max(8, int(inches / 0.068)))
        ax.annotate(heading, (0, 1), (0, 13), xycoords="axes fraction", textcoords="offset points", fontsize=7.5,
                    va="bottom", weight="bold", color=colour(label))  # fmt: skip
    legend(figure, _handles(path, block is not None, contact is not None), columns=5 if inches * across > 6.2 else 3)
    return figure


def _frame(
    true: np.ndarray, samples: Mapping[str, np.ndarray], chosen: Mapping[str, int], main: list[int], tip: list[int],
    block: list[int] | None, touch: np.ndarray, radius: float,
) -> tuple[dict[str, np.ndarray], float]:  # fmt: skip
    """The middle of each model's picture and the width of all: the truth fits in, samples at most 0.8 times further."""
    middles, needed, wanted = {}, 0.05, 0.0
    for label, episode in chosen.items():
        truth = true[episode]
        seen = [truth[:, main]]
        if block:
            seen += [truth[:1, block] - radius, truth[:1, block] + radius]
        if 0 <= touch[episode] < len(truth):
            seen.append(truth[touch[episode], tip][None])
        low, high = np.concatenate(seen).min(0), np.concatenate(seen).max(0)
        middles[label] = (low + high) / 2
        needed = max(needed, float((high - low).max()))
        wanted = max(wanted, 2 * float(np.abs(samples[label][:, episode][..., main] - middles[label]).max()))
    return middles, 1.12 * float(np.clip(wanted, needed, 1.8 * needed))


def _handles(path: str, block: bool, contact: bool) -> list[Line2D]:
    simulator = f"simulator: {'fingertip' if path == 'tip' else path}, to its end"
    handles = [
        Line2D([], [], color="black", lw=1.3, marker="o", ms=3, label=simulator),
        Line2D([], [], color="#999999", lw=0.9, marker=".", ms=3, label="samples, in the model's colour"),
    ]
    if path != "tip":
        handles.append(Line2D([], [], color=COLOURS["data"], lw=0.6, label="simulator: fingertip"))
    if block:
        handles.append(
            Line2D([], [], ls="", marker="o", mfc="#E4E4E4", mec="#8A8A8A", ms=6, label="block at the start")
        )
    if contact:
        handles.append(Line2D([], [], ls="", marker="*", mfc="white", mec="black", mew=0.7, ms=6.5,
                              label="fingertip at first contact"))  # fmt: skip
    return handles


@styled
def rollout_panels(
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
