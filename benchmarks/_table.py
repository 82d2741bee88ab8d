"""Table of all benchmarks, and targets beside what was measured.

Without options it is printed. ``--publish`` writes docs/speed.md and figures/bench_growth from the tables in
runs/bench: ``python -m tsmlib bench table``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import growth
from _rounds import EXTRA, Row, figure, folder, load, text

from reproduction import runs
from tsmlib import plots
from tsmlib.storage import files

ORDER = (
    *(
        "collect",
        "robots",
        "train",
        "avx2",
        "rollout",
        "plan",
        "policy",
        "score",
        "seed",
        "parallel",
        "copies",
    ),
    *("growth", "trust"),
)
DOCS = runs.ROOT / "docs" / "speed.md"
PICTURE = runs.ROOT / "figures" / "bench_growth"
MARKS = ("<!-- table -->", "<!-- end of table -->")
Found = dict[str, list[tuple[Row, dict[str, Any]]]]


@dataclass(frozen=True)
class Target:
    """A figure to reach: what it is of, and whether it is at least or at most ``bound``.

    rows: the part of a benchmark that it is held against. Of several rows the worst counts, or with ``best`` the best.
    """

    says: str
    benchmark: str
    rows: Callable[[Row, dict[str, Any]], bool]
    field: str  # ratio or share
    least: bool
    bound: float
    best: bool = False


def starts(*words: str) -> Callable[[Row, dict[str, Any]], bool]:
    """Rows whose name starts with one of ``words``."""
    return lambda row, _: row.what.startswith(words)


TARGETS = (
    Target(
        "training TSM, c = 64, teacher-forced, targets per second over plain eager windows",
        "train",
        starts("train tsm, teacher-forced: targets"),
        "ratio",
        True,
        2.2,
    ),
    Target(
        "training TSM, c = 64, free-running, targets per second over plain eager windows",
        "train",
        starts("train tsm, free-running: targets"),
        "ratio",
        True,
        1.4,
    ),
    Target(
        "share of the CPU's float32 matrix products in training TSM, both stages",
        "train",
        starts("train tsm, teacher-forced: targets", "train tsm, free-running: targets"),
        "share",
        True,
        0.55,
    ),
    Target(
        "training rtsm free-running, updates per CPU second over those of tsm+energy+direct at equal batch",
        "train",
        starts("train rtsm, free-running, two samples, beside"),
        "ratio",
        True,
        2.5,
    ),
    Target(
        "training on AVX2 alone, any model, updates per second over float32",
        "avx2",
        starts("train "),
        "ratio",
        True,
        0.95,
    ),
    Target(
        "imagined over MuJoCo's steps per second, pushing, c = 64, same core, best of all batches",
        "rollout",
        starts("imagine with tsm, "),
        "ratio",
        True,
        5,
        best=True,
    ),
    Target(
        "100 latent plans, T = 50, over plain eager, per iteration",
        "plan",
        lambda row, r: (
            r["configuration"] == "plain"
            and r["planner"] == "adam"
            and r["search_space"] == "latent"
        ),
        "ratio",
        True,
        2,
    ),
    Target(
        "collecting over a loop of env.step",
        "collect",
        lambda row, r: r["configuration"] == "env.step" and r["metric"] == "steps_per_second",
        "ratio",
        True,
        8,
    ),
    Target(
        "share of raw mujoco.rollout in collecting",
        "collect",
        lambda row, r: r["metric"] == "steps_per_second",
        "share",
        True,
        0.6,
    ),
    Target(
        "ten policies in one model over one, time",
        "policy",
        lambda row, r: r["configuration"] == "copies",
        "ratio",
        False,
        2.5,
    ),
    Target(
        "trainings, scores, CEM plans and policies of a seed, over two hours of two cores",
        "seed",
        lambda row, r: r["configuration"] == "a whole seed",
        "ratio",
        False,
        1,
    ),
    Target(
        "exponent of cost against horizon, targets and seeds",
        "growth",
        lambda row, r: r["configuration"] in ("horizon", "targets", "seeds"),
        "ratio",
        False,
        1.05,
    ),
)
MOST_GIB = 6


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument(
        "--publish", action="store_true", help="write docs/speed.md and figures/bench_growth"
    )
    found = measured()
    if not found:
        raise SystemExit("nothing was measured yet: python -m tsmlib bench")
    print(text([row for rows in found.values() for row, _ in rows]))
    print()
    for line in targets(found):
        print("  ".join(line))
    if options.parse_args().publish:
        publish(found)


def measured() -> Found:
    """The rows of each benchmark that has left a table in the form of ``_rounds``."""
    paths = {
        path.stem: path
        for path in sorted(folder().glob("*.csv"))
        if not path.stem.endswith("_rows")
    }
    names = [
        *(name for name in ORDER if name in paths),
        *(name for name in paths if name not in ORDER),
    ]
    return {name: load(paths[name]) for name in names if set(EXTRA) <= set(columns_of(paths[name]))}


def columns_of(path: Path) -> list[str]:
    """The first line of a table; one in another form has no place here."""
    return path.read_text().partition("\n")[0].split(",")


def targets(found: Found) -> list[tuple[str, str, str, str]]:
    """Of each figure: what, what was asked, what was found, the verdict."""
    lines = []
    for target in TARGETS:
        rows = [
            row for row, columns in found.get(target.benchmark, []) if target.rows(row, columns)
        ]
        rows = [row for row in rows if target.field == "ratio" or row.share is not None]
        percent = target.field == "share"
        asked = f"at {'least' if target.least else 'most'} {f'{target.bound:.0%}' if percent else f'{target.bound:g}'}"
        if not rows:
            lines.append((target.says, asked, "", "not measured"))
            continue
        highest = target.least == target.best  # of the rows, which one counts
        chosen = (max if highest else min)(rows, key=lambda row: value_of(row, target.field))
        value = value_of(chosen, target.field)
        low, _, high = chosen.ratio
        words = f"{value:.1%}" if percent else f"{value:.4g} ({low:.4g} to {high:.4g})"
        reached = value >= target.bound if target.least else value <= target.bound
        lines.append(
            (
                target.says,
                asked,
                f"{words}: {chosen.what}",
                "reached" if reached else "**not reached**",
            )
        )
    peaks = [row for rows in found.values() for row, _ in rows if row.peak_bytes]
    if peaks:
        worst = max(peaks, key=lambda row: row.peak_bytes or 0)
        gib = (worst.peak_bytes or 0) / 2**30
        verdict = "reached" if gib < MOST_GIB else "**not reached**"
        lines.append(
            (
                "peak memory of anything",
                f"under {MOST_GIB} GiB",
                f"{gib:.2f} GiB: {worst.what}",
                verdict,
            )
        )
    return lines


def value_of(row: Row, name: str) -> float:
    """The median ratio, or the share of the limit."""
    return row.ratio[1] if name == "ratio" else float(row.share or 0.0)


def publish(found: Found) -> None:
    """Write docs/speed.md and the figure of growth."""
    lines = [
        *machines(found),
        "",
        *markdown(("figure", "asked", "measured", "verdict"), targets(found)),
        "",
    ]
    rows = []
    for name, some in found.items():
        for row, _ in some:
            low, middle, high = row.ratio
            verb = {"1/s": "x as fast", "s": "x as long"}.get(row.unit, "")
            ratio = (
                f"{figure(middle)}{verb} ({figure(low)} to {figure(high)})" if row.reference else ""
            )
            share = "" if row.share is None else f"{figure(100 * row.share)} % of {row.limit}"
            peak = "" if row.peak_bytes is None else f"{row.peak_bytes / 2**30:.2f} GiB"
            rows.append(
                (name, row.what, row.reference, ratio, share, peak, str(row.threads), str(row.n))
            )
    head = (
        "bench",
        "what",
        "reference",
        "ratio: median (lowest to highest)",
        "limit",
        "peak",
        "threads",
        "rounds",
    )
    lines += markdown(head, rows)
    if missing := [name for name in ORDER if name not in found]:
        lines += ["", f"Not measured: {', '.join(missing)}."]
    if (folder() / "growth_rows.csv").exists():
        plots.save(growth.draw(folder()), PICTURE.with_suffix(".png"))
        lines += ["", f"![How cost grows with the size of things](../figures/{PICTURE.name}.png)"]
    before, _, rest = DOCS.read_text().partition(MARKS[0])
    after = rest.partition(MARKS[1])[2]
    files.write_bytes(
        DOCS, "\n".join([before + MARKS[0], "", *lines, "", MARKS[1] + after]).encode()
    )
    print(DOCS.relative_to(runs.ROOT))


def machines(found: Found) -> list[str]:
    """What measured, a line for each; usually one."""
    about: dict[tuple[Any, ...], list[str]] = {}
    for name, rows in found.items():
        r = rows[0][1]
        about.setdefault(
            tuple(r[field] for field in ("processor", "cores", "torch", "date")), []
        ).append(name)
    return [
        f"{cpu}; {cores} cores; torch {version}; {date}: {', '.join(names)}."
        for (cpu, cores, version, date), names in about.items()
    ]


def markdown(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    """A table."""
    cells = [head, ("---",) * len(head), *rows]
    return ["| " + " | ".join(cell.replace("|", "/") for cell in line) + " |" for line in cells]


if __name__ == "__main__":
    main()
