"""Artefacts on disk: datasets, models, tables and small JSON files. Nothing else in tsmlib writes or reads them.

An artefact is one safetensors file that any safetensors reader opens. Its metadata holds one entry, ``tsmlib``, a JSON
text whose first field is the SHA-256 of the whole file, taken with that field filled with zeros. So a single rename
publishes data and checksum together, and a flipped bit, a cut or an appended byte anywhere in the file is found when it
is loaded. Nothing is pickled, and nothing found in a file is executed.

Files are written beside their final name, flushed to the disk and renamed: a reader meets the old file or the new one.
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from tsmlib.trajectory import Trajectories, TrajectoryError

SCHEMA = 1
MANIFEST = "MANIFEST.json"
COLUMNS = (
    *("env", "sim", "task", "model", "planner", "prior", "horizon", "condition"),
    *("metric", "value", "unit", "n", "seed", "scale"),
)  # of every metrics table

_ZEROS = "0" * 64
_MARK = rb'"tsmlib":"{\"sha256\":\"'  # where the checksum stands in the file's header; cannot occur anywhere else
_REMEDY = {"trajectories": "python -m tsmlib run collect", "model": "python -m tsmlib run train"}

PathLike = str | os.PathLike[str]


class StoreError(ValueError):
    """An artefact that cannot be written, read or trusted: names the file, what was found and expected, the remedy."""


class Model(Protocol):
    """What ``save_model`` needs: the constructor's keyword arguments as plain JSON values, and the weights."""

    def config(self) -> dict[str, Any]: ...

    def state_dict(self) -> Mapping[str, Tensor]: ...


M = TypeVar("M", bound=torch.nn.Module)


# Arrays with a header ------------------------------------------------------------------------------------------------


def save(path: PathLike, tensors: Mapping[str, Tensor | np.ndarray], *, kind: str, header: Mapping[str, Any]) -> None:
    """Write named arrays and a JSON ``header`` to ``path`` (``*.safetensors``), replacing what was there in one step.

    kind: one word that ``load`` must ask for. header: plain JSON values; ``{"inputs": {path: sha256}}`` in it, paths
    relative to this file, names the files that this one was made from, for ``verify``.
    Raises StoreError before writing anything if a value is not finite or the header is not JSON.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise StoreError(f"cannot write {path}: expected a name that ends in .safetensors, found '{path.suffix}'.")
    arrays = {name: _owned(value) for name, value in tensors.items()}
    _require_finite(path, arrays, "Nothing was written.")
    about = _dumps(path, {"sha256": _ZEROS, "schema": SCHEMA, "kind": kind, "header": dict(header)})
    data = safetensors.torch.save(arrays, metadata={"tsmlib": about})
    at = data.index(_MARK) + len(_MARK)
    digest = hashlib.sha256(data).hexdigest().encode()
    write_bytes(path, data[:at] + digest + data[at + len(digest) :])


def load(path: PathLike, *, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The arrays and the header that ``save`` wrote. Every byte is checked first.

    Raises StoreError if the file is missing, damaged, of another kind, or holds a value that is not finite.
    """
    path = Path(path)
    data, about = _read_checked(path, kind)
    try:
        tensors = safetensors.torch.load(data)
    except (safetensors.SafetensorError, ValueError, KeyError) as error:
        raise StoreError(f"{path} is not a valid safetensors file: {error}. {_again(kind)}") from error
    _require_finite(path, tensors, _again(kind))
    return tensors, about["header"]


def read_header(path: PathLike) -> dict[str, Any]:
    """The header alone, of an artefact of any kind. The whole file is checked all the same."""
    return _read_checked(Path(path))[1]["header"]


