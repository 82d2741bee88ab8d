"""Running notebooks: parameters are checked before anything exists, and nothing unfinished is ever called complete."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import multiprocessing
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import nbformat
import pytest

from tsmlib.__main__ import main
from tsmlib.envs.spec import ENV_IDS
from tsmlib.storage import manifest
from tsmlib.storage.files import StoreError
from reproduction import explorer, notebooks, papermill_plugin, parameters, runs
from reproduction.parameters import ParameterError
from reproduction.runs import RunError, resolve

PARAMETERS = (
    'scale = ""\nseed = 0\nrun_dir = ""\nrate = 0.5\nname = "x"\nfast = False\nsizes = [1, 2]'
)


def write_notebook(path: Path, *cells: str, parameters: str = PARAMETERS) -> Path:
    notebook = nbformat.v4.new_notebook(
        metadata={
            "kernelspec": {"name": "python3", "display_name": "Python 3"},
            "language_info": {"name": "python"},
        }
    )
    notebook.cells = [nbformat.v4.new_code_cell(source) for source in (parameters, *cells)]
    notebook.cells[0].metadata["tags"] = ["parameters"]
    path.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, path)
    return path


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with two notebooks, and a name for runs in which braces must survive."""
    monkeypatch.setattr(runs, "NOTEBOOKS", tmp_path / "notebooks")
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path / "runs {x} ü"))
    write_notebook(
        tmp_path / "notebooks" / "01_first.ipynb",
        "result = (scale, seed, rate, name, fast)",
        "result",
    )
    write_notebook(tmp_path / "notebooks" / "02_second.ipynb", "1 + 1")
    return tmp_path


def status(place: Path, scale: str = "laptop", seed: int = 0) -> dict[str, Any]:
    folder = place / "runs {x} ü" / scale / f"seed{seed}"
    return {
        path.name.partition(".")[0]: json.loads(path.read_text())
        for path in folder.glob("*.status.json")
    }


def untouched(place: Path) -> bool:
    return not (place / "runs {x} ü").exists()


# Where things live ---------------------------------------------------------------------------------------------------


