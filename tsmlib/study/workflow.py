"""A workflow: notebooks of several seeds, and each job that they need, as steps of processes of their own.

With the extra ``cluster`` Snakemake runs the steps, on this machine or through any of its executor plugins; without it
the notebooks that are not complete run here one after another, and make ahead what they need (``parallel``). Either way
the same files, and one that fails ends nothing but what needs it.

The workflow of a scale has a folder beside its seeds, ``runs/<scale>/workflow``: the versions of the code that made
what is there, and with Snakemake ``steps.json``, a log and a benchmark of each step, and markers of those that are
done.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import psutil

from tsmlib.storage import artifacts, files, manifest
from tsmlib.storage.files import writer_lock
from tsmlib.storage.provenance import provenance
from tsmlib.study import notebooks
from tsmlib.study.data import require_other_seed
from tsmlib.study.jobs import Job, SeedsJob, complete
from tsmlib.study.needed import needs
from tsmlib.study.notebooks import Execution, code_sha256, environment, terminable
from tsmlib.study.parallel import cores, precompute
from tsmlib.study.parameters import ParameterError
from tsmlib.study.remote_jobs import ask_again
from tsmlib.study.runs import NOTEBOOKS, Notebook, Run, RunError

SNAKEFILE = Path(__file__).with_name("Snakefile")
POOL = "pool"  # in place of an executor: no Snakemake
LOCAL_EXECUTORS = ("", "local", POOL)  # those of this machine
INSTALL = f"{sys.executable} -m pip install 'tsmlib[cluster]'"
MEMORY = {"data": 2000, "model": 2000, "scores": 4000, "plan": 2000, "policy": 2000, "notebook": 4000}  # MB, first try
COPY = 500  # MB more for each further seed of a training of several: its data
AT_ONCE = 10  # seeds of a group
STORAGE = "--default-storage-provider"  # of Snakemake: markers lie elsewhere
READS = {"06_robustness": ("03_predict", "04_latent")}  # notebooks whose tables of the same seed another one shows
MINUTES = {"10_explore": 240}  # that a notebook takes at scale paper on one core, where it is more than USUAL_MINUTES
USUAL_MINUTES = 30
CLAIMS = "08_claims"  # reads the tables of all, at scale paper of every seed


@dataclass(frozen=True)
class Step:
    """One process: a job, of one seed or of several at once, or a notebook.

    done: its marker. settings: where they change it is done again; of a notebook, ``code_sha256``. command: of ``python
    -m tsmlib step``. minutes: until the first try is given up. files: what a job makes, relative to the folder of the
    scale. ships: whether something that comes with the package is taken in place of that.
    """

    kind: str
    done: str
    needs: list[str]
    settings: str
    command: str
    minutes: int
    mem_mb: int
    files: list[str] = field(default_factory=list)
    ships: bool = False


def steps(executions: Sequence[Execution], given: Mapping[str, str]) -> dict[str, Step]:
    """Name -> step, of notebooks and all that they need. given: parameters of the notebooks, as typed; the folder of
    the runs is not repeated, since steps find it in TSM_RUN_DIR.

    A job that two notebooks need with other settings, plans for more targets for instance, is made for the first; the
    other makes its own when it comes to it, once the first is done. What several seeds make as one
    (``seed_groups``) is a step of all of them.
    """
    found: dict[str, Step] = {}
    made_for: dict[str, str] = {}  # step of a job -> step of the notebook that it is made for
    groups = seed_groups(executions)
    options = [word for name, text in given.items() if name != "run_dir" for word in ("-p", f"{name}={text}")]

    def at(run: Run, *seeds: str, kind: str = "") -> list[str]:
        device = "cpu" if kind == "data" else run.device  # simulators need no other
        return ["--scale", run.scale, *seeds, "--device", device, *options]

    def name_of(execution: Execution, job: Job) -> str:
        """Of the step that makes a job."""
        seeds = sorted(each.run.seed for each in groups.get((execution.run.seed, job.name), [execution]))
        return f"{f'seeds{seeds[0]}-{seeds[-1]}' if len(seeds) > 1 else f'seed{seeds[0]}'}/{job.name}"

    def add(execution: Execution, job: Job) -> str:
        """Add the step of a job, and before it those that it needs. Returns its name."""
        name, group = name_of(execution, job), groups.get((execution.run.seed, job.name), [execution])
        if name not in found:
            run, seeds = execution.run, [str(each.run.seed) for each in group]
            before = [add(each, other) for each in group for other in job.needs(each.run)]
            which = ["--seed", seeds[0]] if len(seeds) == 1 else ["--seeds", ",".join(seeds)]
            command = [_word(execution.notebook), "--job", job.name, *at(run, *which, kind=job.kind)]
            step = _step(run, job.kind, name, before, _settings(run, job), command, job.seconds(run), len(group))
            written = [f"seed{seed}/{job.name}.safetensors" for seed in seeds]
            found[name] = replace(step, files=written, ships=job.ships(run))
            made_for[name] = _name(run)
        return name

    for execution in executions:
        run = execution.run
        notebook, seed = _name(run), f"seed{run.seed}"
        inputs: dict[str, None] = {}
        for job in (wanted := needs(run)):
            inputs[name := add(execution, job)] = None
            if found[name].settings != _settings(run, job):
                inputs[made_for[name]] = None
        for job in wanted:  # what others wait for, the notebook need not
            for other in job.needs(run):
                inputs.pop(name_of(execution, other), None)
        reads = [f"{seed}/{stem}" for stem in READS.get(run.notebook, ())]
        if run.notebook == CLAIMS:
            reads = [name for name in found if found[name].kind == "notebook" and not name.endswith(CLAIMS)]
        inputs |= dict.fromkeys(name for name in reads if name in found)
        command = [_word(execution.notebook), *at(run, "--seed", str(run.seed))]
        seconds, typed = 60 * MINUTES.get(run.notebook, USUAL_MINUTES), code_sha256(execution.notebook.path)
        found[notebook] = _step(run, "notebook", notebook, list(inputs), typed, command, seconds)
    return found


def seed_groups(executions: Sequence[Execution]) -> dict[tuple[int, str], list[Execution]]:
    """Models and policies that several seeds need on a GPU, where at most ``AT_ONCE`` of them are made as one.

    (Seed, name of the job) -> a notebook of each seed of its group that needs it; the groups by their seeds.
    """
    need: dict[tuple[str, str], dict[int, Execution]] = {}  # by name and settings
    known: set[tuple[int, str]] = set()
    for execution in executions:
        run = execution.run
        for job in needs(run) if run.device != "cpu" else ():
            if isinstance(job, SeedsJob) and not job.ships(run) and (run.seed, job.name) not in known:
                known.add((run.seed, job.name))
                need.setdefault((job.name, _settings(run, job)), {})[run.seed] = execution
    found: dict[tuple[int, str], list[Execution]] = {}
    for (name, _), of in need.items():
        in_order = [of[seed] for seed in sorted(of)]
        for first in range(0, len(in_order), AT_ONCE):
            if len(group := in_order[first : first + AT_ONCE]) > 1:
                found |= {(each.run.seed, name): group for each in group}
    return found


def _settings(run: Run, job: Job) -> str:
    return json.dumps(job.settings(run), sort_keys=True)


def _name(run: Run) -> str:
    """Of the step of a notebook."""
    return f"seed{run.seed}/{run.notebook}"


def _word(notebook: Notebook) -> str:
    """What names a notebook on a command line: of a copy its path."""
    return notebook.name if notebook.path.parent == NOTEBOOKS else str(notebook.path)


def _step(
    run: Run, kind: str, name: str, needs: list[str], settings: str, command: list[str], seconds: float,
    copies: int = 1,
) -> Step:  # fmt: skip
    minutes = 10 + round(copies * seconds / 15)  # four times what it should take, of copies one after another
    memory = MEMORY[kind] + (copies - 1) * COPY
    if run.scale == "smoke":
        minutes, memory = 10, memory // 2
    return Step(kind, f"done/{kind}/{name}", needs, settings, shlex.join(command), minutes, memory)


def prepare(
    chosen: Sequence[Notebook], seeds: Sequence[int], *, scale: str, device: str, given: Mapping[str, str],
    executor: str = "",
) -> list[Execution]:  # fmt: skip
    """Every notebook with every seed, checked before any file exists; the claims, which read all others, at the end.
    executor: as in ``run_all``; where it is a cluster's, this machine need not have the device.

    Raises ParameterError, for seeds of held-out episodes and targets too.
    """
    require_other_seed(*seeds)
    last = sorted(chosen, key=lambda notebook: notebook.stem == CLAIMS)
    claims = [notebook for notebook in last if notebook.stem == CLAIMS]
    order = [(notebook, seed) for seed in seeds for notebook in last if notebook not in claims]
    order += [(notebook, seed) for seed in seeds for notebook in claims]
    elsewhere = executor not in LOCAL_EXECUTORS
    return [
        notebooks.prepare(one, scale=scale, seed=seed, device=device, given=given, elsewhere=elsewhere)
        for one, seed in order
    ]


def run_all(
    executions: Sequence[Execution], given: Mapping[str, str], *,
    executor: str = "", jobs: int = 0, dry_run: bool = False, any_code: bool = False, more: Sequence[str] = (),
) -> int:  # fmt: skip
    """Run notebooks and what they need as a workflow. Returns an exit status.

    executor: a plugin of Snakemake's, 'local' (this machine), or 'pool' (this machine without Snakemake); '' is local
    where Snakemake is installed, else pool. jobs: at a time; 0 is as many as ``cores`` says here, 100 elsewhere.
    dry_run: list the steps, and do nothing. any_code: go on with what another version of the code made. more: options
    of Snakemake. Raises ParameterError for a negative number of jobs, for options of Snakemake's without it and for a
    kind of step that there is not, RunError where another process holds the workflow, the code changed or something is
    not installed.
    """
    executor = executor or ("local" if importlib.util.find_spec("snakemake") else POOL)
    if jobs < 0:
        raise ParameterError(f"--jobs is {jobs}, expected 1 or more, or 0 for as many as there are cores.")
    if more and executor == POOL:
        raise ParameterError(f"{' '.join(more)!r:.80} are options of Snakemake's, which the pool does without.")
    _require_kinds(more)
    _require_executor(executor)
    here = jobs or cores()
    table, folder = steps(executions, given), executions[0].run.dir.parent / "workflow"
    runs = list({execution.run.dir: execution.run for execution in executions}.values())
    os.environ["TSM_RUN_DIR"] = str(folder.parents[1])
    if dry_run:
        _require_code(folder, runs, table, any_code=any_code)
        _list(table, _undone(executions, table, folder))
        if executor == POOL:
            return 0
        with tempfile.TemporaryDirectory() as place:
            where, listed = folder if folder.is_dir() else Path(place), Path(place) / "steps.json"
            again = _again(executions, table, folder)
            return _snakemake(table, again, where, listed, executor, jobs, ["--dry-run", "--quiet", "rules", *more])
    with _held(folder, [run.seed for run in runs]):
        codes = _require_code(folder, runs, table, any_code=any_code)
        manifest.write_json(folder / "code.json", {"codes": codes})
        if executor == POOL:
            os.environ.setdefault("OMP_NUM_THREADS", "1")  # in kernels, as in the steps of Snakemake
            with environment(TSM_JOBS=str(here)):
                return _run_here(executions, table)
        again = _again(executions, table, folder)
        return _snakemake(table, again, folder, folder / "steps.json", executor, jobs, more)


def _run_here(executions: Sequence[Execution], table: Mapping[str, Step]) -> int:
    """Without Snakemake: the notebooks that are not there (``_undone``), one after another. Returns an exit status.

    Where one fails, those that need it are left out.
    """
    folder = executions[0].run.dir.parent / "workflow"
    _precompute_groups([each for each in executions if notebooks.outdated(each)])
    ended: dict[str, str] = {}
    failed: dict[str, str] = {}  # why
    for execution in executions:
        name = _name(execution.run)
        if lacking := [other for other in table[name].needs if other in failed]:
            failed[name] = f"not executed, since it needs {lacking[0]}"
            continue
        if why := _outdated(execution, table, folder, ended):
            print(f"{name} is executed: {why}")
            try:
                print(notebooks.execute(execution))
            except (RunError, ValueError) as error:  # ValueError: StoreError
                print(f"error: {error}", file=sys.stderr)
                failed[name] = str(error).partition("\n")[0]
                continue
        else:
            print(f"{name} is complete")
        ended[name] = notebooks.span(execution.run)[1]
    if failed:
        said = [f"{len(failed)} of {len(executions)} notebooks are not complete; the same command goes on with them:"]
        print(*said, *(f"{name}: {why}" for name, why in failed.items()), sep="\n  ", file=sys.stderr)
    return 1 if failed else 0


def _undone(executions: Sequence[Execution], table: Mapping[str, Step], folder: Path) -> dict[str, str]:
    """Steps that are to be done, and why."""
    found = {name: "it is not there" for name, step in table.items() if not _made(step, folder)}
    ended: dict[str, str] = {}
    for execution in executions:
        name = _name(execution.run)
        if why := _outdated(execution, table, folder, ended):
            found[name] = why
        else:
            ended[name] = notebooks.span(execution.run)[1]
    return found


def _again(executions: Sequence[Execution], table: Mapping[str, Step], folder: Path) -> dict[str, str]:
    """Steps that Snakemake is to do whatever their markers say, and why: those that are to be done, and those whose
    files were replaced since a notebook used them, so that what was made from these is made again, too."""
    used = {f"seed{each.run.seed}/{file}" for each in executions for file in notebooks.replaced(each.run)}
    changed = [name for name, step in table.items() if used.intersection(step.files)]
    return dict.fromkeys(changed, "its file was replaced") | _undone(executions, table, folder)


def _outdated(execution: Execution, table: Mapping[str, Step], folder: Path, ended: Mapping[str, str]) -> str:
    """Why a notebook is to be executed; '' where it need not be.

    It is, too, where something that it needs is gone, or another whose tables it shows was executed since it began.
    ended: when each complete notebook before it ended.
    """
    name = _name(execution.run)
    if why := notebooks.outdated(execution):
        return why
    if gone := sorted(other for other in _jobs(table, name) if not _made(table[other], folder)):
        return f"{gone[0]} is not there"
    began, _ = notebooks.span(execution.run)
    before = (other for other in table[name].needs if table[other].kind == "notebook")
    later = [other for other in before if not ended.get(other, "") or ended[other] > began]
    return f"{later[0]} was executed since, or is to be" if later else ""


def _jobs(table: Mapping[str, Step], name: str) -> set[str]:
    """Steps of all jobs that a step needs, and that these need."""
    own = {other for other in table[name].needs if table[other].kind != "notebook"}
    return own.union(*(_jobs(table, other) for other in own))


def _precompute_groups(executions: Sequence[Execution]) -> None:
    """What several seeds make as one, before the notebooks that need it, which meet an error again."""
    groups = seed_groups(executions)
    for (seed, name), group in groups.items():
        runs = [each.run for each in group]
        if seed != runs[0].seed:  # of the same group
            continue
        job = complete(runs[0], needs(runs[0]))[name]
        assert isinstance(job, SeedsJob)
        try:
            for run in runs:
                before = [each for each in job.needs(run) if (run.seed, each.name) not in groups]
                precompute(run, before, progress=f"before {job.name}, seed {run.seed}")
            _make_as_one(job, runs)
        except Exception as error:  # whatever a training may raise
            print(f"error: {job.name} of seeds {seed} to {runs[-1].seed}: {error!r}", file=sys.stderr)


def step(executions: Sequence[Execution], job: str) -> None:
    """One step of a workflow: a job that a notebook needs, by its name, or the notebook itself where that is ''.

    executions: a notebook with one seed; with several where a model or policy is made with them as one. Waits for
    whoever makes the same, an orphan of a workflow that was killed for instance; then it is there, or goes on from its
    checkpoint (models of several seeds have none). RunError where this is not the code of the workflow, ParameterError
    for a job that the notebook does not need, and for several seeds of anything else.
    """
    run = executions[0].run
    codes, now = _codes(run.dir.parent / "workflow"), str(provenance()["code"])
    if codes and codes[-1] != now:
        raise RunError(
            f"this step runs tsmlib {now}, its workflow {codes[-1]}: the code was changed meanwhile, or this machine "
            "has another. Stop the workflow, bring that version back or start it again with --any-code."
        )
    known = complete(run, needs(run))
    if job and job not in known:
        raise ParameterError(f"{run.notebook} needs no {job!r:.80}; it needs {', '.join(known) or 'nothing'}.")
    if len(executions) == 1:
        if not job:
            notebooks.execute(executions[0], progress=False, wait=True)
            return
        with terminable(), _locked([run], job):
            known[job].make(run)
    elif isinstance(found := known.get(job), SeedsJob):
        for other in (each.run for each in executions[1:]):
            its = complete(other, needs(other)).get(job)
            if its is None or _settings(other, its) != _settings(run, found):
                seeds = f"{run.seed} and {other.seed}"
                raise ParameterError(f"seeds {seeds} need {job} with different settings; make it with one at a time.")
        _make_as_one(found, [each.run for each in executions])
    else:
        raise ParameterError(
            f"{job or run.notebook} is made with one seed at a time; only models and policies are with several."
        )


def _make_as_one(job: SeedsJob, runs: Sequence[Run]) -> None:
    with terminable(), _locked(runs, job.name):
        job.make_as_one(runs)


@contextmanager
def _locked(runs: Sequence[Run], job: str) -> Iterator[None]:
    """Where no other process makes the job of these runs."""
    with ExitStack() as held:
        for run in sorted(runs, key=lambda run: run.seed):
            held.enter_context(writer_lock(run.dir / ".locks", job, name=job.replace("/", "."), wait=True))
        yield


@contextmanager
def _held(folder: Path, seeds: Sequence[int]) -> Iterator[None]:
    """The workflow's folder, as its only holder."""
    try:
        with writer_lock(folder, f"workflow of seeds {', '.join(map(str, seeds))}"):
            yield
    except files.StoreError as error:
        raise RunError(str(error)) from None


