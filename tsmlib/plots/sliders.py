"""A picture under sliders, for a notebook with a kernel behind it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image as Picture

if TYPE_CHECKING:
    from ipywidgets import VBox


def slider_panel(
    draw: Callable[..., Figure], ranges: Mapping[str, tuple[float, float, float]]
) -> VBox:
    """Sliders, name -> (lowest, highest, step), above the picture ``draw(value, ...)``, which follows them.

    They start at zero, or as near to it as they go, and are as wide as the picture, which keeps its size: with two of
    them and 5 inches at 100 dots both are seen at once on a small screen. Of a figure that ``draw`` returns again, only
    the animated artists are drawn anew, over all others. The picture is an image:
    ``ipywidgets.interact`` captures output instead, for which the client that executes a notebook writes to the kernel
    while it awaits the kernel's answer, and an answer that comes just then can be missed: a run once waited forever.
    """
    from ipywidgets import FloatSlider, Image, Layout, VBox

    sliders = [
        FloatSlider(
            min(max(0.0, low), high),
            min=low,
            max=high,
            step=step,
            description=name,
            style={"description_width": "max-content"},
        )
        for name, (low, high, step) in ranges.items()
    ]
    picture, canvas = Image(format="png"), _Canvas()

    def turn(_: object = None) -> None:
        dots = canvas.dots(draw(*(slider.value for slider in sliders)))
        drawn = BytesIO()
        Picture.fromarray(dots).save(drawn, "png", compress_level=1)  # fast, not small
        picture.width, picture.value = dots.shape[1], drawn.getvalue()

    for slider in sliders:
        slider.observe(turn, "value")
    turn()
    wide = Layout(width=f"{picture.width}px", max_width="100%")
    for slider in sliders:
        slider.layout = wide
    return VBox([*sliders, picture], layout=Layout(align_items="flex-start"))


class _Canvas:
    """Dots of figures; what stays of the last one is kept."""

    def __init__(self) -> None:
        self._figure: Figure | None = None

    def dots(self, figure: Figure) -> np.ndarray:
        """The figure (height, width, 3), uint8."""
        moving = sorted(
            figure.findobj(lambda artist: artist.get_animated()),
            key=lambda artist: artist.get_zorder(),
        )
        if figure is not self._figure or not moving:
            self._figure, self._canvas = figure, FigureCanvasAgg(figure)
            self._canvas.draw()  # without what is animated
            self._still = self._canvas.copy_from_bbox(figure.bbox)
        self._canvas.restore_region(self._still)
        for artist in moving:
            figure.draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba())[..., :3]
