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

relu, silu = torch.ops.aten.relu.out, torch.ops.aten.silu.out
relu_backward = torch.ops.aten.threshold_backward.grad_input
silu_backward = torch.ops.aten.silu_backward.grad_input


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
    residual, skip = not decoder.plain, bool(decoder.state_skip)
    stack = Stack(features, decoder.dilations, residual, skip, torch.is_grad_enabled())
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
    state_skip: bool
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

        inputs = x.new_empty(steps, n, width)
        s, gates = (
            x.new_empty(layers, steps * n, channels),
            x.new_empty(layers, steps * n, 2 * channels),
        )
        h = x.new_empty(steps * n, layers * channels)
        wide = channels + (width if stack.state_skip else 0)
        total = x.new_empty(steps - known, n, wide)
        hidden = [x.new_empty(2, steps - known, n, len(part)) for part in head[:-1]]
        active = total if stack.state_skip else torch.empty_like(total)
        states = x.new_empty(steps - known, n, x.shape[2])
        minus = x.new_full((), -1.0)

        def prepare(layer: int, begin: int, end: int) -> None:
            """Codes and what comes from d positions before."""
            s_, q = s[layer], gates[layer]
            q[begin * n : end * n].unflatten(0, (-1, n)).copy_(given[layer])
            d = dilations[layer]
            if (begin := max(begin, d)) < end:
                q[begin * n : end * n].addmm_(s_[(begin - d) * n : (end - d) * n], earlier[layer])

        def gate(layer: int, s_: Tensor, q: Tensor, h_: Tensor, after: Tensor | None) -> None:
            q.addmm_(s_, now[layer]).sigmoid_()
            filtered, opened = q.split(channels, dim=1)
            torch.add(minus, filtered, alpha=2, out=filtered)
            torch.mul(filtered, opened, out=h_)
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
            prepare(layer, first[layer + 1], known)
            rows = slice(first[layer + 1] * n, known * n)
            gate(layer, s[layer, rows], gates[layer, rows], parts[layer][rows], s[layer + 1, rows])

        by_step = [part.split(n) for part in s], [part.split(n) for part in gates]
        h_by_step, h_parts = h[:, lowest * channels :].split(n), [part.split(n) for part in parts]
        act = silu if stack.state_skip else relu
        latest, deviations, (order, _) = x[known], stack.features.step_std, _orders(stack.features)
        final = (head[-1] * deviations[:, None])[order].T
        final_bias = (head_bias[-1] * deviations)[order]
        for t in range(known, steps):
            k = t - known
            see(stack.features, latest, inputs[t, :, :seen])
            torch.addmm(inlet_bias, inputs[t], inlet.T, out=by_step[0][0][t])
            for layer, d in enumerate(dilations):
                if k % d == 0:
                    prepare(layer, t, min(t + d, steps))
                after = None if layer == last else by_step[0][layer + 1][t]
                gate(layer, by_step[0][layer][t], by_step[1][layer][t], h_parts[layer][t], after)
            torch.addmm(skip_bias, h_by_step[t], skips, out=total[k, :, :channels])
            if stack.state_skip:
                total[k, :, channels:] = inputs[t]
            else:
                relu(total[k], out=active[k])
            a = active[k]
            for (before, after), weight, bias in zip(
                hidden, head[:-1], head_bias[:-1], strict=True
            ):
                a = act(torch.addmm(bias, a, weight.T, out=before[k]), out=after[k])
            latest = torch.add(latest, final_bias, out=states[k]).addmm_(a, final)
        if stack.keep:
            ctx.save_for_backward(x, states, inputs, s, gates, h, total, active, *hidden, *weights)
            ctx.stack, ctx.mixed, ctx.skips = stack, mixed, skips
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

        def slope(layer: int | slice, rows: slice) -> None:
            """Write the derivative of h by q, [g (1 - f^2), f g (1 - g)] = [g - h f, h - h g]."""
            f, g = gates[layer, rows].split(channels, dim=-1)
            df, dg = dq[layer, rows].split(channels, dim=-1)
            value = h[rows].unflatten(1, (layers, -1)).transpose(0, 1)[layer]
            torch.addcmul(g, value, f, value=-1, out=df)
            torch.addcmul(value, value, g, value=-1, out=dg)

        def through(
            layer: int, dh_: Tensor, dq_: Tensor, ds_: Tensor, after: Tensor | None
        ) -> None:
            dq_.unflatten(1, (2, -1)).mul_(dh_[:, None])
            if after is not None and stack.residual:
                ds_ += after
            ds_.addmm_(dq_, now[layer])

        by_step = [part.split(n) for part in ds], [part.split(n) for part in dq]
        act_backward = silu_backward if stack.state_skip else relu_backward
        threshold = () if stack.state_skip else (0,)
        deviations, (order, unsorted) = stack.features.step_std, _orders(stack.features)
        final = (head[-1] * deviations[:, None])[order]
        slopes_ = slopes(stack.features, torch.cat([x, states[:-1]]))
        angles, others = len(stack.features.angles), len(stack.features.others)
        dinputs = s.new_empty(steps, n, width)
        for t in reversed(range(known, steps)):
            k = t - known
            da = dx[t + 1] @ final
            for j in reversed(range(len(hidden))):
                act_backward(da, hidden[j][0, k], *threshold, grad_input=dhidden[j][k])
                da = dhidden[j][k] @ head[j]
            if stack.state_skip:
                dtotal[k] = da
            else:
                relu_backward(da, total[k], 0, grad_input=dtotal[k])
            torch.mm(dtotal[k, :, :channels], skips, out=dh_skips)
            slope(slice(None), slice(t * n, (t + 1) * n))
            for layer in reversed(range(layers)):
                after = None
                if layer < last:
                    after = by_step[0][layer + 1][t]
                    if stack.residual:
                        dh_parts[layer].addmm_(after, back[layer])
                    else:
                        torch.mm(after, back[layer], out=dh_parts[layer])
                through(layer, dh_parts[layer], by_step[1][layer][t], by_step[0][layer][t], after)
                d = stack.dilations[layer]
                if k % d == 0 and (end := min(t + d, steps)) > d:
                    begin = max(t, d)
                    torch.mm(
                        dq[layer, begin * n : end * n],
                        earlier[layer],
                        out=ds[layer, (begin - d) * n : (end - d) * n],
                    )
            row = torch.mm(by_step[0][0][t], inlet, out=dinputs[t])
            if stack.state_skip:
                row += dtotal[k, :, channels:]
            cos, sin, rest_ = (row[:, :seen] * slopes_[t]).split([angles, angles, others], 1)
            dx[t] += dx[t + 1]
            dx[t, :, :angles].add_(cos).add_(sin)
            dx[t, :, angles:].add_(rest_)
        for layer in reversed(range(last)):
            begin, end, d = first[layer + 1], known, stack.dilations[layer]
            rows = slice(begin * n, end * n)
            slope(layer, rows)
            after = ds[layer + 1, rows]
            through(layer, after @ back[layer], dq[layer, rows], ds[layer, rows], after)
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
        dtotal_rows = dtotal.flatten(0, 1)[:, :channels]
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
        outs = [*dhidden, dx[known + 1 :][..., unsorted] * deviations]
        for a, dz, dw, db in zip(ins, outs, dhead, dhead_bias, strict=True):
            torch.mm(dz.flatten(0, 1).T, a.flatten(0, 1), out=dw)
            torch.sum(dz, (0, 1), out=db)
        return None, dx[: known + 1], dinputs[..., seen:], dgiven.flatten(1), *gradients


def _orders(features: Features) -> tuple[list[int], list[int]]:
    """The dimensions of a state, angles first, and where each then stands."""
    order = features.angles + features.others
    return order, sorted(range(len(order)), key=order.__getitem__)
