"""R1, R14 on a cluster: a Slurm of two nodes on this machine, in which jobs, nodes and controllers are killed.

Needs the packages slurm-wlm and munge of Debian, root, and the extra ``cluster``. All lies in temporary folders and
listens on 127.0.0.1 alone; neither systemd nor cgroups are used. Two nodes are two slurmd, so what is not tried: a
second machine, a network file system, accounting (slurmdbd), limits of memory.
"""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import nbformat
import psutil

from reliability.pipelines import numbers
from reliability.world import Outcome, folder
from tsmlib.study.runs import ROOT

PORT = 16817  # of the first controller; those of its nodes follow
CLUSTERS = 3  # side by side in the long form: most of a trial is spent waiting
NODES = ("n1", "n2")
SEEDS = "0,2"
KILLED = ("job", "node", "controller", "workflow")
IN_TURN = ("job", "node", "controller")
STEPS = 7  # of the workflow's ten: after none, one, ... six of them enough are left for three kills
CONFIGURATION = """ClusterName=test{number}
FirstJobId={first}
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={place}/munge/socket,cred_expire=5
CredType=cred/munge
CommunicationParameters=DisableIPv6,NoCtldInAddrAny,NoInAddrAny
SlurmctldPort={port}
StateSaveLocation={place}/state
SlurmctldPidFile={place}/slurmctld.pid
SlurmctldLogFile={place}/log/slurmctld.log
SlurmdSpoolDir={place}/spool-%n
SlurmdPidFile={place}/slurmd-%n.pid
SlurmdLogFile={place}/log/slurmd-%n.log
SlurmdParameters=config_overrides
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/linux
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SchedulerParameters=batch_sched_delay=0,sched_min_interval=0,bf_interval=1
ReturnToService=2
MpiDefault=none
MinJobAge=3600
JobRequeue=1
KillWait=10
SlurmdTimeout=15
MailProg=/bin/true
{nodes}
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
TABLE = """from tsmlib import study
from tsmlib.storage import tables
from tsmlib.study.runs import resolve
run = resolve("02_train", scale=scale, seed=seed, run_dir=run_dir, env=env, models=models)
study.precompute(run, study.needs(run))
net, header = study.load_or_train(run, env, models)
study.dataset(run, env, "test")
rows = [dict(env=env, model=models, metric=f"norm {name}", value=float(w.norm()), seed=run.seed, scale=run.scale)
        for name, w in net.state_dict().items()]
