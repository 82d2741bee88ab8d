"""Gradients of the return through a run's models and prior: their errors (02_train), their signal (07_action_prior)."""

from collections.abc import Sequence

from torch import nn

from tsmlib.evaluation import gradients
from tsmlib.planning.base import SearchSpace
from tsmlib.planning.search_spaces import DirectActions, LatentActions
from tsmlib.planning.tasks import Task
from reproduction.models import load_or_train, load_prior
from reproduction.results import table
from reproduction.results.table import Row
from reproduction.runs import Run
from tsmlib.zoo import method


def error_rows(run: Run, task: Task, models: Sequence[str]) -> list[Row]:
    """Rows of the largest relative error of the gradients of the return of ``models``, of all that it is a function of,
    from the starts of a task."""
    prior, rows = load_prior(run, task.env), list[Row]()
    about = dict(
        env=task.env, metric="gradient_error", unit="ratio", horizon=task.horizon, n=len(task)
    )
    for model in models:
        net = load_or_train(run, task.env, model).model
        assert isinstance(net, nn.Module)
        errors = gradients.of_return(task, net, prior, seed=run.seed)
        rows.append(
            dict(about, model=model, value=max(errors.values()), seed=run.seed, scale=run.scale)
        )
    return rows


def signal_rows(run: Run, task: Task, models: Sequence[str], *, samples: int) -> list[Row]:
    """Rows with a ``target``: signal-to-noise of the gradients of the return of ``models``, in both search spaces, over
    so many samples, at the starts of a task."""
    prior = load_prior(run, task.env)
    spaces: dict[str, SearchSpace] = {
        "latent": LatentActions(prior, task.horizon),
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
