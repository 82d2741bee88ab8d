"""What the codes of TSM carry, and what its samples are worth: data/results/64_codes.csv.

    python benchmarks/codes.py

Shipped models of the three MuJoCo arms on 300 fresh episodes, 16 samples, 90 steps after 10. Energy
score and its median over episodes, in deviations of the data, the smaller the better; what 80 %
intervals hold; and of a model with an encoder the nats of a segment's code, its active dimensions
and how far another code moves the next segment.
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
from tsmlib.pretrained import PRETRAINED
from tsmlib.trajectory import Trajectories

TABLE = Path(__file__).resolve().parents[1] / "data" / "results" / "64_codes.csv"
ARMS = ("Reacher", "ReacherObstacle", "ReacherPush")
MODELS = ("tsm", "tsm+prior", "rtsm", "onestep", "multistep", "lstm")
SEED, EPISODES, SAMPLES, START, STEPS = 1_000_064, 300, 16, 10, 90


def scores(model: torch.nn.Module, data: Trajectories) -> dict[str, float]:
    """Of samples over the horizon, or of the mode of a model that has none."""
    episodes = torch.arange(len(data))
    past, future = data.windows(episodes, torch.full_like(episodes, START), model.past_len, STEPS)
    features, several = model.features, model.stochastic
    states = model.predict(past, future.actions, SAMPLES if several else 1)
    drawn, truth = (features(part)[..., features.scored] for part in (states, future.states))
    energy, _ = scoring.distances(drawn, truth, shifts=SAMPLES - 1)
    held = scoring.coverage(scoring.rank(drawn, truth, torch.Generator().manual_seed(0)), 0.8)
    return {
        "energy score": float(energy.mean()),
        "median": float(energy.mean(1).median()),
        "coverage of 80 %": float(held.mean()) if several else float("nan"),
    }


@torch.no_grad()
def codes(model: tsmlib.TSM, data: Trajectories) -> dict[str, float]:
    """Of every segment of the episodes, after its true past."""
    length = model.segment_len
    starts = torch.arange(START, data.horizon - length + 1, length)
    episodes = torch.arange(len(data)).repeat_interleave(len(starts))
    window = data.windows(episodes, starts.repeat(len(data)), model.past_len, length)
    mean, log_variance = model.posterior(*window)
    prior = model.prior(window.past, window.future.actions)
    nats = latent.kl_by_dimension(mean, log_variance, *prior).sum(1)
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
        for word in MODELS:
            if not (PRETRAINED / arm / f"{word}.safetensors").exists():
                continue
            model = tsmlib.load_pretrained(word, env=env_id(arm))
            found = scores(model, data)
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
