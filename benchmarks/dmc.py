"""Learning curves of `tsmlib.solve` on five tasks of DMControl: a table of rows and a figure.

    OMP_NUM_THREADS=1 python benchmarks/dmc.py --seeds 0 1 2 --steps 50000

Runs are kept in runs/dmc and go on where they stopped; more steps continue them. The rows of all
runs there land in data/results/dmc.csv, one per task, seed and round, and figures/dmc.png is drawn;
``--no-run`` does only this. ``--film`` instead writes figures/dmc.webp, six seconds of each task by
the first seed after ``--steps``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd
import torch
from matplotlib.figure import Figure

import tsmlib
from reproduction import tables
from reproduction.pages import fill
from tsmlib.envs import CONTROL_IDS
from tsmlib.plots.style import BLUE, PALE, styled
from tsmlib.storage.files import write_bytes

ROOT = Path(__file__).resolve().parents[1]
RUNS = ROOT / "runs" / "dmc"
TD_MPC2 = (919, 914, 876, 842, 985)  # after 500,000 steps


def task_of(env: str) -> str:
    """``"cup-catch"`` of ``"tsm/dmc-cup-catch-v0"``."""
    return env.removeprefix("tsm/dmc-").removesuffix("-v0")


def run(env: str, steps: int, seed: int) -> None:
    """One run, and its rows in its folder."""
    folder = RUNS / task_of(env) / f"seed{seed}"
    solved = tsmlib.solve(env, steps, seed=seed, folder=folder)
    about: tables.Row = {
        "env": env,
        "sim": "mujoco",
        "task": task_of(env),
        "model": "onestep+multistep",
    }
    about |= {"planner": "cem", "execution": "closed loop", "seed": seed}
    rows = []
    for record in solved.records:
        measured = {"return": record["return"], "core_minutes": record["cpu_seconds"] / 60}
        for metric, value in measured.items():
            own = {"env_steps": int(record["env_steps"]), "n": solved.options.episodes}
            rows.append(about | own | {"metric": metric, "value": round(value, 3)})
    tables.write(folder / "rows.csv", rows)


@styled
def figure(rows: pd.DataFrame) -> Figure:
    """A panel for each task: every seed, and TD-MPC2 after ten times as many steps."""
    drawn, axes = plt.subplots(1, 5, figsize=(9, 2), sharey=True, layout="constrained")
    for ax, env, level in zip(axes, CONTROL_IDS, TD_MPC2, strict=True):
        own = tables.select(rows, env=env, metric="return")
        for _, seed in own.groupby("seed"):
            ax.plot(seed["env_steps"] / 1000, seed["value"], color=BLUE, marker=".")
        ax.axhline(level, color=PALE, linestyle="--")
        most = rows["env_steps"].max() / 1000 + 1
        ax.set(title=task_of(env), xlabel="1,000 steps", xlim=(0, most), ylim=(0, 1000))
    axes[0].set_ylabel("return")
    return drawn


def film(steps: int, seed: int, tasks: list[str]) -> None:
    """Six seconds of each task side by side, in real time."""
    films = {}
    for task in tasks:
        folder = RUNS / task / f"seed{seed}"
        solved = tsmlib.solve(f"tsm/dmc-{task}-v0", steps, seed=seed, folder=folder)
        solved.horizon = round(6 / solved.data.dt)
        films[task] = solved.film()[:: max(1, round(0.08 / solved.data.dt)), ::2, ::2]
    whole = tsmlib.plots.side_by_side(films)
    picture = tsmlib.plots.animation(whole, 12, form="WEBP", width=1200, hold=1.0)
    write_bytes(ROOT / "figures" / "dmc.webp", picture)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=50_000)
    parser.add_argument("--tasks", nargs="+", default=[task_of(env) for env in CONTROL_IDS])
    parser.add_argument("--no-run", action="store_true")
    parser.add_argument("--film", action="store_true")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    if asked.film:
        film(asked.steps, asked.seeds[0], asked.tasks)
        return
    for seed in [] if asked.no_run else asked.seeds:
        for task in asked.tasks:
            run(f"tsm/dmc-{task}-v0", asked.steps, seed)
    if parts := [tables.read(path) for path in sorted(RUNS.glob("*/*/rows.csv"))]:
        rows = pd.concat(parts)
        tables.write(tables.RESULTS / "dmc.csv", rows)
        tsmlib.plots.save(figure(rows), ROOT / "figures" / "dmc.png")
        fill(ROOT / "docs" / "tasks.md")


if __name__ == "__main__":
    main()
