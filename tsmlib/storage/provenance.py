"""What made an artefact: code, libraries, processor, threads. It travels inside every file and in every status.json."""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
from pathlib import Path
from typing import Any

import torch

import tsmlib

LIBRARIES = ("torch", "numpy", "mujoco", "gymnasium", "pymunk", "safetensors")


def provenance() -> dict[str, Any]:
    """Code version, library versions, processor and threads, as JSON values. No times, no paths, no names of people.

    Two results with equal provenance, seed and inputs should be equal bit for bit where the processor computed them.
    """
    return {**_FIXED, "threads": torch.get_num_threads()}


def _fixed() -> dict[str, Any]:
    package = Path(tsmlib.__file__).parent
    sources = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        sources.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    return {
        "code": f"{tsmlib.__version__}+{sources.hexdigest()[:12]}",  # of the sources: right in a changed tree too
        "commit": _commit(package.parent / ".git"),
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in LIBRARIES},
        "cpu": f"{_processor()}, {torch.backends.cpu.get_cpu_capability()}",
    }


def _commit(git: Path) -> str:
    """The checked-out commit, read without running git; '' outside a clone."""
    try:
        if git.is_file():  # in a linked worktree, which names its own folder and that the folder of all
            git = git.parent / git.read_text().removeprefix("gitdir: ").strip()
        head = (git / "HEAD").read_text().strip()
        if not head.startswith("ref: "):
            return head[:12]
        name = head.removeprefix("ref: ")
        if (git / "commondir").exists():
            git = git / (git / "commondir").read_text().strip()
        if (git / name).exists():
            return (git / name).read_text().strip()[:12]
        packed = (git / "packed-refs").read_text().splitlines()
        return next((line.split()[0][:12] for line in packed if line.endswith(f" {name}")), "")
    except OSError:
        return ""


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


_FIXED = _fixed()  # now, since sources may change while they are in use
