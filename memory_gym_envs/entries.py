"""What the vector observation of an id is made of: a row for each group of entries, in the vector's order."""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np


@dataclass(frozen=True)
class Entries:
    """Neighbouring entries of the vector that belong together."""

    name: str
    width: int  # how many there are
    meaning: str
    low: float = 0.0  # each of them is at least that
    high: float = 1.0  # and at most that


def vector_space(rows: tuple[Entries, ...]) -> gym.spaces.Box:
    """The space of the vector, (V,) float32."""
    low, high = (np.repeat([getattr(row, end) for row in rows], [row.width for row in rows]) for end in ("low", "high"))
    return gym.spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


def vector_slices(rows: tuple[Entries, ...]) -> dict[str, slice]:
    """Where each row's entries are in the vector."""
    ends = np.cumsum([row.width for row in rows]).tolist()
    return {row.name: slice(end - row.width, end) for row, end in zip(rows, ends, strict=True)}
