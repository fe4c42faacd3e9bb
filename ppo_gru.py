"""PPO with a recurrent memory: GRU or LSTM, or none, for comparison.

    python ppo_gru.py --env-id MortarMayhem-Grid-v0

The agent gets one observation at a time and carries a hidden state from step to step, zeroed where an episode ends.
The rollout stores the hidden state before each step. For the update, the steps of each environment are cut into
sequences at the ends of episodes (and every --seq-len steps), padded with zeros to the longest sequence, and run from
the stored hidden state of their first step: truncated back-propagation through time. The gradient flows back to the
first step of a sequence and no further. The stored states at the cuts of --seq-len are stale from the first gradient
step on; --refresh-memory recomputes them with the current weights before each epoch but the first.

Source: Marco Pleines, "Memory-based Deep Reinforcement Learning in Endless Imperfect Information Games", dissertation,
called the thesis below: §5.2 is a section, (5.7) an equation. Defaults: table 6.1, "Final", without auxiliary losses.

How to read: section 2 is the training loop, from the top down; 3 to 5 are what it is built from, 4 the memory; 6 makes
everything. In ppo_utils/ is what any training needs, the scale of rewards, KL estimates, and faster ways to compute the
same.

Shape letters: T steps of a rollout, N environments, A action branches, B steps of a minibatch, S sequences in it, L
steps of its longest sequence, I inputs and D width of the memory, P hidden vectors of an environment, F features of the
trunk, G entries of the ground truth.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.distributions import Categorical
from torch.nn.utils.rnn import pad_sequence

from ppo_utils.environments import as_tensors
from ppo_utils.evaluation import make_agent
from ppo_utils.fast import Muon, encode, first_occurrences, in_chunks, packed_gru
from ppo_utils.flags import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, RunArgs, UnitInterval
from ppo_utils.infos import add_ended, final_observations, ground_truth_of
from ppo_utils.logs import mean_logs, policy_metrics
from ppo_utils.moments import Moments
from ppo_utils.processes import all_gather, average_gradients
from ppo_utils.run import Run
from ppo_utils.runs import command, end_iteration, open_run, prepare, report_out_of_memory, run_to_end


# ---- 1 ARGS ----
@dataclass
class Args(RunArgs):
    """Train a PPO agent with a recurrent memory."""

    exp_name: str = Path(__file__).stem
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
    """before every epoch but the first, recompute the stored hidden states with the current weights"""
    bootstrap_truncated: bool = False
    """add the value of the final observation where a time limit ended an episode; without, it counts as terminated"""
    norm_reward: bool = False
    """divide rewards by the running standard deviation of the discounted return, and clip them to +-10; not in logs"""
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
    """end the update at a minibatch whose approximate KL divergence from the rollout's policy exceeds this (above 0)"""
    optimizer: Literal["adamw", "muon"] = "adamw"
    """muon: Muon for the matrices between hidden layers, at three times the rate; AdamW for all other weights"""
    init_lr: UnitInterval = 2.75e-4
    """initial learning rate"""
    final_lr: UnitInterval = 1.0e-5
    """learning rate from --anneal-steps on"""
    exploration_bonus: Literal["entropy", "log-barrier"] = "entropy"
    """what keeps the policy exploring: its entropy, or the mean log-probability of all actions"""
    init_ent_coef: NonNegativeFloat = 1.0e-4
    """initial weight of the exploration bonus"""
    final_ent_coef: NonNegativeFloat = 1.0e-6
    """weight of the exploration bonus from --anneal-steps on"""
    anneal_steps: NonNegativeInt | None = 163_840_000
    """steps over which learning rate and bonus weight decay linearly (0: no decay; None: --total-timesteps)"""
    reconstruction_coef: NonNegativeFloat = 0.0
    """weight of the loss of reconstructing the observed image (0: off; thesis: 0.1)"""
    ground_truth_coef: NonNegativeFloat = 0.0
    """weight of the loss of estimating the environment's ground truth (0: off; thesis: 0.1)"""
    auxiliary_detach: bool = False
    """only the decoder and the estimator learn from these two losses"""
    embedding: bool = True
    """a linear layer and a ReLU between encoder and memory"""
    trunk_size: PositiveInt = 512
    """width of the layer after the memory, and of the hidden layers of policy and value"""
    value_init_gain: NonNegativeFloat = 1.0
    """gain of the orthogonal initialization of the value's last layer; smaller: initial values closer to 0"""
    amp: bool = False
    """compute the encoder, a transformer and the decoder in bfloat16"""

    memory: Literal["gru", "lstm", "none"] = "gru"
    """what the agent remembers with"""
    hidden_size: PositiveInt = 512
    """width of the hidden state, and of the embedding"""
    num_layers: PositiveInt = 1
    """stacked recurrent layers"""
    seq_len: NonNegativeInt = 0
    """cut episodes into sequences of at most this many steps (0: only where an episode or the rollout ends)"""


