"""Every figure draws what it is given, in one colour per method, into files whose bytes do not change."""

from __future__ import annotations

import base64
import warnings
from io import BytesIO

import matplotlib.pyplot as plt
import numpy as np
import pytest
from IPython.core.formatters import DisplayFormatter
from matplotlib import font_manager
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image

from tsmlib import plots as figures, statistics
from tsmlib.plots import style
from tsmlib import zoo
from tsmlib.zoo import method

NAMES = ("joint0", "joint1", "joint0_vel", "joint1_vel", "tip_x", "tip_y")
UNITS = ("rad", "rad", "rad/s", "rad/s", "m", "m")
TSM, LSTM = method("tsm"), method("lstm")
PLANNED, FREE = method("tsm", "latent", "cem"), method("tsm", "direct", "adam")
ONE_STEP, ZERO = method("onestep", "direct", "adam"), method("none", "", "zero")
ORACLES = method("oracle", "latent", "cem"), method("oracle", "direct", "cem")


PICTURE = np.full((20, 20, 3), 200, np.uint8)


def noise(*shape: int) -> np.ndarray:
    return np.clip(np.random.default_rng(0).normal(scale=0.3, size=shape), -1, 1)


def returns() -> dict[str, dict[figures.Method, dict[str, np.ndarray | None]]]:
    true = -1 - np.abs(noise(12))
    rows: dict[figures.Method, dict[str, np.ndarray | None]] = {
        PLANNED: {"true": true - 0.5, "predicted": true - 0.4},
        FREE: {"true": true - 1.5, "predicted": true},
        ONE_STEP: {"true": true - 3.0, "predicted": true + 0.5},
        ORACLES[0]: {"true": true, "predicted": None},
        ORACLES[1]: {"true": true - 0.2, "predicted": None},
        ZERO: {"true": true - 4.0, "predicted": None},
    }
    return {"reach": rows, "push": rows}


def curve() -> dict[str, np.ndarray]:
    steps = np.arange(10.0)
    return {"seconds": steps, "train": np.exp(-steps), "validation": 1.1 * np.exp(-steps)}


def steps() -> dict[figures.Method, dict[str, np.ndarray]]:
    at = np.array([0.0, 5.0, 20.0])
    return {PLANNED: {"iterations": at, "true": -5 + at / 20, "predicted": -5 + at / 10}}


def film(height: int, width: int) -> np.ndarray:
    return np.zeros((2, height, width, 3), np.uint8)


def draw(ax: plt.Axes, states: np.ndarray, target: np.ndarray) -> None:
    ax.plot([0, states[-1, 4]], [0, states[-1, 5]])
    ax.plot(*target, "o")


EVERY = {
    "figure1": lambda: figures.figure1(),
    "figure2": lambda: figures.figure2(),
    "figure3": lambda: figures.figure3(),
    "figure4": lambda: figures.figure4(
        dict.fromkeys(("MuJoCo", "pymunk"), dict.fromkeys(("Reach", "Push"), PICTURE))
    ),
    "figure6": lambda: figures.figure6(returns()),
    "predicted_vs_true": lambda: figures.predicted_vs_true(returns()),
    "loss_curves": lambda: figures.loss_curves({TSM: curve(), method("prior"): curve()}),
    "torque_gallery": lambda: figures.torque_gallery(noise(3, 20, 2), 0.02),
    "state_histograms": lambda: figures.state_histograms(noise(4, 20, 6), NAMES, UNITS),
    "workspace_coverage": lambda: figures.workspace_coverage(0.2 * noise(500, 2), 0.21),
    "rollout_panels": lambda: figures.rollout_panels(
        noise(15, 6), noise(4, 15, 6), NAMES, UNITS, TSM
    ),
    "plan_strip": lambda: figures.plan_strip(
        draw,
        {TSM: (noise(10, 6), noise(10, 6)), PLANNED: (noise(10, 6), noise(10, 6))},
        np.zeros(2),
        [0, 4, 9],
        notes={TSM: "ends 3 mm off"},
    ),
    "plan_actions": lambda: figures.plan_actions(
        noise(20, 2), noise(20, 2), noise(20, 2), TSM, dt=0.02
    ),
    "along_the_way": lambda: figures.along_the_way(steps()),
    "final_distances": lambda: figures.final_distances(
        {"push": {PLANNED: {"open": np.abs(noise(9))}}}, 0.03
    ),
    "plan_paths": lambda: figures.plan_paths(
        noise(2, 9, 2), noise(2, 10, 2), TSM, wanted=noise(5, 2), zone=(0.1, 0, 0.05)
    ),
}


