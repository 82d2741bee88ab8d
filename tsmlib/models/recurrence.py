"""An LSTM cell with a head that runs on its own predictions, as one function with a backward pass of its own.

    q_t        = W [z_t, h_{t-1}, s_t, u_t, 1]            s_t: features of x_t; z_t: a code, or nothing
    f, w, r, a = sigmoid of the first three quarters of q_t, tanh of the last
    c_t        = f c_{t-1} + w a        h_t = r tanh(c_t)
    x_{t+1}    = x_t + V [s_t, u_t, 1, h_t]               or V [silu(U [s_t, u_t, 1, h_t]), 1]

The inputs of a step lie side by side in one row, from which each product takes what it needs, so that nothing is
concatenated, and the gradient of a weight is one product over all steps at the end. Where there is a U, the products
with W and U, forward and backward, are in the type of ``torch.autocast``, bfloat16 for example; gates, memory, states
and the product with V are not. ``tests/test_recurrence.py`` holds all of it to the same written plainly.

Letters in shapes: B batch, T steps, n hidden size, dz code size, F features, dx state size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from tsmlib.models.base import Step
from tsmlib.models.features import Features
from tsmlib.trajectory import Segment

Memory = tuple[Tensor, Tensor]  # h and c, (B, n) each
sigmoid_backward, tanh_backward = (
    torch.ops.aten.sigmoid_backward.grad_input,  # dy y (1 - y), into a place that is there
    torch.ops.aten.tanh_backward.grad_input,  # dy (1 - y^2)
)


_by_operations = False  # a global and no ContextVar, which torch.compile does not follow


@contextmanager
def as_operations() -> Iterator[None]:
    """Within, recurrences run as torch's own operations in place of ``Recurrence``, whose backward pass
    ``torch.func.vmap`` cannot map. For the whole process; slower on a CPU.
    """
    global _by_operations
    before, _by_operations = _by_operations, True
    try:
        yield
    finally:
        _by_operations = before


@dataclass(frozen=True)
class Recurrent:
    """A cell and its head, with weights as the rows need them: biases beside them, state dimensions with angles first.

    cell: W (dz + n + F + du + 1, 4n). hidden: U (F + du + 1 + n, m), or none. out: V, in the units of the state.
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
        """From layers: cell [s, u, h] -> q, codes z -> q, hidden [h, s, u] -> m, out [m] or [h] -> increments."""
        n = cell.out_features // 4
        seen, h = cell.weight.T.split([cell.in_features - n, n])
        w = torch.cat([*([codes.weight.T] if codes else []), h, seen, cell.bias[None]])
        v = torch.cat([out.weight.T, out.bias[None]])
        if hidden is None:
            v = torch.cat(
                [v.new_zeros(len(seen), v.shape[1]), v.roll(1, 0)]
            )  # the head sees h alone
            return cls(features, w, None, cls._arranged(features, v))
        h, seen = hidden.weight.T.split([n, hidden.in_features - n])
        u = torch.cat([seen, hidden.bias[None], h])
        return cls(features, w, u, cls._arranged(features, v))

    @staticmethod
    def _arranged(features: Features, v: Tensor) -> Tensor:
        order = features.angles + features.others
        v = v * features.step_std
        return v if order == sorted(order) else v[:, order]

    def _product_type(self, x: Tensor) -> torch.dtype:
        """Number type of the products with W and U: that of ``x``, or of ``torch.autocast`` where it is on."""
        kind = x.device.type
        if self.hidden is None or x.dtype != torch.float32 or not torch.is_autocast_enabled(kind):
            return x.dtype
        return torch.get_autocast_dtype(kind)

    def read(self, past: Segment) -> Memory:
        """The memory after a past (B, L, .), all but its last state, with z = 0 and nothing before it."""
        s, u = self.features(past.states[:, :-1]), past.actions[:, 1:]
        given = torch.cat([s, u, torch.ones_like(u[..., :1])], dim=-1).transpose(
            0, 1
        )  # (L - 1, B, .)
        n = self.cell.shape[1] // 4
        cell = self.cell[len(self.cell) - n - given.shape[2] :]
        h = c = past.states.new_zeros(len(past.states), n)
        if _by_operations:
            _, memory = self._stepped(None, (h, c), given, given[..., :0])
            return memory
        keep = torch.is_grad_enabled()
        _, h, c = Recurrence.apply(
            keep,
            self._product_type(h),
            self.features,
            None,
            h,
            c,
            given[..., :0],
            given,
            cell,
            None,
            None,
        )
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
        """From states (B, dx) under actions (T, B, du) and codes (T, B, dz), the states (T, B, dx) and the memory."""
        order = self.features.angles + self.features.others
        given = torch.cat([actions, torch.ones_like(actions[..., :1])], dim=-1)
        x = x if order == sorted(order) else x[:, order]
        if _by_operations:
            states, (h, c) = self._stepped(x, memory, given, codes)
        else:
            keep = torch.is_grad_enabled()
            states, h, c = Recurrence.apply(
                keep,
                self._product_type(x),
                self.features,
                x,
                *memory,
                codes,
                given,
                self.cell,
                self.hidden,
                self.out,
            )
        back = sorted(range(len(order)), key=order.__getitem__)
        return states if order == back else states[..., back], (h, c)

    def _stepped(
        self, x: Tensor | None, memory: Memory, given: Tensor, codes: Tensor
    ) -> tuple[Tensor, Memory]:
        """As ``Recurrence``, by one operation after the other; what does not depend on the step before, all at once."""
        h, c = memory
        kind = self._product_type(h)
        with torch.autocast(h.device.type, enabled=False):
            n, dz, known, seen = (
                h.shape[1],
                codes.shape[2],
                given.shape[2],
                0 if x is None else self.features.dim,
            )
            rows = self.cell[len(self.cell) - known - n - seen - dz :].to(kind)
            of_z, of_h, of_s, of_given = rows.split([dz, n, seen, known])

            def product(a: Tensor, b: Tensor) -> Tensor:
                return (a.to(kind) @ b).to(c.dtype)

            q_given, recurrent = product(given, of_given), torch.cat([of_h, of_s])
            if dz:
                q_given = q_given + product(codes, of_z)
            if self.hidden is not None and x is not None:
                u_s, u_given, u_h = self.hidden.to(kind).split([seen, known, n])
                active_given, u_seen = product(given, u_given), torch.cat([u_h, u_s])
            states = []
            for t, now in enumerate(q_given.unbind(0)):
                s = h if x is None else torch.cat([h, _features(self.features, x)], dim=1)
                gates, new = (now + product(s, recurrent)).split([3 * n, n], dim=1)
                forget, write, read = gates.sigmoid().chunk(3, dim=1)
                c = forget * c + write * new.tanh()
                h = read * c.tanh()
                if x is None:
                    continue
                if self.hidden is None:
                    x = x + torch.addmm(self.out[-n - 1], h, self.out[-n:])
                else:
                    active = active_given[t] + product(torch.cat([h, s[:, n:]], dim=1), u_seen)
                    x = x + torch.addmm(self.out[-1], nn.functional.silu(active), self.out[:-1])
                states.append(x)
            return torch.stack(states) if states else given[..., :0], (h, c)


