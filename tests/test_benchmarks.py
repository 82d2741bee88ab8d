"""Benchmarks run, compare equal work, and leave their tables. How fast anything is, no test asserts."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import _rounds
import _table
import numpy as np
import pandas as pd
import pytest
import torch
from scripts import load_script, refused, run_script
from torch.utils.flop_counter import FlopCounterMode

from tsmlib.__main__ import _benchmarks, main
from tsmlib.models.layers import CausalDecoder, Encoder
from tsmlib.storage import tables
from reproduction import runs

REACH, PUSH = "tsm/Reacher-v0", "tsm/ReacherPush-v1"

TINY = {
    "collect": ["--episodes", "6", "--loop-episodes", "2"],
    "robots": ["--episodes", "3", "--loop-episodes", "2"],
    "train": [
        "--models",
        "tsm,rtsm,onestep",
        "--updates",
        "1",
        "--batch",
        "4",
        "--batches",
        "4",
        "--episodes",
        "3",
    ],
    "avx2": ["--models", "onestep,prior", "--updates", "1", "--batch", "4", "--episodes", "3"],
    "rollout": ["--models", "tsm,onestep", "--rows", "2,4", "--horizon", "3", "--episodes", "2"],
    "plan": [
        *("--targets", "2", "--iterations", "1", "--few", "1", "--samples", "1"),
        *("--candidates", "2", "--horizon", "10"),
    ],
    "policy": ["--copies", "2", "--iterations", "1", "--horizon", "10"],
    "score": [
        "--models",
        "tsm,onestep",
        "--episodes",
        "2",
        "--samples",
        "4",
        "--many",
        "5",
        "--horizon",
        "3",
    ],
    "copies": [
        "--models",
        "multistep",
        "--copies",
        "2",
        "--plans",
        "onestep",
        "--candidates",
        "2",
        "--policies",
        "onestep",
    ],
    "growth": ["--only", "channels", "--largest", "32"],
    "trust": ["--steps", "2", "--loads", "2"],
    "seed": ["--models", "onestep", "--envs", "tsm/Reacher-v0", "--little", "1"],
}
SPEEDS, SECONDS = {"steps_per_second"}, {"seconds"}
ROWS = {  # configuration -> metrics
    "collect": {"env.step": {"steps_per_second", "steps_per_core_second"}, "mj_step": SPEEDS},
    "robots": {"VectorEnv.step": {"steps_per_second", "steps_per_core_second"}, "env.step": SPEEDS},
    "train": {
        "teacher_forced_loss": {"targets_per_second"},
        "point_loss": {"targets_per_second"},
        "loss": {"targets_per_second"},
        "batch": {"windows_per_second"},
        "beside": {"updates_per_second"},
    },
    "avx2": {"loss": {"updates_per_second"}},
    "rollout": {"float32": SPEEDS, "bfloat16": SPEEDS},
    "plan": {"plain": {"iterations_per_second"}, "simulate": {"plan_seconds"}},
    "policy": {"one": SECONDS, "copies": SECONDS},
    "score": {"4 samples": SECONDS, "5 samples": SECONDS},
    "copies": {"multi_step_loss": SECONDS, "plan": SECONDS, "policy": SECONDS},
    "growth": {"channels": {"exponent"}},
    "trust": {"checkpoints": SECONDS, "load": SECONDS},
    "seed": dict.fromkeys(("train", "score", "plan", "policy", "a whole seed"), SECONDS),
}
LIMITED = {"collect", "robots", "train", "rollout", "plan", "policy", "score"}


def run(name: str, *options: str) -> str:
    script = runs.ROOT / "benchmarks" / f"{name}.py"
    if name != "avx2":
        return run_script(script, *options)
    # which starts itself again, as often as there are instruction sets to hold it to
    return subprocess.run(
        [sys.executable, script, *options], capture_output=True, text=True, check=True
    ).stdout


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


def test_the_peak_is_that_of_the_call() -> None:
    program = """import _rounds, torch
