"""Data and models that train in a fraction of a second, and child processes that may be killed."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import pickle
import random
import signal
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from torch import Tensor
from tqdm.auto import tqdm

from tsmlib.models.baselines import OneStep
from tsmlib.models.tsm import TSM
from tsmlib.policies.learning import LearningOptions, episodes_from, learn_policy
from tsmlib.policies.networks import OneStepPolicy
from tsmlib.rewards import Reward
from tsmlib.storage import artifacts, files
from tsmlib.training.checkpoint import load_generation
from tsmlib.training.fit import TrainingOptions, fit
from tsmlib.trajectory import Trajectories

H = 4
SIZES: dict[str, Any] = dict(
    past_len=H, future_len=H, steps=24, batch_size=8, validate_every=4, warmup=3
)


@dataclass
class Outcome:
    """How many trials went as they should, of how many; ``wrong`` describes the others, ``note``
    what was measured.
    """

    right: int = 0
    of: int = 0
    wrong: list[str] = field(default_factory=list)
    note: str = ""

    def count(self, good: object, what: str = "") -> None:
        """Note one trial."""
        self.of += 1
        self.right += bool(good)
        if not good:
            self.wrong.append(what)

    def add(self, other: Outcome) -> None:
        """Take over the trials of another."""
        self.of, self.right, self.wrong = (
            self.of + other.of,
            self.right + other.right,
            self.wrong + other.wrong,
        )

    def check(self) -> Outcome:
        """Fail unless all trials went as they should."""
        assert self.of, "nothing was tried"
        assert self.right == self.of, f"{self.right} of {self.of}; {self.wrong[:5]}"
        return self


@contextlib.contextmanager
def folder() -> Iterator[Path]:
    """An empty folder in memory where there is such a thing, since many small files are written."""
    fast = Path("/dev/shm")
    with tempfile.TemporaryDirectory(
        dir=fast if os.access(fast, os.W_OK) else None, prefix="tsmlib-"
    ) as name:
        yield Path(name)


def episodes(n: int, seed: int) -> Trajectories:
    """States that drift with the actions and with some noise."""
    rng = np.random.default_rng(seed)
    actions = np.repeat(rng.uniform(-1, 1, (n, 6, 2)), 5, axis=1)
    steps = 0.2 * actions @ np.array([[1.0, 0.3, -0.5], [0.2, -1.0, 0.4]]) + 0.05 * rng.normal(
        size=(n, 30, 3)
    )
    states = np.concatenate([np.zeros((n, 1, 3)), steps.cumsum(1)], 1)
    return Trajectories(
        states.astype(np.float32),
        actions.astype(np.float32),
        "tsm/Made-v0",
        0.02,
        ("a", "b", "c"),
        ("rad", "m", "m"),
        (0,),
    )


TRAIN, HELD_OUT = episodes(30, 0), episodes(5, 1)


def small() -> TSM:
    """A temporal segment model that trains fast."""
    return TSM(3, 2, angles=(0,), segment_len=H, channels=8, dilations=(1, 2))


def tiny() -> OneStep:
    """What trains fastest."""
    return OneStep(3, 2, angles=(0,), hidden=8, layers=1)


def new_model(make: Callable[[], Any] = small) -> Any:
    """The same small weights every time."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = make()
    model.features.fit(TRAIN)
    return model


def train(checkpoint: Path | None, loss: Any = None, **settings: Any) -> str:
    """Train to the end and give a digest of weights, curve and, with a checkpoint, everything in
    it.
    """
    model = new_model()
    options = TrainingOptions(**{**SIZES, **settings})
    curve = fit(model, TRAIN, HELD_OUT, options, loss, checkpoint=checkpoint, progress=False)
    return outcome_digest(model, curve, checkpoint)


def learn(checkpoint: Path | None) -> str:
    """The same of a policy, in a model that is not trained."""

    def near(target: Tensor) -> Reward:
        return lambda states, actions: -(states[..., 1:] - target[:, None]).square().sum(-1)

    policy, model = OneStepPolicy(3, 2, angles=(0,), hidden=8), new_model(tiny)
    starts = episodes_from(torch.from_numpy(TRAIN.states[:, 0]))
    options = LearningOptions(horizon=6, episodes=4, iterations=24, record_every=4)
    curve = learn_policy(policy, model, near, starts, options, checkpoint=checkpoint)
    return outcome_digest(policy, curve, checkpoint)


