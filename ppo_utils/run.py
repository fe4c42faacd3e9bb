"""What a training run consists of, from its environments to its progress bar."""

from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import gymnasium as gym
import torch
from torch import nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from ppo_utils.moments import ReturnScale


@dataclass
class Run:
    """All that training needs, made by `prepare`, a script's `setup` and `open_run`."""

    script: str  # the name of the script
    device: torch.device
    checkpoint: dict[str, Any] | None  # that --resume goes on from
    envs: gym.vector.VectorEnv
    started_in: Path  # the folder
    threads: int  # of torch, when this began
    agent: nn.Module | None = None
    optimizers: list[torch.optim.Optimizer] = field(default_factory=list)
    carry: Any = None  # a script's Carry, what the next rollout goes on with
    return_scale: ReturnScale = field(default_factory=ReturnScale)  # for --norm-reward
    folder: Path = Path()  # named by `open_run`
    eval_envs: gym.vector.VectorEnv | None = None
    lock: IO | None = None  # a locked file, which tells other processes that the folder is in use
    writer: SummaryWriter | None = None  # in the first process only, like the progress bar
    bar: tqdm | None = None
    iteration: int = 0  # the current one, from 1
    step: int = 0  # so far, of all environments together
    seconds: float = 0.0  # of training, without evaluations
    returns: deque = field(default_factory=lambda: deque(maxlen=100))  # of the last episodes, for the progress bar
    lengths: deque = field(default_factory=lambda: deque(maxlen=100))
    received_signal: int = 0  # number of the signal (SIGINT or SIGTERM) that this process got, or 0
    stop: bool = False  # a process got one: this iteration is the last
    scores: dict[str, torch.Tensor] = field(default_factory=dict)  # of the last evaluation, see `level_scores`
