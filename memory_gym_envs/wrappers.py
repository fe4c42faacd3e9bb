"""Vector wrappers of the thesis' experiments: grayscale frame stacks, the step number, the spotlight perturbation.

They take any vector environment with same-step autoreset. Gymnasium's (1.2 to 1.4) own vector wrappers of observations
refuse those, and it has no frame stack for vector environments at all.
Shape letters: N lanes, n some of them, H and W of a picture, K frames of a stack, D width of an encoding.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from memory_gym_envs.base import ALL, one_of, overwrite
from memory_gym_envs.bits import pixels
from memory_gym_envs.drawing import FRAME, SCREEN
from memory_gym_envs.options import resolve
from memory_gym_envs.searing_spotlights import (
    SPEED,
    TIME,
    VARIANTS,
    SearingSpotlights,
    lamps,
    shine,
    spot_places,
)

OBSERVATION, STEP_ENCODING = "observation", "step_encoding"  # parts of a Dict that StepEncoding makes
LUMA = np.array([77, 150, 29], np.float32) / 256  # ITU-R 601, in 256ths so that all sums are exact
SPOT_STREAM = 2  # keeps the generators of the perturbation apart from those of the environment with the same seed
HEAD_START = 0.3  # of its way, that a spotlight of the perturbation has gone when an episode begins
SPAWNS = ("initial_spawns", "num_spawns", "initial_spawn_interval", "spawn_interval_threshold")
SIZES = ("spot_min_radius", "spot_max_radius", "spot_min_speed", "spot_max_speed")
LIGHTS = tuple(row for row in VARIANTS["SearingSpotlights-v0"].options if row.name in SPAWNS + SIZES)
# Without coins, exit, damage and time limit, nothing ends.
UNPLAYED = {"num_coins": [], "use_exit": False, "spot_damage": 0.0, "max_steps": -1}


class SameStepWrapper(VectorWrapper):
    """What the wrappers share: an episode ends and the next one begins, however the environment resets.

    The observation of a lane whose episode just ended is the wrapped first one of its next episode; `final_obs` holds
    the wrapped last one of the ended episode. `reset_mask` limits a reset to some lanes. Options, rewards, infos and
    pictures of render() are the environment's. Raises ValueError for an environment without same-step autoreset.
    """

    def __init__(self, env: VectorEnv):
        super().__init__(env)
        if env.metadata.get("autoreset_mode") != AutoresetMode.SAME_STEP:
            raise ValueError(f"{type(self).__name__} needs an environment with AutoresetMode.SAME_STEP, not {env}")

    # ---- what a wrapper provides ----

    def begin(self, observations: Any, lanes: np.ndarray, seeds: list[int | None]) -> None:
        """Starts new episodes in the lanes, (n,), with their first observations. seeds: one for every lane of N."""
        raise NotImplementedError

    def advance(self, observations: Any) -> None:
        """Takes in what all lanes observe after a step, before any reset."""
        raise NotImplementedError

    def wrap(self, observations: Any, lanes: np.ndarray | slice) -> Any:
        """The lanes' observations, wrapped: fresh arrays where anything differs."""
        raise NotImplementedError

    # ---- Gymnasium's interface ----

    def reset(self, *, seed: Any = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts new episodes; arguments and errors are the environment's."""
        mask = (options or {}).get("reset_mask")  # Gymnasium's own vector environments take it out
        observations, infos = self.env.reset(seed=seed, options=options)
        lanes = np.arange(self.num_envs) if mask is None else np.flatnonzero(mask)
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds = [None if seed is None else int(seed) + lane for lane in range(self.num_envs)]
        else:
            seeds = list(seed)
        self.begin(_rows(observations, lanes), lanes, seeds)
        return self.wrap(observations, ALL), infos

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of every lane, its observations wrapped, those in `final_obs` too."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        (ended,) = (terminated | truncated).nonzero()
        first = _rows(observations, ended)
        if ended.size:  # what was seen before the reset
            overwrite(observations, ended, _batched(infos["final_obs"][ended]))
        self.advance(observations)
        if ended.size:
            last = self.wrap(_rows(observations, ended), ended)
            for row, lane in enumerate(ended.tolist()):
                infos["final_obs"][lane] = one_of(last, row)
            overwrite(observations, ended, first)
            self.begin(first, ended, [None] * self.num_envs)
        return self.wrap(observations, ALL), rewards, terminated, truncated, infos

    def _set_space(self, space: gym.Space) -> None:
        self.single_observation_space, self.observation_space = space, batch_space(space, self.num_envs)


class PictureWrapper(SameStepWrapper):
    """A wrapper that changes the picture in the observation: all of it, or the only picture in a Dict.

    Raises ValueError for an observation without a (H, W, 3) uint8 picture, or with several.
    """

    def __init__(self, env: VectorEnv):
        super().__init__(env)
        space = env.single_observation_space
        parts = dict(space.spaces) if isinstance(space, gym.spaces.Dict) else {None: space}
        names = [name for name, part in parts.items() if _is_picture(part)]
        if len(names) != 1:
            raise ValueError(f"{type(self).__name__} needs one (H, W, 3) uint8 picture to observe, not {space}")
        self.part = names[0]  # of a Dict, or None
        self.picture_shape = parts[self.part].shape  # (H, W, 3)

    def picture(self, observations: Any) -> np.ndarray:
        """The pictures of the observations, (n, H, W, 3)."""
        return observations if self.part is None else observations[self.part]

    def replaced(self, whole: Any, picture: Any) -> Any:
        """Observations, or their space, with another picture."""
        return picture if self.part is None else {**whole, self.part: picture}


class GrayscaleStack(PictureWrapper):
    """The last K pictures in grayscale instead of the last one in colour (thesis 6.2.1 has K = 4 and 16).

    env: pictures may be of any size. frames: K.
    Observation: Box (H, W, K) uint8, the newest frame last; other parts of a Dict stay as they are. An episode begins
    with its first frame K times, as in the thesis' code and CleanRL's. Gray is 0.30 red + 0.59 green + 0.11 blue.

    Raises ValueError for an environment without same-step autoreset or picture, and for K below 1.
    """

    def __init__(self, env: VectorEnv, frames: int = 4):
        super().__init__(env)
        shape = (*self.picture_shape[:2], stack_size(frames))
        self._stack = np.zeros((self.num_envs, *shape), np.uint8)
        space = self.replaced(env.single_observation_space, gym.spaces.Box(0, 255, shape, np.uint8))
        self._set_space(gym.spaces.Dict(space) if isinstance(space, dict) else space)

    def begin(self, observations: Any, lanes: np.ndarray, seeds: list[int | None]) -> None:
        """Fills the lanes' stacks with their first frame."""
        self._stack[lanes] = gray(self.picture(observations))[..., None]

    def advance(self, observations: Any) -> None:
        """Puts a frame on each stack."""
        # Every entry moves one place forward. What comes in from the next pixel is where the new frame goes.
        entries = self._stack.reshape(-1)
        entries[:-1] = entries[1:]
        self._stack[..., -1] = gray(self.picture(observations))

    def wrap(self, observations: Any, lanes: np.ndarray | slice) -> Any:
        """The lanes' observations, with a copy of their stacks."""
        return self.replaced(observations, self._stack[lanes].copy())


class VectorStack(SameStepWrapper):
    """The last K vectors instead of the last one, for vector observations as `GrayscaleStack` for pictures.

    frames: K.
    Observation: Box (K * V,) float32, the newest vector last. An episode begins with its first vector K times.

    Raises ValueError for an environment without same-step autoreset or vectors (V,) as observation, and for K below 1.
    """

    def __init__(self, env: VectorEnv, frames: int = 4):
        super().__init__(env)
        space = env.single_observation_space
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"VectorStack needs a vector to observe, not {space}")
        frames = stack_size(frames)
        self._stack = np.zeros((self.num_envs, frames, *space.shape), space.dtype)
        low, high = (np.tile(bound, frames) for bound in (space.low, space.high))
        self._set_space(gym.spaces.Box(low, high, dtype=space.dtype))

    def begin(self, observations: Any, lanes: np.ndarray, seeds: list[int | None]) -> None:
        """Fills the lanes' stacks with their first vector."""
        self._stack[lanes] = observations[:, None]

    def advance(self, observations: Any) -> None:
        """Puts a vector on each stack."""
        self._stack[:, :-1] = self._stack[:, 1:]
        self._stack[:, -1] = observations

    def wrap(self, observations: Any, lanes: np.ndarray | slice) -> Any:
        """A copy of the lanes' stacks."""
        return self._stack[lanes].reshape(-1, *self.single_observation_space.shape).copy()


