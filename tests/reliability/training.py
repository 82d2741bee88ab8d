"""R1-R3, R8, R10, R11, R15, R16: training that is killed, starved of disk, interrupted, fed NaN and
raced.
"""

from __future__ import annotations

import contextlib
import errno
import io
import math
import os
import re
import shutil
import signal
import subprocess
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from reliability.world import (
    HELD_OUT,
    SIZES,
    TRAIN,
    Child,
    Outcome,
    episodes,
    folder,
    forged,
    in_child,
    learn,
    new_model,
    reference,
    refusal,
    rng,
    tiny,
    train,
)
from tsmlib.pretrained import ROOT
from tsmlib.storage import artifacts, files
from tsmlib.training.checkpoint import TrainingStopped, load_generation
from tsmlib.training.fit import TrainingOptions, fit
from tsmlib.trajectory import Window


def killed_at_random_moments(trials: int) -> Outcome:
    """R1: SIGKILL 1 to 4 times at random moments of a training, of a model or a policy: the bits of
    one left alone.
    """
    found, kills = Outcome(), 0
    works = [(work, *reference(work)) for work in (train, learn)]
    for trial in range(trials):
        draw, (work, expected, seconds) = rng(1, trial), works[trial % 4 == 3]
        with folder() as place:
            for _ in range(draw.randint(1, 4)):
                child = Child(lambda: work(place / "run"))  # noqa: B023
                child.kill(after=draw.uniform(0, 1.2 * seconds))
                child.result()
                kills += child.killed
            first = in_child(lambda: work(place / "run"))  # noqa: B023
            before = contents(place)
            again = in_child(lambda: work(place / "run"))  # noqa: B023
            found.count(first == expected, f"trial {trial}: other bits")
            found.count(
                again == expected and contents(place) == before,
                f"trial {trial}: a finished run was changed",
            )
    found.note = f"{trials} trainings, a quarter of them of policies, {kills} kills"
    return found


def contents(place: Path) -> dict[str, bytes]:
    """Every file but the lock."""
    return {
        str(path): path.read_bytes()
        for path in place.rglob("*")
        if path.is_file() and path.name != ".lock"
    }


# Faults at one call -------------------------------------------------------------------------------

CALLS = ("fsync", "replace", "mkdir", "unlink", "open")  # of os; and open and write of a file


def at_every_call(every: int = 1) -> Outcome:
    """R2: SIGKILL, ENOSPC and EIO at each call that writes, of the saves that follow step 8: the
    same bits on resuming.

    every: of so many calls one is tried.
    """
    found, (expected, _) = Outcome(), reference()
    points = 0
    with folder() as start:
        stopped_at(start / "run", 9)
        for first, fault in enumerate(("SIGKILL", "ENOSPC", "EIO")):
            for point in range(first % every, 10_000, every):
                with folder() as place:
                    shutil.copytree(start / "run", place / "run")
                    child = Child(lambda: with_fault(place / "run", point, fault))  # noqa: B023
                    good, value = child.result()
                    if value and good:  # the training came to its end before the fault
                        break
                    points += 1
                    text = os.strerror(
                        getattr(errno, fault, 0)
                    )  # where a fault cost something, it is said
                    said = good or child.killed or (str(place / "run") in value and text in value)
                    found.count(said, f"{fault} at call {point}: {value}")
                    found.count(
                        resumes(place / "run", expected),
                        f"{fault} at call {point}: not resumed bit for bit",
                    )
    found.note = f"{points} faults"
    return found


