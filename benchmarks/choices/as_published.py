"""Whether what a run at scale paper measured is what was published, within the spread of the training seeds.

python -m tsmlib run predict control --scale paper --seed 1
python benchmarks/choices/as_published.py runs/paper/seed1/metrics/0{3_predict,5_control}.csv

Where three seeds are published, a number is outside if they do not let expect it of one more (t interval, 95 %). Where
there is one, as of plans and policies, nothing is known of the spread; what is counted then is how often the run is
the better of the two, which is half of the times if both are draws of the same.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np

from tsmlib import store, study

SCORES = ("ll_paper", "ll_shared", "ll_own", "energy_score_noise", "nrmse", "coverage80")
KEYS = ("env", "model", "planner", "prior", "condition", "metric", "horizon")
STEPS = ("", 10, 80)  # scores over all steps, and at two of them
UPDATES = 2200  # after which the policies of 05_control are learned
T95 = {3: 4.303, 4: 3.182, 5: 2.776}  # by how many seeds there are

Found = dict[tuple, dict[int, float]]  # what was measured -> the value of each training seed


def read(path: Path) -> Found:
    """Scores, and true returns of plans and of learned policies; the mean where there are several copies."""
    values: dict[tuple, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in store.load_table(path):
        score = row["metric"] in SCORES and row["horizon"] in STEPS and row["condition"] in ("clean", "noise", "delay")
        earned = row["metric"] == "return_true" and row["condition"] in ("clean", "closed loop")
        learned = row["metric"] == "return_true" and row["planner"] == "policy" and row["horizon"] == UPDATES
        if row["model"] not in ("none", "oracle") and (score or earned or learned):
            values[tuple(row[key] for key in KEYS)][row["seed"]].append(row["value"])
    return {what: {seed: float(np.mean(copies)) for seed, copies in own.items()} for what, own in values.items()}


def compare(run: Found, published: Found) -> None:
    """Print every number beside those published, then how many are outside and how many are better."""
    outside, better, pairs, compared = [], 0, 0, 0
    for what, own in run.items():
        values, text = np.array(list(published.get(what, {}).values())), " ".join(f"{part}" for part in what if part)
        (value,) = own.values()
        if len(values):
            print(f"{text:75} {value:9.3f}   published {', '.join(f'{v:.3f}' for v in values)}")
        if len(values) in T95:
            compared += 1
            spread = T95[len(values)] * values.std(ddof=1) * np.sqrt(1 + 1 / len(values))
            if abs(value - values.mean()) > spread:
                outside.append(text)
        elif len(values) and "return_true" in what:
            pairs, better = pairs + 1, better + int(value > values.mean())
    if compared:
        print(f"{len(outside)} of {compared} lie outside what the published seeds let expect of one more (95 %)")
        print(*outside, sep="\n")
    if pairs:
        print(f"{better} of {pairs} returns are better than those of the one published seed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", type=Path, nargs="+", help="tables of a run, named as those in data/results")
    for table in parser.parse_args().tables:
        print(f"== {table}")
        compare(read(table), read(study.RESULTS / table.name))


if __name__ == "__main__":
    main()
