"""Score trained agents on levels that they have never seen, or draw their sample-efficiency curves.

    python evaluate.py runs/*/model.pt --json scores.json
    python evaluate.py runs/X/checkpoint-*.pt
    python evaluate.py --curves runs/* --out docs/curves
    python evaluate.py --curves runs/* --over time

Runs whose arguments differ in nothing but the seed are the seeds of one agent. Files of one run, written at different
steps of the training, are agents of their own. As in the thesis (6.1.2, 6.1.3), every seed plays 50 levels outside its
training set, three times each. An agent's score is the interquartile mean (IQM): the mean of the middle half of all
episodes of its seeds, as the thesis pools 750 of them. Beside it stands the IQM of the levels' means, which is another
number: where 70 % of the episodes succeed, the middle half has hardly a failure, but many levels have means below 1.
The 95 % interval is that of a bootstrap that resamples whole seeds: how far the IQM would move with other seeds. Of
three seeds it is about the range of their IQMs. A single seed has none. The thesis' bootstrap is stratified (6.1.2).

Shape letters: R seeds (training runs) of an agent, M levels, E episodes on each, I iterations of a run, P points of a
curve, B bootstrap resamples.
"""

import glob
import gzip
import itertools
import json
import logging
import math
import os
import re
import shutil
import sys
import tempfile
import textwrap
import zlib
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
import tyro
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
from tensorboard.util.tensor_util import make_ndarray
from tqdm import tqdm

from ppo_utils.checkpoints import FORMER_DEFAULTS, RENAMED, import_script, load_weights, read_model, saved_args
from ppo_utils.environments import envs_for, with_options
from ppo_utils.errors import RunError
from ppo_utils.evaluation import are_trained_on, evaluate, evaluation_levels, first_unseen, make_agent
from ppo_utils.flags import NonNegativeInt, PositiveInt, check_bounds

try:
    from matplotlib import color_sequences, rc_context
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.ticker import EngFormatter, StrMethodFormatter
    from scipy.stats import trim_mean
except ImportError as error:
    raise SystemExit(f'evaluate.py needs {error.name}: pip install -e ".[eval]"') from None

MOST_EPISODES = 100_000
AT_ONCE = 1000  # episodes; more would take much memory
# A family's own metric (6.1.3), by the beginning of the id; any other environment's is the return.
OWN_METRIC = {
    "MortarMayhem": "commands_completed",
    "Endless-MortarMayhem": "commands_completed",
    "MysteryPath": "success",
    "SearingSpotlights": "success",
    "Endless-SearingSpotlights": "coins_collected",
}
# Arguments that say how a run was started and recorded, not what learned.
BOOKKEEPING = {"preset", "seed", "torch_deterministic", "cuda", "track", "capture_video", "save_model", "resume"}
BOOKKEEPING |= {"checkpoint_interval", "eval_interval", "eval_levels", "eval_max_steps", "async_envs"}
RESAMPLES = 2000
LABEL_WIDTH = 48  # characters of a line in a legend; a longer one would leave no room for the curves
POINTS = 200  # of a curve; one that has more is averaged over neighbours
# Scalars of every iteration, in seconds: the first is the sum of the others. Evaluations are in none of them.
SECONDS = {name: f"charts/seconds_{name}" for name in ("iteration", "collect", "update")}
# Scalars that tell how an iteration's update went.
UPDATE_CURVES = ("losses/grad_norm", "losses/entropy", "charts/gradient_steps", "charts/learning_rate")


