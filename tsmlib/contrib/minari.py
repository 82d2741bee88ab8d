"""Minari data sets, read as ``Trajectories``. Needs tsmlib[minari].

An HDF5 file from a stranger can point at other files on this machine and declare terabytes in a
kilobyte, and Minari imports the environment that a data set names where it states no spaces. So
before Minari reads, the data set must state two flat Box spaces, and its file hold plain numbers
only, stored in it. No environment that a file names is made.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from tsmlib.envs.ids import stated_id
from tsmlib.storage.files import Json, PathLike, StoreError, read_bytes
from tsmlib.trajectory import Trajectories

MAX_RATIO = 20  # bytes that a file declares over its own
_SUPPORTED = "supported are observations and actions that are Boxes of one dimension, with bounds"


def load_minari(
    path: PathLike,
    *,
    env: str | None = None,
    dt: float | None = None,
    names: tuple[str, ...] | None = None,
    units: tuple[str, ...] | None = None,
    angles: tuple[int, ...] = (),
) -> Trajectories:
    """Read the episodes of a local Minari data set; rewards are not read.

    Args:
        path: its folder, or its id where Minari keeps it.
        env: id of the environment; by default the data set's, or the name of the data set.
        dt: seconds per step; by default one, with a warning.
        names: one word per state dimension; x0, x1, ... by default.
        units: one per state dimension; none by default.
        angles: state dimensions that are angles in radians.

    Returns:
        Trajectories whose actions are scaled from the bounds of the action space to [-1, 1].

    Raises:
        StoreError: anything else than flat Box spaces and plain numbers.
    """
    minari = _minari(path)
    place = Path(path) if Path(path).is_dir() else minari.storage.get_dataset_path(str(path))
    folder = place / "data" if (place / "data").is_dir() else place
    try:
        metadata = json.loads(read_bytes(folder / "metadata.json"))
        low, high = _require_plain(folder, metadata)
        if env is None:
            stated = metadata.get("env_spec")
            env = metadata["dataset_id"] if stated is None else stated_id(json.loads(stated))
        states, actions, terminated = [], [], []
        for x, u, ended in _episodes(minari.MinariDataset(folder), low, high):
            states.append(x)
            actions.append(u)
            terminated.append(ended)
        if dt is None:
            warnings.warn(
                f"{place} does not say how long a step is; one step counts as one second: "
                "give dt=...",
                stacklevel=2,
            )
            dt = 1.0
        return Trajectories(states, actions, env, dt, names, units, angles, terminated=terminated)
    except Exception as error:  # of other libraries, which may fail in any way
        raise StoreError(
            f"{place} holds no usable Minari data set: {str(error) or repr(error):.500}. Expected "
            "flat Box spaces and plain numbers in main_data.hdf5, as Minari itself writes them."
        ) from error


def _minari(what: PathLike) -> ModuleType:
    try:
        import h5py  # noqa: F401
        import minari
    except ImportError:
        raise StoreError(
            f"{what}: Minari data sets need minari and h5py: pip install 'tsmlib[minari]'"
        ) from None
    return minari


def _episodes(
    dataset: Any, low: np.ndarray, high: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray, bool]]:
    """States (T + 1, dx), actions (T, du) in [-1, 1] and whether it terminated, of each episode."""
    centre, half = (low + high) / 2, (high - low) / 2
    for number, episode in enumerate(dataset.iterate_episodes()):
        actions = np.asarray(episode.actions, np.float64)
        over = np.asarray(episode.terminations).astype(bool)
        if actions.ndim != 2 or actions.shape[1] != len(low) or not len(actions) == len(over) > 0:
            raise ValueError(
                f"episode {number} has actions {actions.shape} and terminations {over.shape}, "
                f"expected (T, {len(low)}) and (T,) with at least one step"
            )
        if over[:-1].any():
            raise ValueError(
                f"episode {number} goes on after its termination at step {int(over.argmax())}, "
                "expected its end there"
            )
        scaled = (actions - centre) / half
        if (most := np.abs(scaled).max()) > 1 + 1e-5:
            raise ValueError(
                f"actions of episode {number} leave the action space, by a factor of {most:g}, "
                "expected them within "
                f"{low.tolist()!s:.80} to {high.tolist()!s:.80}"
            )
        yield (
            np.asarray(episode.observations, np.float32),
            scaled.clip(-1, 1).astype(np.float32),
            bool(over[-1]),
        )


def _require_plain(folder: Path, metadata: Mapping[str, Json]) -> tuple[np.ndarray, np.ndarray]:
    """Two flat Box spaces, as many episodes as stated, plain numbers, no more than the file holds.

    The bounds (du,) of the actions.
    """
    import h5py

    stated: Any = metadata
    _box("observations", stated["observation_space"])
    low, high = _box("actions", stated["action_space"])
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
        raise ValueError(
            f"actions have no bounds, {stated['action_space']:.100}: nothing says how to scale "
            f"them to [-1, 1]; "
            f"{_SUPPORTED}. Read it with minari, scale its actions, and make Trajectories of it"
        )
    if stated["data_format"] != "hdf5":
        raise ValueError(
            f"its data are in the format {stated['data_format']!r:.80}, expected 'hdf5'"
        )
    file = folder / "main_data.hdf5"
    left = MAX_RATIO * len(read_bytes(file))

    def refusal(name: str, link: object) -> str | None:
        """What is wrong with an entry; h5py would lose the reason of an error raised here."""
        nonlocal left
        entry = f"{name[:80]!a}"
        if not isinstance(link, h5py.HardLink):
            return f"{entry} is a link ({type(link).__name__}), possibly to another file"
        dataset = root[name]
        if not isinstance(dataset, h5py.Dataset):
            return None
        left -= dataset.nbytes
        if dataset.external or dataset.is_virtual:
            return f"{entry} has its data in other files or arrays"
        if dataset.dtype.kind not in "fiub":
            return f"{entry} holds {dataset.dtype}, not numbers"
        if left < 0:
            return f"{entry} declares {dataset.nbytes} bytes, more than the file can hold"
        return None

    with h5py.File(file, "r", locking=False) as root:
        if reason := root.visititems_links(refusal):
            raise ValueError(reason)
        if not len(root) == stated["total_episodes"] > 0:
            raise ValueError(
                f"it holds {len(root)} groups, but states {stated['total_episodes']!r:.80} episodes"
            )
    return low, high


def _box(what: str, stated: str) -> tuple[np.ndarray, np.ndarray]:
    """The bounds (n,) of a flat Box; ValueError naming another space and what is supported."""
    space: Any = json.loads(stated)  # infinite bounds and all
    kind = {"Dict": "a dictionary", "Discrete": "discrete", "MultiDiscrete": "discrete"}.get(
        space["type"], f"a {space['type']!s:.40}"
    )
    if space["type"] == "Box":
        kind = {1: "", 2: "images", 3: "images"}.get(len(space["shape"]), "not flat")
    if kind:
        raise ValueError(f"{what} are {kind}, {stated:.80}; {_SUPPORTED}")
    if {(len(space["low"]),), (len(space["high"]),)} != {tuple(space["shape"])}:
        raise ValueError(
            f"the space of the {what} is {stated:.80}, expected as many bounds as dimensions"
        )
    if np.dtype(space["dtype"]).kind not in "fiu":
        raise ValueError(f"{what} are of type {space['dtype']!r:.80}, expected numbers")
    return np.array(space["low"], np.float64), np.array(space["high"], np.float64)
