"""Reset options: how long they hold, and what is a wrong one."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from helpers import EACH, FAMILY, HASTY, LANES, check_same, make, roll

from memory_gym_envs import MortarMayhem, MysteryPath, SearingSpotlights


@EACH
def test_options_stay_until_the_next_explicit_reset(env_id):
    envs, hasty = make(env_id), HASTY[FAMILY[env_id]]
    envs.reset(seed=0, options=hasty)
    steps = roll(envs, 100)
    ends = [reward for step in steps for reward in step[1][step[2] | step[3]]]
    assert len(ends) > LANES  # several episodes a lane
    assert min(ends) == min(ends[LANES:]) == -1.0
    assert envs.settings == [envs.complete_options(hasty)] * LANES
    envs.reset()
    assert envs.settings == [envs.defaults] * LANES
    assert all((step[1] >= 0).all() for step in roll(envs, 100))


@EACH
def test_options_that_an_environment_is_made_with(env_id):
    """They are its defaults: Gymnasium's own vector environment, which resets without options, keeps them."""
    hasty = HASTY[FAMILY[env_id]]
    envs = make(env_id, options=hasty)
    assert envs.defaults == make(env_id).complete_options(hasty)
    envs.reset(seed=0, options={"agent_scale": 0.5})
    assert envs.settings == [make(env_id).complete_options({**hasty, "agent_scale": 0.5})] * LANES
    envs.reset(seed=0)
    same_step = {"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}
    theirs = gym.make_vec(env_id, LANES, vectorization_mode="sync", vector_kwargs=same_step, options=hasty)
    theirs.reset(seed=0)
    ended = 0
    for actions in (envs.action_space.sample() for _ in range(100)):
        ours, other = envs.step(actions), theirs.step(actions)
        ended += (ours[2] | ours[3]).sum()
        check_same(ours[0], other[0])
        for mine, their in zip(ours[1:4], other[1:4], strict=True):
            np.testing.assert_array_equal(mine, their)
    assert ended > LANES
    with pytest.raises(ValueError, match=r"'agent_skale'.*'agent_scale'"):
        make(env_id, options={"agent_skale": 1})


@pytest.mark.parametrize(
    "counts", [[2.0, 3.0], range(2, 4), np.array([2.0, 3.0]), (np.float32(2), np.int8(3))], ids=str
)
def test_whole_floats_and_ranges(counts):
    """They are what they stand for: integers, and lists of them."""
    env = gym.make("MortarMayhem-Grid-v0").unwrapped
    env.reset(seed=0, options={"command_count": counts, "allowed_commands": 4.0})
    assert (env.reset_params["command_count"], env.reset_params["allowed_commands"]) == ((2, 3), 4)
    assert {type(each) for each in (*env.reset_params["command_count"], env.reset_params["allowed_commands"])} == {int}


WRONG_ANYWHERE = [
    ({"agent_skale": 1.0}, "'agent_skale'.*'agent_scale'.*a number from 0.04 to 1.0"),
    ({"agent_scale": 0}, "'agent_scale'.*a number from 0.04 to 1.0"),
    ({"agent_scale": float("nan")}, "'agent_scale'"),
    ({"agent_scale": None}, "'agent_scale'"),
    ({"visual_feedback": 1}, "'visual_feedback'.*true or false.*1"),
    ({"visual_feedback": "yes"}, "'visual_feedback'"),
    ({7: 1}, "7"),
    ({"agent\nscale": 1}, r"'agent\\nscale'.*'agent_scale'"),
    ([("agent_scale", 1)], "options must be a dictionary"),
]

WRONG_MORTAR_MAYHEM = [
    ({"arena_sise": 3}, "'arena_sise'.*'(arena|agent)_"),
    ({"explosion_dellay": [3]}, "'explosion_dellay'.*'explosion_delay'.*a list of 1 to 100 integers from 1 to 1000"),
    ({"explosion_delay": 18}, "'explosion_delay'.*a list of 1 to 100 integers from 1 to 1000.*18"),
    ({"explosion_delay": []}, "'explosion_delay'"),
    ({"explosion_delay": [0]}, "'explosion_delay'"),
    ({"explosion_duration": [2, 2.5]}, "'explosion_duration'"),
    ({"explosion_duration": ["2"]}, "'explosion_duration'"),
    ({"explosion_duration": "12"}, "'explosion_duration'"),
    ({"allowed_commands": 3}, "'allowed_commands'.*an integer from 4 to 9.*3"),
    ({"allowed_commands": 10}, "'allowed_commands'"),
    ({"allowed_commands": True}, "'allowed_commands'"),
    ({"allowed_commands": 4.5}, "'allowed_commands'.*an integer from 4 to 9.*4.5"),
    ({"allowed_commands": float("nan")}, "'allowed_commands'"),
    ({"allowed_commands": float("inf")}, "'allowed_commands'"),
    ({"explosion_delay": range(2)}, "'explosion_delay'"),
    ({"reward_command_success": float("inf")}, "'reward_command_success'.*a number from -1000000000 to 1000000000"),
    ({"reward_command_success": 1e308}, "'reward_command_success'"),
    ({"explosion_delay": [18] * 101}, "'explosion_delay'.*a list of 1 to 100 integers"),
    ({"explosion_delay": np.array(18)}, "'explosion_delay'"),
    ({"explosion_delay": np.ones((3, 3), int)}, "'explosion_delay'"),
]

WRONG_MYSTERY_PATH = [
    ({"reward_stepp": 3}, "'reward_stepp'.*'reward_step'.*a number"),
    ({"max_steps": 0}, "'max_steps'.*-1 or an integer from 1 to 1000000000, not 0"),
    ({"max_steps": 1.5}, "'max_steps'"),
    ({"max_steps": 2**63}, "'max_steps'"),
    ({"reward_step": 10**400}, "'reward_step'"),
    ({"max_steps": [128]}, "'max_steps'"),
    ({"reward_fall_off": float("inf")}, "'reward_fall_off'.*a number"),
    ({"show_origin": 0}, "'show_origin'.*true or false.*0"),
]

WRONG_SPOTLIGHTS = [
    ({"agent_helth": 3}, "'agent_helth'.*'agent_health'.*an integer from 1 to 1000000000"),
    ({"agent_health": 0}, "'agent_health'.*an integer from 1 to 1000000000, not 0"),
    ({"initial_spawns": 101}, "'initial_spawns'.*an integer from 0 to 100.*101"),
    ({"spot_min_radius": 0.9}, "'spot_min_radius'.*a number from 1 to 42"),
    ({"spot_max_speed": 1.01}, "'spot_max_speed'"),
    ({"spot_damage": -1}, "'spot_damage'"),
    ({"light_threshold": 256}, "'light_threshold'.*an integer from 0 to 255"),
    ({"black_background": 1}, "'black_background'.*true or false"),
    ({"coin_scale": 0.0}, "'coin_scale'.*a number from 0.1 to 2.0"),
    ({"max_steps": 0}, "'max_steps'.*-1 or an integer from 1 to 1000000000"),
    ({"agent_speed": [3.0]}, "'agent_speed'"),
    ({"spawn_delay": 5}, "'spawn_delay'.*a list of 1 to 100 integers from 0 to 1000, not 5"),
    ({"spawn_delay": [0, 1001]}, "'spawn_delay'"),
    ({"spawn_delay": []}, "'spawn_delay'"),
]

WRONG = {
    MortarMayhem: WRONG_ANYWHERE + WRONG_MORTAR_MAYHEM,
    MysteryPath: WRONG_ANYWHERE + WRONG_MYSTERY_PATH,
    SearingSpotlights: WRONG_ANYWHERE + WRONG_SPOTLIGHTS,
}


@EACH
def test_wrong_option_changes_nothing(env_id):
    envs, env = make(env_id), gym.make(env_id)
    envs.reset(seed=0)
    env.reset(seed=0)
    before = pickle.dumps(envs)
    for options, message in WRONG[FAMILY[env_id]]:
        for each in (envs, env):
            with pytest.raises(ValueError, match=message) as error:
                each.reset(seed=1, options=options)
            assert "\n" not in str(error.value)
        assert pickle.dumps(envs) == before


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        ("MortarMayhem-v0", {"arena_size": 7}),
        ("MortarMayhem-v0", {"arena_size": 1}),
        ("MortarMayhem-v0", {"max_steps": 5}),
        ("MortarMayhem-v0", {"command_count": [10, 101]}),
        ("MortarMayhem-v0", {"command_show_duration": [0]}),
        ("MortarMayhem-v0", {"command_show_delay": [-1]}),
        ("MortarMayhem-Grid-v0", {"agent_speed": 3.0}),
        ("MortarMayhemB-v0", {"command_count": [21]}),
        ("MortarMayhemB-Grid-v0", {"command_show_delay": [1]}),
        ("Endless-MortarMayhem-v0", {"arena_size": 5}),
        ("Endless-MortarMayhem-v0", {"max_steps": 0}),
        ("Endless-MortarMayhem-v0", {"initial_command_count": 0}),
        ("MysteryPath-v0", {"cardinal_origin_choice": [0, 4]}),
        ("MysteryPath-v0", {"cardinal_origin_choice": []}),
        ("MysteryPath-v0", {"cardinal_origin_choice": 1}),
        ("MysteryPath-v0", {"agent_speed": 85.0}),
        ("MysteryPath-v0", {"stamina_level": 20}),
        ("MysteryPath-Grid-v0", {"agent_speed": 3.0}),
        ("MysteryPath-Grid-v0", {"reward_goal": "much"}),
        ("Endless-MysteryPath-v0", {"reward_goal": 1.0}),
        ("Endless-MysteryPath-v0", {"show_goal": True}),
        ("Endless-MysteryPath-v0", {"cardinal_origin_choice": [0]}),
        ("Endless-MysteryPath-v0", {"camera_offset_scale": 5.6}),
        ("Endless-MysteryPath-v0", {"stamina_level": 0}),
        ("SearingSpotlights-v0", {"steps_per_coin": 160}),
        ("SearingSpotlights-v0", {"num_coins": [21]}),
        ("SearingSpotlights-v0", {"num_coins": 1}),
        ("SearingSpotlights-v0", {"coin_enabled": False}),
        ("SearingSpotlights-v0", {"coin_feedback": False}),
        ("Endless-SearingSpotlights-v0", {"num_coins": [1]}),
        ("Endless-SearingSpotlights-v0", {"use_exit": False}),
        ("Endless-SearingSpotlights-v0", {"coin_feedback": 0}),
        ("Endless-SearingSpotlights-v0", {"spawn_interval": 0}),
        ("Endless-SearingSpotlights-v0", {"steps_per_coin": 0}),
    ],
)
def test_options_of_one_id_alone(env_id, options):
    with pytest.raises(ValueError, match=next(iter(options))):
        gym.make(env_id).reset(options=options)


@EACH
def test_values_may_be_numpys(env_id):
    """The settings are plain Python all the same."""
    numpys, envs = {"bool": np.bool_, "int": np.int64, "float": np.float64, "ints": np.array}, make(env_id)
    given = {option.name: numpys[option.kind](option.default) for option in envs.variant.options}
    check_same(envs.complete_options(given), envs.defaults)


@EACH
def test_defaults_are_allowed(env_id):
    for option in FAMILY[env_id].variants[env_id].options:
        assert option.parse(option.default) == option.default
