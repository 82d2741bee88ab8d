"""Tables of the pages, filled into the places that are marked: ``<!-- table: plans -->``."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pandas as pd

from reproduction.claims.judge import PLACES
from reproduction.tables import published, select
from tsmlib import zoo
from tsmlib.statistics import interval

ARMS = {"Reacher": "reaching", "ReacherObstacle": "obstacle", "ReacherPush": "pushing"}
TASKS = {"ReacherPush": "pushing, within 5 cm", "Reacher": "reaching, within 3 cm"}
MARK = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.S)


def predictions(table: pd.DataFrame) -> str:
    """Scores over 90 steps, open loop: mean and half the 95 % interval over seeds."""
    found = select(table, execution="open loop", subset=None, steps_ahead=None)
    lines = []
    for arm, title in ARMS.items():
        own = select(found, env=PLACES[arm])
        for word in (word for word in zoo.words() if word in set(own["model"])):
            score, error, inside = (
                select(own, model=word, metric=metric)["value"]
                for metric in ("energy_score_noise", "nrmse", "coverage80")
            )
            line = {"arm": title, "model": zoo.look(word).name, "energy score": _spelled(score, 3)}
            line |= {"nRMSE": f"{error.mean():.3f}", "80 % coverage": f"{inside.mean():.0%}"}
            lines.append(line | {"seeds": str(len(score))})
    return _markdown(lines)


def plans(table: pd.DataFrame) -> str:
    """Plans over codes by the cross-entropy method, executed open loop; and both floors."""
    found = select(table, execution="open loop", subset=None, iteration=None)
    lines = []
    for arm, title in TASKS.items():
        own = select(found, env=PLACES[arm])
        ways = {word: {"model": word, "planner": "cem"} for word in (*zoo.words(), "oracle")}
        ways |= {"zero": {"model": "none", "planner": "zero"}}
        for word, way in ways.items():
            space = None if word == "zero" else "latent"
            rows = select(own, search_space=space, **way)
            if rows.empty:
                continue
            costs = -select(rows, metric="return_true")["value"]
            gap = select(rows, metric="exploitation_gap")["value"]
            success = select(rows, metric="success")["value"]
            line = {"task": title, "model": zoo.look(word).name, "cost (m)": _spelled(costs, 2)}
            line["gap (m)"] = f"{gap.mean():+.2f}" if len(gap) else ""
            lines.append(line | {"reached": f"{success.mean():.0%}", "seeds": str(len(costs))})
    return _markdown(lines)


PUBLISHED = {  # environment steps 100 k / 500 k, of tdmpc2's results: TD-MPC2, DreamerV3, SAC
    "reacher-easy": ("937 / 919", "872 / 940", "540 / 918"),
    "reacher-hard": ("414 / 914", "813 / 867", "161 / 517"),
    "cartpole-swingup": ("839 / 876", "677 / 789", "835 / 835"),
    "pendulum-swingup": ("724 / 842", "699 / 740", "96 / 408"),
    "cup-catch": ("981 / 985", "870 / 958", "958 / 978"),
}


def control(table: pd.DataFrame) -> str:
    """Returns of ``solve`` after 10, 25 and 50 thousand steps, beside published agents."""
    lines = []
    for task, agents in PUBLISHED.items():
        line = {"task": task}
        for steps in (10_000, 25_000, 50_000):
            rows = select(table, task=task, env_steps=steps)
            values = select(rows, metric="return")["value"]
            word = f"{_spelled(values, 0)} ({len(values)})" if len(values) else "not run"
            line[f"{steps // 1000} k"] = word
        minutes = select(table, task=task, env_steps=25_000, metric="core_minutes")["value"]
        line["core min., 25 k"] = f"{minutes.mean():.1f}" if len(minutes) else ""
        names = ("TD-MPC2", "DreamerV3", "SAC")
        lines.append(line | dict(zip(names, agents, strict=True)))
    return _markdown(lines)


TABLES: dict[str, tuple[Callable[[pd.DataFrame], str], str]] = {  # and the rows they are made of
    "predictions": (predictions, "03_predict"),
    "plans": (plans, "05_control"),
    "control": (control, "dmc"),
}


def fill(page: Path) -> Path:
    """Fill every marked place of a page with its table.

    Args:
        page: a Markdown file.

    Returns:
        The page.

    Raises:
        ValueError: a place that is marked for a table that there is not.
    """

    def filled(place: re.Match[str]) -> str:
        if place[2] not in TABLES:
            raise ValueError(
                f"{page} has a place for table {place[2]!r}; there are {', '.join(TABLES)}"
            )
        make, rows = TABLES[place[2]]
        return f"{place[1]}{make(published(rows))}\n{place[3]}"

    text = MARK.sub(filled, page.read_text(encoding="utf-8"))
    page.write_text(text, encoding="utf-8")
    return page


def _markdown(lines: list[dict[str, str]]) -> str:
    """Lines as a table; what a column repeats from the line above stays empty in the first."""
    table = pd.DataFrame(lines)
    first = table.columns[0]
    table[first] = table[first].where(table[first] != table[first].shift(), "")
    return table.to_markdown(index=False, disable_numparse=True)


def _spelled(values: pd.Series, digits: int) -> str:
    mean, half = interval(values.to_numpy())
    return f"{mean:.{digits}f} ± {half:.{digits}f}" if half else f"{mean:.{digits}f}"
