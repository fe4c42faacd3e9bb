"""Mystery Path's levels: walls, a path around them, and the start of an episode on it.

A path is searched on a grid of 7 x 7 nodes for each segment. A node is a number, column * SIDE + row; the map's cells
of state.py have other numbers.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from memory_gym_envs.character import PAD
from memory_gym_envs.mystery_path.options import SEGMENT, SIDE, TILE
from memory_gym_envs.mystery_path.state import DIRECTIONS, EAST, NO_STEP, ORIGIN, PIT, PIT_ROWS, ROWS, UNREWARDED, State
from memory_gym_envs.state import make_room
from memory_gym_envs.words import WordBuffer, pick, sample_below

FIRST_SEGMENTS = 3  # of an endless path; another is appended whenever the agent enters the last one

NODES = [divmod(node, SIDE) for node in range(SIDE * SIDE)]  # column and row of each
CELLS = [column * ROWS + PIT_ROWS + row for column, row in NODES]
STRAIGHT = ((1, 0), (-1, 0), (0, 1), (0, -1))  # in the original's order
OBLIQUE = ((1, 1), (-1, -1), (1, -1), (-1, 1))


def _neighbours(x: int, y: int, moves: tuple[tuple[int, int], ...]) -> list[int]:
    return [NODES.index((x + dx, y + dy)) for dx, dy in moves if (x + dx, y + dy) in NODES]


NEIGHBOURS = [_neighbours(x, y, STRAIGHT) for x, y in NODES]
DISTANCES = [[math.sqrt((a - x) ** 2 + (b - y) ** 2) for a, b in NODES] for x, y in NODES]

# Nodes that may become walls. A set of border nodes is an integer, with a bit for each of the 24.
INSIDE = [node for node, (x, y) in enumerate(NODES) if 0 < x < SIDE - 2 and 0 < y < SIDE - 2]
BORDER = [node for node, tile in enumerate(NODES) if 0 in tile or SIDE - 1 in tile]


def _border_bits(nodes: list[int]) -> int:
    return sum(1 << at for at, node in enumerate(BORDER) if node in nodes)


# Border nodes that stay free because of a node: at most a step away from a start or end, next to or at the corners of
# a wall.
NEAR_END = [_border_bits(_neighbours(x, y, ((0, 0), *STRAIGHT))) for x, y in NODES]
AROUND_WALL = [_border_bits(_neighbours(x, y, STRAIGHT + OBLIQUE)) for x, y in NODES]
# CANDIDATES[i][bits]: those of the border's nodes 8 * i to 8 * i + 7 that may become walls while the set bits may not.
CANDIDATES = [
    [[BORDER[first + at] for at in range(8) if not bits >> at & 1] for bits in range(256)] for first in (0, 8, 16)
]
CLOSED, UNREACHED = 0, 1 << 20  # in place of a cost

WALL_PERCENT = 33  # the chance of a wall inside
BORDER_WALLS = (4, 8)  # how many walls the border may have
# Draws of a path, at most: origin's side, start, end, the walls inside, how many and which of the border, and the cost
# between each two neighbours.
DRAWS = 3 + len(INSIDE) + 1 + 8 + 2 * SIDE * (SIDE - 1)
SPARE_DRAWS = 7  # for numbers that have to be drawn again, one in ten million


class Level(NamedTuple):
    """What the generator decides at a reset, and for every further segment of an endless path."""

    path: list[int]  # its cells, from the origin to the goal
    walls: list[list[int]]  # the nodes of each segment that the path avoids


def read_ahead(rng: np.random.Generator, paths: int) -> WordBuffer:
    """The words that sampling so many paths may take. Asking the generator for one at a time is slow."""
    return WordBuffer(rng, paths * (DRAWS + SPARE_DRAWS))


def sample_level(rng: np.random.Generator, values: dict[str, Any], endless: bool) -> Level:
    """Samples a level. It draws in the original's order, so that a seed builds the same level."""
    buffer = read_ahead(rng, FIRST_SEGMENTS if endless else 1)
    if endless:
        level = sample_segments(buffer, sample_below(buffer, SIDE), 0, FIRST_SEGMENTS)
    else:
        side = pick(buffer, values["cardinal_origin_choice"])
        start, end = sample_below(buffer, SIDE), sample_below(buffer, SIDE)
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
    """Samples `count` segments of an endless path, which starts in this row of segment number `first`."""
    path, every_wall = [], []
    for segment in range(first, first + count):
        start, end = row, (SIDE - 1) * SIDE + sample_below(buffer, SIDE)
        walls = sample_walls(buffer, start, end)
        path += cells_of(sample_path(buffer, walls, start, end), segment)
        path.append(path[-1] + ROWS)  # the transition tile
        every_wall.append(walls)
        row = end % SIDE
    return Level(path, every_wall)


