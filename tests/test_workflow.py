"""Workflows of several seeds: steps in order, refused before they do harm, and the same files whoever runs them."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import nbformat
import pytest
import torch
from reliability import cluster

from tsmlib.__main__ import main
from tsmlib.figures.method import Method
from tsmlib.storage import artifacts, files, manifest
from tsmlib.storage.provenance import provenance
from tsmlib.study import needed, notebooks, parameters, runs, workflow, zoo
from tsmlib.study.data import HELD_OUT_SEED, TASK_SEED, dataset
from tsmlib.study.parameters import ParameterError
from tsmlib.study.policies import Budget
from tsmlib.study.remote_jobs import ask_again, cancel_held
from tsmlib.study.runs import RunError

HAS_SNAKEMAKE = importlib.util.find_spec("snakemake") is not None
needs_snakemake = pytest.mark.skipif(not HAS_SNAKEMAKE, reason="no Snakemake: pip install 'tsmlib[cluster]'")
NOTEBOOKS = list(runs.notebooks().values())
STORAGE = ["--default-storage-provider", "fs", "--default-storage-prefix", "markers"]


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TSM_RUN_DIR", str(tmp_path / "runs"))
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    return tmp_path


@pytest.fixture
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a notebook or a job that is begun all the same is an error, and not hours of work."""

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("this was not refused")

    for module, name in ((notebooks, "execute"), (workflow, "run_all"), (workflow, "step")):
        monkeypatch.setattr(module, name, refuse)


def table(
    scale: str = "smoke", seeds: tuple[int, ...] = (0, 2), *, device: str = "", **given: str
) -> dict[str, workflow.Step]:
    prepared = workflow.prepare(NOTEBOOKS, seeds, scale=scale, device=device, given=given)
    return workflow.steps(prepared, given)


# Seeds ---------------------------------------------------------------------------------------------------------------


