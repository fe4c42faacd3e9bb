"""Lane i of N is a single environment with its seed: what a vector environment returns is what Gymnasium's own returns.

`SyncVectorEnv` in the same-step mode steps single environments one by one. Ours has to agree with it key by key.
"""

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from helpers import FAMILY, HASTY, ONE_OBS, check_same, lane_of, make, roll

from memory_gym_envs import MortarMayhem, MysteryPath, SearingSpotlights
from memory_gym_envs.players import stumbling

LANES = 3
OPTIONS = {
    "MortarMayhem-v0": {"command_count": [1, 2], "command_show_duration": [1, 2], "explosion_delay": [6, 12]},
    "MortarMayhem-Grid-v0": {"command_count": [1, 4], "command_show_delay": [0, 1]},
    "MortarMayhemB-v0": {"agent_scale": 0.4, "agent_speed": 4.5},
    "MortarMayhemB-Grid-v0": {"arena_size": 3, "explosion_duration": [1, 2]},
    "Endless-MortarMayhem-v0": {"max_steps": 120, "explosion_delay": [12, 18], "agent_speed": 3.7},
    "MysteryPath-v0": {"max_steps": 25, "show_origin": True, "show_goal": True, "cardinal_origin_choice": [0, 3]},
    "MysteryPath-Grid-v0": {"max_steps": 20, "reward_path_progress": 0.1, "show_goal": True},
    "Endless-MysteryPath-v0": {"stamina_level": 15, "show_stamina": True, "show_background": True, "agent_speed": 4.6}
    | {"camera_offset_scale": 2.3},
    "SearingSpotlights-v0": {"num_coins": [0, 2, 4], "coin_scale": 0.6, "initial_spawns": 10, "black_background": True},
    "Endless-SearingSpotlights-v0": {"steps_per_coin": 15, "light_threshold": 150, "agent_visible": True}
    | {"coin_feedback": False},
}
CHANGED = {
    MortarMayhem: {"explosion_delay": [9], "agent_scale": 0.5},
    MysteryPath: {"reward_step": -0.5, "agent_scale": 0.4},
    SearingSpotlights: {"spot_min_radius": 2.0, "spot_max_radius": 30, "initial_spawns": 9, "agent_scale": 0.5}
    | {"spawn_delay": [0, 3, 8]},
}


class Told(gym.Wrapper):
    """A single environment that is reset with the same options until it is told others.

    Automatic resets of ours keep the options, and those of SyncVectorEnv give none.
    """

    def __init__(self, env):
        super().__init__(env)
        self.options = None

    def reset(self, *, seed=None, options=None):
        return self.env.reset(seed=seed, options=self.options)


def gymnasiums_own(env_id, **arguments):
    return SyncVectorEnv(
        [lambda: Told(gym.make(env_id, disable_env_checker=True, **arguments))] * LANES,
        autoreset_mode=AutoresetMode.SAME_STEP,
    )


def reset_both(ours, theirs, seed, options, mask=None):
    """The same explicit reset of both, whose results must agree."""
    lanes = range(LANES) if mask is None else np.flatnonzero(mask)
    for lane in lanes:
        theirs.envs[lane].options = options
    # A dictionary for each, as SyncVectorEnv takes the mask out.
    results = [envs.reset(seed=seed, options=masked(options, mask)) for envs in (ours, theirs)]
    check_same(*results)


def masked(options, mask):
    return options if mask is None else {**(options or {}), "reset_mask": mask}


def check_resets_and_steps(ours, theirs, resets):
    """Both return the same after each reset (seed, options, mask), and in the steps that follow it."""
    rng, ended = np.random.default_rng(0), 0
    for seed, given, mask in resets:
        reset_both(ours, theirs, seed, given, mask)
        for _ in range(40):
            actions = mixed_actions(ours, rng)
            result = ours.step(actions)
            check_same(result, theirs.step(actions))
            ended += np.count_nonzero(result[2] | result[3])
        for lane in range(LANES):
            assert ours.np_random_seed[lane] == theirs.np_random_seed[lane]
            assert ours.np_random[lane].bit_generator.state == theirs.np_random[lane].bit_generator.state
    assert ended > LANES


