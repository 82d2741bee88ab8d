"""fit(): what training guarantees, whatever is trained. Small models on a made-up world."""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import rollout
from tsmlib.models.baselines import LSTM, OneStep
from tsmlib.models.ensemble import Ensemble
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.models.tsm import TSM
from tsmlib.storage import files
from tsmlib.training.callbacks import Callback, CsvCallback, Progress, TensorBoardCallback
from tsmlib.training.checkpoint import TrainingStopped, load_generation
from tsmlib.training.fit import (
    TrainingHistory,
    TrainingOptions,
    fit,
    fixed_windows,
    optimizers,
    schedule,
)
from tsmlib.trajectory import Robot, Trajectories, Window, batches, initial_past

H = 4
SIZES: dict[str, Any] = dict(
    past_len=H, future_len=H, steps=20, batch_size=8, validate_every=5, warmup=3
)


def episodes(n: int, seed: int) -> Trajectories:
    """States that drift with the actions and with some noise."""
    rng = np.random.default_rng(seed)
    actions = np.repeat(rng.uniform(-1, 1, (n, 6, 2)), 5, axis=1)
    steps = 0.2 * actions @ np.array([[1.0, 0.3, -0.5], [0.2, -1.0, 0.4]]) + 0.05 * rng.normal(
        size=(n, 30, 3)
    )
    states = np.concatenate([np.zeros((n, 1, 3)), steps.cumsum(1)], 1)
    return Trajectories(
        states.astype(np.float32),
        actions.astype(np.float32),
        "tsm/Made-v0",
        0.02,
        ("a", "b", "c"),
        ("rad", "m", "m"),
        (0,),
    )


TRAIN, HELD_OUT = episodes(30, 0), episodes(5, 1)


def new_tsm(seed: int = 0, **given: float) -> TSM:
    torch.manual_seed(seed)
    model = TSM(3, 2, angles=(0,), segment_len=H, channels=8, dilations=(1, 2), **given)
    model.take_robot(TRAIN)
    return model


def new_prior(seed: int = 0) -> ActionPrior:
    torch.manual_seed(seed)
    prior = ActionPrior(2, segment_len=H, channels=8, dilations=(1, 2))
    prior.take_robot(TRAIN)
    return prior


def new_rtsm(seed: int = 0) -> RecurrentTSM:
    torch.manual_seed(seed)
    model = RecurrentTSM(3, 2, angles=(0,), hidden=8, latent_dim=2, past_len=H, code_len=H)
    model.take_robot(TRAIN)
    return model


@pytest.mark.parametrize("dt", [0.125, 0.02])  # the steps of the second differ by rounding
def test_a_clock_goes_on_and_the_statistics_of_all_else_are_as_without_it(dt: float) -> None:
    clock = np.broadcast_to(dt * np.arange(31)[:, None], (30, 31, 1)).astype(np.float32)
    timed = replace(
        TRAIN,
        states=np.concatenate([TRAIN.states, clock], 2),
        names=("a", "b", "c", "time"),
        units=("",) * 4,
    )
    model, plain = OneStep.for_data(timed, hidden=8), OneStep.for_data(TRAIN, hidden=8)
    assert model.features.moving.all()
    assert torch.equal(model.features.step_std[:3], plain.features.step_std)
    torch.testing.assert_close(model.features.step_std[3], torch.tensor(dt), rtol=1e-3, atol=0)
    options = TrainingOptions(future_len=4, steps=60, batch_size=32, lr=1e-2, warmup=3)
    fit(model, timed, timed, options, progress=False)
    states = torch.from_numpy(timed.states)
    past = initial_past(states[:, 0], 1, 2)
    reached = rollout(model, past, torch.from_numpy(timed.actions[:, :10]))[:, -1, 3].detach()
    assert 7 * dt < float(reached.mean()) < 13 * dt, (
        reached.mean() / dt
    )  # it stood still, or ran away


def test_an_action_that_is_never_used_does_not_stop_the_training_of_the_prior() -> None:
    unused = replace(TRAIN, actions=TRAIN.actions * np.float32([1, 0]))
    prior = ActionPrior.for_data(unused, segment_len=H, channels=8, dilations=(1, 2))
    assert prior.std[1] == 1
    assert prior.std[0] == torch.from_numpy(TRAIN.actions).flatten(0, 1).std(0)[0]
    options = TrainingOptions(**SIZES | {"steps": 5})
    history = fit(prior, unused, unused, options, progress=False)
    assert math.isfinite(history.validation[-1])


