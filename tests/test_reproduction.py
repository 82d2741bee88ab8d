"""Runs, targets, tables and notebooks: a thing is made once, whole, and named where missing."""

from __future__ import annotations

import gzip
import http.client
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import matplotlib.pyplot as plt
import nbformat
import pandas as pd
import pytest

import tsmlib
from reproduction import explorer, figures, pages, runner, runs, tables, targets
from reproduction.papermill_plugin import completed
from reproduction.plans import How
from reproduction.runs import Missing, Run, env_id
from tsmlib.__main__ import main
from tsmlib.envs.spec import ENV_IDS, EnvSpec
from tsmlib.pretrained import ROOT
from tsmlib.storage import artifacts

KERNEL = {"name": "python3", "display_name": "Python 3", "language": "python"}
PARAMETERS = 'scale = "laptop"\nseed = 0\nspeed = 1.5\nfast = False'


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder that runs are written to."""
    monkeypatch.setattr(runs, "home", lambda: tmp_path)
    return tmp_path


def notebook(path: Path, *cells: str) -> Path:
    """A notebook with a cell of parameters and these cells."""
    made = nbformat.v4.new_notebook(metadata={"kernelspec": KERNEL})
    first = nbformat.v4.new_code_cell(PARAMETERS, metadata={"tags": ["parameters"]})
    made.cells = [first, *map(nbformat.v4.new_code_cell, cells)]
    nbformat.write(made, path)
    return path


# Runs and names -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "given", [{"scale": "big"}, {"seed": -1}, {"seed": 1_000_004}, {"seed": 1.5}], ids=str
)
def test_a_run_that_cannot_be_is_refused(given: dict[str, object]) -> None:
    with pytest.raises((ValueError, TypeError), match=next(iter(given))):
        Run(**given)  # type: ignore[arg-type]


def test_an_arm_is_found_by_its_name() -> None:
    assert {env_id(EnvSpec.parse(env).name) for env in ENV_IDS} == set(ENV_IDS)
    assert env_id("Reacher-noise0.25") == "tsm/Reacher-noise0.25-v0"
    assert env_id("ReacherPush-mass2") == "tsm/ReacherPush-mass2-v1"
    with pytest.raises(ValueError, match="ReacherPush"):
        env_id("Pusher")


def test_a_plan_is_known_by_its_name() -> None:
    assert How.of("tsm-latent-cem-every10") == How("tsm", "latent", "cem", every=10)
    assert How.of("zero").fields["planner"] == "zero"
    with pytest.raises(ValueError, match="tsm-latent-cem"):
        How.of("tsm-latent")


# Targets --------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", runs.SCALES)
@pytest.mark.parametrize("table", targets.TABLES)
def test_every_target_has_a_kind_and_inputs_and_no_target_needs_itself(
    table: str, scale: str
) -> None:
    run, seen = Run(scale), set[str]()

    def walk(name: str, above: tuple[str, ...]) -> None:
        assert name not in above
        if name not in seen:
            seen.add(name)
            assert run.path(name).suffix in (".csv", ".safetensors")
            for needed in targets.inputs(run, name):
                walk(needed, (*above, name))

    walk(f"tables/{table}", ())
    assert len(seen) > 1


@pytest.mark.parametrize("name", ["tables/99", "model/Reacher/tsm", "data", "data/../x", ""])
def test_an_unknown_target_is_refused_and_those_that_there_are_named(name: str) -> None:
    with pytest.raises(ValueError, match="tables/03_predict"):
        targets.make(Run("smoke"), name)


def test_what_is_missing_names_the_command_that_makes_it(home: Path) -> None:
    command = r"python -m tsmlib make scores/Reacher/tsm --scale smoke --seed 3"
    with pytest.raises(Missing, match=command):
        Run("smoke", 3).require("scores/Reacher/tsm")
    with pytest.raises(ValueError, match="make models/PymunkPush/tsm --scale paper"):
        tsmlib.load_pretrained("tsm", env="tsm/PymunkPush-v1")


def test_data_are_made_once_and_are_a_function_of_the_seed(home: Path) -> None:
    run, other = Run("smoke"), Run("smoke", 1)
    path = targets.make(run, "data/Reacher/train")
    first = path.read_bytes()
    assert targets.make(run, "data/Reacher/train").read_bytes() == first
    assert targets.make(run, "data/Reacher/train", again=True).read_bytes() == first
    ours, theirs = (
        artifacts.load_trajectories(targets.make(each, "data/Reacher/train"))
        for each in (run, other)
    )
    assert not (ours.states == theirs.states).all()
    tests = [
        artifacts.load_trajectories(targets.make(each, "data/Reacher/test"))
        for each in (run, other)
    ]
    assert (tests[0].states == tests[1].states).all()  # the same for every seed


def test_a_table_is_made_with_all_that_it_needs(home: Path) -> None:
    """Data, a model, its scores, the table, and the tables of two seeds in one."""
    for seed in (0, 1):
        run = Run("smoke", seed)
        rows = [tables.read(targets.make(run, f"scores/Reacher/{word}")) for word in ("onestep",)]
        assert {"energy_score_noise", "nrmse", "diverged"} <= set(rows[0]["metric"])
        assert set(rows[0]["seed"]) == {seed}
        tables.write(run.path("tables/03_predict"), rows[0])
    pooled = tables.read(targets.pool("smoke", "03_predict", [0, 1]))
    assert set(pooled["seed"]) == {0, 1}
    with pytest.raises(Missing, match="--seed 2"):
        targets.pool("smoke", "03_predict", [0, 2])
    assert not list(home.rglob("*.tmp-*"))


EXAMPLES = (  # one target of each kind
    "data/Reacher/train",
    "models/Reacher/tsm",
    "models/Reacher/prior",
    "collection/Reacher",
    "gradients/Reacher/tsm",
    "scores/Reacher/tsm",
    "episodes/Reacher/tsm",
    "blind/Reacher/tsm",
    "codes/Reacher/tsm",
    "filters/Reacher-noise0.25/filter",
    "plans/Reacher/tsm-latent-cem",
    "plans/Reacher/tsm-latent-cem-every10",
    "plans/Reacher/tsm-direct-adam+rough",
    "trials/Reacher/tsm-latent-cem",
    "trials/Reacher/zero",
    "torques/Reacher/sampled",
    "signals/Reacher/tsm",
    "policies/Reacher/tsm-latent",
    "learning/Reacher/tsm-latent",
    "adapted/Reacher-gain0.7/tsm-zero-5",
    "robots/Pendulum-v1/rtsm",
    "rounds/Pendulum/rtsm-plans",
    "tables/01_collect",
)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder for the targets of all tests that make one."""
    folder = tmp_path_factory.mktemp("targets")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs, "home", lambda: folder)
        yield folder


