"""Figures of codes and of the action prior draw what they are given, and refuse what does not fit."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from io import BytesIO

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image

from tsmlib import plots as figures
from tsmlib.envs.render import draw_scene
from tsmlib.plots import style
from tsmlib.zoo import method

TSM, OURS = METHODS = method("tsm"), method("rtsm")
DRAW = partial(draw_scene, env_id="tsm/ReacherPush-v1")
START = np.array([0.2, 0.3, 0, 0, 0.19, 0.07, 0.1, 0.12, 0, 0])
PATH = START[6:8] + np.linspace(0, 0.1, 30)[:, None]


def noise(*shape: int) -> np.ndarray:
    return 0.01 * np.random.default_rng(0).normal(size=shape)


def fan(*shape: int) -> np.ndarray:
    return PATH + noise(*shape, 30, 2)


def use() -> Figure:
    values = {
        "Reacher": {TSM: np.array([0.001])},
        "Push": {label: np.array([1.0, 2.0, 3.0]) for label in METHODS},
    }
    return figures.code_use(
        {"KL": values, "spread": values},
        {"KL": "nats", "spread": "share"},
        {"KL": {"Reacher": 0.1}, "spread": {}},
    )


def recall(**more: np.ndarray) -> Figure:
    shares = {word: np.full((2, 3), 0.5) for word in ("recall", "precision", "chance")} | more
    return figures.contact_recall(
        {"arm": dict.fromkeys(METHODS, shares), "wall": {TSM: shares}},
        ("1–10", "11–20", "21–30"),
        {"arm": 0.8},
    )


def wheel() -> Figure:
    angle = np.linspace(-3, 3, 50)
    way = np.stack([np.cos(angle), np.sin(angle)], 1) * (np.arange(50) % 2)[:, None]
    return figures.embedding({"codes": (noise(50, 2), way, ("first", "second"))})


def ten(changed: float = 0.5) -> Figure:
    ways = (
        method("data"),
        method("prior", variant="a sample"),
        method("tsm", "latent", "cem"),
        method("tsm", "direct"),
    )
    plans = {way: noise(50, 2) for way in ways}
    return figures.figure10(plans, 0.02, dict.fromkeys(plans, changed))


SPECTRUM = (np.arange(1, 26.0), np.arange(1, 26.0) ** -2)
EVERY: dict[str, Callable[[], Figure]] = {
    "code_use": use,
    "around_touch": lambda: figures.around_touch(
        {label: (abs(noise(30)), abs(noise(30))) for label in METHODS}, 4
    ),
    "spread_against_error": lambda: figures.spread_against_error(
        {
            env: {label: (np.arange(1, 9.0), np.arange(1, 9.0)) for label in METHODS}
            for env in ("Push", "Obstacle")
        }
    ),
    "figure9": lambda: figures.figure9(
        DRAW, np.stack([START] * 3), np.stack([PATH] * 3), dict.fromkeys(METHODS, fan(5, 3))
    ),
    "contact_recall": recall,
    "deflection_intervals": lambda: figures.deflection_intervals(
        {label: (-abs(noise(20)), noise(20) + 9) for label in METHODS}
    ),
    "walk": lambda: figures.walk(DRAW, START, fan(9), {9: 0.02, 17: 0.01, 33: 0.005}),
    "embedding": wheel,
    "code_grid": lambda: figures.code_grid(START, fan(3, 3), PATH, (-1, 0, 1), TSM, radius=0.03),
    "code_fan": lambda: figures.code_fan(DRAW, START, fan(9), PATH, TSM)(fan(6)),
    "figure10": ten,
    "spectra": lambda: figures.spectra(
        {"reach": {method("data"): SPECTRUM, method("tsm", "direct", "adam"): SPECTRUM}}
    ),
    "prior_walks": lambda: figures.prior_walks(noise(4, 9, 10, 2), 0.02),
    "cost_of_prior": lambda: figures.cost_of_prior(
        {"reach": {"lost": noise(9), "distance": noise(9)}}, {"distance": "metres"}
    ),
}


@pytest.mark.parametrize("word", EVERY)
def test_every_figure_is_as_wide_as_a_page_at_most_and_leaves_none_open(word: str) -> None:
    figure = EVERY[word]()
    assert isinstance(figure, Figure)
    assert figure.get_figwidth() <= style.WIDTH + 1e-6
    assert not plt.get_fignums()


def marks(ax: Axes, method: figures.Method) -> list[tuple[float, float]]:
    """Where the marks of a model stand."""
    main = method.look.colour.lower()
    lines = [
        line
        for line in ax.lines
        if to_hex(line.get_color()) == main and line.get_marker() not in ("None", "")
    ]
    return [(float(line.get_xdata()[0]), float(line.get_ydata()[0])) for line in lines]


def test_a_row_has_the_mean_over_seeds_of_each_model() -> None:
    left = use().axes[0]
    assert marks(left, TSM) == [(0.001, 0), (2.0, 1)]
    assert marks(left, OURS) == [(2.0, 1)]


def test_labels_of_spread_and_error_do_not_run_into_each_other() -> None:
    grown = np.geomspace(0.01, 0.3, 10)
    figure = figures.spread_against_error(
        {word: dict.fromkeys(METHODS, (grown, 2 * grown)) for word in ("wall", "arm")}
    )
    figure.canvas.draw()
    left, right = (ax.xaxis.label.get_window_extent() for ax in figure.axes)
    assert left.x1 + 10 < right.x0


def test_a_panel_of_codes_names_the_models_without_values_in_it() -> None:
    values = {
        "KL": {"Push": {TSM: np.array([1.0])}},
        "spread": {"Push": dict.fromkeys(METHODS, np.array([1.0]))},
    }
    left, right = figures.code_use(values, {"KL": "nats", "spread": "share"}, {}).axes
    assert (
        left.get_xlabel() == f"nats\nno values of {', '.join(m.label for m in METHODS if m != TSM)}"
    )
    assert right.get_xlabel() == "share"


def test_a_walk_shows_in_centimetres_how_far_the_ends_lie_from_the_first_one() -> None:
    ways = fan(9)
    _, ends, jumps = figures.walk(DRAW, START, ways, {9: 0.02, 17: 0.01}).axes
    for line, values in zip(ends.lines, 100 * (ways[:, -1] - ways[0, -1]).T, strict=True):
        np.testing.assert_allclose(line.get_ydata(), values)
    assert jumps.lines[0].get_ydata().tolist() == [2.0, 1.0]


def diamonds(ax: Axes) -> list[tuple[float, float]]:
    """Where the reader's own hollow diamonds stand."""
    return [
        (float(x), float(y))
        for line in ax.lines
        if line.get_marker() == "D"
        for x, y in zip(line.get_xdata(), line.get_ydata(), strict=True)
    ]


