"""Scripted players that see the state, for tests: they know the target and walk to it."""

import numpy as np

TILE, SCREEN = 14, 84


def free_player(batch) -> np.ndarray:
    """(N, 2) actions towards the middle of each lane's target tile, on a torus the short way."""
    s = batch.state
    away = s.goal + TILE // 2 - s.pos  # (N, 2)
    if batch.variant.endless:
        away = (away + SCREEN // 2) % SCREEN - SCREEN // 2
    return np.where(away > 2, 2, np.where(away < -2, 1, 0))


def grid_player(batch) -> np.ndarray:
    """(N,) actions: turn the short way towards the target, first along x, then walk."""
    s = batch.state
    away = (s.goal + TILE // 2 - s.pos) // TILE  # (N, 2) tiles
    along_x = away[:, 0] != 0
    wanted = np.where(along_x, np.where(away[:, 0] > 0, 6, 2), np.where(away[:, 1] > 0, 4, 0))
    turn = np.where((wanted - s.facing) % 8 > 4, 2, 1)
    return np.where((away == 0).all(axis=1), 0, np.where(s.facing == wanted, 3, turn))


def player(batch) -> np.ndarray:
    """The right player for the batch's action space."""
    return grid_player(batch) if batch.variant.grid else free_player(batch)
