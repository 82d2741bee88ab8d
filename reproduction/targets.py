"""Everything that is made: a name, what it is made from, and a file.

    data/ReacherPush/train                     episodes
    models/ReacherPush/tsm                     weights
    scores/ReacherPush/tsm                     rows of a table: of predictions,
    plans/ReacherPush/tsm-latent-cem           a plan for every target
    trials/ReacherPush/tsm-latent-cem              of its execution,
    policies/Reacher/tsm-latent                a policy
    learning/Reacher/tsm-latent                    of its learning curve
    tables/03_predict                          a tidy table

``make`` writes a file by renaming it, what it is made from first; ``Run.require`` reads, and
names the command where a file is missing. The Snakefile does the same for all seeds.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import pandas as pd

from reproduction import codes, episodes, plans, policies, robots, rounds, scores, tables
from reproduction.runs import Run, env_id
from reproduction.tables import Row
from tsmlib import zoo
from tsmlib.envs import fingerprint
from tsmlib.envs.spec import ENV_IDS, EnvSpec
from tsmlib.storage import artifacts

ARMS = ("Reacher", "ReacherObstacle", "ReacherPush")
EVERY_ARM = tuple(EnvSpec.parse(env).name for env in ENV_IDS)
BASELINES = ("onestep", "multistep", "lstm")
IMPERFECT = ("Reacher-noise0.25", "Reacher-delay5")
SPACES = ("latent", "direct")
ADAM = ("adam+starts", "adam+rough")


def _scores(run: Run) -> list[str]:
    words = zoo.words("dynamics")
    pairs = product(ARMS, ("tsm", "onestep") if run.scale == "smoke" else words)
    return [f"scores/{arm}/{word}" for arm, word in pairs]


def _episodes(run: Run) -> list[str]:
    return [name.replace("scores", "episodes", 1) for name in _scores(run)]


def _ablation(run: Run) -> list[str]:
    words = run.pick(("tsm",), ("tsm",), (*zoo.words("ablation", "choice"), "tsm", "onestep"))
    return [f"scores/ReacherPush/{word}" for word in words]


def plans_of(run: Run, arm: str) -> list[str]:
    """The plans of table 05, by name."""
    words = run.pick(
        ("tsm", "onestep"),
        ("rtsm", "onestep"),
        tuple(word for word, spec in zoo.ZOO.items() if spec.planned),
    )
    names = [f"{word}-{space}-cem" for word, space in product(words, SPACES)]
    if run.scale == "paper":
        names += [f"tsm-{space}-{planner}" for space, planner in product(SPACES, ADAM)]
        names += ["tsm-latent-adam-iterations500", "tsm-direct-cem+white"]
    if arm == "ReacherPush" and run.scale != "laptop":
        names += [f"{word}-latent-cem-every10" for word in (*words, "oracle")]
    return [*names, "oracle-latent-cem", "zero", "random"]


def _trials(run: Run) -> list[str]:
    arms = ("Reacher", "ReacherPush")
    return [f"trials/{arm}/{name}" for arm in arms for name in plans_of(run, arm)]


def policies_of(run: Run, arm: str) -> list[str]:
    """The policies of tables 05 and 06, through the prior and direct. At paper scale those of
    pushing are of ``tsm+elbo``, by the paper's loss alone."""
    if run.scale != "paper":
        return ["tsm-latent"]
    ours = "tsm+elbo" if arm == "ReacherPush" else "tsm"
    codes, torques = (ours, "rtsm"), (ours, *BASELINES)
    return [*(f"{word}-latent" for word in codes), *(f"{word}-direct" for word in torques)]


def _learning(run: Run, arms: tuple[str, ...]) -> list[str]:
    names = [f"learning/{arm}/{name}" for arm in arms for name in policies_of(run, arm)]
    return names + ["learning/ReacherPush/rtsm-value"] * ("ReacherPush" in arms)


def _robustness(run: Run) -> list[str]:
    words = run.pick(("tsm",), ("tsm", "onestep"), ("tsm", "rtsm", *BASELINES))
    names = [f"scores/{arm}/{word}" for arm, word in product(IMPERFECT, words)]
    filters = (*words, "none", "filter", "exponential")
    names += [f"filters/{IMPERFECT[0]}/{word}" for word in filters]
    names += [f"blind/{IMPERFECT[1]}/tsm", f"codes/{IMPERFECT[0]}/tsm"]
    return names + (_learning(run, IMPERFECT) if run.scale == "paper" else [])


def _torques(run: Run) -> list[str]:
    words = run.pick(("tsm",), ("oracle",), ("tsm", "rtsm", "oracle"))
    sources = [f"{word}-{space}-cem" for word, space in product(words, SPACES)]
    if run.scale == "paper":
        sources += [f"tsm-{space}-{planner}" for space, planner in product(SPACES, ADAM)]
    sources += ["data", "sampled", "reconstructed"]
    names = [f"torques/{arm}/{s}" for arm, s in product(("Reacher", "ReacherPush"), sources)]
    return names + [f"signals/{arm}/tsm" for arm in ("Reacher", "ReacherPush")]


