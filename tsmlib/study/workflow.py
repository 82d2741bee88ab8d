"""A workflow: notebooks of several seeds, and each job that they need, as steps of processes of their own.

With the extra ``cluster`` Snakemake runs the steps, on this machine or through any of its executor plugins; without it
the notebooks run here one after another, and make ahead what they need (``parallel``). Either way the same files.

The workflow of a scale has a folder beside its seeds, ``runs/<scale>/workflow``: ``steps.json``, a log and a benchmark
of each step, markers of those that are done, and the versions of the code that made them.
"""

from __future__ import annotations

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

from tsmlib.storage import files, manifest
from tsmlib.storage.files import writer_lock
from tsmlib.storage.provenance import provenance
from tsmlib.study import notebooks
from tsmlib.study.data import require_other_seed
from tsmlib.study.jobs import Job, Model, complete
from tsmlib.study.needed import needs
from tsmlib.study.notebooks import Execution, terminable
from tsmlib.study.parallel import cores
from tsmlib.study.parameters import ParameterError
from tsmlib.study.runs import NOTEBOOKS, Notebook, Run, RunError

SNAKEFILE = Path(__file__).with_name("Snakefile")
POOL = "pool"  # in place of an executor: no Snakemake
INSTALL = f"{sys.executable} -m pip install 'tsmlib[cluster]'"
MEMORY = {"data": 2000, "model": 2000, "scores": 4000, "plan": 2000, "policy": 2000, "notebook": 4000}  # MB, first try
READS = {"06_robustness": ("03_predict", "04_latent")}  # notebooks whose tables of the same seed another one shows
SEEDS = "seeds"  # in place of a seed in the name of a step of several
CLAIMS = "08_claims"  # reads the tables of all, at scale paper of every seed


@dataclass(frozen=True)
class Step:
    """One process: a job, of one seed or of several at once, or a notebook.

    done: its marker. command: of ``python -m tsmlib step``. minutes: until the first try is given up. makes: the files
    of a job, relative to the seeds' folders. ships: whether something that comes with the package is taken in place of
    what it would make.
    """

    kind: str
    done: str
    needs: list[str]
    settings: str
    command: str
    minutes: int
    mem_mb: int
    makes: list[str] = field(default_factory=list)
    ships: bool = False


def steps(executions: Sequence[Execution], given: Mapping[str, str]) -> dict[str, Step]:
    """Name -> step, of notebooks and all that they need. given: parameters of the notebooks, as typed.

    A job that two notebooks need with other settings, plans for more targets for instance, is made for the first; the
    other makes its own when it comes to it, once the first is done. A model that is trained with several seeds as one
    (``trained_as_one``) is a step of all of them.
    """
    found: dict[str, Step] = {}
    first: dict[str, str] = {}  # step of a job -> step of the notebook that it is made for
    as_one = trained_as_one(executions)

    options = [word for name, text in given.items() for word in ("-p", f"{name}={text}")]

    def named(run: Run, job: Job) -> str:
        """The step that makes a job."""
        return f"{SEEDS if job.name in as_one else f'seed{run.seed}'}/{job.name}"

    def command(each: Execution, *words: str) -> list[str]:
        run = each.run
        return [_word(each.notebook), *words, "--scale", run.scale, "--device", run.device, *options]

    def add(each: Execution, job: Job) -> str:
        """That step, after those that it needs."""
        run, name = each.run, named(each.run, job)
        if name not in found:
            of = as_one[job.name][1] if job.name in as_one else [each]
            before, settings = [add(one, other) for one in of for other in job.needs(one.run)], _settings(run, job)
            words = command(each, "--job", job.name, "--seed", ",".join(str(one.run.seed) for one in of))
            made = _step(run, job.kind, name, before, settings, words, job.seconds(run))
            makes = [f"seed{one.run.seed}/{job.name}.safetensors" for one in of]
            found[name] = replace(made, makes=makes, ships=job.ships(run))
            first[name] = f"seed{run.seed}/{run.notebook}"
        return name

    for each in executions:
        run = each.run
        mine, seed = f"seed{run.seed}/{run.notebook}", f"seed{run.seed}"
        inputs: dict[str, None] = {}
        for job in (wanted := needs(run)):
            inputs[name := add(each, job)] = None
            if found[name].settings != _settings(run, job):
                inputs[first[name]] = None
        for job in wanted:  # what others wait for, the notebook need not
            for other in job.needs(run):
                inputs.pop(named(run, other), None)
        reads = [f"{seed}/{stem}" for stem in READS.get(run.notebook, ())]
        if run.notebook == CLAIMS:
            reads = [name for name in found if found[name].kind == "notebook" and not name.endswith(CLAIMS)]
        inputs |= dict.fromkeys(name for name in reads if name in found)
        words = command(each, "--seed", str(run.seed))
        found[mine] = _step(run, "notebook", mine, list(inputs), "", words, 1800.0)
    return found


