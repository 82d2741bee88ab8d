"""PETS by mbrl-lib 0.2.0, on the same data and under the same scores.

mbrl-lib's ensemble (``GaussianMLP``: 5 members of 4 layers of 200 SiLU units), wrapper (``OneDTransitionRewardModel``)
and trainer (``ModelTrainer``), with the settings of its own examples, trained for a budget of CPU seconds. What
it is fed is what the models here are fed: cosine and sine of the angles, standardised velocities and positions, and the
action; its target is the increment of the state in units of its standard deviation. README.md tells how to install it.

    python benchmarks/peers/pets.py --env tsm/ReacherPush-v1 --form mse --seconds 2320
"""

from __future__ import annotations

import argparse
import copy
import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from reproduction.results import prediction as prediction_results
from torch import Tensor
from tqdm.auto import tqdm

from reproduction import parameters, runs
from tsmlib import study
from tsmlib.contrib.mbrl_lib import transition_batch
from tsmlib.contrib.one_step_ensemble import OneStepEnsemble
from tsmlib.envs.spec import ENV_IDS, EnvSpec
from tsmlib.evaluation import prediction
from tsmlib.models.features import Features
from tsmlib.trajectory import Trajectories

MODELS = {"gaussian": "pets", "mse": "pets+mse"}  # --form -> word in the column "model"
MEMBERS = 5
BATCH, LEARNING_RATE, WEIGHT_DECAY = (
    256,
    1e-3,
    5e-5,
)  # mbrl-lib's examples/conf/overrides/mbpo_pusher.yaml
UNITS = {"train_seconds": "s", "transitions_per_second": "1/s"}
PART = 250  # batches between two looks at the validation data, as often as the models here look

Network = Callable[
    [Tensor], tuple[Tensor, Tensor | None]
]  # (M, R, features + du) -> mean, log variance (M, R, dx)


# What goes in and what comes out -------------------------------------------------------------------------------------


def unit_of(features: Features) -> Tensor:
    """(dx,) what one unit of each state dimension is to mbrl-lib: its increments have unit variance.

    A dimension that never changes keeps its own unit; its increment, and so its target, is zero.
    """
    return torch.where(features.moving, features.step_std, torch.ones_like(features.step_std))


