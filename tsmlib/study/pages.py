"""What README and the pages of docs/ say of the shipped rows, as Markdown."""

from __future__ import annotations

import re

import pandas as pd

from tsmlib.envs.spec import MUJOCO_IDS
from tsmlib.planning.predictors import JUDGING
from tsmlib.planning.tasks import HORIZON
from tsmlib.storage import tables as tables_storage
from tsmlib.study import adaptation, needed, plans, runs, worlds, zoo
from tsmlib.study.claims import evaluate, ledger
from tsmlib.study.claims import report as claims_report
from tsmlib.study.claims.claim import DEFINITIONAL, VERDICTS
from tsmlib.study.comparison import published
from tsmlib.study.results import adaptation as adaptation_results
from tsmlib.study.results import aims as aims_results
from tsmlib.study.results import exploration as exploration_results
from tsmlib.study.results import planning as planning_results
from tsmlib.study.results import policies as policies_results
from tsmlib.study.results import prediction as prediction_results
from tsmlib.study.results import robots as robots_results
from tsmlib.study.results import table
from tsmlib.study.results.planning import PUSH, REACH
from tsmlib.study.runs import ROOT
from tsmlib.study.zoo import OURS, PAPERS

METRICS = ("ll_paper", "ll_shared", "ll_own", "energy_score_noise", "crps_noise", "nrmse", "coverage80", "diverged")
README_MODELS = (PAPERS, OURS, "onestep", "multistep", "lstm")
BASELINES = [model for model in README_MODELS if model not in (PAPERS, OURS)]
POWER, ENOUGH = ROOT / "benchmarks" / "verdicts" / "checks.csv", 0.95  # of checks, by simulation
README_CLAIMS = ("C02", "C32")  # on predictions and on plans


def shipped_verdicts(subject: str = PAPERS) -> list[evaluate.Verdict]:
    """The verdicts that follow from the tables that ship. subject: the model in place of the paper's own."""
    claims = ledger.claims(subject)
    rows = evaluate.tables(claims)
    return [evaluate.judge(claim, rows) for claim in claims]


def shipped_answers() -> list[evaluate.Verdict]:
    """What the tables that ship say of the questions of the paper's outlook."""
    questions = ledger.questions()
    rows = evaluate.tables(questions)
    return [evaluate.judge(question, rows) for question in questions]


# README --------------------------------------------------------------------------------------------------------------


def readme_results() -> str:
    """Five models by four numbers: on pushing, or on reaching as long as pushing has no rows of the paper's model."""
    predict, control = published("03_predict"), published("05_control")
    pushed = all(len(table.select(rows, env=PUSH, model=PAPERS)) for rows in (predict, control))
    env = PUSH if pushed else REACH
    plans = table.select(planning_results.plans_of(control, env=env, planners=["cem"]), search_space="latent")
    found = {
        "prediction error ↓": prediction_results.values(predict, "nrmse", env=env),
        "energy score ↓": prediction_results.values(predict, "energy_score_noise", env=env),
        "80 % coverage": prediction_results.values(predict, "coverage80", env=env),
        "share of oracle's gain ↑": table.values(table.select(plans, metric="gain_share")),
        "gap (m) ↓": table.values(table.select(plans, metric="gap_absolute")),
    }
    lines, seeds = [], {len(values[model]) for values in found.values() for model in README_MODELS if model in values}
    for model in README_MODELS:
        cells = {title: table.spell(values[model]) if model in values else "-" for title, values in found.items()}
        lines.append({"model": f"`{model}`", **cells})
    episodes, targets = prediction_results.select(predict, "nrmse", env=env)["n"].max(), plans["n"].max()
    narrow = re.sub(r":-+", "---", re.sub(" +", " ", table.markdown(pd.DataFrame(lines))))  # README is to be short
    return f"""{narrow}

*`{env}`; means over {" to ".join(map(str, sorted(seeds)))} training seeds ± half the 95 % t interval.
{episodes:,} test episodes, 90 steps open loop: error over the data's deviation (nRMSE), energy score of 32 samples,
truths in 80 % intervals, of samples or else a fitted Gaussian. {targets} targets, CEM over codes:
share, 1 by the simulator, 0 for doing nothing; gap, mean size of predicted minus executed return.*
{readme_loops(env)}"""


