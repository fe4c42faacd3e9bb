"""Several processes, started by torchrun, that train one agent: each plays its share of the environments.

They make the same update, since their gradients are averaged; the first one evaluates, logs and writes the files.
"""

import contextlib
import random
from collections.abc import Iterator
from datetime import timedelta
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
import torch.distributed.nn  # imported before the group is made: see `join_processes`
from torch import nn

from ppo_utils.errors import RunError


def join_processes() -> None:
    """Connect to the other processes, if torchrun started this one."""
    if dist.is_torchelastic_launched() and not dist.is_initialized():
        # If an optimizer imported torch.distributed.nn later, that would keep this group, and Gloo's threads with it,
        # until the interpreter ends, where they can abort the process.
        dist.init_process_group(timeout=timedelta(days=1))  # the others wait while the first one evaluates


def leave_processes() -> None:
    """Close the connection to the other processes."""
    if dist.is_initialized():
        dist.destroy_process_group()


def seed_generators(seed: int) -> None:
    """Seed torch's generator, and NumPy's and Python's, which environments of other packages may use."""
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002
    torch.manual_seed(seed)


def rank_and_size() -> tuple[int, int]:
    """Return this process's rank, and how many processes train together: 0 and 1 unless torchrun started them."""
    return (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)


@contextlib.contextmanager
def report_lost_process() -> Iterator[None]:
    """Raise RunError if another process does not answer."""
    try:
        yield
    except torch.OutOfMemoryError:
        raise
    except RuntimeError as error:  # what Gloo and NCCL raise
        raise RunError("another process of this run has ended; its own output says why") from error


def all_gather(value: Any) -> list[Any]:
    """Return the value of every process, in the order of ranks. Raises RunError if one has ended."""
    values = [value] * rank_and_size()[1]
    if dist.is_initialized():
        with report_lost_process():
            dist.all_gather_object(values, value)
    return values


def average_gradients(agent: nn.Module, num_steps: int) -> None:
    """Replace each gradient, a mean over num_steps here, by the mean over the steps of all processes.

    Raises RunError if one has ended.
    """
    if not dist.is_initialized():
        return
    gradients = [parameter.grad for parameter in agent.parameters() if parameter.grad is not None]
    flat = torch.cat([*(gradient.flatten() for gradient in gradients), gradients[0].new_ones(1)]) * num_steps
    with report_lost_process():
        dist.all_reduce(flat)
    means = (flat[:-1] / flat[-1]).split([gradient.numel() for gradient in gradients])
    for gradient, mean in zip(gradients, means, strict=True):
        gradient.copy_(mean.view_as(gradient))  # in place: its memory layout has to stay that of the weight
