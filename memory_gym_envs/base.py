"""The base class of every environment family: a batch of lanes behind Gymnasium's vector interface.

A family says what its options, spaces, state, rules and pictures are; everything that Gymnasium asks of a vector
environment (seeds, levels, options kept from reset to reset, same-step autoreset, infos, rendering) is here, once.
Shape letters, in the families too: N lanes (parallel environments), n some of them, G entries of the ground truth, V of
a vector observation. A family's state.py has more.
"""

import inspect
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Discrete, MultiDiscrete
from gymnasium.utils import seeding
from gymnasium.vector.utils import batch_space

from memory_gym_envs.drawing import gray, magnify
from memory_gym_envs.entries import vector_space
from memory_gym_envs.old_gymnasium import AutoresetMode, VectorEnv, warn_of_wrappers
from memory_gym_envs.options import brief, complete_options
from memory_gym_envs.saving import Saved, is_generator, plain, restored
from memory_gym_envs.state import Lanes, grows, write_options
from memory_gym_envs.variant import Variant

RENDER_MODES = ("rgb_array", "debug_rgb_array")
OBS_TYPES = ("pixels", "grayscale", "vector")
ACTION_TYPES = ("native", "discrete")
DEBUG_ZOOM = 4  # the debug view is 336 x 336
ALL = slice(None)  # every lane
NO_LIMIT = np.iinfo(np.int64).max  # of steps
LEVEL_STREAM = 1  # keeps the generator that chooses levels apart from the one that builds them
# How the docstring of each family ends.
SHARED_DOC = """
In all ids, other than in the original, images are rows first, `max_steps` truncates, the ground truth is reported, and
wrong options raise ValueError.

## Arguments

`gym.make(id, ...)` and `gym.make_vec(id, num_envs=N, ...)` take

| name | default | meaning |
|---|---|---|
| `render_mode` | None | "rgb_array": what the agent sees; "debug_rgb_array": 336 x 336, with the ground truth |
| `num_levels`, `start_level` | None, 0 | resets without a seed play one of so many levels, from the first on |
| `obs_type` | "pixels" | or "grayscale": pictures (84, 84, 1); or "vector": float32 (V,), `VARIANTS[id].entries` |
| `action_type` | "native" | or "discrete": one number of nine instead of two of three |
| `options` | None | reset parameters that are the environment's defaults |
| `max_episode_steps` | None | truncates longer episodes |
| `autoreset_mode` | SAME_STEP | of `make_vec` alone: when an episode that ended is reset |

`reset(options={...})` takes the same reset parameters, a single environment for one episode. `VARIANTS[id].options` and
`docs/options.md` list them; of a list, one entry is sampled at every reset. The same page describes vectors.

## Version History

- v0: as in memory-gym 1.0.2, except for the differences above.

## References

Marco Pleines: Memory-based Deep Reinforcement Learning in Endless Imperfect Information Games. Dissertation, TU
Dortmund University. Marco Pleines, Matthias Pallasch, Frank Zimmer, Mike Preuss: Memory Gym, arXiv:2309.17207.
"""
# What a subclass has to define.
OF_A_FAMILY = ("variants", "spaces", "allocate", "begin", "advance", "vectors", "frames", "ground_truth", "summary")
# Of what a saved state has for each lane: what it must be.
LANE_BY_LANE: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "settings": ("reset options", lambda each: isinstance(each, dict)),
    "_rngs": ("states of generators or None", lambda each: each is None or is_generator(each)),
    "_level_rngs": ("states of generators or None", lambda each: each is None or is_generator(each)),
    "_seeds": ("integers or None", lambda each: each is None or isinstance(each, int)),
    "_over": ("True or False", lambda each: isinstance(each, (bool, np.bool_))),
}