def mixed_actions(envs, rng) -> np.ndarray:
    """Players that stumble, the later lanes ever more often, so that episodes of all lengths occur."""
    return stumbling(envs, rng, np.linspace(0.1, 1.0, envs.num_envs))


LEVELS = {"pixels": {}, "vector": {"num_levels": 3, "start_level": 40}}


@ONE_OBS
def test_as_gymnasiums_own(env_id, obs_type):
    """Explicit resets of every kind, and two hundred steps with automatic ones between them."""
    levels = LEVELS[obs_type]
    ours = gym.make_vec(env_id, num_envs=LANES, obs_type=obs_type, **levels)
    theirs = gymnasiums_own(env_id, obs_type=obs_type, **levels)
    options, changed = OPTIONS[env_id], CHANGED[FAMILY[env_id]]
    resets = [
        (11, None, None),
        ([5, None, 0], options, None),
        (None, changed, np.array([True, False, True])),
        ([7, 8, None], None, np.array([False, True, True])),
        (None, None, None),
    ]
    check_resets_and_steps(ours, theirs, resets)


@ONE_OBS
def test_ended_episodes(env_id, obs_type):
    """Every step belongs to an episode, and the masks say whose has ended."""
    envs = make(env_id, obs_type=obs_type)
    envs.reset(seed=0, options=HASTY[FAMILY[env_id]])
    lengths, rewards, ends = np.zeros(envs.num_envs, int), np.zeros(envs.num_envs), 0
    for _, reward, terminated, truncated, infos in roll(envs, 150):
        lengths, rewards = lengths + 1, rewards + reward
        assert infos["_ground_truth"].all()
        ended = terminated | truncated
        if not ended.any():
            assert infos.keys() == {"ground_truth", "_ground_truth"}
            continue
        final, masks = infos["final_info"], [infos["_final_obs"], infos["_final_info"]]
        names = {key for key in final if not key.startswith("_")}
        assert names >= {"reward", "length", "ground_truth"}
        for mask in [*masks, *(final[f"_{name}"] for name in names)]:
            assert mask.dtype == bool
            assert np.array_equal(mask, ended)
        assert not any(final[name][~ended].any() for name in names)
        for lane, observation in enumerate(infos["final_obs"]):
            assert observation in envs.single_observation_space if ended[lane] else observation is None
        assert np.array_equal(final["length"][ended], lengths[ended])
        np.testing.assert_allclose(final["reward"][ended], rewards[ended])
        lengths[ended], rewards[ended], ends = 0, 0.0, ends + np.count_nonzero(ended)
    assert ends > 2 * envs.num_envs


@ONE_OBS
def test_reset_mask_resets_only_its_lanes(env_id, obs_type):
    envs, twin = make(env_id, obs_type=obs_type), make(env_id, obs_type=obs_type)
    before, _ = envs.reset(seed=1)
    twin.reset(seed=1)
    rng = np.random.default_rng(1)
    for _ in range(5):
        actions = mixed_actions(envs, rng)
        before, *_ = envs.step(actions)
        twin.step(actions)
    mask, changed = np.array([False, True, False, True]), CHANGED[FAMILY[env_id]]
    options = {"reset_mask": mask, **changed}
    after, infos = envs.reset(seed=[None, 7, None, 8], options=options)
    assert list(options) == ["reset_mask", *changed]  # the caller's dictionary is untouched
    for lane in (0, 2):
        check_same(lane_of(after, lane), lane_of(before, lane))
    assert infos["_ground_truth"].tolist() == mask.tolist()
    assert not infos["ground_truth"][~mask].any()
    # Lanes 0 and 2 go on as if nothing had happened, with their own options, and the others with the new ones.
    for _ in range(60):
        actions = mixed_actions(envs, rng)
        ours, theirs = envs.step(actions), twin.step(actions)
        for lane in (0, 2):
            check_same(lane_of(ours[0], lane), lane_of(theirs[0], lane))
            assert [part[lane] for part in ours[1:4]] == [part[lane] for part in theirs[1:4]]
    assert envs.settings == [envs.defaults, envs.complete_options(changed)] * 2


