"""Figure of the claim ledger: every effect against its margin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tsmlib.figures.style import WIDTH, legend, styled
from tsmlib.study.claims.evaluate import VERDICTS, Verdict, figure

COLOURS = dict(zip(VERDICTS, ("#009E73", "#E69F00", "#7A7A7A", "#D55E00", "#B0B0B0"), strict=True))


@styled
def effects(verdicts: Sequence[Verdict]) -> Figure:
    """Every effect against its margin, a row per claim that has any: the margin is the line, the claimed side tinted.

    Each check has a scale of its own, to the furthest end of its interval: the further out the estimate, the surer.
    Thick is the check that decides, with its estimate and interval in numbers; an open mark has no interval.
    """
    shown = [verdict for verdict in verdicts if any(effect.value is not None for effect in verdict.effects[""])]
    if not shown:
        raise ValueError("no claim has rows: nothing to draw")
    drawn, ax = plt.subplots(figsize=(WIDTH, 0.17 * len(shown) + 0.75))
    ax.axvspan(0, 1.05, color="#EEF6F2", lw=0, zorder=0)
    ax.axvline(0, color="#555555", lw=0.8, zorder=1)
    for y, verdict in enumerate(shown):
        colour, key = COLOURS[verdict.word], verdict.key
        found = [effect for effect in verdict.effects[""] if effect.value is not None]
        for i, effect in enumerate(sorted(found, key=lambda effect: effect is key)):
            (value, low, high), main = effect.beyond / (np.nanmax(np.abs(effect.beyond)) or 1.0), effect is key
            at = y + (0 if main or len(found) == 1 else 0.5 * (i / (len(found) - 1) - 0.5))
            alone = effect.low is None
            look: dict[str, Any] = dict(
                color=colour, lw=1.3 if main else 0.5, alpha=1 if main else 0.55, zorder=4 if main else 3
            )
            ax.plot([low, high], [at, at], **look)
            ax.plot(value, at, "o", ms=3.4 if main else 1.8, mfc="white" if alone else colour, mew=0.7, **look)
        text = figure(key) if key.value is not None else "rows are missing"
        ax.annotate(text, (1, y), (4, 0), ("axes fraction", "data"), "offset points", va="center", fontsize=5.5,
                    color="#444444")  # fmt: skip
    ax.set_yticks(range(len(shown)), [verdict.claim.id for verdict in shown], fontsize=6)
    ax.set(xlim=(-1.05, 1.05), ylim=(len(shown) - 0.5, -0.5), xticks=[-1, 0, 1])
    ax.set_xticklabels(["against the claim", "margin", "for it"])
    ax.tick_params(axis="y", length=0)
    ax.spines["left"].set_visible(False)
    words = [word for word in VERDICTS if any(verdict.word == word for verdict in shown)]
    legend(drawn, [Line2D([], [], color=COLOURS[word], marker="o", ms=3.4, label=word.lower()) for word in words])
    return drawn