LAPTOP = {
    "preset": "laptop", "obs_type": "vector", "attend_commands": True, "hidden_size": 128, "trunk_size": 128,
    "num_envs": 128, "num_steps": 128, "num_minibatches": 16, "update_epochs": 2,
    "norm_reward": True, "gamma": 0.99, "clip_coef": 0.2, "target_kl": 0.05, "max_grad_norm": 0.5,
    "exploration_bonus": "log-barrier", "init_ent_coef": 2e-3, "final_ent_coef": 2e-4,
    "optimizer": "muon", "init_lr": 1e-3, "final_lr": 1e-4, "total_timesteps": 6_000_000, "anneal_steps": None,
}  # fmt: skip
QUICKSTART = {
    **LAPTOP, "preset": "quickstart",
    # Two commands, each shown for one step; four steps to carry one out, and two on its tile while the others burn.
    "env_options": '{"command_count": [2], "command_show_duration": [1], "command_show_delay": [0], '
    '"explosion_delay": [4], "explosion_duration": [2]}',
    "hidden_size": 64, "trunk_size": 64, "num_steps": 32, "num_minibatches": 8, "init_lr": 4e-3,
    "value_init_gain": 0.01, "total_timesteps": 400_000,
}  # fmt: skip
PRESETS = {"thesis": {}, "laptop": LAPTOP, "quickstart": QUICKSTART}  # thesis: the defaults above


# ---- 2 TRAINING ----
def train(args: Args, run: Run) -> None:
    """Train until --total-timesteps, rounded down to whole iterations, or until a signal.

    Raises FloatingPointError if the training diverges, RunError as `end_iteration` does.
    """
    agent, batch_size = run.agent, args.num_envs * args.num_steps  # of all processes together
    # run.step is 0, or where the checkpoint of --resume was written.
    for global_step in range(run.step, args.total_timesteps - batch_size + 1, batch_size):
        began = time.perf_counter()
        run.iteration = global_step // batch_size + 1
        lr = anneal(global_step, args.init_lr, args.final_lr, args.anneal_steps)
        ent_coef = anneal(global_step, args.init_ent_coef, args.final_ent_coef, args.anneal_steps)
        for optimizer in run.optimizers:
            optimizer.param_groups[0]["lr"] = lr * optimizer.param_groups[0]["lr_ratio"]

        rollout, run.carry, episodes = collect(agent, run.envs, run.carry, args)
        collected = time.perf_counter()
        rewards = rollout.rewards
        if args.norm_reward:
            rewards = run.return_scale.scale(rewards, rollout.done, args.gamma)
        rollout.advantages = gae(rewards, rollout, args.gamma, args.gae_lambda)
        rollout.returns = rollout.advantages + rollout.values
        if args.norm_adv == "batch":
            rollout.advantages = normalize(rollout.advantages)
        step_logs, state = update(agent, run.optimizers, rollout, ent_coef, args)
        if args.refresh_memory:
            run.carry.memory = agent.memory.carry(state)  # the next rollout goes on with what was recomputed
        logs = mean_logs(step_logs, rollout.values, rollout.returns)
        updated = time.perf_counter()  # numbers were read: now a GPU has done the update, too

        del rollout, state  # before the next one is collected: one at a time is in memory
        logs |= {"charts/learning_rate": lr, "charts/entropy_coefficient": ent_coef}
        run.step = global_step + batch_size
        end_iteration(args, run, logs, episodes, (began, collected, updated))  # evaluates, logs, saves
        if run.stop:
            break


@dataclass
class Carry:
    """What one rollout of N environments hands to the next."""

    obs: dict[str, np.ndarray]  # each (N, ...), the next observations
    ground_truth: np.ndarray | None  # (N, G), if it is estimated
    memory: dict[str, Tensor]  # what `Memory.begin_rollout` takes


