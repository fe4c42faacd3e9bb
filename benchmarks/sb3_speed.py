"""Steps per second in Stable-Baselines3: N environments in one object, beside its own N single environments.

    python benchmarks/sb3_speed.py [--id ID] [--obs-type pixels|vector] [--num-envs N] [--steps S]

Prints two lines: random actions, and a training of sb3-contrib's RecurrentPPO of so many steps, whose network takes
its part of the time. Both run on one thread; with random actions they take turns, and the best of each counts. Needs
the extra `sb3` and sb3-contrib.
"""

import argparse
import os
import sys
import time
from pathlib import Path

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this clone, before an installed one

import gymnasium as gym
import numpy as np

import memory_gym_envs


def random_rate(envs, steps: int) -> float:
    """Steps per second of all lanes together with random actions."""
    actions = [np.array([envs.action_space.sample() for _ in range(envs.num_envs)]) for _ in range(64)]
    envs.seed(0)
    envs.reset()
    calls = -(-steps // envs.num_envs)
    start = time.process_time()
    for call in range(calls):
        envs.step(actions[call % 64])
    return calls * envs.num_envs / (time.process_time() - start)


def training_rate(envs, steps: int) -> float:
    """Steps per second of a training."""
    from sb3_contrib import RecurrentPPO

    shape = envs.observation_space.shape
    policy = "MultiInputLstmPolicy" if shape is None else "CnnLstmPolicy" if len(shape) == 3 else "MlpLstmPolicy"
    agent = RecurrentPPO(policy, envs, seed=0, device="cpu")
    start = time.process_time()
    agent.learn(steps)
    return agent.num_timesteps / (time.process_time() - start)


def main() -> None:
    """Prints the rates and their ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--id", default="MysteryPath-v0", choices=memory_gym_envs.IDS)
    parser.add_argument("--obs-type", default="pixels", choices=("pixels", "vector"))
    parser.add_argument("--num-envs", type=int, default=16, help="environments (default: 16)")
    parser.add_argument("--steps", type=int, default=4096, help="steps of a training, all together (default: 4096)")
    args = parser.parse_args()
    if min(args.num_envs, args.steps) < 1:
        parser.error("--num-envs and --steps must be positive")
    try:
        import sb3_contrib  # noqa: F401
        import torch
        from stable_baselines3.common.env_util import make_vec_env

        from memory_gym_envs.sb3 import SB3VecEnv
    except ImportError as error:
        sys.exit(f"sb3_speed.py needs {error.name}: pip install stable-baselines3 sb3-contrib")
    torch.set_num_threads(1)
    ours = SB3VecEnv(gym.make_vec(args.id, num_envs=args.num_envs, obs_type=args.obs_type))
    theirs = make_vec_env(args.id, args.num_envs, env_kwargs={"obs_type": args.obs_type})
    for what, rate, steps, rounds in (
        ("random actions", random_rate, 5 * args.steps, 3),
        ("training", training_rate, args.steps, 1),
    ):
        pairs = [(rate(ours, steps), rate(theirs, steps)) for _ in range(rounds)]
        fast, slow = (max(each) for each in zip(*pairs, strict=True))
        print(
            f"{args.id}, {what}: {fast:,.0f} in one object, {slow:,.0f} one by one, ratio {fast / slow:.2f}", flush=True
        )


if __name__ == "__main__":
    main()
