"""What memory-gym 1.0.2 does where no recording leads, and 1.0.3. The expected values are what they gave."""

import copy
import json
import math
import zlib

import gymnasium as gym
import numpy as np
import pytest
from helpers import EACH, check_same, roll

import fuzz_original
from memory_gym_envs import IDS
from memory_gym_envs.character import DIAGONAL_FORTH, PAD, SPAN, STRIDES, Figure, sprites, walk_table
from memory_gym_envs.drawing import ring
from memory_gym_envs.options import complete_options
from memory_gym_envs.players import player, stumbling
from memory_gym_envs.searing_spotlights.drawing import draw_coins_and_exits

CROWD = {"spawn_interval": 1, "spot_min_speed": 1e-5, "spot_max_speed": 1e-4, "spot_damage": 0.0, "steps_per_coin": -1}


def test_diagonal_strides():
    """At speeds of whole pixels times the root of two, which the last bit decides."""
    strides = [1, 2, 2, 4, 5, 5, 6, 8, 8, 10, 10, 11, 12, 13, 15, 16, 16, 17, 19, 20, 20, 21, 22, 23, 25, 25, 27, 27]
    for pixels, stride in enumerate(strides, 1):
        figure = Figure(0.25, math.sqrt(2 * pixels**2), 0, 84, 6, False)
        assert walk_table(figure).reshape(STRIDES, SPAN)[DIAGONAL_FORTH, PAD + 20] == PAD + 20 + stride


def on_grey(image: np.ndarray, solid: np.ndarray) -> bytes:
    """A sprite in the middle of a grey frame."""
    wide = np.full((200, 200, 3), 9, np.uint8)
    first = 100 - len(solid) // 2
    wide[first : first + len(solid), first : first + len(solid)][solid] = image[solid]
    return wide[58:142, 58:142].tobytes()


def checksum(pictures) -> int:
    total = 0
    for each in pictures:
        total = zlib.crc32(on_grey(*each), total)
    return total


def test_sprites_of_every_size():
    agents = (pair for scale in range(40, 1001, 5) for pair in zip(*sprites(scale / 1000), strict=True))
    assert checksum(agents) == 3011986934
    every = [draw_coins_and_exits(((scale / 100, scale / 100),)) for scale in range(10, 201)]
    assert checksum((images[0], solids[0]) for images, solids in every) == 1025842134
    assert checksum((images[i], solids[i]) for images, solids in every for i in (1, 2)) == 3620741150


def test_two_columns_of_a_past_tile_are_grey():
    env = gym.make("Endless-MysteryPath-v0")
    env.reset(seed=1103668575, options={"agent_speed": 7})
    for action in (1, 2, 2, 1, 1, 2, 2, 2, 1, 1, 1, 1, 1, 2, 2, 1, 1):
        frame = env.step(action)[0]
    assert frame[77, :4].tolist() == [[210] * 3] * 3 + [[255] * 3]


def test_any_number_of_spotlights():
    env, rng, total = gym.make("Endless-SearingSpotlights-v0"), np.random.default_rng(0), 0
    env.reset(seed=1000001, options=CROWD)
    for _ in range(301):
        total = zlib.crc32(env.step(rng.integers(0, 3, 2))[0].tobytes(), total)
    assert env.unwrapped.batch.state.num_spots[0] == 304
    assert total == 3712758107


def test_a_crowd_of_spotlights_is_saved():
    envs, twin = (gym.make_vec("Endless-SearingSpotlights-v0", num_envs=4) for _ in range(2))
    envs.reset(seed=0, options=CROWD)
    roll(envs, 250)
    twin.set_state(envs.get_state())
    check_same(roll(envs, 20, seed=1), roll(twin, 20, seed=1))


@pytest.mark.parametrize(("env_id", "steps", "other"), [
    ("MortarMayhem-v0", 275, 93), ("MortarMayhem-Grid-v0", 119, 93), ("MortarMayhemB-v0", 235, 48),
    ("MortarMayhemB-Grid-v0", 79, 48), ("Endless-MortarMayhem-v0", -1, 9), ("MysteryPath-v0", 512, 9),
    ("MysteryPath-Grid-v0", 128, 9), ("Endless-MysteryPath-v0", -1, 9), ("SearingSpotlights-v0", 256, 9),
    ("Endless-SearingSpotlights-v0", -1, 9),
])  # fmt: skip
def test_the_longest_episode(env_id, steps, other):
    """As the original's attribute: of Mortar Mayhem by its options, one step too many where the clue is shown."""
    env = gym.make(env_id).unwrapped
    assert env.max_episode_steps == steps
    options = {"max_steps": 9}
    if other > 9:
        options = {"command_count": [3, 5], "explosion_delay": [2, 7], "explosion_duration": [3, 1]}
        options |= {} if "MayhemB" in env_id else {"command_show_duration": [2, 4], "command_show_delay": [1, 5]}
    env.reset(seed=3, options=options)
    assert env.max_episode_steps == other
    env.reset()
    assert env.max_episode_steps == steps


