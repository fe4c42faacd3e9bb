"""Two environments that test the memory of an agent which can only be trained: importing this registers their ids.

    python ppo_gru.py --preset laptop --env-id ppo_utils.memory_probes:Recall-8-v0 --total-timesteps 200000
    python ppo_gru.py --preset laptop --env-id ppo_utils.memory_probes:Leak-v0 --total-timesteps 200000

Both observe two bits, one-hot, or nothing (zeros), act with one bit, and pay 1 for the right one.
"""

from typing import Any

import gymnasium as gym
import numpy as np

DELAYS = (1, 8, 32, 128)


class Recall(gym.Env):
    """A bit is shown once, and `delay` steps later the action has to be that bit: a return of 1, of 0.5 by guessing.

    No agent that remembers fewer than `delay` steps is better than guessing: nothing else tells it.
    """

    observation_space = gym.spaces.Box(0.0, 1.0, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, delay: int):
        self.delay = delay

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Show the bit."""
        super().reset(seed=seed)
        self.bit, self.now = int(self.np_random.integers(2)), 0
        return shown(self.bit), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Wait, or at the end pay for the answer."""
        over = self.now == self.delay
        self.now += 1
        return shown(None), float(over and action == self.bit), over, False, {}


class Leak(gym.Env):
    """A bit is shown in an episode's last step; the first action of the next episode is paid if it is that bit.

    An agent whose memory is reset has to guess: a mean return of 0.5. What is above comes from the episode before.
    """

    observation_space = gym.spaces.Box(0.0, 1.0, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)
    last = 0  # the bit of the episode before

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Show nothing."""
        super().reset(seed=seed)
        self.bit, self.now = int(self.np_random.integers(2)), 0
        return shown(None), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Pay for the bit of the episode before and show that of this one; then end."""
        self.now += 1
        if self.now == 1:
            paid, self.last = float(action == self.last), self.bit
            return shown(self.bit), paid, False, False, {}
        return shown(None), 0.0, True, False, {}


def shown(bit: int | None) -> np.ndarray:
    """The observation (2,) that shows this bit, or nothing."""
    return np.zeros(2, np.float32) if bit is None else np.eye(2, dtype=np.float32)[bit]


gym.register("Leak-v0", entry_point=Leak)
for _delay in DELAYS:
    gym.register(f"Recall-{_delay}-v0", entry_point=Recall, kwargs={"delay": _delay})