def test_yours_stand_below_the_published_use_of_codes_in_rows_of_their_own_too() -> None:
    published = {"KL": {"Reacher": {TSM: np.array([0.001, 0.003])}}, "spread": {"Reacher": {}}}
    own = {"KL": {"Reacher": {TSM: np.array([0.01])}, "Push": {OURS: np.array([1.0, 3.0])}}}
    figure = figures.code_use(published, dict.fromkeys(published, ""), {}, yours=own)
    left, right = figure.axes
    assert diamonds(left) == [(0.01, 0.25), (2.0, 1.25)]
    assert marks(left, TSM)[0] == (0.002, 0)
    assert not diamonds(right)
    assert [text.get_text() for text in left.get_yticklabels()] == ["Reacher", "Push"]


def test_your_recall_and_precision_are_drawn_where_nothing_is_published_too() -> None:
    own = {
        "arm": {
            OURS: {
                "recall": np.full((1, 3), 0.7),
                "precision": np.full((1, 3), 0.4),
                "chance": np.zeros((1, 3)),
            }
        }
    }
    figure = figures.contact_recall(
        {"arm": {}}, ("1–10", "11–20", "21–30"), {"arm": 0.8}, yours=own
    )
    assert sorted(y for _, y in diamonds(figure.axes[0])) == [0.4] * 3 + [0.7] * 3


def test_every_sample_of_figure_9_is_drawn_from_where_the_object_was() -> None:
    figure = EVERY["figure9"]()
    fans = [
        part for ax in figure.axes for part in ax.collections if isinstance(part, LineCollection)
    ]
    assert [len(part.get_segments()) for part in fans] == [5] * 6
    for part in fans:
        for way in part.get_segments():
            np.testing.assert_allclose(way[0], START[6:8])


def test_an_interval_that_misses_the_truth_is_pale() -> None:
    figure = figures.deflection_intervals({TSM: (np.array([-5.0, 3.0]), np.array([5.0, 20.0]))})
    dark, pale = (to_hex(line.get_color()) for line in figure.axes[0].lines[:2])
    assert dark == TSM.look.colour.lower() != pale
    assert "50% hold the truth" in figure.axes[0].texts[0].get_text()


