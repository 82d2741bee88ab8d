"""Figures: arrays in, a matplotlib figure out; one file per subject.

Every function draws in the style of ``tsmlib.mplstyle`` and returns its ``Figure`` with nothing left open in pyplot: as
the last line of a notebook cell it shows once, and ``save`` writes it. ``__init__.pyi`` lists what is here; a file is
imported when a name of it is first used.

Letters in shapes: n episodes, T steps, S samples, dx state size, H and W pixels.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