def test_there_is_an_example_of_every_kind() -> None:
    assert {name.partition("/")[0] for name in EXAMPLES} == set(targets.KINDS)


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_target_of_every_kind_is_made_at_the_smallest_scale(name: str, shared: Path) -> None:
    path = targets.make(Run("smoke"), name)
    assert path.is_relative_to(shared)
    if path.suffix == ".csv":
        table = tables.read(path)
        assert len(table)
        assert set(table["seed"]) == {0}
        assert set(table["scale"]) == {"smoke"}
        assert not table.duplicated().any()


def test_a_training_that_is_killed_goes_on_to_the_bit(tmp_path: Path) -> None:
    """kill -9 in the middle of a training leaves no model; the next one ends with the same bits."""
    program = (
        "import sys, pathlib\n"
        "from reproduction import runs, targets\n"
        "runs.home = lambda: pathlib.Path(sys.argv[1])\n"
        "targets.make(runs.Run('smoke'), 'models/Reacher/tsm')\n"
    )
    made = []
    for name, kills in (("whole", 0), ("killed", 2)):
        folder = tmp_path / name
        command = [sys.executable, "-c", program, str(folder)]
        target = folder / "runs/smoke/seed0/models/Reacher/tsm.safetensors"
        for _ in range(kills):
            process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
            deadline = time.monotonic() + 60
            while time.monotonic() < deadline and not list(folder.rglob("*.checkpoint/*")):
                time.sleep(0.02)
            process.send_signal(signal.SIGKILL)
            process.wait()
            assert not target.exists()
        subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
        made.append(artifacts.load(target, kind="model")[0])
        assert not list(folder.rglob("*.checkpoint"))
    assert made[0].keys() == made[1].keys()
    assert all((made[0][name] == made[1][name]).all() for name in made[0])


