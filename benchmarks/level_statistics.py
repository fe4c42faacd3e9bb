"""How many steps the finite tasks of varying length take at least, beside the thesis' table 4.5.

    python benchmarks/level_statistics.py [--levels N] [--path-levels N]

Prints a Markdown table of the levels 0 .. N - 1 with default options. Searing Spotlights: the distance from the agent
to the coin to the exit over the agent's speed, rounded up, as in the thesis. Mystery Path: the fewest steps to the goal
without falling off, by breadth-first search; the thesis counts those of a trained agent that sees the path.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this clone, before an installed one

from memory_gym_envs.character import FACINGS, PAD, agent_tables, free_controls, grid_controls, walk
from memory_gym_envs.drawing import SCREEN
from memory_gym_envs.mystery_path.rules import TILE_AT
from memory_gym_envs.mystery_path.state import MAP_STRIDES, PIT, PIT_ROWS

THESIS = {  # mean, standard deviation, minimum, maximum, levels
    "SearingSpotlights-v0": (33.36, 7.56, 14, 63, 100_000),
    "MysteryPath-v0": (29.03, 4.88, 22, 43, 1_000),
    "MysteryPath-Grid-v0": (13.37, 3.16, 7, 22, 1_000),
}
BATCH = 50  # levels at once


def batches(env_id: str, levels: int) -> Iterator[tuple[gym.vector.VectorEnv, dict]]:
    """Yield an environment that has just been reset to the next BATCH levels, and its infos."""
    envs = gym.make_vec(env_id, num_envs=BATCH)
    for first in range(0, levels, BATCH):
        yield envs, envs.reset(seed=first)[1]


def spotlight_lengths(levels: int) -> np.ndarray:
    """Return the optimal lengths of Searing Spotlights levels, (levels,)."""
    lengths = []
    for envs, infos in batches("SearingSpotlights-v0", levels):
        places = infos["ground_truth"].reshape(BATCH, 3, 2) * SCREEN  # of the agent, the coin and the exit
        way = np.linalg.norm(np.diff(places, axis=1), axis=2).sum(axis=1)
        lengths.append(np.ceil(way / envs.defaults["agent_speed"]))
    return np.concatenate(lengths)[:levels]


def path_lengths(env_id: str, levels: int) -> np.ndarray:
    """Return the fewest steps to the goals of a finite Mystery Path id's levels, (levels,)."""
    return np.concatenate([fewest_steps(envs) for envs, _ in batches(env_id, levels)])[:levels]


def fewest_steps(envs: gym.vector.VectorEnv) -> np.ndarray:
    """Return the fewest steps from where the agents are to their goals, (N,)."""
    s, grid = envs.state, envs.variant.grid
    controls, table = grid_controls() if grid else free_controls(), agent_tables(envs.figures).walk
    fewest, steps = np.zeros(envs.num_envs, int), 0
    # Where free movement goes does not depend on the facing.
    front = np.zeros((envs.num_envs, FACINGS if grid else 1, SCREEN, SCREEN), bool)
    front[(np.arange(envs.num_envs), s.facing * grid, *(s.pos.T - PAD))] = True
    seen = front.copy()
    while not fewest.all():
        lane, facing, *place = np.nonzero(front)
        front[:], steps = False, steps + 1
        for action in range(controls.actions - 1):
            turned, pos = walk(facing, np.stack(place, axis=1) + PAD, action, 0, controls, table)
            step = s.step_at[lane, TILE_AT[pos] @ MAP_STRIDES + PIT_ROWS]
            safe = step != PIT
            front[(lane[safe], turned[safe] * grid, *(pos[safe].T - PAD))] = True
            fewest[lane[step == s.path_length[lane]]] = steps
        front &= ~seen
        seen |= front
        front[fewest > 0] = False
    return fewest


def row(env_id: str, lengths: np.ndarray) -> str:
    """Return an id's row of the Markdown table, ours beside the thesis'."""
    ours = (lengths.mean(), lengths.std(), int(lengths.min()), int(lengths.max()), len(lengths))
    cells = [number for pair in zip(ours, THESIS[env_id], strict=True) for number in pair]
    texts = [f"{cell:.2f}" if isinstance(cell, float) else f"{cell:,}" for cell in cells]
    return f"| `{env_id}` | {' | '.join(texts)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--levels", type=int, default=100_000, help="Searing Spotlights levels")
    parser.add_argument("--path-levels", type=int, default=10_000, help="Mystery Path levels of each id")
    args = parser.parse_args()
    if min(args.levels, args.path_levels) < 1:
        parser.error("--levels and --path-levels must be positive")
    names = ("mean", "standard deviation", "minimum", "maximum", "levels")
    print("| id |" + "".join(f" {name} | thesis |" for name in names))
    print("|---|" + "---:|---:|" * len(names))
    print(row("SearingSpotlights-v0", spotlight_lengths(args.levels)))
    for env_id in ("MysteryPath-v0", "MysteryPath-Grid-v0"):
        print(row(env_id, path_lengths(env_id, args.path_levels)))


if __name__ == "__main__":
    main()
