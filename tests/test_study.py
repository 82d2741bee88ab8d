"""What the notebooks share is made once, found again, and never replaced when it is not what it should be."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tsmlib import study
from tsmlib.envs import fingerprint, imperfect
from tsmlib.envs.spec import DELAY, NOISE, EnvSpec
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.tsm import TSM
from tsmlib.planning import tasks
from tsmlib.planning.planners import adam, cem, expected_return, sampled_starts
from tsmlib.planning.predictors import expected_predictor, model_predictor
from tsmlib.planning.search_spaces import DirectActions
from tsmlib.storage import artifacts
from tsmlib.storage.files import StoreError
from reproduction import runs
from reproduction import tasks as study_tasks
from reproduction.parameters import ParameterError
from reproduction.runs import Run

REACHER = "tsm/Reacher-v0"


def new_run(folder: Path, *, seed: int = 1) -> Run:
    """A run cut down; only seed 0 uses what ships with the repository."""
    return runs.resolve("05_control", scale="smoke", seed=seed, run_dir=str(folder))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run in which data, a model and a prior of the basic arm were made. Read only."""
    run = new_run(tmp_path_factory.mktemp("runs"))
    for model in ("tsm", "prior"):
        study.load_or_train(run, REACHER, model)
    return run


@pytest.fixture
def run(made: Run, tmp_path: Path) -> Run:
    """A copy of it to spoil."""
    shutil.copytree(made.dir, tmp_path / "smoke" / "seed1")
    return new_run(tmp_path)


def no_training(*_: Any, **__: Any) -> Any:
    raise AssertionError("this should not have been made again")


# Data ----------------------------------------------------------------------------------------------------------------


def test_data_are_collected_once(made: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study.data, "random_data", no_training)
    data = study.dataset(made, REACHER, "train")
    assert (len(data), data.horizon, data.env) == (20, 100, REACHER)


def test_data_are_a_function_of_the_seed_and_held_out_data_of_none(
    made: Run, tmp_path: Path
) -> None:
    again, other = (new_run(tmp_path, seed=seed) for seed in (1, 2))
    for split in study.SPLITS:
        first, second, third = (study.dataset(run, REACHER, split) for run in (made, again, other))
        np.testing.assert_array_equal(first.states, second.states)
        np.testing.assert_array_equal(first.actions, second.actions)
        assert np.array_equal(first.actions, third.actions) is (split != "train")
    splits = [study.dataset(made, REACHER, split).actions[:8] for split in study.SPLITS]
    assert not np.array_equal(splits[0], splits[1])
    assert not np.array_equal(splits[1], splits[2])


@pytest.mark.parametrize("how", [{"noise": NOISE}, {"delay": DELAY}])
@pytest.mark.parametrize("split", study.SPLITS)
def test_data_of_an_imperfect_arm_are_the_plain_arms_episodes(
    made: Run, how: dict[str, Any], split: str
) -> None:
    env = imperfect(REACHER, **how)
    plain, data = study.dataset(made, REACHER, split), study.dataset(made, env, split)
    assert data.env == env
    np.testing.assert_array_equal(data.actions, plain.actions)
    if "noise" in how:
        assert (data.states != plain.states).all()
        assert (
            np.corrcoef(data.states[..., 4].ravel(), plain.states[..., 4].ravel())[0, 1] > 0.8
        )  # of the same motion
    else:
        np.testing.assert_array_equal(
            data.states[:, : DELAY + 1, :2].std(1) < 0.2, True
        )  # nothing pushes yet
        assert (data.states[:, 0] == plain.states[:, 0]).all()


def test_the_papers_sizes() -> None:
    paper = runs.resolve("01_collect", scale="paper")
    assert study.sizes(paper, REACHER) == {"train": 500, "validation": 200, "test": 1000}
    assert study.sizes(paper, "tsm/ReacherPush-v1")["train"] == 5000
    assert study.sizes(paper, "tsm/PymunkObstacle-v0")["train"] == 5000


# Models --------------------------------------------------------------------------------------------------------------


def test_a_trained_model_is_found_again_with_the_same_weights(
    made: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study.models, "fit", no_training)
    (model, header), (again, _) = (study.load_or_train(made, REACHER, "tsm") for _ in range(2))
    assert isinstance(model, TSM)
    assert all(
        torch.equal(a, b) for a, b in zip(model.parameters(), again.parameters(), strict=True)
    )
    assert header["fingerprint"]["env"] == REACHER
    assert list(header["curves"]) == ["teacher_forced_loss", "loss"]
    assert header["seconds"] > 0
    assert (header["seed"], header["scale"]) == (1, "smoke")
    assert isinstance(study.load_or_train(made, REACHER, "prior")[0], ActionPrior)


