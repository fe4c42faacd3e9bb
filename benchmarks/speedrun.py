"""Who learns a task to its target with the fewest steps? A table of docs/results.md, which has the rules.

    python benchmarks/speedrun.py

Prints each entry of benchmarks/speedrun.csv with what its runs in benchmarks/results reached. Shape letters: R seeds, M
test levels, E episodes on each.
"""

import csv
import itertools
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.stats
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the packages of this repository

import learning
import tables
from ppo_utils.run_logs import RunLog
from ppo_utils.terminal import one_line_exit
from suites import SEEDS, TASKS

ENTRIES = Path(__file__).with_name("speedrun.csv")
ALPHA = 0.01  # significance level of the test that the mean is above the target
SMALLEST_PRINTED = 0.0001  # p-value
HEADING = """| task | target | agent | score | p <= | steps | date, commit |
|---|---:|---|---:|---:|---:|---|"""


@dataclass(frozen=True)
class Entry:
    """A line of the file: what was trained, and when."""

    task: str
    target: float
    agent: str  # as learning.py --agents takes it
    steps: int
    date: str
    commit: str


def read_entries() -> list[Entry]:
    """Read the entries in the order of the file; raise SystemExit for one with no fewer steps than an earlier one."""
    with ENTRIES.open(newline="") as file:
        rows = [*csv.DictReader(file)]
    entries = [Entry(**{**row, "target": float(row["target"]), "steps": int(float(row["steps"]))}) for row in rows]
    for earlier, entry in itertools.combinations(entries, 2):
        if earlier.task == entry.task and earlier.steps <= entry.steps:
            raise SystemExit(
                f"{entry.agent} in {entry.task} has {entry.steps:,} steps; a line needs fewer than earlier ones, here "
                f"than {earlier.steps:,}"
            )
    return entries


def row(entry: Entry) -> str:
    """Return an entry's row of the table.

    Raises SystemExit if a seed has no result, or for a rule that the entry breaks.
    """
    tasks, agents = (entry.task,), (entry.agent,)
    (runs,) = learning.stored_results(tasks=tasks, agents=agents, steps=entry.steps, seeds=SEEDS)[entry.task].values()
    if len(runs) < len(SEEDS):
        raise SystemExit(
            f"benchmarks/results has {len(runs)} of {len(SEEDS)} seeds of {entry.agent} in {entry.task}, "
            f"{entry.steps:,} steps"
        )
    scores = tables.final_scores(TASKS[entry.task].score, runs)  # (R, M, E)
    p_value = probability(scores.mean((1, 2)), entry.target)
    rules = {**rules_of(entry, runs), f"above {entry.target:g}: p = {p_value:.3f}": p_value < ALPHA}
    if broken := [rule for rule, holds in rules.items() if not holds]:
        raise SystemExit(f"{entry.agent} in {entry.task} is not {broken[0]}")
    cells = [
        entry.task,
        f"{entry.target:g}",
        f"`{entry.agent}`",
        tables.mean_and_error(scores),
        f"{max(p_value, SMALLEST_PRINTED):.4f}",
        f"{entry.steps / 1e6:g} M",
        f"{entry.date}, {entry.commit}",
    ]
    return f"| {' | '.join(cells)} |"


def rules_of(entry: Entry, runs: list[RunLog]) -> dict[str, bool]:
    """Return which of the rules of docs/results.md hold, but for those of the mean and of the steps."""
    task = TASKS[entry.task]
    args = learning.plan(learning.Training(steps=entry.steps), task, entry.agent, SEEDS[0]).args
    extra = args.step_encoding or args.observe_last_action
    return {
        "on default options": not task.options,
        "from vectors of what the image shows": args.obs_type == "vector" and not extra,
        "trained from the first step on": args.load_model is None,  # whose steps would not count
        "on the default levels": (args.start_level, args.num_levels) == (0, 100_000),  # else new ones are not known
        "scored on test levels": tables.are_tested(task.score, runs),
        "aimed at 0.9 of the best score": task.best_score is not None and entry.target == 0.9 * task.best_score,
    }


def probability(means: np.ndarray, target: float) -> float:
    """Return the p-value of seeds' means (R,) against a true mean at the target or below (Student's t-test)."""
    return float(scipy.stats.ttest_1samp(means, target, alternative="greater").pvalue)


def main() -> None:
    """Print the table. Raises SystemExit as `read_entries` and `row` do."""
    print("\n".join([HEADING, *map(row, read_entries())]))


if __name__ == "__main__":
    with one_line_exit(OSError, ValueError):
        tyro.cli(main)
