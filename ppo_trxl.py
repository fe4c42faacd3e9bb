"""PPO that remembers with a Transformer-XL: an episodic memory that is seen through a sliding window.

    python ppo_trxl.py --env-id MortarMayhem-Grid-v0

The agent gets one observation at a time. Every step leaves an item in the episodic memory: the inputs of the
transformer's blocks. Each block of a later step attends to the items of the last --trxl-memory-length steps of the
episode. Items are stored without gradient, computed with the weights that acted. --trxl-memory-gradient computes those
of the same segment again, with gradient; --refresh-memory computes those of the rollout again, without gradient, before
each epoch but the first.

A window is never gathered for every query. While acting, each item is projected to its key and value once, into a cache
that is computed again after each update. For the update, the steps of an environment's rollout and the window before
them form a timeline, which is cut into segments of --trxl-segment-length steps. The queries of a segment attend to its
own items and to the window before it, which are projected once per segment, under one band mask: each query sees the
earlier steps of its own episode, as far as the window reaches.

Source: "Memory-based Deep Reinforcement Learning in Endless Imperfect Information Games", called the thesis below.
§5.3 is its section, (5.7) its equation; defaults are the "Final" column of its table 6.1.

How to read: sections 1 to 6 from top to bottom are the algorithm. The memory is section 4; with another one, sections
2, 3 and 5 to 8 stay as they are. What evaluates (7), what runs a training (8: run folder, files, command line) and what
only makes it faster (9) may be skipped.

Shape letters: T steps of a rollout, N environments, A action branches, B samples of a minibatch, S segments of a
minibatch, L steps of the longest, W window, M items that a segment looks at, K blocks, H heads, I inputs and D width of
the memory, F features, G entries of the ground truth, V entries of a vector.
"""

import argparse
import contextlib
import io
import itertools
import math
import os
import random
import signal
import sys
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TextIO, get_args, get_origin, get_type_hints

import gymnasium as gym
import numpy as np
import torch
import torch.distributed as dist
import torch.distributed.nn  # see `setup`
import torch.nn.functional as F
import tyro
from torch import Tensor, nn
from torch.distributions import Categorical
from torch.nn.utils.rnn import pad_sequence
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

try:
    import fcntl
except ImportError:  # Windows has no such locks
    fcntl = None

from memory_gym_envs.making import (
    LaneVideo,
    check_can_film,
    final_numbers,
    final_observations,
    load_state,
    make_envs,
    parse_options,
    save_state,
)


# ---- 1 ARGS ----
class Bounds(NamedTuple):
    """What a number on the command line may be: --help shows it, and `check_args` enforces it."""

    text: str
    allow: Callable[[float], bool]


def bounded(kind: type, text: str, allow: Callable[[float], bool]) -> Any:
    """Return the type of a flag with bounds."""
    return Annotated[kind, Bounds(text, allow), tyro.conf.arg(metavar=f"{kind.__name__.upper()} ({text})")]


PositiveInt = bounded(int, "1 or more", lambda x: x >= 1)
NonNegativeInt = bounded(int, "0 or more", lambda x: x >= 0)
PositiveFloat = bounded(float, "above 0", lambda x: x > 0)
NonNegativeFloat = bounded(float, "0 or more", lambda x: x >= 0)
UnitInterval = bounded(float, "0 to 1", lambda x: 0 <= x <= 1)


@dataclass
class Args:
    """Train a PPO agent with a Transformer-XL memory."""

    exp_name: str = "ppo_trxl"
    """name of the experiment, part of the run folder's name"""
    preset: Literal["thesis", "laptop"] = "thesis"
    """a set of defaults (`PRESETS`) that the command line begins with; flags that are given win over it (in Python:
    Args(**PRESETS["laptop"]))"""
    seed: NonNegativeInt = 1
    """seed of the weights, the actions and the environments: same seed, same curves (on the CPU to the last bit)"""
    torch_deterministic: bool = True
    """ask cuDNN for deterministic algorithms"""
    cuda: bool = True
    """train on the GPU when there is one"""
    amp: bool = False
    """compute encoder and decoder, and a transformer, in bfloat16, faster on processors that have it"""
    track: bool = False
    """log to Weights and Biases too (needs the extra `track`)"""
    wandb_project_name: str = "memory-gym-baselines"
    """the project's name at Weights and Biases"""
    wandb_entity: str | None = None
    """the team's name at Weights and Biases"""
    capture_video: bool = False
    """record some episodes of the first environment to the run folder (needs the extra `play`)"""
    save_model: bool = False
    """write weights and arguments to model.pt in the run folder when training ends"""
    load_model: str | None = None
    """start from the weights in this file, written by --save-model"""
    resume: str | None = None
    """go on with the run in this folder from its last checkpoint; other flags may only repeat the run's values, but
    --total-timesteps may be larger"""
    checkpoint_interval: NonNegativeInt = 50
    """iterations between checkpoints; another one is written when training ends or is stopped, and the last two are
    kept (0: no checkpoints)"""
    keep_models: NonNegativeInt = 0
    """number of evenly spaced points of the training at which the weights are kept, as model-STEP.pt"""

    env_id: str = "MortarMayhem-Grid-v0"
    """any Gymnasium id with Discrete or MultiDiscrete actions, with its module if that has to be imported first, e.g.
    minigrid:MiniGrid-MemoryS9-v0"""
    env_options: str = "{}"
    """reset parameters of a Memory Gym environment as JSON, e.g. '{"command_count": [4]}'"""
    num_levels: NonNegativeInt = 100_000
    """number of levels that a Memory Gym environment trains on (0: no limit)"""
    start_level: NonNegativeInt = 0
    """the first of these levels"""
    obs_type: Literal["pixels", "vector"] = "pixels"
    """what a Memory Gym environment shows: images, or a vector of all that can be seen on them (other environments have
    one kind of observation)"""
    frame_stack: NonNegativeInt = 0
    """observe the last so many images at once, in grayscale, or so many vectors (0: the current one, in colour)"""
    step_encoding: bool = False
    """observe the number of the episode's step too, as a sinusoidal encoding of width 16"""
    observe_last_action: bool = False
    """observe the last action and reward too, as a one-hot vector and a number"""
    spotlight_perturbation: bool = False
    """put a veil over the image, with holes that move as the spotlights of Searing Spotlights do (thesis §7.2)"""
    vector_frequencies: bounded(int, "0 to 16", lambda x: 0 <= x <= 16) = 0
    """number of frequencies of the Fourier features that the network gets of a vector with entries from 0 to 1"""

    total_timesteps: PositiveInt = 163_840_000
    """steps to train for, all environments together, rounded down to whole iterations of num_envs x num_steps"""
    num_envs: PositiveInt = 32
    """environments that run in parallel"""
    num_steps: PositiveInt = 512
    """steps of each environment in one rollout"""
    num_minibatches: PositiveInt = 8
    """minibatches of an epoch"""
    update_epochs: PositiveInt = 3
    """passes over each rollout"""
    gamma: UnitInterval = 0.995
    """discount factor"""
    gae_lambda: UnitInterval = 0.95
    """lambda of generalized advantage estimation"""
    refresh_memory: bool = False
    """before every epoch but the first, recompute the memory that the rollout stored, with the current weights; where
    the update reads none of it, only the next rollout starts from other memory (docs/memory.md)"""
    bootstrap_truncated: bool = False
    """value the final observation of an episode that a time limit cut short, instead of counting it as ended"""
    norm_adv: Literal["none", "minibatch", "batch"] = "none"
    """bring the advantages of each minibatch, or of the whole rollout, to mean 0 and standard deviation 1"""
    clip_coef: PositiveFloat = 0.1
    """how far the probability ratio may move from 1, and the value from the rollout's"""
    clip_vloss: bool = True
    """clip the value loss too"""
    vf_coef: NonNegativeFloat = 0.5
    """weight of the value loss"""
    max_grad_norm: PositiveFloat = 0.25
    """a gradient with a larger norm is scaled down to this one"""
    target_kl: PositiveFloat | None = None
    """end an iteration's update at the first minibatch whose KL divergence from the policy that acted exceeds this,
    which is neither learned from nor logged"""
    init_lr: UnitInterval = 2.75e-4
    """learning rate at the first step"""
    final_lr: UnitInterval = 1.0e-5
    """learning rate from step --anneal-steps on"""
    exploration_bonus: Literal["entropy", "log-barrier"] = "entropy"
    """what keeps the policy exploring: its entropy, or the mean log-probability of all actions, which also brings back
    an action whose probability has vanished"""
    init_ent_coef: NonNegativeFloat = 1.0e-4
    """weight of the exploration bonus at the first step"""
    final_ent_coef: NonNegativeFloat = 1.0e-6
    """weight of the exploration bonus from step --anneal-steps on"""
    anneal_steps: NonNegativeInt = 163_840_000
    """steps over which learning rate and exploration bonus decay linearly (0: they keep their initial values)"""
    reconstruction_coef: NonNegativeFloat = 0.0
    """weight of the loss of reconstructing the image from the memory's output (0: off; the thesis has 0.1)"""
    reconstruction_detach: bool = False
    """reconstruct the image without teaching the agent: a probe of what the memory's output tells of it"""
    ground_truth_coef: NonNegativeFloat = 0.0
    """weight of the loss of estimating the environment's ground truth (0: off; the thesis has 0.1)"""
    ground_truth_detach: bool = False
    """estimate the ground truth without teaching the agent: a probe of what its memory holds"""
    embedding: bool = True
    """embed the encoded observation in the memory's width; without, the memory takes it as it is (in ppo_trxl.py
    only if --trxl-dim is its width)"""
    head_size: PositiveInt = 512
    """width of the layer after the memory, and of the heads' own layers"""
    value_init_gain: NonNegativeFloat = 1.0
    """gain of the value's last layer at initialization: below 1, values begin nearer to 0"""

    eval_interval: NonNegativeInt = 0
    """iterations from one evaluation to the next, and one at the end, on levels that are not trained on (0: none)"""
    eval_levels: PositiveInt = 50
    """levels of an evaluation, from start_level + num_levels on"""
    eval_repeats: PositiveInt = 3
    """times that an evaluation plays each level"""
    eval_max_steps: PositiveInt = 10_000
    """steps after which an evaluation cuts an endless episode short"""

    trxl_num_layers: PositiveInt = 3
    """blocks of the transformer"""
    trxl_num_heads: PositiveInt = 4
    """attention heads of a block"""
    trxl_dim: PositiveInt = 384
    """width of the blocks"""
    trxl_memory_length: PositiveInt = 256
    """window: how many steps an agent looks back at, at most (never further than its episode's first)"""
    trxl_positional_encoding: Literal["absolute", "learned", "relative", "none"] = "absolute"
    """what tells the order of the steps that are looked back at"""
    trxl_query_position: bool = False
    """add the encoding of its own step to the first block's query: the learned one, or else the absolute one"""
    trxl_query_output: bool = False
    """add a projection of the last block's output of the step before to the first block's query, without gradient"""
    trxl_pe_length: PositiveInt = 2048
    """longest episode that a learned encoding is made for"""
    trxl_segment_length: PositiveInt = 128
    """steps of one environment that the update computes at once; minibatches are made of such segments"""
    trxl_memory_gradient: bool = False
    """let the gradient flow through the block inputs of a segment's earlier steps, computed again in the update, where
    stored ones are detached"""
    trxl_init: Literal["xavier", "orthogonal", "kaiming", "tfixup"] = "xavier"
    """how the blocks' weights are initialized"""
    trxl_layer_norm: Literal["pre", "post"] = "pre"
    """where a block normalizes: before attention and projection, or after each is merged with its input"""
    trxl_gate: Literal["none", "gru"] = "none"
    """what merges a layer's output with its input: residual connections (TrXL) or gates (GTrXL)"""
    trxl_gate_bias: bounded(float, "a finite number", math.isfinite) = 0.0
    """above 0 a gate mostly keeps the layer's input at first, not its output"""


