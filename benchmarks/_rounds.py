"""Base of the benchmarks: ways timed in turn, peak memory, matrix products alone, and rows of one table.

Absolute times on a machine that others use mean little: its clock and its load change within seconds. So every figure
is a ratio of two ways that were timed in turn, round by round, and is stated as the median over rounds with the lowest
and the highest.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from tqdm.auto import tqdm

from tsmlib.storage import tables
from tsmlib.storage.provenance import provenance
from tsmlib.study import runs

Ways = Mapping[str, Callable[[], object]]
EXTRA = (
    *("what", "reference", "ratio_lowest", "ratio_median", "ratio_highest", "limit", "share", "peak_bytes"),
    *("processor", "cores", "threads", "torch", "date"),
)  # columns of a benchmark's table beyond those of every table
SGEMM = "sgemm of the same shapes"
HEAD = ("what", "reference", "value", "ratio: median (lowest to highest)", "share of the limit", "peak memory", "n")


@dataclass(frozen=True)
class Row:
    """One measurement.

    value, unit: the median over rounds, for orientation. 1/s: the ratios say how many times as fast as the reference;
    s: how many times as long; exponent: of a cost that grows as size^exponent, the reference is linear growth.
    ratio: value over the reference's, lowest, median and highest over ``n`` rounds. limit, share: what no
    implementation on this machine could pass, and how much of its speed was reached. peak_bytes: the most memory that
    the process had while this way ran, libraries included. columns: env, model, ... as in every table.
    """

    what: str
    reference: str
    value: float
    unit: str
    ratio: tuple[float, float, float]
    n: int
    limit: str = ""
    share: float | None = None
    peak_bytes: int | None = None
    threads: int = 1
    columns: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(
        cls, what: str, own: np.ndarray, reference: str, others: np.ndarray | float, unit: str = "1/s", *,
        limit: str = "", bound: np.ndarray | None = None, peak: int | None = None, threads: int = 0, **columns: Any,
    ) -> Row:  # fmt: skip
        """From what each round gave, (n,) each and in ``unit``: this way, its reference, and its limit ``bound``."""
        share = None
        if bound is not None:
            share = float(np.median(own / bound if unit == "1/s" else bound / own))
        return cls(
            what, reference, float(np.median(own)), unit, spread(own / others), len(own), limit, share, peak,
            threads or torch.get_num_threads(), columns,
        )  # fmt: skip

    def cells(self) -> tuple[str, ...]:
        """What a person reads, under HEAD."""
        low, middle, high = self.ratio
        ratio = f"{figure(middle)} ({figure(low)} to {figure(high)})" if self.reference else ""
        share = "" if self.share is None else f"{figure(100 * self.share)} % of {self.limit}"
        peak = "" if self.peak_bytes is None else f"{self.peak_bytes / 2**30:.2f} GiB"
        value = f"{figure(self.value)} {self.unit}".strip()
        return (self.what, self.reference, value, ratio, share, peak, str(self.n))


def spread(values: np.ndarray) -> tuple[float, float, float]:
    """Lowest, median and highest."""
    return float(np.min(values)), float(np.median(values)), float(np.max(values))


def figure(value: float) -> str:
    """Three digits."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def parser(about: str | None, *, rounds: int) -> argparse.ArgumentParser:
    """With the options that every benchmark has."""
    made = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--rounds", type=int, default=rounds, help=f"each way once a round (default {rounds})")
    made.add_argument("--threads", type=int, default=1, help="of torch (default 1)")
    return made


def parsed(made: argparse.ArgumentParser) -> argparse.Namespace:
    """The options given; torch has its threads."""
    arguments = made.parse_args()
    torch.set_num_threads(arguments.threads)
    return arguments


# Time and memory ------------------------------------------------------------------------------------------------------


def interleaved(ways: Ways, rounds: int, *, warm: bool = True, progress: str = "rounds") -> dict[str, np.ndarray]:
    """Seconds (rounds,) of each way, all of them in turn in every round, after one call of each that does not count.

    Every other round goes through them backwards, so that none always follows the same one. A way that returns a float
    says itself how many seconds count.
    warm: whether that call is made; not where ``peak_bytes`` has called them.
    """
    if warm:
        for call in ways.values():
            call()
    seconds: dict[str, list[float]] = {way: [] for way in ways}
    for i in tqdm(range(rounds), desc=progress, leave=False):
        for way, call in list(ways.items())[:: -1 if i % 2 else 1]:
            began = time.perf_counter()
            own = call()
            seconds[way].append(own if isinstance(own, float) else time.perf_counter() - began)
    return {way: np.array(taken) for way, taken in seconds.items()}


def on_the_cpu(call: Callable[[], object]) -> Callable[[], float]:
    """The seconds that ``call`` takes of the CPU, whatever else it computes."""

    def timed() -> float:
        began = time.process_time()
        call()
        return time.process_time() - began

    return timed


