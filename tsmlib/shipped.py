"""Where that lies which ships: in a checkout, in the wheel, or in the wheel ``tsmlib-models``.

The wheel of the library holds tasks, notebooks and a few models; all other models, the published
tables and the explorer's page are in ``tsmlib-models``, whose files it knows by their SHA-256.
Nothing is fetched here: pip does that, from an index or from a folder.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import importlib.util
import json
import sys
from pathlib import Path

import tsmlib

_PACKAGE = Path(__file__).resolve().parent
INSTALLED = (_PACKAGE / "_shipped").is_dir()  # from a wheel
ROOT = _PACKAGE / "_shipped" if INSTALLED else _PACKAGE.parent
MORE = "tsmlib-models"


def find(name: str) -> Path:
    """The file or folder that ships under a name, which need not exist in a checkout.

    Args:
        name: its path in a checkout, such as "data/pretrained/Reacher/tsm.safetensors".

    Returns:
        Where it is here.

    Raises:
        ValueError: it is in tsmlib-models, which is missing, of another version, or changed.
    """
    path = ROOT / name
    if path.exists() or not INSTALLED:
        return path
    listed = [file for file in digests() if file == name or file.startswith(f"{name}/")]
    return more(name, listed) if listed else path


def more(name: str, files: list[str]) -> Path:
    """What tsmlib-models holds under ``name``, of which ``files`` are compared by their SHA-256."""
    version = tsmlib.__version__
    again = f"{sys.executable} -m pip install --force-reinstall --no-deps {MORE}=={version}"
    again += " (from a release folder: with --no-index --find-links FOLDER)"
    package = importlib.util.find_spec("tsmlib_models")
    if package is None or package.origin is None:
        raise ValueError(f"{name} is in the package {MORE}, which is not installed: type {again}")
    if (found := importlib.metadata.version(MORE)) != version:
        raise ValueError(f"{MORE} is {found}, and tsmlib is {version}: type {again}")
    folder = Path(package.origin).parent
    for file in files:
        path = folder / file
        if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != digests()[file]:
            state = "has another content than" if path.is_file() else "is missing, unlike in"
            raise ValueError(f"{path} {state} the release {version}: type {again}")
    return folder / name


@functools.cache
def digests() -> dict[str, str]:
    """SHA-256 of each file of data/ that is in tsmlib-models; none in a checkout."""
    listing = ROOT / "digests.json"
    return json.loads(listing.read_text()) if INSTALLED else {}
