"""Provenance: code, libraries, CPU and threads, inside every artefact and every status.json."""

import hashlib
import importlib.metadata
import platform
import subprocess
from pathlib import Path

import torch

import tsmlib

LIBRARIES = ("torch", "numpy", "mujoco", "gymnasium", "pymunk", "safetensors")


def provenance() -> dict[str, str | int]:
    """Code version, library versions, CPU and threads, as JSON values. No times, no paths, no names of people.

    Two results with equal provenance, seed and inputs should be equal bit for bit where the CPU computed them.
    """
    return {**_FIXED, "threads": torch.get_num_threads()}


def _fixed() -> dict[str, str | int]:
    package = Path(tsmlib.__file__).parent
    sources = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        sources.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    return {
        "code": f"{tsmlib.__version__}+{sources.hexdigest()[:12]}",  # of the sources: right in a changed tree too
        "commit": _commit(package.parent),
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in LIBRARIES},
        "cpu": f"{_processor()}, {torch.backends.cpu.get_cpu_capability()}",
    }


def _commit(folder: Path) -> str:
    """The checked-out commit; '' outside a clone, or without git."""
    if not (folder / ".git").exists():
        return ""
    try:
        command = ["git", "-C", str(folder), "rev-parse", "--short=12", "HEAD"]
        return subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=10
        ).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        return ""


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(
            line.partition(":")[2].strip() for line in lines if line.startswith("model name")
        )
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


_FIXED = _fixed()  # now, since sources may change while they are in use
