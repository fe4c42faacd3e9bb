"""Observations of any environment as dicts of images and vectors, which is all that the networks take.

Shape letters: N environments, n some of them, H, W and C of an image, V of a vector.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array

from memory_gym_envs.base import lane_seeds
from memory_gym_envs.options import brief
from ppo_utils.errors import RunError
from ppo_utils.lanes import OWN, Place
from ppo_utils.terminal import tell
from ppo_utils.wrappers import MOST_ENTRIES, OBSERVATION, one_hot, rows_of

SMALLEST_IMAGE = 36  # pixels along a side; what is smaller becomes a vector
WIDEST_RANGE = 2**16  # of an image's numbers
LARGEST_ENTRY = 1e18  # of a vector: the squares of larger ones, which networks and losses compute, overflow float32
WRITABLE = ("C_CONTIGUOUS", "WRITEABLE")  # wrappers overwrite observations in place
INFOS = (OWN, "ground_truth", "_ground_truth", "final_obs", "_final_obs", "final_info", "_final_info")


class ObservationParts(VectorWrapper):
    """Every observation as a dict of named parts, in `final_obs` too: each an image or a vector.

    Dicts and Tuples, at any depth, are taken apart; a part's name is the keys that lead to it, joined by dots. An
    observation that is neither is one part named "observation". Text is left out, and a line on stderr says so.

    first_lane: number of the first environment, for error messages.

    Raises ValueError for spaces that are not supported (see `Part.of`), and if nothing is left to observe. Where an
    environment observes NaN, infinity or what its space does not hold, or earns such a reward, step and reset raise
    RunError with one line that says which environment, part and step it was; the bounds of vectors are not checked. Of
    infos, only what a training reads is kept.
    """

    def __init__(self, env: VectorEnv, first_lane: int = 0):
        super().__init__(env)
        space = env.single_observation_space
        leaves = dict(leaves_of(space)) if isinstance(space, CONTAINERS) else {(OBSERVATION,): space}
        texts = [name_of(path) for path, leaf in leaves.items() if is_text(leaf)]
        if texts:
            tell(f"{env.spec.id}: the text {', '.join(texts)} is left out of the observation")
        self._parts = {name_of(path): Part.of(path, leaf) for path, leaf in leaves.items() if not is_text(leaf)}
        if not self._parts:
            raise ValueError(f"the observation space {brief(space)} is not supported; it is all text")
        if len(self._parts) + len(texts) < len(leaves):
            raise ValueError(f"the observation space {brief(space)} is not supported; two parts have the same name")
        spaces = {name: part.space() for name, part in self._parts.items()}
        self.single_observation_space = gym.spaces.Dict(spaces, sort_keys=False)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._first_lane, self._seeds, self._steps = first_lane, [None] * self.num_envs, 0

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Reset the environment, its observations in parts."""
        if seed is not None:
            self._seeds, self._steps = lane_seeds(seed, self.num_envs), 0
        # A copy: Gymnasium's vector environments take reset_mask out of it, which wrappers outside read afterwards.
        observations, infos = self.env.reset(seed=seed, options=options and {**options})
        return self._convert(observations, infos), {name: infos[name] for name in INFOS if name in infos}

    def step(self, actions: np.ndarray) -> tuple[dict[str, np.ndarray], Any, Any, Any, dict[str, Any]]:
        """Step every lane, its observations in parts, those in `final_obs` too."""
        self._steps += 1
        observations, rewards, *ends, infos = self.env.step(actions)
        terminated, truncated = (np.asarray(each, bool) for each in ends)
        done = terminated | truncated
        with np.errstate(over="ignore"):
            finite_rewards = np.isfinite(np.asarray(rewards, np.float32))  # as the training keeps them
        if not finite_rewards.all():
            lane = int(np.flatnonzero(~finite_rewards)[0])
            raise self._error(lane, f"the reward is {rewards[lane]}", infos.get("final_info") if done[lane] else infos)
        infos = {name: infos[name] for name in INFOS if name in infos}
        ended = np.flatnonzero(done)
        if ended.size:
            last = self._convert(self._final(infos, ended), infos.get("final_info"), ended)
            infos["final_obs"], infos["_final_obs"] = np.full(self.num_envs, None), done
            for row, lane in enumerate(ended.tolist()):
                infos["final_obs"][lane] = {name: part[row] for name, part in last.items()}
        return self._convert(observations, infos), rewards, terminated, truncated, infos

    def _final(self, infos: dict[str, Any], ended: np.ndarray) -> Any:
        """Return the last observations of ended episodes, (n,) lanes, as one batch."""
        space, final = self.env.single_observation_space, infos.get("final_obs")
        if final is None:
            raise self._error(int(ended[0]), "an episode ended, and infos have no final_obs", infos)
        if isinstance(final, np.ndarray) and final.dtype == object:  # as Gymnasium has it: an observation for each lane
            return concatenate(space, final[ended], create_empty_array(space, len(ended)))
        return rows_of(final, ended)  # one batch for all lanes

    def _convert(self, observations: Any, infos: Any, lanes: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Return the parts of observations, each (N, ...); no copies of what is right already."""
        parts = {}
        for name, part in self._parts.items():
            try:
                parts[name] = part.convert(observations)
            except WrongValue as error:
                row, what = error.args
                raise self._error(row if lanes is None else int(lanes[row]), f"{name} {what}", infos) from None
        return parts

    def _error(self, lane: int, what: str, infos: Any) -> RunError:
        place = Place(self._first_lane + lane, self._seeds[lane], self._steps)
        if isinstance(infos, dict) and OWN in infos:  # a Lane, which may have been reset with seeds of its own
            _, place = infos[OWN][lane]
        return RunError(f"{self.env.spec.id}: {what} ({place})")


class WrongValue(Exception):
    """An observation is not what its space says: the row of a batch, and what is wrong with it."""


@dataclass
class Part:
    """A part of the observation that is an image or a vector: where it is, and how it is made."""

    path: tuple[str | int, ...]  # the keys that lead to it
    leaf: gym.Space  # of the environment
    axes: tuple[int, int] | None = None  # height and width, if it is an image
    bounds: tuple[float, float] = (0, 1)  # of an image's numbers

    @classmethod
    def of(cls, path: tuple[str | int, ...], leaf: gym.Space) -> "Part":
        """Say what becomes of a space that is no Dict or Tuple.

        A Box with bounds and two neighbouring axes of at least 36 is an image (H, W, C), with all other axes as
        channels: uint8 if these are bytes from 0 to 255, else float32, scaled from its bounds to 0 to 1. Bounds further
        apart than 16 bits, such as the largest numbers of a type, are none: what is between would be one gray. All else
        is a vector (V,) float32, as Gymnasium's `flatten` makes it: Box, Discrete and MultiDiscrete (one-hot),
        MultiBinary.

        Raises ValueError for other spaces, and for an image without bounds.
        """
        if isinstance(leaf, gym.spaces.Box):
            axes = image_axes(leaf.shape)
            if axes is None:
                return cls(path, leaf)
            bounds = float(leaf.low.min()), float(leaf.high.max())
            if bounds[1] - bounds[0] < WIDEST_RANGE:  # NaN and infinity are not
                return cls(path, leaf, axes, bounds)
            if len(leaf.shape) == 2:  # a matrix
                return cls(path, leaf)
        elif isinstance(leaf, (gym.spaces.Discrete, gym.spaces.MultiDiscrete, gym.spaces.MultiBinary)):
            if (entries := gym.spaces.flatdim(leaf)) > MOST_ENTRIES:
                raise ValueError(
                    f"the observation space {name_of(path)}: {brief(leaf)} is not supported; one-hot it would have "
                    f"{entries:,} entries, above {MOST_ENTRIES:,}; observe the number in a Box"
                )
            return cls(path, leaf)
        raise ValueError(
            f"the observation space {name_of(path)}: {brief(leaf)} is not supported; use images (height, width, "
            "channels) with bounds at most 65,535 apart, Box, Discrete, MultiDiscrete, MultiBinary, and Tuple or Dict "
            "of these"
        )

    def space(self) -> gym.spaces.Box:
        """Return the space of what `convert` returns for one environment."""
        if self.axes is None:
            flat = gym.spaces.flatten_space(self.leaf)
            with np.errstate(over="ignore"):  # bounds beyond float32 become infinite
                return gym.spaces.Box(flat.low.astype(np.float32), flat.high.astype(np.float32))
        shape = self._as_image(self.leaf.low[None]).shape[1:]
        return gym.spaces.Box(0, 255, shape, np.uint8) if self._is_bytes else gym.spaces.Box(0, 1, shape, np.float32)

    @property
    def _is_bytes(self) -> bool:
        return self.leaf.dtype == np.uint8 and self.bounds == (0, 255)

    def convert(self, observations: Any) -> np.ndarray:
        """Take this part out of a batch of observations: (n, H, W, C) uint8 or float32, or (n, V) float32.

        Raises WrongValue for NaN, infinity, and numbers that are outside of an image's bounds or that a Discrete,
        MultiDiscrete or MultiBinary space does not have.
        """
        values = observations
        if self.path != (OBSERVATION,) or isinstance(observations, (dict, tuple)):
            for key in self.path:
                values = values[key]
        if self.axes is not None:
            values = self._as_image(np.asarray(values))
            if self._is_bytes:
                if values.dtype != np.uint8:  # larger numbers would wrap around
                    within(values, 0, 255)
                return np.require(values, np.uint8, WRITABLE)
            low, high = self.bounds
            within(finite(values), low, high)
            scaled = np.subtract(values, low, dtype=np.result_type(values, np.float32)) / ((high - low) or 1.0)
            return np.require(scaled, np.float32, WRITABLE)
        rows = np.reshape(values, (len(values), -1))
        if isinstance(self.leaf, (gym.spaces.Discrete, gym.spaces.MultiDiscrete)):
            first = np.ravel(self.leaf.start).astype(np.int64)
            sizes = np.ravel(self.leaf.n if isinstance(self.leaf, gym.spaces.Discrete) else self.leaf.nvec)
            sizes = sizes.astype(np.int64)
            within(rows, first, first + sizes - 1)
            return one_hot(rows - first, sizes)
        if isinstance(self.leaf, gym.spaces.MultiBinary):
            within(rows, 0, 1)
        with np.errstate(over="ignore"):
            rows = finite(np.require(rows, np.float32, WRITABLE))
        large = np.abs(rows) > LARGEST_ENTRY
        if large.any():
            index = tuple(np.argwhere(large)[0].tolist())
            raise WrongValue(index[0], f"has an entry {rows[index]:g}; networks take none beyond {LARGEST_ENTRY:g}")
        return rows

    def _as_image(self, values: np.ndarray) -> np.ndarray:
        """Move height and width of (n, ...) to the front, and join all other axes as channels: (n, H, W, C)."""
        height, width = self.axes
        moved = np.moveaxis(values, (height + 1, width + 1), (1, 2))
        return moved.reshape(*moved.shape[:3], -1)


CONTAINERS = (gym.spaces.Dict, gym.spaces.Tuple)


def leaves_of(space: gym.Space, path: tuple = ()) -> Iterator[tuple[tuple[str | int, ...], gym.Space]]:
    """Yield the spaces inside Dicts and Tuples, in their order, each with the keys that lead to it."""
    if isinstance(space, CONTAINERS):
        inside = space.spaces if isinstance(space, gym.spaces.Dict) else dict(enumerate(space.spaces))
        for key, each in inside.items():
            yield from leaves_of(each, (*path, key))
    else:
        yield path, space


def name_of(path: tuple[str | int, ...]) -> str:
    """Return a part's name."""
    return ".".join(map(str, path))


def image_axes(shape: tuple[int, ...]) -> tuple[int, int] | None:
    """Return which axes are height and width, two neighbours of at least 36 pixels; None if there are none.

    A third large axis counts as channels if it comes last.
    """
    large = [axis for axis, side in enumerate(shape) if side >= SMALLEST_IMAGE]
    if len(shape) == len(large) == 3:
        large.pop()
    return tuple(large) if len(large) == 2 and len(shape) <= 4 and large[1] - large[0] == 1 else None


def finite(values: np.ndarray) -> np.ndarray:
    """Return values (n, ...); raise WrongValue if one is NaN or infinite."""
    if not np.isfinite(values).all():
        index = tuple(np.argwhere(~np.isfinite(values))[0].tolist())
        raise WrongValue(index[0], f"has an entry {values[index]}")
    return values


def within(values: np.ndarray, low: np.ndarray | float, high: np.ndarray | float) -> None:
    """Raise WrongValue if one of the values (n, ...) is below low or above high, numbers or of a row's shape."""
    wrong = (values < low) | (values > high)
    if wrong.any():
        index = tuple(np.argwhere(wrong)[0].tolist())
        low, high = (np.broadcast_to(bound, values.shape)[index] for bound in (low, high))
        raise WrongValue(index[0], f"is {values[index]}, outside of {low} to {high}")


def is_text(space: gym.Space) -> bool:
    """Return whether the space is of strings: Gymnasium's Text, or a package's own, such as MiniGrid's missions."""
    return space.dtype is not None and space.dtype.kind == "U"
