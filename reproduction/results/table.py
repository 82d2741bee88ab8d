"""Results tables (``tsmlib.storage.tables``): selections, values paired by seed, summaries, Markdown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import wraps
from typing import Any, Concatenate, NotRequired, ParamSpec, TypedDict, TypeVar

import numpy as np
import pandas as pd

from tsmlib.envs.spec import EnvSpec
from tsmlib.plots.method import Method
from tsmlib.planning.tasks import Task
from tsmlib.statistics import interval
from tsmlib.storage import tables
from tsmlib.storage.files import Json
from tsmlib import zoo
from reproduction.runs import Run
from tsmlib.zoo import LOOKS, ZOO, look, method

P = ParamSpec("P")
T = TypeVar("T")
PUBLISHED, YOURS = "published", "yours"  # of the column source, see study.evidence
KEYS = (
    "env",
    "task",
    "torque_weight",
    "model",
    "method",
    "torques",
    "search_space",
    "planner",
    "start",
    "what",
)  # what a line is about
REPLACED_TOGETHER = (
    *(
        "env",
        "noise",
        "delay",
        "model",
        "planner",
        "search_space",
        "execution",
        "configuration",
        "seed",
        "scale",
    ),
)
Row = dict[str, object]
K = TypeVar("K")
V = TypeVar("V")
Columns = Mapping[str, tuple[str, str]]  # metric -> title and format of its column


class LearnedCurve(TypedDict):
    """A ``LearningCurve`` as JSON."""

    iteration: list[int]
    seconds: list[float]
    predicted: list[list[float]]
    measured: dict[str, list[list[float]]]
    resumed: list[str]
    policies: NotRequired[int]  # older files were learned alone


class PolicyHeader(TypedDict, total=False):
    """What the file of a learned policy says of itself; targets: that it was measured on as it was learned.

    seconds: of the CPU, of all ``policies`` of the curve together.
    """

    fingerprint: dict[str, Json]
    made_from: dict[str, Json]
    budget: dict[str, int]
    model: str
    search_space: str
    targets: int
    seed: int
    scale: str
    curve: LearnedCurve
    seconds: float
    torch: str
    threads: int
    device: str
    finished: str


# Places and methods --------------------------------------------------------------------------------------------------


def place(env: str) -> Row:
    """The columns that say where a row is from: the arm without its imperfections, simulator, noise and delay."""
    spec = EnvSpec.parse(env)
    return {
        "env": spec.arm.id,
        "sim": spec.simulator,
        "noise": spec.noise or None,
        "delay": spec.delay or None,
    }


def of_task(task: Task, run: Run) -> Row:
    """The columns of whatever a run measured on a task."""
    return place(task.env) | dict(
        task=task.name, horizon=task.horizon, seed=run.seed, scale=run.scale
    )


def fields(method: Method) -> Row:
    """The columns model, search_space and planner of a method."""
    model, planner = method.model, method.planner
    if model in ("random", "zero"):
        model, planner = "none", model
    return {"model": model, "search_space": method.search_space, "planner": planner}


def policy(header: PolicyHeader) -> Row:
    """The columns of a learned policy, from the header of its file."""
    return place(str(header["fingerprint"]["env"])) | dict(
        task=header["made_from"]["task"],
        model=header["model"],
        planner="policy",
        execution="policy",
        search_space=header["search_space"],
        seed=header["seed"],
        scale=header["scale"],
    )


def with_method(table: pd.DataFrame, *columns: str) -> pd.DataFrame:
    """The table with a column ``method``, made of these columns, by default of model, search_space and planner."""
    named = columns or ("model", "search_space", "planner")
    made = [
        method(**dict(zip(named, row, strict=True)))
        for row in zip(*(table[name] for name in named), strict=True)
    ]
    return table.assign(method=pd.Series(made, index=table.index, dtype=object))


def methods(values: Mapping[str, T]) -> dict[Method, T]:
    """The same with methods, which figures take, in place of the words of models; in the order of the zoo."""
    order = [*ZOO, *LOOKS]
    return {method(model): values[model] for model in sorted(values, key=order.index)}


def save(run: Run, rows: Iterable[Row], **common: object) -> pd.DataFrame:
    """Save the rows of a run's notebook; common: what all have in common, beside seed, scale and no planner."""
    common = dict(planner="none", seed=run.seed, scale=run.scale) | common
    return tables.save(
        run.metrics / f"{run.notebook}.csv", [common | row | place(str(row["env"])) for row in rows]
    )


# Selections ----------------------------------------------------------------------------------------------------------