def aims() -> pd.DataFrame:
    """The aims of the study and what the shipped rows say of them."""
    control, free = published("05_control"), policies_results.finished_on_arms(published("model_free"))
    predict = pd.concat([published("03_predict"), published("peers_pets")])
    learned = tables_storage.frame(pd.concat([control, free]))
    return aims_results.aims(tables_storage.frame(predict), control, published("05_control_rows"), learned)


def readme_aims() -> str:
    """The aims that were not reached; of those of exploration, how many."""
    said = aims_results.missed(aims())
    explored = aims_results.of_exploration(published("10_explore"), published("model_free"))["reached"]
    also = (
        f"Of [those of exploration](docs/results.md#exploration-and-adaptation) {(~explored).sum()} of {len(explored)} "
        "are missed or not run, [some of speed](docs/speed.md#what-is-not-reached) too."
    )
    return f"Of the [aims](docs/results.md#aims) of pushing and `{OURS}` {said} {also}" if said else ""


def readme_plans(env: str) -> str:
    """What plans of models with codes cost more than those of the baselines, open loop; empty without rows of both."""
    rows = planning_results.plans_of(published("05_control_rows"), env=env, planners=["cem"])
    costs = {
        way.model: cost for way, cost in planning_results.costs_of(rows).items() if way.search_space == "latent"
    }  # fmt: skip
    there = [model for model in BASELINES if model in costs]
    spell, apart = planning_results.spell_effect, planning_results.paired_differences
    said = [
        f"`{model}` {', '.join(spell(apart(costs[model], costs[each])) for each in there)}"
        for model in (OURS, PAPERS) if there and model in costs
    ]  # fmt: skip
    if not said:
        return ""
    others = ", ".join(f"`{each}`" for each in there)
    return (
        f"Cost of plans (m) minus that of {others}, ± 95 % over targets (over targets and seeds): {'; '.join(said)}. "
    )


def readme_loops(env: str) -> str:
    """What plans cost, how often closed loops bring the object home, and scores beside the baselines'."""
    closed = planning_results.plans_of(published("05_control"), env=env, execution=planning_results.CLOSED)
    hits = table.values(table.select(closed, metric="success"))
    loops = ", ".join(f"`{model}` {found.mean():.0%}" for model, found in hits.items())
    seeds = " to ".join(str(n) for n in sorted({len(found) for found in hits.values()}))
    again = f"Planned again every ten steps ({seeds} training seeds), within 5 cm: {loops}."
    return f"{readme_plans(env)}{again} {readme_scores(env)}".rstrip()


def readme_scores(env: str) -> str:
    """A sentence on energy scores over the best baseline's, 10 and 80 steps ahead; empty without rows of both."""
    rows, said = published("03_predict"), []
    for model in (PAPERS, OURS):
        found = [prediction_results.values(rows, "energy_score_noise", env=env, steps_ahead=h) for h in (10, 80)]
        if not all(model in each and {*BASELINES} <= {*each} for each in found):
            return ""
        ratios = [f"{each[model].mean() / min(each[word].mean() for word in BASELINES):.2f}" for each in found]
        said.append(f"`{model}` {' and '.join(ratios)}")
    return f"Energy score over that of the best of the paper's baselines, 10 and 80 steps ahead: {', '.join(said)}."


def _seeds(rows: pd.DataFrame) -> str:
    """Seeds of rows, in a column or the index, in words: seed 0, or seeds 0, 1."""
    found = [str(seed) for seed in sorted(rows.reset_index()["seed"].dropna().unique())]
    return f"seed{'s' * (len(found) > 1)} {', '.join(found)}"


