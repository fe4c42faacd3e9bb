"""Every id keeps Gymnasium's contract: spaces, seeds, options, autoreset, infos, rendering, clear errors."""

import copy
import json
import pickle
import random
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from players import FAMILY, choices, player, stumbling

import memory_gym_envs
from memory_gym_envs import IDS, MortarMayhem, MysteryPath, SearingSpotlights, options_table

EACH = pytest.mark.parametrize("env_id", IDS)
MORTAR = pytest.mark.parametrize("env_id", MortarMayhem.variants)
SPOTLIGHTS = pytest.mark.parametrize("env_id", SearingSpotlights.variants)
LANES = 4
HASTY = {  # options that end episodes soon; the end of some earns -1
    MortarMayhem: {"explosion_delay": [2], "explosion_duration": (1,), "reward_command_failure": -1},
    MysteryPath: {"max_steps": 9, "reward_step": -1},
    SearingSpotlights: {"agent_health": 1, "initial_spawns": 20, "reward_death": -1},
}


def make(env_id, **arguments):
    return gym.make_vec(env_id, num_envs=LANES, **arguments)


def picture(observation):
    return observation["visual_observation"] if isinstance(observation, dict) else observation


def roll(envs, steps, seed=0):
    """Everything that some steps of random actions return."""
    rng = np.random.default_rng(seed)
    return [envs.step(rng.integers(0, choices(envs), envs.action_space.shape)) for _ in range(steps)]


# ---- Gymnasium's own checks ----


@EACH
def test_check_env(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(env_id).unwrapped)


@EACH
def test_spaces(env_id):
    env, envs = gym.make(env_id), make(env_id)
    four, act_only = "Grid" in env_id or env_id == "Endless-MysteryPath-v0", "B-" in env_id
    assert env.action_space == (gym.spaces.Discrete(4) if four else gym.spaces.MultiDiscrete([3, 3]))
    image = gym.spaces.Box(0, 255, (84, 84, 3), np.uint8)
    if act_only:
        vector = gym.spaces.Box(0.0, 1.0, (180,), np.float32)
        assert env.observation_space == gym.spaces.Dict(visual_observation=image, vector_observation=vector)
    else:
        assert env.observation_space == image
    assert envs.single_action_space == env.action_space
    assert envs.single_observation_space == env.observation_space
    assert envs.reset(seed=0)[0] in envs.observation_space
    for observations, rewards, terminated, truncated, _ in roll(envs, 130):
        assert observations in envs.observation_space
        assert (rewards.dtype, terminated.dtype, truncated.dtype) == (np.float64, np.bool_, np.bool_)
        assert rewards.shape == terminated.shape == truncated.shape == (LANES,)


@EACH
def test_metadata(env_id):
    fps = {"MortarMayhem-Grid-v0": 6, "MortarMayhemB-Grid-v0": 1, "MysteryPath-Grid-v0": 3}.get(env_id, 25)
    env, envs = gym.make(env_id), make(env_id)
    for each in (env, envs):
        assert each.metadata["render_modes"] == ["rgb_array", "debug_rgb_array"]
        assert each.metadata["render_fps"] == fps
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert envs.spec.id == env_id


@EACH
def test_infos_are_those_of_sync_vector_env(env_id):
    """Same keys, masks, dtypes and values as Gymnasium's own same-step autoreset over single environments."""
    ours = make(env_id)
    theirs = SyncVectorEnv([lambda: gym.make(env_id)] * LANES, autoreset_mode=AutoresetMode.SAME_STEP)
    assert data_equivalence(ours.reset(seed=3), theirs.reset(seed=3), exact=True)
    rng, ended = np.random.default_rng(0), 0
    for _ in range(200):
        actions = stumbling(ours, rng, np.array([0.0, 0.3, 0.6, 1.0]))
        left, right = ours.step(actions), theirs.step(actions)
        for ours_part, theirs_part in zip(left[:4], right[:4], strict=True):
            assert data_equivalence(ours_part, theirs_part, exact=True)
        assert set(left[4]) == set(right[4])
        for key in left[4]:
            if key == "final_obs":
                ended += 1
                for a, b in zip(left[4][key], right[4][key], strict=True):
                    assert data_equivalence(a, b, exact=True)
            elif key == "final_info":
                assert set(left[4][key]) == set(right[4][key])
                for name in left[4][key]:
                    assert data_equivalence(left[4][key][name], right[4][key][name], exact=True), name
            else:
                assert data_equivalence(left[4][key], right[4][key], exact=True), key
    assert ended > 2


