"""PPO that remembers with a recurrent network: a GRU, an LSTM, or nothing, for comparison.

    python ppo_gru.py --env-id MortarMayhem-Grid-v0

The agent gets one observation at a time and carries a hidden state from step to step, zeroed where an episode ends.
The rollout stores the hidden state before each step. For the update, the steps of each environment are cut into
sequences at the ends of episodes (and every --seq-len steps), padded with zeros to the longest sequence, and run from
the stored hidden state of their first step: truncated back-propagation through time. The gradient flows back to the
first step of a sequence and no further. The hidden state that a rollout begins with was computed with older weights.
So are, from the first gradient step on, those that --seq-len cuts at; --refresh-memory computes these again, with the
current weights, before each epoch but the first.

Source: "Memory-based Deep Reinforcement Learning in Endless Imperfect Information Games", called the thesis below.
§5.2 is its section, (5.7) its equation; defaults are the "Final" column of its table 6.1, without auxiliary losses.

How to read: from top to bottom. Section 2 is the training loop, then its parts in the order in which it calls them;
section 4 is the memory. What any training needs, whatever its algorithm is, comes from ppo_utils/: types of flags,
environments, evaluation, run folder, checkpoints, several processes, and faster ways to compute the same.

Shape letters: T steps of a rollout, N environments, A action branches, B samples of a minibatch, S sequences of a
minibatch, L steps of the longest, I inputs and D width of the memory, P hidden vectors per environment, F features, G
entries of the ground truth, V entries of a vector.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.distributions import Categorical
from torch.nn.utils.rnn import pad_sequence

from ppo_utils.checkpoints import make_agent
from ppo_utils.environments import as_tensors, final_numbers, final_observations, ground_truth_of
from ppo_utils.fast import encode, first_occurrences, in_chunks, packed_gru
from ppo_utils.flags import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, UnitInterval, bounded
from ppo_utils.processes import all_gather, average_gradients
from ppo_utils.runs import Run, command, open_run, prepare, report, report_out_of_memory, run_to_end, training_envs


# ---- 1 ARGS ----
@dataclass
class Args:
    """Train a PPO agent with a recurrent memory."""

    exp_name: str = Path(__file__).stem
    """name of the experiment, part of the run folder's name"""
    preset: Literal["thesis", "laptop", "quickstart"] = "thesis"
    """defaults to begin with, listed above; flags that are given win over them"""
    seed: NonNegativeInt = 1
    """seed of weights, actions and environments: the same seed gives the same curves (on a CPU bit for bit, with the
    same number of threads)"""
    torch_deterministic: bool = True
    """ask cuDNN for deterministic algorithms"""
    cuda: bool = True
    """train on the GPU if there is one"""
    amp: bool = False
    """compute encoder, transformer and decoder in bfloat16"""
    track: bool = False
    """log to Weights and Biases too (extra `track`); WANDB_PROJECT and WANDB_ENTITY name project and team"""
    capture_video: bool = False
    """record some episodes of the first environment (extra `play`)"""
    save_model: bool = False
    """write model.pt to the run folder when training ends"""
    load_model: str | None = None
    """start from the weights in this file: a model.pt or a checkpoint"""
    resume: str | None = None
    """go on with the run in this folder from its last checkpoint; of all flags only --total-timesteps may change, to a
    larger value"""
    checkpoint_interval: NonNegativeInt = 50
    """iterations between checkpoints, with another one at the end (0: no checkpoints); the last two are kept"""

    env_id: str = "MortarMayhem-Grid-v0"
    """any Gymnasium id with Discrete or MultiDiscrete actions; as module:id if importing a module registers it"""
    env_options: str = "{}"
    """reset options of a Memory Gym environment as JSON, e.g. '{"command_count": [4]}'"""
    num_levels: NonNegativeInt = 100_000
    """number of levels that a Memory Gym environment trains on (0: no limit)"""
    start_level: NonNegativeInt = 0
    """the first of these levels"""
    obs_type: Literal["pixels", "vector"] = "pixels"
    """what a Memory Gym environment shows: images, or vectors of what can be seen on them"""
    frame_stack: NonNegativeInt = 0
    """observe the last K images, in grayscale, or the last K vectors (0: only the current one)"""
    step_encoding: bool = False
    """also observe a sinusoidal encoding of the episode's step"""
    observe_last_action: bool = False
    """also observe the last action and the last reward"""
    spotlight_perturbation: bool = False
    """cover the image with a translucent white layer in which moving spotlights leave holes (thesis §7.2)"""
    vector_frequencies: bounded(int, 0, 16) = 0
    """also observe Fourier features of vectors with entries from 0 to 1, at this many frequencies"""

    total_timesteps: PositiveInt = 163_840_000
    """environment steps to train for, rounded down to whole iterations of num_envs x num_steps"""
    num_envs: PositiveInt = 32
    """environments that run in parallel"""
    num_steps: PositiveInt = 512
    """steps of each environment in a rollout"""
    num_minibatches: PositiveInt = 8
    """minibatches of an epoch"""
    update_epochs: PositiveInt = 3
    """epochs of an update"""
    gamma: UnitInterval = 0.995
    """discount factor"""
    gae_lambda: UnitInterval = 0.95
    """lambda of generalized advantage estimation"""
    refresh_memory: bool = False
    """recompute the memory that a rollout stored with the current weights, before each epoch but the first"""
    bootstrap_truncated: bool = False
    """add the value of the final observation where a time limit ended an episode; without, it counts as terminated"""
    norm_adv: Literal["none", "minibatch", "batch"] = "none"
    """normalize the advantages of each minibatch, or of the whole rollout, to mean 0 and standard deviation 1"""
    clip_coef: PositiveFloat = 0.1
    """clipping range of the probability ratio and of the value"""
    clip_vloss: bool = True
    """clip the value loss"""
    vf_coef: NonNegativeFloat = 0.5
    """weight of the value loss"""
    max_grad_norm: PositiveFloat = 0.25
    """largest norm of the gradient, which is scaled down to it"""
    target_kl: PositiveFloat | None = None
    """end the update before the first minibatch whose KL divergence from the policy that acted is larger"""
    init_lr: UnitInterval = 2.75e-4
    """learning rate at first"""
    final_lr: UnitInterval = 1.0e-5
    """learning rate from --anneal-steps on"""
    exploration_bonus: Literal["entropy", "log-barrier"] = "entropy"
    """what keeps the policy exploring: its entropy, or the mean log-probability of all actions"""
    init_ent_coef: NonNegativeFloat = 1.0e-4
    """weight of the exploration bonus at first"""
    final_ent_coef: NonNegativeFloat = 1.0e-6
    """weight of the exploration bonus from --anneal-steps on"""
    anneal_steps: NonNegativeInt = 163_840_000
    """steps over which learning rate and exploration bonus decay linearly (0: they stay as at first)"""
    reconstruction_coef: NonNegativeFloat = 0.0
    """weight of the loss of reconstructing the observed image (0: off; thesis: 0.1)"""
    reconstruction_detach: bool = False
    """train the decoder alone: no gradient of this loss reaches the agent"""
    ground_truth_coef: NonNegativeFloat = 0.0
    """weight of the loss of estimating the environment's ground truth (0: off; thesis: 0.1)"""
    ground_truth_detach: bool = False
    """train the estimator alone: no gradient of this loss reaches the agent"""
    embedding: bool = True
    """embed the encoded observation in the memory's width"""
    trunk_size: PositiveInt = 512
    """width of the layer after the memory, and of the hidden layers of policy and value"""
    value_init_gain: NonNegativeFloat = 1.0
    """gain of the value's last layer at initialization: the smaller, the nearer to 0 are fresh values"""

    eval_interval: NonNegativeInt = 0
    """iterations between evaluations on unseen levels, with another one at the end (0: no evaluations)"""
    eval_levels: PositiveInt = 50
    """levels of an evaluation, from start_level + num_levels on; each is played three times"""
    eval_max_steps: PositiveInt = 10_000
    """steps after which an evaluation cuts an episode short"""

    memory: Literal["gru", "lstm", "none"] = "gru"
    """what the agent remembers with"""
    hidden_size: PositiveInt = 512
    """width of the hidden state"""
    num_layers: PositiveInt = 1
    """stacked recurrent layers"""
    seq_len: NonNegativeInt = 0
    """longest sequence that the gradient flows through (0: up to the whole rollout)"""