@dataclass
class Rollout:
    """T steps of N environments."""

    obs: dict[str, Tensor]  # each (T, N, ...): uint8 pixels stay uint8
    ground_truth: Tensor | None  # (T, N, G), if it is estimated
    actions: Tensor  # (T, N, A)
    log_probs: Tensor  # (T, N, A)
    values: Tensor  # (T, N)
    rewards: Tensor  # (T, N)
    done: Tensor  # (T, N) the step ended its episode, in one way or the other
    truncation_values: Tensor  # (T, N) value of the final observation, 0 unless a time limit alone ended the episode
    initial_memory: dict[str, Tensor]  # what the memory began with, for --refresh-memory
    memory_state: MemoryState  # what the memory stored of each step
    last_value: Tensor | None = None  # (N,) of the observation after the last step
    first_occurrence: Tensor | None = None  # (T * N,) flat index of the first equal observation; see `encode`
    advantages: Tensor | None = None  # (T, N)
    returns: Tensor | None = None  # (T, N)

    @classmethod
    def allocate(cls, num_steps: int, carry: Carry, agent: Agent) -> Rollout:
        """Make a rollout of zeros on the agent's device."""
        device, num_envs = next(agent.parameters()).device, len(next(iter(carry.obs.values())))
        obs, branches = as_tensors(carry.obs, torch.device("cpu")), len(agent.heads.nvec)
        zeros = partial(torch.zeros, num_steps, num_envs, device=device)
        return cls(
            obs={name: zeros(*part.shape[1:], dtype=part.dtype) for name, part in obs.items()},
            ground_truth=None if carry.ground_truth is None else zeros(carry.ground_truth.shape[1]),
            actions=zeros(branches, dtype=torch.int64),
            log_probs=zeros(branches),
            values=zeros(),
            rewards=zeros(),
            done=zeros(dtype=torch.bool),
            truncation_values=zeros(),
            initial_memory=carry.memory,
            memory_state=agent.memory.begin_rollout(carry.memory, num_steps),
        )


@torch.no_grad()
def collect(
    agent: Agent, envs: gym.vector.VectorEnv, carry: Carry, args: Args
) -> tuple[Rollout, Carry, dict[str, list[float]]]:
    """Act for T steps in all environments; return the steps, what the next rollout begins with, and metrics.

    An ended episode is reset in the same step: the next observation begins another one. Metrics: see `add_ended`.
    """
    device = next(agent.parameters()).device
    obs, ground_truth, episodes = carry.obs, carry.ground_truth, defaultdict(list)
    with torch.autocast(device.type, torch.bfloat16, enabled=args.amp):
        rollout = Rollout.allocate(args.num_steps, carry, agent)
        state = rollout.memory_state
        for t in range(args.num_steps):
            for name, part in obs.items():
                rollout.obs[name][t] = torch.from_numpy(part)
            if ground_truth is not None:
                rollout.ground_truth[t] = torch.from_numpy(ground_truth)
            step_obs = {name: part[t] for name, part in rollout.obs.items()}
            actions, rollout.log_probs[t], rollout.values[t] = agent.get_action_and_value(step_obs, state)
            rollout.actions[t] = actions

            with torch.autocast(device.type, enabled=False):  # for environments that compute with torch
                obs, rewards, terminated, truncated, infos = envs.step(actions.cpu().numpy())
            done = torch.as_tensor(terminated | truncated)
            rollout.rewards[t], rollout.done[t] = torch.as_tensor(rewards), done
            if args.bootstrap_truncated and truncated.any():
                final = as_tensors(final_observations(obs, infos, truncated), device)
                value = agent.get_value(final, state)  # with the memory of the episode that ended
                rollout.truncation_values[t] = value.where(torch.as_tensor(truncated & ~terminated).to(device), 0.0)
            agent.memory.reset(state, done)
            ground_truth = ground_truth_of(infos, args, ground_truth)
            add_ended(episodes, infos, done.numpy())
        rollout.last_value = agent.get_value(as_tensors(obs, device), state)
    rollout.first_occurrence = first_occurrences(rollout.obs)  # for speed: on a CPU, equal images are encoded once
    return rollout, Carry(obs, ground_truth, agent.memory.carry(state)), episodes


