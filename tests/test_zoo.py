"""A model is one entry of the zoo, by which the shipped models were trained."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

import tsmlib
from reproduction import schedules
from tsmlib import zoo
from tsmlib.envs.spec import EnvSpec
from tsmlib.pretrained import PRETRAINED
from tsmlib.storage import artifacts

HEAVY = {"torch", "mujoco", "pymunk", "matplotlib", "pandas"}
SHIPPED = [
    path
    for path in sorted(PRETRAINED.glob("*/*.safetensors"))
    if path.stem in zoo.ZOO and path.parent.name != "PushT"
]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_shipped_model_was_trained_by_its_entry(path: Path) -> None:
    header, spec = artifacts.read_header(path), zoo.ZOO[path.stem]
    assert header["class"] == spec.load().__name__
    planned = schedules.schedule(spec, EnvSpec.parse(header["fingerprint"]["env"]))
    if "curves" in header:
        steps = [curve["step"][-1] for curve in header["curves"].values()]
        assert steps == [stage.steps for stage in planned]
        assert list(header["curves"]) == schedules.keys(planned)
    assert "curves" in header or "schedule" in header
    for found, stage in zip(header.get("schedule", []), planned, strict="schedule" in header):
        assert (asdict(stage) | {"span": list(stage.span)}).items() <= (
            {"muon": 0.0, "span": [0.0, 1.0]} | found
        ).items()


def test_a_stage_says_all_that_training_takes_from_it() -> None:
    stage = zoo.Stage(zoo.Updates("loss", 1, 30, lr=1e-3, batch=64, span=(0.2, 0.7)), (10, 5), 0.5)
    assert schedules.within(stage, 60, False).steps == 300
    assert schedules.within(stage, 60, True).steps == 150
    options = schedules.options(schedules.within(stage, 60, False), 5)
    assert (options.past_len, options.future_len, options.batch_size) == (5, 30, 64)
    assert (options.lr, options.muon, options.span) == (1e-3, 0.01, (0.2, 0.7))
    assert schedules.keys(
        schedules.schedule(zoo.find("rtsm"), EnvSpec.parse("tsm/Reacher-v0"))
    ) == [
        "point_loss",
        "loss",
        "loss-2",
    ]


@pytest.mark.parametrize("word", zoo.ZOO)
def test_every_entry_makes_its_model_and_has_its_losses(word: str) -> None:
    spec, env = zoo.find(word), EnvSpec.parse("tsm/ReacherPush-v1")
    sizes = (2,) if spec.group == "prior" else (10, 2)
    model = spec.load()(*sizes, **spec.arguments(env))
    assert all(hasattr(model, stage.loss) for stage in schedules.schedule(spec, env))


def test_every_model_has_a_look_of_its_own_and_none_the_reader_s() -> None:
    looks = [spec.look for spec in zoo.ZOO.values()]
    assert len({look.name for look in looks}) == len({look.colour for look in looks}) == len(looks)
    words = [*zoo.words("dynamics", "ablation"), "pets", "pets+mse"]
    assert len({zoo.look(word).marker for word in words}) == len(words)
    assert not {"D", "d"} & {look.marker for look in [*looks, *zoo.LOOKS.values()]}
    with pytest.raises(ValueError, match=r"nothing is called 'lstn'; there are tsm, .*lstm"):
        zoo.look("lstn")


@pytest.mark.parametrize("module", ["tsmlib", "tsmlib.zoo"])
def test_it_is_light(module: str) -> None:
    code = f"import sys, {module}; sys.exit(bool({HEAVY} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_public_name_is_what_it_is_called() -> None:
    names = set(tsmlib.__all__) - {"plots", "rewards"}  # modules
    assert {getattr(tsmlib, name).__name__ for name in names} == names


def test_what_ships_is_loaded_by_word_and_environment_and_knows_its_robot() -> None:
    push = "tsm/ReacherPush-v1"
    model, prior = (tsmlib.load_pretrained(word, env=push) for word in ("rtsm", "prior"))
    assert (type(model), type(prior)) == (tsmlib.RecurrentTSM, tsmlib.ActionPrior)
    robot = tsmlib.collect_random(push, 1, horizon=1).robot
    model.robot.require_same(robot, "model and data")
    with pytest.raises(ValueError, match=r"no pretrained tsm\+plain of .* there are .*lstm"):
        tsmlib.load_pretrained("tsm+plain", env=push)
    with pytest.raises(ValueError, match=r"no model is called 'tms'; there are tsm,"):
        tsmlib.load_pretrained("tms", env=push)
    with pytest.raises(ValueError, match=r"'Push' is none of tsm/Reacher-v0"):
        tsmlib.load_pretrained("tsm", env="Push")
