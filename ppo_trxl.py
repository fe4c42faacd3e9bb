"""PPO that remembers with a Transformer-XL: an episodic memory that is attended to through a sliding window.

    python ppo_trxl.py --env-id MortarMayhem-Grid-v0

The agent gets one observation at a time. Every step stores its hidden states, the inputs of the transformer's blocks.
Block k of a later step attends to the inputs of block k at the last --trxl-memory-length steps of the episode, its
window. They are stored without gradient, computed with the weights that acted. With --trxl-memory-gradient, the update
recomputes those of a segment's earlier steps, with gradient. With --refresh-memory, it recomputes those of the rollout,
without gradient, before each epoch but the first.

No query gets a copy of its window. While acting, a hidden state is projected to its key and value once, into a cache,
and the window's again at the start of each rollout. For the update, an environment's rollout and the window before it
form a timeline, which is cut into segments of --trxl-segment-length steps. The queries of a segment attend to its own
steps and to those before it, all projected once, under one band mask.

Source: Marco Pleines, "Memory-based Deep Reinforcement Learning in Endless Imperfect Information Games", dissertation,
called the thesis below: §5.3 is a section of it, (5.7) an equation. Defaults are the "Final" column of its table 6.1,
without auxiliary losses.

How to read: section 2 is the training loop and what it calls, from the top down; 3 to 5 are what these are built from,
4 the memory; 6 makes everything. Code that does not depend on the algorithm comes from ppo_utils/: types of flags,
environments, evaluation, run folder, checkpoints, several processes, and faster ways to compute the same.

Shape letters: T steps of a rollout, N environments, A action branches, B steps of a minibatch, S segments in it, L
steps of its longest segment, W window, M keys that are attended to, K blocks, R hidden states that a step stores (K, or
K + 1), H attention heads, D width of the memory and I of its input (the same), F features of the trunk, G entries of
the ground truth.
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

from ppo_utils.environments import as_tensors, training_envs
from ppo_utils.evaluation import make_agent
from ppo_utils.fast import encode, first_occurrences, in_chunks
from ppo_utils.flags import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, UnitInterval, bounded
from ppo_utils.infos import add_ended, final_observations, ground_truth_of
from ppo_utils.processes import all_gather, average_gradients
from ppo_utils.run import Run
from ppo_utils.runs import command, end_iteration, open_run, prepare, report_out_of_memory, run_to_end


# ---- 1 ARGS ----
@dataclass
class Args:
    """Train a PPO agent with a Transformer-XL memory."""

    exp_name: str = Path(__file__).stem
    """name of the experiment, part of the run folder's name"""
    preset: Literal["thesis", "laptop", "quickstart"] = "thesis"
    """a set of defaults, listed above; explicit flags override it (in Python: Args(**PRESETS["laptop"]))"""
    seed: NonNegativeInt = 1
    """seed of weights, actions and environments; on a CPU with as many threads, a run is repeated bit for bit"""
    torch_deterministic: bool = True
    """ask cuDNN for deterministic algorithms"""
    cuda: bool = True
    """train on the GPU if there is one"""
    amp: bool = False
    """compute in bfloat16, apart from recurrent layers, heads and losses"""
    track: bool = False
    """log to Weights and Biases too (extra `track`); WANDB_PROJECT and WANDB_ENTITY name project and team"""
    capture_video: bool = False
    """record some episodes of the first environment (extra `play`)"""
    save_model: bool = False
    """write model.pt to the run folder when training ends"""
    load_model: str | None = None
    """start from the weights in this model.pt or checkpoint; optimizer and step count start afresh"""
    resume: str | None = None
    """continue the run in this folder from its last checkpoint; only --total-timesteps may change, to a larger value"""
    checkpoint_interval: NonNegativeInt = 50
    """iterations between checkpoints, with another one at the end (0: no checkpoints); the last two are kept"""

    env_id: str = "MortarMayhem-Grid-v0"
    """any Gymnasium id with Discrete or MultiDiscrete actions; as module:id if importing a module registers it"""
    env_options: str = "{}"
    """reset options of a Memory Gym environment as JSON, e.g. '{"command_count": [4]}'"""
    env_kwargs: str = "{}"
    """constructor arguments of another package's environment as JSON, e.g. '{"size": 9}'"""
    async_envs: bool = False
    """train in environments that are each a process of their own, for slow ones of other packages"""
    num_levels: NonNegativeInt = 100_000
    """number of levels to train on (0: no limit); in environments of other packages, a level is a seed"""
    start_level: NonNegativeInt = 0
    """the first of these levels"""
    obs_type: Literal["pixels", "grayscale", "vector"] = "pixels"
    """what a Memory Gym environment shows: images in color or in gray, or vectors of what can be seen on them"""
    frame_stack: NonNegativeInt = 0
    """observe the last K images, in grayscale, or the last K vectors (0: the current one, in color)"""
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
    """before every epoch but the first, recompute the stored hidden states with the current weights"""
    bootstrap_truncated: bool = False
    """add the value of the final observation where a time limit ended an episode; without, it counts as terminated"""
    norm_reward: bool = False
    """divide rewards by the running standard deviation of the discounted return; logged returns are not divided"""
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
    """muon: Muon for the matrices between hidden layers, AdamW for all other weights"""
    muon_lr_ratio: bounded(float, 0, 1000, above=True) = 3.0
    """learning rate of Muon, in multiples of AdamW's (--init-lr, --final-lr)"""
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
    anneal_steps: NonNegativeInt = 163_840_000
    """steps over which learning rate and bonus weight decay linearly, whatever --total-timesteps is (0: no decay)"""
    reconstruction_coef: NonNegativeFloat = 0.0
    """weight of the loss of reconstructing the observed image (0: off; thesis: 0.1)"""
    reconstruction_detach: bool = False
    """only the decoder learns from this loss"""
    ground_truth_coef: NonNegativeFloat = 0.0
    """weight of the loss of estimating the environment's ground truth (0: off; thesis: 0.1)"""
    ground_truth_detach: bool = False
    """only the estimator learns from this loss"""
    embedding: bool = True
    """a linear layer and a ReLU between encoder and memory"""
    trunk_size: PositiveInt = 512
    """width of the layer after the memory, and of the hidden layers of policy and value"""
    value_init_gain: NonNegativeFloat = 1.0
    """gain of the orthogonal initialization of the value's last layer; smaller: initial values closer to 0"""

    eval_interval: NonNegativeInt = 0
    """iterations between evaluations on unseen levels, with another one at the end (0: no evaluations)"""
    eval_levels: PositiveInt = 50
    """number of levels of an evaluation, which follow those of the training; each is played three times"""
    eval_max_steps: PositiveInt = 10_000
    """an evaluation cuts episodes off after this many steps"""

    trxl_num_layers: PositiveInt = 3
    """blocks of the transformer"""
    trxl_num_heads: PositiveInt = 4
    """attention heads of a block"""
    trxl_dim: PositiveInt = 384
    """width of the blocks"""
    trxl_memory_length: PositiveInt = 256
    """window: the most steps back that a query attends to, within its episode"""
    trxl_positional_encoding: Literal["absolute", "learned", "relative", "none"] = "absolute"
    """what tells the order of the steps that are attended to"""
    trxl_query_position: bool = False
    """add the encoding of its own step to the first block's query: the learned one, or else the absolute one"""
    trxl_query_output: bool = False
    """add a projection of the last block's output at the step before to the first block's query, without gradient"""
    trxl_pe_length: PositiveInt = 2048
    """steps that a learned encoding tells apart; later ones share its last entry"""
    trxl_segment_length: PositiveInt = 128
    """steps of one environment that the update computes at once; minibatches are made of such segments"""
    trxl_memory_gradient: bool = False
    """attend to the recomputed, not the stored, hidden states of a segment's earlier steps, with gradient"""
    trxl_init: Literal["xavier", "orthogonal", "kaiming", "tfixup"] = "xavier"
    """initialization of the blocks' weights"""
    trxl_layer_norm: Literal["pre", "post"] = "pre"
    """layer norms before attention and projection, or after each is merged with its input"""
    trxl_gate: Literal["none", "gru"] = "none"
    """what merges a layer's output with its input: residual connections (TrXL) or gates (GTrXL)"""
    trxl_gate_bias: bounded(float, -100, 100) = 0.0
    """bias of the gates: above 0, a gate mostly keeps its input at first"""


