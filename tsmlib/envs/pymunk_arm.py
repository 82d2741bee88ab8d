"""The arm in pymunk (Chipmunk): the same interface and geometry as the MuJoCo arm, and a second
opinion on its physics.

Two links turn in the plane. With torques tau and viscous joint damping d, away from contacts and
the elbow's limit,

    (I + m l^2) dw_1 = tau_0 - tau_1 - d q'_0 + d q'_1        I dw_2 = tau_1 - d q'_1        q' =
    (w_1, w_2 - w_1)

where w are the links' speeds in the world, I and d are the armature and damping of Gymnasium's
Reacher, and m is the second link's mass, which sits in the elbow at distance l from the shoulder.
(In MuJoCo the armature is a rotor in each joint, so a torque at the elbow does not turn the first
link there. Here it does.)
"""

from __future__ import annotations

import hashlib
import math

import numpy as np
import pymunk

from tsmlib.envs import geometry
from tsmlib.envs.arm import ArmVectorEnv
from tsmlib.envs.geometry import (
    ARM_RADIUS,
    BLOCK_DECAY,
    BLOCK_MASS,
    DT,
    ELBOW_LIMIT,
    WALL,
    capsule_length,
)
from tsmlib.envs.physics import Physics
from tsmlib.envs.spec import EnvSpec
from tsmlib.envs.unstable import SimulationUnstable

# Constant: Chipmunk scales cached impulses by dt / previous dt, and a growing dt kicks bodies.
SUBSTEPS = 10
ITERATIONS = 20
ARMATURE = 1.0  # kg m^2 and
DAMPING = Physics.damping  # N m s / rad, both Reacher's
# In kg; adds 0.1 kg m^2 at the shoulder, heavy enough for the solver to hold the elbow together.
ELBOW_MASS = 10.0
ANCHOR_MASS = 1e9  # kg; nothing moves the first link off the shoulder, it only turns
STIFF = 1e-60  # share of an overlap left after a second: a quarter is corrected in a substep
SLOP = 1e-5  # m of overlap that Chipmunk tolerates so that contacts persist
FAR = 1e6  # m
MAX_ANGLE = 1e6  # rad; beyond it, floats no longer resolve the fingertip well
MAX_JOINT_SPEED = 1e3  # rad/s; full torque throughout reaches about 200
MAX_BLOCK_SPEED = 100.0  # m/s

# The arm meets the block only, and passes over the walls and itself.
ARM, BLOCK, WALLS = 0b001, 0b010, 0b100


def physics_hash(env_id: str) -> str:
    """SHA-256 of the numbers that decide how an environment moves; the same on every machine."""
    arm = EnvSpec.parse(env_id)
    lengths, physics = arm.physics.link_lengths, arm.physics
    # Nothing slides and there are no walls but on push; the others keep the numbers that their
    # files were made with.
    decay, wall = (geometry.slide_time(physics), WALL) if arm.task == "push" else (0.2, 0.28)
    numbers = (
        env_id,
        DT,
        SUBSTEPS,
        ITERATIONS,
        SLOP,
        STIFF,
        geometry.GEAR * physics.torque_gain,
        lengths,
        capsule_length(lengths),
        ARM_RADIUS,
        ARMATURE,
        physics.damping,
        ELBOW_MASS,
        ANCHOR_MASS,
        ELBOW_LIMIT,
        physics.object_radius,
        physics.mass,
        decay,
        geometry.FRICTION,
        geometry.RESTITUTION,
        wall,
    )
    return hashlib.sha256(repr(numbers).encode()).hexdigest()


class PymunkArm(ArmVectorEnv):
    """N arms in N pymunk spaces, built anew at every reset, so that an episode is a function of its
    start and actions.

    One space is a few microseconds of C per substep, so the episodes are simulated one after
    another.
    """

    def _start(self, states: np.ndarray) -> None:
        self._starts = states.copy()
        self._history = np.zeros((self.num_envs, 0, 2))  # actions since the reset
        self._live: list[_Episode | None] = [None] * self.num_envs

    def _simulate(self, actions: np.ndarray) -> np.ndarray:
        states = np.empty((*actions.shape[:2], len(self.names)))
        history = np.concatenate([self._history, actions], axis=1)
        over = self._history.shape[1] < self.max_episode_steps <= history.shape[1]
        live = self._live
        self._live = [None] * self.num_envs  # after a fault every episode is replayed
        for i, torques in enumerate(self._torques(actions)):
            episode = live[i] or self._replayed(i)
            for t, (shoulder, elbow) in enumerate(torques):
                state = episode.step(shoulder, elbow)
                if reason := _fault(state):
                    raise SimulationUnstable(self.env_id, i, t, reason)
                states[i, t] = state
            # At the time limit the space, about 150 kB, is given back.
            live[i] = None if over else episode
        self._live, self._history = live, history
        return states

    def _torques(self, actions: np.ndarray) -> list:
        """Actions (..., 2) in N m."""
        return (geometry.GEAR * self.physics.torque_gain * actions).tolist()

    def _replayed(self, i: int) -> _Episode:
        """Episode i, built at its start and brought to the present."""
        episode = _Episode(self.task, self.physics, self._starts[i].tolist())
        for shoulder, elbow in self._torques(self._history[i]):
            episode.step(shoulder, elbow)
        return episode


