"""What the best controllers of cartpole and pendulum could return: data/results/dmc_limits.csv.

    OMP_NUM_THREADS=1 python benchmarks/dmc_limits.py

Pendulum: value iteration over a grid of angles and speeds, mean over all starts. Cartpole: the
planner of `tsmlib.solve` through the equations of motion, as it is and with a larger search, and
the best of five open-loop searches over the first 2.5 seconds, after which nothing need be lost.
"""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from torch import Tensor

import tsmlib
from reproduction import tables
from tsmlib.envs.dmc import TASKS, cartpole_reward
from tsmlib.models.base import Step, repeated
from tsmlib.solving import Controller
from tsmlib.trajectory import Segment

CARTPOLE, PENDULUM = "tsm/dmc-cartpole-swingup-v0", "tsm/dmc-pendulum-swingup-v0"
ANGLES, SPEEDS, FASTEST = 720, 401, 14.0  # of the grid; rad/s


def pendulum() -> float:
    """Mean over starts at rest of the best return."""
    model = mujoco.MjModel.from_xml_string(TASKS["pendulum-swingup"].model)
    inertia, pull, damping, h = (
        1 / _acceleration(model, 0, 1),
        _acceleration(model, np.pi / 2, 0),
        0.1,
        0.02,
    )
    angle = np.linspace(-np.pi, np.pi, ANGLES, endpoint=False)
    speed = np.linspace(-FASTEST, FASTEST, SPEEDS)
    choices = []
    for torque in (-1.0, -0.5, 0.0, 0.5, 1.0):
        x, v = np.meshgrid(angle, speed, indexing="ij")
        reward = np.zeros_like(x)
        for _ in range(2):
            force = inertia * pull * np.sin(x) + torque - damping * v
            v = v + h * force / (inertia + h * damping)
            x = x + h * v
            reward += np.cos(x) >= np.cos(np.deg2rad(8))
        row = (x + np.pi) / (2 * np.pi) * ANGLES % ANGLES
        column = np.clip((v / FASTEST + 1) / 2 * (SPEEDS - 1), 0, SPEEDS - 1.001)
        i, j = row.astype(int), column.astype(int)
        corners = [
            (
                ((i + a) % ANGLES) * SPEEDS + j + b,
                np.abs(1 - a - row + i) * np.abs(1 - b - column + j),
            )
            for a in (0, 1)
            for b in (0, 1)
        ]
        choices.append((reward, corners))
    value = np.zeros((ANGLES, SPEEDS))
    for _ in range(500):
        after = value.ravel()
        value = np.max(
            [r + sum(w * after[k] for k, w in corners) for r, corners in choices], axis=0
        )
    return float(value[:, SPEEDS // 2].mean())


def _acceleration(model: mujoco.MjModel, angle: float, torque: float) -> float:
    data = mujoco.MjData(model)
    data.qpos[0], data.ctrl[0] = angle, torque
    mujoco.mj_forward(model, data)
    return float(data.qacc[0])


class Cartpole:
    """Its equations of motion in a model's place, by one Runge-Kutta step for each step."""

    segment_len, past_len, stochastic, robot = 1, 1, False, None

    def __init__(self) -> None:
        model = mujoco.MjModel.from_xml_string(TASKS["cartpole-swingup"].model)
        self.cart, self.pole = map(float, model.body_mass[1:])
        self.middle = float(model.body_ipos[2, 2])
        self.inertia = float(model.body_inertia[2, 1]) + self.pole * self.middle**2

    def begin(self, past: Segment, *, generator: object = None) -> Step:
        """Go on from the last state."""
        return repeated(self.step, past.states[:, -1])

    def slope(self, x: Tensor, u: Tensor) -> Tensor:
        """The state's derivative."""
        _, angle, speed, turn = x.unbind(-1)
        lever, sine = self.pole * self.middle, angle.sin()
        push = 10 * u[..., 0] - 5e-4 * speed + lever * sine * turn.square()
        twist = 9.81 * lever * sine - 2e-6 * turn
        a, b, c = self.cart + self.pole, lever * angle.cos(), self.inertia
        rates = [speed, turn, (c * push - b * twist) / (a * c - b * b)]
        return torch.stack([*rates, (a * twist - b * push) / (a * c - b * b)], -1)

    def step(self, x: Tensor, u: Tensor, h: float = 0.02) -> Tensor:
        """0.02 s on."""
        one = self.slope(x, u)
        two = self.slope(x + h / 2 * one, u)
        three = self.slope(x + h / 2 * two, u)
        return x + h / 6 * (one + 2 * two + 2 * three + self.slope(x + h * three, u))


def cartpole(candidates: int, iterations: int) -> float:
    """Return of an episode by solve's controller through the equations."""
    options = tsmlib.SolveOptions(candidates=candidates, iterations=iterations)
    space = tsmlib.DirectActions(60, 1, rms=options.rms)
    task = tsmlib.Task.from_env(CARTPOLE, n=1, horizon=500, seed=500)
    controller = Controller(Cartpole(), cartpole_reward, space, 5, options)
    trial = tsmlib.execute(task, controller, past_len=1)
    return float(trial.own_return)


def cartpole_best() -> float:
    """Best return of five open-loop searches over 2.5 s, all reward assumed after it."""
    task = tsmlib.Task.from_env(CARTPOLE, n=1, horizon=125, seed=500)
    predict = tsmlib.model_predictor(Cartpole(), task.past(1))
    space = tsmlib.DirectActions(125, 1, rms=0.8, smoothness=3)
    plans = [
        tsmlib.cem(predict, task.reward, space, 1, candidates=512, elites=48, iterations=25, seed=k)
        for k in range(5)
    ]
    return 1000 - 2 * (125 - max(float(plan.predicted_return) for plan in plans))


def main() -> None:
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    rows: list[tables.Row] = []

    def keep(env: str, planner: str, value: float, n: int = 1) -> None:
        about = {"env": env, "sim": "mujoco", "model": "equations", "planner": planner, "n": n}
        rows.append(about | {"metric": "return", "value": round(value, 1)})
        print(env, planner, round(value, 1), flush=True)
        tables.write(tables.RESULTS / "dmc_limits.csv", rows)

    keep(PENDULUM, "value iteration, all starts", pendulum(), ANGLES)
    keep(CARTPOLE, "cem 512 x 25, open loop", cartpole_best())
    keep(CARTPOLE, "cem 64 x 3", cartpole(64, 3))
    keep(CARTPOLE, "cem 256 x 5", cartpole(256, 5))


if __name__ == "__main__":
    main()
