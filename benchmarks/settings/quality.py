"""Quality of trained models against the time that training took: predictions, plans and physical violations.

    python benchmarks/settings/quality.py measure runs/paper/seed0/settings/ReacherPush/*.safetensors
    python benchmarks/settings/quality.py together benchmarks/settings/models/rtsm_*.safetensors
    python benchmarks/settings/quality.py table
    python benchmarks/settings/quality.py figure

measure adds a line to quality.csv for each file, trained by ``budgets.py`` or shipped (``data/pretrained``); a line
that is there already is not made again. Nothing is taken from the test split:

    energy, nrmse   10 and 80 steps ahead and the mean over 90, of 200 fresh episodes, 32 samples of each; residual
                    noise is fitted on the validation split
    cost            minus the executed return of plans for the validation targets: cross-entropy method over codes of
                    the prior, 96 candidates x 10, judged by the mode, open loop, planner seed 0
    gap             mean size of predicted minus executed return, predicted by 32 samples that had no part in planning
    violations      share of those samples' steps that violate physics

together prints the same of several models as one.

table prints the lines of training seed 0 as Markdown, with the cost of the recurrent TSM minus that of each model
trained as long, paired by target with half the 95 % t interval over targets, and what a doubling of the time buys, from
each line of a model to the next. Of a training with several seeds follow means with half the 95 % t interval over
seeds, and each model with codes against every baseline, paired by seed. lines prints the lines of training seed 0 of
any environments, and the same of several seeds. figure draws all lines into figures/training_time.
"""

from __future__ import annotations

import argparse
from itertools import product
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
import torch

from tsmlib import study
from tsmlib.envs.spec import EnvSpec
from tsmlib.evaluation import exploitation, prediction
from tsmlib.figures import prediction as drawings
from tsmlib.figures import style
from tsmlib.models.base import DynamicsModel
from tsmlib.models.mixture import Mixture
from tsmlib.planning.execution import execute
from tsmlib.planning.planners import cem, reevaluate
from tsmlib.planning.predictors import fresh_predictor, model_predictor
from tsmlib.planning.search_spaces import LatentActions
from tsmlib.storage import artifacts
from tsmlib.study import runs, zoo
from tsmlib.study.data import dataset, random_data
from tsmlib.study.models import load_prior
from tsmlib.study.results import table

HERE = Path(__file__).resolve().parent
EPISODES = 200  # fresh ones
FRESH_SEED = 2_000_004  # of episodes that no training, choice or published score has seen
MEASURES = {  # column -> title and unit; of each a smaller value is better
    "energy_10": "energy score, 10 steps", "energy_80": "energy score, 80 steps", "energy": "energy score, mean",
    "nrmse_10": "nRMSE, 10 steps", "nrmse_80": "nRMSE, 80 steps", "cost": "cost of plans (m)", "gap": "gap (m)",
    "violations": "violations (share of steps)",
}  # fmt: skip
KEY = ["env", "model", "seed", "seconds", "muon"]
SCORES = ("energy_10", "energy_80")  # set against those of the best baseline


def load(path: Path) -> DynamicsModel:
    """The model in a file, of the class that the file names."""
    return cast(DynamicsModel, artifacts.load_model(path, zoo.find(artifacts.read_header(path)["model"]).load()))


def described(path: Path) -> dict[str, object]:
    """What the header of a model says of its training; seconds are nominal, of its stages on the reference machine."""
    header = artifacts.read_header(path)
    env = header["fingerprint"]["env"]
    whole = zoo.find(header["model"]).schedule(EnvSpec.parse(env))
    schedule = zoo.stated(header.get("schedule", [stage.stated() for stage in whole]))
    share = round(schedule[0]["steps"] / whole[0].steps, 4)  # updates are in tens
    curves = list(header["curves"].values())[: len(schedule)]
    return {
        "env": env, "model": header["model"], "seed": header["seed"],
        "seconds": round(share * zoo.BUDGET[EnvSpec.parse(env).standard.name]), "muon": schedule[0]["muon"],
        "decay": schedule[0]["weight_decay"],
        "updates": sum(curve["step"][-1] for curve in curves),
        "cpu_seconds": round(sum(curve["seconds"][-1] for curve in curves)),
        "validation": min(curves[-1]["validation"]),
    }  # fmt: skip