@pytest.mark.parametrize("name", EVERY)
def test_every_figure_is_returned_and_none_is_left_open(name: str) -> None:
    assert isinstance(EVERY[name](), Figure)
    assert plt.get_fignums() == []


@pytest.mark.parametrize("name", EVERY)
def test_every_figure_finds_its_fonts_and_glyphs(
    name: str, caplog: pytest.LogCaptureFixture
) -> None:
    for family in ("DejaVu Sans", "STIXGeneral", "STIXNonUnicode"):
        font_manager.findfont(
            family, fallback_to_default=False
        )  # refused where matplotlib's list of fonts is stale
    figure = EVERY[name]()
    figure.set_dpi(97)  # formulas are kept by resolution, and a missing glyph is only told of once
    with caplog.at_level("WARNING", logger="matplotlib"), warnings.catch_warnings():
        warnings.simplefilter("error")
        figure.draw_without_rendering()
    assert not [record.getMessage() for record in caplog.records]


@pytest.mark.parametrize("name", ["figure2", "figure6"])
def test_the_same_figure_gives_the_same_bytes(name: str, tmp_path) -> None:
    first = [path.read_bytes() for path in figures.save(EVERY[name](), tmp_path / "a" / "one")]
    second = [path.read_bytes() for path in figures.save(EVERY[name](), tmp_path / "two")]
    assert first == second
    assert sorted(path.name for path in tmp_path.rglob("*.*")) == [
        "one.pdf",
        "one.png",
        "two.pdf",
        "two.png",
    ]


def test_a_method_keeps_its_colour_in_every_figure() -> None:
    own = [LSTM.look.colour, TSM.look.colour]
    horizon = figures.against_horizon({"push": {LSTM: noise(1, 5), TSM: noise(1, 5)}}, "").axes[0]
    assert [to_hex(line.get_color()).upper() for line in horizon.lines] == own
    panels = figures.loss_curves({LSTM: curve(), TSM: curve()}).axes
    assert [to_hex(ax.lines[1].get_color()).upper() for ax in panels] == own
    looks = [zoo.look(word) for word in (*zoo.ZOO, *zoo.LOOKS)]
    assert len({look.colour for look in looks}) == len(looks)


def test_figure6_shows_costs_beside_the_latent_oracle_s_and_gaps() -> None:
    rows = returns()["reach"]
    cost, gap = figures.figure6({"reach": rows}).axes
    points = {round(float(bar.lines[0].get_xdata()[0]), 6) for bar in cost.containers}
    methods = (PLANNED, FREE, ONE_STEP, ORACLES[1])
    assert points == {
        round(rows[m]["true"].mean() / rows[ORACLES[0]]["true"].mean(), 6) for m in methods
    }
    assert [float(bar.lines[0].get_xdata()[0]) for bar in gap.containers] == pytest.approx(
        [0.1, 1.5, 3.5]
    )
    assert float(cost.lines[0].get_xdata()[0]) == 1


def test_figure6_names_the_oracle_that_costs_are_divided_by() -> None:
    def legend(rows: dict[figures.Method, dict[str, np.ndarray | None]]) -> list[str]:
        return [text.get_text() for text in figures.figure6({"reach": rows}).legends[0].get_texts()]

    rows = returns()["reach"]
    assert "oracle, latent (= 1)" in legend(rows)
    assert not any("oracle" in word for word in legend({PLANNED: rows[PLANNED]}))


def test_lengths_are_drawn_in_centimetres_and_say_so() -> None:
    states = figures.state_histograms(noise(4, 20, 6), NAMES, UNITS).axes
    assert [ax.get_xlabel()[-4:] for ax in states[-2:]] == ["(cm)", "(cm)"]
    edges = [patch.get_x() for patch in states[4].patches]
    assert min(edges) == pytest.approx(100 * noise(4, 20, 6)[..., 4].min())
    (way, *_), path = (
        figures.plan_paths(noise(1, 9, 2), noise(1, 10, 2), TSM).axes,
        noise(1, 9, 2)[0],
    )
    np.testing.assert_allclose(way.lines[0].get_xydata(), 100 * path)
    places = figures.workspace_coverage(0.2 * noise(500, 2), 0.21).axes[0]
    assert (places.get_xlabel(), places.get_xlim()[1]) == (
        "fingertip x (cm)",
        pytest.approx(1.08 * 21),
    )


