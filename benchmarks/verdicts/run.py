"""How often verdicts are wrong: the checker on simulated worlds whose truth is known, and its power on published rows.

    python benchmarks/verdicts/run.py
    python benchmarks/verdicts/run.py checks           one of its parts alone, checks or worlds
    python benchmarks/verdicts/run.py --table          the table of docs/claims.md, from worlds.csv

worlds.csv: claims of 1 or 8 checks, in worlds of some training seeds and, of plans, 100 targets that are the same in
every seed; of policies, three copies within each seed. A check's value is effect + seed + target + rest, each normal,
of the deviations in KINDS. ``shared`` is the share of the seeds' variance that all checks, or all readings, have in
common. effect: in units of the margin; at 1 the claim is false, and true by any larger number. Wrong verdicts are
REPLICATED at an effect of 1, and NOT REPLICATED at an effect of 1 as well, where the truth is just not on the wrong
side. A claim with three readings has the same effect under each; READING-DEPENDENT is wrong, too.

checks.csv: every check of the ledger whose published rows have two seeds or more, and a margin: the deviation of its
values over seeds, and the share of simulated studies of ten seeds in which it holds, if its truth is as ``truth`` says.
Seeds, and targets where they are the same in every seed, differ there as they do in the rows.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from tsmlib.statistics import random_effects
from tsmlib.storage import files
from tsmlib.study.claims import evaluate, ledger
from tsmlib.study.claims.claim import DEPENDENT, FAILED, REPLICATED, Claim
from tsmlib.study.claims.query import REACHER, TSM, Check, Checks, Model, Number, Place, Query, Term
from tsmlib.study.claims.shown import FIGURE5
from tsmlib.study.zoo import PAPERS

HERE = Path(__file__).resolve().parent
MARGIN, SEEDS = 1.0, 10
SHARES = (  # metrics that lie between 0 and 1
    "cells_visited", "contact_share", "coverage50", "coverage80", "coverage95", "deflection_coverage80", "diverged",
    "moves_untouched", "penetrates", "recall", "success50", "violations_worst", "within_data",
)  # fmt: skip
POSSIBLE = {"auc": (0.5, 1.0)} | dict.fromkeys(SHARES, (0.0, 1.0))
BEYOND, NEAREST, MIDWAY = "beyond", "nearest", "midway"  # where the truth of a check is taken to be


class Deviations(NamedTuple):
    """Standard deviations of a check's value, in worlds in units of the margin; targets: how many, 1 for scores."""

    seed: float
    target: float
    rest: float
    targets: int


class Kind(NamedTuple):
    """Worlds of a kind.

    ask: a claim's number of a model. shared: of the seeds' variance, in all checks and readings. readings: other ones.
    seeds: how many, in turn.
    """

    how: Deviations
    ask: Callable[[Query, Model, Place], Number]
    shared: float = 0.0
    readings: Mapping[str, Mapping[str, str]] = {}
    seeds: tuple[int, ...] = (3, 5, 10)


SCORES = Deviations(0.5, 0.0, 0.0, 1)
FEW_TO_TEN, CHECKS, EFFECTS = (1, 3, 5, 6, 10), (1, 8), (1.0, 2.0)
OTHERS = {"second": {"likelihood": "ll_shared"}, "third": {"likelihood": "ll_horizon"}}  # readings
KINDS = {
    "scores": Kind(SCORES, Query.ll, seeds=FEW_TO_TEN),
    "plans": Kind(Deviations(0.5, 2.5, 2.5, 100), Query.executed, seeds=FEW_TO_TEN),
    "policies, 3 copies": Kind(Deviations(0.5, 0.0, 0.5, 3), Query.final),
    "scores, checks that share half": Kind(SCORES, Query.ll, 0.5),
    "scores, three readings that share half": Kind(SCORES, Query.ll, 0.5, OTHERS),
}  # fmt: skip


