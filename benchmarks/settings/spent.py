"""Cost of a run: seconds by the clock of each notebook, and of each model, policy and plan that it has kept.

python -m tsmlib run all --scale paper --seed 1
python benchmarks/settings/spent.py runs/paper/seed1

A notebook's are those of its last go: what an earlier one made is found, and costs nothing. A file's are all it took:
CPU seconds for models and policies, by the clock of the process that planned for plans.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

from tsmlib.storage import artifacts, manifest


def kind(path: Path) -> str:
    """What a file of a run holds, from its name: models/ENV/MODEL, or plans/ENV-MODEL-PRIOR-PLANNER."""
    if path.parent.name == "plans":
        _, model, _, *planner = path.stem.split("-")
        return "plans, " + ("oracle" if model == "oracle" else "-".join(planner))
    made, _, what = path.stem.partition("-")
    return f"policies, {what}" if made == "policy" else f"models, {path.parent.name}"


def took(path: Path) -> float:
    """Seconds; of a closed loop, which states them together with those of the plan it begins with, its own alone."""
    seconds = float(artifacts.read_header(path)["seconds"])
    first, loop, _ = path.stem.rpartition("-every")
    return seconds - took(path.with_stem(first)) if loop else seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a run, such as runs/paper/seed1")
    run: Path = parser.parse_args().run
    for name, entry in manifest.statuses(run).items():
        print(f"{name:40} {entry['state']:12} {entry.get('seconds', float('nan')):8,.0f} s")
    spent: dict[str, list[float]] = defaultdict(list)
    for path in sorted([*run.glob("models/*/*.safetensors"), *run.glob("plans/*.safetensors")]):
        spent[kind(path)].append(took(path))
    for what, seconds in spent.items():
        print(f"{what:40} {len(seconds):4} files   {sum(seconds):8,.0f} s")
    for word in ("models", "policies", "plans", ""):
        together = [value for what, seconds in spent.items() if what.startswith(word) for value in seconds]
        print(f"{f'all {word}'.strip():40} {len(together):4} files   {sum(together):8,.0f} s")


if __name__ == "__main__":
    main()