def update(
    agent: Agent, optimizers: list[torch.optim.Optimizer], rollout: Rollout, ent_coef: float, args: Args
) -> tuple[list[dict[str, Tensor]], MemoryState]:
    """Learn from the rollout for some epochs; return what to log of each minibatch, and the memory's last state."""
    pieces, step_logs = agent.memory.cut(rollout.done.cpu()), []
    for epoch in range(args.update_epochs):
        if args.refresh_memory and epoch > 0:
            rollout = replace(rollout, memory_state=refreshed_state(agent, rollout, args))
        for minibatch in pieces.minibatches(args.num_minibatches):
            loss, logs = ppo_loss(agent, rollout, minibatch, ent_coef, args)
            step_logs.append(logs)
            if args.target_kl is not None and len(step_logs) > 1:  # the first one's is 0: nothing has been learned yet
                kl = np.mean(all_gather(logs["approx_kl"].item()))  # all processes stop together
                if kl > args.target_kl:
                    return step_logs, rollout.memory_state
            agent.zero_grad()
            loss.backward()
            average_gradients(agent, int(minibatch.length.sum()))  # over processes, if there are several
            logs["grad_norm"] = clip_gradients(agent, args)
            for optimizer in optimizers:
                optimizer.step()
    return step_logs, rollout.memory_state


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
        lists = {name: gather(rollout.obs[name]) for name in agent.heads.scores}  # each (B, rows, columns)
        actions = gather(rollout.actions)  # (B, A)
        policy, log_probs, values, features = agent.evaluate_actions(x, lists, actions, minibatch, rollout.memory_state)
    log_ratio = log_probs - gather(rollout.log_probs)  # (B, A)
    advantages, old_values, returns = gather(rollout.advantages), gather(rollout.values), gather(rollout.returns)
    if args.norm_adv == "minibatch":
        advantages = normalize(advantages)
    pg_loss = policy_loss(log_ratio, advantages, args.clip_coef)
    v_loss = value_loss(values, old_values, returns, args.clip_coef if args.clip_vloss else None)
    entropy = sum(branch.entropy() for branch in policy).mean()  # the branches are independent
    # Unlike the entropy's, the log-barrier's gradient does not vanish near probability 0 (Agarwal et al., 2021).
    barrier = sum(branch.logits.mean() for branch in policy)  # a Categorical's logits are log-probabilities
    loss = pg_loss + args.vf_coef * v_loss - ent_coef * (entropy if args.exploration_bonus == "entropy" else barrier)
    logs = {"policy_loss": pg_loss, "value_loss": v_loss, "entropy": entropy, "log_barrier": barrier}
    if args.auxiliary_detach:
        features = features.detach()
    if agent.decoder is not None:  # (5.5)
        with autocast:
            logits = in_chunks(agent.decoder, features)
        pixels = gather(rollout.obs[agent.encoder.images[0]])  # (B, height, width, channels)
        target = pixels / 255 if pixels.dtype == torch.uint8 else pixels
        logs["reconstruction_loss"] = F.binary_cross_entropy_with_logits(logits.float(), target)
        loss = loss + args.reconstruction_coef * logs["reconstruction_loss"]
    if agent.estimator is not None:  # (5.6)
        logs["ground_truth_loss"] = F.mse_loss(agent.estimator(features), gather(rollout.ground_truth))
        loss = loss + args.ground_truth_coef * logs["ground_truth_loss"]
    logs |= {"loss": loss, **policy_metrics(log_ratio, args.clip_coef)}  # among them what --target-kl limits
    return loss, {name: value.detach() for name, value in logs.items()}


@torch.no_grad()
def refreshed_state(agent: Agent, rollout: Rollout, args: Args) -> MemoryState:
    """Return what the memory would have stored with the current weights (§7.1.4; Kapturowski et al., 2019).

    What the rollout began with is not recomputed. With the weights that acted, it is the same, up to rounding.
    """
    done = rollout.done.cpu()
    with torch.autocast(rollout.values.device.type, torch.bfloat16, enabled=args.amp):
        state = agent.memory.begin_rollout(rollout.initial_memory, len(done))
        for t in range(len(done)):
            _, hidden = agent.memory.step(state, agent.encoder({name: part[t] for name, part in rollout.obs.items()}))
            agent.memory.advance(state, hidden)
            agent.memory.reset(state, done[t])
    return state


def clip_gradients(agent: Agent, args: Args) -> Tensor:
    """Scale the gradient down to --max-grad-norm if its norm is larger; return the norm before.

    With --auxiliary-detach, each auxiliary head is clipped by itself, so that it does not change the agent's step.
    """
    apart = agent.auxiliary if args.auxiliary_detach else ()
    for network in filter(None, (getattr(agent, name) for name in apart)):
        nn.utils.clip_grad_norm_(network.parameters(), args.max_grad_norm)  # in place
    others = [weight for name, weight in agent.named_parameters() if name.partition(".")[0] not in apart]
    return nn.utils.clip_grad_norm_(others, args.max_grad_norm)


# ---- 3 PPO ----
def anneal(step: int, initial: float, final: float, anneal_steps: int) -> float:
    """Decay linearly from initial to final over anneal_steps, then stay; without anneal_steps stay at initial."""
    fraction = min(step / anneal_steps, 1.0) if anneal_steps else 0.0
    return initial + fraction * (final - initial)


def gae(rewards: Tensor, rollout: Rollout, gamma: float, gae_lambda: float) -> Tensor:
    """Return the advantages (T, N) of generalized advantage estimation (2.34), cut wherever an episode ends.

    Where an episode ended, the next value is the bootstrapped value of its final observation, or zero.
    """
    next_values = torch.cat([rollout.values[1:], rollout.last_value[None]])  # (T, N)
    next_values = torch.where(rollout.done, rollout.truncation_values, next_values)
    deltas = rewards + gamma * next_values - rollout.values
    decay = gamma * gae_lambda * ~rollout.done
    advantages = torch.empty_like(deltas)
    advantage = torch.zeros_like(rollout.last_value)
    for t in reversed(range(len(deltas))):
        advantages[t] = advantage = deltas[t] + decay[t] * advantage
    return advantages


