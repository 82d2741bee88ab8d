"""Codes whose distribution is learned: P(Z) = N(mean, deviation^2) in place of N(0, I).

A decoder knows a code by V z alone, which it adds to the pre-activations of its layers, so that
z = mean + deviation e is the same decoder with other numbers: V diag(deviation) in place of V, and
V mean more in the biases. A model that was adapted in this way is a model of its class like any
other, with e ~ N(0, I) as its codes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize


@runtime_checkable
class CodeLayers(Protocol):
    """A model with codes.

    Attributes:
        code_layers: V, without a bias, and the layers to whose outputs V z is added, in the
            order of its rows.
        code_statistics: the layer of an encoder's means and log variances; None without an encoder.
    """

    code_statistics: nn.Linear | None

    @property
    def code_layers(self) -> tuple[nn.Linear, Sequence[nn.Linear]]: ...


class CodeDistribution(nn.Module):
    """N(mean, diag(exp(2 log_deviation))) of codes, at first N(0, I)."""

    def __init__(self, latent_dim: int) -> None:
        super().__init__()
        self.mean, self.log_deviation = (nn.Parameter(torch.zeros(latent_dim)) for _ in range(2))


class _Scaled(nn.Module):
    """V -> V diag(deviation)."""

    def __init__(self, codes: CodeDistribution) -> None:
        super().__init__()
        self.codes = codes

    def forward(self, weight: Tensor) -> Tensor:
        return weight * self.codes.log_deviation.exp()


class _Shifted(nn.Module):
    """b -> b + V mean. rows: those of V (out, dz) that this layer's outputs meet."""

    rows: Tensor

    def __init__(self, codes: CodeDistribution, rows: Tensor) -> None:
        super().__init__()
        self.codes = codes
        self.register_buffer("rows", rows.detach().clone())

    def forward(self, bias: Tensor) -> Tensor:
        return bias + self.rows @ self.codes.mean


class _Standardised(nn.Module):
    """Weights (2 dz, ...) of an encoder's means m and log variances v -> of the same posterior.

    That is (m - mean) / deviation and v - 2 log deviation.
    """

    def __init__(self, codes: CodeDistribution) -> None:
        super().__init__()
        self.codes = codes

    def forward(self, rows: Tensor) -> Tensor:
        means, log_variances = rows.chunk(2)
        log_deviation = self.codes.log_deviation
        if rows.ndim == 2:
            return torch.cat([means / log_deviation.exp()[:, None], log_variances])
        return torch.cat(
            [(means - self.codes.mean) / log_deviation.exp(), log_variances - 2 * log_deviation]
        )


@contextmanager
def learned_codes(model: CodeLayers) -> Iterator[CodeDistribution]:
    """Make the distribution of codes parameters of ``model``, and undo it at the end."""
    changed: list[tuple[nn.Module, str]] = []
    codes, layers = model.code_layers
    found = CodeDistribution(codes.in_features).to(codes.weight)

    def change(layer: nn.Module, name: str, by: nn.Module) -> None:
        parametrize.register_parametrization(layer, name, by)
        changed.append((layer, name))

    try:
        rows = codes.weight.split([layer.out_features for layer in layers])
        for layer, own in zip(layers, rows, strict=True):
            change(layer, "bias", _Shifted(found, own))
        change(codes, "weight", _Scaled(found))
        if model.code_statistics is not None:
            for name in ("weight", "bias"):
                change(model.code_statistics, name, _Standardised(found))
        yield found
    finally:
        for module, name in changed:
            parametrize.remove_parametrizations(module, name)
