"""The arms' scene drawn with matplotlib; it needs no OpenGL."""

from __future__ import annotations

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
    from matplotlib.patches import Circle, Rectangle

    arm = EnvSpec.parse(env_id)
    state, task, radius, lengths = (
        np.asarray(state, np.float64),
        arm.task,
        arm.physics.object_radius,
        arm.physics.link_lengths,
    )
    expected = arm.state_dim
    if state.shape != (expected,):
        raise ValueError(f"the state is {state.shape}; {env_id} expected ({expected},)")

    if background:
        solid = task == "push"  # elsewhere the frame is only there to look at
        ax.add_patch(
            Rectangle(
                (-EXTENT, -EXTENT), 2 * EXTENT, 2 * EXTENT, fc=STEEL if solid else FRAME, ec="none"
            )
        )
        ax.add_patch(Rectangle((-WALL, -WALL), 2 * WALL, 2 * WALL, fc=FLOOR, ec="none"))
        reach = sum(lengths)
        ax.add_patch(Circle((0, 0), reach, fc="none", ec=FRAME, lw=0.8, ls=(0, (4, 3)), zorder=1.1))
        ax.set(xlim=(-EXTENT, EXTENT), ylim=(-EXTENT, EXTENT), aspect="equal")
        ax.set_axis_off()
    for path, colour in ((tip_path, TIP), (block_path, BLOCK)):
        if path is not None:
            path = np.asarray(path)
            ax.plot(
                path[:, 0],
                path[:, 1],
                color=colour,
                lw=1.6,
                alpha=0.8,
                solid_capstyle="round",
                zorder=2,
            )
    if target is not None:
        _target(ax, np.asarray(target), radius if task == "push" else 1.2 * ARM_RADIUS)
    if task != "reach":
        fixed = task == "obstacle"
        face, edge = (STEEL, INK) if fixed else (BLOCK, "#8A5F00")
        ax.add_patch(
            Circle((state[6], state[7]), radius, fc=face, ec=edge, lw=1.0, alpha=alpha, zorder=3)
        )
        if fixed:  # a bolt: it does not move
            ax.add_patch(
                Circle(
                    (state[6], state[7]), 0.25 * radius, fc=INK, ec="none", alpha=alpha, zorder=3
                )
            )
    elbow, _, tip = arm_points(state[:2], lengths)
    # The pedestal.
    ax.add_patch(
        Circle((0, 0), 1.7 * ARM_RADIUS, fc=STEEL, ec=INK, lw=0.9, alpha=alpha, zorder=3.9)
    )
    _capsule(ax, np.zeros(2), elbow, LINK1, alpha, 4.0)
    _capsule(ax, elbow, tip, LINK2, alpha, 4.2)
    ax.add_patch(
        Circle(
            (tip[0], tip[1]), 0.72 * ARM_RADIUS, fc=TIP, ec="white", lw=0.8, alpha=alpha, zorder=4.3
        )
    )
    for joint in (np.zeros(2), elbow):
        ax.add_patch(
            Circle(
                (joint[0], joint[1]),
                0.5 * ARM_RADIUS,
                fc="white",
                ec=INK,
                lw=0.8,
                alpha=alpha,
                zorder=4.4,
            )
        )


def render_array(
    state: np.ndarray,
    env_id: str,
    target: np.ndarray | None = None,
    size: int = 480,
    *,
    tip_path: np.ndarray | None = None,
    block_path: np.ndarray | None = None,
    note: str = "",
) -> np.ndarray:
    """The scene as a uint8 image (size, size, 3). Needs neither a display nor OpenGL.

    tip_path, block_path: as of ``draw_scene``. note: a line of text at the lower left.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if size < 1:
        raise ValueError(f"size is {size}; expected at least 1 pixel")
    figure = Figure(figsize=(4.0, 4.0), dpi=size / 4.0)
    canvas = FigureCanvasAgg(figure)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    draw_scene(ax, state, env_id, target, tip_path=tip_path, block_path=block_path)
    if note:
        ax.text(
            0.02 - WALL, 0.02 - WALL, note, color=INK, fontsize=11, family="DejaVu Sans", zorder=6
        )
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


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
    ax.add_patch(
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
    from matplotlib.patches import Circle

    ax.add_patch(Circle((centre[0], centre[1]), radius, fc="none", ec=TARGET, lw=1.6, zorder=5))
    arm = 0.5 * min(radius, 2 * ARM_RADIUS)
    for dx, dy in ((arm, 0.0), (0.0, arm)):
        ax.plot(
            centre[0] + np.array([-dx, dx]),
            centre[1] + np.array([-dy, dy]),
            color=TARGET,
            lw=1.6,
            zorder=5,
        )
