"""Methods and their looks: the keys of every figure and table of methods. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass, field

SEARCH_SPACES = ("latent", "direct")  # Eq. 3 and Eq. 2
Marker = str | tuple[int, int, float]  # matplotlib's: a letter, or corners, kind and angle
PLANNERS = {"adam": "Adam", "adam+starts": "Adam from samples", "cem": "CEM", "mppi": "MPPI"}


@dataclass(frozen=True)
class Look:
    """The name of a model as the reader meets it, and its colour and marker in every figure.

    marker: matplotlib's; no diamond, which is the reader's own (``axes.YOURS``).
    """

    name: str
    colour: str
    marker: Marker = "o"


@dataclass(frozen=True)
class Method:
    """A model and the way it was used: the key of every mapping of methods.

    search_space: latent or direct; variant: what else distinguishes two uses of a model.
    Methods are compared without their look.
    """

    model: str
    search_space: str = ""
    planner: str = ""
    variant: str = ""
    look: Look = field(compare=False, repr=False, kw_only=True)

    @property
    def how(self) -> tuple[str, ...]:
        """Search space, planner and variant in words, those that are set."""
        return tuple(
            filter(
                None, (self.search_space, PLANNERS.get(self.planner, self.planner), self.variant)
            )
        )

    @property
    def label(self) -> str:
        """The method in one line: ``TSM, latent, CEM``."""
        return ", ".join((self.look.name, *self.how))
