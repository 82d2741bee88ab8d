"""What a candidate of the planner is judged by: the mode of a model, or samples of it, and how many.

    mode              one rollout with z = 0: the default of ``model_predictor``, and all that a deterministic model has
    mean of S         mean return over S samples, the same noise for every candidate and iteration
    fresh mean of S   the same, with other noise in every iteration; the plan with the best return by its own noise wins
    median of S       median return over S samples, the same noise for every candidate and iteration
    mode and mean of S    half the mode's return, half the mean's
    screened mean of S    mean return over the mode and S samples (``expected_predictor``), of the quarter of the
                          candidates whose modes return most: the study's, with S = 8, for models with codes

All with the cross-entropy method over the codes of the action prior, on validation targets, executed open loop; and
with --closed planning again every 10 steps too, from what is left of the plan before. Models are those of the run
(``study.load_or_train``), so a missing one is trained first. gap is the return that the planner's judge (gap_judge) or
32 fresh samples (gap_fresh) predict for the plan, minus the executed one; of a closed loop, for the first plan.
``costs`` are those of the single targets, for paired differences: of more_than_mode and its standard error too.
Among --models, ``oracle`` is the true simulator in the model's place and ``zero`` no torque at all, both open loop.

    python benchmarks/settings/judge.py --models rtsm lstm --targets 100 --seeds 0 1 2 --closed
    python benchmarks/settings/judge.py --models rtsm --envs tsm/ReacherPush-noise0.25-v1 --judges mode "mean of 6"
    python benchmarks/settings/judge.py --table --targets 100

A line that the table has already is not measured again. --table prints the open-loop lines of as many targets, means
over training seeds with half the 95 % t interval; the cost minus the mode's is paired by target. A second table has
what models judged as in the study cost minus what others cost by their modes, with the interval over targets.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from tsmlib import study
from tsmlib.envs.spec import EnvSpec
from tsmlib.models.base import DynamicsModel, Model
from tsmlib.planning.base import Judge, Plan, Predictor, SearchSpace
from tsmlib.planning.execution import Trial, execute, mpc
from tsmlib.planning.planners import cem, reevaluate
from tsmlib.planning.predictors import (
    JUDGING,
    expected_predictor,
    fresh_predictor,
    model_predictor,
    simulator_predictor,
)
from tsmlib.planning.search_spaces import LatentActions
from tsmlib.planning.tasks import Task, zero_torques
from tsmlib.rewards import Reward
from tsmlib.study import plans, runs, zoo
from tsmlib.study.data import require_other_seed
from tsmlib.study.models import load_prior
from tsmlib.study.results import table
from tsmlib.trajectory import Segment

HERE, EVERY = Path(__file__).resolve().parent, 10
JUDGES = (
    "mode", "mean of 2", "fresh mean of 2", "mode and mean of 2", "mean of 6", "fresh mean of 6", "median of 6",
    "mean of 16", "median of 16", "screened mean of 4", "screened mean of 8", "screened mean of 16",
)  # fmt: skip
REFERENCES = ("zero", "oracle")
MODELS = (*zoo.words("dynamics", "ablation", "choice"), *REFERENCES)
STUDY = f"screened mean of {JUDGING}"  # the study's judge of models with codes
KEY = ("env", "model", "model_seed", "judge", "closed", "planner_seed", "targets", "candidates", "iterations", "again")
COLUMNS = (
    *KEY, "cpu_seconds", "cost", "cost_sem", "more_than_mode", "more_than_mode_sem", "within_5cm", "final_mean",
    "gap_judge", "gap_fresh", "gap_fresh_abs", "costs",
)  # fmt: skip
Row = dict[str, str]


def judged_by(words: str, candidates: int) -> Judge:
    """A judge by its name."""
    n = 0 if words == "mode" else int(words.split()[-1])
    common: Judge = partial(model_predictor, samples=n)
    if words.startswith("screened"):
        return partial(expected_predictor, samples=n)
    if words.startswith("fresh"):
        return partial(Fresh, samples=n, population=candidates + 1)
    if not words.startswith("mode and"):
        return common

    def blend(model: Model, past: Segment, *, seed: int) -> Predictor:
        mode, samples = model_predictor(model, past), common(model, past, seed=seed)
        return lambda actions: torch.cat([mode(actions).expand(n, -1, -1, -1, -1), samples(actions)])

    return blend


class Fresh:
    """Samples with other noise for every population, which is asked for in parts: the candidates and their mean."""

    def __init__(self, model: Model, past: Segment, *, seed: int, samples: int, population: int) -> None:
        self.through: Callable[..., Predictor] = partial(model_predictor, model, past, samples=samples)
        self.seed, self.population, self.asked = seed, population, -1  # the first call asks for the start

    def __call__(self, actions: Tensor) -> Tensor:
        index = self.asked // self.population
        self.asked += len(actions)
        return self.through(seed=1_000_003 * (self.seed + 1) + index)(actions)


def by_median(reward: Reward) -> Reward:
    """A reward whose sum, averaged over the samples, is the median return; for planners that take means."""

    def judged(states: Tensor, actions: Tensor) -> Tensor:
        per_step = reward(states, actions)
        middle = per_step.sum(-1).quantile(0.5, dim=0)  # (C, B)
        return (middle / per_step.shape[-1])[None, ..., None].expand_as(per_step)

    return judged


@dataclass(frozen=True)
class Way:
    """A judge, and the planner that asks it. again: iterations of each later plan of a closed loop."""

    judge: str
    seed: int
    candidates: int
    iterations: int
    again: int

    def named(self, task: Task, *, closed: bool) -> Row:
        """Its columns of the key."""
        values = (self.judge, int(closed), self.seed, len(task), self.candidates, self.iterations, self.again)
        return dict(zip(KEY[3:], map(str, values), strict=True))

    def search(
        self, predict: Predictor, reward: Reward, space: SearchSpace, start: Tensor | int, /, *, iterations: int
    ) -> Plan:
        """A ``Planner``."""
        judged = by_median(reward) if "median" in self.judge else reward
        elites = max(2, self.candidates // 10)
        return cem(
            predict, judged, space, start, candidates=self.candidates, elites=elites, iterations=iterations,
            screened=plans.SCREENED if self.judge.startswith("screened") else 1.0, seed=self.seed,
        )  # fmt: skip

    def opened(self, task: Task, model: DynamicsModel, space: SearchSpace) -> Plan:
        """The plan of the whole episode, with the return that its judge predicts."""
        predict = judged_by(self.judge, self.candidates)(model, task.past(model.past_len), seed=self.seed)
        return self.search(predict, task.reward, space, len(task), iterations=self.iterations)

    def closed(self, task: Task, model: DynamicsModel, space: SearchSpace, first: Plan) -> Trial:
        """Planning again every ten steps, from ``first`` on."""
        planner, judge = partial(self.search, iterations=self.again), judged_by(self.judge, self.candidates)
        return mpc(task, model, space, planner, every=EVERY, plan=first, judge=judge, seed=self.seed)


def measured(task: Task, model: DynamicsModel, space: SearchSpace, way: Way, *, closed: bool) -> list[Row]:
    """The lines of one judge: open loop, and closed loop where it is asked for."""
    began = time.process_time()
    plan = way.opened(task, model, space)
    seconds = [time.process_time() - began]
    fresh = reevaluate(plan, fresh_predictor(model, task.past(model.past_len), seed=way.seed + 77), task.reward)
    trials = [execute(task, fresh)]
    if closed:
        began = time.process_time()
        trials.append(way.closed(task, model, space, plan))
        seconds.append(seconds[0] + time.process_time() - began)
    rows = []
    for number, (trial, spent) in enumerate(zip(trials, seconds, strict=True)):
        cost, gap = -trial.executed_return, fresh.predicted_return - trial.executed_return
        found = {
            "cpu_seconds": spent, "cost": cost.mean(), "cost_sem": cost.std() / len(task) ** 0.5,
            "within_5cm": (trial.final_distance < 0.05).float().mean(), "final_mean": trial.final_distance.mean(),
            "gap_judge": (plan.predicted_return - trial.executed_return).mean(), "gap_fresh": gap.mean(),
            "gap_fresh_abs": gap.abs().mean(),
        }  # fmt: skip
        row = way.named(task, closed=bool(number))
        row |= {word: f"{float(value):.4g}" for word, value in found.items()}
        rows.append(row | {"costs": " ".join(f"{value:.3f}" for value in cost.tolist())})
    return rows


def reference(word: str, task: Task, space: SearchSpace, way: Way) -> list[Row]:
    """The line of zero torque or of the oracle."""
    began = time.process_time()
    if word == "zero":
        trial = execute(task, zero_torques(task))
    else:
        simulator = simulator_predictor(task.env, task.start)
        trial = execute(task, way.search(simulator, task.reward, space, len(task), iterations=way.iterations))
    cost = -trial.executed_return
    found = {
        "cpu_seconds": time.process_time() - began, "cost": cost.mean(), "cost_sem": cost.std() / len(task) ** 0.5,
        "within_5cm": (trial.final_distance < 0.05).float().mean(), "final_mean": trial.final_distance.mean(),
    }  # fmt: skip
    row = way.named(task, closed=False) | {name: f"{float(value):.4g}" for name, value in found.items()}
    return [row | {"costs": " ".join(f"{value:.3f}" for value in cost.tolist())}]


def with_differences(rows: list[Row]) -> list[Row]:
    """The table with each line's cost over that of the mode, open loop, paired by target."""
    plain = {_rest(row): row for row in rows if row["judge"] == "mode" and row["closed"] == "0"}
    for row in rows:
        if (other := plain.get(_rest(row))) is not None and other is not row:
            more = np.subtract(*(np.array(each["costs"].split(), float) for each in (row, other)))
            error = more.std(ddof=1) / len(more) ** 0.5 if len(more) > 1 else float("nan")
            row |= {"more_than_mode": f"{more.mean():.3g}", "more_than_mode_sem": f"{error:.2g}"}
    return rows


