"""Measurement of the explorer; docs/explorer.md tells the numbers.

    python explorer/measure.py [--targets 100] [parity] [plans] [closed] [drags] [page]

parity: largest differences of the page from Python, over 100 frozen starts, and CPU time of a try.
plans: returns of open-loop plans for the frozen targets, in the page and in Python.
closed: success of closed loops over random scenes.
drags: of 20 random scenes, as the page plans after a first drag.
page: times, sizes and accessibility in Chromium, by test/measure.mjs.

Each is kept in measured.json. The page must be built.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from reproduction import explorer
from tsmlib.collection import smooth_torques
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import rollout
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.planning.closed_loop import mpc
from tsmlib.planning.execution import Trial, execute
from tsmlib.planning.planners import cem, reevaluate
from tsmlib.planning.predictors import fresh_predictor, model_predictor
from tsmlib.planning.search_spaces import LatentActions
from tsmlib.planning.tasks import Task
from tsmlib.pretrained import draw_task, load_pretrained, load_task
from tsmlib.storage import files

HERE = Path(__file__).parent
MEASURED = HERE / "measured.json"
ENV = "tsm/ReacherPush-v1"
BUSY = 4  # load beyond which times by the clock say nothing
OPEN = {"candidates": 64, "iterations": 6}  # src/session.js
AGAIN = {"candidates": 64, "iterations": 4}
FEWEST = {"candidates": 12, "iterations": 4}  # to which a slow machine falls back
SEEDS = 4  # of Python's planner
CLOSED_SEEDS = 2  # of both planners, in closed loops
DRAGS = 22  # seed of the random scenes


def ask(*questions: dict[str, Any]) -> list[Any]:
    """The answers of test/engine.mjs."""
    command = ["node", str(HERE / "test" / "engine.mjs")]
    done = subprocess.run(
        command, input=json.dumps(questions), capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


def of_pushing() -> tuple[RecurrentTSM, ActionPrior]:
    model, prior = (load_pretrained(word, env=ENV) for word in ("rtsm", "prior"))
    assert isinstance(model, RecurrentTSM)
    assert isinstance(prior, ActionPrior)
    return model, prior


def parity() -> dict[str, Any]:
    """Largest differences: states of `rtsm` after 50 steps, and of MuJoCo after 100."""
    task, (model, _) = load_task(ENV), of_pushing()
    actions = smooth_torques(len(task), 100, generator=torch.Generator().manual_seed(5))
    env: Any = gymnasium.make_vec(ENV, num_envs=len(task)).unwrapped
    env.reset(options={"states": task.start})
    true = env.rollout(actions.numpy())
    asked = {"what": "physics", "task": "push", "starts": task.start.astype(float).tolist()}
    (found,) = ask(asked | {"actions": actions.flatten(1).tolist()})
    physics = np.abs(np.array(found).reshape(true.shape) - true)[..., [0, 1, 4, 5, 6, 7]].max()
    past, actions = task.past(10), actions[:, :50]
    pasts = [
        {"states": x.flatten().tolist(), "actions": u.flatten().tolist()}
        for x, u in zip(*past, strict=True)
    ]
    asked = {"what": "rollout", "task": "push", "model": "rtsm", "pasts": pasts}
    (found,) = ask(asked | {"actions": actions.flatten(1).tolist()})
    expected = rollout(model, past, actions).numpy()
    difference = np.abs(np.array(found).reshape(expected.shape) - expected)[..., [0, 1, 4, 5, 6, 7]]
    cpu = in_page(task.take(10), seed=1, first=OPEN, rounds=1)["cpu"]
    return {"n": len(task), "physics": float(physics), "model": float(difference.max()), "cpu": cpu}


def plans(targets: int) -> dict[str, Any]:
    task, (model, prior) = load_task(ENV).take(targets), of_pushing()
    space, predict = LatentActions(prior, task.horizon), model_predictor(model, task.past(10))
    python = []
    for seed in range(SEEDS):
        plan = cem(predict, task.reward, space, len(task), elites=6, seed=seed, **OPEN)
        plan = reevaluate(plan, fresh_predictor(model, task.past(10), seed=seed + 1), task.reward)
        python.append(
            said(execute(task, plan)) | {"predicted": float(plan.predicted_return.mean())}
        )
    return {
        "n": len(task),
        "python": python,
        "page": [in_page(task, seed=1000 * k, first=OPEN, rounds=1) for k in (1, 2)],
    }


def closed(targets: int) -> list[dict[str, Any]]:
    """A run by page and by Python with each search and seed, kept as soon as it is done.

    Fewer targets are the first ones of more.
    """
    runs: list[dict[str, Any]] = read().get("closed", [])
    task = draw_task(ENV, seed=DRAGS, n=targets)
    done = {(run["n"], run["by"], run["search"], run["seed"]) for run in runs}
    for k in range(CLOSED_SEEDS):
        for again in (FEWEST, AGAIN):
            for by, seed in (("page", 1000 * (k + 1)), ("python", k)):
                search = f"{again['candidates']} x {again['iterations']}"
                if (targets, by, search, seed) not in done:
                    run = (closed_in_page if by == "page" else closed_in_python)(task, again, seed)
                    runs.append({"n": targets, "by": by, "search": search, "seed": seed} | run)
                    keep("closed", runs)
    return runs


def drags() -> dict[str, Any]:
    """A first drag, as shipped: planned again every ten steps; and the one-step model's plan."""
    task = draw_task(ENV, seed=DRAGS, n=20)
    onestep = {"model": "onestep", "space": "direct"}
    return {
        "n": len(task),
        "first": in_page(task, seed=1, replan=True),
        "one-step model, any torques": in_page(task, seed=1, **onestep),
    }


