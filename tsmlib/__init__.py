"""Temporal segment models: learn a distribution over segments of the future, and plan through it.

A dynamics model maps a past segment of states and actions, and the actions planned next, to the
states that follow (Mishra, Abbeel and Mordatch, "Prediction and Control with Temporal Segment
Models", ICML 2017). A one-step model is a segment model of length one. ``__init__.pyi`` lists what
is here; a file is imported when a name of it is first used. ``import tsmlib`` registers the
environments with Gymnasium, whose version 1.4 loads no plugins by entry point.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

from tsmlib import envs as envs  # noqa: E402 - registers the environments; loads no simulator and no torch
