"""Stable-Baselines3 gets the same from N lanes as from N single environments in its own DummyVecEnv."""

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from helpers import FAMILY, HASTY, ONE_OBS, check_same

pytest.importorskip("sb3_contrib")

import sb3_contrib
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from memory_gym_envs.players import player
from memory_gym_envs.sb3 import SB3VecEnv

LANES = 3


def make(env_id="SearingSpotlights-v0", **arguments):
    return SB3VecEnv(gym.make_vec(env_id, num_envs=LANES, **arguments))


def both(env_id, **arguments):
    lanes = [lambda: gym.make(env_id, disable_env_checker=True, **arguments)] * LANES
    return make(env_id, **arguments), DummyVecEnv(lanes)


@ONE_OBS
def test_as_its_own(env_id, obs_type):
    ours, theirs = both(env_id, obs_type=obs_type, options=HASTY[FAMILY[env_id]])
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    ended = 0
    for seed in (7, None):
        for envs in (ours, theirs):
            if seed is not None:
                envs.seed(seed)
        first = [envs.reset() for envs in (ours, theirs)]
        check_same(*map(as_dict, first))
        check_same(ours.reset_infos, theirs.reset_infos)
        for _ in range(60):
            actions = np.array([ours.action_space.sample() for _ in range(LANES)])
            results = [envs.step(actions) for envs in (ours, theirs)]
            check_same(*([as_dict(obs), *rest] for obs, *rest in results))
            check_same(ours.reset_infos, theirs.reset_infos)
            ended += np.count_nonzero(results[0][2])
    assert ended > LANES


def as_dict(observations):
    return dict(observations) if isinstance(observations, dict) else observations


def test_the_page_s_training(monkeypatch):
    """A rollout of it; all else as it stands there."""
    made = []

    class Short(sb3_contrib.RecurrentPPO):
        def __init__(self, *args):
            super().__init__(*args, n_steps=8, n_epochs=1, device="cpu")
            made.append(self)

    monkeypatch.setattr(sb3_contrib, "RecurrentPPO", Short)
    page = (Path(__file__).parents[2] / "docs/environments.md").read_text()
    (block,) = (each for each in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "SB3VecEnv" in each)
    exec(block.replace("100_000", "1"), {})
    assert made[0].num_timesteps == 8 * 16


class Kept(KVWriter):
    """What was logged."""

    def write(self, key_values, key_excluded, step=0):
        self.values = dict(key_values)


class Player:
    """What EvalCallback needs of a model; it knows the way."""

    def __init__(self, envs):
        self.envs, self.logger, self.num_timesteps = envs, Logger(None, [Kept()]), 0

    def predict(self, observations, **_):
        return player(self.envs.venv.envs), None

    def get_env(self):
        return self.envs

    def get_vec_normalize_env(self):
        return None


def test_the_rate_of_success_is_logged():
    """Of episodes with a limit, which ends those with long paths."""
    envs = VecMonitor(make("MysteryPath-Grid-v0", obs_type="vector", options={"max_steps": 11}))
    envs.seed(0)
    callback = EvalCallback(envs, n_eval_episodes=9, eval_freq=1, verbose=0)
    callback.init_callback(Player(envs))
    callback.on_step()
    (kept,) = callback.logger.output_formats
    assert 0 < kept.values["eval/success_rate"] < 1
    # A reward of 1 for the goal, and for nothing else.
    assert kept.values["eval/success_rate"] == pytest.approx(kept.values["eval/mean_reward"])


def test_a_limit_of_steps_is_a_truncation():
    envs = VecMonitor(make("MysteryPath-v0", obs_type="vector", max_episode_steps=20))
    envs.reset()
    for _ in range(20):
        _, _, done, infos = envs.step(np.zeros((LANES, 2), int))
    assert done.all()
    for info in infos:
        assert info["TimeLimit.truncated"]
        assert info["terminal_observation"].shape == envs.observation_space.shape
        assert (info["episode"]["l"], info["episode"]["r"]) == (20, 0.0)


def test_an_end_at_the_limit_of_steps_is_no_truncation():
    """An agent that stands still fails at a command; the limit is that very step."""
    alone = gym.make("MortarMayhem-v0")
    alone.reset(seed=0)
    length = next(step for step in range(1, 300) if alone.step([0, 0])[2])
    ours, theirs = both("MortarMayhem-v0", max_episode_steps=length)
    for envs in (ours, theirs):
        envs.seed(0)
        envs.reset()
        for _ in range(length):
            _, _, done, infos = envs.step(np.zeros((LANES, 2), int))
        assert done[0]
        assert infos[0]["TimeLimit.truncated"] is False


def test_options_are_those_of_all_lanes():
    envs = make("MysteryPath-v0", obs_type="vector")
    envs.set_options({"max_steps": 4})
    envs.reset()
    for _ in range(2):  # the automatic reset keeps them
        for _ in range(4):
            _, _, done, _ = envs.step(np.zeros((LANES, 2), int))
        assert done.all()
    envs.reset()
    assert envs.get_attr("settings")[0][0]["max_steps"] == 512
    envs.set_options([{"max_steps": 4}, {}, {}])
    with pytest.raises(ValueError, match="the same options for all lanes"):
        envs.reset()


def test_attributes_and_methods():
    envs = make(render_mode="rgb_array")
    envs.seed(3)
    envs.reset()
    assert envs.get_attr("variant_id", [0, 2]) == ["SearingSpotlights-v0"] * 2
    assert envs.get_attr("action_space", 1) == [envs.action_space]
    assert not envs.has_attr("nothing")
    assert envs.env_is_wrapped(Monitor) == [False] * LANES
    assert envs.render().shape[2] == 3
    assert [image.shape for image in envs.get_images()] == [(84, 84, 3)] * LANES
    envs.set_attr("num_levels", 4)
    assert envs.envs.num_levels == 4
    with pytest.raises(ValueError, match="num_levels is the same for all lanes"):
        envs.set_attr("num_levels", 4, indices=[1])
    assert len(envs.env_method("ground_truth")) == LANES
    with pytest.raises(ValueError, match="ground_truth is the same for all lanes"):
        envs.env_method("ground_truth", indices=0)
    envs.close()


def test_an_agent_is_evaluated():
    class Still:
        def predict(self, observations, **_):
            return np.zeros((LANES, 2), int), None

    envs = VecMonitor(make("MortarMayhem-v0", obs_type="vector"))
    mean, _ = evaluate_policy(Still(), envs, n_eval_episodes=6)
    assert 0 <= mean <= 1


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_other_autoreset_is_refused(mode):
    with pytest.raises(ValueError, match="with same-step autoreset, not") as error:
        make(autoreset_mode=mode)
    assert "\n" not in str(error.value)
