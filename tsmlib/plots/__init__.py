"""Figures: panels in, a matplotlib figure out.

Every figure function takes a mapping from the title of a panel to what the panel shows: a mapping
from a word to an array. The word is the key of a model in ``tsmlib.zoo``, which gives its name and
its hue in every figure, or any label. A figure is returned and never left open in pyplot: as the
last line of a notebook cell it shows once, and ``save`` writes it.

Letters in shapes: n lines, S samples, T steps, dx state size, H and W pixels.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
