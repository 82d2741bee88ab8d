"""Samples that a score needs: every score with few samples against the same with 500.

The scores of 03_predict are estimated from 32 samples of each model. This script scores one trained model again and
again, with more and more samples, on the first test episodes.

    python benchmarks/settings/samples.py
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from tsmlib import study
from tsmlib.envs.spec import ENV_IDS, EnvSpec
from tsmlib.evaluation import prediction
from tsmlib.storage import tables
from tsmlib.study import parameters, runs, zoo

METRICS = ("ll_paper", "ll_shared", "ll_horizon", "ll_own", "energy_score_noise", "crps_noise", "nrmse", "coverage80")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=ENV_IDS, default="tsm/ReacherPush-v1")
    parser.add_argument("--model", choices=zoo.words("dynamics"), default=zoo.OURS)
    parser.add_argument(
        "--samples", type=int, nargs="+", default=[8, 16, 32, 64, 128, 500], help="the last is the reference"
    )
    parser.add_argument("--episodes", type=int, default=100, help="of the test split (default 100)")
    parser.add_argument("--scale", choices=parameters.SCALES, default="paper")
    parser.add_argument("--out", type=Path, help="table to write (default: metrics/03_samples.csv of the run)")
    arguments = parser.parse_args()
    run = runs.resolve("03_predict", scale=arguments.scale)
    net, _ = study.load_or_train(run, arguments.env, arguments.model)
    test, held_out = (study.dataset(run, arguments.env, split) for split in ("test", "validation"))
    test, held_out = test.take(slice(arguments.episodes)), held_out.take(slice(arguments.episodes))
    common = dict(
        env=arguments.env, sim=EnvSpec.parse(arguments.env).simulator,
        model=arguments.model, planner="none", execution="open loop",
        n=len(test), seed=run.seed, scale=run.scale,
    )  # fmt: skip
    rows = []
    print(f"{arguments.env}, {arguments.model}: means over 90 steps of {len(test)} episodes; seconds of one process")
    print("samples  " + "".join(f"{metric:>20}" for metric in METRICS) + f"{'seconds':>10}")
    for samples in arguments.samples:
        began = time.process_time()
        found = prediction.score(net, net.features, test, held_out, samples=samples, progress=f"{samples} samples")
        seconds = time.process_time() - began
        curves = found.against_horizon()
        values = {metric: float(curves[metric].mean()) for metric in METRICS}
        print(f"{samples:7}  " + "".join(f"{values[metric]:20.3f}" for metric in METRICS) + f"{seconds:10.1f}")
        rows += [dict(common, metric=metric, value=value, samples=samples) for metric, value in values.items()]
        rows.append(dict(common, metric="score_seconds", value=seconds, unit="s", samples=samples))
    path = arguments.out or run.metrics / "03_samples.csv"
    tables.save(path, rows, extra=["samples"])
    print(path)


if __name__ == "__main__":
    main()
