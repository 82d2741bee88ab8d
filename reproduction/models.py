"""Trained models at a run's scale; trained where they are missing. Which there are, and how trained: ``zoo``."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol, Self, TypedDict, cast

import torch
from torch import Tensor

from tsmlib.envs.spec import EnvSpec
from tsmlib.envs.symmetry import copies, symmetric
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import DynamicsModel
from tsmlib.models.tsm import TSM
from tsmlib.stacked_training import fit_stacked, stacked
from tsmlib.storage import artifacts, manifest
from tsmlib.storage.files import Json, StoreError
from tsmlib import zoo
from reproduction.data import dataset, fingerprint, remade_by
from reproduction.runs import ROOT, Run
from reproduction.seeds import make_as_one, require_seeds
from tsmlib.training.fit import fit
from tsmlib.trajectory import Trajectories

if TYPE_CHECKING:
    import pandas as pd  # of the extra "study", which a pretrained model does not need

PRETRAINED = ROOT / "data" / "pretrained"


class TrainedCurve(TypedDict):
    """A ``TrainingHistory`` as JSON."""

    step: list[int]
    seconds: list[float]
    train: list[float]
    validation: list[float]
    bf16: list[bool]
    resumed: list[str]


class Header(TypedDict, total=False):
    """What the file of a trained model says of itself. curves, bf16: by the keys of its stages (``zoo.keys``).

    seconds: of the CPU; of ``copies`` that were trained as one on a ``processor``, by the clock and of all together.
    """

    fingerprint: dict[str, Json]
    model: str
    seed: int
    scale: str
    curves: dict[str, TrainedCurve]
    schedule: list[dict[str, Json]]
    symmetries: int
    bf16: list[str]
    torch: str
    threads: int
    device: str
    finished: str
    seconds: float
    copies: int
    processor: str
    inputs: dict[str, str]


class TrainedModel(DynamicsModel, Protocol):
    """A dynamics model that is an ``nn.Module``."""

    def state_dict(self) -> dict[str, Tensor]: ...

    def to(self, device: str) -> Self: ...


class Trained(NamedTuple):
    """A trained model, and the header of its file: curves, seconds, seed, scale, schedule."""

    model: TrainedModel
    header: Header


def schedule(run: Run, env: str, model: str) -> list[zoo.Updates]:
    """How a model is trained at a run's scale: laptop has half the budget of paper, smoke next to nothing."""
    return zoo.find(model).schedule(EnvSpec.parse(env), _share(run))


def load_or_train(run: Run, env: str, model: str) -> Trained:
    """A trained model of the zoo, by its word.

    From the run's folder; else, at scale laptop with seed 0, from the shipped models; else trained now. Raises
    StoreError for a file of another environment, word, class or schedule, and for one in the run's folder of another
    seed or scale.
    """
    return _kept(run, env, model) or train(
        run, trained_on(env, model), model, _path(run, env, model)
    )


def load_or_train_as_one(runs: Sequence[Run], env: str, model: str) -> list[Trained]:
    """``load_or_train`` of runs with several seeds; those that lack the model are trained as one (``make_as_one``), for
    a GPU."""
    return make_as_one(
        f"{env}: {model}",
        runs,
        lambda run: not any(path.exists() for path in _places(run, env, model)),
        lambda lacking: train_as_one(lacking, trained_on(env, model), model),
        lambda run: load_or_train(run, env, model),
    )


def _path(run: Run, env: str, model: str) -> Path:
    """Where a run keeps a model."""
    folder = run.folder(f"models/{EnvSpec.parse(trained_on(env, model)).name}")
    return folder / f"{zoo.find(model).word}.safetensors"


def _places(run: Run, env: str, model: str) -> list[Path]:
    """Where a model may be: the run's own, and the shipped one."""
    own = _path(run, env, model)
    shipped = run.shipped / own.parent.name / own.name
    return [own, shipped] if run.scale == "laptop" and run.seed == 0 else [own]


def _kept(run: Run, env: str, model: str) -> Trained | None:
    """A model that is there; see ``load_or_train``."""
    env = trained_on(env, model)
    for path in _places(run, env, model):
        if path.exists():
            header = cast(Header, artifacts.read_header(path))
            trained_at = replace(run, scale=header.get("scale", run.scale))
            planned = [stage.stated() for stage in schedule(trained_at, env, model)]
            if header.get("model") != model:
                raise StoreError(
                    f"{path} holds {header.get('model')!r}, expected {model!r}; restore or delete it"
                )
            net = _load(path, env, model)
            asked, made = (run.seed, run.scale), (header.get("seed", run.seed), trained_at.scale)
            if path == _path(run, env, model) and made != asked:
                raise StoreError(
                    f"{path} was trained with seed {made[0]} at scale {made[1]}, expected seed {asked[0]} at scale "
                    f"{asked[1]}. Move it to the run of its own seed and scale, or delete it to train one here"
                )
            if (found := zoo.stated(header.get("schedule", planned))) != planned:
                raise StoreError(
                    f"{path} was trained by another schedule: {found}, expected {planned}. Restore or delete it"
                )
            if (turned := header.get("symmetries", 1)) != (wanted := _symmetries(env, model)):
                raise StoreError(
                    f"{path} was trained on {turned} symmetric copies of its data, expected {wanted}. Restore it"
                )
            return Trained(net, header)
    return None