def _read_checked(path: Path, kind: str | None = None) -> tuple[bytes, dict[str, Any]]:
    """The bytes of an artefact whose checksum holds, and what its ``tsmlib`` entry says."""
    data = _read(path, kind)
    header_end = 8 + int.from_bytes(data[:8], "little")
    at = data.find(_MARK, 8, header_end) + len(_MARK)
    if len(data) < 8 or header_end > len(data) or at < len(_MARK):
        raise StoreError(
            f"{path} is damaged, or was not written by tsmlib: {len(data)} bytes found, and no tsmlib checksum in the "
            f"header. {_again(kind)}"
        )
    view, end = memoryview(data), at + len(_ZEROS)
    stated = data[at:end].decode("latin-1")
    digest = hashlib.sha256(view[:at])
    digest.update(_ZEROS.encode())
    digest.update(view[end:])
    if digest.hexdigest() != stated:
        raise StoreError(
            f"{path} is damaged: its {len(data)} bytes have SHA-256 {digest.hexdigest()[:12]}..., expected "
            f"{stated[:12]!a}.... {_again(kind)}"
        )
    try:
        about = json.loads(json.loads(data[8:header_end])["__metadata__"]["tsmlib"])
        schema, found, _ = about["schema"], about["kind"], dict(about["header"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise StoreError(f"{path} has a header that tsmlib cannot read ({error!r}). {_again(kind)}") from error
    if schema != SCHEMA:
        raise StoreError(f"{path} is written in format {schema}, expected {SCHEMA}. Update tsmlib, or make it again.")
    if kind is not None and found != kind:
        raise StoreError(f"{path} holds '{found}', expected '{kind}'. {_again(kind)}")
    return data, about


def _owned(value: Tensor | np.ndarray) -> Tensor:
    """A contiguous copy on the CPU that shares memory with nothing, as safetensors needs."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(np.array(value, order="C"))
    return value.detach().cpu().clone(memory_format=torch.contiguous_format)


def _require_finite(path: Path, tensors: Mapping[str, Tensor], remedy: str) -> None:
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not torch.isfinite(tensor).all():
            bad = torch.nonzero(~torch.isfinite(tensor))
            index = tuple(bad[0].tolist())
            raise StoreError(
                f"{len(bad)} value(s) of '{name}' for {path} are not finite, the first at index {index}: "
                f"{tensor[index].item()}. {remedy}"
            )


def _again(kind: str | None) -> str:
    command = _REMEDY.get(kind or "")
    return f"Delete it and make it again: {command}" if command else "Restore it, or delete it and make it again."


# Trajectories and models ---------------------------------------------------------------------------------------------


def save_trajectories(path: PathLike, trajectories: Trajectories, header: Mapping[str, Any] | None = None) -> None:
    """Write ``trajectories`` as float32. ``header``: where they come from (seed, controller, ...)."""
    t = trajectories
    fields = {"env": t.env, "dt": t.dt, "names": t.names, "units": t.units, "angles": t.angles}
    arrays = {"states": t.states.astype(np.float32), "actions": t.actions.astype(np.float32)}
    save(path, arrays, kind="trajectories", header={**(header or {}), "trajectories": fields})


def load_trajectories(path: PathLike, *, env: str | None = None) -> Trajectories:
    """Read what ``save_trajectories`` wrote; with ``env``, refuse data of another environment."""
    tensors, header = load(path, kind="trajectories")
    try:
        fields = header["trajectories"]
        found = Trajectories(
            states=tensors["states"].numpy(),
            actions=tensors["actions"].numpy(),
            env=fields["env"],
            dt=fields["dt"],
            names=tuple(fields["names"]),
            units=tuple(fields["units"]),
            angles=tuple(fields["angles"]),
        )
    except (KeyError, TypeError, TrajectoryError) as error:
        raise StoreError(f"{path} holds no usable trajectories: {error}. {_again('trajectories')}") from error
    if env is not None and found.env != env:
        raise StoreError(f"{path} holds trajectories of {found.env}, expected {env}. {_again('trajectories')}")
    return found


def save_model(path: PathLike, model: Model, header: Mapping[str, Any] | None = None) -> None:
    """Write the weights of ``model`` with its class name and constructor arguments.

    header["fingerprint"]: what the model fits (env, dt, names, ...), compared field by field by ``load_model``.
    """
    about = {**(header or {}), "class": type(model).__name__, "config": model.config()}
    save(path, model.state_dict(), kind="model", header=about)


def load_model(path: PathLike, cls: type[M], *, expect: Mapping[str, Any] | None = None) -> M:
    """Build ``cls(**config)`` from the file and load its weights, strictly.

    expect: fields that the file's fingerprint must hold with these values. Raises StoreError naming both sides of
    every field that differs, and for a file of another class or with other weights.
    """
    tensors, header = load(path, kind="model")
    if header.get("class") != cls.__name__:
        raise StoreError(f"{path} holds a {header.get('class')}, expected a {cls.__name__}. {_again('model')}")
    fingerprint = header.get("fingerprint", {})
    wanted = json.loads(_dumps(Path(path), dict(expect or {})))  # tuples become lists, as in the file
    differs = [
        f"{name} is {fingerprint.get(name, 'not stated')!r} in the file, expected {value!r}"
        for name, value in wanted.items()
        if name not in fingerprint or fingerprint[name] != value
    ]
    if differs:
        raise StoreError(f"{path} does not fit: {'; '.join(differs)}. Load a model that does, or {_REMEDY['model']}")
    try:
        model = cls(**header["config"])
        model.load_state_dict(tensors, strict=True)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        first = str(error).strip().replace("\n\t", " ")
        raise StoreError(f"{path} does not fit the present {cls.__name__}: {first} {_again('model')}") from error
    return model


# Tables and JSON -----------------------------------------------------------------------------------------------------


def save_table(path: PathLike, rows: Sequence[Mapping[str, Any]], *, extra: Sequence[str] = ()) -> None:
    """Write one metrics table as CSV: the columns COLUMNS, then ``extra``; a field that a row lacks stays empty.

    Raises StoreError for a column that is in neither and for a number that is not finite.
    """
    path, columns = Path(path), (*COLUMNS, *extra)
    for i, row in enumerate(rows):
        if unknown := sorted(set(row) - set(columns)):
            raise StoreError(f"row {i} for {path} has unknown columns {unknown}, expected some of {list(columns)}.")
        for name, value in row.items():
            if isinstance(value, float | np.floating) and not math.isfinite(value):
                raise StoreError(f"row {i} for {path} holds {name} = {value}, expected a finite number: {dict(row)}")
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _plain(value) for name, value in row.items()} for row in rows)
    write_bytes(path, text.getvalue().encode())


def load_table(path: PathLike) -> list[dict[str, Any]]:
    """Rows of a table, numbers as int or float, empty fields as ''; checked against the folder's manifest, if any."""
    path = Path(path)
    reader = csv.reader(io.StringIO(_text(path)), strict=True)
    try:
        columns, *rows = reader
    except (csv.Error, ValueError) as error:
        raise StoreError(f"{path} is not a table ({error}). {_again(None)}") from error
    if missing := [name for name in COLUMNS if name not in columns]:
        raise StoreError(f"{path} is not a metrics table: it lacks the columns {missing}. {_again(None)}")
    for line, row in enumerate(rows, start=2):
        if len(row) != len(columns):
            raise StoreError(f"{path}, line {line}: {len(row)} fields, expected {len(columns)}. {_again(None)}")
    return [{name: _number(field) for name, field in zip(columns, row, strict=True)} for row in rows]


def write_json(path: PathLike, value: Any) -> None:
    """Write plain JSON values, in one step. Raises StoreError for anything that JSON cannot hold, NaN included."""
    write_bytes(path, (_dumps(Path(path), value, indent=1) + "\n").encode())


def read_json(path: PathLike) -> Any:
    """Read a JSON file. Checked against the folder's manifest, if any."""
    try:
        return json.loads(_text(Path(path)))
    except (ValueError, RecursionError) as error:
        if isinstance(error, StoreError):
            raise
        raise StoreError(f"{path} is not valid JSON: {error}. {_again(None)}") from error


def _plain(value: Any) -> Any:
    """JSON and CSV know Python's own numbers only."""
    if isinstance(value, bool | np.bool_):
        return int(value)
    return value.item() if isinstance(value, np.generic) else value


def _number(field: str) -> Any:
    for convert in (int, float):
        with contextlib.suppress(ValueError):
            return convert(field)
    return field


def _dumps(path: Path, value: Any, indent: int | None = None) -> str:
    def convert(item: Any) -> Any:
        if isinstance(item, np.generic):
            return item.item()
        raise TypeError(f"a {type(item).__name__} is not a JSON value: {item!r:.80}")

    separators = (",", ":") if indent is None else None
    try:
        return json.dumps(value, allow_nan=False, default=convert, indent=indent, separators=separators)
    except (TypeError, ValueError, RecursionError) as error:
        raise StoreError(f"the header or JSON for {path} cannot be written: {error}. Nothing was written.") from error


# Manifests and verification ------------------------------------------------------------------------------------------


def sha256(path: PathLike) -> str:
    """SHA-256 of a file's bytes, as 64 hexadecimal digits."""
    return hashlib.sha256(_read(Path(path))).hexdigest()


def digest(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of named arrays, by name and content."""
    found = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        found.update(name.encode() + tensor.detach().contiguous().numpy().tobytes())
    return found.hexdigest()


def write_manifest(folder: PathLike) -> None:
    """Write ``MANIFEST.json``: size and SHA-256 of every file under ``folder`` (for folders that are shipped)."""
    folder = Path(folder)
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != MANIFEST and not p.name.startswith(".")]
    entries = {p.relative_to(folder).as_posix(): {"bytes": p.stat().st_size, "sha256": sha256(p)} for p in files}
    write_json(folder / MANIFEST, {"files": entries, "sha256": _entries_digest(entries)})


def verify(path: PathLike) -> list[Path]:
    """Hash again an artefact and the inputs it names, or everything under a folder. Returns the files checked.

    In a folder, every artefact and every file that a manifest lists is checked. Inputs that are no longer there are
    passed over. Raises StoreError listing every problem, one a line.
    """
    path = Path(path)
    if not path.exists():
        raise StoreError(f"{path} does not exist. Expected an artefact (*.safetensors) or a folder of them.")
    problems: dict[str, None] = {}  # in order, each once
    checked: dict[Path, None] = {}

    def check(file: Path, wanted: str | None) -> None:
        try:
            if wanted is not None and (found := sha256(file)) != wanted:
                raise StoreError(f"{file} has SHA-256 {found[:12]}..., expected {wanted[:12]}.... {_again(None)}")
            if file.suffix == ".safetensors" and file not in checked:
                checked[file] = None
                inputs = read_header(file).get("inputs", {})
                for name, digest in inputs.items():
                    if (file.parent / name).exists():
                        check((file.parent / name).resolve(), digest)
            checked[file] = None
        except StoreError as error:
            problems[str(error)] = None

    path = path.resolve()
    found = [path] if path.is_file() else sorted(path.rglob("*"))
    for file in found:
        if file.name == MANIFEST:
            try:
                for name, digest in _manifest(file).items():
                    check(file.parent / name, digest)
                checked[file] = None
            except StoreError as error:
                problems[str(error)] = None
        elif file.suffix == ".safetensors":
            check(file, _listed(file))
        elif file == path:
            if (stated := _listed(file)) is None:
                raise StoreError(f"{file} carries no checksum, and no {MANIFEST} above it lists it: nothing to check.")
            check(file, stated)
    if problems:
        raise StoreError("\n".join(problems))
    return list(checked)


def _manifest(path: Path) -> dict[str, str]:
    """File name -> SHA-256, from a manifest that is itself intact."""
    try:
        value = json.loads(_read(path))
        entries = value["files"]
        intact = _entries_digest(entries) == value["sha256"] and set(value) == {"files", "sha256"}
        digests = {name: str(entry["sha256"]) for name, entry in entries.items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        if isinstance(error, StoreError):
            raise
        raise StoreError(f"{path} is not a manifest ({error!r}). Restore it.") from error
    if not intact:
        raise StoreError(f"{path} is damaged: its entries do not have the SHA-256 that it states. Restore it.")
    if any(name.is_absolute() or ".." in name.parts for name in map(Path, digests)):
        raise StoreError(f"{path} lists files outside its own folder. Restore it.")
    return digests


def _entries_digest(entries: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(entries, sort_keys=True).encode()).hexdigest()


def _listed(path: Path) -> str | None:
    """The SHA-256 that the nearest manifest states for ``path``."""
    for folder in path.parents:
        if (folder / MANIFEST).is_file():
            return _manifest(folder / MANIFEST).get(path.relative_to(folder).as_posix())
    return None


# Bytes ---------------------------------------------------------------------------------------------------------------


def write_bytes(path: PathLike, data: bytes) -> None:
    """Replace ``path`` by ``data`` in one step, creating its folder; on failure the old file stays and nothing else."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.tmp-{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for left in path.parent.glob(f".{path.name}.tmp-*"):  # by a process that was killed
            if not _alive(left.name.rpartition("-")[2]):
                left.unlink(missing_ok=True)
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        if os.name != "nt":  # Windows opens no folders
            folder = os.open(path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
    except OSError as error:
        raise StoreError(
            f"cannot write {path} ({len(data)} bytes): {error.strerror or error}. Make room or permission there, or "
            "name another folder with TSM_RUN_DIR."
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _alive(pid: str) -> bool:
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    except (ValueError, OverflowError, PermissionError):
        pass
    return True


def _read(path: Path, kind: str | None = None) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        command = _REMEDY.get(kind or "")
        raise StoreError(f"{path} does not exist. {f'Make it: {command}' if command else 'Check the name.'}") from None
    except (OSError, ValueError) as error:
        raise StoreError(f"cannot read {path}: {error}.") from error


def _text(path: Path) -> str:
    data = _read(path)
    wanted = _listed(path.resolve())
    if wanted is not None and hashlib.sha256(data).hexdigest() != wanted:
        raise StoreError(f"{path} is damaged: its SHA-256 is not the one in {MANIFEST}. {_again(None)}")
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise StoreError(f"{path} is not text: {error}. {_again(None)}") from error
