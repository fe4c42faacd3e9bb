"""Does memory matter, and which one? Trains agents on small tasks, and tabulates what they reach.

    python benchmarks/learning.py --jobs 2 --out docs/learning
    python benchmarks/learning.py --tasks endless-mortar-mayhem --agents GRU TrXL "TrXL, gradient" --steps-scale 6

Vector observations and small networks, so that a run takes minutes on a core. Every agent sees the same vectors, the
stack the last four of them. Scores are those of evaluations during training, on levels outside the training set
(6.1.3). A run that is there already, whole, is not trained again, and one that was stopped goes on.
"""

import glob
import importlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import evaluate

ROOT = Path(__file__).parent.parent
COMMON = "--preset laptop --save-model"
MEMORIES = {
    "GRU": "ppo_gru.py --memory gru",
    "LSTM": "ppo_gru.py --memory lstm",
    "TrXL": "ppo_trxl.py",
    "GTrXL": "ppo_trxl.py --trxl-gate gru",
}
AGENTS = {
    "no memory": "ppo_gru.py --memory none",
    "stack of 4": "ppo_gru.py --memory none --frame-stack 4",
    **MEMORIES,
    **{f"{name}, refreshed": f"{flags} --refresh-memory" for name, flags in MEMORIES.items()},
    **{f"{name}, gradient": f"{MEMORIES[name]} --trxl-memory-gradient" for name in ("TrXL", "GTrXL")},
    **{
        f"{name}, gradient, refreshed": f"{MEMORIES[name]} --trxl-memory-gradient --refresh-memory"
        for name in ("TrXL", "GTrXL")
    },
}


@dataclass(frozen=True)
class Task:
    """A task that is learned within minutes, and how."""

    env_id: str
    options: dict
    metric: str  # the family's own (6.1.3)
    total_timesteps: int
    flags: str
    trxl_flags: str = ""  # the transformer's own


TASKS = {
    "mortar-mayhem": Task(
        "MortarMayhem-Grid-v0",
        # Four commands instead of ten, each shown for one step, and two thirds of the time to carry one out.
        {
            "command_count": [4],
            "command_show_duration": [1],
            "command_show_delay": [0],
            "explosion_delay": [4],
            "explosion_duration": [2],
        },
        "commands_completed",
        1_000_000,
        "",
    ),
    "mystery-path": Task(
        "MysteryPath-Grid-v0",
        # All paths begin at the left, and each of their tiles pays a tenth of the goal's reward when first reached:
        # without this, chance finds too few goals.
        {"cardinal_origin_choice": [0], "reward_path_progress": 0.1},
        "success",
        1_500_000,
        # To remember tiles, an agent has to tell them apart; their coordinates alone differ by a seventh.
        "--vector-frequencies 4",
        # Where the agent fell matters, not when.
        "--trxl-positional-encoding none",
    ),
    "endless-mortar-mayhem": Task(
        "Endless-MortarMayhem-v0",
        # A step crosses a tile, as on the grid; a new command is shown for one step, and carrying one out takes four:
        # an episode with twenty commands carried out has about ninety steps.
        {
            "agent_speed": 14,
            "allowed_commands": 5,
            "explosion_delay": [3],
            "explosion_duration": [1],
            "command_show_duration": [1],
            "command_show_delay": [0],
        },
        "commands_completed",
        1_000_000,
        "",
    ),
}


@dataclass
class Config:
    """What to train and to draw."""

    tasks: tuple[str, ...] = tuple(TASKS)
    """of those that this program knows"""
    agents: tuple[str, ...] = ("no memory", "stack of 4", "GRU", "TrXL")
    """of those that this program knows, each alone or with further flags, e.g. "TrXL --trxl-num-layers 3" """
    steps_scale: float = 1.0
    """share of a task's steps to train for"""
    seeds: tuple[int, ...] = (1, 2, 3)
    """a training run each"""
    jobs: int = 1
    """runs at the same time; they share the cores"""
    evaluations: int = 20
    """points of a curve"""
    folder: Path = Path("learning")
    """where the runs go"""
    out: Path = Path("learning/curves")
    """draw the curves to OUT.png and OUT.svg"""


def steps_of(config: Config, task: Task) -> int:
    """Return the steps that a run trains for."""
    return int(task.total_timesteps * config.steps_scale)


def file_name(agent: str) -> str:
    """Return an agent's name as part of a file's name."""
    return re.sub(r"\W+", "-", agent)


