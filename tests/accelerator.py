"""An accelerator that the processor imitates, to see that nothing computes with tensors of two devices.

Its tensors say that they are on the device "imitated" and hold their numbers in a tensor of the processor. As on CUDA,
an operation fails that meets one of them beside a tensor of the processor, but for a single number in elementwise
operations and for the index in ``x[index]``; and so does drawing on it from a generator of the processor. There is no
half precision on it.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend

DEVICE = "imitated"
INDEXED = ("aten::index", "aten::_unsafe_index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_")


class _Backend(_DummyBackendModule):
    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16]


_setup_privateuseone_for_python_backend(DEVICE, backend_module=_Backend())


class There(Tensor):
    """A tensor on the imitated accelerator."""

    here: Tensor

    @staticmethod
    def __new__(cls, here: Tensor) -> There:
        there = Tensor._make_wrapper_subclass(
            cls, here.shape, here.stride(), here.storage_offset(), dtype=here.dtype, device=f"{DEVICE}:0"
        )
        there.here = here
        return there

    @classmethod
    def __torch_function__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if function is Tensor.__getitem__:  # torch would itself bring a list to the device, past __torch_dispatch__
            x, index = args
            last = index[-1] if isinstance(index, tuple) else index
            if isinstance(last, list):
                return x.index_select(-1, There(torch.tensor(last, dtype=torch.int64)))
        return torch._C._disabled_torch_function_impl(function, types, args, kwargs or {})

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(operation, args, kwargs or {})


class Accelerator(TorchDispatchMode):
    """Within it, there is a device "imitated". count: operations that ran on it."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += any(isinstance(leaf, There) for leaf in tree_leaves(args))
        return _run(operation, args, kwargs or {})


def _run(operation: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """The operation on the numbers; the result on the device that it was asked for on, or where its tensors are."""
    name = operation._schema.name
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    there = any(isinstance(tensor, There) for tensor in tensors)
    if there and name not in ("aten::_to_copy", "aten::copy_"):
        free = tree_leaves(args[1]) if name in INDEXED else []
        for tensor in tensors:
            single = not tensor.ndim and torch.Tag.pointwise in operation.tags
            if not (isinstance(tensor, There) or single or any(tensor is index for index in free)):
                raise RuntimeError(
                    f"{name}: a tensor of the processor, {tuple(tensor.shape)}, beside the accelerator's"
                )
    if kwargs.get("device") is not None:
        there, kwargs = torch.device(kwargs["device"]).type == DEVICE, {**kwargs, "device": "cpu"}
    if there and isinstance(drawn := kwargs.get("generator"), torch.Generator) and drawn.device.type != DEVICE:
        raise RuntimeError(f"{name}: a generator of the processor draws on the accelerator")
    numbers, named = tree_map(lambda leaf: leaf.here if isinstance(leaf, There) else leaf, (args, kwargs))
    found = operation(*numbers, **named)
    if not there:
        return found
    changed = {id(tensor.here): tensor for tensor in tensors if isinstance(tensor, There)}  # in place
    return tree_map(
        lambda leaf: changed[id(leaf)] if id(leaf) in changed else There(leaf) if isinstance(leaf, Tensor) else leaf,
        found,
    )
