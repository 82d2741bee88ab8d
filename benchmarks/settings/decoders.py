"""Planning through the modes of several recurrent decoders, each from a file of its own: do errors that a plan exploits
average out, and how well must each decoder be trained for that?

    python benchmarks/settings/decoders.py --name "three, full budget" --files a.safetensors b.safetensors c.safetensors

The cross-entropy method over codes of the prior, 96 x 10, on validation targets, executed open loop; a candidate is
judged by its mean return over the decoders' modes. A line in decoders.csv per call: validation loss of each decoder,
cost with its standard error, share within 5 cm, what the judge promised beyond the executed return, and the costs of
the single targets, for paired differences.
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path

import torch
from torch import Tensor

from tsmlib import study
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.planning.execution import execute
from tsmlib.planning.planners import cem
from tsmlib.planning.predictors import model_predictor
from tsmlib.planning.search_spaces import LatentActions
from tsmlib.storage import artifacts
from tsmlib.study import runs
from tsmlib.study.models import load_prior

HERE = Path(__file__).resolve().parent
COLUMNS = ("name", "decoders", "targets", "cpu_seconds", "cost", "cost_sem", "within_5cm", "gap_judge", "costs")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--name", required=True, help="of the line")
    parser.add_argument("--files", nargs="+", type=Path, required=True, help="models, each with one decoder or several")
    parser.add_argument("--env", default="tsm/ReacherPush-v1")
    parser.add_argument("--targets", type=int, default=50, help="of the 100 of validation (default 50)")
    parser.add_argument(
        "--out", type=Path, default=HERE / "decoders.csv", help="default decoders.csv beside this script"
    )
    given = parser.parse_args()
    torch.set_num_threads(1)
    task = study.task(given.env, "validation").take(given.targets)
    prior = load_prior(runs.resolve("05_control", scale="laptop"), given.env)
    through = [
        model_predictor(model, task.past(model.past_len))
        for model in (artifacts.load_model(path, RecurrentTSM) for path in given.files)
    ]

    def modes(actions: Tensor) -> Tensor:
        return torch.cat([predict(actions) for predict in through])

    began = time.process_time()
    space = LatentActions(prior, task.horizon)
    plan = cem(modes, task.reward, space, len(task), candidates=96, elites=9, iterations=10, seed=0)
    trial = execute(task, plan)
    cost = -trial.executed_return
    row = {
        "name": given.name, "decoders": str(len(plan.states)), "targets": str(len(task)),
        "cpu_seconds": f"{time.process_time() - began:.0f}", "cost": f"{cost.mean():.4g}",
        "cost_sem": f"{cost.std() / len(task) ** 0.5:.3g}",
        "within_5cm": f"{(trial.final_distance < task.tolerance).float().mean():.3g}",
        "gap_judge": f"{(plan.predicted_return - trial.executed_return).mean():.3g}",
        "costs": " ".join(f"{value:.3f}" for value in cost.tolist()),
    }  # fmt: skip
    new = not given.out.exists()
    with given.out.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerow(row)
    print({name: value for name, value in row.items() if name != "costs"})


if __name__ == "__main__":
    main()
