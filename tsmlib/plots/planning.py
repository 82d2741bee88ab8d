"""Figures of plans: executed and predicted returns, paths, torques, the filmstrip of a plan (figure 6 of the paper).

Letters in shapes: n targets, T steps, dx state size.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from tsmlib.plots import style
from tsmlib.plots.axes import YOURS, diamonds, finish, foot, reference_look, references, yours_entry
from tsmlib.plots.checks import finite, shaped
from tsmlib.plots.method import PLANNERS, Method
from tsmlib.plots.style import DARK, PALE, WIDTH, Props, entry, legend, panels, styled, tint
from tsmlib.statistics import interval

Results = Mapping[
    str, Mapping[Method, Mapping[str, np.ndarray | None]]
]  # task -> method -> {"true", "predicted"}
FLOORS = ("zero", "random")
MARKERS = {
    "adam": "o",
    "adam+starts": "v",
    "cem": "s",
    "mppi": "^",
    "policy": "p",
}  # planner -> marker


Returns = tuple[np.ndarray, np.ndarray | None]  # executed and predicted (n,)


def _returns(results: Results) -> dict[str, dict[Method, Returns]]:
    """Checked results: task -> method -> returns."""
    checked: dict[str, dict[Method, Returns]] = {task: {} for task in results}
    for task, rows in results.items():
        for method, row in rows.items():
            field = f"{task}, {method.label}:"
            true = finite(f"{field} executed returns", np.asarray(row["true"]), "n")
            given = row.get("predicted")
            predicted = (
                None
                if given is None
                else finite(f"{field} predicted returns", given, str(len(true)))
            )
            checked[task][method] = true, predicted
    return checked


def _heights(methods: Iterable[Method]) -> dict[Method, float]:
    """Heights of the rows of a forest plot, a model's together with half a row between two models."""
    methods = list(methods)
    models = list(dict.fromkeys(method.model for method in methods))
    ordered = sorted(methods, key=lambda method: models.index(method.model))
    return {method: i + 0.5 * models.index(method.model) for i, method in enumerate(ordered)}


