"""Errors to the clean state behind noisy sensors, of models and of filters (section 5.3.3).

Errors count in the units in which the noise does, data scaled to [-1, 1]
(``envs.geometry.HALF_RANGE``), so that the raw observation's error is the noise's sigma. Angles are
compared on the circle.

Against a model stands an extended Kalman filter that is told more than any model here: clean states
to fit its dynamics on, the arm's kinematics, and the noise; and an exponential filter. Both are
tuned on validation episodes.

Letters in shapes: N episodes, T steps, K steps predicted, dx = 6 state size of the plain arm, du
action size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from tsmlib.envs.geometry import HALF_RANGE, LINK_LENGTHS, fingertip
from tsmlib.envs.spec import EnvSpec
from tsmlib.evaluation.prediction import cut, sample_states
from tsmlib.models.base import DynamicsModel
from tsmlib.trajectory import Trajectories

STARTS = range(10, 100, 10)  # of the segments that are predicted from the noisy past
PARTS = {"angles": slice(0, 2), "velocities": slice(2, 4), "fingertip": slice(4, 6)}


def errors(predicted: np.ndarray, clean: np.ndarray) -> np.ndarray:
    """Differences (..., dx) of two states (..., dx) in units of data scaled to [-1, 1], angles on
    the circle.
    """
    difference = np.array(predicted, np.float64) - clean
    difference[..., :2] = (difference[..., :2] + np.pi) % (2 * np.pi) - np.pi
    return difference / HALF_RANGE[: difference.shape[-1]]


def rmse(difference: np.ndarray) -> float:
    """Root mean square of all errors."""
    return float(np.sqrt(np.square(difference).mean()))


def model_errors(
    model: DynamicsModel,
    noisy: Trajectories,
    clean: Trajectories,
    *,
    samples: int = 32,
    progress: str = "",
) -> np.ndarray:
    """Errors (N, K, dx) of a model's mean to the clean states, over K = 10 steps after noisy pasts
    (``STARTS``).

    clean: the same episodes without noise. ValueError where their torques differ.
    """
    _require_same(noisy, clean)
    mean = sample_states(
        model, noisy, samples=samples, horizon=10, starts=STARTS, progress=progress
    ).mean(0)
    return errors(mean.numpy(), _segments(clean.states[:, 1:]))


def filter_errors(
    estimate: KalmanFilter, noisy: Trajectories, clean: Trajectories
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the filter at ``STARTS``: of the present state (N, dx), and of the K = 10 predicted
    ones (N, K, dx).
    """
    _require_same(noisy, clean)
    means = estimate.means(noisy)
    now = np.stack([means[:, start] for start in STARTS], 1).reshape(-1, 4)
    truth = np.stack([clean.states[:, start] for start in STARTS], 1).reshape(len(now), -1)
    actions, ahead = _segments(noisy.actions), []
    x = now
    for step in range(10):
        x = estimate.predicted(x, actions[:, step])
        ahead.append(estimate.with_tip(x))
    return errors(estimate.with_tip(now), truth), errors(
        np.stack(ahead, 1), _segments(clean.states[:, 1:])
    )


def exponential_errors(keep: float, noisy: Trajectories, clean: Trajectories) -> np.ndarray:
    """Errors (N, dx) of m_t = keep m_{t-1} + (1 - keep) x_t, the exponential filter, to the present
    at ``STARTS``.
    """
    _require_same(noisy, clean)
    mean, found = noisy.states[:, 0].astype(np.float64), []
    for step in range(max(STARTS) + 1):
        mean = keep * mean + (1 - keep) * noisy.states[:, step]
        if step in STARTS:
            found.append(errors(mean, clean.states[:, step]))
    return np.concatenate(found)


def tuned_exponential(noisy: Trajectories, clean: Trajectories) -> float:
    """The best ``keep`` of eleven for validation episodes."""
    return min(
        np.linspace(0, 0.9, 11), key=lambda keep: rmse(exponential_errors(keep, noisy, clean))
    )


