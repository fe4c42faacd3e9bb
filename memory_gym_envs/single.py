"""One environment: a view of a batch of one. No rules and no drawing in here."""

from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from memory_gym_envs.base import ALL, RENDER_MODES, MemoryGymVectorEnv, lane_seeds
from memory_gym_envs.mortar_mayhem import MortarMayhem
from memory_gym_envs.mystery_path import MysteryPath
from memory_gym_envs.options import brief
from memory_gym_envs.searing_spotlights import SearingSpotlights


class MemoryGymEnv(gym.Env):
    """A single environment of any id of this package; `gym.make(id)` returns the subclass for the id's family.

    Arguments: those of `MemoryGymVectorEnv` that are about one environment. variant is the id, without namespace.
    Observations, actions, rewards, options and infos are those of the id, as its family's class describes them.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 25}  # noqa: RUF012 (as Gymnasium's)
    has_ground_truth_info = True  # every info has it
    family: ClassVar[type[MemoryGymVectorEnv]]

    def __init__(
        self,
        variant: str,
        render_mode: str | None = None,
        num_levels: int | None = None,
        start_level: int = 0,
        obs_type: str = "pixels",
        options: Mapping[str, Any] | None = None,
        action_type: str = "native",
    ):
        if not hasattr(self, "family"):
            raise TypeError(f"gym.make(id) makes an environment: {type(self).__name__} lacks family")
        self.batch = self.family(
            variant, 1, render_mode, num_levels, start_level, obs_type, options, action_type=action_type
        )
        self.render_mode = render_mode
        self.metadata = {**type(self).metadata, "render_fps": self.batch.metadata["render_fps"]}
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space
        self._needs_reset = True

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts a new episode: the observation and {"ground_truth": (G,) float64}.

        seed: the level to play; None: the generator goes on (or num_levels chooses).
        options: reset parameters, for this episode alone. Whatever resets without them, as Gymnasium's vector
            environments do, goes on with those that the environment was made with.

        Raises ValueError for a wrong seed or option; nothing has changed then.
        """
        if isinstance(seed, (list, tuple, np.ndarray)):
            raise ValueError(f"seed must be an integer or None, not {brief(seed)}")
        batch = self.batch
        batch.restart(np.zeros(1, np.intp), lane_seeds(seed, 1), batch.complete_options(options))
        self._needs_reset = False
        return _only(batch.observe(ALL)), {"ground_truth": batch.ground_truth()[0]}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step. The info of an episode's last step also has its summary in plain numbers.

        action: in `action_space`, or an array of one such action, as some pass a number to the original.
        Raises ValueError for a wrong action, ResetNeeded before the first reset and after an episode's end.
        """
        if self._needs_reset:
            raise gym.error.ResetNeeded("call reset() before step(), at the start and after every episode's end")
        batch = self.batch
        lone: Any = [action]
        if isinstance(action, np.ndarray):
            lone = action if action.shape == batch.action_space.shape else action[None]
        try:
            actions = batch.checked_actions(lone)
        except ValueError:
            space = self.action_space
            raise ValueError(f"{batch.variant_id}: the action must be in {space}, not {brief(action)}") from None
        rewards, terminations, truncations = batch.advance(actions)
        terminated, truncated = bool(terminations[0]), bool(truncations[0])
        info: dict[str, Any] = {}
        if terminated or truncated:
            self._needs_reset = True
            info = {key: values[0].item() for key, values in batch.summary(np.zeros(1, np.intp)).items()}
        info["ground_truth"] = batch.ground_truth()[0]
        return _only(batch.observe(ALL)), float(rewards[0]), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """The picture that the render mode asks for, or None without one."""
        pictures = self.batch.render()
        return None if pictures is None else pictures[0]

    # What else the original's environments have.

    @property
    def ground_truth_space(self) -> gym.spaces.Box:
        """The space of the infos' ground truth."""
        return gym.spaces.Box(0.0, self.batch.truth_high, self.batch.ground_truth()[0].shape, np.float64)

    @property
    def default_reset_parameters(self) -> dict[str, Any]:
        """The reset options of an episode that is started without any."""
        return dict(self.batch.defaults)

    def oracle(self) -> dict[str, Any]:
        """The whole task in plain numbers and arrays, hidden or not, as the family's `oracle` names them."""
        numbers = self.batch.oracle()
        return {name: values[0].item() if values.ndim == 1 else values[0] for name, values in numbers.items()}

    @property
    def max_episode_steps(self) -> int:
        """The steps after which this episode is over at the latest; -1: no limit. Known before the first reset too."""
        return self.batch.longest_episode(0)

    @property
    def reset_params(self) -> dict[str, Any]:
        """The reset options of this episode, those that were not given included."""
        return dict(self.batch.settings[0])

    def get_state(self) -> dict[str, Any]:
        """The whole state in plain values, which later steps do not change: `set_state` goes on exactly from there."""
        return {"batch": self.batch.get_state(), "needs_reset": self._needs_reset}

    def set_state(self, state: dict[str, Any]) -> None:
        """Takes over a copy of what get_state() of an environment that was made with the same arguments returned.

        Raises ValueError, in one line, for any other; nothing has changed then.
        """
        before = self.batch.get_state()
        try:
            if not isinstance(state["needs_reset"], bool):
                raise ValueError(f"its needs_reset must be True or False, not {brief(state['needs_reset'])}")
            self.batch.set_state(state["batch"])
            self._needs_reset = state["needs_reset"]
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            self.batch.set_state(before)
            what = error if isinstance(error, ValueError) else brief(error)
            raise ValueError(f"this is no state of this environment, {self.batch.variant_id}: {what}") from None

    # Gymnasium keeps an environment's generator in these two names; here they are lane 0's.

    @property
    def _np_random(self) -> np.random.Generator | None:
        return self.batch.np_random[0]

    @_np_random.setter
    def _np_random(self, rng: np.random.Generator | None) -> None:
        self.batch.set_generator(0, rng)

    @property
    def _np_random_seed(self) -> int | None:
        return self.batch.np_random_seed[0]

    @_np_random_seed.setter
    def _np_random_seed(self, seed: int | None) -> None:
        self.batch._seeds[0] = seed


class MortarMayhemEnv(MemoryGymEnv):  # noqa: D101 (it has its family's docstring)
    __doc__, family = MortarMayhem.__doc__, MortarMayhem


class MysteryPathEnv(MemoryGymEnv):  # noqa: D101
    __doc__, family = MysteryPath.__doc__, MysteryPath


class SearingSpotlightsEnv(MemoryGymEnv):  # noqa: D101
    __doc__, family = SearingSpotlights.__doc__, SearingSpotlights


def register(environment: type[MemoryGymEnv], namespace: str | None = None) -> None:
    """Registers the family's ids for `gym.make` and `gym.make_vec`, with a namespace as `namespace/id`."""
    one, many = (f"{made.__module__}:{made.__name__}" for made in (environment, environment.family))
    for variant in environment.family.variants:
        name = f"{namespace}/{variant}" if namespace else variant
        gym.register(id=name, entry_point=one, vector_entry_point=many, kwargs={"variant": variant})


def _only(observations: Any) -> Any:
    if isinstance(observations, dict):
        return {key: value[0] for key, value in observations.items()}
    return observations[0]
