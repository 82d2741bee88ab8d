"""Under nbval, notebooks run at scale smoke in a folder of their own; the longest tests come first."""

from __future__ import annotations

import os

import pytest


def pytest_configure(config: pytest.Config) -> None:
    os.environ["TQDM_DISABLE"] = "1"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Notebooks last and in order, at the smallest scale whatever they say."""
    for item in items:
        cell = getattr(item, "cell", None)  # of nbval
        if cell is not None and "parameters" in cell.metadata.get("tags", []):
            cell.source = cell.source.replace('"laptop"', '"smoke"')
    items.sort(
        key=lambda item: (
            item.path.name != "test_notebooks.py",
            str(item.path) if item.path.suffix == ".ipynb" else "",
        )
    )
