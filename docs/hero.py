"""The animated picture at the top of README and two picture strips: ``python docs/hero.py`` writes figures/hero.webp,
figures/hero_best.png and figures/hero_median.png.

Plans through the shipped ``rtsm``, and for the strips through ``onestep``, for the first frozen targets of pushing: the
film is of the one with the median final distance by ``rtsm``, at half speed, left the rollout that the model predicted,
right the executed one; the strips are of the same target and of the one where ``rtsm`` ends nearest, by both models,
predicted above executed. Targets from which the object begins less than 0.1 m away are left out.
"""

import argparse
from pathlib import Path

import numpy as np

import tsmlib as tsm
from tsmlib.plots import animation, style
from tsmlib.planning.execution import Trial
from tsmlib.planning.tasks import Task
from tsmlib.storage.files import write_bytes
from tsmlib import zoo
from reproduction.results.planning import by_final_distance

LARGEST = 3_000_000  # bytes
WORDS = ("rtsm", "onestep")


def planned(task: Task, word: str) -> Trial:
    """Plans through a shipped model, executed; shown as predicted is the rollout of its mode."""
    net, prior = tsm.load_pretrained(word, env=task.env), tsm.load_pretrained("prior", env=task.env)
    space, past = tsm.LatentActions(prior, task.horizon), task.past(net.past_len)
    judge, screened = (
        (tsm.expected_predictor, 0.25) if net.stochastic else (tsm.model_predictor, 1.0)
    )
    plan = tsm.cem(
        judge(net, past),
        task.reward,
        space,
        len(task),
        candidates=96,
        screened=screened,
        progress=f"plans of {word}",
    )
    return tsm.execute(task, tsm.reevaluate(plan, tsm.model_predictor(net, past), task.reward))


def save_webp(film: np.ndarray, path: Path) -> None:
    """Write ``film`` (T, H, W, 3) uint8 as an animation that repeats, its last frame held for a second and a half."""
    made = animation(film, 25, form="WEBP", width=720, hold=1.5)
    if len(made) > LARGEST:
        raise ValueError(f"{path} would have {len(made):,} bytes, expected at most {LARGEST:,}")
    write_bytes(path, made)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--env", default="tsm/ReacherPush-v1")
    parser.add_argument("--targets", type=int, default=8)
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).resolve().parents[1] / "figures", help="a folder"
    )
    given = parser.parse_args()
    task = tsm.load_task(given.env).take(given.targets)
    trials = {zoo.method(word, "latent", "cem"): planned(task, word) for word in WORDS}
    ours = next(iter(trials.values()))
    order = by_final_distance(task, ours)
    median = order[len(order) // 2]
    save_webp(tsm.film(task, ours, median), given.out / "hero.webp")
    for word, target in (("best", order[0]), ("median", median)):
        style.save(media.strip(task, trials, target), given.out / f"hero_{word}")


if __name__ == "__main__":
    main()
