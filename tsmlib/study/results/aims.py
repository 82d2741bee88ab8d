"""Aims of the study's own model, of the pushing task and of exploration beside what the published rows say.

They are ours, not the paper's, and were set before these rows were there. Each is held against the other model that is
hardest to be ahead of, which is named.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import bootstrap

from tsmlib.envs.spec import EnvSpec
from tsmlib.figures.method import Method
from tsmlib.statistics import interval, random_effects
from tsmlib.study import zoo
from tsmlib.study.results import adaptation, exploration, planning, policies, prediction, table
from tsmlib.study.results.planning import BASELINES, CLOSED, ORACLE, PUSH, REACH
from tsmlib.study.zoo import OURS

OBSTACLE = "tsm/ReacherObstacle-v0"
WEAK, WEAK_PUSH = "tsm/Reacher-gain0.7-v0", "tsm/ReacherPush-gain0.7-v1"
FEW = 2000  # steps: 20 episodes
ENERGY = "energy_score_noise"
Line = tuple[str, str, float, float, str]  # of table.thresholds


class Worst(NamedTuple):
    """A ratio or a difference against the other model that is hardest to be ahead of, and that model.

    seeds: that both have, where they are fewer than of our own model; else 0.
    """

    value: float
    against: str
    seeds: int = 0

    @property
    def told(self) -> str:
        """``"`lstm`'s"``, ``"`ensemble+mse`'s (1 seed)"``."""
        return f"`{self.against}`'s" + f" ({self.seeds} seed{'s' * (self.seeds > 1)})" * bool(self.seeds)


def aims(predict: pd.DataFrame, plans: pd.DataFrame, targets: pd.DataFrame, learned: pd.DataFrame) -> pd.DataFrame:
    """Aims with what was measured: columns what, threshold, measured, reached, as of ``table.thresholds``.

    Rows of 03_predict with those of other libraries' models, of 05_control, of 05_control_rows and of policies, those
    without a model included. Means over training seeds; ratios and differences paired by seed, or by target.
    """
    return table.thresholds([*_of_plans(plans, targets), *_of_predictions(predict), *_of_policies(learned)])


def of_exploration(rows: pd.DataFrame, free: pd.DataFrame) -> pd.DataFrame:
    """Aims of 10_explore, as ``aims``: rows of it, and learning curves of model-free policies.

    Of differences, paired by seed, the lower end of the 95 % interval over training seeds is held against an aim.
    """
    rows = rows if "configuration" in rows else rows.assign(configuration="")  # of other notebooks, or none
    return table.thresholds([*_of_rounds(rows, free), *_of_adaptation(rows)])


def missed(found: pd.DataFrame) -> str:
    """A clause with the aims of a table of ``aims`` that were not reached; empty if all were."""
    short = found["threshold"].replace({"at most": "≤", "at least": "≥"}, regex=True)
    left = found.assign(threshold=short)[~found["reached"]]
    lines = [f"{line.what} {line.measured} ({line.threshold})" for line in left.itertuples()]
    return f"{len(lines)} of {len(found)} are missed: {'; '.join(lines)}." if lines else ""


def gap_told(targets: pd.DataFrame, *, most: int = 5) -> str:
    """How far the ratio of mean gaps rests on few targets: the share of the ``most`` largest, the 95 % interval when
    targets are drawn again, and medians. Rows of 05_control_rows; empty without those of both models."""
    gaps = _latent(planning.gap_sizes(planning.plans_of(targets, env=PUSH, planners=["cem"])))
    pairs = {other: _shared(gaps[OURS], gaps[other]) for other in BASELINES if {OURS, other} <= {*gaps}}
    if not pairs:
        return ""
    other = max(pairs, key=lambda each: _ratio(*pairs[each]))
    both = pd.concat([each.mean() for each in pairs[other]], axis=1, join="inner").to_numpy()
    if len(both) < 2:
        return ""
    ours, theirs = both.T
    drawn = bootstrap(
        (ours, theirs), lambda x, y, axis: x.mean(axis) / y.mean(axis), paired=True, vectorized=True,
        random_state=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    largest = np.sort(ours)[-most:].sum() / ours.sum()
    return (
        f"Few targets decide a mean gap: the {most} largest of `{OURS}` are {largest:.0%} of its {ours.mean():.2f} m "
        f"({len(pairs[other][0])} of {len(gaps[OURS])} seeds). Its ratio to that of `{other}` is {drawn.low:.2f} to "
        f"{drawn.high:.2f} in 95 % of draws of {len(ours)} targets with replacement; the medians are "
        f"{np.median(ours):.2f} and {np.median(theirs):.2f} m."
    )


def _shared(ours: pd.DataFrame, theirs: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Both tables (seeds, targets), of the seeds that they share."""
    seeds = ours.index.intersection(theirs.index)
    return ours.loc[seeds], theirs.loc[seeds]


