"""The agent's figure, shared by the families: how an action moves and turns it, and what it looks like.

Positions are pixels along one axis, stored with PAD added so that one beyond the screen's edge is still an index.
Facings count eighths of a turn, counter-clockwise from up: 0 up, 1 up-left, 2 left, ... 7 up-right.
"""

import math
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np

from memory_gym_envs.drawing import SCREEN, Sheet, disk, make_sheet, ring, with_margin

PAD = 25  # the radius of the largest agent, of which nothing shows at position 0
SPAN = 137  # stored positions are 0 .. SPAN-1
PIXELS = np.arange(SPAN) - PAD  # what they stand for
FACINGS = 8
BODY, HAND, HAND_OUTLINE = (250, 204, 153), (250, 250, 250), (50, 50, 50)

# What an action does along one axis, a row of a walk table.
FROZEN, STAND, BACK, FORTH, DIAGONAL_BACK, DIAGONAL_FORTH = range(6)
STRIDES = 6


class Figure(NamedTuple):
    """What a figure's size and walk depend on. Lanes whose options agree share one."""

    scale: float
    speed: float  # pixels a step
    low: int  # the walkable square's first pixel, on both axes
    high: int  # one past its last pixel
    reach: int  # how far from the square's edges the centre must stay; on a torus, half of it may be walked past them
    torus: bool


def radius_of(scale: float) -> int:
    """The body's radius in pixels."""
    return int(25 * scale)


LARGEST_RADIUS = radius_of(1.0)


class Controls(NamedTuple):
    """Actions as look-up tables, indexed by facing * actions + action. The last action is: may not move."""

    actions: int  # with that one
    turn: np.ndarray  # (8 * actions,) the next facing
    strides: np.ndarray  # (8 * actions, 2) what happens along x and along y, times SPAN


@cache
def free_controls() -> Controls:
    """MultiDiscrete([3, 3]), as 3 * horizontal + vertical. 0 nothing; 1 left or up; 2 right or down."""
    facing_of = {(0, -1): 0, (-1, -1): 1, (-1, 0): 2, (-1, 1): 3, (0, 1): 4, (1, 1): 5, (1, 0): 6, (1, -1): 7}
    turn, strides = [], []
    for facing in range(FACINGS):
        for action in range(9):
            dx, dy = ((0, -1, 1)[part] for part in divmod(action, 3))
            turn.append(facing_of.get((dx, dy), facing))
            there = {-1: DIAGONAL_BACK, 0: STAND, 1: DIAGONAL_FORTH} if dx and dy else {-1: BACK, 0: STAND, 1: FORTH}
            strides.append((there[dx], there[dy]))
        turn.append(facing)
        strides.append((FROZEN, FROZEN))
    return Controls(10, np.array(turn), np.array(strides) * SPAN)


@cache
def grid_controls() -> Controls:
    """Discrete(4): 0 nothing, 1 turn left, 2 turn right, 3 one tile forward. Facings are the even ones."""
    ahead = {0: (STAND, BACK), 2: (BACK, STAND), 4: (STAND, FORTH), 6: (FORTH, STAND)}
    turn, strides = [], []
    for facing in range(FACINGS):
        turn += [facing, (facing + 2) % FACINGS, (facing - 2) % FACINGS, facing, facing]
        strides += [*[(STAND, STAND)] * 3, ahead.get(facing, (STAND, STAND)), (FROZEN, FROZEN)]
    return Controls(5, np.array(turn), np.array(strides) * SPAN)


def walk_table(figure: Figure) -> np.ndarray:
    """(STRIDES * SPAN,) the next stored position for every stride and every stored position."""
    straight = figure.speed
    diagonal = 1 / math.sqrt(2) * figure.speed  # not sqrt(1/2), which differs in the last bit
    steps = np.array([0.0, -straight, straight, -diagonal, diagonal])  # STAND .. DIAGONAL_FORTH
    if figure.torus:
        # The original rounds the new position here, where it cuts the step off on bounded ground.
        there = _round(PIXELS + steps[:, None])  # (5, SPAN)
        before, behind = figure.low - figure.reach / 2, figure.high + figure.reach / 2
        there = np.where(there > behind, _round(before), np.where(there < before, _round(behind), there))
    else:
        there = PIXELS + np.trunc(steps)[:, None]  # (5, SPAN)
        there = np.maximum(np.minimum(there, figure.high - figure.reach), figure.low + figure.reach)
    table = np.concatenate([PIXELS[None], there]).astype(np.int64) + PAD  # (STRIDES, SPAN), first FROZEN
    return table.clip(0, SPAN - 1).reshape(-1)


