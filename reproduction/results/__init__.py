"""Rows of each notebook, and tables and panels made of them; a file is imported when it is first used."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    [
        "action_prior",
        "exploration",
        "latent",
        "planning",
        "policies",
        "prediction",
        "robots",
        "robustness",
        "table",
    ],
)
