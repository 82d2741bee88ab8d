"""Figures of the published tables: rows in, matplotlib figures out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from reproduction.claims.judge import PLACES, Comparison, compare
from reproduction.claims.ledger import results
from reproduction.pages import ARMS
from reproduction.scores import HORIZONS
from reproduction.tables import select
from tsmlib import plots

BASELINES = ("onestep", "multistep", "lstm")
OURS = ("tsm", "rtsm")
Tables = Callable[[str], pd.DataFrame]


def figure5(tables: Tables = results) -> Figure:
    """Energy score against the steps ahead, every model on every arm, means over seeds."""
    rows = select(tables("03_predict"), metric="energy_score_noise", execution="open loop")
    panels = {}
    for arm, title in ARMS.items():
        own = select(rows, env=PLACES[arm], subset=None, steps_ahead=list(HORIZONS))
        panels[title] = {
            word: _by_seed(select(own, model=word), "steps_ahead") for word in (*OURS, *BASELINES)
        }
    return plots.curves(
        panels, x=HORIZONS, x_label="steps ahead", y_label="energy score", share="x", log="y"
    )


def ahead(tables: Tables = results) -> Figure:
    """On which share of the targets plans are cheaper: the paper's model, and the recurrent one.

    The interval resamples the targets; half of them is level.
    """
    panels: dict[str, dict[str, np.ndarray]] = {}
    for subject, title in (("tsm", "the paper's model"), ("rtsm", "the recurrent model")):
        for rival in BASELINES:
            one = Comparison(
                "05_control_rows",
                "return_true",
                f"{subject}-latent-cem",
                f"{rival}-latent-cem",
                "ReacherPush",
                "better",
            )
            found = compare(one, tables)
            half = 1.96 * np.sqrt(found.ahead * (1 - found.ahead) / found.units)
            low, high = max(0.0, found.ahead - half), min(1.0, found.ahead + half)
            panels.setdefault(title, {})[rival] = np.array([low, found.ahead, high])
    label = "share of 100 targets on which its plans are cheaper"
    return plots.forest(panels, x_label=label, reference=0.5, better="right", columns=2)


FIGURES: dict[str, Callable[[], Figure]] = {"figure5": figure5, "ahead": ahead}


def _by_seed(rows: pd.DataFrame, column: str) -> np.ndarray:
    """Values (seeds, steps); seeds that lack a step are left out."""
    rows = rows.astype({column: float})
    return rows.pivot_table(index="seed", columns=column, values="value").dropna().to_numpy()
