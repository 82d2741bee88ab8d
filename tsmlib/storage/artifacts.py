"""Artefacts on disk: named arrays with a header, trajectories and models, one safetensors file each.

The metadata of the file holds one entry, ``tsmlib``: a JSON text whose first field is the SHA-256 of the whole file,
taken with that field filled with zeros. So a single rename publishes data, header and checksum together, any
safetensors reader opens the file, and a flipped bit, a cut or an appended byte is found when it is loaded. Nothing is
pickled, and nothing found in a file is executed.
"""

import hashlib
import itertools
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor
from torch.nn.modules.module import register_module_parameter_registration_hook

from tsmlib.storage.files import (
    Json,
    PathLike,
    StoreError,
    dumps,
    loads,
    read_bytes,
    remedy,
    write_bytes,
)
from tsmlib.storage.provenance import provenance
from tsmlib.trajectory import Robot, Trajectories, TrajectoryError

SCHEMA = 2  # 1, still read: no provenance, and of the fingerprint only env, dt and names
LARGEST = (
    10_000  # size among a model's arguments, length of a list of them, and parameters of a model
)

ROBOT = ("env", "dt", "names", "units", "angles")  # fields of a model's fingerprint
_ZEROS = "0" * 64
_MARK = rb'"tsmlib":"{\"sha256\":\"'  # where the checksum stands in the file's header; cannot occur anywhere else
_OTHER = "Name another file, or delete it and make one that fits."


class Model(Protocol):
    """The constructor's keyword arguments as plain JSON values, and the weights."""

    def config(self) -> Mapping[str, Json]: ...

    def state_dict(self) -> Mapping[str, Tensor]: ...


M = TypeVar("M", bound=torch.nn.Module)


class Misfit(StoreError):
    """A sound file of something else than was asked for. found: what it is of, such as ``found["env"]``."""

    def __init__(self, message: str, found: Mapping[str, Json]) -> None:
        super().__init__(message)
        self.found = found


# Arrays with a header ------------------------------------------------------------------------------------------------


def save(
    path: PathLike,
    tensors: Mapping[str, Tensor | np.ndarray],
    *,
    kind: str,
    header: Mapping[str, Json],
) -> None:
    """Write named arrays and a JSON ``header`` to ``path`` (``*.safetensors``), replacing what was there in one step.

    kind: one word that ``load`` must ask for. header: plain JSON values; ``{"inputs": {path: sha256}}`` in it, paths
    relative to this file, names the files that this one was made from, for ``verify``. Provenance is added.
    Raises StoreError before writing anything if a value is not finite or the header is not JSON.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise StoreError(
            f"cannot write {path}: expected a name that ends in .safetensors, found '{path.suffix}'."
        )
    arrays = {name: _owned(value) for name, value in tensors.items()}
    _require_finite(path, arrays, "Nothing was written: check what computed them.")
    about = dumps(
        path,
        {
            "sha256": _ZEROS,
            "schema": SCHEMA,
            "kind": kind,
            "header": dict(header),
            "provenance": provenance(),
        },
    )
    data = safetensors.torch.save(arrays, metadata={"tsmlib": about})
    at = data.index(_MARK) + len(_MARK)
    digest = hashlib.sha256(data).hexdigest().encode()
    write_bytes(path, data[:at] + digest + data[at + len(digest) :])


def load(path: PathLike, *, kind: str) -> tuple[dict[str, Tensor], dict[str, Json]]:
    """Arrays and header as ``save`` wrote them. Every byte is checked first.

    Raises StoreError if the file is missing, damaged, of another kind, or holds a value that is not finite.
    """
    tensors, about = _load(Path(path), kind)
    _require_finite(Path(path), tensors, remedy(Path(path)))
    return tensors, about["header"]


def read_header(path: PathLike) -> dict[str, Json]:
    """The header alone, of an artefact of any kind. The whole file is checked all the same."""
    return _read_checked(Path(path))[1]["header"]


def code(path: PathLike) -> str:
    """The version of the code that wrote an artefact, as it says itself; '' where it says none. Nothing is checked."""
    provenance = _stated(path).get("provenance")
    return str(provenance.get("code", "")) if isinstance(provenance, dict) else ""


def checksum(path: PathLike) -> str:
    """The SHA-256 of an artefact, as it says itself; '' where it says none. Nothing is checked."""
    return str(_stated(path).get("sha256", ""))


def unchecked_header(path: PathLike) -> dict[str, Json]:
    """The header alone, of a file that was just loaded. Nothing is checked."""
    header = _stated(path).get("header")
    return header if isinstance(header, dict) else {}


def _stated(path: PathLike) -> dict[str, Any]:
    """What the ``tsmlib`` entry of a file says, if it has one; the rest of the file is not read."""
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            found = json.loads(file.metadata()["tsmlib"])
    except (OSError, safetensors.SafetensorError, ValueError, KeyError, TypeError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _load(path: Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Arrays, not yet known to be finite, and everything that the ``tsmlib`` entry says."""
    data, about = _read_checked(path, kind)
    try:
        return dict(sorted(safetensors.torch.load(data).items())), about  # they come in any order
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError) as error:
        raise StoreError(
            f"{path} is not a valid safetensors file: {error}. {remedy(path)}"
        ) from error


