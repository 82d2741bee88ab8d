"""Learning rates of Muon in rounds of pushing: rates.csv.

    python benchmarks/exploration/rates.py [--models lstm ensemble+mse]

Learners of notebook 10 at scale paper, of training seed 10, which no published row has, by several rates (0: Adam
alone): as they are before the first round, and after the training of one round with no new episodes and with 150 more
random ones (``explore``: where nothing is better on the held-out episodes, the weights stay). All are judged on 100
other random episodes: the mean loss over their windows, and energy scores 10 and 80 steps ahead. A rate is chosen by
that loss after the round with random episodes. A line that is there is not measured again.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pandas as pd
import torch

from tsmlib.exploration import Trainable, explore
from tsmlib.study import adaptation, rounds, worlds
from tsmlib.study.data import random_data
from tsmlib.study.results.exploration import NONE, PUSH, RANDOM
from tsmlib.training.fit import fixed_windows, validate

TABLE, SEED = Path(__file__).with_suffix(".csv"), 10
JUDGED = (3_000_003, 3_000_004)  # seeds of the episodes that judge, and that the scores' noise is fitted to
RATES = {"rtsm": (0.005, 0.01, 0.02), "lstm": (0.0, 0.0025, 0.005, 0.01, 0.02), "ensemble+mse": (0.0, 0.01, 0.02)}
BEFORE = "before the first round"


def judged(model: Trainable) -> dict[str, float]:
    """Loss and energy scores on episodes that no training has seen."""
    data = random_data(PUSH, 100, seed=JUDGED[0]), random_data(PUSH, 50, seed=JUDGED[1])
    scores = adaptation.scored(model, PUSH, data).against_horizon()["energy_score_noise"]
    loss = validate(model.loss, fixed_windows(data[0], model.past_len, 20), SEED)
    return {"loss": loss} | {f"energy_score_{steps}": float(scores[steps - 1]) for steps in adaptation.AHEAD}


def measured(word: str, rate: float) -> Iterator[dict[str, object]]:
    """A line for each stage of one learner."""
    here = worlds.world(PUSH)
    sizes = here.sizes["paper"]
    model, _, train, held_out = rounds.learner(word, sizes, SEED, PUSH, muon=rate)
    yield {"stage": BEFORE, **judged(model)}
    new = here.random(sizes.episodes, rounds.round_seed(SEED, 1))
    how = replace(sizes.options(model.past_len, muon=rate), rounds=1, prior=None)
    for stage, episodes in ((NONE, None), (RANDOM, new)):
        net = copy.deepcopy(model)
        explore(
            net, None, train, held_out, here.tested, how, seed=SEED, augmented=here.augmented,
            episodes=lambda _, found=episodes: found, progress=f"{word} {rate:g}: {stage}",
        )  # fmt: skip
        yield {"stage": stage, **judged(net)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", choices=RATES, default=[*RATES], help="default all")
    parser.add_argument("--out", type=Path, default=TABLE, help="default rates.csv beside this script")
    given = parser.parse_args()
    torch.set_num_threads(1)
    known = pd.read_csv(given.out) if given.out.exists() else pd.DataFrame(columns=["model", "rate"])
    for word in given.models:
        for rate in RATES[word]:
            if not ((known["model"] == word) & (known["rate"] == rate)).any():
                lines = [{"model": word, "rate": rate, **line} for line in measured(word, rate)]
                known = pd.concat([known, pd.DataFrame(lines).round(4)])
                known.to_csv(given.out, index=False, lineterminator="\n")
    print(known.to_string(index=False))


if __name__ == "__main__":
    main()
