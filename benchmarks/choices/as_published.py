"""Whether the scores of a run at scale paper are those that were published, within the spread of the training seeds.

python -m tsmlib run predict --scale paper --seed 0
python benchmarks/choices/as_published.py runs/paper/seed0/metrics/03_predict.csv
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from tsmlib import store, study

METRICS = ("ll_paper", "ll_shared", "ll_own", "energy_score_noise", "nrmse", "coverage80")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path, help="03_predict.csv of a run")
    arguments = parser.parse_args()
    published = store.load_table(study.RESULTS / "03_predict.csv")
    outside, compared = [], 0
    for row in store.load_table(arguments.table):
        if row["metric"] not in METRICS or row["condition"] != "clean" or row["horizon"] not in ("", 10, 80):
            continue
        same = [r for r in published if all(r[k] == row[k] for k in ("env", "model", "metric", "condition", "horizon"))]
        values = np.array([r["value"] for r in same])
        if len(values) < 3:
            continue
        step = f"at {row['horizon']}" if row["horizon"] else ""
        what = f"{row['env']:20} {row['model']:18} {row['metric']:18} {step:6}"
        spread = 4.303 * values.std(ddof=1) * np.sqrt(1 + 1 / len(values))  # 95 % of one more seed, t with 2 freedoms
        print(f"{what} {row['value']:9.3f}   published {', '.join(f'{v:.3f}' for v in values)}")
        compared += 1
        if abs(row["value"] - values.mean()) > spread:
            outside.append(what)
    print(
        f"{len(outside)} of {compared} lie outside what three seeds let expect of a fourth (95 %)", *outside, sep="\n"
    )


if __name__ == "__main__":
    main()