def readme_claims(papers: list[evaluate.Verdict], ours: list[evaluate.Verdict]) -> str:
    """Three lines: how many claims got which verdict, with the paper's model and with ours, and what carries it."""
    carrying = [verdict for verdict in papers if verdict.claim.headline]
    given = ", ".join(
        f"{len(same)} {word.lower()}"
        + f" ({', '.join(verdict.claim.id for verdict in same)})" * (word in claims_report.DECIDED)
        for word in VERDICTS if (same := [verdict for verdict in carrying if verdict.word == word])
    )  # fmt: skip
    named = [verdict for verdict in papers if verdict.claim.id in README_CLAIMS]
    said = "; ".join(
        f"{verdict.claim.id} ({_clause(verdict.claim.statement)}) is **{verdict.word.lower()}**" for verdict in named
    )
    theirs, instead = (f"{claims_report.counts(each)}. {claims_report.seeds_told(each)}" for each in (papers, ours))
    planned = claims_report.by_papers_planner(papers)
    return f"""**What replicated.** With the paper's model, {theirs}
With `{OURS}` in its place, {instead}
Of the {len(carrying)} main claims, with the paper's model: {given}. So {said}. {planned}"""


def _clause(statement: str) -> str:
    """A sentence as part of another."""
    return statement[0].lower() + statement[1:].rstrip(".")


# Pages of docs/ ------------------------------------------------------------------------------------------------------


def claims_page(papers: list[evaluate.Verdict], ours: list[evaluate.Verdict]) -> str:
    """Every claim with its verdict, the main claims first."""
    pairs = sorted(zip(papers, ours, strict=True), key=lambda pair: not pair[0].claim.headline)
    headlines = sum(verdict.claim.headline for verdict in papers)
    carry, others = (
        claims_report.table([first for first, _ in part], [second for _, second in part], root="../")
        for part in (pairs[:headlines], pairs[headlines:])
    )
    by_definition = ", ".join(verdict.claim.id for verdict in papers if verdict.word == DEFINITIONAL)
    return f"""Written by `python -m tsmlib publish --claims` from the rows in `data/results`.

- The paper's model: {claims_report.counts(papers)}. {claims_report.seeds_told(papers)}
- `{OURS}` in its place: {claims_report.counts(ours)}. {claims_report.seeds_told(ours)}
- {claims_report.by_papers_planner(papers)}
- Not counted, since they hold by definition: {by_definition}.

## How many training seeds each figure and claim rests on

A claim rests on the least number of training seeds that any of its checks has; so are the counts above.

{claims_report.seeds_table(papers)}

With `{OURS}` in the place of the paper's model:

{claims_report.seeds_table(ours)}

{cost_of_a_seed()} {time_of_a_seed(published("05_control"), published("06_robustness"))}

{power_of_ten_seeds(pd.read_csv(POWER))} {without_margin()}

## The {headlines} main claims

What the paper says of long horizons, with its figures 5 to 8 and 10, of codes and of the action prior; chosen together
with the margins.

{carry}

## The others

{others}

## Questions of its outlook

The paper ends on what it leaves to future work (section 6). These questions and their thresholds are ours, asked
of `{OURS}`, and are not counted above. Their margins were set when rows of one training seed were there; what
was made anew when rows were known is in [deviations](deviations.md#rows-of-earlier-models).

{claims_report.answers(shipped_answers(), root="../")}"""


def cost_of_a_seed() -> str:
    """A sentence: how long one seed of the study takes, by what its steps state."""
    hours = dict[str, float]()
    for each in runs.notebooks().values():
        run = runs.resolve(each.stem, scale="paper", seed=1)
        hours |= {f"{job.kind} {job.name}": job.seconds(run) / 3600 for job in needed.needs(run)}
    spent = pd.Series(hours).groupby(lambda name: name.partition(" ")[0]).sum()
    parts = ", ".join(f"{spent[kind]:.1f} {told}" for kind, told in (
        ("model", "for models"), ("scores", "scores"), ("plan", "plans"), ("policy", "policies"),
    ))  # fmt: skip
    return (
        f"More seeds are more hours: by the estimates of its steps (`study.needs`), without those of 09 and 10, one "
        f"seed takes about {spent.sum():.0f} hours of one core at scale paper: {parts}."
    )


