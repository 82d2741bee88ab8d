"""Scores are kept and found again, and figures draw the rows of all seeds that there are."""

from __future__ import annotations

import math

import pytest
import torch

from tsmlib import study
from tsmlib.envs.spec import EnvSpec
from tsmlib.evaluation import prediction
from tsmlib.storage import artifacts, manifest, tables
from reproduction.runs import Run, RunError

ENV = "tsm/ReacherPush-v1"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return Run("03_predict", "smoke", 0, tmp_path_factory.mktemp("run"))


@pytest.mark.parametrize("model", ["lstm", "ensemble"])
@pytest.mark.parametrize("segments", [False, True])
def test_scores_are_found_again_as_they_were(
    run: Run, model: str, segments: bool, monkeypatch
) -> None:
    first = study.scores(run, ENV, model, segments=segments)
    monkeypatch.setattr(prediction, "score", None)  # nothing is computed again
    second = study.scores(run, ENV, model, segments=segments)
    assert first.values.keys() == second.values.keys()
    assert all(torch.equal(first.values[metric], second.values[metric]) for metric in first.values)
    assert torch.equal(first.pit, second.pit)
    assert torch.equal(first.outside, second.outside)
    assert math.isclose(first.fitted.shared, second.fitted.shared, rel_tol=1e-6)
    assert torch.equal(first.fitted.own, second.fitted.own)


def test_scores_of_other_weights_are_not_taken(run: Run) -> None:
    before = study.scores(run, ENV, "lstm").values["ll_paper"]
    path = run.models / EnvSpec.parse(ENV).name / "lstm.safetensors"
    net, header = study.load_or_train(run, ENV, "lstm")
    with torch.no_grad():
        net.out.bias += 0.1
    kept = ("fingerprint", "model", "seed", "scale", "curves", "seconds", "symmetries")
    artifacts.save_model(path, net, {word: header[word] for word in kept})
    assert not torch.equal(study.scores(run, ENV, "lstm").values["ll_paper"], before)


def test_scores_of_another_version_are_not_taken(run: Run, monkeypatch) -> None:
    study.scores(run, ENV, "ensemble")
    monkeypatch.setattr(prediction, "VERSION", prediction.VERSION + 1)
    monkeypatch.setattr(prediction, "score", None)
    with pytest.raises(TypeError):
        study.scores(run, ENV, "ensemble")


def test_at_scale_paper_the_other_seeds_are_drawn_too_once_they_are_complete(tmp_path) -> None:
    row = dict(env=ENV, sim="mujoco", model="tsm", metric="nrmse", value=1.0, n=1, scale="paper")
    tables.save(tmp_path / "seed1" / "metrics" / "03_predict.csv", [dict(row, seed=1)])
    run, own = Run("03_predict", "paper", 0, tmp_path / "seed0"), [dict(row, seed=0)]
    with pytest.raises(
        RunError, match="03_predict in .*seed1 is not run, expected complete. Run it: .* --seed 1"
    ):
        study.pooled_rows(run, own)
    manifest.write_json(tmp_path / "seed1" / "status.json", {"03_predict": {"state": "complete"}})
    assert study.pooled_rows(run, own)["seed"].tolist() == [0, 1]
    changed = {"state": "complete", "changed_copy": True, "notebook": "0f"}
    manifest.write_json(tmp_path / "seed1" / "status.json", {"03_predict": changed})
    with pytest.raises(
        RunError, match="03_predict in .*seed1 was executed from a copy with other cells"
    ):
        study.pooled_rows(run, own)
    manifest.write_json(
        tmp_path / "seed0" / "status.json", {"03_predict": changed | {"state": "running"}}
    )
    assert study.pooled_rows(run, own)["seed"].tolist() == [0, 1]  # of the same copy
    laptop = Run("03_predict", "laptop", 0, tmp_path / "seed0")
    assert study.pooled_rows(laptop, own).equals(
        tables.frame(own)
    )  # seeds are pooled at scale paper alone
