"""Tests never see the user's settings or write to runs/; under nbval, notebooks run cut down in a temporary folder."""

from __future__ import annotations

import os
import shutil
import tempfile

import pytest

MADE = pytest.StashKey[str]()  # the folder that this session made for its runs


def notebooks_run(config: pytest.Config) -> bool:
    """Whether nbval collects notebooks in this session."""
    return bool(config.getoption("nbval", False) or config.getoption("nbval_lax", False))


def pytest_configure(config: pytest.Config) -> None:
    for name in ("TSM_SCALE", "TSM_RUN_DIR", "TSM_DEVICE"):
        os.environ.pop(name, None)
    os.environ["TQDM_DISABLE"] = "1"
    if notebooks_run(config):  # the kernels inherit this process's environment
        os.environ["TSM_SCALE"] = "smoke"
        os.environ["TSM_RUN_DIR"] = config.stash[MADE] = tempfile.mkdtemp(prefix="tsmlib-runs-")


def pytest_unconfigure(config: pytest.Config) -> None:
    if folder := config.stash.get(MADE, None):
        shutil.rmtree(folder, ignore_errors=True)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Notebooks last and in order, each with its cells in order; the longest test first, beside the others under -n."""
    items.sort(
        key=lambda item: (
            item.path.name != "test_notebooks.py",
            str(item.path) if item.path.suffix == ".ipynb" else "",
        )
    )
