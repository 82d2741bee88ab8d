"""A successor for the segment model on the pushing task: one change of its recipe at a time, on validation data only.

Every try is one line of ``successor.csv``: what was changed, CPU seconds of training (one thread, validation included),
updates, and what came out of it:

    energy10 .. energy_mean   energy score 10, 50, 80 steps ahead and its mean over 90, of 200 fresh episodes of random
                              torques, 32 samples. Residual noise, one variance per step, is fitted to 200 others, with
                              the same freedom for every model; a deterministic model is noise around one rollout
    nrmse10, nrmse80, coverage80, own_density   as in tsmlib.evaluation.scoring
    cost, within_5cm          of 25 plans for targets that are not the frozen ones, executed open loop: 96 candidates x
                              10 iterations of the cross-entropy method over the codes of the action prior, each
                              candidate judged by the mode (z = 0) of the model
    gap                       return that the mode predicts minus return executed

    python benchmarks/settings/successor.py --list
    python benchmarks/settings/successor.py lstm base "window 30"
    python benchmarks/settings/successor.py "base" --times 4 --seed 1

Training is resumed from ``runs/settings`` where it was stopped. The same name, seed and budget is not run twice.
"""

from __future__ import annotations

import argparse
import csv
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from push_task import CHOSEN, ENV, HERE, action_prior, draw, physics, simulate
from recurrent import Recurrent
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from tsmlib import rewards
from tsmlib.collection import smooth_torques
from tsmlib.envs.geometry import DT, STATE_NAMES, STATE_UNITS
from tsmlib.evaluation import prediction
from tsmlib.models.baselines import LSTM, OneStep
from tsmlib.planning.base import Plan
from tsmlib.planning.planners import cem
from tsmlib.planning.predictors import model_predictor
from tsmlib.planning.search_spaces import LatentActions
from tsmlib.study.runs import ROOT
from tsmlib.training.fit import fixed_windows, schedule
from tsmlib.training.muon import Muon
from tsmlib.training.precision import native_bf16
from tsmlib.trajectory import Trajectories, batches, initial_past

RUNS = ROOT / "runs" / "settings"
EPISODES = {"train": 5000, "validation": 200, "fresh": 200}
SEED = {"validation": 2_000_011, "fresh": 2_000_012, "targets": 2_000_002}
LR_FINAL, WARM_UP, CLIP, EVERY = 1e-5, 100, 1.0, 250


@dataclass(frozen=True)
class Try:
    """A model and how it is trained. windows: (share of the updates, steps of future, samples), one after the other.

    Samples of the score: 0 leaves the model's own number, which is also that of validation.
    """

    model: type[nn.Module] = Recurrent
    options: tuple[tuple[str, Any], ...] = ()
    updates: int = 4000  # of one budget, 290 s of the machine that trained the shipped models
    batch: int = 128
    lr: float = 4e-3
    windows: tuple[tuple[float, int, int], ...] = ((1.0, 20, 0),)
    weight_decay: float = 0.0  # decoupled
    muon: float = 0.0  # learning rate of Muon for the matrices inside; 0: Adam for everything
    loss: str = "loss"  # a method of the model
    average: float = 0.0  # of the weights: decay of an exponential mean; 0: the weights themselves

    def build(self, data: Trajectories, seed: int) -> Any:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            net: Any = self.model(data.states.shape[2], 2, angles=data.angles, **dict(self.options))
        net.features.fit(torch.from_numpy(data.states))
        return net


