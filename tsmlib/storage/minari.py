"""Minari data sets: read as ``Trajectories``, and written from them. Needs ``pip install 'tsmlib[minari]'``.

An HDF5 file from a stranger can point at other files on this machine and declare terabytes in a kilobyte, and Minari
imports the environment that a data set names where it states no spaces. So before Minari reads, the data set must
state two flat Box spaces, and its file hold plain numbers only, stored in it.
"""

import json
import warnings
from pathlib import Path
from types import ModuleType

import numpy as np

from tsmlib.storage.files import PathLike, StoreError, read_bytes
from tsmlib.trajectory import Trajectories

MAX_RATIO = 20  # bytes that a file declares, over its own


def load_minari(
    path: PathLike, *, env: str, dt: float, names: tuple[str, ...], units: tuple[str, ...], angles: tuple[int, ...] = ()
) -> Trajectories:
    """The episodes of a local Minari data set in folder ``path``, with flat Box spaces and equally long episodes.

    Of ``observations`` (T + 1, dx) and ``actions`` (T, du), env, dt, names, units and angles say what they mean, since
    the file does not. Raises StoreError for anything else, before data are read.
    """
    minari = _minari(path)
    folder = Path(path) / "data" if (Path(path) / "data").is_dir() else Path(path)
    try:
        _require_plain(folder)
        episodes = [
            (np.asarray(episode.observations, np.float32), np.asarray(episode.actions, np.float32))
            for episode in minari.MinariDataset(folder).iterate_episodes()
        ]
        if len({actions.shape for _, actions in episodes}) > 1:
            lengths = sorted(len(actions) for _, actions in episodes)
            raise ValueError(f"episodes have {lengths[0]} to {lengths[-1]} steps, expected equally many: cut them")
        states, actions = (np.stack(arrays) for arrays in zip(*episodes, strict=True))
        return Trajectories(states, actions, env, dt, names, units, angles)
    except Exception as error:  # what the files say goes through other libraries, which may fail in any way
        raise StoreError(
            f"{folder} holds no usable Minari data set: {str(error) or repr(error):.500}. Expected flat Box spaces and "
            "plain numbers in main_data.hdf5: ask whoever made it for a copy written by Minari itself."
        ) from error


def save_minari(dataset_id: str, trajectories: Trajectories, rewards: np.ndarray | None = None) -> Path:
    """Write ``trajectories`` as the local Minari data set ``dataset_id`` ("tsm/reacher/random-v0"). Returns its folder.

    rewards: (N, T); zeros where there are none. Minari keeps its data sets in $MINARI_DATASETS_PATH, or ~/.minari.
    """
    from gymnasium.spaces import Box

    minari, t = _minari(dataset_id), trajectories
    buffer = minari.data_collector.EpisodeBuffer
    given = np.zeros(t.actions.shape[:2]) if rewards is None else rewards
    last = np.arange(t.horizon) == t.horizon - 1
    fields = ", ".join(f"{name} ({unit})" for name, unit in zip(t.names, t.units, strict=True))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of author, licence and evaluation, which data need not have
        made = minari.create_dataset_from_buffers(
            dataset_id,
            [
                buffer(observations=x, actions=u, rewards=r, terminations=np.zeros_like(last), truncations=last)
                for x, u, r in zip(t.states, t.actions, given, strict=True)
            ],
            observation_space=Box(-np.inf, np.inf, t.states.shape[2:]),
            action_space=Box(-1, 1, t.actions.shape[2:]),
            description=f"{t.env}, {t.dt} s per step. Observations: {fields}.",
        )
    return Path(made.spec.data_path).parent


def _minari(what: PathLike) -> ModuleType:
    try:
        import h5py  # noqa: F401
        import minari
    except ImportError:
        raise StoreError(f"{what}: Minari data sets need minari and h5py: pip install 'tsmlib[minari]'") from None
    return minari


def _require_plain(folder: Path) -> None:
    """Two flat Box spaces, as many episodes as stated, and numbers within the file itself, no more than it can hold."""
    import h5py

    metadata = json.loads(read_bytes(folder / "metadata.json"))
    for word in ("observation_space", "action_space"):
        space = json.loads(metadata[word])  # infinite bounds and all
        sizes = {len(space["low"]), len(space["high"])}
        if space["type"] != "Box" or {(n,) for n in sizes} != {tuple(space["shape"])}:
            raise ValueError(f"{word} is {metadata[word]:.80}, expected a flat Box")
        if np.dtype(space["dtype"]).kind not in "fiu":
            raise ValueError(f"{word} is of type {space['dtype']!r:.80}, expected numbers")
    file = folder / "main_data.hdf5"
    left = MAX_RATIO * len(read_bytes(file)) if metadata["data_format"] == "hdf5" else 0

    def look(name: str, link: object) -> None:
        nonlocal left
        if not isinstance(link, h5py.HardLink):
            raise ValueError(f"{name[:80]!a} is a link ({type(link).__name__}), possibly to another file")
        found = root[name]
        if isinstance(found, h5py.Dataset):
            left -= found.nbytes
            if found.external or found.is_virtual:
                raise ValueError(f"{name[:80]!a} has its data in other files or arrays")
            if found.dtype.kind not in "fiub":
                raise ValueError(f"{name[:80]!a} holds {found.dtype}, not numbers")
            if left < 0:
                raise ValueError(f"{name[:80]!a} declares {found.nbytes} bytes, more than the file can hold")

    with h5py.File(file, "r", locking=False) as root:
        root.visititems_links(look)
        if not len(root) == metadata["total_episodes"] > 0:
            raise ValueError(f"it holds {len(root)} groups, but states {metadata['total_episodes']!r:.80} episodes")
