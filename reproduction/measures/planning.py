"""Where a plan begins, how soon it is good, and torques that nobody planned."""

import torch
from torch import Tensor

from tsmlib.checks import MOST, require_count, require_seed
from tsmlib.collection import smooth_torques
from tsmlib.planning.base import Predictor, SearchSpace
from tsmlib.planning.search import Search, best_of
from tsmlib.planning.tasks import Task
from tsmlib.rewards import Reward
from tsmlib.sampling import generator_of

RANDOM_TORQUES = 1  # first part of the key of their random numbers, which no data are drawn from


@torch.no_grad()
def sampled_starts(
    predict: Predictor,
    reward: Reward,
    space: SearchSpace,
    n_targets: int,
    *,
    candidates: int = 256,
    keep: int = 4,
    seed: int = 0,
) -> Tensor:
    """The best of random candidates, to begin ``adam`` at.

    Where nothing is pushed before contact there is no gradient either, so a start must touch.

    Args:
        predict: of actions (C, B, T, du) the states (S, C, B, T, dx).
        reward: of states and actions, one number per step.
        space: what is searched, and what draws the candidates.
        n_targets: B.
        candidates: drawn for each target.
        keep: how many of them are kept.
        seed: of the candidates, 0 or above.

    Returns:
        (keep, B, *shape), the best first.
    """
    candidates = require_count("candidates", candidates, most=MOST)
    if require_count("keep", keep, most=MOST) > candidates:
        raise ValueError(f"keep is {keep}; expected at most the {candidates} candidates")
    search = Search(predict, reward, space, require_count("n_targets", n_targets, most=MOST))
    generator = torch.Generator().manual_seed(require_seed("seed", seed))
    parameters = space.scale * space.noise(candidates, n_targets, generator)
    returns = search.returns_of(parameters)
    return best_of(parameters, returns.where(torch.isfinite(returns), -torch.inf), keep)


def iterations_to(curve: Tensor, share: float = 0.95) -> Tensor:
    """Iterations after which a planner has gained most of all that it gains (claim C15).

    Args:
        curve: (iterations + 1, B), of a plan; it begins with its first finite value.
        share: of the gain.

    Returns:
        (B,); 0 for a curve that gains nothing.
    """
    first = curve.gather(0, curve.isfinite().int().argmax(0, keepdim=True))[0]
    return (curve >= first + share * (curve[-1] - first)).int().argmax(0)


def random_torques(task: Task, *, seed: int = 0) -> Tensor:
    """Torques like the arm's training data's.

    Args:
        task: of an arm.
        seed: of the torques.

    Returns:
        (B, T, du).
    """
    generator = generator_of(RANDOM_TORQUES, seed)
    return smooth_torques(len(task), task.horizon, generator=generator, action_dim=task.action_dim)