def test_torques_of_the_data_and_of_the_prior_have_their_own_colours() -> None:
    figure = ten(0.25)
    mains = [to_hex(ax.lines[1].get_color()).upper() for ax in figure.axes]
    assert mains == [method(word).look.colour for word in ("data", "prior", "tsm", "tsm")]
    assert [bool(ax.texts) for ax in figure.axes] == [
        False,
        True,
        True,
        True,
    ]  # the data need no comparison
    assert "0.25" in figure.axes[1].texts[0].get_text()


def test_the_note_of_figure_10_covers_no_torques() -> None:
    figure = ten()
    figure.canvas.draw()
    for ax in figure.axes[1:]:
        lowest = min(np.min(line.get_ydata()) for line in ax.lines)
        assert ax.texts[0].get_window_extent().y1 < ax.transData.transform((0, lowest))[1]


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="k, 3"):
        recall(recall=np.zeros((2, 4)))
    with pytest.raises(ValueError, match="not finite"):
        figures.walk(DRAW, START, np.full((9, 30, 2), np.nan), {9: 0.1})
    with pytest.raises(ValueError, match="expected"):
        figures.code_grid(START, fan(3, 3), PATH, (-1, 1), TSM, radius=0.03)


def test_a_turned_knob_draws_the_picture_anew() -> None:
    seen: list[tuple[float, float]] = []

    def draw(a: float, b: float) -> Figure:
        seen.append((a, b))
        figure = Figure(figsize=(1, 1))
        figure.text(0.1, 0.5, f"{a} {b}")
        return figure

    panel = figures.slider_panel(draw, {"one way": (-3.0, 3.0, 0.25), "the other": (1.0, 2.0, 0.5)})
    first, second, picture = panel.children
    assert (first.description, second.description) == ("one way", "the other")
    before = picture.value
    first.value = 1.25
    second.value = 2.0
    assert seen == [(0.0, 1.0), (1.25, 1.0), (1.25, 2.0)]
    assert before[:4] == picture.value[:4] == b"\x89PNG"
    assert before != picture.value


def test_sliders_and_picture_fit_a_small_screen_together_and_are_not_stretched() -> None:
    picture_of = figures.code_fan(DRAW, START, fan(9), PATH, TSM)
    panel = figures.slider_panel(
        lambda a, b: picture_of(fan(6)), {"a": (-3.0, 3.0, 0.25), "b": (-3.0, 3.0, 0.25)}
    )
    first, _, picture = panel.children
    with Image.open(BytesIO(picture.value)) as shown:
        assert picture.width == str(shown.width)  # a pixel of it is a pixel of the screen
        assert (
            shown.height + 2 * 40 < 900 - 250
        )  # what JupyterLab has above and below a notebook of 900 pixels
    assert panel.layout.align_items == "flex-start"
    assert first.layout.width == f"{shown.width}px"


def test_a_figure_that_moves_is_drawn_over_what_stays_as_if_drawn_whole() -> None:
    picture_of = figures.code_fan(DRAW, START, fan(9), PATH, TSM)
    panel = figures.slider_panel(lambda a: picture_of(fan(6) + 0.02 * a), {"a": (-3.0, 3.0, 0.25)})
    slider, picture = panel.children
    for value in (1.5, -2.0, 0.0):
        slider.value, whole = value, BytesIO()
        picture_of(fan(6) + 0.02 * value).savefig(whole, format="png", dpi=100)
        with Image.open(BytesIO(picture.value)) as shown, Image.open(whole) as expected:
            np.testing.assert_array_equal(np.asarray(shown), np.asarray(expected)[..., :3])


def test_a_slider_moves_the_whole_fan_and_leaves_the_rest() -> None:
    picture_of = figures.code_fan(DRAW, START, fan(9), PATH, TSM)
    still = [artist.get_zorder() for artist in picture_of(fan(6)).axes[0].get_children()]
    (ax,) = picture_of(fan(6) + 0.01).axes
    moved = ax.collections[-1].get_segments()
    np.testing.assert_allclose([way[1:] for way in moved], fan(6) + 0.01)
    np.testing.assert_allclose([way[0] for way in moved], [START[6:8]] * 6)
    assert [artist.get_zorder() for artist in ax.get_children()] == still  # nothing was drawn twice
