"""Tasks: frozen starts, reward and measure of success in an environment; targets of the arm's; reference torques."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace

import gymnasium
import numpy as np
import torch
from torch import Tensor

from tsmlib import rewards
from tsmlib.collection import smooth_torques
from tsmlib.envs.geometry import hole, room
from tsmlib.envs.spec import EnvSpec
from tsmlib.envs.stepping import Arms, make_simulation
from tsmlib.rewards import Reward, rewarded
from tsmlib.sampling import generator_of
from tsmlib.trajectory import Segment, initial_past

HORIZON = {"reach": 50, "push": 100}  # steps of 0.02 s
TOLERANCE = {"reach": 0.03, "push": 0.05}  # metres: a trial that ends within it is a success


Success = Callable[
    [Tensor], Tensor
]  # states (B, T + 1, dx) -> (B,): bool, or a distance to be within the tolerance


@dataclass(frozen=True, repr=False)
class Task:
    """B instances of one task in one environment. start (B, dx), horizon in steps.

    reward_for: targets -> reward. seeds (B,): of the resets that ``start`` was seen after, where states cannot be set.
    success: what an executed episode is judged by, if anything; tolerance: of a distance. target (B, dg), position: of
    the arm's tasks, in metres, and what has to arrive there, fingertip or object; (B, 0) and None of others.

    ``from_env`` makes one of any environment; ``standard`` gives the paper's, ``with_reward`` another reward from the
    same starts. ValueError where a target is out of the arm's reach, the horizon beyond the environment's limit of
    time, or the reward not one number per step; FloatingPointError where it is NaN.
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

    def __repr__(self) -> str:
        return f"Task({self.name!r}, {self.env!r}, {len(self.start)} starts, {self.horizon} steps)"

    @classmethod
    def from_env(
        cls,
        env: str,
        *,
        n: int,
        horizon: int,
        reward: Reward,
        seed: int = 1000,
        success: Success | None = None,
        tolerance: float | None = None,
        name: str = "",
    ) -> Task:
        """``n`` starts of any environment, from the resets of the seeds ``seed``, ``seed + 1``, ...; of an arm, true
        states whatever its sensors say, from one reset of ``seed``, in which start i is a function of it and of i.

        Neighbouring seeds share starts: ``collect_random`` begins its episode i by the reset of its ``seed + i``. The
        default is held out from up to 1,000 episodes of its seed 0; of more, or of another seed, give the first beyond
        theirs, which is that seed plus the number of episodes.

        reward: a torch function of states (..., B, T, dx) and actions (..., B, T, du), one number per step. Where the
        environment ends episodes early, ``rewards.until`` says to planners what it does not count after an end.

        ValueError where ``success`` gives a distance and no ``tolerance``, the distance that counts as a success.
        """
        seed, plain = int(seed), EnvSpec.parse(env).arm.id if env.startswith("tsm/") else env
        with closing(make_simulation(plain, n)) as begun:
            start = begun.reset(seed=seed).astype(np.float32)
        seeds = (
            () if isinstance(begun, Arms) else tuple(range(seed, seed + n))
        )  # an arm begins in any state
        task = cls(
            name or env,
            env,
            start,
            torch.zeros(n, 0),
            lambda _: reward,
            None,
            horizon,
            tolerance or 0.0,
            seeds,
            success,
            begun.action_dim,
        )
        if success is not None and tolerance is None:
            away, _ = task.judged(
                torch.from_numpy(start)[:, None].expand(-1, horizon + 1, -1)
            )  # standing still
            if not away.isnan().all():
                raise ValueError(
                    f"success of task {task.name!r} is a distance, {float(away[0]):.3g} at the first start, and no "
                    "tolerance is given; give the distance within which a trial is a success, tolerance=0.05 for "
                    "example, or a success that is true or false"
                )
        return task

    @classmethod
    def standard(cls, env: str, start: np.ndarray, target: Tensor) -> Task:
        """The paper's task of an environment: to push the object to the target, or to reach it where there is none."""
        if EnvSpec.parse(env).task == "push":
            return cls(
                "push",
                env,
                start,
                target,
                rewards.push,
                rewards.BLOCK,
                HORIZON["push"],
                TOLERANCE["push"],
            )
        return cls("reach", env, start, target, rewards.reach, rewards.TIP)

    def __post_init__(self) -> None:
        if self.horizon < 1:
            raise ValueError(f"horizon is {self.horizon}, expected a positive number of steps")
        spec = gymnasium.registry.get(self.env.partition("(")[0]) if self.seeds else None  # an arm goes on
        if spec and (limit := spec.max_episode_steps) and self.horizon > limit:
            raise ValueError(
                f"horizon is {self.horizon}, but {self.env} ends episodes after {limit} steps; give horizon={limit} or "
                f"less, or register a longer one: gymnasium.register(id, ..., max_episode_steps={self.horizon})"
            )
        if self.seeds and len(self.seeds) != len(self):
            raise ValueError(
                f"{len(self.seeds)} seeds for {len(self)} starts of {self.env}; expected one each"
            )
        if self.position is not None:
            require_reachable(self.env, self.start, self.target, self.position)
        # Standing still, in the shape in which planners ask.
        states = torch.from_numpy(self.start).float()[:, None].expand(2, 1, -1, self.horizon, -1)
        found = rewarded(
            self.reward, states, states.new_zeros(1, len(self), self.horizon, self.action_dim)
        )
        if not torch.isfinite(found).all():
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
    def begins_by_seed(self) -> bool:
        """Whether episodes begin by the seed of a reset: of every robot but the arms, which begin in any state."""
        return bool(self.seeds)

    @property
    def is_standard(self) -> bool:
        """Whether the reward is the paper's."""
        return self.reward_for in (rewards.reach, rewards.push)

    def with_reward(
        self, name: str, reward: Reward, *, target: Tensor | None = None, horizon: int | None = None
    ) -> Task:
        """A task of one's own from these starts, in which the same has to arrive.

        reward: any torch function of states (..., B, T, dx) and actions (..., B, T, du) that gives one number per
        step, (..., B, T), differentiable if it is to be planned for with Adam. It always sees the whole episode, so
        that it may depend on the time. target (2,) or (B, 2): where it should end, for final_distance and pictures.
        """
        goal = self.target if target is None else target.float().expand(len(self), -1)
        steps = self.horizon if horizon is None else horizon
        return replace(self, name=name, target=goal, reward_for=lambda _: reward, horizon=steps)

    def judged(self, states: Tensor) -> tuple[Tensor, Tensor | None]:
        """Final distance (B,), NaN where none is measured, and success (B,) bool, of executed states (B, T + 1, dx)."""
        if self.success is None and self.position is not None:
            away = rewards.final_distance(states, self.target, self.position)
            return away, away <= self.tolerance
        nothing = states.new_full((len(self),), torch.nan)
        if self.success is None:
            return nothing, None
        found = self.success(states)
        if not isinstance(found, Tensor) or found.shape != (len(self),):
            what = (
                f"a tensor {tuple(found.shape)}"
                if isinstance(found, Tensor)
                else f"a {type(found).__name__}"
            )
            raise ValueError(
                f"success of task {self.name!r} is {what} for states {tuple(states.shape)}; expected ({len(self)},), "
                "bool or a distance"
            )
        return (nothing, found) if found.dtype == torch.bool else (found, found <= self.tolerance)

    def past(self, past_len: int) -> Segment:
        """The past before the first step: x_0 repeated, zero actions."""
        return initial_past(torch.from_numpy(self.start).float(), past_len, self.action_dim)

    def take(self, chosen: int | Sequence[int]) -> Task:
        """The first instances, or those of some indices; ValueError where there is none, or not as many."""
        chosen = int(chosen) if isinstance(chosen, np.integer) else chosen
        if isinstance(chosen, int) and not 1 <= chosen <= len(self):
            raise ValueError(
                f"{chosen} targets of {self.env} asked for; choose a number from 1 to {len(self)}"
            )
        each = list(range(chosen)) if isinstance(chosen, int) else list(chosen)
        if not each or not all(0 <= i < len(self) for i in each):
            raise ValueError(
                f"targets {each} of {self.env} asked for; choose some from 0 to {len(self) - 1}"
            )
        seeds = tuple(self.seeds[i] for i in each) if self.seeds else ()
        return replace(self, start=self.start[each], target=self.target[each], seeds=seeds)

    def times(self, n: int) -> Task:
        """All instances n times over, for as many copies of a policy."""
        start, target = np.tile(self.start, (n, 1)), self.target.repeat(n, 1)
        return replace(self, start=start, target=target, seeds=self.seeds * n)