@styled
def figure6(results: Results, yours: Results | None = None) -> Figure:
    """Trajectory optimisation (paper, figure 6): the cost of the executed plans and how far the model misjudged it.

    results: task -> method -> {"true": (n,), "predicted": (n,) or None}, undiscounted returns per target. Points are
    means, bars 95 % t intervals over targets; of the cost, that of the difference to the oracle, target by target,
    where there is one, since targets differ more than methods. Costs are divided by the oracle's on the same targets,
    that of the latent search space where there are two, as in the tables; without an oracle they are in metres. Oracle,
    zero and random torques are reference lines, or words where they lie far off. Filled: latent search space; open:
    direct. yours: as results, of the same or of other targets; hollow diamonds below.
    """
    published, own = (
        {task: _Costs.of(rows) for task, rows in _returns(part).items()}
        for part in (results, yours or {})
    )
    tasks, none = list(dict.fromkeys([*published, *own])), _Costs.of({})
    pairs = {task: (published.get(task, none), own.get(task, none)) for task in tasks}
    if not any(part.lines or part.points for pair in pairs.values() for part in pair):
        raise ValueError("results hold no task with a method: nothing to draw")
    heights = {
        task: _heights({**first.points, **second.points}) for task, (first, second) in pairs.items()
    }
    lengths = [max(2.0, max(places.values(), default=0) + 1) for places in heights.values()]
    size = (WIDTH, sum((0.2 if own else 0.17) * length + 0.42 for length in lengths) + 0.3)
    figure, grid = plt.subplots(
        len(tasks), 2, figsize=size, squeeze=False, sharey="row", height_ratios=lengths
    )
    used: dict[Method, None] = {}
    for (cost, gap), (task, (first, second)) in zip(grid, pairs.items(), strict=True):
        places, main = heights[task], first if first.points else second
        far = _reference_costs(cost, main)
        used |= dict.fromkeys(method for method in main.lines if method not in far)
        gap.axvline(0, color="#999999", lw=0.6, zorder=1)
        for ax, words, values, more in (
            (
                cost,
                f"cost of the executed plan{f' / oracle{chr(39)}s' * main.divided}{' (m)' * (not main.divided)}",
                "points",
                [*far.values()],
            ),
            (gap, "predicted − executed return (m)", "gaps", []),
        ):
            _points(ax, getattr(first, values), places)
            notes = _own_points(ax, getattr(second, values), places, first.points)
            foot(ax, words, [*more, *notes], WIDTH / 2 - 0.6)
            for y in places.values():
                ax.axhline(y, color=style.GRID, lw=0.6, zorder=0)
            style.rows_only(ax)
        _row_names(cost, places)
        cost.set(title=f"{task.capitalize()}: executed cost (lower is better)")
        gap.set(title=f"{task.capitalize()}: gap (0 is best)")
        gap.locator_params(axis="x", nbins=5)  # wide numbers
    unit = " (= 1)" if any(part.divided for pair in pairs.values() for part in pair) else ""
    handles = [entry(_reference_label(method, unit), **reference_look(method)) for method in used]
    planners = dict.fromkeys(method.planner for places in heights.values() for method in places)
    marker = MARKERS.get(next(iter(planners), ""), "o")
    for face, word in ((DARK, "latent"), ("white", "direct")):
        handles.append(
            entry(
                f"search space: {word}", color=DARK, ls="", marker=marker, ms=4.2, mfc=face, mew=0.9
            )
        )
    if any(half for pair in pairs.values() for part in pair for _, half in part.points.values()):
        handles.append(entry("95 % interval over targets", color=DARK, lw=1.0))
    if len(planners) > 1:
        handles += [
            entry(
                PLANNERS.get(word, word), color=DARK, ls="", marker=MARKERS.get(word, "o"), ms=4.2
            )
            for word in planners
        ]
    legend(figure, [*handles, *yours_entry(own)])
    return figure


def _reference_label(method: Method, unit: str) -> str:
    """A reference in the legend; the oracle with its search space, and what its cost is where others are divided."""
    if method.model != "oracle":
        return method.look.name
    return ", ".join(filter(None, (method.look.name, method.search_space))) + unit


@dataclass(frozen=True)
class _Costs:
    """One task of ``figure6``: costs of references, and costs and gaps of the others, each with half its interval."""

    lines: dict[Method, float]
    points: dict[Method, tuple[float, float]]
    gaps: dict[Method, tuple[float, float]]
    divided: bool  # by the oracle's cost

    @staticmethod
    def of(rows: Mapping[Method, Returns]) -> _Costs:
        levels = references({method: float(true.mean()) for method, (true, _) in rows.items()})
        oracle = next(
            (rows[method][0] for method in levels if method.model == "oracle"), np.zeros(0)
        )
        unit = -float(oracle.mean()) if len(oracle) else 1.0
        others = {
            method: row
            for method, row in rows.items()
            if method not in levels and method.model not in FLOORS
        }
        paired = {
            method: true - oracle if len(oracle) == len(true) else true
            for method, (true, _) in others.items()
        }
        return _Costs(
            {method: -level / unit for method, level in levels.items()},
            {
                method: (-float(true.mean()) / unit, interval(paired[method])[1] / unit)
                for method, (true, _) in others.items()
            },
            {
                method: interval(told - true)
                for method, (true, told) in others.items()
                if told is not None
            },
            bool(len(oracle)),
        )


def _reference_costs(ax: Axes, costs: _Costs) -> dict[Method, str]:
    """Lines at the cost of each reference; in words those that would squeeze the methods' costs together."""
    near = [value for value, _ in costs.points.values()]
    near += [level for method, level in costs.lines.items() if method.model == "oracle"]
    far = max(near) + 2 * max(np.ptp(near), 0.02 * abs(max(near))) if near else np.inf
    words = {}
    for method, level in costs.lines.items():
        if level > far:
            words[method] = f"{method.look.name} {level:.1f}"
        else:
            ax.axvline(level, **reference_look(method), zorder=1)
    return words


