"""Resident memory before, half way through and after a million random steps of every id and kind of observation.

    python benchmarks/memory_use.py [--steps S] [--num-envs N] [--ids ID ...] [--obs-types T ...]

Prints a Markdown table, in MB. What an environment needs is there after the first half; what the second half adds would
be a leak. All run in one process, one after the other. Reads /proc, so it needs Linux.
"""

import argparse
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import gymnasium as gym

import memory_gym_envs
from memory_gym_envs.base import OBS_TYPES

COLUMNS = ["id", "observations", "steps", "before", "half way", "after", "second half"]


def resident() -> float:
    """Return the memory that this process holds, in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def play(envs: gym.vector.VectorEnv, steps: int) -> None:
    """Take so many random steps in each lane."""
    for _ in range(steps):
        envs.step(envs.action_space.sample())


def measure(id_: str, obs_type: str, steps: int, num_envs: int) -> tuple[float, float, float]:
    """Return the resident memory before the environment is made, half way through and after its steps, in MB."""
    before, each = resident(), -(-steps // num_envs // 2)
    envs = gym.make_vec(id_, num_envs=num_envs, obs_type=obs_type)
    envs.reset(seed=1)
    envs.action_space.seed(1)
    play(envs, each)
    half = resident()
    play(envs, each)
    after = resident()
    envs.close()
    return before, half, after


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1_000_000, help="of all lanes together (default: 1000000)")
    parser.add_argument("--num-envs", type=int, default=256, help="lanes (default: 256)")
    parser.add_argument("--ids", nargs="+", default=memory_gym_envs.IDS, help="ids to measure (default: all)")
    parser.add_argument("--obs-types", nargs="+", default=OBS_TYPES, help="pixels, vector (default: both)")
    args = parser.parse_args()
    if args.steps < 1 or args.num_envs < 1:
        parser.error("--steps and --num-envs must be positive")
    for chosen, known in ((args.ids, memory_gym_envs.IDS), (args.obs_types, OBS_TYPES)):
        unknown = sorted(set(chosen) - set(known))
        if unknown:
            parser.error(f"not known: {', '.join(unknown)}; possible are {', '.join(known)}")
    start = resident()
    print(f"| {' | '.join(COLUMNS)} |")
    print("|---|---" + "|---:" * (len(COLUMNS) - 2) + "|")
    for id_ in args.ids:
        for obs_type in args.obs_types:
            before, half, after = measure(id_, obs_type, args.steps, args.num_envs)
            numbers = f"{args.steps:,} | {before:.1f} | {half:.1f} | {after:.1f} | {after - half:+.1f}"
            print(f"| `{id_}` | {obs_type} | {numbers} |", flush=True)
    print(f"\nBefore the first: {start:.1f} MB, after the last: {resident():.1f} MB.")


if __name__ == "__main__":
    main()
