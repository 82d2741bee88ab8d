"""Wrong calls of public names end in an error of ours that names the argument, never in silence."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from wrong_calls import (
    COUNT_OR_ZERO,
    NOT_NEGATIVE,
    OPTIONAL,
    POSITIVE,
    Call,
    Made,
    call,
    finding,
)

import tsmlib
from tsmlib.models.features import Features

DX, DU, T = 3, 2, 12


def data(dt: float = 0.1, n: int = 4, dx: int = DX, **meaning: Any) -> tsmlib.Trajectories:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (n, T, DU)).astype(np.float32)
    states = rng.normal(size=(n, T + 1, dx)).astype(np.float32).cumsum(1) / 10
    return tsmlib.Trajectories(states, actions, meaning.pop("env", "made"), dt, **meaning)


OWN, OTHER, SMALLER = data(), data(dt=0.5, env="other"), data(dx=DX - 1)
SMALL: dict[str, Any] = {
    "TSM": dict(segment_len=4, latent_dim=2, channels=4, dilations=(1, 2)),
    "RecurrentTSM": dict(hidden=4, latent_dim=2, past_len=4, code_len=4, segment_len=8),
    "OneStep": dict(hidden=4, layers=1),
    "LSTM": dict(hidden=4, past_len=4, segment_len=8),
    "Ensemble": dict(members=2, hidden=4, layers=1, segment_len=8),
    "ActionPrior": dict(segment_len=4, latent_dim=2, channels=4, dilations=(1, 2)),
}
KINDS = {name: getattr(tsmlib, name) for name in SMALL}
MORE = {  # arguments beside those above
    "TSM": dict(
        beta=1.0,
        head_channels=0,
        plain=False,
    ),
    "Ensemble": dict(gaussian=True),
    "ActionPrior": dict(beta=0.03),
}
ALLOWED = {
    "beta": NOT_NEGATIVE,
    "head_channels": COUNT_OR_ZERO,
}
FEW = tsmlib.TrainingOptions(steps=1, batch_size=2)
TITLE = frozenset({"text"})
OWN_LOSS = object()


def new(name: str) -> Any:
    return KINDS[name].for_data(OWN, **SMALL[name])


def fit(function: Any = tsmlib.fit, **given: Any) -> Any:
    """``function``, by the loss of the model that is given where that is asked for."""
    own = given["loss"] is OWN_LOSS
    return function(**given | ({"loss": getattr(given["model"], "loss", None)} if own else {}))


ROBOTS = {"of another robot": OTHER, "of other sizes": SMALLER}
SHORT = torch.zeros(2, 0, DX), torch.zeros(2, 0, DU)
PAST = tsmlib.Segment(torch.zeros(2, 4, DX), torch.zeros(2, 4, DU))
FIT: dict[str, Any] = dict(
    model=Made(lambda: new("OneStep")),
    data=OWN,
    validation=OWN,
    options=FEW,
    loss=OWN_LOSS,
    seed=0,
    device="cpu",
    progress=False,
    callback=print,
)
FIT_ALSO = {
    "data": ROBOTS,
    "validation": ROBOTS,
    "loss": {"of another model": new("OneStep").loss, "of nothing": lambda *_: torch.tensor(0.0)},
}
FIT_WORDS = {"data": ("robot",), "validation": ("robot",)}
FIT_ALLOWED = {
    "validation": OPTIONAL,
    "options": OPTIONAL,
    "loss": OPTIONAL,
    "callback": OPTIONAL,
    "seed": COUNT_OR_ZERO,
    "progress": TITLE,
}
CALLS = [
    *(
        Call(
            name,
            kind,
            ({} if name == "ActionPrior" else dict(state_dim=DX, angles=(0,)))
            | dict(action_dim=DU)
            | SMALL[name]
            | MORE.get(name, {}),
            ALLOWED,
            {"angles": {"beyond": (DX,), "twice": (0, 0), "below": (-1,)}},
        )
        for name, kind in KINDS.items()
    ),
    *(
        Call(f"{name}.for_data", kind.for_data, dict(data=OWN, seed=0), {"seed": COUNT_OR_ZERO})
        for name, kind in KINDS.items()
    ),
    *(
        Call(
            f"{name}.predict",
            new(name).predict,
            dict(past=PAST, actions=torch.zeros(2, 5, DU), samples=2, seed=0),
            {"samples": OPTIONAL, "seed": COUNT_OR_ZERO},
            {
                "past": {"too short": SHORT, "of another batch": tuple(p[:1] for p in PAST)},
                "actions": {"none": torch.zeros(2, 0, DU), "too many": torch.zeros(2, 5, DU + 1)},
            },
        )
        for name in KINDS
        if name != "ActionPrior"
    ),
    Call(
        "rollout",
        tsmlib.rollout,
        dict(model=new("TSM"), past=PAST, actions=torch.zeros(2, 5, DU)),
        also={
            "model": {"never fitted": tsmlib.TSM(DX, DU)},
            "past": {"too short": SHORT, "swapped": tsmlib.Segment(PAST.actions, PAST.states)},
            "actions": {"one row": torch.zeros(1, 5, DU), "flat": torch.zeros(5, DU)},
        },
        words={"model": ("features of this",), "actions": ("past.states",)},
    ),
    Call(
        "ActionPrior.plan",
        new("ActionPrior").plan,
        dict(past_actions=torch.zeros(2, 4, DU), z=torch.zeros(2, 3, 2)),
    ),
    Call("Features", Features, dict(state_dim=DX, angles=(0,))),
    Call("Features.fit", Features(DX).fit, dict(data=OWN), also={"data": {"sizes": SMALLER}}),
    Call(
        "TrainingOptions",
        tsmlib.TrainingOptions,
        dict(
            past_len=4,
            future_len=4,
            steps=3,
            batch_size=2,
            lr=1e-3,
            lr_final=1e-5,
            warmup=1,
            muon=0.01,
            span=(0.0, 1.0),
            clip=1.0,
            validate_every=2,
            patience=1,
        ),
        dict.fromkeys(("past_len", "future_len"), OPTIONAL)
        | dict.fromkeys(("lr_final", "muon"), NOT_NEGATIVE)
        | {"lr": POSITIVE, "clip": POSITIVE | {"infinite"}}
        | {"warmup": COUNT_OR_ZERO | OPTIONAL | {"huge"}, "patience": COUNT_OR_ZERO | {"huge"}}
        | dict.fromkeys(("steps", "batch_size", "validate_every"), frozenset({"huge"}))
        | {"past_len": OPTIONAL | {"huge"}, "future_len": OPTIONAL | {"huge"}},
        {"span": {"backwards": (1.0, 0.0), "beyond": (0.0, 2.0), "three": (0.0, 0.5, 1.0)}},
    ),
    Call("fit", fit, FIT, FIT_ALLOWED, FIT_ALSO, FIT_WORDS),
    Call(
        "fine_tune",
        partial(fit, tsmlib.fine_tune),
        FIT | dict(part="all"),
        FIT_ALLOWED,
        FIT_ALSO | {"part": {"that it has not": "codes"}},
        FIT_WORDS,
    ),
    Call("CsvCallback", tsmlib.CsvCallback, dict(path="losses.csv"), {"path": frozenset({"text"})}),
]


@pytest.mark.parametrize("case", CALLS, ids=lambda case: case.name)
def test_a_wrong_call_is_refused_by_the_name_of_its_argument(case: Call) -> None:
    call(case)  # the correct one
    findings = [finding(case, *wrong) for wrong in case.cases()]
    assert not (found := [text for text in findings if text]), "\n".join(found)


def test_so_many_wrong_calls_are_tried() -> None:
    assert sum(len(case.cases()) for case in CALLS) > 800