def test_lanes_with_different_options_differ():
    envs = gym.make_vec("MortarMayhem-v0", num_envs=3)
    envs.reset(seed=0)
    envs.reset(seed=0, options={"reset_mask": np.array([False, True, False]), "arena_size": 6, "agent_scale": 0.8})
    observations, _ = envs.reset(seed=0, options={"reset_mask": np.array([False, False, True]), "arena_size": 2})
    black = (observations == 0).all(axis=-1).mean(axis=(1, 2))  # (3,) share of the screen outside the arena
    assert black[1] < 0.01 < black[0] < 0.4 < black[2]
    bodies = (observations == (250, 204, 153)).all(axis=-1).sum(axis=(1, 2))
    assert bodies[1] > 4 * bodies[0] > 0


AGAIN = {  # episodes of different lengths, in which the next one would meet what the one before has left
    "MortarMayhem-v0": {"command_count": [1, 4], "command_show_duration": [1, 3], "explosion_delay": [4]},
    "MortarMayhem-Grid-v0": {"command_count": [1, 4], "command_show_duration": [1, 3]},
    "MortarMayhemB-v0": {"command_count": [1, 3]},
    "MortarMayhemB-Grid-v0": {"command_count": [1, 3]},
    "Endless-MortarMayhem-v0": {"max_steps": 60, "initial_command_count": 2, "explosion_delay": [6]},
    "MysteryPath-v0": {"max_steps": 40, "show_goal": True},
    "MysteryPath-Grid-v0": {"max_steps": 20, "show_origin": True},
    "Endless-MysteryPath-v0": {"show_stamina": True, "stamina_level": 15, "agent_speed": 6.0},
    "SearingSpotlights-v0": {"num_coins": [0, 3], "agent_health": 2, "initial_spawns": 8},
    "Endless-SearingSpotlights-v0": {"steps_per_coin": 25, "agent_health": 3, "initial_spawns": 8},
}


@ONE_OBS
def test_an_episode_is_as_in_an_environment_that_was_never_used(env_id, obs_type):
    """Nothing of the episode before is left, in pictures, rules or the summary, wherever a player got to."""
    options = AGAIN[env_id]
    envs = gym.make_vec(env_id, num_envs=LANES, obs_type=obs_type, num_levels=4)
    first, _ = envs.reset(seed=4, options=options)
    rng, lengths = np.random.default_rng(0), []
    fresh = [
        fresh_twin(env_id, obs_type, seed, options, lane_of(first, i)) for i, seed in enumerate(envs.np_random_seed)
    ]
    for _ in range(150):
        actions = stumbling(envs, rng, np.linspace(0, 1, LANES))
        obs, *numbers, infos = envs.step(actions)
        for lane, twin in enumerate(fresh):
            seen, *wanted, wanted_info = twin.step(actions[lane])
            assert [column[lane] for column in numbers] == wanted
            if not (wanted[1] or wanted[2]):
                check_same(lane_of(obs, lane), seen)
                continue
            check_same(infos["final_obs"][lane], seen)
            for name, value in wanted_info.items():
                assert np.array_equal(infos["final_info"][name][lane], value), name
            lengths.append(wanted_info["length"])
            fresh[lane] = fresh_twin(env_id, obs_type, envs.np_random_seed[lane], options, lane_of(obs, lane))
    assert len(lengths) > 2 * LANES
    assert len(set(lengths)) > 1


def fresh_twin(env_id, obs_type, seed, options, first):
    """A new environment whose episode of this level begins with this observation."""
    twin = gym.make(env_id, obs_type=obs_type, disable_env_checker=True)
    check_same(twin.reset(seed=int(seed), options=options)[0], first)
    return twin
