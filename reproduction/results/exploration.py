"""Results of rounds of exploration (10_explore): their rows; panels, tables and sentences from rows.

Rounds are ``closed loop``; ``iteration`` is the round, ``env_steps`` were executed until then, random ones included,
and ``configuration`` says whose episodes were learned from (DATA). Rows of a round's episodes themselves (EPISODES)
have the subset ``data`` and no execution. Returns of searches through the true simulator, in codes of the prior before
round 1 (subset FIRST_PRIOR) and of the last (LAST_PRIOR), are ``open loop``; ``iteration`` is the planner's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pandas as pd

from tsmlib.envs.spec import EnvSpec
from tsmlib.plots.method import Method
from tsmlib import zoo
from reproduction.results import table
from reproduction.results.planning import CLOSED, OPEN, ORACLE
from reproduction.results.table import Row
from reproduction.runs import Run

PENDULUM, PUSH, HORIZON = "Pendulum-v1", "tsm/ReacherPush-v1", 100
DRAWN = {
    PENDULUM: ("executed return", "the first plan's gap open loop"),
    PUSH: ("executed return", "share within 5 cm", "the first plan's gap open loop"),
}  # of ROUNDS
TASKS = {PENDULUM: "swing up", PUSH: "push"}
PLANNED, RANDOM, NONE = "own plans", "random episodes", "no new episodes"
DATA = (PLANNED, RANDOM, NONE)  # of each round; the last is training alone
_GAPS = {
    "gap_absolute": "size of the first plan's gap",
    "gap_open_loop": "the first plan's gap open loop",
    "lost": "unstable episodes",
}
_RETURN = "executed return"
ROUNDS = {
    PENDULUM: {
        "return_true": _RETURN,
        "success": "share upright",
        **_GAPS,
        "highest": "highest by random codes",
    },
    PUSH: {
        "return_true": _RETURN,
        "success": "share within 5 cm",
        "final_distance": "final distance (m)",
        **_GAPS,
    },
}
SECONDS = {
    "cpu_seconds": "CPU s",
    "wall_seconds": "wall s",
}  # of a round, without what is measured after it
EPISODES = {
    "contact_share": "episodes with contact",
    "contacts_per_episode": "contacts per episode",
    "torque_rms": "rms torque",
}
FIRST_PRIOR, LAST_PRIOR = "first prior", "last prior"  # before round 1, after the last; a subset
MODEL_FREE = ("ppo", "trpo", "sac")
Panels = Mapping[
    str, Mapping[Method, tuple[np.ndarray, np.ndarray]]
]  # title -> learner -> steps (R,), values (k, R)
UNITS = {  # of DRAWN, as a figure's axes say them
    PENDULUM: {
        "executed return": "return (sum of 100 rewards)",
        "the first plan's gap open loop": "gap (sum of 100 rewards)",
    },
    PUSH: {
        "executed return": "return (m)",
        "share within 5 cm": "share of targets",
        "the first plan's gap open loop": "gap (m)",
    },
}


# Rows ----------------------------------------------------------------------------------------------------------------


def round_rows(
    run: Run,
    word: str,
    records: Sequence[Mapping[str, float]],
    n: int,
    *,
    first: int,
    env: str = PENDULUM,
    data: str = PLANNED,
    space: str = "latent",
    samples: int = 0,
) -> list[Row]:
    """What was measured on ``n`` starts after each round, and the SECONDS of it.

    first: environment steps before round 1; data: one of DATA; space: that is searched. samples: by which candidates
    were judged beside the mode; 0: by the mode, or the one rollout that a model has. What is NaN has no row.
    """
    common = _of_loop(run, word, env, data) | dict(
        planner="cem", execution=CLOSED, n=n, search_space=space
    )
    common |= {"samples": samples} if samples else {}
    return [
        common
        | dict(
            iteration=int(record["round"]),
            env_steps=first + int(record["env_steps"]),
            metric=metric,
            value=float(record[metric]),
            **({"unit": "s"} if metric in SECONDS else {}),
        )
        for record in records
        for metric in (*ROUNDS[env], *SECONDS)
        if math.isfinite(record.get(metric, math.nan))
    ]


def episode_rows(
    run: Run,
    word: str,
    found: Sequence[tuple[int, int, Mapping[str, float]]],
    *,
    env: str,
    data: str,
) -> list[Row]:
    """EPISODES of each round that had any: the round, how many they are, and what was measured."""
    rows, steps = list[Row](), 0
    for k, n, numbers in found:
        steps += HORIZON * n
        common = _of_loop(run, word, env, data) | dict(
            planner="none", subset="data", n=n, env_steps=steps, iteration=k
        )
        rows += [common | dict(metric=metric, value=value) for metric, value in numbers.items()]
    return rows


def prior_rows(
    run: Run,
    word: str,
    curves: Mapping[str, Sequence[float]],
    n: int,
    *,
    torques: Mapping[str, float],
    env_steps: int,
    env: str,
    data: str,
) -> list[Row]:
    """Return after each iteration of the search in codes of both priors, and of each the iterations to the return that
    the first prior's search ends with; none where that is not reached. torques: root mean square of each prior's."""
    common = _of_loop(run, word, env, data) | dict(
        planner="cem", execution=OPEN, search_space="latent", env_steps=env_steps, n=n
    )
    rows, level = list[Row](), curves[FIRST_PRIOR][-1]
    for which, curve in curves.items():
        each = common | dict(subset=which)
        rows += [
            each | dict(iteration=i, metric="return_true", value=value)
            for i, value in enumerate(curve)
        ]
        rows.append(each | dict(metric="torque_rms", value=torques[which]))
        there = next((i for i, value in enumerate(curve) if value >= level), None)
        rows += (
            []
            if there is None
            else [each | dict(metric="iterations_to_same_return", value=float(there))]
        )
    return rows


def _of_loop(run: Run, word: str, env: str, data: str) -> Row:
    """The columns that all rows of a loop have in common."""
    sim = {} if env == PENDULUM else {"sim": EnvSpec.parse(env).simulator}
    return sim | dict(
        env=env,
        task=TASKS[env],
        model=word,
        horizon=HORIZON,
        configuration=data,
        seed=run.seed,
        scale=run.scale,
    )


# Panels --------------------------------------------------------------------------------------------------------------


def round_panels(
    rows: pd.DataFrame, titles: Sequence[str], env: str = PENDULUM, *, alone: bool = False
) -> dict[str, dict[Method, tuple[np.ndarray, np.ndarray]]]:
    """Title of ROUNDS -> learner and data -> environment steps (R,) and values (k, R), for ``figures.rounds``.

    Seeds are compared round by round: lost episodes leave one with fewer steps, and steps are means over seeds. Without
    those that take no steps; alone: of these the last round of the study's own model, training alone, at the steps of
    the first. A seed that lacks a round is left out, and a learner of which no seed is whole.
    """
    found: dict[str, dict[Method, tuple[np.ndarray, np.ndarray]]] = {}
    rounds = table.select(
        rows, env=env, execution=CLOSED, configuration=[PLANNED, RANDOM, NONE][: 2 + alone]
    )
    for metric, title in ROUNDS[env].items():
        learners = table.groups(table.select(rounds, metric=metric), ["model", "configuration"])
        for (word, data), own in sorted(learners, key=lambda of: (of[0][0], DATA.index(of[0][1]))):
            if title in titles and (data != NONE or word == zoo.OURS):
                wide = own.pivot(index="seed", columns="iteration", values="value").dropna()
                if wide.empty:
                    continue
                steps = own[own["seed"].isin(wide.index)].groupby("iteration")["env_steps"].mean()
                wide = wide.iloc[:, -1:] if data == NONE else wide
                variant = f"{NONE}, round {wide.columns[-1]}" if data == NONE else data
                at, values = steps[wide.columns].to_numpy(float), wide.to_numpy(float)
                found.setdefault(title, {})[zoo.method(word, variant=variant)] = at, values
    return found


def policy_panels(
    free: pd.DataFrame, titles: Sequence[str], env: str
) -> dict[str, dict[Method, tuple[np.ndarray, np.ndarray]]]:
    """Title of ROUNDS -> model-free learner -> environment steps (R,) and values (k, R), as ``round_panels``, from
    learning curves of ``benchmarks/model_free``, without what was measured before learning."""
    found: dict[str, dict[Method, tuple[np.ndarray, np.ndarray]]] = {}
    for metric, title in ROUNDS[env].items():
        own = table.select(
            free, env=env, planner="policy", subset="", metric=metric, model=MODEL_FREE
        )
        for word, part in (
            table.groups(own[own["env_steps"] > 0], "model") if title in titles else ()
        ):
            wide = part.pivot(index="seed", columns="env_steps", values="value").dropna(axis=1)
            found.setdefault(title, {})[zoo.method(word)] = (
                wide.columns.to_numpy(float),
                wide.to_numpy(float),
            )
    return found


def oracle_rows(plans: pd.DataFrame, env: str) -> pd.DataFrame:
    """Of rows of 05_control, what the oracle's plans over codes return, open loop, and their successes."""
    return table.select(
        plans,
        env=env,
        model=ORACLE.model,
        search_space=ORACLE.search_space,
        planner=ORACLE.planner,
        execution=OPEN,
        metric=["return_true", "success"],
    )


