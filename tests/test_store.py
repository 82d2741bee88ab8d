"""Files: what is written is read back; nothing damaged, foreign or ill-fitting is accepted."""

from __future__ import annotations

import errno
import json
import math
import os
import pickle
import random
import resource
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch
from filelock import FileLock

import tsmlib
from tsmlib.storage import artifacts, files
from tsmlib.storage.files import Json, StoreError
from tsmlib.trajectory import Robot, Trajectories

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
    one, other = (tmp_path / f"{name}.safetensors" for name in ("x", "y"))
    assert one.read_bytes() == other.read_bytes()


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


def uneven() -> Trajectories:
    t = some_trajectories()
    x = [t.states[0], t.states[1, :3], t.states[2, :5]]
    u = [t.actions[0], t.actions[1, :2], t.actions[2, :4]]
    return Trajectories(x, u, "log", 0.1, angles=(0,), unwrap=True, terminated=(False, True, False))


def test_what_save_writes_load_reads(tmp_path: Path) -> None:
    equal = some_trajectories()
    for data in (equal, equal.take([1]), uneven(), uneven().take([0, 2])):
        artifacts.save_trajectories(tmp_path / "x.safetensors", data)
        assert artifacts.load_trajectories(tmp_path / "x.safetensors") == data


def test_padded_episodes_of_older_files_are_read(tmp_path: Path) -> None:
    data = uneven()
    x, u = data.padded()
    about = {name: getattr(data, name) for name in ("env", "dt", "names", "units", "angles")}
    about |= {"lengths": data.lengths, "terminated": data.terminated}
    header: dict[str, Json] = {"trajectories": about}
    path = tmp_path / "x.safetensors"
    artifacts.save(path, {"states": x, "actions": u}, kind="trajectories", header=header)
    assert artifacts.load_trajectories(path) == data
    for lengths in ([5, 2], [5, 2, 99], [5, 2, "4"], "abc", 7, [5, 0, 4]):
        header = {"trajectories": {**about, "lengths": lengths}}
        for arrays in ({"states": x, "actions": u}, data.tensors()._asdict()):
            artifacts.save(path, arrays, kind="trajectories", header=header)
            with pytest.raises(StoreError, match="holds no usable trajectories"):
                artifacts.load_trajectories(path)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("env", 5),
        ("dt", 0),
        ("dt", None),
        ("names", "abcdef"),
        ("angles", [99]),
        ("units", [1] * 6),
    ],
)
def test_a_robot_that_cannot_be_is_refused(tmp_path: Path, field: str, value: Json) -> None:
    t, path = some_trajectories(), tmp_path / "x.safetensors"
    about = {name: getattr(t, name) for name in ("env", "dt", "names", "units", "angles")}
    header: dict[str, Json] = {"trajectories": {**about, field: value}}
    arrays = {"states": t.states, "actions": t.actions}
    artifacts.save(path, arrays, kind="trajectories", header=header)
    with pytest.raises(StoreError, match="holds no usable trajectories"):
        artifacts.load_trajectories(path)


def test_a_model_comes_back_with_its_robot_and_draws_no_random_number(tmp_path: Path) -> None:
    data, path = some_trajectories(), tmp_path / "m.safetensors"
    model = tsmlib.OneStep.for_data(data)
    artifacts.save_model(path, model)
    torch.manual_seed(0)
    before = torch.get_rng_state()
    with ThreadPoolExecutor(4) as threads:
        loaded = list(threads.map(lambda _: artifacts.load_model(path, tsmlib.OneStep), range(8)))
    assert torch.equal(torch.get_rng_state(), before)
    for again in loaded:
        assert again.robot == data.robot
        for ours, theirs in zip(model.parameters(), again.parameters(), strict=True):
            assert torch.equal(ours, theirs)
            assert theirs.requires_grad
        assert not any(weight.is_meta for weight in again.state_dict().values())


def test_a_shipped_model_knows_its_robot() -> None:
    model = tsmlib.load_pretrained("rtsm", env="tsm/Reacher-v0")
    assert isinstance(model.robot, Robot)  # type: ignore[attr-defined]
    assert model.robot.env == "tsm/Reacher-v0"  # type: ignore[attr-defined]


def test_a_loaded_model_computes_the_same(tmp_path: Path) -> None:
    model = Line(inputs=3, outputs=2)
    artifacts.save_model(tmp_path / "m.safetensors", model, {"fingerprint": FINGERPRINT})
    again = artifacts.load_model(tmp_path / "m.safetensors", Line, expect=FINGERPRINT)
    x = torch.randn(4, 3)
    assert torch.equal(model.linear(x), again.linear(x))


