"""What the notebooks share: data sets, trained models and frozen tasks at a run's scale, made where they are missing.

Anything a notebook asks for is taken from its run's folder, else from what ships under ``data``, else made on the spot
with a progress bar. This is the only module that knows how much of everything each scale uses.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

import tsmlib.envs
from tsmlib import evaluate, rewards, scoreboard, store
from tsmlib.baselines import LSTM, Ensemble, OneStep
from tsmlib.collect import collect, once, smooth_torques
from tsmlib.control import TOLERANCE, Task, Trial, execute, random_torques, zero_torques
from tsmlib.envs import has_block
from tsmlib.policy import OneStepPolicy, SegmentPolicy, controller, episodes_from, imagine, improve
from tsmlib.prior import ActionPrior
from tsmlib.runs import ROOT, ParameterError, Run
from tsmlib.train import fit
from tsmlib.trajectory import Trajectories
from tsmlib.trajopt import (
    DirectActions,
    LatentActions,
    Plan,
    Space,
    adam,
    cem,
    reassess,
    sampled_starts,
    through_model,
    through_simulator,
)
from tsmlib.tsm import TSM

SPLITS = ("train", "validation", "test")
CLASSES: dict[str, Any] = {  # by the first part of a model's word; what follows a + is an option of the class
    "tsm": TSM, "onestep": OneStep, "multistep": OneStep, "lstm": LSTM, "ensemble": Ensemble, "prior": ActionPrior,
}  # fmt: skip
DYNAMICS = ("tsm", "tsm+energy", "tsm+energy+direct", "onestep", "multistep", "lstm", "ensemble", "ensemble+mse")
MODELS = (*DYNAMICS, "tsm+teacher", "prior")
OURS = tuple(word for word in MODELS if word.startswith(("tsm", "prior")))  # what 02 trains and looks at
BUDGET = {  # seconds of training on one core at scale paper, the same for every dynamics model of an environment
    "Reacher": 80, "ReacherObstacle": 120, "ReacherPush": 290,
    "PymunkReacher": 40, "PymunkObstacle": 40, "PymunkPush": 60,
}  # fmt: skip
HELD_OUT_SEED = {"validation": 1_000_001, "test": 1_000_002}  # the same for every run seed
TASK_SEED = {"validation": 1_000_003, "test": 1_000_004}
FROZEN = ROOT / "data" / "tasks"
RESULTS = ROOT / "data" / "results"


@dataclass(frozen=True)
class Stage:
    """One part of a training schedule: which loss of the model, for how many updates, over how long a future."""

    loss: str
    steps: int
    future_len: int = 20  # 2 H
    lr: float = 4e-3  # the best of 1e-3, 2e-3 and 4e-3 for every baseline, on validation
    batch: int = 256


def short(env: str) -> str:
    """Folder name of an environment: ReacherPush for tsm/ReacherPush-v0."""
    return env.partition("/")[2].partition("-")[0]


def chosen(parameter: str, text: str, known: Sequence[str]) -> list[str]:
    """The value of a notebook parameter that names one of ``known``, several with commas between, or all."""
    names = list(known) if text == "all" else [word.strip() for word in text.split(",")]
    if unknown := [word for word in names if word not in known]:
        raise ParameterError(f"{parameter} names {unknown[0]!r:.80}, expected some of {', '.join(known)}; or all.")
    return list(dict.fromkeys(names))


# Data ----------------------------------------------------------------------------------------------------------------


def sizes(run: Run, env: str) -> dict[str, int]:
    """Episodes per split: the paper's 500 on the basic arm and 5,000 elsewhere, 200 for validation, 1,000 for test."""
    full = {"train": 5000 if has_block(env) else 500, "validation": 200, "test": 1000}
    return run.pick(smoke={"train": 20, "validation": 8, "test": 8}, laptop=full, paper=full)


def dataset(run: Run, env: str, split: str) -> Trajectories:
    """One split of an environment's data, collected at the first call. Training data depend on the run's seed."""
    n = sizes(run, env)[split]
    path = run.folder(f"data/{short(env)}") / f"{split}.safetensors"
    if path.exists():
        return store.load_trajectories(path, env=env, expect=fingerprint(env))
    if run.seed in HELD_OUT_SEED.values():
        raise ParameterError(f"seed {run.seed} draws the held-out episodes; choose another one to train with")
    seed = HELD_OUT_SEED.get(split, run.seed)
    data = random_data(env, n, seed=seed)
    store.save_trajectories(
        path, data, {"split": split, "seed": seed, "scale": run.scale, "fingerprint": fingerprint(env)}
    )
    return data


