"""The ledger of claims as tables and a picture: verdicts, what decides them, and what the paper leaves open."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from pathlib import Path

from tsmlib.study.claims.evaluate import REPLICATED, VERDICTS, Claim, Verdict, figure
from tsmlib.study.runs import ROOT

CHOICES = Path(__file__).with_name("choices.toml")


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