def levels(
    alone: Panels, planned: Panels, oracle: pd.DataFrame, env: str
) -> dict[str, dict[Method, np.ndarray]]:
    """Title of ROUNDS -> training alone, and the oracle -> values (k,), for ``figures.rounds``.

    alone, planned: ``round_panels`` with training alone and without it; oracle: ``oracle_rows``.
    """
    found: dict[str, dict[Method, np.ndarray]] = {}
    for metric, title in ROUNDS[env].items():
        beyond = {
            way: values[:, -1]
            for way, (_, values) in alone.get(title, {}).items()
            if way not in planned.get(title, {})
        }
        seeds = table.select(oracle, metric=metric)["value"].to_numpy(float)
        if title in planned and len(seeds):
            beyond[zoo.method(ORACLE.model, variant=f"{OPEN}, {len(seeds)} seeds")] = seeds
        if beyond:
            found[title] = beyond
    return found


def axis_ends(
    rows: pd.DataFrame, env: str, also: Mapping[str, float] | None = None
) -> dict[str, float]:
    """Title of DRAWN -> where an axis of what should rise ends: a tenth below the lowest seed of round 0, and below
    what is ``also`` drawn, title -> its lowest value."""
    ends = {}
    closed = table.select(rows, env=env, execution=CLOSED)
    for metric in ("return_true", "success"):
        found, learner = table.select(closed, metric=metric), ["model", "configuration"]
        before = [
            part["value"] for _, part in table.groups(table.select(found, iteration=0), learner)
        ]
        if (title := ROUNDS[env][metric]) in DRAWN[env] and before:
            low = min(float(values.min()) for values in before)
            low = min(low, (also or {}).get(title, low))
            ends[title] = low - 0.1 * abs(low)
    return ends