def random_data(env: str, n: int, *, seed: int, horizon: int = 100) -> Trajectories:
    """``n`` episodes of smooth random torques, a function of (env, n, seed) alone."""
    copies = gymnasium.make_vec(env, num_envs=n)
    torques = smooth_torques(n, horizon, generator=torch.Generator().manual_seed(seed))
    data = collect(copies, once(torques), horizon=horizon, seed=seed)
    copies.close()
    return data


def fingerprint(env: str) -> dict[str, Any]:
    """What a model of this environment was made for; a file that says otherwise is refused."""
    return tsmlib.envs.fingerprint(env)


# Models --------------------------------------------------------------------------------------------------------------


def schedule(run: Run, env: str, model: str) -> list[Stage]:
    """How a model is trained: every dynamics model of an environment for about the same time on one core.

    tsm, tsm+energy: teacher forcing for a quarter of the time, then free-running over two chained segments by squared
    error and KL, or by the energy score. tsm+energy+direct: more teacher forcing, and a head that sees the state itself
    over a narrower stack. tsm+teacher: teacher forcing alone, the ablation. onestep, ensemble: one step ahead.
    multistep, lstm: free-running over 2 H steps. prior: free-running over two segments, its own budget.
    """
    if model == "prior":
        return [Stage("loss", run.pick(smoke=30, laptop=1500, paper=3000), lr=1e-3)]
    seconds = BUDGET[short(env)] * run.pick(smoke=0.0, laptop=0.5, paper=1.0)
    wide = has_block(env)

    def stage(loss: str, rate: float, share: float = 1.0, **options: Any) -> Stage:
        """rate: updates per second on one core of the machine that the published models were trained on."""
        return Stage(loss, max(30, 10 * round(seconds * share * rate / 10)), **options)

    teacher = stage("teacher_forced_loss", 20 if wide else 30, 0.25, future_len=10)
    free: dict[str, Any] = dict(share=0.75, lr=2e-3, batch=128)
    return {
        "tsm": [teacher, stage("loss", 10.5 if wide else 16, **free)],
        "tsm+energy": [teacher, stage("energy_loss", 6.9 if wide else 11, **free)],
        "tsm+energy+direct": [
            stage("teacher_forced_loss", 26, 0.4, future_len=10),
            stage("energy_loss", 8, 0.6, lr=2e-3, batch=128),
        ],
        "tsm+teacher": [stage("teacher_forced_loss", 20 if wide else 30, future_len=10)],
        "onestep": [stage("loss", 36)],
        "multistep": [stage("multi_step_loss", 21)],
        "lstm": [stage("loss", 14.5)],
        "ensemble": [stage("loss", 33.3)],
        "ensemble+mse": [stage("loss", 33.3)],
    }[model]


def load_or_train(run: Run, env: str, model: str) -> tuple[Any, dict[str, Any]]:
    """A trained model, any of MODELS, and the header of its file (curves, seconds, seed, scale).

    From the run's folder; else, at scale laptop with seed 0, from the shipped models; else trained now.
    """
    if model == "prior":  # equally many episodes hold the same torques, whatever the environment
        env = "tsm/ReacherPush-v0" if has_block(env) else "tsm/Reacher-v0"
    own = run.folder(f"models/{short(env)}") / f"{model}.safetensors"
    shipped = run.shipped / short(env) / f"{model}.safetensors"
    for path in [own, shipped] if run.scale == "laptop" and run.seed == 0 else [own]:
        if path.exists():
            header = store.read_header(path)
            if header.get("model") != model:
                raise store.StoreError(
                    f"{path} holds {header.get('model')!r}, expected {model!r}; restore or delete it"
                )
            return store.load_model(path, CLASSES[model.partition("+")[0]], expect=fingerprint(env)), header
    return train(run, env, model, own)


