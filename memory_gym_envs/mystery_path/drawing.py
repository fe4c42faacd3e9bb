"""Mystery Path's frames and debug view. Shape letters: n lanes, T tiles of all trails, t those of the n lanes."""

import math
from functools import cache
from typing import Any

import numpy as np

from memory_gym_envs.character import FACINGS, PAD, PIXELS, SPAN, radius_of
from memory_gym_envs.colors import BLUE, GREEN, RED, WHITE
from memory_gym_envs.drawing import FRAME, ROW, SCREEN, Sheet, make_sheet, paste, read_only, stamp, tile_picture
from memory_gym_envs.mystery_path.options import SEGMENT, SIDE, TILE
from memory_gym_envs.mystery_path.state import FAST, NO_CELL, ROWS, State, tiles_of
from memory_gym_envs.state import Lanes

GREY, ICE = (210, 210, 210), (125, 177, 250)
CROSS = 10  # width of the cross
STAMINA_BAR = 4  # width of the stamina bar
ON_PATH, ORIGIN, GOAL, WALL, EDGE = range(5)  # rows of tiles()

# The picture of a trail's tile by its first pixel, where a negative one counts from the end. Where just two of its
# columns are on the screen, the original gives both the border's colour.
TRAIL_KIND = np.full(SCREEN + TILE, ON_PATH)
TRAIL_KIND[[2 - TILE, SCREEN - 2]] = EDGE


# ---- tables of pictures ----


@cache
def tiles() -> Sheet:
    """Every kind of tile, to be pasted where a part of it may be off the screen."""
    colors = [(WHITE, GREY), (BLUE, BLUE), (GREEN, GREEN), (RED, RED), (GREY, GREY)]
    pictures = np.stack([tile_picture(TILE, *color) for color in colors])
    return make_sheet(pictures, np.ones(pictures.shape[:3], bool), PIXELS)


def cross_mask() -> np.ndarray:
    """Two diagonals, three pixels wide: (CROSS, CROSS) bool."""
    rows, columns = np.indices((CROSS, CROSS))
    return (abs(rows - columns) <= 1) | (abs(rows + columns - CROSS + 1) <= 1)


@cache
def crosses() -> Sheet:
    """The red cross."""
    picture = np.full((CROSS, CROSS, 3), RED, np.uint8)
    return make_sheet(picture[None], cross_mask()[None], PIXELS)


@cache
def grounds() -> np.ndarray:
    """Black, then the tiled background moved left by 0, 1, 2, ... pixels: (1 + TILE, FRAME) uint8."""
    ice = np.tile(tile_picture(TILE, ICE, GREY), (SIDE, SIDE + 1, 1))
    pictures = [np.zeros((SCREEN, SCREEN, 3), np.uint8), *(ice[:, shift : shift + SCREEN] for shift in range(TILE))]
    return read_only(np.stack(pictures).reshape(-1, FRAME))


@cache
def bars() -> np.ndarray:
    """The stamina bar, green below as many red rows as the index: (SCREEN + 1, SCREEN, 3 * STAMINA_BAR) uint8."""
    table = np.tile(np.array(GREEN, np.uint8), (SCREEN + 1, SCREEN, STAMINA_BAR, 1))
    table[np.arange(SCREEN + 1)[:, None] > np.arange(SCREEN)] = RED
    return read_only(table.reshape(SCREEN + 1, SCREEN, 3 * STAMINA_BAR))


# ---- where things are on the screen ----


def camera_columns(values: dict[str, Any]) -> tuple[int, int]:
    """Where the endless id draws the agent and its cross, by its options: stored positions along x."""
    radius, camera = radius_of(values["agent_scale"]), TILE * values["camera_offset_scale"]
    # The original cuts the fraction off at the corner of the agent's sprite, and rounds the cross's middle.
    corner = (2 * radius + int(10 * values["agent_scale"]) + 14) // 2
    return corner + int(radius - corner + camera) + PAD, math.floor(radius + camera + 0.5) + PAD


def set_camera(s: State, lanes: np.ndarray, values: dict[str, Any]) -> None:
    """Writes what the endless id's options mean for the camera, and for what moves with it, to these lanes."""
    speed = int(values["agent_speed"])
    s.extras[lanes] |= values["agent_speed"] > FAST
    s.speed[lanes] = speed
    s.ground_period[lanes] = speed * math.ceil(TILE / speed) if speed else 1
    s.camera[lanes] = TILE * values["camera_offset_scale"]
    s.trail_columns[lanes] = int(values["camera_offset_scale"])
    figure_x, cross_x = camera_columns(values)
    s.figure_x[lanes], s.cross_x[lanes] = figure_x, cross_x
    s.cross_fits[lanes] = cross_x < PAD + SCREEN - STAMINA_BAR * values["show_stamina"] + CROSS // 2


