"""What a frame tells of the agent: where it is and which way it faces, as far as nothing hides it.

The screen's edge, a symbol or a cross may hide so much of an agent that several positions and facings look the same.
The tables made here say which, so that a vector observation knows no more than who sees the frame.
Shape letters: R sprites (the facings of all views), W a sprite's width, P stored positions along one axis.
"""

from typing import NamedTuple

import numpy as np

from memory_gym_envs.character import FACINGS, LARGEST_RADIUS, PAD, PIXELS, SPAN, radius_of
from memory_gym_envs.drawing import SCREEN, with_margin
from memory_gym_envs.entries import Entries, vector_slices

UNSEEN = SPAN  # the position of an agent of which nothing shows, and its size
# What entries say, by their code: stored positions, then UNSEEN, then sizes.
BODY_SIZES = np.arange(1 + LARGEST_RADIUS) / LARGEST_RADIUS
VALUES = np.concatenate([PIXELS / SCREEN, BODY_SIZES]).astype(np.float32)
FLAGS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1, bitorder="little").astype(np.float32)
HIDDEN = (UNSEEN, UNSEEN, UNSEEN, 0)  # the codes
POSITION_STRIDES = np.array([1, SPAN])
CORNERS = np.array([(0, 0), (1, 0), (0, 1), (1, 1)])  # (4, 2) of a square, in units of its width


def agent_entries(low: int, high: int) -> tuple[Entries, ...]:
    """The first entries of a vector, for agents whose centre stays between these pixels on both axes."""
    size = f"radius of the agent's body, / {LARGEST_RADIUS} pixels; 0: none of it is visible"
    centre = "the agent's centre, x and y, / 84 pixels"
    facing = "the agent's facing, one-hot"
    ends = min(low / SCREEN, 0.0), high / SCREEN
    return Entries("size", 1, size), Entries("place", 2, centre, *ends), Entries("facing", FACINGS, facing)


class View(NamedTuple):
    """An agent of one size, where it may be, and what lies over it."""

    scale: float
    image: np.ndarray  # (FACINGS, W, W, 3) uint8: the agent, with what moves with it
    solid: np.ndarray  # (FACINGS, W, W) bool: what of that is drawn
    free: np.ndarray  # (SCREEN, SCREEN) bool: where nothing lies over it
    columns: range  # where its centre may be, stored positions along x
    rows: range  # and along y


class AppearanceTables(NamedTuple):
    """The tables of all views in use, stacked: row view * FACINGS + facing is a sprite's."""

    codes: np.ndarray  # (R * P * P, 4) uint8: codes of size, x and y, and the facings as bits
    solid: np.ndarray  # (R, W + 2, W + 2) bool: the sprites with a transparent rim

    def covered(self, sprite: np.ndarray, pos: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Which pixels lie under the agents: (n, k) bool for points (n, k, 2), x and y with PAD."""
        width = self.solid.shape[1]
        pixel = (points - pos[:, None] + width // 2).clip(0, width - 1)
        return self.solid[sprite[:, None], pixel[..., 1], pixel[..., 0]]


def tables_of(views: list[View]) -> AppearanceTables:
    """Prepares the views."""
    width = max(view.solid.shape[1] for view in views) + 2
    solids = [with_margin(view.solid, (width - view.solid.shape[1]) // 2) for view in views]
    return AppearanceTables(np.concatenate([appearance_codes(view) for view in views]), np.concatenate(solids))


def appearance_codes(view: View) -> np.ndarray:
    """(FACINGS * P * P, 4) uint8: AppearanceTables.codes of one view. What looks the same has the same codes."""
    hashes = appearance_hashes(view)
    _, kind = np.unique(hashes, return_inverse=True)
    kind = kind.reshape(-1)
    facing, y, x = (index.reshape(-1) for index in np.indices(hashes.shape))
    same_look, count = np.zeros((kind.max() + 1, FACINGS), bool), np.bincount(kind)
    same_look[kind, facing] = True
    column, row = (np.rint(np.bincount(kind, index) / count) for index in (x, y))
    size = np.full_like(count, UNSEEN + radius_of(view.scale))
    facings = np.packbits(same_look, axis=1, bitorder="little")
    codes = np.column_stack([size, column + view.columns.start, row + view.rows.start, facings]).astype(np.uint8)
    codes[kind[hashes.reshape(-1) == 0]] = HIDDEN
    table = np.full((FACINGS, SPAN, SPAN, len(HIDDEN)), HIDDEN, np.uint8)
    reach = (slice(None), slice(view.rows.start, view.rows.stop), slice(view.columns.start, view.columns.stop))
    table[reach] = codes[kind].reshape(*hashes.shape, len(HIDDEN))
    return table.reshape(-1, len(HIDDEN))


def appearance_hashes(view: View) -> np.ndarray:
    """(FACINGS, rows, columns) uint64: numbers that differ where the agents look different; 0 where nothing shows.

    The sum over all pixels that show of their colour times their weight, a random number for each pixel of the screen.
    So two pictures have the same number by a chance of one in 2**64.
    """
    color = (view.image.astype(np.uint64) @ np.array([1 << 16, 1 << 8, 1], np.uint64) + 1) * view.solid
    # Along a row of equal pixels the sum is the difference of two partial sums, so that only edges count.
    edges = -np.diff(color, axis=2, prepend=np.uint64(0), append=np.uint64(0))  # (FACINGS, W, W + 1)
    width = color.shape[1]
    weights = np.random.default_rng(0).integers(0, 1 << 64, (SCREEN, SCREEN), np.uint64) * view.free
    before = PAD + width // 2
    weights = np.pad(weights, (before, width + SPAN - before - SCREEN))
    sums = np.pad(np.cumsum(weights, axis=1), ((0, 0), (1, 0)))
    rows, columns = view.rows, view.columns
    hashes = np.zeros((FACINGS, len(rows), len(columns)), np.uint64)
    for facing, row, column in np.argwhere(edges):
        reach = sums[rows.start + row : rows.stop + row, columns.start + column : columns.stop + column]
        hashes[facing] += edges[facing, row, column] * reach
    return hashes


class VectorTables(NamedTuple):
    """What writing vectors needs besides the state."""

    at: dict[str, slice]  # where the entries are in a vector; the agent's are the first
    width: int  # V
    appearance: AppearanceTables
    lane_sprite: np.ndarray  # (N,) the first sprite of the lane's agent in them
    large: bool  # whether some agent is wider than a tile, and so may hide one

    def write_agents(self, out: np.ndarray, sprite: np.ndarray, pos: np.ndarray) -> None:
        """Writes the entries of the agents with these sprites (n,) at these positions (n, 2) to out, (n, V)."""
        codes = self.appearance.codes.take(sprite * (SPAN * SPAN) + pos.dot(POSITION_STRIDES), axis=0)  # (n, 4)
        out[:, :3] = VALUES.take(codes[:, :3])
        out[:, 3 : 3 + FACINGS] = FLAGS.take(codes[:, 3], axis=0)


def vector_tables(
    entries: tuple[Entries, ...], appearance: AppearanceTables, lane_sprite: np.ndarray, scales: list[float], tile: int
) -> VectorTables:
    """The tables for vectors of these entries, and agents of these sizes on tiles of so many pixels."""
    at = vector_slices(entries)
    large = any(2 * radius_of(scale) > tile for scale in scales)
    return VectorTables(at, at[entries[-1].name].stop, appearance, lane_sprite, large)
