"""An accelerator that the processor imitates, to see that nothing computes with tensors of two
devices.

Its tensors say that they are on the device "meta" and hold their numbers in a tensor of the
processor. As on CUDA, an operation fails that meets one of them beside a tensor of the processor,
but for a single number in elementwise operations and for the index in ``x[index]``; and so does
drawing on it from a generator of the processor. There is no half precision on it.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.optim import optimizer
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE = "meta"  # of every build of torch, without numbers of its own, and differentiable
INDEXED = (
    "aten::index",
    "aten::_unsafe_index",
    "aten::index_put",
    "aten::index_put_",
    "aten::_index_put_impl_",
)


class There(Tensor):
    """A tensor on the imitated accelerator."""

    here: Tensor

    @staticmethod
    def __new__(cls, here: Tensor) -> There:
        there = Tensor._make_wrapper_subclass(
            cls, here.shape, here.stride(), here.storage_offset(), dtype=here.dtype, device=DEVICE
        )
        there.here = here
        return there

    @classmethod
    def __torch_function__(
        cls, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        if (
            function is Tensor.__getitem__
        ):  # torch would itself bring a list to the device, past __torch_dispatch__
            x, index = args
            last = index[-1] if isinstance(index, tuple) else index
            if isinstance(last, list):
                dim = -1 if isinstance(index, tuple) else 0
                return x.index_select(dim, There(torch.tensor(last, dtype=torch.int64)))
        return torch._C._disabled_torch_function_impl(function, types, args, kwargs or {})

    @classmethod
    def __torch_dispatch__(
        cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _run(operation, args, kwargs or {})


class Accelerator(TorchDispatchMode):
    """Within it, "meta" is the accelerator, for autocast and Adam too. count: of operations."""

    def __init__(self) -> None:
        super().__init__()
        self.count, self.patches = 0, ExitStack()

    def __enter__(self) -> Accelerator:
        enable, autocast = torch.set_autocast_enabled, torch.autocast
        fused = [*optimizer._get_fused_kernels_supported_devices(), DEVICE]
        for where, name, instead in (
            (
                torch,
                "set_autocast_enabled",
                lambda kind, on: None if kind == DEVICE else enable(kind, on),
            ),
            (
                torch,
                "autocast",
                lambda kind, *_, **how: autocast("cpu" if kind == DEVICE else kind, *_, **how),
            ),
            (optimizer, "_get_fused_kernels_supported_devices", lambda: fused),
        ):
            self.patches.enter_context(mock.patch.object(where, name, instead))
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        self.patches.close()
        super().__exit__(*error)

    def __torch_dispatch__(
        self, operation: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        self.count += any(isinstance(leaf, There) for leaf in tree_leaves(args))
        return _run(operation, args, kwargs or {})


def _run(operation: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """The operation on the numbers; the result on the device that was asked for."""
    name = operation._schema.name
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    there = any(isinstance(tensor, There) for tensor in tensors)
    if there and name not in ("aten::_to_copy", "aten::copy_"):
        free = tree_leaves(args[1]) if name in INDEXED else []
        for tensor in tensors:
            single = not tensor.ndim and torch.Tag.pointwise in operation.tags
            if not (isinstance(tensor, There) or single or any(tensor is index for index in free)):
                raise RuntimeError(
                    f"{name}: a tensor of the processor, {tuple(tensor.shape)}, beside others"
                )
    if kwargs.get("device") is not None:
        there, kwargs = torch.device(kwargs["device"]).type == DEVICE, {**kwargs, "device": "cpu"}
    if (
        there
        and isinstance(drawn := kwargs.get("generator"), torch.Generator)
        and drawn.device.type != DEVICE
    ):
        raise RuntimeError(f"{name}: a generator of the processor draws on the accelerator")
    numbers, named = tree_map(
        lambda leaf: leaf.here if isinstance(leaf, There) else leaf, (args, kwargs)
    )
    found = operation(*numbers, **named)
    if not there:
        return found
    changed = {
        id(tensor.here): tensor for tensor in tensors if isinstance(tensor, There)
    }  # in place
    return tree_map(
        lambda leaf: (
            changed[id(leaf)]
            if id(leaf) in changed
            else There(leaf)
            if isinstance(leaf, Tensor)
            else leaf
        ),
        found,
    )
