"""Searing Spotlights: the scripted player's return, how episodes end, and the original's quirks one by one."""

import copy
import math

import gymnasium as gym
import numpy as np
import pytest

from memory_gym_envs.character import BODY, HAND_OUTLINE, PAD
from memory_gym_envs.entries import vector_slices
from memory_gym_envs.players import player
from memory_gym_envs.searing_spotlights import VARIANTS
from memory_gym_envs.searing_spotlights.state import AGENT, COIN, EXIT, GONE, RADIUS, REACH, SIGHT, SPEED, START, TIME

FINITE, ENDLESS = "SearingSpotlights-v0", "Endless-SearingSpotlights-v0"
SAFE = {"spot_damage": 0}
DARK = {**SAFE, "initial_spawns": 0, "spawn_interval": 10**9, "light_dim_off_duration": 0}  # from the start to the end
DARK_FINITE = {**SAFE, "initial_spawns": 0, "num_spawns": 0, "light_dim_off_duration": 0}
STUCK = {"spot_min_speed": 0.0, "spot_max_speed": 0.0}  # spotlights stay where they start


def play_out(env, act, seed, options=None):
    """One episode of a single environment: rewards, the last step's flags and its info."""
    env.reset(seed=seed, options=options)
    rewards, terminated, truncated = [], False, False
    while not (terminated or truncated):
        _, reward, terminated, truncated, info = env.step(act())
        rewards.append(reward)
    return rewards, terminated, truncated, info


def make(env_id, **arguments):
    env = gym.make(env_id, **arguments).unwrapped
    return env, lambda: player(env.batch)[0]


def still():
    return [0, 0]


# ---- the task ----


@pytest.mark.parametrize("coins", [0, 1, 2, 5])
@pytest.mark.parametrize("seed", range(4))
def test_player_collects_every_coin_and_leaves(coins, seed):
    env, act = make(FINITE)
    pays = {"reward_coin": 0.5, "reward_exit": -3.0} if seed % 2 else {}
    rewards, terminated, truncated, info = play_out(env, act, seed, {**SAFE, "num_coins": [coins], **pays})
    coin, leaving = pays.values() or (0.25, 1.0)
    assert (terminated, truncated) == (True, False)
    assert [r for r in rewards if r] == [coin] * coins + [leaving]
    assert info["reward"] == coin * coins + leaving
    assert info["length"] == len(rewards)
    assert (info["success"], info["coins_collected"], info["agent_health"]) == (1, 1.0, 1.0)


COIN_REACH, EXIT_REACH = 6 + 3, 6 + 5  # the agent's radius and the thing's, by default


def way_to(thing, agent, reach):
    """In how many steps the player, walking straight, gets within reach of a thing, and where it is then.

    A step is 3 pixels, or 2 along both axes. The agent's centre stays 6 pixels inside the screen and off the bar.
    """
    for step in range(1, 100):
        away = thing - agent
        walk = np.sign(away) * (np.abs(away) > 1)
        agent = np.clip(agent + walk * (2 if walk.all() else 3), (6, 4 + 6), (84 - 6, 84 - 6))
        if ((thing - agent) ** 2).sum() <= reach**2:
            return step, agent
    raise AssertionError("never got there")


@pytest.mark.parametrize("seed", range(8))
def test_player_needs_as_many_steps_as_the_way_takes(seed):
    env, act = make(FINITE)
    agent, coin, exit_ = np.round(env.reset(seed=seed)[1]["ground_truth"].reshape(3, 2) * 84)
    rewards, _, _, info = play_out(env, act, seed, SAFE)
    to_coin, agent = way_to(coin, agent, COIN_REACH)
    to_exit, _ = way_to(exit_, agent, EXIT_REACH)
    assert np.flatnonzero(rewards).tolist() == [to_coin - 1, to_coin + to_exit - 1]
    assert info["length"] == to_coin + to_exit


@pytest.mark.parametrize("seed", range(4))
def test_endless_player_earns_a_coin_for_each_way(seed):
    env, act = make(ENDLESS)
    _, info = env.reset(seed=seed, options={**SAFE, "max_steps": 500})
    agent, coin = np.round(info["ground_truth"].reshape(2, 2) * 84)
    coins, truncated = 0, False
    while not truncated:
        steps, agent = way_to(coin, agent, COIN_REACH)
        for step in range(1, steps + 1):
            _, reward, terminated, truncated, info = env.step(act())
            assert not terminated
            assert reward == (0.25 if step == steps else 0.0)
            coins += step == steps
            if truncated:
                break
        coin = np.round(info["ground_truth"][2:] * 84)
    assert info["length"] == 500
    assert info["coins_collected"] == coins > 10
    assert info["reward"] == 0.25 * coins


