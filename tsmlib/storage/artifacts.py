"""Artefacts on disk: datasets, models, checkpoints, tables, JSON. Nothing else in tsmlib writes or reads them.

An artefact is one safetensors file that any safetensors reader opens. Its metadata holds one entry, ``tsmlib``, a JSON
text whose first field is the SHA-256 of the whole file, taken with that field filled with zeros. So a single rename
publishes data, manifest and checksum together, and a flipped bit, a cut or an appended byte anywhere in the file is
found when it is loaded. Tables and JSON are listed in a manifest, or in the ``status.json`` of the run that made them.
Nothing is pickled, and nothing found in a file is executed.

Files are written beside their final name, flushed to the disk and renamed: a reader meets the old file or the new one.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from tsmlib.storage.files import PathLike, StoreError, _again, _dumps, _loads, _other, _read, write_bytes
from tsmlib.storage.provenance import provenance
from tsmlib.trajectory import Trajectories, TrajectoryError

SCHEMA = 2  # 1, still read: no provenance, and of the fingerprint only env, dt and names
LARGEST = 10_000  # number, or length of a list, among a model's arguments: what Python makes of them takes memory too

_ZEROS = "0" * 64
_MARK = rb'"tsmlib":"{\"sha256\":\"'  # where the checksum stands in the file's header; cannot occur anywhere else


class Model(Protocol):
    """What ``save_model`` needs: the constructor's keyword arguments as plain JSON values, and the weights."""

    def config(self) -> dict[str, Any]: ...

    def state_dict(self) -> Mapping[str, Tensor]: ...


M = TypeVar("M", bound=torch.nn.Module)


# Arrays with a header ------------------------------------------------------------------------------------------------


def save(path: PathLike, tensors: Mapping[str, Tensor | np.ndarray], *, kind: str, header: Mapping[str, Any]) -> None:
    """Write named arrays and a JSON ``header`` to ``path`` (``*.safetensors``), replacing what was there in one step.

    kind: one word that ``load`` must ask for. header: plain JSON values; ``{"inputs": {path: sha256}}`` in it, paths
    relative to this file, names the files that this one was made from, for ``verify``. Provenance is added.
    Raises StoreError before writing anything if a value is not finite or the header is not JSON.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise StoreError(f"cannot write {path}: expected a name that ends in .safetensors, found '{path.suffix}'.")
    arrays = {name: _owned(value) for name, value in tensors.items()}
    _require_finite(path, arrays, "Nothing was written: check what computed them.")
    about = _dumps(
        path, {"sha256": _ZEROS, "schema": SCHEMA, "kind": kind, "header": dict(header), "provenance": provenance()}
    )
    data = safetensors.torch.save(arrays, metadata={"tsmlib": about})
    at = data.index(_MARK) + len(_MARK)
    digest = hashlib.sha256(data).hexdigest().encode()
    write_bytes(path, data[:at] + digest + data[at + len(digest) :])


def load(path: PathLike, *, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The arrays and the header that ``save`` wrote. Every byte is checked first.

    Raises StoreError if the file is missing, damaged, of another kind, or holds a value that is not finite.
    """
    tensors, about = _load(Path(path), kind)
    _require_finite(Path(path), tensors, _again(Path(path), kind))
    return tensors, about["header"]


def read_header(path: PathLike) -> dict[str, Any]:
    """The header alone, of an artefact of any kind. The whole file is checked all the same."""
    return _read_checked(Path(path))[1]["header"]


def read_provenance(path: PathLike) -> dict[str, Any]:
    """What made an artefact, see ``provenance``; empty for files of format 1. The whole file is checked."""
    return _read_checked(Path(path))[1].get("provenance", {})