class MemoryGymVectorEnv(Saved, VectorEnv):
    """N environments of one id, stepped together.

    Arguments that SHARED_DOC does not explain, or not fully:
        variant: the id, a key of the family's `variants`.
        num_envs: N, at least 1.
        num_levels: 0 is as None. A level is what `reset(seed=level)` builds; automatic resets sample one, too.
        obs_type: "grayscale" is the luminance. A "vector" has what the frame shows, and nothing that it hides; no frame
            is drawn then.
        action_type: a "discrete" action is 3 times the first of the two, plus the second.

    Raises ValueError for any other argument value.

    Observations, rewards (N,) float64, terminations and truncations (N,) bool and infos are fresh arrays at every call.
    An episode that ends is reset in the same step: `final_obs` and `final_info` hold its last observation and info, in
    the layout of Gymnasium's `SyncVectorEnv`. Every info has `ground_truth` (N, G) float64. With
    `AutoresetMode.NEXT_STEP`, the last observation and info are returned as they are, and the next step resets the
    lane, whatever its action. With `DISABLED`, the caller resets it, by `reset_mask`, before the next step.

    Each lane has a generator of its own, Gymnasium's `np_random(seed)`; nothing is drawn from anywhere else.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as Gymnasium declares it)
        "render_modes": list(RENDER_MODES),
        "render_fps": 25,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    variants: ClassVar[Mapping[str, Variant]] = {}
    tables: ClassVar[tuple[str, ...]] = ()  # attributes that place_tables() makes, too large to pickle
    truth_high: ClassVar[float] = 1.0  # the ground truth's largest value; the least is 0
    kept: ClassVar[tuple[str, ...]] = ("ready", "settings", "_rngs", "_level_rngs", "_seeds", "_over")
    state: Any  # the family's State, a dataclass of `state.array`s; saved besides what is `kept`

    def __init_subclass__(cls) -> None:
        """Appends to the family's docstring what all have."""
        if cls.__doc__:
            cls.__doc__ = f"{inspect.cleandoc(cls.__doc__)}\n{SHARED_DOC}"

    def __init__(
        self,
        variant: str,
        num_envs: int = 1,
        render_mode: str | None = None,
        num_levels: int | None = None,
        start_level: int = 0,
        obs_type: str = "pixels",
        options: Mapping[str, Any] | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        max_episode_steps: int | None = None,
        action_type: str = "native",
    ):
        missing = [name for name in OF_A_FAMILY if getattr(type(self), name) is getattr(MemoryGymVectorEnv, name)]
        if missing:
            raise TypeError(f"gym.make_vec(id) makes an environment: {type(self).__name__} lacks {', '.join(missing)}")
        if variant not in self.variants:
            raise ValueError(f"variant must be one of {', '.join(self.variants)}, not {variant!r}")
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode must be None, {' or '.join(map(repr, RENDER_MODES))}, not {render_mode!r}")
        if obs_type not in OBS_TYPES:
            raise ValueError(f"obs_type must be one of {', '.join(map(repr, OBS_TYPES))}, not {obs_type!r}")
        if action_type not in ACTION_TYPES:
            raise ValueError(f"action_type must be {' or '.join(map(repr, ACTION_TYPES))}, not {action_type!r}")
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            modes = ", ".join(f"{mode} or {mode.value!r}" for mode in AutoresetMode)
            raise ValueError(f"autoreset_mode must be one of {modes}, not {autoreset_mode!r}") from None
        if max_episode_steps is not None:
            max_episode_steps = checked_integer("max_episode_steps", max_episode_steps, 1)
        self.max_episode_steps = max_episode_steps
        self.num_envs = checked_integer("num_envs", num_envs, 1)
        self.num_levels = checked_integer("num_levels", 0 if num_levels is None else num_levels, 0, NO_LIMIT)
        self.start_level = checked_integer("start_level", start_level, 0)
        self.variant_id, self.variant, self.render_mode = variant, self.variants[variant], render_mode
        changed = {"render_fps": self.variant.render_fps, "autoreset_mode": self.autoreset_mode}
        self.metadata = {**type(self).metadata, **changed}
        self.obs_type = obs_type
        self.joined: tuple[int, ...] | None = None  # the sizes of the branches that one number stands for
        self._make_spaces(action_type)
        self._rngs: list[Any] = [None] * self.num_envs  # generators, from the first reset on
        self._level_rngs: list[Any] = [None] * self.num_envs  # likewise, with num_levels
        self._seeds: list[int | None] = [None] * self.num_envs
        self.defaults = complete_options(self.variant.options, options, variant)
        self.settings = [self.defaults] * self.num_envs  # each lane's reset options, never changed in place
        names = ("num_envs", "num_levels", "start_level", "obs_type", "max_episode_steps")
        self.arguments = {"id": variant, **{name: getattr(self, name) for name in names}}
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            self.arguments["autoreset_mode"] = self.autoreset_mode.value
        if self.joined:
            self.arguments["action_type"] = action_type
        self.ready = False
        self._over = np.zeros(self.num_envs, bool)  # lanes that wait for a reset; in the same-step mode, none does
        self.allocate()
        self.place_tables()

    def _make_spaces(self, action_type: str) -> None:
        """Make the spaces of one lane and of all, as obs_type and action_type change those of the family."""
        self.single_observation_space, self.single_action_space = self.spaces()
        if self.obs_type == "vector":
            self.single_observation_space = vector_space(self.variant.entries)
        elif self.obs_type == "grayscale":
            self.single_observation_space = grayscale_space(self.single_observation_space)
        if action_type == "discrete" and isinstance(self.single_action_space, MultiDiscrete):
            self.joined = tuple(self.single_action_space.nvec.tolist())
            self.single_action_space = Discrete(math.prod(self.joined))
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._action_shape = (self.num_envs, *(self.single_action_space.shape or ()))
        space: Any = self.single_action_space
        self._choices = np.array(space.nvec if hasattr(space, "nvec") else space.n, np.uint64)  # of each branch

    # ---- what a family provides ----

    def spaces(self) -> tuple[gym.Space, gym.Space]:
        """The observation space of one lane with pixels, and its action space."""
        raise NotImplementedError

    def allocate(self) -> None:
        """Makes the state arrays of N lanes."""
        raise NotImplementedError

    def configure(self, lanes: np.ndarray) -> None:
        """Takes over the lanes' new `self.settings`, except for options that an array of the state holds as it is."""

    def place_tables(self) -> None:
        """Looks up the tables that follow from the options, and where each lane's rows start in them.

        Called after `allocate` and `configure`, and when a state is set.
        """

    def begin(self, lanes: np.ndarray) -> None:
        """Builds the lanes' next levels, each from its generator in `self.np_random`, and starts their episodes."""
        raise NotImplementedError

    def advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Applies the rules for one step: rewards, terminations, truncations, each (N,). Resets nothing."""
        raise NotImplementedError

    def pixels(self, lanes: Lanes) -> Any:
        """Fresh observations of the lanes with pixels, drawn from the state alone."""
        return self.frames(lanes)

    def vectors(self, lanes: Lanes) -> np.ndarray:
        """Fresh vector observations of the lanes, (n, V) float32: lanes whose frames are equal have equal vectors."""
        raise NotImplementedError

    def frames(self, lanes: Lanes) -> np.ndarray:
        """Fresh frames of the lanes, (n, 84, 84, 3) uint8: what the agent sees."""
        raise NotImplementedError

    def ground_truth(self) -> np.ndarray:
        """A fresh (N, G) float64 array of what the agent has to remember or infer."""
        raise NotImplementedError

    def summary(self, lanes: np.ndarray) -> dict[str, np.ndarray]:
        """The lanes' ended episodes in numbers, each (n,): the final info but for the ground truth."""
        raise NotImplementedError

    def oracle(self) -> dict[str, np.ndarray]:
        """The whole task in plain numbers, (N, ...) fresh arrays, hidden or not: for players, probes and displays.

        Here what all families have: `length`, steps so far, and `seed`, what the lane's generator was last seeded with
        (-1: not known), which is the level, unless an episode began since without a seed and `num_levels`. Raises
        Gymnasium's ResetNeeded before the first reset.
        """
        if not self.ready:
            raise gym.error.ResetNeeded("call reset() before oracle()")
        # Without a seed given, Gymnasium draws one of 128 bits, which is no level.
        seeds = [-1 if seed is None or seed > NO_LIMIT else seed for seed in self._seeds]
        return {"seed": np.array(seeds, np.int64), "length": self.state.length.copy()}

    def longest_episode(self, lane: int) -> int:
        """The steps after which the lane's episode is over at the latest, under its reset options; -1: no limit."""
        return self.settings[lane].get("max_steps", -1)

    def annotate(self, frame: np.ndarray, lane: int) -> None:
        """Draws the lane's ground truth over its magnified frame, in place."""

    # ---- Gymnasium's interface ----

    def reset(self, *, seed: Any = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts new episodes, and returns observations and infos.

        seed: an integer (lane i gets seed + i), a list of N integers or Nones, or None: the lanes' generators go on.
        options: reset parameters, kept until the next explicit reset (None: the defaults). `reset_mask`, a bool array
            (N,), limits the reset to some lanes: the other lanes' observations are returned as they were.

        Raises ValueError for a wrong seed or option; nothing has changed then.
        """
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            warn_of_wrappers()
        lanes, options = self._split_mask(options)
        seeds = lane_seeds(seed, self.num_envs)
        self.restart(lanes, seeds, self.complete_options(options))
        return self.observe(ALL), self._truth_info(lanes)

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of every lane; lanes whose episode ends are reset when `autoreset_mode` says.

        actions: (N,) or (N, 2) integers. Raises ValueError for any other shape, type or range, and Gymnasium's
        ResetNeeded before the first reset.
        """
        if not self.ready:
            raise gym.error.ResetNeeded("call reset() before step()")
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            return self._step_and_wait(self.checked_actions(actions))
        rewards, terminated, truncated = self._advance(self.checked_actions(actions))
        observations, infos = self.observe(ALL), {}
        (ended,) = (terminated | truncated).nonzero()
        if ended.size:
            infos = self._final_info(ended, observations)
            self._next_levels(ended, [None] * self.num_envs)
            overwrite(observations, ended, self.observe(ended))
        infos.update(self._truth_info(None))
        return observations, rewards, terminated, truncated, infos

    def render(self, lanes: Lanes = ALL) -> tuple[np.ndarray, ...] | None:
        """One picture per lane: (84, 84, 3), or (336, 336, 3) in the debug mode. None without a render mode."""
        if self.render_mode is None:
            gym.logger.warn("render() needs an environment that was made with render_mode, e.g. 'rgb_array'")
            return None
        if not self.ready:
            raise gym.error.ResetNeeded("call reset() before render()")
        frames = self.frames(lanes)
        if self.render_mode == "rgb_array":
            return tuple(frames)
        large = [magnify(frame, DEBUG_ZOOM) for frame in frames]
        for lane, frame in zip(np.arange(self.num_envs)[lanes].tolist(), large, strict=True):
            self.annotate(frame, lane)
        return tuple(large)

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator | None, ...]:  # type: ignore[override] # as in SyncVectorEnv
        """Each lane's generator; None before the first reset."""
        return tuple(self._rngs)

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """What each lane's generator was seeded with; -1 if it was set from outside."""
        return tuple(self._seeds)

    def set_generator(self, lane: int, rng: np.random.Generator | None) -> None:
        """Makes the lane draw from this generator from now on."""
        self._rngs[lane], self._seeds[lane] = rng, -1

    # ---- parts ----

    def observe(self, lanes: Lanes) -> Any:
        """Fresh observations of the lanes, of the kind that the environment was made for."""
        if self.obs_type == "vector":
            return self.vectors(lanes)
        pixels = self.pixels(lanes)
        return pixels if self.obs_type == "pixels" else grayscale_pictures(pixels)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in self.tables}

    def __setstate__(self, values: dict[str, Any]) -> None:
        self.__dict__.update(values)
        self.place_tables()

    def get_state(self) -> dict[str, Any]:
        """The lanes' arrays, options, seeds and generators, in plain values that later steps do not change."""
        made_with = {**self.arguments, "options": plain(self.defaults)}
        return {**super().get_state(), "made_with": made_with, "arrays": plain(vars(self.state))}

    def set_state(self, state: dict[str, Any]) -> None:
        """Takes over a copy of what get_state() of an environment with the same arguments returned.

        Raises ValueError for any other, or that of another version of the environment; nothing has changed then.
        """
        if not isinstance(state, Mapping) or "arrays" not in state:
            raise ValueError(f"this is no state of {self.variant_id}: {brief(state)}")
        # States of earlier versions are without these.
        state = {"_over": np.zeros(self.num_envs, bool), "made_with": self.arguments, **state}
        try:
            self._check_state(state)
            settings = [self.complete_options(each) for each in state["settings"]]
            arrays, rest = restored(state["arrays"]), {name: restored(state[name]) for name in self.kept}
        except (AttributeError, KeyError, TypeError) as error:
            raise ValueError(f"this is no state of {self.variant_id}: {brief(error)}") from None
        super().set_state({**rest, "settings": settings})
        self.state = type(self.state)(**arrays)
        self.place_tables()

    def _check_state(self, state: dict[str, Any]) -> None:
        """Raises ValueError if the state is of one made with other arguments, or has not what every lane needs."""
        ours, theirs = {**self.arguments}, {**state["made_with"]}
        options = theirs.pop("options", None)  # which earlier versions did not save
        for name in ours | theirs:
            if theirs.get(name) != ours.get(name):
                given, wanted = (brief(each.get(name)) for each in (theirs, ours))
                raise ValueError(f"the saved state is of one with {name} {given}, not {wanted}")
        if (completed := self.complete_options(options)) != self.defaults:  # last: another id has others
            raise ValueError(f"the saved state is of one with options {brief(completed)}, not {brief(self.defaults)}")
        for name in self.kept:
            given, ours = state[name], plain(getattr(self, name))
            if type(given) is not type(ours) or getattr(given, "dtype", None) != getattr(ours, "dtype", None):
                raise ValueError(f"its {name} must be like {brief(ours)}, not {brief(given)}")
        for name, (what, is_right) in LANE_BY_LANE.items():
            if len(state[name]) != self.num_envs:
                raise ValueError(f"its {name} are of {len(state[name])} lanes, not of {self.num_envs}")
            for each in state[name]:
                if not is_right(each):
                    raise ValueError(f"its {name} must be {what}, not {brief(each)}")
        self._check_arrays(state["arrays"])

    def _check_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        """Raises ValueError if these arrays do not fit into the state."""
        if arrays.keys() != vars(self.state).keys():
            raise ValueError(f"the saved state is of another version of {self.variant_id}")
        for name, ours in vars(self.state).items():
            fixed, shape = slice(ours.ndim - grows(self.state, name)), arrays[name].shape
            if len(shape) != ours.ndim or shape[fixed] != ours.shape[fixed]:
                raise ValueError(f"its array {name} has the shape {shape}, not {ours.shape}")
            # Some arrays are of another type of integers after a step.
            if arrays[name].dtype.kind.replace("u", "i") != ours.dtype.kind.replace("u", "i"):
                raise ValueError(f"its array {name} is of {arrays[name].dtype}, not of {ours.dtype}")

    def complete_options(self, options: Mapping[str, Any] | None) -> dict[str, Any]:
        """The complete reset options. Raises ValueError for a wrong one."""
        if options is None:
            return self.defaults
        return complete_options(self.variant.options, options, self.variant_id, self.defaults)

    def restart(self, lanes: np.ndarray, seeds: list[int | None], settings: dict[str, Any]) -> None:
        """An explicit reset of the lanes with these checked seeds (one for every lane of N) and options."""
        if not self.ready or any(self.settings[lane] != settings for lane in lanes.tolist()):
            for lane in lanes.tolist():
                self.settings[lane] = settings
            write_options(self.state, lanes, settings)
            self.configure(lanes)
            self.place_tables()
        self._next_levels(lanes, seeds)
        self.ready = True

    def _advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`advance`, with truncations by `max_episode_steps`: as Gymnasium's TimeLimit, also of terminated episodes."""
        rewards, terminated, truncated = self.advance(actions)
        if self.max_episode_steps is not None:
            truncated = truncated | (self.state.length >= self.max_episode_steps)
        return rewards, terminated, truncated

    def _step_and_wait(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step in which lanes that wait since the last one are reset, or have to have been, and others begin to."""
        waiting = np.flatnonzero(self._over)
        if waiting.size and self.autoreset_mode is AutoresetMode.DISABLED:
            raise gym.error.ResetNeeded(f"the episodes of lanes {waiting.tolist()} are over: reset them by reset_mask")
        rngs = self._rngs
        try:
            if waiting.size:
                # All lanes advance at once. These do it in a level that nobody sees, by generators that nobody needs.
                unseen = np.random.default_rng(0)
                self._rngs = [unseen if over else rng for over, rng in zip(self._over, rngs, strict=True)]
                self.begin(waiting)
            rewards, terminated, truncated = self._advance(actions)
        finally:  # also after an interrupt: the lanes still wait, and their next levels are the same
            self._rngs = rngs
        if waiting.size:
            self._next_levels(waiting, [None] * self.num_envs)
            rewards[waiting], terminated[waiting], truncated[waiting] = 0.0, False, False
        self._over = terminated | truncated
        infos = self._truth_info(None)
        if self._over.any():
            infos.update(self._summaries(np.flatnonzero(self._over)))
        return self.observe(ALL), rewards, terminated, truncated, infos

    def _next_levels(self, lanes: np.ndarray, seeds: list[int | None]) -> None:
        """Starts the lanes' next episodes. seeds: one for every lane of N."""
        self._over[lanes] = False
        for lane in lanes.tolist():
            self._seed(lane, seeds[lane])
        self.begin(lanes)

    def _seed(self, lane: int, seed: int | None) -> None:
        """Seeds the lane's generator if there is a seed or a choice of levels."""
        if seed is not None and self.num_levels:
            stream = np.random.SeedSequence(seed, spawn_key=(LEVEL_STREAM,))
            self._level_rngs[lane] = np.random.Generator(np.random.PCG64(stream))
        elif self.num_levels:
            if self._level_rngs[lane] is None:
                self._level_rngs[lane] = np.random.default_rng()
            seed = self.start_level + int(self._level_rngs[lane].integers(self.num_levels))
        if seed is not None or self._rngs[lane] is None:
            self._rngs[lane], self._seeds[lane] = seeding.np_random(seed)

    def checked_actions(self, actions: Any) -> np.ndarray:
        """The id's own actions as int64, (N,) or (N, 2), or a ValueError that says what `actions` must be."""
        array = _array(actions)
        if array.shape == self._action_shape and array.dtype.kind in "iu":
            array = array.astype(np.int64, copy=False)
            # Negative numbers are huge as unsigned ones, so one comparison checks both ends.
            if not np.count_nonzero(array.view(np.uint64) >= self._choices):
                return np.stack(np.unravel_index(array, self.joined), axis=1) if self.joined else array
        highest = " or ".join(map(str, np.unique(self._choices).astype(int) - 1))
        limit = f"integers from 0 to {highest} of shape {self._action_shape}"
        raise ValueError(f"{self.variant_id}: actions must be {limit}, not {brief(actions)}")

    def _split_mask(self, options: Mapping[str, Any] | None) -> tuple[np.ndarray, Mapping[str, Any] | None]:
        if not isinstance(options, Mapping) or "reset_mask" not in options:
            return np.arange(self.num_envs), options
        mask = _array(options["reset_mask"])
        if mask.dtype != np.bool_ or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"reset_mask must be a bool array of shape ({self.num_envs},) with at least one True")
        if not self.ready and not mask.all():
            raise ValueError("reset_mask must hold every lane at the first reset")
        return np.flatnonzero(mask), {name: value for name, value in options.items() if name != "reset_mask"}

    def _truth_info(self, lanes: np.ndarray | None) -> dict[str, np.ndarray]:
        """The info that every step and reset has; lanes: those that it is for, None for all."""
        truth, mask = self.ground_truth(), np.ones(self.num_envs, bool)
        if lanes is not None and len(lanes) < self.num_envs:
            mask[:] = False
            mask[lanes] = True
            truth[~mask] = 0.0
        return {"ground_truth": truth, "_ground_truth": mask}

    def _final_info(self, ended: np.ndarray, observations: Any) -> dict[str, Any]:
        """final_obs and final_info of the lanes whose episode ended, as SyncVectorEnv lays them out."""
        final_obs = np.empty(self.num_envs, object)
        for lane in ended.tolist():
            final_obs[lane] = one_of(observations, lane)
        final_info = {**self._summaries(ended), **self._truth_info(ended)}
        mask = final_info["_ground_truth"]
        return {"final_obs": final_obs, "_final_obs": mask.copy(), "final_info": final_info, "_final_info": mask.copy()}

    def _summaries(self, ended: np.ndarray) -> dict[str, np.ndarray]:
        """The ended episodes in numbers, each (N,) with its mask."""
        infos: dict[str, np.ndarray] = {}
        for key, values in self.summary(ended).items():
            infos[key], infos[f"_{key}"] = np.zeros(self.num_envs, values.dtype), np.zeros(self.num_envs, bool)
            infos[key][ended], infos[f"_{key}"][ended] = values, True
        return infos


