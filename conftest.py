"""Tests never see the user's settings; under nbval, notebooks run at the smallest scale."""

from __future__ import annotations

import os

import pytest


def pytest_configure(config: pytest.Config) -> None:
    for name in ("TSM_SCALE", "TSM_RUN_DIR", "TSM_DEVICE"):
        os.environ.pop(name, None)
    os.environ["TQDM_DISABLE"] = "1"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Notebooks last and in order, each with its cells in order, cut down."""
    for item in items:
        cell = getattr(item, "cell", None)  # nbval's
        if cell is not None and "parameters" in cell.metadata.get("tags", []):
            cell.source = cell.source.replace('scale = "laptop"', 'scale = "smoke"')
    items.sort(key=lambda item: str(item.path) if item.path.suffix == ".ipynb" else "")