def at_every_system_call(trials: int = 1000) -> Outcome:
    """R2, R3: the same at each system call that writes, by strace; the order write, fsync, rename,
    fsync.
    """
    found = Outcome(note="strace is not installed: not done")
    if shutil.which("strace") is None:
        return found
    (expected, _), points = reference(), 0
    calls = (
        "write,pwrite64,fsync,fdatasync,rename,renameat,renameat2,unlink,unlinkat,mkdir,ftruncate"
    )
    with folder() as start:
        stopped_at(start / "run", 9)
        log = start / "strace.txt"
        shutil.copytree(start / "run", start / "whole")
        traced(
            lambda: train(start / "whole", steps=SIZES["steps"]),
            ["-e", f"trace={calls},openat", "-y"],
            log,
        )
        published = order_of(log.read_text())
        for name, order in published.items():
            found.count(
                re.fullmatch("w+fRd", order),
                f"{name}: {order}, expected write, fsync, rename, fsync (folder)",
            )
        for fault in ("signal=SIGKILL", "error=ENOSPC", "error=EIO"):
            for call in ("write", "fsync", "rename", "unlink", "ftruncate"):
                for k in range(1, trials + 1):
                    with folder() as place:
                        shutil.copytree(start / "run", place / "run")
                        options = ["-e", f"trace={call}", "-e", f"inject={call}:{fault}:when={k}"]
                        child = traced(lambda: train(place / "run"), options, place / "log")
                        if (
                            "(INJECTED)" not in (text := (place / "log").read_text())
                            and "SIGKILL" not in text
                        ):
                            break
                        points += 1
                        found.count(
                            resumes(place / "run", expected),
                            f"{fault} at {call} {k}: other bits ({child})",
                        )
    found.note = f"{points} faults, {len(published)} files published in order"
    return found


