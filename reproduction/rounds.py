"""Rounds of planning, executing and learning, and models adapted to a changed arm (table 10)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import tsmlib
from reproduction.episodes import load_model, random_data
from reproduction.runs import HELD_OUT, Run, env_id
from reproduction.symmetry import symmetric
from reproduction.tables import Row, place
from tsmlib import zoo
from tsmlib.envs.spec import EnvSpec
from tsmlib.exploration.options import ExplorationOptions
from tsmlib.models.base import DynamicsModel
from tsmlib.planning.execution import without_unstable
from tsmlib.planning.predictors import JUDGING, expected_predictor, fresh_predictor, model_predictor
from tsmlib.planning.tasks import Task
from tsmlib.pretrained import draw_task
from tsmlib.trajectory import Trajectories

DATA = {"plans": "own plans", "random": "random episodes", "none": "no new episodes"}
WITHOUT_PRIOR = ("ensemble+mse",)  # as PETS plans
HORIZON = 100


@dataclass(frozen=True)
class World:
    """A robot that explores.

    Args:
        env: its id; rms: size of its random actions.
        task: (n, seed) -> starts.
        random: (n, seed) -> episodes of random actions.
        hidden: arguments of the models.
        augmented: training data -> with what its symmetries give.
    """

    env: str
    rms: float
    task: Callable[[int, int], Task]
    random: Callable[[int, int], Trajectories]
    hidden: dict[str, dict[str, int | bool]]
    augmented: Callable[[Trajectories], Trajectories] | None = None


def _swing_up(n: int, seed: int) -> Task:
    """Swinging the pendulum up; success is to end within 18 degrees of upright."""
    return Task.from_env(
        "Pendulum-v1",
        n=n,
        horizon=HORIZON,
        seed=seed,
        reward=lambda x, u: x[..., 0] - 0.01 * x[..., 2].square(),
        success=lambda x: x[:, -1, 0] > 0.95,
    )


def _swings(n: int, seed: int) -> Trajectories:
    return tsmlib.collect_random(
        "Pendulum-v1", n, horizon=HORIZON, seed=seed, rms=0.6, time_constant=0.3
    )


PUSH = "tsm/ReacherPush-v1"
WORLDS = {
    "Pendulum": World(
        "Pendulum-v1",
        0.6,
        _swing_up,
        _swings,
        {"rtsm": {"hidden": 48}, "lstm": {"hidden": 48}, "ensemble+mse": {"hidden": 128}},
    ),
    "ReacherPush": World(
        PUSH,
        0.1,
        lambda n, seed: draw_task(PUSH, seed=seed, n=n),
        lambda n, seed: random_data(PUSH, n, seed=seed),
        {"rtsm": {"hidden": 96}, "lstm": {}, "ensemble+mse": {}},
        symmetric,
    ),
}


@dataclass(frozen=True)
class Sizes:
    """Of a loop: first episodes, rounds, episodes and updates of each, starts that measure."""

    first: int
    rounds: int
    episodes: int
    before: int
    updates: int
    starts: int


SIZES = {
    "smoke": Sizes(6, 1, 2, 2, 2, 2),
    "laptop": Sizes(100, 2, 10, 600, 300, 10),
    "paper": Sizes(200, 5, 150, 4000, 2500, 100),
}


def round_rows(run: Run, name: str, loop: str) -> list[Row]:
    """A loop such as ``rtsm-plans``: a learner and what it learns from in each round.

    Round 0 is before it. A loop that was killed goes on from its folder with the same bits.
    """
    (word, data), world, sizes = loop.split("-"), WORLDS[name], SIZES[run.scale]
    train, held_out = _divided(world.random(sizes.first, 50_000 + 1000 * run.seed))
    model = zoo.find(word).load().for_data(train, seed=run.seed, **world.hidden[word])
    prior = None
    if word not in WITHOUT_PRIOR:
        prior = tsmlib.ActionPrior.for_data(train, seed=run.seed, channels=16)
    folder = run.path(f"rounds/{name}/{loop}").with_suffix("")
    _fitted(model, train, held_out, sizes.before, 20, run.seed, folder, world)
    if prior is not None:
        _fitted(prior, train, held_out, sizes.before // 4 + 1, 10, run.seed, folder, None)
    options = ExplorationOptions(
        model=_training(model.past_len, 20, sizes.updates),
        prior=None if prior is None else _training(10, 10, sizes.updates // 5 + 1),
        rounds=sizes.rounds,
        every=10,
        candidates=run.pick(4, 48, 64),
        elites=run.pick(2, 6, 8),
        iterations=run.pick(1, 3, 3),
        rms=world.rms,
    )
    measure = partial(_measured, world.task(sizes.starts, 1000), options, run.seed)
    zero = {"round": 0, "env_steps": 0, **measure(model, prior)}

    def episodes(k: int) -> Trajectories | None:
        return world.random(sizes.episodes, _seed(run, k)) if data == "random" else None

    found = tsmlib.explore(
        model,
        prior,
        train,
        held_out,
        lambda k: world.task(sizes.episodes, _seed(run, k)),
        options,
        seed=run.seed,
        folder=folder / "rounds",
        measure=measure,
        augmented=world.augmented,
        episodes=None if data == "plans" else episodes,
        progress=f"{name} {loop}",
    )
    about = place(world.env) | {"model": word, "planner": "cem", "execution": "closed loop"}
    about |= {"search_space": "latent" if prior else "direct", "configuration": DATA[data]}
    about |= {"horizon": HORIZON, "n": sizes.starts}
    rows: list[Row] = []
    for record in (zero, *found.records):
        steps = sizes.first * HORIZON + int(record["env_steps"])
        here = about | {"iteration": int(record["round"]), "env_steps": steps}
        rows += [
            here | {"metric": k.removeprefix("tested_"), "value": float(v)}
            for k, v in record.items()
            if k.startswith("tested_") and v == v
        ]
    return rows


def _measured(
    task: Task,
    options: ExplorationOptions,
    seed: int,
    model: DynamicsModel,
    prior: tsmlib.ActionPrior | None,
) -> dict[str, float]:
    """Planning again from the same starts after every round; an unstable episode has failed."""
    space = tsmlib.DirectActions(HORIZON, task.action_dim, rms=options.rms)
    if prior is not None:
        space = tsmlib.LatentActions(prior, HORIZON)
    planner = partial(
        tsmlib.cem,
        candidates=options.candidates,
        elites=options.elites,
        iterations=options.iterations,
        seed=seed,
    )
    stable = without_unstable(
        task, lambda left, _: tsmlib.mpc(left, model, space, planner, every=options.every)
    )
    found = {"tested_lost": float(stable.lost), "tested_success": 0.0}
    if (trial := stable.found) is not None:
        reached = float(trial.success.float().mean()) * len(stable.kept) / len(task)
        found |= {"tested_success": reached, "tested_gap_absolute": float(trial.gap.abs().mean())}
        found["tested_return_true"] = float(trial.executed_return.mean())
        if task.position is not None:
            found["tested_final_distance"] = float(trial.final_distance.mean())
    return found


# Adaptation -------------------------------------------------------------------------------------

UPDATES = {"rtsm": (120, 300), "lstm": (300, 800), "ensemble+mse": (300, 800)}  # tuned, scratch
RATES = {"all": 1e-3, "head": 1e-3, "codes": 0.1}
FEW_SEED = 2_000_000  # of the few episodes, which no shipped model has seen


def adapted_rows(run: Run, name: str, way_name: str) -> list[Row]:
    """A model of the standard arm on a changed one, such as ``rtsm-all-20``.

    The ways are ``zero`` (as it is), ``all``, ``head`` and ``codes`` (fine-tuning of that part)
    and ``scratch`` (a new model), with so many episodes of the changed arm.
    """
    word, way, count = way_name.split("-")
    env, episodes = env_id(name), int(count)
    standard = name.partition("-")[0]
    net = load_model(run, standard, word)
    train, held_out = _divided(random_data(env, max(5, episodes), seed=FEW_SEED + run.seed))
    train, share = symmetric(train), run.pick(0.0, 0.3, 1.0)
    tuned, scratch = (max(2, round(share * n)) for n in UPDATES.get(word, (300, 800)))
    if way == "scratch":
        spec = zoo.find(word)
        arguments = spec.arguments(EnvSpec.parse(env))
        net = spec.load().for_data(train, seed=run.seed, **arguments)
        options = _training(net.past_len, 20, scratch, 0.02)
        tsmlib.fit(net, train, held_out, options, seed=run.seed)
    elif way != "zero":
        options = _training(net.past_len, 20, tuned, lr=RATES[way])
        tsmlib.fine_tune(net, train, held_out, options, part=way, seed=run.seed)
    n = run.pick(4, 50, 100)
    tests = [random_data(env, n, seed=HELD_OUT[split]) for split in ("test", "validation")]
    units = tsmlib.load_pretrained("lstm", env=env_id(standard)).features
    scores = tsmlib.score(net, units, *tests, samples=32, horizon=80, starts=(10,), seed=run.seed)
    curves = scores.against_horizon()
    about: Row = {"env": env, "sim": EnvSpec.parse(env).simulator, "model": word}
    about |= {"configuration": "zero-shot" if way == "zero" else way, "n": n}
    about |= {"env_steps": 0 if way == "zero" else 100 * episodes, "execution": "open loop"}
    rows = [
        about
        | {"planner": "none", "metric": metric, "steps_ahead": h}
        | {"value": float(curves[metric][h - 1])}
        for metric in ("energy_score_noise", "nrmse")
        for h in (10, 80)
    ]
    task = tsmlib.load_task(env).take(run.pick(2, 10, 50))
    prior = load_model(run, "ReacherObstacle" if "Push" in name else "Reacher", "prior")
    space, past = tsmlib.LatentActions(prior, task.horizon), task.past(net.past_len)
    judge = expected_predictor if net.stochastic else model_predictor
    predict = judge(net, past, seed=1000 + run.seed)
    candidates = run.pick(8, 96, 96)
    search = {"candidates": candidates, "elites": max(2, candidates // 10), "iterations": 5}
    plan = tsmlib.cem(predict, task.reward, space, len(task), seed=run.seed, **search)
    fresh = fresh_predictor(net, past, seed=1000 + run.seed)
    trial = tsmlib.execute(task, tsmlib.reevaluate(plan, fresh, task.reward))
    about |= {"planner": "cem", "search_space": "latent", "task": task.name, "n": len(task)}
    about |= {"samples": JUDGING if net.stochastic else None}
    means = {"return_true": trial.executed_return, "gap_absolute": trial.gap.abs()}
    means["success"] = (trial.final_distance <= task.tolerance).float()
    return rows + [about | {"metric": k, "value": float(v.mean())} for k, v in means.items()]


def _divided(data: Trajectories) -> tuple[Trajectories, Trajectories]:
    """Training and held-out episodes, one in five."""
    n = max(1, len(data) // 5)
    return data.take(slice(n, None)), data.take(slice(n))


def _training(
    past_len: int, future_len: int, steps: int, muon: float = 0.0, *, lr: float = 2e-3
) -> tsmlib.TrainingOptions:
    return tsmlib.TrainingOptions(
        past_len,
        future_len,
        steps,
        batch_size=64,
        lr=lr,
        muon=muon,
        warmup=min(20, steps),
        validate_every=max(1, steps // 4),
    )


def _fitted(
    net: DynamicsModel,
    train: Trajectories,
    held_out: Trajectories,
    steps: int,
    future_len: int,
    seed: int,
    folder: Path,
    world: World | None,
) -> None:
    data = world.augmented(train) if world and world.augmented else train
    muon = 0.01 if world and world.augmented else 0.0
    options = _training(net.past_len, future_len, steps, muon)
    kept = folder / f"{type(net).__name__}.checkpoint"
    tsmlib.fit(net, data, held_out, options, seed=seed, checkpoint=kept)


def _seed(run: Run, k: int) -> int:
    """Of the tasks, or the random episodes, of round k."""
    return 100_000 * (run.seed + 1) + 1000 * k
