"""Environments ready to train on: any Gymnasium id, whatever it observes and however it resets.

`make_envs` puts the vector wrappers around an environment, in order; `envs_for` calls it with a script's arguments.
`save_state` and `load_state` copy the state of all of them.
A lane is one of the N environments that step together.
Shape letters: N lanes, A action branches.
"""

import difflib
import importlib
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.wrappers.vector import RecordEpisodeStatistics, TransformAction
from torch import Tensor

import memory_gym_envs  # noqa: F401 (registers its ids)
from memory_gym_envs.base import MemoryGymVectorEnv, checked_integer
from memory_gym_envs.options import brief
from memory_gym_envs.saving import Saved
from ppo_utils.flags import RunArgs, flag
from ppo_utils.lanes import Levels, creator, one_line, one_line_errors, same_step_envs
from ppo_utils.observations import ObservationParts
from ppo_utils.processes import rank_and_size
from ppo_utils.terminal import tell
from ppo_utils.wrappers import WRAPPERS, branch_sizes

T = TypeVar("T")  # a script's Args


def envs_for(args: RunArgs, num_envs: int, **kwargs: Any) -> VectorEnv:
    """Make the environments that a script's arguments describe; kwargs and errors are those of `make_envs`."""
    ours = {name: getattr(args, name) for name in ("num_levels", "start_level", "obs_type")} | wrappers_of(args)
    options, env_kwargs = parse_options(args.env_id, args.env_options), json_object("--env-kwargs", args.env_kwargs)
    ours |= {"options": options or None, "env_kwargs": env_kwargs, "asynchronous": args.async_envs}
    return make_envs(args.env_id, num_envs, **ours | kwargs)


def wrappers_of(args: RunArgs) -> dict[str, Any]:
    """Return the flags of `wrap_envs` that are among a script's arguments."""
    return {name: getattr(args, name) for name in WRAPPERS}


def training_envs(args: RunArgs, checkpoint: dict[str, Any] | None) -> VectorEnv:
    """Make this process's share of the environments to train on. Raises as `make_envs` does."""
    rank, processes = rank_and_size()
    share = args.num_envs // processes
    # Environments that cannot be restored must not repeat the episodes that the run began with.
    seed = args.seed if checkpoint is None else [args.seed, checkpoint["step"]]
    mode = "debug_rgb_array" if args.capture_video else None
    try:
        return envs_for(args, share, seed=seed, first_lane=rank * share, render_mode=mode)
    except ValueError as error:
        if args.preset != "quickstart" or args.env_id == RunArgs.env_id or "option" not in str(error):
            raise
        raise ValueError(
            f"{error}; --preset quickstart has options of its own, --env-options '{{}}' the default ones"
        ) from None


def as_tensors(obs: dict[str, np.ndarray], device: torch.device) -> dict[str, Tensor]:
    """Move observations, parts (N, ...), to a device."""
    return {name: torch.from_numpy(part).to(device) for name, part in obs.items()}