@dataclass
class Config:
    """Score checkpoints on unseen levels, or draw the curves of training runs."""

    checkpoints: tyro.conf.Positional[tuple[str, ...]] = ()
    """model files: model.pt that --save-model wrote, or those that were written during training"""
    levels: PositiveInt = 50
    """levels to play"""
    start_level: NonNegativeInt | None = None
    """the first of these levels (default: the first after those of the training; an agent that trained without a limit,
    --num-levels 0, has met none of the numbered levels)"""
    repeats: PositiveInt = 3
    """how often to play each level"""
    max_steps: PositiveInt = 10_000
    """steps after which an endless episode is cut short"""
    env_options: str | None = None
    """reset options of a Memory Gym environment as JSON, over those of the training"""
    deterministic: bool = False
    """take the most probable actions instead of drawing them"""
    seed: NonNegativeInt = 1
    """seed of the actions"""
    cuda: bool = True
    """play on the GPU when there is one"""
    json: str | None = None
    """write the scores to this file too, down to each episode's"""

    curves: tuple[str, ...] = ()
    """run folders whose curves to draw, instead of playing; or files, *.json.gz, that benchmarks/learning.py wrote"""
    over: Literal["steps", "time"] = "steps"
    """what curves are drawn over: environment steps, or hours of training without evaluations"""
    out: str = "curves"
    """draw to OUT.png and OUT.svg"""
    metrics: tuple[str, ...] = ()
    """what to show, e.g. return success (by default the family's own metric; of episodes that are played also return,
    length and falls)"""


# ---- STATISTICS ----
def iqm(scores: np.ndarray) -> np.ndarray:
    """Return the interquartile mean (...) of scores (..., R, M, E): without the lowest and the highest quarter.

    As many are left out as fit whole into a quarter: with three scores none, with five the lowest and the highest.
    """
    return trim_mean(scores.reshape(*scores.shape[:-3], -1), 0.25, axis=-1)


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


def interval(scores: np.ndarray) -> np.ndarray | None:
    """Return the ends (2, ...) of the IQM's 95 % bootstrap interval for scores (..., R, M, E); None for a single seed.

    Whole seeds are resampled (a cluster bootstrap): a drawn seed brings its scores on all levels along, for they come
    from the same weights. To draw other seeds for each level is right where each has been trained on by itself; here it
    makes the interval far too narrow wherever seeds differ, as benchmarks/interval_coverage.py shows. Of three seeds,
    one of 27 resamples has the worst seed three times, more than 2.5 %: the ends are about the lowest and the highest
    IQM of a seed.
    """
    seeds = scores.shape[-3]
    if seeds < 2:
        return None
    drawn = np.random.default_rng(0).integers(seeds, size=(RESAMPLES, seeds))  # (B, R)
    # Resamples of the same seeds are scored once, and one after the other: all at once would take much memory.
    different, which = np.unique(np.sort(drawn), axis=0, return_inverse=True)  # (U, R), (B,); in NumPy 2.0 (B, 1)
    iqms = np.stack([iqm(scores[..., each, :, :]) for each in different], axis=-1)  # (..., U)
    return np.percentile(iqms[..., which.ravel()], [2.5, 97.5], axis=-1)  # of (..., B)


