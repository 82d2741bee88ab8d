"""What a run has cost: seconds by the clock of each notebook, processor seconds of each thing that was made.

python -m tsmlib run all --scale paper --seed 1
python benchmarks/choices/spent.py runs/paper/seed1

A notebook's are those of its last go: what an earlier one made is found, and costs nothing. A file's are all it took.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

from tsmlib import store


def kind(path: Path) -> str:
    """What a file of a run holds, from its name: models/ENV/MODEL, or plans/ENV-MODEL-PRIOR-PLANNER."""
    if path.parent.name == "plans":
        _, model, _, *planner = path.stem.split("-")
        return "plans, " + ("oracle" if model == "oracle" else "-".join(planner))
    made, _, what = path.stem.partition("-")
    return f"policies, {what}" if made == "policy" else f"models, {path.parent.name}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a run, such as runs/paper/seed1")
    run: Path = parser.parse_args().run
    for name, entry in store.read_json(run / "status.json").items():
        print(f"{name:20} {entry['state']:12} {entry.get('seconds', float('nan')):8,.0f} s by the clock")
    spent: dict[str, list[float]] = defaultdict(list)
    for path in sorted([*run.glob("models/*/*.safetensors"), *run.glob("plans/*.safetensors")]):
        spent[kind(path)].append(float(store.read_header(path)["seconds"]))
    for what, seconds in spent.items():
        print(f"{what:40} {len(seconds):4} of {sum(seconds):8,.0f} processor seconds")
    for word in ("models", "policies", "plans", ""):
        of = [value for what, seconds in spent.items() if what.startswith(word) for value in seconds]
        print(f"{'all ' + word:40} {len(of):4} of {sum(of):8,.0f} processor seconds")


if __name__ == "__main__":
    main()
