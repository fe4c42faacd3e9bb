"""Tables and pictures of what agents reached, and how they compare over several tasks.

Shape letters: R seeds, M levels, E episodes, P points of a curve, B resamples, T tasks.
"""

import csv
import functools
import itertools
import json
import math
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats
from matplotlib import color_sequences
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from ppo_utils.run_logs import RunLog, Runs, align
from ppo_utils.scores import RESAMPLES, iqm
from suites import COLORS, TASKS, Task

BOUNDS, THESIS, NEW_LEVELS = (Path(__file__).with_name(f"{name}.csv") for name in ("bounds", "thesis", "new_levels"))
ALPHA = 0.05  # significance level: agents differ if the p-value is below it
SHOWN = ("show_origin", "show_goal")  # options that change how a level looks, not what it is
RIVALS = ("no memory", "GRU")  # with which the others are compared over all tasks
DIFFER_FROM = ("GRU", "16 frames", "no memory")  # whom the others are compared with, all tasks tested at once
NAMES_APART = 0.075  # between the names beside the curves' ends, as a share of the axis


@dataclass(frozen=True)
class Bounds:
    """Mean scores on the test levels that benchmarks/bounds.py found."""

    random: float  # of random actions
    scripted: float  # of a player that sees the whole state


def read_bounds() -> dict[str, Bounds]:
    """Read what benchmarks/bounds.py wrote, by task."""
    with BOUNDS.open(newline="") as file:
        return {row["task"]: Bounds(float(row["random"]), float(row["scripted"])) for row in csv.DictReader(file)}


def read_thesis() -> dict[str, dict[str, str]]:
    """Read the interquartile means of GRU and TrXL that the thesis' text has, and their steps, by task."""
    with THESIS.open(newline="") as file:
        return {row["task"]: row for row in csv.DictReader(file)}


@functools.cache
def read_new_levels() -> dict[tuple[str, str], np.ndarray]:
    """Read what benchmarks/trained_paths.py wrote: for id and reset options, whether each test level (M,) is new."""
    with NEW_LEVELS.open(newline="") as file:
        rows = {row["task"]: np.array([*row["new"]]) == "1" for row in csv.DictReader(file)}
    return {(TASKS[task].env_id, json.dumps(TASKS[task].options)): new for task, new in rows.items()}


def scored_levels(env_id: str, options: dict[str, Any]) -> np.ndarray | None:
    """Return which test levels (M,) begin as none of the first 100,000; None for all, also where that is none."""
    without = {name: value for name, value in options.items() if name not in SHOWN}
    new = read_new_levels().get((env_id, json.dumps(without)))
    return new if new is not None and new.any() else None


def final_scores(name: str, runs: list[RunLog], every_level: bool = False) -> np.ndarray:
    """Return the scores (R, M, E) of the seeds' final weights, by the name of a metric or score.

    They are those on the test levels, or where a run has none, on the development levels. Test levels that begin as one
    of the training's are left out, unless `every_level` asks for them or there are no others.
    """
    levels = "test" if are_tested(name, runs) else "eval"
    scores = align([run.curves[f"{levels}/{name}"] for run in runs])[1][-1]
    args = runs[0].args
    first, count = int(args.get("start_level", 0)), int(args.get("num_levels", 0))
    if every_level or levels == "eval" or not count or first + count > 100_000:  # of those, it is not known
        return scores
    new = scored_levels(args["env_id"], json.loads(args["env_options"]))
    return scores if new is None else scores[:, new]


def are_tested(name: str, runs: list[RunLog]) -> bool:
    """Return whether all of the seeds have the metric or score on the test levels."""
    return all(f"test/{name}" in run.curves for run in runs)


def standard_error(scores: np.ndarray) -> float:
    """Return the standard error of the mean of scores (R, M, E), for other seeds and other levels.

    All seeds play the same levels, so the variance of the mean has two parts, `seed_variance` and that of the levels'
    means over M (a two-way model with random effects). A bootstrap over seeds and levels estimates the same, but with
    three seeds has two thirds of the first part. With one seed, NaN.
    """
    means = scores.mean(2)  # (R, M)
    return math.sqrt(seed_variance(means) + level_variance(means.mean(0))) if len(means) > 1 else math.nan


