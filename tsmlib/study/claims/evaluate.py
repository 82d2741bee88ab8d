"""The ledger: what the paper claims, as rules over rows of the metrics tables, and what the rows say of each claim.

    statement -> rule -> effect and its interval over training seeds -> verdict

``claims.toml`` holds the claims. A rule is an inequality between numbers that every training seed has:

    tsm - onestep > 0.5                a row of a table per seed; the difference is paired by seed
    mean(lap) - mean(tsm) > 0          a row per target or copy, averaged inside the seed: trials are never counted as n
    -0.1 * a < b - c < 0.1 * a         equivalence: two one-sided tests, a 90 % interval where others have 95 %
    a == b                             the interval of the difference holds zero

``word[place].metric[horizon]`` is a query: words and places are sets of columns that claims.toml names, and what stands
further right overrules. Functions: abs, log, min, max, middle (the median), range; and over the trials of a seed mean,
share (of those for which an inequality is true) and corr.

With one training seed the interval is over its trials (jackknife) if every term of the check has them, and then says
nothing about training; without them there is no interval, and nothing follows.

    REPLICATED          every check holds, and keeps its sign under every other reading of the paper that has rows
    READING-DEPENDENT   the rule holds under some reading, not under all
    NOT REPLICATED      the interval of some check lies beyond its margin, on the wrong side
    INCONCLUSIVE        the interval of some check holds its margin, or there is none
    NOT TESTABLE        rows are missing, or were refused

The SHA-256 of all that decides a verdict is stored with it; under another rule a stored verdict is void.
"""

from __future__ import annotations

import ast
import hashlib
import itertools
import json
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tsmlib.statistics import interval
from tsmlib.storage import tables as tables_storage
from tsmlib.study.notebooks import require
from tsmlib.study.runs import ROOT, Run, notebooks

VERSION = 1  # raise it when verdicts are reached in another way: those that are stored are void then
LEDGER = Path(__file__).with_name("claims.toml")
RESULTS = ROOT / "data" / "results"
REPLICATED, DEPENDENT, INCONCLUSIVE, FAILED, UNTESTABLE = VERDICTS = (
    "REPLICATED", "READING-DEPENDENT", "INCONCLUSIVE", "NOT REPLICATED", "NOT TESTABLE",
)  # fmt: skip
TRIALS = ("target", "copy")  # columns that number the trials inside a seed
PAPERS, OURS = "tsm", "tsm+energy+direct"

Row = Mapping[str, Any]
Words = Mapping[str, Mapping[str, Any]]
Query = dict[str, Any]  # column -> value, file, and whether a row per trial is asked for


class ClaimError(ValueError):
    """A claim that cannot be read, or rows that cannot be judged: missing, doubled, of different seeds or trials."""

    def __init__(self, message: str, file: str = "") -> None:
        super().__init__(message)
        self.file = file  # whose rows they are


@dataclass(frozen=True)
class Check:
    """One inequality, ``expression op margin``, and the query of every term in it, by the term's text."""

    expression: str
    op: str
    margin: float
    level: float
    queries: Mapping[str, Query]

    @property
    def asked(self) -> str:
        """The margin, and where: ``> 0.5 (ReacherPush contact)``."""
        places = ", ".join(dict.fromkeys(filter(None, map(_place, self.queries.values()))))
        return f"{self.op} {self.margin:g}" + f" ({places})" * bool(places)

    @property
    def text(self) -> str:
        """All of it as it is read."""
        return f"{self.expression} {self.asked}"

    def accepts(self, low: float, high: float) -> bool:
        """Whether all that lies between ``low`` and ``high`` is on the accepted side of the margin."""
        return {
            ">": low > self.margin, ">=": low >= self.margin, "<": high < self.margin, "<=": high <= self.margin,
            "==": low <= self.margin <= high,
        }[self.op]  # fmt: skip


