"""A comparison: A against B on one arm and one measure is better, level or worse.

The smallest effect that matters was written down before: ``smallest``. The interval resamples
training seeds, and the targets or episodes that all seeds share, together; the rest is pairing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from reproduction.tables import select

# The smallest effects that matter ---------------------------------------------------------------

OF_COST = 0.02  # of the simulator's cost under the same search: returns and their gaps
OF_SCORE = 0.05  # of B's: energy scores, errors, shares
NATS = 0.1  # per step: log-likelihoods
DRAWS, LEVEL = 2000, 0.95  # of the bootstrap

COSTS = ("return_true", "return_predicted", "gap")
SIZES = ("exploitation_gap",)  # taken without their sign
RATIOS = ("gradient_snr",)  # compared by their logarithms
LOWER = ("gap", "energy_score_noise", "nrmse", "rmse_clean", "diverged", *SIZES)
LOWER += ("final_distance", "moves_untouched", "penetrates", "violations_worst")
LOWER += ("error_prior", "error_posterior")
PLACES = {"Reacher": "tsm/Reacher-v0", "ReacherObstacle": "tsm/ReacherObstacle-v0"}
PLACES |= {"ReacherPush": "tsm/ReacherPush-v1"}
Tables = Callable[[str], pd.DataFrame]


@dataclass(frozen=True)
class Comparison:
    """A against B, or against a number.

    Args:
        table: of data/results; measure: its metric, "gap" the size of predicted minus executed.
        a: a model, or model, search space and planner with - between: ``tsm-latent-cem``.
        b: another, or a number.
        on: an arm, such as ``Reacher-noise0.25``; b_on: B's, where it is another.
        expect: what the claim says of A: better, worse, level, not worse, at most, at least.
        at: steps ahead, 0 for the mean over all; b_measure, b_table: B's, where they are others.
        times: what B is multiplied by.
        where: further columns of A's rows, and of B's unless ``b_where`` is given.
        over_at: steps ahead by whose value both are divided, for how an error grows.
    """

    table: str
    measure: str
    a: str
    b: str | float
    on: str
    expect: str
    at: int = 0
    b_on: str = ""
    b_measure: str = ""
    b_table: str = ""
    times: float = 1.0
    where: tuple[tuple[str, object], ...] = ()
    b_where: tuple[tuple[str, object], ...] = ()
    over_at: int = 0


@dataclass(frozen=True)
class Finding:
    """What a comparison found.

    Args:
        comparison: what was compared.
        difference: A minus B; low, high: its interval, NaN where there is one number only.
        smallest: the effect that matters.
        ahead: share of targets or episodes, else of seeds, where A is ahead; of ties half.
        seeds, units: how many there are of both.
        word: better, level, worse or open; "missing" where a table lacks the rows.
    """

    comparison: Comparison
    difference: float
    low: float
    high: float
    smallest: float
    ahead: float
    seeds: int
    units: int
    word: str

    @property
    def holds(self) -> bool | None:
        """Whether it is as the claim says; None where it is open, or rows are missing."""
        accepted = {"not worse": ("better", "level"), "not better": ("worse", "level")}
        if self.word in ("open", "missing"):
            return None
        return self.word in accepted.get(self.comparison.expect, (self.comparison.expect,))


def compare(one: Comparison, tables: Tables) -> Finding:
    """Judge one comparison by the rows of its table.

    Args:
        one: what is compared.
        tables: name of a table -> its rows.

    Returns:
        What was found.
    """
    try:
        a = _values(one, one.a, one.on, one.measure, one.where, tables)
        if isinstance(one.b, str):
            where = one.b_where or one.where
            other = replace(one, table=one.b_table or one.table)
            measure, on = one.b_measure or one.measure, one.b_on or one.on
            b = _values(other, one.b, on, measure, where, tables)
            a, b = _paired(a, one.times * b)
        else:
            b = 0 * a + one.times * one.b
        if one.measure in RATIOS:
            a, b = np.log(a), np.log(b)
    except KeyError:
        return Finding(one, *[np.nan] * 5, 0, 0, "missing")
    sign = -1 if one.measure in LOWER else 1
    difference = (a - b).to_numpy()
    low, high = interval(difference)
    mean, effect = float(difference.mean()), smallest(one, float(b.to_numpy().mean()), tables)
    by_unit = sign * (difference.mean(0) if difference.shape[1] > 1 else difference[:, 0])
    ahead = float(((by_unit > 0) + 0.5 * (by_unit == 0)).mean())
    if one.expect in ("at most", "at least"):
        word = _bounded(one.expect, mean, low, high)
    else:
        word = _word(sign * mean, *sorted((sign * low, sign * high)), effect)
    return Finding(one, mean, low, high, effect, ahead, *difference.shape, word)


def interval(difference: np.ndarray, draws: int = DRAWS) -> tuple[float, float]:
    """95 % interval of a mean over seeds and units (S, N), both resampled; NaN for one number."""
    seeds, units = difference.shape
    if seeds * units == 1:
        return np.nan, np.nan
    draw = np.random.default_rng(0)
    of_seeds = draw.multinomial(seeds, np.full(seeds, 1 / seeds), draws) / seeds
    of_units = draw.multinomial(units, np.full(units, 1 / units), draws) / units
    means = ((of_seeds @ difference) * of_units).sum(1)
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def smallest(one: Comparison, of_b: float, tables: Tables) -> float:
    """The smallest effect that matters, in the measure's unit."""
    if one.measure.startswith("ll_"):
        return NATS
    if one.measure in COSTS:
        found = select(tables("05_control"), model="oracle", search_space="latent", planner="cem")
        found = select(found, env=PLACES[one.on.partition("-")[0]], metric="return_true")
        found = select(found, execution="open loop")
        return OF_COST * abs(float(found["value"].mean()))
    return OF_SCORE if one.measure in RATIOS else OF_SCORE * abs(of_b)


