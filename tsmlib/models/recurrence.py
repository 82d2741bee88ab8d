"""An LSTM cell with a head that runs on its own predictions: one function, its own backward pass.

    q_t        = W [z_t, h_{t-1}, s_t, u_t, 1]        s_t: features of x_t; z_t: a code, or none
    f, w, r, a = sigmoid of the first three quarters of q_t, tanh of the last
    c_t        = f c_{t-1} + w a        h_t = r tanh(c_t)
    x_{t+1}    = x_t + V [s_t, u_t, 1, h_t]               or V [silu(U [s_t, u_t, 1, h_t]), 1]

The inputs of a step lie side by side in one row, from which each product takes what it needs, so
that nothing is concatenated, and the gradient of a weight is one product over all steps at the end.
``tests/test_recurrence.py`` holds all of it to the same written plainly.

Letters in shapes: B batch, T steps, n hidden size, dz code size, F features, dx state size.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from tsmlib.models.base import Step
from tsmlib.models.features import Features
from tsmlib.trajectory import Segment

Memory = tuple[Tensor, Tensor]  # h and c, (B, n) each
sigmoid_backward = torch.ops.aten.sigmoid_backward.grad_input  # dy y (1 - y), into a place
tanh_backward = torch.ops.aten.tanh_backward.grad_input  # dy (1 - y^2)


@dataclass(frozen=True)
class Recurrent:
    """A cell and its head, with weights as the rows need them: biases beside, angles first.

    Args:
        features: of the states.
        cell: W (dz + n + F + du + 1, 4n).
        hidden: U (F + du + 1 + n, m), or none.
        out: V, in the units of the state.
    """

    features: Features
    cell: Tensor
    hidden: Tensor | None
    out: Tensor

    @classmethod
    def of(
        cls,
        features: Features,
        cell: nn.Linear,
        out: nn.Linear,
        *,
        hidden: nn.Linear | None = None,
        codes: nn.Linear | None = None,
    ) -> Recurrent:
        """From layers: cell [s, u, h] -> q, codes z -> q, hidden [h, s, u] -> m, out -> dx."""
        n = cell.out_features // 4
        seen, h = cell.weight.T.split([cell.in_features - n, n])
        w = torch.cat([*([codes.weight.T] if codes else []), h, seen, cell.bias[None]])
        v = torch.cat([out.weight.T, out.bias[None]])
        if hidden is None:
            v = torch.cat([v.new_zeros(len(seen), v.shape[1]), v.roll(1, 0)])  # it sees h alone
            return cls(features, w, None, cls._arranged(features, v))
        h, seen = hidden.weight.T.split([n, hidden.in_features - n])
        u = torch.cat([seen, hidden.bias[None], h])
        return cls(features, w, u, cls._arranged(features, v))

    @staticmethod
    def _arranged(features: Features, v: Tensor) -> Tensor:
        order = features.angles + features.others
        v = v * features.step_std
        return v if order == sorted(order) else v[:, order]

    def read(self, past: Segment) -> Memory:
        """The memory after a past (B, L, .), all but its last state, with z = 0."""
        s, u = self.features(past.states[:, :-1]), past.actions[:, 1:]
        # (L - 1, B, .)
        given = torch.cat([s, u, torch.ones_like(u[..., :1])], dim=-1).transpose(0, 1)
        n = self.cell.shape[1] // 4
        cell = self.cell[len(self.cell) - n - given.shape[2] :]
        h = c = past.states.new_zeros(len(past.states), n)
        keep, none = torch.is_grad_enabled(), given[..., :0]
        _, h, c = Recurrence.apply(keep, self.features, None, h, c, none, given, cell, None, None)
        return h, c

    def begin(self, past: Segment, code: Callable[[], Tensor] | None = None) -> Step:
        """One step at a time after a past; before each, ``code`` gives its z (B, dz)."""
        x, memory = past.states[:, -1], self.read(past)

        def step(u: Tensor) -> Tensor:
            nonlocal x, memory
            z = u[:, :0] if code is None else code()
            (x,), memory = self.run(x, memory, u[None], z[None])
            return x

        return step

    def run(
        self, x: Tensor, memory: Memory, actions: Tensor, codes: Tensor
    ) -> tuple[Tensor, Memory]:
        """States (T, B, dx), memory: from x (B, dx) under actions (T, B, du), codes (T, B, dz)."""
        order = self.features.angles + self.features.others
        given = torch.cat([actions, torch.ones_like(actions[..., :1])], dim=-1)
        x = x if order == sorted(order) else x[:, order]
        keep, (h, c) = torch.is_grad_enabled(), memory
        states, h, c = Recurrence.apply(
            keep, self.features, x, h, c, codes, given, self.cell, self.hidden, self.out
        )
        back = sorted(range(len(order)), key=order.__getitem__)
        return states if order == back else states[..., back], (h, c)


class Recurrence(torch.autograd.Function):
    """All steps. Arguments and results as in ``Recurrent``, but that in x the angles come first.

    keep: what the backward pass needs. Without x nothing is predicted, and ``given`` holds the
    features as well.
    """

    @staticmethod
    def forward(
        ctx: Any,
        keep: bool,
        features: Features,
        x: Tensor | None,
        h: Tensor,
        c: Tensor,
        codes: Tensor,
        given: Tensor,
        cell: Tensor,
        hidden: Tensor | None,
        out: Tensor | None,
    ) -> tuple[Tensor | None, Tensor, Tensor]:
        (steps, batch, dz), n, after = codes.shape, h.shape[1], len(cell)
        kept, inner = steps if keep else min(1, steps), 0 if hidden is None else hidden.shape[1]
        known = given.shape[2]
        sizes = [dz, n, after - dz - n - known, known, n]  # [z, h_{t-1}, s, [u, 1], h_t]
        rows = h.new_zeros(kept, batch, sum(sizes))
        gates = h.new_empty(kept, batch, 4 * n)
        tanhs, cells = h.new_empty(2, kept, batch, n).unbind(0)
        sigmoids, active = h.new_empty(kept, batch, inner), h.new_ones(kept, batch, inner + 1)
        states = None if x is None else x.new_empty(steps, *x.shape)
        start, minus = (x, c), h.new_full((), -1.0)
        _, row_h, row_s, _, row_out = _each(rows, sizes)
        qs, places, outputs = gates.unbind(0), sigmoids.unbind(0), active.unbind(0)
        (ins, _), (_, tails) = _each(rows, [after, n]), _each(rows, [dz + n, -1])
        parts = _each(gates, [n] * 4)
        for t in range(steps):
            if (k := t % kept) == 0:
                rows[..., :dz] = codes[t : t + kept]
                rows[..., after - known : after] = given[t : t + kept]
            row_h[k].copy_(h)
            if x is not None:
                see(features, x, row_s[k])
            q = torch.mm(ins[k], cell, out=qs[k])
            forget, write, read, new = (part[k] for part in parts)
            new.mul_(2)  # tanh(q) = 2 sigmoid(2 q) - 1, which processors compute faster
            q.sigmoid_()
            torch.add(minus, new, alpha=2, out=new)
            c = torch.mul(forget, c, out=cells[k]).addcmul_(write, new)
            tanh = torch.mul(c, 2, out=tanhs[k]).sigmoid_()
            torch.add(minus, tanh, alpha=2, out=tanh)
            h = torch.mul(read, tanh, out=row_out[k])
            if x is None or states is None or out is None:
                continue
            tail = tails[k]
            if hidden is not None:
                s, tail = torch.mm(tail, hidden, out=outputs[k][:, :-1]), outputs[k]
                s.mul_(torch.sigmoid(s, out=places[k]))
            x = torch.addmm(x, tail, out, out=states[t])
        if keep:
            ctx.save_for_backward(
                *start, states, cell, hidden, out, rows, gates, tanhs, cells, sigmoids, active
            )
            ctx.features, ctx.sizes = features, sizes
        return states, h.clone(), c.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, dstates: Tensor, dh: Tensor, dc: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        x, c, states, cell, hidden, out, rows, gates, tanhs, cells, sigmoids, active = saved
        (steps, batch, width), n = rows.shape, dh.shape[1]
        of_codes, of_given = ctx.needs_input_grad[5:7]
        dz, seen, after = ctx.sizes[0], sum(ctx.sizes[:2]), len(cell)
        # Columns that have a gradient.
        first, last = 0 if of_codes else dz, after if of_given else sum(ctx.sizes[:3])
        dh, dc, piece, back = dh.clone(), dc.clone(), torch.empty_like(dh), cell[first:last].T
        drow = dh.new_zeros(batch, width)
        dq, ds = torch.empty_like(gates), torch.empty_like(sigmoids)
        row_z, row_h, row_s, row_given, row_out = drow.split(ctx.sizes, dim=1)
        front, tail, products = drow[:, :seen], drow[:, seen:], drow[:, first:last]
        dcodes = dh.new_empty(steps, batch, dz) if of_codes else None
        dgiven = dh.new_empty(steps, *row_given.shape) if of_given else None
        parts, dparts = _each(gates, [n] * 4), _each(dq, [n] * 4)
        if x is not None:
            dx = torch.cat([torch.zeros_like(x)[None], dstates])  # of x_0 .. x_T
            angles, others = (len(some) for some in (ctx.features.angles, ctx.features.others))
            turns = slopes(ctx.features, torch.cat([x[None], states[:-1]]))
            dx_angles, dx_others = _each(dx, [angles, others])
            cos, sin, rest = row_s.split([angles, angles, others], 1)
            da = torch.empty_like(sigmoids[0])
        for t in reversed(range(steps)):
            if x is None:
                tail.zero_()
            elif hidden is None:
                torch.mm(dx[t + 1], out.T, out=tail)
            else:
                a, s = active[t, :, :-1], sigmoids[t]
                torch.mm(dx[t + 1], out[:-1].T, out=da)
                torch.addcmul(a, a, s, value=-1, out=ds[t]).add_(s).mul_(da)
                torch.mm(ds[t], hidden.T, out=tail)
            dh += row_out
            (forget, write, read, new), tanh = (part[t] for part in parts), tanhs[t]
            dforget, dwrite, dread, dnew = (part[t] for part in dparts)
            before = cells[t - 1] if t else c
            dc += tanh_backward(torch.mul(dh, read, out=piece), tanh, grad_input=piece)
            sigmoid_backward(torch.mul(dh, tanh, out=piece), read, grad_input=dread)
            sigmoid_backward(torch.mul(dc, before, out=piece), forget, grad_input=dforget)
            sigmoid_backward(torch.mul(dc, new, out=piece), write, grad_input=dwrite)
            tanh_backward(torch.mul(dc, write, out=piece), new, grad_input=dnew)
            dc *= forget
            front.zero_()
            torch.addmm(products, dq[t], back, out=products)
            dh.copy_(row_h)
            if dcodes is not None:
                dcodes[t] = row_z
            if dgiven is not None:
                dgiven[t] = row_given
            if x is not None:
                row_s *= turns[t]
                dx[t] += dx[t + 1]
                dx_angles[t].add_(cos).add_(sin)
                dx_others[t].add_(rest)
        dstart = None if x is None else dx[0]
        if not any(ctx.needs_input_grad[7:]):  # of a model that is used, not trained
            return None, None, dstart, dh, dc, dcodes, dgiven, None, None, None
        flat = rows.flatten(0, 1).T
        dcell = flat[:after] @ dq.flatten(0, 1)
        if x is None:
            return None, None, dstart, dh, dc, dcodes, dgiven, dcell, None, None
        dhidden = None if hidden is None else flat[seen:] @ ds.flatten(0, 1)
        last_inputs = flat[seen:] if hidden is None else active.flatten(0, 1).T
        dout = last_inputs @ dx[1:].flatten(0, 1)
        return None, None, dstart, dh, dc, dcodes, dgiven, dcell, dhidden, dout


def _each(buffer: Tensor, sizes: list[int]) -> list[tuple[Tensor, ...]]:
    """Parts of the last dimension, each as one view per step; -1: what is left."""
    left = buffer.shape[-1] - sum(size for size in sizes if size > 0)
    return [
        part.unbind(0)
        for part in buffer.split([left if size < 0 else size for size in sizes], dim=-1)
    ]


def see(features: Features, x: Tensor, s: Tensor) -> None:
    """Write the features of x (..., dx), whose angles come first, into s (..., F)."""
    angles, others = len(features.angles), len(features.others)
    angle, other = x.split_with_sizes([angles, others], -1)
    cos, sin, rest = s.split_with_sizes([angles, angles, others], -1)
    torch.cos(angle, out=cos)
    torch.sin(angle, out=sin)
    rest.copy_(other)
    s.sub_(features.mean).div_(features.std)


def slopes(features: Features, x: Tensor) -> Tensor:
    """Derivative (..., F) of each feature by its dimension of x (..., dx)."""
    angle, other = x.split([len(features.angles), len(features.others)], dim=-1)
    return torch.cat([-angle.sin(), angle.cos(), torch.ones_like(other)], dim=-1) / features.std
