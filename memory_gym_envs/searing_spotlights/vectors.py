"""Vector observations.

All that a vector says of what is below the bar comes from every third pixel, by its colour.
Shape letters: N lanes, n some of them, m some of those, S spotlights, K bodies, V entries of a vector, U uint64s.
"""

from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from memory_gym_envs import bits
from memory_gym_envs.bits import FULL_ROW, ITEMS, POSITION_0, POSITIONS, ROW_STEP, SUBSAMPLE_ROWS, Stencils
from memory_gym_envs.character import FACINGS, sprites
from memory_gym_envs.colors import BLUE, GREEN
from memory_gym_envs.drawing import SCREEN, read_only
from memory_gym_envs.entries import vector_slices
from memory_gym_envs.searing_spotlights import drawing
from memory_gym_envs.searing_spotlights.drawing import ACTION_COLORS, BLUE_FLOOR, TOP_BAR, YELLOW, Scales
from memory_gym_envs.searing_spotlights.state import ABOVE_BAR, AGENT, BELOW_BAR, COIN, EXIT, FADE, UNDER, State
from memory_gym_envs.state import Lanes
from memory_gym_envs.variant import Variant

FAINT = 252  # the highest opacity at which an agent, (3, 3, 2) then, still differs from white floor
SLIGHT = 5  # the highest opacity that may leave some colours as they are
FIRST_RIM = 51  # the lowest opacity at which a rim differs from all colours under it, if only by 1
ROWS_BELOW = np.where(np.arange(0, SCREEN, ROW_STEP) < TOP_BAR, np.uint64(0), FULL_ROW)  # (42,) below the bar
TILE_SHARE = 1 / bits.tile_counts(ROWS_BELOW[None]).astype(np.float32)  # (1, 49)
FULL_SHARE = TILE_SHARE.min()  # of a tile beside the bar
BLUE_TILES = (drawing.floors()[BLUE_FLOOR].reshape(SCREEN, SCREEN, 3) == BLUE).all(axis=-1)  # or the red ones
BLUE_SUBSAMPLE = bits.subsampled_rows(BLUE_TILES[::ROW_STEP])[:, 0]  # (42,)
NO_BITS = np.uint64(0)
READING = slice(0, 8)  # the entries that are read from the bar
# By opacity: (256, 2) all bits where the darkness changes nothing, and where it hides nothing; and the brightness of
# the floor, (256,), where the darkness changes something but hides nothing.
VEIL = (np.arange(256)[:, None] <= (SLIGHT, FAINT)) * FULL_ROW
DUSK = ((1 - np.arange(256) / 255) * (VEIL[:, 1] > VEIL[:, 0])).astype(np.float32)


@cache
def readings(endless: bool) -> np.ndarray:
    """(4 * BARS_PER_CHOICE, 8) float32, read-only: what each of bars() says."""
    return read_only(read_bars(drawing.bars(endless).reshape(-1, SCREEN, 3)))


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
    body_entries: slice  # those on the bodies
    bars: np.ndarray
    readings: np.ndarray
    shapes: Stencils  # subsamples: spotlights by radius, figures in all facings, coin, exit and door for each scale
    rims: Stencils  # subsamples of spotlights' outlines
    high: Stencils  # masks of the bar's rows with the same shapes
    # The exit's door follows the bodies in the next two; the endless id has none, and K rows.
    key: np.ndarray  # (K + 1, N) where the lanes' bodies are in those tables
    bodies: np.ndarray  # (K + 1,) their numbers in State.bodies
    coin: int  # which of the bodies is the first coin
    has_hands: np.ndarray  # (N,) bool: the agent has hands, which show its facing