LAPTOP = {
    "preset": "laptop",
    "obs_type": "vector",
    "hidden_size": 128,
    "trunk_size": 128,
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
}
QUICKSTART = {
    **LAPTOP,
    "preset": "quickstart",
    # Two commands, each shown for one step, and six steps to carry one out.
    "env_options": '{"command_count": [2], "command_show_duration": [1], "command_show_delay": [0], '
    '"explosion_delay": [4], "explosion_duration": [2]}',
    "anneal_steps": 500_000,
    "total_timesteps": 500_000,
}
PRESETS = {"thesis": {}, "laptop": LAPTOP, "quickstart": QUICKSTART}  # thesis: the defaults above


# ---- 2 TRAINING ----
def train(args: Args, run: Run) -> None:
    """Train until --total-timesteps, rounded down to whole iterations, or until a signal.

    Raises FloatingPointError if the training diverges, RunError as `report` does.
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
        rollout.advantages = gae(rollout, last_value, args.gamma, args.gae_lambda)
        rollout.returns = rollout.advantages + rollout.values
        logs = mean_logs(update(agent, run.optimizer, rollout, ent_coef, args), rollout)
        updated = time.perf_counter()

        logs |= {"charts/learning_rate": lr, "charts/entropy_coefficient": ent_coef}
        seconds = {"collect": collected - began, "update": updated - collected, "iteration": updated - began}
        logs |= {f"charts/seconds_{part}": value for part, value in seconds.items()}
        run.step = step + batch_size
        report(args, run, logs, episodes)  # evaluation, TensorBoard, progress bar, checkpoint
        if run.stop:
            break


@dataclass
class Rollout:
    """T steps of N environments to learn from, and what the next rollout goes on with. Each one overwrites the last."""

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
    memory: MemoryState
    carry: dict[str, Tensor]  # the memory that the rollout began with
    advantages: Tensor | None = None  # (T, N)
    returns: Tensor | None = None  # (T, N)
    first_occurrence: Tensor | None = None  # (T * N,) flat index of the first equal observation, if that is used

    @classmethod
    def allocate(cls, num_steps: int, obs: dict[str, np.ndarray], truth: np.ndarray | None, agent: Agent) -> Rollout:
        """Make a rollout on the agent's device that begins with these observations and ground truths."""
        num_envs = len(next(iter(obs.values())))
        device = next(agent.parameters()).device

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(num_steps, num_envs, *shape, dtype=dtype, device=device)

        branches = len(agent.heads.nvec)
        memory = agent.memory.initial_state(num_envs, num_steps, device)
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
            memory=memory,
            carry=agent.memory.carry(memory),
        )


