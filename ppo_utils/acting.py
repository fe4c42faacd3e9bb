"""A trained agent in a program of one's own, which has one environment and steps it itself."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import concatenate, create_empty_array

from ppo_utils.checkpoints import Checkpoint
from ppo_utils.environments import as_tensors, env_actions, envs_for, wrap_envs, wrappers_of
from ppo_utils.errors import report_unusable_policy
from ppo_utils.evaluation import MEMORY_STEPS, with_room
from ppo_utils.lanes import check_fits


class Player:
    """Acts in one environment, an observation at a time: its memory goes on from call to call.

    path: a model or a checkpoint. deterministic: take the most probable actions instead of sampling them. It makes one
    environment of its training to ask for the spaces, and closes it.

    Raises ValueError, OSError, ImportError or gymnasium.error.Error, each with one line for the user.
    """

    def __init__(self, path: str | Path, deterministic: bool = False):
        checkpoint = Checkpoint.read(path)
        self.args, self.deterministic = checkpoint.args, deterministic
        self.args.ground_truth_coef = self.args.reconstruction_coef = 0.0  # the auxiliary heads do not act
        self.args.amp = self.args.async_envs = False  # there is little to compute
        envs = envs_for(self.args, 1)
        envs.close()
        self.given = GivenObservations(envs.unwrapped)
        self.envs = wrap_envs(self.given, **wrappers_of(self.args))
        self.agent = checkpoint.agent(self.envs, {})
        self.reset()

    def reset(self) -> None:
        """Forget all: the next observation is the first one of an episode."""
        fresh = self.agent.memory.initial(1, torch.device("cpu"))
        self.memory = self.agent.memory.begin_rollout(fresh, MEMORY_STEPS)
        self.steps, self.actions = 0, None

    @torch.no_grad()
    def act(self, observation: Any, reward: float = 0.0) -> Any:
        """Return an action for the environment's own observation: an integer for Discrete, (A,) for MultiDiscrete.

        reward: of the step before; --observe-last-action needs it.
        Raises ValueError for an observation of another space, RunError for one that is not finite or outside of it.
        """
        self.given.now = observation, reward
        obs = self.envs.reset()[0] if self.actions is None else self.envs.step(self.actions)[0]
        obs = as_tensors(obs, torch.device("cpu"))
        self.memory = with_room(self.agent.memory, self.memory, self.steps)
        with report_unusable_policy():
            self.actions = self.agent.get_action_and_value(obs, self.memory, self.deterministic)[0].numpy()
        self.steps += 1
        action = env_actions(self.given.single_action_space, self.actions)[0]
        return action if np.ndim(action) else int(action)


class GivenObservations(VectorEnv):
    """One environment that observes, and earns, what it is given: `now`, an observation and a reward."""

    def __init__(self, envs: VectorEnv):
        self.num_envs, self.spec = 1, envs.spec
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.single_observation_space, self.observation_space = envs.single_observation_space, envs.observation_space
        self.single_action_space, self.action_space = envs.single_action_space, envs.action_space
        self.now: tuple[Any, float] | None = None

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Return the observation."""
        return self._observations(), {}

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Return the observation and the reward."""
        return self._observations(), np.array([self.now[1]], np.float64), np.array([False]), np.array([False]), {}

    def _observations(self) -> Any:
        space = self.single_observation_space
        try:
            check_fits(space, self.now[0])
        except ValueError as error:
            hint = "make the environment with the training's obs_type, options and constructor arguments"
            raise ValueError(f"{self.spec.id}: {error}; {hint}") from None
        return concatenate(space, [self.now[0]], create_empty_array(space, 1))
