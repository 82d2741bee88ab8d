"""Published rows of single environments and models, made as the notebooks make them: for models that came later.

    python benchmarks/settings/rows.py predict --scale paper --envs tsm/ReacherPush-v1 --models tsm rtsm lstm
    python benchmarks/settings/rows.py control --scale paper --envs tsm/ReacherPush-v1 --models rtsm lstm --closed rtsm
    python benchmarks/settings/rows.py latent --scale paper --envs tsm/ReacherPush-v1 --models tsm rtsm

predict: open loop and on segments (03_predict); ablations: the same as rows of 03_ablation, where variants of TSM are
compared on pushing with it and with the one-step model. control: plans by each planner in both search spaces, open
loop, and by the cross-entropy method in codes planned again every ten steps for --closed; with the oracle over codes,
no torque and random torques beside them (05_control); the model oracle is the true simulator. policies: learned inside
each model, of ours and the paper's in both search spaces, of the others direct alone, as in 05_control, by --copies
and --iterations where the run has none; how soon each came to a common plateau is told anew from all that are
published then. early: the first --iterations of latent policies again, with ten records, which tell when a policy came
to the plateau that was there by the first record of its curve. Models, scores, plans and policies are those of the
run, so what is missing is made first. torques: of plans by --planners in both search spaces, beside held-out torques
and those of the prior, and the signal of gradients at the first 50 starts (07_action_prior). convergence: of Adam in
codes, how many of 500 iterations until its plans are nearly done, for 25 targets (05_control).

gradients: their errors (02_train). collect, latent and robustness execute 01_collect, 04_latent and 06_robustness in
the run's folder for --envs and --models, as far as these ask for them, and publish what their tables then say:
06_robustness of tsm/Reacher-v0 in its imperfect worlds and of the place of its map that tsm/ReacherObstacle-v0 is.
imperfect: what 06_robustness says of predictions with noise and with delay, without its policies and its map.

rounds: of exploration on --envs, by default the pendulum, by each of --data: own plans, as many random episodes, or no
new ones (the same training alone); of pushing also contacts in each round's episodes, and how soon a search through
the true simulator returns as much in codes of the last prior as in those of the first. What was trained stays in the
run's folder, where a loop that was killed goes on.
adaptation: shipped models adapted to --variants of --envs, by default the reaching arm, by --ways, from --episodes;
reference is a model trained in full on such an arm; with --targets they plan, and are not scored. Both are rows of
10_explore. peers publishes rows that were made beside them, in the files that are named: of benchmarks/peers mbrl-lib's
loop in 10_explore and the scores of its models in peers_pets, of benchmarks/model_free policies without a model in
model_free. whole publishes tables of scripts beside this one, starts.py and samples.py, in place of all their rows.

Rows take the place of those of the same environment, model, method, metric and seed in data/results, in model_free of
those of all seeds of the same environment and algorithm; all others stay. Rounds take the place of all rows of the
same environment, model, data and seed, whatever their steps. Commands side by side write one after another.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from functools import partial, reduce
from itertools import product
from pathlib import Path

import pandas as pd

from tsmlib import figures, study
from tsmlib.envs import imperfect as imperfect_arm
from tsmlib.envs.spec import DELAY, ENV_IDS, NOISE
from tsmlib.figures.method import PLANNERS, SEARCH_SPACES
from tsmlib.storage import manifest, tables
from tsmlib.storage.files import StoreError, writer_lock
from tsmlib.study import (
    adaptation,
    drawings,
    imperfect,
    media,
    needed,
    notebooks,
    parameters,
    rounds,
    runs,
    worlds,
    zoo,
)
from tsmlib.study.data import require_other_seed
from tsmlib.study.jobs import Job, Policy, Scores, plan_jobs
from tsmlib.study.policies import Budget, stored_budget
from tsmlib.study.results import action_prior, exploration, planning
from tsmlib.study.results import policies as policies_results
from tsmlib.study.results.exploration import PENDULUM
from tsmlib.study.results.table import REPLACED_TOGETHER, Row, about, others, select
from tsmlib.study.runs import RESULTS
from tsmlib.trajectory import Trajectories

LOOP = ("env", "model", "configuration", "seed", "scale")
NOTEBOOKS = {
    "collect": "01_collect", "gradients": "02_train", "predict": "03_predict", "ablations": "03_predict",
    "latent": "04_latent", "convergence": "05_control", "robustness": "06_robustness", "imperfect": "06_robustness",
    "torques": "07_action_prior", "rounds": "10_explore", "adaptation": "10_explore",
}  # fmt: skip
REACH = planning.REACH
WEAK = (REACH, "gain0.7")  # the arm that is adapted to by default
WAYS = (*adaptation.WAYS, adaptation.REFERENCE)
SIMULATOR = planning.ORACLE.model
WHOLE = ("03_samples", "07_starts")  # tables that a script beside this one makes as a whole
MAPPED = ("rtsm", exploration.PLANNED, 0, "paper")  # the loops whose episodes are drawn
FLOORS = (planning.ORACLE, zoo.method("zero"), zoo.method("random"))


def merged(published: pd.DataFrame, rows: pd.DataFrame | Iterable[Row]) -> pd.DataFrame:
    """The published table with ``rows`` in place of those with the same key; early records go with their curve."""
    new = tables.frame(rows)
    replaced, early = set(_keys(new)), published["subset"] == policies_results.EARLY
    curves = _keys(published.assign(subset=published["subset"].mask(early, "")))
    kept = [not {key, curve} & replaced for key, curve in zip(_keys(published), curves, strict=True)]
    return tables.frame(pd.concat([published[kept], new]))


def without_loops(published: pd.DataFrame, rows: pd.DataFrame | Iterable[Row]) -> pd.DataFrame:
    """The published table without the loops of rounds that ``rows`` are of: a loop made again may lose other episodes,
    so that its rounds have other steps, and lack a return that was there."""
    made = set(about(tables.frame(rows), LOOP))
    of_rounds = (published["planner"] == "cem") | (published["subset"] == "data")
    again = pd.Series([loop in made for loop in about(published, LOOP)], index=published.index, dtype=bool)
    return published[~(of_rounds & again)]


def _keys(rows: pd.DataFrame) -> list[tuple[str, ...]]:
    """What a row is about, but for its target: a learning curve is replaced as a whole."""
    curve, more = rows["planner"] == "policy", ("metric", "iteration", "steps_ahead")
    masked = rows.assign(**{name: rows[name].astype(object).mask(curve, "") for name in more})
    return about(masked, (*REPLACED_TOGETHER, *more, "env_steps", "subset"))


def shipped(name: str) -> pd.DataFrame:
    """A table of data/results, without rows where there is none."""
    path = RESULTS / f"{name}.csv"
    return tables.load(path) if tables.stored(path) else tables.frame([])


def publish(
    name: str, rows: pd.DataFrame | Iterable[Row], *, loops: bool = False,
    told: Callable[[pd.DataFrame], pd.DataFrame] | None = None,
) -> None:  # fmt: skip
    """Merge rows into a table of data/results, and its new checksum into the manifest. loops: of whole loops of
    rounds, whose former rows go. told: what becomes of the whole table then."""
    new = tables.frame(rows)

    def changed(known: pd.DataFrame) -> pd.DataFrame:
        table = merged(without_loops(known, new) if loops else known, new)
        return told(table) if told else table

    ship(name, changed)


def ship(name: str, changed: Callable[[pd.DataFrame], pd.DataFrame]) -> None:
    """Put what ``changed`` makes of a table of data/results in its place, and its new checksum into the manifest, while
    no other command writes there."""
    with writer_lock(RESULTS.parent, f"rows of {name}", wait=True):
        table = changed(shipped(name))
        tables.ship(RESULTS / f"{name}.csv", table)
        manifest.write_manifest(RESULTS.parent)
    print(f"{name}.csv: {len(table)} rows")


def with_plateaus(table: pd.DataFrame, run: runs.Run, envs: list[str]) -> pd.DataFrame:
    """The published table, with what it says of when this seed's policies came to their plateaus told anew."""
    own = own_policies(table, run, envs)
    told = own[own["metric"].isin(policies_results.SOONEST)]
    rows = study.plateaus(run, [study.load_task(env) for env in envs], own.drop(told.index))
    return tables.frame(pd.concat([table.drop(told.index), tables.frame(rows)]))