def sample_walls(buffer: WordBuffer, start: int, end: int) -> list[int]:
    """The nodes that the path avoids: some inside, and some on the border that touch neither those nor start and end.

    So there always is a path: along the border, and one ring further inside past the walls of the border.
    """
    walls, reserved = buffer.sample_each(INSIDE, WALL_PERCENT), NEAR_END[start] | NEAR_END[end]
    for node in walls:
        reserved |= AROUND_WALL[node]
    border = CANDIDATES[0][reserved & 255] + CANDIDATES[1][reserved >> 8 & 255] + CANDIDATES[2][reserved >> 16]
    return walls + buffer.take_random(border, BORDER_WALLS[sample_below(buffer, 2)])


def sample_path(buffer: WordBuffer, walls: list[int], start: int, end: int) -> list[int]:
    """The path that A* finds over random costs, not always the cheapest: its nodes from start to end."""
    costs, used, distance = buffer.eighths, buffer.used, DISTANCES[end]
    cost, total, previous = [UNREACHED] * (SIDE * SIDE), [0.0] * (SIDE * SIDE), [start] * (SIDE * SIDE)
    for node in walls:
        cost[node] = CLOSED
    opened, first, here, so_far = [], None, start, 1
    while here != end:
        cost[here] = CLOSED
        for node in NEIGHBOURS[here]:
            if cost[node]:
                there = so_far + costs[used]  # a cost of 1 to 8
                used += 1
                if cost[node] == UNREACHED:
                    cost[node], total[node], previous[node] = there, there + distance[node], here
                    opened.append(node)
                elif there < cost[node]:
                    # The original leaves the higher cost as it is.
                    previous[node] = here
        # As in the original, the next node is not the one of the least total. It is the first one in the queue whose
        # total is below that of the queue's first, or else the queue's first itself. So while that stays first, the
        # nodes that were passed over need no second comparison.
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
    while path[-1] != start:
        path.append(previous[path[-1]])
    return path[::-1]


def cells_of(nodes: list[int], segment: int) -> list[int]:
    """The map's cells of this segment's nodes."""
    shift = segment * SEGMENT * ROWS
    return [CELLS[node] + shift for node in nodes]


def start_episode(s: State, lane: int, rng: np.random.Generator, values: dict[str, Any], endless: bool) -> None:
    """Starts the lane's next episode, with these reset options."""
    level = sample_level(rng, values, endless)
    s.step_at[lane] = PIT
    s.fell_at[lane] = s.walls[lane] = s.fallen[lane] = s.shows_cross[lane] = False
    s.path_length[lane] = s.segments[lane] = s.max_column[lane] = s.fails[lane] = s.visited[lane] = 0
    s.length[lane] = s.episode_return[lane] = 0
    write_path(s, lane, level, endless)
    s.reached[lane] = 0
    s.reached[lane, PIT] = s.reached[lane, ORIGIN] = UNREWARDED
    if not endless:
        s.reached[lane, len(level.path)] = UNREWARDED  # the goal has a reward of its own
    column, row = divmod(level.path[0] - PIT_ROWS, ROWS)
    # As in the original, this is the middle of the tile only for an agent of the default size.
    radius = int(s.radius[lane])
    x, y = column * TILE + radius, row * TILE + radius
    s.pos[lane] = s.origin[lane] = x + PAD, y + PAD
    s.tile[lane] = x // TILE, y // TILE
    s.facing[lane] = 6 if endless else 0
    s.path_step[lane], s.last_path_step[lane] = NO_STEP, ORIGIN  # the first step lands on it
    s.next_direction[lane] = s.direction_at[lane, ORIGIN]
    s.stamina[lane] = s.stamina_level[lane]


def write_path(s: State, lane: int, level: Level, endless: bool) -> None:
    """Appends to the lane's path, for which the state may have to grow."""
    first, before = int(s.path_length[lane]) + 1, int(s.segments[lane])
    last, segments = first + len(level.path), before + len(level.walls)
    room = s.fell_at.shape[1] // (SEGMENT * ROWS)  # for segments
    if last > s.path_cell.shape[1] or segments > room:
        # At least by half, so that a path that grows for long seldom has to be copied.
        make_room(s, "P", max(last, s.path_cell.shape[1] * 3 // 2))
        make_room(s, "M", max(segments, room * 3 // 2) * SEGMENT * ROWS)
    s.path_cell[lane, first:last] = level.path
    path = s.path_cell[lane, first:last]
    s.step_at[lane][path] = np.arange(first, last)
    s.direction_at[lane, first : last - 1] = DIRECTIONS[path[1:] - path[:-1]]
    # After a transition tile the path goes on to the right. At the goal, the direction is the one that leads to it.
    s.direction_at[lane, last - 1] = EAST if endless else s.direction_at[lane, last - 2]
    s.path_length[lane] = last - 1
    for segment, walls in enumerate(level.walls, before):
        s.walls[lane, cells_of(walls, segment)] = True
    s.segments[lane] = segments


def append_segment(s: State, lane: int, rng: np.random.Generator) -> None:
    """Appends a segment to the lane's endless path, for which the state may have to grow."""
    buffer = read_ahead(rng, 1)
    row = int(s.path_cell[lane, s.path_length[lane]]) % ROWS - PIT_ROWS
    level = sample_segments(buffer, row, int(s.segments[lane]), 1)
    buffer.close()
    write_path(s, lane, level, endless=True)
