"""Fine-tuning: a trained model adapted to a changed robot from few of its episodes (section 6, future work).

all     every weight
head    the layers that give the increments of the state; all before them as they are
codes   the distribution of the codes, z = mean + deviation e with e ~ N(0, I): 2 dz numbers for each decoder,
        shared by all segments of the new robot; every weight as it is
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

from torch import nn

from tsmlib.models.codes import CodeLayers, learned_codes
from tsmlib.models.features import Features, require_robot
from tsmlib.training.callbacks import Callback
from tsmlib.training.checkpoint import TrainingStopped
from tsmlib.training.fit import Loss, TrainingHistory, TrainingOptions, fit, fixed_windows, validate
from tsmlib.trajectory import Trajectories

Part = Literal["all", "head", "codes"]
PARTS: tuple[Part, ...] = ("all", "head", "codes")


@runtime_checkable
class Headed(Protocol):
    """A model that names, as parts of its parameters' paths, the layers that give its increments."""

    output_layers: tuple[str, ...]


def fine_tune(
    model: nn.Module,
    loss: Loss,
    train: Trajectories,
    validation: Trajectories,
    options: TrainingOptions,
    *,
    part: Part = "all",
    seed: int = 0,
    device: str = "cpu",
    checkpoint: Path | None = None,
    progress: str = "",
    callback: Callback | None = None,
) -> TrainingHistory:
    """Train ``part`` of a trained ``model`` on episodes of a changed robot; everything else as in ``fit``.

    It begins with the model's weights and keeps the statistics of its features, for which they were made. The weights
    with the best validation loss are left in ``model``, those it began with among them, also where TrainingStopped is
    raised; no part stays frozen. ValueError for a model that was never trained, has other states, angles or actions
    than the data, or lacks the part.
    """
    _require_trained(model, train)
    first = {name: weight.detach().clone() for name, weight in model.state_dict().items()}
    held_out = fixed_windows(validation, options.past_len, options.future_len)
    before = validate(loss, held_out, seed)
    try:
        with _only(model, part):
            history = fit(
                model,
                loss,
                train,
                validation,
                options,
                seed=seed,
                device=device,
                checkpoint=checkpoint,
                progress=progress,
                callback=callback,
            )
    except TrainingStopped as stopped:
        if not validate(loss, held_out, seed) < before:
            model.load_state_dict(first)
            stopped.add_note(
                "These were no better than the weights that it began with, which the model has again."
            )
        raise
    if min(history.validation) >= before:
        model.load_state_dict(first)
    return history


@contextmanager
def _only(model: nn.Module, part: Part) -> Iterator[None]:
    """The model with gradients for ``part`` alone."""
    with ExitStack() as stack:
        if part == "all":
            pass
        elif part == "head" and isinstance(model, Headed):
            stack.enter_context(_frozen(model, but=model.output_layers))
        elif part == "codes" and isinstance(model, CodeLayers):
            stack.enter_context(_frozen(model))
            stack.enter_context(learned_codes(model))
        else:
            has = [
                name
                for name, kind in (("head", Headed), ("codes", CodeLayers))
                if isinstance(model, kind)
            ]
            raise ValueError(
                f"part is {part!r:.80}; of {type(model).__name__} one can train {', '.join(map(repr, ['all', *has]))}"
            )
        yield


@contextmanager
def _frozen(model: nn.Module, but: Sequence[str] = ()) -> Iterator[None]:
    """The model without gradients, but of parameters below the paths ``but``."""
    before = {name: weight.requires_grad for name, weight in model.named_parameters()}
    try:
        for name, weight in model.named_parameters():
            weight.requires_grad_(any(f"{name}.".startswith(f"{path}.") for path in but))
        yield
    finally:
        for name, weight in model.named_parameters():
            weight.requires_grad_(before[name])


def _require_trained(model: nn.Module, data: Trajectories) -> None:
    features = getattr(model, "features", None)
    if not isinstance(features, Features):
        return
    if not features.fitted:
        raise ValueError(
            f"this {type(model).__name__} was never trained: it knows no statistics of its data. Load a trained one, "
            "or train it with tsmlib.fit"
        )
    require_robot(model, data, "data of the same robot, changed")
