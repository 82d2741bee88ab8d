"""Reliability checks in their quick forms; ``make reliability`` runs them at full length (docs/reliability.md)."""

from __future__ import annotations

import io
import itertools
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from reliability import __main__ as long
from reliability import cluster, files, pipelines, simulators, training, world
from reliability.__main__ import CHECKS, said
from reliability.world import Outcome
from tqdm.auto import tqdm

from tsmlib.storage import manifest
from reproduction import runs, workflow

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="kills, forks and looks into /proc")
QUICK = {check.__name__: quick for part in CHECKS.values() for check, quick, _ in part}


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """As in the children that a check forks; a training that goes on with other threads would say so."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def quick(check: Callable[[int], Outcome]) -> None:
    """A check with the few trials that tests have time for."""
    check(QUICK[check.__name__]).check()


def test_a_training_killed_at_any_moment_ends_with_the_bits_of_one_left_alone() -> None:
    quick(training.killed_at_random_moments)


def test_no_call_that_fails_or_kills_within_a_save_costs_more_than_that_save() -> None:
    quick(training.at_every_call)


def test_a_spoilt_generation_is_named_and_the_one_before_it_used() -> None:
    quick(training.newest_generation_spoilt)


def test_a_value_that_is_not_finite_is_refused_by_episode_step_and_field() -> None:
    quick(training.values_that_are_not_finite)


def test_a_loss_or_gradient_that_is_not_finite_never_reaches_the_weights() -> None:
    quick(training.losses_that_are_not_finite)


def test_of_three_trainings_in_one_folder_one_writes_and_the_others_name_it() -> None:
    quick(training.two_writers)


def test_a_full_disk_leaves_the_old_file_and_says_how_much_did_not_fit() -> None:
    quick(training.full_disk)


def test_a_cell_interrupted_as_it_trains_goes_on_where_it_was() -> None:
    quick(training.interrupted_in_a_cell)


def test_a_long_training_needs_no_more_memory_than_a_short_one() -> None:
    quick(training.memory)


def test_no_damage_to_any_kind_of_file_goes_unnoticed() -> None:
    quick(files.damage)


def test_a_hostile_file_is_neither_executed_nor_unpacked() -> None:
    quick(files.malice)


def test_a_hostile_minari_data_set_is_refused_or_read_harmlessly() -> None:
    pytest.importorskip("minari")
    pytest.importorskip("h5py")
    quick(files.hostile_minari)


def test_data_and_models_of_another_world_are_refused_naming_both() -> None:
    quick(files.mismatched)


def test_a_hostile_parameter_is_refused_before_any_file_exists() -> None:
    quick(files.hostile_parameters)


def test_whatever_a_forged_file_says_only_our_own_errors_come_of_it() -> None:
    quick(files.fuzz)


def test_a_blow_up_in_mujoco_raises_where_it_happens() -> None:
    quick(simulators.faults_in_mujoco)


def test_data_hold_no_warning_and_no_jump() -> None:
    quick(simulators.large_sets)


def test_a_blow_up_in_pymunk_raises_where_it_happens() -> None:
    quick(simulators.faults_in_pymunk)


def test_an_episode_restored_or_replayed_goes_on_with_the_same_bits() -> None:
    quick(simulators.restores)


def test_another_place_time_zone_locale_or_hash_seed_changes_no_bit() -> None:
    quick(pipelines.elsewhere)


def test_a_training_that_goes_on_with_other_threads_says_so_and_notes_it() -> None:
    quick(pipelines.another_thread_count)


def test_every_check_says_which_number_it_answers() -> None:
    for check in (check for part in CHECKS.values() for check, _, _ in part):
        number, what = said(check)
        assert re.fullmatch(r"R\d+(, R\d+)*", number), check
        assert what, check


def test_a_table_keeps_the_lines_of_checks_that_were_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "reliability.md"
    page.write_bytes(long.DOCS.read_bytes())
    monkeypatch.setattr(long, "DOCS", page)
    before = page.read_text().splitlines()

    def changed() -> list[str]:
        lines = page.read_text().splitlines()
        assert len(lines) == len(before)
        return [line for line in lines if line not in before and not line.startswith("Python ")]

    long.write_table(tmp_path / "nothing was run")
    assert not changed()
    manifest.write_json(
        tmp_path / "full_disk.json",
        {"right": 3, "of": 4, "note": "a | b", "seconds": 5, "day": "2026-11-27"},
    )
    long.write_table(tmp_path)
    number, what = said(training.full_disk)
    assert changed() == [f"| {number} | {what} | 3 | 4 | a / b | 5 | 2026-11-27 |"]


def test_on_a_cluster_each_kind_is_killed_as_often_and_in_every_order() -> None:
    found = cluster.strikes(20)
    kinds = ("job", "node", "controller")
    assert {sum(kind in killed for killed, _ in found) for kind in kinds} == {20}
    assert {killed for killed, _ in found} == set(itertools.permutations(kinds))
    assert {after for _, after in found} == set(range(cluster.STEPS))
    assert cluster.strikes(0) == [(cluster.KILLED, 0)]


def test_on_a_cluster_steps_are_counted_by_the_marks_of_a_workflow(tmp_path: Path) -> None:
    notebook = runs.notebooks()["train"]
    given = {"env": "tsm/Reacher-v0", "models": "prior"}
    steps = workflow.steps(
        workflow.prepare([notebook], (0, 2), scale="smoke", device="", given=given), given
    )
    for n, step in enumerate(steps.values()):
        assert cluster.steps_done(tmp_path) == n
        mark = tmp_path / "runs" / "smoke" / "workflow" / step.done
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.touch()
    assert cluster.steps_done(tmp_path) == len(steps)


def test_a_child_that_is_killed_while_it_draws_a_progress_bar_stops_no_other() -> None:
    def dies() -> None:
        tqdm.get_lock().acquire()
        os.kill(os.getpid(), signal.SIGKILL)

    def draws() -> list[int]:
        return list(tqdm(range(3), file=io.StringIO()))

    assert world.Child(dies).result() == (False, None)
    assert world.in_child(draws) == [0, 1, 2]
