"""Score trained agents on levels that they have never seen, or draw their sample-efficiency curves.

    python evaluate.py runs/*/model.pt --json scores.json
    python evaluate.py --curves runs/* --out docs/curves

Runs whose arguments differ in nothing but the seed are the seeds of one agent. As in the thesis (6.1.2, 6.1.3), every
seed plays 50 levels outside its training set, three times each. An agent's score is the interquartile mean (IQM): the
mean of the middle half of what its seeds scored on the levels. The 95 % interval is a stratified bootstrap's over the
seeds: how far the IQM would move with other seeds. A single seed cannot tell, and has none.

Shape letters: R seeds (training runs) of an agent, M levels, P points of a curve, B bootstrap resamples.
"""

import importlib
import itertools
import json
import os
import sys
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

try:
    from matplotlib import color_sequences
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter
    from scipy.stats import trim_mean
except ImportError as error:
    raise SystemExit(f'evaluate.py needs {error.name}: pip install -e ".[eval]"') from None

# A family's own metric (6.1.3), by the beginning of the id; any other environment's is the return.
OWN_METRIC = {
    "MortarMayhem": "commands_completed",
    "Endless-MortarMayhem": "commands_completed",
    "MysteryPath": "success",
    "SearingSpotlights": "success",
    "Endless-SearingSpotlights": "coins_collected",
}
# Arguments that say how a run was started and recorded, not what learned.
BOOKKEEPING = {"seed", "torch_deterministic", "cuda", "track", "wandb_project_name", "wandb_entity", "capture_video"}
BOOKKEEPING |= {"save_model", "eval_interval", "eval_levels", "eval_repeats", "eval_max_steps"}
RESAMPLES = 2000
POINTS = 200  # of a curve; one that has more is averaged over neighbours


@dataclass
class Config:
    """Score checkpoints on unseen levels, or draw the curves of training runs."""

    checkpoints: tyro.conf.Positional[tuple[str, ...]] = ()
    """model.pt files that --save-model wrote"""
    levels: int = 50
    """levels to play: those that follow the training levels, from start_level + num_levels on"""
    repeats: int = 3
    """how often to play each level"""
    max_steps: int = 10_000
    """steps after which an endless episode is cut short"""
    seed: int = 1
    """seed of the actions"""
    cuda: bool = True
    """play on the GPU when there is one"""
    json: str | None = None
    """write the scores to this file too, down to each seed's mean on each level"""

    curves: tuple[str, ...] = ()
    """run folders whose curves to draw, instead of playing"""
    out: str = "curves"
    """draw to OUT.png and OUT.svg"""
    metrics: tuple[str, ...] = ()
    """what to show, e.g. return success (by default the family's own metric, when playing also return and length)"""


# ---- STATISTICS ----
def iqm(scores: np.ndarray) -> np.ndarray:
    """Return the interquartile mean (...) of scores (..., R, M): the mean without the lowest and the highest quarter.

    As many are left out as fit whole into a quarter: with three scores none, with five the lowest and the highest.
    """
    return trim_mean(scores.reshape(*scores.shape[:-2], -1), 0.25, axis=-1)


def interval(scores: np.ndarray) -> np.ndarray | None:
    """Return the ends (2, ...) of the IQM's 95 % bootstrap interval for scores (..., R, M); None for a single seed.

    Levels are the strata: a resample has R scores of each. A drawn seed brings its scores on all levels along, for they
    come from the same weights. To draw anew for each level, as if every level had been trained on by itself, makes
    intervals several times too narrow: see benchmarks/interval_coverage.py.
    """
    seeds = scores.shape[-2]
    if seeds < 2:
        return None
    drawn = np.random.default_rng(0).integers(seeds, size=(RESAMPLES, seeds))  # (B, R)
    return np.percentile(iqm(scores[..., drawn, :]), [2.5, 97.5], axis=-1)  # of (..., B, R, M)


