"""A claim of the paper, and the verdicts that it can get.

    REPLICATED          every check holds, and keeps its sign under every other reading of the paper that has rows
    READING-DEPENDENT   every check holds under the first reading, and the estimate of one is on the wrong side under
                        another; or not under the first, and under another
    NOT REPLICATED      the interval of some check lies beyond its margin, on the wrong side, by Holm's procedure over
                        the claim's checks
    INCONCLUSIVE        the interval of some check holds its margin, or there is none; readings that fail are named
    NOT TESTABLE        rows are missing, or were refused; or a margin is a share of a lead that is not there
    DEFINITIONAL        nothing that could be measured would contradict it; not counted

The SHA-256 of all that decides a verdict is stored with it; under another rule a stored verdict is void.
"""

from __future__ import annotations

import hashlib
import inspect
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from reproduction.claims.query import Check, Checks, Query
from reproduction.claims.shown import Shown
from tsmlib.zoo import PAPERS

VERSION = (
    4  # raise it when verdicts are reached in another way: those that are stored are void then
)
REPLICATED, DEPENDENT, INCONCLUSIVE, FAILED, UNTESTABLE, DEFINITIONAL = VERDICTS = (
    "REPLICATED",
    "READING-DEPENDENT",
    "INCONCLUSIVE",
    "NOT REPLICATED",
    "NOT TESTABLE",
    "DEFINITIONAL",
)
Rule = Callable[[Query], Checks]


@dataclass(frozen=True, eq=False)
class Claim:
    """A claim of the paper; it decorates the rule that yields its checks, whose docstring is the claim in our words.

    quote: the paper's own, ... where words are left out; '' where it is read off a figure, which ``place`` names.
    readings: name -> fields of Query. why: verdict -> what is known of its cause. depends_on: claims that have to hold
    as well. picture: the paper makes it of a video or of one picture. definition: why it cannot fail.
    subject: the model in place of the paper's own.
    """

    id: str
    place: str
    shown: Shown
    statistic: str
    rule: Rule = lambda _: iter(())
    readings: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    why: Mapping[str, str] = field(default_factory=dict)
    depends_on: Sequence[Claim] = ()
    quote: str = ""
    headline: bool = False
    picture: bool = False
    definition: str = ""
    subject: str = PAPERS

    def __call__(self, rule: Rule) -> Claim:
        return replace(self, rule=rule)

    @property
    def statement(self) -> str:
        """The claim in our words."""
        return inspect.getdoc(self.rule) or ""

    @cached_property
    def checks(self) -> dict[str, list[Check]]:
        """Reading -> checks; that of the name '' decides first."""
        others = [
            check
            for one in self.depends_on
            for check in replace(one, subject=self.subject).checks[""]
        ]
        queries = {
            name: replace(Query(self.subject), **change)
            for name, change in {"": {}, **self.readings}.items()
        }
        return {name: [*self.rule(query), *others] for name, query in queries.items()}

    @property
    def primary(self) -> str:
        """What the reading is called that decides first: plans are CEM's there, and not Adam's, as in the paper."""
        terms = [term for check in self.checks[""] for term in check.number.terms]
        return (
            "by CEM (A20)"
            if any(term.wanted.get("planner") == "cem" for term in terms)
            else "as the paper words it"
        )

    @cached_property
    def sha256(self) -> str:
        """Of all that decides the verdict: the source of the rule, and every check as it is asked."""
        lines = inspect.getsource(self.rule).splitlines()
        body = list(itertools.dropwhile(lambda line: not line.lstrip().startswith("def "), lines))
        checks = {
            reading: [[c.text, c.op, c.margin, c.level, c.premise, c.number.terms] for c in checks]
            for reading, checks in self.checks.items()
        }
        decides = json.dumps([VERSION, self.id, self.definition, body, checks], sort_keys=True)
        return hashlib.sha256(decides.encode()).hexdigest()
