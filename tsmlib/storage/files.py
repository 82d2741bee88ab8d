"""Atomic writes, one read, compression, JSON, and locks that name who holds them."""

import contextlib
import glob
import gzip
import io
import json
import math
import os
import socket
import sys
import threading
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import psutil
from filelock import FileLock, Timeout

PathLike = str | os.PathLike[str]
Json: TypeAlias = bool | int | float | str | Sequence["Json"] | Mapping[str, "Json"] | None

MANIFEST, STATUS = "MANIFEST.json", "status.json"
UNPACKED = 2**28  # bytes that a compressed file may hold


class StoreError(ValueError):
    """An artefact that cannot be written, read or trusted: names the file, what was found and expected, the remedy."""


def write_bytes(path: PathLike, data: bytes) -> None:
    """Replace ``path`` by ``data`` in one step, creating its folder; on failure the old file stays and nothing else."""
    path, here = Path(path), f".tmp-{socket.gethostname()}-"
    temporary = path.with_name(f".{path.name}{here}{threading.get_ident()}-{os.getpid()}")
    try:
        _make(path.parent)
        for left in path.parent.glob(
            f".*{glob.escape(here)}*"
        ):  # by a process of this machine that was killed
            if not alive(left.name.rpartition("-")[2]):
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
    """The bytes of a regular file. Raises StoreError for anything else."""
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            raise OSError("it is a folder or a device, expected a file")
        return path.read_bytes()
    except FileNotFoundError:
        raise StoreError(
            f"{path} does not exist. Check the name, or run the notebook that makes it."
        ) from None
    except (OSError, ValueError) as error:
        raise StoreError(f"cannot read {path}: {error}. Check its name and permissions.") from error


def packed(data: bytes) -> bytes:
    """Bytes as gzip, without a name or a time in it."""
    file = io.BytesIO()
    with gzip.GzipFile("", "wb", fileobj=file, mtime=0) as into:
        into.write(data)
    return file.getvalue()


def unpacked(path: Path, data: bytes) -> bytes:
    """What a file ``*.gz`` unpacks to. Raises StoreError for what is no gzip, cut, or larger than UNPACKED."""
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            found = file.read(UNPACKED + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise StoreError(f"{path} is damaged, or no gzip: {error}. {remedy(path)}") from error
    if len(found) > UNPACKED:
        raise StoreError(
            f"{path} unpacks to more than {UNPACKED} bytes, expected fewer. {remedy(path)}"
        )
    return found


def remedy(path: Path) -> str:
    """Advice about a damaged file."""
    if "data" in path.absolute().parts:
        return "Restore it: git checkout -- data in a clone; else install tsmlib again."
    return "Delete it and make it again."


def _cannot_write(what: str, error: OSError) -> StoreError:
    return StoreError(
        f"cannot write {what}: {error.strerror or error}. Make room or permission there, or name another folder with "
        "TSM_RUN_DIR."
    )


def _make(folder: Path) -> None:
    """Create a folder and those above it, so that they outlive a power cut."""
    if not folder.is_dir():
        _make(folder.parent)
        folder.mkdir(exist_ok=True)
        _sync(folder.parent)


def _sync(folder: Path) -> None:
    if os.name == "nt":  # Windows opens no folders
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def writer_lock(
    folder: PathLike, purpose: str, *, name: str = "", wait: bool = False
) -> Iterator[None]:
    """Exclusive right to write in ``folder``, made if need be; it ends with this process, however that ends.

    name: of the part of the folder that is written, where others may write the rest; '' is all of it. wait: until
    another holder is done, naming it on stderr, in place of StoreError naming it: process, machine, purpose and since.
    """
    hidden = f".{name}" if name else ""
    lock, holder = FileLock(Path(folder) / f"{hidden}.lock"), Path(folder) / f"{hidden}.writer"
    try:
        _make(Path(folder))
        if who := _acquire_or_name(lock, holder):
            if not wait:
                raise StoreError(
                    f"{Path(folder) / name} is being written by another process ({who}). Wait for it or end it, or "
                    "take another seed, or another folder with TSM_RUN_DIR."
                )
            sys.stderr.write(f"waiting for {who}, which writes {Path(folder) / name}\n")
            lock.acquire(poll_interval=0.5)
    except OSError as error:
        raise _cannot_write(f"in {folder}", error) from error
    try:
        since = time.strftime("%F %T%z")
        with contextlib.suppress(OSError):  # a full disk: nameless, but locked
            holder.write_text(
                f"pid {os.getpid()} on {socket.gethostname()}, {purpose}, since {since}"
            )
        yield
    finally:
        with contextlib.suppress(OSError):
            holder.unlink()
        lock.release()


def _acquire_or_name(lock: FileLock, holder: Path) -> str:
    """Who holds the lock, "unknown" where that is not said within two seconds; '' once it is acquired."""
    for _ in range(10):  # a new holder writes its name at once, on a busy machine a little later
        with contextlib.suppress(Timeout):
            lock.acquire(timeout=0.2)
            return ""
        with contextlib.suppress(OSError):
            if who := holder.read_text():
                return who
    return "unknown"


def alive(pid: object, host: object = None) -> bool:
    """Whether there may be a process of this number; True for what is none, or is of another machine.

    host: the machine's name; None is this one.
    """
    try:
        return host not in (None, socket.gethostname()) or psutil.pid_exists(int(str(pid)))
    except (ValueError, OverflowError):
        return True


def loads(text: str | bytes) -> Json:
    """JSON values without the numbers that JSON does not have. Raises ValueError, or RecursionError for deep ones."""

    def refuse(word: str) -> None:
        raise ValueError(f"{word} is not a JSON value")

    return json.loads(text, parse_constant=refuse)


def encode_nonfinite(value: Json) -> Any:
    """JSON in which the numbers that it does not have are the texts "nan", "inf" and "-inf"."""
    if isinstance(value, float | np.floating):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, Mapping):
        return {name: encode_nonfinite(item) for name, item in value.items()}
    return [encode_nonfinite(item) for item in value] if isinstance(value, list | tuple) else value


def decode_nonfinite(value: Json) -> Any:
    """The numbers again. Any text that is one of the three becomes one, so only for values without texts of their own;
    tuples have become lists."""
    if isinstance(value, Mapping):
        return {name: decode_nonfinite(item) for name, item in value.items()}
    if isinstance(value, list):
        return [decode_nonfinite(item) for item in value]
    return float(value) if isinstance(value, str) and value in ("nan", "inf", "-inf") else value


def dumps(path: Path, value: Json, indent: int | None = None) -> str:
    """JSON text for ``path``. Raises StoreError for anything that JSON cannot hold, NaN included."""

    def convert(item: object) -> object:
        if isinstance(item, np.generic):
            return item.item()
        raise TypeError(f"a {type(item).__name__} is not a JSON value: {item!r:.80}")

    separators = (",", ":") if indent is None else None
    try:
        return json.dumps(
            value, allow_nan=False, default=convert, indent=indent, separators=separators
        )
    except (TypeError, ValueError, RecursionError) as error:
        raise StoreError(
            f"the header or JSON for {path} cannot be written: {error}. Nothing was written."
        ) from error
