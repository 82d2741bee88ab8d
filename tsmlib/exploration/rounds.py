"""The files of a round of exploration."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from tsmlib.models.config import Configured
from tsmlib.storage import artifacts
from tsmlib.storage.files import Json, StoreError, decode_nonfinite, encode_nonfinite
from tsmlib.trajectory import Trajectories


@dataclass(frozen=True)
class RoundFiles:
    """The files of one round: its episodes, then the prior, at last the model with its record.

    Attributes:
        folder: of the round.
        identity: of the loop and of what the round learns from; files of another are refused.
    """

    folder: Path
    identity: Mapping[str, Json]

    def episodes(self) -> tuple[Trajectories | None, dict[str, float]] | None:
        """Episodes, None where all were lost, and their record; None where nothing is there."""
        path, whole = self.folder / "episodes.safetensors", self.folder / "model.safetensors"
        if path.exists():
            return artifacts.load_trajectories(path), self._record(path)
        return (None, self._record(whole)) if whole.exists() else None

    def keep_episodes(self, episodes: Trajectories, record: Mapping[str, float]) -> None:
        """Write episodes and their record."""
        path = self.folder / "episodes.safetensors"
        artifacts.save_trajectories(path, episodes, self._header(record))

    def models(self, model: Configured, prior: Configured | None) -> dict[str, float] | None:
        """The record of the whole round, its weights now in the nets; None if not all is there."""
        path = self.folder / "model.safetensors"
        if not path.exists():
            return None
        record = self._record(path)
        for name, net in {"model": model, "prior": prior}.items():
            if net is not None:
                stored = artifacts.load_model(self.folder / f"{name}.safetensors", type(net))
                net.load_state_dict(stored.state_dict())
        return record

    def keep_models(
        self, model: Configured, prior: Configured | None, record: Mapping[str, float]
    ) -> None:
        """Write the nets and the record of the whole round; its checkpoints go."""
        header = self._header(record)
        if prior is not None:
            artifacts.save_model(self.folder / "prior.safetensors", prior, header)
        artifacts.save_model(self.folder / "model.safetensors", model, header)
        for checkpoint in self.folder.glob("*.checkpoint"):
            shutil.rmtree(checkpoint)

    def _header(self, record: Mapping[str, float]) -> dict[str, Json]:
        return {"identity": dict(self.identity), "record": encode_nonfinite(dict(record))}

    def _record(self, path: Path) -> dict[str, float]:
        header = artifacts.read_header(path)
        stored = cast(dict[str, Json], header.get("identity", {}))
        if differs := artifacts.differences(stored, dict(self.identity)):
            raise StoreError(
                f"{path} is of another exploration: {'; '.join(differs)}. Delete "
                f"{self.folder.parent} to start anew, or go back to those settings"
            )
        return dict(decode_nonfinite(header["record"]))
