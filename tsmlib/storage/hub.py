"""Models in folders and on the Hugging Face Hub: weights, ``config.json`` and a card."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import TypeVar

import torch

import tsmlib
from tsmlib.robot import Robot
from tsmlib.storage import artifacts
from tsmlib.storage.files import Json, PathLike, StoreError, dumps, write_bytes

WEIGHTS = "model.safetensors"
M = TypeVar("M", bound=torch.nn.Module)
CARD = """---
library_name: tsmlib
pipeline_tag: robotics
tags: [world-model, model-based-reinforcement-learning, tsmlib]
---
# {name} for {env}

```python
import tsmlib

model = tsmlib.{name}.from_pretrained("{folder}")
states = model.predict(start, actions, samples=32)
```

{robot}{scores}Arguments of the class: `{config}`. Written by tsmlib {version}.
"""


def save_pretrained(
    model: artifacts.Model,
    folder: PathLike,
    *,
    name: str = "",
    scores: Mapping[str, float] | None = None,
) -> None:
    """Write a model, its arguments and its card into a folder, as ``from_pretrained`` reads it."""
    folder, cls, robot = Path(folder), type(model).__name__, getattr(model, "robot", None)
    about: Mapping[str, Json] = asdict(robot) if isinstance(robot, Robot) else {}
    rows = {"robot": about, "score": {k: f"{v:.4g}" for k, v in (scores or {}).items()}}
    tables = {title: _table(title, values) for title, values in rows.items()}
    card = CARD.format(
        name=cls,
        env=about.get("env", "an unnamed robot"),
        folder=name or folder.name,
        robot=tables["robot"],
        scores=tables["score"],
        config=json.dumps(model.config()),
        version=tsmlib.__version__,
    )
    artifacts.save_model(folder / WEIGHTS, model)
    config = dumps(folder, {"model_type": "tsmlib", "class": cls, "config": model.config()})
    write_bytes(folder / "config.json", config.encode())
    write_bytes(folder / "README.md", card.encode())


def from_pretrained(cls: type[M], name: PathLike) -> M:
    """Read a model from a folder; where there is none of that name, from the Hub."""
    path = Path(name)
    if path.is_dir() or path.is_absolute() or str(name).count("/") != 1:
        return artifacts.load_model(path / WEIGHTS, cls)
    hub = _hub(f"{path} is no folder here, and the Hub")
    try:
        return artifacts.load_model(hub.hf_hub_download(str(name), WEIGHTS), cls)
    except OSError as error:  # its errors of any kind
        raise StoreError(
            f"{name} is no folder here, and the Hub did not give it: {error}. Check the name, the "
            "network and, of a private one: hf auth login"
        ) from error


def push_to_hub(
    model: artifacts.Model, name: str, *, private: bool, scores: Mapping[str, float] | None
) -> str:
    """Upload what ``save_pretrained`` writes; returns the address."""
    hub = _hub("an upload")
    with tempfile.TemporaryDirectory() as folder:
        save_pretrained(model, folder, name=name, scores=scores)
        hub.create_repo(name, private=private, exist_ok=True)
        return str(hub.upload_folder(repo_id=name, folder_path=folder))


def _hub(what: str) -> ModuleType:
    try:
        import huggingface_hub
    except ImportError as error:
        raise ImportError(
            f"{what} needs huggingface-hub: type {sys.executable} -m pip install 'tsmlib[hub]'"
        ) from error
    return huggingface_hub


def _table(title: str, values: Mapping[str, Json]) -> str:
    lines = [f"| {key} | {value} |\n" for key, value in values.items()]
    return f"| {title} | |\n|---|---|\n{''.join(lines)}\n" if lines else ""