def _load(path: Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Arrays, not yet known to be finite, and everything that the ``tsmlib`` entry says."""
    data, about = _read_checked(path, kind)
    try:
        return dict(sorted(safetensors.torch.load(data).items())), about  # they come in any order
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{path} is not a valid safetensors file: {error}. {_again(path, kind)}") from error


def _read_checked(path: Path, kind: str | None = None) -> tuple[bytes, dict[str, Any]]:
    """The bytes of an artefact whose checksum holds, and what its ``tsmlib`` entry says."""
    data = _read(path, kind)
    header_end = 8 + int.from_bytes(data[:8], "little")
    at = data.find(_MARK, 8, header_end) + len(_MARK)
    if len(data) < 8 or header_end > len(data) or at < len(_MARK):
        raise StoreError(
            f"{path} is damaged, or was not written by tsmlib: {len(data)} bytes found, and no tsmlib checksum in the "
            f"header. {_again(path, kind)}"
        )
    view, end = memoryview(data), at + len(_ZEROS)
    stated = data[at:end].decode("latin-1")
    digest = hashlib.sha256(view[:at])
    digest.update(_ZEROS.encode())
    digest.update(view[end:])
    if digest.hexdigest() != stated:
        raise StoreError(
            f"{path} is damaged: its {len(data)} bytes have SHA-256 {digest.hexdigest()[:12]}..., expected "
            f"{stated[:12]!a}.... {_again(path, kind)}"
        )
    try:
        about = _loads(_loads(data[8:header_end])["__metadata__"]["tsmlib"])
        schema, found, _ = about["schema"], about["kind"], {**about["header"]}
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise StoreError(f"{path} has a header that tsmlib cannot read ({error!r}). {_again(path, kind)}") from error
    if type(schema) is not int or not 1 <= schema <= SCHEMA:
        raise StoreError(
            f"{path} is written in format {schema!r:.80}, expected 1 to {SCHEMA}. Update tsmlib, or make it again."
        )
    if kind is not None and found != kind:
        raise StoreError(f"{path} holds {found!r:.80}, expected '{kind}'. {_other(path, kind)}")
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


# Trajectories and models ---------------------------------------------------------------------------------------------


def save_trajectories(path: PathLike, trajectories: Trajectories, header: Mapping[str, Any] | None = None) -> None:
    """Write ``trajectories`` as float32. ``header``: where they come from (seed, controller, fingerprint, ...)."""
    t = trajectories
    fields = {"env": t.env, "dt": t.dt, "names": t.names, "units": t.units, "angles": t.angles}
    arrays = {"states": t.states.astype(np.float32), "actions": t.actions.astype(np.float32)}
    save(path, arrays, kind="trajectories", header={**(header or {}), "trajectories": fields})


def load_trajectories(
    path: PathLike, *, env: str | None = None, expect: Mapping[str, Any] | None = None
) -> Trajectories:
    """Read what ``save_trajectories`` wrote; with ``env`` or ``expect``, a fingerprint, refuse data of anything else.

    Raises StoreError naming episode, step and field of a value that is not finite.
    """
    path = Path(path)
    tensors, about = _load(path, "trajectories")
    try:
        fields = about["header"]["trajectories"]
        kinds = {name: str(tensor.dtype) for name, tensor in tensors.items()}
        if kinds != dict.fromkeys(("states", "actions"), "torch.float32"):
            raise TypeError(f"found {kinds}, expected 'states' and 'actions' in torch.float32")
        words = [fields["env"], *fields["names"], *fields["units"]]
        size = tensors["states"].shape[-1]
        if not all(isinstance(word, str) for word in words) or not 0 < fields["dt"] < math.inf:
            raise TypeError(f"expected texts as env, names and units and a dt above 0, found {fields!r:.200}")
        if not all(type(index) is int and 0 <= index < size for index in fields["angles"]):
            raise TypeError(f"angles are {fields['angles']!r:.80}, expected some of the {size} state dimensions")
        found = Trajectories(
            states=tensors["states"].numpy(),
            actions=tensors["actions"].numpy(),
            env=fields["env"],
            dt=fields["dt"],
            names=tuple(fields["names"]),
            units=tuple(fields["units"]),
            angles=tuple(fields["angles"]),
        )
        fingerprint = {**about["header"].get("fingerprint", {}), **fields}
    except (KeyError, IndexError, TypeError, TrajectoryError) as error:
        raise StoreError(f"{path} holds no usable trajectories: {error}. {_again(path, 'trajectories')}") from error
    if env is not None and found.env != env:
        raise StoreError(f"{path} holds trajectories of {found.env}, expected {env}. {_other(path, 'trajectories')}")
    if differs := differences(fingerprint, expect or {}, only_stated=about["schema"] == 1):
        raise StoreError(f"{path} does not fit: {'; '.join(differs)}. {_other(path, 'trajectories')}")
    return found


def save_model(path: PathLike, model: Model, header: Mapping[str, Any] | None = None) -> None:
    """Write the weights of ``model`` with its class name and constructor arguments.

    header["fingerprint"]: what the model fits (env, dt, names, ...), compared field by field by ``load_model``.
    The length H of its segments joins it there.
    """
    about = {**(header or {}), "class": type(model).__name__, "config": model.config()}
    if hasattr(model, "segment_len"):
        about["fingerprint"] = {"segment_len": model.segment_len, **about.get("fingerprint", {})}
    save(path, model.state_dict(), kind="model", header=about)


def load_model(path: PathLike, cls: type[M], *, expect: Mapping[str, Any] | None = None) -> M:
    """Build ``cls(**config)`` from the file and load its weights, strictly.

    expect: fields that the file's fingerprint must hold with these values. Raises StoreError naming both sides of
    every field that differs, and for a file of another class or with weights of other shapes or types.
    """
    path = Path(path)
    tensors, about = _load(path, "model")
    _require_finite(path, tensors, _again(path, "model"))
    header = about["header"]
    if header.get("class") != cls.__name__:
        raise StoreError(
            f"{path} holds a {header.get('class')!r:.80}, expected a {cls.__name__}. {_other(path, 'model')}"
        )
    try:
        config, fingerprint = {**header["config"]}, {**header.get("fingerprint", {})}
        _require_sizes(config)
        limit = LARGEST + sum(tensor.numel() for tensor in tensors.values())
        with (
            torch.device("meta"),
            _AtMost(limit),
        ):  # a plan of the model, without memory, however large the file says it is
            planned = layout(cls(**config).state_dict())
        differs = differences(layout(tensors), planned) + [f"{n} is unknown" for n in set(tensors) - set(planned)]
    except Exception as error:  # what the file says goes to a constructor, which may fail in any way
        raise StoreError(
            f"{path} does not fit the present {cls.__name__}: {error!r:.500}. {_other(path, 'model')}"
        ) from error
    if differs:
        raise StoreError(
            f"{path} does not fit the present {cls.__name__}: {'; '.join(differs[:5])}. {_other(path, 'model')}"
        )
    if differs := differences(fingerprint, expect or {}, only_stated=about["schema"] == 1):
        raise StoreError(f"{path} does not fit: {'; '.join(differs)}. {_other(path, 'model')}")
    model = cls(**config)
    model.load_state_dict(tensors, strict=True)
    return model


class _AtMost(TorchFunctionMode):
    """So many operations of torch, so that no number of layers in a file keeps a processor busy."""

    def __init__(self, operations: int) -> None:
        self.operations = operations

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.operations -= 1
        if self.operations < 0:
            raise ValueError("it would be much larger than its file")
        return func(*args, **(kwargs or {}))


def _require_sizes(config: Mapping[str, Any]) -> None:
    """Refuse a model's arguments, from a file, that would take memory before any array is planned."""
    for name, value in config.items():
        for item in (value, *value) if isinstance(value, list) else (value,):
            size = len(item) if isinstance(item, list) else item
            if isinstance(item, dict):
                _require_sizes(item)
            elif isinstance(size, int) and size > LARGEST:
                raise ValueError(f"{name} is {value!s:.80}, expected sizes of at most {LARGEST}")


def differences(found: Mapping[str, Any], expected: Mapping[str, Any], *, only_stated: bool = False) -> list[str]:
    """What ``expected`` asks for and ``found``, from a file, does not hold, naming both sides.

    only_stated: what ``found`` does not mention is not asked for, except the environment.
    """
    wanted = json.loads(json.dumps(dict(expected)))  # tuples become lists, as in a file
    return [
        f"{name} is {found.get(name, 'not stated')!r} in the file, expected {value!r}"
        for name, value in wanted.items()
        if found.get(name) != value and (name in found or name == "env" or not only_stated)
    ]


def layout(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    """Type and shape of each array, in words."""
    return {
        name: f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}" for name, tensor in tensors.items()
    }


def digest(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of named arrays, by name and content."""
    found = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        found.update(name.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
    return found.hexdigest()
