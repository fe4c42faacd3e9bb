"""Vector observations. Shape letters: F floors, N lanes, n some of them, V entries of a vector observation."""

from functools import cache, lru_cache

import numpy as np

from memory_gym_envs.appearance import CORNERS, AppearanceTables, VectorTables, View, tables_of
from memory_gym_envs.character import FACINGS, PAD, Figure, sprites
from memory_gym_envs.drawing import SCREEN, read_only
from memory_gym_envs.mortar_mayhem.arena import ARENA_SIZES, COMMANDS, FLOORS, TILE, first_pixel, tile_tables
from memory_gym_envs.mortar_mayhem.drawing import SYMBOL, SYMBOL_AT, symbols
from memory_gym_envs.mortar_mayhem.state import State
from memory_gym_envs.state import Lanes

# (10, 9) a command as one-hot, for every symbol; BLANK: zeros
COMMAND_ENTRIES = read_only(np.eye(1 + len(COMMANDS), dtype=np.float32)[:, 1:])


@lru_cache(maxsize=16)
def appearance_tables(figures: tuple[Figure, ...], clue: bool) -> AppearanceTables:
    """What shows of these figures behind every symbol; without a clue, behind none."""
    free = ~symbol_masks() if clue else ~symbol_masks()[:1]
    views = []
    for figure in figures:
        around = (figure.reach + 1) // 2 if figure.torus else 0
        reach = range(PAD - around, PAD + SCREEN + around + 1)
        image, solid = sprites(figure.scale)
        views += [View(figure.scale, image, solid, each, reach, reach) for each in free]
    return tables_of(views)


@cache
def symbol_masks() -> np.ndarray:
    """(10, SCREEN, SCREEN) bool, read-only: where each symbol is drawn."""
    masks = np.zeros((len(symbols()), SCREEN, SCREEN), bool)
    square = slice(SYMBOL_AT, SYMBOL_AT + SYMBOL)
    masks[:, square, square] = symbols()[:, :, ::3] > 0
    return read_only(masks)


@cache
def floor_entries() -> np.ndarray:
    """(F, 4) float32, read-only: arena, fire and safe tile of every floor."""
    size, fire = np.array([(size / ARENA_SIZES[-1], tile is not None) for size, tile in FLOORS]).T
    safe = (tile_tables().corner - PAD + TILE // 2) / SCREEN * fire[:, None]
    return read_only(np.column_stack([size, fire, safe]).astype(np.float32))


def make_vectors(s: State, tables: VectorTables, lanes: Lanes) -> np.ndarray:
    """Fresh vector observations of the lanes, (n, V) float32."""
    at = tables.at
    sprite = tables.lane_sprite[lanes] + s.facing[lanes]  # (n,)
    out = np.empty((len(sprite), tables.width), np.float32)
    if "command" in at:
        symbol = s.symbol[lanes]
        sprite += symbol * FACINGS
        out[:, at["command"]] = COMMAND_ENTRIES.take(symbol, axis=0)
    else:
        out[:, at["commands"]] = s.vector[lanes]
    tables.write_agents(out, sprite, s.pos[lanes])
    floor = out[:, at["arena"].start : at["safe"].stop]  # (n, 4)
    floor[:] = floor_entries().take(s.floor[lanes], axis=0)
    if tables.large:
        hide_floor(floor, s, lanes, sprite, tables.appearance)
    return out


def hide_floor(out: np.ndarray, s: State, lanes: Lanes, sprite: np.ndarray, tables: AppearanceTables) -> None:
    """Clears the floor's entries (n, 4) of what large agents hide, in place.

    It checks eight pixels alone: the corners of the arena and of the target tile. The arena shows if one of its corners
    does, the fire if one of these burns, the safe tile if one of its own corners does.
    """
    size = s.size[lanes]
    first = first_pixel(size) + PAD  # (n,)
    arena = first[:, None, None] + CORNERS * (TILE * size - 1)[:, None, None]  # (n, 4, 2)
    tile = s.target_corner[lanes][:, None] + CORNERS * (TILE - 1)  # (n, 4, 2)
    points = np.concatenate([arena, tile], axis=1)  # (n, 8, 2)
    x, y = np.moveaxis(points - PAD, -1, 0)
    shown = ~tables.covered(sprite, s.pos[lanes], points) & ~symbol_masks()[s.symbol[lanes][:, None], y, x]  # (n, 8)
    shows_fire = shown[:, :4] & (arena != tile).any(axis=-1)
    out[:, 0] *= shown[:, :4].any(axis=1)
    out[:, 1:] *= shows_fire.any(axis=1)[:, None]
    out[:, 2:] *= shown[:, 4:].any(axis=1)[:, None]
