"""A family of Memory Gym environments in one file: a color is shown once and asked for `delay` steps later.

    python ppo_gru.py --preset laptop --env-id examples.recall:Recall-v0 --num-envs 32 --total-timesteps 100000

`MemoryGymVectorEnv` says what each method returns, and what else can be overridden. Shape letters: N lanes, n of them,
V entries of a vector observation, G of the ground truth.
"""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np

from memory_gym_envs.base import MemoryGymVectorEnv
from memory_gym_envs.entries import Entries
from memory_gym_envs.options import Option
from memory_gym_envs.single import MemoryGymEnv, register
from memory_gym_envs.state import array, empty
from memory_gym_envs.variant import Variant

COLORS = np.array([(255, 0, 0), (0, 255, 0), (0, 0, 255), (0, 0, 0)], np.uint8)  # the last: nothing
BLANK = 3
OPTIONS = (
    Option("delay", 8, "int", 1, 100, "steps from the color to the answer"),
    Option("reward_success", 1.0, "float", None, None, "reward for the right answer"),
)
ENTRIES = (Entries("color", BLANK, "the color that is shown, one-hot: red, green, blue; zeros: none"),)
VARIANTS = {"Recall-v0": Variant(4, OPTIONS, ENTRIES)}  # the ids; 4 frames a second in videos


@dataclass
class State:
    """All that later steps depend on, an array a field."""

    length: np.ndarray = array("N")  # steps so far; needed
    color: np.ndarray = array("N")  # the one to remember
    total: np.ndarray = array("N", dtype=np.float64)  # rewards so far
    delay: np.ndarray = array("N", option="delay")  # each lane's reset option of this name
    reward: np.ndarray = array("N", dtype=np.float64, option="reward_success")


class Recall(MemoryGymVectorEnv):
    """A color is shown once; some steps later, the action has to name it."""

    variants = VARIANTS

    def spaces(self):
        return gym.spaces.Box(0, 255, (84, 84, 3), np.uint8), gym.spaces.Discrete(BLANK)

    def allocate(self):
        self.state = empty(State, N=self.num_envs)

    def begin(self, lanes):
        self.state.length[lanes], self.state.total[lanes] = 0, 0.0
        for lane in lanes.tolist():  # a seed's level is what is drawn here
            self.state.color[lane] = self.np_random[lane].integers(BLANK)

    def advance(self, actions):
        s = self.state
        s.length += 1
        over = s.length > s.delay
        rewards = s.reward * (over & (actions == s.color))
        s.total += rewards
        return rewards, over, np.zeros(self.num_envs, bool)  # terminated, truncated

    def shown(self, lanes):
        return np.where(self.state.length[lanes] == 0, self.state.color[lanes], BLANK)  # (n,)

    def frames(self, lanes):
        return np.tile(COLORS[self.shown(lanes)][:, None, None], (1, 84, 84, 1))  # (n, 84, 84, 3)

    def vectors(self, lanes):
        return np.eye(BLANK + 1, BLANK, dtype=np.float32)[self.shown(lanes)]  # (n, V)

    def ground_truth(self):
        return np.eye(BLANK)[self.state.color]  # (N, G)

    def summary(self, lanes):
        total = self.state.total[lanes]
        return {"reward": total, "length": self.state.length[lanes], "success": (total > 0).astype(np.float64)}


class RecallEnv(MemoryGymEnv):
    """One of them."""

    family = Recall


register(RecallEnv)
