"""Frames and their tables. Shape letters: n lanes, S spotlights that fit, R sprites, W a sprite's width, U uint64s."""

from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from memory_gym_envs.base import NO_LIMIT
from memory_gym_envs.bits import NO_SHAPE, Stencils, pixels, stencils
from memory_gym_envs.character import FACINGS
from memory_gym_envs.colors import BLUE, GREEN, RED, WHITE
from memory_gym_envs.drawing import FRAME, ROW, SCREEN, Sheet, disk, make_sheet, paste, read_only, ring
from memory_gym_envs.searing_spotlights.state import ABOVE_BAR, BELOW_BAR, COIN, EXIT, FADE, GONE, UNDER, State
from memory_gym_envs.state import Lanes

TILE = 12  # pixels; the floor is a chessboard
TOP_BAR = 4  # rows of the top bar
YELLOW, ORANGE, GREY = (255, 255, 0), (255, 165, 0), (50, 50, 50)
DOOR_OPEN, DOOR_CLOSED = (48, 141, 70), (55, 55, 55)
ACTION_COLORS = ((120, 120, 120), (116, 1, 113), (255, 94, 14))  # nothing, left or up, right or down
BLUE_FLOOR, RED_FLOOR, WHITE_FLOOR, BLACK_FLOOR = range(4)
WIDTHS = SCREEN + 1  # of lost health in the top bar: the last hit may take more than the half that shows health
BARS_PER_CHOICE = 3 * 3 * 3 * WIDTHS  # rows of bars() for one choice of what to show

Scales = tuple[tuple[float, float], ...]  # of a coin and an exit, a pair for every three sprites


# ---- pictures ----


@cache
def floors() -> np.ndarray:
    """(4, FRAME) uint8, read-only: the four floors in full light."""
    tile = np.arange(SCREEN) // TILE
    light = (tile[:, None] + tile) % 2 == 0  # (84, 84)
    table: np.ndarray = np.zeros((4, SCREEN, SCREEN, 3), np.uint8)
    table[:BLACK_FLOOR] = WHITE
    table[BLUE_FLOOR, ~light], table[RED_FLOOR, ~light] = BLUE, RED
    return read_only(table.reshape(4, FRAME))


@cache
def bars(endless: bool) -> np.ndarray:
    """(4 * BARS_PER_CHOICE, ROW) uint8, read-only: a row of the top bar for every content.

    Ordered by what it may show (1 for actions + 2 for positive rewards), the horizontal and the vertical action, the
    last gain (0 before the first step, 1, 2 for a positive reward) and the width of lost health.
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
    return read_only(table.reshape(-1, ROW))


@lru_cache(maxsize=8)
def spot_stencils(least: int, largest: int) -> tuple[Stencils, Stencils]:
    """The tables of spotlights and of their outlines. Cached: environments with the same options share them."""
    disks, rims = spot_shapes(least, largest)
    return stencils(disks), stencils(rims)


def spot_shapes(least: int, largest: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The masks of spotlights by radius, and their outlines."""
    radii = range(least, largest + 1)
    disks = [disk(2 * radius, radius, radius, radius) for radius in radii]
    rims = [ring(2 * radius, radius, radius, radius, 1) for radius in radii]
    return [NO_SHAPE] * least + disks, [NO_SHAPE] * least + rims


def draw_coins_and_exits(scales: Scales) -> tuple[np.ndarray, np.ndarray]:
    """A coin, a closed exit and an open one for each pair of scales: sprites (R, W, W, 3) uint8 and masks (R, W, W)."""
    width = 2 * max(int(10 * scale) for pair in scales for scale in pair) + 2
    images = np.zeros((3 * len(scales), width, width, 3), np.uint8)
    solids = np.zeros(images.shape[:3], bool)
    for index, (coin_scale, exit_scale) in enumerate(scales):
        _draw_coin_sprite(images[3 * index], solids[3 * index], coin_scale)
        for look, color in enumerate((DOOR_CLOSED, DOOR_OPEN)):
            _draw_exit_sprite(images[3 * index + 1 + look], solids[3 * index + 1 + look], exit_scale, color)
    return images, solids


@lru_cache(maxsize=16)
def coin_and_exit_sheet(scales: Scales) -> Sheet:
    """The sprites of draw_coins_and_exits(). Cached: environments with the same options share them."""
    return make_sheet(*draw_coins_and_exits(scales), np.arange(SCREEN))