def predicted(net: DynamicsModel, env: str, n_episodes: int) -> dict[str, float]:
    """Scores of predictions, of fresh episodes."""
    run = runs.resolve("03_predict", scale="paper", seed=0)
    fresh = random_data(env, n_episodes, seed=FRESH_SEED)
    found = prediction.score(net, net.features, fresh, dataset(run, env, "validation"), samples=32, progress="scores")
    mean = found.against_horizon()
    energy, nrmse = mean["energy_score_noise"], mean["nrmse"]
    return {
        "energy_10": float(energy[9]), "energy_80": float(energy[79]), "energy": float(energy.mean()),
        "nrmse_10": float(nrmse[9]), "nrmse_80": float(nrmse[79]), "coverage80": float(mean["coverage80"].mean()),
    }  # fmt: skip


def planned(net: DynamicsModel, env: str, n_targets: int) -> dict[str, object]:
    """What plans for validation targets cost, predict and violate."""
    task = study.load_task(env, "validation").take(n_targets)
    past = task.past(net.past_len)
    space = LatentActions(load_prior(runs.resolve("05_control", scale="laptop"), env), task.horizon)
    plan = cem(
        model_predictor(net, past), task.reward, space, len(task), candidates=96, elites=9, iterations=10, seed=0
    )
    plan = reevaluate(plan, fresh_predictor(net, past, seed=1), task.reward)
    trial = execute(task, plan)
    found: dict[str, object] = {
        "targets": len(task), "cost": -float(trial.executed_return.mean()),
        "gap": float((plan.predicted_return - trial.executed_return).abs().mean()),
        "within": float((trial.final_distance < task.tolerance).float().mean()),
        "violations": float("nan"), "costs": " ".join(f"{-value:.3f}" for value in trial.executed_return.tolist()),
    }  # fmt: skip
    if task.name == "push":
        shares = exploitation.shares(task.start, plan.states.numpy(), env)
        found["violations"] = float(shares["violations"].mean())
    return found


def measured(path: Path, n_targets: int, n_episodes: int) -> dict[str, object]:
    """A line of the table."""
    said = described(path)
    env = str(said["env"])
    net = load(path)
    return said | predicted(net, env, n_episodes) | planned(net, env, n_targets)


def doublings(lines: pd.DataFrame) -> pd.DataFrame:
    """What a doubling of the training time changes, as a share, from each line to the next of the same model."""
    found = []
    for (env, model), group in lines.groupby(["env", "model"], sort=False):
        group = group.sort_values("seconds")
        for before, after in zip(group.iloc[:-1].itertuples(), group.iloc[1:].itertuples(), strict=True):
            times = np.log2(after.seconds / before.seconds)
            ratios = {name: getattr(after, name) / getattr(before, name) for name in MEASURES}
            changes = {name: ratio ** (1 / times) - 1 for name, ratio in ratios.items()}
            found.append({"env": env, "model": model, "from": before.seconds, "to": after.seconds} | changes)
    return pd.DataFrame(found)


def further(lines: pd.DataFrame, score: str, times: tuple[int, ...] = (4, 16, 64)) -> pd.DataFrame:
    """A score after ``times`` the longest training, and what a doubling would change there, if what a doubling brings
    goes on to fall as it did between the last three lines of each model, by the same factor for each quadrupling."""
    found = []
    for model, group in lines.groupby("model", sort=False):
        group = group.sort_values("seconds").tail(3)
        seconds, values = group["seconds"].to_numpy(float), group[score].to_numpy(float)
        slopes = np.diff(np.log(values)) / np.diff(np.log2(seconds))  # of each doubling, as a logarithm
        if len(slopes) < 2 or not 0 < (factor := slopes[1] / slopes[0]) < 1:
            continue  # nothing that slows down
        for each in times:
            steps = np.arange(1, round(np.log2(each) / 2) + 1)  # quadruplings
            later = np.exp(2 * slopes[1] * (factor**steps).sum())
            found.append({
                "model": model, "seconds": round(each * seconds[-1]), MEASURES[score]: values[-1] * later,
                "a doubling there": np.exp(slopes[1] * factor ** steps[-1]) - 1,
            })  # fmt: skip
    return pd.DataFrame(found)


def over_the_best(lines: pd.DataFrame) -> pd.DataFrame:
    """Energy scores of models with codes over that of the best other model trained as long, which is named."""
    coded, found = zoo.words(cls=zoo.CODED), []
    for (env, seconds), group in lines.groupby(["env", "seconds"]):
        own, others = (group[group["model"].isin(coded) == given].set_index("model") for given in (True, False))
        for model in own.index if len(others) else ():
            ratios = {
                MEASURES[name]: f"{own[name][model] / others[name].min():.2f} ({others[name].idxmin()})"
                for name in SCORES
            }
            found.append({"env": env, "seconds": seconds, "model": model} | ratios)
    return pd.DataFrame(found)