def test_a_parameter_beats_the_environment_which_beats_the_default(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert resolve("05_control").dir == runs.ROOT / "runs" / "laptop" / "seed0"
    monkeypatch.setenv("TSM_SCALE", "smoke")
    monkeypatch.setenv("TSM_RUN_DIR", "/elsewhere")
    assert resolve("05_control", seed=3).dir == Path("/elsewhere/smoke/seed3")
    assert resolve("05_control", scale="paper", run_dir="/here").dir == Path("/here/paper/seed0")


def test_the_place_of_a_run_does_not_depend_on_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = resolve("05_control")
    monkeypatch.chdir(tmp_path)
    assert resolve("05_control") == before
    assert before.shipped == runs.ROOT / "data" / "pretrained"


def test_folders_exist_when_they_are_asked_for_and_not_before(place: Path) -> None:
    run = resolve("01_first")
    assert untouched(place)
    for folder in (run.data, run.models, run.metrics, run.figures):
        assert folder.is_dir()
        assert folder.parent == run.dir


def test_a_run_picks_by_scale() -> None:
    assert [
        resolve("x", scale=scale).pick(smoke=1, laptop=2, paper=3) for scale in parameters.SCALES
    ] == [1, 2, 3]


@pytest.mark.parametrize(
    "bad",
    [
        *(
            {"scale": value}
            for value in ("huge", "../../x", "smoke\n", 1, None, True, "x" * 300, "laptop/..")
        ),
        *({"seed": value} for value in (-1, 2**31, 1.0, "1", True, None, float("nan"), 10**30)),
        *(
            {"run_dir": value}
            for value in ("../x", "a/../b", "~/x", "a\0b", "a\nb", 3, None, "x" * 2000, "a\u202eb")
        ),
        {"run_dir": str(Path(__file__))},
    ],
    ids=lambda bad: repr(bad)[:40],
)
def test_bad_settings_are_refused_naming_the_value(bad: dict[str, Any]) -> None:
    with pytest.raises(ParameterError, match=r"(scale|seed|run_dir) is .*expected"):
        resolve("05_control", **bad)


def test_a_bad_environment_is_refused_by_its_own_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TSM_SCALE", "huge")
    with pytest.raises(
        ParameterError, match="TSM_SCALE is 'huge', expected one of smoke, laptop, paper"
    ):
        resolve("05_control")


def test_a_folder_that_cannot_be_made_is_one_clear_message() -> None:
    with pytest.raises(ParameterError, match=r"cannot make the folder .*TSM_RUN_DIR"):
        _ = resolve("05_control", run_dir="/proc/nowhere").data


# Parameters ----------------------------------------------------------------------------------------------------------


def test_values_take_the_type_of_the_default(place: Path) -> None:
    given = {"seed": "7", "rate": "1e-3", "name": "007", "fast": "True"}
    assert parameters.typed(runs.notebooks()["first"].path, given) == {
        "seed": 7,
        "rate": 0.001,
        "name": "007",
        "fast": True,
    }


def test_the_schema_knows_every_environment_model_and_parameter() -> None:
    assert set(parameters.ENVS) == set(ENV_IDS)
    for notebook in runs.notebooks().values():
        assert set(parameters.declared(notebook.path)) <= set(parameters.SCHEMA), notebook.name
        for name, default in parameters.declared(notebook.path).items():
            parameters.check(name, default)


BAD_PARAMETERS = [
    *(
        "sed=7",
        "seed",
        "=3",
        "seed=3",
        "scale=smoke",
        "rate=",
        "name=a\nb",
        "name=a\0b",
        "sizes=[3]",
        "sizes=3",
    ),
    *(
        f"rate={text}"
        for text in (
            "nan",
            "inf",
            "-inf",
            "1e999",
            "true",
            "0x10",
            "1_000",
            "10**9",
            "[1]",
            "{}",
            "1,5",
        )
    ),
    *(f"fast={text}" for text in ("1", "yes", "", "None")),
    "seed=1; open('pwned.txt','w').write('x'); y=3",
    "__class__=3",
    "run_dir=../../x",
    "run_dir=~",
    "name=" + "x" * 2000,
]


@pytest.mark.parametrize("item", BAD_PARAMETERS, ids=lambda item: repr(item)[:40])
def test_bad_parameters_are_refused_before_any_file_exists(
    place: Path, item: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "first", "-p", item]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert untouched(place)


@pytest.mark.parametrize(
    "seed", ["-1", "2147483648", "1.0", "x", "", "nan", "1e3", "0x10", "9" * 99]
)
def test_bad_seeds_are_refused_before_any_file_exists(place: Path, seed: str) -> None:
    assert main(["run", "first", f"--seed={seed}"]) == 2
    assert main(["run", "first", "--scale", "huge"]) == 2
    assert untouched(place)


def test_an_unknown_notebook_is_refused_listing_those_that_exist(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "contrl"]) == 2
    assert "there are first, second, or all" in capsys.readouterr().err


@pytest.mark.parametrize(
    "source", ["x = 1 + y", "import os", "x, y = 1, 2", "x = open('f')", "x ="]
)
def test_a_parameters_cell_holds_literals_only(place: Path, source: str) -> None:
    with pytest.raises(ParameterError, match="parameters cell"):
        parameters.declared(write_notebook(place / "03_bad.ipynb", parameters=source))


