"""PushT: its physics, its starts and goals, and the three measures of success."""

import dataclasses
from functools import partial

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch

import tsmlib
from reproduction import pusht, pusht_models
from tsmlib.collection import collect
from tsmlib.envs.pusht import PushT, weak_policy
from tsmlib.envs.pusht_field import (
    GOAL,
    clearance,
    in_field,
    placed,
    pusht_image,
    pusht_physics,
    pusht_variant,
    symmetric_copies,
)
from tsmlib.envs.stepping import make_simulation
from tsmlib.models.egocentric import Egocentric
from tsmlib.planning.pusht import (
    coverage,
    distance,
    pusht_task,
    random_play,
    solved_b,
    solved_c,
    success_a,
    success_b,
    success_c,
)
from tsmlib.trajectory import initial_past


def play(n=12, horizon=30, env_id="tsm/PushT-v0", seed=0):
    policy = weak_policy(torch.Generator().manual_seed(seed))
    return collect(gymnasium.make_vec(env_id, num_envs=n), policy, horizon=horizon, seed=seed)


@pytest.fixture(scope="module")
def data():
    return play()


def begun(states):
    env = PushT(len(states))
    env.reset(options={"states": states})
    return env


def test_an_untouched_t_does_not_move():
    state = np.array([[60.0, 60, 300, 300, 0.3, 0, 0]])
    moved = begun(state).rollout(np.full((1, 5, 2), -0.2))
    assert (moved[0, :, 2:5] == state[0, 2:5]).all()


def test_the_pusher_reaches_a_place_at_rest_and_a_push_carries_the_t_along():
    state = np.array([[250.0, 200, 250, 300, 0, 0, 0]])
    after = begun(state).rollout(np.array([[[0.0, 0.8]] * 4 + [[0.0, 0.0]] * 6]))
    assert after[0, -1, 3] > 300
    assert abs(after[0, -1, 2] - 250) < 1
    assert clearance(after[0, -1]) > -1.5


def test_what_is_pushed_stops_when_the_pusher_leaves(data):
    still = np.abs(np.diff(data.states[..., 2:5], axis=1)).max(-1) == 0
    apart = clearance(data.states) > 80
    assert still[apart[:, :-1] & apart[:, 1:]].mean() > 0.9


def test_an_episode_is_a_function_of_its_start_and_actions(data):
    env = begun(data.states[:, 0].astype(float))
    whole = env.rollout(data.actions)
    env.reset(seed=0)
    parts = [env.rollout(data.actions[:, k : k + 10]) for k in (0, 10, 20)]
    # A start drawn from a seed has more digits than one in float32, and contact multiplies them.
    assert (np.concatenate(parts, 1).astype(np.float32) == data.states[:, 1:]).all()
    assert np.median(np.abs(whole - data.states[:, 1:])) < 1e-2


def test_a_snapshot_continues_bit_for_bit(data):
    env = begun(data.states[:, 0])
    env.rollout(data.actions[:, :20])
    snapshot = env.get_state()
    first = env.rollout(data.actions[:, 20:])
    env.set_state(snapshot)
    assert (env.rollout(data.actions[:, 20:]) == first).all()


def test_one_field_is_many_with_n_of_one(data):
    one = gymnasium.make("tsm/PushT-v0")
    one.reset(options={"states": data.states[3, 0]})
    stepped = np.stack([one.step(u)[0] for u in data.actions[3, :20]])
    assert (stepped == begun(data.states[3:4, 0]).rollout(data.actions[3:4, :20])[0]).all()


def test_starts_lie_within_the_walls_and_apart():
    env = PushT(100)
    states, info = env.reset(seed=3)
    assert in_field(states).all()
    assert (clearance(states) > 0).all()
    assert (info["goal"] == GOAL).all()
    assert (PushT(2).reset(seed=3)[0] == states[:2]).all()  # episode i does not depend on N


@pytest.mark.parametrize(("shape", "n"), [("T", 8), ("L", 4), ("plus", 8)])
def test_the_physics_commute_with_quarter_turns_and_mirrors(shape, n):
    name = pusht_variant(shape=shape)
    data, env = play(env_id=name), PushT(12, name)
    copies = symmetric_copies(data.states.astype(float), data.actions.astype(float), shape)
    assert len(copies) == n
    assert (copies[0][0] == data.states).all()
    for states, actions in copies:
        env.reset(options={"states": states[:, 0]})
        apart = np.abs(env.rollout(actions) - states[:, 1:]).max((1, 2))
        assert np.median(apart) < 0.01


