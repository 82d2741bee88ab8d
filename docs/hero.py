"""The animated picture at the top of README: ``python docs/hero.py`` writes figures/hero.webp.

A plan through the shipped ``rtsm`` for the first frozen targets of pushing; shown is the one with the median final
distance, at half speed, left the rollout that the model predicted, right the executed one.
"""

import argparse
from pathlib import Path

import numpy as np

import tsmlib as tsm
from tsmlib.figures import animation
from tsmlib.storage.files import write_bytes
from tsmlib.study.results.planning import by_final_distance

LARGEST = 3_000_000  # bytes


def frames(env: str, targets: int, model: Path | None) -> np.ndarray:
    """The film (T, height, width, 3). model: a file in place of the shipped one."""
    net = tsm.load_model(model, tsm.RecurrentTSM) if model else tsm.load_pretrained("rtsm", env=env)
    task = tsm.load_task(env).take(targets)
    space = tsm.LatentActions(tsm.load_pretrained("prior", env=env), task.horizon)
    past, options = task.past(net.past_len), dict(candidates=96, screened=0.25, progress="planning")
    plan = tsm.cem(tsm.expected_predictor(net, past), task.reward, space, targets, **options)
    plan = tsm.reevaluate(plan, tsm.model_predictor(net, past), task.reward)  # shown is the mode
    trial = tsm.execute(task, plan)
    order = by_final_distance(task, trial)
    return tsm.film(task, trial, order[len(order) // 2])


def save_webp(film: np.ndarray, path: Path) -> None:
    """Write ``film`` (T, H, W, 3) uint8 as an animation that repeats, its last frame held for a second and a half."""
    made = animation(film, 25, form="WEBP", width=720, hold=1.5)
    if len(made) > LARGEST:
        raise ValueError(f"{path} would have {len(made):,} bytes, expected at most {LARGEST:,}")
    write_bytes(path, made)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--env", default="tsm/ReacherPush-v1")
    parser.add_argument("--targets", type=int, default=8)
    parser.add_argument("--model", type=Path, help="a model file in place of the shipped rtsm")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "figures" / "hero.webp")
    given = parser.parse_args()
    save_webp(frames(given.env, given.targets, given.model), given.out)
