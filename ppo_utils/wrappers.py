"""Vector wrappers of observations: frame stacks, lists, the step, the last action, Fourier features, a perturbation.

They take any vector environment with same-step autoreset. Gymnasium's (1.4) own vector wrappers of observations refuse
those, and it has no frame stack for vector environments at all.
Shape letters: N lanes, n some of them, H and W of an image, K frames of a stack, D width of an encoding, V of a
vector, F frequencies, A action branches.
"""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from memory_gym_envs.base import ALL, checked_integer, lane_seeds, one_of, overwrite
from memory_gym_envs.bits import pixels
from memory_gym_envs.drawing import FRAME, SCREEN, gray
from memory_gym_envs.mortar_mayhem import VARIANTS as MORTAR_MAYHEM
from memory_gym_envs.mortar_mayhem.options import VECTOR_COMMANDS
from memory_gym_envs.options import brief, complete_options
from memory_gym_envs.saving import Saved
from memory_gym_envs.searing_spotlights import VARIANTS, SearingSpotlights
from memory_gym_envs.searing_spotlights.drawing import light_masks, spot_stencils
from memory_gym_envs.searing_spotlights.rules import spot_positions
from memory_gym_envs.searing_spotlights.state import SPEED, TIME
from ppo_utils.scores import bare_id

OBSERVATION = "observation"  # the name of an observation that is no Dict, where it becomes a part of one
COMMANDS, STEP_ENCODING, LAST_ACTION = "commands", "step_encoding", "last_action"  # parts that the wrappers add
SINES, COSINES = "sines", "cosines"
MOST_ENTRIES = 2**24  # of a one-hot vector: the weights of a layer of 128 that takes it are 8 GB
SPOT_STREAM = 2  # keeps the generators of the perturbation apart from those of the environment with the same seed
HEAD_START = 0.3  # of its way, that a spotlight of the perturbation has gone when an episode begins
SPAWNS = ("initial_spawns", "num_spawns", "initial_spawn_interval", "spawn_interval_threshold")
SIZES = ("spot_min_radius", "spot_max_radius", "spot_min_speed", "spot_max_speed")
LIGHTS = tuple(row for row in VARIANTS["SearingSpotlights-v0"].options if row.name in SPAWNS + SIZES)
# Without coins, exit, damage and time limit, nothing ends.
UNPLAYED = {"num_coins": [], "use_exit": False, "spot_damage": 0.0, "max_steps": -1}


