"""Settings that were tried beside the preset's: the table of docs/tuning.md.

    python benchmarks/trials.py
    python benchmarks/trials.py --add "TrXL+ --final-lr 1e-5" runs/RUN

Scores on development levels while the learning rate falls as in a whole training, most of it ahead. Of a trial, only
this curve is kept, in benchmarks/trials.csv, to which --add writes that of a run's folder; whole trainings beside them
are in benchmarks/results.
"""

import csv
import sys
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the packages of this repository

import learning
from ppo_utils.run_logs import NoCurvesError, RunLog, read_run
from ppo_utils.terminal import one_line_exit
from suites import TASKS

TRIALS = Path(__file__).with_name("trials.csv")
COLUMNS = {  # million steps of each task's columns, and the whole trainings that stand above its trials
    "MortarMayhem-Grid-v0": ((1.2, 1.8, 2.4), ("TrXL+", "TrXL+, before", "GRU")),
    "MortarMayhem-v0": ((1.2, 2.4, 6), ("TrXL+", "TrXL+, before", "GRU")),
    "MysteryPath-Grid-v0": ((2.4, 4.8, 6, 9), ("TrXL+", "TrXL+, low rate", "GRU")),
    "SearingSpotlights-v0": ((1.2, 1.8, 2.4), ("TrXL+", "TrXL+, before", "GRU")),
}
Curve = dict[int, float]  # mean scores by steps


@dataclass
class Config:
    """What to add; without it, the table is printed."""

    add: tuple[str, Path] | None = None
    """an agent, as benchmarks/learning.py names it, and the folder of its run"""


def curve_of(run: RunLog) -> Curve:
    """Return a run's mean scores on development levels."""
    steps, scores = run.curves[f"eval/{TASKS[run.args['env_id']].score}"]
    return dict(zip(steps.tolist(), scores.mean((1, 2)).tolist(), strict=True))


def add(agent: str, run: RunLog) -> None:
    """Append a run's curve to the file. Raises SystemExit for a run that the tables could not show, or have already."""
    task, seed = run.args["env_id"], run.args["seed"]
    if task not in COLUMNS:
        raise SystemExit(f"the tables have {', '.join(COLUMNS)}, not {task}")
    if run.args["env_options"] != "{}":
        raise SystemExit(f"the tables have tasks with default options, not {run.args['env_options']}")
    if f"eval/{TASKS[task].score}" not in run.curves:
        raise SystemExit(f"{run.path} has no evaluations; train with --eval-interval")
    with TRIALS.open(newline="") as file:
        if any((row["task"], row["agent"], row["seed"]) == (task, agent, seed) for row in csv.DictReader(file)):
            raise SystemExit(f"there is a trial of {agent} in {task} with seed {seed} already")
    with TRIALS.open("a", newline="") as file:
        rows = ((task, agent, seed, step, f"{score:.4f}") for step, score in curve_of(run).items())
        csv.writer(file, lineterminator="\n").writerows(rows)


def read_trials(task: str) -> dict[str, list[Curve]]:
    """Read the curves of a task's trials: one for each seed of an agent, in the order of the file."""
    curves = defaultdict(dict)
    with TRIALS.open(newline="") as file:
        for row in csv.DictReader(file):
            if row["task"] == task:
                seeds = curves[row["agent"]]
                seeds.setdefault(row["seed"], {})[int(row["step"])] = float(row["score"])
    return {agent: [*seeds.values()] for agent, seeds in curves.items()}


def score_at(curve: Curve, millions: float) -> float:
    """Return the score then, linear between evaluations; NaN before the first, and if the run ended 5 % earlier."""
    step, steps = 1e6 * millions, [*curve]
    return float(np.interp(step, steps, [*curve.values()])) if steps[0] <= step < steps[-1] / 0.95 else np.nan


def row(agent: str, curves: list[Curve], columns: tuple[float, ...]) -> str:
    """Return an agent's row: how many seeds, and their means at each of the columns that all of them came to."""
    means = [np.mean([score_at(curve, millions) for curve in curves]) for millions in columns]
    cells = ["" if np.isnan(mean) else f"{mean:.2f}" for mean in means]
    return f"| {' | '.join([f'`{agent}`', str(len(curves)), *cells])} |"


def main(config: Config) -> None:
    """Print the tables, or add a run. Raises NoCurvesError for a folder that holds none, SystemExit as `add` does."""
    if config.add:
        agent, folder = config.add
        add(agent, read_run(str(folder)))
        return
    for task, (columns, agents) in COLUMNS.items():
        print(f"\n| {task} | seeds | {' | '.join(f'{millions:g} M' for millions in columns)} |")
        print(f"|---|{'---:|' * (1 + len(columns))}")
        stored = learning.stored_results(tasks=(task,), agents=agents)[task]
        whole = {agent: [*map(curve_of, runs)] for agent, runs in stored.items() if runs}
        for agent, curves in (whole | read_trials(task)).items():
            print(row(agent, curves, columns))


if __name__ == "__main__":
    with one_line_exit(NoCurvesError, OSError):
        main(tyro.cli(Config))