def select(table: pd.DataFrame, **where: object) -> pd.DataFrame:
    """The rows that have these values; of a list, tuple, set or range any of them. None or "": an empty field."""
    keep = np.ones(len(table), dtype=bool)
    for name, wanted in where.items():
        column = table[name]
        among = (
            list(wanted) if isinstance(wanted, list | tuple | set | frozenset | range) else [wanted]
        )
        known = [value for value in among if value is not None and value != ""]
        found = column.isin(known)
        if len(known) < len(among):
            found = found | column.isna() | (column.astype(object) == "")
        keep &= found.to_numpy(dtype=bool)
    return table[keep]


def groups(table: pd.DataFrame, by: str | list[str]) -> Iterator[tuple[Any, pd.DataFrame]]:
    """Rows of the same value, or values, in order of appearance."""
    return iter(table.groupby(by, sort=False)) if len(table) else iter(())


def by_seed(table: pd.DataFrame, by: str = "model") -> pd.DataFrame:
    """Values with a line per seed and a column per model, NaN where there is none. ValueError if a value is doubled."""
    doubled = table[table.duplicated([by, "seed"])]
    if len(doubled):
        first = doubled.iloc[0]
        raise ValueError(
            f"{first['metric']} of {first[by]} stands twice for seed {first['seed']}; select one of them"
        )
    wide = table.pivot(index="seed", columns=by, values="value")
    return wide[list(table[by].unique())]


def values(table: pd.DataFrame, by: str = "model") -> dict[Any, np.ndarray]:
    """Model -> one value per seed, in the order of the seeds."""
    return arrays(by_seed(table, by))


def pairs(table: pd.DataFrame, subject: str, by: str = "model") -> dict[Any, np.ndarray]:
    """Model -> ``subject`` minus that model, one difference per seed that both have."""
    wide = by_seed(table, by)
    if subject not in wide:
        return {}
    found = {
        key: (wide[subject] - seeds).dropna().to_numpy()
        for key, seeds in wide.items()
        if key != subject
    }
    return {key: seeds for key, seeds in found.items() if len(seeds)}


def arrays(wide: pd.DataFrame) -> dict[Any, np.ndarray]:
    """Name -> a column's numbers, without what is missing."""
    return {name: column.dropna().to_numpy() for name, column in wide.items()}


def means(
    table: pd.DataFrame, by: str | list[str], columns: str | list[str] = "metric"
) -> pd.DataFrame:
    """Means, over seeds above all, with a line per ``by`` and a column per metric, in order of appearance."""
    return table.pivot_table(index=by, columns=columns, values="value", sort=False)


# Rows in place of others ----------------------------------------------------------------------------------------------


def about(rows: pd.DataFrame, columns: Sequence[str] = REPLACED_TOGETHER) -> list[tuple[str, ...]]:
    """The values of some columns in each row, as texts: empty where a row, or the table, has none."""
    texts = [
        rows[name].astype(object).where(rows[name].notna(), "").astype(str)
        if name in rows
        else [""] * len(rows)
        for name in columns
    ]
    return list(zip(*texts, strict=True))


def others(
    published: pd.DataFrame, own: pd.DataFrame, columns: Sequence[str] = REPLACED_TOGETHER
) -> pd.DataFrame:
    """The published rows that are about nothing that ``own`` has rows of: of other seeds, environments, models or
    methods."""
    there = set(about(own, columns))
    return published[
        np.array([thing not in there for thing in about(published, columns)], dtype=bool)
    ]


def of_fewer(published: pd.DataFrame, own: pd.DataFrame) -> dict[tuple[str, ...], tuple[int, int]]:
    """Values of REPLACED_TOGETHER -> of how many targets or episodes ``own`` and the published rows are at most, where
    ``own`` are of fewer. Rows without a number are left out."""
    found, ships = _most(own), _most(published)
    return {what: (n, ships[what]) for what, n in found.items() if n < ships.get(what, 0)}


def _most(rows: pd.DataFrame) -> dict[tuple[str, ...], int]:
    rows = rows.dropna(subset=["n"]).sort_values("n")
    return dict(
        zip(about(rows), rows["n"].astype(int), strict=True)
    )  # of the same the last, which is the most


# Published rows and the reader's own ----------------------------------------------------------------------------------


def drawn(found: pd.DataFrame) -> pd.DataFrame:
    """The rows that a figure draws in full: the published ones; at scale paper, whose figures are published, the run's
    own. All of them where no ``source`` is told."""
    if "source" not in found:
        return found
    own = select(found, source=YOURS)
    return own if "paper" in set(own["scale"]) else select(found, source=PUBLISHED)


def own_rows(found: pd.DataFrame) -> pd.DataFrame:
    """The reader's own rows, where ``drawn`` gives those of others."""
    if "source" not in found:
        return found.iloc[:0]
    own = select(found, source=YOURS)
    return own.iloc[:0] if "paper" in set(own["scale"]) else own