class StepEncoding(SameStepWrapper):
    """The number of steps since the episode began, as a sinusoidal encoding beside the observation (thesis 6.2.1).

    width: D, even; the thesis has 16. Works with any observation.
    Observation: Dict of `step_encoding`, Box (D,) float32 of (2.57) and (2.58), and the environment's own parts, or
    `observation` if it is no Dict. Position 0 is the episode's first observation; there is no last one.

    Raises ValueError for an environment without same-step autoreset or with a part of that name, and for an odd width
    or one below 2.
    """

    def __init__(self, env: VectorEnv, width: int = 16):
        super().__init__(env)
        if not isinstance(width, (int, np.integer)) or width < 2 or width % 2:
            raise ValueError(f"width must be an even integer of at least 2, not {width!r}")
        self.width, self._steps = int(width), np.zeros(self.num_envs, np.int64)
        space = env.single_observation_space
        parts = dict(space.spaces) if isinstance(space, gym.spaces.Dict) else {OBSERVATION: space}
        if STEP_ENCODING in parts:
            raise ValueError(f"the observation already has a part {STEP_ENCODING!r}: {space}")
        encoding = gym.spaces.Box(-1.0, 1.0, (self.width,), np.float32)
        self._set_space(gym.spaces.Dict({**parts, STEP_ENCODING: encoding}))

    def begin(self, observations: Any, lanes: np.ndarray, seeds: list[int | None]) -> None:
        """Sets the lanes' step numbers to 0."""
        self._steps[lanes] = 0

    def advance(self, observations: Any) -> None:
        """Counts a step."""
        self._steps += 1

    def wrap(self, observations: Any, lanes: np.ndarray | slice) -> Any:
        """The lanes' observations with their step numbers' encodings, (n, D)."""
        parts = observations if isinstance(observations, dict) else {OBSERVATION: observations}
        return {**parts, STEP_ENCODING: sinusoidal(self._steps[lanes], self.width)}