def summary(agent: str, runs: dict[str, int | None], scores: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return what to report of an agent, for JSON: scores (R, M, E) by metric.

    runs: the paths in the order of the seeds, with the steps that each was trained for, None where that is not known.
    """
    metrics = {}
    for name, values in scores.items():
        metrics[name] = {"mean": float(values.mean())}
        for suffix, each in (("", values), ("_of_levels", values.mean(-1, keepdims=True))):
            ends = interval(each)
            metrics[name][f"iqm{suffix}"] = float(iqm(each))
            metrics[name][f"interval{suffix}"] = None if ends is None else ends.tolist()
        metrics[name]["scores"] = values.tolist()
    return {"agent": agent, "runs": [*runs], "steps": [*runs.values()], "metrics": metrics}


def table(agents: list[dict[str, Any]]) -> str:
    """Return the summaries as a Markdown table, the agents below each other for every metric.

    Below it is a line for each agent whose seeds were trained for different numbers of steps.
    """
    lines = [
        "| metric | agent | seeds | mean | IQM | 95 % interval | IQM of level means | 95 % interval |",
        "|---|---|---:|---:|---:|---|---:|---|",
    ]
    for metric in agents[0]["metrics"]:
        for agent in agents:
            score = agent["metrics"][metric]
            cells = [metric, agent["agent"], len(agent["runs"]), f"{score['mean']:.3f}"]
            for suffix in ("", "_of_levels"):
                ends = score[f"interval{suffix}"]
                cells += [f"{score[f'iqm{suffix}']:.3f}"]
                cells += ["none: one seed" if ends is None else "{:.3f} to {:.3f}".format(*ends)]
            lines.append(f"| {' | '.join(map(str, cells))} |")
    for agent in agents:
        if len({*agent["steps"]}) > 1:
            steps = ", ".join("an unknown number" if step is None else f"{step:,}" for step in agent["steps"])
            lines.append(f"\n{agent['agent']}: its seeds were trained for different numbers of steps: {steps}")
    return "\n".join(lines)


# ---- AGENTS ----
def task_of(args: dict[str, Any]) -> str:
    """Name what was learned: runs of another environment, or one made or reset with other arguments, do not compare."""
    given = [args[name] for name in ("env_options", "env_kwargs") if args.get(name, "{}") != "{}"]
    return " ".join([args["env_id"], *given])


def own_metric(env_id: str) -> str:
    """Return the name of the environment's own metric."""
    name = re.split("[:/]", env_id)[-1]  # without module and namespace
    return next((metric for start, metric in OWN_METRIC.items() if name.startswith(start)), "return")


def tasks_of(runs: dict[str, dict[str, Any]], title: Callable) -> dict[str, dict[str, list[str]]]:
    """Sort runs, arguments by path, into tasks and agents: the paths of an agent's seeds by title and label."""
    tasks = defaultdict(dict)
    for path, args in runs.items():
        for name in {"env_options", "env_kwargs"} & args.keys():  # one spelling
            args = args | {name: json.dumps(json.loads(args[name]), sort_keys=True)}
        tasks[title(args)][path] = args
    return {name: agents_of(members) for name, members in tasks.items()}


def agents_of(runs: dict[str, dict[str, Any]]) -> dict[str, list[str]]:
    """Put the runs that differ in nothing but the seed together; runs: their arguments by path.

    The arguments of a model file include the step of the training at which it was written, if that is known. Seeds of
    an agent may be at different steps; but where one seed is given at several, each step is an agent of its own.

    Raises ValueError if two of them have the same seed and step too, since they tell no more than one.
    """
    agents = defaultdict(dict)
    for path, args in runs.items():
        key = tuple(sorted((k, v) for k, v in args.items() if k not in BOOKKEEPING | {"step"}))
        members, place = agents[key], (args["seed"], args.get("step", "unknown"))
        if place in members:
            twin = members[place]
            raise ValueError(f"{path} is the same agent and seed, {args['seed']}, as {twin}; leave one of them out")
        members[place] = path
    found = []
    for members in agents.values():
        for step, paths in steps_apart(members).items():
            args = {name: value for name, value in runs[paths[0]].items() if name != "step"}
            found.append((args if step is None else args | {"step": step}, paths))
    return dict(zip(labels([args for args, _ in found]), [paths for _, paths in found], strict=True))


def steps_apart(members: dict[tuple[Any, Any], str]) -> dict[Any, list[str]]:
    """Sort an agent's paths, given by seed and step, by their step; all are under None if no seed is there twice."""
    if len({seed for seed, _ in members}) == len(members):
        return {None: list(members.values())}
    steps = sorted({step for _, step in members}, key=lambda step: (step == "unknown", step))
    return {step: [path for (_, each), path in members.items() if each == step] for step in steps}


def labels(agents: list[dict[str, Any]]) -> list[str]:
    """Name each agent by exp_name, and if these are not all different, by the arguments that are."""
    names = [args["exp_name"] for args in agents]
    if len(set(names)) == len(names):
        return names
    keys = dict.fromkeys(key for args in agents for key in args if key not in BOOKKEEPING)
    differ = [key for key in keys if differs(key, agents)]
    bare = {"exp_name", "script"}
    words = [[args[k] if k in bare else f"{k}={args[k]}" for k in differ if k in args] for args in agents]
    return [" ".join(dict.fromkeys(each)) or args["exp_name"] for each, args in zip(words, agents, strict=True)]


def differs(key: str, agents: list[dict[str, Any]]) -> bool:
    """Return whether an argument tells agents apart: by its values, or since some agents of a script lack it."""
    values = {args[key] for args in agents if key in args}
    scripts = {args["script"] for args in agents}
    having = [{key in args for args in agents if args["script"] == script} for script in scripts]
    return len(values) > 1 or any(len(each) > 1 for each in having)


# ---- CURVES ----
class NoCurvesError(ValueError):
    """A run that was stopped in its first iteration, or no run at all."""


@dataclass
class RunLog:
    """What a training run logged. A curve is steps (P,) and values (P, M, E), by the name of its TensorBoard scalar.

    Of evaluations it has every episode. Runs of earlier versions kept the levels' means (E = 1); of losses and training
    episodes there is one number a step (M = E = 1).
    """

    path: str
    args: dict[str, str]  # the script's name and its arguments, as text
    curves: dict[str, tuple[np.ndarray, np.ndarray]]
    machine: str = "not recorded"  # what trained it, if a file of `write_run` names it

    def seconds(self, name: str) -> np.ndarray:
        """Return the seconds (I,) of each iteration: a name in SECONDS."""
        return self.curves[SECONDS[name]][1][:, 0, 0]

    def hours(self, steps: np.ndarray) -> np.ndarray:
        """Return the hours (P,) that it had been training for at these steps (P,), interpolated within iterations."""
        ends = self.curves[SECONDS["iteration"]][0]
        return np.interp(steps, [0, *ends], [0, *np.cumsum(self.seconds("iteration")) / 3600])

    @property
    def last_step(self) -> int:
        """The last step that a curve has a point at."""
        return int(max(steps[-1] for steps, _ in self.curves.values()))

    def has_seconds(self) -> bool:
        """Return whether it has the seconds of its iterations, which runs of earlier versions do not have."""
        return set(SECONDS.values()) <= set(self.curves)


Runs = dict[str, list[RunLog]]  # the seeds of each agent, by its label


def read_run(path: str) -> RunLog:
    """Read a run folder's TensorBoard files, or a file of `write_run`; raise NoCurvesError if it holds none."""
    if path.endswith(".json.gz"):
        try:
            with gzip.open(path, "rt") as file:
                saved = json.load(file)
            curves = {name: (np.cumsum(steps), np.array(values)) for name, (steps, values) in saved["curves"].items()}
            machine = saved.get("machine", RunLog.machine)
            return RunLog(path, with_defaults(saved["args"]), curves, machine)
        except (KeyError, TypeError, AttributeError, ValueError, EOFError, zlib.error, gzip.BadGzipFile):
            raise NoCurvesError(f"{path} holds no curves of a training run") from None
    if not os.path.isdir(path):
        raise NoCurvesError(f"there is no run folder {path}")
    logging.getLogger("tensorboard").setLevel(logging.ERROR)  # it warns of a crash where a run was resumed
    events = read_events(path)
    tags = events.Tags()
    if not tags["scalars"] or "hyperparameters/text_summary" not in tags["tensors"]:
        if glob.glob(f"{path}/*.json.gz"):
            raise NoCurvesError(f"{path} is a folder of results; give the files themselves, as {path}/*.json.gz")
        raise NoCurvesError(f"{path} holds no curves of a training run")
    return RunLog(path, hyperparameters(events), event_curves(events))


def read_events(folder: str) -> EventAccumulator:
    """Read a run folder's TensorBoard files in the order of the steps that they begin at.

    That of their names is by the clocks of the machines that wrote them, one of which may have been behind.
    """
    with tempfile.TemporaryDirectory() as ordered:
        for number, path in enumerate(sorted(glob.glob(f"{glob.escape(folder)}/*tfevents*"), key=beginning)):
            shutil.copyfile(path, f"{ordered}/events.out.tfevents.{number:010}")
        events = EventAccumulator(ordered, size_guidance={"scalars": 0, "tensors": 0})
        events.Reload()
        return events


def beginning(path: str) -> tuple[int, float]:
    """Return the step that a TensorBoard file begins at, and the time of its first entry."""
    first = list(itertools.islice(EventFileLoader(path).Load(), 2))  # the version, then the step that was resumed at
    return max((event.step for event in first), default=0), min((event.wall_time for event in first), default=0.0)


def event_curves(events: EventAccumulator) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the curves in a run's TensorBoard files. There is no point where a scalar is not a finite number.

    Of steps that a resumed run played twice, the last count, and those that it has not played again do not.
    """
    points = {}  # by name, values (M, E) by step
    for name in events.Tags()["scalars"]:
        found = {point.step: np.full((1, 1), point.value) for point in events.Scalars(name)}
        points[name] = {step: value for step, value in found.items() if np.isfinite(value)}
    for name in events.Tags()["tensors"]:
        if name.startswith("eval_levels/"):
            means = name.replace("eval_levels/", "eval/")
            found = {point.step: make_ndarray(point.tensor_proto) for point in events.Tensors(name)}
            # The reader forgets what lies beyond the step of --resume, but of scalars only.
            points[means] = {
                step: scores.reshape(len(scores), -1) for step, scores in found.items() if step in points.get(means, ())
            }
    return {name: (np.array([*each]), stack_scores([*each.values()])) for name, each in points.items() if each}


def stack_scores(scores: list[np.ndarray]) -> np.ndarray:
    """Stack scores, (..., M, E) each; where only some have every episode, the levels' means (..., M, 1) of all.

    Where they have different levels too, which do not compare, the means over these, (..., 1, 1).
    """
    for axis in (-1, -2):
        if len({each.shape for each in scores}) > 1:
            scores = [each.mean(axis, keepdims=True) for each in scores]
    return np.stack(scores)


def hyperparameters(events: EventAccumulator) -> dict[str, str]:
    """Return a run's arguments as text, from the Markdown table in its TensorBoard file.

    A resumed run has written them more than once; the last ones count.
    """
    rows = events.Tensors("hyperparameters/text_summary")[-1].tensor_proto.string_val[0].decode().splitlines()[2:]
    return with_defaults(dict(row[1:-1].split("|", 1) for row in rows))


def with_defaults(given: dict[str, str]) -> dict[str, str]:
    """Return a run's arguments as today's version has them.

    An argument that is newer than the run has the value that it stood for then, or its default; one that no longer
    exists is left out.
    """
    name = given.get("script", "ppo_trxl" if "trxl_dim" in given else "ppo_gru")  # an older run does not say it
    try:
        defaults = asdict(import_script({"script": name}, name).Args())
    except ValueError:  # the script is not here
        defaults = given
    given = FORMER_DEFAULTS | {RENAMED.get(key, key): value for key, value in given.items()}
    return {"script": name} | {key: str(given.get(key, value)) for key, value in defaults.items()}


def write_run(run: RunLog, path: str) -> None:
    """Write what tables and pictures need, in a few KB; `read_run` reads it as it reads the run's folder.

    That is the machine, the arguments, the evaluations in the family's own metric, return, length and falls, those on
    test levels too, the seconds of each iteration, and the curves UPDATE_CURVES, averaged to POINTS. Steps are kept as
    differences, which compress better.
    """
    metrics = (own_metric(run.args["env_id"]), "return", "length", "num_fails")
    names = [f"{levels}/{name}" for levels in ("eval", "test") for name in metrics]
    kept = {name: run.curves[name] for name in (*dict.fromkeys(names), *SECONDS.values()) if name in run.curves}
    for name in UPDATE_CURVES:
        if name in run.curves:
            steps, values = align([run.curves[name]])  # (P,), (P, R, M, E) with R = M = E = 1
            kept[name] = steps, values[:, 0]
    four_digits = np.vectorize(lambda value: float(f"{value:.4g}"))  # also of small norms; scores have few digits
    curves = {
        name: (np.diff(steps, prepend=0).tolist(), (values if name in names else four_digits(values)).tolist())
        for name, (steps, values) in kept.items()
    }
    part = Path(f"{path}.part")
    try:
        with gzip.open(part, "wt") as file:
            json.dump({"machine": run.machine, "args": run.args, "curves": curves}, file, separators=(",", ":"))
        os.replace(part, path)  # a file that is there is complete
    finally:
        part.unlink(missing_ok=True)


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


def align(runs: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Bring curves, x (P,) and values (P, M, E) of each run, to a common x (P,): return it and scores (P, R, M, E).

    x is steps or hours. The common x is that of all runs, as far as every run reaches, at most POINTS. Between its own,
    a run has its last evaluation's scores: a mixture of two would have another IQM than either. Numbers that are means
    already (M = E = 1) are interpolated, and averaged over neighbours. Raises ValueError if the runs do not overlap.
    """
    first, last = max(x[0] for x, _ in runs), min(x[-1] for x, _ in runs)
    if first > last:
        raise ValueError("the curves of an agent's seeds do not overlap; leave out the shortest run")
    common = np.unique(np.concatenate([x for x, _ in runs]))
    common = common[(first <= common) & (common <= last)]
    parts = np.array_split(np.arange(len(common)), min(len(common), POINTS))
    if all(values[0].size == 1 for _, values in runs):
        curves = np.stack([np.interp(common, x, values[:, 0, 0]) for x, values in runs], axis=1)  # (all x, R)
        scores = np.stack([curves[part].mean(0) for part in parts])[..., None, None]
        return np.array([common[part].mean() for part in parts]), scores
    common = common[[part[-1] for part in parts]]  # (P,)
    latest = [values[np.searchsorted(x, common, side="right") - 1] for x, values in runs]  # of (P, M, E)
    return common, np.moveaxis(stack_scores(latest), 0, 1)


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
        "iqm": trim_mean(seconds, 0.25),
        "max": seconds.max(),
        **parts,
        "hours": np.mean([each.sum() for each in durations]) / 3600,
    }
    return {name: float(number) for name, number in numbers.items()}