def _word(mean: float, low: float, high: float, effect: float) -> str:
    """By a difference that is positive where A is better."""
    if low > 0 and mean >= effect:
        return "better"
    if high < 0 and mean <= -effect:
        return "worse"
    return "level" if -effect < low and high < effect else "open"


def _bounded(expect: str, mean: float, low: float, high: float) -> str:
    """Whether a number is on its side of a bound, 0 here; one number alone decides by itself."""
    low, high = (mean, mean) if np.isnan(low) else (low, high)
    if expect == "at least":
        return "at least" if low >= 0 else ("at most" if high < 0 else "open")
    return "at most" if high <= 0 else ("at least" if low > 0 else "open")


def _values(
    one: Comparison,
    who: str,
    on: str,
    measure: str,
    where: tuple[tuple[str, object], ...],
    tables: Tables,
) -> pd.DataFrame:
    """Values (seeds, units) of one side; KeyError where there are none."""
    if measure == "gap":
        sides = (
            _values(one, who, on, metric, where, tables)
            for metric in ("return_predicted", "return_true")
        )
        predicted, executed = _paired(*sides)
        return (predicted - executed).abs()
    model, space, planner = [*who.split("-"), "", ""][:3]
    arm, noise, delay = _place(on)
    way = {"policy": "policy", "": None}.get(planner, "open loop")
    known: dict[str, object] = {"env": arm, "noise": noise, "delay": delay, "model": model}
    known |= {"metric": measure, "subset": None}
    known |= {"search_space": space or None} if space or planner else {}
    known |= {"planner": planner, "execution": way} if planner else {}
    known |= {"execution": "open loop"} if one.table in ("03_predict", "03_ablation") else {}
    rows = select(tables(one.table), **(known | dict(where)))
    wide = _wide(select(rows, steps_ahead=one.at or None))
    if one.over_at:
        wide = wide / _wide(select(rows, steps_ahead=one.over_at))
    return wide.abs() if measure in SIZES else wide


def _wide(rows: pd.DataFrame) -> pd.DataFrame:
    """(seeds, targets or episodes): the last record of what is learned, means over copies."""
    if rows.empty:
        raise KeyError("no rows")
    order = "iteration" if rows["iteration"].notna().any() else "env_steps"
    steps = rows[order].fillna(-1)
    rows = rows[steps == steps.groupby(rows["seed"]).transform("max")]
    unit = next((name for name in ("target", "episode") if name in rows), "")
    rows = rows.assign(unit=rows[unit].fillna(0) if unit else 0, seed=rows["seed"].fillna(0))
    return rows.pivot_table(index="seed", columns="unit", values="value").dropna(axis=1)


def _paired(a: pd.DataFrame, b: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The seeds and units that both have; one seed of B is compared with all of A."""
    if len(b) == 1 and len(a) > 1:
        b = pd.concat([b] * len(a)).set_axis(a.index)
    seeds, units = a.index.intersection(b.index), a.columns.intersection(b.columns)
    if not len(seeds) or not len(units):
        raise KeyError("no seed that both have")
    return a.loc[seeds, units], b.loc[seeds, units]


def _place(on: str) -> tuple[str, float | None, int | None]:
    """Environment, noise and delay of an arm by its name."""
    arm, *imperfect = on.split("-")
    noise = next((float(word[5:]) for word in imperfect if word.startswith("noise")), None)
    delay = next((int(word[5:]) for word in imperfect if word.startswith("delay")), None)
    return PLACES[arm], noise, delay
