"""Scores of agents in numbers: which runs are the seeds of one agent, its interquartile mean, its table.

Shape letters: R seeds (training runs) of an agent, M levels, E episodes on each, B bootstrap resamples.
"""

import json
import math
import re
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np

# A family's own metric (6.1.3), by the beginning of the id; any other environment's is the return.
OWN_METRIC = {
    "MortarMayhem": "carried_out",
    "Endless-MortarMayhem": "carried_out",
    "MysteryPath": "success",
    "SearingSpotlights": "success",
    "Endless-SearingSpotlights": "coins_collected",
}
# Arguments that say how a run was started and recorded, not what learned.
BOOKKEEPING = {"preset", "seed", "cuda", "track", "capture_video", "save_model", "resume"}
BOOKKEEPING |= {"checkpoint_interval", "eval_interval", "eval_levels", "eval_max_steps", "async_envs"}
RESAMPLES = 2000


# ---- statistics ----
def iqm(scores: np.ndarray) -> np.ndarray:
    """Return the interquartile mean (...) of scores (..., R, M, E): without the lowest and the highest quarter.

    As many are left out as fit whole into a quarter: with three scores none, with five the lowest and the highest.
    """
    pooled = scores.reshape(*scores.shape[:-3], -1)
    quarter = pooled.shape[-1] // 4
    end = pooled.shape[-1] - quarter
    return np.partition(pooled, (quarter, end - 1), axis=-1)[..., quarter:end].mean(-1)


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


def error_over_levels(scores: np.ndarray) -> float | None:
    """Return the standard error of the mean of scores (R, M, E) for other levels; None for several seeds or one level.

    Where there are several seeds, their differences count too, which the bootstrap's interval shows.
    """
    seeds, levels, _ = scores.shape
    if seeds > 1 or levels < 2:
        return None
    return float(scores[0].mean(-1).std(ddof=1)) / math.sqrt(levels)


def summary(agent: str, runs: dict[str, int | None], scores: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return what to report of an agent, for JSON: scores (R, M, E) by metric.

    runs: the paths in the order of the seeds, with the steps that each was trained for, None where that is not known.
    """
    metrics = {}
    for name, values in scores.items():
        metrics[name] = {"mean": float(values.mean()), "error_over_levels": error_over_levels(values)}
        for suffix, each in (("", values), ("_of_levels", values.mean(-1, keepdims=True))):
            ends = interval(each)
            metrics[name][f"iqm{suffix}"] = float(iqm(each))
            metrics[name][f"interval{suffix}"] = None if ends is None else ends.tolist()
        metrics[name]["scores"] = values.tolist()
    return {"agent": agent, "runs": [*runs], "steps": [*runs.values()], "metrics": metrics}


def table(agents: list[dict[str, Any]]) -> str:
    """Return the summaries as a Markdown table, the agents below each other for every metric.

    Intervals are there if an agent has several seeds. Below it is a line that says what is not in the numbers of a
    single one, and a line for each agent whose seeds were trained for different numbers of steps.
    """
    has_intervals = any(len(agent["runs"]) > 1 for agent in agents)
    ends_of = ["95 % interval"] * has_intervals
    header = ["metric", "agent", "seeds", "mean", "IQM", *ends_of, "IQM of level means", *ends_of]
    dashes = ["---" if name in ("metric", "agent", "95 % interval") else "---:" for name in header]
    lines = [f"| {' | '.join(header)} |", f"|{'|'.join(dashes)}|"]
    for metric in agents[0]["metrics"]:
        for agent in agents:
            score = agent["metrics"][metric]
            error = score["error_over_levels"]
            mean = f"{score['mean']:.3f}" + ("" if error is None else f" ± {error:.3f}")
            cells = [metric, agent["agent"], len(agent["runs"]), mean]
            for suffix in ("", "_of_levels"):
                ends = score[f"interval{suffix}"]
                cells += [f"{score[f'iqm{suffix}']:.3f}"]
                cells += ["" if ends is None else "{:.3f} to {:.3f}".format(*ends)] * has_intervals
            lines.append(f"| {' | '.join(map(str, cells))} |")
    if any("±" in line for line in lines):
        lines.append("\n± of one seed is the standard error over levels; other seeds would differ by more")
    for agent in agents:
        if len({*agent["steps"]}) > 1:
            steps = ", ".join("an unknown number" if step is None else f"{step:,}" for step in agent["steps"])
            lines.append(f"\n{agent['agent']}: its seeds were trained for different numbers of steps: {steps}")
    return "\n".join(lines)


# ---- agents ----
def task_of(args: dict[str, Any]) -> str:
    """Name what was learned: runs of another environment, or one made or reset with other arguments, do not compare."""
    given = [args[name] for name in ("env_options", "env_kwargs") if args.get(name, "{}") != "{}"]
    return " ".join([args["env_id"], *given])


def bare_id(env_id: str) -> str:
    """Return an environment's id without module and namespace."""
    return re.split("[:/]", env_id)[-1]


def own_metric(env_id: str) -> str:
    """Return the name of the environment's own metric."""
    name = bare_id(env_id)
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
