"""Several trainings of one model as one, with stacked weights, against one alone: what a gradient takes; and policies.

A gradient of a training loss, at the batch and the future of the study's schedule, of one model and of --copies with
weights, windows and noise of their own, put through ``torch.func.vmap`` as one call. Windows are drawn beforehand, and
the optimiser's step is left out, which costs as much per weight either way. CPU seconds; on --device cuda by the clock.
Models that step through a backward pass of their own (LSTM, rtsm) have no such form. Of rtsm it is one step of the
recurrence instead, with its backward pass by autograd and rows as in each stage: of one model by ``addmm``, and of all
copies by ``baddbmm`` over stacked weights.

Of plans it is what ``cem`` judges candidates by first, a rollout of the mode of --candidates for each of ten targets;
of policies an update of ``learn_policy``, with the episodes and copies of the study, of one policy in one model, and of
--copies in as many models by ``learn_stacked``; latent where the model has codes. Weights are new ones. Policies are
timed on a CPU alone.

    python benchmarks/copies.py        or        python -m tsmlib bench copies
"""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import torch
from _rounds import Row, interleaved, parsed, parser, save
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap

from tsmlib import study
from tsmlib.models.base import rollout
from tsmlib.models.recurrence import as_operations
from tsmlib.models.recurrent import SAMPLES
from tsmlib.policies.learning import LearningOptions, episodes_from, learn_policy
from tsmlib.policies.networks import OneStepPolicy, Policy, SegmentPolicy
from tsmlib.policies.stacked import learn_stacked
from tsmlib.study import runs, zoo
from tsmlib.study.zoo import Updates
from tsmlib.trajectory import Segment, Window, batches

ENV = "tsm/ReacherPush-v1"
UPDATES = 2  # of a policy, in each round


class Loss(nn.Module):
    """A loss of a model as a module, which can be called with other weights."""

    def __init__(self, net: Any, loss: str) -> None:
        super().__init__()
        self.net, self.loss = net, loss

    def forward(self, window: Window, generator: torch.Generator) -> Tensor:
        return getattr(self.net, self.loss)(window, generator)


class Rollout(nn.Module):
    """The mode of a model, rolled out, as a module."""

    def __init__(self, net: Any) -> None:
        super().__init__()
        self.net = net

    def forward(self, past: Segment, actions: Tensor) -> Tensor:
        return rollout(self.net, past, actions)


def timed(device: str, call: Callable[[], object]) -> Callable[[], float]:
    """Seconds of ``call``."""

    def run() -> float:
        clock = time.process_time if device == "cpu" else time.perf_counter
        began = clock()
        call()
        if device != "cpu":
            torch.cuda.synchronize()
        return clock() - began

    return run


def ways(word: str, stage: Updates, copies: int, device: str) -> dict[str, Callable[[], float]]:
    """One gradient, and ``copies`` of them."""
    run, data = runs.resolve("bench", scale="laptop"), study.random_data(ENV, 50, seed=0)
    losses: list[nn.Module] = [Loss(study.initialise(run, word, data), stage.loss).to(device) for _ in range(copies)]
    net: Any = losses[0].net
    generator = torch.Generator().manual_seed(0)
    draw = batches(data.padded(net.past_len).to(device), past_len=net.past_len, future_len=stage.future_len,
                   batch_size=stage.batch, generator=generator)  # fmt: skip
    windows = [next(draw) for _ in range(copies)]
    stacked = Window(*(
        Segment(*(torch.stack(parts) for parts in zip(*segments, strict=True)))
        for segments in zip(*windows, strict=True)
    ))  # fmt: skip
    weights, _ = stack_module_state(losses)  # the statistics of the data are the same

    def value(own: dict[str, Tensor], window: Window) -> Tensor:
        return functional_call(losses[0], own, (window, generator))

    def many() -> None:
        for weight in weights.values():
            weight.grad = None
        vmap(value, randomness="different")(weights, stacked).sum().backward()

    def one() -> None:
        losses[0].zero_grad()
        losses[0](windows[0], generator).backward()

    return {"one": timed(device, one), "many": timed(device, many)}


def step(net: Any, copies: int, rows: int, device: str) -> Callable[[], float]:
    """A step of a decoder of rtsm and its backward pass, ten times: of one copy, or of several stacked ones."""
    decoder = net.decoder.over(net.features)
    stack = (copies,) if copies > 1 else ()
    product: Callable[..., Tensor] = torch.baddbmm if stack else torch.addmm
    cell, hidden, out = (w.detach().expand(*stack, *w.shape).clone().requires_grad_() for w in
                         (decoder.cell, decoder.hidden, decoder.out))  # fmt: skip
    n = cell.shape[-1] // 4
    given, c = (torch.randn(*stack, rows, size, device=device) for size in (cell.shape[-2], n))
    given.requires_grad_()
    zeros = [torch.zeros(size, device=device) for size in (4 * n, hidden.shape[-1], out.shape[-1])]

    def call() -> None:
        for _ in range(10):
            for leaf in (cell, hidden, out, given):
                leaf.grad = None
            forget, write, read, new = product(zeros[0], given, cell).chunk(4, -1)
            memory = forget.sigmoid() * c + write.sigmoid() * new.tanh()
            seen = torch.cat([given[..., : hidden.shape[-2] - n], read.sigmoid() * memory.tanh()], -1)
            active = nn.functional.silu(product(zeros[1], seen, hidden))
            product(zeros[2], active, out[..., :-1, :]).sum().backward()

    return timed(device, call)


