"""Few-shot adaptation: how well a model of the standard arm predicts and plans on a changed one, after few episodes.

    python benchmarks/adaptation/run.py --variants gain0.7 mass2 links0.12x0.11 --episodes 20 --seeds 0

For each variant and model: zero-shot; fine-tuned on so many episodes, all weights, the head alone, or the distribution
of the codes alone; a new model of the same episodes. Predictions are open loop after ten observed steps, on test
episodes of the variant (``study.adaptation``). Plans are by the cross-entropy method over codes of the standard arm's
prior, executed once, open loop, on frozen targets; --targets 0 leaves them out, and a later call with targets adds
them. Their candidates are judged by the mode and eight samples (judge: expectation), of a model without samples by its
one rollout; the gap is that of a return predicted from other samples. copies: symmetric ones that are trained on in
place of each episode, 0 where the arm has none or nothing is trained. A line in table.csv for each model; a line that
is there is not measured again, unless plans are wanted and those that it has were judged otherwise.
"""

from __future__ import annotations

import argparse
import fcntl
from functools import cache, partial
from pathlib import Path

import pandas as pd
import torch

import tsmlib as tsm
from tsmlib.envs import symmetry
from tsmlib.study import adaptation
from tsmlib.study.models import TrainedModel
from tsmlib.study.results import table
from tsmlib.trajectory import Trajectories

HERE = Path(__file__).resolve().parent
KEY = ["arm", "variant", "model", "way", "episodes", "copies", "seed"]
SEARCH, JUDGE = dict(candidates=96, elites=9, iterations=5, screened=0.25), "expectation"
held_out = cache(adaptation.held_out)


def measured(env: str, word: str, way: adaptation.Way, episodes: int, seed: int, given: argparse.Namespace) -> dict:
    """Numbers of one line."""
    data = adaptation.few(env, episodes, seed=seed) if episodes else None
    model, seconds = adaptation.adapted(word, env, way, data, seed=seed, share=given.share)
    test: tuple[Trajectories, Trajectories] = held_out(env, given.test)
    curves = adaptation.scored(model, env, test, seed=seed).against_horizon()
    found = {
        f"{name}_{steps}": f"{curves[metric][steps - 1]:.4g}"
        for name, metric in (("energy_score", "energy_score_noise"), ("nrmse", "nrmse"))
        for steps in adaptation.AHEAD
    }
    found |= {"test_episodes": len(test[0]), "train_seconds": f"{seconds:.0f}"}
    return found | (planned(env, model, given.targets, seed) if given.targets else {})


def planned(env: str, model: TrainedModel, targets: int, seed: int) -> dict:
    """Cost of plans on frozen targets, and the share that ends within the tolerance."""
    task = tsm.load_task(env).take(targets)
    space = tsm.LatentActions(prior(env), task.horizon)
    past, drawn = task.past(model.past_len), 1000 + seed  # not the planner's; of the judges eight times that
    predict = tsm.expected_predictor(model, past, seed=drawn)
    plan = tsm.cem(predict, task.reward, space, len(task), seed=seed, **SEARCH)
    plan = tsm.reevaluate(plan, tsm.fresh_predictor(model, past, seed=drawn), task.reward)
    trial = tsm.execute(task, plan)
    assert trial.success is not None
    return {
        "cost": f"{-trial.executed_return.mean():.4g}", "success": f"{trial.success.float().mean():.3g}",
        "gap": f"{trial.gap.abs().mean():.3g}", "targets": len(task), "judge": JUDGE,
    }  # fmt: skip


@cache
def prior(env: str) -> tsm.ActionPrior:
    return tsm.load_pretrained("prior", env=env)  # type: ignore[return-value]


def copies(env: str, episodes: int) -> int:
    """Symmetric copies in place of each of the episodes that are trained on; 0: the episodes as they are."""
    n = symmetry.copies(env) if episodes else 0
    return n if n > 1 else 0


def summary(lines: pd.DataFrame) -> str:
    """Means over seeds of every way, with half the 95 % t interval where there are several."""
    rows = []
    about = [*KEY[:-1], "judge"]  # none where nothing was planned
    for keys, part in lines.assign(judge=lines["judge"].fillna("") if "judge" in lines else "").groupby(
        about, sort=False
    ):
        row = dict(zip(about, keys, strict=True))
        for name in ("energy_score_10", "energy_score_80", "nrmse_10", "nrmse_80", "cost", "success"):
            known = part[name].dropna().astype(float) if name in part else pd.Series(dtype=float)
            row[name] = table.spell(known, "{:.3g} ± {:.2g}") if len(known) else ""
        rows.append({**row, "seeds": len(part)})
    return table.markdown(pd.DataFrame(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", default="tsm/ReacherPush-v1")
    parser.add_argument("--variants", nargs="+", choices=adaptation.VARIANTS, default=list(adaptation.VARIANTS))
    parser.add_argument("--models", nargs="+", choices=adaptation.BUDGETS, default=["rtsm", "lstm"])
    parser.add_argument("--ways", nargs="+", choices=adaptation.WAYS, default=list(adaptation.WAYS))
    parser.add_argument("--episodes", nargs="+", type=int, default=[5, 20, 80])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--targets", type=int, default=0)
    parser.add_argument("--test", type=int, default=200, help="test episodes")
    parser.add_argument("--share", type=float, default=1.0, help="of the updates")
    parser.add_argument("--out", type=Path, default=HERE / "table.csv")
    given = parser.parse_args()
    torch.set_num_threads(1)
    for seed in given.seeds:
        for name in given.variants:
            env = adaptation.changed(given.arm, name)
            for word in given.models:
                for way in (way for way in adaptation.ways(word) if way in given.ways):
                    for n in [0] if way == "zero-shot" else given.episodes:
                        line = dict(zip(KEY, (given.arm, name, word, way, n, copies(env, n), seed), strict=True))
                        add(given.out, line, given.targets > 0, partial(measured, env, word, way, n, seed, given))
    print(summary(pd.read_csv(given.out)))


def add(out: Path, line: dict, plans: bool, measure: partial) -> None:
    """Measure and write a line, unless it is there, with plans if they are wanted."""
    if len(known := same(out, line)) and not (plans and (known.get("judge", pd.Series([""])) != JUDGE).all()):
        return
    print(line | (found := measure()), flush=True)
    with Path(__file__).open() as lock:  # several processes may add lines
        fcntl.flock(lock, fcntl.LOCK_EX)
        lines = pd.read_csv(out) if out.exists() else pd.DataFrame(columns=KEY)
        lines = lines.drop(same(out, line).index)
        pd.concat([lines, pd.DataFrame([line | found])]).to_csv(out, index=False)


def same(out: Path, line: dict) -> pd.DataFrame:
    """The lines of that key."""
    lines = pd.read_csv(out) if out.exists() else pd.DataFrame(columns=KEY)
    return lines[(lines[KEY] == pd.Series(line)).all(axis=1)]


if __name__ == "__main__":
    main()
