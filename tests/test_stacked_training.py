"""Several trainings as one are each what ``fit`` makes of it alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from tsmlib.envs.spec import EnvSpec
from tsmlib.envs.symmetry import symmetric
from tsmlib.stacked_training import fit_stacked, stacked
from tsmlib.study import models as study_models
from tsmlib.study import runs, zoo
from tsmlib.study.data import random_data
from tsmlib.training.checkpoint import TrainingStopped
from tsmlib.training.fit import TrainingOptions, fit
from tsmlib.training.precision import native_bf16
from tsmlib.trajectory import Trajectories, TrajectoryError

ENVS = ("tsm/ReacherObstacle-v0", "tsm/PymunkPush-v1")
LOSSES = [
    ("tsm", "teacher_forced_loss"), ("tsm", "loss"), ("tsm", "energy_loss"), ("rtsm", "point_loss"), ("rtsm", "loss"),
    ("onestep", "loss"), ("onestep", "multi_step_loss"), ("lstm", "loss"), ("prior", "loss"), ("ensemble", "loss"),
    ("ensemble+mse", "loss"),
]  # fmt: skip
OTHERS = sorted({(word, stage.loss) for word, spec in zoo.ZOO.items() for stage in spec.stages} - set(LOSSES))
SEEDS = (3, 8)


def data(env: str, seed: int) -> Trajectories:
    return random_data(env, 6, seed=seed, horizon=30)


def options(past_len: int, **changes: Any) -> TrainingOptions:
    given = dict(batch_size=8, lr=5e-4, muon=0.002, warmup=2, validate_every=4, clip=0.5) | changes
    return TrainingOptions(past_len, 20, 6, **given)


def models(word: str, env: str, given: list[Trajectories]) -> list[Any]:
    spec = zoo.find(word)
    made: Any = spec.load()
    return [made.for_data(d, seed=s, **spec.arguments(EnvSpec.parse(env))) for d, s in zip(given, SEEDS, strict=True)]


def trained_as_one(
    word: str, loss: str, env: str, device: str = "cpu", *, compiled: bool = False, **changes: Any
) -> Any:
    """Models trained as one, each of which is what the same became alone."""
    given, held_out = [symmetric(data(env, seed)) for seed in SEEDS], data(env, 99)
    alone, together = models(word, env, given), models(word, env, given)
    o = options(alone[0].past_len, **changes)
    histories = [
        fit(net, getattr(net, loss), d, held_out, o, seed=s) for net, d, s in zip(alone, given, SEEDS, strict=True)
    ]
    train = stacked(given, o.past_len, device)
    found = fit_stacked(together, loss, train, held_out, o, seeds=SEEDS, device=device, compiled=compiled)
    for one, other in zip(histories, found, strict=True):
        assert one.step == other.step
        torch.testing.assert_close(other.train, one.train, rtol=3e-4, atol=1e-5)
        torch.testing.assert_close(other.validation, one.validation, rtol=3e-4, atol=1e-5)
    for one, other in zip(alone, together, strict=True):
        for name, weight in one.state_dict().items():
            # Adam divides a gradient that is all but zero by its own size, so that rounding moves a few weights further
            apart = (other.state_dict()[name].cpu().double() - weight.double()).abs()
            assert (apart > 2e-5 + 1e-3 * weight.abs()).double().mean() <= 2e-3, name
            assert apart.max() <= 1e-3, name
    return together


@pytest.mark.parametrize("env", ENVS)
@pytest.mark.parametrize(("word", "loss"), LOSSES)
def test_each_of_several_copies_is_what_it_is_alone(word: str, loss: str, env: str) -> None:
    trained_as_one(word, loss, env)


@pytest.mark.parametrize(("word", "loss"), OTHERS)
def test_and_so_is_each_of_the_other_models(word: str, loss: str) -> None:
    trained_as_one(word, loss, ENVS[0])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(("word", "loss"), LOSSES)
def test_a_recorded_update_does_what_one_on_the_processor_does(word: str, loss: str, compiled: bool) -> None:
    trained_as_one(word, loss, ENVS[1], "cuda", compiled=compiled)


@pytest.mark.parametrize("changes", [dict(muon=0.0), dict(muon=0.0, weight_decay=0.1), dict(weight_decay=0.1)])
def test_optimisers_are_those_of_a_training_alone(changes: dict[str, float]) -> None:
    trained_as_one("rtsm", "loss", ENVS[0], **changes)


def test_copies_are_not_one_another() -> None:
    one, other = trained_as_one("onestep", "loss", ENVS[0])
    assert not any(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))


def test_copies_of_other_sizes_and_other_counts_are_refused() -> None:
    env = ENVS[0]
    with pytest.raises(TrajectoryError, match="expected one shape"):
        stacked([data(env, 3), random_data(env, 5, seed=8, horizon=30)], 1)
    given = [data(env, seed) for seed in SEEDS]
    nets = models("onestep", env, given)
    with pytest.raises(ValueError, match="found 2 models, 1 seeds and data of 2 copies"):
        fit_stacked(nets, "loss", stacked(given, 1), given[0], options(1), seeds=(3,))


def test_what_a_training_alone_refuses_or_treats_otherwise_is_refused() -> None:
    env = ENVS[0]
    given = [data(env, seed) for seed in SEEDS]
    nets, train = models("onestep", env, given), stacked(given, 1)
    with pytest.raises(ValueError, match="past_len is 2, but OneStep is given 1 steps of past"):
        fit_stacked(nets, "loss", train, given[0], options(2), seeds=SEEDS)
    with pytest.raises(TrajectoryError, match="episodes of 30 steps are too short for windows of 31 future steps"):
        fit_stacked(nets, "loss", train, given[0], replace(options(1), future_len=31), seeds=SEEDS)
    nets[1].features.step_std[0] = 0
    with pytest.raises(ValueError, match="other state dimensions change"):
        fit_stacked(nets, "loss", train, given[0], options(1), seeds=SEEDS)
    nets[1].features.step_std.zero_()
    with pytest.raises(ValueError, match="a OneStep has no statistics of its data"):
        fit_stacked(nets, "loss", train, given[0], options(1), seeds=SEEDS)
    next(nets[0].parameters()).requires_grad_(False)
    with pytest.raises(ValueError, match=r"net\.0\.weight requires no gradient"):
        fit_stacked(nets, "loss", train, given[0], options(1), seeds=SEEDS)
    others = models("onestep", env, given)
    for net in others:
        net.loss = lambda window, generator: torch.rand(2, generator=generator).sum()
    with pytest.raises(ValueError, match="draws its noise by other means"):
        fit_stacked(others, "loss", train, given[0], options(1), seeds=SEEDS)


def test_seeds_are_trained_as_one_and_found_by_their_runs(tmp_path: Path) -> None:
    env = "tsm/Reacher-v0"
    own = [runs.resolve("02_train", scale="smoke", seed=seed, run_dir=str(tmp_path)) for seed in SEEDS]
    for run, made in zip(own, study_models.train_as_one(own, env, "onestep"), strict=True):
        found, header = study_models.load_or_train(run, env, "onestep")
        assert (header["seed"], header["copies"], header["processor"]) == (run.seed, 2, "cpu")
        kept, had = found.state_dict(), made.model.state_dict()
        assert all(torch.equal(kept[name], had[name]) for name in kept)
    with pytest.raises(ValueError, match="found runs of smoke 3 on cpu, smoke 3 on cpu; expected different seeds"):
        study_models.train_as_one([own[0]] * 2, env, "onestep")
    with pytest.raises(ValueError, match="prior of tsm/ReacherPush-v1 is trained on tsm/ReacherObstacle-v0"):
        study_models.train_as_one(own, "tsm/ReacherPush-v1", "prior")


def test_where_a_seed_cannot_be_trained_with_the_others_they_are_trained_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    own = [runs.resolve("02_train", scale="smoke", seed=seed, run_dir=str(tmp_path)) for seed in SEEDS]
    alone = fit

    def stopped(*_: object, seed: int = 3, **given: Any) -> Any:
        if seed == 3:
            raise TrainingStopped("the loss of seed 3 is not finite")
        return alone(*_, seed=seed, **given)

    monkeypatch.setattr(study_models, "fit_stacked", stopped)
    monkeypatch.setattr(study_models, "fit", stopped)
    with pytest.raises(TrainingStopped, match="the loss of seed 3"):
        study_models.load_or_train_as_one(own, "tsm/Reacher-v0", "onestep")
    assert "one by one: the loss of seed 3 is not finite" in capsys.readouterr().out
    assert [(run.dir / "models" / "Reacher" / "onestep.safetensors").exists() for run in own] == [False, True]
    monkeypatch.setattr(study_models, "fit", alone)
    found = study_models.load_or_train_as_one(own, "tsm/Reacher-v0", "onestep")
    assert [(made.header["seed"], made.header.get("copies")) for made in found] == [(3, None), (8, None)]


def test_models_of_every_past_are_trained_as_one(tmp_path: Path) -> None:
    own = [runs.resolve("02_train", scale="smoke", seed=seed, run_dir=str(tmp_path)) for seed in SEEDS]
    found = study_models.train_as_one(own, "tsm/Reacher-v0", "tsm+h20")
    assert [made.header["copies"] for made in found] == [2, 2]


def test_a_loss_that_is_not_finite_stops_all_with_the_best_weights_so_far() -> None:
    env = ENVS[0]
    given = [data(env, seed) for seed in SEEDS]
    nets = models("onestep", env, given)
    train = stacked(given, 1)
    train.states[1] = float("nan")
    with pytest.raises(TrainingStopped, match="the loss of seed 8 is not finite at step 4 of 6"):
        fit_stacked(nets, "loss", train, given[0], options(1), seeds=SEEDS)
    assert all(weight.isfinite().all() for net in nets for weight in net.parameters())


@pytest.mark.skipif(not native_bf16(), reason="this processor multiplies no matrices in bfloat16")
@pytest.mark.parametrize(("word", "loss"), [("onestep", "multi_step_loss"), ("rtsm", "loss"), ("rtsm", "point_loss")])
def test_products_are_in_bfloat16_where_those_of_a_training_alone_are(word: str, loss: str) -> None:
    env, histories, validated = ENVS[1], dict[bool, list[float]](), dict[bool, list[float]]()
    given, held_out = [symmetric(data(env, seed)) for seed in SEEDS], data(env, 99)
    for bf16 in (False, True):
        nets = models(word, env, given)
        o = options(nets[0].past_len, bf16=bf16)
        found = fit_stacked(nets, loss, stacked(given, o.past_len), held_out, o, seeds=SEEDS)
        assert found[0].bf16 == [bf16] * 2
        histories[bf16], validated[bf16] = found[0].train, found[0].validation
    alone = models(word, env, given)[0]
    expected = fit(alone, getattr(alone, loss), given[0], held_out, o, seed=SEEDS[0])
    torch.testing.assert_close(histories[True], expected.train, rtol=3e-3, atol=0.0)
    torch.testing.assert_close(validated[True], expected.validation, rtol=3e-3, atol=0.0)
    assert histories[True] != histories[False]
