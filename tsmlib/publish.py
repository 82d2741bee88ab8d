"""What ships: a paper-scale run copied into data/ and figures/, and README's results written from it."""

from __future__ import annotations

from tsmlib import store
from tsmlib.report import report
from tsmlib.runs import ROOT, Run, RunError
from tsmlib.study import RESULTS

README = ROOT / "README.md"
MARKS = ("<!-- results -->", "<!-- end of results -->")


def publish(run: Run) -> None:
    """Copy a run's models, oracle plans, tables and figures into data/ and figures/; rewrite README's results.

    Raises RunError, before anything is written, unless all three notebooks ran to their end.
    """
    status = store.read_json(run.dir / "status.json")
    for notebook in ("01_collect", "02_train", "05_control"):
        state = status.get(notebook, {}).get("state", "missing")
        if state != "complete":
            raise RunError(f"{notebook} in {run.dir} is {state}; python -m tsmlib run all --scale paper completes it")
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
    store.write_manifest(ROOT / "data")
    before, _, rest = README.read_text().partition(MARKS[0])
    after = rest.partition(MARKS[1])[2]
    text = "\n".join([before + MARKS[0], "", readme_results(), "", MARKS[1] + after])
    store.write_bytes(README, text.encode())


def shipped_report() -> str:
    """The published results of 05_control as a Markdown table."""
    table = RESULTS / "05_control.csv"
    if not table.exists():  # while they are being made
        return "Nothing is published yet: `python -m tsmlib run all --scale paper`, then `python -m tsmlib publish`."
    return report(store.load_table(table))


def readme_results() -> str:
    """What README says about results, from the shipped tables alone."""
    control = store.load_table(RESULTS / "05_control.csv")
    train = [row for row in store.load_table(RESULTS / "02_train.csv") if row["env"] == "tsm/ReacherPush-v0"]
    arms, others = (
        report([row for row in control if row["sim"] == sim and row["metric"] not in ("success", "plan_seconds")])
        for sim in ("mujoco", "pymunk")
    )
    scores = {(row["model"], row["metric"], row["horizon"]): row for row in train}
    metrics = ("ll_paper", "ll_shared", "energy_score", "nrmse")
    lines = ["| model | " + " | ".join(f"{m} at {h}" for m in metrics for h in (10, 80)) + " |", "|---" * 9 + "|"]
    for model in ("tsm+teacher", "tsm", "tsm+energy"):
        cells = [f"{scores[model, m, h]['value']:.3f}" for m in metrics for h in (10, 80)]
        lines.append(f"| {model} | " + " | ".join(cells) + " |")
    n, seed = scores["tsm", "ll_paper", 10]["n"], control[0]["seed"]
    return f"""Written by `python -m tsmlib publish` from `data/results`: scale paper, one training seed ({seed}).

**Planning, MuJoCo.** Frozen targets, T = 50 steps, executed open loop; means over targets, returns in metres summed
over steps.

{arms}

**Planning, pymunk.**

{others}

**Prediction, pushing in MuJoCo.** {n} test episodes, open loop after ten observed steps; log-likelihoods (higher is
better) and energy score and error (lower is better) at 10 and at 80 steps, standardised units.

{chr(10).join(lines)}"""
