"""Layers of segment models and policies: gated causal convolutions (Eq. 1), an encoder (A.1).

Letters in shapes: B batch, P positions in time, C channels, dz latent size.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tsmlib.checks import LARGEST, require_count, require_counts, require_flag
from tsmlib.sampling import Noise, standard_normal

BLOCK = 1024  # rows that are decoded at once on a CPU


def on_device_of(model: object, *tensors: Tensor) -> tuple[Tensor, ...]:
    """``tensors`` on the device of the model's weights; as they are where it has none."""
    weight = first_weight(model)
    return tensors if weight is None else tuple(tensor.to(weight.device) for tensor in tensors)


def chunked(compute: Callable[..., Tensor], *rows: Tensor, most: int | None = None) -> Tensor:
    """``compute`` of so few rows at a time, ``most``, that its steps stay in a CPU's cache."""
    most = min(BLOCK, most or BLOCK)
    if len(rows[0]) <= most or rows[0].device.type != "cpu":
        return compute(*rows)
    return torch.cat(
        [compute(*block) for block in zip(*(part.split(most) for part in rows), strict=True)]
    )


def first_weight(model: object) -> nn.Parameter | None:
    """By whose type and device a model takes its inputs; None where it has no weights."""
    return next(model.parameters(), None) if isinstance(model, nn.Module) else None


def silu_network(*widths: int) -> nn.Sequential:
    """Linear layers from each width to the next, with SiLU between them."""
    inner = [m for i, o in pairwise(widths[:-1]) for m in (nn.Linear(i, o), nn.SiLU())]
    return nn.Sequential(*inner, nn.Linear(widths[-2], widths[-1]))


def whole_segments(future: Tensor, segment_len: int) -> tuple[Tensor, ...]:
    """A window's future (B, n H, .) in segments of H steps; ValueError where it is not n H."""
    steps = future.shape[1]
    if steps % segment_len:
        raise ValueError(
            f"future_len is {steps}, which is not a whole number of segments of {segment_len}; "
            f"choose {max(1, steps // segment_len) * segment_len}, or give the model "
            f"segment_len={steps}"
        )
    return future.split(segment_len, dim=1)