def test_time_stands_below_the_lowest_panels_of_torques_and_not_beside_the_stamp() -> None:
    figure = figures.torque_gallery(noise(8, 20, 2), 0.02)
    assert [ax.get_xlabel() for ax in figure.axes] == [""] * 4 + ["time (s)"] * 4
    assert not figure.get_supxlabel()


def test_a_state_that_hardly_varies_has_logarithmic_heights_and_says_so() -> None:
    states = noise(50, 20, 6)
    states[:45, :, 2] = 0
    axes = figures.state_histograms(states, NAMES, UNITS).axes
    assert [ax.get_yscale() for ax in axes] == [
        "linear",
        "linear",
        "log",
        "linear",
        "linear",
        "linear",
    ]
    assert axes[2].get_xlabel() == "shoulder velocity (rad/s)\nheights logarithmic"


def test_a_legend_has_no_column_that_its_rows_leave_almost_empty() -> None:
    for count, columns in {6: 3, 9: 5, 11: 4, 3: 3}.items():
        figure = plt.figure()
        style.legend(figure, [style.entry(str(i), color="k") for i in range(count)], 5)
        assert figure.legends[0]._ncols == columns
        plt.close(figure)


def test_a_dot_of_predicted_and_executed_returns_is_named() -> None:
    legend = figures.predicted_vs_true(returns()).legends[0]
    assert [text.get_text() for text in legend.get_texts()] == [
        "one target of one training seed",
        "executed as predicted",
        "gap",
    ]


def test_figure6_names_the_marks_it_draws() -> None:
    figure = figures.figure6({"reach": {PLANNED: returns()["reach"][PLANNED]}})
    marks = {
        text.get_text(): handle.get_marker()
        for text, handle in zip(
            figure.legends[0].get_texts(), figure.legends[0].legend_handles, strict=True
        )
    }
    drawn = {bar.lines[0].get_marker() for bar in figure.axes[0].containers}
    assert {marks["search space: latent"], marks["search space: direct"]} == drawn


def test_figure6_pairs_targets_with_the_oracle_and_says_what_lies_far_off() -> None:
    hard = 3 * noise(12) - 5
    rows = {
        ORACLES[0]: hard,
        PLANNED: hard - 0.5,
        method("lstm", "latent", "cem"): hard - 0.6,
        ZERO: hard - 20,
    }
    cost, _ = figures.figure6(
        {"push": {one: {"true": true, "predicted": true} for one, true in rows.items()}}
    ).axes
    for bar in cost.containers:  # all targets are missed by the same, however different they are
        assert np.ptp(bar.lines[2][0].get_segments()[0][:, 0]) == pytest.approx(0, abs=1e-9)
    assert "outside: zero torque" in cost.get_xlabel()
    assert cost.get_xlim()[1] < 10
    assert [label.get_text() for label in cost.get_yticklabels()] == [
        "",
        "",
    ]  # latent, by CEM, all of them


def test_the_gap_along_the_way_is_the_last_one() -> None:
    (ax,) = figures.along_the_way(steps()).axes
    assert [text.get_text() for text in ax.texts] == ["gap +1.00"]
    np.testing.assert_array_equal(ax.lines[1].get_ydata(), [-5, -4.75, -4])


def test_a_share_of_targets_reached_is_a_count() -> None:
    (ax,) = figures.final_distances(
        {"push": {TSM: {"closed": np.array([0.02, 0.01, 0.2, 0.04])}}}, 0.03
    ).axes
    line = ax.lines[0]
    np.testing.assert_allclose(line.get_xdata(), [0, 1, 2, 4, 20])  # cm
    np.testing.assert_allclose(line.get_ydata(), [0, 25, 50, 75, 100])
    assert ax.lines[1].get_xdata()[0] == 3


