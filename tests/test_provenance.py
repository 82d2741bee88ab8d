"""What made an artefact is known wherever the repository is checked out."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tsmlib.storage.provenance import _commit

git = shutil.which("git")


@pytest.mark.skipif(git is None, reason="no git")
def test_the_commit_is_found_in_a_clone_and_in_a_worktree_linked_to_it(tmp_path: Path) -> None:
    clone, linked = tmp_path / "clone", tmp_path / "linked"

    def run(*arguments: str) -> str:
        who = ("-c", "user.name=nobody", "-c", "user.email=nobody@example.org")
        command = [str(git), "-C", str(clone), *who, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    clone.mkdir()
    run("init", "--quiet")
    run("commit", "--quiet", "--allow-empty", "--message", "first")
    run("worktree", "add", "--quiet", "-b", "other", str(linked))
    run("commit", "--quiet", "--allow-empty", "--message", "second")
    assert _commit(clone) == run("rev-parse", "HEAD")[:12]
    assert _commit(linked) == run("rev-parse", "other")[:12]
    run("-C", str(linked), "checkout", "--quiet", "--detach")
    assert _commit(linked) == run("rev-parse", "other")[:12]
    assert _commit(tmp_path / "nowhere") == _commit(tmp_path) == ""
