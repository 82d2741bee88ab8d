"""Figures of predictions show every model in its own colour, and say in words what does not fit the axis."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from tsmlib import plots as figures, statistics
from tsmlib.plots import axes
from tsmlib.zoo import method

MODELS = TSM, _, _, ONE_STEP, MULTI_STEP, LSTM, ENSEMBLE, _ = tuple(
    map(
        method,
        ("tsm", "rtsm", "tsm+teacher", "onestep", "multistep", "lstm", "ensemble", "ensemble+mse"),
    )
)
ENVS = ("Reacher", "Obstacle", "Push")
NAMES = ("joint0", "joint1", "tip_x", "tip_y", "block_x", "block_y")
LEVELS = np.linspace(0.1, 0.9, 9)


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).normal(scale=0.3, size=shape)


def scores(*models: figures.Method) -> dict[figures.Method, np.ndarray]:
    return {m: i + noise(3) for i, m in enumerate(models)}


def curves(*models: figures.Method, seeds: int = 3) -> dict[figures.Method, np.ndarray]:
    return {m: 1 + i + 0.1 * noise(seeds, 30) for i, m in enumerate(models)}


def episodes(
    *models: figures.Method,
) -> tuple[
    np.ndarray, dict[figures.Method, np.ndarray], dict[figures.Method, np.ndarray], tuple[str, ...]
]:
    """Blocks that move 5 cm to the right; episode 0 is the worst, 4 the best, 2 the median."""
    true = np.zeros((5, 20, 6))
    true[..., 4] = 0.1 + np.linspace(0, 0.05, 20)
    predicted = {m: true + 0.01 * noise(4, 5, 20, 6) for m in models}
    return true, predicted, {m: np.array([5.0, 4, 3, 2, 1]) for m in models}, NAMES


def texts(figure: Figure) -> str:
    return "\n".join(text.get_text() for ax in figure.axes for text in ax.texts)


def below(figure: Figure) -> str:
    return " ".join(ax.get_xlabel() for ax in figure.axes).replace("\n", " ")


def lines(ax: Axes, model: figures.Method) -> list[plt.Line2D]:
    return [line for line in ax.lines if to_hex(line.get_color()).upper() == model.look.colour]


gallery = partial(figures.gallery, radius=0.03)


EVERY: dict[str, Callable[[], Figure]] = {
    "figure5": lambda: figures.figure5({"": {env: scores(*MODELS) for env in ENVS}}),
    "figure5, two panels": lambda: figures.figure5(
        {t: {e: scores(*MODELS) for e in ENVS} for t in ("paper", "fair")}
    ),
    "figure5, one seed": lambda: figures.figure5({"": {ENVS[0]: {TSM: np.array([1.0])}}}),
    "against_horizon": lambda: figures.against_horizon(
        {"reach": curves(*MODELS), "push": curves(TSM, LSTM, seeds=1)},
        "NRMSE",
        log=["push"],
        reference={"reach": 0.8},
    ),
    "calibration": lambda: figures.calibration(LEVELS, {"push": dict.fromkeys(MODELS, LEVELS)}),
    "differences": lambda: figures.differences(
        {"reach": scores(*MODELS[1:]), "push": {LSTM: np.array([1.0])}},
        "nats",
        TSM,
        lower_is_better=["push"],
    ),
    "training_time": lambda: figures.training_time(
        {
            t: {m: (np.array([145.0, 580, 2320]), np.array([3.0, 2, 1])) for m in MODELS}
            for t in ("cost", "gap")
        },
        ships=580.0,
    ),
    "gallery": lambda: gallery(*episodes(TSM, LSTM), contact=np.array([3, -1, 3, 3, 19]), by=TSM),
    "gallery, tip": lambda: gallery(*episodes(*MODELS), path="tip"),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", EVERY)
def test_every_figure_is_laid_out_without_warnings_and_none_is_left_open(name: str) -> None:
    figure = EVERY[name]()
    figure.draw_without_rendering()
    assert plt.get_fignums() == []
    assert min(text.get_fontsize() for text in figure.findobj(plt.Text) if text.get_text()) >= 6.5


def test_every_model_has_its_colour_and_marker_in_every_figure() -> None:
    assert (
        len({m.look.colour for m in MODELS}) == len({m.look.marker for m in MODELS}) == len(MODELS)
    )
    for name in ("figure5", "against_horizon", "calibration", "gallery, tip"):
        figure = EVERY[name]()
        assert all(any(lines(ax, m) for ax in figure.axes) for m in MODELS), name


def test_both_ensembles_are_named_by_their_loss() -> None:
    legend = EVERY["figure5"]().legends[0]
    named = [text.get_text() for text in legend.get_texts()]
    assert {"ensemble (Gaussian)", "ensemble (squared error)"} <= set(named)


def test_on_a_logarithmic_axis_the_mean_over_seeds_is_that_of_the_logarithm() -> None:
    rows = np.array([[1.0, 1.0], [4.0, 4.0]])
    (ax,) = figures.against_horizon({"error": {TSM: rows}}, "units", log=["error"]).axes
    np.testing.assert_allclose(lines(ax, TSM)[0].get_ydata(), 2.0)
    (shade,) = ax.collections
    edge = shade.get_paths()[0].vertices[:, 1]
    assert edge.min() * edge.max() == pytest.approx(4.0)  # as far up as down, as factors of 2
    with pytest.raises(ValueError, match="0 cannot stand on a logarithmic axis"):
        figures.against_horizon({"error": {TSM: np.array([[0.0], [4.0]])}}, "units", log=["error"])


def test_the_line_against_training_time_joins_the_first_trainings_and_the_others_are_marked() -> (
    None
):
    seconds, values = np.array([2320.0, 580, 2320]), np.array([1.0, 4, 3])
    (ax,) = figures.training_time({"cost": {TSM: (seconds, values)}}).axes
    marks, line = lines(ax, TSM)
    assert marks.get_xydata().tolist() == [[2320, 3]]
    assert line.get_xydata().tolist() == [[580, 4], [2320, 1]]


def test_training_time_is_nominal_and_the_line_is_the_budget_that_ships() -> None:
    figure = figures.training_time({"cost": {TSM: (np.array([580.0]), np.ones(1))}}, ships=580.0)
    assert figure.axes[0].get_xlabel() == "nominal training time\nof one network (s)"
    assert figure.legends[0].get_texts()[-1].get_text() == "budget that ships, 580 s"


def test_figure5_marks_the_mean_over_seeds_and_its_interval() -> None:
    seeds = np.array([1.0, 2.0, 4.0])
    (ax,) = figures.figure5({"": {ENVS[0]: {TSM: seeds, LSTM: seeds + 1}}}).axes
    bar, mark = (line.get_ydata() for line in lines(ax, TSM))
    mean, half = statistics.interval(seeds)
    np.testing.assert_allclose(mark, [mean])
    np.testing.assert_allclose(bar, [mean - half, mean + half])


def test_figure5_keeps_the_place_of_a_model_that_one_environment_lacks() -> None:
    (ax,) = figures.figure5(
        {"": {ENVS[0]: scores(TSM, ONE_STEP, LSTM), ENVS[1]: scores(TSM, LSTM)}}
    ).axes
    first, second = ([float(lines(ax, m)[i].get_xdata()[0]) for m in (TSM, LSTM)] for i in (1, 3))
    assert first[1] - first[0] == second[1] - second[0] == 2


def test_a_diverged_model_leaves_the_others_readable_and_its_value_in_words() -> None:
    good, far = scores(TSM, MODELS[1], LSTM), np.array([-1e5, -2e5, -3e5])
    figure = figures.figure5(
        {"": {"push": good | {ONE_STEP: far, ENSEMBLE: np.array([5.0, 5, 300])}}}
    )
    assert below(figure).startswith(
        "outside: push, one-step −2.0×10⁵ ± 2.5×10⁵ push, ensemble (Gaussian) 103 ± "
    )
    low, high = figure.axes[0].get_ylim()
    seen = np.concatenate(list(good.values()))
    assert low < seen.min() < seen.max() < high < low + 20
    assert {"v", "^"} <= {
        line.get_marker() for line in lines(figure.axes[0], ONE_STEP)
    }  # its interval leaves twice


def test_what_lies_within_the_axis_is_not_told() -> None:
    seen = scores(TSM, LSTM, MULTI_STEP)
    figure = figures.figure5({"": {"push": seen}})
    low, high = figure.axes[0].get_ylim()
    assert (
        low
        < np.concatenate(list(seen.values())).min()
        < np.concatenate(list(seen.values())).max()
        < high
    )
    assert below(figure) == ""
    assert below(figures.against_horizon({"push": curves(TSM, LSTM)}, "NRMSE")) == "steps ahead"
    assert below(figures.differences({"push": seen}, "nats", ENSEMBLE)) == "nats"


def test_environments_whose_scores_lie_apart_share_an_axis() -> None:
    points = np.concatenate([-12.5 + noise(14), -19 + noise(7)])
    low, high = axes.limits(points, points)
    assert low < points.min() < points.max() < high


def test_one_seed_that_goes_astray_does_not_squeeze_the_others() -> None:
    rows = curves(TSM, LSTM, MULTI_STEP)
    rows[TSM][0, 4] = -300.0
    figure = figures.against_horizon({"push": rows}, "nats")
    assert figure.axes[0].get_ylim()[0] > -20
    assert "outside: TSM to −9" in below(figure)


def test_yours_are_hollow_diamonds_over_the_published_marks() -> None:
    seeds, mine = scores(TSM), {TSM: np.array([0.05]), LSTM: np.array([0.1])}
    drawn = figures.figure5({"": {"push": seeds}}, yours={"": {"push": mine}})
    (ax,) = drawn.axes
    points = {
        to_hex(line.get_color()).upper(): line.get_ydata()[0]
        for line in ax.lines
        if line.get_marker() == "D"
    }
    assert points == {TSM.look.colour: 0.05, LSTM.look.colour: 0.1}
    assert "yours" in [text.get_text() for text in drawn.legends[0].get_texts()]


def test_yours_that_leave_the_axis_are_told_in_words() -> None:
    figure = figures.figure5(
        {"": {"push": scores(TSM, LSTM)}}, yours={"": {"push": {TSM: np.array([-1e5])}}}
    )
    assert "push, TSM, yours −10⁵" in below(figure)
    figure.draw_without_rendering()
    assert figure.axes[0].get_position().width > 0.5  # what is outside leaves the layout alone


def test_a_diverged_curve_ends_in_an_arrow_and_its_furthest_value_in_words() -> None:
    rows = curves(TSM, LSTM, MULTI_STEP) | {ONE_STEP: np.exp(np.arange(30.0))[None]}
    figure = figures.against_horizon({"push": rows}, "NRMSE")
    assert below(figure) == "steps ahead outside: one-step to 3.9×10¹²"
    assert figure.axes[0].get_ylim()[1] < 50
    (arrow,) = (line for line in lines(figure.axes[0], ONE_STEP) if line.get_marker() == "^")
    assert arrow.get_ydata() == figure.axes[0].get_ylim()[1]


@pytest.mark.parametrize(("low", "high"), [(1.1, 1.9), (0.3, 2), (0.01, 5), (1e-3, 1e6)])
def test_a_logarithmic_axis_has_some_ticks_and_not_too_many(low: float, high: float) -> None:
    ax = Figure().add_subplot()
    axes.log_axis(ax, low, high)
    ax.set_ylim(low, high)
    assert 2 <= sum(low <= tick <= high for tick in ax.get_yticks()) <= 10


def test_the_mean_over_seeds_is_drawn_against_steps_from_one() -> None:
    rows = curves(LSTM)
    ax = figures.against_horizon({"push": rows}, "NRMSE").axes[0]
    (line,) = lines(ax, LSTM)
    np.testing.assert_array_equal(line.get_xdata(), np.arange(1, 31))
    np.testing.assert_allclose(line.get_ydata(), rows[LSTM].mean(0))
    assert len(ax.collections) == 1
    assert not figures.against_horizon({"push": curves(LSTM, seeds=1)}, "NRMSE").axes[0].collections


def test_a_second_method_of_a_model_is_dashed() -> None:
    ax = figures.against_horizon(
        {"push": curves(TSM, method("tsm", variant="free"))}, "NRMSE"
    ).axes[0]
    assert len({line.get_linestyle() for line in lines(ax, TSM)}) == 2


def test_calibration_has_the_ideal_as_its_diagonal() -> None:
    ax = EVERY["calibration"]().axes[0]
    np.testing.assert_array_equal(ax.lines[0].get_xydata(), [[0, 0], [1, 1]])


def test_a_difference_is_filled_only_where_its_interval_excludes_zero() -> None:
    sure, open_, single = np.array([1.0, 1.1, 1.2]), np.array([-1.0, 0.2, 1.0]), np.array([1.0])
    figure = figures.differences(
        {"push": {ONE_STEP: sure, LSTM: open_, ENSEMBLE: single}}, "nats", TSM
    )
    faces = {
        m: to_hex(lines(figure.axes[0], m)[-1].get_markerfacecolor())
        for m in (ONE_STEP, LSTM, ENSEMBLE)
    }
    assert faces == {ONE_STEP: ONE_STEP.look.colour.lower(), LSTM: "#ffffff", ENSEMBLE: "#ffffff"}
    assert "better →" in texts(figure)
    assert "TSM minus" in texts(figure)


def test_where_lower_is_better_the_sides_of_zero_change() -> None:
    figure = figures.differences(
        {"energy": scores(LSTM)}, "energy score", TSM, lower_is_better=["energy"]
    )
    assert "← better" in texts(figure)
    assert "worse →" in texts(figure)


def test_zero_is_always_in_sight() -> None:
    low, high = (
        figures.differences({"push": {LSTM: np.array([7.0, 7.1])}}, "nats", TSM).axes[0].get_xlim()
    )
    assert low < 0 < 7.1 < high


def test_a_diverged_difference_is_told_below() -> None:
    values = scores(LSTM, ENSEMBLE, MULTI_STEP) | {ONE_STEP: np.array([1e5, 1e5, 1e5])}
    assert "outside: one-step 10⁵" in below(figures.differences({"push": values}, "nats", TSM))


def test_the_gallery_shows_best_median_and_worst_by_energy_score() -> None:
    figure = gallery(*episodes(TSM, LSTM))
    assert [ax.get_ylabel() for ax in figure.axes[::2]] == ["best", "median", "worst"]
    assert [ax.get_title("left") for ax in figure.axes[::2]] == [
        f"energy score {score}" for score in (1, 3, 5)
    ]
    assert all(ax.get_aspect() == 1 for ax in figure.axes)
    black = [
        line
        for line in figure.axes[0].lines
        if line.get_color() == "black" and len(line.get_xdata()) > 1
    ]
    np.testing.assert_allclose(black[0].get_xdata(), episodes(TSM)[0][4, :, 4])


def test_one_model_may_choose_the_episodes_of_all() -> None:
    true, predicted, energy, names = episodes(TSM, LSTM)
    energy[LSTM] = energy[TSM][::-1]
    figure = gallery(true, predicted, energy, names, by=TSM)
    assert figure.axes[0].get_ylabel() == "best for TSM"
    assert figure.axes[1].get_title("left") == "energy score 5"


def test_samples_that_leave_the_picture_are_counted() -> None:
    true, predicted, energy, names = episodes(TSM, LSTM)
    predicted[LSTM][:3, 4, -1, 4] += 1e6
    figure = gallery(true, predicted, energy, names)
    assert "3 of 4 leave,\nto 10⁶ m off" in texts(figure)
    assert np.ptp(figure.axes[0].get_xlim()) < 0.5
    assert "leave" not in texts(gallery(*episodes(TSM, LSTM)))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0, "0"),
        (0.5, "0.5"),
        (-12.34, "−12.3"),
        (1234.5, "1234"),
        (-123456, "−1.2×10⁵"),
        (1e-5, "10⁻⁵"),
    ],
)
def test_numbers_in_words(value: float, text: str) -> None:
    assert axes.spell(value) == text


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: figures.figure5({}), "nothing to draw"),
        (
            lambda: figures.figure5({"": {"push": {TSM: noise(3, 2)}}}),
            r"push, TSM has shape \(3, 2\), expected \(k\)",
        ),
        (
            lambda: figures.figure5({"": {"push": {TSM: np.array([1, np.nan])}}}),
            "push, TSM: 1 of 2 values are not",
        ),
        (
            lambda: figures.figure5({"a": {"push": {TSM: noise(3)}}}, {"b": "nats"}),
            "panel 'a' is missing",
        ),
        (
            lambda: figures.against_horizon({"push": {TSM: noise(9)}}, "e"),
            r"shape \(9,\), expected \(k, T\)",
        ),
        (
            lambda: figures.against_horizon({"push": curves(TSM)}, "e", log=["reach"]),
            "log names a panel 'reach'",
        ),
        (
            lambda: figures.against_horizon({"push": {TSM: -np.ones((1, 3))}}, "e", log=["push"]),
            "−1 cannot stand",
        ),
        (
            lambda: figures.calibration(LEVELS, {"push": {TSM: LEVELS[:4]}}),
            r"shape \(4,\), expected \(9\)",
        ),
        (
            lambda: figures.calibration(LEVELS, {"push": {TSM: 100 * LEVELS}}),
            "10 to 90, expected shares",
        ),
        (
            lambda: figures.differences({"push": scores(LSTM)}, "nats", TSM, lower_is_better=["x"]),
            "there are push",
        ),
        (
            lambda: gallery(*episodes(TSM), path="elbow"),
            "no path of the elbow; there are tip, block",
        ),
        (lambda: gallery(*episodes(TSM), by=LSTM), "energy holds TSM; 'LSTM' is missing"),
        (
            lambda: gallery(*episodes(TSM), contact=np.zeros(4)),
            r"contact has shape \(4,\), expected \(5\)",
        ),
        (
            lambda: gallery(noise(2, 9, 6), {TSM: noise(4, 2, 9, 6)}, {TSM: noise(2)}, NAMES),
            "at least 3",
        ),
    ],
)
def test_a_wrong_input_is_named(wrong: Callable[[], Figure], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        wrong()
    assert plt.get_fignums() == []


def test_markers_of_a_line_stand_at_steps_that_were_measured() -> None:
    (ax,) = figures.against_horizon({"": curves(*MODELS)}, "", measured=(1, 2, 5, 10, 20, 30)).axes
    found = [line.get_xdata()[line.get_markevery()].tolist() for line in ax.lines[:4]]
    assert found == [[1, 10], [2, 20], [5, 30], [1, 10]]


def test_a_forest_plot_says_what_filled_and_open_marks_and_small_dots_are() -> None:
    def legend(values: dict[figures.Method, np.ndarray]) -> list[str]:
        return [
            text.get_text()
            for text in figures.differences({"": values}, "", TSM).legends[0].get_texts()
        ]

    assert legend(scores(LSTM)) == [
        "mean, 95 % interval without 0",
        "interval with 0, or a single seed",
        "one seed",
    ]
    assert legend({LSTM: np.array([1.0])}) == ["a single seed"]
