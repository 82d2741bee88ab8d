"""A segment of gated layers that runs on its own predictions: one function, its own backward pass.

    s_0(t)     = inlet of the features of x_t and the action u_t
    q_l(t)     = W_l [s_l(t - d_l), s_l(t)] + V_l z                 h_l = tanh(q_f) sigmoid(q_g)
    s_{l+1}(t) = s_l(t) + R_l h_l(t)       x_{t+1} = x_t + head(sum_l K_l h_l(t))         Eq. 1

What is known, the past, goes through layer by layer, all positions in one product; then follows
one step after the other. What a layer takes from d steps before is one product for d steps, and the
gradient of a weight is one product over all positions at the end. ``CausalDecoder.step`` is the
same written plainly, to which ``tests/test_free_running.py`` holds it.

Letters in shapes: B batch, P known positions, K steps that follow, T = P + K, L layers, C channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from tsmlib.models.features import Features
from tsmlib.models.layers import CausalDecoder
from tsmlib.models.recurrence import see, slopes
from tsmlib.trajectory import Segment

relu = torch.ops.aten.relu.out
relu_backward = torch.ops.aten.threshold_backward.grad_input


def free_running(
    decoder: CausalDecoder, features: Features, past: Segment, actions: Tensor, z: Tensor
) -> Tensor:
    """States (B, K, dx) after a past (B, P + 1, .) under actions (B, K, du) and codes z (B, dz)."""
    order, back = _orders(features)
    x, u = past.states, torch.cat([past.actions[:, 1:], actions], dim=1)
    x = x if order == back else x[..., order]
    head = [layer for layer in decoder.head if isinstance(layer, nn.Linear)]
    taps, outs = ([getattr(layer, name) for layer in decoder.layers] for name in ("taps", "out"))
    linears = [decoder.inlet, *taps, *outs, *head]
    weights = [part for layer in linears for part in (layer.weight, layer.bias)]
    stack = Stack(features, decoder.dilations, not decoder.plain, torch.is_grad_enabled())
    states = FreeRunning.apply(
        stack, x.transpose(0, 1), u.transpose(0, 1), decoder.codes(z), *weights
    )
    return (states if order == back else states[..., back]).transpose(0, 1)


@dataclass(frozen=True)
class Stack:
    """What a decoder is beside its weights; ``keep``: what the backward pass needs."""

    features: Features
    dilations: tuple[int, ...]
    residual: bool
    keep: bool

    def first(self, known: int) -> list[int]:
        """The first known position at which each layer's input is needed; the last sees all."""
        owed = [0]
        for dilation in reversed(self.dilations):
            owed.insert(0, min(known, owed[0] + dilation))
        return [known - some for some in owed]

    def parts(self, weights: Sequence[Tensor]) -> list[tuple[list[Tensor], list[Tensor]]]:
        """Weights and biases of the inlet, the taps, the layers' outputs and the head."""
        n, weights = len(self.dilations), list(weights)
        ends = [0, 1, 1 + n, 1 + 2 * n, len(weights) // 2]
        return [
            (weights[2 * a : 2 * b : 2], weights[2 * a + 1 : 2 * b : 2]) for a, b in pairwise(ends)
        ]


class FreeRunning(torch.autograd.Function):
    """All positions: x (P + 1, B, dx), angles first, u (T, B, du), V z (B, 2 C L) -> (K, B, dx)."""

    @staticmethod
    def forward(
        ctx: Any, stack: Stack, x: Tensor, u: Tensor, codes: Tensor, *weights: Tensor
    ) -> Tensor:
        ((inlet,), (inlet_bias,)), taps, outs, (head, head_bias) = stack.parts(weights)
        steps, n, known, dilations = len(u), x.shape[1], len(x) - 1, stack.dilations
        layers, (channels, width), seen = len(dilations), inlet.shape, stack.features.dim
        first, last = stack.first(known), layers - 1
        # tanh(q) = 2 sigmoid(2 q) - 1, which processors compute faster
        twice = x.new_ones(2, channels)
        twice[0] = 2
        twice = twice.flatten()
        w = (torch.stack(taps[0]) * twice[:, None]).transpose(1, 2)
        earlier, now = w[:, :channels].unbind(0), w[:, channels:].unbind(0)
        given = codes.unflatten(1, (layers, -1)).transpose(0, 1)
        given = ((given + torch.stack(taps[1])[:, None]) * twice).unbind(0)
        mixed, biases = torch.stack(outs[0]), torch.stack(outs[1])
        back = [part.T for part in mixed[:, :channels]]
        lowest = 0 if stack.residual else last  # the first layer that has a skip connection
        skips = mixed[lowest:, channels:].transpose(1, 2).flatten(0, 1)
        skip_bias, residual_biases = (
            biases[lowest:, channels:].sum(0),
            biases[:, :channels].unbind(0),
        )

        # Without gradients to come, one set of buffers serves all layers and positions.
        kept, room = (steps, steps) if stack.keep else (known + 1, max(known, 1))
        inputs, s = x.new_empty(steps, n, width), x.new_empty(layers, steps * n, channels)
        gates = x.new_empty(layers if stack.keep else 1, room * n, 2 * channels)
        h = x.new_empty(room * n, layers * channels)
        total = x.new_empty(kept - known, n, channels)
        hidden = [x.new_empty(2, kept - known, n, len(part)) for part in head[:-1]]
        active = torch.empty_like(total)
        states = x.new_empty(steps - known, n, x.shape[2])
        minus = x.new_full((), -1.0)

        def prepare(layer: int, begin: int, end: int) -> Tensor:
            """Codes and what comes from d positions before: q, but for what comes from now."""
            rows = slice(begin * n, end * n)
            q = gates[layer, rows] if stack.keep else gates[0, : (end - begin) * n]
            q.unflatten(0, (-1, n)).copy_(given[layer])
            d = dilations[layer]
            if (late := max(begin, d)) < end:
                before = s[layer, (late - d) * n : (end - d) * n]
                q[(late - begin) * n :].addmm_(before, earlier[layer])
            return q

        def gate(
            layer: int,
            s_: Tensor,
            q: Tensor,
            f: Tensor,
            g: Tensor,
            h_: Tensor,
            after: Tensor | None,
        ) -> None:
            q.addmm_(s_, now[layer]).sigmoid_()
            torch.add(minus, f, alpha=2, out=f)
            torch.mul(f, g, out=h_)
            if after is None:
                return
            if stack.residual:
                torch.add(s_, residual_biases[layer], out=after).addmm_(h_, back[layer])
            else:
                torch.addmm(residual_biases[layer], h_, back[layer], out=after)

        inputs[..., seen:] = u
        see(stack.features, x[:known], inputs[:known, :, :seen])
        rows = slice(first[0] * n, known * n)
        torch.addmm(inlet_bias, inputs.flatten(0, 1)[rows], inlet.T, out=s[0, rows])
        parts = h.split(channels, dim=1)
        for layer in range(last):
            rows = slice(first[layer + 1] * n, known * n)
            q = prepare(layer, first[layer + 1], known)
            h_ = parts[layer][rows] if stack.keep else parts[layer][: len(q)]
            f, g = q.chunk(2, dim=1)
            gate(layer, s[layer, rows], q, f, g, h_, s[layer + 1, rows])

        # What a step needs, as views that are made once.
        late = known * n if stack.keep else 0
        repeat = 1 if stack.keep else steps - known
        s_steps = [part[known * n :].split(n) for part in s]
        views = (gates, gates[..., :channels], gates[..., channels:])
        q_steps, f_steps, g_steps = ([_steps(p[late:], n, repeat) for p in v] for v in views)
        if not stack.keep:
            q_steps, f_steps, g_steps = (v * layers for v in (q_steps, f_steps, g_steps))
        h_steps = [_steps(part[late:], n, repeat) for part in parts]
        mix_steps = _steps(h[late:, lowest * channels :], n, repeat)
        in_steps, seen_steps = inputs[known:].unbind(0), inputs[known:, :, :seen].unbind(0)
        latest, deviations, (order, _) = x[known], stack.features.step_std, _orders(stack.features)
        final = (head[-1] * deviations[:, None])[order].T
        final_bias = (head_bias[-1] * deviations)[order]
        for k in range(steps - known):
            kept_k, t = k if stack.keep else 0, known + k
            see(stack.features, latest, seen_steps[k])
            torch.addmm(inlet_bias, in_steps[k], inlet.T, out=s_steps[0][k])
            for layer, d in enumerate(dilations):
                if not stack.keep:
                    prepare(layer, t, t + 1)
                elif k % d == 0:
                    prepare(layer, t, min(t + d, steps))
                after = None if layer == last else s_steps[layer + 1][k]
                q, f, g, h_ = (v[layer][k] for v in (q_steps, f_steps, g_steps, h_steps))
                gate(layer, s_steps[layer][k], q, f, g, h_, after)
            torch.addmm(skip_bias, mix_steps[k], skips, out=total[kept_k])
            a = relu(total[kept_k], out=active[kept_k])
            for buffer, weight, bias in zip(hidden, head[:-1], head_bias[:-1], strict=True):
                before, after = buffer[:, kept_k].unbind(0)
                a = relu(torch.addmm(bias, a, weight.T, out=before), out=after)
            latest = torch.add(latest, final_bias, out=states[k]).addmm_(a, final)
        if stack.keep:
            ctx.save_for_backward(x, states, inputs, s, gates, h, total, active, *hidden, *weights)
            ctx.stack, ctx.mixed, ctx.skips, ctx.final = stack, mixed, skips, final
        return states

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, dstates: Tensor) -> tuple[Tensor | None, ...]:
        stack: Stack = ctx.stack
        x, states, inputs, s, gates, h, total, active, *rest = ctx.saved_tensors
        layers = len(stack.dilations)
        count = len(rest) - (len(ctx.needs_input_grad) - 4)
        hidden, weights = rest[:count], rest[count:]
        ((inlet,), _), (taps, _), _, (head, _) = stack.parts(weights)
        (steps, n, width), known, channels = inputs.shape, len(x) - 1, len(inlet)
        seen, last, first = stack.features.dim, layers - 1, stack.first(known)
        lowest = 0 if stack.residual else last
        earlier, now = [w[:, :channels] for w in taps], [w[:, channels:] for w in taps]
        back, skips = ctx.mixed[:, :channels].unbind(0), ctx.skips.T
        dq, ds = torch.empty_like(gates), torch.empty_like(s)
        dh, dtotal = s.new_empty(n, layers * channels), torch.empty_like(total)
        dh_parts, dh_skips = dh.split(channels, dim=1), dh[:, lowest * channels :]
        dhidden = [torch.empty_like(part[0]) for part in hidden]
        dx = torch.cat([torch.zeros_like(x), dstates])  # of x_0 .. x_T
        parts = h.split(channels, dim=1)
        for layer, d in enumerate(stack.dilations):
            ds[layer, : max(known - d, 0) * n].zero_()
            ds[layer, max(steps - d, 0) * n :].zero_()

        def slope(f: Tensor, g: Tensor, value: Tensor, df: Tensor, dg: Tensor) -> None:
            """Write the derivative of h by q, [g (1 - f^2), f g (1 - g)] = [g - h f, h - h g]."""
            torch.addcmul(g, value, f, value=-1, out=df)
            torch.addcmul(value, value, g, value=-1, out=dg)

        def through(
            layer: int, dh_: Tensor, dq_: Tensor, both: Tensor, ds_: Tensor, after: Tensor | None
        ) -> None:
            both.mul_(dh_)
            if after is not None and stack.residual:
                ds_ += after
            ds_.addmm_(dq_, now[layer])

        ds_steps, dq_steps, both_steps = (
            [part[known * n :].split(n) for part in whole]
            for whole in (ds, dq, dq.unflatten(2, (2, channels)))
        )
        dh_both = [part[:, None] for part in dh_parts]
        halves = (
            part.unflatten(1, (steps, n))[:, known:].unbind(1)
            for whole in (gates, dq)
            for part in whole.chunk(2, dim=2)
        )
        f_steps, g_steps, df_steps, dg_steps = halves
        h_steps = h.view(steps, n, layers, channels)[known:].transpose(1, 2).unbind(0)
        deviations, final = stack.features.step_std, ctx.final.T
        slopes_ = slopes(stack.features, torch.cat([x, states[:-1]]))
        angles, others = len(stack.features.angles), len(stack.features.others)
        dinputs = s.new_empty(steps, n, width)
        for t in reversed(range(known, steps)):
            k = t - known
            da = dx[t + 1] @ final
            for j in reversed(range(len(hidden))):
                relu_backward(da, hidden[j][0, k], 0, grad_input=dhidden[j][k])
                da = dhidden[j][k] @ head[j]
            relu_backward(da, total[k], 0, grad_input=dtotal[k])
            torch.mm(dtotal[k], skips, out=dh_skips)
            slope(f_steps[k], g_steps[k], h_steps[k], df_steps[k], dg_steps[k])
            for layer in reversed(range(layers)):
                after = None
                if layer < last:
                    after = ds_steps[layer + 1][k]
                    if stack.residual:
                        dh_parts[layer].addmm_(after, back[layer])
                    else:
                        torch.mm(after, back[layer], out=dh_parts[layer])
                dq_, both, ds_ = (v[layer][k] for v in (dq_steps, both_steps, ds_steps))
                through(layer, dh_both[layer], dq_, both, ds_, after)
                d = stack.dilations[layer]
                if k % d == 0 and (end := min(t + d, steps)) > d:
                    begin = max(t, d)
                    torch.mm(
                        dq[layer, begin * n : end * n],
                        earlier[layer],
                        out=ds[layer, (begin - d) * n : (end - d) * n],
                    )
            row = torch.mm(ds_steps[0][k], inlet, out=dinputs[t])
            cos, sin, rest_ = (row[:, :seen] * slopes_[t]).split_with_sizes(
                [angles, angles, others], 1
            )
            dx[t] += dx[t + 1]
            dx[t, :, :angles].add_(cos).add_(sin)
            dx[t, :, angles:].add_(rest_)
        for layer in reversed(range(last)):
            begin, end, d = first[layer + 1], known, stack.dilations[layer]
            rows = slice(begin * n, end * n)
            dq_ = dq[layer, rows]
            (f, g), (df, dg) = gates[layer, rows].chunk(2, 1), dq_.chunk(2, 1)
            slope(f, g, parts[layer][rows], df, dg)
            after = ds[layer + 1, rows]
            dh_ = (after @ back[layer])[:, None]
            through(layer, dh_, dq_, dq_.unflatten(1, (2, -1)), ds[layer, rows], after)
            if (begin := max(begin, d)) < end:
                ds[layer, (begin - d) * n : (end - d) * n].addmm_(
                    dq[layer, begin * n : end * n], earlier[layer]
                )
        begin = first[0]
        dinputs[:begin] = 0
        torch.mm(ds[0, begin * n : known * n], inlet, out=dinputs[begin:known].flatten(0, 1))
        cos, sin, rest_ = (dinputs[:known, :, :seen] * slopes_[:known]).split(
            [angles, angles, others], 2
        )
        dx[:known, :, :angles].add_(cos).add_(sin)
        dx[:known, :, angles:].add_(rest_)

        gradients = [torch.zeros_like(part) for part in weights]
        (
            ((dinlet,), (dinlet_bias,)),
            (dtaps, dtaps_bias),
            (douts, douts_bias),
            (dhead, dhead_bias),
        ) = stack.parts(gradients)
        torch.mm(ds[0, begin * n :].T, inputs[begin:].flatten(0, 1), out=dinlet)
        torch.sum(ds[0, begin * n :], 0, out=dinlet_bias)
        dgiven = s.new_empty(n, layers, 2 * channels)
        dtotal_rows = dtotal.flatten(0, 1)
        for layer, d in enumerate(stack.dilations):
            begin = first[layer + 1] * n
            torch.mm(dq[layer, begin:].T, s[layer, begin:], out=dtaps[layer][:, channels:])
            if (late := max(begin, d * n)) < len(dq[layer]):
                torch.mm(
                    dq[layer, late:].T,
                    s[layer, late - d * n : (steps - d) * n],
                    out=dtaps[layer][:, :channels],
                )
            dgiven[:, layer] = dq[layer, begin:].unflatten(0, (-1, n)).sum(0)
            torch.sum(dgiven[:, layer], 0, out=dtaps_bias[layer])
            if layer < last:
                after = ds[layer + 1, begin:]
                torch.mm(after.T, parts[layer][begin:], out=douts[layer][:channels])
                torch.sum(after, 0, out=douts_bias[layer][:channels])
            if layer >= lowest:
                torch.mm(dtotal_rows.T, parts[layer][known * n :], out=douts[layer][channels:])
                torch.sum(dtotal_rows, 0, out=douts_bias[layer][channels:])
        ins = [active, *(part[1] for part in hidden)]
        columns = dx[known + 1 :].unbind(-1)
        sorted_ = torch.stack([columns[i] for i in _orders(stack.features)[1]], dim=-1)
        outs = [*dhidden, sorted_ * deviations]
        for a, dz, dw, db in zip(ins, outs, dhead, dhead_bias, strict=True):
            torch.mm(dz.flatten(0, 1).T, a.flatten(0, 1), out=dw)
            torch.sum(dz, (0, 1), out=db)
        return None, dx[: known + 1], dinputs[..., seen:], dgiven.flatten(1), *gradients


def _orders(features: Features) -> tuple[list[int], list[int]]:
    """The dimensions of a state, angles first, and where each then stands."""
    order = features.angles + features.others
    return order, sorted(range(len(order)), key=order.__getitem__)


def _steps(part: Tensor, n: int, repeat: int) -> tuple[Tensor, ...]:
    """Views of n rows each; where only those of one step were kept, these again and again."""
    return part.split(n) if repeat == 1 else (part[:n],) * repeat