# Tables and sentences ------------------------------------------------------------------------------------------------


@table.sourced
def rounds_table(rows: pd.DataFrame, env: str = PENDULUM) -> pd.DataFrame:
    """A line for each learner and round; contacts of its episodes, its seconds and what judged its candidates where
    these are known."""
    lines = []
    keys = ["model", "configuration", "iteration"]
    collected, closed = (
        table.select(rows, env=env, subset="data"),
        table.select(rows, env=env, execution=CLOSED),
    )
    words, known = list(closed["model"].unique()), set(closed["metric"])
    for word, data, k in sorted(
        {key for key, _ in table.groups(closed, keys)},
        key=lambda of: (words.index(of[0]), DATA.index(of[1]), of[2]),
    ):
        own = table.select(closed, model=word, configuration=data, iteration=k)
        steps = own.groupby("seed")["env_steps"].max().mean()
        line: Row = {"model": f"`{word}`", "what": data, "round": int(k), "steps": f"{steps:,.0f}"}
        if "samples" in closed:  # a column of newer tables
            line["judge"] = _judge(word, own["samples"])
        for metric, title in {
            name: title for name, title in (ROUNDS[env] | SECONDS).items() if name in known
        }.items():
            values, form = table.select(own, metric=metric)["value"], "{:.2f} ± {:.2f}"
            line[title] = (
                table.spell(values, "{:.0f}" if metric in SECONDS else form) if len(values) else ""
            )
        for metric, title in EPISODES.items() if len(collected) else ():
            values = table.select(
                collected, model=word, configuration=data, iteration=k, metric=metric
            )["value"]
            form = "{:.3f} ± {:.3f}" if metric == "torque_rms" else "{:.2f} ± {:.2f}"
            line[title] = table.spell(values, form) if len(values) else ""
        lines.append({**line, "n": int(own["n"].max())})
    return pd.DataFrame(lines)