def _codes(folder: Path) -> list[str]:
    """Versions of the code that a workflow was run with, the last one at the end."""
    path = folder / "code.json"
    found = manifest.read_own_json(path).get("codes", []) if path.exists() else []
    return [str(code) for code in found] if isinstance(found, list) else []


def _require_code(folder: Path, runs: Sequence[Run], table: Mapping[str, Step], *, any_code: bool) -> list[str]:
    """The versions of the code in a workflow's folder, in the notebooks' statuses and in the files of steps, this one
    at the end.

    RunError naming both where it differs, unless ``any_code``.
    """
    now, accepted = str(provenance()["code"]), _codes(folder)
    others = {code: f"{folder}" for code in accepted[-1:] if code != now}
    for run in runs:
        for name, code in notebooks.codes(run).items():
            if code not in (now, *accepted):
                others[code] = f"{name} in {run.dir}"
    for file in (folder.parent / name for step in table.values() for name in step.files):
        if file.exists() and (code := artifacts.code(file)) not in ("", now, *accepted):
            others.setdefault(code, str(file))
    if others and not any_code:
        code, where = next(iter(others.items()))
        raise RunError(
            f"{where} was made by tsmlib {code}, this is {now}: results of two versions would lie beside each other. "
            "Bring that version back, take another folder with TSM_RUN_DIR, or, where what changed does not matter, "
            "add --any-code. Every file states the version that made it."
        )
    return [*(code for code in dict.fromkeys([*accepted, *others]) if code != now), now]