rows += [dict(env=env, model=models, metric="train_seconds", unit="s", value=header["seconds"])]
_ = tables.save(run.metrics / "02_train.csv", rows)"""


def missing() -> str:
    """What a cluster on this machine lacks; '' where it has all."""
    lacking = [name for name in ("slurmctld", "slurmd", "munged", "srun", "sbatch") if not shutil.which(name)]
    modules = ("snakemake", "snakemake_executor_plugin_slurm")
    lacking += [name for name in modules if importlib.util.find_spec(name) is None]
    return f"no {', '.join(lacking)}" if lacking else "" if os.geteuid() == 0 else "starts daemons as root"


@dataclass(frozen=True)
class Slurm:
    """A controller and two nodes in a folder. Clusters of different numbers share no port and no number of a job."""

    place: Path
    number: int = 0

    @property
    def environment(self) -> dict[str, str]:
        """Of every command of Slurm's. The executor drops SLURM_CONF before srun, which is given it again."""
        path = f"{self.place / 'bin'}:{os.environ['PATH']}"
        return {**os.environ, "SLURM_CONF": str(self.place / "slurm.conf"), "PATH": path}

    def command(self, *words: str) -> str:
        done = subprocess.run(words, env=self.environment, capture_output=True, text=True, check=False)
        return done.stdout.strip()

    def start(self) -> None:
        for name in ("state", "log", "munge", "bin", *(f"spool-{node}" for node in NODES)):
            (self.place / name).mkdir(parents=True, exist_ok=True)
        port = PORT + self.number * (1 + len(NODES))
        key, srun = self.place / "munge" / "key", self.place / "bin" / "srun"
        key.write_bytes(os.urandom(1024))
        key.chmod(0o600)
        (self.place / "munge").chmod(0o711)
        memory = psutil.virtual_memory().total // 2**21 - 512
        nodes = [
            f"NodeName={node} NodeHostname={socket.gethostname()} NodeAddr=127.0.0.1 Port={port + 1 + i} CPUs=1 "
            f"RealMemory={memory} State=UNKNOWN" for i, node in enumerate(NODES)
        ]  # fmt: skip
        conf = CONFIGURATION.format(
            number=self.number, first=1 + 100_000 * self.number, host=socket.gethostname(), place=self.place, port=port,
            nodes="\n".join(nodes),
        )  # fmt: skip
        (self.place / "slurm.conf").write_text(conf)
        srun.write_text(f'#!/bin/sh\nSLURM_CONF={self.place}/slurm.conf exec {shutil.which("srun")} "$@"\n')
        srun.chmod(0o755)
        munge = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
        options = [f"--{name}={self.place / 'munge' / file}" for name, file in munge.items()]
        subprocess.run(["munged", "--force", *options], check=True)
        self.start_controller()
        for node in NODES:
            self.start_node(node)
        wait_for(lambda: len(self.command("sinfo", "-h", "-N", "-t", "idle", "-o", "%N").split()) == len(NODES))

    def start_controller(self) -> None:
        subprocess.run(["slurmctld", "-f", self.place / "slurm.conf"], env=self.environment, check=True)

    def start_node(self, node: str) -> None:
        subprocess.run(["slurmd", "-f", self.place / "slurm.conf", "-N", node], env=self.environment, check=True)

    def resume(self) -> None:
        """Nodes that Slurm has set aside, as one on which it started a job twice, take jobs again."""
        for node in NODES:
            self.command("scontrol", "update", f"NodeName={node}", "State=RESUME")

    def pid(self, name: str) -> int:
        """Of slurmctld, slurmd-n1 or munge/pid."""
        return int((self.place / name).read_text())

    def running(self) -> list[tuple[str, str, psutil.Process]]:
        """Job, node and process of those jobs whose step of tsmlib has begun."""
        jobs = [line.split() for line in self.command("squeue", "-h", "-t", "R", "-o", "%A %N").splitlines()]
        return [(job, node, process) for job, node in jobs for process in self.processes(job) if is_step(process)]

    def processes(self, job: str) -> list[psutil.Process]:
        """Of a job: its steps' daemons, and all that they started."""
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error):
                daemon = process.name() == "slurmstepd" and f"[{job}." in " ".join(process.cmdline())
                if daemon or process.environ().get("SLURM_JOB_ID") == job:
                    found.append(process)
        return found

    def stop(self) -> None:
        for job in self.command("squeue", "-h", "-o", "%A").split():
            self.command("scancel", job)
            for process in self.processes(job):
                kill(process)
        for process in psutil.Process().children():  # a workflow, where a trial went wrong
            with contextlib.suppress(psutil.Error):
                if process.environ().get("SLURM_CONF") == self.environment["SLURM_CONF"]:
                    kill(process)
        for name in (*(f"slurmd-{node}.pid" for node in NODES), "slurmctld.pid", "munge/pid"):
            with contextlib.suppress(OSError, ValueError, psutil.Error):
                daemon = psutil.Process(self.pid(name))
                daemon.terminate()
                daemon.wait(20)


@contextlib.contextmanager
def slurm(number: int = 0) -> Iterator[Slurm]:
    with folder() as place:
        cluster = Slurm(place, number)
        try:
            cluster.start()
            yield cluster
        finally:
            cluster.stop()


def kill(process: psutil.Process) -> bool:
    """Whether it was there to be killed."""
    with contextlib.suppress(psutil.Error):
        process.kill()
        return True
    return False


def is_step(process: psutil.Process) -> bool:
    """Whether it is what makes a part of a run, and not the shells and daemons around it."""
    with contextlib.suppress(psutil.Error):
        return "step" in process.cmdline()
    return False


def wait_for(condition: object, seconds: float = 900) -> None:
    end = time.monotonic() + seconds
    while not condition():  # type: ignore[operator]
        if time.monotonic() > end:
            raise TimeoutError(f"{seconds} s went by")
        time.sleep(0.2)


def workflow(place: Path, *options: str, environment: dict[str, str] | None = None) -> subprocess.Popen[bytes]:
    """A workflow of two seeds at smoke: data, the action prior, and a notebook that writes its weights as a table."""
    cells = ['scale = ""\nseed = 0\nrun_dir = ""\nenv = "tsm/Reacher-v0"\nmodels = "prior"', TABLE]
    notebook = nbformat.v4.new_notebook(metadata={"kernelspec": {"name": "python3", "display_name": "Python 3"}})
    notebook.cells = [nbformat.v4.new_code_cell(cell) for cell in cells]
    notebook.cells[0].metadata["tags"] = ["parameters"]
    place.mkdir(exist_ok=True)
    path = place / "02_train.ipynb"
    nbformat.write(notebook, path)
    given = ["-p", "env=tsm/Reacher-v0", "-p", "models=prior"]
    command = [sys.executable, "-m", "tsmlib", "run", str(path), "--scale", "smoke", "--seeds", SEEDS, *given, *options]
    surroundings = {**(environment or os.environ), "TSM_RUN_DIR": str(place / "runs"), "PYTHONPATH": str(ROOT)}
    surroundings |= {"OMP_NUM_THREADS": "1", "TQDM_DISABLE": "1"}
    with open(place / "log", "ab") as log:
        return subprocess.Popen(command, env=surroundings, stdout=log, stderr=log, cwd=place)


