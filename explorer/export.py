"""Export what the page needs into a folder: MJCF, float32 networks, and ``manifest.json``.

    python explorer/export.py explorer/dist

From the shipped safetensors, whose checksums are verified when they are loaded. Weights are
matrices (inputs, outputs) row by row, outputs padded with zeros to a multiple of 8, the last layer
scaled to the units of a step.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import json
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from tsmlib import zoo
from tsmlib.envs import geometry, mujoco_arm
from tsmlib.envs.spec import EnvSpec
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.base import DynamicsModel
from tsmlib.models.baselines import LSTM, OneStep
from tsmlib.models.features import Features
from tsmlib.models.layers import CausalDecoder
from tsmlib.models.recurrent import RecurrentTSM
from tsmlib.models.tsm import TSM
from tsmlib.planning.tasks import HORIZON, TOLERANCE
from tsmlib.pretrained import draw_task, load_pretrained
from tsmlib.storage import files
from tsmlib.storage.files import Json

FORMAT = 3  # of the manifest and of the files that it names; src/files.js asks for the same
PAST_LEN = 10
TASKS = {
    "push": "tsm/ReacherPush-v1",
    "obstacle": "tsm/ReacherObstacle-v0",
    "reach": "tsm/Reacher-v0",
}
MODELS = ("rtsm", "tsm", "lstm", "onestep")
Arrays = dict[str, Tensor]


def linear(name: str, weight: Tensor, bias: Tensor | None, scale: Tensor | None = None) -> Arrays:
    """A layer (out, in) as the kernel reads it: ``name.w`` (in, out padded to 8) and ``name.b``."""
    if scale is not None:
        weight, bias = weight * scale[:, None], None if bias is None else bias * scale
    missing = -len(weight) % 8
    found = {f"{name}.w": nn.functional.pad(weight, (0, 0, 0, missing)).T}
    return found if bias is None else {**found, f"{name}.b": nn.functional.pad(bias, (0, missing))}


def of_layer(name: str, layer: nn.Module, scale: Tensor | None = None) -> Arrays:
    layer = cast(nn.Linear, layer)
    return linear(name, layer.weight, layer.bias, scale)


def of_stack(decoder: CausalDecoder, scale: Tensor) -> Arrays:
    """A stack of gated layers (Eq. 1) with its head: ReLU, and perhaps a hidden layer."""
    if not all(layer.residual for layer in list(decoder.layers)[:-1]):
        raise ValueError("the page knows stacks with residual connections; export another")
    channels, found = decoder.inlet.out_features, of_layer("inlet", decoder.inlet)
    for i, (layer, code) in enumerate(
        zip(decoder.layers, decoder.codes.weight.chunk(len(decoder.layers)), strict=True)
    ):
        earlier, now = layer.taps.weight.split(channels, dim=1)
        found |= linear(f"{i}.earlier", earlier, layer.taps.bias) | linear(f"{i}.now", now, None)
        found |= of_layer(f"{i}.out", layer.out) | linear(f"{i}.codes", code, None)
    *inner, last = [layer for layer in decoder.head if isinstance(layer, nn.Linear)]
    for layer in inner:
        found |= of_layer("hidden", layer)
    return found | of_layer("last", last, scale)


def of_cell(cell: nn.Linear, features: Features) -> Arrays:
    """A cell [s, u, h] -> gates with its inputs in the order of the page's rows, [h, s, u]."""
    seen, h = cell.weight.split(
        [cell.in_features - cell.out_features // 4, cell.out_features // 4], dim=1
    )
    return linear("cell", torch.cat([h, seen], dim=1), cell.bias)


def statistics(features: Features) -> Arrays:
    return {"mean": features.mean, "std": features.std}


@torch.no_grad()
def network(model: nn.Module) -> tuple[dict[str, Json], Arrays]:
    """What the page is told of a model, and its arrays; ValueError for an unknown class."""
    match model:
        case ActionPrior():
            shape: dict[str, Json] = {
                "dilations": list(model.decoder.dilations),
                "codes": model.latent_dim,
                "hold": 10,
            }
            return {"kind": "prior", **shape}, {"std": model.std} | of_stack(
                model.decoder, model.std
            )
        case TSM():
            shape = {
                "dilations": list(model.decoder.dilations),
                "codes": model.latent_dim,
                "hold": model.segment_len,
            }
            return {"kind": "gated", **shape}, statistics(model.features) | of_stack(
                model.decoder, model.features.step_std
            )
        case RecurrentTSM():
            hidden, _, out = model.decoder.head
            arrays = of_cell(model.decoder.cell, model.features) | linear(
                "codes", model.decoder.codes.weight, None
            )
            arrays |= of_layer("hidden", hidden) | of_layer("last", out, model.features.step_std)
            return {"kind": "recurrent", "codes": model.latent_dim, "hold": model.code_len}, (
                statistics(model.features) | arrays
            )
        case LSTM():
            arrays = of_cell(model.cell, model.features) | of_layer(
                "last", model.out, model.features.step_std
            )
            return {"kind": "recurrent", "codes": 0, "hold": 0}, statistics(model.features) | arrays
        case OneStep():
            layers = [layer for layer in model.net if isinstance(layer, nn.Linear)]
            arrays = {
                k: v
                for i, layer in enumerate(layers[:-1])
                for k, v in of_layer(f"{i}", layer).items()
            }
            arrays |= of_layer("last", layers[-1], model.features.step_std)
            return {"kind": "feedforward", "layers": len(layers) - 1, "codes": 0, "hold": 0}, (
                statistics(model.features) | arrays
            )
    raise ValueError(
        f"the page cannot run a {type(model).__name__}; it knows segment models and baselines"
    )


@torch.no_grad()
def strongest_codes(model: DynamicsModel, env: str, n: int = 2) -> list[int]:
    """The dimensions of the code that move the end of a rollout most, over 20 starts."""
    if not isinstance(model, TSM | RecurrentTSM):
        return []
    task = draw_task(env, seed=1_000_003, n=20)
    past = task.past(PAST_LEN)
    torques = torch.zeros(len(task), model.code_len, 2) + 0.1
    moved = []
    for axis in torch.eye(model.latent_dim):
        low, high = (
            model.decode(past, torques, (side * axis).expand(len(task), -1)) for side in (-2.0, 2.0)
        )
        moved.append(float(model.features.difference(low, high).norm(dim=(1, 2)).mean()))
    return sorted(range(model.latent_dim), key=lambda i: -moved[i])[:n]


def write_network(folder: Path, name: str, model: nn.Module) -> dict[str, Json]:
    """Write a model's arrays as one file of little-endian float32; what the manifest says of it."""
    about, arrays = network(model)
    at, places, parts = 0, {}, []
    for word, array in arrays.items():
        values = np.ascontiguousarray(array.detach().numpy(), "<f4")
        places[word] = {"at": at, "shape": list(values.shape)}
        at, parts = at + values.size, [*parts, values.tobytes()]
    data = b"".join(parts)
    files.write_bytes(folder / f"{name}.f32", data)
    return {
        **about,
        "file": f"{name}.f32",
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
        "arrays": cast(Json, places),
    }


def write_physics(folder: Path, name: str, env: str) -> dict[str, Json]:
    """Write the arm of ``env`` as MJCF, and the numbers that its six digits do not give."""
    model, spec = mujoco_arm.load_model(env), mujoco.MjSpec.from_file(str(mujoco_arm.ASSET))
    task = EnvSpec.parse(env).task
    if task != "reach":
        spec.delete(spec.body("target"))
        mujoco_arm._add_block(spec, EnvSpec.parse(env).physics, moving=task == "push")
    spec.option.timestep, spec.option.integrator = model.opt.timestep, model.opt.integrator
    spec.option.disableflags = model.opt.disableflags
    spec.compile()
    xml = spec.to_xml()
    files.write_bytes(folder / f"{name}.xml", xml.encode())
    again, exact = mujoco.MjModel.from_xml_string(xml), {}
    for word in dir(model):
        value = None if word.startswith("_") else getattr(model, word)
        if isinstance(value, np.ndarray) and value.dtype == np.float64:
            other = getattr(again, word)
            if value.shape != other.shape:
                raise ValueError(
                    f"{env}: {word} is {value.shape} as compiled and {other.shape} from its MJCF"
                )
            if not np.array_equal(value, other):
                exact[word] = value.ravel().tolist()
    return {
        "file": f"{name}.xml",
        "substeps": round(geometry.DT / model.opt.timestep),
        "exact": cast(Json, exact),
    }


def write(folder: Path, tasks: Mapping[str, str] = TASKS) -> None:
    """Write everything, the manifest last."""
    described: dict[str, Json] = {}
    for task, env in tasks.items():
        spec, ring = EnvSpec.parse(env), geometry.TARGET_RING[task]
        models: dict[str, Json] = {}
        for word in MODELS:
            try:
                model = load_pretrained(word, env=env)
            except ValueError:  # none ships
                continue
            look = zoo.look(word)
            network = write_network(folder, f"{spec.name}-{word}", cast(nn.Module, model))
            knobs = strongest_codes(model, env)
            models[word] = cast(
                Json, {"network": network, "name": look.name, "colour": look.colour, "knobs": knobs}
            )
        prior = write_network(
            folder, f"{spec.name}-prior", cast(nn.Module, load_pretrained("prior", env=env))
        )
        described[task] = {
            "env": env,
            "stateDim": spec.state_dim,
            "models": models,
            "prior": prior,
            "physics": write_physics(folder, spec.name, env),
            "horizon": HORIZON["push" if task == "push" else "reach"],
            "tolerance": TOLERANCE["push" if task == "push" else "reach"],
            "start": {
                "angles": list(geometry.START_ANGLES[task]),
                "block": list(geometry.BLOCK_RING),
            },
            "target": list(ring),
        }
    manifest: dict[str, Json] = {
        "format": FORMAT,
        "dt": geometry.DT,
        "pastLen": PAST_LEN,
        "tasks": described,
        "arm": {
            "links": list(geometry.LINK_LENGTHS),
            "capsule": geometry.LINK1_CAPSULE,
            "radius": geometry.ARM_RADIUS,
            "elbow": geometry.ELBOW_LIMIT,
            "block": geometry.BLOCK_RADIUS,
            "wall": geometry.WALL,
            "clearance": geometry.BLOCK_CLEARANCE,
        },
    }
    for file in importlib.metadata.distribution("mujoco-core").files or ():
        if "licenses" in file.parts:  # of MuJoCo and of what is built into it
            files.write_bytes(folder / "vendor" / file.name, file.read_binary())
    files.write_bytes(folder / "manifest.json", json.dumps(manifest).encode())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description="Export the networks and the physics of the explorer."
    )
    parser.add_argument("folder", type=Path)
    write(parser.parse_args().folder)