def peak_bytes(call: Callable[[], object]) -> int:
    """The most memory that this process has while ``call`` runs; where Linux does not tell, that it ever had."""
    status, reset = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    if not reset.exists():
        import resource  # not on Windows

        call()
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    reset.write_text("5")  # the highest so far is forgotten
    call()
    line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    return 1024 * int(line.split()[1])


def bandwidth(n_bytes: int = 2**28) -> Callable[[], object]:
    """A way that reads ``n_bytes`` from memory and writes as many."""
    source, target = torch.ones(n_bytes // 4), torch.empty(n_bytes // 4)
    return lambda: target.copy_(source)


# Matrix products ------------------------------------------------------------------------------------------------------


class Products(TorchDispatchMode):
    """Within it every matrix product is noted: ``shapes`` (b, m, k, n) -> how many of b products (m, k) (k, n).

    A convolution counts as the product of its unfolded input with its weights.
    """

    def __init__(self) -> None:
        super().__init__()
        self.shapes: Counter[tuple[int, int, int, int]] = Counter()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = function(*args, **(kwargs or {}))
        name = function.overloadpacket.__name__
        if name in ("mm", "addmm", "bmm", "baddbmm"):
            left, right = (part.shape for part in args[-2:])
            self.shapes[(left[0] if len(left) == 3 else 1, left[-2], left[-1], right[-1])] += 1
        elif name == "convolution":
            self._convolution(result.shape, args[1].shape, 1)
        elif name == "convolution_backward":
            self._convolution(args[0].shape, args[2].shape, sum(args[-1][:2]))
        return result

    def _convolution(self, out: Sequence[int], weight: Sequence[int], count: int) -> None:
        self.shapes[(1, out[0] * out[2], weight[1] * weight[2], weight[0])] += count

    @classmethod
    def of(cls, call: Callable[[], object]) -> Products:
        """Those of one call."""
        with cls() as found:
            call()
        return found

    def __sub__(self, other: Products) -> Products:
        """What is left without those of ``other``."""
        left = Products()
        left.shapes = self.shapes - other.shapes
        return left

    @property
    def flops(self) -> int:
        """Multiplications and additions."""
        return sum(2 * b * m * k * n * count for (b, m, k, n), count in self.shapes.items())

    def alone(self) -> Callable[[], None]:
        """A way that does these products in float32 and nothing else, on operands that are there already."""
        drawn = [
            (count, torch.randn(b, m, k), torch.randn(b, k, n), torch.empty(b, m, n))
            for (b, m, k, n), count in self.shapes.items()
        ]
        operands = [
            (count, torch.bmm, a, b, out) if len(a) > 1 else (count, torch.mm, a[0], b[0], out[0])
            for count, a, b, out in drawn
        ]

        def run() -> None:
            for count, product, a, b, out in operands:
                for _ in range(count):
                    product(a, b, out=out)

        return run


# Tables ---------------------------------------------------------------------------------------------------------------


def folder() -> Path:
    """Where benchmarks leave their tables: runs/bench."""
    return runs.resolve("bench").dir.parents[1] / "bench"


def machine() -> dict[str, Any]:
    """What measured, without its name."""
    return {
        "processor": provenance()["cpu"], "cores": os.cpu_count(), "torch": torch.__version__,
        "date": f"{datetime.now(UTC):%Y-%m-%d}",
    }  # fmt: skip


def save(name: str, rows: Sequence[Row]) -> None:
    """Print ``rows`` and write them to runs/bench/<name>.csv."""
    print(text(rows))
    table, about = [], machine()
    for row in rows:
        low, middle, high = row.ratio
        measured = {
            "what": row.what, "reference": row.reference, "ratio_lowest": low, "ratio_median": middle,
            "ratio_highest": high, "limit": row.limit, "threads": row.threads, "value": row.value, "unit": row.unit,
            "n": row.n, "share": row.share, "peak_bytes": row.peak_bytes,
        }  # fmt: skip
        table.append({**row.columns, **measured, **about})
    path = folder() / f"{name}.csv"
    tables.save(path, table, extra=EXTRA)
    print(path)


def load(path: Path) -> list[tuple[Row, dict[str, Any]]]:
    """The rows of one benchmark, each with the fields that it stands in."""
    found = []
    for r in tables.records(tables.load(path)):
        share, peak = (None if r[name] == "" else r[name] for name in ("share", "peak_bytes"))
        ratio = (r["ratio_lowest"], r["ratio_median"], r["ratio_highest"])
        row = Row(
            r["what"], r["reference"], r["value"], r["unit"], ratio, r["n"], r["limit"], share, peak, r["threads"]
        )
        found.append((row, r))
    return found


def text(rows: Sequence[Row]) -> str:
    """A table for a terminal."""
    cells = [HEAD, *(row.cells() for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in cells)
