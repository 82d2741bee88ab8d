"""Torques that 07_action_prior measures, of a run's data and prior."""

import torch

from tsmlib.evaluation import actions
from tsmlib.planning.tasks import Task
from reproduction.data import dataset
from reproduction.models import load_prior
from reproduction.results.action_prior import Torques
from reproduction.runs import Run

TRAINED_ON = 500  # training episodes that others are measured against


def task_torques(run: Run, task: Task) -> Torques:
    """Held-out torques, samples of the prior, and the former reconstructed by it, each as long as the task."""
    train, held_out = (
        torch.from_numpy(dataset(run, task.env, split).actions) for split in ("train", "test")
    )
    prior, draw = load_prior(run, task.env), torch.Generator().manual_seed(run.seed)
    data = held_out[: len(held_out) // 2, : task.horizon]
    made = {
        "data": data,
        "sampled": actions.sample_actions(prior, len(data), task.horizon, draw),
        "reconstructed": actions.reconstruct(prior, data),
    }
    return Torques(task, train[:TRAINED_ON], held_out, made)