class GatedLayer(nn.Module):
    """One dilated causal layer with the gated activation of Eq. 1, residual and skip connection.

        h = tanh(W_f * s + V_f^T z) . sigmoid(W_g * s + V_g^T z)

    As one matrix product over the two taps, s_{t-d} and s_t, the same function serves all positions
    (B, P, C) and one (B, C). ``taps``: W_f and W_g; ``out``: 1x1, residual and skip.

    Args:
        channels: C.
        residual: without only for an ablation (section 3.1).
        skip: without only for an ablation.
    """

    def __init__(self, channels: int, *, residual: bool = True, skip: bool = True) -> None:
        super().__init__()
        self.residual, self.skip = residual, skip
        self.taps = nn.Linear(2 * channels, 2 * channels)
        self.out = nn.Linear(channels, 2 * channels)

    def forward(self, earlier: Tensor, now: Tensor, code: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs at t - d and t (..., C), V z (..., 2 C) -> the next layer's input and the skip."""
        filtered, gate = (self.taps(torch.cat([earlier, now], dim=-1)) + code).chunk(2, dim=-1)
        residual, skip = self.out(torch.tanh(filtered) * torch.sigmoid(gate)).chunk(2, dim=-1)
        s = now + residual if self.residual else residual
        return s, skip if self.skip else torch.zeros_like(skip)


Cache = list[list[Tensor]]  # per layer, its last `dilation` inputs (..., C), oldest first


def advance(
    inlet: nn.Module, layers: nn.ModuleList, inputs: Tensor, codes: Tensor, cache: Cache
) -> Tensor:
    """One position: inputs (..., input_dim), V z of all layers -> sum of the skips (..., C)."""
    s, skips = inlet(inputs), []
    for layer, code, window in zip(layers, codes.chunk(len(layers), dim=-1), cache, strict=True):
        window.append(s)
        s, skip = layer(window.pop(0), s, code)
        skips.append(skip)
    return reduce(torch.add, skips)


class CausalDecoder(nn.Module):
    """P(output | inputs up to now, z): gated layers whose output at a position sees no later one.

    ``forward`` decodes all positions at once; ``begin`` and ``step`` one by one with cached
    activations, for inputs that depend on earlier outputs. Both compute the same numbers. Receptive
    field: 1 + sum(dilations). The arguments are those of ``TSM``.
    """

    def __init__(
        self,
        input_dim: int,
        output_dim: int,
        latent_dim: int,
        *,
        channels: int = 32,
        head_channels: int = 0,
        dilations: Sequence[int] = (1, 2, 4, 8, 4),
        plain: bool = False,
    ) -> None:
        super().__init__()
        require_counts(channels=channels)
        require_count("head_channels", head_channels, least=0, most=LARGEST)
        require_flag("plain", plain)
        if isinstance(dilations, str) or not isinstance(dilations, Sequence) or not dilations:
            raise TypeError(f"dilations is {dilations!r:.80}; expected a tuple such as (1, 2, 4)")
        for dilation in dilations:
            require_counts(dilations=dilation)
        self.inlet = nn.Linear(input_dim, channels)
        self.dilations, self.plain = tuple(dilations), plain
        # Plain: neither residual nor skip connections but the last layer's output.
        self.layers = nn.ModuleList(
            GatedLayer(channels, residual=not plain, skip=not plain or last)
            for last in [*[False] * (len(dilations) - 1), True]
        )
        # V_f, V_g of every layer
        self.codes = nn.Linear(latent_dim, 2 * channels * len(dilations), bias=False)
        head = [nn.Linear(channels, head_channels), nn.ReLU()] if head_channels else []
        self.head = nn.Sequential(
            nn.ReLU(), *head, nn.Linear(head_channels or channels, output_dim)
        )

    def forward(self, inputs: Tensor, z: Tensor, n: int | None = None) -> Tensor:
        """(B, P, input_dim), (B, dz) -> (B, n, output_dim) at the last ``n`` positions, or all."""
        _, skips = self._parallel(inputs, z, inputs.shape[1] if n is None else n)
        return self.head(reduce(torch.add, skips))

    def begin(self, inputs: Tensor, z: Tensor) -> Cache:
        """The cache after the known inputs (B, P, input_dim), P >= 0."""
        layer_inputs, _ = self._parallel(inputs, z, 0)
        return [
            list(F.pad(s, (0, 0, dilation, 0))[:, -dilation:].unbind(1))
            for dilation, s in zip(self.dilations, layer_inputs, strict=True)
        ]

    def step(self, inputs: Tensor, codes: Tensor, cache: Cache) -> Tensor:
        """One position: (B, input_dim), ``self.codes(z)`` -> (B, output_dim). Moves ``cache``."""
        return self.head(advance(self.inlet, self.layers, inputs, codes, cache))

    def _parallel(self, inputs: Tensor, z: Tensor, n: int) -> tuple[list[Tensor], list[Tensor]]:
        """Each layer's inputs, as far as the last ``n`` outputs see them, and its skips there.

        ``owed``: how many last positions of a layer's inputs are needed, from the last layer down.
        """
        owed = [n]
        for dilation in reversed(self.dilations):
            owed.insert(0, min(inputs.shape[1], owed[0] + dilation))
        s = self.inlet(inputs[:, inputs.shape[1] - owed[0] :])  # (B, P, C)
        layer_inputs, skips = [s], []
        codes = self.codes(z)[:, None].chunk(len(self.layers), dim=-1)
        for layer, dilation, code, now in zip(
            self.layers, self.dilations, codes, owed[1:], strict=True
        ):
            if layer is self.layers[-1] and not n:
                break
            # Zeros before the first position.
            earlier = F.pad(s, (0, 0, now + dilation - s.shape[1], 0))[:, :now]
            s, skip = layer(earlier, s[:, s.shape[1] - now :], code)
            layer_inputs.append(s)
            skips.append(skip[:, now - n :])
        return layer_inputs, skips


class Encoder(nn.Module):
    """Q(Z | segment): 1-D convolutions over time with ReLU, projected to mean and log variance."""

    def __init__(
        self, input_dim: int, segment_len: int, latent_dim: int, *, channels: int = 32
    ) -> None:
        super().__init__()
        first, second = (nn.Conv1d(size, channels, 3, padding=1) for size in (input_dim, channels))
        self.convolutions = nn.Sequential(first, nn.ReLU(), second, nn.ReLU())
        self.project = nn.Linear(channels * segment_len, 2 * latent_dim)

    def forward(self, segment: Tensor) -> tuple[Tensor, Tensor]:
        """(B, H, input_dim) -> mean and log variance of Z, (B, dz) each."""
        mean, log_variance = self.project(
            self.convolutions(segment.transpose(1, 2)).flatten(1)
        ).chunk(2, dim=-1)
        return mean, log_variance


def sample_posterior(mean: Tensor, log_variance: Tensor, generator: Noise) -> Tensor:
    """z ~ N(mean, variance) by the reparametrisation trick."""
    return mean + (0.5 * log_variance).exp() * standard_normal(mean.shape, generator, mean)


def kl_from_standard_normal(mean: Tensor, log_variance: Tensor) -> Tensor:
    """KL(N(mean, variance) || N(0, I)) in nats, summed over the last dimension."""
    return 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1)