class SpotlightPerturbation(PictureWrapper):
    """A veil over the picture in which spotlights leave holes, wandering as in Searing Spotlights (thesis 7.2).

    The defaults are those of the author's code (neroRL): a white veil of opacity 120, and spotlights that have gone
    30 % of their way when an episode begins, so that the first observation is perturbed too. The light is that of a
    Searing Spotlights environment that nobody plays; it changes nothing but the picture.

    env: pictures must be 84 x 84. opacity: of the veil, of 255. shade: its gray level, 255 white, 0 black.
    lights: any of the Searing Spotlights options in LIGHTS. With the default ones no spotlight appears after step 1,200
        of an episode; a larger num_spawns has them go on.
    Observation: as before, Box (84, 84, 3) uint8 or a Dict with one.
    Each lane has a generator of its own for the spotlights, which reset(seed) seeds, apart from the environment's; it
    goes on from episode to episode.

    Raises ValueError for an environment without same-step autoreset or such a picture, and for other arguments.
    """

    def __init__(self, env: VectorEnv, opacity: int = 120, shade: int = 255, lights: Mapping[str, Any] | None = None):
        super().__init__(env)
        if self.picture_shape != (SCREEN, SCREEN, 3):
            raise ValueError(f"SpotlightPerturbation needs {SCREEN} x {SCREEN} pixels, not {self.picture_shape}")
        for name, value in (("opacity", opacity), ("shade", shade)):
            if not isinstance(value, (int, np.integer)) or not 0 <= value <= 255:
                raise ValueError(f"{name} must be an integer from 0 to 255, not {value!r}")
        self.clear, self.veil = np.uint16(255 - opacity), np.uint16(shade * opacity)
        values = resolve(LIGHTS, lights, type(self).__name__)
        self._light = SearingSpotlights("SearingSpotlights-v0", self.num_envs)
        self._settings = self._light.resolve({**values, **UNPLAYED})
        least, largest = values["spot_min_radius"], values["spot_max_radius"]
        self._radii = int(least), int(max(least, largest))

    def begin(self, observations: Any, lanes: np.ndarray, seeds: list[int | None]) -> None:
        """Draws the first spotlights of the lanes' episodes."""
        for lane in lanes.tolist():
            if seeds[lane] is not None:
                stream = np.random.SeedSequence(seeds[lane], spawn_key=(SPOT_STREAM,))
                self._light.set_generator(lane, np.random.Generator(np.random.PCG64(stream)))
        self._light.restart(lanes, [None] * self.num_envs, self._settings)
        s = self._light.state
        s.spots[TIME, lanes] = HEAD_START
        s.place[:, lanes] = spot_places(s.spots[:, lanes]).astype(np.int64) + s.spot_key[lanes]
        s.spots[TIME, lanes] += s.spots[SPEED, lanes]

    def advance(self, observations: Any) -> None:
        """Moves the spotlights on."""
        self._light.advance(np.zeros((self.num_envs, 2), np.int64))

    def wrap(self, observations: Any, lanes: np.ndarray | slice) -> Any:
        """The lanes' observations, with the veil wherever no spotlight is."""
        frames = self.picture(observations).reshape(-1, FRAME)  # (n, FRAME)
        bits, _ = shine(self._light.state, lamps(*self._radii), lanes)
        veiled = frames * self.clear
        veiled += self.veil
        veiled //= np.uint16(255)
        veiled = veiled.astype(np.uint8)
        # Where a spotlight is, the difference to the frame is taken out again: a choice by three bit operations.
        veiled ^= frames
        veiled &= ~pixels(bits)
        veiled ^= frames
        return self.replaced(observations, veiled.reshape(-1, *self.picture_shape))