def _rest(row: Row) -> tuple[str, ...]:
    return tuple(row[word] for word in KEY if word not in ("judge", "closed"))


def opened(rows: list[Row], targets: int) -> pd.DataFrame:
    """Open-loop lines for as many targets; ValueError without any."""
    wanted = [row for row in rows if row["closed"] == "0" and row["targets"] == str(targets)]
    if not wanted:
        there = sorted({int(row["targets"]) for row in rows})
        raise ValueError(f"no open-loop lines of {targets} targets; there are lines of {', '.join(map(str, there))}")
    return pd.DataFrame(wanted)


def against(rows: list[Row], targets: int) -> pd.DataFrame:
    """What models judged by ``STUDY`` cost minus what others cost that are judged by their modes, paired by target.

    Means over training seeds that both have, with half the 95 % t interval over targets.
    """
    costs = {
        (line.env, line.planner_seed, line.model, line.judge, line.candidates, line.model_seed):
            np.array(str(line.costs).split(), float)
        for line in opened(rows, targets).itertuples()
    }  # fmt: skip
    kinds, found = dict.fromkeys(key[:-1] for key in costs), []
    for ours, theirs in product(kinds, kinds):
        if ours[:2] == theirs[:2] and ours[3] == STUDY and theirs[3] == "mode":
            seeds = [key[-1] for key in costs if key[:-1] == ours and (*theirs, key[-1]) in costs]
            apart = [costs[*ours, seed] - costs[*theirs, seed] for seed in seeds]
            if apart:
                found.append({
                    "model": ours[2], "minus": theirs[2], "its candidates": theirs[4], "seeds": len(seeds),
                    "cost (m)": table.spell(np.mean(apart, axis=0), "{:+.2f} ± {:.2f}"),
                    "in each seed": ", ".join(f"{each.mean():+.2f}" for each in apart),
                })  # fmt: skip
    return pd.DataFrame(found)


