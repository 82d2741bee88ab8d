"""From the id of an environment to a controller: collect, fit, plan, collect where plans lead.

    repeat: fit the model to all data; run episodes in closed loop through it; append them

A thin loop over ``collect_random``, ``fit`` and ``cem``. The planner is given the reward as a
function, which agents without a model of it have to learn.
"""

from __future__ import annotations

import time
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F
from tqdm.auto import tqdm

from tsmlib.checks import require_count, require_number, require_seed, require_type
from tsmlib.collection import collect_random
from tsmlib.envs.ids import find_spec
from tsmlib.envs.spaces import said
from tsmlib.envs.stepping import make
from tsmlib.exploration.rounds import RoundFiles
from tsmlib.films import film
from tsmlib.models.base import Model
from tsmlib.models.baselines import OneStep
from tsmlib.planning.execution import Trial, execute
from tsmlib.planning.planners import cem
from tsmlib.planning.predictors import model_predictor
from tsmlib.planning.search_spaces import DirectActions
from tsmlib.planning.tasks import Task
from tsmlib.plots import save_video
from tsmlib.rewards import Reward, fingerprint, reward_of, rewarded
from tsmlib.storage.files import Json, PathLike, encode_nonfinite, writer_lock
from tsmlib.training.fit import TrainingOptions, fit
from tsmlib.trajectory import Segment, Trajectories

BLIND = 1e12  # deviation in which a model sees a goal, so that it sees zero


@dataclass(frozen=True)
class SolveOptions:
    """Settings of ``solve``, the same for every environment.

    Args:
        episodes: of a round, run side by side.
        ahead: seconds that a plan looks ahead. What pays later than that is not planned for.
        every: seconds after which it is planned again.
        candidates: of each plan (``cem``).
        iterations: of each plan.
        rms: of the actions that are searched and of the first, random ones, of full action.
        hidden: size of the model's hidden layers.
        first: updates of the model before the first plan.
        updates: in each round after it.
    """

    episodes: int = 5
    ahead: float = 1.2
    every: float = 0.1
    candidates: int = 64
    iterations: int = 3
    rms: float = 0.6
    hidden: int = 128
    first: int = 600
    updates: int = 300

    def __post_init__(self) -> None:
        least = {"episodes": 2, "candidates": 8, "iterations": 1, "hidden": 1, "first": 1}
        for name, low in (least | {"updates": 1}).items():
            require_count(name, getattr(self, name), least=low)
        for name in ("ahead", "every", "rms"):
            require_number(name, getattr(self, name), 0, above=True)
        if self.every >= self.ahead:
            raise ValueError(f"every is {self.every} s; expected less than ahead, {self.ahead} s")


