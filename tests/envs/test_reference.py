"""The recordings of memory-gym 1.0.2 replay step for step, alone and as one lane of a vector environment.

The directory in the environment variable REFERENCE_TRACES replaces the few recordings in tests/data.
"""

import json
import os
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from helpers import FAMILY

import memory_gym_envs
from memory_gym_envs import MortarMayhem, MysteryPath, SearingSpotlights

FOLDER = Path(os.environ.get("REFERENCE_TRACES") or Path(__file__).resolve().parents[1] / "data")
FILES = sorted(path for path in FOLDER.glob("*.npz") if path.name.split(".")[0] in memory_gym_envs.IDS)
LANES, LANE = 3, 1
OTHER_LANES = {
    MortarMayhem: {"agent_scale": 0.5, "explosion_delay": [5]},
    MysteryPath: {"agent_scale": 0.4, "max_steps": 50},
    SearingSpotlights: {"agent_scale": 0.5, "initial_spawns": 9},
}


class Recording:
    """One recording, and the comparison of each step with it."""

    def __init__(self, path: Path):
        data = np.load(path)
        self.env_id, self.seed = str(data["env_id"]), int(data["seed"])
        self.options, self.final = json.loads(str(data["options"])), json.loads(str(data["final_info"]))
        self.actions, self.rewards, self.dones = data["actions"], data["rewards"], data["dones"]
        self.truth, self.vector = data["ground_truth"], data["vector"]
        self.frames = dict(zip(data["frame_steps"].tolist(), data["frames"], strict=True))
        self.frames_seen = 0

    def check(self, step: int, observation, truth) -> None:
        if isinstance(observation, dict):
            np.testing.assert_array_equal(observation["vector_observation"], self.vector[step])
            observation = observation["visual_observation"]
        if len(self.truth):
            np.testing.assert_allclose(truth, self.truth[step], rtol=0, atol=1e-12)
        if step in self.frames:
            np.testing.assert_array_equal(observation, self.frames[step])
            self.frames_seen += 1

    def check_end(self, info) -> None:
        assert self.frames_seen == len(self.frames)
        for key, value in self.final.items():
            np.testing.assert_allclose(info[key], value, rtol=0, atol=1e-9, err_msg=key)


def test_recordings_are_there():
    assert {path.name.split(".")[0] for path in FILES} == set(memory_gym_envs.IDS)


@pytest.mark.parametrize("env_id", memory_gym_envs.IDS)
def test_alone(env_id):
    """The first recording of each id: test_lanes.py says that lanes are single environments."""
    path = next(path for path in FILES if path.name.split(".")[0] == env_id)
    recording = Recording(path)
    env = gym.make(recording.env_id)
    observation, info = env.reset(seed=recording.seed, options=recording.options)
    recording.check(0, observation, info["ground_truth"])
    for step, action in enumerate(recording.actions):
        observation, reward, terminated, truncated, info = env.step(action)
        assert reward == recording.rewards[step]
        assert (terminated or truncated) == recording.dones[step]
        if truncated:
            assert step + 1 == env.unwrapped.batch.settings[0]["max_steps"]
        recording.check(step + 1, observation, info["ground_truth"])
    recording.check_end(info)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_as_a_lane(path):
    """The other lanes play other levels, with other options and random actions."""
    recording = Recording(path)
    envs = gym.make_vec(recording.env_id, num_envs=LANES)
    envs.reset(seed=5, options=OTHER_LANES[FAMILY[recording.env_id]])
    mask = np.arange(LANES) == LANE
    seeds = [None, recording.seed, None]
    observations, infos = envs.reset(seed=seeds, options={"reset_mask": mask, **recording.options})
    recording.check(0, pick(observations), infos["ground_truth"][LANE])
    envs.action_space.seed(0)
    for step, action in enumerate(recording.actions):
        actions = envs.action_space.sample()
        actions[LANE] = action
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        done = bool(terminated[LANE] or truncated[LANE])
        assert rewards[LANE] == recording.rewards[step]
        assert done == recording.dones[step]
        observation = infos["final_obs"][LANE] if done else pick(observations)
        info = infos["final_info"] if done else infos
        recording.check(step + 1, observation, info["ground_truth"][LANE])
    recording.check_end({key: values[LANE] for key, values in info.items()})


def pick(observations):
    """The recording's lane of a batch of observations."""
    if isinstance(observations, dict):
        return {key: value[LANE] for key, value in observations.items()}
    return observations[LANE]
