"""What the tests of every id share: the ids, a vector environment of each, random steps, and a strict comparison."""

import itertools

import gymnasium as gym
import numpy as np
import pytest

import memory_gym_envs
from memory_gym_envs import IDS, MortarMayhem, MysteryPath, SearingSpotlights
from memory_gym_envs.players import choices

LANES = 4
FAMILY = {env_id: family for family in memory_gym_envs.FAMILIES for env_id in family.variants}
EACH = pytest.mark.parametrize("env_id", IDS)
MORTAR = pytest.mark.parametrize("env_id", MortarMayhem.variants)
SPOTLIGHTS = pytest.mark.parametrize("env_id", SearingSpotlights.variants)


FAMILIES = pytest.mark.parametrize("env_id", ["MortarMayhem-Grid-v0", "MysteryPath-v0", "SearingSpotlights-v0"])
# Each id with one of the two, and each family with both: where the code that is tested is the same for all ids.
ONE_OBS = pytest.mark.parametrize(("env_id", "obs_type"), [*zip(IDS, itertools.cycle(("pixels", "vector")))])
EACH_OBS = pytest.mark.parametrize(("env_id", "obs_type"), [*itertools.product(IDS, ("pixels", "vector"))])
HASTY = {  # options that end episodes soon; the end of some earns -1
    MortarMayhem: {"explosion_delay": [2], "explosion_duration": (1,), "reward_command_failure": -1},
    MysteryPath: {"max_steps": 9, "reward_step": -1},
    SearingSpotlights: {"agent_health": 1, "initial_spawns": 20, "reward_death": -1},
}


def make(env_id, **arguments):
    return gym.make_vec(env_id, num_envs=LANES, **arguments)


def picture(observation):
    return observation["visual_observation"] if isinstance(observation, dict) else observation


def lane_of(observations, lane):
    return {k: v[lane] for k, v in observations.items()} if isinstance(observations, dict) else observations[lane]


def roll(envs, steps, seed=0):
    """Everything that some steps of random actions return."""
    rng = np.random.default_rng(seed)
    return [envs.step(rng.integers(0, choices(envs), envs.action_space.shape)) for _ in range(steps)]


def check_same(left, right, where="result"):
    """Both have the same types, keys, shapes, dtypes and values, all the way down."""
    assert type(left) is type(right), where
    if isinstance(left, dict):
        assert left.keys() == right.keys(), where
        for key in left:
            check_same(left[key], right[key], f"{where}[{key!r}]")
    elif isinstance(left, (tuple, list)) or (isinstance(left, np.ndarray) and left.dtype == object):
        assert len(left) == len(right), where
        for at, (one, other) in enumerate(zip(left, right, strict=True)):
            check_same(one, other, f"{where}[{at}]")
    elif isinstance(left, np.ndarray):
        assert (left.dtype, left.shape) == (right.dtype, right.shape), where
        assert np.array_equal(left, right), where
    else:
        assert left == right, where