BASE = Try()
MUON = replace(BASE, muon=0.02)
TRIES: dict[str, Try] = {
    "lstm": Try(LSTM, updates=4200, batch=256),
    "lstm, weight decay 0.1": Try(LSTM, updates=4200, batch=256, weight_decay=0.1),
    "base": BASE,
    "window 30": replace(BASE, windows=((1.0, 30, 0),), updates=2800),
    "window 50": replace(BASE, windows=((1.0, 50, 0),), updates=1700),
    "window 10, then 20, then 40": replace(BASE, windows=((0.3, 10, 0), (0.4, 20, 0), (0.3, 40, 0)), updates=3800),
    "hidden 256": replace(BASE, options=(("hidden", 256),), updates=2200),
    "hidden 96": replace(BASE, options=(("hidden", 96),), updates=6500),
    "rate 2e-3": replace(BASE, lr=2e-3),
    "rate 8e-3": replace(BASE, lr=8e-3),
    "4 samples": replace(BASE, options=(("samples", 4),), updates=2350),
    "mode weight 0.5": replace(BASE, options=(("mode_weight", 0.5),), updates=2900),
    "score of each step too": replace(BASE, options=(("per_step", 1.0),)),
    "batch 64": replace(BASE, batch=64, updates=7000),
    "mean of weights 0.999": replace(BASE, average=0.999),
    "1 sample": replace(BASE, options=(("samples", 1),), updates=6500),  # codes are noise to be ignored
    "muon 0.02": MUON,
    "muon 0.05": replace(MUON, muon=0.05),
    "muon 0.02, lstm": Try(LSTM, updates=4200, batch=256, muon=0.02),
    "muon 0.006, lstm": Try(LSTM, updates=4200, batch=256, lr=2e-3, muon=0.006),
    "muon 0.02, window 10, then 20": replace(MUON, windows=((0.5, 10, 0), (0.5, 20, 0)), updates=5000),
    "muon 0.02, 1 sample": replace(MUON, options=(("samples", 1),), updates=6000),
    "muon 0.02, mode weight 0.5": replace(MUON, options=(("mode_weight", 0.5),), updates=2800),
    "muon 0.02, batch 64": replace(MUON, batch=64, updates=6500),
    "muon 0.02, hidden 256": replace(MUON, options=(("hidden", 256),), updates=2100),
    "muon 0.02, 4 samples": replace(MUON, options=(("samples", 4),), updates=2300),
    "window 10, then 20": replace(BASE, windows=((0.5, 10, 0), (0.5, 20, 0)), updates=5200),
    "muon 0.02, 1 then 2 samples": replace(MUON, windows=((0.6, 20, 1), (0.4, 20, 2)), updates=4600),
    "muon 0.006, 1 then 2 samples": replace(
        MUON, lr=2e-3, muon=0.006, windows=((0.5, 20, 1), (0.35, 20, 2), (0.15, 30, 2)), updates=4400
    ),
    "muon 0.02, hidden 256, 1 then 2 samples": replace(
        MUON, options=(("hidden", 256),), windows=((0.5, 20, 1), (0.3, 20, 2), (0.2, 30, 2)), updates=2800
    ),
    "muon 0.02, 1 then 2 samples, mode weight 0.5": replace(
        MUON, windows=((0.6, 20, 1), (0.4, 20, 2)), updates=4000, options=(("mode_weight", 0.5),)
    ),
    "muon 0.02, 1 then 2 samples, hidden 96": replace(
        MUON, windows=((0.6, 20, 1), (0.4, 20, 2)), updates=7600, options=(("hidden", 96),)
    ),
    "muon 0.02, lstm, decay 0.1": Try(LSTM, updates=4200, batch=256, lr=2e-3, muon=0.02, weight_decay=0.1),
    "onestep": Try(OneStep, updates=6000, batch=256),
    "onestep, muon 0.02": Try(OneStep, updates=6000, batch=256, lr=2e-3, muon=0.02),
    "multistep": Try(OneStep, updates=5600, batch=256, loss="multi_step_loss"),
    "multistep, muon 0.02": Try(OneStep, updates=5600, batch=256, lr=2e-3, muon=0.02, loss="multi_step_loss"),
    "code of 2": replace(BASE, options=(("latent_dim", 2),)),
}


# Data ----------------------------------------------------------------------------------------------------------------


def data(split: str, seed: int) -> Trajectories:
    """Episodes of smooth random torques in the chosen task, collected at the first call."""
    seed = SEED.get(split, seed)
    path = RUNS / f"{split}-{seed}.safetensors"
    if not path.exists():
        n = EPISODES[split]
        with physics(CHOSEN):
            starts, _ = draw(CHOSEN, n, seed)
            torques = smooth_torques(n, CHOSEN.horizon, generator=torch.Generator().manual_seed(seed))
            states = simulate(starts, torques)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_file({"states": torch.from_numpy(states).float(), "actions": torques}, path)
    kept = load_file(path)
    return Trajectories(kept["states"].numpy(), kept["actions"].numpy(), ENV, DT, STATE_NAMES, STATE_UNITS)


# Training ------------------------------------------------------------------------------------------------------------