def seed_variance(means: np.ndarray) -> float:
    """Return the part of the variance of the mean of (R, M) that differences between seeds have.

    The seeds' means also vary by what a seed does on these levels more than on others. `level_variance` has that part
    too, so that it is subtracted here.
    """
    seeds, levels = means.shape
    alone = means - means.mean(1, keepdims=True) - means.mean(0) + means.mean()  # what only that seed and level have
    both = (alone**2).sum() / ((seeds - 1) * (levels - 1)) / means.size if levels > 1 else 0.0
    return max(means.mean(1).var(ddof=1) / seeds - both, 0.0)


def level_variance(means: np.ndarray) -> float:
    """Return the variance of the mean of levels (M,); of a single level, 0."""
    return means.var(ddof=1) / len(means) if len(means) > 1 else 0.0


def mean_and_error(scores: np.ndarray) -> str:
    """Return the mean of scores (R, M, E) with its standard error, if there are several seeds."""
    error = standard_error(scores)
    return f"{scores.mean():.2f}" + ("" if math.isnan(error) else f" ± {error:.2f}")


def minutes_of(runs: list[RunLog]) -> float:
    """Return the mean duration of trainings, without evaluations."""
    return float(np.mean([run.seconds("iteration").sum() for run in runs])) / 60


def best_of(task: Task, agents: Runs) -> float:
    """Return the best possible score, or where there is no bound the highest mean of these agents."""
    return task.best_score or max(float(final_scores(task.score, runs).mean()) for runs in agents.values() if runs)


@dataclass(frozen=True)
class Comparison:
    """Two agents' numbers: by how many standard errors the first one's mean is higher, and how likely by chance."""

    errors: float
    p_value: float  # two-sided
    interval: tuple[float, float] | None = None  # of the difference, of confidence 1 - ALPHA; None: one seed

    @property
    def is_ahead(self) -> bool:
        """Return whether the first one is decidedly higher."""
        return self.errors > 0 and self.p_value < ALPHA

    @classmethod
    def of(cls, higher: np.ndarray, lower: np.ndarray) -> "Comparison":
        """Compare numbers (R, M) of the seeds of two agents, which played the same M levels, by Welch's t-test.

        The variance of the difference has a part of each agent's seeds, and one of the levels' differences. Degrees of
        freedom are at most those of the seeds, whose variances are often estimated as 0 by chance. One seed tells
        nothing.
        """
        if min(len(higher), len(lower)) < 2:
            return cls(0.0, 1.0)
        levels = higher.mean(0) - lower.mean(0)  # (M,)
        parts = [seed_variance(higher), seed_variance(lower), level_variance(levels)]
        freedom = [len(higher) - 1, len(lower) - 1, max(len(levels) - 1, 1)]
        difference, variance = levels.mean(), sum(parts)
        if not variance:
            errors, p_value = (math.copysign(math.inf, difference), 0.0) if difference else (0.0, 1.0)
            return cls(errors, p_value, (difference, difference))
        error = math.sqrt(variance)
        of_all = variance**2 / sum(part**2 / each for part, each in zip(parts, freedom, strict=True))
        student = scipy.stats.t(min(of_all, freedom[0] + freedom[1]))
        margin = error * student.isf(ALPHA / 2)
        p_value = 2 * student.sf(abs(difference / error))
        return cls(difference / error, p_value, (difference - margin, difference + margin))


def holm(p_values: list[float]) -> list[bool]:
    """Return which of these p-values stand at a family-wise error of `ALPHA` (Holm, 1979)."""
    order = np.argsort(p_values)
    limits = ALPHA / np.arange(len(order), 0, -1)
    passed = np.cumprod(np.array(p_values)[order] <= limits).astype(bool)  # from the smallest to the first that fails
    return passed[np.argsort(order)].tolist()


