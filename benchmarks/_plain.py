"""Plain form of the segment model, as the paper's text reads: reference of the benchmarks, oracle of the tests.

    h = tanh(W_f * s + V_f z) . sigmoid(W_g * s + V_g z)      (Eq. 1)

Filter and gate are separate dilated causal convolutions of two taps, residual and skip separate 1x1 convolutions, and
all of it is float32, eager, one operation after the other. Shapes: B batch, P positions, C channels, dz latent size.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.layers import CausalDecoder
from tsmlib.models.tsm import TSM
from tsmlib.sampling import Noise, standard_normal
from tsmlib.trajectory import Segment, Window


class PlainLayer(nn.Module):
    """Eq. 1 with residual and skip connection, over (B, C, P)."""

    def __init__(self, channels: int, latent_dim: int, dilation: int) -> None:
        super().__init__()
        self.dilation = dilation
        self.filter = nn.Conv1d(channels, channels, 2, dilation=dilation)  # W_f
        self.gate = nn.Conv1d(channels, channels, 2, dilation=dilation)  # W_g
        self.filter_code = nn.Linear(latent_dim, channels, bias=False)  # V_f
        self.gate_code = nn.Linear(latent_dim, channels, bias=False)  # V_g
        self.residual = nn.Conv1d(channels, channels, 1)
        self.skip = nn.Conv1d(channels, channels, 1)

    def forward(self, s: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """(B, C, dilation + P), (B, dz) -> the next layer's input and the skip output, (B, C, P) each."""
        h = torch.tanh(self.filter(s) + self.filter_code(z)[..., None])
        h = h * torch.sigmoid(self.gate(s) + self.gate_code(z)[..., None])
        return s[..., self.dilation :] + self.residual(h), self.skip(h)


class PlainDecoder(nn.Module):
    """P(output | inputs up to now, z), with the weights of a ``CausalDecoder`` that has residuals and skips."""

    def __init__(self, decoder: CausalDecoder) -> None:
        super().__init__()
        weights = {name: value.detach().clone() for name, value in decoder.state_dict().items()}
        channels, input_dim = weights["inlet.weight"].shape
        codes = weights["codes.weight"]  # (2 C layers, dz): V_f, V_g of every layer
        self.inlet = nn.Linear(input_dim, channels)
        self.layers = nn.ModuleList(PlainLayer(channels, codes.shape[1], d) for d in decoder.dilations)
        self.direct = bool(decoder.state_skip)
        widths = [weights[name] for name in weights if name.startswith("head.") and name.endswith("weight")]
        activation = nn.SiLU if self.direct else nn.ReLU
        head: list[nn.Module] = [] if self.direct else [nn.ReLU()]
        for i, weight in enumerate(widths):
            head += [activation()] if i else []
            head.append(nn.Linear(*reversed(weight.shape)))
        self.head = nn.Sequential(*head)
        mine = {name: weights[name] for name in weights if name.startswith(("inlet.", "head."))}
        for i, (f, g) in enumerate(v.chunk(2) for v in codes.chunk(len(self.layers))):
            mine |= {f"layers.{i}.filter_code.weight": f, f"layers.{i}.gate_code.weight": g}
            for part, names in (("taps", ("filter", "gate")), ("out", ("residual", "skip"))):
                weight, bias = (weights[f"layers.{i}.{part}.{word}"].chunk(2) for word in ("weight", "bias"))
                for name, w, b in zip(names, weight, bias, strict=True):
                    taps = torch.stack(w.split(channels, dim=1), dim=2)  # (C, C, 2) or (C, C, 1), earlier tap first
                    mine |= {f"layers.{i}.{name}.weight": taps, f"layers.{i}.{name}.bias": b}
        self.load_state_dict(mine)

    def forward(self, inputs: Tensor, z: Tensor) -> Tensor:
        """All positions at once: (B, P, input_dim), (B, dz) -> (B, P, output_dim)."""
        s = self.inlet(inputs).transpose(1, 2)  # (B, C, P)
        total = torch.zeros_like(s)
        for layer in self.layers:
            s, skip = layer(F.pad(s, (layer.dilation, 0)), z)
            total = total + skip
        return self._out(total.transpose(1, 2), inputs)

    def begin(self, inputs: Tensor, z: Tensor) -> list[Tensor]:
        """After the known inputs (B, P, input_dim), the last ``dilation`` inputs of each layer (B, C, dilation)."""
        s = self.inlet(inputs).transpose(1, 2)
        cache = []
        for layer in self.layers:
            padded = F.pad(s, (layer.dilation, 0))
            cache.append(padded[..., -layer.dilation :])
            s, _ = layer(padded, z)
        return cache

    def step(self, inputs: Tensor, z: Tensor, cache: list[Tensor]) -> Tensor:
        """The next position: (B, input_dim) -> (B, output_dim). ``cache`` moves on by one."""
        s = self.inlet(inputs)[..., None]  # (B, C, 1)
        total = torch.zeros_like(s)
        for i, layer in enumerate(self.layers):
            window = torch.cat([cache[i], s], dim=2)
            cache[i] = window[..., 1:]
            s, skip = layer(window, z)
            total = total + skip
        return self._out(total[..., 0], inputs)

    def _out(self, total: Tensor, inputs: Tensor) -> Tensor:
        return self.head(torch.cat([total, inputs], dim=-1) if self.direct else total)


