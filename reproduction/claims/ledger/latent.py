"""Claims of sections 5.3.4 and 5.3.5: codes and the action prior (figures 9 and 10)."""
# fmt: off
# isort: off

from reproduction.claims.claim import FAILED, REPLICATED, Claim
from reproduction.claims.query import (
    ADAM, BASELINES, LAP, NOISE, PUSH, REACHER, TASKS, TSM, Checks, Model, Query, between, correlation,
)
from reproduction.claims.shown import CODES_USED, FIGURE10, FIGURE6, FIGURE9, SPREAD, WALK

@Claim("C45", "section 5.3.4", SPREAD,
       quote="our model does learn a meaningful latent space: one that encodes uncertainty about the future.",
       statistic="reconstruction error with the encoder's code minus with a random one; rank correlation of spread and "
                 "error")
def c45(q: Query) -> Checks:
    """Codes have a meaning: they hold what is uncertain about the future."""
    yield q.latent("error_posterior", PUSH) - q.latent("error_prior", PUSH) < 0
    yield q.latent("spearman", PUSH) >= 0.3

@Claim("C46", "section 5.3.4", CODES_USED, headline=True,
       quote="When the dynamics are simple and deterministic ... the model does express certainty by ignoring the "
             "latent code.",
       statistic="plain arm: KL per segment in nats, active units, spread of samples over that of the data",
       why={REPLICATED: "Codes are ignored with the obstacle too (KL, active units), where the paper would have "
                        "them used."})
def c46(q: Query) -> Checks:
    """Where dynamics are simple and certain, codes are ignored."""
    yield q.latent("kl", REACHER) <= 0.1
    yield q.latent("active_units", REACHER) <= 0
    yield q.latent("spread", REACHER) <= 0.01

@Claim("C47", "section 5.3.4", CODES_USED,
       quote="With stochasticity ... it provides a spread of reasonable state trajectories.",
       statistic="spread of samples with noise minus without; coverage of the 80 % interval",
       why={FAILED: "Squared error and KL leave noise out of the codes, so that samples spread little. The energy "
                    "score puts it there."})
def c47(q: Query) -> Checks:
    """Where the world is noisy, samples spread reasonably."""
    yield q.latent("spread", NOISE) - q.latent("spread", REACHER) > 0
    yield from between(0.75, q.score("coverage80", TSM, NOISE), 0.85)

@Claim("C48", "section 5.3.4", CODES_USED, headline=True,
       quote="when the dynamics are deterministic but complex, the model also uses the latent codes to express "
             "uncertainty. This can occur ... immediately following a collision",
       statistic="KL on pushing minus the plain arm; spread after contact over that before, at the same steps",
       why={REPLICATED: "It holds at pushing, for segments after a touch. Over all segments of pushing the KL is below "
                        "what C46 calls ignored, and with the obstacle codes are ignored."})
def c48(q: Query) -> Checks:
    """Where dynamics are certain but complex, codes are used, above all after collisions."""
    yield q.latent("kl", PUSH) - q.latent("kl", REACHER) > 0
    yield q.latent("spread_ratio", PUSH) >= 2

@Claim("C49", "section 5.3.4", WALK,
       quote="A particular latent code corresponds to a particular future within the space of possible ones",
       statistic="variance over repeated predictions with one code held fixed",
       definition="The decoder is a function of the code, so that one code decodes to one future in every "
                  "implementation.")
def c49(q: Query) -> Checks:
    """One code is one future."""
    yield q.latent("fixed_code_variance", PUSH) <= 0

@Claim("C50", "figure 9", FIGURE9, picture=True,
       quote="It correctly predicts collisions between arm and object, and between object and wall, but expresses some "
             "uncertainty in the deflection angles and how far the object travels",
       statistic="recall within two steps of contacts with object and wall; coverage of the 80 % interval of "
                 "deflection angles",
       why={FAILED: "Contacts are foretold as often as asked. But samples lie too close together: 80 % intervals of "
                    "the deflection hold a good third of the truths."})
def c50(q: Query) -> Checks:
    """It foresees collisions of arm, object and wall, and is unsure of angles and distances after them."""
    yield q.latent("recall", PUSH, subset="object") >= 0.8
    yield q.latent("recall", PUSH, subset="wall") >= 0.7
    yield from between(0.75, q.latent("deflection_coverage80", PUSH, subset="first touch"), 0.85)

@Claim("C51", "section 5.3.5, figure 10", FIGURE10, headline=True, picture=True, readings=ADAM,
       quote="when we use an action prior, solutions from trajectory optimization look similar.",
       statistic="area under the curve of a classifier that tells them from held-out training torques",
       why={FAILED: "The classifier also tells apart random draws of the prior and training torques rebuilt "
                    "through it: it recognises this prior's decoder, so that no plan through this prior would pass."})
def c51(q: Query) -> Checks:
    """Planned through the prior, torques look like training data."""
    for task in TASKS:
        yield q.torques("auc", LAP, task) <= 0.65

@Claim("C52", "section 5.3.5, figure 10", FIGURE10, headline=True, picture=True, readings=ADAM,
       quote="the solutions from optimizing directly over actions, which are sharp and discontinuous, unlike anything "
             "the dynamics model has seen before.",
       statistic="area under the curve of the same classifier; mean change per step over that of the data",
       why={FAILED: "Candidates of the cross-entropy method are as smooth as the data, and Adam begins at zero; from "
                    "strong noise and without a penalty plans are sharp (07_action_prior)."})
def c52(q: Query) -> Checks:
    """Planned directly, torques are sharp and discontinuous."""
    for task in TASKS:
        yield q.torques("auc", TSM, task) >= 0.9
        yield q.torques("change_ratio", TSM, task) >= 3

@Claim("C53", "section 5.3.5", FIGURE6, headline=True, readings=ADAM,
       quote="the discrepancy between the model and the true dynamics is minimized, resulting in higher rewards "
             "achieved in the actual environment.",
       statistic="size of the gap and executed return: with the prior minus without, both tasks")
def c53(q: Query) -> Checks:
    """The prior makes gaps smaller and so returns higher."""
    for task in TASKS:
        yield abs(q.gap(LAP, task)).mean() - abs(q.gap(TSM, task)).mean() < 0
        yield q.executed(LAP, task) - q.executed(TSM, task) > 0

@Claim("C54", "section 5.3.5", FIGURE6, readings=ADAM,
       quote="the baselines perform poorly on the pushing task ... because of large discrepancies between the model "
             "prediction and the true execution.",
       statistic="over targets, correlation of gap and executed return; share of the lead of TSM with prior that the "
                 "prior closes")
def c54(q: Query) -> Checks:
    """Baselines fail at pushing because their predicted returns are wrong."""
    for rival in BASELINES:
        executed = q.plans("return_true", rival, PUSH)
        yield correlation(abs(q.gap(rival, PUSH)), executed) <= -0.3
        with_prior = q.executed(Model(rival.word, "latent"), PUSH)
        yield with_prior - executed.mean() >= 0.5 * (q.executed(LAP, PUSH) - executed.mean())
