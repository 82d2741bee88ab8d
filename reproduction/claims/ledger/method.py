"""Claims of sections 3 to 5.2."""
# fmt: off
# isort: off

from reproduction.claims.claim import DEPENDENT, FAILED, REPLICATED, Claim
from reproduction.claims.query import (
    ADAM, ARMS, DELAY, LAP, LIKELIHOODS, LSTM, MULTI_STEP, ONE_STEP, PUSH, REACHER, TASKS, TSM, VARIANCE, Check,
    Checks, Model, Number, Query, between, constant, log,
)
from reproduction.claims.shown import (
    ACTION_PRIOR, CAUSES, CHANGES, DATA, FIGURE6, FIGURE7, HORIZON, ITERATIONS, PROBLEM, ROBUSTNESS, WORKSPACE,
)

SPREAD = ("It is the protocol, by which a model with samples states a variance for every step and the one-step model "
          "one for everything; by one shared variance they are much closer.")


@Claim("C09", "section 3", CHANGES, readings=LIKELIHOODS,
       quote="Empirically, we observe that having the encoder model ... instead of ... gives equivalent performance",
       statistic="log-likelihood, full encoder minus ours, against a tenth of the lead over the one-step model")
def c09(q: Query) -> Checks:
    """An encoder that sees the future states alone is as good as one that sees everything."""
    lead, change = _lead(q), q.ablation(Model("tsm+full")) - q.ablation(TSM)
    yield (lead > 0).assumed()
    yield from between(-0.1 * lead, change, 0.1 * lead)

@Claim("C10", "section 3.1", CHANGES, readings=LIKELIHOODS,
       quote="residual layers and skip connections between layers give slightly better performance but are not "
             "essential",
       statistic="log-likelihood with them minus without, against a quarter of the lead over the one-step model",
       why={DEPENDENT: "By the paper's likelihood they bring less than a tenth of the lead, by one shared variance "
                       "more than all of it. The variant without them has TSM's learning rate."})
def c10(q: Query) -> Checks:
    """Residual and skip connections help a little and are not essential."""
    lead, change = _lead(q), q.ablation(TSM) - q.ablation(Model("tsm+plain"))
    yield (lead > 0).assumed()
    yield change > 0
    yield change <= 0.25 * lead

@Claim("C11", "section 3", ROBUSTNESS,
       quote="We introduce dependency on past actions ... to support dynamics with delayed or filtered actions.",
       statistic="log-likelihood with delay: TSM minus the same with zeros for past actions")
def c11(q: Query) -> Checks:
    """Seeing past actions is what makes delayed actions predictable."""
    yield q.ll(TSM, DELAY) - q.ll(TSM, DELAY, subset="past actions zero") > 0

@Claim("C12", "section 4.2", CAUSES, readings=ADAM,
       quote="the optimization may find actions that achieve high rewards under the model (by exploiting it in a "
             "regime where it is invalid)",
       statistic="predicted minus true return, distance to the training torques, power above 5 Hz: raw actions minus "
                 "codes",
       why={FAILED: "Plans over raw actions are further from the training torques. The check that fails is the power "
                    "above 5 Hz at pushing, of which this sentence of the paper says nothing (C52 does)."})
def c12(q: Query) -> Checks:
    """Plans over raw actions exploit the model with actions unlike its data."""
    for task in TASKS:
        yield q.gap(TSM, task).mean() - q.gap(LAP, task).mean() > 0
        for metric in ("torque_novelty", "torque_fast"):
            yield q.plans(metric, TSM, task, trials=False) - q.plans(metric, LAP, task, trials=False) > 0

@Claim("C13", "section 4.2", ACTION_PRIOR,
       quote="the gradients of the rewards with respect to the latent codes are likely to have stronger signal than "
             "those with respect to a single action",
       statistic="logarithm of the signal-to-noise ratio of gradients over model samples: codes minus actions")
def c13(q: Query) -> Checks:
    """Gradients with respect to codes carry a stronger signal than those with respect to actions."""
    for task in TASKS:
        codes, actions = (q.torques("gradient_snr", model, task, planner="adam", trials=True) for model in (LAP, TSM))
        yield log(codes).mean() - log(actions).mean() > 0

@Claim("C14", "section 4.2", PROBLEM,
       quote="we are optimizing over fewer variables",
       statistic="8 codes for each of K segments against 2 torques for each of T = 10 K steps, T = 50 and 100",
       definition="It is arithmetic: 8 K < 20 K.")
def c14(_: Query) -> Checks:
    """Codes are fewer numbers to optimise than actions."""
    for segments in (5, 10):
        yield constant(2 * 10 * segments, "torques of a plan") > 8 * segments

@Claim("C15", "section 4.2", ITERATIONS,
       quote="We used Adam ... with step size 0.01 to perform this optimization and found that it generally converged "
             "in around 100 iterations.",
       statistic="iterations to 95 % of the gain at 500 iterations: share of targets within 100 and within 150",
       why={FAILED: "On reaching no target gets there within 150 iterations, since from codes of zero a hundred steps "
                    "of 0.01 do not get far."})
