"""JSON files, checksums and manifests of what ships or was made by a run."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tsmlib.storage import files as files_storage
from tsmlib.storage.artifacts import read_header
from tsmlib.storage.files import (
    MANIFEST,
    STATUS,
    Json,
    PathLike,
    StoreError,
    read_bytes,
    remedy,
    unpacked,
)


def write_json(path: PathLike, value: Json) -> None:
    """Write plain JSON values, in one step. Raises StoreError for anything that JSON cannot hold, NaN included."""
    files_storage.write_bytes(path, _as_written(Path(path), value))


def read_own_json(path: PathLike) -> dict[str, Json]:
    """The object in a manifest or a status, which must be as ``write_json`` left it, to the byte."""
    path = Path(path)
    data = read_bytes(path)
    value = _parsed(path, data)
    if not isinstance(value, dict) or data != _as_written(path, value):
        raise StoreError(f"{path} is damaged: it is not as it was written. {remedy(path)}")
    return value


def read_text(path: PathLike) -> str:
    """The text of a file, checked against the folder's manifest, if any; of one named ``*.gz`` what it unpacks to."""
    path = Path(path)
    data = read_bytes(path)
    _require_sha256(path, data, _listed(path.resolve()))
    try:
        return (unpacked(path, data) if path.suffix == ".gz" else data).decode()
    except UnicodeDecodeError as error:
        raise StoreError(f"{path} is not text: {error}. {remedy(path)}") from error


def _as_written(path: Path, value: Json) -> bytes:
    return (files_storage.dumps(path, value, indent=1) + "\n").encode()


def _parsed(path: Path, text: str | bytes) -> Json:
    try:
        return files_storage.loads(text)
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{path} is damaged, or no JSON: {error}. {remedy(path)}") from error


def sha256(path: PathLike) -> str:
    """SHA-256 of a file's bytes, as 64 hexadecimal digits."""
    return hashlib.sha256(read_bytes(path)).hexdigest()


def _require_sha256(path: Path, data: bytes, wanted: str | None) -> None:
    if wanted is not None and (found := hashlib.sha256(data).hexdigest()) != wanted:
        raise StoreError(
            f"{path} is damaged, or was changed after its run was complete: it has SHA-256 {found[:12]}..., expected "
            f"{wanted[:12]}.... {remedy(path)}"
        )


def write_manifest(folder: PathLike) -> None:
    """Write ``MANIFEST.json``: size and SHA-256 of every file under ``folder`` (for folders that are shipped)."""
    folder = Path(folder)
    files = [
        p
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name != MANIFEST and not p.name.startswith(".")
    ]
    write_json(folder / MANIFEST, sealed({"files": listing(folder, files)}))


def listing(folder: Path, files: Sequence[Path]) -> dict[str, dict[str, Json]]:
    """Size and SHA-256 of each file, by its name relative to ``folder``."""
    return {
        p.relative_to(folder).as_posix(): {"bytes": p.stat().st_size, "sha256": sha256(p)}
        for p in files
    }


def sealed(entry: Mapping[str, Json]) -> dict[str, Json]:
    """A JSON object with the SHA-256 of its other fields in ``sha256``."""
    return {**entry, "sha256": _seal(entry)}


def intact(entry: object) -> bool:
    """Whether an object that ``sealed`` made is as it was."""
    return isinstance(entry, dict) and "sha256" in entry and entry["sha256"] == _seal(entry)


