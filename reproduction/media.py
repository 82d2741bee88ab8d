"""What a notebook shows: figures, tables, and films and strips of executed plans."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd
import torch
from gymnasium.spaces import Box
from IPython.display import Image, Markdown, display
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from tsmlib import plots as figures, rewards
from tsmlib.envs import drawing
from tsmlib.envs.geometry import DT
from tsmlib.envs.render import draw_scene, render_array
from tsmlib.envs.stepping import make, within_bounds
from tsmlib.evaluation import latent
from tsmlib.evaluation.futures import Coded
from tsmlib.plots.method import Method
from tsmlib.planning.execution import Trial
from tsmlib.planning.tasks import Task
from reproduction.results import table
from reproduction.runs import FIGURES, Run
from tsmlib.trajectory import Trajectories, Window

if TYPE_CHECKING:
    from ipywidgets import VBox


def show(
    run: Run, figure: Figure, stem: str, rows: pd.DataFrame | None = None, *, n: int | None = None
) -> None:
    """Save a figure as ``stem`` among the run's and display it.

    It is stamped with where its numbers are from: rows, what it draws (``study.evidence``); or n, of how many episodes
    or targets of this run.
    """
    if rows is not None:
        figures.stamp(figure, table.stamp(rows, figure=True))
    elif n is not None:
        stamp_run(run, figure, n)
    figures.save(figure, run.figures / stem)
    display(figure)


def show_published(stem: str) -> None:
    """Display a figure of the published rows; nothing where there are none, as in an installation."""
    path = FIGURES / f"{stem}.png"
    if path.exists():
        display(Image(filename=path))


def stamp_run(run: Run, figure: Figure, n: int) -> None:
    """Stamp a figure with a run, and of how many of its episodes or targets it is."""
    figures.stamp(figure, f"{'' if run.scale == 'paper' else 'yours: '}{of_run(run)}, n = {n:,}")


def of_run(run: Run) -> str:
    """Scale and seed of a run, for a stamp."""
    return f"scale {run.scale}, seed {run.seed}"


def show_table(
    found: pd.DataFrame | str,
    title: str = "",
    form: str = "{:.3g}",
    rows: pd.DataFrame | None = None,
) -> None:
    """Display a table, or one that is Markdown already, below its title; nothing of an empty one.

    form: of floats. rows: what it is made of (``study.evidence``), for a line below that says where they are from.
    """
    stamp = "" if rows is None or not len(rows) else f"*{table.stamp(rows)}*"
    if len(found) and isinstance(found, pd.DataFrame):
        found = found if found.index.names == [None] else found.reset_index()
        floats = found.select_dtypes("float")
        found = table.markdown(
            found.assign(
                **{str(name): floats[name].map(form.format, na_action="ignore") for name in floats}
            )
        )
    if len(found):
        display(Markdown("\n\n".join(part for part in (title, found, stamp) if part)))
