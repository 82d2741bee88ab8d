"""PushT's field without its simulator: physics, ids, geometry, symmetries, pictures. In px."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from gymnasium.envs.registration import register, registry

from tsmlib.checks import require_choice, require_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ENV_ID = "tsm/PushT-v0"
SIZE, LOW, HIGH, WALL = (
    512.0,
    5.0,
    506.0,
    2.0,
)  # px: the picture, the walls' centre lines, their radius
NAMES = ("pusher_x", "pusher_y", "tee_x", "tee_y", "tee_angle", "pusher_vx", "pusher_vy")
UNITS = ("px", "px", "px", "px", "rad", "px/s", "px/s")
GOAL = (256.0, 400.0, 256.0, 256.0, np.pi / 4, 0.0, 0.0)  # of a task without pairs (protocol A)
# Boxes (left, top, right, bottom) in units of the scale; the moment of the first counts for each.
SHAPES = {
    "T": ((-2.0, 0.0, 2.0, 1.0), (-0.5, 1.0, 0.5, 4.0)),
    "small_T": ((-1.5, 0.0, 1.5, 1.0), (-0.5, 1.0, 0.5, 2.0)),
    "L": ((0.0, 0.0, 1.0, 2.0), (0.0, -1.0, 2.0, 0.0)),
    "Z": ((0.0, 0.0, 2.0, 1.0), (-1.0, -1.0, 1.0, 0.0)),
    "square": ((-1.0, -1.0, 1.0, 1.0),),
    "I": ((-0.5, -2.0, 0.5, 2.0),),
    "plus": ((-1.5, -0.5, 1.5, 0.5), (-0.5, -1.5, 0.5, 1.5)),
}
HANDED = ("L", "Z")  # not their own mirror image
GREY, GREEN, BLUE = "#778899", "#90EE90", "#4169E1"  # the colours that the field knows


@dataclass(frozen=True)
class PushTPhysics:
    """What can differ between two fields.

    Args:
        radius: of the pusher, px.
        scale: width of the T's boxes, px.
        friction: of pusher, T and walls; 0 in the original, whose 1 pymunk does not read.
        shape: of what is pushed, a key of ``SHAPES``.

    Raises:
        ValueError: a value out of its range.
    """

    radius: float = 15.0
    scale: float = 30.0
    friction: float = 0.0
    shape: str = "T"

    def __post_init__(self) -> None:
        require_number("radius", self.radius, 5.0, 40.0)
        require_number("scale", self.scale, 15.0, 45.0)
        require_number("friction", self.friction, 0.0, 2.0)
        require_choice("shape", self.shape, SHAPES)

    @property
    def id(self) -> str:
        """Gymnasium's id, ``"tsm/PushT-scale40-shapeL-v0"``; of the standard ``"tsm/PushT-v0"``."""
        changed = (f for f in fields(self) if getattr(self, f.name) != f.default)
        values = ((f.name, getattr(self, f.name)) for f in changed)
        words = [f"-{name}{value if name == 'shape' else f'{value:g}'}" for name, value in values]
        return f"tsm/PushT{''.join(words)}-v0"

    @property
    def boxes(self) -> np.ndarray:
        """Corners (boxes, 4, 2) of what is pushed, in its own frame, px."""
        x = np.array(SHAPES[self.shape]) * self.scale
        return np.stack([x[:, [0, 1]], x[:, [2, 1]], x[:, [2, 3]], x[:, [0, 3]]], axis=1)


def pusht_physics(env_id: str) -> PushTPhysics:
    """The physics that an id says, registered from then on; ValueError for another id."""
    names = "".join(rf"(?:-{f.name}([0-9A-Za-z_.]+))?" for f in fields(PushTPhysics))
    parts = re.fullmatch(rf"tsm/PushT{names}-v0", env_id)
    if parts is None:
        raise ValueError(
            f"{env_id!r:.80} is no PushT; expected {ENV_ID!r} or what pusht_variant() calls one"
        )
    values = zip(fields(PushTPhysics), parts.groups(), strict=True)
    given = {f.name: text if f.name == "shape" else float(text) for f, text in values if text}
    pusht_variant(**given)
    return PushTPhysics(**given)  # type: ignore[arg-type]


def pusht_variant(**changes: float | str) -> str:
    """The id of PushT with other physics (`PushTPhysics`), registered where it is not yet."""
    physics = PushTPhysics(**changes)  # type: ignore[arg-type]
    if physics.id not in registry:
        register(
            physics.id,
            entry_point="tsmlib.envs.pusht:PushTEnv",
            vector_entry_point="tsmlib.envs.pusht:PushT",
            kwargs={"env_id": physics.id},
            max_episode_steps=300,
        )
    return physics.id


