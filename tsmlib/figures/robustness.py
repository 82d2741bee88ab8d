"""Figures of noisy sensors and delayed actions: an episode, errors to the clean state, and a map (section 5.3.3).

Letters in shapes: k seeds, T steps, K steps predicted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure

from tsmlib.figures import axes
from tsmlib.figures.checks import Panels, finite, finite_panels, shaped
from tsmlib.figures.method import Method
from tsmlib.figures.style import BLUE, DARK, ORANGE, PALE, WIDTH, Props, entry, legend, panels, styled, tint


@styled
def imperfect_episode(
    clean: np.ndarray, noisy: np.ndarray, taken: np.ndarray, applied: np.ndarray, *, titles: Sequence[str], dt: float
) -> Figure:
    """Observed and true states, torques sent and torques applied, in one episode.

    clean, noisy (T + 1, P): some dimensions of the true and of the observed state, one panel each, titled ``titles``
    (P,) with units; taken, applied (T,): the torque of one joint as it was sent and as it arrived; dt: s per step.
    """
    clean = finite("clean", clean, f"T {len(titles)}")
    noisy = finite("noisy", noisy, f"{len(clean)} {len(titles)}")
    taken, applied = (finite(word, torque, f"{len(clean) - 1}") for word, torque in
                      (("taken", taken), ("applied", applied)))  # fmt: skip
    figure, (*states, torque) = panels(len(titles) + 1, len(titles) + 1, 1.7, head=0)
    at = np.arange(len(clean)) * dt
    sensed: Props = {"color": tint(BLUE, 0.6), "ls": "", "marker": "."}
    for ax, title, truth, seen in zip(states, titles, clean.T, noisy.T, strict=True):
        ax.plot(at, seen, **sensed, ms=3, mew=0)
        ax.plot(at, truth, color=DARK, lw=1.1)
        ax.set(title=title, xlabel="time (s)")
    torque.step(at[:-1], taken, where="post", color=ORANGE, lw=1.0)
    torque.step(at[:-1], applied, where="post", color=DARK, lw=1.1)
    torque.set(title="shoulder torque (of full)", xlabel="time (s)")
    legend(figure, [entry("true state; torque that arrives", color=DARK), entry("observed state", **sensed),
                    entry("torque that is sent", color=ORANGE)])  # fmt: skip
    return figure


@styled
def filtering_errors(ahead: Panels, now: Mapping[str, Mapping[Method, float]], raw: Mapping[str, float]) -> Figure:
    """Errors to the clean state after a noisy past, against the raw observation's.

    ahead: panel -> method -> (k, K), the error of each seed 1 .. K steps ahead; now: panel -> filter -> the error of
    its estimate of the present state, at 0 steps; raw: panel -> the raw observation's. One scale for all panels; what
    leaves it has an arrow, and its value stands in words below.
    """
    for word, given in (("now", now), ("raw", raw)):
        if set(given) != set(ahead):
            raise ValueError(f"{word} has the panels {', '.join(given)}; expected {', '.join(ahead)}")
    checked, look_of = finite_panels(ahead, "k K"), axes.looks(ahead)
    means = np.concatenate([row.mean(0) for rows in checked.values() for row in rows.values()])
    figure, grid = panels(len(ahead), len(ahead), 2.1, head=0, sharey=True)
    grid[0].set_ylim(0, max(1.25 * max(raw.values()), 1.05 * float(np.quantile(means, 0.9))))
    unseen: Props = {"color": PALE, "ls": "--", "lw": 1}
    alone = dict.fromkeys(method for rows in now.values() for method in rows if method not in look_of)
    points: dict[Method, Props] = {method: {"color": method.look.colour, "ls": "", "marker": "o", "ms": 4,
                                            "mfc": "white"} for method in alone}  # fmt: skip
    for ax, (title, rows) in zip(grid, checked.items(), strict=True):
        ax.axhline(raw[title], **unseen, zorder=1)
        notes = []
        for method, row in rows.items():
            at, (mean, half) = np.arange(1, row.shape[1] + 1), axes.band(row)
            if method in now[title]:
                at, mean, half = np.append(0, at), np.append(now[title][method], mean), np.append(0, half)
            axes.curve(ax, at, mean, half, look_of[method])
            notes += axes.outside(ax, at, mean, method)
        for method in points.keys() & now[title].keys():
            ax.plot(0, now[title][method], **points[method], zorder=4)
        ax.set(title=title.capitalize(), xticks=range(0, max(row.shape[1] for row in rows.values()) + 1, 2))
        axes.foot(ax, "steps ahead", notes, WIDTH / len(ahead) - 0.2)
    grid[0].set_ylabel("error to the clean state\n(half ranges)")
    handles = [*axes.entries(look_of), *(entry(method.label, **look) for method, look in points.items())]
    return axes.finish(figure, [grid], [*handles, entry("raw observation", **unseen)], 4)


@styled
def advantage_map(
    differences: Mapping[str, np.ndarray], *, noise: Sequence[float], delay: Sequence[int], unit: str
) -> Figure:
    """Advantage of a model over a grid of noise and delay, one panel per place and rival.

    differences: panel -> (noise, delay), NaN where there is none, which is hatched; above zero the model is ahead.
    """
    if not differences:
        raise ValueError("differences holds no panel: nothing to draw")
    shape = f"{len(noise)} {len(delay)}"
    grids = {title: shaped(f"{title} (noise by delay)", values, shape) for title, values in differences.items()}
    every = np.abs(np.concatenate([values.ravel() for values in grids.values()]))
    far = float(np.nanmax(every, initial=0)) or 1.0
    figure, grid = panels(len(grids), len(grids), 2.2, head=0, sharey=True)
    for ax, (title, values) in zip(grid, grids.items(), strict=True):
        image = ax.imshow(values, cmap="PuOr", norm=TwoSlopeNorm(0.0, -far, far), origin="lower", aspect="auto")
        for (row, column), value in np.ndenumerate(values):
            text = "" if np.isnan(value) else f"{value:+.1f}".replace("-", "\u2212")
            ax.text(column, row, text, ha="center", va="center", fontsize=8,
                    color="white" if abs(value) > 0.6 * far else "black")  # fmt: skip
        ax.set(title=title.replace(": ", ":\n"), xlabel="delay (steps)")
        ax.set_xticks(range(len(delay)), [f"{value}" for value in delay])
        ax.set_yticks(range(len(noise)), [f"{value:g}" for value in noise])
        ax.patch.set(hatch="////", edgecolor="#C8C8C8")
        ax.spines[:].set_visible(False)
        ax.tick_params(length=0)
    grid[0].set_ylabel("noise (half ranges)")
    figure.colorbar(image, ax=grid, label=unit, shrink=0.9)
    return figure
