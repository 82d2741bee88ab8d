"""What the dynamics models of this package have in common."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Self, cast

from tsmlib.checks import require_counts, require_type
from tsmlib.models.config import Configured, weights_from
from tsmlib.models.features import Features
from tsmlib.models.predict import predict
from tsmlib.storage.files import Json
from tsmlib.trajectory import Robot, Trajectories


class StateModel(Configured):
    """A dynamics model of one robot, in the units of its training data.

    Attributes:
        features: angles as cosine and sine, all standardised.
        robot: whose states and actions it was trained on; None until there are data.
    """

    def __init__(self, state_dim: int, action_dim: int, angles: Sequence[int]) -> None:
        super().__init__()
        require_counts(state_dim=state_dim, action_dim=action_dim)
        self.state_dim, self.action_dim = state_dim, action_dim
        self.features = Features(state_dim, angles)
        self.robot: Robot | None = None

    @classmethod
    def for_data(cls, data: Trajectories, *, seed: int = 0, **options: Json) -> Self:
        """Make the model of ``data``, ready to be trained on them.

        Args:
            data: training episodes, whose robot and statistics the model takes.
            seed: of the first weights.
            options: arguments of the class by name, beyond state_dim, action_dim and angles.

        Returns:
            The untrained model.
        """
        require_type("data", data, Trajectories, "tsmlib.Trajectories")
        robot, make = data.robot, cast(Callable[..., Self], cls)
        with weights_from(seed):
            model = make(robot.state_dim, robot.action_dim, angles=robot.angles, **options)
        model.take_robot(data)
        return model

    def take_robot(self, data: Trajectories) -> None:
        """Take the robot of training data and, where there are none yet, their statistics.

        Args:
            data: training episodes.
        """
        if not self.features.fitted:
            self.features.fit(data)
        self.robot = data.robot

    predict = predict
