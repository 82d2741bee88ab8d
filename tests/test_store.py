"""Artefacts: what is written is read back exactly, and nothing damaged, foreign or ill-fitting is ever accepted."""

from __future__ import annotations

import errno
import gzip
import json
import math
import os
import pickle
import random
import resource
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch
from filelock import FileLock

from tsmlib.storage import artifacts, files, tables
from tsmlib.storage import manifest as manifest_storage
from tsmlib.storage.files import Json, StoreError
from reproduction.notebooks import _note, require
from reproduction.runs import Run, RunError
from tsmlib.trajectory import Trajectories

NAMES = ("joint0", "joint1", "joint0_vel", "joint1_vel", "tip_x", "tip_y")
UNITS = ("rad", "rad", "rad/s", "rad/s", "m", "m")


def some_trajectories(n: int = 3, steps: int = 5) -> Trajectories:
    rng = np.random.default_rng(0)
    states = rng.normal(size=(n, steps + 1, 6)).astype(np.float32)
    actions = rng.uniform(-1, 1, size=(n, steps, 2)).astype(np.float32)
    return Trajectories(states, actions, "tsm/Reacher-v0", 0.02, NAMES, UNITS)


class Line(torch.nn.Module):
    def __init__(self, *, inputs: int, outputs: int = 1) -> None:
        super().__init__()
        self.inputs, self.outputs = inputs, outputs
        self.linear = torch.nn.Linear(inputs, outputs)

    def config(self) -> dict[str, Any]:
        return {"inputs": self.inputs, "outputs": self.outputs}


class TrainingHistory(Line):
    pass


FINGERPRINT = {"env": "tsm/Reacher-v0", "names": NAMES, "dt": 0.02}


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "thing.safetensors"
    tensors = {"a": torch.arange(6.0).reshape(2, 3), "n": torch.tensor([3])}
    artifacts.save(path, tensors, kind="thing", header={"seed": 7})
    return path


# What goes in comes out ----------------------------------------------------------------------------------------------


def test_arrays_and_header_come_back_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "er" / "x.safetensors"
    header = {
        "seed": 7,
        "text": 'quotes " and "tsmlib":"{\\"sha256\\":\\"',
        "nested": {"list": [1, 2.5, None]},
    }
    tensors = {
        "a": torch.randn(3, 4),
        "b": np.arange(5),
        "c": np.float32(2.0) * np.ones((2, 0)),
        "d": torch.ones(()),
    }
    artifacts.save(path, tensors, kind="thing", header=header)
    found, found_header = artifacts.load(path, kind="thing")
    assert found_header == header == artifacts.read_header(path)
    assert set(found) == set(tensors)
    for name, value in tensors.items():
        assert torch.equal(found[name], torch.as_tensor(value))
        assert found[name].dtype == torch.as_tensor(value).dtype


def test_a_view_is_stored_as_its_own_values(tmp_path: Path) -> None:
    whole = torch.arange(12.0).reshape(3, 4)
    artifacts.save(tmp_path / "x.safetensors", {"t": whole.T, "row": whole[1]}, kind="k", header={})
    found, _ = artifacts.load(tmp_path / "x.safetensors", kind="k")
    assert torch.equal(found["t"], whole.T)
    assert torch.equal(found["row"], whole[1])


def test_any_safetensors_reader_opens_an_artefact(saved: Path) -> None:
    assert torch.equal(safetensors.torch.load_file(saved)["n"], torch.tensor([3]))


def test_the_same_content_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("x", "y"):
        artifacts.save_trajectories(
            tmp_path / f"{name}.safetensors", some_trajectories(), {"seed": 1}
        )
    assert manifest_storage.sha256(tmp_path / "x.safetensors") == manifest_storage.sha256(
        tmp_path / "y.safetensors"
    )


def test_trajectories_come_back_as_they_were(tmp_path: Path) -> None:
    before = some_trajectories()
    artifacts.save_trajectories(tmp_path / "x.safetensors", before, {"seed": 1})
    after = artifacts.load_trajectories(
        tmp_path / "x.safetensors", expect={"env": "tsm/Reacher-v0"}
    )
    np.testing.assert_array_equal(after.states, before.states)
    np.testing.assert_array_equal(after.actions, before.actions)
    assert after.states.dtype == after.actions.dtype == np.float32
    assert (after.env, after.dt, after.names, after.units, after.angles) == (
        (before.env, before.dt, before.names, before.units, before.angles)
    )


