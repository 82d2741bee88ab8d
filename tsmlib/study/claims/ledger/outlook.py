"""Questions that the paper leaves to future work (section 6), answered by rows of ours. None is a claim of the paper.

    Q1    an iterative procedure, guided by the model's predictions, gathers better data than random actions
    Q2    few-shot learning adapts a dynamics model
    Q3    a segment model adapts better than another model

The margins are zero, and were set when rows of one training seed were there.
"""
# fmt: off
# isort: off

from tsmlib.study.claims.claim import Claim
from tsmlib.study.claims.query import LSTM, TSM, WEAK_MOTORS, PENDULUM, Checks, Query
from tsmlib.study.claims.shown import ADAPTED, ROUNDS

FEW = 2000  # steps: 20 episodes of 100


@Claim("Q1", "section 6, first question", ROUNDS,
       statistic="executed return after four rounds: own plans minus as many random episodes")
def q1(q: Query) -> Checks:
    """Does data that are gathered by planning with the model serve it better than random episodes?"""
    own, random = (q.explored("return_true", TSM, PENDULUM, data, env_steps=2200)
                   for data in ("own plans", "random episodes"))
    yield own > random

@Claim("Q2", "section 6, last question", ADAPTED,
       statistic="energy score after 80 steps: fine-tuned on 20 episodes minus zero-shot, and minus from scratch")
def q2(q: Query) -> Checks:
    """Does a model that is fine-tuned on few episodes predict a changed arm better than it did, or than a new one?"""
    adapted, untouched, new = (
        q.explored("energy_score_noise", TSM, WEAK_MOTORS, training, env_steps=steps, steps_ahead=80)
        for training, steps in (("all", FEW), ("zero-shot", 0), ("scratch", FEW)))
    yield adapted < untouched
    yield adapted < new

@Claim("Q3", "section 6, last question", ADAPTED,
       statistic="energy score after 80 steps, fine-tuned on 20 episodes: the segment model minus the LSTM")
def q3(q: Query) -> Checks:
    """Does a segment model adapt to a changed arm better than an LSTM?"""
    ours, theirs = (q.explored("energy_score_noise", model, WEAK_MOTORS, "all", env_steps=FEW, steps_ahead=80)
                    for model in (TSM, LSTM))
    yield ours < theirs