def normalize(x: Tensor) -> Tensor:
    """Return x, of any shape, with mean 0 and standard deviation 1, over all processes."""
    moments = Moments()
    moments.add(x)
    return (x - moments.mean) / (moments.deviation + 1e-8)


def policy_loss(log_ratio: Tensor, advantages: Tensor, clip_coef: float) -> Tensor:
    """Return the clipped surrogate loss (2.41) of log_ratio (B, A): its mean over branches (5.4) and samples."""
    ratio = log_ratio.clamp(max=20).exp()  # from 89 on, it would be infinite, and with an advantage of 0 NaN
    advantages = advantages[:, None]
    return -torch.minimum(ratio * advantages, ratio.clamp(1 - clip_coef, 1 + clip_coef) * advantages).mean()


def value_loss(values: Tensor, old_values: Tensor, returns: Tensor, clip_coef: float | None) -> Tensor:
    """Return the mean squared error of values (B,), clipped around old_values (2.43) if clip_coef; not halved."""
    loss = (values - returns).square()
    if clip_coef is not None:
        clipped = old_values + (values - old_values).clamp(-clip_coef, clip_coef)
        loss = torch.maximum(loss, (clipped - returns).square())
    return loss.mean()


@dataclass
class Pieces:
    """Pieces of a rollout: consecutive steps of one environment each. A minibatch consists of whole pieces.

    A memory decides where a rollout is cut: a recurrent one into sequences, at the ends of episodes; a transformer into
    segments of the same length. A rollout's tensors are (T, N, ...); flattened, step t of environment n has the index
    t * N + n. Two environments, five steps, and an episode of environment 0 that ends after t = 2, cut into sequences:

        flat indices   t = 0  1  2  3  4        pieces         first   length
        environment 0      0  2  4 |6  8        0  2  4          0       3
        environment 1      1  3  5  7  9        6  8             6       2
                                                1  3  5  7  9    1       5

    flat_index() lists the steps of all pieces, (B,): 0 2 4 6 8 1 3 5 7 9. What belongs to them, x (B, ...), is padded
    for a network that runs over time, pad(x) (S, L, ...), and unpad takes the padding away again:

        x0  x2  x4  0   0
        x6  x8  0   0   0
        x1  x3  x5  x7  x9
    """

    first: Tensor  # (S,) flat index of each piece's first step
    length: Tensor  # (S,) number of its steps; both on the CPU, since shapes depend on them
    num_envs: int  # N

    @classmethod
    def from_starts(cls, starts: Tensor) -> Pieces:
        """Make pieces that begin at every step where starts (T, N) is true; starts[0] has to be."""
        num_steps, num_envs = starts.shape
        n, t = starts.T.nonzero().unbind(-1)  # (S,) each, environment after environment
        length = torch.diff(n * num_steps + t, append=torch.tensor([num_steps * num_envs]))
        return cls(t * num_envs + n, length, num_envs)

    def is_real(self) -> Tensor:
        """Return the mask (S, L) of a padded batch: true at steps, false at padding."""
        return torch.arange(int(self.length.max())) < self.length[:, None]

    def flat_index(self) -> Tensor:
        """Return the flat indices (B,) of all steps, piece after piece."""
        piece, column = self.is_real().nonzero().unbind(-1)  # (B,) each
        return self.first[piece] + column * self.num_envs

    def pad(self, x: Tensor) -> Tensor:
        """Pad what belongs to the steps, (B, ...), with zeros to the longest piece: (S, L, ...)."""
        return pad_sequence(x.split(self.length.tolist()), batch_first=True)

    def unpad(self, y: Tensor) -> Tensor:
        """Take the padding away: (S, L, ...) to (B, ...)."""
        index = self.is_real().flatten().nonzero()[:, 0]  # on the CPU: indexing by a mask makes a GPU synchronize
        return y.flatten(0, 1).index_select(0, index.to(y.device))

    def minibatches(self, count: int) -> Iterator[Pieces]:
        """Shuffle the pieces, and distribute them over count minibatches of about the same number of steps.

        None is empty, unless a piece is longer than 1 / count of all steps, which `open_run` has ruled out.
        """
        order = torch.randperm(len(self.first))
        first, length = self.first[order], self.length[order]
        # Divide all pieces, end to end, into count equal parts: a piece belongs to the part in which its middle lies.
        twice_middle = 2 * length.cumsum(0) - length  # an integer
        part = twice_middle * count // (2 * length.sum())  # (S,), ascending
        sizes = part.bincount(minlength=count).tolist()
        for mb_first, mb_length in zip(first.split(sizes), length.split(sizes), strict=True):
            yield Pieces(mb_first, mb_length, self.num_envs)


