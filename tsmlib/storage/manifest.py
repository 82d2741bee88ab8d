"""JSON files, checksums and manifests of what ships or was made by a run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tsmlib.storage.artifacts import read_header
from tsmlib.storage.files import MANIFEST, STATUS, PathLike, StoreError, _again, _dumps, _loads, _read, write_bytes


def write_json(path: PathLike, value: Any) -> None:
    """Write plain JSON values, in one step. Raises StoreError for anything that JSON cannot hold, NaN included."""
    write_bytes(path, (_dumps(Path(path), value, indent=1) + "\n").encode())


def read_json(path: PathLike) -> Any:
    """Read a JSON file. Checked against the folder's manifest, if any."""
    try:
        return _loads(_text(Path(path)))
    except (ValueError, RecursionError) as error:
        if isinstance(error, StoreError):
            raise
        raise StoreError(f"{path} is not valid JSON: {error}. {_again(Path(path))}") from error


def read_own_json(path: PathLike) -> Any:
    """Read a manifest or a status, which must be as ``write_json`` left it, to the byte."""
    path = Path(path)
    data = _read(path)
    try:
        value = _loads(data)
        as_written = data == (_dumps(path, value, indent=1) + "\n").encode()
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{path} is damaged: {error}. {_again(path)}") from error
    if not as_written or not isinstance(value, dict):
        raise StoreError(f"{path} is damaged: it is not as it was written. {_again(path)}")
    return value


# Manifests and verification ------------------------------------------------------------------------------------------


def sha256(path: PathLike) -> str:
    """SHA-256 of a file's bytes, as 64 hexadecimal digits."""
    return hashlib.sha256(_read(Path(path))).hexdigest()


def write_manifest(folder: PathLike) -> None:
    """Write ``MANIFEST.json``: size and SHA-256 of every file under ``folder`` (for folders that are shipped)."""
    folder = Path(folder)
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != MANIFEST and not p.name.startswith(".")]
    write_json(folder / MANIFEST, sealed({"files": listing(folder, files)}))


def listing(folder: Path, files: Sequence[Path]) -> dict[str, dict[str, Any]]:
    """Size and SHA-256 of each file, by its name relative to ``folder``."""
    return {p.relative_to(folder).as_posix(): {"bytes": p.stat().st_size, "sha256": sha256(p)} for p in files}


def sealed(entry: Mapping[str, Any]) -> dict[str, Any]:
    """A JSON object with the SHA-256 of its other fields in ``sha256``."""
    return {**entry, "sha256": _seal(entry)}


def intact(entry: Any) -> bool:
    """Whether an object that ``sealed`` made is as it was."""
    return isinstance(entry, dict) and "sha256" in entry and entry["sha256"] == _seal(entry)


def _seal(entry: Mapping[str, Any]) -> str:
    rest = {name: value for name, value in entry.items() if name != "sha256"}
    text = json.dumps(rest["files"] if set(rest) == {"files"} else rest, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def verify(path: PathLike) -> list[Path]:
    """Hash again an artefact and the inputs it names, or everything under a folder. Returns the files checked.

    In a folder, every artefact and every file that a manifest or a run's status lists is checked. Inputs that are no
    longer there are passed over. Raises StoreError listing every problem, one a line.
    """
    path = Path(path)
    if not path.exists():
        raise StoreError(
            f"{path} does not exist. Expected an artefact (*.safetensors) or a folder of them: check the name."
        )
    problems: dict[str, None] = {}  # in order, each once
    checked: dict[Path, None] = {}

    def check(file: Path, wanted: str | None) -> None:
        try:
            if wanted is not None and (found := sha256(file)) != wanted:
                raise StoreError(f"{file} has SHA-256 {found[:12]}..., expected {wanted[:12]}.... {_again(file)}")
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
        if file.name in (MANIFEST, STATUS):
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
                raise StoreError(
                    f"{file} carries no checksum, and no {MANIFEST} or {STATUS} above it lists it: nothing to check. "
                    "Name a folder, or an artefact (*.safetensors)."
                )
            check(file, stated)
    if problems:
        raise StoreError("\n".join(problems))
    return list(checked)


def _manifest(path: Path) -> dict[str, str]:
    """File name -> SHA-256, from a manifest that is itself intact, or from the complete notebooks of a status."""
    try:
        value = read_own_json(path)
        if path.name == STATUS:
            entries = [entry for entry in value.values() if "files" in entry and entry["state"] == "complete"]
        else:
            entries = [value]
            if set(value) != {"files", "sha256"}:
                raise TypeError("expected 'files' and 'sha256'")
        digests = {name: str(file["sha256"]) for entry in entries for name, file in entry["files"].items()}
        whole = all(map(intact, entries))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        if isinstance(error, StoreError):
            raise
        raise StoreError(f"{path} is not a manifest ({error!r}). {_again(path)}") from error
    if not whole:
        raise StoreError(f"{path} is damaged: its entries do not have the SHA-256 that it states. {_again(path)}")
    if any(name.is_absolute() or ".." in name.parts for name in map(Path, digests)):
        raise StoreError(f"{path} lists files outside its own folder. {_again(path)}")
    return digests


def _listed(path: Path) -> str | None:
    """The SHA-256 that the nearest manifest or status states for ``path``."""
    for folder in path.parents:
        for name in (MANIFEST, STATUS):
            if (folder / name).is_file():
                return _manifest(folder / name).get(path.relative_to(folder).as_posix())
    return None


def _text(path: Path) -> str:
    data = _read(path)
    wanted = _listed(path.resolve())
    if wanted is not None and (found := hashlib.sha256(data).hexdigest()) != wanted:
        raise StoreError(
            f"{path} is damaged, or was changed after its run was complete: its SHA-256 is {found[:12]}..., expected "
            f"{wanted[:12]}.... {_again(path)}"
        )
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise StoreError(f"{path} is not text: {error}. {_again(path)}") from error