def test_seeds_are_named_by_ranges_and_commas() -> None:
    assert parameters.parse_seeds("0-3") == [0, 1, 2, 3]
    assert parameters.parse_seeds("5,0, 2-3") == [5, 0, 2, 3]


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize(
    "text", ["", "3-1", "0,0", "0-2,2", "-1", "1.0", "0-", "a", "0;1", "0-99999", "4294967296", "٣"]
)
def test_other_words_for_seeds_are_refused(text: str, place: Path) -> None:
    with pytest.raises(ParameterError, match=r"(--seeds|seed) is .*(expected|once)"):
        parameters.parse_seeds(text)
    assert main(["run", "all", f"--seeds={text}"]) == 2
    assert not list(place.iterdir())


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize("seed", ["0", "4"])
def test_seeds_are_named_in_one_way(seed: str, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command in (["run", "all"], ["step", "train"]):
        assert main([*command, "--seed", seed, "--seeds", "1-3"]) == 2
        assert f"--seed {seed} and --seeds 1-3 are both given" in capsys.readouterr().err
    assert not list(place.iterdir())


@pytest.mark.parametrize("seed", [*HELD_OUT_SEED.values(), *TASK_SEED.values()])
def test_seeds_of_held_out_episodes_and_targets_are_refused(
    seed: int, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for asked in (["--seeds", f"{seed - 1}-{seed}"], ["--seed", f"{seed}"]):
        assert main(["run", "all", "--scale", "smoke", *asked]) == 2
        assert "draws held-out episodes or targets" in capsys.readouterr().err
    assert not list(place.iterdir())
    with pytest.raises(ParameterError, match="draws held-out episodes or targets"):  # without a workflow
        dataset(runs.resolve("01_collect", scale="smoke", seed=seed), "tsm/Reacher-v0", "train")


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize("seed", [401, 999, 1000, 1031])
def test_seeds_that_train_a_notebook_on_the_starts_of_its_tests_are_refused(
    seed: int, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for asked in ([f"--seeds=0,{seed}"], [f"--seed={seed}"]):
        assert main(["run", "your_own", *asked]) == 2
        assert "expected one below 401 or above 1031" in capsys.readouterr().err
    assert not list(place.iterdir())
    for other in (seed, 0, 9, 400, 1032):
        runs.resolve("09_your_own" if other != seed else "02_train", seed=other)


def test_the_seeds_that_are_refused_are_those_of_the_notebook() -> None:
    source = "\n".join(cell.source for cell in nbformat.read(runs.notebooks()["your_own"].path, 4).cells)
    episodes = max(int(n) for pair in re.findall(r"(?:smoke|laptop|paper)=\((\d+), (\d+)\)", source) for n in pair)
    starts = max(int(n) for n in re.findall(r"paper=\((\d+), \(64", source))
    (first,) = set(re.findall(r"Task\.from_env\([^)]*?seed=(\d+)", source))
    assert range(int(first) - episodes + 1, int(first) + starts) == runs.TESTED


# Steps ---------------------------------------------------------------------------------------------------------------


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that says that it has one."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)


@pytest.mark.usefixtures("gpu")
@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize("scale", ["smoke", "laptop", "paper"])
def test_a_step_comes_after_those_that_it_needs(scale: str, device: str) -> None:
    done, steps = set[str](), table(scale, device=device)
    for name, step in steps.items():
        assert set(step.needs) <= done, name
        done.add(name)
    assert len({step.done for step in steps.values()}) == len(steps)
    assert sum(step.kind == "notebook" for step in steps.values()) == 2 * len(NOTEBOOKS)


def test_claims_wait_for_the_notebooks_of_every_seed() -> None:
    steps = table("paper")
    others = {name for name, step in steps.items() if step.kind == "notebook" and "08_claims" not in name}
    assert set(steps["seed0/08_claims"].needs) == set(steps["seed2/08_claims"].needs) == others


def test_a_plan_that_a_second_notebook_makes_for_more_targets_is_not_made_before_the_first_has_used_it() -> None:
    plan = "seed2/plans/Reacher-oracle-latent-cem"
    steps = table("laptop")
    assert plan in steps["seed2/05_control"].needs
    assert "seed2/05_control" in steps["seed2/07_action_prior"].needs
    assert "seed2/05_control" not in table("paper")["seed2/07_action_prior"].needs  # there it is the same plan


def test_a_change_of_a_schedule_reaches_what_was_made_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    before = table("paper", (0,))
    spec = zoo.ZOO["lstm"]
    longer = tuple(replace(stage, rate=99.0) for stage in spec.stages)
    monkeypatch.setitem(zoo.ZOO, "lstm", replace(spec, stages=longer))
    changed = {name for name, step in table("paper", (0,)).items() if step.settings != before[name].settings}
    arms = ("", "Obstacle", "Push", "-noise0.25", "-delay5", "-noise0.1", "-noise0.25-delay5")
    assert changed == {f"seed0/models/Reacher{arm}/lstm" for arm in arms}


def test_a_change_of_a_notebook_reaches_its_step_and_one_of_its_prose_or_outputs_does_not(place: Path) -> None:
    own = runs.notebooks()["train"]

    def settings(notebook: runs.Notebook) -> dict[str, str]:
        prepared = workflow.prepare([notebook], [0], scale="paper", device="", given={})
        return {name: step.settings for name, step in workflow.steps(prepared, {}).items()}

    notebook, copy = nbformat.read(own.path, 4), runs.Notebook(own.name, place / own.path.name)
    cells = {cell.cell_type: cell for cell in notebook.cells}  # the last of each type
    cells["markdown"].source += " More."
    cells["code"].outputs = [nbformat.v4.new_output("stream", text="1")]
    nbformat.write(notebook, copy.path)
    before = settings(own)
    assert settings(copy) == before
    cells["code"].source += "\n1 + 1"
    nbformat.write(notebook, copy.path)
    assert {name for name, stated in settings(copy).items() if stated != before[name]} == {"seed0/02_train"}


def test_steps_find_the_folder_of_the_runs_in_the_environment(place: Path) -> None:
    given = {"run_dir": "elsewhere", "env": "tsm/Reacher-v0"}
    prepared = workflow.prepare([runs.notebooks()["train"]], [0], scale="smoke", device="", given=given)
    for step in workflow.steps(prepared, given).values():
        assert "run_dir" not in step.command
        assert "env=tsm/Reacher-v0" in step.command


def test_a_notebook_that_takes_hours_is_given_them() -> None:
    minutes = {name: step.minutes for name, step in table("paper", (0,)).items() if step.kind == "notebook"}
    assert minutes["seed0/10_explore"] > 4 * 155  # CPU minutes of its loops and of what it adapts
    assert {each for name, each in minutes.items() if name != "seed0/10_explore"} == {130}


def test_what_ships_is_there_and_no_step_that_is_to_be_done_again(place: Path) -> None:
    folder = place / "runs" / "laptop" / "workflow"
    prepared = workflow.prepare(NOTEBOOKS, (0, 2), scale="laptop", device="", given={})
    steps = workflow.steps(prepared, {})
    there = steps.keys() - workflow._undone(prepared, steps, folder)
    assert {f"seed0/models/{arm}/rtsm" for arm in ("Reacher", "ReacherPush")} <= there
    assert {f"seed{seed}/plans/ReacherPush-oracle-latent-cem" for seed in (0, 2)} <= there
    assert not {name for name in there if "seed2/models" in name or "data/" in name or name.endswith("05_control")}
    assert not any(step.ships for scale in ("smoke", "paper") for step in table(scale).values())


@pytest.mark.usefixtures("gpu")
def test_on_a_gpu_a_model_that_several_seeds_need_is_one_step_of_all_of_them() -> None:
    steps = table("paper", (4, 0, 2), device="cuda")
    step = steps["seeds0-4/models/Reacher/lstm"]
    assert step.files == [f"seed{seed}/models/Reacher/lstm.safetensors" for seed in (0, 2, 4)]
    assert set(step.needs) == {
        f"seed{seed}/data/Reacher/{part}" for seed in (0, 2, 4) for part in ("train", "validation")
    }
    assert "--seeds 0,2,4" in step.command
    assert "seeds0-4/models/Reacher/lstm" in steps["seed2/scores/Reacher/lstm"].needs
    assert "seed0/models/Reacher-noise0.1/lstm" in steps  # which seed 0 alone needs
    for others in (table("paper", (2,), device="cuda"), table("paper")):
        assert not any(name.startswith("seeds") for name in others)


def test_a_machine_without_a_gpu_submits_steps_that_need_one_and_data_need_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for here in ("", "local", "pool"):
        with pytest.raises(ParameterError, match="device is cuda"):
            workflow.prepare(NOTEBOOKS, [0], scale="smoke", device="cuda", given={}, executor=here)
    prepared = workflow.prepare(NOTEBOOKS, [0], scale="smoke", device="cuda", given={}, executor="slurm")
    for step in workflow.steps(prepared, {}).values():
        assert f"--device {'cpu' if step.kind == 'data' else 'cuda'}" in step.command


def test_the_page_on_clusters_says_what_a_step_asks_for() -> None:
    page = (runs.ROOT / "docs/howto/cluster.md").read_text()
    notebooks = runs.notebooks()
    prepared = workflow.prepare([notebooks["explore"], notebooks["train"]], [0], scale="paper", device="", given={})
    steps = workflow.steps(prepared, {})
    usual, exploring = (steps[f"seed0/{name}"] for name in ("02_train", "10_explore"))
    assert f"| {usual.mem_mb:,} |" in page
    assert f"a notebook {usual.minutes}, `10_explore`, whose loops are CPU hours, {exploring.minutes}" in page
    model, more = (workflow._step(prepared[0].run, "model", "m", [], "", [], 600, n) for n in (1, 3))  # of ten minutes
    assert (model.minutes, more.minutes) == (50, 130)  # four times, and for each seed
    assert more.mem_mb - model.mem_mb == 2 * 500
    assert "500 for each seed after the first" in page


def test_what_the_page_on_clusters_asks_of_slurm_for_a_gpu_is_allowed_by_its_plugin() -> None:
    utils = pytest.importorskip("snakemake_executor_plugin_slurm.utils")
    page = (runs.ROOT / "docs/howto/cluster.md").read_text()
    (asked,) = re.findall(r"--default-resources slurm_partition=\S+ slurm_account=\S+ (gpu=(\d)) ", page)
    job = SimpleNamespace(resources=SimpleNamespace(get={"gpu": int(asked[1])}.get))
    assert "--gpus" in utils.set_gres_string(job)
    assert "slurm_extra" not in page


@pytest.mark.usefixtures("gpu")
def test_a_policy_is_one_step_of_all_seeds_too_after_the_models_that_it_learns_in() -> None:
    steps = table("paper", (0, 2), device="cuda")
    step = steps["seeds0-2/models/ReacherPush/policy-rtsm-latent"]
    assert step.kind == "policy"
    assert {"seeds0-2/models/ReacherPush/rtsm", "seed0/data/ReacherPush/train"} <= set(step.needs)
    assert step.files == [f"seed{seed}/models/ReacherPush/policy-rtsm-latent.safetensors" for seed in (0, 2)]
    assert not any("seeds" in name and ("plans" in name or "scores" in name) for name in steps)


@pytest.mark.usefixtures("gpu")
def test_seeds_that_need_a_policy_with_other_settings_are_no_group(monkeypatch: pytest.MonkeyPatch) -> None:
    def policies(run: runs.Run) -> list[tuple[str, Method, Budget]]:
        budget = {2: Budget(3, 44), 4: Budget(3, 2200)}.get(run.seed, needed.WHOLE)  # that of seed 4 is the same
        return [(needed.REACH, zoo.method("rtsm", "latent", "policy"), budget)]

    monkeypatch.setattr(needed, "_policies", policies)
    steps = table("paper", (0, 2, 4), device="cuda")
    name = "models/Reacher/policy-rtsm-latent"
    assert {f"seeds0-4/{name}", f"seed2/{name}"} <= steps.keys()
    assert steps[f"seeds0-4/{name}"].files == [f"seed{seed}/{name}.safetensors" for seed in (0, 4)]
    with pytest.raises(ParameterError, match="seeds 0 and 2 need models/Reacher/policy-rtsm-latent with different"):
        workflow.step(workflow.prepare([runs.notebooks()["control"]], (0, 2), scale="paper", device="", given={}), name)


@pytest.mark.usefixtures("gpu")
def test_a_seed_whose_model_ships_is_none_of_those_that_are_trained(place: Path) -> None:
    steps = table("laptop", (0, 1, 2), device="cuda")
    assert steps["seeds1-2/models/Reacher/lstm"].files == [
        f"seed{seed}/models/Reacher/lstm.safetensors" for seed in (1, 2)
    ]
    assert steps["seed0/scores/Reacher/lstm"].needs[0] == "seed0/models/Reacher/lstm"
    folder = place / "runs" / "laptop" / "workflow"
    assert workflow._made(steps["seed0/models/Reacher/lstm"], folder)
    for seed in (1, 2):
        assert not workflow._made(steps["seeds1-2/models/Reacher/lstm"], folder)
        files.write_bytes(folder.parent / f"seed{seed}/models/Reacher/lstm.safetensors", b"")
    assert workflow._made(steps["seeds1-2/models/Reacher/lstm"], folder)


@pytest.mark.usefixtures("gpu")
def test_not_more_than_ten_seeds_are_trained_as_one_and_they_ask_for_more_memory() -> None:
    steps = table("smoke", tuple(range(13)), device="cuda")
    found = {name: step for name, step in steps.items() if name.endswith("models/Reacher/lstm")}
    assert {name.partition("/")[0]: len(step.files) for name, step in found.items()} == {
        "seeds0-9": 10,
        "seeds10-12": 3,
    }
    assert len({step.mem_mb for step in found.values()}) == 2


# Refusals ------------------------------------------------------------------------------------------------------------


def dry(*options: str) -> int:
    return main(["run", "train", "--scale", "smoke", "--seeds", "0,2", "--dry-run", *options])


def test_a_dry_run_lists_the_steps_and_leaves_nothing(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert dry("--executor", "pool") == 0
    told = capsys.readouterr().out.splitlines()
    assert "model    seed2/models/ReacherPush/rtsm" in told
    assert told[-1] == f"{len(told) - 1} of {len(told) - 1} steps are not there yet"
    assert not list(place.iterdir())


def test_an_executor_without_its_package_is_refused_naming_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], place: Path
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if "snakemake" in name else name)
    assert dry("--executor", "slurm") == 1
    assert "pip install 'tsmlib[cluster]'" in capsys.readouterr().err
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name.endswith("_kubernetes") else name)
    assert dry("--executor", "kubernetes") == 1
    assert "pip install snakemake-executor-plugin-kubernetes" in capsys.readouterr().err
    assert dry("--executor", "../x") == 2
    assert not list(place.iterdir())


def test_options_that_would_be_ignored_are_refused(capsys: pytest.CaptureFixture[str], place: Path) -> None:
    assert dry("--executor", "pool", "--jobs=-3") == 2
    assert "--jobs is -3, expected 1 or more" in capsys.readouterr().err
    assert dry("--executor", "pool", "--", "--cores", "3") == 2
    assert "'--cores 3' are options of Snakemake's" in capsys.readouterr().err
    assert not list(place.iterdir())


@pytest.mark.parametrize(
    "words", [["--set-resources", "model:runtime=9", "modle:mem_mb=1200"], ["--set-resources=modle:mem_mb=1200"],
              ["--jobs", "2", "--set-threads", "modle=2"]],
)  # fmt: skip
def test_a_kind_of_step_that_there_is_not_is_refused_naming_those_there_are(
    words: list[str], capsys: pytest.CaptureFixture[str], place: Path
) -> None:
    assert dry("--executor", "local", "--", *words) == 2
    assert "names 'modle', expected a kind of step: data, model, scores, plan, policy, n" in capsys.readouterr().err
    assert not list(place.iterdir())


@needs_snakemake
def test_the_command_of_the_page_on_clusters_for_a_gpu_is_taken_by_snakemake(place: Path) -> None:
    page = (runs.ROOT / "docs/howto/cluster.md").read_text().replace("\\\n", " ")
    (words,) = re.findall(r"^python -m tsmlib (run .* --device cuda --executor slurm) -- (.*)$", page, re.MULTILINE)
    ours, theirs = (text.split() for text in words)
    ours = [{"all": "train", "paper": "smoke"}.get(word, word) for word in ours]
    assert main([*ours, "--dry-run", "--", *theirs]) == 0


def test_a_notebook_beside_those_of_another_version_of_the_code_is_executed_and_that_is_said(place: Path) -> None:
    run, now = runs.resolve("02_train", scale="smoke"), provenance()["code"]
    assert notebooks.other_code(run) == ""
    for code, said in ((now, False), ("0.1.0+bbb", True)):
        entry = {"state": "complete", "provenance": {"code": code}}
        manifest.write_json(run.dir / "01_collect.status.json", manifest.sealed(entry))
        told = notebooks.other_code(run)
        assert bool(told) == said
    assert f"01_collect in {run.dir} was made by tsmlib 0.1.0+bbb, this is {now}" in told


def test_a_workflow_that_another_process_holds_is_refused_naming_it(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with files.writer_lock(place / "runs" / "smoke" / "workflow", "workflow of seeds 0"):
        assert main(["run", "train", "--scale", "smoke", "--seeds", "0", "--executor", "pool"]) == 1
    told = capsys.readouterr().err
    assert f"workflow is being written by another process (pid {os.getpid()} on " in told
    assert "workflow of seeds 0, since" in told


def test_two_versions_of_the_code_are_refused_naming_both_unless_it_is_asked_for(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, now = place / "runs" / "smoke" / "workflow", provenance()["code"]
    manifest.write_json(folder / "code.json", {"codes": ["0.1.0+aaa"]})
    assert dry("--executor", "pool") == 1
    told = capsys.readouterr().err
    assert f"workflow was made by tsmlib 0.1.0+aaa, this is {now}" in told
    assert "--any-code" in told
    assert dry("--executor", "pool", "--any-code") == 0
    manifest.write_json(folder / "code.json", {"codes": ["0.1.0+aaa", now]})
    assert dry("--executor", "pool") == 0
    entry = {"state": "complete", "provenance": {"code": "0.1.0+bbb"}}
    manifest.write_json(folder.parent / "seed2" / "02_train.status.json", manifest.sealed(entry))
    assert dry("--executor", "pool") == 1
    assert "02_train in" in capsys.readouterr().err


def test_a_file_of_another_version_of_the_code_is_refused_too(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = place / "runs" / "smoke" / "seed2" / "data" / "ReacherPush" / "test.safetensors"
    arrays = {"x": torch.zeros(1)}
    artifacts.save(path, arrays, kind="trajectories", header={})
    assert dry("--executor", "pool") == 0
    with monkeypatch.context() as patch:
        patch.setattr(artifacts, "provenance", lambda: {"code": "0.1.0+ccc"})
        artifacts.save(path, arrays, kind="trajectories", header={})
    assert artifacts.code(path) == "0.1.0+ccc"
    assert dry("--executor", "pool") == 1
    assert f"{path} was made by tsmlib 0.1.0+ccc" in capsys.readouterr().err
    assert dry("--executor", "pool", "--any-code") == 0
    path.write_bytes(b"damaged")  # which the step will say
    assert artifacts.code(path) == ""


def test_a_step_of_another_version_than_its_workflow_is_refused(place: Path) -> None:
    manifest.write_json(place / "runs" / "smoke" / "workflow" / "code.json", {"codes": ["0.1.0+aaa"]})
    (execution, *_) = workflow.prepare(NOTEBOOKS[1:2], [0], scale="smoke", device="", given={})
    with pytest.raises(RunError, match=r"this step runs tsmlib .*, its workflow 0\.1\.0\+aaa"):
        workflow.step([execution], "data/Reacher/test")


def test_a_step_makes_a_job_by_its_name_and_no_other(place: Path) -> None:
    assert main(["step", "collect", "--job", "data/Reacher/test", "--scale", "smoke", "--seed", "2"]) == 0
    assert (place / "runs" / "smoke" / "seed2" / "data" / "Reacher" / "test.safetensors").exists()
    assert main(["step", "collect", "--job", "models/Reacher/tsm", "--scale", "smoke"]) == 2


def test_a_step_of_several_seeds_trains_a_model_with_those_that_lack_it_as_one(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["step", "train", "--scale", "smoke", "--device", "cpu", "-p", "env=tsm/Reacher-v0", "-p", "models=prior"]
    headers = {}
    assert main([*words, "--job", "models/Reacher/prior", "--seed", "2"]) == 0
    for _ in range(2):  # the second time all are there
        assert main([*words, "--job", "models/Reacher/prior", "--seeds", "2,0,3"]) == 0
        for seed in (0, 2, 3):
            path = place / "runs" / "smoke" / f"seed{seed}" / "models" / "Reacher" / "prior.safetensors"
            header = artifacts.read_header(path)
            assert headers.setdefault(seed, header) == header
    assert [headers[seed].get("copies") for seed in (0, 2, 3)] == [2, None, 2]
    for job in ("data/Reacher/train", ""):
        assert main([*words, "--job", job, "--seeds", "2,0"]) == 2
        assert f"{job or '02_train'} is made with one seed at a time" in capsys.readouterr().err
    assert main(["step", "all", "--job", "data/Reacher/train"]) == 2
    assert "a step is of one notebook" in capsys.readouterr().err


def test_a_step_of_several_seeds_learns_a_policy_with_them_as_one(place: Path) -> None:
    job = "models/Reacher/policy-tsm-latent"
    words = ["step", "control", "--scale", "smoke", "--device", "cpu"]
    assert main([*words, "--job", job, "--seeds", "0,2"]) == 0
    for seed in (0, 2):
        header: Any = artifacts.read_header(place / "runs" / "smoke" / f"seed{seed}" / f"{job}.safetensors")
        assert (header["seed"], header["curve"]["policies"]) == (seed, 2)


def test_without_snakemake_models_of_several_seeds_are_trained_before_the_notebooks(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given, job = {"env": "tsm/Reacher-v0", "models": "prior"}, "models/Reacher/prior"
    prepared = workflow.prepare([runs.notebooks()["train"]], (0, 2, 3, 4), scale="smoke", device="", given=given)
    groups = {(each.run.seed, job): group for group in (prepared[:2], prepared[2:]) for each in group}
    monkeypatch.setattr(workflow, "seed_groups", lambda _: groups)  # as on a GPU
    workflow._precompute_groups(prepared)
    for execution in prepared:
        assert artifacts.read_header(execution.run.dir / f"{job}.safetensors")["copies"] == 2


# Without Snakemake ---------------------------------------------------------------------------------------------------

TRIED = """import os
open({tried!r}, 'a').write(f"{stem} {{seed}} {{os.environ['TSM_JOBS']}},")
assert seed != 0 or os.path.exists({mended!r}), "not yet"
"""


def small(folder: Path, stem: str, *more: str) -> None:
    """A notebook that lists its executions, and fails with seed 0 until it is mended."""
    source = TRIED.format(stem=stem, tried=str(folder / "tried"), mended=str(folder / "mended"))
    notebook = nbformat.v4.new_notebook(metadata={"kernelspec": {"name": "python3", "display_name": "Python 3"}})
    given = 'scale = ""\nseed = 0\nrun_dir = ""\nenv = "tsm/Reacher-v0"\nmodels = "prior"'
    notebook.cells = [nbformat.v4.new_code_cell(cell) for cell in (given, source, *more)]
    notebook.cells[0].metadata["tags"] = ["parameters"]
    (folder / "notebooks").mkdir(exist_ok=True)
    nbformat.write(notebook, folder / "notebooks" / f"{stem}.ipynb")


def test_without_snakemake_a_failure_ends_nothing_else_and_what_is_complete_is_not_executed_again(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(runs, "NOTEBOOKS", place / "notebooks")
    small(place, "00_first")
    small(place, "08_claims")
    tried = place / "tried"

    def run(seeds: str, *options: str) -> list[str]:
        tried.write_text("")
        options = ("--scale", "smoke", "--seeds", seeds, "--executor", "pool", *options)
        assert main(["run", "all", *options]) == (0 if (place / "mended").exists() else 1)
        return tried.read_text().rstrip(",").split(",")

    assert run("0,2", "--jobs", "3") == ["00_first 0 3", "00_first 2 3"]
    told = capsys.readouterr().err
    assert "3 of 4 notebooks are not complete; the same command goes on with them:\n" in told
    assert re.search(r"^  seed0/00_first: 00_first failed: .*AssertionError: not yet", told, re.MULTILINE)
    for seed in (0, 2):
        assert f"  seed{seed}/08_claims: not executed, since it needs seed0/00_first\n" in told
    (place / "mended").touch()
    assert run("0,2", "--jobs", "1") == ["00_first 0 1", "08_claims 0 1", "08_claims 2 1"]
    assert "seed2/00_first is complete" in capsys.readouterr().out
    assert run("0,2") == [""]
    small(place, "00_first", "1 + 1")
    assert [word.rpartition(" ")[0] for word in run("2")] == ["00_first 2", "08_claims 2"]


def only_training(place: Path, monkeypatch: pytest.MonkeyPatch) -> list[notebooks.Execution]:
    """Of one seed, a small 02_train alone."""
    monkeypatch.setattr(runs, "NOTEBOOKS", place / "notebooks")
    small(place, "02_train")
    return workflow.prepare(list(runs.notebooks().values()), [2], scale="smoke", device="", given={})


def test_without_snakemake_a_notebook_is_executed_again_where_what_it_needs_is_gone(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared = only_training(place, monkeypatch)
    made = [place / "runs" / "smoke" / file for step in workflow.steps(prepared, {}).values() for file in step.files]
    assert len(made) == 4
    for path in made:  # as if the notebook did
        files.write_bytes(path, b"")
    for times, gone in ((1, None), (1, made[0]), (2, None)):
        assert workflow.run_all(prepared, {}, executor="pool") == 0
        assert (place / "tried").read_text().count("02_train 2") == times
        if gone:
            gone.unlink()


def replace_file(path: Path) -> None:
    """The same weights from another training."""
    tensors, header = artifacts.load(path, kind="model")
    artifacts.save(path, tensors, kind="model", header=header | {"finished": "2001-01-01"})


def test_a_notebook_is_executed_again_where_a_file_that_it_was_made_from_was_replaced_and_only_once(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    prepared = only_training(place, monkeypatch)
    steps, folder = workflow.steps(prepared, {}), place / "runs" / "smoke" / "workflow"
    for file in (file for step in steps.values() for file in step.files):
        artifacts.save(folder.parent / file, {"x": torch.zeros(1)}, kind="model", header={})
    assert workflow.run_all(prepared, {}, executor="pool") == 0
    replace_file(folder.parent / "seed2/models/Reacher/prior.safetensors")
    assert workflow._undone(prepared, steps, folder).keys() == {"seed2/02_train"}
    assert workflow._again(prepared, steps, folder).keys() == {"seed2/models/Reacher/prior", "seed2/02_train"}
    for said in ("executed: models/Reacher/prior.safetensors is not what it was made from\n", "complete\n"):
        capsys.readouterr()
        assert workflow.run_all(prepared, {}, executor="pool") == 0
        assert f"seed2/02_train is {said}" in capsys.readouterr().out
    assert (place / "tried").read_text().count("02_train 2") == 2


def test_a_file_that_is_replaced_while_a_notebook_runs_makes_it_out_of_date(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared = only_training(place, monkeypatch)
    prior = place / "runs" / "smoke" / "seed2/models/Reacher/prior.safetensors"
    artifacts.save(prior, {"x": torch.zeros(1)}, kind="model", header={})
    papermill = notebooks._papermill

    def replacing(*asked: Any) -> Path:
        replace_file(prior)
        return papermill(*asked)

    monkeypatch.setattr(notebooks, "_papermill", replacing)
    assert workflow.run_all(prepared, {}, executor="pool") == 0
    assert notebooks.replaced(prepared[0].run) == ["models/Reacher/prior.safetensors"]


def test_a_notebook_states_the_shipped_model_that_it_is_made_from_where_its_run_has_none(place: Path) -> None:
    run = runs.resolve("02_train", scale="laptop", seed=0, env="tsm/Reacher-v0", models="prior")
    file = "models/Reacher/prior.safetensors"
    assert notebooks._files(run, needed.needs(run))[file] == artifacts.checksum(
        run.shipped / "Reacher" / "prior.safetensors"
    )
    artifacts.save(run.dir / file, {"x": torch.zeros(1)}, kind="model", header={})
    assert notebooks._files(run, needed.needs(run))[file] == artifacts.checksum(run.dir / file)


@pytest.mark.parametrize(
    ("more", "forced"),
    [
        ([], ["done/data/a"]),
        (STORAGE, ["done/data/a", "done/data/b"]),
        (["=".join(STORAGE[:2])], ["done/data/a", "done/data/b"]),
    ],
)
def test_steps_are_done_again_where_their_markers_are_in_storage_that_only_snakemake_sees(
    more: list[str], forced: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[str] = []
    monkeypatch.setitem(sys.modules, "snakemake", ModuleType("snakemake"))
    monkeypatch.setitem(sys.modules, "snakemake.cli", (cli := ModuleType("snakemake.cli")))
    cli.main = given.extend  # type: ignore[attr-defined]
    table = {name: workflow.Step("data", f"done/data/{name}", [], "", "", 1, 1) for name in "abc"}
    files.write_bytes(tmp_path / "done/data/a", b"")
    workflow._snakemake(table, {"a": "gone", "b": "gone"}, tmp_path, tmp_path / "steps.json", "local", 1, more)
    assert [word for word in given if word.startswith("done/")] == forced


def test_a_notebook_of_other_parameters_or_without_its_table_is_not_there(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(runs.ROOT))
    monkeypatch.setattr(runs, "NOTEBOOKS", place / "notebooks")
    table = "from tsmlib.study.runs import resolve\n_ = (resolve('00_first', seed=seed).metrics / 'a').write_text('')"
    small(place, "00_first", table)

    def missing(*options: str) -> str:
        capsys.readouterr()
        assert main(["run", "all", "--scale", "smoke", "--seeds", "2", "--executor", "pool", *options]) == 0
        return capsys.readouterr().out.splitlines()[-1]

    monkeypatch.setenv("TSM_SCALE", "smoke")
    run_dir = f"run_dir={place / 'runs'}"
    missing("-p", run_dir)
    assert missing("--dry-run") == "0 of 1 steps are not there yet"  # however the folder was named
    assert missing("--dry-run", "-p", run_dir) == "0 of 1 steps are not there yet"
    assert missing("--dry-run", "-p", "env=tsm/ReacherPush-v1") == "1 of 1 steps are not there yet"
    (place / "runs/smoke/seed2/metrics/a").unlink()
    assert missing("--dry-run") == "1 of 1 steps are not there yet"


# Whole workflows -----------------------------------------------------------------------------------------------------


@needs_snakemake
def test_the_folder_of_the_runs_is_handed_on_by_every_executor(place: Path) -> None:
    (place / "steps.json").write_text("{}")
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(workflow.SNAKEFILE), "--dry-run"]
    command += ["--directory", str(place), "--config", f"steps={place / 'steps.json'}"]
    without = {name: value for name, value in os.environ.items() if name != "TSM_RUN_DIR"}
    for environment, status in ((os.environ, 0), (without, 1)):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == status
        assert ("TSM_RUN_DIR" in done.stdout + done.stderr) == bool(status)  # declared, so that it is passed on


@needs_snakemake
def test_snakemake_and_the_pool_make_the_same_files(place: Path) -> None:
    found: dict[str, Any] = {}
    for executor, more in (("pool", ()), ("local", ("--", "--printshellcmds"))):
        process = cluster.workflow(place / executor, "--executor", executor, *more)
        assert process.wait(600) == 0, (place / executor / "log").read_text()
        found[executor] = cluster.made(place / executor)
    assert found["local"] == found["pool"]
    assert sorted(found["pool"])[1:] == [f"seed{seed}/metrics/02_train.csv" for seed in (0, 2)]
    folder = place / "local" / "runs" / "smoke" / "workflow"
    for part, suffix in (("log", ".log"), ("benchmark", ".tsv")):
        assert (folder / part / "seed2" / "models" / "Reacher" / f"prior{suffix}").exists()
    steps = json.loads((folder / "steps.json").read_text())
    assert all((folder / step["done"]).exists() for step in steps.values())
    assert cluster.steps_done(place / "local") == len(steps) > cluster.STEPS
    assert "OMP_NUM_THREADS=1 TSM_JOBS=1 " in (place / "local" / "log").read_text()
    again = cluster.workflow(place / "local", "--executor", "local")
    assert again.wait(600) == 0
    assert "Nothing to be done" in (place / "local" / "log").read_text()
    (folder.parent / "seed0" / "metrics" / "02_train.csv").unlink()
    replace_file(folder.parent / "seed2" / "models" / "Reacher" / "prior.safetensors")
    began = time.time()
    again = cluster.workflow(place / "local", "--executor", "local")
    assert again.wait(600) == 0
    assert cluster.made(place / "local") == found["pool"]
    told = (place / "local" / "log").read_text()
    again_done = {"model/seed2/models/Reacher/prior", "notebook/seed0/02_train", "notebook/seed2/02_train"}
    assert set(re.findall(r"(\S+) is done again", told)) == again_done
    for seed, steps_again in ((0, 1), (2, 2)):
        log = folder / "log" / f"seed{seed}"
        assert len({path for path in log.rglob("*.log") if path.stat().st_mtime > began}) == steps_again


def slurm_says(folder: Path, monkeypatch: pytest.MonkeyPatch, *queue: str) -> Path:
    """Commands in place of Slurm's, of which ``squeue`` prints these lines; where ``scancel`` notes what it is told."""
    for name, script in (("squeue", f"cat {folder}/queue"), ("scancel", f"echo $@ >> {folder}/cancelled")):
        files.write_bytes(path := folder / "bin" / name, f"#!/bin/sh\n{script}\n".encode())
        path.chmod(0o755)
    (folder / "queue").write_text("\n".join(queue))
    monkeypatch.setenv("PATH", str(folder / "bin"), prepend=os.pathsep)
    (folder / "cancelled").touch()
    return folder / "cancelled"


def test_a_job_that_slurm_holds_is_cancelled_so_that_it_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = ("launch failed requeued held", "launch_failed_requeued_held", "job requeued in held state")
    queue = ["1|Priority", *(f"{i}|{reason}" for i, reason in enumerate(held, start=2)), f"9|{held[0]}", "5|BeginTime"]
    cancelled = slurm_says(tmp_path, monkeypatch, *queue)
    cancel_held([SimpleNamespace(external_jobid=str(i)) for i in range(1, 7)])  # 9 is of another workflow
    assert cancelled.read_text().split() == ["2", "3", "4"]


def test_jobs_of_which_a_check_says_nothing_are_asked_of_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Executor:
        """Of four jobs one succeeds, one fails, one runs; of the last nothing is known."""

        def __init__(self) -> None:
            self.reported = list[str]()

        def report_job_success(self, job: SimpleNamespace) -> None:
            self.reported.append(f"{job.external_jobid} succeeded")

        def report_job_error(self, job: SimpleNamespace, msg: str) -> None:
            self.reported.append(f"{job.external_jobid} {msg}")

        async def check_active_jobs(self, jobs: list[SimpleNamespace]) -> AsyncIterator[SimpleNamespace]:
            for job in jobs:
                if job.external_jobid == "1":
                    self.report_job_success(job)
                elif job.external_jobid == "2":
                    self.report_job_error(job, msg="failed")
                elif job.external_jobid == "3":
                    yield job

    async def left(jobs: list[SimpleNamespace]) -> list[str]:
        return [job.external_jobid async for job in executor.check_active_jobs(jobs)]

    slurm_says(tmp_path, monkeypatch)
    jobs = [SimpleNamespace(external_jobid=str(i)) for i in range(1, 5)]
    executor = Executor()
    assert asyncio.run(left(jobs)) == ["3"]
    ask_again(Executor)
    executor.reported.clear()
    assert asyncio.run(left(jobs)) == ["3", "4"]
    assert executor.reported == ["1 succeeded", "2 failed"]


@pytest.mark.skipif(bool(cluster.missing()), reason=f"{cluster.missing()}: apt-get install slurm-wlm munge, as root")
def test_a_killed_job_on_a_cluster_changes_no_table() -> None:
    cluster.killed_on_a_cluster(0).check()
