"""Draw the README's pictures of the environments: the agent's view above, the debug view below.

python benchmarks/pictures.py docs
"""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
from PIL import Image

import memory_gym_envs  # noqa: F401 (registers the ids)


def joined(pictures: list[np.ndarray], axis: int, gap: int = 8) -> np.ndarray:
    """Join pictures of the same size along an axis, with white pixels in between."""
    shape = list(pictures[0].shape)
    shape[axis] = gap
    white = np.full(shape, 255, np.uint8)
    return np.concatenate([part for picture in pictures for part in (white, picture)][1:], axis)


def column(env: gym.Env, observation: np.ndarray) -> np.ndarray:
    """Return the agent's view above the debug view, both 336 pixels wide."""
    return joined([observation.repeat(4, axis=0).repeat(4, axis=1), env.render()], axis=0)


def mortar_mayhem(seed: int = 3) -> np.ndarray:
    """Return four moments: a command is shown, the agent walks, the right tile stays blue, it stands on a wrong one."""
    env = gym.make("MortarMayhem-v0", render_mode="debug_rgb_array")
    observation, info = env.reset(seed=seed, options={"command_count": [2]})
    columns, rewarded = [column(env, observation)], False
    for step in range(1000):
        target = info["ground_truth"] * 4  # the target's tile, for an arena of five
        centre = (target * 14 + 14).astype(int)
        agent = np.argwhere((observation == (250, 204, 153)).all(-1)).mean(0)[::-1]
        walk = np.where(np.abs(centre - agent) <= 2, 0, np.where(centre > agent, 2, 1))
        # After the first command it stays where it is, and so fails the second.
        observation, reward, done, _, info = env.step(walk if not rewarded else np.zeros(2, int))
        if step == 12 or reward > 0 or done:
            columns.append(column(env, observation))
        rewarded |= reward > 0
        if done:
            break
    return joined(columns, axis=1)


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "docs")
    Image.fromarray(mortar_mayhem()).save(folder / "mortar_mayhem.png", optimize=True)