def command(config: Config, task: Task, agent: str, seed: int) -> list[str]:
    """Return the command line of a training run."""
    name, dashes, further = agent.partition(" --")
    script, *memory = AGENTS[name].split()
    steps = steps_of(config, task)
    flags = [*COMMON.split(), *memory, *task.flags.split(), *(task.trxl_flags.split() if "trxl" in script else [])]
    flags += f"{dashes}{further}".split()
    flags += ["--total-timesteps", str(steps), "--anneal-steps", str(steps)]
    flags += ["--env-id", task.env_id, "--env-options", json.dumps(task.options)]
    flags += ["--exp-name", file_name(agent), "--seed", str(seed)]
    args = parsed(script, flags)
    every = max(1, steps // (args.num_envs * args.num_steps) // config.evaluations)
    return [sys.executable, str(ROOT / script), *flags, "--eval-interval", str(every)]


def parsed(script: str, flags: list[str]) -> Any:
    """Return the script's Args for these flags."""
    return importlib.import_module(Path(script).stem).parse_args(flags)


def folders_of(config: Config, task: Task, agent: str, seed: int) -> dict[str, bool]:
    """Return the folders of such runs, and whether each came to its end: it was evaluated then."""
    line, found = command(config, task, agent, seed), {}
    wanted, args = arguments(line), parsed(Path(line[1]).name, line[2:])
    for folder in sorted(glob.glob(f"{config.folder}/runs/{task.env_id}__{file_name(agent)}__{seed}__*")):
        run = EventAccumulator(folder, size_guidance={"scalars": 0})
        run.Reload()
        if "hyperparameters/text_summary" not in run.Tags()["tensors"]:
            continue  # stopped before its first step
        if {**evaluate.hyperparameters(run), "resume": "None"} == wanted:
            evaluated = f"eval/{task.metric}" in run.Tags()["scalars"]
            last = run.Scalars(f"eval/{task.metric}")[-1].step if evaluated else 0
            found[folder] = last + args.num_envs * args.num_steps > steps_of(config, task)
    return found


def folder_of(config: Config, task: Task, agent: str, seed: int) -> str | None:
    """Return the folder of such a run that came to its end, if there is one."""
    return next((folder for folder, whole in folders_of(config, task, agent, seed).items() if whole), None)


def arguments(line: list[str]) -> dict[str, str]:
    """Return a command line's arguments as `evaluate.hyperparameters` tells those of a run."""
    args = asdict(parsed(line[1], line[2:]))
    return {"script": Path(line[1]).stem} | {name: " ".join(str(value).split()) for name, value in args.items()}


def train(config: Config, task: Task, agent: str, seed: int) -> None:
    """Run a training, or go on with one that was stopped; raise SystemExit that names its output's file if it fails."""
    line = command(config, task, agent, seed)
    for folder in folders_of(config, task, agent, seed):
        if glob.glob(f"{folder}/checkpoint-*.pt"):
            line = [*line[:2], "--resume", os.path.relpath(folder, config.folder)]
    threads = str(max(1, (os.cpu_count() or 1) // config.jobs))
    log = config.folder / f"{task.env_id}-{file_name(agent)}-{seed}.log"
    environment = {**os.environ, "OMP_NUM_THREADS": threads, "TQDM_MININTERVAL": "10"}
    with log.open("a") as output:
        if subprocess.run(line, cwd=config.folder, env=environment, stdout=output, stderr=output).returncode:
            raise SystemExit(f"{agent} on {task.env_id}, seed {seed}, failed: see {log}")
    print(f"trained {agent} on {task.env_id}, seed {seed}", flush=True)


def curves(folders: list[str], metric: str) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield, of each run's evaluations, the steps (P,), the hours of training until then (P,), and the levels' scores.

    The hours are without evaluations, the scores (P, M, E): E episodes on each of M levels.
    """
    for folder in folders:
        run = evaluate.read_run(folder)
        steps, scores = evaluate.read_curve(run, f"eval/{metric}")
        yield steps, evaluate.training_hours(run, steps), scores


def row(agent: str, folders: list[str], metric: str, best: float) -> str:
    """Return the agent's row: its last score, and what it took to nine tenths of the best score of all agents."""
    steps, hours, scores = map(np.stack, zip(*curves(folders, metric), strict=True))  # (R, P), (R, P), (R, P, M, E)
    last, ends = evaluate.iqm(scores[:, -1]), evaluate.interval(scores[:, -1])
    middle = evaluate.iqm(scores.swapaxes(0, 1))  # (P,)
    reached = np.flatnonzero(middle >= 0.9 * best)
    taken = ("never", "")
    if reached.size:
        taken = (f"{steps[0, reached[0]]:,.0f}", f"{60 * hours[:, reached[0]].mean():.1f}")
    mean = scores[:, -1].mean()
    span = "none: one seed" if ends is None else "{:.2f} to {:.2f}".format(*ends)
    whole = f"{60 * hours[:, -1].mean():.1f}"
    return f"| {agent} | {len(folders)} | {mean:.2f} | {last:.2f} | {span} | {taken[0]} | {taken[1]} | {whole} |"


def report(config: Config, name: str) -> None:
    """Print a task's table."""
    task = TASKS[name]
    folders = {agent: [folder_of(config, task, agent, seed) for seed in config.seeds] for agent in config.agents}
    scores = [evaluate.iqm(np.stack([c[2][-1] for c in curves(each, task.metric)])) for each in folders.values()]
    print(f"\n{task.env_id} {json.dumps(task.options)}, {task.metric} after {steps_of(config, task):,} steps\n")
    print("| agent | seeds | mean | IQM | 95 % interval | steps to 0.9 of the best | minutes | minutes in all |")
    print("|---|---:|---:|---:|---|---:|---:|---:|")
    for agent, each in folders.items():
        print(row(agent, each, task.metric, float(max(scores))))


def main(config: Config) -> None:
    """Train what is missing, then print the tables and draw the curves."""
    if config.steps_scale <= 0:
        raise SystemExit(f"--steps-scale is {config.steps_scale}; it must be above 0")
    for given, known in ((config.tasks, TASKS), ([agent.partition(" --")[0] for agent in config.agents], AGENTS)):
        if unknown := [name for name in given if name not in known]:
            raise SystemExit(f"there is no {unknown[0]}; there are {', '.join(known)}")
    config.folder.mkdir(parents=True, exist_ok=True)
    wanted = [(TASKS[task], agent, seed) for task in config.tasks for seed in config.seeds for agent in config.agents]
    missing = [run for run in wanted if folder_of(config, *run) is None]
    with ThreadPoolExecutor(config.jobs) as pool:
        list(pool.map(lambda run: train(config, *run), missing))
    for task in config.tasks:
        report(config, task)
    evaluate.draw_curves(evaluate.Config(curves=tuple(folder_of(config, *run) for run in wanted), out=str(config.out)))


if __name__ == "__main__":
    main(tyro.cli(Config))
