"""Publishing: a paper-scale run copied into data/ and figures/, and README's results written from it."""

from dataclasses import replace
from pathlib import Path

import pandas as pd

from tsmlib import study
from tsmlib.envs import imperfect
from tsmlib.envs.spec import DELAY, ENV_IDS, NOISE, EnvSpec
from tsmlib.planning.tasks import HORIZON
from tsmlib.storage import files, manifest
from tsmlib.storage import tables as tables_storage
from tsmlib.study import zoo
from tsmlib.study.claims import evaluate, ledger
from tsmlib.study.claims import report as claims_report
from tsmlib.study.claims.claim import DEFINITIONAL
from tsmlib.study.notebooks import require
from tsmlib.study.predictions import RESULTS
from tsmlib.study.results import planning as planning_results
from tsmlib.study.results import policies as policies_results
from tsmlib.study.results import prediction as prediction_results
from tsmlib.study.results import table
from tsmlib.study.runs import ROOT, Run
from tsmlib.study.zoo import OURS, PAPERS

README = ROOT / "README.md"
METRICS = ("ll_paper", "ll_shared", "ll_own", "energy_score_noise", "crps_noise", "nrmse", "coverage80", "diverged")
MARKS = ("<!-- results -->", "<!-- end of results -->")
CLAIM_MARKS = ("<!-- claims -->", "<!-- end of claims -->")
POOLED = (
    "03_predict",
    "04_latent",
    "06_robustness",
    "07_action_prior",
)  # tables that ship with all seeds


def publish(run: Run) -> None:
    """Copy a run's models, oracle plans, tables and figures into data/ and figures/; rewrite what README says of them.

    The tables of POOLED have the rows of the other seeds beside this run as well. Raises RunError, before anything is
    written, unless the notebooks ran to their end and their results are as they left them.
    """
    for notebook in ("01_collect", "02_train", "05_control", *POOLED):
        require(run, notebook)
    tables = pooled(run)
    for source, pattern, target in (
        (run.models, "*/*.safetensors", run.shipped),
        (run.folder("plans"), "*-oracle-*.safetensors", RESULTS),
        (run.metrics, "*.csv", RESULTS),
        (run.figures, "*.*", ROOT / "figures"),
    ):
        for path in sorted(source.glob(pattern)):
            if _ships(path):
                copy = target / path.relative_to(source)
                copy.parent.mkdir(parents=True, exist_ok=True)
                files.write_bytes(copy, path.read_bytes())
    for notebook, rows in tables.items():
        tables_storage.save(RESULTS / f"{notebook}.csv", rows)
    manifest.write_manifest(ROOT / "data")
    _between(MARKS, readme_results())
    publish_claims()


def _ships(path: Path) -> bool:
    """Not checkpoints, nor models that only a table needs: of the paper's choices, and of the map of imperfect arms."""
    arms = {imperfect(arm, **how) for arm in ENV_IDS for how in ({}, {"noise": NOISE}, {"delay": DELAY})}
    table_only = path.stem in zoo.words("choice") or path.parent.name not in {EnvSpec.parse(arm).name for arm in arms}
    return ".checkpoint" not in path.name and not (path.parents[1].name == "models" and table_only)


def pooled(run: Run) -> dict[str, pd.DataFrame]:
    """Notebook -> the rows of this run and of every seed beside it. RunError where one did not come to its end."""
    own = {notebook: tables_storage.load(run.metrics / f"{notebook}.csv") for notebook in POOLED}
    return {notebook: study.published_rows(replace(run, notebook=notebook), rows) for notebook, rows in own.items()}


def publish_claims() -> None:
    """Judge every claim from the tables that ship: data/results/08_claims.csv, and README's table. Idempotent."""
    papers, ours = shipped_verdicts(PAPERS), shipped_verdicts(OURS)
    tables_storage.save(RESULTS / "08_claims.csv", evaluate.as_rows(papers + ours, scale="paper"), extra=evaluate.EXTRA)
    manifest.write_manifest(ROOT / "data")
    _between(CLAIM_MARKS, readme_claims(papers, ours))