# Tables ---------------------------------------------------------------------------------------

OTHERS = (
    "08_claims",
    "11_pusht",
    "codes",
    "tries",
    "policies_tried",
    "conformal",
)  # have columns of their own
PUBLISHED = sorted(p for p in tables.RESULTS.glob("*.csv*") if not p.name.startswith(OTHERS))


@pytest.mark.parametrize("path", PUBLISHED, ids=lambda path: path.name)
def test_a_published_table_is_read_and_written_back_to_the_byte(path: Path, tmp_path: Path) -> None:
    raw = path.read_bytes()
    raw = gzip.decompress(raw) if path.suffix == ".gz" else raw
    table = tables.published(path.name.partition(".")[0])
    assert tables.write(tmp_path / "t.csv", table).read_bytes() == raw


def test_a_table_of_another_schema_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "other.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(tables.TableError, match=r"other.csv is a table of another schema.*metric"):
        tables.read(path)
    with pytest.raises(tables.TableError, match="unknown columns colour"):
        tables.frame([{"metric": "x", "value": 1.0, "colour": "red"}])
    for value in (float("nan"), float("inf"), None):
        with pytest.raises(tables.TableError, match="row 1 has no finite value"):
            tables.frame([{"metric": "x", "value": 1.0}, {"metric": "y", "value": value}])


def test_rows_are_selected_by_value_by_list_and_by_what_is_empty() -> None:
    rows = [{"metric": "x", "value": float(i), "seed": i, "delay": i or None} for i in range(3)]
    table = tables.frame([*rows, {"metric": "y", "value": 5.0, "subset": "contact"}])
    assert list(tables.select(table, metric="x", seed=[0, 2])["value"]) == [0.0, 2.0]
    assert list(tables.select(table, delay=None, subset=None)["value"]) == [0.0]
    assert list(tables.select(table, seed=2)["value"]) == [2.0]
    assert len(tables.select(table, target=3)) == 0  # no such column


def test_markdown_leaves_out_what_is_missing() -> None:
    shown = tables.markdown(pd.DataFrame({"a": [1.23456, float("nan")], "b": ["x", "y"]}))
    assert "1.23" in shown
    assert "nan" not in shown


