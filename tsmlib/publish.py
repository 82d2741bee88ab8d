"""What ships: a paper-scale run copied into data/ and figures/, and README's results written from it."""

from __future__ import annotations

from dataclasses import replace

from tsmlib import policy_report, scoreboard, store, study
from tsmlib.report import by_loop, report
from tsmlib.runs import ROOT, Run, require
from tsmlib.study import RESULTS

README = ROOT / "README.md"
METRICS = ("ll_paper", "ll_shared", "ll_own", "energy_score_noise", "crps_noise", "nrmse", "coverage80", "diverged")
MARKS = ("<!-- results -->", "<!-- end of results -->")


def publish(run: Run) -> None:
    """Copy a run's models, oracle plans, tables and figures into data/ and figures/; rewrite README's results.

    The table of 03_predict has the rows of the other seeds beside this run as well, and model-free policies come from
    ``bench/model_free.csv`` beside the scales. Raises RunError, before anything is written, unless the notebooks ran to
    their end and their results are as they left them.
    """
    for notebook in ("01_collect", "02_train", "03_predict", "05_control"):
        require(run, notebook)
    for source, pattern, target in (
        (run.models, "*/*.safetensors", run.shipped),
        (run.folder("plans"), "*-oracle-*.safetensors", RESULTS),
        (run.metrics, "*.csv", RESULTS),
        (run.figures, "*.*", ROOT / "figures"),
    ):
        for path in sorted(source.glob(pattern)):
            if ".checkpoint" not in path.name:
                copy = target / path.relative_to(source)
                copy.parent.mkdir(parents=True, exist_ok=True)
                store.write_bytes(copy, path.read_bytes())
    predicted = run.metrics / "03_predict.csv"
    rows = study.evidence(replace(run, notebook="03_predict"), store.load_table(predicted))
    store.save_table(RESULTS / predicted.name, rows)  # of every seed beside this run
    learned = run.dir.parents[1] / "bench" / "model_free.csv"
    if learned.exists():
        finished = policy_report.finished(store.load_table(learned))
        store.save_table(RESULTS / learned.name, finished, extra=["configuration"])
    store.write_manifest(ROOT / "data")
    before, _, rest = README.read_text().partition(MARKS[0])
    after = rest.partition(MARKS[1])[2]
    text = "\n".join([before + MARKS[0], "", readme_results(), "", MARKS[1] + after])
    store.write_bytes(README, text.encode())


def readme_results() -> str:
    """What README says about results, from the shipped tables alone."""
    control = store.load_table(RESULTS / "05_control.csv")
    predict, learned = store.load_table(RESULTS / "03_predict.csv"), control
    if (peers := RESULTS / "peers_pets.csv").exists():
        predict += store.load_table(peers)
    if (free := RESULTS / "model_free.csv").exists():
        learned = [*control, *store.load_table(free)]
    envs = list(dict.fromkeys(row["env"] for row in predict))
    seeds = {env: len({row["seed"] for row in predict if row["env"] == env}) for env in envs}
    boards = "\n\n".join(
        f"`{env}`, {seeds[env]} training seed{'s' * (seeds[env] > 1)}{' unless said' * (seeds[env] > 1)}:\n\n"
        + scoreboard.board(predict, METRICS, env=env)
        for env in envs
    )
    n = max(row["n"] for row in predict if row["condition"] == "clean" and row["n"] != "")
    return f"""Written by `python -m tsmlib publish` from `data/results`, scale paper.

**Prediction.** {n:,} test episodes, open loop with the true torques for 90 steps after ten observed ones; means over
steps, in standardised units, with half the 95 % t interval where there are several training seeds. Higher is better for
the likelihoods `ll_`, lower for the others, and `coverage80` should be 0.80. The models of an
environment got as many updates as fit into the same time on one idle core (`study.BUDGET`). `pets` is the same kind of
model as `ensemble`, by mbrl-lib (`benchmarks/peers`).

{boards}

**Planning.** Training seed {control[0]["seed"]}, frozen targets, T = 50 steps, the cross-entropy method through each
model, executed open loop; means over targets, returns in metres summed over steps.

{report([row for row in control if row["metric"] != "plan_seconds"])}

**Planning again** every ten steps, pushing:

{by_loop(control)}

**Policies** learned inside the models, and model-free ones in the environment; returns of the last record, mean over
copies with half the 95 % t interval.

{policy_report.report(policy_report.learning_curves(learned))}"""