def test_nothing_but_models_is_left_behind(made: Run) -> None:
    assert sorted(p.name for p in (made.models / "Reacher").iterdir()) == [
        "prior.safetensors",
        "tsm.safetensors",
    ]


def test_a_model_knows_the_scale_of_its_data(made: Run) -> None:
    data, (model, _) = (
        study.dataset(made, REACHER, "train"),
        study.load_or_train(made, REACHER, "tsm"),
    )
    seen = model.features(torch.from_numpy(data.states)).flatten(0, 1)
    torch.testing.assert_close(seen.std(0), torch.ones(8), rtol=0.01, atol=0.01)
    torch.testing.assert_close(seen.mean(0), torch.zeros(8), rtol=0, atol=0.01)


@pytest.mark.parametrize("env", ["tsm/ReacherPush-v1", "tsm/PymunkReacher-v0"])
def test_models_with_contacts_are_wider(env: str) -> None:
    run = runs.resolve("02_train", scale="smoke")
    config = study.initialise(run, "tsm", study.random_data(env, 2, seed=0, horizon=10)).config()
    wide = "Push" in env
    assert (config["channels"], config["head_channels"]) == (
        (64, 128) if wide else (32, 0)
    )  # appendix A.1
    assert (config["segment_len"], config["latent_dim"]) == (10, 8)  # section 5.1


def test_an_imperfect_arm_is_trained_as_long_as_the_plain_one_and_shares_its_prior(
    made: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study.models, "fit", no_training)
    prior, _ = study.load_or_train(made, REACHER, "prior")
    for env in (imperfect(REACHER, noise=0.1), imperfect(REACHER, delay=DELAY)):
        for scale in ("smoke", "paper"):
            run = runs.resolve("02_train", scale=scale)
            assert study.models.schedule(run, env, "tsm") == study.models.schedule(
                run, REACHER, "tsm"
            )
        shared, _ = study.load_or_train(made, env, "prior")
        assert all(
            torch.equal(a, b) for a, b in zip(prior.parameters(), shared.parameters(), strict=True)
        )


