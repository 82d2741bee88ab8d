"""What ships: a paper-scale run copied into data/ and figures/, and README's results written from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from tsmlib import study
from tsmlib.envs import imperfect
from tsmlib.envs.spec import DELAY, ENV_IDS, NOISE
from tsmlib.storage import files, manifest
from tsmlib.storage import tables as tables_storage
from tsmlib.study.claims import evaluate
from tsmlib.study.claims import report as claims_report
from tsmlib.study.notebooks import require
from tsmlib.study.predictions import RESULTS
from tsmlib.study.results import policies as policies_results
from tsmlib.study.results import prediction as prediction_results
from tsmlib.study.results.planning import by_loop, report
from tsmlib.study.runs import ROOT, Run

README = ROOT / "README.md"
METRICS = ("ll_paper", "ll_shared", "ll_own", "energy_score_noise", "crps_noise", "nrmse", "coverage80", "diverged")
MARKS = ("<!-- results -->", "<!-- end of results -->")
CLAIM_MARKS = ("<!-- claims -->", "<!-- end of claims -->")
POOLED = (
    "03_predict",
    "04_latent",
    "06_robustness",
    "07_action_prior",
)  # notebooks whose tables ship with the rows of every seed


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
        tables_storage.save_table(RESULTS / f"{notebook}.csv", rows, extra=_extra(rows))
    manifest.write_manifest(ROOT / "data")
    _between(MARKS, readme_results())
    publish_claims()


def _ships(path: Path) -> bool:
    """Not checkpoints, nor models that only a table needs: of the paper's choices, and of the map of imperfect arms."""
    arms = {imperfect(arm, **how) for arm in ENV_IDS for how in ({}, {"noise": NOISE}, {"delay": DELAY})}
    table_only = path.stem in study.CHOICES or path.parent.name not in {study.short(arm) for arm in arms}
    return ".checkpoint" not in path.name and not (path.parents[1].name == "models" and table_only)


def pooled(run: Run) -> dict[str, list[dict[str, Any]]]:
    """Notebook -> the rows of this run and of every seed beside it. RunError where one did not come to its end."""
    own = {notebook: tables_storage.load_table(run.metrics / f"{notebook}.csv") for notebook in POOLED}
    return {notebook: study.evidence(replace(run, notebook=notebook), rows) for notebook, rows in own.items()}


def _extra(rows: list[dict[str, Any]]) -> list[str]:
    """Columns beyond those of every table."""
    return [column for column in dict.fromkeys(c for row in rows for c in row) if column not in tables_storage.COLUMNS]


def publish_claims() -> None:
    """Judge every claim from the tables that ship: data/results/08_claims.csv, and README's table. Idempotent."""
    papers, ours = (shipped_verdicts(model) for model in (evaluate.PAPERS, evaluate.OURS))
    rows = [
        row
        for model, verdicts in ((evaluate.PAPERS, papers), (evaluate.OURS, ours))
        for row in evaluate.as_rows(verdicts, model=model, scale="paper")
    ]
    tables_storage.save_table(RESULTS / "08_claims.csv", rows, extra=evaluate.EXTRA)
    manifest.write_manifest(ROOT / "data")
    _between(CLAIM_MARKS, readme_claims(papers, ours))


def shipped_verdicts(model: str = evaluate.PAPERS) -> list[evaluate.Verdict]:
    """The verdicts that follow from the tables that ship."""
    ledger = evaluate.read(subject=model)
    rows = evaluate.tables(ledger)
    return [evaluate.judge(claim, rows) for claim in ledger]


def _between(marks: tuple[str, str], written: str) -> None:
    """Put ``written`` between two marks of README."""
    before, _, rest = README.read_text().partition(marks[0])
    after = rest.partition(marks[1])[2]
    files.write_bytes(README, "\n".join([before + marks[0], "", written, "", marks[1] + after]).encode())


def readme_claims(papers: list[evaluate.Verdict], ours: list[evaluate.Verdict]) -> str:
    """What README says of the paper's claims: those that carry it, and how many of all got which verdict."""
    pairs = [pair for pair in zip(papers, ours, strict=True) if pair[0].claim.headline]
    table = claims_report.table([first for first, _ in pairs], [second for _, second in pairs])
    return f"""Written by `python -m tsmlib run claims` from the rows in `data/results`.

- The paper's model: {claims_report.counts(papers)}.
- `{evaluate.OURS}` in its place: {claims_report.counts(ours)}.

Below are the {len(pairs)} of {len(papers)} claims that carry the paper. All of them, why each verdict is what it is,
and what the paper leaves open are in `notebooks/08_claims.ipynb`.

{table}"""


def readme_results() -> str:
    """What README says about results, from the shipped tables alone."""
    control = tables_storage.load_table(RESULTS / "05_control.csv")
    predict, learned = tables_storage.load_table(RESULTS / "03_predict.csv"), list[Mapping[str, Any]](control)
    if (peers := RESULTS / "peers_pets.csv").exists():
        predict += tables_storage.load_table(peers)
    if (free := RESULTS / "model_free.csv").exists():
        learned += policies_results.finished(tables_storage.load_table(free))
    envs = list(dict.fromkeys(row["env"] for row in predict))
    seeds = {env: len({row["seed"] for row in predict if row["env"] == env}) for env in envs}
    boards = "\n\n".join(
        f"`{env}`, {seeds[env]} training seed{'s' * (seeds[env] > 1)}{' unless said' * (seeds[env] > 1)}:\n\n"
        + prediction_results.board(predict, METRICS, env=env)
        for env in envs
    )
    n = max(row["n"] for row in predict if row["condition"] == "clean" and row["n"] != "")
    return f"""Written by `python -m tsmlib publish` from `data/results`, scale paper.

**Prediction.** {n:,} test episodes, 32 samples of each, open loop with the true torques for 90 steps after ten
observed ones; means over steps, in standardised units, with half the 95 % t interval where there are several training
seeds. Higher is better for the likelihoods `ll_`, lower for the others, and `coverage80` should be 0.80. The models
of an environment got as many updates as fit into the same time on one idle core (`study.BUDGET`). `pets` is the same
kind of model as `ensemble`, by mbrl-lib (`benchmarks/peers`).

{boards}

**Planning.** Training seed {control[0]["seed"]}, frozen targets, T = 50 steps, the cross-entropy method through each
model, executed open loop; means over targets, returns in metres summed over steps.

{report([row for row in control if row["metric"] != "plan_seconds"])}

**Planning again** every ten steps, pushing:

{by_loop(control)}

**Policies** learned inside the models, and model-free ones in the environment; means of the last record
over k copies or seeds, with half the 95 % t interval.

{policies_results.report(policies_results.learning_curves(learned))}"""
