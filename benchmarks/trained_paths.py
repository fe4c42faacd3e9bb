"""How well do agents do on test levels whose path was often, rarely or never among those they trained on?

    python benchmarks/trained_paths.py [--count]

The tables and the picture of docs/results.md, of the final weights in benchmarks/results. Levels with other numbers may
have the same path. Takes 10 s. With --count, in two minutes, the table of docs/evaluation.md: how many levels of each
task are new. Shape letters: R seeds, M test levels, E episodes on each.
"""

import json
import sys
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import gymnasium as gym
import numpy as np
import tyro
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the packages of this repository

import learning
import ppo_gru
import tables
from ppo_utils.evaluation import beginnings
from ppo_utils.flags import RunArgs
from ppo_utils.terminal import one_line_exit
from suites import COLORS, LONGER, SEEDS, TASKS

AGENTS = ("no memory", "16 frames", "GRU", "TrXL+, low rate", "TrXL+")
PATH_TASKS = ("MysteryPath-Grid-v0", "MysteryPath-v0")  # tasks that have the same paths
LONG_TASK = PATH_TASKS[1]  # of which one agent has a longer training, too
LEVELS = 100_000  # that are trained on by default
TEST_LEVELS = learning.TEST_LEVELS
COUNTED = {  # what the table calls them: id, reset options
    **{name: (task.env_id, json.dumps(task.options)) for name, task in TASKS.items() if task.best_score is not None},
    "quickstart": (ppo_gru.Args().env_id, ppo_gru.QUICKSTART["env_options"]),
}
ENDLESS, TILES = "Endless-MysteryPath-v0", (8, 11)  # tiles that a GRU comes to after 3 and 9 million steps
EDGES = (0, 1, 2, 5, 11, 31, 101, np.inf)  # a column's levels: path so often in the training, below the next


@dataclass
class Config:
    """What to print."""

    count: bool = False
    """how many levels of each task are new, instead of the scores"""
    out: Path = Path("docs/trained_paths.png")
    """where the scores are drawn"""


def times_trained_on(args: RunArgs, levels: int) -> np.ndarray:
    """Return how often each test level's path was among a training's levels, (M,)."""
    task = args.env_id, args.env_options
    trained_on = Counter(beginnings(*task, args.start_level, args.num_levels))
    return np.array([trained_on[each] for each in beginnings(*task, learning.FIRST_TEST_LEVEL, levels)])


def first_tiles(first: int, levels: int, tiles: int) -> list[bytes]:
    """Return the first tiles, after the origin, of so many levels of Endless Mystery Path."""
    envs, found = gym.make_vec(ENDLESS, num_envs=TEST_LEVELS, obs_type="vector"), []
    for level in range(first, first + levels, TEST_LEVELS):
        envs.reset(seed=level)
        found += [path[1 : tiles + 1].tobytes() for path in envs.unwrapped.oracle()["path"]]
    envs.close()
    return found


def print_counts() -> None:
    """Print how many of each task's training levels differ, and how many test levels begin as none of them.

    Of Endless Mystery Path only the first tiles count. Which levels of the others are new goes to
    benchmarks/new_levels.csv, a digit for each.
    """
    lines = ["task,new"]
    print("| task | different levels of the first 100,000 | new of 1,000 test levels |\n|---|---:|---:|")
    for name, task in COUNTED.items():
        trained_on = set(beginnings(*task, 0, LEVELS))
        new = [each not in trained_on for each in beginnings(*task, learning.FIRST_TEST_LEVEL, TEST_LEVELS)]
        print(f"| {name} | {len(trained_on):,} | {sum(new):,} |")
        if name in TASKS and not all(new):
            lines.append(f"{name},{''.join(str(int(each)) for each in new)}")
    for tiles in TILES:
        trained_on = set(first_tiles(0, LEVELS, tiles))
        new = [each not in trained_on for each in first_tiles(learning.FIRST_TEST_LEVEL, TEST_LEVELS, tiles)]
        print(f"| {ENDLESS}, first {tiles} tiles | {len(trained_on):,} | {sum(new):,} |")
    tables.NEW_LEVELS.write_text("\n".join(lines) + "\n")


def print_scores(out: Path) -> None:
    """Print a table for each task, and draw them."""
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    columns = ["0", "1", "2-4", "5-10", "11-30", "31-100", "more"]
    times = times_trained_on(ppo_gru.Args(env_id=PATH_TASKS[0]), TEST_LEVELS)
    inside = [(low <= times) & (times < high) for low, high in pairwise(EDGES)]
    results = learning.stored_results(tasks=PATH_TASKS, agents=AGENTS, seeds=SEEDS)
    longer = learning.stored_results(tasks=(LONG_TASK,), steps=LONGER[LONG_TASK], agents=("TrXL+",))
    results[LONG_TASK][f"TrXL+, {LONGER[LONG_TASK] / 1e6:g} M"] = longer[LONG_TASK]["TrXL+"]
    for axis, (env_id, agents) in zip(figure.subplots(1, 2, sharey=True), results.items(), strict=True):
        print(f"| {env_id}, path trained on | {' | '.join(columns)} | all |\n|---|{'---:|' * (len(columns) + 1)}")
        print(f"| test levels | {' | '.join(str(each.sum()) for each in inside)} | {len(times):,} |")
        for agent, runs in ((agent, runs) for agent, runs in agents.items() if runs):
            scores = tables.final_scores("success", runs, every_level=True)  # (R, M, E)
            means = [scores[:, each].mean() for each in inside]
            print(f"| {agent} | {' | '.join(f'{mean:.2f}' for mean in [*means, scores.mean()])} |")
            style = {} if agent in COLORS else {"linestyle": "--"}
            axis.plot(columns, means, marker="o", color=COLORS.get(agent, COLORS["TrXL+"]), label=agent, **style)
        axis.set_title(env_id)
        axis.set_xlabel("how often the level's path was trained on")
        print()
    axis.legend(frameon=False, fontsize=8)
    figure.axes[0].set_ylabel("success")
    figure.savefig(out, dpi=120)


def main(config: Config) -> None:
    """Count levels, or print scores and draw them."""
    if config.count:
        print_counts()
    else:
        print_scores(config.out)


if __name__ == "__main__":
    with one_line_exit(OSError, ValueError):
        main(tyro.cli(Config))