def own_policies(table: pd.DataFrame, run: runs.Run, envs: list[str]) -> pd.DataFrame:
    """The published rows of policies of a run's seed and scale on some environments."""
    return select(table, planner="policy", seed=run.seed, scale=run.scale, env=envs, noise=None, delay=None)


def controlled(
    run: runs.Run, envs: list[str], models: list[str], closed: list[str], spaces: list[str], planners: list[str]
) -> tuple[list[Row], list[Row]]:
    """Rows of 05_control.csv and 05_control_rows.csv."""
    tasks = [study.load_task(env) for env in envs]
    ways = [*(way for planner in planners for way in zoo.methods(models, planner, spaces)), *FLOORS]
    wanted = [job for env in envs for job in plan_jobs(env, 100, ways)]
    wanted += [job for env in envs for job in plan_jobs(env, 100, zoo.methods(closed, "cem", ["latent"]), every=10)]
    study.precompute(run, wanted)
    trials = study.trials(run, tasks, ways)
    rows, targets = planning.rows(tasks, trials, run)
    if closed:
        loops = study.trials(run, tasks, zoo.methods(closed, "cem", ["latent"]), every=10)
        more, more_targets = planning.rows(tasks, loops, run, execution=planning.CLOSED)
        rows, targets = [*rows, *more], [*targets, *more_targets]
    return rows, targets


