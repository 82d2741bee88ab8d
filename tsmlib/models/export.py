"""A rollout as one graph without Python, for ``torch.export`` and ONNX."""

from __future__ import annotations

import copy
import importlib.util
import os
import sys
from pathlib import Path

import torch
from torch import Tensor, nn

from tsmlib.checks import require_count, require_type
from tsmlib.models.base import DynamicsModel, predict_segment
from tsmlib.models.layers import first_weight
from tsmlib.models.tsm import TSM
from tsmlib.trajectory import Segment

INPUTS = ("past_states", "past_actions", "actions")
NEEDED = ("onnx", "onnxscript")  # extra "onnx"


class Rollout(nn.Module):
    """The mode of ``tsmlib.rollout`` without its checks: past and actions (B, T, du) to states.

    Args:
        model: a dynamics model that is an ``nn.Module``.
    """

    def __init__(self, model: DynamicsModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, past_states: Tensor, past_actions: Tensor, actions: Tensor) -> Tensor:
        """States (B, T, dx) after a past (B, L, .), in physical units."""
        past, predicted = Segment(past_states, past_actions), []
        for moves in actions.split(self.model.segment_len, dim=1):
            past = past.last(self.model.past_len)
            states = self._segment(past, moves)
            predicted.append(states)
            past = past.then(Segment(states, moves))
        return torch.cat(predicted, dim=1)

    def _segment(self, past: Segment, moves: Tensor) -> Tensor:
        if not isinstance(self.model, TSM):
            return predict_segment(self.model, past, moves)
        step = self.model.begin(past)  # operations that can be traced
        return torch.stack([step(u) for u in moves.unbind(1)], dim=1)


@torch.no_grad()
def export(
    model: DynamicsModel, path: str | os.PathLike[str], *, steps: int = 50, rows: int = 1
) -> torch.export.ExportedProgram:
    """Write the mode of a rollout as a file for ONNX Runtime.

    Its inputs are ``past_states`` (B, L, dx) and ``past_actions`` (B, L, du), with L the model's
    ``past_len``, and ``actions`` (B, steps, du); its output is ``states`` (B, steps, dx), in
    physical units. All are float32.

    Args:
        model: a trained model of this package.
        path: ends in .onnx; or in .pt2, for ``torch.export.load``, which needs no extra.
        steps: length of the rollout.
        rows: B, such as the number of candidates of a search.

    Returns:
        The exported program, which torch runs.

    Raises:
        ImportError: the extra "onnx" is missing.
        ValueError: a name with another ending, or a model that torch cannot export.
        TypeError: a model that is no ``nn.Module``.
    """
    require_type("model", model, nn.Module, "a model of this package")
    path, steps = Path(path), require_count("steps", steps)
    rows = require_count("rows", rows)
    if path.suffix not in (".onnx", ".pt2"):
        raise ValueError(f"path is {path}; expected a name that ends in .onnx or .pt2")
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if path.suffix == ".onnx" and missing:
        raise ImportError(
            f"an .onnx file needs {', '.join(missing)}, missing here; type: {sys.executable} -m "
            f"pip install 'tsmlib[onnx]', or name {path.stem}.pt2"
        )
    weight = first_weight(model)
    dx, du = (int(str(model.config()[name])) for name in ("state_dim", "action_dim"))
    examples = tuple(
        torch.zeros(rows, length, size, device=None if weight is None else weight.device)
        for length, size in ((model.past_len, dx), (model.past_len, du), (steps, du))
    )
    graph = copy.deepcopy(Rollout(model)).eval().requires_grad_(False)
    try:
        program = torch.export.export(graph, examples)
    except Exception as error:  # of any kind, from within torch
        raise ValueError(
            f"a {type(model).__name__} cannot be exported ({error!s:.200}); a OneStep, LSTM, "
            "Egocentric, TSM and RecurrentTSM can"
        ) from error
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".pt2":
        torch.export.save(program, path)
    else:
        torch.onnx.export(
            program,
            f=path,
            input_names=INPUTS,
            output_names=["states"],
            external_data=False,
            optimize=False,
        )
    return program
