"""Evaluation: agents play levels that they are not trained on (§6.1.3 of the thesis).

Shape letters: N environments, one for each episode.
"""

import functools
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor, nn

from ppo_utils.environments import as_tensors, is_memory_gym, make_envs, parse_options
from ppo_utils.errors import report_unusable_policy
from ppo_utils.flags import RunArgs
from ppo_utils.infos import final_numbers, ground_truth_of
from ppo_utils.terminal import tell

REPEATS = 3  # times that each level is played
AT_ONCE = 1000  # levels whose beginnings are looked at
MEMORY_STEPS = 64  # that a memory has room for, until `with_room` makes room again


def first_after(args: RunArgs) -> int:
    """Return the first level after those that a script's arguments train on."""
    return args.start_level + args.num_levels


def are_trained_on(args: RunArgs, first: int, levels: int) -> bool:
    """Return whether a script's arguments train on any of so many levels from `first` on; without a limit, on none."""
    return max(first, args.start_level) < min(first + levels, first_after(args))


def evaluation_levels(
    args: RunArgs, levels: int, repeats: int = REPEATS, first: int | None = None, new: bool = False
) -> list[int]:
    """Return the seeds (N,) of an evaluation's levels, with repeats: from `first`, or those that follow the
    training's.

    new: only `new_levels`, which may raise ValueError.
    """
    first = first_after(args) if first is None else first
    numbers = new_levels(args, levels, first) if new else range(first, first + levels)
    return [level for level in numbers for _ in range(repeats)]


@functools.cache  # 100,000 levels take ten seconds, and agents share them
def beginnings(env_id: str, env_options: str, first: int, count: int) -> tuple[bytes, ...]:
    """Return what so many levels from `first` on begin with: all that `oracle()` of the Memory Gym environments tells.

    That is path, commands, coins and places. Raises ValueError for other environments.
    """
    if not is_memory_gym(env_id):
        raise ValueError(f"--new-levels: {env_id} does not tell what a level holds")
    envs = make_envs(env_id, AT_ONCE, options=parse_options(env_id, env_options), obs_type="vector")
    found = []
    while len(found) < count:
        envs.reset(seed=[first + len(found) + lane for lane in range(AT_ONCE)])
        told = [part for name, part in envs.unwrapped.oracle().items() if name != "seed"]  # as wide for all levels
        found += [b"|".join(part[lane].tobytes() for part in told) for lane in range(AT_ONCE)]
    envs.close()
    return tuple(found[:count])


def count_trained_on(args: RunArgs, first: int, levels: int) -> int:
    """Return how many of so many levels from `first` on begin as one of the training's.

    Raises ValueError as `beginnings` does.
    """
    task = args.env_id, args.env_options
    trained_on = set(beginnings(*task, args.start_level, args.num_levels))
    return sum(each in trained_on for each in beginnings(*task, first, levels))


def new_levels(args: RunArgs, count: int, first: int) -> list[int]:
    """Return the first `count` levels from `first` on that begin as none of a training's levels does.

    Raises ValueError as `beginnings` does, for a training without a limit, and where of 1,000 levels none is new.
    """
    if not args.num_levels:
        raise ValueError("--new-levels: with --num-levels 0, a training may have met any level")
    task = args.env_id, args.env_options
    trained_on = set(beginnings(*task, args.start_level, args.num_levels))
    found, at = [], first
    while len(found) < count:
        fresh = [at + n for n, each in enumerate(beginnings(*task, at, AT_ONCE)) if each not in trained_on]
        if not fresh:
            raise ValueError(f"--new-levels: levels {at} to {at + AT_ONCE - 1} all begin as some of the training do")
        found, at = found + fresh, at + AT_ONCE
    return found[:count]


def make_agent(kind: type[nn.Module], envs: VectorEnv, infos: dict, args: RunArgs) -> nn.Module:
    """Make an agent, of a script's Agent, for environments; infos are those of a reset.

    Raises ValueError for spaces that do not suit, RunError if there is no ground truth to estimate.
    """
    truth = ground_truth_of(infos, args)
    size = 0 if truth is None else truth.shape[1]
    return kind(envs.single_observation_space, envs.single_action_space.nvec.tolist(), args, size)


def with_room(memory: nn.Module, state: Any, step: int) -> Any:
    """Return an agent's memory state with room for an episode's step, however many came before."""
    return memory.begin_rollout(memory.carry(state), MEMORY_STEPS) if step and step % MEMORY_STEPS == 0 else state


@torch.no_grad()
def evaluate(
    agent: nn.Module,
    envs: VectorEnv,
    levels: list[int],
    max_steps: int,
    *,
    amp: bool = False,
    deterministic: bool = False,
) -> dict[str, np.ndarray]:
    """Play each of the levels (N,) in an environment of its own, with the stochastic policy (§6.1.3).

    With deterministic, actions are the most probable ones.

    Returns metrics (N,) by name: return, length, finished (0 for an episode that max_steps cut short), and every number
    in an episode's final info, NaN where an episode did not report it. The memory begins empty.
    """
    device = next(agent.parameters()).device
    obs, _ = envs.reset(seed=levels)
    playing = np.ones(len(levels), bool)
    metrics = {"return": np.zeros(len(levels)), "length": np.zeros(len(levels))}
    with report_unusable_policy(), torch.autocast(device.type, torch.bfloat16, enabled=amp):
        memory = agent.memory.begin_rollout(agent.memory.initial(len(levels), device), MEMORY_STEPS)
        for t in range(max_steps):
            memory = with_room(agent.memory, memory, t)
            actions, *_ = agent.get_action_and_value(as_tensors(obs, device), memory, deterministic)
            with torch.autocast(device.type, enabled=False):  # for environments that compute with torch
                obs, rewards, terminated, truncated, infos = envs.step(actions.cpu().numpy())
            done = terminated | truncated
            agent.memory.reset(memory, torch.as_tensor(done))
            metrics["return"] += rewards * playing
            metrics["length"] += playing
            for name, values in final_numbers(infos, done & playing).items():
                if name not in ("return", "length", "finished"):  # counted here; the environment's own are ignored
                    now = np.isfinite(values)
                    metrics.setdefault(name, np.full(len(levels), np.nan))[now] = values[now]
            playing &= ~done
            if not playing.any():
                break
    return metrics | {"finished": 1.0 - playing}


def level_scores(args: RunArgs, agent: nn.Module, envs: VectorEnv) -> dict[str, Tensor]:
    """Return an evaluation's metrics by name, (--eval-levels, REPEATS) float64: every episode on every level.

    Training goes on as if there had been none, unless an environment of another package takes random numbers from
    NumPy's or Python's global generator. A metric is left out if some episodes lack it: what is reported only at an
    episode's end is missing where --eval-max-steps cut the episode short.
    """
    device = next(agent.parameters()).device
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(args.seed)
        levels = evaluation_levels(args, args.eval_levels)
        metrics = evaluate(agent, envs, levels, args.eval_max_steps, amp=args.amp)
    incomplete = [name for name, values in metrics.items() if np.isnan(values).any()]
    for name in incomplete:
        tell_incomplete(name)
    complete = {name: torch.from_numpy(values) for name, values in metrics.items() if name not in incomplete}
    return {name: values.unflatten(0, (-1, REPEATS)) for name, values in complete.items()}


@functools.cache
def tell_incomplete(name: str) -> None:
    """Say, once, that evaluations leave a metric out."""
    tell(f"\nevaluations leave out {name}: not all of their episodes report it")
