"""Models that were trained twice with the same training seeds: as copies on a GPU, and alone on a CPU.

    git show 8a20766:data/results/03_predict.csv.gz > build/gpu.csv.gz
    python benchmarks/settings/twice.py write build/gpu.csv.gz --seeds 6 7 8
    python benchmarks/settings/twice.py

write puts scores of pushing of these seeds into twice.csv, from an older table of scores (GPU) and the one that ships
(CPU): of 1,000 test episodes, open loop, whole, with residual noise. Without it the table is printed: for each model
and metric the mean over seeds of either training, and of the difference, paired by seed, with half the 95 % t interval
where there are two seeds or more.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd

from tsmlib.statistics import interval
from tsmlib.storage import tables
from tsmlib.study.results import table
from tsmlib.study.runs import RESULTS

FILE = Path(__file__).parent / "twice.csv"
PUSH, METRICS = "tsm/ReacherPush-v1", {"energy_score_noise": "energy score", "nrmse": "nRMSE", "coverage80": "coverage"}
ABOUT = ["model", "metric", "seed"]


def scores(path: Path, seeds: list[int]) -> pd.DataFrame:
    """A line for each model, metric and seed: the score over all 90 steps."""
    rows = table.select(tables.load(path), env=PUSH, execution="open loop", metric=list(METRICS), seed=seeds, subset="")
    whole = rows[rows["steps_ahead"].isna()]
    return pd.DataFrame(whole[[*ABOUT, "value"]])


def compared(both: pd.DataFrame) -> pd.DataFrame:
    """A line for each metric and model: means over seeds, and of CPU minus GPU with half its interval."""
    lines = []
    for (metric, model), part in both.groupby(["metric", "model"], sort=False):
        mean, half = interval(part["cpu"] - part["gpu"])
        lines.append({
            "": METRICS[str(metric)], "model": model, "seeds": len(part), "GPU, copies": f"{part['gpu'].mean():.3f}",
            "CPU, alone": f"{part['cpu'].mean():.3f}",
            "CPU minus GPU": f"{mean:.3f}" + (f" ± {half:.3f}" if len(part) > 1 else ""),
        })  # fmt: skip
    return pd.DataFrame(lines)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("part", nargs="?", default="print", choices=("write", "print"))
    options.add_argument("older", nargs="?", type=Path, help="the table of write")
    options.add_argument("--seeds", nargs="+", type=int, default=[6, 7, 8])
    given = options.parse_args()
    if (given.part == "write") != bool(given.older):
        options.error("write, and nothing else, takes an older table of scores")
    if given.older:
        older, newer = (scores(path, given.seeds) for path in (given.older, RESULTS / "03_predict.csv"))
        both = older.merge(newer, on=ABOUT, suffixes=("_older", "_newer"))
        both = both.rename(columns={"value_older": "gpu", "value_newer": "cpu"})
        same = sorted(set(both.loc[both["gpu"] == both["cpu"], "seed"].tolist()))
        if same or both.empty:
            options.error(f"{given.older}: seeds {same or given.seeds} have no other scores there than those that ship")
        both.sort_values(ABOUT).to_csv(FILE, index=False, float_format="%.6g", lineterminator="\n")
    print(table.markdown(compared(pd.read_csv(FILE))))


if __name__ == "__main__":
    main()
