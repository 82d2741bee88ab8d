"""R4-R7, R9, R13, R27: what was damaged, forged, mixed up or made up at random is refused in words."""

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

import numpy as np
import torch

from reliability.world import TRAIN, Child, Outcome, artefacts, folder, forged, in_child, new_model, refusal, rng
from tsmlib.envs import fingerprint
from tsmlib.envs.spec import ENV_IDS
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.baselines import LSTM, OneStep
from tsmlib.models.ensemble import Ensemble
from tsmlib.models.tsm import TSM
from tsmlib.policies.networks import OneStepPolicy, SegmentPolicy
from tsmlib.storage import artifacts, files, manifest
from tsmlib.storage.files import StoreError
from tsmlib.storage.minari import load_minari
from tsmlib.study import parameters, runs
from tsmlib.study.parameters import ParameterError
from tsmlib.study.runs import RunError
from tsmlib.trajectory import TrajectoryError

OURS = (StoreError, ParameterError, RunError, TrajectoryError)  # all that a reader may meet


# Damage --------------------------------------------------------------------------------------------------------------


def damage(trials: int) -> Outcome:
    """R4: of each kind of file flipped bits, a quarter as many cuts, a tenth appends, a twentieth zeroed blocks.

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
    """Every damage to one file. The name of the file must be in the message."""
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
        try:
            load()
            found.count(False, f"{kind}, {what}: accepted")
        except StoreError as error:
            found.count(path.name in str(error), f"{kind}, {what}: {error}")
        except RunError as error:  # of a status that is not to be trusted
            found.count(kind == "status", f"{kind}, {what}: {error}")
        except Exception as error:
            found.count(False, f"{kind}, {what}: {error!r}")
        finally:
            signal.alarm(0)
    path.write_bytes(data)
    load()
    return found


def little_memory() -> None:
    """Let this process take 4 GB more than it has."""
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + 4 * 2**30, resource.RLIM_INFINITY))


def spoils(data: bytes, trials: int) -> Iterator[tuple[str, bytes]]:
    """What happens to files. Half of the flips fall into the first 2 KiB, where structure is."""
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
        yield f"zeroed at {start}", data[:start] + bytes(min(size, len(data) - start)) + data[start + size :]


# Malice --------------------------------------------------------------------------------------------------------------


class Payload:
    """Makes a file when it is unpickled."""

    def __init__(self, canary: Path) -> None:
        self.canary = canary

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.canary),)


def hostile_files(place: Path) -> dict[str, bytes]:
    """Files that do something when a careless loader meets them."""
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
        torch.save({"w": torch.ones(2), "x": payload}, buffer, _use_new_zipfile_serialization=not legacy)
        kinds[f"torch.save, {'legacy' if legacy else 'zip'}"] = buffer.getvalue()
    buffer = io.BytesIO()
    np.save(buffer, np.array([payload], dtype=object), allow_pickle=True)
    kinds["object .npy"] = buffer.getvalue()
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=True, a=np.array([payload], dtype=object))
    kinds["object .npz"] = buffer.getvalue()
    kinds["yaml"] = f"!!python/object/apply:os.mkdir ['{canary}']".encode()
    kinds["json class"] = json.dumps({"__class__": "os.system", "args": [f"mkdir {canary}"]}).encode()
    kinds["python"] = f"import os; os.mkdir({str(canary)!r})".encode()
    for name, member in {
        "zip ../": "../canary", "zip absolute": str(canary), "zip drive": "C:\\canary", "zip nul": "a\0b",
        "zip twice": "x",
    }.items():  # fmt: skip
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
    """R5, R7: pickles, code, archives under the names of artefacts: refused in 2 s, nothing executed or unpacked."""
    return in_child(_malice)  # since an audit hook stays


def _malice() -> Outcome:
    found, seen = Outcome(), []

    def hook(event: str, _: tuple[Any, ...]) -> None:
        if event.startswith(("pickle.", "os.system", "os.exec", "os.posix_spawn", "subprocess.", "socket.")):
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
                try:
                    load()
                    said = "accepted"
                except (StoreError, RunError) as error:
                    said = "" if path.name in str(error) or kind == "status" else str(error)
                except Exception as error:
                    said = repr(error)
                quick = time.process_time() - began < 2
                found.count(quick and not said and not (place / "canary").exists(), f"{kind} from {name}: {said}")
            path.write_bytes(data)
        found.count(seen == ["listening"], f"events: {seen[:5]}")
        found.note = f"{len(kinds)} files under the names of {found.of // len(kinds)} artefacts"
    return found


def hostile_hdf5(trials: int = 0) -> Outcome:
    """R6: HDF5 files that point elsewhere, lie about their size or never end: refused in 2 s, before data are read."""
    import h5py

    found = Outcome()
    about = dict(env="tsm/Made-v0", dt=0.02, names=("a", "b", "c"), units=("m",) * 3)
    with folder() as place:
        secret = place / "secret.bin"
        secret.write_bytes(np.full((31, 3), 1234.5).tobytes())
        other = place / "other.h5"
        with h5py.File(other, "w") as file:
            file["x"] = np.full((31, 3), 1234.5)
            file["group/observations"] = np.full((31, 3), 1234.5)

        def put(group: Any, **options: Any) -> Any:
            return group.create_dataset("observations", data=TRAIN.states[0], **options)

        def linked(link: Any) -> Callable[[Any], None]:
            def make(group: Any) -> None:
                group["observations"] = link

            return make

        def virtual(group: Any) -> None:
            layout = h5py.VirtualLayout((31, 3), "f8")
            layout[:] = h5py.VirtualSource(str(other), "x", (31, 3))
            group.create_virtual_dataset("observations", layout)

        def loop(group: Any) -> None:
            put(group)
            group["again"] = group

        def twice(group: Any) -> None:
            group["copy"] = put(group)

        def deep(group: Any) -> None:
            put(group)
            for _ in range(50):
                group = group.create_group("g")

        def compound(group: Any) -> None:
            group["observations"] = np.zeros((31, 3), [("a", "f4"), ("b", "i4")])

        def texts(group: Any) -> None:
            group.create_dataset("observations", (31, 3), h5py.string_dtype())

        def references(group: Any) -> None:
            group.create_dataset("observations", (31, 3), h5py.ref_dtype)

        def huge(group: Any) -> None:
            group.create_dataset("observations", (10**9, 1000), "f4", chunks=(1000, 1000))

        def bomb(group: Any) -> None:
            group.create_dataset("observations", data=np.zeros((10**6, 3)), compression="gzip", fletcher32=True)

        def many(group: Any) -> None:
            put(group)
            for i in range(10_000):
                group.file.create_group(f"g{i}/h")
            group["end"] = h5py.ExternalLink("x", "y")

        def unknown_filter(group: Any) -> None:
            plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            plist.set_chunk((31, 3))
            plist.set_filter(32001, h5py.h5z.FLAG_OPTIONAL, ())  # blosc
            space = h5py.h5s.create_simple((31, 3))
            h5py.h5d.create(group.id, b"observations", h5py.h5t.IEEE_F32LE, space, plist)

        external = dict(external=[(str(secret), 0, secret.stat().st_size)])
        makers: dict[str, Callable[[Any], Any]] = {
            "external storage": lambda g: g.create_dataset("observations", (31, 3), "f8", **external),
            "external link": linked(h5py.ExternalLink(str(other), "/x")),
            "soft link": linked(h5py.SoftLink("/elsewhere")),
            "soft link to itself": linked(h5py.SoftLink("/episode_0/observations")),
            "virtual": virtual,
            "a group within itself": loop,
            "one object twice": twice,
            "50 groups deep": deep,
            "compound": compound,
            "texts": texts,
            "references": references,
            "3.6 TiB declared": huge,
            "gzip bomb": bomb,
            "gzip without checksum": lambda g: put(g, compression="gzip"),
            "lzf": lambda g: put(g, compression="lzf", fletcher32=True),
            "unknown filter": unknown_filter,
            "20,000 groups, then a link": many,
            "no shape": lambda g: g.create_dataset("observations", data=1.0),
            "a named type": linked(np.dtype("f4")),
        }
        path = place / "hostile.h5"
        for name, make in makers.items():
            with h5py.File(path, "w") as file:
                group = file.create_group("episode_0")
                group["actions"] = TRAIN.actions[0]
                make(group)
            found.count(*refused(path, about, name))
        with h5py.File(path, "w") as file:
            file["episode_0"] = h5py.ExternalLink(str(other), "/group")
        found.count(*refused(path, about, "a linked episode"))
        with h5py.File(path, "w") as file:
            file.attrs["text"] = "x" * 60_000
        found.count(*refused(path, about, "no episodes"))
        whole = minari_file(path, h5py)
        draw = rng(6)
        for _ in range(max(30, trials)):  # and what an accident makes of a good one
            path.write_bytes(whole[: draw.randrange(len(whole))])
            found.count(*refused(path, about, "cut"))
        path.write_bytes(whole)
        loaded = load_minari(path, **about)
        found.count(np.array_equal(loaded.states, TRAIN.states), "a good file was not read")
        found.note = f"{len(makers) + 2} hostile files"
    return found


def minari_file(path: Path, h5py: Any) -> bytes:
    """A file as Minari writes it: resizable chunks, texts about each step."""
    with h5py.File(path, "w") as file:
        for i, (states, actions) in enumerate(zip(TRAIN.states, TRAIN.actions, strict=True)):
            group = file.create_group(f"episode_{i}")
            group.attrs["total_steps"] = len(actions)
            for name, array in {"observations": states, "actions": actions, "rewards": actions[:, 0]}.items():
                group.create_dataset(name, data=array, chunks=True, maxshape=(None, *array.shape[1:]))
            group.create_dataset("infos", data=["{}"] * len(actions), dtype=h5py.string_dtype())
    return path.read_bytes()


def refused(path: Path, about: dict[str, Any], name: str) -> tuple[bool, str]:
    """Whether a file is refused in time, in words, and in little memory."""
    began, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        load_minari(path, **about)
        return False, f"{name}: accepted"
    except StoreError as error:
        grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
        fine = path.name in str(error) and time.process_time() - began < 2
        return fine and grown < 200e6 + 3 * path.stat().st_size, f"{name}: {error} ({grown / 1e6:.0f} MB)"
    except Exception as error:
        return False, f"{name}: {error!r}"


# What does not belong together ---------------------------------------------------------------------------------------

OTHERWISE: dict[str, Any] = {
    "dt": 0.01, "names": ["x"] * 6, "units": ["cm"] * 6, "angles": [0], "noise": 0.25, "delay": 3,
    "simulator": "0" * 64, "segment_len": 5,
}  # fmt: skip


def mismatched(trials: int = 0) -> Outcome:
    """R9: data and models of each environment asked for as another's, and with each field of the fingerprint off."""
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
                    try:
                        load()
                        said = ""
                    except StoreError as error:
                        said = str(error)
                    if env == name:
                        found.count(not said, said)
                    else:
                        field = "env" if name in prints else name
                        both = repr(stated[field]) in said and repr(expected[field]) in said
                        found.count(both and path.name in said, f"{path.stem} {name} as {env}: {said}")
    return found


