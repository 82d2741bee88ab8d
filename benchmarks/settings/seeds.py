"""Models of several training seeds, trained as one: for a GPU; and policies, for any processor.

    python benchmarks/settings/seeds.py --scale paper --seeds 3 4 5 6 7 8 9 --device cuda --compiled

What is missing of the seeds' data is collected first, by as many processes as there are cores. Then each model is
trained with all seeds at once (``tsmlib.stacked_training``), --together models side by side in processes of their own,
in the order in which they are named; the prior is one of them. Models that are there are trained again and replaced:
name the seeds that are missing. Files are those that ``python -m tsmlib run train`` makes of each seed, in
runs/paper/seed<k>/models, and say in their headers that they were trained as copies, and on what. --compiled is worth
its minute or more where a training takes longer than that.

    python benchmarks/settings/seeds.py --scale paper --seeds 0 1 2 3 4 5 6 7 8 9 --table

writes into ``seeds.csv`` beside this script: validation loss and seconds of the models that these seeds have, as their
headers say, in place of lines of the same environment, model, seed and processor.

    python benchmarks/settings/seeds.py --scale paper --seeds 3 4 --envs tsm/ReacherPush-v1 --models tsm rtsm lstm \
        --policies 880 --together 2

learns policies in those models for so many iterations, three copies of each seed and all seeds as one
(``tsmlib.policies.stacked``): direct ones, and where a model has codes also latent ones. The models have to be there.
Policies that are there stay, whatever their iterations; those that were stopped go on. ``rows.py policies`` finds them.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from itertools import product
from pathlib import Path
from typing import cast

import pandas as pd
import torch

from tsmlib import study
from tsmlib.envs.spec import EnvSpec
from tsmlib.figures.method import Method
from tsmlib.storage import artifacts
from tsmlib.study import models, parallel, policies, runs, zoo
from tsmlib.study.data import dataset, require_other_seed

SEEDS = Path(__file__).with_name("seeds.csv")
ENVS = ("tsm/ReacherPush-v1", "tsm/ReacherObstacle-v0", "tsm/Reacher-v0")
MODELS = ("rtsm", "tsm", "lstm", "multistep", "onestep", "prior")
SPLITS = ("train", "validation")
TARGETS, COPIES = 100, 3  # of policies, as in rows.py


def collect(run: runs.Run, env: str) -> None:
    """Training and validation data of a run, where they are missing."""
    torch.set_num_threads(1)
    for split in SPLITS:
        dataset(run, env, split)


def train(of: list[runs.Run], env: str, word: str, compiled: bool) -> str:
    """One model of all seeds, trained and stored; a line on it."""
    torch.set_num_threads(1)
    found = models.train_as_one(of, env, word, compiled=compiled)
    best = [min(list(made.header["curves"].values())[-1]["validation"]) for made in found]
    return f"{env} {word}: {found[0].header['seconds']:.0f} s, {' '.join(f'{value:.4g}' for value in best)}"


def learn(of: list[runs.Run], env: str, method: Method, iterations: int) -> str:
    """One policy of all seeds, learned and stored; a line on it."""
    torch.set_num_threads(1)
    task, budget = study.load_task(env).take(TARGETS), policies.Budget(COPIES, iterations)
    of = [run for run in of if policies.stored_budget(run, env, method) is None]
    if not of:
        return f"{env} {method.label}: there"
    found = policies.learn_as_one(of, task, method, budget)
    ends = [sum(one.header["curve"]["measured"]["return_true"][-1]) / COPIES for one in found]
    return f"{env} {method.label}: {found[0].header['seconds']:.0f} s, {' '.join(f'{end:.3f}' for end in ends)}"


def table(of: list[runs.Run], envs: Sequence[str], words: Sequence[str]) -> pd.DataFrame:
    """A line for each model that there is; seconds of one on a CPU by its time, of copies by the clock, all together.

    validation: the least loss of the last stage.
    """
    lines = []
    for env, word, run in product(envs, words, of):
        path = run.dir / "models" / EnvSpec.parse(env).name / f"{word}.safetensors"
        if models.trained_on(env, word) != env or not path.exists():
            continue
        header = cast(models.Header, artifacts.read_header(path))
        best = min(list(header["curves"].values())[-1]["validation"])
        made_on = header.get("processor", header.get("device", "cpu"))
        lines.append({
            "env": env, "model": word, "seed": run.seed, "processor": made_on,
            "copies": header.get("copies", 1), "seconds": round(header["seconds"]), "validation": f"{best:.4g}",
        })  # fmt: skip
    return pd.DataFrame(lines)


def merged(stored: pd.DataFrame, new: pd.DataFrame) -> pd.DataFrame:
    """Stored lines in their order, replaced where a new one has the same environment, model, seed and processor; then
    the other new ones."""
    about = ["env", "model", "seed", "processor"]
    lines = pd.concat([stored, new]).set_index(about)
    last = lines[~lines.index.duplicated(keep="last")]
    return last.loc[lines.index.unique()].reset_index()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--envs", nargs="+", default=ENVS, help=f"default {' '.join(ENVS)}")
    parser.add_argument("--models", nargs="+", default=MODELS, choices=zoo.words(), metavar="MODEL",
                        help=f"some of {' '.join(zoo.words())}; default {' '.join(MODELS)}")  # fmt: skip
    parser.add_argument("--policies", type=int, default=0, metavar="N", help="learn policies in them, N iterations")
    parser.add_argument("--together", type=int, default=5, help="models side by side (default 5)")
    parser.add_argument("--compiled", action="store_true", help="losses and gradients by torch.compile")
    parser.add_argument("--table", action="store_true", help="write into seeds.csv, and train nothing")
    parser.add_argument("--scale", default="", help="default TSM_SCALE, else laptop")
    parser.add_argument("--device", default="", help="default TSM_DEVICE, else cpu")
    given = parser.parse_args()
    if doubled := sorted({seed for seed in given.seeds if given.seeds.count(seed) > 1}):
        parser.error(f"--seeds names {', '.join(map(str, doubled))} more than once; name each seed once")
    if given.together < 1:
        parser.error(f"--together {given.together}: expected at least 1 (default 5)")
    if given.policies < 0:
        parser.error(f"--policies {given.policies}: expected at least 1 iteration; leave it out to train models")
    try:
        require_other_seed(*given.seeds)
        own = [runs.resolve("02_train", scale=given.scale, seed=seed, device=given.device) for seed in given.seeds]
        for env in given.envs:
            EnvSpec.parse(env)
    except ValueError as error:  # ParameterError is one
        parser.error(str(error))
    if given.table and (scale := own[0].scale) != "paper":
        parser.error(f"{SEEDS.name} has lines of scale paper alone, got {scale}; type --table --scale paper")
    if given.table:
        found = table(own, given.envs, given.models)
        merged(pd.read_csv(SEEDS, dtype=str), found.astype(str)).to_csv(SEEDS, index=False, lineterminator="\n")
        print(found.to_string(index=False))
        return
    began, spawn = time.perf_counter(), multiprocessing.get_context("spawn")
    if given.policies:
        words = [word for word in given.models if zoo.find(word).group != "prior"]
        for env, word, run in product(given.envs, words, own):
            if not (run.dir / "models" / EnvSpec.parse(env).name / f"{word}.safetensors").exists():
                parser.error(f"{run.dir} has no {word} of {env}; train it first, by this script without --policies")
        with ProcessPoolExecutor(given.together, mp_context=spawn, max_tasks_per_child=1) as learners:
            finish(began, {
                learners.submit(learn, own, env, way, given.policies): f"{env} {way.label}"
                for env, way in product(given.envs, zoo.policies(words))
            })  # fmt: skip
        return
    wanted = [(env, word) for env, word in product(given.envs, given.models) if models.trained_on(env, word) == env]
    with (
        ProcessPoolExecutor(parallel.cores(), mp_context=spawn) as collectors,
        ProcessPoolExecutor(given.together, mp_context=spawn, max_tasks_per_child=1) as trainers,
    ):
        splits = {env: [collectors.submit(collect, run, env) for run in own] for env in given.envs}
        under_way: dict[Future[str], str] = {}
        for env, word in wanted:
            for split in splits[env]:
                split.result()
            under_way[trainers.submit(train, own, env, word, given.compiled)] = f"{env} {word}"
        finish(began, under_way)


def finish(began: float, under_way: dict[Future[str], str]) -> None:
    """Wait for all and say what came of each; exit status 1 where one failed."""
    failed = False
    for done in as_completed(under_way):
        failed |= (error := done.exception()) is not None
        said = f"{under_way[done]}: {type(error).__name__}: {error}" if error else done.result()
        print(f"{time.perf_counter() - began:6.0f} s  {said}", flush=True)
    if failed:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
