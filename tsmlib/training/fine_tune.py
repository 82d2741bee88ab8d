"""Fine-tuning: a trained model adapted to a changed robot from few of its episodes (section 6).

all     every weight
head    the layers that give the increments of the state; all before them as they are
codes   the distribution of the codes, z = mean + deviation e with e ~ N(0, I): 2 dz numbers for
        each decoder, shared by all segments of the new robot; every weight as it is
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Literal

from torch import nn

from tsmlib.checks import require_choice, require_seed
from tsmlib.models.base import require_robot
from tsmlib.models.codes import CodeLayers, learned_codes
from tsmlib.storage.files import PathLike
from tsmlib.training.callbacks import Callback
from tsmlib.training.checkpoint import TrainingStopped
from tsmlib.training.fit import (
    Loss,
    TrainingHistory,
    TrainingOptions,
    checked,
    fit,
    fixed_windows,
    validate,
)
from tsmlib.trajectory import Trajectories

Part = Literal["all", "head", "codes"]
PARTS: tuple[Part, ...] = ("all", "head", "codes")


def fine_tune(
    model: nn.Module,
    data: Trajectories,
    validation: Trajectories | None = None,
    options: TrainingOptions | None = None,
    loss: Loss | None = None,
    *,
    part: Part = "all",
    seed: int = 0,
    device: str = "cpu",
    checkpoint: PathLike | None = None,
    progress: bool | str = True,
    callback: Callback | None = None,
) -> TrainingHistory:
    """Train ``part`` of a trained model on episodes of a changed robot (section 6).

    It begins with the model's weights and keeps the statistics of its features. The weights with
    the best validation loss are left in ``model``, those it began with among them, also where
    TrainingStopped is raised; no part stays frozen.

    Args:
        model: a trained model, or an action prior.
        data: episodes of the robot as it is now: another ``env``, the same states and actions.
        validation: held-out episodes; None for a tenth of ``data``, by episodes.
        options: windows and schedule; None for ``TrainingOptions()``.
        loss: (window, generator) -> a scalar tensor; None for ``model.loss``.
        part: "all", "head" or "codes", see above.
        seed: of windows and noise.
        device: where it is trained, such as "cuda"; the model comes back to the CPU.
        checkpoint: a folder of its own, from which a training that was stopped goes on.
        progress: whether to show a progress bar, or its title.
        callback: called with a ``Progress`` at every validation.

    Returns:
        The losses at every validation.

    Raises:
        ValueError: the model was never trained, has other states or actions than the data, or lacks
            the part; and as of ``fit``.
    """
    loss, train, validation, options = checked(model, data, validation, options, loss)
    require_choice("part", part, PARTS)
    if not getattr(getattr(model, "features", None), "fitted", True):
        raise ValueError(
            f"this {type(model).__name__} was never trained: it knows no statistics of its data. "
            "Load a trained one, or train it with tsmlib.fit"
        )
    what = "the model and data of its robot, changed,"
    require_robot(model, train.robot, what, but=("env",))
    first = {name: weight.detach().clone() for name, weight in model.state_dict().items()}
    held_out = fixed_windows(validation, *options.lengths)
    before = validate(loss, held_out, require_seed("seed", seed))
    robot = getattr(model, "robot", None)
    setattr(model, "robot", train.robot)  # noqa: B010 - of any module
    try:
        with _only(model, part):
            history = fit(
                model,
                train,
                validation,
                options,
                loss,
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
                "These were no better than the weights that it began with, which the model has "
                "again."
            )
        raise
    except BaseException:
        setattr(model, "robot", robot)  # noqa: B010
        raise
    if min(history.validation) >= before:
        model.load_state_dict(first)
    return history


@contextmanager
def _only(model: nn.Module, part: Part) -> Iterator[None]:
    """The model with gradients for ``part`` alone."""
    head = getattr(model, "output_layers", None)  # parts of its parameters' paths
    with ExitStack() as stack:
        if part == "head" and head is not None:
            stack.enter_context(frozen(model, but=head))
        elif part == "codes" and isinstance(model, CodeLayers):
            stack.enter_context(frozen(model))
            stack.enter_context(learned_codes(model))
        elif part != "all":
            has = (
                ["all"] + ["head"] * (head is not None) + ["codes"] * isinstance(model, CodeLayers)
            )
            raise ValueError(
                f"part is {part!r:.80}; of {type(model).__name__} one can train "
                f"{', '.join(map(repr, has))}"
            )
        yield


@contextmanager
def frozen(model: object, but: Sequence[str] = ()) -> Iterator[None]:
    """The model without gradients, but of parameters below the paths ``but``."""
    weights = dict(model.named_parameters()) if isinstance(model, nn.Module) else {}
    before = {name: weight.requires_grad for name, weight in weights.items()}
    try:
        for name, weight in weights.items():
            weight.requires_grad_(any(f"{name}.".startswith(f"{path}.") for path in but))
        yield
    finally:
        for name, weight in weights.items():
            weight.requires_grad_(before[name])
