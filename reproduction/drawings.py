"""Figures of results tables, drawn alike by the notebooks and, from the tables that ship, by ``publish --figures``.

found: the rows of a notebook's table, with the column ``source`` (``study.evidence``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import pandas as pd
from matplotlib.figure import Figure

from tsmlib import plots as figures
from tsmlib.envs.spec import EnvSpec
from tsmlib.evaluation import scoring
from tsmlib.plots.method import Method
from tsmlib.models.action_prior import ActionPrior
from tsmlib.planning.execution import execute
from tsmlib.planning.tasks import Task, random_torques, zero_torques
from tsmlib import zoo
from reproduction import rounds as rounds_study
from reproduction.results import (
    adaptation,
    exploration,
    latent,
    planning,
    policies,
    prediction,
    robustness,
    table,
)
from tsmlib.trajectory import Trajectories

PROTOCOLS = {"ll_paper": "paper's protocol", "ll_shared": "one shared variance"}  # of figure 5
SCORES = {**PROTOCOLS, "ll_own": "own density", "energy_score_noise": "energy score"}
FEW = (zoo.PAPERS, zoo.OURS, "onestep", "multistep", "lstm", "ensemble+mse")  # drawn step by step


class Drawing(NamedTuple):
    """A figure, what its files are called, and the rows that it draws, for its stamp."""

    figure: Figure
    stem: str
    rows: pd.DataFrame


# 03_predict ----------------------------------------------------------------------------------------------------------


def _whole(found: pd.DataFrame, envs: Sequence[str]) -> pd.DataFrame:
    return table.select(found, execution="open loop", subset="", env=envs)


def figure5(found: pd.DataFrame, envs: Sequence[str]) -> Drawing:
    """Log-likelihoods of all models, by environment."""
    published, yours = table.pair(
        found, partial(prediction.score_panels, titles=PROTOCOLS, envs=envs)
    )
    return Drawing(figures.figure5(published, yours=yours), "figure5", _whole(found, envs))


def horizon(found: pd.DataFrame, envs: Sequence[str]) -> Iterator[Drawing]:
    """Three scores of the models FEW at every step ahead."""
    titles = {"ll_paper": "log-likelihood", "energy_score_noise": "energy score", "nrmse": "error"}
    few = table.select(_whole(found, envs), model=FEW)
    published, yours = table.pair(few, partial(prediction.horizon_panels, titles=titles, envs=envs))
    units = {
        "log-likelihood": "nats per step",
        "energy score": "data's s.d.",
        "error": "data's s.d.",
    }
    ylabels = {title: units[title.partition(": ")[2]] for title in published}
    log = [title for title in published if not title.endswith("likelihood")]
    if published:
        figure = figures.against_horizon(
            published,
            ylabels,
            log=log,
            columns=len(titles),
            yours=yours,
            measured=prediction.HORIZONS,
        )
        yield Drawing(figure, "03_horizon", few)


def differences(found: pd.DataFrame, envs: Sequence[str], subject: str) -> Iterator[Drawing]:
    """``subject`` minus each other model, paired by seed, a figure for each environment with another model."""
    for env in envs:
        published, yours = table.pair(
            found, partial(prediction.paired_panels, subject=subject, titles=SCORES, env=env)
        )
        if published:
            lower = (
                [SCORES["energy_score_noise"]] if SCORES["energy_score_noise"] in published else []
            )
            ours, xlabels = zoo.method(subject), dict.fromkeys(published, "log-likelihood (nats)")
            xlabels |= dict.fromkeys(lower, "energy score (data's s.d.)")
            figure = figures.differences(
                published, xlabels, ours, lower_is_better=lower, yours=yours
            )
            yield Drawing(figure, f"03_differences_{EnvSpec.parse(env).name}", _whole(found, [env]))


def calibration(found: pd.DataFrame, envs: Sequence[str]) -> Drawing:
    """Observed coverage of central intervals, over all steps and after contact."""
    published, yours = table.pair(found, partial(prediction.calibration_panels, envs=envs))
    figure = figures.calibration(scoring.LEVELS.numpy(), published, yours=yours)
    return Drawing(figure, "03_calibration", _whole(found, envs))


# 04_latent -----------------------------------------------------------------------------------------------------------


def code_use(found: pd.DataFrame, envs: Sequence[str]) -> Drawing:
    """KL of the codes and spread of samples, of single segments."""
    units = {"KL per segment": "nats", "spread of samples": "data's s.d."}
    thresholds = {"KL per segment": {"Reacher": 0.1}, "spread of samples": {"Reacher": 0.01}}
    rows = table.select(found, env=envs, execution="segments", metric=("kl", "spread"))
    published, yours = table.pair(rows, partial(latent.use_panels, envs=envs))
    return Drawing(figures.code_use(published, units, thresholds, yours=yours), "04_use", rows)


# 05_control ----------------------------------------------------------------------------------------------------------


def figure6(found: pd.DataFrame, by_target: pd.DataFrame, tasks: Sequence[Task]) -> Drawing:
    """Costs and gaps of open-loop plans. by_target: rows with a ``target``."""
    published, yours = table.pair(by_target, partial(planning.return_panels, tasks=tasks))
    return Drawing(figures.figure6(published, yours), "figure6", planning.plans_of(found))


def predicted_and_executed(by_target: pd.DataFrame, tasks: Sequence[Task]) -> Drawing:
    """Returns of single targets and training seeds, of latent plans through some models. by_target: rows with a
    ``target``."""
    models = (zoo.OURS, zoo.PAPERS, "lstm", "onestep")
    rows = table.select(
        planning.plans_of(by_target), model=models, search_space="latent", planner="cem"
    )
    read = partial(
        planning.return_panels,
        tasks=tasks,
        methods=zoo.methods(models, "cem", ["latent"]),
        apart=True,
    )
    published, yours = table.pair(rows, read)
    return Drawing(figures.predicted_vs_true(published, yours), "05_predicted_and_executed", rows)


def closed_loop(found: pd.DataFrame, by_target: pd.DataFrame, task: Task) -> Drawing:
    """Final distances open loop and closed loop. by_target: rows with a ``target``."""
    published, yours = table.pair(by_target, partial(planning.distance_panels, task=task))
    figure = figures.final_distances(published, task.tolerance, yours)
    return Drawing(figure, "05_closed_loop", table.select(found, execution=planning.CLOSED))


def figure7(learned: pd.DataFrame, found: pd.DataFrame) -> Drawing:
    """Learning curves of policies. learned: their rows and those of model_free.csv; found: with those of plans."""
    curves, yours = table.pair(learned, policies.learning_curves)
    references = policies.references(planning.plans_of(table.drawn(found)))
    references = {task: levels for task, levels in references.items() if task in curves}
    figure = figures.figure7(curves, references, yours=yours)
    return Drawing(figure, "figure7", table.select(learned, execution="policy"))


# 06_robustness -------------------------------------------------------------------------------------------------------


def filtering(found: pd.DataFrame, env: str, words: Sequence[str]) -> Drawing:
    """Errors to the clean state of models and filters behind noisy sensors."""
    panels = robustness.filtering_panels(table.drawn(found), env, words)
    yours = robustness.own_errors(table.own_rows(found), env, words)
    rows = prediction.select(
        found, "rmse_clean", env=env, execution="segments", model=(*words, "filter")
    )
    return Drawing(figures.filtering_errors(*panels, yours=yours), "06_filtering", rows)


def floors(task: Task) -> dict[Method, float]:
    """Mean executed returns of random and of zero torques."""
    torques = {"random": random_torques(task), "zero": zero_torques(task)}
    return {
        zoo.method(word): float(execute(task, each).executed_return.mean())
        for word, each in torques.items()
    }


def figure8(found: pd.DataFrame, floor: Mapping[Method, float]) -> Iterator[Drawing]:
    """Learning curves of policies with noise and delay. floor: returns of random and zero torques."""
    curves, yours = table.pair(found, robustness.learning_curves)
    if curves:
        rows = table.select(found, execution="policy", metric="return_true")
        yield Drawing(figures.figure8(curves, floor, yours), "figure8", rows)


def advantage_map(
    found: pd.DataFrame,
    clean: pd.DataFrame,
    subject: str,
    rivals: Sequence[str],
    noises: Sequence[float],
    delays: Sequence[int],
) -> Iterator[Drawing]:
    """``subject`` minus each rival, by noise and delay. clean: rows of 03_predict, of the arms without either."""
    rows = robustness.advantage_rows(found, clean, (subject, *rivals), noises, delays)
    ahead = partial(
        robustness.advantage, subject=subject, rivals=rivals, noises=noises, delays=delays
    )
    maps, yours = table.pair(rows, ahead)
    if maps:
        yield Drawing(
            figures.advantage_map(maps, zoo.method(subject), unit="nats per step", yours=yours),
            "06_map",
            rows,
        )


# 10_explore ----------------------------------------------------------------------------------------------------------


def rounds(
    found: pd.DataFrame,
    env: str,
    titles: Sequence[str],
    free: pd.DataFrame | None = None,
    plans: pd.DataFrame | None = None,
) -> Iterator[Drawing]:
    """What rounds of exploration bring on an environment: numbers of ``exploration.ROUNDS``, by their titles. free:
    learning curves of policies without a model, beside; plans: rows of 05_control, of which the oracle's are."""
    task, units = exploration.TASKS[env].capitalize(), exploration.UNITS[env]
    rows = table.select(found, execution=planning.CLOSED, env=env)
    every, yours = table.pair(
        rows, partial(exploration.round_panels, titles=titles, env=env, alone=True)
    )
    curves, _ = table.pair(rows, partial(exploration.round_panels, titles=titles, env=env))
    oracle = exploration.oracle_rows(found[:0] if plans is None else plans, env)
    across = exploration.levels(every, curves, oracle, env)
    if curves:
        stem = "10_pushing" if env == exploration.PUSH else "10_rounds"
        policies = {} if free is None else exploration.policy_panels(free, titles, env)
        fell = {
            title: min(float(values.mean(0).min()) for _, values in part.values())
            for title, part in policies.items()
        }
        curves = {title: {**part, **policies.get(title, {})} for title, part in curves.items()}
        panels, own = (
            {f"{task}: {title}": part[title] for title in part} for part in (curves, yours)
        )
        ylabels = {f"{task}: {title}": units[title] for title in curves}
        ends = exploration.axis_ends(table.drawn(rows), env, fell)
        lowest = {f"{task}: {title}": low for title, low in ends.items()}
        source = table.PUBLISHED if table.PUBLISHED in set(rows["source"]) else table.YOURS
        if policies and free is not None:
            beside = table.select(
                free, env=env, planner="policy", subset="", model=exploration.MODEL_FREE
            )
            rows = pd.concat([rows, beside.assign(source=source)])
        if len(oracle):
            rows = pd.concat([rows, oracle.assign(source=source)])
        levels = {f"{task}: {title}": values for title, values in across.items()}
        yield Drawing(
            figures.rounds(panels, ylabels, yours=own, lowest=lowest, levels=levels), stem, rows
        )