@pytest.mark.parametrize("coins", [1, 3])
def test_without_an_exit_the_last_coin_ends_the_episode(coins):
    env, act = make(FINITE)
    rewards, terminated, _, info = play_out(env, act, 1, {**SAFE, "num_coins": [coins], "use_exit": False})
    assert terminated
    assert [r for r in rewards if r] == [0.25] * coins
    assert rewards[-1] == 0.25
    assert info["success"] == 1
    assert not info["ground_truth"][2:].any()


@pytest.mark.parametrize("coins", [[], [0]])
def test_with_nothing_to_do_time_runs_out(coins):
    env, act = make(FINITE)
    options = {**SAFE, "num_coins": coins, "use_exit": False, "max_steps": 40, "reward_max_steps": -1}
    rewards, terminated, truncated, info = play_out(env, act, 1, options)
    assert (len(rewards), terminated, truncated) == (40, False, True)
    assert not any(rewards)  # reward_max_steps is ignored, as in the original
    assert (info["success"], info["coins_collected"]) == (0, 1.0)


def test_default_player_mostly_wins():
    """Walking straight, without a look at the spotlights, succeeds in most levels and never earns anything else."""
    envs = gym.make_vec(FINITE, num_envs=8)
    envs.reset(seed=0)
    earned = []
    for _ in range(300):
        *_, infos = envs.step(player(envs))
        for lane in np.flatnonzero(infos.get("_final_info", ())):
            final = {key: values[lane] for key, values in infos["final_info"].items()}
            earned.append(final["reward"])
            assert final["reward"] in (0.0, 0.25, 1.25)
            assert final["success"] == (final["reward"] == 1.25 and final["agent_health"] > 0)
    assert np.mean(np.array(earned) == 1.25) > 0.7


def test_endless_player_collects_until_time_runs_out():
    env, act = make(ENDLESS)
    env.reset(seed=5, options={**SAFE, "max_steps": 800})
    total, places, truncated = 0.0, set(), False
    while not truncated:
        places.add(tuple(env.batch.state.bodies[:, 0, COIN].tolist()))
        _, reward, terminated, truncated, info = env.step(act())
        assert not terminated
        assert reward in (0.0, 0.25)
        total += reward
    assert info["length"] == 800
    assert info["coins_collected"] == total / 0.25 >= len(places) - 1 > 15
    assert info["reward"] == total


def test_endless_coin_has_a_deadline():
    env, _ = make(ENDLESS)
    options = {**SAFE, "steps_per_coin": 30}
    # Away from the coin: an agent in a corner.
    _, terminated, truncated, info = play_out(env, lambda: [1, 1], 3, options)
    assert (terminated, truncated) == (True, False)
    assert info["length"] % 30 == 0 or info["coins_collected"]
    assert info["agent_health"] == 1.0


def test_endless_without_coins():
    env, act = make(ENDLESS)
    options = {**SAFE, "coin_enabled": False, "max_steps": 300}
    rewards, terminated, truncated, info = play_out(env, act, 3, options)
    assert (len(rewards), terminated, truncated) == (300, False, True)
    assert not any(rewards)
    assert not info["ground_truth"][2:].any()


@pytest.mark.parametrize("env_id", [FINITE, ENDLESS])
def test_time_limit_truncates_and_death_at_that_step_terminates(env_id):
    env, _ = make(env_id)
    options = {"initial_spawns": 30} | ({"steps_per_coin": -1} if env_id == ENDLESS else {})
    died = len(play_out(env, still, 0, options)[0])
    for limit in (died - 1, died, died + 1):
        rewards, terminated, truncated, _ = play_out(env, still, 0, {**options, "max_steps": limit})
        assert len(rewards) == min(limit, died)
        assert (terminated, truncated) == ((False, True) if limit < died else (True, False))


# ---- health and rewards ----


