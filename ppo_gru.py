"""PPO that remembers with a recurrent network: GRU, LSTM, or nothing at all for comparison.

    python ppo_gru.py --env-id MortarMayhem-Grid-v0

The agent sees one observation at a time and carries a hidden state from step to step, zeroed where an episode ends.
While it plays, every step's hidden state is stored. To learn, each lane's steps are cut into pieces at the ends of
episodes (and every --seq-len steps), padded with zeros to the longest piece and unrolled from the piece's stored
hidden state: truncated back-propagation through time. The gradient reaches back to the beginning of the piece, never
further; what the piece was given to start with was computed with the weights of the time, and is not recomputed.

After chapter 5 of "Memory-based Deep Reinforcement Learning in Endless Imperfect Information Games", called the thesis
below; numbers in brackets are its equations, defaults are the "Final" column of its table 6.1. Only section 5 knows
which memory this is.

Shape letters: T steps of a rollout, N lanes (environments in parallel), A action branches, R steps of a minibatch,
S pieces of a minibatch, L steps of the longest piece, D width of the memory, P hidden vectors per lane.
"""

import contextlib
import importlib
import itertools
import json
import math
import os
import sys
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from functools import partial
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
import torch.nn.functional as F
import tyro
from gymnasium.vector import AutoresetMode
from torch import Tensor, nn
from torch.distributions import Categorical
from torch.nn.utils.rnn import pad_sequence
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from memory_gym_envs.wrappers import GrayscaleStack, StepEncoding, VectorStack


# ---- 1 ARGS ----
@dataclass
class Args:
    """Train a PPO agent with a recurrent memory."""

    exp_name: str = "ppo_gru"
    """name of the experiment, part of the run folder's name"""
    seed: int = 1
    """seed of the weights, the actions and the environments: same seed, same curves (on the CPU to the last bit)"""
    torch_deterministic: bool = True
    """ask cuDNN for deterministic algorithms"""
    cuda: bool = True
    """train on the GPU when there is one"""
    amp: bool = False
    """compute the networks in bfloat16, faster on processors that have it; losses stay in float32"""
    compile: bool = False
    """compile convolutions and heads before training: takes a minute, and on a CPU a C++ compiler"""
    cuda_graphs: bool = False
    """on a GPU, replay the act step, and gradient steps of unchanging shapes, as CUDA graphs"""
    track: bool = False
    """log to Weights and Biases too (needs the extra `track`)"""
    wandb_project_name: str = "memory-gym-baselines"
    """the project's name at Weights and Biases"""
    wandb_entity: str | None = None
    """the team's name at Weights and Biases"""
    capture_video: bool = False
    """record some episodes of lane 0 to the run folder (needs the extra `play`)"""
    save_model: bool = False
    """write weights and arguments to model.pt in the run folder when training ends"""
    load_model: str | None = None
    """start from the weights in this file, written by --save-model"""

    env_id: str = "MortarMayhem-Grid-v0"
    """any Gymnasium id with Discrete or MultiDiscrete actions and pixels, vectors or a Dict of them as observation"""
    env_options: str = "{}"
    """reset parameters of a Memory Gym environment as JSON, e.g. '{"command_count": [4]}'"""
    num_levels: int = 100_000
    """how many levels a Memory Gym environment trains on (0: no limit)"""
    start_level: int = 0
    """the first of these levels"""
    obs_type: Literal["pixels", "vector"] = "pixels"
    """what a Memory Gym environment shows: pictures, or a vector of all that is to be seen on them"""
    frame_stack: int = 0
    """observe the last so many pictures at once, in grayscale, or so many vectors (0: only the present, in colour)"""
    step_encoding: bool = False
    """observe the number of the episode's step too, as a sinusoidal encoding of width 16"""
    vector_frequencies: int = 0
    """give the network sines and cosines of a vector's numbers, from 0 to 1, too, at so many frequencies (0: none)"""

    total_timesteps: int = 163_840_000
    """steps to train for, all lanes together, rounded down to whole iterations of num_envs x num_steps"""
    num_envs: int = 32
    """lanes: environments that play in parallel"""
    num_steps: int = 512
    """steps of each lane in one rollout"""
    num_minibatches: int = 8
    """minibatches of an epoch"""
    update_epochs: int = 3
    """how often each rollout is learned from"""
    gamma: float = 0.995
    """discount factor"""
    gae_lambda: float = 0.95
    """lambda of generalized advantage estimation"""
    bootstrap_truncated: bool = False
    """value the final observation of an episode that a time limit cut short, instead of counting it as ended"""
    norm_adv: bool = False
    """normalize the advantages of each minibatch"""
    clip_coef: float = 0.1
    """how far the probability ratio, and the value, may move from the rollout's"""
    clip_vloss: bool = True
    """clip the value loss too"""
    vf_coef: float = 0.5
    """weight of the value loss"""
    max_grad_norm: float = 0.25
    """the gradient is scaled down to this norm"""
    target_kl: float | None = None
    """end an iteration's learning after the epoch whose mean KL divergence exceeds this"""
    init_lr: float = 2.75e-4
    """learning rate at the first step"""
    final_lr: float = 1.0e-5
    """learning rate from step --anneal-steps on"""
    init_ent_coef: float = 1.0e-4
    """weight of the entropy bonus at the first step"""
    final_ent_coef: float = 1.0e-6
    """weight of the entropy bonus from step --anneal-steps on"""
    anneal_steps: int = 163_840_000
    """steps over which both decay linearly (0: both keep their initial values)"""
    reconstruction_coef: float = 0.0
    """weight of the loss of drawing the observed picture from the memory's output (0: not drawn; the thesis has 0.1)"""
    ground_truth_coef: float = 0.0
    """weight of the loss of estimating the environment's ground truth (0: not estimated; the thesis has 0.1)"""
    ground_truth_detach: bool = False
    """estimate without teaching the agent: a probe of what its memory holds"""
    head_size: int = 512
    """width of the layer behind the memory, and of the heads' own layers"""

    eval_interval: int = 0
    """iterations from one evaluation to the next, and one at the end, on levels that are not trained on (0: none)"""
    eval_levels: int = 50
    """levels of an evaluation: those that follow start_level + num_levels - 1"""
    eval_repeats: int = 3
    """how often an evaluation plays each level"""
    eval_max_steps: int = 10_000
    """steps after which an evaluation cuts an endless episode short"""

    memory: Literal["gru", "lstm", "none"] = "gru"
    """what the agent remembers with"""
    hidden_size: int = 512
    """width of the hidden state"""
    num_layers: int = 1
    """stacked recurrent layers"""
    seq_len: int = 0
    """longest piece the gradient flows through (0: the longest episode in the rollout)"""


def flag(name: str) -> str:
    """Return the command line's spelling of a field of Args."""
    return "--" + name.replace("_", "-")


def check_args(args: Args) -> None:
    """Raise ValueError, naming the flag and what it may be, for the first value or combination that cannot work."""
    integers = [(name, 0) for name in ("num_levels", "start_level", "anneal_steps", "seed")]
    integers += [(name, 0) for name in ("frame_stack", "eval_interval", "seq_len")]
    integers += [(name, 1) for name in ("num_envs", "num_steps", "num_minibatches", "update_epochs")]
    integers += [(name, 1) for name in ("head_size", "eval_levels", "eval_repeats", "eval_max_steps")]
    integers += [(name, 1) for name in ("total_timesteps", "hidden_size", "num_layers")]
    numbers = [("gamma", 0, 1), ("gae_lambda", 0, 1), ("vector_frequencies", 0, 16)]
    numbers += [(name, 0, math.inf) for name in ("vf_coef", "init_lr", "final_lr", "init_ent_coef", "final_ent_coef")]
    numbers += [(name, 0, math.inf) for name in ("reconstruction_coef", "ground_truth_coef")]
    for name, low in integers:
        if not low <= getattr(args, name) < 2**63:
            raise ValueError(f"{flag(name)} is {getattr(args, name)}; it must be {low} or more (and below 2 ** 63)")
    for name, low, high in numbers:
        if not low <= getattr(args, name) <= high or not math.isfinite(getattr(args, name)):
            raise ValueError(f"{flag(name)} is {getattr(args, name)}; it must be a number from {low} to {high}")
    for name in ("clip_coef", "max_grad_norm", "target_kl"):
        value = getattr(args, name)
        if value is not None and not value > 0:
            raise ValueError(f"{flag(name)} is {value}; it must be above 0")
    if not args.exp_name or set(args.exp_name) & set("/\\"):
        raise ValueError(f"--exp-name is {args.exp_name!r}; it must be a name without slashes")
    batch_size = args.num_envs * args.num_steps
    if args.total_timesteps < batch_size:
        raise ValueError(
            f"--total-timesteps is {args.total_timesteps}, less than one iteration of {batch_size} steps "
            f"(--num-envs {args.num_envs} x --num-steps {args.num_steps})"
        )
    longest = 1 if args.memory == "none" else min(args.seq_len or args.num_steps, args.num_steps)
    if args.num_minibatches * longest > batch_size:
        raise ValueError(
            f"--num-minibatches is {args.num_minibatches}, but an iteration is sure of only {batch_size // longest} "
            f"pieces to deal (up to {longest} of {batch_size} steps each); use that many or a shorter --seq-len"
        )


