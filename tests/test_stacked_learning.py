"""Policies of several seeds, learned as one, are each what ``learn_policy`` makes of it alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from untrained import in_units

from tsmlib import study
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.baselines import LSTM, OneStep
from tsmlib.models.ensemble import Ensemble
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.models.tsm import TSM
from tsmlib.policies.learning import Draw, LearningCurve, LearningOptions, episodes_from, learn_policy
from tsmlib.policies.networks import OneStepPolicy, Policy, SegmentPolicy
from tsmlib.policies.stacked import learn_stacked
from tsmlib.rewards import Reward
from tsmlib.study import policies as study_policies
from tsmlib.study import runs
from tsmlib.training.checkpoint import TrainingStopped
from tsmlib.trajectory import Segment

DX, DU, H = 5, 2, 4
SEEDS = (10, 20)
ANGLES = (1,)  # not first, as on an arm
OPTIONS = LearningOptions(horizon=9, episodes=3, iterations=6, record_every=2, lr=1e-2)
SMALL: dict[str, Any] = dict(segment_len=H, channels=8, dilations=(1, 2, 1))
MODELS: dict[str, Any] = {
    "tsm": lambda: TSM(DX, DU, angles=ANGLES, **SMALL),
    "onestep": lambda: OneStep(DX, DU, angles=ANGLES, hidden=8, layers=1),
    "lstm": lambda: LSTM(DX, DU, angles=ANGLES, hidden=8, past_len=H, segment_len=8),
    "rtsm": lambda: RecurrentTSM(DX, DU, angles=ANGLES, hidden=8, latent_dim=3, past_len=H, code_len=H, segment_len=8),
}
KINDS = ("onestep", "segment")


def arrive(target: Tensor) -> Reward:
    return lambda states, actions: -(states[..., 2:4] - target[:, None]).square().sum(-1)


def models(word: str) -> list[Any]:
    """Of other weights and other statistics."""
    made = []
    for seed in SEEDS:
        torch.manual_seed(seed)
        net = in_units(MODELS[word]())
        net.features.step_std.fill_(0.1 + seed / 1000)
        made.append(net)
    return made


def policies(kind: str) -> list[Any]:
    made: list[Policy] = []
    for seed in SEEDS:
        options: dict[str, Any] = dict(angles=ANGLES, copies=2, seed=seed)
        torch.manual_seed(seed)
        if kind == "onestep":
            made.append(OneStepPolicy(DX, DU, hidden=8, **options))
        else:
            prior = ActionPrior(DU, latent_dim=3, **SMALL)
            made.append(SegmentPolicy(DX, prior, channels=8, dilations=(1, 2), **options))
    return made


def draws() -> list[Draw]:
    starts = torch.Generator().manual_seed(0)
    return [episodes_from(torch.randn(20, DX, generator=starts)) for _ in SEEDS]


def alone(kind: str, word: str, options: LearningOptions = OPTIONS, **given: Any) -> tuple[list[Any], list[Any]]:
    learned = policies(kind)
    curves = [
        learn_policy(policy, model, arrive, draw, options, seed=seed, **{name: of[k] for name, of in given.items()})
        for k, (policy, model, draw, seed) in enumerate(zip(learned, models(word), draws(), SEEDS, strict=True))
    ]
    return learned, curves


def together(
    kind: str, word: str, options: LearningOptions = OPTIONS, device: str = "cpu", **given: Any
) -> tuple[list[Any], list[Any]]:
    learned, nets = [policy.to(device) for policy in policies(kind)], [net.to(device) for net in models(word)]
    curves = learn_stacked(learned, nets, arrive, draws(), options, seeds=SEEDS, **given)
    return [policy.cpu() for policy in learned], curves


def assert_same(one: tuple[list[Any], list[LearningCurve]], other: tuple[list[Any], list[LearningCurve]]) -> None:
    for a, b in zip(one[1], other[1], strict=True):
        assert a.iteration == b.iteration
        torch.testing.assert_close(torch.tensor(b.predicted), torch.tensor(a.predicted), rtol=1e-4, atol=1e-4)
    for a, b in zip(one[0], other[0], strict=True):
        for name, weight in a.state_dict().items():
            torch.testing.assert_close(b.state_dict()[name], weight, rtol=1e-3, atol=1e-4, msg=name)


@pytest.mark.parametrize("word", MODELS)
@pytest.mark.parametrize("kind", KINDS)
def test_each_of_several_policies_learns_what_it_learns_alone(kind: str, word: str) -> None:
    before = policies(kind)
    found = together(kind, word)
    assert_same(alone(kind, word), found)
    assert all(not torch.equal(a.net[0].weight, b.net[0].weight) for a, b in zip(before, found[0], strict=True)
               if kind == "onestep")  # fmt: skip
    assert found[1][0].predicted != found[1][1].predicted


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("word", MODELS)
@pytest.mark.parametrize("kind", KINDS)
def test_on_a_gpu_it_learns_the_same(kind: str, word: str) -> None:
    assert_same(alone(kind, word), together(kind, word, device="cuda"))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("word", MODELS)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.filterwarnings("error:.*is not captured")
def test_models_of_arms_are_captured_as_cuda_graphs(kind: str, word: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "ANGLES", (0, 1))
    assert_same(alone(kind, word), together(kind, word, device="cuda"))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_model_that_no_cuda_graph_holds_says_so() -> None:
    with pytest.warns(UserWarning, match="LSTM is not captured"):
        together("onestep", "lstm", device="cuda")


def test_each_copys_gradient_is_shortened_by_its_own_norm() -> None:
    options = replace(OPTIONS, clip=1e-3)
    assert_same(alone("onestep", "rtsm", options), together("onestep", "rtsm", options))


@pytest.mark.parametrize("then", [alone, together])
@pytest.mark.parametrize("first", [alone, together])
def test_what_was_stopped_goes_on_together_or_alone(first: Any, then: Any, tmp_path: Path) -> None:
    def stop_at_4(policy: Policy) -> dict[str, Tensor]:
        asked.append(policy)
        if len(asked) > limit:
            raise KeyboardInterrupt
        return {"one": torch.ones(2)}

    def given(way: Any) -> dict[str, Any]:
        measures, places = [stop_at_4, stop_at_4], [tmp_path / str(seed) for seed in SEEDS]
        if way is alone:
            return {"measure": measures, "checkpoint": places}
        return {"measures": measures, "checkpoints": places}

    asked, limit = list[Policy](), 4 if first is together else 2
    with pytest.raises(KeyboardInterrupt):
        first("segment", "lstm", **given(first))
    limit = 1000
    found = then("segment", "lstm", **given(then))
    assert_same(alone("segment", "lstm"), found)
    assert found[1][0].measured["one"] == [[1.0, 1.0]] * 4
    assert [curve.policies for curve in found[1]] == [1 if first is then is alone else 2] * 2


def test_a_policy_that_had_come_less_far_joins_the_others(tmp_path: Path) -> None:
    places, shorter = [tmp_path / str(seed) for seed in SEEDS], list[int]()

    def stop_at_2(policy: Policy) -> dict[str, Tensor]:
        shorter.append(1)
        if len(shorter) > 2:
            raise KeyboardInterrupt
        return {}

    with pytest.raises(KeyboardInterrupt):
        learn_policy(
            policies("onestep")[0], models("rtsm")[0], arrive, draws()[0], OPTIONS, seed=SEEDS[0], measure=stop_at_2,
            checkpoint=places[0],
        )  # fmt: skip
    assert_same(alone("onestep", "rtsm"), together("onestep", "rtsm", checkpoints=places))


def test_where_one_fails_all_stop_with_the_weights_of_their_last_record() -> None:
    usual, calls = draws(), list[int]()

    def far_away(n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        calls.append(n)
        start, target = usual[1](n, generator)
        return (start + torch.inf if len(calls) > 10 else start), target  # from iteration 3 on, of two copies

    learned = policies("onestep")
    with pytest.raises(TrainingStopped, match="seed 20: the model predicts states that are not finite at iteration 3"):
        learn_stacked(learned, models("rtsm"), arrive, [usual[0], far_away], OPTIONS, seeds=SEEDS)
    after_2 = alone("onestep", "rtsm", replace(OPTIONS, iterations=2))[0]
    for a, b in zip(learned, after_2, strict=True):
        for name, weight in b.state_dict().items():
            torch.testing.assert_close(a.state_dict()[name], weight, rtol=1e-3, atol=1e-4)


class Whole(torch.nn.Module):
    """A model of whole segments."""

    segment_len = past_len = 1

    def predict_segment(self, past: Segment, actions: Tensor) -> Tensor:
        return past.states[:, -1:]


def test_what_cannot_be_one_of_several_is_refused() -> None:
    learned, given = policies("onestep"), models("onestep")
    with pytest.raises(ValueError, match="found 2 policies, 1 models, 2 draws, 2 seeds, 2 measures, 2 checkpoints"):
        learn_stacked(learned, given[:1], arrive, draws(), OPTIONS, seeds=SEEDS)
    members: list[Any] = [in_units(Ensemble(DX, DU, members=2, hidden=4, layers=1)) for _ in SEEDS]
    for others, name in ((members, "Ensemble"), ([Whole(), Whole()], "Whole")):
        with pytest.raises(ValueError, match=f"a {name} cannot be one of several models; learn in it by learn_policy"):
            learn_stacked(learned, others, arrive, draws(), OPTIONS, seeds=SEEDS)
    with pytest.raises(ValueError, match="the reward has no gradient"):
        learn_stacked(learned, given, lambda _: lambda x, u: x[..., 0].sign().detach(), draws(), OPTIONS, seeds=SEEDS)


@pytest.mark.parametrize(("name", "value"), [("target_std", 0.5), ("copies", 3), ("hidden", 4)])
def test_policies_that_are_not_alike_are_refused_naming_what_differs(name: str, value: float) -> None:
    options: dict[str, Any] = dict(angles=ANGLES, copies=2, hidden=8) | {name: value}
    learned = [policies("onestep")[0], OneStepPolicy(DX, DU, **options)]
    with pytest.raises(ValueError, match="OneStepPolicys that are stacked must be alike; found .* and "):
        learn_stacked(learned, models("onestep"), arrive, draws(), OPTIONS, seeds=SEEDS)


def test_models_that_are_not_alike_are_refused_naming_what_differs() -> None:
    longer = in_units(LSTM(DX, DU, angles=ANGLES, hidden=8, past_len=H, segment_len=9))
    with pytest.raises(ValueError, match="LSTMs that are stacked must be alike; found segment_len 8 and 9"):
        learn_stacked(policies("onestep"), [models("lstm")[0], longer], arrive, draws(), OPTIONS, seeds=SEEDS)
    with pytest.raises(ValueError, match="found class 'LSTM' and 'OneStep'"):
        learn_stacked(
            policies("onestep"), [models("lstm")[0], models("onestep")[0]], arrive, draws(), OPTIONS, seeds=SEEDS
        )


def test_policies_of_several_runs_are_learned_as_one_and_found_by_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = [runs.resolve("05_control", scale="smoke", seed=seed, run_dir=str(tmp_path)) for seed in (1, 2)]
    task, method = study.load_task("tsm/Reacher-v0").take(3), study.method("onestep", "direct", "policy")
    made = study_policies.learn_as_one(own, task, method, study.Budget(copies=2))
    monkeypatch.setattr(study_policies, "learn_policy", None)
    monkeypatch.setattr(study_policies, "learn_stacked", None)
    for run, (policy, header) in zip(own, made, strict=True):
        found = study.learn(run, task, method, study.Budget(copies=2))
        assert (header["seed"], found.header["seed"], header["curve"]["policies"]) == (run.seed, run.seed, 2)
        kept, had = found.policy.state_dict(), policy.state_dict()
        assert all(torch.equal(kept[name], had[name]) for name in kept)
    again = study_policies.learn_as_one(own, task, method, study.Budget(copies=2))
    assert [one.header["seed"] for one in again] == [1, 2]


def test_policies_that_cannot_learn_as_one_learn_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise ValueError("no such model")

    own = [runs.resolve("05_control", scale="smoke", seed=seed, run_dir=str(tmp_path)) for seed in (1, 2)]
    task, method = study.load_task("tsm/Reacher-v0").take(3), study.method("onestep", "direct", "policy")
    monkeypatch.setattr(study_policies, "learn_stacked", refuse)
    made = study_policies.learn_as_one(own, task, method)
    told = capsys.readouterr().out
    assert "the direct policy in onestep of seeds 1, 2 is not made as one, but one by one: no such model" in told
    assert [(one.header["curve"]["policies"], one.header["seed"]) for one in made] == [(1, 1), (1, 2)]
    with pytest.raises(ValueError, match="found runs of smoke 1 on cpu, smoke 1 on cpu; expected different seeds"):
        study_policies.learn_as_one([own[0], own[0]], task, method)