def rollouts(word: str, copies: int, candidates: int, device: str) -> dict[str, Callable[[], float]]:
    """A rollout of candidates for ten targets in one model, and in ``copies`` of them."""
    run, data = runs.resolve("bench", scale="laptop"), study.random_data(ENV, 50, seed=0)
    task = study.load_task(ENV).take(10)
    nets: list[Any] = [study.initialise(run, word, data).to(device) for _ in range(copies)]
    past, actions = task.past(nets[0].past_len), torch.rand(candidates * len(task), task.horizon, task.action_dim) - 0.5
    pasts, actions = Segment(*(part.repeat(candidates, 1, 1).to(device) for part in past)), actions.to(device)
    weights, buffers = stack_module_state(nets)
    whole = Rollout(deepcopy(nets[0]))
    whole.net.features.settle()
    named = {f"net.{name}": part.detach() for name, part in (weights | buffers).items()}

    @torch.no_grad()
    def many() -> None:
        with as_operations():
            vmap(lambda own: functional_call(whole, own, (pasts, actions)))(named)

    @torch.no_grad()
    def one() -> None:
        rollout(nets[0], pasts, actions)

    return {"one": timed(device, one), "many": timed(device, many)}


def policies(word: str, copies: int) -> dict[str, Callable[[], float]]:
    """Seconds of an update of one policy, and of ``copies`` in as many models."""
    run, data = runs.resolve("bench", scale="laptop"), study.random_data(ENV, 50, seed=0)
    task, draw = study.load_task(ENV), episodes_from(torch.from_numpy(data.states[:, 0]))
    o = LearningOptions(horizon=task.horizon, iterations=UPDATES, record_every=UPDATES)
    (dx, du), latent = (data.states.shape[2], data.actions.shape[2]), word in zoo.words(cls=zoo.CODED)
    nets: list[Any] = [study.initialise(run, word, data) for _ in range(copies)]
    made: list[Policy] = []
    for _ in nets:
        prior: Any = study.initialise(run, "prior", data)
        policy = (
            SegmentPolicy(dx, prior, angles=data.angles, copies=3) if latent
            else OneStepPolicy(dx, du, angles=data.angles, copies=3)
        )  # fmt: skip
        policy.features.fit(torch.from_numpy(data.states))
        made.append(policy)

    def one() -> float:
        return learn_policy(made[0], nets[0], task.reward_for, draw, o).seconds[-1] / UPDATES

    def many() -> float:
        curves = learn_stacked(made, nets, task.reward_for, [draw] * copies, o, seeds=range(copies))
        return curves[0].seconds[-1] / UPDATES

    return {"one": one, "many": many}


def main() -> None:
    options = parser(__doc__, rounds=7)
    options.add_argument("--models", default="tsm,onestep,multistep,rtsm")
    options.add_argument("--plans", default="tsm,onestep,lstm,rtsm", help="models in which candidates are rolled out")
    options.add_argument("--candidates", type=int, default=96, help="for each target (default 96)")
    options.add_argument("--policies", default="tsm,onestep,lstm,rtsm", help="models of the policies")
    options.add_argument("--copies", type=int, default=10)
    options.add_argument("--device", default="cpu")
    arguments = parsed(options)
    rows, copies = [], arguments.copies
    for word in filter(None, arguments.models.split(",")):
        for stage in study.schedule(runs.resolve("bench", scale="laptop"), ENV, word):
            what = "a gradient"
            if word == "rtsm":
                what, n = "ten steps and back", stage.batch * (1 if stage.loss == "point_loss" else SAMPLES)
                net = study.initialise(runs.resolve("bench", scale="laptop"), word, study.random_data(ENV, 50, seed=0))
                net = net.to(arguments.device)
                both = {"one": step(net, 1, n, arguments.device), "many": step(net, copies, n, arguments.device)}
            else:
                both = ways(word, stage, copies, arguments.device)
            seconds = interleaved(both, arguments.rounds)
            rows.append(Row.of(
                f"{copies} trainings of {word} as one, {stage.loss}, {what}: seconds", seconds["many"],
                "one training", seconds["one"], unit="s", env=ENV, sim="mujoco", task="push", model=word,
                configuration=stage.loss, metric="seconds",
            ))  # fmt: skip
    for word in filter(None, arguments.plans.split(",")):
        seconds = interleaved(rollouts(word, copies, arguments.candidates, arguments.device), arguments.rounds)
        rows.append(Row.of(
            f"{copies} rollouts in {word} as one: seconds", seconds["many"], "one rollout", seconds["one"],
            unit="s", env=ENV, sim="mujoco", task="push", model=word, configuration="plan", metric="seconds",
        ))  # fmt: skip
    for word in filter(None, arguments.policies.split(",") if arguments.device == "cpu" else []):
        seconds = interleaved(policies(word, copies), arguments.rounds)
        rows.append(Row.of(
            f"{copies} policies in {word} as one, an update: seconds", seconds["many"], "one policy", seconds["one"],
            unit="s", env=ENV, sim="mujoco", task="push", model=word, configuration="policy", metric="seconds",
        ))  # fmt: skip
    print(f"{ENV}, {arguments.rounds} rounds, {arguments.threads} threads, {arguments.device}")
    save("copies", rows)


if __name__ == "__main__":
    main()