def time_of_a_seed(control: pd.DataFrame, robustness: pd.DataFrame) -> str:
    """A sentence: how long policies and plans of one seed took, by the rows that were timed."""
    clean = robustness["noise"].isna() & robustness["delay"].isna()  # the policies of 05_control again
    learned = table.select(pd.concat([control, robustness[~clean]]), metric="seconds")
    way = ["env", "noise", "delay", "model", "search_space", "planner", "execution"]
    curves = learned.groupby([*way, "seed"], dropna=False)["value"].max()  # seconds of a curve are those until then
    policies = curves.groupby(way, dropna=False).mean()
    plans_ = table.select(control, metric="plan_seconds").groupby(way, dropna=False)["value"].mean()
    seeds = learned["seed"].unique()
    return (
        f"In the rows that ship {len(policies)} policies took {policies.sum() / 3600:.1f} hours (CPU seconds, "
        f"seeds {min(seeds)} to {max(seeds)}) and {len(plans_)} plans {plans_.sum() / 3600:.1f} (by the clock, closed "
        "loops with the plan that they begin with); of scores no seconds are kept."
    )


def power_of_ten_seeds(checks: pd.DataFrame) -> str:
    """How many of the checks in benchmarks/verdicts/checks.csv ten seeds would find, and which they would not."""
    once, seeds = checks.drop_duplicates("check"), sorted(checks["seeds"].unique())
    found = once["power"] >= ENOUGH
    weak = [
        f"{claim} ({', '.join(f'{power:.0%}'.replace('%', ' %') for power in sorted(each['power']))})"
        for claim, each in once[~found].groupby("claim")
    ]  # fmt: skip
    nearest, midway = ((once["why"] == why).sum() for why in ("nearest", "midway"))
    where = f"; for {nearest} that cannot be, as near as can be (a share or AUC of 1, an AUC of 0.5)" * bool(nearest)
    where += f"; for {midway} halves of tests of equivalence, midway between both margins" * bool(midway)
    others = f". The others are found in fewer: {', '.join(weak)}" * bool(weak)
    which = " to ".join(str(count) for count in sorted({seeds[0], seeds[-1]}))
    return (
        f"We simulated ten seeds that differ as those of the rows do, for the {len(once)} checks with {which} training "
        "seeds and a margin that is not zero, checks of several claims counted once "
        "(`benchmarks/verdicts/checks.csv`). The truth was as far beyond the margin as that is from zero"
        f"{where}. Of these {found.sum()} are found in {ENOUGH:.0%} of studies or more{others}."
    ).replace("95%", "95 %")


def without_margin() -> str:
    """A sentence: how many checks have a margin of zero, so that their power is not known."""
    asked = [check for claim in ledger.claims(PAPERS) if not claim.definition for check in claim.checks[""]]
    own = {check.text: check for check in asked if not check.premise}.values()
    zero, equal = (sum(not check.margin and (check.op == "==") is same for check in own) for same in (False, True))
    return (
        f"The power of {zero} others, of {len(own)} checks in all, is not known: their margin is zero, since they ask "
        "which of two is ahead, and name no difference that would have to be found. Nor is that of "
        f"{equal} that asks for a difference of zero."
    )


def full_page(papers: list[evaluate.Verdict], ours: list[evaluate.Verdict]) -> str:
    """Every claim in full, in the order of the paper."""
    return "\n\n".join(
        claims_report.in_full(first, second, root="../") for first, second in zip(papers, ours, strict=True)
    )


