"""Verdicts as tables and as arrays: deciding effects, causes, and changes under other readings of the paper."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from tsmlib.study.claims.claim import DEFINITIONAL, DEPENDENT, FAILED, REPLICATED, VERDICTS, Claim
from tsmlib.study.claims.evaluate import Verdict
from tsmlib.study.results.table import markdown
from tsmlib.study.runs import ROOT

DECIDED = (REPLICATED, DEPENDENT, FAILED)


def counts(verdicts: Sequence[Verdict]) -> str:
    """How often each verdict was given, and by one training seed alone; what holds by definition is left out."""
    words = [verdict.word for verdict in verdicts]
    given = ", ".join(f"{words.count(word)} {word.lower()}" for word in VERDICTS if word != DEFINITIONAL)
    single = sum(verdict.word in DECIDED and verdict.key.seeds == 1 for verdict in verdicts)
    by_one = f"; {single} of the decided ones rest on one training seed" if single else ""
    return f"of {len(words) - words.count(DEFINITIONAL)} claims {given}{by_one}"


def table(verdicts: Sequence[Verdict], ours: Sequence[Verdict], *, root: str = "") -> str:
    """The ledger as a Markdown table. The deciding check is the one that is furthest from holding.

    ours: the same claims with ``zoo.OURS`` for TSM. root: path from the reader to the repository, '' or with a /.
    """
    lines = []
    for verdict, other in zip(verdicts, ours, strict=True):
        claim, key, checks = verdict.claim, verdict.key, len(verdict.effects[""])
        found = "no rows yet" if key.value is None else key.estimate
        lines.append({
            "": claim.id, "the paper says": f"{claim.statement} ({claim.place})", "verdict": f"**{verdict.word}**",
            "with our model": other.word.lower(), "measured": claim.statistic,
            "deciding check": f"{found}, asked {key.check.asked}{f'; one of {checks}' * (checks > 1)}",
            "n": key.n, "shown in": _links(claim, root),
        })  # fmt: skip
    return markdown(pd.DataFrame(lines))


def answers(verdicts: Sequence[Verdict], *, root: str = "") -> str:
    """Questions of the paper's outlook with what our rows say, one line for each check, in Markdown."""
    lines = [
        {
            "": verdict.claim.id, "question": f"{verdict.claim.statement} ({verdict.claim.place})",
            "measured": f"`{effect.check.number.text}`", "verdict": f"**{verdict.word}**",
            "found": f"{effect.text}, asked {effect.check.asked}", "shown in": _links(verdict.claim, root),
        }
        for verdict in verdicts for effect in verdict.effects[""]
    ]  # fmt: skip
    return markdown(pd.DataFrame(lines))


def _links(claim: Claim, root: str) -> str:
    notebook, section, figure = claim.shown
    at = f"#{section.replace(' ', '-')}" if section else ""
    found = [f"[{notebook}]({root}notebooks/{notebook}.ipynb{at})"]
    if figure and (ROOT / "figures" / f"{figure}.png").exists():
        found.append(f"[{figure}]({root}figures/{figure}.png)")
    return ", ".join(found)


def reasons(verdicts: Sequence[Verdict]) -> str:
    """Why each claim that did not get REPLICATED did not, as a Markdown list."""
    return "\n".join(f"- **{v.claim.id}**, {v.word.lower()}. {v.why}" for v in verdicts if v.word != REPLICATED)


def readings(verdicts: Sequence[Verdict]) -> str:
    """The claims of which a check changes sides under another reading of the paper, and those of which none does."""
    found: dict[str, tuple[list[str], list[str]]] = {}
    for verdict in verdicts:
        first = [effect.right_side for effect in verdict.effects[""]]
        for reading, effects in verdict.effects.items():
            if reading and any(effect.value is not None for effect in effects):
                same = [effect.right_side for effect in effects] == first
                found.setdefault(reading, ([], []))[same].append(verdict.claim.id)
    lines = [(reading, *map(", ".join, sides)) for reading, sides in sorted(found.items())]
    return markdown(pd.DataFrame(lines, columns=["reading", "turns", "does not turn"]))


def margins(verdicts: Sequence[Verdict]) -> list[tuple[str, str, str, np.ndarray]]:
    """What ``figures.claim_margins`` draws, of every claim with rows.

    Id, verdict, the deciding effect in words, and how far each estimate and its interval (n, 3) lie beyond the margin,
    the deciding one last.
    """
    found = []
    for verdict in verdicts:
        effects = sorted(verdict.effects[""], key=lambda effect: effect is verdict.key)
        if any(effect.value is not None for effect in effects):
            beyond = np.array([e.beyond for e in effects if e.value is not None or e is verdict.key])
            found.append((verdict.claim.id, verdict.word, verdict.key.text, beyond))
    return found
