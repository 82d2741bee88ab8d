"""Figures of plans: what they earned, what the model promised, the torques, and the film of one.

The paper's figures 6 and 10 and what surrounds them. Reached through ``tsmlib.figures``, where labels are explained.
Letters in shapes: n targets, T steps, dx state size.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from tsmlib.figures.style import (
    COLOURS,
    NAMES,
    WIDTH,
    colour,
    joint_legend,
    legend,
    name,
    panels,
    pretty,
    shaped,
    styled,
    tint,
    torques,
    words,
)
from tsmlib.statistics import interval

Results = Mapping[str, Mapping[str, Mapping[str, np.ndarray | None]]]  # task -> label -> {"true", "predicted"}
REFERENCES = {"oracle": "-", "zero": "--", "random": ":"}  # drawn as lines: nothing a model could gain or lose
PLANNER_MARKERS = {"adam": "o", "adam+starts": "v", "cem": "s", "mppi": "^", "policy": "D"}


def _returns(results: Results) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray | None]]]:
    """Checked results: task -> label -> (true (n,), predicted (n,) or None)."""
    checked: dict[str, dict[str, tuple[np.ndarray, np.ndarray | None]]] = {}
    for task, rows in results.items():
        checked[task] = {}
        for label, row in rows.items():
            words(label)
            true = shaped(f"results['{task}']['{label}']['true']", row["true"], "n")  # type: ignore[arg-type]
            given = row.get("predicted")
            predicted = None if given is None else shaped(f"results['{task}']['{label}']['predicted']", given, "n")
            if predicted is not None and len(predicted) != len(true):
                raise ValueError(
                    f"{task}, {label}: {len(true)} true and {len(predicted)} predicted returns, expected equally many"
                )
            for word, array in (("true", true), ("predicted", predicted)):
                if array is not None and not np.isfinite(array).all():
                    raise ValueError(
                        f"{task}, {label}: {np.sum(~np.isfinite(array))} of {array.size} {word} returns are not "
                        "finite; a mean over them means nothing. Drop or explain these targets first"
                    )
            checked[task][label] = (true, predicted)
    if not any(checked.values()):
        raise ValueError("results hold no task with a label: nothing to draw")
    return checked


def _markers(label: str) -> tuple[str, bool]:
    """The marker of a label's planner and whether it is filled (planned through the action prior)."""
    rest = words(label)[1].split()
    marker = next((PLANNER_MARKERS[word] for word in rest if word in PLANNER_MARKERS), "o")
    return marker, "actions" not in rest


def _two_lines(label: str) -> str:
    model, rest = words(label)
    return f"{NAMES.get(model, model)}\n{', '.join(pretty(rest))}"


def _groups(labels: Sequence[str]) -> tuple[dict[str, float], dict[str, float], float]:
    """Heights of the rows of a forest plot: label -> y, model -> y of its first row, and the lowest edge."""
    heights: dict[str, float] = {}
    heads: dict[str, float] = {}
    y = 0.0
    for model in COLOURS:
        for label in (label for label in labels if words(label)[0] == model):
            heads.setdefault(model, y)
            heights[label] = y
            y += 1.0
        y += 0.5 if model in heads else 0.0
    return heights, heads, y - 1.0


