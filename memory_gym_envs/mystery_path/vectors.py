"""Mystery Path's vector observations. Shape letters: n lanes, V entries of a vector, t tiles of the lanes' trails."""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from memory_gym_envs.appearance import CORNERS, AppearanceTables, VectorTables, View, tables_of
from memory_gym_envs.character import FACINGS, LARGEST_RADIUS, PAD, PIXELS, SPAN, sprites
from memory_gym_envs.colors import RED
from memory_gym_envs.drawing import SCREEN, with_margin
from memory_gym_envs.mystery_path import drawing
from memory_gym_envs.mystery_path.drawing import CROSS, STAMINA_BAR
from memory_gym_envs.mystery_path.options import SIDE, TILE
from memory_gym_envs.mystery_path.state import State
from memory_gym_envs.state import Lanes

CROSS_ROW_FITS = abs(PIXELS - SCREEN // 2) < (SCREEN + CROSS) // 2  # of stored positions along y


class ViewOptions(NamedTuple):
    """What decides how much of an agent shows. Lanes whose options agree share one."""

    scale: float
    column: int | None  # the stored position along x where the endless id always draws the agent
    aside: int  # pixels from the agent's centre to its cross, to the right
    width: int  # pixels of the screen that are left of the stamina bar


def view_options_of(values: dict[str, Any], scale: float, endless: bool) -> ViewOptions:
    """What the reset options mean for an agent of this size."""
    if not endless:
        return ViewOptions(scale, None, 0, SCREEN)
    figure_x, cross_x = drawing.camera_columns(values)
    return ViewOptions(scale, figure_x, cross_x - figure_x, SCREEN - STAMINA_BAR * values["show_stamina"])


@lru_cache(maxsize=16)
def appearance_tables(view_options: tuple[ViewOptions, ...]) -> AppearanceTables:
    """What can be seen of the agent with each of these view options, without a cross and with one."""
    views = []
    for options in view_options:
        free = np.zeros((SCREEN, SCREEN), bool)
        free[:, : options.width] = True
        rows = range(SPAN) if options.column else range(PAD, PAD + SCREEN + LARGEST_RADIUS + 1)
        columns = range(options.column, options.column + 1) if options.column else rows
        image, solid = sprites(options.scale)
        for picture in ((image, solid), with_cross(image, solid, options.aside)):
            views.append(View(options.scale, *picture, free, columns, rows))
    return tables_of(views)


def with_cross(image: np.ndarray, solid: np.ndarray, aside: int) -> tuple[np.ndarray, np.ndarray]:
    """The figure's sprites (8, W, W, 3) and masks (8, W, W) with a cross, so many pixels right of their middle."""
    margin = max(0, CROSS // 2 + abs(aside) - solid.shape[1] // 2)
    image, solid = with_margin(image, margin), with_margin(solid, margin)
    first = solid.shape[1] // 2 - CROSS // 2
    square = (slice(None), slice(first, first + CROSS), slice(first + aside, first + aside + CROSS))
    image[square][:, drawing.cross_mask()], solid[square][:, drawing.cross_mask()] = RED, True
    return image, solid


def make_vectors(s: State, tables: VectorTables, lanes: Lanes, endless: bool) -> np.ndarray:
    """Fresh vector observations of the lanes, (n, V) float32."""
    at, shows_cross, pos = tables.at, s.shows_cross[lanes], drawing.positions_on_screen(s, lanes, endless)
    sprite = tables.lane_sprite[lanes] + shows_cross * FACINGS + s.facing[lanes]  # (n,)
    out = np.zeros((len(sprite), tables.width), np.float32)
    tables.write_agents(out, sprite, pos)
    if endless:
        write_endless(out, s, tables, lanes, sprite, pos)
    else:
        out[:, at["cross"]] = shows_cross[:, None]
        if np.count_nonzero(s.extras[lanes]):
            write_ends(out[:, at["origin"].start : at["goal"].stop], s, lanes, tables.appearance, sprite)
    return out


def write_ends(out: np.ndarray, s: State, lanes: Lanes, appearance: AppearanceTables, sprite: np.ndarray) -> None:
    """Writes where the path's origin and goal are, if they are shown and not hidden. out: (n, 4), zeros so far."""
    which, last = np.arange(len(out)), s.path_length[lanes]
    for end, shown, step in ((0, s.show_origin[lanes], np.ones_like(last)), (2, s.show_goal[lanes], last)):
        centre = drawing.tile_centres(s.path_cell[lanes][which, step])  # (n, 2)
        points = centre[:, None] - TILE // 2 + CORNERS * (TILE - 1)  # (n, 4, 2)
        shown = shown & ~appearance.covered(sprite, s.pos[lanes], points).all(axis=1)
        out[:, end : end + 2] = (centre - PAD) / SCREEN * shown[:, None]


def write_endless(
    out: np.ndarray, s: State, tables: VectorTables, lanes: Lanes, sprite: np.ndarray, pos: np.ndarray
) -> None:
    """Writes the endless id's entries except the agent's. out: (n, V). sprite, pos: (n,) and (n, 2), the agents'."""
    at, shows_cross = tables.at, s.shows_cross[lanes]
    if np.count_nonzero(shows_cross):
        out[:, at["cross"].start] = shows_cross & s.cross_fits[lanes] & CROSS_ROW_FITS.take(pos[:, 1])
    if np.count_nonzero(s.shows_trail[lanes]):
        agent = (sprite, pos) if tables.large else None
        write_trail(out[:, at["past"].start : at["scroll"].stop], s, lanes, tables.appearance, agent)
    if np.count_nonzero(s.extras[lanes]):
        out[:, at["ground"].start] = drawing.ground_rows(s, lanes) / TILE
        out[:, at["bar"].start] = s.show_stamina[lanes]
        out[:, at["stamina"].start] = s.show_stamina[lanes] * (1 - drawing.spent_stamina(s, lanes) / SCREEN)


def write_trail(
    out: np.ndarray, s: State, lanes: Lanes, appearance: AppearanceTables, agent: tuple[np.ndarray, np.ndarray] | None
) -> None:
    """Writes which tiles of the trails show, and their scroll. A tile shows if one of its corners does.

    out: (n, 57), zeros so far. agent: sprites (n,) and positions (n, 2) of agents that may hide a tile, or None.
    """
    owner, x, y = drawing.trail_on_screen(s, lanes)
    inset, width = 0, SCREEN
    if np.count_nonzero(s.extras[lanes]):
        # The background has the same borders, which may be two columns wide, but not the pixels inside them.
        inset = 2 * s.show_ground[lanes][owner]  # (t,)
        width = (SCREEN - STAMINA_BAR * s.show_stamina[lanes])[owner]  # (t,)
    shown = (x + inset < width) & (x + (TILE - 1) - inset >= 0)
    cut = x == 1 - TILE  # only its last column is on the screen, in the screen's first
    if np.count_nonzero(cut):
        # If the camera is between two pixels, the next tile may start in the same column and cover it.
        row = owner * SCREEN + y  # (t,)
        shown &= ~(cut & np.isin(row, row[x == 0]))
    if agent is not None:
        sprite, pos = agent
        corners = np.stack([x, y], axis=1)[:, None] + abs(CORNERS * (TILE - 1) - np.reshape(inset, (-1, 1, 1)))
        free = (corners[..., 0] >= 0) & (corners[..., 0] < np.reshape(width, (-1, 1)))  # (t, 4)
        shown &= (free & ~appearance.covered(sprite[owner], pos[owner], corners + PAD)).any(axis=1)
    owner, x, y = owner[shown], x[shown], y[shown]
    out[owner, (x // TILE + 1) * SIDE + y // TILE] = 1.0
    # If the camera is between two pixels, the tiles of a trail differ in this by one: the largest counts.
    np.maximum.at(out[:, -1], owner, (x % TILE / TILE).astype(np.float32))
