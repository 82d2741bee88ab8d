"""Claims of the abstract and section 1."""
# fmt: off
# isort: off

from reproduction.claims.claim import FAILED, INCONCLUSIVE, REPLICATED, Claim
from reproduction.claims.ledger.latent import c51, c53
from reproduction.claims.ledger.method import c12, c16
from reproduction.claims.query import (
    ARMS, BASELINES, DELAY, LIKELIHOODS, MULTI_STEP, NOISE, OBSTACLE, ONE_STEP, PUSH, TSM, Checks, Query, between,
    largest, log, median, smallest,
)
from reproduction.claims.shown import ACTION_PRIOR, CALIBRATION, HORIZON, RANGE, TRAINING

@Claim("C01", "Abstract", RANGE,
       quote="It makes stable and accurate predictions over long horizons for complex, stochastic systems",
       statistic="share of 90-step rollouts that leave the physical range; error at 90 steps over that of predicting "
                 "the mean")
def c01(q: Query) -> Checks:
    """Predictions stay stable over long horizons."""
    for arm in ARMS:
        yield q.score("diverged", TSM, arm) <= 0.01
        yield q.score("nrmse", TSM, arm, step=90) < 1

@Claim("C02", "Abstract, section 1", HORIZON, headline=True, readings=LIKELIHOODS,
       quote="our method makes better predictions over long horizons than one-step models",
       statistic="log-likelihood and error at 20, 50 and 90 steps: TSM minus the better one-step model",
       why={FAILED: "Where its likelihood is ahead, that is the freedom of its variance: by one shared variance it is "
                    "ahead nowhere beyond doubt. The error of its mean is not told from that of the better one-step "
                    "model on the plain arm, and is larger at 20 and 50 steps with the obstacle and at pushing."})
def c02(q: Query) -> Checks:
    """Over long horizons its predictions are better than those of one-step models."""
    for arm in ARMS:
        for h in (20, 50, 90):
            tsm, one, multi = (q.ll(model, arm, step=h) for model in (TSM, ONE_STEP, MULTI_STEP))
            yield tsm - largest(one, multi) > 0
            tsm, one, multi = (q.score("nrmse", model, arm, step=h) for model in (TSM, ONE_STEP, MULTI_STEP))
            yield tsm - smallest(one, multi) < 0

@Claim("C03", "section 1", HORIZON,
       quote="the predictions from a one-step model tend to diverge from the true dynamics, either due to the "
             "accumulation of small errors or deviation from the regime represented by the data",
       statistic="growth of the error from step 1 to step 50, as a logarithm: one-step minus TSM",
       why={REPLICATED: "On pushing and on the plain arm TSM's error grows less mostly because it is larger at the "
                        "first step, not because it is much smaller at step 50."})
def c03(q: Query) -> Checks:
    """One-step models drift away from the truth because their small errors add up."""
    for arm in ARMS:
        one, tsm = (q.score("nrmse", m, arm, step=50) / q.score("nrmse", m, arm, step=1) for m in (ONE_STEP, TSM))
        yield log(one) - log(tsm) > 0

@Claim("C04", "section 1", HORIZON,
       quote="our approach can model both uncertainty and complex interactions (like collisions) holistically over a "
             "segment, even if it makes small errors at individual timesteps",
       statistic="error at ten steps, TSM minus one-step, in the middle one of the three environments")
def c04(q: Query) -> Checks:
    """TSM may err on single steps and still be right about the whole segment."""
    yield median(*(q.score("nrmse", TSM, arm, step=10) - q.score("nrmse", ONE_STEP, arm, step=10) for arm in ARMS)) < 0

@Claim("C05", "Abstract", CALIBRATION,
       quote="effectively expressing uncertainty",
       statistic="coverage of the central 50, 80 and 95 % intervals of its samples; energy score minus each "
                 "baseline's, all with residual noise",
       why={FAILED: "Trained by squared error and KL, its codes say little and its samples lie too close together."})
def c05(q: Query) -> Checks:
    """It tells how uncertain the future is."""
    for arm in (PUSH, NOISE):
        for share, low, high in ((50, 0.45, 0.55), (80, 0.75, 0.85), (95, 0.90, 1.00)):
            yield from between(low, q.score(f"coverage{share}", TSM, arm), high)
        for rival in BASELINES:
            yield q.score("energy_score_noise", TSM, arm) - q.score("energy_score_noise", rival, arm) < 0

@Claim("C06", "Abstract", CALIBRATION, readings=LIKELIHOODS,
       quote="modeling the effects of collisions, sensory noise, and action delays",
       statistic="log-likelihood after contact, with noise and with delay: TSM minus each baseline",
       why={INCONCLUSIVE: "It holds for pushing, noise and delay. After contact with the obstacle the multi-step model "
                          "and the LSTM are level with TSM."})
def c06(q: Query) -> Checks:
    """It models collisions, sensor noise and delayed actions."""
    for arm, subset in ((OBSTACLE, "contact"), (PUSH, "contact"), (NOISE, ""), (DELAY, "")):
        for rival in BASELINES:
            yield q.ll(TSM, arm, subset=subset) - q.ll(rival, arm, subset=subset) > 0

@Claim("C07", "Abstract", TRAINING,
       quote="The learned dynamics model and action prior can be used for end-to-end, fully differentiable trajectory "
             "optimization and model-based policy optimization",
       statistic="largest relative difference between gradients and central differences, in float64")
def c07(q: Query) -> Checks:
    """Model, prior and reward are differentiable from end to end."""
    yield q.gradient_error() <= 1e-5

@Claim("C08", "section 1", ACTION_PRIOR, depends_on=(c12, c16, c51, c53),
       quote="can be used in a variety of control settings while only considering actions from the regime where the "
             "model is valid",
       statistic="everything that C12, C16, C51 and C53 measure",
       why={FAILED: "It rests on other claims, and not all of them hold."})
def c08(_: Query) -> Checks:
    """Control uses only actions for which the model is valid."""
    return iter(())
