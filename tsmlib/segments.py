"""Segments and windows: what models see of trajectories (letters as in ``trajectory``)."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from tsmlib.robot import TrajectoryError


class Segment(NamedTuple):
    """States in physical units, with the actions that led to them.

    Args:
        states: (B, L, dx).
        actions: (B, L, du) in [-1, 1].
    """

    states: Tensor
    actions: Tensor

    def then(self, following: Segment) -> Segment:
        """Append another segment.

        Args:
            following: states and actions (B, K, .).

        Returns:
            States (B, L + K, dx) and actions (B, L + K, du).
        """
        return Segment(*(torch.cat(pair, dim=1) for pair in zip(self, following, strict=True)))

    def last(self, length: int) -> Segment:
        """Take the last steps, as the past of what follows.

        Args:
            length: steps to take; all, where the segment has fewer.

        Returns:
            States (B, length, dx) and actions (B, length, du).
        """
        return Segment(self.states[:, -length:], self.actions[:, -length:])

    def to(self, device: torch.device | str) -> Segment:
        """Move the segment to a device.

        Args:
            device: such as "cuda".

        Returns:
            The same states and actions there.
        """
        return Segment(self.states.to(device), self.actions.to(device))


class Window(NamedTuple):
    """A past and the future that followed it.

    Args:
        past: X-, U- (B, L, .).
        future: X+, U+ (B, K, .).
    """

    past: Segment
    future: Segment


class Episodes(NamedTuple):
    """Episodes one after the other, without padding, as tensors.

    Args:
        states: (sum of T_i + 1, dx).
        actions: (sum of T_i, du).
        lengths: (N,), the steps T_i of each episode; always on the CPU.
    """

    states: Tensor
    actions: Tensor
    lengths: Tensor

    def to(self, device: torch.device | str) -> Episodes:
        """The same episodes on ``device``."""
        return Episodes(self.states.to(device), self.actions.to(device), self.lengths)

    def window(self, episodes: Tensor, starts: Tensor, past_len: int, future_len: int) -> Window:
        """The windows of Trajectories.windows, without its checks."""
        first = (self.lengths.cumsum(0) - self.lengths)[episodes]  # action of each episode
        at = starts[:, None] + torch.arange(-past_len, future_len)  # t of u_t, which led to x_{t+1}
        states = self.states[(first + episodes)[:, None] + (at + 1).clamp_min(0)]
        actions = self.actions[first[:, None] + at.clamp_min(0)]
        actions = actions.where((at >= 0)[..., None].to(actions.device), 0.0)
        return Window(
            Segment(states[:, :past_len], actions[:, :past_len]),
            Segment(states[:, past_len:], actions[:, past_len:]),
        )


def initial_past(states: Tensor, past_len: int, action_dim: int) -> Segment:
    """The past of an episode that starts in ``states`` (B, dx): x_0 repeated, zero actions."""
    return Segment(
        states[:, None].expand(-1, past_len, -1),
        states.new_zeros(len(states), past_len, action_dim),
    )


def states_before(window: Window) -> Tensor:
    """x_t .. x_{t+K-1}, the states in which the future's actions are taken: (B, K, dx)."""
    return torch.cat([window.past.states[:, -1:], window.future.states[:, :-1]], dim=1)


def real_steps(lengths: Sequence[int], horizon: int) -> Tensor:
    """(N, T) bool: the steps of episodes of these lengths, as opposed to their padding."""
    return torch.arange(horizon) < torch.tensor(lengths)[:, None]


def window_at(index: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Episode and start of the windows ``index`` (B,), of which episodes have ``counts`` (N,)."""
    ends = counts.cumsum(0)
    episodes = torch.searchsorted(ends, index, right=True)
    return episodes, index - (ends - counts)[episodes]


def batches(
    data: Episodes,
    *,
    past_len: int,
    future_len: int,
    batch_size: int,
    generator: torch.Generator,
) -> Iterator[Window]:
    """Endless random windows, uniform over all that lie within an episode.

    Args:
        data: the episodes, ``Trajectories.tensors()``, on the device where windows are wanted.
        past_len: L, steps of the past.
        future_len: K, steps of the future.
        batch_size: B, windows in a batch.
        generator: of random numbers, on the CPU.

    Returns:
        An iterator over windows (B, L, .) and (B, K, .).

    Raises:
        TrajectoryError: no episode has ``future_len`` steps. A warning counts those that have not.
    """
    counts = window_counts(data.lengths, future_len, "training")
    even = bool((counts == counts[0]).all())
    while True:
        if even:
            episodes = torch.randint(len(counts), (batch_size,), generator=generator)
            starts = torch.randint(int(counts[0]), (batch_size,), generator=generator)
        else:
            index = torch.randint(int(counts.sum()), (batch_size,), generator=generator)
            episodes, starts = window_at(index, counts)
        yield data.window(episodes, starts, past_len, future_len)


def window_counts(lengths: Tensor, future_len: int, what: str) -> Tensor:
    counts = (lengths - future_len + 1).clamp_min(0)
    short = int((counts == 0).sum())
    if short == len(counts):
        raise TrajectoryError(
            f"{what}: {short} episodes of at most {int(lengths.max())} steps hold no window of "
            f"{future_len} future steps; expected episodes of at least {future_len} steps"
        )
    if short:
        warnings.warn(
            f"{what}: {short} of {len(counts)} episodes are shorter than {future_len} steps and "
            "are not used",
            stacklevel=3,
        )
    return counts