def train(
    model: nn.Module, loss: Callable[..., Tensor] | None = None, **settings: Any
) -> TrainingHistory:
    own = {name: settings.pop(name) for name in TrainingOptions.__annotations__ if name in settings}
    options = TrainingOptions(**SIZES | own)
    return fit(model, TRAIN, HELD_OUT, options, loss, progress=False, **settings)


def weights(model: nn.Module) -> dict[str, Tensor]:
    return {name: tensor.clone() for name, tensor in model.state_dict().items()}


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


class Faulty:
    """The model's loss, except that call number ``at`` does something else."""

    def __init__(self, model: Any, at: int, instead: Callable[[Tensor], Tensor]) -> None:
        self.model, self.at, self.instead, self.calls = model, at, instead, 0
        self.__name__ = "loss"

    def __call__(self, window: Window, generator: torch.Generator) -> Tensor:
        value = self.model.loss(window, generator)
        if torch.is_grad_enabled():  # not a validation
            self.calls += 1
            if self.calls == self.at:
                return self.instead(value)
        return value


@pytest.mark.parametrize("made_for", [TSM, RecurrentTSM, OneStep, LSTM, Ensemble, ActionPrior])
def test_a_model_made_for_data_has_their_robot_and_weights_that_the_seed_alone_decides(
    made_for: Any,
) -> None:
    torch.manual_seed(5)
    one, later, other = (made_for.for_data(TRAIN, seed=seed) for seed in (0, 0, 1))
    assert torch.initial_seed() == 5  # the global generator is left alone
    assert one.robot == TRAIN.robot
    assert same(weights(one), weights(later))
    assert not same(weights(one), weights(other))
    if made_for is ActionPrior:
        std = torch.from_numpy(TRAIN.actions).flatten(0, 1).std(0)
        torch.testing.assert_close(one.std, std)
    else:
        states = one.features(torch.from_numpy(TRAIN.states)).flatten(0, 1)
        torch.testing.assert_close(states.std(0), torch.ones(4), atol=1e-3, rtol=0)


@pytest.mark.parametrize("new", [TSM, RecurrentTSM, OneStep, LSTM, Ensemble, ActionPrior])
def test_a_model_is_fitted_by_its_name_and_data_alone(new: Any) -> None:
    sizes = (2,) if new is ActionPrior else (3, 2)
    model = new(*sizes) if new is ActionPrior else new(*sizes, angles=(0,))
    options = TrainingOptions(steps=2, batch_size=4)
    curve = fit(model, TRAIN, options=options, progress=False)
    assert math.isfinite(curve.validation[-1])
    assert model.robot == TRAIN.robot
    again = new.for_data(TRAIN.split(0.9)[0])
    if new is ActionPrior:
        assert torch.equal(model.std, again.std)
    else:
        torch.testing.assert_close(model.features.state_dict(), again.features.state_dict())
        assert model.predict(HELD_OUT.states[:, 0], HELD_OUT.actions).shape == (5, 30, 3)


def test_the_window_of_a_short_episode_is_as_long_as_the_episode() -> None:
    short, options = TRAIN.cut(15), TrainingOptions()
    assert options.for_model(new_tsm(), TRAIN).future_len == 2 * H
    assert options.for_model(TSM.for_data(short), short).future_len == 10
    assert options.for_model(OneStep.for_data(short), short).future_len == 15
    assert options.for_model(new_tsm(), TRAIN).past_len == H
    few = TrainingOptions(steps=100)
    assert [o.for_model(new_tsm(), TRAIN).warmup for o in (options, few)] == [100, 10]


OTHER_ROBOTS = {
    "env": Robot("tsm/Other-v0", 0.02, ("a", "b", "c"), ("rad", "m", "m"), (0,), 2),
    "dt": Robot("tsm/Made-v0", 0.2, ("a", "b", "c"), ("rad", "m", "m"), (0,), 2),
    "names": Robot("tsm/Made-v0", 0.02, ("a", "b", "d"), ("rad", "m", "m"), (0,), 2),
    "angles": Robot("tsm/Made-v0", 0.02, ("a", "b", "c"), ("rad", "m", "m"), (), 2),
}