def convergence(run: runs.Run, envs: list[str], models: list[str]) -> list[Row]:
    """Rows of 05_control_rows.csv that say how soon a long optimisation was nearly done."""
    asked = needed.control(run)
    tasks, ways = [study.load_task(env).take(asked.n_few) for env in envs], zoo.methods(models, "adam", ["latent"])
    long = asked.converging_iterations
    study.precompute(run, [job for task in tasks for job in plan_jobs(task.env, len(task), ways, iterations=long)])
    plans = [(task, way, study.plan(run, task, way, iterations=long)) for task, way in product(tasks, ways)]
    return [row for task, way, plan in plans for row in planning.convergence(task, plan, run, way)]


def torques(run: runs.Run, envs: list[str], models: list[str], planners: list[str]) -> list[Row]:
    """Rows of 07_action_prior.csv."""
    tasks = [study.load_task(env) for env in envs]
    ways = [way for planner in planners for way in zoo.methods(models, planner)]
    study.precompute(run, [job for env in envs for job in plan_jobs(env, 100, ways)])
    trials, rows = study.trials(run, tasks, ways), list[Row]()
    for task in tasks:
        rows += action_prior.task_rows(study.task_torques(run, task), trials[task.env], run)
        rows += study.signal_rows(run, task.take(50), [word for word in models if word != SIMULATOR], samples=32)
    return rows


def imperfect_rows(run: runs.Run, models: list[str]) -> list[Row]:
    """Rows of 06_robustness.csv on the reaching arm with noise and with delay, but for those of policies."""
    noisy, late = imperfect_arm(REACH, noise=NOISE), imperfect_arm(REACH, delay=DELAY)
    pairs, coded = list(product((noisy, late), models)), [word for word in models if word in zoo.words(cls=zoo.CODED)]
    study.precompute(run, [Scores(env, word, segments) for env, word in pairs for segments in (False, True)])
    rows = [*study.score_rows(run, pairs), *imperfect.blind_rows(run, late, coded)]
    rows += [row for env in (noisy, late) for row in imperfect.code_rows(run, env, coded)]
    return rows + imperfect.clean_rows(run, noisy, REACH, models)


