"""Named arrays with a header, trajectories and models: one safetensors file each.

The metadata of a file hold one entry, ``tsmlib``: a JSON text whose first field is the SHA-256 of
the whole file, taken with that field filled with zeros. So one rename publishes data, header and
checksum together, any safetensors reader opens the file, and a flipped bit, a cut or an appended
byte is found when it is loaded. Nothing is pickled, and nothing in a file is executed.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from tsmlib.checks import described, require_type
from tsmlib.robot import Robot
from tsmlib.storage.files import Json, PathLike, StoreError, dumps, loads, read_bytes, write_bytes
from tsmlib.storage.provenance import provenance
from tsmlib.trajectory import Trajectories

SCHEMA = 2  # 1, of some shipped files: a fingerprint of fewer fields
_ZEROS = "0" * 64
_MARK = rb'"tsmlib":"{\"sha256\":\"'  # where the checksum stands; cannot occur anywhere else
_AGAIN = "Make it again; a file of the repository is restored by: git checkout -- FILE."
_OTHER = "Name another file, or make one that fits."


class Model(Protocol):
    """The constructor's arguments as JSON, and the weights."""

    def config(self) -> Mapping[str, Json]: ...

    def state_dict(self) -> Mapping[str, Tensor]: ...


M = TypeVar("M", bound=torch.nn.Module)


def save(
    path: PathLike,
    tensors: Mapping[str, Tensor | np.ndarray],
    *,
    kind: str,
    header: Mapping[str, Json],
) -> None:
    """Write named arrays, replacing what was there in one step.

    Args:
        path: ends in .safetensors.
        tensors: arrays by name, of finite numbers.
        kind: one word that ``load`` must be given again.
        header: JSON values.

    Raises:
        StoreError: a number that is not finite, a header that is no JSON, or no room.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise StoreError(f"cannot write {path}: expected a name that ends in .safetensors.")
    try:
        if "__metadata__" in tensors:
            raise TypeError("'__metadata__' names the header")
        arrays = {name: _owned(value) for name, value in tensors.items()}
        _require_finite(path, arrays)
        about: dict[str, Json] = {"sha256": _ZEROS, "schema": SCHEMA, "kind": kind}
        about |= {"header": dict(header), "provenance": provenance()}
        data = safetensors.torch.save(arrays, metadata={"tsmlib": dumps(path, about)})
    except (TypeError, AttributeError, safetensors.SafetensorError) as error:
        raise StoreError(f"cannot write {path}: {error}. Expected arrays of numbers.") from error
    at = data.index(_MARK) + len(_MARK)
    digest = hashlib.sha256(data).hexdigest().encode()
    write_bytes(path, data[:at] + digest + data[at + len(digest) :])


def _owned(value: Tensor | np.ndarray) -> Tensor:
    """A contiguous copy on the CPU, in this machine's byte order."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(np.array(value, value.dtype.newbyteorder("="), order="C"))
    return value.detach().cpu().clone(memory_format=torch.contiguous_format)


def load(path: PathLike, *, kind: str) -> tuple[dict[str, Tensor], dict[str, Json]]:
    """Read what ``save`` wrote.

    Args:
        path: of the file.
        kind: the word that it was saved with.

    Returns:
        The arrays by name, and the header.

    Raises:
        StoreError: the file is missing, damaged, or of another kind.
    """
    tensors, about = _load(Path(path), kind)
    return tensors, about["header"]