@pytest.mark.parametrize("field", OTHER_ROBOTS)
def test_a_model_its_data_and_held_out_data_are_of_one_robot(field: str) -> None:
    robot = OTHER_ROBOTS[field]
    meaning = (robot.env, robot.dt, robot.names, robot.units, robot.angles)
    other = Trajectories(TRAIN.states / 10, TRAIN.actions, *meaning)
    model = new_tsm()
    before = weights(model)
    for given in ((TRAIN, other), (other, other)):
        with pytest.raises(ValueError, match=f"not of one robot: {field} is .* and "):
            fit(model, *given)
    assert same(weights(model), before)


# What comes out ---------------------------------------------------------------------------------


@pytest.mark.parametrize("new", [new_tsm, new_prior])
def test_the_loss_goes_down(new: Callable[[], Any]) -> None:
    curve = train(new(), steps=60, lr=1e-2, validate_every=20)
    assert curve.step == [20, 40, 60]
    assert curve.train[-1] < 0.7 * curve.train[0]
    assert curve.validation[-1] < 0.7 * curve.validation[0]
    assert np.all(np.diff(curve.seconds) > 0)


def test_the_same_seed_gives_the_same_weights_and_another_seed_does_not() -> None:
    models = [new_tsm() for _ in range(3)]
    curves = [train(model, seed=seed) for model, seed in zip(models, (0, 0, 1), strict=True)]
    assert same(weights(models[0]), weights(models[1]))
    assert curves[0].validation == curves[1].validation
    assert not same(weights(models[0]), weights(models[2]))


def test_the_weights_with_the_best_validation_loss_are_kept() -> None:
    model = new_tsm()

    def worse_in_the_end(window: Window, generator: torch.Generator) -> Tensor:
        """A loss whose validation is best at the second of four."""
        value = model.loss(window, generator)
        if torch.is_grad_enabled():
            return value
        validations.append(weights(model))
        return torch.tensor([3.0, 1.0, 2.0, 1.0][len(validations) - 1])

    validations: list[dict[str, Tensor]] = []
    curve = train(model, worse_in_the_end)
    assert curve.validation == [3.0, 1.0, 2.0, 1.0]
    best = validations[1]
    assert same(weights(model), best)
    assert not same(best, validations[3])


def test_patience_stops_early() -> None:
    model = new_tsm()

    def never_better(window: Window, generator: torch.Generator) -> Tensor:
        value = model.loss(window, generator)
        return value if torch.is_grad_enabled() else torch.tensor(1.0)

    assert train(model, never_better, steps=400, patience=3).step == [5, 10, 15, 20]


def test_validation_uses_the_same_windows_every_time_from_all_over_the_data() -> None:
    first, second = (fixed_windows(HELD_OUT, H, H, n_windows=40) for _ in range(2))
    assert torch.equal(first.future.states, second.future.states)
    assert first.future.states.shape == (40, H, 3)
    assert fixed_windows(HELD_OUT, H, H).future.states.shape == (
        5 * 27,
        H,
        3,
    )  # every window there is
    assert torch.equal(first.past.states[0, 0], torch.from_numpy(HELD_OUT.states[0, 0]))
    assert torch.equal(first.future.states[-1, -1], torch.from_numpy(HELD_OUT.states[-1, -1]))


def test_the_learning_rate_warms_up_and_ends_at_its_final_value() -> None:
    rates = [schedule(step, 1000, 1e-3, 1e-5, 100) for step in range(1001)]
    assert rates[0] == pytest.approx(1e-5)
    assert max(rates) == rates[99] == rates[100] == pytest.approx(1e-3)
    assert np.all(np.diff(rates[:100]) > 0)
    assert np.all(np.diff(rates[100:]) < 0)
    assert rates[550] == pytest.approx((1e-3 + 1e-5) / 2)
    assert rates[1000] == pytest.approx(1e-5)


