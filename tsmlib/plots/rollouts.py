"""Figures of rollouts: samples of models over the truth, in the plane and against time.

Letters in shapes: S samples, N episodes, T steps, dx state size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from tsmlib.plots.axes import dimension, looks, spell, wrapped
from tsmlib.plots.checks import finite, shaped
from tsmlib.plots.method import Method
from tsmlib.plots.style import DARK, NOTE, WIDTH, Props, entry, legend, scene, styled, tint

ROWS = ("best", "median", "worst")
BLOCK: Props = {"fc": "#E4E4E4", "ec": "#8A8A8A"}
TOUCH: Props = {"ls": "", "marker": "*", "color": "white", "mec": "black", "mew": 0.7, "ms": 6.5}


def _pair(names: Sequence[str], word: str) -> list[int]:
    """The columns of a position in the plane."""
    known = [n[:-2] for n in names if n.endswith("_x") and f"{n[:-2]}_y" in names]
    if word not in known:
        raise ValueError(
            f"names hold no path of the {word}; there are {', '.join(known) or 'none'}"
        )
    return [names.index(f"{word}_{axis}") for axis in "xy"]


@dataclass(frozen=True)
class _Episode:
    """One episode and its samples in the plane: paths (T, 2) and (S, T, 2) of what is shown, and of the fingertip."""

    truth: np.ndarray
    samples: np.ndarray
    tip: np.ndarray
    tip_samples: np.ndarray
    block: np.ndarray | None  # (2,), where it starts
    touch: int  # first step with contact, negative where there is none
    radius: float
    score: float

    def seen(self) -> np.ndarray:
        """What must fit into the picture, (n, 2)."""
        parts = [self.truth]
        if self.block is not None:
            parts.append(np.stack([self.block - self.radius, self.block + self.radius]))
        if 0 <= self.touch < len(self.truth):
            parts.append(self.tip[self.touch, None])
        return np.concatenate(parts)

    def middle(self) -> np.ndarray:
        """The middle of the picture (2,)."""
        return (self.seen().min(0) + self.seen().max(0)) / 2

    def draw(self, ax: Axes, colour: str, span: float) -> None:
        """The picture, ``span`` metres wide, its samples in ``colour``; a cross where one of them leaves it."""
        low, high = self.middle() - span / 2, self.middle() + span / 2
        faint = float(np.clip(4 / len(self.samples), 0.15, 0.7))
        if self.block is not None:
            ax.add_patch(Circle(tuple(self.block), self.radius, **BLOCK, lw=0.7, zorder=1))
        if self.tip is not self.truth:
            ax.plot(*self.tip_samples.T, color=tint(colour, 0.6), lw=0.4, alpha=faint, zorder=2)
            ax.plot(*self.tip.T, color=DARK, lw=0.6, zorder=3)
        ax.plot(*self.samples.T, color=colour, lw=0.9, alpha=faint, zorder=4)
        ax.plot(*self.samples[:, -1].T, ".", color=colour, ms=3, mew=0, zorder=4.2)
        ax.plot(*self.truth.T, color="black", lw=1.3, zorder=5)
        ax.plot(*self.truth[-1], "o", color="black", ms=3, zorder=5)
        if 0 <= self.touch < len(self.truth):
            ax.plot(*self.tip[self.touch], **TOUCH, zorder=5.5)
        scene(ax)
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        outside = np.any((self.samples < low) | (self.samples > high), axis=2)
        if gone := int(outside.any(1).sum()):
            leaving = [p[o.argmax()] for p, o in zip(self.samples, outside, strict=True) if o.any()]
            ax.plot(
                *np.clip(leaving, low, high).T,
                "x",
                color=colour,
                ms=3.5,
                mew=1,
                clip_on=False,
                zorder=6,
            )
            far = float(np.linalg.norm(self.samples - self.truth, axis=-1).max())
            ax.annotate(
                f"{gone} of {len(self.samples)} leave,\nto {spell(far)} m off",
                (1, 0),
                (0, -2),
                fontsize=6.5,
                xycoords="axes fraction",
                textcoords="offset points",
                ha="right",
                va="top",
            )


@styled
def gallery(
    true: np.ndarray,
    predicted: Mapping[Method, np.ndarray],
    energy: Mapping[Method, np.ndarray],
    names: Sequence[str],
    *,
    radius: float,
    contact: np.ndarray | None = None,
    by: Method | None = None,
    path: str = "block",
) -> Figure:
    """Rollouts over the truth in the plane: each model's best, median and worst episode, by energy score.

    true: (N, T, dx); predicted: method -> (S, N, T, dx), all S are drawn; energy: method -> (N,); names (dx,): of the
    dimensions; radius: the block's, in m; contact: (N,) first step with contact, negative where there is none; by: the
    method whose scores choose the episodes for all columns (None: each its own). path: whose way is drawn thick,
    "block" (with the fingertip's thinner) or "tip" (with the block where it starts). Episodes in a row share a scale.
    Where a sample leaves the picture stands a cross; below, how many do, and the largest distance from the truth.
    """
    true = finite("true", true, "N T dx")
    n, steps, size = true.shape
    shaped("names", np.zeros(len(names)), str(size))
    if n < len(ROWS):
        raise ValueError(f"true holds {n} episodes: best, median and worst need at least 3")
    methods = list(looks({"": predicted}))
    samples = {
        method: finite(f"predicted of {method.label}", predicted[method], f"S {n} {steps} {size}")
        for method in methods
    }
    if missing := [
        method.label for method in (*methods, *([by] if by else [])) if method not in energy
    ]:
        there = ", ".join(method.label for method in energy) or "nothing"
        raise ValueError(f"energy holds {there}; '{missing[0]}' is missing")
    scores = {
        method: finite(f"energy of {method.label}", values, str(n))
        for method, values in energy.items()
    }
    touch = np.full(n, -1) if contact is None else finite("contact", contact, str(n)).astype(int)
    main, tip = _pair(names, path), _pair(names, "tip")
    block = _pair(names, "block") if "block_x" in names else None

    def episode(method: Method, i: int) -> _Episode:
        truth, drawn = true[i], samples[method][:, i]
        ways = truth[:, main], drawn[..., main]
        beside = ways if path == "tip" else (truth[:, tip], drawn[..., tip])
        place = None if block is None else truth[0, block]
        return _Episode(*ways, *beside, place, int(touch[i]), radius, float(scores[method][i]))

    order = {
        method: np.argsort(values, kind="stable")[[0, (n - 1) // 2, -1]]
        for method, values in scores.items()
    }
    shown = [
        {method: episode(method, order[by or method][row]) for method in methods}
        for row in range(3)
    ]
    return _pictures(shown, by, _handles(path, block is not None, contact is not None))


def _pictures(
    shown: Sequence[Mapping[Method, _Episode]], by: Method | None, handles: Sequence[Line2D]
) -> Figure:
    """A row for each of ROWS, a column for each method."""
    count = len(shown[0])
    inches = min(1.75, (WIDTH - 0.25) / count)
    down, across = (3, count) if count > 1 else (1, 3)  # a single model lies on its side
    size = (inches * across + 0.25, down * (inches + 0.42) + 0.45)
    figure, grid = plt.subplots(down, across, squeeze=False, figsize=size)
    for word, axes, episodes in zip(ROWS, grid.reshape(3, count), shown, strict=True):
        span = _span(list(episodes.values()))
        for ax, (method, episode) in zip(axes, episodes.items(), strict=True):
            episode.draw(ax, method.look.colour, span)
            score = "energy score" if inches > 1.2 else "score"
            ax.set_title(f"{score} {spell(episode.score)}", fontsize=6.5, color=NOTE)
        _scale_bar(axes[0], span)
        axes[0].set_ylabel(word + (f" for {by.label}" if by else ""), fontsize=7.5)
    for ax, method in zip(grid.flat, shown[0], strict=False):
        ax.annotate(
            wrapped(method.label, inches),
            (0, 1),
            (0, 13),
            xycoords="axes fraction",
            fontsize=7.5,
            va="bottom",
            textcoords="offset points",
            weight="bold",
            color=method.look.colour,
        )
    legend(figure, handles, columns=5 if size[0] > 6.4 else 3 if size[0] > 4.5 else 2)
    return figure


def _span(episodes: Sequence[_Episode]) -> float:
    """The width of all pictures of a row: the truth fits in, samples at most 0.8 times further."""
    needed = max(0.05, *(float(np.ptp(episode.seen(), axis=0).max()) for episode in episodes))
    wanted = max(
        2 * float(np.abs(episode.samples - episode.middle()).max()) for episode in episodes
    )
    return 1.12 * float(np.clip(wanted, needed, 1.8 * needed))


def _scale_bar(ax: Axes, span: float) -> None:
    """A bar of a round length below a picture ``span`` metres wide."""
    length = max(
        (length for length in (0.01, 0.02, 0.05, 0.1, 0.2) if length < 0.4 * span), default=0.01
    )
    ax.plot(
        (0, length / span),
        (-0.04, -0.04),
        color="#222222",
        lw=1.4,
        transform=ax.transAxes,
        clip_on=False,
        solid_capstyle="butt",
    )
    ax.annotate(
        f"{length:g} m",
        (0, -0.04),
        (0, -2),
        xycoords="axes fraction",
        textcoords="offset points",
        fontsize=6.5,
        va="top",
    )


def _handles(path: str, block: bool, contact: bool) -> list[Line2D]:
    simulator = f"simulator: {'fingertip' if path == 'tip' else path}, to its end"
    handles = [
        entry(simulator, color="black", lw=1.3, marker="o", ms=3),
        entry("samples, in the model's colour", color="#999999", lw=0.9, marker=".", ms=3),
    ]
    if path != "tip":
        handles.append(entry("simulator: fingertip", color=DARK, lw=0.6))
    if block:
        handles.append(
            entry("block at the start", ls="", marker="o", mfc=BLOCK["fc"], mec=BLOCK["ec"], ms=6)
        )
    if contact:
        handles.append(entry("fingertip at first contact", **TOUCH))
    return handles


@styled
def rollout_panels(
    true: np.ndarray,
    predicted: np.ndarray,
    names: Sequence[str],
    units: Sequence[str],
    method: Method,
    dt: float = 0.02,
) -> Figure:
    """Predicted samples over the truth, per state dimension against time and as paths in the plane.

    true: (T, dx); predicted: (S, T, dx), of ``method``; dt in s. Dimensions named ``<word>_x`` and ``<word>_y`` give a
    path in the plane.
    """
    true = shaped("true", true, f"T {len(names)}")
    predicted = shaped("predicted", predicted, f"S {len(true)} {len(names)}")
    seconds, main, rows = np.arange(1, len(true) + 1) * dt, method.look.colour, -(-len(names) // 2)
    faint: Props = {"color": main, "alpha": max(0.12, min(0.7, 3 / len(predicted))), "lw": 0.8}
    figure = plt.figure(figsize=(WIDTH, max(2.6, 0.82 * rows + 0.5)))
    grid = figure.add_gridspec(rows, 3, width_ratios=(1, 1, 1.25))
    for i, word in enumerate(names):
        ax = figure.add_subplot(grid[i // 2, i % 2])
        ax.plot(seconds, predicted[:, :, i].T, **faint)
        ax.plot(seconds, true[:, i], color=DARK, lw=1.2)
        last = i + 2 >= len(names)
        ax.set(ylabel=f"{dimension(word)}\n({units[i]})", xlabel="time (s)" if last else "")
        ax.locator_params(axis="y", nbins=4)
        ax.set_xlim(0, seconds[-1])
        ax.tick_params(labelbottom=last)
    figure.align_ylabels()
    plane = figure.add_subplot(grid[:, 2])
    for word in (word[:-2] for word in names if word.endswith("_x") and f"{word[:-2]}_y" in names):
        x, y = _pair(names, word)
        plane.plot(predicted[:, :, x].T, predicted[:, :, y].T, **faint)
        plane.plot(true[:, x], true[:, y], color=DARK, lw=1.4)
        plane.plot(true[0, x], true[0, y], "o", color=DARK, ms=3)
        plane.annotate(
            word, (true[0, x], true[0, y]), (4, 4), textcoords="offset points", fontsize=6.5
        )
    plane.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", anchor="N")
    plane.margins(0.1)
    legend(
        figure,
        [
            entry("simulator", color=DARK, lw=1.2),
            entry(f"{method.label}, {len(predicted)} samples", color=main, lw=0.8),
        ],
    )
    return figure