class SameStepWrapper(Saved, VectorWrapper):
    """What the wrappers share: an episode ends and the next one begins, however the environment resets.

    The observation of a lane whose episode just ended is the wrapped first one of its next episode; `final_obs` holds
    the wrapped last one of the ended episode. `reset_mask` limits a reset to some lanes. Options, rewards, infos and
    images of render() are the environment's. Raises ValueError for an environment without same-step autoreset, and for
    observations that are neither arrays nor a Dict of these.
    """

    def __init__(self, env: VectorEnv):
        super().__init__(env)
        if env.metadata.get("autoreset_mode") != AutoresetMode.SAME_STEP:
            raise ValueError(f"{type(self).__name__} needs an environment with AutoresetMode.SAME_STEP, not {env}")
        arrays = (gym.spaces.Box, gym.spaces.Discrete, gym.spaces.MultiDiscrete, gym.spaces.MultiBinary)
        space = env.single_observation_space
        if not all(isinstance(part, arrays) for part in named(space).values()):
            raise ValueError(f"{type(self).__name__} needs arrays to observe, or a Dict of them, not {brief(space)}")

    # ---- what a wrapper provides: `wrap`, and the other two if it remembers something ----

    def begin(self, observations: Any, lanes: np.ndarray, seeds: list[int | None]) -> None:
        """Start new episodes in the lanes, (n,), with their first observations. seeds: one for every lane of N."""

    def advance(self, observations: Any, actions: np.ndarray, rewards: np.ndarray) -> None:
        """Take in a step of all lanes and what they observe after it, before any reset."""

    def wrap(self, observations: Any, lanes: np.ndarray | slice) -> Any:
        """Return the lanes' observations, wrapped: fresh arrays where anything differs."""
        raise NotImplementedError

    # ---- Gymnasium's interface ----

    def reset(self, *, seed: Any = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start new episodes; arguments and errors are the environment's."""
        # Read before, since Gymnasium's own vector environments take it out.
        mask = options.get("reset_mask") if isinstance(options, Mapping) else None
        seeds = lane_seeds(seed, self.num_envs)
        observations, infos = self.env.reset(seed=seed, options=options)
        lanes = np.arange(self.num_envs) if mask is None else np.flatnonzero(mask)
        self.begin(rows_of(observations, lanes), lanes, seeds)
        return self.wrap(observations, ALL), infos

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step every lane, its observations wrapped, those in `final_obs` too."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        (ended,) = (terminated | truncated).nonzero()
        first = rows_of(observations, ended)
        if ended.size:  # what was seen before the reset
            overwrite(observations, ended, _batched(infos["final_obs"][ended]))
        self.advance(observations, np.asarray(actions), rewards)
        if ended.size:
            last = self.wrap(rows_of(observations, ended), ended)
            for row, lane in enumerate(ended.tolist()):
                infos["final_obs"][lane] = one_of(last, row)
            overwrite(observations, ended, first)
            self.begin(first, ended, [None] * self.num_envs)
        return self.wrap(observations, ALL), rewards, terminated, truncated, infos

    def _set_space(self, space: gym.Space) -> None:
        self.single_observation_space, self.observation_space = space, batch_space(space, self.num_envs)

    def _add_part(self, name: str, part: gym.spaces.Box) -> None:
        """Make the space a Dict of the environment's own parts and this one."""
        space = self.env.single_observation_space
        if name in named(space):
            raise ValueError(f"the observation already has a part {name!r}: {space}")
        self._set_space(gym.spaces.Dict({**named(space), name: part}))


class ImageWrapper(SameStepWrapper):
    """A wrapper that changes the image in the observation: all of it, or the only image in a Dict.

    channels: how many an image may have.

    Raises ValueError for an observation without such a (H, W, channels) uint8 image, or with several.
    """

    channels: ClassVar[tuple[int, ...]] = (3,)

    def __init__(self, env: VectorEnv):
        super().__init__(env)
        space = env.single_observation_space
        parts = named(space)
        names = [name for name, part in parts.items() if self._is_image(part)]
        if len(names) != 1:
            shape = f"(H, W, {' or '.join(map(str, self.channels))})"
            raise ValueError(f"{type(self).__name__} needs one {shape} uint8 image to observe, not {space}")
        self.part = names[0]
        self.image_shape = parts[self.part].shape  # (H, W, channels)

    def image(self, observations: Any) -> np.ndarray:
        """Return the images of the observations, (n, H, W, channels)."""
        return named(observations)[self.part]

    def replaced(self, whole: Any, image: Any) -> Any:
        """Return observations, or their space, with another image."""
        return {**named(whole), self.part: image} if isinstance(whole, (dict, gym.spaces.Dict)) else image

    def _is_image(self, space: gym.Space) -> bool:
        image = isinstance(space, gym.spaces.Box) and space.dtype == np.uint8
        return image and len(space.shape) == 3 and space.shape[2] in self.channels


class GrayscaleStack(ImageWrapper):
    """The last K images in grayscale instead of the last one in colour (thesis 6.2.1 has K = 4 and 16).

    env: images may be of any size, and gray already (H, W, 1). frames: K.
    Observation: Box (H, W, K) uint8, the newest frame last; other parts of a Dict stay as they are. An episode begins
    with its first frame K times, as in the thesis' code and CleanRL's. Gray is 0.30 red + 0.59 green + 0.11 blue.

    Raises ValueError for an environment without same-step autoreset or image, and for K below 1.
    """

    channels = (1, 3)
    kept = ("_stack",)

    def __init__(self, env: VectorEnv, frames: int = 4):
        super().__init__(env)
        shape = (*self.image_shape[:2], checked_integer("frames", frames, 1))
        self.arguments = {"frames": shape[-1]}
        self._stack = np.zeros((self.num_envs, *shape), np.uint8)
        space = self.replaced(env.single_observation_space, gym.spaces.Box(0, 255, shape, np.uint8))
        self._set_space(gym.spaces.Dict(space) if isinstance(space, dict) else space)

    def begin(self, observations: Any, lanes: np.ndarray, seeds: list[int | None]) -> None:
        """Fill the lanes' stacks with their first frame."""
        self._stack[lanes] = gray(self.image(observations))[..., None]

    def advance(self, observations: Any, actions: np.ndarray, rewards: np.ndarray) -> None:
        """Put a frame on each stack."""
        # Every entry moves one place forward. What comes in from the next pixel is where the new frame goes.
        entries = self._stack.reshape(-1)
        entries[:-1] = entries[1:]
        self._stack[..., -1] = gray(self.image(observations))

    def wrap(self, observations: Any, lanes: np.ndarray | slice) -> Any:
        """Return the lanes' observations, with a copy of their stacks."""
        return self.replaced(observations, self._stack[lanes].copy())


class CommandList(SameStepWrapper):
    """The commands of Mortar Mayhem's act tasks as a list, apart from other entries of the vector that they are in.

    Observation: Dict of `commands`, Box (20, 9) float32, and all else, that vector without them.

    Raises ValueError for an environment without same-step autoreset or without such a vector.
    """

    def __init__(self, env: VectorEnv):
        super().__init__(env)
        parts = {**named(env.single_observation_space)}
        self._part = next((name for name in (OBSERVATION, "vector_observation") if name in parts), None)
        commands = gym.spaces.Box(0.0, 1.0, (VECTOR_COMMANDS, 9), np.float32)
        vector = parts.pop(self._part, None)
        if not is_act_task(env) or vector is None or vector.shape[0] < math.prod(commands.shape):
            raise ValueError(f"CommandList needs what an act task of Mortar Mayhem observes, not {env}")
        self._others = vector.shape[0] - math.prod(commands.shape)  # number of entries before the commands
        if self._others:
            low, high = vector.low[: self._others], vector.high[: self._others]
            parts[self._part] = gym.spaces.Box(low, high, dtype=vector.dtype)
        self._set_space(gym.spaces.Dict({**parts, COMMANDS: commands}))

    def wrap(self, observations: Any, lanes: np.ndarray | slice) -> Any:
        """Return the lanes' observations, their commands apart."""
        parts = {**named(observations)}
        vectors = parts.pop(self._part)
        if self._others:
            parts[self._part] = vectors[:, : self._others].copy()
        return {**parts, COMMANDS: vectors[:, self._others :].reshape(-1, VECTOR_COMMANDS, 9).copy()}


class VectorStack(SameStepWrapper):
    """The last K vectors instead of the last one, for vector observations as `GrayscaleStack` for images.

    frames: K. Of a Dict, each vector is stacked by itself; other parts stay as they are.
    Observation: Box (K * V,), the newest vector last, or a Dict of such. An episode begins with its first vector K
    times.

    Raises ValueError for an environment without same-step autoreset or without a vector (V,), and for K below 1.
    """

    kept = ("_stacks",)

    def __init__(self, env: VectorEnv, frames: int = 4):
        super().__init__(env)
        space, frames = env.single_observation_space, checked_integer("frames", frames, 1)
        self.arguments = {"frames": frames}
        parts = {**named(space)}
        vectors = {k: part for k, part in parts.items() if isinstance(part, gym.spaces.Box) and len(part.shape) == 1}
        if not vectors:
            raise ValueError(f"VectorStack needs a vector to observe, or a Dict with one, not {space}")
        self._stacks = {k: np.zeros((self.num_envs, frames, *part.shape), part.dtype) for k, part in vectors.items()}
        for name, part in vectors.items():
            low, high = (np.tile(bound, frames) for bound in (part.low, part.high))
            parts[name] = gym.spaces.Box(low, high, dtype=part.dtype)
        self._set_space(gym.spaces.Dict(parts) if isinstance(space, gym.spaces.Dict) else parts[OBSERVATION])

    def begin(self, observations: Any, lanes: np.ndarray, seeds: list[int | None]) -> None:
        """Fill the lanes' stacks with their first vector."""
        for name, stack in self._stacks.items():
            stack[lanes] = named(observations)[name][:, None]

    def advance(self, observations: Any, actions: np.ndarray, rewards: np.ndarray) -> None:
        """Put a vector on each stack."""
        for name, stack in self._stacks.items():
            stack[:, :-1] = stack[:, 1:]
            stack[:, -1] = named(observations)[name]

    def wrap(self, observations: Any, lanes: np.ndarray | slice) -> Any:
        """Return the lanes' observations with a copy of their stacks."""
        stacks = {name: np.array(each[lanes]) for name, each in self._stacks.items()}  # (n, K, V)
        flat = {name: each.reshape(len(each), -1) for name, each in stacks.items()}  # (n, K * V)
        return {**observations, **flat} if isinstance(observations, dict) else flat[OBSERVATION]


class StepEncoding(SameStepWrapper):
    """The number of steps since the episode began, as a sinusoidal encoding beside the observation (thesis 6.2.1).

    width: D, even; the thesis has 16. Works with any arrays.
    Observation: Dict of `step_encoding`, Box (D,) float32 of (2.57) and (2.58), and the environment's own parts, or
    `observation` if it is no Dict. Position 0 is the episode's first observation; there is no last one.

    Raises ValueError for an environment without same-step autoreset or with a part of that name, and for an odd width
    or one below 2.
    """

    kept = ("_steps",)

    def __init__(self, env: VectorEnv, width: int = 16):
        super().__init__(env)
        if not isinstance(width, (int, np.integer)) or width < 2 or width % 2:
            raise ValueError(f"width must be an even integer of at least 2, not {width!r}")
        self.width, self._steps = int(width), np.zeros(self.num_envs, np.int64)
        self.arguments = {"width": self.width}
        self._add_part(STEP_ENCODING, gym.spaces.Box(-1.0, 1.0, (self.width,), np.float32))

    def begin(self, observations: Any, lanes: np.ndarray, seeds: list[int | None]) -> None:
        """Set the lanes' step numbers to 0."""
        self._steps[lanes] = 0

    def advance(self, observations: Any, actions: np.ndarray, rewards: np.ndarray) -> None:
        """Count a step."""
        self._steps += 1

    def wrap(self, observations: Any, lanes: np.ndarray | slice) -> Any:
        """Return the lanes' observations with their step numbers' encodings, (n, D)."""
        return {**named(observations), STEP_ENCODING: sinusoidal(self._steps[lanes], self.width)}


class LastAction(SameStepWrapper):
    """The action and the reward of the step before, beside the observation.

    Works with any arrays, and with Discrete and one-dimensional MultiDiscrete actions.
    Observation: Dict of `last_action`, Box (V,) float32, and the environment's own parts, or `observation` if it is no
    Dict. The vector is the action one-hot, branch after branch, then the reward; zeros at an episode's beginning.

    Raises ValueError for an environment without same-step autoreset, with other actions or with a part of that name.
    """

    kept = ("_last",)

    def __init__(self, env: VectorEnv):
        super().__init__(env)
        self._branches = branch_sizes(env.single_action_space)
        width = int(self._branches.sum()) + 1
        self._last = np.zeros((self.num_envs, width), np.float32)
        low, high = np.zeros(width, np.float32), np.ones(width, np.float32)
        low[-1], high[-1] = -np.inf, np.inf
        self._add_part(LAST_ACTION, gym.spaces.Box(low, high, dtype=np.float32))

    def begin(self, observations: Any, lanes: np.ndarray, seeds: list[int | None]) -> None:
        """Forget the lanes' actions."""
        self._last[lanes] = 0.0

    def advance(self, observations: Any, actions: np.ndarray, rewards: np.ndarray) -> None:
        """Keep the step's action and reward."""
        choices = actions.reshape(self.num_envs, -1) - self.env.single_action_space.start  # (N, A)
        self._last[:, :-1] = one_hot(choices, self._branches)
        self._last[:, -1] = rewards

    def wrap(self, observations: Any, lanes: np.ndarray | slice) -> Any:
        """Return the lanes' observations with a copy of their last actions."""
        return {**named(observations), LAST_ACTION: np.array(self._last[lanes])}


class FourierFeatures(SameStepWrapper):
    """Sines and cosines of all vectors, whose entries should lie between 0 and 1, at pi, 2 pi, 4 pi ... beside them.

    They magnify small differences, so that a network learns sooner to tell values apart (Tancik et al., 2020).

    frequencies: F.
    Observation: Dict of the environment's own parts, or `observation` if it is no Dict, then `sines` and `cosines`, Box
    (V F,) float32 each, V entries of all vectors together.

    Raises ValueError for an environment without same-step autoreset or vector, or with parts of these names.
    """

    def __init__(self, env: VectorEnv, frequencies: int):
        super().__init__(env)
        self.arguments = {"frequencies": frequencies}
        self._angles = np.float32(math.pi) * 2.0 ** np.arange(frequencies, dtype=np.float32)  # (F,) of an entry of 1
        parts = named(env.single_observation_space)
        self._vectors = [name for name, part in parts.items() if len(part.shape) == 1]
        if not self._vectors:
            raise ValueError(f"FourierFeatures needs an observation with a vector, not with {', '.join(parts)} alone")
        if taken := {SINES, COSINES} & parts.keys():
            raise ValueError(
                f"FourierFeatures adds {SINES} and {COSINES}, but the observation has {min(taken)} already"
            )
        entries = sum(parts[name].shape[0] for name in self._vectors)
        features = gym.spaces.Box(-1.0, 1.0, (entries * frequencies,), np.float32)
        self._set_space(gym.spaces.Dict({**parts, SINES: features, COSINES: features}, sort_keys=False))

    def wrap(self, observations: Any, lanes: np.ndarray | slice) -> Any:
        """Return the lanes' observations with the features of their vectors."""
        vectors = np.concatenate([named(observations)[name] for name in self._vectors], axis=1, dtype=np.float32)
        angles = (vectors[..., None] * self._angles).reshape(len(vectors), -1)  # (n, V F)
        return {**named(observations), SINES: np.sin(angles), COSINES: np.cos(angles)}


class SpotlightPerturbation(ImageWrapper):
    """A translucent layer over the image with moving holes, the spotlights of Searing Spotlights (thesis 7.2).

    The defaults are those of the author's code (neroRL): a white layer of opacity 120, and spotlights that have gone
    30 % of their way when an episode begins, so that the first observation is perturbed too. A Searing Spotlights
    environment, which gets no actions from the agent, computes them; they change nothing but the image.

    env: images must be 84 x 84. opacity: of the veil, of 255. shade: its gray level, 255 white, 0 black.
    lights: any of the Searing Spotlights options in LIGHTS. With the default ones no spotlight appears after step 1,200
        of an episode; a larger num_spawns has them go on.
    Observation: as before, Box (84, 84, 3) uint8 or a Dict with one.
    Each lane has a generator of its own for the spotlights, which reset(seed) seeds, apart from the environment's; it
    goes on from episode to episode.

    Raises ValueError for an environment without same-step autoreset or such an image, and for other arguments.
    """

    def __init__(self, env: VectorEnv, opacity: int = 120, shade: int = 255, lights: Mapping[str, Any] | None = None):
        super().__init__(env)
        if self.image_shape != (SCREEN, SCREEN, 3):
            raise ValueError(f"SpotlightPerturbation needs {SCREEN} x {SCREEN} pixels, not {self.image_shape}")
        opacity, shade = checked_integer("opacity", opacity, 0, 255), checked_integer("shade", shade, 0, 255)
        self.clear, self.veil = np.uint16(255 - opacity), np.uint16(shade * opacity)
        values = complete_options(LIGHTS, lights, type(self).__name__)
        self.arguments = {"opacity": opacity, "shade": shade, **values}
        self._light = SearingSpotlights("SearingSpotlights-v0", self.num_envs)
        self._settings = self._light.complete_options({**values, **UNPLAYED})
        least, largest = values["spot_min_radius"], values["spot_max_radius"]
        self._radii = int(least), int(max(least, largest))

    def get_state(self) -> dict[str, Any]:
        """Return the state of the light in plain values: its spotlights, and the lanes' generators for them."""
        return self._light.get_state()

    def set_state(self, state: dict[str, Any]) -> None:
        """Take over a copy of what get_state() returned."""
        self._light.set_state(state)

    def begin(self, observations: Any, lanes: np.ndarray, seeds: list[int | None]) -> None:
        """Sample the first spotlights of the lanes' episodes."""
        for lane in lanes.tolist():
            if seeds[lane] is not None:
                stream = np.random.SeedSequence(seeds[lane], spawn_key=(SPOT_STREAM,))
                self._light.set_generator(lane, np.random.Generator(np.random.PCG64(stream)))
        self._light.restart(lanes, [None] * self.num_envs, self._settings)
        s = self._light.state
        s.spots[TIME, lanes] = HEAD_START
        s.spot_place[:, lanes] = spot_positions(s.spots[:, lanes]).astype(np.int64) + s.spot_key[lanes]
        s.spots[TIME, lanes] += s.spots[SPEED, lanes]

    def advance(self, observations: Any, actions: np.ndarray, rewards: np.ndarray) -> None:
        """Move the spotlights on."""
        self._light.advance(np.zeros((self.num_envs, 2), np.int64))

    def wrap(self, observations: Any, lanes: np.ndarray | slice) -> Any:
        """Return the lanes' observations, with the veil wherever no spotlight is."""
        frames = self.image(observations).reshape(-1, FRAME)  # (n, FRAME)
        bits, _ = light_masks(self._light.state, spot_stencils(*self._radii), lanes)
        veiled = frames * self.clear
        veiled += self.veil
        veiled //= np.uint16(255)
        veiled = veiled.astype(np.uint8)
        # Where a spotlight is, the difference to the frame is taken out again: a choice by three bit operations.
        veiled ^= frames
        veiled &= ~pixels(bits)
        veiled ^= frames
        return self.replaced(observations, veiled.reshape(-1, *self.image_shape))


def named(observation: Any) -> dict[str, Any]:
    """Return an observation, or its space, as parts by name: those of a dict, or its only one."""
    if isinstance(observation, gym.spaces.Dict):
        return observation.spaces
    return observation if isinstance(observation, dict) else {OBSERVATION: observation}


def branch_sizes(space: gym.Space) -> np.ndarray:
    """Return the number of actions of each branch, (A,); raise ValueError unless Discrete or MultiDiscrete."""
    if isinstance(space, gym.spaces.Discrete):
        sizes = np.array([space.n])
    elif isinstance(space, gym.spaces.MultiDiscrete) and space.nvec.ndim == 1 and space.nvec.size:
        sizes = space.nvec
    else:
        kinds = "Discrete or one-dimensional MultiDiscrete"
        raise ValueError(f"the action space {brief(space)} is not supported; use {kinds}")
    if sum(sizes.tolist()) > MOST_ENTRIES:
        raise ValueError(f"the action space {brief(space)} is not supported; it has more than {MOST_ENTRIES:,} actions")
    return sizes


def one_hot(choices: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return choices (n, A) from 0 to sizes - 1, each one-hot, side by side: (n, sum of the sizes) float32."""
    found = np.zeros((len(choices), sizes.sum()), np.float32)
    found[np.arange(len(choices))[:, None], choices + (np.cumsum(sizes) - sizes)] = 1.0
    return found


def sinusoidal(positions: np.ndarray, width: int) -> np.ndarray:
    """Return the transformer's encoding of positions (n,), (n, width) float32: (2.57) at even, (2.58) at odd places."""
    rates = 10000.0 ** -(np.arange(0, width, 2) / width)  # (width / 2,)
    angles = positions[:, None] * rates
    return np.stack([np.sin(angles), np.cos(angles)], axis=2).reshape(-1, width).astype(np.float32)


def rows_of(observations: Any, rows: np.ndarray) -> Any:
    """Return some rows of a batch of observations, in dicts and tuples too."""
    if isinstance(observations, dict):
        return {name: rows_of(part, rows) for name, part in observations.items()}
    if isinstance(observations, tuple):
        return tuple(rows_of(part, rows) for part in observations)
    return np.asarray(observations)[rows]


def _batched(observations: np.ndarray) -> Any:
    """Return single observations, (n,) objects, as one batch."""
    if isinstance(observations[0], dict):
        return {key: np.stack([each[key] for each in observations]) for key in observations[0]}
    return np.stack(list(observations))


def is_act_task(env: VectorEnv) -> bool:
    """Return whether the environment is Mortar Mayhem without a clue: all commands are observed all the time."""
    variant = MORTAR_MAYHEM.get(bare_id(env.spec.id) if env.spec else None)
    return variant is not None and not variant.clue


def stacked(envs: VectorEnv, frames: int) -> VectorEnv:
    """Stack images, or vectors where there are no images."""
    images = any(len(part.shape) == 3 for part in envs.single_observation_space.values())
    return (GrayscaleStack if images else VectorStack)(envs, frames)


# What flags of RunArgs do to observations, the innermost first: each takes the environments and the flag's value.
WRAPPERS = {
    "spotlight_perturbation": lambda envs, _: SpotlightPerturbation(envs),
    "attend_commands": lambda envs, _: CommandList(envs) if is_act_task(envs) else envs,
    "frame_stack": stacked,
    "vector_frequencies": FourierFeatures,  # before entries that are not from 0 to 1
    "step_encoding": lambda envs, _: StepEncoding(envs),
    "observe_last_action": lambda envs, _: LastAction(envs),
}