def test_an_interrupted_training_continues(
    run: Run, made: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = run.models / "Reacher" / "prior.safetensors"
    path.unlink()
    fit = study.models.fit

    def stopped(*args: Any, **settings: Any) -> Any:
        fit(*args, **settings)
        raise KeyboardInterrupt

    monkeypatch.setattr(study.models, "fit", stopped)
    with pytest.raises(KeyboardInterrupt):
        study.load_or_train(run, REACHER, "prior")
    assert [p.name for p in path.parent.glob("prior*")] == ["prior-loss.checkpoint"]
    monkeypatch.setattr(study.models, "fit", fit)
    again, _ = study.load_or_train(run, REACHER, "prior")
    whole, _ = study.load_or_train(made, REACHER, "prior")
    assert all(
        torch.equal(a, b) for a, b in zip(again.parameters(), whole.parameters(), strict=True)
    )
    assert [p.name for p in path.parent.glob("prior*")] == ["prior.safetensors"]


# Plans ---------------------------------------------------------------------------------------------------------------


def some_task(n: int = 2) -> tasks.Task:
    return study.load_task(REACHER, "validation").take(n)


LATENT, DIRECT = study.method("tsm", "latent", "cem"), study.method("tsm", "direct", "cem")


def stored(run: Run) -> dict[Path, int]:
    """The plans that a run has kept, and when each was written."""
    return {path: path.stat().st_mtime_ns for path in (run.dir / "plans").iterdir()}


@pytest.mark.parametrize("every", [0, 20])
@pytest.mark.parametrize("planner", ["adam", "adam+starts", "cem", "mppi"])
@pytest.mark.parametrize("space", ["latent", "direct"])
def test_every_method_plans_and_executes(made: Run, planner: str, space: str, every: int) -> None:
    trial = study.trial(made, some_task(), study.method("tsm", space, planner), every=every)
    assert trial.plan is not None
    assert trial.actions.shape == (2, 50, 2)
    torch.testing.assert_close(trial.gap, trial.plan.predicted_return - trial.executed_return)


def test_trials_of_several_tasks_and_methods_are_made_in_one_call(made: Run) -> None:
    methods = {"reach": [LATENT, study.method("zero")]}
    found = study.trials(made, [some_task()], methods)
    assert list(found) == [REACHER]
    assert list(found[REACHER]) == methods["reach"]
    assert torch.equal(
        found[REACHER][LATENT].actions, study.plan(made, some_task(), LATENT).actions
    )
    assert (found[REACHER][study.method("zero")].actions == 0).all()


def test_the_oracles_executed_return_is_the_predicted_one(run: Run) -> None:
    trial = study.trial(run, some_task(), study.method("oracle", "direct", "cem"))
    assert trial.plan is not None
    torch.testing.assert_close(
        trial.plan.predicted_return, trial.executed_return, rtol=1e-4, atol=1e-4
    )


def test_a_plan_is_kept_for_its_task_and_models_alone(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = study.plan(run, some_task(), LATENT)
    before = stored(run)
    again = study.plan(run, some_task(), LATENT)
    assert torch.equal(again.actions, first.actions)
    assert again.seconds == first.seconds
    assert stored(run) == before
    study.plan(run, some_task(3), LATENT)  # other targets
    assert (
        study.plan(run, some_task(), LATENT, iterations=1).seconds != first.seconds
    )  # another budget
    second = study.plan(run, some_task(), LATENT)  # of three targets, the first two
    monkeypatch.setattr(study.plans, "VERSION", study.plans.VERSION + 1)
    third = study.plan(run, some_task(), LATENT)  # another planner by the same name
    assert third.seconds != second.seconds != first.seconds


def test_a_kept_plan_is_the_one_that_was_made(made: Run) -> None:
    mppi = study.method("tsm", "direct", "mppi")
    first, again = (study.plan(made, some_task(), mppi, iterations=3) for _ in range(2))
    assert first.trace is not None
    assert again.trace is not None
    for name in ("actions", "parameters", "states", "predicted_return", "curve", "trace"):
        assert torch.equal(getattr(first, name), getattr(again, name)), name


def test_a_task_with_a_reward_of_its_own_is_planned_for_each_time(made: Run) -> None:
    plain = study.plan(made, some_task(), LATENT)
    before = stored(made)
    for height in (0.1, -0.1):
        own = some_task().with_reward(
            "reach", lambda states, actions, h=height: -(states[..., 5] - h).abs()
        )
        plan = study.plan(made, own, LATENT)
        assert not torch.equal(plan.predicted_return, plain.predicted_return)
        torch.testing.assert_close(study.trial(made, own, LATENT).actions, plan.actions)
    assert stored(made) == before


def test_a_closed_loop_begins_with_the_open_plan_and_is_kept(run: Run) -> None:
    before = study.plan(run, some_task(), LATENT)
    first = study.trial(run, some_task(), LATENT, every=20)
    assert torch.equal(first.actions[:, :20], before.actions[:, :20])
    assert not torch.equal(first.actions[:, 20:], before.actions[:, 20:])
    assert first.plan is not None
    assert first.plan.curve.shape == (3, 2)  # one predicted return for each plan
    known = stored(run)
    again = study.trial(run, some_task(), LATENT, every=20)
    assert torch.equal(again.states, first.states)
    assert stored(run) == known
    study.trial(run, some_task(), LATENT, every=25)
    assert len(stored(run)) == len(known) + 1


def test_along_the_way_the_predicted_return_only_grows(made: Run) -> None:
    adam = study.method("tsm", "direct", "adam")
    found = study.along_the_way(made, some_task(), adam, iterations=6, at=[0, 3, 6])
    whole = study.plan(made, some_task(), adam, iterations=6)
    assert (found[0].actions == 0).all()
    assert torch.equal(found[6].actions, whole.actions)
    for trial in found.values():
        assert trial.plan is not None
    assert not torch.equal(found[0].actions, found[3].actions)


def test_at_laptop_the_oracles_plans_are_the_shipped_ones_if_they_are_of_this_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    oracle = study.method("oracle", "direct", "cem")
    asked = runs.resolve("05_control", scale="laptop", run_dir=str(tmp_path / "runs"))
    monkeypatch.setattr(study.plans, "RESULTS", tmp_path)
    made = study.plan(asked, some_task(3), oracle)
    (own,) = (asked.dir / "plans").iterdir()
    own.rename(tmp_path / own.name)
    again = study.plan(asked, some_task(), oracle)
    assert torch.equal(again.actions, made.actions[:2])
    assert not stored(asked)
    monkeypatch.setattr(study.plans, "VERSION", study.plans.VERSION + 1)
    assert study.plan(asked, some_task(), oracle).seconds != made.seconds
    assert stored(asked)


def test_plans_judged_by_other_samples_are_made_again(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = study.plan(run, some_task(), LATENT)
    monkeypatch.setattr(study.plans, "JUDGING", 2)
    second = study.plan(run, some_task(), LATENT)
    assert second.seconds != first.seconds


def test_a_plan_is_chosen_by_mode_and_samples(made: Run) -> None:
    plan, net = (
        study.plan(made, some_task(), LATENT),
        study.load_or_train(made, some_task().env, LATENT.model).model,
    )
    judge = expected_predictor(net, some_task().past(net.past_len), seed=made.seed)
    judged = expected_return(judge(plan.actions[None]), plan.actions[None], some_task().reward)[0]
    torch.testing.assert_close(judged, plan.curve[-1], rtol=1e-4, atol=1e-4)


def test_a_film_shows_the_mode_of_a_plan(made: Run) -> None:
    trial = study.trial(made, some_task(), LATENT)
    seen = study.with_modes(made, some_task(), LATENT, trial)
    assert trial.plan is not None
    assert seen.plan is not None
    assert seen.plan.states.shape == (1, 2, 50, 6)  # the mode
    net = study.load_or_train(made, some_task().env, LATENT.model).model
    mode = model_predictor(net, some_task().past(net.past_len))(trial.actions[None])[:, 0]
    torch.testing.assert_close(seen.plan.states, mode, rtol=1e-4, atol=1e-4)
    assert torch.equal(seen.plan.predicted_return, trial.plan.predicted_return)


def test_the_return_is_not_predicted_with_the_samples_that_the_planner_searched_with(
    made: Run,
) -> None:
    plan = study.plan(made, some_task(), LATENT)
    assert not torch.equal(plan.predicted_return, plan.curve[-1])


@pytest.mark.parametrize(
    "bad", [("tsm", "latent", "policy", 0), ("tsm", "", "adam", 0), ("oracle", "direct", "cem", -1)]
)
def test_an_unknown_method_is_refused_before_anything_is_trained(
    tmp_path: Path, bad: tuple[str, str, str, int]
) -> None:
    *words, iterations = bad
    with pytest.raises(
        ValueError, match="expected adam, adam\\+starts, cem or mppi, latent or direct, and 0"
    ):
        study.plan(new_run(tmp_path), some_task(), study.method(*words), iterations=iterations)
    assert not any(tmp_path.iterdir())


# Bad input: one clear message that names the thing, and nothing is overwritten ---------------------------------------


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def flipped(data: bytes) -> bytes:
    return data[:-9] + bytes([data[-9] ^ 1]) + data[-8:]


@pytest.mark.parametrize(
    "damage", [cut, flipped, lambda data: b""], ids=["cut", "flipped bit", "empty"]
)
@pytest.mark.parametrize(
    "what", ["models/Reacher/tsm", "models/Reacher/prior", "data/Reacher/train"]
)
def test_a_damaged_file_is_named_and_left_alone(
    run: Run, what: str, damage: Callable[[bytes], bytes]
) -> None:
    path = run.dir / f"{what}.safetensors"
    path.write_bytes(damaged := damage(path.read_bytes()))
    with pytest.raises(StoreError, match=rf"{path.name} is damaged.*(Delete it and|Restore)"):
        if what.startswith("data"):
            study.dataset(run, REACHER, "train")
        else:
            study.load_or_train(run, REACHER, path.stem)
    assert path.read_bytes() == damaged


def test_a_model_of_another_environment_is_refused_naming_both(run: Run) -> None:
    there = run.folder("models/PymunkReacher") / "tsm.safetensors"
    shutil.copy(run.models / "Reacher" / "tsm.safetensors", there)
    before = there.read_bytes()
    with pytest.raises(
        StoreError, match="env is 'tsm/Reacher-v0' in the file, expected 'tsm/PymunkReacher-v0'"
    ):
        study.load_or_train(run, "tsm/PymunkReacher-v0", "tsm")
    assert there.read_bytes() == before


@pytest.mark.parametrize("how", [{"noise": NOISE}, {"delay": DELAY}])
def test_models_of_a_plain_and_of_an_imperfect_arm_do_not_take_each_others_place(
    run: Run, how: dict[str, Any]
) -> None:
    env = imperfect(REACHER, **how)
    (model, header), there = (
        study.load_or_train(run, REACHER, "tsm"),
        run.models / "Reacher" / "tsm.safetensors",
    )
    other = run.folder(f"models/{EnvSpec.parse(env).name}") / "tsm.safetensors"
    shutil.copy(there, other)
    with pytest.raises(StoreError, match=f"env is '{REACHER}' in the file, expected '{env}'"):
        study.load_or_train(run, env, "tsm")
    kept = {key: header[key] for key in ("model", "seed", "scale", "curves", "seconds")}
    artifacts.save_model(other, model, kept | {"fingerprint": fingerprint(env)})
    assert study.load_or_train(run, env, "tsm")[1]["fingerprint"]["env"] == env
    shutil.copy(other, there)
    with pytest.raises(StoreError, match=f"env is '{env}' in the file, expected '{REACHER}'"):
        study.load_or_train(run, REACHER, "tsm")


def test_data_of_a_plain_arm_are_refused_for_an_imperfect_one(run: Run) -> None:
    env = imperfect(REACHER, noise=NOISE)
    there = run.folder(f"data/{EnvSpec.parse(env).name}") / "train.safetensors"
    shutil.copy(run.data / "Reacher" / "train.safetensors", there)
    with pytest.raises(StoreError, match=f"env is '{REACHER}' in the file, expected '{env}'"):
        study.dataset(run, env, "train")


V0, V1 = "tsm/ReacherPush-v0", "tsm/ReacherPush-v1"
GONE = rf"{V0} is gone: the physics of pushing changed .* {V1} took its place\. Delete it and make a new one: "


def test_data_of_version_0_are_refused_with_the_command_that_makes_new_ones(run: Run) -> None:
    there = run.folder("data/ReacherPush") / "train.safetensors"
    old = replace(study.random_data(V1, 2, seed=0), env=V0)
    artifacts.save_trajectories(there, old, {"fingerprint": {**fingerprint(V1), "env": V0}})
    with pytest.raises(
        StoreError, match=rf"train.safetensors does not fit: {GONE}python -m tsmlib run collect"
    ):
        study.dataset(run, V1, "train")


def test_a_model_of_version_0_is_refused_with_the_command_that_makes_a_new_one(run: Run) -> None:
    there = run.folder("models/ReacherPush") / "onestep.safetensors"
    net = study.initialise(run, "onestep", study.random_data(V1, 2, seed=0))
    artifacts.save_model(
        there, net, {"model": "onestep", "fingerprint": {"env": V0}, "schedule": []}
    )
    command = rf"python -m tsmlib run train -p env={V1} -p models=onestep"
    with pytest.raises(StoreError, match=rf"onestep.safetensors does not fit: {GONE}{command}"):
        study.load_or_train(run, V1, "onestep")


def test_a_task_of_version_0_is_refused_with_the_command_that_makes_a_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task, path = study.load_task(V1), tmp_path / "ReacherPush.safetensors"
    monkeypatch.setattr(study_tasks, "FROZEN", tmp_path)
    for env, message in (
        (V0, f"{GONE}python benchmarks/settings/freeze_tasks.py"),
        (REACHER, f"env is '{REACHER}'"),
    ):
        arrays = {"start": task.start, "target": task.target}
        artifacts.save(path, arrays, kind="task", header={"task": "push", "env": env, "seed": 0})
        with pytest.raises(StoreError, match=message):
            study.load_task(V1)


def test_a_model_in_the_place_of_another_is_refused(run: Run) -> None:
    folder = run.models / "Reacher"
    shutil.copy(folder / "tsm.safetensors", folder / "prior.safetensors")
    with pytest.raises(StoreError, match="holds 'tsm', expected 'prior'"):
        study.load_or_train(run, REACHER, "prior")


@pytest.mark.parametrize(("scale", "seed"), [("smoke", 5), ("paper", 1)])
def test_a_model_of_another_seed_or_scale_is_refused_naming_both(
    run: Run, scale: str, seed: int
) -> None:
    other = runs.resolve("05_control", scale=scale, seed=seed, run_dir=str(run.dir.parents[1]))
    there = other.folder("models/Reacher") / "tsm.safetensors"
    shutil.copy(run.models / "Reacher" / "tsm.safetensors", there)
    said = f"{there} was trained with seed 1 at scale smoke, expected seed {seed} at scale {scale}. Move it .* delete it"
    with pytest.raises(StoreError, match=said):
        study.load_or_train(other, REACHER, "tsm")


def test_shipped_models_are_those_of_scale_laptop_and_seed_0_whatever_scale_they_were_trained_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study.models, "fit", no_training)
    run = runs.resolve("05_control", scale="laptop", run_dir=str(tmp_path))
    assert study.load_or_train(run, REACHER, "tsm")[1]["scale"] == "paper"


@pytest.mark.parametrize(("taken", "seed"), [("train", 5), ("test", 1)])
def test_training_data_of_another_seed_or_split_are_refused_naming_both(
    run: Run, taken: str, seed: int
) -> None:
    other = new_run(run.dir.parents[1], seed=seed)
    drawn = study.data.HELD_OUT_SEED.get(taken, run.seed)
    study.dataset(run, REACHER, taken)
    there = other.folder("data/Reacher") / "train.safetensors"
    shutil.copy(run.data / "Reacher" / f"{taken}.safetensors", there)
    with pytest.raises(
        StoreError,
        match=f"holds split '{taken}' drawn with seed {drawn}, expected 'train' with seed {seed}",
    ):
        study.dataset(other, REACHER, "train")


def test_data_of_another_environment_are_refused(run: Run) -> None:
    there = run.folder("data/PymunkReacher") / "train.safetensors"
    shutil.copy(run.data / "Reacher" / "train.safetensors", there)
    with pytest.raises(
        StoreError, match="env is 'tsm/Reacher-v0' in the file, expected 'tsm/PymunkReacher-v0'"
    ):
        study.dataset(run, "tsm/PymunkReacher-v0", "train")


def test_a_folder_that_cannot_be_written_is_found_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = new_run(tmp_path)
    (run.folder() / "data").write_text("in the way")
    (run.folder() / "models").write_text("in the way")
    monkeypatch.setattr(study.data, "random_data", no_training)
    monkeypatch.setattr(study.models, "fit", no_training)
    with pytest.raises(ParameterError, match=r"cannot make the folder .*data/Reacher.*TSM_RUN_DIR"):
        study.dataset(run, REACHER, "train")
    with pytest.raises(
        ParameterError, match=r"cannot make the folder .*models/Reacher.*TSM_RUN_DIR"
    ):
        study.load_or_train(run, REACHER, "tsm")


@pytest.mark.parametrize("n", [0, -3])
def test_a_number_of_episodes_that_is_not_positive_is_refused(n: int) -> None:
    with pytest.raises(ValueError, match=rf"n is {n}, .* expected a positive number of episodes"):
        study.random_data(REACHER, n, seed=0)
    with pytest.raises(ValueError, match=rf"num_envs is {n}; expected at least 1"):
        study.draw_task(REACHER, seed=0, n=n)


@pytest.mark.parametrize("horizon", [0, -3])
def test_episodes_without_steps_are_refused(horizon: int) -> None:
    with pytest.raises(
        ValueError,
        match=rf"horizon is {horizon}, expected a positive number of episodes and of steps",
    ):
        study.random_data(REACHER, 2, seed=0, horizon=horizon)


def test_planners_refuse_sizes_that_make_no_sense() -> None:
    def predict(actions: torch.Tensor) -> torch.Tensor:
        return actions[None]

    def reward(states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        return -actions.square().sum(-1)

    space = DirectActions(5)
    for bad in (
        {"candidates": 0},
        {"elites": 0},
        {"elites": 1},
        {"elites": 300},
        {"iterations": 0},
        {"candidates": -1},
    ):
        with pytest.raises(ValueError, match="expected"):
            cem(predict, reward, space, 2, **bad)
    with pytest.raises(ValueError, match="keep is 5 of 4 candidates, expected 1 to 4"):
        sampled_starts(predict, reward, space, 2, candidates=4, keep=5)
    with pytest.raises(ValueError, match="iterations is -1, expected"):
        adam(predict, reward, space, torch.zeros(1, 2, 5, 2), iterations=-1)


@pytest.mark.parametrize("text", ["tsm/Nothing-v0", "", "tsm/Reacher-v0,,", "ALL"])
def test_a_parameter_that_names_something_unknown_lists_what_there_is(text: str) -> None:
    with pytest.raises(
        ParameterError,
        match="envs names .*, expected some of tsm/Reacher-v0, tsm/ReacherPush-v1; or all",
    ):
        study.parse_choice("envs", text, [REACHER, "tsm/ReacherPush-v1"])
    assert study.parse_choice("envs", f" {REACHER} ", [REACHER]) == [REACHER]
    assert study.parse_choice("envs", "all", ["a", "b"]) == ["a", "b"]