@torch.no_grad()
def collect(
    agent: Agent, envs: gym.vector.VectorEnv, rollout: Rollout, args: Args
) -> tuple[Tensor, dict[str, list[float]]]:
    """Act for T steps in all environments; return the value (N,) of what follows, and metrics of the ended episodes.

    An ended episode is reset in the same step, so that next_obs begins the next one. Metrics are lists by name:
    charts/episodic_return, charts/episodic_length, and episode/* for every number in the environment's final info.
    """
    device, memory = rollout.values.device, rollout.memory
    episodes = defaultdict(list)
    rollout.truncation_values.zero_()
    rollout.carry = agent.memory.carry(memory)
    with torch.autocast(device.type, torch.bfloat16, enabled=args.amp):
        agent.memory.begin_rollout(memory, rollout.carry)
        for t in range(args.num_steps):
            for name, part in rollout.next_obs.items():
                rollout.obs[name][t] = torch.from_numpy(part)  # to the device, dtype kept
            if rollout.ground_truth is not None:
                rollout.ground_truth[t] = torch.as_tensor(rollout.next_ground_truth)
            obs = {name: part[t] for name, part in rollout.obs.items()}
            rollout.actions[t], rollout.log_probs[t], rollout.values[t] = agent.get_action_and_value(obs, memory)

            next_obs, rewards, terminated, truncated, infos = envs.step(rollout.actions[t].cpu().numpy())
            done = terminated | truncated
            rollout.rewards[t] = torch.as_tensor(rewards)
            rollout.terminated[t], rollout.truncated[t] = torch.as_tensor(terminated), torch.as_tensor(truncated)
            if args.bootstrap_truncated and truncated.any():
                final = as_tensors(final_observations(next_obs, infos, truncated), device)
                value = agent.get_value(final, memory)  # with the memory of the episode that ended
                rollout.truncation_values[t] = value * rollout.truncated[t]
            agent.memory.reset(memory, torch.as_tensor(done))
            rollout.next_obs, rollout.next_ground_truth = next_obs, ground_truth_of(infos, args)
            if done.any():
                episodes["charts/episodic_return"] += infos["episode"]["r"][done].tolist()
                episodes["charts/episodic_length"] += infos["episode"]["l"][done].tolist()
                for name, _, values in final_numbers(infos, done):
                    episodes[f"episode/{name}"] += values.tolist()
        return agent.get_value(as_tensors(rollout.next_obs, device), memory), episodes