PRESETS = {
    "thesis": {},  # the defaults above
    "laptop": {
        "obs_type": "vector",
        "trxl_num_layers": 2,
        "trxl_dim": 64,
        "trxl_memory_length": 128,
        "trxl_query_position": True,
        "trxl_memory_gradient": True,
        "head_size": 128,
        "num_steps": 128,
        "update_epochs": 4,
        "gamma": 0.99,
        "clip_coef": 0.2,
        "max_grad_norm": 0.5,
        "target_kl": 0.05,
        "init_lr": 1e-3,
        "final_lr": 1e-4,
        "exploration_bonus": "log-barrier",
        "init_ent_coef": 5e-4,
        "final_ent_coef": 5e-5,
        "anneal_steps": 1_000_000,
        "total_timesteps": 1_000_000,
    },
}
# What shapes the network; an error message names these if weights do not fit.
OBSERVATION_FLAGS = ("env_id", "obs_type", "frame_stack", "step_encoding", "observe_last_action", "vector_frequencies")
BLOCK_FLAGS = (
    "trxl_num_layers",
    "trxl_num_heads",
    "trxl_dim",
    "trxl_positional_encoding",
    "trxl_query_output",
    "trxl_pe_length",
    "trxl_layer_norm",
    "trxl_gate",
)
NETWORK_FLAGS = (*OBSERVATION_FLAGS, "embedding", "head_size", *BLOCK_FLAGS)
# Flags that change nothing unless another one has one of these values.
NEEDS = {"trxl_gate_bias": ("trxl_gate", ("gru",)), "trxl_pe_length": ("trxl_positional_encoding", ("learned",))}


def memory_width(args: Args) -> int:
    """Return the width that the encoded observation is embedded in."""
    return args.trxl_dim


def longest_piece(args: Args) -> int:
    """Return how many steps a piece of a rollout, see `Pieces`, may have."""
    return min(args.trxl_segment_length, args.num_steps)


# ---- 2 PPO ----
def anneal(step: int, initial: float, final: float, anneal_steps: int) -> float:
    """Decay linearly from initial to final over anneal_steps, then stay; without anneal_steps stay at initial."""
    fraction = min(step / anneal_steps, 1.0) if anneal_steps else 0.0
    return initial + fraction * (final - initial)


def gae(
    rewards: Tensor,
    values: Tensor,
    last_value: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    truncation_values: Tensor,
    gamma: float,
    gae_lambda: float,
) -> Tensor:
    """Return the advantages (T, N) of generalized advantage estimation (2.34), cut wherever an episode ends.

    last_value (N,) is the value of the observation after the last step. truncation_values (T, N) holds the value of
    the final observation where a truncated episode is bootstrapped and zero elsewhere; a terminated one never is.
    """
    done = terminated | truncated
    next_values = torch.cat([values[1:], last_value[None]])  # (T, N)
    next_values = torch.where(done, truncation_values * ~terminated, next_values)
    deltas = rewards + gamma * next_values - values
    decay = gamma * gae_lambda * ~done
    advantages = torch.empty_like(deltas)
    advantage = torch.zeros_like(last_value)
    for t in reversed(range(len(deltas))):
        advantages[t] = advantage = deltas[t] + decay[t] * advantage
    return advantages


def normalize(x: Tensor) -> Tensor:
    """Return x with mean 0 and standard deviation 1."""
    return (x - x.mean()) / (x.std(correction=0) + 1e-8)


def policy_loss(log_ratio: Tensor, advantages: Tensor, clip_coef: float) -> Tensor:
    """Return the clipped surrogate loss (2.41) of log_ratio (B, A): its mean over branches (5.4) and samples."""
    ratio = log_ratio.exp()
    advantages = advantages[:, None]
    clipped = ratio.clamp(1 - clip_coef, 1 + clip_coef)
    return -torch.minimum(ratio * advantages, clipped * advantages).mean()


def value_loss(values: Tensor, old_values: Tensor, returns: Tensor, clip_coef: float | None) -> Tensor:
    """Return the mean squared error of values (B,), clipped around old_values (2.43) unless clip_coef is None.

    There is no factor 1/2, which CleanRL has.
    """
    loss = (values - returns).square()
    if clip_coef is not None:
        clipped = old_values + (values - old_values).clamp(-clip_coef, clip_coef)
        loss = torch.maximum(loss, (clipped - returns).square())
    return loss.mean()


def log_barrier(policy: list[Categorical]) -> Tensor:
    """Return the mean log-probability of all actions, not only of those taken: over samples, summed over branches.

    It is largest for a uniform policy. Where an action's probability is near 0, the gradients of the surrogate loss and
    of the entropy are near 0 too; that of the log barrier is not (Agarwal et al., On the Theory of Policy Gradient
    Methods, 2021).
    """
    return sum(branch.logits.mean() for branch in policy)  # a Categorical's logits are normalized


def reconstruction_loss(logits: Tensor, pixels: Tensor) -> Tensor:
    """Return the mean binary cross-entropy (5.5) of logits and pixels, (B, height, width, channels) each."""
    return F.binary_cross_entropy_with_logits(logits, pixels / 255 if pixels.dtype == torch.uint8 else pixels)


@torch.no_grad()
def policy_metrics(log_ratio: Tensor, clip_coef: float) -> dict[str, Tensor]:
    """Return what to log of log_ratio (B, A): how far the policy has moved from the rollout's."""
    deviation = log_ratio.exp() - 1
    joint = log_ratio.sum(-1)  # the branches are independent: log-ratios add up
    return {
        "old_approx_kl": -joint.mean(),
        "approx_kl": (joint.exp() - 1 - joint).mean(),  # http://joschu.net/blog/kl-approx.html
        "clipfrac": (deviation.abs() > clip_coef).float().mean(),
        "ratio_error": deviation.abs().max(),
    }


def explained_variance(values: Tensor, returns: Tensor) -> float:
    """Return the share of the returns' variance that the values explain; NaN if the returns do not vary."""
    variance = returns.var().item()
    return 1 - (returns - values).var().item() / variance if variance > 0 else math.nan


@dataclass
class Pieces:
    """Runs of consecutive steps of one environment each, which minibatches are made of.

    A memory decides where a rollout is cut: a recurrent one into sequences, at the ends of episodes; a transformer into
    segments of the same length. A rollout's tensors are (T, N, ...); flattened, step t of environment n has the index
    t * N + n. Two environments, five steps, and an episode of environment 0 that ends after t = 2, cut into sequences:

        flat indices   t = 0  1  2  3  4        pieces         first   length
        environment 0      0  2  4 |6  8        0  2  4          0       3
        environment 1      1  3  5  7  9        6  8             6       2
                                                1  3  5  7  9    1       5

    flat_index() lists the steps of all pieces, (B,): 0 2 4 6 8 1 3 5 7 9. What belongs to them, x (B, D), is padded
    for a network that runs over time, pad(x) (S, L, D), and unpad takes the padding away again:

        x0  x2  x4  0   0
        x6  x8  0   0   0
        x1  x3  x5  x7  x9
    """

    first: Tensor  # (S,) flat index of each piece's first step
    length: Tensor  # (S,) number of its steps; both on the CPU, since shapes depend on them
    num_envs: int  # N

    @classmethod
    def from_starts(cls, starts: Tensor) -> "Pieces":
        """Make pieces that begin at every step where starts (T, N) is true, as it is at t = 0."""
        num_steps, num_envs = starts.shape
        cuts = starts.T.flatten().nonzero()[:, 0]  # environment after environment: n * T + t
        length = torch.diff(cuts, append=torch.tensor([num_steps * num_envs]))
        n, t = cuts // num_steps, cuts % num_steps
        return cls(t * num_envs + n, length, num_envs)

    def columns(self) -> Tensor:
        """Return the column indices 0 .. L - 1 of a padded batch."""
        return torch.arange(int(self.length.max()))

    def is_step(self) -> Tensor:
        """Return the mask (S, L) of a padded batch: true at steps, false at padding."""
        return self.columns() < self.length[:, None]

    def flat_index(self) -> Tensor:
        """Return the flat indices (B,) of all steps, piece after piece."""
        return (self.first[:, None] + self.columns() * self.num_envs)[self.is_step()]

    def pad(self, x: Tensor) -> Tensor:
        """Pad what belongs to the steps, (B, D), with zeros to the longest piece: (S, L, D)."""
        return pad_sequence(x.split(self.length.tolist()), batch_first=True)

    def unpad(self, y: Tensor) -> Tensor:
        """Take the padding away: (S, L, ...) to (B, ...)."""
        steps = self.is_step().flatten().nonzero()[:, 0]  # found on the CPU: a mask would make a GPU wait
        return y.flatten(0, 1).index_select(0, steps.to(y.device))

    def minibatches(self, count: int) -> Iterator["Pieces"]:
        """Shuffle the pieces, and distribute them, whole, over count minibatches of about the same number of steps."""
        order = torch.randperm(len(self.first))
        first, length = self.first[order], self.length[order]
        # (S,) the minibatch of each piece, by the position of its first step. No minibatch is empty: `check_args` makes
        # sure that no piece is longer than a minibatch's share of the steps.
        minibatch = (length.cumsum(0) - length) * count // length.sum()
        sizes = minibatch.bincount(minlength=count).tolist()
        for mb_first, mb_length in zip(first.split(sizes), length.split(sizes), strict=True):
            yield Pieces(mb_first, mb_length, self.num_envs)


# ---- 3 ENCODERS AND HEADS ----
def layer_init(layer: nn.Module, gain: float = math.sqrt(2)) -> nn.Module:
    """Initialize a layer's weights orthogonally and its biases with zero; return it."""
    for name, parameter in layer.named_parameters():
        if "bias" in name:
            nn.init.zeros_(parameter)
        else:
            nn.init.orthogonal_(parameter, gain)
    return layer


class AtariCNN(nn.Sequential):
    """The convolutions of Mnih et al. (2015), table 6.2."""

    def __init__(self, channels: int):
        super().__init__(
            layer_init(nn.Conv2d(channels, 32, 8, 4)),
            nn.ReLU(inplace=True),
            layer_init(nn.Conv2d(32, 64, 4, 2)),
            nn.ReLU(inplace=True),
            layer_init(nn.Conv2d(64, 64, 3, 1)),
            nn.ReLU(inplace=True),
        )
        self.to(memory_format=torch.channels_last)  # the order in which the environments deliver pixels

    def forward(self, pixels: Tensor) -> Tensor:
        """Map pixels (B, height, width, channels), uint8 or float in [0, 1], to features (B, F)."""
        scaled = pixels.float().mul_(1 / 255) if pixels.dtype == torch.uint8 else pixels
        features = super().forward(scaled.permute(0, 3, 1, 2))  # (B, channels, height, width)
        return features.permute(0, 2, 3, 1).flatten(1)  # in the order they have in memory: no copy


def fourier_features(x: Tensor, frequencies: int) -> Tensor:
    """Append sines and cosines of x (B, V) at pi, 2 pi, 4 pi ...: (B, V (1 + 2 frequencies)).

    They magnify small differences, so that a network learns sooner to tell values apart (Tancik et al., 2020).
    """
    angles = x[..., None] * (math.pi * 2 ** torch.arange(frequencies, device=x.device))  # (B, V, frequencies)
    return torch.cat([x, angles.sin().flatten(1), angles.cos().flatten(1)], -1)


class Encoder(nn.Module):
    """Encodes each part of an observation, concatenates the features and embeds them in `width` (§5.1), unless None.

    Raises ValueError for frequencies without a vector to take them of.
    """

    def __init__(self, spaces: dict[str, gym.spaces.Box], width: int | None, frequencies: int):
        super().__init__()
        self.frequencies = frequencies
        self.images = [name for name, space in spaces.items() if len(space.shape) == 3]
        self.vectors = [name for name, space in spaces.items() if len(space.shape) == 1]
        self.cnns = nn.ModuleList(AtariCNN(spaces[name].shape[2]) for name in self.images)
        with torch.no_grad():
            blank = [torch.zeros(1, *spaces[name].shape) for name in self.images]
            features = sum(cnn(x).shape[1] for cnn, x in zip(self.cnns, blank, strict=True))
        if self.vectors:
            entries = sum(spaces[name].shape[0] for name in self.vectors)
            self.mlp = layer_init(nn.Linear(entries * (1 + 2 * frequencies), 128))
            features += 128
        elif frequencies:
            raise ValueError("--vector-frequencies needs an observation with a vector; use 0")
        self.width = features if width is None else width
        self.embedding = None if width is None else layer_init(nn.Linear(features, width))

    def forward(self, obs: dict[str, Tensor]) -> Tensor:
        """Encode observations, each part (B, ...), to (B, self.width)."""
        features = [in_chunks(cnn, obs[name]) for cnn, name in zip(self.cnns, self.images, strict=True)]  # section 9
        if self.vectors:
            vector = torch.cat([obs[name] for name in self.vectors], -1)
            features.append(F.relu(self.mlp(fourier_features(vector, self.frequencies))))
        x = torch.cat(features, -1)
        if self.embedding is not None:
            x = F.relu(self.embedding(x))
        return x.float()  # from bfloat16, with --amp


