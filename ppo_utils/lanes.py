"""The environments of one id, side by side: made, stepped and reset together, each with seeds and errors of its own.

A lane is one of the N environments that step together.
"""

import contextlib
import copy
import functools
import inspect
import os
import secrets
import signal
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing import Queue
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec, load_env_creator
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.async_vector_env import AsyncState, _async_worker

from memory_gym_envs.options import brief
from ppo_utils.errors import LaneError, RunError
from ppo_utils.processes import seed_generators
from ppo_utils.terminal import tell

OWN = "own"  # where an info has a lane's own info, and its `Place`


@dataclass(frozen=True)
class Levels:
    """Seeds that resets take: count of them, from first; without count, resets take none."""

    first: int = 0
    count: int = 0


class Place(NamedTuple):
    """Where an environment was, for messages: its number, its last seed, and how many steps it has taken since."""

    number: int
    seed: int | None
    steps: int

    @property
    def step(self) -> str:
        """Name the step, counted from the last reset with a seed."""
        began = "it was made" if self.seed is None else f"its reset with seed {self.seed}"
        return f"step {self.steps} since {began}"

    def __str__(self) -> str:
        return f"environment {self.number}, {self.step}"


class UnfitError(ValueError):
    """An observation or a reward is not what it should be."""


class Lane(gym.Wrapper):
    """One environment of several. Its errors say which one it was and how to get there again.

    What it raises becomes the cause of a LaneError. An observation that does not fit its space (see `check_fits`),
    or a reward that is not one number, is a RunError. Both have the number of the lane, the seed that the environment
    was last reset with, and the number of the step since then, which infos have too, for what is found later.

    A reset without a seed takes one of the levels, if there are any; which ones depends on the last seed that was
    given. The last observation and info of an episode are copies, since some environments return the same arrays at
    every step. Infos are one object each, which Gymnasium does not try to make arrays of: its arrays have the type of
    the value that comes first. A reward may be an array of one number. Closing raises nothing.
    """

    def __init__(self, env: gym.Env, number: int, levels: Levels):
        super().__init__(env)
        self._number, self._levels = number, levels
        self._seed, self._steps, self._rng = None, 0, np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment. Raises LaneError for what it raises, RunError for what it should not return."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        elif self._levels.count:
            seed = self._levels.first + int(self._rng.integers(self._levels.count))
        where = f"the reset after {self._place.step}"
        if seed is not None:
            self._seed, self._steps, where = seed, 0, f"its reset with seed {seed}"
        with self._located(where):
            observation, info = self.env.reset(seed=seed, options=options)
            check_fits(self.observation_space, observation)
            return observation, {OWN: (dict(info), self._place)}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step the environment. Raises LaneError for what it raises, RunError for what it should not return."""
        self._steps += 1
        with self._located():
            observation, reward, terminated, truncated, info = self.env.step(action)
            check_fits(self.observation_space, observation)
            reward, info = one_number(reward), dict(info)
        if terminated or truncated:
            observation = copy.deepcopy(observation)
            with contextlib.suppress(Exception):  # something in it cannot be copied
                info = copy.deepcopy(info)
        return observation, reward, terminated, truncated, {OWN: (info, self._place)}

    def render(self) -> Any:
        """Return the image; None, and a line on stderr, if that raises: a process of its own would end with it."""
        try:
            return self.env.render()
        except Exception as error:
            tell(f"environment {self._number} raised {error!r} when it was drawn")

    def close(self) -> None:
        """Close the environment; what it raises is a line on stderr, since nothing that follows needs it."""
        try:
            super().close()
        except Exception as error:
            tell(f"environment {self._number} raised {error!r} when it was closed")

    @property
    def _place(self) -> Place:
        return Place(self._number, self._seed, self._steps)

    @contextlib.contextmanager
    def _located(self, where: str = "") -> Iterator[None]:
        """Say of errors in which environment and step they were."""
        try:
            yield
        except UnfitError as error:
            raise RunError(f"{self.unwrapped.spec.id}: {error} ({self._place})") from None
        except Exception as error:
            what = f"environment {self._number} raised {type(error).__name__} in {where or self._place.step}"
            raise LaneError(": ".join(filter(None, [what, one_line(error)]))) from error


class AsyncLanes(AsyncVectorEnv):
    """Lanes in processes of their own. One that dies is a RunError; after an error, closing waits for none of them.

    seed: of the first lane, the others' follow; see `work_apart`.
    """

    def __init__(self, lanes: list[Callable[[], gym.Env]], first_lane: int, seed: int | None):
        self._first_lane = first_lane  # the number of the first one, among those of all processes
        self._pending = False  # a call has begun, and has not come to its end
        worker = functools.partial(work_apart, first_lane, seed)
        # Not all spaces can be in shared memory.
        apart = {"autoreset_mode": AutoresetMode.SAME_STEP, "shared_memory": False, "worker": worker}
        try:
            with self._alive():
                super().__init__(lanes, **apart)
        except BaseException:
            for process in getattr(self, "processes", ()):
                process.terminate()
            raise

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        """Reset all lanes."""
        with self._alive():
            return super().reset(**arguments)

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step all lanes."""
        with self._alive():
            return super().step(actions)

    def close_extras(self, timeout: float | None = None, terminate: bool = False) -> None:
        """End all processes, at once if a call has failed."""
        if self._pending:  # its answers may never come, and are not waited for
            self._state, terminate = AsyncState.DEFAULT, True
        super().close_extras(timeout, terminate)

    @contextlib.contextmanager
    def _alive(self) -> Iterator[None]:
        self._pending = True
        try:
            yield
            self._pending = False
        except (EOFError, ConnectionError) as error:
            for lane, process in enumerate(getattr(self, "processes", ()), self._first_lane):
                process.join(1)
                if process.exitcode is not None:
                    code = process.exitcode
                    raise RunError(f"the process of environment {lane} ended, with exit code {code}") from error
            raise


