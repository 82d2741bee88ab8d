"""Data sets at a run's scale, collected where they are missing."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import cast

import gymnasium
import torch
from tqdm.auto import tqdm

import tsmlib.envs
from tsmlib.collection import collect, open_loop, smooth_torques
from tsmlib.envs.spec import EnvSpec, gone
from tsmlib.storage import artifacts
from tsmlib.storage.files import Json, StoreError
from reproduction.parameters import ParameterError, standard_arm
from reproduction.runs import Run
from tsmlib.trajectory import Trajectories

SPLITS = ("train", "validation", "test")
HELD_OUT_SEED = {
    "validation": 1_000_001,
    "test": 1_000_002,
}  # of episodes, the same for every run seed
TASK_SEED = {"validation": 1_000_003, "test": 1_000_004}  # of targets


def require_other_seed(*seeds: int) -> None:
    """ParameterError for a training seed that draws held-out episodes or targets."""
    if held_out := sorted({*HELD_OUT_SEED.values(), *TASK_SEED.values()} & set(seeds)):
        raise ParameterError(
            f"seed {held_out[0]} draws held-out episodes or targets, on which nothing may be trained; choose others."
        )


def parse_choice(parameter: str, text: str, known: Sequence[str]) -> list[str]:
    """The value of a notebook parameter that names one of ``known``, several with commas between, or all.

    A variant of an environment is known where the standard one is.
    """
    names = list(known) if text == "all" else [word.strip() for word in text.split(",")]
    if unknown := [word for word in names if word not in known and standard_arm(word) not in known]:
        raise ParameterError(
            f"{parameter} names {unknown[0]!r:.80}, expected some of {', '.join(known)}; or all."
        )
    return list(dict.fromkeys(names))


def sizes(run: Run, env: str) -> dict[str, int]:
    """Episodes per split: the paper's 500 on the basic arm and 5,000 elsewhere, 200 for validation, 1,000 for test."""
    full = {"train": 5000 if EnvSpec.parse(env).has_block else 500, "validation": 200, "test": 1000}
    return run.pick(smoke={"train": 20, "validation": 8, "test": 8}, laptop=full, paper=full)


def dataset(run: Run, env: str, split: str) -> Trajectories:
    """One split of an environment's data, collected at the first call. Training data depend on the run's seed.

    Raises StoreError for a file of another environment, split or seed.
    """
    n, seed = sizes(run, env)[split], HELD_OUT_SEED.get(split, run.seed)
    path = run.folder(f"data/{EnvSpec.parse(env).name}") / f"{split}.safetensors"
    if path.exists():
        command = f"python -m tsmlib run collect --scale {run.scale} --seed {run.seed}"
        with remade_by(command, path):
            found = artifacts.load_trajectories(path, expect=fingerprint(env))
        header = artifacts.unchecked_header(path)
        if (stated := (header.get("split", split), header.get("seed", seed))) != (split, seed):
            raise StoreError(
                f"{path} holds split {stated[0]!r} drawn with seed {stated[1]}, expected {split!r} with seed {seed}. "
                f"Move it to where it belongs, or delete it and make a new one: {command}"
            )
        return found
    require_other_seed(run.seed)
    if n >= 1000:
        print(f"{env}: collecting {n:,} episodes for {split}, about {n / 100:.0f} s on one core")
    data = random_data(env, n, seed=seed)
    artifacts.save_trajectories(
        path,
        data,
        {"split": split, "seed": seed, "scale": run.scale, "fingerprint": fingerprint(env)},
    )
    return data


def datasets(run: Run, wanted: Iterable[tuple[str, str]]) -> dict[tuple[str, str], Trajectories]:
    """(environment, split) -> its data."""
    return {pair: dataset(run, *pair) for pair in tqdm(list(wanted), desc="data sets")}


def random_data(env: str, n: int, *, seed: int, horizon: int = 100) -> Trajectories:
    """``n`` episodes of smooth random torques, a function of (env, n, seed) alone."""
    torques = smooth_torques(n, horizon, generator=torch.Generator().manual_seed(seed))
    with closing(gymnasium.make_vec(env, num_envs=n)) as copies:
        return collect(copies, open_loop(torques), horizon=horizon, seed=seed)


@contextmanager
def remade_by(command: str, path: Path) -> Iterator[None]:
    """Of a file at ``path`` for an environment that is gone: StoreError with the reason, and what makes a new one."""
    try:
        yield
    except artifacts.Misfit as misfit:
        if reason := gone(str(misfit.found.get("env"))):
            raise StoreError(
                f"{path} does not fit: {reason}. Delete it and make a new one: {command}"
            ) from misfit
        raise


def fingerprint(env: str) -> dict[str, Json]:
    """What a model of this environment was made for; a file that says otherwise is refused."""
    return cast("dict[str, Json]", tsmlib.envs.fingerprint(env))