def closed_in_page(task: Task, again: dict[str, int], seed: int) -> dict[str, float]:
    return in_page(task, seed=seed, first=OPEN, again=again, replan=True)


def closed_in_python(task: Task, again: dict[str, int], seed: int) -> dict[str, float]:
    model, prior = of_pushing()
    space, predict = LatentActions(prior, task.horizon), model_predictor(model, task.past(10))
    first = cem(predict, task.reward, space, len(task), elites=6, seed=seed, **OPEN)
    planner = partial(
        cem, elites=max(2, again["candidates"] // 10), seed=seed, **again
    )  # as many as in the page
    return said(mpc(task, model, space, planner, plan=first, seed=seed))


def in_page(task: Task, **asked: Any) -> dict[str, float]:
    """Means over the targets of a task, planned and executed in the page's own code."""
    asked = {"what": "plan", "task": "push", "model": "rtsm", "space": "latent"} | asked
    (found,) = ask(
        asked | {"starts": task.start.astype(float).tolist(), "targets": task.target.tolist()}
    )
    return {
        word: float(np.mean([one[word] for one in found]))
        for word in ("predicted", "executed", "success", "cpu")
    }


def said(trial: Trial) -> dict[str, float]:
    assert trial.success is not None
    return {
        "executed": float(trial.executed_return.mean()),
        "success": float(trial.success.float().mean()),
    }


def page() -> dict[str, Any]:
    """Where the machine is busy, times by the clock stay those of the measurement before."""
    with explorer.server(port=0) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        command = [
            "node",
            str(HERE / "test" / "measure.mjs"),
            f"http://127.0.0.1:{running.server_port}/",
        ]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        running.shutdown()
        thread.join()
    done.check_returncode()
    found = json.loads(done.stdout) | {
        "load": round(os.getloadavg()[0], 1),
        "processors": os.cpu_count(),
    }
    if found["load"] > BUSY and (before := read().get("page")):
        lasting = ("gzip_bytes", "plan_cpu_ms", "longest_task_ms", "violations", "looked_at")
        found |= {word: value for word, value in before.items() if word not in lasting}
    return found


def read() -> dict[str, Any]:
    return json.loads(MEASURED.read_text()) if MEASURED.exists() else {}


def keep(part: str, found: object) -> None:
    """Write what a part measured, and leave the others as they are."""
    files.write_bytes(MEASURED, (json.dumps(read() | {part: found}, indent=1) + "\n").encode())


@torch.no_grad()
def main(asked: list[str], targets: int) -> None:
    parts: dict[str, Callable[[], object]] = {
        "parity": parity,
        "plans": partial(plans, targets),
        "closed": partial(closed, targets),
        "drags": drags,
        "page": page,
    }
    for part in [word for word in parts if word in asked or not asked]:
        keep(part, parts[part]())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Measure the explorer, into measured.json.")
    parser.add_argument("parts", nargs="*", choices=["parity", "plans", "closed", "drags", "page"])
    parser.add_argument("--targets", type=int, default=100)
    arguments = parser.parse_args()
    main(arguments.parts, arguments.targets)