def update(
    agent: Agent, optimizer: torch.optim.Optimizer, rollout: Rollout, ent_coef: float, args: Args
) -> list[dict[str, Tensor]]:
    """Learn from the rollout for some epochs; return what to log of each gradient step."""
    if args.norm_adv == "batch":
        rollout.advantages = normalize(rollout.advantages)
    rollout.first_occurrence = first_occurrences(rollout.obs)  # on a CPU, equal images are encoded once
    pieces = agent.memory.cut((rollout.terminated | rollout.truncated).cpu())
    steps = []
    for epoch in range(args.update_epochs):
        if args.refresh_memory and epoch > 0:
            refresh_memory(agent, rollout, args)
        for minibatch in pieces.minibatches(args.num_minibatches):
            loss, logs = ppo_loss(agent, rollout, minibatch, ent_coef, args)
            if args.target_kl is not None and steps:  # before the first step, the policy is still the one that acted
                kl = np.mean(all_gather(logs["approx_kl"].item()))  # of all processes, which stop together
                if kl > args.target_kl:
                    return steps
            optimizer.zero_grad()
            loss.backward()
            average_gradients(agent, int(minibatch.length.sum()))  # over processes, if there are several
            logs["grad_norm"] = clip_gradients(agent, args)
            optimizer.step()
            steps.append(logs)
    return steps


