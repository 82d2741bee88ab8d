"""One training for another share of its budget, at another rate of Muon, or with weight decay: what would that buy?

    python benchmarks/settings/budgets.py lstm --times 3 --muon 0.01
    python benchmarks/settings/budgets.py rtsm --times 0.3333 --seed 2
    python benchmarks/settings/budgets.py onestep --env tsm/Reacher-v0 --decay 0.1

trains on the data of scale paper, seed 0, and their symmetric copies. Model and checkpoints go to the run's folder
``settings`` (``TSM_RUN_DIR``); stopped, it goes on from there. ``curve.py`` makes the lines of the table from such a
folder, ``decoders.py`` plans with the models.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict, replace

import torch

from tsmlib.envs import fingerprint
from tsmlib.envs.spec import EnvSpec
from tsmlib.envs.symmetry import copies
from tsmlib.storage import artifacts
from tsmlib.study import models, runs, zoo
from tsmlib.training.fit import fit


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="word of a dynamics model")
    parser.add_argument("--env", default="tsm/ReacherPush-v1")
    parser.add_argument("--times", type=float, default=1.0, help="the budget (default 1)")
    parser.add_argument("--muon", type=float, help="rate of Muon (default: that of the study)")
    parser.add_argument("--decay", type=float, default=0.0, help="of the weight matrices, decoupled (default 0)")
    parser.add_argument("--seed", type=int, default=0, help="of the weights and the order of the data (default 0)")
    given = parser.parse_args()
    if not given.times > 0:
        parser.error(f"--times {given.times:g}: expected more than 0, a share of the budget")
    torch.set_num_threads(1)
    run, spec, env = runs.resolve("02_train", scale="paper", seed=0), zoo.find(given.model), EnvSpec.parse(given.env)
    data, held_out = models.training_data(run, given.env, given.model)
    net = spec.load().for_data(data, seed=given.seed, **spec.arguments(env))
    stages = [replace(stage, weight_decay=given.decay) for stage in spec.schedule(env, given.times)]
    if given.muon is not None:
        stages = [replace(stage, muon=given.muon) for stage in stages]
    decayed = f"_decay{given.decay:g}" * bool(given.decay)
    name = f"{given.model}_{given.times:g}_{stages[0].muon:g}_{given.seed}{decayed}"
    path, curves = run.folder(f"settings/{env.name}") / f"{name}.safetensors", {}
    for key, stage in zip(zoo.keys(stages), stages, strict=True):
        curve = fit(
            net, getattr(net, stage.loss), data, held_out, stage.options(net.past_len), seed=given.seed,
            checkpoint=path.with_name(f"{name}-{key}.checkpoint"), progress=f"{name}: {key}",
        )  # fmt: skip
        curves[key] = asdict(curve)
        print(f"{name} {key}: {stage.steps} updates, validation loss {min(curve.validation):.3g}", flush=True)
    artifacts.save_model(path, net, {
        "fingerprint": fingerprint(given.env), "model": given.model, "seed": given.seed, "curves": curves,
        "schedule": [stage.stated() for stage in stages], "symmetries": copies(given.env), "scale": "paper",
        "bf16": [key for key, curve in curves.items() if any(curve["bf16"])],
        "torch": torch.__version__, "finished": time.strftime("%Y-%m-%d"),
        "seconds": sum(curve["seconds"][-1] for curve in curves.values()),
    })  # fmt: skip
    print(path)


if __name__ == "__main__":
    main()