def c15(q: Query) -> Checks:
    """Adam with step 0.01 converges in about 100 iterations."""
    for task in TASKS:
        iterations = q.plans("iterations_to_95", LAP, task, planner="adam")
        yield (iterations <= 100).share() > 0.5
        yield (iterations <= 150).share() > 0.75

@Claim("C16", "section 4.3", FIGURE7,
       quote="The resulting policy will learn to accomplish the task while only considering actions for which the "
             "dynamics model is valid.",
       statistic="share of executed steps within the training torques' 95 % range; size of the gap against a one-step "
                 "policy")
def c16(q: Query) -> Checks:
    """A policy that acts through the prior stays where the model is valid."""
    for task in TASKS:
        yield q.policy("within_data", LAP, task).mean() >= 0.9
        lap, tsm = (abs(q.policy("exploitation_gap", model, task)).mean() for model in (LAP, TSM))
        yield lap - tsm < 0

@Claim("C17", "sections 5.1 and 6", WORKSPACE, picture=True,
       quote="correlated random actions resulted in sufficient exploration for the tasks we considered",
       statistic="share of the cells of a 20 x 20 grid over the workspace that data visit; share of episodes with "
                 "contact",
       why={REPLICATED: "How strong and how smooth the torques are was chosen here so that they do (A15)."})
def c17(q: Query) -> Checks:
    """Smooth random torques explore enough."""
    yield q.data("cells_visited", REACHER) >= 0.9
    yield q.data("contact_share", PUSH) >= 0.1

@Claim("C18", "section 5.1", CHANGES, readings=LIKELIHOODS,
       quote="As the segment length approaches 1, the model degenerates into a one-step model",
       statistic="log-likelihood, H = 1 minus the one-step model, against a tenth of the lead of H = 10",
       why={FAILED: SPREAD})
def c18(q: Query) -> Checks:
    """With segments of one step it is a one-step model."""
    lead, apart = _lead(q), q.ablation(Model("tsm+h1")) - q.ablation(ONE_STEP)
    yield (lead > 0).assumed()
    yield from between(-0.1 * lead, apart, 0.1 * lead)

@Claim("C19", "section 5.1", CHANGES, readings=LIKELIHOODS,
       quote="for longer segments, its performance plateaus",
       statistic="log-likelihood, H = 20 minus H = 10, against a tenth of what H = 10 has over H = 1")
def c19(q: Query) -> Checks:
    """Segments longer than ten steps bring little."""
    tsm = q.ablation(TSM)
    lead = tsm - q.ablation(Model("tsm+h1"))
    yield (lead > 0).assumed()
    yield q.ablation(Model("tsm+h20")) - tsm < 0.1 * lead

@Claim("C20", "section 5.1", DATA,
       quote="the states towards the end of the segment become independent of those at the beginning",
       statistic="autocorrelation of the joint velocities at 20 steps",
       why={FAILED: "Torques are smooth and joints have little friction, so that speeds last longer than a segment."})
def c20(q: Query) -> Checks:
    """The end of a long segment hardly depends on its beginning."""
    for task in TASKS:
        yield from between(-0.2, q.data("velocity_autocorrelation", task, lag=20), 0.2)

@Claim("C21", "section 5.1", CHANGES, readings=LIKELIHOODS,
       quote="this latent-space dimensionality was a good trade-off between expressiveness and information density",
       statistic="log-likelihood, 8 dimensions minus 4, and 16 minus 8")
def c21(q: Query) -> Checks:
    """Eight latent dimensions are a good trade-off."""
    yield q.ablation(TSM) - q.ablation(Model("tsm+z4")) >= 0
    yield Check(q.ablation(Model("tsm+z16")) - q.ablation(TSM), "==", 0)

@Claim("C22", "section 5.2", HORIZON, readings=VARIANCE,
       quote="we expect it to be more robust to the accumulation of small errors",
       statistic="log-likelihood at 10, 20, 50 and 90 steps, multi-step minus one-step")
def c22(q: Query) -> Checks:
    """Training over several steps makes a one-step model more robust."""
    for arm in ARMS:
        for h in (10, 20, 50, 90):
            yield q.ll(MULTI_STEP, arm, step=h) - q.ll(ONE_STEP, arm, step=h) > 0

@Claim("C23", "section 5.2", FIGURE6, readings=ADAM,
       quote="We expect that the LSTM can learn fairly complex dynamics, but the hidden state dependencies can make "
             "trajectory and policy optimization more difficult.",
       statistic="log-likelihood, LSTM minus one-step; executed return of plans over raw actions, TSM minus LSTM")
def c23(q: Query) -> Checks:
    """An LSTM learns the dynamics and is harder to optimise through."""
    for task in TASKS:
        yield q.ll(LSTM, task) - q.ll(ONE_STEP, task) > 0
        yield q.executed(TSM, task) - q.executed(LSTM, task) > 0


def _lead(q: Query) -> Number:
    """What TSM of the ablations is ahead of the one-step model by."""
    return q.ablation(TSM) - q.ablation(ONE_STEP)
