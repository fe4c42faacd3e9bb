"""Sample-efficiency curves of training runs: pictures, and tables of where they end and how long they took.

Shape letters: R seeds (training runs) of an agent, M levels, E episodes on each, P points of a curve.
"""

import itertools
import math
import textwrap
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from ppo_utils.run_logs import SECONDS, RunLog, Runs, align, read_run
from ppo_utils.scores import interval, iqm, own_metric, summary, table, task_of, tasks_of

try:
    from matplotlib import color_sequences, rc_context
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.ticker import EngFormatter, StrMethodFormatter
except ImportError as error:
    raise ImportError(f'to draw needs {error.name}: pip install -e ".[eval]"') from None

LABEL_WIDTH = 48  # characters of a line in a legend; a longer one would leave no room for the curves


def draw_curves(
    folders: tuple[str, ...], out: str = "curves", wanted: tuple[str, ...] = (), over: str = "steps"
) -> list[dict[str, Any]]:
    """Draw a picture of each task and metric, the metrics side by side; print where the curves end, and return it.

    wanted: the metrics, by default the family's own. Wall times are printed and returned of the agents whose runs all
    have them.
    """
    runs_by_path = read_runs(folders, over)
    paths = tasks_of({path: run.args for path, run in runs_by_path.items()}, task_of)
    tasks = {
        title: {label: [runs_by_path[path] for path in members] for label, members in agents.items()}
        for title, agents in paths.items()
    }
    metrics = {}
    for title, agents in tasks.items():
        first, *_ = itertools.chain(*agents.values())
        metrics[title] = wanted or (own_metric(first.args["env_id"]),)
    last = draw_tasks(tasks, out, metrics, over)
    report = []
    for title, agents in tasks.items():
        summaries = [
            summary(label, {run.path: run.last_step for run in runs}, last[title][label])
            for label, runs in agents.items()
        ]
        for each in summaries:
            if all(run.has_seconds() for run in agents[each["agent"]]):
                each["wall_time"] = wall_time(agents[each["agent"]])
        report.append({"task": title, "agents": summaries})
        print(f"{title}, where the curves end\n\n{table(summaries)}\n")
        names = next(iter(last[title].values()))  # of the curves, the same for all agents
        if any(lacks_episodes(run, name) for run in itertools.chain(*agents.values()) for name in names):
            print("earlier versions kept the levels' means only: the IQM of runs that they trained is that of these\n")
        if any("wall_time" in each for each in summaries):
            print(f"{title}, seconds of an iteration and hours of a training\n\n{time_table(summaries)}\n")
    return report


def read_runs(folders: tuple[str, ...], over: str) -> dict[str, RunLog]:
    """Read the runs; raise ValueError for one that cannot be drawn over steps or time."""
    runs = {path: read_run(path) for path in dict.fromkeys(folders)}
    older = [path for path, run in runs.items() if not run.has_seconds()]
    if over == "time" and older:
        raise ValueError(
            f"{older[0]} has no {SECONDS['iteration']}, since an earlier version trained it; draw it --over steps, or "
            "leave it out"
        )
    return runs


def curve_name(metric: str, runs: list[RunLog]) -> str:
    """Return the curve that shows the metric in every one of the runs, of evaluations rather than training episodes.

    Raises ValueError if there is none.
    """
    common = set.intersection(*(set(run.curves) for run in runs))
    for name in (metric, f"eval/{metric}", f"episode/{metric}", f"charts/episodic_{metric}"):
        if name in common:
            return name
    known = ", ".join(sorted(name for name in common if name.startswith(("eval/", "episode/", "charts/episodic_"))))
    raise ValueError(
        f"the runs of {task_of(runs[0].args)} have no curve of {metric} in common; they all have "
        f"{known or 'none of an episode yet'}"
    )


@rc_context({"text.parse_math": False})  # a name may have a $
def draw_tasks(
    tasks: dict[str, Runs], out: str, metrics: dict[str, tuple[str, ...]], over: str = "steps"
) -> dict[str, dict[str, dict[str, np.ndarray]]]:
    """Draw each task and metric to OUT.png and OUT.svg; tasks: the runs by the task's title and agent's label.

    Metrics are by title, as many for each task. Return the last scores (R, M, E) by title, label and name of the curve.
    """
    labels = dict.fromkeys(itertools.chain(*tasks.values()))
    looks = itertools.cycle(itertools.product(("-", "--", ":"), color_sequences["tab10"]))
    styles = {label: {"linestyle": line, "color": color} for label, (line, color) in zip(labels, looks, strict=False)}
    figure, grid = blank_pictures(len(tasks), max(map(len, metrics.values())))
    last = defaultdict(lambda: defaultdict(dict))
    for axes, (title, agents) in zip(grid, tasks.items(), strict=True):
        every_run = list(itertools.chain(*agents.values()))
        for axis, metric in zip(axes, metrics[title], strict=True):
            name = curve_name(metric, every_run)
            for label, scores in draw_metric(axis, name, agents, styles, over).items():
                last[title][label][name] = scores
        axes[0].set_title(textwrap.fill(title, 55 * len(axes)), loc="left", fontsize="medium")
    add_legend(figure, tasks, styles)
    figure.draw_without_rendering()  # the layout changes the ticks, and these the layout
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    for name in (f"{out}.png", f"{out}.svg"):
        figure.savefig(name, dpi=150)
    return last


