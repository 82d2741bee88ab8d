"""Collection of trajectories: any controller, in many episodes at once.

Random data, a running planner and a policy under test are the same call with another controller.
"""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from warnings import warn

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor

from tsmlib.checks import as_tensor, require_count, require_number, require_seed
from tsmlib.envs.stepping import Arms, Seeds, Simulation, make_simulation, simulation
from tsmlib.trajectory import Segment, Trajectories, initial_past

Controller = Callable[[Segment], Tensor]  # the past (N, L, .) -> the next K actions (N, K, du)


def collect(
    env: VectorEnv | Simulation,
    controller: Controller,
    *,
    horizon: int = 100,  # section 5.1
    past_len: int = 10,
    seed: Seeds = None,
    states: np.ndarray | None = None,
) -> Trajectories:
    """Run one episode in each of an environment's N copies.

    Args:
        env: ``gymnasium.make_vec(id, num_envs=N)`` of any environment whose observations are Boxes,
            or Dicts and Tuples of them, and whose actions are a Box with bounds. Asynchronous
            copies pay where a step takes longer than about a millisecond.
        controller: gives the next actions in [-1, 1], which stand for the bounds of the action
            space; asked again when they are executed. ``open_loop`` makes one of given actions.
        horizon: steps, unless the environment ends an episode before.
        past_len: steps of past that the controller sees.
        seed: episode i begins by the reset of ``seed + i``; or one seed for each. An arm's start
            is a function of ``seed`` and i.
        states: (N, dx), where the episodes of an arm begin.

    Returns:
        The episodes, in float32.

    Raises:
        UnsupportedEnvironment: an environment that cannot be collected from; says what it takes.
        SimulationUnstable: a state is not finite.
    """
    horizon = require_count("horizon", horizon)
    if isinstance(controller, OpenLoop) and controller.actions.shape[1] < horizon:
        steps = controller.actions.shape[1]
        raise ValueError(
            f"the actions are of {steps} steps; expected those of an episode of {horizon}. Give as "
            f"many, or horizon={steps}"
        )
    run: Simulation = simulation(env) if isinstance(env, VectorEnv) else env
    if not hasattr(run, "rollout"):
        raise TypeError(f"env is {env!s:.80}; expected gymnasium.make_vec(id, num_envs=N)")
    start = run.reset(seed=seed, states=states)
    past = initial_past(torch.from_numpy(start).float(), past_len, run.action_dim)
    seen, done, taken = [start[:, None]], [], 0
    while taken < horizon and not run.ended.all():
        given = as_tensor("actions", controller(past), (len(start), "T", run.action_dim))
        actions = given.detach().cpu().clamp(-1, 1)[:, : horizon - taken]
        if actions.shape[1] < 1:
            raise ValueError(f"the controller gave no actions at step {taken} of {horizon}")
        reached = run.rollout(actions.numpy())
        past = past.then(Segment(torch.from_numpy(reached).float(), actions)).last(past_len)
        seen.append(reached)
        done.append(actions.numpy())
        taken += actions.shape[1]
    exact = np.concatenate(seen, axis=1)
    most, spread = np.abs(exact).max((0, 1)), exact.std((0, 1))
    kept = np.spacing(most.astype(np.float32))
    # Variation below 1e-10 of a value is what arithmetic leaves.
    lost = (kept > 0.01 * spread) & (spread > 1e-10 * most) & (not isinstance(run, Arms))
    for d in np.flatnonzero(lost)[:1]:
        warn(
            f"{run.names[d]} of {run.id} is about {most[d]:g} and varies by {spread[d]:.3g}, where "
            f"float32 tells no less than {kept[d]:.3g} apart; take off an offset first: "
            "gymnasium.wrappers.TransformObservation",
            stacklevel=2,
        )
    return Trajectories(
        exact.astype(np.float32),
        np.concatenate(done, axis=1),
        run.id,
        run.dt,
        run.names,
        run.units,
        run.angles,
        lengths=run.steps.tolist(),
        terminated=run.terminated.tolist(),
        jumps=isinstance(run, Arms),
    )


