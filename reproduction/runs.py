"""Scale and seed of a run, and the file of everything that it makes."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from tsmlib import shipped
from tsmlib.checks import require_choice, require_count
from tsmlib.envs.spec import ENV_IDS, EnvSpec
from tsmlib.shipped import INSTALLED, ROOT

SCALES = ("smoke", "laptop", "paper")
TENSORS = ("data", "models", "plans", "policies")  # kinds of targets that are no table of rows
HELD_OUT = {"validation": 1_000_001, "test": 1_000_002}  # seeds of episodes, for every run
RESERVED = range(1_000_000, 1_000_100)  # seeds of held-out episodes and targets
T = TypeVar("T")


class Missing(FileNotFoundError):
    """A thing that is read before it is made; the message names the command that makes it."""


@dataclass(frozen=True)
class Run:
    """What everything is a function of.

    Args:
        scale: "smoke" (a test), "laptop" (minutes, shipped models) or "paper" (all is made).
        seed: of data, weights, starts and planners.
    """

    scale: str = "laptop"
    seed: int = 0

    def __post_init__(self) -> None:
        require_choice("scale", self.scale, SCALES)
        require_count("seed", self.seed, least=0)
        if self.seed in RESERVED:
            raise ValueError(
                f"seed is {self.seed}; expected one outside {RESERVED.start} to "
                f"{RESERVED.stop - 1}, which draw the held-out episodes and targets"
            )

    @property
    def folder(self) -> Path:
        """Where it writes."""
        return root() / self.scale / f"seed{self.seed}"

    def pick(self, smoke: T, laptop: T, paper: T) -> T:
        """The value for its scale."""
        return {"smoke": smoke, "laptop": laptop, "paper": paper}[self.scale]

    def path(self, target: str) -> Path:
        """The file of a target such as ``models/ReacherPush/tsm``.

        At scale laptop the models are those that ship.
        """
        kind, _, rest = target.partition("/")
        if kind == "models" and self.scale == "laptop":
            return shipped.find(f"data/pretrained/{rest}.safetensors")
        return self.folder / f"{target}.{'safetensors' if kind in TENSORS else 'csv'}"

    def require(self, target: str) -> Path:
        """The file of a target; Missing where it is not made yet."""
        if not (path := self.path(target)).exists():
            how = f"python -m tsmlib make {target} --scale {self.scale} --seed {self.seed}"
            raise Missing(f"{path} is missing; make it: {how}")
        return path

    def __str__(self) -> str:
        return f"scale {self.scale}, seed {self.seed}"


def home() -> Path:
    """The folder that ``runs`` lies in: the repository; of an installed package, where you are."""
    return Path.cwd() if INSTALLED else ROOT


def root() -> Path:
    """The folder of all runs: ``runs``, or what the variable TSM_RUN_DIR names."""
    return Path(os.environ.get("TSM_RUN_DIR") or home() / "runs").absolute()


def env_id(name: str) -> str:
    """The id of an arm by the name in targets: ``Reacher-delay5`` is ``tsm/Reacher-delay5-v0``.

    Raises:
        ValueError: no arm has this name.
    """
    versions = {EnvSpec.parse(env).name: env.rpartition("-")[2] for env in ENV_IDS}
    if (arm := name.partition("-")[0]) not in versions:
        raise ValueError(f"no arm is called {name!r:.80}; there are {', '.join(versions)}")
    return EnvSpec.parse(f"tsm/{name}-{versions[arm]}").id
