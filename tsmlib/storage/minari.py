"""Data from elsewhere: a Minari data set (or any HDF5 file laid out like one) becomes ``Trajectories``.

An HDF5 file from a stranger can point at other files on this machine, and declare terabytes in a kilobyte. So the whole
file is looked over before any of its data is read, and one thing that is not plain numbers stored in that file itself
refuses it. h5py is needed for this alone: ``pip install tsmlib[minari]``.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from tsmlib.storage.files import PathLike, StoreError
from tsmlib.trajectory import Trajectories, TrajectoryError

MAX_OBJECTS = 200_000  # groups and data sets: 20,000 Minari episodes
MAX_DEPTH = 8
MAX_RATIO = 20  # declared bytes over stored bytes, of compressed data
FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32"}  # all in HDF5 itself; others would load a library


def load_minari(
    path: PathLike, *, env: str, dt: float, names: tuple[str, ...], units: tuple[str, ...], angles: tuple[int, ...] = ()
) -> Trajectories:
    """The episodes of a Minari data set: its folder, or its ``main_data.hdf5``; all must be equally long.

    Of an episode, ``observations`` (T + 1, dx) and ``actions`` (T, du) are read; what they mean (env, dt, names, units,
    angles) is said here, since the file does not. Raises StoreError, before any data is read, for a file with links to
    other files, external or virtual storage, types other than numbers, filters beyond gzip, shuffle and fletcher32,
    compressed data without fletcher32, or more declared than stored; and for data that are no trajectories.
    """
    path = Path(path)
    file = path / "data" / "main_data.hdf5" if path.is_dir() else path
    if not file.is_file():
        raise StoreError(f"{file} is not a file; expected a Minari data set's folder, or its main_data.hdf5.")
    try:
        import h5py
    except ImportError:
        raise StoreError(f"reading {file} needs h5py: pip install 'tsmlib[minari]'") from None
    try:
        with h5py.File(file, "r", locking=False) as root:
            _Inspection(h5py, file).group(root, "", 0)
            found = sorted(
                (int(match[1]), name) for name in root if (match := re.fullmatch(r"episode_(\d{1,9})", name, re.ASCII))
            )
            if not found:
                raise StoreError(f"{file} holds no group episode_0; expected one per episode, as Minari writes them.")
            episodes = [_episode(h5py, file, root, name) for _, name in found]
    except (
        OSError,
        RuntimeError,
        KeyError,
        ValueError,
        TypeError,
        AttributeError,
    ) as error:  # what libhdf5 makes of it
        if isinstance(error, StoreError):
            raise
        raise StoreError(f"{file} is not a whole HDF5 file: {error!r:.200}. Ask for it again.") from error
    if len({states.shape for states, _ in episodes}) > 1 or len({actions.shape for _, actions in episodes}) > 1:
        lengths = sorted({len(actions) for _, actions in episodes})
        raise StoreError(
            f"{file} holds episodes of {lengths[0]} to {lengths[-1]} steps; expected equally long ones. Cut them to "
            "one length."
        )
    try:
        return Trajectories(
            np.stack([states for states, _ in episodes]), np.stack([actions for _, actions in episodes]),
            env, dt, names, units, angles,
        )  # fmt: skip
    except TrajectoryError as error:
        raise StoreError(f"{file} does not hold what env, names and units say: {error}") from error


def _episode(h5py: Any, file: Path, root: Any, name: str) -> tuple[np.ndarray, np.ndarray]:
    """States (T + 1, dx) and actions (T, du) in float32."""
    arrays = []
    for part in ("observations", "actions"):
        data = root[name].get(part)
        if not isinstance(data, h5py.Dataset) or len(data.shape) != 2 or data.dtype.kind not in "fi":
            raise StoreError(
                f"{file}: {name}/{part} is {data!r:.80}, expected numbers of shape (steps, size). "
                "Record flat vectors, no dictionaries."
            )
        arrays.append(np.asarray(data[()], np.float32))
    return arrays[0], arrays[1]


class _Inspection:
    """Looks at everything in a file, following no link and reading no data; what is out of place refuses it."""

    def __init__(self, h5py: Any, file: Path) -> None:
        self.h5py, self.file, self.seen = h5py, file, set[int]()
        self.left = file.stat().st_size  # bytes that may still be claimed

    def group(self, group: Any, name: str, depth: int) -> None:
        """A group and all below it."""
        if depth > MAX_DEPTH:
            self.refuse(name, f"groups are nested more than {MAX_DEPTH} deep")
        for key in group:
            inner = f"{name}/{key}"
            if len(self.seen) > MAX_OBJECTS:
                self.refuse(inner, f"it holds more than {MAX_OBJECTS} objects")
            link = group.get(key, getlink=True)
            if not isinstance(link, self.h5py.HardLink):
                self.refuse(inner, f"it is a link ({type(link).__name__}), possibly to another file")
            child = group.get(key)
            address = self.h5py.h5o.get_info(child.id).addr
            if address in self.seen:
                self.refuse(inner, "it is the same object as one before, under another name")
            self.seen.add(address)
            match child:
                case self.h5py.Group() as below:
                    self.group(below, inner, depth + 1)
                case self.h5py.Dataset() as data:
                    self.dataset(data, inner)
                case other:
                    self.refuse(inner, f"it is a {type(other).__name__}")

    def dataset(self, data: Any, name: str) -> None:
        """A data set: plain numbers, in this file, as many as are declared."""
        plist, where = data.id.get_create_plist(), data.id.get_type()
        if plist.get_external_count():
            self.refuse(name, "its data lie in another file")
        if data.is_virtual:
            self.refuse(name, "it is a view of other data sets")
        if where.get_class() not in (self.h5py.h5t.INTEGER, self.h5py.h5t.FLOAT, self.h5py.h5t.ENUM):
            if name.rpartition("/")[2] == "infos":
                return  # texts about each step, which Minari adds and nobody here reads
            self.refuse(name, f"it holds {data.dtype}, not numbers")
        filters = [plist.get_filter(i)[0] for i in range(plist.get_nfilters())]
        if unknown := [number for number in filters if number not in FILTERS]:
            self.refuse(name, f"it uses filter {unknown[0]}, expected {', '.join(FILTERS.values())} or none")
        packed = 1 in filters
        if packed and 3 not in filters:
            self.refuse(name, "it is compressed without a checksum (fletcher32)")
        declared, stored = data.nbytes, data.id.get_storage_size()
        self.left -= stored
        if declared > (MAX_RATIO if packed else 1) * stored or self.left < 0:
            self.refuse(name, f"it declares {declared} bytes and stores {stored}")

    def refuse(self, name: str, found: str) -> None:
        raise StoreError(
            f"{self.file}: {name[:80]!a} was not read, because {found}. Expected plain numbers, stored in this file. "
            "Ask whoever made it for a copy written by Minari itself."
        )
