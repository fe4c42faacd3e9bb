"""Mystery Path: find a hidden path by trial, and remember it when a false step leads back to its origin (thesis 4.4).

Shape letters: N lanes, n some of them, M cells of the map, P steps of the path that fit, K of them drawn, S segments.
"""

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from memory_gym_envs.appearance import (
    LARGEST_RADIUS,
    AppearanceTables,
    View,
    agent_entries,
    covered,
    make_appearance_tables,
    write_agent_entries,
)
from memory_gym_envs.base import DEBUG_ZOOM, NO_LIMIT, MemoryGymVectorEnv, numbered, widened
from memory_gym_envs.character import (
    FACINGS,
    PAD,
    SPAN,
    STRIDES,
    Figure,
    agent_tables,
    free_controls,
    grid_controls,
    radius_of,
    sprites,
    walk,
)
from memory_gym_envs.drawing import FRAME, ROW, SCREEN, Sheet, magnify, make_sheet, paste, stamp
from memory_gym_envs.entries import Entries, vector_slices
from memory_gym_envs.options import Option
from memory_gym_envs.words import WordBuffer, below, pick

TILE = 12  # pixels
SIDE = 7  # tiles along one side of the screen, and of a segment of the endless path
SEGMENT = SIDE + 1  # columns of a segment with the transition tile behind it
FIRST_SEGMENTS = 3  # of an endless path; more are appended as the agent gets there

# A cell of the map is column * ROWS + PIT_ROWS + row, with rows of pit above and below the screen: in the endless id
# nothing holds the agent back there, and the largest and fastest gets nine tiles out.
PIT_ROWS = 9
ROWS = PIT_ROWS + SIDE + PIT_ROWS
MAP_STRIDES = np.array([ROWS, 1])

PIT = 0  # the step of the path at places that are none; the path's own steps count from 1, the origin
NO_CELL = -1  # the cell of that step
FAST = 14  # pixels: who walks further in a step can leave the stored positions
NO_STEP = -1  # where an agent is while it is put back
REACHED = -1  # of steps without a reward for reaching them first
TILE_AT = (np.arange(SPAN) - PAD) // TILE  # of stored positions on the screen
BRANCHES = np.array([3, 1])  # numbers the actions of two branches

EAST, NORTH, SOUTH, WEST = range(4)
DIRECTIONS = np.zeros(2 * ROWS + 1, np.int64)  # by the difference of two cells, counted from the end if negative
DIRECTIONS[[ROWS, -1, 1, -ROWS]] = EAST, NORTH, SOUTH, WEST


# ---- configuration ----


@dataclass(frozen=True)
class Variant:
    """What tells one Mystery Path id from another."""

    grid: bool  # turn and walk tile by tile, instead of free movement
    endless: bool  # a path without a goal, from left to right; no walking left, and stamina
    render_fps: int
    options: tuple[Option, ...]
    entries: tuple[Entries, ...]  # of a vector observation


def _options(grid: bool, endless: bool) -> tuple[Option, ...]:
    """The reset options of an id, in the original's order of names."""
    steps, progress = -1 if endless else 128 if grid else 512, 0.0 if grid else 0.1
    size, ignored = "size of the agent; 0.25: 12 pixels wide", "ignored, as in the original"
    origin = ignored if endless else "show the path's origin in blue"
    sides = "where the path starts: 0 left, 1 right, 2 top, 3 bottom"
    camera = "how many tiles from the screen's left edge the agent is drawn"
    rows = [
        (True, Option("max_steps", steps, "int", 1, None, "steps until truncation; -1: no limit", also=(-1,))),
        (True, Option("agent_scale", 0.25, "float", 0.04, 1.0, f"{size}; {ignored}" if grid else size)),
        (not grid, Option("agent_speed", 3.0, "float", 0.0, 84.0, "pixels that the agent walks in a step")),
        (not endless, Option("cardinal_origin_choice", (0, 1, 2, 3), "ints", 0, 3, f"{sides} *")),
        (True, Option("show_origin", False, "bool", None, None, origin)),
        (not endless, Option("show_goal", False, "bool", None, None, "show the path's goal in green")),
        (endless, Option("show_past_path", True, "bool", None, None, "show the path behind the agent in white")),
        (endless, Option("show_background", False, "bool", None, None, "show tiles that move as the agent walks")),
        (endless, Option("show_stamina", False, "bool", None, None, "show how much stamina is left")),
        (True, Option("visual_feedback", True, "bool", None, None, "show a red cross where the agent falls off")),
        (endless, Option("camera_offset_scale", 5.0, "float", 0.0, 5.5, camera)),
        (endless, Option("stamina_level", 20, "int", 1, None, "steps until the agent must have reached a new tile")),
        (not endless, Option("reward_goal", 1.0, "float", None, None, "reward for reaching the goal")),
        (True, Option("reward_fall_off", 0.0, "float", None, None, "reward for falling off the path")),
        (True, Option("reward_path_progress", progress, "float", None, None, "reward for each new tile of the path")),
        (True, Option("reward_step", 0.0, "float", None, None, "reward for every step")),
    ]
    return tuple(option for present, option in rows if present)


def _entries(endless: bool) -> tuple[Entries, ...]:
    """What a vector observation of an id is made of."""
    cross = Entries("cross", 1, "1: a red cross is seen, where the agent fell off")
    if not endless:
        places = [
            Entries(name, 2, f"the centre of the path's {name}, x and y, / 84 pixels; zeros: not shown, or hidden")
            for name in ("origin", "goal")
        ]
        return *agent_entries(0, SCREEN + LARGEST_RADIUS), cross, *places
    past = (
        "1: a tile of the path behind the agent shows, by column and then row; its left edge is in one of 8 columns of "
        "12 pixels, the first of which is left of the screen"
    )
    return (
        *agent_entries(-PAD, SPAN - 1 - PAD),
        cross,
        Entries("past", SEGMENT * SIDE, past),
        Entries("scroll", 1, "how far right of its column's left edge each of them starts, at most, / 12 pixels"),
        Entries("ground", 1, "one more than how far left the background has moved, / 12 pixels; 0: there is none"),
        Entries("bar", 1, "1: the stamina bar is there"),
        Entries("stamina", 1, "how much of it is green"),
    )


def _variant(fps: int, grid: bool = False, endless: bool = False) -> Variant:
    return Variant(grid, endless, fps, _options(grid, endless), _entries(endless))


VARIANTS = {
    "MysteryPath-v0": _variant(25),
    "MysteryPath-Grid-v0": _variant(3, grid=True),
    "Endless-MysteryPath-v0": _variant(25, endless=True),
}


# ---- state ----


