"""Models that were trained twice with the same training seeds: as copies on a GPU, and alone on a CPU.

    git show 8a20766:data/results/03_predict.csv.gz > build/gpu.csv.gz
    python benchmarks/settings/twice.py write build/gpu.csv.gz
    python benchmarks/settings/twice.py

write puts scores of reaching and pushing into twice.csv, from an older table of scores (GPU) and the one that ships
(CPU), of the models and seeds that differ: of 1,000 test episodes, open loop, whole, with residual noise. Without it
the table is printed: for each arm, model and metric the mean over seeds of either training, and of the difference,
paired by seed, with half the 95 % t interval where there are two seeds or more.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd

from tsmlib.statistics import interval
from tsmlib.storage import tables
from tsmlib.storage.files import StoreError
from tsmlib.study.results import table
from tsmlib.study.runs import RESULTS

FILE = Path(__file__).parent / "twice.csv"
ARMS = {"tsm/ReacherPush-v1": "pushing", "tsm/Reacher-v0": "reaching"}
METRICS = {"energy_score_noise": "energy score", "nrmse": "nRMSE", "coverage80": "coverage"}
ABOUT = ["env", "model", "metric", "seed"]


def scores(path: Path, way: str) -> pd.DataFrame:
    """A line for each arm, model, metric and seed: the score over all 90 steps, in a column ``way``."""
    shown = table.select(tables.load(path), env=list(ARMS), noise=None, delay=None, subset="")
    rows = table.select(shown, execution="open loop", metric=list(METRICS))
    whole = rows[rows["steps_ahead"].isna()]
    return pd.DataFrame(whole[[*ABOUT, "value"]]).rename(columns={"value": way})


def compared(both: pd.DataFrame) -> pd.DataFrame:
    """A line for each arm, metric and model: means over seeds, and of CPU minus GPU with half its interval."""
    lines = []
    for (env, metric, model), part in both.groupby(["env", "metric", "model"], sort=False):
        mean, half = interval(part["cpu"] - part["gpu"])
        lines.append({
            "arm": ARMS[str(env)], "": METRICS[str(metric)], "model": model, "seeds": len(part),
            "GPU, copies": f"{part['gpu'].mean():.3f}",
            "CPU, alone": f"{part['cpu'].mean():.3f}",
            "CPU minus GPU": f"{mean:.3f}" + (f" ± {half:.3f}" if len(part) > 1 else ""),
        })  # fmt: skip
    return pd.DataFrame(lines)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("part", nargs="?", default="print", choices=("write", "print"))
    options.add_argument("older", nargs="?", type=Path, help="the table of write")
    given = options.parse_args()
    if (given.part == "write") != bool(given.older):
        options.error("write, and nothing else, takes an older table of scores")
    if given.older:
        try:
            older = scores(given.older, "gpu")
        except StoreError as error:
            options.error(f"{error} --help says how an older table of scores is had from git")
        both = older.merge(scores(RESULTS / "03_predict.csv", "cpu"), on=ABOUT).query("gpu != cpu")
        if both.empty:
            options.error(f"{given.older}: no other scores of these arms there than those that ship")
        both.sort_values(ABOUT).to_csv(FILE, index=False, float_format="%.6g", lineterminator="\n")
    print(table.markdown(compared(pd.read_csv(FILE))))


if __name__ == "__main__":
    main()