# ---- 2 ENVIRONMENTS ----
def make_envs(args: Args, num_envs: int, render_mode: str | None = None) -> gym.vector.VectorEnv:
    """Make a vector environment with same-step autoreset: an ended lane's next observation begins a new episode.

    With a render_mode, render() returns a picture a lane: debug_rgb_array, which Memory Gym alone has, or rgb_array.
    Raises gymnasium.error.Error for an unknown id, ImportError for a missing package or module, ValueError for wrong
    levels and for an observation that the environment does not offer.
    """
    module, _, name = args.env_id.rpartition(":")
    if module:
        importlib.import_module(module)
    levels = is_memory_gym(name)
    kwargs = {"render_mode": render_mode if levels else "rgb_array"} if render_mode else {}
    if levels:
        kwargs |= {"num_levels": args.num_levels, "start_level": args.start_level, "obs_type": args.obs_type}
    elif args.obs_type != "pixels":
        raise ValueError(f"--obs-type is of Memory Gym environments; {args.env_id} has one kind of observation")
    try:
        envs = same_step_envs(name, num_envs, kwargs)
    except TypeError as error:  # what a constructor says of an argument that it does not take
        raise ValueError(f"{args.env_id} cannot be made: {error}") from None
    if args.frame_stack:
        pictures = any(len(part.shape) == 3 for part in observation_spaces(envs.single_observation_space).values())
        envs = (GrayscaleStack if pictures else VectorStack)(envs, args.frame_stack)
    return StepEncoding(envs) if args.step_encoding else envs


def same_step_envs(name: str, num_envs: int, kwargs: dict[str, Any]) -> gym.vector.VectorEnv:
    """Make the id's own vector environment if it resets in the same step, else Gymnasium's synchronous one."""
    if gym.spec(name).vector_entry_point is not None:
        envs = gym.make_vec(name, num_envs, **kwargs)
        if envs.metadata.get("autoreset_mode") == AutoresetMode.SAME_STEP:
            return envs
        envs.close()
    same_step = {"autoreset_mode": AutoresetMode.SAME_STEP}
    return gym.make_vec(name, num_envs, vectorization_mode="sync", vector_kwargs=same_step, **kwargs)


def is_memory_gym(env_id: str) -> bool:
    """Tell whether the id is one of this repository's environments, which have levels and reset parameters."""
    return str(gym.spec(env_id.rpartition(":")[2]).entry_point).startswith("memory_gym_envs")


def reset_options(env_id: str, env_options: str) -> dict | None:
    """Parse --env-options; raise ValueError if it is no JSON object or the environment has no such parameters."""
    try:
        options = json.loads(env_options)
    except json.JSONDecodeError as error:
        raise ValueError(f"--env-options is no JSON ({error}): {env_options}") from None
    if not isinstance(options, dict):
        raise ValueError(f'--env-options must be a JSON object such as {{"visual_feedback": false}}, not {env_options}')
    if options and not is_memory_gym(env_id):
        raise ValueError(f"--env-options are reset parameters of Memory Gym environments; {env_id} has none")
    return options or None


def first_reset(envs: gym.vector.VectorEnv, seed: int, options: dict | None) -> tuple[dict[str, Tensor], dict]:
    """Seed every lane with its own stream, then begin each lane's first episode; return observations (N, ...), infos.

    Raises ValueError for a reset parameter that the environment does not have or allow.
    """
    # Neighbouring run seeds must not share lanes, so the lanes' seeds count up from a hash of the run's seed.
    envs.reset(seed=int(np.random.SeedSequence(seed).generate_state(1)[0]), options=options)
    # An explicit seed is a level of its own; from here on the levels come from the training set.
    obs, infos = envs.reset(options=options)
    return as_tensors(obs), infos


def ground_truth_of(infos: dict) -> Tensor:
    """Return the ground truth (N, G) in the infos; raise ValueError if the environment reports none of that shape."""
    truth = np.asarray(infos.get("ground_truth"))
    if truth.ndim != 2 or truth.dtype.kind not in "biuf":
        raise ValueError("--ground-truth-coef needs an environment that has ground_truth, an array, in its info; use 0")
    return torch.as_tensor(truth, dtype=torch.float32)


def observation_spaces(space: gym.Space) -> dict[str, gym.spaces.Box]:
    """Name the parts of an observation; raise ValueError for a space that the encoder has no layer for."""
    parts = dict(space.spaces) if isinstance(space, gym.spaces.Dict) else {"observation": space}
    for name, part in parts.items():
        box = isinstance(part, gym.spaces.Box)
        pixels = box and len(part.shape) == 3 and min(part.shape[:2]) >= 36
        pixels = pixels and (part.dtype == np.uint8 or (part.low.min() >= 0 and part.high.max() <= 1))
        if not pixels and not (box and len(part.shape) == 1):
            raise ValueError(
                f"the observation space {name}: {part} is not supported; use pixels (height, width, channels) of at "
                "least 36 x 36, bytes or numbers from 0 to 1, a vector, or a Dict of these"
            )
    return parts


def action_branches(space: gym.Space) -> list[int]:
    """Return the number of actions of each branch; raise ValueError for other than Discrete and MultiDiscrete."""
    if isinstance(space, gym.spaces.Discrete):
        return [int(space.n)]
    if isinstance(space, gym.spaces.MultiDiscrete) and space.nvec.ndim == 1:
        return space.nvec.tolist()
    raise ValueError(f"the action space {space} is not supported; use Discrete or one-dimensional MultiDiscrete")


def to_env_actions(actions: Tensor, space: gym.Space) -> np.ndarray:
    """Turn branch choices (N, A) into what the environments take: (N,) for Discrete, (N, A) for MultiDiscrete."""
    actions = actions.cpu().numpy() + space.start  # the first action's number, 0 unless the space says otherwise
    return actions[:, 0] if isinstance(space, gym.spaces.Discrete) else actions


def as_tensors(obs: np.ndarray | dict[str, np.ndarray]) -> dict[str, Tensor]:
    """Give observations their names of `observation_spaces`, as tensors on the CPU."""
    parts = obs if isinstance(obs, dict) else {"observation": obs}
    return {name: torch.from_numpy(np.ascontiguousarray(part)) for name, part in parts.items()}


def require(module: str, name: str, extra: str):
    """Import a module that only the flag `name` needs; raise ImportError that says which extra brings it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise ImportError(f'{name} needs {module.split(".")[0]}: pip install -e ".[{extra}]"') from None


class LaneRecorder:
    """Writes videos of lane 0, of the episodes that Gymnasium's capped cubic schedule picks (0, 1, 8, 27, ...).

    A video shows every observation that was acted on. It is written when the episode ends or max_frames are reached.
    Raises ImportError without the extra `play`, ValueError if the environment draws no pictures.
    """

    def __init__(self, envs: gym.vector.VectorEnv, folder: str, max_frames: int = 1000):
        self.envs, self.folder, self.max_frames = envs, folder, max_frames
        self.episode, self.frames, self.written = 0, [], False
        self.clip = require("moviepy.video.io.ImageSequenceClip", "--capture-video", "play").ImageSequenceClip
        # Gymnasium's module imports moviepy as well, so it must not be imported without the extra.
        self.is_due = importlib.import_module("gymnasium.utils.save_video").capped_cubic_video_schedule
        if not isinstance((envs.render() or [None])[0], np.ndarray):
            raise ValueError("--capture-video needs an environment that draws pictures (render_mode rgb_array)")

    def capture(self) -> None:
        """Keep a frame of the episode that is being played, if it is one to record."""
        if self.is_due(self.episode) and not self.written:
            self.frames.append(self.envs.render()[0])
            if len(self.frames) == self.max_frames:
                self.write()

    def end_episode(self) -> None:
        """Write the episode's video, unless that is done, and go on to the next episode."""
        if self.frames:
            self.write()
        self.episode, self.written = self.episode + 1, False

    def write(self) -> None:
        """Write the frames to episode-<number>.mp4 and let go of them."""
        os.makedirs(self.folder, exist_ok=True)
        clip = self.clip(self.frames, fps=self.envs.metadata.get("render_fps", 30))
        clip.write_videofile(os.path.join(self.folder, f"episode-{self.episode}.mp4"), logger=None)
        self.frames, self.written = [], True


# ---- 3 PURE FUNCTIONS ----
def layer_init(layer: nn.Module, gain: float = math.sqrt(2)) -> nn.Module:
    """Initialize a layer's weights orthogonally and its biases with zero; return it."""
    for name, parameter in layer.named_parameters():
        nn.init.zeros_(parameter) if "bias" in name else nn.init.orthogonal_(parameter, gain)
    return layer


def with_frequencies(x: Tensor, frequencies: int) -> Tensor:
    """Append to numbers (B, V) their Fourier features, sines and cosines at pi, 2 pi, 4 pi ...: (B, V (1 + 2 K)).

    What differs little in x differs much in these, so that a network tells it apart sooner (Tancik et al., 2020).
    """
    angles = x[..., None] * (math.pi * 2 ** torch.arange(frequencies, device=x.device))  # (B, V, K)
    return torch.cat([x, angles.sin().flatten(1), angles.cos().flatten(1)], -1)


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
    carry = gamma * gae_lambda * ~done
    advantages = torch.empty_like(deltas)
    advantage = torch.zeros_like(last_value)
    for t in reversed(range(len(deltas))):
        advantages[t] = advantage = deltas[t] + carry[t] * advantage
    return advantages


