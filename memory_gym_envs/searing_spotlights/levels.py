"""Levels: what the generator decides at a reset and when a coin or a spotlight appears.

All is sampled in the original's order, so that a seed means the same level here.
`free` are the pixels where something may be put, (84, 84) bool; None: all.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from memory_gym_envs.base import NO_LIMIT
from memory_gym_envs.bits import POSITION_0, POSITIONS
from memory_gym_envs.character import FACINGS, PAD, hand_offsets, radius_of
from memory_gym_envs.drawing import SCREEN
from memory_gym_envs.searing_spotlights.rules import coin_show_limit, start_wait, update_targets
from memory_gym_envs.searing_spotlights.state import AGENT, COIN, EXIT, GONE, NO_KEY, NO_SPOT, RADIUS, State
from memory_gym_envs.state import make_room
from memory_gym_envs.words import pick, sample_below, word_source

MIDDLE = SCREEN // 2
OUTSIDE = math.sqrt(2 * SCREEN**2) / 2  # spotlights start and end that far from the middle, and their radius more
MARGIN = 7  # coins and the exit stay that far from the screen's edges
AGENT_SPACE, COIN_SPACE = 28, 21  # pixels around a position where nothing else is put

Position = tuple[int, int]  # x and y in pixels


def start_episode(s: State, lane: int, rng: np.random.Generator, values: dict[str, Any], endless: bool) -> None:
    """Starts the lane's next episode, with these reset options."""
    next_word = word_source(rng)
    # Before the first step the agent is drawn facing up wherever it faces, as in the original.
    if s.drawn_facing is s.facing:
        s.drawn_facing = s.drawn_facing.copy()
    s.facing[lane], s.drawn_facing[lane] = sample_below(next_word, FACINGS), 0
    if values["sample_agent_position"]:
        pos, free = sample_position(next_word, None, AGENT_SPACE)
    else:
        pos, free = (MIDDLE, MIDDLE), occupied(None, (MIDDLE, MIDDLE), COIN_SPACE)
    s.bodies[:, lane], s.targets[lane] = GONE, 0.0
    s.bodies[:, lane, AGENT] = pos
    for axis in range(2):
        s.pos[lane, axis] = pos[axis] + PAD
    write_spots(s, lane, [sample_spot(rng, values) for _ in range(values["initial_spawns"])])
    if endless:
        coins = [sample_coin(next_word, None)] if values["coin_enabled"] else []
    else:
        coins = []
        num_coins = pick(next_word, values["num_coins"]) if values["num_coins"] else 0
        for _ in range(num_coins + values["use_exit"]):
            position, free = sample_position(next_word, free, COIN_SPACE)
            coins.append(inside(position))
        if values["use_exit"]:
            s.bodies[:, lane, EXIT] = s.targets[lane, 2:] = coins.pop()  # the last of them
    for coin, position in enumerate(coins):
        s.bodies[:, lane, COIN + coin] = position
    s.num_coins[lane] = s.coins_left[lane] = len(coins)
    s.coin_show_limit[lane] = coin_show_limit(values, first=True)
    update_targets(s, lane)
    s.spawns_left[lane] = values.get("num_spawns", NO_LIMIT)
    start_wait(s, lane, pick(next_word, values["spawn_delay"]))
    s.health[lane] = s.full_health[lane]
    s.floor[lane] = 2 * lane
    for field in (s.collected, s.coin_age, s.success, s.is_open, s.lost_width, s.length):
        field[lane] = 0
    s.last_action[lane] = s.shown_action[lane] = s.shown_gain[lane] = 0
    s.last_gain[lane], s.episode_return[lane] = 1, 0.0


def write_spots(s: State, lane: int, spots: list[list[float]]) -> None:
    """Makes these the lane's spotlights, each a column of State.spots. They shine from the first step on."""
    count = len(spots)
    if count > s.spot_key.shape[1]:
        make_room(s, "S", count)
    s.spots[:, lane], s.spot_key[lane], s.num_spots[lane] = NO_SPOT[:, None], NO_KEY, count
    if count:
        s.spots[:, lane, :count] = np.array(spots).T
        s.spot_key[lane, :count] = [spot[RADIUS] * POSITIONS + POSITION_0 for spot in spots]
    s.spot_place[:, lane], s.near_light[lane] = 0, False


