"""Searing Spotlights: stay out of the light, remember where you are, collect coins and leave (thesis 4.5).

Shape letters: N lanes, n some of them, S spotlights that fit, B bodies: the agent, the exit and the coins that fit.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from memory_gym_envs.base import ALL, DEBUG_ZOOM, NO_LIMIT, MemoryGymVectorEnv, widened
from memory_gym_envs.bits import (
    FULL_ROW,
    ITEMS,
    NO_SHAPE,
    PLACE_0,
    PLACES,
    SAMPLE_ROWS,
    SAMPLE_STEP,
    Stencils,
    pixel_scratch,
    pixels,
    sample,
    samples,
    stencils,
    sums,
    tile_counts,
    unpacked,
)
from memory_gym_envs.character import (
    FACINGS,
    PAD,
    SPAN,
    STRIDES,
    Figure,
    agent_tables,
    free_controls,
    hand_places,
    radius_of,
    sprites,
    walk,
)
from memory_gym_envs.drawing import FRAME, ROW, SCREEN, Sheet, disk, magnify, make_sheet, paste, ring
from memory_gym_envs.entries import Entries, vector_slices
from memory_gym_envs.options import Option
from memory_gym_envs.words import below, pick, words

TILE = 12  # pixels; the floor is a chessboard
TOP_BAR = 4  # rows of the top bar
MIDDLE = SCREEN // 2
OUTSIDE = math.sqrt(2 * SCREEN**2) / 2  # a spotlight starts and ends that far from the middle, and its radius more
MARGIN = 7  # coins and the exit stay that far from the screen's edges
AGENT_SPACE, COIN_SPACE = 28, 21  # pixels around a place where nothing else is put
SPOT_RADII = (1, 42)  # pixels; the largest light is as wide as the screen
MOST_COINS = 20

AGENT, EXIT, COIN = 0, 1, 2  # bodies; coins are the last ones
GONE = 180  # where bodies are that do not exist, in pixels: too far away to be touched or seen
AWAY = -1000  # where spotlights are that do not exist

# What is known of a spotlight, a row of State.spots. Its place at time t is START + t * (TOWARD + t * BEND).
# It hurts within REACH of the agent's centre and may show a part of it within SIGHT, both squared.
TIME, SPEED, RADIUS, REACH, SIGHT = range(5)
START, TOWARD, BEND = slice(5, 7), slice(7, 9), slice(9, 11)
NO_SPOT = np.array([0.0, 0.0, 0.0, -1.0, -1.0, AWAY, AWAY, 0.0, 0.0, 0.0, 0.0])  # (11,)

NO_KEY = -AWAY  # brings a spotlight that does not exist to place 0


# ---- configuration ----


@dataclass(frozen=True)
class Variant:
    """What tells one Searing Spotlights id from another."""

    endless: bool  # one coin after the other, no exit
    render_fps: int
    options: tuple[Option, ...]
    entries: tuple[Entries, ...]  # of a vector observation


UNUSED = "ignored, as in the original"


def _options(endless: bool) -> tuple[Option, ...]:
    """The reset options of an id, in the original's order of names."""
    return tuple(option for present, option in _light_rows(endless) + _body_rows(endless) if present)


def _light_rows(endless: bool) -> list[tuple[bool, Option]]:
    """Time and light: which options an id has, and what they are."""
    finite, (small, large), least = not endless, SPOT_RADII, "; {} where that is larger"
    steps, deadline = "steps until truncation; -1: no limit", "steps to collect a coin in; -1: no limit"
    return [
        (True, Option("max_steps", -1 if endless else 256, "int", 1, None, steps, also=(-1,))),
        (endless, Option("steps_per_coin", 160, "int", 1, None, deadline, also=(-1,))),
        (True, Option("initial_spawns", 3 if endless else 4, "int", 0, 100, "spotlights at the start")),
        (finite, Option("num_spawns", 30, "int", 0, None, "spotlights that follow")),
        (finite, Option("initial_spawn_interval", 30, "int", 0, None, "steps between them, without the threshold")),
        (finite, Option("spawn_interval_threshold", 10, "int", 0, None, "steps added to initial_spawn_interval")),
        (finite, Option("spawn_interval_decay", 0.95, "float", 0.0, 1.0, UNUSED)),
        (endless, Option("spawn_interval", 50, "int", 1, None, "steps between the spotlights that follow")),
        (True, Option("spot_min_radius", 7.5, "float", small, large, "smallest radius of a spotlight, rounded down")),
        (True, Option("spot_max_radius", 13.75, "float", small, large, "largest" + least.format("the smallest"))),
        (True, Option("spot_min_speed", 0.0025, "float", 0.0, 1.0, "slowest spotlight, in passages a step")),
        (True, Option("spot_max_speed", 0.0075, "float", 0.0, 1.0, "fastest" + least.format("the slowest"))),
        (True, Option("spot_damage", 1.0, "float", 0.0, None, "health lost in a step in the light")),
        (True, Option("visual_feedback", True, "bool", None, None, "redden the floor while the agent is in the light")),
        (True, Option("black_background", False, "bool", None, None, "black floor; spotlights have a white rim")),
        (True, Option("hide_chessboard", False, "bool", None, None, "white floor, which never reddens")),
        (True, Option("light_dim_off_duration", 6, "int", 0, 255, "steps in which the light goes out; 0: it is out")),
        (True, Option("light_threshold", 255, "int", 0, 255, "dimming ends when darkness exceeds this; 255: black")),
    ]


def _body_rows(endless: bool) -> list[tuple[bool, Option]]:
    """Coins, exit, agent and rewards, likewise."""
    finite, shown = not endless, "frames that show the first coin in the dark; each later one: one frame less"
    return [
        (finite, Option("num_coins", (1,), "ints", 0, MOST_COINS, "coins to collect *", empty=True)),
        (True, Option("coin_scale", 0.375, "float", 0.1, 2.0, "size of a coin; 0.375: 6 pixels wide")),
        (endless, Option("coin_show_duration", 6, "int", 0, None, shown)),
        (True, Option("coins_visible", False, "bool", None, None, "coins are visible in the dark")),
        (endless, Option("coin_enabled", True, "bool", None, None, "false: no coins, and no time limit for them")),
        (finite, Option("use_exit", True, "bool", None, None, "false: the last coin ends the episode")),
        (finite, Option("exit_scale", 0.5, "float", 0.1, 2.0, "size of the exit; 0.5: 10 pixels wide")),
        (finite, Option("exit_visible", False, "bool", None, None, "the exit is visible in the dark")),
        (True, Option("agent_speed", 3.0, "float", 0.0, 84.0, "pixels that the agent walks in a step")),
        (True, Option("agent_health", 10 if endless else 5, "int", 1, None, "health at the start")),
        (True, Option("agent_scale", 0.25, "float", 0.04, 1.0, "size of the agent; 0.25: 12 pixels wide")),
        (True, Option("agent_visible", False, "bool", None, None, "the agent is visible in the dark")),
        (True, Option("sample_agent_position", True, "bool", None, None, "false: the agent starts in the middle")),
        (True, Option("show_last_action", True, "bool", None, None, "show the action before the last in the top bar")),
        (True, Option("show_last_positive_reward", True, "bool", None, None, "show whether the step before paid")),
        (True, Option("reward_inside_spotlight", 0.0, "float", None, None, "reward for each step in the light")),
        (True, Option("reward_outside_spotlight", 0.0, "float", None, None, "reward for each step in the dark")),
        (True, Option("reward_death", 0.0, "float", None, None, "added when no health is left")),
        (finite, Option("reward_exit", 1.0, "float", None, None, "reward for leaving")),
        (finite, Option("reward_max_steps", 0.0, "float", None, None, UNUSED)),
        (True, Option("reward_coin", 0.25, "float", None, None, "reward for each coin")),
    ]


def _entries(endless: bool) -> tuple[Entries, ...]:
    """What the vector of an id holds."""
    action = "the action in the bar, one-hot: none, {}, {}; zeros where it is hidden"
    place = "{}: how many pixels are visible, over 144 and at most 1; x and y of their middle, over 84"
    tiles = "of each tile of 12 x 12 pixels, row by row, the share that is {}; the bar's pixels don't count"
    table: list[tuple[Any, ...]] = [
        (True, "health", 1, "share of the bar's left half that is green"),
        (True, "horizontal", 3, action.format("left", "right")),
        (True, "vertical", 3, action.format("up", "down")),
        (True, "rewarded", 1, "1 where the bar shows a positive reward"),
        (True, "agent", 3, place.format("the agent")),
        (not endless, "exit", 3, place.format("the exit without its black frame")),
        (True, "coin", 3, place.format("the coin, or all of them")),
        (True, "facing", 8, "the agent's where all of it is visible, one-hot: up, up-left, left, ... up-right"),
        (not endless, "exit_open", 1, "1 where an open exit is visible"),
        (not endless, "coins", 49, tiles.format("coins")),
        (True, "light", 49, tiles.format("bright floor or, with a black background, rims of spotlights")),
        (True, "dusk", 1, "brightness of the floor outside of the light, while any is visible"),
        (True, "alarm", 1, "1 where red floor is visible"),
    ]
    return tuple(Entries(*row) for present, *row in table if present)


