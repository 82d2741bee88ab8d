"""The arm in MuJoCo: Gymnasium's own Reacher, and the variants with a block edited from it.

The basic arm is the file that Gymnasium ships; only two option flags are set, so that positions,
velocities and time are the whole state (no automatic reset, no warm start of the constraint
solver). ``mujoco.rollout`` simulates all episodes in C++ threads; memory is bounded by passing it a
few hundred episodes at a time. It stops an episode at MuJoCo's first warning, which its clock then
shows.

Contacts have no friction: torques of 200 N m are so strong that friction would wedge the arm
against the obstacle.
"""

import hashlib
import operator
import os
from functools import cache
from pathlib import Path
from typing import Unpack

from tsmlib.envs.unstable import SimulationUnstable, import_mujoco, without_log

import_mujoco()

import gymnasium  # noqa: E402
import mujoco  # noqa: E402
import mujoco.rollout  # noqa: E402
import numpy as np  # noqa: E402

from tsmlib.envs.arm import ArmVectorEnv  # noqa: E402
from tsmlib.envs.geometry import (  # noqa: E402
    BLOCK_DECAY,
    BLOCK_MASS,
    DT,
    LINK_LENGTHS,
    RESTITUTION,
    WALL,
    capsule_length,
    fingertip,
)
from tsmlib.envs.physics import Changes, Physics  # noqa: E402
from tsmlib.envs.spec import EnvSpec  # noqa: E402

ASSET = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "reacher.xml"
PLANE = 0.01  # m, height of the plane in which all centres move
# Seconds, of the variants (the basic arm keeps 0.01 s): a fingertip at 30 m/s cannot step past the
# block.
TIMESTEP = 0.00125
# Seconds; the stiffest contact that is stable at this time step, and critically damped.
CONTACT_TIME = 2 * TIMESTEP
# Seconds, of the wall's spring: it returns 0.38 to 0.53 of the speed, depending on when the step
# falls.
WALL_TIME = 6 * TIMESTEP
RIGID = (0.999, 0.9999, 0.001, 0.5, 2)  # solimp: at full torque a squeeze stays below 0.1 mm
MAX_SPEED = 1e3  # rad/s or m/s; full torque held for a whole episode reaches 180 rad/s
CHUNK = 256  # episodes handed to MuJoCo together: of 100 steps of 16 substeps they are 30 MB


@cache
def load_model(env_id: str) -> mujoco.MjModel:
    """The compiled model of an environment id; shared, so treat it as read-only."""
    arm = EnvSpec.parse(env_id)
    if arm.id == arm.standard.id and arm.task == "reach":
        model = mujoco.MjModel.from_xml_path(str(ASSET))
    else:
        spec = mujoco.MjSpec.from_file(str(ASSET))
        if arm.task != "reach":
            spec.delete(spec.body("target"))
            spec.option.timestep = TIMESTEP
            spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
            _add_block(spec, arm.physics, moving=arm.task == "push")
        _change_arm(spec, arm.physics)
        model = spec.compile()
    model.opt.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_AUTORESET | mujoco.mjtDisableBit.mjDSBL_WARMSTART
    )
    return model


@cache
def physics_hash(env_id: str) -> str:
    """SHA-256 of the numbers that decide how an environment moves, as compiled; the same on every
    machine.
    """
    model = load_model(env_id)
    found = hashlib.sha256(
        repr((model.opt.timestep, int(model.opt.integrator), model.opt.disableflags)).encode()
    )
    for name in (
        "opt.gravity",
        "body_mass",
        "body_inertia",
        "body_pos",
        "body_parentid",
        "jnt_type",
        "jnt_axis",
        "jnt_range",
        "jnt_solref",
        "jnt_solimp",
        "dof_damping",
        "dof_armature",
        "geom_type",
        "geom_size",
        "geom_pos",
        "geom_bodyid",
        "geom_contype",
        "geom_conaffinity",
        "geom_condim",
        "geom_priority",
        "geom_solref",
        "geom_solimp",
        "actuator_gear",
        "actuator_ctrlrange",
    ):
        values = np.asarray(operator.attrgetter(name)(model), np.float64)
        found.update(f"{name} {np.round(values, 9).ravel().tolist()}\n".encode())
    return found.hexdigest()


def _change_arm(spec: mujoco.MjSpec, physics: Physics) -> None:
    """Joint damping, gears and lengths of a variant; Reacher's own damping is 1 N m s/rad."""
    for joint in (spec.joint("joint0"), spec.joint("joint1")):
        joint.damping = physics.damping * joint.damping
    for motor in spec.actuators:
        motor.gear = physics.torque_gain * motor.gear
    if physics.link_lengths != LINK_LENGTHS:
        first, second = physics.link_lengths
        for name, length in (("link0", first), ("link1", capsule_length(physics.link_lengths))):
            spec.geom(name).fromto = [0.0, 0.0, 0.0, length, 0.0, 0.0]
        spec.body("body1").pos = [first, 0.0, 0.0]
        spec.body("fingertip").pos = [second, 0.0, 0.0]


