"""Scores of trained models on test episodes, kept in the run's folder."""

from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import asdict
from typing import Any, NamedTuple

import pandas as pd
import torch
from torch import Tensor

from tsmlib.envs.spec import EnvSpec
from tsmlib.evaluation import prediction, scoring
from tsmlib.models.base import DynamicsModel, predict_segment
from tsmlib.sampling import Noise
from tsmlib.storage import artifacts, manifest, tables
from reproduction.data import dataset
from reproduction.models import load_or_train
from reproduction.notebooks import require
from reproduction.results import prediction as prediction_results
from reproduction.runs import Run, RunError
from tsmlib.trajectory import Segment


def scores(run: Run, env: str, model: str, *, segments: bool = False) -> prediction.Scores:
    """``prediction.score`` of a trained model on test episodes: open loop, or ``segments`` from the true past.

    Smoke 8 episodes and samples, laptop 200 episodes and 16 samples, paper 1,000 and 32. Scores are kept in the run's
    folder and found again as long as weights, data and sizes are the same.
    """
    net, _ = load_or_train(run, env, model)
    test, held_out = (dataset(run, env, split) for split in ("test", "validation"))
    n, samples = score_sizes(run).values()
    test, held_out = test.take(slice(n)), held_out.take(slice(min(n, 200)))
    options: dict[str, Any] = {"horizon": 90}
    if segments:
        options = {"horizon": 10, "starts": list(prediction_results.SEGMENTS)}
    path = (
        run.folder(f"scores/{EnvSpec.parse(env).name}")
        / f"{model}{'-segments' * segments}.safetensors"
    )
    made_from = {
        "version": prediction.VERSION,
        "rows": prediction.ROWS,
        "samples": samples,
        "seed": run.seed,
        **options,
        "model": net.config(),
        "weights": artifacts.digest(net.state_dict()),
        **{
            split: artifacts.digest(
                {"states": torch.from_numpy(data.states), "actions": torch.from_numpy(data.actions)}
            )
            for split, data in (("test", test), ("validation", held_out))
        },
    }
    if not path.exists() or artifacts.read_header(path).get("made_from") != made_from:
        features = deepcopy(net.features)  # what is scored is on the CPU
        found = prediction.score(
            net.to(run.device),
            features,
            test,
            held_out,
            samples=samples,
            seed=run.seed,
            **options,
            progress=f"{EnvSpec.parse(env).name} {model}: {'segments' if segments else 'open loop'}",
        )
        tensors = {f"values.{metric}": value for metric, value in found.values.items()}
        tensors |= {
            f"fitted.{name}": torch.as_tensor(value) for name, value in asdict(found.fitted).items()
        }
        tensors |= {"pit": found.pit, "outside": found.outside}
        artifacts.save(
            path, tensors, kind="scores", header={"made_from": made_from, "device": run.device}
        )
    return _unpacked(
        artifacts.load(path, kind="scores")[0]
    )  # new ones too: the same rows in the same order


def score_sizes(run: Run) -> dict[str, int]:
    """Test episodes, and samples of each prediction; of a model without samples these are noisy copies."""
    return run.pick(
        smoke={"n": 8, "samples": 8},
        laptop={"n": 200, "samples": 16},
        paper={"n": 1000, "samples": 32},
    )


class Scored(NamedTuple):
    """Scores of a model on whole episodes, and on segments from the true past."""

    open_loop: prediction.Scores
    segments: prediction.Scores


def score_all(run: Run, wanted: Iterable[tuple[str, str]]) -> dict[tuple[str, str], Scored]:
    """(environment, model) -> its scores."""
    return {pair: Scored(scores(run, *pair), scores(run, *pair, segments=True)) for pair in wanted}


def score_rows(run: Run, wanted: Iterable[tuple[str, str]]) -> list[dict[str, object]]:
    """Rows of ``score_all``, see ``results.prediction``."""
    found = []
    for (env, model), (open_loop, segments) in score_all(run, wanted).items():
        test = dataset(run, env, "test").take(slice(len(open_loop.outside)))
        found += prediction_results.rows(
            env, model, open_loop, segments, test, seed=run.seed, scale=run.scale
        )
    return found


def pooled_rows(
    run: Run,
    rows: pd.DataFrame | Iterable[Mapping[str, object]],
    name: str = "",
    *,
    whole: bool = True,
) -> pd.DataFrame:
    """The given rows, and at scale paper those of the other seeds beside this run.

    name: the table's, by default the notebook's. Where another seed's notebook did not come to its end, or was a copy
    with other cells than this run's: RunError if ``whole``, else that seed is left out, and it is said.
    """
    own = manifest.statuses(run.dir).get(run.notebook)
    cells = str(own.get("notebook", "")) if isinstance(own, dict) else ""
    file, parts = f"{name or run.notebook}.csv", [tables.frame(rows)]
    for other in run.seeds() if run.scale == "paper" else ():
        if other.dir != run.dir and (path := other.dir / "metrics" / file).exists():
            try:
                require(other, run.notebook, cells=cells)
            except RunError as error:
                if whole:
                    raise
                print(f"seed {other.seed} is left out: {error}")
                continue
            parts.append(tables.load(path))
    return tables.frame(pd.concat(parts))


def _unpacked(tensors: dict[str, torch.Tensor]) -> prediction.Scores:
    values = {
        name.partition(".")[2]: tensor
        for name, tensor in tensors.items()
        if name.startswith("values.")
    }
    fitted = {
        name.partition(".")[2]: tensor
        for name, tensor in tensors.items()
        if name.startswith("fitted.")
    }
    numbers: dict[str, Any] = {
        name: tensor if tensor.ndim else float(tensor) for name, tensor in fitted.items()
    }
    return prediction.Scores(values, tensors["pit"], tensors["outside"], scoring.Fitted(**numbers))


class WithoutPastActions:
    """A model that is shown zeros for the past actions U- (section 3)."""

    def __init__(self, model: DynamicsModel) -> None:
        self.model = model
        self.segment_len, self.past_len, self.features = (
            model.segment_len,
            model.past_len,
            model.features,
        )
        self.stochastic = model.stochastic

    def predict_segment(
        self, past: Segment, actions: Tensor, *, generator: Noise | None = None
    ) -> Tensor:
        """As the model's, see ``DynamicsModel``."""
        return predict_segment(
            self.model, Segment(past.states, 0 * past.actions), actions, generator=generator
        )
