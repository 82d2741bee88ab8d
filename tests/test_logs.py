"""Logs: what people's files hold becomes right trajectories, or one error that says what to do."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import types
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

import tsmlib
from tsmlib.trajectory import Trajectories, TrajectoryError

PAGE = Path(__file__).parent.parent / "docs" / "howto" / "logs.md"
KNOWN = {"states": ["x", "v"], "actions": ["u"], "episode": "run", "time": "t", "bounds": (-2, 2)}


def log(steps: tuple[int, ...] = (6, 9, 4)) -> pd.DataFrame:
    rng, rows = np.random.default_rng(0), []
    for run, n in enumerate(steps):
        for step in range(n):
            rows.append((f"run{run}", 100.0 * run + 0.05 * step, *rng.normal(size=2)))
    frame = pd.DataFrame(rows, columns=["run", "t", "x", "v"])
    return frame.assign(u=rng.uniform(-2, 2, len(frame)))


@pytest.fixture(autouse=True)
def _quiet() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def read(table: Any, **change: Any) -> Trajectories:
    return Trajectories.from_table(table, **(KNOWN | change))


def test_the_page_reaches_a_plan_in_eight_statements(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
    for block in blocks:
        exec(block, names)
    plan, data = names["plan"], names["data"]
    assert len(re.findall(r"^\w", blocks[1], re.M)) <= 8
    assert plan.actions.shape == (1, 40, 1)
    assert len(data) > 40
    assert max(data.lengths) < 120
    assert np.abs(data.flat_actions).max() <= 1
    assert plan.predicted_return.item() > plan.curve.ravel()[0] - 1e-3


def test_a_row_pairs_the_state_with_the_action_taken_in_it_and_the_last_action_goes() -> None:
    frame = log()
    data = read(frame)
    assert data.lengths == (5, 8, 3)
    assert (data.names, data.dt, data.env) == (("x", "v"), 0.05, "log")
    for i, (_, run) in enumerate(frame.groupby("run", sort=False)):
        states, actions = data.episode(i)
        np.testing.assert_allclose(states, run[["x", "v"]], rtol=1e-6)
        np.testing.assert_allclose(2 * actions, run[["u"]][:-1], rtol=1e-5)


def polars_like(frame: pd.DataFrame) -> Any:
    polars = pytest.importorskip("polars")
    return polars.DataFrame({name: frame[name].tolist() for name in frame})


def test_commas_that_may_separate_thousands_are_read_with_a_warning(tmp_path: Path) -> None:
    lines = ["t;x;u", *(f"{k};{1 + k},25{k};0" for k in range(4))]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    with pytest.warns(UserWarning, match="'1,250' is read as '1.250'.*thousands"):
        data = tsmlib.Trajectories.from_table(
            str(tmp_path / "log.csv"), time="t", states=["x"], actions=["u"]
        )
    assert data.flat_states[1, 0] == np.float32(2.251)


@pytest.mark.parametrize(
    "form", ["csv", "gz", "semicolons", "commas", "dict", "polars", "shuffled"]
)
def test_the_same_table_in_any_form_gives_the_same_data(form: str, tmp_path: Path) -> None:
    frame = log()
    frame.loc[8, "x"] = np.nan
    table: Any = frame
    if form in ("csv", "gz", "semicolons", "commas"):
        table = str(tmp_path / ("log.csv.gz" if form == "gz" else "log.csv"))
        separator, decimal = {"semicolons": ";.", "commas": ";,"}.get(form, ",.")
        frame.to_csv(table, index=False, sep=separator, decimal=decimal)
    elif form == "dict":
        table = {name: frame[name].to_numpy() for name in frame}
    elif form == "polars":
        table = polars_like(frame)
    else:  # rows of runs mixed, each in order of time
        table = frame.sort_values("t", key=lambda t: t % 100, kind="stable")
    assert read(table).lengths == read(frame).lengths == (5, 1, 5, 3)
    np.testing.assert_allclose(read(table).flat_states, read(frame).flat_states, rtol=1e-6)


def test_what_was_guessed_cut_and_left_out_is_said() -> None:
    frame = log().drop(index=[9, 10])
    frame.loc[2, "x"] = np.nan
    frame.loc[17, "u"] = np.nan
    with pytest.warns(UserWarning, match="dt is") as caught:
        data = read(frame)
    assert data.lengths == (1, 2, 2, 3, 2)
    said = str(caught[0].message)
    assert "dt is 0.05 s, the median step of 't'" in said
    assert "3 episodes became 5: 1 gaps in time, 2 rows with missing values, 2 of 17 rows" in said
    assert caught[0].filename == __file__


def test_missing_values_are_filled_in_on_request() -> None:
    frame = log((12,))
    frame.loc[3:4, "x"] = np.nan
    frame.loc[6, "u"] = np.nan
    data = read(frame, missing="interpolate")
    states, actions = data.episode(0)
    assert data.lengths == (11,)
    np.testing.assert_allclose(states[2:6, 0], np.linspace(frame.x[2], frame.x[5], 4), rtol=1e-5)
    assert actions[6] == actions[5]
    frame.loc[2:9, "x"] = np.nan  # too many
    assert read(frame, missing="interpolate").lengths == (1, 1)
    with pytest.raises(TrajectoryError, match="column 'x' has no number in row 2"):
        read(frame, missing="refuse")


def test_angles_are_unwrapped_across_missing_values() -> None:
    frame = log((12,))
    angle = np.linspace(2, 5, 12)
    frame["x"] = (angle + np.pi) % (2 * np.pi) - np.pi
    with pytest.raises(TrajectoryError, match="'x' jumps by more than pi"):
        read(frame, angles=["x"])
    frame.loc[4, "x"] = np.nan
    with pytest.raises(TrajectoryError, match="'x' jumps by more than pi beside missing values"):
        read(frame, angles=["x"], missing="interpolate")
    data = read(frame, angles=["x"], missing="interpolate", unwrap=True)
    np.testing.assert_allclose(data.states[0, :, 0], angle, rtol=1e-5)


def test_dates_are_seconds() -> None:
    frame = log((9,))
    frame["t"] = pd.Timestamp("2024-01-01") + pd.to_timedelta(np.arange(9) * 20, unit="ms")
    assert read(frame).dt == pytest.approx(0.02)


def test_bounds_scale_actions() -> None:
    frame = log()
    frame["u"] = np.linspace(0, 10, len(frame))
    whole = read(frame, bounds="data").flat_actions
    np.testing.assert_allclose(whole, read(frame, bounds={"u": (0, 10)}).flat_actions)
    assert whole[0] == -1
    assert whole[-1] > 0.8


def damaged(**change: Any) -> Any:
    frame = log()
    for name, (row, value) in change.items():
        frame[name] = frame[name].astype(object)
        frame.loc[row, name] = value
    return frame


ROW = log().iloc[:1]


@pytest.mark.parametrize(
    ("table", "change", "message"),
    [
        (log(), {"states": ["x", "w"]}, "there is no column 'w'.*There are run, t, x, v, u"),
        (log(), {"states": ["x", "vv"]}, "did you mean 'v'"),
        (log(), {"states": []}, "states is"),
        (log(), {"states": ["x", "x"]}, "no name twice"),
        (log(), {"time": "time"}, "no column 'time'"),
        (log(), {"episode": "id"}, "no column 'id'"),
        (damaged(x=(4, "high")), {}, "column 'x' holds 'high' in row 4 of the table"),
        (damaged(u=(4, "1_000")), {}, "column 'u' holds '1_000' in row 4"),
        (damaged(x=(4, 3j)), {}, "column 'x' holds 3j in row 4"),
        (damaged(run=(4, None)), {}, "column 'run' names no episode in row 4"),
        (damaged(t=(4, None)), {}, "time 't' is missing in row 4"),
        (log().iloc[::-1], {}, "'t' goes from .* in row 1 of the table.*sort by it"),
        (damaged(t=(4, 0.15)), {}, "'t' goes from 0.15 to 0.15 s in row 4"),
        (pd.concat([log(), log()]), {}, "'t' goes from"),
        (pd.concat([log(), log()]), {"time": None, "dt": 0.1}, "goes on after another has begun"),
        (log(), {"time": None}, "give time=... or dt=..."),
        (log(), {"dt": 20}, "dt is 20 s, but the median step of 't' is 0.05"),
        (log(), {"dt": 0.06}, "dt is 0.06 s, but the median"),
        (log().assign(t=np.arange(19) * 20), {"episode": None}, "'t' is 20 s; expected seconds"),
        (log().assign(t_ms=log().t), {"time": "t_ms"}, "'t_ms' is .*divide a time in milliseconds"),
        (
            log((9, 9)).assign(t=np.outer([1, 2], np.arange(9)).ravel() * 0.05),
            {},
            "expected one dt",
        ),
        (log(), {"states": ["x", "u"]}, "are states and actions"),
        (log().assign(run=[[1]] * 19), {}, "column 'run' names no episodes: unhashable"),
        (log(), {"states": None}, "states is None"),
        (log(), {"dt": -1}, "dt is -1"),
        (log().assign(t=np.cumsum(np.r_[np.tile([0.01, 1], 9), 1])), {"episode": None}, "only"),
        (log((1, 1, 1)), {}, "every episode has a single row"),
        (log().assign(x=np.nan), {}, "no two of 19 rows follow"),
        (log().iloc[:0], {}, "expected as many in each, and some"),
        (log(), {"bounds": (-1, 1)}, r"'u' is .* in row .*within its bounds -1 to 1"),
        (log(), {"bounds": (2, -2)}, "2 and -2; expected .* low < high"),
        (log(), {"bounds": (-2, np.inf)}, "bounds of 'u' are"),
        (log(), {"bounds": ((-2,), (2,))}, "bounds of 'u' are"),
        (log(), {"bounds": {"w": (-2, 2)}}, r"bounds are of \['w'\]"),
        (log(), {"bounds": "table"}, "expected one of 'data'"),
        (log().assign(u=1.0), {"bounds": "data"}, "low < high"),
        (log(), {"bounds": None}, "expected them within .*bounds="),
        (log(), {"angles": ["w"]}, "angles are"),
        (log(), {"units": {"w": "m"}}, "units name"),
        (log(), {"missing": "drop"}, "expected one of 'split'"),
        ({"x": [1.0], "v": [1.0, 2.0], "u": [0.0]}, {"episode": None, "time": None}, "rows"),
        ({"x": np.zeros((3, 2)), "v": [0] * 3, "u": [0] * 3}, {}, "one per|value per row"),
        (pd.concat([log(), log()[["x"]]], axis=1), {}, "the name once"),
        (np.zeros((5, 3)), {}, "of a ndarray cannot be read"),
        ("nowhere.csv", {}, "nowhere.csv cannot be read as a CSV"),
        (log().assign(t="2024-01-01 10:00"), {}, "pandas.to_datetime"),
    ],
)
def test_what_is_no_log_is_one_clear_error(table: Any, change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read(table, **change)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,v,u,run,t\n1,2,0,0\n", "row 0 of .* has 4 fields; expected 5"),
        ("x,v,x,run,t\n1,2,0,0,0\n", "names a column twice"),
        ("", "cannot be read|no column|columns"),
        ("x;v;u;run;t\n1,5;2.5;0;0;0\n1,5;2;0;0;1\n", "'x' holds '1,5' in row 0.* decimal"),
        ("\x00\xff\x80", "no column|cannot be read"),
    ],
)
def test_a_csv_that_is_none_is_one_clear_error(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(TrajectoryError, match=message):
        read(path)


# Flat arrays

OBS = np.arange(20.0).reshape(10, 2)
ACT = np.linspace(-1, 1, 10)[:, None]
OVER = np.zeros(10, bool)
OVER[3] = True
LATE = np.zeros(10)
LATE[8] = 1


def test_flat_arrays_end_where_they_say() -> None:
    data = Trajectories.from_flat(OBS, ACT, OVER, LATE, dt=0.1)
    assert (data.lengths, data.terminated) == ((3, 4), (False, False))
    np.testing.assert_array_equal(data.episode(1)[0], OBS[4:9])
    after = (
        np.concatenate([OBS[1:], OBS[-1:]]) + (OVER | (LATE > 0) | (np.arange(10) == 9))[:, None]
    )
    whole = Trajectories.from_flat(OBS, ACT, OVER, LATE, dt=0.1, next_observations=after)
    assert (whole.lengths, whole.terminated) == ((4, 5, 1), (True, False, False))
    np.testing.assert_array_equal(whole.episode(0)[0], [*OBS[:4], after[3]])
    np.testing.assert_allclose(whole.flat_actions, ACT, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"observations": OBS[:5]}, "with one row for each step"),
        ({"observations": {"a": OBS}}, "observations are of type object"),
        ({"actions": ACT + 1j}, "actions are of type complex128"),
        ({"actions": ACT.astype(str)}, "expected real numbers"),
        ({"timeouts": None}, "timeouts have shape"),
        ({"actions": ACT[:, 0]}, "actions .* expected .M, dx"),
        ({"terminals": OVER[:5]}, "terminals have shape"),
        ({"terminals": np.full(10, 2)}, "expected 10 booleans"),
        ({"timeouts": np.full(10, np.nan)}, "timeouts have shape"),
        ({"terminals": np.ones(10)}, "every episode has a single row"),
        ({"next_observations": OBS[:5]}, "not the observations of the next rows"),
        ({"next_observations": OBS}, "not the observations of the next rows"),
        ({"actions": 3 * ACT}, "bounds"),
        ({"bounds": (-0.5, 0.5)}, "within its bounds"),
        ({"observations": np.where(OBS == 5, np.nan, OBS)}, "episode 0, step 2, field 'x1'"),
    ],
)
def test_flat_arrays_that_do_not_fit_are_refused(change: dict, message: str) -> None:
    given = {"observations": OBS, "actions": ACT, "terminals": OVER, "timeouts": LATE}
    with pytest.raises(ValueError, match=message):
        Trajectories.from_flat(**(given | {"dt": 0.1} | change))


def test_an_hdf5_file_is_read_as_its_arrays(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    arrays = {"observations": OBS, "actions": ACT, "terminals": OVER, "timeouts": LATE}
    with h5py.File(tmp_path / "log.hdf5", "w") as file:
        file.update(arrays)
    data = Trajectories.from_hdf5(tmp_path / "log.hdf5", dt=0.1)
    assert data == Trajectories.from_flat(**arrays, dt=0.1)
    with h5py.File(tmp_path / "log.hdf5", "r+") as file:
        del file["actions"]
        file["actions"] = h5py.ExternalLink("/etc/passwd", "/x")
    with pytest.raises(TrajectoryError, match="actions is missing, or a link"):
        Trajectories.from_hdf5(tmp_path / "log.hdf5", dt=0.1)
    (tmp_path / "other.hdf5").write_bytes(b"text")
    with pytest.raises(TrajectoryError, match="holds no usable flat data set"):
        Trajectories.from_hdf5(tmp_path / "other.hdf5", dt=0.1)


# LeRobot, read through a stand-in for pyarrow where that is not installed


class Parquet(types.ModuleType):
    """What ``pyarrow.parquet`` does here, on files of JSON."""

    def read_table(self, path: Path, columns: list[str]) -> Any:
        table = json.loads(Path(path).read_text())
        return types.SimpleNamespace(to_pydict=lambda: {name: table[name] for name in columns})


@pytest.fixture
def lerobot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", Parquet("pyarrow.parquet"))
    names = {"motors": ["shoulder", "elbow"]}
    feature = {"dtype": "float32", "shape": [2], "names": names}
    info = {
        "codebase_version": "v3.0",
        "fps": 20,
        "robot_type": "so100",
        "features": {"observation.state": feature, "action": feature},
    }
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    for chunk, episodes in enumerate([(0, 1), (2,)]):
        steps = [(e, k) for e in episodes for k in range(5 + e)]
        table = {
            "observation.state": [[e + 0.1 * k, -k] for e, k in steps],
            "action": [[k, 10 * k] for _, k in steps],
            "episode_index": [e for e, _ in steps],
            "timestamp": [k / 20 for _, k in steps],
        }
        folder = tmp_path / "data" / f"chunk-{chunk:03d}"
        folder.mkdir(parents=True)
        (folder / "file-000.parquet").write_text(json.dumps(table))
    return tmp_path


def test_a_lerobot_folder_is_read_with_its_names_and_rate(lerobot: Path) -> None:
    data = Trajectories.from_lerobot(lerobot, angles=["elbow"])
    assert (data.lengths, data.env, data.dt) == ((4, 5, 6), "so100", 0.05)
    assert (data.names, data.angles) == (("shoulder", "elbow"), (1,))
    np.testing.assert_allclose(data.episode(1)[0][:, 0], 1 + 0.1 * np.arange(6), rtol=1e-6)
    np.testing.assert_allclose(data.episode(0)[1][:, 0], np.arange(4) / 3 - 1, atol=1e-6)
    (lerobot / "meta" / "info.json").write_text("{}")
    with pytest.raises(TrajectoryError, match=r"no usable LeRobotDataset: KeyError\('features'\)"):
        Trajectories.from_lerobot(lerobot)


def test_importing_the_library_loads_no_reader() -> None:
    code = (
        "import sys, tsmlib; tsmlib.Trajectories; print({'pandas', 'h5py', 'csv'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pandas" not in done.stdout
    assert "h5py" not in done.stdout


def test_an_end_of_an_episode_is_the_past_of_a_plan() -> None:
    data = read(log())
    past = data.past(1, 3)
    states, actions = data.episode(1)
    torch.testing.assert_close(past.states[0], torch.from_numpy(states[-3:]))
    torch.testing.assert_close(past.actions[0], torch.from_numpy(actions[-3:]))
    assert tsmlib.OneStep.for_data(data).past_len >= 1