def test_a_larger_t_is_another_environment_that_its_id_remembers():
    name = pusht_variant(scale=40, radius=20, shape="L", friction=0.5)
    assert name == "tsm/PushT-radius20-scale40-friction0.5-shapeL-v0"
    assert pusht_physics(name).scale == 40
    assert make_simulation(name, 2).id == name
    assert play(2, 3, name).env == name


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"states": np.zeros((1, 5))}, "five numbers lack the pusher's velocity"),
        ({"goal": [10, 20, 256, 256, 0, 0, 0]}, "goal 0 is outside the field or inside a wall"),
        ({"goal": [256, 400, 30, 256, 0, 0, 0]}, "goal 0 is outside the field"),
        ({"goal": [np.nan, 400, 30, 256, 0, 0, 0]}, "goal is not finite"),
        ({"target": [0, 0]}, "unknown reset options"),
    ],
)
def test_bad_starts_and_goals_are_named(options, words):
    PushT(1).reset(options={"goal": [23, 23, 256, 256, 0, 0, 0]})
    with pytest.raises(ValueError, match=words):
        PushT(1).reset(options=options)


def test_bad_actions_are_named():
    with pytest.raises(gymnasium.error.ResetNeeded):
        PushT(1).rollout(np.zeros((1, 1, 2)))
    env = begun(np.array([GOAL]))
    with pytest.raises(ValueError, match="expected \\(N=1, T, 2\\)"):
        env.rollout(np.zeros((1, 2)))
    with pytest.raises(ValueError, match="nan in episode 0, step 1"):
        env.rollout(np.array([[[0, 0], [np.nan, 0]]]))
    with pytest.raises(ValueError, match="is no PushT"):
        pusht_physics("tsm/PushT-wheels4-v0")


def test_measures_of_success():
    goal = torch.tensor(GOAL, dtype=torch.float32)
    near = goal + torch.tensor([12.0, 0, 12, 0, 0.3, 0, 0])
    away = goal + torch.tensor([30.0, 0, 0, 0, 0.0, 0, 0])
    turned = goal + torch.tensor([0.0, 0, 0, 0, 2 * np.pi + 0.1, 0, 0])
    assert solved_b(near, goal)
    assert not solved_b(away, goal)
    assert solved_b(turned, goal)
    assert not solved_c(near, goal)
    assert solved_c(away, goal)
    assert solved_c(turned, goal)
    episode = torch.stack([near, away, away, near])
    assert success_b(episode, goal)
    assert not success_c(episode, goal)
    assert success_c(torch.stack([near, away, away, away]), goal)
    assert not success_c(torch.stack([away, away]), goal)  # two steps are not held for three
    assert success_a(torch.stack([near, away]), goal)
    assert not success_a(near[None], goal)


def test_coverage_is_the_share_of_the_goals_area():
    goal = torch.tensor(GOAL, dtype=torch.float32)
    assert coverage(goal, goal) == 1.0
    shifted = torch.tensor([0.0, 0, 256, 256, 0, 0, 0])
    level = shifted.clone()
    level[2] += 30.0  # bar: 3 of 4 boxes stay covered, stem: none of 3
    assert coverage(level, shifted) == pytest.approx(3 / 7, abs=0.01)


def test_the_t_lies_where_its_state_says():
    corner = placed(np.array([[60.0, 30.0]]), np.array(GOAL))
    assert corner[0] == pytest.approx([256 + 30 / 2**0.5, 256 + 90 / 2**0.5])