# ---- seeds, levels, generators ----


@EACH
def test_seeds(env_id):
    envs, more = make(env_id), make(env_id)
    first, _ = envs.reset(seed=5)
    again, _ = more.reset(seed=[5, 6, 7, 8])
    assert data_equivalence(first, again, exact=True)
    assert len({picture(first)[lane].tobytes() for lane in range(LANES)}) > 1
    assert envs.np_random_seed == (5, 6, 7, 8)
    following, _ = envs.reset()
    assert not data_equivalence(first, following, exact=True)
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
    assert data_equivalence(observation, env.reset(seed=4)[0], exact=True)


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


# ---- options ----


@EACH
def test_options_stay_until_the_next_explicit_reset(env_id):
    envs, hasty = make(env_id), HASTY[FAMILY[env_id]]
    envs.reset(seed=0, options=hasty)
    steps = roll(envs, 200)
    ends = [reward for step in steps for reward in step[1][step[2] | step[3]]]
    assert len(ends) > LANES  # several episodes a lane
    assert min(ends) == min(ends[LANES:]) == -1.0
    assert envs.settings == [envs.resolve(hasty)] * LANES
    envs.reset()
    assert envs.settings == [envs.defaults] * LANES
    assert all((step[1] >= 0).all() for step in roll(envs, 200))


@EACH
def test_every_option_in_its_range(env_id):
    """Random settings of all options at once: no exception, nothing outside the spaces."""
    rng = np.random.default_rng(0)
    specs = FAMILY[env_id].variants[env_id].options
    envs = make(env_id)
    for _ in range(25):
        options = {option.name: json.loads(json.dumps(random_value(option, rng))) for option in specs}
        observations, _ = envs.reset(seed=int(rng.integers(1000)), options=options)
        assert observations in envs.observation_space
        for observations, rewards, _, _, infos in roll(envs, 40):  # noqa: B007 - the last is used
            assert np.isfinite(rewards).all()
            # A Searing Spotlights agent may start up to two pixels outside the screen.
            assert ((infos["ground_truth"] >= 0) & (infos["ground_truth"] <= 86 / 84)).all()
        assert observations in envs.observation_space


def random_value(option, rng):
    if option.kind == "bool":
        return bool(rng.integers(2))
    low = -5 if option.low is None else option.low
    high = min(20, low + 10) if option.high is None else option.high
    if option.kind == "float":
        return float(rng.choice([low, high, rng.uniform(low, high)]))
    small = min(high, low + 12)
    shortest = 0 if option.empty else 1
    values = [int(rng.choice([low, rng.integers(low, small + 1)])) for _ in range(rng.integers(shortest, 4))]
    return values if option.kind == "ints" else int(rng.choice([low, high if high <= 9 else small]))


