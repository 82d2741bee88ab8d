"""Published rows, made again by one command: those of a table, those that a claim asks for, or all.

    python benchmarks/settings/reproduce.py 05_control --seeds 0
    python benchmarks/settings/reproduce.py C46
    python benchmarks/settings/reproduce.py all --list

RECIPES has a command for every row that ships; run are those with the environments, models and seeds of the rows that
are wanted. Some need build/model_free and build/peers, which docs/reproducing.md says how to install: where they are
missing it stops before it begins. Models, scores, plans and policies that are missing in runs/paper/seed<k> are made
first, here, one after another: hours, or days (docs/claims.md says how many); models that were trained on a GPU are not
the same bits then. What is there is used: name an empty TSM_RUN_DIR to make all anew. What was made stays, so that a
command that was stopped goes on; those of other libraries begin again. --list prints the commands, to run some of them,
or side by side.

The new rows take the place of those in data/results, claims are judged, pages and their figure made anew; then it says
how far new values lie from those before, which are kept in runs/reproduce until then. ``git checkout data docs figures
README.md`` takes it back, with whatever else you changed there.

    python benchmarks/settings/reproduce.py --page

writes the commands, and the seeds of the rows that ship, into docs/reproducing.md.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

import numpy as np
import pandas as pd

from tsmlib.storage import files, tables
from tsmlib.study import adaptation, runs, worlds
from tsmlib.study.claims import evaluate
from tsmlib.study.claims.claim import Claim
from tsmlib.study.claims.ledger import claims, questions
from tsmlib.study.publish import between
from tsmlib.study.results import exploration, policies
from tsmlib.study.results.table import select
from tsmlib.study.runs import RESULTS, ROOT
from tsmlib.study.zoo import OURS, PAPERS

PAGE, MARKS = ROOT / "docs" / "reproducing.md", ("<!-- commands -->", "<!-- end of commands -->")
ROWS, PETS = "benchmarks/settings/rows.py", "build/peers/bin/python benchmarks/peers"
REACH, OBSTACLE, PUSH, PENDULUM = "tsm/Reacher-v0", "tsm/ReacherObstacle-v0", "tsm/ReacherPush-v1", "Pendulum-v1"
PYMUNK = ("tsm/PymunkReacher-v0", "tsm/PymunkObstacle-v0", "tsm/PymunkPush-v1")
OUR, FIVE = (PAPERS, OURS), (PAPERS, OURS, "onestep", "multistep", "lstm")
ENSEMBLES, FREE, FLOORS = ("ensemble", "ensemble+mse"), ("ppo", "trpo"), ("oracle", "none")
VARIANTS = ("tsm+plain", "tsm+full", "tsm+h1", "tsm+h20", "tsm+z4", "tsm+z16")
OPEN, CLOSED = {"execution": ("open loop",)}, {"execution": ("closed loop",)}
POLICY, EARLY = {"planner": ("policy",)}, {"subset": (policies.EARLY,)}
CONTROL, CONVERGED = ("05_control", "05_control_rows"), {"metric": ("iterations_to_95",)}
FILTERS = ("none", "filter", "exponential")  # in the place of a model that filters noise
CEM, ADAM = {"planner": ("cem", "zero", "random")}, {"planner": ("adam",)}
JUDGED = "08_claims"  # the table that ``publish --claims`` writes, whatever was made before
CLAIMS = "python -m tsmlib publish --claims"
REQUEST = "request.json"  # what a command was asked for
FURTHEST = 20  # metrics that are printed


@dataclass(frozen=True)
class Recipe:
    """Rows of ``tables``, and what makes them: ``rows.py part``, or ``script``, {seed} and {runs} in it.

    envs, models: of the rows, as the command takes them; extra_models: of rows that come with them. only,
    excluded: column -> values that the rows have, and do not have. variant: what was changed of the environments in the
    rows. whole: the command takes all of ``models``, whatever rows are wanted.
    """

    tables: tuple[str, ...]
    part: str
    envs: tuple[str, ...]
    models: tuple[str, ...] = ()
    extra_models: tuple[str, ...] = ()
    options: str = ""
    only: Mapping[str, Sequence[str | int]] = field(default_factory=dict)
    excluded: Mapping[str, Sequence[str]] = field(default_factory=dict)
    variant: str = ""
    script: tuple[str, ...] = ()
    whole: bool = False

    def env_of_rows(self, env: str) -> str:
        """What the column ``env`` says."""
        return adaptation.changed(env, self.variant) if self.variant else env

    def made(self, table: pd.DataFrame) -> pd.DataFrame:
        """Those of the rows of one of ``tables`` that the command makes."""
        envs = [self.env_of_rows(env) for env in self.envs]
        found = select(table, env=envs, model=[*self.models, *self.extra_models], **self.only)
        for column, values in self.excluded.items():
            found = found.drop(select(found, **{column: values}).index)
        return found

    def commands(self, rows: pd.DataFrame, seed: str, folder: str = "runs") -> list[str]:
        """As many as make these rows, all of one seed; more than one where environments have rows of other models.

        folder: of all runs.
        """
        if self.script:
            return [line.format(seed=seed, runs=folder) for line in self.script]
        pairs = set(zip(rows["env"], rows["model"], strict=True))
        there = [env for env in self.envs if self.env_of_rows(env) in set(rows["env"])]
        asked = {
            env: tuple(word for word in self.models if self.whole or (self.env_of_rows(env), word) in pairs)
            for env in there
        }
        return [
            " ".join([
                f"python {ROWS} {self.part} --scale paper --seed {seed} --envs", *envs,
                *(("--models", *(models or self.models[:1])) if self.models else ()),
                *(("--variants", self.variant) if self.variant else ()), *self.options.split(),
            ])
            for models, envs in groupby(there, lambda env: asked[env])
        ]  # fmt: skip


def _rounds(envs: tuple[str, ...], models: tuple[str, ...], data: str) -> Recipe:
    """Of exploration."""
    only = {"configuration": (data,)}
    return Recipe(("10_explore",), "rounds", envs, models, options=f"--data '{data}'", only=only)


def _adapted(env: str, variant: str, ways: tuple[str, ...], models: tuple[str, ...]) -> Recipe:
    """Models adapted to a changed arm, or trained in full on it."""
    return Recipe(
        ("10_explore",), "adaptation", (env,), models, options=f"--ways {' '.join(ways)} --episodes 5 20 80",
        variant=variant, only={"planner": ("none",), "configuration": ways},
    )  # fmt: skip


def _plans(env: str, variant: str, episodes: str = "20") -> Recipe:
    """What models adapted to a changed arm plan there."""
    options = f"--ways {' '.join(adaptation.WAYS)} --episodes {episodes} --targets 50"
    only = {"planner": ("cem",), "execution": ("open loop",), "configuration": adaptation.WAYS}
    return Recipe(("10_explore",), "adaptation", (env,), TUNED, options=options, variant=variant, only=only)


def _loop(env: str) -> Recipe:
    """mbrl-lib's own."""
    made = f"{{runs}}/paper/seed{{seed}}/metrics/peers_loop-{env.rpartition('/')[2]}.csv"
    lines = (f"{PETS}/loop.py --env {env} --scale paper --seed {{seed}}", f"python {ROWS} peers {made}")
    return Recipe(("10_explore",), "", (env,), ("pets",), script=lines)


