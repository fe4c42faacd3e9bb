"""A scripted player earns exactly the known return, in exactly the known number of steps, in every id."""

import gymnasium as gym
import numpy as np
import pytest
from players import player

from memory_gym_envs import MortarMayhem

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
        assert info["success"] == (done == 4)


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
        assert not any(rewards[:-1])
        earned.add(rewards[-1])
    assert earned == {-0.5, 3.1}  # 3.1 where the command was to stay


@pytest.mark.parametrize("env_id", BOUNDS)
def test_walking_into_the_fire(env_id):
    """The command that was already checked no longer counts, and the step pays the failure reward."""
    env = gym.make(env_id).unwrapped
    options = {"reward_command_failure": -0.5, "explosion_duration": [40]}
    env.reset(seed=3, options=options)
    while not env.batch.state.lit[0]:
        _, _, terminated, _, _ = env.step(player(env.batch)[0])
    assert not terminated
    x, y = (env.batch.state.goal[0] + 7 - env.batch.state.pos[0]).tolist()
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
    assert info["commands_completed"] == checks == sum(r > 0 for r in rewards)
    assert info["reward"] == pytest.approx(0.1 * checks)
    completed = 0
    while checks > (completed + 1) * (completed + 2) // 2 - 1:
        completed += 1
    assert info["max_command_sequence"] == completed


@pytest.mark.parametrize("env_id", MortarMayhem.variants)
def test_players_in_lanes(env_id):
    """The same returns with automatic resets, several episodes a lane."""
    envs = gym.make_vec(env_id, num_envs=LANES)
    options = {"max_steps": 120} if "Endless" in env_id else {"command_count": [1, 3]}
    envs.reset(seed=0, options=options)
    ended = 0
    for _ in range(400):
        _, _, terminated, truncated, infos = envs.step(player(envs))
        for lane in np.flatnonzero(terminated | truncated):
            final = {key: values[lane] for key, values in infos["final_info"].items()}
            ended += 1
            if "Endless" in env_id:
                assert final["reward"] == pytest.approx(0.1 * endless_checks(120))
            else:
                assert final["success"] == 1
                assert round(final["reward"] / 0.1) in (1, 3)
    assert ended >= 2 * LANES
