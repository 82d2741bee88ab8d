"""Verdicts on the claims of the ledger, from rows of the results tables.

    claim -> checks -> effects and their intervals over training seeds -> verdict

Where every term of a check has trials (targets, copies of a policy), the interval is of their pseudo-values
(jackknife): over seeds and targets as two random effects, since the targets are the same in every seed; over the means
of seeds, where trials are a seed's own copies. With one training seed it is over its trials, and then says nothing
about training; without trials there is no interval, and nothing follows.

A claim holds if every check does, at its own level. It fails if some check does: by Holm's procedure over the claim's
checks, so that many checks do not make a failure likely by chance.
"""

from __future__ import annotations

import itertools
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pandas as pd

from tsmlib.statistics import Estimate, holm, random_effects
from tsmlib.storage import tables as tables_storage
from reproduction.claims.claim import (
    DEFINITIONAL,
    DEPENDENT,
    FAILED,
    INCONCLUSIVE,
    REPLICATED,
    UNTESTABLE,
    Claim,
)
from reproduction.claims.query import Check, Term
from reproduction.notebooks import require
from reproduction.results.table import others
from reproduction.runs import RESULTS, Run, find, notebooks

UNTOLD = {
    "samples_to_90"
}  # not told by a curve that was recorded too rarely (``results.policies.plateau_rows``)
TRIALS = ("target", "copy")  # columns that number the trials inside a seed
MADE_BY = {  # table -> what to run where it lacks rows; of the others, their notebook
    "03_ablation": "python -m tsmlib run predict --scale paper",
    "model_free": "benchmarks/model_free (its README says how)",
}


class ClaimError(ValueError):
    """Rows of ``table`` that cannot be judged: missing, doubled, of different seeds or trials."""

    def __init__(self, message: str, table: str = "") -> None:
        super().__init__(message)
        self.table = table


@dataclass(frozen=True)
class Effect:
    """What rows say of a check: estimate, interval where there is one, n in words, and a state.

    p: one-sided p value against lying on the claimed side of the margin, where there is an interval.
    by_seed: the number of each training seed, where it has trials the mean of their pseudo-values.
    """

    check: Check
    state: str  # one of STATES
    value: float | None = None
    low: float | None = None
    high: float | None = None
    n: str = ""
    why: str = ""
    p: float = np.nan
    by_seed: tuple[float, ...] = ()

    @property
    def seeds(self) -> int:
        """How many training seeds there are."""
        return len(self.by_seed)

    @property
    def beyond(self) -> np.ndarray:
        """How far estimate and ends of the interval (3,) lie beyond the margin: negative on the wrong side, or NaN."""
        return self._beyond(self.value, self.low, self.high)

    @property
    def seeds_beyond(self) -> np.ndarray:
        """The same of each training seed (seeds,)."""
        return self._beyond(*self.by_seed)

    def _beyond(self, *numbers: float | None) -> np.ndarray:
        found = np.array([np.nan if number is None else number for number in numbers])
        return (found - self.check.margin) * (-1 if self.check.op[0] == "<" else 1)

    @property
    def right_side(self) -> bool:
        """Whether the estimate keeps the claimed sign; what cannot be estimated does not contradict it."""
        return (
            self.value is None
            or self.check.op == "=="
            or bool(self.check.accepts(self.value, self.value))
        )

    @property
    def against(self) -> bool:
        """Whether the whole interval lies on the wrong side of the margin."""
        if self.low is None or self.high is None or self.check.op == "==":
            return False
        return not self.right_side and not self.low <= self.check.margin <= self.high

    @property
    def ease(self) -> tuple[int, float]:
        """Sorts checks by how far they are from holding, the furthest first."""
        value, low, high = self.beyond
        if np.isnan(low):  # of what has no interval the side alone is known
            return STATES.index(self.state), -1.0 if value < 0 else 0.0
        return STATES.index(self.state), float(value / (abs(high - low) + 1e-300))

    @property
    def estimate(self) -> str:
        """Estimate and interval in words."""
        if self.value is None:
            return "no rows"
        level = " (90 %)" * (self.check.level == 0.90)
        return f"{self.value:.3g}" + (
            "" if self.low is None else f" [{self.low:.3g}, {self.high:.3g}]{level}"
        )

    @property
    def text(self) -> str:
        """Estimate, interval and n in words."""
        counted = f"n = {self.n}" if self.n[:1].isdigit() else self.n  # what is exact has no number
        return self.estimate if self.value is None else f"{self.estimate}, {counted}"