@dataclass(frozen=True)
class Effect:
    """What rows say of a check: estimate, interval where there is one, n in words, and a state."""

    check: Check
    state: str  # holds, fails, open or missing
    value: float | None = None
    low: float | None = None
    high: float | None = None
    n: str = ""
    why: str = ""

    @property
    def beyond(self) -> np.ndarray:
        """How far estimate and ends of the interval (3,) lie beyond the margin: negative on the wrong side, or NaN."""
        ends = np.array([np.nan if end is None else end for end in (self.value, self.low, self.high)])
        return (ends - self.check.margin) * (-1 if self.check.op[0] == "<" else 1)

    @property
    def right_side(self) -> bool:
        """Whether the estimate keeps the claimed sign; what cannot be estimated does not contradict it."""
        return self.value is None or self.check.op == "==" or self.check.accepts(self.value, self.value)


@dataclass(frozen=True)
class Claim:
    """A claim of the paper. readings: name -> checks; that of the name "" decides first."""

    id: str
    place: str
    statement: str
    statistic: str
    rule: Sequence[str]
    notebook: str
    made_by: Mapping[str, str]  # file -> command
    readings: Mapping[str, tuple[Check, ...]]
    section: str = ""
    figure: str = ""
    headline: bool = False
    rests_on: Sequence[str] = ()  # claims that have to hold as well
    ours: bool = False  # the threshold is ours: the paper says it in words, or of a picture
    why: Mapping[str, str] = field(default_factory=dict)  # verdict -> what is known of its cause

    @cached_property
    def sha256(self) -> str:
        """Of all that decides the verdict."""
        checks = {
            reading: [[c.expression, c.op, c.margin, c.level, c.queries] for c in checks]
            for reading, checks in self.readings.items()
        }
        return hashlib.sha256(json.dumps([VERSION, self.id, checks], sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Verdict:
    """A claim, one of VERDICTS, why, and the effects of each reading."""

    claim: Claim
    word: str
    why: str
    effects: Mapping[str, Sequence[Effect]]

    @property
    def key(self) -> Effect:
        """The check of the primary reading that decides: the one that is furthest from holding."""
        return min(self.effects[""], key=_ease)


# Reading the ledger --------------------------------------------------------------------------------------------------


def read(path: Path = LEDGER, *, subject: str = PAPERS) -> list[Claim]:
    """The claims of a ledger. subject: the model that stands where the paper's own model is meant.

    Raises ClaimError naming the claim and what is wrong with it.
    """
    ledger = tomllib.loads(path.read_text())
    words: Words = {
        word: {**columns, "model": subject} if columns.get("model") == PAPERS else columns
        for word, columns in ledger["words"].items()
    }
    found: dict[str, Claim] = {}
    for entry in ledger["claim"]:
        try:
            claim = _claim({**entry, "made_by": ledger["made_by"]}, words)
        except (KeyError, TypeError, ValueError, SyntaxError) as error:
            what = f"nothing is called {error}" if isinstance(error, KeyError) else error
            raise ClaimError(f"{path.name}, {entry.get('id', 'a claim')}: {what}. Correct its entry.") from error
        if claim.id in found:
            raise ClaimError(f"{path.name}: {claim.id} stands twice. Delete one of them.")
        found[claim.id] = claim
    return [_resting(claim, found) for claim in found.values()]


def _resting(claim: Claim, claims: Mapping[str, Claim]) -> Claim:
    """A claim that rests on others, with their checks."""
    if unknown := set(claim.rests_on) - set(claims):
        raise ClaimError(f"{claim.id} rests on {min(unknown)}, which the ledger does not have. Correct its entry.")
    return replace(claim, readings={
        reading: (*checks, *(check for other in claim.rests_on for check in claims[other].readings[""]))
        for reading, checks in claim.readings.items()
    })  # fmt: skip


def _claim(entry: dict[str, Any], words: Words) -> Claim:
    common = {"scale": "paper"} | _columns(entry.pop("where", ""), words)
    common |= {"metric": entry.pop("metric")} if "metric" in entry else {}
    each, others = entry.pop("each", {}), entry.pop("readings", {})
    readings = {}
    for reading, change in {"": {}, **others}.items():
        checks: list[Check] = []
        for values in itertools.product(*each.values()):
            chosen = dict(zip(each, values, strict=True))
            base = common | _columns(chosen.pop("at", ""), words) | change
            for line in entry["rule"]:
                for word, expression in chosen.items():
                    line = re.sub(rf"\b{word}\b", expression, line)
                checks += [check for check in _checks(line, base, words) if check not in checks]
        readings[reading] = tuple(checks)
    return Claim(**entry, readings=readings)


def _columns(names: str, words: Words) -> dict[str, Any]:
    return {column: value for name in names.split() for column, value in words[name].items()}


def _checks(line: str, base: Query, words: Words) -> Iterator[Check]:
    """The inequalities in one line of a rule: one, or both of ``a < b < c``."""
    tree = ast.parse(line, mode="eval").body
    if not isinstance(tree, ast.Compare):
        raise ValueError(f"{line!r} is no inequality")
    names = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "=="}
    sides = [tree.left, *tree.comparators]
    for left, kind, right in zip(sides, tree.ops, sides[1:], strict=False):
        op, queries = names[type(kind)], _queries(ast.BinOp(left, ast.Sub(), right), base, words)
        if not _queries(left, base, words):
            left, right, op = right, left, op.translate(str.maketrans("<>", "><"))
        margin = 0.0
        if _queries(right, base, words):
            left = ast.BinOp(left, ast.Sub(), right)
        else:
            margin = float(_number(right, {}))
        expression, level = ast.unparse(left), 0.95 if len(tree.ops) == 1 else 0.90
        with np.errstate(all="ignore"):  # what nobody can evaluate is found now
            _number(left, {term: np.ones(2) if query["trials"] else 1.0 for term, query in queries.items()})
        yield Check(expression, op, margin, level, queries)


def _queries(node: ast.AST, base: Query, words: Words, trials: bool = False) -> dict[str, Query]:
    """The query of every term below ``node``, by its text."""
    if _is_term(node):
        term, query = ast.unparse(node), Query()
        while not isinstance(node, ast.Name):  # from the right: what stands there already stays
            match node:
                case ast.Attribute(value=inner, attr=metric):
                    columns: Query = {"metric": metric}
                case ast.Subscript(value=inner, slice=ast.Constant(value=steps)):
                    columns = {"horizon": steps}
                case ast.Subscript(value=inner, slice=place):
                    columns = _columns(ast.unparse(place), words)
                case _:
                    raise ValueError(f"{term!r} is no query; write word[place].metric[horizon]")
            node, query = inner, columns | query
        query = base | _columns(node.id, words) | query | {"trials": trials}
        if not {"metric", "file"} <= set(query):
            raise ValueError(f"{term!r} names no metric or no file")
        return {term: query}
    below: list[Any] = list(ast.iter_child_nodes(node))
    if isinstance(node, ast.Call):
        trials, below = trials or ast.unparse(node.func) in OVER_TRIALS, list(node.args)
    found: dict[str, Query] = {}
    for child in below:
        for term, query in _queries(child, base, words, trials).items():
            if found.setdefault(term, query) != query:
                raise ValueError(f"{term!r} is asked for by trial and as a mean")
    return found


def _is_term(node: ast.AST) -> bool:
    return isinstance(node, ast.Attribute | ast.Subscript | ast.Name)


def _place(query: Query) -> str:
    """Where a term's rows come from, in few words: ReacherPush contact."""
    env = str(query.get("env", "")).removeprefix("tsm/").removesuffix("-v0")
    condition = query.get("condition", "clean")
    return " ".join(filter(None, [env, "" if condition == "clean" else str(condition)]))


OVER_TRIALS: Mapping[str, Callable[..., Any]] = {
    "mean": np.mean, "share": np.mean, "corr": lambda a, b: np.corrcoef(a, b)[0, 1],
}  # fmt: skip
FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    "abs": np.abs, "log": np.log, "min": lambda *a: np.min(a, 0), "max": lambda *a: np.max(a, 0),
    "middle": lambda *a: np.median(a, 0), "range": lambda *a: np.ptp(a, 0), **OVER_TRIALS,
}  # fmt: skip
OPERATORS: Mapping[type, Callable[..., Any]] = {
    ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide,
    ast.Lt: np.less, ast.LtE: np.less_equal, ast.Gt: np.greater, ast.GtE: np.greater_equal,
}  # fmt: skip