def _add_block(spec: mujoco.MjSpec, physics: Physics, *, moving: bool) -> None:
    """A disc among the arm's links: on two damped slides between four walls, or fixed at its mocap
    position.

    It collides as a sphere centred in the arm's plane, where sphere and disc are the same and
    contacts are exact, and is drawn as a cylinder. It cannot leave the plane, and walls are half
    spaces, so nothing passes them. No friction (condim 1), its parameters rule over the links'
    (priority 1), and group 3 is not drawn.
    """
    block = spec.worldbody.add_body(name="block", pos=[0.0, 0.0, PLANE], mocap=not moving)
    block.add_geom(
        name="block",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[physics.object_radius, 0, 0],
        mass=physics.mass,
        contype=1,
        conaffinity=0,
        condim=1,
        solref=[CONTACT_TIME, 1.0],
        solimp=RIGID,
        priority=1,
        group=3,
    )
    block.add_geom(
        name="block_drawn",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[physics.object_radius, 0.012, 0],
        mass=0,
        contype=0,
        conaffinity=0,
        rgba=[0.95, 0.7, 0.2, 1] if moving else [0.35, 0.35, 0.35, 1],
    )
    if moving:
        for axis, name in enumerate("xy"):
            block.add_joint(
                name=f"block_{name}",
                type=mujoco.mjtJoint.mjJNT_SLIDE,
                axis=np.eye(3)[axis],
                armature=0.0,
                damping=BLOCK_MASS / BLOCK_DECAY,
                limited=mujoco.mjtLimited.mjLIMITED_FALSE,
            )
        _add_walls(spec)


def _add_walls(spec: mujoco.MjSpec) -> None:
    """Four walls from which the object bounces; the arm passes over them."""
    log_e = np.log(RESTITUTION)
    # Of the damped spring that returns this share of the speed.
    damping_ratio = -log_e / np.hypot(np.pi, log_e)
    for name, axis, sign in (("east", 0, 1), ("north", 1, 1), ("west", 0, -1), ("south", 1, -1)):
        spec.worldbody.add_geom(
            name=f"wall_{name}",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0.3, 0.3, 0.01],
            pos=sign * WALL * np.eye(3)[axis] + [0, 0, PLANE],
            zaxis=-sign * np.eye(3)[axis],
            contype=0,
            conaffinity=1,
            condim=1,
            solref=[WALL_TIME, damping_ratio],
            solimp=RIGID,
            priority=2,
            group=3,
        )


