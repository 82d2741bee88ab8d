"""PushT in pymunk: a round pusher moves a T in a walled field. Places are in px, y points down.

The constants are those of stable-worldmodel, so are ``gym-pusht``'s. In state x_t the pusher is
drawn to the place

    g = p_t + 100 u_t        dv = (100 (g - p) - 20 v) dt        ten times in a step of 0.1 s

and what it meets moves as it is pushed: nothing slides on, since velocities are lost from one
physics step to the next. The pusher is not stopped by anything, neither by walls; a T that it
squeezes against a wall may leave the field.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable

import gymnasium
import numpy as np
import pymunk
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from tsmlib.checks import require_choice, require_count
from tsmlib.envs.arm import OneEnv
from tsmlib.envs.pusht_field import (
    ENV_ID,
    GOAL,
    HIGH,
    LOW,
    NAMES,
    UNITS,
    WALL,
    PushTPhysics,
    clearance,
    in_field,
    placed,
    pusht_image,
    pusht_physics,
    require_in_field,
    require_states,
)
from tsmlib.envs.unstable import SimulationUnstable
from tsmlib.trajectory import Segment

DT, SUBSTEPS = 0.1, 10  # s; physics steps in each
STIFFNESS, DAMPING = 100.0, 20.0  # of the pusher's controller, 1/s^2 and 1/s
REACH = 100.0  # px from the pusher to its target at full action
FAR = 1e4  # px; beyond it a simulation has failed
Info = dict[str, np.ndarray]


class PushT(VectorEnv):
    """N fields. Episodes are not reset on their own: ``truncated`` turns true after the last step.

    ``reset(seed, options)``: ``options["states"]`` (N, 7) starts the episodes there,
    ``options["goal"]`` (7,) or (N, 7) sets the goal. Without a start, episode i is drawn from
    (seed, i) alone: pusher and T within the walls and apart.

    An episode is a function of its start and actions. Chipmunk keeps impulses that cannot be read,
    so a snapshot is the start with all actions since, and is brought back by replaying them, bit
    for bit.
    """

    metadata = {  # noqa: RUF012 - as Gymnasium declares it
        "render_modes": ["rgb_array"],
        "render_fps": round(1 / DT),
        "autoreset_mode": AutoresetMode.DISABLED,
    }
    names, units, angles, dt = NAMES, UNITS, (4,), DT

    def __init__(
        self,
        num_envs: int,
        env_id: str = ENV_ID,
        *,
        max_episode_steps: int = 300,
        render_mode: str | None = None,
    ) -> None:
        self.num_envs = require_count("num_envs", num_envs)
        self.render_mode = require_choice("render_mode", render_mode, (None, "rgb_array"))
        self.physics, self.env_id = pusht_physics(env_id), env_id
        self.max_episode_steps = max_episode_steps
        self.single_observation_space = Box(-np.inf, np.inf, (7,), np.float64)
        self.single_action_space = Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.goal = np.tile(GOAL, (num_envs, 1))
        self._root, self._resets = secrets.randbits(64), 0
        self._episodes: list[_Episode] = []

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start N episodes; gives states (N, 7) and ``{"goal": (N, 7)}``."""
        options = options or {}
        if unknown := set(options) - {"states", "goal"}:
            raise ValueError(
                f"unknown reset options {sorted(unknown)}; expected 'states' and 'goal'"
            )
        super().reset(seed=seed)
        if seed is not None:
            self._root, self._resets = seed, 0
        if "states" in options:
            states = require_states("states", options["states"], self.num_envs)
        else:
            roots = ((self._root, self._resets, i) for i in range(self.num_envs))
            states = np.stack([self._draw(np.random.default_rng(root)) for root in roots])
        self._resets += 1
        goal = np.atleast_2d(np.asarray(options.get("goal", GOAL), np.float64))
        self.goal = require_states(
            "goal", np.broadcast_to(goal, (self.num_envs, goal.shape[-1])), self.num_envs
        )
        require_in_field("goal", self.goal, self.physics)
        self._starts, self._history = states, np.zeros((self.num_envs, 0, 2))
        self._episodes = [_Episode(self.physics, start) for start in states.tolist()]
        self._states = states
        return states.copy(), {"goal": self.goal.copy()}

    def rollout(self, actions: np.ndarray) -> np.ndarray:
        """Advance by ``actions`` (N, T, 2), clipped to [-1, 1]: the states (N, T, 7) after each.

        Raises:
            ValueError: actions of another shape, or not finite; nothing was simulated.
            SimulationUnstable: the T is thrown out of the picture.
        """
        if not self._episodes:
            raise gymnasium.error.ResetNeeded(
                f"{self.env_id}: call reset() before step() or rollout()"
            )
        actions = np.asarray(actions, np.float64)
        if actions.ndim != 3 or actions.shape[::2] != (self.num_envs, 2):
            raise ValueError(
                f"actions are {actions.shape}; {self.env_id} expected (N={self.num_envs}, T, 2)"
            )
        if len(bad := np.argwhere(~np.isfinite(actions))):
            raise ValueError(
                f"actions are {actions[tuple(bad[0])]} in episode {bad[0][0]}, step {bad[0][1]}; "
                "expected finite numbers"
            )
        actions = actions.clip(-1.0, 1.0)
        states = np.empty((*actions.shape[:2], 7))
        for i, (episode, row) in enumerate(zip(self._episodes, actions.tolist(), strict=True)):
            for t, (x, y) in enumerate(row):
                states[i, t] = state = episode.step(x, y)
                if not (abs(state[2]) < FAR and abs(state[3]) < FAR):
                    step, self._episodes = t + self._history.shape[1], []
                    raise SimulationUnstable(self.env_id, i, step, f"the T is at {state[2:4]} px")
        self._history = np.concatenate([self._history, actions], axis=1)
        self._states = states[:, -1] if actions.shape[1] else self._states
        return states

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """One step by actions (N, 2): states (N, 7), rewards, terminated, truncated (N,), goals.

        The reward is minus the mean distance of the T's corners from the goal's, in hundreds of
        pixels.
        """
        states = self.rollout(np.asarray(actions)[:, None])[:, 0]
        corners = self.physics.boxes.reshape(-1, 2)
        away = np.linalg.norm(placed(corners, states) - placed(corners, self.goal), axis=-1)
        truncated = np.full(self.num_envs, self._history.shape[1] >= self.max_episode_steps)
        info = {"goal": self.goal.copy()}
        return states, -away.mean(-1) / 100.0, np.zeros(self.num_envs, bool), truncated, info

    def get_state(self) -> tuple[np.ndarray, np.ndarray]:
        """Starts (N, 7) and actions since (N, t, 2): all that the future depends on."""
        return self._starts.copy(), self._history.copy()

    def set_state(self, snapshot: tuple[np.ndarray, np.ndarray]) -> None:
        """Continue from what `get_state` gave."""
        starts, actions = snapshot
        self.reset(options={"states": starts, "goal": self.goal})
        self.rollout(actions)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A uint8 image (height, width, 3) of each; None without ``render_mode="rgb_array"``."""
        if self.render_mode is None:
            return None
        pairs = zip(self._states, self.goal, strict=True)
        return tuple(pusht_image(state, goal, self.physics) for state, goal in pairs)

    def _draw(self, rng: np.random.Generator) -> np.ndarray:
        """A first state (7,): uniform, until pusher and T are apart and in the field."""
        while True:
            places = rng.uniform([50, 50, 100, 100, -np.pi], [450, 450, 400, 400, np.pi])
            state = np.concatenate([places, np.zeros(2)])
            if in_field(state, self.physics) and clearance(state, self.physics) > 1.0:
                return state


class _Episode:
    """One field, in a space of its own."""

    def __init__(self, physics: PushTPhysics, state: list[float]) -> None:
        self.space = pymunk.Space()
        self.space.damping = 0.0
        corners = [(LOW, HIGH), (LOW, LOW), (HIGH, LOW), (HIGH, HIGH)]
        for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
            self._add(pymunk.Segment(self.space.static_body, start, end, WALL), physics)
        self.pusher = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.pusher.position, self.pusher.velocity = (state[0], state[1]), (state[5], state[6])
        self.space.add(self.pusher)
        self._add(pymunk.Circle(self.pusher, physics.radius), physics)
        boxes = [[(float(x), float(y)) for x, y in box] for box in physics.boxes]
        self.tee = pymunk.Body(1.0, len(boxes) * pymunk.moment_for_poly(1.0, boxes[0]))
        self.space.add(self.tee)
        for box in boxes:
            self._add(pymunk.Poly(self.tee, box), physics)
        middle = physics.boxes.mean((0, 1))
        self.tee.center_of_gravity = float(middle[0]), float(middle[1])
        self.tee.angle = state[4]  # before the position, which would otherwise be another
        self.tee.position = state[2], state[3]

    def _add(self, shape: pymunk.Shape, physics: PushTPhysics) -> None:
        shape.friction = physics.friction
        self.space.add(shape)

    def step(self, ux: float, uy: float) -> tuple[float, ...]:
        """The state after one step of 0.1 s."""
        pusher, space, dt = self.pusher, self.space, DT / SUBSTEPS
        (x, y), (vx, vy) = pusher.position, pusher.velocity
        goal_x, goal_y = x + REACH * ux, y + REACH * uy
        for _ in range(SUBSTEPS):
            vx += (STIFFNESS * (goal_x - x) - DAMPING * vx) * dt
            vy += (STIFFNESS * (goal_y - y) - DAMPING * vy) * dt
            pusher.velocity = vx, vy
            space.step(dt)
            x, y = pusher.position
        return (x, y, *self.tee.position, self.tee.angle, vx, vy)


class PushTEnv(OneEnv):
    """One field."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / DT)}  # noqa: RUF012
    angles, dt = (4,), DT

    def __init__(self, env_id: str = ENV_ID, render_mode: str | None = None) -> None:
        super().__init__(PushT(1, env_id, render_mode=render_mode))


def weak_policy(generator: torch.Generator, *, near: float = 100.0) -> Callable[[Segment], Tensor]:
    """The controller of random play: a target around the pusher, drawn towards the T.

    stable-worldmodel's WeakPolicy: the pusher's place plus noise, clipped to a square of half-width
    ``near`` around the T's place. Without it the pusher rarely meets the T.
    """

    def controller(past: Segment) -> Tensor:
        pusher, tee = past.states[:, -1, :2], past.states[:, -1, 2:4]
        noise = torch.rand(pusher.shape, generator=generator) * 2 - 1
        target = (pusher + REACH * noise).clamp(tee - near, tee + near)
        return ((target - pusher) / REACH).clamp(-1, 1)[:, None]

    return controller
