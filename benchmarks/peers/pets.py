"""PETS by mbrl-lib 0.2.0, on the same data and under the same scores.

mbrl-lib's ensemble (``GaussianMLP``: 5 members of 4 layers of 200 SiLU units), wrapper
(``OneDTransitionRewardModel``)
and trainer (``ModelTrainer``), with the settings of its own examples, trained for a budget of CPU
seconds. What
it is fed is what the models here are fed: cosine and sine of the angles, standardised velocities
and positions, and the
action; its target is the increment of the state in units of its standard deviation. README.md tells
how to install it.

    python benchmarks/peers/pets.py --arm ReacherPush --form mse --seconds 2320
"""

from __future__ import annotations

import argparse
import copy
import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm.auto import tqdm

from reproduction import tables
from reproduction.episodes import load_data
from reproduction.runs import Run, env_id
from reproduction.scores import OPEN, SEGMENTS, STARTS, summarised
from reproduction.symmetry import symmetric
from tsmlib.evaluation.prediction import score
from tsmlib.models.ensemble import Members
from tsmlib.models.features import Features
from tsmlib.trajectory import Trajectories

MODELS = {"gaussian": "pets", "mse": "pets+mse"}  # --form -> word in the column "model"
MEMBERS = 5
BATCH, LEARNING_RATE, WEIGHT_DECAY = (
    256,
    1e-3,
    5e-5,
)  # mbrl-lib's examples/conf/overrides/mbpo_pusher.yaml
PART = 250  # batches between two looks at the validation data, as often as the models here look

Network = Callable[
    [Tensor], tuple[Tensor, Tensor | None]
]  # (M, R, features + du) -> mean, log variance (M, R, dx)


# What goes in and what comes out ------------------------------------------------------------------


def unit_of(features: Features) -> Tensor:
    """(dx,) what one unit of each state dimension is to mbrl-lib: its increments have unit
    variance.

    A dimension that never changes keeps its own unit; its increment, and so its target, is zero.
    """
    return torch.where(features.moving, features.step_std, torch.ones_like(features.step_std))