little, much = _rounds.peak_bytes(lambda: None), _rounds.peak_bytes(lambda: torch.ones(2**26))
print(much - little)
"""  # in a process of its own: what other tests freed, this one has kept
    folder = runs.ROOT / "benchmarks"
    found = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=folder
    )
    assert int(found.stdout) > 2**27


@pytest.mark.parametrize("name", TINY)
def test_a_benchmark_states_ratios_with_their_spread(
    name: str, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TSM_RUN_DIR", str(place))
    # collect ends with an error where two ways reach states that differ in any bit
    assert "2 rounds" in run(name, *TINY[name], "--rounds", "2")
    values: dict[str, set[str]] = {}
    rows = _rounds.load(place / "bench" / f"{name}.csv")
    for row, columns in rows:
        values.setdefault(columns["configuration"], set()).add(columns["metric"])
        assert row.ratio == tuple(sorted(row.ratio)), row.what
        assert row.n == 2
        assert row.peak_bytes is None or row.peak_bytes > 2**26
        assert columns["processor"]
        assert "/" not in columns["processor"]
    assert values == ROWS[name]
    assert any(row.share is not None and row.limit for row, _ in rows) == (name in LIMITED)
    assert len({row.what + row.reference for row, _ in rows}) == len(rows)


def test_the_table_is_written_from_what_was_measured(
    place: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("TSM_RUN_DIR", str(place))
    if len(found := _table.measured()) < len(TINY):
        pytest.skip("needs the tables of the tests above")
    page, picture = tmp_path / "speed.md", tmp_path / "growth"
    page.write_bytes(_table.DOCS.read_bytes())
    monkeypatch.setattr(_table, "DOCS", page)
    monkeypatch.setattr(_table, "PICTURE", picture)
    monkeypatch.setattr(runs, "ROOT", tmp_path)
    _table.publish(found)
    text = page.read_text()
    assert all(row.what in text for rows in found.values() for row, _ in rows)
    assert all(target.says in text for target in _table.TARGETS)
    asked = text.partition(_table.MARKS[0])[2].partition("| bench |")[0]
    assert asked.count("not measured") == 1, (
        "a target names rows that there are not; growth has few sizes here"
    )
    assert picture.with_suffix(".png").exists()
    _table.publish(found)
    assert page.read_text() == text


def test_of_several_rows_the_worst_is_held_against_a_target() -> None:
    def row(ratio: float) -> _rounds.Row:
        return _rounds.Row("ten", "one", 1.0, "s", (ratio, ratio, ratio), 1)

    found = {"policy": [(row(ratio), {"configuration": "copies"}) for ratio in (2.0, 3.0)]}
    (line,) = (line for line in _table.targets(found) if line[0].startswith("ten policies"))
    assert line[2].startswith("3 ")
    assert line[3] == "**not reached**"


def test_ways_run_in_turn_after_one_call_that_does_not_count() -> None:
    called: list[str] = []
    seconds = _rounds.interleaved(
        {"a": lambda: called.append("a"), "b": lambda: called.append("b")}, 3
    )
    assert called == ["a", "b", "a", "b", "b", "a", "a", "b"]
    assert {way: taken.shape for way, taken in seconds.items()} == {"a": (3,), "b": (3,)}


def test_a_ratio_of_speeds_and_a_share_say_how_much_was_reached() -> None:
    row = _rounds.Row.of(
        "w", np.array([2.0, 4.0]), "r", np.array([1.0, 1.0]), limit="l", bound=np.array([4.0, 8.0])
    )
    assert row.ratio == (2.0, 3.0, 4.0)
    assert row.share == 0.5
    slow = _rounds.Row.of(
        "w", np.array([2.0]), "r", np.array([1.0]), "s", limit="l", bound=np.array([0.5])
    )
    assert slow.share == 0.25


def test_products_are_those_that_torch_counts() -> None:
    decoder, encoder = CausalDecoder(8, 6, 4, channels=16), Encoder(6, 10, 4)

    def call() -> None:
        value = (
            decoder(torch.randn(5, 12, 8), torch.randn(5, 4)).sum()
            + encoder(torch.randn(5, 10, 6))[0].sum()
        )
        value.backward()

    counter = FlopCounterMode(display=False)
    with counter:
        call()
    products = _rounds.Products.of(call)
    assert products.flops == pytest.approx(counter.get_total_flops(), rel=1e-6)
    products.alone()()


def test_every_benchmark_has_a_test_and_a_place_in_the_table() -> None:
    assert set(_benchmarks()) - {"parallel"} == set(
        TINY
    )  # whose processes take long to start; see test_parallel
    assert set(_benchmarks()) <= set(_table.ORDER)


def test_a_benchmark_that_does_not_exist_is_refused_by_name(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["bench", "speed"]) == 2
    assert "score, seed, train, trust, all of them, or table" in capsys.readouterr().err


def test_the_page_of_speed_has_a_place_for_its_table() -> None:
    text = (runs.ROOT / "docs" / "speed.md").read_text()
    assert text.count(_table.MARKS[0]) == text.count(_table.MARKS[1]) == 1
    assert tables.COLUMNS[-1] == "scale"  # what benchmarks add comes after


def test_lines_of_seeds_replace_those_of_the_same_processor_alone() -> None:
    seeds = load_script(runs.ROOT / "benchmarks" / "settings" / "seeds.py", "settings_seeds")
    stored = pd.DataFrame(
        {
            "env": "arm",
            "model": ["a", "b"],
            "seed": "1",
            "processor": "gpu",
            "validation": ["1", "2"],
        }
    )
    new = pd.DataFrame(
        {
            "env": "arm",
            "model": "a",
            "seed": "1",
            "processor": ["cpu", "gpu"],
            "validation": list("34"),
        }
    )
    assert seeds.merged(stored, new)[["model", "processor", "validation"]].to_numpy().tolist() == [
        ["a", "gpu", "4"],
        ["b", "gpu", "2"],
        ["a", "cpu", "3"],
    ]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--seeds", "1000002", "3"], "seed 1000002 draws held-out episodes or targets"),
        (["--seeds", "3", "3"], "--seeds names 3 more than once; name each seed once"),
        (["--seeds", "3", "--envs", "foo"], "'foo' is none of tsm/Reacher-v0"),
        (
            ["--seeds", "3", "--scale", "foo"],
            "scale is 'foo', expected one of smoke, laptop, paper",
        ),
        (["--seeds", "3", "--together", "0"], "--together 0: expected at least 1"),
        (["--seeds", "3", "--policies", "-1"], "--policies -1: expected at least 1 iteration"),
        (
            ["--seeds", "3", "--table"],
            "lines of scale paper alone, got laptop; type --table --scale paper",
        ),
        (["--seeds", "3", "--table", "--scale", "smoke"], "lines of scale paper alone, got smoke"),
    ],
)
def test_models_of_several_seeds_that_cannot_be_are_refused_before_any_work(
    options: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path))
    assert said in refused(runs.ROOT / "benchmarks" / "settings" / "seeds.py", *options)
    assert not list(tmp_path.iterdir())


def test_an_older_table_of_scores_that_is_not_there_is_refused_with_where_it_comes_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        run_script(
            runs.ROOT / "benchmarks" / "settings" / "twice.py", "write", str(tmp_path / "none.csv")
        )
    said = capsys.readouterr().err
    assert "none.csv does not exist" in said
    assert "--help says how an older table of scores is had from git" in said


def test_a_table_of_two_trainings_pairs_scores_of_the_older_and_of_those_that_ship(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    twice = load_script(runs.ROOT / "benchmarks" / "settings" / "twice.py", "settings_twice")
    push = {
        "env": PUSH,
        "model": "rtsm",
        "seed": 6,
        "execution": "open loop",
        "subset": "",
        "metric": "nrmse",
    }
    lines = [
        (push, 0.25),
        (push | {"env": REACH, "seed": 5}, 0.75),
        (push | {"env": REACH, "noise": 0.25}, 1.0),
    ]
    for name, more in (("older", 0.25), ("03_predict", 0.0)):
        tables.save(
            tmp_path / f"{name}.csv", [line | {"value": value + more} for line, value in lines]
        )
    monkeypatch.setattr(twice, "FILE", tmp_path / "twice.csv")
    monkeypatch.setattr(twice, "RESULTS", tmp_path)

    def written(older: str) -> str:
        monkeypatch.setattr("sys.argv", ["twice.py", "write", str(tmp_path / older)])
        twice.main()
        return (tmp_path / "twice.csv").read_text()

    assert written("older.csv").splitlines() == [
        "env,model,metric,seed,gpu,cpu",
        f"{REACH},rtsm,nrmse,5,1,0.75",
        f"{PUSH},rtsm,nrmse,6,0.5,0.25",
    ]
    with pytest.raises(SystemExit):
        written("03_predict.csv")
    assert "no other scores of these arms there than those that ship" in capsys.readouterr().err


def test_trainings_of_one_seed_that_are_compared_have_no_interval() -> None:
    twice = load_script(runs.ROOT / "benchmarks" / "settings" / "twice.py", "settings_twice")
    one = pd.DataFrame(
        {"env": PUSH, "model": "m", "metric": "nrmse", "seed": [6], "gpu": [0.5], "cpu": [0.25]}
    )
    assert twice.compared(one)["CPU minus GPU"].tolist() == ["-0.250"]
    assert (
        " ± "
        in twice.compared(pd.concat([one, one.assign(seed=7, cpu=0.3)]))["CPU minus GPU"].item()
    )
