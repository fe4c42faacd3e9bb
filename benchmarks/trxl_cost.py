"""What the Transformer-XL memory costs: resident memory, the memory's own share, and a step's time by window.

    python benchmarks/trxl_cost.py [--num-steps 512] [--windows 64 256 1024]

Plays one iteration of the thesis' settings in an environment with long episodes. The memory's own share is what a
rollout stores, the cache, and what its blocks keep of a minibatch for the backward pass. A step's time is that of the
memory alone, as the agent plays, once its window is full; the attention's is measured apart.
"""

import os
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import torch
import torch.nn.functional as F
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this clone, before an installed one

import ppo_trxl
from ppo_utils.errors import RunError
from ppo_utils.flags import PositiveInt, check_bounds
from ppo_utils.runs import close
from ppo_utils.terminal import one_line_exit


@dataclass
class Config:
    """What to measure."""

    env_id: str = "MortarMayhem-v0"
    """an id whose episodes are long"""
    num_steps: PositiveInt = 512
    """steps of a rollout"""
    windows: tuple[int, ...] = (64, 256, 1024)
    """windows to time a step with"""
    repeats: PositiveInt = 40
    """steps to take the median of"""


def megabytes(tensors: list[torch.Tensor]) -> float:
    """Return the size of the tensors' storages, each counted once, in units of 10^6 bytes."""
    storages = {tensor.untyped_storage().data_ptr(): tensor.untyped_storage().nbytes() for tensor in tensors}
    return sum(storages.values()) / 1e6


def kept_for_backward(run, args: ppo_trxl.Args) -> list[torch.Tensor]:
    """Return what the blocks keep of a minibatch for the backward pass."""
    kept: list[torch.Tensor] = []

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        kept.append(tensor)
        return tensor

    memory = run.agent.memory
    rollout, *_ = ppo_trxl.collect(run.agent, run.envs, run.carry, args)
    minibatch = next(memory.cut(rollout.done).minibatches(args.num_minibatches))
    x = torch.randn(int(minibatch.length.sum()), memory.width, requires_grad=True)
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        memory.unroll(rollout.memory_state, x, minibatch)
    weights = {parameter.untyped_storage().data_ptr() for parameter in memory.parameters()}
    return [tensor for tensor in kept if tensor.untyped_storage().data_ptr() not in weights]


def shares(config: Config) -> None:
    """Print the resident memory after an iteration, on Linux, and the memory's own share."""
    import resource  # which Windows does not have

    steps = {"num_steps": config.num_steps, "total_timesteps": 32 * config.num_steps}
    args = ppo_trxl.Args(env_id=config.env_id, cuda=False, **steps)
    run = ppo_trxl.setup(args)
    ppo_trxl.train(args, run)
    resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6  # kilobytes on Linux
    memory = run.agent.memory.begin_rollout(run.carry.memory, args.num_steps)
    kept = kept_for_backward(run, args)
    close(run)
    rows = {
        "highest resident memory, all in all": resident,
        "stored hidden states": megabytes([memory.hidden, memory.row_step]),
        "cache of keys and values": megabytes([*memory.keys, *memory.values]),
        "kept of a minibatch for the backward pass": megabytes(kept),
    }
    print(f"{config.env_id}, 32 x {config.num_steps}, window {args.trxl_memory_length}\n\n| memory | MB |\n|---|---:|")
    for name, size in rows.items():
        print(f"| {name} | {size:,.0f} |")


@torch.no_grad()
def step_times(config: Config, window: int) -> tuple[float, float]:
    """Return the median seconds of a step of the memory with a full window, and of its attention alone."""
    args = ppo_trxl.Args(trxl_memory_length=window, num_steps=config.repeats)
    memory = ppo_trxl.Memory(args, args.trxl_dim)
    fresh = memory.initial(args.num_envs, torch.device("cpu"))
    state = memory.begin_rollout(fresh | {"episode_step": fresh["episode_step"] + window}, args.num_steps)
    x = torch.randn(args.num_envs, memory.width)
    split = memory.blocks[0].attention.split
    step, attention = [], []
    for _ in range(config.repeats):
        start = time.perf_counter()
        _, hidden = memory.step(state, x)
        memory.advance(state, hidden)
        step.append(time.perf_counter() - start)
        key_columns, _, mask = ppo_trxl.attended_keys(state.episode_step[:, None], window, x.device)
        rows = slice(state.now - len(key_columns), state.now)
        start = time.perf_counter()
        for keys, values in zip(state.keys, state.values, strict=True):
            F.scaled_dot_product_attention(
                split(x[:, None]), split(keys[:, rows]), split(values[:, rows]), mask[:, None]
            )
        attention.append(time.perf_counter() - start)
    return statistics.median(step), statistics.median(attention)


def main(config: Config) -> None:
    """Print both tables. Raises ValueError, and what a script's `setup` raises."""
    check_bounds(config)
    for window in config.windows:
        check_bounds(ppo_trxl.Args(trxl_memory_length=window))
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)  # the run folder goes there
        shares(config)
    print("\n| window | memory's step, ms | its attention, ms | the rest, ms |\n|---:|---:|---:|---:|")
    for window in config.windows:
        step, attention = (1000 * seconds for seconds in step_times(config, window))
        print(f"| {window:,} | {step:.1f} | {attention:.1f} | {step - attention:.1f} |")


if __name__ == "__main__":
    with one_line_exit(ValueError, OSError, ImportError, gym.error.Error, RunError):
        main(tyro.cli(Config))
