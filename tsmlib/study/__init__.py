"""What the notebooks share: data sets, trained models and frozen tasks at a run's scale, made where they are missing.

Anything a notebook asks for is taken from its run's folder, else from what ships under ``data``, else made on the spot
with a progress bar. Only here is it known how much of everything each scale uses.
"""

from tsmlib.envs import has_block
from tsmlib.study.data import HELD_OUT_SEED, SPLITS, chosen, dataset, fingerprint, random_data, short, sizes
from tsmlib.study.models import (
    BUDGET,
    CHOICES,
    CLASSES,
    DYNAMICS,
    MODELS,
    OURS,
    Stage,
    bf16_pays,
    fresh,
    load_or_train,
    schedule,
    train,
    train_ahead,
)
from tsmlib.study.parallel import ahead
from tsmlib.study.plans import along_the_way, plan, trial
from tsmlib.study.policies import EPISODES, assess, kept_budget, learn, within_data
from tsmlib.study.predictions import RESULTS, evidence, scores, table
from tsmlib.study.tasks import FROZEN, TASK_SEED, draw_task, freeze_tasks, task

__all__ = [
    "BUDGET", "CHOICES", "CLASSES", "DYNAMICS", "EPISODES", "FROZEN", "HELD_OUT_SEED", "MODELS", "OURS", "RESULTS",
    "SPLITS", "TASK_SEED", "Stage", "ahead", "along_the_way", "assess", "bf16_pays", "chosen", "dataset", "draw_task",
    "evidence", "fingerprint", "freeze_tasks", "fresh", "has_block", "kept_budget", "learn", "load_or_train",
    "plan", "random_data", "schedule", "scores", "short", "sizes", "table", "task", "train",
    "train_ahead", "trial", "within_data",
]  # fmt: skip
