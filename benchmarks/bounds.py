"""What random actions, and a scripted player that sees the whole state, score on the test levels of learning.py.

    python benchmarks/bounds.py

For comparison with agents, on the same levels: those that are new. The player, of memory_gym_envs.players, knows the
target and walks to it. In Searing Spotlights it goes straight through the light. In the endless tasks it stops after
MAX_STEPS steps, or where the path of Endless Mystery Path goes left, where nobody can follow it. Writes
benchmarks/bounds.csv; tables of learning.py have its scores beside the agents'.
"""

import csv
import sys
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this clone, before an installed one

from learning import FIRST_TEST_LEVEL, TEST_LEVELS
from memory_gym_envs.players import choices, player
from ppo_utils.terminal import one_line_exit
from suites import FULL, SMALL, Task
from tables import BOUNDS, scored_levels

MAX_STEPS = 10_000  # as in evaluate.py
# In the small endless task, where a step crosses a tile, the player steps too far.
FINITE_SMALL = {name: task for name, task in SMALL.items() if not task.env_id.startswith("Endless")}


def random_player(envs: gym.vector.VectorEnv, rng: np.random.Generator) -> np.ndarray:
    """Return random actions."""
    return rng.integers(0, choices(envs), envs.action_space.shape)


def scripted_player(envs: gym.vector.VectorEnv, rng: np.random.Generator) -> np.ndarray:
    """Return the actions of the player that sees the whole state."""
    return player(envs)


def play(task: Task, actions_of: Callable, levels: int = TEST_LEVELS, max_steps: int = MAX_STEPS) -> np.ndarray:
    """Return a player's score on each test level, (M,)."""
    envs = gym.make_vec(task.env_id, num_envs=levels, obs_type="vector", max_episode_steps=max_steps)
    envs.reset(seed=FIRST_TEST_LEVEL, options=task.options)
    rng, scores, playing = np.random.default_rng(0), np.zeros(levels), np.ones(levels, bool)
    name = "reward" if task.score == "return" else task.score
    while playing.any():
        *_, infos = envs.step(actions_of(envs, rng))
        if "final_info" in infos:
            ended = infos["_final_info"] & playing
            scores[ended] = infos["final_info"][name][ended]
            playing &= ~ended
    return scores


def main(out: Path = BOUNDS, levels: int = TEST_LEVELS, max_steps: int = MAX_STEPS) -> None:
    """Write the mean scores over levels; raise ValueError for numbers that cannot work.

    Args:
        out: the file to write.
        levels: how many test levels to play.
        max_steps: steps after which an endless episode is cut short.
    """
    if not 1 <= levels <= TEST_LEVELS or max_steps < 1:
        raise ValueError(f"--levels must be 1 to {TEST_LEVELS}, --max-steps 1 or more; they are {levels}, {max_steps}")
    rows = [("task", "random", "scripted")]
    for name, task in (FINITE_SMALL | FULL).items():
        new = scored_levels(task.env_id, task.options)
        which = slice(None) if new is None else new[:levels]
        scores = [play(task, each, levels, max_steps)[which].mean() for each in (random_player, scripted_player)]
        rows.append((name, *(f"{each:.4g}" for each in scores)))
    with out.open("w", newline="") as file:  # not before all has been played: what was stopped changes nothing
        csv.writer(file, lineterminator="\n").writerows(rows)


if __name__ == "__main__":
    with one_line_exit(OSError, ValueError):
        tyro.cli(main)