def _robots(run: Run) -> list[str]:
    robots = run.pick(
        ("Pendulum-v1",), ("Pendulum-v1",), ("Pendulum-v1", "Hopper-v5", "HalfCheetah-v5")
    )
    words = run.pick(("rtsm",), ("rtsm",), ("rtsm", "onestep", "lstm", "ensemble+mse"))
    return [f"robots/{env}/{word}" for env, word in product(robots, words)]


def _rounds(run: Run) -> list[str]:
    pairs = product(("rtsm", "lstm", "ensemble+mse"), ("plans", "random", "none"))
    loops = [f"{word}-{data}" for word, data in pairs]
    picked = product(("Pendulum", "ReacherPush"), run.pick(loops[:1], loops[:2], loops))
    names = [f"rounds/{world}/{loop}" for world, loop in picked]
    arms = [f"ReacherPush-{word}" for word in ("mass0.5", "mass2", "gain0.7")]
    arms = run.pick(arms[-1:], arms[-1:], arms)
    ways = run.pick(("zero",), ("zero", "all"), ("zero", "all", "head", "codes", "scratch"))
    return names + [f"adapted/{arm}/rtsm-{way}-20" for arm, way in product(arms, ways)]


TABLES: dict[str, Callable[[Run], list[str]]] = {  # name -> the rows that it holds
    "01_collect": lambda run: [f"collection/{arm}" for arm in EVERY_ARM],
    "02_train": lambda run: [f"gradients/ReacherPush/{word}" for word in ("tsm", "rtsm")],
    "03_predict": _scores,
    "03_episodes": _episodes,
    "03_ablation": _ablation,
    "04_latent": lambda run: [*(f"codes/{arm}/tsm" for arm in ARMS), "codes/ReacherPush/rtsm"],
    "05_control": lambda run: _trials(run) + _learning(run, ("Reacher", "ReacherPush")),
    "05_control_rows": _trials,
    "06_robustness": _robustness,
    "07_action_prior": _torques,
    "09_your_own": _robots,
    "10_explore": _rounds,
}


@dataclass(frozen=True)
class Kind:
    """What targets of one kind are made of.

    Args:
        inputs: (run, words of the name) -> names of what they are made from.
        make: (run, words of the name, file) -> writes the file, or gives rows for it.
    """

    inputs: Callable[[Run, list[str]], list[str]]
    make: Callable[[Run, list[str], Path], list[Row] | None]


def _data_of(arm: str, *splits: str) -> list[str]:
    return [f"data/{arm}/{split}" for split in splits]


def _model_inputs(run: Run, words: list[str]) -> list[str]:
    return _data_of(words[0], "train", "validation")


def _prior_of(arm: str) -> str:
    return (
        f"models/{'ReacherObstacle' if EnvSpec.parse(env_id(arm)).has_block else 'Reacher'}/prior"
    )


def _score_inputs(run: Run, words: list[str]) -> list[str]:
    arm, word = words
    return [f"models/{arm}/{word}", *_data_of(arm, "validation", "test")]


def _plan_inputs(run: Run, words: list[str]) -> list[str]:
    arm, (word, space, planner, *more) = words[0], words[1].split("-")
    names = [] if word == "oracle" else [f"models/{arm}/{word}"]
    names += [_prior_of(arm)] if space == "latent" else []
    again = any(part.startswith("every") for part in more)
    return names + ([f"plans/{arm}/{word}-{space}-{planner}"] if again else [])


def _trial_inputs(run: Run, words: list[str]) -> list[str]:
    arm, name = words
    return [] if name in ("zero", "random") else [f"plans/{arm}/{name}"]


def _policy_inputs(run: Run, words: list[str]) -> list[str]:
    arm, (word, space) = words[0], words[1].split("-")
    prior = [_prior_of(arm)] if space == "latent" else []
    return [f"models/{arm}/{word}", *prior, *_data_of(arm, "train")]


def _filter_inputs(run: Run, words: list[str]) -> list[str]:
    arm, word = words
    own, clean = (_data_of(a, "train", "validation", "test") for a in (arm, arm.partition("-")[0]))
    model = [] if word in ("none", "filter", "exponential") else [f"models/{arm}/{word}"]
    return [*model, *own, *clean]


def _torque_inputs(run: Run, words: list[str]) -> list[str]:
    arm, source = words
    held = _data_of(arm, "train", "test")
    if source == "data":
        return held
    more = [_prior_of(arm)] if source in ("sampled", "reconstructed") else [f"plans/{arm}/{source}"]
    return held + more


def _adapted_inputs(run: Run, words: list[str]) -> list[str]:
    arm, word = words[0].partition("-")[0], words[1].partition("-")[0]
    return [f"models/{arm}/{word}", _prior_of(arm)]


