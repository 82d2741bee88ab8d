"""The 54 claims of the paper, each a function that yields its checks.

The paper gives no number: every threshold is ours and was set before results existed. One choice came after results:
the planner of claims about plans was Adam, the paper's, and is CEM since rows were there, because Adam has not planned
through every model. No margin moved. Adam is a reading wherever it was primary.
"""

from dataclasses import replace

from tsmlib.study.claims.claim import Claim
from tsmlib.study.claims.ledger import introduction, latent, method, results
from tsmlib.study.zoo import PAPERS

_FOUND = [value for part in (introduction, method, results, latent) for value in vars(part).values()]
LEDGER = sorted({value for value in _FOUND if isinstance(value, Claim)}, key=lambda claim: claim.id)


def claims(subject: str = PAPERS) -> list[Claim]:
    """All claims in order. subject: the model that stands where the paper's own model is meant."""
    return [replace(claim, subject=subject) for claim in LEDGER]