def train(what: Try, seed: int, path: Path, *, stop_at: float = float("inf")) -> tuple[Any, dict[str, Any]]:
    """A trained model, and CPU seconds, updates and best validation loss; resumed from ``path``.

    As ``tsmlib.training.fit``: the weights with the best validation loss are kept. stop_at: time of day to stop at.
    """
    train_on, held_out = data("train", seed), data("validation", seed)
    net, mean = what.build(train_on, seed), what.build(train_on, seed)  # mean: of the weights
    inside = [p for name, p in net.named_parameters() if what.muon and p.ndim == 2 and "code" not in name]
    others = [p for p in net.parameters() if not any(p is q for q in inside)]
    optimizers: list[Any] = [torch.optim.AdamW(others, lr=what.lr, weight_decay=what.weight_decay, fused=True)]
    if inside:
        optimizers.append(Muon(inside, lr=what.muon, weight_decay=what.weight_decay))
    generator, kept = torch.Generator(), what.build(train_on, seed)
    phases = [(length, n) for share, length, n in what.windows for _ in range(round(share * what.updates))]
    phases += [what.windows[-1][1:]] * (what.updates - len(phases))
    segment = train_on.padded(net.past_len)
    draws = {n: batches(segment, past_len=net.past_len, future_len=n, batch_size=what.batch, generator=generator)
             for n, _ in set(phases)}  # fmt: skip
    window = fixed_windows(held_out, net.past_len, what.windows[-1][1])
    done = dict(step=0, seconds=0.0, best=float("inf"), best_step=0)
    if path.exists():
        tensors = load_file(path)
        done = {key: float(tensors.pop(key)) for key in done}
        for word, part in (("net", net), ("mean", mean), ("kept", kept)):
            part.load_state_dict(
                {k.removeprefix(f"{word}."): v for k, v in tensors.items() if k.startswith(f"{word}.")}
            )
        for number, optimizer in enumerate(optimizers):
            for i, parameter in enumerate(optimizer.param_groups[0]["params"]):
                stem = f"optimizer{number}.{i}."
                optimizer.state[parameter] = {k.removeprefix(stem): v for k, v in tensors.items() if k.startswith(stem)}
    began = time.process_time() - done["seconds"]
    total = 0.0
    for step in range(int(done["step"]), what.updates):
        generator.manual_seed(seed * 1_000_003 + step)
        length, samples = phases[step]
        if samples:
            net.samples = samples
        rate = schedule(step, what.updates, 1.0, LR_FINAL / what.lr, WARM_UP)
        for optimizer, peak in zip(optimizers, (what.lr, what.muon), strict=False):
            for group in optimizer.param_groups:
                group["lr"] = rate * peak
        torch.clear_autocast_cache()
        with torch.autocast("cpu", torch.bfloat16, enabled=native_bf16("cpu")):
            value = getattr(net, what.loss)(next(draws[length]), generator)
        net.zero_grad(set_to_none=True)
        value.backward()
        nn.utils.clip_grad_norm_(net.parameters(), CLIP)
        for optimizer in optimizers:
            optimizer.step()
        total += value.item()
        with torch.no_grad():
            keep = min(what.average, (1 + step) / (10 + step))
            for slow, fast in zip(mean.parameters(), net.parameters(), strict=True):
                slow.lerp_(fast, 1 - keep)
        if (step + 1) % EVERY == 0 or step + 1 == what.updates:
            with torch.no_grad():
                loss = getattr(mean, what.loss)(window, generator.manual_seed(seed)).item()
            if loss < done["best"]:
                done |= dict(best=loss, best_step=step + 1)
                kept.load_state_dict(mean.state_dict())
            done |= dict(step=step + 1, seconds=time.process_time() - began)
            print(
                f"  {step + 1:6} {done['seconds']:6.0f} s  train {total / EVERY:.4f}  validation {loss:.4f}", flush=True
            )
            total = 0.0
            over = step + 1 == what.updates or time.time() > stop_at
            if over or (step + 1) % (4 * EVERY) == 0:
                tensors = {f"{word}.{k}": v.clone() for word, part in (("net", net), ("mean", mean), ("kept", kept))
                           for k, v in part.state_dict().items()}  # fmt: skip
                for number, optimizer in enumerate(optimizers):
                    for i, parameter in enumerate(optimizer.param_groups[0]["params"]):
                        state = optimizer.state[parameter].items()
                        tensors |= {f"optimizer{number}.{i}.{key}": v.clone() for key, v in state}
                tensors |= {key: torch.tensor(float(number), dtype=torch.float64) for key, number in done.items()}
                path.parent.mkdir(parents=True, exist_ok=True)
                save_file(tensors, path)
            if over:
                break
    return kept.eval(), dict(seconds=done["seconds"], updates=int(done["step"]), validation=done["best"],
                             best_at=int(done["best_step"]))  # fmt: skip


# What it is worth ----------------------------------------------------------------------------------------------------