def _read_checked(path: Path, kind: str | None = None) -> tuple[bytes, dict[str, Any]]:
    """The bytes of an artefact whose checksum holds, and what its ``tsmlib`` entry says."""
    data = read_bytes(path)
    header_end = 8 + int.from_bytes(data[:8], "little")
    at = data.find(_MARK, 8, header_end) + len(_MARK)
    if len(data) < 8 or header_end > len(data) or at < len(_MARK):
        raise StoreError(
            f"{path} is damaged, or was not written by tsmlib: {len(data)} bytes found, and no tsmlib checksum in the "
            f"header. {remedy(path)}"
        )
    stated = data[at : at + len(_ZEROS)].decode("latin-1")
    found = hashlib.sha256(data[:at] + _ZEROS.encode() + data[at + len(_ZEROS) :]).hexdigest()
    if found != stated:
        raise StoreError(
            f"{path} is damaged: its {len(data)} bytes have SHA-256 {found[:12]}..., expected {stated[:12]!a}.... "
            f"{remedy(path)}"
        )
    try:
        entry: Any = loads(data[8:header_end])
        about: Any = loads(entry["__metadata__"]["tsmlib"])
        schema, holds, _ = about["schema"], about["kind"], {**about["header"]}
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise StoreError(
            f"{path} has a header that tsmlib cannot read ({error!r}). {remedy(path)}"
        ) from error
    if type(schema) is not int or not 1 <= schema <= SCHEMA:
        raise StoreError(
            f"{path} is written in format {schema!r:.80}, expected 1 to {SCHEMA}. Update tsmlib, or make it again."
        )
    if kind is not None and holds != kind:
        raise StoreError(f"{path} holds {holds!r:.80}, expected '{kind}'. {_OTHER}")
    return data, about