def transitions(data: Trajectories, unit: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All x_t / unit (N T, dx), u_t (N T, du) and x_{t+1} / unit, episode by episode."""
    scaled = data.states / unit.numpy()
    before, after = (part.reshape(-1, part.shape[2]) for part in (scaled[:, :-1], scaled[:, 1:]))
    return before, data.actions.reshape(-1, data.actions.shape[2]), after


class Peer(Members):
    """An ensemble of one-step networks fed by ``Features``, by trajectory sampling with a fixed
    member (TS-inf).

    network: mean and log variance of the increments in ``unit_of(features)``, log variance None
    where none is stated.
    """

    def __init__(self, network: Network, features: Features, *, members: int = MEMBERS) -> None:
        self.network, self.features, self.members = network, features, members
        # What never changes stays exactly as it is.
        self.scale = unit_of(features) * features.moving

    @torch.no_grad()
    def increments(
        self, x: Tensor, u: Tensor, which: slice = slice(None)
    ) -> tuple[Tensor, Tensor | None]:
        """(M, R, dx), (M, R, du) -> mean and log variance of the increments (M, R, dx)."""
        inputs = torch.cat([self.features(x), u], dim=-1)
        every = inputs.new_zeros(self.members, *inputs.shape[1:])
        every[which] = inputs
        mean, log_variance = self.network(every)
        return mean[which], None if log_variance is None else log_variance[which]


# Theirs -------------------------------------------------------------------------------------------


def wrapped(form: str, features: Features, action_dim: int) -> Any:
    """mbrl-lib's model with new weights, drawn from torch's global generator."""
    from mbrl.models import GaussianMLP, OneDTransitionRewardModel

    unit = unit_of(features)
    ensemble = GaussianMLP(
        features.dim + action_dim,
        len(unit),
        "cpu",
        num_layers=4,
        hid_size=200,
        ensemble_size=MEMBERS,
        deterministic=form == "mse",
        propagation_method="fixed_model",
        activation_fn_cfg={"_target_": "torch.nn.SiLU"},
    )
    return OneDTransitionRewardModel(
        ensemble,
        target_is_delta=True,
        normalize=True,
        learned_rewards=False,
        obs_process_fn=lambda scaled: features(torch.as_tensor(scaled) * unit),
    )


def batch_of(data: Trajectories, features: Features) -> Any:
    """All transitions of ``data``, in units of their increments, as mbrl-lib takes them."""
    scaled = data.states / unit_of(features).numpy()
    names = (data.env, data.dt, data.names, data.units, data.angles)
    return transition_batch(Trajectories(scaled, data.actions, *names))


def transition_batch(data: Trajectories) -> Any:
    """All transitions of episodes as an ``mbrl.types.TransitionBatch``, with rewards of zero,
    episode by episode.
    """
    from mbrl.types import TransitionBatch

    last = np.cumsum(data.steps) - 1  # row of the last action of each episode
    terminated, truncated = np.zeros((2, len(data.flat_actions)), bool)
    terminated[last] = data.terminated
    truncated[last] = ~terminated[last]
    before = np.delete(data.flat_states, data.offsets + data.steps, axis=0)
    after = np.delete(data.flat_states, data.offsets, axis=0)
    zeros = np.zeros(len(before), np.float32)
    return TransitionBatch(before, data.flat_actions, after, zeros, terminated, truncated)


def initialise(
    form: str, features: Features, data: Trajectories, *, seed: int, batch: int = BATCH
) -> tuple[Any, Any]:
    """mbrl-lib's model with new weights and the statistics of ``data``, and batches of a bootstrap
    for every member.
    """
    from mbrl.util.replay_buffer import BootstrapIterator

    model, whole = wrapped(form, features, data.actions.shape[2]), batch_of(data, features)
    model.update_normalizer(whole)
    return model, BootstrapIterator(
        whole,
        batch,
        MEMBERS,
        shuffle_each_epoch=True,
        permute_indices=False,
        rng=np.random.default_rng(seed),
    )


def network_of(model: Any) -> Network:
    """All members of mbrl-lib's model as one function, its own normalisation of the inputs
    included.
    """
    return lambda inputs: model.model(
        model.input_normalizer.normalize(inputs), use_propagation=False
    )


class Parts:
    """Loops over ``batches`` that are ``size`` long and go on where the last one ended, pass after
    pass.
    """

    def __init__(self, batches: Iterable[Any], size: int) -> None:
        self.stream, self.size, self.drawn = (
            itertools.chain.from_iterable(itertools.repeat(batches)),
            size,
            0,
        )

    def __iter__(self) -> Iterator[Any]:
        for batch in itertools.islice(self.stream, self.size):
            self.drawn += 1
            yield batch


class BudgetUsed(Exception):
    """Leaves mbrl-lib's training loop, which knows epochs but no seconds."""


def train(
    form: str,
    features: Features,
    data: Trajectories,
    held_out: Trajectories,
    *,
    seconds: float,
    seed: int,
) -> tuple[Any, dict[str, float]]:
    """mbrl-lib's model with its best weights on ``held_out`` after ``seconds``, and what training
    took.

    seconds: of CPU time, validation included, so that whatever else a machine does costs this peer
    nothing.

    As in its examples, every member has a bootstrap of the transitions, and weights count as better
    where the squared
    error of any member on the validation data falls by 1 %.
    """
    from mbrl.models import ModelTrainer
    from mbrl.util.replay_buffer import TransitionIterator

    torch.manual_seed(seed)
    model, bootstraps = initialise(form, features, data, seed=seed)
    parts = Parts(bootstraps, min(PART, len(bootstraps)))
    best: dict[str, Any] = {"score": None, "weights": None}
    bar = tqdm(total=round(seconds), desc=f"{data.env} {MODELS[form]}", unit="s")
    began = time.process_time()

    def after_part(
        model: Any, _: int, part: int, loss: float, score: Tensor, best_score: Tensor
    ) -> None:
        if best["score"] is None or not torch.equal(best_score, best["score"]):
            best.update(score=best_score.clone(), weights=copy.deepcopy(model.state_dict()))
        used = time.process_time() - began
        bar.update(min(round(used), bar.total) - bar.n)
        bar.set_postfix(train=loss, validation=score.mean().item(), best=best_score.mean().item())
        if used > seconds:
            raise BudgetUsed

    with suppress(BudgetUsed):
        ModelTrainer(model, optim_lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY).train(
            parts,
            dataset_val=TransitionIterator(batch_of(held_out, features), BATCH),
            callback=after_part,
            silent=True,
        )
    used = time.process_time() - began
    bar.close()
    model.load_state_dict(best["weights"])
    model.eval()
    return model, {
        "train_seconds": used,
        "transitions_per_second": parts.drawn * BATCH / used,
        "epochs": parts.drawn / len(bootstraps),
        "parameters": sum(w.numel() for w in model.parameters()),
        "validation_mse": best["score"].mean().item(),
    }


def check(model: Any, peer: Peer, data: Trajectories) -> None:
    """End with an error where ``peer`` does not do what mbrl-lib's own ``sample`` does, on one step
    of ``data``.
    """
    before, actions, _ = transitions(data, unit := unit_of(peer.features))
    rows = torch.randperm(len(actions))[: 20 * MEMBERS]
    x, u = torch.from_numpy(before)[rows], torch.from_numpy(actions)[rows]
    state = model.reset(x, rng=torch.Generator())
    theirs, *_ = model.sample(u, state, deterministic=True)
    members = state["propagation_indices"].view(MEMBERS, -1)  # (M, R): which rows each member takes
    mean, _ = peer.increments((x * unit)[members], u[members])
    moving = peer.features.moving
    off = (mean - (theirs - x)[members])[..., moving].abs().max().item()
    if not off < 1e-3:  # x in units of its increments is up to 1e3, in single precision
        raise SystemExit(
            f"the adapter is {off:.1e} standard deviations off mbrl-lib's own prediction"
        )


# Scores -----------------------------------------------------------------------------------------


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", default="ReacherPush", help="default ReacherPush")
    parser.add_argument("--form", choices=MODELS, default="gaussian", help="what is trained")
    parser.add_argument("--seconds", type=float, default=300, help="CPU seconds of training")
    parser.add_argument("--seed", type=int, default=0, help="of data, weights and batches")
    parser.add_argument("--scale", default="paper", help="of the run that has the data")
    arguments = parser.parse_args()
    run, arm, word = Run(arguments.scale, arguments.seed), arguments.arm, MODELS[arguments.form]
    data, held_out, test = (load_data(run, arm, split) for split in ("train", "validation", "test"))
    features = Features(data.states.shape[2], data.angles).fit(data)
    how = {"seconds": arguments.seconds, "seed": arguments.seed}
    model, took = train(arguments.form, features, symmetric(data), held_out, **how)
    peer = Peer(network_of(model), features)
    check(model, peer, test)
    about = tables.place(env_id(arm)) | {"model": word, "planner": "none"}
    about |= {"seed": run.seed, "scale": run.scale}
    options = {"samples": 32, "seed": run.seed}
    rows = [about | {"metric": name, "value": value} for name, value in took.items()]
    whole = score(peer, features, test, held_out, horizon=90, **options)
    rows += summarised(about | {"execution": OPEN}, whole)
    parts = score(peer, features, test, held_out, horizon=10, starts=list(STARTS), **options)
    rows += summarised(about | {"execution": SEGMENTS}, parts, steps=False)
    print(tables.write(run.folder / "peers" / f"{arm}-{word}.csv", rows))


if __name__ == "__main__":
    main()
