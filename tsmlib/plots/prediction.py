"""Figures of predictions: scores by environment and steps ahead, calibration, differences (figure 5 of the paper).

What lies far outside an axis has an arrow, and its value in words below the panel.

Letters in shapes: k seeds, T steps, L levels.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from tsmlib.plots import axes
from tsmlib.plots.checks import Panels, finite, finite_panels, known, per_panel
from tsmlib.plots.method import Method
from tsmlib.plots.style import (
    DARK,
    DASHED,
    GRID,
    WIDTH,
    Props,
    above,
    entry,
    note,
    panels,
    rows_only,
    styled,
    tint,
)
from tsmlib.statistics import interval

BAND = {"color": "#DDDDDD", "lw": 5, "solid_capstyle": "butt"}


@styled
def figure5(
    values: Mapping[str, Panels],
    ylabel: str | Mapping[str, str] = "log-likelihood (nats per step)",
    yours: Mapping[str, Panels] | None = None,
) -> Figure:
    """Prediction quality by environment (paper, figure 5): mean over seeds, 95 % t interval, each seed a small dot.

    values: title -> environment -> method -> (k,), one value per seed; ylabel: one for all, or title -> text; yours: as
    values, drawn over them as hollow diamonds at their means.
    """
    own = {title: finite_panels(panel, "k") for title, panel in (yours or {}).items()}
    checked = {title: finite_panels(panel, "k") for title, panel in values.items()}
    look_of = axes.looks(*checked.values(), *own.values())
    ylabels = per_panel("ylabel", ylabel, checked)
    slots, group = {method: i for i, method in enumerate(look_of)}, len(look_of) + 1.6
    width = WIDTH if len(checked) > 1 else 0.72 * WIDTH
    figure, grid = panels(len(checked), len(checked), 2.25, width=width, head=0)
    several = False
    for ax, (title, panel) in zip(grid, checked.items(), strict=True):
        mine = own.get(title, {})
        panel = {env: panel.get(env, {}) for env in {**panel, **mine}}
        every = [
            seeds for env, rows in panel.items() for seeds in {**mine.get(env, {}), **rows}.values()
        ]
        several |= any(len(seeds) > 1 for rows in panel.values() for seeds in rows.values())
        ax.set_ylim(axes.limits(np.concatenate(every), axes.ends(every)))
        ax.set_xlim(-1.3, len(panel) * group - 1.3)
        notes = []
        for e, (env, rows) in enumerate(panel.items()):
            for method, seeds in rows.items():
                far = axes.mark(
                    ax, "y", e * group + slots[method], seeds, look_of[method], aside=0.32
                )
                notes += [f"{env}, {method.label} {text}" for text in far]
            for method, seeds in mine.get(env, {}).items():
                place, mean = np.array([e * group + slots[method]]), np.array([seeds.mean()])
                notes += [f"{env}, {text}" for text in axes.diamonds(ax, "y", place, mean, method)]
            if e:
                ax.axvline(e * group - 1.3, color="#CCCCCC", lw=0.6, zorder=1)
        ax.grid(axis="y", color=GRID, lw=0.6)
        ax.set_xticks([e * group + (len(look_of) - 1) / 2 for e in range(len(panel))], list(panel))
        ax.tick_params(axis="x", length=0, labelsize=7)
        ax.set(title=title, ylabel=ylabels[title])
        axes.foot(ax, "", notes, width / len(checked) - 0.5)
    handles = axes.entries(look_of, ls="", ms=4.2)
    if several:
        handles.append(
            entry("95 % interval over seeds", color=DARK, ls="", marker="|", ms=7, mew=1.1)
        )
        handles.append(entry("one seed", color="#777777", ls="", marker="o", ms=1.8, mew=0))
    handles += axes.yours_entry(*own.values())
    return axes.finish(figure, [grid], handles, 5 if len(checked) > 1 else 3)


@styled
def training_time(
    curves: Mapping[str, Mapping[Method, tuple[np.ndarray, np.ndarray]]],
    *,
    ships: float | None = None,
) -> Figure:
    """Measures against the time that training took, one panel each, both axes logarithmic.

    curves: title -> method -> seconds (k,) and values (k,), positive; where a time was trained for more than once, the
    line joins the first of them, such as one seed's, and each other is a small mark. seconds: nominal, of one network,
    of which a model may have several. ships: the budget in seconds by which a network that ships is trained, a dashed
    line.
    """
    figure, grid = panels(len(curves), 4, 1.6)
    look_of = axes.looks(curves)
    for ax, (title, lines) in zip(grid, curves.items(), strict=True):
        every, drawn = list[float](), list[float]()
        for method, (seconds, values) in lines.items():
            seconds = finite(f"seconds of {title}, {method.label}", seconds, "k")
            values = finite(f"values of {title}, {method.label}", values, f"{len(seconds)}")
            times, first = np.unique(seconds, return_index=True)
            others = np.setdiff1d(np.arange(len(seconds)), first)
            small = look_of[method] | {"ms": 2.6, "mew": 0, "ls": "", "alpha": 0.7}
            ax.plot(seconds[others], values[others], **small, zorder=3)
            ax.plot(times, values[first], **look_of[method] | {"ms": 4}, zorder=4)
            every, drawn = [*every, *seconds.tolist()], [*drawn, *values.tolist()]
        axes.log_axis(ax, min(drawn) / 1.15, max(drawn) * 1.15)
        ax.set(title=title, xscale="log", xlim=(min(every) / 1.3, max(every) * 1.3))
        ax.set_xticks(sorted(set(every)), [axes.spell(value) for value in sorted(set(every))])
        ax.minorticks_off()
        if ships is not None:
            ax.axvline(ships, color=DARK, ls=DASHED, lw=0.7, zorder=1)
    for ax in grid[-4:]:
        ax.set_xlabel("nominal training time\nof one network (s)")
    handles = axes.entries(look_of, ms=4)
    if ships is not None:
        handles.append(entry(f"budget that ships, {ships:,.0f} s", color=DARK, ls=DASHED, lw=0.7))
    return axes.finish(figure, [grid], handles, 6)


@styled
def against_horizon(
    curves: Panels,
    ylabel: str | Mapping[str, str],
    *,
    log: Collection[str] = (),
    reference: Mapping[str, float] | None = None,
    columns: int = 3,
    yours: Panels | None = None,
    measured: Sequence[int] = (),
) -> Figure:
    """Scores at every step ahead, one panel each: mean over seeds, and a band for its 95 % t interval.

    curves: title -> method -> (k, T); ylabel: one for all, or title -> text; log: the titles with a logarithmic axis,
    mean and interval being those of the logarithm;
    reference: title -> a value to draw a dashed line at, such as the nominal coverage; yours: as curves, drawn over
    them as hollow diamonds; measured: the steps ahead of which scores are known, for markers to stand only there, each
    line's at every third, so that they part. The axis is that of the medians over seeds: one seed that goes astray does
    not squeeze the others. A band may run out of its panel; of a curve that does, the furthest value stands below.
    """
    reference, own = reference or {}, finite_panels(yours or {}, "k T")
    checked = finite_panels(curves, "k T")
    known("log", log, curves)
    known("reference", reference, curves)
    look_of, ylabels, titles = (
        axes.looks(curves, own),
        per_panel("ylabel", ylabel, curves),
        list(curves),
    )
    columns = min(columns, len(titles))
    width = WIDTH if columns > 2 else 3.5 * columns
    figure, grid = panels(len(titles), columns, 1.55, width=width, head=0.1)
    banded = False
    for i, (title, ax) in enumerate(zip(titles, grid, strict=True)):
        mine, logarithmic = own.get(title, {}), title in log
        every = {**mine, **checked[title]}.values()
        medians, means = (
            np.concatenate([of(rows, 0) for rows in every]) for of in (np.median, np.mean)
        )
        if logarithmic and (least := min(rows.min() for rows in every)) <= 0:
            raise ValueError(f"{title}: {axes.spell(least)} cannot stand on a logarithmic axis")
        _scale(ax, title, medians, means, reference.get(title), logarithmic)
        lines = {
            method: axes.interval_ends(rows, logarithmic) for method, rows in checked[title].items()
        }
        notes = []
        for j, (method, (mean, lowest, highest)) in enumerate(lines.items()):
            steps = np.arange(1, len(mean) + 1)
            marks = [step - 1 for step in list(measured)[j % 3 :: 3] if step <= len(mean)]
            axes.curve(ax, steps, mean, lowest, highest, look_of[method], j / len(lines), marks)
            notes += axes.outside(ax, steps, mean, method)
            banded |= bool((lowest < highest).any())
        for method, rows in mine.items():
            some = np.linspace(0, rows.shape[1] - 1, 5).astype(int)
            notes += axes.diamonds(
                ax, "y", some + 1, axes.interval_ends(rows, logarithmic)[0][some], method
            )
        ax.set_xlim(
            0, max(rows.shape[1] for part in (checked[title], mine) for rows in part.values()) + 1
        )
        ax.set(title=axes.wrapped(title, width / columns - 0.2), ylabel=ylabels[title])
        axes.foot(
            ax, "steps ahead" if i + columns >= len(titles) else "", notes, width / columns - 0.4
        )
    handles = [
        *axes.entries(look_of),
        *([entry("95 % interval over seeds", **BAND)] if banded else []),
    ]
    handles += axes.yours_entry(*own.values())
    down = [grid[i : i + columns] for i in range(0, len(grid), columns)]
    return axes.finish(figure, down, handles, 5 if width == WIDTH else 2)


def _scale(
    ax: axes.Axes, title: str, points: np.ndarray, near: np.ndarray, level: float | None, log: bool
) -> None:
    """The y axis for points of lines, for others where they are near, and a dashed reference."""
    low, high = axes.limits(points, near, [] if level is None else [level], log)
    ax.locator_params(nbins=6)
    if log:
        axes.log_axis(ax, low, high)
    ax.set_ylim(low, high)
    if level is not None:
        ax.axhline(level, color="#777777", ls=DASHED, lw=0.8, zorder=1)


@styled
def calibration(
    levels: np.ndarray, curves: Panels, columns: int = 3, yours: Panels | None = None
) -> Figure:
    """Observed against nominal coverage of a model's central intervals; ideal is the diagonal.

    levels: (L,) nominal coverages in [0, 1]; curves: title -> method -> (L,) observed shares in [0, 1]; yours: as
    curves, drawn over them as hollow diamonds.
    """
    nominal = finite("levels", levels, "L")
    checked, own = (finite_panels(given, str(len(nominal))) for given in (curves, yours or {}))
    look_of = axes.looks(curves, own)
    shares = {
        f"{title}, {method.label}": row
        for part in (checked, own)
        for title, rows in part.items()
        for method, row in rows.items()
    }
    for word, array in {"levels": nominal, **shares}.items():
        if array.min() < 0 or array.max() > 1:
            raise ValueError(
                f"{word}: {array.min():g} to {array.max():g}, expected shares between 0 and 1"
            )
    columns = min(columns, len(curves))
    size = min(2.2, WIDTH / columns)
    figure, grid = panels(
        len(curves),
        columns,
        size,
        width=size * columns + 0.2,
        head=0,
        sharex=True,
        sharey=True,
        layout="compressed",
    )
    for i, (ax, (title, rows)) in enumerate(zip(grid, checked.items(), strict=True)):
        ax.plot((0, 1), (0, 1), color="#999999", lw=0.7, zorder=1)
        for method, row in rows.items():
            ax.plot(
                nominal,
                row,
                **look_of[method],
                zorder=3,
                clip_on=False,
                markevery=max(1, len(nominal) // 8),
            )
        some = np.linspace(0, len(nominal) - 1, 7).astype(int)[1:-1]
        for method, row in own.get(title, {}).items():
            axes.diamonds(ax, "y", nominal[some], row[some], method)
        note(ax, "intervals too wide", 0.03, 0.97)
        note(ax, "too narrow", 0.97, 0.03)
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_ticks((0, 0.25, 0.5, 0.75, 1), ("0", "0.25", "0.5", "0.75", "1"))
        last = i + columns >= len(curves)
        ax.set(
            xlim=(0, 1),
            ylim=(0, 1),
            aspect="equal",
            title=title,
            xlabel="nominal coverage" if last else "",
            ylabel="" if i % columns else "observed coverage",
        )
        ax.tick_params(labelbottom=last)
    handles = [*axes.entries(look_of), *axes.yours_entry(*own.values())]
    return axes.finish(figure, [grid], handles, (1, 3, 5, 5)[min(columns, 4) - 1])


@styled
def differences(
    values: Panels,
    xlabel: str | Mapping[str, str],
    subject: Method,
    *,
    lower_is_better: Collection[str] = (),
    yours: Panels | None = None,
) -> Figure:
    """``subject`` minus each other method, paired by seed, with 95 % t intervals and a line at zero (a forest plot).

    values: title -> the other method -> (k,) differences; xlabel: one for all, or title -> text;
    lower_is_better: the titles in which a negative difference favours ``subject``. A mark is filled and its row tinted
    where the interval excludes zero; it is open where it does not, and for a single seed, which has no interval.
    yours: as values, drawn below them as hollow diamonds at their means. The legend says as much.
    """
    checked, own = finite_panels(values, "k"), finite_panels(yours or {}, "k")
    known("lower_is_better", lower_is_better, values)
    look_of, xlabels, count = (
        axes.looks(values, own),
        per_panel("xlabel", xlabel, values),
        len(values),
    )
    heights = {method: y for y, method in enumerate(look_of)}
    width = WIDTH if count > 1 else 4.5
    figure, grid = panels(
        count, count, 0.21 * len(look_of) + 0.85, width=width, head=0, sharey=True
    )
    for ax, (title, rows) in zip(grid, checked.items(), strict=True):
        mine = own.get(title, {})
        every = [*rows.values()] or [seeds.mean(keepdims=True) for seeds in mine.values()]
        ax.set_xlim(axes.limits(np.concatenate(every), axes.ends(every), also=[0.0]))
        ax.locator_params(axis="x", nbins=5 if count < 4 else 4)
        notes = []
        for method, seeds in rows.items():
            (mean, half), look, y = interval(seeds), look_of[method], heights[method]
            if half and abs(mean) > half:
                ax.axhspan(y - 0.5, y + 0.5, color=tint(method.look.colour, 0.13), lw=0, zorder=0)
            else:
                look = {**look, "mfc": "white"}
            notes += [
                f"{method.label} {text}" for text in axes.mark(ax, "x", y, seeds, look, aside=0.27)
            ]
        for method, seeds in mine.items():
            at, own_mean = (
                np.array([heights[method] - 0.25 * (method in rows)]),
                np.array([seeds.mean()]),
            )
            notes += axes.diamonds(ax, "x", at, own_mean, method)
        ax.axvline(0, color="#555555", lw=0.8, zorder=1)
        words = ("better", "worse") if title in lower_is_better else ("worse", "better")
        above(ax, f"← {words[0]}", 0)
        above(ax, f"{words[1]} →", 1)
        ax.set_title(axes.wrapped(title, (width - 1.6) / count), pad=12)
        rows_only(ax)
        ax.tick_params(axis="y", pad=5)
        axes.foot(ax, xlabels[title], notes, (width - 1.6) / count)
    grid[0].set_yticks(list(heights.values()), [method.label for method in heights], fontsize=7)
    grid[0].annotate(
        f"{subject.label} minus",
        (0, 1),
        (-5, 1),
        xycoords="axes fraction",
        textcoords="offset points",
        fontsize=7,
        ha="right",
        va="bottom",
        weight="bold",
        color=subject.look.colour,
    )
    grid[0].set_ylim(len(look_of) - 0.5, -0.5)
    point: Props = {"color": DARK, "marker": "o", "ms": 4.2, "mew": 0.7}
    several = any(len(seeds) > 1 for rows in checked.values() for seeds in rows.values())
    handles = [entry("mean, 95 % interval without 0", **point, lw=1.1)] if several else []
    handles.append(
        entry(f"{'interval with 0, or ' * several}a single seed", **point, lw=0, mfc="white")
    )
    if several:
        handles.append(entry("one seed", color="#777777", ls="", marker="o", ms=1.8, mew=0))
    return axes.finish(figure, [grid], [*handles, *axes.yours_entry(*own.values())], 5)
