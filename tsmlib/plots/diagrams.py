"""The paper's figures 1-3 as vector diagrams: the segments, the model in training, planning over latent codes.

One colour per quantity: what is known (past states and actions, latent codes) blue, planned actions green, predicted
states red. Coordinates are inches from the lower left corner.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch, Polygon, Rectangle

from tsmlib.plots.style import styled, tint

PAST, ACTION, FUTURE, INK, GREY = "#0077BB", "#009E73", "#CC3311", "#222222", "#8A8A8A"
DILATIONS = (1, 2, 4, 8, 4)
Point = tuple[float, float]


def _canvas(width: float, height: float) -> tuple[Figure, Axes]:
    figure = plt.figure(figsize=(width, height))
    figure.set_layout_engine("none")
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set(xlim=(0, width), ylim=(0, height))
    ax.set_axis_off()
    return figure, ax


def _arrow(
    ax: Axes, start: Point, end: Point, colour: str = INK, dashed: bool = False, bend: float = 0
) -> None:
    ax.add_patch(
        FancyArrowPatch(
            start,
            end,
            arrowstyle="-|>,head_length=2.6,head_width=1.5",
            color=colour,
            lw=0.8,
            shrinkA=0,
            shrinkB=0,
            ls=(0, (3, 2)) if dashed else "-",
            connectionstyle=f"arc3,rad={bend}",
            zorder=4,
        )
    )


def _route(ax: Axes, points: Sequence[Point], colour: str = INK, dashed: bool = False) -> None:
    """An arrow along straight pieces."""
    xs, ys = zip(*points[:-1], strict=True)
    ax.plot(
        xs,
        ys,
        color=colour,
        lw=0.8,
        ls=(0, (3, 2)) if dashed else "-",
        zorder=4,
        solid_capstyle="butt",
    )
    _arrow(ax, points[-2], points[-1], colour, dashed)


def _text(
    ax: Axes,
    x: float,
    y: float,
    text: str,
    colour: str | None = None,
    size: float = 9,
    ha: str = "center",
    *,
    va: str = "center_baseline",
    **more: Any,
) -> None:
    ax.text(x, y, text, color=colour, fontsize=size, ha=ha, va=va, **more)


def _box(
    ax: Axes, x: float, y: float, width: float, height: float, text: str, colour: str = INK
) -> None:
    """A rounded box around (x, y) with its text."""
    ax.add_patch(
        FancyBboxPatch(
            (x - width / 2, y - height / 2),
            width,
            height,
            boxstyle="round,pad=0,rounding_size=0.06",
            fc="white",
            ec=colour,
            lw=0.9,
            zorder=5,
        )
    )
    _text(ax, x, y, text, zorder=6)


def _disc(ax: Axes, x: float, y: float, text: str, colour: str, radius: float = 0.15) -> None:
    ax.add_patch(Circle((x, y), radius, fc=tint(colour, 0.12), ec=colour, lw=0.9, zorder=5))
    _text(ax, x, y - 0.005, text, zorder=6)


def _wave(phase: float, n: int = 120) -> np.ndarray:
    """A smooth made-up signal on [0, 1], within about [-1, 1]."""
    s = np.linspace(0, 1, n)
    return 0.62 * np.sin(5.2 * s + phase) + 0.3 * np.sin(11.0 * s + 2.1 * phase + 1)


def _film(
    ax: Axes,
    x: float,
    y: float,
    width: float,
    height: float,
    colour: str,
    phases: Sequence[float],
    steps: int = 0,
) -> None:
    """A small time series panel around (x, y); with ``steps`` the signals are piecewise constant."""
    ax.add_patch(
        Rectangle(
            (x - width / 2, y - height / 2),
            width,
            height,
            fc=tint(colour, 0.08),
            ec=colour,
            lw=0.7,
            zorder=5,
        )
    )
    for phase in phases:
        wave = 0.42 * height * _wave(phase) + y
        along = np.linspace(x - 0.46 * width, x + 0.46 * width, len(wave))
        every = len(wave) // steps if steps else 1
        ax.plot(
            along[::every],
            wave[::every],
            color=colour,
            lw=0.9,
            zorder=6,
            drawstyle="steps-mid" if steps else "default",
        )


@styled
def figure1() -> Figure:
    """The probabilistic model (paper, figure 1): past segments and planned actions in, possible futures out."""
    figure, ax = _canvas(5.0, 2.6)
    left, now, right, H = 0.48, 2.36, 4.24, 10
    step = (now - left) / H
    states, torques, axis = 1.86, 0.84, 0.36
    for x0, colour in ((left, PAST), (now, FUTURE)):
        ax.add_patch(Rectangle((x0, states - 0.46), now - left, 0.92, fc=tint(colour, 0.07), lw=0))
    for x0, colour in ((left, PAST), (now, ACTION)):
        ax.add_patch(Rectangle((x0, torques - 0.28), now - left, 0.56, fc=tint(colour, 0.07), lw=0))

    s = np.linspace(0, 1, 121)  # the past: H states ending at t
    past = 0.28 * np.sin(4.6 * s + 0.4) * (0.4 + 0.6 * s)
    ax.plot(left + s * (now - left), states + past, color=PAST, lw=1.2)
    ticks = np.arange(1, H + 1)
    ax.plot(left + ticks * step, states + past[12 * ticks], "o", color=PAST, ms=3.2)
    rise = (
        (past[-1] - past[-13]) * 10 * s * np.exp(-2.6 * s)
        + 0.34 * np.sin(3.6 * s) * s**0.7
        + 0.36 * s
    )
    for spread in (-0.75, -0.4, 0.35, 0.75, 0.0):
        strong, future = spread == 0, states + past[-1] + rise + 0.3 * spread * s**1.6
        shade, width = (FUTURE, 1.2) if strong else (tint(FUTURE, 0.45), 0.8)
        ax.plot(now + s * (right - now), future, color=shade, lw=width, zorder=3 if strong else 2)
        if strong:
            ax.plot(now + ticks * step, future[12 * ticks], "o", color=FUTURE, ms=3.2, zorder=4)

    u = np.linspace(0, 1, 2 * H)  # one torque per step, held over the step
    held = 0.17 * np.sin(9.5 * u + 0.6) + 0.07 * np.sin(21 * u)
    for part, x0, colour in ((held[:H], left, PAST), (held[H:], now, ACTION)):
        ax.stairs(torques + part, x0 + step * np.arange(H + 1), baseline=None, color=colour, lw=1.2)

    ax.plot([now, now], [axis, 2.36], color=INK, lw=0.7, ls=(0, (3, 2)), zorder=1)
    _arrow(ax, (left - 0.1, axis), (right + 0.22, axis))
    for x, text in ((left, "$t-H$"), (now, "$t$"), (right, "$t+H$")):
        ax.plot([x, x], [axis - 0.035, axis + 0.035], color=INK, lw=0.7)
        _text(ax, x, axis - 0.09, text, None, 8, va="top")
    _text(ax, right + 0.26, axis, "time", None, 7, "left")
    for x0, y, text, colour in (
        (left, 2.46, "past states $X^-$", PAST),
        (now, 2.46, "possible future states $X^+$", FUTURE),
        (left, 1.26, "past actions $U^-$", PAST),
        (now, 1.26, "planned actions $U^+$", ACTION),
    ):
        _text(ax, x0 + (now - left) / 2, y - 0.02, text, colour, 8)
    _text(ax, left - 0.14, states, "$x$", None, 10, "right", va="center")
    _text(ax, left - 0.14, torques, "$u$", None, 10, "right", va="center")
    return figure


def _tree(ax: Axes, columns: np.ndarray, rows: np.ndarray) -> None:
    """The decoder's layers: every connection faint, what the last output rests on in full."""
    last = len(columns) - 1
    needed = {last}
    for layer in range(len(DILATIONS), 0, -1):
        gap = DILATIONS[layer - 1]
        for strong in (False, True):
            pairs = [
                (c - d, c)
                for c in (needed if strong else range(last + 1))
                for d in (0, gap)
                if c - d >= 0
            ]
            lines = [[(columns[a], rows[layer - 1]), (columns[b], rows[layer])] for a, b in pairs]
            shade, width = (INK, 0.75) if strong else ("#E2E2E2", 0.5)
            ax.add_collection(
                LineCollection(lines, colors=shade, linewidths=width, zorder=3 if strong else 1)
            )
        below = {a for c in needed for a in (c, c - gap) if a >= 0}
        dots = np.array([c in needed for c in range(last + 1)])
        y = np.full(len(columns), rows[layer])
        ax.scatter(columns, y, s=9, c=np.where(dots, INK, "#D2D2D2"), linewidths=0, zorder=4)
        needed = below