def traced(work: Callable[[], Any], options: list[str], log: Path) -> tuple[bool, Any]:
    """The result of ``work`` in a child under strace."""
    reader, writer = os.pipe()

    def when_told() -> Any:
        os.close(writer)
        os.read(reader, 1)
        return work()

    child = Child(when_told)
    os.close(reader)
    command = ["strace", "-f", "-o", str(log), *options, "-p", str(child.pid)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as strace:
        assert strace.stderr is not None
        said = strace.stderr.readline()
        assert "attached" in said, said
        os.write(writer, b"x")
        os.close(writer)
        return child.result()


def order_of(text: str) -> dict[str, str]:
    """For each name that a rename published: w writes to it, f its fsync, R the rename, d the
    folder's fsync after.
    """
    order: dict[str, str] = {}
    waiting: dict[str, str] = {}
    for line in text.splitlines():
        if match := re.search(r"(write|pwrite64)\(\d+<([^>]+\.tmp-[^>]+)>", line):
            waiting[match[2]] = waiting.get(match[2], "") + "w"
        elif match := re.search(r"fsync\(\d+<([^>]+)>", line):
            if ".tmp-" in match[1]:
                waiting[match[1]] = waiting.get(match[1], "") + "f"
            else:
                for name, seen in order.items():
                    if str(Path(name).parent) == match[1] and not seen.endswith("d"):
                        order[name] = seen + "d"
        elif match := re.search(
            r'rename\w*\((?:AT_FDCWD[^"]*)?"([^"]+)", (?:AT_FDCWD[^"]*)?"([^"]+)"', line
        ):
            order[match[2]] = waiting.pop(match[1], "") + "R"
    return order


def stopped_at(checkpoint: Path, step: int) -> None:
    """A checkpoint after ``step`` steps of a training."""

    class Stop(Exception):
        pass

    model = new_model()
    calls = 0

    def loss(window: Window, generator: torch.Generator) -> Tensor:
        nonlocal calls
        calls += torch.is_grad_enabled()
        if calls > step:
            raise Stop
        return model.loss(window, generator)

    with contextlib.suppress(Stop):
        options = TrainingOptions(**SIZES)
        fit(model, TRAIN, HELD_OUT, options, loss, checkpoint=checkpoint, progress=False)
        raise AssertionError("it was not stopped")


def with_fault(checkpoint: Path, point: int, fault: str) -> str:
    """Digest of a training whose call number ``point`` that writes something fails; "" where that
    cost nothing.

    In a child of its own, since calls are patched.
    """
    made = 0

    def count() -> None:
        nonlocal made
        made += 1
        if made == point + 1:
            if fault == "SIGKILL":
                os.kill(os.getpid(), signal.SIGKILL)
            raise OSError(getattr(errno, fault), os.strerror(getattr(errno, fault)))

    def counted(real: Any) -> Any:
        def call(*args: Any, **options: Any) -> Any:
            count()
            return real(*args, **options)

        return call

    class File(io.FileIO):
        write, flush = counted(io.FileIO.write), counted(io.FileIO.flush)

    for name in CALLS:
        setattr(os, name, counted(getattr(os, name)))
    files.open = counted(File)  # type: ignore[attr-defined]
    digest = train(checkpoint)
    return digest if made <= point else ""


def resumes(checkpoint: Path, expected: str) -> bool:
    """Whether a generation is whole, none is refused, and the rest of the training gives the
    expected bits.
    """

    def work() -> str:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert load_generation(checkpoint) is not None
            return train(checkpoint)

    good, value = Child(work).result()
    return good and value == expected


def newest_generation_spoilt(trials: int) -> Outcome:
    """R3: a newest generation that is empty, cut at random, or stale: the one before is used, both
    are named.
    """
    found = Outcome()
    with folder() as place:
        stopped_at(place / "run", 9)
        before, newest = sorted((place / "run").glob("*.safetensors"))
        whole, stale = newest.read_bytes(), before.read_bytes()
        for trial in range(trials):
            spoilt = (b"", whole[: rng(3, trial).randrange(len(whole))], stale)[trial % 3]
            newest.write_bytes(spoilt)
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                used = load_generation(place / "run")
            text = " ".join(str(warning.message) for warning in said)
            found.count(
                used and used[0] == before and str(before) in text and str(newest) in text, text
            )
    return found


# Numbers that are none ----------------------------------------------------------------------------


def values_that_are_not_finite(trials: int) -> Outcome:
    """R8: one NaN or infinity at a random place of a data set: refused, naming episode, step and
    column.
    """
    found, data = Outcome(), TRAIN.take(slice(10))
    fields = {
        "env": data.env,
        "dt": data.dt,
        "names": data.names,
        "units": data.units,
        "angles": data.angles,
    }
    with folder() as place:
        path = place / "data.safetensors"
        for trial in range(trials):
            draw = rng(8, trial)
            arrays = {
                "states": torch.from_numpy(data.states.copy()),
                "actions": torch.from_numpy(data.actions.copy()),
            }
            name = draw.choice(["states", "actions"])
            episode, step, column = (draw.randrange(size) for size in arrays[name].shape)
            arrays[name][episode, step, column] = draw.choice([math.nan, math.inf, -math.inf])
            forged(path, arrays, kind="trajectories", header={"trajectories": fields})
            said = refusal(lambda: artifacts.load_trajectories(path))
            found.count(
                str(path) in said and f"({episode}, {step}, {column})" in said,
                said,
            )
        weights = {name: tensor.clone() for name, tensor in new_model().state_dict().items()}
        for name in weights:
            spoilt = {**weights, name: torch.full_like(weights[name], math.nan)}
            forged(
                path, spoilt, kind="model", header={"class": "TSM", "config": new_model().config()}
            )
            said = refusal(lambda: artifacts.load_model(path, type(new_model())))
            found.count(str(path) in said and name in said, said)
    return found


def losses_that_are_not_finite(trials: int) -> Outcome:
    """R8: a loss or gradient that is not finite at a random step: training stops there, a good
    generation is kept.
    """
    found = Outcome()
    for trial in range(trials):
        draw, model, calls = rng(80, trial), new_model(), 0
        at, in_gradient = draw.randrange(1, SIZES["steps"]), draw.random() < 0.5

        def loss(window: Window, generator: torch.Generator) -> Tensor:
            nonlocal calls
            value = model.loss(window, generator)  # noqa: B023
            if torch.is_grad_enabled():
                calls += 1
                if calls == at + 1:  # noqa: B023
                    first = next(model.parameters())  # noqa: B023
                    cliff = (first - first.detach()).abs().sum().sqrt()  # 0, an infinite slope
                    return value + cliff if in_gradient else value * math.nan  # noqa: B023
            return value

        with folder() as place:
            work = partial(
                fit,
                model,
                TRAIN,
                HELD_OUT,
                TrainingOptions(**SIZES),
                loss,
                checkpoint=place / "run",
                progress=False,
            )
            said = refusal(work, TrainingStopped)
            kept = (load_generation(place / "run") is not None) is (at >= SIZES["validate_every"])
            good = calls == at + 1 and f"at step {at} of" in said and kept
            found.count(good and all(p.isfinite().all() for p in model.parameters()), said)
    return found


# One writer ---------------------------------------------------------------------------------------


def two_writers(trials: int) -> Outcome:
    """R11: three trainings at once in one folder: one writes, the others name it; a killed one's
    lock is free.
    """
    found, (expected, _) = Outcome(), reference()
    for trial in range(trials):
        with folder() as place:
            start = time.monotonic() + 0.05

            def work() -> str:
                time.sleep(max(0.0, start - time.monotonic()))  # noqa: B023
                return train(place / "run", steps=SIZES["steps"])

            children = [Child(work) for _ in range(3)]
            if trial % 3 == 2:
                children[0].kill(after=rng(11, trial).uniform(0.05, 0.3))
            results = [child.result() for child in children]
            pids = [f"pid {child.pid} on" for child in children]
            for good, value in results:
                named = isinstance(value, str) and any(pid in value for pid in pids)
                found.count(good or value is None or named, f"trial {trial}: {value}")
            began = time.monotonic()
            with files.writer_lock(place / "run", "a check"):
                found.count(time.monotonic() - began < 5, f"trial {trial}: the lock was not free")
            end = in_child(lambda: train(place / "run"))
            found.count(end == expected, f"trial {trial}: other bits")
    return found


# A full disk --------------------------------------------------------------------------------------


def full_disk(trials: int = 0) -> Outcome:
    """R10: a full disk while data, a table, figure, video or checkpoint is written: the old file
    stays, it is said.
    """
    from matplotlib.figure import Figure

    from tsmlib import plots as figures

    found, (expected, _) = Outcome(), reference()

    def cramped(work: Callable[[], Any], size: int) -> tuple[bool, Any]:
        def limited() -> Any:
            import resource

            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
            return work()

        return Child(limited).result()

    with folder() as place:
        data, table, picture, film = (
            place / f"x.{kind}" for kind in ("safetensors", "csv", "png", "mp4")
        )
        writers: dict[Path, Callable[[], Any]] = {
            data: lambda: artifacts.save_trajectories(data, TRAIN),
            table: lambda: files.write_bytes(table, 200 * b"metric,value\n"),
            picture: lambda: figures.save(Figure(), place / "x.png"),
        }
        for path, write in writers.items():
            write()
            before = path.read_bytes()
            for size in (0, 1, 1000, len(before) - 1):
                good, said = cramped(write, size)
                clear = (
                    not good
                    and str(path) in said
                    and f"{len(before)} bytes" in said
                    and "too large" in said
                )
                found.count(
                    clear and path.read_bytes() == before, f"{path.name}, {size} bytes: {said}"
                )
        frames = np.zeros((3, 64, 64, 3), np.uint8)
        figures.save_video(frames, film)
        before = film.read_bytes()
        good, said = cramped(lambda: figures.save_video(frames, film), 1000)
        found.count(not good and str(film) in said and film.read_bytes() == before, said)
        stopped_at(place / "run", 9)
        good, said = cramped(lambda: train(place / "run"), 1000)
        found.count(not good and "StoreError: cannot write" in said, said)
        found.count(resumes(place / "run", expected), "not resumed bit for bit")
        found.count(not list(place.rglob(".*.tmp-*")), "half a file is left")
    return found


# In a notebook ------------------------------------------------------------------------------------


def interrupted_in_a_cell(trials: int) -> Outcome:
    """R15: SIGINT at a random moment of a cell that trains; the cell runs again, and ends with the
    same bits.
    """
    found, (expected, _) = Outcome(), reference()
    tests = Path(__file__).resolve().parent.parent
    with kernel() as (manager, client):
        run(client, f"import sys; sys.path[:0] = [{str(tests)!r}, {str(tests.parent)!r}]")
        run(client, "import torch; from pathlib import Path; from reliability.world import train")
        run(client, "torch.set_num_threads(1); train(None)")
        began = time.monotonic()
        run(client, "train(None)")
        seconds, slowest, stopped = time.monotonic() - began, 0.0, 0
        for trial in range(trials):
            with folder() as place:
                cell = f"digest = train(Path({str(place / 'run')!r})); digest"
                request = client.execute(cell)
                time.sleep(rng(15, trial).uniform(0, 1.2 * seconds))
                sent = time.monotonic()
                manager.interrupt_kernel()
                reply = answer(client, request)
                slowest = max(slowest, time.monotonic() - sent)
                stopped += reply["status"] != "ok"
                fine = reply["status"] == "ok" or reply["ename"] == "KeyboardInterrupt"
                found.count(fine, f"trial {trial}: {reply.get('ename')}: {reply.get('evalue')}")
                run(client, "pass")  # whatever of the signal was left
                found.count(run(client, cell) == repr(expected), f"trial {trial}: other bits")
        found.count(slowest < 5, f"the prompt came back after {slowest:.1f} s")
        found.note = f"{stopped} of {trials} stopped, prompt back within {slowest:.2f} s"
    return found


@contextlib.contextmanager
def kernel(**environment: str) -> Iterator[tuple[Any, Any]]:
    """Manager and client of a kernel in the folder of the notebooks."""
    from jupyter_client.manager import start_new_kernel

    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": str(ROOT),
        **environment,
    }
    options = dict(env=environment, cwd=str(ROOT), stderr=subprocess.DEVNULL)
    manager, client = start_new_kernel(kernel_name="python3", **options)
    try:
        yield manager, client
    finally:
        client.stop_channels()
        manager.shutdown_kernel(now=True)


