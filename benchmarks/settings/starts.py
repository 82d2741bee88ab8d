"""Causes of sharp planned torques: the start of the search, and the weight of torque (section 5.3.5, figure 10).

The paper shows sharp, discontinuous plans over raw torques and says neither where its optimisation started nor how
much torque costs. This script plans for reaching with Adam, as the paper does, over torques from zero and from white
noise of two sizes, and over the codes of the action prior from N(0, I), with the torque penalty and without.

    python benchmarks/settings/starts.py
"""

from __future__ import annotations

import argparse
from itertools import product
from pathlib import Path

import torch

from tsmlib import rewards, study
from tsmlib.envs.spec import EnvSpec
from tsmlib.planning.base import SearchSpace
from tsmlib.planning.execution import execute
from tsmlib.planning.planners import adam, reevaluate
from tsmlib.planning.predictors import model_predictor
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.storage import tables
from tsmlib.study import parameters, runs, zoo
from tsmlib.study.results import action_prior as action_prior_results

ENV = "tsm/Reacher-v0"
STARTS = {"direct": (0.0, 0.1, 0.5), "latent": (1.0,)}  # standard deviation of the noise that parameters start from


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", choices=zoo.words("dynamics"), default="tsm")
    parser.add_argument("--targets", type=int, default=10, help="of the validation task (default 10)")
    parser.add_argument("--weights", type=float, nargs="+", default=[0.0, 1.0], help="of the squared torque")
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--scale", choices=parameters.SCALES, default="paper")
    parser.add_argument("--out", type=Path, help="table to write (default: metrics/07_starts.csv of the run)")
    arguments = parser.parse_args()
    run = runs.resolve("07_action_prior", scale=arguments.scale)
    path = arguments.out or run.metrics / "07_starts.csv"
    posed = study.load_task(ENV, "validation").take(arguments.targets)
    model, prior = (study.load_or_train(run, ENV, word)[0] for word in (arguments.model, "prior"))
    held_out, train = (torch.from_numpy(study.dataset(run, ENV, split).actions) for split in ("test", "train"))
    spaces: dict[str, SearchSpace] = {
        "direct": DirectActions(posed.horizon), "latent": LatentActions(prior, posed.horizon)
    }  # fmt: skip
    rows = []
    for word, weight in product(spaces, arguments.weights):
        task = posed.with_reward(posed.name, rewards.reach(posed.target, torque_weight=weight))
        past, space = task.past(model.past_len), spaces[word]
        predict, judge = (
            model_predictor(model, past, samples=s if model.stochastic else 0, seed=run.seed + i)
            for i, s in enumerate((2, 32))
        )
        for start in STARTS[word]:
            noise = torch.randn(1, len(task), *space.shape, generator=torch.Generator().manual_seed(run.seed))
            plan = adam(predict, task.reward, space, start * noise, iterations=arguments.iterations,
                        progress=f"weight {weight:g}, {word} from {start:g}")  # fmt: skip
            trial = execute(task, reevaluate(plan, judge, task.reward))
            common = dict(
                env=ENV, sim=EnvSpec.parse(ENV).simulator,
                task=task.name, model=arguments.model, planner="adam", search_space=word,
                horizon=task.horizon, execution="open loop", seed=run.seed, scale=run.scale, start=start,
                torque_weight=weight,
            )  # fmt: skip
            rows += action_prior_results.rows(trial.actions, held_out, train[:500], **common)
            for metric, values in (("return_true", trial.executed_return), ("exploitation_gap", trial.gap),
                                   ("final_distance", trial.final_distance)):  # fmt: skip
                value = float(values.mean())
                rows.append(dict(common, metric=metric, value=value, unit="m", n=len(task)))
            tables.save(path, rows, extra=["start", "torque_weight"])
            print(f"weight {weight:g}, {word} from {start:g}: mean change "
                  f"{next(r['value'] for r in rows[::-1] if r['metric'] == 'change'):.4f}", flush=True)  # fmt: skip
    print(path)


if __name__ == "__main__":
    main()