STATES = (
    "void",
    "fails",
    "missing",
    "open",
    "holds",
)  # of a whole rule the first that one of its checks has


@dataclass(frozen=True)
class Verdict:
    """A claim, one of VERDICTS, why, and the effects of each reading.

    turning: readings by which a claim that is DEPENDENT gets another verdict than by the first.
    """

    claim: Claim
    word: str
    why: str
    effects: Mapping[str, Sequence[Effect]]
    turning: Sequence[str] = ()

    @property
    def key(self) -> Effect:
        """The check of the primary reading that decides: the one that is furthest from holding."""
        return min(self.effects[""], key=lambda effect: effect.ease)

    @property
    def checks(self) -> list[Effect]:
        """The effects that have to hold: of the primary reading, without premises."""
        return [effect for effect in self.effects[""] if not effect.check.premise]

    @property
    def seeds(self) -> int:
        """The least number of training seeds that any of its checks with rows has; 0 where there are none."""
        return min((effect.seeds for effect in self.checks if effect.seeds), default=0)

    @property
    def without_rows(self) -> int:
        """How many of its checks have no rows."""
        return sum(effect.value is None for effect in self.checks)

    @property
    def failing_readings(self) -> dict[str, int]:
        """The other readings of the paper under which an inconclusive claim fails -> training seeds of what fails."""
        named = self.effects.items() if self.word == INCONCLUSIVE else ()
        return {
            reading: max(effect.seeds for effect in found if effect.state == "fails")
            for reading, found in named
            if reading and state_of(found) == "fails"
        }


# Rows ----------------------------------------------------------------------------------------------------------------


class Tables:
    """Rows of results tables; those of ``<file>_rows``, one per trial, count as the file's."""

    def __init__(self, rows: Mapping[str, pd.DataFrame]) -> None:
        self.rows = rows
        self.ask, self._lines = cache(self._ask), cache(self._read)
        self.parts: dict[tuple[Hashable, ...], list[pd.DataFrame]] = {}
        for file, table in rows.items():
            trial = (
                table[[name for name in TRIALS if name in table]]
                .astype(float)
                .max(axis=1)
                .fillna(-1)
                .astype(int)
            )
            filled = table.astype(object).where(table.notna(), "").assign(trial=trial)
            for (metric, model), part in filled.groupby(["metric", "model"]) if len(table) else ():
                self.parts.setdefault((file.removesuffix("_rows"), metric, model), []).append(part)

    def relabelled(self, models: Mapping[str, str]) -> Tables:
        """The same rows with other models' names on them: a check of the checker."""
        return Tables(
            {
                file: table.assign(model=table["model"].replace(models))
                for file, table in self.rows.items()
            }
        )

    def asked(self, check: Check) -> dict[Term, pd.DataFrame]:
        """``ask`` for every term of a check. What is averaged along learning curves is where all of them were recorded,
        since a curve that goes on for longer spends more of it near its end. ClaimError as ``ask``, and where curves
        have no more than one such place."""
        averaged = [
            set(next(iter(self._lines(term).values())))
            for term in check.number.terms
            if term.average
        ]
        common = frozenset[float]().union(*averaged).intersection(*averaged)
        if averaged and len(common) < 2:
            raise ClaimError(
                f"curves were recorded at different places in {check.text}",
                check.number.terms[0].table,
            )
        return {
            term: self.ask(term, common) if term.average else self.ask(term)
            for term in check.number.terms
        }

    def _ask(self, term: Term, among: frozenset[float] = frozenset()) -> pd.DataFrame:
        """Values (seeds, trials), one column where there are no trials; of a curve at its end, or the mean ``among``
        some places. ClaimError for rows missing or wrong."""
        values = {
            key: np.mean([line[at] for at in sorted(among)]) if among else line[max(line)]
            for key, line in self._lines(term).items()
        }
        return pd.Series(values).unstack().sort_index().sort_index(axis=1)

    def _read(self, term: Term) -> dict[tuple[int, int], dict[float, float]]:
        """(seed, trial) -> place on the curve -> value."""
        asked = ", ".join(
            f"{column} {value}"
            for column, value in term.wanted.items()
            if value not in ("", "paper")
        )
        said = f"of {term.metric}{' by trial' * term.trials} (model {term.model}, {asked})"
        for part in self.parts.get((term.table, term.metric, term.model), []):
            keep = (part["trial"].to_numpy() >= 0) == term.trials
            for column, value in term.wanted.items():
                keep &= (part[column].to_numpy() == value) if column in part else value == ""
            if keep.any():
                break
        else:
            raise ClaimError(f"no rows yet in {term.table}.csv {said}", term.table)
        lines: dict[tuple[int, int], dict[float, float]] = {}
        columns = (
            part[keep][name].tolist() for name in ("seed", "trial", term.curve or "trial", "value")
        )
        for seed, trial, at, value in zip(*columns, strict=True):
            line = lines.setdefault((seed, trial), {})
            if at in line or value == "":
                what = "two rows" if at in line else "nan"
                raise ClaimError(f"{term.table}.csv has {what} for seed {seed} {said}", term.table)
            line[at] = value
        if term.curve and len({tuple(sorted(line)) for line in lines.values()}) > 1:
            raise ClaimError(f"{term.table}.csv has curves of different lengths {said}", term.table)
        return lines