class Recurrence(torch.autograd.Function):
    """All steps. Arguments and results as in ``Recurrent``, but that in x the angles come first.

    keep: what the backward pass needs. kind: number type of the products with W and U, and of the rows. Without x
    nothing is predicted, and ``given`` holds the features as well.
    """

    @staticmethod
    def forward(
        ctx: Any,
        keep: bool,
        kind: torch.dtype,
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
        sizes = [
            dz,
            n,
            after - dz - n - given.shape[2],
            given.shape[2],
            n,
        ]  # [z, h_{t-1}, s, [u, 1], h_t]
        # Zeros: products in bfloat16 read the part of a row that they are given up to the next multiple of 32 columns
        # (oneDNN on AMX), and what is no number there spreads.
        rows = h.new_zeros(kept, batch, sum(sizes), dtype=kind)
        gates = h.new_empty(kept, batch, 4 * n)
        cell, hidden = cell.to(kind), None if hidden is None else hidden.to(kind)
        tanhs, cells = h.new_empty(2, kept, batch, n).unbind(0)
        sigmoids, active = h.new_empty(kept, batch, inner), h.new_ones(kept, batch, inner + 1)
        same, piece = kind == h.dtype, torch.empty_like(h)
        states, start, minus = (
            None if x is None else x.new_empty(steps, *x.shape),
            (x, c),
            h.new_full((), -1.0),
        )
        _, row_h, row_s, _, row_out = _each(rows, sizes)
        qs, places, outputs = gates.unbind(0), sigmoids.unbind(0), active.unbind(0)
        (ins, _), (_, tails), parts = (
            _each(rows, [after, n]),
            _each(rows, [dz + n, -1]),
            _each(gates, [n] * 4),
        )
        for t in range(steps):
            if (k := t % kept) == 0:
                rows[..., :dz], rows[..., after - given.shape[2] : after] = (
                    codes[t : t + kept],
                    given[t : t + kept],
                )
            row_h[k].copy_(h)
            if x is not None:
                _see(features, x, row_s[k])
            q, (forget, write, read, new) = (
                _product(ins[k], cell, qs[k]),
                (part[k] for part in parts),
            )
            new.mul_(2)  # tanh(q) = 2 sigmoid(2 q) - 1, which processors compute faster
            q.sigmoid_()
            torch.add(minus, new, alpha=2, out=new)
            c = torch.mul(forget, c, out=cells[k]).addcmul_(write, new)
            tanh = torch.mul(c, 2, out=tanhs[k]).sigmoid_()
            torch.add(minus, tanh, alpha=2, out=tanh)
            h = torch.mul(read, tanh, out=row_out[k] if same else piece)
            if not same:
                row_out[k].copy_(h)
            if x is None or states is None or out is None:
                continue
            tail = tails[k]
            if hidden is not None:
                s, tail = _product(tail, hidden, outputs[k][:, :-1]), outputs[k]
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
        x, c, states, cell, hidden, out, rows, gates, tanhs, cells, sigmoids, active = (
            ctx.saved_tensors
        )
        (steps, batch, width), n = rows.shape, dh.shape[1]
        of_codes, of_given = ctx.needs_input_grad[6:8]
        dz, seen, after = ctx.sizes[0], sum(ctx.sizes[:2]), len(cell)
        first, last = (
            0 if of_codes else dz,
            after if of_given else sum(ctx.sizes[:3]),
        )  # columns that have a gradient
        dh, dc, piece, back = dh.clone(), dc.clone(), torch.empty_like(dh), cell[first:last].T
        drow, dq, ds = (
            dh.new_zeros(batch, width),
            torch.empty_like(gates),
            torch.empty_like(sigmoids),
        )
        row_z, row_h, row_s, row_given, row_out = drow.split(ctx.sizes, dim=1)
        front, tail, products = drow[:, :seen], drow[:, seen:], drow[:, first:last]
        dcodes = dh.new_empty(steps, batch, dz) if of_codes else None
        dgiven = dh.new_empty(steps, *row_given.shape) if of_given else None
        parts, dparts = _each(gates, [n] * 4), _each(dq, [n] * 4)
        if x is not None:
            dx = torch.cat([torch.zeros_like(x)[None], dstates])  # of x_0 .. x_T
            angles, others = (len(some) for some in (ctx.features.angles, ctx.features.others))
            slopes = _slopes(ctx.features, torch.cat([x[None], states[:-1]]))
            (dx_angles, dx_others), (cos, sin, rest) = (
                _each(dx, [angles, others]),
                row_s.split([angles, angles, others], 1),
            )
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
                _product(ds[t], hidden.T, tail)
            dh += row_out
            (forget, write, read, new), tanh = (part[t] for part in parts), tanhs[t]
            dforget, dwrite, dread, dnew = (part[t] for part in dparts)
            dc += tanh_backward(torch.mul(dh, read, out=piece), tanh, grad_input=piece)
            sigmoid_backward(torch.mul(dh, tanh, out=piece), read, grad_input=dread)
            sigmoid_backward(
                torch.mul(dc, cells[t - 1] if t else c, out=piece), forget, grad_input=dforget
            )
            sigmoid_backward(torch.mul(dc, new, out=piece), write, grad_input=dwrite)
            tanh_backward(torch.mul(dc, write, out=piece), new, grad_input=dnew)
            dc *= forget
            front.zero_()
            _added(products, dq[t], back, products)
            dh.copy_(row_h)
            if dcodes is not None:
                dcodes[t] = row_z
            if dgiven is not None:
                dgiven[t] = row_given
            if x is not None:
                row_s *= slopes[t]
                dx[t] += dx[t + 1]
                dx_angles[t].add_(cos).add_(sin)
                dx_others[t].add_(rest)
        flat = rows.flatten(0, 1).T
        dcell = _gradient(flat[:after], dq)
        if x is None:
            return None, None, None, None, dh, dc, dcodes, dgiven, dcell, None, None
        dhidden = None if hidden is None else _gradient(flat[seen:], ds)
        dout = _gradient(flat[seen:] if hidden is None else active.flatten(0, 1).T, dx[1:])
        return None, None, None, dx[0], dh, dc, dcodes, dgiven, dcell, dhidden, dout


def _product(a: Tensor, b: Tensor, out: Tensor) -> Tensor:
    """a b in the type of b, written into ``out``, which may be of another."""
    return (
        torch.mm(a, b, out=out) if out.dtype == b.dtype else out.copy_(torch.mm(a.to(b.dtype), b))
    )


def _added(x: Tensor, a: Tensor, b: Tensor, out: Tensor) -> Tensor:
    """x + a b, the product in the type of b, written into ``out``."""
    return (
        torch.addmm(x, a, b, out=out)
        if x.dtype == b.dtype
        else torch.add(x, torch.mm(a.to(b.dtype), b), out=out)
    )


def _gradient(rows: Tensor, d: Tensor) -> Tensor:
    """Of a weight: rows (k, T B) times gradients (T, B, m) in the type of the rows, as (k, m) in that of d."""
    product = torch.mm(
        rows, d.flatten(0, 1).to(rows.dtype), out=rows.new_empty(len(rows), d.shape[2])
    )  # no autocast
    return product.to(d.dtype)


def _each(buffer: Tensor, sizes: list[int]) -> list[tuple[Tensor, ...]]:
    """Parts of the last dimension, each as one view per step; -1: what is left."""
    left = buffer.shape[-1] - sum(size for size in sizes if size > 0)
    return [
        part.unbind(0)
        for part in buffer.split([left if size < 0 else size for size in sizes], dim=-1)
    ]


def _features(features: Features, x: Tensor) -> Tensor:
    """Features (B, F) of x (B, dx), whose angles come first."""
    angle, other = x.split([len(features.angles), len(features.others)], dim=1)
    return (torch.cat([angle.cos(), angle.sin(), other], dim=1) - features.mean) / features.std


def _see(features: Features, x: Tensor, s: Tensor) -> None:
    """Write the features of x (B, dx), whose angles come first, into s (B, F)."""
    angles, others = len(features.angles), len(features.others)
    angle, other = x.split([angles, others], 1)
    if s.dtype != x.dtype:
        s.copy_(_features(features, x))
        return
    cos, sin, rest = s.split([angles, angles, others], 1)
    torch.cos(angle, out=cos)
    torch.sin(angle, out=sin)
    rest.copy_(other)
    s.sub_(features.mean).div_(features.std)


def _slopes(features: Features, x: Tensor) -> Tensor:
    """Derivative (..., F) of each feature by the dimension of x (..., dx) that it is a function of."""
    angle, other = x.split([len(features.angles), len(features.others)], dim=-1)
    return torch.cat([-angle.sin(), angle.cos(), torch.ones_like(other)], dim=-1) / features.std