def train(run: Run, env: str, model: str, path: Path) -> tuple[Any, dict[str, Any]]:
    """Train ``model`` by its schedule and store it at ``path``. Resumes from checkpoints beside it."""
    print(f"{env}: no trained {model} at scale {run.scale}; training it now")
    data, held_out = dataset(run, env, "train"), dataset(run, env, "validation")
    net = fresh(run, model, data)
    curves = {}
    for stage in schedule(run, env, model):
        checkpoint = path.with_name(f"{model}-{stage.loss}.checkpoint")
        curve = fit(
            net, getattr(net, stage.loss), data, held_out,
            past_len=net.past_len, future_len=stage.future_len, steps=stage.steps, lr=stage.lr,
            batch_size=run.pick(smoke=32, laptop=stage.batch, paper=stage.batch),
            validate_every=run.pick(smoke=10, laptop=250, paper=250), seed=run.seed, bf16=True,
            checkpoint=checkpoint, progress=f"{short(env)} {model}: {stage.loss}",
        )  # fmt: skip
        curves[stage.loss] = asdict(curve)
    header = {
        "fingerprint": fingerprint(env), "model": model, "seed": run.seed, "scale": run.scale, "curves": curves,
        "seconds": sum(c["seconds"][-1] for c in curves.values()), "torch": torch.__version__,
        "threads": torch.get_num_threads(), "finished": time.strftime("%Y-%m-%d"),
        "inputs": _inputs(run, env, path),
    }  # fmt: skip
    store.save_model(path, net, header)
    for stage in schedule(run, env, model):
        shutil.rmtree(path.with_name(f"{model}-{stage.loss}.checkpoint"))
    return net, store.read_header(path)


def _inputs(run: Run, env: str, path: Path) -> dict[str, str]:
    """The data that a model in ``path`` was trained on: file, relative to the model, and SHA-256."""
    files = [run.data / short(env) / f"{split}.safetensors" for split in ("train", "validation")]
    return {Path(os.path.relpath(file, path.parent)).as_posix(): store.sha256(file) for file in files}


def fresh(run: Run, model: str, data: Trajectories) -> Any:
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
    net = CLASSES[kind](states.shape[2], actions.shape[2], angles=data.angles, **options)
    net.features.fit(torch.from_numpy(states))
    return net


# Predictions ---------------------------------------------------------------------------------------------------------


def scores(run: Run, env: str, model: str, *, segments: bool = False) -> evaluate.Scores:
    """``evaluate.score`` of a trained model on test episodes: open loop, or ``segments`` from the true past.

    Smoke 8 episodes and samples, laptop 200 episodes and 16 samples, paper 1,000 and 32. Scores are kept in the run's
    folder and found again as long as weights, data and sizes are the same.
    """
    net, _ = load_or_train(run, env, model)
    test, held_out = (dataset(run, env, split) for split in ("test", "validation"))
    test, held_out = (
        data.take(slice(run.pick(smoke=8, laptop=200, paper=n))) for data, n in ((test, 1000), (held_out, 200))
    )
    samples = run.pick(smoke=8, laptop=16, paper=32)  # of a model without samples: noisy copies
    options: dict[str, Any] = {"horizon": 90}
    if segments:
        options = {"horizon": 10, "starts": list(scoreboard.SEGMENTS)}
    path = run.folder(f"scores/{short(env)}") / f"{model}{'-segments' * segments}.safetensors"
    made_from = {
        "version": evaluate.VERSION, "rows": evaluate.ROWS, "samples": samples, "seed": run.seed, **options,
        "model": net.config(), "weights": store.digest(net.state_dict()),
        **{split: store.digest({"states": torch.from_numpy(data.states), "actions": torch.from_numpy(data.actions)})
           for split, data in (("test", test), ("validation", held_out))},
    }  # fmt: skip
    if path.exists() and store.read_header(path)["made_from"] == made_from:
        tensors, _ = store.load(path, kind="scores")
        return _unpacked(tensors)
    found = evaluate.score(
        net, net.features, test, held_out, samples=samples, seed=run.seed, **options,
        progress=f"{short(env)} {model}: {'segments' if segments else 'open loop'}",
    )  # fmt: skip
    tensors = {f"values.{metric}": value for metric, value in found.values.items()}
    tensors |= {f"fitted.{name}": torch.as_tensor(value) for name, value in asdict(found.fitted).items()}
    tensors |= {"pit": found.pit, "outside": found.outside}
    store.save(path, tensors, kind="scores", header={"made_from": made_from})
    return found