def test_help_of_a_notebook_lists_its_parameters_with_defaults_and_comments(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = 'scale = ""  # how much\nseed = 0\nrun_dir = ""\nrate = 0.5  # per second, not "per # minute"'
    write_notebook(place / "notebooks" / "01_first.ipynb", parameters=cell)
    for words in (["run", "first", "--help"], ["run", "-h", "first"]):
        assert main(words) == 0
        text = capsys.readouterr().out
        assert re.search(r"^  --scale '' +how much$", text, re.MULTILINE)
        assert re.search(r'^  -p rate=0.5 +per second, not "per # minute"$', text, re.MULTILINE)
        assert "fast" not in text
    assert main(["run", "--help"]) == 0
    assert "rate" not in capsys.readouterr().out
    assert main(["run", "frist", "--help"]) == 2
    assert untouched(place)


def test_a_mistyped_parameter_is_refused_naming_the_closest(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "first", "-p", "rat=1"]) == 2
    assert (
        "no parameter 'rat'; the closest is rate, and it has scale, seed, run_dir, rate,"
        in capsys.readouterr().err
    )
    assert main(["run", "first", "-p", "xyzzy=1"]) == 2
    assert "no parameter 'xyzzy'; it has scale" in capsys.readouterr().err


def test_notebooks_are_copied_out_and_a_changed_copy_is_never_replaced(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copies = [place / "mine" / name for name in ("01_first.ipynb", "02_second.ipynb")]
    for _ in range(2):  # the second time there is nothing to do
        assert main(["notebooks", str(place / "mine")]) == 0
        assert capsys.readouterr().out.split() == list(map(str, copies))
    assert [path.read_bytes() for path in copies] == [
        each.path.read_bytes() for each in runs.notebooks().values()
    ]
    copies[0].unlink()
    copies[1].write_text("{}")
    assert main(["notebooks", str(place / "mine")]) == 1
    assert "mine holds 02_second.ipynb, changed since" in capsys.readouterr().err
    assert copies[1].read_text() == "{}"
    assert not copies[0].exists()


def test_a_copy_is_named_by_its_path(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = write_notebook(
        place / "mine" / "01_first.ipynb", parameters="scale = ''\nseed = 0\nrun_dir = ''\nmine = 3"
    )
    assert main(["run", str(copy), "--help"]) == 0
    assert "-p mine=3" in capsys.readouterr().out
    assert main(["run", str(copy.with_name("02_none.ipynb"))]) == 2
    assert "no notebook is called" in capsys.readouterr().err


def test_what_a_changed_copy_made_counts_for_nothing_but_itself(place: Path) -> None:
    copy = write_notebook(place / "mine" / "01_first.ipynb", "import tsmlib")
    assert main(["run", str(copy)]) == 0
    own = notebooks.prepare(runs.Notebook("first", copy))
    assert notebooks.outdated(own) == ""
    with pytest.raises(
        RunError, match=r"a copy with other cells than 01_first.ipynb.*tsmlib run first"
    ):
        notebooks.require(own.run, "01_first")
    assert (
        notebooks.require(own.run, "01_first", cells=notebooks.code_sha256(copy))["changed_copy"]
        is True
    )
    assert main(["run", "first"]) == 0
    assert notebooks.require(own.run, "01_first")["state"] == "complete"
    assert notebooks.outdated(own) == "its cells changed"


def test_without_the_tools_of_notebooks_a_run_names_what_to_install(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "papermill", None)
    assert main(["run", "first"]) == 1
    assert re.search(
        r"notebooks need papermill, .*pip install 'tsmlib\[study\]'", capsys.readouterr().err
    )
    assert untouched(place)


# Execution -----------------------------------------------------------------------------------------------------------


def test_a_notebook_runs_with_its_parameters_into_its_folder(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(
            [
                "run",
                "first",
                "--scale",
                "smoke",
                "--seed",
                "3",
                "-p",
                "rate=0.25",
                "-p",
                "fast=true",
            ]
        )
        == 0
    )
    executed = place / "runs {x} ü" / "smoke" / "seed3" / "01_first.ipynb"
    assert capsys.readouterr().out.strip() == str(executed)
    notebook = nbformat.read(executed, 4)
    assert notebook.cells[-1].outputs[0].data["text/plain"] == "('smoke', 3, 0.25, 'x', True)"
    entry = status(place, "smoke", 3)["01_first"]
    assert entry["state"] == "complete"
    assert entry["parameters"]["seed"] == 3
    assert not list(executed.parent.glob(".*.ipynb"))
    assert entry["provenance"]["torch"]
    assert (entry["scale"], entry["seed"]) == ("smoke", 3)


def test_what_a_notebook_prints_is_told_as_it_comes(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_notebook(
        place / "notebooks" / "01_first.ipynb",
        "print('no model;', 'training it now')\nprint('done')",
    )
    assert main(["run", "first"]) == 0
    told = capsys.readouterr()
    assert "no model; training it now\ndone\n" in told.err
    assert "training" not in told.out


UNFINISHED = {
    "raises": ("1 / 0", "ZeroDivisionError: division by zero"),
    "exits": ("import sys; sys.exit(0)", "stopped before its last cell"),
    "killed": ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "died"),
}


@pytest.mark.parametrize("how", UNFINISHED)
def test_a_notebook_that_does_not_reach_its_end_failed(place: Path, how: str) -> None:
    source, message = UNFINISHED[how]
    write_notebook(place / "notebooks" / "01_first.ipynb", source, "print('after')")
    with pytest.raises(
        RunError, match=rf"01_first failed: [\s\S]*{message}[\s\S]*See .*01_first.ipynb"
    ):
        notebooks.execute(notebooks.prepare(runs.notebooks()["first"]), progress=False)
    assert status(place)["01_first"]["state"] == "failed"
    assert message in status(place)["01_first"]["error"]


def test_running_all_stops_at_the_first_failure(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_notebook(place / "notebooks" / "01_first.ipynb", "1 / 0")
    assert main(["run", "all"]) == 1
    assert "ZeroDivisionError" in capsys.readouterr().err
    assert set(status(place)) == {"01_first"}


def start(place: Path) -> subprocess.Popen[bytes]:
    """A process that runs a notebook which never ends, once its kernel is in that cell."""
    write_notebook(
        place / "notebooks" / "01_first.ipynb",
        f"open({str(place / 'inside')!r}, 'w').write(str(__import__('os').getpid()))\nimport time; time.sleep(3600)",
    )
    code = (
        # SIGINT would be ignored where the tests themselves run in the background.
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler);"
        "import sys; from pathlib import Path;"
        "from reproduction import runs; from tsmlib.__main__ import main;"
        f"runs.NOTEBOOKS = Path({str(place / 'notebooks')!r}); sys.exit(main(['run', 'first']))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], cwd=runs.ROOT, stderr=subprocess.DEVNULL
    )
    wait_for(lambda: (place / "inside").exists() and bool((place / "inside").read_text()))
    return process


def wait_for(condition: Callable[[], bool], seconds: float = 600) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stopped_run_is_interrupted_and_its_kernel_goes(
    place: Path, number: signal.Signals
) -> None:
    process = start(place)
    process.send_signal(number)
    assert process.wait(600) == 130
    assert status(place)["01_first"]["state"] == "interrupted"
    wait_for(lambda: gone(int((place / "inside").read_text())))


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_a_notebook_of_a_run_has_one_writer_until_that_writer_is_gone(place: Path) -> None:
    process = start(place)
    again, second = (notebooks.prepare(runs.notebooks()[name]) for name in ("first", "second"))
    try:
        with pytest.raises(
            RunError,
            match=rf"written by another process \(pid {process.pid} on .*, 01_first, since",
        ):
            notebooks.execute(again, progress=False)
        notebooks.execute(second, progress=False)  # another notebook of the run does not wait
        assert status(place)["02_second"]["state"] == "complete"
        with pytest.raises(
            RunError, match="01_first in .* is running, expected complete. Wait for it"
        ):
            notebooks.require(second.run, "01_first")
    finally:
        process.kill()
        process.wait()
    assert status(place)["01_first"]["state"] == "running"
    with pytest.raises(RunError, match="01_first in .* is interrupted: its process is gone"):
        notebooks.require(second.run, "01_first")
    write_notebook(place / "notebooks" / "01_first.ipynb", "1 + 1")
    notebooks.execute(again, progress=False)
    assert status(place)["01_first"]["state"] == "complete"
    with contextlib.suppress(
        ProcessLookupError
    ):  # a kernel also ends by itself once its parent is gone
        os.kill(int((place / "inside").read_text()), signal.SIGKILL)


def test_a_process_of_another_machine_is_not_looked_for_here(place: Path) -> None:
    run, there = resolve("01_first"), {"state": "running", "pid": 2**22 + 1, "host": "another"}
    manifest.write_json(run.dir / "01_first.status.json", manifest.sealed(there))
    with pytest.raises(RunError, match="01_first in .* is running, expected complete"):
        notebooks.require(run, "01_first")


WRITES = """from reproduction.runs import resolve
run = resolve('{stem}', scale=scale, seed=seed, run_dir=run_dir)
for name, text in {files!r}.items():
    _ = (run.metrics / name).write_text(text)
{more}"""


def test_a_notebook_answers_for_the_files_that_it_wrote_last(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(runs.ROOT))
    for stem, files in {
        "01_first": {"a": "1", "b": "1"},
        "02_second": {"b": "2", "c": "2"},
    }.items():
        write_notebook(
            place / "notebooks" / f"{stem}.ipynb", WRITES.format(stem=stem, files=files, more="")
        )
        execution = notebooks.prepare(runs.notebooks()[stem[3:]])
        notebooks.execute(execution, progress=False)
        assert set(notebooks.require(execution.run, stem)["files"]) == {
            f"metrics/{name}" for name in files
        }
    run = execution.run
    notebooks.require(run, "01_first")  # b is the second's now
    assert len([path for path in manifest.verify(run.dir) if path.parent == run.metrics]) == 3
    (run.metrics / "b").write_text("1")
    notebooks.require(run, "01_first")
    with pytest.raises(RunError, match="b is not what 02_second made"):
        notebooks.require(run, "02_second")
    with pytest.raises(StoreError, match="b is damaged, or was changed"):
        manifest.verify(run.dir)
    (run.metrics / "a").write_text("2")
    with pytest.raises(RunError, match="a is not what 01_first made"):
        notebooks.require(run, "01_first")


def test_notebooks_that_run_at_the_same_time_answer_for_their_own_files(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(runs.ROOT))
    until = (
        f"import os, time\nwhile not os.path.exists({str(place / 'go')!r}):\n    time.sleep(0.05)"
    )
    for stem, more in {
        "01_first": until,
        "02_second": f"open({str(place / 'go')!r}, 'w').close()",
    }.items():
        source = WRITES.format(stem=stem, files={f"{stem}.csv": "x"}, more=more)
        write_notebook(place / "notebooks" / f"{stem}.ipynb", source)
    with multiprocessing.get_context("fork").Pool(2) as pool:
        pool.map(
            partial(notebooks.execute, progress=False),
            map(notebooks.prepare, runs.notebooks().values()),
        )
    for stem, entry in status(place).items():
        assert set(entry["files"]) == {f"metrics/{stem}.csv"}


def test_the_status_of_an_older_run_is_read(place: Path) -> None:
    run = resolve("03_third")
    (run.metrics / "a").write_text("1")
    old = {"files": manifest.listing(run.dir, [run.metrics / "a"]), "state": "complete", "pid": 1}
    manifest.write_json(run.dir / "status.json", {"03_third": manifest.sealed(old)})
    assert notebooks.require(run, "03_third")["pid"] == 1
    notebooks.execute(notebooks.prepare(runs.notebooks()["first"]), progress=False)
    assert manifest.verify(run.metrics / "a") == [run.metrics / "a"]
    (run.metrics / "a").write_text("2")
    with pytest.raises(RunError, match="a is not what 03_third made"):
        notebooks.require(run, "03_third")
    with pytest.raises(StoreError, match="a is damaged"):
        manifest.verify(run.dir)


# papermill by itself -------------------------------------------------------------------------------------------------


def in_terminal(command: list[str], cwd: Path, environment: dict[str, str]) -> tuple[int, str]:
    """Exit status and screen of a command typed in a terminal."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(cwd)
        os.execve(command[0], command, environment)
    screen = b""
    while True:
        try:
            block = os.read(terminal, 4096)
        except OSError:  # the terminal closes with its last process
            break
        if not block:
            break
        screen += block
    os.close(terminal)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), screen.decode(errors="replace")


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A small copy of the repository whose package and entry point come before the installed ones."""
    shutil.copytree(
        runs.ROOT / "tsmlib", tmp_path / "tsmlib", ignore=shutil.ignore_patterns("__pycache__")
    )
    write_notebook(tmp_path / "notebooks" / "01_tiny.ipynb", "1 + 1")
    info = tmp_path / "tsmlib-9.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: tsmlib\nVersion: 9\n")
    (info / "entry_points.txt").write_text(
        "[papermill.io]\ntsmlib-default-output = reproduction.papermill_plugin:handler\n"
    )
    return tmp_path


PAPERMILL = str(Path(sys.executable).with_name("papermill"))


def test_papermill_with_a_notebook_alone_works_in_a_terminal(clone: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(clone)}
    code, screen = in_terminal([PAPERMILL, "notebooks/01_tiny.ipynb"], clone, environment)
    assert code == 0, screen
    executed = clone / "runs" / "laptop" / "seed0" / "01_tiny.ipynb"
    assert nbformat.read(executed, 4).cells[-1].outputs[0].data["text/plain"] == "2"


def test_papermill_writes_to_a_pipe_as_ever(clone: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(clone)}
    done = subprocess.run(
        [PAPERMILL, "notebooks/01_tiny.ipynb"],
        cwd=clone,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        check=True,
    )
    assert nbformat.reads(done.stdout.decode(), 4).cells[-1].outputs[0].data["text/plain"] == "2"
    assert not (clone / "runs").exists()


def test_other_papermill_commands_are_left_alone(place: Path) -> None:
    elsewhere = write_notebook(place / "elsewhere" / "01_first.ipynb")
    here = str(place / "notebooks" / "01_first.ipynb")
    for argv in (
        ["papermill"],
        ["papermill", "--help"],
        ["papermill", here, "out.ipynb"],
        ["papermill", here, "out.ipynb", "-p", "seed", "3", "--no-progress-bar"],
        ["papermill", here, "-p", "seed"],
        ["papermill", here, "-y", "seed: 3"],
        ["papermill", str(elsewhere)],
        ["papermill", str(elsewhere), "-p", "sed", "3"],
        ["papermill", str(place / "notebooks" / "09_missing.ipynb")],
        ["pytest", here],
    ):
        before = list(argv)
        papermill_plugin.check(argv, terminal=True)
        assert argv == before
    papermill_plugin.check(argv := ["/bin/papermill", here], terminal=False)
    assert argv == ["/bin/papermill", here]
    assert untouched(place)


def test_papermill_puts_a_notebook_where_run_would(place: Path) -> None:
    here = str(place / "notebooks" / "01_first.ipynb")
    papermill_plugin.check(argv := ["/bin/papermill", here], terminal=True)
    assert argv[2].endswith("laptop/seed0/01_first.ipynb")
    assert "{{x}}" in argv[2]
    papermill_plugin.check(
        argv := ["papermill", here, "-p", "scale", "smoke", "-p", "seed", "3"], terminal=True
    )
    assert argv[-1].endswith("smoke/seed3/01_first.ipynb")
    copy = write_notebook(place / "mine" / "01_first.ipynb", "import tsmlib")
    papermill_plugin.check(argv := ["papermill", str(copy)], terminal=True)
    assert argv[-1].endswith("laptop/seed0/01_first.ipynb")


@pytest.mark.parametrize(
    "words",
    [
        ["-p", "scal", "smoke"],
        ["out.ipynb", "-p", "seed", "3", "--parameters", "scal", "smoke"],
        ["out.ipynb", "-r", "scal", "smoke"],
        ["out.ipynb", "--parameters_yaml", "{seed: 3, scal: smoke}"],
        ["out.ipynb", "-b", "c2NhbDogc21va2U="],
    ],
    ids=str,
)
@pytest.mark.parametrize("terminal", [True, False])
def test_papermill_refuses_a_parameter_that_the_notebook_does_not_have(
    place: Path, words: list[str], terminal: bool
) -> None:
    argv = ["papermill", str(place / "notebooks" / "01_first.ipynb"), *words]
    with pytest.raises(
        ParameterError, match="01_first has no parameter 'scal'; the closest is scale, and it has"
    ):
        papermill_plugin.check(argv, terminal=terminal)
    assert untouched(place)


def test_papermill_itself_refuses_before_it_runs_anything(clone: Path) -> None:
    done = subprocess.run(
        [PAPERMILL, "notebooks/01_tiny.ipynb", "out.ipynb", "-p", "scal", "smoke"],
        cwd=clone,
        env={**os.environ, "PYTHONPATH": str(clone)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.strip().startswith(
        "error: 01_tiny has no parameter 'scal'; the closest is scale,"
    )
    assert not (clone / "out.ipynb").exists()


@pytest.mark.parametrize("given", [{"sed": 3}, {"seed": 3}], ids=str)
def test_papermill_in_python_is_refused_the_same_by_the_notebook(
    place: Path, given: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    import papermill

    monkeypatch.setenv("PYTHONPATH", str(runs.ROOT))
    own = "from reproduction.runs import resolve\nresolve('01_x', scale=scale, seed=seed)"
    path = write_notebook(place / "01_x.ipynb", own)
    if "sed" in given:
        with pytest.raises(
            papermill.PapermillExecutionError,
            match="01_x has no parameter 'sed'; the closest is seed",
        ):
            papermill.execute_notebook(
                path, place / "out.ipynb", parameters=given, progress_bar=False
            )
        assert not list(place.glob("runs*"))
    else:
        papermill.execute_notebook(path, place / "out.ipynb", parameters=given, progress_bar=False)
        assert "seed=3" in (place / "out.ipynb").read_text()


def test_cells_that_only_begin_like_papermills_are_left_alone() -> None:
    ours, injected = 'scale = ""\nseed = 0', "# Parameters\nfoo = 1\n"
    others = (
        [],
        ["", injected],
        ["", "data = 3", injected],
        ["", ours, "# Parameters\nseed = 3"],
        ["", ours, "1 +"],
    )
    for cells in others:
        parameters.require_declared(cells, "01_x")
    with pytest.raises(ParameterError, match="01_x has no parameter 'foo'; it has scale, seed."):
        parameters.require_declared(["", ours, injected, "1 +"], "01_x")
    parameters.require_declared(
        ["", ours, injected, "# Parameters\nseed = 3"], "01_x"
    )  # mended, in the same kernel


def test_the_installed_package_registers_the_entry_point() -> None:
    names = [entry.name for entry in importlib.metadata.entry_points(group="papermill.io")]
    assert "tsmlib-default-output" in names, "install the package first: pip install --no-deps -e ."


def test_a_port_that_is_taken_or_none_is_named_with_what_to_type(tmp_path: Path) -> None:
    for name in ("index.html", "manifest.json"):
        (tmp_path / name).write_text("{}")
    with explorer.server(tmp_path, port=0) as running:
        for port, why in (
            (running.server_port, ".+"),
            (99999, "ports are 0 to 65535"),
            (-1, "ports are 0 to 65535"),
        ):
            with pytest.raises(
                RunError, match=rf"port {port} of 127.0.0.1 cannot be used \({why}\).*--port 0"
            ):
                explorer.server(tmp_path, port=port)