def test_whatever_is_drawn_beside_a_path_has_an_entry_in_the_legend() -> None:
    texts = EVERY["plan_paths"]().legends[0].get_texts()
    assert [text.get_text() for text in texts[2:]] == ["path to follow", "zone to keep away from"]


def test_the_interval_of_five_values_is_the_one_in_the_tables() -> None:
    mean, half = statistics.interval(np.arange(5.0))
    assert mean == 2
    assert half == pytest.approx(2.776445 * np.std(np.arange(5), ddof=1) / 5**0.5)
    wide = statistics.interval(np.arange(100.0))[1]
    assert wide == pytest.approx(1.98422 * np.std(np.arange(100), ddof=1) / 10, rel=1e-4)


def test_a_rollout_is_drawn_over_the_truth() -> None:
    true, predicted = noise(15, 6), noise(4, 15, 6)
    axes = figures.rollout_panels(true, predicted, NAMES, UNITS, TSM).axes
    assert len(axes) == 7
    np.testing.assert_array_equal(axes[4].lines[-1].get_ydata(), true[:, 4])
    np.testing.assert_array_equal(axes[4].lines[2].get_ydata(), predicted[2, :, 4])
    assert len(axes[6].lines) == 4 + 2  # the tip's four samples, its true path and its start


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            lambda: figures.torque_gallery(noise(3, 20), 0.02),
            r"actions has shape \(3, 20\), expected \(n, T, 2\)",
        ),
        (
            lambda: figures.rollout_panels(noise(15, 6), noise(4, 14, 6), NAMES, UNITS, TSM),
            r"expected \(S, 15, 6\)",
        ),
        (lambda: figures.state_histograms(noise(5, 4), NAMES, UNITS), r"expected \(n, 6\)"),
        (lambda: figures.figure4({}), "equally many environments of each simulator, got none"),
        (
            lambda: figures.figure4({"MuJoCo": {"Push": PICTURE}, "pymunk": {}}),
            "got 1 of MuJoCo, 0 of pymunk",
        ),
        (lambda: figures.figure4({"MuJoCo": {"Push": PICTURE / 255}}), "MuJoCo, Push is float64"),
        (
            lambda: figures.figure6({"reach": {TSM: {"true": np.array([1, np.nan])}}}),
            "TSM: executed returns: 1 of 2",
        ),
        (
            lambda: figures.figure6({"reach": {TSM: {"true": noise(3), "predicted": noise(2)}}}),
            r"\(2,\), expected \(3",
        ),
        (lambda: figures.figure6({}), "nothing to draw"),
        (
            lambda: figures.predicted_vs_true({"reach": {ZERO: {"true": noise(3)}}}),
            "no method has predicted",
        ),
        (lambda: figures.along_the_way({}), "nothing to draw"),
        (
            lambda: figures.along_the_way({TSM: {**steps()[PLANNED], "true": noise(2)}}),
            r"expected \(3\)",
        ),
        (lambda: figures.final_distances({}, 0.03), "nothing to draw"),
        (
            lambda: figures.final_distances({"push": {TSM: {"shut": noise(3)}}}, 0.03),
            "'shut', expected open or",
        ),
        (
            lambda: figures.plan_paths(noise(2, 9, 2), noise(3, 9, 2), TSM),
            "predicted holds 2 paths and executed 3",
        ),
        (lambda: figures.loss_curves({TSM: {"train": noise(3)}}), "expected 'seconds' or 'step'"),
        (
            lambda: figures.plan_strip(draw, {TSM: (noise(9, 6), noise(9, 6))}, np.zeros(2), [9]),
            "between 0 and 8",
        ),
        (
            lambda: figures.plan_strip(draw, {TSM: (noise(9, 6), noise(8, 6))}, np.zeros(2), [0]),
            "executed states of TSM",
        ),
        (lambda: figures.plan_strip(draw, {}, np.zeros(2), [0]), "nothing to draw"),
        (lambda: figures.side_by_side({}), "no film"),
        (
            lambda: figures.side_by_side({"low": film(4, 6), "high": film(5, 6)}),
            "low 4, high 5; render all at one height",
        ),
        (lambda: figures.stacked(film(4, 6), film(4, 8)), "above is 6 pixels wide and below 8"),
        (lambda: figures.save_video(noise(2, 4, 4, 3), "a.mp4"), "expected uint8"),
        (lambda: figures.save_video(np.zeros((2, 4, 4, 3), np.uint8), "a.avi"), "must end in .mp4"),
    ],
)
def test_a_wrong_input_is_named(wrong, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        wrong()
    assert plt.get_fignums() == []


def test_a_film_has_even_sides_and_waits_for_the_longer_half(tmp_path) -> None:
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    left, right = np.zeros((3, 65, 63, 3), np.uint8), np.full((5, 65, 64, 3), 200, np.uint8)
    both = figures.side_by_side({"model": left, "simulator": right})
    assert both.shape[0] == 5
    assert both.shape[2] == 127
    np.testing.assert_array_equal(both[4, -65:, :63], left[2])
    tall = figures.stacked(both[:2], both)
    np.testing.assert_array_equal(tall[4], np.concatenate([both[1], both[4]]))
    first, second = (
        figures.save_video(both, tmp_path / "a.mp4"),
        figures.save_video(both, tmp_path / "b.mp4"),
    )
    assert first.read_bytes() == second.read_bytes()
    frames = np.stack(imageio.mimread(first))
    assert frames.shape == (5, both.shape[1] + both.shape[1] % 2, 128, 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mp4", "b.mp4"]


@pytest.mark.parametrize("suffix", ["png", "gif", "webp"])
def test_a_film_is_a_picture_that_moves_and_repeats(tmp_path, suffix: str) -> None:
    frames = np.zeros((4, 20, 30, 3), np.uint8)
    for step in range(4):
        frames[step, :, 5 * step : 5 * step + 5] = (0, 114, 178)
    with Image.open(figures.save_video(frames, tmp_path / f"a.{suffix}", fps=20)) as picture:
        assert picture.n_frames == 4
        assert picture.info["loop"] == 0
        picture.seek(2)
        picture.load()
        assert picture.info["duration"] == 50
        shown = np.asarray(picture.convert("RGB")).astype(int)
    assert np.abs(shown[10, 12] - (0, 114, 178)).max() < 20
    assert shown[10, 25].max() < 20


def test_a_notebook_shows_a_film_without_trusting_its_maker(tmp_path) -> None:
    """JupyterLab shows markup of a notebook that it does not trust without the sources in it, and pictures as ever."""
    pytest.importorskip("imageio_ffmpeg")
    frames = np.random.default_rng(0).integers(0, 255, (3, 40, 60, 3)).astype(np.uint8)
    for film in (frames, figures.save_video(frames, tmp_path / "a.mp4")):
        data, _ = DisplayFormatter().format(figures.embed(film))
        assert set(data) == {"image/png", "text/plain"}
        with Image.open(BytesIO(base64.b64decode(data["image/png"]))) as picture:
            assert picture.n_frames == 3


def test_a_film_takes_kilobytes_of_a_notebook_for_each_of_its_frames() -> None:
    frames = np.full((20, 514, 960, 3), 240, np.uint8)
    x, y = np.meshgrid(np.arange(960), np.arange(514))
    for step in range(20):  # two balls with soft shades, as a renderer draws them
        for x0 in (200, 700):
            off = np.hypot(x - x0 - step, y - 250 - 2 * step)
            frames[step][off < 60] = (
                255 * (1 - 0.5 * off[off < 60, None] / 60) * (0.9, 0.6, 0)
            ).astype(np.uint8)
    assert len(figures.embed(frames).data) < 20 * 15_000


def test_a_film_that_is_not_there_says_how_to_make_it(tmp_path) -> None:
    with pytest.raises(FileNotFoundError, match=r"figures\.save_video"):
        figures.embed(tmp_path / "none.mp4")


@pytest.mark.parametrize("words", [1, 12])
def test_a_legend_is_never_wider_than_its_figure(words: int) -> None:
    with plt.style.context(style.STYLE):
        figure = plt.figure(figsize=(5, 3), layout="constrained")
        handles = [
            style.entry(" ".join(["label"] * (words if i == 7 else 1)), color="k") for i in range(8)
        ]
        rows = style.legend(figure, handles, columns=4)
        figure.canvas.draw()
    plt.close(figure)
    (drawn,) = figure.legends
    box = drawn.get_window_extent()
    assert box.x0 >= 0
    assert box.x1 <= figure.bbox.width
    assert (rows == 2) == (words == 1)