def gray(frames: np.ndarray) -> np.ndarray:
    """Colour pictures (..., 3) uint8 in grayscale, (...) uint8, rounded to the nearest."""
    return (frames @ LUMA + np.float32(0.5)).astype(np.uint8)


def stack_size(frames: int) -> int:
    """The number of frames of a stack; raises ValueError unless it is an integer of at least 1."""
    if not isinstance(frames, (int, np.integer)) or frames < 1:
        raise ValueError(f"frames must be an integer of at least 1, not {frames!r}")
    return int(frames)


def sinusoidal(positions: np.ndarray, width: int) -> np.ndarray:
    """The transformer's encoding of positions (n,), (n, width) float32: (2.57) at even, (2.58) at odd places."""
    rates = 10000.0 ** -(np.arange(0, width, 2) / width)  # (width / 2,)
    angles = positions[:, None] * rates
    return np.stack([np.sin(angles), np.cos(angles)], axis=2).reshape(-1, width).astype(np.float32)


def _is_picture(space: gym.Space) -> bool:
    image = isinstance(space, gym.spaces.Box) and space.dtype == np.uint8
    return image and len(space.shape) == 3 and space.shape[2] == 3


def _rows(observations: Any, lanes: np.ndarray) -> Any:
    """Copies of the lanes' observations."""
    if isinstance(observations, dict):
        return {key: values[lanes] for key, values in observations.items()}
    return observations[lanes]


def _batched(observations: np.ndarray) -> Any:
    """Single observations, (n,) objects, as one batch."""
    if isinstance(observations[0], dict):
        return {key: np.stack([each[key] for each in observations]) for key in observations[0]}
    return np.stack(list(observations))