WRONG_ANYWHERE = [
    ({"agent_skale": 1.0}, "'agent_skale'.*'agent_scale'.*a number from 0.04 to 1.0"),
    ({"agent_scale": 0}, "'agent_scale'.*a number from 0.04 to 1.0"),
    ({"agent_scale": float("nan")}, "'agent_scale'"),
    ({"agent_scale": None}, "'agent_scale'"),
    ({"visual_feedback": 1}, "'visual_feedback'.*true or false.*1"),
    ({"visual_feedback": "yes"}, "'visual_feedback'"),
    ({7: 1}, "7"),
    ([("agent_scale", 1)], "options must be a dictionary"),
]
WRONG_MORTAR_MAYHEM = [
    ({"arena_sise": 3}, "'arena_sise'.*'(arena|agent)_"),
    ({"explosion_dellay": [3]}, "'explosion_dellay'.*'explosion_delay'.*a list of integers from 1 to 1000"),
    ({"explosion_delay": 18}, "'explosion_delay'.*a list of integers from 1 to 1000.*18"),
    ({"explosion_delay": []}, "'explosion_delay'"),
    ({"explosion_delay": [0]}, "'explosion_delay'"),
    ({"explosion_duration": [2, 2.5]}, "'explosion_duration'"),
    ({"explosion_duration": ["2"]}, "'explosion_duration'"),
    ({"explosion_duration": "12"}, "'explosion_duration'"),
    ({"allowed_commands": 3}, "'allowed_commands'.*an integer from 4 to 9.*3"),
    ({"allowed_commands": 10}, "'allowed_commands'"),
    ({"allowed_commands": True}, "'allowed_commands'"),
    ({"reward_command_success": float("inf")}, "'reward_command_success'.*a number"),
]
WRONG_MYSTERY_PATH = [
    ({"reward_stepp": 3}, "'reward_stepp'.*'reward_step'.*a number"),
    ({"max_steps": 0}, "'max_steps'.*-1 or an integer of at least 1.*0"),
    ({"max_steps": 1.5}, "'max_steps'"),
    ({"max_steps": [128]}, "'max_steps'"),
    ({"reward_fall_off": float("inf")}, "'reward_fall_off'.*a number"),
    ({"show_origin": 0}, "'show_origin'.*true or false.*0"),
]
WRONG_SPOTLIGHTS = [
    ({"agent_helth": 3}, "'agent_helth'.*'agent_health'.*an integer of at least 1"),
    ({"agent_health": 0}, "'agent_health'.*an integer of at least 1.*0"),
    ({"initial_spawns": 101}, "'initial_spawns'.*an integer from 0 to 100.*101"),
    ({"spot_min_radius": 0.9}, "'spot_min_radius'.*a number from 1 to 42"),
    ({"spot_max_speed": 1.01}, "'spot_max_speed'"),
    ({"spot_damage": -1}, "'spot_damage'"),
    ({"light_threshold": 256}, "'light_threshold'.*an integer from 0 to 255"),
    ({"black_background": 1}, "'black_background'.*true or false"),
    ({"coin_scale": 0.0}, "'coin_scale'.*a number from 0.1 to 2.0"),
    ({"max_steps": 0}, "'max_steps'.*-1 or an integer of at least 1"),
    ({"agent_speed": [3.0]}, "'agent_speed'"),
]
WRONG = {
    MortarMayhem: WRONG_ANYWHERE + WRONG_MORTAR_MAYHEM,
    MysteryPath: WRONG_ANYWHERE + WRONG_MYSTERY_PATH,
    SearingSpotlights: WRONG_ANYWHERE + WRONG_SPOTLIGHTS,
}
WRONG_CASES = [
    pytest.param(env_id, *case, id=f"{env_id}-{str(case[0])[:40]}") for env_id in IDS for case in WRONG[FAMILY[env_id]]
]


@pytest.mark.parametrize(("env_id", "options", "message"), WRONG_CASES)
def test_wrong_option_changes_nothing(env_id, options, message):
    envs, env = make(env_id), gym.make(env_id)
    envs.reset(seed=0)
    env.reset(seed=0)
    before = pickle.dumps(envs)
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
        ("Endless-SearingSpotlights-v0", {"num_coins": [1]}),
        ("Endless-SearingSpotlights-v0", {"use_exit": False}),
        ("Endless-SearingSpotlights-v0", {"spawn_interval": 0}),
        ("Endless-SearingSpotlights-v0", {"steps_per_coin": 0}),
    ],
)
def test_options_of_one_id_alone(env_id, options):
    with pytest.raises(ValueError, match=next(iter(options))):
        gym.make(env_id).reset(options=options)


@EACH
def test_options_table(env_id):
    table = options_table(FAMILY[env_id].variants[env_id].options)
    for option in FAMILY[env_id].variants[env_id].options:
        assert f"| `{option.name}` | `{json.dumps(option.default)}` | {option.allowed} |" in table
        assert option.parse(option.default) == option.default


# ---- wrong arguments and actions ----


@EACH
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"render_mode": "ansi"}, "render_mode"),
        ({"num_levels": -1}, "num_levels"),
        ({"num_levels": 1.5}, "num_levels"),
        ({"start_level": -1}, "start_level"),
        ({"start_level": "a"}, "start_level"),
        ({"num_envs": 0}, "num_envs"),
        ({"num_envs": 2.0}, "num_envs"),
        ({"variant": "Nothing-v9"}, "variant must be one of .*-v0, .*Nothing-v9"),
    ],
)
def test_wrong_arguments(env_id, arguments, message):
    with pytest.raises(ValueError, match=message):
        FAMILY[env_id](**{"variant": env_id, **arguments})