class PlainTSM(nn.Module):
    """A ``TSM`` with the paper's encoder, decoded plainly: its losses and predictions, from its weights."""

    def __init__(self, model: TSM) -> None:
        super().__init__()
        features = model.features
        self.segment_len, self.past_len, self.latent_dim = model.segment_len, model.past_len, model.latent_dim
        self.beta, self.angles, self.others = model.beta, features.angles, features.others
        for name in ("mean", "std", "step_std", "moving", "scored"):
            self.register_buffer(name, getattr(features, name).clone())
        weights = {name: value.detach().clone() for name, value in model.encoder.state_dict().items()}
        channels, input_dim, width = weights["convolutions.0.weight"].shape
        self.first = nn.Conv1d(input_dim, channels, width, padding=1)
        self.second = nn.Conv1d(channels, channels, width, padding=1)
        self.project = nn.Linear(channels * model.segment_len, 2 * model.latent_dim)
        for mine, name in ((self.first, "convolutions.0"), (self.second, "convolutions.2"), (self.project, "project")):
            mine.load_state_dict({word: weights[f"{name}.{word}"] for word in ("weight", "bias")})
        self.decoder = PlainDecoder(model.decoder)

    def predict_segment(self, past: Segment, actions: Tensor, *, generator: Noise | None = None) -> Tensor:
        """(B, L, .), (B, K <= H, du) -> states (B, K, dx). No generator: z = 0; with one: z ~ N(0, I)."""
        shape = (len(actions), self.latent_dim)
        z = actions.new_zeros(shape) if generator is None else standard_normal(shape, generator, actions)
        return self.decode(past, actions, z)

    def decode(self, past: Segment, actions: Tensor, z: Tensor) -> Tensor:
        """Free-running: (B, L, .), (B, K, du), (B, dz) -> (B, K, dx)."""
        x, states = past.states[:, -1], []
        cache = self.decoder.begin(self.inputs(past.states[:, :-1], past.actions[:, 1:]), z)
        for k in range(actions.shape[1]):
            x = x + self.step_std * self.decoder.step(self.inputs(x, actions[:, k]), z, cache)
            states.append(x)
        return torch.stack(states, dim=1)

    def encode(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Q(Z | X+): (B, H, dx) -> mean and log variance (B, dz)."""
        h = torch.relu(self.first(self.features(states).transpose(1, 2)))
        mean, log_variance = self.project(torch.relu(self.second(h)).flatten(1)).chunk(2, dim=-1)
        return mean, log_variance

    def loss(self, window: Window, generator: Noise) -> Tensor:
        """As ``TSM.loss``: free-running, one segment after the other, each from the predicted one before it."""
        past, total = window.past, window.past.states.new_zeros(())
        for future in self.segments(window.future):
            z, kl = self.code(future, generator)
            predicted = self.decode(past, future.actions, z)
            error = (self.features(predicted) - self.features(future.states))[..., self.scored]
            total = total + (error.square().sum((1, 2)) + self.beta * kl).mean()
            past = Segment(predicted, future.actions)
        return total

    def teacher_forced_loss(self, window: Window, generator: Noise) -> Tensor:
        """As ``TSM.teacher_forced_loss``: one-step increments with the true states as inputs."""
        past, total = window.past, window.past.states.new_zeros(())
        for future in self.segments(window.future):
            z, kl = self.code(future, generator)
            before = torch.cat([past.states, future.states[:, :-1]], dim=1)
            actions = torch.cat([past.actions[:, 1:], future.actions], dim=1)
            increments = self.decoder(self.inputs(before, actions), z)[:, -self.segment_len :]
            true = (future.states - before[:, -self.segment_len :]) / self.step_std.clamp_min(1e-9)
            error = (increments - true)[..., self.moving]
            total = total + (error.square().sum((1, 2)) + self.beta * kl).mean()
            past = future
        return total

    def energy_loss(self, window: Window, generator: Noise) -> Tensor:
        """As ``TSM.energy_loss``: two free-running samples with codes from the prior."""
        past = Segment(*(torch.cat([part, part]) for part in window.past))
        total = past.states.new_zeros(())
        for future in self.segments(window.future):
            actions = torch.cat([future.actions, future.actions])
            states = self.predict_segment(past, actions, generator=generator)
            past = Segment(states, actions)
            a, b = self.features(states).chunk(2)
            x = self.features(future.states)
            distances = [(d.flatten(1).square().sum(1) + 1e-8).sqrt() for d in (a - x, b - x, a - b)]
            total = total + ((distances[0] + distances[1] - distances[2]) / 2).mean()
        return total

    def features(self, states: Tensor) -> Tensor:
        """Cosines, sines and the rest, standardised."""
        angles = states[..., self.angles]
        raw = torch.cat([torch.cos(angles), torch.sin(angles), states[..., self.others]], dim=-1)
        return (raw - self.mean) / self.std

    def inputs(self, states: Tensor, actions: Tensor) -> Tensor:
        return torch.cat([self.features(states), actions], dim=-1)

    def code(self, future: Segment, generator: Noise) -> tuple[Tensor, Tensor]:
        """A code from Q(Z | X+), and its KL divergence from N(0, I): (B, dz), (B,)."""
        mean, log_variance = self.encode(future.states)
        z = mean + torch.exp(0.5 * log_variance) * standard_normal(mean.shape, generator, mean)
        return z, 0.5 * (mean.square() + torch.exp(log_variance) - 1 - log_variance).sum(-1)

    def segments(self, future: Segment) -> list[Segment]:
        parts = zip(*(part.split(self.segment_len, dim=1) for part in future), strict=True)
        return [Segment(*part) for part in parts]


class PlainPrior(nn.Module):
    """The decoder of an ``ActionPrior``, plainly: codes to torques."""

    def __init__(self, prior: ActionPrior) -> None:
        super().__init__()
        self.segment_len, self.past_len, self.latent_dim = prior.segment_len, prior.past_len, prior.latent_dim
        self.register_buffer("std", prior.std.clone())
        self.decoder = PlainDecoder(prior.decoder)

    def decode(self, past_actions: Tensor, z: Tensor) -> Tensor:
        """(B, L, du), (B, dz) -> (B, H, du)."""
        u, actions = past_actions[:, -1], []
        cache = self.decoder.begin(past_actions[:, :-1] / self.std, z)
        for _ in range(self.segment_len):
            u = (u + self.std * self.decoder.step(u / self.std, z, cache)).clamp(-1, 1)
            actions.append(u)
        return torch.stack(actions, dim=1)

    def plan(self, past_actions: Tensor, z: Tensor) -> Tensor:
        """(B, L, du), (B, K, dz) -> (B, K H, du)."""
        segments = []
        for k in range(z.shape[1]):
            past_actions = self.decode(past_actions[:, -self.past_len :], z[:, k])
            segments.append(past_actions)
        return torch.cat(segments, dim=1)