def predictions(net: Any, seed: int) -> dict[str, float]:
    """Scores of 200 fresh episodes."""
    found = prediction.score(net, net.features, data("fresh", seed), data("validation", seed), samples=32)
    mean = found.against_horizon()
    energy = mean["energy_score_noise"]
    return {
        "energy10": float(energy[9]), "energy50": float(energy[49]), "energy80": float(energy[79]),
        "energy_mean": float(energy.mean()), "nrmse10": float(mean["nrmse"][9]), "nrmse80": float(mean["nrmse"][79]),
        "coverage80": float(mean["coverage80"].mean()), "own_density": float(mean["ll_own"].mean()),
        "outside": float(found.outside.mean()),
    }  # fmt: skip


@cache
def posed(n: int) -> tuple[np.ndarray, Tensor]:
    """Starts and targets, those of the table of the task."""
    with physics(CHOSEN):
        return draw(CHOSEN, n, SEED["targets"])


def executed(actions: Tensor, targets: Tensor, starts: np.ndarray) -> tuple[Tensor, Tensor]:
    """Returns (B,) and final distances (B,) of actions (B, T, 2) in the true simulator."""
    with physics(CHOSEN):
        states = torch.from_numpy(simulate(starts, actions))
    returns = rewards.push(targets)(states[:, 1:], actions).sum(-1)
    return returns, rewards.final_distance(states, targets, rewards.BLOCK)


def planned(net: Any, n: int, *, samples: int = 0, seed: int = 0, candidates: int = 96, iterations: int = 10) -> Plan:
    """Plans for ``n`` targets through the model; candidates judged by the mode, or by so many common samples."""
    starts, targets = posed(n)
    past = initial_past(torch.from_numpy(starts), net.past_len, 2)
    samples = samples if getattr(net, "stochastic", True) else 0
    return cem(
        model_predictor(net, past, samples=samples, seed=seed), rewards.push(targets),
        LatentActions(action_prior(), CHOSEN.horizon), n,
        candidates=candidates, elites=max(2, candidates // 10), iterations=iterations, seed=seed,
    )  # fmt: skip


def plans(net: Any, n: int = 25) -> dict[str, float]:
    """What plans by the mode cost when they are executed."""
    plan, (starts, targets) = planned(net, n), posed(n)
    returns, final = executed(plan.actions, targets, starts)
    return {
        "targets": n, "cost": -float(returns.mean()), "cost_sem": float(returns.std() / n**0.5),
        "gap": float((plan.predicted_return - returns).mean()),
        "gap_abs": float((plan.predicted_return - returns).abs().mean()),
        "within_5cm": float((final < 0.05).float().mean()), "final_mean": float(final.mean()),
        "plan_seconds": plan.seconds,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="of the tries, in this order")
    parser.add_argument("--list", action="store_true", help="what there is to try")
    parser.add_argument("--times", type=float, default=1.0, help="of the budget (default 1)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--targets", type=int, default=25)
    parser.add_argument("--stop-at", default="", help="time of day, such as 21:30, to stop training at")
    parser.add_argument("--out", type=Path, default=HERE / "successor.csv")
    arguments = parser.parse_args()
    if arguments.list:
        print("\n".join(f"{name:30} {what}" for name, what in TRIES.items()))
        return
    if unknown := [name for name in arguments.names if name not in TRIES]:
        parser.error(f"unknown try {unknown[0]!r}; expected some of {', '.join(map(repr, TRIES))}")
    torch.set_num_threads(1)
    stop_at = float("inf")
    if arguments.stop_at:
        stop_at = time.mktime(time.strptime(time.strftime("%Y-%m-%d ") + arguments.stop_at, "%Y-%m-%d %H:%M"))
    for name in arguments.names:
        what = replace(TRIES[name], updates=round(arguments.times * TRIES[name].updates))
        stem = f"{name.replace(',', '').replace(' ', '-')}-x{arguments.times:g}-seed{arguments.seed}"
        arithmetic = "bfloat16" if native_bf16("cpu") else "float32"  # of products, by the processor
        key = {"what": name, "times": f"{arguments.times:g}", "seed": str(arguments.seed), "arithmetic": arithmetic}
        rows = read(arguments.out)
        if any(all(row[word] == value for word, value in key.items()) for row in rows):
            continue
        print(stem, flush=True)
        net, found = train(what, arguments.seed, RUNS / f"{stem}.checkpoint.safetensors", stop_at=stop_at)
        save_file(net.state_dict(), RUNS / f"{stem}.safetensors")
        found |= predictions(net, arguments.seed) | plans(net, arguments.targets)
        row = key | {word: f"{value:.4g}" for word, value in found.items()}
        write(arguments.out, [*read(arguments.out), row])
        print(stem, row, flush=True)


def read(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write(path: Path, rows: list[dict[str, str]]) -> None:
    columns = list(dict.fromkeys(word for row in rows for word in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