def damage_is_refused(path: Path, damaged: bytes, load: Callable[[Path], Any]) -> None:
    path.write_bytes(damaged)
    with pytest.raises(StoreError, match=path.name):
        load(path)


def loaders(tmp_path: Path) -> dict[Path, Callable[[Path], Any]]:
    """One artefact of each kind, and what loads it."""
    trajectories, model = tmp_path / "t.safetensors", tmp_path / "m.safetensors"
    artifacts.save_trajectories(trajectories, some_trajectories(), {"seed": 1})
    artifacts.save_model(model, Line(inputs=3), {"fingerprint": FINGERPRINT})
    return {
        trajectories: artifacts.load_trajectories,
        model: lambda path: artifacts.load_model(path, Line),
    }


@pytest.mark.parametrize("which", [0, 1], ids=["trajectories", "model"])
def test_no_flipped_bit_goes_unnoticed(tmp_path: Path, which: int) -> None:
    path, load = list(loaders(tmp_path).items())[which]
    data, rng = path.read_bytes(), random.Random(0)
    header = range(min(8 * 400, 8 * len(data)))  # most of the ways to go wrong are here
    for bit in rng.sample(header, 400) + rng.sample(range(8 * len(data)), min(400, 8 * len(data))):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        damage_is_refused(path, bytes(flipped), load)


@pytest.mark.parametrize("which", [0, 1], ids=["trajectories", "model"])
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


def test_a_foreign_safetensors_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    safetensors.torch.save_file({"a": torch.ones(2)}, path)
    with pytest.raises(StoreError, match="no file of tsmlib"):
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


def test_a_missing_file_is_named_with_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"none\.safetensors does not exist: check its name"):
        artifacts.load_trajectories(tmp_path / "none.safetensors")


def test_another_kind_is_refused(saved: Path) -> None:
    with pytest.raises(StoreError, match="holds a 'thing', expected a 'trajectories'"):
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
    with pytest.raises(StoreError, match=r"'w' in .* are not finite, the first at \(1, 2\)"):
        artifacts.save(path, {"w": array}, kind="model", header={})
    assert not any(tmp_path.iterdir())
    with monkeypatch.context() as patch:  # a file that someone else made
        patch.setattr(artifacts, "_require_finite", lambda *_: None)
        artifacts.save(path, {"w": array}, kind="model", header={})
    with pytest.raises(StoreError, match=r"the first at \(1, 2\)"):
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
    with pytest.raises(StoreError, match="cannot write .*name another folder"):
        artifacts.save(
            saved / "inside" / "x.safetensors", {"a": torch.ones(1)}, kind="thing", header={}
        )
    with pytest.raises(StoreError, match="cannot write"):
        files.write_bytes("/proc/nowhere/x.json", b"")


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
    assert {"code", "cpu", "mujoco", "numpy"} <= set(found)


def test_a_lock_ends_with_its_holder_and_names_it_meanwhile(tmp_path: Path) -> None:
    run = tmp_path / "deep" / "run"

    def refused(said: str, where: Path = run) -> None:
        with pytest.raises(StoreError, match=said), files.writer_lock(where, "another"):
            pass

    with files.writer_lock(run, "a test"):
        refused(f"pid {os.getpid()} on .*, a test, since 2.*another folder")
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
    refused("cannot write in .*another folder", Path("/proc/nowhere"))


def test_a_holder_that_writes_its_name_late_is_named(tmp_path: Path) -> None:
    with FileLock(tmp_path / ".lock"):
        late = threading.Timer(0.5, (tmp_path / ".writer").write_text, ["pid 7 on a busy machine"])
        late.start()
        said = pytest.raises(StoreError, match=r"another process \(pid 7 on a busy machine\)")
        with said, files.writer_lock(tmp_path, "a test"):
            pass
        late.join()


def test_a_folder_without_locks_is_said_and_keeps_nobody_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import fcntl

    def missing(*_: Any) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", missing)
    for _ in range(2):
        with (
            pytest.warns(UserWarning, match="on a file system without locks"),
            files.writer_lock(tmp_path, "a test"),
        ):
            pass


def test_a_temporary_file_of_a_killed_writer_goes_after_an_hour(saved: Path) -> None:
    old, new = (saved.with_name(f".{saved.name}.tmp-{k}-0") for k in (1, 2))
    for path in (old, new):
        path.write_bytes(b"half")
    os.utime(old, (0, 0))
    artifacts.save(saved, {"a": torch.zeros(3)}, kind="thing", header={})
    assert sorted(only(saved.parent)) == sorted([new.name, saved.name])