def outcome_digest(model: torch.nn.Module, curve: Any, checkpoint: Path | None) -> str:
    """SHA-256 over the weights, the curve without its times, and weights and Adam's moments of the
    last generation.
    """
    noted = {name: value for name, value in asdict(curve).items() if name != "seconds"}
    parts = [artifacts.digest(model.state_dict()), json.dumps(noted)]
    if checkpoint is not None:
        found = load_generation(checkpoint)
        assert found is not None
        parts.append(artifacts.digest(found[1]))
    return hashlib.sha256("".join(parts).encode()).hexdigest()


def reference(work: Callable[[Path], str] = train) -> tuple[str, float]:
    """The digest of a training that nobody disturbed, and its seconds."""
    with folder() as place:
        work(place / "once")  # what torch makes ready once, children need not make again
        began = time.perf_counter()
        value = in_child(lambda: work(place / "whole"))
        return value, time.perf_counter() - began


# Children -----------------------------------------------------------------------------------------


class Child:
    """A forked process that computes one thing; it may be killed at any time."""

    def __init__(self, work: Callable[[], Any]) -> None:
        reader, writer = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            status = 1
            try:
                os.close(reader)
                signal.signal(signal.SIGINT, signal.default_int_handler)
                torch.set_num_threads(1)  # the threads of the parent are not here
                tqdm.set_lock(
                    threading.RLock()
                )  # a child that is killed keeps the one that all share
                warnings.simplefilter("ignore")
                try:
                    found = (True, work())
                except BaseException as error:
                    found = (False, f"{type(error).__name__}: {error}")
                with os.fdopen(writer, "wb") as pipe:
                    pickle.dump(found, pipe)
                status = 0
            finally:
                os._exit(status)
        os.close(writer)
        self._reader = reader
        self.killed = False

    def kill(self, after: float = 0.0, number: int = signal.SIGKILL) -> None:
        """Send a signal, ``after`` seconds from now, unless it is over by then."""
        end = time.monotonic() + after
        while time.monotonic() < end:
            if self._over():
                return
            time.sleep(min(0.002, max(0.0, end - time.monotonic())))
        os.kill(self.pid, number)

    def result(self) -> tuple[bool, Any]:
        """(True, value), (False, error), or (False, None) where it was killed."""
        with os.fdopen(self._reader, "rb") as pipe:
            data = pipe.read()
        _, status = os.waitpid(self.pid, 0)
        self.killed = os.WIFSIGNALED(status)
        return pickle.loads(data) if data and not self.killed else (False, None)

    def _over(self) -> bool:
        return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def in_child(work: Callable[[], Any]) -> Any:
    """The value of ``work``, computed elsewhere."""
    good, value = Child(work).result()
    if not good:
        raise RuntimeError(f"the child failed: {value}")
    return value


# Artefacts ----------------------------------------------------------------------------------------


def forged(
    path: Path, arrays: dict[str, torch.Tensor], *, kind: str, header: Any, **about: Any
) -> None:
    """An artefact whose checksum holds, whatever is in it: not damage, but the work of somebody."""
    said = {"sha256": "0" * 64, "schema": artifacts.SCHEMA, "kind": kind, "header": header, **about}
    text = json.dumps(said, separators=(",", ":"))
    data = safetensors.torch.save(arrays, metadata={"tsmlib": text})
    mark = rb'"tsmlib":"{\"sha256\":\"'
    at = data.index(mark) + len(mark)
    digest = hashlib.sha256(data).hexdigest().encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data[:at] + digest + data[at + 64 :])


def artefacts(place: Path) -> dict[str, tuple[Path, Callable[[], Any]]]:
    """One file of each kind, and what loads it."""
    data, model = place / "data.safetensors", place / "model.safetensors"
    artifacts.save_trajectories(data, TRAIN.take(slice(3)), {"seed": 1})
    artifacts.save_model(model, new_model(), {"fingerprint": {"env": "tsm/Made-v0"}})
    checkpoint = place / "run.checkpoint"
    train(checkpoint, steps=4)
    (generation,) = checkpoint.glob("*.safetensors")
    task = place / "task.safetensors"
    arrays = {"start": torch.zeros(3, 6), "target": torch.ones(3, 2)}
    artifacts.save(task, arrays, kind="task", header={"task": "reach"})
    return {
        "dataset": (data, lambda: artifacts.load_trajectories(data)),
        "model": (model, lambda: artifacts.load_model(model, TSM)),
        "checkpoint": (generation, lambda: load_generation(checkpoint)),
        "task": (task, lambda: artifacts.load(task, kind="task")),
    }


def refusal(work: Callable[[], Any], kind: type[Exception] = files.StoreError) -> str:
    """The message of the error that ``work`` must raise; '' where it raises none."""
    try:
        work()
    except kind as error:
        return str(error)
    return ""


def rng(*seed: int) -> random.Random:
    """Draws of one trial."""
    return random.Random(repr(seed))