def load_prior(run: Run, env: str) -> ActionPrior:
    """The action prior of an environment, as ``load_or_train`` finds it."""
    return cast(ActionPrior, load_or_train(run, env, "prior").model)


def load_pretrained(model: str, *, env: str) -> TrainedModel:
    """A model that comes with the package, by its word in the zoo and the id of its environment.

    ValueError naming what there is.
    """
    folder = PRETRAINED / EnvSpec.parse(trained_on(env, zoo.find(model).word)).name
    if not (path := folder / f"{model}.safetensors").exists():
        there = [path.stem for path in sorted(folder.glob("*.safetensors")) if path.stem in zoo.ZOO]
        known = f"there are {', '.join(there)}" if there else "there are none"
        raise ValueError(f"no pretrained {model} of {env} in {folder}: {known}.")
    return _load(path, trained_on(env, model), model)


def train_all(run: Run, wanted: Iterable[tuple[str, str]]) -> dict[tuple[str, str], Trained]:
    """(env, model) -> the trained model."""
    return {pair: load_or_train(run, *pair) for pair in wanted}


def described(trained: Mapping[tuple[str, str], Trained]) -> pd.DataFrame:
    """What was trained, as texts: parameters, updates, CPU seconds (older files: unknown), scale."""
    import pandas as pd

    lines = []
    for (env, model), (net, header) in trained.items():
        parameters = sum(weights.numel() for weights in cast(torch.nn.Module, net).parameters())
        updates = sum(curve["step"][-1] for curve in header["curves"].values())
        seconds = f"{header['seconds']:.0f}" if "schedule" in header else ""
        if "copies" in header:
            seconds += f" ({header['copies']} as one, by the clock, {header['processor']})"
        counts = {"parameters": f"{parameters:,}", "updates": f"{updates:,}"}
        lines.append(
            {"env": env, "model": model, **counts, "CPU seconds": seconds, "scale": header["scale"]}
        )
    return pd.DataFrame(lines)


def trained_on(env: str, model: str) -> str:
    """The environment; of the prior, since equally many episodes hold the same torques, one with as many."""
    if zoo.find(model).group != "prior":
        return env
    return "tsm/ReacherObstacle-v0" if EnvSpec.parse(env).has_block else "tsm/Reacher-v0"


def _load(path: Path, env: str, model: str) -> TrainedModel:
    with remade_by(f"python -m tsmlib run train -p env={env} -p models={model}", path):
        return cast(
            TrainedModel,
            artifacts.load_model(path, zoo.find(model).load(), expect=fingerprint(env)),
        )


def train(run: Run, env: str, model: str, path: Path) -> Trained:
    """Train a model by its schedule and store it at ``path``. Resumes from checkpoints beside it."""
    print(
        f"{env}: no trained {model} at scale {run.scale}; training it now, {_duration(run, env, model)}"
    )
    data, held_out = training_data(run, env, model)
    net, name = initialise(run, model, data), EnvSpec.parse(env).name
    stages, curves = schedule(run, env, model), {}
    checkpoints = _checkpoints(path, stages)
    for key, stage, checkpoint in zip(zoo.keys(stages), stages, checkpoints, strict=True):
        curve = fit(
            cast(torch.nn.Module, net),
            getattr(net, stage.loss),
            data,
            held_out,
            stage.options(net.past_len, **_fewer(run)),
            seed=run.seed,
            device=run.device,
            checkpoint=checkpoint,
            progress=f"{name} {model}: {key}",
        )
        curves[key] = asdict(curve)
    artifacts.save_model(path, net, _header(run, env, model, curves, path))
    for checkpoint in checkpoints:
        shutil.rmtree(checkpoint)
    return Trained(net, cast(Header, artifacts.read_header(path)))


def _checkpoints(path: Path, stages: Sequence[zoo.Updates]) -> list[Path]:
    """Of each stage of a training whose model is stored at ``path``."""
    return [path.with_name(f"{path.stem}-{key}.checkpoint") for key in zoo.keys(stages)]


def _fewer(run: Run) -> dict[str, float | tuple[float, float]]:
    """Options of ``fit`` that are smaller at scale smoke."""
    return {"batch_size": 32, "validate_every": 10} if run.scale == "smoke" else {}