def answer(client: Any, request: str) -> dict[str, Any]:
    """The reply to a request, once the kernel is idle again."""
    while True:
        reply = client.get_shell_msg(timeout=3600)
        if reply["parent_header"].get("msg_id") == request:
            return reply["content"]


def printed(client: Any, cell: str) -> tuple[dict[str, Any], str]:
    """The reply to a cell, and what it prints."""
    found: list[str] = []

    def hook(message: dict[str, Any]) -> None:
        if message["msg_type"] == "stream":
            found.append(message["content"]["text"])

    reply = client.execute_interactive(
        cell, output_hook=hook, timeout=3600, stop_on_error=False
    )  # nor the next one
    return reply["content"], "".join(found)


def run(client: Any, cell: str) -> str:
    """The value that a cell shows."""
    shown: list[str] = []

    def hook(message: dict[str, Any]) -> None:
        if message["msg_type"] == "execute_result":
            shown.append(message["content"]["data"]["text/plain"])

    client.execute_interactive(cell, output_hook=hook, timeout=3600)
    return "".join(shown)


# Memory -------------------------------------------------------------------------------------------


def memory(trials: int) -> Outcome:
    """R16: resident memory over ``trials`` training steps, sampled after a tenth of them: at most 1
    MB per 1,000.
    """
    found, model, data = Outcome(), new_model(tiny), episodes(30, 0)
    samples: list[tuple[int, float]] = []
    page = os.sysconf("SC_PAGE_SIZE") / 1e6
    calls = 0

    def loss(window: Window, generator: torch.Generator) -> Tensor:
        nonlocal calls
        calls += 1
        if calls % max(1, trials // 50) == 0 and calls > trials / 10:
            samples.append((calls, page * int(Path("/proc/self/statm").read_text().split()[1])))
        return model.loss(window, generator)

    with folder() as place:
        open_before = len(os.listdir("/proc/self/fd"))
        options = TrainingOptions(
            **{
                **SIZES,
                "past_len": model.past_len,
                "steps": trials,
                "validate_every": max(1, trials // 20),
            }
        )
        fit(model, data, HELD_OUT, options, loss, checkpoint=place / "run", progress=False)
        steps, megabytes = np.array(samples).T
        slope = 1000 * np.polyfit(steps, megabytes, 1)[0]
        found.count(slope <= 1.0, f"{slope:.2f} MB per 1,000 steps")
        found.count(
            megabytes[-1] <= 1.05 * megabytes[0],
            f"from {megabytes[0]:.0f} to {megabytes[-1]:.0f} MB",
        )
        found.count(abs(len(os.listdir("/proc/self/fd")) - open_before) <= 2, "files are left open")
        found.count(
            len(list((place / "run").glob("*.safetensors"))) == 2, "more than two generations"
        )
        found.note = f"{trials} steps, {slope:+.3f} MB per 1,000"
    return found
