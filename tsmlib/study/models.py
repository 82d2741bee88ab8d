"""Trained models at a run's scale: their words, training schedules and files; trained where they are missing."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from tsmlib.envs.spec import has_block, imperfections
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.baselines import LSTM, OneStep
from tsmlib.models.ensemble import Ensemble
from tsmlib.models.tsm import TSM
from tsmlib.storage import artifacts, manifest
from tsmlib.storage import files as files_storage
from tsmlib.study.data import dataset, fingerprint, short
from tsmlib.study.parallel import precompute
from tsmlib.study.runs import Run
from tsmlib.training.fit import fit
from tsmlib.trajectory import Trajectories

CLASSES: dict[str, Any] = {  # by the first part of a model's word; what follows a + is an option of the class
    "tsm": TSM, "onestep": OneStep, "multistep": OneStep, "lstm": LSTM, "ensemble": Ensemble, "prior": ActionPrior,
}  # fmt: skip
DYNAMICS = ("tsm", "tsm+energy", "tsm+energy+direct", "onestep", "multistep", "lstm", "ensemble", "ensemble+mse")
OURS = ("tsm", "tsm+energy", "tsm+energy+direct", "tsm+teacher", "tsm+direct", "prior")  # what 02 looks at
CHOICES: dict[str, dict[str, Any]] = {  # the paper's choices, one changed at a time
    "tsm+full": {"full_encoder": True}, "tsm+plain": {"plain": True}, "tsm+z4": {"latent_dim": 4},
    "tsm+z16": {"latent_dim": 16}, "tsm+h1": {"segment_len": 1},
    "tsm+h20": {"segment_len": 20, "dilations": (1, 2, 4, 8, 16, 8)},  # receptive field 2 H again
}  # fmt: skip
MODELS = (*dict.fromkeys((*DYNAMICS, *OURS, *CHOICES)),)
BUDGET = {  # seconds of training on one core at scale paper, the same for every dynamics model of an environment
    "Reacher": 80, "ReacherObstacle": 120, "ReacherPush": 290,
    "PymunkReacher": 40, "PymunkObstacle": 40, "PymunkPush": 60,
}  # fmt: skip


@dataclass(frozen=True)
class Stage:
    """One part of a training schedule: which loss of the model, for how many updates, over how long a future."""

    loss: str
    steps: int
    future_len: int = 20  # 2 H
    lr: float = 4e-3  # the best of 1e-3, 2e-3 and 4e-3 for every baseline, on validation
    batch: int = 256


def schedule(run: Run, env: str, model: str) -> list[Stage]:
    """How a model is trained: every dynamics model of an environment for about the same time on one core.

    tsm, tsm+energy: teacher forcing for a quarter of the time, then free-running over two chained segments by squared
    error and KL, or by the energy score. tsm+energy+direct: more teacher forcing, and a head that sees the state itself
    over a narrower stack. tsm+teacher, tsm+direct: ablations, teacher forcing alone, and that head with the paper's
    loss. CHOICES: as many updates as tsm. onestep, ensemble: one step ahead. multistep, lstm: free-running over 2 H
    steps. prior: free-running over two segments, its own budget.
    """
    if model == "prior":
        return [Stage("loss", run.pick(smoke=20, laptop=1500, paper=3000), lr=1e-3)]
    seconds = BUDGET[short(imperfections(env)[0])] * run.pick(smoke=0.0, laptop=0.5, paper=1.0)
    wide = has_block(env)

    def stage(loss: str, rate: float, share: float = 1.0, **options: Any) -> Stage:
        """rate: updates per second on one core of the machine that the published models were trained on."""
        return Stage(loss, max(20, 10 * round(seconds * share * rate / 10)), **options)

    teacher = stage("teacher_forced_loss", 20 if wide else 30, 0.25, future_len=10)
    longer = stage("teacher_forced_loss", 26, 0.4, future_len=10)
    free: dict[str, Any] = dict(share=0.75, lr=2e-3, batch=128)
    paper = [teacher, stage("loss", 10.5 if wide else 16, **free)]
    if model in CHOICES:
        return [replace(teacher, future_len=20), paper[1]] if model == "tsm+h20" else paper
    return {
        "tsm": paper,
        "tsm+energy": [teacher, stage("energy_loss", 6.9 if wide else 11, **free)],
        "tsm+direct": [longer, stage("loss", 11, **{**free, "share": 0.6})],
        "tsm+energy+direct": [longer, stage("energy_loss", 8, **{**free, "share": 0.6})],
        "tsm+teacher": [stage("teacher_forced_loss", 20 if wide else 30, future_len=10)],
        "onestep": [stage("loss", 36)],
        "multistep": [stage("multi_step_loss", 21)],
        "lstm": [stage("loss", 14.5)],
        "ensemble": [stage("loss", 33.3)],
        "ensemble+mse": [stage("loss", 33.3)],
    }[model]


def load_or_train(run: Run, env: str, model: str) -> tuple[Any, dict[str, Any]]:
    """A trained model, any of MODELS, and the header of its file (curves, seconds, seed, scale).

    From the run's folder; else, at scale laptop with seed 0, from the shipped models; else trained now. Raises
    store.StoreError for a file of another environment, word, class or schedule.
    """
    env = _trained_on(env, model)
    own = run.folder(f"models/{short(env)}") / f"{model}.safetensors"
    shipped = run.shipped / short(env) / f"{model}.safetensors"
    for path in [own, shipped] if run.scale == "laptop" and run.seed == 0 else [own]:
        if path.exists():
            header = artifacts.read_header(path)
            if header.get("model") != model:
                raise files_storage.StoreError(
                    f"{path} holds {header.get('model')!r}, expected {model!r}; restore or delete it"
                )
            planned = _plain(schedule(replace(run, scale=header.get("scale", run.scale)), env, model))
            if (found := header.get("schedule", planned)) != planned:
                raise files_storage.StoreError(
                    f"{path} was trained by another schedule: {found}, expected {planned}. Restore or delete it"
                )
            return artifacts.load_model(path, CLASSES[model.partition("+")[0]], expect=fingerprint(env)), header
    return train(run, env, model, own)


def precompute_models(run: Run, wanted: Iterable[tuple[str, str]]) -> None:
    """``precompute`` for models: each (env, model) that is wanted, once, the longest trainings first."""
    pairs = list(dict.fromkeys((_trained_on(env, model), model) for env, model in wanted))
    pairs.sort(key=lambda pair: -BUDGET[short(imperfections(pair[0])[0])])
    precompute(run, [(load_or_train, *pair) for pair in pairs], progress="models")


def _trained_on(env: str, model: str) -> str:
    """The environment; of the prior, since equally many episodes hold the same torques, one with as many."""
    if model != "prior":
        return env
    return "tsm/ReacherPush-v0" if has_block(env) else "tsm/Reacher-v0"


def train(run: Run, env: str, model: str, path: Path) -> tuple[Any, dict[str, Any]]:
    """Train ``model`` by its schedule and store it at ``path``. Resumes from checkpoints beside it."""
    print(f"{env}: no trained {model} at scale {run.scale}; training it now")
    data, held_out = dataset(run, env, "train"), dataset(run, env, "validation")
    net = initialise(run, model, data)
    curves = {}
    for stage in schedule(run, env, model):
        checkpoint = path.with_name(f"{model}-{stage.loss}.checkpoint")
        curve = fit(
            net, getattr(net, stage.loss), data, held_out,
            past_len=net.past_len, future_len=stage.future_len, steps=stage.steps, lr=stage.lr,
            batch_size=run.pick(smoke=32, laptop=stage.batch, paper=stage.batch),
            validate_every=run.pick(smoke=10, laptop=250, paper=250), seed=run.seed, bf16=bf16_pays(model, stage),
            device=run.device, checkpoint=checkpoint, progress=f"{short(env)} {model}: {stage.loss}",
        )  # fmt: skip
        curves[stage.loss] = asdict(curve)
    header = {
        "fingerprint": fingerprint(env), "model": model, "seed": run.seed, "scale": run.scale, "curves": curves,
        "schedule": _plain(schedule(run, env, model)), "torch": torch.__version__,
        "bf16": [stage.loss for stage in schedule(run, env, model) if bf16_pays(model, stage)],
        "threads": torch.get_num_threads(), "device": run.device, "finished": time.strftime("%Y-%m-%d"),
        "seconds": sum(c["seconds"][-1] for c in curves.values()),  # of processor time
        "inputs": _inputs(run, env, path),
    }  # fmt: skip
    artifacts.save_model(path, net, header)
    for stage in schedule(run, env, model):
        shutil.rmtree(path.with_name(f"{model}-{stage.loss}.checkpoint"))
    return net, artifacts.read_header(path)


def bf16_pays(model: str, stage: Stage) -> bool:
    """Whether products in bfloat16 are faster: not where a gated stack is run step by step (benchmarks/train.py)."""
    return stage.loss == "teacher_forced_loss" or model.partition("+")[0] not in ("tsm", "prior")


def _plain(stages: list[Stage]) -> list[dict[str, Any]]:
    """A schedule as it stands in a model's header."""
    return [asdict(stage) for stage in stages]