def _owned(value: Tensor | np.ndarray) -> Tensor:
    """A contiguous copy on the CPU that shares memory with nothing, as safetensors needs."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(np.array(value, order="C"))
    return value.detach().cpu().clone(memory_format=torch.contiguous_format)


def _require_finite(path: Path, tensors: Mapping[str, Tensor], advice: str) -> None:
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not torch.isfinite(tensor).all():
            bad = torch.nonzero(~torch.isfinite(tensor))
            index = tuple(bad[0].tolist())
            raise StoreError(
                f"{len(bad)} value(s) of '{name}' for {path} are not finite, the first at index {index}: "
                f"{tensor[index].item()}. {advice}"
            )


# Trajectories --------------------------------------------------------------------------------------------------------


def save_trajectories(
    path: PathLike, trajectories: Trajectories, header: Mapping[str, Json] | None = None
) -> None:
    """Write ``trajectories`` as float32. ``header``: where they come from (seed, controller, fingerprint, ...)."""
    t = trajectories
    fields: dict[str, Json] = {
        "env": t.env,
        "dt": t.dt,
        "names": t.names,
        "units": t.units,
        "angles": t.angles,
    }
    same = len(set(t.lengths)) == 1
    fields |= {} if same else {"lengths": t.lengths}
    fields |= {"terminated": t.terminated} if any(t.terminated) else {}
    arrays = {
        "states": t.states if same else t.flat_states,
        "actions": t.actions if same else t.flat_actions,
    }
    save(path, arrays, kind="trajectories", header={**(header or {}), "trajectories": fields})


def load_trajectories(path: PathLike, *, expect: Mapping[str, Json] | None = None) -> Trajectories:
    """Trajectories as ``save_trajectories`` wrote them, of ``expect``, a fingerprint, where that is given.

    Raises StoreError naming episode, step and field of a value that is not finite, or both sides of what differs.
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
            raise TypeError(
                f"expected texts as env, names and units and a dt above 0, found {fields!r:.200}"
            )
        if not all(type(index) is int and 0 <= index < size for index in fields["angles"]):
            raise TypeError(
                f"angles are {fields['angles']!r:.80}, expected some of the {size} state dimensions"
            )
        arrays = (tensors["states"].numpy(), tensors["actions"].numpy())
        meaning = (tuple(fields["names"]), tuple(fields["units"]), tuple(fields["angles"]))
        lengths, ended = fields.get("lengths"), fields.get("terminated")
        if arrays[0].ndim == 2:
            robot = Robot(fields["env"], fields["dt"], *meaning, arrays[1].shape[-1])
            found = Trajectories.from_rows(*arrays, lengths, robot, ended)
        else:
            ends = {"lengths": lengths, "terminated": ended}
            found = Trajectories(*arrays, fields["env"], fields["dt"], *meaning, **ends)
        fingerprint = {**about["header"].get("fingerprint", {}), **fields}
    except (KeyError, IndexError, TypeError, TrajectoryError) as error:
        raise StoreError(f"{path} holds no usable trajectories: {error}. {remedy(path)}") from error
    require_fit(path, fingerprint, expect, about["schema"])
    return found


# Models --------------------------------------------------------------------------------------------------------------


def save_model(path: PathLike, model: Model, header: Mapping[str, Json] | None = None) -> None:
    """Write the weights of ``model`` with its class name and constructor arguments.

    header["fingerprint"]: what the model fits (env, dt, names, ...), compared field by field by ``load_model``.
    The length H of its segments joins it there.
    """
    about = {**(header or {}), "class": type(model).__name__, "config": model.config()}
    stated = about.get("fingerprint", {})
    if isinstance(robot := getattr(model, "robot", None), Robot) and isinstance(stated, Mapping):
        stated = {name: getattr(robot, name) for name in ROBOT} | stated
        about["fingerprint"] = stated
    if hasattr(model, "segment_len") and isinstance(stated, Mapping):
        about["fingerprint"] = {"segment_len": model.segment_len, **stated}
    save(path, model.state_dict(), kind="model", header=about)