def _require_executor(name: str) -> None:
    """RunError saying what to install, where an executor is missing."""
    if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", name):
        raise ParameterError(f"executor is {name!r:.80}, expected local, {POOL}, slurm or another plugin's name.")
    if name == POOL:
        return
    if not importlib.util.find_spec("snakemake"):
        raise RunError(f"--executor {name} needs Snakemake, missing here: {INSTALL}")
    if name != "local" and not importlib.util.find_spec(f"snakemake_executor_plugin_{name.replace('-', '_')}"):
        package = "'tsmlib[cluster]'" if name == "slurm" else f"snakemake-executor-plugin-{name}"
        raise RunError(f"--executor {name} needs its plugin, missing here: {sys.executable} -m pip install {package}")


def _require_kinds(more: Sequence[str]) -> None:
    """ParameterError where options of Snakemake's are for a kind of step that there is not, which it would ignore."""
    option = ""
    for word in more:
        value = word
        if word.startswith("-"):
            option, _, value = word.partition("=")
        kind = re.split("[:=]", value)[0]
        if option in ("--set-resources", "--set-threads") and value and kind not in MEMORY:
            raise ParameterError(f"{option} names {kind!r:.80}, expected a kind of step: {', '.join(MEMORY)}.")


def _list(table: Mapping[str, Step], undone: Mapping[str, str]) -> None:
    """Print the steps that are not there yet."""
    missing = [name for name in table if name in undone]
    for name in missing:
        print(f"{table[name].kind:8} {name}")
    print(f"{len(missing)} of {len(table)} steps are not there yet")


