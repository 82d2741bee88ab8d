"""Reliability checks with few trials; ``make reliability`` runs them at full length."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest
import torch
from reliability.__main__ import CHECKS, Check

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="kills, forks and looks into /proc")
QUICK = [(check, few) for part in CHECKS.values() for check, (few, _) in part.items() if few >= 0]


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """As in the children that a check forks; a training that goes on with others would say so."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize(("check", "trials"), QUICK, ids=[check.__name__ for check, _ in QUICK])
def test_every_trial_goes_as_the_page_on_reliability_says(check: Check, trials: int) -> None:
    if check.__name__ == "hostile_minari":
        pytest.importorskip("minari")
        pytest.importorskip("h5py")
    check(trials).check()
