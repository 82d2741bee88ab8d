"""Tasks: frozen starts, a reward and a measure of success in one environment.

Letters in shapes: B starts, T horizon, dx, du, dg size of state, action and target.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from tsmlib import rewards
from tsmlib.checks import (
    MOST,
    as_tensor,
    described,
    require_callable,
    require_count,
    require_number,
    require_seed,
    require_type,
)
from tsmlib.envs.ids import find_spec
from tsmlib.envs.spec import EnvSpec
from tsmlib.envs.stepping import Arms, make_simulation
from tsmlib.planning.starts import (
    begin,
    chosen_indices,
    require_reachable,
    require_same_starts,
    require_within_limit,
)
from tsmlib.rewards import Reward, require_reward, reward_of, rewarded
from tsmlib.robot import warn_of_other_env
from tsmlib.trajectory import Robot, Segment, initial_past

HORIZON = {"reach": 50, "push": 100}  # steps of 0.02 s
TOLERANCE = {"reach": 0.03, "push": 0.05}  # metres: a trial that ends within it is a success


# states (B, T + 1, dx) -> (B,): bool, or a distance to be within the tolerance
Success = Callable[[Tensor], Tensor]


@dataclass(frozen=True, repr=False)
class Task:
    """B instances of one task in one environment.

    ``Task.from_env`` makes one of any environment, ``load_task`` gives the paper's, ``with_reward``
    another reward from the same starts.

    Args:
        name: of the task, in tables and errors.
        env: id of the environment.
        start: (B, dx), states or first observations, physical units.
        target: (B, dg), what the reward is about; (B, 0) where it needs none.
        reward_for: targets (B, dg) -> reward.
        position: of what has to arrive in an arm's state, fingertip or object; else None.
        horizon: T, steps.
        tolerance: distance within which a trial is a success.
        seeds: (B,), of the resets that ``start`` was seen after; none where states can be set.
        success: of executed states (B, T + 1, dx) whether, or how far from, success: (B,).
        success_for: targets (B, dg) -> success, where it depends on them.
        action_dim: du.
        idle: (du,), the action in [-1, 1] that does nothing; zeros without.

    Raises:
        TypeError: an argument of another kind.
        ValueError: a target out of the arm's reach, a horizon beyond the environment's limit of
            time, or a reward that is not one number per step.
        FloatingPointError: the reward is NaN for a robot that stands still.
    """

    name: str
    env: str
    start: np.ndarray
    target: Tensor
    reward_for: Callable[[Tensor], Reward]
    position: slice | None = None
    horizon: int = HORIZON["reach"]
    tolerance: float = TOLERANCE["reach"]
    seeds: tuple[int, ...] = ()
    success: Success | None = None
    action_dim: int = 2
    idle: Tensor | None = None
    success_for: Callable[[Tensor], Success] | None = None

    def __repr__(self) -> str:
        return f"Task({self.name!r}, {self.env!r}, {len(self.start)} starts, {self.horizon} steps)"

    @classmethod
    def from_env(
        cls,
        env: str,
        *,
        n: int,
        horizon: int,
        reward: Reward | None = None,
        seed: int = 1000,
        success: Success | None = None,
        tolerance: float | None = None,
        name: str = "",
    ) -> Task:
        """A task of any environment, whose starts are its own resets.

        Neighbouring seeds share starts: ``collect_random`` begins its episode i by the reset of its
        ``seed + i``. The default is held out from up to 1,000 episodes of seed 0.

        Args:
            env: id of the environment.
            n: B, starts, from the resets of the seeds ``seed``, ``seed + 1``, ...; of an arm true
                states, from one reset of ``seed``.
            horizon: T, steps.
            reward: a torch function of states (..., B, T, dx) and actions (..., B, T, du), one
                number per step; None for the environment's own (``rewards.reward_of``).
                ``rewards.until`` says what counts where episodes end early.
            seed: of the first reset, 0 or above.
            success: of executed states (B, T + 1, dx) a bool, or a distance: (B,).
            tolerance: the distance that counts as a success; needed where ``success`` is one.
            name: of the task; the id without.

        Returns:
            The task.

        Raises:
            UnsupportedEnvironment: the same seed does not give the same start twice.
            ValueError: ``success`` is a distance and there is no ``tolerance``.
        """
        require_type("env", env, str, "an id, such as 'Pendulum-v1'")
        n, seed = require_count("n", n, most=MOST), require_seed("seed", seed)
        if tolerance is not None:
            tolerance = require_number("tolerance", tolerance, 0)
        require_type("name", name, str, "a text")
        begun, start = begin(env, n, seed)
        scored = reward_of(env) if reward is None else reward
        require_reward(scored)
        task = cls(
            name=name or begun.id,
            env=env if isinstance(begun, Arms) else begun.id,
            start=start,
            target=torch.zeros(n, 0),
            reward_for=lambda _: scored,
            horizon=horizon,
            tolerance=tolerance or 0.0,
            # An arm begins in any state.
            seeds=() if isinstance(begun, Arms) else tuple(range(seed, seed + n)),
            success=success,
            action_dim=begun.action_dim,
            idle=torch.from_numpy(begun.idle),
        )
        if success is not None and tolerance is None:
            still = torch.from_numpy(start)[:, None].expand(-1, task.horizon + 1, -1)
            distance, _ = task.judged(still)
            if not distance.isnan().all():
                raise ValueError(
                    f"success of task {task.name!r} is a distance, {float(distance[0]):.3g} at the "
                    "first start, and no tolerance is given; give one, tolerance=0.05 for "
                    "example, or a success that is true or false"
                )
        return task

    @classmethod
    def standard(cls, env: str, start: np.ndarray, target: Tensor) -> Task:
        """The paper's task of an arm: to push the object to the target, or else to reach it.

        Args:
            env: id of the arm.
            start: (B, dx), states.
            target: (B, 2), metres.

        Returns:
            The task.
        """
        push = EnvSpec.parse(env).task == "push"
        kind = "push" if push else "reach"  # around an obstacle too
        return cls(
            name=kind,
            env=env,
            start=start,
            target=target,
            reward_for=rewards.push if push else rewards.reach,
            position=rewards.BLOCK if push else rewards.TIP,
            horizon=HORIZON[kind],
            tolerance=TOLERANCE[kind],
        )

    def __post_init__(self) -> None:
        for field in ("name", "env"):
            require_type(f"{field} of a task", getattr(self, field), str, "a text")
        hint = "a function of targets that gives a reward, such as tsmlib.rewards.reach"
        require_callable("reward_for", self.reward_for, hint)
        if self.success is not None:
            require_callable("success", self.success, "a function of states (B, T + 1, dx)")
        start = as_tensor("start", self.start, ("B", "dx"))
        if not len(start):
            raise ValueError(f"task {self.name!r} has no start; expected at least one")
        du = require_count("action_dim", self.action_dim, most=MOST)
        idle = torch.zeros(du) if self.idle is None else as_tensor("idle", self.idle, (du,))
        checked: dict[str, object] = {
            "start": start.numpy(),
            "target": as_tensor("target", self.target, (len(start), "dg")),
            "horizon": require_count("horizon", self.horizon, most=MOST),
            "tolerance": require_number("tolerance", self.tolerance, 0),
            "seeds": tuple(require_seed("a seed", seed) for seed in self.seeds),
            "idle": idle,
        }
        for field, value in checked.items():
            object.__setattr__(self, field, value)
        if self.seeds:  # an arm goes on
            require_within_limit(self.env, self.horizon)
        if self.seeds and len(self.seeds) != len(self):
            raise ValueError(
                f"{len(self.seeds)} seeds for {len(self)} starts of {self.env}; expected one each"
            )
        if self.position is not None:
            require_reachable(self.env, self.start, self.target, self.position)
        # Standing still, in the shape in which planners ask.
        states = start[:, None].expand(2, 1, -1, self.horizon, -1)
        per_step = rewarded(self.reward, states, self.idle_actions()[None])
        if not torch.isfinite(per_step).all():
            body = "a robot" if self.position is None else "an arm"
            raise ValueError(
                f"the reward of task {self.name!r} is infinite for {body} that stands still"
            )

    def __len__(self) -> int:
        return len(self.start)

    @property
    def reward(self) -> Reward:
        """The task's reward, one target per instance."""
        return self.reward_for(self.target)

    @property
    def robot(self) -> Robot:
        """What the numbers of states and actions mean."""
        return _robot(self.env, find_spec(self.env).entry_point)  # type: ignore[arg-type]

    @property
    def begins_by_seed(self) -> bool:
        """Whether episodes begin by the seed of a reset; those of the arms begin in any state."""
        return bool(self.seeds)

    @property
    def is_standard(self) -> bool:
        """Whether the reward is the paper's."""
        return self.reward_for in (rewards.reach, rewards.push)

    def idle_actions(self) -> Tensor:
        """Do nothing: the floor below which a plan does harm.

        Returns:
            Actions (B, T, du) in [-1, 1].
        """
        assert self.idle is not None  # see __post_init__
        return self.idle.expand(len(self), self.horizon, -1).clone()

    def with_reward(
        self, name: str, reward: Reward, *, target: Tensor | None = None, horizon: int | None = None
    ) -> Task:
        """A task of one's own from these starts, in which the same has to arrive.

        Args:
            name: of the task.
            reward: a torch function of states (..., B, T, dx) and actions (..., B, T, du), one
                number per step (..., B, T), differentiable if ``adam`` is to plan. It sees the
                whole episode, so that it may depend on the time.
            target: (dg,) or (B, dg), where it should end, for distances and pictures.
            horizon: T, steps; as it was without.

        Returns:
            The task.
        """
        require_reward(reward)
        goal = self.target
        if target is not None:
            dg = goal.shape[1] or "dg"
            sizes = (dg,) if np.ndim(target) == 1 else (len(self), dg)
            goal = as_tensor("target", target, sizes).expand(len(self), -1)
        steps = self.horizon if horizon is None else horizon
        return replace(self, name=name, target=goal, reward_for=lambda _: reward, horizon=steps)

    def judged(self, states: Tensor) -> tuple[Tensor, Tensor | None]:
        """What executed episodes are judged by.

        Args:
            states: (B, T + 1, dx).

        Returns:
            Final distance (B,), NaN where none is measured; and success (B,) bool, or None.

        Raises:
            ValueError: the task's ``success`` gives something else, or NaN.
        """
        judge = self.success_for(self.target) if self.success_for else self.success
        if judge is None and self.position is not None:
            distance = rewards.final_distance(states, self.target, self.position)
            return distance, distance <= self.tolerance
        nothing = states.new_full((len(self),), torch.nan)
        if judge is None:
            return nothing, None
        success = judge(states)
        if not isinstance(success, Tensor) or success.shape != (len(self),):
            raise ValueError(
                f"success of task {self.name!r} is {described(success)} for states "
                f"{tuple(states.shape)}; expected ({len(self)},), bool or a distance"
            )
        if success.isnan().any():
            raise ValueError(f"success of task {self.name!r} is nan; expected a bool or a distance")
        if success.dtype == torch.bool:
            return nothing, success
        return success.to(states.dtype), success <= self.tolerance

    def past(self, past_len: int) -> Segment:
        """The past before the first step.

        Args:
            past_len: L, steps, as ``model.past_len`` has it.

        Returns:
            x_0 repeated and no actions: (B, L, dx) and (B, L, du).
        """
        steps = require_count("past_len", past_len, most=MOST)
        return initial_past(torch.from_numpy(self.start).float(), steps, self.action_dim)

    def take(self, chosen: int | Sequence[int]) -> Task:
        """Some of the instances.

        Args:
            chosen: the number of first ones, or their indices.

        Returns:
            The task with these alone.

        Raises:
            ValueError: there is none, or not as many.
        """
        indices = chosen_indices(chosen, len(self), self.env)
        seeds = tuple(self.seeds[i] for i in indices) if self.seeds else ()
        return replace(self, start=self.start[indices], target=self.target[indices], seeds=seeds)

    def require_robot(self, robot: Robot | None, what: str) -> None:
        """Require that a robot is this task's, and warn where it is of another environment.

        A model of the standard arm may plan for a variant: the id alone is no error.

        Args:
            robot: of a model or data; None is not compared.
            what: what the two are of, such as "the model and the task".

        Raises:
            TrajectoryError: they differ in more than the environment.
        """
        if robot is None or robot == self.robot:
            return
        robot.require_same(self.robot, what, but=("env",))
        warn_of_other_env(robot, self.robot, what)

    def require_start(self, states: Tensor, what: str) -> None:
        """Require that states are this task's starts, up to rounding.

        Args:
            states: (B, dx) in physical units.
            what: what begins in them, for the message.

        Raises:
            ValueError: they are others.
        """
        name = f"task {self.name!r} of {self.env}"
        require_same_starts(states, torch.from_numpy(self.start), what, name)


@cache
def _robot(env: str, made_by: object) -> Robot:
    """The robot of an id, until something else is registered under it."""
    with closing(make_simulation(env, 1)) as run:
        return Robot(run.id, run.dt, run.names, run.units, run.angles, run.action_dim)
