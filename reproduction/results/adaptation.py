"""Results of adapted models (10_explore): their rows; curves, tables and sentences from rows.

Rows are ``open loop``, of predictions without a planner; ``env_steps`` are those of the changed arm that a model
knows, and ``configuration`` is the way (``study.adaptation``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

import numpy as np
import pandas as pd

from tsmlib.envs.spec import EnvSpec
from tsmlib.evaluation.prediction import Scores
from tsmlib.plots.method import Look, Method
from tsmlib.planning.execution import Trial
from tsmlib import zoo
from reproduction.results import table
from reproduction.results.planning import ARRIVED, OPEN
from reproduction.results.table import Row
from reproduction.runs import Run

REFERENCE: Final = "reference"
SCORES = {"energy_score_noise": "energy score", "nrmse": "nRMSE"}
PLANS = ("return_true", "success", "gap_absolute")  # metrics of plans
WAYS = {  # of training: no colour and no marker of a model; the redder, the more of the weights is trained on
    "zero-shot": Look("zero-shot", "#6E6E6E", (5, 2, 0)),
    "all": Look("all weights", "#8B0A1A", (6, 1, 0)),
    "head": Look("head", "#E34A33", "8"),
    "codes": Look("codes", "#F4A582", "+"),
    "scratch": Look("from scratch", "#6B6B00", "x"),
    "reference": Look("trained in full", "#1E1E1E", (4, 1, 45)),
}


def adapted_rows(
    run: Run,
    env: str,
    word: str,
    way: str,
    scores: Scores,
    *,
    episodes: int,
    ahead: Sequence[int],
    seconds: float | None,
) -> list[Row]:
    """Both scores of an adapted model at some steps ahead, and the CPU ``seconds`` of its training; no row of these for
    None, where they are of several models together."""
    curves = scores.against_horizon()
    common = dict(
        env=env,
        sim=EnvSpec.parse(env).simulator,
        model=word,
        planner="none",
        execution=OPEN,
        configuration=way,
        env_steps=100 * episodes,
        n=len(scores.outside),
        seed=run.seed,
        scale=run.scale,
    )
    found = [
        common
        | dict(metric=metric, steps_ahead=steps, value=float(curves[metric][steps - 1]), unit="1")
        for metric in SCORES
        for steps in ahead
    ]
    if seconds is not None:
        found.append(common | dict(metric="train_seconds", value=seconds, unit="s"))
    return found


def planned_rows(
    run: Run, env: str, word: str, way: str, trial: Trial, *, episodes: int, samples: int
) -> list[Row]:
    """Executed return, share within the task's tolerance and mean size of the gap of an adapted model's plans.

    samples: by which candidates were judged beside the mode.
    """
    assert trial.success is not None
    spec = EnvSpec.parse(env)
    common = dict(
        env=env,
        sim=spec.simulator,
        task=spec.task,
        model=word,
        planner="cem",
        search_space="latent",
        execution=OPEN,
        horizon=trial.actions.shape[1],
        configuration=way,
        env_steps=100 * episodes,
        n=len(trial.actions),
        seed=run.seed,
        scale=run.scale,
    ) | ({"samples": samples} if samples else {})
    found = {
        "return_true": (trial.executed_return, "m"),
        "success": (trial.success.float(), "share"),
        "gap_absolute": (trial.gap.abs(), "m"),
    }
    return [
        common | dict(metric=metric, value=float(values.mean()), unit=unit)
        for metric, (values, unit) in found.items()
    ]


def way_curves(
    rows: pd.DataFrame, steps_ahead: int
) -> dict[str, dict[Method, tuple[np.ndarray, np.ndarray]]]:
    """Model -> way -> episodes of the changed arm (R,) and energy score (k, R), for ``figures.adapted``."""
    found: dict[str, dict[Method, tuple[np.ndarray, np.ndarray]]] = {}
    here = table.select(rows, execution=OPEN, metric="energy_score_noise", steps_ahead=steps_ahead)
    for (word, way), own in table.groups(here, ["model", "configuration"]):
        wide = own.pivot(index="seed", columns="env_steps", values="value").dropna()
        looked = Method(way, look=WAYS[way])
        found.setdefault(zoo.look(word).name, {})[looked] = (
            wide.columns.to_numpy(float) / 100,
            wide.to_numpy(float),
        )
    return {
        model: dict(sorted(ways.items(), key=lambda item: [*WAYS].index(item[0].model)))
        for model, ways in found.items()
    }


def shares_left(
    rows: pd.DataFrame, episodes: int
) -> dict[str, dict[str, dict[Method, np.ndarray]]]:
    """Model and steps ahead -> arm -> way -> the share of the zero-shot energy score that is left (k,), paired by seed,
    for ``figures.arms``. What is adapted alone, not what is trained anew."""
    here, found = (
        table.select(rows, execution=OPEN, planner="none", metric="energy_score_noise"),
        {},
    )
    for (ahead, word), own in sorted(
        table.groups(here, ["steps_ahead", "model"]),
        key=lambda of: (of[0][0], zoo.look(of[0][1]).name),
    ):
        if arms := _by_arm(own, ("all", "head", "codes"), episodes, np.divide):
            found[f"{zoo.look(word).name}, {ahead} steps"] = arms
    return found


def gains(rows: pd.DataFrame, episodes: int) -> dict[str, dict[str, dict[Method, np.ndarray]]]:
    """Model -> arm -> way -> executed return of plans minus zero-shot (k,), paired by seed, for ``figures.arms``."""
    here, found = table.select(rows, execution=OPEN, planner="cem", metric="return_true"), {}
    for word, own in sorted(table.groups(here, "model"), key=lambda of: zoo.look(of[0]).name):
        if arms := _by_arm(own, ("all", "head", "codes", "scratch"), episodes, np.subtract):
            found[zoo.look(word).name] = arms
    return found


def _by_arm(
    rows: pd.DataFrame,
    ways: Sequence[str],
    episodes: int,
    change: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> dict[str, dict[Method, np.ndarray]]:
    """Arm -> way -> ``change`` of a value from that of zero-shot, of the same seed and the same n."""
    found = {}
    for env, own in table.groups(rows, "env"):
        before, spec, changed = table.select(own, configuration="zero-shot"), EnvSpec.parse(env), {}
        for way in ways:
            after = table.select(own, configuration=way, env_steps=100 * episodes)
            both = after.merge(before, on=["seed", "n"], suffixes=("", "_before"))
            if len(both):
                changed[Method(way, look=WAYS[way])] = change(
                    *both[["value", "value_before"]].to_numpy(float).T
                )
        if changed:
            found[f"{spec.task}, {spec.physics.label}"] = changed
    return found


@table.sourced
def ways_table(rows: pd.DataFrame) -> pd.DataFrame:
    """A line for each arm, model, way and number of episodes: both scores, and CPU seconds of training."""
    lines = []
    keys = ["env", "model", "configuration", "env_steps"]
    for (env, word, way, steps), own in table.groups(
        table.select(rows, execution=OPEN, planner="none"), keys
    ):
        line: Row = {
            "env": env,
            "model": f"`{word}`",
            "what": WAYS[way].name,
            "episodes": int(steps) // 100,
        }
        for metric, title in SCORES.items():
            for ahead, part in table.groups(table.select(own, metric=metric), "steps_ahead"):
                line[f"{title}, {ahead} steps"] = table.spell(part["value"])
        spent = table.select(own, metric="train_seconds")["value"]
        line["CPU s"] = table.spell(spent, "{:.0f}") if len(spent) else "-"
        lines.append({**line, "seeds": own["seed"].nunique(), "n": int(own["n"].max())})
    return pd.DataFrame(lines)


@table.sourced
def plans_table(rows: pd.DataFrame) -> pd.DataFrame:
    """A line for each arm, model, way and number of episodes: what its plans return, minus zero-shot (paired by seed,
    to as many targets), how many end within the tolerance, and the size of the gap."""
    lines = []
    here = table.select(rows, execution=OPEN, planner="cem", configuration=list(WAYS))
    for (env, word), own in table.groups(here, ["env", "model"]):
        columns = ["metric", "configuration", "env_steps"]
        wide, n = (own.pivot(index="seed", columns=columns, values=name) for name in ("value", "n"))
        ways = set(zip(own["configuration"], own["env_steps"], strict=True))
        for way, steps in sorted(ways, key=lambda of: ([*WAYS].index(of[0]), of[1])):
            returns, success, gap = (wide[metric, way, steps].dropna() for metric in PLANS)
            line: Row = {
                "env": env,
                "model": f"`{word}`",
                "what": WAYS[way].name,
                "episodes": int(steps) // 100,
            }
            line["executed return"] = table.spell(returns, "{:.2f} ± {:.2f}")
            line["minus zero-shot"] = ""
            if way != "zero-shot" and ("return_true", "zero-shot", 0) in wide:
                this, before = ("return_true", way, steps), ("return_true", "zero-shot", 0)
                gained = (wide[this] - wide[before]).where(n[this] == n[before]).dropna()
                line["minus zero-shot"] = table.spell(gained, "{:+.2f} ± {:.2f}")
            line[ARRIVED] = table.spell(success, "{:.1%} ± {:.1%}")
            line["size of the gap"] = table.spell(gap, "{:.2f} ± {:.2f}")
            lines.append(
                {**line, "seeds": len(returns), "n": int(n["return_true", way, steps].max())}
            )
    return pd.DataFrame(lines)


@table.sourced
def recovered_table(rows: pd.DataFrame) -> pd.DataFrame:
    """A line for each arm, model and way: the share of the loss of energy score that n episodes recover,

        (zero-shot - adapted) / (zero-shot - trained in full),

    paired by seed, at the greatest number of steps ahead. Only where the reference has rows, and is better than
    zero-shot."""
    lines = []
    here = table.select(rows, execution=OPEN, planner="none", metric="energy_score_noise")
    here = here[here["steps_ahead"] == here["steps_ahead"].max()]
    for (env, word), own in table.groups(here, ["env", "model"]):
        found = recovered(own)
        for way in [way for way in WAYS if way in found and found[way].notna().to_numpy().any()]:
            line: Row = {"env": env, "model": f"`{word}`", "what": WAYS[way].name}
            for steps in sorted(found.columns.get_level_values("env_steps").unique()):
                shares = found[way][steps].dropna() if steps in found[way] else []
                line[f"{int(steps) // 100} episodes"] = (
                    table.spell(shares, "{:.1%} ± {:.1%}") if len(shares) else ""
                )
            lines.append(
                {**line, "seeds": len(found[way].dropna(how="all")), "n": int(own["n"].max())}
            )
    return pd.DataFrame(lines)


def recovered(rows: pd.DataFrame) -> pd.DataFrame:
    """Of energy scores of one arm and model, the share recovered of what zero-shot loses against the reference: a line
    for each seed that has both, a column for each way and number of steps. NaN where the reference is no better than
    zero-shot, so that there is nothing to recover."""
    wide = rows.pivot(index="seed", columns=["configuration", "env_steps"], values="value")
    if not {"zero-shot", REFERENCE} <= set(wide.columns.get_level_values(0)):
        return pd.DataFrame()
    one = (
        wide.T.groupby(level=0).first().T
    )  # column of each way; those two have one number of episodes
    zero, full = one["zero-shot"], one[REFERENCE]
    ways = wide.drop(columns=["zero-shot", REFERENCE], level=0)
    lost = (zero - full).where(zero > full)
    return ways.rsub(zero, axis=0).div(lost, axis=0).dropna(how="all")


@table.told
def sentences(rows: pd.DataFrame) -> Iterator[str]:
    """How much of the zero-shot error each way leaves, and how much of what the reference takes off it."""
    last_steps = table.select(rows, execution=OPEN, metric="energy_score_noise")
    last_steps = last_steps[last_steps["steps_ahead"] == last_steps["steps_ahead"].max()]
    for (env, word), own in table.groups(last_steps, ["env", "model"]):
        keyed = table.groups(own, ["configuration", "env_steps"])
        left = {(str(way), int(steps)): float(part["value"].mean()) for (way, steps), part in keyed}
        if (zero := left.pop(("zero-shot", 0), None)) is not None:
            ahead = own["steps_ahead"].max()
            shares = {key: value / zero for key, value in left.items()}
            yield (
                f"`{env}`, `{word}`: of the zero-shot energy score at {ahead} steps is left, with n episodes, by "
                f"{_by_way(shares)}."
            )
            if len(found := recovered(own)):
                means = found.mean().dropna()
                shares = {
                    (str(key[0]), int(key[1])): float(mean)
                    for key, mean in zip(means.index, means, strict=True)
                }
                yield (
                    f"`{env}`, `{word}`: of what training in full takes off it is taken off by {_by_way(shares)} "
                    f"(paired, seeds: {len(found)})."
                )


def _by_way(shares: Mapping[tuple[str, int], float]) -> str:
    """Shares in words, way by way; keys: way and steps."""
    said = []
    for way, look in WAYS.items():
        own = sorted((steps, share) for (which, steps), share in shares.items() if which == way)
        if own:
            said.append(
                f"{look.name} {', '.join(f'{share:.0%} ({steps // 100})' for steps, share in own)}"
            )
    return "; ".join(said)
