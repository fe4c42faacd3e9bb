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
MUON, LOW_RATE, LAPTOP = ", Muon", ", Muon, low rate", ", laptop"
RUNS = {  # millions of steps, and what follows the agents' names: the longest runs of each task
    "MortarMayhem-v0": (12, MUON),
    "MortarMayhem-Grid-v0": (6, MUON),
    "MortarMayhemB-v0": (6, LAPTOP),
    "MortarMayhemB-Grid-v0": (3, LAPTOP),
    "Endless-MortarMayhem-v0": (20, MUON),
    "MysteryPath-v0": (6, LOW_RATE),
    "MysteryPath-Grid-v0": (15, LOW_RATE),
    "Endless-MysteryPath-v0": (9, MUON),
    "SearingSpotlights-v0": (6, MUON),
    "Endless-SearingSpotlights-v0": (9, MUON),
}
NAMES = {"no memory": "none", "stack of 16": "16 frames", "GRU": "GRU", "TrXL": "TrXL+"}


def scores_of(env_id: str, agent: str, steps: int) -> list[float]:
    """Return the score of each seed, of none where the agent was not trained so."""
    if agent not in learning.AGENTS:
        return []
    suite = "full" if env_id in ("MysteryPath-v0", "MysteryPath-Grid-v0") else "laptop"
    config = learning.Config(suite=suite, tasks=(env_id,), steps=steps, agents=(agent,), results=RESULTS)
    (runs,) = learning.results_of(config, learning.plans_of(config))[env_id].values()
    return tables.final_scores(TASKS[env_id].score, runs).mean((1, 2)).tolist() if runs else []


def main(out: Path = Path("docs/seeds.png")) -> None:
    """Draw the picture to a file."""
    bounds, thesis = tables.read_bounds(), tables.read_thesis()
    figure = Figure(figsize=(13, 5.2), layout="constrained")
    for axis, (env_id, (millions, kind)) in zip(figure.subplots(2, 5).flat, RUNS.items(), strict=True):
        theirs = dict(zip(("GRU", "TrXL"), thesis.get(env_id, "").split(", "), strict=False))
        for column, agent in enumerate(NAMES):
            scores = scores_of(env_id, agent + kind, millions * 1_000_000)
            color = COLORS["TrXL+" if agent == "TrXL" else agent]
            axis.plot([column] * len(scores), scores, "o", color=color, alpha=0.6)
            if level := theirs.get(agent):
                axis.plot(column, float(level.removeprefix("> ")), "k_", markersize=28, label="thesis")
        axis.axhline(bounds[env_id].random, color="gray", linestyle=":", label="random actions")
        axis.axhline(bounds[env_id].scripted, color="gray", linestyle="--", label="scripted player")
        if TASKS[env_id].best_score is None:
            axis.set_yscale("log")
        axis.set_xticks(range(len(NAMES)), NAMES.values(), fontsize=8)
        axis.set_xlim(-0.5, len(NAMES) - 0.5)
        axis.set_title(f"{env_id.removesuffix('-v0')}, {millions} M", fontsize=9)
        axis.set_ylabel(TASKS[env_id].score, fontsize=8)
    handles = dict(zip(*reversed(figure.axes[0].get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    tyro.cli(main)
