"""Torques that 07_action_prior measures, of a run's data and prior, and the signal of gradients to them."""

from collections.abc import Sequence

import torch

from tsmlib.evaluation import actions, gradients
from tsmlib.models.action_prior import ActionPrior
from tsmlib.planning.base import SearchSpace
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.planning.tasks import Task
from tsmlib.study.data import dataset
from tsmlib.study.models import load_or_train
from tsmlib.study.results import table
from tsmlib.study.results.action_prior import Torques
from tsmlib.study.results.table import Row
from tsmlib.study.runs import Run
from tsmlib.study.zoo import method

TRAINED_ON = 500  # training episodes that others are measured against


def action_prior(run: Run, task: Task) -> ActionPrior:
    """The prior of a task's arm."""
    prior = load_or_train(run, task.env, "prior").model
    assert isinstance(prior, ActionPrior)
    return prior


def task_torques(run: Run, task: Task) -> Torques:
    """Held-out torques, samples of the prior, and the former reconstructed by it, each as long as the task."""
    train, held_out = (torch.from_numpy(dataset(run, task.env, split).actions) for split in ("train", "test"))
    prior, draw = action_prior(run, task), torch.Generator().manual_seed(run.seed)
    data = held_out[: len(held_out) // 2, : task.horizon]
    made = {
        "data": data,
        "sampled": actions.sample_actions(prior, len(data), task.horizon, draw),
        "reconstructed": actions.reconstruct(prior, data),
    }
    return Torques(task, train[:TRAINED_ON], held_out, made)


def gradient_rows(run: Run, task: Task, models: Sequence[str], *, samples: int) -> list[Row]:
    """Rows with a ``target``: signal-to-noise of the gradients of the return of ``models``, in both search spaces, over
    so many samples, at the starts of a task."""
    spaces: dict[str, SearchSpace] = {
        "latent": LatentActions(action_prior(run, task), task.horizon),
        "direct": DirectActions(task.horizon),
    }
    rows: list[Row] = []
    for model in models:
        net = load_or_train(run, task.env, model).model
        for word, space in spaces.items():
            about = table.of_task(task, run) | table.fields(method(model, word, "adam"))
            about |= dict(execution="open loop", metric="gradient_snr", n=samples)
            found = gradients.signal(task, net, space, samples=samples, seed=run.seed)
            rows += [dict(about, value=value, target=i) for i, value in enumerate(found.tolist())]
    return rows