# ---- ONE TASK ----
def table(task: Task, agents: Runs) -> str:
    """Return a task's table, a row for each agent that has runs, and below it what these took and on which machines."""
    runs_of = {agent: runs for agent, runs in agents.items() if runs}
    best = best_of(task, runs_of)
    every_run = [run for runs in runs_of.values() for run in runs]
    hours = sum(run.seconds("iteration").sum() for run in every_run) / 3600
    machines = "; ".join(dict.fromkeys(run.machine for run in every_run))
    taken = ("ahead of", "largest drop", "minutes to 0.5 of the best", "minutes to 0.9", "minutes")
    header = ("agent", "mean", "IQM", "each seed", *taken)
    lines = [
        f"{task.score} after {int(every_run[0].args['total_timesteps']):,} steps\n",
        f"| {' | '.join(header)} |",
        f"|{'|'.join('---' if name in ('agent', 'each seed', 'ahead of') else '---:' for name in header)}|",
        *(row(agent, runs_of, task, best) for agent in runs_of),
        f"\nRuns: {len(every_run)}, together {hours:.1f} hours without evaluations. Machines: {machines}",
    ]
    new = read_new_levels().get((task.env_id, json.dumps(task.options)))
    if new is not None and not new.any() and any(are_tested(task.score, runs) for runs in runs_of.values()):
        lines.append("No test level is new: each begins as one of the training's, so that all count")
    untested = [agent for agent, runs in runs_of.items() if not are_tested(task.score, runs)]
    if 0 < len(untested) < len(runs_of):
        lines.append(f"On development levels, so not comparable with the others: {', '.join(untested)}")
    return "\n".join(lines)


def row(agent: str, runs_of: Runs, task: Task, best: float) -> str:
    """Return the agent's row: its score, that of each seed, which agents it is ahead of, and how it learned.

    That is the largest drop, how far a seed's mean is below an earlier one, and the minutes to 0.5 and 0.9 of `best`,
    all on development levels.
    """
    runs = runs_of[agent]
    scores = final_scores(task.score, runs)  # (R, M, E)
    steps, curve = align([run.curves[f"eval/{task.score}"] for run in runs])  # (P,), (P, R, M, E)
    minutes = 60 * np.mean([run.hours(steps) for run in runs], 0)  # (P,)
    means = curve.mean((-2, -1))  # (P, R)
    drop = (np.maximum.accumulate(means) - means).max()
    cells = [agent, mean_and_error(scores), f"{iqm(scores):.2f}"]
    cells.append(", ".join(f"{mean:.2f}" for mean in scores.mean((1, 2))))
    cells.append(", ".join(other for other in runs_of if is_ahead(scores, final_scores(task.score, runs_of[other]))))
    cells.append(f"{drop:.2f}")
    for share in (0.5, 0.9):
        there = np.flatnonzero(means.mean(1) >= share * best)
        cells.append(f"{minutes[there[0]]:.1f}" if there.size and best else "")
    return f"| {' | '.join(cells)} | {minutes[-1]:.1f} |"


def is_ahead(scores: np.ndarray, others: np.ndarray) -> bool:
    """Return whether scores (R, M, E) are decidedly higher than others; on other levels, never."""
    if scores.shape[1] != others.shape[1]:
        return False
    return Comparison.of(scores.mean(2), others.mean(2)).is_ahead