def lane_seeds(seed: Any, num_envs: int) -> list[int | None]:
    """Each lane's seed, as Gymnasium's vector environments have it: of an integer, lane i has seed + i.

    Raises ValueError for anything but None, an integer from 0, or one of these for each of the N lanes.
    """
    if seed is None:
        return [None] * num_envs
    if isinstance(seed, (list, tuple)) or (isinstance(seed, np.ndarray) and seed.ndim):
        if len(seed) != num_envs:
            raise ValueError(f"seed must hold one entry for each of {num_envs} lanes, not {len(seed)}")
        return [None if each is None else checked_integer("seed", each, 0) for each in seed]
    first = checked_integer("seed", seed, 0)
    return [first + lane for lane in range(num_envs)]


def checked_integer(name: str, value: Any, low: int, high: float = math.inf) -> int:
    """The value as an int; raises ValueError, which says what it must be, unless it is an integer in that range."""
    try:
        number = -1 if isinstance(value, (bool, np.bool_)) else operator.index(value)
    except TypeError:
        number = -1
    if not low <= number <= high:
        limit = f"of at least {low}" if high == math.inf else f"from {low} to {high}"
        raise ValueError(f"{name} must be an integer {limit}, not {brief(value)}")
    return number


def _array(value: Any) -> np.ndarray:
    """The value as an array, which holds no numbers if rows differ in length."""
    try:
        return np.asarray(value)
    except ValueError:
        return np.asarray(None)


def one_of(observations: Any, lane: int) -> Any:
    """A copy of the lane's observation."""
    if isinstance(observations, dict):
        return {key: values[lane].copy() for key, values in observations.items()}
    return observations[lane].copy()


def grayscale_space(space: gym.Space) -> gym.Space:
    """The space with one channel instead of three in each picture."""
    if isinstance(space, gym.spaces.Dict):
        return gym.spaces.Dict({key: grayscale_space(each) for key, each in space.items()})
    if not isinstance(space, gym.spaces.Box) or space.dtype != np.uint8:
        return space
    return gym.spaces.Box(0, 255, (*space.shape[:2], 1), np.uint8)


def grayscale_pictures(observations: Any) -> Any:
    """The observations with one channel instead of three in each picture."""
    if isinstance(observations, dict):
        return {key: grayscale_pictures(each) for key, each in observations.items()}
    return gray(observations)[..., None] if observations.dtype == np.uint8 else observations


def overwrite(observations: Any, lanes: np.ndarray, fresh: Any) -> None:
    """Replaces the lanes' observations, in place."""
    if isinstance(observations, dict):
        for key, values in observations.items():
            values[lanes] = fresh[key]
    else:
        observations[lanes] = fresh