def results_page() -> str:
    """Every published table of predictions, plans and policies, from the shipped rows alone."""
    control, by_target, free = published("05_control"), published("05_control_rows"), published("model_free")
    predict = tables_storage.frame(pd.concat([published("03_predict"), published("peers_pets")]))
    learned = tables_storage.frame(pd.concat([control, policies_results.finished_on_arms(free)]))
    seeds = {env: own["seed"].nunique() for env, own in table.groups(predict, "env")}
    scores = "\n\n".join(
        f"`{env}`, {n} training seed{'s' * (n > 1)}{' unless said' * (n > 1)}:\n\n"
        + prediction_results.scores_table(predict, METRICS, env=env)
        for env, n in seeds.items()
    )
    planned = ", ".join(f"{_seeds(planning_results.plans_of(control, env=env))} for {task}" for env, task in
                        ((REACH, "reaching"), (PUSH, "pushing")))  # fmt: skip
    peers = (
        "\n`pets` is the same kind of model as `ensemble`, by mbrl-lib (`benchmarks/peers`), from the episodes as they "
        "were collected: of pushing the others also had them turned and mirrored."
    ) * ("pets" in set(predict["model"]))
    over = {env: prediction_results.over_the_best(predict, OURS, "energy_score_noise", env=env, steps_ahead=(10, 80))
            for env in MUJOCO_IDS}  # fmt: skip
    beside = "\n\n".join(f"`{env}`:\n\n{table.markdown(lines)}" for env, lines in over.items() if len(lines))
    pages = robots_page(published("09_your_own")), exploration_page(published("10_explore"), free)
    later = "\n\n".join(filter(None, pages))
    n = predict[(predict["execution"] == "open loop") & (predict["subset"] == "")]["n"].max()
    there = [word for word in zoo.ZOO if word in set(predict["model"])]
    names = ", ".join(f"{zoo.look(word).name} is `{word}`" for word in there)
    return f"""Written by `python -m tsmlib publish` from `data/results`, scale paper. In tables of plans and in figures
{names}.

## Aims

What was aimed at for pushing and for `{OURS}`, before these rows were there, means over the training seeds of the
tables below. Each is against the model that is hardest to be ahead of, which is named: of plans among the baselines,
which have no codes, of predictions and policies among all others.

{table.markdown(aims())}

{aims_results.gap_told(by_target)}

## Prediction

{n:,} test episodes, 32 samples of each, open loop with the true torques for 90 steps after ten
observed ones; means over steps, in standardised units, with half the 95 % t interval where there are several training
seeds. Higher is better for the likelihoods `ll_`, lower for the others, and `coverage80` should be 0.80. The models
of an environment got as many updates as fit into the same time on one idle core (`study.BUDGET`), all by Muon.{peers}

{scores}

The mean of a log score is decided by the episodes that all samples of a model miss. `ll_own`, mean over 90 steps, of
all episodes, and without the twentieth of them in which each model's own is lowest:

{prediction_results.own_density_table(predict, MUJOCO_IDS)}

Seed by seed: the energy score of `{OURS}` over that of the best other model that has rows (in brackets).

{beside}

## Planning

Training {planned}; frozen targets, T = {HORIZON["reach"]} steps for reaching and {HORIZON["push"]} for
pushing, the cross-entropy method through each model, executed open loop; means over targets, returns in metres summed
over steps. The mode of a model with codes sorts the candidates, and the best quarter is judged by the mean over the
mode and {JUDGING} samples (`expected_predictor`, `cem(screened=)`). Of an ensemble the first member sorts, and the
mean over all members judges. A model without samples has its one rollout.

{planning_results.plans_table(control[control["metric"] != "plan_seconds"])}

Two of those of eight frozen targets from which the object begins at least 0.1 m away (`docs/hero.py`, training seed 0),
over codes, open loop, predicted above executed: the one with the median final distance by `{OURS}`, and the one where
it ends nearest.

![Plans of the recurrent TSM and of the one-step model for the median target](../figures/hero_median.png)

![The same for the target where the recurrent TSM ends nearest](../figures/hero_best.png)

By gradients (Adam, as in the paper, {plans.ITERATIONS["adam"]["paper"]} iterations from zero, judged by the
mode), where there are rows:

{planning_results.plans_table(control[control["metric"] != "plan_seconds"], planner="adam")}

## Pushing, target by target

The cross-entropy method over codes; the cost of `{OURS}` and its size of the gap minus those of each other method on
the same targets, means over the training seeds above; half the 95 % interval is over targets, in brackets over targets
and training seeds (two-way random effects, with one degree of freedom fewer than seeds):

{table.markdown(planning_results.paired_table(by_target, PUSH, OURS))}

## Planning again every ten steps, pushing

{planning_results.loops_table(control)}

Target by target, as above:

{table.markdown(planning_results.paired_table(by_target, PUSH, OURS, execution=planning_results.CLOSED))}

## Policies

Learned inside the models, and model-free ones in the environment; means of the last record
with half the 95 % t interval over training seeds, or over the copies that learned in the models of a single one.
Seconds are of those seeds whose models and policies were not trained and learned together with those of others.

{policies_results.policies_table(policies_results.learning_curves(learned))}

{later}"""


