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

from tsmlib.plots import axes
from tsmlib.plots.checks import finite, known
from tsmlib.plots.method import SEARCH_SPACES, Method
from tsmlib.plots.style import DARK, DASHED, GRID, WIDTH, Props, entry, styled

Curves = dict[str, np.ndarray]
LearningCurves = Mapping[str, Mapping[Method, Mapping[str, np.ndarray]]]  # task -> method -> Curves
References = Mapping[str, Mapping[Method, float]]  # task -> method -> return
AXES = {
    "steps": "steps in the model",
    "samples": "environment steps, the model's data included",
    "seconds": "seconds, training of the model included",
}
FREE = "; without a model, in the environment"  # more on the first of AXES
PREDICTED: Props = {"ls": DASHED, "lw": 0.6, "alpha": 0.7}
STRIP = "#F4F4F4"


@styled
def figure7(
    curves: LearningCurves,
    references: References | None = None,
    against: Sequence[str] = tuple(AXES),
    yours: LearningCurves | None = None,
) -> Figure:
    """Learning curves of policies (paper, figure 7): a column for each task, a row for each quantity of ``against``.

    curves: task -> method -> {"return_true": (k, R)}, mean undiscounted return over the task's targets in m, of k
    copies of a policy or, without a model, of k training seeds, and of {"steps", "samples", "seconds": (R,)} what is
    known of it, "return_predicted": (k, R) of the model, "seeds": of how many training seeds (1 without): of more than
    one the k are these. steps: in the model that a policy learns in, or else in the
    environment; samples: in the environment, those of the model's data included. A method is drawn in the rows that it
    has numbers for. references: task -> oracle, zero or random torques -> return, drawn as lines.

    A model has one colour and marker; latent policies are filled and thick, direct ones open. Lines are means; against
    steps, dashes show the predicted return. Ends of curves stand once more in a strip beside the axis of steps, with
    bars for their 95 % t intervals over the k. A policy whose samples are a data set that never grows has no curve
    against these: its end and interval stand in a strip, whose one tick says how many they are, as a line on the axis
    does. Seconds are on a logarithmic axis from 1 s. The range of returns is that of the ends and what lies near them;
    where curves begin, and references outside, stand in words below. yours: as curves, drawn over them as hollow
    diamonds.
    """
    return _draw(curves, references or {}, against, yours=yours)


@styled
def figure8(
    curves: LearningCurves,
    references: Mapping[Method, float] | None = None,
    yours: LearningCurves | None = None,
) -> Figure:
    """Learning curves of policies with noise and with delay beside the clean arm (paper, figure 8), one scale for all.

    curves: condition -> method -> {"return_true": (k, R), "steps": (R,)}, steps in the model; references: zero or
    random torques -> return, drawn as lines in every panel. Lines are means, bands their 95 % t intervals over the k,
    which "seeds" says as for ``figure7``. yours: as curves, drawn over them as hollow diamonds.
    """
    every = dict.fromkeys({**curves, **(yours or {})}, references or {})
    return _draw(curves, every, ("steps",), sharey=True, yours=yours)


