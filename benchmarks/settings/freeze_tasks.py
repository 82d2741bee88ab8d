"""Write the test tasks of every environment into data/tasks. Done once; a test compares them with a new draw.

python benchmarks/settings/freeze_tasks.py
"""

from __future__ import annotations

from tsmlib import study
from tsmlib.envs.spec import ENV_IDS, EnvSpec
from tsmlib.storage import artifacts

if __name__ == "__main__":
    study.FROZEN.mkdir(parents=True, exist_ok=True)
    for env in ENV_IDS:
        drawn = study.draw_task(env, seed=study.TASK_SEED["test"])
        header = {"task": drawn.name, "env": env, "seed": study.TASK_SEED["test"]}
        path = study.FROZEN / f"{EnvSpec.parse(env).name}.safetensors"
        artifacts.save(path, {"start": drawn.start, "target": drawn.target}, kind="task", header=header)
