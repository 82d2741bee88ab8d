"""What goes wrong in a simulator: the error that says so, MuJoCo's warnings, a missing screen."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


class SimulationUnstable(RuntimeError):
    """The simulator left the physical range.

    Attributes:
        env: id.
        episode: which of those that ran together.
        step: since its reset, from 0.
        reason: what left the range.
    """

    def __init__(self, env: str, episode: int, step: int, reason: str) -> None:
        super().__init__(
            f"the simulation of {env} became unstable in episode {episode} at step {step}: "
            f"{reason}. "
            "Check the state this episode started from; the other episodes of this call were not "
            "returned."
        )
        self.env, self.episode, self.step, self.reason = env, episode, step, reason


@contextmanager
def without_log() -> Iterator[None]:
    """MuJoCo's warnings go nowhere, so that it writes no MUJOCO_LOG.TXT.

    Whoever asks for this reports what went wrong.
    """
    import mujoco

    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)


def import_mujoco() -> None:
    """Import MuJoCo so that it draws without a screen, or, where it cannot, simulates all the same.

    It refuses to be imported where the library that draws, which MUJOCO_GL names, is missing.
    """
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        import mujoco
    except (ImportError, AttributeError, OSError, RuntimeError):
        os.environ["MUJOCO_GL"] = "disabled"
        import mujoco  # noqa: F401