def _draw(
    curves: LearningCurves,
    references: References,
    against: Sequence[str],
    sharey: bool = False,
    yours: LearningCurves | None = None,
) -> Figure:
    """``figure7``; sharey: one scale of returns for all columns, from doing nothing on, and bands in place of bars."""
    known("against", against, list(AXES))
    known("references", references, [*curves, *(yours or {})])
    checked, own = (
        {
            task: {
                method: _checked(f"{task}, {method.label}", given) for method, given in rows.items()
            }
            for task, rows in part.items()
        }
        for part in (curves, yours or {})
    )
    checked = {task: checked.get(task, {}) for task in {**checked, **own}}
    look_of = {method: _look(method, look) for method, look in axes.looks(checked, own).items()}
    levels = {task: axes.references(references.get(task, {})) for task in checked}
    size = (WIDTH if len(checked) > 1 else 3.8, (1.75 if sharey else 2.25) * len(against) + 0.1)
    figure, grid = plt.subplots(
        len(against), len(checked), figsize=size, squeeze=False, sharey=True if sharey else "col"
    )
    for column, (task, rows) in zip(grid.T, checked.items(), strict=True):
        mine = own.get(task, {})
        shown = {
            name: part or own.get(name, {})
            for name, part in (checked if sharey else {task: rows}).items()
        }
        column[0].set_ylim(_limits(shown, {name: levels[name] for name in shown}, floored=sharey))
        column[0].set_title(task.capitalize())
        for ax, word in zip(column, against, strict=True):
            for method, level in levels[task].items():
                ax.axhline(level, **axes.reference_look(method), zorder=1)
            drawn, over = (
                {method: part[method] for method in look_of if word in part.get(method, {})}
                for part in (rows, mine)
            )
            below = (
                [] if sharey else _below(ax, levels[task], [*drawn.values(), *over.values()], word)
            )
            _panel(
                ax,
                word,
                drawn,
                look_of,
                WIDTH / len(checked) - 0.3,
                over,
                below,
                banded=sharey,
                barred=not sharey and (word != "seconds" or [*against] == ["seconds"]),
            )
    for row in grid:
        row[0].set_ylabel("executed return (m)")
    every = [row for part in (checked, own) for rows in part.values() for row in rows.values()]
    lowest = {task: column[0].get_ylim()[0] for column, task in zip(grid.T, checked, strict=True)}
    used = dict.fromkeys(
        method for task, own in levels.items() for method in own if own[method] >= lowest[task]
    )
    models = {
        method.model: method
        for method in sorted(look_of, key=lambda method: not method.search_space)
    }
    handles = [
        entry(method.look.name, **{**look_of[method], "mfc": method.look.colour, "lw": 1.1})
        for method in models.values()
    ]
    spaces = [
        word for word in SEARCH_SPACES if any(method.search_space == word for method in look_of)
    ]
    handles += [
        entry(
            f"{word} policy",
            color=DARK,
            marker="o",
            ms=3.2,
            mfc="white" if word == "direct" else DARK,
            lw=0.9 if word == "direct" else 1.3,
        )
        for word in spaces
    ]
    handles += [entry(method.look.name, **axes.reference_look(method)) for method in used]
    if "steps" in against and any({"return_predicted", "steps"} <= row.keys() for row in every):
        handles.append(entry("predicted return", color="#777777", **PREDICTED))
    if "samples" in against and any(_fixed(row) for row in every):
        handles.append(
            entry("steps in the models' data", color="#BBBBBB", ls="", marker="|", ms=8, mew=0.8)
        )
    if over_what := _over(checked):
        bar: Props = {"color": DARK, "ls": "", "marker": "|", "ms": 8, "mew": 0.8}
        shade: Props = {"color": "#DDDDDD", "lw": 5, "solid_capstyle": "butt"}
        handles.append(entry(f"95 % interval over {over_what}", **(shade if sharey else bar)))
    handles += axes.yours_entry(*own.values())
    return axes.finish(figure, grid, handles, 5 if len(checked) > 1 else 2)


def _limits(
    checked: Mapping[str, Mapping[Method, Curves]], levels: References, floored: bool
) -> tuple[float, float]:
    """The range of returns of some tasks: of the ends of curves, and below them as far as curves begin, or somewhat
    more than as far again. Ends more than half as far below all references as the best lies above may lie outside.

    floored: of everything, but what falls far below doing nothing may lie outside.
    """
    means = [axes.band(row["return_true"])[0] for rows in checked.values() for row in rows.values()]
    floors = [level for task in checked for level in levels[task].values()]
    if not floored:
        ends = np.array(
            [*(mean[-1] for mean in means), *(max(own.values()) for own in levels.values() if own)]
        )
        if floors:
            ends = ends[ends >= min(floors) - 0.5 * (ends.max() - min(floors))]
        low, high = axes.limits(ends, ends)
        start = min(low, *(mean[0] for mean in means)) - 0.1 * (high - low)
        return max(low - 0.6 * (high - low), start), high + 0.3 * (high - low)
    every = np.concatenate(means)
    low, high = axes.limits(every, every, also=floors)
    return max(low, min(floors) - 0.35 * (high - min(floors))) if floors else low, high