def _draw_coin_sprite(image: np.ndarray, solid: np.ndarray, scale: float) -> None:
    """Draws a coin in place: image (W, W, 3), solid (W, W) bool."""
    middle, radius, rim = len(solid) // 2, int(10 * scale), int(2 * scale)
    solid |= disk(len(solid), middle, middle, radius)
    image[solid] = YELLOW
    # A line of no width fills the circle: small coins are orange all over.
    edge = ring(len(solid), middle, middle, radius, rim) if rim else solid
    image[edge] = ORANGE
    solid |= edge


def _draw_exit_sprite(image: np.ndarray, solid: np.ndarray, scale: float, color: tuple[int, int, int]) -> None:
    """Draws an exit with a door of this colour in place: image (W, W, 3), solid (W, W) bool."""
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


# ---- options ----


def set_pictures(s: State, lanes: np.ndarray, values: dict[str, Any]) -> None:
    """Writes what the options mean for the pictures to the state of these lanes, (n,)."""
    coins, exit_, agent = values["coins_visible"], values.get("exit_visible", False), values["agent_visible"]
    calm = WHITE_FLOOR if values["hide_chessboard"] else BLUE_FLOOR
    alarm = RED_FLOOR if calm == BLUE_FLOOR and values["visual_feedback"] else calm
    s.floors[lanes] = BLACK_FLOOR if values["black_background"] else (calm, alarm)
    s.darkness[lanes] = opacity = fading(values["light_dim_off_duration"], values["light_threshold"])
    # Rims are blended like dimmed pixels, so with rims the darkness is never just black.
    opaque = np.flatnonzero(opacity == 255)
    s.dark_at[lanes] = opaque[0] if opaque.size and not values["black_background"] else NO_LIMIT
    s.reddens[lanes] = s.floors[lanes[0], 1] == RED_FLOOR
    shown = values["show_last_action"] + 2 * values["show_last_positive_reward"]
    s.first_bar[lanes] = shown * BARS_PER_CHOICE
    # In the original, where a surface is drawn depends on which others are visible.
    s.exit_layer[lanes] = (BELOW_BAR if coins else ABOVE_BAR) if exit_ else UNDER
    s.agent_layer[lanes] = (BELOW_BAR if coins and exit_ else ABOVE_BAR) if agent else UNDER
    s.layered[lanes] = exit_ or agent


