"""Drawing by geometry in NumPy: shapes as boolean masks, and sprites pasted into many frames at once.

Frames are (n, 84, 84, 3) uint8, rows first: frames[i, y, x]. Masks are (height, width) bool.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

SCREEN = 84  # width and height of an observation in pixels
ROW = 3 * SCREEN  # bytes in a row of a frame
FRAME = SCREEN * ROW  # bytes in a frame
FEW = 4  # sprites that are pasted faster one by one
LUMA = np.array([77, 150, 29], np.float32) / 256  # ITU-R 601, in 256ths so that all sums are exact


def disk(size: int, x: float, y: float, radius: int) -> np.ndarray:
    """A filled circle on a (size, size) mask, as a midpoint rasteriser draws it.

    (x, y) is the corner where the four central pixels meet, so the disk is 2 * radius pixels wide.
    """
    columns, rows = np.arange(size) + 0.5 - x, np.arange(size) + 0.5 - y
    across, down = np.abs(columns)[None, :] + 0.5, np.abs(rows)[:, None] + 0.5  # >= 1
    short, long = np.minimum(across, down), np.maximum(across, down)
    # A rasteriser walks one octant and rounds the other axis, hence the half pixel on the longer leg alone.
    return (short**2 + (long - 0.5) ** 2 < radius**2) | ((long <= radius) & (long <= 1))


def ring(size: int, x: float, y: float, radius: int, width: int) -> np.ndarray:
    """A circle of the given line width, less than the radius, on a (size, size) mask."""
    size, x, y = size + 2, x + 1, y + 1  # a pixel more on each side: where the mask ends is no edge
    if width == 1:
        return _outline(disk(size, x, y, radius), x, y)[1:-1, 1:-1]
    # The inner edge is a thin line of its own, within which nothing is drawn.
    solid, inner = (_wider_disk(size, x, y, each) for each in (radius, radius - width + 1))
    return (solid & (~inner | _outline(inner, x, y)))[1:-1, 1:-1]


def _outline(solid: np.ndarray, x: float, y: float) -> np.ndarray:
    """The edge of a disk: the outermost pixel of each column and, beside the diagonals, of each row."""
    columns, rows = np.arange(len(solid)) + 0.5 - x, (np.arange(len(solid)) + 0.5 - y)[:, None]
    around = np.pad(solid, 1)
    above = np.where(rows < 0, around[:-2, 1:-1], around[2:, 1:-1])  # the next pixel away from the centre
    aside = np.where(columns < 0, around[1:-1, :-2], around[1:-1, 2:])
    steep = np.abs(columns) - np.abs(rows)
    return solid & ((~above & (steep <= 0)) | (~aside & (steep >= 0)))


def _wider_disk(size: int, x: float, y: float, radius: int) -> np.ndarray:
    """The disk that a thick circle fills up to its edge."""
    solid = disk(size, x, y, radius)
    # Its rasteriser walks row by row, one step beyond the diagonal: in two of all sizes that is a pixel too far.
    row, column = {4: (2, 4), 11: (7, 9)}.get(radius, (0, 0))
    down, across = (np.abs(np.arange(size) + 0.5 - middle) + 0.5 for middle in (y, x))  # >= 1
    return solid | ((down == row)[:, None] & (across == column))


def turned(mask: np.ndarray, degrees: float, size: int) -> np.ndarray:
    """A square mask turned counter-clockwise about its centre, on a (size, size) mask."""
    old, angle = len(mask), np.radians(degrees)
    offset = np.arange(size) + 0.5 - size / 2
    # A hair to the left, because that is where the original's rounding turns.
    x, y = offset[None, :] - 1e-3, offset[:, None]
    cos, sin = np.cos(angle), np.sin(angle)
    source_x = np.floor(x * cos - y * sin + old / 2).astype(int)  # (size, size)
    source_y = np.floor(x * sin + y * cos + old / 2).astype(int)
    inside = (source_x >= 0) & (source_x < old) & (source_y >= 0) & (source_y < old)
    return inside & mask[source_y.clip(0, old - 1), source_x.clip(0, old - 1)]


def with_margin(pictures: np.ndarray, margin: int) -> np.ndarray:
    """Pictures or masks (K, W, W, ...) with so many more pixels on each of the four sides, black or False."""
    return np.pad(pictures, [(0, 0), (margin, margin), (margin, margin)] + [(0, 0)] * (pictures.ndim - 3))


@cache
def tile_picture(width: int, inside: tuple[int, int, int], edge: tuple[int, int, int]) -> np.ndarray:
    """(W, W, 3) uint8, read-only: a tile with an edge of one pixel."""
    picture = np.full((width, width, 3), edge, np.uint8)
    picture[1:-1, 1:-1] = inside
    return read_only(picture)


class Sheet(NamedTuple):
    """Sprites ready to be pasted at any position in a frame, cut off at the screen's edges.

    Each sprite lies in the middle of a transparent canvas. To paste one is to choose a W x W window of the frame that
    stays on the screen, the window of the canvas that covers the same pixels, and to blend the two: frame & keep | ink.
    """

    row: np.dtype  # of one row of a window: W pixels as one opaque item, which NumPy copies twice as fast as bytes
    canvas: int  # width and height of a sprite's canvas
    keep: np.ndarray  # (starts, W) rows: the windows at every start; 255 where a sprite is transparent
    ink: np.ndarray  # (starts, W) likewise: colours, 0 where a sprite is transparent
    canvases: tuple[np.ndarray, np.ndarray]  # what those are windows of
    frame_start: np.ndarray  # (P * P,) first pixel of the frame's window, for every y and x
    canvas_start: np.ndarray  # (P * P,) first pixel of the canvas' window, for every y and x
    strides: np.ndarray  # (2,) from x and y to the index of these two


def make_sheet(sprites: np.ndarray, solid: np.ndarray, positions: np.ndarray) -> Sheet:
    """Prepares (R, W, W, 3) sprites, solid where the (R, W, W) mask says, for centres at the given positions.

    positions: (P,) in pixels along one axis of the screen, what each index of `pos` in `paste` stands for.
    A sprite's centre is the corner between its four central pixels.
    """
    count, width = solid.shape[:2]
    frame_start = (positions - width // 2).clip(0, SCREEN - width)
    shift = frame_start - (positions - width // 2)  # > 0: cut off at the left or top, < 0: at the right or bottom
    before, after = max(0, -int(shift.min())), max(0, int(shift.max()))
    canvas = before + width + after
    keep = np.full((count, canvas, canvas, 3), 255, np.uint8)
    ink = np.zeros((count, canvas, canvas, 3), np.uint8)
    middle = slice(before, before + width)
    keep[:, middle, middle] = np.where(solid[..., None], 0, 255)
    ink[:, middle, middle] = np.where(solid[..., None], sprites, 0)
    source = shift + before
    row = np.dtype(f"V{3 * width}")
    return Sheet(
        row,
        canvas,
        squares_of(keep, canvas, row),
        squares_of(ink, canvas, row),
        (keep, ink),
        (frame_start[:, None] * SCREEN + frame_start).reshape(-1),
        (source[:, None] * canvas + source).reshape(-1),
        np.array([1, len(positions)]),
    )


def paste(frames: np.ndarray, sheet: Sheet, rows: np.ndarray, pos: np.ndarray, owner: np.ndarray | None = None) -> None:
    """Pastes sprite rows[i] of the sheet into frames[i], centred at pos[i].

    frames: (n, FRAME) uint8, contiguous, changed in place. rows: (n,). pos: (n, 2), x and y, indices of positions.
    owner: (m,) into which frames instead; rows and pos are (m,) and (m, 2) then. The squares that sprites of the same
        frame cover must not overlap, those cut off at the screen's edges being moved back onto it.
    """
    if len(rows) <= FEW:
        for i in range(len(rows)):
            _paste_one(frames, sheet, rows[i], pos[i], i if owner is None else owner[i])
        return
    first = np.arange(0, len(frames) * SCREEN * SCREEN, SCREEN * SCREEN) if owner is None else owner * SCREEN * SCREEN
    index = pos.dot(sheet.strides)  # (n,)
    start = sheet.frame_start.take(index) + first
    source = sheet.canvas_start.take(index) + rows * (sheet.canvas * sheet.canvas)
    squares = squares_of(frames, SCREEN, sheet.row)  # a square never leaves its frame, as frame_start is clipped
    patch = squares[start]  # (n, W) rows
    pixels = patch.view(np.uint8)  # (n, W * W * 3), the same memory
    pixels &= sheet.keep[source].view(np.uint8)
    pixels |= sheet.ink[source].view(np.uint8)
    squares[start] = patch


def _paste_one(frames: np.ndarray, sheet: Sheet, row: int, pos: np.ndarray, owner: int) -> None:
    """Pastes one sprite: the same as `paste`, in fewer calls."""
    index = pos.dot(sheet.strides)
    start = 3 * (sheet.frame_start[index] + owner * (SCREEN * SCREEN))
    source = 3 * (sheet.canvas_start[index] + row * (sheet.canvas * sheet.canvas))
    square, pitch = (sheet.row.itemsize // 3, sheet.row.itemsize), (3 * sheet.canvas, 1)
    patch = np.ndarray(square, np.uint8, frames, start, (ROW, 1))
    keep, ink = (np.ndarray(square, np.uint8, canvas, source, pitch) for canvas in sheet.canvases)
    patch &= keep
    patch |= ink


def stamp(frames: np.ndarray, picture: np.ndarray, owner: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """Puts a (W, W, 3) picture without transparent pixels into frames[owner[i]], its top left pixel at x[i], y[i].

    frames: (n, FRAME) uint8, contiguous, changed in place. owner, x, y: (m,). All of it must be on the screen.
    """
    row = np.dtype(f"V{3 * len(picture)}")
    squares = squares_of(frames, SCREEN, row)
    squares[(owner * SCREEN + y) * SCREEN + x] = picture.reshape(len(picture), -1).view(row)[:, 0]  # (W,) rows


def squares_of(images: np.ndarray, across: int, row: np.dtype) -> np.ndarray:
    """A view of all W x W squares of images, in memory (..., across, across, 3), by their first pixel: (starts, W)."""
    width = row.itemsize // 3
    starts = images.size // 3 - (width - 1) * (across + 1)
    return np.ndarray((starts, width), row, images, 0, (3, 3 * across))


def gray(frames: np.ndarray) -> np.ndarray:
    """Pictures (..., 3) or (..., 1) uint8 in grayscale: (...) uint8, their luminance rounded to the nearest."""
    if frames.shape[-1] == 1:
        return frames[..., 0]
    return (frames @ LUMA + np.float32(0.5)).astype(np.uint8)


def read_only(table: np.ndarray) -> np.ndarray:
    """The table, which can no longer be written to, since many environments share it."""
    table.flags.writeable = False
    return table


def magnify(frame: np.ndarray, factor: int) -> np.ndarray:
    """A frame enlarged by a whole factor, nearest neighbour."""
    return frame.repeat(factor, axis=0).repeat(factor, axis=1)
