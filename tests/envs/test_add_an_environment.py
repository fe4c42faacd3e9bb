"""examples/recall.py: its family has all that those of the package have."""

import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from helpers import check_same, roll

import examples.recall  # noqa: F401 (registers Recall-v0)
from ppo_utils.environments import is_memory_gym, make_envs

OPTIONS = {"delay": 3, "reward_success": 0.5}


@pytest.mark.parametrize("obs_type", ["pixels", "vector"])
def test_gymnasium_s_checker(obs_type):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make("Recall-v0", obs_type=obs_type).unwrapped)


def test_the_rules():
    assert gym.spec("Recall-v0").to_json()
    env = gym.make("Recall-v0")
    frame, info = env.reset(seed=4, options=OPTIONS)
    color = int(info["ground_truth"].argmax())
    assert (frame == np.eye(3)[color] * 255).all()
    for step in range(4):
        frame, reward, terminated, truncated, info = env.step(color)
        assert not frame.any()
        assert (reward, terminated, truncated) == (0.5 * (step == 3), step == 3, False)
    assert (info["reward"], info["length"], info["success"]) == (0.5, 4, 1.0)
    with pytest.raises(ValueError, match="Recall-v0 has no option 'dely'; the nearest is 'delay'"):
        env.reset(options={"dely": 3})
    with pytest.raises(ValueError, match="the action must be in Discrete"):
        env.reset(seed=4) and env.step(3)


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_lanes_are_single_environments(mode):
    lanes = SyncVectorEnv([lambda: gym.make("Recall-v0", options=OPTIONS).unwrapped] * 4, autoreset_mode=mode)
    envs = gym.make_vec("Recall-v0", num_envs=4, options=OPTIONS, autoreset_mode=mode)
    check_same(envs.reset(seed=3)[0], lanes.reset(seed=3)[0])
    for ours, theirs in zip(roll(envs, 30), roll(lanes, 30), strict=True):
        check_same(ours[:4], theirs[:4])


def test_it_is_saved_and_pickled():
    envs, twin = (gym.make_vec("Recall-v0", num_envs=4, options=OPTIONS) for _ in range(2))
    envs.reset(seed=0)
    roll(envs, 10)
    twin.set_state(envs.get_state())
    copy = pickle.loads(pickle.dumps(envs))
    ahead = roll(envs, 20, seed=1)
    check_same(ahead, roll(twin, 20, seed=1))
    check_same(ahead, roll(copy, 20, seed=1))


def test_levels_and_debug_view():
    envs = gym.make_vec("Recall-v0", num_envs=2, num_levels=5, render_mode="debug_rgb_array")
    envs.reset()
    roll(envs, 40)
    assert set(envs.np_random_seed) <= set(range(5))
    assert [picture.shape for picture in envs.render()] == [(336, 336, 3)] * 2


def test_scripts_can_train_on_it():
    """With levels, reset options and vectors, as on those of the package."""
    assert is_memory_gym("examples.recall:Recall-v0")
    assert gym.make("Recall-v0").unwrapped.max_episode_steps == -1, "it does not say"
    envs = make_envs("examples.recall:Recall-v0", 3, seed=1, obs_type="vector", num_levels=5, options=OPTIONS)
    observations, _ = envs.reset()
    assert observations["observation"].shape == (3, 3)
    assert set(envs.np_random_seed) <= set(range(5))
    assert envs.unwrapped.settings[0]["delay"] == 3
