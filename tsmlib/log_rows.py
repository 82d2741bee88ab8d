"""The rows of a log: read from any table, cut, completed and scaled."""

from __future__ import annotations

import csv
import gzip
import os
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from tsmlib import casting
from tsmlib.checks import require_choice, require_number
from tsmlib.robot import TrajectoryError

Missing = Literal["split", "interpolate", "refuse"]
Bounds = tuple[float, float] | Mapping[str, tuple[float, float]] | Literal["data"]
FilePath = str | os.PathLike[str]
FILLED = 5  # missing rows, one after the other, that "interpolate" fills in at most
MILLI = re.compile(r"(?<![a-z])(m|u|µ|n)s(ec)?(?![a-z])|milli|micro|nano")  # in a header
SLOW = 1  # s; a longer step is taken for a time in other units unless dt says so
EMPTY = ("", "na", "n/a", "nan", "null", "none", "<na>")  # cells of a CSV that hold nothing


class Table(Protocol):
    """Columns by name: a pandas or polars frame, or a dictionary of arrays."""

    def __getitem__(self, name: str, /) -> object: ...


@dataclass
class Log:
    """Rows of a table, episode by episode."""

    states: tuple[str, ...]
    actions: tuple[str, ...]
    rows: np.ndarray  # (M, dx + du), NaN where a value is missing
    ids: np.ndarray  # (M,) of episodes, rising
    clock: np.ndarray | None  # (M,) s
    places: np.ndarray  # (M,) row of the table
    time: str | None
    notes: list[str] = field(default_factory=list)

    @classmethod
    def read(
        cls,
        table: Table | FilePath,
        states: tuple[str, ...],
        actions: tuple[str, ...],
        episode: str | None,
        time: str | None,
    ) -> Log:
        columns = _read_csv(Path(table)) if isinstance(table, str | os.PathLike) else table
        values = [_numbers(name, _column(columns, name)) for name in (*states, *actions)]
        if both := set(states) & set(actions):
            raise TrajectoryError(
                f"columns {sorted(both)} are states and actions; expected each to be one of them"
            )
        clock = None if time is None else _seconds(time, _column(columns, time))
        ids = np.zeros(len(values[0]), np.int64)
        if episode is not None:
            ids = _codes(episode, _column(columns, episode))
        sizes = [len(column) for column in (*values, ids, *([] if clock is None else [clock]))]
        if len(set(sizes)) > 1 or not sizes[0]:
            raise TrajectoryError(f"columns have {sizes} rows; expected as many in each, and some")
        places = np.argsort(ids, kind="stable")
        if clock is None and (np.diff(places) < 0).any():
            raise TrajectoryError(
                f"an episode of column '{episode}' goes on after another has begun; expected the "
                "rows of each together, or time=... that says how they follow"
            )
        rows, ids = np.stack(values, 1)[places], ids[places]
        clock = None if clock is None else clock[places]
        return cls(states, actions, rows, ids, clock, places, time)

    def steps(self, dt: float | None) -> tuple[float, np.ndarray]:
        """Seconds per step, and whether each row follows the one before it (M - 1,)."""
        within = np.diff(self.ids) == 0
        if self.clock is None:
            if dt is None:
                raise TrajectoryError("nothing says how long a step is: give time=... or dt=...")
            return dt, within
        steps = np.diff(self.clock)
        for row in np.flatnonzero(within & (steps <= 0))[:1]:
            raise TrajectoryError(
                f"'{self.time}' goes from {self.clock[row]:.12g} to {self.clock[row + 1]:.12g} s "
                f"in row {self.places[row + 1]} of the table, within an episode; expected time to "
                "increase: sort by it, drop rows that occur twice, or name the episode=... column"
            )
        if not within.any():
            raise TrajectoryError("every episode has a single row; expected two rows or more")
        median = float(f"{np.median(steps[within]):.6g}")
        if dt is None:
            dt = median
            self.notes.append(f"dt is {dt:g} s, the median step of '{self.time}'")
            if dt > SLOW or MILLI.search(str(self.time).lower()):
                raise TrajectoryError(
                    f"the median step of '{self.time}' is {dt:g} s; expected seconds: divide a "
                    f"time in milliseconds by 1e3, in nanoseconds by 1e9, or give dt={dt:g}"
                )
        dt = require_number("dt", dt, 0, above=True)
        if abs(median - dt) > 0.05 * dt:
            raise TrajectoryError(
                f"dt is {dt:g} s, but the median step of '{self.time}' is {median:g}; expected "
                "both alike and in seconds: convert the time, or leave dt out"
            )
        follows = within & (np.abs(steps - dt) <= 0.5 * dt)
        begins = np.flatnonzero(np.diff(self.ids, prepend=-1))
        for start, end in zip(begins, [*begins[1:], len(self.ids)], strict=True):
            own = steps[start : end - 1][follows[start : end - 1]]
            if len(own) >= 5 and abs(np.median(own) - dt) > 0.1 * dt:
                raise TrajectoryError(
                    f"dt is {dt:g} s, but the median step of '{self.time}' is {np.median(own):g} "
                    f"in the episode that begins in row {self.places[start]}; expected one dt: "
                    "resample the log, or read episodes of each dt by themselves"
                )
        if follows.sum() < 0.7 * within.sum():
            raise TrajectoryError(
                f"only {follows.sum()} of {within.sum()} steps of '{self.time}' are near dt = "
                f"{dt:g} s, their median is {median:g}; expected even steps in seconds: convert "
                "the time, or resample the log"
            )
        return dt, follows

    def complete(
        self, missing: Missing, follows: np.ndarray, angles: tuple[int, ...], unwrap: bool
    ) -> None:
        """Unwrap angles, and fill in or refuse missing values."""
        dx, gone = len(self.states), ~np.isfinite(self.rows)
        if missing == "refuse" and gone.any():
            row, column = np.argwhere(gone)[0]
            raise TrajectoryError(
                f"column '{(*self.states, *self.actions)[column]}' has no number in row "
                f'{self.places[row]}; expected numbers only, or missing="split" or "interpolate"'
            )
        runs = np.split(np.arange(len(self.rows)), np.flatnonzero(~follows) + 1)
        for run in runs:
            for column in range(self.rows.shape[1]):
                have = run[~gone[run, column]]
                values = self.rows[have, column]
                if column in angles and unwrap:
                    values = casting.unwrapped_angle(self.states[column], values)
                    self.rows[have, column] = values
                lack = run[gone[run, column]]
                if missing != "interpolate" or not len(lack) or not len(have):
                    continue
                if column in angles and (np.abs(np.diff(values)) > np.pi).any():
                    raise TrajectoryError(
                        f"the angle '{self.states[column]}' jumps by more than pi beside missing "
                        "values; unwrap=True takes the jumps out of one that was wrapped"
                    )
                before = np.searchsorted(have, lack) - 1
                inside = (before >= 0) & (before < len(have) - 1)
                lack, before = lack[inside], before[inside]
                short = have[before + 1] - have[before] <= FILLED + 1
                lack, before = lack[short], before[short]
                held = values[before]
                line = np.interp(lack, have, values) if len(lack) else held
                self.rows[lack, column] = line if column < dx else held
        filled = (gone & np.isfinite(self.rows)).any(1).sum()
        if filled:
            self.notes.append(f"values of {filled} rows were filled in")

    def scale(self, bounds: Bounds | None) -> None:
        """Actions from their bounds to [-1, 1]."""
        dx = len(self.states)
        self.rows[:, dx:], notes = scaled(self.rows[:, dx:], self.actions, bounds, self.places)
        self.notes += notes

    def parts(self, follows: np.ndarray) -> list[tuple[int, int]]:
        """First and last row of each run of rows that follow each other with all their values."""
        dx, have = len(self.states), np.isfinite(self.rows)
        whole = have[:, :dx].all(1)
        linked = follows & whole[:-1] & whole[1:] & have[:-1, dx:].all(1)
        edges = np.diff(np.concatenate([[0], linked.astype(int), [0]]))
        parts = list(zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True))
        if not parts:
            raise TrajectoryError(
                f"no two of {len(have)} rows follow each other with all their values; expected "
                f"numbers in {', '.join((*self.states, *self.actions))}"
            )
        episodes = len(set(self.ids.tolist()))
        gaps = int(((np.diff(self.ids) == 0) & ~follows).sum())
        left_out = len(have) - sum(int(b - a) + 1 for a, b in parts)
        if gaps or left_out or len(parts) != episodes:
            self.notes.append(
                f"{episodes} episodes became {len(parts)}: {gaps} gaps in time, "
                f"{int((~have.all(1)).sum())} rows with missing values, {left_out} of {len(have)} "
                "rows left out"
            )
        return [(int(a), int(b)) for a, b in parts]


