"""The workflow: a job or its controller that is killed costs no more than that job."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from tsmlib.pretrained import ROOT

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("snakemake") is None,
    reason="snakemake is not installed: pip install 'tsmlib[cluster]'",
)
TARGET = "smoke/seed0/scores/Reacher/tsm.csv"


def started(folder: Path, *options: str) -> subprocess.Popen[bytes]:
    """Snakemake, making the target below a folder."""
    environment = {**os.environ, "TSM_RUN_DIR": str(folder), "TQDM_DISABLE": "1"}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.getenv("PYTHONPATH")]))
    command = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "reproduction/Snakefile")]
    command += ["--cores", "1", "--rerun-incomplete", *options, TARGET]
    return subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)


def struck(controller: subprocess.Popen[bytes], folder: Path, whom: str) -> bool:
    """Kill a job that is training, or its controller; False where it was over before."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and controller.poll() is None:
        if list(folder.rglob("*.checkpoint/*.safetensors")):
            family = psutil.Process(controller.pid).children(recursive=True)
            jobs = [
                each for each in family if "tsmlib" in each.cmdline() and "make" in each.cmdline()
            ]
            chosen = jobs if whom == "job" else [psutil.Process(controller.pid), *family]
            for process in chosen:
                process.send_signal(signal.SIGKILL)
            return bool(chosen)
        time.sleep(0.02)
    return False


@pytest.mark.parametrize("whom", ["job", "controller"])
def test_what_is_killed_is_done_again_and_ends_with_the_same_bytes(
    whom: str, tmp_path: Path
) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert started(whole).wait() == 0
    controller = started(killed)
    assert struck(controller, killed, whom)
    status = controller.wait()
    if whom == "controller":
        assert status != 0
        assert not (killed / TARGET).exists()
        started(killed, "--unlock").wait()
        assert started(killed).wait() == 0
    else:
        assert status == 0  # it was tried again
    assert (killed / TARGET).read_bytes() == (whole / TARGET).read_bytes()
    assert not list(killed.rglob("*.checkpoint"))
