"""The ledger of claims as tables and a picture: verdicts, what decides them, and what the paper leaves open."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tsmlib.claims import REPLICATED, VERDICTS, Claim, Verdict, figure
from tsmlib.runs import ROOT
from tsmlib.style import WIDTH, legend, styled

CHOICES = Path(__file__).with_name("choices.toml")
COLOURS = dict(zip(VERDICTS, ("#009E73", "#E69F00", "#7A7A7A", "#D55E00", "#B0B0B0"), strict=True))


def counts(verdicts: Sequence[Verdict]) -> str:
    """How often each word was given."""
    words = [verdict.word for verdict in verdicts]
    return ", ".join(f"{words.count(word)} {word.lower()}" for word in VERDICTS)


def table(verdicts: Sequence[Verdict], ours: Sequence[Verdict], *, root: str = "") -> str:
    """The ledger as a Markdown table. The deciding check is the one that is furthest from holding.

    ours: the same claims with ``claims.OURS`` for TSM. root: path from the reader to the repository, '' or with a /.
    """
    head = "| | the paper says | verdict | with our model | measured | deciding check | n | shown in |"
    lines = [head, "|---" * 8 + "|"]
    for verdict, other in zip(verdicts, ours, strict=True):
        claim, key, checks = verdict.claim, verdict.key, len(verdict.effects[""])
        found = "no rows yet" if key.value is None else f"{figure(key).rpartition(', n = ')[0]}"
        decides = f"{found}, asked {key.check.asked}{f'; one of {checks}' * (checks > 1)}"
        lines.append(
            f"| {claim.id} | {claim.statement} ({claim.place}) | **{verdict.word}** | {other.word.lower()} "
            f"| {claim.statistic} | {decides} | {key.n} | {_links(claim, root)} |"
        )
    return "\n".join(lines)


def _links(claim: Claim, root: str) -> str:
    """Where a claim's numbers are shown: notebook, section and figure, as far as they exist."""
    found, section = claim.notebook, claim.section.replace(" ", "-")
    if (ROOT / "notebooks" / f"{claim.notebook}.ipynb").exists():
        found = f"[{claim.notebook}]({root}notebooks/{claim.notebook}.ipynb{f'#{section}' * bool(section)})"
    if claim.figure and (ROOT / "figures" / f"{claim.figure}.png").exists():
        found += f", [{claim.figure}]({root}figures/{claim.figure}.png)"
    return found


def reasons(verdicts: Sequence[Verdict]) -> str:
    """Why each claim that did not get REPLICATED did not, as a Markdown list."""
    return "\n".join(f"- **{v.claim.id}**, {v.word.lower()}. {v.why}" for v in verdicts if v.word != REPLICATED)


def choices(verdicts: Sequence[Verdict]) -> str:
    """What the paper leaves open, what was chosen, why, and what happens otherwise, as a Markdown table (A1 to A31).

    The last column is from rows: the claims whose checks change sides under a reading of that name, and those that
    do not.
    """
    lines = ["| | the paper leaves open | chosen here | why | otherwise | verdicts |", "|---" * 6 + "|"]
    for entry in tomllib.loads(CHOICES.read_text())["choice"]:
        sides: dict[bool, list[str]] = {True: [], False: []}
        for verdict in verdicts:
            tried = [
                [effect.right_side for effect in effects]
                for reading, effects in verdict.effects.items()
                if re.match(rf"{entry['id']}(?!\d)", reading) and any(effect.value is not None for effect in effects)
            ]
            if tried:
                first = [effect.right_side for effect in verdict.effects[""]]
                sides[all(found == first for found in tried)].append(verdict.claim.id)
        said = [f"{word} {', '.join(ids)}" for word, ids in (("turns", sides[False]), ("not", sides[True])) if ids]
        cells = [entry[field] for field in ("id", "open", "chosen", "why", "otherwise")]
        lines.append(f"| {' | '.join(cells)} | {'; '.join(said)} |")
    return "\n".join(lines)


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