def made(place: Path) -> dict[str, object]:
    """Every table of the runs without what a clock measured, and the names of all data, models and tables."""
    runs = place / "runs" / "smoke"
    found: dict[str, object] = {str(path.relative_to(runs)): numbers(path) for path in runs.glob("seed*/metrics/*.csv")}
    found["files"] = sorted(
        str(path.relative_to(runs)) for path in runs.glob("seed*/[dm]*/**/*.[sc]*") if path.is_file()
    )
    return found


def steps_done(place: Path) -> int:
    """How many steps of the workflow in a folder are marked as done."""
    return sum(path.is_file() for path in (place / "runs" / "smoke" / "workflow" / "done").rglob("*"))


def strike(cluster: Slurm, how: str, process: subprocess.Popen[bytes], place: Path, *, after: int = 0) -> None:
    """Kill a job's process, a node with all it runs, the controller, or the workflow, while a job runs and at least
    so many steps are done."""
    running = list[tuple[str, str, psutil.Process]]()

    def ready() -> bool:
        running[:] = cluster.running() if steps_done(place) >= after else []
        if how == "job" and running and not kill(running[0][2]):  # it ended just now
            running.clear()
        return bool(running)

    wait_for(lambda: ready() or process.poll() is not None)
    if not running:
        raise RuntimeError(f"the workflow ended with {steps_done(place)} steps, before a {how} was killed")
    job, node, _ = running[0]
    if how == "node":
        kill(psutil.Process(cluster.pid(f"slurmd-{node}.pid")))
        for each in cluster.processes(job):
            kill(each)
        wait_for(lambda: cluster.command("sinfo", "-h", "-n", node, "-o", "%T") in ("down*", "down", "drained*"))
        cluster.start_node(node)
    elif how == "controller":
        kill(psutil.Process(cluster.pid("slurmctld.pid")))
        time.sleep(10)
        cluster.start_controller()
    elif how == "workflow":
        process.kill()


def killed_on_a_cluster(each: int) -> Outcome:
    """R1, R14: jobs, nodes and controllers of a Slurm of two nodes killed, two seeds at smoke: the tables of the pool.

    ``each`` runs of the workflow, on CLUSTERS at once, in each of which a job, a node and the controller are killed
    (``strikes``); for 0 one run, in which the workflow is killed too.
    """
    if lacking := missing():
        return Outcome(note=f"{lacking}: not done")
    clusters = CLUSTERS if each else 1
    found, trials = Outcome(), iter(list(enumerate(strikes(each))))  # shared: the next goes to whoever is free
    with folder() as place, ThreadPoolExecutor(clusters) as pool:
        assert workflow(place / "local", "--executor", "pool").wait(1800) == 0, (place / "local" / "log").read_text()

        def of_one(number: int) -> Outcome:
            mine = Outcome()
            with slurm(number) as cluster:
                for trial, (killed, after) in trials:
                    mine.add(tried(cluster, killed, place / f"trial{trial}", made(place / "local"), after=after))
            return mine

        for outcome in pool.map(of_one, range(clusters)):
            found.add(outcome)
    kills = sum(len(killed) for killed, _ in strikes(each))
    which = f"{', '.join(IN_TURN)}, in any order" if each else ", ".join(KILLED)
    found.note = f"{kills} kills: in each run {which}; seeds {SEEDS}"
    return found


def tried(cluster: Slurm, killed: Sequence[str], place: Path, expected: object, *, after: int) -> Outcome:
    """One run of the workflow in a folder, during which these are killed: whether it makes what is expected."""
    quick = ["--slurm-init-seconds-before-status-checks", "2", "--seconds-between-status-checks", "2"]
    options = ["--executor", "slurm", "--jobs", "4", "--", *quick]
    found, said = Outcome(), f"{', '.join(killed)} after {after} steps"
    cluster.resume()
    process = workflow(place, *options, environment=cluster.environment)
    try:
        for how in killed:
            strike(cluster, how, process, place, after=after)
            if how == "workflow":
                process.wait()
                process = workflow(place, *options, environment=cluster.environment)
        code, same = process.wait(1800), made(place) == expected
    except Exception as error:
        process.kill()
        process.wait()
        cluster.command("scancel", "--user", "root")
        wait_for(lambda: not cluster.command("squeue", "-h"))
        found.count(False, f"{said}: {error!r}")
    else:
        said = f"{said}: exit {code}, same tables {same}"
        found.count(code == 0 and same, f"{said}: {(place / 'log').read_text()[-800:]}")
    print(said, flush=True)
    return found


def strikes(each: int) -> list[tuple[tuple[str, ...], int]]:
    """What is killed in each run of ``killed_on_a_cluster``, in every order, and after how many steps the first."""
    orders = itertools.cycle(itertools.permutations(IN_TURN))
    return [(next(orders), i % STEPS) for i in range(each)] or [(KILLED, 0)]
