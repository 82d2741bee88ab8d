"""Training each model as the study trains it, against the same updates written plainly, and against sgemm.

Every call is ``tsmlib.training.fit.fit`` for ten updates, with the loss, the batch and the future of a stage of
``study.schedule``: windows drawn, loss, gradient, clipping, Adam, and one validation on so few windows that its share
is that of the study (2,000 windows every 250 updates). The reference is the same stage in float32 through
``_plain.PlainTSM``; for models that have no plain form, themselves in the other precision, which is emulated where the
processor has no bfloat16. The limit is the time that
the matrix products of the very same call take alone, in float32: the share says how many of the CPU's float32
operations per second training gets.

    python benchmarks/train.py        or        python -m tsmlib bench train
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest import mock

import numpy as np
from _plain import PlainTSM
from _rounds import SGEMM, Products, Row, interleaved, on_the_cpu, parsed, parser, peak_bytes, save
from tsmlib.training.precision import native_bf16

from tsmlib import study, zoo
from tsmlib.models.tsm import TSM
from tsmlib.training.fit import TrainingOptions, fit
from tsmlib.trajectory import Trajectories
from tsmlib.zoo import OURS, Updates

ENV = "tsm/ReacherPush-v1"
BEFORE = "tsm+energy+direct"  # what rtsm took the place of
WORDS = {
    "teacher_forced_loss": "teacher-forced",
    "loss": "free-running",
    "energy_loss": "energy score",
}
ONE_STEP = {"onestep", "ensemble", "ensemble+mse"}
Data = tuple[Trajectories, Trajectories]


def main() -> None:
    options = parser(__doc__, rounds=5)
    options.add_argument("--models", default=",".join([*zoo.words("dynamics"), "prior"]))
    options.add_argument("--updates", type=int, default=10, help="in every call (default 10)")
    options.add_argument(
        "--batches", default="128,256,512,1024", help="windows per update, tsm free-running"
    )
    options.add_argument(
        "--batch", type=int, default=0, help="windows per update; 0: as in the schedule (default)"
    )
    options.add_argument(
        "--episodes", type=int, default=200, help="to draw windows from (default 200)"
    )
    arguments = parsed(options)
    run = runs.resolve("bench", scale="laptop")
    data = study.random_data(ENV, arguments.episodes, seed=0), study.random_data(ENV, 1, seed=1)
    rows, seen = [], set()
    for model in arguments.models.split(","):
        for stage in study.schedule(run, ENV, model):
            stage = replace(stage, batch=arguments.batch or stage.batch)
            net = study.initialise(run, model, data[0])
            kind = (type(net), str(net.config()), stage.loss, stage.batch, stage.future_len)
            if kind not in seen:  # tsm and tsm+energy begin alike
                rows.append(stage_row(net, model, stage, data, arguments))
            seen.add(kind)
    if OURS in arguments.models.split(","):
        rows.append(before_row(run, data, arguments))
    if arguments.batches:
        sizes = [int(word) for word in arguments.batches.split(",")]
        rows += batch_rows(study.initialise(run, "tsm", data[0]), sizes, data, arguments.updates, 2)
    print(
        f"{ENV}, {arguments.rounds} rounds of {arguments.updates} updates, {arguments.threads} threads"
    )
    save("train", rows)


def training(
    net: Any, stage: Updates, data: Data, *, updates: int, bf16: bool | None = None
) -> Callable[[], object]:
    """``updates`` updates of a stage, as the study has them.

    bf16: matrix products in bfloat16, native or not; None: as ``fit`` chooses by the stage and the processor.
    """

    def call() -> None:
        options = TrainingOptions(
            past_len=net.past_len,
            future_len=stage.future_len,
            steps=updates,
            batch_size=stage.batch,
            validate_every=updates,
            lr=1e-5,
            muon=1e-5 if stage.muon else 0.0,
            weight_decay=stage.weight_decay,
            bf16=stage.bf16 if bf16 is None else bf16,
        )
        chosen = native_bf16() if bf16 is None else bf16
        with mock.patch("tsmlib.training.fit.native_bf16", return_value=chosen):
            fit(net, getattr(net, stage.loss), *data, options)

    return call


def stage_row(net: Any, model: str, stage: Updates, data: Data, arguments: Any) -> Row:
    """Supervised targets per second of one stage."""
    bf16 = stage.bf16 and native_bf16()
    plain = PlainTSM(net) if isinstance(net, TSM) else net
    other = (
        "plain eager float32"
        if plain is not net
        else f"itself in {'float32' if bf16 else 'bfloat16'}"
    )
    fast = training(net, stage, data, updates=arguments.updates, bf16=bf16)
    products = Products.of(fast)
    ways = {
        "fast": fast,
        "plain": training(
            plain, stage, data, updates=arguments.updates, bf16=plain is net and not bf16
        ),
        "sgemm": products.alone(),
    }
    ways["plain"]()
    peak = peak_bytes(fast)
    seconds = interleaved(ways, arguments.rounds, warm=False, progress=f"{model}: {stage.loss}")
    targets = (
        arguments.updates * stage.batch * stage.future_len
    )  # states, or torques, that a loss compares
    windows = arguments.updates * stage.batch / seconds["fast"]
    name = stage.loss if stage.loss not in WORDS or model in ONE_STEP else WORDS[stage.loss]
    name = {"loss": "one step ahead", "multi_step_loss": "free-running"}.get(name, name)
    name += ", longer windows" * (stage.future_len > 20)
    print(f"{model}, {name}: {sorted(windows)[len(windows) // 2]:,.0f} windows a second")
    return Row.of(
        f"train {model}, {name}: targets",
        targets / seconds["fast"],
        other,
        targets / seconds["plain"],
        limit=SGEMM,
        bound=targets / seconds["sgemm"],
        peak=peak,
        env=ENV,
        sim="mujoco",
        model=model,
        configuration=stage.loss,
        metric="targets_per_second",
        horizon=stage.future_len,
    )


def before_row(run: runs.Run, data: Data, arguments: Namespace) -> Row:
    """Updates per CPU second of the free-running stages of rtsm and of what it took the place of, at equal batch.

    Both draw two samples of two chained segments and compare them by the energy score.
    """
    losses, ways = {OURS: "loss", BEFORE: "energy_loss"}, {}
    for model, loss in losses.items():
        stage = next(
            s for s in study.schedule(run, ENV, model) if s.loss == loss and s.future_len == 20
        )
        stage = replace(stage, batch=arguments.batch or 128)
        net = study.initialise(run, model, data[0])
        ways[model] = on_the_cpu(training(net, stage, data, updates=arguments.updates))
    seconds = interleaved(ways, arguments.rounds, progress=f"{OURS} and {BEFORE}")
    speed = {model: arguments.updates / taken for model, taken in seconds.items()}
    return Row.of(
        f"train {OURS}, free-running, two samples, beside {BEFORE}: updates per CPU second",
        speed[OURS],
        BEFORE,
        speed[BEFORE],
        env=ENV,
        sim="mujoco",
        model=OURS,
        configuration="beside",
        metric="updates_per_second",
        horizon=20,
    )


def batch_rows(net: Any, sizes: list[int], data: Data, updates: int, rounds: int) -> list[Row]:
    """tsm free-running: bfloat16 against float32, batch by batch, per window."""
    ways, products = {}, {}
    for batch in sizes:
        stage = Updates("loss", 1, future_len=20, lr=4e-3, batch=batch, bf16=True)
        for word, bf16 in (("bfloat16", True), ("float32", False)):
            ways[f"{word} {batch}"] = training(net, stage, data, updates=updates, bf16=bf16)
        products[batch] = Products.of(ways[f"float32 {batch}"])
        ways[f"sgemm {batch}"] = products[batch].alone()
    peaks = {way: peak_bytes(call) for way, call in ways.items()}
    seconds = interleaved(ways, rounds, warm=False, progress="batches")

    def speed(way: str, batch: int) -> np.ndarray:
        return updates * batch / seconds[f"{way} {batch}"]

    return [
        Row.of(
            f"train tsm, free-running, {word}, batch {batch}: windows",
            speed(word, batch),
            f"{'float32, the same batch' if word == 'bfloat16' else f'float32, batch {sizes[0]}'}",
            speed("float32", batch if word == "bfloat16" else sizes[0]),
            limit=SGEMM,
            bound=speed("sgemm", batch),
            peak=peaks[f"{word} {batch}"],
            env=ENV,
            sim="mujoco",
            model="tsm",
            configuration="batch",
            metric="windows_per_second",
            horizon=20,
        )
        for batch in sizes
        for word in ("bfloat16", "float32")
        if word == "bfloat16" or batch != sizes[0]
    ]


if __name__ == "__main__":
    main()
