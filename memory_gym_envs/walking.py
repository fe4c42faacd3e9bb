"""What the three families share: an agent that walks, the sum of an episode's rewards, and a limit of steps."""

from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from memory_gym_envs import character
from memory_gym_envs.base import MemoryGymVectorEnv
from memory_gym_envs.character import PAD, SPAN, STRIDES, Figure
from memory_gym_envs.drawing import SCREEN
from memory_gym_envs.state import array

GRID_SCALE = 0.25  # the agent's size in grid ids, which ignore agent_scale
BRANCHES = np.array([3, 1])  # numbers the actions of two branches from 0 to 8


@dataclass
class WalkingState:
    """One array a field, one row a lane. A family adds its own. Positions are stored with PAD added."""

    pos: np.ndarray = array("N", 2)  # the agent's centre, x and y
    facing: np.ndarray = array("N")
    figure: np.ndarray = array("N")  # the first of the batch's figures that the agent walks by
    length: np.ndarray = array("N")  # steps so far
    episode_return: np.ndarray = array("N", dtype=np.float64)  # sum of rewards so far
    step_limit: np.ndarray = array("N", fill=-1, option="max_steps")  # steps until truncation; -1: no limit


class WalkingVectorEnv(MemoryGymVectorEnv):
    """A family whose agent walks. Its state extends WalkingState."""

    tables: ClassVar[tuple[str, ...]] = ("_agent_tables", "_vector_tables")
    tile: ClassVar[int]  # pixels that the agent of grid ids walks in a step

    # ---- what a family provides ----

    def figures_of(self, values: dict[str, Any]) -> tuple[Figure, ...]:
        """The agent's figure under these options, here on the whole screen; or two, as it walks along x and along y."""
        return (self.figure_of(values, 0, SCREEN),)

    def vector_tables(self) -> Any:
        """The tables of vector observations."""
        raise NotImplementedError

    def apply_rules(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One step of the rules, but for the limit of steps: rewards and terminations, (N,) each. action: (N,)."""
        raise NotImplementedError

    # ---- what is the same for all; base.py describes the methods that have no docstring here ----

    def spaces(self) -> tuple[gym.Space, gym.Space]:
        actions = gym.spaces.Discrete(4) if self.variant.grid else gym.spaces.MultiDiscrete([3, 3])
        return gym.spaces.Box(0, 255, (SCREEN, SCREEN, 3), np.uint8), actions

    def scale_of(self, values: dict[str, Any]) -> float:
        """The agent's size under these options."""
        return GRID_SCALE if self.variant.grid else values["agent_scale"]

    def figure_of(self, values: dict[str, Any], low: int, high: int, torus: bool = False) -> Figure:
        """The agent's figure under these options, on ground from pixel `low` to the one before `high`."""
        scale = self.scale_of(values)
        if self.variant.grid:
            return Figure(scale, self.tile, low, high, self.tile // 2, False)
        return Figure(scale, values["agent_speed"], low, high, character.radius_of(scale), torus)

    def place_tables(self) -> None:
        every, numbers = numbered([self.figures_of(values) for values in self.settings])
        self.figures = tuple(figure for each in every for figure in each)  # the different ones of all lanes
        axes = np.arange(len(every[0]))
        self.state.figure[:] = np.multiply(numbers, len(axes))
        self._agent_tables = character.agent_tables(self.figures)
        self._controls = character.grid_controls() if self.variant.grid else character.free_controls()
        self._lane_walk = (self.state.figure[:, None] + axes) * (STRIDES * SPAN)  # (N, 1) or (N, 2)
        if self.obs_type == "vector":
            self._vector_tables = self.vector_tables()

    def advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s = self.state
        s.length += 1
        rewards, terminated = self.apply_rules(actions if actions.ndim == 1 else actions.dot(BRANCHES))
        s.episode_return += rewards
        truncated = s.length == s.step_limit
        if np.count_nonzero(truncated):
            truncated &= ~terminated
        return rewards, terminated, truncated

    def move_agents(self, action: np.ndarray) -> None:
        """Turns and moves the agents. action: (N,)."""
        s, table = self.state, self._agent_tables.walk
        s.facing, s.pos = character.walk(s.facing, s.pos, action, self._lane_walk, self._controls, table)

    def summary(self, lanes: np.ndarray) -> dict[str, np.ndarray]:
        """The lanes' ended episodes in numbers, each (n,). A family adds its own."""
        return {"reward": self.state.episode_return[lanes], "length": self.state.length[lanes]}

    def oracle(self) -> dict[str, np.ndarray]:
        """As in MemoryGymVectorEnv, and `position` (N, 2), the agent's centre in pixels, x and y."""
        return super().oracle() | {"position": self.state.pos - PAD}


def numbered(every: list[Any]) -> tuple[tuple[Any, ...], list[int]]:
    """The different ones among these, and for each which of them it is."""
    different = tuple(dict.fromkeys(every))
    return different, [different.index(each) for each in every]