# Parameters ----------------------------------------------------------------------------------------------------------


def hostile_texts() -> list[str]:
    """At least 150 values that no parameter may have, typed on a command line."""
    texts = ["../x", "../../etc/passwd", "a/../../b", "..", "~", "~root", "~/x", "a\0b", "\0", "a\nb", "\n", "\r", "\t",
             "a\u202eb", "\u200bx", "\ufeffx", "\u2028x", "\x1b[31mred", "\x7f", "\ud800x", " x", "x ", "CON", "con",
             "nul.txt", "aux/x", "a/PRN", "com1", "LPT9.x", "../..", "a/..", "x/../../..", "/../x", "~x", "Nul", "PRN",
             "com7/x", "x" * 300, "x" * 1001, "x" * 100_000]  # fmt: skip
    texts += [
        f"{text}{tail}" for text in ("../", "~", "a\0", "a\n", "\u202e") for tail in ("1", "smoke", "tsm", "x" * 20)
    ]
    controls = [
        chr(code)
        for code in (
            *range(1, 32),
            *range(127, 161),
            *range(0x2028, 0x2030),
            *range(0x2060, 0x2070),
            0x200E,
            0x200F,
            0x2066,
            0x2069,
            0xE0001,
        )
    ]
    return texts + [f"a{control}b" for control in controls]


