"""Drawing: floors, symbols and whole frames. Shape letters: F floors, n lanes."""

from functools import cache

import numpy as np

from memory_gym_envs.character import FACINGS
from memory_gym_envs.drawing import ROW, SCREEN, Sheet, paste, read_only, ring, tile_picture, turned
from memory_gym_envs.mortar_mayhem.arena import COMMANDS, FLOORS, TILE, first_pixel
from memory_gym_envs.mortar_mayhem.state import State
from memory_gym_envs.state import Lanes

CALM_TILE, CALM_EDGE = (21, 43, 77), (29, 60, 107)  # blue
BURNING_TILE, BURNING_EDGE = (81, 18, 26), (112, 24, 36)  # red
SYMBOL, SYMBOL_AT = 24, 31  # width of the symbols' square, and its first pixel on both axes


@cache
def floors() -> np.ndarray:
    """(F, FRAME) uint8, read-only: the pictures of FLOORS, without an agent."""
    calm, burning = tile_picture(TILE, CALM_TILE, CALM_EDGE), tile_picture(TILE, BURNING_TILE, BURNING_EDGE)
    table = np.zeros((len(FLOORS), SCREEN, SCREEN, 3), np.uint8)
    for frame, (size, safe) in zip(table, FLOORS, strict=True):
        for x in range(size):
            for y in range(size):
                top, left = first_pixel(size) + TILE * y, first_pixel(size) + TILE * x
                frame[top : top + TILE, left : left + TILE] = calm if safe in (None, (x, y)) else burning
    return read_only(table.reshape(len(FLOORS), -1))


@cache
def symbols() -> np.ndarray:
    """(10, SYMBOL, 3 * SYMBOL) uint8, read-only: BLANK, then the commands. White on black, to be drawn by `|`."""
    arrow, circle = arrow_mask(), ring(22, 10, 10, 10, 2)
    circle[9:11, :20] = True
    # A turned arrow's square is larger. It keeps the top left corner, so it sits lower and further to the right.
    masks = {"stay": circle}
    for quarter, (straight, diagonal) in enumerate(
        [("right", "right_up"), ("up", "left_up"), ("left", "left_down"), ("down", "right_down")]
    ):
        masks[straight], masks[diagonal] = np.rot90(arrow, quarter), turned(arrow, 45 + 90 * quarter, 31)
    table = np.zeros((1 + len(COMMANDS), SYMBOL, SYMBOL, 3), np.uint8)
    for command, name in enumerate(COMMANDS):
        mask = masks[name][:SYMBOL, :SYMBOL]
        table[1 + command, : len(mask), : len(mask)][mask] = 255
    return read_only(table.reshape(-1, SYMBOL, 3 * SYMBOL))


def arrow_mask() -> np.ndarray:
    """(22, 22) bool: an arrow to the right, two pixels thick: a shaft and a head of two 45-degree strokes."""
    rows, columns = np.indices((22, 22))
    aside = np.abs(rows - 10)
    head = (aside <= 10) & (columns + aside >= 20) & (columns + aside <= 21)
    return head | ((rows >= 10) & (rows <= 11) & (columns <= 20))


def draw(s: State, sheet: Sheet, lanes: Lanes) -> np.ndarray:
    """Fresh frames of the lanes, (n, 84, 84, 3) uint8, from the state alone."""
    frames = floors().take(s.floor[lanes], axis=0)  # (n, FRAME)
    paste(frames, sheet, s.figure[lanes] * FACINGS + s.facing[lanes], s.pos[lanes])
    symbol = s.symbol[lanes]
    if np.count_nonzero(symbol):
        square = frames.reshape(-1, SCREEN, ROW)[:, SYMBOL_AT : SYMBOL_AT + SYMBOL, 3 * SYMBOL_AT :][..., : 3 * SYMBOL]
        square |= symbols().take(symbol, axis=0)  # (n, SYMBOL, 3 * SYMBOL)
    return frames.reshape(-1, SCREEN, SCREEN, 3)