def _made(step: Step, folder: Path) -> bool:
    """Whether what a job makes is there, or ships; if it still holds, only the step can tell. True of a notebook."""
    return step.ships or all((folder.parent / file).exists() for file in step.files)


def _snakemake(
    table: Mapping[str, Step], again: Mapping[str, str], folder: Path, listed: Path, executor: str, jobs: int,
    more: Sequence[str],
) -> int:  # fmt: skip
    """Snakemake in this process, so that the lock of the folder lives as long as it does. again: steps that are done
    again where they have a marker, and why."""
    from snakemake.cli import main as snakemake

    files.write_bytes(listed, json.dumps({name: asdict(step) for name, step in table.items()}, indent=1).encode())
    elsewhere = any(word.partition("=")[0] == STORAGE for word in more)  # where its plugin alone can look
    gone = {
        step.done: again[name] for name, step in table.items()
        if name in again and (elsewhere or (folder / step.done).exists())
    }  # fmt: skip
    if elsewhere:
        print(f"{len(gone)} steps are done, whatever their markers in storage say")
    else:
        for done, why in gone.items():
            print(f"{done.removeprefix('done/')} is done again: {why}")
    options = [
        "--snakefile", str(SNAKEFILE), "--directory", str(folder), "--config", f"steps={listed}",
        "--nolock", "--keep-going", "--retries", "2", "--rerun-incomplete", "--rerun-triggers", "mtime", "params",
        "--show-failed-logs",
        *(["--forcerun", *gone] if gone else []),
    ]  # fmt: skip
    if executor == "local":
        memory = psutil.virtual_memory().total * 8 // 10 // 10**6
        options += ["--cores", str(jobs or cores()), "--resources", f"mem_mb={memory}"]
    else:
        options += ["--executor", executor, "--jobs", str(jobs or 100), "--latency-wait", "60"]
        if executor == "slurm":
            ask_again(importlib.import_module("snakemake_executor_plugin_slurm").Executor)
            if "--slurm-status-command" not in more and not _accounting():
                print("this Slurm keeps no accounts: jobs are watched with squeue", file=sys.stderr)
                options += ["--slurm-status-command", "squeue"]
    try:
        snakemake([*options, *more])
    except SystemExit as end:
        if end.code and "--dry-run" not in more:
            print(f"what went wrong stands in {folder / 'log'}; the same command goes on", file=sys.stderr)
        return int(end.code or 0) if not isinstance(end.code, str) else 1
    return 0


def _accounting() -> bool:
    """Whether sacct answers; where slurmdbd is missing, the executor would never learn that a job ended."""
    command = shutil.which("sacct")
    return bool(command) and subprocess.run([str(command), "-n"], capture_output=True, check=False).returncode == 0