def make_vector_tables(
    s: State, variant: Variant, radii: tuple[int, int], figure_scales: tuple[float, ...], scales: Scales
) -> VectorTables:
    """The tables for the lanes of this state.

    radii: the smallest and the largest spotlight. figure_scales: of each two figures, which State.figure numbers.
    scales: those that State.coin_sprite numbers.
    """
    first, coins = radii[1] + 1, s.bodies.shape[2] - COIN
    agent = first + s.figure // 2 * FACINGS  # (N,) each
    coin = first + len(figure_scales) * FACINGS + s.coin_sprite
    exit_, door = coin + 1, coin + 2
    if variant.endless:
        key, bodies = [agent, coin], [AGENT, COIN]
    else:
        key, bodies = [agent, exit_, *[coin] * coins, door], [AGENT, EXIT, *range(COIN, COIN + coins), EXIT]
    shapes, rims, high = vector_shapes(*radii, figure_scales, scales)
    at = vector_slices(variant.entries)
    return VectorTables(
        width=at["alarm"].stop,
        at=at,
        body_entries=slice(at["agent"].start, at["coin"].stop),
        bars=drawing.bars(variant.endless),
        readings=readings(variant.endless),
        shapes=shapes,
        rims=rims,
        high=high,
        key=np.stack(key) * POSITIONS + POSITION_0,
        bodies=np.array(bodies),
        coin=1 if variant.endless else COIN,
        has_hands=np.array([int(10 * scale) > 0 for scale in figure_scales])[s.figure // 2],
    )


@lru_cache(maxsize=16)
def vector_shapes(
    least: int, largest: int, figure_scales: tuple[float, ...], scales: Scales
) -> tuple[Stencils, Stencils, Stencils]:
    """VectorTables' shapes, rims and high. Cached: environments with equal options share them."""
    disks, rims = drawing.spot_shapes(least, largest)
    figures = [solid for scale in figure_scales for solid in sprites(scale)[1]]
    images, solids = drawing.draw_coins_and_exits(scales)
    # An exit's frame is as black as the dark, so only its door is visible.
    things = [each for i in range(0, len(solids), 3) for each in (*solids[i : i + 2], images[i + 1].any(axis=-1))]
    shapes = disks + figures + things
    return bits.subsample_stencils(shapes), bits.subsample_stencils(rims), bits.stencils(shapes, TOP_BAR)


class SubsampledFrames(NamedTuple):
    """n lanes' frames, subsampled, (n, 42) uint64 each, and the K bodies in them."""

    opacity: np.ndarray  # (n,) of the darkness
    lit: np.ndarray  # pixels that the darkness leaves as they are
    clear: np.ndarray  # pixels that it does not hide
    rim: np.ndarray | None  # white rims of spotlights; None: no lane has rims
    x: np.ndarray  # (K, n) where the bodies are, as keys of VectorTables.shapes
    y: np.ndarray  # (K, n)
    raised: np.ndarray  # (m,) which of the frames may have bodies above the darkness
    layer: np.ndarray | None  # (K, m, 1) where those are: UNDER it, BELOW_BAR or ABOVE_BAR
    cover: np.ndarray  # (K, n, 42) what each body covers
    seen: np.ndarray  # (K, n, 42) what is visible of it
    floor: np.ndarray  # what nothing covers


def make_vectors(s: State, g: VectorTables, lanes: Lanes) -> np.ndarray:
    """The vectors of the lanes, (n, V) float32, from the state alone. No frame is drawn.

    They depend on the colours of the bar and of every third pixel below it, so equal frames have equal vectors.
    """
    subsampled = subsample_frames(s, g, lanes)
    out = np.zeros((len(subsampled.lit), g.width), np.float32)
    write_bar(s, g, lanes, subsampled, out)
    write_rest(s, g, lanes, subsampled, out)
    return out


def subsample_frames(s: State, g: VectorTables, lanes: Lanes) -> SubsampledFrames:
    """The lanes' frames, subsampled."""
    spot_key, each = s.spot_place[:, lanes, : int(s.num_spots.max())], np.arange(len(s.pos))[lanes]
    spots, has_exit = spot_key.shape[2], g.coin == COIN
    key = np.empty((2, spots + len(g.key), len(each)), np.int64)
    key[:, :spots] = spot_key.transpose(0, 2, 1)
    np.add(s.bodies[:, lanes].transpose(0, 2, 1)[:, g.bodies], g.key[:, lanes], out=key[:, spots:])
    key[:, spots + AGENT] += s.drawn_facing[lanes] * POSITIONS
    shapes = g.shapes.at(*key)  # (S + K + 1, n, 42)
    lit, rim = drawing.overlay(shapes[:spots], g.rims, key[:, :spots], s.rim[lanes])
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
    return SubsampledFrames(opacity, lit, clear, rim, x, y, raised, layer, cover, seen, floor)


def layers(s: State, g: VectorTables, lanes: Lanes) -> tuple[np.ndarray, np.ndarray | None]:
    """SubsampledFrames' raised and layer."""
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
    """The same where some bodies are above the darkness, in front of all others. layer: (K, n, 1)."""
    above = np.where(layer == UNDER, NO_BITS, cover)
    free = ~np.bitwise_or.reduce(above, axis=0)
    seen_above, _ = visible_parts(above, np.where(layer == ABOVE_BAR, FULL_ROW, ROWS_BELOW), FULL_ROW)
    seen_below, floor = visible_parts(cover ^ above, clear & free)
    return seen_above | seen_below, floor & free


def write_bar(s: State, g: VectorTables, lanes: Lanes, subsampled: SubsampledFrames, out: np.ndarray) -> None:
    """Writes health, actions and reward."""
    rows = drawing.bar_rows(s, lanes)
    out[:, READING] = g.readings.take(rows, axis=0)
    if subsampled.layer is not None and (subsampled.layer == ABOVE_BAR).any():
        high, over_bar = subsampled.raised, subsampled.layer == ABOVE_BAR  # (m,), (K, m, 1)
        cover = g.high.at(subsampled.x[:, high], subsampled.y[:, high]) * over_bar  # (K, m, U)
        left = ~np.bitwise_or.reduce(cover, axis=0).view(np.uint16).reshape(-1, TOP_BAR, ITEMS)
        columns = bits.unpacked(np.bitwise_or.reduce(left, axis=1))  # (m, 84) those of which anything is left
        out[high, READING] = read_bars(g.bars[rows[high]].reshape(-1, SCREEN, 3) * columns[..., None])


def write_rest(s: State, g: VectorTables, lanes: Lanes, subsampled: SubsampledFrames, out: np.ndarray) -> None:
    """Writes the other entries."""
    cover, seen, (bodies, n, _) = subsampled.cover, subsampled.seen, subsampled.seen.shape
    bright, visible = subsampled.lit & subsampled.floor, subsampled.clear & subsampled.floor
    dusk = DUSK.take(subsampled.opacity)
    if subsampled.rim is not None:
        bright = np.where(s.rim[lanes][:, None], rims_left(subsampled, subsampled.rim), bright)
        dusk = dusk * ~s.rim[lanes]
    lines = np.empty((bodies + 3, n, SUBSAMPLE_ROWS), np.uint64)
    lines[:bodies] = seen
    np.bitwise_and(cover[AGENT] & ROWS_BELOW, ~seen[AGENT], out=lines[bodies])  # hidden parts of the agent
    np.bitwise_xor(visible, bright, out=lines[bodies + 1])  # visible floor outside of the light
    np.bitwise_and(visible, BLUE_SUBSAMPLE, out=lines[bodies + 2])  # visible floor that is blue or red
    any_ = np.bitwise_or.reduce(lines, axis=2) != 0  # (K + 3, n)
    out[:, g.at["dusk"].start] = dusk * any_[-2]
    out[:, g.at["alarm"].start] = (s.floor & s.reddens)[lanes] * any_[-1]
    write_bodies(g, seen, any_[:bodies], out)
    (whole,) = (any_[AGENT] & ~any_[bodies] & g.has_hands[lanes]).nonzero()
    out[whole, g.at["facing"].start + s.drawn_facing[lanes][whole]] = 1
    if "exit" in g.at:
        out[:, g.at["exit_open"].start] = s.is_open[lanes] * any_[EXIT]
    write_tiles(g, seen, any_[:bodies], bright, out)


def write_bodies(g: VectorTables, seen: np.ndarray, any_: np.ndarray, out: np.ndarray) -> None:
    """Writes how much of the bodies is visible, and where. any_: (K, n) whether any is."""
    (bodies, n), kinds = any_.shape, g.coin + 1
    body, lane = any_.nonzero()
    total = bits.sums(seen[body, lane])  # (hits, 3)
    if bodies > kinds:
        each = np.zeros((bodies, n, 3), np.float32)
        each[body, lane] = total
        each[g.coin] = each[g.coin :].sum(axis=0)
        body, lane = each[:kinds, :, 0].nonzero()
        total = each[body, lane]
    total[:, 1:] /= SCREEN * total[:, :1]
    np.minimum(total[:, 0] * FULL_SHARE, 1, out=total[:, 0])
    out[:, g.body_entries].reshape(n, kinds, 3)[lane, body] = total


def write_tiles(g: VectorTables, seen: np.ndarray, any_: np.ndarray, bright: np.ndarray, out: np.ndarray) -> None:
    """Writes which share of each tile is light and which is coins (not in the endless id). any_: (K, n) as above."""
    if "coins" not in g.at:
        out[:, g.at["light"]] = bits.tile_counts(bright) * TILE_SHARE
        return
    lanes = np.flatnonzero(any_[g.coin :].any(axis=0))
    coins = np.bitwise_or.reduce(seen[g.coin :, lanes], axis=0)
    share = bits.tile_counts(np.concatenate([bright, coins])) * TILE_SHARE
    out[:, g.at["light"]], out[lanes, g.at["coins"]] = share[: len(bright)], share[len(bright) :]


def rims_left(subsampled: SubsampledFrames, rim: np.ndarray) -> np.ndarray:
    """What is visible of these rims, (n, 42): none in a faint darkness, and nothing under bodies above the darkness."""
    rim = rim & ROWS_BELOW & -(subsampled.opacity >= FIRST_RIM)[:, None].astype(np.uint64)
    if subsampled.layer is not None:
        above = np.where(subsampled.layer == UNDER, NO_BITS, subsampled.cover[:, subsampled.raised])
        rim[subsampled.raised] &= ~np.bitwise_or.reduce(above, axis=0)
    return rim
