"""Figures take arrays, draw each model in one hue, and let no words collide."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import combinations
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from tsmlib import plots, zoo
from tsmlib.plots.style import looks

RANDOM = np.random.default_rng(0)
LINE, LINES = RANDOM.normal(size=20).cumsum(), RANDOM.normal(size=(6, 20)).cumsum(1)
WAY, WAYS = RANDOM.normal(size=(20, 2)).cumsum(0), RANDOM.normal(size=(6, 20, 2)).cumsum(1)
WORDS = ("tsm", "rtsm", "onestep", "multistep", "lstm", "ensemble+mse", "simulator")
ARMS = ("reaching", "around an obstacle", "pushing")
STATES = ("shoulder", "elbow", "tip_x", "tip_y", "block_x", "block_y")
PICTURE = np.zeros((40, 40, 3), np.uint8)
FIGURES: dict[str, Callable[[], Figure]] = {
    "curves": lambda: plots.curves(
        {arm: dict.fromkeys(WORDS, LINES) for arm in ARMS}, x_label="time (s)", y_label="error (cm)"
    ),
    "lines": lambda: plots.curves({"torque": {"rtsm": LINES}}, spread="lines", held=True),
    "fan": lambda: plots.fan(
        {"rtsm": RANDOM.normal(size=(9, 20, 6)), "simulator": RANDOM.normal(size=(20, 6))},
        STATES,
        ("rad", "rad", "m", "m", "m", "m"),
    ),
    "forest": lambda: plots.forest(
        {
            arm: {**dict.fromkeys(WORDS[:3], (-1, 0, 2)), "a longer row of words": (1, 2, 3)}
            for arm in ARMS
        },
        x_label="difference (m)",
        better="right",
    ),
    "paths": lambda: plots.paths(
        {arm: {"rtsm": WAYS, "onestep": WAY, "executed": WAY} for arm in ARMS}, target=(0.1, 0.2)
    ),
    "pictures": lambda: plots.pictures(
        {row: dict.fromkeys(ARMS, PICTURE) for row in ("MuJoCo", "pymunk")}
    ),
    "codes": lambda: plots.codes(
        {"shoulder": LINES, "elbow": LINES, "object": WAYS}, np.arange(6), label="code"
    ),
}
each_figure = pytest.mark.parametrize("draw", FIGURES.values(), ids=FIGURES)


def words(figure: Figure) -> Iterator[tuple[str, Bbox]]:
    """Every text that is drawn, and the place that it takes."""
    drawn: list[Text] = []
    draw = Text.draw

    def recorded(text: Text, renderer: RendererBase) -> None:
        drawn.append(text)
        draw(text, renderer)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Text, "draw", recorded)
        FigureCanvasAgg(figure).draw()
    return ((text.get_text(), text.get_window_extent()) for text in drawn if text.get_text())


@each_figure
def test_a_figure_is_returned_and_nothing_stays_open(draw: Callable[[], Figure]) -> None:
    assert isinstance(draw(), Figure)
    assert not plt.get_fignums()


@each_figure
def test_no_words_overlap_or_leave_the_figure(draw: Callable[[], Figure]) -> None:
    figure = draw()
    placed = list(words(figure))
    for word, box in placed:
        assert box.x0 > -1, word
        assert box.x1 < figure.bbox.x1 + 1, word
    for (one, box), (other, beside) in combinations(placed, 2):
        shared = Bbox.intersection(box, beside)
        assert shared is None or min(shared.width, shared.height) < 2, (one, other)


@each_figure
def test_a_figure_draws_what_it_is_given(
    draw: Callable[[], Figure], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = pixels(draw())
    for name in ("LINES", "WAYS", "RANDOM", "PICTURE"):
        other = np.random.default_rng(1) if name == "RANDOM" else globals()[name] + 3
        monkeypatch.setitem(globals(), name, other)
    if draw is not FIGURES["forest"]:
        assert not np.array_equal(before, pixels(draw()))


def pixels(figure: Figure) -> np.ndarray:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def test_a_model_has_one_name_and_one_hue_in_every_figure() -> None:
    for draw in (FIGURES["curves"], FIGURES["paths"]):
        for line in draw().legends[0].get_lines():
            known = {spec.look.name: spec.look.colour for spec in zoo.ZOO.values()}
            if line.get_label() in known:
                assert to_hex(line.get_color()) == known[line.get_label()].lower()


def test_hues_of_models_are_told_apart() -> None:
    hues = {word: np.array(to_rgb(spec.look.colour)) for word, spec in zoo.ZOO.items()}
    for one, other in combinations(hues, 2):
        apart = np.abs(hues[one] - hues[other]).sum()
        assert apart > (0.25 if {one, other} <= set(WORDS) else 0.02), (one, other)
    names = [spec.look.name for spec in zoo.ZOO.values()]
    assert len(set(names)) == len(names)


def test_two_uses_of_one_model_have_one_hue_and_different_dashes() -> None:
    found = looks({"": {"rtsm, with prior": LINE, "rtsm, without": LINE}})
    (one, dashes), (other, others) = found.values()
    assert one.colour == other.colour
    assert dashes != others
    assert one.name == "recurrent TSM, with prior"


def test_a_band_is_the_mean_and_its_interval() -> None:
    (ax,) = plots.curves({"": {"tsm": LINES}}).axes
    np.testing.assert_allclose(ax.lines[0].get_ydata(), LINES.mean(0))
    low, high = ax.collections[0].get_paths()[0].get_extents().intervaly
    assert low < LINES.mean(0).min()
    assert high > LINES.mean(0).max()


def test_a_row_is_blue_on_the_better_side_and_grey_across_the_reference() -> None:
    rows = {"ahead": (1, 2, 3), "level": (-1, 0, 1), "behind": (-3, -2, -1)}
    (ax,) = plots.forest({"": rows}, better="right").axes
    assert len({line.get_color() for line in ax.lines if len(line.get_xdata()) == 1}) == 3


@pytest.mark.parametrize(
    ("draw", "says"),
    [
        (lambda: plots.curves({}), "nothing to draw"),
        (lambda: plots.curves({"arm": {"tsm": WAYS}}), r"tsm of panel 'arm' .*\(6, 20, 2\)"),
        (lambda: plots.curves({"": {"tsm": LINE}}, x=LINE[1:]), r"x has shape \(19,\)"),
        (lambda: plots.curves({"": {"tsm": LINE / 0}}), "infinite"),
        (lambda: plots.forest({"": {"row": (3, 2, 1)}}), "low, middle and high"),
        (lambda: plots.fan({"tsm": WAY}, STATES, STATES), r"\(T, 6\) or \(S, T, 6\)"),
        (lambda: plots.codes({"": LINES}, [1, 2]), r"\(2, T\)"),
        (lambda: plots.pictures({"row": {"": LINES}}), "uint8"),
        (lambda: plots.save(FIGURES["lines"](), "one.jpeg"), r"\.png, \.svg or \.pdf"),
        (lambda: plots.side_by_side({}), "no film"),
        (lambda: plots.save_video(PICTURE[None], "film.mov"), "must end in"),
        (lambda: plots.embed(PICTURE), r"expected uint8 \(T, H, W, 3\)"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero")
def test_what_cannot_be_drawn_is_refused_by_name(draw: Callable[[], object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        draw()


@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_the_same_figure_has_the_same_bytes(tmp_path: Path, ending: str) -> None:
    one, other = (plots.save(FIGURES["curves"](), tmp_path / f"{k}.{ending}") for k in range(2))
    assert one.read_bytes() == other.read_bytes()


def test_films_stand_side_by_side_and_the_shorter_one_waits(tmp_path: Path) -> None:
    from PIL import Image

    film = np.random.default_rng(0).integers(0, 255, (5, 40, 60, 3)).astype(np.uint8)
    both = plots.side_by_side({"predicted": film, "executed": film[:3]})
    assert both.shape == (5, 60, 120, 3)
    np.testing.assert_array_equal(both[-1, 20:, 60:], film[2])
    assert plots.stacked(film, film[:2]).shape == (5, 80, 60, 3)
    with Image.open(plots.save_video(film, tmp_path / "film.webp")) as picture:
        assert picture.n_frames == 5
    assert plots.embed(film, fps=10).data[:4] == b"\x89PNG"
    pytest.importorskip("imageio_ffmpeg")
    assert plots.save_video(film, tmp_path / "film.mp4").stat().st_size


def test_plots_load_neither_torch_nor_a_simulator() -> None:
    asked = "import sys, tsmlib.plots as p; [getattr(p, n) for n in p.__all__]; "
    asked += "print(*{'torch', 'mujoco', 'pymunk', 'pandas', 'IPython'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