def evidence(run: Run, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows that this notebook's figures draw: all seeds there are, at the paper's sizes where they are to be had.

    Scale paper: the given rows and those of the other seeds beside this run. Laptop: the published ones, and the given
    rows of environments that are not among them. Smoke: the given rows.
    """
    name = f"{run.notebook}.csv"
    if run.scale == "laptop" and (RESULTS / name).exists():
        published = store.load_table(RESULTS / name)
        known = {row["env"] for row in published}
        return [*published, *(row for row in rows if row["env"] not in known)]
    if run.scale != "paper":
        return rows
    others = [path for path in sorted(run.dir.parent.glob(f"seed*/metrics/{name}")) if run.dir not in path.parents]
    return [*rows, *(row for path in others for row in store.load_table(path))]


def _unpacked(tensors: dict[str, torch.Tensor]) -> evaluate.Scores:
    values = {name.partition(".")[2]: tensor for name, tensor in tensors.items() if name.startswith("values.")}
    fitted = {name.partition(".")[2]: tensor for name, tensor in tensors.items() if name.startswith("fitted.")}
    numbers: dict[str, Any] = {name: tensor if tensor.ndim else float(tensor) for name, tensor in fitted.items()}
    return evaluate.Scores(values, tensors["pit"], tensors["outside"], evaluate.Fitted(**numbers))


# Tasks ---------------------------------------------------------------------------------------------------------------


def task(env: str, split: str = "test") -> Task:
    """100 starts and targets of an environment's task. ``test`` ones are frozen in data/tasks and choose nothing."""
    path = FROZEN / f"{short(env)}.safetensors"
    if split == "test" and path.exists():
        tensors, header = store.load(path, kind="task")
        return Task(header["task"], header["env"], tensors["start"].numpy(), tensors["target"])
    return draw_task(env, seed=TASK_SEED[split])


def draw_task(env: str, *, seed: int, n: int = 100) -> Task:
    """Starts from the environment's reset, targets uniform in the disc of radius 0.2 m."""
    copies = gymnasium.make_vec(env, num_envs=n)
    start, info = copies.reset(seed=seed)
    copies.close()
    name = "push" if "Push" in env else "reach"
    return Task(name, env, start.astype(np.float32), torch.from_numpy(info["target"]).float())


def freeze_tasks() -> None:
    """Write the test tasks of every environment into data/tasks. Done once; a test compares them with a new draw."""
    for env in tsmlib.envs.ENV_IDS:
        drawn = draw_task(env, seed=TASK_SEED["test"])
        path = FROZEN / f"{short(env)}.safetensors"
        path.parent.mkdir(parents=True, exist_ok=True)
        header = {"task": drawn.name, "env": env, "seed": TASK_SEED["test"]}
        store.save(path, {"start": drawn.start, "target": drawn.target}, kind="task", header=header)


# Plans ---------------------------------------------------------------------------------------------------------------


def trial(run: Run, task: Task, model: str, planner: str, prior: str, *, iterations: int = 0) -> Trial:
    """Plan with one method and execute open loop in the true simulator.

    model: any of DYNAMICS, or oracle (the true simulator), or none. planner: adam (from zero, as the paper),
    adam+starts (from the best of sampled candidates), cem; with model none: random or zero torques. prior: codes
    (Eq. 3) or actions (Eq. 2). iterations: of the planner; 0 means the scale's default.
    """
    if model == "none":
        return execute(task, {"random": random_torques, "zero": zero_torques}[planner](task))
    return execute(task, plan(run, task, model, planner, prior, iterations=iterations))


def plan(run: Run, task: Task, model: str, planner: str, prior: str, *, iterations: int = 0) -> Plan:
    """The plan alone; see ``trial``. ``predicted`` comes from 32 model samples that the planner did not see.

    Plans are kept in the run's folder and found again as long as task, models and budget are the same. At scale
    laptop the oracle's plans are those that ship in data/results, since it simulates every candidate.
    """
    if planner not in ("adam", "adam+starts", "cem") or prior not in ("codes", "actions") or iterations < 0:
        raise ValueError(
            f"planner is {planner!r}, prior {prior!r}, iterations {iterations}; expected adam, adam+starts or cem, "
            "codes or actions, and 0 (the scale's default) or more"
        )
    nets = {}
    if prior == "codes":
        nets["prior"], _ = load_or_train(run, task.env, "prior")
    if model != "oracle":
        nets["model"], _ = load_or_train(run, task.env, model)
    budget = (
        run.pick(smoke=8, laptop=96, paper=128),
        iterations
        or (run.pick(smoke=2, laptop=8, paper=12) if planner == "cem" else run.pick(smoke=3, laptop=100, paper=100)),
    )
    name = f"{short(task.env)}-{model}-{prior}-{planner}.safetensors"
    made_from = {
        "env": task.env, "horizon": task.horizon, "seed": run.seed, "candidates": budget[0], "iterations": budget[1],
        "weights": {word: store.digest(net.state_dict()) for word, net in nets.items()},
    }  # fmt: skip
    own, shipped = run.folder("plans") / name, RESULTS / name
    if own.exists() and store.read_header(own)["made_from"] == made_from and (kept := _kept(own, task)):
        return kept
    if model == "oracle" and run.scale == "laptop" and shipped.exists() and (kept := _kept(shipped, task, prefix=True)):
        return kept
    found = _search(run, task, planner, nets, *budget, bar=f"{task.name}: {model}, {planner} over {prior}")
    if model != "oracle":
        net = nets["model"]
        fresh_samples = through_model(net, task.past(net.past_len), samples=32, seed=run.seed + 1)
        found = reassess(found, fresh_samples, task.reward)
    arrays: dict[str, Any] = {
        "start": task.start, "target": task.target, "actions": found.actions, "parameters": found.parameters,
        "states": found.states[:1], "predicted": found.predicted, "curve": found.curve,
    }  # fmt: skip
    store.save(own, arrays, kind="plan", header={"made_from": made_from, "seconds": found.seconds})
    return found


def _search(
    run: Run, task: Task, planner: str, nets: dict[str, Any], candidates: int, iterations: int, *, bar: str
) -> Plan:
    began = time.perf_counter()
    space: Space = LatentActions(nets["prior"], task.horizon) if "prior" in nets else DirectActions(task.horizon)
    if "model" in nets:
        predict = through_model(nets["model"], task.past(nets["model"].past_len), samples=2, seed=run.seed)
    else:
        predict = through_simulator(task.env, task.start)
    if planner == "cem":
        found = cem(
            predict, task.reward, space, len(task),
            candidates=candidates, elites=max(2, candidates // 10), iterations=iterations, seed=run.seed, progress=bar,
        )  # fmt: skip
    else:
        start = torch.zeros(1, len(task), *space.shape)
        if planner == "adam+starts":
            start = sampled_starts(
                predict, task.reward, space, len(task), candidates=candidates, keep=2, seed=run.seed
            )  # fmt: skip
        found = adam(predict, task.reward, space, start, iterations=iterations, progress=bar)
    return replace(found, seconds=time.perf_counter() - began)


def _kept(path: Path, task: Task, *, prefix: bool = False) -> Plan | None:
    """The plan in ``path`` if it was made for this task, or, with ``prefix``, for more targets that begin with its."""
    tensors, header = store.load(path, kind="plan")
    n = len(task)
    same = np.array_equal(tensors["start"][:n].numpy(), task.start) and torch.equal(tensors["target"][:n], task.target)
    if not same or (len(tensors["start"]) != n and not prefix):
        return None
    return Plan(
        actions=tensors["actions"][:n], parameters=tensors["parameters"][:n], states=tensors["states"][:, :n],
        predicted=tensors["predicted"][:n], curve=tensors["curve"][:, :n], seconds=header["seconds"],
    )  # fmt: skip


# Policies ------------------------------------------------------------------------------------------------------------


def learn(
    run: Run, task: Task, model: str, prior: str, *, copies: int = 1, iterations: int = 0
) -> tuple[Any, dict[str, Any]]:
    """A policy learned inside a trained model, and the header of its file (learning curve, seconds, seed, scale).

    prior: codes (a SegmentPolicy, acting through the action prior) or actions (a OneStepPolicy). copies: learned side
    by side from different seeds. iterations: 0 means smoke 4, laptop 300, paper 2,200. Episodes start as those of the
    training data, so the environment is not asked. What the policy truly earns on ``task`` is measured at ten points
    along the way, beside what the model promises there (``assess``); neither has a part in learning.

    From the run's folder; else, at scale laptop with seed 0, the shipped one, whatever its copies and iterations; else
    learned now, going on from its checkpoint if it was stopped.
    """
    if prior not in ("codes", "actions") or iterations < 0 or copies < 1:
        raise ValueError(
            f"prior is {prior!r}, iterations {iterations}, copies {copies}; expected codes or actions, 0 (the scale's "
            "default) or more iterations, and at least one copy"
        )
    net, _ = load_or_train(run, task.env, model)
    nets = {"model": net} | ({"prior": load_or_train(run, task.env, "prior")[0]} if prior == "codes" else {})
    name, cls = f"policy-{model}-{prior}.safetensors", SegmentPolicy if prior == "codes" else OneStepPolicy
    own, shipped = run.folder(f"models/{short(task.env)}") / name, run.shipped / short(task.env) / name
    weights = {word: store.digest(net.state_dict()) for word, net in nets.items()}
    made_from = {"task": task.name, "horizon": task.horizon, "seed": run.seed, "weights": weights}
    budget = {"copies": copies, "iterations": iterations or run.pick(smoke=4, laptop=300, paper=2200)}
    for path in [own, shipped] if run.scale == "laptop" and run.seed == 0 else [own]:
        if path.exists():
            header = store.read_header(path)
            if header.get("made_from") == made_from and (path == shipped or header.get("budget") == budget):
                return store.load_model(path, cls, expect=fingerprint(task.env)), header
    print(f"{task.env}: no policy learned in {model} through {prior} at scale {run.scale}; learning it now")
    data = dataset(run, task.env, "train")
    options: dict[str, Any] = dict(angles=data.angles, copies=copies, seed=1000 * run.seed)
    if prior == "codes":
        policy: Any = SegmentPolicy(data.states.shape[2], nets["prior"], **options)
    else:
        policy = OneStepPolicy(data.states.shape[2], data.actions.shape[2], **options)
    policy.features.fit(torch.from_numpy(data.states))
    checkpoint = own.with_name(f"policy-{model}-{prior}.checkpoint")
    curve = improve(
        policy, net, rewards.reach if task.name == "reach" else rewards.push,
        episodes_from(torch.from_numpy(data.states[:, 0])), horizon=task.horizon, iterations=budget["iterations"],
        episodes=run.pick(smoke=4, laptop=20, paper=20), seed=1000 * run.seed,
        record_every=max(1, budget["iterations"] // 10), measure=lambda p: assess(p, net, task, seed=run.seed + 1),
        checkpoint=checkpoint, progress=f"{short(task.env)} policy in {model} through {prior}",
    )  # fmt: skip
    header = {
        "fingerprint": fingerprint(task.env), "made_from": made_from, "budget": budget, "model": model, "prior": prior,
        "seed": run.seed, "scale": run.scale, "curve": asdict(curve), "seconds": curve.seconds[-1],
        "torch": torch.__version__, "threads": torch.get_num_threads(), "finished": time.strftime("%Y-%m-%d"),
    }  # fmt: skip
    store.save_model(own, policy, header)
    shutil.rmtree(checkpoint)
    return policy, store.read_header(own)


@torch.no_grad()
def assess(policy: Any, model: Any, task: Task, *, seed: int) -> dict[str, torch.Tensor]:
    """What a policy earns on a task and what the model promises there, without action noise: means, one per copy."""
    many = task.times(policy.copies)
    done = execute(many, controller(policy, many.target))
    start, draw = torch.from_numpy(many.start).float(), torch.Generator().manual_seed(seed)
    promised = many.reward(*imagine(policy, model, start, many.target, horizon=task.horizon, noise=0.0, generator=draw))
    found = {
        "return_true": done.true, "return_predicted": promised.sum(-1), "final_distance": done.final_distance,
        "success": (done.final_distance < TOLERANCE).float(),
    }  # fmt: skip
    return {name: values.unflatten(0, (policy.copies, -1)).mean(1) for name, values in found.items()}
