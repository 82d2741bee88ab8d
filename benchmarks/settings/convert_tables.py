"""Results tables of the columns `prior, horizon, condition`, rewritten once to those of ``tsmlib.storage.tables``.

    python benchmarks/settings/convert_tables.py OLD_FOLDER NEW_FOLDER

Every combination of table, planner and condition is mapped below, and an unknown one is an error. Rows stay in their
order; afterwards every number is compared with the old one.
"""

from __future__ import annotations

import argparse
import csv
from collections import Counter
from pathlib import Path
from typing import Any

from tsmlib.envs.spec import DELAY, NOISE
from tsmlib.storage import tables

SPACES = {"": "", "codes": "latent", "actions": "direct"}
METRICS = {"broken": "violations", "broken_worst": "violations_worst"}
ABOUT_CODES = {"active_units", "kl", "error", "error_posterior", "error_prior", "error_zero", "fixed_code_variance",
               "spearman", "spread"}  # fmt: skip  # of single segments, in 06_robustness too
OPEN, SEGMENTS = {"execution": "open loop"}, {"execution": "segments"}
SCORES = {
    "clean": OPEN, "segments": SEGMENTS, "contact": OPEN | {"subset": "contact"},
    "segments contact": SEGMENTS | {"subset": "contact"},
}  # fmt: skip
CODES = {
    "segments": SEGMENTS, "segments free": SEGMENTS | {"subset": "free"},
    "segments contact": SEGMENTS | {"subset": "contact"}, "before touch": SEGMENTS | {"subset": "before touch"},
    "after touch": SEGMENTS | {"subset": "after touch"}, "object moves": SEGMENTS | {"subset": "object moves"},
    "object": OPEN | {"subset": "object"}, "wall": OPEN | {"subset": "wall"},
    "first touch": OPEN | {"subset": "first touch"},
}  # fmt: skip
ARMS: dict[str, dict[str, Any]] = {
    "noise": {"noise": NOISE}, "delay": {"delay": DELAY}, "noise 0.1": {"noise": 0.1},
    "noise, delay": {"noise": NOISE, "delay": DELAY},
}  # fmt: skip
IMPERFECT = SCORES | {
    f"{arm}{rest}": about | what
    for arm, about in ARMS.items()
    for rest, what in {"": OPEN, ", segments": SEGMENTS}.items()
} | {"delay, past actions zero": ARMS["delay"] | OPEN | {"subset": "past actions zero"}}  # fmt: skip
POLICY = {"execution": "policy"}
EPISODES = 100  # steps of an episode of data


def converted(table: str, old: dict[str, str], plan_steps: dict[str, str]) -> dict[str, str]:
    """A row in the new columns. Raises KeyError for what no mapping names."""
    row = dict(old)
    horizon, condition, prior = row.pop("horizon"), row.pop("condition"), row.pop("prior")
    metric, planner = row["metric"], row["planner"]
    new: dict[str, Any] = {}
    match table:
        case "01_collect":
            _only(condition, "clean")
            new = {"horizon": horizon}
            if metric == "velocity_autocorrelation":
                new = {"horizon": EPISODES, "lag": horizon}
        case "02_train":
            _only(condition, "clean")
            new = {"horizon": horizon}
            if row["model"] != "prior" and metric not in ("gradient_error", "parameters", "train_seconds"):
                new = OPEN | {"steps_ahead": horizon}
        case "03_predict" | "03_ablation" | "03_samples" | "peers_pets":
            new = SCORES[condition] | {"steps_ahead": horizon}
        case "04_latent":
            new = CODES[condition] | {"steps_ahead": horizon}
        case "05_control" | "05_control_rows" if planner == "policy":
            _only(condition, "learning")
            new = POLICY | {"iteration": horizon}
        case "05_control" | "05_control_rows":
            new = {"clean": OPEN, "closed loop": {"execution": "closed loop"}, "along the way": OPEN}[condition]
            if condition == "along the way":
                new = new | {"iteration": horizon, "horizon": plan_steps[row["env"]]}
            else:
                new = new | {"horizon": horizon}
        case "06_robustness" if planner == "policy":
            new = POLICY | {"iteration": horizon} | {"clean": {}, **ARMS}[condition]
        case "06_robustness":
            new = IMPERFECT[condition] | {"steps_ahead": horizon}
            if metric in ABOUT_CODES or metric.startswith("rmse_clean"):
                new = new | SEGMENTS
        case "07_action_prior":
            subsets = {"clean": "", "cost of the prior": "", "data": "data", "samples": "sampled",
                       "again": "reconstructed"}  # fmt: skip
            new = {"horizon": horizon, "subset": subsets[condition]}
            new = new | (OPEN if condition in ("clean", "cost of the prior") else {})
        case "07_starts":
            _only(condition, "starts")
            new = OPEN | {"horizon": horizon}
        case "model_free":
            new = POLICY | {"env_steps": horizon} | {"learning": {}, "search": {"subset": "search"}}[condition]
        case "08_claims":
            _only(horizon + condition + prior, "")
        case _:
            raise KeyError(table)
    return row | new | {"search_space": SPACES[prior], "metric": METRICS.get(metric, metric)}


def _only(found: str, known: str) -> None:
    if found != known:
        raise KeyError(found)


def convert(source: Path, target: Path) -> None:
    """One table; ValueError where a number is another afterwards."""
    with source.open(newline="") as file:
        old = list(csv.DictReader(file))
    plan_steps = {row["env"]: row["horizon"] for row in old if row["condition"] == "clean"}
    extra = [name for name in old[0] if name not in (*tables.COLUMNS, "prior", "horizon", "condition")]
    tables.save(target, [converted(source.stem, row, plan_steps) for row in old], extra=extra)
    new = tables.records(tables.load(target))
    kept = [name for name in old[0] if name not in ("prior", "horizon", "condition", "metric")]
    before = [(METRICS.get(row["metric"], row["metric"]), *(_number(row[name]) for name in kept)) for row in old]
    after = [(row["metric"], *(row[name] for name in kept)) for row in new]
    if before != after or Counter(before) != Counter(after):
        raise ValueError(f"{target}: rows differ from {source}")
    steps = ("horizon", "steps_ahead", "iteration", "env_steps", "lag")
    for one, other in zip(old, new, strict=True):
        found = [other[name] for name in steps if other.get(name, "") != ""]
        along = one["metric"] == "velocity_autocorrelation" or one["condition"] == "along the way"  # an episode's, too
        wanted = int(one["horizon"]) if one["horizon"] else None
        if len(found) != (wanted is not None) + along or (wanted is not None and wanted not in found):
            raise ValueError(f"{target}: {one} lost its horizon: {other}")
    keys = [tuple(value for name, value in row.items() if name != "value") for row in new]
    if len(set(keys)) != len(keys):
        raise ValueError(f"{target}: {len(keys) - len(set(keys))} rows stand twice")
    print(f"{source.name}: {len(new)} rows, each with a key of its own")


def _number(field: str) -> Any:
    try:
        return float(field)
    except ValueError:
        return field


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("source", type=Path)
    options.add_argument("target", type=Path)
    arguments = options.parse_args()
    for path in sorted(arguments.source.glob("*.csv")):
        convert(path, arguments.target / path.name)
