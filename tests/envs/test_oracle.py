"""A scripted player earns exactly the known return, in exactly the known number of steps, in every id."""

import copy
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from helpers import FAMILY

import memory_gym_envs
from memory_gym_envs import MortarMayhem, MysteryPath
from memory_gym_envs.mystery_path.state import EAST, NORTH, SOUTH, WEST
from memory_gym_envs.players import player

# Table 4.4, but for the act tasks: the thesis' formula says 18 to 234 and 6 to 78 there. The original itself, whose
# first command has one step more than the others, needs one step more; behind a clue the reset makes up for it.
BOUNDS = {
    "MortarMayhem-v0": (58, 274),
    "MortarMayhem-Grid-v0": (46, 118),
    "MortarMayhemB-v0": (19, 235),
    "MortarMayhemB-Grid-v0": (7, 79),
}
LANES = 8


def play_out(env, act, seed, options=None):
    """One episode of a single environment: rewards, the last step's flags and its info."""
    env.reset(seed=seed, options=options)
    rewards, terminated, truncated = [], False, False
    while not (terminated or truncated):
        _, reward, terminated, truncated, info = env.step(act())
        rewards.append(reward)
    return rewards, terminated, truncated, info


@pytest.mark.parametrize("env_id", BOUNDS)
@pytest.mark.parametrize("seed", range(4))
def test_player_completes_every_command(env_id, seed):
    env = gym.make(env_id).unwrapped
    options = {"reward_episode_success": 0.5}
    rewards, terminated, truncated, info = play_out(env, lambda: player(env.batch)[0], seed, options)
    assert (terminated, truncated) == (True, False)
    assert len(rewards) == info["length"] == BOUNDS[env_id][1]
    assert [r for r in rewards if r] == pytest.approx([0.1] * 9 + [0.6])
    assert info["reward"] == pytest.approx(1.5)
    assert info["success"] == 1
    assert info["commands_completed"] == 1.0


def test_a_failure_at_the_step_limit_is_a_failure():
    """Terminated only, as in the other families; one step earlier, the limit comes first."""
    env = gym.make("Endless-MortarMayhem-v0").unwrapped
    idle = np.zeros(env.action_space.shape, np.int64)
    rewards, *ends, _ = play_out(env, lambda: idle, 3)
    assert ends == [True, False]
    for limit, wanted in ((len(rewards), [True, False]), (len(rewards) - 1, [False, True])):
        found, *ends, _ = play_out(env, lambda: idle, 3, {"max_steps": limit})
        assert (len(found), ends) == (limit, wanted)


@pytest.mark.parametrize("env_id", BOUNDS)
def test_idle_agent_fails_at_the_first_command_that_moves(env_id):
    env = gym.make(env_id).unwrapped
    idle = np.zeros(env.action_space.shape, np.int64)
    lengths = [len(play_out(env, lambda: idle, seed)[0]) for seed in range(60)]
    shortest, longest = BOUNDS[env_id]
    assert min(lengths) == shortest
    period = (longest - shortest) // 9
    assert all(shortest <= n <= longest and (n - shortest) % period == 0 for n in lengths)
    # The first command is "stay" for some levels and moves the target for most.
    assert np.mean(np.array(lengths) == shortest) > 0.5


@pytest.mark.parametrize("env_id", BOUNDS)
def test_failure_pays_only_the_failure_reward(env_id):
    env = gym.make(env_id).unwrapped
    idle = np.zeros(env.action_space.shape, np.int64)
    options = {"reward_command_failure": -0.5, "reward_command_success": 1.0, "command_count": [5]}
    for seed in range(10):
        rewards, _, _, info = play_out(env, lambda: idle, seed, options)
        done = sum(r == 1.0 for r in rewards)
        if done == 5:
            continue
        assert rewards[-1] == -0.5
        assert sum(rewards) == info["reward"] == done - 0.5
        # A failure at the very last command counts as success, as in the original.
        assert info["commands_completed"] == (1.0 if done == 4 else done / 5)
        assert info["carried_out"] == done / 5
        assert info["success"] == (done == 4)
        assert info["is_success"] is False


@pytest.mark.parametrize("env_id", BOUNDS)
def test_failing_at_the_last_command(env_id):
    """It counts as success, as in the original, but the episode's reward is overwritten by the failure's."""
    env = gym.make(env_id).unwrapped
    idle = np.zeros(env.action_space.shape, np.int64)
    options = {"command_count": [1], "reward_command_failure": -0.5, "reward_episode_success": 3.0}
    earned = set()
    for seed in range(20):
        rewards, _, _, info = play_out(env, lambda: idle, seed, options)
        assert (info["success"], info["commands_completed"]) == (1, 1.0)
        assert info["carried_out"] == info["is_success"] == (rewards[-1] == 3.1)
        assert not any(rewards[:-1])
        earned.add(rewards[-1])
    assert earned == {-0.5, 3.1}  # 3.1 where the command was to stay