def summary(rows: list[Row], targets: int) -> pd.DataFrame:
    """Open-loop lines of models for as many targets, over their training seeds, as texts."""
    lines, numbers = opened(rows, targets), list(COLUMNS[len(KEY) : -1])
    lines[numbers] = lines[numbers].replace("", "nan").astype(float)
    key = ["env", "model", "judge", "candidates", "iterations"]
    means = lines[~lines["model"].isin(REFERENCES)].groupby([*key, "model_seed"], sort=False)[numbers].mean()
    return pd.DataFrame([
        dict(zip(key, what, strict=True)) | {
            "seeds": len(own), "cost (m)": table.spell(own["cost"]),
            "minus the mode's": "" if "mode" in what else table.spell(own["more_than_mode"], "{:+.2f} ± {:.2f}"),
            "within 5 cm (%)": table.spell(100 * own["within_5cm"], "{:.0f} ± {:.0f}"),
            "size of the gap (m)": table.spell(own["gap_fresh_abs"], "{:.2f} ± {:.2f}"),
            "CPU s": f"{own['cpu_seconds'].mean():.0f}",
        }
        for what, own in means.groupby(key, sort=False)
    ])  # fmt: skip


def read(path: Path) -> list[Row]:
    """The table in ``path``, or an empty one. ValueError for one of other columns."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    if rows and (missing := set(COLUMNS) - set(rows[0])):
        raise ValueError(f"{path} has no columns {', '.join(sorted(missing))}; name another table with --out")
    return rows


def write(path: Path, rows: list[Row]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", default=["rtsm"], choices=MODELS, metavar="MODEL",
                        help=f"some of {' '.join(MODELS)} (default rtsm)")  # fmt: skip
    parser.add_argument("--envs", nargs="+", default=["tsm/ReacherPush-v1"], help="default tsm/ReacherPush-v1")
    parser.add_argument("--judges", nargs="+", choices=JUDGES, default=JUDGES, metavar="JUDGE", help="default all")
    parser.add_argument("--targets", type=int, default=25, help="of the 100 of validation (default 25)")
    parser.add_argument("--candidates", type=int, default=96)
    parser.add_argument("--iterations", type=int, default=10, help="of an open-loop plan (default 10)")
    parser.add_argument("--again", type=int, default=plans.AGAIN["cem"]["paper"], help="of each later plan (default 4)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="of the planner (default 0)")
    parser.add_argument("--closed", action="store_true", help="plan again every 10 steps too")
    parser.add_argument("--scale", default="", help="of the models; default TSM_SCALE, else laptop")
    parser.add_argument("--model-seed", type=int, default=0, help="of the models (default 0)")
    parser.add_argument("--table", action="store_true", help="print the table")
    parser.add_argument("--out", type=Path, default=HERE / "judge.csv", help="default judge.csv beside this script")
    arguments = parser.parse_args()
    if arguments.table:
        try:
            rows = read(arguments.out)
            print(table.markdown(summary(rows, arguments.targets)))
            print(table.markdown(against(rows, arguments.targets)))
        except ValueError as error:
            parser.error(str(error))
        return
    torch.set_num_threads(1)
    try:
        require_other_seed(arguments.model_seed)
        run = runs.resolve("05_control", scale=arguments.scale, seed=arguments.model_seed)
        for env in arguments.envs:
            EnvSpec.parse(env)
    except ValueError as error:  # ParameterError is one
        parser.error(str(error))
    for env in arguments.envs:
        task = study.load_task(env, "validation").take(arguments.targets)
        space = LatentActions(load_prior(run, env), task.horizon)
        for word in arguments.models:
            model = None if word in REFERENCES else study.load_or_train(run, env, word).model.eval()
            for seed in arguments.seeds if word != "zero" else (0,):
                for judge in ("",) if model is None else arguments.judges if model.stochastic else ("mode",):
                    way = Way(judge, seed, arguments.candidates, arguments.iterations, arguments.again)
                    known, common = read(arguments.out), {"env": env, "model": word, "model_seed": str(run.seed)}
                    wanted = common | way.named(task, closed=arguments.closed and model is not None)
                    if any(all(row[key] == value for key, value in wanted.items()) for row in known):
                        continue
                    if model is None:
                        found = reference(word, task, space, way)
                    else:
                        found = measured(task, model, space, way, closed=arguments.closed)
                    new = [common | row for row in found]
                    keys = [tuple(row[key] for key in KEY) for row in new]
                    kept = [row for row in known if tuple(row[key] for key in KEY) not in keys]
                    write(arguments.out, with_differences([*kept, *new]))
                    for row in new:
                        print({key: value for key, value in row.items() if key != "costs"}, flush=True)


if __name__ == "__main__":
    main()
