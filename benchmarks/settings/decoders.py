"""Planning through models from files: do errors that a plan exploits average out over several networks, how well must
each be trained for that, what does more training buy a baseline, and must all judge every candidate?

    python benchmarks/settings/decoders.py --name "three, full budget" --files a.safetensors b.safetensors c.safetensors
    python benchmarks/settings/decoders.py --compare "three, full budget"
    python benchmarks/settings/decoders.py --alone

The cross-entropy method over codes of the prior, 96 x 10, on validation targets (or by --split test on the frozen ones,
by which nothing is chosen), executed open loop; a candidate is judged by its mean return over the modes of all files'
models, or only the share --screened that the first likes best. A line in decoders.csv per call: cost with its standard
error, share within 5 cm, what the judge predicted beyond the executed return, and the costs of the single targets.
--compare prints the table: the cost of that line minus those of the others, paired by target, with half the 95 % t
interval over targets. --alone prints another, of lines whose files are trainings of one model that differ in the seed:
their cost minus the mean cost of the same trainings one by one, which ``quality.py measure`` planned with, paired by
target. ``budgets.py`` trains such files.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from quality import KEY, described, load

from tsmlib import study
from tsmlib.models.mixture import Mixture
from tsmlib.planning.execution import execute
from tsmlib.planning.planners import cem
from tsmlib.planning.predictors import model_predictor
from tsmlib.planning.search_spaces import LatentActions
from tsmlib.study import runs
from tsmlib.study.models import load_prior
from tsmlib.study.results import table

HERE = Path(__file__).resolve().parent
TRAININGS = ("models", "seeds", "seconds", "muons")  # columns: of each file in turn


def planned(name: str, files: list[Path], env: str, n_targets: int, screened: float, split: str) -> dict[str, object]:
    """A line of the table."""
    about, task = [described(path) for path in files], study.load_task(env, split).take(n_targets)
    trainings = {
        words: " ".join(str(training[word]) for training in about)
        for words, word in zip(TRAININGS, KEY[1:], strict=True)
    }
    prior = load_prior(runs.resolve("05_control", scale="laptop"), env)
    model = Mixture(map(load, files))
    judge = model_predictor(model, task.past(model.past_len))
    began = time.process_time()
    space = LatentActions(prior, task.horizon)
    options = dict(candidates=96, elites=9, iterations=10, screened=screened, seed=0)
    plan = cem(judge, task.reward, space, len(task), **options)
    trial = execute(task, plan)
    cost = -trial.executed_return
    return trainings | {
        "name": name, "env": env, "split": split, "screened": screened, "decoders": len(plan.states),
        "targets": len(task),
        "cpu_seconds": f"{time.process_time() - began:.0f}", "cost": f"{cost.mean():.4g}",
        "cost_sem": f"{cost.std() / len(task) ** 0.5:.3g}",
        "within_5cm": f"{(trial.final_distance < task.tolerance).float().mean():.3g}",
        "gap_judge": f"{(plan.predicted_return - trial.executed_return).mean():.3g}",
        "costs": " ".join(f"{value:.3f}" for value in cost.tolist()),
    }  # fmt: skip


def compared(lines: pd.DataFrame, name: str) -> pd.DataFrame:
    """The lines of as many targets as line ``name`` has, the cheapest first, with the paired difference to it."""
    costs = {other: np.array(texts.split(), float) for other, texts in zip(lines["name"], lines["costs"], strict=True)}
    of = {line.name: (line.env, line.split, len(costs[line.name])) for line in lines.itertuples(index=False)}
    same = lines[[of[other] == of[name] for other in lines["name"]]]
    same = same.sort_values("cost", key=lambda texts: texts.astype(float))
    minus = [
        "" if other == name else table.spell(costs[name] - costs[other], "{:+.2f} ± {:.2f}") for other in same["name"]
    ]
    return pd.DataFrame({
        "judged by": same["name"], "cost": same["cost"] + " ± " + same["cost_sem"],
        "within 5 cm": [f"{float(share):.0%}" for share in same["within_5cm"]],
        "predicted beyond executed": same["gap_judge"], f"cost of {name} minus this": minus,
    })  # fmt: skip


def alone(lines: pd.DataFrame, singles: pd.DataFrame) -> pd.DataFrame:
    """Several trainings of one model that judge together, against the same trainings one by one.

    lines: of this table. singles: of ``quality.csv``, without weight decay; of as many targets.
    """
    single, found = singles[singles["decay"] == 0].set_index(KEY), []
    for line in lines[lines["split"] == "validation"].dropna(subset=["models"]).itertuples():
        words = (getattr(line, each).split() for each in TRAININGS)
        trainings = [
            (line.env, model, int(seed), int(seconds), float(muon))
            for model, seed, seconds, muon in zip(*words, strict=True)
        ]
        costs, kinds = np.array(line.costs.split(), float), {(model, *how) for _, model, _, *how in trainings}
        if len(kinds) > 1 or len(set(trainings)) < 2 or int(line.decoders) != len(set(trainings)):
            continue
        if missing := [each for each in trainings if each not in single.index]:
            raise ValueError(f"quality.csv has no line of {missing[0]}; run: quality.py measure FILE, of that training")
        own = single.loc[trainings]
        each = np.array([texts.split() for texts in own["costs"]], float)
        if each.shape != (len(trainings), len(costs)):
            continue  # of other targets
        found.append({
            "model": trainings[0][1], "seconds": trainings[0][3], "networks": len(own),
            "one by one": f"{each.mean():.2f}", "together": f"{costs.mean():.2f}",
            "difference": table.spell(costs - each.mean(axis=0), "{:+.2f} ± {:.2f}"),
            "within 5 cm, one by one": f"{own['within'].mean():.0%}",
            "within 5 cm, together": f"{float(line.within_5cm):.0%}", "predicted beyond executed": line.gap_judge,
        })  # fmt: skip
    return pd.DataFrame(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--name", help="of the line that is added")
    what.add_argument("--compare", metavar="NAME", help="print the table, every line against this one")
    what.add_argument("--alone", action="store_true", help="print the table of trainings together and one by one")
    parser.add_argument(
        "--files", nargs="+", type=Path, default=[], help="files of trained models, which judge together"
    )
    parser.add_argument("--screened", type=float, default=1.0, help="share that all judge (default 1: all candidates)")
    parser.add_argument("--env", default="tsm/ReacherPush-v1")
    parser.add_argument("--split", default="validation", choices=("validation", "test"), help="default validation")
    parser.add_argument("--targets", type=int, default=50, help="of the 100 of the split (default 50)")
    parser.add_argument(
        "--out", type=Path, default=HERE / "decoders.csv", help="default decoders.csv beside this script"
    )
    given = parser.parse_args()
    torch.set_num_threads(1)
    lines = pd.read_csv(given.out, dtype=str) if given.out.exists() else pd.DataFrame({"name": []})
    if given.compare:
        if given.compare not in set(lines["name"]):
            parser.error(f"{given.out} has no line {given.compare!r}; it has: {', '.join(lines['name'])}")
        print(table.markdown(compared(lines, given.compare)))
        return
    if given.alone:
        if not len(lines) or not len(found := alone(lines, pd.read_csv(HERE / "quality.csv"))):
            parser.error(f"{given.out} has no line of several trainings of one model; add one by --name and --files")
        print(table.markdown(found))
        return
    if not given.files:
        parser.error("--name wants --files: the models that a candidate is judged by")
    line = planned(given.name, given.files, given.env, given.targets, given.screened, given.split)
    pd.concat([lines, pd.DataFrame([line])]).to_csv(given.out, index=False)
    print({name: value for name, value in line.items() if name != "costs"})


if __name__ == "__main__":
    main()
