"""Verdicts as tables and as arrays: deciding effects, causes, and changes under other readings of the paper."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from tsmlib import plots as figures
from reproduction.claims.claim import (
    DEFINITIONAL,
    DEPENDENT,
    FAILED,
    INCONCLUSIVE,
    REPLICATED,
    UNTESTABLE,
    VERDICTS,
    Claim,
)
from reproduction.claims.evaluate import Effect, Verdict, state_of
from reproduction.claims.query import PAPERS_PLANNER
from reproduction.results.table import markdown
from reproduction.runs import FIGURES

DECIDED = (REPLICATED, DEPENDENT, FAILED)
ANSWERS = {
    REPLICATED: "yes",
    FAILED: "no",
    INCONCLUSIVE: "open",
    UNTESTABLE: "not testable",
}  # to our own questions


def counts(verdicts: Sequence[Verdict]) -> str:
    """How often each verdict was given, and how many of those that decide rest on one training seed in some check;
    what holds by definition is left out."""
    words = [verdict.word for verdict in verdicts]
    given = ", ".join(
        f"{words.count(word)} {word.lower()}" for word in VERDICTS if word != DEFINITIONAL
    )
    single = sum(verdict.word in DECIDED and verdict.seeds == 1 for verdict in verdicts)
    by_one = (
        f"; {single} of the decided ones rest{'s' * (single == 1)} on one training seed"
        if single
        else ""
    )
    return f"of {len(words) - words.count(DEFINITIONAL)} claims {given}{by_one}"


def table(verdicts: Sequence[Verdict], ours: Sequence[Verdict], *, root: str = "") -> str:
    """The ledger as a Markdown table. The deciding check is the one that is furthest from holding.

    ours: the same claims with ``zoo.OURS`` for TSM. root: path from the reader to the repository, '' or with a /.
    """
    lines = []
    for verdict, other in zip(verdicts, ours, strict=True):
        claim, key, checks = verdict.claim, verdict.key, len(verdict.checks)
        found = "no rows yet" if key.value is None else key.estimate
        lines.append(
            {
                "": f"[{claim.id}]({root}docs/claims_in_full.md#{claim.id.lower()})",
                "the claim, in our words": f"{claim.statement} ({claim.place})",
                "verdict": "; ".join(filter(None, [f"**{verdict.word}**", failing(verdict)])),
                "by Adam": _by_papers_planner(verdict),
                "with our model": other.word.lower(),
                "measured": claim.statistic,
                "deciding check": "; ".join(
                    filter(
                        None,
                        [
                            f"{found}, asked {key.check.asked}",
                            f"one of {checks}" * (checks > 1),
                            unmeasured(verdict),
                        ],
                    )
                ),
                "n": key.n,
                "shown in": _links(claim, root),
            }
        )
    return markdown(pd.DataFrame(lines))


def by_papers_planner(verdicts: Sequence[Verdict]) -> str:
    """The claims of which the paper's planner gives another verdict than ours, in a sentence; '' without any."""
    effects = [effect for verdict in verdicts for effect in verdict.effects.get(PAPERS_PLANNER, ())]
    planned = (
        e
        for e in effects
        if any(term.wanted.get("planner") == "adam" for term in e.check.number.terms)
    )
    seeds = sorted({effect.seeds for effect in planned if effect.seeds})
    turned: dict[str, list[str]] = {}
    for verdict in verdicts:
        word = _by_papers_planner(verdict)
        if word not in ("", "no rows", verdict.word.lower()):
            turned.setdefault(word, []).append(verdict.claim.id)
    told = "; ".join(f"{', '.join(claims)} {word}" for word, claims in turned.items())
    few = " to ".join(str(count) for count in dict.fromkeys((seeds[0], seeds[-1]))) if told else ""
    return (
        f"Of all claims, by Adam, the paper's planner, in place of CEM ({few} seeds): {told}."
        if told
        else ""
    )


