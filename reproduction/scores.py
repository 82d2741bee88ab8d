"""Scores of predictions (tables 03 and 06), and of single episodes for intervals."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from reproduction.episodes import load_data, load_model
from reproduction.measures.contacts import after_first, contact_steps
from reproduction.runs import Run, env_id
from reproduction.tables import Row, place
from tsmlib.envs.spec import EnvSpec
from tsmlib.evaluation.prediction import Scores, cut, score
from tsmlib.evaluation.scoring import LEVELS
from tsmlib.models.base import predict_segment
from tsmlib.trajectory import Segment, Trajectories

STARTS = range(10, 100, 30)  # steps at which segments from the true past begin
HORIZONS = (1, 2, 5, 10, 20, 30, 40, 50, 60, 70, 80, 90)
TRIMMED = "without the worst 5 %"  # of the episodes, by the model's own log-likelihood
BLIND = "past actions zero"
OPEN, SEGMENTS = "open loop", "segments"


def sizes(run: Run) -> tuple[int, int]:
    """Test episodes, and samples of each prediction."""
    return run.pick((8, 8), (200, 16), (1000, 32))


def scored(run: Run, name: str, word: str, **options: object) -> tuple[Scores, Trajectories]:
    """Scores of a model on test episodes, and these episodes."""
    net, (n, samples) = load_model(run, name, word), sizes(run)
    test = load_data(run, name, "test").take(slice(n))
    held_out = load_data(run, name, "validation").take(slice(min(n, 200)))
    how = {"samples": samples, "seed": run.seed, "progress": f"{name} {word}", **options}
    return score(how.pop("model", net), net.features, test, held_out, **how), test


def score_rows(run: Run, name: str, word: str) -> list[Row]:
    """All scores of a model, open loop over 90 steps and in segments from the true past."""
    whole, test = scored(run, name, word, horizon=90)
    parts, _ = scored(run, name, word, horizon=10, starts=list(STARTS))
    spec = EnvSpec.parse(env_id(name))
    about = place(env_id(name)) | {"model": word, "planner": "none"}
    rows = summarised(about | {"execution": OPEN}, whole) + summarised(
        about | {"execution": SEGMENTS}, parts, None, steps=False
    )
    if spec.has_block and not spec.noise:
        touching = contact_steps(test.states, test.env)
        since = cut(after_first(touching), (10,), whole.pit.shape[1])
        within = cut(touching, STARTS, parts.pit.shape[1]).any(1, keepdim=True)
        ever = within.expand(-1, parts.pit.shape[1])
        rows += summarised(about | {"execution": OPEN, "subset": "contact"}, whole, since)
        touched = about | {"execution": SEGMENTS, "subset": "contact"}
        rows += summarised(touched, parts, ever, steps=False)
    likelihood = whole.values["ll_own"].mean(1).sort().values
    kept = likelihood[int(0.05 * len(likelihood)) :]
    outside = whole.outside.float()
    about |= {"execution": OPEN}
    trimmed = {"metric": "ll_own", "subset": TRIMMED, "value": float(kept.mean()), "n": len(kept)}
    out = {"metric": "diverged", "unit": "share", "value": float(outside.mean()), "n": len(outside)}
    return [*rows, about | trimmed, about | out]


def episode_rows(run: Run, name: str, word: str) -> list[Row]:
    """Energy score of each test episode, mean over 90 steps: what intervals resample."""
    found, _ = scored(run, name, word, horizon=90)
    about = place(env_id(name)) | {"model": word, "planner": "none", "execution": OPEN, "n": 1}
    values = found.values["energy_score_noise"].mean(1).tolist()
    return [
        about | {"metric": "energy_score_noise", "value": float(f"{value:.5g}"), "episode": i}
        for i, value in enumerate(values)
    ]


def blind_rows(run: Run, name: str, word: str) -> list[Row]:
    """Scores of a segment model that is shown zeros for the past actions U- (claim C11)."""
    blind = WithoutPastActions(load_model(run, name, word))
    found, test = scored(run, name, word, horizon=90, model=blind)
    about = place(env_id(name)) | {"model": word, "planner": "none", "execution": OPEN}
    about |= {"subset": BLIND, "n": len(test)}
    return [about | {"metric": k, "value": value} for k, value in _means(found, None).items()]


class WithoutPastActions:
    """A model that is shown zeros for the past actions U- (section 3)."""

    def __init__(self, model: torch.nn.Module) -> None:
        self.model, self.features = model, model.features
        self.segment_len, self.past_len = model.segment_len, model.past_len
        self.stochastic = model.stochastic

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: torch.Generator | None = None
    ) -> Tensor:
        """As the model's."""
        blind = Segment(past.states, 0 * past.actions)
        return predict_segment(self.model, blind, actions, generator=generator)


def summarised(
    about: Row, found: Scores, where: Tensor | None = None, *, steps: bool = True
) -> list[Row]:
    """Means over all predicted steps, or those of ``where`` (N, T); and at HORIZONS."""
    chosen = torch.ones(found.pit.shape[:2], dtype=torch.bool) if where is None else where
    if not chosen.any():
        return []
    about = about | {"n": int(chosen.any(1).sum())}
    rows = [about | {"metric": k, "value": value} for k, value in _means(found, where).items()]
    if not steps:
        return rows
    counts = chosen.sum(0).tolist()
    for metric, curve in found.against_horizon(where).items():
        for h in HORIZONS:
            if h <= len(counts) and counts[h - 1]:
                at = {"steps_ahead": h, "value": float(curve[h - 1]), "n": counts[h - 1]}
                rows.append(about | at | {"metric": metric})
    for level, share in zip(LEVELS, found.calibration(where), strict=True):
        metric = f"calibration{round(100 * float(level))}"
        rows.append(about | {"metric": metric, "value": float(share), "unit": "share"})
    return rows


def _means(found: Scores, where: Tensor | None) -> dict[str, float]:
    means = {
        metric: float((value if where is None else value[where]).mean())
        for metric, value in found.values.items()
    }
    means["nrmse"] = math.sqrt(means.pop("squared_error"))
    return means
