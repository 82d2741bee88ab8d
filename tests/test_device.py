"""Models are trained, rolled out, planned with and learned in on an accelerator as on a CPU."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import pytest
import torch
from accelerator import DEVICE, Accelerator
from test_axioms import DU, MODELS, Case, motion, new_prior
from torch import Tensor

from reproduction.measures.actions import reconstruct, sample_actions
from tsmlib.evaluation import prediction
from tsmlib.models.base import rollout
from tsmlib.planning.base import Planner, SearchSpace
from tsmlib.planning.planners import adam, cem
from tsmlib.planning.predictors import model_predictor
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.policies.learning import LearningOptions, learn_policy
from tsmlib.policies.networks import OneStepPolicy, SegmentPolicy, controller
from tsmlib.rewards import Reward
from tsmlib.training.fit import TrainingOptions, fit
from tsmlib.trajectory import Segment, Trajectories, initial_past

T = TypeVar("T")

PROCESSOR, HORIZON, TARGETS, REACHER = "cpu", 20, 3, "tsm/Reacher-v0"


@pytest.fixture(params=[pytest.param(DEVICE, id="imitated"), *["cuda"] * torch.cuda.is_available()])
def device(request: pytest.FixtureRequest) -> str:
    """An accelerator: one that the processor imitates, and a real one where there is one."""
    return request.param


def on(place: str, make: Callable[[str], T]) -> T:
    """``make(place)`` while that is a device, which it uses."""
    if place != DEVICE:
        return make(place)
    with Accelerator() as accelerator:
        made = make(place)
    assert accelerator.count, "nothing ran on it"
    return made


def agree(found: Tensor, expected: Tensor, device: str) -> bool:
    """On the same device, and equal up to rounding, of an accelerator that may be imitated."""
    close = 1e-6 if device == DEVICE else 1e-3
    return found.device == expected.device and torch.allclose(
        found, expected, rtol=close, atol=close
    )


@pytest.fixture(params=["tsm", "onestep", "lstm", "ensemble", "ensemble+mse, obstacle"])
def case(request: pytest.FixtureRequest) -> Case:
    return MODELS[request.param]


def episodes(case: Case, n: int, seed: int) -> Trajectories:
    seen = motion(case, n, 31, seed=seed)
    names = tuple(f"x{i}" for i in range(case.state_dim))
    return Trajectories(
        seen.states.float().numpy(),
        seen.actions[:, 1:].float().numpy(),
        "tsm/Made-v0",
        0.02,
        names,
        ("",) * len(names),
        case.model(torch.float32).features.angles,
    )


def weights(model: Any) -> Tensor:
    return torch.cat([parameter.detach().flatten() for parameter in model.parameters()])


def new_model(name: str = "tsm") -> Any:
    return MODELS[name].model(torch.float32)


def to_the_origin(states: Tensor, actions: Tensor) -> Tensor:
    return -states[..., :2].square().sum(-1) - actions.square().sum(-1)


def test_a_model_trained_on_it_comes_back_the_same(case: Case, device: str) -> None:
    data, held_out = episodes(case, 12, 0), episodes(case, 4, 1)
    for loss, _ in case.losses:

        def trained(place: str, loss: str = loss) -> tuple[Tensor, Tensor]:
            model = case.model(torch.float32)
            options = TrainingOptions(
                future_len=10, steps=2, batch_size=4, validate_every=2, warmup=0
            )
            wanted = getattr(model, loss)
            curve = fit(model, data, held_out, options, wanted, device=place, progress=False)
            return torch.tensor([curve.train, curve.validation]), weights(model)

        (there, found), (here, expected) = on(device, trained), on(PROCESSOR, trained)
        assert agree(there, here, device), loss
        moved = expected - weights(case.model(torch.float32))
        assert moved.abs().max() > 1e-3
        assert (found - expected).norm() < 0.01 * moved.norm(), loss


@pytest.mark.filterwarnings("ignore:for .* to a meta parameter")  # which would have no numbers
def test_a_training_that_stopped_on_it_goes_on_there_or_elsewhere(
    device: str, tmp_path: Path
) -> None:
    data, held_out = episodes(MODELS["tsm"], 12, 0), episodes(MODELS["tsm"], 4, 1)

    def trained(*places: str) -> dict[str, Tensor]:
        """To its end on the last of ``places``, stopped once at step 2 on each other."""
        folder = tmp_path / "-".join(places)
        for place in places:
            model = new_model()
            calls = 0

            def loss(window: Any, generator: Any, model: Any = model, place: str = place) -> Tensor:
                nonlocal calls
                calls += 1
                if place != places[-1] and calls == 5:  # the first loss, two updates, a validation
                    raise KeyboardInterrupt
                return model.loss(window, generator)

            def run(place: str, model: Any = model, loss: Any = loss) -> None:
                options = TrainingOptions(10, 10, steps=4, batch_size=8, validate_every=2, warmup=0)
                fit(
                    model,
                    data,
                    held_out,
                    options,
                    loss,
                    checkpoint=folder,
                    device=place,
                    progress=False,
                )

            with suppress(KeyboardInterrupt):
                on(place, run)
            assert next(model.parameters()).device.type == PROCESSOR
        return model.state_dict()

    expected = trained(PROCESSOR)
    again = trained(device, device)
    with pytest.warns(UserWarning, match="device"):
        elsewhere = trained(device, PROCESSOR), trained(PROCESSOR, device)
    for found in (again, *elsewhere):
        assert all(torch.allclose(found[name], expected[name], atol=1e-4) for name in expected)


def test_a_model_there_is_rolled_out_from_here(case: Case, device: str) -> None:
    model, seen = case.model(torch.float32), motion(case, 6, 40)
    past = Segment(*(part[:, :10].float() for part in seen)).last(model.past_len)
    actions = seen.actions[:, 10:].float()

    def imagined(place: str) -> list[Tensor]:
        model.to(place)
        return [
            rollout(model, past, actions, generator=g)
            for g in (None, torch.Generator().manual_seed(0))
        ]

    here, there = on(PROCESSOR, imagined), on(device, imagined)
    assert all(agree(a, b, device) for a, b in zip(there, here, strict=True))


def test_it_scores_as_the_processor_does(case: Case, device: str) -> None:
    data, held_out = episodes(case, 6, 2), episodes(case, 5, 3)
    features = case.model(torch.float32).features

    def scores(place: str) -> prediction.Scores:
        return prediction.score(
            case.model(torch.float32).to(place), features, data, held_out, samples=3, horizon=20
        )

    there, here = on(device, scores), on(PROCESSOR, scores)
    assert all(agree(there.values[metric], here.values[metric], device) for metric in here.values)


@pytest.mark.parametrize(
    "planner", [partial(adam, iterations=1), partial(cem, candidates=4, elites=2, iterations=1)]
)
@pytest.mark.parametrize("over", ["codes", "actions"])
def test_it_finds_the_same_plan(planner: Planner, over: str, device: str) -> None:
    start = motion(MODELS["tsm"], TARGETS, 2).states[:, 0].float()

    def found(place: str) -> tuple[Tensor, ...]:
        model, prior = new_model().to(place), new_prior().float().to(place)
        space: SearchSpace = (
            LatentActions(prior, HORIZON) if over == "codes" else DirectActions(HORIZON, rms=0.1)
        )
        predict = model_predictor(model, initial_past(start, model.past_len, DU), samples=2)
        plan = planner(predict, to_the_origin, space, TARGETS)
        left, parameters = space.after(plan.parameters, 7)  # what a closed loop goes on from
        return plan.actions, plan.predicted_return, left.decode(parameters[None])

    assert all(
        agree(there, here, device)
        for there, here in zip(on(device, found), on(PROCESSOR, found), strict=True)
    )


@pytest.mark.parametrize("through", ["codes", "actions"])
def test_a_policy_learned_there_is_the_same_and_acts_here(through: str, device: str) -> None:
    seen = motion(MODELS["tsm"], 8, 20)
    starts = seen.states[:, 0].float()

    def reward(target: Tensor) -> Reward:
        return lambda states, actions: -(states[..., :2] - target[:, None]).square().sum(-1)

    def learned(place: str) -> tuple[Any, Tensor]:
        if through == "codes":
            policy: Any = SegmentPolicy(6, new_prior().float(), angles=(0, 1), channels=8)
        else:
            policy = OneStepPolicy(6, DU, angles=(0, 1))

        def draw(n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
            return starts[torch.randint(8, (n,), generator=generator)], torch.randn(
                n, 2, generator=generator
            )

        model, options = new_model(), LearningOptions(horizon=12, iterations=2, episodes=3)
        learn_policy(policy.to(place), model.to(place), reward, draw, options)
        past = Segment(*(part[:4, :10].float() for part in seen))
        return policy, controller(policy, torch.zeros(4, 2))(past)

    (there, act), (here, expected) = on(device, learned), on(PROCESSOR, learned)
    assert agree(act, expected, device)
    for a, b in zip(there.cpu().parameters(), here.parameters(), strict=True):
        assert agree(a, b, device)


def test_a_model_and_a_prior_there_are_scored_as_they_are_here(device: str) -> None:
    case = MODELS["tsm"]
    test, validation = episodes(case, 4, seed=1), episodes(case, 4, seed=2)
    actions = torch.from_numpy(test.actions[:, :20])

    def scored(place: str) -> dict[str, Tensor]:
        model, prior, generator = (
            new_model().to(place),
            new_prior().float().to(place),
            torch.Generator().manual_seed(0),
        )
        return prediction.score(
            model, model.features, test, validation, samples=2, horizon=10
        ).values | {
            "sampled": sample_actions(prior, 2, 20, generator),
            "reconstructed": reconstruct(prior, actions),
        }

    there, here = on(device, scored), on(PROCESSOR, scored)
    for name, expected in here.items():
        assert agree(there[name], expected, device), name


def test_the_imitated_one_refuses_tensors_of_two_devices() -> None:
    with Accelerator():
        there, index, number = torch.ones(3).to(DEVICE), torch.tensor([0, 2]), torch.tensor(1.0)
        for on_it in (there + number, there[index]):
            assert on_it.device.type == DEVICE
        for mix in (
            lambda: there + torch.ones(3),
            lambda: there.index_select(0, index),
            lambda: torch.stack([there[0], number]),
        ):
            with pytest.raises(RuntimeError, match="a tensor of the processor"):
                mix()
        with pytest.raises(RuntimeError, match="a generator of the processor"):
            torch.randn(3, generator=torch.Generator(), device=DEVICE)
