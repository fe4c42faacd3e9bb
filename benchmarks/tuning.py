"""How many steps `--preset laptop` takes, and how fast it is: the table of docs/tuning.md.

    python benchmarks/tuning.py

Scores are those of benchmarks/results on development levels. Speeds are those of benchmarks/steps_per_second.csv, which
--measure writes: short trainings in turn, for which the machine has to have nothing else to do.

    python benchmarks/tuning.py --measure MortarMayhem-Grid-v0 SearingSpotlights-v0
"""

import csv
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the packages of this repository

import learning
from ppo_utils.run_logs import align, read_run
from suites import LAPTOP, TASKS

RESULTS, SPEEDS = (Path(__file__).with_name(name) for name in ("results", "steps_per_second.csv"))
AGENTS = {"ppo_trxl.py": "TrXL, Muon", "ppo_gru.py": "GRU, Muon"}  # by script
STEPS = 81_920  # of a training that is measured


@dataclass
class Config:
    """What to do before the table is printed."""

    measure: tuple[str, ...] = ()
    """the tasks whose steps per second are measured again on this machine, within two minutes a task"""


def plans_of(task: str, agent: str) -> dict[tuple[str, str, int], learning.Plan]:
    """Return the trainings of an agent, one a seed."""
    return learning.plans_of(learning.Config(suite="laptop", tasks=(task,), agents=(agent,), results=RESULTS))


def read_speeds() -> dict[tuple[str, str], float]:
    """Return the steps per second that were measured, by task and script."""
    with SPEEDS.open(newline="") as file:
        return {tuple(key): float(speed) for *key, speed in [*csv.reader(file)][1:]}


def measure_speeds(tasks: tuple[str, ...]) -> None:
    """Train for a few iterations with each script in turn, on one core, and write their steps per second.

    Raises SystemExit for tasks that this preset was not trained on.
    """
    if unknown := {*tasks} - {*LAPTOP}:
        raise SystemExit(f"there is no {min(unknown)!r}; there are {'; '.join(LAPTOP)}")
    speeds = read_speeds()
    flags = ["--no-save-model", "--eval-interval", "0", "--total-timesteps", str(STEPS)]
    for task in tasks:
        for script, agent in AGENTS.items():
            plan = next(iter(plans_of(task, agent).values()))
            with tempfile.TemporaryDirectory() as folder:
                env = {**os.environ, "OMP_NUM_THREADS": "1"}
                subprocess.run([*plan.command, *flags], check=True, cwd=folder, env=env)
                (run,) = (Path(folder) / "runs").iterdir()
                speeds[task, script] = read_run(str(run)).curves["charts/SPS"][1][-1].item()
    with SPEEDS.open("w", newline="") as file:  # at the end: a failed training loses nothing
        in_order = sorted(speeds.items(), key=lambda each: [*LAPTOP].index(each[0][0]))
        rows = [(*key, round(speed)) for key, speed in in_order]
        csv.writer(file).writerows([("task", "script", "steps_per_second"), *rows])


def steps_to(goal: float, steps: np.ndarray, scores: np.ndarray) -> str:
    """Return in millions the first of P steps at which the mean of the scores (P, R, M, E) is there; or nothing."""
    there = np.flatnonzero(scores.mean((1, 2, 3)) >= goal)
    return f"{steps[there[0]] / 1e6:.2f} M" if there.size else ""


def table(speeds: dict[tuple[str, str], float]) -> str:
    """Return a row for each task: the steps of a training, and each agent's to 0.5 and 0.9 of the best, and speed.

    The best is the best possible score, or where there is no bound the highest mean of these agents. Raises SystemExit
    where an agent has no results.
    """
    lines = ["| task | steps | transformer: to 0.5 | to 0.9 | steps/s | GRU: to 0.5 | to 0.9 | steps/s |"]
    lines.append("|---|---:|---:|---:|---:|---:|---:|---:|")
    for name in dict.fromkeys(task for task, _ in speeds):
        runs_of = {
            script: learning.results_of(learning.Config(results=RESULTS), plans_of(name, agent))[name].popitem()[1]
            for script, agent in AGENTS.items()
        }
        if lacking := [script for script, runs in runs_of.items() if not runs]:
            raise SystemExit(f"{RESULTS} has no results of {lacking[0]} in {name}; learning.py trains what is missing")
        task = TASKS[name]
        curves = {script: align([run.curves[f"eval/{task.score}"] for run in runs]) for script, runs in runs_of.items()}
        best = task.best_score or max(scores[-1].mean() for _, scores in curves.values())
        total = int(next(iter(runs_of.values()))[0].args["total_timesteps"])
        cells = [name, f"{total / 1e6:g} M"]
        for script, (steps, scores) in curves.items():
            cells += [steps_to(share * best, steps, scores) for share in (0.5, 0.9)] + [f"{speeds[name, script]:,.0f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main(config: Config) -> None:
    """Print the table."""
    if config.measure:
        measure_speeds(config.measure)
    print(table(read_speeds()))


if __name__ == "__main__":
    main(tyro.cli(Config))