def _inputs(run: Run, env: str, path: Path) -> dict[str, str]:
    """The data that a model in ``path`` was trained on: file, relative to the model, and SHA-256."""
    files = [run.data / short(env) / f"{split}.safetensors" for split in ("train", "validation")]
    return {Path(os.path.relpath(file, path.parent)).as_posix(): manifest.sha256(file) for file in files}


def initialise(run: Run, model: str, data: Trajectories) -> Any:
    """The model as training starts: new weights, and the statistics of the training data."""
    with torch.random.fork_rng(devices=[]):  # torch layers draw their weights from the global generator
        torch.manual_seed(run.seed)
        return _new(model, data)


def _new(model: str, data: Trajectories) -> Any:
    states, actions = data.states, data.actions
    if model == "prior":
        return ActionPrior(actions.shape[2]).fit_scale(torch.from_numpy(actions))
    kind, _, option = model.partition("+")
    options: dict[str, Any] = {"gaussian": option != "mse"} if kind == "ensemble" else {}
    if kind == "tsm" and option.endswith("direct"):
        options = dict(channels=32, direct_channels=200)
    elif kind == "tsm" and has_block(data.env):
        options = dict(channels=64, head_channels=128)  # appendix A.1
    options |= CHOICES.get(model, {})
    net = CLASSES[kind](states.shape[2], actions.shape[2], angles=data.angles, **options)
    net.features.fit(torch.from_numpy(states))
    return net