# ---- 4 MEMORY ----
# The interface of a memory, which the other sections use:
#   initial, carry           what episodes begin with, what the next rollout goes on with: a dict of tensors
#   begin_rollout            from such a dict, the state of a rollout, with room for what its steps store
#   step, advance, reset     compute a step; store it and move on; forget the episodes that ended
#   cut, unroll              cut a rollout into pieces; compute whole pieces at once in the update
#   width, flags             D, the width of its output; the arguments that loaded weights must have been trained with
#   input_width              from the arguments alone: the width of an embedding
# advance and reset change a state in place; all others only read it.
@dataclass
class MemoryState:
    """What N environments remember, and what the update needs of the rollout's steps."""

    now: int  # the step of the rollout that comes next
    hidden: Tensor  # (N, P, D) the hidden state before that step
    stored: Tensor  # (T, N, P, D) the hidden state before each step


class Memory(nn.Module):
    """A stack of GRU or LSTM layers, or nothing (§5.2).

    The hidden state of an environment is P vectors of width D: that of each layer, then for the LSTM the cell state of
    each layer; none without memory. Raises ValueError for flags that would change nothing without memory.
    """

    flags = ("memory", "hidden_size", "num_layers")

    def __init__(self, args: Args, inputs: int):
        super().__init__()
        if args.memory == "none" and (args.seq_len or args.num_layers > 1 or args.refresh_memory):
            raise ValueError("--seq-len, --num-layers and --refresh-memory need --memory gru or lstm")
        self.kind = args.memory
        self.seq_len = 1 if args.memory == "none" else args.seq_len  # without memory, a step is a piece by itself
        self.width = inputs if args.memory == "none" else args.hidden_size
        self.hidden_vectors = args.num_layers * {"gru": 1, "lstm": 2, "none": 0}[args.memory]
        if args.memory != "none":
            rnn = nn.GRU if args.memory == "gru" else nn.LSTM
            # As in CleanRL, the stacked matrix of all gates is orthogonal, not each gate's. No ReLU follows: it would
            # throw away half of tanh's outputs (§5.2.4).
            self.rnn = layer_init(rnn(inputs, self.width, args.num_layers, batch_first=True), 1.0)

    @staticmethod
    def input_width(args: Args) -> int:
        """Return the width that the encoded observation is embedded in."""
        return args.hidden_size

    def initial(self, num_envs: int, device: torch.device) -> dict[str, Tensor]:
        """Return the memory of fresh episodes: zeros, (N, P, D)."""
        return {"hidden": torch.zeros(num_envs, self.hidden_vectors, self.width, device=device)}

    def carry(self, state: MemoryState) -> dict[str, Tensor]:
        """Return what the next rollout goes on with: the hidden state, which nothing changes in place."""
        return {"hidden": state.hidden}

    def begin_rollout(self, carry: dict[str, Tensor], num_steps: int) -> MemoryState:
        """Return a state that goes on with what `initial` or `carry` returned, with room for num_steps."""
        hidden = carry["hidden"]
        return MemoryState(0, hidden, hidden.new_zeros(num_steps, *hidden.shape))

    def step(self, state: MemoryState, x: Tensor) -> tuple[Tensor, Tensor]:
        """Compute one step of all environments, x (N, I): the output (N, D) and the next hidden state (N, P, D)."""
        if self.kind == "none":
            return x, state.hidden
        y, hidden = self.recur(x[:, None], state.hidden)
        return y[:, 0], hidden

    def advance(self, state: MemoryState, hidden: Tensor) -> None:
        """Store the hidden state before the step, and move on to the one after it."""
        if state.now == len(state.stored):
            raise IndexError("there is no room for this step; begin_rollout(carry(state), num_steps) makes room again")
        state.stored[state.now] = state.hidden
        state.hidden = hidden
        state.now += 1

    def reset(self, state: MemoryState, done: Tensor) -> None:
        """Forget the episodes that ended: done (N,), on the CPU."""
        state.hidden = state.hidden.masked_fill(done[:, None, None].to(state.hidden.device), 0.0)

    def cut(self, done: Tensor) -> Pieces:
        """Cut a rollout, whose episodes end where done (T, N) is true, into sequences."""
        starts = torch.ones_like(done)
        starts[1:] = done[:-1]
        t = torch.arange(len(done))[:, None]
        began = torch.where(starts, t, 0).cummax(0).values  # (T, N) the episode's first step in this rollout
        length = self.seq_len or len(done)  # 0: no episode is cut
        return Pieces.from_starts((t - began) % length == 0)

    def unroll(self, state: MemoryState, x: Tensor, pieces: Pieces) -> Tensor:
        """Run whole sequences: x (B, I) to (B, D), each from the stored hidden state of its first step."""
        if self.kind == "none":
            return x
        hidden = state.stored.flatten(0, 1)[pieces.first.to(x.device)]  # (S, P, D)
        if self.kind == "gru" and x.device.type == "cpu":
            return packed_gru(self.rnn, x, pieces.length, hidden)  # the same without padding, and faster
        y, _ = self.recur(pieces.pad(x), hidden)  # (S, L, D)
        return pieces.unpad(y)  # so that the losses are means over real steps (5.8)

    def recur(self, x: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Run the layers over x (S, L, I) from the hidden state (S, P, D): outputs (S, L, D), last state (S, P, D)."""
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
        """Map pixels (B, height, width, channels), uint8 or float in [0, 1], to the last layer's maps, flattened."""
        scaled = pixels.float().mul_(1 / 255) if pixels.dtype == torch.uint8 else pixels
        features = super().forward(scaled.permute(0, 3, 1, 2))  # (B, 64, smaller height, smaller width)
        return features.permute(0, 2, 3, 1).flatten(1)  # a view, since they are stored channels last


class Encoder(nn.Module):
    """Encodes the images and vectors of an observation, and embeds them together (§5.1); width None: no embedding."""

    def __init__(self, spaces: dict[str, gym.spaces.Box], width: int | None):
        super().__init__()
        self.images = [name for name, space in spaces.items() if len(space.shape) == 3]
        self.vectors = [name for name, space in spaces.items() if len(space.shape) == 1]
        self.cnns = nn.ModuleList(AtariCNN(spaces[name].shape[2]) for name in self.images)
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

    def __init__(self, width: int, shapes: dict[str, tuple[int, int]], nvec: list[int], size: int, value_gain: float):
        super().__init__()
        self.nvec = nvec  # number of actions of each branch, as Gymnasium calls it
        # An observed list, (rows, columns), is read by attention: the memory's output gives each of its rows a score.
        self.scores = nn.ModuleDict({name: mlp_head(width, rows, 1.0) for name, (rows, _) in shapes.items()})
        self.trunk = layer_init(nn.Linear(width + sum(columns for _, columns in shapes.values()), size))
        self.policy = mlp_head(size, sum(nvec), 0.1)  # as in the author's code: nearly uniform at first
        self.value = mlp_head(size, 1, value_gain)

    def forward(self, x: Tensor, obs: dict[str, Tensor]) -> tuple[list[Categorical], Tensor, Tensor]:
        """Map the memory's output (B, D) and observed lists to each branch's policy, values (B,), features (B, F)."""
        with torch.autocast(x.device.type, enabled=False):  # --amp: bfloat16 is too coarse for values and log-ratios
            x = x.float()
            # Normalized scores keep all weights well above 0: a row that is not read yet still gets a gradient.
            scores = {name: score(x) for name, score in self.scores.items()}  # each (B, rows)
            weights = {name: F.layer_norm(each, each.shape[-1:]).softmax(-1) for name, each in scores.items()}
            read = [(weight[:, None] @ obs[name])[:, 0] for name, weight in weights.items()]  # each (B, columns)
            features = F.relu(self.trunk(torch.cat([x, *read], -1)))
            logits = self.policy(features).split(self.nvec, -1)  # A parts
            policy = [Categorical(logits=part, validate_args=False) for part in logits]
            return policy, self.value(features)[:, 0], features


def mlp_head(size: int, outputs: int, gain: float) -> nn.Sequential:
    """Make a head of two layers; gain initializes the last one."""
    hidden, last = layer_init(nn.Linear(size, size)), layer_init(nn.Linear(size, outputs), gain)
    return nn.Sequential(hidden, nn.ReLU(inplace=True), last)


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
    """Encoder, memory and heads: acts step by step, and recomputes pieces of a rollout with gradient.

    nvec: number of actions of each branch. ground_truth_size: entries of the environment's ground truth. Raises
    ValueError for an observation that does not suit the arguments.
    """

    auxiliary = ("decoder", "estimator")  # networks that neither act nor value, None where they are off

    def __init__(self, space: gym.spaces.Dict, nvec: list[int], args: Args, ground_truth_size: int = 0):
        super().__init__()
        self.encoder = Encoder(space.spaces, Memory.input_width(args) if args.embedding else None)
        self.memory = Memory(args, self.encoder.width)
        list_shapes = {name: each.shape for name, each in space.items() if len(each.shape) == 2}
        self.heads = Heads(self.memory.width, list_shapes, nvec, args.trunk_size, args.value_init_gain)
        images = [space[name].shape for name in self.encoder.images]
        if args.reconstruction_coef and len(images) != 1:
            raise ValueError(f"--reconstruction-coef needs an observation with one image, not {len(images)}; use 0")
        with torch.random.fork_rng(devices=[]):  # they do not change the random numbers that are drawn later
            self.decoder = Decoder(args.trunk_size, images[0]) if args.reconstruction_coef else None
            self.estimator = mlp_head(args.trunk_size, ground_truth_size, 1.0) if args.ground_truth_coef else None

    def get_action_and_value(
        self, obs: dict[str, Tensor], state: MemoryState, deterministic: bool = False
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Act in all environments, and move the memory on: actions (N, A), log-probabilities (N, A), values (N,).

        deterministic: take each branch's most probable action instead of sampling.
        """
        x, hidden = self.memory.step(state, self.encoder(obs))
        self.memory.advance(state, hidden)
        policy, values, _ = self.heads(x, obs)
        actions = torch.stack([branch.mode if deterministic else branch.sample() for branch in policy], -1)
        return actions, log_probs_of(policy, actions), values

    def get_value(self, obs: dict[str, Tensor], state: MemoryState) -> Tensor:
        """Return the values (N,) of observations that are not acted on; the memory's state stays as it is."""
        x, _ = self.memory.step(state, self.encoder(obs))
        return self.heads(x, obs)[1]

    def evaluate_actions(
        self, x: Tensor, lists: dict[str, Tensor], actions: Tensor, pieces: Pieces, state: MemoryState
    ) -> tuple[list[Categorical], Tensor, Tensor, Tensor]:
        """Recompute, with gradient, what `get_action_and_value` computed at the steps of the pieces.

        x: the steps' encoded observations (B, I). lists: those observed. Returns for each branch a distribution of B
        actions, the log-probabilities (B, A) of the actions (B, A), values (B,) and features (B, F).
        """
        policy, values, features = self.heads(self.memory.unroll(state, x, pieces), lists)
        return policy, log_probs_of(policy, actions), values, features


def log_probs_of(policy: list[Categorical], actions: Tensor) -> Tensor:
    """Return the log-probability (B, A) of the chosen action (B, A) of every branch."""
    return torch.stack([branch.log_prob(action) for branch, action in zip(policy, actions.unbind(-1), strict=True)], -1)


def make_optimizers(agent: Agent, args: Args) -> list[torch.optim.Optimizer]:
    """Return AdamW, and with --optimizer muon also Muon (Jordan et al., 2024) for the matrices between hidden layers.

    Its steps are orthogonal: all directions of a matrix change equally. Outer layers, whose other side is an
    observation or an output, are AdamW's, as is all that is no weight of an `nn.Linear`, such as recurrent layers.
    `train` sets the learning rates; Muon's is three times AdamW's.
    """
    heads, hidden = agent.heads, []
    if args.optimizer == "muon":
        first_layers = [head[0] for head in (heads.policy, heads.value, *heads.scores.values())]
        inner = filter(None, [agent.encoder.embedding, agent.memory, heads.trunk, *first_layers])
        hidden = [layer.weight for part in inner for layer in part.modules() if isinstance(layer, nn.Linear)]
    others = [weight for weight in agent.parameters() if weight not in {*hidden}]
    adamw = torch.optim.AdamW([{"params": others, "lr": args.init_lr, "lr_ratio": 1.0}], fused=True)
    if not hidden:
        return [adamw]
    group = {"params": hidden, "lr": 3.0 * args.init_lr, "lr_ratio": 3.0}
    return [adamw, Muon([group], weight_decay=0.01, adjust_lr_fn="match_rms_adamw")]


# ---- 6 MAIN ----
def setup(args: Args) -> Run:
    """Check the arguments and make all that a training needs; bad input raises before any file is written.

    Raises ValueError, OSError, ImportError, RunError or gymnasium.error.Error, each with one line for the user.
    """
    run, obs, infos = prepare(args, Path(__file__).stem)
    with report_out_of_memory(args, run.device, run.envs.single_observation_space):
        run.agent = make_agent(Agent, run.envs, infos, args).to(run.device)
        run.carry = Carry(obs, ground_truth_of(infos, args), run.agent.memory.initial(run.envs.num_envs, run.device))
        Rollout.allocate(args.num_steps, run.carry, run.agent)  # does it fit?
    run.optimizers = make_optimizers(run.agent, args)
    return open_run(args, run)  # sets all of it to the checkpoint's state, if there is one


def main(args: Args) -> Path:
    """Train an agent from Python; return the run folder. Raises what `setup` and `run_to_end` raise."""
    args = replace(args)  # `setup` fills in what is None
    return run_to_end(args, setup(args), train)


if __name__ == "__main__":
    command(Args, PRESETS, setup, train)
