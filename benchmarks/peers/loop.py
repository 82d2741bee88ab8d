"""PETS as mbrl-lib 0.2.0 runs it: its own loop of planning, executing and learning, beside the rounds of 10_explore.

``mbrl.algorithms.pets.train`` with as many random steps before and planned steps after as ``study.worlds`` has at a
scale, from starts and targets drawn alike. What its model then plans is executed from the starts that measure there.
README.md tells how to install it.

    OMP_NUM_THREADS=1 python benchmarks/peers/loop.py --env Pendulum-v1 --seed 0

Rows as those of rounds, model ``pets``, of the last round alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import torch
from reproduction.results import exploration as results
from reproduction.results.exploration import HORIZON, PENDULUM, PUSH
from reproduction.worlds import Sizes
from torch import Tensor

from reproduction import runs, worlds
from tsmlib.envs.stepping import make_simulation
from tsmlib.planning.tasks import Task
from tsmlib.rewards import rewarded
from tsmlib.trajectory import Trajectories

SETTINGS = {  # bound: of the actions, random ones included; every: steps between plans; trained: episodes between fits,
    # those of a round where it is not said
    PENDULUM: {"bound": 1.0, "every": 1, "trained": 1},
    PUSH: {"bound": 0.2, "every": 10},
}
PLANNING = {"smoke": (20, 2, 5, 5), "laptop": (100, 5, 5, 30), "paper": (100, 5, 5, 30)}
# candidates, iterations, particles (a multiple of the 5 members), steps ahead; README.md says what other numbers return
EPOCHS = {"smoke": 1, "laptop": 25, "paper": 25}  # of each training
UNITS_FROM = 20  # random episodes, of which nothing else is learned


class Robot(gymnasium.Env):
    """Episodes of a robot as mbrl-lib takes them, one task after another, ended by a limit of time alone.

    An observation is the state, angles as cosine and sine, in ``unit``: mbrl-lib scales what its networks read, not
    what they predict. Actions are those here, within ``bound``.
    """

    def __init__(self, tasks: Callable[[int], Task], unit: np.ndarray, *, bound: float) -> None:
        self.tasks, self.task, self.unit, self.episode, self.taken = tasks, tasks(0), unit, 0, 0
        self.simulation = make_simulation(self.task.env, 1)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, unit.shape, np.float64)
        self.action_space = gymnasium.spaces.Box(-bound, bound, (self.task.action_dim,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        self.task, self.taken = self.tasks(self.episode), 0
        self.episode += 1
        begin: dict[str, Any] = (
            {"seed": self.task.seeds} if self.task.begins_by_seed else {"states": self.task.start}
        )
        return self._observed(self.simulation.reset(**begin)), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        state = self.simulation.rollout(np.asarray(action, np.float32)[None, None])[:, 0]
        self.taken += 1
        reward = self.task.reward(
            *(torch.as_tensor(part).float()[:, None] for part in (state, action[None]))
        )
        return self._observed(state), float(reward), False, self.taken == HORIZON, {}

    def reward(self, action: Tensor, following: Tensor) -> Tensor:
        """Of predicted observations (B, k), to the target of the episode that runs: (B, 1)."""
        angles = len(self.simulation.angles)
        seen = following * torch.from_numpy(self.unit).to(following)
        states = torch.cat(
            [torch.zeros_like(seen[:, :angles]), seen[:, 2 * angles :]], dim=1
        )  # no reward asks angles
        return rewarded(
            self.task.reward, states.float()[:, None, None], action.float()[:, None, None]
        )[:, 0]

    def _observed(self, states: np.ndarray) -> np.ndarray:
        return features(states, self.simulation.angles)[0] / self.unit


def features(states: np.ndarray, angles: tuple[int, ...]) -> np.ndarray:
    """Cosines and sines of the angles, which are the first dimensions, and the rest of states (..., dx)."""
    turned, rest = states[..., : len(angles)], states[..., len(angles) :]
    return np.concatenate([np.cos(turned), np.sin(turned), rest], axis=-1, dtype=np.float64)


def unit_of(data: Trajectories) -> np.ndarray:
    """Standard deviation of the increments of what is observed (k,); 1 of what never changes."""
    steps = np.diff(features(data.states, data.angles), axis=1).std((0, 1))
    return np.where(steps > 0, steps, 1.0)


def settings(env: str, scale: str, sizes: Sizes, *, seed: int) -> Any:
    """mbrl-lib's configuration: its pets.yaml, gaussian_mlp.yaml, mbpo_pusher.yaml, with PLANNING and SETTINGS."""
    from omegaconf import OmegaConf

    candidates, iterations, particles, ahead = PLANNING[scale]
    here, planned = SETTINGS[env], sizes.rounds * sizes.episodes * HORIZON
    return OmegaConf.create(
        {
            "seed": seed,
            "device": "cpu",
            "debug_mode": False,
            "dynamics_model": {
                "_target_": "mbrl.models.GaussianMLP",
                "_recursive_": False,
                "device": "cpu",
                "num_layers": 4,
                "in_size": None,
                "out_size": None,
                "ensemble_size": 5,
                "hid_size": 200,
                "deterministic": False,
                "propagation_method": "fixed_model",
                "activation_fn_cfg": {"_target_": "torch.nn.SiLU"},
            },
            "algorithm": {
                "dataset_size": sizes.first * HORIZON + planned + HORIZON,
                "normalize": True,
                "normalize_double_precision": True,
                "target_is_delta": True,
                "learned_rewards": False,
                "initial_exploration_steps": sizes.first * HORIZON,
                "num_particles": particles,
                "freq_train_model": here.get("trained", sizes.episodes) * HORIZON,
                "agent": {
                    "_target_": "mbrl.planning.TrajectoryOptimizerAgent",
                    "_recursive_": False,
                    "action_lb": "???",
                    "action_ub": "???",
                    "planning_horizon": ahead,
                    "replan_freq": here["every"],
                    "verbose": False,
                    "optimizer_cfg": {
                        "_target_": "mbrl.planning.CEMOptimizer",
                        "num_iterations": iterations,
                        "elite_ratio": 0.1,
                        "population_size": candidates,
                        "alpha": 0.1,
                        "lower_bound": "???",
                        "upper_bound": "???",
                        "return_mean_elites": True,
                        "device": "cpu",
                        "clipped_normal": False,
                    },
                },
            },
            "overrides": {  # it trains at the beginning of an episode: one more is played, of which nothing is learned
                "num_steps": planned + 1,
                "trial_length": HORIZON,
                "num_elites": 5,
                "model_lr": 1e-3,
                "model_wd": 5e-5,
                "model_batch_size": 256,
                "validation_ratio": 0,
                "patience": 25,
                "num_epochs_train_model": EPOCHS[scale],
            },
        }
    )