@EACH
@pytest.mark.parametrize("seed", [-1, 1.5, "a", [1, 2], [1, 2, 3, -4], True])
def test_wrong_seeds(env_id, seed):
    envs, env = make(env_id), gym.make(env_id).unwrapped
    envs.reset(seed=0)
    before = pickle.dumps(envs)
    for each in (envs, env):
        with pytest.raises(ValueError, match="seed"):
            each.reset(seed=seed)
    assert pickle.dumps(envs) == before


@EACH
@pytest.mark.parametrize("mask", [[1, 0, 0, 0], np.zeros(4, bool), np.ones(3, bool), None])
def test_wrong_reset_mask(env_id, mask):
    envs = make(env_id)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="reset_mask"):
        envs.reset(options={"reset_mask": mask})
    with pytest.raises(ValueError, match="reset_mask"):
        gym.make(env_id).reset(options={"reset_mask": np.ones(1, bool)})


@EACH
def test_first_reset_holds_every_lane(env_id):
    with pytest.raises(ValueError, match="reset_mask"):
        make(env_id).reset(options={"reset_mask": np.array([True, False, True, True])})


@EACH
def test_wrong_actions(env_id):
    env, envs = gym.make(env_id), make(env_id)
    env.reset(seed=0)
    envs.reset(seed=0)
    right = np.zeros_like(envs.action_space.sample())
    before = pickle.dumps(envs)
    for wrong in (right - 1, right + 4, right.astype(float), right[:-1], right[None], None, "ab", [[1], [1, 2]], True):
        with pytest.raises(ValueError, match="actions must be integers from 0 to"):
            envs.step(wrong)
    for wrong in (right[0] - 1, right[0] + 4, right[0] + 0.5, right[:2], None, [1, [2]], [1, 1, 1]):
        with pytest.raises(ValueError, match="actions must be integers from 0 to"):
            env.step(wrong)
    assert pickle.dumps(envs) == before
    for fine in (right, right.tolist(), right.astype(np.int8), right.astype(np.uint64)):
        envs.step(fine)
    env.step(right[0].tolist())


@EACH
def test_reset_needed(env_id):
    env, envs = gym.make(env_id).unwrapped, make(env_id, render_mode="rgb_array")
    for each in (env, envs):
        with pytest.raises(gym.error.ResetNeeded):
            each.step(each.action_space.sample())
    with pytest.raises(gym.error.ResetNeeded):
        envs.render()
    env.reset(seed=0, options=HASTY[FAMILY[env_id]])
    over = False
    while not over:
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        over = terminated or truncated
    assert set(info) > {"reward", "length", "ground_truth"}
    with pytest.raises(gym.error.ResetNeeded):
        env.step(env.action_space.sample())
    env.reset()
    env.step(env.action_space.sample())


# ---- state ----


@EACH
@pytest.mark.parametrize("clone", [lambda e: pickle.loads(pickle.dumps(e)), copy.deepcopy], ids=["pickle", "deepcopy"])
@pytest.mark.parametrize("num_levels", [None, 5])
def test_copies_have_the_same_future(env_id, clone, num_levels):
    envs = make(env_id, num_levels=num_levels)
    envs.reset(seed=1, options=HASTY[FAMILY[env_id]] | {"agent_scale": 0.3})
    roll(envs, 70)
    twin = clone(envs)
    for left, right in zip(roll(envs, 100, seed=2), roll(twin, 100, seed=2), strict=True):
        for ours, theirs in zip(left[:4], right[:4], strict=True):
            assert data_equivalence(ours, theirs, exact=True)
    assert envs.np_random[0].bit_generator.state == twin.np_random[0].bit_generator.state


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


