"""The quick start teaches with what it computes: another target, model or seed is another result."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import nbformat
import pytest
import torch
from torch import Tensor

from reproduction import runs

NOTEBOOK = runs.notebooks()["quickstart"].path


def run_cells(**given: object) -> dict[str, Any]:
    """The names that the notebook leaves behind at the smallest scale, films and pictures left out."""
    names: dict[str, Any] = {}
    for cell in nbformat.read(NOTEBOOK, 4).cells:
        if cell.cell_type == "code" and not cell.source.startswith("figures."):
            exec(compile(cell.source, str(NOTEBOOK), "exec"), names)
        if "parameters" in cell.metadata.get("tags", []):
            names |= {"scale": "smoke", **given}
    return names


@pytest.fixture(scope="module", autouse=True)
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patch, mpl.rc_context():
        patch.setenv("TSM_RUN_DIR", str(tmp_path_factory.mktemp("runs")))
        yield


@pytest.fixture(scope="module")
def plain() -> dict[str, Any]:
    return run_cells()


def shown(names: dict[str, Any]) -> Tensor:
    """Executed and predicted returns of both plans, (2, 2, 8)."""
    return torch.stack(
        [
            torch.stack([trial.executed_return, trial.plan.predicted_return])
            for trial in names["trials"].values()
        ]
    )


@pytest.mark.parametrize("given", [{"target_x": 0.15}, {"seed": 1}, {"model": "tsm"}], ids=str)
def test_what_a_reader_changes_changes_what_is_shown(
    given: dict[str, object], plain: dict[str, Any]
) -> None:
    assert (shown(run_cells(**given)) - shown(plain)).abs().mean() > 0.01


def test_it_uses_the_public_interface_and_says_the_equations_of_the_paper() -> None:
    cells = nbformat.read(NOTEBOOK, 4).cells
    imports = {
        line
        for cell in cells
        for line in cell.source.splitlines()
        if line.startswith(("import ", "from "))
    }
    assert imports == {
        "import gymnasium",
        "import torch",
        "import tsmlib",
        "from tsmlib import plots as figures, study",
        "from reproduction.runs import resolve",
    }
    for before, after in pairwise(cells):
        if "$$" in before.source:
            assert (
                "tsmlib." in after.source or after.cell_type == "markdown"
            )  # beside the call that is it
    assert all(tag in "".join(cell.source for cell in cells) for tag in (r"\tag{2}", r"\tag{3}"))


def test_it_is_short() -> None:
    cells = nbformat.read(NOTEBOOK, 4).cells
    code = [cell.source for cell in cells if cell.cell_type == "code"]
    assert len(code) <= 15
    assert max(source.count("\n") + 1 for source in code) <= 15
    assert Path(NOTEBOOK).stat().st_size < 20_000
