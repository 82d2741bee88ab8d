"""A model is one entry of the zoo, and the entries are those that the shipped models were trained by."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import tsmlib
from tsmlib import plots as figures, study
from tsmlib.envs.spec import EnvSpec
from tsmlib.plots.axes import YOURS
from tsmlib.plots.planning import MARKERS
from tsmlib.models.baselines import OneStep
from tsmlib.storage import artifacts
from tsmlib import zoo

SHIPPED = [
    p
    for p in sorted((runs.ROOT / "data/pretrained").glob("*/*.safetensors"))
    if not p.stem.startswith("policy") and p.parent.name != "PushT"
]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_shipped_model_was_trained_by_its_entry(path: Path) -> None:
    header, spec = artifacts.read_header(path), zoo.ZOO[path.stem]
    assert header["class"] == spec.load().__name__
    planned = spec.schedule(EnvSpec.parse(header["fingerprint"]["env"]))
    for key, stage in zip(zoo.keys(planned), planned, strict=True):
        steps = header["curves"][key]["step"][-1]
        assert steps == stage.steps or (stage.patience and steps < stage.steps)
    assert list(header["curves"]) == zoo.keys(planned)
    stated = [stage.stated() for stage in planned]
    assert zoo.stated(header.get("schedule", stated)) == stated  # the oldest do not say


def test_older_headers_mean_the_defaults_of_what_came_later() -> None:
    stages = [
        replace(stage, muon=0.0)
        for stage in zoo.find("tsm").schedule(EnvSpec.parse("tsm/Reacher-v0"))
    ]
    now = [stage.stated() for stage in stages]
    older = [
        {name: stage[name] for name in ("loss", "steps", "future_len", "lr", "batch")}
        for stage in now
    ]
    assert zoo.stated(older) == now
    for change in ({"muon": 0.02}, {"weight_decay": 0.1}, {"patience": 4}, {"span": (0.0, 0.6)}):
        changed = [replace(stages[0], **change), *stages[1:]]
        assert zoo.stated(older) != [stage.stated() for stage in changed]


def test_a_stage_says_all_that_training_takes_from_it() -> None:
    stage = zoo.Stage(
        "loss", 10, future_len=30, lr=1e-3, batch=64, muon=0.02, patience=3, span=(0.2, 0.7)
    ).within(60, False)
    options = stage.options(5, validate_every=7)
    assert (options.past_len, options.future_len, options.steps, options.batch_size) == (
        5,
        30,
        600,
        64,
    )
    assert (options.lr, options.muon, options.patience, options.span) == (1e-3, 0.02, 3, (0.2, 0.7))
    assert options.validate_every == 7


def test_every_model_has_a_look_of_its_own() -> None:
    looks = [spec.look for spec in zoo.ZOO.values()]
    assert len({look.name for look in looks}) == len({look.colour for look in looks}) == len(looks)
    words = [*zoo.words("dynamics", "ablation"), "pets", "pets+mse"]
    assert len({zoo.look(word).marker for word in words}) == len(words)


def test_a_diamond_is_the_reader_s_own_and_no_model_s() -> None:
    markers = {
        look.marker for look in (*(spec.look for spec in zoo.ZOO.values()), *zoo.LOOKS.values())
    }
    assert not {"D", "d"} & {*markers, *MARKERS.values()}
    assert YOURS["marker"] == "D"


def test_a_method_is_named_in_words() -> None:
    assert zoo.method("tsm", "latent", "cem").label == "TSM, latent, CEM"
    assert zoo.method("none", "", "zero") == zoo.method("zero")
    assert zoo.method("zero").label == "zero torque"
    with pytest.raises(ValueError, match=r"nothing is called 'lstn'; there are tsm, .*lstm"):
        zoo.method("lstn")
    with pytest.raises(ValueError, match="search space is 'codes'.*expected latent or direct"):
        zoo.method("tsm", "codes", "cem")


HEAVY = {"torch", "mujoco", "pymunk", "matplotlib", "pandas"}


def test_the_zoo_is_light() -> None:
    code = f"import sys, tsmlib.zoo; sys.exit(bool({HEAVY} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_model_is_added_in_one_entry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Trained, found again, scored, planned with, learned in and drawn, all by its word."""
    tiny = zoo.ModelSpec(
        "tiny",
        zoo.Look("a tiny network", "#123456", "<"),
        "tsmlib.models.baselines:OneStep",
        (zoo.Stage("loss", 36),),
        lambda env: {"hidden": 8, "layers": 1},
    )
    monkeypatch.setitem(zoo.ZOO, "tiny", tiny)
    run, env = (
        runs.resolve("03_predict", scale="smoke", seed=1, run_dir=str(tmp_path)),
        "tsm/Reacher-v0",
    )
    ((net, header),) = study.train_all(run, [(env, "tiny")]).values()
    assert isinstance(net, OneStep)
    assert net.config()["hidden"] == 8
    assert header["model"] == "tiny"
    ((open_loop, segments),) = study.score_all(run, [(env, "tiny")]).values()
    assert open_loop.values["energy_score"].isfinite().all()
    assert segments.values["energy_score"].isfinite().all()
    task, method = study.load_task(env).take(2), zoo.method("tiny", "direct", "cem")
    trial = study.trials(run, [task], [method])[env][method]
    assert trial.executed_return.isfinite().all()
    policy, _ = study.learn(
        run, task, zoo.method("tiny", "direct", "policy"), study.Budget(iterations=1)
    )
    assert policy.copies == 1
    assert "tiny" in zoo.words("dynamics")
    assert trial.plan is not None
    returns = {
        "true": trial.executed_return.numpy(),
        "predicted": trial.plan.predicted_return.numpy(),
    }
    figure = figures.figure6({task.name: {method: returns}})
    assert any(
        "a tiny network" in text.get_text()
        for ax in figure.axes
        for text in (*ax.get_yticklabels(), *ax.texts)
    )


def test_what_ships_is_loaded_by_word_and_environment() -> None:
    model, prior = (
        tsmlib.load_pretrained(word, env="tsm/ReacherPush-v1") for word in ("rtsm", "prior")
    )
    assert (type(model), type(prior)) == (tsmlib.RecurrentTSM, tsmlib.ActionPrior)
    assert tsmlib.load_task("tsm/ReacherPush-v1").target.shape == (100, 2)
    with pytest.raises(
        ValueError, match=r"no pretrained tsm\+full of tsm/ReacherPush-v1 in .*: there are .*lstm"
    ):
        tsmlib.load_pretrained("tsm+full", env="tsm/ReacherPush-v1")
    with pytest.raises(ValueError, match=r"no model is called 'tms'; there are tsm,"):
        tsmlib.load_pretrained("tms", env="tsm/ReacherPush-v1")
    with pytest.raises(ValueError, match=r"'Push' is none of tsm/Reacher-v0"):
        tsmlib.load_pretrained("tsm", env="Push")


def test_the_library_is_imported_when_it_is_used() -> None:
    code = f"import sys, tsmlib; sys.exit(bool({HEAVY} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert {getattr(tsmlib, name).__name__ for name in tsmlib.__all__} == set(tsmlib.__all__)


def test_policies_act_in_codes_only_of_models_that_have_some() -> None:
    found = [(way.model, way.search_space) for way in zoo.policies(zoo.words("dynamics"))]
    assert [model for model, space in found if space == "direct"] == list(zoo.words("dynamics"))
    assert {model for model, space in found if space == "latent"} == {"tsm", "rtsm"}
