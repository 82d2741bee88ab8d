"""Muon (Jordan et al., 2024): momentum whose update of a weight matrix is orthogonalised.

Of the momentum G = U S V^T an update keeps U V^T, so that all directions of a layer are learned at
the same rate. torch.optim.Muon multiplies in bfloat16, which takes thirty times as long on
processors without such instructions; this one computes in the type of the weights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor, nn

# s -> a s + b s^3 + c s^5, the steepest at zero that still ends near 1
QUINTIC = (3.4445, -4.7750, 2.0315)
ITERATIONS = 5


def matrices(model: nn.Module) -> list[nn.Parameter]:
    """Weights of layers (out, in) and stacks (M, in, out), with two rows and columns or more.

    Neither kernels of convolutions nor what the model names in ``adam_only``, an optional tuple of
    its layers and parameters; ValueError where it has none of such a name.
    """
    named, spared = dict(model.named_parameters()), tuple(getattr(model, "adam_only", ()))
    for name in spared:
        if not any(f"{path}.".startswith(f"{name}.") for path in named):
            raise ValueError(
                f"adam_only of {type(model).__name__} names {name!r:.80}; expected a layer or "
                f"parameter of it, such as {', '.join(list(named)[:3])}"
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


def orthogonalised(matrix: Tensor) -> Tensor:
    """About U V^T of the singular values U S V^T of (..., n, m): they become 0.7 to 1.2."""
    a, b, c = QUINTIC
    tall = matrix.shape[-2] > matrix.shape[-1]
    x = matrix.mT if tall else matrix
    x = x / x.norm(dim=(-2, -1), keepdim=True).clamp(min=1e-7)
    for _ in range(ITERATIONS):
        gram = x @ x.mT
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x.mT if tall else x


class Muon(torch.optim.Optimizer):
    """Muon for weights (out, in), as of ``nn.Linear``, and stacks (M, in, out).

        M <- momentum M + (1 - momentum) G
        W <- W - lr sqrt(max(1, out / in)) orthogonalised(momentum M + (1 - momentum) G)

    Args:
        params: the weights.
        lr: learning rate.
        momentum: of the gradient G.
    """

    def __init__(self, params: Iterable[Tensor], lr: float, *, momentum: float = 0.95) -> None:
        super().__init__(params, dict(lr=lr, momentum=momentum))

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """One update of every weight that has a gradient."""
        for group in self.param_groups:
            lr, momentum = group["lr"], group["momentum"]
            for weight in group["params"]:
                if weight.grad is None:
                    continue
                state = self.state[weight]
                if not state:
                    state["momentum_buffer"] = torch.zeros_like(weight)
                mean = state["momentum_buffer"].lerp_(weight.grad, 1 - momentum)
                update = orthogonalised(weight.grad.lerp(mean, momentum))
                outputs, inputs = (weight if weight.ndim == 2 else weight.mT).shape[-2:]
                weight.add_(update, alpha=-lr * max(1.0, outputs / inputs) ** 0.5)