def time_table(agents: list[dict[str, Any]]) -> str:
    """Return the wall times in the summaries of agents that have one as a Markdown table, an agent a row."""
    names = ("mean", "std", "min", "median", "IQM", "max", "collect", "update", "hours")
    lines = [f"| agent | seeds | {' | '.join(names)} |", f"|---|---:|{'---:|' * len(names)}"]
    for agent in agents:
        if "wall_time" in agent:
            cells = (agent["agent"], len(agent["runs"]), *(f"{agent['wall_time'][name.lower()]:.3f}" for name in names))
            lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def read_runs(config: Config) -> dict[str, RunLog]:
    """Read the runs; raise ValueError for one that cannot be drawn."""
    runs = {path: read_run(path) for path in dict.fromkeys(config.curves)}
    older = [path for path, run in runs.items() if not run.has_seconds()]
    if config.over == "time" and older:
        raise ValueError(
            f"{older[0]} has no {SECONDS['iteration']}, since an earlier version trained it; draw it --over steps, or "
            "leave it out"
        )
    return runs


def draw_curves(config: Config) -> list[dict[str, Any]]:
    """Draw a picture of each task and metric, the metrics side by side; print where the curves end, and return it.

    Wall times are printed and returned of the agents whose runs all have them.
    """
    runs_by_path = read_runs(config)
    paths = tasks_of({path: run.args for path, run in runs_by_path.items()}, task_of)
    tasks = {
        title: {label: [runs_by_path[path] for path in members] for label, members in agents.items()}
        for title, agents in paths.items()
    }
    metrics = {}
    for title, agents in tasks.items():
        first, *_ = itertools.chain(*agents.values())
        metrics[title] = config.metrics or (own_metric(first.args["env_id"]),)
    last = draw_tasks(tasks, config.out, metrics, config.over)
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


