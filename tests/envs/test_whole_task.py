"""What oracle() tells is what infos, rewards and the rules say, step by step."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from helpers import EACH, LANES, make

from memory_gym_envs import MortarMayhem, MysteryPath, SearingSpotlights
from memory_gym_envs.mortar_mayhem.arena import MOVES
from memory_gym_envs.players import stumbling


def told(env_id, chance, steps=400):
    """Steps of players that stumble: what oracle() says before and after each, rewards, and infos."""
    envs, rng = make(env_id, obs_type="vector", autoreset_mode=AutoresetMode.NEXT_STEP), np.random.default_rng(0)
    with pytest.raises(gym.error.ResetNeeded, match="before oracle"):
        envs.oracle()
    envs.reset(seed=5)
    assert envs.oracle()["seed"].tolist() == [5, 6, 7, 8]
    for _ in range(steps):
        before, over = envs.oracle(), envs._over.copy()
        _, rewards, terminated, truncated, infos = envs.step(stumbling(envs, rng, np.full(LANES, chance)))
        after = envs.oracle()
        playing, ended = np.flatnonzero(~over), np.flatnonzero((terminated | truncated) & ~over)
        assert (after["length"] == np.where(over, 0, before["length"] + 1)).all()
        yield envs, before, after, rewards, infos, playing, ended


@pytest.mark.parametrize("env_id", MortarMayhem.variants)
def test_mortar_mayhem(env_id):
    earned = started = 0
    for envs, before, after, rewards, infos, playing, _ in told(env_id, 0.05):
        side = envs.state.size[:, None]
        np.testing.assert_allclose(infos["ground_truth"], after["target_tile"] / (side - 1))
        count = (before["commands"] >= 0).sum(1)
        due = before["commands"][np.arange(LANES), np.minimum(count - before["commands_left"], count - 1)]
        assert (due == before["command"])[before["commands_left"] > 0].all()
        begins = before["length"] == 0
        started += begins.sum()
        led = (before["tile"] + MOVES[before["command"]]) % side
        assert (led == before["target_tile"])[begins].all()
        paid = (rewards > 0)[playing]
        assert ((after["carried_out"] - before["carried_out"] == 1) == (rewards > 0))[playing].all()
        assert (after["tile"] == before["target_tile"])[playing][paid].all()
        earned += paid.sum()
    assert earned > 10
    assert started >= LANES


@pytest.mark.parametrize("env_id", MysteryPath.variants)
def test_mystery_path(env_id):
    headings = np.array([(1, 0), (0, -1), (0, 1), (-1, 0)])
    on_path = arrived = fell = 0
    for envs, before, after, _, infos, playing, ended in told(env_id, 0.3):
        fell += (after["falls"] - before["falls"])[playing].sum()
        for lane in np.setdiff1d(playing, ended).tolist():
            # The truth is the direction of the next tile, which stays as it was where an endless path goes left.
            to_next, path = (after["next_tile"] - after["tile"])[lane], after["path"][lane]
            path = path[path[:, 0] >= 0]  # from the origin, tile by tile
            assert (np.abs(np.diff(path, axis=0)).sum(1) == 1).all()
            if envs.state.path_step[lane] > 0:
                here = (path == after["tile"][lane]).all(1).argmax()
                assert path[[here, here + 1][: len(path) - here]].tolist()[-1] == after["next_tile"][lane].tolist()
            if envs.state.path_step[lane] > 0 and (to_next[0] >= 0 or not envs.variant.endless):
                on_path += 1
                assert to_next.tolist() == headings[infos["ground_truth"][lane].argmax()].tolist()
        for lane in [] if envs.variant.endless else ended.tolist():
            assert after["falls"][lane] == infos["num_fails"][lane]
            arrived += infos["success"][lane]
            assert (after["tiles_left"][lane] == 0) == infos["success"][lane]
            assert (after["tile"] == after["goal_tile"])[lane].all() == infos["success"][lane]
    assert min(on_path, fell) > 5
    assert arrived > 3 or envs.variant.endless


@pytest.mark.parametrize("env_id", SearingSpotlights.variants)
def test_searing_spotlights(env_id):
    collected = 0
    for envs, before, after, _, infos, playing, _ in told(env_id, 0.1):
        np.testing.assert_allclose(infos["ground_truth"][:, :2] * 84, after["position"])
        there = ~np.isnan(after["coins"]).any(2)  # (N, C)
        if not envs.variant.endless:
            assert (there.sum(1) == after["coins_left"]).all()
            np.testing.assert_allclose(infos["ground_truth"][:, 4:] * 84, after["exit"])
            assert (after["exit_is_open"] == (after["coins_left"] == 0)).all()
        for lane in playing.tolist():
            collected += after["coins_collected"][lane] - before["coins_collected"][lane]
            assert after["health"][lane] <= before["health"][lane]
    assert collected > 5


@EACH
def test_one_environment(env_id):
    env, envs = gym.make(env_id).unwrapped, gym.make_vec(env_id, num_envs=1)
    env.reset(seed=3)
    envs.reset(seed=3)
    one, batch = env.oracle(), envs.oracle()
    assert one.keys() == batch.keys()
    assert all(np.array_equal(one[name], batch[name][0], equal_nan=True) for name in one)
    for name in batch:
        batch[name][:] = 0  # it is the caller's
    again = envs.oracle()
    assert all(np.array_equal(one[name], again[name][0], equal_nan=True) for name in one)
