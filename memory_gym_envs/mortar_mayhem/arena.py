"""The arena: its sizes, its tiles, the commands and where they lead.

A floor is an arena of one size, either calm or burning everywhere but on one tile. Floors are numbered by their row in
FLOORS. A tile is known by the number of the floor that burns around it.
Shape letter: F floors.
"""

from functools import cache
from typing import NamedTuple, TypeVar

import numpy as np

from memory_gym_envs.character import PAD
from memory_gym_envs.drawing import SCREEN, read_only

TILE = 14  # width of a tile in pixels
ARENA_SIZES = range(2, 7)  # tiles along one side of the arena
TORUS_SIZE = 6  # fills the screen

# In the original's order: allowed_commands=k allows the first k.
COMMANDS = ("right", "down", "left", "up", "stay", "right_down", "right_up", "left_down", "left_up")
MOVES = np.array([(1, 0), (0, 1), (-1, 0), (0, -1), (0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)])  # (9, 2) tiles

# (arena size, None): the calm floor. (arena size, (column, row)): the floor that burns around this tile.
FLOORS = [(size, tile) for size in ARENA_SIZES for tile in (None, *((x, y) for x in range(size) for y in range(size)))]

Size = TypeVar("Size", int, np.ndarray)


def first_pixel(size: Size) -> Size:
    """The first pixel of an arena of this size, on both axes. size: one, or many in an array."""
    return SCREEN // 2 - TILE * size // 2


class TileTables(NamedTuple):
    """Look-up tables with a row for each floor: its safe tile, or on a calm floor the tile in the top left corner."""

    corner: np.ndarray  # (F, 2) the tile's first pixel, x and y, with PAD
    truth: np.ndarray  # (F, 2) float64: the tile's column and row, divided by arena size - 1
    next: np.ndarray  # (F, 9) the tile that each command leads to, on a torus


@cache
def tile_tables() -> TileTables:
    """The tables of all tiles."""
    numbers = {floor: number for number, floor in enumerate(FLOORS)}
    tiles = [(size, *(tile or (0, 0))) for size, tile in FLOORS]
    corner = [[first_pixel(size) + PAD + TILE * x, first_pixel(size) + PAD + TILE * y] for size, x, y in tiles]
    truth = [[x / (size - 1), y / (size - 1)] for size, x, y in tiles]
    ahead = [[numbers[size, ((x + dx) % size, (y + dy) % size)] for dx, dy in MOVES.tolist()] for size, x, y in tiles]
    return TileTables(*(read_only(np.array(table)) for table in (corner, truth, ahead)))
