"""What do trained transformers attend to? How much goes to the due command's clue, and to falls (thesis 6.5).

    python benchmarks/attention.py agents/mortar-mayhem-grid-trxl.pt agents/mystery-path-grid-trxl.pt

In Mortar Mayhem, a command is carried out long after it was shown; in Mystery Path, the agent has to remember where it
fell off. Agents play test levels, and a step is counted if it can attend to what is looked for. The table has the mean
share of this among the steps that it attends to, which is what uniform attention would give, and the mean share of the
attention, of each head (blocks are separated by semicolons).

Shape letters: N environments, one for each test level, H heads, M earlier steps that a step attends to.
"""

import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.vector import VectorEnv, VectorWrapper
from torch import nn

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the packages of this repository

from enjoy import attention_weights
from learning import FIRST_TEST_LEVEL
from ppo_utils.checkpoints import Checkpoint
from ppo_utils.environments import envs_for
from ppo_utils.errors import RunError
from ppo_utils.evaluation import evaluate
from ppo_utils.flags import PositiveInt, check_bounds
from ppo_utils.terminal import one_line_exit

SHOWS_NONE, WANTS_NONE = -1, -2
HEADING = """| agent | looked for | if spread evenly | attention of each head |
|---|---|---:|---:|"""


@dataclass
class Config:
    """Let transformers play Mortar Mayhem or Mystery Path."""

    checkpoints: Annotated[tuple[str, ...], tyro.conf.Positional]
    """files that --save-model wrote"""
    levels: PositiveInt = 100
    """test levels to play, each once"""


def commands(s: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return which command of the sequence Mortar Mayhem shows, and which is to be carried out now, (N,) each."""
    period = s.show_duration + s.show_delay
    first = s.count - s.clue_end // period  # in the endless task, a clue shows the new commands only
    shown = np.where(s.symbol > 0, first + s.clue_step // period, SHOWS_NONE)
    acts = (s.clue_step >= s.clue_end) & ~s.burning
    return shown, np.where(acts, s.current, WANTS_NONE)


def falls(s: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return 0 where Mystery Path shows a fall, and 0, which is looked for, (N,) each."""
    return np.where(s.fallen, 0, SHOWS_NONE), np.zeros(len(s.fallen))


COMMANDS, FALLS = ("the due command", commands), ("falls", falls)
SUBJECTS = {
    "MortarMayhem-v0": COMMANDS,
    "MortarMayhem-Grid-v0": COMMANDS,
    "Endless-MortarMayhem-v0": COMMANDS,
    "MysteryPath-v0": FALLS,
    "MysteryPath-Grid-v0": FALLS,
    "Endless-MysteryPath-v0": FALLS,
}


class Shown(VectorWrapper):
    """Tells of each lane's first episode what its steps showed."""

    def __init__(self, env: VectorEnv, look: Callable[[Any], tuple[np.ndarray, np.ndarray]]):
        super().__init__(env)
        self.look, self.playing = look, np.ones(self.num_envs, bool)

    def reset(self, **given: Any) -> tuple[Any, dict]:
        """Reset every lane."""
        results = self.env.reset(**given)
        shown, self.wanted = self.look(self.unwrapped.state)
        self.shown = [shown]  # at each step, (N,)
        return results

    def step(self, actions: np.ndarray) -> tuple[Any, ...]:
        """Step every lane."""
        *results, infos = self.env.step(actions)
        if "final_info" in infos:
            self.playing &= ~infos["_final_info"]
        shown, self.wanted = self.look(self.unwrapped.state)
        self.shown.append(shown)
        return *results, infos

    def wanted_among(self, earlier: int) -> np.ndarray:
        """Return which of so many steps before the present one showed what is looked for now, (N, earlier)."""
        shown = np.stack(self.shown[-1 - earlier : -1], 1)
        return (shown == self.wanted[:, None]) & self.playing[:, None]


def attended(agent: nn.Module, envs: Shown, levels: list[int]) -> tuple[float, list[np.ndarray]]:
    """Let an agent play; return the share of what is looked for among the steps attended to, and of the attention.

    The latter of each block by head, (H,). Raises ValueError if no step could attend to what is looked for.
    """
    uniform = []
    weights: list[list[np.ndarray]] = [[] for _ in agent.memory.blocks]

    def add(block: int, given: tuple) -> None:
        x, keys, _, age, mask = given
        earlier = keys.shape[1]
        if earlier >= len(envs.shown):  # an episode's first step has an empty key
            return
        attends = mask[:, 0].numpy()  # (N, M)
        wanted = envs.wanted_among(earlier) & attends
        asks = wanted.any(1)
        if block == 0:
            uniform.append((wanted.sum(1) / attends.sum(1).clip(1))[asks])
        of_block = attention_weights(agent.memory.blocks[block].attention, x, keys, age, mask)[:, :, 0]  # (N, H, M)
        weights[block].append((of_block.numpy() * wanted[:, None]).sum(-1)[asks])

    for number, block in enumerate(agent.memory.blocks):
        block.attention.register_forward_pre_hook(lambda _, given, number=number: add(number, given))
    evaluate(agent, envs, levels, sys.maxsize)
    shares = np.concatenate(uniform)
    if not len(shares):
        raise ValueError("in these levels, no step could attend to what is looked for")
    return shares.mean(), [np.concatenate(each).mean(0) for each in weights]


def agents_of(config: Config, tasks: Iterable[str]) -> Iterator[tuple[str, nn.Module, VectorEnv, list[int]]]:
    """Yield each agent's path, the agent, an environment for each test level, and the levels.

    Raises ValueError if there is none or for one of another task, and what `Checkpoint.read` raises.
    """
    check_bounds(config)
    whose = f"give agents of {', '.join(tasks)}"
    if not config.checkpoints:
        raise ValueError(whose)
    for path in config.checkpoints:
        checkpoint = Checkpoint.read(path)
        if checkpoint.args.env_id not in tasks:
            raise ValueError(f"{path} was trained in {checkpoint.args.env_id}; {whose}")
        envs = envs_for(checkpoint.args, config.levels)
        agent = checkpoint.agent(envs, envs.reset()[1])
        torch.manual_seed(0)
        yield path, agent, envs, [*range(FIRST_TEST_LEVEL, FIRST_TEST_LEVEL + config.levels)]
        envs.close()


def main(config: Config) -> None:
    """Print a table, an agent a row; raise ValueError for no transformer, and what `agents_of` and `evaluate` raise."""
    rows = []
    for path, agent, envs, levels in agents_of(config, SUBJECTS):
        if not hasattr(agent.memory, "blocks"):
            raise ValueError(f"{path} is no transformer; give agents that ppo_trxl.py trained")
        name, look = SUBJECTS[envs.spec.id]
        share, blocks = attended(agent, Shown(envs, look), levels)
        heads = "; ".join(", ".join(f"{100 * head:.0f}" for head in block) for block in blocks)
        rows.append(f"| `{Path(path).name}` | {name} | {100 * share:.0f} % | {heads} % |")
    print("\n".join([HEADING, *rows]))


if __name__ == "__main__":
    with one_line_exit(ValueError, OSError, ImportError, gym.error.Error, RunError):
        main(tyro.cli(Config))