def summary(agent: str, paths: list[str], scores: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return what to report of an agent, for JSON: scores (R, M) by metric, paths in the order of the seeds."""
    metrics = {}
    for name, values in scores.items():
        ends = interval(values)
        metrics[name] = {
            "mean": float(values.mean()),
            "iqm": float(iqm(values)),
            "interval": None if ends is None else ends.tolist(),
            "scores": values.tolist(),
        }
    return {"agent": agent, "seeds": paths, "metrics": metrics}


def table(agents: list[dict[str, Any]]) -> str:
    """Return the summaries as a Markdown table, the agents below each other for every metric."""
    lines = ["| metric | agent | seeds | mean | IQM | 95 % interval |", "|---|---|---:|---:|---:|---|"]
    for metric in agents[0]["metrics"]:
        for agent in agents:
            score = agent["metrics"][metric]
            ends = "none: one seed" if score["interval"] is None else "{:.3f} to {:.3f}".format(*score["interval"])
            cells = (metric, agent["agent"], len(agent["seeds"]), f"{score['mean']:.3f}", f"{score['iqm']:.3f}", ends)
            lines.append("| {} | {} | {} | {} | {} | {} |".format(*cells))
    return "\n".join(lines)


# ---- AGENTS ----
def task_of(args: dict[str, str]) -> str:
    """Name what was learned: runs of another environment, or with other reset parameters, do not compare."""
    options = args.get("env_options", "{}")
    return args["env_id"] + (f" {options}" if options != "{}" else "")


def own_metric(env_id: str) -> str:
    """Return the name of the environment's own metric."""
    name = env_id.rpartition(":")[2]
    return next((metric for start, metric in OWN_METRIC.items() if name.startswith(start)), "return")


def tasks_of(runs: dict[str, dict[str, str]], title: Callable) -> dict[str, dict[str, list[str]]]:
    """Sort runs, arguments by path, into tasks and agents: the paths of an agent's seeds by title and label."""
    tasks = defaultdict(dict)
    for path, args in runs.items():
        tasks[title(args)][path] = args
    return {name: agents_of(members) for name, members in tasks.items()}


def agents_of(runs: dict[str, dict[str, str]]) -> dict[str, list[str]]:
    """Put the runs that differ in nothing but the seed together; runs: their arguments by path.

    Raises ValueError if two of them have the same seed too, since they tell no more than one.
    """
    agents = defaultdict(dict)
    for path, args in runs.items():
        seeds = agents[tuple(sorted((k, v) for k, v in args.items() if k not in BOOKKEEPING))]
        if args["seed"] in seeds:
            twin = seeds[args["seed"]]
            raise ValueError(f"{path} is the same agent and seed, {args['seed']}, as {twin}; leave one of them out")
        seeds[args["seed"]] = path
    members = [list(seeds.values()) for seeds in agents.values()]
    return dict(zip(labels([runs[paths[0]] for paths in members]), members, strict=True))


def labels(agents: list[dict[str, str]]) -> list[str]:
    """Name each agent by exp_name, and if these are not all different, by the arguments that are."""
    names = [args["exp_name"] for args in agents]
    if len(set(names)) == len(names):
        return names
    keys = dict.fromkeys(key for args in agents for key in args if key not in BOOKKEEPING)
    differ = [key for key in keys if len({args[key] for args in agents if key in args}) > 1]
    bare = {"exp_name", "script"}
    words = [[args[k] if k in bare else f"{k}={args[k]}" for k in differ if k in args] for args in agents]
    return [" ".join(dict.fromkeys(each)) for each in words]


# ---- CURVES ----
def read_run(folder: str) -> EventAccumulator:
    """Read a run folder's TensorBoard file; raise ValueError if there is none or it holds no curves."""
    if not os.path.isdir(folder):
        raise ValueError(f"there is no run folder {folder}")
    events = EventAccumulator(folder, size_guidance={"scalars": 0})
    events.Reload()
    tags = events.Tags()
    if not tags["scalars"] or "hyperparameters/text_summary" not in tags["tensors"]:
        raise ValueError(f"{folder} holds no curves of a training run")
    return events


def hyperparameters(events: EventAccumulator) -> dict[str, str]:
    """Return a run's arguments as text, from the Markdown table that its TensorBoard file begins with."""
    rows = events.Tensors("hyperparameters/text_summary")[0].tensor_proto.string_val[0].decode().splitlines()[2:]
    args = dict(row[1:-1].split("|", 1) for row in rows)
    return {"script": "ppo_trxl" if "trxl_dim" in args else "ppo_gru"} | args


def curve_name(metric: str, runs: list[EventAccumulator]) -> str:
    """Return the scalar that shows the metric in every one of the runs, of evaluations rather than training episodes.

    Raises ValueError if there is none.
    """
    common = set.intersection(*(set(run.Tags()["scalars"]) for run in runs))
    for name in (metric, f"eval/{metric}", f"episode/{metric}", f"charts/episodic_{metric}"):
        if name in common:
            return name
    known = ", ".join(sorted(name for name in common if name.startswith(("eval/", "episode/", "charts/episodic_"))))
    raise ValueError(f"the runs have no curve of {metric} in common; they all have {known or 'none of an episode yet'}")


def align(runs: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Bring curves (steps, values) to common steps (P,): return these and scores (P, R, 1).

    The steps are those of all runs, as far as every run reaches; between its own, a run's values are interpolated.
    """
    first, last = max(steps[0] for steps, _ in runs), min(steps[-1] for steps, _ in runs)
    if first > last:
        raise ValueError("the curves of an agent's seeds have no steps in common; leave out the shortest run")
    steps = np.unique(np.concatenate([steps for steps, _ in runs]))
    steps = steps[(first <= steps) & (steps <= last)]
    scores = np.stack([np.interp(steps, *run) for run in runs], axis=-1)  # (points, R)
    parts = np.array_split(np.arange(len(steps)), min(len(steps), POINTS))
    return np.array([steps[part].mean() for part in parts]), np.stack([scores[part].mean(0) for part in parts])[..., None]


def draw_metric(axis: Axes, name: str, agents: dict[str, list[EventAccumulator]]) -> dict[str, np.ndarray]:
    """Draw the scalar of every agent, seeds by label; return each one's last scores (R, 1)."""
    last = {}
    for color, (label, runs) in zip(itertools.cycle(color_sequences["petroff10"]), agents.items()):
        points = [run.Scalars(name) for run in runs]
        steps, scores = align([(np.array([p.step for p in run]), np.array([p.value for p in run])) for run in points])
        axis.plot(steps, iqm(scores), color=color, label=f"{label}, {len(runs)} seed{'s' * (len(runs) > 1)}")
        if (band := interval(scores)) is not None:
            axis.fill_between(steps, *band, color=color, alpha=0.2, linewidth=0)
        last[label] = scores[-1]
    axis.set(xlabel="steps", ylabel=name)
    axis.xaxis.set_major_formatter(EngFormatter(sep=" "))
    axis.grid(alpha=0.3)
    axis.legend(frameon=False)
    return last


def draw_curves(config: Config) -> None:
    """Write the picture, a row for each task and a column for each metric, and print where the curves end."""
    events = {path: read_run(path) for path in dict.fromkeys(config.curves)}
    tasks = tasks_of({path: hyperparameters(run) for path, run in events.items()}, task_of)
    columns = len(config.metrics) or 1
    figure = Figure(figsize=(5.5 * columns, 3.6 * len(tasks)), layout="constrained")
    rows = figure.subplots(len(tasks), columns, squeeze=False)
    for axes, (title, agents) in zip(rows, tasks.items(), strict=True):
        runs = {label: [events[path] for path in paths] for label, paths in agents.items()}
        last = defaultdict(dict)
        for axis, metric in zip(axes, config.metrics or [own_metric(title)], strict=True):
            name = curve_name(metric, [run for each in runs.values() for run in each])
            axis.set_title(title, wrap=True)
            for label, scores in draw_metric(axis, name, runs).items():
                last[label][name] = scores
        print(f"{title}, where the curves end\n")
        print(table([summary(label, paths, last[label]) for label, paths in agents.items()]), end="\n\n")
    for name in (f"{config.out}.png", f"{config.out}.svg"):
        figure.savefig(name, dpi=150)
        print(f"wrote {name}")


# ---- SCORES ----
def load_args(path: str) -> tuple[Any, dict[str, str]]:
    """Return the script that trained a checkpoint, and its arguments as text; raise ValueError if it is none."""
    draw_curves(config)


def play_levels(script, path, config):
    draw_curves(config)


def score_checkpoints(config: Config) -> None:
    """Play the levels with every checkpoint's agent; print a table for each task, and write the JSON file."""
    draw_curves(config)


def main(config: Config) -> None:
    """Do what the command line asks for; raise ValueError or OSError, in one line for the user, if that cannot be."""
    if bool(config.checkpoints) == bool(config.curves):
        raise ValueError("give checkpoints to score (runs/*/model.pt) or --curves with run folders to draw")
    draw_curves(config)


if __name__ == "__main__":
    try:
        main(tyro.cli(Config))
    except (ValueError, OSError, ImportError, gym.error.Error) as error:
        sys.exit(f"evaluate.py: {' '.join(str(error).split())}")
