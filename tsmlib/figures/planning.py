"""Figures of plans: executed and predicted returns, paths, torques, the filmstrip of a plan (figure 6 of the paper).

Letters in shapes: n targets, T steps, dx state size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from tsmlib.figures import style
from tsmlib.figures.axes import REFERENCES, reference_look, references
from tsmlib.figures.checks import finite, shaped
from tsmlib.figures.method import Method
from tsmlib.figures.style import DARK, WIDTH, Props, entry, legend, panels, styled, tint
from tsmlib.statistics import interval

Results = Mapping[str, Mapping[Method, Mapping[str, np.ndarray | None]]]  # task -> method -> {"true", "predicted"}
MARKERS = {"adam": "o", "adam+starts": "v", "cem": "s", "mppi": "^", "policy": "D"}  # planner -> marker


Returns = tuple[np.ndarray, np.ndarray | None]  # executed and predicted (n,)


def _returns(results: Results) -> dict[str, dict[Method, Returns]]:
    """Checked results: task -> method -> returns."""
    checked: dict[str, dict[Method, Returns]] = {task: {} for task in results}
    for task, rows in results.items():
        for method, row in rows.items():
            field = f"{task}, {method.label}:"
            true = finite(f"{field} executed returns", np.asarray(row["true"]), "n")
            given = row.get("predicted")
            predicted = None if given is None else finite(f"{field} predicted returns", given, str(len(true)))
            checked[task][method] = true, predicted
    if not any(checked.values()):
        raise ValueError("results hold no task with a method: nothing to draw")
    return checked


def _heights(methods: Iterable[Method]) -> dict[Method, float]:
    """Heights of the rows of a forest plot, a model's together with half a row between two models."""
    methods = list(methods)
    models = list(dict.fromkeys(method.model for method in methods))
    ordered = sorted(methods, key=lambda method: models.index(method.model))
    return {method: i + 0.5 * models.index(method.model) for i, method in enumerate(ordered)}


@styled
def figure6(results: Results) -> Figure:
    """Trajectory optimisation (paper, figure 6): the cost of the executed plans and how far the model misjudged it.

    results: task -> method -> {"true": (n,), "predicted": (n,) or None}, undiscounted returns per target. Points are
    means, bars 95 % t intervals over targets; of the cost, that of the difference to the oracle, target by target,
    where there is one, since targets differ more than methods. Oracle, zero and random torques become reference lines
    (of several oracles the better one), or words where they lie far off. Filled: latent search space; open: direct.
    """
    checked = _returns(results)
    heights = {task: _heights(m for m in rows if m.model not in REFERENCES) for task, rows in checked.items()}
    lengths = [max(2.0, max(places.values(), default=0) + 1) for places in heights.values()]
    size = (WIDTH, sum(0.17 * length + 0.42 for length in lengths) + 0.3)
    figure, grid = plt.subplots(
        len(checked), 2, figsize=size, squeeze=False, sharey="row", height_ratios=lengths
    )  # fmt: skip
    used: dict[Method, None] = {}
    for (cost, gap), (task, rows) in zip(grid, checked.items(), strict=True):
        levels = references({method: float(true.mean()) for method, (true, _) in rows.items()})
        far = _reference_costs(cost, levels, [-rows[method][0].mean() for method in heights[task]])
        used |= dict.fromkeys(method for method in levels if method not in far)
        oracle = next((rows[method][0] for method in levels if method.model == "oracle"), np.zeros(0))
        _points(cost, gap, rows, heights[task], oracle)
        _row_names(cost, heights[task])
        cost.set(title=f"{task.capitalize()}: executed cost (lower is better)")
        gap.set(title=f"{task.capitalize()}: gap (0 is best)", xlabel="predicted − executed return (m)")
        cost.set_xlabel("\n".join(["−executed return (m)", *far.values()]))
    handles = [entry(method.look.name, **reference_look(method)) for method in used]
    for face, word in ((DARK, "latent"), ("white", "direct")):
        handles.append(entry(f"search space: {word}", color=DARK, ls="", marker="o", ms=4.2, mfc=face, mew=0.9))
    legend(figure, handles)
    return figure


def _reference_costs(ax: Axes, levels: Mapping[Method, float], costs: Sequence[float]) -> dict[Method, str]:
    """Lines at the cost of each reference; in words those that would squeeze the methods' ``costs`` together."""
    near = [*costs, *(-level for method, level in levels.items() if method.model == "oracle")]
    far = max(near) + 2 * max(np.ptp(near), 0.1) if near else np.inf
    words = {}
    for method, level in levels.items():
        if -level > far:
            words[method] = f"outside: {method.look.name} {-level:.1f}"
        else:
            ax.axvline(-level, **reference_look(method), zorder=1)
    return words