def placed(points: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Points (..., P, 2) of the T's own frame where it is in states (..., 7): (..., P, 2), px."""
    cosine, sine = np.cos(states[..., 4, None]), np.sin(states[..., 4, None])
    x, y = points[..., 0], points[..., 1]
    turned = np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
    return turned + states[..., None, 2:4]


def in_field(states: np.ndarray, physics: PushTPhysics | None = None) -> np.ndarray:
    """Whether pusher and T lie within the walls, up to a pixel: (..., 7) -> (...) bool."""
    physics = physics or PushTPhysics()
    corners = placed(physics.boxes.reshape(-1, 2), states)
    low, high, pusher = LOW + WALL - 1.0, HIGH - WALL + 1.0, states[..., :2]
    inside = (corners >= low) & (corners <= high)
    clear = (pusher >= low + physics.radius) & (pusher <= high - physics.radius)
    return np.asarray(inside.all((-2, -1)) & clear.all(-1))


def clearance(states: np.ndarray, physics: PushTPhysics | None = None) -> np.ndarray:
    """Pixels between pusher and T in states (..., 7), negative where they overlap: (...)."""
    physics = physics or PushTPhysics()
    offset = states[..., :2] - states[..., 2:4]
    cosine, sine = np.cos(states[..., 4]), np.sin(states[..., 4])
    x, y = offset[..., 0], offset[..., 1]
    own = np.stack([cosine * x + sine * y, cosine * y - sine * x], axis=-1)[..., None, :]
    low, high = physics.boxes[:, 0], physics.boxes[:, 2]
    beyond = np.maximum(low - own, own - high)  # (..., boxes, 2)
    outside = np.linalg.norm(beyond.clip(min=0.0), axis=-1)
    return (outside + beyond.max(-1).clip(max=0.0)).min(-1) - physics.radius


def require_states(name: str, value: object, n: int) -> np.ndarray:
    """``value`` as finite float64 states (n, 7); ValueError that names it otherwise."""
    states = np.array(value, np.float64)
    if states.shape[-1:] == (5,):
        raise ValueError(
            f"{name} is {states.shape}: gym-pusht's five numbers lack the pusher's velocity; "
            f"expected ({n}, 7), append two zeros: np.pad({name}, ((0, 0), (0, 2)))"
        )
    if states.shape != (n, 7):
        raise ValueError(f"{name} is {states.shape}; expected ({n}, 7): {', '.join(NAMES)}")
    if len(bad := np.argwhere(~np.isfinite(states))):
        raise ValueError(f"{name} is not finite in episode {bad[0][0]}: {states[bad[0][0]]}")
    return states


def require_in_field(name: str, states: np.ndarray, physics: PushTPhysics | None = None) -> None:
    """ValueError naming the first of states (N, 7) whose pusher or T is not within the walls."""
    within = in_field(states, physics)
    if not within.all():
        i = int(np.argmin(within))
        raise ValueError(
            f"{name} {i} is outside the field or inside a wall: pusher at "
            f"{states[i, :2].round(1)}, T at {states[i, 2:4].round(1)} turned by "
            f"{states[i, 4]:.2f} rad; expected both, with all their corners, "
            f"between {LOW + WALL:g} and {HIGH - WALL:g} px"
        )


def symmetric_copies(
    states: np.ndarray, actions: np.ndarray, shape: str = "T"
) -> list[tuple[np.ndarray, np.ndarray]]:
    """States (..., 7) and actions (..., 2), turned by quarters and mirrored: eight of each.

    An L or a Z is another shape in the mirror, so of them there are four.
    """
    centre, copies = (LOW + HIGH) / 2, []
    for mirror in (1.0,) if shape in HANDED else (1.0, -1.0):
        for quarters in range(4):
            cosine, sine = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarters]
            turn = np.array([[cosine, sine], [-sine, cosine]], states.dtype)
            turn[0] *= mirror  # x -> mirror x, then the turn, of rows
            x = states.copy()
            for part in (slice(0, 2), slice(2, 4)):
                x[..., part] = (states[..., part] - centre) @ turn + centre
            x[..., 4] = mirror * states[..., 4] + quarters * np.pi / 2
            x[..., 5:] = states[..., 5:] @ turn
            copies.append((x, actions @ turn))
    return copies


def pusht_image(
    state: np.ndarray,
    goal: np.ndarray | None = None,
    physics: PushTPhysics | None = None,
    *,
    pixels: int = 256,
) -> np.ndarray:
    """A state (7,) over its goal: grey T, green goal, blue pusher; uint8 (pixels, pixels, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1, 1), dpi=pixels)
    canvas, ax = FigureCanvasAgg(figure), figure.add_axes((0, 0, 1, 1))
    draw_pusht(ax, state, goal, physics)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def pusht_frames(
    states: np.ndarray, goal: np.ndarray | None = None, physics: PushTPhysics | None = None
) -> np.ndarray:
    """States (T, 7) drawn over their goal: uint8 (T, H, W, 3)."""
    return np.stack([pusht_image(state, goal, physics) for state in states])


def draw_pusht(
    ax: Axes,
    state: np.ndarray,
    goal: np.ndarray | None = None,
    physics: PushTPhysics | None = None,
    *,
    alpha: float = 1.0,
) -> None:
    """Draw a state (7,) over its goal into ``ax``, px."""
    from matplotlib.patches import Circle, Polygon, Rectangle

    physics = physics or PushTPhysics()
    ax.add_patch(Rectangle((LOW, LOW), HIGH - LOW, HIGH - LOW, fc="white", ec="#D3D3D3", lw=2))
    poses = [(state, GREY)] if goal is None else [(goal, GREEN), (state, GREY)]
    for pose, colour in poses:
        for box in physics.boxes:
            ax.add_patch(Polygon(placed(box, pose), fc=colour, ec=colour, lw=0.3, alpha=alpha))
    ax.add_patch(Circle(tuple(state[:2]), physics.radius, fc=BLUE, ec="none", alpha=alpha))
    ax.set(xlim=(0, SIZE), ylim=(SIZE, 0), aspect="equal")
    ax.axis("off")