def adapted(
    run: runs.Run, models: list[str], envs: list[str], ways: list[str], episodes: list[int], targets: int
) -> list[Row]:
    """Rows of 10_explore.csv: of shipped models, adapted to changed arms; zero-shot whatever the episodes are. targets:
    of plans, in place of predictions."""
    rows = list[Row]()
    for env, word in product(envs, models):
        for way in (way for way in (*adaptation.ways(word), adaptation.REFERENCE) if way in ways):
            for n in episodes[:1] if way in ("zero-shot", adaptation.REFERENCE) else episodes:
                found = adaptation.made(run, word, env, way=way, episodes=n)
                if targets:
                    rows += adaptation.plan_rows(run, word, env, way, found, n_targets=targets)
                else:
                    rows += adaptation.score_rows(run, word, env, way, found, n_test=100)
    return rows


def draw(run: runs.Run, env: str, loop: rounds.Loop) -> None:
    """Where a loop has been, as a figure that ships."""
    first, *own = [data for data in loop.episodes if data is not None]
    if env == PENDULUM:
        assert loop.priors is not None
        stem, (figure, n) = "10_visited", drawings.visited(first, reduce(Trajectories.joined, own), *loop.priors)
    else:
        stem, (figure, n) = "10_places", drawings.places(first, own[-1])
    media.stamp_run(run, figure, n)
    figures.save(figure, runs.ROOT / "figures" / stem)


def wanted_rounds(options: argparse.ArgumentParser, given: argparse.Namespace) -> list[tuple[str, str, str]]:
    """Environment, model and data of every loop; ends the command where a model does not explore there."""
    for env, word in (pairs := list(product(given.envs or [PENDULUM], given.models))):
        try:
            worlds.require(env, word)
        except ValueError as error:
            options.error(str(error))
    return [(env, word, data) for env, word in pairs for data in given.data]


def wanted_arms(options: argparse.ArgumentParser, given: argparse.Namespace) -> list[str]:
    """Changed arms; ends the command where an arm has nothing to change, or a model does not ship or adapt."""
    try:
        arms = [adaptation.changed(arm, word) for arm in given.envs or [WEAK[0]] for word in given.variants]
        for arm, word in product(arms, given.models):
            adaptation.require(arm, word)
    except ValueError as error:
        options.error(str(error))
    return arms


def published_peers(files: list[Path]) -> None:
    """Rows of other libraries, from the tables that benchmarks/peers and benchmarks/model_free wrote."""
    rows = tables.frame(pd.concat([tables.load(path) for path in files]))
    loops, policies = rows[rows["execution"] == "closed loop"], rows[rows["execution"] == "policy"]
    predicted = rows[rows["planner"] == "none"]
    if len(loops):
        publish("10_explore", loops, loops=True)
    if len(predicted):
        publish("peers_pets", predicted)
    if len(policies):  # a learner's steps may have been others before
        about_these = ("env", "model")
        ship("model_free", lambda known: tables.frame(pd.concat([others(known, policies, about_these), policies])))


def published_whole(files: list[Path]) -> None:
    """Tables of WHOLE as they are."""
    for path in files:
        tables.load(path)  # StoreError where it is damaged
    with writer_lock(RESULTS.parent, ", ".join(path.name for path in files), wait=True):
        for path in files:
            tables.ship_bytes(RESULTS / path.name, path.read_bytes())
        manifest.write_manifest(RESULTS.parent)


