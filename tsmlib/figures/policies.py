"""Figures of learned policies: returns along their learning, and the cost of it (figures 7 and 8 of the paper).

Letters in shapes: k policies or seeds, R records along a curve.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from tsmlib.figures import axes
from tsmlib.figures.checks import finite, known
from tsmlib.figures.method import SEARCH_SPACES, Method
from tsmlib.figures.style import DARK, DASHED, GRID, WIDTH, Props, entry, note, styled

Curves = dict[str, np.ndarray]
LearningCurves = Mapping[str, Mapping[Method, Mapping[str, np.ndarray]]]  # task -> method -> Curves
References = Mapping[str, Mapping[Method, float]]  # task -> method -> return
AXES = {"steps": "steps in the model", "samples": "environment steps, the model's data included",
        "seconds": "seconds, training of the model included"}  # fmt: skip
FREE = "; without a model, in the environment"  # more on the first of AXES
PREDICTED: Props = {"ls": DASHED, "lw": 0.7}


@styled
def figure7(
    curves: LearningCurves, references: References | None = None, against: Sequence[str] = tuple(AXES),
    yours: LearningCurves | None = None,
) -> Figure:  # fmt: skip
    """Learning curves of policies (paper, figure 7): a column for each task, a row for each quantity of ``against``.

    curves: task -> method -> {"return_true": (k, R)}, mean undiscounted return over the task's targets in m, and of
    {"steps", "samples", "seconds": (R,)} what is known of it, "return_predicted": (k, R) of the model. steps: in the
    model that a policy learns in, or else in the environment; samples: in the environment, those of the model's data
    included. A method is drawn in the rows that it has numbers for. references: task -> oracle, zero or random torques
    -> return, drawn as lines.

    A model has one colour and marker; latent policies are filled and thick, direct ones open. Lines are means, bands
    their 95 % t intervals over the k. Against steps, dashes show the predicted return. A policy whose samples are a
    data set that never grows is a point there, at its end, and a faint line to the right of it; such points stand side
    by side, right of a line that says how many they all are. Seconds are on a logarithmic axis from 1 s. The range of
    returns is that of the ends and what lies near them; where curves begin, and references outside, stand in words
    below. yours: as curves, drawn over them as hollow diamonds.
    """
    return _draw(curves, references or {}, against, yours=yours)


@styled
def figure8(
    curves: LearningCurves, references: Mapping[Method, float] | None = None, yours: LearningCurves | None = None
) -> Figure:
    """Learning curves of policies with noise and with delay beside the clean arm (paper, figure 8), one scale for all.

    curves: condition -> method -> {"return_true": (k, R), "steps": (R,)}, steps in the model; references: zero or
    random torques -> return, drawn as lines in every panel. Lines are means, bands their 95 % t intervals. yours: as
    curves, drawn over them as hollow diamonds.
    """
    every = dict.fromkeys({**curves, **(yours or {})}, references or {})
    return _draw(curves, every, ("steps",), sharey=True, yours=yours)


def _draw(
    curves: LearningCurves, references: References, against: Sequence[str], sharey: bool = False,
    yours: LearningCurves | None = None,
) -> Figure:  # fmt: skip
    """``figure7``; sharey: one scale of returns for all columns, from doing nothing on."""
    known("against", against, list(AXES))
    known("references", references, [*curves, *(yours or {})])
    checked, own = (
        {task: {method: _checked(f"{task}, {method.label}", given) for method, given in rows.items()}
         for task, rows in part.items()} for part in (curves, yours or {})
    )  # fmt: skip
    checked = {task: checked.get(task, {}) for task in {**checked, **own}}
    look_of = {method: _look(method, look) for method, look in axes.looks(checked, own).items()}
    levels = {task: axes.references(references.get(task, {})) for task in checked}
    size = (WIDTH if len(checked) > 1 else 3.8, 1.75 * len(against) + 0.1)
    figure, grid = plt.subplots(
        len(against), len(checked), figsize=size, squeeze=False, sharey=True if sharey else "col"
    )
    for column, (task, rows) in zip(grid.T, checked.items(), strict=True):
        mine = own.get(task, {})
        shown = {name: part or own.get(name, {}) for name, part in (checked if sharey else {task: rows}).items()}
        column[0].set_ylim(_limits(shown, {name: levels[name] for name in shown}, floored=sharey))
        column[0].set_title(task.capitalize())
        for ax, word in zip(column, against, strict=True):
            for method, level in levels[task].items():
                ax.axhline(level, **axes.reference_look(method), zorder=1)
            drawn, over = ({method: part[method] for method in look_of if word in part.get(method, {})}
                           for part in (rows, mine))  # fmt: skip
            below = [] if sharey else _below(ax, levels[task], [*drawn.values(), *over.values()], word)
            _panel(ax, word, drawn, look_of, WIDTH / len(checked) - 0.3, over, below)
    for row in grid:
        row[0].set_ylabel("executed return (m)")
    every = [row for part in (checked, own) for rows in part.values() for row in rows.values()]
    lowest = {task: column[0].get_ylim()[0] for column, task in zip(grid.T, checked, strict=True)}
    used = dict.fromkeys(method for task, own in levels.items() for method in own if own[method] >= lowest[task])
    models = {method.model: method for method in sorted(look_of, key=lambda method: not method.search_space)}
    handles = [entry(method.look.name, **{**look_of[method], "mfc": method.look.colour, "lw": 1.1})
               for method in models.values()]  # fmt: skip
    spaces = [word for word in SEARCH_SPACES if any(method.search_space == word for method in look_of)]
    handles += [entry(f"{word} policy", color=DARK, marker="o", ms=3.2, mfc="white" if word == "direct" else DARK,
                      lw=0.9 if word == "direct" else 1.3) for word in spaces]  # fmt: skip
    handles += [entry(method.look.name, **axes.reference_look(method)) for method in used]
    if "steps" in against and any({"return_predicted", "steps"} <= row.keys() for row in every):
        handles.append(entry("predicted return", color="#777777", **PREDICTED))
    if any(len(row["return_true"]) > 1 for row in every):
        handles.append(entry("95 % interval", color="#DDDDDD", lw=5, solid_capstyle="butt"))
    handles += axes.yours_entry(*own.values())
    return axes.finish(figure, grid, handles, 5 if len(checked) > 1 else 2)


def _limits(checked: Mapping[str, Mapping[Method, Curves]], levels: References, floored: bool) -> tuple[float, float]:
    """The range of returns of some tasks: of the ends of curves, and below them as far as curves begin, or somewhat
    more than as far again.

    floored: of everything, but what falls far below doing nothing may lie outside.
    """
    means = [axes.band(row["return_true"])[0] for rows in checked.values() for row in rows.values()]
    floors = [level for task in checked for level in levels[task].values()]
    if not floored:
        ends = np.array([*(mean[-1] for mean in means), *(max(own.values()) for own in levels.values() if own)])
        low, high = axes.limits(ends, ends)
        start = min(low, *(mean[0] for mean in means)) - 0.1 * (high - low)
        return max(low - 1.2 * (high - low), start), high + 0.1 * (high - low)
    every = np.concatenate(means)
    low, high = axes.limits(every, every, also=floors)
    return max(low, min(floors) - 0.35 * (high - min(floors))) if floors else low, high


def _below(ax: Axes, levels: Mapping[Method, float], drawn: Sequence[Curves], word: str) -> list[str]:
    """In words, where curves begin that come from below the axis, and the references there."""
    low = ax.get_ylim()[0]
    first = [float(row["return_true"][:, 0].mean()) for row in drawn if word != "samples" or np.ptp(row[word])]
    begin = [axes.spell(value) for value in (min(first, default=low), max((v for v in first if v < low), default=low))]
    words = [f"curves begin at {' to '.join(dict.fromkeys(begin))}"] * any(value < low for value in first)
    words += [f"{method.look.name} {axes.spell(level)}" for method, level in levels.items() if level < low]
    return [", ".join(words)] if words else []


def _panel(
    ax: Axes, word: str, drawn: Mapping[Method, Curves], look_of: Mapping[Method, Props], inches: float,
    over: Mapping[Method, Curves], below: Sequence[str],
) -> None:  # fmt: skip
    """Curves against one quantity, a key of AXES; ``over`` them diamonds. below: what is already said to lie there."""
    far, notes = _scale(ax, word, [row[word] for row in (*drawn.values(), *over.values())]), list(below)
    points = [method for method, row in drawn.items() if word == "samples" and np.ptp(row[word]) == 0]
    for i, (method, row) in enumerate(drawn.items()):
        look, at, (mean, half) = look_of[method], row[word], axes.band(row["return_true"])
        if word == "seconds":
            at, mean, half = (part[at >= 1] for part in (at, mean, half))
        if method in points:
            if method is points[0]:
                ax.axvline(at[-1], color="#CCCCCC", lw=0.6, zorder=1)
                told = f"line: data of the models, {_spelled(at[-1], far)}\nright of it, side by side: their policies"
                note(ax, told, 0.02 if at[-1] > far / 2 else 0.98, 0.02)  # where no curve begins
            at, mean, half = at[-1:] + 0.018 * far * (1 + points.index(method)), mean[-1:], half[-1:]
            ax.plot([at[0], far], [mean[0]] * 2, color=look["color"], lw=0.5, alpha=0.6, zorder=2)
            ax.vlines(at, mean - half, mean + half, color=look["color"], lw=0.7, alpha=0.5, zorder=3)
            ax.plot(at, mean, **{**look, "ls": ""}, zorder=4)
        else:
            axes.curve(ax, at, mean, half, look, shift=i / len(drawn))
        if word == "steps" and "return_predicted" in row:
            ax.plot(at, row["return_predicted"].mean(0), color=look["color"], **PREDICTED, zorder=2.5)
        notes += axes.outside(ax, at[-1:], mean[-1:], method) if below else axes.outside(ax, at, mean, method)
    for method, row in over.items():
        at, mean = row[word], row["return_true"].mean(0)
        some = np.unique(np.linspace(0, len(at) - 1, 6).astype(int))
        if below:  # where curves begin is said
            some = some[mean[some] >= ax.get_ylim()[0]] if (mean[some] >= ax.get_ylim()[0]).any() else some[-1:]
        if word == "samples" and np.ptp(at) == 0:
            some = some[-1:]
        notes += axes.diamonds(ax, "y", at[some], mean[some], method)
    ax.grid(axis="y", color=GRID, lw=0.6)
    free = word == "steps" and any(not method.search_space for method in (*drawn, *over))
    axes.foot(ax, AXES[word] + FREE * free, notes, inches)


def _checked(field: str, given: Mapping[str, np.ndarray]) -> Curves:
    """Curves of one method whose parts fit each other."""
    true = finite(f"{field}, return_true", given["return_true"], "k R")
    shapes = {"return_predicted": f"{true.shape[0]} {true.shape[1]}"} | dict.fromkeys(AXES, f"{true.shape[1]}")
    row = {word: finite(f"{field}, {word}", given[word], shape) for word, shape in shapes.items() if word in given}
    for word in AXES.keys() & row.keys():
        if (np.diff(row[word]) < 0).any():
            raise ValueError(f"{field}: {word} go backwards; records must be in the order of learning")
    return {"return_true": true, **row}


def _look(method: Method, look: Props) -> Props:
    """Filled and thick where the policy acts through the action prior, open where it gives torques itself."""
    direct = method.search_space == "direct"
    return {**look, "ls": "-", "ms": 5 if look["marker"] == "*" else 3.2, "lw": 0.9 if direct else 1.3,
            "mfc": "white" if direct else look["color"]}  # fmt: skip


def _scale(ax: Axes, word: str, at: Sequence[np.ndarray]) -> float:
    """The x axis for everything in ``at``, logarithmic for seconds; where it ends."""
    every = np.concatenate(at) if at else np.ones(1)
    far = float(every.max())
    if word == "seconds" and far > 1:
        near = float(every[every >= 1].min())
        ax.set_xscale("log")
        ax.set_xlim(0.8 * near, 1.15 * far)
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if far < 100 * near else (1.0,)))
        ax.xaxis.set_minor_locator(NullLocator())
    else:
        ax.set_xlim(-0.015 * far, 1.06 * far)
        ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}" if word == "seconds" else
                                               _spelled(value, far)))  # fmt: skip
    return far


def _spelled(steps: float, far: float) -> str:
    """A number of steps on an axis that ends at ``far``: 300k, 1.5M."""
    unit, suffix = (1e6, "M") if far >= 1e6 else (1e3, "k") if far >= 1e4 else (1, "")
    return f"{steps / unit:,g}{suffix if steps else ''}"
