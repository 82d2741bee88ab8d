"""How bytes reach the disk: all of a file or none of it, even through a power cut, and one writer per folder."""

from __future__ import annotations

import contextlib
import json
import os
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil

PathLike = str | os.PathLike[str]


class StoreError(ValueError):
    """An artefact that cannot be written, read or trusted: names the file, what was found and expected, the remedy."""


def write_bytes(path: PathLike, data: bytes) -> None:
    """Replace ``path`` by ``data`` in one step, creating its folder; on failure the old file stays and nothing else."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.tmp-{os.getpid()}")
    try:
        _make(path.parent)
        for left in path.parent.glob(".*.tmp-*"):  # by a process that was killed
            if not alive(left.name.rpartition("-")[2]):
                left.unlink(missing_ok=True)
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _sync(path.parent)
    except OSError as error:
        raise StoreError(
            f"cannot write {path} ({len(data)} bytes): {error.strerror or error}. Make room or permission there, or "
            "name another folder with TSM_RUN_DIR."
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _make(folder: Path) -> None:
    """Make a folder and those above it, so that they outlive a power cut."""
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


def alive(pid: Any) -> bool:
    """Whether there may be a process of this number; True for what is none."""
    try:
        return psutil.pid_exists(int(pid))
    except (TypeError, ValueError, OverflowError):
        return True


@contextlib.contextmanager
def only_writer(folder: PathLike, purpose: str) -> Iterator[None]:
    """Hold ``folder``, made if need be, against other writers; the lock goes when this process does.

    Raises StoreError naming the holder: process, machine, purpose and since when.
    """
    try:
        import fcntl
    except ImportError:  # no such locks on Windows
        yield
        return
    try:
        _make(Path(folder))
        lock = open(Path(folder) / ".lock", "a+")  # noqa: SIM115 - closed below
    except OSError as error:
        raise StoreError(
            f"cannot write in {folder}: {error.strerror or error}. Make room or permission there, or name another "
            "folder with TSM_RUN_DIR."
        ) from error
    with lock:
        for attempt in range(20):
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError:
                lock.seek(0)
                if (holder := lock.read().strip()) or attempt == 19:  # it may be about to write its name
                    raise StoreError(
                        f"{folder} is being written by another process ({holder or 'unknown'}). Wait for it or end "
                        "it, or take another seed, or another folder with TSM_RUN_DIR."
                    ) from None
                time.sleep(0.05)
        lock.truncate(0)
        lock.write(f"pid {os.getpid()} on {socket.gethostname()}, {purpose}, since {time.strftime('%F %T%z')}")
        lock.flush()
        try:
            yield
        finally:
            lock.truncate(0)


MANIFEST, STATUS = "MANIFEST.json", "status.json"
_MAKES = {"trajectories": "collect", "model": "train"}  # kind -> notebook; for others, all of them


def _again(path: Path, kind: str | None = None) -> str:
    """What to do about a file that is damaged."""
    if path.name == STATUS:
        return f"Delete it and run the notebooks again: {_command(path)}"
    if any((folder / MANIFEST).is_file() for folder in path.absolute().parents):
        return "Restore it: git checkout -- data, where it came with the repository."
    if kind == "checkpoint":
        return "Delete it: training goes on from the one before it."
    what = "make it again" if kind in _MAKES else "run the notebook that makes it, or all of them"
    return f"Delete it and {what}: {_command(path, kind)}"


def _other(path: Path, kind: str) -> str:
    """What to do about a whole file that is not the one that was asked for."""
    instead = f", or delete it and make one that fits: {_command(path, kind)}" if kind in _MAKES else "."
    return f"Name another file{instead}"


def _command(path: Path, kind: str | None = None) -> str:
    """What makes a file, with the scale and the seed of the run that it lies in."""
    run = re.search(r"/(smoke|laptop|paper)/seed(\d+)/", path.absolute().as_posix())
    options = f" --scale {run[1]} --seed {run[2]}" if run else ""
    return f"python -m tsmlib run {_MAKES.get(kind or '', 'all')}{options}"


def _loads(text: str | bytes) -> Any:
    """JSON without the numbers that JSON does not have."""

    def refuse(word: str) -> Any:
        raise ValueError(f"{word} is not a JSON value")

    return json.loads(text, parse_constant=refuse)


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


# Bytes ---------------------------------------------------------------------------------------------------------------


def _read(path: Path, kind: str | None = None) -> bytes:
    try:
        if path.exists() and not path.is_file():
            raise OSError("it is a folder or a device, expected a file")
        return path.read_bytes()
    except FileNotFoundError:
        remedy = (
            f"Make it: {_command(path, kind)}"
            if kind in _MAKES
            else "Check the name, or run the notebook that makes it."
        )
        raise StoreError(f"{path} does not exist. {remedy}") from None
    except (OSError, ValueError) as error:
        raise StoreError(f"cannot read {path}: {error}. Check its name and permissions.") from error