def executed(notebook: runs.Notebook, run: runs.Run, envs: list[str], models: list[str]) -> pd.DataFrame:
    """The table that a notebook leaves in the run's folder, for these environments and models."""
    asked = {"env": ",".join(envs), "models": ",".join(models)}
    given = {name: value for name, value in asked.items() if name in parameters.declared(notebook.path)}
    execution = notebooks.prepare(notebook, scale=run.scale, seed=run.seed, given=given)
    notebooks.execute(execution)
    found = tables.load(execution.run.metrics / f"{notebook.stem}.csv")
    return found[found["env"].isin(envs) & (found["seed"] == run.seed)]


FILES = {"peers": published_peers, "whole": published_whole}  # parts that take files


def parser() -> argparse.ArgumentParser:
    """The command's options."""
    found = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("part", choices=(*NOTEBOOKS, "control", "policies", "early", *FILES))
    found.add_argument("files", nargs="*", type=Path, help="tables that peers and whole publish")
    found.add_argument("--envs", nargs="+", default=[], choices=(*ENV_IDS, PENDULUM), metavar="ENV")
    found.add_argument("--models", nargs="+", default=[], choices=(*zoo.words(), SIMULATOR), metavar="MODEL",
                       help="of control and torques also oracle, the true simulator")  # fmt: skip
    found.add_argument("--closed", nargs="*", default=[], choices=(*zoo.words(), SIMULATOR), metavar="MODEL")
    found.add_argument("--spaces", nargs="+", default=SEARCH_SPACES, choices=SEARCH_SPACES, help="default both")
    found.add_argument("--planners", nargs="+", default=["cem"], choices=PLANNERS, help="default cem")
    found.add_argument("--data", nargs="+", default=exploration.DATA[:2], choices=exploration.DATA, help="of rounds")
    found.add_argument("--variants", nargs="+", default=[WEAK[1]], choices=adaptation.VARIANTS, metavar="VARIANT",
                       help=f"of the arm that is adapted to (default {WEAK[1]})")  # fmt: skip
    found.add_argument("--ways", nargs="+", default=WAYS, choices=WAYS, help="of adaptation (default all)")
    found.add_argument("--episodes", nargs="+", type=int, default=[20], help="to adapt from (default 20)")
    found.add_argument("--targets", type=int, default=0, metavar="N",
                       help="of adaptation: plans to the first N test targets, in place of predictions")  # fmt: skip
    found.add_argument("--copies", type=int, default=3, help="of a policy, side by side (default 3)")
    found.add_argument("--iterations", type=int, default=880, help="of learning a policy (default 880)")
    found.add_argument("--scale", default="", help="default TSM_SCALE, else laptop")
    found.add_argument("--seed", type=int, default=0)
    return found


