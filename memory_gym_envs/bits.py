"""Shapes at any position in a frame as bits: laid over each other, counted, and turned into pixels.

Bits come in two kinds. A mask has one for every pixel: 84 rows of 7 items, an item being 12 neighbouring pixels,
(84, 7) uint16. A subsample has one for every third pixel: every second row, and 8 of 12 neighbouring pixels as a byte,
(42,) uint64. The lowest bit is the leftmost pixel.
Shape letters: K shapes, n frames, U uint64s of a mask or a subsample.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from memory_gym_envs.drawing import SCREEN

ITEM = 12
ITEMS = SCREEN // ITEM
TILES = SCREEN // 12
MASK = SCREEN * ITEMS  # items of a mask
ROW_STEP = 2
SUBSAMPLE_ROWS = SCREEN // ROW_STEP  # rows of a subsample
FULL_ROW = np.uint64((1 << 8 * ITEMS) - 1)  # all bits of one
SUBSAMPLE_COLUMNS = np.array([0, 1, 3, 4, 6, 7, 9, 10])  # which of 12 pixels are
POSITIONS, POSITION_0 = 256, 64  # shapes are at -64 .. 191 on both axes
NO_SHAPE = np.zeros((0, 0), bool)


class Stencils(NamedTuple):
    """Square shapes at every position, which is the corner of their four middle pixels.

    A picture of one is a window on a long strip, on which it stands between dark rows, once for every x. The arrays
    (K * POSITIONS,) are looked up by shape * POSITIONS + POSITION_0 + x, or y.
    """

    windows: np.ndarray  # (rows,) by their first row on the strip: one opaque item each, a view of the strip
    column: np.ndarray  # where on the strip the shape starts, for every x
    row: np.ndarray  # how far from there the window starts, for every y

    def at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The pictures at these keys, (...): (..., U) uint64."""
        pictures = self.windows[self.column.take(x) + self.row.take(y)]
        return pictures.view(np.uint64).reshape(*pictures.shape, pictures.itemsize // 8)


def stencils(shapes: Sequence[np.ndarray], height: int = SCREEN) -> Stencils:
    """Masks of (W, W) shapes, W even: of the frame's first rows, so many."""
    return _stencils(shapes, _packed, 1, height)


def subsample_stencils(shapes: Sequence[np.ndarray]) -> Stencils:
    """Subsamples of (W, W) shapes, W even."""
    return _stencils(shapes, subsampled_rows, ROW_STEP, SUBSAMPLE_ROWS)


def _stencils(shapes: Sequence[np.ndarray], pack: Callable, step: int, height: int) -> Stencils:
    positions = np.arange(POSITIONS) - POSITION_0
    width = np.array([len(shape) for shape in shapes])[:, None]  # (K, 1)
    first = positions - width // 2  # (K, POSITIONS) the shape's first row or column
    # A subsample has every second row of a shape, these or those: every x has a part of the strip for either.
    part, phase = width // step + height, -first % step
    row = (-first // step).clip(-height, width // step) + part * phase
    column, end = np.full(first.shape, height), 2 * height + step * int(part.max())
    strip = [pack(np.zeros((end, SCREEN), bool))]  # a window that starts in its row `height` is dark whatever the y
    for index, shape in enumerate(shapes):
        if shape.size:
            seen = (first[index] < SCREEN) & (first[index] > -len(shape))
            column[index, seen] = end + step * part[index] * (first[index, seen] + len(shape) - 1)
            strip.append(_every_x(shape, pack, step, height))
            end += len(strip[-1])
    rows = np.concatenate(strip)  # (rows, items)
    window = np.dtype(f"V{rows[:height].nbytes}")
    windows = np.ndarray((len(rows) - height + 1,), window, rows, 0, rows.strides[:1])
    return Stencils(windows, column.reshape(-1), row.reshape(-1))


def _every_x(shape: np.ndarray, pack: Callable, step: int, height: int) -> np.ndarray:
    """Rows of a strip: a (W, W) mask at every x where any of it is on the screen, each part before dark rows."""
    wide = np.pad(shape, ((0, 0), (SCREEN - 1, SCREEN - 1)))
    cut = np.lib.stride_tricks.sliding_window_view(wide, SCREEN, axis=1)[:, ::-1]  # (W, X, 84), from left to right
    bits = pack(cut)  # (W, X, items)
    parts = bits.reshape(-1, step, *bits.shape[1:]).transpose(2, 1, 0, 3)  # (X, step, W / step, items)
    return np.pad(parts, ((0, 0), (0, 0), (0, height), (0, 0))).reshape(-1, bits.shape[2])


def _packed(pixels: np.ndarray) -> np.ndarray:
    """Rows of pixels (..., 84) bool as items (..., 7) uint16."""
    return pixels.reshape(*pixels.shape[:-1], ITEMS, ITEM) @ (1 << np.arange(ITEM, dtype=np.uint16))


def unpacked(items: np.ndarray) -> np.ndarray:
    """The reverse: (..., 7) uint16 as (..., 84) bool."""
    return (items[..., None] >> np.arange(ITEM, dtype=np.uint16) & 1).astype(bool).reshape(*items.shape[:-1], SCREEN)


def subsampled_rows(pixels: np.ndarray) -> np.ndarray:
    """Rows of pixels (..., 84) bool as one number each, (..., 1) uint64."""
    eights = pixels.reshape(*pixels.shape[:-1], ITEMS, ITEM)[..., SUBSAMPLE_COLUMNS]
    lines = np.packbits(eights, axis=-1, bitorder="little")[..., 0]  # (..., 7)
    rows = np.zeros((*lines.shape[:-1], 8), np.uint8)
    rows[..., :ITEMS] = lines
    return rows.view(np.uint64)


@cache
def _pixels() -> np.ndarray:
    """(2**ITEM,) items of 36 bytes: 255 where a bit is set."""
    bits = np.arange(1 << ITEM)[:, None] >> np.arange(ITEM) & 1
    return (bits.astype(np.uint8) * np.uint8(255)).repeat(3, axis=1).view(f"V{3 * ITEM}")[:, 0]


def pixel_scratch(count: int) -> np.ndarray:
    """Memory for the pixels of so many masks."""
    return np.empty((count, MASK), _pixels().dtype)


def pixels(masks: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Masks (n, 588) uint16 for frames: (n, FRAME) uint8, 255 where a bit is set.

    out: (n, 588) of pixel_scratch() to write it to, which costs less than fresh memory.
    """
    return _pixels().take(masks, out=out, mode="clip").view(np.uint8)


_BITS_OF_BYTES = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(axis=1, dtype=np.uint8)  # (256,)


def bit_counts(numbers: np.ndarray) -> np.ndarray:
    """How many bits of each number are set, (..., k) unsigned, contiguous: (..., k) uint8."""
    if hasattr(np, "bitwise_count"):  # since NumPy 2
        return np.bitwise_count(numbers)
    return _BITS_OF_BYTES[numbers.view(np.uint8)].reshape(*numbers.shape, numbers.itemsize).sum(axis=-1, dtype=np.uint8)


def tile_counts(lines: np.ndarray) -> np.ndarray:
    """Bits of subsamples, (n, 42) uint64, in each tile of 12 x 12 pixels, at most 48: (n, 49) uint8."""
    counts = bit_counts(lines.view(np.uint8)).view(np.uint64).reshape(len(lines), TILES, -1)
    sums_ = np.einsum("njr->nj", counts).view(np.uint8).reshape(len(lines), TILES, 8)
    return sums_[..., :TILES].reshape(len(lines), -1)


_X, _Y = (ITEM * np.arange(ITEMS)[:, None] + SUBSAMPLE_COLUMNS).reshape(-1), ROW_STEP * np.arange(SUBSAMPLE_ROWS)
_DIGITS = SCREEN.bit_length()  # of an x
# A row's pixels whose x has this binary digit; first all of them: (1 + _DIGITS, 1) uint64.
_PLANES = (_X >> np.arange(_DIGITS)[:, None] & 1).astype(np.uint64) @ (1 << np.arange(len(_X), dtype=np.uint64))
_PLANES = np.append(FULL_ROW, _PLANES)[:, None]
# (8 * 42, 3) float32: what their counts add to the number of pixels and to the sums of x and of y.
_MOMENTS: np.ndarray = np.zeros((1 + _DIGITS, SUBSAMPLE_ROWS, 3), np.float32)
_MOMENTS[0] = np.stack([np.ones(SUBSAMPLE_ROWS), np.full(SUBSAMPLE_ROWS, 0.5), _Y + 0.5], axis=1)
_MOMENTS[1:, :, 1] = 1 << np.arange(_DIGITS)[:, None]
_MOMENTS = _MOMENTS.reshape(-1, 3)


def sums(lines: np.ndarray) -> np.ndarray:
    """How many bits of subsamples, (n, 42) uint64, are set, and the sums of their pixels' x and y: (n, 3) float32."""
    counts = bit_counts(lines[:, None] & _PLANES)  # (n, 8, 42)
    return counts.reshape(len(lines), len(_MOMENTS)).astype(np.float32) @ _MOMENTS
