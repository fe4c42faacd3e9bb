"""Stable-Baselines3's interface to N environments that are stepped together. Needs the extra `sb3`.

    from sb3_contrib import RecurrentPPO
    from stable_baselines3.common.vec_env import VecMonitor
    from memory_gym_envs.sb3 import SB3VecEnv

    envs = VecMonitor(SB3VecEnv(gym.make_vec("MysteryPath-v0", num_envs=16)))
    RecurrentPPO("CnnLstmPolicy", envs).learn(100_000)

Its own `make_vec_env` makes N single environments and steps them one after the other.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from memory_gym_envs.base import MemoryGymVectorEnv


class SB3VecEnv(VecEnv):
    """N lanes of a vector environment of this package as a VecEnv, for algorithms, wrappers and `evaluate_policy`.

    envs: by `gym.make_vec(id, num_envs=N)`, with same-step autoreset. Raises ValueError for any other.

    Infos are those of single environments, with `terminal_observation` and `TimeLimit.truncated`. Options, by
    `set_options`, are the same for all lanes, and hold for automatic resets too, until the next explicit one.
    Attributes and methods are those of the vector environment: one for all lanes.
    """

    def __init__(self, envs: gym.vector.VectorEnv):
        if not isinstance(envs, MemoryGymVectorEnv) or envs.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"it takes a vector environment of memory_gym_envs with same-step autoreset, not {envs}")
        self.envs = envs
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Any:
        """Starts new episodes with the seeds and options that were set since the last reset."""
        if any(options != self._options[0] for options in self._options):
            raise ValueError("set_options needs the same options for all lanes")
        observations, infos = self.envs.reset(seed=self._seeds, options=self._options[0] or None)
        self.reset_infos = [{"ground_truth": truth} for truth in infos["ground_truth"]]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Takes the actions of the step that step_wait() does."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """One step of all lanes: observations, rewards (N,) float32, which episodes have ended (N,), and infos."""
        observations, rewards, terminated, truncated, batched = self.envs.step(self._actions)
        infos = [{"ground_truth": truth, "TimeLimit.truncated": False} for truth in batched["ground_truth"]]
        done = terminated | truncated
        for lane in np.flatnonzero(done).tolist():
            self.reset_infos[lane] = {"ground_truth": infos[lane]["ground_truth"]}
            final = {name: column[lane] for name, column in batched["final_info"].items() if name[0] != "_"}
            infos[lane] = {name: value.item() if value.ndim == 0 else value for name, value in final.items()}
            infos[lane]["TimeLimit.truncated"] = bool(truncated[lane] and not terminated[lane])
            infos[lane]["terminal_observation"] = batched["final_obs"][lane]
        return observations, rewards.astype(np.float32), done, infos

    def close(self) -> None:
        """Closes the environment."""
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Each lane's picture, or None without a render mode."""
        return self.envs.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The environment's attribute, once for each lane asked for; spaces are a lane's own."""
        owner = self if attr_name in ("observation_space", "action_space") else self.envs
        return [getattr(owner, attr_name)] * len(self._lanes(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets the environment's attribute. Raises ValueError if it is to be that of some lanes only."""
        self._check_all(attr_name, indices)
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Calls the environment's method once: every lane has its result. Raises ValueError for some lanes only."""
        self._check_all(method_name, indices)
        return [getattr(self.envs, method_name)(*method_args, **method_kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Any = None) -> list[bool]:
        """No lane has a wrapper of its own."""
        return [False] * len(self._lanes(indices))

    def _lanes(self, indices: Any) -> list[int]:
        return np.arange(self.num_envs)[slice(None) if indices is None else indices].reshape(-1).tolist()

    def _check_all(self, name: str, indices: Any) -> None:
        if len(set(self._lanes(indices))) < self.num_envs:
            raise ValueError(f"{name} is the same for all lanes, and cannot be that of lanes {indices} only")