def test_a_picture_shows_pusher_t_and_goal():
    picture = pusht_image(np.array([400.0, 400, 150, 150, 0, 0, 0]), np.array(GOAL), pixels=128)
    assert picture.shape == (128, 128, 3)
    assert picture.dtype == np.uint8
    for x, y, colour in ((400, 400, "#4169E1"), (150, 165, "#778899"), (256, 290, "#90EE90")):
        rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        assert np.abs(picture[y // 4, x // 4].astype(int) - rgb).max() < 12


def pairs(n=3, horizon=25):
    """States of random play and those 25 steps later, with the actions in between."""
    seen = play(60, horizon, seed=7)
    start, goal = seen.states[:, 0], seen.states[:, -1]
    moved = np.linalg.norm(goal[:, 2:4] - start[:, 2:4], axis=-1) > 30
    chosen = np.flatnonzero(in_field(goal) & moved)[:n]
    return start[chosen], goal[chosen], torch.from_numpy(seen.actions[chosen])


def test_actions_that_led_to_a_goal_are_a_success_in_every_protocol():
    start, goal, actions = pairs()
    still = torch.cat([actions, torch.zeros(len(goal), 3, 2)], dim=1)
    for protocol in "ABC":
        task = dataclasses.replace(pusht_task(start, goal, protocol), horizon=28)
        assert tsmlib.execute(task, still).success.all() or protocol == "C"
        assert not tsmlib.execute(task, torch.zeros_like(still)).success.any()


def test_the_reward_is_best_for_the_actions_that_led_to_the_goal():
    start, goal, actions = pairs()
    task = pusht_task(start, goal, "B")
    predict = tsmlib.simulator_predictor(task)
    other = torch.stack([actions, 0.8 * actions, torch.zeros_like(actions)])
    returns = task.reward(predict(other)[0], other).sum(-1)
    assert (returns.argmax(0) == 0).all()


def test_pairs_are_judged_by_their_own_goal_when_some_are_taken():
    start, goal, actions = pairs()
    task = dataclasses.replace(pusht_task(start, goal), horizon=25).take([2, 0])
    assert tsmlib.execute(task, actions[[2, 0]]).success.all()
    assert not tsmlib.execute(task, actions[[0, 2]]).success.any()


def test_the_simulator_predicts_what_follows_in_the_middle_of_an_episode():
    start, goal, actions = pairs()
    task = pusht_task(start, goal)
    whole = tsmlib.simulator_predictor(task)(actions[None])
    rest = tsmlib.simulator_predictor(task, done=actions[:, :10])(actions[None, :, 10:])
    assert torch.equal(rest, whole[:, :, :, 10:])


def test_plans_of_a_lookahead_follow_each_other_to_the_end_of_the_episode():
    start, goal, _ = pairs(2)
    task = dataclasses.replace(pusht_task(start, goal), horizon=12)
    space = tsmlib.DirectActions(5, rms=0.6, smoothness=0)
    planner = partial(tsmlib.cem, candidates=4, elites=2, iterations=1)
    trial = tsmlib.mpc(task, None, space, planner, every=3, lookahead=5)
    assert trial.actions.shape == (2, 12, 2)
    assert trial.gap.shape == (2,)
    with pytest.raises(ValueError, match="lookahead is 2"):
        tsmlib.mpc(task, None, space, planner, every=3, lookahead=2)


def test_what_has_succeeded_stays_idle_where_the_first_success_counts():
    start, goal, _ = pairs(2)
    task = dataclasses.replace(pusht_task(start, goal), horizon=8)
    first = torch.from_numpy(start[:, :2])

    def moved(n):  # a success is that the pusher has moved
        return lambda states: (states[..., :2] - first[:n, None]).norm(dim=-1).amax(-1) > 5

    task = dataclasses.replace(task, success_for=lambda goal: moved(len(goal)))
    planner = partial(tsmlib.cem, candidates=4, elites=2, iterations=1)
    space = tsmlib.DirectActions(4, rms=0.6, smoothness=0)
    trial = tsmlib.mpc(task, None, space, planner, every=2, lookahead=4, until_success=True)
    assert trial.success.all()
    assert (trial.actions[:, :2] != 0).any(-1).all()
    assert (trial.actions[:, 4:] == 0).all()


def test_random_play_ends_where_the_t_leaves_the_picture():
    seen = random_play(20, horizon=60, seed=3)
    assert len(seen) % 8 == 0
    assert min(seen.lengths) >= 30
    corners = placed(pusht_physics(seen.env).boxes.reshape(-1, 2), seen.flat_states)
    assert corners.min() >= -0.01
    assert corners.max() <= 512.01


@pytest.mark.parametrize("split", ["test", "validation"])
def test_frozen_pairs_lie_in_the_field_and_ask_for_a_push(split):
    task = tsmlib.load_pusht(split)
    start, goal = task.start, task.target.numpy()
    assert len(task) == {"test": 500, "validation": 200}[split]
    assert in_field(start).all()
    assert in_field(goal).all()
    assert (np.linalg.norm(start[:, 2:4] - goal[:, 2:4], axis=1) >= 10).all()
    assert len(tsmlib.load_pusht(split, "A")) == 100


def test_the_shipped_model_predicts_a_second_of_play_within_pixels(data):
    model = tsmlib.load_pretrained("egocentric", env="tsm/PushT-v0")
    past = initial_past(torch.from_numpy(data.states[:, 0]), model.past_len, 2)
    predicted = model.predict(past, torch.from_numpy(data.actions[:, :10]))
    off = distance(predicted, torch.from_numpy(data.states[:, 1:11]))
    assert off.median() < 2


def test_stages_whose_shares_add_up_to_more_than_one_are_all_trained(data):
    net = tsmlib.OneStep.for_data(data, hidden=8)
    few = tsmlib.TrainingOptions(past_len=1, future_len=2, batch_size=8, warmup=1)
    parts = [("loss", few, 0.5), ("loss", few, 0.5), ("loss", few, 0.05)]
    updates, _ = pusht_models.train(net, parts, data, data, 0.0, 0)
    assert updates == 20 * len(parts)


def test_the_tables_command_goes_from_play_to_rows_and_makes_none_twice(tmp_path):
    words = ["--seeds", "0", "--pairs", "2", "--simulator", "1", "--share", "0", "--protocols", "C"]
    words += ["--models", str(tmp_path), "--out", str(tmp_path / "rows.csv")]
    tables = []
    for _ in range(2):
        pusht.main(words)
        tables.append(pd.read_csv(tmp_path / "rows.csv"))
    assert tables[0].method.tolist() == ["random play", "egocentric", "one plan", "simulator"]
    assert tables[1].equals(tables[0])
    assert (tmp_path / "egocentric-0.safetensors").exists()


def test_bad_pairs_are_named():
    start, goal, _ = pairs(1)
    with pytest.raises(ValueError, match="pair 0 is solved at the start by protocol B"):
        pusht_task(start, start)
    with pytest.raises(ValueError, match="goal 0 is outside the field"):
        pusht_task(start, goal + np.array([0, 0, 400, 0, 0, 0, 0]))
    with pytest.raises(ValueError, match="goal is .* five numbers lack the pusher's velocity"):
        pusht_task(start, goal[:, :5])
    with pytest.raises(ValueError, match="expected \\(1, 7\\)"):
        pusht_task(start[0], goal[0])
    with pytest.raises(ValueError, match="split is 'train'"):
        tsmlib.load_pusht("train")
    with pytest.raises(ValueError, match="protocol is 'D'"):
        pusht_task(start, goal, "D")


@pytest.fixture(scope="module")
def model(data):
    return Egocentric.for_data(data, hidden=16)


@pytest.mark.parametrize(
    ("sizes", "arguments", "words"),
    [
        ((3, 2), {"angles": (2,), "body": (0, 1, 2)}, "vectors is"),
        ((0, 2), {}, "state_dim is 0"),
        ((7, 3), {}, "action_dim is 3; expected 2"),
        ((7, 2), {"body": (2, 3)}, "body is .*; expected 3 different columns"),
        ((7, 2), {"body": None}, "body is None"),
        ((7, 2), {"body": (2, 2, 4)}, "body is"),
        ((7, 2), {"places": (0, 1)}, "places is 0"),
        ((7, 2), {"places": ((0, True),)}, "places is"),
        ((7, 2), {"places": ((0, 1), (0, 1))}, "column 0 2 times"),
        ((7, 2), {"vectors": ((5, 7),)}, "vectors is"),
        ((7, 2), {"angles": (0,)}, "angles is .*; expected the body's alone"),
        ((7, 2), {"angles": 4}, "angles is 4"),
        ((7, 2), {"hidden": -1}, "hidden is -1"),
    ],
)
def test_columns_that_make_no_sense_are_named(sizes, arguments, words):
    with pytest.raises((TypeError, ValueError), match=words):
        Egocentric(*sizes, **arguments)


def test_what_is_seen_from_the_t_does_not_depend_on_where_it_lies(model, data):
    x, u = torch.from_numpy(data.states[:, 3]), torch.from_numpy(data.actions[:, 3])
    turned = symmetric_copies(data.states[:, 3], data.actions[:, 3])[1]  # by a quarter
    seen, other = model._seen(x, u), model._seen(*map(torch.from_numpy, turned))
    assert torch.allclose(seen[:, :6], other[:, :6], atol=1e-3)  # all but where the T itself is


def test_increments_in_the_frame_of_the_t_are_put_back_into_the_world(model, data):
    before, after = torch.from_numpy(data.states[:, 3]), torch.from_numpy(data.states[:, 4])
    change = model._increments(before, after)
    with torch.no_grad():
        for weight in model.parameters():
            weight.zero_()
        expected = []
        for row, x in zip(change, before, strict=True):
            model.linear.bias.copy_(row / model.step_std)
            expected.append(model.step(x, torch.zeros(2)))
    assert torch.allclose(torch.stack(expected), after, atol=1e-3)
