"""Any environment: what is collected, executed and predicted is what stepping it gives, or an error
says why not.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing, nullcontext
from functools import partial
from typing import Any

import gymnasium
import gymnasium.wrappers as W
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import register, registry
from gymnasium.spaces import Box, flatten
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from hostile import HOSTILE, Cart, DictObservation
from torch import Tensor

import tsmlib
from tsmlib.collection import collect, open_loop, smooth_torques
from tsmlib.envs import stepping
from tsmlib.envs.ids import environment_id, stated_id
from tsmlib.envs.spaces import idle_action, within_bounds
from tsmlib.envs.stepping import (
    Stepping,
    UnsupportedEnvironment,
    Vectorised,
    make_simulation,
    simulation,
)
from tsmlib.envs.unstable import SimulationUnstable

PENDULUM, HOPPER, CHEETAH = "Pendulum-v1", "Hopper-v5", "HalfCheetah-v5"
V5 = [
    "Ant",
    "HalfCheetah",
    "Hopper",
    "Humanoid",
    "HumanoidStandup",
    "InvertedDoublePendulum",
    "InvertedPendulum",
    "Pusher",
    "Reacher",
    "Swimmer",
    "Walker2d",
]
IDS = [PENDULUM, "MountainCarContinuous-v0", "Pendulum-v1(g=1.0)", "HalfCheetah-v5(frame_skip=10)"]
IDS += [f"{name}-v5" for name in V5] + [f"{name}-v4" for name in V5 if name != "Pusher"]


def still(states: Tensor, actions: Tensor) -> Tensor:
    """Move little, with little."""
    return -states[..., 0].square() - 0.1 * actions.square().sum(-1)


def random_actions(n: int, horizon: int, dim: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return smooth_torques(n, horizon, generator=generator, action_dim=dim, rms=0.8)


def stepped(env_id: str, actions: Tensor, seed: int) -> list[tuple[np.ndarray, float, bool]]:
    """Observations, return and termination of every episode, from a loop that knows nothing of
    tsmlib.
    """
    found = []
    name, _, given = env_id.partition("(")
    for i, own in enumerate(actions.double().numpy()):
        env = gymnasium.make(name, **(eval(f"dict({given}") if given else {}))  # noqa: S307
        low, high = env.action_space.low.ravel(), env.action_space.high.ravel()
        space: Any = env.action_space
        seen, total, over = [], 0.0, False
        seen.append(np.array(flatten(env.observation_space, env.reset(seed=seed + i)[0]), float))
        for u in own:
            x, reward, over, late, _ = env.step(
                (low + (u + 1) / 2 * (high - low)).astype(space.dtype).reshape(space.shape)
            )
            seen.append(np.array(flatten(env.observation_space, x), float))
            total += float(np.sum(reward))
            if over or late:
                break
        found.append((np.stack(seen), total, bool(over)))
    return found


Made = Callable[..., str]


@pytest.fixture
def made() -> Iterator[Made]:
    """Registers an environment for one test."""
    names = []

    def make(entry: Callable[..., gymnasium.Env], **options: Any) -> str:
        names.append(f"hostile/Own{len(names)}-v0")
        options = {"max_episode_steps": 50, **options}
        register(names[-1], entry_point=entry, disable_env_checker=True, **options)
        return names[-1]

    yield make
    for name in names:
        del registry[name]


# The table: from an id to data, a model and a closed loop -----------------------------------------


def closed_loop(env_id: str) -> tuple[tsmlib.Task, tsmlib.Trial]:
    data = tsmlib.collect_random(env_id, episodes=2, horizon=8, seed=0)
    model = tsmlib.OneStep.for_data(data, hidden=4)
    task = tsmlib.Task.from_env(env_id, n=2, horizon=4, reward=still)
    space = tsmlib.DirectActions(task.horizon, task.action_dim, rms=0.5)
    planner = partial(tsmlib.cem, candidates=4, elites=2, iterations=1)
    return task, tsmlib.mpc(task, model, space, planner, every=2)


def require_stepped(task: tsmlib.Task, trial: tsmlib.Trial) -> None:
    """The trial is what a plain loop gives."""
    for i, (seen, total, _) in enumerate(stepped(task.env, trial.actions, task.seeds[0])):
        taken = len(seen) - 1
        np.testing.assert_allclose(trial.states[i, : taken + 1], seen, rtol=1e-6, atol=1e-6)
        assert float(trial.own_return[i]) == pytest.approx(total, rel=1e-4, abs=1e-5)
        assert trial.steps[i] == taken


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.filterwarnings("ignore:.*out of date")
def test_every_robot_of_gymnasium_goes_from_its_id_to_a_closed_loop(env_id: str) -> None:
    require_stepped(*closed_loop(env_id))


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.filterwarnings("ignore:.*float32 tells")
def test_hostile_environments_give_what_stepping_gives_or_an_error_that_says_why(
    name: str, made: Made
) -> None:
    expected = HOSTILE[name]
    env_id = made(expected.made)
    if expected.fails:
        with pytest.raises((ValueError, SimulationUnstable), match=expected.fails):
            tsmlib.collect_random(env_id, episodes=2, horizon=20)
        return
    actions = random_actions(2, 12, make_simulation(env_id, 1).action_dim)
    with (
        pytest.warns(UserWarning, match=expected.warns) if expected.warns else nullcontext(),
        closing(make_simulation(env_id, 2)) as run,
    ):
        first = run.reset(seed=0)
        run.rollout(actions.numpy())
        if not expected.repeats:
            return
    assert (run.names, run.dt) == (expected.names, pytest.approx(run.dt))
    states = make_simulation(env_id, 2)
    np.testing.assert_array_equal(states.reset(seed=0), first)
    rollout = states.rollout(actions.numpy())
    if "Noise" not in name or name == "SeededNoise":
        for i, (seen, total, over) in enumerate(stepped(env_id, actions, seed=0)):
            steps = len(seen) - 1
            np.testing.assert_array_equal(rollout[i, :steps], seen[1:])  # to the last bit
            assert (states.steps[i], bool(states.terminated[i])) == (steps, over)
            assert states.returns[i] == pytest.approx(total)
        require_stepped(*closed_loop(env_id))
    task = tsmlib.Task.from_env(env_id, n=2, horizon=12, reward=still, seed=3)
    candidates = torch.stack([random_actions(2, 12, task.action_dim, seed) for seed in range(3)])
    if expected.oracle:
        with pytest.raises(UnsupportedEnvironment, match=f"has no oracle: .*{expected.oracle}"):
            tsmlib.simulator_predictor(task)(candidates)
        return
    predict = tsmlib.simulator_predictor(task)
    for predicted in (
        predict(candidates)[0],
        predict(candidates)[0],
    ):  # asked again, it says the same
        for one, own in zip(predicted, candidates, strict=True):
            torch.testing.assert_close(one, tsmlib.execute(task, own).states[:, 1:], rtol=0, atol=0)


# Names of robots ----------------------------------------------------------------------------------


def test_an_id_carries_the_arguments_in_which_a_robot_differs() -> None:
    makes = {
        "Pendulum-v1": gymnasium.make_vec(PENDULUM, num_envs=2),
        "Pendulum-v1(g=1.0)": gymnasium.make_vec(PENDULUM, num_envs=2, g=np.float64(1.0)),
        "Pendulum-v1+TimeAwareObservation": gymnasium.make_vec(
            PENDULUM, num_envs=2, wrappers=[gymnasium.wrappers.TimeAwareObservation]
        ),
        "Pendulum-v1(copies differ)": SyncVectorEnv(
            [partial(gymnasium.make, PENDULUM, g=g) for g in (1.0, 2.0)]
        ),
    }
    for name, env in makes.items():
        data = collect(env, open_loop(torch.zeros(2, 3, 1)), horizon=3, seed=0)
        assert data.env.partition("Observation(")[0].removesuffix(
            "Observation"
        ) == name.removesuffix("Observation")
        if name.endswith(("+TimeAwareObservation", "differ)")):
            with pytest.raises(
                UnsupportedEnvironment, match="cannot be made from its id.*register"
            ):
                tsmlib.Task.from_env(data.env, n=1, horizon=3, reward=still)
    with pytest.raises(UnsupportedEnvironment, match="cannot be made from its id"):
        make_simulation("Pendulum-v1(g=earth)", 1)
    assert make_simulation("Pendulum-v1(g=10.0, render_mode=None)", 1).id == "Pendulum-v1(g=10.0)"


def test_an_id_in_a_file_carries_arguments_and_wrappers_too() -> None:
    wrapped = gymnasium.make_vec(PENDULUM, num_envs=1, g=1.0, wrappers=[W.TimeAwareObservation])
    record = json.loads(wrapped.envs[0].spec.to_json())  # type: ignore[attr-defined]
    assert stated_id(record) == "Pendulum-v1(g=1.0)+TimeAwareObservation"


def test_an_argument_that_no_id_can_carry_is_named(made: Made) -> None:
    class Weighed(Cart):
        def __init__(self, weight: Any = None) -> None:
            self.weight = weight

    env = gymnasium.make_vec(made(Weighed), num_envs=1, weight=Weighed)
    with pytest.raises(UnsupportedEnvironment, match="argument weight of .* register it by itself"):
        simulation(env)
    registered = made(Weighed, kwargs={"weight": np.arange(3)})
    assert (
        environment_id(gymnasium.make(registered))
        == make_simulation(registered, 1).id
        == registered
    )


# Time ---------------------------------------------------------------------------------------------


def test_a_step_is_as_long_as_the_clocks_say_or_the_environment_or_counts_as_a_second(
    made: Made,
) -> None:
    def dt(env: VectorEnv | str) -> float:
        run = make_simulation(env, 1) if isinstance(env, str) else simulation(env)
        with closing(run):
            run.reset(seed=0)
            return run.dt

    assert dt(PENDULUM) == 0.05
    assert dt("MountainCarContinuous-v0") == pytest.approx(1 / 30)
    assert dt("HalfCheetah-v5(frame_skip=10)") == pytest.approx(0.1)
    repeat = partial(gymnasium.wrappers.RepeatAction, num_repeats=3)
    for mode in ("sync", "async"):
        for env_id in (PENDULUM, CHEETAH):
            env = gymnasium.make_vec(env_id, num_envs=1, vectorization_mode=mode, wrappers=[repeat])
            assert dt(env) == pytest.approx(0.15)

    class Skips(gymnasium.Wrapper):
        def step(self, action: Any) -> Any:
            return [self.env.step(action) for _ in range(4)][-1]

    assert dt(made(lambda: Skips(Cart()))) == pytest.approx(0.4)
    assert dt(made(lambda: Skips(gymnasium.make(CHEETAH)))) == pytest.approx(0.2)
    for kind in (SyncVectorEnv, AsyncVectorEnv):
        copies = [partial(gymnasium.make, CHEETAH, frame_skip=k) for k in (5, 10)]
        refused = pytest.raises(UnsupportedEnvironment, match="differ in dt, 0.05 and 0.1")
        with closing(kind(copies)) as env, refused:
            simulation(env)
    with pytest.warns(
        UserWarning, match="does not say how long a step is; .* Give it an attribute"
    ):
        assert dt(made(type("Timeless", (Cart,), {"dt": None, "metadata": {}}))) == 1.0


def test_what_an_environment_says_of_itself_is_kept(made: Made) -> None:
    said = {
        "names": ["turn", "speed"],
        "units": ("rad", "m/s"),
        "angles": [0],
        "dt": np.float32(0.5),
    }
    data = tsmlib.collect_random(made(type("Said", (Cart,), said)), episodes=2, horizon=3)
    assert (data.names, data.units, data.angles, data.dt) == (
        ("turn", "speed"),
        ("rad", "m/s"),
        (0,),
        0.5,
    )


@pytest.mark.parametrize(
    "said", [{"names": ("a", "b", "c")}, {"units": ["m"]}, {"angles": (7,)}, {"angles": (True,)}]
)
def test_an_attribute_that_means_something_else_is_not_taken_and_said(
    made: Made, said: dict[str, Any]
) -> None:
    (name,) = said
    with pytest.warns(UserWarning, match=f"attribute {name} of .* not taken"):
        data = tsmlib.collect_random(made(type("Other", (Cart,), said)), episodes=2, horizon=3)
    assert (data.names, data.units, data.angles) == (("x0", "x1"), ("", ""), ())


def test_an_attribute_that_raises_is_named(made: Made) -> None:
    kind = type("Late", (Cart,), {"dt": property(lambda self: {}["reset first"])})
    with pytest.raises(UnsupportedEnvironment, match="dt of Late raises KeyError"):
        tsmlib.collect_random(made(kind), episodes=2, horizon=3)


# Actions ------------------------------------------------------------------------------------------


def test_full_actions_are_the_bounds_and_the_idle_one_is_zero_or_nearest_to_it() -> None:
    space = Box(np.float32([-2, 0, -1, 3]), np.float32([2, 10, 3, 3]))
    found = within_bounds(np.array([[-1] * 4, [0] * 4, [1] * 4, [5, 0.5, 0, 0]]), space)
    expected = [[-2, 0, -1, 3], [0, 5, 1, 3], [2, 10, 3, 3], [2, 7.5, 1, 3]]
    np.testing.assert_array_equal(found, np.array(expected, np.float32))
    np.testing.assert_array_equal(within_bounds(idle_action(space), space), [0, 0, 0, 3])


def test_actions_of_another_size_or_without_a_number_are_refused() -> None:
    run = make_simulation(PENDULUM, 2)
    with pytest.raises(
        ValueError, match=r"actions are \(2, 3, 2\); Pendulum-v1 expected \(2, T, 1\)"
    ):
        run.rollout(np.zeros((2, 3, 2)))
    with pytest.raises(ValueError, match=r"actions has shape \(2, 3, 2\); expected \(2, T, 1\)"):
        collect(run, open_loop(torch.zeros(2, 3, 2)), horizon=3)
    with pytest.raises(ValueError, match="not finite; nothing was simulated"):
        run.rollout(np.full((2, 1, 1), np.nan))


# Episodes -----------------------------------------------------------------------------------------


def test_an_episode_ends_at_the_limit_of_time_without_being_terminated() -> None:
    data = tsmlib.collect_random(PENDULUM, episodes=2, horizon=230, seed=0)
    assert data.steps.tolist() == [200, 200]
    assert not any(data.terminated)


def test_a_controller_in_pieces_gets_what_one_in_a_piece_gets() -> None:
    actions, asked = random_actions(3, 24, 3), []

    def pieces(past: tsmlib.Segment) -> Tensor:
        asked.append(past)
        return actions[:, 7 * (len(asked) - 1) :][:, :7]

    whole, cut = (
        collect(make_simulation(HOPPER, 3), each, horizon=24, seed=0)
        for each in (open_loop(actions), pieces)
    )
    assert whole.steps.tolist() == cut.steps.tolist()
    for i in range(3):
        np.testing.assert_array_equal(whole.episode(i)[0], cut.episode(i)[0])


def test_what_float32_cannot_tell_apart_is_said_and_not_only_lost(made: Made) -> None:
    far = made(type("Far", (Cart,), {"seen": lambda self: self.x + 1e7}))
    with pytest.warns(UserWarning, match=r"x0 of .* is about 1e\+07 .* take off an offset"):
        tsmlib.collect_random(far, 2, horizon=5)
    with closing(make_simulation(far, 2)) as run:
        assert run.reset(seed=0)[0, 0] != np.float32(run.reset(seed=0)[0, 0])


def test_other_robots_begin_from_seeds_and_not_from_observations() -> None:
    run, states = make_simulation(PENDULUM, 2), np.zeros((2, 3))
    with pytest.raises(
        UnsupportedEnvironment, match="Pendulum-v1 cannot begin in given states.*name the seed"
    ):
        collect(run, open_loop(torch.zeros(2, 3, 1)), horizon=3, states=states)
    with pytest.raises(
        ValueError, match="3 seeds for 2 episodes of Pendulum-v1; expected one each"
    ):
        run.reset(seed=[1, 2, 3])
    np.testing.assert_array_equal(run.reset(seed=np.int64(3)), run.reset(seed=[3, 4]))


def test_environments_are_closed_where_something_raises(made: Made) -> None:
    class Counted(Cart):
        open, broken = 0, False

        def __init__(self) -> None:
            Counted.open += 1

        def push(self, u: np.ndarray) -> float:
            if Counted.broken:
                raise RuntimeError("broken")
            return 0.0

        def close(self) -> None:
            Counted.open -= 1

    env_id = made(Counted)
    task = tsmlib.Task.from_env(env_id, n=3, horizon=2, reward=still)
    Counted.broken = True
    for attempt in (
        lambda: tsmlib.collect_random(env_id, 3),
        lambda: tsmlib.execute(task, torch.zeros(3, 2, 1)),
    ):
        with pytest.raises(RuntimeError, match="broken"):
            attempt()
        assert Counted.open == 0
    Counted.action_space = gymnasium.spaces.Discrete(2)
    with pytest.raises(UnsupportedEnvironment):
        make_simulation(env_id, 2)
    assert Counted.open == 0


# Vector environments ------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", list(AutoresetMode))
@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv])
@pytest.mark.parametrize("copy", [True, False])
def test_what_a_vector_environment_makes_of_ended_episodes_stays_out_of_the_data(
    kind: Any, mode: AutoresetMode, copy: bool
) -> None:
    env_id, actions = "InvertedPendulum-v5", random_actions(3, 20, 1)
    env = kind([partial(gymnasium.make, env_id)] * 3, autoreset_mode=mode, copy=copy)
    with closing(Vectorised(env)) as run:
        run.reset(seed=1)
        states = run.rollout(actions.numpy())
    for i, (seen, total, over) in enumerate(stepped(env_id, actions, seed=1)):
        np.testing.assert_array_equal(states[i, : len(seen) - 1], seen[1:])
        assert (run.steps[i], bool(run.terminated[i]), run.returns[i]) == (
            len(seen) - 1,
            over,
            total,
        )
    assert min(run.steps) < 20


@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv])
def test_dictionaries_come_from_vector_environments_too(kind: Any) -> None:
    env, actions = kind([DictObservation] * 2), random_actions(2, 5, 1)
    with closing(simulation(env)) as run:
        first, states = run.reset(seed=0), run.rollout(actions.numpy())
    assert (run.id, run.names) == ("DictObservation", ("speed", "position[0]"))
    assert first[0, 1] != first[1, 1] == pytest.approx(states[1, 0, 1], abs=0.2)


def test_copies_that_are_one_object_are_refused() -> None:
    one = Cart()
    with pytest.raises(
        UnsupportedEnvironment, match="2 copies of Cart are one and the same object"
    ):
        simulation(SyncVectorEnv([lambda: one] * 2))


def test_copies_whose_models_were_edited_move_as_their_own_do() -> None:
    def robot(gravity: float) -> gymnasium.Env:
        env = gymnasium.make(CHEETAH)
        env.unwrapped.model.opt.gravity[2] = gravity  # type: ignore[attr-defined]
        return env

    pulls = (-9.81, -1.6)
    actions = random_actions(2, 20, 6)
    run = simulation(SyncVectorEnv([partial(robot, pull) for pull in pulls]))
    run.reset(seed=0)
    states = run.rollout(actions.numpy())
    for i, pull in enumerate(pulls):
        env = robot(pull)
        env.reset(seed=i)
        alone = [env.step(u.astype(np.float32))[0] for u in actions[i].double().numpy()]
        np.testing.assert_array_equal(states[i], alone)


class Drifts(VectorEnv):
    """Copies that are one: reset takes one seed, and copy i ends after 3 + i steps."""

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.DISABLED}  # noqa: RUF012
    num_envs, dt, rollout = 2, 0.1, "something else"
    single_observation_space = single_action_space = Box(-9, 9, (1,))
    heeds, finals, together = False, False, True

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[np.ndarray, dict]:
        if options and self.heeds:
            self.x[options["reset_mask"]] = 0.0
            return self.x, {}
        super().reset(seed=seed)
        self.x, self.t = self.np_random.normal(size=(2, 1)).astype(np.float32), 0
        return self.x, {}

    def step(self, actions: np.ndarray) -> Any:
        self.x, self.t = self.x + actions, self.t + 1
        over = np.full(2, self.t >= 3) if self.together else self.t == np.array([3, 5])
        info = {"final_obs": self.x.copy()} if self.finals and over.any() else {}
        if self.finals:
            self.x = np.where(over[:, None], 0, self.x).astype(np.float32)
        return self.x, np.zeros((2, 1)), np.zeros(2, bool), over, info


def test_a_vector_environment_that_takes_one_seed_is_given_one() -> None:
    still = open_loop(torch.zeros(2, 5, 1))
    first, again, other = (collect(Drifts(), still, horizon=5, seed=seed) for seed in (1, 1, None))
    np.testing.assert_array_equal(first.states, again.states)
    assert first.states[0, 0] != first.states[1, 0] != other.states[1, 0]
    assert first.steps.tolist() == [3, 3]
    with pytest.raises(
        UnsupportedEnvironment, match="Drifts takes no seed for each .* give one for all"
    ):
        collect(Drifts(), still, horizon=5, seed=[1, 2])


@pytest.mark.parametrize(
    ("ways", "fails"),
    [
        ({"metadata": {}}, "does not say what an episode that ended came to.*final_obs"),
        ({"metadata": {}, "finals": True}, ""),
        ({"metadata": {"autoreset_mode": AutoresetMode.SAME_STEP}, "finals": True}, ""),
        ({"metadata": {"autoreset_mode": AutoresetMode.SAME_STEP}}, "does not say what an episode"),
        ({"heeds": True}, ""),
        ({}, "reset copy 1 too, in the middle of its episode"),
    ],
)
def test_an_episode_that_was_reset_within_its_last_step_ends_where_it_came_to(
    ways: dict[str, Any], fails: str
) -> None:
    run = simulation(type("Drifts", (Drifts,), {**ways, "together": False})())
    first = run.reset(seed=1)
    with pytest.raises(UnsupportedEnvironment, match=fails) if fails else nullcontext():
        states = run.rollout(np.full((2, 6, 1), 0.01))
        np.testing.assert_allclose(states[:, -1], first + np.array([[3], [5]]) * 0.09, rtol=1e-5)
        assert run.steps.tolist() == [3, 5]


def test_a_wrapped_arm_is_collected_from_until_its_limit_of_time() -> None:
    wrapped = RecordEpisodeStatistics(gymnasium.make_vec("tsm/Reacher-v0", num_envs=2))
    actions = open_loop(torch.zeros(2, 120, 2))
    data = collect(wrapped, actions, horizon=120, seed=3)
    arms = collect(gymnasium.make_vec("tsm/Reacher-v0", num_envs=2), actions, horizon=100, seed=3)
    assert data.env == arms.env == "tsm/Reacher-v0"
    np.testing.assert_allclose(data.states, arms.states, atol=1e-6)
    assert isinstance(simulation(gymnasium.make_vec("tsm/Reacher-v0", num_envs=1)), stepping.Arms)


def test_an_episode_that_is_not_finite_is_told_with_its_step_since_reset() -> None:
    class BlowsUp(Cart):
        def push(self, u: np.ndarray) -> float:
            return np.nan if u[0] > 0.5 else 0.0

    for kind in (SyncVectorEnv, partial(AsyncVectorEnv, context="fork")):
        actions = np.zeros((3, 6, 1))
        actions[1, 3] = 1.0
        with closing(simulation(kind([BlowsUp] * 3))) as run:
            run.reset(seed=0)
            run.rollout(actions[:, :2])
            with pytest.raises(
                SimulationUnstable, match="episode 1 at step 3: x1 is nan"
            ) as caught:
                run.rollout(actions[:, 2:])
            assert (caught.value.env, caught.value.episode, caught.value.step) == ("BlowsUp", 1, 3)


def test_a_copy_of_ones_own_is_stepped_without_an_id() -> None:
    assert Stepping([Cart(), Cart()]).id == "Cart"


def test_nothing_counts_after_an_episode_ended_and_success_is_a_yes_or_a_distance() -> None:
    def fallen(x: Tensor) -> Tensor:
        return (x[..., 0] < 0.7) | (x[..., 1].abs() > 0.2)

    reward = tsmlib.rewards.until(fallen, lambda x, u: x[..., 5] + 1)
    task = tsmlib.Task.from_env(
        "Hopper-v5", n=3, horizon=60, reward=reward, seed=0, success=lambda x: ~fallen(x[:, -1])
    )
    actions = random_actions(3, 60, 3)
    trial, predicted = (
        tsmlib.execute(task, actions),
        tsmlib.simulator_predictor(task)(actions[None]),
    )
    assert max(trial.lengths) < 60
    slow = [float((trial.states[i, 1 : n + 1, 5] + 1).sum()) for i, n in enumerate(trial.lengths)]
    np.testing.assert_allclose(trial.executed_return, slow, rtol=1e-4)
    foretold = task.reward(predicted[0], actions[None]).sum(-1)[0]
    np.testing.assert_allclose(foretold, slow, rtol=1e-4)
    assert trial.success.tolist() == [False] * 3
    near = dict(success=lambda x: (x[:, -1, 0] - 1).abs(), tolerance=0.5)
    pose = tsmlib.Task.from_env(
        "Pendulum-v1", n=3, horizon=4, reward=lambda x, u: x[..., 0], **near
    )
    trial = tsmlib.execute(pose, pose.idle_actions())
    torch.testing.assert_close(trial.final_distance, (trial.states[:, -1, 0] - 1).abs())
    assert trial.success.tolist() == (trial.final_distance <= 0.5).tolist()


def test_zeros_that_are_half_thrust_are_said_aloud(made: Made) -> None:
    class Thruster(Cart):
        action_space = Box(np.float32([0]), np.float32([10]))

    task = tsmlib.Task.from_env(made(Thruster), n=1, horizon=4, reward=lambda x, u: x[..., 0])
    with pytest.warns(UserWarning, match=r"actions are zeros, .* nothing there is \[-1.0\]"):
        tsmlib.execute(task, torch.zeros(1, 4, 1))