def tables(claims: Sequence[Claim], run: Run | None = None) -> Tables:
    """The rows that ship. run: of scale paper; its rows, and those of each seed beside it, take the place of those of
    the same seed, environment, model and method.

    RunError where a notebook that made such rows did not come to its end.
    """
    checks = [check for claim in claims for found in claim.checks.values() for check in found]
    files = {term.table for check in checks for term in check.number.terms}
    names = sorted(files | {f"{file}_rows" for file in files})
    paths = {name: tables_storage.stored(RESULTS / f"{name}.csv") for name in names}
    rows = {name: tables_storage.load(path) for name, path in paths.items() if path}
    stems = {
        notebook.stem[:3]: notebook.stem for notebook in notebooks().values()
    }  # 03_ablation is 03_predict's
    runs = run.seeds() if run and run.scale == "paper" else []
    for name in names:
        found = list[pd.DataFrame]()
        for one in runs:
            if (path := one.dir / "metrics" / f"{name}.csv").exists():
                if name[:3] in stems:
                    require(one, stems[name[:3]])
                found.append(tables_storage.load(path))
        if found:
            own = pd.concat(found)
            rows[name] = pd.concat([others(rows.get(name, own[:0]), own), own], ignore_index=True)
    return Tables(rows)


# Judging -------------------------------------------------------------------------------------------------------------


def judge(claim: Claim, rows: Tables) -> Verdict:
    """What rows say of a claim."""
    effects = {
        reading: _void(claim, checks, rows)
        + _of_one_family([_effect(claim, c, rows) for c in checks if not c.premise])
        for reading, checks in claim.checks.items()
    }
    states = {reading: state_of(found) for reading, found in effects.items()}
    first, key = states.pop(""), min(effects[""], key=lambda effect: effect.ease)
    holds, fails = (
        [reading for reading, found in states.items() if found == state]
        for state in ("holds", "fails")
    )
    turned = [
        reading
        for reading, found in states.items()
        if found != "void" and not all(effect.right_side for effect in effects[reading])
    ]
    measured = f"{key.check.text}: it is {key.text}."
    failing = sum(effect.state == "fails" for effect in effects[""])
    word, why = {
        "holds": (REPLICATED, ""),
        "fails": (FAILED, f"{measured} {failing} of {len(effects[''])} checks fail."),
        "open": (
            INCONCLUSIVE,
            f"{measured} {_undecided(key, len(effects['']))}"
            + f" It fails under {', '.join(fails)}." * bool(fails),
        ),
        "missing": (UNTESTABLE, key.why),
        "void": (UNTESTABLE, key.why),
    }[first]
    if claim.definition:
        word, why = DEFINITIONAL, claim.definition
    elif first == "holds" and turned:
        word, why = DEPENDENT, f"It holds {claim.primary}. It turns with: {'; '.join(turned)}."
    elif first in ("fails", "open") and holds:
        first_reading = claim.primary[0].upper() + claim.primary[1:]
        word, why = DEPENDENT, f"It holds with: {'; '.join(holds)}. {first_reading}, {why}"
    turning = () if word != DEPENDENT else turned if first == "holds" else holds
    return Verdict(
        claim, word, " ".join(filter(None, [why, claim.why.get(word, "")])), effects, turning
    )


