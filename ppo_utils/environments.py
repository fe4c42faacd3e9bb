"""Environments ready to train on: any Gymnasium id, whatever it observes and however it resets.

`make_envs` puts the vector wrappers around an environment, in order; `envs_for` calls it with a script's arguments.
`save_state` and `load_state` copy the state of all of them. What a training counts and logs is read from infos:
`ground_truth_of`, `final_numbers` and `final_observations` take it from them.
A lane is one of the N environments that step together.
Shape letters: N lanes, A action branches, G entries of the ground truth.
"""

import contextlib
import difflib
import importlib
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec, load_env_creator
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.wrappers.vector import RecordEpisodeStatistics, TransformAction
from torch import Tensor

import memory_gym_envs  # noqa: F401 (registers its ids)
from memory_gym_envs.base import checked_integer
from memory_gym_envs.options import brief
from memory_gym_envs.saving import Saved
from ppo_utils.observations import ObservationParts
from ppo_utils.processes import rank_and_size
from ppo_utils.wrappers import (
    FourierFeatures,
    GrayscaleStack,
    LastAction,
    SpotlightPerturbation,
    StepEncoding,
    VectorStack,
    branch_sizes,
)


def envs_for(args: Any, num_envs: int, **kwargs: Any) -> VectorEnv:
    """Make the environments that a script's arguments describe; kwargs and errors are those of `make_envs`."""
    names = ("num_levels", "start_level", "obs_type")
    names += ("frame_stack", "step_encoding", "observe_last_action", "spotlight_perturbation", "vector_frequencies")
    kwargs |= {name: getattr(args, name) for name in names}
    return make_envs(args.env_id, num_envs, options=parse_options(args.env_id, args.env_options), **kwargs)


def training_envs(args: Any, checkpoint: dict[str, Any] | None) -> VectorEnv:
    """Make this process's share of the environments to train on. Raises as `make_envs` does."""
    rank, processes = rank_and_size()
    share = args.num_envs // processes
    # Environments that cannot be restored must not repeat the episodes that the run began with.
    seed = args.seed if checkpoint is None or checkpoint["step"] == 0 else [args.seed, checkpoint["step"]]
    mode = "debug_rgb_array" if args.capture_video else None
    return envs_for(args, share, seed=seed, first_lane=rank * share, render_mode=mode)


def as_tensors(obs: dict[str, np.ndarray], device: torch.device) -> dict[str, Tensor]:
    """Move observations to a device."""
    return {name: torch.from_numpy(part).to(device) for name, part in obs.items()}


def make_envs(
    env_id: str,
    num_envs: int,
    *,
    seed: int | Sequence[int] | None = None,
    first_lane: int = 0,
    options: dict[str, Any] | None = None,
    num_levels: int = 0,
    start_level: int = 0,
    obs_type: str = "pixels",
    frame_stack: int = 0,
    step_encoding: bool = False,
    observe_last_action: bool = False,
    spotlight_perturbation: bool = False,
    vector_frequencies: int = 0,
    render_mode: str | None = None,
) -> VectorEnv:
    """Make a vector environment of N lanes with same-step autoreset; the caller's `reset()` begins.

    env_id: a Gymnasium id, or "module:id" if importing a module registers it.
    seed: of all lanes, an integer or several from 0; each lane gets its own random stream, and the next reset no seed.
    first_lane: the lanes are number first_lane, first_lane + 1, ... of a larger set: with the same seed, they have the
        seeds and play the episodes of these lanes of it. Vector environments of other packages may seed all lanes
        together, and then do not.
    options: reset parameters of a Memory Gym environment, the defaults of every reset; see `parse_options`.
    num_levels, start_level, obs_type: of Memory Gym environments; others have no such thing and ignore them, with a
        line on stderr where pictures are shown though vectors were asked for.
    frame_stack, step_encoding, observe_last_action, spotlight_perturbation, vector_frequencies: see GrayscaleStack and
        VectorStack, StepEncoding, LastAction, SpotlightPerturbation, FourierFeatures.
    render_mode: what render() draws; of other packages than this, always rgb_array.

    Observations are dicts of pictures and vectors, see `ObservationParts`; actions are integers (N, A), see
    `branch_actions`; infos hold the statistics of ended episodes, see Gymnasium's vector RecordEpisodeStatistics.
    What single environments raise in later steps and resets says which lane it was, see `LaneErrors`.

    Raises gymnasium.error.Error for an unknown id, ImportError for a missing package, ValueError for an environment
    that cannot be made or that is not supported, and for wrong arguments.
    """
    for name, value, low in (("num_envs", num_envs, 1), ("first_lane", first_lane, 0)):
        checked_integer(name, value, low)
    spec, memory_gym = find_spec(env_id), is_memory_gym(env_id)
    if options and not memory_gym:
        raise ValueError(f"options are reset parameters of Memory Gym environments; {env_id} has none")
    levels = {"num_levels": num_levels, "start_level": start_level, "obs_type": obs_type, "options": options}
    kwargs = levels if memory_gym else {}
    if render_mode is not None:
        kwargs["render_mode"] = render_mode if memory_gym else "rgb_array"
    with one_line_errors(f"{env_id} cannot be made"):
        envs = same_step_envs(spec, num_envs, kwargs)

    envs = ObservationParts(branch_actions(envs))
    pictures = [name for name, part in envs.single_observation_space.items() if len(part.shape) == 3]
    if obs_type == "vector" and pictures and not memory_gym:
        print(f"{env_id} has no vectors to show instead of its {', '.join(pictures)}", file=sys.stderr)
    if spotlight_perturbation:
        with one_line_errors("--spotlight-perturbation"):
            envs = SpotlightPerturbation(envs)
    if frame_stack:
        with one_line_errors("--frame-stack"):
            envs = (GrayscaleStack if pictures else VectorStack)(envs, frame_stack)
    if step_encoding:
        envs = StepEncoding(envs)
    if observe_last_action:
        envs = LastAction(envs)
    if vector_frequencies:
        with one_line_errors("--vector-frequencies"):
            envs = FourierFeatures(envs, vector_frequencies)

    first_seed = None
    if seed is not None:
        with one_line_errors(f"{env_id} cannot be reset"):
            # Neighbouring seeds must not share lanes, so the lanes' seeds count up from a hash of the seed.
            first_seed = int(np.random.SeedSequence(seed).generate_state(1)[0]) + first_lane
            envs.reset(seed=first_seed)
    locate_errors(envs.unwrapped, first_lane, first_seed)  # only now: the errors above already say what failed
    # An explicit seed is a level of its own, which nobody plays: what counts episodes comes after it.
    return EpisodeStatistics(envs)