def draw(policy: list[Categorical]) -> Tensor:
    """Draw an action of every branch, (B, A): the very ones that `sample` draws, but a GPU is asked for no number."""
    races = [branch.probs / torch.empty_like(branch.probs).exponential_() for branch in policy]
    return torch.stack([race.argmax(-1) for race in races], -1)


def log_probs_of(policy: list[Categorical], actions: Tensor) -> Tensor:
    """Return the log-probability (B, A) of the chosen action (B, A) of every branch."""
    return torch.stack([branch.log_prob(action) for branch, action in zip(policy, actions.unbind(-1), strict=True)], -1)


def policy_loss(log_ratio: Tensor, advantages: Tensor, clip_coef: float) -> Tensor:
    """Return the clipped surrogate loss (2.41) of log_ratio (R, A), averaged over branches (5.4) and steps."""
    ratio, advantages = log_ratio.exp(), advantages[:, None]
    clipped = ratio.clamp(1 - clip_coef, 1 + clip_coef)
    return -torch.minimum(ratio * advantages, clipped * advantages).mean()


def value_loss(values: Tensor, old_values: Tensor, returns: Tensor, clip_coef: float | None) -> Tensor:
    """Return the mean squared error of values (R,), clipped around old_values (2.43) unless clip_coef is None."""
    loss = (values - returns).square()
    if clip_coef is not None:
        clipped = old_values + (values - old_values).clamp(-clip_coef, clip_coef)
        loss = torch.maximum(loss, (clipped - returns).square())
    return loss.mean()


def reconstruction_loss(logits: Tensor, pixels: Tensor) -> Tensor:
    """Return the mean binary cross-entropy (5.5) of drawn pictures, as logits, and the pixels, both (R, H, W, C)."""
    return F.binary_cross_entropy_with_logits(logits, pixels / 255 if pixels.dtype == torch.uint8 else pixels)


def first_alike(obs: dict[str, Tensor]) -> Tensor:
    """Return, for every step of a rollout, the flat index (T * N,) of the first step with the same observation.

    Takes each part (T, N, ...), on the CPU. The same are those whose bytes have the same 64-bit hash.
    """
    first: dict[int, int] = {}
    steps = zip(*(part.flatten(0, 1).numpy() for part in obs.values()), strict=True)
    hashes = (hash(tuple(part.tobytes() for part in step)) for step in steps)
    return torch.tensor([first.setdefault(each, index) for index, each in enumerate(hashes)])


