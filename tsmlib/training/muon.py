"""Muon (Jordan et al., 2024): momentum whose update of a weight matrix is orthogonalised.

Of the momentum G = U S V^T an update keeps U V^T, so that all directions of a layer are learned at the same rate.
torch.optim.Muon multiplies in bfloat16, which takes thirty times as long on processors without such instructions; this
one computes in the type of the weights, and takes a stack of matrices as several.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

QUINTIC = (
    3.4445,
    -4.7750,
    2.0315,
)  # s -> a s + b s^3 + c s^5, the steepest at zero that still ends near 1


def matrices(model: nn.Module) -> list[nn.Parameter]:
    """Weights of linear and recurrent layers (out, in), and stacks of them (M, in, out), with two rows and columns.

    Neither kernels of convolutions nor what the model names in ``adam_only``, an optional tuple of its layers and
    parameters: ValueError where it has none of such a name.
    """
    named, spared = dict(model.named_parameters()), tuple(getattr(model, "adam_only", ()))
    for name in spared:
        if not any(f"{path}.".startswith(f"{name}.") for path in named):
            raise ValueError(
                f"adam_only of {type(model).__name__} names {name!r:.80}; expected a layer or parameter of it, such as "
                f"{', '.join(list(named)[:3])}"
            )
    kernels = {
        id(layer.weight) for layer in model.modules() if isinstance(layer, nn.modules.conv._ConvNd)
    }
    return [
        weight
        for path, weight in named.items()
        if weight.ndim in (2, 3)
        and min(weight.shape[-2:]) > 1
        and id(weight) not in kernels
        and not any(f"{path}.".startswith(f"{name}.") for name in spared)
    ]


def orthogonalised(matrix: Tensor, iterations: int = 5) -> Tensor:
    """About U V^T of the singular value decomposition U S V^T of (..., n, m): singular values from 0.7 to 1.2."""
    a, b, c = QUINTIC
    tall = matrix.shape[-2] > matrix.shape[-1]
    x = matrix.mT if tall else matrix
    x = x / x.norm(dim=(-2, -1), keepdim=True).clamp(min=1e-7)
    for _ in range(iterations):
        gram = x @ x.mT
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x.mT if tall else x


class Muon(torch.optim.Optimizer):
    """Muon for weights (out, in), as of ``nn.Linear``, and stacks (M, in, out), as of ``BatchedLinear``.

    copies: whether weights have a leading dimension of copies, (S, out, in) and (S, M, in, out), each of which is
    orthogonalised alone; a flag, since (S, out, in) looks like a stack. lr: a number, or a tensor, which a CUDA graph
    reads at each replay.

    M <- momentum M + (1 - momentum) G
    W <- (1 - lr weight_decay) W - lr sqrt(max(1, out / in)) orthogonalised(momentum M + (1 - momentum) G)
    """

    def __init__(
        self,
        params: Iterable[Tensor],
        lr: float | Tensor,
        *,
        momentum: float = 0.95,
        weight_decay: float = 0.0,
        copies: bool = False,
    ) -> None:
        super().__init__(params, dict(lr=lr, momentum=momentum, weight_decay=weight_decay))
        self.copies = copies

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """One update of every weight that has a gradient."""
        for group in self.param_groups:
            given = ((weight, weight.grad) for weight in group["params"])
            directions = [
                (w, self._direction(w, gradient, group))
                for w, gradient in given
                if gradient is not None
            ]
            for same in (
                _of_one_shape(directions) if self.copies else [[pair] for pair in directions]
            ):
                found = [direction for _, direction in same]
                updates = (
                    orthogonalised(torch.stack(found))
                    if self.copies
                    else [orthogonalised(found[0])]
                )
                for (weight, _), update in zip(same, updates, strict=True):
                    self._move(weight, update, group)

    def _move(self, weight: Tensor, update: Tensor, group: dict[str, Any]) -> None:
        outputs, inputs = (
            weight.shape[-2:] if weight.ndim == 2 + self.copies else weight.mT.shape[-2:]
        )
        scale = max(1.0, outputs / inputs) ** 0.5
        if group["weight_decay"]:
            weight.mul_(1 - group["lr"] * group["weight_decay"])
        if isinstance(group["lr"], Tensor):
            weight.sub_(update * (group["lr"] * scale))
        else:
            weight.add_(update, alpha=-group["lr"] * scale)

    def _direction(self, weight: Tensor, gradient: Tensor, group: dict[str, Any]) -> Tensor:
        """The momentum, moved on, and the gradient: what is to be orthogonalised."""
        state = self.state[weight]
        if not state:
            state["momentum_buffer"] = torch.zeros_like(weight)
        mean = state["momentum_buffer"].lerp_(gradient, 1 - group["momentum"])
        return gradient.lerp(mean, group["momentum"])


def _of_one_shape(pairs: list[tuple[Tensor, Tensor]]) -> list[list[tuple[Tensor, Tensor]]]:
    shapes = dict.fromkeys(weight.shape for weight, _ in pairs)
    return [[pair for pair in pairs if pair[0].shape == shape] for shape in shapes]