def _points(
    ax: Axes, values: Mapping[Method, tuple[float, float]], heights: Mapping[Method, float]
) -> None:
    """Means with their intervals."""
    for method, (mean, half) in values.items():
        face = "white" if method.search_space == "direct" else method.look.colour
        ax.errorbar(
            mean,
            heights[method],
            xerr=half,
            color=method.look.colour,
            mfc=face,
            ms=4.2,
            mew=0.9,
            ls="",
            marker=MARKERS.get(method.planner, "o"),
            elinewidth=1.0,
            capsize=0,
            zorder=3,
        )
    ax.margins(x=0.06)


def _own_points(
    ax: Axes,
    values: Mapping[Method, tuple[float, float]],
    heights: Mapping[Method, float],
    shown: Collection[Method],
) -> list[str]:
    """The reader's own means as hollow diamonds, below ``shown`` ones; in words what lies far outside of these."""
    means = {method: mean for method, (mean, _) in values.items()}
    low, high = ax.get_xlim() if shown or not means else (min(means.values()), max(means.values()))
    room = high - low or 1.0
    near = [mean for mean in means.values() if low - room <= mean <= high + room]
    ax.set_xlim(
        min([low, *(mean - 0.06 * room for mean in near)]),
        max([high, *(mean + 0.06 * room for mean in near)]),
    )
    places = {method: np.array([heights[method] + 0.34 * (method in shown)]) for method in means}
    return [
        note
        for method in means
        for note in diamonds(ax, "x", places[method], np.array([means[method]]), method)
    ]


def _row_names(ax: Axes, heights: Mapping[Method, float]) -> None:
    """How each row was planned, less what all have in common, and each model's name beside its first row."""
    shared = (
        set.intersection(*(set(method.how) for method in heights)) if len(heights) > 1 else set()
    )
    names = [", ".join(word for word in method.how if word not in shared) for method in heights]
    ax.set_yticks(list(heights.values()), names)
    ax.set_ylim(max(heights.values(), default=0) + 0.7, -0.7)
    wide, heads = (
        max(map(len, names), default=0),
        {method.model: method for method in reversed(list(heights))},
    )
    for method in heads.values():
        ax.annotate(
            method.look.name,
            (0, heights[method]),
            (-3.6 * wide - 8, 0),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            ha="right",
            va="center_baseline",
            fontsize=7,
            color=method.look.colour,
            weight="bold",
        )


def _title(ax: Axes, method: Method) -> None:
    ax.set_title(f"{method.look.name}\n{', '.join(method.how)}", fontsize=7)


