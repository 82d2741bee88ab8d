"""R1, R14 on a cluster: a Slurm of two nodes on this machine, in which jobs, nodes and controllers are killed.

Needs the packages slurm-wlm and munge of Debian, root, and the extra ``cluster``. All lies in one temporary folder and
listens on 127.0.0.1 alone; neither systemd nor cgroups are used. Two nodes are two slurmd, so what is not tried: a
second machine, a network file system, accounting (slurmdbd), limits of memory.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import nbformat
import psutil

from reliability.pipelines import numbers
from reliability.world import Outcome, folder
from tsmlib.study.runs import ROOT

PORT = 16817  # of the controller; those of the nodes follow
NODES = ("n1", "n2")
SEEDS = "0,2"
KILLED = ("job", "node", "controller", "workflow")
IN_TURN = ("job", "node", "controller")
STEPS = 9  # of the workflow's ten those after which one always runs
CONFIGURATION = """ClusterName=test
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
    """A controller and two nodes in a folder."""

    place: Path

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
        key, srun = self.place / "munge" / "key", self.place / "bin" / "srun"
        key.write_bytes(os.urandom(1024))
        key.chmod(0o600)
        (self.place / "munge").chmod(0o711)
        memory = psutil.virtual_memory().total // 2**21 - 512
        nodes = [
            f"NodeName={node} NodeHostname={socket.gethostname()} NodeAddr=127.0.0.1 Port={PORT + 1 + i} CPUs=1 "
            f"RealMemory={memory} State=UNKNOWN" for i, node in enumerate(NODES)
        ]  # fmt: skip
        conf = CONFIGURATION.format(host=socket.gethostname(), place=self.place, port=PORT, nodes="\n".join(nodes))
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

    def pid(self, name: str) -> int:
        """Of slurmctld, slurmd-n1 or munge/pid."""
        return int((self.place / name).read_text())

    def running(self) -> list[tuple[str, str]]:
        """Job and node of those jobs whose step of tsmlib has begun."""
        jobs = [line.split() for line in self.command("squeue", "-h", "-t", "R", "-o", "%A %N").splitlines()]
        return [(job, node) for job, node in jobs if any("step" in p.cmdline() for p in self.processes(job))]

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
            if "tsmlib" in process.cmdline():
                kill(process)
        for name in (*(f"slurmd-{node}.pid" for node in NODES), "slurmctld.pid", "munge/pid"):
            with contextlib.suppress(OSError, ValueError, psutil.Error):
                daemon = psutil.Process(self.pid(name))
                daemon.terminate()
                daemon.wait(20)


@contextlib.contextmanager
def slurm() -> Iterator[Slurm]:
    with folder() as place:
        cluster = Slurm(place)
        try:
            cluster.start()
            yield cluster
        finally:
            cluster.stop()


def kill(process: psutil.Process) -> None:
    with contextlib.suppress(psutil.Error):
        process.kill()


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
    running = list[tuple[str, str]]()

    def ready() -> bool:
        running[:] = cluster.running() if steps_done(place) >= after else []
        return bool(running)

    wait_for(lambda: ready() or process.poll() is not None)
    if not running:
        raise RuntimeError(f"the workflow ended with {steps_done(place)} steps, before a {how} was killed")
    job, node = running[0]
    if how == "job":
        kill(next(p for p in cluster.processes(job) if "step" in p.cmdline()))
    elif how == "node":
        kill(psutil.Process(cluster.pid(f"slurmd-{node}.pid")))
        for each in cluster.processes(job):
            kill(each)
        wait_for(lambda: "down" in cluster.command("sinfo", "-h", "-n", node, "-o", "%T"))
        cluster.start_node(node)
    elif how == "controller":
        kill(psutil.Process(cluster.pid("slurmctld.pid")))
        time.sleep(10)
        cluster.start_controller()
    else:
        process.kill()


def killed_on_a_cluster(each: int, kinds: Sequence[str] = IN_TURN) -> Outcome:
    """R1, R14: jobs, nodes and controllers of a Slurm of two nodes killed, two seeds at smoke: the tables of the pool.

    Each of ``kinds`` is killed in ``each`` runs of the workflow, one in a run, after none of its steps, one, ... in
    turn; for 0 all of KILLED in one run, one after another.
    """
    if lacking := missing():
        return Outcome(note=f"{lacking}: not done")
    found = Outcome()
    quick = ["--slurm-init-seconds-before-status-checks", "2", "--seconds-between-status-checks", "2"]
    with folder() as place, slurm() as cluster:
        assert workflow(place / "local", "--executor", "pool").wait(1800) == 0, (place / "local" / "log").read_text()
        expected = made(place / "local")
        for trial, killed in enumerate(strikes(each, kinds)):
            there = place / f"trial{trial}"
            options = ["--executor", "slurm", "--jobs", "4", "--", *quick]
            process = workflow(there, *options, environment=cluster.environment)
            after = trial // len(kinds) % STEPS if each else 0
            try:
                for how in killed:
                    strike(cluster, how, process, there, after=after)
                    if how == "workflow":
                        process.wait()
                        process = workflow(there, *options, environment=cluster.environment)
            except Exception as error:
                process.kill()
                process.wait()
                cluster.command("scancel", "--user", "root")
                found.count(False, f"{', '.join(killed)} after {after} steps: {error!r}")
                continue
            code, same = process.wait(1800), made(there) == expected
            said = f"{', '.join(killed)} after {after} steps: exit {code}, same tables {same}"
            told = (there / "log").read_text()
            found.count(code == 0 and same, f"{said}: {told[-800:]}")
            print(said, flush=True)
    often = f"{each} times each" if each else "once each, in one run"
    found.note = f"{', '.join(kinds if each else KILLED)} killed {often}; seeds {SEEDS}"
    return found


def strikes(each: int, kinds: Sequence[str] = IN_TURN) -> list[tuple[str, ...]]:
    """What is killed in each run of ``killed_on_a_cluster``."""
    return [(kind,) for _ in range(each) for kind in kinds] or [KILLED]
