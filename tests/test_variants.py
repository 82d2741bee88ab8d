"""Arms with other physics: what holds for the standard one holds for them too."""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
import torch

import tsmlib
from reproduction.measures.exploitation import violations
from reproduction.symmetry import symmetric
from tsmlib.collection import collect, open_loop, smooth_torques
from tsmlib.envs import fingerprint, imperfect, variant
from tsmlib.envs.geometry import (
    BLOCK_CLEARANCE,
    DT,
    GEAR,
    WALL,
    closest_gap,
    fingertip,
    room,
    slide_time,
    target_ring,
)
from tsmlib.envs.mujoco_arm import load_model
from tsmlib.envs.physics import Physics
from tsmlib.envs.pymunk_arm import ELBOW_MASS
from tsmlib.envs.spec import ENV_IDS, EnvSpec
from tsmlib.planning.tasks import Task
from tsmlib.pretrained import draw_task

REACH, PUSH, PYMUNK_PUSH = "tsm/Reacher-v0", "tsm/ReacherPush-v1", "tsm/PymunkPush-v1"
NAMED: dict[str, dict[str, Any]] = {
    "mass0.5": {"mass": 0.5},
    "mass2": {"mass": 2},
    "damping0.5": {"damping": 0.5},
    "damping2": {"damping": 2.0},
    "links0.12x0.11": {"link_lengths": (0.12, 0.11)},
    "links0.1x0.132": {"link_lengths": [0.1, 0.132]},
    "radius0.04": {"object_radius": 0.04},
    "gain0.7": {"torque_gain": 0.7},
}
EXTREME: list[dict[str, Any]] = [
    {"mass": 0.25},
    {"mass": 4},
    {"damping": 0.5},
    {"damping": 4},
    {"link_lengths": (0.06, 0.18)},
    {"link_lengths": (0.18, 0.06)},
    {"object_radius": 0.02},
    {"object_radius": 0.05},
    {"torque_gain": 1.25},
]
ALL = [
    {
        "mass": 0.25,
        "damping": 0.5,
        "link_lengths": (0.12, 0.12),
        "object_radius": 0.02,
        "torque_gain": 1.25,
    },
    {
        "mass": 4,
        "damping": 0.5,
        "link_lengths": (0.12, 0.12),
        "object_radius": 0.05,
        "torque_gain": 1.25,
    },
]


def arms(env_id: str, n: int, seed: int = 0, **changes: Any) -> tuple[Any, np.ndarray]:
    """n episodes at their start, and their states (n, dx)."""
    env = gymnasium.make_vec(env_id, num_envs=n, **changes).unwrapped
    return env, env.reset(seed=seed)[0]


def torques(n: int, rms: float = 0.1, steps: int = 60) -> np.ndarray:
    """Smooth actions (n, steps, 2)."""
    return smooth_torques(n, steps, generator=torch.Generator().manual_seed(0), rms=rms).numpy()