class Heads(nn.Module):
    """The layer after the memory, the multi-discrete policy and the state value (table 6.2)."""

    def __init__(self, width: int, nvec: list[int], size: int, value_gain: float):
        super().__init__()
        self.nvec = nvec  # number of actions of each branch, as Gymnasium calls it
        self.trunk = layer_init(nn.Linear(width, size))
        self.policy = head(size, sum(nvec), 0.1)
        self.value = head(size, 1, value_gain)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map the memory's output (B, D) to the logits of all branches, values (B,) and features (B, F)."""
        with torch.autocast(x.device.type, enabled=False):  # --amp: bfloat16 is too coarse for values and log-ratios
            features = F.relu(self.trunk(x.float()))
            return self.policy(features), self.value(features)[:, 0], features

    def distributions(self, logits: Tensor) -> list[Categorical]:
        """Make the distribution of each branch's action from the logits of all branches."""
        return [Categorical(logits=part, validate_args=False) for part in logits.split(self.nvec, -1)]


def head(size: int, outputs: int, gain: float) -> nn.Sequential:
    """Make a head with a layer of its own."""
    return nn.Sequential(
        layer_init(nn.Linear(size, size)), nn.ReLU(inplace=True), layer_init(nn.Linear(size, outputs), gain)
    )


class Decoder(nn.Sequential):
    """The transposed Atari CNN, which reconstructs the observed image (§5.1.2, table 6.2).

    Raises ValueError unless the observation has one image.
    """

    def __init__(self, features: int, spaces: dict[str, gym.spaces.Box]):
        images = [space.shape for space in spaces.values() if len(space.shape) == 3]
        if len(images) != 1:
            raise ValueError(f"--reconstruction-coef needs an observation with one image, not {len(images)}; use 0")
        height, width, channels = images[0]
        sizes = [(height, width)]  # of the image and of each convolution's output
        for kernel, stride in ((8, 4), (4, 2), (3, 1)):
            sizes.append(tuple((size - kernel) // stride + 1 for size in sizes[-1]))
        # Pixels at the right and lower edge that the encoder's first two strides do not reach.
        output_padding = [
            [(size - kernel) % stride for size in sizes[i]] for i, (kernel, stride) in enumerate(((8, 4), (4, 2)))
        ]
        super().__init__(
            layer_init(nn.Linear(features, 64 * math.prod(sizes[3]))),
            nn.ReLU(inplace=True),
            nn.Unflatten(1, (64, *sizes[3])),
            layer_init(nn.ConvTranspose2d(64, 64, 3, 1)),
            nn.ReLU(inplace=True),
            layer_init(nn.ConvTranspose2d(64, 32, 4, 2, output_padding=output_padding[1])),
            nn.ReLU(inplace=True),
            layer_init(nn.ConvTranspose2d(32, channels, 8, 4, output_padding=output_padding[0]), 1.0),
        )

    def forward(self, features: Tensor) -> Tensor:
        """Map features (B, F) to the logits of images (B, height, width, channels)."""
        return super().forward(features).permute(0, 2, 3, 1)


# ---- 4 MEMORY ----
# Memory(args, inputs) is an nn.Module that maps I inputs to width D; a MemoryState is what it remembers. What the other
# sections use of any memory:
#   initial_state, begin_rollout   the state of fresh episodes; the state made ready for a rollout with new weights
#   step, reset                    take a step, which also stores what the update needs; forget where an episode ended
#   cut, unroll                    cut a rollout into pieces; compute whole pieces at once in the update
#   rewind                         go back to the rollout's first step, to store all of it again (--refresh-memory)
#   logs                           numbers for TensorBoard, averaged over processes (maxima: `combine_processes`)
#   not_saved                      fields of the state that no checkpoint holds
#   width                          D, the width of what comes out
# Section 1 has what is known before it is made: its flags, those in PRESETS, NETWORK_FLAGS and NEEDS, memory_width
# and longest_piece.
def visible(age: Tensor, episode_step: Tensor, window: int) -> Tensor:
    """Return whether a query at this step of its episode sees the item that was stored `age` steps before it.

    The rollout, the bootstrap value and the update all ask this function. `Memory.reach` limits how far back they look,
    never to less than what may be visible.
    """
    return (age >= 1) & (age <= episode_step) & (age <= window)


def sinusoid(position: Tensor, width: int) -> Tensor:
    """Encode positions, steps or ages of any shape, as sines and cosines (2.57, 2.58): (..., width) float64."""
    frequency = 10000 ** (-torch.arange(0, width, 2, dtype=torch.float64, device=position.device) / width)
    angle = position[..., None] * frequency
    return torch.stack([angle.sin(), angle.cos()], -1).flatten(-2)  # (..., width / 2, 2) to (..., width)


class Attention(nn.Module):
    """Multi-head attention (2.55, 2.56) to items that are projected to keys and values elsewhere.

    With relative encoding the scores are those of (2.61), as the thesis has it: unlike in Dai et al. (2019), positions
    are projected to keys as items are, and u and v as queries are.
    """

    def __init__(self, width: int, heads: int, relative: bool):
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width, bias=False)
        self.key = nn.Linear(width, width, bias=False)
        self.value = nn.Linear(width, width, bias=False)
        self.output = nn.Linear(width, width)
        if relative:
            self.content_bias = nn.Parameter(torch.zeros(width))  # u
            self.position_bias = nn.Parameter(torch.zeros(width))  # v
        self.relative = relative

    def forward(self, x: Tensor, keys: Tensor, values: Tensor, age: Tensor, seen: Tensor) -> Tensor:
        """Attend from x (S, L, D) to keys and values (S, M, D): exactly zero where nothing is seen.

        age (L, M) is how many steps lie between a query and an item; seen (S, L, M) which items a query sees.
        """
        query, mask, sees_nothing = self.query_and_mask(x, age, seen)
        heads = F.scaled_dot_product_attention(query, self.split(keys), self.split(values), mask)  # (S, H, L, D / H)
        return self.output(heads.transpose(1, 2).flatten(2)).masked_fill(sees_nothing, 0.0)

    def query_and_mask(self, x: Tensor, age: Tensor, seen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return queries (S, H, L, D / H), a boolean or additive mask, and which queries see nothing (S, L, 1)."""
        sees_nothing = ~seen.any(-1, keepdim=True)
        mask = (seen | sees_nothing)[:, None]  # (S, 1, L, M); a row without any item would make the softmax NaN
        if not self.relative:
            return self.split(self.query(x)), mask, sees_nothing
        query = self.split(self.query(x + self.content_bias))
        # As many ages as items: the last query and the first item are farthest apart.
        ages = torch.arange(1, age.shape[1] + 1, device=x.device)
        encoded = self.split(self.key(sinusoid(ages, x.shape[-1]).to(x.dtype))[None])  # (1, H, ages, D / H)
        by_age = self.split(self.query(x + self.position_bias)) @ encoded.transpose(2, 3)  # (S, H, L, ages)
        at = (age.clamp(min=1) - 1).expand(*by_age.shape[:3], -1)  # (S, H, L, M)
        bias = by_age.gather(-1, at) / math.sqrt(query.shape[-1])
        return query, bias.masked_fill(~mask, -math.inf), sees_nothing

    def split(self, x: Tensor) -> Tensor:
        """Split the width between the heads: (S, L, D) to (S, H, L, D / H)."""
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)


class Gate(nn.Module):
    """A gated recurrent unit in place of a residual connection: GTrXL (Parisotto et al., 2020).

    The stream x is its hidden state, and the output y of a layer its input; §2.4.7 has them the other way round, see
    docs/memory.md. A bias above 0 mostly keeps x at first.
    """

    def __init__(self, width: int, bias: float):
        super().__init__()
        self.from_y = nn.Linear(width, 3 * width, bias=False)
        self.from_x = nn.Linear(width, 2 * width, bias=False)
        self.candidate = nn.Linear(width, width, bias=False)
        self.bias = nn.Parameter(torch.full((width,), bias))

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        """Merge x and y, (S, L, D) each."""
        (r_y, z_y, h_y), (r_x, z_x) = self.from_y(y).chunk(3, -1), self.from_x(x).chunk(2, -1)
        r, z = torch.sigmoid(r_y + r_x), torch.sigmoid(z_y + z_x - self.bias)
        h = torch.tanh(h_y + self.candidate(r * x))
        return torch.lerp(x, h.to(x.dtype), z.to(x.dtype))  # (1 - z) x + z h


class Block(nn.Module):
    """A transformer block (figure 5.5): attention to the memory, then a projection, each merged with its input.

    Layer norms come before both (figure 2.11b), or after both (figure 2.11a). Parisotto et al. (2020) have a ReLU
    behind the attention too.
    """

    def __init__(self, args: Args):
        super().__init__()
        width = args.trxl_dim
        before, after = (nn.LayerNorm, nn.Identity) if args.trxl_layer_norm == "pre" else (nn.Identity, nn.LayerNorm)
        self.norm_query, self.norm_items, self.norm_output = before(width), before(width), before(width)
        self.after_attention, self.after_projection = after(width), after(width)
        self.attention = Attention(width, args.trxl_num_heads, args.trxl_positional_encoding == "relative")
        self.projection = nn.Linear(width, width)
        if args.trxl_gate == "gru":
            self.merge_attention, self.merge_output = (Gate(width, args.trxl_gate_bias) for _ in range(2))
        else:
            self.merge_attention = self.merge_output = torch.add  # residual connections

    def keys_values(self, items: Tensor) -> tuple[Tensor, Tensor]:
        """Project items (..., D), to which their positions are added already, to keys and values."""
        items = self.norm_items(items)
        return self.attention.key(items), self.attention.value(items)

    def forward(
        self, x: Tensor, added_to_query: Tensor | float, keys_values: tuple, age: Tensor, seen: Tensor
    ) -> Tensor:
        """Map x (S, L, D) to the next block's input (S, L, D); added_to_query (S, L, D) is for the query alone."""
        x = self.merge_attention(x, self.attention(self.norm_query(x + added_to_query), *keys_values, age, seen))
        x = self.after_attention(x)
        x = self.merge_output(x, F.relu(self.projection(self.norm_output(x))))
        return self.after_projection(x)


def block_init(block: Block, scheme: str, blocks: int) -> None:
    """Initialize the weights of a block's layers by the scheme (table 6.1), and their biases with zero.

    T-Fixup (Huang et al., 2020) is Xavier with values, outputs and projections scaled by 0.67 / blocks^(1/4).
    """
    init = {"orthogonal": nn.init.orthogonal_, "kaiming": nn.init.kaiming_normal_}.get(scheme, nn.init.xavier_uniform_)
    for layer in block.modules():
        if isinstance(layer, nn.Linear):
            for matrix in layer.weight.detach().split(layer.in_features):  # a gate's layer stacks square matrices
                init(matrix)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    if scheme == "tfixup":
        with torch.no_grad():
            for layer in (block.attention.value, block.attention.output, block.projection):
                layer.weight.mul_(0.67 * blocks**-0.25)


class MemoryState(NamedTuple):
    """What N environments remember: a timeline of W steps before a rollout and the T steps of it.

    Row W + t of the timeline is step t of the rollout; the last row, W + T, is that of the bootstrap value. `now` and
    `episode_step` are replaced step by step, the timeline is written in place. The numbers of steps stay on the CPU:
    shapes depend on them, and a GPU would have to be waited for.
    """

    now: int  # row of the step that comes next
    episode_step: Tensor  # (N,) which step of its episode that is
    items: Tensor  # (W + T + 1, N, K or K + 1, D) the input of every block; with --trxl-query-output the output
    item_steps: Tensor  # (W + T + 1, N) which step of its episode an item was stored at
    keys: Tensor  # (K, N, W + T + 1, D) the items' projections, cached while acting
    values: Tensor  # (K, N, W + T + 1, D)


class Memory(nn.Module):
    """Transformer-XL as an episodic memory with a sliding window (§5.3), or GTrXL.

    Every step leaves an item, the inputs of the K blocks. A step's query in block k sees the k-th part of the items of
    up to W steps before it, of the same episode, never its own. Raises ValueError unless `inputs` is --trxl-dim, even
    and a multiple of --trxl-num-heads.
    """

    not_saved = ("keys", "values")  # in checkpoints: every rollout computes them before they are read

    def __init__(self, args: Args, inputs: int):
        super().__init__()
        if args.trxl_dim % args.trxl_num_heads or args.trxl_dim % 2:
            raise ValueError(f"--trxl-dim is {args.trxl_dim}; it must be even and a multiple of --trxl-num-heads")
        if inputs != args.trxl_dim:
            raise ValueError(f"--trxl-dim is {args.trxl_dim}; with --no-embedding it must be {inputs} here")
        self.width = args.trxl_dim
        self.window = args.trxl_memory_length
        self.segment_length = args.trxl_segment_length
        self.encoding = args.trxl_positional_encoding
        self.query_position = args.trxl_query_position
        self.memory_gradient = args.trxl_memory_gradient
        self.cache_dtype = torch.bfloat16 if args.amp else torch.float32  # as the layers deliver keys and values
        self.blocks = nn.ModuleList(Block(args) for _ in range(args.trxl_num_layers))
        for block in self.blocks:
            block_init(block, args.trxl_init, args.trxl_num_layers)
        if self.encoding == "learned":
            length = args.trxl_pe_length + 1  # one for what follows an episode's last step, which may be valued
            self.table = nn.Parameter(torch.randn(length, self.width) / math.sqrt(self.width))
        self.query_output = nn.Linear(self.width, self.width, bias=False) if args.trxl_query_output else None

    def initial_state(self, num_envs: int, num_steps: int, device: torch.device) -> MemoryState:
        """Return the memory of fresh episodes, which has no items, with room for a rollout of num_steps."""
        rows = self.window + num_steps + 1
        cache = (len(self.blocks), num_envs, rows, self.width)
        parts = len(self.blocks) + (self.query_output is not None)
        return MemoryState(
            now=self.window,
            episode_step=torch.zeros(num_envs, dtype=torch.int64),
            items=torch.zeros(rows, num_envs, parts, self.width, device=device),
            item_steps=torch.zeros(rows, num_envs, dtype=torch.int64),
            keys=torch.zeros(cache, dtype=self.cache_dtype, device=device),
            values=torch.zeros(cache, dtype=self.cache_dtype, device=device),
        )

    def begin_rollout(self, state: MemoryState) -> MemoryState:
        """Move the last W items to the beginning of the timeline, and project them with the current weights."""
        for stored in (state.items, state.item_steps):
            stored[: self.window] = stored[state.now - self.window : state.now].clone()  # the two may overlap
        state = state._replace(now=self.window)
        rows, _, seen = self.look_back(state)
        seen = seen[:, 0].T  # (M, N)
        items = state.items[rows].masked_fill(~seen[..., None, None], 0.0)  # (M, N, K or K + 1, D)
        position = self.position(state.item_steps[rows].to(seen.device).where(seen, 0), items.dtype)  # (M, N, D)
        for k, block in enumerate(self.blocks):
            keys, values = block.keys_values(items[:, :, k] + position)
            state.keys[k][:, rows], state.values[k][:, rows] = keys.transpose(0, 1), values.transpose(0, 1)
        return state

    def rewind(self, state: MemoryState) -> MemoryState:
        """Return the state that the rollout began with; what it stored stays until it is stored again."""
        return state._replace(now=self.window, episode_step=state.item_steps[self.window].clone())

    def step(self, x: Tensor, state: MemoryState) -> tuple[Tensor, MemoryState]:
        """Take one step of all environments: x (N, D) to (N, D), and the state after it. Stores the step's item.

        To get a value only, discard the returned state: the next call overwrites row `now`, which no query of this step
        sees. Raises MemoryLimit if an episode outlasts a learned encoding's table.
        """
        self.check_length(state.episode_step)
        rows, age, seen = self.look_back(state)
        episode_step = state.episode_step.to(x.device)[:, None]  # (N, 1)
        position = self.position(episode_step, x.dtype)  # (N, 1, D)
        added_to_query = self.added_to_query(episode_step, state.items[state.now - 1][:, None], x.dtype)
        state.item_steps[state.now] = state.episode_step
        x = x[:, None]  # (N, 1, D)
        for k, block in enumerate(self.blocks):
            state.items[state.now, :, k] = x[:, 0].detach()
            key, value = block.keys_values(x + position)  # (N, 1, D) each
            state.keys[k][:, state.now], state.values[k][:, state.now] = key[:, 0], value[:, 0]
            keys_values = state.keys[k][:, rows], state.values[k][:, rows]  # (N, M, D) each
            x = block(x, added_to_query if k == 0 else 0.0, keys_values, age, seen)
        if self.query_output is not None:
            state.items[state.now, :, -1] = x[:, 0].detach()
        return x[:, 0], state._replace(now=state.now + 1, episode_step=state.episode_step + 1)

    def look_back(self, state: MemoryState) -> tuple[slice, Tensor, Tensor]:
        """Return the M rows that the next step may see, their ages (1, M), and which of them it sees (N, 1, M)."""
        back = self.reach(state.episode_step)
        age = torch.arange(back, 0, -1)[None]  # (1, M), the oldest item first
        seen = visible(age, state.episode_step[:, None], self.window)[:, None]
        return slice(state.now - back, state.now), age.to(state.items.device), seen.to(state.items.device)

    def reach(self, episode_steps: Tensor) -> int:
        """Return how far back a query at any of these steps may see; at least 1, since attention needs an item."""
        return min(max(int(episode_steps.max()), 1), self.window)

    def reset(self, state: MemoryState, done: Tensor) -> MemoryState:
        """Forget where an episode ended: done (N,), on the CPU."""
        rows = slice(state.now - self.reach(state.episode_step), state.now)
        for cache in (state.keys, state.values):
            # No query sees these, but a NaN among them would spread even through a weight of zero.
            cache[:, done.nonzero().to(cache.device), rows] = 0.0
        return state._replace(episode_step=state.episode_step.masked_fill(done, 0))

    def cut(self, done: Tensor) -> Pieces:
        """Cut a rollout into segments of --trxl-segment-length steps, the last one perhaps shorter.

        Where episodes end, done (T, N), does not matter: `visible` keeps them apart.
        """
        starts = torch.arange(len(done)) % self.segment_length == 0
        return Pieces.from_starts(starts[:, None].expand_as(done))

    def unroll(self, x: Tensor, pieces: Pieces, state: MemoryState) -> Tensor:
        """Run whole segments: x (B, D) to (B, D), attending to the stored items of up to W steps before each step.

        All queries of a segment share its items, and a band mask tells which of them each one sees. Below, a segment of
        four steps, a window of three, and an episode that ends after the second step (1: seen):

                               the W items before   the segment's own, but for its last
            query, step 5            1  1  1           .  .  .
            query, step 6            .  1  1           1  .  .
            query, step 0            .  .  .           .  .  .      an episode's first step sees nothing
            query, step 1            .  .  .           .  .  1

        With --trxl-memory-gradient, the segment's own are recomputed block inputs instead of the stored items: the same
        numbers as long as the weights are, but with a gradient to earlier steps (Dai et al., 2019).
        """
        device = x.device
        last_row = len(state.item_steps) - 1  # indices are clamped to it: a short last segment's padding lies beyond
        x = pieces.pad(x)  # (S, L, D)
        first = pieces.first[:, None]  # (S, 1)
        row, env = self.window + first // pieces.num_envs, first % pieces.num_envs  # (S, 1) of a segment's first step
        columns = pieces.columns()  # (L,)
        episode_step = state.item_steps[(row + columns).clamp(max=last_row), env].where(pieces.is_step(), 0)  # (S, L)
        back = self.reach(episode_step[:, 0])  # items from before the segment: later queries see no earlier ones
        item_columns = torch.arange(-back, len(columns) - 1)  # (M,)
        rows = (row + item_columns).clamp(max=last_row)  # (S, M)
        item_steps = state.item_steps[rows, env].to(device)  # (S, M)
        items = state.items[rows.to(device), env.to(device)]  # (S, M, K or K + 1, D)

        age = (columns[:, None] - item_columns).to(device)  # (L, M)
        episode_step = episode_step.to(device)
        seen = visible(age, episode_step[..., None], self.window)  # (S, L, M)
        seen_by_any = seen.any(1)  # (S, M); what no query sees becomes zero, so that not even a NaN in it has an effect
        items, item_steps = items.masked_fill(~seen_by_any[..., None, None], 0.0), item_steps.where(seen_by_any, 0)
        position = self.position(item_steps, x.dtype)  # (S, M, D)
        previous_items = items[:, back - 1 :]  # (S, L, K or K + 1, D): columns -1 .. L - 2
        added_to_query = self.added_to_query(episode_step, previous_items, x.dtype)
        for k, block in enumerate(self.blocks):
            block_items = items[:, :, k]
            if self.memory_gradient:
                own = x[:, :-1].masked_fill(~seen_by_any[:, back:, None], 0.0)
                block_items = torch.cat([block_items[:, :back], own], 1)
            keys_values = block.keys_values(block_items + position)
            x = block(x, added_to_query if k == 0 else 0.0, keys_values, age, seen)
        return pieces.unpad(x)

    def encode_step(self, episode_step: Tensor, dtype: torch.dtype) -> Tensor:
        """Encode steps of episodes, of any shape, to (..., D): by the learned table, or as sines and cosines."""
        return self.table[episode_step] if self.encoding == "learned" else sinusoid(episode_step, self.width).to(dtype)

    def position(self, episode_step: Tensor, dtype: torch.dtype) -> Tensor | float:
        """Return what is added to items (..., D) that were stored at these steps of their episodes."""
        return self.encode_step(episode_step, dtype) if self.encoding in ("absolute", "learned") else 0.0

    def added_to_query(self, episode_step: Tensor, previous_items: Tensor, dtype: torch.dtype) -> Tensor | float:
        """Return what is added to the first block's query (S, L, D) at these steps (S, L) of their episodes (§7.1.3).

        With --trxl-query-position the encoding of the step; with --trxl-query-output a projection of the last block's
        output of the step before, which is the last part of that step's items (S, L, K + 1, D).
        """
        added = self.encode_step(episode_step, dtype) if self.query_position else 0.0
        if self.query_output is not None:
            previous_output = previous_items[..., -1, :].masked_fill(episode_step[..., None] == 0, 0.0)
            added = added + self.query_output(previous_output)
        return added

    def check_length(self, episode_step: Tensor) -> None:
        """Raise MemoryLimit if an episode outlasts the learned encoding's table."""
        if self.encoding == "learned" and int(episode_step.max()) >= len(self.table):
            raise MemoryLimit(
                f"--trxl-pe-length is {len(self.table) - 1}, but an episode is longer; make it the longest episode's "
                "length, or use --trxl-positional-encoding absolute or relative, which have no such limit"
            )

    def logs(self, state: MemoryState) -> dict[str, float]:
        """Return what to log of the last rollout: how far back any of its steps saw."""
        return {"memory_window": min(int(state.item_steps[self.window : state.now].max()), self.window)}


# ---- 5 AGENT ----
class Agent(nn.Module):
    """Encoder, memory and heads: acts step by step, and evaluates whole pieces of what it did.

    nvec: number of actions of each branch. ground_truth_size: entries of the environment's ground truth. Raises
    ValueError for an observation that does not suit the arguments.
    """

    def __init__(self, space: gym.spaces.Dict, nvec: list[int], args: Args, ground_truth_size: int = 0):
        super().__init__()
        self.encoder = Encoder(space.spaces, memory_width(args) if args.embedding else None, args.vector_frequencies)
        self.memory = Memory(args, self.encoder.width)
        self.heads = Heads(self.memory.width, nvec, args.head_size, args.value_init_gain)
        with torch.random.fork_rng([]):  # with and without these, the random numbers that follow are the same
            self.decoder = Decoder(args.head_size, space.spaces) if args.reconstruction_coef else None
            self.estimator = head(args.head_size, ground_truth_size, 1.0) if args.ground_truth_coef else None

    def get_action_and_value(
        self, obs: dict[str, Tensor], state: MemoryState
    ) -> tuple[Tensor, Tensor, Tensor, MemoryState]:
        """Take one step of all environments.

        Returns actions (N, A), their log-probabilities (N, A), values (N,) and the memory's state after the step.
        """
        x, state = self.memory.step(self.encoder(obs), state)
        logits, values, _ = self.heads(x)
        policy = self.heads.distributions(logits)
        actions = torch.stack([branch.sample() for branch in policy], -1)
        return actions, log_probs_of(policy, actions), values, state

    def get_value(self, obs: dict[str, Tensor], state: MemoryState) -> Tensor:
        """Return the values (N,) of observations that are not acted on."""
        x, _ = self.memory.step(self.encoder(obs), state)
        return self.heads(x)[1]

    def evaluate_actions(
        self, x: Tensor, actions: Tensor, pieces: Pieces, state: MemoryState
    ) -> tuple[list[Categorical], Tensor, Tensor, Tensor]:
        """Recompute, with gradient, what `get_action_and_value` computed at the steps of the pieces.

        x: the steps' encoded observations (B, I). Returns the policy, a distribution of B actions for each branch, the
        log-probabilities (B, A) of the actions (B, A), values (B,) and features (B, F).
        """
        logits, values, features = self.heads(self.memory.unroll(x, pieces, state))
        policy = self.heads.distributions(logits)
        return policy, log_probs_of(policy, actions), values, features


def log_probs_of(policy: list[Categorical], actions: Tensor) -> Tensor:
    """Return the log-probability (B, A) of the chosen action (B, A) of every branch."""
    return torch.stack([branch.log_prob(action) for branch, action in zip(policy, actions.unbind(-1), strict=True)], -1)


class MemoryLimit(ValueError):
    """An episode is longer than the memory allows; says which flag helps. `Memory.step` may raise it."""


# ---- 6 TRAINING ----
@dataclass
class Rollout:
    """T steps of N environments to learn from, and what the next rollout goes on with; each rollout overwrites it."""

    obs: dict[str, Tensor]  # each (T, N, ...): uint8 pixels stay uint8
    actions: Tensor  # (T, N, A)
    log_probs: Tensor  # (T, N, A)
    values: Tensor  # (T, N)
    rewards: Tensor  # (T, N)
    terminated: Tensor  # (T, N) the step ended its episode
    truncated: Tensor  # (T, N) the step ended its episode by a time limit
    truncation_values: Tensor  # (T, N) value of the final observation, where bootstrapped
    ground_truth: Tensor | None  # (T, N, G), if it is estimated
    next_obs: dict[str, np.ndarray]  # each (N, ...)
    next_ground_truth: np.ndarray | None  # (N, G)
    memory_state: MemoryState  # what the update needs of these steps, and what the next one begins with
    advantages: Tensor | None = None  # (T, N)
    returns: Tensor | None = None  # (T, N)

    @classmethod
    def allocate(cls, num_steps: int, obs: dict[str, np.ndarray], truth: np.ndarray | None, agent: Agent) -> "Rollout":
        """Make a rollout on the agent's device that begins with these observations and ground truths."""
        num_envs = len(next(iter(obs.values())))
        device = next(agent.parameters()).device

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(num_steps, num_envs, *shape, dtype=dtype, device=device)

        branches = len(agent.heads.nvec)
        return cls(
            obs={name: zeros(*part.shape[1:], dtype=part.dtype) for name, part in as_tensors(obs, device).items()},
            actions=zeros(branches, dtype=torch.int64),
            log_probs=zeros(branches),
            values=zeros(),
            rewards=zeros(),
            terminated=zeros(dtype=torch.bool),
            truncated=zeros(dtype=torch.bool),
            truncation_values=zeros(),
            ground_truth=None if truth is None else zeros(truth.shape[1]),
            next_obs=obs,
            next_ground_truth=truth,
            memory_state=agent.memory.initial_state(num_envs, num_steps, device),
        )


def autocast(args: Args, device: torch.device) -> torch.autocast:
    """Return the context in which the networks compute in bfloat16, with --amp."""
    return torch.autocast(device.type, torch.bfloat16, enabled=args.amp)


def as_tensors(obs: dict[str, np.ndarray], device: torch.device) -> dict[str, Tensor]:
    """Move observations to a device."""
    return {name: torch.from_numpy(part).to(device) for name, part in obs.items()}


@torch.no_grad()
def collect(
    agent: Agent, envs: gym.vector.VectorEnv, rollout: Rollout, args: Args
) -> tuple[Tensor, dict[str, list[float]]]:
    """Act for T steps in all environments; return the value (N,) of what follows, and metrics of the ended episodes.

    The environments are those of `memory_gym_envs.making`: an observation is a dict of images and vectors, and an ended
    episode is reset in the same step, so that next_obs begins the next one. Metrics are lists by name:
    charts/episodic_return, charts/episodic_length, and episode/* for every number in the environment's final info.
    """
    device = rollout.values.device
    episodes = defaultdict(list)
    rollout.truncation_values.zero_()
    with autocast(args, device):
        state = agent.memory.begin_rollout(rollout.memory_state)
        for t in range(args.num_steps):
            for name, part in rollout.next_obs.items():
                rollout.obs[name][t] = torch.from_numpy(part)  # to the device, dtype kept
            if rollout.ground_truth is not None:
                rollout.ground_truth[t] = torch.as_tensor(rollout.next_ground_truth)
            obs = {name: part[t] for name, part in rollout.obs.items()}
            rollout.actions[t], rollout.log_probs[t], rollout.values[t], state = agent.get_action_and_value(obs, state)

            next_obs, rewards, terminated, truncated, infos = envs.step(rollout.actions[t].cpu().numpy())
            done = terminated | truncated
            rollout.rewards[t] = torch.as_tensor(rewards)
            rollout.terminated[t], rollout.truncated[t] = torch.as_tensor(terminated), torch.as_tensor(truncated)
            if args.bootstrap_truncated and truncated.any():
                final = as_tensors(final_observations(next_obs, infos, truncated), device)
                value = agent.get_value(final, state)  # with the memory of the episode that ended
                rollout.truncation_values[t] = value * rollout.truncated[t]
            state = agent.memory.reset(state, torch.as_tensor(done))
            rollout.next_obs = next_obs
            rollout.next_ground_truth = infos["ground_truth"] if rollout.ground_truth is not None else None
            if done.any():
                episodes["charts/episodic_return"] += infos["episode"]["r"][done].tolist()
                episodes["charts/episodic_length"] += infos["episode"]["l"][done].tolist()
                for name, _, values in final_numbers(infos, done):
                    episodes[f"episode/{name}"] += values.tolist()
        rollout.memory_state = state
        return agent.get_value(as_tensors(rollout.next_obs, device), state), episodes


def ppo_loss(
    agent: Agent, rollout: Rollout, observations: "UniqueObservations", minibatch: Pieces, ent_coef: float, args: Args
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the total loss (5.7) of a minibatch, and what to log of it."""
    index = minibatch.flat_index().to(rollout.values.device)  # (B,)

    def gather(stored: Tensor) -> Tensor:
        return stored.flatten(0, 1).index_select(0, index)  # (T, N, ...) to (B, ...)

    with autocast(args, index.device):
        x = observations.encode(agent.encoder, index)  # (B, I); section 9: on a CPU, equal ones once
        policy, log_probs, values, features = agent.evaluate_actions(
            x, gather(rollout.actions), minibatch, rollout.memory_state
        )
    log_ratio = log_probs - gather(rollout.log_probs)  # (B, A)
    advantages, old_values, returns = gather(rollout.advantages), gather(rollout.values), gather(rollout.returns)
    if args.norm_adv == "minibatch":
        advantages = normalize(advantages)
    pg_loss = policy_loss(log_ratio, advantages, args.clip_coef)
    v_loss = value_loss(values, old_values, returns, args.clip_coef if args.clip_vloss else None)
    entropy = sum(branch.entropy() for branch in policy).mean()  # of independent branches: the sum
    barrier = log_barrier(policy)
    loss = pg_loss + args.vf_coef * v_loss - ent_coef * (entropy if args.exploration_bonus == "entropy" else barrier)
    logs = {"policy_loss": pg_loss, "value_loss": v_loss, "entropy": entropy, "log_barrier": barrier}
    if agent.decoder is not None:  # (5.5)
        with autocast(args, index.device):
            logits = in_chunks(agent.decoder, features.detach() if args.reconstruction_detach else features)
        logs["reconstruction_loss"] = reconstruction_loss(logits.float(), gather(rollout.obs[agent.encoder.images[0]]))
        loss = loss + args.reconstruction_coef * logs["reconstruction_loss"]
    if agent.estimator is not None:  # (5.6)
        estimate = agent.estimator(features.detach() if args.ground_truth_detach else features)  # (B, G)
        logs["ground_truth_loss"] = F.mse_loss(estimate, gather(rollout.ground_truth))
        loss = loss + args.ground_truth_coef * logs["ground_truth_loss"]
    logs |= {"loss": loss, **policy_metrics(log_ratio, args.clip_coef)}
    return loss, {name: value.detach() for name, value in logs.items()}


@torch.no_grad()
def refresh_memory(agent: Agent, rollout: Rollout, args: Args) -> None:
    """Store again, with the current weights, what the rollout stored of the memory (§7.1.4; Kapturowski et al., 2019).

    What was stored before the rollout stays as it is. With the weights that acted, nothing changes, to the last bit.
    """
    done = (rollout.terminated | rollout.truncated).cpu()
    with autocast(args, rollout.values.device):
        state = agent.memory.begin_rollout(agent.memory.rewind(rollout.memory_state))
        for t in range(len(done)):
            x = agent.encoder({name: part[t] for name, part in rollout.obs.items()})
            _, state = agent.memory.step(x, state)
            state = agent.memory.reset(state, done[t])
    rollout.memory_state = state


def update(
    agent: Agent, optimizer: torch.optim.Optimizer, rollout: Rollout, ent_coef: float, args: Args
) -> dict[str, float]:
    """Learn from the rollout for some epochs; return what to log, averaged over the minibatches.

    Raises FloatingPointError if a loss or a gradient was not finite; the weights are of no use then.
    """
    if args.norm_adv == "batch":
        rollout.advantages = normalize(rollout.advantages)
    observations = UniqueObservations(rollout.obs, agent)
    pieces = agent.memory.cut((rollout.terminated | rollout.truncated).cpu())
    clipped_together = groups_to_clip(agent, args)
    logs = []
    too_far = False  # for --target-kl
    for epoch in range(args.update_epochs):
        if args.refresh_memory and epoch > 0:
            refresh_memory(agent, rollout, args)
        for minibatch in pieces.minibatches(args.num_minibatches):
            loss, log = ppo_loss(agent, rollout, observations, minibatch, ent_coef, args)
            if args.target_kl is not None and logs:  # before the first step, the policy is still the one that acted
                kl = np.mean(all_gather(log["approx_kl"].item()))  # section 8: of all processes, which stop together
                too_far = kl > args.target_kl
                if too_far:
                    break
            optimizer.zero_grad()
            loss.backward()
            average_gradients(agent, int(minibatch.length.sum()))  # section 8: over processes, if there are several
            norms = [nn.utils.clip_grad_norm_(group, args.max_grad_norm) for group in clipped_together]
            log |= {"grad_norm": norms[0], "largest_norm": torch.stack(norms).max()}
            optimizer.step()
            logs.append(log)
        if too_far:
            break

    means = torch.stack([torch.stack([*log.values()]) for log in logs]).mean(0)  # over minibatches
    losses = dict(zip(logs[0], means.tolist(), strict=True))  # asks a GPU once, for all minibatches
    largest_norm = losses.pop("largest_norm")
    if not math.isfinite(losses["loss"] + largest_norm):
        raise FloatingPointError("the loss or its gradient is not finite; try a lower --init-lr")
    # Before the first gradient step the weights are those that acted, so every ratio has to be 1.
    losses["ratio_error"] = logs[0]["ratio_error"].item()
    losses["explained_variance"] = explained_variance(rollout.values, rollout.returns)
    padding = 1 - float(pieces.length.float().mean() / pieces.length.max())  # if all were padded to the longest
    charts = {"gradient_steps": len(logs), "padding_fraction": padding, **agent.memory.logs(rollout.memory_state)}
    return {f"losses/{k}": v for k, v in losses.items()} | {f"charts/{k}": v for k, v in charts.items()}


def groups_to_clip(agent: Agent, args: Args) -> list[list[nn.Parameter]]:
    """Return the parameters whose gradients are clipped together: the agent's first, then each detached head's.

    A detached head is a probe of what the features hold: if its gradient had a share of the norm, clipping would change
    the agent's step.
    """
    auxiliary = ((agent.estimator, args.ground_truth_detach), (agent.decoder, args.reconstruction_detach))
    probes = [[*network.parameters()] for network, detached in auxiliary if network is not None and detached]
    in_probes = {*itertools.chain(*probes)}
    return [[parameter for parameter in agent.parameters() if parameter not in in_probes], *probes]


def train(args: Args, run: "Run") -> None:
    """Train until --total-timesteps, rounded down to whole iterations, or until a signal.

    Raises FloatingPointError if the training diverges, MemoryLimit as the memory does, RunError as `report` does.
    """
    agent, rollout = run.agent, run.rollout
    batch_size = args.num_envs * args.num_steps
    for step in range(run.step, args.total_timesteps - batch_size + 1, batch_size):
        began = time.perf_counter()
        run.iteration = step // batch_size + 1
        lr = anneal(step, args.init_lr, args.final_lr, args.anneal_steps)
        ent_coef = anneal(step, args.init_ent_coef, args.final_ent_coef, args.anneal_steps)
        run.optimizer.param_groups[0]["lr"].fill_(lr)

        last_value, episodes = collect(agent, run.envs, rollout, args)
        collected = time.perf_counter()
        rollout.advantages = gae(
            rewards=rollout.rewards,
            values=rollout.values,
            last_value=last_value,
            terminated=rollout.terminated,
            truncated=rollout.truncated,
            truncation_values=rollout.truncation_values,
            gamma=args.gamma,
            gae_lambda=args.gae_lambda,
        )
        rollout.returns = rollout.advantages + rollout.values
        logs = update(agent, run.optimizer, rollout, ent_coef, args)
        updated = time.perf_counter()

        logs |= {"charts/learning_rate": lr, "charts/entropy_coefficient": ent_coef}
        seconds = {"collect": collected - began, "update": updated - collected, "iteration": updated - began}
        logs |= {f"charts/seconds_{part}": value for part, value in seconds.items()}
        run.step = step + batch_size
        report(args, run, logs, episodes)  # section 8: evaluation, TensorBoard, progress bar, checkpoints
        if run.stop:
            break


# ---- 7 EVALUATION ----
def evaluation_levels(args: Args) -> list[int]:
    """Return the seeds (N,) of the levels that an evaluation plays: those after the training levels, with repeats."""
    first = args.start_level + args.num_levels
    return [first + level for level in range(args.eval_levels) for _ in range(args.eval_repeats)]


@torch.no_grad()
def evaluate(agent: Agent, envs: gym.vector.VectorEnv, args: Args, memory_steps: int = 64) -> dict[str, np.ndarray]:
    """Play each of `evaluation_levels` in an environment of its own, with the stochastic policy (§6.1.3).

    Returns metrics (N,) by name: return, length, finished (0 for an episode that was cut short), and every number in
    an episode's final info. The memory begins empty, and has room for memory_steps steps at a time.
    """
    levels = evaluation_levels(args)
    device = next(agent.parameters()).device
    obs, _ = envs.reset(seed=levels)
    state = agent.memory.initial_state(len(levels), memory_steps, device)
    playing = np.ones(len(levels), bool)
    metrics = {"return": np.zeros(len(levels)), "length": np.zeros(len(levels))}
    with autocast(args, device):
        for t in range(args.eval_max_steps):
            if t % memory_steps == 0:
                state = agent.memory.begin_rollout(state)
            actions, _, _, state = agent.get_action_and_value(as_tensors(obs, device), state)
            obs, rewards, terminated, truncated, infos = envs.step(actions.cpu().numpy())
            done = terminated | truncated
            state = agent.memory.reset(state, torch.as_tensor(done))
            metrics["return"] += rewards * playing
            metrics["length"] += playing
            for name, which, values in final_numbers(infos, done & playing):
                if name not in ("return", "length"):  # counted above; the environment's own of these names are ignored
                    metrics.setdefault(name, np.full(len(levels), np.nan))[which] = values
            playing &= ~done
            if not playing.any():
                break
    return metrics | {"finished": 1.0 - playing}


def level_scores(args: Args, run: "Run") -> dict[str, Tensor]:
    """Return an evaluation's metrics by name, (--eval-levels, --eval-repeats) float64: every episode on every level.

    Training goes on as if there had been none, unless an environment of another package takes random numbers from
    NumPy's or Python's global generator. What only an episode's end tells is left out if an episode was cut
    short: the best ones would be missing. An episode that is too long for the memory ends the evaluation with a warning
    and without metrics.
    """
    device = run.rollout.values.device
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(args.seed)
        try:
            metrics = evaluate(run.agent, run.eval_envs, args)
        except MemoryLimit as error:
            tqdm.write(f"no evaluation: {error}", file=sys.stderr)
            return {}
    complete = {name: torch.from_numpy(values) for name, values in metrics.items() if not np.isnan(values).any()}
    return {name: values.unflatten(0, (-1, args.eval_repeats)) for name, values in complete.items()}


# ---- 8 RUNNING ----
class RunError(RuntimeError):
    """Training cannot go on for a reason outside of it, as a full disk; the message is one line that names it."""


@dataclass
class Run:
    """All that training needs, made by `setup`."""

    envs: gym.vector.VectorEnv
    eval_envs: gym.vector.VectorEnv | None
    agent: Agent
    optimizer: torch.optim.Optimizer
    rollout: Rollout
    folder: Path
    writer: SummaryWriter | None = None  # only in the first process, as the progress bar
    bar: tqdm | None = None
    iteration: int = 0  # the current one, from 1
    step: int = 0  # so far, of all environments together
    seconds: float = 0.0  # of training, without evaluations
    returns: deque = field(default_factory=lambda: deque(maxlen=100))  # of the last episodes, for the progress bar
    lengths: deque = field(default_factory=lambda: deque(maxlen=100))
    received_signal: int = 0  # SIGTERM or SIGINT, if this process got one
    stop: bool = False  # a process got one: this iteration is the last
    lock: TextIO | None = None  # an open file, which tells others that the folder is in use


def flag(name: str) -> str:
    """Return the command line's spelling of a field of Args."""
    return "--" + name.replace("_", "-")


def as_flags(values: dict[str, Any]) -> str:
    """Return values of fields of Args as a command line."""
    return " ".join(
        flag(name if value else f"no_{name}") if isinstance(value, bool) else f"{flag(name)} {value}"
        for name, value in values.items()
    )


def parse_args(argv: list[str]) -> Args:
    """Parse a command line; its flags win over what --preset holds, or what the run of --resume began with.

    Raises what `read_checkpoint` raises.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset")
    first.add_argument("--resume")
    given = first.parse_known_args(argv)[0]
    default = Args(**PRESETS.get(given.preset, {}))  # tyro reports an unknown one, as all errors
    if given.resume is not None:
        default = saved_args(read_checkpoint(given.resume))
    laptop = as_flags(PRESETS["laptop"])
    description = f"{Args.__doc__} The defaults are the thesis'. --preset laptop stands for {laptop}"
    return tyro.cli(Args, args=argv, default=default, description=description)


def check_args(args: Args) -> None:
    """Raise ValueError, naming the flag and what it may be, for the first value or combination that cannot work."""
    for name, kind in get_type_hints(Args, include_extras=True).items():
        value, parts = getattr(args, name), (kind, *get_args(kind))  # float | None has its bounds in a part
        for bounds in (each for part in parts for each in getattr(part, "__metadata__", ())):
            if isinstance(bounds, Bounds) and value is not None and not bounds.allow(value):
                raise ValueError(f"{flag(name)} is {value}; it must be {bounds.text}")
        if get_origin(kind) is Literal and value not in get_args(kind):  # in Python; tyro checks the command line
            raise ValueError(f"{flag(name)} is {value!r}; it must be one of {', '.join(get_args(kind))}")
        if isinstance(value, int) and value >= 2**63:  # torch and NumPy take no more
            raise ValueError(f"{flag(name)} is {value}; it must be below 2 ** 63")
    if not args.exp_name or set(args.exp_name) & set("/\\"):
        raise ValueError(f"--exp-name is {args.exp_name!r}; it must be a name without slashes")
    for name in ("reconstruction", "ground_truth"):
        if getattr(args, f"{name}_detach") and not getattr(args, f"{name}_coef"):
            raise ValueError(f"{flag(f'{name}_detach')} needs {flag(f'{name}_coef')} above 0")
    for name, (other, values) in NEEDS.items():
        if getattr(args, name) != getattr(Args, name) and getattr(args, other) not in values:
            raise ValueError(f"{flag(name)} needs {flag(other)} {' or '.join(values)}; without, it changes nothing")
    batch_size = args.num_envs * args.num_steps
    if args.total_timesteps < batch_size:
        raise ValueError(
            f"--total-timesteps is {args.total_timesteps}, less than one iteration of {batch_size} steps "
            f"(--num-envs {args.num_envs} x --num-steps {args.num_steps})"
        )
    _, processes = rank_and_size()
    if args.num_envs % processes:
        raise ValueError(f"--num-envs is {args.num_envs}; it must be a multiple of the {processes} processes")
    longest, share = longest_piece(args), batch_size // processes
    if args.num_minibatches * longest > share:
        raise ValueError(
            f"--num-minibatches is {args.num_minibatches}, but an iteration may have only {share // longest} sequences "
            f"(up to {longest} of {share} steps each); use at most that many, or more environments (--num-envs)"
        )


def environments(args: Args, num_envs: int, **kwargs: Any) -> gym.vector.VectorEnv:
    """Make the environments that the arguments describe; kwargs and errors are those of `make_envs`."""
    names = ("num_levels", "start_level", "obs_type")
    names += ("frame_stack", "step_encoding", "observe_last_action", "spotlight_perturbation")
    kwargs |= {name: getattr(args, name) for name in names}
    return make_envs(args.env_id, num_envs, options=parse_options(args.env_id, args.env_options), **kwargs)


def make_agent(envs: gym.vector.VectorEnv, infos: dict, args: Args, device: torch.device) -> Agent:
    """Make the agent for the environments, whose infos have the ground truth if that is to be estimated.

    Raises ValueError for spaces that do not suit, or if there is no ground truth.
    """
    truth = np.asarray(infos.get("ground_truth"))
    if args.ground_truth_coef and (truth.ndim != 2 or truth.dtype.kind not in "biuf"):
        raise ValueError("--ground-truth-coef needs an environment that has ground_truth, an array, in its info; use 0")
    size = truth.shape[1] if args.ground_truth_coef else 0
    return Agent(envs.single_observation_space, envs.single_action_space.nvec.tolist(), args, size).to(device)


def setup(args: Args) -> Run:
    """Check the arguments and make everything, files last.

    Bad input raises before anything is written, but for a checkpoint that does not fit. Raises ValueError, OSError,
    ImportError or gymnasium.error.Error, each with one line for the user.
    """
    if dist.is_torchelastic_launched() and not dist.is_initialized():  # by torchrun
        # torch.distributed.nn is imported at the top: imported later, by an optimizer, it would keep this group, and
        # Gloo's threads with it, until the interpreter ends, where they can abort the process.
        dist.init_process_group(timeout=timedelta(days=1))  # the others wait while the first one evaluates
    checkpoint = None if args.resume is None else read_checkpoint(args.resume)
    if checkpoint is not None:
        check_resumed(args, checkpoint)
    check_args(args)
    run = make_run(args, 0 if checkpoint is None else checkpoint["step"])
    if args.load_model is not None and checkpoint is None:
        load_weights(run.agent, read_model(args.load_model), args.load_model)
    rank, _ = rank_and_size()
    if rank == 0:
        make_folder(args, run)
    if checkpoint is not None:
        load_checkpoint(run, checkpoint)
    if rank == 0:
        open_logs(args, run)
    return run


def make_run(args: Args, step: int) -> Run:
    """Make environments, agent and optimizer of a run that begins at this step. Raises as `setup` does.

    Of several processes, each has its share of the environments, and the first one evaluates.
    """
    rank, processes = rank_and_size()
    random.seed(args.seed)  # it and NumPy's: environments of other packages may use them
    np.random.seed(args.seed % 2**32)  # noqa: NPY002
    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    device = torch.device("cpu")
    if torch.cuda.is_available() and args.cuda:
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
        torch.set_float32_matmul_precision("high")  # TF32
    if args.capture_video:
        check_can_film(args.env_id)
    with enough_memory(args, device):
        mode = "debug_rgb_array" if args.capture_video else None
        share = args.num_envs // processes
        # Environments that cannot be restored must not repeat the episodes that the run began with.
        seed = [args.seed, step] if step else args.seed
        envs = environments(args, share, seed=seed, first_lane=rank * share, render_mode=mode)
        obs, infos = envs.reset()
        agent = make_agent(envs, infos, args, device)
        rollout = Rollout.allocate(
            args.num_steps, obs, infos["ground_truth"] if args.ground_truth_coef else None, agent
        )
        evaluates = args.eval_interval and rank == 0
        eval_envs = environments(args, len(evaluation_levels(args))) if evaluates else None
    if rank > 0:  # all processes begin with the same weights, but draw numbers of their own
        own = int(np.random.SeedSequence([args.seed, rank]).generate_state(1)[0])
        random.seed(own)
        np.random.seed(own)  # noqa: NPY002
        torch.manual_seed(own)
    # The learning rate is a tensor, thus of float32. A float, which is of float64, would be simpler, but would change
    # rounding, and with it the curves of docs/results.md. The weight decay is torch's default.
    optimizer = torch.optim.AdamW(agent.parameters(), lr=torch.tensor(args.init_lr), weight_decay=0.01, fused=True)
    folder = Path(args.resume or all_gather(new_folder(args))[0])
    return Run(envs, eval_envs, agent, optimizer, rollout, folder, step=step)


@contextlib.contextmanager
def enough_memory(args: Args, device: torch.device) -> Iterator[None]:
    """Raise ValueError, naming what is larger than usual, if what is made inside does not fit in the memory."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "allocate" not in str(error):
            raise
        harmless = ("seed", "total_timesteps", "start_level", "num_levels", "anneal_steps", "num_minibatches")
        harmless += ("update_epochs", "checkpoint_interval", "keep_models", "eval_interval", "eval_max_steps")
        sizes = [each for each in fields(Args) if type(each.default) is int and each.name not in harmless]
        large = [each.name for each in sizes if getattr(args, each.name) > each.default] or ["num_envs", "num_steps"]
        large = " ".join(f"{flag(name)} {getattr(args, name)}" for name in large)
        raise ValueError(f"this does not fit in the memory of {device}; use less of {large}") from None


def new_folder(args: Args) -> Path:
    """Name a run folder that does not exist yet: a second run that begins in the same second gets a number."""
    env_id = args.env_id.replace("/", "-").replace(":", "-")
    first = Path("runs") / f"{env_id}__{args.exp_name}__{args.seed}__{int(time.time())}"
    numbered = (first.with_name(f"{first.name}-{number}") for number in itertools.count(2))
    return next(folder for folder in itertools.chain([first], numbered) if not folder.exists())


def make_folder(args: Args, run: Run) -> None:
    """Make the run folder, or take over the one of --resume, and film if asked to.

    Raises OSError if it cannot be written or is in use, or as `start_tracking` does.
    """
    if args.resume is not None and not os.access(run.folder, os.W_OK):
        raise OSError(f"--resume {run.folder}: this folder cannot be written")
    try:
        run.folder.mkdir(parents=True, exist_ok=args.resume is not None)
    except FileExistsError:  # another run has made it since it was named
        run.folder = new_folder(args)
        return make_folder(args, run)
    except OSError as error:
        where = "run where the folder runs can be written"
        raise OSError(f"cannot make {run.folder} ({error.strerror}); {where}") from None
    if args.track:
        try:
            start_tracking(args, run.folder.resolve().name)
        except (ValueError, ImportError):
            if args.resume is None:
                os.removedirs(run.folder)
            raise
    run.lock = open(run.folder / ".lock", "w")  # noqa: SIM115 (until the run is closed)
    if fcntl is not None:
        try:
            fcntl.flock(run.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OSError(f"--resume {run.folder}: another process is training this run") from None
        except OSError:  # some network file systems have no locks
            pass
    for part in run.folder.glob("*.part"):
        part.unlink()  # of a process that was killed while it wrote
    if args.capture_video:
        run.envs = LaneVideo(run.envs, str(run.folder / (f"videos-{run.step}" if run.step else "videos")))


def open_logs(args: Args, run: Run) -> None:
    """Open the TensorBoard file, which hides what was logged beyond the run's step, and the progress bar."""
    run.writer = SummaryWriter(str(run.folder), purge_step=run.step + 1 if run.step else None)
    hyperparameters = {"script": Path(__file__).stem, **asdict(args)}
    rows = "\n".join(f"|{key}|{' '.join(str(value).split())}|" for key, value in hyperparameters.items())
    run.writer.add_text("hyperparameters", f"|param|value|\n|-|-|\n{rows}", run.step)
    batch_size = args.num_envs * args.num_steps
    total = args.total_timesteps // batch_size * batch_size
    run.bar = tqdm(total=total, initial=run.step, unit=" steps", unit_scale=True)


def start_tracking(args: Args, name: str) -> None:
    """Mirror the TensorBoard curves to Weights and Biases; raise ValueError if that does not start.

    Raises ImportError without the extra `track`.
    """
    try:
        import wandb
    except ImportError:
        raise ImportError('--track needs wandb: pip install -e ".[track]"') from None
    where = {"project": args.wandb_project_name, "entity": args.wandb_entity, "name": name, "id": name}
    try:
        wandb.init(**where, resume="allow", sync_tensorboard=True, config=asdict(args), save_code=True)
    except Exception as error:  # whatever wandb raises: no account, no such team, no network
        raise ValueError(f"--track: {error}; log in with `wandb login`, or leave --track out") from None


def report(args: Args, run: Run, logs: dict[str, float], episodes: dict[str, list[float]]) -> None:
    """End an iteration: evaluate, log, and save, each where it is due.

    Raises RunError if a file cannot be written or a process is gone, FloatingPointError if a weight is not finite.
    """
    iteration, iterations = run.iteration, args.total_timesteps // (args.num_envs * args.num_steps)
    if run.eval_envs is not None and (iteration % args.eval_interval == 0 or iteration == iterations):
        for name, scores in level_scores(args, run).items():
            logs[f"eval/{name}"] = scores.mean().item()
            with writing_to(run.folder):
                run.writer.add_tensor(f"eval_levels/{name}", scores, run.step)
    logs, episodes, run.stop = combine_processes(all_gather((logs, episodes, run.received_signal)))
    write_logs(args, run, logs, episodes)
    if iteration * args.keep_models // iterations > (iteration - 1) * args.keep_models // iterations:
        write_file(model_of(args, run), run.folder / f"model-{run.step}.pt")
    is_last = run.stop or iteration == iterations
    if args.checkpoint_interval and (iteration % args.checkpoint_interval == 0 or is_last):
        save_checkpoint(args, run)


def write_logs(args: Args, run: Run, logs: dict[str, float], episodes: dict[str, list[float]]) -> None:
    """Write an iteration's numbers to TensorBoard and the progress bar; the first process does. Raises RunError."""
    run.seconds += logs["charts/seconds_iteration"]
    run.returns.extend(episodes.get("charts/episodic_return", []))
    run.lengths.extend(episodes.get("charts/episodic_length", []))
    if run.writer is None:
        return
    logs |= {name: float(np.mean(values)) for name, values in episodes.items()}
    logs["charts/SPS"] = run.step / run.seconds
    with writing_to(run.folder):
        for name, value in logs.items():
            run.writer.add_scalar(name, value, run.step)
    last = {"return": run.returns, "length": run.lengths}
    shown = {name: f"{np.mean(values):.2f}" for name, values in last.items() if values}
    run.bar.set_postfix({**shown, "SPS": f"{logs['charts/SPS']:.0f}"}, refresh=False)
    run.bar.update(args.num_envs * args.num_steps)


def rank_and_size() -> tuple[int, int]:
    """Return this process's rank, and how many processes train together: 0 and 1 unless torchrun started them."""
    return (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)


@contextlib.contextmanager
def lost_process() -> Iterator[None]:
    """Raise RunError if another process does not answer."""
    try:
        yield
    except RuntimeError as error:  # what Gloo and NCCL raise
        raise RunError("another process of this run has ended; its own output says why") from error


def all_gather(value: Any) -> list[Any]:
    """Return the value of every process, in the order of ranks. Raises RunError if one has ended."""
    values = [value] * rank_and_size()[1]
    if dist.is_initialized():
        with lost_process():
            dist.all_gather_object(values, value)
    return values


def average_gradients(agent: Agent, num_steps: int) -> None:
    """Replace each gradient, a mean over num_steps here, by the mean over the steps of all processes.

    Raises RunError if one has ended.
    """
    if not dist.is_initialized():
        return
    gradients = [parameter.grad for parameter in agent.parameters() if parameter.grad is not None]
    flat = torch.cat([*(gradient.flatten() for gradient in gradients), gradients[0].new_ones(1)]) * num_steps
    with lost_process():
        dist.all_reduce(flat)
    means = (flat[:-1] / flat[-1]).split([gradient.numel() for gradient in gradients])
    for gradient, mean in zip(gradients, means, strict=True):
        gradient.copy_(mean.view_as(gradient))  # in place: its memory layout has to stay that of the weight


def combine_processes(parts: list[tuple[dict, dict, int]]) -> tuple[dict[str, float], dict[str, list[float]], bool]:
    """Combine what the processes found: the means of their logs, all episodes, and whether any got a signal.

    Maxima over samples are maxima over processes.
    """
    logs, episodes, signals = zip(*parts, strict=True)
    values_of = {name: [each[name] for each in logs if name in each] for name in logs[0]}
    maxima = ("losses/ratio_error", "charts/memory_window")
    logs = {name: max(values) if name in maxima else float(np.mean(values)) for name, values in values_of.items()}
    joined = defaultdict(list)
    for each in episodes:
        for name, values in each.items():
            joined[name] += values
    return logs, joined, any(signals)


def model_of(args: Args, run: Run) -> dict[str, Any]:
    """Return what a model's file holds, which is a part of what a checkpoint holds."""
    saved = {"script": Path(__file__).stem, "args": asdict(replace(args, resume=None)), "step": run.step}
    return saved | {"weights": run.agent.state_dict()}


@contextlib.contextmanager
def writing_to(path: Path) -> Iterator[None]:
    """Raise RunError if what is inside cannot write."""
    try:
        yield
    except OSError as error:
        raise RunError(f"cannot write to {path} ({error.strerror})") from error


def write_file(saved: dict[str, Any], path: Path) -> None:
    """Write a model or a checkpoint, in the first process, atomically: the file is whole, or it is not there.

    Raises FloatingPointError, and writes nothing, if a weight is not finite; RunError if it cannot be written.
    """
    if rank_and_size()[0] > 0:
        return
    if not all(weight.isfinite().all() for weight in saved["weights"].values()):
        raise FloatingPointError(f"{path} is not written, since weights are not finite; try a lower --init-lr")
    part, content = Path(f"{path}.part"), io.BytesIO()
    torch.save(saved, content)
    try:
        with writing_to(path):
            part.write_bytes(content.getbuffer())
            flush_to_disk(part)
            os.replace(part, path)
            flush_to_disk(path.parent)  # its new name
    finally:
        with contextlib.suppress(OSError):  # the error of writing is being raised already
            part.unlink(missing_ok=True)


def flush_to_disk(path: Path) -> None:
    """Have the system write a file, or a folder's list of files, to the disk, where a power failure leaves it."""
    if path.is_file() or os.name == "posix":
        handle = os.open(path, os.O_RDONLY if os.name == "posix" else os.O_RDWR)
        os.fsync(handle)
        os.close(handle)


def save_checkpoint(args: Args, run: Run) -> None:
    """Write all that a run goes on with, and keep the checkpoint before it. Raises what `write_file` raises."""
    processes = all_gather(state_of_process(run))
    if run.writer is None:
        return
    with writing_to(run.folder):
        run.writer.flush()
        for file in run.folder.glob("events.out.tfevents.*"):
            flush_to_disk(file)  # a checkpoint means that the curves are there too
    run_state = {"seconds": run.seconds, "returns": list(run.returns), "lengths": list(run.lengths)}
    run_state["optimizer"] = run.optimizer.state_dict()
    run_state["processes"] = map_nested(processes, np.ndarray, torch.from_numpy)  # weights_only loads no arrays
    write_file(model_of(args, run) | run_state, run.folder / f"checkpoint-{run.step}.pt")
    with writing_to(run.folder):
        for path in checkpoints_in(run.folder)[:-2]:
            path.unlink()


def state_of_process(run: Run) -> dict[str, Any]:
    """Return what each process goes on with: environments, memory and generators, in arrays, tensors and numbers."""
    rollout, not_saved = run.rollout, run.agent.memory.not_saved
    memory = rollout.memory_state._asdict()
    return {
        "environments": save_state(run.envs),
        "next_obs": rollout.next_obs,
        "next_ground_truth": rollout.next_ground_truth,
        "memory": {name: part for name, part in memory.items() if name not in not_saved},
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state(rollout.values.device) if rollout.values.is_cuda else None,
        "numpy": np.random.get_state(),  # noqa: NPY002 (it and Python's: environments of other packages may use them)
        "python": random.getstate(),
    }


def load_checkpoint(run: Run, saved: dict[str, Any]) -> None:
    """Set a run that was just made to what `save_checkpoint` wrote: it goes on as if it had never stopped.

    Environments of other packages begin new episodes, with a line that says so. Raises ValueError if weights, optimizer
    or environments do not fit.
    """
    load_weights(run.agent, saved, run.folder)
    run.optimizer.load_state_dict(saved["optimizer"])
    for weight, moments in run.optimizer.state.items():
        if moments["exp_avg"].shape != weight.shape:  # torch tells the weights apart by their order alone
            raise ValueError(
                f"{run.folder}: its checkpoint is of a version with the weights in another order, and training cannot "
                "go on from it; --load-model takes its weights"
            )
    run.step, run.seconds = saved["step"], saved["seconds"]
    run.returns.extend(saved["returns"])
    run.lengths.extend(saved["lengths"])
    rank, rollout = rank_and_size()[0], run.rollout
    state = saved["processes"][rank]
    random.setstate(state["python"])
    torch.set_rng_state(state["torch"])
    if state["cuda"] is not None and rollout.values.is_cuda:
        torch.cuda.set_rng_state(state["cuda"], rollout.values.device)
    names = ("environments", "next_obs", "next_ground_truth", "numpy")
    arrays = map_nested({name: state[name] for name in names}, Tensor, Tensor.numpy)
    np.random.set_state(arrays["numpy"])  # noqa: NPY002
    if arrays["environments"] is None:
        if rank == 0:
            print(f"{run.envs.spec.id} has no state to save: every environment begins a new episode", file=sys.stderr)
        return
    load_state(run.envs, arrays["environments"])
    rollout.next_obs, rollout.next_ground_truth = arrays["next_obs"], arrays["next_ground_truth"]
    memory, fresh = state["memory"], rollout.memory_state
    for name, part in memory.items():
        memory[name] = part.to(getattr(fresh, name).device) if isinstance(part, Tensor) else part
    rollout.memory_state = fresh._replace(**memory)


def map_nested(value: Any, kind: type, function: Callable) -> Any:
    """Apply a function to all values of a kind in nested dicts, lists and tuples."""
    if isinstance(value, dict):
        return {name: map_nested(each, kind, function) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(map_nested(each, kind, function) for each in value)
    return function(value) if isinstance(value, kind) else value


def checkpoints_in(folder: str | Path) -> list[Path]:
    """Return the checkpoints of a run, the latest last."""
    found = {int(path.stem[11:]): path for path in Path(folder).glob("checkpoint-*.pt") if path.stem[11:].isdecimal()}
    return [found[step] for step in sorted(found)]


def read_checkpoint(folder: str | Path) -> dict[str, Any]:
    """Read a run's last checkpoint, which has all that `read_model` returns and more.

    Raises ValueError if it is not whole, OSError if there is none.
    """
    if not (found := checkpoints_in(folder)):
        raise OSError(f"--resume {folder}: there is no checkpoint-STEP.pt in this folder")
    try:
        return read_model(found[-1])
    except ValueError as error:
        before = f"go on from {found[-2]}" if len(found) > 1 else "begin again"
        raise ValueError(f"{error}; remove it to {before}") from None


def check_resumed(args: Args, saved: dict[str, Any]) -> None:
    """Raise ValueError if the arguments are not those of the run that --resume goes on with."""
    if saved["script"] != Path(__file__).stem:
        raise ValueError(f"--resume {args.resume}: this run is {saved['script']}.py's, not {Path(__file__).name}'s")
    if "processes" not in saved:
        raise ValueError(f"--resume {args.resume}: its last checkpoint holds weights alone; --load-model takes these")
    theirs = saved_args(saved)
    for name in (each.name for each in fields(Args) if each.name not in ("resume", "total_timesteps")):
        if getattr(args, name) != getattr(theirs, name):
            raise ValueError(
                f"{flag(name)} is {getattr(args, name)}, but the run in {args.resume} has {getattr(theirs, name)}; "
                "leave the flag out, or begin another run"
            )
    if args.total_timesteps < theirs.total_timesteps:
        raise ValueError(
            f"--total-timesteps is {args.total_timesteps}, but the run in {args.resume} has {theirs.total_timesteps}; "
            "it may be extended only"
        )
    before, processes = len(saved["processes"]), rank_and_size()[1]
    if before != processes:
        raise ValueError(f"--resume {args.resume}: this run has {before} processes, not {processes}; start as many")


def read_model(path: str | Path) -> dict[str, Any]:
    """Read a model or a checkpoint, to the CPU: the script's name, its arguments, the weights, and what more it holds.

    Raises ValueError if it is not such a file, OSError if it cannot be read.
    """
    if not os.path.isfile(path):
        raise OSError(f"there is no file {path}; --save-model writes model.pt to the run folder")
    content = io.BytesIO(Path(path).read_bytes())
    try:
        saved = torch.load(content, map_location="cpu", weights_only=True)
        return {**saved, "script": saved["script"], "args": dict(saved["args"]), "weights": dict(saved["weights"])}
    except Exception:  # torch.load raises many kinds of errors for a wrong file, and none tells more
        raise ValueError(f"{path} is cut short, or neither a model nor a checkpoint") from None


def saved_args(saved: dict[str, Any]) -> Args:
    """Return the arguments in what `read_model` read; a flag that is newer than the file has its default."""
    known = {each.name for each in fields(Args)}
    given = {name: value for name, value in saved["args"].items() if name in known}
    return Args(**given)


def load_weights(agent: Agent, saved: dict[str, Any], path: str | Path) -> None:
    """Give the agent the weights in what `read_model` read; auxiliary heads may be added to it or left out.

    Raises ValueError if they are another script's or another network's, or not finite.
    """
    if saved["script"] != Path(__file__).stem:
        raise ValueError(f"{path} was trained by {saved['script']}.py, not by {Path(__file__).name}")
    try:
        missing, unexpected = agent.load_state_dict(saved["weights"], strict=False)
        if not all(name.startswith(("decoder.", "estimator.")) for name in (*missing, *unexpected)):
            raise RuntimeError
    except (RuntimeError, TypeError):
        theirs = as_flags({name: getattr(saved_args(saved), name) for name in NETWORK_FLAGS})
        raise ValueError(f"{path} holds the weights of another network, trained with {theirs}") from None
    if not all(weight.isfinite().all() for weight in saved["weights"].values()):
        raise ValueError(f"{path} holds weights that are not finite: the training diverged")


def stop_on_signals(run: Run) -> None:
    """Have SIGINT (Ctrl-C) and SIGTERM end the training after the current iteration, a second Ctrl-C at once.

    A second SIGTERM does not: torchrun passes on the one that a cluster has sent to all processes.
    """

    def stop(number: int, _: Any) -> None:
        if run.received_signal and number == signal.SIGINT and not dist.is_initialized():
            raise KeyboardInterrupt
        if not run.received_signal and run.bar is not None:
            hint = "" if dist.is_initialized() else "; Ctrl-C stops at once, without a checkpoint"
            os.write(2, f"\nstopping at the end of this iteration{hint}\n".encode())  # print might be at work already
        run.received_signal = number

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)


def close(run: Run) -> None:
    """Close all files, environments and connections."""
    for each in filter(None, (run.bar, run.envs, run.eval_envs, run.writer, run.lock)):
        with contextlib.suppress(OSError):  # that a file cannot be written was reported before
            each.close()
    if dist.is_initialized():
        dist.destroy_process_group()


def run_to_end(args: Args, run: Run) -> Path:
    """Train until it is done or stopped; return the run folder. Raises what `train` and `write_file` raise.

    With --save-model, what was learned is kept, unless the training diverged, a file could not be written or another
    process ended.
    """
    save_model = args.save_model
    try:
        train(args, run)
        if run.writer is not None:
            with writing_to(run.folder):
                run.writer.flush()
    except KeyboardInterrupt:
        pass
    except (FloatingPointError, RunError, MemoryLimit) as error:
        save_model = save_model and isinstance(error, MemoryLimit)
        found = checkpoints_in(run.folder)
        last = f"the last checkpoint is {found[-1]}" if found else "there is no checkpoint yet"
        raise type(error)(f"iteration {run.iteration}: {error}; {last}") from error
    finally:
        try:
            if save_model:
                write_file(model_of(args, run), run.folder / "model.pt")
        finally:
            close(run)
    return run.folder


def main(args: Args) -> Path:
    """Train an agent as the arguments say; return the run folder. Raises what `setup` and `run_to_end` raise."""
    return run_to_end(args, setup(args))


# ---- 9 FAST PATHS ----
class UniqueObservations:
    """The observations of a rollout, of which equal ones are encoded once in a minibatch.

    On a CPU the encoder of images is most of the work, and in grid tasks most images repeat. Elsewhere every
    observation is encoded. The gradient is the same, up to rounding.
    """

    def __init__(self, obs: dict[str, Tensor], agent: Agent):
        self.obs = {name: part.flatten(0, 1) for name, part in obs.items()}  # (T * N, ...)
        on_cpu = all(part.device.type == "cpu" for part in obs.values())
        self.first_occurrence = first_occurrences(self.obs) if agent.encoder.images and on_cpu else None

    def encode(self, encoder: Encoder, index: Tensor) -> Tensor:
        """Encode the observations at the flat indices (B,): (B, I)."""
        inverse = None
        if self.first_occurrence is not None:
            index, inverse = self.first_occurrence[index].unique(return_inverse=True)
        count = len(index)
        if torch.is_autocast_enabled("cpu"):
            # Kernels for bfloat16 are compiled for every batch size, which can take longer than running them.
            index = F.pad(index, (0, -count % 16))
        x = encoder({name: part.index_select(0, index.to(part.device)) for name, part in self.obs.items()})[:count]
        return x if inverse is None else x.index_select(0, inverse)


def first_occurrences(obs: dict[str, Tensor]) -> Tensor:
    """Return, for each observation (T * N, ...), the index (T * N,) of the first one that is equal to it.

    Takes tensors on the CPU. Equal are those whose bytes have the same 64-bit hash.
    """
    first: dict[int, int] = {}
    samples = zip(*(part.numpy() for part in obs.values()), strict=True)
    hashes = (hash(tuple(part.tobytes() for part in sample)) for sample in samples)
    return torch.tensor([first.setdefault(each, index) for index, each in enumerate(hashes)])


CHUNK = 256  # the backward pass of 2,048 images at once takes about 1.5 times as long on a CPU, for its caches


def in_chunks(network: Callable, x: Tensor) -> Tensor:
    """Apply a network that reads or makes images to x (B, ...): on a CPU chunk by chunk."""
    if x.device.type != "cpu" or len(x) <= CHUNK:
        return network(x)
    return torch.cat([network(part) for part in x.split(CHUNK)])


if __name__ == "__main__":
    try:
        args = parse_args(sys.argv[1:])
        run = setup(args)
    except (ValueError, OSError, ImportError, gym.error.Error, RunError) as error:
        sys.exit(f"{Path(__file__).name}: {' '.join(str(error).split())}")
    stop_on_signals(run)
    # If TensorBoard's thread fails to write, the next call to the writer raises here.
    threading.excepthook = lambda it: None if "tensorboard" in repr(type(it.thread)) else threading.__excepthook__(it)
    try:
        run_to_end(args, run)
    except (MemoryLimit, FloatingPointError, RunError) as error:
        sys.exit(f"{Path(__file__).name}: {' '.join(str(error).split())}")
    sys.exit(128 + run.received_signal if run.received_signal else 0)
