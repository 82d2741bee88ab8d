"""A picture under sliders, for a notebook with a kernel behind it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from io import BytesIO
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

if TYPE_CHECKING:
    from ipywidgets import VBox


def slider_panel(draw: Callable[..., Figure], ranges: Mapping[str, tuple[float, float, float]]) -> VBox:
    """Sliders, name -> (lowest, highest, step), above the picture ``draw(value, ...)``, which follows them.

    They start at zero, or as near to it as they go, and are as wide as the picture, which keeps its size: with two of
    them and 5 inches at 100 dots both are seen at once on a small screen. The picture is an image:
    ``ipywidgets.interact`` captures output instead, for which the client that executes a notebook writes to the kernel
    while it awaits the kernel's answer, and an answer that comes just then can be missed: a run once waited forever.
    """
    from ipywidgets import FloatSlider, Image, Layout, VBox

    sliders = [
        FloatSlider(
            min(max(0.0, low), high), min=low, max=high, step=step, description=name,
            style={"description_width": "max-content"},
        )
        for name, (low, high, step) in ranges.items()
    ]  # fmt: skip
    picture = Image(format="png")

    def turn(_: object = None) -> None:
        figure, drawn = draw(*(slider.value for slider in sliders)), BytesIO()
        figure.savefig(drawn, format="png", dpi=figure.dpi, pil_kwargs={"compress_level": 1})  # fast, not small
        picture.width, picture.value = round(figure.get_figwidth() * figure.dpi), drawn.getvalue()

    for slider in sliders:
        slider.observe(turn, "value")
    turn()
    wide = Layout(width=f"{picture.width}px", max_width="100%")
    for slider in sliders:
        slider.layout = wide
    return VBox([*sliders, picture], layout=Layout(align_items="flex-start"))