@EACH
def test_returned_arrays_are_the_callers(env_id):
    """Overwriting everything that was returned changes nothing later."""
    envs, twin = make(env_id), make(env_id)
    results = [envs.reset(seed=0)]
    twin.reset(seed=0)
    for _ in range(3):
        spoil(results.pop())
        for left, right in zip(roll_and_spoil(envs, 60), roll(twin, 60), strict=True):
            for ours, theirs in zip(left[:4], right[:4], strict=True):
                assert data_equivalence(ours, theirs, exact=True)
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


@EACH
def test_a_frame_depends_on_this_episode_alone(env_id):
    """The original shows the last episode's agent until the new one moves."""
    env, fresh = gym.make(env_id), gym.make(env_id)
    still = np.zeros_like(env.action_space.sample())
    env.reset(seed=1, options=HASTY[FAMILY[env_id]])
    over = False
    while not over:
        _, _, terminated, truncated, _ = env.step(still + choices(env.unwrapped.batch) - 1)
        over = terminated or truncated
    frames = [env.reset(seed=8), fresh.reset(seed=8)]
    assert data_equivalence(*frames, exact=True)
    for _ in range(5):
        assert data_equivalence(env.step(still), fresh.step(still), exact=True)


# ---- pictures ----


@EACH
def test_render(env_id):
    env, envs = gym.make(env_id, render_mode="rgb_array"), make(env_id, render_mode="rgb_array")
    observation, _ = env.reset(seed=2)
    assert np.array_equal(env.render(), picture(observation))
    envs.reset(seed=2)
    for step in range(30):
        ((observations, *_),) = roll(envs, 1, seed=step)
        frames = envs.render()
        assert isinstance(frames, tuple)
        assert np.array_equal(np.stack(frames), picture(observations))


@MORTAR
def test_debug_render_circles_the_target(env_id):
    env = gym.make(env_id, render_mode="debug_rgb_array").unwrapped
    observation, info = env.reset(seed=2)
    for _ in range(60):
        frame = env.render()
        assert frame.shape == (336, 336, 3)
        assert frame.dtype == np.uint8
        circle = (frame == (0, 255, 0)).all(axis=-1)
        size = 6 if "Endless" in env_id else 5
        tile = info["ground_truth"] * (size - 1)
        x, y = 168 - 28 * size + 56 * tile + 28  # the target's middle
        rows, columns = circle.nonzero()
        assert abs(rows.mean() + 0.5 - y) < 1
        assert abs(columns.mean() + 0.5 - x) < 1
        assert np.ptp(rows) == np.ptp(columns) == 55
        assert np.array_equal(frame[~circle], picture(observation).repeat(4, 0).repeat(4, 1)[~circle])
        observation, _, over, _, info = env.step(env.action_space.sample())
        if over:
            observation, info = env.reset()


@EACH
def test_no_render_mode_warns(env_id):
    env = gym.make(env_id).unwrapped
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


