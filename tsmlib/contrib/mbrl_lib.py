"""mbrl-lib's models behind the planners of this package, and models of this package behind
mbrl-lib's ``ModelEnv``.

mbrl-lib is not needed to import this module. Its own pins do not install beside today's Gymnasium,
so it is installed without them: ``pip install 'tsmlib[mbrl]'`` and then ``pip install --no-deps
mbrl==0.2.0``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, TypedDict, cast

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor

from tsmlib.contrib.one_step_ensemble import OneStepEnsemble
from tsmlib.models.base import Model, Step, as_dynamics, stepper
from tsmlib.models.layers import first_weight
from tsmlib.rewards import Reward, rewarded
from tsmlib.trajectory import Segment, initial_past

if TYPE_CHECKING:
    from mbrl.models import ModelEnv


class Network(Protocol):
    """What is asked of the network inside: mbrl-lib's ``GaussianMLP`` has it."""

    num_members: int
    elite_models: list[int] | None

    def forward(self, x: Tensor, *, use_propagation: bool) -> tuple[Tensor, Tensor | None]: ...


class Normalizer(Protocol):
    """mbrl-lib's statistics of the inputs."""

    def normalize(self, val: Tensor) -> Tensor: ...


class TransitionModel(Protocol):
    """What is asked of mbrl-lib's model: ``OneDTransitionRewardModel`` has it."""

    model: Network
    input_normalizer: Normalizer | None
    obs_process_fn: Callable[[Tensor], Tensor] | None
    target_is_delta: bool
    no_delta_list: list[int]
    learned_rewards: bool


class MbrlModel(torch.nn.Module, OneStepEnsemble):
    """A trained ``mbrl.models.OneDTransitionRewardModel`` with a ``GaussianMLP`` as a model of this
    package.

    Its observations are the states here, in physical units, and its actions those here, in [-1, 1].
    Of a learned reward nothing is used: rewards are functions here. Only the elite members predict,
    where there are some. TypeError naming what another object lacks.
    """

    def __init__(self, model: TransitionModel) -> None:
        super().__init__()
        inner = getattr(model, "model", None)
        missing = [name for name in TransitionModel.__annotations__ if not hasattr(model, name)]
        if inner is not None:
            missing += [
                f"model.{name}" for name in ("num_members", "forward") if not hasattr(inner, name)
            ]
        if missing:
            raise TypeError(
                f"{type(model).__name__} has no {', '.join(missing)}; expected an "
                "mbrl.models.OneDTransitionRewardModel around a GaussianMLP"
            )
        self.theirs = model
        elite = getattr(model.model, "elite_models", None)
        self.elite = list(range(model.model.num_members)) if elite is None else list(elite)
        self.members = len(self.elite)

    def step(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor | None]:
        theirs, seen = self.theirs, x
        if theirs.obs_process_fn is not None:
            seen = (
                torch.as_tensor(theirs.obs_process_fn(x.flatten(0, 1)))
                .to(x)
                .unflatten(0, x.shape[:2])
            )
        inputs = torch.cat([seen, u], dim=-1)
        if theirs.input_normalizer is not None:
            inputs = theirs.input_normalizer.normalize(inputs).to(x.dtype)
        # Every network takes the rows of its own member; one that is not among the elite computes
        # for nothing.
        every = inputs.new_zeros(theirs.model.num_members, *inputs.shape[1:])
        every[self.elite] = inputs
        mean, log_variance = theirs.model.forward(every, use_propagation=False)
        dx = x.shape[-1]
        mean = mean[self.elite][..., :dx]  # the last column is a learned reward
        if theirs.target_is_delta:
            absolute = torch.zeros(dx, dtype=torch.bool, device=x.device)
            absolute[theirs.no_delta_list] = True
            mean = torch.where(absolute, mean - x, mean)
        else:
            mean = mean - x
        return mean, None if log_variance is None else (
            0.5 * log_variance[self.elite][..., :dx]
        ).exp()


class ModelState(TypedDict):
    """A state of a simulation: ``obs`` (B, dx) as mbrl-lib has it, the past, and what steps on from
    here.
    """

    obs: Tensor
    past: Segment
    steps: int
    run: _Run


class _Run:
    """One batch of rollouts, which can only be stepped on from its latest state."""

    def __init__(self) -> None:
        self.step: Step | None = None
        self.deterministic, self.steps = False, 0


