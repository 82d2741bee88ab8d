"""Schedule and result of exploration."""

from __future__ import annotations

from dataclasses import dataclass, field

from tsmlib.checks import require_count, require_number, require_type
from tsmlib.planning.predictors import JUDGING
from tsmlib.training.fit import TrainingOptions
from tsmlib.trajectory import Trajectories


@dataclass(frozen=True)
class ExplorationOptions:
    """Schedule of ``explore``.

    Args:
        model: one round's training of the model, from the weights it has.
        prior: one round's training of the prior; None leaves it as it is.
        rounds: of planning, executing and learning.
        every: steps executed before the next plan (``mpc``).
        candidates: of each plan (``cem``), at least 2.
        elites: of the candidates, at least 2.
        iterations: of each plan.
        held_out: share of each round's episodes that join the held-out data: at least one and never
            all, but none of a single one, which is trained on.
        rms: of the actions that are searched where there is no prior; None takes their size and
            smoothness from the training data.
        judging: samples by which candidates are judged beside the mode; 0: by the mode alone.
        screened: share of the candidates that all samples judge (``cem``).
    """

    model: TrainingOptions
    prior: TrainingOptions | None = None
    rounds: int = 5
    every: int = 10
    candidates: int = 96
    elites: int = 9
    iterations: int = 4
    held_out: float = 0.1
    rms: float | None = None
    judging: int = JUDGING
    screened: float = 0.25

    def __post_init__(self) -> None:
        for name in ("model", "prior"):
            if name == "model" or self.prior is not None:
                value = getattr(self, name)
                require_type(name, value, TrainingOptions, "tsmlib.TrainingOptions(...)")
        least = {"rounds": 1, "every": 1, "candidates": 2, "elites": 2, "iterations": 1}
        for name, low in (least | {"judging": 0}).items():
            require_count(name, getattr(self, name), least=low)
        if self.elites > self.candidates:
            raise ValueError(
                f"elites is {self.elites}; expected at most the {self.candidates} candidates"
            )
        if self.rms is not None:
            require_number("rms", self.rms, 0, above=True)
        require_number("screened", self.screened, 0, 1)
        if require_number("held_out", self.held_out, 0, 1, above=True) == 1:
            raise ValueError("held_out is 1; expected a share below 1, for some to be trained on")


@dataclass(repr=False)
class Exploration:
    """What ``explore`` leaves.

    Attributes:
        train: all training data.
        held_out: all held-out data.
        records: one per round: ``round``; ``env_steps`` executed so far; ``executed_return``,
            ``success`` and ``final_distance``, means over its episodes, by the task's measures;
            ``predicted_return`` and the mean size of the ``gap``; ``lost``, episodes whose
            simulation became unstable, whereupon the others begin anew, and
            ``discarded_steps`` that all had executed until then, which ``env_steps`` counts;
            ``validation`` and ``prior_validation``, losses on held-out data; and what ``measure``
            gave. Means of a round that lost all its episodes are NaN.
        episodes: of each round; None where it had no new ones.
        seconds: ``cpu_seconds`` and ``wall_seconds`` of each round, without ``measure``.
    """

    train: Trajectories
    held_out: Trajectories
    records: list[dict[str, float]] = field(default_factory=list)
    episodes: list[Trajectories | None] = field(default_factory=list)
    seconds: list[dict[str, float]] = field(default_factory=list)

    def __repr__(self) -> str:
        episodes = f"{len(self.train)} episodes to train on, {len(self.held_out)} held out"
        return f"Exploration({len(self.records)} rounds, {episodes})"
