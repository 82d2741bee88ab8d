"""Figures of noisy sensors and delayed actions: an episode, errors to the clean state, and a map (section 5.3.3).

Letters in shapes: k seeds, T steps, K steps predicted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure

from tsmlib.plots import axes
from tsmlib.plots.checks import Panels, finite, finite_panels
from tsmlib.plots.method import Method
from tsmlib.plots.style import (
    BLUE,
    DARK,
    ORANGE,
    PALE,
    WIDTH,
    Props,
    entry,
    legend,
    panels,
    styled,
    tint,
)
from tsmlib.statistics import interval


@styled
def imperfect_episode(
    clean: np.ndarray,
    noisy: np.ndarray,
    taken: np.ndarray,
    applied: np.ndarray,
    *,
    titles: Sequence[str],
    dt: float,
) -> Figure:
    """Observed and true states, torques sent and torques applied, in one episode.

    clean, noisy (T + 1, P): some dimensions of the true and of the observed state, one panel each, titled ``titles``
    (P,) with units; taken, applied (T,): the torque of one joint as it was sent and as it arrived; dt: s per step.
    """
    clean = finite("clean", clean, f"T {len(titles)}")
    noisy = finite("noisy", noisy, f"{len(clean)} {len(titles)}")
    taken, applied = (
        finite(word, torque, f"{len(clean) - 1}")
        for word, torque in (("taken", taken), ("applied", applied))
    )
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
    legend(
        figure,
        [
            entry("true state; torque that arrives", color=DARK),
            entry("observed state", **sensed),
            entry("torque that is sent", color=ORANGE),
        ],
    )
    return figure


@styled
def filtering_errors(
    ahead: Panels,
    now: Mapping[str, Mapping[Method, float]],
    raw: Mapping[str, float],
    yours: Panels | None = None,
) -> Figure:
    """Errors to the clean state after a noisy past, against the raw observation's.

    ahead: panel -> method -> (k, K), the error of each seed 1 .. K steps ahead; now: panel -> filter -> the error of
    its estimate of the present state, at 0 steps; raw: panel -> the raw observation's; yours: as ahead, drawn over them
    as hollow diamonds. One scale for all panels; what leaves it has an arrow, and its value stands in words below.
    """
    for word, given in (("now", now), ("raw", raw)):
        if set(given) != set(ahead):
            raise ValueError(
                f"{word} has the panels {', '.join(given)}; expected {', '.join(ahead)}"
            )
    checked, own = finite_panels(ahead, "k K"), finite_panels(yours or {}, "k K")
    look_of = axes.looks(ahead, own)
    means = np.concatenate([row.mean(0) for rows in checked.values() for row in rows.values()])
    figure, grid = panels(len(ahead), len(ahead), 2.1, head=0, sharey=True)
    grid[0].set_ylim(0, max(1.25 * max(raw.values()), 1.05 * float(np.quantile(means, 0.9))))
    unseen: Props = {"color": PALE, "ls": "--", "lw": 1}
    alone = dict.fromkeys(
        method for rows in now.values() for method in rows if method not in look_of
    )
    points: dict[Method, Props] = {
        method: {"color": method.look.colour, "ls": "", "marker": "o", "ms": 4, "mfc": "white"}
        for method in alone
    }
    for ax, (title, rows) in zip(grid, checked.items(), strict=True):
        ax.axhline(raw[title], **unseen, zorder=1)
        notes = []
        for method, row in rows.items():
            at, (mean, half) = np.arange(1, row.shape[1] + 1), axes.band(row)
            if method in now[title]:
                at, mean, half = (
                    np.append(0, at),
                    np.append(now[title][method], mean),
                    np.append(0, half),
                )
            axes.curve(ax, at, mean, mean - half, mean + half, look_of[method])
            notes += axes.outside(ax, at, mean, method)
        for method, row in own.get(title, {}).items():
            some = np.arange(0, row.shape[1], 3)
            notes += axes.diamonds(ax, "y", some + 1, row.mean(0)[some], method)
        for method in points.keys() & now[title].keys():
            ax.plot(0, now[title][method], **points[method], zorder=4)
        ax.set(
            title=title.capitalize(),
            xticks=range(0, max(row.shape[1] for row in rows.values()) + 1, 2),
        )
        axes.foot(ax, "steps ahead", notes, WIDTH / len(ahead) - 0.2)
    grid[0].set_ylabel("error to the clean state\n(half ranges)")
    handles = [
        *axes.entries(look_of),
        *(entry(method.label, **look) for method, look in points.items()),
    ]
    handles += [entry("raw observation", **unseen), *axes.yours_entry(*own.values())]
    return axes.finish(figure, [grid], handles, 4)


@styled
def advantage_map(
    differences: Panels, subject: Method, *, unit: str, yours: Panels | None = None
) -> Figure:
    """Advantage of ``subject`` over its rivals where something is hidden and where nothing is: a line each.

    differences: place -> rival -> how far the model is ahead, in ``unit``, by training seed (k,); above zero it is. A
    cell is coloured by their mean and says it, with half the 95 % t interval where there are several; beside a place
    stands how many there are. yours: the same, means in brackets. Places without numbers are left out by whoever gives
    them.
    """
    checked, own = finite_panels(differences, "k"), finite_panels(yours or {}, "k")
    places = list(dict.fromkeys([*checked, *own]))
    rivals = list(dict.fromkeys(m for part in (checked, own) for row in part.values() for m in row))
    if not rivals:
        raise ValueError("differences holds no place with a rival: nothing to draw")
    values, mine = (
        np.array(
            [
                [
                    part[place][rival].mean() if rival in part.get(place, {}) else np.nan
                    for rival in rivals
                ]
                for place in places
            ]
        )
        for part in (checked, own)
    )
    shade = np.where(np.isnan(values), mine, values)
    far = float(np.nanmax(np.abs(shade), initial=0)) or 1.0
    figure, ax = plt.subplots(figsize=(1.25 * len(rivals) + 2.8, 0.27 * len(places) + 0.55))
    image = ax.imshow(shade, cmap="PuOr", norm=TwoSlopeNorm(0.0, -far, far), aspect="auto")
    for (y, x), middle in np.ndenumerate(shade):
        cells = [
            (form, part.get(places[y], {}).get(rivals[x]))
            for form, part in (("{}", checked), ("({})", own))
        ]
        said = [form.format(_ahead(seeds)) for form, seeds in cells if seeds is not None]
        ax.text(
            x,
            y,
            " ".join(said).replace("-", "\u2212"),
            ha="center",
            va="center",
            fontsize=7.5,
            color="white" if abs(middle) > 0.6 * far else "black",
        )
    ax.set_xticks(range(len(rivals)), [f"against {rival.label}" for rival in rivals])
    ax.set_yticks(range(len(places)), [place + _seeds(checked.get(place, {})) for place in places])
    ax.xaxis.tick_top()
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0, labelsize=7)
    below = ["±: half the 95 % interval over seeds"] * any(
        len(k) > 1 for row in checked.values() for k in row.values()
    )
    ax.set_xlabel("; ".join([*below, *(["in brackets: yours"] if own else [])]))
    figure.colorbar(image, ax=ax, label=f"{subject.label} ahead by\n({unit})", shrink=0.9)
    return figure


def _ahead(seeds: np.ndarray) -> str:
    """A mean, with half its interval where there are several seeds."""
    mean, half = interval(seeds)
    return f"{mean:+.1f}" + (f" ± {half:.1f}" if half else "")


def _seeds(row: Mapping[Method, np.ndarray]) -> str:
    """How many training seeds a place of the map has, from the fewest that a rival has to the most."""
    counts = sorted({len(seeds) for seeds in row.values()})
    return f" ({' to '.join(map(str, counts))} seed{'s' * (counts[-1] > 1)})" if counts else ""