@styled
def predicted_vs_true(results: Results, yours: Results | None = None) -> Figure:
    """Predicted against executed returns, one dot per target and training seed; the line to the diagonal is the gap.

    results and yours as in ``figure6``, but n plans of any targets and seeds; methods without predictions are left out.
    """
    published, own = (
        {
            task: {
                method: (true, told) for method, (true, told) in rows.items() if told is not None
            }
            for task, rows in _returns(part).items()
        }
        for part in (results, yours or {})
    )
    none = np.zeros(0), np.zeros(0)
    checked = {
        task: {
            method: (published.get(task, {}).get(method, none), own.get(task, {}).get(method, none))
            for method in {**published.get(task, {}), **own.get(task, {})}
        }
        for task in {**published, **own}
    }
    checked = {task: rows for task, rows in checked.items() if rows}
    if not checked:
        raise ValueError(
            "no method has predicted returns: nothing to compare with the executed ones"
        )
    columns = min(4, max(map(len, checked.values())))
    down, size = [-(-len(rows) // columns) for rows in checked.values()], WIDTH / max(columns, 3)
    figure = plt.figure(figsize=(size * columns, 1.02 * size * sum(down) + 0.2 * len(down)))
    grid = figure.add_gridspec(sum(down), columns)
    for first, (task, rows) in zip(np.cumsum([0, *down]), checked.items(), strict=False):
        every = np.concatenate([part for pair in rows.values() for row in pair for part in row])
        edge = 0.04 * np.ptp(every) + 1e-9
        limits = (every.min() - edge, every.max() + edge)
        for i, (method, ((true, predicted), (mine, told))) in enumerate(rows.items()):
            ax, main = (
                figure.add_subplot(grid[first + i // columns, i % columns]),
                method.look.colour,
            )
            ax.plot(limits, limits, color="#999999", lw=0.7, zorder=1)
            ax.vlines(true, true, predicted, color=tint(main, 0.3), lw=0.4, zorder=2)
            ax.scatter(true, predicted, s=5, color=main, alpha=0.7, linewidths=0, zorder=3)
            ax.plot(mine, told, **YOURS, color=DARK, zorder=4)
            _title(ax, method)
            gaps = {"mean gap": predicted - true, "yours": told - mine}
            words = [f"{word} {gap.mean():+.2f} m" for word, gap in gaps.items() if len(gap)]
            style.note(ax, "\n".join(words).replace("-", "−"), 0.97, 0.05)
            ax.set(
                xlim=limits,
                ylim=limits,
                aspect="equal",
                xlabel="executed return (m)" if i + columns >= len(rows) else "",
                ylabel="" if i % columns else f"{task.capitalize()}: predicted return (m)",
            )
            ax.locator_params(nbins=5)
    dot = entry("one target of one training seed", color=DARK, ls="", marker="o", ms=2.6, mew=0)
    diagonal = entry("executed as predicted", color="#999999", lw=0.7)
    gap = entry("gap", color=PALE, ls="", marker="|", ms=7)
    return finish(figure, [], [dot, diagonal, gap, *yours_entry(*own.values())], 4)


@styled
def along_the_way(
    curves: Mapping[Method, Mapping[str, np.ndarray]],
    yours: Mapping[Method, Mapping[str, np.ndarray]] | None = None,
) -> Figure:
    """Predicted and executed return along the iterations of the planner, one panel per method.

    curves: method -> {"iterations": (I,), "true": (I,), "predicted": (I,)}, mean returns of the plan so far, executed
    open loop. Where the shaded gap grows, the planner exploits the model. yours: as curves; hollow diamonds, those of
    the predicted return small.
    """
    yours = yours or {}
    if not curves and not yours:
        raise ValueError("curves hold no method: nothing to draw")
    figure, axes = panels(len({**curves, **yours}), 4, 1.45, sharey=True)
    looks: dict[str, Props] = {
        "predicted": {"ls": style.DASHED, "lw": 0.9},
        "true": {"marker": "o", "ms": 2.5},
    }
    for i, (ax, method) in enumerate(zip(axes, {**curves, **yours}, strict=True)):
        _title(ax, method)
        ax.set(xlabel="iterations", ylabel="" if i % 4 else "return (m)")
        for word, size in (("true", 3.4), ("predicted", 2.2)) if method in yours else ():
            own = yours[method]
            ax.plot(
                own["iterations"],
                own[word],
                **{**YOURS, "ms": size},
                color=method.look.colour,
                zorder=5,
            )
        if (curve := curves.get(method)) is None:
            continue
        at = shaped(f"{method.label}: iterations", curve["iterations"], "I")
        found = {
            word: shaped(f"{method.label}: {word}", curve[word], str(len(at))) for word in looks
        }
        ax.fill_between(
            at, found["predicted"], found["true"], color=tint(method.look.colour, 0.25), lw=0
        )
        for word, look in looks.items():
            ax.plot(at, found[word], color=method.look.colour, **look)
        style.note(ax, f"gap {found['predicted'][-1] - found['true'][-1]:+.2f}", 0.96, 0.06)
        ax.locator_params(nbins=4)
    words = {"predicted": "predicted return", "true": "executed return"}
    handles = [entry(words[word], color=DARK, **look) for word, look in looks.items()]
    legend(figure, [*handles, *yours_entry(yours)])
    return figure


@styled
def final_distances(
    distances: Mapping[str, Mapping[Method, Mapping[str, np.ndarray]]],
    tolerance: float,
    yours: Mapping[str, Mapping[Method, Mapping[str, np.ndarray]]] | None = None,
) -> Figure:
    """Share of targets that end within a distance: solid in closed loop, dashed open loop.

    distances: task -> method -> {"open" or "closed": (n,)} in m. tolerance: what counts as a success, m. yours: as
    distances; thin lines with hollow diamonds.
    """
    yours = yours or {}
    distances = {task: distances.get(task, {}) for task in {**distances, **yours}}
    if not any((*distances.values(), *yours.values())):
        raise ValueError("distances hold no task with a method: nothing to draw")
    figure, axes = panels(
        len(distances), len(distances), 2.5, width=3.5 * len(distances), head=0, sharey=True
    )
    looks: dict[str, Props] = {
        "open": {"ls": (0, (2, 1.2)), "lw": 0.8},
        "closed": {"ls": "-", "lw": 1.3},
    }
    for ax, (task, rows) in zip(axes, distances.items(), strict=True):
        for mine, part in ((False, rows), (True, yours.get(task, {}))):
            for method, way, values in (
                (m, way, values) for m, ways in part.items() for way, values in ways.items()
            ):
                if way not in looks:
                    raise ValueError(f"{task}, {method.label} has '{way}', expected open or closed")
                end = np.sort(shaped(f"{task}, {method.label}, {way}", values, "n"))
                share = np.arange(len(end) + 1) / len(end)
                own = {**YOURS, "lw": 0.6, "markevery": (1, max(1, len(end) // 8))} if mine else {}
                look = {**looks[way], **own, "ls": looks[way]["ls"]}
                ax.step(
                    100 * np.append(0, end),
                    100 * share,
                    where="post",
                    color=method.look.colour,
                    **look,
                )
        ax.axvline(100 * tolerance, color="#999999", lw=0.6, zorder=1)
        ax.set(title=task.capitalize(), xlabel="final distance (cm)", xlim=(0, 25), ylim=(0, 102))
    axes[0].set_ylabel("targets within that distance (%)")
    drawn = dict.fromkeys(
        method for part in (distances, yours) for rows in part.values() for method in rows
    )
    handles = [entry(method.label, color=method.look.colour) for method in drawn]
    handles += [entry(f"{way} loop", color=DARK, **looks[way]) for way in looks]
    handles.append(entry(f"success, {100 * tolerance:g} cm", color="#999999", lw=0.6))
    handles += yours_entry(*yours.values())
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
    """Paths in the plane, drawn in cm, one panel per episode: the predicted rollout and the executed plan, (n, T, 2)
    each, in m.

    method: of the prediction. wanted (k, 2) or (n, k, 2): the line to follow, or one point to end at. zone: x, y and
    radius of a disc to keep away from. reach: radius of the circle that the fingertip cannot leave.
    """
    predicted, executed = (
        shaped("predicted", predicted, "n T 2"),
        shaped("executed", executed, "n T 2"),
    )
    if len(predicted) != len(executed):
        raise ValueError(
            f"predicted holds {len(predicted)} paths and executed {len(executed)}, expected equally many"
        )
    n, columns = len(executed), min(4, len(executed))
    figure, axes = panels(
        n, columns, 1.8, width=1.7 * columns + 0.5, head=0.65, sharex=True, sharey=True
    )
    looks: tuple[Props, Props] = (
        {"color": method.look.colour, "lw": 0.9, "ls": style.DASHED},
        {"color": DARK, "lw": 1.1, "marker": "o", "ms": 3, "markevery": [0]},
    )
    goal: Props = {"color": style.PALE, "lw": 3, "solid_capstyle": "round"}
    if wanted is not None:
        wanted = np.broadcast_to(wanted, (n, *np.shape(wanted)[-2:]))
        goal = (
            goal
            if wanted.shape[1] > 1
            else {"color": DARK, "ls": "", "marker": "+", "ms": 7, "mew": 1.2}
        )
    for i, ax in enumerate(axes):
        if zone is not None:
            ax.add_patch(
                Circle(
                    (100 * zone[0], 100 * zone[1]),
                    100 * zone[2],
                    fc=tint(style.RED, 0.25),
                    ec="none",
                )
            )
        if reach is not None:
            ax.add_patch(Circle((0, 0), 100 * reach, fill=False, ec=style.PALE, lw=0.6))
        if wanted is not None:
            ax.plot(*(100 * wanted[i].T), **goal)
        for path, look in zip((predicted[i], executed[i]), looks, strict=True):
            ax.plot(*(100 * path.T), **look)
        ax.set(aspect="equal", xlabel="x (cm)")
        ax.locator_params(nbins=4)
    axes[0].set_ylabel("y (cm)")
    handles = [
        entry(f"predicted rollout, {method.label}", **looks[0]),
        entry("executed plan", **looks[1]),
    ]
    if wanted is not None:
        handles.append(entry("path to follow" if wanted.shape[1] > 1 else "target", **goal))
    if zone is not None:
        handles.append(
            entry(
                "zone to keep away from",
                color=tint(style.RED, 0.25),
                ls="",
                marker="o",
                ms=6,
                mew=0,
            )
        )
    if reach is not None:
        handles.append(entry("reach of the arm", color=style.PALE, lw=0.6))
    legend(figure, handles, columns=2)
    return figure


@styled
def plan_actions(
    data: np.ndarray, latent: np.ndarray, direct: np.ndarray, method: Method, *, dt: float
) -> Figure:
    """Torques of the data, of a latent and of a direct plan (paper, figure 10), each (T, 2) in [-1, 1]; dt in s.

    The number is the mean change from step to step; method: that planned."""
    figure, axes = panels(3, 3, 1.6, head=0, sharey=True)
    shown = {"training data": data} | {
        f"{method.look.name}\n{word} plan": torques
        for word, torques in (("latent", latent), ("direct", direct))
    }
    limit = max(float(np.abs(actions).max()) for actions in shown.values()) or 1.0
    for ax, (title, actions) in zip(axes, shown.items(), strict=True):
        actions = shaped(title, actions, "T 2")
        style.torques(
            ax, actions, dt, DARK if title == "training data" else method.look.colour, limit=limit
        )
        change = np.abs(np.diff(actions, axis=0)).mean() if len(actions) > 1 else 0.0
        ax.set_title(title, fontsize=7)
        ax.set_xlabel("time (s)")
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
        checked[method] = (
            told,
            shaped(f"executed states of {method.label}", done, f"{size[0]} {size[1]}"),
        )
    if not len(times) or any(not 0 <= step < size[0] for step in times):
        raise ValueError(f"times {list(times)} must be steps between 0 and {size[0] - 1}")
    width, rows = min(WIDTH, 1.4 * len(times) + 0.3), 2 * len(checked)
    inches = (width, rows * (width - 0.3) / len(times) + 0.2 + 0.12 * len(notes or ()))
    figure, grid = plt.subplots(
        rows, len(times), figsize=inches, squeeze=False, layout="compressed"
    )
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
            grid[2 * i + 1, -1].set_xlabel(
                notes[method], fontsize=6.5, color=style.NOTE, labelpad=2
            )
    for ax, step in zip(grid[0], times, strict=True):
        ax.set_title(f"{(step + 1) * dt:.2f} s", fontsize=7)
    return figure