def fading(duration: int, threshold: int) -> np.ndarray:
    """(FADE,) uint8: the darkness' opacity after so many steps. duration: in steps."""
    if not duration:
        return np.full(FADE, threshold, np.uint8)
    opacity = [0]
    while len(opacity) < FADE:  # the last addition may exceed the threshold, as in the original
        opacity.append(min(255, opacity[-1] + 255 // duration) if opacity[-1] <= threshold else opacity[-1])
    return np.array(opacity, np.uint8)


# ---- frames ----


class DrawingTables(NamedTuple):
    """The tables that frames are made of."""

    spots: tuple[Stencils, Stencils]  # and their rims
    figures: Sheet
    coins_and_exits: Sheet
    bars: np.ndarray
    scratch: np.ndarray  # (N, 588) scratch for pixels()


def draw(s: State, drawing: DrawingTables, lanes: Lanes) -> np.ndarray:
    """Fresh frames of the lanes, (n, 84, 84, 3) uint8, drawn from the state alone."""
    dim = (s.length < s.dark_at)[lanes]  # (n,) the darkness is not just black
    frames = s.scenery.take(s.floor[lanes], axis=0)  # (n, FRAME), in full light
    draw_agents(s, drawing, lanes, frames, s.near_light[lanes] | dim)
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


def bar_rows(s: State, lanes: Lanes) -> np.ndarray:
    """(n,) which of bars() the lanes show."""
    return s.first_bar[lanes] + (3 * s.shown_action[lanes] + s.shown_gain[lanes]) * WIDTHS + s.lost_width[lanes]


def draw_scenery(s: State, drawing: DrawingTables, lane: int) -> None:
    """Draws the lane's scenery, which is to be done whenever a coin or the exit has changed."""
    frames, twice = floors().take(s.floors[lane], axis=0), np.array([lane, lane])
    draw_coins(s, drawing, twice, frames, True)
    draw_exits(s, drawing, twice, frames, True)
    s.scenery[2 * lane : 2 * lane + 2] = frames


def draw_coins(s: State, drawing: DrawingTables, lanes: Lanes, frames: np.ndarray, shown: np.ndarray | bool) -> None:
    """Draws coins into the frames (n, FRAME), in place. shown: (n,) bool in which lanes; True: in all."""
    sprite = s.coin_sprite[lanes]
    for coin in range(COIN, s.bodies.shape[2]):
        pos = s.bodies[:, lanes, coin].T  # (n, 2)
        paste_shown(frames, drawing.coins_and_exits, sprite, pos, shown & (pos[:, 0] != GONE))


def draw_exits(s: State, drawing: DrawingTables, lanes: Lanes, frames: np.ndarray, shown: np.ndarray | bool) -> None:
    """Draws exits into the frames (n, FRAME), in place. shown: (n,) bool in which lanes; True: in all."""
    pos = s.bodies[:, lanes, EXIT].T  # (n, 2)
    sprite = (s.coin_sprite + s.is_open)[lanes] + 1
    paste_shown(frames, drawing.coins_and_exits, sprite, pos, shown & (pos[:, 0] != GONE))


def draw_agents(s: State, drawing: DrawingTables, lanes: Lanes, frames: np.ndarray, shown: np.ndarray | bool) -> None:
    """Draws agents into the frames (n, FRAME), in place. shown: (n,) bool in which lanes; True: in all."""
    if shown is True or np.count_nonzero(shown):
        paste_shown(frames, drawing.figures, (s.figure * FACINGS + s.drawn_facing)[lanes], s.pos[lanes], shown)


def paste_shown(frames: np.ndarray, sheet: Sheet, rows: np.ndarray, pos: np.ndarray, shown: np.ndarray | bool) -> None:
    """Pastes sprite rows[i] of the sheet at pos[i] into frames[i] where shown[i]; shown = True: into all of them."""
    count = len(rows) if shown is True else np.count_nonzero(shown)
    if count == len(rows):
        paste(frames, sheet, rows, pos)
    elif count:
        at = np.flatnonzero(shown)
        paste(frames, sheet, rows[at], pos[at], at)


def draw_layer(s: State, drawing: DrawingTables, lanes: Lanes, frames: np.ndarray, layer: int) -> None:
    """Draws the exits and agents that belong to this layer, which the darkness does not cover."""
    draw_exits(s, drawing, lanes, frames, s.exit_layer[lanes] == layer)
    draw_agents(s, drawing, lanes, frames, s.agent_layer[lanes] == layer)


def light_masks(s: State, spots: tuple[Stencils, Stencils], lanes: Lanes) -> tuple[np.ndarray, np.ndarray | None]:
    """Masks of what the spotlights light and of their visible rims (None: no lane has rims), (n, 588) uint16 each."""
    key = s.spot_place[:, lanes, : int(s.num_spots.max())].transpose(0, 2, 1).copy()  # (2, S, n)
    disks, rims = spots
    lit, rim = overlay(disks.at(*key), rims, key, s.rim[lanes])
    return lit.view(np.uint16), None if rim is None else rim.view(np.uint16)


def overlay(
    disks: np.ndarray, rims: Stencils, key: np.ndarray, rimmed: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """Overlays the spotlights: what they light, and their visible rims (None: no lane has rims), (n, U) each.

    disks: (S, n, U) each alone. rims, key: the table of rims, and their keys in it, (2, S, n).
    rimmed: (n,) bool: the lane's spotlights have rims.
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
    s: State, lanes: Lanes, frames: np.ndarray, lit: np.ndarray, rim: np.ndarray | None, dim: np.ndarray
) -> None:
    """Darkens the lanes' frames, (n, FRAME), in place.

    lit: (n, FRAME) 255 where a pixel stays as it is. rim: (n, 588) mask of white pixels, or None.
    dim: which of the n lanes are dimmed, not just black.
    """
    if dim.size:
        who = dim if isinstance(lanes, slice) else lanes[dim]
        opacity = s.darkness[who, np.minimum(s.length[who], FADE - 1)].astype(np.uint16)[:, None]
        bright = frames[dim].astype(np.uint16)
        # The remaining brightness is rounded up, as the original rounds down what it takes away.
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