def test_marked_places_are_filled_and_the_rest_is_left_alone(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Mine\n\n<!-- table: plans -->\nold\n<!-- end -->\n\nProse.\n")
    once = pages.fill(page).read_text()
    assert once.startswith("# Mine\n")
    assert once.endswith("<!-- end -->\n\nProse.\n")
    assert "| pushing, within 5 cm" in once
    assert "old" not in once
    assert pages.fill(page).read_text() == once
    page.write_text("<!-- table: colours -->\n<!-- end -->")
    with pytest.raises(ValueError, match="'colours'; there are predictions, plans"):
        pages.fill(page)


def test_the_tables_of_the_results_page_are_those_of_the_rows(tmp_path: Path) -> None:
    page = ROOT / "docs" / "results.md"
    copy = tmp_path / "results.md"
    copy.write_text(page.read_text())
    assert pages.fill(copy).read_text() == page.read_text(), "type: python -m tsmlib pages"


@pytest.mark.parametrize("name", figures.FIGURES)
def test_a_figure_is_drawn_of_the_published_rows(name: str) -> None:
    figure = figures.FIGURES[name]()
    assert all(ax.has_data() for ax in figure.axes)
    plt.close(figure)


# Notebooks ------------------------------------------------------------------------------------


def test_a_notebook_is_executed_with_its_parameters_into_the_folder_of_its_run(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = notebook(home / "own.ipynb", "open('made.txt', 'w').write(f'{scale} {seed} {speed}')")
    words = ["run", str(path), "--scale", "smoke", "--seed", "7", "-p", "speed=2.5"]
    assert main(words) == 0
    folder = home / "runs" / "smoke" / "seed7"
    assert (folder / "made.txt").read_text() == "smoke 7 2.5"
    assert capsys.readouterr().out.split()[-1] == str(folder / "own.ipynb")


def test_a_notebook_is_executed_again_where_it_failed_or_has_changed(home: Path) -> None:
    path = home / "own.ipynb"
    counted = "open('count.txt', 'a').write('x')"
    for cell in (counted + "; 1 / 0", counted, counted, counted + "  # changed"):
        main(["run", str(notebook(path, cell)), "--missing"])
    assert (home / "runs/laptop/seed0/count.txt").read_text() == "xxx"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-p", "sped=2"], "has no parameter 'sped'; the closest is speed; it has scale, seed"),
        (["-p", "speed=fast"], "expected float"),
        (["-p", "fast=maybe"], "expected bool"),
        (["-p", "speed"], "expected NAME=VALUE"),
        (["-p", "seed=1"], "--seed"),
        (["--scale", "huge"], "'smoke', 'laptop', 'paper'"),
    ],
)
def test_a_parameter_that_cannot_be_is_refused_before_any_file_exists(
    words: list[str], said: str, home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = notebook(home / "own.ipynb")
    assert main(["run", str(path), *words]) == 2
    assert said in capsys.readouterr().err
    assert not (home / "runs").exists()


def test_a_notebook_that_fails_says_the_cell_and_leaves_what_was_done(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = notebook(home / "own.ipynb", "print('before')", "1 / 0", "print('after')")
    assert main(["run", str(path), "--scale", "smoke"]) == 1
    error = capsys.readouterr().err
    assert "ZeroDivisionError" in error
    executed = (home / "runs/smoke/seed0/own.ipynb").read_text()
    assert "before" in executed
    assert main(["run", "nothing"]) == 1
    assert "there are quickstart, collect" in capsys.readouterr().err


def test_papermill_alone_gets_an_output_path_and_nothing_else_is_touched(tmp_path: Path) -> None:
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "reproduction").mkdir()
    path = str(notebook(tmp_path / "notebooks" / "05_own.ipynb"))
    out = str(tmp_path / "runs" / "smoke" / "seed3" / "05_own.ipynb")
    typed = ["papermill", path, "-p", "scale", "smoke", "-p", "seed", "3"]
    assert completed(typed) == [*typed, out]
    assert completed(["papermill", path])[-1].endswith("laptop/seed0/05_own.ipynb")
    elsewhere = str(notebook(tmp_path / "05_own.ipynb"))
    for other in ([path, "out.ipynb"], [elsewhere], ["--help"], [path, "--log-output"], []):
        assert completed(["papermill", *other]) == ["papermill", *other]
    with pytest.raises(SystemExit, match="no parameter 'scala'"):
        completed(["papermill", path, "-p", "scala", "smoke"])


def test_the_commands_are_listed_and_the_notebooks_copied_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([]) == 2
    assert main(["--version"]) == 0
    assert tsmlib.__version__ in capsys.readouterr().out
    assert main(["notebooks", str(tmp_path)]) == 0
    copies = {path.name for path in tmp_path.iterdir()}
    assert copies == {path.name for path in runner.NOTEBOOKS.glob("*.ipynb")}
    (tmp_path / sorted(copies)[0]).write_text("changed")
    assert main(["notebooks", str(tmp_path)]) == 1
    assert "name another folder" in capsys.readouterr().err


def test_loading_a_model_imports_no_pandas_and_no_notebook() -> None:
    code = (
        "import sys, tsmlib\n"
        "tsmlib.load_pretrained('rtsm', env='tsm/Reacher-v0')\n"
        "heavy = {'pandas', 'papermill', 'IPython', 'matplotlib', 'reproduction'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_the_explorer_answers_this_machine_with_files_of_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "dist"
    folder.mkdir()
    for name in ("index.html", "manifest.json"):
        (folder / name).write_text("page")
    (tmp_path / "secret").write_text("secret")
    (folder / "link").symlink_to(tmp_path / "secret")
    with explorer.server(folder.resolve(), port=0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()

        def status(path: str, host: str = "127.0.0.1") -> int:
            connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
            connection.request("GET", path, headers={"Host": f"{host}:{server.server_port}"})
            return connection.getresponse().status

        assert status("/index.html") == status("/index.html", "localhost") == 200
        assert status("/index.html", "evil.example") == 403
        assert {status(path) for path in ("/link", "/%00", "/../secret", "/none")} == {404}
        server.shutdown()
    with pytest.raises(runner.RunError, match="make explorer"):
        explorer.server(tmp_path)
