"""The ledger: what each claim says, the comparisons that test it, and what they found in words."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from itertools import product
from pathlib import Path

import jinja2
import pandas as pd

from reproduction.claims.judge import Comparison, Finding, Tables, compare
from reproduction.tables import RESULTS, TEXTS, published

LEDGER = Path(__file__).with_name("ledger.toml")
TEMPLATE = Path(__file__).with_name("claims.md.j2")
ARMS = {"Reacher": "reaching", "ReacherObstacle": "the obstacle", "ReacherPush": "pushing"}
IMPERFECT = {"noise0.25": "noisy sensors", "delay5": "delayed actions"}


@dataclass(frozen=True)
class Claim:
    """A claim of the paper.

    Args:
        id: C01 to C54; place: in the paper; quote: its words; says: ours.
        headline: whether it is one of the main claims.
        comparisons: that test it; control: has to hold for it to be testable.
        note: what is known of the cause; definition: why nothing could contradict it.
        untested: why no comparison tests it.
    """

    id: str
    place: str
    quote: str
    says: str
    headline: bool = False
    comparisons: tuple[Comparison, ...] = ()
    control: tuple[Comparison, ...] = ()
    note: str = ""
    definition: str = ""
    untested: str = ""


@dataclass(frozen=True)
class Verdict:
    """A claim and what its comparisons found."""

    claim: Claim
    findings: Sequence[Finding]
    controls: Sequence[Finding] = field(default=())

    @property
    def counts(self) -> tuple[int, int, int]:
        """Comparisons that hold, that do not, and that are open."""
        held = [finding.holds for finding in self.findings]
        return held.count(True), held.count(False), held.count(None)

    @property
    def word(self) -> str:
        """holds, holds in part, does not hold, open, not testable, not tested or by definition."""
        if self.claim.definition:
            return "true by definition"
        if self.claim.untested:
            return "not tested"
        if any(not control.holds for control in self.controls):
            return "not testable"
        hold, fail, _ = self.counts
        if hold == len(self.findings):
            return "holds"
        return "holds in part" if hold else ("does not hold" if fail else "open")

    @property
    def found(self) -> str:
        """What was found, in plain words."""
        if self.claim.definition:
            return f"True by definition. {self.claim.definition}"
        if self.claim.untested:
            return f"Not tested. {self.claim.untested}"
        if self.word == "not testable":
            return f"Not testable. {self.claim.note}"
        hold, places = self.counts[0], dict[str, list[bool | None]]()
        for finding in self.findings:
            places.setdefault(_told(finding.comparison.on), []).append(finding.holds)
        groups = {
            "holds on": [k for k, held in places.items() if all(held)],
            "in part on": [k for k, held in places.items() if any(held) and not all(held)],
            "not on": [k for k, held in places.items() if not any(held) and False in held],
            "open on": [k for k, held in places.items() if set(held) == {None}],
        }
        parts = [f"{word} {_listed(names)}" for word, names in groups.items() if names]
        said = f"{', '.join(parts)} ({hold} of {len(self.findings)})."
        return f"{said[0].upper()}{said[1:]} {self.claim.note}".strip()


def claims(path: Path = LEDGER) -> list[Claim]:
    """The claims in the order of the paper; those that rest on others have their comparisons.

    Args:
        path: of the ledger.

    Returns:
        The claims.
    """
    found: dict[str, Claim] = {}
    entries = tomllib.loads(path.read_text(encoding="utf-8"))
    for name, entry in entries.items():
        written = list(entry.pop("compare", []))
        for other in entry.pop("rests_on", []):
            written += entries[other].get("compare", [])
        control = [entry.pop("control")] if "control" in entry else []
        both = {"comparisons": _expanded(written), "control": _expanded(control)}
        found[name] = Claim(name, **entry, **both)
    return list(found.values())


@cache
def results(name: str) -> pd.DataFrame:
    """A table of data/results, in a form that is fast to select from."""
    table = published(name)
    return table.astype({column: "category" for column in TEXTS if column in table})


def judge(claim: Claim, tables: Tables = results) -> Verdict:
    """What the comparisons of a claim find in tables, by default those of data/results."""
    findings = [compare(one, tables) for one in claim.comparisons]
    return Verdict(claim, findings, [compare(one, tables) for one in claim.control])


def as_table(verdicts: Sequence[Verdict]) -> pd.DataFrame:
    """One line for each comparison."""
    lines = []
    for verdict in verdicts:
        for finding in (*verdict.findings, *verdict.controls):
            one = finding.comparison
            line = {"claim": verdict.claim.id, "table": one.table, "measure": one.measure}
            line |= {"a": one.a, "b": one.b, "on": one.on, "steps_ahead": one.at or None}
            line |= {"b_on": one.b_on, "where": _spelled(one.where), "times": one.times}
            line |= {"difference": finding.difference, "low": finding.low, "high": finding.high}
            line |= {"smallest": finding.smallest, "ahead": finding.ahead}
            line |= {"seeds": finding.seeds, "units": finding.units, "expected": one.expect}
            held = {True: "yes", False: "no", None: finding.word}[finding.holds]
            lines.append(line | {"found": finding.word, "holds": held})
    table = pd.DataFrame(lines)
    numbers = ["difference", "low", "high", "smallest", "ahead"]
    table[numbers] = table[numbers].map(lambda x: float(f"{x:.4g}"))
    table["steps_ahead"] = table["steps_ahead"].astype("Int64")
    return table


def page(verdicts: Sequence[Verdict]) -> str:
    """The claims on one page, in Markdown."""
    words = [verdict.word for verdict in verdicts]
    counts = {word: words.count(word) for word in dict.fromkeys(words)}
    loader = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True)
    template = loader.from_string(TEMPLATE.read_text(encoding="utf-8"))
    return template.render(verdicts=verdicts, counts=counts)


def write(docs: Path) -> list[Path]:
    """Judge all claims and write ``08_claims.csv`` and ``docs/claims.md``."""
    verdicts = [judge(claim) for claim in claims()]
    table, text = RESULTS / "08_claims.csv", docs / "claims.md"
    as_table(verdicts).to_csv(table, index=False, lineterminator="\n")
    text.write_text(page(verdicts), encoding="utf-8")
    return [table, text]


def _expanded(written: Sequence[Mapping[str, object]]) -> tuple[Comparison, ...]:
    """A comparison for each combination of what is written as a list."""
    found, known = [], {each.name for each in fields(Comparison)}
    for entry in written:
        if unknown := set(entry) - known:
            raise ValueError(f"a comparison has no {', '.join(sorted(unknown))}: {dict(entry)}")
        lists = {k: v if isinstance(v, list) else [v] for k, v in entry.items()}
        for values in product(*lists.values()):
            one = dict(zip(lists, values, strict=True))
            for name in ("where", "b_where"):
                one[name] = tuple(dict(one.get(name, {})).items())
            found.append(Comparison(**one))
    return tuple(found)


def _told(on: str) -> str:
    """An arm as a reader knows it."""
    arm, _, imperfect = on.partition("-")
    return IMPERFECT.get(imperfect, ARMS[arm])


def _listed(names: Sequence[str]) -> str:
    """Names with commas, and "and" before the last."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def _spelled(where: Sequence[tuple[str, object]]) -> str:
    return ", ".join(f"{name} {value}" for name, value in where)