def _below(
    ax: Axes, levels: Mapping[Method, float], drawn: Sequence[Curves], word: str
) -> list[str]:
    """In words, where curves begin that come from below the axis, and the references there."""
    low = ax.get_ylim()[0]
    first = [
        float(row["return_true"][:, 0].mean())
        for row in drawn
        if word != "samples" or np.ptp(row[word])
    ]
    begin = [
        axes.spell(value)
        for value in (min(first, default=low), max((v for v in first if v < low), default=low))
    ]
    words = [f"curves begin at {' to '.join(dict.fromkeys(begin))}"] * any(
        value < low for value in first
    )
    words += [
        f"{method.look.name} {axes.spell(level)}" for method, level in levels.items() if level < low
    ]
    return [", ".join(words)] if words else []


def _fixed(row: Curves) -> bool:
    """Whether a policy was learned from a data set that never grows."""
    return "samples" in row and np.ptp(row["samples"]) == 0


def _over(checked: Mapping[str, Mapping[Method, Curves]]) -> str:
    """What intervals are over, in words: training seeds, copies of a policy in a model of one, or seeds without a
    model."""
    counts: dict[str, set[int]] = {
        "training seeds": set(),
        "copies of a policy": set(),
        "seeds without a model": set(),
    }
    for method, row in ((method, row) for rows in checked.values() for method, row in rows.items()):
        learned = "training seeds" if row["seeds"] > 1 else "copies of a policy"
        counts[learned if method.search_space else "seeds without a model"].add(
            len(row["return_true"])
        )
    some = {word: sorted(found - {1}) for word, found in counts.items()}
    return ", ".join(
        f"{' to '.join(map(str, found))} {word}" for word, found in some.items() if found
    )


def _panel(
    ax: Axes,
    word: str,
    drawn: Mapping[Method, Curves],
    look_of: Mapping[Method, Props],
    inches: float,
    over: Mapping[Method, Curves],
    below: Sequence[str],
    banded: bool,
    barred: bool,
) -> None:
    """Curves against one quantity, a key of AXES; ``over`` them diamonds. below: what is already said to lie there.

    banded: with bands for intervals; barred: with bars for those of the ends, beside the axis where it counts steps.
    """
    rows, notes = [*drawn.values(), *over.values()], list(below)
    far = _scale(ax, word, [row[word] for row in rows])
    fixed = [
        method
        for method in look_of
        if word == "samples" and _fixed(drawn.get(method, over.get(method, {})))
    ]
    beside = (
        [method for method in look_of if method in drawn] if word == "steps" and barred else fixed
    )
    sizes = sorted({float(row[word][0]) for row in rows if word == "samples" and _fixed(row)})
    strip = _strip(ax, far, beside, sizes) if beside else {}
    for i, (method, row) in enumerate(drawn.items()):
        look, at, (mean, half) = look_of[method], row[word], axes.band(row["return_true"])
        if word == "seconds":
            at, mean, half = (part[at >= 1] for part in (at, mean, half))
        ended = (
            0.0
            if word == "seconds"
            else 0.01 * far * (1 + sum(m not in strip for m in [*drawn][:i]))
        )
        place = np.array([strip.get(method, at[-1] + ended)])
        if method not in fixed:
            reach = half if banded else np.zeros(len(at))
            axes.curve(ax, at, mean, mean - reach, mean + reach, look, shift=i / len(drawn))
        if method in strip:
            ax.plot(place, mean[-1:], **{**look, "ls": ""}, zorder=4)
        if barred and half[-1]:
            axes.bars(ax, place, mean[-1:], half[-1:], look["color"])
        if word == "steps" and "return_predicted" in row:
            ax.plot(
                at, row["return_predicted"].mean(0), color=look["color"], **PREDICTED, zorder=2.5
            )
        at = place if method in fixed else at
        far_off = slice(-1, None) if below or method in fixed else slice(None)
        notes += axes.outside(ax, at[far_off], mean[far_off], method)
    for method, row in over.items():
        at, mean = row[word], row["return_true"].mean(0)
        some = np.unique(np.linspace(0, len(at) - 1, 6).astype(int))
        if below:  # where curves begin is said
            some = (
                some[mean[some] >= ax.get_ylim()[0]]
                if (mean[some] >= ax.get_ylim()[0]).any()
                else some[-1:]
            )
        if method in fixed:
            at, some = np.full(len(at), strip[method]), np.array([len(at) - 1])
        notes += axes.diamonds(ax, "y", at[some], mean[some], method)
    ax.grid(axis="y", color=GRID, lw=0.6)
    free = word == "steps" and any(not method.search_space for method in (*drawn, *over))
    axes.foot(ax, AXES[word] + FREE * free, notes, inches)