def main() -> None:
    options = parser()
    given = options.parse_args()
    if bool(given.files) != (given.part in FILES) or not all(path.is_file() for path in given.files):
        missing = [str(path) for path in given.files if not path.is_file()]
        options.error(
            f"{' and '.join(FILES)}, and nothing else, take tables that are there; got "
            f"{missing or [str(path) for path in given.files] or 'none'}"
        )
    if given.part == "whole" and (other := [path.name for path in given.files if path.stem not in WHOLE]):
        options.error(f"whole takes {' and '.join(f'{name}.csv' for name in WHOLE)}; got {', '.join(other)}")
    if given.part in FILES:
        try:
            FILES[given.part](given.files)
        except StoreError as error:
            options.error(str(error))
        return
    if not given.models and given.part != "collect":
        options.error(f"{given.part} needs --models, some of {', '.join(zoo.words())}")
    if SIMULATOR in given.models and given.part not in ("control", "torques"):
        options.error(f"{given.part} takes no {SIMULATOR}; --models are some of {', '.join(zoo.words())}")
    if SIMULATOR in given.models and not set(given.planners) <= {"cem", "mppi"}:
        options.error(f"the simulator has no gradient; --planners of {SIMULATOR} are cem and mppi")
    if not given.envs and NOTEBOOKS.get(given.part) != "10_explore":
        options.error(f"{given.part} needs --envs, some of {', '.join(ENV_IDS)}")
    if PENDULUM in given.envs and given.part != "rounds":
        options.error(f"{given.part} takes no {PENDULUM}; --envs are some of {', '.join(ENV_IDS)}")
    if min(given.episodes) < 2:
        options.error(f"--episodes {min(given.episodes)}: expected at least 2, since one is held out")
    if given.copies < 1 or given.iterations < 0:
        options.error(
            f"--copies {given.copies}, --iterations {given.iterations}: expected at least one copy, and 0 (the scale's "
            "default) or more iterations"
        )
    if (given.targets and given.part != "adaptation") or not 0 <= given.targets <= 100:
        options.error(f"--targets {given.targets}: expected 1 to 100, and of adaptation alone")
    notebook = NOTEBOOKS.get(given.part, "05_control")
    try:
        require_other_seed(given.seed)
        run = runs.resolve(notebook, scale=given.scale, seed=given.seed)
    except parameters.ParameterError as error:
        options.error(str(error))
    if given.part == "convergence" and not needed.control(run).converging:
        options.error(f"nothing converges at scale {run.scale}; --scale of convergence is paper or smoke")
    if given.part in ("predict", "ablations"):
        pairs = list(product(given.envs, given.models))
        wanted: list[Job] = [Scores(env, word, segments) for env, word in pairs for segments in (False, True)]
        study.precompute(run, wanted)
        publish("03_ablation" if given.part == "ablations" else notebook, study.score_rows(run, pairs))
    elif given.part == "convergence":
        publish(f"{notebook}_rows", convergence(run, given.envs, given.models))
    elif given.part == "imperfect":
        publish(notebook, imperfect_rows(run, given.models))
    elif given.part == "torques":
        publish(notebook, torques(run, given.envs, given.models, given.planners))
    elif given.part == "rounds":
        for env, word, data in wanted_rounds(options, given):
            loop = rounds.loop(run, word, env=env, data=data, folder=run.folder("rounds"))
            publish(notebook, [*loop.rows, *loop.seconds], loops=True)
            if (word, data, run.seed, run.scale) == MAPPED:
                draw(run, env, loop)
    elif given.part == "adaptation":
        for env in wanted_arms(options, given):
            publish(notebook, adapted(run, given.models, [env], given.ways, given.episodes, given.targets))
    elif given.part == "gradients":
        starts = [study.load_task(env).take(2) for env in given.envs]
        publish(notebook, [row for task in starts for row in study.error_rows(run, task, given.models)])
    elif given.part in NOTEBOOKS:
        publish(notebook, executed(runs.notebooks()[given.part], run, given.envs, given.models))
    elif given.part == "policies":
        budget = Budget(given.copies, given.iterations)
        policies = [
            (study.load_task(env), way, stored_budget(run, env, way) or budget)
            for env, way in product(given.envs, zoo.policies(given.models))
        ]
        study.precompute(run, [Policy(task.env, len(task), way, budget) for task, way, budget in policies])
        told = partial(with_plateaus, run=run, envs=given.envs)
        publish(notebook, study.policy_rows(run, policies), told=told)
    elif given.part == "early":
        budget, published = Budget(given.copies, given.iterations), shipped(notebook)
        latent = [way for way in zoo.policies(given.models) if way.search_space == "latent"]
        for env, way in product(given.envs, latent):
            if select(own_policies(published, run, [env]), model=way.model, search_space="latent").empty:
                options.error(
                    f"{env}: no latent policy in {way.model} of seed {run.seed} is published; run policies first"
                )
        rows = study.early_rows(run, [(study.load_task(env), way, budget) for env, way in product(given.envs, latent)])
        publish(notebook, rows, told=partial(with_plateaus, run=run, envs=given.envs))
    else:
        rows, targets = controlled(run, given.envs, given.models, given.closed, given.spaces, given.planners)
        publish(notebook, rows)
        publish(f"{notebook}_rows", targets)


if __name__ == "__main__":
    main()