def _number(node: ast.AST, terms: Mapping[str, Any]) -> Any:
    """An expression's value, from those of its terms in one seed: numbers, or arrays over trials."""
    if _is_term(node):
        return terms[ast.unparse(node)]
    match node:
        case ast.Constant(value=int() | float() as value):
            return value
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_number(operand, terms)
        case ast.BinOp(left=left, op=op, right=right) | ast.Compare(left=left, ops=[op], comparators=[right]):
            return OPERATORS[type(op)](_number(left, terms), _number(right, terms))
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return FUNCTIONS[name](*(_number(argument, terms) for argument in arguments))
    raise ValueError(f"{ast.unparse(node)!r} cannot stand in a rule")


# Rows ----------------------------------------------------------------------------------------------------------------


class Tables:
    """Rows of metrics tables, by file, metric and model."""

    def __init__(self, rows: Mapping[str, Sequence[Row]]) -> None:
        self.rows = rows
        self.answers: dict[str, dict[int, dict[tuple[Any, ...], float]]] = {}
        self.found: dict[tuple[str, Any, Any], list[Row]] = {}
        for file, table in rows.items():
            for row in table:
                self.found.setdefault((file, row["metric"], row["model"]), []).append(row)

    def ask(self, query: Query) -> dict[int, dict[tuple[Any, ...], float]]:
        """Seed -> trial -> value; a row that belongs to no trial has the trial ()."""
        name = json.dumps(query, sort_keys=True)
        if name not in self.answers:
            self.answers[name] = self._ask(query)
        return self.answers[name]

    def relabelled(self, models: Mapping[str, str]) -> Tables:
        """The same rows with other models' names on them: a check of the checker."""
        return Tables({
            file: [{**row, "model": models.get(row["model"], row["model"])} for row in table]
            for file, table in self.rows.items()
        })  # fmt: skip

    def _ask(self, query: Query) -> dict[int, dict[tuple[Any, ...], float]]:
        wanted = {column: value for column, value in query.items() if column not in ("file", "trials")}
        along = wanted.pop("horizon") if wanted.get("horizon") in ("last", "average") else None
        file, trials = query["file"], query["trials"]
        lines: dict[tuple[int, tuple[Any, ...]], dict[Any, float]] = {}  # seed, trial -> horizon -> value
        for name in (f"{file}_rows", file) if trials else (file,):
            for row in self.found.get((name, query["metric"], query.get("model")), []):
                trial = tuple(row[column] for column in TRIALS if row.get(column, "") != "")
                if bool(trial) == trials and all(row.get(c, "") == value for c, value in wanted.items()):
                    line = lines.setdefault((row["seed"], trial), {})
                    if row["horizon"] in line or (line and not along):
                        raise ClaimError(f"{name}.csv has two rows for seed {row['seed']} of {spell(query)}", file)
                    line[row["horizon"]] = row["value"]
            if lines:
                break
        if not lines:
            raise ClaimError(f"no rows yet in {file}.csv of {spell(query)}", file)
        if len({tuple(sorted(line)) for line in lines.values()}) > 1 and along:
            raise ClaimError(f"{file}.csv has curves of different lengths of {spell(query)}", file)
        found: dict[int, dict[tuple[Any, ...], float]] = {}
        for (seed, trial), line in sorted(lines.items()):
            value = line[max(line)] if along == "last" else float(np.mean([*line.values()]))
            found.setdefault(seed, {})[trial] = value
        return found


