"""Learning rate of each model: half, once and twice that of its schedule, on validation data.

Both rates of a schedule are scaled, Muon's and that of Adam beside it; the table names Muon's where there is one.

Every model gets the same three tries at the same share of its budget (`study.BUDGET`); what counts is the best
validation loss of its last stage. Losses of different models are not to be compared. Data are those of the study, with
their symmetric copies.

    python benchmarks/settings/learning_rates.py
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tsmlib import study
from tsmlib.envs.spec import ENV_IDS, EnvSpec
from tsmlib.storage import tables
from tsmlib.study import parameters, runs, zoo
from tsmlib.training.fit import fit

FACTORS = (0.5, 1.0, 2.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=ENV_IDS, default="tsm/ReacherPush-v1")
    parser.add_argument("--models", nargs="+", choices=zoo.words("dynamics"), metavar="MODEL", default=[
        "onestep", "multistep", "lstm", "ensemble+mse", "tsm", "rtsm"])  # fmt: skip
    parser.add_argument("--share", type=float, default=0.2, help="of the budget (default 0.2)")
    parser.add_argument("--scale", choices=parameters.SCALES, default="paper")
    parser.add_argument("--out", type=Path, help="table to write (default: metrics/02_learning_rates.csv of the run)")
    arguments = parser.parse_args()
    run = runs.resolve("02_train", scale=arguments.scale)
    path = arguments.out or run.metrics / "02_learning_rates.csv"
    common = dict(
        env=arguments.env, sim=EnvSpec.parse(arguments.env).simulator, planner="none",
        metric="validation_loss", seed=run.seed, scale=run.scale,
    )  # fmt: skip
    rows = []
    for model in arguments.models:
        data, held_out = study.training_data(run, arguments.env, model)
        for factor in FACTORS:
            net = study.initialise(run, model, data)
            for stage in study.schedule(run, arguments.env, model):
                steps = max(1, round(stage.steps * arguments.share))
                curve = fit(
                    net, getattr(net, stage.loss), data, held_out,
                    stage.options(
                        net.past_len, steps=steps, lr=factor * stage.lr, muon=factor * stage.muon, validate_every=50
                    ),
                    seed=run.seed, progress=f"{model}, {factor:g} times the rate: {stage.loss}",
                )  # fmt: skip
            best, rate = min(curve.validation), factor * (stage.muon or stage.lr)
            print(f"{model:20} last stage at {rate:.0e}: best validation loss {best:.4f}", flush=True)
            rows.append(dict(common, model=model, n=len(held_out), value=best, rate=rate))
            tables.save(path, rows, extra=["rate"])
    print(path)


if __name__ == "__main__":
    main()
