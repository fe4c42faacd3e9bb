"""Score trained agents on other levels than those of their training, or draw their sample-efficiency curves.

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

Shape letters: R seeds (training runs) of an agent, M levels, E episodes on each.
"""

import itertools
import json
import os
import sys
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
import tyro
from tqdm import tqdm

from ppo_utils.checkpoints import Checkpoint
from ppo_utils.environments import envs_for, is_memory_gym
from ppo_utils.errors import RunError
from ppo_utils.evaluation import are_trained_on, count_trained_on, evaluate, evaluation_levels, first_after
from ppo_utils.flags import NonNegativeInt, PositiveInt, check_bounds
from ppo_utils.runs import report_out_of_memory
from ppo_utils.scores import bare_id, own_metric, summary, table, task_of, tasks_of
from ppo_utils.terminal import one_line_exit, open_streams

MOST_EPISODES = 100_000
AT_ONCE = 1000  # episodes; more would take much memory
MOST_COUNTED = 100_000  # levels of a training, which take ten seconds


@dataclass
class Config:
    """Score checkpoints on other levels than the training's, or draw the curves of training runs."""

    checkpoints: tyro.conf.Positional[tuple[str, ...]] = ()
    """model files: model.pt that --save-model wrote, or those that were written during training"""
    levels: PositiveInt = 50
    """levels to play"""
    start_level: NonNegativeInt | None = None
    """the first of these levels (default: the first after those of the training; an agent that trained without a limit,
    --num-levels 0, has met none of the numbered levels)"""
    new_levels: bool = False
    """of these levels, play only those that begin as none of the training's does: two levels may have the same path;
    not with --env-options, under which the training's are others"""
    repeats: PositiveInt = 3
    """how often to play each level"""
    max_steps: PositiveInt = 10_000
    """steps after which an endless episode is cut short"""
    env_options: str | None = None
    """reset options of a Memory Gym environment as JSON, over those of the training"""
    deterministic: bool = False
    """take the most probable actions instead of sampling them"""
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
    length and num_fails)"""


def play(checkpoint: Checkpoint, config: Config) -> dict[str, np.ndarray]:
    """Let a checkpoint's agent play the levels; return numbers (M, E) by name.

    Raises what `make_envs` raises for an environment that is not there, ValueError for weights that do not fit.
    """
    args = checkpoint.args
    device = torch.device("cuda" if torch.cuda.is_available() and config.cuda else "cpu")
    levels = evaluation_levels(args, config.levels, config.repeats, config.start_level, config.new_levels)
    agent, found = None, defaultdict(lambda: np.full(len(levels), np.nan))
    for start in range(0, len(levels), AT_ONCE):
        batch = levels[start : start + AT_ONCE]
        with report_out_of_memory(config, device):
            envs = envs_for(args, len(batch), asynchronous=False)  # a process for each episode would be many
            if agent is None:
                agent = checkpoint.agent(envs, envs.reset()[1]).to(device)
                torch.manual_seed(config.seed)
            played = evaluate(agent, envs, batch, config.max_steps, amp=args.amp, deterministic=config.deterministic)
        envs.close()
        for name, numbers in played.items():
            found[name][start : start + AT_ONCE] = numbers
    return {name: numbers.reshape(config.levels, config.repeats) for name, numbers in found.items()}


def title_of(args: dict[str, Any], config: Config) -> str:
    """Name the task and the levels of it that are played."""
    training = SimpleNamespace(**args)
    first = first_after(training) if config.start_level is None else config.start_level
    trained_on = " (of its training)" if are_trained_on(training, first, config.levels) else ""
    if config.new_levels:
        trained = f"{training.start_level} to {first_after(training) - 1}"
        which = f"{config.levels} levels from {first} on that begin as none of the levels {trained} does"
    else:
        which = f"levels {first} to {first + config.levels - 1}{trained_on}"
    levels = f"{which}, {config.repeats} times each"
    return f"{task_of(args)}, {levels}{', most probable actions' if config.deterministic else ''}"


def trained_levels(args: dict[str, Any], config: Config) -> str:
    """Say how many of the levels that are played begin as one of the training's, where that can be known.

    In an endless task it is not counted: an agent sees only as much of a level as it comes to.
    """
    training = SimpleNamespace(**args)
    if not is_memory_gym(training.env_id) or not training.num_levels or config.new_levels:
        return ""
    may, hint = "Some of these levels may begin as levels of the training do", "; --new-levels plays only others"
    if bare_id(training.env_id).startswith("Endless") or config.env_options is not None:
        return may
    if training.num_levels > MOST_COUNTED:
        return may + hint
    first = first_after(training) if config.start_level is None else config.start_level
    count = count_trained_on(training, first, config.levels)
    told = f"Of these {config.levels} levels, {count} begin as levels of the training do"
    return told + hint if 0 < count < config.levels else told


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

    A task that does not report the wanted metrics gets a line, and its usual ones.
    """
    checkpoints = {path: Checkpoint.read(path, config.env_options) for path in dict.fromkeys(config.checkpoints)}
    arguments = {path: checkpoint.arguments() for path, checkpoint in checkpoints.items()}
    tasks = tasks_of(arguments, lambda args: title_of(args, config))
    with tqdm(checkpoints.items(), unit=" agents") as bar:  # closed before an error's line
        played = {path: play(each, config) for path, each in bar}
    report = []
    for title, agents in tasks.items():
        paths = list(itertools.chain(*agents.values()))
        env_id, numbers = arguments[paths[0]]["env_id"], [played[path] for path in paths]
        try:
            metrics = choose_metrics(config.metrics, env_id, numbers)
        except ValueError as error:  # what was played is not thrown away
            print(f"{title}: {error}", file=sys.stderr)
            metrics = choose_metrics((), env_id, numbers)
        summaries = []
        for label, members in agents.items():
            scores = {name: np.stack([played[path][name] for path in members]) for name in metrics}  # (R, M, E) each
            summaries.append(summary(label, {path: checkpoints[path].step for path in members}, scores))
        finished = float(np.mean([played[path]["finished"] for path in paths]))
        report.append({"task": title, "finished": finished, "agents": summaries})
        print(f"{title}\n\n{table(summaries)}\n")
        if finished < 1:
            print(f"--max-steps cut {1 - finished:.2%} of the episodes; what only their end tells is left out\n")
        trainings = {(arguments[path]["start_level"], arguments[path]["num_levels"]): arguments[path] for path in paths}
        for (first, count), training in trainings.items():
            if told := trained_levels(training, config):
                whose = f"Trained on {count} levels from {first} on: " if len(trainings) > 1 else ""
                print(f"{whose}{told}\n")
    return report


def check_numbers(config: Config) -> None:
    """Raise ValueError for the first number that cannot work."""
    check_bounds(config)
    if config.new_levels and config.env_options is not None:
        raise ValueError(
            "--new-levels and --env-options: which levels are new is known for the training's options only"
        )
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
        if Path(config.json).is_dir():  # the current folder, if it is empty
            raise ValueError(f"--json {config.json} is a folder; give a file to write to")
    if config.curves:
        from ppo_utils.curves import draw_curves  # it needs matplotlib; to play, nothing else has to be installed

        report = draw_curves(config.curves, config.out, config.metrics, config.over)
    else:
        report = score_checkpoints(config)
    if config.json is not None:
        Path(config.json).write_text(json.dumps(report, indent=1))
    agents = [agent for task in report for agent in task["agents"]] if config.checkpoints else []
    if agents and not any({*config.metrics} <= {*agent["metrics"]} for agent in agents):
        raise ValueError(f"no task reports {', '.join(config.metrics)}")


if __name__ == "__main__":
    open_streams()
    with one_line_exit(ValueError, OSError, ImportError, gym.error.Error, RunError):
        main(tyro.cli(Config))