def _free(envs: tuple[str, ...], models: tuple[str, ...], options: str) -> Recipe:
    """Policies without a model."""
    made = f"{{runs}}/paper/seed0/metrics/model_free_{'_'.join(models)}.csv"
    command = f"build/model_free/bin/python benchmarks/model_free/model_free.py {options} --out {made}"
    return Recipe(("model_free",), "", envs, models, script=(command, f"python {ROWS} peers {made}"))


ARMS = [arm for arm in adaptation.VARIANTS if arm != "standard"]
TUNED = tuple(adaptation.BUDGETS)  # models that are adapted
EXPLORING = tuple(worlds.world(PUSH).learners)  # of rounds
ROBOTS = ("Hopper-v5", "HalfCheetah-v5", PENDULUM)
METRICS = "{runs}/paper/seed0/metrics"
RECIPES = (  # in the order in which they are run: policies without a model before those that are compared with them
    Recipe(("01_collect",), "collect", (REACH, OBSTACLE, PUSH, *PYMUNK), extra_models=("none",)),
    Recipe(("02_train",), "gradients", (PUSH,), OUR),
    Recipe(("03_predict",), "predict", (REACH, OBSTACLE, PUSH), (*FIVE, *ENSEMBLES)),
    Recipe(
        ("peers_pets",), "", (PUSH,), ("pets",),
        script=(
            f"{PETS}/pets.py --env {PUSH} --form gaussian --seconds 2320 --run-dir {{runs}}/paper/seed0",
            f"python {ROWS} peers {METRICS}/peers_pets.csv",
        ),
    ),
    Recipe(("03_ablation",), "ablations", (PUSH,), ("onestep", PAPERS, *VARIANTS)),
    Recipe(("03_samples",), "", (PUSH,), (OURS,), script=(
        "python benchmarks/settings/samples.py", f"python {ROWS} whole {METRICS}/03_samples.csv",
    )),
    Recipe(("04_latent",), "latent", (REACH, OBSTACLE, PUSH), OUR),
    _free((REACH, PUSH), FREE, "--seeds 10"),
    _free((PUSH,), ("sac",), f"--env {PUSH} --algorithm sac"),
    _free((PENDULUM,), (*FREE, "sac"), f"--env {PENDULUM} --algorithm ppo trpo sac"),
    Recipe(CONTROL, "control", (REACH, PUSH), (*FIVE, "ensemble+mse"), FLOORS, only={**CEM, **OPEN}),
    Recipe(CONTROL, "control", (REACH,), ("oracle",), only={"search_space": ("direct",)}),
    Recipe(CONTROL, "control", (PUSH,), FIVE, options=f"--closed {' '.join(FIVE)}", only=CLOSED),
    Recipe(CONTROL, "control", (PUSH,), FIVE, options="--planners adam", only=ADAM, excluded=CONVERGED),
    Recipe(CONTROL, "control", (REACH,), OUR, options="--planners adam", only=ADAM, excluded=CONVERGED),
    Recipe(
        CONTROL, "control", (REACH,), FIVE[2:], options="--planners adam --spaces direct", only=ADAM, excluded=CONVERGED
    ),
    Recipe(CONTROL[:1], "policies", (REACH,), (PAPERS,), FREE, "--iterations 880", POLICY, EARLY),
    Recipe(CONTROL[:1], "policies", (REACH,), (*FIVE[1:], "ensemble+mse"), FREE, "--iterations 2200", POLICY, EARLY),
    Recipe(CONTROL[:1], "policies", (PUSH,), FIVE, FREE, "--iterations 880", POLICY),
    Recipe(CONTROL[:1], "early", (REACH,), OUR, options="--iterations 220", only=EARLY),
    Recipe(CONTROL[1:], "convergence", (REACH, PUSH), OUR, only=CONVERGED),
    Recipe(
        ("06_robustness",), "robustness", (REACH, OBSTACLE), FIVE, FILTERS, only={"seed": range(5)}, whole=True
    ),
    Recipe(("06_robustness",), "imperfect", (REACH,), FIVE, FILTERS, only={"seed": range(5, 10)}, whole=True),
    Recipe(("07_action_prior",), "torques", (REACH, PUSH), OUR, ("prior", "none"), "--planners cem adam"),
    Recipe(("07_action_prior",), "torques", (REACH,), ("oracle",)),
    Recipe(("07_starts",), "", (REACH,), (PAPERS,), script=(
        "python benchmarks/settings/starts.py", f"python {ROWS} whole {METRICS}/07_starts.csv",
    )),
    Recipe(("09_your_own",), "", ROBOTS, (OURS, "onestep", "lstm", "ensemble+mse"), FLOORS, script=(
        "python -m tsmlib run your_own --scale paper", "python -m tsmlib publish --table your_own",
    )),
    *(_rounds((PENDULUM,), EXPLORING, data) for data in exploration.DATA),
    _rounds((PUSH,), EXPLORING, exploration.PLANNED),
    _rounds((PUSH,), EXPLORING[:1], exploration.RANDOM),
    _rounds((PUSH,), EXPLORING[:2], exploration.NONE),
    *map(_loop, (PENDULUM, PUSH)),
    _adapted(REACH, "gain0.7", (*adaptation.WAYS, adaptation.REFERENCE), TUNED),
    _plans(REACH, "gain0.7"),
    *(_adapted(PUSH, arm, adaptation.WAYS, TUNED) for arm in ARMS),
    _adapted(PUSH, "gain0.7", (adaptation.REFERENCE,), (OURS,)),
    *(_plans(PUSH, arm, "5 20 80" if arm == "gain0.7" else "20") for arm in ARMS),
)  # fmt: skip


