"""Draw the picture at the top of README: ``python docs/hero.py`` writes figures/hero.webp and
figures/hero.png, its last frame.

Two models plan the same push from the same start, each over the codes of the same action prior: the
recurrent segment model and a one-step model. Left: 32 futures of the first plan. Middle: the one
future that the one-step model predicts for its own. Right: what the arm did, either way. Target
and seed were chosen because they are instructive; on most targets the two models differ less.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle

import tsmlib
from tsmlib import plots, zoo
from tsmlib.envs.render import draw_scene
from tsmlib.planning.tasks import Task
from tsmlib.storage.files import write_bytes

ENV, TARGET, SEED = "tsm/ReacherPush-v1", 14, 1
FUTURES = 32
BLOCK, RADIUS = slice(6, 8), 0.03
SEGMENTS, ONE_STEP = (zoo.look(word).colour for word in ("rtsm", "onestep"))
ORANGE = "#A86A00"  # the hue of the one-step model, dark enough for words
FIGURES = Path(__file__).resolve().parents[1] / "figures"


@dataclass(frozen=True)
class Push:
    """A plan: predicted futures (S, T, dx), the mode first, and the execution (T, dx)."""

    futures: np.ndarray
    executed: np.ndarray


def planned(task: Task, word: str, *, seed: int) -> Push:
    """Plan for one target through a shipped model, and execute the plan."""
    model = tsmlib.load_pretrained(word, env=task.env)
    past = task.past(model.past_len)
    space = tsmlib.LatentActions(tsmlib.load_pretrained("prior", env=task.env), task.horizon)
    judge = tsmlib.expected_predictor if model.stochastic else tsmlib.model_predictor
    search = dict(candidates=192, iterations=12, screened=0.25, seed=seed)
    plan = tsmlib.cem(judge(model, past), task.reward, space, 1, **search)
    with torch.no_grad():
        mode = tsmlib.model_predictor(model, past)(plan.actions[None])[:, 0, 0]
        futures = mode
        if model.stochastic:
            sample = tsmlib.model_predictor(model, past, samples=FUTURES, seed=seed + 1)
            futures = torch.cat([mode, sample(plan.actions[None])[:, 0, 0]])
    return Push(futures.numpy(), tsmlib.execute(task, plan).states[0, 1:].numpy())


def frame(task: Task, segments: Push, one_step: Push, step: int) -> np.ndarray:
    """The three panels at one step, (H, W, 3) uint8."""
    target = task.target[0].numpy()
    figure = Figure(figsize=(9.6, 4.16), dpi=100, facecolor="white")
    panels = [figure.add_axes((k / 3 + 0.004, 0.138, 1 / 3 - 0.008, 0.75)) for k in range(3)]
    titles = (f"Segment model: {FUTURES} futures", "One-step model: one future", "What happened")
    for ax, title, hue in zip(panels, titles, (SEGMENTS, ORANGE, "#222222"), strict=True):
        ax.set_title(title, fontsize=12, color=hue, family="DejaVu Sans", weight="bold", pad=6)
    fan = segments.futures[1:, : step + 1, BLOCK]
    only = one_step.futures[0, : step + 1, BLOCK]
    done, failed = (push.executed[: step + 1, BLOCK] for push in (segments, one_step))
    scene(panels[0], segments.futures[0, step], target, [(way, SEGMENTS, 0.1) for way in fan])
    scene(panels[1], one_step.futures[0, step], target, [(only, ONE_STEP, 1.0)])
    scene(panels[2], one_step.executed[step], target, [(failed, ONE_STEP, 1.0)], arm=0.3)
    scene(panels[2], segments.executed[step], target, [(done, SEGMENTS, 1.0)], over=True)
    clock = f"{0.02 * (step + 1):.2f} s"
    near = 1000 * np.linalg.norm(fan[:, -1] - target, axis=-1)
    say(
        figure,
        0,
        0,
        f"{clock}   predicted {near.mean():.0f} \u00b1 {near.std():.0f} mm off",
        SEGMENTS,
    )
    say(figure, 1, 0, f"{clock}   predicted {distance(only, target):.0f} mm off", ORANGE)
    say(figure, 2, 0, f"{clock}   segment model {distance(done, target):.0f} mm off", SEGMENTS)
    say(figure, 2, 1, f"{clock}   one-step model {distance(failed, target):.0f} mm off", ORANGE)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def scene(
    ax: Axes,
    state: np.ndarray,
    target: np.ndarray,
    ways: list[tuple[np.ndarray, str, float]],
    *,
    arm: float = 1.0,
    over: bool = False,
) -> None:
    """The arm, and each way of the object with the object at its end, in a model's hue.

    ways: positions (T, 2), hue and opacity of each. arm: its opacity. over: over another scene.
    """
    before = len(ax.patches)
    draw_scene(ax, state, ENV, None if over else target, alpha=arm, background=not over)
    for patch in ax.patches[before:]:
        if isinstance(patch, Circle) and np.allclose(patch.center, state[BLOCK]):
            patch.set_visible(False)  # the object has the model's hue
    for way, hue, opacity in ways:
        ax.plot(*way.T, color=hue, lw=1.6, alpha=min(1.0, 3.5 * opacity), zorder=3.2)
        ax.add_patch(
            Circle(tuple(way[-1]), RADIUS, fc=hue, ec="white", lw=0.5, alpha=opacity, zorder=3.4)
        )


def distance(way: np.ndarray, target: np.ndarray) -> float:
    """Millimetres from the end of a way (T, 2) to the target."""
    return 1000 * float(np.linalg.norm(way[-1] - target))


def say(figure: Figure, panel: int, line: int, text: str, hue: str) -> None:
    """A line of text below a panel."""
    figure.text(
        panel / 3 + 0.01,
        0.085 - 0.056 * line,
        text,
        color=hue,
        fontsize=11,
        family="DejaVu Sans",
        weight="bold",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw the picture at the top of README.")
    parser.add_argument("--target", type=int, default=TARGET, help="which of the test targets")
    parser.add_argument("--seed", type=int, default=SEED, help="of both searches")
    parser.add_argument("--out", type=Path, default=FIGURES, help="a folder")
    given = parser.parse_args()
    task = tsmlib.load_task(ENV).take([given.target])
    segments, one_step = (planned(task, word, seed=given.seed) for word in ("rtsm", "onestep"))
    film = np.stack([frame(task, segments, one_step, k) for k in range(1, task.horizon, 2)])
    write_bytes(
        given.out / "hero.webp", plots.animation(film, 17, form="WEBP", width=960, hold=2.5)
    )
    write_bytes(given.out / "hero.png", plots.animation(film[-1:], form="PNG", colours=128))


if __name__ == "__main__":
    main()