class ForModelEnv:
    """A model of this package as what ``mbrl.models.ModelEnv`` asks of its dynamics model:
    ``reset`` and ``sample``.

    A code, or a member, is drawn for each segment of H steps and held, as in ``rollout``. The past
    of a rollout is its first state, repeated, unless ``saw`` said what really happened before.
    Rewards are not predicted: give ``ModelEnv`` a function (``reward_function``).
    """

    def __init__(self, model: Model, action_dim: int) -> None:
        self.model, self.action_dim = model, action_dim
        self._stochastic = as_dynamics(model).stochastic
        self._past_len = as_dynamics(model).past_len
        weight = first_weight(model)
        self.device = torch.device("cpu") if weight is None else weight.device
        self._past: Segment | None = None

    def saw(self, past: Segment | None) -> None:
        """Let rollouts start from ``past`` (1, L, .), what has happened until now; None at the
        start of an episode.
        """
        self._past = past

    def reset(self, obs: np.ndarray | Tensor, rng: torch.Generator | None = None) -> ModelState:
        """Begin rollouts in ``obs`` (B, dx). ValueError where these are not the states in which the
        seen past ends.
        """
        x = torch.as_tensor(obs, dtype=torch.float32, device=self.device)
        if self._past is None:
            past = initial_past(x, self._past_len, self.action_dim)
        else:
            past = Segment(*(part.to(x).expand(len(x), -1, -1) for part in self._past))
            if not torch.allclose(past.states[:, -1], x, atol=1e-4):
                raise ValueError(
                    "rollouts are asked for from another state than the one in which the past of "
                    "saw(past) ends: say saw(...) after every step of the environment, and "
                    "saw(None) when an episode begins"
                )
        return {"obs": x, "past": past, "steps": 0, "run": _Run()}

    def sample(
        self,
        act: Tensor,
        model_state: ModelState,
        deterministic: bool = False,
        rng: torch.Generator | None = None,
    ) -> tuple[Tensor, None, None, ModelState]:
        """Next states (B, dx) under ``act`` (B, du), no rewards, no ends, and the state to go on
        from.

        deterministic: the mode; else samples drawn from ``rng``. ValueError for a state that was
        stepped on before.
        """
        run, past = model_state["run"], model_state["past"]
        if model_state["steps"] != run.steps:
            raise ValueError(
                f"this model state, {model_state['steps']} steps after its reset, was stepped on "
                f"before, to step "
                f"{run.steps}; go on from the state that sample() gave, or reset() again"
            )
        u = torch.as_tensor(act).to(model_state["obs"])
        with torch.no_grad():
            if run.step is None or run.deterministic != deterministic:
                generator = None if deterministic or not self._stochastic else rng
                run.step = stepper(self.model, past, generator=generator)
                run.deterministic = deterministic
            x = run.step(u)
        run.steps += 1
        past = past.then(Segment(x[:, None], u[:, None])).last(self._past_len)
        return x, None, None, {"obs": x, "past": past, "steps": run.steps, "run": run}


def reward_function(reward: Reward) -> Callable[[Tensor, Tensor], Tensor]:
    """A reward of this package, for one instance of a task, as mbrl-lib has them: (B, du), next (B,
    dx) -> (B, 1).
    """

    def of_steps(act: Tensor, next_obs: Tensor) -> Tensor:
        return rewarded(reward, next_obs[:, None, None], act[:, None, None])[:, 0]

    return of_steps


def never(act: Tensor, next_obs: Tensor) -> Tensor:
    """mbrl-lib's termination function of an episode that only a limit of time ends: (B, 1) of
    False.
    """
    return torch.zeros(len(next_obs), 1, dtype=torch.bool, device=next_obs.device)


def model_env(
    model: Model,
    env: gymnasium.Env,
    reward: Reward,
    *,
    terminated: Callable[[Tensor, Tensor], Tensor] = never,
    generator: torch.Generator | None = None,
) -> ModelEnv:
    """An ``mbrl.models.ModelEnv`` in which a model of this package stands in for ``env``, for
    mbrl-lib's agents.

    reward: of this package, for one instance of a task (``task.take(1).reward``). terminated:
    mbrl-lib's function of actions (B, du) and next states (B, dx) to (B, 1) bool. Actions lie in
    [-1, 1], whatever the bounds of ``env``. ``found.dynamics_model.saw(past)`` says what happened
    before a plan is asked for in the middle of an episode.
    """
    try:
        from mbrl.models import ModelEnv
    except ImportError as error:
        raise ImportError(
            f"mbrl-lib cannot be imported ({error}): pip install "
            "'tsmlib[mbrl]', then pip install --no-deps mbrl==0.2.0"
        ) from error
    space = cast(Box, env.action_space)
    (action_dim,) = space.shape
    adapted = ForModelEnv(model, action_dim)
    made = ModelEnv(
        env,
        adapted,
        terminated,
        reward_function(reward),
        generator or torch.Generator(adapted.device),
    )
    made.action_space = Box(-1.0, 1.0, (action_dim,), np.float32)
    return made