LAPTOP = {
    "preset": "laptop",
    "obs_type": "vector",
    "trxl_num_layers": 1,
    "trxl_dim": 96,
    "trxl_query_position": True,
    "trxl_memory_gradient": True,
    "trunk_size": 128,
    "num_envs": 128,
    "num_steps": 128,
    "optimizer": "muon",
    "update_epochs": 2,
    "num_minibatches": 16,
    "norm_reward": True,
    "gamma": 0.99,
    "clip_coef": 0.2,
    "max_grad_norm": 0.5,
    "target_kl": 0.05,
    "init_lr": 1e-3,
    "final_lr": 1e-4,
    "exploration_bonus": "log-barrier",
    "init_ent_coef": 2e-3,
    "final_ent_coef": 2e-4,
    "anneal_steps": 6_000_000,
    "total_timesteps": 6_000_000,
}
QUICKSTART = {
    **LAPTOP,
    "preset": "quickstart",
    # Two commands, each shown for one step, and six steps to carry one out.
    "env_options": '{"command_count": [2], "command_show_duration": [1], "command_show_delay": [0], '
    '"explosion_delay": [4], "explosion_duration": [2]}',
    "num_steps": 32,
    "num_minibatches": 8,
    "anneal_steps": 400_000,
    "total_timesteps": 400_000,
}
PRESETS = {"thesis": {}, "laptop": LAPTOP, "quickstart": QUICKSTART}  # thesis: the defaults above


# ---- 2 TRAINING ----
def train(args: Args, run: Run) -> None:
    """Train until --total-timesteps, rounded down to whole iterations, or until a signal.

    Raises FloatingPointError if the training diverges, RunError as `end_iteration` does.
    """
    agent, rollout = run.agent, run.rollout
    batch_size = args.num_envs * args.num_steps  # of all processes together
    # run.step is 0, or where the checkpoint of --resume was written.
    for global_step in range(run.step, args.total_timesteps - batch_size + 1, batch_size):
        began = time.perf_counter()
        run.iteration = global_step // batch_size + 1
        lr = anneal(global_step, args.init_lr, args.final_lr, args.anneal_steps)
        ent_coef = anneal(global_step, args.init_ent_coef, args.final_ent_coef, args.anneal_steps)
        for optimizer, ratio in zip(run.optimizers, (1.0, args.muon_lr_ratio), strict=False):
            optimizer.param_groups[0]["lr"] = lr * ratio

        last_value, episodes = collect(agent, run.envs, rollout, args)
        collected = time.perf_counter()
        if args.norm_reward:
            rollout.rewards /= rollout.return_scale.update(rollout.rewards, rollout.done, args.gamma)
        rollout.advantages = gae(rollout, last_value, args.gamma, args.gae_lambda)
        rollout.returns = rollout.advantages + rollout.values
        logs = mean_logs(update(agent, run.optimizers, rollout, ent_coef, args), rollout)
        updated = time.perf_counter()

        logs |= {"charts/learning_rate": lr, "charts/entropy_coefficient": ent_coef}
        logs |= {"charts/seconds_collect": collected - began, "charts/seconds_update": updated - collected}
        logs |= {"charts/seconds_iteration": updated - began}
        run.step = global_step + batch_size
        end_iteration(args, run, logs, episodes)  # evaluation, TensorBoard, progress bar, checkpoint
        if run.stop:
            break