def state_of(effects: Sequence[Effect]) -> str:
    """Of a rule: void where a premise does not hold; else one check that fails decides, whatever is missing."""
    return min((effect.state for effect in effects), key=STATES.index)


def _void(claim: Claim, checks: Sequence[Check], rows: Tables) -> list[Effect]:
    """The premises that do not hold by their estimates."""
    found = [_effect(claim, check, rows) for check in checks if check.premise]
    return [
        replace(
            effect,
            state="void",
            why=f"A margin is a share of {effect.check.number.text}: it is {effect.text}.",
        )
        for effect in found
        if not effect.right_side
    ]


def _undecided(key: Effect, checks: int) -> str:
    """Why a check decides nothing."""
    if key.low is None:
        return "One seed has no interval."
    if key.against:
        return f"The interval lies on the wrong side, but not by Holm's procedure over {checks} checks."
    return "The interval holds the margin."


def _of_one_family(effects: Sequence[Effect]) -> list[Effect]:
    """The effects of one reading; of those that fail by themselves only what Holm's procedure leaves."""
    rejected = holm(
        [effect.p for effect in effects], [(1 - effect.check.level) / 2 for effect in effects]
    )
    return [
        replace(effect, state="open")
        if effect.state == "fails" and np.isfinite(effect.p) and not left
        else effect
        for effect, left in zip(effects, rejected, strict=True)
    ]


def _effect(claim: Claim, check: Check, rows: Tables) -> Effect:
    try:
        return measure(check, rows)
    except ClaimError as error:
        notebook = find(error.table)
        word = notebook.name if notebook else "all"
        command = MADE_BY.get(error.table, f"python -m tsmlib run {word} --scale paper")
        return Effect(check, "missing", why=f"{claim.id}: {error}. Run: {command}")


def measure(check: Check, rows: Tables) -> Effect:
    """Estimate and interval of a check. ClaimError where rows are missing, doubled, or do not belong together."""
    asked = rows.asked(check)
    if not asked:  # arithmetic
        exact = float(check.number.of({}))
        return Effect(
            check, "holds" if check.accepts(exact, exact) else "fails", exact, exact, exact, "exact"
        )
    values, n = of_seeds(check, asked)
    found = compared(check, random_effects(values, crossed=not nested(asked)), n)
    return replace(found, by_seed=tuple(values.mean(1).tolist()))


def nested(terms: Iterable[Term]) -> bool:
    """Whether trials are a seed's own, copies of a policy, and not targets that all seeds have."""
    return any(term.curve for term in terms)


def of_seeds(check: Check, asked: Mapping[Term, pd.DataFrame]) -> tuple[np.ndarray, str]:
    """A check's values (seeds, trials), one column where there are no trials, and n in words. asked: rows of its terms.

    ClaimError where they do not belong together.
    """
    seeds, own = _paired(check, asked)
    whole = not any(np.isnan(found).any() for found in own.values())

    def number(i: int, without: int | None = None) -> float:
        rows = {term: values[i] if term.trials else values[i, 0] for term, values in own.items()}
        if not whole:
            rows = {
                term: values[~np.isnan(values)] if term.trials else values
                for term, values in rows.items()
            }
        if without is not None:
            rows = {term: np.delete(values, without) for term, values in rows.items()}
        with np.errstate(all="ignore"):
            value = float(check.number.of(rows))
        if not np.isfinite(value):
            raise ClaimError(
                f"{check.text}: {value} in seed {seeds[i]}", check.number.terms[0].table
            )
        return value

    values, n = (
        np.array([[number(i)] for i in range(len(seeds))]),
        f"{len(seeds)} seed{'s' * (len(seeds) > 1)}",
    )
    trials = min(found.shape[1] for found in own.values())  # 1 where a term has none
    if trials > 1 and whole:
        # pseudo-values (seeds, trials): of a mean, the trials' own
        left_out = np.array(
            [[number(i, without=j) for j in range(trials)] for i in range(len(seeds))]
        )
        values = trials * values - (trials - 1) * left_out
        n = f"{n} of {trials} copies each" if nested(asked) else f"{trials} trials of {n}"
    return values, n