def _ratio(ours: pd.DataFrame, theirs: pd.DataFrame) -> float:
    """Of the means of two such tables."""
    return float(ours.to_numpy().mean() / theirs.to_numpy().mean())


def _latent(found: Mapping[Method, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """Model -> values of its plans over codes."""
    return {way.model: values for way, values in found.items() if way.search_space == "latent"}


def _of_plans(plans: pd.DataFrame, targets: pd.DataFrame) -> list[Line]:
    opened, closed = (
        table.select(planning.plans_of(plans, env=PUSH, execution=way), planner=["cem", "zero"])
        for way in ("open loop", CLOSED)
    )

    def mean(metric: str, model: str, rows: pd.DataFrame = opened) -> float:
        own = table.select(rows, model=model, metric=metric)
        own = own[(own["search_space"] == "latent") | (own["planner"] == "zero")]
        return float(own["value"].mean())

    by_target = planning.plans_of(targets, env=PUSH, planners=["cem"])
    costs, gaps = _latent(planning.costs_of(by_target)), _latent(planning.gap_sizes(by_target))
    there = [other for other in BASELINES if {OURS, other} <= {*costs} & {*gaps}]
    apart = {other: planning.paired_differences(costs[OURS], costs[other]) for other in there}
    apart = {other: each for other, each in apart.items() if each.size}
    behind = _worst(
        {other: sum(interval(each.mean().to_numpy())) for other, each in apart.items()},
        {other: len(each) for other, each in apart.items()} | {OURS: len(costs.get(OURS, ()))},
    )
    trained = _worst({
        other: float(each.to_numpy().mean()) + random_effects(each.to_numpy()).half()
        for other, each in apart.items() if len(each) > 1
    })  # fmt: skip
    both = {other: _shared(gaps[OURS], gaps[other]) for other in there}
    seeds = {other: len(ours) for other, (ours, _) in both.items()} | {OURS: len(gaps.get(OURS, ()))}
    gap = _worst({other: _ratio(*each) for other, each in both.items()}, seeds)
    return [
        ("cost of no torque over the oracle's", "at least", 2.0, mean("cost_over_oracle", "none"), "{:.2f}"),
        ("pushes by the oracle within 5 cm", "at least", 0.9,
         mean("success", ORACLE.model), "{:.0%}"),
        (f"cost of plans through `{OURS}` over the oracle's", "at most", 1.15, mean("cost_over_oracle", OURS),
         "{:.2f}"),
        (f"pushes by `{OURS}`, planned again every ten steps, within 5 cm", "at least", 0.8,
         mean("success", OURS, closed), "{:.0%}"),
        (f"`{OURS}`'s cost minus {behind.told} (m), upper end over targets", "at most", 0.0, behind.value,
         "{:.2f}"),
        (f"`{OURS}`'s cost minus {trained.told} (m), upper end over targets and seeds", "at most", 0.0,
         trained.value, "{:.2f}"),
        (f"`{OURS}`'s mean gap over {gap.told}", "at most", 0.5, gap.value, "{:.2f}"),
        (f"steps predicted by `{OURS}` that violate physics", "at most", 0.05, mean("violations", OURS), "{:.1%}"),
    ]  # fmt: skip


def _of_predictions(predict: pd.DataFrame) -> list[Line]:
    found = list[Line]()
    for env, steps, bound in ((PUSH, 10, 0.5), (PUSH, 80, 0.5), (OBSTACLE, None, 1.0), (REACH, None, 1.0)):
        worst = _over_others(predict, env, steps)
        where = f"at {steps} steps" if env == PUSH else f"of {EnvSpec.parse(env).name}"
        what = f"`{OURS}`'s energy score {where} over {worst.told}"
        found.append((what, "at most", bound, worst.value, "{:.2f}"))
    return found


def _over_others(predict: pd.DataFrame, env: str, steps: int | None) -> Worst:
    """The mean over seeds that both have of our energy score over another model's; the largest of all models."""
    rows = prediction.select(predict, ENERGY, env=env, steps_ahead=steps)
    wide = rows.pivot(index="seed", columns="model", values="value")
    ours = wide[OURS] if OURS in wide else pd.Series(dtype=float)
    ratios = {str(other): ours / wide[other] for other in wide}
    seeds = {other: int(each.notna().sum()) for other, each in ratios.items()}
    return _worst({other: float(each.mean()) for other, each in ratios.items() if other != OURS}, seeds)


def _of_policies(learned: pd.DataFrame) -> list[Line]:
    curves: Mapping[Method, Mapping[str, np.ndarray]] = policies.learning_curves(learned).get("push", {})
    inside, free = dict[str, float](), dict[str, float]()  # returns at the end; of two search spaces the larger
    seeds = {method.model: int(own["seeds"]) for method, own in curves.items()}
    for method, own in curves.items():
        ends, end = inside if method.search_space else free, float(own["return_true"][:, -1].mean())
        ends[method.model] = max(end, ends.get(method.model, end))
    ours = inside.pop(OURS, float("nan"))
    names = {"": "others"} | {word: zoo.look(word).name for word in seeds}
    return [
        (f"return of the best policy inside `{OURS}` minus {names[worst.against]}'s "
         f"({seeds.get(OURS, 0)} and {seeds.get(worst.against, 0)} seeds)", "at least", 0.0, -worst.value, "{:.2f}")
        for others in (inside, free)
        for worst in [_worst({model: end - ours for model, end in others.items()})]
    ]  # fmt: skip


def _of_rounds(rows: pd.DataFrame, free: pd.DataFrame) -> list[Line]:
    closed = table.select(rows, execution=CLOSED, configuration=exploration.PLANNED)
    pushing = table.select(rows, env=PUSH, execution=CLOSED, model=OURS)
    last = int(pushing["iteration"].max()) if len(pushing) else 0
    before, alone = "round 0", exploration.NONE
    won = table.select(pushing, metric="success")
    gained = 100 * exploration.paired(won, last) if last else pd.DataFrame(columns=[before, alone], dtype=float)
    lines: list[Line] = [
        (f"points of success, pushing by `{OURS}`, after {last} rounds of own plans minus {what}, lower end",
         "at least", 10.0, _lower(gained[what]), "{:.1f}")
        for what in (before, alone)
    ]  # fmt: skip
    for policy in exploration.MODEL_FREE:
        share = exploration.steps_share(closed, table.select(free, model=policy), PUSH, OURS)
        lines.append((f"steps of `{OURS}` to what {zoo.look(policy).name} returns at its end, pushing, over its own",
                      "at most", 0.1, share, "{:.1%}"))  # fmt: skip
    for env, where in ((exploration.PENDULUM, "swinging up"), (PUSH, "pushing")):
        ends = table.select(closed, env=env, metric="return_true", model=[OURS, "pets"])
        wide = ends[ends["iteration"] == ends["iteration"].max()].pivot(index="seed", columns="model", values="value")
        ahead = wide.get(OURS, pd.Series(dtype=float)) - wide.get("pets", pd.Series(dtype=float))
        told = f"{where} ({ahead.notna().sum()} seeds)"
        lines.append((f"return of `{OURS}` minus that of mbrl-lib's PETS after as many steps, {told}, lower end",
                      "at least", 0.0, _lower(ahead), "{:.2f}"))  # fmt: skip
    seconds = table.select(closed, env=PUSH, model=OURS, metric="wall_seconds")["value"]
    return [
        *lines,
        ("iterations of a search in codes of the last prior over those in codes of the first, to the return that the "
         "latter ends with; inf: in some seed not within ten", "at most", 0.5, _iterations(rows), "{:.2f}"),
        (f"minutes of the longest round of pushing by `{OURS}`, by the clock, one process", "at most", 10.0,
         float(seconds.max()) / 60, "{:.1f}"),
    ]  # fmt: skip


def _iterations(rows: pd.DataFrame) -> float:
    own = table.select(rows, env=PUSH, model=OURS, configuration=exploration.PLANNED, execution=planning.OPEN,
                       metric="iterations_to_same_return")  # fmt: skip
    wide = own.pivot(index="seed", columns="subset", values="value")
    searched = table.select(rows, env=PUSH, model=OURS, configuration=exploration.PLANNED, execution=planning.OPEN,
                            metric="return_true", subset=exploration.LAST_PRIOR)  # fmt: skip
    wide = wide[wide.index.isin(searched["seed"])].reindex(columns=[exploration.FIRST_PRIOR, exploration.LAST_PRIOR])
    first, last = (wide[which].astype(float) for which in wide)
    return float((last.fillna(np.inf) / first).mean())


def _of_adaptation(rows: pd.DataFrame) -> list[Line]:
    reaching, pushing = _recovered(rows, WEAK), _recovered(rows, WEAK_PUSH)
    none = pd.Series(dtype=float)
    ours = reaching.pop(OURS, none)
    return [
        *((f"percent of its loss on {arm} with weak motors, against a model trained on {n} of its episodes, that "
           f"`{OURS}` recovers from 20, all weights", "at least", 70.0, float(found.mean()), "{:.1f}")
          for arm, n, found in (("a reaching arm", 500, ours), ("a pushing arm", "5,000", pushing.get(OURS, none)))),
        *((f"percent that `{OURS}` recovers on the reaching arm minus that of `{word}` (points), lower end", "at least",
           0.0, _lower(ours - reaching.get(word, none)), "{:.1f}") for word in ("lstm", "ensemble+mse")),
    ]  # fmt: skip


def _recovered(rows: pd.DataFrame, env: str) -> dict[str, pd.Series]:
    """Model -> percent of its loss on an arm that all weights recover from FEW steps, by seed."""
    here = table.select(rows, env=env, execution=planning.OPEN, planner="none", metric=ENERGY)
    here = here[here["steps_ahead"] == here["steps_ahead"].max()]
    shares = {word: adaptation.recovered(own) for word, own in table.groups(here, "model")}
    return {word: 100 * found["all", FEW] for word, found in shares.items() if ("all", FEW) in found}


def _lower(values: pd.Series) -> float:
    """The lower end of the 95 % interval of a mean; NaN of fewer than two values."""
    known = values.dropna().to_numpy(float)
    mean, half = interval(known) if len(known) > 1 else (float("nan"), 0.0)
    return mean - half


def _worst(found: Mapping[str, float], seeds: Mapping[str, int] | None = None) -> Worst:
    """The largest value and whose it is; NaN of nothing. seeds: of each model, our own among them."""
    known = {word: value for word, value in found.items() if value == value}
    word = max(known, key=lambda each: known[each], default="")
    n = (seeds or {}).get(word, 0)
    return Worst(known.get(word, float("nan")), word, n if n < (seeds or {}).get(OURS, 0) else 0)