# ---- saved states ----


def save_state(envs: VectorEnv) -> dict[str, Any] | None:
    """Return the whole state of environments from `make_envs`, or None if there are parts of other packages in them.

    They may be in a `LaneVideo`, whose state is the numbers of the episode and the step.
    Saved are: every array of the environment, with the levels that are being played; each lane's generator and its
    seed, and the one that chooses levels; the present options, which automatic resets keep; frame stacks, step numbers
    and last actions; the lights of the perturbation and their generators; returns and lengths of the episodes so far,
    and of the last ended ones. Not saved are an episode's seconds, which count from `load_state`, and a video that is
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
    """Return whether the id is one of this package's environments, which have levels and reset parameters."""
    return str(find_spec(env_id).entry_point).startswith("memory_gym_envs")


def parse_options(env_id: str, text: str) -> dict[str, Any] | None:
    """Parse --env-options; raise ValueError if it is no JSON object or the environment has no such parameters."""
    try:
        options = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"--env-options is no JSON ({error}): {text}") from None
    if not isinstance(options, dict):
        raise ValueError(f'--env-options must be a JSON object such as {{"visual_feedback": false}}, not {text}')
    if options and not is_memory_gym(env_id):
        raise ValueError(f"--env-options are reset parameters of Memory Gym environments; {env_id} has none")
    return options or None


# ---- the environments themselves ----


def same_step_envs(spec: EnvSpec, num_envs: int, kwargs: dict[str, Any]) -> VectorEnv:
    """Make the id's own vector environment if it resets in the same step, else Gymnasium's synchronous one.

    Raises ValueError if there is no environment that resets in the same step.
    """
    own = spec.vector_entry_point
    if own is not None and (spec.entry_point is None or resets_in_same_step(creator(own))):
        envs = gym.make_vec(spec.id, num_envs, vectorization_mode="vector_entry_point", **kwargs)
    else:
        same_step = {"autoreset_mode": AutoresetMode.SAME_STEP}
        envs = gym.make_vec(spec.id, num_envs, vectorization_mode="sync", vector_kwargs=same_step, **kwargs)
    if not resets_in_same_step(envs):
        raise ValueError(f"{spec.id} does not reset an ended episode in the same step")
    return envs


def creator(entry_point: str | Callable) -> Callable:
    """Return what makes the environment: its class, as a rule."""
    return load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point


def resets_in_same_step(envs: Any) -> bool:
    """Return whether the metadata of an environment, or of its class, says so."""
    return getattr(envs, "metadata", {}).get("autoreset_mode") == AutoresetMode.SAME_STEP


@contextlib.contextmanager
def one_line_errors(what: str) -> Iterator[None]:
    """Turn what an environment raises into a ValueError of one line that begins with what failed.

    Errors whose cause is the machine or the installation stay as they are.
    """
    try:
        yield
    except (gym.error.Error, ImportError, OSError, MemoryError):
        raise
    except Exception as error:
        raise ValueError(f"{what}: {one_line(error) or repr(error)}") from error


