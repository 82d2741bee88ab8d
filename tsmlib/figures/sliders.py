"""A picture under sliders, for a notebook with a kernel behind it."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

if TYPE_CHECKING:
    from ipywidgets import VBox


def slider_panel(draw: Callable[..., Figure], **ranges: tuple[float, float, float]) -> VBox:
    """Sliders, name=(lowest, highest, step), above the picture ``draw(name=value, ...)``, which follows them.

    They start at zero, or as near to it as they go. The picture is an image: ``ipywidgets.interact`` captures output
    instead, for which the client that executes a notebook writes to the kernel while it awaits the kernel's answer, and
    an answer that comes just then can be missed: a run once waited forever.
    """
    from ipywidgets import FloatSlider, Image, VBox

    sliders = {
        name: FloatSlider(min(max(0.0, low), high), min=low, max=high, step=step, description=name)
        for name, (low, high, step) in ranges.items()
    }
    picture = Image(format="png")

    def turn(_: object = None) -> None:
        drawn = BytesIO()
        draw(**{name: slider.value for name, slider in sliders.items()}).savefig(drawn, format="png")
        picture.value = drawn.getvalue()

    for slider in sliders.values():
        slider.observe(turn, "value")
    turn()
    return VBox([*sliders.values(), picture])