@dataclass
class Rollout:
    """T steps of N environments, and what the next rollout goes on with, which overwrites them."""

    obs: dict[str, Tensor]  # each (T, N, ...): uint8 pixels stay uint8
    actions: Tensor  # (T, N, A)
    log_probs: Tensor  # (T, N, A)
    values: Tensor  # (T, N)
    rewards: Tensor  # (T, N)
    terminated: Tensor  # (T, N) the step ended its episode
    truncated: Tensor  # (T, N) the step ended its episode by a time limit
    truncation_values: Tensor  # (T, N) value of the final observation, 0 where not bootstrapped
    ground_truth: Tensor | None  # (T, N, G), if it is estimated
    next_obs: dict[str, np.ndarray]  # each (N, ...)
    next_ground_truth: np.ndarray | None  # (N, G)
    memory_state: MemoryState
    initial_memory: dict[str, Tensor]  # what the rollout began with, for --refresh-memory
    return_scale: ReturnScale  # for --norm-reward
    advantages: Tensor | None = None  # (T, N)
    returns: Tensor | None = None  # (T, N)
    first_occurrence: Tensor | None = None  # (T * N,) flat index of the first equal observation; see `encode`

    @property
    def done(self) -> Tensor:
        """(T, N) the step ended its episode, in one way or the other."""
        return self.terminated | self.truncated

    @classmethod
    def allocate(cls, num_steps: int, obs: dict[str, np.ndarray], truth: np.ndarray | None, agent: Agent) -> Rollout:
        """Make a rollout on the agent's device that begins with these observations and ground truths."""
        num_envs = len(next(iter(obs.values())))
        device = next(agent.parameters()).device

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(num_steps, num_envs, *shape, dtype=dtype, device=device)

        branches = len(agent.heads.nvec)
        state = agent.memory.initial_state(num_envs, num_steps, device)
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
            memory_state=state,
            initial_memory=agent.memory.carry(state),
            return_scale=ReturnScale(torch.zeros(num_envs, device=device)),
        )


@torch.no_grad()
def collect(
    agent: Agent, envs: gym.vector.VectorEnv, rollout: Rollout, args: Args
) -> tuple[Tensor, dict[str, list[float]]]:
    """Act for T steps in all environments; return the value (N,) of the next step, and metrics of the ended episodes.

    An ended episode is reset in the same step, so that next_obs begins the next one. Metrics: see `add_ended`.
    """
    device, state = rollout.values.device, rollout.memory_state
    episodes = defaultdict(list)
    rollout.truncation_values.zero_()
    rollout.initial_memory = agent.memory.carry(state)
    with torch.autocast(device.type, torch.bfloat16, enabled=args.amp):
        agent.memory.begin_rollout(state, rollout.initial_memory)
        for t in range(args.num_steps):
            for name, part in rollout.next_obs.items():
                rollout.obs[name][t] = torch.from_numpy(part)
            if rollout.ground_truth is not None:
                rollout.ground_truth[t] = torch.as_tensor(rollout.next_ground_truth)
            obs = {name: part[t] for name, part in rollout.obs.items()}
            rollout.actions[t], rollout.log_probs[t], rollout.values[t] = agent.get_action_and_value(obs, state)

            next_obs, rewards, terminated, truncated, infos = envs.step(rollout.actions[t].cpu().numpy())
            done = terminated | truncated
            rollout.rewards[t] = torch.as_tensor(rewards)
            rollout.terminated[t], rollout.truncated[t] = torch.as_tensor(terminated), torch.as_tensor(truncated)
            if args.bootstrap_truncated and truncated.any():
                final = as_tensors(final_observations(next_obs, infos, truncated), device)
                value = agent.get_value(final, state)  # with the memory of the episode that ended
                rollout.truncation_values[t] = value.where(rollout.truncated[t] & ~rollout.terminated[t], 0.0)
            agent.memory.reset(state, torch.as_tensor(done))
            rollout.next_obs = next_obs
            rollout.next_ground_truth = ground_truth_of(infos, args, rollout.next_ground_truth)
            add_ended(episodes, infos, done)
        return agent.get_value(as_tensors(rollout.next_obs, device), state), episodes


def update(
    agent: Agent, optimizers: list[torch.optim.Optimizer], rollout: Rollout, ent_coef: float, args: Args
) -> list[dict[str, Tensor]]:
    """Learn from the rollout for some epochs; return what to log of each minibatch."""
    if args.norm_adv == "batch":
        rollout.advantages = normalize(rollout.advantages)
    rollout.first_occurrence = first_occurrences(rollout.obs)  # for speed: on a CPU, equal images are encoded once
    pieces = agent.memory.cut(rollout.done.cpu())
    step_logs = []
    for epoch in range(args.update_epochs):
        if args.refresh_memory and epoch > 0:
            refresh_memory(agent, rollout, args)
        for minibatch in pieces.minibatches(args.num_minibatches):
            loss, logs = ppo_loss(agent, rollout, minibatch, ent_coef, args)
            step_logs.append(logs)
            if args.target_kl is not None and len(step_logs) > 1:  # the first one's is 0: nothing has been learned yet
                kl = np.mean(all_gather(logs["approx_kl"].item()))  # all processes stop together
                if kl > args.target_kl:
                    return step_logs
            agent.zero_grad()
            loss.backward()
            average_gradients(agent, int(minibatch.length.sum()))  # over processes, if there are several
            logs["grad_norm"] = clip_gradients(agent, args)
            for optimizer in optimizers:
                optimizer.step()
    return step_logs


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
        policy, log_probs, values, features = agent.evaluate_actions(x, actions, minibatch, rollout.memory_state)
    log_ratio = log_probs - gather(rollout.log_probs)  # (B, A)
    advantages, old_values, returns = gather(rollout.advantages), gather(rollout.values), gather(rollout.returns)
    if args.norm_adv == "minibatch":
        advantages = normalize(advantages)
    pg_loss = policy_loss(log_ratio, advantages, args.clip_coef)
    v_loss = value_loss(values, old_values, returns, args.clip_coef if args.clip_vloss else None)
    entropy = sum(branch.entropy() for branch in policy).mean()  # the branches are independent
    barrier = log_barrier(policy)
    loss = pg_loss + args.vf_coef * v_loss - ent_coef * (entropy if args.exploration_bonus == "entropy" else barrier)
    logs = {"policy_loss": pg_loss, "value_loss": v_loss, "entropy": entropy, "log_barrier": barrier}
    if agent.decoder is not None:  # (5.5)
        with autocast:
            logits = in_chunks(agent.decoder, features.detach() if args.reconstruction_detach else features)
        pixels = gather(rollout.obs[agent.encoder.images[0]])  # (B, height, width, channels)
        target = pixels / 255 if pixels.dtype == torch.uint8 else pixels
        logs["reconstruction_loss"] = F.binary_cross_entropy_with_logits(logits.float(), target)
        loss = loss + args.reconstruction_coef * logs["reconstruction_loss"]
    if agent.estimator is not None:  # (5.6)
        estimate = agent.estimator(features.detach() if args.ground_truth_detach else features)  # (B, G)
        logs["ground_truth_loss"] = F.mse_loss(estimate, gather(rollout.ground_truth))
        loss = loss + args.ground_truth_coef * logs["ground_truth_loss"]
    logs |= {"loss": loss, **policy_metrics(log_ratio, args.clip_coef)}
    return loss, {name: value.detach() for name, value in logs.items()}


