"""What noise, codes and proposals are worth where the search is small: 11_pusht_search.csv.

    python benchmarks/pusht_search.py

PushT in protocol B, 200 validation pairs, the shipped model, an eighth of its candidates; ``split``
test: the frozen pairs. A proposal is a network from state and goal to a plan, learned from plans
of the same search for pairs of random play; a quarter of the candidates are drawn around it.
Rows that are there already are not made again. States, not pixels; random play, no demonstrations.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from pusht_rounds import pairs
from torch import Tensor, nn
from torch.nn import functional as F

import tsmlib
from reproduction import pusht
from tsmlib.models.layers import silu_network
from tsmlib.planning.base import SearchSpace
from tsmlib.planning.pusht import random_play
from tsmlib.pretrained import load_pusht
from tsmlib.training.options import TrainingOptions
from tsmlib.trajectory import Segment, initial_past

TABLE = Path(__file__).resolve().parents[1] / "data" / "results" / "11_pusht_search.csv"
AHEAD, EVERY = pusht.AHEAD["B"][0], pusht.EVERY
METHODS = {  # method -> candidates
    "white noise": 16,
    "smooth noise": 16,
    "1/f noise": 16,
    "codes": 16,
    "codes, 6 candidates": 6,
    "proposal": 16,
}


class Pink(tsmlib.DirectActions):
    """Noise whose power falls as one over the frequency."""

    def noise(self, n: int, n_targets: int, generator: torch.Generator) -> Tensor:
        steps, dim = self.shape
        frequency = torch.fft.rfftfreq(steps).clamp(min=1 / steps)
        drawn = torch.randn(n, n_targets, dim, len(frequency), 2, generator=generator)
        noise = torch.fft.irfft(torch.view_as_complex(drawn) * frequency**-0.5, n=steps)
        return (noise / noise.std()).transpose(-1, -2)


class Proposal(nn.Module):
    """Plans for states and goals (B, 7), made as seen from the T."""

    spread: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.net = silu_network(14, 256, 256, 2 * AHEAD)
        self.register_buffer("spread", torch.ones(AHEAD, 2))

    def forward(self, x: Tensor, goal: Tensor) -> Tensor:
        """The parameters (B, T, 2) of a plan."""
        cosine, sine = x[:, None, 4].cos(), x[:, None, 4].sin()
        tee, angle = x[:, 2:4], goal[:, 4] - x[:, 4]
        vectors = [x[:, :2] - tee, goal[:, 2:4] - tee, goal[:, :2] - tee, x[:, 5:]]
        seen = _turned(torch.stack(vectors, 1) / 100, cosine, -sine).flatten(1)
        rest = [x[:, 4].cos(), x[:, 4].sin(), 2 * angle.sin(), 2 - 2 * angle.cos()]
        told = torch.cat([seen, (tee - 255) / 100, torch.stack(rest, 1)], 1)
        return _turned(self.net(told).unflatten(1, (AHEAD, 2)), cosine, sine)

    def draw(self, task: tsmlib.Task, x: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """Plans (n, B, T, 2): the likeliest, and others around it."""
        with torch.no_grad():
            middle = self(x, task.target)
        drawn = torch.randn(n, *middle.shape, generator=generator)
        drawn[0] = 0
        return middle + self.spread * drawn


def _turned(vectors: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    x, y = vectors.unbind(-1)
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y], -1)


def learned(model: tsmlib.DynamicsModel, n_pairs: int, updates: int) -> Proposal:
    """A proposal, from plans for pairs of random play."""
    task, plans = pairs(n_pairs, 6000, "B"), []
    space = tsmlib.DirectActions(AHEAD, rms=pusht.RMS, smoothness=0)
    for k in range(0, n_pairs, 500):
        some = task.take(range(k, min(k + 500, n_pairs)))
        predict = tsmlib.model_predictor(model, some.past(1))
        plan = tsmlib.cem(
            predict, some.reward, space, len(some), candidates=48, elites=6, iterations=4, seed=k
        )
        plans.append(plan.parameters)
    x, u, n = torch.from_numpy(task.start), torch.cat(plans), n_pairs - n_pairs // 10
    torch.manual_seed(0)
    proposal = Proposal()
    optimizer = torch.optim.Adam(proposal.parameters(), 2e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, updates)
    for _ in range(updates):
        rows = torch.randint(0, n, (256,))
        loss = (proposal(x[rows], task.target[rows]) - u[rows]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        proposal.spread.copy_((proposal(x[n:], task.target[n:]) - u[n:]).std(0))
    return proposal


@dataclass
class Replanned:
    """A controller that plans every five steps, by one of the methods."""

    task: tsmlib.Task
    model: tsmlib.DynamicsModel
    method: str
    seed: int
    prior: tsmlib.ActionPrior
    proposal: Proposal
    done: int = 0
    left: Tensor | None = None  # of the last plan

    def __call__(self, past: Segment) -> Tensor:
        so_far = past.states[:, past.states.shape[1] - self.done - 1 :]
        rows = (~self.task.judged(so_far)[1]).nonzero()[:, 0]
        actions = torch.zeros(len(self.task), EVERY, 2)
        if len(rows):
            task, x = self.task.take(rows.tolist()), past.states[rows, -1]
            space = self.space(past.actions[rows])
            left = torch.zeros(len(rows), *space.shape) if self.left is None else self.left[rows]
            candidates, start = METHODS[self.method], left[None]
            if self.method == "proposal":
                drawn = torch.Generator().manual_seed(1000 * self.seed + self.done)
                start = torch.cat([start, self.proposal.draw(task, x, candidates, drawn)])
                candidates -= candidates // 4
            predict = tsmlib.model_predictor(self.model, initial_past(x, 1, 2))
            budget = {"candidates": candidates, "elites": max(2, candidates // 4), "iterations": 4}
            plan = tsmlib.cem(
                predict, task.reward, space, start, **budget, seed=100 * self.seed + self.done
            )
            steps = EVERY // (AHEAD // space.shape[0])
            parameters = torch.zeros(len(self.task), *space.shape)
            parameters[rows] = F.pad(plan.parameters[:, steps:], (0, 0, 0, steps))
            actions[rows], self.left = plan.actions[:, :EVERY], parameters
        self.done += EVERY
        return actions

    def space(self, before: Tensor) -> SearchSpace:
        """What is searched after the actions ``before`` (B, t, 2)."""
        if self.method.startswith("codes"):
            return tsmlib.LatentActions(self.prior, AHEAD, past=before[:, -self.prior.past_len :])
        kind = Pink if self.method == "1/f noise" else tsmlib.DirectActions
        smoothness = 1.5 if self.method == "smooth noise" else 0.0
        return kind(AHEAD, rms=pusht.RMS, smoothness=smoothness)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--split", choices=("validation", "test"), default="validation")
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--plans", type=int, default=2500, help="that a proposal learns from")
    parser.add_argument("--updates", type=int, default=2500, help="of the prior and the proposal")
    parser.add_argument("--out", type=Path, default=TABLE)
    given = parser.parse_args()
    torch.set_num_threads(1)
    model = tsmlib.load_pretrained("egocentric", env="tsm/PushT-v0")
    play = random_play(300, seed=5000)
    prior = tsmlib.ActionPrior.for_data(play, segment_len=EVERY)
    options = TrainingOptions(steps=given.updates, batch_size=256)
    tsmlib.fit(prior, play, None, options, progress=False)
    proposal = learned(model, given.plans, given.updates)
    table, task = pusht.Table(given.out), load_pusht(given.split, "B").take(given.pairs)
    for method in given.methods:
        for seed in given.seeds:
            if not table.has(method, "B", seed):
                began = time.process_time()
                plan = Replanned(task, model, method, seed, prior, proposal)
                trial = tsmlib.execute(task, plan, past_len=task.horizon + 1)
                line = pusht.row(task, trial, method, "B", seed)
                seconds = round(time.process_time() - began, 1)
                table.add(line | {"split": given.split, "seconds": seconds})


if __name__ == "__main__":
    main()