def test_trainings_that_follow_each_other_share_one_schedule() -> None:
    whole = [schedule(step, 1000, 1e-3, 1e-5, 0) for step in range(1001)]
    first = [schedule(step, 600, 1e-3, 1e-5, 0, (0.0, 0.6)) for step in range(600)]
    second = [
        schedule(step, 400, 1e-3, 1e-5, 50, (0.6, 1.0)) for step in range(401)
    ]  # no second warm-up
    assert first + second == pytest.approx(whole)
    warm = [schedule(step, 600, 1e-3, 1e-5, 100, (0.0, 0.6)) for step in range(601)]
    assert warm[99] == warm[100] == pytest.approx(1e-3)
    assert warm[600] == pytest.approx(second[0])


def test_without_muon_it_is_adam() -> None:
    model, plain, noise = new_tsm(), new_tsm(), torch.Generator()
    train(model, steps=5, validate_every=5, seed=2)
    optimizer = torch.optim.Adam(plain.parameters(), lr=1e-3, fused=True)
    draw = batches(TRAIN.tensors(), past_len=H, future_len=H, batch_size=8, generator=noise)
    for step in range(5):
        optimizer.param_groups[0]["lr"] = schedule(step, 5, 1e-3, 1e-5, 3)
        noise.manual_seed(2 * 1_000_003 + step)
        optimizer.zero_grad()
        plain.loss(next(draw), noise).backward()
        nn.utils.clip_grad_norm_(plain.parameters(), 1.0)
        optimizer.step()
    assert same(weights(model), weights(plain))


def test_muon_lowers_the_loss_and_leaves_adam_what_is_not_its_own() -> None:
    made = optimizers(new_tsm(), TrainingOptions(**SIZES, muon=0.02))
    held = {
        name: [p for group in optimizer.param_groups for p in group["params"]]
        for name, optimizer in made.items()
    }
    assert held.keys() == {"adam", "muon"}
    assert len(held["adam"]) + len(held["muon"]) == len(list(new_tsm().parameters()))
    assert min(p.ndim for p in held["muon"]) == 2
    curve = train(new_tsm(), steps=60, lr=1e-2, muon=0.1, validate_every=20)
    assert curve.validation[-1] < 0.7 * curve.validation[0]


# Stopped and resumed ----------------------------------------------------------------------------


class Interrupted(Exception):
    pass


def interrupt(_: Tensor) -> Tensor:
    raise Interrupted


GENERATIONS = {
    3: [],
    6: ["000000005"],
    13: ["000000005", "000000010"],
    17: ["000000010", "000000015"],
}


@pytest.mark.parametrize("new", [new_tsm, new_prior, new_rtsm])
@pytest.mark.parametrize("at", GENERATIONS)
@pytest.mark.parametrize("settings", [{}, {"muon": 0.02}, {"span": (0.6, 1.0)}], ids=str)
def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(
    tmp_path: Path, new: Callable[..., Any], settings: dict[str, Any], at: int
) -> None:
    whole, stopped, resumed, again = new(), new(), new(), new()
    expected = train(whole, **settings)
    checkpoint = tmp_path / "run"
    with pytest.raises(Interrupted):
        train(stopped, Faulty(stopped, at, interrupt), checkpoint=checkpoint, **settings)
    assert [path.stem for path in sorted(checkpoint.glob("*.safetensors"))] == GENERATIONS[at]
    counted = Faulty(resumed, 0, interrupt)
    curve = train(resumed, counted, checkpoint=checkpoint, **settings)
    assert counted.calls == 20 - max(
        map(int, GENERATIONS[at]), default=0
    )  # what was done is not done again
    assert same(weights(resumed), weights(whole))
    assert (curve.step, curve.train, curve.validation) == (
        expected.step,
        expected.train,
        expected.validation,
    )
    assert asdict(train(again, checkpoint=checkpoint, **settings)) == asdict(
        curve
    )  # finished: nothing is left to do
    assert same(weights(again), weights(whole))


# Callbacks --------------------------------------------------------------------------------------


def lines(path: Path) -> list[dict[str, float]]:
    return [
        {name: float(text) for name, text in line.items()}
        for line in csv.DictReader(path.open(newline=""))
    ]


