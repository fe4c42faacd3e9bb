"""Evaluation: agents play levels that they are not trained on (§6.1.3 of the thesis).

Shape letters: N environments, one for each episode.
"""

from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import nn

from ppo_utils.environments import as_tensors, final_numbers

REPEATS = 3  # times that each level is played


def evaluation_levels(args: Any, levels: int, repeats: int = REPEATS) -> list[int]:
    """Return the seeds (N,) of an evaluation's levels: those that follow the training levels, with repeats."""
    first = args.start_level + args.num_levels
    return [level for level in range(first, first + levels) for _ in range(repeats)]


@torch.no_grad()
def evaluate(
    agent: nn.Module, envs: VectorEnv, levels: list[int], max_steps: int, amp: bool = False, memory_steps: int = 64
) -> dict[str, np.ndarray]:
    """Play each of the levels (N,) in an environment of its own, with the stochastic policy (§6.1.3).

    Returns metrics (N,) by name: return, length, finished (0 for an episode that max_steps cut short), and every number
    in an episode's final info, NaN where an episode did not report it. The memory begins empty, and has room for
    memory_steps steps at a time.
    """
    device = next(agent.parameters()).device
    obs, _ = envs.reset(seed=levels)
    memory = agent.memory.initial_state(len(levels), memory_steps, device)
    playing = np.ones(len(levels), bool)
    metrics = {"return": np.zeros(len(levels)), "length": np.zeros(len(levels))}
    with torch.autocast(device.type, torch.bfloat16, enabled=amp):
        for t in range(max_steps):
            if t % memory_steps == 0:
                agent.memory.begin_rollout(memory, agent.memory.carry(memory))
            actions, _, _ = agent.get_action_and_value(as_tensors(obs, device), memory)
            obs, rewards, terminated, truncated, infos = envs.step(actions.cpu().numpy())
            done = terminated | truncated
            agent.memory.reset(memory, torch.as_tensor(done))
            metrics["return"] += rewards * playing
            metrics["length"] += playing
            for name, which, values in final_numbers(infos, done & playing):
                if name not in ("return", "length"):  # counted above; the environment's own of these names are ignored
                    metrics.setdefault(name, np.full(len(levels), np.nan))[which] = values
            playing &= ~done
            if not playing.any():
                break
    return metrics | {"finished": 1.0 - playing}
