"""How fast the scripts train, beside the bounds that the encoder alone would allow.

    python benchmarks/train_sps.py --num-steps 128 512

A bound of an iteration is a part of the encoder and nothing else: forward on every step of the rollout, then forward
and backward on every step of every epoch, in pieces of the best size. One bound is the three convolutions, the other
these and the layer from their 3,136 features to the memory's width. A script's iteration is all it does: environments,
memory, heads, losses and optimizer. All are timed in turn, several times, and the medians divided, because a machine's
speed changes from minute to minute.

On a CPU, a script encodes equal observations of a minibatch once, and may overtake a bound where there are many:
`distinct` is the share of an update's observations that it encodes, under a policy that has learned next to nothing.
What a fast path brings is the ratio of two runs, one of them --without it.
"""

import importlib
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import gymnasium as gym
import torch
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this clone, before an installed one

import ppo_gru
from ppo_utils.errors import RunError
from ppo_utils.flags import PositiveInt, check_bounds
from ppo_utils.runs import close, parse_args
from ppo_utils.terminal import one_line_exit


@dataclass
class Config:
    """What to measure."""

    script: str = "ppo_gru"
    """the script, without .py"""
    env_id: str = "MortarMayhem-Grid-v0"
    """a Memory Gym id with pixels"""
    num_envs: PositiveInt = 32
    """lanes"""
    num_steps: list[int] = field(default_factory=lambda: [128, 512])
    """steps of a rollout, a table row each"""
    rounds: PositiveInt = 3
    """how often bound and script are timed in turn"""
    chunks: list[int] = field(default_factory=lambda: [64, 128, 256, 512])
    """sizes of piece that the bound may choose from"""
    flags: str = ""
    """further flags of the script in one argument, e.g. --flags='--memory lstm'"""
    without: list[Literal["packed_gru", "first_occurrences", "in_chunks", "Muon"]] = field(default_factory=list)
    """fast paths of ppo_utils/fast.py that the script does without"""


def padded_gru(rnn: torch.nn.GRU, x: torch.Tensor, lengths: torch.Tensor, hidden: torch.Tensor) -> torch.Tensor:
    """Compute what `packed_gru` does with the library's GRU, over padded sequences."""
    pieces = ppo_gru.Pieces(torch.zeros_like(lengths), lengths, 1)
    return pieces.unpad(rnn(pieces.pad(x), hidden.transpose(0, 1).contiguous())[0])


PLAIN = {  # what each fast path replaces
    "packed_gru": padded_gru,
    "first_occurrences": lambda obs: None,
    "in_chunks": lambda network, x: network(x),
    "Muon": torch.optim.Muon,
}


def seconds(work: Callable[[], None], device: torch.device) -> float:
    """Time one call, the device's queue included."""
    start = time.perf_counter()
    work()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start


def bound_iteration(network: torch.nn.Module, args, device: torch.device, chunk: int) -> Callable[[], None]:
    """Return a function that does the network's work of one iteration and nothing else, in pieces of chunk frames."""
    network = network.to(device)
    frames = torch.randint(0, 256, (max(chunk, args.num_envs), 84, 84, 3), dtype=torch.uint8, device=device)

    def iteration() -> None:
        with torch.no_grad():
            for _ in range(args.num_steps):
                network(frames[: args.num_envs])
        for _ in range(args.update_epochs * args.num_envs * args.num_steps // chunk):
            network.zero_grad()
            network(frames[:chunk]).sum().backward()

    return iteration


def one_iteration(script: ModuleType, args: Any, run: Any) -> None:
    """Train for an iteration, the first of the run again."""
    run.step = 0
    script.train(args, run)


def measure(config: Config, num_steps: int) -> tuple[dict[str, float], float, int]:
    """Return the steps/s of the script and of both bounds, the share of distinct pictures, and the best piece."""
    script = importlib.import_module(config.script)
    for name in config.without:
        if not hasattr(script, name):
            raise ValueError(f"{config.script} has no {name}; leave it out of --without")
        setattr(script, name, PLAIN[name])
    flags = f"--env-id {config.env_id} --num-envs {config.num_envs} --num-steps {num_steps} {config.flags}"
    args = parse_args(script.Args, script.PRESETS, flags.split())
    args.total_timesteps = config.num_envs * num_steps  # of one call of train
    args.checkpoint_interval = 0
    short = replace(args, num_steps=32)
    run = script.setup(args)
    if not run.agent.encoder.cnns:
        close(run)
        raise ValueError("the bounds are those of convolutions; choose an environment and flags with images")
    device = run.device
    cnn = script.AtariCNN(3)
    encoder = torch.nn.Sequential(cnn, torch.nn.Linear(3136, run.agent.memory.width), torch.nn.ReLU())
    trials = {chunk: bound_iteration(cnn, short, device, chunk) for chunk in config.chunks}
    best = min(trials, key=lambda chunk: min(seconds(trials[chunk], device) for _ in range(3)))
    work = {
        "script": partial(one_iteration, script, args, run),
        "convolutions": bound_iteration(cnn, args, device, best),
        "encoder": bound_iteration(encoder, args, device, best),
    }
    work["script"]()  # the first iteration allocates
    times, encoded = {name: [] for name in work}, []
    cnn = run.agent.encoder.cnns[0]
    cnn.register_forward_pre_hook(lambda _, inputs: encoded.append(len(inputs[0]) * torch.is_grad_enabled()))
    for _ in range(config.rounds):
        for name, iteration in work.items():
            times[name].append(seconds(iteration, device))
    close(run)
    steps = config.num_envs * num_steps
    distinct = sum(encoded) / (config.rounds * args.update_epochs * steps)
    return {name: steps / statistics.median(taken) for name, taken in times.items()}, distinct, best


def main(config: Config) -> None:
    """Print a Markdown table, a row per rollout length. Raises ValueError, and what a script's `setup` raises."""
    check_bounds(config)
    if min(config.chunks, default=0) < 1:
        raise ValueError(f"--chunks is {' '.join(map(str, config.chunks)) or 'empty'}; give sizes of 1 frame or more")
    print(f"{config.script} on {config.env_id} {config.flags}, {torch.get_num_threads()} threads\n")
    print("| lanes x steps | steps/s | distinct | convolutions alone | share | encoder alone | share | best piece |")
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)  # the run folders go there
        for num_steps in config.num_steps:
            rates, distinct, chunk = measure(config, num_steps)
            bounds = [
                f"{rates[name]:.0f} | {rates['script'] / rates[name]:.2f}" for name in ("convolutions", "encoder")
            ]
            row = [f"{config.num_envs} x {num_steps}", f"{rates['script']:.0f}", f"{distinct:.2f}", *bounds, str(chunk)]
            print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    with one_line_exit(ValueError, OSError, ImportError, gym.error.Error, RunError):
        main(tyro.cli(Config))