def one_line(error: Exception) -> str:
    """Return the error's message without line breaks; empty if it has none."""
    return " ".join(str(error).split())


class LaneErrors(gym.Wrapper):
    """One environment of several, whose errors say which it is and how to get there again.

    What its step or reset raises becomes the cause of a RuntimeError, whose message has the number of the lane, the
    seed that the environment was last reset with, and the number of the step since then. Automatic resets and those
    without a seed do not start the count again.

    seed: what it was reset with before, None for nothing.
    """

    def __init__(self, env: gym.Env, lane: int, seed: int | None):
        super().__init__(env)
        self._lane, self._seed, self._steps = lane, seed, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment. Raises RuntimeError for what it raises."""
        if seed is not None:
            self._seed, self._steps = seed, 0
        try:
            return self.env.reset(seed=seed, options=options)
        except Exception as error:
            raise self._located(error, "the reset after step") from error

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment. Raises RuntimeError for what it raises."""
        self._steps += 1
        try:
            return self.env.step(action)
        except Exception as error:
            raise self._located(error, "step") from error

    def _located(self, error: Exception, where: str) -> RuntimeError:
        began = "it was made, never reset with a seed" if self._seed is None else f"its reset with seed {self._seed}"
        what = f"{type(error).__name__} in {where} {self._steps} since {began}"
        return RuntimeError(": ".join(filter(None, [f"environment {self._lane} raised {what}", one_line(error)])))


def locate_errors(envs: VectorEnv, first_lane: int, first_seed: int | None) -> None:
    """Put the environments that Gymnasium steps one after the other into `LaneErrors`.

    first_lane, first_seed: the first one's number and what it was reset with; the others' count up from there.
    """
    if isinstance(envs, SyncVectorEnv):
        seeds = [None if first_seed is None else first_seed + i for i in range(envs.num_envs)]
        envs.envs = [LaneErrors(env, first_lane + i, seeds[i]) for i, env in enumerate(envs.envs)]


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
        actions = np.asarray(actions) + space.start  # the first action's number, 0 unless the space says otherwise
        return actions[:, 0] if isinstance(space, gym.spaces.Discrete) else actions

    return TransformAction(envs, to_env, single_action_space=gym.spaces.MultiDiscrete(sizes))


# ---- what infos say ----


def ground_truth_of(infos: dict[str, Any], args: Any) -> np.ndarray | None:
    """Return the ground truth (N, G) that --ground-truth-coef estimates, None where it is 0.

    Raises ValueError if the environment reports none.
    """
    if not args.ground_truth_coef:
        return None
    truth = np.asarray(infos.get("ground_truth"))
    if truth.ndim != 2 or truth.dtype.kind not in "biuf":
        raise ValueError("--ground-truth-coef needs an environment that has ground_truth, an array, in its info; use 0")
    return truth


def final_numbers(infos: dict[str, Any], lanes: np.ndarray) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield each number in the final infos of the given lanes: its name, which of them have it (N,), and theirs.

    lanes: (N,) bool.
    """
    final = infos.get("final_info", {})
    for name, values in final.items():
        which = lanes & final.get(f"_{name}", False)
        if which.any() and isinstance(values, np.ndarray) and all(np.isscalar(value) for value in values[which]):
            found = np.array(values[which].tolist())
            if found.dtype.kind in "biuf":
                yield name, which, found


def final_observations(
    observations: dict[str, np.ndarray], infos: dict[str, Any], lanes: np.ndarray
) -> dict[str, np.ndarray]:
    """Return copies of observations (N, ...) in which the given lanes hold the last one of the episode that just ended.

    lanes: (N,) bool.
    """
    observations = {name: part.copy() for name, part in observations.items()}
    for lane in np.flatnonzero(lanes):
        for name, part in infos["final_obs"][lane].items():
            observations[name][lane] = part
    return observations


class EpisodeStatistics(Saved, RecordEpisodeStatistics):
    """Gymnasium's statistics of ended episodes, which can be saved, but for the seconds: those start again."""

    kept = ("episode_count", "episode_returns", "episode_lengths", "prev_dones")
    queues = ("return_queue", "length_queue")

    def get_state(self) -> dict[str, Any]:
        """Return returns and lengths so far, and those of the last ended episodes."""
        return {**super().get_state(), **{name: np.array(getattr(self, name)) for name in self.queues}}

    def set_state(self, state: dict[str, Any]) -> None:
        """Take over a copy of what get_state() returned."""
        super().set_state(state)
        for name in self.queues:
            getattr(self, name).clear()
            getattr(self, name).extend(state[name])
        self.episode_start_times = np.full(self.num_envs, time.perf_counter())