def test_clue_shows_every_command_and_hides_it_again():
    """Nine symbols, each its own, for show_duration steps; then a blank."""
    env = gym.make("MortarMayhem-v0", disable_env_checker=True).unwrapped
    observation, _ = env.reset(seed=0, options={"command_count": [40], "arena_size": 6})
    state, shapes = env.batch.state, {}
    for step in range(160):
        white = (observation == 255).all(axis=-1)
        assert white.any() == (step % 4 != 3)
        if step % 4 != 3:
            shapes.setdefault(int(state.commands[0, step // 4]), set()).add(white.tobytes())
        observation, *_ = env.step([1, 1])
    assert len(shapes) == 9
    assert all(len(seen) == 1 for seen in shapes.values())
    assert len(set.union(*shapes.values())) == 9


def test_visual_feedback():
    red = (112, 24, 36)
    for feedback in (True, False):
        env = gym.make("MortarMayhemB-v0").unwrapped
        env.reset(seed=1, options={"visual_feedback": feedback})
        seen = 0
        for _ in range(60):
            observation, *_ = env.step(player(env.batch)[0])
            seen += bool((observation["visual_observation"] == red).all(axis=-1).any())
        assert seen == (12 if feedback else 0)  # two fires of six steps


@SPOTLIGHTS
def test_debug_render_lights_everything(env_id):
    """Floor, agent, coin and exit show in the dark; green circles are where the agent's view is lit."""
    env = gym.make(env_id, render_mode="debug_rgb_array").unwrapped
    env.reset(seed=2, options={"spot_damage": 0, "light_dim_off_duration": 0})
    for step in range(60):
        observation, _, _, _, info = env.step([0, 0])
        frame = env.render()
        assert frame.shape == (336, 336, 3)
        assert frame.dtype == np.uint8
        view = observation.repeat(4, 0).repeat(4, 1)
        assert np.array_equal(frame[:16], view[:16])  # the bar
        circle = (frame == (0, 255, 0)).all(axis=-1)
        circle[:16] = False
        seen = (view[16:] > 0).any(axis=-1) & ~circle[16:]
        assert np.array_equal(frame[16:][seen], view[16:][seen])
        floor_shows = (observation[4:] == 255).all(axis=-1).sum() > 20
        assert circle.any() or not floor_shows
        for x, y in (info["ground_truth"] * 336).reshape(-1, 2):
            thing = frame[round(y) - 4 : round(y) + 4, round(x) - 4 : round(x) + 4].reshape(-1, 3)
            floor = {(255, 255, 255), (0, 0, 255), (255, 0, 0), (0, 255, 0)}
            assert {tuple(pixel) for pixel in thing.tolist()} - floor, step


def test_spotlights_show_what_they_light():
    """With a black floor, only the agent, the coin, the exit and the white rims of spotlights can be seen."""
    env = gym.make("SearingSpotlights-v0").unwrapped
    options = {"black_background": True, "spot_damage": 0, "initial_spawns": 12, "light_dim_off_duration": 0}
    env.reset(seed=3, options=options)
    colors = set()
    for _ in range(120):
        observation, *_ = env.step([0, 0])
        colors |= {tuple(pixel) for pixel in observation[4:].reshape(-1, 3).tolist()}
    rim, body, hand, coin, door = (255, 255, 255), (250, 204, 153), (50, 50, 50), (255, 165, 0), (55, 55, 55)
    assert colors <= {(0, 0, 0), rim, body, hand, coin, door}
    assert colors >= {(0, 0, 0), rim, body}


def test_nothing_painted_black_or_white_stays():
    """In the original, black_background and hide_chessboard last for as long as the environment."""
    env, fresh = gym.make("SearingSpotlights-v0"), gym.make("SearingSpotlights-v0")
    for option in ("black_background", "hide_chessboard"):
        first, _ = env.reset(seed=1, options={option: True})
        assert not (first[4:] == (0, 0, 255)).all(axis=-1).any()
        assert np.array_equal(env.reset(seed=2)[0], fresh.reset(seed=2)[0])


@SPOTLIGHTS
def test_visible_in_the_dark(env_id):
    """What the options make visible is drawn over the darkness, every step."""
    names = ["agent_visible", "coins_visible"] + ["exit_visible"] * ("Endless" not in env_id)
    env = gym.make(env_id).unwrapped
    env.reset(seed=4, options={**dict.fromkeys(names, True), "initial_spawns": 0})
    for _ in range(30):
        observation, _, over, _, _ = env.step([0, 0])
        colors = {tuple(pixel) for pixel in observation[4:].reshape(-1, 3).tolist()}
    assert not over
    assert colors >= {(0, 0, 0), (250, 204, 153), (255, 165, 0)}
    assert ((55, 55, 55) in colors) == ("exit_visible" in names)


def test_needs_neither_pygame_nor_torch():
    """The package imports NumPy and Gymnasium only."""
    code = "import sys, memory_gym_envs; print([m for m in ('pygame', 'torch', 'memory_gym') if m in sys.modules])"
    folder = Path(memory_gym_envs.__file__).parents[1]
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=folder)
    assert result.stdout.strip() == "[]"


def test_ids():
    assert set(memory_gym_envs.IDS) >= {
        "MortarMayhem-v0",
        "MortarMayhem-Grid-v0",
        "MortarMayhemB-v0",
        "MortarMayhemB-Grid-v0",
        "Endless-MortarMayhem-v0",
        "MysteryPath-v0",
        "MysteryPath-Grid-v0",
        "Endless-MysteryPath-v0",
        "SearingSpotlights-v0",
        "Endless-SearingSpotlights-v0",
    }
    assert all(env_id in gym.registry for env_id in memory_gym_envs.IDS)