@dataclass
class Pieces:
    """Runs of consecutive steps of one lane each. Step t of lane n has the flat index t * N + n."""

    first: Tensor  # (S,) flat index of each piece's first step, on the rollout's device once it is learned from
    length: Tensor  # (S,) steps of each piece, on the CPU, as shapes depend on it
    lanes: int  # N

    @classmethod
    def cut(cls, begins: Tensor) -> "Pieces":
        """Cut the rollout of all lanes before every step where begins (T, N) is true; the first step always is."""
        steps, lanes = begins.shape
        cuts = begins.T.flatten().nonzero()[:, 0]  # lane after lane, so that a piece's steps are neighbours
        length = torch.diff(cuts, append=torch.tensor([steps * lanes]))
        return cls(cuts % steps * lanes + cuts // steps, length, lanes)

    def steps(self) -> Tensor:
        """Return the flat indices (R,) of all steps, piece after piece."""
        return self.unpad(self.first[:, None] + self.places(self.first.device) * self.lanes)

    def within(self) -> Tensor:
        """Return which step of its piece, counted from 0, each step (R,) is."""
        return self.unpad(self.places().expand(len(self.length), -1))

    def places(self, device: torch.device | None = None) -> Tensor:
        """Number the places (L,) of a piece that is padded to the longest."""
        return torch.arange(int(self.length.max()), device=device)

    def even(self) -> bool:
        """Tell whether all pieces have the same length, so that there is no padding."""
        return bool((self.length == self.length[0]).all())

    def pad(self, x: Tensor) -> Tensor:
        """Pad what belongs to the steps, (R, D), with zeros to the longest piece: (S, L, D)."""
        if self.even():
            return x.unflatten(0, (len(self.length), -1))
        return pad_sequence(x.split(self.length.tolist()), batch_first=True)

    def unpad(self, y: Tensor) -> Tensor:
        """Drop the padding: (S, L, ...) to (R, ...)."""
        if self.even():
            return y.flatten(0, 1)
        real = (self.places() < self.length[:, None]).flatten().nonzero()[:, 0]
        return y.flatten(0, 1).index_select(0, real.to(y.device))

    def minibatches(self, count: int) -> Iterator["Pieces"]:
        """Shuffle the pieces and deal them, whole, into count minibatches of nearly the same number of steps."""
        order = torch.randperm(len(self.first))
        first, length = self.first[order.to(self.first.device)], self.length[order]
        share = (length.cumsum(0) - length) * count // length.sum()  # (S,) the minibatch that a piece goes to
        sizes = share.bincount(minlength=count).tolist()
        for mb_first, mb_length in zip(first.split(sizes), length.split(sizes), strict=True):
            yield Pieces(mb_first, mb_length, self.lanes)


# ---- 4 ENCODERS AND HEADS ----
class AtariCNN(nn.Sequential):
    """The convolutions of Mnih et al. (2015), table 6.2: pixels (B, height, width, channels) to features (B, F)."""

    def __init__(self, channels: int, chunk: int = 256):
        super().__init__(
            layer_init(nn.Conv2d(channels, 32, 8, 4)),
            nn.ReLU(inplace=True),
            layer_init(nn.Conv2d(32, 64, 4, 2)),
            nn.ReLU(inplace=True),
            layer_init(nn.Conv2d(64, 64, 3, 1)),
            nn.ReLU(inplace=True),
        )
        self.chunk = chunk
        self.to(memory_format=torch.channels_last)  # the order in which the environments deliver pixels

    def forward(self, pixels: Tensor) -> Tensor:
        """Encode uint8 pixels, scaled to [0, 1], or float ones as they are."""
        # A CPU's caches want small batches: the backward pass of 2,048 frames at once takes about 1.5 times as long.
        size = self.chunk if pixels.device.type == "cpu" else len(pixels)
        # Compiled for a CPU, it is so for one size: the rest of a batch would be compiled anew every time.
        whole, rest = self.convolve, partial(AtariCNN.convolve, self)
        features = [(whole if len(chunk) == size else rest)(chunk) for chunk in pixels.split(size)]
        features = torch.cat(features) if len(features) > 1 else features[0]  # (B, channels, height, width)
        return features.permute(0, 2, 3, 1).flatten(1)  # in the order they have in memory: no copy

    def convolve(self, pixels: Tensor) -> Tensor:
        """Scale and convolve pixels: (B, height, width, channels) to (B, channels, height, width)."""
        return super().forward(self.scale(pixels))

    @staticmethod
    def scale(pixels: Tensor) -> Tensor:
        """Turn (B, height, width, channels) into float (B, channels, height, width), still channels last in memory."""
        scaled = pixels.float().mul_(1 / 255) if pixels.dtype == torch.uint8 else pixels
        return scaled.permute(0, 3, 1, 2)


def rounded_up(x: Tensor, multiple: int = 16) -> Tensor:
    """Append rows of zeros to x (B, ...) up to a multiple, where a CPU computes in bfloat16.

    It compiles these kernels for every number of rows that it meets, which can take longer than running them.
    """
    if not torch.is_autocast_enabled("cpu"):
        return x
    return F.pad(x, (*(x.dim() - 1) * (0, 0), 0, -len(x) % multiple))


class Encoder(nn.Module):
    """Encodes each part of an observation, concatenates the features and embeds them in the memory's width (5.1).

    Raises ValueError for frequencies without a vector to take them of.
    """

    def __init__(self, spaces: dict[str, gym.spaces.Box], width: int, frequencies: int):
        super().__init__()
        self.frequencies = frequencies
        self.pixels = [name for name, space in spaces.items() if len(space.shape) == 3]
        self.vectors = [name for name, space in spaces.items() if len(space.shape) == 1]
        self.cnns = nn.ModuleList(AtariCNN(spaces[name].shape[2]) for name in self.pixels)
        with torch.no_grad():
            blank = [torch.zeros(1, *spaces[name].shape) for name in self.pixels]
            features = sum(cnn(x).shape[1] for cnn, x in zip(self.cnns, blank, strict=True))
        if self.vectors:
            numbers = sum(spaces[name].shape[0] for name in self.vectors)
            self.mlp = layer_init(nn.Linear(numbers * (1 + 2 * frequencies), 128))
            features += 128
        elif frequencies:
            raise ValueError("--vector-frequencies needs an observation with a vector; use 0")
        self.embedding = layer_init(nn.Linear(features, width))

    def forward(self, obs: dict[str, Tensor]) -> Tensor:
        """Encode observations of B steps, each part (B, ...), to (B, D)."""
        rows, obs = len(next(iter(obs.values()))), {name: rounded_up(part) for name, part in obs.items()}
        features = [cnn(obs[name]) for cnn, name in zip(self.cnns, self.pixels, strict=True)]
        if self.vectors:
            vector = torch.cat([obs[name].float() for name in self.vectors], -1)
            features.append(F.relu(self.mlp(with_frequencies(vector, self.frequencies))))
        features = torch.cat(features, -1) if len(features) > 1 else features[0]
        return F.relu(self.embedding(features))[:rows].float()


class Decoder(nn.Sequential):
    """The Atari CNN turned round, which draws the observed picture (5.1.2, table 6.2).

    Maps features (B, F) to logits (B, height, width, channels). Raises ValueError unless there is one picture to draw.
    """

    def __init__(self, features: int, spaces: dict[str, gym.spaces.Box]):
        pictures = [space.shape for space in spaces.values() if len(space.shape) == 3]
        if len(pictures) != 1:
            raise ValueError(f"--reconstruction-coef needs an observation with one picture, not {len(pictures)}; use 0")
        height, width, channels = pictures[0]
        sizes = [(height, width)]  # of the pictures between the layers, from the last one to the first
        for kernel, stride in ((8, 4), (4, 2), (3, 1)):
            sizes.append(tuple((size - kernel) // stride + 1 for size in sizes[-1]))
        rest = [[(size - kernel) % stride for size in sizes[i]] for i, (kernel, stride) in enumerate(((8, 4), (4, 2)))]
        super().__init__(
            layer_init(nn.Linear(features, 64 * math.prod(sizes[3]))),
            nn.ReLU(inplace=True),
            nn.Unflatten(1, (64, *sizes[3])),
            layer_init(nn.ConvTranspose2d(64, 64, 3, 1)),
            nn.ReLU(inplace=True),
            layer_init(nn.ConvTranspose2d(64, 32, 4, 2, output_padding=rest[1])),
            nn.ReLU(inplace=True),
            layer_init(nn.ConvTranspose2d(32, channels, 8, 4, output_padding=rest[0]), 1.0),
        )

    def forward(self, features: Tensor) -> Tensor:
        """Draw the pictures, in pieces that suit a CPU's caches as the encoder's do."""
        chunks = features.split(256) if features.device.type == "cpu" else [features]
        return torch.cat([super(Decoder, self).forward(chunk) for chunk in chunks]).permute(0, 2, 3, 1)


class Heads(nn.Module):
    """The layer after the memory, the multi-discrete policy and the state value (table 6.2)."""

    def __init__(self, width: int, branches: list[int], size: int):
        super().__init__()
        self.branches = branches
        self.trunk = layer_init(nn.Linear(width, size))
        self.policy = head(size, sum(branches), 0.1)
        self.value = head(size, 1, 1.0)

    def forward(self, x: Tensor) -> tuple[list[Categorical], Tensor, Tensor]:
        """Map what the memory says, (B, D), to a distribution of each branch, values (B,) and features (B, F)."""
        features = F.relu(self.trunk(rounded_up(x)))
        logits, values = self.policy(features)[: len(x)].float(), self.value(features)[: len(x), 0].float()
        policy = [Categorical(logits=part, validate_args=False) for part in logits.split(self.branches, -1)]
        return policy, values, features[: len(x)]


def head(size: int, outputs: int, gain: float) -> nn.Sequential:
    """Make a head with a layer of its own."""
    return nn.Sequential(
        layer_init(nn.Linear(size, size)), nn.ReLU(inplace=True), layer_init(nn.Linear(size, outputs), gain)
    )


# ---- 5 MEMORY ----
class GRUScan(torch.autograd.Function):
    """One layer of `nn.GRU` over packed pieces, for learning on a CPU, where the library's own is much slower.

    Takes the projected inputs (R, 3D), the first states (S, D), the recurrent weight and bias, and how many pieces go
    on at each step, a list; returns the states (R, D). Inputs and states are in the order of torch's PackedSequence:
    the first step of all pieces, the longest piece first, then the second step of those that have one. What is saved:
    there is no padding, the weight is turned once instead of at every step, and its gradient is one product of all
    steps instead of a sum of L small ones. The gates r, z and n are those of torch's documentation of nn.GRU.
    """

    @staticmethod
    def forward(ctx, inputs: Tensor, first: Tensor, weight: Tensor, bias: Tensor, sizes: list[int]) -> Tensor:
        """Run the recurrence, keeping every gate for the way back."""
        width = first.shape[1]
        gates = inputs.clone()  # (R, 3D) the projected inputs, step by step overwritten with r, z and n
        states, before, candidates = (inputs.new_empty(len(inputs), width) for _ in range(3))  # (R, D) each
        turned, state = weight.T.contiguous(), first
        steps = zip(*(each.split(sizes) for each in (gates, before, candidates, states)), strict=True)
        for gate, previous, candidate, now in steps:
            previous.copy_(state[: len(now)])
            hidden = torch.addmm(bias, previous, turned)  # (rows, 3D)
            rz, n = gate.split((2 * width, width), -1)
            rz.add_(hidden[:, : 2 * width]).sigmoid_()
            candidate.copy_(hidden[:, 2 * width :])  # the recurrent part of n
            n.addcmul_(rz[:, :width], candidate).tanh_()
            state = torch.lerp(n, previous, rz[:, width:], out=now)
        ctx.save_for_backward(before, gates, candidates, weight)
        ctx.sizes = sizes
        return states

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Walk back through the steps: only what depends on the later states is left to the loop."""
        before, gates, candidates, weight = ctx.saved_tensors
        r, z, n = gates.chunk(3, -1)  # (R, D) each
        to_n = (1 - z) * (1 - n.square())  # what a state's gradient is multiplied with on its way to n's argument
        to_z = (before - n) * z * (1 - z)
        to_r = candidates * r * (1 - r)  # from n's argument on
        grad_hidden = torch.empty_like(gates)  # (R, 3D) of the recurrent product
        grad_n = torch.empty_like(n)
        carried = grad.new_zeros(0, grad.shape[1])  # the gradient that the later steps send back
        end = len(grad)
        for size in reversed(ctx.sizes):
            now, end = slice(end - size, end), end - size
            total = grad[now].clone()
            total[: len(carried)] += carried
            part_r, part_z, part_n = grad_hidden[now].chunk(3, -1)
            torch.mul(total, to_n[now], out=grad_n[now])
            torch.mul(grad_n[now], to_r[now], out=part_r)
            torch.mul(total, to_z[now], out=part_z)
            torch.mul(grad_n[now], r[now], out=part_n)
            carried = torch.addmm(total.mul_(z[now]), grad_hidden[now], weight)
        grad_weight = grad_hidden.T @ before  # (3D, D)
        grad_bias = grad_hidden.sum(0)
        grad_hidden.chunk(3, -1)[2].copy_(grad_n)  # the inputs' gradient differs in n alone
        return grad_hidden, carried, grad_weight, grad_bias, None


class GRU(nn.GRU):
    """`nn.GRU` with the batch first, and a way of its own to learn on a CPU."""

    def scan(self, x: Tensor, state: Tensor, sizes: list[int]) -> Tensor:
        """Map steps (R, D) and the layers' first states (P, S, D) to the last layer's states (R, D).

        All in the order that GRUScan takes them in, as it takes the sizes.
        """
        for first, (w_input, w_hidden, b_input, b_hidden) in zip(state, self.all_weights, strict=True):
            x = GRUScan.apply(F.linear(x, w_input, b_input), first, w_hidden, b_hidden, sizes)
        return x


class Memory(nn.Module):
    """A stack of GRU or LSTM layers, or nothing (thesis 5.2).

    The live memory of a lane is P hidden vectors of width D: one a layer for the GRU, two (hidden, then cell state)
    for the LSTM, none without memory. A rollout stores, of every step, the live memory that the step began with.
    """

    flags = ("memory", "hidden_size", "num_layers")  # those that shape the network

    def __init__(self, args: Args):
        super().__init__()
        self.seq_len, self.width = args.seq_len, args.hidden_size
        self.kind, self.packed = args.memory, args.memory == "gru"  # learns from packed pieces, on a CPU
        self.hidden_vectors = args.num_layers * {"gru": 1, "lstm": 2, "none": 0}[args.memory]
        if args.memory != "none":
            rnn = GRU if args.memory == "gru" else nn.LSTM
            # The outputs are activated already: another ReLU behind them would throw half of them away (5.2.4).
            self.rnn = layer_init(rnn(self.width, self.width, args.num_layers, batch_first=True), 1.0)

    def initial(self, num_steps: int, lanes: int, device: torch.device) -> Tensor:
        """Return the live memory (N, P, D) of fresh episodes, the same for rollouts of any length."""
        return torch.zeros(lanes, self.hidden_vectors, self.width, device=device)

    def storage(self, num_steps: int, lanes: int, device: torch.device) -> Tensor:
        """Return room (T, N, P, D) for what a rollout stores."""
        return torch.zeros(num_steps, lanes, self.hidden_vectors, self.width, device=device)

    def store(self, stored: Tensor, t: int, item: Tensor) -> None:
        """Put away what step t of the rollout has to be remembered for."""
        stored[t] = item

    def refresh(self, live: Tensor, stored: Tensor) -> Tensor:
        """Make the live memory ready for a new rollout: a hidden state simply goes on."""
        return live

    def step(self, x: Tensor, live: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Take one step of all lanes: x (N, D) to (N, D), the new live memory, and what to store of this step."""
        if self.kind == "none":
            return x, live, live
        y, new_live = self.recur(x[:, None], live)
        return y[:, 0], new_live, live

    def reset(self, live: Tensor, done: Tensor) -> Tensor:
        """Forget the lanes whose episode ended, where done (N,) is true."""
        return live.masked_fill(done[:, None, None].to(live.device), 0.0) if done.any() else live

    def cut(self, done: Tensor) -> Pieces:
        """Cut a rollout, whose episodes end where done (T, N) is true, into the pieces that minibatches are made of."""
        begins = torch.ones_like(done)
        if self.kind == "none":
            return Pieces.cut(begins)
        begins[1:] = done[:-1]
        if self.seq_len:
            now = torch.arange(len(done))[:, None]
            began = torch.where(begins, now, 0).cummax(0).values  # (T, N) the step that the episode began at
            begins = (now - began) % self.seq_len == 0
        return Pieces.cut(begins)

    def unroll(self, x: Tensor, pieces: Pieces, stored: Tensor) -> Tensor:
        """Run whole pieces at once: x (R, D) to (R, D), from the stored (T, N, P, D) memory of their first steps."""
        if self.kind == "none":
            return x
        live = stored.flatten(0, 1)[pieces.first]  # (S, P, D)
        if self.packed and x.device.type == "cpu":
            return self.scan(x, pieces, live)
        y, _ = self.recur(pieces.pad(x), live)  # (S, L, D)
        # The padding ends here: what follows, the losses' means (5.8) included, sees real steps only.
        return pieces.unpad(y)

    def scan(self, x: Tensor, pieces: Pieces, live: Tensor) -> Tensor:
        """Do for the steps x (R, D), piece after piece, what `recur` does for padded pieces."""
        within, longest = pieces.within(), pieces.length.argsort(descending=True)
        rank = longest.argsort().repeat_interleave(pieces.length)  # (R,) of the step's piece
        order = (within * len(longest) + rank).argsort()
        with torch.autocast("cpu", enabled=False):
            y = self.rnn.scan(x[order], live[longest].transpose(0, 1), within.bincount().tolist())
        return y[order.argsort()]

    def recur(self, x: Tensor, live: Tensor) -> tuple[Tensor, Tensor]:
        """Run the recurrent layers over x (S, L, D) from the live memory (S, P, D); return both anew."""
        state = live.transpose(0, 1).contiguous()  # (P, S, D)
        with torch.autocast(x.device.type, enabled=False):  # rounding would add up from step to step
            y, state = self.rnn(x, state if self.kind == "gru" else state.chunk(2))
        if self.kind == "lstm":
            state = torch.cat(state)
        return y, state.transpose(0, 1)

    def numbers(self, pieces: Pieces, stored: Tensor) -> dict[str, float]:
        """Return what to log of a rollout's pieces: the share of (S, L) that is padding."""
        return {"padding_fraction": 1 - float(pieces.length.float().mean() / pieces.length.max())}


# ---- 6 AGENT ----
class Agent(nn.Module):
    """Encoder, memory and heads. Plays step by step with `act`, learns from whole pieces with `unroll`.

    ground_truths is how many numbers the environment's ground truth has. Raises ValueError for spaces that it cannot
    encode as the arguments ask, act in or draw.
    """

    def __init__(self, observation_space: gym.Space, action_space: gym.Space, args: Args, ground_truths: int = 0):
        super().__init__()
        spaces = observation_spaces(observation_space)
        self.memory = Memory(args)
        self.encoder = Encoder(spaces, self.memory.width, args.vector_frequencies)
        self.heads = Heads(self.memory.width, action_branches(action_space), args.head_size)
        with torch.random.fork_rng([]):  # what follows from the seed is the same with and without these
            self.decoder = Decoder(args.head_size, spaces) if args.reconstruction_coef else None
            self.estimator = head(args.head_size, ground_truths, 1.0) if args.ground_truth_coef else None

    def act(self, obs: dict[str, Tensor], live: Any) -> tuple[list[Categorical], Tensor, Any, Any]:
        """Take one step of all lanes: the action distributions, values (N,), new live memory, and what to store."""
        x, live, stored = self.memory.step(self.encoder(obs), live)
        policy, values, _ = self.heads(x)
        return policy, values, live, stored

    def choose(self, obs: dict[str, Tensor], live: Any) -> tuple[Tensor, Tensor, Tensor, Any, Any]:
        """Do as `act` does and draw: actions (N, A), their log-probabilities, values, live memory, what to store."""
        policy, values, live, stored = self.act(obs, live)
        actions = draw(policy)
        return actions, log_probs_of(policy, actions), values, live, stored

    def unroll(
        self, obs: dict[str, Tensor], which: Tensor | None, pieces: Pieces, stored: Any
    ) -> tuple[list[Categorical], Tensor, Tensor]:
        """Recompute the distributions, values (R,) and features (R, F) of the pieces' steps, in the pieces' order.

        which (R,) is the row of obs that each step observed, None if there is a row a step.
        """
        x = self.encoder(obs) if which is None else self.encoder(obs).index_select(0, which)
        return self.heads(self.memory.unroll(x, pieces, stored))


class MemoryLimit(ValueError):
    """A memory cannot hold what it is given; says which flag helps. Raised by `Memory.step`."""


def compile_layers(agent: Agent, obs: dict[str, Tensor]) -> None:
    """Compile the convolutions, on a CPU for pieces of their full size, and the heads; obs (N, ...) are any.

    Raises ValueError if that fails.
    """
    device = next(agent.parameters()).device
    for cnn in agent.encoder.cnns:
        cnn.convolve = torch.compile(cnn.convolve, dynamic=device.type != "cpu")
    for layers in (agent.heads.trunk, agent.heads.policy, agent.heads.value):
        layers.compile(dynamic=True)
    pieces = max((cnn.chunk for cnn in agent.encoder.cnns), default=2)
    first = {name: part[:1].expand(pieces, *part.shape[1:]) for name, part in on_device(obs, device).items()}
    try:
        agent.heads(agent.encoder(first))
    except Exception as error:  # whatever the compiler raises
        raise ValueError(f"--compile: {error}; install a C++ compiler (g++), or leave --compile out") from None


def make_agent(envs: gym.vector.VectorEnv, infos: dict, args: Args, device: torch.device) -> Agent:
    """Make the agent for the environments, whose infos have the ground truth if that is to be estimated.

    Raises ValueError for spaces that do not suit, or if there is no ground truth.
    """
    ground_truths = ground_truth_of(infos).shape[1] if args.ground_truth_coef else 0
    return Agent(envs.single_observation_space, envs.single_action_space, args, ground_truths).to(device)


def save_model(agent: Agent, args: Args, path: str) -> None:
    """Write weights, arguments and the script's name to path, whole or not at all."""
    saved = {"script": script_name(), "args": asdict(args), "weights": agent.state_dict()}
    torch.save(saved, path + ".part")
    os.replace(path + ".part", path)


def script_name() -> str:
    """Return the name of this script, without .py."""
    return os.path.splitext(os.path.basename(__file__))[0]


def load_model(path: str) -> tuple[Args, dict[str, Tensor]]:
    """Read the arguments and the weights, on the CPU, of a file that `save_model` wrote.

    Raises ValueError if the file is not such a file or another script's, OSError if it cannot be read.
    """
    if not os.path.isfile(path):
        raise OSError(f"there is no file {path}; --save-model writes model.pt to the run folder")
    try:
        with open(path, "rb") as file:
            saved = torch.load(file, map_location="cpu", weights_only=True)
        script, given, weights = saved["script"], saved["args"], saved["weights"]
    except OSError:
        raise
    except Exception:  # what torch.load raises for a file of another kind is many things, and none tells more
        raise ValueError(f"{path} is not a model that --save-model wrote") from None
    if script != script_name():
        raise ValueError(f"{path} was trained by {script}.py, not by {script_name()}.py")
    known = {field.name for field in fields(Args)}
    return Args(**{name: value for name, value in given.items() if name in known}), weights


def load_weights(agent: Agent, path: str) -> None:
    """Give the agent the weights in the file; auxiliary heads may be added to it or left out.

    Raises ValueError if they belong to another network, are no numbers or there are none, OSError if the file cannot be
    read.
    """
    saved_args, weights = load_model(path)
    try:
        missing, unexpected = agent.load_state_dict(weights, strict=False)
        if not all(name.startswith(("decoder.", "estimator.")) for name in (*missing, *unexpected)):
            raise RuntimeError
    except (RuntimeError, TypeError):
        shaping = ("env_id", *agent.memory.flags, "head_size", "obs_type")
        shaping += ("frame_stack", "step_encoding", "vector_frequencies")
        flags = [f"{flag(name)} {getattr(saved_args, name)}" for name in shaping]
        raise ValueError(f"{path} holds the weights of another network, trained with {' '.join(flags)}") from None
    if not all(weight.isfinite().all() for weight in weights.values()):
        raise ValueError(f"{path} holds weights that are no finite numbers: the training diverged")


# ---- 7 TRAINING ----
@dataclass
class Rollout:
    """What T steps of N lanes leave behind to learn from, on the device; overwritten by every iteration."""

    obs: dict[str, Tensor]  # each (T, N, ...): uint8 pixels stay uint8
    actions: Tensor  # (T, N, A)
    log_probs: Tensor  # (T, N, A)
    values: Tensor  # (T, N)
    rewards: Tensor  # (T, N)
    terminated: Tensor  # (T, N) the step ended its episode
    truncated: Tensor  # (T, N) the step ended its episode by a time limit
    truncation_values: Tensor  # (T, N) value of the final observation, where bootstrapped
    ground_truth: Tensor | None  # (T, N, G), if it is estimated
    memory: Any  # what the memory stores of the steps
    alike: Tensor | None  # (T * N,) flat index of the step whose observation stands for this one's, if any may


@dataclass
class Play:
    """Where the lanes are between two rollouts."""

    obs: dict[str, Tensor]  # (N, ...) the observations to act on next
    ground_truth: Tensor | None  # (N, G) theirs, if it is estimated
    live: Any  # the live memory
    returns: np.ndarray  # (N,) undiscounted return of each lane's episode so far
    lengths: np.ndarray  # (N,) steps of each lane's episode so far


def make_rollout(agent: Agent, play: Play, num_steps: int, device: torch.device) -> Rollout:
    """Allocate a rollout for observations and ground truths like those of play."""
    lanes = len(play.returns)

    def empty(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.zeros(num_steps, lanes, *shape, dtype=dtype, device=device)

    branches = len(agent.heads.branches)
    seek = agent.encoder.pixels and device.type == "cpu"  # where encoding is most of the work
    return Rollout(
        obs={name: empty(*part.shape[1:], dtype=part.dtype) for name, part in on_device(play.obs, device).items()},
        actions=empty(branches, dtype=torch.int64),
        log_probs=empty(branches),
        values=empty(),
        rewards=empty(),
        terminated=empty(dtype=torch.bool),
        truncated=empty(dtype=torch.bool),
        truncation_values=empty(),
        ground_truth=empty(play.ground_truth.shape[1]) if play.ground_truth is not None else None,
        memory=agent.memory.storage(num_steps, lanes, device),
        alike=torch.arange(num_steps * lanes) if seek else None,
    )


def autocast(args: Args, device: torch.device) -> torch.autocast:
    """Return the context in which the networks compute in bfloat16 with --amp; it keeps the weights' casts.

    But a CUDA graph casts them anew: those that were kept would be of the time of the recording.
    """
    return torch.autocast(device.type, torch.bfloat16, enabled=args.amp, cache_enabled=not args.cuda_graphs)


@torch.no_grad()
def collect(
    agent: Agent, envs: gym.vector.VectorEnv, play: Play, rollout: Rollout, args: Args, recorder: LaneRecorder | None
) -> tuple[Tensor, dict[str, list[float]]]:
    """Play T steps of all lanes into the rollout; return the value (N,) of what follows, and the ended episodes.

    The episodes are lists of numbers by name: charts/episodic_return, charts/episodic_length, and episode/* for every
    number in the environment's final info. Leaves `play` where the next rollout goes on.
    """
    device, episodes = rollout.values.device, defaultdict(list)
    rollout.truncation_values.zero_()
    with autocast(args, device):
        play.live = agent.memory.refresh(play.live, rollout.memory)
        for t in range(args.num_steps):
            actions, live = decide(agent, play, rollout, t)
            if recorder is not None:
                recorder.capture()

            obs, rewards, terminated, truncated, infos = envs.step(to_env_actions(actions, envs.single_action_space))
            play.obs = as_tensors(obs)
            if rollout.ground_truth is not None:
                play.ground_truth = ground_truth_of(infos)
            rollout.rewards[t] = torch.as_tensor(rewards)
            rollout.terminated[t], rollout.truncated[t] = torch.as_tensor(terminated), torch.as_tensor(truncated)
            if args.bootstrap_truncated and truncated.any():
                final = on_device(final_observations(play.obs, infos, truncated), device)
                value = agent.act(final, live)[1]  # from the memory as it was before the reset
                rollout.truncation_values[t] = value * rollout.truncated[t]

            done = terminated | truncated
            play.live = agent.memory.reset(live, torch.as_tensor(done))
            note_episodes(play, rewards, done, infos, episodes)
            if recorder is not None and done[0]:
                recorder.end_episode()
        _, last_value, _, _ = agent.act(on_device(play.obs, device), play.live)
    if rollout.alike is not None:
        rollout.alike.copy_(first_alike(rollout.obs))
    return last_value, episodes


def decide(agent: Agent, play: Play, rollout: Rollout, t: int) -> tuple[Tensor, Any]:
    """Choose the lanes' actions (N, A) of step t, and put away all that the choice is learned from.

    Returns the new live memory too, as it is before the step may end episodes.
    """
    for name, part in play.obs.items():
        rollout.obs[name][t] = part  # the first and only copy: env to device, dtype kept
    if rollout.ground_truth is not None:
        rollout.ground_truth[t] = play.ground_truth
    actions, rollout.log_probs[t], rollout.values[t], live, stored = agent.choose(
        {name: part[t] for name, part in rollout.obs.items()}, play.live
    )
    rollout.actions[t] = actions
    agent.memory.store(rollout.memory, t, stored)
    return actions, live


def on_device(obs: dict[str, Tensor], device: torch.device) -> dict[str, Tensor]:
    """Move observations to the device, as the encoder takes them."""
    return {k: v.to(device, v.dtype if v.dtype == torch.uint8 else torch.float32) for k, v in obs.items()}


def final_observations(obs: dict[str, Tensor], infos: dict, lanes: np.ndarray) -> dict[str, Tensor]:
    """Return observations (N, ...) in which the given lanes hold the last one of the episode that just ended."""
    obs = {name: part.clone() for name, part in obs.items()}
    for lane in lanes.nonzero()[0]:
        for name, part in as_tensors(infos["final_obs"][lane]).items():
            obs[name][lane] = part
    return obs


def note_episodes(play: Play, rewards: np.ndarray, done: np.ndarray, infos: dict, episodes: dict[str, list]) -> None:
    """Count the step in every lane's return and length; move those of ended episodes to the lists in episodes."""
    play.returns += rewards
    play.lengths += 1
    if not done.any():
        return
    episodes["charts/episodic_return"] += play.returns[done].tolist()
    episodes["charts/episodic_length"] += play.lengths[done].tolist()
    play.returns[done], play.lengths[done] = 0, 0
    for name, _, values in final_numbers(infos, done):
        episodes[f"episode/{name}"] += values.tolist()


def final_numbers(infos: dict, lanes: np.ndarray) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield each number in the final infos of the given lanes: its name, which of them have it (N,), and theirs."""
    final = infos.get("final_info", {})
    for name, values in final.items():
        which = lanes & final.get(f"_{name}", False)
        if which.any() and isinstance(values, np.ndarray) and all(np.isscalar(value) for value in values[which]):
            found = np.array(values[which].tolist())
            if found.dtype.kind in "biuf":
                yield name, which, found


class Graphed:
    """A function on a GPU, recorded as a CUDA graph and replayed: one launch instead of hundreds.

    Its inputs are nested tuples and dicts. The tensors among them are copied to where the recording reads them; their
    shapes, and whatever is no tensor, are part of it. A few calls in a row that agree in these run as they are, the
    next one is recorded; from then on such calls are replayed, and others run as they are. A replay overwrites what the
    one before returned.
    """

    def __init__(self, function: Callable, warm_up: int = 3):
        self.function, self.warm_up, self.stream = function, warm_up, torch.cuda.Stream()
        self.graph, self.like, self.calls = None, None, 0

    def __call__(self, *inputs: Any) -> Any:
        """Call the function, in one of these ways."""
        like = each_leaf(lambda leaf: leaf.shape if isinstance(leaf, Tensor) else leaf, inputs)
        if like != self.like:
            if self.graph is not None:
                return self.function(*inputs)
            self.like, self.calls = like, 0
        self.calls += 1
        if self.calls <= self.warm_up:
            return self.run_aside(*inputs)
        if self.graph is None:
            self.inputs = each_leaf(lambda leaf: leaf.clone() if isinstance(leaf, Tensor) else leaf, inputs)
            self.graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self.graph):
                self.outputs = self.function(*self.inputs)
        for kept, given in zip(tensors_in(self.inputs), tensors_in(inputs), strict=True):
            if kept is not given:
                kept.copy_(given)
        self.graph.replay()
        return self.outputs

    def run_aside(self, *inputs: Any) -> Any:
        """Call the function on a stream of its own, as what is to be recorded has to be run before."""
        self.stream.wait_stream(torch.cuda.current_stream())
        try:
            with torch.cuda.stream(self.stream):
                return self.function(*inputs)
        finally:
            torch.cuda.current_stream().wait_stream(self.stream)


def each_leaf(function: Callable, x: Any) -> Any:
    """Apply the function to what nested tuples and dicts hold; return the results, nested in the same way."""
    if isinstance(x, dict):
        return {name: each_leaf(function, part) for name, part in x.items()}
    if not isinstance(x, tuple):
        return function(x)
    parts = [each_leaf(function, part) for part in x]
    return type(x)(*parts) if hasattr(x, "_fields") else tuple(parts)  # a NamedTuple, or a plain one


def tensors_in(x: Any) -> list[Tensor]:
    """Return the tensors in nested tuples and dicts, in order."""
    found = []
    each_leaf(found.append, x)
    return [leaf for leaf in found if isinstance(leaf, Tensor)]


def minibatch_loss(
    agent: Agent, rollout: Rollout, targets: tuple[Tensor, Tensor], pieces: Pieces, ent_coef: Tensor, args: Args
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the total loss (5.7) of the pieces' steps and the numbers to log; targets: advantages, returns (T, N)."""
    device = rollout.values.device
    steps = pieces.steps()  # (R,)
    distinct, which = steps, None
    if rollout.alike is not None:
        distinct, which = rollout.alike[steps].unique(return_inverse=True)  # equals are encoded once

    def take(stored: Tensor, rows: Tensor = steps) -> Tensor:
        return stored.flatten(0, 1).index_select(0, rows)

    obs = {name: take(part, distinct) for name, part in rollout.obs.items()}
    with autocast(args, device):
        policy, values, features = agent.unroll(obs, which, pieces, rollout.memory)
    log_ratio = log_probs_of(policy, take(rollout.actions)) - take(rollout.log_probs)  # (R, A)
    entropy = torch.stack([branch.entropy() for branch in policy], -1).sum(-1).mean()
    advantages, returns = map(take, targets)
    if args.norm_adv:
        advantages = (advantages - advantages.mean()) / (advantages.std(correction=0) + 1e-8)
    pg_loss = policy_loss(log_ratio, advantages, args.clip_coef)
    v_loss = value_loss(values, take(rollout.values), returns, args.clip_coef if args.clip_vloss else None)
    loss = pg_loss + args.vf_coef * v_loss - ent_coef * entropy
    logs = {"policy_loss": pg_loss, "value_loss": v_loss, "entropy": entropy, **policy_numbers(log_ratio, args)}
    if agent.decoder is not None:
        pixels = take(rollout.obs[agent.encoder.pixels[0]])
        with autocast(args, device):
            drawn = agent.decoder(features)
        logs["reconstruction_loss"] = reconstruction_loss(drawn.float(), pixels)
        loss = loss + args.reconstruction_coef * logs["reconstruction_loss"]
    if agent.estimator is not None:
        estimate = agent.estimator((features.detach() if args.ground_truth_detach else features).float())
        logs["ground_truth_loss"] = F.mse_loss(estimate, take(rollout.ground_truth))  # (5.6)
        loss = loss + args.ground_truth_coef * logs["ground_truth_loss"]
    logs["loss"] = loss
    return loss, {f"losses/{name}": value.detach() for name, value in logs.items()}


@torch.no_grad()
def policy_numbers(log_ratio: Tensor, args: Args) -> dict[str, Tensor]:
    """Return what to log of log_ratio (R, A): how far the policy has moved from the rollout's."""
    off, joint = log_ratio.exp() - 1, log_ratio.sum(-1)  # the branches are independent: log-ratios add up
    return {
        "old_approx_kl": -joint.mean(),
        "approx_kl": (joint.exp() - 1 - joint).mean(),  # http://joschu.net/blog/kl-approx.html
        "clipfrac": (off.abs() > args.clip_coef).float().mean(),
        "ratio_error": off.abs().max(),
    }


def descend(
    agent: Agent,
    optimizer: torch.optim.Optimizer,
    rollout: Rollout,
    args: Args,
    first: Tensor,
    lengths: tuple[int, ...],
    targets: tuple[Tensor, Tensor],
    ent_coef: Tensor,
) -> dict[str, Tensor]:
    """Take a gradient step on the pieces with these first steps (S,) and lengths; return the numbers to log."""
    pieces = Pieces(first, torch.tensor(lengths), rollout.values.shape[1])
    loss, log = minibatch_loss(agent, rollout, targets, pieces, ent_coef, args)
    optimizer.zero_grad()
    loss.backward()
    log["losses/grad_norm"] = clip_gradients(agent, args)
    optimizer.step()
    return log


def update(
    agent: Agent, learn: Callable, rollout: Rollout, last_value: Tensor, ent_coef: float, args: Args
) -> dict[str, float]:
    """Learn from the rollout for some epochs; return what to log, averaged over the minibatches.

    learn is `descend` with the arguments that never change.
    """
    advantages = gae(
        rewards=rollout.rewards,
        values=rollout.values,
        last_value=last_value,
        terminated=rollout.terminated,
        truncated=rollout.truncated,
        truncation_values=rollout.truncation_values,
        gamma=args.gamma,
        gae_lambda=args.gae_lambda,
    )
    returns = advantages + rollout.values
    pieces = agent.memory.cut((rollout.terminated | rollout.truncated).cpu())
    pieces.first = pieces.first.to(advantages.device)
    targets, ent_coef, logs = (advantages, returns), torch.tensor(ent_coef, device=advantages.device), []
    for _ in range(args.update_epochs):
        for minibatch in pieces.minibatches(args.num_minibatches):
            log = learn(minibatch.first, tuple(minibatch.length.tolist()), targets, ent_coef)
            logs.append(torch.stack([*log.values()]))
        epoch = logs[-args.num_minibatches :]
        if args.target_kl is not None and named_means(log, epoch)["losses/approx_kl"] > args.target_kl:
            break
    means = named_means(log, logs)
    # Before the first gradient step the weights are the rollout's, and so must be every probability.
    means["losses/ratio_error"] = named_means(log, logs[:1])["losses/ratio_error"]
    means["losses/explained_variance"] = explained_variance(rollout.values, returns)
    return means | {f"charts/{name}": value for name, value in agent.memory.numbers(pieces, rollout.memory).items()}


def named_means(names: Iterable[str], rows: list[Tensor]) -> dict[str, float]:
    """Return each column's mean over the rows, by name."""
    return dict(zip(names, torch.stack(rows).mean(0).tolist(), strict=True))


def clip_gradients(agent: Agent, args: Args) -> Tensor:
    """Scale the agent's gradient down to --max-grad-norm, a probe's apart from it; return the agent's norm before."""
    probe, rest = [], []
    for name, parameter in agent.named_parameters():
        (probe if args.ground_truth_detach and name.startswith("estimator.") else rest).append(parameter)
    nn.utils.clip_grad_norm_(probe, args.max_grad_norm)
    return nn.utils.clip_grad_norm_(rest, args.max_grad_norm)


def explained_variance(values: Tensor, returns: Tensor) -> float:
    """Return the share of the returns' variance that the values explain; NaN if the returns do not vary."""
    variance = returns.var().item()
    return 1 - (returns - values).var().item() / variance if variance > 0 else math.nan


@torch.no_grad()
def evaluate(agent: Agent, envs: gym.vector.VectorEnv, args: Args, memory_steps: int = 64) -> dict[str, np.ndarray]:
    """Play each level of `evaluation_levels` once, a lane each, with fresh memory and the stochastic policy (6.1.3).

    Returns numbers (N,) by name: return, length, finished (0 for an episode that was cut short), and every number in
    an episode's final info. Draws from torch's generator; the memory is refreshed every memory_steps steps.
    """
    levels = evaluation_levels(args)
    device, options = next(agent.parameters()).device, reset_options(args.env_id, args.env_options)
    obs, _ = envs.reset(seed=levels, options=options)
    live = agent.memory.initial(memory_steps, len(levels), device)
    stored = agent.memory.storage(memory_steps, len(levels), device)
    playing = np.ones(len(levels), bool)
    found = {name: np.zeros(len(levels)) for name in ("return", "length", "finished")}
    with autocast(args, device):
        for t in range(args.eval_max_steps):
            if t % memory_steps == 0:
                live = agent.memory.refresh(live, stored)
            policy, _, live, item = agent.act(on_device(as_tensors(obs), device), live)
            agent.memory.store(stored, t % memory_steps, item)
            actions = to_env_actions(draw(policy), envs.single_action_space)
            obs, rewards, terminated, truncated, infos = envs.step(actions)
            done = terminated | truncated
            live = agent.memory.reset(live, torch.as_tensor(done))
            found["return"] += rewards * playing
            found["length"] += playing
            for name, which, values in final_numbers(infos, done & playing):
                found.setdefault(name, np.full(len(levels), np.nan))[which] = values
            playing &= ~done
            if not playing.any():
                break
    return found | {"finished": 1.0 - playing}


def evaluation_levels(args: Args) -> list[int]:
    """Return the seeds (N,) of the levels that an evaluation plays: those after the training levels, with repeats."""
    first = args.start_level + args.num_levels
    return [first + level for level in range(args.eval_levels) for _ in range(args.eval_repeats)]


@dataclass
class Run:
    """All that training needs, made by `setup` from an Args."""

    envs: gym.vector.VectorEnv
    eval_envs: gym.vector.VectorEnv | None
    agent: Agent
    optimizer: torch.optim.Optimizer
    learn: Callable  # takes a gradient step, see `update`
    rollout: Rollout
    play: Play
    recorder: LaneRecorder | None
    folder: str
    writer: SummaryWriter


def setup(args: Args) -> Run:
    """Check the arguments and make everything, the run folder last: bad input raises before anything is written.

    Raises ValueError, OSError, ImportError or gymnasium.error.Error, each with one line for the user.
    """
    check_args(args)
    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    device = torch.device("cuda" if torch.cuda.is_available() and args.cuda else "cpu")
    if args.cuda_graphs and device.type != "cuda":
        raise ValueError("--cuda-graphs needs a GPU; leave it out")
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")  # TF32
    with enough_memory(args, device):
        envs = make_envs(args, args.num_envs, "debug_rgb_array" if args.capture_video else None)
        if envs.metadata.get("autoreset_mode") != AutoresetMode.SAME_STEP:
            raise ValueError(f"{args.env_id} does not reset an ended episode in the same step")
        obs, infos = first_reset(envs, args.seed, reset_options(args.env_id, args.env_options))
        agent = make_agent(envs, infos, args, device)
        ground_truth = ground_truth_of(infos) if agent.estimator is not None else None
        live = agent.memory.initial(args.num_steps, args.num_envs, device)
        play = Play(obs, ground_truth, live, np.zeros(args.num_envs), np.zeros(args.num_envs, np.int64))
        rollout = make_rollout(agent, play, args.num_steps, device)
        eval_envs = make_envs(args, len(evaluation_levels(args))) if args.eval_interval else None
    if args.load_model is not None:
        load_weights(agent, args.load_model)
    if args.compile:
        compile_layers(agent, obs)
    optimizer, learn = make_learner(agent, rollout, args)

    folder = new_folder(args)
    recorder = LaneRecorder(envs, os.path.join(folder, "videos")) if args.capture_video else None
    if args.track:
        start_tracking(args, os.path.basename(folder))
    return Run(envs, eval_envs, agent, optimizer, learn, rollout, play, recorder, folder, open_writer(args, folder))


def make_learner(agent: Agent, rollout: Rollout, args: Args) -> tuple[torch.optim.Optimizer, Callable]:
    """Return the optimizer, and what takes a gradient step with it, see `update`.

    With --cuda-graphs, such steps and those of playing will be recorded.
    """
    lr = torch.tensor(args.init_lr, device=rollout.values.device)  # as a number, a CUDA graph would keep it
    optimizer = torch.optim.AdamW(agent.parameters(), lr=lr, fused=True, capturable=args.cuda_graphs)
    learn = partial(descend, agent, optimizer, rollout, args)
    if not args.cuda_graphs:
        return optimizer, learn
    agent.choose, recorded = Graphed(agent.choose), Graphed(learn)

    def learn_from(first: Tensor, lengths: tuple[int, ...], *rest: Any) -> dict[str, Tensor]:
        # The padding of uneven pieces is told by numbers from the CPU, which cannot be copied in a recording.
        return (recorded if len(set(lengths)) == 1 else learn)(first, lengths, *rest)

    return optimizer, learn_from


@contextlib.contextmanager
def enough_memory(args: Args, device: torch.device) -> Iterator[None]:
    """Raise ValueError, naming what is larger than usual, if what is made inside does not fit in the memory."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "memory" not in str(error):
            raise
        numbers = [(each, getattr(args, each.name)) for each in fields(Args) if type(each.default) is int]
        large = [f"{flag(each.name)} {value}" for each, value in numbers if value > each.default]
        large = [name for name in large if not name.startswith(("--seed", "--total", "--start", "--anneal"))]
        large = " ".join(large) or f"--num-envs {args.num_envs} --num-steps {args.num_steps}"
        raise ValueError(f"this does not fit in the memory of {device}; use less of {large}") from None


def new_folder(args: Args) -> str:
    """Name a run folder that does not exist yet: a second run that begins in the same second gets a number."""
    env_id = args.env_id.replace("/", "-").replace(":", "-")
    folder = os.path.join("runs", f"{env_id}__{args.exp_name}__{args.seed}__{int(time.time())}")
    numbered = (f"{folder}-{number}" for number in itertools.count(2))
    return folder if not os.path.exists(folder) else next(name for name in numbered if not os.path.exists(name))


def open_writer(args: Args, folder: str) -> SummaryWriter:
    """Make the run folder and its TensorBoard file, which begins with the hyperparameters.

    Raises OSError if the folder cannot be made.
    """
    try:
        os.makedirs(folder)
    except OSError as error:
        raise OSError(f"cannot make {folder} ({error.strerror}); run where the folder runs can be written") from None
    writer = SummaryWriter(folder)
    rows = "\n".join(f"|{key}|{' '.join(str(value).split())}|" for key, value in asdict(args).items())
    writer.add_text("hyperparameters", f"|param|value|\n|-|-|\n{rows}")
    return writer


def start_tracking(args: Args, name: str) -> None:
    """Mirror the TensorBoard curves to Weights and Biases; raise ValueError if that does not start."""
    wandb = require("wandb", "--track", "track")
    try:
        wandb.init(
            project=args.wandb_project_name,
            entity=args.wandb_entity,
            sync_tensorboard=True,
            config=asdict(args),
            name=name,
            save_code=True,
        )
    except Exception as error:  # whatever wandb raises: no account, no such team, no network
        raise ValueError(f"--track: {error}; log in with `wandb login`, or leave --track out") from None


def train(args: Args, run: Run) -> str:
    """Train for --total-timesteps, rounded down to whole iterations, or until Ctrl-C; return the run folder.

    Whatever ends it, what was learned is kept. Raises what `iterate` raises.
    """
    recent = {"return": deque(maxlen=100), "length": deque(maxlen=100)}
    batch_size = args.num_envs * args.num_steps
    iterations, seconds = args.total_timesteps // batch_size, 0.0
    bar = tqdm(total=iterations * batch_size, unit=" steps", unit_scale=True)
    try:
        with bar, contextlib.suppress(KeyboardInterrupt):
            for iteration in range(1, iterations + 1):
                began = time.perf_counter()
                scalars, episodes = iterate(args, run, (iteration - 1) * batch_size)
                seconds += time.perf_counter() - began
                step = iteration * batch_size
                if run.eval_envs is not None and (iteration % args.eval_interval == 0 or iteration == iterations):
                    for name, scores in evaluation(run, args).items():
                        scalars[f"eval/{name}"] = scores.mean().item()
                        run.writer.add_tensor(f"eval_levels/{name}", scores, step)
                scalars["charts/SPS"] = step / seconds
                for name, value in scalars.items():
                    run.writer.add_scalar(name, value, step)
                for name, window in recent.items():
                    window.extend(episodes.get(f"charts/episodic_{name}", []))
                shown = {name: f"{np.mean(window):.2f}" for name, window in recent.items() if window}
                bar.set_postfix({**shown, "SPS": f"{scalars['charts/SPS']:.0f}"}, refresh=False)
                bar.update(batch_size)
    finally:
        if args.save_model:
            save_model(run.agent, args, os.path.join(run.folder, "model.pt"))
        run.writer.close()
        for envs in filter(None, (run.envs, run.eval_envs)):
            envs.close()
        if run.recorder is not None:
            run.recorder.end_episode()
    return run.folder


def iterate(args: Args, run: Run, step: int) -> tuple[dict[str, float], dict[str, list[float]]]:
    """Play a rollout from this step of the training on, learn from it; return what to log, and the ended episodes.

    Raises FloatingPointError if the training diverged, MemoryLimit as the memory does.
    """
    lr = anneal(step, args.init_lr, args.final_lr, args.anneal_steps)
    ent_coef = anneal(step, args.init_ent_coef, args.final_ent_coef, args.anneal_steps)
    run.optimizer.param_groups[0]["lr"].fill_(lr)
    last_value, episodes = collect(run.agent, run.envs, run.play, run.rollout, args, run.recorder)
    scalars = update(run.agent, run.learn, run.rollout, last_value, ent_coef, args)
    if not math.isfinite(scalars["losses/grad_norm"]):
        raise FloatingPointError("the training diverged: its gradient is no finite number; try a lower --init-lr")
    scalars |= {"charts/learning_rate": lr, "charts/entropy_coefficient": ent_coef}
    return scalars | {name: float(np.mean(values)) for name, values in episodes.items()}, episodes


def evaluation(run: Run, args: Args) -> dict[str, Tensor]:
    """Return an evaluation's numbers by name, each level's mean over its repeats, (--eval-levels,) float64.

    Training goes on as if there had been none. What only an episode's end tells is not there if an episode was cut
    short: the best ones would be left out.
    """
    device = run.rollout.values.device
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(args.seed)
        found = evaluate(run.agent, run.eval_envs, args)
    told = {name: torch.from_numpy(values) for name, values in found.items() if not np.isnan(values).any()}
    return {name: values.unflatten(0, (-1, args.eval_repeats)).mean(1) for name, values in told.items()}


def main(args: Args) -> str:
    """Train an agent as the arguments say; return the run folder. Raises what `setup` and `train` raise."""
    return train(args, setup(args))


def one_line(error: Exception) -> str:
    """Return what to tell the user of an error."""
    return f"{script_name()}.py: {' '.join(str(error).split())}"


if __name__ == "__main__":
    args = tyro.cli(Args)
    try:
        run = setup(args)
    except (ValueError, OSError, ImportError, gym.error.Error) as error:
        sys.exit(one_line(error))
    try:
        train(args, run)
    except (MemoryLimit, FloatingPointError) as error:
        sys.exit(one_line(error))
