"""Draw an agent at work: what it would see beside the debug view, a frame for each step of a level's episode.

    python benchmarks/moving_picture.py agents/mortar-mayhem-grid-trxl.pt docs/agent.gif

The level is one of the test levels, with the agent's own environment and options.
"""

import functools
import json
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
import tyro
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this clone, before an installed one

import memory_gym_envs  # noqa: F401 (registers the ids)
from learning import FIRST_TEST_LEVEL
from pictures import joined, text
from ppo_utils.acting import Player

SIDE = 336  # pixels of a view
MILLISECONDS = 160  # that a frame is shown
LAST = 12  # times as long is the last one


def main(path: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path], level: int = FIRST_TEST_LEVEL) -> None:
    """Write the picture and print how the episode went.

    Args:
        path: a model.pt.
        out: the file to write, a GIF.
        level: the level to play.
    """
    torch.manual_seed(1)
    player = Player(path)
    make = functools.partial(gym.make, player.args.env_id, obs_type=player.args.obs_type)
    envs = make(render_mode="rgb_array"), make(render_mode="debug_rgb_array")
    options = json.loads(player.args.env_options)
    (observation, _), _ = (env.reset(seed=level, options=options) for env in envs)
    names = joined([np.asarray(text(name, SIDE)) for name in ("agent's view", "debug view")], axis=1)
    frames, done, info, reward = [], False, {}, 0.0
    while True:
        views = [Image.fromarray(env.render()).resize((SIDE, SIDE), Image.Resampling.NEAREST) for env in envs]
        frames.append(Image.fromarray(np.concatenate([names, joined([np.asarray(view) for view in views], axis=1)])))
        if done:
            break
        action = player.act(observation, reward)
        (observation, reward, terminated, truncated, info), _ = (env.step(action) for env in envs)
        done = terminated or truncated
    durations = [MILLISECONDS] * (len(frames) - 1) + [LAST * MILLISECONDS]
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=True)
    print(f"level {level}: a return of {info['reward']:.2f} in {info['length']} steps")


if __name__ == "__main__":
    tyro.cli(main)