def sample_position(next_word: Callable[[], int], free: np.ndarray | None, space: int) -> tuple[Position, np.ndarray]:
    """A position near a free pixel, and which pixels are free once those less than `space` away are occupied."""
    cells = () if free is None else np.flatnonzero(free)
    # Where nothing is free, the original fails.
    cell = int(cells[sample_below(next_word, len(cells))]) if len(cells) else sample_below(next_word, SCREEN * SCREEN)
    y, x = divmod(cell, SCREEN)
    return (x + 2 + sample_below(next_word, 2), y + 2 + sample_below(next_word, 2)), occupied(free, (x, y), space)


def occupied(free: np.ndarray | None, pos: Position, space: int) -> np.ndarray:
    """Which pixels are free once those less than `space` away from the position are occupied."""
    left, top = SCREEN - 1 - pos[0], SCREEN - 1 - pos[1]
    far = _distant(space)[top : top + SCREEN, left : left + SCREEN]
    return far if free is None else free & far


@cache
def _distant(space: int) -> np.ndarray:
    """(167, 167) bool: which pixels are at least `space` away from the central one."""
    offset = np.arange(1 - SCREEN, SCREEN)
    return offset**2 + offset[:, None] ** 2 >= space**2


def inside(pos: Position) -> Position:
    """The position, moved inside the screen's margin."""
    x, y = (min(max(part, MARGIN), SCREEN - MARGIN) for part in pos)
    return x, y


def sample_coin(next_word: Callable[[], int], last: Position | None) -> Position:
    """The endless task's next coin, away from the last one. It may lie under the agent, as in the original."""
    free = None if last is None else occupied(None, last, AGENT_SPACE)
    return inside(sample_position(next_word, free, AGENT_SPACE)[0])


def sample_spot(rng: np.random.Generator, values: dict[str, Any]) -> list[float]:
    """A new spotlight, a column of State.spots. Its path is bent, from one side of the screen to roughly the other."""
    next_word = word_source(rng)
    least, slowest = int(values["spot_min_radius"]), values["spot_min_speed"]
    radius = least + sample_below(next_word, max(int(values["spot_max_radius"]) - least, 0) + 1)
    speed = rng.uniform(slowest, max(slowest, values["spot_max_speed"]))
    start = sample_below(next_word, 360)
    target = start + 180 - 45 + sample_below(next_word, 90)
    offset = target - 135 + sample_below(next_word, 270)
    far = OUTSIDE + radius
    x, y = (MIDDLE + far * part for part in UNITS[start])
    to_x, to_y = (MIDDLE + far * part for part in UNITS[target])
    off_x, off_y = (MIDDLE + far * part for part in UNITS[offset])
    reach, sight = radius + radius_of(values["agent_scale"]), radius + _extent(values["agent_scale"])
    path = [x, y, to_x - x, to_y - y, off_x - to_x, off_y - to_y]
    return [0.0, speed, radius, reach * reach, sight * sight, *path]


@cache
def _extent(scale: float) -> float:
    """How far from the agent's centre a spotlight may end and still show some of it, in pixels."""
    hands = max(math.hypot(*hand) for facing in range(FACINGS) for hand in hand_offsets(scale, facing))
    return max(radius_of(scale), hands + int(10 * scale)) + 3  # as both are drawn at whole pixels


def _unit(degrees: int) -> tuple[float, float]:
    """The direction of an angle; quarter turns are exact."""
    if degrees % 90 == 0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[degrees // 90 % 4]
    angle = math.fmod(degrees * math.pi / 180, 2 * math.pi)
    return math.cos(angle), math.sin(angle)


UNITS = [_unit(degrees) for degrees in range(720)]