def hostile_numbers() -> list[str]:
    """Values that no number of ours may have."""
    return [
        "-1", "-0.5", "1e9", "1e308", "nan", "NaN", "inf", "-inf", "infinity", "true", "True", "None", "null", "0x10",
        "0b1", "0o7", "1_000", "1,5", "1;2", "10**9", "1+1", "[1]", "{}", "()", "", " ", "1 ", " 1", "+", "-", "--1",
        "1.", ".5", "1.0", "1e3", "1/2", "½", "²", "１", "٣", "1e", "e1", "1j", "$1", "`id`", "$(id)", "%s", "{seed}",
        "{x.__class__}", "__import__('os')", "9" * 19, "9" * 5000, "2147483648", "-2147483649", "Smoke", "seed=1",
    ]  # fmt: skip


def hostile_parameters(trials: int = 0) -> Outcome:
    """R13: hostile values and names for each parameter of each notebook: exit 2, a line that names it, no file."""
    import contextlib

    from tsmlib.__main__ import main

    found, per_parameter = Outcome(), []
    words = hostile_texts() + hostile_numbers()
    names = ["sed", "", " ", "seed ", "Seed", "__class__", "seed=1; import os; x", "os.system('id')", "a.b", "a[0]",
             "seed\n", "лl", "import os", "lambda: 0", "x" * 300, "run_dir\0", "None", "-p", "--seed", "é"]  # fmt: skip
    with folder() as place:
        before = os.environ.get("TSM_RUN_DIR")
        os.environ["TSM_RUN_DIR"] = str(place / "runs")
        try:
            for word, notebook in runs.notebooks().items():
                for name, default in parameters.declared(notebook).items():
                    hostile = hostile_texts() if name == "run_dir" else words
                    if isinstance(default, str) and name != "run_dir":
                        hostile = [text for text in hostile if text]  # '' is a scale
                    per_parameter.append(len(hostile))
                    for text in hostile:
                        given = [f"--{name}={text}"] if name in ("scale", "seed") else [f"-p{name}={text}"]
                        errors = io.StringIO()
                        with contextlib.redirect_stderr(errors):
                            code = main(["run", word, *given])
                        line = errors.getvalue()
                        clear = line.count("\n") == 1 and name in line and "expected" in line
                        found.count(code == 2 and clear, f"{word} {name}={text[:40]!r}: {code} {line[:200]}")
                for name in names:
                    with contextlib.redirect_stderr(io.StringIO()):
                        found.count(main(["run", word, f"-p{name}=1"]) == 2, f"{word} {name!r}")
            for bad in (*hostile_texts(), -1, 2**31, 1.0, True, None, [], {}, b"x", float("nan"), 10**30, object()):
                for name in ("scale", "seed", "run_dir", "env", "models", "n_targets"):
                    try:
                        runs.resolve("05_control", **{name: bad})
                        found.count(False, f"resolve({name}={bad!r:.40})")
                    except ParameterError as error:
                        found.count(name in str(error), str(error))
            found.count(not any(place.iterdir()), f"files were made: {list(place.iterdir())}")
        finally:
            os.environ.pop("TSM_RUN_DIR")
            if before is not None:
                os.environ["TSM_RUN_DIR"] = before
    found.note = f"at least {min(per_parameter)} values for each of {len(per_parameter)} parameters"
    return found