def _by_papers_planner(verdict: Verdict) -> str:
    """The verdict where plans are by the paper's planner; '' of claims that are not about plans."""
    return _under(verdict.effects[PAPERS_PLANNER]) if PAPERS_PLANNER in verdict.effects else ""


def unmeasured(verdict: Verdict) -> str:
    """How many of a claim's checks have no rows, in words; '' where all have some, or none."""
    some = 0 < verdict.without_rows < len(verdict.checks)
    return f"{verdict.without_rows} of {len(verdict.checks)} checks have no rows" * some


def seeds_table(verdicts: Sequence[Verdict]) -> str:
    """Claims by the least number of training seeds over all of a claim's checks, in Markdown.

    In brackets how many of the checks have that number, where not all have, and how many have no rows.
    """
    counted, lines = [verdict for verdict in verdicts if verdict.word != DEFINITIONAL], []
    for seeds in sorted({verdict.seeds for verdict in counted}):
        same = [verdict for verdict in counted if verdict.seeds == seeds]
        drawn = {
            int(number)
            for verdict in same
            for number in re.findall(r"figure (\d+)", verdict.claim.place)
        }
        lines.append(
            {
                "training seeds": seeds or "no rows",
                "claims": len(same),
                "which": ", ".join(map(_resting, same)),
                "figures of the paper": ", ".join(map(str, sorted(drawn))),
            }
        )
    return markdown(pd.DataFrame(lines))


def seeds_told(verdicts: Sequence[Verdict]) -> str:
    """How many training seeds claims rest on, and how many have no rows of some or all checks, in a sentence."""
    counted = [verdict for verdict in verdicts if verdict.word != DEFINITIONAL]
    seeds, some = (
        [verdict.seeds for verdict in counted],
        sum(bool(unmeasured(verdict)) for verdict in counted),
    )
    told = [f"{seeds.count(n)} on {n}" for n in sorted({*seeds} - {0})]
    told += [f"{seeds.count(0)} without rows"] * (0 in seeds)
    lacking = f"; {some} lack{'s' * (some == 1)} rows of some checks" * bool(some)
    return f"Training seeds: {', '.join(told)}{lacking}."


def _resting(verdict: Verdict) -> str:
    checks, fewest = (
        len(verdict.checks),
        sum(effect.seeds == verdict.seeds for effect in verdict.checks),
    )
    some = f"{fewest} of {checks} checks" * (fewest + verdict.without_rows < checks)
    told = "; ".join(filter(None, [some, unmeasured(verdict)]))
    return verdict.claim.id + f" ({told})" * bool(told)


def failing(verdict: Verdict) -> str:
    """Readings under which an inconclusive claim fails, in words; '' without any."""
    told = (
        f"{name}{' (one training seed)' * (seeds == 1)}"
        for name, seeds in verdict.failing_readings.items()
    )
    return f"it fails under {', '.join(told)}" if verdict.failing_readings else ""


def answers(verdicts: Sequence[Verdict], *, root: str = "") -> str:
    """Questions of the paper's outlook with what our rows say, one line for each check, in Markdown."""
    lines = []
    for verdict in verdicts:
        answer = " ".join(
            filter(None, [f"**{ANSWERS[verdict.word]}**", verdict.claim.why.get(verdict.word, "")])
        )
        lines += [
            {
                "": verdict.claim.id,
                "question": f"{verdict.claim.statement} ({verdict.claim.place})",
                "measured": f"`{effect.check.number.text}`",
                "answer": answer,
                "found": f"{effect.text}, asked {effect.check.asked}",
                "shown in": _links(verdict.claim, root),
            }
            for effect in verdict.effects[""]
        ]
    return markdown(pd.DataFrame(lines))


def _links(claim: Claim, root: str) -> str:
    notebook, section, figure = claim.shown
    at = f"#{section.replace(' ', '-')}" if section else ""
    found = [f"[{notebook}]({root}notebooks/{notebook}.ipynb{at})"]
    if figure and (FIGURES / f"{figure}.png").exists():
        found.append(f"[{figure}]({root}figures/{figure}.png)")
    return ", ".join(found)