def _judge(word: str, samples: pd.Series) -> str:
    """What judged a learner's candidates, from the column ``samples`` of its rows; empty for another library's."""
    if word in zoo.words(cls=zoo.CODED):
        return "; ".join(
            f"mode, {n:.0f} samples" if n else "mode" for n in sorted(set(samples.fillna(0)))
        )
    if word in zoo.words(cls=("Ensemble",)):
        return "members"
    return "its rollout" if word in zoo.ZOO else ""


@table.sourced
def differences_table(rows: pd.DataFrame, env: str = PUSH) -> pd.DataFrame:
    """A line for each learner and round of own plans: how much more return, and how many points more of success, than
    before the first round, and than on other data after as many rounds; paired by seed (``paired``). seeds: of these
    comparisons."""
    lines = []
    closed = table.select(rows, env=env, execution=CLOSED)
    for word, own in table.groups(closed, "model"):
        for k in sorted(set(table.select(own, configuration=PLANNED)["iteration"]) - {0}):
            line, seeds = Row(), list[int]()
            for metric, unit, form in (
                ("return_true", 1, "{:+.2f} ± {:.2f}"),
                ("success", 100, "{:+.1f} ± {:.1f}"),
            ):
                found = unit * paired(table.select(own, metric=metric), k)
                seeds += [n for n in found.count() if n]
                title = ROUNDS[env][metric] + " (points)" * (metric == "success")
                line |= {
                    f"{title} minus {what}": table.spell(values.dropna(), form)
                    if values.notna().any()
                    else ""
                    for what, values in found.items()
                }
            if seeds:
                counted = f"{min(seeds)} to {max(seeds)}" if len(set(seeds)) > 1 else seeds[0]
                lines.append({"model": f"`{word}`", "round": int(k), **line, "seeds": counted})
    return pd.DataFrame(lines)


def paired(rows: pd.DataFrame, k: int) -> pd.DataFrame:
    """Of rows of one learner and metric, a line for each seed: own plans after round k minus round 0, and minus other
    data after round k; NaN where a seed lacks one of both, or their candidates were judged by other numbers of
    ``samples``, as long as only some loops have been made again."""
    judged = rows.assign(
        samples=rows["samples"].astype(float).fillna(0) if "samples" in rows else 0.0
    )
    others = {"round 0": (PLANNED, 0), NONE: (NONE, k), RANDOM: (RANDOM, k)}
    columns = pd.MultiIndex.from_tuples([(PLANNED, k), *others.values()])
    values, samples = (
        judged.pivot(index="seed", columns=["configuration", "iteration"], values=name).reindex(
            columns=columns
        )
        for name in ("value", "samples")
    )
    return pd.DataFrame(
        {
            what: (values[PLANNED, k] - values[key]).where(samples[PLANNED, k] == samples[key])
            for what, key in others.items()
        }
    )


@table.sourced
def priors_table(rows: pd.DataFrame, env: str = PUSH) -> pd.DataFrame:
    """A line for each learner: returns that a search through the true simulator ends with in codes of the first prior
    and of the last, the iterations of both to the former, "> 10" where a seed's search of ten does not reach it, and
    the root mean square of the torques that random codes of each give."""
    lines = []
    here = table.select(rows, env=env, execution=OPEN, subset=[FIRST_PRIOR, LAST_PRIOR])
    for (word, data), own in table.groups(here, ["model", "configuration"]):
        line: Row = {"model": f"`{word}`", "what": data}
        returns, last = table.select(own, metric="return_true"), int(own["iteration"].max())
        needed = table.select(own, metric="iterations_to_same_return")
        for which in (FIRST_PRIOR, LAST_PRIOR):
            ends = table.select(returns, subset=which, iteration=last)["value"]
            line[f"return by the {which}"] = table.spell(ends, "{:.2f} ± {:.2f}")
        for which in (FIRST_PRIOR, LAST_PRIOR):
            found = table.select(needed, subset=which)["value"]
            line[f"iterations of the {which}"] = (
                table.spell(found, "{:.1f} ± {:.1f}")
                if len(found) == own["seed"].nunique()
                else f"> {last}"
            )
        for which in (FIRST_PRIOR, LAST_PRIOR):
            found = table.select(own, metric="torque_rms", subset=which)["value"]
            line[f"rms torque of the {which}"] = (
                table.spell(found, "{:.4f} ± {:.4f}") if len(found) else "-"
            )
        lines.append({**line, "n": int(own["n"].max())})
    return pd.DataFrame(lines)