def spell(query: Query) -> str:
    """A query in words: its metric, and every other column that it asks for."""
    rest = {c: v for c, v in query.items() if c not in ("file", "metric", "trials", "scale") and v != ""}
    by = " by trial" if query["trials"] else ""
    return f"{query['metric']}{by} ({', '.join(f'{column} {value}' for column, value in rest.items())})"


def tables(claims: Sequence[Claim], run: Run | None = None) -> Tables:
    """The rows that ship. run: of scale paper; the rows of each seed beside it that has its own take their place.

    RunError where a notebook that made such rows did not come to its end.
    """
    files = {q["file"] for c in claims for checks in c.readings.values() for k in checks for q in k.queries.values()}
    names = sorted(files | {f"{file}_rows" for file in files})
    rows = {name: tables_storage.load_table(path) for name in names if (path := RESULTS / f"{name}.csv").exists()}
    folders = sorted(run.dir.parent.glob("seed*/metrics")) if run and run.scale == "paper" else []
    for folder, name in itertools.product(folders, names):
        if not (path := folder / f"{name}.csv").exists():
            continue
        assert run
        if name[3:] in notebooks():
            seed = int(folder.parent.name.removeprefix("seed"))
            require(replace(run, seed=seed, dir=folder.parent), name)
        own = tables_storage.load_table(path)
        seeds = {row["seed"] for row in own}
        rows[name] = [row for row in rows.get(name, []) if row["seed"] not in seeds] + own
    return Tables(rows)