def _load(path: Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    data, about = _read(path, kind)
    try:
        tensors = dict(sorted(safetensors.torch.load(data).items()))
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{path} is no valid safetensors file: {error}. {_AGAIN}") from error
    _require_finite(path, tensors)
    return tensors, about


def read_header(path: PathLike) -> dict[str, Json]:
    """The header of a file of any kind; the whole file is checked."""
    header: dict[str, Json] = _read(Path(path), None)[1]["header"]
    return header


def _read(path: Path, kind: str | None) -> tuple[bytes, dict[str, Any]]:
    """The bytes of a file whose checksum holds, and its ``tsmlib`` entry."""
    data = read_bytes(path)
    end = 8 + int.from_bytes(data[:8], "little")
    at = data.find(_MARK, 8, min(end, len(data))) + len(_MARK)
    if at < len(_MARK):
        raise StoreError(
            f"{path} is damaged, or no file of tsmlib: its {len(data)} bytes have no checksum in "
            f"their header. {_AGAIN}"
        )
    stated = data[at : at + 64].decode("latin-1")
    found = hashlib.sha256(data[:at] + _ZEROS.encode() + data[at + 64 :]).hexdigest()
    if found != stated:
        raise StoreError(
            f"{path} is damaged: its {len(data)} bytes have SHA-256 {found[:12]}..., expected "
            f"{stated[:12]!a}.... {_AGAIN}"
        )
    try:
        entry: Any = loads(data[8:end])
        about: Any = loads(entry["__metadata__"]["tsmlib"])
        schema, holds, _ = about["schema"], about["kind"], {**about["header"]}
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise StoreError(f"{path} has no readable header ({error!r:.200}). {_AGAIN}") from error
    if schema not in (1, SCHEMA):
        raise StoreError(f"{path} has format {schema!r:.80}, expected {SCHEMA}. {_AGAIN}")
    if kind is not None and holds != kind:
        raise StoreError(f"{path} holds a {holds!r:.80}, expected a '{kind}'. {_OTHER}")
    return data, about


def _require_finite(path: Path, tensors: Mapping[str, Tensor]) -> None:
    for name, tensor in tensors.items():
        bad = torch.nonzero(~torch.isfinite(tensor))
        if len(bad):
            index = tuple(bad[0].tolist())
            raise StoreError(
                f"{len(bad)} value(s) of '{name}' in {path} are not finite, the first at {index}: "
                f"{tensor[index].item()}. Expected finite numbers: check what computed them."
            )


def save_trajectories(
    path: PathLike, trajectories: Trajectories, header: Mapping[str, Json] | None = None
) -> None:
    """Write trajectories; ``header`` says where they come from (seed, controller, ...)."""
    require_type("trajectories", trajectories, Trajectories, "Trajectories")
    t = trajectories
    about = {field.name: getattr(t, field.name) for field in fields(Robot)[:-1]}
    if any(t.terminated):
        about["terminated"] = t.terminated
    if t.jumps:
        about["jumps"] = True
    arrays = {"states": t.flat_states, "actions": t.flat_actions}
    if len(set(t.lengths)) > 1:
        about["lengths"] = t.lengths
    else:
        arrays = {"states": t.states, "actions": t.actions}
    save(path, arrays, kind="trajectories", header={**(header or {}), "trajectories": about})


def load_trajectories(path: PathLike, *, expect: Mapping[str, Json] | None = None) -> Trajectories:
    """Read what ``save_trajectories`` wrote.

    Args:
        path: of the file.
        expect: fields of the robot, or of the header's ``fingerprint``, that must agree.

    Raises:
        StoreError: the file is missing, damaged or of something else.
    """
    path = Path(path)
    tensors, entry = _load(path, "trajectories")
    try:
        header = entry["header"]
        about: Any = header["trajectories"]
        states, actions = tensors["states"].numpy(), tensors["actions"].numpy()
        ends = {name: about.get(name) for name in ("lengths", "terminated")}
        jumps = bool(about.get("jumps"))
        known = {field.name: about[field.name] for field in fields(Robot)[:-1]}
        robot = Robot(**known, action_dim=actions.shape[-1])
        if states.ndim == 2:
            trajectories = Trajectories.from_rows(
                states, actions, ends["lengths"], robot, ends["terminated"], jumps=jumps
            )
        else:
            meaning = (robot.env, robot.dt, robot.names, robot.units, robot.angles)
            trajectories = Trajectories(states, actions, *meaning, jumps=jumps, **ends)
        stated: Any = header.get("fingerprint", {})
        found = {**stated, **about}
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise StoreError(f"{path} holds no usable trajectories: {error}. {_AGAIN}") from error
    require_fit(path, found, expect, only_stated=entry["schema"] == 1)
    return trajectories


def save_model(path: PathLike, model: Model, header: Mapping[str, Json] | None = None) -> None:
    """Write a model.

    Args:
        path: ends in .safetensors.
        model: its class, constructor arguments, robot and weights are kept.
        header: JSON values; those of ``fingerprint`` are compared by ``load_model``.

    Raises:
        StoreError: weights that are not finite, or no room.
    """
    require_type("path", path, (str, os.PathLike), "the path of a file")
    if not hasattr(model, "config"):
        raise TypeError(f"model is {described(model)}; expected one with config() and state_dict()")
    about = {**(header or {}), "class": type(model).__name__, "config": model.config()}
    stated = about.get("fingerprint", {})
    if hasattr(model, "segment_len") and isinstance(stated, Mapping):
        about["fingerprint"] = {"segment_len": model.segment_len, **stated}
    robot = getattr(model, "robot", None)
    if isinstance(robot, Robot):
        about["robot"] = asdict(robot)
    save(path, model.state_dict(), kind="model", header=about)


def load_model(path: PathLike, cls: type[M], *, expect: Mapping[str, Json] | None = None) -> M:
    """Read a model; no random number is drawn.

    Args:
        path: of the file.
        cls: class of the model.
        expect: fields of the file's fingerprint that must agree.

    Returns:
        The model, on the CPU, with its robot where the file states one.

    Raises:
        StoreError: the file is missing, damaged, of another class, or does not fit ``cls`` or
            ``expect``; both sides of what differs are named.
    """
    require_type("cls", cls, type, "a class of models, such as tsmlib.TSM")
    require_type("path", path, (str, os.PathLike), "the path of a file")
    path = Path(path)
    tensors, entry = _load(path, "model")
    header = entry["header"]
    if header.get("class") != cls.__name__:
        raise StoreError(
            f"{path} holds a {header.get('class')!r:.80}, expected a {cls.__name__}. {_OTHER}"
        )
    try:
        with torch.device("meta"):
            model = cls(**_known(header["config"], cls))
        differing = differences(_layout(tensors), _layout(model.state_dict()))
        differing += [f"{name} is unknown" for name in tensors.keys() - model.state_dict().keys()]
        fingerprint = {**header.get("fingerprint", {})}
        robot = _robot(header, fingerprint)
    except Exception as error:  # a constructor may fail in any way
        differing = [f"{error!r:.500}"]
    if differing:
        raise StoreError(
            f"{path} does not fit the present {cls.__name__}: {'; '.join(differing[:5])}. {_OTHER}"
        )
    require_fit(path, fingerprint, expect, only_stated=entry["schema"] == 1)
    owned = {name: tensor.clone() for name, tensor in tensors.items()}
    model.load_state_dict(owned, strict=True, assign=True)
    if robot is not None and hasattr(model, "robot"):
        model.robot = robot  # type: ignore[assignment] # of any model
    return model


def _known(config: Mapping[str, Json], cls: type) -> dict[str, Json]:
    """Arguments without those that are off, 0 or False, and that the class no longer has."""
    names = inspect.signature(cls).parameters
    return {name: value for name, value in config.items() if value or name in names}


def _robot(header: Mapping[str, Any], fingerprint: Mapping[str, Any]) -> Robot | None:
    """The robot that the file of a model states, if it states all of one."""
    stated = header.get("robot") or {
        **fingerprint,
        "action_dim": header["config"].get("action_dim"),
    }
    names = [field.name for field in fields(Robot)]
    if any(stated.get(name) is None for name in names):
        return None
    return Robot(**{name: stated[name] for name in names})


def require_fit(
    path: PathLike,
    found: Mapping[str, Json],
    expect: Mapping[str, Json] | None,
    *,
    only_stated: bool = False,
) -> None:
    """StoreError naming both sides of every field of ``expect`` that ``found`` does not hold."""
    if differing := differences(found, expect or {}, only_stated=only_stated):
        raise StoreError(f"{path} does not fit: {'; '.join(differing)}. {_OTHER}")


def differences(
    found: Mapping[str, Json], expected: Mapping[str, Json], *, only_stated: bool = False
) -> list[str]:
    """Both sides of every field of ``expected`` that ``found``, from a file, does not hold.

    Args:
        found: what the file says; ``standard`` in it holds values of fields that it leaves out.
        expected: what is needed, with ``standard`` likewise.
        only_stated: what the file does not mention is not compared, except the environment.
    """
    wanted = json.loads(json.dumps(dict(expected)))  # tuples become lists, as in a file
    stated, usual = found.get("standard"), wanted.pop("standard", {})
    if "simulator" in wanted:  # a whole fingerprint
        usual = {**(stated if isinstance(stated, Mapping) else {}), **usual}
        wanted, found = usual | wanted, usual | dict(found)
    return [
        f"{name} is {found.get(name, 'not stated')!r} in the file, expected {value!r}"
        for name, value in wanted.items()
        if found.get(name) != value and (name in found or name == "env" or not only_stated)
    ]


def _layout(tensors: Mapping[str, Tensor]) -> dict[str, Json]:
    """Type and shape of each array, in words."""
    return {
        name: f"{x.dtype} {list(x.shape)}".removeprefix("torch.") for name, x in tensors.items()
    }


def digest(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of named arrays, by name and content."""
    sha = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        sha.update(name.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
    return sha.hexdigest()


def trajectories_digest(data: Trajectories) -> str:
    """Sixteen digits that tell the states and actions of data sets apart."""
    arrays = {"states": data.flat_states, "actions": data.flat_actions}
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    if len(set(data.lengths)) > 1:
        tensors["lengths"] = torch.tensor(data.lengths)
    return digest(tensors)[:16]
