"""Learning curves on PushT: rounds of own play, random play, and SAC, on the first frozen pairs.

    python benchmarks/pusht_rounds.py                  # models: this environment
    python benchmarks/pusht_rounds.py --methods sac    # model_free/requirements.txt

Protocol C, states, no demonstrations. All begin episodes at states of random play and aim at what
it came to 25 steps later; this play is not counted. SAC sees and acts in the frame of the T, as
``Egocentric`` does; its reward is the environment's, minus the distance that plans are judged by.
Rows that are there already are not made again; ``figures/pusht_rounds.png`` is drawn from them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import gymnasium
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from torch import Tensor

import tsmlib
from reproduction import pusht
from tsmlib.envs.pusht import PushTEnv
from tsmlib.envs.pusht_field import ENV_ID, in_field, pusht_physics
from tsmlib.exploration.options import ExplorationOptions
from tsmlib.models.baselines import OneStep
from tsmlib.models.egocentric import Egocentric
from tsmlib.planning.pusht import PROTOCOLS, pusht_task, random_play
from tsmlib.plots.style import BLUE, NOTE, ORANGE, RED, styled
from tsmlib.pretrained import load_pusht
from tsmlib.trajectory import Segment

ROOT = Path(__file__).resolve().parents[1]
BUDGETS = (5_000, 20_000, 50_000)  # steps of the environment
MARKS = (2_500, 5_000, 10_000, 15_000, 20_000, 30_000, 40_000, 50_000, 75_000, 100_000)  # of SAC
STAGES: tuple[pusht.Stage, ...] = (  # of the training on the first play, and of a round's
    (1, 1024, 700, (0.0, 0.35)),
    (4, 384, 500, (0.35, 0.65)),
    (10, 192, 300, (0.65, 1.0)),
)
FURTHER: pusht.Stage = (10, 192, 600, (0.0, 1.0))
SEARCH = {"candidates": 64, "elites": 8, "iterations": 3}
PAIRS, LONG, EPISODE = 200, 100, 50  # measured on; steps of an episode of random play, of own play
LINES = {  # method -> colour, name at its line
    "own play": (BLUE, "Egocentric, own play"),
    "random play": (ORANGE, "Egocentric, random play"),
    "one-step, own play": (RED, "one-step model, own play"),
    "sac": (NOTE, "SAC"),
}


def pairs(n: int, seed: int, protocol: str = "C", env: str = ENV_ID) -> tsmlib.Task:
    """Starts and goals as the frozen ones are, of other play, in any field."""
    starts, goals, physics = [], [], pusht_physics(env)
    while sum(map(len, starts)) < n:
        played = random_play(100, horizon=EPISODE, seed=seed, symmetries=False, env=env).cut(
            EPISODE
        )
        start, goal = (
            played.states[:, :-25:5].reshape(-1, 7),
            played.states[:, 25::5].reshape(-1, 7),
        )
        apart = np.linalg.norm(goal[:, 2:4] - start[:, 2:4], axis=1) >= 10
        still = torch.from_numpy(start)[:, None].expand(-1, 3, -1)
        solved = PROTOCOLS[protocol][0](still, torch.from_numpy(goal)).numpy()
        kept = apart & ~solved & in_field(goal, physics)
        starts, goals, seed = [*starts, start[kept]], [*goals, goal[kept]], seed + 1
    order = np.random.default_rng(seed).permutation(sum(map(len, starts)))[:n]
    return pusht_task(
        np.concatenate(starts)[order], np.concatenate(goals)[order], protocol, env=env
    )


def line(
    task: tsmlib.Task, trial: tsmlib.Trial, method: str, seed: int, env_steps: int, began: float
) -> pusht.Row:
    """One row of the table."""
    seconds = round(time.process_time() - began, 1)
    more: pusht.Row = {"seconds": seconds, "env_steps": env_steps}
    return pusht.row(task, trial, method, "C", seed) | more


def rounds(method: str, seed: int, add: Callable[[pusht.Row], None]) -> None:
    """A model on 5,000 steps of random play, then on three rounds of its own or of more."""
    began, task = time.process_time(), load_pusht("test", "C").take(PAIRS)
    play = partial(random_play, horizon=LONG, symmetries=False)
    first = play(BUDGETS[0] // LONG, seed=10_000 * seed + 1)
    held_out = play(20, seed=10_000 * seed + 2)
    if method.startswith("one-step"):
        model: Egocentric | OneStep = OneStep.for_data(first, seed=seed)
    else:
        model = Egocentric.for_data(first, seed=seed, hidden=128)
    for stage in STAGES:
        tsmlib.fit(
            model, mirrored(first), held_out, pusht.options(stage), seed=seed, progress=False
        )

    def measure(model: tsmlib.DynamicsModel, prior: object = None) -> dict[str, float]:
        trial = pusht.trial(model, task, "C", seed=seed, **SEARCH)
        done.append(BUDGETS[len(done)])
        add(line(task, trial, method, seed, done[-1], began))
        return {}

    done: list[int] = []
    measure(model)
    counts = {k: (BUDGETS[k] - BUDGETS[k - 1]) for k in range(1, len(BUDGETS))}
    further = pusht.options(FURTHER)
    options = ExplorationOptions(model=further, rounds=len(counts), every=5, **SEARCH)
    random = method == "random play"
    tsmlib.explore(
        model,
        None,
        first,
        held_out,
        lambda k: pairs(counts[k] // EPISODE, 10_000 * seed + 100 * k),
        options,
        seed=seed,
        measure=measure,
        augmented=mirrored,
        episodes=(lambda k: play(counts[k] // LONG, seed=10_000 * seed + 10 * k))
        if random
        else None,
    )


def mirrored(data: tsmlib.Trajectories) -> tsmlib.Trajectories:
    """Episodes with their quarter turns and mirror images."""
    copies = tsmlib.envs.pusht_field.symmetric_copies(data.flat_states, data.flat_actions)
    states, actions = (np.concatenate(part) for part in zip(*copies, strict=True))
    lengths = data.lengths * len(copies)
    return tsmlib.Trajectories.from_rows(states, actions, lengths, data.robot)


def seen(states: Tensor, goal: Tensor) -> Tensor:
    """States (..., 7) and goals as a policy sees them, from the T: (..., 12)."""
    cosine, sine = states[..., 4].cos(), states[..., 4].sin()
    parts = (
        states[..., :2] - states[..., 2:4],
        goal[..., 2:4] - states[..., 2:4],
        states[..., 5:],
    )
    turned = [turn(part / 100, cosine, -sine) for part in parts]
    angle = goal[..., 4] - states[..., 4]
    more = [cosine, sine, angle.cos(), angle.sin()]
    place = (states[..., 2:4] - 256) / 256
    return torch.cat([*turned, place, torch.stack(more, -1)], -1)


def turn(vector: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Vectors (..., 2) turned."""
    x, y = vector.unbind(-1)
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y], -1)


