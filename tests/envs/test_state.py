"""An environment's state: it can be copied, nobody else has a hand in it, and no episode leaves anything behind."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from helpers import EACH, EACH_OBS, HASTY, check_same, make, roll
from players import FAMILY, choices


@EACH_OBS
@pytest.mark.parametrize("clone", [lambda e: pickle.loads(pickle.dumps(e)), copy.deepcopy], ids=["pickle", "deepcopy"])
@pytest.mark.parametrize("num_levels", [None, 5])
def test_copies_have_the_same_future(env_id, obs_type, clone, num_levels):
    envs = make(env_id, obs_type=obs_type, num_levels=num_levels)
    envs.reset(seed=1, options=HASTY[FAMILY[env_id]] | {"agent_scale": 0.3})
    roll(envs, 70)
    twin = clone(envs)
    check_same(roll(envs, 100, seed=2), roll(twin, 100, seed=2))
    for ours, theirs in zip(envs.np_random, twin.np_random, strict=True):
        assert ours is not theirs
        assert ours.bit_generator.state == theirs.bit_generator.state


@EACH
def test_closing_one_leaves_the_others(env_id):
    first, second = gym.make(env_id, render_mode="rgb_array"), gym.make(env_id, render_mode="rgb_array")
    vector = make(env_id)
    for each in (first, second, vector):
        each.reset(seed=0)
    first.close()
    first.close()
    vector.close()
    second.step(second.action_space.sample())
    assert second.render().shape == (84, 84, 3)


@EACH_OBS
def test_returned_arrays_are_the_callers(env_id, obs_type):
    """Overwriting everything that was returned changes nothing later."""
    envs, twin = make(env_id, obs_type=obs_type), make(env_id, obs_type=obs_type)
    results = [envs.reset(seed=0)]
    twin.reset(seed=0)
    for _ in range(3):
        spoil(results.pop())
        for left, right in zip(roll_and_spoil(envs, 60), roll(twin, 60), strict=True):
            check_same(left, right)
        results.append(envs.reset())
        twin.reset()


def roll_and_spoil(envs, steps):
    rng = np.random.default_rng(0)
    for _ in range(steps):
        result = envs.step(rng.integers(0, choices(envs), envs.action_space.shape))
        yield copy.deepcopy(result)
        spoil(result)


def spoil(part):
    if isinstance(part, np.ndarray) and part.dtype == object:
        for each in part:
            spoil(each)
    elif isinstance(part, np.ndarray):
        part.fill(77)
    elif isinstance(part, dict):
        for each in part.values():
            spoil(each)
    elif isinstance(part, (tuple, list)):
        for each in part:
            spoil(each)


@EACH_OBS
def test_an_observation_depends_on_this_episode_alone(env_id, obs_type):
    """The original shows the last episode's agent until the new one moves."""
    env, fresh = gym.make(env_id, obs_type=obs_type), gym.make(env_id, obs_type=obs_type)
    still = np.zeros_like(env.action_space.sample())
    env.reset(seed=1, options=HASTY[FAMILY[env_id]])
    over = False
    while not over:
        _, _, terminated, truncated, _ = env.step(still + choices(env.unwrapped.batch) - 1)
        over = terminated or truncated
    check_same(env.reset(seed=8), fresh.reset(seed=8))
    for _ in range(5):
        check_same(env.step(still), fresh.step(still))
