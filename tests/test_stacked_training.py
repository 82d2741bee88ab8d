"""Several trainings as one are each what ``fit`` makes of it alone."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from tsmlib.envs.spec import EnvSpec
from tsmlib.envs.symmetry import symmetric
from tsmlib.stacked_training import fit_stacked, stacked
from tsmlib.study import zoo
from tsmlib.study.data import random_data
from tsmlib.training.checkpoint import TrainingStopped
from tsmlib.training.fit import TrainingHistory, TrainingOptions, fit
from tsmlib.training.precision import native_bf16
from tsmlib.trajectory import Trajectories, TrajectoryError

ENVS = ("tsm/ReacherObstacle-v0", "tsm/PymunkPush-v1")
LOSSES = [
    ("tsm", "teacher_forced_loss"), ("tsm", "loss"), ("tsm", "energy_loss"), ("rtsm", "point_loss"), ("rtsm", "loss"),
    ("onestep", "loss"), ("onestep", "multi_step_loss"), ("lstm", "loss"), ("prior", "loss"),
]  # fmt: skip
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


def both(word: str, loss: str, env: str, **changes: Any) -> tuple[list[Any], list[Any], list[TrainingHistory]]:
    """Models that were trained alone, the same trained as one, and the records of the latter beside the former's."""
    given, held_out = [symmetric(data(env, seed)) for seed in SEEDS], data(env, 99)
    alone, together = models(word, env, given), models(word, env, given)
    o = options(alone[0].past_len, **changes)
    histories = [
        fit(net, getattr(net, loss), d, held_out, o, seed=s) for net, d, s in zip(alone, given, SEEDS, strict=True)
    ]
    found = fit_stacked(together, loss, stacked(given, o.past_len), held_out, o, seeds=SEEDS)
    for one, other in zip(histories, found, strict=True):
        assert one.step == other.step
        torch.testing.assert_close(other.train, one.train, rtol=3e-4, atol=1e-5)
        torch.testing.assert_close(other.validation, one.validation, rtol=3e-4, atol=1e-5)
    return alone, together, found


@pytest.mark.parametrize("env", ENVS)
@pytest.mark.parametrize(("word", "loss"), LOSSES)
def test_each_of_several_copies_is_what_it_is_alone(word: str, loss: str, env: str) -> None:
    alone, together, _ = both(word, loss, env)
    for one, other in zip(alone, together, strict=True):
        for name, weight in one.state_dict().items():
            torch.testing.assert_close(other.state_dict()[name], weight, rtol=1e-3, atol=2e-5, msg=name)


@pytest.mark.parametrize("changes", [dict(muon=0.0), dict(muon=0.0, weight_decay=0.1), dict(weight_decay=0.1)])
def test_optimisers_are_those_of_a_training_alone(changes: dict[str, float]) -> None:
    alone, together, _ = both("rtsm", "loss", ENVS[0], **changes)
    for one, other in zip(alone, together, strict=True):
        for name, weight in one.state_dict().items():
            torch.testing.assert_close(other.state_dict()[name], weight, rtol=1e-3, atol=2e-5, msg=name)


def test_copies_are_not_one_another() -> None:
    _, (one, other), _ = both("onestep", "loss", ENVS[0])
    assert not any(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))


def test_copies_of_other_sizes_and_other_counts_are_refused() -> None:
    env = ENVS[0]
    with pytest.raises(TrajectoryError, match="expected one shape"):
        stacked([data(env, 3), random_data(env, 5, seed=8, horizon=30)], 1)
    given = [data(env, seed) for seed in SEEDS]
    nets = models("onestep", env, given)
    with pytest.raises(ValueError, match="found 2 models, 1 seeds and data of 2"):
        fit_stacked(nets, "loss", stacked(given, 1), given[0], options(1), seeds=(3,))


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
    env, histories = ENVS[1], dict[bool, list[float]]()
    given, held_out = [symmetric(data(env, seed)) for seed in SEEDS], data(env, 99)
    for bf16 in (False, True):
        nets = models(word, env, given)
        o = options(nets[0].past_len, bf16=bf16)
        found = fit_stacked(nets, loss, stacked(given, o.past_len), held_out, o, seeds=SEEDS)
        assert found[0].bf16 == [bf16] * 2
        histories[bf16] = found[0].train
    alone = models(word, env, given)[0]
    expected = fit(alone, getattr(alone, loss), given[0], held_out, o, seed=SEEDS[0]).train
    torch.testing.assert_close(histories[True], expected, rtol=3e-3, atol=0.0)
    assert histories[True] != histories[False]