def full_torques(n: int, steps: int = 60) -> np.ndarray:
    """Actions (n, steps, 2) of -1 or 1 that jump every tenth step."""
    return np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], (n, steps // 10, 2)), 10, axis=1)


def depth(states: np.ndarray, env_id: str) -> np.ndarray:
    """How deep the object is in the arm or in a wall, in metres (...)."""
    into_wall = np.abs(states[..., 6:8]).max(-1) - room(EnvSpec.parse(env_id).physics)
    return np.maximum(-closest_gap(states, env_id), into_wall)


# Names ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", [PUSH, PYMUNK_PUSH])
@pytest.mark.parametrize("word", NAMED)
def test_a_variant_is_made_by_keyword_or_by_its_id_and_is_the_same(env_id: str, word: str) -> None:
    name = variant(env_id, **NAMED[word])
    assert name == env_id.replace("-v1", f"-{word}-v1")
    by_keyword, start = arms(env_id, 4, **NAMED[word])
    by_name, same = arms(name, 4)
    assert by_keyword.spec.id == by_name.spec.id == by_keyword.env_id == name
    np.testing.assert_array_equal(start, same)
    moved = by_keyword.rollout(torques(4))
    np.testing.assert_array_equal(moved, by_name.rollout(torques(4)))
    one = gymnasium.make(env_id, **NAMED[word])
    assert one.spec is not None
    assert one.spec.id == name
    one.reset(options={"states": start[0]})
    np.testing.assert_array_equal([one.step(action)[0] for action in torques(4)[0]], moved[0])
    standard, _ = arms(env_id, 4)
    standard.reset(
        options={"states": start}
    ) if "radius" not in word and "links" not in word else standard.reset(seed=0)
    assert not np.array_equal(standard.rollout(torques(4, rms=0.3)), moved)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_standard_values_name_the_standard_arm(env_id: str) -> None:
    assert variant(env_id, damping=1, link_lengths=[0.1, 0.11], torque_gain=1.0) == env_id
    assert EnvSpec.parse(env_id).physics == Physics()
    assert not set(fingerprint(env_id)) & {
        "mass",
        "damping",
        "link_lengths",
        "object_radius",
        "torque_gain",
    }


def test_noise_and_delay_join_a_variant() -> None:
    name = imperfect(variant(REACH, damping=2), noise=0.25, delay=5)
    assert name == "tsm/Reacher-damping2-noise0.25-delay5-v0"
    spec = EnvSpec.parse(name)
    assert (spec.arm.id, spec.standard.id) == ("tsm/Reacher-damping2-v0", REACH)
    by_name = gymnasium.make_vec(name, num_envs=3)
    by_keyword = gymnasium.make_vec(imperfect(REACH, noise=0.25, delay=5), num_envs=3, damping=2)
    assert by_keyword.unwrapped.spec is not None
    assert by_keyword.unwrapped.spec.id == name
    seen = [
        collect(env, open_loop(torch.from_numpy(torques(3))), horizon=60, seed=1)
        for env in (by_name, by_keyword)
    ]
    np.testing.assert_array_equal(seen[0].states, seen[1].states)
    assert {data.env for data in seen} == {name}
    assert (
        gymnasium.make(imperfect(REACH, noise=0.25), damping=2).spec.id
        == "tsm/Reacher-damping2-noise0.25-v0"
    )  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("env_id", "changes", "message"),
    [
        (PUSH, {"mass": -1}, r"mass is -1 kg; expected 0.25 to 4 kg \(the standard arm has 1.0\)"),
        (PUSH, {"mass": float("nan")}, "mass is .*nan.*expected a number"),
        (PUSH, {"mass": "2"}, "mass is .*expected a number"),
        (PUSH, {"damping": 0}, "damping is 0 N m s/rad; expected 0.5 to 4"),
        (PUSH, {"object_radius": 0.09}, "object_radius is 0.09 m; expected 0.02 to 0.05 m"),
        (PUSH, {"torque_gain": True}, "torque_gain is .*expected a number"),
        (PUSH, {"link_lengths": (0.2, 0.2)}, r"link_lengths are \(0.2, 0.2\) m; .*at most 0.24 m"),
        (PUSH, {"link_lengths": (0.1,)}, "link_lengths are .*expected two lengths"),
        (PUSH, {"link_lengths": 0.1}, "link_lengths is 0.1; expected two numbers"),
        (
            REACH,
            {"mass": 2},
            "mass of tsm/Reacher-v0 cannot be chosen: it has no object. It takes damping, link_len",
        ),
        (REACH, {"object_radius": 0.04}, "object_radius of tsm/Reacher-v0 cannot be chosen"),
        (
            "tsm/PymunkObstacle-v0",
            {"mass": 2},
            "its obstacle does not move. It takes damping, .*object_radius",
        ),
        (
            PUSH,
            {"friction": 1},
            "friction of tsm/ReacherPush-v1 cannot be chosen: there is no such.*takes mass, dam",
        ),
    ],
)
def test_a_value_that_makes_no_sense_is_refused_with_what_is_allowed(
    env_id: str, changes: dict[str, Any], message: str
) -> None:
    for make in (lambda: gymnasium.make(env_id, **changes), lambda: variant(env_id, **changes)):
        with pytest.raises(ValueError, match=message):
            make()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("tsm/ReacherPush-mass2.0-v1", "is written tsm/ReacherPush-mass2-v1"),
        ("tsm/ReacherPush-mass1-v1", "is written tsm/ReacherPush-v1"),
        ("tsm/ReacherPush-mass9-v1", "mass is 9 kg; expected"),
        ("tsm/ReacherPush-links0.1-v1", "expected two"),
        ("tsm/ReacherPush-mass1x2-v1", "written|expected"),
        ("tsm/ReacherPush-mass1.2.3-v1", "float"),
        ("tsm/Reacher-mass2-v0", "it has no object"),
        ("tsm/ReacherPush-gain0.7-mass2-v1", "none of tsm/Reacher-v0"),
        ("tsm/ReacherPush-mass2-v0", "none of tsm/Reacher-v0"),
    ],
)
def test_another_spelling_is_refused(name: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EnvSpec.parse(name)


# Physics ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ENV_IDS[1:3] + ENV_IDS[4:])
@pytest.mark.parametrize("changes", [*EXTREME, *ALL], ids=str)
def test_nothing_penetrates_except_in_the_instant_of_impact(
    env_id: str, changes: dict[str, Any]
) -> None:
    if EnvSpec.parse(env_id).task == "obstacle":
        changes = {name: value for name, value in changes.items() if name != "mass"}
    name = variant(env_id, **changes)
    env, start = arms(name, 30)
    physics = EnvSpec.parse(name).physics
    assert closest_gap(start, name).min() > BLOCK_CLEARANCE
    states = env.rollout(torques(30, rms=0.05))
    np.testing.assert_allclose(
        states[..., 4:6], fingertip(states[..., :2], physics.link_lengths), atol=1e-12
    )
    deep = (
        depth(states, name) if EnvSpec.parse(env_id).task == "push" else -closest_gap(states, name)
    )
    assert deep.max() < 4e-3
    assert not (deep[:, 1:] > 1e-3)[deep[:, :-1] > 1e-3].any()
    away = (closest_gap(states, name) > 0.03).all(1)
    assert away.any()
    np.testing.assert_allclose(
        states[away, :, 6:], np.repeat(start[away, None, 6:], 60, axis=1), atol=1e-9
    )


@pytest.mark.parametrize("env_id", [PUSH, PYMUNK_PUSH])
@pytest.mark.parametrize("changes", EXTREME, ids=str)
def test_nothing_tunnels_at_full_torque(env_id: str, changes: dict[str, Any]) -> None:
    name = variant(env_id, **changes)
    env, _ = arms(name, 40)
    states, physics = env.rollout(full_torques(40)), EnvSpec.parse(name).physics
    assert (
        -closest_gap(states, name).min() < physics.object_radius + 0.01
    )  # the centres never cross
    assert np.abs(states[..., 6:8]).max() < WALL + 2 * physics.object_radius
    assert np.abs(states[..., 2:4]).max() < 2 * GEAR * physics.torque_gain / physics.damping


@pytest.mark.parametrize("env_id", [PUSH, PYMUNK_PUSH])
def test_a_heavier_object_slides_further_against_the_same_drag(env_id: str) -> None:
    state = np.array([[0.0, 0.0, 0.0, 0.0, 0.21, 0.0, -0.1, 0.0, 0.0, 0.3]])
    for mass in (0.5, 2.0):
        env, _ = arms(env_id, 1, mass=mass)
        env.reset(options={"states": state})
        speed = env.rollout(np.zeros((1, 10, 2)))[0, :, 9]
        decay = slide_time(Physics(mass=mass))
        assert decay == pytest.approx(0.05 * mass)
        np.testing.assert_allclose(
            speed, 0.3 * np.exp(-DT * np.arange(1, 11) / decay), rtol=0.3 if mass < 1 else 0.05
        )


def test_the_shoulder_in_mujoco_obeys_its_equation_of_motion() -> None:
    """With no torque at the elbow, I w' = gain 200 u - d w."""
    for damping, gain in ((1.0, 1.0), (2.0, 1.0), (0.5, 0.7)):
        env, _ = arms(REACH, 1, damping=damping, torque_gain=gain)
        env.reset(options={"states": np.zeros((1, 6))})
        speed = env.rollout(np.tile([0.01, 0.0], (1, 5, 1)))[0, :, 2]
        expected = gain * GEAR * 0.01 / damping * (1 - np.exp(-damping * DT * np.arange(1, 6)))
        np.testing.assert_allclose(speed, expected, rtol=0.01)


def test_the_arm_in_pymunk_obeys_its_equation_of_motion() -> None:
    damping, gain, length = 2.0, 0.7, 0.12
    env, _ = arms(
        "tsm/PymunkReacher-v0", 1, damping=damping, torque_gain=gain, link_lengths=(length, 0.1)
    )
    env.reset(options={"states": np.zeros((1, 6))})
    states = env.rollout(0.02 * np.ones((1, 20, 2)) * [1.0, 0.5])[0]
    w, q = np.zeros(2), np.zeros(2)  # speeds and angles in the world
    for _ in range(20 * 200):
        joint, tau = np.array([w[0], w[1] - w[0]]), gain * GEAR * 0.02 * np.array([1.0, 0.5])
        first = (tau[0] - tau[1] - damping * (joint[0] - joint[1])) / (1 + ELBOW_MASS * length**2)
        w = w + DT / 200 * np.array([first, tau[1] - damping * joint[1]])
        q = q + DT / 200 * w
    np.testing.assert_allclose(
        states[-1, :4], [q[0], q[1] - q[0], w[0], w[1] - w[0]], rtol=0.02, atol=1e-3
    )


def test_the_geometry_of_a_variant_is_that_of_its_model() -> None:
    name = variant(PUSH, link_lengths=(0.12, 0.1), object_radius=0.04)
    _, states = arms(name, 20)
    model, data = load_model(name), mujoco.MjData(load_model(name))
    states[:, :2] = np.random.default_rng(0).uniform(-3, 3, (20, 2))
    for state, gap in zip(states, closest_gap(states, name), strict=True):
        data.qpos[:] = np.r_[state[:2], state[6:8]]
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(
            data.body("fingertip").xpos[:2], fingertip(state[:2], (0.12, 0.1)), atol=1e-12
        )
        links = [model.geom(link).id for link in ("link0", "link1", "fingertip")]
        distance = min(
            mujoco.mj_geomDistance(model, data, link, model.geom("block").id, 1.0, None)
            for link in links
        )
        assert gap == pytest.approx(distance, abs=1e-9)


@pytest.mark.parametrize("changes", [{"mass": 2.0}, {"link_lengths": (0.12, 0.11)}], ids=str)
def test_an_episode_replays_bit_for_bit(changes: dict[str, Any]) -> None:
    for env_id in (PUSH, PYMUNK_PUSH):
        env, start = arms(env_id, 8, **changes)
        states = env.rollout(torques(8))
        env.reset(seed=9, options={"states": start})
        first = env.rollout(torques(8)[:, :30])
        np.testing.assert_array_equal(
            np.concatenate([first, env.rollout(torques(8)[:, 30:])], 1), states
        )


@pytest.mark.parametrize("env_id", [PUSH, PYMUNK_PUSH])
@pytest.mark.parametrize(
    "changes", [{"mass": 2.0}, {"link_lengths": (0.12, 0.11)}, {"object_radius": 0.04}], ids=str
)
def test_symmetric_copies_stay_true_of_a_variant(env_id: str, changes: dict[str, Any]) -> None:
    data = tsmlib.collect_random(variant(env_id, **changes), 10, seed=3, horizon=40)
    copies = symmetric(data)
    env, _ = arms(data.env, len(copies))
    env.reset(seed=0, options={"states": copies.states[:, 0].astype(float)})
    off = np.abs(env.rollout(copies.actions) - copies.states[:, 1:])[..., [0, 1, 4, 5, 6, 7]].max(
        (1, 2)
    )
    assert np.quantile(off, 0.9) < 1e-3


def test_true_episodes_of_a_variant_violate_no_physics() -> None:
    for changes in (
        {"mass": 2.0},
        {"mass": 0.5},
        {"link_lengths": (0.12, 0.11)},
        {"object_radius": 0.05},
    ):
        data = tsmlib.collect_random(variant(PUSH, **changes), 40, seed=1, horizon=60)
        assert violations(data.states, data.env)["violations"].mean() < 1e-3
    assert (
        violations(data.states, PUSH)["violations"].mean() > 0.1
    )  # a smaller object would have been left alone
    heavy = tsmlib.collect_random(variant(PUSH, mass=4.0), 60, seed=1, horizon=60)
    assert (
        violations(heavy.states, heavy.env)["violations"].mean()
        < violations(heavy.states, PUSH)["violations"].mean()
    )


# Pictures, tasks and files ----------------------------------------------------------------------


def test_targets_are_drawn_and_allowed_as_far_as_the_variant_gets() -> None:
    for changes in (
        {"object_radius": 0.05},
        {"link_lengths": (0.06, 0.07)},
        {"link_lengths": (0.12, 0.12)},
    ):
        for env_id in (PUSH, REACH):
            if env_id == REACH and "object_radius" in changes:
                continue
            task = draw_task(
                variant(env_id, **changes), seed=0, n=50
            )  # Task checks that they are within reach
            inner, outer = target_ring(EnvSpec.parse(task.env))
            distance = task.target.norm(dim=1)
            assert inner - 1e-6 <= distance.min()
            assert distance.max() <= outer + 1e-6
    longer = variant(REACH, link_lengths=(0.12, 0.11))
    start, far = arms(longer, 1)[1], torch.tensor([[0.225, 0.0]])
    assert len(Task.standard(longer, start, far)) == 1
    with pytest.raises(ValueError, match=r"the fingertip gets as far as 0.21 m"):
        Task.standard(REACH, start, far)


def test_the_task_of_a_variant_with_the_same_shape_is_the_frozen_one() -> None:
    standard = tsmlib.load_task(PUSH)
    heavy = tsmlib.load_task(variant(PUSH, mass=2.0))
    assert heavy.env == "tsm/ReacherPush-mass2-v1"
    np.testing.assert_array_equal(heavy.start, standard.start)
    assert torch.equal(heavy.target, standard.target)
    large = tsmlib.load_task(variant(PUSH, object_radius=0.05))
    assert len(large) == 100
    assert closest_gap(large.start.astype(float), large.env).min() > 0
    trial, same = (
        tsmlib.execute(task.take(3), torch.from_numpy(torques(3, rms=0.3, steps=100)))
        for task in (heavy, standard)
    )
    assert not torch.equal(trial.states, same.states)
