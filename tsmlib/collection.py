"""Collection of trajectories: any controller, in many episodes at once.

Random data, a running planner and a policy under test are the same call with another controller.
"""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor

from tsmlib.envs.stepping import Seeds, Simulation, make_simulation, simulation
from tsmlib.trajectory import Segment, Trajectories, initial_past

Controller = Callable[
    [Segment], Tensor
]  # the past (N, L, .) -> the next K actions (N, K, du), then asked again


def collect(
    env: VectorEnv | Simulation,
    controller: Controller,
    *,
    horizon: int = 100,  # section 5.1
    past_len: int = 10,
    seed: Seeds = None,
    states: np.ndarray | None = None,
) -> Trajectories:
    """Run one episode in each of ``env``'s N copies for ``horizon`` steps, or until the environment
    ends it.

    env: ``gymnasium.make_vec(id, num_envs=N)`` of any environment with flat Boxes of observations
    and actions. Actions in [-1, 1] are scaled to the bounds of its action space. Episodes start
    from the environment's own distribution, drawn from ``seed`` (a function of it and of i in
    episode i; where copies are reset one by one also a seed for each), or, in an arm's, from
    ``states`` (N, dx). UnsupportedEnvironment, naming what is supported, for anything else.
    """
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}, expected a positive number of steps")
    if isinstance(controller, OpenLoop) and controller.actions.shape[1] < horizon:
        raise ValueError(
            f"the actions are of {controller.actions.shape[1]} steps, those of an episode of "
            f"{horizon} were expected; "
            f"give as many, or horizon={controller.actions.shape[1]}"
        )
    seed = int(seed) if isinstance(seed, np.integer) else seed
    episodes: Simulation = simulation(env) if isinstance(env, VectorEnv) else env
    start = episodes.reset(seed=seed, states=states)
    past = initial_past(torch.from_numpy(start).float(), past_len, episodes.action_dim)
    seen, done, taken = [start[:, None]], [], 0
    while taken < horizon and not episodes.ended.all():
        actions = controller(past).detach().clamp(-1, 1)[:, : horizon - taken]
        if actions.shape[1] < 1:
            raise ValueError(
                f"the controller gave no actions when asked at step {taken} of {horizon}"
            )
        reached = episodes.rollout(actions.numpy())
        past = past.then(Segment(torch.from_numpy(reached).float(), actions)).last(past_len)
        seen.append(reached)
        done.append(actions.numpy())
        taken += actions.shape[1]
    return Trajectories(
        states=np.concatenate(seen, axis=1, dtype=np.float32),
        actions=np.concatenate(done, axis=1, dtype=np.float32),
        env=episodes.id,
        dt=episodes.dt,
        names=episodes.names,
        units=episodes.units,
        angles=episodes.angles,
        lengths=tuple(episodes.steps.tolist()),
        terminated=tuple(episodes.terminated.tolist()),
    )


def collect_random(
    env_id: str,
    episodes: int,
    *,
    horizon: int = 100,
    seed: int = 0,
    rms: float = 0.5,  # of full action
    time_constant: float
    | None = None,  # s, see ``smooth_torques``; one and a half steps, as the arm's
) -> Trajectories:
    """``episodes`` of smooth random actions in the environment of an id, a function of the
    arguments alone.

    Episode i of any robot but the arms begins by the reset of ``seed + i``, so neighbouring seeds
    share starts: give ``Task.from_env``, which begins at 1000 by default, a seed beyond these where
    there are more.
    """
    seed = int(seed)  # of NumPy, say
    with closing(make_simulation(env_id, episodes)) as run:
        actions = smooth_torques(
            episodes,
            horizon,
            generator=torch.Generator().manual_seed(seed),
            action_dim=run.action_dim,
            rms=rms,
            time_constant=time_constant or 1.5 * run.dt,
            dt=run.dt,
        )
        return collect(run, open_loop(actions), horizon=horizon, seed=seed)


def smooth_torques(
    n: int,
    horizon: int,
    *,
    generator: torch.Generator,
    action_dim: int = 2,
    rms: float = 0.1,  # of full torque; at most 10 % of steps at the elbow stop, most objects met (01_collect)
    time_constant: float = 0.03,  # s, of each of the two poles: their power density halves at 3.4 Hz
    dt: float = 0.02,
) -> Tensor:
    """Smooth random torques (section 5.1): white noise through two poles, (n, horizon, action_dim).

    The filter starts at rest, so the first torques are small; they settle to a root mean square of
    ``rms``, clipped.
    """
    if n < 1 or horizon < 1:
        raise ValueError(
            f"n is {n}, horizon is {horizon}, expected a positive number of episodes and of steps"
        )
    keep = np.exp(-dt / time_constant)
    noise = torch.randn(n, horizon, action_dim, generator=generator).numpy()
    once, twice, torques = (
        np.zeros((n, action_dim)),
        np.zeros((n, action_dim)),
        np.empty_like(noise),
    )
    for step in range(horizon):
        once = keep * once + (1 - keep) * noise[:, step]
        twice = keep * twice + (1 - keep) * once
        torques[:, step] = twice
    settled = (1 - keep) ** 2 * np.sqrt(
        (1 + keep**2) / (1 - keep**2) ** 3
    )  # standard deviation of two equal poles
    return torch.from_numpy((torques * (rms / settled)).clip(-1, 1).astype(np.float32))


@dataclass(frozen=True)
class OpenLoop:
    """The controller that plays ``actions`` (N, T, du), once, from the start of an episode."""

    actions: Tensor

    def __call__(self, past: Segment) -> Tensor:
        return self.actions


def open_loop(actions: Tensor) -> OpenLoop:
    """The open-loop controller that plays ``actions`` (N, T, du) from the start of an episode."""
    return OpenLoop(actions)
