"""Cost of a run: seconds by the clock of each notebook, and of each model, policy and plan that it has kept.

python -m tsmlib run all --scale paper --seed 1
python benchmarks/settings/spent.py runs/paper/seed1

A notebook's are those of its last go: what an earlier one made is found, and costs nothing. A file's are all it took:
CPU seconds for models and policies, by the clock of the process that planned for plans; of a closed loop its own alone,
without those of the plan that it begins with.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, cast

from tsmlib.envs.spec import EnvSpec
from tsmlib.figures.method import PLANNERS, Method
from tsmlib.storage import artifacts, manifest
from tsmlib.study import plans, zoo


class Cost(NamedTuple):
    """Seconds of one file: of models, policies or plans, and of which of them."""

    kind: str
    which: str
    seconds: float


def costs(run: Path) -> Iterator[Cost]:
    """Of every model, policy and plan that a run has kept, as its header says."""
    for path in sorted(run.glob("models/*/*.safetensors")):
        header = artifacts.read_header(path)
        seconds, env = cast(float, header["seconds"]), cast(dict[str, str], header["fingerprint"])["env"]
        if "search_space" in header:
            yield Cost("policies", f"{header['model']}, {header['search_space']}", seconds)
        else:
            yield Cost("models", EnvSpec.parse(env).name, seconds)
    for path in sorted(run.glob("plans/*.safetensors")):
        header = artifacts.read_header(path)
        seconds, posed = cast(float, header["seconds"]), cast(dict[str, int], header["made_from"])
        env, every = str(posed["env"]), posed["every"]
        way = method_of(path, env, every, posed["iterations"])
        if every:
            first = path.with_stem(plans.file_name(env, way))
            seconds -= cast(float, artifacts.read_header(first)["seconds"])
        loop = f", every {every} steps" * bool(every)
        yield Cost("plans", way.model if way.model == "oracle" else f"{way.planner}{loop}", seconds)


def method_of(path: Path, env: str, every: int, iterations: int) -> Method:
    """The method whose plan a file is; iterations: those of its header, in its name if they are not the usual ones."""
    for way in (way for planner in PLANNERS for way in zoo.methods([*zoo.words(), "oracle"], planner)):
        if path.stem in (plans.file_name(env, way, every=every, iterations=n) for n in (0, iterations)):
            return way
    raise ValueError(f"{path} is of no method that there is")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a run, such as runs/paper/seed1")
    run: Path = parser.parse_args().run
    for name, entry in manifest.statuses(run).items():
        print(f"{name:40} {entry['state']:12} {entry.get('seconds', float('nan')):8,.0f} s")
    spent: dict[str, list[float]] = defaultdict(list)
    for cost in costs(run):
        for what in (f"{cost.kind}, {cost.which}", f"all {cost.kind}", "all"):
            spent[what].append(cost.seconds)
    for what, seconds in sorted(spent.items(), key=lambda item: item[0].startswith("all")):
        print(f"{what:40} {len(seconds):4} files   {sum(seconds):8,.0f} s")


if __name__ == "__main__":
    main()
