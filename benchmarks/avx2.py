"""Training where the processor has AVX2 alone, and so no bfloat16: each stage as the study trains it, against float32.

torch and oneDNN are held to AVX2 by their variables, in a process of its own; the calls are those of ``train.py``, but
that ``fit`` chooses the precision (``training.precision``). Emulated, bfloat16 would make 0.1 to 0.2 times the updates
of float32. A stage that trains in float32 everywhere is measured too. Seconds are those of the CPU.

    python benchmarks/avx2.py        or        python -m tsmlib bench avx2
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

HELD = {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2"}  # read once, as torch is loaded


def main() -> None:
    if any(os.environ.get(name) != value for name, value in HELD.items()):
        raise SystemExit(
            subprocess.run([sys.executable, *sys.argv], env={**os.environ, **HELD}, check=False).returncode
        )

    from _rounds import Row, interleaved, on_the_cpu, parsed, parser, save
    from train import ENV, training

    from tsmlib import study
    from tsmlib.study import runs, zoo

    options = parser(__doc__, rounds=9)
    options.add_argument("--models", default=",".join([*zoo.words("dynamics"), "prior"]))
    options.add_argument("--updates", type=int, default=10, help="in every call (default 10)")
    options.add_argument("--batch", type=int, default=0, help="windows per update; 0: as in the schedule (default)")
    options.add_argument("--episodes", type=int, default=200, help="to draw windows from (default 200)")
    arguments = parsed(options)
    run, rows = runs.resolve("bench", scale="laptop"), []
    data = study.random_data(ENV, arguments.episodes, seed=0), study.random_data(ENV, 1, seed=1)
    for model in arguments.models.split(","):
        net, stages = study.initialise(run, model, data[0]), study.schedule(run, ENV, model)
        for key, stage in zip(zoo.keys(stages), stages, strict=True):
            stage = replace(stage, batch=arguments.batch or stage.batch)
            ways = {
                "chosen": on_the_cpu(training(net, stage, data, updates=arguments.updates)),
                "float32": on_the_cpu(training(net, stage, data, updates=arguments.updates, bf16=False)),
            }
            seconds = interleaved(ways, arguments.rounds, progress=f"{model}: {key}")
            speed = {way: arguments.updates / taken for way, taken in seconds.items()}
            rows.append(
                Row.of(
                    f"train {model}, {key}, AVX2 alone: updates", speed["chosen"], "float32", speed["float32"],
                    env=ENV, sim="mujoco", model=model, configuration=stage.loss, metric="updates_per_second",
                    horizon=stage.future_len,
                )
            )  # fmt: skip
    print(f"{ENV}, {arguments.rounds} rounds of {arguments.updates} updates, {arguments.threads} threads")
    save("avx2", rows)


if __name__ == "__main__":
    main()
