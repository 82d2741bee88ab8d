"""Rows of 06_robustness on predictions, where observations are noisy or actions come late."""

from __future__ import annotations

from collections.abc import Iterable
from typing import cast

import numpy as np

from tsmlib.envs.spec import NOISE
from tsmlib.evaluation import filtering, futures, prediction
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.models.tsm import TSM
from reproduction.data import dataset
from reproduction.models import load_or_train
from reproduction.predictions import WithoutPastActions, score_sizes
from reproduction.results import latent, robustness, table
from reproduction.results import prediction as prediction_results
from reproduction.results.table import Row
from reproduction.runs import Run


def blind_rows(run: Run, env: str, words: Iterable[str]) -> list[Row]:
    """Scores, open loop, of segment models that are shown zeros in place of past actions."""
    (n, samples), rows = score_sizes(run).values(), list[Row]()
    test, held_out = dataset(run, env, "test").take(slice(n)), dataset(run, env, "validation")
    for word in words:
        blind = WithoutPastActions(load_or_train(run, env, word).model)
        found = prediction.score(
            blind,
            blind.features,
            test,
            held_out,
            horizon=90,
            samples=samples,
            seed=run.seed,
            progress=f"{word}, blind",
        )
        here: Row = table.place(env) | dict(
            planner="none",
            execution="open loop",
            subset="past actions zero",
            n=len(test),
            seed=run.seed,
            scale=run.scale,
            model=word,
        )
        means = prediction_results.means(found)
        rows += [dict(here, metric=metric, value=value) for metric, value in means.items()]
    return rows


def code_rows(run: Run, env: str, words: Iterable[str]) -> list[Row]:
    """What codes of segment models hold, in segments from the true past: spread, error, KL and active units."""
    (n, samples), rows = score_sizes(run).values(), list[Row]()
    test = dataset(run, env, "test").take(slice(n))
    for word in words:
        net = cast(TSM | RecurrentTSM, load_or_train(run, env, word).model)
        found = futures.sample_futures(net, test, samples=samples, horizon=10, seed=run.seed)
        own = latent.rows(net, found, model=word, seed=run.seed, scale=run.scale)
        rows += [row for row in own if not row.get("subset") and "dimension" not in row]
    return rows


def clean_rows(run: Run, noisy: str, clean: str, words: Iterable[str]) -> list[Row]:
    """Errors to the true state, of models, of the raw observation, and of two filters that are tuned on validation
    episodes. noisy, clean: the same arm with sensor noise and without."""
    (n, samples), rows = score_sizes(run).values(), list[Row]()
    test, truth = (dataset(run, env, "test").take(slice(n)) for env in (noisy, clean))
    held_out = dataset(run, noisy, "validation"), dataset(run, clean, "validation")

    def add(word: str, ahead: np.ndarray | None, now: np.ndarray | None = None) -> None:
        rows.extend(robustness.error_rows(noisy, word, ahead, now, seed=run.seed, scale=run.scale))

    for word in words:
        net, told = load_or_train(run, noisy, word).model, f"{word}: errors to the true state"
        add(word, filtering.model_errors(net, test, truth, samples=samples, progress=told))
    raw = filtering.errors(test.states[:, 1:], truth.states[:, 1:])
    add("none", np.repeat(raw[:, :, None], 10, 2).reshape(-1, 10, raw.shape[-1]))
    kalman = filtering.KalmanFilter.fitted(dataset(run, clean, "train"), NOISE).tuned(*held_out)
    now, ahead = filtering.filter_errors(kalman, test, truth)
    add("filter", ahead, now)
    add(
        "exponential",
        None,
        filtering.exponential_errors(filtering.tuned_exponential(*held_out), test, truth),
    )
    return rows