VARIANTS = {
    "SearingSpotlights-v0": Variant(False, 25, _options(endless=False), _entries(endless=False)),
    "Endless-SearingSpotlights-v0": Variant(True, 25, _options(endless=True), _entries(endless=True)),
}


# ---- state ----


@dataclass
class State:
    """One array a field. The agent's pos is stored with PAD added, like in the other families."""

    pos: np.ndarray  # (N, 2) the agent's centre, x and y
    facing: np.ndarray  # (N,)
    drawn_facing: np.ndarray  # (N,) the facing that is drawn
    figure: np.ndarray  # (N,) which of the batch's figures the agent is
    bodies: np.ndarray  # (2, N, B) x and y of the agent, the exit and the coins; GONE where there is none
    touch_squared: np.ndarray  # (N, B) float64: square of the distance at which the agent touches them
    coin_sprite: np.ndarray  # (N,) the sprite of the lane's coin; those of its closed and its open exit follow
    is_open: np.ndarray  # (N,) 1 if the exit is open
    targets: np.ndarray  # (N, 4) float64: x and y of the first coin left and of the exit; 0 where there is none
    num_coins: np.ndarray  # (N,) in this episode
    coins_left: np.ndarray  # (N,) of them
    collected: np.ndarray  # (N,) coins so far
    coin_age: np.ndarray  # (N,) steps since the coin appeared (endless)
    success: np.ndarray  # (N,) 1 when the task is done
    spots: np.ndarray  # (11, N, S) float64: the spotlights, oldest first; see TIME .. BEND
    spot_key: np.ndarray  # (N, S) where the radius begins in SpotStencils, with PLACE_0 added; or NO_KEY
    num_spots: np.ndarray  # (N,) spotlights
    spot_place: np.ndarray  # (2, N, S) where each one shines, x and y as indices of SpotStencils; 0 where it doesn't
    near_light: np.ndarray  # (N,) bool: some of the agent may be in the light
    spawn_wait: np.ndarray  # (N,) steps until the next one
    spawns_left: np.ndarray  # (N,) spotlights to follow
    health: np.ndarray  # (N,) float64
    scenery: np.ndarray  # (2 * N, FRAME) uint8: each lane's floor, coins and exit in full light: calm, then alarmed
    floor: np.ndarray  # (N,) which row of the scenery shows
    lost_width: np.ndarray  # (N,) pixels of the top bar that show lost health
    last_action: np.ndarray  # (N,) 3 * horizontal + vertical
    shown_action: np.ndarray  # (N,) that of the step before
    last_gain: np.ndarray  # (N,) 1, or 2 after a positive reward
    shown_gain: np.ndarray  # (N,) that of the step before; 0 before the first step
    length: np.ndarray  # (N,) steps so far
    episode_return: np.ndarray  # (N,) float64: sum of rewards so far
    # Options that the rules or the pictures need at every step.
    step_limit: np.ndarray  # (N,) steps until truncation
    coin_limit: np.ndarray  # (N,) steps to collect a coin in
    coin_show_limit: np.ndarray  # (N,) age until which coins are visible in the dark
    spawn_interval: np.ndarray  # (N,) steps between spotlights
    full_health: np.ndarray  # (N,) float64: health at the start
    damage: np.ndarray  # (N,) float64
    floors: np.ndarray  # (N, 2) rows of floors(): while the agent is in the dark, and in the light
    rim: np.ndarray  # (N,) bool: spotlights have a white rim
    darkness: np.ndarray  # (N, FADE) uint8: opacity of the dark after so many steps
    dark_at: np.ndarray  # (N,) steps until it is opaque and nothing else
    reddens: np.ndarray  # (N,) 1 if the floor is red while the agent is in the light
    first_bar: np.ndarray  # (N,) the first row of bars() that shows what the lane may see
    exit_layer: np.ndarray  # (N,) UNDER the dark, or above it and BELOW_BAR or ABOVE_BAR
    agent_layer: np.ndarray  # (N,) likewise
    layered: np.ndarray  # (N,) bool: either is above the dark
    reward_inside: np.ndarray  # (N,) float64
    reward_outside: np.ndarray  # (N,) float64
    reward_death: np.ndarray  # (N,) float64
    reward_coin: np.ndarray  # (N,) float64
    reward_exit: np.ndarray  # (N,) float64


UNDER, BELOW_BAR, ABOVE_BAR = range(3)
FADE = 257  # steps after which the darkness no longer changes


def empty_state(lanes: int) -> State:
    """The state of N lanes before their first reset, with room for no coin and one spotlight."""
    shapes = {"pos": (lanes, 2), "bodies": (2, lanes, COIN), "touch_squared": (lanes, COIN)}
    shapes |= {"spots": (len(NO_SPOT), lanes, 1), "spot_key": (lanes, 1), "spot_place": (2, lanes, 1)}
    shapes |= {"targets": (lanes, 4), "darkness": (lanes, FADE), "scenery": (2 * lanes, FRAME), "floors": (lanes, 2)}
    floats = ("touch_squared", "targets", "spots", "health", "episode_return", "full_health", "damage")
    rewards = ("reward_inside", "reward_outside", "reward_death", "reward_coin", "reward_exit")
    kinds: dict[str, Any] = dict.fromkeys((*floats, *rewards), np.float64)
    kinds |= dict.fromkeys(("near_light", "rim", "layered"), bool) | dict.fromkeys(("darkness", "scenery"), np.uint8)
    names = State.__dataclass_fields__
    return State(**{name: np.zeros(shapes.get(name, (lanes,)), kinds.get(name, np.int64)) for name in names})


def make_room(s: State, coins: int = 0, spots: int = 0) -> None:
    """Widens the state's arrays, where they are too narrow, for so many coins and spotlights in a lane."""
    s.bodies, s.touch_squared = widened(s.bodies, COIN + coins, GONE), widened(s.touch_squared, COIN + coins)
    old = s.spot_key.shape[1]
    if spots > old:
        s.spots, s.spot_key = widened(s.spots, spots), widened(s.spot_key, spots, NO_KEY)
        s.spots[:, :, old:] = NO_SPOT[:, None, None]
        s.spot_place = widened(s.spot_place, spots)


# ---- levels ----


class Level(NamedTuple):
    """What the generator decides at a reset."""

    facing: int
    pos: tuple[int, int]
    spots: list[list[float]]  # each a column of State.spots
    coins: list[tuple[int, int]]
    exit: tuple[int, int] | None


def sample_level(rng: np.random.Generator, values: dict[str, Any], variant: Variant) -> Level:
    """Samples a level in the original's order, so that its seeds mean the same here."""
    word = words(rng)
    facing = below(word, FACINGS)
    if values["sample_agent_position"]:
        pos, free = sample_place(word, None, AGENT_SPACE)
    else:
        pos = (MIDDLE, MIDDLE)
        free = occupied(None, pos, COIN_SPACE)
    spots = [sample_spot(rng, values) for _ in range(values["initial_spawns"])]
    if variant.endless:
        return Level(facing, pos, spots, [sample_coin(word, None)] if values["coin_enabled"] else [], None)
    things = []
    coins = pick(word, values["num_coins"]) if values["num_coins"] else 0
    for _ in range(coins + values["use_exit"]):
        place, free = sample_place(word, free, COIN_SPACE)
        things.append(inside(place))
    return Level(facing, pos, spots, things, things.pop() if values["use_exit"] else None)


def sample_place(word: Callable[[], int], free: np.ndarray | None, space: int) -> tuple[tuple[int, int], np.ndarray]:
    """A place near a free pixel, and what is free when the pixels around that one are occupied.

    free: (84, 84) bool, or None: every pixel is.
    """
    cells = () if free is None else np.flatnonzero(free)
    # Where nothing is free, the original fails.
    cell = int(cells[below(word, len(cells))]) if len(cells) else below(word, SCREEN * SCREEN)
    y, x = divmod(cell, SCREEN)
    return (x + 2 + below(word, 2), y + 2 + below(word, 2)), occupied(free, (x, y), space)


def occupied(free: np.ndarray | None, pos: tuple[int, int], space: int) -> np.ndarray:
    """What is free when the pixels less than `space` away are not. free: (84, 84) bool, or None: every pixel is."""
    left, top = SCREEN - 1 - pos[0], SCREEN - 1 - pos[1]
    rest = _distant(space)[top : top + SCREEN, left : left + SCREEN]
    return rest if free is None else free & rest


@cache
def _distant(space: int) -> np.ndarray:
    """(167, 167) bool: which pixels are at least `space` away from the central one."""
    offset = np.arange(1 - SCREEN, SCREEN)
    return offset**2 + offset[:, None] ** 2 >= space**2


def inside(pos: tuple[int, int]) -> tuple[int, int]:
    """The place, moved inside the screen's margin."""
    x, y = (min(max(part, MARGIN), SCREEN - MARGIN) for part in pos)
    return x, y


def sample_coin(word: Callable[[], int], last: tuple[int, int] | None) -> tuple[int, int]:
    """The endless task's next coin, away from the last one. It may lie under the agent, as in the original."""
    free = None if last is None else occupied(None, last, AGENT_SPACE)
    return inside(sample_place(word, free, AGENT_SPACE)[0])


