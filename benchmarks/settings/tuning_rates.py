"""Learning rates of fine-tuning: tuning_rates.csv.

    python benchmarks/settings/tuning_rates.py

Shipped models of the pushing arm are fine-tuned on 20 episodes of the arm with 70 % of its torque, each part by several
peak rates, with three draws of the episodes. A rate is chosen by ``validation``, the mean over draws of the least loss
on the held-out fifth of the episodes; energy scores, on episodes that nothing else sees, stand beside it. What is
chosen is ``study.adaptation.BUDGETS``. A line that is there is not measured again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import cast

import pandas as pd
import torch

from tsmlib.envs.symmetry import symmetric
from tsmlib.fine_tuning import Part, fine_tune
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.study import adaptation
from tsmlib.study.data import random_data
from tsmlib.study.models import load_pretrained
from tsmlib.trajectory import Trajectories

TABLE = Path(__file__).with_suffix(".csv")
ARM = "tsm/ReacherPush-v1"
SEEDS, EPISODES = (7, 8, 9), 20  # no seed of the study's
JUDGED = (3_000_001, 3_000_002)  # seeds of the episodes that are scored, and that the scores' noise is fitted to
RATES: dict[str, dict[Part, tuple[float, ...]]] = {
    "rtsm": {"all": (3e-4, 1e-3, 3e-3), "head": (3e-4, 1e-3, 3e-3, 1e-2), "codes": (0.03, 0.1, 0.3)},
    "lstm": {"all": (3e-4, 1e-3, 3e-3), "head": (3e-3, 1e-2, 3e-2)},
    "ensemble+mse": {"all": (1e-4, 3e-4, 1e-3), "head": (3e-4, 1e-3, 3e-3, 1e-2)},
}


def lines() -> Iterator[tuple[str, Part, float, int]]:
    """Model, part, rate and seed of each line."""
    for word, parts in RATES.items():
        for part, rates in parts.items():
            for rate, seed in product(rates, SEEDS):
                yield word, part, rate, seed


@cache
def judged(env: str) -> tuple[Trajectories, Trajectories]:
    """Episodes that are scored, and half as many that the scores' noise is fitted to."""
    return random_data(env, 100, seed=JUDGED[0]), random_data(env, 50, seed=JUDGED[1])


def measured(word: str, part: Part, rate: float, seed: int) -> dict[str, float]:
    """The least validation loss, and energy scores of the model that has it."""
    env = adaptation.changed(ARM, "gain0.7")
    train, held_out = adaptation.few(env, EPISODES, seed=seed)
    net = cast(RecurrentTSM, load_pretrained(word, env=ARM))
    how = replace(adaptation.options(net, word, part), lr=rate)
    history = fine_tune(
        net, net.loss, symmetric(train), held_out, how, part=part, seed=seed, progress=f"{word} {part} {rate:g}"
    )
    scores = adaptation.scored(net, env, judged(env)).against_horizon()["energy_score_noise"]
    return {"validation": min(history.validation)} | {
        f"energy_score_{steps}": float(scores[steps - 1]) for steps in adaptation.AHEAD
    }


def main() -> None:
    torch.set_num_threads(1)
    known = pd.read_csv(TABLE) if TABLE.exists() else pd.DataFrame(columns=["model", "part", "rate", "seed"])
    for word, part, rate, seed in lines():
        line = {"model": word, "part": part, "rate": rate, "seed": seed}
        if not (known[list(line)] == pd.Series(line)).all(axis=1).any():
            new = line | {name: f"{value:.4g}" for name, value in measured(word, part, rate, seed).items()}
            known = pd.concat([known, pd.DataFrame([new])])
            known.to_csv(TABLE, index=False, lineterminator="\n")
    numbers = known.astype(dict.fromkeys(known.columns[4:], float))
    print(
        numbers.drop(columns="seed").groupby(["model", "part", "rate"]).mean().to_string(float_format="{:.4g}".format)
    )


if __name__ == "__main__":
    main()
