"""The error of a simulation that left what is possible, of any environment."""


class SimulationUnstable(RuntimeError):
    """The simulator left the physical range: ``env`` (id), ``episode``, ``step`` since reset (from 0), ``reason``."""

    def __init__(self, env: str, episode: int, step: int, reason: str) -> None:
        super().__init__(
            f"the simulation of {env} became unstable in episode {episode} at step {step}: {reason}. "
            "Check the state this episode started from; the other episodes of this call were not returned."
        )
        self.env, self.episode, self.step, self.reason = env, episode, step, reason