@pytest.mark.parametrize("env_id", BOUNDS)
def test_commands_completed_before_a_time_limit(env_id):
    """As many as were paid for: none while they are shown, and all that were checked, also while the fire burns."""
    found = set()
    envs = gym.make_vec(env_id, num_envs=2)
    envs.reset(seed=3)
    for step in range(1, BOUNDS[env_id][1]):
        actions = player(envs)
        if step % (4 if "Grid" in env_id else 12) != 1:  # half of a command's time
            envs.step(actions)
            continue
        limited = copy.deepcopy(envs)
        limited.max_episode_steps = step
        envs.step(actions)
        _, _, terminated, truncated, infos = limited.step(actions)
        assert truncated.all()
        assert not terminated.any()
        final = infos["final_info"]
        assert final["commands_completed"] == pytest.approx(final["reward"])  # 0.1 for each of ten
        assert np.array_equal(final["carried_out"], final["commands_completed"])
        found |= {*final["commands_completed"].round(1).tolist()}
    assert found == {i / 10 for i in range(10)}


@pytest.mark.parametrize("env_id", BOUNDS)
def test_walking_into_the_fire(env_id):
    """The command that was already checked no longer counts, and the step pays the failure reward."""
    env = gym.make(env_id).unwrapped
    options = {"reward_command_failure": -0.5, "explosion_duration": [40]}
    env.reset(seed=3, options=options)
    while not env.batch.state.burning[0]:
        _, _, terminated, _, _ = env.step(player(env.batch)[0])
    assert not terminated
    x, y = (env.batch.state.target_corner[0] + 7 - env.batch.state.pos[0]).tolist()
    assert abs(x) <= 2
    assert abs(y) <= 2
    rng = np.random.default_rng(0)
    steps = 0
    while not terminated:  # wander until the fire catches the agent
        _, reward, terminated, _, info = env.step(rng.integers(0, 4) if env.batch.variant.grid else [2, 2])
        steps += 1
        assert steps < 40
    assert reward == -0.5
    assert info["reward"] == pytest.approx(0.1 - 0.5)
    assert info["commands_completed"] == 0.0
    assert info["success"] == 0


def endless_checks(limit: int, show: int = 3, gap: int = 1, burn: int = 6, fuse: int = 18) -> int:
    """How many commands are checked within so many steps, by counting from the description alone.

    The clue of the first command takes show + gap steps, one of them at the reset. Its check comes fuse + 1 acting
    steps later, every next one after burn + fuse more, and each new command's clue is shown in between.
    """
    time, checks, length = show + gap - 1 + fuse + 1, 0, 1
    while True:
        for command in range(length):
            if command:
                time += burn + fuse
            if time > limit:
                return checks
            checks += 1
        length += 1
        time += show + gap + burn + fuse


@pytest.mark.parametrize("limit", [21, 22, 500, 5000])
def test_endless_player_never_fails(limit):
    env = gym.make("Endless-MortarMayhem-v0").unwrapped
    rewards, terminated, truncated, info = play_out(env, lambda: player(env.batch)[0], limit, {"max_steps": limit})
    checks = endless_checks(limit)
    assert (terminated, truncated) == (False, True)
    assert len(rewards) == info["length"] == limit
    assert info["carried_out"] == info["commands_completed"] == checks == sum(r > 0 for r in rewards)
    assert info["reward"] == pytest.approx(0.1 * checks)
    completed = 0
    while checks > (completed + 1) * (completed + 2) // 2 - 1:
        completed += 1
    assert info["max_command_sequence"] == completed


# Mystery Path. The player walks from middle to middle, 4 steps a tile at the default speed, and a tile is reached at
# its edge: after 2 steps when it is entered from the left or above, 3 from the right or below.
EDGE = {EAST: 2, SOUTH: 2, WEST: 3, NORTH: 3}


def arrival(headings: list[int]) -> int:
    """Steps after which the player reaches the tile that these directions lead to."""
    return 4 * (len(headings) - 1) + EDGE[headings[-1]]


def grid_arrival(headings: list[int]) -> int:
    """The same tile by tile, from facing north: a step a tile, and one for each quarter turn."""
    quarter = {NORTH: 0, WEST: 1, SOUTH: 2, EAST: 3}
    facings = [0, *(quarter[heading] for heading in headings)]
    turns = [(b - a) % 4 for a, b in pairwise(facings)]
    return len(headings) + sum(min(turn, 4 - turn) for turn in turns)


