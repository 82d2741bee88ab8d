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
    return env_id == "Pendulum-v1" or _hidden_positions(env_id) is not None


def frames(env_id: str, states: np.ndarray) -> np.ndarray:
    """Pictures (T, height, width, 3) of observations (T, dx); ValueError of an environment that is
    not drawable.
    """
    if env_id == "Pendulum-v1":
        return np.stack([_pendulum(state) for state in states])
    hidden = _hidden_positions(env_id)
    if hidden is None:
        raise ValueError(
            f"{env_id} cannot be drawn from its observations; film it by its own "
            "render_mode='rgb_array'"
        )
    return _of_mujoco(_robot(env_id), np.asarray(states, np.float64), hidden)


def _pendulum(state: np.ndarray) -> np.ndarray:
    """(cos, sin, speed), the angle from above and anticlockwise."""
    picture = _Picture(-ACROSS / 2, -ACROSS * HEIGHT / WIDTH / 2)
    tip = 0.85 * np.array([-state[1], state[0]]) / max(1e-6, float(np.hypot(state[0], state[1])))
    picture.rod(np.stack([np.zeros(2), tip]), 0.09, BODY)
    picture.rod(np.zeros((2, 2)), 0.04, EDGE)
    return picture.array()


def _of_mujoco(robot: Any, states: np.ndarray, hidden: int) -> np.ndarray:
    """A robot of MuJoCo from the side, or from above where it has a target, the reacher of ``dmc``.

    hidden: how many of the first positions are not observed; they are summed up from their
    velocities.
    """
    import mujoco

    model, data, pictures = robot.model, mujoco.MjData(robot.model), []
    view, target = getattr(robot, "view", None), getattr(robot, "target_radius", 0.0)
    axes = [0, 1] if target else [0, 2]
    unseen = np.cumsum(states[:, -model.nv :][:, :hidden], 0) * robot.dt
    positions = np.concatenate([unseen, states[:, : model.nq - hidden]], 1)
    bodies = np.flatnonzero(model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE))
    for state, position in zip(states, positions, strict=True):
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        if view is None:  # it is followed
            picture = _Picture(float(position[0]) - ACROSS / 2, -BELOW)
            picture.ground()
        else:
            picture = _Picture(*view)
        if target:
            picture.rod(np.stack([state[-2:]] * 2), target, OTHER)
        if model.ntendon:
            picture.draw.line(picture.pixels(data.site_xpos[:, axes]), EDGE, 2)
        away = 0 * bodies if target else data.geom_xpos[bodies, 1].round(6)
        for i in bodies[np.argsort(-away, kind="stable")]:
            _draw_body(picture, model, data, int(i), axes)
        pictures.append(picture.array())
    return np.stack(pictures)


def _draw_body(picture: _Picture, model: Any, data: Any, i: int, axes: list[int]) -> None:
    """A box, capsule or ball; a left or hind leg and a ball seen from the side in another hue."""
    from mujoco import mjtGeom

    place, kind, (wide, half, high) = (
        data.geom_xpos[i, axes],
        model.geom_type[i],
        model.geom_size[i],
    )
    if kind == int(mjtGeom.mjGEOM_BOX):
        corners = picture.pixels(place + np.array([[-wide, high], [wide, -high]]))
        picture.draw.rectangle((*corners[0], *corners[1]), MARK, EDGE, 2 * SMOOTH)
        return
    ball, name = kind == int(mjtGeom.mjGEOM_SPHERE), model.geom(i).name
    second = "left" in name or name.startswith("b") or (ball and axes == [0, 2])
    reach = (0.0 if ball else half) * data.geom_xmat[i].reshape(3, 3)[axes, 2]
    picture.rod(
        np.stack([place - reach, place + reach]),
        wide,
        OTHER if second else BODY,
    )


@cache
def _robot(env_id: str) -> Any:
    """The environment of an id, to draw with."""
    return make(env_id).unwrapped


@cache
def _hidden_positions(env_id: str) -> int | None:
    """How many of the first positions an observation leaves out, 0 or 1; None: it is something
    else.
    """
    if env_id in CONTROL_IDS:
        return 0
    robot = _robot(env_id)
    if type(getattr(robot, "data", None)).__name__ != "MjData":
        return None
    seen, _ = robot.reset(seed=0)
    for hidden in (0, 1):
        inside = np.concatenate([robot.data.qpos[hidden:], robot.data.qvel])
        if seen.shape == inside.shape and np.allclose(seen, inside):
            return hidden
    return None