def _seal(entry: Mapping[str, Json]) -> str:
    rest = {name: value for name, value in entry.items() if name != "sha256"}
    text = json.dumps(rest["files"] if set(rest) == {"files"} else rest, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def verify(path: PathLike) -> list[Path]:
    """Hash again an artefact and the inputs it names, or everything under a folder. Returns the files checked.

    In a folder, every artefact and every file that a manifest or a run's status lists is checked. Inputs that are no
    longer there are passed over. Raises StoreError listing every problem, one a line.
    """
    path = Path(path).resolve()
    if not path.exists():
        raise StoreError(
            f"{path} does not exist. Expected an artefact (*.safetensors) or a folder of them: check the name."
        )
    if path.is_file() and path.suffix != ".safetensors" and not _states(path) and not _listed(path):
        raise StoreError(
            f"{path} carries no checksum, and no {MANIFEST} or {STATUS} above it lists it: nothing to check. "
            "Name a folder, or an artefact (*.safetensors)."
        )
    problems: dict[str, None] = {}  # in order, each once
    checked: dict[Path, None] = {}

    def check(file: Path, wanted: str | None) -> None:
        try:
            if _states(file):
                for name, digest in _manifest(file).items():
                    check(file.parent / name, _listed(file.parent / name) or digest)
            else:
                _require_sha256(file, read_bytes(file), wanted)
            if file.suffix == ".safetensors" and file not in checked:
                checked[file] = None
                inputs = read_header(file).get("inputs", {})
                for name, stated in inputs.items() if isinstance(inputs, dict) else ():
                    if (file.parent / name).exists():
                        check((file.parent / name).resolve(), str(stated))
            checked[file] = None
        except ValueError as error:  # StoreError, or a name that no file can have
            problems[str(error)] = None

    for file in [path] if path.is_file() else sorted(path.rglob("*")):
        if file.suffix == ".safetensors" or _states(file) or file == path:
            check(file, _listed(file))
    if problems:
        raise StoreError("\n".join(problems))
    return list(checked)


def statuses(folder: Path) -> dict[str, Any]:
    """What the status files of a run state: notebook -> entry, in the order in which they were made.

    A notebook has its own, ``03_predict.status.json``; older runs have one for all, ``status.json``.
    """
    found: dict[str, Any] = {}
    for path in _status_files(folder):
        value = read_own_json(path)
        found |= value if path.name == STATUS else {path.name.removesuffix(f".{STATUS}"): value}
    return found


def _status_files(folder: Path) -> list[Path]:
    """Status files by when their notebooks ended, the older runs' first."""
    old = [folder / STATUS] if (folder / STATUS).is_file() else []
    return old + sorted(
        folder.glob(f"[!.]*.{STATUS}"),
        key=lambda path: str(read_own_json(path).get("finished", "")),
    )


def made_by(entries: Mapping[str, Any]) -> dict[str, str]:
    """File -> the notebook of ``statuses`` that made it; of several the last."""
    complete = (
        name
        for name, entry in entries.items()
        if intact(entry) and entry.get("state") == "complete"
    )
    return {file: name for name in complete for file in entries[name].get("files", {})}


def _states(path: Path) -> bool:
    """Whether a file is a manifest or a status."""
    return path.name in (MANIFEST, STATUS) or path.name.endswith(f".{STATUS}")


def _manifest(path: Path) -> dict[str, str]:
    """File name -> SHA-256, from a manifest that is itself intact, or from the complete notebooks of a status."""
    value: dict[str, Any] = read_own_json(path)
    try:
        if path.name == MANIFEST:
            entries = [value]
            if set(value) != {"files", "sha256"}:
                raise TypeError("expected 'files' and 'sha256'")
        else:
            entries = list(value.values()) if path.name == STATUS else [value]
            entries = [
                entry for entry in entries if "files" in entry and entry["state"] == "complete"
            ]
        digests = {
            name: str(file["sha256"]) for entry in entries for name, file in entry["files"].items()
        }
        whole = all(map(intact, entries))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise StoreError(f"{path} is not a manifest ({error!r}). {remedy(path)}") from error
    if not whole:
        raise StoreError(
            f"{path} is damaged: its entries do not have the SHA-256 that it states. {remedy(path)}"
        )
    if any(name.is_absolute() or ".." in name.parts for name in map(Path, digests)):
        raise StoreError(f"{path} lists files outside its own folder. {remedy(path)}")
    return digests


def _listed(path: Path) -> str | None:
    """The SHA-256 that the nearest manifest, or else the statuses beside each other, state for ``path``."""
    for folder in path.parents:
        stating = [folder / MANIFEST] if (folder / MANIFEST).is_file() else _status_files(folder)
        if stating:
            digests: dict[str, str] = {}
            for file in stating:
                digests |= _manifest(file)
            return digests.get(path.relative_to(folder).as_posix())
    return None