def test_a_callback_sees_every_record_and_leaves_the_bits_alone() -> None:
    alone, watched, seen = new_tsm(), new_tsm(), list[Progress]()

    def watch(progress: Progress) -> None:
        torch.rand(3), np.random.default_rng().random(3)
        seen.append(progress)

    expected, curve = train(alone), train(watched, callback=watch)
    assert same(weights(watched), weights(alone))
    assert (curve.train, curve.validation) == (expected.train, expected.validation)
    assert [(one.step, one.seconds) for one in seen] == list(
        zip(curve.step, curve.seconds, strict=True)
    )
    assert [one.values["train"] for one in seen] == curve.train
    assert [one.values["validation"] for one in seen] == curve.validation


@pytest.mark.parametrize("at", [3, 6, 13])
def test_a_resumed_training_has_every_step_once_in_its_table(tmp_path: Path, at: int) -> None:
    table, model, checkpoint = (
        CsvCallback(tmp_path / "logs" / "losses.csv"),
        new_tsm(),
        tmp_path / "run",
    )
    with pytest.raises(Interrupted):
        train(model, Faulty(model, at, interrupt), checkpoint=checkpoint, callback=table)
    curve = train(new_tsm(), checkpoint=checkpoint, callback=CsvCallback(table.path))
    assert list(lines(table.path)[0]) == ["step", "seconds", "train", "validation"]
    assert [line["step"] for line in lines(table.path)] == curve.step == [5, 10, 15, 20]
    assert [line["validation"] for line in lines(table.path)] == curve.validation


def interrupted_after(callback: Callback, checkpoint: Path) -> None:
    """A training that is stopped at step 10, after the callback and before its checkpoint."""

    def stop(progress: Progress) -> None:
        callback(progress)
        if progress.step == 10:
            raise Interrupted

    with pytest.raises(Interrupted):
        train(new_tsm(), checkpoint=checkpoint, callback=stop)


def test_a_table_of_other_columns_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.csv").write_text("name,value\na,1\n")
    with pytest.raises(
        files.StoreError,
        match=r"mine.csv has the columns name, value; expected step, seconds, train",
    ):
        train(new_tsm(), callback=CsvCallback(tmp_path / "mine.csv"))
    assert (tmp_path / "mine.csv").read_text() == "name,value\na,1\n"


def test_tensorboard_shows_every_step_of_a_resumed_training_once(tmp_path: Path) -> None:
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    board, checkpoint = TensorBoardCallback(tmp_path / "board"), tmp_path / "run"

    interrupted_after(board, checkpoint)
    curve = train(
        new_tsm(), checkpoint=checkpoint, callback=TensorBoardCallback(tmp_path / "board")
    )
    shown = accumulator.EventAccumulator(str(tmp_path / "board")).Reload()
    assert set(shown.Tags()["scalars"]) == {"train", "validation", "seconds"}
    assert [event.step for event in shown.Scalars("validation")] == curve.step
    assert np.allclose([event.value for event in shown.Scalars("validation")], curve.validation)


def test_without_tensorboard_its_callback_names_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    monkeypatch.delitem(sys.modules, "torch.utils.tensorboard", raising=False)
    with pytest.raises(ImportError, match=r'pip install "tsmlib\[tensorboard\]"'):
        TensorBoardCallback("board")


OTHER_RUNS: dict[str, tuple[dict[str, Any], str]] = {
    "seed": ({"seed": 3}, "seed is 0 in the file, expected 3"),
    "lr": ({"lr": 5e-4}, "lr is 0.001 in the file, expected 0.0005"),
    "steps": ({"steps": 50}, "steps is 20 in the file, expected 50"),
    "clip": ({"clip": math.inf}, "clip is 1.0 in the file, expected 'inf'"),
    "future": ({"future_len": 2 * H}, "future_len is 4 in the file, expected 8"),
    "muon": ({"muon": 0.02}, "muon is 0.0 in the file, expected 0.02"),
    "span": ({"span": (0.6, 1.0)}, r"span is \[0.0, 1.0\] in the file, expected \[0.6, 1.0\]"),
}


@pytest.mark.parametrize("field", OTHER_RUNS)
def test_a_checkpoint_of_another_run_is_refused_naming_what_differs(
    tmp_path: Path, field: str
) -> None:
    other, message = OTHER_RUNS[field]
    train(new_tsm(), checkpoint=str(tmp_path / "run"))
    content, model = folder_bytes(tmp_path / "run"), new_tsm()
    before = weights(model)
    expected = f"run/.*safetensors is the checkpoint of another run: .*{message}.* Delete"
    with pytest.raises(files.StoreError, match=expected):
        train(model, checkpoint=tmp_path / "run", **other)
    assert folder_bytes(tmp_path / "run") == content
    assert same(weights(model), before)


