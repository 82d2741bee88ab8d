"""Long forms of the checks: ``make reliability PARTS="files simulators"``, or all; ``--quick``: as in tests.

The line of each check is kept in ``runs/reliability``, and the table of docs/reliability.md is written from these; a
line that was not measured here stays as it is. So the parts may be run one after another. Ends with status 1 where a
trial went wrong. The part ``table`` runs nothing. A part may also be one check, and ``check=10`` is ten trials of it.
"""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
os.environ.setdefault("TQDM_DISABLE", "1")

import torch

from reliability import cluster, files, pipelines, simulators, training
from reliability.world import Outcome
from tsmlib.storage import files as files_storage
from tsmlib.storage import manifest
from reproduction import runs

DOCS = runs.ROOT / "docs" / "reliability.md"
MARKS = ("<!-- table -->", "<!-- end of table -->")
LONG_ONLY = -1
CHECKS: dict[
    str, list[tuple[Callable[[int], Outcome], int, int]]
] = {  # check, quick and long trials
    "training": [
        (training.killed_at_random_moments, 20, 300),
        (training.at_every_call, 3, 1),
        (training.at_every_system_call, LONG_ONLY, 1000),
        (training.newest_generation_spoilt, 60, 200),
        (training.values_that_are_not_finite, 60, 200),
        (training.losses_that_are_not_finite, 8, 20),
        (training.full_disk, 0, 0),
        (training.two_writers, 5, 50),
        (training.interrupted_in_a_cell, 3, 50),
        (training.memory, 2000, 20000),
    ],
    "files": [
        (files.damage, 300, 2000),
        (files.malice, 0, 0),
        (files.hostile_minari, 0, 500),
        (files.mismatched, 0, 0),
        (files.hostile_parameters, 8, 0),
        (files.fuzz, 400, 5000),
    ],
    "simulators": [
        (simulators.faults_in_mujoco, 100, 100),
        (simulators.large_sets, 20, 5000),
        (simulators.faults_in_pymunk, 50, 50),
        (simulators.restores, 36, 36),
    ],
    "pipelines": [
        (pipelines.notebooks_in_any_order, LONG_ONLY, 2),
        (pipelines.notebooks_in_workflows, LONG_ONLY, 0),
        (pipelines.cells_out_of_order, LONG_ONLY, 20),
        (pipelines.killed_runs, LONG_ONLY, 24),  # tests/test_runner.py has each once
        (pipelines.elsewhere, 2, 3),
        (pipelines.threads, LONG_ONLY, 20),
        (pipelines.another_thread_count, 0, 0),
    ],
    "cluster": [
        (cluster.killed_on_a_cluster, 0, 20),
    ],
}


def main() -> int:
    torch.set_num_threads(1)  # as in the children that a check forks
    quick = "--quick" in sys.argv
    by_name = {entry[0].__name__: [entry] for part in CHECKS.values() for entry in part}
    chosen: list[tuple[Callable[[int], Outcome], int]] = []
    for word in [word for word in sys.argv[1:] if word != "--quick"] or list(CHECKS):
        name, _, trials = word.partition("=")
        entries = CHECKS.get(name) or by_name.get(name, [])
        if word != "table" and (not entries or (trials and not trials.isdecimal())):
            print(
                f"error: no part is called {word!r}; there are {', '.join([*CHECKS, *by_name])} and table."
            )
            return 2
        for check, few, many in entries:
            if not quick or few != LONG_ONLY:
                chosen.append((check, int(trials or (few if quick else many))))
    place = runs.resolve("reliability").dir.parents[1] / "reliability"
    failed = 0
    for check, count in chosen:
        began = seconds_used()
        try:
            outcome = check(count)
        except Exception as error:
            outcome = Outcome(wrong=[repr(error)[:300]])
        seconds = seconds_used() - began
        failed += not 0 < outcome.of == outcome.right and not outcome.note.endswith("not done")
        score = f"{outcome.right} of {outcome.of}   {outcome.note}   {seconds:.0f} s"
        print(
            f"{said(check)[0]:7} {check.__name__:28} {score}",
            *outcome.wrong[:10],
            sep="\n        ",
            flush=True,
        )
        entry = {
            "right": outcome.right,
            "of": outcome.of,
            "note": outcome.note,
            "seconds": round(seconds),
            "wrong": outcome.wrong[:10],
            "day": f"{datetime.now(UTC):%Y-%m-%d}",
        }
        if outcome.of or not outcome.note.endswith("not done"):
            manifest.write_json(place / f"{check.__name__}.json", entry)
    write_table(place)
    return 1 if failed else 0


def said(check: Callable[[int], Outcome]) -> tuple[str, str]:
    """R number and first paragraph of a check's docstring."""
    number, _, what = (check.__doc__ or "").split("\n\n")[0].replace("\n    ", " ").partition(": ")
    return number, what


def seconds_used() -> float:
    """CPU seconds of this process and of the children that it has waited for."""
    return sum(os.times()[:4])


def write_table(place: Path) -> None:
    """Write the table of docs/reliability.md: the lines that ``place`` holds, and those of the page of other checks."""
    before, _, rest = DOCS.read_text().partition(MARKS[0])
    table, _, after = rest.partition(MARKS[1])
    written = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    kept = {tuple(cells[:2]): cells[2:] for cells in written if len(cells) == 7}
    lines = [
        "| test | what | right | of | measured | CPU s | day |",
        "|---|---|---|---|---|---|---|",
    ]
    for part in CHECKS.values():
        for check, _, _ in part:
            path = place / f"{check.__name__}.json"
            told, found = _cells(*said(check)), kept.get(_cells(*said(check)))
            if path.exists():
                entry = manifest.read_own_json(path)
                found = [
                    *_cells(
                        *(entry.get(name, "") for name in ("right", "of", "note", "seconds", "day"))
                    )
                ]
            lines.append(
                "| "
                + " | ".join([*told, *(found or ["", "", "not yet run at full length", "", ""])])
                + " |"
            )
    lines += [
        "",
        f"Python {platform.python_version()}, torch {torch.__version__}, {platform.system()}.",
    ]
    files_storage.write_bytes(
        DOCS, "\n".join([before + MARKS[0], "", *lines, "", MARKS[1] + after]).encode()
    )


def _cells(*values: object) -> tuple[str, ...]:
    return tuple(" ".join(str(value).replace("|", "/").split()) for value in values)


if __name__ == "__main__":
    sys.exit(main())
