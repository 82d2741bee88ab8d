"""Data sets of the arms, trained models, and what the data hold (tables 01 and 02)."""

from __future__ import annotations

import shutil
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path

import gymnasium
import numpy as np
import torch

import tsmlib
from reproduction import schedules
from reproduction.measures import gradients
from reproduction.measures.data import autocorrelation, cells_visited, shares
from reproduction.runs import HELD_OUT, Run, env_id
from reproduction.symmetry import copies, symmetric
from reproduction.tables import Row, place
from tsmlib import zoo
from tsmlib.envs import fingerprint
from tsmlib.envs.geometry import LINK_LENGTHS
from tsmlib.envs.spec import EnvSpec
from tsmlib.models.action_prior import ActionPrior
from tsmlib.storage import artifacts
from tsmlib.trajectory import Trajectories

LAGS = (5, 10, 20, 40)  # steps
CHECKED = 2  # starts of the gradients that are checked


def random_data(env: str, n: int, *, seed: int, horizon: int = 100) -> Trajectories:
    """Episodes of smooth random torques, a function of (env, n, seed) alone."""
    torques = tsmlib.smooth_torques(n, horizon, generator=torch.Generator().manual_seed(seed))
    with closing(gymnasium.make_vec(env, num_envs=n)) as arms:
        return tsmlib.collect(arms, tsmlib.open_loop(torques), horizon=horizon, seed=seed)


def make_data(run: Run, name: str, split: str) -> Trajectories:
    """The paper's 500 episodes of the plain arm and 5,000 elsewhere; 200 and 1,000 held out."""
    env = env_id(name)
    whole = {"train": 5000 if EnvSpec.parse(env).has_block else 500, "validation": 200}
    n = run.pick({"train": 20}.get(split, 8), whole.get(split, 1000), whole.get(split, 1000))
    return random_data(env, n, seed=HELD_OUT.get(split, run.seed))


def load_data(run: Run, name: str, split: str) -> Trajectories:
    """A split that is made."""
    path = run.require(f"data/{name}/{split}")
    return artifacts.load_trajectories(path, expect=fingerprint(env_id(name)))


def make_model(run: Run, name: str, word: str, path: Path) -> torch.nn.Module:
    """A model of the zoo trained by its schedule; a training that was killed goes on."""
    env, spec = env_id(name), zoo.find(word)
    train, held_out = (load_data(run, name, split) for split in ("train", "validation"))
    if spec.group != "prior" and copies(env) > 1:
        train = symmetric(train)
    net = spec.load().for_data(train, seed=run.seed, **spec.arguments(EnvSpec.parse(env)))
    stages = schedules.schedule(spec, EnvSpec.parse(env), run.pick(0.0, 0.5, 1.0))
    checkpoints = []
    for key, stage in zip(schedules.keys(stages), stages, strict=True):
        options = schedules.options(stage, net.past_len)
        if run.scale == "smoke":
            options = replace(options, batch_size=32, validate_every=10)
        checkpoints.append(path.with_name(f"{word}-{key}.checkpoint"))
        loss, title = getattr(net, stage.loss), f"{name} {word}: {key}"
        kept = {"checkpoint": checkpoints[-1], "progress": title}
        tsmlib.fit(net, train, held_out, options, loss, seed=run.seed, **kept)
    header = {"fingerprint": fingerprint(env), "model": word, "seed": run.seed, "scale": run.scale}
    header |= {"schedule": [asdict(stage) for stage in stages]}
    artifacts.save_model(path, net, header)
    for checkpoint in checkpoints:
        shutil.rmtree(checkpoint)
    return net


def load_model(run: Run, name: str, word: str) -> torch.nn.Module:
    """A model that is made; at scale laptop the one that ships."""
    path = run.require(f"models/{prior_of(name) if word == 'prior' else name}/{word}")
    return artifacts.load_model(path, zoo.find(word).load())


def load_prior(run: Run, name: str) -> ActionPrior:
    """The action prior of an arm, that of its kind with as many episodes."""
    return load_model(run, name, "prior")


def prior_of(name: str) -> str:
    """The arm whose prior is another's too, since equally many episodes hold the same torques."""
    return "ReacherObstacle" if EnvSpec.parse(env_id(name)).has_block else "Reacher"


def collection_rows(run: Run, name: str) -> list[Row]:
    """How far random torques go (table 01, claims C17 and C20)."""
    data = load_data(run, name, "train")
    about = place(env_id(name)) | {"split": "train", "n": len(data), "horizon": 100}
    about |= {"model": "none", "planner": "none"}
    tips, joints = data.states[:, 1:, 4:6], data.states[:, 1:, 2:4]
    hole, reach = abs(LINK_LENGTHS[1] - LINK_LENGTHS[0]), sum(LINK_LENGTHS)
    visited = cells_visited(tips, inner=hole, outer=reach)
    rows: list[Row] = [about | {"metric": "cells_visited", "value": visited, "unit": "share"}]
    for lag in LAGS:
        both = autocorrelation(joints, lag)
        value = float(both[np.abs(both).argmax()])
        rows.append(about | {"metric": "velocity_autocorrelation", "lag": lag, "value": value})
    return rows + [
        about | {"metric": metric, "value": value}
        for metric, value in shares(data.states, env_id(name)).items()
    ]


def gradient_rows(run: Run, name: str, word: str) -> list[Row]:
    """The largest relative error of the gradients of the return (table 02, claim C07)."""
    task = tsmlib.load_task(env_id(name)).take(CHECKED)
    net, prior = load_model(run, name, word), load_prior(run, name)
    errors = gradients.of_return(task, net, prior, seed=run.seed)
    about = {"env": task.env, "horizon": task.horizon, "n": len(task), "model": word}
    return [about | {"metric": "gradient_error", "value": max(errors.values()), "unit": "ratio"}]
