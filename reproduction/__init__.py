"""The reproduction: data sets, trained models, plans and scores at a run's scale, made where they are missing.

Anything a notebook asks for is taken from its run's folder, else from what ships under ``data``, else made on the spot
with a progress bar. Only here is it known how much of everything each scale uses. ``__init__.pyi`` lists what is here.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