def shipped_verdicts(subject: str = PAPERS) -> list[evaluate.Verdict]:
    """The verdicts that follow from the tables that ship. subject: the model in place of the paper's own."""
    claims = ledger.claims(subject)
    rows = evaluate.tables(claims)
    return [evaluate.judge(claim, rows) for claim in claims]


def _between(marks: tuple[str, str], written: str) -> None:
    """Put ``written`` between two marks of README."""
    before, _, rest = README.read_text().partition(marks[0])
    after = rest.partition(marks[1])[2]
    files.write_bytes(README, "\n".join([before + marks[0], "", written, "", marks[1] + after]).encode())


def readme_claims(papers: list[evaluate.Verdict], ours: list[evaluate.Verdict]) -> str:
    """What README says of the paper's claims: those that carry it, and how many of all got which verdict."""
    pairs = [pair for pair in zip(papers, ours, strict=True) if pair[0].claim.headline]
    table = claims_report.table([first for first, _ in pairs], [second for _, second in pairs])
    by_definition = ", ".join(verdict.claim.id for verdict in papers if verdict.word == DEFINITIONAL)
    return f"""Written by `python -m tsmlib publish --claims` from the rows in `data/results`.

- The paper's model: {claims_report.counts(papers)}.
- `{OURS}` in its place: {claims_report.counts(ours)}.
- Not counted, since they hold by definition: {by_definition}.

Below are the {len(pairs)} of {len(papers)} claims that carry the paper. All of them, and why each verdict is what it
is, are in `notebooks/08_claims.ipynb`; what the paper leaves open is in [docs/deviations.md](docs/deviations.md).

{table}"""


def readme_results() -> str:
    """What README says about results, from the shipped tables alone."""
    control, predict, peers, free = (
        tables_storage.load(path) if (path := RESULTS / f"{name}.csv").exists() else tables_storage.frame([])
        for name in ("05_control", "03_predict", "peers_pets", "model_free")
    )
    predict = tables_storage.frame(pd.concat([predict, peers]))
    learned = tables_storage.frame(pd.concat([control, policies_results.finished(free)]))
    seeds = {env: own["seed"].nunique() for env, own in table.groups(predict, "env")}
    scores = "\n\n".join(
        f"`{env}`, {n} training seed{'s' * (n > 1)}{' unless said' * (n > 1)}:\n\n"
        + prediction_results.scores_table(predict, METRICS, env=env)
        for env, n in seeds.items()
    )
    seed = control["seed"].iloc[0]
    n = predict[(predict["execution"] == "open loop") & (predict["subset"] == "")]["n"].max()
    return f"""Written by `python -m tsmlib publish` from `data/results`, scale paper.

**Prediction.** {n:,} test episodes, 32 samples of each, open loop with the true torques for 90 steps after ten
observed ones; means over steps, in standardised units, with half the 95 % t interval where there are several training
seeds. Higher is better for the likelihoods `ll_`, lower for the others, and `coverage80` should be 0.80. The models
of an environment got as many updates as fit into the same time on one idle core (`study.BUDGET`). `pets` is the same
kind of model as `ensemble`, by mbrl-lib (`benchmarks/peers`).

{scores}

**Planning.** Training seed {seed}, frozen targets, T = {HORIZON["reach"]} steps for reaching and {HORIZON["push"]} for
pushing, the cross-entropy method through each model, executed open loop; means over targets, returns in metres summed
over steps.

{planning_results.plans_table(control[control["metric"] != "plan_seconds"])}

**Planning again** every ten steps, pushing:

{planning_results.loops_table(control)}

**Policies** learned inside the models, and model-free ones in the environment; means of the last record
over k copies or seeds, with half the 95 % t interval.

{policies_results.policies_table(policies_results.learning_curves(learned))}"""
