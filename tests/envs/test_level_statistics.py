"""Levels are as long as the thesis measured (table 4.5)."""

import gymnasium as gym
import numpy as np
import pytest

from level_statistics import THESIS, fewest_steps, path_lengths, spotlight_lengths
from memory_gym_envs.players import player


def test_optimal_length_of_spotlight_levels():
    lengths = spotlight_lengths(1000)
    mean, deviation, least, most, _ = THESIS["SearingSpotlights-v0"]
    assert abs(lengths.mean() - mean) < 0.5
    assert abs(lengths.std() - deviation) < 0.5
    assert lengths.min() >= least
    assert lengths.max() <= most


@pytest.mark.parametrize(
    ("env_id", "levels", "straight"), [("MysteryPath-v0", 500, 22), ("MysteryPath-Grid-v0", 500, 6)]
)
def test_shortest_walk_of_path_levels(env_id, levels, straight):
    """Close to what a trained agent needs that sees the path. The shortest path leads straight ahead."""
    lengths = path_lengths(env_id, levels)
    mean, deviation, *_ = THESIS[env_id]
    assert abs(lengths.mean() - mean) < 0.5
    assert abs(lengths.std() - deviation) < 0.5
    assert lengths.min() >= straight


@pytest.mark.parametrize("env_id", ["MysteryPath-v0", "MysteryPath-Grid-v0"])
def test_no_player_is_faster(env_id):
    """The scripted player, who walks along the path, is never faster than the fewest steps, but sometimes as fast."""
    envs = gym.make_vec(env_id, num_envs=40)
    envs.reset(seed=0)
    fewest, taken = fewest_steps(envs), np.zeros(40, int)
    for step in range(1, 200):
        *_, infos = envs.step(player(envs))
        first = infos.get("_final_info", np.zeros(40, bool)) & (taken == 0)
        taken[first] = step
    assert taken.all()
    assert (taken >= fewest).all()
    assert (taken == fewest).any()
