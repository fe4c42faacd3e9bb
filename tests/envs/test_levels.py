"""Seeds, generators and levels: what a reset plays, and where its random numbers come from."""

import pickle
import random

import gymnasium as gym
import numpy as np
from helpers import EACH, LANES, check_same, make, picture, roll


@EACH
def test_seeds(env_id):
    envs, more = make(env_id), make(env_id)
    first, _ = envs.reset(seed=5)
    again, _ = more.reset(seed=[5, 6, 7, 8])
    check_same(first, again)
    assert len({picture(first)[lane].tobytes() for lane in range(LANES)}) > 1
    assert envs.np_random_seed == (5, 6, 7, 8)
    following, _ = envs.reset()
    assert not np.array_equal(picture(first), picture(following))
    # None inside a list lets that lane's generator go on.
    mixed, _ = more.reset(seed=[None, 6, None, None])
    assert np.array_equal(picture(mixed)[0], picture(following)[0])
    assert np.array_equal(picture(mixed)[1], picture(first)[1])


@EACH
def test_generator_is_gymnasiums(env_id):
    env = gym.make(env_id).unwrapped
    env.reset(seed=9)
    assert env.np_random is env.batch.np_random[0] is env._np_random
    assert env.np_random_seed == 9
    fresh, _ = gym.utils.seeding.np_random(4)
    env.np_random = fresh
    assert env.np_random_seed == -1
    observation, _ = env.reset()
    assert env.np_random is fresh
    check_same(observation, env.reset(seed=4)[0])


def test_a_generator_from_outside():
    """A lane draws from it from the next reset on. Its seed is -1, Gymnasium's word for one that is not known."""
    envs = make("MysteryPath-v0")
    envs.reset(seed=5)
    fresh, _ = gym.utils.seeding.np_random(20)
    envs.set_generator(2, fresh)
    assert envs.np_random[2] is fresh
    assert envs.np_random_seed == (5, 6, -1, 8)
    _, infos = envs.reset(options={"show_goal": True, "reset_mask": np.arange(LANES) == 2})
    alone = gym.make("MysteryPath-v0")
    assert np.array_equal(infos["ground_truth"][2], alone.reset(seed=20)[1]["ground_truth"])
    assert envs.np_random[2].bit_generator.state == alone.unwrapped.np_random.bit_generator.state
    env = alone.unwrapped
    env._np_random = np.random.default_rng(1)  # as Gymnasium's own setter does it
    assert env.np_random_seed == -1


@EACH
def test_nothing_draws_from_a_global_generator(env_id):
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    before = (random.getstate(), pickle.dumps(np.random.get_state()))  # noqa: NPY002
    envs = make(env_id, num_levels=3)
    envs.reset(seed=2)
    roll(envs, 130)
    envs.reset()
    assert before == (random.getstate(), pickle.dumps(np.random.get_state()))  # noqa: NPY002


@EACH
def test_levels(env_id):
    """With num_levels every reset plays a level that reset(seed=level) plays; lanes choose differently."""
    envs = make(env_id, num_levels=4, start_level=100)
    single = gym.make(env_id)
    level_obs = {picture(single.reset(seed=level)[0]).tobytes(): level for level in range(100, 104)}
    truth = {tuple(single.reset(seed=level)[1]["ground_truth"]): level for level in range(100, 104)}
    explicit, _ = envs.reset(seed=0)
    assert np.array_equal(picture(explicit)[1], picture(single.reset(seed=1)[0]))  # an explicit seed is the level
    played = []
    for _ in range(12):
        observations, infos = envs.reset()
        assert all(picture(observations)[lane].tobytes() in level_obs for lane in range(LANES))
        assert all(tuple(each) in truth for each in infos["ground_truth"])
        assert all(100 <= seed < 104 for seed in envs.np_random_seed)
        played.append(envs.np_random_seed)
    assert {seed for row in played for seed in row} == {100, 101, 102, 103}
    columns = list(zip(*played, strict=True))
    assert len(set(columns)) == LANES
    again = make(env_id, num_levels=4, start_level=100)
    again.reset(seed=0)
    assert [(again.reset(), again.np_random_seed)[1] for _ in range(12)] == played
    automatic = gym.make_vec(env_id, num_envs=2, num_levels=2, start_level=100)
    automatic.reset()
    for *_, infos in roll(automatic, 130):
        assert set(automatic.np_random_seed) <= {100, 101}
        assert infos["ground_truth"].shape == (2, len(next(iter(truth))))


def test_unseeded_levels_differ():
    """Without a seed every lane of every environment takes its own entropy."""
    played = set()
    for _ in range(2):
        envs = gym.make_vec("MortarMayhem-v0", num_envs=3, num_levels=10**9)
        envs.reset()
        played.update(envs.np_random_seed)
    unlimited = gym.make_vec("MortarMayhem-v0", num_envs=3)
    unlimited.reset()
    assert len(played | set(unlimited.np_random_seed)) == 9
