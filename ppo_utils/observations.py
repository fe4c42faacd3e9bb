"""Observations of any environment as dicts of pictures and vectors, which is all that the networks take.

Shape letters: N environments, H, W and C of a picture, V of a vector.
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array

from memory_gym_envs.options import brief
from ppo_utils.wrappers import named, one_hot

SMALLEST_PICTURE = 36  # pixels along a side; what is smaller becomes a vector


class ObservationParts(VectorWrapper):
    """Every observation as a dict of named parts, in `final_obs` too: each a picture or a vector.

    The parts of a Dict keep their names and their order; any other observation is one part named "observation".
    Pictures are Box (H, W, C) with sides of at least 36, uint8, or float32 from 0 to 1; two-dimensional ones get a
    channel, and channels that come first go last. All else becomes a vector (V,) float32, as Gymnasium's `flatten`
    makes it: Box of any shape, Discrete and MultiDiscrete (one-hot), MultiBinary, and Tuple and Dict of these.
    Text is left out, and a line on stderr says so.

    Raises ValueError for other spaces, for pictures of other numbers, and if nothing is left to observe.
    """

    def __init__(self, env: VectorEnv):
        super().__init__(env)
        given = named(env.single_observation_space)
        texts = [name for name, space in given.items() if is_text(space)]
        if texts:
            print(f"{env.spec.id}: the text {', '.join(texts)} is left out of the observation", file=sys.stderr)
        self._convert = {name: converter(name, space) for name, space in given.items() if name not in texts}
        if not self._convert:
            raise ValueError(
                f"the observation space {brief(env.single_observation_space)} is not supported; it is all text"
            )
        parts = {name: converted_space(given[name], convert) for name, convert in self._convert.items()}
        self.single_observation_space = gym.spaces.Dict(parts, sort_keys=False)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Reset the environment, its observations in parts."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return self.parts(observations), infos

    def step(self, actions: np.ndarray) -> tuple[dict[str, np.ndarray], Any, Any, Any, dict[str, Any]]:
        """Step every lane, its observations in parts, those in `final_obs` too."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        if "final_obs" in infos:
            space, final = self.env.single_observation_space, infos["final_obs"]
            (ended,) = infos["_final_obs"].nonzero()
            last = self.parts(concatenate(space, final[ended], create_empty_array(space, len(ended))))
            for row, lane in enumerate(ended.tolist()):
                final[lane] = {name: part[row] for name, part in last.items()}
        return self.parts(observations), rewards, terminated, truncated, infos

    def parts(self, observations: Any) -> dict[str, np.ndarray]:
        """Return the parts of observations, each (N, ...); no copies of what is right already."""
        given = named(observations)
        return {name: convert(given[name]) for name, convert in self._convert.items()}


def converter(name: str, space: gym.Space) -> Callable[[Any], np.ndarray]:
    """Return what makes pictures or vectors of a batch of this part of the observations; ValueError if nothing can."""
    if isinstance(space, gym.spaces.Box):
        layout = picture_layout(space.shape)
        if layout is not None and (space.dtype == np.uint8 or (space.low.min() >= 0 and space.high.max() <= 1)):
            return partial(as_pictures, layout)
        supported = layout in (None, "HW")  # a matrix of other numbers is no picture
    else:
        supported = is_flattenable(space)
    if supported:
        return partial(as_vectors, space)
    raise ValueError(
        f"the observation space {name}: {brief(space)} is not supported; use pictures (height, width, "
        "channels) of bytes or of numbers from 0 to 1, Box, Discrete, MultiDiscrete, MultiBinary, Tuple or Dict"
    )


def converted_space(space: gym.Space, convert: Callable[[Any], np.ndarray]) -> gym.spaces.Box:
    """Return the space of what `converter` makes of one observation from this space."""
    with np.errstate(over="ignore"):  # bounds beyond float32 become infinite
        if convert.func is as_vectors:
            flat = gym.spaces.flatten_space(space)
            return gym.spaces.Box(flat.low.astype(np.float32), flat.high.astype(np.float32))
        low, high = (convert(bound[None])[0] for bound in (space.low, space.high))
        return gym.spaces.Box(low, high, dtype=low.dtype)


def picture_layout(shape: tuple[int, ...]) -> str | None:
    """Return which axes of a Box are a picture's: height, width and channels; None if it is too small to be one."""
    large = tuple(side >= SMALLEST_PICTURE for side in shape)
    layouts = {(True, True): "HW", (True, True, False): "HWC", (True, True, True): "HWC", (False, True, True): "CHW"}
    return layouts.get(large)


def as_pictures(layout: str, values: np.ndarray) -> np.ndarray:
    """Return a batch of pictures in this layout as (N, H, W, C), bytes or float32."""
    if layout == "HW":
        values = values[..., None]
    elif layout == "CHW":
        values = np.moveaxis(values, 1, -1)
    return np.ascontiguousarray(values, np.uint8 if values.dtype == np.uint8 else np.float32)


def as_vectors(space: gym.Space, values: Any) -> np.ndarray:
    """Return what Gymnasium's `flatten` makes of each of a batch of observations, (N, V) float32, all lanes at once."""
    if isinstance(space, gym.spaces.Dict):
        return np.concatenate([as_vectors(part, values[name]) for name, part in space.spaces.items()], axis=1)
    if isinstance(space, gym.spaces.Tuple):
        return np.concatenate([as_vectors(*each) for each in zip(space.spaces, values, strict=True)], axis=1)
    rows = np.reshape(values, (len(values), -1))
    if isinstance(space, gym.spaces.Discrete):
        return one_hot(rows - space.start, np.array([space.n]))
    if isinstance(space, gym.spaces.MultiDiscrete):
        return one_hot(rows - space.start.ravel(), space.nvec.ravel())
    return np.ascontiguousarray(rows, np.float32)


def is_flattenable(space: gym.Space) -> bool:
    """Return whether `as_vectors` knows the space, and what is in it."""
    if isinstance(space, (gym.spaces.Dict, gym.spaces.Tuple)):
        inside = list(named(space).values()) if isinstance(space, gym.spaces.Dict) else space.spaces
        return bool(inside) and all(map(is_flattenable, inside))
    known = gym.spaces.Box, gym.spaces.Discrete, gym.spaces.MultiDiscrete, gym.spaces.MultiBinary
    return isinstance(space, known)


def is_text(space: gym.Space) -> bool:
    """Return whether the space is of strings: Gymnasium's Text, or a package's own, such as MiniGrid's missions."""
    return space.dtype is not None and space.dtype.kind == "U"