def require_reachable(env: str, start: np.ndarray, target: Tensor, position: slice) -> None:
    """ValueError unless there is one target (B, 2) per start, in metres, where the arm's fingertip or object gets."""
    if position.stop > start.shape[1]:
        raise ValueError(f"there is nothing to push in {env}; its task is 'reach'")
    if target.shape != (len(start), 2):
        raise ValueError(
            f"target is {tuple(target.shape)}, expected ({len(start)}, 2): one per start"
        )
    physics = EnvSpec.parse(env).physics
    if position == rewards.TIP:
        reach, inner, away = sum(physics.link_lengths), hole(physics), target.norm(dim=1)
        within, what = (away <= reach + 1e-6) & (away >= inner - 1e-6), "fingertip"
        limit = f"{reach:g} m from the shoulder" + (
            f" and not into the hole around it, expected {inner:g} to {reach:g} m" if inner else ""
        )
    else:
        within, what = target.abs().amax(1) <= room(physics) + 1e-6, "object"
        limit = f"{room(physics):g} m along x and y, where the walls are"
    if not within.all():
        i = int((~within).nonzero()[0])
        raise ValueError(
            f"target {i} at ({target[i, 0]:.3f}, {target[i, 1]:.3f}) m is out of reach: "
            f"the {what} gets as far as {limit}"
        )


def zero_torques(task: Task) -> Tensor:
    """No torque at all: the floor below which a plan does harm. (B, T, du)."""
    return torch.zeros(len(task), task.horizon, task.action_dim)


RANDOM_TORQUES = 1  # first part of the key of their random numbers, which no data are drawn from


def random_torques(task: Task, *, seed: int = 0) -> Tensor:
    """Torques like the arm's training data's. (B, T, du)."""
    generator = generator_of(RANDOM_TORQUES, seed)
    return smooth_torques(len(task), task.horizon, generator=generator, action_dim=task.action_dim)
