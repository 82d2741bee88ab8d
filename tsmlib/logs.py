"""Logs of robots as trajectories: tables, flat arrays, LeRobot folders, HDF5 files.

A row of a log holds the state x_t and the action u_t taken in it. An episode is a run of rows that
follow each other by one time step, with all states, and all actions but the last: that one leads to
a state that nobody logged, and is dropped.
"""

from __future__ import annotations

import importlib
import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self, cast

import numpy as np

from tsmlib import casting
from tsmlib.checks import require_choice
from tsmlib.log_rows import Bounds, FilePath, Log, Missing, Table, flags, names_of, scaled
from tsmlib.robot import TrajectoryError, columns_of


class FromLogs:
    """The constructors of ``Trajectories`` that read logs."""

    @classmethod
    def from_table(
        cls,
        table: Table | FilePath,
        *,
        states: Sequence[str],
        actions: Sequence[str],
        episode: str | None = None,
        time: str | None = None,
        dt: float | None = None,
        bounds: Bounds | None = None,
        angles: Sequence[int | str] = (),
        units: Sequence[str] | Mapping[str, str] | None = None,
        env: str = "log",
        missing: Missing = "split",
        unwrap: bool = False,
    ) -> Self:
        """Episodes of a table that has a row for each step, cut at gaps in time.

        Args:
            table: a pandas or polars frame, a dictionary of arrays, or the path of a CSV file.
            states: columns of the state, in physical units.
            actions: columns of the action.
            episode: column that tells episodes apart; without it all rows are of one.
            time: column of the time, in seconds or as dates; it increases within an episode.
            dt: seconds per step; by default the median step of ``time``.
            bounds: (low, high) of all actions, or {column: (low, high)}; they become -1 and 1.
                "data" takes those of the table. Without them actions are within [-1, 1].
            angles: states that are angles in radians, by name or by index.
            units: of the states, one each or {column: unit}.
            env: a name for the robot.
            missing: "split" cuts where a value is missing; "interpolate" fills in up to five rows,
                states by a line, actions by the one before; "refuse" raises.
            unwrap: take the jumps out of angles that were wrapped.

        Returns:
            Trajectories; a warning says what was guessed, cut and left out.

        Raises:
            TrajectoryError: a column that is not there or holds no numbers, time that stands still,
                goes back or is uneven, actions beyond ``bounds``, or no two rows that follow.
        """
        require_choice("missing", missing, ("split", "interpolate", "refuse"))
        log = Log.read(
            table, names_of("states", states), names_of("actions", actions), episode, time
        )
        turning = columns_of(angles, log.states)
        dt, follows = log.steps(dt)
        log.complete(missing, follows, turning, unwrap)
        log.scale(bounds)
        parts = log.parts(follows)
        if isinstance(units, Mapping):
            if unknown := sorted(units.keys() - set(log.states)):
                raise TrajectoryError(f"units name {unknown}; expected some of {log.states}")
            units = [units.get(name, "") for name in log.states]
        if log.notes:
            warnings.warn("; ".join(log.notes), stacklevel=2)
        dx, make = len(log.states), cast(Callable[..., Self], cls)
        x = [log.rows[a : b + 1, :dx] for a, b in parts]
        u = [log.rows[a:b, dx:] for a, b in parts]
        return make(x, u, env, dt, log.states, units, turning)

    @classmethod
    def from_flat(
        cls,
        observations: np.ndarray,
        actions: np.ndarray,
        terminals: np.ndarray,
        timeouts: np.ndarray,
        *,
        dt: float,
        next_observations: np.ndarray | None = None,
        bounds: Bounds | None = None,
        names: Sequence[str] | None = None,
        units: Sequence[str] | None = None,
        angles: Sequence[int | str] = (),
        env: str = "log",
        unwrap: bool = False,
    ) -> Self:
        """Episodes of flat arrays, the usual layout of offline data.

        Args:
            observations: (M, dx), the state of each row, which become states.
            actions: (M, du), the action taken in it.
            terminals: (M,), whether the environment ended the episode after this action.
            timeouts: (M,), whether the episode ended after this action for another reason.
            dt: seconds per step.
            next_observations: (M, dx), the state that the action led to. With it the last action of
                an episode is kept; without it that state is unknown.
            bounds: (low, high) of all actions, or "data"; they become -1 and 1.
            names: one word per state dimension.
            units: one per state dimension.
            angles: state dimensions that are angles in radians.
            env: a name for the robot.
            unwrap: take the jumps out of angles that were wrapped.

        Returns:
            Trajectories; those of one row, which has no next state, are left out with a warning.

        Raises:
            TrajectoryError: arrays that do not fit, or next observations that are not the next.
        """
        x = casting.numbers("observations", observations)
        u = casting.numbers("actions", actions).astype(np.float64)
        if x.ndim != 2 or u.ndim != 2 or len(u) != len(x) or not len(x):
            raise TrajectoryError(
                f"observations have shape {x.shape}, actions {u.shape}; expected (M, dx) and "
                "(M, du) with one row for each step"
            )
        over = [flags("terminals", terminals, len(x)), flags("timeouts", timeouts, len(x))]
        ends = np.flatnonzero(over[0] | over[1]) + 1
        begins = [0, *(int(end) for end in ends if end < len(x))]
        parts = list(zip(begins, [*begins[1:], len(x)], strict=True))
        after = next_observations
        if after is not None:
            after = casting.numbers("next_observations", after)
            inside = np.setdiff1d(np.arange(len(x) - 1), ends - 1)
            if after.shape != x.shape or not np.array_equal(
                np.float32(after[inside]), np.float32(x[inside + 1])
            ):
                raise TrajectoryError(
                    "next_observations are not the observations of the next rows; expected them to "
                    "be within an episode, and its end marked in terminals or timeouts"
                )
        named = tuple(f"action {k}" for k in range(u.shape[1]))
        u, notes = scaled(u, named, bounds)
        least = 1 if after is not None else 2
        if not len(ends):
            notes.append("nothing marks the end of an episode, so that all rows are one")
        if short := sum(b - a < least for a, b in parts):
            notes.append(f"{short} of {len(parts)} episodes have a single row and are left out")
        if notes:
            warnings.warn("; ".join(notes), stacklevel=2)
        parts = [(a, b) for a, b in parts if b - a >= least]
        if not parts:
            raise TrajectoryError("every episode has a single row; expected two rows or more")
        states, taken, ended = [], [], []
        for a, b in parts:
            states.append(x[a:b] if after is None else np.concatenate([x[a:b], after[b - 1 : b]]))
            taken.append(u[a : b - 1] if after is None else u[a:b])
            ended.append(after is not None and bool(over[0][b - 1]))
        about = {"terminated": ended, "unwrap": unwrap}
        make = cast(Callable[..., Self], cls)
        return make(states, taken, env, dt, names, units, angles, **about)

    @classmethod
    def from_lerobot(
        cls,
        folder: FilePath,
        *,
        bounds: Bounds | None = "data",
        angles: Sequence[int | str] = (),
        units: Sequence[str] | Mapping[str, str] | None = None,
        missing: Missing = "split",
        unwrap: bool = False,
    ) -> Self:
        """Episodes of a LeRobotDataset (version 3) on disk, without its pictures; needs pyarrow.

        Args:
            folder: the one that holds ``meta`` and ``data``.
            bounds: as of ``from_table``, by the names "action.NAME"; "data" takes their range.
            angles: states that are angles in radians, by name or by index.
            units: of the states, one each or {name: unit}.
            missing: as of ``from_table``.
            unwrap: take the jumps out of angles that were wrapped.

        Returns:
            Trajectories of ``observation.state`` and ``action``, with the folder's rate and names.

        Raises:
            TrajectoryError: no such data set, or one without states and actions.
        """
        parquet, root = _module("pyarrow.parquet", "lerobot"), Path(folder)
        wanted = {"observation.state": "", "action": "action."}
        try:
            info = json.loads((root / "meta" / "info.json").read_text(encoding="utf-8"))
            names = {key: _features(info["features"][key], key) for key in wanted}
            files = sorted((root / "data").rglob("*.parquet"))
            columns = [*wanted, "episode_index", "timestamp"]
            tables = [parquet.read_table(file, columns=columns).to_pydict() for file in files]
            whole = {name: [v for part in tables for v in part[name]] for name in columns}
            flat = {key: np.array(whole[key], np.float64) for key in wanted}
            rate, kind = float(info["fps"]), str(info.get("robot_type") or root.name)
            table = {"episode_index": whole["episode_index"], "timestamp": whole["timestamp"]}
            for key, prefix in wanted.items():
                for name, column in zip(names[key], flat[key].T, strict=True):
                    table[prefix + name] = column
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise TrajectoryError(
                f"{root} holds no usable LeRobotDataset: {error!r:.300}. Expected meta/info.json "
                "with fps and features, and data/**/*.parquet with observation.state, action, "
                "episode_index and timestamp"
            ) from error
        about = dict(angles=angles, units=units, env=kind, missing=missing, unwrap=unwrap)
        return cls.from_table(
            table,
            states=names["observation.state"],
            actions=["action." + name for name in names["action"]],
            episode="episode_index",
            time="timestamp",
            dt=1 / rate,
            bounds=bounds,
            **about,  # type: ignore[arg-type]
        )

    @classmethod
    def from_hdf5(
        cls,
        path: FilePath,
        *,
        dt: float,
        bounds: Bounds | None = None,
        names: Sequence[str] | None = None,
        units: Sequence[str] | None = None,
        angles: Sequence[int | str] = (),
        env: str = "log",
        unwrap: bool = False,
    ) -> Self:
        """``from_flat`` of a flat HDF5 file; needs h5py.

        Args:
            path: a file with observations, actions, terminals and timeouts, perhaps
                next_observations, at its top.
            dt: seconds per step.
            bounds: (low, high) of all actions, or "data"; they become -1 and 1.
            names: one word per state dimension.
            units: one per state dimension.
            angles: state dimensions that are angles in radians.
            env: a name for the robot.
            unwrap: take the jumps out of angles that were wrapped.

        Returns:
            Trajectories.

        Raises:
            TrajectoryError: a file without these arrays of numbers in itself.
        """
        h5py = _module("h5py", "minari")
        arrays: dict[str, np.ndarray] = {}
        needed = ("observations", "actions", "terminals", "timeouts")
        try:
            with h5py.File(path, "r", locking=False) as file:
                for name in (*needed, "next_observations"):
                    if name not in needed and name not in file:
                        continue
                    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
                        raise ValueError(f"{name} is missing, or a link")
                    if file[name].external or file[name].is_virtual:
                        raise ValueError(f"{name} has its data in other files")
                    arrays[name] = file[name][()]
        except (OSError, ValueError, KeyError, AttributeError, MemoryError) as error:
            raise TrajectoryError(
                f"{path} holds no usable flat data set: {error}. Expected arrays {needed} "
                "at its top"
            ) from error
        meaning = dict(names=names, units=units, angles=angles, env=env, unwrap=unwrap)
        return cls.from_flat(**arrays, dt=dt, bounds=bounds, **meaning)  # type: ignore[arg-type]


def _features(feature: Mapping[str, Any], key: str) -> list[str]:
    """Names of the numbers of a LeRobot feature, which has them in several forms."""
    names = feature.get("names")
    if isinstance(names, dict):
        names = next(iter(names.values()))
    size = int(feature["shape"][0])
    if not isinstance(names, list) or len(names) != size or len(set(map(str, names))) != size:
        names = [f"{key}[{k}]" for k in range(size)]
    return [str(name) for name in names]


def _module(name: str, extra: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise TrajectoryError(f"this needs {name}: pip install 'tsmlib[{extra}]'") from None
