"""Minari data sets of any lengths and metadata are read as they are, or refused by name."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Space

from tsmlib.contrib.minari import load_minari
from tsmlib.storage.files import StoreError

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")

DX, DU = 3, 2
LOW, HIGH = np.array([-0.5, -1.0], np.float32), np.array([2.0, 3.0], np.float32)


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))


def written(
    lengths: tuple[int, ...] = (5, 5),
    *,
    ended: tuple[int, ...] = (),
    observations: Space | None = None,
    actions: Space | None = None,
    dtype: Any = np.float32,
    change: Callable[[list[Any]], Any] = lambda episodes: None,
    **options: Any,
) -> Path:
    """A data set that Minari itself wrote. Episode i has the states i + 0.01 t."""
    observed = observations or Box(-np.inf, np.inf, (DX,), dtype)
    acted = actions or Box(-1, 1, (DU,), np.float32)
    acted.seed(0)
    episodes = []
    for i, steps in enumerate(lengths):
        x = (i + 0.01 * np.arange(steps + 1, dtype=dtype))[:, None] + np.zeros(DX, dtype)
        last = np.arange(steps) == steps - 1
        episodes.append(
            dict(
                observations={"x": x}
                if isinstance(observed, Dict)
                else np.broadcast_to(
                    x.reshape(len(x), *[1] * (len(observed.shape or ()) - 1), DX),
                    (len(x), *observed.shape),
                ).astype(observed.dtype),
                actions=np.stack([acted.sample() for _ in range(steps)]),
                rewards=np.zeros(steps),
                terminations=last & (i in ended),
                truncations=last & (i not in ended),
            )
        )
    change(episodes)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = minari.create_dataset_from_buffers(
            "made/data-v0",
            [minari.data_collector.EpisodeBuffer(**episode) for episode in episodes],
            observation_space=observed,
            action_space=acted,
            **options,
        )
    return Path(made.spec.data_path).parent


def oracle(folder: Path) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """States and actions of each episode as Minari gives them."""
    found = list(minari.MinariDataset(folder / "data").iterate_episodes())
    return [episode.observations for episode in found], [episode.actions for episode in found]


SHAPES: dict[str, dict[str, Any]] = {
    "equal": {},
    "early ends": {"lengths": (5, 3, 7), "ended": (1,)},
    "one-step episodes": {"lengths": (1, 4, 1), "ended": (0, 2)},
    "one episode": {"lengths": (6,)},
    "all terminated": {"lengths": (4, 4), "ended": (0, 1)},
    "float64": {"dtype": np.float64, "lengths": (5, 2)},
    "with an environment": {
        "env": "Pendulum-v1",
        "lengths": (3, 2),
        "actions": Box(-2, 2, (1,), np.float32),
    },
    "asymmetric bounds": {"actions": Box(LOW, HIGH, dtype=np.float32), "lengths": (5, 4)},
    "float64 actions": {"actions": Box(-0.4, 0.4, (DU,), np.float64)},
    "whole numbers": {"observations": Box(0, 9, (DX,), np.int64)},
    "many": {"lengths": tuple(range(1, 41)), "ended": tuple(range(0, 40, 2))},
}


@pytest.mark.parametrize("shape", SHAPES)
def test_what_minari_wrote_is_read_as_it_is(shape: str) -> None:
    options = SHAPES[shape]
    folder, lengths = written(**options), options.get("lengths", (5, 5))
    with pytest.warns(
        UserWarning,
        match="does not say how long a step is; one step counts as one second: give dt=",
    ):
        data = load_minari(folder)
    states, actions = oracle(folder)
    space = options.get("actions", Box(-1, 1, (DU,)))
    assert data.steps.tolist() == list(lengths)
    assert data.terminated == tuple(i in options.get("ended", ()) for i in range(len(lengths)))
    assert (data.env, data.dt) == (options.get("env", "made/data-v0"), 1.0)
    assert (data.names, data.angles) == (("x0", "x1", "x2"), ())
    for i, steps in enumerate(lengths):
        np.testing.assert_array_equal(data.episode(i)[0], states[i].astype(np.float32))
        for k in range(steps):
            scaled = [
                2 * (u - a) / (b - a) - 1
                for u, a, b in zip(actions[i][k], space.low, space.high, strict=True)
            ]
            np.testing.assert_allclose(data.episode(i)[1][k], scaled, atol=1e-6)


def test_what_data_mean_can_be_said(recwarn: pytest.WarningsRecorder) -> None:
    given: dict[str, Any] = dict(
        env="cart", dt=0.05, names=("a", "b", "c"), units=("m", "m/s", "rad"), angles=(2,)
    )
    data = load_minari(written(), **given)
    assert {name: getattr(data, name) for name in given} == given
    assert not recwarn.list


def test_a_data_set_is_found_by_its_id() -> None:
    written()
    assert len(load_minari("made/data-v0", dt=0.1)) == 2
    with pytest.raises(StoreError, match="made/other-v0 holds no usable"):
        load_minari("made/other-v0")


def goes_on(episodes: list[Any]) -> None:
    episodes[0]["terminations"][2] = True


def beyond(episodes: list[Any]) -> None:
    episodes[1]["actions"] = 3 * np.ones_like(episodes[1]["actions"])


def not_finite(episodes: list[Any]) -> None:
    episodes[1]["observations"][2, 1] = np.nan


def too_few_states(episodes: list[Any]) -> None:
    episodes[1]["observations"] = episodes[1]["observations"][:-1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"observations": Dict({"x": Box(-1, 1, (DX,))})},
            "observations are a dictionary, .*supported are",
        ),
        ({"actions": Discrete(3)}, "actions are discrete, .*Discrete.*supported are"),
        (
            {"observations": Box(0, 255, (4, DX), np.uint8)},
            "observations are images, .*supported are",
        ),
        (
            {"actions": Box(-np.inf, np.inf, (DU,), np.float32)},
            "actions have no bounds, .*make Trajectories of it",
        ),
        ({"actions": Box(0, np.inf, (DU,), np.float32)}, "actions have no bounds"),
        ({"change": goes_on}, "episode 0 goes on after its termination at step 2"),
        ({"change": beyond}, "actions of episode 1 leave the action space, by a factor of 3"),
        ({"change": not_finite}, "not finite, the first in episode 1, step 2, field 'x1'"),
        ({"change": too_few_states}, r"states \(5, 3\) and actions \(5, 2\) of episode 1"),
    ],
    ids=lambda part: "" if isinstance(part, dict) else part[:30],
)
def test_another_kind_of_data_is_refused_by_name(options: dict[str, Any], message: str) -> None:
    folder = written(**options)
    with pytest.raises(StoreError, match=message) as caught:
        load_minari(folder, dt=0.1)
    assert str(folder) in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"env_spec": json.dumps({"id": ["os:system"]})},
            "no usable Minari data set",
        ),
        ({"data_format": "arrow"}, "in the format 'arrow', expected 'hdf5'"),
    ],
)
def test_metadata_that_say_something_else_are_refused(change: dict[str, Any], message: str) -> None:
    folder = written()
    file = folder / "data" / "metadata.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    with pytest.raises(StoreError, match=message):
        load_minari(folder)
