"""Figures of the action prior: torques of data and plans (figure 10 of the paper), spectra, and what codes decode to.

Letters in shapes: B targets, T steps, F frequencies, n codes on a walk.
"""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from tsmlib.plots import style
from tsmlib.plots.checks import finite, shaped
from tsmlib.plots.method import Method
from tsmlib.plots.style import WIDTH, Props, entry, legend, panels, styled, tint

WALK = mpl.colormaps["viridis"]


@styled
def figure10(
    plans: Mapping[Method, np.ndarray], dt: float, changes: Mapping[Method, float]
) -> Figure:
    """Torques over time (paper, figure 10): method -> (T, 2) in [-1, 1], four to a row, torques on one scale.

    plans: of each method an example; changes: method -> mean change of torque from step to step of all its plans, as a
    share of the data's, which goes without saying for the data.
    """
    plans = {method: shaped(method.label, actions, "T 2") for method, actions in plans.items()}
    figure, axes = panels(len(plans), 4, 1.3, sharex="row", sharey=True)
    limit = max(float(np.abs(actions).max()) for actions in plans.values())
    for ax, (method, actions) in zip(axes, plans.items(), strict=True):
        style.torques(ax, actions, dt, method.look.colour, limit=limit)
        ax.set_ylim(-1.4 * limit, 1.08 * limit)  # the note stands below all torques
        ax.set_title(f"{method.look.name}\n{', '.join(method.how)}", fontsize=7)
        if method.model != "data":
            every = "draws" if method.model == "prior" else "plans"
            style.note(ax, f"all {every}: |Δu| {changes[method]:.2f} × data's", 0.98, 0.02)
    style.torque_labels(figure)
    style.joint_legend(figure)
    return figure


@styled
def spectra(curves: Mapping[str, Mapping[Method, tuple[np.ndarray, np.ndarray]]]) -> Figure:
    """Spectra of torques: title -> method -> frequencies (F,) in Hz and power density (F,).

    Direct plans are dashed, those by Adam pale; the data lie broad behind all others.
    """
    figure, axes = panels(
        len(curves), len(curves), 2.2, width=min(WIDTH, 3.4 * len(curves)), head=0, sharey=True
    )
    for ax, (title, rows) in zip(axes, curves.items(), strict=True):
        for method, (frequency, power) in rows.items():
            word = f"{title}, {method.label}"
            ax.plot(finite(word, frequency, "F"), finite(word, power, "F"), **_line(method))
        ax.set(yscale="log", title=title.capitalize(), xlabel="frequency (Hz)")
    axes[0].set_ylabel("power of the torques (1/Hz)")
    drawn = dict.fromkeys(method for rows in curves.values() for method in rows)
    legend(figure, [entry(method.label, **_line(method)) for method in drawn], columns=4)
    return figure


def _line(method: Method) -> Props:
    if method.model == "data":
        return {"color": method.look.colour, "lw": 2.2, "alpha": 0.5}
    shade = tint(method.look.colour, 0.6 if method.planner.startswith("adam") else 1)
    return {
        "color": shade,
        "ls": style.DASHED if method.search_space == "direct" else "-",
        "lw": 1.1,
    }


@styled
def prior_walks(walks: np.ndarray, dt: float) -> Figure:
    """Torques decoded from codes: walks (m, n, T, 2), each from one code (dark) to another (light), from rest.

    Shoulder above, elbow below, a column for each walk.
    """
    walks = finite("walks", walks, "m n T 2")
    figure, grid = plt.subplots(
        2, len(walks), figsize=(WIDTH, 2.5), sharex=True, sharey=True, squeeze=False
    )
    seconds = np.arange(walks.shape[2]) * dt
    shades = WALK(np.linspace(0, 0.92, walks.shape[1]))
    for column, codes in zip(grid.T, walks, strict=True):
        for joint, ax in enumerate(column):
            for way, shade in zip(codes[..., joint], shades, strict=True):
                ax.plot(seconds, way, color=shade, lw=0.9)
            ax.axhline(0, color="#DDDDDD", lw=0.5, zorder=0)
            ax.set_xlim(0, seconds[-1])
    for i, ax in enumerate(grid[0]):
        ax.set_title(f"walk {i + 1}")
    for ax, word in zip(grid[:, 0], style.JOINTS, strict=True):
        ax.set_ylabel(word)
    style.torque_labels(figure)
    ends = {
        "the first code of a walk": shades[0],
        "between": shades[len(shades) // 2],
        "the last": shades[-1],
    }
    legend(figure, [entry(word, color=shade) for word, shade in ends.items()])
    return figure


@styled
def cost_of_prior(
    values: Mapping[str, Mapping[str, np.ndarray]], labels: Mapping[str, str]
) -> Figure:
    """Return lost by the latent search space, target by target: title -> {"lost", "distance", "peak"}: (B,).

    labels: "distance" and "peak" -> what stands below the axis. Red where the latent space loses, blue where it gains.
    """
    columns = tuple(labels)
    figure, axes = panels(len(values) * len(columns), len(values) * len(columns), 1.9, head=0)
    places = iter(axes)
    for title, found in values.items():
        lost = finite(f"{title}: lost", found["lost"], "B")
        for word in columns:
            ax = next(places)
            at = finite(f"{title}: {word}", found[word], str(len(lost)))
            ax.axhline(0, color="#999999", lw=0.7, zorder=1)
            ax.scatter(
                at, lost, s=8, c=np.where(lost > 0, style.RED, style.BLUE), linewidths=0, zorder=2
            )
            ax.set(title=title, xlabel=labels[word])
            ax.locator_params(nbins=5)
    axes[0].set_ylabel("return lost in latent space (m)")
    dots: Props = {"ls": "", "marker": "o", "ms": 3, "mew": 0}
    legend(
        figure,
        [
            entry("one target, latent space loses", color=style.RED, **dots),
            entry("one target, it gains", color=style.BLUE, **dots),
        ],
    )
    return figure