@dataclass
class Controller:
    """Plan through a model every few steps of one run of episodes, from the plan before.

    Attributes:
        model: what plans are made through.
        reward: of each step, of its state and action alone.
        space: of the steps that are looked ahead.
        every: steps that a plan is followed.
        options: of the planner.
        seed: of the candidates of the next plan.
    """

    model: Model
    reward: Reward
    space: DirectActions
    every: int
    options: SolveOptions
    seed: int = 0
    left: Tensor | None = None  # (1, B, T, du), of the plan before

    def __call__(self, past: Segment) -> Tensor:
        """The next actions (B, every, du) after ``past`` (B, L, .)."""
        plan = cem(
            model_predictor(self.model, past),
            self.reward,
            self.space,
            len(past.states) if self.left is None else self.left,
            candidates=self.options.candidates,
            elites=max(2, self.options.candidates // 8),
            iterations=self.options.iterations,
            seed=self.seed,
        )
        self.seed += 1
        self.left = F.pad(plan.parameters[:, self.every :], (0, 0, 0, self.every))[None]
        return plan.actions[:, : self.every]


@dataclass(repr=False)
class Solved:
    """What ``solve`` leaves.

    Attributes:
        env: id of the environment.
        model: fitted to all data.
        data: all episodes.
        reward: that plans are made by.
        horizon: steps of an episode.
        options: settings.
        goal: dimensions of the state that the environment calls its ``goal``, which no physics
            reads: the model is blind to them.
        records: the learning curve, one per round: ``round``, ``env_steps`` until its end,
            ``return`` and its ``spread``, mean and deviation over the episodes by the
            environment's own reward, where it keeps one, ``planned_return`` by the reward of the
            planner, and ``cpu_seconds`` from the beginning, training included.
    """

    env: str
    model: OneStep
    data: Trajectories
    reward: Reward
    horizon: int
    options: SolveOptions
    goal: tuple[int, ...] = ()
    records: list[dict[str, float]] = field(default_factory=list)

    def __repr__(self) -> str:
        last = self.records[-1]
        return (
            f"Solved({self.env!r}, return {last['return']:.4g} after {last['env_steps']:.0f} "
            f"steps, {last['cpu_seconds'] / 60:.1f} core minutes)"
        )

    def controller(self, *, seed: int = 0) -> Controller:
        """Make the controller of one run of episodes, as ``collect`` and ``execute`` take it.

        Args:
            seed: of the candidates of its plans.

        Returns:
            A controller that plans anew every ``options.every`` seconds.
        """
        o, dt = self.options, self.data.dt
        every = max(1, round(o.every / dt))
        ahead = max(every + 1, round(o.ahead / dt))
        space = DirectActions(ahead, self.data.robot.action_dim, rms=o.rms)
        return Controller(self.model, self.reward, space, every, o, seed)

    def task(self, episodes: int = 1, *, seed: int = 500) -> Task:
        """Make the task of episodes that begin by the environment's resets.

        Args:
            episodes: B, their number.
            seed: of the first reset; later episodes take the seeds after it.

        Returns:
            The task, of ``horizon`` steps.
        """
        return Task.from_env(
            self.env, n=episodes, horizon=self.horizon, reward=self.reward, seed=seed
        )

    def play(self, episodes: int = 1, *, seed: int = 500) -> Trial:
        """Run episodes in closed loop.

        Args:
            episodes: B, their number.
            seed: of the first reset and of the plans; later episodes take the seeds after it.

        Returns:
            The trial, whose ``own_return`` is by the environment's own reward.
        """
        return execute(self.task(episodes, seed=seed), self.controller(seed=seed), past_len=1)

    def film(self, path: PathLike | None = None, *, seed: int = 500) -> np.ndarray:
        """Film one episode in closed loop.

        Args:
            path: of a file to write, .mp4, .webp, .gif or .png, in real time; None for none.
            seed: of the reset and of the plans.

        Returns:
            Frames (T, H, W, 3) uint8.
        """
        frames = film(self.task(seed=seed), self.play(seed=seed), 0)
        if path is not None:
            save_video(frames, Path(path), fps=max(1, round(1 / self.data.dt)))
        return frames


def solve(
    env: str,
    steps: int = 50_000,
    *,
    reward: Reward | None = None,
    horizon: int | None = None,
    seed: int = 0,
    options: SolveOptions | None = None,
    folder: PathLike | None = None,
    progress: bool = True,
) -> Solved:
    """Learn to control an environment, from random actions to plans through a learned model.

    Args:
        env: id of the environment.
        steps: of the environment, at most, the random ones included; where one ``step`` stands for
            several, as in DMControl with an ``action_repeat``, each of these counts.
        reward: of states (..., B, T, dx) and actions (..., B, T, du), one number per step, a
            function of the step alone; None for the one that the environment offers to plan by.
        horizon: steps of an episode; None for the environment's limit.
        seed: of everything.
        options: settings; None for the same defaults everywhere.
        folder: of its own, from which a run that was stopped goes on; more ``steps`` continue it.
        progress: whether to show a bar with the last return.

    Returns:
        Model, data, learning curve and controller.

    Raises:
        ValueError: the environment offers no reward, or has no limit of time; fewer steps than two
            rounds take; or a reward that is the same at every step of two rounds.
        StoreError: ``folder`` is of another run, or in use.
    """
    o = SolveOptions() if options is None else options
    require_type("options", o, SolveOptions, "tsmlib.SolveOptions(...)")
    steps, seed = require_count("steps", steps), require_seed("seed", seed)
    limit = find_spec(env).max_episode_steps
    if horizon is None and limit is None:
        raise ValueError(f"{env} has no limit of time; give the steps of an episode, horizon=200")
    horizon = require_count("horizon", limit if horizon is None else horizon)
    aim = reward_of(env, guided=True) if reward is None else reward
    with closing(make(env)) as made:
        repeat, goal = said(made, "action_repeat") or 1, said(made, "goal") or ()
    if steps < 2 * (per_round := o.episodes * horizon * repeat):
        raise ValueError(f"steps is {steps}; expected at least two rounds of {per_round}")
    data = collect_random(env, o.episodes, horizon=horizon, seed=_draw(seed, 0), rms=o.rms)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = OneStep.for_data(data, hidden=o.hidden)
    solved = Solved(data.env, model, data, aim, horizon, o, goal)
    start = torch.from_numpy(data.flat_states[data.offsets])
    identity: dict[str, Json] = {
        "settings": asdict(o),
        "seed": seed,
        "env": data.env,
        "horizon": horizon,
        "reward of chance": list(fingerprint(aim, start, horizon, data.robot.action_dim)),
    }
    spent, taken, k = 0.0, repeat * int(data.steps.sum()), 0
    with ExitStack() as stack:
        if folder is not None:
            stack.enter_context(writer_lock(Path(folder), f"solve, seed {seed}"))
        bar = stack.enter_context(tqdm(total=steps, desc=env, disable=not progress))
        while k == 0 or taken + per_round <= steps:
            files = None
            if folder is not None:
                part = Path(folder) / f"round-{k:03d}"
                files = RoundFiles(part, encode_nonfinite(identity))
            record = {"round": float(k)}
            if k:
                new, own = _episodes(solved, k, seed, files)
                solved.data = solved.data.joined(new)
                _require_graded(solved)
                taken += repeat * int(new.steps.sum())
                record |= own | {"env_steps": float(taken)}
            record = _fitted(solved, k, seed, record, files)
            spent += record["cpu_seconds"]
            if k:
                solved.records.append(record | {"cpu_seconds": spent})
                bar.set_postfix({"return": f"{record['return']:.4g}"}, refresh=False)
            bar.update(taken - bar.n)
            k += 1
    return solved


def _draw(seed: int, k: int) -> int:
    """A seed of round k, from which its resets count up; those from 500 on are of no round."""
    return (seed * 1_000_003 + 1000 * k) % 2**31


def _require_graded(solved: Solved) -> None:
    """ValueError where all steps so far earn the same, so that plans are made of nothing."""
    states, actions = solved.data.padded(solved.horizon)
    after = torch.from_numpy(states[:, 1:])
    earned = rewarded(solved.reward, after, torch.from_numpy(actions))
    if float(earned.max() - earned.min()) == 0:
        raise ValueError(
            f"the reward of {solved.env} is {float(earned[0, 0]):g} at each of {earned.numel()} "
            f"steps; a plan that looks {solved.options.ahead:g} s ahead sees nothing to choose by, "
            "and no value bridges more. Give a reward that grades the way, reward=function, or "
            "look farther ahead, SolveOptions(ahead=...)"
        )


def _episodes(
    solved: Solved, k: int, seed: int, files: RoundFiles | None
) -> tuple[Trajectories, dict[str, float]]:
    """The episodes of round k, and what is said of them."""
    stored = files and files.episodes()
    if stored and stored[0] is not None:
        return stored[0], stored[1]
    began = time.process_time()
    trial = solved.play(solved.options.episodes, seed=_draw(seed, k))
    own = cast(Tensor, trial.own_return)  # of execute, as seen, there always
    own = torch.where(own.isnan(), trial.executed_return, own)
    record = {"return": float(own.mean()), "spread": float(own.std())}
    record["planned_return"] = float(trial.executed_return.mean())
    record["cpu_seconds"] = time.process_time() - began
    seen = cast(Trajectories, trial.seen)
    if files:
        files.keep_episodes(seen, record)
    return seen, record


def _fitted(
    solved: Solved, k: int, seed: int, record: dict[str, float], files: RoundFiles | None
) -> dict[str, float]:
    """The record of round k, the model now fitted to all data, or loaded."""
    if files and (stored := files.models(solved.model, None)) is not None:
        return stored
    began, o = time.process_time(), solved.options
    train, held_out = solved.data.split(0.9, seed=seed)
    features = solved.model.features.fit(train)
    for d in solved.goal:  # few episodes hold few goals, from which a network learns nonsense
        features.std[2 * len(features.angles) + features.others.index(d)] = BLIND
    schedule = TrainingOptions(
        future_len=min(20, *solved.data.lengths),
        steps=o.updates if k else o.first,
        batch_size=128,
        lr=2e-3,
        muon=0.01,
        validate_every=100,
    )
    fit(
        solved.model,
        train,
        held_out,
        schedule,
        solved.model.multi_step_loss,
        seed=seed + k,
        checkpoint=None if files is None else files.folder / "model.checkpoint",
        progress=False,
    )
    spent = time.process_time() - began
    record = record | {"cpu_seconds": record.get("cpu_seconds", 0.0) + spent}
    if files:
        files.keep_models(solved.model, None, record)
    return record
