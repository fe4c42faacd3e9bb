"""Prints what 200 steps of random actions give in each id, as checksums: the same with all versions of the packages."""

import zlib

import gymnasium as gym
import numpy as np

import memory_gym_envs

for env_id in memory_gym_envs.IDS:
    env, rng, checksum = gym.make(env_id, disable_env_checker=True).unwrapped, np.random.default_rng(0), 0
    branches = getattr(env.action_space, "nvec", None)
    over, seed = True, 0
    for _ in range(200):
        if over:
            seen, over, seed = (*env.reset(seed=seed), 0.0), False, seed + 1
        else:
            action = rng.integers(env.action_space.n) if branches is None else rng.integers(branches)
            observation, reward, terminated, truncated, info = env.step(action)
            seen, over = (observation, info, reward), terminated or truncated
        observation, info, reward = seen
        images = observation.values() if isinstance(observation, dict) else [observation]
        for array in (*images, info["ground_truth"], np.float64(reward)):
            checksum = zlib.crc32(np.ascontiguousarray(array), checksum)
    print(env_id, env.max_episode_steps, checksum)