@pytest.mark.parametrize("env_id", [FINITE, ENDLESS])
def test_light_costs_health_and_pays_the_step(env_id):
    env, _ = make(env_id)
    options = {"initial_spawns": 20, "reward_inside_spotlight": -0.5, "reward_outside_spotlight": 0.125}
    options |= {"reward_death": -4.0, "agent_health": 3, "spot_damage": 2.0}
    if env_id == ENDLESS:
        options["steps_per_coin"] = -1
    rewards, terminated, _, info = play_out(env, still, 2, options)
    inside = [r for r in rewards if r < 0]
    assert terminated
    assert inside == [-0.5, -4.5]
    assert rewards[-1] == -4.5
    assert set(rewards[:-1]) <= {-0.5, 0.125}
    assert info["agent_health"] == pytest.approx(-1 / 3)
    assert info["reward"] == pytest.approx(sum(rewards))


def test_dying_at_the_exit_pays_but_is_no_success():
    env, act = make(FINITE)
    env.reset(seed=0, options={"initial_spawns": 1, "num_spawns": 0, "reward_death": -0.5})
    env.batch.state.spots[REACH, 0, 0] = -1.0  # a spotlight that does no harm
    reward = 0.0
    while reward < 1.0:
        earlier = copy.deepcopy(env)
        _, reward, _, _, info = env.step(act())
    assert (info["success"], info["is_success"]) == (1, True)
    # The same step again, but with the last health lost in it.
    s = earlier.batch.state
    s.spots[[REACH, SIGHT], 0, 0], s.health[0] = 1e6, 1.0
    _, reward, terminated, _, info = earlier.step(player(earlier.batch)[0])
    assert terminated
    assert (reward, info["success"], info["coins_collected"], info["agent_health"]) == (0.5, 0, 1.0, 0.0)
    assert info["is_success"] is False


def test_bar_shows_the_action_and_the_reward_before_the_last():
    colors = [(120, 120, 120), (116, 1, 113), (255, 94, 14)]
    env, act = make(FINITE)
    env.reset(seed=0, options={**SAFE, "num_coins": [3]})
    history, gains = [[0, 0]], [False]
    for _ in range(60):
        action = act().tolist()
        observation, reward, over, _, _ = env.step(action)
        before_last, gained = history[-1], gains[-1]
        assert tuple(observation[1, 50]) == colors[before_last[0]]
        assert tuple(observation[1, 80]) == colors[before_last[1]]
        assert tuple(observation[1, 60]) == ((255, 255, 0) if gained else (50, 50, 50))
        history.append(action)
        gains.append(reward > 0)
        if over:
            break
    assert over
    assert sum(gains) == 4


@pytest.mark.parametrize("env_id", [FINITE, ENDLESS])
@pytest.mark.parametrize("action_shown", [False, True])
@pytest.mark.parametrize("reward_shown", [False, True])
def test_bar_hides_what_it_is_told_to(env_id, action_shown, reward_shown):
    env, act = make(env_id)
    options = {"show_last_action": action_shown, "show_last_positive_reward": reward_shown, **SAFE}
    env.reset(seed=0, options=options)
    colors = set()
    for _ in range(15):
        observation, *_ = env.step(act())
        colors |= {tuple(pixel) for pixel in observation[1, 42:].tolist()}
    ground = (0, 0, 0) if env_id == ENDLESS else (50, 50, 50)
    assert ((120, 120, 120) in colors) == action_shown
    if not action_shown:
        assert colors <= {ground, (50, 50, 50), (255, 255, 0)}


# ---- spotlights ----