def loop(env: str, scale: str, sizes: Sizes, *, seed: int) -> dict[str, float]:
    """Random episodes, rounds, and what plans from the starts that measure then return."""
    from mbrl.algorithms import pets

    from tsmlib.contrib.mbrl_lib import never

    here = worlds.world(env)
    unit = unit_of(here.random(UNITS_FROM, 700_000 + seed))
    drawn = here.drawn(sizes.first + sizes.rounds * sizes.episodes + 1, 100_000 * (seed + 1))
    bound, cfg = SETTINGS[env]["bound"], settings(env, scale, sizes, seed=seed)
    robot = Robot(lambda i: drawn.take([i]), unit, bound=bound)
    torch.manual_seed(seed)
    robot.action_space.seed(seed)
    with TemporaryDirectory() as folder:
        pets.train(robot, never, robot.reward, cfg, silent=True, work_dir=folder)
        return measured(here.tested(sizes.starts), cfg, Path(folder), unit, bound=bound)


def measured(
    task: Task, cfg: Any, folder: Path, unit: np.ndarray, *, bound: float
) -> dict[str, float]:
    """Means over the starts of a task, planned by the model in ``folder`` as the loop planned."""
    import mbrl.models
    import mbrl.planning
    from mbrl.util.common import create_one_dim_tr_model

    from tsmlib.contrib.mbrl_lib import never

    robot = Robot(lambda i: task.take([i]), unit, bound=bound)
    model = create_one_dim_tr_model(cfg, unit.shape, robot.action_space.shape, model_dir=folder)
    generator = torch.Generator().manual_seed(cfg.seed)
    simulated = mbrl.models.ModelEnv(robot, model, never, robot.reward, generator=generator)
    agent = mbrl.planning.create_trajectory_optim_agent_for_model(
        simulated, cfg.algorithm.agent, num_particles=cfg.algorithm.num_particles
    )
    actions = np.zeros((len(task), HORIZON, task.action_dim), np.float32)
    for episode in range(len(task)):
        seen, _ = robot.reset()
        agent.reset()
        for step in range(HORIZON):
            actions[episode, step] = agent.act(seen)
            seen, *_ = robot.step(actions[episode, step])
    return executed(task, torch.from_numpy(actions))


def executed(task: Task, actions: Tensor) -> dict[str, float]:
    """What the same actions return in the simulation in which all plans are executed."""
    from tsmlib.planning.execution import execute

    trial = execute(task, actions)
    assert trial.success is not None
    found = {
        "return_true": float(trial.executed_return.mean()),
        "success": float(trial.success.float().mean()),
    }
    return found | (
        {} if task.position is None else {"final_distance": float(trial.final_distance.mean())}
    )


def parser() -> argparse.ArgumentParser:
    """The command's options."""
    found = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    found.add_argument("--env", choices=SETTINGS, default=PENDULUM, help=f"default {PENDULUM}")
    found.add_argument("--scale", choices=PLANNING, default="paper", help="default paper")
    found.add_argument("--seed", type=int, default=0, help="default 0")
    found.add_argument(
        "--out", type=Path, help="table to write (default: metrics/peers_loop-ENV.csv of the run)"
    )
    return found


def main(given: list[str] | None = None) -> None:
    """The command."""
    arguments = parser().parse_args(given)
    run = runs.resolve("10_explore", scale=arguments.scale, seed=arguments.seed)
    env, sizes = arguments.env, worlds.world(arguments.env).sizes[run.scale]
    torch.set_num_threads(1)
    try:
        import mbrl.algorithms.pets  # noqa: F401
    except ImportError as error:
        raise SystemExit(
            f"mbrl-lib cannot be imported ({error}); benchmarks/peers/README.md tells how"
        ) from error
    planned = sizes.rounds * sizes.episodes * HORIZON
    record = {
        "round": sizes.rounds,
        "env_steps": planned,
        **loop(env, run.scale, sizes, seed=run.seed),
    }
    rows = results.round_rows(
        run, "pets", [record], sizes.starts, first=sizes.first * HORIZON, env=env, space="direct"
    )
    path = arguments.out or run.metrics / f"peers_loop-{env.rpartition('/')[2]}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows).to_csv(path, index=False)
    print(f"{env}, seed {run.seed}: {record}\n{path}")


if __name__ == "__main__":
    main()