# Made up -------------------------------------------------------------------------------------------------------------

WORDS = ["", "env", "tsm/Reacher-v0", "TSM", "x" * 50, "states", "../x", "\0", "nan", None, True, 0, -1, 1, 3, 10**9,
         2**70, 1e308, -1e-308, [], {}, [[]], [0], {"a": 1}, [1, 2, 3], ["a", "b", "c"], ["m"] * 3]  # fmt: skip


def made_up(draw: Any, value: Any, depth: int = 0) -> Any:
    """``value`` with a few of its parts replaced, dropped or added."""
    if draw.random() < 0.12:
        return draw.choice(WORDS)
    if isinstance(value, dict):
        items = {name: made_up(draw, item, depth + 1) for name, item in value.items() if draw.random() > 0.06}
        return {**items, **({str(draw.choice(WORDS)): draw.choice(WORDS)} if draw.random() < 0.1 else {})}
    if isinstance(value, list):
        items = [made_up(draw, item, depth + 1) for item in value if draw.random() > 0.04]
        return items + ([draw.choice(WORDS)] if draw.random() < 0.06 else [])
    return value


def fuzz(trials: int) -> Outcome:
    """R27: headers, manifests, status files, notebooks, texts made up at random, checksums correct: only our errors."""
    found, refusals = Outcome(), 0
    warnings.simplefilter("ignore")
    with folder() as place:
        kinds = artefacts(place)
        plain: list[tuple[str, dict[str, torch.Tensor], Any, Path]] = []
        for kind in ("dataset", "model", "checkpoint"):
            path = kinds[kind][0]
            word = {"dataset": "trajectories"}.get(kind, kind)
            arrays, header = artifacts.load(path, kind=word)
            plain.append((word, arrays, header, path))
        sheets = [(kinds[kind][0], json.loads(kinds[kind][0].read_text())) for kind in ("manifest", "status")]
        loads = dict(kinds.values())
        notebook = place / "01_x.ipynb"
        cells = [{"cell_type": "code", "metadata": {"tags": ["parameters"]}, "source": ["seed = 0\n", 'scale = ""']}]
        for trial in range(trials):
            draw = rng(27, trial)
            work: Callable[[], Any]
            if trial % 4 < 2:
                word, arrays, header, path = draw.choice(plain)
                tensors = {name: change(draw, tensor) for name, tensor in arrays.items() if draw.random() > 0.02}
                schema = {} if draw.random() < 0.9 else {"schema": draw.choice(WORDS)}
                forged(path, tensors or arrays, kind=word, header=made_up(draw, header), **schema)
                work = loads[path]
            elif trial % 4 == 2:
                path, sheet = draw.choice(sheets)
                made = made_up(draw, sheet)
                if draw.random() < 0.7:  # with seals that hold
                    if path.name == files.STATUS and isinstance(made, dict):
                        made = {n: manifest.sealed(e) if isinstance(e, dict) and e else e for n, e in made.items()}
                    elif isinstance(made, dict) and "files" in made:
                        made = manifest.sealed({"files": made["files"]})
                path.write_text(json.dumps(made))
                work = loads[path] if draw.random() < 0.5 else lambda: manifest.verify(path)  # noqa: B023
            else:
                notebook.write_text(json.dumps(made_up(draw, {"cells": cells})))
                text = "".join(
                    draw.choice("0123456789eE+-._ax\n\0 ,;[](){}'\"=tsm/Rv") for _ in range(draw.randrange(12))
                )
                name = draw.choice(list(parameters.SCHEMA))
                given = {name: text}
                work = draw.choice([
                    lambda: parameters.typed(notebook, given),  # noqa: B023
                    lambda: parameters.convert(name, text),  # noqa: B023
                    lambda: parameters.check(name, draw.choice(WORDS)),  # noqa: B023
                ])  # fmt: skip
            try:
                work()
                found.count(True)
            except OURS as error:
                refusals += 1
                found.count(bool(str(error)))
            except BaseException as error:
                found.count(False, f"trial {trial}: {error!r:.300}")
        found.note = f"{refusals} refused, {found.of - refusals} accepted"
        claims = in_child(lambda: greedy(place))
        found.add(claims)
        found.note += f", {claims.of} that claim memory"
    return found