@styled
def figure6(results: Results) -> Figure:
    """Trajectory optimisation (paper, figure 6): the cost of the executed plans and how far the model misjudged it.

    results: task -> label -> {"true": (n,), "predicted": (n,) or None}, undiscounted returns per target. Points are
    means, bars 95 % t intervals over targets; of the cost, that of the difference to the oracle, target by target,
    where there is one, since targets differ more than methods. Labels that start with oracle, zero or random become
    reference lines (of several oracles the better one), or words where they lie far off. Filled: planned through the
    action prior (codes); open: raw actions.
    """
    checked = _returns(results)
    methods = {task: [label for label in rows if words(label)[0] not in REFERENCES] for task, rows in checked.items()}
    lengths = [max(2.0, _groups(labels)[2] + 1.0) for labels in methods.values()]
    figure, axes = plt.subplots(
        len(checked), 2, figsize=(WIDTH, sum(0.17 * length + 0.42 for length in lengths) + 0.3), squeeze=False,
        sharey="row", height_ratios=lengths,
    )  # fmt: skip
    used: set[str] = set()
    for (cost, gap), (task, rows) in zip(axes, checked.items(), strict=True):
        heights, heads, low = _groups(methods[task])
        levels = {word: max((rows[label][0] for label in rows if words(label)[0] == word), key=np.mean)
                  for word in REFERENCES if any(words(label)[0] == word for label in rows)}  # fmt: skip
        outside = _draw_levels(cost, levels, [-rows[label][0].mean() for label in heights])
        used |= {word for word in levels if word not in outside}
        for label, y in heights.items():
            true, predicted = rows[label]
            base = levels.get("oracle", np.zeros(0))
            paired = true - base if len(base) == len(true) else true
            marker, filled = _markers(label)
            look = {"color": colour(label), "marker": marker, "mfc": colour(label) if filled else "white",
                    "ms": 4.2, "mew": 0.9, "elinewidth": 1.0, "capsize": 0, "ls": "", "zorder": 3}  # fmt: skip
            cost.errorbar(-true.mean(), y, xerr=interval(paired)[1], **look)
            if predicted is not None:
                mean, half = interval(predicted - true)
                gap.errorbar(mean, y, xerr=half, **look)
        gap.axvline(0, color="#999999", lw=0.6, zorder=1)
        for ax in (cost, gap):
            for y in heights.values():
                ax.axhline(y, color="#EEEEEE", lw=0.6, zorder=0)
            ax.spines["left"].set_visible(False)
            ax.tick_params(axis="y", length=0)
            ax.margins(x=0.06)
        rest = [pretty(words(label)[1]) for label in heights]
        common = set.intersection(*map(set, rest)) if len(rest) > 1 else set()  # the planner, if there is but one
        cost.set_yticks(list(heights.values()), [", ".join(w for w in words if w not in common) for words in rest])
        cost.set_ylim(low + 0.7, -0.7)
        wide = max((len(text.get_text()) for text in cost.get_yticklabels()), default=0)
        for model, y in heads.items():
            cost.annotate(NAMES.get(model, model), (0, y), (-3.6 * wide - 8, 0), xycoords=("axes fraction", "data"),
                          textcoords="offset points", ha="right", va="center_baseline", fontsize=7,
                          color=COLOURS[model], weight="bold")  # fmt: skip
        cost.set_title(f"{task.capitalize()}: true cost (lower is better)")
        gap.set_title(f"{task.capitalize()}: gap (0 is best)")
        cost.set_xlabel("\n".join(["−return of the executed plan (m)", *outside.values()]))
        gap.set_xlabel("predicted − true return (m)")
    dark = COLOURS["data"]
    handles = [Line2D([], [], color=COLOURS[r], ls=REFERENCES[r], lw=1, label=name(r)) for r in REFERENCES if r in used]
    for fill, text in ((dark, "through the action prior"), ("white", "raw actions")):
        handles.append(Line2D([], [], color=dark, ls="", marker="o", ms=4.2, mfc=fill, mew=0.9, label=text))
    legend(figure, handles)
    return figure


def _draw_levels(ax: Axes, levels: Mapping[str, np.ndarray], costs: Sequence[float]) -> dict[str, str]:
    """Lines at the mean cost of each reference; in words those that would squeeze the methods' ``costs`` together."""
    near = [*costs, *(-levels["oracle"].mean() for _ in levels if "oracle" in levels)]
    far = max(near) + 2 * max(np.ptp(near), 0.1) if near else np.inf
    outside = {}
    for word, returns in levels.items():
        if -returns.mean() > far:
            outside[word] = f"outside: {name(word)} {-returns.mean():.1f}"
        else:
            ax.axvline(-returns.mean(), color=COLOURS[word], ls=REFERENCES[word], lw=1, zorder=1)
    return outside


