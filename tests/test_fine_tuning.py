"""Fine-tuning: what is trained and what stays, the distribution of codes, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

import tsmlib
from tsmlib.models.codes import learned_codes
from tsmlib.models.layers import kl_from_standard_normal
from tsmlib.storage.artifacts import digest
from tsmlib.storage.files import StoreError
from tsmlib.training.checkpoint import TrainingStopped
from tsmlib.trajectory import Segment, initial_past

ARM, WEAK = "tsm/Reacher-v0", "tsm/Reacher-gain0.7-v0"
OPTIONS = tsmlib.TrainingOptions(
    past_len=10, future_len=10, steps=8, batch_size=32, validate_every=2, lr=3e-3, warmup=1
)
HEADS = {
    "rtsm": ("decoder.head",),
    "tsm": ("decoder.head",),
    "lstm": ("out",),
    "onestep": ("net.4",),
    "ensemble": ("weights.2", "biases.2"),
}


@cache
def data(env: str) -> tsmlib.Trajectories:
    return tsmlib.collect_random(env, 8, horizon=30)


def model(word: str) -> Any:
    made: dict[str, Callable[[], Any]] = {
        "rtsm": lambda: tsmlib.RecurrentTSM.for_data(data(ARM), hidden=8),
        "tsm": lambda: tsmlib.TSM.for_data(data(ARM), channels=8, dilations=(1, 2)),
        "lstm": lambda: tsmlib.LSTM.for_data(data(ARM), hidden=8),
        "onestep": lambda: tsmlib.OneStep.for_data(data(ARM), hidden=8, layers=2),
        "ensemble": lambda: tsmlib.Ensemble.for_data(data(ARM), hidden=8, layers=2),
    }
    return made[word]()


def tuned(net: Any, part: Any, **given: Any) -> tsmlib.Trajectories:
    weak, options = data(WEAK), replace(OPTIONS, past_len=net.past_len)
    given = {"progress": False, "part": part} | given
    tsmlib.fine_tune(net, weak.take(slice(2, None)), weak.take(slice(2)), options, **given)
    return weak


def changed(net: nn.Module, before: dict[str, torch.Tensor]) -> set[str]:
    return {
        name for name, weight in net.state_dict().items() if not torch.equal(weight, before[name])
    }


def copied(net: nn.Module) -> dict[str, torch.Tensor]:
    return {name: weight.clone() for name, weight in net.state_dict().items()}


@pytest.mark.parametrize("word", HEADS)
def test_the_head_is_trained_and_nothing_before_it(word: str) -> None:
    net = model(word)
    before = copied(net)
    tuned(net, "head")
    moved = changed(net, before)
    assert moved
    assert all(name.startswith(HEADS[word]) for name in moved)
    assert {name for name, _ in net.named_parameters() if name.startswith(HEADS[word])} == moved
    assert all(weight.requires_grad for weight in net.parameters())
    tuned(net, "all")
    assert not moved.issuperset(changed(net, before))


@pytest.mark.parametrize("word", ["rtsm", "tsm"])
def test_codes_are_all_that_is_fitted_and_the_model_stays_one_of_its_class(
    word: str, tmp_path: Path
) -> None:
    net = model(word)
    before = copied(net)
    tuned(net, "codes")
    moved = changed(net, before)
    assert {name.rpartition(".")[0].rpartition(".")[2] for name in moved} <= {
        "codes",
        "cell",
        "taps",
        "project",
    }
    assert any(name.endswith("codes.weight") for name in moved)
    for name in (name for name in moved if name.endswith("codes.weight")):
        ratio = net.state_dict()[name] / before[name]
        torch.testing.assert_close(
            ratio, ratio[:1].expand_as(ratio), rtol=1e-4, atol=1e-4
        )  # one number a dimension
    tsmlib.save_model(tmp_path / "tuned.safetensors", net)
    again = tsmlib.load_model(tmp_path / "tuned.safetensors", type(net))
    assert digest(again.state_dict()) == digest(net.state_dict())


def test_a_learned_distribution_is_another_code_of_the_same_decoder() -> None:
    net, window = model("tsm"), data(ARM)
    past = Segment(
        torch.from_numpy(window.states[:, :10]), torch.from_numpy(window.actions[:, :10])
    )
    actions, z = torch.from_numpy(window.actions[:, 10:20]), torch.randn(8, net.latent_dim)
    mean, deviation = torch.randn(net.latent_dim), torch.rand(net.latent_dim) + 0.5
    future = torch.from_numpy(window.states[:, 10:20])
    expected, (m, v) = net.decode(past, actions, mean + deviation * z), net.encode(future)
    with torch.no_grad(), learned_codes(net) as found:
        found.mean.copy_(mean)
        found.log_deviation.copy_(deviation.log())
    torch.testing.assert_close(net.decode(past, actions, z), expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(net.encode(future)[0] * deviation + mean, m, rtol=1e-4, atol=1e-5)
    against = torch.distributions.kl_divergence(
        torch.distributions.Normal(m, (v / 2).exp()), torch.distributions.Normal(mean, deviation)
    ).sum(1)
    torch.testing.assert_close(
        kl_from_standard_normal(*net.encode(future)), against, rtol=1e-3, atol=1e-3
    )


def test_codes_that_were_shifted_are_brought_back_by_data_of_the_decoder_itself() -> None:
    net, arm = tsmlib.RecurrentTSM.for_data(data(ARM), hidden=8), data(ARM)
    with torch.no_grad():
        net.decoder.codes.weight.mul_(5)  # so that a code says much
    past = initial_past(torch.from_numpy(arm.states[:, 0]), 10, 2)
    actions = torch.from_numpy(arm.actions)

    @torch.no_grad()
    def mode() -> torch.Tensor:
        return torch.cat([past.states[:, -1:], tsmlib.rollout(net, past, actions)], 1)

    expected = mode()
    drawn = replace(arm, states=expected.numpy())
    with torch.no_grad(), learned_codes(net) as codes:
        codes.mean.fill_(1.0)
    before = (mode() - expected).norm()
    options = tsmlib.TrainingOptions(
        10, 20, steps=80, batch_size=32, lr=0.1, warmup=1, validate_every=10
    )
    tsmlib.fine_tune(net, drawn, drawn, options, net.point_loss, part="codes", progress=False)
    assert (mode() - expected).norm() < 0.2 * before


def test_a_model_that_only_gets_worse_is_left_as_it_was() -> None:
    net = model("onestep")
    before = digest(net.state_dict())
    wild = replace(OPTIONS, past_len=1, lr=1.0, steps=4, validate_every=4)
    tsmlib.fine_tune(net, data(WEAK), data(WEAK), wild, progress=False)
    assert digest(net.state_dict()) == before


def test_a_fine_tuning_that_breaks_off_leaves_no_weights_worse_than_the_first() -> None:
    net, updates = model("rtsm"), 0
    before = digest(net.state_dict())

    def breaks_off(window: tsmlib.Window, generator: torch.Generator) -> torch.Tensor:
        nonlocal updates
        updates += (learning := torch.is_grad_enabled())
        return net.loss(window, generator) * (math.nan if learning and updates == 6 else 1)

    wild = replace(OPTIONS, lr=1.0)
    with pytest.raises(TrainingStopped, match="weights of step [24] are kept") as stopped:
        tsmlib.fine_tune(net, data(WEAK), data(WEAK), wild, breaks_off, progress=False)
    assert digest(net.state_dict()) == before
    assert "the weights that it began with" in stopped.value.__notes__[0]


def test_a_stopped_fine_tuning_goes_on_with_the_same_bits_and_not_as_another(
    tmp_path: Path,
) -> None:
    class Stopped(Exception):
        pass

    def stop(progress: tsmlib.Progress) -> None:
        if progress.step == 4:
            raise Stopped

    whole, again = model("rtsm"), model("rtsm")
    tuned(whole, "codes")
    with pytest.raises(Stopped):
        tuned(again, "codes", checkpoint=tmp_path, callback=stop)
    assert not any("parametrizations" in name for name in again.state_dict())
    with pytest.raises(StoreError, match="frozen"):
        tuned(model("rtsm"), "head", checkpoint=tmp_path)
    again = model("rtsm")
    tuned(again, "codes", checkpoint=tmp_path)
    assert digest(again.state_dict()) == digest(whole.state_dict())


def test_what_cannot_be_fine_tuned_is_refused() -> None:
    with pytest.raises(ValueError, match="part is 'codes'; of LSTM one can train 'all', 'head'"):
        tuned(model("lstm"), "codes")
    with pytest.raises(ValueError, match="never trained.*tsmlib.fit"):
        tuned(tsmlib.OneStep(6, 2, angles=(0, 1)), "all")
    push, net = data("tsm/ReacherPush-v1"), model("onestep")
    with pytest.raises(
        ValueError, match="the model and data of its robot, changed, are not of one robot: names is"
    ):
        tsmlib.fine_tune(net, push, push)


@pytest.mark.parametrize(("first", "then"), [("head", "all"), ("all", "head")])
def test_the_checkpoint_of_another_part_is_refused(tmp_path: Path, first: Any, then: Any) -> None:
    tuned(model("rtsm"), first, checkpoint=tmp_path / "run")
    with pytest.raises(StoreError, match="is the checkpoint of another run: .*frozen is "):
        tuned(model("rtsm"), then, checkpoint=tmp_path / "run")