def visited(
    random: Trajectories, own: Trajectories, first: ActionPrior, last: ActionPrior, n: int = 24
) -> tuple[Figure, int]:
    """States of pendulums, and episodes in each panel at most: the random episodes that a loop began with, codes of the
    prior before it and after, and the loop's own episodes."""
    seen = {
        "random episodes": random,
        "codes of the first prior": pendulum.walks(first, n),
        "codes of the last prior": pendulum.walks(last, n),
        "own plans": own,
    }
    planes = {title: pendulum.plane(data) for title, data in seen.items()}
    notes = {
        title: f"{len(data)} episodes, highest {pendulum.highest(data):.2f}"
        for title, data in seen.items()
    }
    return figures.visited(planes, ("angle (rad)", "speed (rad/s)"), notes), max(
        len(data) for data in seen.values()
    )


def places(first: Trajectories, last: Trajectories, n: int = 24) -> tuple[Figure, int]:
    """Where fingertip and object are, in how many episodes of each; and the share of all that have a contact.

    first, last: episodes that a loop of pushes began with, and those of its last round; the first ``n`` are drawn.
    """
    n, seen = min(n, len(first), len(last)), {"random": first, "own plans": last}
    touched = {title: rounds_study.of_pushes(each)["contact_share"] for title, each in seen.items()}
    notes = {
        f"object: {title}": f"contact in {touched[title]:.0%}\nof {len(each)} episodes"
        for title, each in seen.items()
    }
    drawn = {title: each.take(slice(n)) for title, each in seen.items()}
    return figures.visited(rounds_study.places(drawn), ("x (m)", "y (m)"), notes, equal=True), n