def _points(
    cost: Axes, gap: Axes, rows: Mapping[Method, Returns], heights: Mapping[Method, float], oracle: np.ndarray
) -> None:
    """Means of cost and gap with their intervals, of the cost that of its difference to the oracle's."""
    gap.axvline(0, color="#999999", lw=0.6, zorder=1)
    for method, y in heights.items():
        (true, predicted), main = rows[method], method.look.colour
        face = "white" if method.search_space == "direct" else main
        look: Props = {"color": main, "marker": MARKERS.get(method.planner, "o"), "mfc": face, "ms": 4.2, "mew": 0.9,
                       "elinewidth": 1.0, "capsize": 0, "ls": "", "zorder": 3}  # fmt: skip
        paired = true - oracle if len(oracle) == len(true) else true
        cost.errorbar(-true.mean(), y, xerr=interval(paired)[1], **look)
        if predicted is not None:
            mean, half = interval(predicted - true)
            gap.errorbar(mean, y, xerr=half, **look)
    for ax in (cost, gap):
        for y in heights.values():
            ax.axhline(y, color=style.GRID, lw=0.6, zorder=0)
        style.rows_only(ax)
        ax.margins(x=0.06)


def _row_names(ax: Axes, heights: Mapping[Method, float]) -> None:
    """How each row was planned, less what all have in common, and each model's name beside its first row."""
    shared = set.intersection(*(set(method.how) for method in heights)) if len(heights) > 1 else set()
    names = [", ".join(word for word in method.how if word not in shared) for method in heights]
    ax.set_yticks(list(heights.values()), names)
    ax.set_ylim(max(heights.values(), default=0) + 0.7, -0.7)
    wide, heads = max(map(len, names), default=0), {method.model: method for method in reversed(list(heights))}
    for method in heads.values():
        ax.annotate(method.look.name, (0, heights[method]), (-3.6 * wide - 8, 0), xycoords=("axes fraction", "data"),
                    textcoords="offset points", ha="right", va="center_baseline", fontsize=7,
                    color=method.look.colour, weight="bold")  # fmt: skip


def _title(ax: Axes, method: Method) -> None:
    ax.set_title(f"{method.look.name}\n{', '.join(method.how)}", fontsize=7)