def test_health_far_below_zero():
    """The bar's red part is as wide as the last 32 bits of its width say, if that is positive."""
    for damage, red in ((1e3, 42), (6e7, 0), (1e8, 0), (1.1e8, 42)):
        env = gym.make("SearingSpotlights-v0")
        env.reset(seed=0, options={"agent_health": 1, "spot_damage": damage, "initial_spawns": 100})
        over = False
        while not over:
            frame, _, over, _, _ = env.step([0, 0])
        assert (frame[0, :42] == (255, 0, 0)).all(axis=-1).sum() == red


@EACH
def test_attributes_of_the_original(env_id):
    env = gym.make(env_id).unwrapped
    space = env.ground_truth_space
    assert env.has_ground_truth_info
    assert env.default_reset_parameters["agent_scale"] == 0.25
    for seed in range(20):
        _, info = env.reset(seed=seed, options={"agent_scale": 0.3})
        assert info["ground_truth"] in space
        assert env.step(env.action_space.sample())[4]["ground_truth"] in space
    assert env.reset_params == env.default_reset_parameters | {"agent_scale": 0.3}
    env.default_reset_parameters["agent_scale"] = env.reset_params["agent_scale"] = 1.0
    assert (env.default_reset_parameters["agent_scale"], env.reset_params["agent_scale"]) == (0.25, 0.3)


# Options that are rarely met together: id, level, how often the player stumbles, options, checksum of what they gave.
EPISODES = [
    (
        "MortarMayhem-v0",
        1,
        0.0,
        {"reward_command_success": 0.0, "reward_episode_success": 0.5, "command_count": [2]},
        2454724946,
    ),
    (
        "MortarMayhem-Grid-v0",
        2,
        0.0,
        {"reward_command_success": -1.0, "reward_episode_success": 0.5, "command_show_delay": [0]},
        2517202689,
    ),
    ("MortarMayhemB-v0", 3, 0.1, {"arena_size": 2, "agent_scale": 0.9, "visual_feedback": False}, 3860761588),
    ("Endless-MortarMayhem-v0", 2, 0.0, {"agent_scale": 0.2, "agent_speed": 5.5}, 4243898724),
    (
        "Endless-MortarMayhem-v0",
        5,
        0.0,
        {"agent_scale": 0.6, "allowed_commands": 4, "initial_command_count": 3},
        1323787362,
    ),
    (
        "MysteryPath-v0",
        6,
        0.1,
        {"show_origin": True, "show_goal": True, "agent_scale": 0.4, "agent_speed": 2.5},
        1776970569,
    ),
    (
        "MysteryPath-Grid-v0",
        7,
        0.2,
        {"show_goal": True, "reward_path_progress": 0.1, "visual_feedback": False},
        1206388327,
    ),
    (
        "Endless-MysteryPath-v0",
        8,
        0.1,
        {"agent_speed": 5.0, "show_background": True, "camera_offset_scale": 2.3},
        627045775,
    ),
    ("Endless-MysteryPath-v0", 9, 0.1, {"agent_speed": 7.0, "show_background": True, "show_stamina": True}, 1921750883),
    ("Endless-MysteryPath-v0", 10, 0.3, {"camera_offset_scale": 0.375}, 3930608191),
    ("Endless-MysteryPath-v0", 11, 0.1, {"camera_offset_scale": 0.6, "agent_speed": 4.0}, 1824402223),
    (
        "Endless-MysteryPath-v0",
        12,
        0.1,
        {"camera_offset_scale": 1.331, "agent_speed": 1.0, "stamina_level": 60},
        2241310818,
    ),
    (
        "Endless-MysteryPath-v0",
        13,
        0.3,
        {"camera_offset_scale": 5.5, "agent_scale": 0.47, "show_stamina": True, "stamina_level": 40},
        2666017023,
    ),
    (
        "Endless-MysteryPath-v0",
        14,
        0.3,
        {"camera_offset_scale": 5.5, "agent_scale": 0.7, "show_stamina": True},
        1595137261,
    ),
    ("SearingSpotlights-v0", 7, 0.0, {"light_threshold": 84, "exit_scale": 0.55}, 2622199732),
    (
        "SearingSpotlights-v0",
        14,
        0.0,
        {"num_coins": [3], "show_last_action": False, "sample_agent_position": False},
        3499235925,
    ),
    (
        "SearingSpotlights-v0",
        15,
        0.5,
        {"black_background": True, "hide_chessboard": True, "initial_spawns": 12, "spot_damage": 0.0},
        3376648562,
    ),
    (
        "SearingSpotlights-v0",
        16,
        0.1,
        {"agent_visible": True, "coins_visible": True, "agent_scale": 0.5, "num_coins": [3]},
        3511682533,
    ),
    (
        "SearingSpotlights-v0",
        17,
        0.1,
        {
            "agent_visible": True,
            "exit_visible": True,
            "agent_scale": 0.5,
            "num_coins": [3],
            "coin_scale": 2.0,
            "exit_scale": 1.8,
        },
        1667542922,
    ),
    (
        "SearingSpotlights-v0",
        18,
        0.1,
        {
            "agent_visible": True,
            "exit_visible": True,
            "coins_visible": True,
            "num_coins": [3],
            "coin_scale": 2.0,
            "exit_scale": 1.8,
        },
        762693620,
    ),
    (
        "SearingSpotlights-v0",
        19,
        0.1,
        {"light_dim_off_duration": 255, "num_coins": [3], "coin_scale": 2.0, "exit_scale": 1.8},
        1580612811,
    ),
    (
        "SearingSpotlights-v0",
        1,
        0.9,
        {
            "spot_min_speed": 0.125,
            "spot_max_speed": 0.125,
            "initial_spawn_interval": 0,
            "spawn_interval_threshold": 3,
            "spot_damage": 0.1,
        },
        357530408,
    ),
    (
        "Endless-SearingSpotlights-v0",
        21,
        0.1,
        {"agent_visible": True, "coins_visible": True, "coin_scale": 1.5, "light_threshold": 84},
        2364779080,
    ),
    (
        "Endless-SearingSpotlights-v0",
        22,
        0.3,
        {"agent_scale": 1.0, "spot_damage": 0.7, "show_last_positive_reward": False},
        3330893509,
    ),
]