def _strip(
    ax: Axes, far: float, beside: Sequence[Method], sizes: Sequence[float]
) -> dict[Method, float]:
    """A strip beside a linear axis that ends at ``far``, and where each method stands in it: ends of curves, or of
    policies whose models' data have some ``sizes``, which its one tick says, and lines on the axis."""
    low, start, step = ax.get_xlim()[0], 1.07 * far, 0.035 * far
    end = start + step * (len(beside) + 1)
    ticks = [tick for tick in ax.xaxis.get_major_locator().tick_values(0, far) if 0 <= tick <= far]
    said = " to ".join(dict.fromkeys(_spelled(size, far) for size in (*sizes[:1], *sizes[-1:])))
    label = f"models,\n{said} steps" if sizes else "ends"
    ax.set_xticks([*ticks, (start + end) / 2], [*(_spelled(tick, far) for tick in ticks), label])
    ax.xaxis.get_major_ticks()[-1].tick1line.set_visible(False)
    ax.axvspan(start, end, color=STRIP, lw=0, zorder=0)
    ax.set_xlim(low, end)
    ax.spines["bottom"].set_bounds(low, 1.02 * far)
    for size in sizes:
        ax.axvline(size, color="#BBBBBB", lw=0.8, zorder=1)
    return {method: start + step * (i + 1) for i, method in enumerate(beside)}


def _checked(field: str, given: Mapping[str, np.ndarray]) -> Curves:
    """Curves of one method whose parts fit each other."""
    true = finite(f"{field}, return_true", given["return_true"], "k R")
    shapes = {"return_predicted": f"{true.shape[0]} {true.shape[1]}"} | dict.fromkeys(
        AXES, f"{true.shape[1]}"
    )
    row = {
        word: finite(f"{field}, {word}", given[word], shape)
        for word, shape in shapes.items()
        if word in given
    }
    for word in AXES.keys() & row.keys():
        if (np.diff(row[word]) < 0).any():
            raise ValueError(
                f"{field}: {word} go backwards; records must be in the order of learning"
            )
    return {"return_true": true, "seeds": np.asarray(given.get("seeds", 1)), **row}


def _look(method: Method, look: Props) -> Props:
    """Filled and thick where the policy acts through the action prior, open where it gives torques itself."""
    direct = method.search_space == "direct"
    return {
        **look,
        "ls": "-",
        "ms": 5 if look["marker"] == "*" else 3.2,
        "lw": 0.9 if direct else 1.3,
        "mfc": "white" if direct else look["color"],
    }


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
    ax.xaxis.set_major_formatter(
        FuncFormatter(lambda value, _: f"{value:,g}" if word == "seconds" else _spelled(value, far))
    )
    return far


def _spelled(steps: float, far: float) -> str:
    """A number of steps on an axis that ends at ``far``: 300k, 1.5M."""
    unit, suffix = (1e6, "M") if far >= 1e6 else (1e3, "k") if far >= 1e4 else (1, "")
    return f"{steps / unit:,g}{suffix if steps else ''}"