@torch.no_grad()
def refresh_memory(agent: Agent, rollout: Rollout, args: Args) -> None:
    """Recompute what the rollout stored of the memory, with the current weights (§7.1.4; Kapturowski et al., 2019).

    What it began with is not recomputed. With the weights that acted, nothing changes, up to rounding.
    """
    state, done = rollout.memory_state, rollout.done.cpu()
    with torch.autocast(rollout.values.device.type, torch.bfloat16, enabled=args.amp):
        agent.memory.begin_rollout(state, rollout.initial_memory)
        for t in range(len(done)):
            x = agent.encoder({name: part[t] for name, part in rollout.obs.items()})
            _, hidden = agent.memory.step(state, x)
            agent.memory.advance(state, hidden)
            agent.memory.reset(state, done[t])


def clip_gradients(agent: Agent, args: Args) -> Tensor:
    """Scale the gradient down to --max-grad-norm if its norm is larger; return the norm before.

    A detached network is clipped by itself, so that it does not change the agent's step.
    """
    own = {*agent.parameters()}
    for network, detached in ((agent.decoder, args.reconstruction_detach), (agent.estimator, args.ground_truth_detach)):
        if detached:
            nn.utils.clip_grad_norm_(network.parameters(), args.max_grad_norm)
            own -= {*network.parameters()}
    return nn.utils.clip_grad_norm_([each for each in agent.parameters() if each in own], args.max_grad_norm)


def mean_logs(step_logs: list[dict[str, Tensor]], rollout: Rollout) -> dict[str, float]:
    """Return the means of what an update logged; the minibatch at which --target-kl ended it has no gradient norm.

    Raises FloatingPointError if a loss or a gradient was not finite: the weights are unusable then.
    """
    logged = {name: [logs[name] for logs in step_logs if name in logs] for name in step_logs[0]}
    losses = {name: torch.stack(each).mean().item() for name, each in logged.items()}
    if not (math.isfinite(losses["loss"]) and math.isfinite(losses["grad_norm"])):
        raise FloatingPointError("the loss or its gradient is not finite; try a lower --init-lr, or smaller rewards")
    # Before the first gradient step, ratios differ from 1 by rounding only, if the update recomputes what acted.
    losses["ratio_error"] = step_logs[0]["ratio_error"].item()
    losses["explained_variance"] = explained_variance(rollout.values, rollout.returns)
    gradient_steps = len(logged["grad_norm"])
    return {f"losses/{name}": value for name, value in losses.items()} | {"charts/gradient_steps": gradient_steps}


# ---- 3 PPO ----
def anneal(step: int, initial: float, final: float, anneal_steps: int) -> float:
    """Decay linearly from initial to final over anneal_steps, then stay; without anneal_steps stay at initial."""
    fraction = min(step / anneal_steps, 1.0) if anneal_steps else 0.0
    return initial + fraction * (final - initial)


def gae(rollout: Rollout, last_value: Tensor, gamma: float, gae_lambda: float) -> Tensor:
    """Return the advantages (T, N) of generalized advantage estimation (2.34), cut wherever an episode ends.

    last_value (N,) is the value of the observation after the last step. Where an episode ended, the next value is the
    bootstrapped value of its final observation, or zero.
    """
    next_values = torch.cat([rollout.values[1:], last_value[None]])  # (T, N)
    next_values = torch.where(rollout.done, rollout.truncation_values, next_values)
    deltas = rollout.rewards + gamma * next_values - rollout.values
    decay = gamma * gae_lambda * ~rollout.done
    advantages = torch.empty_like(deltas)
    advantage = torch.zeros_like(last_value)
    for t in reversed(range(len(deltas))):
        advantages[t] = advantage = deltas[t] + decay[t] * advantage
    return advantages


@dataclass
class ReturnScale:
    """Mean and variance, over all steps, of the discounted sum of an episode's rewards (Engstrom et al., 2020).

    Rewards are divided by its deviation. No mean is subtracted, so that they keep their sign; nothing is clipped.
    """

    discounted: Tensor  # (N,) that sum in the present episodes
    count: int = 0
    mean: float = 0.0
    variance: float = 0.0

    def update(self, rewards: Tensor, done: Tensor, gamma: float) -> float:
        """Take in a rollout's rewards (T, N); return the standard deviation, 1 as long as all returns are equal."""
        returns = torch.zeros_like(rewards)
        for t in range(len(rewards)):
            returns[t] = self.discounted * gamma + rewards[t]
            self.discounted = returns[t] * ~done[t]
        ours = returns.numel(), returns.double().mean().item(), returns.double().var(correction=0).item()
        for count, mean, variance in all_gather(ours):  # merged as in Chan et al. (1979)
            self.count += count
            share, delta = count / self.count, mean - self.mean
            self.variance += share * (variance - self.variance + (1 - share) * delta**2)
            self.mean += share * delta
        return math.sqrt(self.variance) or 1.0


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
    """Return the mean squared error of values (B,), clipped around old_values (2.43) if clip_coef; not halved."""
    loss = (values - returns).square()
    if clip_coef is not None:
        clipped = old_values + (values - old_values).clamp(-clip_coef, clip_coef)
        loss = torch.maximum(loss, (clipped - returns).square())
    return loss.mean()