class FromTheT(gymnasium.Env):
    """PushT with pairs of random play, seen and acted upon from the T; an episode is 50 steps."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (12,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, task: tsmlib.Task, seed: int) -> None:
        self.task, self.env, self.rng = task, PushTEnv(), np.random.default_rng(seed)

    def _seen(self) -> np.ndarray:
        return seen(self.state, self.goal).numpy()

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        i = int(self.rng.integers(len(self.task)))
        self.goal, self.taken = self.task.target[i], 0
        given = {"states": self.task.start[i], "goal": self.goal.numpy()}
        self.state = torch.from_numpy(self.env.reset(options=given)[0]).float()
        return self._seen(), {}

    def step(self, action: np.ndarray) -> tuple:
        angle = self.state[4]
        action = turn(torch.from_numpy(action), angle.cos(), angle.sin())
        state, reward, *_ = self.env.step(action.numpy())
        self.state, self.taken = torch.from_numpy(state).float(), self.taken + 1
        return self._seen(), reward, False, self.taken == EPISODE, {}


def sac(seed: int, steps: int, add: Callable[[pusht.Row], None]) -> None:
    """Soft actor-critic, one update a step."""
    from stable_baselines3 import SAC

    began = time.process_time()
    env = FromTheT(pairs(2000, 10_000 * seed + 5), seed)
    model = SAC("MlpPolicy", env, seed=seed, device="cpu", learning_starts=1000, gamma=0.98)
    task = load_pusht("test", "C").take(PAIRS)

    def control(past: Segment) -> Tensor:
        state = past.states[:, -1]
        action, _ = model.predict(seen(state, task.target).numpy(), deterministic=True)
        angle = state[:, 4]
        return turn(torch.from_numpy(action), angle.cos(), angle.sin()).clamp(-1, 1)[:, None]

    for mark in MARKS:
        if mark <= steps:
            model.learn(mark - model.num_timesteps, reset_num_timesteps=False)
            trial = tsmlib.execute(task, control, past_len=1)
            add(line(task, trial, "sac", seed, mark, began))


@styled
def figure(rows: pd.DataFrame) -> Figure:
    """Share of goals solved against steps of the environment, a label at each line."""
    drawn, ax = plt.subplots(figsize=(6, 3.2), layout="constrained")
    for method, (colour, name) in LINES.items():
        own = rows[rows.method == method].sort_values("env_steps")
        if len(own):
            x, y = own.env_steps / 1000, 100 * own.success
            ax.fill_between(x, 100 * own.low, 100 * own.high, color=colour, alpha=0.15, lw=0)
            ax.plot(x, y, color=colour, marker="o", ms=3)
            ax.annotate(
                name,
                (x.iloc[-1], y.iloc[-1]),
                (5, 0),
                color=colour,
                va="center",
                textcoords="offset points",
                annotation_clip=False,
            )
    ax.set(xlabel="1,000 steps of the environment", ylabel="goals solved (%)", ylim=(0, 100))
    ax.set(xlim=(0, None))
    return drawn


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--methods", nargs="*", default=[m for m in LINES if m != "sac"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sac-steps", type=int, default=100_000)
    parser.add_argument("--out", type=Path, default=ROOT / "data/results/11_pusht_rounds.csv")
    parser.add_argument("--figure", type=Path, default=ROOT / "figures/pusht_rounds.png")
    given = parser.parse_args()
    torch.set_num_threads(1)
    for method in given.methods:
        table = pusht.Table(given.out)
        if not table.has(method, "C", given.seed):
            run = partial(sac, given.seed, given.sac_steps) if method == "sac" else None
            (run or partial(rounds, method, given.seed))(table.add)
    tsmlib.plots.save(figure(pd.read_csv(given.out)), given.figure)


if __name__ == "__main__":
    main()
