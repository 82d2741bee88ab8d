"""Windows of test episodes, and futures that a segment model samples for them.

Letters in shapes: S samples, N windows, L past length, T steps, dx state size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tsmlib.evaluation.prediction import sample_states
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.models.tsm import TSM
from tsmlib.trajectory import Segment, Trajectories, Window

Coded = TSM | RecurrentTSM  # one code for H steps: ``decode``, ``code_len``, ``latent_dim``
# Steps at which the windows begin; with HORIZON they hold every step of an episode once.
STARTS = (10, 40, 70)
HORIZON = 30


@dataclass(frozen=True)
class SampledFutures:
    """Windows of test episodes, and what a model predicts for them with codes from N(0, I).

    window: past (N, L, .) and future (N, T, .); samples (S, N, T, dx), physical units.
    """

    env: str
    window: Window
    samples: Tensor

    def first(self, steps: int) -> SampledFutures:
        """The same windows, cut after ``steps``."""
        past, future = self.window
        future = Segment(*(part[:, :steps] for part in future))
        return replace(self, window=Window(past, future), samples=self.samples[:, :, :steps])


def sample_futures(
    model: Coded,
    test: Trajectories,
    *,
    samples: int,
    horizon: int = HORIZON,
    seed: int = 0,
    progress: str = "",
) -> SampledFutures:
    """Windows from STARTS of every test episode, episode by episode, and sampled futures under
    their true actions.
    """
    test.require_equal_lengths("a look at the futures of every episode")
    drawn = sample_states(
        model, test, samples=samples, horizon=horizon, starts=STARTS, seed=seed, progress=progress
    )
    episodes = torch.arange(len(test)).repeat_interleave(len(STARTS))
    begin = torch.tensor(STARTS).repeat(len(test))
    window = test.windows(episodes, begin, model.past_len, horizon)
    return SampledFutures(test.env, window, drawn)