# Wanted rows and their commands --------------------------------------------------------------------------------------


def shipped(folder: Path = RESULTS) -> dict[str, pd.DataFrame]:
    """Every table of data/results that a recipe makes. folder: of a copy."""
    names = sorted({name for recipe in RECIPES for name in recipe.tables})
    return {name: tables.load(path) for name in names if (path := tables.stored(folder / f"{name}.csv"))}


def rows_of_claims(some: Iterable[Claim], rows: Mapping[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """The rows that the checks of claims ask for, under every reading."""
    checks = [check for one in some for found in one.checks.values() for check in found]
    terms = {
        (name, term) for check in checks for term in check.number.terms for name in (term.table, f"{term.table}_rows")
    }
    of = {name: dict(iter(rows[name].groupby(["metric", "model"]))) for name in {name for name, _ in terms} & set(rows)}
    found: dict[str, pd.Index] = {}
    for name, term in terms:
        if name in of and (part := of[name].get((term.metric, term.model))) is not None:
            wanted = {column: value for column, value in term.wanted.items() if column in part}
            found[name] = select(part, **wanted).index.union(found.get(name, part.index[:0]))
    return {name: rows[name].loc[index] for name, index in sorted(found.items())}


def with_sources(wanted: Mapping[str, pd.DataFrame], rows: Mapping[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """The rows that a claim asks for, and those that they are told from or that their commands would drop.

    When a policy came to a plateau is told from all latent policies of its arm and seed, and from the learners without
    a model; and the first records of a policy of reaching go when it is learned again.
    """
    learned, found = rows["05_control"], dict(wanted)
    if "05_control" not in wanted:
        return found
    of_policies = select(wanted["05_control"], planner="policy")
    plateaus = select(of_policies, metric=list(policies.SOONEST))
    latent = select(learned, planner="policy", search_space="latent")
    again = sharing(latent, plateaus, ["env", "seed"])
    relearned = pd.concat([of_policies, again])
    early = sharing(select(latent, subset=policies.EARLY), relearned, ["env", "seed", "model"])
    found["05_control"] = learned.loc[wanted["05_control"].index.union(again.index).union(early.index)]
    if len(plateaus):
        free = select(rows["model_free"], env=[*plateaus["env"].unique()], model=FREE)
        found["model_free"] = rows["model_free"].loc[free.index.union(found.get("model_free", free[:0]).index)]
    return found


def sharing(rows: pd.DataFrame, others: pd.DataFrame, columns: list[str]) -> pd.DataFrame:
    """Those of ``rows`` that have the values of some row of ``others`` in these columns."""
    return rows[rows.set_index(columns).index.isin(others.set_index(columns).index)]


def commands(wanted: Mapping[str, pd.DataFrame], folder: str = "runs") -> list[str]:
    """That make these rows, recipe by recipe, seed by seed, each command once. folder: of all runs."""
    found = list[str]()
    for recipe in RECIPES:
        made = [recipe.made(wanted[name]) for name in recipe.tables if name in wanted]
        rows = pd.concat(made) if made else pd.DataFrame({"seed": []})
        for seed, part in rows.groupby("seed"):
            found += recipe.commands(part, str(seed), folder)
    return list(dict.fromkeys(found))


def differences(before: Mapping[str, pd.DataFrame], after: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Of each table and metric: rows, those that are there again, and how far their values then lie from those before,
    in units and as a share of the metric's standard deviation before, where it has one; the furthest first."""
    lines = []
    for name, old in before.items():
        about = [column for column in old if column not in ("value", "n")]
        both = old.merge(after[name], on=about, suffixes=("", "_again"), how="left")
        for metric, part in both.groupby("metric"):
            off = (part["value_again"] - part["value"]).abs()
            spread = part["value"].std()
            lines.append({
                "table": name, "metric": metric, "rows": len(part), "there again": int(off.notna().sum()),
                "equal": int((off == 0).sum()), "largest difference": off.max(),
                "mean / deviation": off.mean() / (spread if spread > 0 else np.nan),
            })  # fmt: skip
    return pd.DataFrame(lines).sort_values("mean / deviation", ascending=False, ignore_index=True)


# The command ---------------------------------------------------------------------------------------------------------


def words(line: str) -> list[str]:
    """A command's words, with this interpreter in place of ``python``."""
    found = shlex.split(line)
    return [sys.executable if found[0] == "python" else str(ROOT / found[0]), *found[1:]]


def missing(lines: Sequence[str]) -> dict[str, str]:
    """Interpreters of other environments that are not there, and the page that tells how to install them."""
    others = {shlex.split(line)[0] for line in lines} - {"python"}
    pages = {name: f"benchmarks/{name.split('/')[1]}/README.md" for name in others}
    return {name: page for name, page in sorted(pages.items()) if not (ROOT / name).exists()}


def page() -> str:
    """Every command as docs/reproducing.md has it, with the seeds of the rows that ship."""
    rows, lines = shipped(), ['rows="python benchmarks/settings/rows.py" seed=0']
    for recipe in RECIPES:
        made = pd.concat([recipe.made(rows[name]) for name in recipe.tables if name in rows])
        if not (commands := recipe.commands(made, "$seed")):
            continue
        part = f" ({recipe.part})" if recipe.part else ""
        lines += ["", f"# {', '.join(recipe.tables)}{part}: {_seeds(recipe, made)}"]
        for line in commands:
            lines.append(line.replace(f"python {ROWS}", "$rows"))
    return "\n".join(
        ["```{code-block} bash", *lines, "", f"# {JUDGED}, the pages, and the checksums of all", CLAIMS, "```"]
    )


def _seeds(recipe: Recipe, rows: pd.DataFrame) -> str:
    """Of which seeds a recipe has rows: of all environments and models alike, or of each."""
    told = {}
    for env in recipe.envs:
        of = rows[rows["env"] == recipe.env_of_rows(env)]
        models: dict[str, list[str]] = {}
        for word in (*recipe.models, *recipe.extra_models[:1] * (not recipe.models)):
            if there := sorted(set(of["seed"][of["model"] == word])):
                models.setdefault(span(there), []).append(word)
        most = max(models, key=lambda seeds: len(models[seeds]), default="no rows ship")
        told[env] = "; ".join([most, *(f"{', '.join(models[one])}: {one}" for one in models if one != most)])
    if len(set(told.values())) == 1:
        return told[recipe.envs[0]]
    return "; ".join(f"{env} ({text})" for env, text in told.items())


def span(seeds: Sequence[int]) -> str:
    """seed 0; seeds 0 to 4; seeds 0, 2."""
    if len(seeds) > 2 and seeds[-1] - seeds[0] == len(seeds) - 1:
        return f"seeds {seeds[0]} to {seeds[-1]}"
    return f"seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}"


def verdict(one: Claim, rows: Mapping[str, pd.DataFrame]) -> evaluate.Verdict:
    """Of a claim, by some rows."""
    return evaluate.judge(one, evaluate.Tables(rows))


def compared(one: Claim, before: Mapping[str, pd.DataFrame], after: Mapping[str, pd.DataFrame]) -> str:
    """Both verdicts on a claim, and the check that decided the first, then and now."""
    old, new = verdict(one, before), verdict(one, after)
    (again,) = (effect for effect in new.effects[""] if effect.check.text == old.key.check.text)
    return f"{one.id}: {old.word}, again {new.word}\n  {old.key.check.text}\n  {old.key.text}\n  again {again.text}"


def folder() -> Path:
    """Of all runs."""
    return runs.home() / (os.environ.get("TSM_RUN_DIR") or "runs")


def keep(place: Path, request: Mapping[str, files.Json]) -> None:
    """Copy the tables to ``place``, as a whole or not at all, and say for which request."""
    made = Path(f"{place}.partial")
    shutil.copytree(RESULTS, made, dirs_exist_ok=True)
    files.write_bytes(made / REQUEST, files.dumps(made / REQUEST, dict(request)).encode())
    made.rename(place)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", help="tables of data/results, claims (C46), questions (Q1), or all")
    parser.add_argument("--seeds", type=int, nargs="+", default=[], help="default: all that have such rows")
    parser.add_argument(
        "--subject", default=PAPERS, choices=(PAPERS, OURS), help=f"model that a claim is about (default {PAPERS})"
    )
    parser.add_argument("--list", action="store_true", help="print the commands, and run none")
    parser.add_argument("--page", action="store_true", help="write the commands into docs/reproducing.md")
    given = parser.parse_args()
    if given.page:
        between(PAGE, MARKS, page())
        return
    place, request = folder() / "reproduce", {"what": given.what, "seeds": given.seeds, "subject": given.subject}
    if place.is_dir() and not given.list:
        if (stopped := files.loads((place / REQUEST).read_bytes())) != request:
            parser.error(
                f"{place} keeps the tables from before a command that was stopped, {stopped}; run that one to its end, "
                "or delete the folder to compare with what is there now"
            )
        print(f"compared with the tables in {place}, kept by this command as it was stopped")
    rows = shipped(place) if place.is_dir() else shipped()
    known = {one.id: one for one in (*claims(given.subject), *questions())}
    if not given.what or (unknown := [name for name in given.what if name not in (*rows, *known, "all")]):
        which = f"no table or claim is called {', '.join(unknown)}" if given.what else "nothing is named"
        parser.error(f"{which}; there are {', '.join(rows)}; claims C01 to C54; questions Q1 to Q7; all")
    chosen = [known[name] for name in given.what if name in known]
    parts = [with_sources(rows_of_claims(chosen, rows), rows)]
    parts += [{name: rows[name] for name in rows if name in given.what or "all" in given.what}]
    wanted = {
        name: (found := pd.concat(some))[~found.index.duplicated()].sort_index()
        for name in rows if (some := [part[name] for part in parts if name in part])
    }  # fmt: skip
    seeds = sorted({int(seed) for table in wanted.values() for seed in table["seed"]})
    if not seeds:
        parser.error(f"{', '.join(given.what)} has no rows that ship")
    if given.seeds:
        wanted = {name: select(table, seed=given.seeds) for name, table in wanted.items()}
        if lacking := sorted(set(given.seeds) - set(seeds)):
            parser.error(f"no rows of seed {', '.join(map(str, lacking))} ship; there are {span(seeds)}")
    lines = commands(wanted, shlex.quote(os.path.relpath(folder(), ROOT)))
    if given.list:
        print("\n".join([*lines, CLAIMS]))
        return
    if others := missing(lines):
        how = "; ".join(f"{name} (how to install it: {where})" for name, where in others.items())
        parser.error(f"these commands need another environment: {how}; --list prints the commands")
    if not place.is_dir():
        keep(place, request)
    for i, line in enumerate([*lines, CLAIMS], 1):
        print(f"[{i} of {len(lines) + 1}] {line}", flush=True)
        if code := subprocess.run(words(line), cwd=ROOT, check=False).returncode:
            raise SystemExit(
                f"{line}\nended with status {code}; what was made before it stays, and the same command goes on"
            )
    after = shipped()
    found = differences({name: table for name, table in wanted.items() if len(table)}, after)
    print(found.head(FURTHEST).to_string(index=False, float_format="{:.3g}".format))
    print(f"{len(found)} metrics, the furthest first; {found['equal'].sum()} of {found['rows'].sum()} rows are equal")
    for name in rows:
        if more := len(after[name]) - len(rows[name]):
            print(f"{name} has {more:+} rows")
    print("\n".join(compared(one, rows, after) for one in chosen))
    shutil.rmtree(place)


if __name__ == "__main__":
    main()