def several(lines: pd.DataFrame) -> pd.DataFrame:
    """The lines of those trainings that were made with more than one seed."""
    return lines[lines.groupby(["env", "model", "seconds", "muon", "decay"])["seed"].transform("nunique") > 1]


def over_seeds(lines: pd.DataFrame) -> pd.DataFrame:
    """Each training as texts, mean and half the 95 % t interval over its seeds."""
    groups = lines.groupby(["env", "model", "seconds"])
    return pd.DataFrame([
        {"env": env, "model": model, "seconds": seconds, "seeds": len(group)}
        | {title: table.spell(group[name]) for name, title in MEASURES.items()}
        | {"80 % coverage": table.spell(100 * group["coverage80"], "{:.0f} ± {:.0f} %")}
        | {"within 5 cm": table.spell(100 * group["within"], "{:.0f} ± {:.0f} %")}
        for (env, model, seconds), group in groups
    ])  # fmt: skip


def against_baselines(lines: pd.DataFrame) -> pd.DataFrame:
    """Models with codes against each other model trained as long, paired by seed, as texts.

    Ratios of energy scores and of the gap, differences of what plans cost and of violations; mean and half the 95 % t
    interval over the seeds that both have.
    """
    coded, found = zoo.words(cls=zoo.CODED), []
    for (env, seconds), group in lines.groupby(["env", "seconds"]):
        each = {model: own.set_index("seed") for model, own in group.groupby("model")}
        for model, other in product([word for word in each if word in coded], [w for w in each if w not in coded]):
            own, best = each[model].align(each[other], join="inner", axis=0)
            if len(own) > 1:
                ratios = {
                    f"{MEASURES[name]}, ratio": table.spell(own[name] / best[name], "{:.2f} ± {:.2f}")
                    for name in (*SCORES, "gap")
                }
                found.append({
                    "env": env, "seconds": seconds, "model": model, "against": other, "seeds": len(own), **ratios,
                    "cost, difference": table.spell(own["cost"] - best["cost"], "{:+.2f} ± {:.2f}"),
                    "violations, difference (%)": table.spell(
                        100 * (own["violations"] - best["violations"]), "{:+.1f} ± {:.1f}"
                    ),
                })  # fmt: skip
    return pd.DataFrame(found)


def seed_tables(every: pd.DataFrame) -> list[str]:
    """Tables of trainings of one environment with several seeds, as Markdown; none without any."""
    if not len(lines := several(every)):
        return []
    return [
        "Several training seeds, mean and half the 95 % t interval over them:",
        table.markdown(_known(over_seeds(lines))),
        "Models with codes against each baseline trained as long, paired by seed:",
        table.markdown(_known(against_baselines(lines))),
    ]


def _known(texts: pd.DataFrame) -> pd.DataFrame:
    """Without the environment, and without measures that it has nothing of."""
    nothing = [name for name in texts if texts[name].astype(str).str.contains("nan").all()]
    return texts.drop(columns=["env", *nothing])


def spelled(lines: pd.DataFrame) -> pd.DataFrame:
    """Each line as texts; measures that it has nothing of are left out."""
    measures = {name: title for name, title in MEASURES.items() if lines[name].notna().any()}
    return lines[["env", "model", "seconds", "cpu_seconds", "updates", "muon", "decay"]].assign(
        **{title: lines[name].map("{:.3g}".format) for name, title in measures.items()},
        **{"80 % coverage": lines["coverage80"].map("{:.0%}".format)},
        **{"within 5 cm": lines["within"].map("{:.0%}".format)},
    )


def tables(every: pd.DataFrame) -> str:
    """All tables, as Markdown."""
    lines = every[every["seed"] == 0]
    values, changes = lines.sort_values(["env", "model", "seconds"], kind="stable"), doublings(lines)
    costs = {
        (line.env, line.model, line.seconds): np.array(str(line.costs).split(), float) for line in values.itertuples()
    }
    minus = [
        "" if model == zoo.OURS or (ours := costs.get((env, zoo.OURS, seconds))) is None
        else table.spell(ours - own, "{:+.2f} ± {:.2f}") for (env, model, seconds), own in costs.items()
    ]  # fmt: skip
    parts = [table.markdown(spelled(values).drop(columns="env").assign(**{f"cost of {zoo.OURS} minus this": minus}))]
    if not changes.empty:
        each = changes[["model", "from", "to"]].assign(
            **{title: changes[name].map("{:+.0%}".format) for name, title in MEASURES.items()}
        )
        parts += [
            "Energy scores over that of the best baseline trained as long, in brackets:",
            table.markdown(over_the_best(lines).drop(columns="env")),
            "A doubling of the time changes these by:",
            table.markdown(each),
            "If that goes on to fall as it did, by the same factor for each quadrupling (models whose changes do not "
            "fall are left out):",
            *(table.markdown(_spelled_further(further(lines, score), score)) for score in ("energy", "energy_80")),
        ]
    parts += seed_tables(every)
    return "\n\n".join(parts)


