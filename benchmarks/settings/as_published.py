"""Results of a run at scale paper against the published ones, by the spread of the other training seeds.

python -m tsmlib run all --scale paper --seed 1
python benchmarks/settings/as_published.py runs/paper/seed1/metrics/03_predict.csv   # or 05_control, 06_robustness

A number is outside where it lies beyond the 95 % prediction interval (t) that the other published seeds give for one
more; of one seed nothing is known of the spread. Where the run's own seed is published, how far it moved is told in
standard deviations between the published seeds. Numbers of one model hang together: the counts describe, and are no
test.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from tsmlib import study
from tsmlib.statistics import interval
from tsmlib.storage import tables

SCORES = {  # metric -> what makes it comparable: larger is better
    "ll_paper": lambda value: value,
    "ll_own": lambda value: value,
    "energy_score_noise": lambda value: -value,
    "nrmse": lambda value: -value,
    "coverage80": lambda value: -abs(value - 0.8),
    "return_true": lambda value: value,
}
KEYS = ("env", "model", "planner", "search_space", "execution", "noise", "delay", "metric", "steps_ahead")
STEPS = ("", 10, 80)  # scores over all steps, and at two of them

Found = dict[tuple, dict[int, float]]  # what was measured -> the value of each training seed


def read(path: Path) -> Found:
    """Scores, true returns of plans, and of policies when they are learned; the mean where there are several copies."""
    rows = tables.records(tables.load(path))
    updates = [row["iteration"] for row in rows if row["planner"] == "policy" and row["iteration"] != ""]
    learned = max(updates, default=0)

    def wanted(row: dict[str, Any]) -> bool:
        if row["model"] in ("none", "oracle"):
            return False
        if row["planner"] == "policy":
            return row["metric"] == "return_true" and row["iteration"] == learned
        if row["metric"] == "return_true":
            return row["iteration"] == ""
        return (
            row["metric"] in SCORES
            and row["steps_ahead"] in STEPS
            and (row["execution"], row["subset"]) == ("open loop", "")
        )

    values: dict[tuple, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in filter(wanted, rows):
        values[tuple(row[key] for key in KEYS)][row["seed"]].append(row["value"])
    return {what: {seed: float(np.mean(copies)) for seed, copies in own.items()} for what, own in values.items()}


def compare(run: Found, published: Found) -> None:
    """Print every number beside those of the other seeds, then how many are outside, better and worse."""
    outside, moved, bounded = [], [], 0
    counts: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(3, int))  # planner -> compared, better, worse
    for what, own in run.items():
        if len(own) > 1:
            raise SystemExit(f"the table holds seeds {sorted(own)}, expected one; name that of a run, in its metrics/")
        ((seed, value),) = own.items()
        known = published.get(what, {})
        others = np.array([v for k, v in known.items() if k != seed])
        if not len(others):
            continue
        text, good = " ".join(f"{part}" for part in what if part != ""), SCORES[what[KEYS.index("metric")]]
        print(f"{text:75} {value:9.3f}   published {', '.join(f'{v:.3f}' for v in others)}")
        better, worse = good(value) > good(others.mean()), good(value) < good(others.mean())
        counts[what[KEYS.index("planner")]] += [1, better, worse]
        if seed in known:
            moved.append((good(value) - good(known[seed])) / np.std(list(known.values()), ddof=1))
        if len(others) > 1:
            bounded += 1
            mean, half = interval(others)
            if abs(value - mean) > half * np.sqrt(len(others) + 1):  # of one more number, not of the mean
                outside.append(f"{text} ({'better' if better else 'worse'})")
    for planner, (compared, better, worse) in counts.items():
        print(f"planner {planner}: of {compared}, {better} better than the other seeds' mean, {worse} worse")
    print(f"{len(outside)} of {bounded} outside the 95 % prediction interval for one more seed", *outside, sep="\n")
    if moved:
        below, middle, above = np.quantile(moved, [0.05, 0.5, 0.95])
        print(
            f"{len(moved)} beside the same seed: better by {middle:.2f} standard deviations in the median, "
            f"{below:.2f} to {above:.2f} for nine in ten"
        )
    print(f"{len(run) - sum(compared for compared, *_ in counts.values())} not compared: no other seed is published")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", type=Path, nargs="+", help="tables of a run, named as those in data/results")
    for table in parser.parse_args().tables:
        print(f"== {table}")
        compare(read(table), read(study.RESULTS / table.name))


if __name__ == "__main__":
    main()