def robots_page(rows: pd.DataFrame) -> str:
    """Scores and plans of the robots of 09_your_own; empty without rows."""
    if not len(rows):
        return ""
    seeds = ", ".join(str(seed) for seed in sorted(rows["seed"].unique()))
    return f"""## Robots of Gymnasium

Written from the rows that `python -m tsmlib run your_own --scale paper` made, training seed {seeds};
`python -m tsmlib publish --table your_own` copies them. Data are smooth random actions, collected by the package:
no data set of Minari's was downloaded, and `load_minari` reads one in their place. Training aimed at the same
CPU time for all models of a robot, at scale paper 24 s, and took what the column says. Energy score and nRMSE are open
loop after ten observed steps, in standardised units, lower is better.

{robots_results.scores_table(rows)}

{robots_results.sentences(rows)}

Plans, closed loop, by the environment's own reward; the oracle is the same planner through the true simulator, from
the first n of the same starts, which may be harder or easier than all. Success is to end upright, within 18 degrees;
the hopper's episodes end where it falls, after the steps that are said:

{robots_results.plans_table(rows)}

Model-free learners as [RL Baselines3 Zoo]({robots_results.SOURCE}) published them, one run each, on version 3 of the
MuJoCo robots and over whole episodes; they were not run here:

{robots_results.model_free_table()}"""


def exploration_page(rows: pd.DataFrame, free: pd.DataFrame | None = None) -> str:
    """Rounds of exploration and adapted models of 10_explore; empty without rows. free: model-free learners, beside."""
    if not len(rows):
        return ""
    seeds = ", ".join(str(seed) for seed in sorted(rows["seed"].unique()))
    every = worlds.world(exploration_results.PENDULUM).sizes["paper"].every
    return f"""## Exploration and adaptation

Written from the rows that `python -m tsmlib run explore --scale paper` or `python
benchmarks/settings/rows.py` made, seeds {seeds}. Plans of the pendulum are made anew every
{every} steps, from n starts that no round trains on; steps count the random episodes before the
first round.
{_exploration_aims(rows, free)}
![Executed return and open-loop gap of the pendulum against environment steps](../figures/10_rounds.png)

Steps are on a logarithmic axis; of learners without a model single seeds are marked at the end.

mbrl-lib's PETS plans the pendulum anew after every step and is trained before every episode, as in its own examples;
the pushing arm, like the others here, every ten steps and once a round (`benchmarks/peers`).

{exploration_results.rounds_table(rows)}
{_steps_of_policies(rows, free, exploration_results.PENDULUM)}
![States of random episodes, of codes of the first prior and of the last, of own plans](../figures/10_visited.png)

States (upright is 0) of a loop of `rtsm`, seed 0, and of codes that its priors draw at random; above, the mean over
episodes of the greatest height, -1 to 1.
{_pushing_rounds(rows, free)}
The id of an arm says what has changed: `gain0.7` has lost 30 % of its torque, of `mass0.5` the object has half its
mass, of `damping2` the joints have twice their damping, and of `links0.12x0.11` the upper link is 20 % longer. n test
episodes, open loop after ten observed steps, in units of the standard arm.
Seeds are of the few episodes and of the updates on them: all begin from one model, as it ships. Rates of fine-tuning
were chosen, those of training from scratch were not.

![Energy scores of models of the weak reaching arm against the episodes that they know](../figures/10_ways.png)

![The share of the zero-shot energy score that twenty episodes leave, arm by arm](../figures/10_arms.png)

Right of the line adapting made a model worse.

![What plans of adapted models return, minus those of the model as it ships, arm by arm](../figures/10_plans.png)

Right of the line plans return more than those of the model as it ships.

{adaptation_results.ways_table(rows)}
{_recovered(rows)}{_adapted_plans(rows)}
{exploration_results.sentences(rows)}
{adaptation_results.sentences(rows)}"""