def blank_pictures(tasks: int, metrics: int) -> tuple[Figure, np.ndarray]:
    """Return a figure and its axes (tasks, metrics).

    With one metric, up to three tasks are side by side; with several, each task has a row.
    """
    across = min(tasks, 2 if tasks <= 4 else 3) if metrics == 1 else 1
    down = math.ceil(tasks / across)
    figure = Figure(figsize=(5.5 * across * metrics, 3.8 * down), layout="constrained")
    grid = figure.subplots(down, across * metrics, squeeze=False).reshape(-1, metrics)
    for axis in grid[tasks:].flat:
        axis.remove()
    return figure, grid[:tasks]


def draw_metric(
    axis: Axes, name: str, agents: Runs, styles: dict[str, dict], over: str = "steps"
) -> dict[str, np.ndarray]:
    """Draw a curve of every agent, its runs by label, over steps or time; return each one's last scores (R, M, E)."""
    last = {}
    for label, runs in agents.items():
        curves = [run.curves[name] for run in runs]
        if over == "time":
            curves = [(run.hours(steps), values) for run, (steps, values) in zip(runs, curves, strict=True)]
        x, scores = align(curves)
        marker = "o" if len(x) == 1 else None  # a line of one point is not to be seen
        axis.plot(x, iqm(scores), marker=marker, **styles[label])
        if len(runs) > 1:
            axis.fill_between(x, *interval(scores), color=styles[label]["color"], alpha=0.2, linewidth=0)
        last[label] = scores[-1]
    axis.set(xlabel="steps" if over == "steps" else "hours of training", ylabel=name)
    # 2 M steps are 2,000,000, but 20 m hours would be 0.02.
    axis.xaxis.set_major_formatter(EngFormatter(sep=" ") if over == "steps" else StrMethodFormatter("{x:g}"))
    axis.grid(alpha=0.3)
    return last


def add_legend(figure: Figure, tasks: dict[str, Runs], styles: dict[str, dict]) -> None:
    """Add one legend for all tasks below their pictures, with the number of each agent's seeds."""
    lines, texts = [], []
    for label in styles:
        counts = [len(agents[label]) for agents in tasks.values() if label in agents]
        least, most = min(counts), max(counts)
        seeds = f"{most} seed{'s' * (most > 1)}" if least == most else f"{least} to {most} seeds"
        lines.append(Line2D([], [], **styles[label]))
        texts.append(textwrap.fill(f"{label}, {seeds}", LABEL_WIDTH, break_on_hyphens=False))
    widest = 0.8 + 0.085 * max(len(line) for text in texts for line in text.splitlines())  # inches
    columns = max(1, int(figure.get_figwidth() / widest))
    figure.set_figheight(figure.get_figheight() + 0.22 * sum(text.count("\n") + 1 for text in texts) / columns)
    figure.legend(lines, texts, loc="outside lower left", ncols=columns, frameon=False)


def lacks_episodes(run: RunLog, name: str) -> bool:
    """Return whether a run has been evaluated several times on each level, but kept the levels' means only."""
    return name.startswith("eval/") and run.curves[name][1].shape[2] == 1


def wall_time(runs: list[RunLog]) -> dict[str, float]:
    """Return an agent's wall time by name, for JSON, as in the thesis' tables 6.3 and 6.4.

    mean to max: seconds of one iteration, over all iterations of all runs. collect, update: means of its two parts.
    hours: the mean duration of a training.
    """
    durations = [run.seconds("iteration") for run in runs]
    seconds = np.concatenate(durations)  # of all runs' iterations
    parts = {name: np.concatenate([run.seconds(name) for run in runs]).mean() for name in ("collect", "update")}
    numbers = {
        "mean": seconds.mean(),
        "std": seconds.std(),
        "min": seconds.min(),
        "median": np.median(seconds),
        "iqm": iqm(seconds[None, None]),
        "max": seconds.max(),
        **parts,
        "hours": np.mean([each.sum() for each in durations]) / 3600,
    }
    return {name: float(number) for name, number in numbers.items()}


def time_table(agents: list[dict[str, Any]]) -> str:
    """Return the wall times in the summaries of agents that have one as a Markdown table, one row per agent."""
    names = ("mean", "std", "min", "median", "IQM", "max", "collect", "update", "hours")
    lines = [f"| agent | seeds | {' | '.join(names)} |", f"|---|---:|{'---:|' * len(names)}"]
    for agent in agents:
        if "wall_time" in agent:
            cells = (agent["agent"], len(agent["runs"]), *(f"{agent['wall_time'][name.lower()]:.3f}" for name in names))
            lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)