def log_barrier(policy: list[Categorical]) -> Tensor:
    """Return the mean log-probability over all actions of a branch and over samples, summed over branches.

    It is largest for a uniform policy. Unlike the entropy's, its gradient does not vanish near probability 0 (Agarwal
    et al., On the Theory of Policy Gradient Methods, 2021).
    """
    return sum(branch.logits.mean() for branch in policy)  # a Categorical's logits are normalized


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
        cuts = starts.T.flatten().nonzero()[:, 0]  # environment after environment: n * T + t
        length = torch.diff(cuts, append=torch.tensor([num_steps * num_envs]))
        n, t = cuts // num_steps, cuts % num_steps
        return cls(t * num_envs + n, length, num_envs)

    def columns(self) -> Tensor:
        """Return the column indices 0 .. L - 1 of a padded batch."""
        return torch.arange(int(self.length.max()))

    def is_real(self) -> Tensor:
        """Return the mask (S, L) of a padded batch: true at steps, false at padding."""
        return self.columns() < self.length[:, None]

    def flat_index(self) -> Tensor:
        """Return the flat indices (B,) of all steps, piece after piece."""
        return (self.first[:, None] + self.columns() * self.num_envs)[self.is_real()]

    def pad(self, x: Tensor) -> Tensor:
        """Pad what belongs to the steps, (B, ...), with zeros to the longest piece: (S, L, ...)."""
        return pad_sequence(x.split(self.length.tolist()), batch_first=True)

    def unpad(self, y: Tensor) -> Tensor:
        """Take the padding away: (S, L, ...) to (B, ...)."""
        index = self.is_real().flatten().nonzero()[:, 0]  # on the CPU: indexing by a mask makes a GPU synchronize
        return y.flatten(0, 1).index_select(0, index.to(y.device))

    def minibatches(self, count: int) -> Iterator[Pieces]:
        """Shuffle the pieces, and distribute them over count minibatches of about the same number of steps.

        None is empty, unless a piece is longer than 1 / count of all steps, which `prepare` has ruled out.
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
#   initial_state            the state of fresh episodes, with room for what a rollout stores
#   carry, begin_rollout     what one rollout hands to the next; begin a rollout with it
#   step, advance, reset     compute a step; store it and move on; forget the episodes that ended
#   cut, unroll              cut a rollout into pieces; compute whole pieces at once in the update
#   width, flags             D, the width of its output; the arguments that loaded weights must have been trained with
#   input_width, longest_piece    from the arguments alone: the width of an embedding, the most steps of a piece
# begin_rollout, advance and reset change a state in place; all others only read it.
@dataclass
class MemoryState:
    """What N environments remember: a timeline of the W steps before a rollout and its T steps.

    Row W + t of the timeline is step t of the rollout. While that step is computed, now = W + t, and the rows before it
    are filled. Numbers of steps stay on the CPU, since shapes depend on them.
    """

    now: int  # row of the step that comes next
    episode_step: Tensor  # (N,) which step of its episode that is
    row_step: Tensor  # (W + T, N) which step of its episode each row is
    hidden: Tensor  # (W + T, N, R, D) the inputs of the K blocks, and with --trxl-query-output the last one's output
    keys: Tensor  # (K, N, W + T, D) projections of the blocks' inputs, a cache for acting
    values: Tensor  # (K, N, W + T, D)


class Memory(nn.Module):
    """Transformer-XL as an episodic memory with a sliding window (§5.3), or GTrXL.

    A step's query in block k attends to the inputs of block k at up to W steps before it, of the same episode, never to
    its own. What no query attends to is set to zero before it is read: a mask alone would let a NaN pass (0 * NaN is
    NaN). Raises ValueError for a width that does not fit, and for flags that would change nothing.
    """

    flags = ("trxl_num_layers", "trxl_num_heads", "trxl_dim", "trxl_memory_length", "trxl_positional_encoding")
    flags += ("trxl_query_position", "trxl_query_output", "trxl_pe_length", "trxl_layer_norm", "trxl_gate")

    def __init__(self, args: Args, inputs: int):
        super().__init__()
        if args.trxl_dim % args.trxl_num_heads or args.trxl_dim % 2:
            raise ValueError(f"--trxl-dim is {args.trxl_dim}; it must be even and a multiple of --trxl-num-heads")
        if inputs != args.trxl_dim:
            raise ValueError(f"--trxl-dim is {args.trxl_dim}; with --no-embedding it must be {inputs} here")
        if args.trxl_gate_bias and args.trxl_gate == "none":
            raise ValueError("--trxl-gate-bias needs --trxl-gate gru; without, it changes nothing")
        if args.trxl_pe_length != Args.trxl_pe_length and args.trxl_positional_encoding != "learned":
            raise ValueError("--trxl-pe-length needs --trxl-positional-encoding learned; without, it changes nothing")
        self.width, self.window = args.trxl_dim, args.trxl_memory_length
        self.segment_length, self.memory_gradient = args.trxl_segment_length, args.trxl_memory_gradient
        self.encoding, self.query_position = args.trxl_positional_encoding, args.trxl_query_position
        self.cache_dtype = torch.bfloat16 if args.amp else torch.float32  # as the layers deliver keys and values
        self.blocks = nn.ModuleList(Block(args) for _ in range(args.trxl_num_layers))
        for block in self.blocks:
            block_init(block, args.trxl_init, args.trxl_num_layers)
        if self.encoding == "learned":
            self.table = nn.Parameter(torch.randn(args.trxl_pe_length + 1, self.width) / math.sqrt(self.width))
        self.query_output = nn.Linear(self.width, self.width, bias=False) if args.trxl_query_output else None
        self.stored = args.trxl_num_layers + args.trxl_query_output  # R

    @staticmethod
    def input_width(args: Args) -> int:
        """Return the width that the encoded observation is embedded in."""
        return args.trxl_dim

    @staticmethod
    def longest_piece(args: Args) -> int:
        """Return the most steps that a piece of a rollout can have."""
        return min(args.trxl_segment_length, args.num_steps)

    def initial_state(self, num_envs: int, num_steps: int, device: torch.device) -> MemoryState:
        """Return the state of fresh episodes, with no step to attend to and room for a rollout of num_steps."""
        rows, num_blocks = self.window + num_steps, len(self.blocks)
        cache_shape = (num_blocks, num_envs, rows, self.width)
        return MemoryState(
            now=self.window,
            episode_step=torch.zeros(num_envs, dtype=torch.int64),
            row_step=torch.zeros(rows, num_envs, dtype=torch.int64),
            hidden=torch.zeros(rows, num_envs, self.stored, self.width, device=device),
            keys=torch.zeros(cache_shape, dtype=self.cache_dtype, device=device),
            values=torch.zeros(cache_shape, dtype=self.cache_dtype, device=device),
        )

    def carry(self, state: MemoryState) -> dict[str, Tensor]:
        """Return what the next rollout begins with: the last W rows, and the steps of the episodes."""
        rows = slice(state.now - self.window, state.now)
        parts = {"hidden": state.hidden[rows], "row_step": state.row_step[rows], "episode_step": state.episode_step}
        return {name: part.clone() for name, part in parts.items()}

    @torch.no_grad()
    def begin_rollout(self, state: MemoryState, carry: dict[str, Tensor]) -> None:
        """Go on with what `carry` returned, and project it to keys and values with the current weights."""
        state.now, state.episode_step = self.window, carry["episode_step"]
        state.row_step[: self.window] = carry["row_step"]
        state.hidden[: self.window] = carry["hidden"]
        rows, _, mask = self.attended_rows(state)
        hidden = state.hidden[rows].transpose(0, 1).masked_fill(~mask[:, 0, :, None, None], 0.0)  # (N, M, R, D)
        position = self.position(state.row_step[rows].T.to(hidden.device), hidden.dtype)  # (N, M, D)
        for k, block in enumerate(self.blocks):
            state.keys[k, :, rows], state.values[k, :, rows] = block.keys_values(hidden[:, :, k] + position)

    def step(self, state: MemoryState, x: Tensor) -> tuple[Tensor, Tensor]:
        """Compute one step of all environments, x (N, D): the output (N, D) and what is stored of it (N, R, D)."""
        rows, age, mask = self.attended_rows(state)
        x = x[:, None]  # (N, 1, D)
        query = self.first_query(x, state.episode_step.to(x.device)[:, None], state.hidden[state.now - 1, :, -1:])
        hidden = [x]
        for k, block in enumerate(self.blocks):
            # After the first block, the query is the block's input.
            x = query = block(x, query, (state.keys[k, :, rows], state.values[k, :, rows]), age, mask)
            hidden.append(x)
        return x[:, 0], torch.cat(hidden[: self.stored], 1)

    @torch.no_grad()
    def advance(self, state: MemoryState, hidden: Tensor) -> None:
        """Store the step's hidden states (N, R, D), cache their keys and values, and move on."""
        if state.now == len(state.row_step):
            raise IndexError("there is no room for this step; begin_rollout(state, carry(state)) makes room again")
        state.hidden[state.now] = hidden
        state.row_step[state.now] = state.episode_step
        position = self.position(state.episode_step.to(hidden.device), hidden.dtype)  # (N, D)
        for k, block in enumerate(self.blocks):
            state.keys[k, :, state.now], state.values[k, :, state.now] = block.keys_values(hidden[:, k] + position)
        state.episode_step = state.episode_step + 1
        state.now += 1

    def reset(self, state: MemoryState, done: Tensor) -> None:
        """Forget the episodes that ended: done (N,), on the CPU."""
        ended = done.nonzero()[:, 0].to(state.keys.device)
        for cache in (state.keys, state.values):
            cache[:, ended, state.now - self.window : state.now] = 0.0  # (K, ended, W, D)
        state.episode_step = state.episode_step.masked_fill(done, 0)

    def cut(self, done: Tensor) -> Pieces:
        """Cut a rollout, done (T, N), into segments. They may span episodes, which `attention_mask` keeps apart."""
        starts = torch.arange(len(done)) % self.segment_length == 0
        return Pieces.from_starts(starts[:, None].expand_as(done))

    def unroll(self, state: MemoryState, x: Tensor, pieces: Pieces) -> Tensor:
        """Compute whole segments at once, x (B, D) to (B, D), each from the stored hidden states before and in it.

        All queries of a segment share its keys: those of its own steps but the last, and of the steps before it. A band
        mask tells which of them a query attends to. A window of three, and a second segment of four steps, rows W + 4 =
        7 to 10 of the timeline, in which an episode ends after the second step (1: attended to):

            row                           4  5  6   7  8  9
            key column                   -3 -2 -1   0  1  2
            query column 0, step 5        1  1  1   .  .  .
            query column 1, step 6        .  1  1   1  .  .
            query column 2, step 0        .  .  .   .  .  .     an episode's first step attends to nothing
            query column 3, step 1        .  .  .   .  .  1

        With --trxl-memory-gradient, keys of the segment's own steps are computed from the block inputs of this pass,
        with gradient (Dai et al., 2019): the same numbers, as long as the weights are those that acted.
        """
        device, last_row = x.device, len(state.row_step) - 1  # a short segment's padding lies beyond that row
        x = pieces.pad(x)  # (S, L, D)
        first = pieces.first[:, None]  # (S, 1)
        row, env = self.window + first // pieces.num_envs, first % pieces.num_envs  # (S, 1) each, of the first steps
        columns = pieces.columns()  # (L,)
        query_rows = (row + columns).clamp(max=last_row)  # (S, L)
        query_step = state.row_step[query_rows, env].where(pieces.is_real(), 0)  # (S, L); padding attends to nothing
        # Later columns need no more: c steps further into the same episode, column c attends as far back as column 0.
        length = min(max(int(query_step[:, 0].max()), 1), self.window)
        key_columns = torch.arange(-length, len(columns) - 1)  # (M,)
        key_rows = (row + key_columns).clamp(max=last_row)  # (S, M)
        key_step = state.row_step[key_rows, env].to(device)  # (S, M)
        hidden = state.hidden[key_rows.to(device), env.to(device)]  # (S, M, R, D)
        age, query_step = (columns[:, None] - key_columns).to(device), query_step.to(device)  # (L, M), (S, L)
        mask = attention_mask(age, query_step[..., None], self.window)  # (S, L, M)
        attended = mask.any(1)[..., None]  # (S, M, 1)
        hidden = hidden.masked_fill(~attended[..., None], 0.0)
        position = self.position(key_step, x.dtype)  # (S, M, D)
        query = self.first_query(x, query_step, hidden[:, length - 1 :, -1])  # column c gets the output of column c - 1
        for k, block in enumerate(self.blocks):
            inputs = hidden[:, :, k]  # (S, M, D)
            if self.memory_gradient:
                own = x[:, :-1].masked_fill(~attended[:, length:], 0.0)
                inputs = torch.cat([inputs[:, :length], own], 1)
            x = query = block(x, query, block.keys_values(inputs + position), age, mask)
        return pieces.unpad(x)

    def attended_rows(self, state: MemoryState) -> tuple[slice, Tensor, Tensor]:
        """Return the M rows that the next step may attend to, their ages (1, M), and the mask (N, 1, M)."""
        length = min(max(int(state.episode_step.max()), 1), self.window)  # at least 1, since attention needs a key
        age = torch.arange(length, 0, -1)[None]
        mask = attention_mask(age, state.episode_step[:, None], self.window)[:, None]
        return slice(state.now - length, state.now), age.to(state.hidden.device), mask.to(state.hidden.device)

    def encode_step(self, episode_step: Tensor, dtype: torch.dtype) -> Tensor:
        """Encode steps of episodes (...) by the learned table, or as sines and cosines: (..., D)."""
        if self.encoding == "learned":  # steps beyond the table share its last entry
            return self.table[episode_step.clamp(max=len(self.table) - 1)]
        return sinusoid(episode_step, self.width).to(dtype)

    def position(self, episode_step: Tensor, dtype: torch.dtype) -> Tensor | float:
        """Return what is added to hidden states of these steps (...): their encoding (..., D), or 0."""
        return self.encode_step(episode_step, dtype) if self.encoding in ("absolute", "learned") else 0.0

    def first_query(self, x: Tensor, episode_step: Tensor, previous_output: Tensor) -> Tensor:
        """Return x (S, L, D) plus, by flag, its step's encoding and previous_output (S, L, D), projected (§7.1.3)."""
        query = x + self.encode_step(episode_step, x.dtype) if self.query_position else x
        if self.query_output is not None:
            query = query + self.query_output(previous_output.masked_fill(episode_step[..., None] == 0, 0.0))
        return query