# ---- ALL TASKS ----
def overview(tasks: dict[str, Runs], bounds: dict[str, Bounds], thesis: dict[str, dict[str, str]]) -> str:
    """Return a table with a row for each task: the mean score of each agent's final weights, and its standard error.

    Beside it stand the scores of random actions, of the scripted player and in the thesis, the steps of a training, and
    the minutes of the fastest and of the slowest agent. An agent's heading has its number of seeds, if others have
    another one, and so has a cell with fewer; where there is none, there is no number.
    """
    names = [*dict.fromkeys(agent for agents in tasks.values() for agent in agents)]
    seeds = {name: max(len(agents.get(name, [])) for agents in tasks.values()) for name in names}

    def count(runs: int) -> str:
        return f"{runs} seed{'s' * (runs > 1)}"

    def cell(agent: str, task: Task, runs: list[RunLog]) -> str:
        if not runs:
            return ""
        few = f", {count(len(runs))}" if len(runs) < seeds[agent] else ""
        return mean_and_error(final_scores(task.score, runs)) + few

    same = len({*seeds.values()} - {0}) == 1
    headings = [name if same or not seeds[name] else f"{name} ({count(seeds[name])})" for name in names]

    theirs = ["thesis: GRU, TrXL"] if tasks.keys() & thesis.keys() else []
    header = ["task, score", "steps", "random", *headings, "scripted", *theirs, "minutes"]
    lines = [f"| {' | '.join(header)} |", f"|---|{'---:|' * (len(header) - 1)}"]
    for name, agents in tasks.items():
        first = next(runs[0] for runs in agents.values() if runs)
        minutes = [minutes_of(runs) for runs in agents.values() if runs]
        known = bounds.get(name)
        cells = [
            f"{name}, {TASKS[name].score}",
            f"{int(first.args['total_timesteps']) / 1e6:.4g} M",
            f"{known.random:.2f}" if known else "",
            *(cell(agent, TASKS[name], agents.get(agent, [])) for agent in names),
            f"{known.scripted:.2f}" if known else "",
            *[", ".join(thesis[name][agent] for agent in ("GRU", "TrXL")) if name in thesis else "" for _ in theirs],
            " to ".join(dict.fromkeys(f"{each:.0f}" for each in (min(minutes), max(minutes)))),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def differing(tasks: dict[str, Runs]) -> str:
    """Return a line for each agent and each of DIFFER_FROM: where they differ, at a family-wise error of `ALPHA`."""
    names, lines = dict.fromkeys(agent for agents in tasks.values() for agent in agents), []
    for rival, name in itertools.product(DIFFER_FROM, names):
        if name == rival or name in DIFFER_FROM[: DIFFER_FROM.index(rival)]:  # which has that line
            continue
        p_values = {}
        for task, agents in tasks.items():
            if agents.get(name) and agents.get(rival):
                ours, theirs = (final_scores(TASKS[task].score, agents[each]).mean(2) for each in (name, rival))
                p_values[task] = Comparison.of(ours, theirs).p_value
        found = [task for task, differs in zip(p_values, holm([*p_values.values()]), strict=True) if differs]
        if len(p_values) > 1:
            which = f"{name} and {rival} differ, with {len(p_values)} tasks tested at once (Holm, 1979), in "
            lines.append(which + (", ".join(found) or "none"))
    return "\n".join(lines)


def aggregate(tasks: dict[str, Runs], bounds: dict[str, Bounds]) -> str:
    """Return a table over all tasks, one row per agent: its normalized IQM, how probably it is better than `RIVALS`.

    After Agarwal et al. (2021), "Deep Reinforcement Learning at the Edge of the Statistical Precipice". A seed's mean
    is normalized so that 0 is that of random actions and 1 the best (`best_of`); the IQM is over all tasks and seeds.
    The probability is that one seed is better than one of the rival's, averaged over tasks. Intervals, of 95 %, are
    those of a bootstrap that draws seeds for each task by itself. Only tasks that have bounds count. Return "" if they
    are fewer than two, or not all agents have equally many seeds in all of them.
    """
    tasks = {name: agents for name, agents in tasks.items() if name in bounds}
    counts = {len(runs) for agents in tasks.values() for runs in agents.values()}
    names = [*dict.fromkeys(agent for agents in tasks.values() for agent in agents)]
    if len(tasks) < 2 or len(names) < 2 or len(counts) != 1 or any([*agents] != names for agents in tasks.values()):
        return ""
    normalized = np.empty((len(names), len(tasks), *counts))  # (agents, T, R)
    for i, (name, agents) in enumerate(tasks.items()):
        low, high = bounds[name].random, best_of(TASKS[name], agents)
        means = np.array([final_scores(TASKS[name].score, runs).mean((1, 2)) for runs in agents.values()])
        normalized[:, i] = (means - low) / (high - low)
    seeds = normalized.shape[-1]
    drawn = np.random.default_rng(0).integers(seeds, size=(len(names), RESAMPLES, len(tasks), seeds))
    resampled = np.take_along_axis(normalized[:, None], drawn, -1)  # (agents, B, T, R)

    def cell(value: np.ndarray, values: np.ndarray) -> str:
        low, high = np.percentile(values, [2.5, 97.5])
        return f"{float(value):.2f} ({low:.2f} to {high:.2f})"

    rivals = [rival for rival in RIVALS if rival in names]
    header = ["agent", "normalized IQM", *(f"better than {rival}" for rival in rivals)]
    lines = [f"| {' | '.join(header)} |", f"|---|{'---:|' * (len(header) - 1)}"]
    for name, scores, resamples in zip(names, normalized, resampled, strict=True):
        cells = [cell(iqm(scores[..., None]), iqm(resamples[..., None]))]
        for rival in rivals:
            i = names.index(rival)
            same = rival == name
            cells.append("" if same else cell(better(scores, normalized[i]), better(resamples, resampled[i])))
        lines.append(f"| {' | '.join([name, *cells])} |")
    return "\n".join(lines)


def better(scores: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return how probably a seed of scores (..., T, R) is above one of the others' (..., T, R), averaged over tasks."""
    difference = scores[..., :, None] - others[..., None, :]  # (..., T, R, R)
    return (0.5 + 0.5 * np.sign(difference)).mean((-3, -2, -1))


# ---- PICTURE ----
def draw(tasks: dict[str, Runs], out: Path) -> None:
    """Draw each task's curves on development levels, the mean and its standard error, with names at their ends.

    An axis goes from 0 to the best possible score, or where there is no bound to a bit above the highest curve.
    """
    down = 1 if len(tasks) <= 3 else 2
    across = math.ceil(len(tasks) / down)
    figure = Figure(figsize=(4 * across, 3.2 * down), layout="constrained")
    grid = figure.subplots(down, across, squeeze=False).ravel()
    for axis in grid[len(tasks) :]:
        axis.remove()
    names = dict.fromkeys(agent for agents in tasks.values() for agent in agents)
    others = itertools.cycle(color_sequences["Dark2"])
    colors = {name: COLORS.get(name) or next(others) for name in names}
    for axis, (name, agents) in zip(grid, tasks.items(), strict=False):
        draw_task(axis, TASKS[name], {agent: runs for agent, runs in agents.items() if runs}, colors)
        axis.set_title(name, fontsize="medium")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)


def draw_task(axis: Axes, task: Task, agents: Runs, colors: dict[str, Any]) -> None:
    """Draw the curves of one task's agents."""
    ends, top = {}, 0.0
    for agent, runs in agents.items():
        x, scores = align([run.curves[f"eval/{task.score}"] for run in runs])  # (P,), (P, R, M, E)
        means = scores.mean((1, 2, 3))
        errors = np.nan_to_num([standard_error(each) for each in scores])
        axis.plot(x, means, color=colors[agent], linewidth=1.5)
        axis.fill_between(x, means - errors, means + errors, color=colors[agent], alpha=0.2, linewidth=0)
        ends[agent], top = (x[-1], means[-1]), max(top, (means + errors).max())
    top = task.best_score or top or 1.0
    axis.set(xlabel="steps", ylabel=task.score, ylim=(0, top))
    axis.margins(x=0)
    axis.xaxis.set_major_formatter(EngFormatter(sep=" "))
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)
    places = spread([y / top for _, y in ends.values()], NAMES_APART)
    for (agent, end), place in zip(ends.items(), places, strict=True):
        where = {"xytext": (1.05, place), "textcoords": "axes fraction", "annotation_clip": False, "va": "center"}
        line = {"arrowstyle": "-", "color": colors[agent], "linewidth": 0.6, "shrinkA": 0, "shrinkB": 0}
        axis.annotate(textwrap.fill(agent, 28), end, **where, color=colors[agent], fontsize="small", arrowprops=line)


def spread(places: list[float], apart: float) -> list[float]:
    """Return places on an axis from 0 to 1, moved up or down so that neighbours are at least so far apart."""
    order = np.argsort(places, kind="stable")
    found = np.array(places, float)[order]
    for i in range(1, len(found)):
        found[i] = max(found[i], found[i - 1] + apart)
    if found.size and found[-1] > 1:  # push down from the top
        found[-1] = 1
        for i in reversed(range(len(found) - 1)):
            found[i] = min(found[i], found[i + 1] - apart)
    return found[np.argsort(order)].tolist()
