"""CueRecall-v0: the smallest task that cannot be solved without memory.

A cue is shown at the first step only, and asked for after blank steps: at least blanks[0] and fewer than blanks[1].
Observation (3,): the cue one-hot, then whether this step asks. Action MultiDiscrete([2, 2]): each branch names a cue,
heard only when asked for.
Reward, at the end: the share of branches that are right, so 1 at best and 0.5 for guessing.
"""

import gymnasium as gym
import numpy as np


class CueRecall(gym.Env):
    observation_space = gym.spaces.Box(0.0, 1.0, (3,), np.float32)
    action_space = gym.spaces.MultiDiscrete([2, 2])

    def __init__(self, blanks=(10, 13)):
        self.limits = blanks

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cue = int(self.np_random.integers(2))
        self.blanks = int(self.np_random.integers(*self.limits))
        self.t = 0
        obs = np.zeros(3, np.float32)
        obs[self.cue] = 1
        return obs, {}

    def step(self, action):
        self.t += 1
        asked = self.t == self.blanks + 2
        reward = float(np.mean(np.asarray(action) == self.cue)) if asked else 0.0
        obs = np.zeros(3, np.float32)
        obs[2] = self.t == self.blanks + 1
        return obs, reward, asked, False, {"right": reward} if asked else {}


gym.register("CueRecall-v0", entry_point=CueRecall)
