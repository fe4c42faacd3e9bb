"""Export one step of a trained agent as a program without Python (torch.export).

    python examples/export_step.py agents/mystery-path-grid-trxl.pt --out step.pt2

It maps the parts of an observation and the memory's state to logits, a tensor for each action branch, the state value
and the next state. `beginning` says what the state is when an episode begins:

    step = torch.export.load("step.pt2").module()
    logits, value, *state = step(obs, *state)

Shape letters: P vectors of a recurrent memory's state, W steps of the window, K blocks, D the width.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import torch
import tyro
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the scripts of this repository

import ppo_gru
import ppo_trxl
from ppo_utils.acting import Player
from ppo_utils.errors import RunError
from ppo_utils.terminal import one_line_exit, open_streams


@dataclass
class Config:
    """Export one step of a trained agent."""

    checkpoint: tyro.conf.Positional[str]
    """model.pt, a checkpoint or a file in agents/"""
    out: str = "step.pt2"
    """the file to write"""


class RecurrentStep(nn.Module):
    """A step of an agent of ppo_gru.py."""

    def __init__(self, agent: nn.Module):
        super().__init__()
        self.agent = agent

    def forward(self, obs: dict[str, Tensor], hidden: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
        """Map parts (1, ...) and the hidden state (1, P, D)."""
        state = ppo_gru.MemoryState(now=0, hidden=hidden, stored=hidden[None])
        y, hidden = self.agent.memory.step(state, self.agent.encoder(obs))
        policy, value, _ = self.agent.heads(y, obs)
        return [branch.logits for branch in policy], value, hidden

    def beginning(self) -> tuple[Tensor, ...]:
        """Return the state that an episode begins with."""
        return (self.agent.memory.initial(1, torch.device("cpu"))["hidden"],)


class TransformerStep(nn.Module):
    """A step of an agent of ppo_trxl.py."""

    def __init__(self, agent: nn.Module):
        super().__init__()
        self.agent, self.memory, self.window = agent, agent.memory, agent.memory.window

    def forward(
        self, obs: dict[str, Tensor], hidden: Tensor, episode_step: Tensor
    ) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
        """Map parts (1, ...), the window of hidden states (1, W, K, D), oldest first, and the episode's step (1,)."""
        x = self.agent.encoder(obs)[:, None]  # (1, 1, D)
        age = torch.arange(self.window, 0, -1)[None]  # (1, W)
        mask = ppo_trxl.attention_mask(age, episode_step[:, None], self.window)[:, None]  # (1, 1, W)
        memory_position = self.encode((episode_step[:, None] - age).clamp(min=0))  # (1, W, D)
        if self.memory.encoding in ("relative", "none"):
            memory_position = 0.0
        inputs = []
        for k, block in enumerate(self.memory.blocks):
            inputs.append(x)
            keys_values = block.keys_values(hidden[:, :, k] + memory_position)
            x = block(x, self.encode(episode_step[:, None]), *keys_values, age, mask)
        policy, value, _ = self.agent.heads(x[:, 0], obs)
        hidden = torch.cat([hidden[:, 1:], torch.stack(inputs, 2)], 1)
        return [branch.logits for branch in policy], value, hidden, episode_step + 1

    def encode(self, step: Tensor) -> Tensor:
        """Encode steps of the episode as `Memory.encode_step` does, without reading their values."""
        if self.memory.encoding == "learned":
            return self.memory.table[step.clamp(max=len(self.memory.table) - 1)]
        return ppo_trxl.sinusoid(step, self.memory.width).float()

    def beginning(self) -> tuple[Tensor, ...]:
        """Return the state that an episode begins with."""
        hidden = torch.zeros(1, self.window, len(self.memory.blocks), self.memory.width)
        return hidden, torch.zeros(1, dtype=torch.int64)


STEPS = {ppo_gru.Agent: RecurrentStep, ppo_trxl.Agent: TransformerStep}


def main(config: Config) -> None:
    """Write the program; raise ValueError for an agent of another script, and what `Player` raises."""
    out = Path(config.out)
    if out.is_dir() or not out.parent.is_dir():
        raise ValueError(f"--out is {config.out}; give a file in a folder that is there")
    player = Player(config.checkpoint)
    kind = STEPS.get(type(player.agent))
    if kind is None:
        raise ValueError("only agents of ppo_gru.py and ppo_trxl.py can be exported; write a step like theirs here")
    step = kind(player.agent).eval()
    obs = {name: torch.from_numpy(part) for name, part in player.envs.observation_space.sample().items()}
    state = step.beginning()
    torch.export.save(torch.export.export(step, (obs, *state)), config.out)
    parts = ", ".join(f"{name} {tuple(part.shape)}" for name, part in obs.items())
    zeros = ", ".join(f"{tuple(part.shape)} of {part.dtype}" for part in state)
    print(f"wrote {config.out}: from the parts {parts} and a state, at first zeros: {zeros}")


if __name__ == "__main__":
    open_streams()
    with one_line_exit(ValueError, OSError, ImportError, gym.error.Error, RunError):
        main(tyro.cli(Config))