def reasons(verdicts: Sequence[Verdict]) -> str:
    """Why each claim that did not get REPLICATED did not, as a Markdown list."""
    return "\n".join(
        f"- **{v.claim.id}**, {v.word.lower()}. {v.why}" for v in verdicts if v.word != REPLICATED
    )


def readings(verdicts: Sequence[Verdict]) -> str:
    """The claims of which a check changes sides under another reading of the paper, and those of which none does."""
    found: dict[str, tuple[list[str], list[str]]] = {}
    for verdict in verdicts:
        first = [effect.right_side for effect in verdict.checks]
        for reading, effects in verdict.effects.items():
            asked = state_of(effects) != "void" and state_of(verdict.effects[""]) != "void"
            if reading and asked and any(effect.value is not None for effect in effects):
                same = [effect.right_side for effect in effects] == first
                found.setdefault(reading, ([], []))[same].append(verdict.claim.id)
    lines = [(reading, *map(", ".join, sides)) for reading, sides in sorted(found.items())]
    return markdown(pd.DataFrame(lines, columns=["reading", "turns", "does not turn"]))


def in_full(verdict: Verdict, ours: Verdict, *, root: str = "") -> str:
    """One claim as a section in Markdown: the paper's words and ours, verdict, every check with a picture of all its
    seeds, the verdict under each reading, and what would change it. ours: the same with ``zoo.OURS`` for TSM."""
    claim = verdict.claim
    checks = len(verdict.checks)
    several = f"All of {checks} checks have to hold" if checks > 1 else "One check has to hold"
    known = (
        verdict.why
        if verdict.word in (DEFINITIONAL, UNTESTABLE)
        else claim.why.get(verdict.word, "")
    )
    known = f" {known}" if known else ""
    several = "; ".join(filter(None, [several, unmeasured(verdict)]))
    picture = f"![Checks of {claim.id}]({root}figures/claims/{claim.id}.svg)\n\n" * bool(
        drawn_checks(verdict)
    )
    found = [
        {
            "": i,
            "check": f"`{effect.check.number.text}`",
            "asked": f"{effect.check.op} {effect.check.margin:g}",
            "found": effect.text,
            "state": effect.state,
        }
        for i, effect in enumerate(verdict.effects[""], 1)
    ]
    read = [
        {
            "reading": reading or claim.primary,
            "verdict": _under(found),
            "deciding check": _deciding(found),
        }
        for reading, found in verdict.effects.items()
    ]
    return f"""## {claim.id}

{quotation(claim)}

In our words: {claim.statement}

**{verdict.word}**; with `{ours.claim.subject}` {ours.word.lower()}.{known}

Measured: {claim.statistic}. {several}. Shown in {_links(claim, root)}.

{picture}{markdown(pd.DataFrame(found))}

{markdown(pd.DataFrame(read))}

What would change it: {change(verdict)}"""


def quotation(claim: Claim) -> str:
    """The paper's words as a block quote in Markdown, or the figure that a claim is read off."""
    told = f"> “{claim.quote}” ({claim.place})" if claim.quote else f"Read off {claim.place}."
    return told + "\n\nThe paper says this of one picture or video." * claim.picture


def drawn_checks(verdict: Verdict) -> list[figures.DrawnCheck]:
    """What ``figures.claim_checks`` draws of a claim; empty where no check has rows."""
    effects = verdict.effects[""]
    if all(effect.value is None for effect in effects):
        return []
    return [
        figures.DrawnCheck(
            effect.state,
            f"{effect.estimate}, asked {effect.check.op} {effect.check.margin:g}",
            effect.check.margin,
            {"<": -1, ">": 1}.get(effect.check.op[0], 0),
            np.array([effect.value, effect.low, effect.high], float),
            np.array(effect.by_seed, float),
        )
        for effect in effects
    ]


def _under(effects: Sequence[Effect]) -> str:
    """What would be the verdict if this reading were the only one."""
    words = {
        "holds": "replicated",
        "fails": "not replicated",
        "open": "inconclusive",
        "missing": "no rows",
        "void": "not testable",
    }
    return words[state_of(effects)]