def sample_spot(rng: np.random.Generator, values: dict[str, Any]) -> list[float]:
    """A new spotlight, a column of State.spots: on a bent path from one side of the screen to roughly the other."""
    word = words(rng)
    least, slowest = int(values["spot_min_radius"]), values["spot_min_speed"]
    radius = least + below(word, max(int(values["spot_max_radius"]) - least, 0) + 1)
    speed = rng.uniform(slowest, max(slowest, values["spot_max_speed"]))
    start = below(word, 360)
    target = start + 180 - 45 + below(word, 90)
    offset = target - 135 + below(word, 270)
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
    hands = max(math.hypot(*place) for facing in range(FACINGS) for place in hand_places(scale, facing))
    return max(radius_of(scale), hands + int(10 * scale)) + 3  # as both are drawn at whole pixels


def _unit(degrees: int) -> tuple[float, float]:
    """The direction of an angle; quarter turns are exact."""
    if degrees % 90 == 0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[degrees // 90 % 4]
    angle = math.fmod(degrees * math.pi / 180, 2 * math.pi)
    return math.cos(angle), math.sin(angle)


UNITS = [_unit(degrees) for degrees in range(720)]


def write_level(s: State, lane: int, level: Level, spawns: int) -> None:
    """Starts the lane's episode at this level, with so many spotlights to follow."""
    coins = len(level.coins)
    make_room(s, spots=len(level.spots))
    # Before the first step the agent is drawn facing up wherever it faces, as in the original.
    if s.drawn_facing is s.facing:
        s.drawn_facing = s.drawn_facing.copy()
    s.facing[lane], s.drawn_facing[lane] = level.facing, 0
    s.bodies[:, lane] = GONE
    s.bodies[:, lane, AGENT] = level.pos
    for axis in range(2):
        s.pos[lane, axis] = level.pos[axis] + PAD
    for coin, place in enumerate(level.coins):
        s.bodies[:, lane, COIN + coin] = place
    s.targets[lane] = 0.0
    if level.exit is not None:
        s.bodies[:, lane, EXIT] = s.targets[lane, 2:] = level.exit
    s.num_coins[lane] = s.coins_left[lane] = coins
    update_targets(s, lane)
    s.spots[:, lane], s.spot_key[lane], s.num_spots[lane] = NO_SPOT[:, None], NO_KEY, len(level.spots)
    if level.spots:
        s.spots[:, lane, : len(level.spots)] = np.array(level.spots).T
        s.spot_key[lane, : len(level.spots)] = [spot[RADIUS] * PLACES + PLACE_0 for spot in level.spots]
    s.spot_place[:, lane], s.near_light[lane] = 0, False  # they shine from the first step on
    s.spawns_left[lane], s.spawn_wait[lane] = spawns, s.spawn_interval[lane] if spawns else NO_LIMIT
    s.health[lane] = s.full_health[lane]
    s.floor[lane] = 2 * lane
    for field in (s.collected, s.coin_age, s.success, s.is_open, s.lost_width, s.length):
        field[lane] = 0
    s.last_action[lane] = s.shown_action[lane] = s.shown_gain[lane] = 0
    s.last_gain[lane], s.episode_return[lane] = 1, 0.0


def add_spot(s: State, lane: int, spot: list[float]) -> None:
    """Adds a spotlight to the lane's."""
    at = int(s.num_spots[lane])
    if at == s.spot_key.shape[1]:
        # Every step reads all of that, so it is just enough, unless there are so many that growing often costs more.
        make_room(s, spots=at + max(2, at // 8))
    s.spots[:, lane, at] = spot
    s.spot_key[lane, at] = spot[RADIUS] * PLACES + PLACE_0
    s.num_spots[lane] = at + 1


def update_targets(s: State, lane: int) -> None:
    """Makes the first coin left the lane's goal."""
    coins = np.flatnonzero(s.bodies[0, lane, COIN:] != GONE)
    s.targets[lane, :2] = s.bodies[:, lane, COIN + coins[0]] if coins.size else 0.0


# ---- drawing ----

WHITE, BLUE, RED = (255, 255, 255), (0, 0, 255), (255, 0, 0)
YELLOW, ORANGE, GREEN = (255, 255, 0), (255, 165, 0), (0, 255, 0)
DOOR_OPEN, DOOR_CLOSED = (48, 141, 70), (55, 55, 55)
GREY = (50, 50, 50)
ACTION_COLORS = ((120, 120, 120), (116, 1, 113), (255, 94, 14))  # nothing, left or up, right or down
BLUE_FLOOR, RED_FLOOR, WHITE_FLOOR, BLACK_FLOOR = range(4)


@cache
def floors() -> np.ndarray:
    """(4, FRAME) uint8, read-only: the four floors, lit."""
    tile = np.arange(SCREEN) // TILE
    light = (tile[:, None] + tile) % 2 == 0  # (84, 84)
    table: np.ndarray = np.zeros((4, SCREEN, SCREEN, 3), np.uint8)
    table[:BLACK_FLOOR] = WHITE
    table[BLUE_FLOOR, ~light], table[RED_FLOOR, ~light] = BLUE, RED
    table = table.reshape(4, FRAME)
    table.flags.writeable = False
    return table


WIDTHS = SCREEN + 1  # of lost health in the top bar: a last hit may reach beyond the bar's half
BARS_PER_CHOICE = 3 * 3 * 3 * WIDTHS  # rows of bars() for one choice of what to show


@cache
def bars(endless: bool) -> np.ndarray:
    """(4 * BARS_PER_CHOICE, ROW) uint8, read-only: the top bar, by what it shows and how that is.

    What it shows: 1 for actions + 2 for positive rewards. How that is: both actions, last gain (0 before the first
    step, 1, 2 for a positive one) and lost health.
    """
    half, quarter = SCREEN // 2, SCREEN // 4
    table: np.ndarray = np.zeros((2, 2, 3, 3, 3, WIDTHS, SCREEN, 3), np.uint8)
    table[:] = (0, 0, 0) if endless else GREY
    table[..., :half, :] = GREEN
    for action, color in enumerate(ACTION_COLORS):
        table[:, 1, action, :, :, :, half : half + quarter] = color
        table[:, 1, :, action, :, :, half + quarter :] = color
    for width in range(WIDTHS):
        table[..., width, :width, :] = RED
    for gain, color in ((1, GREY), (2, YELLOW)):
        table[1, 0, :, :, gain, :, half:] = color
        table[1, 1, :, :, gain, :, half + 15 : half + 25] = color
    table = table.reshape(-1, ROW)
    table.flags.writeable = False
    return table


class SpotStencils(NamedTuple):
    """Every spotlight at every place, by its radius."""

    disks: Stencils
    rims: Stencils  # their outlines


@lru_cache(maxsize=8)
def spot_stencils(least: int, largest: int) -> SpotStencils:
    """The tables for spotlights of these radii. Cached: environments with the same options share them."""
    disks, rims = spot_shapes(least, largest)
    return SpotStencils(stencils(disks), stencils(rims))


def spot_shapes(least: int, largest: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The masks of spotlights by radius, and their outlines."""
    radii = range(least, largest + 1)
    disks = [disk(2 * radius, radius, radius, radius) for radius in radii]
    rims = [ring(2 * radius, radius, radius, radius, 1) for radius in radii]
    return [NO_SHAPE] * least + disks, [NO_SHAPE] * least + rims


def draw_coins_and_exits(scales: tuple[tuple[float, float], ...]) -> tuple[np.ndarray, np.ndarray]:
    """Coins and exits of the given pairs of scales, a coin, a closed exit and an open one for each.

    Their colours (R, W, W, 3), and (R, W, W) bool what is drawn of them.
    """
    width = 2 * max(int(10 * scale) for pair in scales for scale in pair) + 2
    images = np.zeros((3 * len(scales), width, width, 3), np.uint8)
    solids = np.zeros(images.shape[:3], bool)
    for index, (coin_scale, exit_scale) in enumerate(scales):
        _draw_coin_sprite(images[3 * index], solids[3 * index], coin_scale)
        for look, color in enumerate((DOOR_CLOSED, DOOR_OPEN)):
            _draw_exit_sprite(images[3 * index + 1 + look], solids[3 * index + 1 + look], exit_scale, color)
    return images, solids


@lru_cache(maxsize=16)
def coin_and_exit_sheet(scales: tuple[tuple[float, float], ...]) -> Sheet:
    """The sprites of these coins and exits."""
    return make_sheet(*draw_coins_and_exits(scales), np.arange(SCREEN))


def _draw_coin_sprite(image: np.ndarray, solid: np.ndarray, scale: float) -> None:
    middle, radius, rim = len(solid) // 2, int(10 * scale), int(2 * scale)
    solid |= disk(len(solid), middle, middle, radius)
    image[solid] = YELLOW
    # A line of no width fills the circle: small coins are orange all over.
    edge = ring(len(solid), middle, middle, radius, rim) if rim else solid
    image[edge] = ORANGE
    solid |= edge


def _draw_exit_sprite(image: np.ndarray, solid: np.ndarray, scale: float, color: tuple[int, int, int]) -> None:
    size, corner, frame = int(20 * scale), int(10 * scale), int(2 * scale)
    first = len(solid) // 2 - size // 2
    square = slice(first, first + size)
    arch, door = _arch(size, corner), np.zeros((size, size), bool)
    if frame == 1:
        door[:-1, 1:-1] = arch[:-1, 1:-1]
        door[0] = False
        line = ring(2 * corner, corner, corner, corner, 1)[:corner]
        door[:corner, :corner] &= ~line[:, :corner]
        door[:corner, size - corner :] &= ~line[:, corner:]
    elif frame:  # a frame of no width fills the exit: small ones are black, open or not
        door[frame:-frame, frame:-frame] = _arch(size - 2 * frame, max(0, corner - frame))
    solid[square, square] = arch
    image[square, square][door] = color


def _arch(size: int, corner: int) -> np.ndarray:
    """A square mask with round corners at the top."""
    mask = np.ones((size, size), bool)
    quarter = disk(2 * corner, corner, corner, corner)[:corner]
    mask[:corner, :corner], mask[:corner, size - corner :] = quarter[:, :corner], quarter[:, corner:]
    return mask


class DrawingTables(NamedTuple):
    """The tables that pictures are made of."""

    spots: SpotStencils
    figures: Sheet
    coins_and_exits: Sheet
    bars: np.ndarray
    scratch: np.ndarray  # (N, 588) scratch for pixels()


def draw(s: State, drawing: DrawingTables, lanes: np.ndarray | slice) -> np.ndarray:
    """Fresh frames of the lanes, (n, 84, 84, 3) uint8, from the state alone."""
    dim = (s.length < s.dark_at)[lanes]  # (n,) the darkness is not just black
    frames = draw_in_full_light(s, drawing, lanes, s.near_light[lanes] | dim)
    lit, rim = light_masks(s, drawing.spots, lanes)
    darken(s, lanes, frames, pixels(lit, drawing.scratch[: len(lit)]), rim, np.flatnonzero(dim))
    coins = s.coin_age[lanes] < s.coin_show_limit[lanes]
    if np.count_nonzero(coins):
        draw_coins(s, drawing, lanes, frames, coins)
    layered = np.count_nonzero(s.layered[lanes])
    if layered:
        draw_layer(s, drawing, lanes, frames, BELOW_BAR)
    frames.reshape(-1, SCREEN, ROW)[:, :TOP_BAR] = drawing.bars.take(bar_rows(s, lanes), axis=0)[:, None]
    if layered:
        draw_layer(s, drawing, lanes, frames, ABOVE_BAR)
    return frames.reshape(-1, SCREEN, SCREEN, 3)


def bar_rows(s: State, lanes: np.ndarray | slice) -> np.ndarray:
    """(n,) which of bars() the lanes show."""
    return s.first_bar[lanes] + (3 * s.shown_action[lanes] + s.shown_gain[lanes]) * WIDTHS + s.lost_width[lanes]


def draw_in_full_light(
    s: State, drawing: DrawingTables, lanes: np.ndarray | slice, seen: np.ndarray | bool
) -> np.ndarray:
    """The lanes in full light, with the agents that are seen, (n,) bool or just True: (n, FRAME) uint8."""
    frames = s.scenery.take(s.floor[lanes], axis=0)
    draw_agents(s, drawing, lanes, frames, seen)
    return frames


def draw_scenery(s: State, drawing: DrawingTables, lane: int) -> None:
    """Draws the lane's scenery, whenever a coin or the exit has changed."""
    frames, twice = floors().take(s.floors[lane], axis=0), np.array([lane, lane])
    draw_coins(s, drawing, twice, frames, True)
    draw_exits(s, drawing, twice, frames, True)
    s.scenery[2 * lane : 2 * lane + 2] = frames


def draw_coins(
    s: State, drawing: DrawingTables, lanes: np.ndarray | slice, frames: np.ndarray, shown: np.ndarray | bool
) -> None:
    """Draws the coins of the lanes that are shown, (n,) bool, into the frames, in place."""
    sprite = s.coin_sprite[lanes]
    for coin in range(COIN, s.bodies.shape[2]):
        pos = s.bodies[:, lanes, coin].T  # (n, 2)
        paste_shown(frames, drawing.coins_and_exits, sprite, pos, shown & (pos[:, 0] != GONE))


def draw_exits(
    s: State, drawing: DrawingTables, lanes: np.ndarray | slice, frames: np.ndarray, shown: np.ndarray | bool
) -> None:
    """Draws the exits of the lanes that are shown, (n,) bool, into the frames, in place."""
    pos = s.bodies[:, lanes, EXIT].T  # (n, 2)
    sprite = (s.coin_sprite + s.is_open)[lanes] + 1
    paste_shown(frames, drawing.coins_and_exits, sprite, pos, shown & (pos[:, 0] != GONE))


def draw_agents(
    s: State, drawing: DrawingTables, lanes: np.ndarray | slice, frames: np.ndarray, shown: np.ndarray | bool
) -> None:
    """Draws the agents of the lanes that are shown, (n,) bool, into the frames, in place."""
    if shown is True or np.count_nonzero(shown):
        paste_shown(frames, drawing.figures, (s.figure * FACINGS + s.drawn_facing)[lanes], s.pos[lanes], shown)


def paste_shown(frames: np.ndarray, sheet: Sheet, rows: np.ndarray, pos: np.ndarray, shown: np.ndarray | bool) -> None:
    """Pastes sprite rows[i] of the sheet at pos[i] into those of the frames that are shown, (n,) bool or just True."""
    count = len(rows) if shown is True else np.count_nonzero(shown)
    if count == len(rows):
        paste(frames, sheet, rows, pos)
    elif count:
        at = np.flatnonzero(shown)
        paste(frames, sheet, rows[at], pos[at], at)


def draw_layer(s: State, drawing: DrawingTables, lanes: np.ndarray | slice, frames: np.ndarray, layer: int) -> None:
    """Draws the exits and agents that belong to this layer, which the darkness does not cover."""
    draw_exits(s, drawing, lanes, frames, s.exit_layer[lanes] == layer)
    draw_agents(s, drawing, lanes, frames, s.agent_layer[lanes] == layer)


def light_masks(s: State, tables: SpotStencils, lanes: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray | None]:
    """What the spotlights light and, if any has a rim, which pixels those are: masks, (n, 588) uint16."""
    key = s.spot_place[:, lanes, : int(s.num_spots.max())].transpose(0, 2, 1).copy()  # (2, S, n)
    lit, rim = overlay(tables.disks.at(*key), tables.rims, key, s.rim[lanes])
    return lit.view(np.uint16), None if rim is None else rim.view(np.uint16)


def overlay(
    disks: np.ndarray, rims: Stencils, key: np.ndarray, rimmed: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """Lays spotlights over each other: what they light and, if any has a rim, which pixels those are, (n, words).

    disks: (S, n, words) each alone. rims, key: the table with their rims, and its keys (2, S, n). rimmed: (n,) bool.
    """
    lit = np.bitwise_or.reduce(disks, axis=0)
    if not np.count_nonzero(rimmed):
        return lit, None
    # A later spotlight covers the rims of the earlier ones, and its own rim covers their light.
    inner, rim = np.zeros((2, *lit.shape), np.uint64)
    for own_disk, own_rim in zip(disks, rims.at(*key), strict=True):
        inner, rim = (inner | own_disk) & ~own_rim, (rim & ~own_disk) | own_rim
    return np.where(rimmed[:, None], inner, lit), rim * rimmed[:, None]


def darken(
    s: State,
    lanes: np.ndarray | slice,
    frames: np.ndarray,
    lit: np.ndarray,
    rim: np.ndarray | None,
    dim: np.ndarray,
) -> None:
    """Lays the darkness over the lanes' frames, (n, FRAME), in place.

    lit: (n, FRAME) mask of what it leaves out. rim: (n, 588) mask of what of it is white, or None.
    dim: those of the n lanes where it is not just black.
    """
    if dim.size:
        who = dim if isinstance(lanes, slice) else lanes[dim]
        opacity = s.darkness[who, np.minimum(s.length[who], FADE - 1)].astype(np.uint16)[:, None]
        bright = frames[dim].astype(np.uint16)
        # What is left is rounded up, as what the original takes away is rounded down.
        veiled = bright * (255 - opacity)
        veiled += 254
        veiled //= 255
        if rim is not None:
            np.copyto(veiled, bright + (255 - bright) * opacity // 255, where=pixels(rim[dim]) > 0)
        veiled = veiled.astype(np.uint8)
        veiled &= ~lit[dim]
    frames &= lit
    if dim.size:
        frames[dim] |= veiled


# ---- vectors ----

# All that a vector says of what is below the bar comes from every third pixel, by its colour.
FAINT = 252  # the darkest dark in which an agent, (3, 3, 2) there, still differs from white floor
SLIGHT = 5  # and the darkest one in which some colours may stay as they are
FIRST_RIM = 51  # from there on a rim differs from all colours that it runs over, if only by 1
ROWS_BELOW = np.where(np.arange(0, SCREEN, SAMPLE_STEP) < TOP_BAR, 0, FULL_ROW).astype(
    np.uint64
)  # (42,) the sample below the bar
TILE_SHARE = 1 / tile_counts(ROWS_BELOW[None]).astype(np.float32)  # (1, 49)
FULL_SHARE = TILE_SHARE.min()  # of a tile beside the bar
BLUE_SAMPLE = sample((floors()[BLUE_FLOOR].reshape(SCREEN, SCREEN, 3) == BLUE).all(axis=-1))  # (42,) or red ones
NO_BITS = np.uint64(0)
READING = slice(0, 8)  # the entries that come from the bar
# By opacity: (256, 2) all bits where the darkness changes nothing, and where it hides nothing; and, where only the
# latter is true, how bright the floor is, (256,).
VEIL = (np.arange(256)[:, None] <= (SLIGHT, FAINT)) * FULL_ROW
DUSK = ((1 - np.arange(256) / 255) * (VEIL[:, 1] > VEIL[:, 0])).astype(np.float32)


@cache
def readings(endless: bool) -> np.ndarray:
    """(4 * BARS_PER_CHOICE, 8) float32, read-only: what each of bars() says."""
    table = read_bars(bars(endless).reshape(-1, SCREEN, 3))
    table.flags.writeable = False
    return table


def read_bars(bar: np.ndarray) -> np.ndarray:
    """Health, horizontal and vertical action, reward: (n, 84, 3) uint8 -> (n, 8) float32."""
    half, quarter = SCREEN // 2, SCREEN // 4
    green, yellow, *actions = ((bar == color).all(axis=-1) for color in (GREEN, YELLOW, *ACTION_COLORS))  # (n, 84)
    across = [where[:, half : half + quarter].any(axis=1) for where in actions]
    down = [where[:, half + quarter :].any(axis=1) for where in actions]
    entries = [green[:, :half].mean(axis=1), *across, *down, yellow[:, half:].any(axis=1)]
    return np.stack(entries, axis=1).astype(np.float32)


class VectorTables(NamedTuple):
    """The tables that vectors are made of. Bodies are the agent, the exit (not in the endless id) and the coins."""

    width: int  # of a vector
    at: dict[str, slice]  # where its entries are
    places: slice  # where those on the bodies' places are
    bars: np.ndarray
    readings: np.ndarray
    shapes: Stencils  # samples: spotlights by radius, figures in all facings, a coin, an exit and a door for each scale
    rims: Stencils  # samples of spotlights' outlines
    high: Stencils  # masks of the bar's rows with the same shapes
    key: np.ndarray  # (K + 1, N) where the lanes' bodies are in those tables, and then the exit's door
    bodies: np.ndarray  # (K + 1,) their numbers in State.bodies. Without exits there is no door: both are (K, ...) then
    coin: int  # which of the bodies is the first coin
    has_hands: np.ndarray  # (N,) bool: the agent has hands, which show its facing


@lru_cache(maxsize=16)
def vector_shapes(
    least: int, largest: int, figure_scales: tuple[float, ...], scales: tuple[tuple[float, float], ...]
) -> tuple[Stencils, Stencils, Stencils]:
    """VectorTables' shapes, rims and high. Cached: environments with equal options share them."""
    disks, rims = spot_shapes(least, largest)
    figures = [solid for scale in figure_scales for solid in sprites(scale)[1]]
    images, solids = draw_coins_and_exits(scales)
    # An exit's frame is as black as the dark, so what can be seen of it is its door.
    things = [each for i in range(0, len(solids), 3) for each in (*solids[i : i + 2], images[i + 1].any(axis=-1))]
    shapes = disks + figures + things
    return samples(shapes), samples(rims), stencils(shapes, TOP_BAR)


class FrameSamples(NamedTuple):
    """n lanes' frames as samples, (n, 42) uint64 each, and the K bodies in them."""

    opacity: np.ndarray  # (n,) of the darkness
    lit: np.ndarray  # what it leaves out
    clear: np.ndarray  # what it does not hide
    rim: np.ndarray | None  # what of the light is white, if any lane has rims
    x: np.ndarray  # (K, n) where the bodies are, as keys of VectorTables.shapes
    y: np.ndarray  # (K, n)
    raised: np.ndarray  # (m,) which of the frames have bodies above the darkness
    layer: np.ndarray | None  # (K, m, 1) where those are: UNDER it, BELOW_BAR or ABOVE_BAR
    cover: np.ndarray  # (K, n, 42) what each body covers
    seen: np.ndarray  # (K, n, 42) what is visible of it
    floor: np.ndarray  # what nothing covers


def make_vectors(s: State, g: VectorTables, lanes: np.ndarray | slice) -> np.ndarray:
    """The vectors of the lanes, (n, V) float32, from the state alone. No frame is drawn.

    They are made of the colours of the bar and of every third pixel below it, so that equal frames have equal vectors.
    """
    sampled = sample_frames(s, g, lanes)
    out = np.zeros((len(sampled.lit), g.width), np.float32)
    write_bar(s, g, lanes, sampled, out)
    write_rest(s, g, lanes, sampled, out)
    return out


def sample_frames(s: State, g: VectorTables, lanes: np.ndarray | slice) -> FrameSamples:
    """The lanes' frames as samples."""
    place, each = s.spot_place[:, lanes, : int(s.num_spots.max())], np.arange(len(s.pos))[lanes]
    spots, has_exit = place.shape[2], g.coin == COIN
    key = np.empty((2, spots + len(g.key), len(each)), np.int64)
    key[:, :spots] = place.transpose(0, 2, 1)
    np.add(s.bodies[:, lanes].transpose(0, 2, 1)[:, g.bodies], g.key[:, lanes], out=key[:, spots:])
    key[:, spots + AGENT] += s.drawn_facing[lanes] * PLACES
    shapes = g.shapes.at(*key)  # (S + K + 1, n, 42)
    lit, rim = overlay(shapes[:spots], g.rims, key[:, :spots], s.rim[lanes])
    opacity = s.darkness[each, np.minimum(s.length[lanes], FADE - 1)]
    veil = VEIL.take(opacity, axis=0)  # (n, 2)
    lit |= veil[:, :1]
    clear = lit | veil[:, 1:]
    bodies, (raised, layer) = slice(spots, -1 if has_exit else None), layers(s, g, lanes)
    cover = shapes[bodies]
    seen, floor = visible_parts(cover, clear)
    if layer is not None:
        seen[:, raised], floor[raised] = visible_parts_in_layers(cover[:, raised], clear[raised], layer)
    if has_exit:
        seen[EXIT] &= shapes[-1]
    x, y = key[:, bodies]
    return FrameSamples(opacity, lit, clear, rim, x, y, raised, layer, cover, seen, floor)


def layers(s: State, g: VectorTables, lanes: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray | None]:
    """FrameSamples' raised and layer."""
    coins = s.coin_age[lanes] < s.coin_show_limit[lanes]
    (raised,) = (coins | s.layered[lanes]).nonzero()
    if not raised.size:
        return raised, None
    others = [s.agent_layer[lanes], s.exit_layer[lanes]][: g.coin]
    every = others + [coins * BELOW_BAR] * (s.bodies.shape[2] - COIN)
    return raised, np.array([layer[raised] for layer in every])[..., None]


def visible_parts(cover: np.ndarray, clear: np.ndarray, left: Any = ROWS_BELOW) -> tuple[np.ndarray, np.ndarray]:
    """What is visible of bodies and of the floor behind them, (K, n, 42) and (n, 42).

    cover: (K, n, 42) what the bodies cover, from front to back. clear: (n, 42). left: (42,) what nothing covers so far.
    """
    seen = np.empty_like(cover)
    for body, shown in zip(cover, seen, strict=True):
        np.bitwise_and(body, left, out=shown)
        left = left ^ shown
    seen &= clear
    return seen, left


def visible_parts_in_layers(cover: np.ndarray, clear: np.ndarray, layer: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same where some of the bodies are above the darkness, and before all others. layer: (K, n, 1)."""
    above = np.where(layer == UNDER, NO_BITS, cover)
    free = ~np.bitwise_or.reduce(above, axis=0)
    seen_above, _ = visible_parts(above, np.where(layer == ABOVE_BAR, FULL_ROW, ROWS_BELOW), FULL_ROW)
    seen_below, floor = visible_parts(cover ^ above, clear & free)
    return seen_above | seen_below, floor & free


def write_bar(s: State, g: VectorTables, lanes: np.ndarray | slice, sampled: FrameSamples, out: np.ndarray) -> None:
    """Writes health, action and reward."""
    senses = bar_rows(s, lanes)
    out[:, READING] = g.readings.take(senses, axis=0)
    if sampled.layer is not None and (sampled.layer == ABOVE_BAR).any():
        high, over_bar = sampled.raised, sampled.layer == ABOVE_BAR  # (m,), (K, m, 1)
        cover = g.high.at(sampled.x[:, high], sampled.y[:, high]) * over_bar  # (K, m, words)
        left = ~np.bitwise_or.reduce(cover, axis=0).view(np.uint16).reshape(-1, TOP_BAR, ITEMS)
        columns = unpacked(np.bitwise_or.reduce(left, axis=1))  # (m, 84) those of which anything is left
        out[high, READING] = read_bars(g.bars[senses[high]].reshape(-1, SCREEN, 3) * columns[..., None])


def write_rest(s: State, g: VectorTables, lanes: np.ndarray | slice, sampled: FrameSamples, out: np.ndarray) -> None:
    """Writes the other entries."""
    cover, seen, (bodies, n, _) = sampled.cover, sampled.seen, sampled.seen.shape
    bright, visible, dusk = sampled.lit & sampled.floor, sampled.clear & sampled.floor, DUSK.take(sampled.opacity)
    if sampled.rim is not None:
        bright = np.where(s.rim[lanes][:, None], rims_left(sampled, sampled.rim), bright)
        dusk = dusk * ~s.rim[lanes]
    lines = np.empty((bodies + 3, n, SAMPLE_ROWS), np.uint64)
    lines[:bodies] = seen
    np.bitwise_and(cover[AGENT] & ROWS_BELOW, ~seen[AGENT], out=lines[bodies])
    np.bitwise_xor(visible, bright, out=lines[bodies + 1])
    np.bitwise_and(visible, BLUE_SAMPLE, out=lines[bodies + 2])
    any_ = np.bitwise_or.reduce(lines, axis=2) != 0  # (K + 3, n)
    out[:, g.at["dusk"].start] = dusk * any_[-2]
    out[:, g.at["alarm"].start] = (s.floor & s.reddens)[lanes] * any_[-1]
    write_places(g, seen, any_[:bodies], out)
    (whole,) = (any_[AGENT] & ~any_[bodies] & g.has_hands[lanes]).nonzero()
    out[whole, g.at["facing"].start + s.drawn_facing[lanes][whole]] = 1
    if "exit" in g.at:
        out[:, g.at["exit_open"].start] = s.is_open[lanes] * any_[EXIT]
    write_tiles(g, seen, any_[:bodies], bright, out)


def write_places(g: VectorTables, seen: np.ndarray, any_: np.ndarray, out: np.ndarray) -> None:
    """Writes how much of the bodies is visible and where that is. any_: (K, n) whether any is."""
    (bodies, n), kinds = any_.shape, g.coin + 1
    body, lane = any_.nonzero()
    total = sums(seen[body, lane])  # (hits, 3)
    if bodies > kinds:
        each = np.zeros((bodies, n, 3), np.float32)
        each[body, lane] = total
        each[g.coin] = each[g.coin :].sum(axis=0)
        body, lane = each[:kinds, :, 0].nonzero()
        total = each[body, lane]
    total[:, 1:] /= SCREEN * total[:, :1]
    np.minimum(total[:, 0] * FULL_SHARE, 1, out=total[:, 0])
    out[:, g.places].reshape(n, kinds, 3)[lane, body] = total


def write_tiles(g: VectorTables, seen: np.ndarray, any_: np.ndarray, bright: np.ndarray, out: np.ndarray) -> None:
    """Writes which share of each tile shows light and coins (not in the endless id). any_: (K, n) whether any shows."""
    if "coins" not in g.at:
        out[:, g.at["light"]] = tile_counts(bright) * TILE_SHARE
        return
    lanes = np.flatnonzero(any_[g.coin :].any(axis=0))
    coins = np.bitwise_or.reduce(seen[g.coin :, lanes], axis=0)
    share = tile_counts(np.concatenate([bright, coins])) * TILE_SHARE
    out[:, g.at["light"]], out[lanes, g.at["coins"]] = share[: len(bright)], share[len(bright) :]


def rims_left(sampled: FrameSamples, rim: np.ndarray) -> np.ndarray:
    """What is visible of these rims, (n, 42): of any in a dark that is dark enough, and over all that is under it."""
    rim = rim & ROWS_BELOW & -(sampled.opacity >= FIRST_RIM)[:, None].astype(np.uint64)
    if sampled.layer is not None:
        above = np.where(sampled.layer == UNDER, NO_BITS, sampled.cover[:, sampled.raised])
        rim[sampled.raised] &= ~np.bitwise_or.reduce(above, axis=0)
    return rim


# ---- rules ----


def spot_places(spots: np.ndarray) -> np.ndarray:
    """Where spotlights (11, N, S) are on their ways, x and y in pixels: (2, N, S) float64."""
    place = spots[TIME] * spots[BEND]
    place += spots[TOWARD]
    place *= spots[TIME]
    place += spots[START]
    return place


def remove_finished(s: State) -> tuple[np.ndarray, np.ndarray]:
    """Removes the spotlights that are through: lanes and slots, each (n,), of those that pause for this step.

    The original removes them from the list that it is walking, so the one behind each is skipped: it neither moves nor
    shines in that step.
    """
    lanes, slots = [], []
    for lane in np.flatnonzero((s.spots[TIME] >= 1.0).any(axis=1)).tolist():
        through = s.spots[TIME, lane] >= 1.0
        kept, pausing, at = list(range(int(s.num_spots[lane]))), [], 0
        while at < len(kept):
            if through[kept[at]]:
                del kept[at]
                pausing += kept[at : at + 1]
            at += 1
        left = len(kept)
        s.spots[:, lane, :left], s.spot_key[lane, :left] = s.spots[:, lane, kept], s.spot_key[lane, kept]
        s.spots[:, lane, left:], s.spot_key[lane, left:] = NO_SPOT[:, None], NO_KEY
        s.num_spots[lane] = left
        slots += [kept.index(each) for each in pausing]
        lanes += [lane] * len(pausing)
    return np.array(lanes, np.intp), np.array(slots, np.intp)


def take_damage(s: State, lanes: np.ndarray) -> np.ndarray:
    """Damages the agents of these lanes; (n,) bool whose health is gone."""
    s.health[lanes] -= s.damage[lanes]
    s.floor[lanes] += 1
    lost = 1 - s.health[lanes] / s.full_health[lanes]
    # Cut off to whole pixels, and to the last 32 bits, as in the original, which draws nothing if those are negative.
    width = (SCREEN // 2 * lost).astype(np.int64).astype(np.int32)
    s.lost_width[lanes] = np.maximum(s.lost_width[lanes], np.minimum(width, SCREEN))
    return s.health[lanes] <= 0


def take_coins(s: State, lane: int, touched: np.ndarray) -> int:
    """Takes the lane's coins that are touched, (B,) bool, and returns how many those are."""
    taken, skip = 0, False
    for coin in np.flatnonzero(s.bodies[0, lane, COIN:] != GONE) + COIN:
        if skip:  # the coin behind a taken one is skipped for this step, as in the original
            skip = False
        elif touched[coin]:
            s.bodies[:, lane, coin] = GONE
            taken, skip = taken + 1, True
    s.coins_left[lane] -= taken
    s.is_open[lane] = s.coins_left[lane] == 0
    s.collected[lane] += taken
    update_targets(s, lane)
    return taken


class SearingSpotlights(MemoryGymVectorEnv):
    """Searing Spotlights (thesis 4.5): collect coins and leave in the dark, away from wandering spotlights.

    ## Description

    The light goes out in the first steps. Spotlights wander over the dark screen and show what is in them; each step in
    one costs the agent health. It has to collect the coins and to leave through the exit, which opens then, all from
    memory: of where things were, and of where it has been walking to since it was last seen. A bar at the top shows
    health, the action before the last, and whether the step before the last was rewarded.

    - `SearingSpotlights-v0`: one coin and the exit; a new spotlight every 40 steps.
    - `Endless-SearingSpotlights-v0`: one coin after the other, each visible for a moment and to be collected within 160
      steps; a new spotlight every 50 steps, twice the health, no exit.

    ## Action Space

    `MultiDiscrete([3, 3])`:

    | value | horizontal | vertical |
    |---|---|---|
    | 0 | none | none |
    | 1 | left | up |
    | 2 | right | down |

    ## Observation Space

    `Box(0, 255, (84, 84, 3), uint8)`, rows first. With obs_type="vector" a flat float32 vector: `docs/vectors.md`,
    `VARIANTS[id].entries`.

    ## Rewards

    `reward_coin` (0.25) for a coin, `reward_exit` (1) for leaving, and in every step `reward_inside_spotlight` or
    `reward_outside_spotlight` (both 0); `reward_death` (0) is added when no health is left.

    ## Episode End

    Terminated when no health is left, by leaving, without an exit by the last coin; in the endless id by
    `steps_per_coin` steps without a coin. Truncated after `max_steps` steps, unless it ends at that very step. An agent
    that knows everything needs 14 to 63 steps for the finite task, 33 on average (table 4.5).

    ## Info

    `ground_truth` (6,): x and y of the agent, of the first coin left and of the exit; the endless id (4,) without the
    exit. In pixels over 84, so an agent that starts outside the screen has up to 86 / 84; 0 for what is not there. At
    an episode's end also `reward`, `length`, `agent_health` (share left, negative if the last hit took more than that),
    `coins_collected` (a share, 1 if there were none; in the endless id a number), and `success` but in the endless id.

    ## Arguments

    `gym.make(id, ...)` and `gym.make_vec(id, num_envs=N, ...)` take

    | name | default | meaning |
    |---|---|---|
    | `render_mode` | None | "rgb_array": what the agent sees; "debug_rgb_array": 336 x 336, with the ground truth |
    | `num_levels`, `start_level` | None, 0 | resets without a seed play one of so many levels, from the first on |
    | `obs_type` | "pixels" | or "vector" |
    | `options` | None | reset parameters that are the environment's defaults |
    | `max_episode_steps` | None | truncates longer episodes |
    | `autoreset_mode` | SAME_STEP | of `make_vec` alone: when an episode that ended is reset |

    `reset(options={...})` takes the same reset parameters, a single environment for one episode. `docs/options.md` and
    `VARIANTS[id].options` list them. Those marked * are lists, one entry of which is sampled at every reset.
    Radii and speeds of spotlights are sampled between their smallest and largest.

    ## Version History

    - v0: as in memory-gym 1.0.2, but for what follows.

    ## References

    Marco Pleines: Memory-based Deep Reinforcement Learning in Endless Imperfect Information Games. Dissertation, TU
    Dortmund University. Marco Pleines, Matthias Pallasch, Frank Zimmer, Mike Preuss: Memory Gym, arXiv:2309.17207.

    ## Kept from the original, and differences

    Kept from the original: the bar shows the action and the reward of the step before the last. A spotlight behind one
    that is removed skips that step, and so does a coin behind a taken one when several are touched at once. The wait
    for the next spotlight is always the first of the planned intervals, as the last is what a spawn removes; so
    spawn_interval_decay changes nothing, and neither does reward_max_steps. All coins but the first are a step old when
    they are first shown, so in the dark they are seen in one frame less than `coin_show_duration` says. Radii of
    spotlights are whole pixels, from spot_min_radius to spot_max_radius, both rounded down. The agent may start under
    the bar or outside the screen and steps inside with its first step; before that it is drawn facing up, and no
    spotlight shines. Dying at the exit is no success, though it pays. An endless task's coin may appear on the agent.
    Small coins (scale below 0.5) are all rim and small exits all frame. What is visible in the dark is drawn above the
    bar or below it, depending on what else is.
    Differences from the original: images are rows first; max_steps truncates; the finite id reports ground truth;
        nothing that an episode drew or painted black or white shows in the next; no exit, no coins and a hidden action
        bar work; the share of no coins is 1, not NaN; coins for which no free pixel is left are put anywhere; a
        smallest radius or speed above the largest replaces it; `coin_enabled` is new; wrong options raise ValueError.
    """

    variants = VARIANTS
    tables = ("_agent_tables", "_drawing", "_vector_tables")
    growing = ("bodies", "touch_squared", "spots", "spot_key", "spot_place")
    truth_high = (SCREEN + 2) / SCREEN  # an agent may start that far outside of the screen
    kept = (*MemoryGymVectorEnv.kept, "_unlocked")

    def spaces(self) -> tuple[gym.Space, gym.Space]:
        """The observation space of one lane with pixels, and its action space."""
        return gym.spaces.Box(0, 255, (SCREEN, SCREEN, 3), np.uint8), gym.spaces.MultiDiscrete([3, 3])

    def allocate(self) -> None:
        """Makes the state of N lanes."""
        self.state = empty_state(self.num_envs)
        self._number_sprites()
        self._unlocked: list[int] = []  # lanes without coins, whose exits open in the first step
        self.place_tables()

    def configure(self, lanes: np.ndarray) -> None:
        """Takes over the options of the lanes, and the tables that all lanes' options need."""
        s, endless, values = self.state, self.variant.endless, self.settings[int(lanes[0])]
        make_room(s, coins=1 if endless else max((1, *values["num_coins"])))
        for field, name in RULES.items():
            getattr(s, field)[lanes] = values.get(name, 0)
        s.step_limit[lanes] = _limit(values["max_steps"])
        s.coin_limit[lanes] = _limit(values["steps_per_coin"] if endless and values["coin_enabled"] else -1)
        s.coin_show_limit[lanes] = NO_LIMIT if values["coins_visible"] else _limit(values.get("coin_show_duration", 0))
        waits = ("spawn_interval",) if endless else ("initial_spawn_interval", "spawn_interval_threshold")
        s.spawn_interval[lanes] = max(1, sum(values[name] for name in waits))
        radius = radius_of(values["agent_scale"])
        coin, exit_ = int(10 * values["coin_scale"]), 10 * values.get("exit_scale", 0.0)
        s.touch_squared[lanes, COIN:], s.touch_squared[lanes, EXIT] = (coin + radius) ** 2, (exit_ + radius) ** 2
        s.touch_squared[lanes, AGENT] = -1.0
        self._configure_pictures(lanes, values)
        self._number_sprites()
        self.place_tables()

    def _configure_pictures(self, lanes: np.ndarray, values: dict[str, Any]) -> None:
        s = self.state
        plain = WHITE_FLOOR if values["hide_chessboard"] else BLUE_FLOOR
        alarm = RED_FLOOR if plain == BLUE_FLOOR and values["visual_feedback"] else plain
        s.rim[lanes] = values["black_background"]
        s.floors[lanes] = BLACK_FLOOR if values["black_background"] else (plain, alarm)
        s.darkness[lanes] = fading = _fading(values["light_dim_off_duration"], values["light_threshold"])
        # A rim is drawn like dimmed pixels are, so with rims the darkness is never just black.
        opaque = np.flatnonzero(fading == 255)
        s.dark_at[lanes] = opaque[0] if opaque.size and not values["black_background"] else NO_LIMIT
        s.reddens[lanes] = s.floors[lanes[0], 1] == RED_FLOOR
        shown = values["show_last_action"] + 2 * values["show_last_positive_reward"]
        s.first_bar[lanes] = shown * BARS_PER_CHOICE
        exit_, coins = values.get("exit_visible", False), values["coins_visible"]
        # The original inserts the surfaces at places in a list that depend on each other.
        s.exit_layer[lanes] = (BELOW_BAR if coins else ABOVE_BAR) if exit_ else UNDER
        s.agent_layer[lanes] = (BELOW_BAR if coins and exit_ else ABOVE_BAR) if values["agent_visible"] else UNDER
        s.layered[lanes] = exit_ or values["agent_visible"]

    def _number_sprites(self) -> None:
        """Numbers the different figures, coins and exits of all lanes' options."""
        figures, scales = zip(*((_figures(each), _scales(each)) for each in self.settings), strict=True)
        self.figures, self.scales = tuple(dict.fromkeys(figures)), tuple(dict.fromkeys(scales))
        # Each figure is there twice: the bar makes the ground less high than it is wide.
        self.state.figure[:] = [2 * self.figures.index(figure) for figure in figures]
        self.state.coin_sprite[:] = [3 * self.scales.index(scale) for scale in scales]

    def place_tables(self) -> None:
        """The tables that step() looks things up in, and where each lane's rows start in them."""
        self._agent_tables = agent_tables(tuple(figure for pair in self.figures for figure in pair))
        every = [values[name] for values in self.settings for name in ("spot_min_radius", "spot_max_radius")]
        radii, endless = (int(min(every)), int(max(every))), self.variant.endless
        scratch = pixel_scratch(self.num_envs)
        self._drawing = DrawingTables(
            spot_stencils(*radii), self._agent_tables.sheet, coin_and_exit_sheet(self.scales), bars(endless), scratch
        )
        if self.obs_type == "vector":
            self._vector_tables = self._make_vector_tables(*radii)
        self._controls = free_controls()
        self._calm = np.arange(0, 2 * self.num_envs, 2)  # (N,) the scenery's calm rows
        self._lane_walk = (self.state.figure[:, None] + np.arange(2)) * (STRIDES * SPAN)  # (N, 2)

    def _make_vector_tables(self, least: int, largest: int) -> VectorTables:
        """The tables that vectors are made of, for spotlights of these radii."""
        s, figures = self.state, tuple(across.scale for across, _ in self.figures)
        coins = s.bodies.shape[2] - COIN
        first = largest + 1 + len(figures) * FACINGS + s.coin_sprite  # (N,) the coin, before the exit and the door
        key = [largest + 1 + s.figure // 2 * FACINGS, first + 1, *[first] * coins, first + 2]
        bodies = [AGENT, EXIT, *range(COIN, COIN + coins), EXIT]
        if self.variant.endless:
            key, bodies = key[:-1:COIN], bodies[:-1:COIN]
        shapes, rims, high = vector_shapes(least, largest, figures, self.scales)
        at = vector_slices(self.variant.entries)
        return VectorTables(
            width=at["alarm"].stop,
            at=at,
            places=slice(at["agent"].start, at["coin"].stop),
            bars=bars(self.variant.endless),
            readings=readings(self.variant.endless),
            shapes=shapes,
            rims=rims,
            high=high,
            key=np.stack(key) * PLACES + PLACE_0,
            bodies=np.array(bodies),
            coin=1 if self.variant.endless else COIN,
            has_hands=np.array([int(10 * values["agent_scale"]) > 0 for values in self.settings]),
        )

    def begin(self, lanes: np.ndarray) -> None:
        """Samples the lanes' next levels and starts their episodes."""
        for lane in lanes.tolist():
            values = self.settings[lane]
            spawns = NO_LIMIT if self.variant.endless else _limit(values["num_spawns"])
            level = sample_level(self._rngs[lane], values, self.variant)
            write_level(self.state, lane, level, spawns)
            self._draw_scenery(lane)
            if not level.coins:
                self._unlocked.append(lane)

    def advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One step of the rules: walk, spawn, shine, burn, collect, leave."""
        s = self.state
        s.length += 1
        self._move(actions)
        while self._unlocked:
            lane = self._unlocked.pop()
            s.is_open[lane] = s.coins_left[lane] == 0
            self._draw_scenery(lane)
        s.spawn_wait -= 1
        due = s.spawn_wait == 0
        if np.count_nonzero(due):
            for lane in np.flatnonzero(due).tolist():
                self._spawn(lane)
        hit = self._move_spots()
        rewards, terminated, s.floor = s.reward_outside.copy(), np.zeros(self.num_envs, bool), self._calm.copy()
        if np.count_nonzero(hit):
            lanes = np.flatnonzero(hit)
            terminated[lanes] = dead = take_damage(s, lanes)
            rewards[lanes] = s.reward_inside[lanes] + s.reward_death[lanes] * dead
        gap = s.bodies - s.bodies[:, :, :1]  # (2, N, B)
        gap *= gap
        touched = gap[0] + gap[1] <= s.touch_squared
        if np.count_nonzero(touched):
            self._collect(touched, rewards)
            if not self.variant.endless:
                self._leave(touched, rewards, terminated)
        return rewards, terminated, self._finish(rewards, terminated)

    def _move(self, actions: np.ndarray) -> None:
        s = self.state
        action = actions[:, 0] * 3 + actions[:, 1]  # (N,)
        s.shown_action, s.last_action = s.last_action, action
        s.facing, s.pos = walk(s.facing, s.pos, action, self._lane_walk, self._controls, self._agent_tables.walk)
        s.drawn_facing = s.facing
        np.subtract(s.pos.T, PAD, out=s.bodies[:, :, AGENT])

    def _spawn(self, lane: int) -> None:
        """Adds a spotlight to the lane's."""
        s = self.state
        add_spot(s, lane, sample_spot(self._rngs[lane], self.settings[lane]))
        s.spawns_left[lane] -= 1
        # Always the first interval of the original's list, as its spawns remove the last one.
        s.spawn_wait[lane] = s.spawn_interval[lane] if s.spawns_left[lane] else NO_LIMIT

    def _move_spots(self) -> np.ndarray:
        """Moves the spotlights on; (N,) bool whose agent is in the light."""
        s = self.state
        pausing = remove_finished(s) if np.count_nonzero(s.spots[TIME] >= 1.0) else None
        time = s.spots[TIME]  # (N, S)
        spot = spot_places(s.spots)  # (2, N, S)
        place = spot.astype(np.int64)
        place += s.spot_key
        spot -= s.bodies[:, :, :1]
        spot *= spot
        distance = spot[0] + spot[1]  # (N, S) squared
        if pausing is None:
            time += s.spots[SPEED]
        else:
            held = time[pausing]
            time += s.spots[SPEED]
            time[pausing], distance[pausing], place[(ALL, *pausing)] = held, np.inf, 0
        s.spot_place, s.near_light = place, (distance <= s.spots[SIGHT]).any(axis=1)
        return (distance <= s.spots[REACH]).any(axis=1) if np.count_nonzero(s.near_light) else s.near_light

    def _collect(self, touched: np.ndarray, rewards: np.ndarray) -> None:
        """Takes the coins that are touched, (N, B) bool; the endless id then has a new one."""
        s = self.state
        for lane in np.flatnonzero(touched[:, COIN:].any(axis=1)).tolist():
            last = tuple(s.bodies[:, lane, COIN].tolist())
            rewards[lane] += s.reward_coin[lane] * take_coins(s, lane, touched[lane])
            if self.variant.endless:
                s.bodies[:, lane, COIN] = sample_coin(words(self._rngs[lane]), last)
                s.coins_left[lane], s.coin_age[lane] = 1, 0
                update_targets(s, lane)
            self._draw_scenery(lane)

    def _leave(self, touched: np.ndarray, rewards: np.ndarray, terminated: np.ndarray) -> None:
        """Ends the episodes whose agent stands at the open exit or, without one, has just taken the last coin."""
        s = self.state
        has_exit = s.bodies[0, :, EXIT] != GONE
        done = (s.coins_left == 0) & np.where(has_exit, touched[:, EXIT], s.num_coins > 0)
        rewards += s.reward_exit * (done & has_exit)
        s.success[:] = done & ~terminated
        terminated |= done

    def _finish(self, rewards: np.ndarray, terminated: np.ndarray) -> np.ndarray:
        """Counts the step; (N,) bool which episodes are truncated."""
        s = self.state
        if self.variant.endless:
            s.coin_age += 1
            terminated |= s.coin_age == s.coin_limit
        s.shown_gain, s.last_gain = s.last_gain, (rewards > 0) + 1
        s.episode_return += rewards
        return (s.length == s.step_limit) & ~terminated

    def _draw_scenery(self, lane: int) -> None:
        """Draws the lane's scenery again, unless nothing but frames() needs it."""
        if self.obs_type == "pixels":
            draw_scenery(self.state, self._drawing, lane)

    def frames(self, lanes: np.ndarray | slice) -> np.ndarray:
        """Fresh frames of the lanes, (n, 84, 84, 3)."""
        if self.obs_type == "vector":
            for lane in np.arange(self.num_envs)[lanes].tolist():
                draw_scenery(self.state, self._drawing, lane)
        return draw(self.state, self._drawing, lanes)

    def vectors(self, lanes: np.ndarray | slice) -> np.ndarray:
        """Fresh vector observations of the lanes, (n, V) float32: see VARIANTS[id].entries."""
        return make_vectors(self.state, self._vector_tables, lanes)

    def ground_truth(self) -> np.ndarray:
        """A fresh (N, 6), or (N, 4) in the endless id: the agent's, the coin's and the exit's x and y, over 84."""
        s = self.state
        truth = np.empty((self.num_envs, 4 if self.variant.endless else 6))
        truth[:, :2] = s.bodies[:, :, AGENT].T
        truth[:, 2:] = s.targets[:, : truth.shape[1] - 2]
        truth /= SCREEN
        return truth

    def summary(self, lanes: np.ndarray) -> dict[str, np.ndarray]:
        """The lanes' ended episodes in numbers."""
        s = self.state
        numbers = {"reward": s.episode_return[lanes], "length": s.length[lanes]}
        numbers["agent_health"] = (s.health / s.full_health)[lanes]
        if self.variant.endless:
            return numbers | {"coins_collected": s.collected[lanes]}
        coins = s.num_coins[lanes]
        share = np.where(coins > 0, s.collected[lanes] / np.maximum(coins, 1), 1.0)
        return numbers | {"coins_collected": share, "success": s.success[lanes]}

    def annotate(self, frame: np.ndarray, lane: int) -> None:
        """Lights everything below the bar, and circles the spotlights."""
        s, lanes = self.state, np.array([lane])
        lit = draw_in_full_light(s, self._drawing, lanes, True)
        below = slice(TOP_BAR * DEBUG_ZOOM, None)
        frame[below] = magnify(lit.reshape(SCREEN, SCREEN, 3), DEBUG_ZOOM)[below]
        for slot in np.flatnonzero(s.spot_place[0, lane]).tolist():
            radius = int(s.spots[RADIUS, lane, slot])
            x, y = (s.spot_place[:, lane, slot] - radius * PLACES - PLACE_0).tolist()
            circle = ring(len(frame), x * DEBUG_ZOOM, y * DEBUG_ZOOM, radius * DEBUG_ZOOM, DEBUG_ZOOM)
            circle[: TOP_BAR * DEBUG_ZOOM] = False
            frame[circle] = GREEN


# What the rules take over from the options as it is.
RULES = {
    "full_health": "agent_health",
    "damage": "spot_damage",
    "reward_inside": "reward_inside_spotlight",
    "reward_outside": "reward_outside_spotlight",
    "reward_death": "reward_death",
    "reward_coin": "reward_coin",
    "reward_exit": "reward_exit",
}


def _limit(steps: int) -> int:
    return NO_LIMIT if steps == -1 else steps


def _fading(duration: int, threshold: int) -> np.ndarray:
    """(FADE,) uint8: the darkness' opacity after so many steps."""
    if not duration:
        return np.full(FADE, threshold, np.uint8)
    opacity = [0]
    while len(opacity) < FADE:  # the last addition may pass the threshold, as in the original
        opacity.append(min(255, opacity[-1] + 255 // duration) if opacity[-1] <= threshold else opacity[-1])
    return np.array(opacity, np.uint8)


def _figures(values: dict[str, Any]) -> tuple[Figure, Figure]:
    """The agent's figure as it walks across and as it walks down, where the bar is in its way."""
    scale, speed = values["agent_scale"], values["agent_speed"]
    across, down = (Figure(scale, speed, low, SCREEN, radius_of(scale), False) for low in (0, TOP_BAR))
    return across, down


def _scales(values: dict[str, Any]) -> tuple[float, float]:
    return values["coin_scale"], values.get("exit_scale", values["coin_scale"])
