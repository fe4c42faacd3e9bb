"""How far into Mortar Mayhem's ten commands do agents get, and when? The table and picture of docs/tuning.md.

    python benchmarks/frontier.py

Of the development episodes that carried out k - 1 commands, the share that carries out command k too, all seeds
together, from benchmarks/results. Shape letters: P evaluations, C commands.
"""

import sys
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the packages of this repository

import learning
from ppo_utils.run_logs import align
from ppo_utils.terminal import one_line_exit

COUNT = 10  # commands of the tasks' default options
LEARNED_SHARE = 0.9  # a command is learned when so many of those who come to it carry it out
MIN_EPISODES = 20  # episodes that a share in the picture is of
RUNS = {  # what the table and picture call them: task, steps, and the agent of learning.py
    "GRU, clue and act": ("MortarMayhem-Grid-v0", 6e6, "GRU"),
    "TrXL+, clue and act": ("MortarMayhem-Grid-v0", 6e6, "TrXL+"),
    "step encoding, act, list not attended to": ("MortarMayhemB-Grid-v0", 6e6, "step encoding --no-attend-commands"),
    "GRU, act": ("MortarMayhemB-Grid-v0", 3e6, "GRU"),
}


def reached(task: str, steps: float, agent: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the steps (P,) and how many episodes carried out at least 0 to C commands, (P, C + 1)."""
    (runs,) = learning.stored_results(tasks=(task,), steps=int(steps), agents=(agent,))[task].values()
    steps_of, shares = align([run.curves["eval/carried_out"] for run in runs])  # (P,), (P, R, M, E)
    counts = np.rint(COUNT * shares.reshape(len(shares), -1, 1))
    return steps_of, (counts >= np.arange(COUNT + 1)).sum(1)


def first_time(steps: np.ndarray, episodes: np.ndarray, commands: int) -> str:
    """Return in millions the first of the steps (P,) at which all of so many first commands are learned; or nothing."""
    shares = episodes[:, 1 : commands + 1] / np.maximum(episodes[:, :commands], 1)
    there = np.flatnonzero((shares >= LEARNED_SHARE).all(1))
    return f"{steps[there[0]] / 1e6:.2f}" if there.size else ""


def draw(every: dict[str, tuple[np.ndarray, np.ndarray]], path: Path) -> None:
    """Draw a map of the shares for each agent: one row per command, one column per evaluation."""
    figure = Figure(figsize=(10, 2.6), layout="constrained")
    axes = figure.subplots(1, len(every), sharex=True, sharey=True)
    for axis, (name, (steps, episodes)) in zip(axes, every.items(), strict=True):
        shares = np.where(episodes[:, :-1] >= MIN_EPISODES, episodes[:, 1:] / np.maximum(episodes[:, :-1], 1), np.nan)
        ends = (0, steps[-1] / 1e6, 0.5, COUNT + 0.5)
        image = axis.imshow(shares.T, origin="lower", extent=ends, aspect="auto", vmin=0, vmax=1, cmap="viridis")
        axis.set_title(name.replace(", ", "\n", 1), fontsize=9)
        axis.set_xlabel("million steps")
        axis.set_yticks([1, 5, 10])
    axes[0].set_ylabel("command")
    axes[0].set_xlim(0, max(steps[-1] for steps, _ in every.values()) / 1e6)
    figure.colorbar(image, label="share of those who come to it", ax=axes)
    figure.savefig(path, dpi=110)


def main(out: Path = Path("docs/frontier.png")) -> None:
    """Print the table, and draw the picture to out."""
    commands = (1, 2, 3, 4, 6, 8, 10)
    every = {name: reached(*each) for name, each in RUNS.items()}
    print(f"| million steps to the first | {' | '.join(map(str, commands))} |\n|---|{'---:|' * len(commands)}")
    for name, each in every.items():
        print(f"| {name} | {' | '.join(first_time(*each, count) for count in commands)} |")
    draw(every, out)


if __name__ == "__main__":
    with one_line_exit(OSError, ValueError):
        tyro.cli(main)
