"""Schedule and record of learning a policy (A.3)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from tsmlib.checks import require_count, require_number
from tsmlib.training.checkpoint import Curve


@dataclass(frozen=True)
class LearningOptions:
    """Schedule of ``learn_policy``; defaults are the paper's (A.3), where it states them.

    Args:
        horizon: T, steps of an imagined episode.
        gamma: discount per step, above 0 and at most 1.
        noise: standard deviation of the policy's output.
        episodes: imagined per update.
        iterations: updates; at 2200 the rate has decayed (A25).
        lr: learning rate of Adam.
        lr_decay: per 100 iterations, above 0 and at most 1.
        lr_final: where the decay ends.
        clip: norm that the gradient is shortened to; 0 never, the paper states none.
        record_every: iterations between records; a checkpoint is written as often.
        bootstrap: H, steps of an update, after which a learned value stands for the rest of the
            episode; 0 for the paper's way, whole episodes and no value.
    """

    horizon: int = 50
    gamma: float = 0.99
    noise: float = 0.01
    episodes: int = 20
    iterations: int = 2200
    lr: float = 1e-3
    lr_decay: float = 0.9
    lr_final: float = 1e-4
    clip: float = 0.0
    record_every: int = 100
    bootstrap: int = 0

    @classmethod
    def with_value(
        cls, *, horizon: int, iterations: int = 3000, record_every: int = 250
    ) -> LearningOptions:
        """The schedule for what whole episodes do not teach, such as pushing; not the paper's.

        Args:
            horizon: T, steps of an imagined episode.
            iterations: updates of H = 16 steps.
            record_every: iterations between records.

        Returns:
            The options.
        """
        return cls(
            horizon=horizon,
            gamma=0.98,
            noise=0.1,
            episodes=128,
            iterations=iterations,
            lr=2e-3,
            lr_decay=0.05 ** (100 / iterations),  # a twentieth at the end
            clip=1.0,
            record_every=record_every,
            bootstrap=16,
        )

    def __post_init__(self) -> None:
        for name in ("horizon", "episodes", "iterations", "record_every"):
            require_count(name, getattr(self, name))
        require_count("bootstrap", self.bootstrap, least=0)
        for name in ("gamma", "lr_decay"):
            require_number(name, getattr(self, name), 0, 1, above=True)
        for name in ("noise", "lr_final", "clip"):
            require_number(name, getattr(self, name), 0)
        require_number("lr", self.lr, 0, above=True)


@dataclass(repr=False)
class LearningCurve(Curve):
    """Record of ``learn_policy``, with one entry for each record.

    Attributes:
        iteration: updates done.
        predicted: undiscounted predicted return, mean over the same 50 episodes.
        measured: by name what ``measure`` returned, such as the executed return.
    """

    unit: ClassVar[str] = "iteration"
    remedy: ClassVar[str] = "Check that the reward's gradient is finite everywhere, or clip"
    iteration: list[int] = field(default_factory=list)
    predicted: list[float] = field(default_factory=list)
    measured: dict[str, list[float]] = field(default_factory=dict)

    def __repr__(self) -> str:
        ends = self.predicted[:: max(1, len(self.predicted) - 1)]
        returns = " to ".join(f"{value:.4g}" for value in ends)
        return f"LearningCurve({max(self.iteration, default=0)} iterations, return {returns})"
