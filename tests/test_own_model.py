"""A model of one's own needs two names; where it is wrong, the error says what and what is expected."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium
import pytest
import torch
from torch import Tensor

import tsmlib as tsm
from tsmlib.models.features import Features
from tsmlib.trajectory import Segment


class Still:
    """A model with the least that one needs."""

    segment_len = 5

    def predict_segment(self, past: Segment, actions: Tensor) -> Tensor:
        return past.states[:, -1:].expand(-1, actions.shape[1], -1)


def test_a_model_of_two_names_plans_scores_and_is_controlled() -> None:
    task = tsm.load_task("tsm/Reacher-v0").take(2)
    space = tsm.DirectActions(task.horizon)
    plan = tsm.cem(tsm.model_predictor(Still(), task.past(5)), task.reward, space, 2, candidates=30, iterations=2)
    assert torch.isfinite(tsm.execute(task, plan).executed_return).all()
    trial = tsm.mpc(task, Still(), space, partial(tsm.cem, candidates=30, iterations=1), every=25)
    assert trial.states.shape == (2, 51, 6)
    data = tsm.collect(
        gymnasium.make_vec(task.env, num_envs=8), tsm.open_loop(torch.zeros(8, 30, 2)), horizon=30, seed=0
    )
    features = Features(6, data.angles).fit(torch.from_numpy(data.states))
    scores = tsm.score(Still(), features, data.take(slice(0, 4)), data.take(slice(4, 8)), samples=1, horizon=10)
    assert float(scores.against_horizon()["nrmse"].mean()) < 0.1  # without torque the arm hardly moves


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"segment_len": None}, "segment_len of Other is None; expected a positive int"),
        ({"segment_len": 0}, "segment_len of Other is 0; expected a positive int"),
        ({"predict_segment": lambda self, past, actions: past.states},
         r"gave a tensor \(2, 5, 6\) for actions \(2, 3, 2\); expected states \(2, 3, 6\)"),
        ({"predict_segment": lambda self, past, actions: None}, "predict_segment of Other gave a NoneType"),
    ],
)  # fmt: skip
def test_a_model_that_is_something_else_is_refused_by_what_is_wrong(changes: dict[str, Any], message: str) -> None:
    other = type("Other", (Still,), changes)()
    past = tsm.load_task("tsm/Reacher-v0").take(2).past(5)
    with pytest.raises(TypeError, match=message):
        tsm.model_predictor(other, past)(torch.zeros(1, 2, 3, 2))


def test_an_object_that_cannot_predict_is_refused_by_what_it_lacks() -> None:
    past = tsm.load_task("tsm/Reacher-v0").take(2).past(5)
    with pytest.raises(
        TypeError, match="object cannot predict: it has no segment_len and no predict_segment. The least"
    ):
        tsm.model_predictor(object(), past)(torch.zeros(1, 2, 3, 2))  # type: ignore[arg-type]