@styled
def predicted_vs_true(results: Results) -> Figure:
    """Predicted against executed returns, one dot per target; the line to the diagonal is the gap.

    results as in ``figure6``; methods without predictions are left out.
    """
    checked = {task: {method: (true, told) for method, (true, told) in rows.items() if told is not None}
               for task, rows in _returns(results).items()}  # fmt: skip
    checked = {task: rows for task, rows in checked.items() if rows}
    if not checked:
        raise ValueError("no method has predicted returns: nothing to compare with the executed ones")
    columns = min(4, max(map(len, checked.values())))
    down, size = [-(-len(rows) // columns) for rows in checked.values()], WIDTH / max(columns, 3)
    figure = plt.figure(figsize=(size * columns, 1.02 * size * sum(down) + 0.2 * len(down)))
    grid = figure.add_gridspec(sum(down), columns)
    for first, (task, rows) in zip(np.cumsum([0, *down]), checked.items(), strict=False):
        every = np.concatenate([part for row in rows.values() for part in row])
        edge = 0.04 * np.ptp(every) + 1e-9
        limits = (every.min() - edge, every.max() + edge)
        for i, (method, (true, predicted)) in enumerate(rows.items()):
            ax, main = figure.add_subplot(grid[first + i // columns, i % columns]), method.look.colour
            ax.plot(limits, limits, color="#999999", lw=0.7, zorder=1)
            ax.vlines(true, true, predicted, color=tint(main, 0.35), lw=0.6, zorder=2)
            ax.scatter(true, predicted, s=7, color=main, linewidths=0, zorder=3)
            _title(ax, method)
            style.note(ax, f"mean gap {np.mean(predicted - true):+.2f}", 0.97, 0.05)
            ax.set(xlim=limits, ylim=limits, aspect="equal",
                   xlabel="executed return" if i + columns >= len(rows) else "",
                   ylabel="" if i % columns else f"{task.capitalize()}: predicted return")  # fmt: skip
            ax.locator_params(nbins=5)
    return figure


@styled
def along_the_way(curves: Mapping[Method, Mapping[str, np.ndarray]]) -> Figure:
    """Predicted and executed return along the iterations of the planner, one panel per method.

    curves: method -> {"iterations": (I,), "true": (I,), "predicted": (I,)}, mean returns of the plan so far, executed
    open loop. Where the shaded gap grows, the planner exploits the model.
    """
    if not curves:
        raise ValueError("curves hold no method: nothing to draw")
    figure, axes = panels(len(curves), 4, 1.45, sharey=True)
    looks: dict[str, Props] = {"predicted": {"ls": style.DASHED, "lw": 0.9}, "true": {"marker": "o", "ms": 2.5}}
    for i, (ax, (method, curve)) in enumerate(zip(axes, curves.items(), strict=True)):
        at = shaped(f"{method.label}: iterations", curve["iterations"], "I")
        found = {word: shaped(f"{method.label}: {word}", curve[word], str(len(at))) for word in looks}
        ax.fill_between(at, found["predicted"], found["true"], color=tint(method.look.colour, 0.25), lw=0)
        for word, look in looks.items():
            ax.plot(at, found[word], color=method.look.colour, **look)
        _title(ax, method)
        style.note(ax, f"gap {found['predicted'][-1] - found['true'][-1]:+.2f}", 0.96, 0.06)
        ax.set(xlabel="iterations", ylabel="" if i % 4 else "return (m)")
        ax.locator_params(nbins=4)
    words = {"predicted": "predicted return", "true": "executed return"}
    legend(figure, [entry(words[word], color=DARK, **look) for word, look in looks.items()])
    return figure


@styled
def final_distances(distances: Mapping[str, Mapping[Method, Mapping[str, np.ndarray]]], tolerance: float) -> Figure:
    """Share of targets that end within a distance: solid in closed loop, dashed open loop.

    distances: task -> method -> {"open" or "closed": (n,)} in m. tolerance: what counts as a success, m.
    """
    if not any(distances.values()):
        raise ValueError("distances hold no task with a method: nothing to draw")
    figure, axes = panels(len(distances), len(distances), 2.5, width=3.5 * len(distances), head=0, sharey=True)
    looks: dict[str, Props] = {"open": {"ls": (0, (2, 1.2)), "lw": 0.8}, "closed": {"ls": "-", "lw": 1.3}}
    for ax, (task, rows) in zip(axes, distances.items(), strict=True):
        for method, ways in rows.items():
            for way, values in ways.items():
                if way not in looks:
                    raise ValueError(f"{task}, {method.label} has '{way}', expected open or closed")
                end = np.sort(shaped(f"{task}, {method.label}, {way}", values, "n"))
                share = np.arange(len(end) + 1) / len(end)
                ax.step(1000 * np.append(0, end), 100 * share, where="post", color=method.look.colour, **looks[way])
        ax.axvline(1000 * tolerance, color="#999999", lw=0.6, zorder=1)
        ax.set(title=task.capitalize(), xlabel="final distance (mm)", xlim=(0, 250), ylim=(0, 102))
    axes[0].set_ylabel("targets reached (%)")
    drawn = dict.fromkeys(method for rows in distances.values() for method in rows)
    handles = [entry(method.label, color=method.look.colour) for method in drawn]
    handles += [entry(f"{way} loop", color=DARK, **looks[way]) for way in looks]
    legend(figure, handles, columns=2 * len(distances))
    return figure


@styled
def plan_paths(
    predicted: np.ndarray,
    executed: np.ndarray,
    method: Method,
    *,
    wanted: np.ndarray | None = None,
    zone: tuple[float, float, float] | None = None,
    reach: float | None = None,
) -> Figure:
    """Paths in the plane, one panel per episode: the predicted rollout and the executed plan, (n, T, 2) each, in m.

    method: of the prediction. wanted (k, 2) or (n, k, 2): the line to follow, or one point to end at. zone: x, y and
    radius of a disc to keep away from. reach: radius of the circle that the fingertip cannot leave.
    """
    predicted, executed = shaped("predicted", predicted, "n T 2"), shaped("executed", executed, "n T 2")
    if len(predicted) != len(executed):
        raise ValueError(f"predicted holds {len(predicted)} paths and executed {len(executed)}, expected equally many")
    n, columns = len(executed), min(4, len(executed))
    figure, axes = panels(n, columns, 1.8, width=1.7 * columns + 0.5, sharex=True, sharey=True)
    looks: tuple[Props, Props] = ({"color": method.look.colour, "lw": 0.9, "ls": style.DASHED},
                                  {"color": DARK, "lw": 1.1, "marker": "o", "ms": 3, "markevery": [0]})  # fmt: skip
    goal: Props = {"color": style.PALE, "lw": 3, "solid_capstyle": "round"}
    if wanted is not None:
        wanted = np.broadcast_to(wanted, (n, *np.shape(wanted)[-2:]))
        goal = goal if wanted.shape[1] > 1 else {"color": DARK, "ls": "", "marker": "+", "ms": 7, "mew": 1.2}
    for i, ax in enumerate(axes):
        if zone is not None:
            ax.add_patch(Circle(zone[:2], zone[2], fc=tint(style.RED, 0.25), ec="none"))
        if reach is not None:
            ax.add_patch(Circle((0, 0), reach, fill=False, ec=style.PALE, lw=0.6))
        if wanted is not None:
            ax.plot(*wanted[i].T, **goal)
        for path, look in zip((predicted[i], executed[i]), looks, strict=True):
            ax.plot(*path.T, **look)
        ax.set(aspect="equal", xlabel="x (m)")
        ax.locator_params(nbins=4)
    axes[0].set_ylabel("y (m)")
    legend(figure, [entry(f"predicted rollout, {method.label}", **looks[0]), entry("executed plan", **looks[1])])
    return figure


@styled
def plan_actions(data: np.ndarray, latent: np.ndarray, direct: np.ndarray, method: Method, *, dt: float) -> Figure:
    """Torques of the data, of a latent and of a direct plan (paper, figure 10), each (T, 2) in [-1, 1]; dt in s.

    The number is the mean change from step to step; method: that planned."""
    figure, axes = panels(3, 3, 1.6, head=0, sharey=True)
    shown = {"training data": data, "latent plan": latent, "direct plan": direct}
    limit = max(float(np.abs(actions).max()) for actions in shown.values()) or 1.0
    for ax, (title, actions) in zip(axes, shown.items(), strict=True):
        actions = shaped(title, actions, "T 2")
        style.torques(ax, actions, dt, DARK if title == "training data" else method.look.colour, limit=limit)
        change = np.abs(np.diff(actions, axis=0)).mean() if len(actions) > 1 else 0.0
        ax.set(title=title, xlabel="time (s)")
        ax.set_title(f"mean |Δu| {change:.3f}", loc="right", fontsize=6.5, color="#555555")
    axes[0].set_ylabel("torque (share of full)")
    style.joint_legend(figure)
    return figure


@styled
def plan_strip(
    draw: Callable[[Axes, np.ndarray, np.ndarray], object],
    rollouts: Mapping[Method, tuple[np.ndarray, np.ndarray]],
    target: np.ndarray,
    times: Sequence[int],
    dt: float = 0.02,
    notes: Mapping[Method, str] | None = None,
) -> Figure:
    """A filmstrip of one target: for each method the predicted rollout above, the executed plan below, at ``times``.

    draw(ax, states (k, dx) until then, target (2,)) paints one scene; rollouts: method -> predicted and executed
    states, (T, dx) each, row k the state after k + 1 steps of dt seconds; notes: method -> words below its last
    picture.
    """
    if not rollouts:
        raise ValueError("rollouts hold no method: nothing to draw")
    checked, size = {}, np.shape(next(iter(rollouts.values()))[0])
    for method, (told, done) in rollouts.items():
        told = shaped(f"predicted states of {method.label}", told, "T dx")
        checked[method] = told, shaped(f"executed states of {method.label}", done, f"{size[0]} {size[1]}")
    if not len(times) or any(not 0 <= step < size[0] for step in times):
        raise ValueError(f"times {list(times)} must be steps between 0 and {size[0] - 1}")
    width, rows = min(WIDTH, 1.4 * len(times) + 0.3), 2 * len(checked)
    inches = (width, rows * (width - 0.3) / len(times) + 0.2 + 0.12 * len(notes or ()))
    figure, grid = plt.subplots(rows, len(times), figsize=inches, squeeze=False, layout="compressed")
    for i, (method, states) in enumerate(checked.items()):
        for row, path, title in zip(grid[2 * i :], states, ("predicted", "executed"), strict=False):
            for ax, step in zip(row, times, strict=True):
                draw(ax, path[: step + 1], np.asarray(target))
                style.scene(ax)
                ax.set(xlabel="", ylabel="")
            colour = method.look.colour if len(checked) > 1 else DARK
            name = f"{method.look.name}\n" if len(checked) > 1 else ""
            row[0].set_ylabel(name + title, fontsize=7.5, color=colour)
        if notes and method in notes:
            grid[2 * i + 1, -1].set_xlabel(notes[method], fontsize=6.5, color=style.NOTE, labelpad=2)
    for ax, step in zip(grid[0], times, strict=True):
        ax.set_title(f"{(step + 1) * dt:.2f} s", fontsize=7)
    return figure