def steps_table(rows: pd.DataFrame, free: pd.DataFrame, env: str = PUSH) -> str:
    """Environment steps of rounds to the final return of each model-free learner, and the round that came to it; and
    the learner's own to the return after the last round, where it stays; means over seeds. Empty where either has no
    rows.

    free: learning curves of ``benchmarks/model_free``. "-" for a return that was not reached.
    """
    if not (len(rows) and len(free)):
        return ""
    rounds = table.select(
        rows, env=env, execution=CLOSED, configuration=PLANNED, metric="return_true"
    )
    learned = table.select(free, env=env, planner="policy", subset="", metric="return_true")
    lines = []
    for policy in (word for word in MODEL_FREE if word in set(learned["model"])):
        theirs = table.select(learned, model=policy)
        curve, (end, level) = theirs.groupby("env_steps")["value"].mean(), _end(theirs)
        for word, ours in table.groups(rounds, "model"):
            own, k, taken = _there(ours, level)
            there = curve.index[curve[::-1].cummin()[::-1] >= own.iloc[-1]]
            lines.append(
                {
                    "policy": zoo.look(policy).name,
                    "its steps": f"{end:,.0f}",
                    "its return": f"{level:.2f}",
                    "rounds of": f"`{word}`",
                    "steps to that return": "-" if k is None else f"{taken:,.0f}",
                    "share": "-" if k is None else f"{taken / end:.1%}",
                    "when": "never"
                    if k is None
                    else f"in round {k:.0f}"
                    if k
                    else "before the first round",
                    "return after the last": f"{own.iloc[-1]:.2f}",
                    "policy's steps to that": f"{there[0]:,.0f}" if len(there) else "-",
                    "seeds": f"{theirs['seed'].nunique()} / {ours['seed'].nunique()}",
                }
            )
    return table.markdown(pd.DataFrame(lines))


def steps_share(rows: pd.DataFrame, free: pd.DataFrame, env: str, word: str) -> float:
    """The share of a policy's environment steps after which rounds of a learner return as much as it at its end, means
    over seeds: NaN without rows of both, inf where they never do."""
    learned = table.select(free, env=env, planner="policy", subset="", metric="return_true")
    rounds = table.select(
        rows, env=env, model=word, configuration=PLANNED, execution=CLOSED, metric="return_true"
    )
    if not (len(learned) and len(rounds)):
        return math.nan
    end, level = _end(learned)
    return _there(rounds, level)[2] / end


def _end(learned: pd.DataFrame) -> tuple[float, float]:
    """Environment steps of a learner without a model, and the return that it ends with."""
    curve = learned.groupby("env_steps")["value"].mean()
    return float(curve.index[-1]), float(curve.iloc[-1])


def _there(rounds: pd.DataFrame, level: float) -> tuple[pd.Series, float | None, float]:
    """Returns of a learner by round, the first round that returns as much as ``level``, None if none does, and the
    environment steps until then, inf if none does."""
    own = rounds.groupby("iteration")[["env_steps", "value"]].mean()
    k = next((float(k) for k in own.index[own["value"] >= level]), None)
    return own["value"], k, math.inf if k is None else float(own["env_steps"][k])


@table.told
def sentences(rows: pd.DataFrame) -> Iterator[str]:
    """What the rounds changed, learner by learner."""
    keys = ["env", "model", "configuration"]
    for (env, word, data), own in table.groups(table.select(rows, execution=CLOSED), keys):
        if (first := own["iteration"].min()) == (last := own["iteration"].max()):
            continue  # another library's, of which there is the last round alone
        means = own.groupby(["metric", "iteration"])["value"].mean()
        said = [
            f"{title} {means[metric, first]:.2f} -> {means[metric, last]:.2f}"
            for metric, title in ROUNDS[env].items()
            if metric in means
        ]
        where = "" if env == PENDULUM else f"`{env}`, "
        yield f"{where}`{word}` on {data}, round {first} -> {last}: {', '.join(said)}."