def compared(check: Check, found: Estimate, n: str) -> Effect:
    """The effect of a check, from its estimate."""
    if not found.dof:
        return Effect(check, "open", found.mean, n=n)
    half = found.half(check.level)
    low, high = found.mean - half, found.mean + half
    inside = check.op != "==" and low <= check.margin <= high
    state = "holds" if check.accepts(low, high) else "open" if inside else "fails"
    p = np.nan
    if check.op != "==":  # mirrored, since a mean on the margin is no evidence against either side
        sign = -1 if check.op[0] == "<" else 1
        p = replace(found, mean=sign * found.mean).p_below(sign * check.margin)
    return Effect(check, state, found.mean, low, high, n, p=p)


def _paired(
    check: Check, asked: Mapping[Term, pd.DataFrame]
) -> tuple[list[int], dict[Term, np.ndarray]]:
    """The seeds that all terms have, and the values (seeds, trials) of each. ClaimError where rows do not pair."""
    for (a, one), (b, two) in itertools.combinations(asked.items(), 2):
        about = ("env", "noise", "delay", "subset", "execution")
        same = a.table == b.table and all(
            a.wanted.get(column) == b.wanted.get(column) for column in about
        )
        same = same and not {a.metric, b.metric} & UNTOLD
        if same and set(one.index) != set(two.index):  # elsewhere the seeds that both have count
            has = f"{one.index.tolist()} of {a.text}, and {two.index.tolist()} of {b.text}"
            raise ClaimError(f"{a.table}.csv has seeds {has} in {check.text}", a.table)
    seeds = sorted(set.intersection(*(set(found.index) for found in asked.values())))
    if not seeds:
        raise ClaimError(f"no seed has rows for all of {check.text}", check.number.terms[0].table)
    paired = {term: found.loc[seeds].dropna(axis=1, how="all") for term, found in asked.items()}
    by_trial = {term: found for term, found in paired.items() if term.trials}
    if (
        len(
            {
                (tuple(found.columns), found.isna().to_numpy().tobytes())
                for found in by_trial.values()
            }
        )
        > 1
    ):
        file, texts = next(iter(by_trial)).table, ", ".join(term.text for term in by_trial)
        raise ClaimError(f"{file}.csv has different trials of {texts}", file)
    return seeds, {term: found.to_numpy() for term, found in paired.items()}


# What is stored ------------------------------------------------------------------------------------------------------

EXTRA = (
    "claim",
    "reading",
    "check",
    "low",
    "high",
    "margin",
    "level",
    "state",
    "verdict",
    "sha256",
)


def as_rows(verdicts: Sequence[Verdict], *, scale: str) -> list[dict[str, str | float]]:
    """Rows of metrics/08_claims.csv, one per effect, and at least one per claim; without what an effect lacks."""
    rows = (
        dict(
            model=v.claim.subject,
            metric="effect",
            scale=scale,
            claim=v.claim.id,
            reading=reading,
            check=e.check.text,
            value=e.value,
            low=e.low,
            high=e.high,
            margin=e.check.margin,
            level=e.check.level,
            n=e.n,
            state=e.state,
            verdict=v.word,
            sha256=v.claim.sha256,
        )
        for v in verdicts
        for reading, effects in v.effects.items()
        for e in effects
        if e.value is not None or e is v.key
    )
    return [{name: value for name, value in row.items() if value is not None} for row in rows]