@styled
def figure2() -> Figure:
    """The model in training (paper, figure 2): encoder, code, and the decoder's dilated causal convolutions.

    The tree is that of kernel size 2 and dilations 1, 2, 4, 8, 4: the last output rests on 20 = 2 H positions. Each
    position holds a state and the action taken in it; the first one is zero padding.
    """
    figure, ax = _canvas(7.0, 3.5)
    ax.set_ylim(0.22, 3.72)
    H, x, out, top = 10, 0.95, 3.2, 3.58
    columns = 2.55 + 0.2 * np.arange(2 * H)
    rows = np.array([0.98, 1.33, 1.66, 1.99, 2.32, 2.65])
    _decoder(ax, columns, rows, out)
    _encoder(ax, x, out)

    bus, code = 2.12, 1.02  # the code enters every layer
    ax.plot([x + 0.15, bus, bus], [code, code, rows[-1]], color=PAST, lw=0.8)
    for y in rows[1:]:
        _arrow(ax, (bus, y), (columns[0] - 0.08, y), PAST)
    _text(ax, bus, rows[-1] + 0.13, "$V_k^\\top z$", PAST, 8)

    middle = (columns[H] + columns[-1]) / 2  # the two terms of the loss
    _text(ax, columns[H] - 0.14, out, "$\\hat{X}^+$", FUTURE, 9, "right")
    _route(ax, [((x + middle) / 2, top), (x, top), (x, out + 0.22)])
    _route(ax, [((x + middle) / 2, top), (middle, top), (middle, out + 0.085)])
    _text(ax, (x + middle) / 2, top, "$\\ell_2$ loss", None, 8, backgroundcolor="white", zorder=6)
    ax.plot([x + 0.36, x + 0.5], [1.65, 1.65], color=INK, lw=0.8)
    ax.text(
        x + 0.54, 1.65, "KL from\n$\\mathcal{N}(0,I)$", va="center", fontsize=7, linespacing=1.3
    )
    return figure


