"""A model of one's own needs two names; an error says what is wrong with it."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium
import pytest
import torch
from torch import Tensor

import tsmlib
from tsmlib.models.features import Features
from tsmlib.sampling import SeparateNoise, SharedNoise, by_generator, standard_normal
from tsmlib.trajectory import Segment


class Still:
    """A model with the least that one needs."""

    segment_len = 5

    def predict_segment(self, past: Segment, actions: Tensor) -> Tensor:
        return past.states[:, -1:].expand(-1, actions.shape[1], -1)


def test_a_model_of_two_names_plans_scores_and_is_controlled() -> None:
    task = tsmlib.load_task("tsm/Reacher-v0").take(2)
    space = tsmlib.DirectActions(task.horizon, rms=0.1)
    plan = tsmlib.cem(
        tsmlib.model_predictor(Still(), task.past(5)),
        task.reward,
        space,
        2,
        candidates=30,
        iterations=2,
    )
    assert torch.isfinite(tsmlib.execute(task, plan).executed_return).all()
    trial = tsmlib.mpc(
        task, Still(), space, partial(tsmlib.cem, candidates=30, iterations=1), every=25
    )
    assert trial.states.shape == (2, 51, 6)
    data = tsmlib.collect(
        gymnasium.make_vec(task.env, num_envs=8),
        tsmlib.open_loop(torch.zeros(8, 30, 2)),
        horizon=30,
        seed=0,
    )
    features = Features(6, data.angles).fit(torch.from_numpy(data.states))
    scores = tsmlib.score(
        Still(), features, data.take(slice(0, 4)), data.take(slice(4, 8)), samples=1, horizon=10
    )
    assert (
        float(scores.against_horizon()["nrmse"].mean()) < 0.1
    )  # without torque the arm hardly moves


class Gusts:
    """A model that draws as torch draws, and nothing else."""

    segment_len, past_len = 10, 1

    def predict_segment(
        self, past: Segment, actions: Tensor, generator: torch.Generator | None = None
    ) -> Tensor:
        x, states = past.states[:, -1], []
        for u in actions.unbind(1):
            x = x + 0.1 * u.sum(1, keepdim=True)
            if generator is not None:
                x = x + 0.1 * torch.randn(x.shape, generator=generator)
            states.append(x)
        return torch.stack(states, dim=1)


JUDGES = {
    "samples": partial(tsmlib.model_predictor, samples=3),
    "expected": partial(tsmlib.expected_predictor, samples=3),
    "fresh": partial(tsmlib.fresh_predictor, samples=3),
}


@pytest.mark.parametrize("judge", JUDGES.values(), ids=JUDGES)
def test_a_model_that_draws_from_a_torch_generator_has_futures_that_candidates_share(
    judge: Any,
) -> None:
    task = tsmlib.load_task("tsm/Reacher-v0").take(2)
    predict, space = (
        judge(Gusts(), task.past(1), seed=4),
        tsmlib.DirectActions(task.horizon, rms=0.1),
    )
    same = predict(torch.zeros(3, 2, task.horizon, 2))  # (S, C, B, T, dx)
    assert torch.equal(same, same[:, :1].expand_as(same))
    assert torch.equal(same, predict(torch.zeros(3, 2, task.horizon, 2)))
    futures = same[:, 0].flatten(0, 1)[:, -1, 0]  # of samples and targets, each its own
    assert len(futures.unique()) == len(futures)
    for planner in (
        partial(tsmlib.adam, iterations=2),
        partial(tsmlib.cem, candidates=4, elites=2, iterations=1, screened=0.5),
        partial(tsmlib.mppi, candidates=4, iterations=1),
    ):
        assert torch.isfinite(planner(predict, task.reward, space, 2).predicted_return).all()
    trial = tsmlib.mpc(
        task,
        Gusts(),
        space,
        partial(tsmlib.mppi, candidates=2, iterations=1),
        every=25,
        judge=judge,
    )
    assert torch.isfinite(trial.executed_return).all()


def test_common_random_numbers_of_a_torch_generator_are_those_of_standard_normal() -> None:
    def noise() -> SharedNoise:
        return SharedNoise(
            SeparateNoise(tuple(torch.Generator().manual_seed(k) for k in (1, 2))), 6
        )

    drawn, again, like = noise(), noise(), torch.zeros(12, 2)
    for _ in range(2):  # the second draw goes on where the first ended
        parts = [
            torch.randn(len(like[rows]), 2, generator=own) for rows, own in by_generator(12, drawn)
        ]
        assert torch.equal(torch.cat(parts), standard_normal((12, 2), again, like))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"segment_len": None}, "segment_len of Other is None; expected a positive int"),
        ({"segment_len": 0}, "segment_len of Other is 0; expected a positive int"),
        (
            {"predict_segment": lambda self, past, actions: past.states},
            r"gave a Tensor \(2, 5, 6\) for actions \(2, 3, 2\); expected .*\(2, 3, 6\)",
        ),
        (
            {"predict_segment": lambda self, past, actions: None},
            "predict_segment of Other gave a NoneType",
        ),
    ],
)
def test_a_model_that_is_something_else_is_refused_by_what_is_wrong(
    changes: dict[str, Any], message: str
) -> None:
    other = type("Other", (Still,), changes)()
    past = tsmlib.load_task("tsm/Reacher-v0").take(2).past(5)
    with pytest.raises(TypeError, match=message):
        tsmlib.model_predictor(other, past)(torch.zeros(1, 2, 3, 2))


def test_an_object_that_cannot_predict_is_refused_by_what_it_lacks() -> None:
    past = tsmlib.load_task("tsm/Reacher-v0").take(2).past(5)
    with pytest.raises(
        TypeError,
        match="object, which cannot predict: it has no segment_len and no predict_segment. The",
    ):
        tsmlib.model_predictor(object(), past)(torch.zeros(1, 2, 3, 2))  # type: ignore[arg-type]
