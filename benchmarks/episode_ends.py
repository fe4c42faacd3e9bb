"""What ends the episodes of Endless Mystery Path and Endless Searing Spotlights? Trained agents play test levels.

    python benchmarks/episode_ends.py agents/endless-mystery-path-gru.pt agents/endless-searing-spotlights-gru.pt

In Endless Mystery Path, an episode ends with a fall where the agent came further before, with a second fall at the same
place, or without stamina (thesis 4.4.2); in Endless Searing Spotlights, without health or too late for a coin (4.5.2).

Shape letters: N environments, one for each of M test levels.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.vector import VectorEnv, VectorWrapper

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the packages of this repository

import attention
from ppo_utils.errors import RunError
from ppo_utils.evaluation import evaluate
from ppo_utils.flags import PositiveInt
from ppo_utils.terminal import one_line_exit

RIGHT = 1  # an action of Endless Mystery Path


@dataclass
class Config(attention.Config):
    """Let agents of the two tasks play."""

    levels: PositiveInt = 500
    """test levels to play, each once"""


class LastFalls(VectorWrapper):
    """Tells of each lane's first episode in Endless Mystery Path whether it ended with a fall: `fell` (N,).

    And whether that was into a column behind the furthest that its agent has reached: `behind` (N,). For the default
    options, with which a step crosses at most one column's border.
    """

    def __init__(self, env: VectorEnv):
        super().__init__(env)
        self.playing = np.ones(self.num_envs, bool)
        self.fell, self.behind = np.zeros((2, self.num_envs), bool)

    def step(self, actions: np.ndarray) -> tuple[Any, ...]:
        """Step every lane."""
        before = self.unwrapped.oracle()
        column = before["tile"][:, 0] + (np.ravel(actions) == RIGHT)  # where a fall would be
        *others, infos = self.env.step(actions)
        if "final_info" in infos:
            ended, final = infos["_final_info"] & self.playing, infos["final_info"]
            self.fell |= ended & (final["num_fails"] > before["falls"])
            self.behind |= ended & self.fell & (column < final["max_x"])
            self.playing &= ~ended
        return *others, infos


def percent(which: np.ndarray) -> str:
    """Return the share of episodes (M,) that are true."""
    return f"{100 * which.mean():.0f} %"


def path_ends(envs: VectorEnv, play: Callable) -> str:
    """Say what ends episodes of Endless Mystery Path; `play` lets the agent play in such environments."""
    envs = LastFalls(envs)
    play(envs)
    behind, again, never = map(percent, (envs.behind, envs.fell & ~envs.behind, ~envs.fell))
    return f"{behind} fall where they came further before, {again} at the same place again, {never} do not fall"


def light_ends(envs: VectorEnv, play: Callable) -> str:
    """Say what ends episodes of Endless Searing Spotlights, and what an episode has."""
    played = play(envs)
    coins, steps = played["coins_collected"].mean(), played["length"].mean()
    return f"{percent(played['agent_health'] <= 0)} are without health; {coins:.2f} coins in {steps:.0f} steps"


ENDS = {"Endless-MysteryPath-v0": path_ends, "Endless-SearingSpotlights-v0": light_ends}


def main(config: Config) -> None:
    """Print a line for each agent; raise what `attention.agents_of` and `evaluate` raise."""
    for path, agent, envs, levels in attention.agents_of(config, ENDS):
        play = partial(evaluate, agent, levels=levels, max_steps=sys.maxsize)
        print(f"{path}: {ENDS[envs.spec.id](envs, play)}")


if __name__ == "__main__":
    with one_line_exit(ValueError, OSError, ImportError, gym.error.Error, RunError):
        main(tyro.cli(Config))