def _write_data(run: Run, words: list[str], path: Path) -> None:
    header = {"seed": run.seed, "scale": run.scale, "fingerprint": fingerprint(env_id(words[0]))}
    artifacts.save_trajectories(path, episodes.make_data(run, *words), header)


def _write_model(run: Run, words: list[str], path: Path) -> None:
    episodes.make_model(run, *words, path)


def _write_plan(run: Run, words: list[str], path: Path) -> None:
    plans.save_plan(path, plans.make_plan(run, *words))


def _write_policy(run: Run, words: list[str], path: Path) -> None:
    policies.make_policy(run, *words, path)


def _rows(make: Callable[..., list[Row]]) -> Callable[[Run, list[str], Path], list[Row]]:
    """What ``make`` measures, with seed and scale in each row."""

    def rows(run: Run, words: list[str], path: Path) -> list[Row]:
        return [{"seed": run.seed, "scale": run.scale, **row} for row in make(run, *words)]

    return rows


def _table(run: Run, words: list[str], path: Path) -> list[Row]:
    """All rows of a table. Rows of single targets have one of their own where it is declared."""
    (name,) = words
    whole = pd.concat([tables.read(run.require(part)) for part in TABLES[name](run)])
    if "target" in whole and (name.endswith("_rows") or f"{name}_rows" in TABLES):
        whole = whole[whole["target"].notna() == name.endswith("_rows")]
        whole = whole if name.endswith("_rows") else whole.drop(columns="target")
    return whole.to_dict("records")


KINDS: dict[str, Kind] = {
    "data": Kind(lambda run, words: [], _write_data),
    "models": Kind(_model_inputs, _write_model),
    "plans": Kind(_plan_inputs, _write_plan),
    "policies": Kind(_policy_inputs, _write_policy),
    "collection": Kind(
        lambda run, words: _data_of(words[0], "train"), _rows(episodes.collection_rows)
    ),
    "gradients": Kind(
        lambda run, words: ["/".join(["models", *words]), _prior_of(words[0])],
        _rows(episodes.gradient_rows),
    ),
    "scores": Kind(_score_inputs, _rows(scores.score_rows)),
    "episodes": Kind(_score_inputs, _rows(scores.episode_rows)),
    "blind": Kind(_score_inputs, _rows(scores.blind_rows)),
    "codes": Kind(_score_inputs, _rows(codes.code_rows)),
    "filters": Kind(_filter_inputs, _rows(codes.filter_rows)),
    "trials": Kind(_trial_inputs, _rows(plans.trial_rows)),
    "torques": Kind(_torque_inputs, _rows(plans.torque_rows)),
    "signals": Kind(
        lambda run, words: ["/".join(["models", *words]), _prior_of(words[0])],
        _rows(plans.signal_rows),
    ),
    "learning": Kind(
        lambda run, words: ["/".join(["policies", *words]), *_data_of(words[0], "train")],
        _rows(policies.learning_rows),
    ),
    "robots": Kind(lambda run, words: [], _rows(robots.robot_rows)),
    "rounds": Kind(lambda run, words: [], _rows(rounds.round_rows)),
    "adapted": Kind(_adapted_inputs, _rows(rounds.adapted_rows)),
    "tables": Kind(lambda run, words: TABLES[words[0]](run), _table),
}


def inputs(run: Run, name: str) -> list[str]:
    """What a target is made from; at scale laptop models are those that ship."""
    kind, words = _split(name)
    return [] if kind == "models" and run.scale == "laptop" else KINDS[kind].inputs(run, words)


def make(run: Run, name: str, *, again: bool = False) -> Path:
    """Make a target, and before it whatever it is made from and is not there.

    Args:
        run: scale and seed.
        name: of the target.
        again: whether it is made although it is there.

    Returns:
        Its file, whole.

    Raises:
        ValueError: no target is called so.
        Missing: a model that does not ship is asked for at scale laptop.
    """
    (kind, words), path = _split(name), run.path(name)
    if path.exists() and not again:
        return path
    if kind == "models" and run.scale == "laptop":
        return run.require(name)
    for needed in inputs(run, name):
        make(run, needed)
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = KINDS[kind].make(run, words, path)
    return path if rows is None else tables.write(path, rows)


def pool(scale: str, name: str, seeds: list[int]) -> Path:
    """A table of several seeds in ``runs/<scale>/tables``, beside the folders of the seeds."""
    runs = [Run(scale, seed) for seed in seeds]
    whole = pd.concat([tables.read(run.require(f"tables/{name}")) for run in runs])
    return tables.write(runs[0].folder.parent / "tables" / f"{name}.csv", whole)


def _split(name: str) -> tuple[str, list[str]]:
    """Kind and words of a target's name."""
    kind, *words = name.split("/")
    no_table = kind == "tables" and "".join(words[:1]) not in TABLES
    if kind not in KINDS or not words or os.pardir in words or no_table:
        known = ", ".join([*KINDS, *(f"tables/{table}" for table in TABLES)])
        raise ValueError(f"no target is called {name!r:.80}; there are {known}")
    return kind, words
