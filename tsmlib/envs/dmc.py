"""Five small tasks with the figures of the DeepMind Control Suite (Tassa et al. 2018), in MuJoCo.

Masses, lengths, gears, time steps, start distributions and rewards are the suite's. A step is two
of the suite's control steps (action repeat 2, as TD-MPC2 and others report), so an episode has 500
steps and returns at most 1,000. The state is what MuJoCo integrates: joint positions, then
velocities, then the target where there is one.

Compared with dm_control 1.0.50 under mujoco 3.17: over three episodes of 500 steps of each task,
states agree to 4e-15 and rewards to 4e-16.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gymnasium
import mujoco
import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor

REPEAT = 2  # control steps in a step
ARM_LENGTH = 0.12  # metres, of either link of the reacher, to the finger's centre
FINGER = 0.01  # metres, radius
CUP = (0.6, -0.05, 0.05 - 0.025)  # height, target below it, half width less the ball's radius
BALL_HEIGHT = 0.2


def gaussian(distance: Tensor, margin: float) -> Tensor:
    """The suite's soft tolerance: 1 at no distance, 0.1 at ``margin``."""
    return torch.exp(np.log(0.1) * (distance / margin).square())


def finger(angles: Tensor) -> Tensor:
    """Place (..., 2) of the reacher's finger, metres, from joint angles (..., 2), radians."""
    first, second = angles[..., 0], angles.sum(-1)
    across, up = first.cos() + second.cos(), first.sin() + second.sin()
    return ARM_LENGTH * torch.stack([across, up], dim=-1)


def reacher_reward(size: float) -> Callable[[Tensor, Tensor], Tensor]:
    """1 where the finger touches a target of radius ``size`` in metres, else 0."""

    def reward(states: Tensor, actions: Tensor) -> Tensor:
        return (-towards_target(states, actions) <= size + FINGER).to(states.dtype)

    return reward


def towards_target(states: Tensor, actions: Tensor) -> Tensor:
    """Minus the distance from the finger to the target, metres."""
    return -(finger(states[..., :2]) - states[..., 4:6]).norm(dim=-1)


def cartpole_reward(states: Tensor, actions: Tensor) -> Tensor:
    """Upright, in the middle, with little force and speed: a product of four numbers in [0, 1]."""
    upright = (states[..., 1].cos() + 1) / 2
    centred = (1 + gaussian(states[..., 0], 2.0)) / 2
    gentle = (4 + (1 - actions[..., 0].clamp(-1, 1).square())) / 5
    slow = (1 + gaussian(states[..., 3], 5.0)) / 2
    return upright * centred * gentle * slow


def upright(states: Tensor, actions: Tensor) -> Tensor:
    """Cosine of the pendulum's angle."""
    return states[..., 0].cos()


def pendulum_reward(states: Tensor, actions: Tensor) -> Tensor:
    """1 within 8 degrees of upright, else 0."""
    return (states[..., 0].cos() >= np.cos(np.deg2rad(8))).to(states.dtype)


def ball_in_cup(states: Tensor) -> tuple[Tensor, Tensor]:
    """Place of the ball beside and above the target in the cup, metres."""
    up = BALL_HEIGHT + states[..., 3] - (CUP[0] + CUP[1] + states[..., 1])
    return states[..., 2] - states[..., 0], up


def cup_reward(states: Tensor, actions: Tensor) -> Tensor:
    """1 where the whole ball is in the cup, else 0."""
    across, up = ball_in_cup(states)
    return ((across.abs() < CUP[2]) & (up.abs() < CUP[2])).to(states.dtype)


def around_the_rim(states: Tensor, actions: Tensor) -> Tensor:
    """Minus the way of the ball into the cup, metres: below its rim, first to a place beside it."""
    across, up = ball_in_cup(states)
    beside, rim = 0.09, 0.09
    above = (up > rim) | ((across.abs() < 0.05) & (up > -CUP[2]))
    first = torch.hypot(across.abs() - beside, up - rim) + float(np.hypot(beside, rim))
    return -torch.where(above, torch.hypot(across, up), first)


@dataclass(frozen=True)
class ControlTask:
    """One task.

    Attributes:
        model: MJCF.
        names, units, angles: of the state.
        reward: of states (..., dx) and actions (..., du).
        start: draws (qpos, qvel, target).
        guide: added to the reward to plan by, where that is mostly zero; not the suite's.
        substeps: physics steps in a control step.
        view: left and lower edge and width of its pictures, metres.
        target_radius: of the reacher's target, metres; 0 where there is none.
    """

    model: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    angles: tuple[int, ...]
    reward: Callable[[Tensor, Tensor], Tensor]
    start: Callable[[np.random.Generator], tuple[np.ndarray, ...]]
    guide: Callable[[Tensor, Tensor], Tensor] | None = None
    substeps: int = 1
    view: tuple[float, float, float] = (-0.4, -0.25, 0.8)
    target_radius: float = 0.0