def trained_as_one(executions: Sequence[Execution]) -> dict[str, tuple[Model, list[Execution]]]:
    """Models that several seeds need on a GPU, where they are trained as one: by the names of their jobs, with a
    notebook of each seed that needs them."""
    found: dict[str, tuple[Model, dict[int, Execution]]] = {}
    for each in executions:
        for job in needs(each.run) if each.run.device != "cpu" else ():
            if isinstance(job, Model) and not job.ships(each.run):
                found.setdefault(job.name, (job, {}))[1].setdefault(each.run.seed, each)
    return {name: (job, list(of.values())) for name, (job, of) in found.items() if len(of) > 1}


def _settings(run: Run, job: Job) -> str:
    return json.dumps(job.settings(run), sort_keys=True)


def _word(notebook: Notebook) -> str:
    """What names a notebook on a command line: of a copy its path."""
    return notebook.name if notebook.path.parent == NOTEBOOKS else str(notebook.path)


def _step(run: Run, kind: str, name: str, needs: list[str], settings: str, command: list[str], seconds: float) -> Step:
    minutes, memory = 10 + round(seconds / 15), MEMORY[kind]  # four times what it should take
    if run.scale == "smoke":
        minutes, memory = 10, memory // 2
    return Step(kind, f"done/{kind}/{name}", needs, settings, shlex.join(command), minutes, memory)


def prepare(
    chosen: Sequence[Notebook], seeds: Sequence[int], *, scale: str, device: str, given: Mapping[str, str]
) -> list[Execution]:
    """Every notebook with every seed, checked before any file exists; the claims, which read all others, at the end.

    Raises ParameterError, for seeds of held-out episodes and targets too.
    """
    require_other_seed(*seeds)
    last = sorted(chosen, key=lambda notebook: notebook.stem == CLAIMS)
    claims = [notebook for notebook in last if notebook.stem == CLAIMS]
    order = [(notebook, seed) for seed in seeds for notebook in last if notebook not in claims]
    order += [(notebook, seed) for seed in seeds for notebook in claims]
    return [notebooks.prepare(one, scale=scale, seed=seed, device=device, given=given) for one, seed in order]


def run_all(
    executions: Sequence[Execution], given: Mapping[str, str], *,
    executor: str = "", jobs: int = 0, dry_run: bool = False, any_code: bool = False, more: Sequence[str] = (),
) -> int:  # fmt: skip
    """Run notebooks and what they need as a workflow. Returns an exit status.

    executor: a plugin of Snakemake's, 'local' (this machine), or 'pool' (this machine without Snakemake); '' is local
    where Snakemake is installed, else pool. jobs: at a time; 0 is one for each core here, 100 elsewhere. dry_run: list
    the steps, and do nothing. any_code: go on with what another version of the code made. more: options of Snakemake.
    Raises RunError where another process holds the workflow, the code changed or something is not installed.
    """
    executor = executor or ("local" if importlib.util.find_spec("snakemake") else POOL)
    _require_executor(executor)
    table, folder = steps(executions, given), executions[0].run.dir.parent / "workflow"
    runs = list({execution.run.dir: execution.run for execution in executions}.values())
    os.environ["TSM_RUN_DIR"] = str(folder.parents[1])
    if dry_run:
        _require_code(folder, runs, any_code=any_code)
        _list(table, folder)
        if executor == POOL:
            return 0
        with tempfile.TemporaryDirectory() as place:
            where = folder if folder.is_dir() else Path(place)
            return _snakemake(
                table, where, Path(place) / "steps.json", executor, jobs, ["--dry-run", "--quiet", "rules", *more]
            )
    with _held(folder, [run.seed for run in runs]):
        codes = _require_code(folder, runs, any_code=any_code)
        manifest.write_json(folder / "code.json", {"codes": codes})
        if executor == POOL:
            os.environ.setdefault("OMP_NUM_THREADS", "1")  # in kernels, as in the steps of Snakemake
            for model, of in trained_as_one(executions).values():
                model.make_as_one([each.run for each in of])
            for execution in executions:
                print(notebooks.execute(execution))
            return 0
        return _snakemake(table, folder, folder / "steps.json", executor, jobs, more)