@dataclass
class State:
    """One array a field, one row a lane. Positions are stored with PAD added, tiles count from the top left."""

    pos: np.ndarray  # (N, 2) the agent's centre, x and y; in the endless id x is counted along the path
    facing: np.ndarray  # (N,)
    figure: np.ndarray  # (N,) which of the batch's figures the agent is
    view: np.ndarray  # (N,) and which of its view options it has
    origin: np.ndarray  # (N, 2) where the agent starts and is put back to
    tile: np.ndarray  # (N, 2) the agent's tile, column and row
    path_step: np.ndarray  # (N,) the path's step at that tile, or PIT
    last_path_step: np.ndarray  # (N,) the path's step where the agent last was on the path
    next_direction: np.ndarray  # (N,) the direction of the tile after that
    fallen: np.ndarray  # (N,) bool: in the pit, and so put back at the next step
    path_length: np.ndarray  # (N,) steps of the path; the last one is the goal
    path_cell: np.ndarray  # (N, P) where each step of the path is, NO_CELL at first
    direction_at: np.ndarray  # (N, P) the direction of the next step
    reached: np.ndarray  # (N, P) 1 + how often the agent had fallen off when it last was there; 0: never; or REACHED
    step_at: np.ndarray  # (N, M) the inverse of cell: the step of the path that is there, or PIT
    shows_trail: np.ndarray  # (N,) bool: the path behind the agent, if there is any, is shown
    trail_lane: np.ndarray  # (m,) the lane of each tile of the path that is shown behind any agent
    trail_x: np.ndarray  # (m,) its first pixel, counted along the path
    trail_y: np.ndarray  # (m,)
    shows_cross: np.ndarray  # (N,) bool: in the pit, and a cross shows it
    fell_at: np.ndarray  # (N, M) bool: the agent fell off there before
    walls: np.ndarray  # (N, M) bool: the path may not lead there; nothing but the debug view needs it
    segments: np.ndarray  # (N,)
    max_column: np.ndarray  # (N,) the rightmost column of the path reached so far
    stamina: np.ndarray  # (N,) steps left to reach another tile
    fails: np.ndarray  # (N,) how often the agent fell off
    visited: np.ndarray  # (N,) tiles reached so far
    length: np.ndarray  # (N,) steps so far
    episode_return: np.ndarray  # (N,) float64: sum of rewards so far
    # Options that the rules or the drawing need.
    radius: np.ndarray  # (N,) of the agent's body
    speed: np.ndarray  # (N, 1) whole pixels a step, in the endless id
    show_origin: np.ndarray  # (N,) bool
    show_goal: np.ndarray  # (N,) bool
    show_past: np.ndarray  # (N,) bool
    show_ground: np.ndarray  # (N,) bool
    show_stamina: np.ndarray  # (N,) bool
    extras: np.ndarray  # (N,) bool: one of these, but for the past path, or a speed above FAST
    visual_feedback: np.ndarray  # (N,) bool
    camera: np.ndarray  # (N,) float64: pixels between the screen's left edge and the path's, when the agent is there
    trail_columns: np.ndarray  # (N,) columns of the past path that are shown, and the agent's own
    ground_period: np.ndarray  # (N,) pixels after which the background starts again
    figure_x: np.ndarray  # (N,) where the agent is drawn, in the endless id
    cross_x: np.ndarray  # (N,) likewise the cross
    cross_fits: np.ndarray  # (N,) bool: that is on the screen, not behind the stamina bar
    step_limit: np.ndarray  # (N,) steps until truncation
    stamina_level: np.ndarray  # (N,)
    reward_goal: np.ndarray  # (N,) float64
    reward_fall_off: np.ndarray  # (N,) float64
    reward_progress: np.ndarray  # (N,) float64
    reward_step: np.ndarray  # (N,) float64


PATH_ARRAYS = ("path_cell", "direction_at", "reached")  # (N, P)
MAP_ARRAYS = ("step_at", "fell_at", "walls")  # (N, M)


def empty_state(lanes: int, segments: int) -> State:
    """The state of N lanes before their first reset, with room for this many segments."""
    steps, cells = (SIDE * SIDE + 1,), (segments * SEGMENT * ROWS,)
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("pos", "origin", "tile"), (2,))
    shapes |= {"speed": (1,)} | dict.fromkeys(PATH_ARRAYS, steps) | dict.fromkeys(MAP_ARRAYS, cells)
    flags = ("fallen", "shows_trail", "shows_cross", "cross_fits", "fell_at", "walls", "extras", "visual_feedback")
    kinds: dict[str, Any] = dict.fromkeys((*flags, *(f"show_{what}" for what in SHOWN)), bool)
    kinds |= dict.fromkeys(("episode_return", "camera"), np.float64)
    kinds |= dict.fromkeys(("reward_goal", "reward_fall_off", "reward_progress", "reward_step"), np.float64)
    names = State.__dataclass_fields__
    s = State(**{name: np.zeros((lanes, *shapes.get(name, ())), kinds.get(name, np.int64)) for name in names})
    s.path_cell[:, PIT] = NO_CELL
    s.trail_lane = s.trail_x = s.trail_y = np.zeros(0, np.int64)
    return s


SHOWN = {
    "origin": "show_origin",
    "goal": "show_goal",
    "past": "show_past_path",
    "ground": "show_background",
    "stamina": "show_stamina",
}