def same_step_envs(
    spec: EnvSpec,
    num_envs: int,
    kwargs: dict[str, Any],
    first_lane: int,
    levels: Levels,
    asynchronous: bool,
    seed: int | None,
) -> VectorEnv:
    """Make the id's own vector environment if it resets in the same step, else lanes one after the other, or at once.

    seed: that the first lane will be reset with.

    Raises ValueError if there is no environment that resets in the same step, and for kwargs that it does not take.
    """
    own = spec.vector_entry_point
    if own is not None and (spec.entry_point is None or resets_in_same_step(creator(own))) and not asynchronous:
        check_kwargs(spec.id, creator(own), kwargs)
        envs = gym.make_vec(spec.id, num_envs, vectorization_mode="vector_entry_point", **kwargs)
        if not resets_in_same_step(envs):
            raise ValueError(f"{spec.id} does not reset an ended episode in the same step")
        return envs
    if spec.entry_point is None:
        raise ValueError(f"{spec.id} has no single environments, which --async-envs needs")
    check_kwargs(spec.id, creator(spec.entry_point), kwargs)
    make = functools.partial(make_lane, spec, kwargs, levels)
    lanes = [functools.partial(make, first_lane + lane) for lane in range(num_envs)]
    if asynchronous:
        envs = AsyncLanes(lanes, first_lane, seed)
    else:
        envs = SyncVectorEnv(lanes, autoreset_mode=AutoresetMode.SAME_STEP)
    envs.spec = spec
    return envs


def work_apart(
    first_lane: int,
    seed: int | None,
    index: int,
    make: Callable[[], gym.Env],
    pipe: Connection,
    parent_pipe: Connection,
    shared_memory: Any,
    errors: Queue,
    *more: Any,
) -> None:
    """Step a lane as Gymnasium does, in a session of its own, with global generators that are seeded like the lane.

    Signals to the training's process group, such as Ctrl-C or that of `timeout`, are for the first process: it ends the
    iteration, for which it needs all lanes, and then the lanes.
    """
    if hasattr(os, "setsid"):
        os.setsid()
    else:  # Windows, where Ctrl-C is for all processes of a console
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Else they would be copies of the training's: an environment that draws from them would be the same in all lanes.
    seed_generators(secrets.randbits(32) if seed is None else seed + index)
    errors = LaneErrors(errors, first_lane + index)
    try:
        env = make()
    except Exception as error:
        parent_pipe.close()
        what = f"environment {first_lane + index} raised {type(error).__name__} when it was made"
        errors.put((index, LaneError, ": ".join(filter(None, [what, one_line(error)])), traceback.format_exc()))
        pipe.recv()  # the first call
        pipe.send((None, False))
        return
    _async_worker(index, lambda: env, pipe, parent_pipe, shared_memory, errors, *more)