def test_episodes_of_different_length_come_back_with_their_ends(tmp_path: Path) -> None:
    t = some_trajectories()
    states, actions = (
        [t.states[0], t.states[1, :3], t.states[2, :5]],
        [t.actions[0], t.actions[1, :2], t.actions[2, :4]],
    )
    before = Trajectories(
        states, actions, t.env, t.dt, NAMES, UNITS, terminated=(False, True, False)
    )
    artifacts.save_trajectories(tmp_path / "x.safetensors", before)
    after = artifacts.load_trajectories(tmp_path / "x.safetensors")
    np.testing.assert_array_equal(after.states, before.states)
    assert (after.lengths, after.terminated) == ((5, 2, 4), (False, True, False))
    artifacts.save_trajectories(tmp_path / "y.safetensors", t)
    assert {"lengths", "terminated"}.isdisjoint(
        artifacts.read_header(tmp_path / "y.safetensors")["trajectories"]
    )


@pytest.mark.parametrize("lengths", [[5, 2], [5, 2, 99], [5, 2, "4"], "abc", 7, [5, 1, 4]])
def test_a_file_whose_ends_do_not_fit_is_refused(tmp_path: Path, lengths: Json) -> None:
    t = some_trajectories()
    fields = {
        "env": t.env,
        "dt": t.dt,
        "names": NAMES,
        "units": UNITS,
        "angles": [],
        "lengths": lengths,
    }
    arrays = {"states": t.states, "actions": t.actions}
    artifacts.save(
        tmp_path / "x.safetensors", arrays, kind="trajectories", header={"trajectories": fields}
    )
    with pytest.raises(StoreError, match="holds no usable trajectories"):
        artifacts.load_trajectories(tmp_path / "x.safetensors")


def test_a_loaded_model_computes_the_same(tmp_path: Path) -> None:
    model = Line(inputs=3, outputs=2)
    artifacts.save_model(tmp_path / "m.safetensors", model, {"fingerprint": FINGERPRINT})
    again = artifacts.load_model(tmp_path / "m.safetensors", Line, expect=FINGERPRINT)
    x = torch.randn(4, 3)
    assert torch.equal(model.linear(x), again.linear(x))


def test_a_table_comes_back_with_numbers_as_numbers(tmp_path: Path) -> None:
    rows = [
        {
            "env": "tsm/Reacher-v0",
            "metric": "success",
            "value": np.float32(0.5),
            "n": 100,
            "seed": np.int64(0),
        },
        {"env": 'a "b", c', "metric": "return_true", "value": -1e-30, "target": 3},
    ]
    tables.save(tmp_path / "t.csv", rows, extra=("target",))
    found = tables.records(tables.load(tmp_path / "t.csv"))
    assert found[0]["value"] == 0.5
    assert found[0]["n"] == 100
    assert found[0]["horizon"] == found[0]["target"] == ""
    assert found[1]["env"] == rows[1]["env"]
    assert found[1]["value"] == -1e-30
    assert found[1]["target"] == 3


def test_json_comes_back_as_it_was(tmp_path: Path) -> None:
    value = {"b": [1, 2.5, None, "ü"], "a": {}}
    manifest_storage.write_json(tmp_path / "x.json", value)
    assert manifest_storage.read_own_json(tmp_path / "x.json") == value


# Damage is found -----------------------------------------------------------------------------------------------------


def damage_is_refused(path: Path, damaged: bytes, load: Callable[[Path], Any]) -> None:
    path.write_bytes(damaged)
    with pytest.raises(StoreError, match=path.name):
        load(path)


def loaders(tmp_path: Path) -> dict[Path, Callable[[Path], Any]]:
    """One artefact of each kind, and what loads it."""
    trajectories, model, table = (
        tmp_path / name for name in ("t.safetensors", "m.safetensors", "shipped/x.csv")
    )
    artifacts.save_trajectories(trajectories, some_trajectories(), {"seed": 1})
    artifacts.save_model(model, Line(inputs=3), {"fingerprint": FINGERPRINT})
    tables.save(table, [{"metric": "success", "value": 0.5}])
    manifest_storage.write_manifest(table.parent)
    return {
        trajectories: artifacts.load_trajectories,
        model: lambda path: artifacts.load_model(path, Line),
        table: tables.load,
    }


