"""The drawing shows the state it is given."""

import gymnasium
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from tsmlib.envs import drawing, render
from tsmlib.envs.geometry import fingertip
from tsmlib.envs.render import EXTENT, draw_scene, render_array
from tsmlib.envs.spec import ENV_IDS, PYMUNK_IDS


def a_state(
    env_id: str, q: tuple[float, float] = (0.5, 1.0), block: tuple[float, float] = (-0.1, -0.15)
) -> np.ndarray:
    arm = np.array([*q, 0.0, 0.0, *fingertip(np.array(q))])
    return arm if env_id.endswith("Reacher-v0") else np.concatenate([arm, block, np.zeros(2)])


def colour_at(image: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The pixel (3,) in [0, 1] that shows a point of the plane."""
    size = len(image)
    column, row = ((np.asarray(point) * (1, -1) / EXTENT + 1) / 2 * size).astype(int)
    return image[row, column] / 255


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_fingertip_and_block_are_drawn_where_they_are(env_id: str) -> None:
    state = a_state(env_id)
    image = render_array(state, env_id)
    assert image.shape == (480, 480, 3)
    assert image.dtype == np.uint8
    np.testing.assert_allclose(colour_at(image, state[4:6]), to_rgb(render.TIP), atol=0.02)
    if env_id.endswith("Push-v1"):
        np.testing.assert_allclose(colour_at(image, state[6:8]), to_rgb(render.BLOCK), atol=0.02)


def test_another_state_or_target_is_another_picture() -> None:
    env_id = PYMUNK_IDS[2]
    pictures = [
        render_array(a_state(env_id), env_id, size=120),
        render_array(a_state(env_id, q=(0.6, 1.0)), env_id, size=120),
        render_array(a_state(env_id, block=(0.1, -0.15)), env_id, size=120),
        render_array(a_state(env_id), env_id, target=np.array([0.1, -0.1]), size=120),
    ]
    for i, one in enumerate(pictures):
        assert all((one != other).any() for other in pictures[i + 1 :])


def test_an_environment_renders_its_present_state() -> None:
    env = gymnasium.make(PYMUNK_IDS[0], render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    state, *_ = env.step(np.ones(2, np.float32))
    after = env.render()
    assert (before != after).any()
    np.testing.assert_array_equal(after, render_array(state, PYMUNK_IDS[0], env.unwrapped.target))


def test_several_poses_and_paths_share_one_drawing() -> None:
    axes = Figure().add_subplot()
    state = a_state(PYMUNK_IDS[2])
    path = np.linspace((0.0, 0.0), (0.1, 0.1), 5)
    draw_scene(axes, state, PYMUNK_IDS[2], tip_path=path, block_path=-path)
    patches = len(axes.patches)
    draw_scene(axes, state, PYMUNK_IDS[2], alpha=0.3, background=False)
    assert len(axes.lines) == 2
    assert patches < len(axes.patches) < 2 * patches


def test_a_state_of_another_environment_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\(6,\); tsm/PymunkPush-v1 expected \(10,\)"):
        render_array(a_state(PYMUNK_IDS[0]), PYMUNK_IDS[2])


def coloured(frame: np.ndarray, colour: str) -> np.ndarray:
    """Rows and columns (n, 2) of the pixels of a colour."""
    return np.argwhere((frame == Image.new("RGB", (1, 1), colour).getpixel((0, 0))).all(-1))


def test_robots_are_drawn_from_what_they_observe_and_others_are_named() -> None:
    assert all(map(drawing.drawable, ("Pendulum-v1", "HalfCheetah-v5", "Walker2d-v5")))
    assert not any(map(drawing.drawable, ("Ant-v5", "Reacher-v5", "MountainCarContinuous-v0")))
    with pytest.raises(ValueError, match="Ant-v5 cannot be drawn from its observations"):
        drawing.frames("Ant-v5", np.zeros((2, 105)))


def test_a_pendulum_is_drawn_where_its_angle_says() -> None:
    angles = np.array([0.0, np.pi / 2, np.pi])  # up, to the left, down
    states = np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
    middles = [coloured(x, drawing.BODY).mean(0) for x in drawing.frames("Pendulum-v1", states)]
    away = np.array(middles) - (drawing.HEIGHT / 2, drawing.WIDTH / 2)
    assert away[0, 0] < -30
    assert away[1, 1] < -30
    assert away[2, 0] > 30
