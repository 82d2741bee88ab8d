"""Quality against training time: what the headers of trained models say, a line for each stage of each training.

    python benchmarks/settings/curve.py data/pretrained/ReacherPush

adds the models of a folder to the table; a line that is there already is not added again. Losses are those at the
best validation; losses of different models and stages do not compare.
"""

from __future__ import annotations

import argparse
import csv
from itertools import cycle
from pathlib import Path

from tsmlib.storage import artifacts
from tsmlib.study import zoo

HERE = Path(__file__).resolve().parent
COLUMNS = ("env", "model", "seed", "symmetries", "muon", "cpu_seconds", "stage", "updates", "training", "validation")


def lines(path: Path) -> list[dict[str, str]]:
    """The lines of one model."""
    header = artifacts.read_header(path)
    schedule = zoo.stated(header["schedule"])
    found = []
    for (stage, curve), planned in zip(header["curves"].items(), cycle(schedule), strict=False):  # of each decoder
        best = min(range(len(curve["step"])), key=lambda i: curve["validation"][i])
        found.append({
            "env": header["fingerprint"]["env"], "model": header["model"], "seed": str(header["seed"]),
            "symmetries": str(header.get("symmetries", 1)), "muon": f"{planned['muon']:g}",
            "cpu_seconds": f"{header['seconds']:.0f}", "stage": stage, "updates": str(curve["step"][-1]),
            "training": f"{curve['train'][best]:.3g}", "validation": f"{curve['validation'][best]:.3g}",
        })  # fmt: skip
    return found


def is_dynamics(path: Path) -> bool:
    """Whether a file is of a dynamics model, as opposed to the prior and to policies."""
    header = artifacts.read_header(path)
    return "search_space" not in header and header.get("model") in zoo.words("dynamics", "ablation", "choice")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, help="of trained models")
    parser.add_argument("--out", type=Path, default=HERE / "curve.csv")
    arguments = parser.parse_args()
    known = list(csv.DictReader(arguments.out.open(newline=""))) if arguments.out.exists() else []
    for folder in arguments.folders:
        for path in sorted(folder.glob("*.safetensors")):
            if is_dynamics(path):
                known += [line for line in lines(path) if line not in known]
    with arguments.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(known)


if __name__ == "__main__":
    main()