def _steps_of_policies(rows: pd.DataFrame, free: pd.DataFrame | None, env: str) -> str:
    """The part of that page on model-free learners of an environment; empty without rows of them."""
    if free is None or not (beside := exploration_results.steps_table(rows, free, env)):
        return ""
    return f"""
Environment steps of rounds to the return that a model-free learner ends with, and the learner's own to the return after
the last round, at the first of its 25 records from which it stays there; means over seeds (of the policy / of the
rounds), from the same starts; the fewest of rounds are their random episodes:

{beside}
"""


def _exploration_aims(rows: pd.DataFrame, free: pd.DataFrame | None) -> str:
    """The part of that page on what was aimed at."""
    found = aims_results.of_exploration(rows, tables_storage.frame([]) if free is None else free)
    return f"""
What this study aims at; "not measured" has not been run. Steps to what PPO, TRPO and SAC return at their end count the
random episodes, and are all reached by these alone, so that they say nothing of rounds. On the arm that pushes PETS
returns what no torque does; one setting of it was run, without symmetric copies.

{table.markdown(found)}
"""


def _recovered(rows: pd.DataFrame) -> str:
    """The part of that page on what adaptation recovers; empty without a model trained in full."""
    if not (found := adaptation_results.recovered_table(rows)):
        return ""
    return f"""
The share of its loss that a model recovers from n episodes, (zero-shot - adapted) / (zero-shot - trained in full) of
the energy score at the most steps ahead, paired by seed:

{found}
"""


def _adapted_plans(rows: pd.DataFrame) -> str:
    """The part of that page on what adapted models plan; empty without rows."""
    if not (found := adaptation_results.plans_table(rows)):
        return ""
    return f"""
What such models plan on those arms: the cross-entropy method, {plans.CANDIDATES["paper"]} candidates and
{adaptation.PLAN_ITERATIONS} iterations, over codes of the standard arm's prior, executed open loop, to the first n test
targets: the frozen ones, but where a link is longer, which draws its own. Candidates are judged by the mode and
{JUDGING} samples, of an ensemble by its members, of the LSTM by its one rollout. Seeds are of the planner, too:

{found}
"""


def _pushing_rounds(rows: pd.DataFrame, free: pd.DataFrame | None) -> str:
    """The part of that page on the arm that pushes; empty without rows."""
    if not (found := exploration_results.rounds_table(rows, exploration_results.PUSH)):
        return ""
    page = f"""
The arm that pushes, planned again every ten steps, to the first n frozen targets; "{exploration_results.NONE}" is the
same training on the first random episodes alone:

![Return, share within 5 cm and open-loop gap of the pushing arm against environment steps](../figures/10_pushing.png)

Steps are on a logarithmic axis. Axes end a little below the lowest of round 0 and of the policies; dotted across is
what training alone ends with, and what plans through the true simulator return (oracle): the longer search of study
05, open loop, in codes of its prior.

{found}

![Fingertip and object on the plane, in random episodes and in own plans](../figures/10_places.png)

Every step of 24 random episodes that `rtsm`, seed 0, began with, and of 24 from its last round of own plans.
"""
    if differences := exploration_results.differences_table(rows):
        page += f"""
Own plans minus others, paired by seed: minus the same learner before its first round, and minus those of the other data
after as many rounds, which have been trained as often:

{differences}
"""
    page += _steps_of_policies(rows, free, exploration_results.PUSH)
    if priors := exploration_results.priors_table(rows):
        page += f"""
A search through the true simulator, which favours no prior, in codes of the prior before the first round and of the
last, from the first n frozen starts: returns that it ends with, and iterations to that of the first prior:

{priors}
"""
    return page
