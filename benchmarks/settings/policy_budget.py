"""Policies learned in fewer updates: 880 instead of the paper's 2,200, cut short or with a faster decay.

Three direct copies inside a shipped model; their executed return is measured on 100 validation targets.

    python benchmarks/settings/policy_budget.py
"""

from __future__ import annotations

import argparse

import torch

from tsmlib import study
from tsmlib.policies.learning import LearningOptions, episodes_from, learn_policy
from tsmlib.policies.networks import OneStepPolicy
from tsmlib.study import runs, zoo

TRIES = {"2,200": (2200, 0.9), "880, decayed as far": (880, 0.9**2.5), "880, cut short": (880, 0.9)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=("tsm/Reacher-v0", "tsm/ReacherPush-v1"), default="tsm/ReacherPush-v1")
    parser.add_argument("--model", choices=zoo.words("dynamics"), default=zoo.OURS)
    arguments = parser.parse_args()
    run, task = runs.resolve("bench", scale="laptop"), study.load_task(arguments.env, "validation")
    model, _ = study.load_or_train(run, arguments.env, arguments.model)
    starts = torch.from_numpy(study.random_data(arguments.env, 1000, seed=0).states[:, 0])
    reward = task.reward_for
    for name, (iterations, decay) in TRIES.items():
        policy = OneStepPolicy(starts.shape[1], 2, angles=model.features.angles, copies=3)
        curve = learn_policy(
            policy, model, reward, episodes_from(starts),
            LearningOptions(horizon=task.horizon, iterations=iterations, lr_decay=decay, record_every=iterations),
            measure=lambda p: study.assess(p, model, task, seed=1), progress=name,
        )  # fmt: skip
        executed = torch.tensor(curve.measured["return_true"][-1])
        print(
            f"{name} updates, {curve.seconds[-1]:.0f} s: return {executed.mean():.2f}, three copies {executed.tolist()}"
        )


if __name__ == "__main__":
    main()