def make_envs(
    env_id: str,
    num_envs: int,
    *,
    seed: int | Sequence[int] | None = None,
    first_lane: int = 0,
    options: dict[str, Any] | None = None,
    env_kwargs: dict[str, Any] | None = None,
    asynchronous: bool = False,
    num_levels: int = 0,
    start_level: int = 0,
    obs_type: str = "pixels",
    render_mode: str | None = None,
    **wrappers: Any,
) -> VectorEnv:
    """Make a vector environment of N lanes with same-step autoreset; the caller's `reset()` begins.

    env_id: a Gymnasium id, or "module:id" if importing a module registers it.
    seed: of all lanes, an integer or several from 0; each lane gets its own random stream, and the next reset no seed.
    first_lane: the lanes are number first_lane, first_lane + 1, ... of a larger set: with the same seed, they have the
        seeds and play the episodes of these lanes of it. Vector environments of other packages may seed all lanes
        together, and then do not.
    options: reset parameters of a Memory Gym environment, the defaults of every reset; see `parse_options`.
    env_kwargs: constructor arguments of another package's environment.
    asynchronous: every environment in a process of its own, for slow environments of other packages.
    num_levels, start_level: of Memory Gym environments. With a num_levels above 0, resets of others take one of the
        seeds start_level, start_level + 1, ..., num_levels of them, if they are made one by one, not as vector
        environments.
    obs_type: of Memory Gym environments; others ignore it, with a line on stderr if they show images.
    render_mode: what render() draws; of other packages than this, always rgb_array.
    wrappers: flags of `wrap_envs`.

    Observations and actions are those of `wrap_envs`; infos hold the statistics of ended episodes, see Gymnasium's
    vector RecordEpisodeStatistics.
    What single environments raise in later steps and resets says which lane it was, see `Lane`. NaN and infinity in
    observations and rewards, and numbers outside of a discrete space, raise RunError.

    Raises gymnasium.error.Error for an unknown id, ImportError for a missing package, ValueError for an environment
    that cannot be made or that is not supported, and for wrong arguments.
    """
    for name, value, low in (("num_envs", num_envs, 1), ("first_lane", first_lane, 0)):
        checked_integer(name, value, low)
    spec, memory_gym = find_spec(env_id), is_memory_gym(env_id)
    if options and not memory_gym:
        raise ValueError(f"options are reset parameters of Memory Gym environments; {env_id} has none")
    if memory_gym and (env_kwargs or asynchronous):
        what = "env_kwargs are" if env_kwargs else "asynchronous is"
        raise ValueError(f"{what} for environments of other packages; {env_id} has options, and is faster as it is")
    kwargs = {**(env_kwargs or {})}
    if memory_gym:
        kwargs = {"num_levels": num_levels, "start_level": start_level, "obs_type": obs_type, "options": options}
    if render_mode is not None:
        kwargs["render_mode"] = render_mode if memory_gym else "rgb_array"
    levels = Levels(start_level, num_levels)
    if seed is not None:
        # Neighbouring seeds must not share lanes, so the lanes' seeds count up from a hash of the seed, of 30 bits,
        # since some simulators take seeds below 2 ** 31 only.
        seed = int(np.random.SeedSequence(seed).generate_state(1)[0] >> 2) + first_lane
    with one_line_errors(f"{env_id} cannot be made"):
        envs = same_step_envs(spec, num_envs, kwargs, first_lane, levels, asynchronous, seed)

    try:
        envs = wrap_envs(envs, first_lane, **wrappers)
        images = [name for name, part in envs.single_observation_space.items() if len(part.shape) == 3]
        if obs_type != "pixels" and images and not memory_gym:
            tell(f"{env_id} has no {obs_type} to show instead of its {', '.join(images)}")

        if seed is not None:
            with one_line_errors(f"{env_id} cannot be reset"):
                envs.reset(seed=seed)
        # An explicit seed is a level of its own, which nobody plays: what counts episodes comes after it.
        return EpisodeStatistics(envs)
    except Exception:
        envs.close()
        raise


def wrap_envs(envs: VectorEnv, first_lane: int = 0, **flags: Any) -> VectorEnv:
    """Wrap a vector environment with same-step autoreset, so that agents can observe it and act in it.

    Observations are dicts of images and vectors, see `ObservationParts`; actions are integers (N, A), see
    `branch_actions`. first_lane: number of the first environment, for error messages. flags: values by name, of those
    in WRAPPERS; what is 0 or False adds nothing. Raises ValueError for an environment that does not suit, TypeError for
    other flags.
    """
    if unknown := [name for name in flags if name not in WRAPPERS]:
        raise TypeError(f"there is no argument {unknown[0]}; there are {', '.join(WRAPPERS)}")
    envs = ObservationParts(branch_actions(envs), first_lane)
    for name, wrap in WRAPPERS.items():
        if flags.get(name):
            with one_line_errors(flag(name)):
                envs = wrap(envs, flags[name])
    return envs


