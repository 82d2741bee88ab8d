"""Robots of one's own: short from id to film, drawn as they are, compared at equal time; mistakes are not silent."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gymnasium
import nbformat
import numpy as np
import pytest
import torch
from gymnasium.envs.classic_control import PendulumEnv
from gymnasium.envs.registration import register, registry
from PIL import Image
from torch import Tensor

import tsmlib
from tsmlib.envs import drawing
from tsmlib.envs.snapshots import restore, save
from tsmlib.storage import tables
from reproduction import publish, robots, runs
from reproduction.media import film
from reproduction.results import robots as results
from reproduction.runs import ROOT, Run
from tsmlib.trajectory import Trajectories, TrajectoryError

PENDULUM, HOPPER, CHEETAH = results.ENVS
RUN = Run("09_your_own", "smoke", 0, ROOT / "runs" / "nowhere")
still: Callable[[Tensor, Tensor], Tensor] = lambda x, u: -x[..., 0].square()  # noqa: E731


def pendulum(**options: Any) -> Trajectories:
    return tsmlib.collect_random(PENDULUM, episodes=4, horizon=20, **options)


# Length --------------------------------------------------------------------------------------------------------------


def robot_cells() -> dict[str, str]:
    """Environment -> the cell of the notebook that goes from its id to a film."""
    cells = [cell.source for cell in nbformat.read(runs.notebooks()["your_own"].path, 4).cells]
    return {
        env: next(cell for cell in cells if f'collect_random("{env}"' in cell)
        for env in results.ENVS
    }


@pytest.mark.parametrize(("env", "most"), [(PENDULUM, 13), (HOPPER, 15), (CHEETAH, 15)])
def test_from_an_id_to_a_film_it_is_a_cell_of_the_public_interface(env: str, most: int) -> None:
    cell = robot_cells()[env]
    assert (
        len(cell.splitlines()) <= most
    )  # that of the pendulum has one of the film beyond twelve to the executed plan
    assert set(re.findall(r"tsmlib\.(\w+)", cell)) <= set(tsmlib.__all__)
    assert cell.splitlines()[-1].startswith("figures.embed(tsmlib.film(task, trial, ")
    assert all(
        word in cell
        for word in ("tsmlib.fit(", "tsmlib.Task.from_env(", "tsmlib.mpc(", 'progress="')
    )


def test_from_an_id_to_an_executed_plan_the_pendulum_of_the_guide_takes_twelve_lines() -> None:
    text = (ROOT / "docs" / "howto" / "own_robot.md").read_text()  # whose programs test_docs runs
    block = next(
        block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if PENDULUM in block
    )
    lines = [
        line for line in block.splitlines() if line and not line.startswith(("import ", "print("))
    ]
    assert len(lines) <= 12
    assert lines[-1].startswith("trial = tsmlib.execute(")


# Pictures ------------------------------------------------------------------------------------------------------------


def test_robots_are_drawn_from_what_they_observe_and_others_are_named() -> None:
    drawn = [PENDULUM, HOPPER, CHEETAH, "Walker2d-v5", "InvertedPendulum-v5"]
    others = ["Ant-v5", "Swimmer-v5", "Reacher-v5", "MountainCarContinuous-v0"]
    assert [drawing.drawable(env) for env in drawn + others] == [True] * len(drawn) + [False] * len(
        others
    )
    with pytest.raises(
        ValueError, match="Ant-v5 cannot be drawn from its observations; film it by its own render"
    ):
        drawing.frames("Ant-v5", np.zeros((2, 105)))


def coloured(frame: np.ndarray, colour: str) -> np.ndarray:
    """Rows and columns (n, 2) of the pixels of a colour."""
    return np.argwhere((frame == Image.new("RGB", (1, 1), colour).getpixel((0, 0))).all(-1))


def test_a_pendulum_is_drawn_where_its_angle_says() -> None:
    angles = np.array([0.0, np.pi / 2, np.pi])  # up, to the left, down
    states = np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
    middles = [coloured(frame, drawing.BODY).mean(0) for frame in drawing.frames(PENDULUM, states)]
    away = np.array(middles) - (drawing.HEIGHT / 2, drawing.WIDTH / 2)
    assert away[0, 0] < -30
    assert away[1, 1] < -30
    assert away[2, 0] > 30
    assert abs(away[[0, 2], 1]).max() < 2


def test_a_cheetah_keeps_its_place_in_the_picture_while_the_ground_moves_by_its_speed() -> None:
    states = np.zeros((3, 17))
    states[:, 8] = 4.0  # metres per second forward, 0.05 s a step
    frames = drawing.frames(CHEETAH, states)
    bodies = [coloured(frame, drawing.BODY).mean(0) for frame in frames]
    np.testing.assert_allclose(bodies[2], bodies[0], atol=0.5)
    marks = [coloured(frame, drawing.MARK)[:, 1].min() for frame in frames]
    assert marks[0] != marks[1] != marks[2]


class Pictured(PendulumEnv):
    """A pendulum under another id, whose pictures say which step it is; ``broken``: it gives none."""

    def __init__(self, broken: bool = False, **options: Any) -> None:
        super().__init__(**options)
        self.broken, self.taken = broken, 0

    def step(self, u: np.ndarray) -> Any:
        self.taken += 1
        return super().step(u)

    def render(self) -> Any:
        if self.broken:
            raise OSError("no screen")
        return np.full((40, 60, 3), self.taken, np.uint8)


@pytest.fixture
def made() -> Iterator[Callable[..., str]]:
    names = []

    def make(**how: Any) -> str:
        names.append(f"tests/Pictured{len(names)}-v0")
        register(
            names[-1],
            entry_point=lambda **options: Pictured(**how, **options),
            max_episode_steps=200,
        )
        return names[-1]

    yield make
    for name in names:
        del registry[name]


def executed(env: str, horizon: int = 4) -> tuple[tsmlib.Task, tsmlib.Trial]:
    """A plan without thought, and its execution."""
    task = tsmlib.Task.from_env(env, n=2, horizon=horizon, reward=still)
    space = tsmlib.DirectActions(horizon, task.action_dim, rms=0.5)
    model = tsmlib.OneStep.for_data(tsmlib.collect_random(env, episodes=2, horizon=10), hidden=8)
    return task, tsmlib.mpc(
        task, model, space, partial(tsmlib.cem, candidates=4, elites=2, iterations=1), every=4
    )


def test_a_film_shows_prediction_and_execution_to_the_end_of_the_episode() -> None:
    task, trial = executed(HOPPER, horizon=60)
    assert trial.lengths
    found = film(task, trial, 1)
    assert len(found) == trial.lengths[1]
    assert found.shape[2] == 2 * drawing.WIDTH


def test_a_robot_that_cannot_be_drawn_films_itself_or_says_what_is_missing(
    made: Callable[..., str],
) -> None:
    task, trial = executed(made())
    assert [frame[-1, -1, 0] for frame in film(task, trial, 1)] == [1, 2, 3, 4]
    task, trial = executed(made(broken=True))
    with pytest.raises(
        RuntimeError, match=r"tests/Pictured1-v0 gives no pictures here: no screen.*MUJOCO_GL=egl"
    ):
        film(task, trial, 0)


# Comparisons ---------------------------------------------------------------------------------------------------------


def test_a_model_is_trained_for_about_as_long_as_was_asked() -> None:
    data = tsmlib.collect_random(PENDULUM, episodes=20, horizon=60)
    net, taken = robots.train_for(1.0, "onestep", data, data.take(slice(4)))
    assert 0.3 < taken < 3
    assert net.features.fitted


def test_the_oracle_is_the_same_planner_and_beats_doing_nothing() -> None:
    task = tsmlib.Task.from_env(
        PENDULUM, n=3, horizon=10, seed=5, reward=lambda x, u: -x[..., 2].square()
    )
    space = tsmlib.DirectActions(10, 1, rms=0.5)
    planner = partial(tsmlib.cem, candidates=12, elites=3, iterations=2)
    trial = tsmlib.execute(task, torch.zeros(3, 10, 1))
    rows = tables.frame(
        robots.reference_rows(RUN, task, "rtsm", trial, space, planner, every=5, n=2)
    )
    found = rows[rows["metric"] == "return_true"].set_index(["model", "planner"])
    assert set(found.index) == {
        ("rtsm", "cem"),
        ("oracle", "cem"),
        ("none", "zero"),
        ("none", "random"),
    }
    assert found["n"].tolist() == [3, 2, 3, 3]
    nothing = tsmlib.execute(task.take(2), torch.zeros(2, 10, 1)).executed_return.mean()
    assert found.loc[("oracle", "cem"), "value"] > nothing
    assert found.loc[("rtsm", "cem"), "value"] == pytest.approx(
        found.loc[("none", "zero"), "value"]
    )


def test_the_sentence_and_the_tables_say_what_the_rows_say() -> None:
    common = dict(env=HOPPER, planner="none", execution="open loop", n=7, seed=0, scale="smoke")
    rows = tables.frame(
        [
            common | dict(model=model, metric=metric, steps_ahead=steps, value=value * steps)
            for model, value in (("rtsm", 0.02), ("lstm", 0.04), ("onestep", 0.05))
            for metric in results.SCORES
            for steps in results.AHEAD
        ]
        + [
            common | dict(model=model, metric="train_seconds", value=9.0)
            for model in ("rtsm", "lstm", "onestep")
        ]
    )
    assert "`rtsm` is 0.50 times that of the best other, `lstm`, at 10 steps" in results.sentences(
        rows
    )
    lines = results.scores_table(rows).splitlines()
    assert [cell.strip() for cell in lines[2].split("|")][2:] == [
        "`rtsm`",
        "0.2",
        "1",
        "0.2",
        "1",
        "9",
        "7",
        "",
    ]
    assert "-0.86" in results.model_free_table()


def test_the_table_of_one_notebook_is_published_with_all_its_seeds(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tests.test_publish import seed

    monkeypatch.setattr(publish, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(publish, "publish_claims", lambda: None)
    (tmp_path / "results").mkdir()
    run = seed(tmp_path, 0)
    seed(tmp_path, 1)
    publish.publish_table(run, "09_your_own")
    assert tables.load(tmp_path / "results" / "09_your_own.csv")["seed"].tolist() == [0, 1]
    assert [path.name for path in (tmp_path / "results").iterdir()] == ["09_your_own.csv"]


# Mistakes that used to be silent -------------------------------------------------------------------------------------


def test_actions_of_another_scale_are_refused_with_what_to_divide_them_by() -> None:
    data = pendulum()
    with pytest.raises(
        TrajectoryError, match=r"go up to 2.*within \[-1, 1\].*actions / env.action_space.high"
    ):
        Trajectories(
            data.states,
            2 * np.sign(data.actions),
            PENDULUM,
            data.dt,
            data.names,
            data.units,
            angles=(),
        )


def test_no_dimension_is_taken_for_an_angle_unless_it_is_named() -> None:
    data = pendulum()
    assert data.angles == ()
    for model in (tsmlib.TSM, tsmlib.RecurrentTSM, tsmlib.OneStep, tsmlib.LSTM, tsmlib.Ensemble):
        assert model.for_data(data).features.angles == []  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "model", [tsmlib.TSM, tsmlib.RecurrentTSM, tsmlib.OneStep, tsmlib.LSTM, tsmlib.Ensemble]
)
def test_a_model_that_was_never_fitted_neither_scores_nor_plans(model: Any) -> None:
    data, net = pendulum(), model(3, 1)
    with pytest.raises(
        ValueError, match=rf"features of this {model.__name__} were never fitted.*for_data\(traj"
    ):
        tsmlib.score(net, net.features, data, data, samples=1, horizon=5)
    task = tsmlib.Task.from_env(PENDULUM, n=2, horizon=10, reward=still)
    with pytest.raises(ValueError, match="were never fitted, so it cannot predict"):
        tsmlib.cem(
            tsmlib.model_predictor(net, task.past(net.past_len)),
            still,
            tsmlib.DirectActions(10, 1),
            2,
        )


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (lambda x, u: x[..., 0].numpy(), "is a ndarray; expected a tensor"),
        (lambda x, u: x.mean(), r"is a tensor \(\); expected a tensor"),
        (lambda x, u: x[..., 9], r"the reward fails on states .* Count dimensions from the right"),
        (lambda x, u: x[..., 0] / 0 * 0, "the reward is nan for target 0 at step 0"),
    ],
)
def test_a_reward_of_another_shape_is_refused(reward: Any, message: str) -> None:
    with pytest.raises((ValueError, FloatingPointError), match=message):
        tsmlib.Task.from_env(PENDULUM, n=2, horizon=4, reward=reward)


# Snapshots -----------------------------------------------------------------------------------------------------------


def test_a_snapshot_brings_back_random_generators_and_nested_values() -> None:
    env: Any = gymnasium.make(PENDULUM).unwrapped
    env.reset(seed=1)
    env.kept = {"numbers": [1, 2], "array": np.zeros(2)}
    taken = save(env)
    drawn = env.np_random.standard_normal(3)
    env.kept["numbers"].append(3)
    env.kept["array"] += 1
    restore(env, taken)
    np.testing.assert_array_equal(env.np_random.standard_normal(3), drawn)
    assert env.kept["numbers"] == [1, 2]
    assert env.kept["array"].tolist() == [0, 0]
    env._np_random = None
    restore(env, taken)
    np.testing.assert_array_equal(env.np_random.standard_normal(3), drawn)