def load_model(path: PathLike, cls: type[M], *, expect: Mapping[str, Json] | None = None) -> M:
    """``cls(**config)`` from the file, with its weights, strictly.

    expect: fields that the file's fingerprint must hold with these values. Raises StoreError naming both sides of
    every field that differs, and for a file of another class or with weights of other shapes or types.
    """
    path = Path(path)
    tensors, about = _load(path, "model")
    _require_finite(path, tensors, remedy(path))
    header = about["header"]
    if header.get("class") != cls.__name__:
        raise StoreError(
            f"{path} holds a {header.get('class')!r:.80}, expected a {cls.__name__}. {_OTHER}"
        )
    try:
        config, fingerprint = {**header["config"]}, {**header.get("fingerprint", {})}
        planned = _planned_layout(cls, config)
        differs = differences(layout(tensors), planned) + [
            f"{n} is unknown" for n in set(tensors) - set(planned)
        ]
    except (
        Exception
    ) as error:  # what the file says goes to a constructor, which may fail in any way
        differs = [f"{error!r:.500}"]
    if differs:
        raise StoreError(
            f"{path} does not fit the present {cls.__name__}: {'; '.join(differs[:5])}. {_OTHER}"
        )
    require_fit(path, fingerprint, expect, about["schema"])
    model = cls(**config)
    model.load_state_dict(tensors, strict=True)
    if hasattr(model, "robot") and fingerprint.keys() >= set(ROBOT):
        model.robot = Robot(*(fingerprint[name] for name in ROBOT), model.action_dim)
    return model


def _planned_layout(cls: type[torch.nn.Module], config: dict[str, Json]) -> dict[str, str]:
    """Layout of ``cls(**config)``, found without its memory, however large the file says that it is."""
    for name, value in config.items():
        if max(_sizes(value), default=0) > LARGEST:
            raise ValueError(f"{name} is {value!s:.80}, expected sizes of at most {LARGEST}")
    parameters = itertools.count()

    def count(*_: object) -> None:
        if next(parameters) > LARGEST:
            raise ValueError("it would be much larger than its file")

    hook = register_module_parameter_registration_hook(count)
    try:
        with torch.device("meta"):
            return layout(cls(**config).state_dict())
    finally:
        hook.remove()


def _sizes(value: Json) -> Iterator[int]:
    """Every integer within a JSON value, and the length of every list."""
    if isinstance(value, int):
        yield value
    elif isinstance(value, list | dict):
        yield len(value)
        for item in value.values() if isinstance(value, dict) else value:
            yield from _sizes(item)


# Comparison ----------------------------------------------------------------------------------------------------------


def require_fit(
    path: Path, found: Mapping[str, Json], expect: Mapping[str, Json] | None, schema: int = SCHEMA
) -> None:
    """Misfit naming both sides of every field of ``expect`` that ``found``, from the file, does not hold."""
    if differs := differences(found, expect or {}, only_stated=schema == 1):
        raise Misfit(f"{path} does not fit: {'; '.join(differs)}. {_OTHER}", found)


def differences(
    found: Mapping[str, Json], expected: Mapping[str, Json], *, only_stated: bool = False
) -> list[str]:
    """Fields of ``expected`` that ``found``, from a file, does not hold, naming both sides.

    ``standard``, in either of both: values of fields that the other leaves out.
    only_stated: what ``found`` does not mention is not asked for, except the environment.
    """
    wanted = json.loads(json.dumps(dict(expected)))  # tuples become lists, as in a file
    # Fields that only a variant of an environment states, with what the others mean by leaving them out.
    stated, usual = found.get("standard"), wanted.pop("standard", {})
    if "simulator" in wanted:  # a whole fingerprint
        usual = {**(stated if isinstance(stated, Mapping) else {}), **usual}
        wanted, found = usual | wanted, usual | dict(found)
    return [
        f"{name} is {found.get(name, 'not stated')!r} in the file, expected {value!r}"
        for name, value in wanted.items()
        if found.get(name) != value and (name in found or name == "env" or not only_stated)
    ]


def layout(tensors: Mapping[str, Tensor]) -> dict[str, str]:
    """Type and shape of each array, in words."""
    return {
        name: f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"
        for name, tensor in tensors.items()
    }


def digest(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of named arrays, by name and content."""
    found = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        found.update(name.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
    return found.hexdigest()


def trajectories_digest(data: Trajectories) -> str:
    """The first 16 digits of the ``digest`` of states, actions and, where episodes differ in length, lengths."""
    if len(set(data.lengths)) == 1:
        return digest(
            {"states": torch.from_numpy(data.states), "actions": torch.from_numpy(data.actions)}
        )[:16]
    return digest(data.tensors()._asdict())[:16]