# ---- SCORES ----
@dataclass
class Checkpoint:
    """What a model file holds, read once."""

    path: str
    script: ModuleType  # that trained it
    saved: dict[str, Any]  # script, args and weights
    step: int | None  # of the training, at which it was written; None if the file does not tell
    args: Any  # the script's Args

    @classmethod
    def read(cls, path: str, env_options: str | None = None) -> "Checkpoint":
        """Read a file, to play with further reset options, JSON.

        Raises ValueError if it is no checkpoint, its script is not here or its environment does not have the options,
        OSError without a file.
        """
        saved = read_model(path)
        script = import_script(saved, path)
        # A file to resume from holds much more, which would stay in memory.
        needed = {name: saved[name] for name in ("script", "args", "weights")}
        args = with_options(saved_args(script.Args, saved), env_options)
        return cls(path, script, needed, saved.get("step"), args)

    def arguments(self) -> dict[str, Any]:
        """Return the arguments by name, with the script's name, and the step if it is known."""
        step = {} if self.step is None else {"step": self.step}
        return {"script": self.script.__name__, **asdict(self.args), **step}


def play(checkpoint: Checkpoint, config: Config) -> dict[str, np.ndarray]:
    """Let a checkpoint's agent play the levels; return numbers (M, E) by name.

    Raises what `make_envs` raises for an environment that is not there, ValueError for weights that do not fit.
    """
    args = checkpoint.args
    device = torch.device("cuda" if torch.cuda.is_available() and config.cuda else "cpu")
    levels = evaluation_levels(args, config.levels, config.repeats, config.start_level)
    agent, found = None, defaultdict(lambda: np.full(len(levels), np.nan))
    for start in range(0, len(levels), AT_ONCE):
        batch = levels[start : start + AT_ONCE]
        envs = envs_for(args, len(batch), asynchronous=False)  # a process for each episode would be many
        if agent is None:
            _, infos = envs.reset()
            agent = make_agent(checkpoint.script.Agent, envs, infos, args).to(device)
            load_weights(agent, checkpoint.saved, checkpoint.path)
            torch.manual_seed(config.seed)
        played = evaluate(agent, envs, batch, config.max_steps, amp=args.amp, deterministic=config.deterministic)
        envs.close()
        for name, numbers in played.items():
            found[name][start : start + AT_ONCE] = numbers
    return {name: numbers.reshape(config.levels, config.repeats) for name, numbers in found.items()}


