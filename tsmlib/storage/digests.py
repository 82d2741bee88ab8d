"""Digests of arrays, by which weights and data sets are told apart."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import torch
from torch import Tensor

from tsmlib.trajectory import Trajectories


def digest(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of named arrays, by name and content."""
    sha = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        sha.update(name.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
    return sha.hexdigest()


def trajectories_digest(data: Trajectories) -> str:
    """Sixteen digits that tell the states and actions of data sets apart."""
    arrays = {"states": data.flat_states, "actions": data.flat_actions}
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    if len(set(data.lengths)) > 1:
        tensors["lengths"] = torch.tensor(data.lengths)
    return digest(tensors)[:16]
