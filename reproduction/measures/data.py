"""Statistics of collected data: workspace coverage, autocorrelation of velocities, contacts
(section 5.1).
"""

import numpy as np

from tsmlib.envs.geometry import ELBOW_LIMIT, closest_gap
from tsmlib.envs.spec import EnvSpec

CONTACT_GAP = 0.001  # m between arm and block


def cells_visited(points: np.ndarray, *, inner: float, outer: float, cells: int = 20) -> float:
    """Share of the cells of a grid that ``points`` (..., 2) visit (claim C17).

    The grid covers the square around a disc of radius ``outer`` (m) with ``cells`` cells along each
    side; what counts are those whose centre is in the disc and not in its hole of radius ``inner``.
    """
    edges = np.linspace(-outer, outer, cells + 1)
    x, y = np.asarray(points, np.float64).reshape(-1, 2).T
    visits, _, _ = np.histogram2d(x, y, bins=[edges, edges])
    centres = (edges[:-1] + edges[1:]) / 2
    radius = np.hypot(centres[:, None], centres)
    return float((visits > 0)[(radius >= inner) & (radius <= outer)].mean())


def autocorrelation(series: np.ndarray, lag: int) -> np.ndarray:
    """Correlation of ``series`` (N, T, d) with itself ``lag`` steps later, over all episodes and
    steps: (d,).
    """
    if not 1 <= lag < series.shape[1]:
        raise ValueError(
            f"lag is {lag}, expected 1 to {series.shape[1] - 1}: the episodes have "
            f"{series.shape[1]} steps"
        )
    sides = (
        np.asarray(side, np.float64).reshape(-1, series.shape[2])
        for side in (series[:, :-lag], series[:, lag:])
    )
    before, after = (side - side.mean(0) for side in sides)
    return (before * after).mean(0) / np.sqrt(np.square(before).mean(0) * np.square(after).mean(0))


def shares(states: np.ndarray, env: str) -> dict[str, float]:
    """Shares of ``states`` (N, T + 1, dx): of steps at the elbow's stop, of episodes with contact
    and with a push.
    """
    spec = EnvSpec.parse(env)
    found = {"limit_share": (np.abs(states[:, 1:, 1]) > ELBOW_LIMIT - 0.02).mean()}
    if spec.has_block:
        found["contact_share"] = (closest_gap(states, env).min(1) < CONTACT_GAP).mean()
    if spec.task == "push":
        way = np.linalg.norm(states[..., 6:8] - states[:, :1, 6:8], axis=-1)
        found["moved_share"] = (way.max(1) > 0.005).mean()
    return {metric: float(share) for metric, share in found.items()}
