"""Symmetries of the pushing arm: quarter turns about the shoulder, and mirror images along x.

The walls are a square around the shoulder, the shoulder turns freely and the elbow's limits are
even, so the physics commute with all eight: episodes of random torques, whose first poses lie in
every direction, stay what they are.
"""

import numpy as np

from tsmlib.envs.spec import EnvSpec
from tsmlib.trajectory import Trajectories

COPIES = 8


def copies(env_id: str) -> int:
    """Symmetric copies of the training data: 8 of pushing, 1 of the others, whose first poses lie
    along x.
    """
    return COPIES if EnvSpec.parse(env_id).task == "push" else 1


def turned(states: np.ndarray, quarters: int) -> np.ndarray:
    """States (..., 10) as seen after ``quarters`` quarter turns of everything about the shoulder;
    torques stay.
    """
    cosine, sine = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarters % 4]
    found = states.copy()
    found[..., 0] += quarters * np.pi / 2
    for x in (4, 6, 8):  # fingertip, block's position, block's velocity
        found[..., x] = cosine * states[..., x] - sine * states[..., x + 1]
        found[..., x + 1] = sine * states[..., x] + cosine * states[..., x + 1]
    return found


def mirrored(states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States (..., 10) and torques (..., 2) with y negated: joint angles, their velocities and
    torques change sign.
    """
    signs = np.array([-1, -1, -1, -1, 1, -1, 1, -1, 1, -1], states.dtype)
    return states * signs, -actions


def symmetric(data: Trajectories) -> Trajectories:
    """Episodes with all their symmetric copies (``copies``), the episodes themselves first."""
    if copies(data.env) == 1:
        return data
    states, actions = data.flat_states, data.flat_actions
    both = ((states, actions), mirrored(states, actions))
    return Trajectories.from_rows(
        np.concatenate([turned(x, quarters) for quarters in range(4) for x, _ in both]),
        np.concatenate([u for _ in range(4) for _, u in both]),
        data.lengths * COPIES,
        data.robot,
        data.terminated * COPIES,
        jumps=data.jumps,
    )
