"""Pictures of robots that are not arms, drawn from their observations with Pillow: nothing needs
OpenGL or pygame.

A predicted rollout is a sequence of observations, of which an environment's own ``render`` knows
nothing. Drawn are Pendulum-v1, the tasks of ``dmc``, and from the side the robots of MuJoCo that
observe their positions, the first of which may be left out, and then their velocities: HalfCheetah,
Hopper, Walker2d, InvertedPendulum.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from tsmlib.envs.spec import CONTROL_IDS
from tsmlib.envs.stepping import make

WIDTH, HEIGHT, SMOOTH = 480, 300, 2  # pixels; of a picture that is drawn so many times as large
ACROSS = 3.2  # metres from edge to edge
BELOW = 0.3  # metres of ground that are seen
SKY, GROUND, MARK, EDGE, BODY, OTHER = (
    "#FAFAF8",
    "#D5DAE0",
    "#7B8794",
    "#22303C",
    "#56B4E9",
    "#E69F00",
)

Points = np.ndarray  # (..., 2), metres across and up


class _Picture:
    """One frame. left, bottom: metres at its lower left corner."""

    def __init__(self, left: float, bottom: float, across: float = ACROSS) -> None:
        self.left, self.bottom, self.scale = left, bottom, SMOOTH * WIDTH / across
        self.edge = 0.012 * across / ACROSS
        self.image = Image.new("RGB", (SMOOTH * WIDTH, SMOOTH * HEIGHT), SKY)
        self.draw = ImageDraw.Draw(self.image)

    def pixels(self, points: Points) -> list[tuple[float, float]]:
        across, up = (np.asarray(points) - (self.left, self.bottom)).T * self.scale
        return list(zip(across.tolist(), (SMOOTH * HEIGHT - up).tolist(), strict=True))

    def rod(self, ends: Points, radius: float, colour: str) -> None:
        """A line (2, 2) with round ends, and an edge around it."""
        for grown, fill in ((radius + self.edge, EDGE), (radius, colour)):
            reach = grown * self.scale
            for x, y in (corners := self.pixels(ends)):
                self.draw.ellipse((x - reach, y - reach, x + reach, y + reach), fill)
            self.draw.line(corners, fill, round(2 * reach))

    def ground(self) -> None:
        """The ground at height 0, with its metres."""
        (_, level), *_ = self.pixels(np.zeros((1, 2)))
        self.draw.rectangle((0, level, SMOOTH * WIDTH, SMOOTH * HEIGHT), GROUND)
        for place in range(math.floor(self.left), math.ceil(self.left + ACROSS) + 1):
            line = self.pixels(np.array([[place, 0], [place, -0.08]]))
            self.draw.line(line, MARK, 2 * SMOOTH)
            self.draw.text(line[1], f"{place} m", MARK, _font(), anchor="mt")

    def array(self) -> np.ndarray:
        return np.asarray(self.image.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS))


@cache
def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(13 * SMOOTH)


def drawable(env_id: str) -> bool:
    """Whether ``frames`` can draw this environment."""
    return env_id == "Pendulum-v1" or env_id in CONTROL_IDS or _hidden_positions(env_id) is not None


def frames(env_id: str, states: np.ndarray) -> np.ndarray:
    """Pictures (T, height, width, 3) of observations (T, dx); ValueError of an environment that is
    not drawable.
    """
    if env_id == "Pendulum-v1":
        return np.stack([_pendulum(state) for state in states])
    if env_id in CONTROL_IDS:
        return _of_control(_robot(env_id), np.asarray(states, np.float64))
    hidden = _hidden_positions(env_id)
    if hidden is None:
        raise ValueError(
            f"{env_id} cannot be drawn from its observations; film it by its own "
            "render_mode='rgb_array'"
        )
    return _from_the_side(_robot(env_id), np.asarray(states, np.float64), hidden)


def _pendulum(state: np.ndarray) -> np.ndarray:
    """(cos, sin, speed), the angle from above and anticlockwise."""
    picture = _Picture(-ACROSS / 2, -ACROSS * HEIGHT / WIDTH / 2)
    tip = 0.85 * np.array([-state[1], state[0]]) / max(1e-6, float(np.hypot(state[0], state[1])))
    picture.rod(np.stack([np.zeros(2), tip]), 0.09, BODY)
    picture.rod(np.zeros((2, 2)), 0.04, EDGE)
    return picture.array()


def _from_the_side(robot: Any, states: np.ndarray, hidden: int) -> np.ndarray:
    """hidden: how many of the first positions are not observed; they are summed up from their
    velocities.
    """
    import mujoco

    model, data = robot.model, mujoco.MjData(robot.model)
    speeds = states[:, -model.nv :]
    unseen = np.cumsum(speeds[:, :hidden], 0) * robot.dt
    positions = np.concatenate([unseen, states[:, : model.nq - hidden]], 1)
    bodies = np.flatnonzero(model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE))
    found = []
    for position in positions:
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        middle = data.geom_xpos[bodies][:, [0, 2]]
        picture = _Picture(float(position[0]) - ACROSS / 2, -BELOW)
        picture.ground()
        for place, i in sorted(
            zip(middle, bodies, strict=True), key=lambda pair: -data.geom_xpos[pair[1], 1]
        ):
            half = _half_length(model, int(i)) * data.geom_xmat[i].reshape(3, 3)[[0, 2], 2]
            # Left leg, or hind leg.
            second = "left" in (name := model.geom(i).name) or name.startswith("b")
            picture.rod(
                np.stack([place - half, place + half]),
                float(model.geom_size[i, 0]),
                OTHER if second else BODY,
            )
        found.append(picture.array())
    return np.stack(found)


def _of_control(robot: Any, states: np.ndarray) -> np.ndarray:
    """The tasks of ``dmc``: the reacher from above, the others from the side."""
    import mujoco

    model, data, target = robot.model, mujoco.MjData(robot.model), robot.target_radius
    (left, bottom, across), axes = robot.view, [0, 1] if target else [0, 2]
    kinds, pictures = mujoco.mjtGeom, []
    for state in states:
        data.qpos[:] = state[: model.nq]
        mujoco.mj_kinematics(model, data)
        picture = _Picture(left, bottom, across)
        if target:
            picture.rod(np.stack([state[-2:]] * 2), target, OTHER)
        if model.ntendon:
            picture.draw.line(picture.pixels(data.site_xpos[:, axes]), EDGE, 2)
        for i in np.flatnonzero(model.geom_type != int(kinds.mjGEOM_PLANE)):
            place, (wide, _, high) = data.geom_xpos[i, axes], model.geom_size[i]
            if model.geom_type[i] == int(kinds.mjGEOM_BOX):
                corners = picture.pixels(place + np.array([[-wide, high], [wide, -high]]))
                picture.draw.rectangle((*corners[0], *corners[1]), MARK, EDGE, 2 * SMOOTH)
                continue
            half = _half_length(model, int(i)) * data.geom_xmat[i].reshape(3, 3)[axes, 2]
            ball = model.geom_type[i] == int(kinds.mjGEOM_SPHERE) and not target
            picture.rod(np.stack([place - half, place + half]), wide, OTHER if ball else BODY)
        pictures.append(picture.array())
    return np.stack(pictures)


def _half_length(model: Any, geom: int) -> float:
    """Of a capsule or a cylinder along its own third axis; of a ball 0."""
    import mujoco

    long = int(model.geom_type[geom]) in map(
        int, (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER)
    )
    return float(model.geom_size[geom, 1]) if long else 0.0


@cache
def _robot(env_id: str) -> Any:
    """The environment of an id, to draw with."""
    return make(env_id).unwrapped


@cache
def _hidden_positions(env_id: str) -> int | None:
    """How many of the first positions an observation leaves out, 0 or 1; None: it is something
    else.
    """
    robot = _robot(env_id)
    if type(getattr(robot, "data", None)).__name__ != "MjData":
        return None
    seen, _ = robot.reset(seed=0)
    for hidden in (0, 1):
        inside = np.concatenate([robot.data.qpos[hidden:], robot.data.qvel])
        if seen.shape == inside.shape and np.allclose(seen, inside):
            return hidden
    return None