# Judging -------------------------------------------------------------------------------------------------------------


def judge(claim: Claim, rows: Tables) -> Verdict:
    """What rows say of a claim."""
    effects = {reading: [_effect(claim, check, rows) for check in checks] for reading, checks in claim.readings.items()}
    states = {reading: state(found) for reading, found in effects.items()}
    first, key = states.pop(""), min(effects[""], key=_ease)
    holds = [reading for reading, found in states.items() if found == "holds"]
    turned = [reading for reading in states if not all(effect.right_side for effect in effects[reading])]
    measured = f"{key.check.text}: it is {figure(key)}."
    failing = sum(effect.state == "fails" for effect in effects[""])
    word, why = {
        "holds": (REPLICATED, ""),
        "fails": (FAILED, f"{measured} {failing} of {len(effects[''])} checks fail."),
        "open": (
            INCONCLUSIVE,
            f"{measured} {'The interval holds the margin.' if key.low is not None else 'One seed has no interval.'}",
        ),
        "missing": (UNTESTABLE, key.why),
    }[first]
    if first == "holds" and turned:
        word, why = DEPENDENT, f"It holds as the paper words it. It turns with: {'; '.join(turned)}."
    elif first in ("fails", "open") and holds:
        word, why = DEPENDENT, f"It holds with: {'; '.join(holds)}. As the paper words it, {why}"
    return Verdict(claim, word, " ".join(filter(None, [why, claim.why.get(word, "")])), effects)


def state(effects: Sequence[Effect]) -> str:
    """Of a whole rule: one check that fails decides, whatever else is missing."""
    states = {effect.state for effect in effects}
    return next(word for word in STATES if word in states)


STATES = ("fails", "missing", "open", "holds")


def _ease(effect: Effect) -> tuple[int, float]:
    """Sorts checks by how far they are from holding, the furthest first."""
    value, low, high = effect.beyond
    if np.isnan(low):  # of what has no interval the side alone is known
        return STATES.index(effect.state), -1.0 if value < 0 else 0.0
    return STATES.index(effect.state), float(value / (abs(high - low) + 1e-300))


def _effect(claim: Claim, check: Check, rows: Tables) -> Effect:
    try:
        return measure(check, rows)
    except ClaimError as error:
        return Effect(check, "missing", why=f"{claim.id}: {error}. Run: {claim.made_by[error.file]}")


