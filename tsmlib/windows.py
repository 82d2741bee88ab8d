"""Windows: what models read of episodes, in the time convention of ``trajectory``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from tsmlib.checks import require_count
from tsmlib.robot import TrajectoryError
from tsmlib.segments import Episodes, Segment, Window, window_counts


class Windows:
    """The part of ``Trajectories`` that gives single episodes, segments and windows."""

    if TYPE_CHECKING:
        env: str
        lengths: tuple[int, ...]
        flat_states: np.ndarray
        flat_actions: np.ndarray

    def __len__(self) -> int:
        return len(self.lengths)

    @property
    def horizon(self) -> int:
        """Steps of the longest episode, T."""
        return max(self.lengths)

    @property
    def steps(self) -> np.ndarray:
        """Steps of each episode (N,)."""
        return np.array(self.lengths, np.int64)

    @property
    def offsets(self) -> np.ndarray:
        """Row of ``flat_states`` at which each episode begins (N,)."""
        return np.cumsum(self.steps + 1) - self.steps - 1

    def episode(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Take one episode.

        Args:
            i: its number; negative ones count from the end.

        Returns:
            States (T_i + 1, dx), physical units, and actions (T_i, du).

        Raises:
            IndexError: there is no such episode.
        """
        if not isinstance(i, int | np.integer) or not -len(self) <= i < len(self):
            raise IndexError(
                f"there is no episode {i!r:.80}; expected one of the {len(self)} from 0 on"
            )
        i, row = i % len(self), int(self.offsets[i])
        steps = self.lengths[i]
        return self.flat_states[row : row + steps + 1], self.flat_actions[row - i : row - i + steps]

    def segment(self, past_len: int = 0) -> Segment:
        """Join all episodes, of one length, to one segment that begins at rest.

        Args:
            past_len: L, steps of rest before the first.

        Returns:
            States (N, L + T, dx) and actions (N, L + T, du); column L + t holds u_t and x_{t+1}.

        Raises:
            TrajectoryError: episodes differ in length.
        """
        self.require_equal_lengths("data.segment(...)")
        every = torch.arange(len(self))
        window = self.windows(every, torch.zeros_like(every), past_len, self.horizon)
        return window.past.then(window.future)

    def tensors(self) -> Episodes:
        """Give the episodes as tensors, which share the memory of the arrays.

        Returns:
            States (sum of T_i + 1, dx), actions (sum of T_i, du) and lengths (N,).
        """
        arrays = (self.flat_states, self.flat_actions, self.steps)
        return Episodes(*(torch.from_numpy(array) for array in arrays))

    def windows(self, episodes: Tensor, starts: Tensor, past_len: int, future_len: int) -> Window:
        """Take one window per pair of an episode and a start.

        Args:
            episodes: (B,) numbers of episodes.
            starts: (B,) steps t; the past ends with x_t, and is at rest before the episode.
            past_len: L, steps of the past.
            future_len: K, steps of the future, u_t to u_{t+K-1}; they end within the episode.

        Returns:
            The past (B, L, .) and the future (B, K, .).

        Raises:
            TrajectoryError: there is no such episode, or a future that ends beyond it.
        """
        for name, length in (("past_len", past_len), ("future_len", future_len)):
            require_count(name, length, least=0)
        episodes, starts = _indices("episodes", episodes), _indices("starts", starts)
        if not bool(((episodes >= 0) & (episodes < len(self))).all()):
            raise TrajectoryError(f"episodes are {episodes!s:.80}; expected 0 to {len(self) - 1}")
        lengths = torch.from_numpy(self.steps)[episodes]
        if not bool(((starts >= 0) & (starts + future_len <= lengths)).all()):
            raise TrajectoryError(
                f"windows of {future_len} steps from steps {starts.tolist()!s:.80} leave their "
                f"episodes of {lengths.tolist()!s:.80} steps; expected them to end within"
            )
        return self.tensors().window(episodes, starts, past_len, future_len)

    def past(self, episode: int, past_len: int) -> Segment:
        """The end of an episode, for a plan that goes on from there.

        Args:
            episode: its number.
            past_len: L, as many steps as the model looks back: ``model.past_len``.

        Returns:
            States (1, L, dx) and actions (1, L, du), at rest before the episode.
        """
        steps = len(self.episode(episode)[1])
        at, end = torch.tensor([episode % len(self)]), torch.tensor([steps])
        return self.windows(at, end, require_count("past_len", past_len), 0).past

    def window_counts(self, future_len: int, what: str) -> np.ndarray:
        """Count the windows in each episode; a warning counts the episodes that have none.

        Args:
            future_len: K, steps of the future.
            what: the windows are for, for the message.

        Returns:
            Windows of each episode (N,).

        Raises:
            TrajectoryError: no episode has ``future_len`` steps.
        """
        return window_counts(
            torch.from_numpy(self.steps), future_len, f"{what} of {self.env}"
        ).numpy()

    def require_equal_lengths(self, purpose: str) -> None:
        """Require that all episodes have one length.

        Args:
            purpose: what needs it, for the message.

        Raises:
            TrajectoryError: they differ; the message names what to use.
        """
        if len(set(self.lengths)) > 1:
            raise TrajectoryError(
                f"{purpose} needs episodes of equal length; those of {self.env} have "
                f"{min(self.lengths)} to {self.horizon} steps. data.cut(steps) takes the beginning "
                "of those that are long enough, data.episode(i) gives one, data.padded() pads them"
            )


def _indices(name: str, values: Tensor) -> Tensor:
    indices = torch.as_tensor(values)
    if indices.ndim != 1 or indices.dtype.is_floating_point or indices.dtype.is_complex:
        raise TrajectoryError(f"{name} are {values!s:.80}; expected whole numbers (B,)")
    return indices.long()
