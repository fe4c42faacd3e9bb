"""Scripted players that see the whole state: they know the target and walk to it.

    from memory_gym_envs import players

    observations, rewards, terminations, truncations, infos = envs.step(players.player(envs))

For data to imitate, and to compare agents with. In Searing Spotlights the player goes straight through the light; where
the path of Endless Mystery Path goes left, it stops, since nobody can follow it.
"""

from typing import Any

import gymnasium as gym
import numpy as np

from memory_gym_envs.base import MemoryGymVectorEnv
from memory_gym_envs.drawing import SCREEN
from memory_gym_envs.mortar_mayhem.arena import TILE
from memory_gym_envs.mystery_path import MysteryPath
from memory_gym_envs.mystery_path.drawing import tile_centres
from memory_gym_envs.mystery_path.state import EAST, WEST
from memory_gym_envs.searing_spotlights import SearingSpotlights
from memory_gym_envs.searing_spotlights.state import AGENT, COIN, EXIT, GONE


def choices(env: Any) -> int:
    """How many values an action, or each part of one, has."""
    space = getattr(env, "single_action_space", env.action_space)
    return int(space.nvec[0]) if isinstance(space, gym.spaces.MultiDiscrete) else int(space.n)


def free_player(batch: Any) -> np.ndarray:
    """(N, 2) actions towards the middle of each lane's target tile, on a torus the short way."""
    s = batch.state
    away = s.target_corner + TILE // 2 - s.pos  # (N, 2)
    if batch.variant.endless:
        away = (away + SCREEN // 2) % SCREEN - SCREEN // 2
    return np.where(away > 2, 2, np.where(away < -2, 1, 0))


def grid_player(batch: Any) -> np.ndarray:
    """(N,) actions: turn the short way towards the target, first along x, then walk."""
    s = batch.state
    away = (s.target_corner + TILE // 2 - s.pos) // TILE  # (N, 2) tiles
    along_x = away[:, 0] != 0
    wanted = np.where(along_x, np.where(away[:, 0] > 0, 6, 2), np.where(away[:, 1] > 0, 4, 0))
    return np.where((away == 0).all(axis=1), 0, turn_or_walk(s.facing, wanted))


def turn_or_walk(facing: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(N,) actions of a grid id: one tile forward in the wanted direction, or turn to it the short way."""
    return np.where(facing == wanted, 3, np.where((wanted - facing) % 8 > 4, 2, 1))


def path_grid_player(batch: Any) -> np.ndarray:
    """(N,) actions to the path's next tile."""
    s = batch.state
    heading = s.direction_at[np.arange(batch.num_envs), s.last_path_step]
    return turn_or_walk(s.facing, np.array([6, 0, 4, 2])[heading])


def path_free_player(batch: Any) -> np.ndarray:
    """(N, 2) actions to the path's next tile: first to the middle of the way there, then along it."""
    s, lanes = batch.state, np.arange(batch.num_envs)
    away = tile_centres(s.path_cell[lanes, np.minimum(s.last_path_step + 1, s.path_length)]) - s.pos  # (N, 2)
    along_x = np.isin(s.direction_at[lanes, s.last_path_step], (EAST, WEST))
    aside = np.abs(np.where(along_x, away[:, 1], away[:, 0])) > 2
    both = np.where(away > 2, 2, np.where(away < -2, 1, 0))
    return both * np.stack([along_x != aside, along_x == aside], axis=1)


def path_endless_player(batch: Any) -> np.ndarray:
    """(N,) actions likewise. Where the path goes left, nothing."""
    across, down = path_free_player(batch).T
    return np.where(across == 2, 1, np.where(down > 0, down + 1, 0))


def spot_player(batch: Any) -> np.ndarray:
    """(N, 2) actions straight to the first coin left, then to the exit, whatever the spotlights do."""
    bodies = batch.state.bodies  # (2, N, B)
    order = np.concatenate([bodies[:, :, COIN:], bodies[:, :, [EXIT, AGENT]]], axis=2)
    first = np.argmax(order[0] != GONE, axis=1)  # (N,)
    away = (np.take_along_axis(order, first[None, :, None], axis=2)[:, :, 0] - bodies[:, :, AGENT]).T  # (N, 2)
    return np.where(away > 1, 2, np.where(away < -1, 1, 0))


def player(envs: MemoryGymVectorEnv) -> np.ndarray:
    """The actions, (N,) or (N, 2), of the player that knows the task of these environments.

    For one environment made by gym.make(id), env.step(player(env.unwrapped.batch)[0]).
    """
    if isinstance(envs, SearingSpotlights):
        actions = spot_player(envs)
    elif isinstance(envs, MysteryPath):
        endless, grid = envs.variant.endless, envs.variant.grid
        actions = (path_endless_player if endless else path_grid_player if grid else path_free_player)(envs)
    else:
        actions = (grid_player if envs.variant.grid else free_player)(envs)
    return np.ravel_multi_index(actions.T, envs.joined) if envs.joined else actions


def stumbling(batch: Any, rng: np.random.Generator, chance: np.ndarray) -> np.ndarray:
    """The player's actions, each lane's replaced by random ones with its chance (N,)."""
    actions = player(batch)
    stumble = rng.random(batch.num_envs) < chance
    random = rng.integers(0, choices(batch), actions.shape)
    return np.where(stumble if actions.ndim == 1 else stumble[:, None], random, actions)