def ppo_loss(
    agent: Agent, rollout: Rollout, minibatch: Pieces, ent_coef: float, args: Args
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the total loss (5.7) of a minibatch, and what to log of it."""
    index = minibatch.flat_index().to(rollout.values.device)  # (B,)

    def gather(stored: Tensor) -> Tensor:
        return stored.flatten(0, 1).index_select(0, index)  # (T, N, ...) to (B, ...)

    autocast = torch.autocast(index.device.type, torch.bfloat16, enabled=args.amp)
    with autocast:
        x = encode(agent.encoder, rollout.obs, index, rollout.first_occurrence)  # (B, I)
        actions = gather(rollout.actions)  # (B, A)
        policy, log_probs, values, features = agent.evaluate_actions(x, actions, minibatch, rollout.memory)
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
        with autocast:
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

    The memory that the rollout began with stays as it is. With the weights that acted, nothing changes.
    """
    done, memory = (rollout.terminated | rollout.truncated).cpu(), rollout.memory
    with torch.autocast(rollout.values.device.type, torch.bfloat16, enabled=args.amp):
        agent.memory.begin_rollout(memory, rollout.carry)
        for t in range(len(done)):
            x = agent.encoder({name: part[t] for name, part in rollout.obs.items()})
            _, stored = agent.memory.step(memory, x)
            agent.memory.store(memory, stored)
            agent.memory.reset(memory, done[t])


def clip_gradients(agent: Agent, args: Args) -> Tensor:
    """Scale the gradient down to --max-grad-norm if its norm is larger; return the norm.

    A detached head is clipped by itself: a share in the agent's norm would change the agent's step.
    """
    own = {*agent.parameters()}
    for head, detached in ((agent.decoder, args.reconstruction_detach), (agent.estimator, args.ground_truth_detach)):
        if head is not None and detached:
            nn.utils.clip_grad_norm_(head.parameters(), args.max_grad_norm)
            own -= {*head.parameters()}
    return nn.utils.clip_grad_norm_([each for each in agent.parameters() if each in own], args.max_grad_norm)


def mean_logs(steps: list[dict[str, Tensor]], rollout: Rollout) -> dict[str, float]:
    """Return the means of what the gradient steps of an update logged.

    Raises FloatingPointError if a loss or a gradient was not finite, which has spoilt the weights.
    """
    losses = {name: torch.stack([logs[name] for logs in steps]).mean().item() for name in steps[0]}
    if not (math.isfinite(losses["loss"]) and math.isfinite(losses["grad_norm"])):
        raise FloatingPointError("the loss or its gradient is not finite; try a lower --init-lr")
    # Before the first gradient step the weights are those that acted, so every ratio has to be 1.
    losses["ratio_error"] = steps[0]["ratio_error"].item()
    losses["explained_variance"] = explained_variance(rollout.values, rollout.returns)
    return {f"losses/{name}": value for name, value in losses.items()} | {"charts/gradient_steps": len(steps)}


# ---- 3 PPO ----
def anneal(step: int, initial: float, final: float, anneal_steps: int) -> float:
    """Decay linearly from initial to final over anneal_steps, then stay; without anneal_steps stay at initial."""
    fraction = min(step / anneal_steps, 1.0) if anneal_steps else 0.0
    return initial + fraction * (final - initial)


def gae(rollout: Rollout, last_value: Tensor, gamma: float, gae_lambda: float) -> Tensor:
    """Return the advantages (T, N) of generalized advantage estimation (2.34), cut wherever an episode ends.

    last_value (N,) is the value of the observation after the last step. Where an episode is truncated, what follows is
    worth its truncation value, which is zero unless the final observation is bootstrapped; where it terminated, zero.
    """
    done = rollout.terminated | rollout.truncated
    next_values = torch.cat([rollout.values[1:], last_value[None]])  # (T, N)
    next_values = torch.where(done, rollout.truncation_values * ~rollout.terminated, next_values)
    deltas = rollout.rewards + gamma * next_values - rollout.values
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

    It is largest for a uniform policy. Near probability 0 the gradients of surrogate loss and entropy vanish, but that
    of the log barrier does not (Agarwal et al., On the Theory of Policy Gradient Methods, 2021).
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
    def from_starts(cls, starts: Tensor) -> Pieces:
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

    def minibatches(self, count: int) -> Iterator[Pieces]:
        """Shuffle the pieces, and distribute them, whole, over count minibatches of about the same number of steps.

        No minibatch is empty: `check_minibatches` makes sure that no piece is longer than a minibatch's share.
        """
        order = torch.randperm(len(self.first))
        first, length = self.first[order], self.length[order]
        twice_middle = 2 * length.cumsum(0) - length
        minibatch = twice_middle * count // (2 * length.sum())  # (S,) of each piece, by the position of its middle
        sizes = minibatch.bincount(minlength=count).tolist()
        for mb_first, mb_length in zip(first.split(sizes), length.split(sizes), strict=True):
            yield Pieces(mb_first, mb_length, self.num_envs)


# ---- 4 MEMORY ----
# What the other sections use of any memory, and what another one has to have:
#   initial_state            the state of fresh episodes, with room for what a rollout stores
#   carry, begin_rollout     what one rollout hands to the next; begin a rollout with it
#   step, store, reset       take a step; store what it leaves; forget the episodes that ended
#   cut, unroll              cut a rollout into pieces; run whole pieces at once in the update
#   width                    D, the width of what comes out
#   input_width, longest_piece, flags    what is known before it is made
# begin_rollout, store and reset change a state in place; all others only read it.
@dataclass
class MemoryState:
    """What N environments remember, and what the update needs of the rollout's steps."""

    t: int  # the step of the rollout that comes next
    hidden: Tensor  # (N, P, D) the hidden state before that step
    stored: Tensor  # (T, N, P, D) the hidden state before each step


class Memory(nn.Module):
    """A stack of GRU or LSTM layers, or nothing (§5.2).

    The hidden state of an environment is P vectors of width D: one a layer for the GRU, two (hidden, then cell state)
    for the LSTM, none without memory. Raises ValueError for flags that would change nothing without memory.
    """

    flags = ("memory", "hidden_size", "num_layers")  # with other values, the same weights are another network

    def __init__(self, args: Args, inputs: int):
        super().__init__()
        if args.memory == "none" and (args.seq_len or args.num_layers > 1 or args.refresh_memory):
            raise ValueError("--seq-len, --num-layers and --refresh-memory need --memory gru or lstm")
        self.kind, self.seq_len = args.memory, args.seq_len
        self.width = inputs if args.memory == "none" else args.hidden_size
        self.hidden_vectors = args.num_layers * {"gru": 1, "lstm": 2, "none": 0}[args.memory]
        if args.memory != "none":
            rnn = nn.GRU if args.memory == "gru" else nn.LSTM
            # The outputs are activated already: another ReLU behind them would throw half of them away (§5.2.4).
            # As in CleanRL, a matrix is orthogonal that stacks those of all gates; a single gate's is not.
            self.rnn = layer_init(rnn(inputs, self.width, args.num_layers, batch_first=True), 1.0)

    @staticmethod
    def input_width(args: Args) -> int:
        """Return the width that the encoded observation is embedded in."""
        return args.hidden_size

    @staticmethod
    def longest_piece(args: Args) -> int:
        """Return how many steps a piece of a rollout may have."""
        return 1 if args.memory == "none" else min(args.seq_len or args.num_steps, args.num_steps)

    def initial_state(self, num_envs: int, num_steps: int, device: torch.device) -> MemoryState:
        """Return the state of fresh episodes, zeros, with room for a rollout of num_steps."""
        hidden = torch.zeros(num_envs, self.hidden_vectors, self.width, device=device)
        return MemoryState(0, hidden, torch.zeros(num_steps, *hidden.shape, device=device))

    def carry(self, state: MemoryState) -> dict[str, Tensor]:
        """Return what the next rollout begins with: the hidden state."""
        return {"hidden": state.hidden}

    def begin_rollout(self, state: MemoryState, carry: dict[str, Tensor]) -> None:
        """Go on with what `carry` returned, and store from the beginning again."""
        state.t, state.hidden = 0, carry["hidden"].to(state.stored.device)

    def step(self, state: MemoryState, x: Tensor) -> tuple[Tensor, Tensor]:
        """Take one step of all environments, x (N, I): return the output (N, D) and the hidden state (N, P, D)."""
        if self.kind == "none":
            return x, state.hidden
        y, hidden = self.recur(x[:, None], state.hidden)
        return y[:, 0], hidden

    def store(self, state: MemoryState, hidden: Tensor) -> None:
        """Store the hidden state before the step, and go on with the one after it."""
        state.stored[state.t] = state.hidden
        state.t, state.hidden = state.t + 1, hidden

    def reset(self, state: MemoryState, done: Tensor) -> None:
        """Forget the episodes that ended: done (N,), on the CPU."""
        state.hidden = state.hidden.masked_fill(done[:, None, None].to(state.hidden.device), 0.0)

    def cut(self, done: Tensor) -> Pieces:
        """Cut a rollout, whose episodes end where done (T, N) is true, into sequences."""
        starts = torch.ones_like(done)
        if self.kind == "none":
            return Pieces.from_starts(starts)  # every step by itself
        starts[1:] = done[:-1]
        if self.seq_len:
            t = torch.arange(len(done))[:, None]
            began = torch.where(starts, t, 0).cummax(0).values  # (T, N) the episode's first step in this rollout
            starts = (t - began) % self.seq_len == 0
        return Pieces.from_starts(starts)

    def unroll(self, state: MemoryState, x: Tensor, pieces: Pieces) -> Tensor:
        """Run whole sequences: x (B, I) to (B, D), each from the stored hidden state of its first step."""
        if self.kind == "none":
            return x
        hidden = state.stored.flatten(0, 1)[pieces.first.to(x.device)]  # (S, P, D)
        if self.kind == "gru" and x.device.type == "cpu":
            return packed_gru(self.rnn, x, pieces.length, hidden)  # the same without padding, and faster
        y, _ = self.recur(pieces.pad(x), hidden)  # (S, L, D)
        # The padding ends here: what follows, the losses' means (5.8) included, sees real steps only.
        return pieces.unpad(y)

    def recur(self, x: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Run the recurrent layers over x (S, L, I) from the hidden state (S, P, D); return outputs and last one."""
        hidden = hidden.transpose(0, 1).contiguous()  # (P, S, D)
        with torch.autocast(x.device.type, enabled=False):  # rounding errors would add up from step to step
            y, hidden = self.rnn(x, hidden if self.kind == "gru" else hidden.chunk(2))
        if self.kind == "lstm":
            hidden = torch.cat(hidden)
        return y, hidden.transpose(0, 1)


# ---- 5 AGENT ----
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


class Encoder(nn.Module):
    """Encodes the images and vectors of an observation, and embeds them together in `width` (§5.1), unless None."""

    def __init__(self, spaces: dict[str, gym.spaces.Box], width: int | None):
        super().__init__()
        self.images = [name for name, space in spaces.items() if len(space.shape) == 3]
        self.vectors = [name for name, space in spaces.items() if len(space.shape) == 1]
        self.cnns = nn.ModuleList(AtariCNN(spaces[name].shape[2]) for name in self.images)
        with torch.no_grad():
            blank = [torch.zeros(1, *spaces[name].shape) for name in self.images]
            features = sum(cnn(image).shape[1] for cnn, image in zip(self.cnns, blank, strict=True))
        if self.vectors:
            self.mlp = layer_init(nn.Linear(sum(spaces[name].shape[0] for name in self.vectors), 128))
            features += 128
        self.width = features if width is None else width
        self.embedding = None if width is None else layer_init(nn.Linear(features, width))

    def forward(self, obs: dict[str, Tensor]) -> Tensor:
        """Encode observations, each part (B, ...), to (B, self.width)."""
        features = [in_chunks(cnn, obs[name]) for cnn, name in zip(self.cnns, self.images, strict=True)]
        if self.vectors:
            features.append(F.relu(self.mlp(torch.cat([obs[name] for name in self.vectors], -1))))
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
    """The transposed Atari CNN: reconstructs an image of shape (height, width, channels) (§5.1.2, table 6.2)."""

    def __init__(self, features: int, shape: tuple[int, int, int]):
        *size, channels = shape  # of the image, then of each convolution's output
        output_padding = []  # pixels at the right and lower edge that a convolution does not reach
        for kernel, stride in ((8, 4), (4, 2), (3, 1)):
            output_padding.append([(side - kernel) % stride for side in size])
            size = [(side - kernel) // stride + 1 for side in size]
        super().__init__(
            layer_init(nn.Linear(features, 64 * math.prod(size))),
            nn.ReLU(inplace=True),
            nn.Unflatten(1, (64, *size)),
            layer_init(nn.ConvTranspose2d(64, 64, 3, 1)),
            nn.ReLU(inplace=True),
            layer_init(nn.ConvTranspose2d(64, 32, 4, 2, output_padding=output_padding[1])),
            nn.ReLU(inplace=True),
            layer_init(nn.ConvTranspose2d(32, channels, 8, 4, output_padding=output_padding[0]), 1.0),
        )

    def forward(self, features: Tensor) -> Tensor:
        """Map features (B, F) to the logits of images (B, height, width, channels)."""
        return super().forward(features).permute(0, 2, 3, 1)


class Agent(nn.Module):
    """Encoder, memory and heads: acts step by step, and evaluates whole pieces of what it did.

    nvec: number of actions of each branch. ground_truth_size: entries of the environment's ground truth. Raises
    ValueError for an observation that does not suit the arguments.
    """

    def __init__(self, space: gym.spaces.Dict, nvec: list[int], args: Args, ground_truth_size: int = 0):
        super().__init__()
        self.encoder = Encoder(space.spaces, Memory.input_width(args) if args.embedding else None)
        self.memory = Memory(args, self.encoder.width)
        self.heads = Heads(self.memory.width, nvec, args.trunk_size, args.value_init_gain)
        images = [space[name].shape for name in self.encoder.images]
        if args.reconstruction_coef and len(images) != 1:
            raise ValueError(f"--reconstruction-coef needs an observation with one image, not {len(images)}; use 0")
        with torch.random.fork_rng([]):  # with and without these, the random numbers that follow are the same
            self.decoder = Decoder(args.trunk_size, images[0]) if args.reconstruction_coef else None
            self.estimator = head(args.trunk_size, ground_truth_size, 1.0) if args.ground_truth_coef else None

    def get_action_and_value(self, obs: dict[str, Tensor], memory: MemoryState) -> tuple[Tensor, Tensor, Tensor]:
        """Take one step of all environments, which the memory's state stores.

        Returns actions (N, A), their log-probabilities (N, A) and values (N,).
        """
        x, stored = self.memory.step(memory, self.encoder(obs))
        self.memory.store(memory, stored)
        logits, values, _ = self.heads(x)
        policy = self.heads.distributions(logits)
        actions = torch.stack([branch.sample() for branch in policy], -1)
        return actions, log_probs_of(policy, actions), values

    def get_value(self, obs: dict[str, Tensor], memory: MemoryState) -> Tensor:
        """Return the values (N,) of observations that are not acted on; the memory's state stays as it is."""
        x, _ = self.memory.step(memory, self.encoder(obs))
        return self.heads(x)[1]

    def evaluate_actions(
        self, x: Tensor, actions: Tensor, pieces: Pieces, memory: MemoryState
    ) -> tuple[list[Categorical], Tensor, Tensor, Tensor]:
        """Recompute, with gradient, what `get_action_and_value` computed at the steps of the pieces.

        x: the steps' encoded observations (B, I). Returns the policy, a distribution of B actions for each branch, the
        log-probabilities (B, A) of the actions (B, A), values (B,) and features (B, F).
        """
        logits, values, features = self.heads(self.memory.unroll(memory, x, pieces))
        policy = self.heads.distributions(logits)
        return policy, log_probs_of(policy, actions), values, features


def log_probs_of(policy: list[Categorical], actions: Tensor) -> Tensor:
    """Return the log-probability (B, A) of the chosen action (B, A) of every branch."""
    return torch.stack([branch.log_prob(action) for branch, action in zip(policy, actions.unbind(-1), strict=True)], -1)


# ---- 6 MAIN ----
def setup(args: Args) -> Run:
    """Check the arguments and make all that a training needs; its files come last.

    Bad input raises before anything is written. Raises ValueError, OSError, ImportError or gymnasium.error.Error, each
    with one line for the user.
    """
    script = Path(__file__).stem
    device, checkpoint = prepare(args, script, Memory.longest_piece(args))
    with report_out_of_memory(args, device):
        envs = training_envs(args, checkpoint)
        obs, infos = envs.reset()
        agent = make_agent(Agent, envs, infos, args).to(device)
        rollout = Rollout.allocate(args.num_steps, obs, ground_truth_of(infos, args), agent)
    # The learning rate is a tensor, thus of float32. A float, which is of float64, would be simpler, but would change
    # rounding, and with it the curves of docs/results.md. The weight decay is torch's default.
    optimizer = torch.optim.AdamW(agent.parameters(), lr=torch.tensor(args.init_lr), weight_decay=0.01, fused=True)
    return open_run(args, Run(script, envs, agent, optimizer, rollout), checkpoint)


def main(args: Args) -> Path:
    """Train an agent as the arguments say; return the run folder. Raises what `setup` and `run_to_end` raise."""
    return run_to_end(args, setup(args), train)


if __name__ == "__main__":
    command(Args, PRESETS, setup, train)