def _deciding(effects: Sequence[Effect]) -> str:
    key = min(effects, key=lambda effect: effect.ease)
    return f"{key.text}, asked {key.check.asked}"


def change(verdict: Verdict) -> str:
    """What would change a verdict, from the check that decides it, in words."""
    key, checks = verdict.key, len(verdict.checks)
    if verdict.word == DEFINITIONAL:
        return "nothing that could be measured."
    if verdict.word == UNTESTABLE:
        return "a lead to take a share of." if key.state == "void" else "rows, which are missing."
    if verdict.word == DEPENDENT:
        read = {verdict.claim.primary: "", **{reading: reading for reading in verdict.turning}}
        told = [f"{name} ({_under(verdict.effects[reading])})" for name, reading in read.items()]
        return f"to know which counts: {told[0]}, or {'; '.join(told[1:])}."
    if key.low is None:
        return "another training seed, since one has no interval."
    away, low, high = key.beyond
    several = f" All of {checks} checks have to hold." * (checks > 1)
    if verdict.word in (REPLICATED, FAILED):
        found = f"{key.text}, asked {key.check.op} {key.check.margin:g}"
        if verdict.word == REPLICATED:
            return f"rows by which the interval of a check goes past its margin; the one nearest to it is {found}."
        failing = sum(effect.state == "fails" for effect in verdict.checks)
        fewer = (
            f"none of the {failing} checks that fail does"
            if failing > 1
            else "the check that fails does not"
        )
        return f"rows by which {fewer}; {'the deciding one' if failing > 1 else 'it'} is {found}.{several}"
    side = "right" if away > 0 else "wrong"
    if low * high > 0:
        return (
            f"more rows: the interval of the deciding check lies on the {side} side of its margin by itself, but not "
            f"by Holm's procedure over {checks} checks."
        )
    if key.seeds < 2 or "trials" in key.n:
        return f"more training seeds and trials: the mean of the deciding check lies on the {side} side of its margin."
    wanted = seeds_to_decide(key, 1 if away > 0 else checks)
    many = f"about {wanted} training seeds" if wanted else "more than 100 training seeds"
    holm = f", by Holm's procedure over {checks} checks" * (checks > 1)
    return (
        f"{many} that differ as these do, which put the interval of the deciding check on the {side} side of its "
        f"margin, where its mean lies{f'.{several}' if away > 0 else f'{holm}.'}"
    )


def seeds_to_decide(effect: Effect, checks: int = 1) -> int:
    """How many training seeds that differ as these do leave the margin outside of the interval; 0: more than 100.

    checks: of a claim, of which this one is to fail by the first step of Holm's procedure.
    """
    deviation, away = np.std(effect.by_seed, ddof=1), abs(effect.beyond[0])
    sizes = np.arange(2, 101)
    quantile = 1 - (1 - effect.check.level) / 2 / checks
    enough = sizes[stdtrit(sizes - 1, quantile) * deviation / np.sqrt(sizes) < away]
    return int(enough[0]) if len(enough) else 0


def margins(verdicts: Sequence[Verdict]) -> list[tuple[str, str, str, str, np.ndarray, np.ndarray]]:
    """What ``figures.claim_margins`` draws, of every claim with rows.

    Id, the claim in our words, verdict, the deciding effect in words, how far each estimate and its interval (n, 3) lie
    beyond the margin, the deciding one last, and how far the training seeds of that one (seeds,) do.
    """
    found = []
    for verdict in verdicts:
        effects = sorted(verdict.effects[""], key=lambda effect: effect is verdict.key)
        if any(effect.value is not None for effect in effects):
            beyond = np.array(
                [e.beyond for e in effects if e.value is not None or e is verdict.key]
            )
            claim, key = verdict.claim, verdict.key
            found.append(
                (claim.id, claim.statement, verdict.word, key.text, beyond, key.seeds_beyond)
            )
    return found