def measure(check: Check, rows: Tables) -> Effect:
    """Estimate and interval of a check. ClaimError where rows are missing, doubled, or do not belong together."""
    tree = ast.parse(check.expression, mode="eval").body
    asked = {term: rows.ask(query) for term, query in check.queries.items()}
    if not asked:  # arithmetic
        exact = float(_number(tree, {}))
        return Effect(check, "holds" if check.accepts(exact, exact) else "fails", exact, exact, exact, "exact")
    for (a, one), (b, two) in itertools.combinations(asked.items(), 2):
        same = all(check.queries[a].get(c) == check.queries[b].get(c) for c in ("file", "env", "condition"))
        if same and set(one) != set(two):  # elsewhere the seeds that both have count
            file = check.queries[a]["file"]
            raise ClaimError(
                f"{file}.csv has seeds {sorted(one)} of {a}, and {sorted(two)} of {b} in {check.text}", file
            )
    seeds = sorted(set.intersection(*map(set, asked.values())))
    by_trial = [term for term, query in check.queries.items() if query["trials"]]
    for seed in seeds:
        if len({tuple(sorted(asked[term][seed])) for term in by_trial}) > 1:
            file = check.queries[by_trial[0]]["file"]
            raise ClaimError(f"{file}.csv has different trials of {', '.join(by_trial)} in seed {seed}", file)
    if not seeds:
        file = next(iter(check.queries.values()))["file"]
        raise ClaimError(f"no seed has rows for all of {check.text}", file)

    def number(seed: int, without: int | None = None) -> float:
        values: dict[str, Any] = {term: found[seed].get((), 0.0) for term, found in asked.items()}
        for term in by_trial:
            trials = [asked[term][seed][trial] for trial in sorted(asked[term][seed])]
            values[term] = np.array(trials if without is None else trials[:without] + trials[without + 1 :])
        with np.errstate(all="ignore"):
            found = float(_number(tree, values))
        if not np.isfinite(found):
            raise ClaimError(f"{check.text}: {found} in seed {seed}", next(iter(check.queries.values()))["file"])
        return found

    values, n = np.array([number(seed) for seed in seeds]), f"{len(seeds)} seed{'s' * (len(seeds) > 1)}"
    trials = len(asked[by_trial[0]][seeds[0]]) if by_trial else 0
    if len(seeds) == 1 and trials > 1 and len(by_trial) == len(asked):  # pseudo-values: of a mean, the trials' own
        values = trials * values[0] - (trials - 1) * np.array([number(seeds[0], without=i) for i in range(trials)])
        n = f"{trials} trials of 1 seed"
    mean, half = interval(values, check.level)
    if len(values) == 1:
        return Effect(check, "open", mean, n=n)
    low, high = mean - half, mean + half
    inside = check.op != "==" and low <= check.margin <= high
    found = "holds" if check.accepts(low, high) else "open" if inside else "fails"
    return Effect(check, found, mean, low, high, n)


def figure(effect: Effect) -> str:
    """Estimate, interval and n in words."""
    if effect.value is None:
        return "no rows"
    between = "" if effect.low is None else f" [{effect.low:.3g}, {effect.high:.3g}]"
    return f"{effect.value:.3g}{between}, n = {effect.n}"


# What is stored ------------------------------------------------------------------------------------------------------

EXTRA = ("claim", "reading", "check", "low", "high", "margin", "level", "state", "verdict", "sha256")


def as_rows(verdicts: Sequence[Verdict], **common: Any) -> list[dict[str, Any]]:
    """Rows of metrics/08_claims.csv, one per effect, and at least one per claim. common: model, scale."""
    return [
        dict(
            common, metric="effect", claim=v.claim.id, reading=reading, check=e.check.text, margin=e.check.margin,
            value=_blank(e.value), low=_blank(e.low), high=_blank(e.high), level=e.check.level, n=e.n, state=e.state,
            verdict=v.word, sha256=v.claim.sha256,
        )
        for v in verdicts for reading, effects in v.effects.items() for e in effects
        if e.value is not None or e is v.key
    ]  # fmt: skip


def _blank(number: float | None) -> float | str:
    return "" if number is None else number


def load(path: Path, claims: Sequence[Claim], *, model: str = PAPERS) -> dict[str, str]:
    """Claim -> stored verdict. ClaimError where one was judged by another rule than the ledger's, or not at all."""
    stored = {row["claim"]: row for row in tables_storage.load_table(path) if row["model"] == model}
    again = "Judge it again: python -m tsmlib run claims"
    for claim in claims:
        if claim.id not in stored:
            raise ClaimError(f"{path} holds no verdict on {claim.id}. {again}")
        if stored[claim.id]["sha256"] != claim.sha256:
            raise ClaimError(f"{path}: the rule of {claim.id} has changed, so its stored verdict is void. {again}")
    return {claim.id: stored[claim.id]["verdict"] for claim in claims}