def collect_random(
    env_id: str,
    episodes: int,
    *,
    horizon: int = 100,
    seed: int = 0,
    rms: float = 0.5,
    time_constant: float | None = None,
) -> Trajectories:
    """Collect episodes of smooth random actions, a function of the arguments alone.

    Args:
        env_id: of the environment, with its arguments: ``"Pendulum-v1(g=1.0)"``.
        episodes: how many.
        horizon: steps, unless the environment ends an episode before.
        seed: of the actions and starts. Episode i of any robot but the arms begins by the reset of
            ``seed + i``, so neighbouring seeds share starts: give ``Task.from_env``, which begins
            at 1000 by default, a seed beyond these where there are more.
        rms: of the actions, full action being 1.
        time_constant: s, see ``smooth_torques``; one and a half steps by default.

    Returns:
        The episodes.

    Raises:
        UnsupportedEnvironment: an environment that cannot be collected from; says what it takes.
    """
    seed = require_seed("seed", seed)
    with closing(make_simulation(env_id, episodes)) as run:
        actions = smooth_torques(
            episodes,
            horizon,
            generator=torch.Generator().manual_seed(seed),
            action_dim=run.action_dim,
            rms=rms,
            time_constant=1.5 * run.dt if time_constant is None else time_constant,
            dt=run.dt,
        )
        return collect(run, open_loop(actions), horizon=horizon, seed=seed)


def smooth_torques(
    n: int,
    horizon: int,
    *,
    generator: torch.Generator,
    action_dim: int = 2,
    rms: float = 0.1,
    time_constant: float = 0.03,
    dt: float = 0.02,
) -> Tensor:
    """Draw smooth random torques (section 5.1): white noise through two poles.

    The filter starts at rest, so the first torques are small.

    Args:
        n: episodes.
        horizon: steps.
        generator: of the noise.
        action_dim: du.
        rms: to which they settle, of full torque, clipped. At 0.1 at most 10 % of steps are at the
            elbow's stop, and most objects are met.
        time_constant: s, of each of the two poles; at 0.03 s power density halves at 3.4 Hz.
        dt: s per step.

    Returns:
        Torques (n, horizon, action_dim) in [-1, 1].
    """
    sizes = {"n": n, "horizon": horizon, "action_dim": action_dim}
    shape = [require_count(name, size) for name, size in sizes.items()]
    require_number("rms", rms, 0)
    require_number("time_constant", time_constant, 0, above=True)
    keep = np.exp(-require_number("dt", dt, 0, above=True) / time_constant)
    noise = torch.randn(shape, generator=generator).numpy()
    once, twice, torques = np.zeros(shape[::2]), np.zeros(shape[::2]), np.empty_like(noise)
    for step in range(horizon):
        once = keep * once + (1 - keep) * noise[:, step]
        twice = keep * twice + (1 - keep) * once
        torques[:, step] = twice
    # Standard deviation of two equal poles.
    settled = (1 - keep) ** 2 * np.sqrt((1 + keep**2) / (1 - keep**2) ** 3)
    return torch.from_numpy((torques * (rms / settled)).clip(-1, 1).astype(np.float32))


@dataclass(frozen=True)
class OpenLoop:
    """The controller that plays ``actions`` (N, T, du), once, from the start of an episode."""

    actions: Tensor

    def __call__(self, past: Segment) -> Tensor:
        return self.actions


def open_loop(actions: Tensor) -> OpenLoop:
    """Make the open-loop controller that plays actions from the start of an episode.

    Args:
        actions: (N, T, du) in [-1, 1].

    Returns:
        The controller, for ``execute`` and ``collect``.
    """
    return OpenLoop(as_tensor("actions", actions, ("N", "T", "du")))