class LaneErrors:
    """Takes the errors of a lane's process to the training, each as one line that names the lane."""

    def __init__(self, queue: Queue, number: int):
        self._queue, self._number = queue, number

    def put(self, item: tuple[int, type[BaseException], Any, str]) -> None:
        """Send the lane's index, an error's type and value, and its traceback."""
        index, kind, value, trace = item
        message = str(value)
        if issubclass(kind, Exception) and not issubclass(kind, (LaneError, RunError)):  # not raised by a `Lane`
            hint = "what it returns has to be sent from its process; train without --async-envs"
            kind, message = RunError, f"environment {self._number}: {kind.__name__}: {one_line(value)}; {hint}"
        self._queue.put((index, kind, message, trace))


def make_lane(spec: EnvSpec, kwargs: dict[str, Any], levels: Levels, number: int) -> Lane:
    """Make one environment."""
    return Lane(gym.make(spec, **kwargs), number, levels)


def check_fits(space: gym.Space, observation: Any, name: str = "observation") -> None:
    """Raise UnfitError if an observation has not the keys, shapes or kinds of numbers of its space."""
    if isinstance(space, (gym.spaces.Dict, gym.spaces.Tuple)):
        parts = space.spaces if isinstance(space, gym.spaces.Dict) else dict(enumerate(space.spaces))
        for key, part in parts.items():
            try:
                inside = observation[key]
            except (KeyError, IndexError, TypeError):
                raise UnfitError(f"{name} has no {key!r}: {brief(observation)}") from None
            check_fits(part, inside, f"{name}.{key}")
    elif isinstance(space, (gym.spaces.Box, gym.spaces.Discrete, gym.spaces.MultiDiscrete, gym.spaces.MultiBinary)):
        array = np.asarray(observation)
        if array.shape != space.shape or not np.can_cast(array.dtype, space.dtype, "same_kind"):
            raise UnfitError(
                f"{name} is of {array.dtype}, shape {array.shape}, and its space {space.dtype}, {space.shape}"
            )
        if space.dtype.kind in "iu" and not np.can_cast(array.dtype, space.dtype):  # numbers might wrap around
            least, most = np.iinfo(space.dtype).min, np.iinfo(space.dtype).max
            wrong = array[(array < least) | (array > most)]
            if wrong.size:
                raise UnfitError(f"{name} has an entry {wrong[0]}, outside of {least} to {most}")


def one_number(reward: Any) -> float:
    """Return a reward, which may be an array of one number. Raises UnfitError for anything else."""
    try:
        return float(np.asarray(reward).item())
    except (TypeError, ValueError):
        raise UnfitError(f"the reward is {brief(reward)}, not a number") from None


def check_kwargs(env_id: str, create: Callable, kwargs: dict[str, Any]) -> None:
    """Raise ValueError if neither the environment's constructor nor gym.make takes an argument."""
    try:
        parameters = inspect.signature(create).parameters
    except ValueError:  # of a class that is not written in Python
        return
    if any(each.kind is inspect.Parameter.VAR_KEYWORD for each in parameters.values()):
        return
    taken = [name for name in parameters if name not in ("self", "render_mode")]
    for name in kwargs.keys() - {*taken, "render_mode", "max_episode_steps"}:  # Gymnasium's own
        raise ValueError(f"{env_id} has no argument {name!r}; it has {', '.join(taken) or 'none'}")


def creator(entry_point: str | Callable) -> Callable:
    """Return what makes the environment: its class, as a rule."""
    return load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point


def resets_in_same_step(envs: Any) -> bool:
    """Return whether the metadata of an environment, or of its class, says so."""
    return getattr(envs, "metadata", {}).get("autoreset_mode") == AutoresetMode.SAME_STEP


@contextlib.contextmanager
def one_line_errors(what: str) -> Iterator[None]:
    """Turn what an environment raises into a ValueError of one line that begins with what failed.

    Errors whose cause is the machine or the installation stay as they are, and a RunError, which is one line.
    """
    try:
        yield
    except RunError:
        raise
    except Exception as error:
        first = error.__cause__ if isinstance(error, LaneError) else error
        if isinstance(first, (gym.error.Error, ImportError, OSError, MemoryError)):
            raise first from None
        raise ValueError(f"{what}: {one_line(error) or repr(error)}") from error


def one_line(error: Exception) -> str:
    """Return the error's message without line breaks; empty if it has none."""
    return " ".join(str(error).split())