@pytest.mark.parametrize("env_id", ["MysteryPath-v0", "MysteryPath-Grid-v0"])
@pytest.mark.parametrize("seed", range(8))
def test_player_walks_the_path(env_id, seed):
    env = gym.make(env_id).unwrapped
    goal = 1.0 if seed % 2 else -2.0
    options = {"reward_path_progress": 0.1, "reward_fall_off": -5.0} | ({} if seed % 2 else {"reward_goal": goal})
    rewards, terminated, truncated, info = play_out(env, lambda: player(env.batch)[0], seed, options)
    s = env.batch.state
    headings = s.direction_at[0, 1 : s.path_length[0]].tolist()
    assert (terminated, truncated) == (True, False)
    assert len(rewards) == info["length"] == (grid_arrival if "Grid" in env_id else arrival)(headings)
    assert [r for r in rewards if r] == [0.1] * (len(headings) - 1) + [goal]
    assert info["reward"] == pytest.approx(goal + 0.1 * (len(headings) - 1))
    assert (info["success"], info["is_success"], info["num_fails"]) == (1, True, 0)


@pytest.mark.parametrize(("limit", "levels"), [(1, 3), (2, 3), (150, 3), (1500, 1)])
def test_endless_player_walks_on(limit, levels):
    """As far as the path does not go left, where nobody can follow."""
    env = gym.make("Endless-MysteryPath-v0").unwrapped
    played = 0
    for seed in range(40):
        options = {"max_steps": limit, "reward_fall_off": -5.0}
        rewards, terminated, truncated, info = play_out(env, lambda: player(env.batch)[0], seed, options)
        s = env.batch.state
        headings = s.direction_at[0, 1 : s.path_length[0]].tolist()
        if WEST in headings[: limit // 4 + 2]:
            continue
        tiles = [step for step in range(1, len(headings) + 1) if arrival(headings[:step]) <= limit]
        assert (terminated, truncated) == (False, True)
        assert len(rewards) == info["length"] == limit
        assert info["tiles_visited"] == len(tiles) == sum(r == 0.1 for r in rewards)
        assert info["reward"] == pytest.approx(0.1 * len(tiles))
        assert info["max_x"] == sum(heading == EAST for heading in headings[: len(tiles)])
        assert info["num_fails"] == 0
        played += 1
        if played == levels:
            return
    pytest.fail("there are too few levels to play")


LANE_OPTIONS = {
    MortarMayhem: ({"command_count": [1, 3]}, {"max_steps": 120}),  # finite, endless
    MysteryPath: ({}, {"max_steps": 40}),
}


@pytest.mark.parametrize("env_id", [env_id for env_id in memory_gym_envs.IDS if FAMILY[env_id] in LANE_OPTIONS])
def test_players_in_lanes(env_id):
    """The same returns with automatic resets, several episodes a lane."""
    envs, endless = gym.make_vec(env_id, num_envs=LANES), "Endless" in env_id
    envs.reset(seed=0, options=LANE_OPTIONS[FAMILY[env_id]][endless])
    ended = 0
    for _ in range(400):
        _, _, terminated, truncated, infos = envs.step(player(envs))
        for lane in np.flatnonzero(terminated | truncated):
            ended += 1
            check_final(env_id, {key: values[lane] for key, values in infos["final_info"].items()})
    assert ended >= 2 * LANES


def check_final(env_id, final):
    """The final info of an episode that the player played with LANE_OPTIONS."""
    if env_id == "Endless-MysteryPath-v0":
        assert final["reward"] == pytest.approx(0.1 * final["tiles_visited"])
        assert final["num_fails"] == 0
        assert final["tiles_visited"] <= 10  # less where the path goes left
    elif "MysteryPath" in env_id:
        assert (final["success"], final["num_fails"]) == (1, 0)
        assert final["reward"] == 1.0 if "Grid" in env_id else final["reward"] > 1.0
    elif "Endless" in env_id:
        assert final["reward"] == pytest.approx(0.1 * endless_checks(120))
    else:
        assert final["success"] == 1
        assert round(final["reward"] / 0.1) in (1, 3)


def test_without_a_seed_the_level_is_not_known():
    """Gymnasium then draws a seed of 128 bits."""
    envs = gym.make_vec("MortarMayhem-v0", 2, obs_type="vector")
    env = gym.make("MortarMayhem-v0", obs_type="vector")
    envs.reset()
    env.reset()
    assert (envs.unwrapped.oracle()["seed"].tolist(), env.unwrapped.oracle()["seed"]) == ([-1, -1], -1)
    envs.reset(seed=[2**62, 3])
    assert envs.unwrapped.oracle()["seed"].tolist() == [2**62, 3]