def greedy(place: Path) -> Outcome:
    """Models of a few kilobytes, one of whose sizes is a thousand million: refused before they take memory."""
    found, path = Outcome(), place / "greedy.safetensors"
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    little_memory()
    prior = ActionPrior(2, segment_len=4, channels=8, dilations=(1, 2))
    models = [new_model(), OneStep(3, 2, hidden=8), LSTM(3, 2, hidden=8), Ensemble(3, 2, hidden=8), prior,
              OneStepPolicy(3, 2, hidden=8), SegmentPolicy(3, prior, channels=8)]  # fmt: skip

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
                found.count(good, f"{type(model).__name__}, {name} {huge!r:.30}: {grown:.0f} MB, {said}")
    began = time.process_time()
    said = ask(models[3], members=10_000, layers=10_000)
    found.count("larger than its file" in said and time.process_time() - began < 2, said)
    return found


def change(draw: Any, tensor: torch.Tensor) -> torch.Tensor:
    """A tensor, now and then of another type or shape."""
    if draw.random() < 0.97 or tensor.ndim == 0:
        return tensor
    if draw.random() < 0.5:
        return tensor.to(draw.choice([torch.float64, torch.int32, torch.bfloat16, torch.bool]))
    return draw.choice(
        [tensor[:0].clone(), tensor.flatten()[:1].clone(), torch.stack([tensor, tensor]), torch.tensor(1.0)]
    )
