"""What trust costs: checkpoints within a training, and the checks when a shipped model is loaded.

A training with checkpoints is compared with the same one without, in turn; a load with all its checks with reading the
bytes and copying them into a model that exists.

    python benchmarks/trust.py        or        python -m tsmlib bench trust
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from tqdm.auto import tqdm

from tsmlib import runs, store, study
from tsmlib.train import fit
from tsmlib.tsm import TSM

ENV = "tsm/ReacherPush-v0"
SPREAD = {"median": np.median, "lowest": np.min, "highest": np.max}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=500, help="of a training (default 500, a checkpoint every 250)")
    parser.add_argument("--loads", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()

    data, held_out = (study.random_data(ENV, n, seed=seed) for n, seed in ((200, 0), (20, 1)))
    run = runs.resolve("bench", scale="laptop")
    shipped = run.shipped / study.short(ENV) / "tsm.safetensors"
    expect = study.fingerprint(ENV)
    settings = dict(past_len=10, future_len=20, steps=arguments.steps, validate_every=max(1, arguments.steps // 2))
    seconds: dict[str, list[float]] = {"with": [], "without": [], "load": [], "read": []}
    existing = store.load_model(shipped, TSM, expect=expect)
    with tempfile.TemporaryDirectory() as name:
        for i in tqdm(range(arguments.rounds), desc="rounds"):
            for way in ("with", "without"):
                net = study.fresh(run, "tsm", data)
                began = time.process_time()
                fit(net, net.loss, data, held_out, checkpoint=Path(name) / str(i) if way == "with" else None,
                    bf16=True, **settings)  # type: ignore[arg-type]  # fmt: skip
                seconds[way].append(time.process_time() - began)
            for _ in range(arguments.loads):
                began = time.perf_counter()
                store.load_model(shipped, TSM, expect=expect)
                seconds["load"].append(time.perf_counter() - began)
                began = time.perf_counter()
                existing.load_state_dict(safetensors.torch.load(shipped.read_bytes()))
                seconds["read"].append(time.perf_counter() - began)
    ratio = np.array(seconds["with"]) / np.array(seconds["without"])
    load, read = (1000 * np.median(seconds[way]) for way in ("load", "read"))
    print(f"{ENV}, {arguments.steps} steps, {arguments.rounds} rounds, {torch.get_num_threads()} threads")
    spread = f"({ratio.min():.3f} to {ratio.max():.3f})"
    print(f"training with checkpoints takes {np.median(ratio):.3f} times as long {spread}; at most 1.05")
    print(f"loading a shipped model takes {load:.1f} ms, {load - read:.1f} ms more than its bytes; at most 50 ms more")
    common = dict(env=ENV, sim="mujoco", model="tsm", n=arguments.rounds)
    rows = [
        dict(common, condition="checkpoints", metric=f"ratio_{word}", value=of(ratio)) for word, of in SPREAD.items()
    ]
    rows.append(dict(common, condition="load", metric="seconds", value=load / 1000, unit="s"))
    rows.append(dict(common, condition="checks", metric="seconds", value=(load - read) / 1000, unit="s"))
    path = run.dir.parents[1] / "bench" / "trust.csv"
    store.save_table(path, rows)
    print(path)


if __name__ == "__main__":
    main()
