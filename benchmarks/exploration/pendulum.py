"""What a round of the pendulum needs: return on validation starts against training and planning.

    python benchmarks/exploration/pendulum.py rtsm --updates 1000 --before 1500 --prior 300 --candidates 64 --elites 8 \
        --iterations 5 --every 5

The loop of notebook 10 (``study.rounds.loop``) with the numbers of ``Sizes`` that are given, of training seed 10, which
no published row has. After every round the model plans from 16 validation starts. A line in pendulum.csv for each
round: executed return, share upright, mean absolute gap. With --judging 0 --screened 1 the mode judges candidates, of
an ensemble all members. Lines of the same loop are replaced.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict, replace
from pathlib import Path
from unittest.mock import patch

import pandas as pd
import torch

from tsmlib.study import pendulum, rounds, runs, worlds
from tsmlib.study.results.exploration import PENDULUM

PLACE, SEED, STARTS, VALIDATION = Path(__file__).with_suffix(".csv"), 10, 16, 3000
GIVEN = ("updates", "before", "prior", "candidates", "elites", "iterations", "every", "judging", "screened")
METRICS = ("return_true", "success", "gap_absolute")


def lines(word: str, sizes: worlds.Sizes) -> pd.DataFrame:
    """One loop, round 0 first."""
    began, run = time.process_time(), runs.resolve("10_explore", scale="paper", seed=SEED)
    validation = replace(worlds.WORLDS[PENDULUM], tested=lambda n: pendulum.swing_up(n, seed=VALIDATION))
    with patch.dict(worlds.WORLDS, {PENDULUM: validation}):
        rows = pd.DataFrame(rounds.loop(run, word, sizes=sizes).rows)
    table = rows[rows["metric"].isin(METRICS)].pivot(index="env_steps", columns="metric", values="value").reset_index()
    what = {"model": word} | {name: asdict(sizes)[name] for name in GIVEN}
    return table[["env_steps", *METRICS]].assign(**what, loop_seconds=round(time.process_time() - began))


def main() -> None:
    default = worlds.world(PENDULUM).sizes["paper"]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", choices=worlds.WORLDS[PENDULUM].learners)
    for name in GIVEN:
        number = getattr(default, name)
        parser.add_argument(f"--{name}", type=type(number), default=number, help="default %(default)s")
    parser.add_argument("--out", type=Path, default=PLACE, help="default pendulum.csv beside this script")
    given = vars(parser.parse_args())
    torch.set_num_threads(1)
    word, out = given.pop("model"), given.pop("out")
    new = lines(word, replace(default, starts=STARTS, **given))
    key = ["model", *GIVEN]
    if out.exists():
        kept = pd.read_csv(out)
        same = kept[key].eq(new[key].iloc[0]).all(axis=1)
        new = pd.concat([kept[~same], new])
    columns = [*key, "env_steps", *METRICS, "loop_seconds"]
    new[columns].round(3).to_csv(out, index=False)
    print(new[columns].round(2).to_string(index=False))


if __name__ == "__main__":
    main()