def names_of(field_: str, names: Sequence[str]) -> tuple[str, ...]:
    listed = (names,) if isinstance(names, str) else tuple(names or ())
    if not listed or not all(isinstance(name, str) for name in listed):
        raise TrajectoryError(f"{field_} is {names!r:.80}; expected names of columns")
    return listed


def _column(table: Table, name: str) -> np.ndarray:
    """A column of any table as an array (M,) of whatever it holds."""
    names = getattr(table, "column_names", getattr(table, "columns", None))
    names = table if isinstance(table, Mapping) else names
    known = [str(n) for n in names] if isinstance(names, Iterable) else []
    if names is not None and name not in known:
        near = get_close_matches(name, known, 1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        raise TrajectoryError(
            f"there is no column '{name}'; {hint}There are {', '.join(known):.300}"
        )
    try:
        array = np.asarray(table[name])
    except Exception as error:  # of another library, which may fail in any way
        raise TrajectoryError(
            f"column '{name}' of a {type(table).__name__} cannot be read: {error!r:.200}. Expected "
            "a pandas or polars frame, a dictionary of arrays, or the path of a CSV file"
        ) from error
    if array.ndim != 1:
        raise TrajectoryError(
            f"column '{name}' has shape {array.shape}; expected a value per row, and the name once"
        )
    return array


def _numbers(name: str, column: np.ndarray) -> np.ndarray:
    """A column as float64, NaN where a value is missing."""
    if column.dtype.kind in "fiub":
        values = column.astype(np.float64)
    elif column.dtype.kind in "OUT":
        values = np.array([_number(name, row, value) for row, value in enumerate(column)], float)
    else:
        raise TrajectoryError(f"column '{name}' holds {column.dtype}; expected numbers")
    return np.where(np.isfinite(values), values, np.nan)


def _number(name: str, row: int, value: object) -> float:
    if value is None or str(value).strip().lower() in EMPTY:
        return float("nan")
    try:
        if "_" in str(value):
            raise ValueError
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        shown = str(value) if isinstance(value, str) else value
        hint = ": pandas.read_csv(..., decimal=',') reads commas" if "," in str(value) else ""
        raise TrajectoryError(
            f"column '{name}' holds {shown!r:.40} in row {row} of the table; "
            f"expected a number{hint}"
        ) from None


def _seconds(name: str, column: np.ndarray) -> np.ndarray:
    if column.dtype.kind in "mM":
        start = column[0] if column.dtype.kind == "M" else np.timedelta64(0)
        seconds = (column - start) / np.timedelta64(1, "s")
    elif len(column) and isinstance(column[0], str) and "-" in column[0][1:]:
        raise TrajectoryError(
            f"the time '{name}' is '{column[0]!s:.40}'; expected seconds or dates: "
            "pandas.to_datetime(...) makes dates of texts"
        )
    elif len(column) and hasattr(column[0], "timestamp"):  # dates with a time zone
        seconds = np.array([value.timestamp() for value in column], np.float64)
    else:
        seconds = _numbers(name, column)
    for row in np.flatnonzero(~np.isfinite(seconds))[:1]:
        raise TrajectoryError(
            f"the time '{name}' is missing in row {row}; expected one in each row"
        )
    return seconds


def _codes(name: str, column: np.ndarray) -> np.ndarray:
    """Episodes as numbers in the order in which they begin."""
    values = column.tolist()
    for row, value in enumerate(values):
        if value is None or value != value or str(value).strip().lower() in EMPTY:
            raise TrajectoryError(f"column '{name}' names no episode in row {row} of the table")
    try:
        numbers = {value: code for code, value in enumerate(dict.fromkeys(values))}
    except TypeError as error:
        raise TrajectoryError(f"column '{name}' names no episodes: {error}") from error
    return np.array([numbers[value] for value in values], np.int64)


def flags(name: str, values: np.ndarray, n: int) -> np.ndarray:
    array = np.asarray(values)
    array = array[:, 0] if array.ndim == 2 and array.shape[1] == 1 else array
    if array.shape != (n,) or array.dtype.kind not in "fiub" or not np.isin(array, (0, 1)).all():
        raise TrajectoryError(
            f"{name} have shape {array.shape} and type {array.dtype}; expected {n} booleans"
        )
    return array.astype(bool)


def scaled(
    actions: np.ndarray,
    names: tuple[str, ...],
    bounds: Bounds | None,
    places: np.ndarray | None = None,
) -> tuple[np.ndarray, list[str]]:
    """Actions scaled from their bounds to [-1, 1], and what there is to say of the bounds."""
    if bounds is None:
        return actions, []
    notes = []
    if isinstance(bounds, str):
        require_choice("bounds", bounds, ("data",))
        known = [u[np.isfinite(u)] for u in actions.T]
        edges = [(u.min(initial=np.inf), u.max(initial=-np.inf)) for u in known]
        pairs: Mapping[str, tuple[float, float]] = dict(zip(names, edges, strict=True))
        said = ", ".join(f"'{name}' {low:g} to {high:g}" for name, (low, high) in pairs.items())
        notes.append(f"actions are scaled by their range in the data: {said}")
    else:
        pairs = bounds if isinstance(bounds, Mapping) else dict.fromkeys(names, bounds)
    if set(pairs) != set(names):
        raise TrajectoryError(f"bounds are of {list(pairs)}; expected one pair for each of {names}")
    inside = np.empty_like(actions, np.float64)
    for column, name in enumerate(names):
        pair = np.asarray(pairs[name])
        if pair.shape != (2,) or pair.dtype.kind not in "fiu" or not np.isfinite(pair).all():
            raise TrajectoryError(
                f"the bounds of '{name}' are {pairs[name]!r:.80}; expected two numbers (low, "
                "high), or a dictionary {name: (low, high)}"
            )
        low, high = (float(edge) for edge in pair)
        if not low < high:
            raise TrajectoryError(
                f"the bounds of '{name}' are {low:g} and {high:g}; expected (low, high), low < high"
            )
        inside[:, column] = (2 * actions[:, column] - (low + high)) / (high - low)
        for row in np.flatnonzero(np.abs(inside[:, column]) > 1 + 1e-5)[:1]:
            at = row if places is None else places[row]
            raise TrajectoryError(
                f"'{name}' is {actions[row, column]:g} in row {at}; expected it within its bounds "
                f"{low:g} to {high:g}"
            )
    return inside.clip(-1, 1), notes


def _read_csv(path: Path) -> dict[str, list[str]]:
    """The columns of a CSV file as texts."""
    opening = gzip.open if path.suffix == ".gz" else open
    try:
        with opening(path, "rt", encoding="utf-8-sig", newline="") as file:
            header = file.readline()
            separator = max(",;\t", key=header.count)
            (names,) = csv.reader([header], delimiter=separator)
            lines = [line for line in csv.reader(file, delimiter=separator) if line]
    except (OSError, ValueError, csv.Error) as error:
        raise TrajectoryError(
            f"{path} cannot be read as a CSV file: {error!r:.200}. Read it "
            "by pandas and give the frame"
        ) from error
    names = [name.strip() for name in names]
    for row, line in enumerate(lines):
        if len(line) != len(names):
            raise TrajectoryError(
                f"row {row} of {path} has {len(line)} fields; expected {len(names)}, as its header"
            )
    if len(set(names)) < len(names):
        raise TrajectoryError(f"{path} names a column twice: {', '.join(names):.200}")
    if separator != ",":
        lines = _with_points(lines)
    return {name: [line[k] for line in lines] for k, name in enumerate(names)}


def _with_points(lines: list[list[str]]) -> list[list[str]]:
    """Cells with decimal points, where all of a file's fractions have decimal commas."""
    commas, points = (
        re.compile(rf"\s*[+-]?\d*{mark}\d+(e[+-]?\d+)?\s*", re.IGNORECASE) for mark in (",", r"\.")
    )
    if any(points.fullmatch(cell) for line in lines for cell in line):
        return lines
    fractions = [cell for line in lines for cell in line if commas.fullmatch(cell)]
    thousands = re.compile(r"\s*[+-]?[1-9]\d{0,2},\d{3}\s*")
    if fractions and all(map(thousands.fullmatch, fractions)):
        warnings.warn(
            f"{fractions[0]!r} is read as {fractions[0].replace(',', '.')!r}; where commas "
            "separate thousands, read the file with pandas.read_csv(path, sep=';', thousands=',')",
            stacklevel=2,
        )
    return [
        [cell.replace(",", ".") if commas.fullmatch(cell) else cell for cell in line]
        for line in lines
    ]