def drawn(
    effects: np.ndarray, seeds: int, how: Deviations, rng: np.random.Generator, shared: float = 0.0
) -> np.ndarray:
    """Values (effects, seeds, targets) of studies. shared: of the seeds' variance, in all effects alike."""
    shape = (len(effects), seeds, how.targets)
    noise = rng.standard_normal((*shape[:2], 1))
    if shared:
        noise = (1 - shared) ** 0.5 * noise + shared**0.5 * rng.standard_normal((1, seeds, 1))
    values = effects[:, None, None] + how.seed * noise
    return values + how.target * rng.standard_normal((shape[0], 1, shape[2])) + how.rest * rng.standard_normal(shape)


class World(evaluate.Tables):
    """Rows of a world: under each reading a value (seeds, targets) of each rival, and 0 for the paper's model."""

    def __init__(self, effects: np.ndarray, seeds: int, kind: Kind, rng: np.random.Generator) -> None:
        metrics = [term.metric for term in kind.ask(Query(), TSM, REACHER).terms]
        metrics += [reading["likelihood"] for reading in kind.readings.values()]
        values = drawn(np.tile(effects, len(metrics)), seeds, kind.how, rng, kind.shared)
        asked = product(metrics, range(len(effects)))
        self.values = {(metric, f"rival{i}"): -each for (metric, i), each in zip(asked, values, strict=True)}
        self.values |= {(metric, PAPERS): np.zeros(values.shape[1:]) for metric in metrics}

    def ask(self, term: Term) -> pd.DataFrame:
        return pd.DataFrame(self.values[term.metric, term.model])


def superiority(n_checks: int, kind: Kind) -> Claim:
    """The paper's model is ahead of each of so many rivals by more than the margin."""

    def rule(q: Query) -> Checks:
        for i in range(n_checks):
            found = kind.ask(q, TSM, REACHER) - kind.ask(q, Model(f"rival{i}"), REACHER) > MARGIN
            assert isinstance(found, Check)
            yield found

    return Claim("X1", "simulated", FIGURE5, "it", readings=kind.readings)(rule)


def worlds(studies: int, rng: np.random.Generator) -> pd.DataFrame:
    """A line for each kind of rows, number of seeds, of checks, and effect."""
    lines = []
    for name, kind in KINDS.items():
        for seeds, n_checks, effect in product(kind.seeds, CHECKS, EFFECTS):
            asked, effects = superiority(n_checks, kind), np.full(n_checks, effect)
            words = [evaluate.judge(asked, World(effects, seeds, kind, rng)).word for _ in range(studies)]
            shares = {word.lower(): words.count(word) / studies for word in (REPLICATED, DEPENDENT, FAILED)}
            about = {"rows": name, "seeds": seeds, "checks": n_checks, "effect": effect}
            lines.append({**about, **shares, "studies": studies})
    return pd.DataFrame(lines)


def checks(studies: int, rng: np.random.Generator) -> pd.DataFrame:
    """A line for each check of the ledger with rows of several seeds and a margin."""
    claims, lines = ledger.claims(PAPERS), []
    rows = evaluate.tables(claims)
    for one, check in ((each, check) for each in claims for check in each.checks[""]):
        if not check.margin or check.op == "==" or not check.number.terms:
            continue
        try:
            values, _ = evaluate.of_seeds(check, asked := rows.asked(check))
        except evaluate.ClaimError:
            continue
        if len(values) < 2:
            continue
        other = [each.margin for each in one.checks[""] if each.number is check.number and each is not check]
        value, why = truth(check, other)
        how = deviations(values, crossed=not evaluate.nested(asked))
        found = (random_effects(study) for study in drawn(np.full(studies, value), SEEDS, how, rng))
        holds = [evaluate.compared(check, each, "").state == "holds" for each in found]
        lines.append({
            "claim": one.id, "check": check.text, "seeds": len(values),
            "deviation": f"{values.mean(1).std(ddof=1):.3g}", "margin": check.margin, "truth": round(value, 6),
            "why": why, "power": f"{np.mean(holds):.3f}", "studies": studies,
        })  # fmt: skip
    return pd.DataFrame(lines)