def _round(x: np.ndarray | float) -> np.ndarray:
    """The nearest whole number, halves away from zero."""
    return np.trunc(x + np.copysign(0.5, x))


def sprites(scale: float) -> tuple[np.ndarray, np.ndarray]:
    """The figure in its eight facings: (8, W, W, 3) colours and the (8, W, W) mask of what is drawn."""
    radius, hand, outline = radius_of(scale), int(10 * scale), int(3 * scale)
    width = 4 * (radius + hand) + 4
    middle = width // 2
    image, solid = np.zeros((FACINGS, width, width, 3), np.uint8), np.zeros((FACINGS, width, width), bool)
    body = disk(width, middle, middle, radius)
    image[:, body], solid[:, body] = BODY, True
    for facing in range(FACINGS):
        for x, y in hand_offsets(scale, facing):
            palm = disk(width, middle + x, middle + y, hand)
            image[facing][palm] = HAND
            # A line of no width fills the circle: small hands are dark all over.
            image[facing][ring(width, middle + x, middle + y, hand, outline) if outline else palm] = HAND_OUTLINE
            solid[facing] |= palm
    spare = int(np.argmax((solid | solid[:, ::-1, ::-1]).any(axis=(0, 1)))) if solid.any() else middle - 1
    inner = slice(spare, width - spare)
    return image[:, inner, inner], solid[:, inner, inner]


def hand_offsets(scale: float, facing: int) -> list[tuple[int, int]]:
    """Where the two hands are, in whole pixels from the body's centre."""
    across = 2 * radius_of(scale) + int(10 * scale)
    centre = (across + 14) // 2  # from the corner of the original's sprite, where its rounding starts
    aside, ahead = int(18 * scale), int(12 * scale) + 7 - centre
    angle = math.radians(360 - 45 * facing)
    # Quarter turns are exact; the eighths in between keep their rounding errors, which tip some hands by a pixel.
    cos, sin = (round(f(angle)) if facing % 2 == 0 else f(angle) for f in (math.cos, math.sin))
    turned = [(cos * x - sin * ahead, sin * x + cos * ahead) for x in (-aside, aside)]
    return [(math.floor(centre + x) - centre, math.floor(centre + y) - centre) for x, y in turned]


class AgentTables(NamedTuple):
    """The tables of all figures in use, stacked: figure f walks by rows f * STRIDES and looks like rows f * FACINGS."""

    walk: np.ndarray  # (F * STRIDES * SPAN,)
    sheet: Sheet


@lru_cache(maxsize=16)
def agent_tables(figures: tuple[Figure, ...]) -> AgentTables:
    """The tables of the given figures. Cached: environments with the same options share them."""
    walk = np.concatenate([walk_table(figure) for figure in figures])
    pictures = [sprites(figure.scale) for figure in figures]
    width = min(SCREEN, max(solid.shape[1] for _, solid in pictures))
    images, solids = (
        np.concatenate([with_margin(each, (width - each.shape[1]) // 2) for each in kind])
        for kind in zip(*pictures, strict=True)
    )
    return AgentTables(walk, make_sheet(images, solids, PIXELS))


def walk(
    facing: np.ndarray, pos: np.ndarray, action: np.ndarray, start: np.ndarray, controls: Controls, table: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One step of all figures: the new facings (N,) and positions (N, 2).

    action: (N,) controls.actions - 1 for agents that may not move.
    start: where the lane's walk table starts, (N, 1), or (N, 2) with a table for each axis.
    """
    key = facing * controls.actions + action
    return controls.turn.take(key), table.take(controls.strides.take(key, axis=0) + start + pos)