def title_of(args: dict[str, Any], config: Config) -> str:
    """Name the task and the levels of it that are played."""
    training = SimpleNamespace(**args)
    first = first_unseen(training) if config.start_level is None else config.start_level
    trained_on = " (of its training)" if are_trained_on(training, first, config.levels) else ""
    levels = f"levels {first} to {first + config.levels - 1}{trained_on}, {config.repeats} times each"
    return f"{task_of(args)}, {levels}{', most probable actions' if config.deterministic else ''}"


def choose_metrics(wanted: tuple[str, ...], env_id: str, played: list[dict[str, np.ndarray]]) -> list[str]:
    """Return the metrics to report: those wanted, else the family's own, return, length and falls.

    Only what every episode reported can be averaged; one that was cut short has return and length so far, and no more.
    Raises ValueError for a wanted metric that they did not all report.
    """
    known = [name for name in played[0] if all(name in each and not np.isnan(each[name]).any() for each in played)]
    if unknown := [name for name in wanted if name not in known]:
        raise ValueError(f"not every episode reported {unknown[0]}; all reported {', '.join(known)}")
    usual = dict.fromkeys([own_metric(env_id), "return", "length", "num_fails"])
    return list(wanted) or [name for name in usual if name in known]


def score_checkpoints(config: Config) -> list[dict[str, Any]]:
    """Play the levels with every checkpoint's agent; print a table for each task, and return what is in it.

    A task that does not report the wanted metrics gets a line instead. Raises ValueError if none does.
    """
    checkpoints = {path: Checkpoint.read(path, config.env_options) for path in dict.fromkeys(config.checkpoints)}
    arguments = {path: checkpoint.arguments() for path, checkpoint in checkpoints.items()}
    tasks = tasks_of(arguments, lambda args: title_of(args, config))
    played = {path: play(each, config) for path, each in tqdm(checkpoints.items(), unit=" agents")}
    report = []
    for title, agents in tasks.items():
        paths = list(itertools.chain(*agents.values()))
        try:
            metrics = choose_metrics(config.metrics, arguments[paths[0]]["env_id"], [played[path] for path in paths])
        except ValueError as error:
            if len(tasks) == 1:
                raise
            print(f"{title}: {error}", file=sys.stderr)
            continue
        summaries = []
        for label, members in agents.items():
            scores = {name: np.stack([played[path][name] for path in members]) for name in metrics}  # (R, M, E) each
            summaries.append(summary(label, {path: checkpoints[path].step for path in members}, scores))
        finished = float(np.mean([played[path]["finished"] for path in paths]))
        report.append({"task": title, "finished": finished, "agents": summaries})
        print(f"{title}\n\n{table(summaries)}\n")
        if finished < 1:
            print(f"--max-steps cut {1 - finished:.2%} of the episodes; what only their end tells is left out\n")
    if not report:
        raise ValueError(f"no task reports {', '.join(config.metrics)}")
    return report


