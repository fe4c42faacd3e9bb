"""Adapters of `memory_check`: for the agents of this project's scripts, sb3-contrib, CleanRL and TorchRL."""

from __future__ import annotations

import copy
import io
from types import ModuleType
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from ppo_utils.memory_check import Adapter

ENTRIES = 6  # of an observed vector


class ScriptAdapter(Adapter):
    """The agent of `ppo_gru.py`, `ppo_trxl.py` or a copy of either, which observes a vector.

    script: the module. args: its `Args`. The heads' weights are tripled: they hardly depend on anything at first.
    """

    obs_shape = (ENTRIES,)

    def __init__(self, script: ModuleType, args: Any):
        self.script, self.args, self.nvec = script, args, [3, 2]
        self.space = gym.spaces.Dict({"observation": gym.spaces.Box(-float("inf"), float("inf"), self.obs_shape)})
        self.agent = script.Agent(self.space, self.nvec, args)
        with torch.no_grad():
            for parameter in self.agent.heads.parameters():
                parameter.mul_(3.0)

    def initial(self, lanes: int) -> dict[str, Tensor]:
        """Return what `Memory.initial` does."""
        return self.agent.memory.initial(lanes, torch.device("cpu"))

    def act(self, obs: Tensor, state: dict[str, Tensor], begins: Tensor) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Take a step in a rollout of its own."""
        outputs, values, state, _ = self.rollout(obs[None], begins[None], state)
        return outputs[0], values[0], state

    def rollout(self, obs: Tensor, begins: Tensor, state: dict[str, Tensor]) -> tuple[Tensor, Tensor, Any, Any]:
        """Act as `collect` does; the update needs the memory's state at the end."""
        memory, outputs, values = self.agent.memory, [], []
        rollout = memory.begin_rollout(state, len(obs))
        for now, begin in zip(obs, begins, strict=True):
            memory.reset(rollout, begin)
            x, hidden = memory.step(rollout, self.agent.encoder({"observation": now}))
            memory.advance(rollout, hidden)
            output, value = self.heads(x)
            outputs.append(output)
            values.append(value)
        return torch.stack(outputs), torch.stack(values), memory.carry(rollout), rollout

    def evaluate(self, obs: Tensor, begins: Tensor, stored: Any) -> tuple[Tensor, Tensor]:
        """Compute all pieces of the rollout as a minibatch."""
        done = torch.cat([begins[1:], torch.zeros_like(begins[:1])])
        pieces = self.agent.memory.cut(done)
        index = pieces.flat_index()
        x = self.agent.encoder({"observation": obs.flatten(0, 1)[index]})
        outputs, values = self.heads(self.agent.memory.unroll(stored, x, pieces))
        back = index.argsort()
        return outputs[back].unflatten(0, begins.shape), values[back].unflatten(0, begins.shape)

    def value(self, obs: Tensor, state: dict[str, Tensor]) -> Tensor:
        """Return what `Agent.get_value` does."""
        return self.agent.get_value({"observation": obs}, self.agent.memory.begin_rollout(state, 1))

    def reloaded(self) -> ScriptAdapter:
        """Load the weights into a new agent."""
        other = type(self)(self.script, self.args)
        other.agent.load_state_dict(saved(self.agent))
        return other

    def heads(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits (B, P) and values (B,)."""
        policy, values, _ = self.agent.heads(x, {})
        return torch.cat([branch.logits for branch in policy], -1), values


class SB3Adapter(Adapter):
    """A recurrent policy of sb3-contrib that observes a vector and takes one discrete action, as `RecurrentPPO.policy`.

    The update's batch is that of its `RecurrentRolloutBuffer`: lane after lane, each with the state of its first step.
    """

    def __init__(self, policy: Any):
        self.policy, self.obs_shape = policy.set_training_mode(False) or policy, policy.observation_space.shape

    def initial(self, lanes: int) -> Any:
        """Return zeros for actor and critic: hidden and cell states (layers, N, D)."""
        lstm = self.policy.lstm_actor
        zeros = torch.zeros(lstm.num_layers, lanes, lstm.hidden_size)
        return [[zeros, zeros], [zeros, zeros]]

    def act(self, obs: Tensor, state: Any, begins: Tensor) -> tuple[Tensor, Tensor, Any]:
        """Take a step as `forward` does."""
        return self.run(obs, begins, state)

    def evaluate(self, obs: Tensor, begins: Tensor, stored: Any) -> tuple[Tensor, Tensor]:
        """Compute whole lanes."""
        flat_obs, flat_begins = obs.transpose(0, 1).flatten(0, 1), begins.T.flatten()
        outputs, values, _ = self.run(flat_obs, flat_begins, stored[0])
        lanes = begins.shape[::-1]
        return outputs.unflatten(0, lanes).transpose(0, 1), values.unflatten(0, lanes).T

    def value(self, obs: Tensor, state: Any) -> Tensor:
        """Return what `predict_values` does."""
        return self.policy.predict_values(obs, tuple(state[1]), torch.zeros(len(obs)))[:, 0]

    def reloaded(self) -> SB3Adapter:
        """Load the weights into a copy with others."""
        other = copy.deepcopy(self.policy)
        with torch.no_grad():
            for parameter in other.parameters():
                parameter.zero_()
        other.load_state_dict(saved(self.policy))
        return type(self)(other)

    def run(self, obs: Tensor, begins: Tensor, state: Any) -> tuple[Tensor, Tensor, Any]:
        """Run actor and critic over steps (B, ...), which are of as many lanes as the state has."""
        policy, (actor, critic) = self.policy, state
        features = policy.extract_features(obs)
        pi, vf = features if isinstance(features, tuple) else (features, features)
        starts = begins.float()
        latent, actor = policy._process_sequence(pi, tuple(actor), starts, policy.lstm_actor)
        if policy.lstm_critic is not None:
            latent_vf, critic = policy._process_sequence(vf, tuple(critic), starts, policy.lstm_critic)
        elif policy.shared_lstm:
            latent_vf, critic = latent.detach(), actor
        else:
            latent_vf = policy.critic(vf)
        logits = policy.action_net(policy.mlp_extractor.forward_actor(latent))
        values = policy.value_net(policy.mlp_extractor.forward_critic(latent_vf))[:, 0]
        return logits, values, [list(actor), list(critic)]


class CleanRLAdapter(Adapter):
    """The `Agent` of CleanRL's `ppo_atari_lstm.py`, or of a script like it: `get_states`, `actor` and `critic`."""

    def __init__(self, agent: torch.nn.Module, obs_shape: tuple[int, ...]):
        self.agent, self.obs_shape = agent, obs_shape

    def initial(self, lanes: int) -> list[Tensor]:
        """Return zeros, hidden and cell state (layers, N, D)."""
        lstm = self.agent.lstm
        return [torch.zeros(lstm.num_layers, lanes, lstm.hidden_size) for _ in range(2)]

    def act(self, obs: Tensor, state: list[Tensor], begins: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Take a step as `get_action_and_value` does."""
        hidden, state = self.agent.get_states(obs, tuple(state), begins.float())
        return self.agent.actor(hidden), self.agent.critic(hidden)[:, 0], list(state)

    def evaluate(self, obs: Tensor, begins: Tensor, stored: Any) -> tuple[Tensor, Tensor]:
        """Compute all lanes as one minibatch, step after step."""
        outputs, values, _ = self.act(obs.flatten(0, 1), stored[0], begins.flatten())
        return outputs.unflatten(0, begins.shape), values.unflatten(0, begins.shape)

    def value(self, obs: Tensor, state: list[Tensor]) -> Tensor:
        """Return what `get_value` does in the middle of episodes."""
        return self.agent.get_value(obs, tuple(state), torch.zeros(len(obs)))[:, 0]


class CleanRLTrXLAdapter(Adapter):
    """The `Agent` of CleanRL's `ppo_trxl.py`, with the memories, windows and masks that its main program gives to it.

    length: `--trxl-memory-length`. The agent's longest episode must have more than 48 steps.
    """

    def __init__(self, agent: torch.nn.Module, length: int):
        self.agent, self.length, self.obs_shape = agent, length, tuple(agent.obs_shape)
        if agent.max_episode_steps <= 48:
            raise ValueError(f"max_episode_steps is {agent.max_episode_steps}; make the agent with more than 48")

    def initial(self, lanes: int) -> dict[str, Tensor]:
        """Return empty memories (N, steps, layers, D) and steps (N,) of episodes."""
        transformer = self.agent.transformer
        layers, dim = len(transformer.transformer_layers), self.agent.critic.in_features
        memory = torch.zeros(lanes, self.agent.max_episode_steps, layers, dim)
        return {"memory": memory, "step": torch.zeros(lanes, dtype=torch.int64)}

    def act(self, obs: Tensor, state: dict[str, Tensor], begins: Tensor) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Take a step, and write what the blocks were given into the memory."""
        memory, step = state["memory"].clone(), torch.where(begins, 0, state["step"])
        memory[begins] = 0.0
        outputs, values, given = self.run(obs, memory, step)
        memory[torch.arange(len(obs)), step] = given
        return outputs, values, {"memory": memory, "step": step + 1}

    def rollout(self, obs: Tensor, begins: Tensor, state: dict[str, Tensor]) -> tuple[Tensor, Tensor, Any, Any]:
        """Act; the update needs the memory after each step, and each step's place in its episode."""
        outputs, values, after = [], [], []
        for now, begin in zip(obs, begins, strict=True):
            output, value, state = self.act(now, state, begin)
            outputs.append(output)
            values.append(value)
            after.append(state)
        stored = {name: torch.stack([each[name] for each in after]) for name in state}
        return torch.stack(outputs), torch.stack(values), state, stored

    def evaluate(self, obs: Tensor, begins: Tensor, stored: Any) -> tuple[Tensor, Tensor]:
        """Compute all steps as a minibatch, each with its window of its episode's memory as it was at the end."""
        steps, lanes = begins.shape
        last = torch.full_like(stored["step"], steps - 1)  # step of each one's episode in this rollout
        for t in reversed(range(steps - 1)):
            last[t] = torch.where(begins[t + 1], t, last[t + 1])
        memories = stored["memory"][last, torch.arange(lanes)].flatten(0, 1)
        outputs, values, _ = self.run(obs.flatten(0, 1), memories, stored["step"].flatten() - 1)
        return outputs.unflatten(0, begins.shape), values.unflatten(0, begins.shape)

    def value(self, obs: Tensor, state: dict[str, Tensor]) -> Tensor:
        """Return what the main program bootstraps from."""
        first = (state["step"] - self.length).clamp(min=0)
        window = first[:, None] + torch.arange(self.length)
        mask, positions = self.mask(state["step"]), self.window(state["step"] - 1)
        return self.agent.get_value(obs, self.select(state["memory"], window), mask, positions)

    def run(self, obs: Tensor, memory: Tensor, step: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Compute steps (B,) of episodes with these memories: logits, values and what the blocks were given."""
        window = self.window(step)
        *_, values, given = self.agent.get_action_and_value(obs, self.select(memory, window), self.mask(step), window)
        return torch.cat([branch(self.agent.x) for branch in self.agent.actor_branches], -1), values, given

    def window(self, step: Tensor) -> Tensor:
        """(B, length) the steps of the episode that a window shows."""
        return (step - self.length + 1).clamp(min=0)[:, None] + torch.arange(self.length)

    def mask(self, step: Tensor) -> Tensor:
        """(B, length) which of them are over."""
        return torch.arange(self.length) < step.clamp(max=self.length - 1)[:, None]

    def select(self, memory: Tensor, window: Tensor) -> Tensor:
        """(B, length, layers, D) the memory's entries in a window."""
        return memory[torch.arange(len(memory))[:, None], window]


class TorchRLAdapter(Adapter):
    """TorchRL's `LSTMModule` or `GRUModule` that reads `obs`, its states and `is_init`, and writes `y`; a head follows.

    primed: where an episode begins, the data have zeros as states, as `TensorDictPrimer` writes them.
    """

    def __init__(self, module: Any, primed: bool = True):
        self.module, self.primed, self.states = module, primed, module.in_keys[1:-1]
        self.network = next(each for each in module.modules() if isinstance(each, torch.nn.RNNBase))
        self.obs_shape, self.head = (self.network.input_size,), torch.nn.Linear(self.network.hidden_size, 4)

    def initial(self, lanes: int) -> list[Tensor]:
        """Return zeros (N, layers, D) for each state."""
        return [torch.zeros(lanes, self.network.num_layers, self.network.hidden_size) for _ in self.states]

    def act(self, obs: Tensor, state: list[Tensor], begins: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Take a step."""
        data = self.run({"obs": obs, "is_init": begins[:, None], **dict(zip(self.states, state, strict=True))}, 1)
        return *self.heads(data["y"]), [data["next", name] for name in self.states]

    def evaluate(self, obs: Tensor, begins: Tensor, stored: Any) -> tuple[Tensor, Tensor]:
        """Compute all lanes, (N, T, ...), in the recurrent mode."""
        from torchrl.modules import set_recurrent_mode

        states = [torch.stack(each, 1) for each in zip(*stored, strict=True)]  # each (N, T, layers, D)
        if self.primed:
            states = [each.masked_fill(begins.T[..., None, None], 0.0) for each in states]
        data = {"obs": obs.transpose(0, 1), "is_init": begins.T[..., None]}
        with set_recurrent_mode(True):
            y = self.run(data | dict(zip(self.states, states, strict=True)), 2)["y"]
        outputs, values = self.heads(y)
        return outputs.transpose(0, 1), values.T

    def run(self, data: dict[str, Tensor], batch_dims: int) -> Any:
        """Run the module on a TensorDict of these."""
        from tensordict import TensorDict

        return self.module(TensorDict(data, data["obs"].shape[:batch_dims]))

    def heads(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return three outputs and a value."""
        outputs = self.head(y)
        return outputs[..., :3], outputs[..., 3]


def saved(module: torch.nn.Module) -> dict[str, Tensor]:
    """Return the module's weights after they were written to a file and read."""
    file = io.BytesIO()
    torch.save(module.state_dict(), file)
    file.seek(0)
    return torch.load(file, weights_only=True)
