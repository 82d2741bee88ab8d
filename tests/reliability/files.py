"""R4-R7, R9, R13, R27: refusal of files and parameters that are damaged, forged, mixed up or made
up at random.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import resource
import signal
import sys
import tarfile
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from reliability.world import (
    TRAIN,
    Child,
    Outcome,
    artefacts,
    folder,
    forged,
    in_child,
    new_model,
    refusal,
    rng,
)
from tsmlib.contrib.minari import load_minari
from tsmlib.envs import fingerprint
from tsmlib.envs.spec import ENV_IDS
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.baselines import LSTM, OneStep
from tsmlib.models.ensemble import Ensemble
from tsmlib.models.tsm import TSM
from tsmlib.policies.networks import OneStepPolicy, SegmentPolicy
from tsmlib.storage import artifacts
from tsmlib.storage.files import StoreError
from tsmlib.trajectory import Trajectories, TrajectoryError

try:
    import h5py
except ImportError:
    h5py = None

OURS = (StoreError, TrajectoryError)  # all that a reader may meet


# Damage -------------------------------------------------------------------------------------------


def damage(trials: int) -> Outcome:
    """R4: flipped bits in each kind of file, a quarter as many cuts, a tenth appends, a twentieth
    zeroed blocks.

    Each load happens in a child with an alarm of 20 s and 4 GB of memory more than it has.
    """
    found = Outcome()
    with folder() as place:
        kinds = artefacts(place)
        for kind, (path, load) in kinds.items():
            good, value = Child(lambda: damaged(kind, path, load, trials)).result()  # noqa: B023
            if good:
                found.add(value)
            else:
                found.count(False, f"{kind}: the child died: {value}")
        found.note = f"{len(kinds)} kinds of file"
    return found


def damaged(kind: str, path: Path, load: Callable[[], Any], trials: int) -> Outcome:
    """Loads of one file in every damaged form. The name of the file must be in the message."""
    little_memory()
    signal.signal(signal.SIGALRM, signal.SIG_DFL)  # a hang is a death
    warnings.simplefilter("ignore")
    found, data = Outcome(), path.read_bytes()
    load()
    for what, spoilt in spoils(data, trials):
        if spoilt == data:
            continue
        path.write_bytes(spoilt)
        signal.alarm(20)
        found.count(*named(kind, path, load, what))
        signal.alarm(0)
    path.write_bytes(data)
    load()
    return found


def named(kind: str, path: Path, load: Callable[[], Any], what: str) -> tuple[bool, str]:
    """Whether ``load`` is refused by one of our errors, with the name of the file (or for a status,
    of its run).
    """
    try:
        load()
        return False, f"{kind}, {what}: accepted"
    except StoreError as error:
        return path.name in str(error) or kind == "status", f"{kind}, {what}: {error}"
    except Exception as error:
        return False, f"{kind}, {what}: {error!r}"


def little_memory() -> None:
    """A limit of 4 GB more memory than this process has."""
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + 4 * 2**30, resource.RLIM_INFINITY))


def spoils(data: bytes, trials: int) -> Iterator[tuple[str, bytes]]:
    """Spoilt copies of a file. Half of the flips fall into the first 2 KiB, where structure is."""
    draw = rng(4, len(data))
    for trial in range(trials):
        bit = draw.randrange(8 * (min(len(data), 2048) if trial % 2 else len(data)))
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        yield f"bit {bit} flipped", bytes(flipped)
    for _ in range(trials // 4):
        length = draw.randrange(len(data))
        yield f"cut to {length}", data[:length]
    for _ in range(trials // 10):
        tail = draw.choice([b"\0", b"\n", b" ", b"}", draw.randbytes(16), data[:64], data])
        yield f"{len(tail)} appended", data + tail
    for _ in range(max(1, trials // 20)):
        start, size = draw.randrange(len(data)), 4096
        yield (
            f"zeroed at {start}",
            data[:start] + bytes(min(size, len(data) - start)) + data[start + size :],
        )


# Malice -------------------------------------------------------------------------------------------


class Payload:
    """An object that makes a folder when it is unpickled."""

    def __init__(self, canary: Path) -> None:
        self.canary = canary

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.canary),)


def hostile_files(place: Path) -> dict[str, bytes]:
    """Files that execute or unpack something in a loader that trusts what it reads."""
    canary = place / "canary"
    payload, kinds = Payload(canary), {}
    for protocol in (0, 2, 5):
        kinds[f"pickle {protocol}"] = pickle.dumps({"weights": payload}, protocol)
    code = f"__import__('os').mkdir({str(canary)!r})"
    kinds["eval"] = b"c__builtin__\neval\n(S" + repr(code).encode() + b"\ntR."
    kinds["exec"] = b"c__builtin__\nexec\n(S" + repr(code).encode() + b"\ntR."
    kinds["os.system"] = b"cposix\nsystem\n(S'mkdir " + str(canary).encode() + b"'\ntR."
    for legacy in (False, True):
        buffer = io.BytesIO()
        torch.save(
            {"w": torch.ones(2), "x": payload}, buffer, _use_new_zipfile_serialization=not legacy
        )
        kinds[f"torch.save, {'legacy' if legacy else 'zip'}"] = buffer.getvalue()
    buffer = io.BytesIO()
    np.save(buffer, np.array([payload], dtype=object), allow_pickle=True)
    kinds["object .npy"] = buffer.getvalue()
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=True, a=np.array([payload], dtype=object))
    kinds["object .npz"] = buffer.getvalue()
    kinds["yaml"] = f"!!python/object/apply:os.mkdir ['{canary}']".encode()
    kinds["json class"] = json.dumps(
        {"__class__": "os.system", "args": [f"mkdir {canary}"]}
    ).encode()
    kinds["python"] = f"import os; os.mkdir({str(canary)!r})".encode()
    for name, member in {
        "zip ../": "../canary",
        "zip absolute": str(canary),
        "zip drive": "C:\\canary",
        "zip nul": "a\0b",
        "zip twice": "x",
    }.items():
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            archive.writestr(member, "out")
            archive.writestr(member, "again")
        kinds[name] = buffer.getvalue()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bomb", bytes(50_000_000))
    kinds["zip bomb"] = buffer.getvalue()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for i in range(11_000):
            archive.writestr(str(i), "")
    kinds["zip of 11,000"] = buffer.getvalue()
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        link = tarfile.TarInfo("link")
        link.type, link.linkname = tarfile.SYMTYPE, str(place)
        archive.addfile(link)
        archive.addfile(tarfile.TarInfo("link/canary"))
    kinds["tar with a link"] = buffer.getvalue()
    kinds["header of 2^63"] = (2**63).to_bytes(8, "little") + b"{}"
    kinds["deep json"] = (100_000).to_bytes(8, "little") + b"[" * 100_000
    return kinds


def malice(trials: int = 0) -> Outcome:
    """R5, R7: pickles, code, archives under the names of artefacts: refused in 2 s, nothing
    executed or unpacked.
    """
    return in_child(_malice)  # since an audit hook stays


def _malice() -> Outcome:
    found, seen = Outcome(), []

    def hook(event: str, _: tuple[Any, ...]) -> None:
        if event.startswith(
            ("pickle.", "os.system", "os.exec", "os.posix_spawn", "subprocess.", "socket.")
        ):
            seen.append(event)

    with folder() as place:
        kinds = hostile_files(place)
        for kind, (path, load) in artefacts(place).items():
            data = path.read_bytes()
            if not seen:
                sys.addaudithook(hook)
                seen.append("listening")
            for name, hostile in kinds.items():
                path.write_bytes(hostile)
                began = time.process_time()
                good, said = named(kind, path, load, name)
                found.count(
                    good and time.process_time() - began < 10 and not (place / "canary").exists(),
                    said,
                )
            path.write_bytes(data)
        found.count(seen == ["listening"], f"events: {seen[:5]}")
        found.note = f"{len(kinds)} files under the names of {found.of // len(kinds)} artefacts"
    return found


def minari_of(name: str, data: Trajectories) -> Path:
    """The folder of a data set of these episodes that Minari itself wrote."""
    import minari
    from gymnasium.spaces import Box

    episodes = []
    for x, u in map(data.episode, range(len(data))):
        last = np.arange(len(u)) == len(u) - 1
        about = dict(rewards=np.zeros(len(u)), terminations=last & False, truncations=last)
        episodes.append(minari.data_collector.EpisodeBuffer(observations=x, actions=u, **about))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = minari.create_dataset_from_buffers(
            name,
            episodes,
            observation_space=Box(-np.inf, np.inf, (data.robot.state_dim,)),
            action_space=Box(-1, 1, (data.robot.action_dim,)),
        )
    return Path(made.spec.data_path).parent


def hostile_minari(trials: int = 0) -> Outcome:
    """R6: Minari data sets that point elsewhere, lie about size or name code: refused or read
    harmlessly, in 2 s.

    Harmlessly: what is loaded is what the file itself holds, and nothing was executed.
    """
    found = Outcome()
    with folder() as place, mock.patch.dict(os.environ, MINARI_DATASETS_PATH=str(place)):
        whole = minari_of("tsm/made/random-v0", TRAIN)
        found.count(*harmless(whole, TRAIN, "a whole one", refused=False))
        one = minari_of("tsm/made/one-v0", TRAIN.take(slice(1)))
        file, metadata = one / "data" / "main_data.hdf5", one / "data" / "metadata.json"
        good, stated = file.read_bytes(), json.loads(metadata.read_text())
        for name, make in hostile_hdf5(place).items():
            file.write_bytes(good)
            with h5py.File(file, "a") as root:
                group = root["episode_0"]
                if name not in HARMLESS:
                    del group["observations"]
                make(group)
            found.count(*harmless(one, TRAIN.take(slice(1)), name, refused=name not in HARMLESS))
        file.write_bytes(good)
        specification = json.dumps(
            {
                "id": "Evil-v0",
                "entry_point": "os:mkdir",
                "additional_wrappers": [],
                "kwargs": {"path": str(place / "canary")},
            }
        )
        space = json.loads(stated["observation_space"])
        changes: dict[str, dict[str, Any]] = {
            "an entry point": {"env_spec": specification, "observation_space": None},
            "episodes without end": {"total_episodes": 10**12},
            "arrow": {"data_format": "arrow"},
            "a format that is a path": {"data_format": "../../canary"},
            "deep json": {"observation_space": "[" * 100_000},
            "a dictionary": {
                "observation_space": json.dumps({"type": "Dict", "subspaces": {"x": space}})
            },
            "a text": {
                "action_space": json.dumps(
                    {"type": "Text", "max_length": 10**9, "low": [], "high": []}
                )
            },
            "a large box": {
                "observation_space": json.dumps({**space, "shape": [10**9], "low": -1, "high": 1})
            },
            "a large type": {"observation_space": json.dumps({**space, "dtype": "S1000000000"})},
            "another version": {"minari_version": "99.0"},
        }
        for name, change in changes.items():
            said = {
                word: value for word, value in {**stated, **change}.items() if value is not None
            }
            metadata.write_text(json.dumps(said))
            found.count(*harmless(one, TRAIN, name))
        metadata.write_text(json.dumps({**stated, "env_spec": specification}))
        found.count(
            *harmless(one, TRAIN.take(slice(1)), "an entry point beside spaces", refused=False)
        )
        found.count(not (place / "canary").exists(), "something was executed")
        draw, path = rng(6), whole / "data" / "main_data.hdf5"
        data = path.read_bytes()
        for _ in range(max(30, trials)):  # and what an accident makes of a good one
            path.write_bytes(data[: draw.randrange(len(data))])
            found.count(*harmless(whole, TRAIN, "cut"))
        found.note = f"{len(hostile_hdf5(place)) + len(changes) + 1} hostile data sets"
    return found


HARMLESS = (
    "a group within itself",
    "one object twice",
    "50 groups deep",
    "10,000 groups",
    "a long attribute",
)


def hostile_hdf5(place: Path) -> dict[str, Callable[[Any], Any]]:
    """What may stand in the place of an episode's observations (31, 3), or, if harmless, beside
    them.
    """
    secret, other = place / "secret.bin", place / "other.h5"
    secret.write_bytes(np.full((31, 3), 1234.5).tobytes())
    with h5py.File(other, "w") as file:
        file["x"] = np.full((31, 3), 1234.5)

    def put(name: str = "observations", **options: Any) -> Callable[[Any], Any]:
        return lambda group: group.create_dataset(name, **options)

    def linked(link: Any) -> Callable[[Any], Any]:
        return lambda group: group.__setitem__("observations", link)

    def virtual(group: Any) -> None:
        layout = h5py.VirtualLayout((31, 3), "f8")
        layout[:] = h5py.VirtualSource(str(other), "x", (31, 3))
        group.create_virtual_dataset("observations", layout)

    def unknown_filter(group: Any) -> None:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((31, 3))
        plist.set_filter(32001, h5py.h5z.FLAG_OPTIONAL, ())  # blosc
        space = h5py.h5s.create_simple((31, 3))
        data = h5py.h5d.create(group.id, b"observations", h5py.h5t.IEEE_F32LE, space, plist)
        data.write_direct_chunk((0, 0), b"packed")

    def linked_episode(group: Any) -> None:
        root = group.file
        del root["episode_0"]
        root["episode_0"] = h5py.ExternalLink(str(other), "/")

    fields = np.zeros((31, 3), [("a", "f4"), ("b", "i4")])
    return {
        "external storage": put(
            shape=(31, 3), dtype="f8", external=[(str(secret), 0, secret.stat().st_size)]
        ),
        "external link": linked(h5py.ExternalLink(str(other), "/x")),
        "soft link": linked(h5py.SoftLink("/elsewhere")),
        "soft link to itself": linked(h5py.SoftLink("/episode_0/observations")),
        "virtual": virtual,
        "compound": put(data=fields),
        "texts": put(shape=(31, 3), dtype=h5py.string_dtype()),
        "references": put(shape=(31, 3), dtype=h5py.ref_dtype),
        "3.6 TiB declared": put(shape=(10**9, 1000), dtype="f4", chunks=(1000, 1000)),
        "gzip bomb": put(data=np.zeros((10**6, 3)), compression="gzip", fletcher32=True),
        "unknown filter": unknown_filter,
        "no shape": put(data=1.0),
        "no numbers": put(data=np.full((31, 3), np.nan)),
        "a named type": linked(np.dtype("f4")),
        "a group": lambda group: group.create_group("observations"),
        "nothing": lambda group: None,
        "a linked episode": linked_episode,
        "two episodes": lambda group: group.file.create_group("episode_1"),
        "a group within itself": lambda group: group.__setitem__("again", group),
        "one object twice": lambda group: group.__setitem__("copy", group["observations"]),
        "50 groups deep": lambda group: group.create_group("/".join("g" * 50)),
        "10,000 groups": lambda group: [group.create_group(f"g{i}") for i in range(10_000)],
        "a long attribute": lambda group: group.attrs.__setitem__("text", "x" * 60_000),
    }


def harmless(
    place: Path, data: Trajectories, name: str, *, refused: bool = True
) -> tuple[bool, str]:
    """Whether a data set is refused, or loaded as ``data``, in time, in words, and in little
    memory.
    """
    about = {word: getattr(data, word) for word in ("env", "dt", "names", "units", "angles")}
    began, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        fine = np.array_equal(load_minari(place, **about).states, data.states) and not refused
        said = "accepted"
    except StoreError as error:
        said, fine = str(error), refused and str(place) in str(error)
    except Exception as error:
        said, fine = repr(error), False
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    size = sum(path.stat().st_size for path in (place / "data").iterdir())
    fine = fine and time.process_time() - began < 10 and grown < 200e6 + 3 * size
    return fine, f"{name}: {said} ({grown / 1e6:.0f} MB)"


# What does not belong together --------------------------------------------------------------------

OTHERWISE: dict[str, Any] = {
    "dt": 0.01,
    "names": [f"x{i}" for i in range(6)],
    "units": ["rad"] * 2 + ["cm"] * 4,
    "angles": [0],
    "noise": 0.25,
    "delay": 3,
    "simulator": "0" * 64,
    "segment_len": 5,
}


def mismatched(trials: int = 0) -> Outcome:
    """R9: data and models of each environment asked for as another's, and with each field of the
    fingerprint off.
    """
    found = Outcome()
    with folder() as place:
        data, model = place / "data.safetensors", place / "model.safetensors"
        prints = {env: {**fingerprint(env), "segment_len": 4} for env in ENV_IDS}
        off = {name: {**prints[ENV_IDS[0]], name: value} for name, value in OTHERWISE.items()}
        for name, stated in {**prints, **off}.items():
            size = len(stated["names"])
            fields = {word: stated[word] for word in ("env", "dt", "names", "units", "angles")}
            arrays = {"states": torch.zeros(2, 6, size), "actions": torch.zeros(2, 5, 2)}
            about: dict[str, Any] = {"trajectories": fields, "fingerprint": stated}
            artifacts.save(data, arrays, kind="trajectories", header=about)
            artifacts.save_model(model, new_model(), {"fingerprint": stated})
            asked = prints.items() if name in prints else [(ENV_IDS[0], prints[ENV_IDS[0]])]
            for env, expected in asked:
                loads: dict[Path, Callable[[], Any]] = {
                    data: lambda: artifacts.load_trajectories(data, expect=expected),  # noqa: B023
                    model: lambda: artifacts.load_model(model, TSM, expect=expected),  # noqa: B023
                }
                for path, load in loads.items():
                    said = refusal(load)
                    if env == name:
                        found.count(not said, said)
                    else:
                        field = "env" if name in prints else name
                        both = repr(stated[field]) in said and repr(expected[field]) in said
                        found.count(
                            both and path.name in said, f"{path.stem} {name} as {env}: {said}"
                        )
    return found


# Sizes ---------------------------------------------------------------------------------------


def sizes(trials: int = 0) -> Outcome:
    """R5: models whose files claim more than they hold, in a process with little memory."""

    def claimed() -> Outcome:
        with folder() as place:
            return greedy(place)

    return in_child(claimed)


def greedy(place: Path) -> Outcome:
    """Models of a few kilobytes, one of whose sizes is a thousand million: refused before they take
    memory.
    """
    found, path = Outcome(), place / "greedy.safetensors"
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    little_memory()
    prior = ActionPrior(2, segment_len=4, channels=8, dilations=(1, 2))
    models = [
        new_model(),
        OneStep(3, 2, hidden=8),
        LSTM(3, 2, hidden=8),
        Ensemble(3, 2, hidden=8),
        prior,
        OneStepPolicy(3, 2, hidden=8),
        SegmentPolicy(3, prior, channels=8),
    ]

    def ask(model: Any, **changed: Any) -> str:
        header = {"class": type(model).__name__, "config": {**model.config(), **changed}}
        forged(path, model.state_dict(), kind="model", header=header)
        return refusal(lambda: artifacts.load_model(path, type(model)))

    for model in models:
        found.count(not ask(model), f"{type(model).__name__} was not read")
        for name in model.config():
            for huge in (10**9, [10**9], [1] * 20_000, {"action_dim": 10**9}):
                said = ask(model, **{name: huge})
                grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
                good = path.name in said and "at most" in said and grown < 100
                found.count(
                    good, f"{type(model).__name__}, {name} {huge!r:.30}: {grown:.0f} MB, {said}"
                )
    began = time.process_time()
    said = ask(models[3], members=10_000, layers=10_000)
    found.count("larger than its file" in said and time.process_time() - began < 10, said)
    return found
