"""What the codes of TSM carry, and what its samples are worth: data/results/codes.csv.

    python benchmarks/codes.py

Shipped models of the three MuJoCo arms on 300 fresh episodes, 16 samples, 90 steps after 10. Energy
score and its median over episodes, in deviations of the data, the smaller the better; what 80 %
intervals hold; and of a model with an encoder the nats of a segment's code, its active dimensions
and how far another code moves the next segment. ``ahead of ...``: the share of episodes on which a
segment model has the smaller energy score.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import torch

import tsmlib
from reproduction.episodes import random_data
from reproduction.measures import latent
from reproduction.runs import env_id
from tsmlib.evaluation import scoring
from tsmlib.trajectory import Trajectories

TABLE = Path(__file__).resolve().parents[1] / "data" / "results" / "codes.csv"
ARMS = ("Reacher", "ReacherObstacle", "ReacherPush")
BASELINES = ("onestep", "multistep", "lstm")
MODELS = ("tsm", "rtsm")
SEED, EPISODES, SAMPLES, START, STEPS = 1_000_064, 300, 16, 10, 90


def scores(model: torch.nn.Module, data: Trajectories) -> tuple[dict[str, float], torch.Tensor]:
    """Of samples over the horizon, or of the mode of a model that has none; and of each episode."""
    episodes = torch.arange(len(data))
    past, future = data.windows(episodes, torch.full_like(episodes, START), model.past_len, STEPS)
    features, several = model.features, model.stochastic
    states = model.predict(past, future.actions, SAMPLES if several else 1)
    drawn, truth = (features(part)[..., features.scored] for part in (states, future.states))
    energy, _ = scoring.distances(drawn, truth, shifts=SAMPLES - 1)
    held = scoring.coverage(scoring.rank(drawn, truth, torch.Generator().manual_seed(0)), 0.8)
    means = {
        "energy score": float(energy.mean()),
        "median": float(energy.mean(1).median()),
        "coverage of 80 %": float(held.mean()) if several else float("nan"),
    }
    return means, energy.mean(1)


@torch.no_grad()
def codes(model: tsmlib.TSM, data: Trajectories) -> dict[str, float]:
    """Of every segment of the episodes, after its true past."""
    length = model.segment_len
    starts = torch.arange(START, data.horizon - length + 1, length)
    episodes = torch.arange(len(data)).repeat_interleave(len(starts))
    window = data.windows(episodes, starts.repeat(len(data)), model.past_len, length)
    mean, log_variance = model.encode(window.future.states)
    nats = latent.kl_by_dimension(mean, log_variance).sum(1)
    effects = latent.total_effects(model, window, torch.Generator().manual_seed(0))
    return {
        "nats": float(nats.mean()),
        "nats, 90th percentile": float(nats.quantile(0.9)),
        "active dimensions": int(latent.active_units(mean).sum()),
        "effect of another code": float(effects.square().sum().sqrt()),
    }


def rows() -> Iterator[dict[str, str]]:
    """One line an arm and model."""
    for arm in ARMS:
        data = random_data(env_id(arm), EPISODES, seed=SEED)
        rivals = dict[str, torch.Tensor]()
        for word in (*BASELINES, *MODELS):
            model = tsmlib.load_pretrained(word, env=env_id(arm))
            found, each = scores(model, data)
            if word in BASELINES:
                rivals[word] = each
            else:
                shares = {
                    rival: float((each < other).float().mean()) for rival, other in rivals.items()
                }
                found |= {f"ahead of {rival}": share for rival, share in shares.items()}
            if isinstance(model, tsmlib.TSM):
                found |= codes(model, data)
            spelled = {name: f"{value:.4g}" for name, value in found.items() if value == value}
            yield {"arm": arm, "model": word} | spelled


if __name__ == "__main__":
    lines = list(rows())
    names = list(dict.fromkeys(name for line in lines for name in line))
    with TABLE.open("w", newline="") as file:
        table = csv.DictWriter(file, names, lineterminator="\n")
        table.writeheader()
        table.writerows(lines)
    print(TABLE.read_text(), end="")
