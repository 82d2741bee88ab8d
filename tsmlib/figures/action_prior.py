"""Figures of the action prior: torques of data and plans (figure 10 of the paper), spectra, and what codes decode to.

Reached through ``tsmlib.figures``, where labels are explained.

Letters in shapes: B targets, T steps, F frequencies, n codes on a walk.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tsmlib.figures.axes import finite
from tsmlib.figures.style import COLOURS, WIDTH, colour, joint_legend, legend, panels, shaped, styled, torques

WALK = mpl.colormaps["viridis"]


@styled
def figure10(plans: Mapping[str, np.ndarray], dt: float, changes: Mapping[str, float], label: str = "tsm") -> Figure:
    """Torques over time (paper, figure 10): title -> (T, 2) in [-1, 1], four to a row, all on one scale.

    changes: title -> mean change of torque from step to step of all plans of that kind, as a share of the data's. A
    title that begins with ``data`` or ``prior`` is drawn in their colour, all others in that of ``label``.
    """
    plans = {title: shaped(title, actions, "T 2") for title, actions in plans.items()}
    figure, axes = panels(len(plans), 4, 1.25, sharex=True, sharey=True)
    limit = max(float(np.abs(actions).max()) for actions in plans.values())
    for ax, (title, actions) in zip(axes, plans.items(), strict=True):
        first = title.split()[0].rstrip(",")
        torques(ax, actions, dt, COLOURS[first] if first in ("data", "prior") else colour(label), limit=limit)
        ax.set_title(title, fontsize=7)
        ax.annotate(f"change {changes[title]:.2f} of the data's", (0.98, 0.02), xycoords="axes fraction", ha="right",
                    fontsize=6.5, color="#555555")  # fmt: skip
    figure.supxlabel("time (s)", fontsize=7)
    figure.supylabel("torque (share of full)", fontsize=7)
    joint_legend(figure)
    return figure


@styled
def spectra(
    curves: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]], looks: Mapping[str, tuple[str, str]]
) -> Figure:  # fmt: skip
    """How fast torques change: title -> name -> frequencies (F,) in Hz and power density (F,).

    looks: name -> a word of ``style.COLOURS`` for its colour, and a line style.
    """
    figure, grid = plt.subplots(
        1, len(curves), figsize=(min(WIDTH, 3.4 * len(curves)), 2.2), sharey=True, squeeze=False
    )
    for ax, (title, rows) in zip(grid[0], curves.items(), strict=True):
        for word, (frequency, power) in rows.items():
            look = _line(*looks[word])
            ax.plot(finite(f"{title}, {word}", frequency, "F"), finite(f"{title}, {word}", power, "F"),
                    **look)  # fmt: skip
        ax.set(yscale="log", title=title, xlabel="frequency (Hz)")
    grid[0, 0].set_ylabel("power of the torques (1/Hz)")
    names = dict.fromkeys(word for rows in curves.values() for word in rows)
    legend(figure, [Line2D([], [], **_line(*looks[word]), label=word) for word in names], columns=4)
    return figure


@styled
def prior_walks(walks: np.ndarray, dt: float) -> Figure:
    """Torques that codes decode to: walks (m, n, T, 2), each from one code (dark) to another (light), from rest.

    Shoulder above, elbow below.
    """
    walks = finite("walks", walks, "m n T 2")
    figure, grid = plt.subplots(2, len(walks), figsize=(WIDTH, 2.5), sharex=True, sharey=True, squeeze=False)
    seconds = np.arange(walks.shape[2]) * dt
    shades = WALK(np.linspace(0, 0.92, walks.shape[1]))
    for column, codes in zip(grid.T, walks, strict=True):
        for joint, ax in enumerate(column):
            for way, shade in zip(codes[..., joint], shades, strict=True):
                ax.plot(seconds, way, color=shade, lw=0.9)
            ax.axhline(0, color="#DDDDDD", lw=0.5, zorder=0)
            ax.set_xlim(0, seconds[-1])
    for ax, word in zip(grid[:, 0], ("shoulder", "elbow"), strict=True):
        ax.set_ylabel(word)
    figure.supxlabel("time (s)", fontsize=7)
    figure.supylabel("torque (share of full)", fontsize=7)
    return figure


@styled
def cost_of_prior(values: Mapping[str, Mapping[str, np.ndarray]], labels: Mapping[str, str]) -> Figure:
    """What each target loses by searching over codes: title -> {"lost", "distance", "peak"}: (B,).

    labels: "distance" and "peak" -> what stands below the axis. Red where codes lose, blue where they gain.
    """
    columns = tuple(labels)
    count = len(values) * len(columns)
    figure, grid = plt.subplots(1, count, figsize=(WIDTH, 1.9), squeeze=False)
    places = iter(grid[0])
    for title, found in values.items():
        lost = finite(f"{title}: lost", found["lost"], "B")
        for word in columns:
            ax = next(places)
            at = finite(f"{title}: {word}", found[word], str(len(lost)))
            ax.axhline(0, color="#999999", lw=0.7, zorder=1)
            shades = np.where(lost > 0, COLOURS["multistep"], COLOURS["tsm"])
            ax.scatter(at, lost, s=8, c=shades, linewidths=0, zorder=2)
            ax.set(title=title if word == columns[0] else "", xlabel=labels[word])
            ax.locator_params(nbins=5)
    grid[0, 0].set_ylabel("return lost by codes (m)")
    return figure


def _line(main: str, dashes: str) -> dict[str, Any]:
    """How a spectrum is drawn: the data broad and pale, behind all others."""
    broad = main == "data"
    return {"color": COLOURS[main], "ls": dashes, "lw": 2.2 if broad else 1.1, "alpha": 0.5 if broad else 1.0}
