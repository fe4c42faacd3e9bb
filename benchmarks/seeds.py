"""What has each seed reached, beside random actions, a scripted player and the thesis? The picture of docs/results.md.

    python benchmarks/seeds.py

A panel a task, a dot a seed: the score of the final weights on new test levels, from benchmarks/results. Endless tasks
have a logarithmic axis, since the thesis trains much longer.
"""

import sys
from pathlib import Path

import tyro
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the packages of this repository

import learning
import tables
from suites import COLORS, TASKS

RESULTS = Path(__file__).with_name("results")
AGENTS = ("no memory", "16 frames", "GRU", "TrXL+, before", "TrXL+")


def main(out: Path = Path("docs/seeds.png")) -> None:
    """Draw the picture to a file."""
    bounds, thesis = tables.read_bounds(), tables.read_thesis()
    config = learning.Config(suite="full", agents=AGENTS, results=RESULTS)
    results = learning.results_of(config, learning.plans_of(config))
    figure = Figure(figsize=(13, 5.2), layout="constrained")
    for axis, (env_id, agents) in zip(figure.subplots(2, 5).flat, results.items(), strict=True):
        task = TASKS[env_id]
        theirs = dict(zip(("GRU", "TrXL+"), thesis.get(env_id, "").split(", "), strict=False))
        for column, (agent, runs) in enumerate(agents.items()):
            scores = tables.final_scores(task.score, runs).mean((1, 2)).tolist() if runs else []
            axis.plot([column] * len(scores), scores, "o", color=COLORS[agent], alpha=0.6)
            if level := theirs.get(agent):
                axis.plot(column, float(level.removeprefix("> ")), "k_", markersize=28, label="thesis")
        axis.axhline(bounds[env_id].random, color="gray", linestyle=":", label="random actions")
        axis.axhline(bounds[env_id].scripted, color="gray", linestyle="--", label="scripted player")
        if task.best_score is None:
            axis.set_yscale("log")
        axis.set_xticks(range(len(AGENTS)), [agent.replace(" ", "\n") for agent in AGENTS], fontsize=7)
        axis.set_xlim(-0.5, len(AGENTS) - 0.5)
        axis.set_title(f"{env_id.removesuffix('-v0')}, {task.total_timesteps / 1e6:g} M", fontsize=9)
        axis.set_ylabel(task.score, fontsize=8)
    handles = dict(zip(*reversed(figure.axes[0].get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    tyro.cli(main)