def _spelled_further(found: pd.DataFrame, score: str) -> pd.DataFrame:
    """``further`` as texts, a line per model."""
    return pd.DataFrame([
        {"model": model} | {
            f"{MEASURES[score]} after {line['seconds']:,} s (a doubling)":
                f"{line[MEASURES[score]]:.3f} ({line['a doubling there']:+.0%})"
            for line in own.to_dict("records")
        }
        for model, own in found.groupby("model", sort=False)
    ])  # fmt: skip


def stamp(lines: pd.DataFrame) -> str:
    """What the figure's lines are of, below it: training seeds, networks, episodes and targets."""
    several_of, targets = several(lines), ", ".join(map(str, sorted(set(lines["targets"]))))
    more = ", ".join(f"{seconds:g} s" for seconds in sorted(set(several_of["seconds"])))
    seeds = ", ".join(map(str, sorted(set(several_of["seed"]))))
    models = ", ".join(zoo.look(model).name for model in dict.fromkeys(several_of["model"]))
    return (
        f"{EnvSpec.parse(str(lines['env'].iloc[0])).name}, training seed 0"
        + f"; small marks: the other training seeds of {seeds}, after {more}, of {models}" * bool(more)
        + f"; one network each; predictions: n = {EPISODES} fresh episodes, plans and "
        f"violations: n = {targets} validation targets"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("measure", "together", "table", "lines", "figure"))
    parser.add_argument("files", nargs="*", type=Path, help="trained models")
    parser.add_argument("--targets", type=int, default=100, help="of validation (default 100)")
    parser.add_argument(
        "--episodes", type=int, default=EPISODES, help="fresh ones, to score predictions of (default 200)"
    )
    parser.add_argument("--out", type=Path, default=HERE / "quality.csv", help="default quality.csv beside this script")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.what in ("measure", "together") and not given.files:
        parser.error(f"{given.what} wants files of models, such as data/pretrained/ReacherPush/rtsm.safetensors")
    if given.what == "together":
        net, env = Mixture(map(load, given.files)), str(described(given.files[0])["env"])
        print({**predicted(net, env, given.episodes), **planned(net, env, given.targets), "costs": ""})
    for path in given.files if given.what == "measure" else ():
        known = pd.read_csv(given.out) if given.out.exists() else pd.DataFrame(columns=[*KEY, "decay"])
        said = described(path)
        if (known[[*KEY, "decay"]] == [said[name] for name in (*KEY, "decay")]).all(axis=1).any():
            print(f"{path}: measured already")
            continue
        line = measured(path, given.targets, given.episodes)
        known = pd.read_csv(given.out) if given.out.exists() else pd.DataFrame()  # another process may have added some
        pd.concat([known, pd.DataFrame([line])]).to_csv(given.out, index=False, float_format="%.4g")
        print({name: value for name, value in line.items() if name != "costs"}, flush=True)
    if given.what == "table":
        print(tables(pd.read_csv(given.out)))
    elif given.what == "lines":
        found = pd.read_csv(given.out)
        one = found[found["seed"] == 0].sort_values(["env", "model", "seconds", "muon"], kind="stable")
        parts = [table.markdown(spelled(one))]
        for env, lines in found.groupby("env"):
            parts += [f"{env}:" * (len(several(lines)) > 0), *seed_tables(lines)]
        print("\n\n".join(filter(None, parts)))
    elif given.what == "figure":
        lines = pd.read_csv(given.out)
        curves = {
            title: {
                zoo.method(str(model)): (group["seconds"].to_numpy(), group[name].to_numpy())
                for model, group in lines.sort_values(["seconds", "seed"]).groupby("model", sort=False)
            }
            for name, title in MEASURES.items()
        }
        figure = drawings.training_time(curves, ships=zoo.BUDGET["ReacherPush"])
        style.save(style.stamp(figure, stamp(lines)), runs.ROOT / "figures" / "training_time")


if __name__ == "__main__":
    main()
