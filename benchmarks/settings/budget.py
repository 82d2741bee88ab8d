"""Shorter trainings: other batches and fewer updates, against the shipped model of the same schedule.

Each try changes one of the two in every stage: twice the batch for half the updates, as many windows altogether; or
half the batch for as many updates. What counts is the best validation loss of a stage, beside that in the header of
the shipped model. The first stage decides little of the last, so read both.

    python benchmarks/settings/budget.py
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tsmlib import study
from tsmlib.envs.spec import ENV_IDS, EnvSpec
from tsmlib.storage import artifacts, tables
from tsmlib.study import parameters, runs, zoo
from tsmlib.training.fit import fit

TRIES = {"twice the batch, half the updates": (2.0, 0.5), "half the batch": (0.5, 1.0)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=ENV_IDS, default="tsm/ReacherPush-v1")
    parser.add_argument("--model", choices=zoo.words("dynamics"), default="tsm")
    parser.add_argument("--stages", type=int, default=2, help="how many of the model's stages (default 2)")
    parser.add_argument("--scale", choices=parameters.SCALES, default="paper")
    parser.add_argument("--out", type=Path, help="table to write (default: metrics/02_budget.csv of the run)")
    arguments = parser.parse_args()
    run, model = runs.resolve("02_train", scale=arguments.scale), arguments.model
    data, held_out = study.training_data(run, arguments.env, model)
    shipped = artifacts.read_header(run.shipped / EnvSpec.parse(arguments.env).name / f"{model}.safetensors")["curves"]
    path, rows = arguments.out or run.metrics / "02_budget.csv", []
    for condition, (batches, updates) in TRIES.items():
        net, stages = study.initialise(run, model, data), study.schedule(run, arguments.env, model)
        for key, stage in list(zip(zoo.keys(stages), stages, strict=True))[: arguments.stages]:
            curve = fit(
                net, getattr(net, stage.loss), data, held_out,
                stage.options(
                    net.past_len, steps=max(1, round(updates * stage.steps)), batch_size=round(batches * stage.batch),
                    patience=0,
                ),
                seed=run.seed, progress=f"{model}, {condition}: {key}",
            )  # fmt: skip
            best, known, seconds = min(curve.validation), min(shipped[key]["validation"]), curve.seconds[-1]
            print(f"{model} {key}, {condition}: {best:.4f} after {seconds:.0f} s, shipped {known:.4f}", flush=True)
            common = dict(
                env=arguments.env,
                sim=EnvSpec.parse(arguments.env).simulator,
                model=model,
                planner="none",
                seed=run.seed,
            )
            common |= dict(scale=run.scale, configuration=condition, n=len(held_out), stage=key)
            rows.append(dict(common, metric="validation_loss", value=best))
            rows.append(dict(common, metric="validation_loss_shipped", value=known))
            tables.save(path, rows, extra=["stage"])
    print(path)


if __name__ == "__main__":
    main()