class MujocoArm(ArmVectorEnv):
    """N arms in MuJoCo. ``threads`` simulate at once (by default as many as CPU cores, up to 8)."""

    def __init__(
        self,
        num_envs: int,
        env_id: str,
        *,
        threads: int | None = None,
        max_episode_steps: int = 100,
        render_mode: str | None = None,
        **changes: Unpack[Changes],
    ) -> None:
        super().__init__(
            num_envs,
            env_id,
            max_episode_steps=max_episode_steps,
            render_mode=render_mode,
            **changes,
        )
        self.model = load_model(self.env_id)
        self.frame_skip = round(DT / self.model.opt.timestep)
        threads = min(threads or min(os.cpu_count() or 1, 8), num_envs)
        self._data = [mujoco.MjData(self.model) for _ in range(threads)]
        self._pool = mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0)
        self._physics = np.zeros(
            (num_envs, mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        )
        self._obstacle = np.zeros((num_envs, 2))

    def _start(self, states: np.ndarray) -> None:
        nq, nv = self.model.nq, self.model.nv
        self._physics = np.zeros_like(self._physics)  # time, positions, velocities
        self._physics[:, 1:3] = states[:, :2]
        self._physics[:, 1 + nq : 3 + nq] = states[:, 2:4]
        if self.task == "reach":
            self._physics[:, 3:5] = self.target  # drawn there; the arm does not feel it
        elif self.task == "push":
            self._physics[:, 3:5] = states[:, 6:8]
            self._physics[:, 1 + nq + 2 : 1 + nq + nv] = states[:, 8:10]
        else:
            self._obstacle = states[:, 6:8].copy()
        self._check(self._physics[:, None], np.full(self.num_envs, -DT), 0)

    def _simulate(self, actions: np.ndarray) -> np.ndarray:
        states = np.empty((*actions.shape[:2], len(self.names)))
        ends = np.empty_like(self._physics)
        for first in range(0, self.num_envs, CHUNK):
            part = slice(first, first + CHUNK)
            physics, warned = self._advance(
                self._physics[part], self._obstacle[part], actions[part]
            )
            try:
                self._check(physics, self._physics[part, 0], first, warned)
            except SimulationUnstable as fault:
                warning = self._warning(fault.episode, actions[fault.episode, : fault.step + 1])
                raise SimulationUnstable(
                    fault.env, fault.episode, fault.step, fault.reason + warning
                ) from None
            states[part] = self._to_states(physics, self._obstacle[part])
            ends[part] = physics[:, -1]
        self._physics = ends
        return states

    def _advance(
        self, start: np.ndarray, obstacle: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """MuJoCo states (n, T, ...) after each of T steps of ``frame_skip`` substeps; whether the
        last one warned (n,).

        One more substep is taken and forgotten: an episode that stands still in it had a warning in
        the one before.
        """
        control = np.repeat(actions, self.frame_skip, axis=1)
        control = np.concatenate([control, control[:, -1:]], axis=1)
        spec = mujoco.mjtState.mjSTATE_CTRL.value
        if self.task == "obstacle":
            spec |= mujoco.mjtState.mjSTATE_MOCAP_POS.value
            position = np.concatenate([obstacle, np.full((len(obstacle), 1), PLANE)], axis=1)
            control = np.concatenate(
                [control, np.repeat(position[:, None], control.shape[1], axis=1)], axis=2
            )
        with without_log():
            physics, _ = self._pool.rollout(
                self.model, self._data, start, control, control_spec=spec
            )
        warned = physics[:, -1, 0] == physics[:, -2, 0]
        return physics[:, self.frame_skip - 1 : -1 : self.frame_skip].copy(), warned

    def _to_states(self, physics: np.ndarray, obstacle: np.ndarray) -> np.ndarray:
        """MuJoCo states (n, T, ...) to states (n, T, dx)."""
        nq, nv = self.model.nq, self.model.nv
        q, dq = physics[..., 1 : 1 + nq], physics[..., 1 + nq : 1 + nq + nv]
        parts = [q[..., :2], dq[..., :2], fingertip(q[..., :2], self.physics.link_lengths)]
        if self.task == "push":
            parts += [q[..., 2:], dq[..., 2:]]
        elif self.task == "obstacle":
            fixed = np.broadcast_to(obstacle[:, None], (*q.shape[:2], 2))
            parts += [fixed, np.zeros_like(fixed)]
        return np.concatenate(parts, axis=-1)

    def _warning(self, episode: int, actions: np.ndarray) -> str:
        """What MuJoCo warns of when an episode is stepped again from where this call began, one
        substep at a time.
        """
        data = mujoco.MjData(self.model)
        mujoco.mj_setState(
            self.model, data, self._physics[episode], mujoco.mjtState.mjSTATE_FULLPHYSICS
        )
        if self.task == "obstacle":
            data.mocap_pos[0] = (*self._obstacle[episode], PLANE)
        with without_log():
            for action in np.repeat(actions, self.frame_skip, axis=0):
                data.ctrl[:] = action
                mujoco.mj_step(self.model, data)
                for kind, warning in enumerate(data.warning):
                    if warning.number:
                        text = mujoco.mju_warningText(kind, warning.lastinfo)
                        return f" (MuJoCo: {text.rstrip('.')})"
        return ""

    def _check(
        self,
        physics: np.ndarray,
        start_time: np.ndarray,
        first: int,
        warned: np.ndarray | bool = False,
    ) -> None:
        """Raise where MuJoCo stopped, gave numbers that are not finite, or speeds beyond
        `MAX_SPEED`.
        """
        nq = self.model.nq
        clock = start_time[:, None] + DT * np.arange(1, physics.shape[1] + 1)
        stopped = np.abs(physics[..., 0] - clock) > self.model.opt.timestep / 2
        stopped[:, -1] |= warned
        with np.errstate(invalid="ignore"):
            fast = (np.abs(physics[..., 1 + nq :]) > MAX_SPEED).any(axis=-1)
        reasons = (
            ("the state is not finite", ~np.isfinite(physics).all(axis=-1)),
            (f"speed above {MAX_SPEED:g} rad/s", fast),
            ("MuJoCo stopped it", stopped),
        )
        wrong = reasons[0][1] | reasons[1][1] | reasons[2][1]
        if wrong.any():
            episode, step = np.argwhere(wrong)[0]
            reason = next(reason for reason, where in reasons if where[episode, step])
            raise SimulationUnstable(self.env_id, first + int(episode), int(step), reason)

    def close_extras(self, **kwargs: object) -> None:
        self._pool.close()