@styled
def predicted_vs_true(results: Results) -> Figure:
    """What the model promised against what the arm got, one dot per target; the line to the diagonal is the gap.

    results as in ``figure6``; labels without predictions are left out.
    """
    checked = {task: {label: row for label, row in rows.items() if row[1] is not None}
               for task, rows in _returns(results).items()}  # fmt: skip
    checked = {task: rows for task, rows in checked.items() if rows}
    if not checked:
        raise ValueError("no label has predicted returns: nothing to compare with the true ones")
    columns = min(4, max(len(rows) for rows in checked.values()))
    heights = {task: -(-len(rows) // columns) for task, rows in checked.items()}
    size = WIDTH / max(columns, 3)
    figure = plt.figure(figsize=(size * columns, 1.02 * size * sum(heights.values()) + 0.2 * len(heights)))
    grid = figure.add_gridspec(sum(heights.values()), columns)
    first = 0
    for task, rows in checked.items():
        everything = np.concatenate([part for row in rows.values() for part in row if part is not None])
        edge = 0.04 * np.ptp(everything) + 1e-9
        limits = (everything.min() - edge, everything.max() + edge)
        for i, (label, (true, predicted)) in enumerate(rows.items()):
            assert predicted is not None
            ax = figure.add_subplot(grid[first + i // columns, i % columns])
            ax.plot(limits, limits, color="#999999", lw=0.7, zorder=1)
            ax.vlines(true, true, predicted, color=tint(colour(label), 0.35), lw=0.6, zorder=2)
            ax.scatter(true, predicted, s=7, color=colour(label), linewidths=0, zorder=3)
            ax.set_title(_two_lines(label), fontsize=7)
            ax.annotate(f"mean gap {np.mean(predicted - true):+.2f}", (0.97, 0.05), xycoords="axes fraction",
                        ha="right", fontsize=6.5)  # fmt: skip
            ax.set(xlim=limits, ylim=limits, aspect="equal")
            ax.locator_params(nbins=5)
            ax.set_xlabel("true return" if i + columns >= len(rows) else "")
            ax.set_ylabel("" if i % columns else f"{task.capitalize()}: predicted return")
        first += heights[task]
    return figure


@styled
def along_the_way(curves: Mapping[str, Mapping[str, np.ndarray]]) -> Figure:
    """What more optimisation is worth: what the model promises and what the arm earns, against iterations.

    curves: label -> {"iterations": (I,), "true": (I,), "predicted": (I,)}, mean returns of the plan so far, executed
    open loop. One panel per label; where the shaded gap grows, the planner exploits the model.
    """
    if not curves:
        raise ValueError("curves hold no label: nothing to draw")
    figure, axes = panels(len(curves), 4, 1.45, sharey=True)
    for ax, (label, curve) in zip(axes, curves.items(), strict=True):
        at = shaped(f"{label}: iterations", curve["iterations"], "I")
        true, predicted = (shaped(f"{label}: {word}", curve[word], str(len(at))) for word in ("true", "predicted"))
        main = colour(label)
        ax.fill_between(at, true, predicted, color=tint(main, 0.25), lw=0)
        ax.plot(at, predicted, color=main, lw=0.9, ls=(0, (3, 1.5)))
        ax.plot(at, true, color=main, lw=1.3, marker="o", ms=2.5)
        ax.set_title(_two_lines(label), fontsize=7)
        ax.annotate(f"gap {predicted[-1] - true[-1]:+.2f}", (0.96, 0.06), xycoords="axes fraction", ha="right",
                    fontsize=6.5)  # fmt: skip
        ax.set_xlabel("iterations")
        ax.locator_params(nbins=4)
    for ax in axes[:: min(4, len(axes))]:
        ax.set_ylabel("return (m)")
    dark = COLOURS["data"]
    legend(figure, [Line2D([], [], color=dark, lw=0.9, ls=(0, (3, 1.5)), label="promised by the model"),
                    Line2D([], [], color=dark, lw=1.3, marker="o", ms=2.5, label="earned by the arm")])  # fmt: skip
    return figure


@styled
def final_distances(distances: Mapping[str, Mapping[str, Mapping[str, np.ndarray]]], tolerance: float) -> Figure:
    """How near trials end, as the share of targets within a distance: solid in closed loop, dashed open loop.

    distances: task -> label -> {"open" or "closed": (n,)} in m. tolerance: what counts as a success, m.
    """
    if not any(distances.values()):
        raise ValueError("distances hold no task with a label: nothing to draw")
    figure, axes = plt.subplots(1, len(distances), figsize=(3.5 * len(distances), 2.5), squeeze=False, sharey=True)
    looks: dict[str, dict[str, Any]] = {"open": {"ls": (0, (2, 1.2)), "lw": 0.8}, "closed": {"ls": "-", "lw": 1.3}}
    labels: dict[str, None] = {}
    for ax, (task, rows) in zip(axes[0], distances.items(), strict=True):
        for label, ways in rows.items():
            labels.setdefault(label)
            for way, values in ways.items():
                if way not in looks:
                    raise ValueError(f"{task}, {label} has '{way}', expected open or closed")
                end = np.sort(shaped(f"{task}, {label}, {way}", values, "n"))
                share = np.arange(len(end) + 1) / len(end)
                ax.step(1000 * np.append(0, end), 100 * share, where="post", color=colour(label), **looks[way])
        ax.axvline(1000 * tolerance, color="#999999", lw=0.6, zorder=1)
        ax.set(title=task.capitalize(), xlabel="final distance (mm)", xlim=(0, 250), ylim=(0, 102))
    axes[0, 0].set_ylabel("targets reached (%)")
    handles = [Line2D([], [], color=colour(label), label=name(label)) for label in labels]
    handles += [Line2D([], [], color=COLOURS["data"], **looks[way], label=f"{way} loop") for way in looks]
    legend(figure, handles, columns=2 * len(distances))
    return figure


@styled
def plan_paths(
    dreamt: np.ndarray, done: np.ndarray, *, wanted: np.ndarray | None = None,
    zone: tuple[float, float, float] | None = None, reach: float | None = None, label: str = "tsm",
) -> Figure:  # fmt: skip
    """Paths in the plane, one panel per episode: what the model dreamt and what the arm did, (n, T, 2) each, in m.

    wanted (k, 2) or (n, k, 2): the line to follow, or one point to end at. zone: x, y and radius of a disc to keep away
    from. reach: radius of the circle that the fingertip cannot leave. label: whose dream it is.
    """
    dreamt, done = shaped("dreamt", dreamt, "n T 2"), shaped("done", done, "n T 2")
    if len(dreamt) != len(done):
        raise ValueError(f"dreamt holds {len(dreamt)} paths and done {len(done)}, expected equally many")
    columns, dark, main = min(4, len(done)), COLOURS["data"], colour(label)
    rows = -(-len(done) // columns)
    figure, grid = plt.subplots(
        rows, columns, figsize=(1.7 * columns + 0.5, 1.8 * rows + 0.35), squeeze=False, sharex=True, sharey=True
    )
    for ax in grid.flat[len(done) :]:
        ax.remove()
    axes = list(grid.flat[: len(done)])
    if wanted is not None:
        wanted = np.broadcast_to(wanted, (len(done), *np.shape(wanted)[-2:]))
    for i, ax in enumerate(axes):
        if zone is not None:
            ax.add_patch(Circle(zone[:2], zone[2], fc=tint(COLOURS["multistep"], 0.25), ec="none"))
        if reach is not None:
            ax.add_patch(Circle((0, 0), reach, fill=False, ec="#BBBBBB", lw=0.6))
        if wanted is not None:
            ax.plot(*wanted[i].T, color="#BBBBBB", lw=3 if len(wanted[i]) > 1 else 0, marker="" if len(wanted[i]) > 1
                    else "+", ms=7, mew=1.2, mec=dark, solid_capstyle="round")  # fmt: skip
        ax.plot(*dreamt[i].T, color=main, lw=0.9, ls=(0, (3, 1.5)))
        ax.plot(*done[i].T, color=dark, lw=1.1)
        ax.plot(*done[i, 0], "o", color=dark, ms=3)
        ax.set(aspect="equal", xlabel="x (m)")
        ax.locator_params(nbins=4)
    axes[0].set_ylabel("y (m)")
    shown: dict[str, Any] = {"lw": 1.1, "marker": "o", "ms": 3, "markevery": [0]}
    legend(figure, [Line2D([], [], color=main, lw=0.9, ls=(0, (3, 1.5)), label=f"dreamt by {name(label)}"),
                    Line2D([], [], color=dark, label="done by the arm", **shown)])  # fmt: skip
    return figure


@styled
def plan_actions(data_actions: np.ndarray, prior_plan: np.ndarray, direct_plan: np.ndarray, dt: float,
                 label: str = "tsm") -> Figure:  # fmt: skip
    """What the action prior does to a plan (paper, figure 10): torques of the data, of a plan over latent codes and of
    a plan over raw actions, each (T, 2) in [-1, 1]; dt in s. The number is the mean change from step to step."""
    figure, axes = plt.subplots(1, 3, figsize=(WIDTH, 1.6), sharey=True)
    shown = (("training data", data_actions, COLOURS["data"]), ("plan over codes", prior_plan, colour(label)),
              ("plan over actions", direct_plan, colour(label)))  # fmt: skip
    limit = max(float(np.abs(actions).max()) for _, actions, _ in shown) or 1.0
    for ax, (title, actions, main) in zip(axes, shown, strict=True):
        actions = shaped(title, actions, "T 2")
        torques(ax, actions, dt, main, limit=limit)
        ax.set_title(title)
        change = np.abs(np.diff(actions, axis=0)).mean() if len(actions) > 1 else 0.0
        ax.set_title(f"mean |Δu| {change:.3f}", loc="right", fontsize=6.5, color="#555555")
        ax.set_xlabel("time (s)")
    axes[0].set_ylabel("torque (share of full)")
    joint_legend(figure)
    return figure


@styled
def plan_strip(
    draw: Callable[[Axes, np.ndarray, np.ndarray], object], predicted_states: np.ndarray, true_states: np.ndarray,
    target: np.ndarray, times: Sequence[int], dt: float = 0.02,
) -> Figure:  # fmt: skip
    """A filmstrip: what the model dreamt above, what the arm did below, at the steps ``times``.

    draw(ax, state (dx,), target (2,)) paints one scene; predicted_states and true_states: (T, dx), row k the
    state after k + 1 steps of dt seconds.
    """
    predicted = shaped("predicted_states", predicted_states, "T dx")
    true = shaped("true_states", true_states, f"{len(predicted)} {predicted.shape[1]}")
    outside = [step for step in times if not 0 <= step < len(true)]
    if outside or not len(times):
        raise ValueError(f"times {list(times)} must be steps between 0 and {len(true) - 1}")
    width = min(WIDTH, 1.4 * len(times) + 0.2)
    figure, axes = plt.subplots(2, len(times), figsize=(width, 2 * width / len(times) + 0.15), squeeze=False,
                                layout="compressed")  # fmt: skip
    for row, states, title in zip(axes, (predicted, true), ("model", "simulator"), strict=True):
        for ax, step in zip(row, times, strict=True):
            draw(ax, states[step], np.asarray(target))
            ax.set(aspect="equal", xticks=(), yticks=(), xlabel="", ylabel="", title="")
            ax.set_axis_on()
            ax.spines[:].set(visible=True, color="#CCCCCC")
        row[0].set_ylabel(title, fontsize=7.5)
    for ax, step in zip(axes[0], times, strict=True):
        ax.set_title(f"{(step + 1) * dt:.2f} s", fontsize=7)
    return figure