def attention_mask(age: Tensor, episode_step: Tensor, window: int) -> Tensor:
    """Return whether a query at this step of its episode attends to a key `age` steps older: one rule, everywhere."""
    return (age >= 1) & (age <= episode_step) & (age <= window)


def sinusoid(index: Tensor, width: int) -> Tensor:
    """Encode steps or ages of any shape as sines and cosines (2.57, 2.58): (..., width) float64."""
    frequency = 10000 ** (-torch.arange(0, width, 2, dtype=torch.float64, device=index.device) / width)
    angle = index[..., None] * frequency
    return torch.stack([angle.sin(), angle.cos()], -1).flatten(-2)  # (..., width / 2, 2) to (..., width)


class Block(nn.Module):
    """A transformer block (figure 5.5): attention to the memory, then a projection, each merged with its input.

    Layer norms come before both (figure 2.11b) or after both (2.11a). Parisotto et al. have a ReLU after attention too.
    """

    def __init__(self, args: Args):
        super().__init__()
        width = args.trxl_dim
        before, after = (nn.LayerNorm, nn.Identity) if args.trxl_layer_norm == "pre" else (nn.Identity, nn.LayerNorm)
        self.norm_query, self.norm_memory, self.norm_projection = before(width), before(width), before(width)
        self.after_attention, self.after_projection = after(width), after(width)
        self.attention = Attention(width, args.trxl_num_heads, args.trxl_positional_encoding == "relative")
        self.projection = nn.Linear(width, width)
        gated = args.trxl_gate == "gru"  # else, residual connections
        self.merge_attention = Gate(width, args.trxl_gate_bias) if gated else torch.add
        self.merge_projection = Gate(width, args.trxl_gate_bias) if gated else torch.add

    def keys_values(self, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Project hidden states (..., D), to which their positions are added already, to keys and values."""
        hidden = self.norm_memory(hidden)
        return self.attention.key(hidden), self.attention.value(hidden)

    def forward(self, x: Tensor, query: Tensor, keys_values: tuple, age: Tensor, mask: Tensor) -> Tensor:
        """Map x (S, L, D) to the next block's input; query (S, L, D) is x, but in the first block `first_query`."""
        x = self.merge_attention(x, self.attention(self.norm_query(query), *keys_values, age, mask))
        x = self.after_attention(x)
        x = self.merge_projection(x, F.relu(self.projection(self.norm_projection(x))))
        return self.after_projection(x)


class Attention(nn.Module):
    """Multi-head attention (2.55, 2.56) to keys and values that `Block.keys_values` made, so that they can be cached.

    With relative encoding the scores are those of (2.61), as the thesis has it: unlike in Dai et al. (2019), the matrix
    of the keys projects positions too, and that of the queries u and v.
    """

    def __init__(self, width: int, num_heads: int, relative: bool):
        super().__init__()
        self.num_heads, self.relative = num_heads, relative
        self.query = nn.Linear(width, width, bias=False)
        self.key = nn.Linear(width, width, bias=False)
        self.value = nn.Linear(width, width, bias=False)
        self.output = nn.Linear(width, width)
        if relative:
            self.content_bias = nn.Parameter(torch.zeros(width))  # u
            self.position_bias = nn.Parameter(torch.zeros(width))  # v

    def forward(self, x: Tensor, keys: Tensor, values: Tensor, age: Tensor, mask: Tensor) -> Tensor:
        """Attend from x (S, L, D) to keys and values (S, M, D): exactly zero for a query with nothing to attend to.

        age (L, M): how many steps older than its query a key is. mask (S, L, M): which keys a query attends to.
        """
        query, bias, empty = self.query_and_bias(x, age, mask)
        y = F.scaled_dot_product_attention(query, self.split(keys), self.split(values), bias)  # (S, H, L, D / H)
        return self.output(y.transpose(1, 2).flatten(2)).masked_fill(empty, 0.0)

    def query_and_bias(self, x: Tensor, age: Tensor, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return queries (S, H, L, D / H), a mask (S, 1 or H, L, M), and which of them have no key (S, L, 1).

        The mask is boolean, or with relative positions added to the scores.
        """
        empty = ~mask.any(-1, keepdim=True)
        mask = (mask | empty)[:, None]  # (S, 1, L, M); a plain softmax over no key is NaN
        if not self.relative:
            return self.split(self.query(x)), mask, empty
        content_query = self.split(self.query(x + self.content_bias))
        position_query = self.split(self.query(x + self.position_bias))
        # Score each possible age once, from 1 to M, and look up that of each key: an age of 2 is in column 1.
        ages = torch.arange(1, age.shape[1] + 1, device=x.device)
        encoded = self.split(self.key(sinusoid(ages, x.shape[-1]).to(x.dtype))[None])  # (1, H, M, D / H)
        scores = position_query @ encoded.transpose(2, 3) / math.sqrt(encoded.shape[-1])  # (S, H, L, M)
        column = (age.clamp(min=1) - 1).expand_as(scores)
        return content_query, scores.gather(-1, column).masked_fill(~mask, -math.inf), empty

    def split(self, x: Tensor) -> Tensor:
        """Split the width of (S, any length, D) between the heads: (S, H, the same length, D / H)."""
        return x.unflatten(-1, (self.num_heads, -1)).transpose(1, 2)


class Gate(nn.Module):
    """A gated recurrent unit in place of a residual connection: GTrXL (Parisotto et al., 2020).

    The stream x is its hidden state, and the output y of a layer its input; §2.4.7 has them the other way round, where
    a bias would keep y. A bias above 0 mostly keeps x at first.
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


def block_init(block: Block, scheme: str, num_blocks: int) -> None:
    """Initialize the weights of a block's layers by the scheme (table 6.1), and their biases with zero.

    T-Fixup (Huang et al., 2020) is Xavier with values, outputs and projections scaled by 0.67 / num_blocks^(1/4).
    """
    init = {"orthogonal": nn.init.orthogonal_, "kaiming": nn.init.kaiming_normal_}.get(scheme, nn.init.xavier_uniform_)
    for layer in block.modules():
        if isinstance(layer, nn.Linear):
            for matrix in layer.weight.detach().split(layer.in_features):  # a gate's layer stacks square matrices
                init(matrix)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    if scheme == "tfixup":
        for layer in (block.attention.value, block.attention.output, block.projection):
            layer.weight.detach().mul_(0.67 * num_blocks**-0.25)


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
        self.policy = mlp_head(size, sum(nvec), 0.1)
        self.value = mlp_head(size, 1, value_gain)

    def forward(self, x: Tensor) -> tuple[list[Categorical], Tensor, Tensor]:
        """Map the memory's output (B, D) to each branch's distribution, values (B,) and features (B, F)."""
        with torch.autocast(x.device.type, enabled=False):  # --amp: bfloat16 is too coarse for values and log-ratios
            features = F.relu(self.trunk(x.float()))
            logits = self.policy(features).split(self.nvec, -1)  # A parts
            policy = [Categorical(logits=part, validate_args=False) for part in logits]
            return policy, self.value(features)[:, 0], features


def mlp_head(size: int, outputs: int, gain: float) -> nn.Sequential:
    """Make a head of two layers; gain initializes the last one."""
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
    """Encoder, memory and heads: acts step by step, and recomputes pieces of a rollout with gradient.

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
        with torch.random.fork_rng(devices=[]):  # they do not change the random numbers that are drawn later
            self.decoder = Decoder(args.trunk_size, images[0]) if args.reconstruction_coef else None
            self.estimator = mlp_head(args.trunk_size, ground_truth_size, 1.0) if args.ground_truth_coef else None

    def get_action_and_value(self, obs: dict[str, Tensor], state: MemoryState) -> tuple[Tensor, Tensor, Tensor]:
        """Act in all environments, and move the memory's state on to the next step.

        Returns actions (N, A), their log-probabilities (N, A) and values (N,).
        """
        x, hidden = self.memory.step(state, self.encoder(obs))
        self.memory.advance(state, hidden)
        policy, values, _ = self.heads(x)
        actions = torch.stack([branch.sample() for branch in policy], -1)
        return actions, log_probs_of(policy, actions), values

    def get_value(self, obs: dict[str, Tensor], state: MemoryState) -> Tensor:
        """Return the values (N,) of observations that are not acted on; the memory's state stays as it is."""
        x, _ = self.memory.step(state, self.encoder(obs))
        return self.heads(x)[1]

    def evaluate_actions(
        self, x: Tensor, actions: Tensor, pieces: Pieces, state: MemoryState
    ) -> tuple[list[Categorical], Tensor, Tensor, Tensor]:
        """Recompute, with gradient, what `get_action_and_value` computed at the steps of the pieces.

        x: the steps' encoded observations (B, I). Returns the policy, a distribution of B actions for each branch, the
        log-probabilities (B, A) of the actions (B, A), values (B,) and features (B, F).
        """
        policy, values, features = self.heads(self.memory.unroll(state, x, pieces))
        return policy, log_probs_of(policy, actions), values, features


def make_optimizers(agent: Agent, args: Args) -> list[torch.optim.Optimizer]:
    """Return AdamW, and with --optimizer muon also Muon (Jordan et al., 2024) for the matrices between hidden layers.

    Its steps are orthogonal: all directions of a matrix change equally. Outer layers, whose other side is an
    observation or an output, are AdamW's, as is all that is no weight of an `nn.Linear`, such as recurrent layers.
    """
    if args.optimizer == "adamw":
        return [torch.optim.AdamW(agent.parameters(), lr=args.init_lr, fused=True)]
    outer = ("encoder.mlp", "heads.policy.2", "heads.value.2", "decoder", "estimator")
    linear = {name: layer.weight for name, layer in agent.named_modules() if isinstance(layer, nn.Linear)}
    hidden = [weight for name, weight in linear.items() if not name.startswith(outer)]
    others = [weight for weight in agent.parameters() if weight not in {*hidden}]
    muon = torch.optim.Muon(hidden, weight_decay=0.01, adjust_lr_fn="match_rms_adamw")
    return [torch.optim.AdamW(others, lr=args.init_lr, fused=True), muon]


def log_probs_of(policy: list[Categorical], actions: Tensor) -> Tensor:
    """Return the log-probability (B, A) of the chosen action (B, A) of every branch."""
    return torch.stack([branch.log_prob(action) for branch, action in zip(policy, actions.unbind(-1), strict=True)], -1)


# ---- 6 MAIN ----
def setup(args: Args) -> Run:
    """Check the arguments and make all that a training needs; bad input raises before any file is written.

    Raises ValueError, OSError, ImportError, RunError or gymnasium.error.Error, each with one line for the user.
    """
    script = Path(__file__).stem
    device, checkpoint = prepare(args, script, Memory.longest_piece(args))  # checkpoint: None without --resume
    with report_out_of_memory(args, device):
        envs = training_envs(args, checkpoint)
    with report_out_of_memory(args, device, envs.single_observation_space):
        obs, infos = envs.reset()
        agent = make_agent(Agent, envs, infos, args).to(device)
        rollout = Rollout.allocate(args.num_steps, obs, ground_truth_of(infos, args), agent)
    run = Run(script=script, envs=envs, agent=agent, optimizers=make_optimizers(agent, args), rollout=rollout)
    return open_run(args, run, checkpoint)  # sets all of it to the checkpoint's state, if there is one


def main(args: Args) -> Path:
    """Train an agent from Python; return the run folder. Raises what `setup` and `run_to_end` raise."""
    return run_to_end(args, setup(args), train)


if __name__ == "__main__":
    command(Args, PRESETS, setup, train)