def truth(check: Check, other: list[float]) -> tuple[float, str]:
    """What the truth is taken to be, and one of BEYOND, NEAREST and MIDWAY.

    As far beyond the margin as that is from zero; where it cannot be, the nearest that it can. other: the margin on the
    other side, where a check is half of a test of equivalence: midway between both, since both halves have to hold.
    """
    if other:
        return (check.margin + other[0]) / 2, MIDWAY
    value = check.margin + abs(check.margin) * (-1 if check.op[0] == "<" else 1)
    share = check.number.text.startswith("share(")
    low, high = (0.0, 1.0) if share else POSSIBLE.get(check.number.terms[0].metric, (-np.inf, np.inf))
    return (value, BEYOND) if low <= value <= high else (low if value < low else high, NEAREST)


def deviations(values: np.ndarray, *, crossed: bool) -> Deviations:
    """Of a check's values (seeds, trials). crossed: the trials are the same in every seed, else their means count."""
    seeds, trials = values.shape
    rows, columns = values.mean(1, keepdims=True), values.mean(0, keepdims=True)
    if trials == 1 or not crossed:
        return Deviations(float(rows.std(ddof=1)), 0.0, 0.0, 1)
    rest = ((values - rows - columns + values.mean()) ** 2).sum() / ((seeds - 1) * (trials - 1))
    of_seeds, of_trials = rows.var(ddof=1) - rest / trials, columns.var(ddof=1) - rest / seeds
    return Deviations(*(float(max(part, 0.0) ** 0.5) for part in (of_seeds, of_trials, rest)), trials)


PARTS = {"checks": checks, "worlds": worlds}


def page_table(found: pd.DataFrame) -> str:
    """What docs/claims.md says of worlds, in Markdown: wrong verdicts at an effect of 1, right ones at 2.

    Scores of one seed have no interval, and so no verdict.
    """
    decided = found[(found["seeds"] > 1) | (found["rows"] == "plans")]
    lines = [
        "| rows | training seeds | checks | wrongly replicated, effect 1 | wrongly not replicated, effect 1 | "
        "reading-dependent, effect 1 | replicated, effect 2 |",
        "|---|---|---|---|---|---|---|",
    ]
    for (rows, seeds, n_checks), pair in decided.groupby(["rows", "seeds", "checks"], sort=False):
        false, true = (pair[pair["effect"] == effect].iloc[0] for effect in (1, 2))
        shares = [*(false[word.lower()] for word in (REPLICATED, FAILED, DEPENDENT)), true[REPLICATED.lower()]]
        lines.append(f"| {rows} | {seeds} | {n_checks} | {' | '.join(map(percent, shares))} |")
    return "\n".join(lines)


def percent(share: float) -> str:
    """Two digits."""
    return f"{100 * share:.2g} %" if 0 < share < 0.995 else f"{share:.0%}".replace("%", " %" if share else "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="part", help=f"{' or '.join(PARTS)} (default: both)")
    parser.add_argument("--studies", type=int, default=400, help="of each line (default 400)")
    parser.add_argument("--out", type=Path, default=HERE, help="folder (default: that of this script)")
    parser.add_argument("--table", action="store_true", help="print the table that docs/claims.md has, and stop")
    given = parser.parse_args()
    if given.table:
        print(page_table(pd.read_csv(HERE / "worlds.csv")))
        return
    if unknown := set(given.parts) - set(PARTS):
        parser.error(f"no part is called {', '.join(sorted(unknown))}; there are {' and '.join(PARTS)}")
    if given.studies < 1:
        parser.error(f"--studies {given.studies}: expected at least 1; the tables that ship are of 400, the default")
    found = {name: PARTS[name](given.studies, np.random.default_rng(0)) for name in given.parts or PARTS}
    for name, lines in found.items():
        files.write_bytes(given.out / f"{name}.csv", lines.to_csv(index=False).encode())
        print(lines.to_string(index=False))


if __name__ == "__main__":
    main()
