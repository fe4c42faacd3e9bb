"""Lane i of N is a single environment with its seed: same levels, same rules, same pictures, resets included."""

import gymnasium as gym
import numpy as np
import pytest
from players import FAMILY, stumbling

import memory_gym_envs
from memory_gym_envs import MortarMayhem, MysteryPath, SearingSpotlights

LANES = 5
OPTIONS = {
    "MortarMayhem-v0": {"command_count": [1, 2], "command_show_duration": [1, 2], "explosion_delay": [6, 12]},
    "MortarMayhem-Grid-v0": {"command_count": [1, 4], "command_show_delay": [0, 1]},
    "MortarMayhemB-v0": {"agent_scale": 0.4, "agent_speed": 4.5},
    "MortarMayhemB-Grid-v0": {"arena_size": 3, "explosion_duration": [1, 2]},
    "Endless-MortarMayhem-v0": {"max_steps": 120, "explosion_delay": [12, 18], "agent_speed": 3.7},
    "MysteryPath-v0": {"max_steps": 60, "show_origin": True, "show_goal": True, "cardinal_origin_choice": [0, 3]},
    "MysteryPath-Grid-v0": {"max_steps": 30, "reward_path_progress": 0.1, "show_goal": True},
    "Endless-MysteryPath-v0": {"stamina_level": 15, "show_stamina": True, "show_background": True, "agent_speed": 4.6}
    | {"camera_offset_scale": 2.3},
    "SearingSpotlights-v0": {"num_coins": [0, 2, 4], "coin_scale": 0.6, "initial_spawns": 10, "black_background": True},
    "Endless-SearingSpotlights-v0": {"steps_per_coin": 40, "light_threshold": 150, "agent_visible": True},
}
CHANGED = {
    MortarMayhem: {"explosion_delay": [9], "agent_scale": 0.5},
    MysteryPath: {"reward_step": -0.5, "agent_scale": 0.4},
    SearingSpotlights: {"spot_min_radius": 2.0, "spot_max_radius": 30, "initial_spawns": 9, "agent_scale": 0.5},
}


def same(left, right) -> bool:
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(left[key], right[key]) for key in left)
    return np.array_equal(left, right)


def lane_of(observations, lane):
    return {k: v[lane] for k, v in observations.items()} if isinstance(observations, dict) else observations[lane]


def mixed_actions(envs, rng) -> np.ndarray:
    """Players that stumble, the later lanes ever more often, so that episodes of all lengths occur."""
    return stumbling(envs, rng, np.linspace(0.1, 1.0, envs.num_envs))


@pytest.mark.parametrize("num_levels", [None, 3])
@pytest.mark.parametrize("env_id", memory_gym_envs.IDS)
@pytest.mark.parametrize("changed", [False, True], ids=["default", "options"])
def test_lane_equals_single(env_id, changed, num_levels):
    levels = {"num_levels": num_levels, "start_level": 40} if num_levels else {}
    envs = gym.make_vec(env_id, num_envs=LANES, **levels)
    singles = [gym.make(env_id, **levels).unwrapped for _ in range(LANES)]
    options = OPTIONS[env_id] if changed else None
    observations, infos = envs.reset(seed=11, options=options)
    for lane, single in enumerate(singles):
        observation, info = single.reset(seed=11 + lane, options=options)
        assert same(observation, lane_of(observations, lane))
        assert same(info["ground_truth"], infos["ground_truth"][lane])
    rng, ended = np.random.default_rng(0), 0
    for _ in range(200):
        actions = mixed_actions(envs, rng)
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        for lane, single in enumerate(singles):
            action = actions[lane] if actions.ndim > 1 else int(actions[lane])
            observation, reward, over, cut, info = single.step(action)
            assert (reward, over, cut) == (rewards[lane], terminated[lane], truncated[lane])
            if over or cut:
                ended += 1
                assert same(observation, infos["final_obs"][lane])
                final = {key: infos["final_info"][key][lane] for key in info}
                assert same(info, final)
                # An automatic reset keeps the options; the single environment is told them again.
                observation, info = single.reset(options=options)
            assert same(observation, lane_of(observations, lane))
            assert same(info["ground_truth"], infos["ground_truth"][lane])
    assert ended > 2


@pytest.mark.parametrize("env_id", memory_gym_envs.IDS)
def test_reset_mask_resets_only_its_lanes(env_id):
    envs, twin = (gym.make_vec(env_id, num_envs=4) for _ in range(2))
    before, _ = envs.reset(seed=1)
    twin.reset(seed=1)
    rng = np.random.default_rng(1)
    for _ in range(5):
        actions = mixed_actions(envs, rng)
        before, *_ = envs.step(actions)
        twin.step(actions)
    mask = np.array([False, True, False, True])
    changed = CHANGED[FAMILY[env_id]]
    options = {"reset_mask": mask, **changed}
    after, infos = envs.reset(seed=[None, 7, None, 8], options=options)
    assert list(options) == ["reset_mask", *changed]  # the caller's dictionary is untouched
    single = gym.make(env_id)
    for lane, level in ((1, 7), (3, 8)):
        fresh, _ = single.reset(seed=level, options=changed)
        assert same(lane_of(after, lane), fresh)
    for lane in (0, 2):
        assert same(lane_of(after, lane), lane_of(before, lane))
    assert infos["_ground_truth"].tolist() == mask.tolist()
    assert not infos["ground_truth"][~mask].any()
    # Lanes 0 and 2 go on as if nothing had happened, with their own options, and the others with the new ones.
    for _ in range(60):
        actions = mixed_actions(envs, rng)
        ours, theirs = envs.step(actions), twin.step(actions)
        for lane in (0, 2):
            assert same(lane_of(ours[0], lane), lane_of(theirs[0], lane))
            assert [part[lane] for part in ours[1:4]] == [part[lane] for part in theirs[1:4]]
    assert envs.settings == [envs.defaults, envs.resolve(changed)] * 2


def test_lanes_with_different_options_differ():
    envs = gym.make_vec("MortarMayhem-v0", num_envs=3)
    envs.reset(seed=0)
    envs.reset(seed=0, options={"reset_mask": np.array([False, True, False]), "arena_size": 6, "agent_scale": 0.8})
    observations, _ = envs.reset(seed=0, options={"reset_mask": np.array([False, False, True]), "arena_size": 2})
    black = (observations == 0).all(axis=-1).mean(axis=(1, 2))  # (3,) share of the screen outside the arena
    assert black[1] < 0.01 < black[0] < 0.4 < black[2]
    bodies = (observations == (250, 204, 153)).all(axis=-1).sum(axis=(1, 2))
    assert bodies[1] > 4 * bodies[0] > 0