def step(executions: Sequence[Execution], job: str) -> None:
    """One step of a workflow: a job that a notebook needs, by its name, or the notebook itself where that is ''.

    executions: of one notebook; with several seeds where a model is trained with them as one. Waits for whoever makes
    the same, an orphan of a workflow that was killed for instance; then it is there, or goes on from its checkpoint.
    RunError where this is not the code of the workflow, ParameterError for a job that the notebook does not need, or
    that is no model, with several seeds.
    """
    execution, runs = executions[0], [each.run for each in executions]
    run = runs[0]
    codes, now = _codes(run.dir.parent / "workflow"), str(provenance()["code"])
    if codes and codes[-1] != now:
        raise RunError(
            f"this step runs tsmlib {now}, its workflow {codes[-1]}: the code was changed meanwhile, or this machine "
            "has another. Stop the workflow, bring that version back or start it again with --any-code."
        )
    if not job and len(runs) == 1:
        notebooks.execute(execution, progress=False, wait=True)
        return
    known = complete(run, needs(run))
    if job not in known:
        raise ParameterError(f"{run.notebook} needs no {job!r:.80}; it needs {', '.join(known) or 'nothing'}.")
    with terminable(), ExitStack() as held:
        for one in sorted(runs, key=lambda one: one.seed):
            held.enter_context(writer_lock(one.dir / ".locks", job, name=job.replace("/", "."), wait=True))
        if len(runs) == 1:
            known[job].make(run)
        elif isinstance(model := known[job], Model):
            model.make_as_one(runs)
        else:
            raise ParameterError(f"{job} is made with one seed at a time; only models are trained with several as one.")


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


def _require_code(folder: Path, runs: Sequence[Run], *, any_code: bool) -> list[str]:
    """The versions of the code in a workflow's folder and in its seeds, this one at the end.

    RunError naming both where it differs, unless ``any_code``.
    """
    now, accepted = str(provenance()["code"]), _codes(folder)
    others = {code: f"{folder}" for code in accepted[-1:] if code != now}
    for run in runs:
        for name, entry in manifest.statuses(run.dir).items():
            code = entry.get("provenance", {}).get("code") if isinstance(entry, dict) else None
            if code not in (None, now, *accepted):
                others[str(code)] = f"{name} in {run.dir}"
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


def _list(table: Mapping[str, Step], folder: Path) -> None:
    """Print the steps that are not there yet."""
    missing = [name for name in table if not _made(name, table[name], folder)]
    for name in missing:
        print(f"{table[name].kind:8} {name}")
    print(f"{len(missing)} of {len(table)} steps are not there yet")


def _made(name: str, step: Step, folder: Path) -> bool:
    """Whether what a step makes is there, or ships; if it still holds, only the step can tell."""
    if step.kind == "notebook":
        seed, _, rest = name.partition("/")
        entry = manifest.statuses(folder.parent / seed).get(rest, {})
        return isinstance(entry, dict) and entry.get("state") == "complete"
    return step.ships or all((folder.parent / file).exists() for file in step.makes)


def _snakemake(
    table: Mapping[str, Step], folder: Path, listed: Path, executor: str, jobs: int, more: Sequence[str]
) -> int:
    """Snakemake in this process, so that the lock of the folder lives as long as it does."""
    from snakemake.cli import main as snakemake

    files.write_bytes(listed, json.dumps({name: asdict(step) for name, step in table.items()}, indent=1).encode())
    gone = [
        step.done for name, step in table.items() if (folder / step.done).exists() and not _made(name, step, folder)
    ]
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
        if executor == "slurm" and "--slurm-status-command" not in more and not _accounting():
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