def _header(
    run: Run,
    env: str,
    model: str,
    curves: Mapping[str, Mapping[str, Json]],
    path: Path,
    *,
    copies: int = 0,
) -> dict[str, Json]:
    """Of the file of a trained model."""
    ends = [cast(TrainedCurve, curve)["seconds"][-1] for curve in curves.values()]
    header: dict[str, Json] = {
        "fingerprint": fingerprint(env),
        "model": model,
        "seed": run.seed,
        "scale": run.scale,
        "curves": dict(curves),
        "schedule": [stage.stated() for stage in schedule(run, env, model)],
        "symmetries": _symmetries(env, model),
        "bf16": [
            key for key, curve in curves.items() if any(cast(TrainedCurve, curve)["bf16"])
        ],  # as the CPU had it
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "device": run.device,
        "finished": time.strftime("%Y-%m-%d"),
        "seconds": sum(ends),
        "inputs": dict(_inputs(run, env, path)),
    }
    if copies:
        header["copies"] = copies
        header["processor"] = (
            "cpu" if run.device == "cpu" else torch.cuda.get_device_name(run.device)
        )
    return header


def train_as_one(
    runs: Sequence[Run], env: str, model: str, *, compiled: bool = False
) -> list[Trained]:
    """Train a model with the seeds of several runs as one (``fit_stacked``), and store each where its run finds it.

    For a GPU; on a CPU it gains little or nothing (docs/speed.md). compiled: of ``fit_stacked``. Nothing is kept of a
    training that is stopped. ValueError for runs of one seed or of several scales, for a model that is trained on the
    data of another environment, and where ``fit_stacked`` raises one.
    """
    require_seeds(runs)
    if (other := trained_on(env, model)) != env:
        raise ValueError(f"{model} of {env} is trained on {other}; name that environment")
    parts = [training_data(run, env, model) for run in runs]
    nets = [initialise(run, model, data) for run, (data, _) in zip(runs, parts, strict=True)]
    train, held_out = (
        stacked([data for data, _ in parts], nets[0].past_len, runs[0].device),
        parts[0][1],
    )
    stages, curves = schedule(runs[0], env, model), [dict[str, dict[str, Json]]() for _ in runs]
    title = f"{EnvSpec.parse(env).name} {model}, {len(runs)} seeds"
    for key, stage in zip(zoo.keys(stages), stages, strict=True):
        found = fit_stacked(
            [cast(torch.nn.Module, net) for net in nets],
            stage.loss,
            train,
            held_out,
            stage.options(nets[0].past_len, **_fewer(runs[0])),
            seeds=[run.seed for run in runs],
            device=runs[0].device,
            compiled=compiled,
            progress=f"{title}: {key}",
        )
        for own, curve in zip(curves, found, strict=True):
            own[key] = asdict(curve)
    made = []
    for run, net, own in zip(runs, nets, curves, strict=True):
        path = _path(run, env, model)
        artifacts.save_model(path, net, _header(run, env, model, own, path, copies=len(runs)))
        for checkpoint in _checkpoints(path, stages):  # of a training alone, which was stopped
            shutil.rmtree(checkpoint, ignore_errors=True)
        made.append(Trained(net, cast(Header, artifacts.read_header(path))))
    return made


def training_data(run: Run, env: str, model: str) -> tuple[Trajectories, Trajectories]:
    """What a model is trained on, with the symmetric copies where there are some; and the validation data."""
    data, held_out = dataset(run, env, "train"), dataset(run, env, "validation")
    return symmetric(data) if _symmetries(env, model) > 1 else data, held_out


def _share(run: Run) -> float:
    """The part of its budget that a model is trained for."""
    return run.pick(smoke=0.0, laptop=0.5, paper=1.0)


def training_seconds(run: Run, env: str, model: str) -> float:
    """The budget of a training."""
    return _share(run) * zoo.find(model).seconds(EnvSpec.parse(env))


def _duration(run: Run, env: str, model: str) -> str:
    """How long a training may take, in words."""
    if not (seconds := training_seconds(run, env, model)):
        return "a few updates"
    return f"about {max(1, round(seconds / 60))} min of one core. Stopped, it goes on from there the next time"


def _symmetries(env: str, model: str) -> int:
    """Symmetric copies of the data that a model is trained on; of the prior 1, since its training knows no states."""
    return copies(env) if zoo.find(model).group != "prior" else 1


def _inputs(run: Run, env: str, path: Path) -> dict[str, str]:
    """The data that a model in ``path`` was trained on: file, relative to the model, and SHA-256."""
    files = [
        run.data / EnvSpec.parse(env).name / f"{split}.safetensors"
        for split in ("train", "validation")
    ]
    return {
        Path(os.path.relpath(file, path.parent)).as_posix(): manifest.sha256(file) for file in files
    }


def initialise(run: Run, model: str, data: Trajectories) -> TrainedModel:
    """The model as training starts: new weights, and the statistics of the training data."""
    spec = zoo.find(model)
    made_for = cast(type[ActionPrior | TSM], spec.load())  # all classes of the zoo have it
    return cast(
        TrainedModel,
        made_for.for_data(data, seed=run.seed, **spec.arguments(EnvSpec.parse(data.env))),
    )