def _mjcf(options: str, body: str, rest: str) -> str:
    return f"<mujoco>{options}<worldbody>{body}</worldbody>{rest}</mujoco>"


def _motors(*joints: str, gear: float) -> str:
    each = (
        f'<motor joint="{j}" gear="{gear}" ctrllimited="true" ctrlrange="-1 1"/>' for j in joints
    )
    return f"<actuator>{''.join(each)}</actuator>"


_FREE = '<flag contact="disable"/>'
REACHER = _mjcf(
    f'<option timestep="0.02">{_FREE}</option>',
    """<body pos="0 0 0.01">
      <joint name="shoulder" axis="0 0 1" damping="0.01"/>
      <geom type="capsule" fromto="0 0 0 0.12 0 0" size="0.01"/>
      <body pos="0.12 0 0">
        <joint name="wrist" axis="0 0 1" damping="0.01" limited="true" range="-160 160"/>
        <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01"/>
        <body pos="0.12 0 0"><geom type="sphere" size="0.01"/></body>
      </body>
    </body>""",
    _motors("shoulder", "wrist", gear=0.05),
)
CARTPOLE = _mjcf(
    f'<option timestep="0.01" integrator="RK4">{_FREE}</option>',
    """<body pos="0 0 1">
      <joint name="cart" type="slide" axis="1 0 0" damping="5e-4" limited="true" range="-1.8 1.8"
        solreflimit="0.08 1"/>
      <geom type="box" size="0.2 0.15 0.1" mass="1"/>
      <body>
        <joint name="pole" axis="0 1 0" damping="2e-6"/>
        <geom type="capsule" fromto="0 0 0 0 0 1" size="0.045" mass="0.1"/>
      </body>
    </body>""",
    _motors("cart", gear=10),
)
PENDULUM = _mjcf(
    f'<option timestep="0.02">{_FREE}</option>',
    """<body pos="0 0 0.6">
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="0"/>
      <geom type="sphere" pos="0 0 0.5" size="0.05" mass="1"/>
    </body>""",
    _motors("hinge", gear=1),
)
_WALLS = (
    "-0.05 0 0 -0.05 0 -0.075",
    "-0.05 0 -0.075 -0.025 0 -0.1",
    "-0.025 0 -0.1 0.025 0 -0.1",
    "0.025 0 -0.1 0.05 0 -0.075",
    "0.05 0 -0.075 0.05 0 0",
)
_SLIDE = '<joint name="{}" type="slide" axis="{}"{}/>'
_SPRING = ' damping="3" stiffness="20"'
CUP_AND_BALL = _mjcf(
    "",
    f"""<geom type="plane" size="0.6 0.2 10"/>
    <body pos="0 0 {CUP[0]}">
      {_SLIDE.format("cup_x", "1 0 0", _SPRING)}{_SLIDE.format("cup_z", "0 0 1", _SPRING)}
      {"".join(f'<geom type="capsule" size="0.008" fromto="{wall}"/>' for wall in _WALLS)}
      <site name="cup" pos="0 0 -0.108" size="0.005"/>
    </body>
    <body pos="0 0 {BALL_HEIGHT}">
      {_SLIDE.format("ball_x", "1 0 0", "")}{_SLIDE.format("ball_z", "0 0 1", "")}
      <geom type="sphere" size="0.025"/><site name="ball" size="0.005"/>
    </body>""",
    """<tendon><spatial limited="true" range="0 0.3"><site site="ball"/><site site="cup"/></spatial>
    </tendon>"""
    + _motors("cup_x", "cup_z", gear=5),
)