def check_numbers(config: Config) -> None:
    """Raise ValueError for the first number that cannot work."""
    check_bounds(config)
    if (episodes := config.levels * config.repeats) > MOST_EPISODES:
        raise ValueError(f"--levels x --repeats is {episodes}; at most {MOST_EPISODES} are played")


def main(config: Config) -> None:
    """Do what the command line asks for.

    Raises ValueError, OSError, ImportError, gymnasium.error.Error or RunError, each with one line for the user.
    """
    paths = {name: tuple(map(str, getattr(config, name))) for name in ("checkpoints", "curves")}  # a Path, from Python
    config = replace(config, **paths)
    if bool(config.checkpoints) == bool(config.curves):
        raise ValueError("give either checkpoints to play with (runs/*/model.pt), or --curves and run folders (runs/*)")
    check_numbers(config)
    if not os.path.basename(config.out):
        raise ValueError(f"--out {config.out} is a folder; give the files' name too, as {config.out}curves")
    if config.json is not None:
        if not os.path.isdir(os.path.dirname(config.json) or "."):
            raise ValueError(f"there is no folder {os.path.dirname(config.json)} to write to")
        if os.path.isdir(config.json):
            raise ValueError(f"--json {config.json} is a folder; give a file to write to")
    report = draw_curves(config) if config.curves else score_checkpoints(config)
    if config.json is not None:
        Path(config.json).write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    config = tyro.cli(Config)
    try:
        main(config)
    except (ValueError, OSError, ImportError, gym.error.Error, RunError) as error:
        sys.exit(f"evaluate.py: {' '.join(str(error).split())}")
    except KeyboardInterrupt:
        sys.exit(130)