@pytest.mark.parametrize("which", [0, 1, 2], ids=["trajectories", "model", "table"])
def test_no_flipped_bit_goes_unnoticed(tmp_path: Path, which: int) -> None:
    path, load = list(loaders(tmp_path).items())[which]
    data, rng = path.read_bytes(), random.Random(0)
    header = range(min(8 * 400, 8 * len(data)))  # most of the ways to go wrong are here
    for bit in rng.sample(header, 400) + rng.sample(range(8 * len(data)), min(400, 8 * len(data))):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        damage_is_refused(path, bytes(flipped), load)


@pytest.mark.parametrize("which", [0, 1, 2], ids=["trajectories", "model", "table"])
def test_no_cut_append_or_zeroed_block_goes_unnoticed(tmp_path: Path, which: int) -> None:
    path, load = list(loaders(tmp_path).items())[which]
    data = path.read_bytes()
    for length in range(0, len(data), max(1, len(data) // 100)):
        damage_is_refused(path, data[:length], load)
    for tail in (b"\0", b"\n", b" ", data):
        damage_is_refused(path, data + tail, load)
    for start in range(0, len(data) - 16, max(16, len(data) // 50)):
        if any(data[start : start + 16]):
            damage_is_refused(path, data[:start] + bytes(16) + data[start + 16 :], load)


def test_a_flipped_bit_in_a_manifest_is_found(tmp_path: Path) -> None:
    tables.save(tmp_path / "x.csv", [{"metric": "success", "value": 0.5}])
    manifest_storage.write_manifest(tmp_path)
    manifest = tmp_path / files.MANIFEST
    data = manifest.read_bytes()
    for bit in range(8 * len(data)):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        damage_is_refused(manifest, bytes(flipped), lambda _: manifest_storage.verify(tmp_path))


def test_a_foreign_safetensors_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    safetensors.torch.save_file({"a": torch.ones(2)}, path)
    with pytest.raises(StoreError, match="not written by tsmlib"):
        artifacts.load(path, kind="thing")


def test_a_pickle_is_refused_and_not_executed(tmp_path: Path) -> None:
    class Payload:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.mkdir, (str(tmp_path / "canary"),)

    path = tmp_path / "x.safetensors"
    path.write_bytes(pickle.dumps({"weights": Payload()}))
    with pytest.raises(StoreError, match=r"x\.safetensors"):
        artifacts.load(path, kind="model")
    assert not (tmp_path / "canary").exists()


def test_loading_starts_no_process_and_opens_no_connection(tmp_path: Path) -> None:
    artefacts = loaders(tmp_path)
    seen: list[str] = []
    listening = True

    def hook(event: str, _: tuple[Any, ...]) -> None:
        if listening and event.startswith(
            ("pickle.", "os.system", "subprocess.", "socket.", "exec", "compile")
        ):
            seen.append(event)

    sys.addaudithook(hook)
    for path, load in artefacts.items():
        load(path)
    listening = False
    assert not seen


# What does not fit is refused ----------------------------------------------------------------------------------------


def test_a_missing_file_is_named_with_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(
        StoreError, match=r"none\.safetensors does not exist.*run the notebook that makes it"
    ):
        artifacts.load_trajectories(tmp_path / "none.safetensors")


def test_another_kind_is_refused(saved: Path) -> None:
    with pytest.raises(StoreError, match="holds 'thing', expected 'trajectories'"):
        artifacts.load_trajectories(saved)


def test_trajectories_of_another_environment_are_refused(tmp_path: Path) -> None:
    artifacts.save_trajectories(tmp_path / "x.safetensors", some_trajectories())
    with pytest.raises(
        StoreError, match="env is 'tsm/Reacher-v0' in the file, expected 'tsm/ReacherPush-v1'"
    ):
        artifacts.load_trajectories(
            tmp_path / "x.safetensors", expect={"env": "tsm/ReacherPush-v1"}
        )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_is_neither_written_nor_read(
    tmp_path: Path, value: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, array = tmp_path / "x.safetensors", np.ones((2, 3))
    array[1, 2] = value
    with pytest.raises(StoreError, match=r"'w' for .*not finite, the first at index \(1, 2\)"):
        artifacts.save(path, {"w": array}, kind="model", header={})
    assert not any(tmp_path.iterdir())
    with monkeypatch.context() as patch:  # a file that someone else made
        patch.setattr(artifacts, "_require_finite", lambda *_: None)
        artifacts.save(path, {"w": array}, kind="model", header={})
    with pytest.raises(StoreError, match=r"index \(1, 2\)"):
        artifacts.load(path, kind="model")


def test_a_model_of_another_environment_is_refused_naming_both_sides(tmp_path: Path) -> None:
    path = tmp_path / "m.safetensors"
    artifacts.save_model(path, Line(inputs=3), {"fingerprint": FINGERPRINT})
    wrong = {**FINGERPRINT, "env": "tsm/ReacherPush-v1", "past_len": 10}
    with pytest.raises(StoreError) as caught:
        artifacts.load_model(path, Line, expect=wrong)
    message = str(caught.value)
    assert "env is 'tsm/Reacher-v0' in the file, expected 'tsm/ReacherPush-v1'" in message
    assert "past_len is 'not stated' in the file, expected 10" in message
    assert "dt is" not in message


def test_a_model_of_another_class_or_shape_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.safetensors"
    artifacts.save_model(path, Line(inputs=3))
    with pytest.raises(StoreError, match="holds a 'Line', expected a TrainingHistory"):
        artifacts.load_model(path, TrainingHistory)
    tensors, header = artifacts.load(path, kind="model")
    artifacts.save(path, tensors, kind="model", header={**header, "config": {"inputs": 4}})
    with pytest.raises(StoreError, match="does not fit the present Line"):
        artifacts.load_model(path, Line)
    artifacts.save(path, tensors, kind="model", header={**header, "config": {"colour": 4}})
    with pytest.raises(StoreError, match="does not fit the present Line"):
        artifacts.load_model(path, Line)


def test_numbers_that_json_does_not_have_are_spelled_and_read_again() -> None:
    given: Any = {
        "clip": math.inf,
        "curve": [[1.5, -math.inf], [np.float32(np.nan)]],
        "name": "info",
        "n": 3,
        "none": None,
    }
    again = files.decode_nonfinite(
        files.loads(json.dumps(files.encode_nonfinite(given), allow_nan=False))
    )
    assert again.keys() == given.keys()
    assert str(again) == str({**given, "curve": [[1.5, -math.inf], [math.nan]]})


def test_a_header_that_is_not_json_is_refused(saved: Path) -> None:
    before = saved.read_bytes()
    for header in ({"f": print}, {"x": float("nan")}, {"t": torch.ones(1)}, {("a",): 1}):
        with pytest.raises(StoreError, match=r"thing\.safetensors cannot be written"):
            artifacts.save(saved, {"a": torch.ones(1)}, kind="thing", header=header)
    assert saved.read_bytes() == before


def test_a_compressed_table_is_the_same_table_and_the_same_bytes_at_any_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [{"metric": "success", "value": 0.1, "seed": seed} for seed in range(50)]
    plain = tables.save(tmp_path / "t.csv", rows)
    text = (tmp_path / "t.csv").read_bytes()
    tables.save(tmp_path / "a.csv.gz", rows)
    monkeypatch.setattr(time, "time", lambda: 2e9)
    tables.save(tmp_path / "b.csv.gz", rows)
    packed = (tmp_path / "a.csv.gz").read_bytes()
    assert packed == (tmp_path / "b.csv.gz").read_bytes()
    assert gzip.decompress(packed) == text
    assert tables.load(tmp_path / "a.csv.gz").equals(plain)
    assert tables.load(tmp_path / "b.csv").equals(plain)  # by the name that the notebooks use


def test_a_table_ships_in_one_form_alone_whichever_its_size_asks_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, rows = (
        tmp_path / "t.csv",
        [{"metric": "success", "value": 0.1, "seed": seed} for seed in range(50)],
    )
    for large, name in ((100, "t.csv.gz"), (10_000, "t.csv"), (100, "t.csv.gz")):
        monkeypatch.setattr(tables, "LARGE", large)
        assert tables.ship(path, rows).equals(tables.load(path))
        assert [each.name for each in tmp_path.iterdir()] == [name]
        assert tables.stored(path) == tmp_path / name
    other = gzip.compress(gzip.decompress((tmp_path / "t.csv.gz").read_bytes()), 1)
    (tmp_path / "t.csv.gz").write_bytes(other)
    tables.ship(path, rows)
    assert (tmp_path / "t.csv.gz").read_bytes() == other  # packed otherwise, and the same table
    path.write_bytes(gzip.decompress(other))
    with pytest.raises(StoreError, match=r"t\.csv is there compressed as well"):
        tables.load(path)


def test_a_compressed_table_that_is_cut_changed_or_too_large_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "t.csv.gz"
    tables.save(path, [{"metric": "success", "value": 0.1, "seed": seed} for seed in range(50)])
    good = path.read_bytes()
    changed = bytearray(good)
    changed[len(good) // 2] ^= 1
    for bad in (b"", good[:-9], bytes(changed), b"env,sim\n"):
        path.write_bytes(bad)
        with pytest.raises(StoreError, match=r"t\.csv\.gz"):
            tables.load(path)
    path.write_bytes(good)
    monkeypatch.setattr(files, "UNPACKED", 1000)
    with pytest.raises(StoreError, match="unpacks to more than 1000 bytes"):
        tables.load(path)


def test_a_table_with_a_wrong_column_or_number_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="unknown columns \\['modle'\\]"):
        tables.save(tmp_path / "t.csv", [{"modle": "tsm"}])
    with pytest.raises(StoreError, match="value = nan"):
        tables.save(tmp_path / "t.csv", [{"metric": "success", "value": float("nan")}])
    assert not any(tmp_path.iterdir())


def test_a_file_that_is_no_table_is_refused(tmp_path: Path) -> None:
    for text in (
        "",
        "a,b\n1,2\n",
        ",".join(tables.COLUMNS) + "\n1,2\n",
        ",".join(tables.COLUMNS) + '\n"1',
    ):
        (tmp_path / "t.csv").write_text(text)
        with pytest.raises(StoreError, match=r"t\.csv"):
            tables.records(tables.load(tmp_path / "t.csv"))


# Writing is all or nothing -------------------------------------------------------------------------------------------


def only(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir()]


def test_a_full_disk_leaves_the_old_file_and_nothing_else(saved: Path) -> None:
    before = saved.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(
            StoreError, match=r"cannot write .*thing\.safetensors \(\d+ bytes\): File too large"
        ):
            artifacts.save(saved, {"a": torch.zeros(10_000)}, kind="thing", header={})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, ignored)
    assert saved.read_bytes() == before
    assert only(saved.parent) == [saved.name]


@pytest.mark.parametrize("call", ["fsync", "replace"])
@pytest.mark.parametrize(
    "fault", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()]
)
def test_a_fault_while_writing_leaves_the_old_file_and_nothing_else(
    saved: Path, monkeypatch: pytest.MonkeyPatch, call: str, fault: BaseException
) -> None:
    def fail(*_: Any) -> None:
        raise fault

    before = saved.read_bytes()
    with monkeypatch.context() as patch, pytest.raises((StoreError, KeyboardInterrupt)) as caught:
        patch.setattr(os, call, fail)
        artifacts.save(saved, {"a": torch.zeros(3)}, kind="thing", header={})
    if isinstance(fault, OSError):
        assert "No space left" in str(caught.value)
        assert str(saved) in str(caught.value)
    assert saved.read_bytes() == before
    assert only(saved.parent) == [saved.name]


def test_threads_that_write_one_file_do_not_mix(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, both, replace = tmp_path / "x.json", threading.Barrier(2, timeout=30), os.replace

    def together(source: Path, target: Path) -> None:
        both.wait()
        replace(source, target)

    monkeypatch.setattr(os, "replace", together)
    contents = [word * 100_000 for word in (b"a", b"b")]
    with ThreadPoolExecutor(2) as threads:
        list(threads.map(lambda data: files.write_bytes(path, data), contents))
    assert path.read_bytes() in contents
    assert os.listdir(tmp_path) == ["x.json"]


def test_data_reaches_the_disk_before_its_name_does(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    for name in ("fsync", "replace"):
        real = getattr(os, name)
        monkeypatch.setattr(
            os, name, lambda *a, name=name, real=real: (calls.append(name), real(*a))[1]
        )
    artifacts.save(saved, {"a": torch.zeros(3)}, kind="thing", header={})
    assert calls == ["fsync", "replace", "fsync"]


def test_an_unwritable_folder_is_one_clear_message(saved: Path) -> None:
    with pytest.raises(StoreError, match="cannot write .*TSM_RUN_DIR"):
        artifacts.save(
            saved / "inside" / "x.safetensors", {"a": torch.ones(1)}, kind="thing", header={}
        )
    with pytest.raises(StoreError, match="cannot write"):
        manifest_storage.write_json("/proc/nowhere/x.json", {})


def test_leftovers_of_a_killed_writer_are_removed(saved: Path) -> None:
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)
    left, elsewhere = (
        f".{saved.name}.tmp-{host}-{child}" for host in (socket.gethostname(), "another")
    )
    for name in (left, elsewhere):
        saved.with_name(name).write_bytes(b"half")
    artifacts.save(saved, {"a": torch.zeros(3)}, kind="thing", header={})
    assert sorted(only(saved.parent)) == [
        elsewhere,
        saved.name,
    ]  # whether that one goes on, nobody here knows


# Verification --------------------------------------------------------------------------------------------------------


def test_verify_follows_an_artefact_to_what_it_was_made_from(tmp_path: Path) -> None:
    data, model = tmp_path / "data.safetensors", tmp_path / "models" / "m.safetensors"
    artifacts.save_trajectories(data, some_trajectories())
    artifacts.save_model(
        model, Line(inputs=3), {"inputs": {"../data.safetensors": manifest_storage.sha256(data)}}
    )
    assert {path.name for path in manifest_storage.verify(model)} == {
        "m.safetensors",
        "data.safetensors",
    }
    artifacts.save_trajectories(data, some_trajectories(n=4))
    with pytest.raises(StoreError, match="data.safetensors is damaged, or was changed"):
        manifest_storage.verify(model)
    data.unlink()
    assert [path.name for path in manifest_storage.verify(model)] == ["m.safetensors"]


def test_verify_lists_every_problem_of_a_folder(tmp_path: Path) -> None:
    for name in "abc":
        artifacts.save_trajectories(tmp_path / f"{name}.safetensors", some_trajectories())
    tables.save(tmp_path / "t.csv", [])
    manifest_storage.write_manifest(tmp_path)
    assert len(manifest_storage.verify(tmp_path)) == 5
    (tmp_path / "a.safetensors").write_bytes(b"")
    (tmp_path / "b.safetensors").unlink()
    (tmp_path / "t.csv").write_text("x")
    with pytest.raises(StoreError) as caught:
        manifest_storage.verify(tmp_path)
    for name in ("a.safetensors", "b.safetensors", "t.csv"):
        assert name in str(caught.value)
    assert "c.safetensors" not in str(caught.value)


def test_verify_and_load_know_the_tables_of_a_complete_run(tmp_path: Path) -> None:
    run = Run("05_control", "smoke", 0, tmp_path)
    table = run.metrics / "05_control.csv"
    tables.save(table, [{"metric": "success", "value": 0.5}])
    _note(run, {"state": "complete", "files": manifest_storage.listing(run.dir, [table])})
    assert table in manifest_storage.verify(tmp_path)
    assert require(run, "05_control")["state"] == "complete"
    table.write_text(table.read_text().replace("0.5", "0.9"))
    with pytest.raises(StoreError, match="05_control.csv is damaged, or was changed"):
        manifest_storage.verify(tmp_path)
    with pytest.raises(
        StoreError, match="05_control.csv is damaged, or was changed after its run was complete"
    ):
        tables.records(tables.load(table))
    with pytest.raises(RunError, match="python -m tsmlib run control --scale smoke --seed 0"):
        require(run, "05_control")
    with pytest.raises(RunError, match="02_train in .* is not run, expected complete"):
        require(run, "02_train")


def test_a_file_of_the_first_format_is_held_to_what_it_states(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "m.safetensors"
    expect = {**FINGERPRINT, "noise": 0.0}
    artifacts.save_model(path, Line(inputs=3), {"fingerprint": FINGERPRINT})
    with pytest.raises(StoreError, match="noise is 'not stated' in the file, expected 0.0"):
        artifacts.load_model(path, Line, expect=expect)
    with monkeypatch.context() as patch:
        patch.setattr(artifacts, "SCHEMA", 1)
        artifacts.save_model(path, Line(inputs=3), {"fingerprint": FINGERPRINT})
    artifacts.load_model(path, Line, expect=expect)
    with pytest.raises(StoreError, match="dt is 0.02 in the file, expected 0.01"):
        artifacts.load_model(path, Line, expect={**expect, "dt": 0.01})


def test_an_artefact_states_what_made_it(saved: Path) -> None:
    with safetensors.safe_open(saved, "np") as file:
        found = json.loads(file.metadata()["tsmlib"])["provenance"]
    assert (
        found["torch"] == torch.__version__.partition("+")[0] or found["torch"] == torch.__version__
    )
    assert found["threads"] == torch.get_num_threads()
    assert {"code", "commit", "cpu", "mujoco", "numpy"} <= set(found)


def test_a_model_as_large_as_a_forger_likes_is_refused_without_making_it(tmp_path: Path) -> None:
    path = tmp_path / "m.safetensors"
    forged = Line(inputs=3)
    for inputs, said in (
        (9999, r"linear.weight is 'float32 \[1, 3\]' in the file, expected .*9999"),
        (10**12, "inputs is 1000000000000, expected sizes of at most 10000"),
    ):
        forged.inputs = inputs
        artifacts.save_model(path, forged)
        with pytest.raises(StoreError, match=said):
            artifacts.load_model(path, Line)


def test_a_lock_ends_with_its_holder_and_names_it_meanwhile(tmp_path: Path) -> None:
    run = tmp_path / "deep" / "run"

    def refused(said: str, where: Path = run) -> None:
        with pytest.raises(StoreError, match=said), files.writer_lock(where, "another"):
            pass

    with files.writer_lock(run, "a test"):
        refused(f"pid {os.getpid()} on .*, a test, since 2.*TSM_RUN_DIR")
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        with files.writer_lock(run, "a child"):
            os.write(writer, b"x")
            signal.pause()
    os.read(reader, 1)
    refused(f"pid {child} on .*, a child")
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    with files.writer_lock(run, "another"):
        pass
    refused("cannot write in .*TSM_RUN_DIR", Path("/proc/nowhere"))


def test_a_holder_that_writes_its_name_late_is_named(tmp_path: Path) -> None:
    with FileLock(tmp_path / ".lock"):
        late = threading.Timer(0.5, (tmp_path / ".writer").write_text, ["pid 7 on a busy machine"])
        late.start()
        said = pytest.raises(StoreError, match=r"another process \(pid 7 on a busy machine\)")
        with said, files.writer_lock(tmp_path, "a test"):
            pass
        late.join()


def test_a_lock_of_one_part_leaves_the_others_alone_and_may_be_waited_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        with files.writer_lock(tmp_path, "a child", name="one"):
            os.write(writer, b"x")
            time.sleep(1)
        os._exit(0)
    os.read(reader, 1)
    with files.writer_lock(tmp_path, "a test", name="two"):
        pass
    with files.writer_lock(tmp_path, "a test", name="one", wait=True):
        assert (
            f"waiting for pid {child} on {socket.gethostname()}, a child" in capsys.readouterr().err
        )
    os.waitpid(child, 0)


def test_a_manifest_cannot_point_outside_its_folder(tmp_path: Path) -> None:
    entries = {"../../etc/passwd": {"bytes": 1, "sha256": "0" * 64}}
    manifest_storage.write_json(
        tmp_path / files.MANIFEST, manifest_storage.sealed({"files": entries})
    )
    with pytest.raises(StoreError, match="outside its own folder"):
        manifest_storage.verify(tmp_path)


def test_verify_does_not_vouch_for_what_it_cannot_check(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(StoreError, match="nothing to check"):
        manifest_storage.verify(tmp_path / "notes.txt")
    with pytest.raises(StoreError, match="does not exist"):
        manifest_storage.verify(tmp_path / "nothing")
