"""Scripted players that see the state, for tests: they know the target and walk to it."""

import gymnasium as gym
import numpy as np

from memory_gym_envs import FAMILIES, MortarMayhem
from memory_gym_envs.searing_spotlights import AGENT, COIN, EXIT, GONE

TILE, SCREEN = 14, 84
FAMILY = {env_id: family for family in FAMILIES for env_id in family.variants}


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


def spot_player(batch) -> np.ndarray:
    """(N, 2) actions straight to the first coin left, then to the exit, whatever the spotlights do."""
    bodies = batch.state.bodies  # (2, N, B)
    order = np.concatenate([bodies[:, :, COIN:], bodies[:, :, [EXIT, AGENT]]], axis=2)
    first = np.argmax(order[0] != GONE, axis=1)  # (N,)
    away = (np.take_along_axis(order, first[None, :, None], axis=2)[:, :, 0] - bodies[:, :, AGENT]).T  # (N, 2)
    return np.where(away > 1, 2, np.where(away < -1, 1, 0))


def player(batch) -> np.ndarray:
    """The right player for the batch."""
    if not isinstance(batch, MortarMayhem):
        return spot_player(batch)
    return grid_player(batch) if batch.variant.grid else free_player(batch)


def choices(env) -> int:
    """How many values an action, or each part of one, has."""
    space = getattr(env, "single_action_space", env.action_space)
    return int(space.nvec[0]) if isinstance(space, gym.spaces.MultiDiscrete) else int(space.n)
