"""Provenance: what made a file, inside the file."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import platform
from pathlib import Path

import torch

import tsmlib

LIBRARIES = ("torch", "numpy", "mujoco", "gymnasium", "pymunk", "safetensors")


def provenance() -> dict[str, str | int]:
    """Versions of code and libraries, kind of CPU, threads; no times, no paths, no names.

    Two results of equal provenance, seed and inputs are equal bit for bit if a CPU computed them.
    """
    return {**_versions(), "threads": torch.get_num_threads()}


@functools.cache
def _versions() -> dict[str, str]:
    package, sources = Path(tsmlib.__file__).parent, hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        sources.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    return {
        "code": f"{tsmlib.__version__}+{sources.hexdigest()[:12]}",
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in LIBRARIES},
        "cpu": f"{platform.machine()}, {torch.backends.cpu.get_cpu_capability()}",
    }


_versions()  # now, since sources may change while they are in use
