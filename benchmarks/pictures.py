"""Draw an episode of a trained agent: what it would see as an image, and the debug view, which shows all.

    python benchmarks/pictures.py agents/mortar-mayhem-grid-trxl.pt docs/agent.gif
    python benchmarks/pictures.py agents/mystery-path-grid-trxl.pt docs/mystery_path.png

A GIF has a frame for each step and, in Mortar Mayhem, a strip with all commands of the episode: a frame around the one
that is due, a green tick in those that were carried out. A PNG has six steps at even distances. The level is one of the
test levels, with the agent's own environment and options.
"""

import functools
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
import tyro
from PIL import Image, ImageDraw, ImageFont

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this clone, before an installed one

from learning import FIRST_TEST_LEVEL
from memory_gym_envs.mortar_mayhem.drawing import SYMBOL, symbols
from ppo_utils.acting import Player
from ppo_utils.environments import is_memory_gym
from ppo_utils.errors import RunError
from ppo_utils.terminal import one_line_exit

VIEW, GAP, LABEL = 336, 8, 44  # pixels: a view's side, white between views, margins with labels
MILLISECONDS = 160  # that a frame is shown
LAST = 12  # times as long is the last one
COLUMNS = 6  # of a PNG
GREEN, ORANGE, GRAY = (0, 140, 0), (240, 120, 0), (200, 200, 200)


@dataclass
class Config:
    """Draw an episode of a trained agent."""

    checkpoint: tyro.conf.Positional[Path]
    """a file that --save-model wrote"""
    out: tyro.conf.Positional[Path]
    """the file to write, a GIF or a PNG"""
    level: int = FIRST_TEST_LEVEL
    """the level to play"""


class Moment(NamedTuple):
    """An episode after some steps."""

    truth: dict[str, Any]  # what `oracle()` tells
    views: list[np.ndarray]  # the agent's and the debug view, (VIEW, VIEW, 3)


def play(path: Path, level: int) -> tuple[list[Moment], dict[str, Any]]:
    """Return all moments of an episode, and its last info."""
    torch.manual_seed(1)
    player = Player(path)
    if not is_memory_gym(player.args.env_id):
        raise ValueError(f"{path} was trained in {player.args.env_id}; give an agent of a Memory Gym environment")
    make = functools.partial(gym.make, player.args.env_id, obs_type=player.args.obs_type)
    envs = make(render_mode="rgb_array"), make(render_mode="debug_rgb_array")
    options = json.loads(player.args.env_options)
    (observation, _), _ = (env.reset(seed=level, options=options) for env in envs)
    moments, done, info, reward = [], False, {}, 0.0
    while True:
        views = [Image.fromarray(env.render()).resize((VIEW, VIEW), Image.Resampling.NEAREST) for env in envs]
        moments.append(Moment(envs[0].unwrapped.oracle(), [np.asarray(view) for view in views]))
        if done:
            return moments, info
        action = player.act(observation, reward)
        (observation, reward, terminated, truncated, info), _ = (env.step(action) for env in envs)
        done = terminated or truncated


def joined(pictures: list[np.ndarray], axis: int) -> np.ndarray:
    """Join pictures of the same size along an axis, with white pixels in between."""
    shape = list(pictures[0].shape)
    shape[axis] = GAP
    white = np.full(shape, 255, np.uint8)
    return np.concatenate([part for picture in pictures for part in (white, picture)][1:], axis)


def text(words: str, width: int = VIEW) -> Image.Image:
    """Return words in the middle of a white strip, (LABEL, width)."""
    strip = Image.new("RGB", (width, LABEL), "white")
    ImageDraw.Draw(strip).text((width / 2, LABEL / 2), words, "black", ImageFont.load_default(28), anchor="mm")
    return strip


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


def moving(moments: list[Moment], out: Path) -> None:
    """Write a frame for each moment, the two views beside each other."""
    names = joined([np.asarray(text(name)) for name in ("agent's view", "debug view")], axis=1)
    frames = []
    for step, (truth, views) in enumerate(moments):
        parts = [names, joined(views, axis=1), np.asarray(strip(step, truth, names.shape[1]))]
        frames.append(Image.fromarray(np.concatenate(parts)))
    durations = [MILLISECONDS] * (len(frames) - 1) + [LAST * MILLISECONDS]
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=True)


def still(moments: list[Moment], out: Path) -> None:
    """Write moments at even distances, the agent's view above the debug view."""
    columns = [
        np.concatenate([np.asarray(text(f"step {step}")), joined(moments[step].views, axis=0)])
        for step in np.linspace(0, len(moments) - 1, COLUMNS).round().astype(int)
    ]
    pictures = Image.fromarray(joined(columns, axis=1))
    whole = Image.new("RGB", (LABEL + pictures.width, pictures.height), "white")
    whole.paste(pictures, (LABEL, 0))
    for row, words in enumerate(("agent's view", "debug view")):
        whole.paste(text(words).transpose(Image.Transpose.ROTATE_90), (0, LABEL + row * (VIEW + GAP)))
    whole.resize((whole.width // 2, whole.height // 2)).save(out, optimize=True)


def main(config: Config) -> None:
    """Write the picture and print how the episode went."""
    moments, info = play(config.checkpoint, config.level)
    (moving if config.out.suffix == ".gif" else still)(moments, config.out)
    print(f"level {config.level}: a return of {info['reward']:.2f} in {info['length']} steps")


if __name__ == "__main__":
    with one_line_exit(ValueError, OSError, ImportError, gym.error.Error, RunError):
        main(tyro.cli(Config))