def _decoder(ax: Axes, columns: np.ndarray, rows: np.ndarray, out: float) -> None:
    """The tree of layers at ``rows`` above its inputs, states above actions, and below its outputs at ``out``."""
    H, x_row, u_row = len(columns) // 2, 0.86, 0.62
    for c, x in enumerate(columns):
        for y, known, planned in ((x_row, c <= H, FUTURE), (u_row, c < H, ACTION)):
            colour = PAST if known else planned
            face, edge, line = (tint(colour, 0.3), colour, "-") if c else ("white", "#BBBBBB", ":")
            _cell(ax, x, y, face, edge, line)
    _tree(ax, columns, rows)
    for x in columns[H:]:
        ax.plot(
            [x, x],
            [rows[-1], out - 0.085],
            color="#E2E2E2" if x < columns[-1] else INK,
            lw=0.7,
            zorder=2,
        )
        _cell(ax, x, out, tint(FUTURE, 0.3), FUTURE)
    right = columns[-1] + 0.12
    for layer, gap in enumerate(DILATIONS, start=1):
        _text(ax, right, rows[layer] - 0.165, f"dilation {gap}", GREY, 6.5, "left")
    _route(
        ax,
        [
            (columns[-2], out + 0.085),
            (columns[-2], out + 0.2),
            (right + 0.48, out + 0.2),
            (right + 0.48, x_row),
            (columns[-1] + 0.085, x_row),
        ],
        FUTURE,
        dashed=True,
    )
    _text(ax, right + 0.42, out + 0.26, "fed back", FUTURE, 6.5, "right", va="baseline")
    for lo, hi, text, colour in ((1, H - 1, "$U^-$", PAST), (H, 2 * H - 1, "$U^+$", ACTION)):
        ax.plot([columns[lo] - 0.07, columns[hi] + 0.07], [u_row - 0.15] * 2, color=colour, lw=0.8)
        _text(ax, (columns[lo] + columns[hi]) / 2, u_row - 0.2, text, colour, 9, va="top")
    _text(ax, columns[0] - 0.14, x_row, "$X^-$", PAST, 9, "right")
    _text(
        ax, columns[0] - 0.07, 2.97, "decoder  $P^{(x)}(X^+\\mid X^-,U^-,U^+,Z)$", None, 8.5, "left"
    )


def _cell(
    ax: Axes, x: float, y: float, face: str | tuple[float, ...], edge: str, ls: str = "-"
) -> None:
    ax.add_patch(
        Rectangle((x - 0.075, y - 0.085), 0.15, 0.17, lw=0.6, fc=face, ec=edge, ls=ls, zorder=5)
    )


