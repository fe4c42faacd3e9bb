"""Draw an agent at work: what it would see beside the debug view, a frame for each step of a level's episode.

    python benchmarks/moving_picture.py agents/mortar-mayhem-grid-trxl.pt docs/agent.gif

The level is one of the test levels, with the agent's own environment and options. In Mortar Mayhem, a strip below has
all commands of the episode: a frame around the one that is due, a green tick in those that were carried out.
"""

import functools
import json
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro
from PIL import Image, ImageDraw

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this clone, before an installed one

import memory_gym_envs  # noqa: F401 (registers the ids)
from learning import FIRST_TEST_LEVEL
from memory_gym_envs.mortar_mayhem.drawing import SYMBOL, symbols
from pictures import LABEL, joined, text
from ppo_utils.acting import Player

SIDE = 336  # pixels of a view
MILLISECONDS = 160  # that a frame is shown
LAST = 12  # times as long is the last one
GREEN, ORANGE, GRAY = (0, 140, 0), (240, 120, 0), (200, 200, 200)


def strip(step: int, truth: dict[str, Any], width: int) -> Image.Image:
    """Return a strip of that width with the episode's step and, in Mortar Mayhem, its commands and how far they are."""
    if "commands" not in truth:
        return text(f"step {step}", width)
    picture = Image.new("RGB", (width, LABEL), "white")
    words, side, between = 120, LABEL - 4, 55  # pixels: for the step, of a command's box, from one box to the next
    picture.paste(text(f"step {step}", words))
    draw = ImageDraw.Draw(picture)
    for index, command in enumerate(command for command in truth["commands"] if command >= 0):
        x, y = words + between * index, 2
        symbol = 255 - symbols()[1 + command].reshape(SYMBOL, SYMBOL, 3)  # black on white
        picture.paste(Image.fromarray(symbol), (x + (side - SYMBOL) // 2, y + (side - SYMBOL) // 2))
        is_due = index == truth["carried_out"]
        draw.rectangle((x, y, x + side, y + side), outline=ORANGE if is_due else GRAY, width=4 if is_due else 1)
        if index < truth["carried_out"]:
            draw.line([(x + 6, y + 24), (x + 16, y + 33), (x + 35, y + 8)], fill=GREEN, width=4)
    return picture


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
        below = strip(len(frames), envs[0].unwrapped.oracle(), names.shape[1])
        views = [Image.fromarray(env.render()).resize((SIDE, SIDE), Image.Resampling.NEAREST) for env in envs]
        parts = [names, joined([np.asarray(view) for view in views], axis=1), np.asarray(below)]
        frames.append(Image.fromarray(np.concatenate(parts)))
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
