"""Figures of the claim ledger: every claim against its margin, and every check of a claim with its training seeds."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tsmlib.plots.style import NOTE, WIDTH, Props, entry, legend, rows_only, styled

VERDICTS = {  # verdict -> colour
    "REPLICATED": "#009E73",
    "READING-DEPENDENT": "#E69F00",
    "INCONCLUSIVE": "#7A7A7A",
    "NOT REPLICATED": "#D55E00",
    "NOT TESTABLE": "#B0B0B0",
    "DEFINITIONAL": "#56B4E9",
}


@styled
def claim_margins(claims: Sequence[tuple[str, str, str, str, np.ndarray, np.ndarray]]) -> Figure:
    """Every effect against its margin, a row per claim: the margin is the line, the claimed side tinted.

    claims: id, the claim in our words, verdict, the deciding effect in words, how far estimate and ends of the interval
    of each effect (n, 3) lie beyond the margin, the deciding one last, and how far each of its training seeds does;
    ends that are NaN are no interval. Each effect has a scale of its own, to the furthest end: the further out the
    estimate, the surer. Thick is the one that decides, with its seeds as ticks; an open mark has no interval, since it
    is of one training seed. What is claimed stands to the left, over two lines where it is long. ValueError without
    claims.
    """
    if not claims:
        raise ValueError("no claim has rows: nothing to draw")
    figure, ax = plt.subplots(figsize=(WIDTH + 1.6, 0.2 * len(claims) + 0.75))
    ax.axvspan(0, 1.05, color="#EEF6F2", lw=0, zorder=0)
    ax.axvline(0, color="#555555", lw=0.8, zorder=1)
    for y, (_, _, verdict, text, beyond, seeds) in enumerate(claims):
        furthest = np.maximum(np.fmax.reduce(np.abs(beyond), axis=1, keepdims=True), 1e-300)
        furthest[-1] = np.fmax.reduce(np.abs(seeds), initial=furthest[-1, 0])
        scaled = beyond / furthest
        ax.plot(
            seeds / furthest[-1],
            [y] * len(seeds),
            "|",
            color=VERDICTS[verdict],
            zorder=3,
            ms=6,
            mew=0.6,
        )
        offsets = [*np.linspace(-0.25, 0.25, len(beyond) - 1), 0.0]
        for i, (value, low, high) in enumerate(scaled):
            main, at = i == len(beyond) - 1, y + offsets[i]
            colour, alpha, above = VERDICTS[verdict], 1 if main else 0.55, 4 if main else 3
            ax.plot(
                [low, high],
                [at, at],
                color=colour,
                alpha=alpha,
                zorder=above,
                lw=1.3 if main else 0.5,
            )
            ax.plot(
                value,
                at,
                "o",
                color=colour,
                alpha=alpha,
                zorder=above,
                ms=3.4 if main else 1.8,
                mew=0.7,
                mfc="white" if np.isnan(low) else colour,
            )
        ax.annotate(
            text,
            (1, y),
            (4, 0),
            ("axes fraction", "data"),
            "offset points",
            va="center",
            fontsize=5.5,
            color="#444444",
        )
    ax.set_yticks(
        range(len(claims)),
        [textwrap.fill(f"{claim}  {says}".strip(), 60) for claim, says, *_ in claims],
        fontsize=5.5,
        linespacing=1.0,
        ha="left",
    )
    ax.set(xlim=(-1.05, 1.05), ylim=(len(claims) - 0.5, -0.5), xticks=[-1, 0, 1])
    ax.set_xticklabels(["against the claim", "margin", "for it"])
    ax.tick_params(axis="y", length=0, pad=172)  # points: the width of 60 letters
    ax.spines["left"].set_visible(False)
    given = {verdict for _, _, verdict, *_ in claims}
    marks = [
        Line2D([], [], color=VERDICTS[word], marker="o", ms=3.4, label=word.lower())
        for word in VERDICTS
        if word in given
    ]
    grey = "#444444"
    if any(np.isnan(beyond[:, 1]).any() for *_, beyond, _ in claims):
        marks.append(
            entry(
                "no interval: one training seed", color=grey, marker="o", ms=3.4, mfc="white", ls=""
            )
        )
    marks.append(
        entry(
            "one training seed of the effect that decides",
            color=grey,
            marker="|",
            ms=6,
            mew=0.6,
            ls="",
        )
    )
    legend(figure, marks)
    return figure


STATES = {  # of a check -> colour; of others grey
    "holds": VERDICTS["REPLICATED"],
    "fails": VERDICTS["NOT REPLICATED"],
    "open": VERDICTS["INCONCLUSIVE"],
}


class DrawnCheck(NamedTuple):
    """A check as it is drawn.

    estimate: with the ends of its interval (3,), NaN where there are none. seeds: each training seed's number (seeds,).
    side: 1 where larger numbers than the margin are claimed, -1 where smaller ones are, 0 where the margin itself is.
    """

    state: str
    text: str
    margin: float
    side: int
    estimate: np.ndarray
    seeds: np.ndarray


@styled
def claim_checks(checks: Sequence[DrawnCheck]) -> Figure:
    """Every check of a claim, a row each, numbered from 1: estimate, interval and training seeds against the margin.

    The claimed side is to the right and tinted; where the margin itself is claimed, nothing is. Each row has a linear
    scale of its own, with its ends in numbers.
    ValueError without checks.
    """
    if not checks:
        raise ValueError("no checks: nothing to draw")
    figure, ax = plt.subplots(figsize=(WIDTH, 0.2 * len(checks) + 0.55))
    ax.axvline(0, color="#555555", lw=0.8, zorder=1)
    for y, check in enumerate(checks):
        colour, side = STATES.get(check.state, VERDICTS["NOT TESTABLE"]), check.side or 1
        if check.side:
            ax.fill_between([0, 1.08], y - 0.5, y + 0.5, color="#EEF6F2", lw=0, zorder=0)
        beyond, seeds = (
            side * (numbers - check.margin) for numbers in (check.estimate, check.seeds)
        )
        furthest = (
            float(np.fmax.reduce(np.abs(np.concatenate([beyond, seeds])), initial=0.0)) or 1.0
        )
        ax.plot(
            seeds / furthest,
            [y] * len(seeds),
            "o",
            ms=4,
            mfc="none",
            mec=colour,
            mew=0.6,
            alpha=0.8,
            zorder=3,
        )
        value, low, high = beyond / furthest
        ax.plot([low, high], [y, y], color=colour, lw=1.6, zorder=2)
        ax.plot([value, value], [y - 0.32, y + 0.32], color=colour, lw=1.6, zorder=4)
        words: Props = {"va": "center", "fontsize": 5.5, "annotation_clip": False}
        ax.annotate(
            f"{y + 1}  {check.state}",
            (0, y),
            (-42, 0),
            ("axes fraction", "data"),
            "offset points",
            ha="right",
            color=colour,
            **words,
        )
        for at, share, places in ((-1, 0, "right"), (1, 1, "left")):
            ends = f"{check.margin + side * at * furthest:.3g}" if np.isfinite(beyond[0]) else ""
            ax.annotate(
                ends,
                (share, y),
                (4 * at, 0),
                ("axes fraction", "data"),
                "offset points",
                ha=places,
                color=NOTE,
                **words,
            )
        ax.annotate(
            check.text,
            (1, y),
            (38, 0),
            ("axes fraction", "data"),
            "offset points",
            color="#444444",
            **words,
        )
    ax.set(xlim=(-1.08, 1.08), ylim=(len(checks) - 0.5, -0.5), xticks=[-1, 0, 1], yticks=[])
    ax.set_xticklabels(["against the claim", "margin", "for it"])
    rows_only(ax)
    grey = "#444444"
    legend(
        figure,
        [
            entry("mean", color=grey, marker="|", ms=6, mew=1.6, ls=""),
            entry("interval", color=grey, lw=1.6),
            entry("one training seed", color=grey, marker="o", ms=4, mfc="none", mew=0.6, ls=""),
        ],
    )
    return figure