def test_wait_is_always_the_first_interval():
    """30 + 10 steps, whatever the decay, 30 times; the endless task every 50 steps for ever."""
    for env_id, interval, first in ((FINITE, 40, 4), (ENDLESS, 50, 3)):
        env, _ = make(env_id)
        options = {**SAFE, "spot_min_speed": 0.0, "spot_max_speed": 0.0, "max_steps": 1000}
        options |= {"spawn_interval_decay": 0.5} if env_id == FINITE else {"steps_per_coin": -1}
        env.reset(seed=0, options=options)
        counts = [(env.step([0, 0]), int(env.batch.state.num_spots[0]))[1] for _ in range(400)]
        assert counts == [first + (step + 1) // interval for step in range(400)]


def test_num_spawns_runs_out():
    env, _ = make(FINITE)
    slow = {"spot_min_speed": 0.0, "spot_max_speed": 0.0}
    options = {**SAFE, **slow, "num_spawns": 3, "initial_spawns": 0, "initial_spawn_interval": 0}
    env.reset(seed=0, options={**options, "spawn_interval_threshold": 0})
    counts = [(env.step([0, 0]), int(env.batch.state.num_spots[0]))[1] for _ in range(10)]
    assert counts == [1, 2, 3] + [3] * 7


@pytest.mark.parametrize("env_id", [FINITE, ENDLESS])
def test_spotlights_that_never_leave_pile_up(env_id):
    env, _ = make(env_id)
    fast = {"spawn_interval": 1} if env_id == ENDLESS else {"initial_spawn_interval": 0, "spawn_interval_threshold": 0}
    never = {"max_steps": -1, "steps_per_coin": -1} if env_id == ENDLESS else {"max_steps": -1, "num_spawns": 10**9}
    env.reset(seed=0, options={**SAFE, **fast, **never, "spot_min_speed": 0.0, "spot_max_speed": 0.0})
    s = env.batch.state
    first = int(s.num_spots[0])
    counts = [(env.step([0, 0]), int(s.num_spots[0]))[1] for _ in range(500)]
    assert counts == [first + 1 + step for step in range(500)]
    assert s.spots.shape[2] < 600  # there is no room for many more, as every step reads all of it


def test_spotlight_behind_a_removed_one_pauses():
    env, _ = make(FINITE)
    env.reset(seed=0, options={**SAFE, "initial_spawns": 4, "num_spawns": 0})
    env.step([0, 0])
    s = env.batch.state
    s.spots[TIME, 0, :4] = [1.0, 0.25, 1.0, 0.5]
    env.step([0, 0])
    # The second skips a step behind the first, and the fourth behind the third.
    assert s.num_spots[0] == 2
    assert s.spots[TIME, 0, :2].tolist() == [0.25, 0.5]
    assert not env.batch.state.spot_place[:, 0].any()
    env.step([0, 0])
    assert (s.spots[TIME, 0, :2] > [0.25, 0.5]).all()
    assert env.batch.state.spot_place[:, 0, :2].all()


@pytest.mark.parametrize("low_high", [("spot_min_radius", "spot_max_radius"), ("spot_min_speed", "spot_max_speed")])
def test_smallest_above_largest_replaces_it(low_high):
    low, high = low_high
    value = 20.0 if "radius" in low else 0.02
    env, _ = make(FINITE)
    env.reset(seed=0, options={low: value, high: value / 2, "initial_spawns": 10})
    drawn = env.batch.state.spots[RADIUS if "radius" in low else SPEED, 0, :10]
    assert (drawn == value).all()


def test_dimming():
    """Light until the first step, black after the seventh, by the original's 42 of 255 a step."""
    env, _ = make(FINITE)
    observation, _ = env.reset(seed=0, options={"initial_spawns": 0, "num_spawns": 0})
    white = []
    for _ in range(10):
        white.append(int(observation[4:].max()))
        observation, *_ = env.step([0, 0])
    assert white == [255, 213, 171, 129, 87, 45, 3, 0, 0, 0]
    for threshold, last in ((83, 84), (84, 126), (100, 126)):  # the first step beyond the threshold
        env.reset(seed=0, options={"light_threshold": threshold, "initial_spawns": 0})
        for _ in range(10):
            observation, *_ = env.step([0, 0])
        assert observation[4:].max() == 255 - last


@pytest.mark.parametrize(("scale", "radius"), [(0.5, 5), (0.55, 5.5), (1.25, 12.5)])
def test_reach_of_the_exit(scale, radius):
    """The agent's 6 pixels and ten times the scale, halves too; at its edge, and just beyond."""
    env, _ = make(FINITE)
    env.reset(seed=0, options={**SAFE, "exit_scale": scale, "num_coins": []})
    env.step([0, 0])  # opens the exit
    reaches = 0
    for x, y in np.ndindex(20, 20):
        near = x**2 + y**2 <= (6 + radius) ** 2
        if abs(np.hypot(x, y) - 6 - radius) > 1:
            continue
        earlier = copy.deepcopy(env)
        s = earlier.batch.state
        s.bodies[:, 0, EXIT] = s.pos[0] - PAD + (x, -y)
        _, reward, terminated, _, _ = earlier.step([0, 0])
        assert (reward, terminated) == (float(near), near), (x, y)
        reaches += near
    assert reaches > 5


@pytest.mark.parametrize("exit_visible", [False, True])
@pytest.mark.parametrize("coins_visible", [False, True])
def test_an_agent_that_shows_in_the_dark_is_below_the_bar_with_coins_and_exit_alone(coins_visible, exit_visible):
    """As in the original, where it is drawn with the bar's surface unless both others are visible."""
    env, _ = make(FINITE)
    shown = {"agent_visible": True, "coins_visible": coins_visible, "exit_visible": exit_visible}
    env.reset(seed=0, options={**DARK_FINITE, **shown, "agent_scale": 0.5, "num_coins": [0]})
    s = env.batch.state
    s.pos[0] = PAD + 30, PAD + 4 + 12  # as far up as it may walk: its hands reach into the bar
    frame, *_ = env.step([0, 1])
    hands = (frame[:4, 15:45] == HAND_OUTLINE).all(axis=-1).any()
    assert (frame[4:] == BODY).all(axis=-1).any()
    assert hands == (not (coins_visible and exit_visible))


# ---- levels ----


def test_things_keep_their_distance():
    env, _ = make(FINITE)
    for seed in range(200):
        env.reset(seed=seed, options={"num_coins": [3]})
        bodies = env.batch.state.bodies[:, 0]
        assert (bodies[:, EXIT:] >= 7).all()
        assert (bodies[:, EXIT:] <= 77).all()
        assert (bodies[:, AGENT] >= 2).all()
        assert (bodies[:, AGENT] <= 86).all()
        for coin in range(COIN, COIN + 3):
            # 28 pixels before both are moved by up to 1 pixel apart and into the margin, up to 7 on both axes.
            assert math.dist(bodies[:, AGENT], bodies[:, coin]) > 28 - 1.5 - 10


@pytest.mark.parametrize("coins", [4, 20])
def test_more_coins_than_there_is_room_for(coins):
    env, act = make(FINITE)
    for seed in range(3):
        rewards, _, _, info = play_out(env, act, seed, {**SAFE, "num_coins": [coins], "max_steps": 2000})
        assert info["coins_collected"] == 1.0
        assert sum(rewards) == 0.25 * coins + 1


def test_ground_truth_is_where_things_are():
    env, act = make(FINITE)
    _, info = env.reset(seed=0, options={**SAFE, "num_coins": [2]})
    over = False
    while not over:
        bodies = env.batch.state.bodies[:, 0]
        coins = bodies[:, COIN:][:, bodies[0, COIN:] != GONE]
        first = coins[:, 0] if coins.size else np.zeros(2)
        expected = np.concatenate([bodies[:, AGENT], first, bodies[:, EXIT]]) / 84
        np.testing.assert_allclose(info["ground_truth"], expected)
        _, _, over, _, info = env.step(act())


# ---- options that the original lacks ----


def coin_and_gain(observation):
    """Whether a coin is visible, and whether the bar shows a reward."""
    if observation.ndim == 1:
        at = vector_slices(VARIANTS[ENDLESS].entries)
        return bool(observation[at["coin"]][0]), bool(observation[at["rewarded"]][0])
    orange, yellow = ((observation == color).all(axis=-1) for color in ((255, 165, 0), (255, 255, 0)))
    return bool(orange[4:].any()), bool(yellow[:4].any())


@pytest.mark.parametrize("obs_type", ["pixels", "vector"])
@pytest.mark.parametrize("feedback", [True, False])
def test_coin_feedback(feedback, obs_type):
    """In the dark, the first coin is visible in 6 frames, and each later one in 5 or none; so is its reward."""
    env, act = make(ENDLESS, obs_type=obs_type)
    for seed in (4, 5):  # the second episode starts like the first one
        observation, _ = env.reset(seed=seed, options={**DARK, "coin_feedback": feedback})
        seen, rewards = [coin_and_gain(observation)], [0.0]
        for _ in range(150):
            observation, reward, terminated, _, _ = env.step(act())
            assert not terminated
            seen.append(coin_and_gain(observation))
            rewards.append(reward)
        taken = np.flatnonzero(rewards)
        assert len(taken) > 4
        assert taken[0] > 6
        coins = {*range(6)} | {step + frame for step in taken for frame in range(5) if feedback}
        gains = {step + 1 for step in taken if feedback}  # the bar is a step late
        assert {step for step, (coin, _) in enumerate(seen) if coin} == {step for step in coins if step <= 150}
        assert {step for step, (_, gain) in enumerate(seen) if gain} == {step for step in gains if step <= 150}


@pytest.mark.parametrize("obs_type", ["pixels", "vector"])
def test_light_shows_a_coin_that_appeared_in_the_dark(obs_type):
    env, act = make(ENDLESS, obs_type=obs_type)
    options = {**DARK, **STUCK, "coin_feedback": False, "initial_spawns": 1, "spot_min_radius": 9, "spot_max_radius": 9}
    env.reset(seed=3, options=options)
    s, reward = env.batch.state, 0.0
    while not reward:
        _, reward, *_ = env.step(act())
    assert not coin_and_gain(env.step([0, 0])[0])[0]
    s.spots[START, 0, 0] = s.bodies[:, 0, COIN]
    assert coin_and_gain(env.step([0, 0])[0])[0]


@pytest.mark.parametrize("obs_type", ["pixels", "vector"])
def test_what_else_shows_coins_and_rewards_is_no_coin_feedback(obs_type):
    """Coins that are visible in the dark stay so, and the bar shows what else the step paid."""
    env, act = make(ENDLESS, obs_type=obs_type)
    options = {**DARK, "coin_feedback": False, "coins_visible": True, "reward_outside_spotlight": 0.5}
    env.reset(seed=3, options=options)
    steps = [env.step(act()) for _ in range(100)]
    assert {reward for _, reward, *_ in steps} == {0.5, 0.75}
    assert [coin_and_gain(observation) for observation, *_ in steps] == [(True, False)] + [(True, True)] * 99


def test_coin_feedback_changes_no_rule():
    envs, twin = (gym.make_vec(ENDLESS, num_envs=4) for _ in range(2))
    envs.reset(seed=0, options={**SAFE, "coin_feedback": False})
    twin.reset(seed=0, options=SAFE)
    total = 0.0
    for _ in range(150):
        ours, theirs = envs.step(player(envs)), twin.step(player(twin))
        total += ours[1].sum()
        for left, right in zip(ours[1:4], theirs[1:4], strict=True):
            np.testing.assert_array_equal(left, right)
        np.testing.assert_array_equal(ours[4]["ground_truth"], theirs[4]["ground_truth"])
    assert total > 5
    assert generators(envs) == generators(twin)


def generators(envs):
    return [rng.bit_generator.state for rng in envs.np_random]


def every(env_id, interval):
    """The options for spotlights that stay, and come with this interval, for ever."""
    finite = {"initial_spawn_interval": interval - 1, "spawn_interval_threshold": 1, "num_spawns": 10**9}
    return {**SAFE, **STUCK, "initial_spawns": 0, "max_steps": -1} | (
        finite if env_id == FINITE else {"spawn_interval": interval, "steps_per_coin": -1}
    )


def spawns(env, steps):
    """The steps since the reset or the spotlight before, for each that comes in so many steps."""
    counts = [0] + [(env.step([0, 0]), int(env.batch.state.num_spots[0]))[1] for _ in range(steps)]
    return np.diff([0, *(np.flatnonzero(np.diff(counts)) + 1)]).tolist()


@pytest.mark.parametrize("env_id", [FINITE, ENDLESS])
def test_spawn_delay(env_id):
    """It is added to each interval, the first one too."""
    env, _ = make(env_id)
    firsts, every_wait = set(), set()
    for seed in range(12):
        env.reset(seed=seed, options={**every(env_id, 5), "spawn_delay": [0, 3, 7]})
        waits = spawns(env, 100)
        assert len({*waits}) > 1
        assert sum(waits) > 100 - 12
        firsts.add(waits[0])
        every_wait |= {*waits}
    assert firsts == every_wait == {5, 8, 12}
    env.reset(seed=0, options={**every(env_id, 5), "spawn_delay": [6]})
    assert spawns(env, 115) == [11] * 10
    env.reset(seed=0, options=every(env_id, 5))
    assert spawns(env, 115) == [5] * 23


@pytest.mark.parametrize("env_id", [FINITE, ENDLESS])
def test_one_spawn_delay_takes_no_draw(env_id):
    """Levels and spotlights are those of the default, and so is the level of several, as it is drawn before."""
    batches = []
    for delays in ([0], [4], [4, 4]):
        env, _ = make(env_id)
        env.reset(seed=5, options={**every(env_id, 10), "initial_spawns": 2, "spawn_delay": delays})
        batches.append(env.batch)
    default, one, several = batches
    for other in (one, several):
        np.testing.assert_array_equal(other.state.bodies, default.state.bodies)
        np.testing.assert_array_equal(other.state.spots, default.state.spots)
    assert generators(one) == generators(default) != generators(several)
    for batch, interval in ((default, 10), (one, 14)):
        for _ in range(3 * interval):
            batch.step(np.zeros((1, 2), np.int64))
    np.testing.assert_array_equal(one.state.spots[:, :, :5], default.state.spots[:, :, :5])
    assert generators(one) == generators(default)