def pair(
    found: pd.DataFrame, read: Callable[[pd.DataFrame], Mapping[str, Mapping[K, V]]]
) -> tuple[dict[str, Mapping[K, V]], dict[str, Mapping[K, V]]]:
    """What ``read`` makes of the rows that are drawn in full, and of the reader's own beside them: title -> panel.

    Panels for which neither has rows are left out.
    """
    first, second = read(drawn(found)), read(own_rows(found))
    titles = [title for title in {**first, **second} if first.get(title) or second.get(title)]
    return {title: first.get(title, {}) for title in titles}, {
        title: second[title] for title in titles if second.get(title)
    }


def stamp(found: pd.DataFrame, *, figure: bool = False) -> str:
    """Where rows are from, in one line: scale, seeds and n of the published ones and of the reader's own.

    Arms of which nothing is published are named. figure: only of what a figure shows, which says less at scale paper;
    there it is said if other models with codes have rows and OURS has none.
    """
    shown = pd.concat([drawn(found), own_rows(found)]) if figure else found
    said = []
    for source, part in groups(shown, "source"):
        title = "" if figure and len(own_rows(found)) == 0 and source == YOURS else f"{source}: "
        said.append(f"{title}{_origin(part)}")
    known = set(select(found, source=PUBLISHED)["env"])
    if figure and own_rows(found).empty:  # at scale paper it is what will be published
        known |= set(found["env"])
    if missing := [env for env in found["env"].unique() if env and env not in known]:
        said.append(f"of {', '.join(map(_env_name, missing))} nothing is published")
    models = set(found["model"]) if figure and "model" in found else set()
    if zoo.OURS not in models and models & set(zoo.words(cls=zoo.CODED)):
        said.append(f"no rows of {method(zoo.OURS).label}")
    return "; ".join(said)


def _origin(part: pd.DataFrame) -> str:
    seeds, counts = sorted(set(part["seed"].dropna())), sorted(set(part["n"].dropna()))
    if "target" in part and part["target"].notna().all():  # rows of single targets
        counts = [part["target"].nunique()]
    words = [f"scale {', '.join(part['scale'].unique())}"]
    more = f" ({'; '.join(fewer)})" if (fewer := _fewer(part)) else ""
    words += [f"seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}{more}"] * bool(seeds)
    words += [f"n {'up to' if len(counts) > 1 else '='} {counts[-1]:,}"] * bool(counts)
    return ", ".join(words)


def _fewer(part: pd.DataFrame) -> list[str]:
    """Worlds, environments with their noise and delay, that have not all the seeds of some rows, with those that they
    have; then models that have not all of them in any world that does; then models that have fewer in one world than
    both of these say."""
    known = part[part["seed"].notna()]
    seeds, known = (
        set(known["seed"]),
        known.assign(noise=known["noise"].fillna(0), delay=known["delay"].fillna(0)),
    )
    worlds = {_world_name(*key): own for key, own in groups(known, ["env", "noise", "delay"])}
    of_world = {name: set(own["seed"]) for name, own in worlds.items()}
    whole = [worlds[name] for name in worlds if of_world[name] == seeds]
    of_model = _seeds_of_models(pd.concat(whole)) if whole else {}
    of_both = dict[str, set[int]]()
    for name, own in worlds.items():
        here = _seeds_of_models(own)
        few = {
            model: here[model]
            for model in here
            if here[model] < of_world[name] & of_model.get(model, seeds)
        }
        of_both |= {
            f"{' and '.join(models)} on {name}": few[models[0]]
            for _, models in _by_value(_listed(few))
        }
    return [
        f"{', '.join(names)}: {few}"
        for of in (of_world, of_model, of_both)
        for few, names in _by_value(
            _listed({name: own for name, own in of.items() if own != seeds})
        )
    ]


def _listed(seeds: Mapping[str, set[int]]) -> dict[str, str]:
    """Seeds in words."""
    return {name: ", ".join(map(str, sorted(own))) for name, own in seeds.items()}


def _seeds_of_models(rows: pd.DataFrame) -> dict[str, set[int]]:
    """Of models and what is drawn beside them, by the names in figures."""
    return {
        look(model).name: set(own["seed"])
        for model, own in groups(rows, "model")
        if model in {**ZOO, **LOOKS}
    }


def _by_value(texts: Mapping[str, str]) -> Iterator[tuple[str, list[str]]]:
    """Each text with the names that have it."""
    return (
        (text, [name for name in texts if texts[name] == text])
        for text in dict.fromkeys(texts.values())
    )


def _world_name(env: str, noise: float, delay: int) -> str:
    said = [f"{word} {value:g}" for word, value in (("noise", noise), ("delay", delay)) if value]
    return " with ".join(filter(None, (_env_name(env), " and ".join(said))))


def _env_name(env: str) -> str:
    return EnvSpec.parse(env).name if env.startswith("tsm/") else env


