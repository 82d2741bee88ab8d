"""The long form: ``make torture``, or ``make torture PARTS="files simulators"`` for some; ``--quick``: as in tests.

Each check is run at full length; its line is kept in ``runs/torture`` and the table of docs/trust.md is written from
all lines there are, so that the parts may be run one after another. Ends with status 1 where a trial went wrong. The
part ``table`` runs nothing. A part may also be one check, and ``check=10`` is ten trials of it.
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

from reliability import files, pipelines, simulators, training
from reliability.world import Outcome
from tsmlib.storage import files as files_storage
from tsmlib.storage import manifest
from tsmlib.study import runs

DOCS = runs.ROOT / "docs" / "trust.md"
MARKS = ("<!-- table -->", "<!-- end of table -->")
LONG_ONLY = -1
CHECKS: dict[str, list[tuple[str, Callable[[int], Outcome], int, int]]] = {  # R number, check, quick and long trials
    "training": [
        ("R1", training.killed_at_random_moments, 20, 300),
        ("R2", training.at_every_call, 0, 0),
        ("R2, R3", training.at_every_system_call, LONG_ONLY, 1000),
        ("R3", training.newest_generation_spoilt, 60, 200),
        ("R8", training.values_that_are_not_finite, 60, 200),
        ("R8", training.losses_that_are_not_finite, 8, 20),
        ("R10", training.full_disk, 0, 0),
        ("R11", training.two_writers, 5, 50),
        ("R15", training.interrupted_in_a_cell, 3, 50),
        ("R16", training.memory, 2000, 20000),
    ],
    "files": [
        ("R4", files.damage, 300, 2000),
        ("R5, R7", files.malice, 0, 0),
        ("R6", files.hostile_hdf5, 0, 500),
        ("R9", files.mismatched, 0, 0),
        ("R13", files.hostile_parameters, 0, 0),
        ("R27", files.fuzz, 400, 5000),
    ],
    "simulators": [
        ("R17", simulators.faults_in_mujoco, 100, 100),
        ("R17", simulators.large_sets, 20, 5000),
        ("R18", simulators.faults_in_pymunk, 50, 50),
        ("R19", simulators.restores, 36, 36),
    ],
    "pipelines": [
        ("R12", pipelines.notebooks_in_any_order, LONG_ONLY, 2),
        ("R12", pipelines.cells_out_of_order, LONG_ONLY, 20),
        ("R14", pipelines.killed_runs, LONG_ONLY, 24),  # tests/test_runner.py has each once
        ("R20", pipelines.elsewhere, 2, 3),
        ("R21", pipelines.threads, LONG_ONLY, 20),
        ("R21", pipelines.another_thread_count, 0, 0),
    ],
}


def main() -> int:
    torch.set_num_threads(1)  # as in the children that a check forks
    quick = "--quick" in sys.argv
    by_name = {entry[1].__name__: [entry] for part in CHECKS.values() for entry in part}
    chosen: list[tuple[str, Callable[[int], Outcome], int]] = []
    for word in [word for word in sys.argv[1:] if word != "--quick"] or list(CHECKS):
        name, _, trials = word.partition("=")
        entries = CHECKS.get(name) or by_name.get(name, [])
        if word != "table" and (not entries or (trials and not trials.isdecimal())):
            print(f"error: no part is called {word!r}; there are {', '.join([*CHECKS, *by_name])} and table.")
            return 2
        for number, check, few, many in entries:
            if not quick or few != LONG_ONLY:
                chosen.append((number, check, int(trials or (few if quick else many))))
    place = runs.resolve("torture").dir.parents[1] / "torture"
    failed = 0
    for number, check, count in chosen:
        began = seconds_used()
        try:
            outcome = check(count)
        except Exception as error:
            outcome = Outcome(wrong=[repr(error)[:300]])
        seconds = seconds_used() - began
        failed += not 0 < outcome.of == outcome.right and not outcome.note.endswith("not done")
        line = f"{number:7} {check.__name__:28} {outcome.right} of {outcome.of}   {outcome.note}   {seconds:.0f} s"
        print(line, *outcome.wrong[:10], sep="\n        ", flush=True)
        entry = {
            "number": number, "right": outcome.right, "of": outcome.of, "note": outcome.note,
            "seconds": round(seconds), "wrong": outcome.wrong[:10], "day": f"{datetime.now(UTC):%Y-%m-%d}",
        }  # fmt: skip
        manifest.write_json(place / f"{check.__name__}.json", entry)
    write_table(place)
    return 1 if failed else 0


def said(check: Callable[[int], Outcome]) -> str:
    """What a check says of itself, after its number."""
    return (check.__doc__ or "").partition(": ")[2].split("\n\n")[0].replace("\n    ", " ")


def seconds_used() -> float:
    """Processor seconds of this process and of the children that it has waited for."""
    return sum(os.times()[:4])


def write_table(place: Path) -> None:
    """Put the lines there are into docs/trust.md."""
    lines = ["| test | what | right | of | measured | CPU s |", "|---|---|---|---|---|---|"]
    for part in CHECKS.values():
        for number, check, _, _ in part:
            path = place / f"{check.__name__}.json"
            entry = manifest.read_json(path) if path.exists() else {"note": "not yet run at full length"}
            cells = (number, said(check), *(entry.get(name, "") for name in ("right", "of", "note", "seconds")))
            lines.append("| " + " | ".join(str(cell).replace("|", "/") for cell in cells) + " |")
    lines += ["", f"Python {platform.python_version()}, torch {torch.__version__}, {platform.system()}."]
    before, _, rest = DOCS.read_text().partition(MARKS[0])
    after = rest.partition(MARKS[1])[2]
    files_storage.write_bytes(DOCS, "\n".join([before + MARKS[0], "", *lines, "", MARKS[1] + after]).encode())


if __name__ == "__main__":
    sys.exit(main())