def make_room(s: State, steps: int, segments: int) -> bool:
    """Widens the state if it cannot hold a path of so many steps and segments; whether it had to."""
    room = s.fell_at.shape[1] // (SEGMENT * ROWS)
    if steps < s.path_cell.shape[1] and segments <= room:
        return False
    # By half as much again at least, so that an ever longer path seldom has to move.
    steps, segments = max(steps + 1, s.path_cell.shape[1] * 3 // 2), max(segments, room * 3 // 2)
    for name in PATH_ARRAYS:
        setattr(s, name, widened(getattr(s, name), steps))
    for name in MAP_ARRAYS:
        setattr(s, name, widened(getattr(s, name), segments * SEGMENT * ROWS))
    return True


# ---- levels ----

# While a path is sampled, a place is column * SIDE + row of a 7 x 7 grid.
PLACES = [divmod(place, SIDE) for place in range(SIDE * SIDE)]
CELLS = [column * ROWS + PIT_ROWS + row for column, row in PLACES]
STRAIGHT = ((1, 0), (-1, 0), (0, 1), (0, -1))  # in the original's order
OBLIQUE = ((1, 1), (-1, -1), (1, -1), (-1, 1))


def _neighbours(x: int, y: int, moves: tuple[tuple[int, int], ...]) -> list[int]:
    spots = [(x + dx, y + dy) for dx, dy in moves]
    return [spot[0] * SIDE + spot[1] for spot in spots if spot in PLACES]


NEIGHBOURS = [_neighbours(x, y, STRAIGHT) for x, y in PLACES]
DISTANCES = [[math.sqrt((a - x) ** 2 + (b - y) ** 2) for a, b in PLACES] for x, y in PLACES]

# Places that may become walls. Of the border's, a set is an integer's bits, and eight of them are a look-up.
INSIDE = [place for place, (x, y) in enumerate(PLACES) if 0 < x < SIDE - 2 and 0 < y < SIDE - 2]
BORDER = [place for place, spot in enumerate(PLACES) if 0 in spot or SIDE - 1 in spot]


def _border_bits(places: list[int]) -> int:
    return sum(1 << at for at, place in enumerate(BORDER) if place in places)


NEAR = [_border_bits(_neighbours(x, y, ((0, 0), *STRAIGHT))) for x, y in PLACES]
AROUND = [_border_bits(_neighbours(x, y, STRAIGHT + OBLIQUE)) for x, y in PLACES]
FREE = [[[BORDER[first + at] for at in range(8) if not kept >> at & 1] for kept in range(256)] for first in (0, 8, 16)]
CLOSED, UNREACHED = 0, 1 << 20  # in place of a cost

WALLS = 33  # the chance of a wall in percent
# Draws of a path: origin's side, start, end, the inside, how many and which of the border, and one for each two places.
DRAWS = 3 + len(INSIDE) + 1 + 8 + 2 * SIDE * (SIDE - 1)
SPARE = 7  # for numbers that are drawn again, one in ten million


class Level(NamedTuple):
    """What the generator decides at a reset, and for every further segment of an endless path."""

    path: list[int]  # its cells, from the origin to the goal
    walls: list[list[int]]  # the untraceable places of each segment


def read_ahead(rng: np.random.Generator, paths: int) -> WordBuffer:
    """The words that so many paths may take. Asking the generator for one at a time is slow."""
    return WordBuffer(rng, paths * (DRAWS + SPARE))


def sample_level(rng: np.random.Generator, values: dict[str, Any], variant: Variant) -> Level:
    """Samples a level in the original's order, so that its seeds mean the same here."""
    buffer = read_ahead(rng, FIRST_SEGMENTS if variant.endless else 1)
    if variant.endless:
        level = sample_segments(buffer, below(buffer, SIDE), 0, FIRST_SEGMENTS)
    else:
        side = pick(buffer, values["cardinal_origin_choice"])
        start, end = below(buffer, SIDE), below(buffer, SIDE)
        near, far = (0, SIDE - 1) if side in (0, 2) else (SIDE - 1, 0)
        if side in (0, 1):
            start, end = near * SIDE + start, far * SIDE + end
        else:
            start, end = start * SIDE + near, end * SIDE + far
        walls = sample_walls(buffer, start, end)
        level = Level(cells_of(sample_path(buffer, walls, start, end), 0), [walls])
    buffer.close()
    return level


def sample_segments(buffer: WordBuffer, row: int, first: int, count: int) -> Level:
    """Samples segments of an endless path, from this row on, the first of them being segment number `first`."""
    path, every_wall = [], []
    for segment in range(first, first + count):
        start, end = row, (SIDE - 1) * SIDE + below(buffer, SIDE)
        walls = sample_walls(buffer, start, end)
        path += cells_of(sample_path(buffer, walls, start, end), segment)
        path.append(path[-1] + ROWS)  # the transition tile
        every_wall.append(walls)
        row = end % SIDE
    return Level(path, every_wall)


def sample_walls(buffer: WordBuffer, start: int, end: int) -> list[int]:
    """Untraceable places: some inside, some on the border that touch neither those nor start and end.

    So there always is a path: along the border, and one ring further inside past the walls that stand there.
    """
    walls, kept_free = buffer.sample_each(INSIDE, WALLS), NEAR[start] | NEAR[end]
    for place in walls:
        kept_free |= AROUND[place]
    free = FREE[0][kept_free & 255] + FREE[1][kept_free >> 8 & 255] + FREE[2][kept_free >> 16]
    return walls + buffer.take_random(free, (4, 8)[below(buffer, 2)])


def sample_path(buffer: WordBuffer, walls: list[int], start: int, end: int) -> list[int]:
    """The path that A* finds over random costs, not always the cheapest: its places from start to end."""
    costs, used, distance = buffer.eighths, buffer.used, DISTANCES[end]
    cost, total, previous = [UNREACHED] * (SIDE * SIDE), [0.0] * (SIDE * SIDE), [start] * (SIDE * SIDE)
    for place in walls:
        cost[place] = CLOSED
    opened, first, here, so_far = [], None, start, 1
    while here != end:
        cost[here] = CLOSED
        for place in NEIGHBOURS[here]:
            if cost[place]:
                there = so_far + costs[used]  # a cost of 1 to 8
                used += 1
                if cost[place] == UNREACHED:
                    cost[place], total[place], previous[place] = there, there + distance[place], here
                    opened.append(place)
                elif there < cost[place]:
                    # The original leaves the higher cost as it is.
                    previous[place] = here
        # Next is not the least total: as in the original, it is the first in line whose total is less than that of the
        # first one, else the first one. So none needs to be compared with it twice.
        if first is None:
            waiting, passed = iter(opened), []
            first = next(waiting)
            least = total[first]
        for here in waiting:
            if total[here] < least:
                break
            passed.append(here)
        else:
            here, first, opened = first, None, passed
        so_far = cost[here] + 1
    buffer.used = used
    path = [end]
    while here != start:
        here = previous[here]
        path.append(here)
    return path[::-1]


def cells_of(places: list[int], segment: int) -> list[int]:
    """The map's cells of this segment's places."""
    shift = segment * SEGMENT * ROWS
    return [CELLS[place] + shift for place in places]


def write_level(s: State, lane: int, level: Level, endless: bool) -> None:
    """Starts the lane's episode at this level."""
    s.step_at[lane] = PIT
    s.fell_at[lane] = s.walls[lane] = s.fallen[lane] = s.shows_cross[lane] = False
    s.path_length[lane] = s.segments[lane] = s.max_column[lane] = s.fails[lane] = s.visited[lane] = 0
    s.length[lane] = s.episode_return[lane] = 0
    write_path(s, lane, level, endless)
    s.reached[lane] = 0
    s.reached[lane, PIT] = s.reached[lane, 1] = REACHED
    if not endless:
        s.reached[lane, len(level.path)] = REACHED  # the goal has a reward of its own
    column, row = divmod(level.path[0] - PIT_ROWS, ROWS)
    # Not the tile's middle but for the default size, as in the original.
    radius = int(s.radius[lane])
    x, y = column * TILE + radius, row * TILE + radius
    s.pos[lane] = s.origin[lane] = x + PAD, y + PAD
    s.tile[lane] = x // TILE, y // TILE
    s.facing[lane] = 6 if endless else 0
    s.path_step[lane], s.last_path_step[lane] = NO_STEP, 1  # the first step lands on the origin
    s.next_direction[lane] = s.direction_at[lane, 1]
    s.stamina[lane] = s.stamina_level[lane]


def write_path(s: State, lane: int, level: Level, endless: bool) -> None:
    """Appends to the lane's path, for which there must be room."""
    first = int(s.path_length[lane]) + 1
    last = first + len(level.path)
    s.path_cell[lane, first:last] = level.path
    path = s.path_cell[lane, first:last]
    s.step_at[lane][path] = np.arange(first, last)
    s.direction_at[lane, first : last - 1] = DIRECTIONS[path[1:] - path[:-1]]
    # Behind a transition tile the path goes on to the right. The goal has the direction that leads to it.
    s.direction_at[lane, last - 1] = EAST if endless else s.direction_at[lane, last - 2]
    s.path_length[lane] = last - 1
    for segment, walls in enumerate(level.walls, int(s.segments[lane])):
        s.walls[lane, cells_of(walls, segment)] = True
    s.segments[lane] += len(level.walls)


def forget_trails(s: State, lanes: np.ndarray) -> None:
    """Removes the past paths of the lanes from those that are shown."""
    if np.count_nonzero(s.shows_trail[lanes]):
        s.shows_trail[lanes] = False
        left = s.shows_trail.take(s.trail_lane)
        s.trail_lane, s.trail_x, s.trail_y = s.trail_lane[left], s.trail_x[left], s.trail_y[left]


# ---- drawing ----

WHITE, GREY, ICE = (255, 255, 255), (210, 210, 210), (125, 177, 250)
BLUE, GREEN, RED = (0, 0, 255), (0, 255, 0), (255, 0, 0)
CROSS = 10  # width of the cross
STAMINA_BAR = 4  # width of the stamina bar
ON_PATH, ORIGIN, GOAL, WALL, EDGE = range(5)  # rows of tiles()
STEPS_BACK = np.arange(1, (2 * SIDE - 1) * SIDE + 1)  # steps back that can be drawn: those on less than two segments


@cache
def tile_picture(inner: tuple[int, int, int], border: tuple[int, int, int]) -> np.ndarray:
    """(TILE, TILE, 3) uint8, read-only: a tile with a border of one pixel."""
    picture = np.tile(np.array(border, np.uint8), (TILE, TILE, 1))
    picture[1:-1, 1:-1] = inner
    picture.flags.writeable = False
    return picture


@cache
def tiles() -> Sheet:
    """Every kind of tile, to be pasted where a part of it may be off the screen."""
    colors = [(WHITE, GREY), (BLUE, BLUE), (GREEN, GREEN), (RED, RED), (GREY, GREY)]
    pictures = np.stack([tile_picture(*color) for color in colors])
    return make_sheet(pictures, np.ones(pictures.shape[:3], bool), np.arange(SPAN) - PAD)


def cross_mask() -> np.ndarray:
    """(CROSS, CROSS) bool: two diagonals, three pixels wide."""
    rows, columns = np.indices((CROSS, CROSS))
    return (abs(rows - columns) <= 1) | (abs(rows + columns - CROSS + 1) <= 1)


@cache
def crosses() -> Sheet:
    """The red cross."""
    picture = np.tile(np.array(RED, np.uint8), (CROSS, CROSS, 1))
    return make_sheet(picture[None], cross_mask()[None], np.arange(SPAN) - PAD)


@cache
def grounds() -> np.ndarray:
    """(1 + TILE, FRAME) uint8, read-only: black, then the tiled background moved left by 0, 1, 2, ... pixels."""
    ice = np.tile(tile_picture(ICE, GREY), (SIDE, SIDE + 1, 1))
    pictures = [np.zeros((SCREEN, SCREEN, 3), np.uint8), *(ice[:, shift : shift + SCREEN] for shift in range(TILE))]
    table = np.stack(pictures).reshape(-1, FRAME)
    table.flags.writeable = False
    return table


@cache
def bars() -> np.ndarray:
    """(SCREEN + 1, SCREEN, 3 * STAMINA_BAR) uint8, read-only: the stamina bar, green below so many red rows."""
    table = np.tile(np.array(GREEN, np.uint8), (SCREEN + 1, SCREEN, STAMINA_BAR, 1))
    table[np.arange(SCREEN + 1)[:, None] > np.arange(SCREEN)] = RED
    table = table.reshape(SCREEN + 1, SCREEN, 3 * STAMINA_BAR)
    table.flags.writeable = False
    return table


def draw(s: State, sheet: Sheet, lanes: np.ndarray | slice, endless: bool) -> np.ndarray:
    """Fresh frames of the lanes, (n, 84, 84, 3) uint8, from the state alone."""
    frames = draw_endless_ground(s, lanes) if endless else draw_ground(s, lanes)  # (n, FRAME)
    draw_agent(frames, s, sheet, lanes, endless)
    return frames.reshape(-1, SCREEN, SCREEN, 3)


def draw_ground(s: State, lanes: np.ndarray | slice) -> np.ndarray:
    """Black (n, FRAME), with the path's origin and goal where they are shown."""
    frames = np.zeros((len(s.last_path_step[lanes]), FRAME), np.uint8)
    if not np.count_nonzero(s.extras[lanes]):
        return frames
    for shown, kind in ((s.show_origin[lanes], ORIGIN), (s.show_goal[lanes], GOAL)):
        if np.count_nonzero(shown):
            (which,) = shown.nonzero()
            step = s.path_length[lanes][which] if kind == GOAL else 1
            cell = s.path_cell[lanes][which, step]
            paste(frames, tiles(), np.full(len(which), kind), tile_centres(cell), which)
    return frames


def tile_centres(cell: np.ndarray) -> np.ndarray:
    """(n, 2) the middles of the cells' tiles, with PAD."""
    return np.stack([cell // ROWS, cell % ROWS - PIT_ROWS], axis=1) * TILE + TILE // 2 + PAD


def draw_endless_ground(s: State, lanes: np.ndarray | slice) -> np.ndarray:
    """(n, FRAME): black or the background, and the path behind the agent where it is shown."""
    if np.count_nonzero(s.extras[lanes]):
        frames = grounds().take(ground_rows(s, lanes), axis=0)
    else:
        frames = np.zeros((len(s.last_path_step[lanes]), FRAME), np.uint8)
    if np.count_nonzero(s.shows_trail[lanes]):
        draw_trail(frames, s, lanes)
    return frames


def ground_rows(s: State, lanes: np.ndarray | slice) -> np.ndarray:
    """(n,) the rows of grounds() that are behind everything."""
    # Starts again as soon as it has moved by a tile or more, which jumps if the speed does not divide that.
    walked = s.pos[lanes, 0] - s.origin[lanes, 0]
    return (walked % s.ground_period[lanes] + 1) * s.show_ground[lanes]


# The picture of a past tile by its first pixel, counted from the end if negative. Where just two of its columns are on
# the screen, the original paints both like its border.
TRAIL_KIND = np.full(SCREEN + TILE, ON_PATH)
TRAIL_KIND[[2 - TILE, SCREEN - 2]] = EDGE


def draw_trail(frames: np.ndarray, s: State, lanes: np.ndarray | slice) -> None:
    """Draws the past path on the lanes' frames, in place."""
    owner, x, y = trail_on_screen(s, lanes)
    whole = (x >= 0) & (x <= SCREEN - TILE)
    if np.count_nonzero(whole) < len(whole):
        cut = ~whole & (x > -TILE) & (x < SCREEN)
        centres = np.stack([x[cut], y[cut]], axis=1) + TILE // 2 + PAD
        # Before the whole tiles, which then cover what the cut ones' squares have of them.
        paste(frames, tiles(), TRAIL_KIND.take(x[cut]), centres, owner[cut])
        owner, x, y = owner[whole], x[whole], y[whole]
    stamp(frames, tile_picture(WHITE, GREY), owner, x, y)


def trail_on_screen(s: State, lanes: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The past path of the lanes: for each tile, (m,), whose of them it is, and its first pixel, x and y."""
    lane, y = s.trail_lane, s.trail_y  # (m,)
    # A camera between two pixels cuts the fraction off, towards zero.
    x = (s.trail_x - (s.pos[:, 0] - s.origin[:, 0] - s.camera)[lane]).astype(np.int64)
    if isinstance(lanes, slice):
        return lane, x, y
    frame = np.full(len(s.last_path_step), NO_CELL)
    frame[lanes] = np.arange(len(lanes))
    owner = frame[lane]
    mine = owner != NO_CELL
    return owner[mine], x[mine], y[mine]


def place_on_screen(s: State, lanes: np.ndarray | slice, endless: bool) -> np.ndarray:
    """(n, 2) where the agents are drawn."""
    pos = s.pos[lanes]
    if endless:
        pos = pos.copy()
        pos[:, 0] = s.figure_x[lanes]
        if np.count_nonzero(s.extras[lanes]):  # a fast agent may be far off the screen
            np.clip(pos, 0, SPAN - 1, out=pos)
    return pos


def spent_stamina(s: State, lanes: np.ndarray | slice) -> np.ndarray:
    """(n,) how many pixels of the bar are red."""
    return (SCREEN * (1 - s.stamina[lanes] / s.stamina_level[lanes])).astype(np.int64)


def draw_agent(frames: np.ndarray, s: State, sheet: Sheet, lanes: np.ndarray | slice, endless: bool) -> None:
    """Draws the agents, their stamina and their crosses on the frames (n, FRAME), in place."""
    pos, extras = place_on_screen(s, lanes, endless), endless and np.count_nonzero(s.extras[lanes])
    paste(frames, sheet, s.figure[lanes] * FACINGS + s.facing[lanes], pos)
    if extras:
        shown = s.show_stamina[lanes]
        frames.reshape(-1, SCREEN, ROW)[shown, :, -3 * STAMINA_BAR :] = bars()[spent_stamina(s, lanes)[shown]]
    (which,) = s.shows_cross[lanes].nonzero()
    if which.size:
        cross = pos[which]
        if endless:
            cross[:, 0] = s.cross_x[lanes][which]
        paste(frames, crosses(), np.zeros_like(which), cross, which)


# ---- vector observations ----

CROSS_FITS = abs(np.arange(SPAN) - PAD - SCREEN // 2) < (SCREEN + CROSS) // 2  # of stored positions along y
CORNERS = np.array([(0, 0), (1, 0), (0, 1), (1, 1)])  # (4, 2)


class ViewOptions(NamedTuple):
    """What decides how much of an agent shows. Lanes whose options agree share one."""

    scale: float
    column: int | None  # the stored position where the agent is always drawn, in the endless id
    aside: int  # how far right of the agent's centre its cross is drawn
    width: int  # pixels of the screen that are left of the stamina bar


@lru_cache(maxsize=16)
def appearance_tables(every: tuple[ViewOptions, ...]) -> AppearanceTables:
    """What can be seen of the agent with these view options, without a cross and with one."""
    views = []
    for options in every:
        free = np.zeros((SCREEN, SCREEN), bool)
        free[:, : options.width] = True
        rows = range(SPAN) if options.column else range(PAD, PAD + SCREEN + LARGEST_RADIUS + 1)
        columns = range(options.column, options.column + 1) if options.column else rows
        image, solid = sprites(options.scale)
        for picture in ((image, solid), with_cross(image, solid, options.aside)):
            views.append(View(options.scale, *picture, free, columns, rows))
    return make_appearance_tables(views)


def with_cross(image: np.ndarray, solid: np.ndarray, aside: int) -> tuple[np.ndarray, np.ndarray]:
    """The figure's sprites with a cross over them, so far right of their middle."""
    margin = max(0, CROSS // 2 + abs(aside) - solid.shape[1] // 2)
    around = ((0, 0), (margin, margin), (margin, margin))
    image, solid = np.pad(image, (*around, (0, 0))), np.pad(solid, around)
    first = solid.shape[1] // 2 - CROSS // 2
    square = (slice(None), slice(first, first + CROSS), slice(first + aside, first + aside + CROSS))
    image[square][:, cross_mask()], solid[square][:, cross_mask()] = RED, True
    return image, solid


def write_ends(
    out: np.ndarray, s: State, lanes: np.ndarray | slice, tables: AppearanceTables, sprite: np.ndarray
) -> None:
    """Writes the path's origin and goal to out, (n, 4) and zeros so far, where they are shown and not hidden."""
    which, last = np.arange(len(out)), s.path_length[lanes]
    for end, shown, step in ((0, s.show_origin[lanes], np.ones_like(last)), (2, s.show_goal[lanes], last)):
        centre = tile_centres(s.path_cell[lanes][which, step])  # (n, 2)
        points = centre[:, None] - TILE // 2 + CORNERS * (TILE - 1)  # (n, 4, 2)
        shown = shown & ~covered(tables, sprite, s.pos[lanes], points).all(axis=1)
        out[:, end : end + 2] = (centre - PAD) / SCREEN * shown[:, None]


def write_trail(out: np.ndarray, s: State, lanes: np.ndarray | slice, tables: AppearanceTables, agent: Any) -> None:
    """Writes the past path and the scroll of its tiles to out, (n, 57) and zeros so far. A tile shows if a corner does.

    agent: sprites (n,) and where they are drawn (n, 2) of agents that may hide a tile, or None.
    """
    owner, x, y = trail_on_screen(s, lanes)
    inset, width = 0, SCREEN
    if np.count_nonzero(s.extras[lanes]):
        # The background has the same borders, which may be two columns wide, but not the pixels inside them.
        inset, width = 2 * s.show_ground[lanes][owner], (SCREEN - STAMINA_BAR * s.show_stamina[lanes])[owner]  # (m,)
    shown = (x + inset < width) & (x + (TILE - 1) - inset >= 0)
    cut = x == 1 - TILE  # all but its last pixels, in the screen's first column
    if np.count_nonzero(cut):
        # A camera between two pixels may put the next tile, which covers them, there too.
        row = owner * SCREEN + y  # (m,)
        shown &= ~(cut & np.isin(row, row[x == 0]))
    if agent is not None:
        sprite, pos = agent
        corners = np.stack([x, y], axis=1)[:, None] + abs(CORNERS * (TILE - 1) - np.reshape(inset, (-1, 1, 1)))
        free = (corners[..., 0] >= 0) & (corners[..., 0] < np.reshape(width, (-1, 1)))  # (m, 4)
        shown &= (free & ~covered(tables, sprite[owner], pos[owner], corners + PAD)).any(axis=1)
    owner, x, y = owner[shown], x[shown], y[shown]
    out[owner, (x // TILE + 1) * SIDE + y // TILE] = 1.0
    # Not all of a path's tiles have the same, where the camera is between two pixels.
    np.maximum.at(out[:, -1], owner, (x % TILE / TILE).astype(np.float32))


# ---- rules ----

# The endless id's actions: 0 nothing, 1 right, 2 up, 3 down.
ENDLESS_MOVES = np.array([(0, 0), (1, 0), (0, -1), (0, 1)])  # (4, 2)
ENDLESS_TURN = np.array([(facing, 6, 0, 4) for facing in range(FACINGS)])  # (8, 4) the next facing


def enter_tiles(s: State, lane_path: np.ndarray, rewards: np.ndarray, endless: bool) -> None:
    """What happens on another tile, or in the pit. Where the agent has not moved on, this changes nothing.

    lane_path: (N,) where the lane's steps start in the flattened path. rewards: (N,), changed in place.
    """
    s.last_path_step = np.where(s.fallen, s.last_path_step, s.path_step)
    here, now = s.path_step + lane_path, s.fails + 1
    before = s.reached.take(here)
    fresh = before == 0
    if np.count_nonzero(fresh):
        rewards += fresh * s.reward_progress
        s.visited += fresh
    if endless:
        # The first time since the last fall, a tile gives stamina back. So does the origin.
        np.copyto(s.stamina, s.stamina_level, where=before != now)
    s.reached.put(here, now)
    if np.count_nonzero(s.fallen):
        rewards += s.fallen * s.reward_fall_off
        s.fails += s.fallen
    s.shows_cross = s.fallen & s.visual_feedback
    direction = s.direction_at.take(s.last_path_step + lane_path)
    if endless:
        # The ground truth has no entry for the west.
        np.copyto(direction, s.next_direction, where=direction == WEST)
        s.shows_trail = s.show_past & (s.tile[:, 0] > 0)
        update_trails(s, lane_path)
    s.next_direction = direction


def update_trails(s: State, lane_path: np.ndarray) -> None:
    """Finds the path behind the agents that is shown."""
    (lanes,) = s.shows_trail.nonzero()
    if lanes.size:
        s.trail_lane, cell = trail(s, lanes, lane_path)
        column, row = np.divmod(cell, ROWS)
        s.trail_x, s.trail_y = column * TILE, (row - PIT_ROWS) * TILE


def trail(s: State, lanes: np.ndarray, lane_path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The path behind the agents of the lanes: for each tile, (m,), its lane and its cell.

    From the last step but one backwards, up to the first that is as far to the left as the camera's offset in tiles.
    """
    at = s.last_path_step.take(lanes)
    first_column = np.maximum(s.tile[:, 0] - s.trail_columns, 1).take(lanes)  # (n,)
    bound = first_column * ROWS  # cells below that are far enough left
    back = STEPS_BACK[: int(at.max())]  # (K,)
    # What is before the pit is of another lane, but nobody gets there: the pit's cell is left of everything.
    cells = s.path_cell.take((at + lane_path.take(lanes))[:, None] - back)  # (n, K)
    count = (cells < bound[:, None]).argmax(axis=1) + 1  # (n,)
    np.minimum(count, at - 1, out=count)
    return lanes.repeat(count), cells[back <= count[:, None]]


def fatal_falls(s: State, cell: np.ndarray) -> np.ndarray:
    """The endless id: who fell off where the episode ends, (N,) bool.

    cell: (N,) the agents' places in the flattened map.
    """
    over = s.fallen & ((s.tile[:, 0] < s.max_column) | s.fell_at.take(cell))
    # Never forgotten: the original means to, on progress, but compares before there can be any.
    s.fell_at.put(cell[s.fallen], True)
    return over


def camera_columns(values: dict[str, Any]) -> tuple[int, int]:
    """Where the endless id draws the agent, and where its cross: stored positions along x."""
    radius, camera = radius_of(values["agent_scale"]), TILE * values["camera_offset_scale"]
    # The original cuts the fraction off at the corner of the agent's sprite, and rounds the cross's middle.
    corner = (2 * radius + int(10 * values["agent_scale"]) + 14) // 2
    return corner + int(radius - corner + camera) + PAD, math.floor(radius + camera + 0.5) + PAD


class MysteryPath(MemoryGymVectorEnv):
    """Mystery Path (thesis 4.4): follow a path that cannot be seen, by remembering where one fell off.

    ## Description

    A path leads over a grid of 7 x 7 tiles, from a random tile of one side to one of the opposite side. Neither is
    seen. An agent that steps off the path falls into a pit, which a red cross shows, and is back at the path's origin
    at the next step, whatever its action.

    - `MysteryPath-v0`: free movement. `MysteryPath-Grid-v0`: tile by tile.
    - `Endless-MysteryPath-v0`: the path goes on to the right for ever, in segments of 7 columns and a transition tile.
      The camera moves with the agent, which sees the path behind it but cannot walk left.

    ## Action Space

    `MultiDiscrete([3, 3])`:

    | value | horizontal | vertical |
    |---|---|---|
    | 0 | none | none |
    | 1 | left | up |
    | 2 | right | down |

    `Discrete(4)`, Grid id:

    | value | action |
    |---|---|
    | 0 | nothing |
    | 1 | turn left |
    | 2 | turn right |
    | 3 | one tile forward |

    `Discrete(4)`, endless id:

    | value | action |
    |---|---|
    | 0 | nothing |
    | 1 | right |
    | 2 | up |
    | 3 | down |

    ## Observation Space

    `Box(0, 255, (84, 84, 3), uint8)`, rows first. With obs_type="vector" a flat float32 vector: `docs/vectors.md`,
    `VARIANTS[id].entries`.

    ## Rewards

    `reward_goal` (1) at the goal, `reward_path_progress` (0.1, Grid 0) for every other tile but the origin when it is
    reached for the first time, `reward_fall_off` (0) in the pit, and `reward_step` (0) at every step.

    ## Episode End

    Terminated at the goal. The endless id: terminated when no new tile was reached for `stamina_level` (20) steps (all
    tiles are new again after a fall), by falling off in a column left of the best progress, and by falling off at the
    same place again. Truncated after `max_steps` steps (512, Grid 128, endless no limit; a real end at that very step
    counts as termination).

    ## Info

    `ground_truth`: one-hot, the direction of the path's next tile from where the agent last was on the path: east,
    north, south, west, (4,); at the goal, the direction that leads to it. Endless id: east, north, south, (3,); where
    the path goes west, the direction before. At an episode's end also `reward`, `length`, `num_fails` and `success`; in
    the endless id `max_x`, the rightmost column of the path that was reached, and `tiles_visited`, instead of success.

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

    ## Version History

    - v0: as in memory-gym 1.0.2, but for what follows.

    ## References

    Marco Pleines: Memory-based Deep Reinforcement Learning in Endless Imperfect Information Games. Dissertation, TU
    Dortmund University. Marco Pleines, Matthias Pallasch, Frank Zimmer, Mike Preuss: Memory Gym, arXiv:2309.17207.

    ## Kept from the original, and differences

    Kept from the original: the agent starts as far from its tile's top left corner as its radius, so one of scale 0.48
        or more starts beside the origin; grid ids ignore agent_scale, the endless id show_origin; in the endless id the
        camera's fraction of a pixel is cut off, the background jumps at speeds that do not divide 12, no place of a
        fall is ever forgotten, and only the first tile of the leftmost column that is shown of the past path is drawn,
        none while the agent is in the first column. Where the endless path goes left, nobody can follow it. Steps are
        cut off to whole pixels, a diagonal one to 2 pixels at the default speed.
    Differences from the original: images are rows first; max_steps truncates; every id reports ground truth; wrong
        options raise ValueError.
    """

    variants = VARIANTS
    tables = ("_agent_tables", "_appearance")
    growing = (*PATH_ARRAYS, *MAP_ARRAYS, "trail_lane", "trail_x", "trail_y")

    def spaces(self) -> tuple[gym.Space, gym.Space]:
        """The observation space of one lane with pixels, and its action space."""
        free = not (self.variant.grid or self.variant.endless)
        actions = gym.spaces.MultiDiscrete([3, 3]) if free else gym.spaces.Discrete(4)
        return gym.spaces.Box(0, 255, (SCREEN, SCREEN, 3), np.uint8), actions

    def allocate(self) -> None:
        """Makes the state of N lanes."""
        self.state = empty_state(self.num_envs, FIRST_SEGMENTS + 1 if self.variant.endless else 1)
        self.figures = (self._figure(self.defaults),)  # all that differ, of all lanes
        self.view_options = (self._view_options(self.defaults),)  # likewise
        self.place_tables()

    def configure(self, lanes: np.ndarray) -> None:
        """Takes over the options of the lanes, and the tables that all lanes' options need."""
        s, values = self.state, self.settings[int(lanes[0])]
        s.step_limit[lanes] = NO_LIMIT if values["max_steps"] == -1 else values["max_steps"]
        s.visual_feedback[lanes] = values["visual_feedback"]
        s.radius[lanes] = radius_of(0.25 if self.variant.grid else values["agent_scale"])
        for what, option in SHOWN.items():
            getattr(s, f"show_{what}")[lanes] = values.get(option, False)
        shown = any(values.get(option, False) for what, option in SHOWN.items() if what != "past")
        s.extras[lanes] = shown or values.get("agent_speed", 0.0) > FAST
        s.reward_goal[lanes] = values.get("reward_goal", 0.0)
        s.reward_fall_off[lanes] = values["reward_fall_off"]
        s.reward_progress[lanes] = values["reward_path_progress"]
        s.reward_step[lanes] = values["reward_step"]
        s.stamina_level[lanes] = values.get("stamina_level", 1)
        if self.variant.endless:
            self._place_camera(lanes, values)
        self.figures, s.figure[:] = numbered([self._figure(each) for each in self.settings])
        self.view_options, s.view[:] = numbered([self._view_options(each) for each in self.settings])
        self.place_tables()

    def _place_camera(self, lanes: np.ndarray, values: dict[str, Any]) -> None:
        s, speed = self.state, int(values["agent_speed"])
        s.camera[lanes] = TILE * values["camera_offset_scale"]
        s.trail_columns[lanes] = int(values["camera_offset_scale"])
        s.speed[lanes] = speed
        s.ground_period[lanes] = speed * math.ceil(TILE / speed) if speed else 1
        s.figure_x[lanes], s.cross_x[lanes] = camera_columns(values)
        s.cross_fits[lanes] = (
            camera_columns(values)[1] < PAD + SCREEN - STAMINA_BAR * values["show_stamina"] + CROSS // 2
        )

    def _figure(self, values: dict[str, Any]) -> Figure:
        if self.variant.grid:
            return Figure(0.25, TILE, 0, SCREEN, TILE // 2, False)
        scale = values["agent_scale"]
        return Figure(scale, values["agent_speed"], 0, SCREEN, radius_of(scale), False)

    def _view_options(self, values: dict[str, Any]) -> ViewOptions:
        scale = 0.25 if self.variant.grid else values["agent_scale"]
        if not self.variant.endless:
            return ViewOptions(scale, None, 0, SCREEN)
        figure_x, cross_x = camera_columns(values)
        return ViewOptions(scale, figure_x, cross_x - figure_x, SCREEN - STAMINA_BAR * values["show_stamina"])

    def place_tables(self) -> None:
        """The flat tables that step() looks things up in, and where each lane's rows start in them."""
        self._agent_tables = agent_tables(self.figures)
        self._controls = grid_controls() if self.variant.grid else free_controls()
        self._truths = np.eye(4)[:, : 3 if self.variant.endless else 4].copy()
        self._lane_walk = self.state.figure[:, None] * (STRIDES * SPAN)  # (N, 1)
        self._lane_map = np.arange(self.num_envs) * self.state.step_at.shape[1] + PIT_ROWS  # (N,)
        self._lane_path = np.arange(self.num_envs) * self.state.path_cell.shape[1]  # (N,)
        if self.obs_type == "vector":
            self._appearance = appearance_tables(self.view_options)
            self._at = vector_slices(self.variant.entries)
            # An agent that is no wider than a tile cannot hide one.
            self._large = any(2 * radius_of(options.scale) > TILE for options in self.view_options)

    def begin(self, lanes: np.ndarray) -> None:
        """Samples the lanes' next levels and starts their episodes."""
        forget_trails(self.state, lanes)
        for lane in lanes.tolist():
            level = sample_level(self._rngs[lane], self.settings[lane], self.variant)
            if make_room(self.state, len(level.path), len(level.walls)):
                self.place_tables()
            write_level(self.state, lane, level, self.variant.endless)

    def advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One step of the rules: walk, land on a tile, end or fall."""
        s, endless = self.state, self.variant.endless
        s.length += 1
        self._move(actions)
        if endless:
            s.tile = (s.pos - PAD) // TILE  # (N, 2)
            self._extend_paths()
        else:
            s.tile = TILE_AT.take(s.pos)  # (N, 2)
        cell = s.tile.dot(MAP_STRIDES) + self._lane_map  # (N,)
        before, s.path_step = s.path_step, s.step_at.take(cell)
        s.fallen = s.path_step == PIT
        rewards = s.reward_step.copy()
        landed = int(np.count_nonzero(s.path_step != before))
        if landed:
            enter_tiles(s, self._lane_path, rewards, endless)
        terminated = self._spend_stamina(cell, landed) if endless else s.path_step == s.path_length
        if not endless and np.count_nonzero(terminated):
            rewards += terminated * s.reward_goal
        s.episode_return += rewards
        truncated = s.length == s.step_limit
        if np.count_nonzero(truncated):
            truncated &= ~terminated
        return rewards, terminated, truncated

    def _spend_stamina(self, cell: np.ndarray, landed: int) -> np.ndarray:
        """The endless id: who has no stamina left, or fell off where it must not; (N,) bool."""
        s = self.state
        if not landed:
            s.stamina -= 1
            return s.stamina == 0
        over = fatal_falls(s, cell) if np.count_nonzero(s.fallen) else False
        s.max_column = np.where(s.fallen, s.max_column, np.maximum(s.max_column, s.tile[:, 0]))
        s.stamina -= 1
        return (s.stamina == 0) | over

    def _move(self, actions: np.ndarray) -> None:
        """Walks, or puts those who fell back to the origin."""
        s, endless = self.state, self.variant.endless
        action = actions if actions.ndim == 1 else actions.dot(BRANCHES)  # (N,)
        if np.count_nonzero(s.fallen):
            action = np.where(s.fallen, 0, action)
            s.pos = np.where(s.fallen[:, None], s.origin, s.pos)
            s.path_step[s.fallen] = NO_STEP  # what it lands on is another tile, even if that is the pit again
        if endless:
            s.facing = ENDLESS_TURN.take(s.facing * len(ENDLESS_MOVES) + action)
            s.pos = s.pos + ENDLESS_MOVES.take(action, axis=0) * s.speed
        else:
            s.facing, s.pos = walk(s.facing, s.pos, action, self._lane_walk, self._controls, self._agent_tables.walk)

    def _extend_paths(self) -> None:
        """Appends a segment to the paths whose last one was just entered."""
        s = self.state
        entered = s.tile[:, 0] >= (s.segments - 1) * SEGMENT
        if not np.count_nonzero(entered):
            return
        for lane in np.flatnonzero(entered).tolist():
            steps, segments = int(s.path_length[lane]), int(s.segments[lane])
            row = int(s.path_cell[lane, steps]) % ROWS - PIT_ROWS
            buffer = read_ahead(self._rngs[lane], 1)
            level = sample_segments(buffer, row, segments, 1)
            buffer.close()
            if make_room(s, steps + len(level.path), segments + 1):
                self.place_tables()
            write_path(s, lane, level, endless=True)

    def vectors(self, lanes: np.ndarray | slice) -> np.ndarray:
        """Fresh vector observations of the lanes, (n, V) float32."""
        s, at, endless = self.state, self._at, self.variant.endless
        pos, shows_cross = place_on_screen(s, lanes, endless), s.shows_cross[lanes]
        sprite = (2 * s.view[lanes] + shows_cross) * FACINGS + s.facing[lanes]  # (n,)
        out = np.zeros((len(sprite), *(self.single_observation_space.shape or ())), np.float32)
        write_agent_entries(out[:, at["size"].start : at["facing"].stop], self._appearance, sprite, pos)
        if endless:
            self._write_endless(out, lanes, sprite, pos)
        else:
            out[:, at["cross"]] = shows_cross[:, None]
            if np.count_nonzero(s.extras[lanes]):
                write_ends(out[:, at["origin"].start : at["goal"].stop], s, lanes, self._appearance, sprite)
        return out

    def _write_endless(self, out: np.ndarray, lanes: np.ndarray | slice, sprite: np.ndarray, pos: np.ndarray) -> None:
        """Writes what only the endless id has, or has off the screen."""
        s, at = self.state, self._at
        shows_cross = s.shows_cross[lanes]
        if np.count_nonzero(shows_cross):
            out[:, at["cross"].start] = shows_cross & s.cross_fits[lanes] & CROSS_FITS.take(pos[:, 1])
        if np.count_nonzero(s.shows_trail[lanes]):
            trail = out[:, at["past"].start : at["scroll"].stop]
            write_trail(trail, s, lanes, self._appearance, (sprite, pos) if self._large else None)
        if np.count_nonzero(s.extras[lanes]):
            out[:, at["ground"].start] = ground_rows(s, lanes) / TILE
            out[:, at["bar"].start] = s.show_stamina[lanes]
            out[:, at["stamina"].start] = s.show_stamina[lanes] * (1 - spent_stamina(s, lanes) / SCREEN)

    def frames(self, lanes: np.ndarray | slice) -> np.ndarray:
        """Fresh frames of the lanes, (n, 84, 84, 3)."""
        return draw(self.state, self._agent_tables.sheet, lanes, self.variant.endless)

    def ground_truth(self) -> np.ndarray:
        """A fresh (N, 4), endless (N, 3): the direction of the path's next tile."""
        return self._truths.take(self.state.next_direction, axis=0)

    def summary(self, lanes: np.ndarray) -> dict[str, np.ndarray]:
        """The lanes' ended episodes in numbers."""
        s = self.state
        numbers = {"reward": s.episode_return[lanes], "length": s.length[lanes]}
        if self.variant.endless:
            places = {"max_x": s.max_column[lanes], "tiles_visited": s.visited[lanes]}
            return numbers | {"num_fails": s.fails[lanes]} | places
        success = (s.path_step[lanes] == s.path_length[lanes]).astype(np.int64)
        return numbers | {"success": success, "num_fails": s.fails[lanes]}

    def annotate(self, frame: np.ndarray, lane: int) -> None:
        """Draws the path in white, its origin and transition tiles blue, its goal green, walls red, then the agent."""
        s, one, endless = self.state, np.array([lane]), self.variant.endless
        small = draw_endless_ground(s, one) if endless else draw_ground(s, one)  # (1, FRAME)
        steps = int(s.path_length[lane])
        path = s.path_cell[lane, 1 : steps + 1].tolist()
        marks = [(cell, ORIGIN if cell // ROWS % SEGMENT == SIDE else ON_PATH) for cell in path]
        marks[0] = (marks[0][0], ORIGIN)
        if not endless:
            marks[-1] = (marks[-1][0], GOAL)
        marks += [(cell, WALL) for cell in np.flatnonzero(s.walls[lane]).tolist()]
        camera = int(s.pos[lane, 0] - s.origin[lane, 0] - s.camera[lane]) if endless else 0
        for cell, kind in marks:
            centre = tile_centres(np.array([cell])) - (camera, 0)
            if PAD - TILE // 2 < centre[0, 0] < PAD + SCREEN + TILE // 2:
                paste(small, tiles(), np.array([kind]), centre)
        draw_agent(small, s, self._agent_tables.sheet, one, endless)
        frame[:] = magnify(small.reshape(SCREEN, SCREEN, 3), DEBUG_ZOOM)
