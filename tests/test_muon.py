"""Muon is that of torch, in the type of the weights and for stacks of matrices."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from tsmlib.models.baselines import LSTM
from tsmlib.models.ensemble import Ensemble
from tsmlib.models.tsm import TSM
from tsmlib.training.muon import Muon, matrices, orthogonalised


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def stepped(
    optimizer: torch.optim.Optimizer, weight: nn.Parameter, gradients: list[torch.Tensor]
) -> torch.Tensor:
    for gradient in gradients:
        weight.grad = gradient.clone()
        optimizer.step()
    return weight.detach()


@pytest.mark.skipif(not hasattr(torch.optim, "Muon"), reason="this torch has no Muon")
@pytest.mark.parametrize("shape", [(24, 6), (6, 24), (10, 10)])
def test_it_is_torchs_but_for_bfloat16(shape: tuple[int, int]) -> None:
    ours, theirs = (nn.Parameter(drawn(*shape)) for _ in range(2))
    gradients = [drawn(*shape, seed=1 + i) for i in range(5)]
    found = stepped(Muon([ours], lr=0.02), ours, gradients)
    expected = stepped(torch.optim.Muon([theirs], lr=0.02, weight_decay=0.0), theirs, gradients)
    assert (found - expected).norm() < 0.02 * (expected - drawn(*shape)).norm()


def test_an_update_has_singular_values_near_one_whatever_the_gradient() -> None:
    for shape in ((24, 6), (6, 24), (3, 8, 8)):
        values = torch.linalg.svdvals(orthogonalised(1e3 * drawn(*shape)))
        assert values.min() > 0.3
        assert values.max() < 1.3
    assert orthogonalised(torch.zeros(4, 3)).abs().max() == 0


@pytest.mark.parametrize(("inputs", "outputs"), [(4, 9), (9, 4)])
def test_a_stack_is_its_matrices_one_by_one(inputs: int, outputs: int) -> None:
    """A layer keeps (out, in), a stack of them (M, in, out); both learn alike."""
    stack = nn.Parameter(drawn(3, inputs, outputs))
    singles = [nn.Parameter(matrix.mT.contiguous().clone()) for matrix in stack.detach()]
    gradients = [drawn(3, inputs, outputs, seed=1 + i) for i in range(4)]
    found = stepped(Muon([stack], lr=0.02), stack, gradients)
    for m, single in enumerate(singles):
        turned = [gradient[m].mT for gradient in gradients]
        alone = stepped(Muon([single], lr=0.02), single, turned)
        torch.testing.assert_close(found[m], alone.mT, rtol=1e-4, atol=1e-5)


def names(model: nn.Module) -> set[str]:
    known = {id(weight) for weight in matrices(model)}
    return {name for name, weight in model.named_parameters() if id(weight) in known}


def test_matrices_are_the_weights_of_linear_and_recurrent_layers_and_stacks_of_them() -> None:
    assert names(Ensemble(3, 2, angles=(0,), hidden=8, layers=2)) == {
        f"weights.{i}" for i in range(3)
    }
    found = names(LSTM(3, 2, angles=(0,)))
    assert found == {
        name for name, weight in LSTM(3, 2, angles=(0,)).named_parameters() if weight.ndim == 2
    }
    tsm = TSM(3, 2, angles=(0,), segment_len=4, channels=8, dilations=(1, 2))
    kernels = {name for name, weight in tsm.named_parameters() if "convolutions" in name}
    assert kernels
    assert not kernels & names(tsm)
    assert names(nn.Linear(5, 1)) == set()  # one row is a vector


def test_a_model_may_keep_layers_to_adam() -> None:
    model = nn.Sequential(nn.Linear(4, 5), nn.Sequential(nn.Linear(5, 6), nn.Linear(6, 3)))
    assert names(model) == {"0.weight", "1.0.weight", "1.1.weight"}
    model.adam_only = ("1.0", "0.weight")
    assert names(model) == {"1.1.weight"}
    model.adam_only = ("1",)
    assert names(model) == {"0.weight"}
    model.adam_only = ("code",)
    with pytest.raises(
        ValueError,
        match="adam_only of Sequential names 'code'; expected a layer or parameter of it",
    ):
        matrices(model)