def transitions(data: Trajectories, unit: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All x_t / unit (N T, dx), u_t (N T, du) and x_{t+1} / unit, episode by episode."""
    scaled = data.states / unit.numpy()
    before, after = (part.reshape(-1, part.shape[2]) for part in (scaled[:, :-1], scaled[:, 1:]))
    return before, data.actions.reshape(-1, data.actions.shape[2]), after


class Peer(OneStepEnsemble):
    """An ensemble of one-step networks fed by ``Features``, by trajectory sampling with a fixed member (TS-inf).

    network: mean and log variance of the increments in ``unit_of(features)``, log variance None where none is stated.
    """

    def __init__(self, network: Network, features: Features, *, members: int = MEMBERS) -> None:
        self.network, self.features, self.members, self.unit = (
            network,
            features,
            members,
            unit_of(features),
        )

    @torch.no_grad()
    def step(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor | None]:
        """(M, R, dx), (M, R, du) -> mean and standard deviation of the increments (M, R, dx), physical units."""
        mean, log_variance = self.network(torch.cat([self.features(x), u], dim=-1))
        scale = self.unit * self.features.moving  # what never changes stays exactly as it is
        return scale * mean, None if log_variance is None else scale * (0.5 * log_variance).exp()


# Theirs --------------------------------------------------------------------------------------------------------------


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
    return transition_batch(replace(data, states=data.states / unit_of(features).numpy()))


def initialise(
    form: str, features: Features, data: Trajectories, *, seed: int, batch: int = BATCH
) -> tuple[Any, Any]:
    """mbrl-lib's model with new weights and the statistics of ``data``, and batches of a bootstrap for every member."""
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
    """All members of mbrl-lib's model as one function, its own normalisation of the inputs included."""
    return lambda inputs: model.model(
        model.input_normalizer.normalize(inputs), use_propagation=False
    )


class Parts:
    """Loops over ``batches`` that are ``size`` long and go on where the last one ended, pass after pass."""

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
    """mbrl-lib's model with its best weights on ``held_out`` after ``seconds``, and what training took.

    seconds: of CPU time, validation included, so that whatever else a machine does costs this peer nothing.

    As in its examples, every member has a bootstrap of the transitions, and weights count as better where the squared
    error of any member on the validation data falls by 1 %.
    """
    from mbrl.models import ModelTrainer
    from mbrl.util.replay_buffer import TransitionIterator

    torch.manual_seed(seed)
    model, bootstraps = initialise(form, features, data, seed=seed)
    parts = Parts(bootstraps, min(PART, len(bootstraps)))
    best: dict[str, Any] = {"score": None, "weights": None}
    bar = tqdm(
        total=round(seconds), desc=f"{EnvSpec.parse(data.env).name} {MODELS[form]}", unit="s"
    )
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
    """End with an error where ``peer`` does not do what mbrl-lib's own ``sample`` does, on one step of ``data``."""
    before, actions, _ = transitions(data, peer.unit)
    rows = torch.randperm(len(actions))[: 20 * MEMBERS]
    x, u = torch.from_numpy(before)[rows], torch.from_numpy(actions)[rows]
    state = model.reset(x, rng=torch.Generator())
    theirs, *_ = model.sample(u, state, deterministic=True)
    members = state["propagation_indices"].view(MEMBERS, -1)  # (M, R): which rows each member takes
    mean, _ = peer.step((x * peer.unit)[members], u[members])
    moving = peer.features.moving
    off = ((mean / peer.unit) - (theirs - x)[members])[..., moving].abs().max().item()
    if not off < 1e-3:  # x in units of its increments is up to 1e3, in single precision
        raise SystemExit(
            f"the adapter is {off:.1e} standard deviations off mbrl-lib's own prediction"
        )


# Scores --------------------------------------------------------------------------------------------------------------


def table(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write ``rows`` to ``path``, in place of those of the same model, environment and seed that it holds."""
    key = ("env", "model", "seed")
    new = {tuple(row[name] for name in key) for row in rows}
    kept = pd.read_csv(path).to_dict("records") if path.exists() else []
    others = [row for row in kept if tuple(row[name] for name in key) not in new]
    pd.DataFrame([*others, *rows]).to_csv(path, index=False)


def run_of(folder: Path) -> runs.Run:
    """The run whose folder this is, ``.../<scale>/seed<k>``."""
    scale, seed = folder.parent.name, folder.name.removeprefix("seed")
    if scale not in parameters.SCALES or not seed.isdecimal():
        raise SystemExit(
            f"--run-dir is {folder}, expected the folder of a run, such as runs/paper/seed0"
        )
    return runs.Run("peers_pets", scale, int(seed), folder)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--env", choices=ENV_IDS, default="tsm/ReacherPush-v1", help="default tsm/ReacherPush-v1"
    )
    parser.add_argument(
        "--form", choices=MODELS, default="gaussian", help="what is trained (default gaussian)"
    )
    parser.add_argument(
        "--seconds", type=float, default=300, help="CPU seconds of training (default 300)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of weights and batches (default 0)")
    parser.add_argument(
        "--samples", type=int, default=32, help="per trajectory (default 32, as 03_predict)"
    )
    parser.add_argument(
        "--episodes", type=int, default=1000, help="of the test split (default 1000)"
    )
    parser.add_argument(
        "--run-dir", type=Path, default=Path("runs/paper/seed0"), help="default runs/paper/seed0"
    )
    parser.add_argument(
        "--out", type=Path, help="table to write (default: metrics/peers_pets.csv of the run)"
    )
    arguments = parser.parse_args()
    run = run_of(arguments.run_dir.resolve())
    data, validation, test = (study.dataset(run, arguments.env, split) for split in study.SPLITS)
    test, word = test.take(slice(arguments.episodes)), MODELS[arguments.form]
    features = Features(data.states.shape[2], data.angles).fit(torch.from_numpy(data.states))
    copies, _ = study.training_data(run, arguments.env, "ensemble")
    model, took = train(
        arguments.form, features, copies, validation, seconds=arguments.seconds, seed=arguments.seed
    )
    peer = Peer(network_of(model), features)
    check(model, peer, test)
    print(
        f"{arguments.env}, {word}: "
        + ", ".join(f"{name} {value:,.4g}" for name, value in took.items())
    )
    began = time.perf_counter()
    splits, options = (test, validation), dict(samples=arguments.samples, seed=arguments.seed)
    open_loop = prediction.score(peer, features, *splits, progress=f"{word}, open loop", **options)
    options |= dict(starts=prediction_results.SEGMENTS, horizon=10)
    segments = prediction.score(peer, features, *splits, progress=f"{word}, segments", **options)
    print(
        f"{arguments.samples} samples of {len(test)} trajectories scored in {time.perf_counter() - began:.0f} s"
    )
    for metric, curve in open_loop.against_horizon().items():
        print(f"    {metric:18} at 10 steps {curve[9]:9.3f}   at 80 steps {curve[79]:9.3f}")
    common = dict(seed=arguments.seed, scale=run.scale)
    rows = prediction_results.rows(arguments.env, word, open_loop, segments, test, **common)
    about = {
        name: rows[0][name] for name in ("env", "sim", "model", "planner", "execution")
    } | common
    rows += [
        dict(about, metric=name, value=value, unit=UNITS.get(name, ""))
        for name, value in took.items()
    ]
    path = arguments.out or run.metrics / "peers_pets.csv"
    table(path, rows)
    print(path)


if __name__ == "__main__":
    main()
