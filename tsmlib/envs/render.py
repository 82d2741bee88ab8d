"""The arms' scene drawn with matplotlib; it needs no OpenGL."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tsmlib.envs.geometry import ARM_RADIUS, WALL, arm_points
from tsmlib.envs.spec import EnvSpec

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours, distinct for colour-blind readers; link 2 and the block differ in
# lightness as well.
LINK1, LINK2, TIP, BLOCK, TARGET = "#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00"
INK, STEEL, FRAME, FLOOR = "#22303C", "#7B8794", "#D5DAE0", "#FAFAF8"
EXTENT = WALL + 0.025  # m, half width of the picture


def draw_scene(
    ax: Axes,
    state: np.ndarray,
    env_id: str,
    target: np.ndarray | None = None,
    *,
    tip_path: np.ndarray | None = None,
    block_path: np.ndarray | None = None,
    alpha: float = 1.0,
    background: bool = True,
) -> None:
    """Draw one state (dx,) of ``env_id`` into ``ax``, seen from above, in metres.

    target (2,): where the fingertip, or on push the block, should go. tip_path, block_path (T, 2):
    where they went. alpha fades arm and block and ``background=False`` leaves out floor and walls,
    to lay several poses over another. ValueError where the state's size does not fit the
    environment.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Circle

    arm, state = EnvSpec.parse(env_id), np.asarray(state, np.float64)
    task, radius = arm.task, arm.physics.object_radius
    if state.shape != (arm.state_dim,):
        raise ValueError(f"the state is {state.shape}; {env_id} expected ({arm.state_dim},)")

    def disc(
        centre: np.ndarray, size: float, face: str, edge: str, lw: float, order: float
    ) -> None:
        place = (float(centre[0]), float(centre[1]))
        ax.add_artist(Circle(place, size, fc=face, ec=edge, lw=lw, alpha=alpha, zorder=order))

    if background:
        draw_floor(ax, env_id)
    for path, colour in ((tip_path, TIP), (block_path, BLOCK)):
        if path is not None:
            path = np.asarray(path)
            line = Line2D(path[:, 0], path[:, 1], color=colour, lw=1.6, alpha=0.8, zorder=2)
            line.set_solid_capstyle("round")
            ax.add_artist(line)
    if target is not None:
        _target(ax, np.asarray(target), radius if task == "push" else 1.2 * ARM_RADIUS)
    if task == "push":
        disc(state[6:8], radius, BLOCK, "#8A5F00", 1.0, 3)
    elif task == "obstacle":
        disc(state[6:8], radius, STEEL, INK, 1.0, 3)
        disc(state[6:8], 0.25 * radius, INK, "none", 1.0, 3)  # a bolt: it does not move
    shoulder, (elbow, _, tip) = np.zeros(2), arm_points(state[:2], arm.physics.link_lengths)
    disc(shoulder, 1.7 * ARM_RADIUS, STEEL, INK, 0.9, 3.9)  # the pedestal
    _capsule(ax, shoulder, elbow, LINK1, alpha, 4.0)
    _capsule(ax, elbow, tip, LINK2, alpha, 4.2)
    disc(tip, 0.72 * ARM_RADIUS, TIP, "white", 0.8, 4.3)
    for joint in (shoulder, elbow):
        disc(joint, 0.5 * ARM_RADIUS, "white", INK, 0.8, 4.4)


def draw_floor(ax: Axes, env_id: str) -> None:
    """Floor, walls and reach of the arm of ``env_id``, with the limits of the picture."""
    from matplotlib.patches import Circle, Rectangle

    arm = EnvSpec.parse(env_id)
    solid = arm.task == "push"  # elsewhere the frame is only there to look at
    for half, colour in ((EXTENT, STEEL if solid else FRAME), (WALL, FLOOR)):
        ax.add_artist(Rectangle((-half, -half), 2 * half, 2 * half, fc=colour, ec="none"))
    reach = sum(arm.physics.link_lengths)
    ax.add_artist(Circle((0, 0), reach, fc="none", ec=FRAME, lw=0.8, ls=(0, (4, 3)), zorder=1.1))
    ax.set(xlim=(-EXTENT, EXTENT), ylim=(-EXTENT, EXTENT), aspect="equal")
    ax.set_axis_off()


def render_array(
    state: np.ndarray,
    env_id: str,
    target: np.ndarray | None = None,
    size: int = 480,
    *,
    note: str = "",
) -> np.ndarray:
    """The scene as a uint8 image (size, size, 3). Needs neither a display nor OpenGL.

    note: a line of text at the lower left.
    """
    return render_frames(np.asarray(state)[None], env_id, target, size, notes=(note,))[0]


def render_frames(
    states: np.ndarray,
    env_id: str,
    target: np.ndarray | None = None,
    size: int = 480,
    *,
    tip_path: np.ndarray | None = None,
    block_path: np.ndarray | None = None,
    notes: Sequence[str] = (),
) -> np.ndarray:
    """States (T, dx) as frames (T, size, size, 3) uint8; what does not move is drawn once.

    tip_path, block_path (T, 2): where they went, drawn up to each frame. notes: text of each frame.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if size < 1:
        raise ValueError(f"size is {size}; expected at least 1 pixel")
    figure = Figure(figsize=(4.0, 4.0), dpi=size / 4.0)
    canvas = FigureCanvasAgg(figure)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    draw_floor(ax, env_id)
    canvas.draw()
    floor, still = canvas.copy_from_bbox(figure.bbox), set(ax.get_children())
    frames = np.empty((len(states), size, size, 3), np.uint8)
    for step, state in enumerate(states):
        tip, block = (None if x is None else x[: step + 1] for x in (tip_path, block_path))
        draw_scene(ax, state, env_id, target, tip_path=tip, block_path=block, background=False)
        if step < len(notes):
            ax.text(
                *(2 * (0.02 - WALL,)),
                notes[step],
                color=INK,
                fontsize=11,
                family="DejaVu Sans",
                zorder=6,
            )
        canvas.restore_region(floor)
        moved = [artist for artist in ax.get_children() if artist not in still]
        for artist in sorted(moved, key=lambda artist: artist.get_zorder()):
            ax.draw_artist(artist)
            artist.remove()
        frames[step] = np.asarray(canvas.buffer_rgba())[..., :3]
    return frames


def _capsule(
    ax: Axes, start: np.ndarray, end: np.ndarray, colour: str, alpha: float, zorder: float
) -> None:
    """A link with round ends, its true width in metres."""
    from matplotlib.patches import Polygon

    along = np.arctan2(*(end - start)[::-1])
    half = np.linspace(-np.pi / 2, np.pi / 2, 24)
    rim = [
        centre + ARM_RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        for centre, angle in ((end, along + half), (start, along + np.pi + half))
    ]
    ax.add_artist(
        Polygon(
            np.concatenate(rim),
            fc=colour,
            ec=INK,
            lw=0.9,
            alpha=alpha,
            zorder=zorder,
            joinstyle="round",
        )
    )


def _target(ax: Axes, centre: np.ndarray, radius: float) -> None:
    """A ring the size of what should reach it, and a cross."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Circle

    ax.add_artist(Circle((centre[0], centre[1]), radius, fc="none", ec=TARGET, lw=1.6, zorder=5))
    arm = 0.5 * min(radius, 2 * ARM_RADIUS)
    for dx, dy in ((arm, 0.0), (0.0, arm)):
        along, across = centre[0] + np.array([-dx, dx]), centre[1] + np.array([-dy, dy])
        ax.add_artist(Line2D(along, across, color=TARGET, lw=1.6, zorder=5))