def _reacher_start(rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    wrist = np.deg2rad(160)
    angles = np.array([rng.uniform(-np.pi, np.pi), rng.uniform(-wrist, wrist)])
    around, away = rng.uniform(0, 2 * np.pi), rng.uniform(0.05, 0.20)
    return angles, np.zeros(2), away * np.array([np.sin(around), np.cos(around)])


def _cartpole_start(rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    place = np.array([0.0, np.pi]) + 0.01 * rng.standard_normal(2)
    return place, 0.01 * rng.standard_normal(2), np.zeros(0)


def _pendulum_start(rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    return rng.uniform(-np.pi, np.pi, 1), np.zeros(1), np.zeros(0)


def _cup_start(rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    return np.array([0, 0, rng.uniform(-0.2, 0.2), rng.uniform(0.2, 0.5)]), np.zeros(4), np.zeros(0)


def _reacher(size: float) -> ControlTask:
    names = ("shoulder", "wrist", "shoulder speed", "wrist speed", "target x", "target y")
    units = ("rad", "rad", "rad/s", "rad/s", "m", "m")
    return ControlTask(
        REACHER,
        names,
        units,
        (0, 1),
        reacher_reward(size),
        _reacher_start,
        towards_target,
        target_radius=size,
    )


TASKS = {
    "reacher-easy": _reacher(0.05),
    "reacher-hard": _reacher(0.015),
    "cartpole-swingup": ControlTask(
        CARTPOLE,
        ("cart", "pole", "cart speed", "pole speed"),
        ("m", "rad", "m/s", "rad/s"),
        (1,),
        cartpole_reward,
        _cartpole_start,
        view=(-2.4, -0.6, 4.8),
    ),
    "pendulum-swingup": ControlTask(
        PENDULUM,
        ("hinge", "hinge speed"),
        ("rad", "rad/s"),
        (0,),
        pendulum_reward,
        _pendulum_start,
        upright,
        view=(-1.28, -0.2, 2.56),
    ),
    "cup-catch": ControlTask(
        CUP_AND_BALL,
        tuple(f"{b} {a}{s}" for s in ("", " speed") for b in ("cup", "ball") for a in "xz"),
        ("m",) * 4 + ("m/s",) * 4,
        (),
        cup_reward,
        _cup_start,
        around_the_rim,
        substeps=10,
        view=(-0.8, -0.05, 1.6),
    ),
}


class ControlEnv(gymnasium.Env):
    """One of ``TASKS`` as a Gymnasium environment.

    Args:
        task: its name, such as "cartpole-swingup".

    Attributes:
        reward_function: the reward of a control step, of states (..., dx) and actions (..., du).
        guided_reward: the same with the task's guide, to plan by.
        action_repeat: control steps of the suite in one step.
        goal: dimensions of the state that no physics reads, the reacher's target.
    """

    action_repeat = REPEAT

    metadata = {"render_modes": []}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(self, task: str) -> None:
        self.task = TASKS[task]
        self.reward_function = self.task.reward
        self.view, self.target_radius = self.task.view, self.task.target_radius
        self.model = mujoco.MjModel.from_xml_string(self.task.model)
        self.data = mujoco.MjData(self.model)
        self.dt = REPEAT * self.task.substeps * self.model.opt.timestep
        self.names, self.units, self.angles = self.task.names, self.task.units, self.task.angles
        self.target = np.zeros(len(self.names) - self.model.nq - self.model.nv)
        self.goal = tuple(range(self.model.nq + self.model.nv, len(self.names)))
        self.observation_space = Box(-np.inf, np.inf, (len(self.names),), np.float64)
        self.action_space = Box(-1.0, 1.0, (self.model.nu,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, np.ndarray] | None = None
    ) -> tuple[np.ndarray, dict[str, object]]:
        """Begin an episode in ``options["states"]`` (dx,), or as the suite draws it."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        if options and "states" in options:
            nq, nv = self.model.nq, self.model.nv
            given = np.asarray(options["states"], np.float64)
            place, speed, self.target = np.split(given, [nq, nq + nv])
            self._put(place, speed)
            return self._observed(), {}
        while True:
            place, speed, self.target = self.task.start(self.np_random)
            self._put(place, speed)
            if self.data.ncon == 0:  # the ball touches nothing
                return self._observed(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, object]]:
        """Two control steps by ``action`` (du,) in [-1, 1]; the reward is the sum of both."""
        self.data.ctrl[:] = np.clip(action, -1.0, 1.0)
        total, control = 0.0, torch.from_numpy(self.data.ctrl.copy())
        for _ in range(REPEAT):
            mujoco.mj_step(self.model, self.data, self.task.substeps)
            total += float(self.task.reward(torch.from_numpy(self._observed()), control))
        return self._observed(), total, False, False, {}

    def guided_reward(self, states: Tensor, actions: Tensor) -> Tensor:
        """The task's reward and, where it has one, its guide."""
        reward = self.task.reward(states, actions)
        return reward if self.task.guide is None else reward + self.task.guide(states, actions)

    def _put(self, place: np.ndarray, speed: np.ndarray) -> None:
        self.data.qpos[:], self.data.qvel[:] = place, speed
        mujoco.mj_forward(self.model, self.data)

    def _observed(self) -> np.ndarray:
        return np.concatenate([self.data.qpos, self.data.qvel, self.target])