@dataclass(frozen=True)
class KalmanFilter:
    """Extended Kalman filter of angles and velocities s (4,) of the plain arm, behind noisy
    sensors.

    s' = A [s, u, 1] + N(0, Q), fitted by least squares on clean states; it observes s and the
    fingertip, whose position follows from the angles. weight: what Q is multiplied with. sigma: the
    sensors' noise. lengths: links.
    """

    transition: np.ndarray  # (7, 4)
    process: np.ndarray  # (4, 4)
    sigma: float
    weight: float = 1.0
    lengths: tuple[float, float] = LINK_LENGTHS

    @classmethod
    def fitted(cls, clean: Trajectories, sigma: float) -> KalmanFilter:
        """The filter whose dynamics are fitted to clean episodes."""
        before = clean.states[:, :-1, :4].reshape(-1, 4)
        inputs = np.concatenate(
            [before, clean.actions.reshape(len(before), -1), np.ones((len(before), 1))],
            1,
            dtype=np.float64,
        )
        after = clean.states[:, 1:, :4].reshape(-1, 4).astype(np.float64)
        transition = np.linalg.lstsq(inputs, after, rcond=None)[0]
        return cls(
            transition,
            np.cov((after - inputs @ transition).T),
            sigma,
            lengths=EnvSpec.parse(clean.env).physics.link_lengths,
        )

    def tuned(self, noisy: Trajectories, clean: Trajectories) -> KalmanFilter:
        """The filter with the weight of its process noise that is best on validation episodes."""
        tried = [replace(self, weight=weight) for weight in (0.1, 0.3, 1.0, 3.0, 10.0)]
        return min(tried, key=lambda one: rmse(filter_errors(one, noisy, clean)[0]))

    def predicted(self, x: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The mean (N, 4) one step after x (N, 4) under actions (N, du)."""
        return np.concatenate([x, actions, np.ones((len(x), 1))], 1) @ self.transition

    def means(self, noisy: Trajectories) -> np.ndarray:
        """Estimates (N, T + 1, 4) of each present state, given all observations until then."""
        noise = np.diag(np.square(self.sigma * np.array(HALF_RANGE[:6])))
        x, covariance = (
            noisy.states[:, 0, :4].astype(np.float64),
            np.tile(noise[:4, :4], (len(noisy), 1, 1)),
        )
        found = [x]
        a = self.transition[:4].T
        for step in range(noisy.horizon):
            x = self.predicted(x, noisy.actions[:, step])
            covariance = a @ covariance @ a.T + self.weight * self.process
            # (N, 6, 4)
            h = np.concatenate([np.tile(np.eye(4), (len(x), 1, 1)), self._tip_jacobian(x)], 1)
            seen = noisy.states[:, step + 1] - self.with_tip(x)
            gain = covariance @ h.mT @ np.linalg.inv(h @ covariance @ h.mT + noise)
            x = x + (gain @ seen[..., None])[..., 0]
            covariance = covariance - gain @ h @ covariance
            found.append(x)
        return np.stack(found, 1)

    def with_tip(self, x: np.ndarray) -> np.ndarray:
        """Angles and velocities (..., 4) and the fingertip (..., 6) that they imply."""
        return np.concatenate([x, fingertip(x[..., :2], self.lengths)], -1)

    def _tip_jacobian(self, x: np.ndarray) -> np.ndarray:
        """Derivative of the fingertip by angles and velocities: (N, 4) -> (N, 2, 4)."""
        both = x[:, 0] + x[:, 1]
        second = self.lengths[1] * np.stack([-np.sin(both), np.cos(both)], 1)
        first = self.lengths[0] * np.stack([-np.sin(x[:, 0]), np.cos(x[:, 0])], 1)
        return np.stack([first + second, second, 0 * second, 0 * second], 2)


def _segments(steps: np.ndarray) -> np.ndarray:
    """(N, T, ...) -> the K = 10 steps after each of ``STARTS``, as of ``sample_states``."""
    return cut(torch.from_numpy(np.ascontiguousarray(steps)), STARTS, 10).numpy()


def _require_same(noisy: Trajectories, clean: Trajectories) -> None:
    noisy.require_equal_lengths("a comparison of filters")
    if not np.array_equal(noisy.actions, clean.actions):
        raise ValueError(
            f"the episodes of {noisy.env} and of {clean.env} hold other torques; draw both "
            "from one seed, so that they "
            "are the same episodes with and without noise"
        )