def positions_on_screen(s: State, lanes: Lanes, endless: bool) -> np.ndarray:
    """(n, 2) stored positions where the agents are drawn."""
    pos = s.pos[lanes]
    if endless:
        pos = pos.copy()
        pos[:, 0] = s.figure_x[lanes]
        if np.count_nonzero(s.extras[lanes]):  # a fast agent may be far off the screen
            np.clip(pos, 0, SPAN - 1, out=pos)
    return pos


def tile_centres(cell: np.ndarray) -> np.ndarray:
    """(n, 2) the centres of the cells' tiles, with PAD."""
    return tiles_of(cell) * TILE + TILE // 2 + PAD


def trail_on_screen(s: State, lanes: Lanes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The tiles of the lanes' trails: for each, (t,), the index of its lane in `lanes`, its first pixel, x and y."""
    lane, y = s.trail_lane, s.trail_y  # (T,)
    # Where the camera is between two pixels, the fraction is cut off, towards zero.
    x = (s.trail_x - (s.pos[:, 0] - s.origin[:, 0] - s.camera)[lane]).astype(np.int64)
    if isinstance(lanes, slice):
        return lane, x, y
    frame = np.full(len(s.last_path_step), NO_CELL)
    frame[lanes] = np.arange(len(lanes))
    owner = frame[lane]
    mine = owner != NO_CELL
    return owner[mine], x[mine], y[mine]


def ground_rows(s: State, lanes: Lanes) -> np.ndarray:
    """(n,) the rows of grounds() that are behind everything."""
    # The background starts again as soon as it has moved by a tile or more. It jumps if the speed does not divide TILE.
    walked = s.pos[lanes, 0] - s.origin[lanes, 0]
    return (walked % s.ground_period[lanes] + 1) * s.show_ground[lanes]


def spent_stamina(s: State, lanes: Lanes) -> np.ndarray:
    """(n,) how many pixels of the bar are red."""
    return (SCREEN * (1 - s.stamina[lanes] / s.stamina_level[lanes])).astype(np.int64)


# ---- frames ----


def draw(s: State, sheet: Sheet, lanes: Lanes, endless: bool) -> np.ndarray:
    """Fresh frames of the lanes, (n, 84, 84, 3) uint8, from the state alone. sheet: of the agents."""
    frames = draw_ground(s, lanes, endless)  # (n, FRAME)
    draw_agent(frames, s, sheet, lanes, endless)
    return frames.reshape(-1, SCREEN, SCREEN, 3)


def draw_ground(s: State, lanes: Lanes, endless: bool) -> np.ndarray:
    """(n, FRAME): black or the background, and what is shown of the path: its trail, or its origin and goal."""
    extras = np.count_nonzero(s.extras[lanes])
    if endless and extras:
        frames = grounds().take(ground_rows(s, lanes), axis=0)
    else:
        frames = np.zeros((len(s.last_path_step[lanes]), FRAME), np.uint8)
    if endless and np.count_nonzero(s.shows_trail[lanes]):
        draw_trail(frames, s, lanes)
    if extras and not endless:
        for shown, kind in ((s.show_origin[lanes], ORIGIN), (s.show_goal[lanes], GOAL)):
            (which,) = shown.nonzero()
            if which.size:
                step = s.path_length[lanes][which] if kind == GOAL else 1
                cell = s.path_cell[lanes][which, step]
                paste(frames, tiles(), np.full(len(which), kind), tile_centres(cell), which)
    return frames


def draw_trail(frames: np.ndarray, s: State, lanes: Lanes) -> None:
    """Draws the trails on the lanes' frames (n, FRAME), in place."""
    owner, x, y = trail_on_screen(s, lanes)
    whole = (x >= 0) & (x <= SCREEN - TILE)
    if np.count_nonzero(whole) < len(whole):
        cut = ~whole & (x > -TILE) & (x < SCREEN)
        centres = np.stack([x[cut], y[cut]], axis=1) + TILE // 2 + PAD
        # Cut tiles are drawn first, because the squares that they are pasted in may overlap whole tiles.
        paste(frames, tiles(), TRAIL_KIND.take(x[cut]), centres, owner[cut])
        owner, x, y = owner[whole], x[whole], y[whole]
    stamp(frames, tile_picture(TILE, WHITE, GREY), owner, x, y)


def draw_agent(frames: np.ndarray, s: State, sheet: Sheet, lanes: Lanes, endless: bool) -> None:
    """Draws the agents, their stamina and their crosses on the frames (n, FRAME), in place."""
    pos, extras = positions_on_screen(s, lanes, endless), endless and np.count_nonzero(s.extras[lanes])
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


def draw_truth(s: State, sheet: Sheet, lane: int, endless: bool) -> np.ndarray:
    """The lane's frame with its path, (84, 84, 3) uint8: what the debug view enlarges."""
    one = np.array([lane])
    frames = draw_ground(s, one, endless)  # (1, FRAME)
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
            paste(frames, tiles(), np.array([kind]), centre)
    draw_agent(frames, s, sheet, one, endless)
    return frames.reshape(SCREEN, SCREEN, 3)