def shares_left(found: pd.DataFrame, episodes: int = 20) -> Iterator[Drawing]:
    """What adapting leaves of the zero-shot energy score, arm by arm."""
    rows = _of_several_arms(
        table.select(table.drawn(found), execution=planning.OPEN, planner="none")
    )
    if shares := adaptation.shares_left(rows, episodes):
        what = f"energy score after {episodes} episodes / before"
        yield Drawing(figures.arms(shares, what, ratio=True), "10_arms", rows)


def gains(found: pd.DataFrame, episodes: int = 20) -> Iterator[Drawing]:
    """What adapting brings to plans, arm by arm."""
    own = table.select(
        table.drawn(found), execution=planning.OPEN, planner="cem", configuration=[*adaptation.WAYS]
    )
    rows = _of_several_arms(own)
    if gained := adaptation.gains(rows, episodes):
        what = f"executed return after {episodes} episodes\nminus before (m)"
        yield Drawing(figures.arms(gained, what, ratio=False), "10_plans", rows)


def _of_several_arms(rows: pd.DataFrame) -> pd.DataFrame:
    """Those of models that have rows of several arms."""
    return table.select(
        rows, model=[word for word, own in table.groups(rows, "model") if own["env"].nunique() > 1]
    )


def ways(found: pd.DataFrame, env: str, steps_ahead: int = 80) -> Iterator[Drawing]:
    """Energy scores of models that were adapted to a changed arm, way by way."""
    rows = table.select(found, execution=planning.OPEN, planner="none", env=env)
    curves, yours = table.pair(rows, partial(adaptation.way_curves, steps_ahead=steps_ahead))
    if curves:
        ylabel, arm = (
            f"energy score, {steps_ahead} steps (data's s.d.)",
            EnvSpec.parse(env).physics.label,
        )
        yield Drawing(
            figures.adapted(curves, ylabel, yours=yours, robot=f"the arm, {arm}"), "10_ways", rows
        )