# ---- saved states ----


def save_state(envs: VectorEnv) -> dict[str, Any] | None:
    """Return the whole state of environments from `make_envs`, or None if there are parts of other packages in them.

    They may be in a `LaneVideo`, whose state is the number of the episode.
    Saved are: every array of the environment, with the levels that are being played; each lane's generator and its
    seed, and the one that chooses levels; the present options, which automatic resets keep; frame stacks, step numbers
    and last actions; the lights of the perturbation and their generators; returns and lengths of the episodes so far.
    Not saved are an episode's seconds, which count from `load_state`, and a video that is
    being recorded: the next scheduled episode has one again.

    All values are plain: dicts with str keys, lists, tuples, str, int, float, bool, None, and NumPy arrays of numbers
    or bools. They are copies: later steps do not change them.
    """
    parts = saved_parts(envs)
    if parts is None:
        return None
    return {"environments": describe(parts), "parts": [part.get_state() for part in parts]}


def load_state(envs: VectorEnv, state: dict[str, Any]) -> None:
    """Set environments, made with the same arguments, to what `save_state` returned: they play on exactly from there.

    No reset is needed before or after. The state remains the caller's: later steps do not change it.

    Raises ValueError if the state is of other environments: of another id, number of lanes, choice of levels or kind of
    observation, or with other wrappers; and for what is no state. Nothing has changed then, but a video that was
    being recorded ends.
    """
    parts = saved_parts(envs)
    if parts is None:
        raise ValueError(f"{envs.spec.id} has parts of other packages, whose state cannot be set")
    theirs = state.get("environments") if isinstance(state, dict) else None
    if not isinstance(theirs, dict) or state.keys() != {"environments", "parts"}:
        raise ValueError(f"this is no state of environments: {brief(state)}")
    ours = describe(parts)
    for name in ours | theirs:
        if ours.get(name) != theirs.get(name):
            raise ValueError(
                f"the saved state is of environments with {name} {theirs.get(name)!r}, not {ours.get(name)!r}"
            )
    before = [part.get_state() for part in parts]
    try:
        set_states(parts, state["parts"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:  # it is not what get_state() returned
        set_states(parts, before)
        raise ValueError(f"this is no state of {envs.spec.id}: {one_line(error)}") from error


def set_states(parts: list[Saved], states: list[dict[str, Any]]) -> None:
    """Set each part to its state."""
    for part, state in zip(parts, states, strict=True):
        part.set_state(state)


def saved_parts(envs: VectorEnv) -> list[Saved] | None:
    """Return the environment and its wrappers that have a state, from the inside out; None if one's is not known.

    Raises ValueError for a single environment.
    """
    if not isinstance(envs, VectorEnv):
        raise ValueError(f"a state is that of a vector environment, by make_envs or gym.make_vec, not of {envs}")
    parts: list[Saved] = []
    layers = [envs]
    while isinstance(layers[-1], VectorWrapper):
        layers.append(layers[-1].env)
    for layer in reversed(layers):
        if isinstance(layer, Saved):
            parts.append(layer)
        elif not isinstance(layer, (ObservationParts, TransformAction)):  # which have none
            return None
    return parts


def describe(parts: list[Saved]) -> dict[str, Any]:
    """Return what environments with these parts were made with; a state fits if this is equal."""
    environment, *wrappers = parts
    names = [type(wrapper).__name__ for wrapper in wrappers]
    values = {**environment.arguments, "wrappers": ", ".join(names)}
    for name, wrapper in zip(names, wrappers, strict=True):
        values |= {f"{name}'s {argument}": value for argument, value in wrapper.arguments.items()}
    return values


# ---- ids and options ----


def find_spec(env_id: str) -> EnvSpec:
    """Return what is registered for the id, or for "module:id" once the module is imported.

    Raises ImportError for a module that is not installed, gymnasium.error.Error for an id that is not registered.
    """
    module, _, name = env_id.rpartition(":")
    if module.startswith("."):
        raise ImportError(f"the module of {env_id} begins with a dot; give its whole name")
    if module:
        if "" not in sys.path:
            sys.path.append("")  # modules in the current folder, after all others
        importlib.import_module(module)
    if name not in gym.registry and (near := difflib.get_close_matches(name, gym.registry, n=1)):
        raise gym.error.NameNotFound(f"there is no environment {name}; the nearest is {near[0]}")
    try:
        return gym.spec(name)
    except (gym.error.NameNotFound, gym.error.NamespaceNotFound) as error:
        if module:
            raise
        hint = "if it is another package's, say which module registers it: module:id"
        raise type(error)(f"{one_line(error)} {hint}") from None


def is_memory_gym(env_id: str) -> bool:
    """Return whether the id is one of a `MemoryGymVectorEnv`, which has levels, reset parameters and vectors."""
    try:
        made = creator(find_spec(env_id).vector_entry_point or "")
    except (ImportError, ValueError):  # of a package that needs more than is installed; no entry point
        return False
    return isinstance(made, type) and issubclass(made, MemoryGymVectorEnv)


def json_object(name: str, text: str) -> dict[str, Any]:
    """Parse the JSON object of a flag of this name; raise ValueError if it is none."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{name} is no JSON ({error}): {brief(text)}") from None
    if not isinstance(found, dict):
        raise ValueError(f'{name} must be a JSON object such as {{"size": 9}}, not {text}')
    return found


def parse_options(env_id: str, text: str) -> dict[str, Any]:
    """Parse --env-options; raise ValueError if it is no JSON object or the environment has no such parameters."""
    options = json_object("--env-options", text)
    if options and not is_memory_gym(env_id):
        raise ValueError(
            f"--env-options are reset parameters of Memory Gym environments; {env_id} has none (--env-kwargs are "
            "constructor arguments)"
        )
    return options


def with_options(args: T, text: str | None) -> T:
    """Return a script's arguments with further --env-options, JSON, over those that it has; None: no others.

    Raises ValueError as `parse_options`.
    """
    if text is None:
        return args
    options = parse_options(args.env_id, args.env_options) | parse_options(args.env_id, text)
    return replace(args, env_options=json.dumps(options))


# ---- actions ----


def branch_actions(envs: VectorEnv) -> VectorEnv:
    """Make the environment take one integer from 0 per branch, (N, A): a MultiDiscrete space, whatever it was.

    Raises ValueError for other spaces than Discrete and one-dimensional MultiDiscrete.
    """
    space = envs.single_action_space
    sizes = branch_sizes(space)

    def to_env(actions: np.ndarray) -> np.ndarray:
        if np.shape(actions) != (envs.num_envs, len(sizes)):
            shape = f"({envs.num_envs}, {len(sizes)}), lanes and branches"
            raise ValueError(f"actions must be integers of shape {shape}, not {brief(actions)}")
        return env_actions(space, np.asarray(actions))

    return TransformAction(envs, to_env, single_action_space=gym.spaces.MultiDiscrete(sizes))


def env_actions(space: gym.Space, actions: np.ndarray) -> np.ndarray:
    """Turn actions (N, A), counted from 0, into the environment's own: (N,) for Discrete, (N, A) for MultiDiscrete."""
    actions = (actions + space.start).astype(space.dtype)  # start is 0 unless the space says otherwise
    return actions[:, 0] if isinstance(space, gym.spaces.Discrete) else actions


class EpisodeStatistics(Saved, RecordEpisodeStatistics):
    """Gymnasium's statistics of ended episodes, with a state: of the episodes that go on, without their seconds."""

    kept = ("episode_count", "episode_returns", "episode_lengths", "prev_dones")

    def set_state(self, state: dict[str, Any]) -> None:
        """Take over a copy of what get_state() returned."""
        super().set_state(state)
        self.episode_start_times = np.full(self.num_envs, time.perf_counter())