@pytest.mark.parametrize(("env_id", "seed", "chance", "options", "expected"), EPISODES)
def test_options_together(env_id, seed, chance, options, expected):
    """Frames, rewards and the end of an episode, or its first 120 steps."""
    env, rng = gym.make(env_id).unwrapped, np.random.default_rng(seed)

    def act(step):
        return stumbling(env.batch, rng, np.array([chance]))[0].tolist() if step < 120 else None

    played = fuzz_original.play(env, seed, options, act, theirs=False)
    seen = [checksums for _, *checksums in played["seen"]]
    found = [seen, np.round(played["rewards"], 6).tolist(), played["over"]]
    assert zlib.crc32(json.dumps(found).encode()) == expected


# ---- 1.0.3 ----


def paid(env_id, seed, options, actions):
    """The steps that were rewarded, with their rewards, and the episode's length."""
    env, rewards, over = gym.make(env_id).unwrapped, [], False
    env.reset(seed=seed, options=options)
    for action in actions:
        if not over:
            _, reward, terminated, truncated, _ = env.step(action(env) if callable(action) else action)
            rewards.append(round(reward, 6))
            over = terminated or truncated
    return {step: reward for step, reward in enumerate(rewards) if reward}, len(rewards)


def test_the_newest_command_has_a_reward_of_its_own():
    actions = [lambda env: player(env.batch)[0]] * 200 + [[0, 0]] * 100
    rewards, length = paid("Endless-MortarMayhem-v0", 4, {"reward_new_command_success": 1.0}, actions)
    assert (list(rewards.values()), length) == ([1.1, 0.1, 1.1, 0.1, 0.1, 1.1, 0.1, 0.1], 226)


@pytest.mark.parametrize(("restores", "longest"), [(False, 27), (True, 28)])
def test_tiles_pay_again_after_a_fall_and_the_origin_may_restore_stamina(restores, longest):
    options = {"reward_path_progress_dense": 0.01, "origin_restores_stamina": restores}
    off_the_path = [1] * 6 + [3] * 4
    rewards, _ = paid("Endless-MysteryPath-v0", 4, options, off_the_path + [1] * 10)
    assert rewards == {1: 0.11, 5: 0.11, 11: 0.01, 15: 0.01, 19: 0.11}
    assert paid("Endless-MysteryPath-v0", 4, options, off_the_path + [0] * 30) == ({1: 0.11, 5: 0.11}, longest)


# ---- benchmarks/fuzz_original.py ----


@EACH
def test_fuzz_draws_valid_options(env_id):
    table = gym.make(env_id).unwrapped.batch.variant.options
    for version, rule in fuzz_original.AS_IN.items():
        lacks, drawn = fuzz_original.LACKS[version], set()
        for seed in range(100):
            options = fuzz_original.sample_options(np.random.default_rng(seed), table, version)
            complete_options(table, options | rule.get(env_id, {}), env_id)
            drawn |= options.keys()
        assert drawn == {option.name for option in table} - lacks


@pytest.mark.parametrize("env_id", IDS)
def test_fuzz_finds_what_differs(env_id):
    """An episode is compared with itself, and then with a copy in which one thing is different."""
    env = gym.make(env_id).unwrapped
    ours = fuzz_original.play(env, 0, {}, fuzz_original.choose_actions(np.random.default_rng(0), env), theirs=False)
    theirs = copy.deepcopy(ours)
    assert fuzz_original.compare(ours, theirs, 1.0) == {}
    theirs["seen"][3][2] += 1
    theirs["seen"][4][0] = [value + 1e-3 for value in theirs["seen"][4][0]]
    theirs["rewards"][1] += 0.1
    theirs["over"] = not theirs["over"]
    found = fuzz_original.compare(ours, theirs, 1.0)
    assert found == {"frame": 3, "ground truth": 4, "reward": 2, "end": len(ours["rewards"])}


@pytest.mark.parametrize("width", [1, 4])
def test_a_circle_that_is_cut_off_has_no_edge_there(width):
    assert np.array_equal(ring(40, 38, 3, 10, width), ring(60, 38, 3, 10, width)[:40, :40])