def sourced(
    make: Callable[Concatenate[pd.DataFrame, P], pd.DataFrame],
) -> Callable[Concatenate[pd.DataFrame, P], str]:
    """A table in Markdown with a line for the published rows and one for the reader's own, next to each other.

    A column says which is which, with n where lines have one. Rows without a ``source`` make the table as it is.
    """

    @wraps(make)
    def made(found: pd.DataFrame, *args: P.args, **kwargs: P.kwargs) -> str:
        if "source" not in found:
            return markdown(make(found, *args, **kwargs))
        parts = [(part, make(part, *args, **kwargs)) for _, part in groups(found, "source")]
        labelled = [_labelled(lines, part) for part, lines in parts if len(lines)]
        return markdown(_alternating(pd.concat(labelled, ignore_index=True))) if labelled else ""

    return made


def told(
    say: Callable[Concatenate[pd.DataFrame, P], Iterable[str]],
) -> Callable[Concatenate[pd.DataFrame, P], str]:
    """Sentences that are made of rows, as a Markdown list: those of the published ones, then the reader's own."""

    @wraps(say)
    def made(found: pd.DataFrame, *args: P.args, **kwargs: P.kwargs) -> str:
        parts = groups(found, "source") if "source" in found else iter([("", found)])
        lines = [
            f"- {source and source.capitalize() + ': '}{text}"
            for source, part in parts
            for text in say(part, *args, **kwargs)
        ]
        return "\n".join(lines)

    return made


def _labelled(lines: pd.DataFrame, part: pd.DataFrame) -> pd.DataFrame:
    """A table of rows of one source, with the column ``rows`` after those that say what a line is about."""
    source = part["source"].iloc[0]
    own = source == YOURS
    seeds = ", ".join(map(str, sorted(set(part["seed"].dropna()))))
    more = f", seed {seeds}, scale {part['scale'].iloc[0]}" if own else ""
    counts = lines["n"].tolist() if "n" in lines else [""] * len(lines)
    texts = [f"{source}{'' if n == '' or pd.isna(n) else f', n = {n:,}'}{more}" for n in counts]
    place = sum(name in KEYS for name in lines)
    keys = [name for name in lines if name in KEYS]
    rest = [name for name in lines if name not in (*KEYS, "n")]
    found = lines[[*keys, *rest]].copy()
    found.insert(place, "rows", [f"**{text}**" if own else text for text in texts])
    return found


def _alternating(lines: pd.DataFrame) -> pd.DataFrame:
    """Lines about the same below each other, otherwise in order of appearance."""
    keys = [name for name in lines if name in KEYS]
    ranks = pd.DataFrame(
        {name: pd.factorize(lines[name].map(str))[0] for name in keys}, index=lines.index
    )
    return lines.loc[ranks.sort_values(keys, kind="stable").index] if keys else lines


# Printed tables ------------------------------------------------------------------------------------------------------


def spell(numbers: Iterable[float], form: str = "{:.3g} ± {:.2g}") -> str:
    """Mean and half the 95 % t interval; the mean alone where there is no interval."""
    mean, half = interval(np.asarray(list(numbers)))
    return form.format(mean, half) if half else form.partition(" ± ")[0].format(mean)


def printed(wide: pd.DataFrame, columns: Columns) -> pd.DataFrame:
    """Numbers as text in named columns, for those metrics that there are; the index in front."""
    texts = {
        title: wide[name].map(form.format, na_action="ignore")
        for name, (title, form) in columns.items()
        if name in wide
    }
    return pd.DataFrame(texts, index=wide.index).reset_index()


def markdown(table: pd.DataFrame) -> str:
    """A Markdown table of texts, empty without lines; methods and environments as readers know them."""
    if not len(table):
        return ""
    known: dict[str, Callable[[Any], str]] = {
        "env": "`{}`".format,
        "method": lambda method: method.label,
        "reached": {True: "yes", False: "no"}.__getitem__,
    }
    texts = table.astype(object).where(table.notna(), "")
    texts = texts.assign(
        **{name: texts[name].map(text) for name, text in known.items() if name in texts}
    )
    texts = texts.rename(columns={"env": "environment", "search_space": "search space"}).astype(str)
    return texts.to_markdown(index=False, disable_numparse=True)


def thresholds(lines: Iterable[tuple[str, str, float, float, str]]) -> pd.DataFrame:
    """Thresholds: of what, "at most" or "at least", bound, measured and format, with whether it was reached.

    NaN: what was not measured, which reaches nothing.
    """
    found = [
        {
            "what": what,
            "threshold": f"{word} {form.format(bound)}" if bound == bound else "not measured",
            "measured": form.format(value) if value == value else "not measured",
            "reached": bool(value <= bound if word == "at most" else value >= bound),
        }
        for what, word, bound, value, form in lines
    ]
    return pd.DataFrame(found, columns=["what", "threshold", "measured", "reached"])
