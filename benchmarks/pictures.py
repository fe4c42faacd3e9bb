"""Draw the pictures of the environments: the agent's view above, the debug view below, a column for each moment.

python benchmarks/pictures.py docs
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from PIL import Image, ImageDraw, ImageFont

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this clone, before an installed one

import memory_gym_envs  # noqa: F401 (registers the ids)

RED, YELLOW = (255, 0, 0), (255, 255, 0)
VIEW, GAP, LABEL = 336, 8, 44  # pixels: a view's side, white between views, the margins with labels on top and left


class Moment(NamedTuple):
    """An episode after so many steps."""

    step: int
    observation: np.ndarray  # (84, 84, 3)
    truth: np.ndarray  # the id's ground truth
    returned: float  # sum of rewards so far
    picture: np.ndarray  # the agent's view above the debug view, both VIEW pixels wide


def joined(pictures: list[np.ndarray], axis: int) -> np.ndarray:
    """Join pictures of the same size along an axis, with white pixels in between."""
    shape = list(pictures[0].shape)
    shape[axis] = GAP
    white = np.full(shape, 255, np.uint8)
    return np.concatenate([part for picture in pictures for part in (white, picture)][1:], axis)


def episode(env_id: str, seed: int, act: Callable[[Moment], np.ndarray], steps: int = 1000, **options) -> list[Moment]:
    """Play an episode, or as many steps of it, and return all its moments."""
    env = gym.make(env_id, render_mode="debug_rgb_array")
    observation, info = env.reset(seed=seed, options=options)
    moments, returned, done = [], 0.0, False
    while True:
        picture = joined([observation.repeat(4, axis=0).repeat(4, axis=1), env.render()], axis=0)
        moments.append(Moment(len(moments), observation, info["ground_truth"], returned, picture))
        if done or len(moments) > steps:
            return moments
        observation, reward, terminated, truncated, info = env.step(act(moments[-1]))
        returned, done = returned + reward, terminated or truncated


def first(moments: list[Moment], condition: Callable[[Moment], bool]) -> Moment:
    """Return the first moment for which the condition holds."""
    return next(moment for moment in moments if condition(moment))


def shows(color: tuple[int, int, int], rows: slice = slice(4, None)) -> Callable[[Moment], bool]:
    """Return the condition that the agent sees the color in these rows: by default below a top bar."""
    return lambda moment: bool((moment.observation[rows] == color).all(axis=-1).any())


def towards(away: np.ndarray) -> np.ndarray:
    """Return the action of free movement that goes there, for a distance in pixels along x and y."""
    return np.where(np.abs(away) <= 2, 0, np.where(away > 0, 2, 1))


def mortar_mayhem() -> dict[str, Moment]:
    """Return four moments by what happens in them."""

    def act(moment: Moment) -> np.ndarray:
        agent = np.argwhere((moment.observation == (250, 204, 153)).all(-1)).mean(0)[::-1]
        target = (moment.truth * 4 * 14 + 14).astype(int)  # of an arena of five
        # After the first command it stays where it is, and so fails the second.
        return np.zeros(2, int) if moment.returned else towards(target - agent)

    moments = episode("MortarMayhem-v0", 3, act, command_count=[2])
    return {
        "a command is shown": moments[0],
        "walking to its tile": moments[10],
        "correct tile: reward 0.1": first(moments, lambda moment: moment.returned > 0),
        "wrong tile: episode ends": moments[-1],
    }


def mystery_path() -> dict[str, Moment]:
    """Return four moments by what happens in them, the last of the endless task."""
    ways = np.array([(2, 0), (0, 1), (0, 2), (1, 0)])  # east, north, south, west

    def act(moment: Moment) -> np.ndarray:
        way = moment.truth.argmax()
        return ways[way if moment.step < 24 else way ^ 1]  # later to the side, south instead of west

    moments = episode("MysteryPath-v0", 5, act)
    endless = episode("Endless-MysteryPath-v0", 3, lambda moment: 1 + moment.truth.argmax(), 60)
    return {
        "start at the origin": moments[0],
        "on the path": moments[24],
        "fell off: red cross": first(moments, shows(RED)),
        "endless: past path visible": endless[-1],
    }


def searing_spotlights() -> dict[str, Moment]:
    """Return four moments by what happens in them, the last of the endless task."""

    def act(moment: Moment) -> np.ndarray:
        agent, *things = moment.truth.reshape(-1, 2) * 84
        return towards(next(thing for thing in things if thing.any()) - agent)

    moments = episode("SearingSpotlights-v0", 41, act)
    endless = episode("Endless-SearingSpotlights-v0", 8, act, 52)
    return {
        "the light goes out": moments[3],
        "dark: coin collected": first(moments, shows(YELLOW, slice(1))),
        "in the light: health lost": first(moments, shows(RED)),
        "endless: a new coin": endless[-1],
    }


def text(words: str, width: int) -> Image.Image:
    """Return words in the middle of a white strip, (LABEL, width)."""
    strip = Image.new("RGB", (width, LABEL), "white")
    ImageDraw.Draw(strip).text((width / 2, LABEL / 2), words, "black", ImageFont.load_default(28), anchor="mm")
    return strip


def labelled(moments: dict[str, Moment]) -> Image.Image:
    """Return the moments beside each other, with what happens above them and the names of the views on the left."""
    pictures = joined([moment.picture for moment in moments.values()], axis=1)
    whole = Image.new("RGB", (LABEL + pictures.shape[1], LABEL + pictures.shape[0]), "white")
    whole.paste(Image.fromarray(pictures), (LABEL, LABEL))
    for column, words in enumerate(moments):
        whole.paste(text(words, VIEW), (LABEL + column * (VIEW + GAP), 0))
    for row, words in enumerate(("agent's view", "debug view")):
        whole.paste(text(words, VIEW).transpose(Image.Transpose.ROTATE_90), (0, LABEL + row * (VIEW + GAP)))
    return whole


def write(folder: Path) -> None:
    """Write one picture for each family."""
    for family in (mortar_mayhem, mystery_path, searing_spotlights):
        labelled(family()).save(folder / f"{family.__name__}.png", optimize=True)


if __name__ == "__main__":
    write(Path(sys.argv[1] if len(sys.argv) > 1 else "docs"))