def _encoder(ax: Axes, x: float, out: float) -> None:
    """The encoder's column at x, from the future at ``out`` down to the code."""
    code = 1.02
    _film(ax, x, out, 1.1, 0.44, FUTURE, (0.3, 2.2))
    _text(ax, x - 0.62, out, "$X^+$", FUTURE, 9, "right")
    funnel = [(x - 0.55, 2.68), (x + 0.55, 2.68), (x + 0.3, 2.1), (x - 0.3, 2.1)]
    ax.add_patch(Polygon(funnel, fc="white", ec=INK, lw=0.9))
    for y, half in ((2.53, 0.455), (2.25, 0.335)):
        ax.plot([x - half - 0.03, x + half + 0.03], [y, y], color="#D8D8D8", lw=0.7)
    _text(ax, x, 2.39, "$Q^{(x)}(Z\\mid X^+)$", None, 8.5)
    _text(ax, x - 0.5, 2.3, "encoder", None, 7, "right")
    _arrow(ax, (x, out - 0.22), (x, 2.68))
    for dx, text in ((-0.2, "$\\mu_Z$"), (0.2, "$\\sigma_Z$")):
        _arrow(ax, (x + dx * 0.9, 2.1), (x + dx, 1.8))
        _disc(ax, x + dx, 1.65, text, PAST)
        _arrow(ax, (x + dx * 0.75, 1.515), (x + 0.35 * dx, code + 0.135))
    _disc(ax, x, code, "$z$", PAST)
    _text(ax, x, code - 0.25, "$z=\\mu_Z+\\sigma_Z\\,\\varepsilon$", None, 8)


@styled
def figure3() -> Figure:
    """Planning over latent codes (paper, figure 3): codes make actions, actions make states, states give rewards, and
    the gradient of the return flows back to the codes (dashed)."""
    figure, ax = _canvas(5.15, 3.85)
    centres, names = (1.2, 2.55, 4.4), ("1", "2", "K")
    z_y, prior_y, u_y, model_y, x_y, r_y, sum_y = 0.3, 0.84, 1.38, 1.94, 2.48, 3.02, 3.58
    middle = (centres[0] + centres[-1]) / 2
    for i, (x, k) in enumerate(zip(centres, names, strict=True)):
        _disc(ax, x, z_y, f"$z_{k}$", PAST, 0.17)
        _box(ax, x, prior_y, 0.62, 0.3, "$P^{(u)}$")
        _film(ax, x, u_y, 0.78, 0.32, ACTION, (0.4 + 1.7 * i, 2.0 + 1.1 * i), steps=12)
        _box(ax, x, model_y, 0.62, 0.3, "$P^{(x)}$")
        _film(ax, x, x_y, 0.78, 0.32, FUTURE, (1.0 + 1.3 * i, 2.7 + 0.9 * i))
        _box(ax, x, r_y, 0.9, 0.29, f"$r(X_{k},U_{k})$")
        for y, text, colour in ((u_y, f"$U_{k}$", ACTION), (x_y, f"$X_{k}$", FUTURE)):
            _text(ax, x - 0.44, y + 0.02, text, colour, 9, "right")
        edges = [
            (z_y + 0.17, prior_y - 0.15),
            (prior_y + 0.15, u_y - 0.16),
            (u_y + 0.16, model_y - 0.15),
            (model_y + 0.15, x_y - 0.16),
            (x_y + 0.16, r_y - 0.145),
        ]
        for n, (low, high) in enumerate(edges):
            _arrow(ax, (x, low), (x, high))
            shift = 0.2 if n else 0.1
            _arrow(ax, (x + shift, high), (x + shift, low - (0 if n else 0.03)), PAST, dashed=True)
        end = middle + 0.35 * (x - middle)  # the return
        _arrow(ax, (x, r_y + 0.145), (end, sum_y - 0.16))
        _arrow(ax, (end + 0.16, sum_y - 0.16), (x + 0.16, r_y + 0.145), PAST, dashed=True)
    _box(ax, middle, sum_y, 1.75, 0.32, "$\\mathbf{E}\\;[\\;\\Sigma_k\\,r(X_k,U_k)\\;]$")
    _text(ax, middle - 0.94, sum_y, "maximise", None, 7.5, "right")

    for y, following, start in (
        (u_y, prior_y, "$U_0=0$"),
        (x_y, model_y, "$x_0$"),
    ):  # from segment to segment
        _text(ax, 0.52, following, start, None, 9, "right")
        _arrow(ax, (0.57, following), (centres[0] - 0.31, following))
        bend = centres[0] + 0.6
        _route(
            ax,
            [(centres[0] + 0.39, y), (bend, y), (bend, following), (centres[1] - 0.31, following)],
        )
        bend = centres[1] + 0.6
        _route(ax, [(centres[1] + 0.39, y), (bend, y), (bend, following), (bend + 0.2, following)])
        _text(ax, bend + 0.34, following, "\N{MIDLINE HORIZONTAL ELLIPSIS}", va="center")
        _arrow(ax, (bend + 0.46, following), (centres[2] - 0.31, following))
    _arrow(ax, (0.62, 0.22), (0.24, 0.22), PAST, dashed=True)
    _text(ax, 0.43, 0.3, "gradient", PAST, 6.5, va="bottom")
    return figure
