"""Atomic writes, one read, JSON, and a lock that names who holds it."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import socket
import threading
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from filelock import FileLock, Timeout

PathLike = str | os.PathLike[str]
Json: TypeAlias = bool | int | float | str | Sequence["Json"] | Mapping[str, "Json"] | None
NO_LOCKS = (errno.EOPNOTSUPP, errno.ENOLCK)  # of flock, as on some network folders
LEFT_AFTER = 3600  # s, after which a temporary file was left by a process that was killed


class StoreError(ValueError):
    """A file that cannot be written, read or trusted: what was found, expected, and the remedy."""


def write_bytes(path: PathLike, data: bytes) -> None:
    """Replace a file in one step, creating its folder; on failure the old file stays.

    Args:
        path: of the file.
        data: its new content.

    Raises:
        StoreError: it cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.tmp-{os.getpid()}-{threading.get_ident()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for left in path.parent.glob(".*.tmp-*"):
            if left != temporary and time.time() - left.stat().st_mtime > LEFT_AFTER:
                left.unlink(missing_ok=True)
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _sync(path.parent)
    except OSError as error:
        raise _cannot_write(f"{path} ({len(data)} bytes)", error) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def read_bytes(path: PathLike) -> bytes:
    """The bytes of a regular file; StoreError for anything else."""
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            raise OSError("it is a folder or a device, expected a file")
        return path.read_bytes()
    except FileNotFoundError:
        raise StoreError(f"{path} does not exist: check its name, or make it first.") from None
    except (OSError, ValueError) as error:
        raise StoreError(f"cannot read {path}: {error}. Check its name and permissions.") from error


def _cannot_write(what: str, error: OSError) -> StoreError:
    return StoreError(
        f"cannot write {what}: {error.strerror or error}. Make room or permission there, or name "
        "another folder."
    )


def _sync(folder: Path) -> None:
    """Let a rename outlive a power cut."""
    if os.name == "nt":  # Windows opens no folders
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def writer_lock(folder: PathLike, purpose: str) -> Iterator[None]:
    """Hold the right to write in a folder, which ends with this process, however that ends.

    Where the file system has no locks a warning says so, and nothing keeps two writers apart.

    Args:
        folder: made if it is not there.
        purpose: told to another process that wants to write.

    Raises:
        StoreError: another process writes there; process, machine, purpose and since are named.
    """
    folder = Path(folder)
    lock, holder = FileLock(folder / ".lock"), folder / ".writer"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _acquire(lock, holder)
    except (OSError, NotImplementedError) as error:  # the second of an older filelock
        if isinstance(error, OSError) and error.errno not in NO_LOCKS:
            raise _cannot_write(f"in {folder}", error) from error
        warnings.warn(
            f"{folder} is on a file system without locks (flock): see to it that no other process "
            "writes there, or name a folder on a local disk",
            stacklevel=3,
        )
    try:
        since, host = time.strftime("%F %T%z"), socket.gethostname()
        with contextlib.suppress(OSError):  # a full disk: nameless, but locked
            holder.write_text(f"pid {os.getpid()} on {host}, {purpose}, since {since}")
        yield
    finally:
        with contextlib.suppress(OSError):
            holder.unlink()
        lock.release()


def _acquire(lock: FileLock, holder: Path) -> None:
    who = ""
    for _ in range(10):  # a new holder writes its name at once, on a busy machine a little later
        with contextlib.suppress(Timeout):
            lock.acquire(timeout=0.2)
            return
        with contextlib.suppress(OSError):
            who = holder.read_text()
        if who:
            break
    raise StoreError(
        f"{holder.parent} is being written by another process ({who or 'unknown'}). Wait for it, "
        "end it, or name another folder."
    )


def loads(text: str | bytes) -> Json:
    """JSON without the numbers that it does not have; ValueError, or RecursionError if deep."""

    def refuse(word: str) -> None:
        raise ValueError(f"{word} is not a JSON value")

    value: Json = json.loads(text, parse_constant=refuse)
    return value


def dumps(path: PathLike, value: Json) -> str:
    """JSON for ``path``; StoreError for anything that it cannot hold, NaN included."""

    def convert(item: object) -> object:
        if isinstance(item, np.generic):
            return item.item()
        raise TypeError(f"a {type(item).__name__} is not a JSON value: {item!r:.80}")

    try:
        return json.dumps(value, allow_nan=False, default=convert, separators=(",", ":"))
    except (TypeError, ValueError, RecursionError) as error:
        raise StoreError(f"the header of {path} cannot be written: {error}.") from error


def encode_nonfinite(value: Json) -> Any:
    """JSON in which the numbers that it does not have are the texts "nan", "inf" and "-inf"."""
    if isinstance(value, float | np.floating):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, Mapping):
        return {name: encode_nonfinite(item) for name, item in value.items()}
    return [encode_nonfinite(item) for item in value] if isinstance(value, list | tuple) else value


def decode_nonfinite(value: Json) -> Any:
    """The numbers again; for values without texts of their own. Tuples have become lists."""
    if isinstance(value, Mapping):
        return {name: decode_nonfinite(item) for name, item in value.items()}
    if isinstance(value, list):
        return [decode_nonfinite(item) for item in value]
    return float(value) if isinstance(value, str) and value in ("nan", "inf", "-inf") else value