def scaled(model: TSM, scale: float) -> Callable[..., Tensor]:
    return lambda window, generator: scale * model.loss(window, generator)


def test_a_loss_is_known_by_what_it_gives_and_not_by_its_name(tmp_path: Path) -> None:
    first, same_loss, other = new_tsm(), new_tsm(), new_tsm()
    train(first, scaled(first, 1.0), checkpoint=tmp_path / "run")
    assert train(same_loss, same_loss.loss, checkpoint=tmp_path / "run").step == [5, 10, 15, 20]
    message = "another run: loss of the first weights is .* in the file, expected -"
    with pytest.raises(files.StoreError, match=message):
        train(other, scaled(other, -100.0), checkpoint=tmp_path / "run")


@pytest.mark.parametrize("new", [lambda: new_tsm(seed=7), lambda: new_tsm(beta=0.5)])
def test_a_checkpoint_of_another_model_is_refused(tmp_path: Path, new: Callable[[], TSM]) -> None:
    train(new_tsm(), checkpoint=tmp_path / "run")
    with pytest.raises(
        files.StoreError, match=r"another run: .*(began with|configuration\.beta) is "
    ):
        train(new(), checkpoint=tmp_path / "run")


def test_a_checkpoint_of_other_data_is_refused(tmp_path: Path) -> None:
    model, options = new_tsm(), TrainingOptions(**SIZES)
    train(model, checkpoint=tmp_path / "run")
    with pytest.raises(files.StoreError, match="episodes is 30 in the file, expected 20; data is"):
        fit(new_tsm(), TRAIN.take(slice(20)), HELD_OUT, options, checkpoint=tmp_path / "run")


def folder_bytes(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# What goes wrong --------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_the_first_loss_that_is_not_finite_stops_training_and_keeps_the_best_weights(
    tmp_path: Path, value: float
) -> None:
    kept, model = new_tsm(), new_tsm()
    with pytest.raises(Interrupted):
        train(kept, Faulty(kept, 12, interrupt), checkpoint=tmp_path / "kept")
    found = load_generation(tmp_path / "kept")
    assert found is not None
    _, tensors, header = found
    best = {
        name.removeprefix("best."): t for name, t in tensors.items() if name.startswith("best.")
    }
    faulty, kept_step = Faulty(model, 14, lambda loss: loss * value), header["best_step"]
    message = (
        rf"training loss became {value} at step 13 of 20; the weights of step {kept_step} are "
        "kept.*smaller lr"
    )
    with pytest.raises(TrainingStopped, match=message):
        train(model, faulty)
    assert faulty.calls == 14
    assert same(weights(model), best)


@pytest.mark.parametrize("at", [10, 12])
def test_a_gradient_that_is_not_finite_never_reaches_the_weights(tmp_path: Path, at: int) -> None:
    model, checkpoint = new_tsm(), tmp_path / "run"
    first = next(model.parameters())
    with pytest.raises(
        TrainingStopped,
        match=f"the gradient became nan at step {at - 1} of 20; the weights of step",
    ):
        train(model, Faulty(model, at, lambda loss: loss + _cliff(first)), checkpoint=checkpoint)
    assert all(torch.isfinite(p).all() for p in model.parameters())
    assert load_generation(checkpoint) is not None  # the last good one is still there


def _cliff(parameter: Tensor) -> Tensor:
    """Zero, with an infinite slope."""
    return (parameter - parameter.detach()).abs().sum().sqrt()


@pytest.mark.parametrize(
    ("new", "future_len", "better"), [(new_tsm, 6, 4), (new_tsm, 3, 4), (new_prior, 6, 4)]
)
def test_a_future_of_no_whole_number_of_segments_is_refused(
    new: Any, future_len: int, better: int
) -> None:
    message = f"future_len is {future_len}, .* whole number of segments of 4; choose {better}, or"
    with pytest.raises(ValueError, match=message):
        train(new(), future_len=future_len)