class _Episode:
    """One arm and what it can touch, in a space of its own. ``state`` is a list of dx numbers."""

    def __init__(self, task: str, physics: Physics, state: list[float]) -> None:
        self.physics = physics
        self.space = pymunk.Space()
        self.space.iterations = ITERATIONS
        self.space.collision_slop = SLOP
        self.space.collision_bias = STIFF
        self._add_arm(*state[:4])
        self.block: pymunk.Body | None = None
        self.obstacle: tuple[float, ...] = ()
        if task == "push":
            self._add_block((state[6], state[7]), (state[8], state[9]))
            self._add_walls()
        elif task == "obstacle":
            self.obstacle = (*state[6:8], 0.0, 0.0)
            self._add_disc(self.space.static_body, (state[6], state[7]))

    def step(self, shoulder: float, elbow: float) -> tuple[float, ...]:
        """Apply the torques (N m) for one step of DT and give the state."""
        link1, link2, step = self.link1, self.link2, self.space.step
        for _ in range(SUBSTEPS):
            link1.torque = shoulder - elbow
            link2.torque = elbow
            step(DT / SUBSTEPS)
        q, w, reach = link1.angle, link1.angular_velocity, link2.angle
        first, second = self.physics.link_lengths
        tip_x = first * math.cos(q) + second * math.cos(reach)
        tip_y = first * math.sin(q) + second * math.sin(reach)
        arm = (q, reach - q, w, link2.angular_velocity - w, tip_x, tip_y)
        return (
            (*arm, *self.block.position, *self.block.velocity)
            if self.block
            else arm + self.obstacle
        )

    def _add_arm(self, q0: float, q1: float, dq0: float, dq1: float) -> None:
        (length, second), damping = self.physics.link_lengths, self.physics.damping
        self.link1 = pymunk.Body(ANCHOR_MASS, ARMATURE)
        self.link2 = pymunk.Body(ELBOW_MASS, ARMATURE)
        self.link1.angle, self.link1.angular_velocity = q0, dq0
        self.link2.angle, self.link2.angular_velocity = q0 + q1, dq0 + dq1
        self.link2.position = length * math.cos(q0), length * math.sin(q0)
        self.link2.velocity = -dq0 * length * math.sin(q0), dq0 * length * math.cos(q0)
        elbow = pymunk.PivotJoint(self.link1, self.link2, (length, 0.0), (0.0, 0.0))
        limit = pymunk.RotaryLimitJoint(self.link1, self.link2, -ELBOW_LIMIT, ELBOW_LIMIT)
        elbow.error_bias = limit.error_bias = STIFF
        shoulder_damper = pymunk.DampedRotarySpring(
            self.space.static_body, self.link1, 0.0, 0.0, damping
        )
        elbow_damper = pymunk.DampedRotarySpring(self.link1, self.link2, 0.0, 0.0, damping)
        shapes = (
            pymunk.Segment(self.link1, (0.0, 0.0), (length, 0.0), ARM_RADIUS),
            pymunk.Segment(
                self.link2, (0.0, 0.0), (capsule_length(self.physics.link_lengths), 0.0), ARM_RADIUS
            ),
            pymunk.Circle(self.link2, ARM_RADIUS, (second, 0.0)),  # the fingertip
        )
        for shape in shapes:
            shape.filter = pymunk.ShapeFilter(categories=ARM, mask=BLOCK)
            shape.friction = (
                1.0  # Chipmunk multiplies the friction, and the elasticity, of the two surfaces
            )
        self.space.add(self.link1, self.link2, elbow, limit, shoulder_damper, elbow_damper, *shapes)

    def _add_block(self, position: tuple[float, float], velocity: tuple[float, float]) -> None:
        self.block = pymunk.Body(self.physics.mass, math.inf)  # it slides and does not turn
        self.block.position, self.block.velocity = position, velocity
        self.space.add(self.block)
        self._add_disc(self.block, (0.0, 0.0))
        for anchor in (
            (FAR, 0.0),
            (0.0, FAR),
        ):  # a dashpot along x and one along y: drag without a callback
            drag = BLOCK_MASS / BLOCK_DECAY
            self.space.add(
                pymunk.DampedSpring(
                    self.space.static_body, self.block, anchor, (0.0, 0.0), 0.0, 0.0, drag
                )
            )

    def _add_disc(self, body: pymunk.Body, centre: tuple[float, float]) -> None:
        disc = pymunk.Circle(body, self.physics.object_radius, centre)
        disc.filter = pymunk.ShapeFilter(categories=BLOCK)
        disc.friction, disc.elasticity = geometry.FRICTION, 1.0
        self.space.add(disc)

    def _add_walls(self) -> None:
        thick = 0.5  # m, so that nothing passes through
        far = WALL + thick
        corners = [(far, far), (-far, far), (-far, -far), (far, -far)]
        for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
            wall = pymunk.Segment(self.space.static_body, start, end, thick)
            wall.filter = pymunk.ShapeFilter(categories=WALLS, mask=BLOCK)
            wall.friction, wall.elasticity = 1.0, geometry.RESTITUTION
            self.space.add(wall)


def _fault(state: tuple[float, ...]) -> str | None:
    """What is wrong with a state, if anything; written so that a comparison with NaN fails."""
    q0, q1, dq0, dq1 = state[:4]
    if not (abs(q0) < MAX_ANGLE and abs(q1) < ELBOW_LIMIT + 1.0):
        return f"the joint angles are {q0, q1} rad, and the elbow's limit is {ELBOW_LIMIT} rad"
    if not (abs(dq0) < MAX_JOINT_SPEED and abs(dq1) < MAX_JOINT_SPEED):
        return f"the joints turn at {dq0, dq1} rad/s, expected below {MAX_JOINT_SPEED}"
    if len(state) > 6:
        x, y, vx, vy = state[6:]
        if not (abs(x) < WALL and abs(y) < WALL):
            return f"the block's centre is at {x, y} m, beyond the walls at {WALL} m"
        if not (abs(vx) < MAX_BLOCK_SPEED and abs(vy) < MAX_BLOCK_SPEED):
            return f"the block moves at {vx, vy} m/s, expected below {MAX_BLOCK_SPEED}"
    return None
