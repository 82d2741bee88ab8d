"""Figures of noise and delay show the numbers they are given, on one scale, and say what they leave out."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from tsmlib.plots import Look, Method, advantage_map, figure8, filtering_errors, imperfect_episode
from tsmlib.statistics import interval
from tsmlib.zoo import method

STEPS, DT = 20, 0.02
TSM, LSTM, ONE_STEP, ZERO = method("tsm"), method("lstm"), method("onestep"), method("zero")
KALMAN, SMOOTHED = (
    method("filter"),
    Method("exponential", look=Look("exponential filter", "#8C8C8C")),
)
LATENT, DIRECT, RIVAL = method("tsm", "latent"), method("tsm", "direct"), method("lstm", "direct")
FLOOR = {method("random"): -13.5, ZERO: -12.1}
draw = np.random.default_rng(0)


def learned(end: float, k: int = 3, records: int = 5) -> dict[str, np.ndarray]:
    true = end + (-12 - end) * np.exp(-np.arange(records)) + 0.1 * draw.normal(size=(k, records))
    return {"return_true": true, "steps": 220_000.0 * np.arange(records)}


CURVES = {
    condition: {LATENT: learned(-4.0 - worse), DIRECT: learned(-5.0 - worse), RIVAL: learned(-7.0)}
    for condition, worse in (("clean", 0.0), ("noise", 1.0), ("delay", 2.0))
}
CLEAN = np.cumsum(draw.normal(size=(STEPS + 1, 3)), 0)
NOISY = CLEAN + 0.25 * draw.normal(size=CLEAN.shape)
SENT = draw.uniform(-1, 1, STEPS)
APPLIED = np.concatenate([np.zeros(5), SENT])[:STEPS]
TITLES = ("joint1 (rad)", "joint0 vel (rad/s)", "tip x (m)")
PARTS = ("whole state", "angles", "velocities", "fingertip")


def precompute(level: float, k: int = 3) -> np.ndarray:
    return level * (1 + 0.1 * np.arange(10)) + 0.002 * draw.normal(size=(k, 10))


AHEAD = {
    part: {TSM: precompute(0.1 + 0.02 * i), LSTM: precompute(0.15), KALMAN: precompute(0.08, k=1)}
    for i, part in enumerate(PARTS)
}
NOW = {part: {KALMAN: 0.07, SMOOTHED: 0.15} for part in PARTS}
RAW = {part: 0.25 - 0.01 * i for i, part in enumerate(PARTS)}
ONE_STEP = method("onestep")
MAP = {
    "noise 0, delay 5": {ONE_STEP: np.array([-1.24]), LSTM: np.array([7.0, 8.0, 9.0])},
    "obstacle, after contact": {LSTM: np.array([0.5])},
}


def episode(**changed: Any) -> Figure:
    given: dict[str, Any] = dict(
        clean=CLEAN, noisy=NOISY, taken=SENT, applied=APPLIED, titles=TITLES, dt=DT
    )
    return imperfect_episode(**given | changed)


def grid(given: Any = MAP, yours: Any = None) -> Figure:
    return advantage_map(given, TSM, unit="nats per step", yours=yours)


def lines(ax: Axes, method: Method) -> list[Any]:
    return [
        line for line in ax.lines if to_hex(line.get_color()).lower() == method.look.colour.lower()
    ]


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


EVERY: dict[str, Callable[[], Figure]] = {
    "figure 8": lambda: figure8(CURVES, FLOOR),
    "figure 8, one condition": lambda: figure8({"noise": CURVES["noise"]}),
    "an episode": episode,
    "filtering": lambda: filtering_errors(AHEAD, NOW, RAW),
    "filtering, one part and one seed": lambda: filtering_errors(
        {"angles": {TSM: precompute(0.1, k=1)}}, {"angles": {}}, {"angles": 0.25}
    ),
    "a map": grid,
    "a map of yours alone": lambda: grid({}, MAP),
    "a map of one cell without a difference": lambda: grid({"plain arm": {LSTM: np.zeros(1)}}),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", EVERY)
def test_every_figure_is_laid_out_without_warnings_and_not_left_open(name: str) -> None:
    figure = EVERY[name]()
    figure.draw_without_rendering()
    assert plt.get_fignums() == []
    assert min(text.get_fontsize() for text in figure.findobj(plt.Text) if text.get_text()) >= 6.5


@pytest.mark.parametrize("name", ["figure 8", "an episode", "filtering"])
def test_titles_fit_beside_each_other(name: str) -> None:
    figure = EVERY[name]()
    figure.canvas.draw()
    boxes = [ax._left_title.get_window_extent() for ax in figure.axes if ax.get_title(loc="left")]
    assert boxes
    assert max(box.x1 for box in boxes) <= figure.bbox.x1
    for one, other in pairwise(boxes):
        assert one.x1 < other.x0


# Figure 8 ------------------------------------------------------------------------------------------------------------


def test_figure_8_has_a_column_for_each_condition_and_one_scale_for_all() -> None:
    figure = figure8(CURVES, FLOOR)
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["Clean", "Noise", "Delay"]
    (scale,) = {ax.get_ylim() for ax in figure.axes}
    assert scale[0] < -13.5
    assert scale[1] > max(
        row["return_true"].mean(0).max() for rows in CURVES.values() for row in rows.values()
    )


def test_curves_of_a_condition_are_means_with_their_interval_and_floors_stand_in_every_panel() -> (
    None
):
    for ax, (_, rows) in zip(figure8(CURVES, FLOOR).axes, CURVES.items(), strict=True):
        (lstm,) = lines(ax, LSTM)
        np.testing.assert_allclose(lstm.get_ydata(), rows[RIVAL]["return_true"].mean(0))
        np.testing.assert_array_equal(lstm.get_xdata(), rows[RIVAL]["steps"])
        codes, actions = lines(ax, TSM)
        np.testing.assert_allclose(codes.get_ydata(), rows[LATENT]["return_true"].mean(0))
        np.testing.assert_allclose(actions.get_ydata(), rows[DIRECT]["return_true"].mean(0))
        flat = {line.get_ydata()[0] for line in ax.lines if len(set(line.get_ydata())) == 1}
        assert flat == set(FLOOR.values())
        mean, half = interval(rows[LATENT]["return_true"][:, 3])
        at_record = [part.get_paths()[0].vertices for part in ax.collections]
        at_record = [np.round(v[v[:, 0] == 660_000.0, 1], 9) for v in at_record]
        assert any(sorted(set(v)) == pytest.approx([mean - half, mean + half]) for v in at_record)


# An episode ----------------------------------------------------------------------------------------------------------


def test_an_episode_shows_what_is_true_and_what_sensors_say_at_every_step() -> None:
    axes = episode().axes
    assert [ax.get_title(loc="left") for ax in axes[:3]] == list(TITLES)
    for d, ax in enumerate(axes[:3]):
        seen, truth = ax.lines
        np.testing.assert_array_equal(seen.get_ydata(), NOISY[:, d])
        np.testing.assert_array_equal(truth.get_ydata(), CLEAN[:, d])
        np.testing.assert_allclose(truth.get_xdata(), DT * np.arange(STEPS + 1))
        assert (seen.get_linestyle(), truth.get_linestyle()) == ("None", "-")


def test_a_torque_is_held_from_its_step_on() -> None:
    sent, applied = episode().axes[-1].lines
    np.testing.assert_array_equal(sent.get_ydata(), SENT)
    np.testing.assert_array_equal(applied.get_ydata(), APPLIED)
    np.testing.assert_allclose(sent.get_xdata(), DT * np.arange(STEPS))
    assert sent.get_drawstyle() == applied.get_drawstyle() == "steps-post"


# Filtering -----------------------------------------------------------------------------------------------------------


def test_errors_stand_at_their_steps_and_a_filter_begins_with_the_present() -> None:
    figure = filtering_errors(AHEAD, NOW, RAW)
    for ax, part in zip(figure.axes, PARTS, strict=True):
        (tsm,) = lines(ax, TSM)
        assert tsm.get_xdata().tolist() == list(range(1, 11))
        np.testing.assert_allclose(tsm.get_ydata(), AHEAD[part][TSM].mean(0))
        (kalman,), (exponential,) = lines(ax, KALMAN), lines(ax, SMOOTHED)
        assert kalman.get_xdata().tolist() == list(range(11))
        np.testing.assert_allclose(kalman.get_ydata(), [0.07, *AHEAD[part][KALMAN][0]])
        assert (list(exponential.get_xdata()), list(exponential.get_ydata())) == ([0], [0.15])
        (raw,) = lines(ax, ZERO)
        assert set(raw.get_ydata()) == {RAW[part]}
    assert [ax.get_title(loc="left") for ax in figure.axes] == [part.capitalize() for part in PARTS]
    assert legend(figure) == [
        "TSM",
        "LSTM",
        "Kalman filter",
        "exponential filter",
        "raw observation",
    ]


def test_all_parts_share_a_scale_in_which_the_raw_observation_is_seen() -> None:
    figure = filtering_errors(AHEAD, NOW, RAW | {"angles": 3.0})
    (scale,) = {ax.get_ylim() for ax in figure.axes}
    assert scale[0] == 0
    assert scale[1] > 3.0


def test_a_model_that_is_far_off_is_told_in_words() -> None:
    rows = {part: dict(own) for part, own in AHEAD.items()}
    rows["velocities"][ONE_STEP] = precompute(2.0)
    figure = filtering_errors(rows, NOW, RAW)
    assert figure.axes[0].get_ylim()[1] < 1
    told = [ax.get_xlabel().replace("\n", " ") for ax in figure.axes]
    assert (
        told[2]
        == f"steps ahead outside: one-step to {rows['velocities'][ONE_STEP].mean(0).max():.3g}"
    )
    assert told[0] == told[1] == told[3] == "steps ahead"
    assert len(lines(figure.axes[2], ONE_STEP)) == 2  # the line and its arrow


# The map -------------------------------------------------------------------------------------------------------------


def test_a_map_has_a_line_per_place_a_column_per_rival_and_zero_in_the_middle_of_its_colours() -> (
    None
):
    figure = grid()
    ax, bar = figure.axes
    (image,) = ax.images
    np.testing.assert_array_equal(image.get_array().filled(np.nan), [[-1.24, 8.0], [np.nan, 0.5]])
    assert [text.get_text() for text in ax.get_xticklabels()] == [
        "against one-step",
        "against LSTM",
    ]
    places = [text.get_text() for text in ax.get_yticklabels()]
    assert places == ["noise 0, delay 5 (1 to 3 seeds)", "obstacle, after contact (1 seed)"]
    assert (image.norm.vmin, image.norm.vcenter, image.norm.vmax) == (-8.0, 0.0, 8.0)
    assert bar.get_ylabel() == "TSM ahead by\n(nats per step)"


def test_every_cell_says_its_mean_half_an_interval_of_several_seeds_and_yours_in_brackets() -> None:
    yours = {
        "noise 0, delay 5": {LSTM: np.array([7.0])},
        "obstacle, after contact": {ONE_STEP: np.array([-3.0])},
    }
    ax = grid(yours=yours).axes[0]
    half = interval(MAP["noise 0, delay 5"][LSTM])[1]
    assert [text.get_text() for text in ax.texts] == [
        "−1.2",
        f"+8.0 ± {half:.1f} (+7.0)",
        "(−3.0)",
        "+0.5",
    ]
    assert ax.get_xlabel() == "±: half the 95 % interval over seeds; in brackets: yours"


# What cannot be drawn ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: figure8({}), "nothing to draw"),
        (
            lambda: figure8({"noise": {LATENT: learned(-4) | {"steps": np.arange(4)}}}),
            r"expected \(5\)",
        ),
        (
            lambda: figure8(
                {"noise": {LATENT: learned(-4) | {"return_true": np.full((3, 5), np.nan)}}}
            ),
            "noise, TSM, latent, return_true: 15 of 15",
        ),
        (lambda: episode(titles=TITLES[:2]), r"clean has shape \(21, 3\), expected \(T, 2\)"),
        (lambda: episode(noisy=NOISY[1:]), r"noisy has shape \(20, 3\), expected \(21, 3\)"),
        (lambda: episode(taken=SENT[1:]), r"taken has shape \(19,\), expected \(20\)"),
        (
            lambda: episode(applied=np.append(APPLIED, 0)),
            r"applied has shape \(21,\), expected \(20\)",
        ),
        (
            lambda: episode(clean=np.where(CLEAN > 0, CLEAN, np.inf)),
            "clean: .* values are not finite",
        ),
        (lambda: filtering_errors({}, {}, {}), "nothing to draw"),
        (
            lambda: filtering_errors(AHEAD, NOW, {"angles": 0.25}),
            "raw has the panels angles; expected whole",
        ),
        (lambda: filtering_errors(AHEAD, {}, RAW), "now has the panels ; expected whole state"),
        (
            lambda: filtering_errors(
                {"angles": {TSM: np.zeros(10)}}, {"angles": {}}, {"angles": 0.25}
            ),
            r"angles, TSM has shape \(10,\), expected \(k, K\)",
        ),
        (
            lambda: filtering_errors(
                {"angles": {TSM: np.full((1, 10), np.nan)}}, {"angles": {}}, {"angles": 0.25}
            ),
            "angles, TSM: 10 of 10 values are not finite",
        ),
        (lambda: grid({}), "nothing to draw"),
    ],
)
def test_input_that_cannot_be_drawn_is_refused_in_words(
    call: Callable[[], Figure], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        call()
    assert plt.get_fignums() == []
