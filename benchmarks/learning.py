"""Does memory matter, and which one? Trains agents on a suite of tasks, and tabulates what they reach.

    python benchmarks/learning.py --out docs/learning
    python benchmarks/learning.py --tasks endless-mortar-mayhem --agents GRU TrXL "TrXL, gradient" --steps-scale 6
    python benchmarks/learning.py --suite full --results benchmarks/results

The small suite has tasks that take minutes on a core; the full one has the ten environments as they are. Agents have
vector observations and small networks, and all see the same vectors, a frame stack the last few. Scores are those of
evaluations during training, on levels outside the training set (6.1.3).

What a run reached is kept in a file of some KB in --results, which `evaluate.py --curves` can draw too. A run whose
file is there is not trained again; one that was stopped goes on from its last checkpoint in --folder.
"""

import contextlib
import glob
import importlib
import json
import math
import os
import re
import signal
import subprocess
import sys
import zlib
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from tqdm import tqdm

import evaluate
import memory_gym_envs

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
    "stack of 16": "ppo_gru.py --memory none --frame-stack 16",
    "step encoding": "ppo_gru.py --memory none --step-encoding",
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
    """A task, and how it is learned."""

    env_id: str
    total_timesteps: int
    options: dict = field(default_factory=dict)
    flags: str = ""
    trxl_flags: str = ""  # the transformer's own

    @property
    def metric(self) -> str:
        """Return the name of the family's own metric (6.1.3)."""
        return evaluate.own_metric(self.env_id)


SMALL = {
    "mortar-mayhem": Task(
        "MortarMayhem-Grid-v0",
        1_000_000,
        # Four commands instead of ten, each shown for one step, and two thirds of the time to carry one out.
        {
            "command_count": [4],
            "command_show_duration": [1],
            "command_show_delay": [0],
            "explosion_delay": [4],
            "explosion_duration": [2],
        },
    ),
    "mystery-path": Task(
        "MysteryPath-Grid-v0",
        1_500_000,
        # All paths begin at the left, and each of their tiles pays a tenth of the goal's reward when first reached:
        # without this, chance finds too few goals.
        {"cardinal_origin_choice": [0], "reward_path_progress": 0.1},
        # To remember tiles, an agent has to tell them apart; their coordinates alone differ by a seventh.
        "--vector-frequencies 4",
        # Where the agent fell matters, not when.
        "--trxl-positional-encoding none",
    ),
    "endless-mortar-mayhem": Task(
        "Endless-MortarMayhem-v0",
        1_000_000,
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
    ),
}
FULL = {
    # As in the small task, an agent has to tell tiles apart to remember them.
    env_id: Task(env_id, 10_000_000, flags="--vector-frequencies 4" if "MysteryPath" in env_id else "")
    for env_id in memory_gym_envs.IDS
}
TASKS = SMALL | FULL
SUITES = {
    "small": (SMALL, ("no memory", "stack of 4", "GRU", "TrXL")),
    "full": (
        FULL,
        ("no memory", "stack of 4", "stack of 16", "step encoding", *MEMORIES, "TrXL --trxl-query-position"),
    ),
}


@dataclass
class Training:
    """How agents are trained, and where that goes."""

    steps_scale: float = 1.0
    """share of a task's steps to train for"""
    seeds: tuple[int, ...] = (1, 2, 3)
    """a training run each"""
    jobs: int = os.cpu_count() or 1
    """runs at the same time; they share the cores"""
    evaluations: int = 20
    """points of a curve"""
    folder: Path = Path("learning")
    """where the runs go"""
    results: Path = Path("learning/results")
    """where a file of some KB goes for every finished run"""


@dataclass
class Config(Training):
    """What to train and to draw."""

    suite: Literal["small", "full"] = "small"
    """tasks that are learned within minutes, or the ten environments with their default options"""
    tasks: tuple[str, ...] = ()
    """other tasks than the suite's, of those that this program knows"""
    agents: tuple[str, ...] = ()
    """other agents than the suite's, of those that this program knows, each alone or with further flags, e.g.
    "TrXL --trxl-num-layers 3" """
    out: Path = Path("learning/curves")
    """draw the curves to OUT.png and OUT.svg"""


def steps_of(config: Training, task: Task) -> int:
    """Return the steps that a run trains for."""
    return int(task.total_timesteps * config.steps_scale)


def file_name(agent: str) -> str:
    """Return an agent's name as part of a file's name."""
    return re.sub(r"\W+", "-", agent)


def command(config: Training, task: Task, agent: str, seed: int) -> list[str]:
    """Return the command line of a training run."""
    name, dashes, further = agent.partition(" --")
    script, *memory = AGENTS[name].split()
    steps = steps_of(config, task)
    flags = [*COMMON.split(), *memory, *task.flags.split(), *(task.trxl_flags.split() if "trxl" in script else [])]
    flags += ["--total-timesteps", str(steps), "--anneal-steps", str(steps)]
    flags += ["--env-id", task.env_id, "--env-options", json.dumps(task.options)]
    flags += ["--exp-name", file_name(agent), "--seed", str(seed)]
    flags += f"{dashes}{further}".split()
    args = parsed(script, flags)
    every = max(1, steps // (args.num_envs * args.num_steps) // config.evaluations)
    return [sys.executable, str(ROOT / script), *flags, "--eval-interval", str(every)]


def parsed(script: str, flags: list[str]) -> Any:
    """Return the script's Args for these flags."""
    return importlib.import_module(Path(script).stem).parse_args(flags)


def runs_in(place: str, config: Training, task: Task, agent: str, seed: int) -> list[evaluate.RunLog]:
    """Return the runs with these arguments among the folders, or the files of results, in a place."""
    wanted, found = arguments(command(config, task, agent, seed)), []
    for path in sorted(glob.glob(f"{place}/{task.env_id}__{file_name(agent)}__{seed}__*")):
        with contextlib.suppress(evaluate.NoCurvesError):
            found.append(evaluate.read_run(path))
    return [run for run in found if {**run.args, "resume": "None"} == wanted]


def result_of(config: Training, task: Task, agent: str, seed: int) -> evaluate.RunLog | None:
    """Return the finished run with these arguments, if its result is there."""
    return next(iter(runs_in(str(config.results), config, task, agent, seed)), None)


def is_complete(run: evaluate.RunLog) -> bool:
    """Return whether a run has trained for all its steps."""
    total, *batch = (int(run.args[name]) for name in ("total_timesteps", "num_envs", "num_steps"))
    return run.has_seconds() and run.curves["charts/seconds_iteration"][0][-1] + math.prod(batch) > total


def arguments(line: list[str]) -> dict[str, str]:
    """Return a command line's arguments as a run that was read has them."""
    args = asdict(parsed(line[1], line[2:]))
    return {"script": Path(line[1]).stem} | {name: " ".join(str(value).split()) for name, value in args.items()}


RUNNING = set()  # training processes, to be stopped with this one


def train(config: Training, task: Task, agent: str, seed: int) -> None:
    """Run a training, or go on with one that was stopped; raise SystemExit that names its log if it fails."""
    line = command(config, task, agent, seed)
    for run in runs_in(f"{config.folder}/runs", config, task, agent, seed):
        if glob.glob(f"{run.path}/checkpoint-*.pt"):
            line = [*line[:2], "--resume", os.path.relpath(run.path, config.folder)]
    threads = str(max(1, (os.cpu_count() or 1) // config.jobs))
    task_hash = zlib.crc32(json.dumps(asdict(task)).encode())
    log = config.folder / f"{task.env_id}-{file_name(agent)}-{seed}-{task_hash:08x}.log"
    environment = {**os.environ, "OMP_NUM_THREADS": threads, "TQDM_MININTERVAL": "10"}
    with log.open("a") as output:
        # In a session of its own, Ctrl-C does not reach it: `train_missing` stops it, so that it leaves a checkpoint.
        how = {"cwd": config.folder, "env": environment, "stdout": output, "stderr": output, "start_new_session": True}
        with subprocess.Popen(line, **how) as process:
            RUNNING.add(process)
            code = process.wait()
            RUNNING.remove(process)
    if code == 0:
        tqdm.write(f"trained {agent} on {task.env_id}, seed {seed}")
    elif code not in (-signal.SIGTERM, 128 + signal.SIGTERM):  # stopped before its first iteration, or after one
        raise SystemExit(f"{agent} on {task.env_id}, seed {seed}, failed: see {log}")


def write_result(config: Training, task: Task, agent: str, seed: int) -> None:
    """Train if that has not been done, and write what the run reached.

    Raises SystemExit if it was stopped, or has no score at its end.
    """
    wanted = (f"{config.folder}/runs", config, task, agent, seed)
    if not any(map(is_complete, runs_in(*wanted))):
        train(config, task, agent, seed)
    run = next(filter(is_complete, runs_in(*wanted)), None)
    if run is None:
        raise SystemExit(f"{agent} on {task.env_id}, seed {seed}, was stopped; the same command goes on with it")
    steps, _ = run.curves.get(f"eval/{task.metric}", ([0], None))
    if steps[-1] != run.curves["charts/seconds_iteration"][0][-1]:
        raise SystemExit(
            f"{agent} on {task.env_id}, seed {seed}, has no {task.metric} at its end: an evaluation was cut short; "
            f'give the agent more steps, as "{agent} --eval-max-steps 100000"'
        )
    evaluate.write_run(run, f"{config.results}/{Path(run.path).name}.json.gz")


def train_missing(config: Training, wanted: list[tuple[Task, str, int]]) -> None:
    """Do the trainings that have no result, some at a time, and show how long it takes.

    Raises SystemExit, at the end, if some failed, and for steps that are no number of steps.
    """
    if config.steps_scale <= 0:
        raise SystemExit(f"--steps-scale is {config.steps_scale}; it must be above 0")
    for folder in (config.folder, config.results):
        folder.mkdir(parents=True, exist_ok=True)
    each_once = {tuple(command(config, *run)): run for run in wanted}.values()
    missing = [run for run in each_once if result_of(config, *run) is None]
    steps, failed = sum(steps_of(config, task) for task, _, _ in missing), []
    with (
        ThreadPoolExecutor(config.jobs) as pool,
        tqdm(total=steps, unit=" steps", unit_scale=True, disable=not missing) as bar,
    ):
        trainings = {pool.submit(write_result, config, *run): run[0] for run in missing}
        try:
            for training in as_completed(trainings):
                try:
                    training.result()
                except SystemExit as error:
                    failed.append(str(error))
                    tqdm.write(failed[-1])
                bar.update(steps_of(config, trainings[training]))
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in RUNNING.copy():
                process.terminate()
            raise SystemExit("stopped; the same command goes on") from None
    if failed:
        raise SystemExit("; ".join(failed))


def row(agent: str, runs: list[evaluate.RunLog], metric: str, best: float) -> str:
    """Return the agent's row: its last score, and what it took to nine tenths of the best score of all agents."""
    steps, scores = evaluate.align([run.curves[f"eval/{metric}"] for run in runs])  # (P,), (P, R, M, E)
    minutes = 60 * np.mean([run.hours(steps) for run in runs], 0)  # (P,), without evaluations
    ends = evaluate.interval(scores[-1])
    middle = evaluate.iqm(scores)  # (P,)
    reached = np.flatnonzero(middle >= 0.9 * best) if best > 0 else np.array([])
    taken = (f"{steps[reached[0]]:,.0f}", f"{minutes[reached[0]]:.1f}") if reached.size else ("never", "")
    span = "none: one seed" if ends is None else "{:.2f} to {:.2f}".format(*ends)
    cells = (agent, len(runs), f"{scores[-1].mean():.2f}", f"{middle[-1]:.2f}", span, *taken, f"{minutes[-1]:.1f}")
    return f"| {' | '.join(map(str, cells))} |"


def report(config: Config, task: Task, runs: dict[str, list[evaluate.RunLog]]) -> None:
    """Print a task's table: each agent's runs, an evaluated seed each."""
    curves = [evaluate.align([run.curves[f"eval/{task.metric}"] for run in each]) for each in runs.values()]
    best = max(evaluate.iqm(scores[-1]) for _, scores in curves)
    print(f"\n{task.env_id} {json.dumps(task.options)}, {task.metric} after {steps_of(config, task):,} steps\n")
    print("| agent | seeds | mean | IQM | 95 % interval | steps to 0.9 of the best | minutes | minutes in all |")
    print("|---|---:|---:|---:|---|---:|---:|---:|")
    for agent, each in runs.items():
        print(row(agent, each, task.metric, float(best)))


def main(config: Config) -> None:
    """Train what is missing, then print the tables and draw the curves."""
    suite_tasks, suite_agents = SUITES[config.suite]
    tasks, agents = config.tasks or suite_tasks, config.agents or suite_agents
    for given, known in ((tasks, TASKS), ([agent.partition(" --")[0] for agent in agents], AGENTS)):
        if unknown := [name for name in given if name not in known]:
            raise SystemExit(f"there is no {unknown[0]}; there are {', '.join(known)}")
    wanted = [(TASKS[task], agent, seed) for task in tasks for seed in config.seeds for agent in agents]
    train_missing(config, wanted)
    paths = []
    for task in map(TASKS.get, tasks):
        runs = {agent: [result_of(config, task, agent, seed) for seed in config.seeds] for agent in agents}
        report(config, task, runs)
        paths += [run.path for each in runs.values() for run in each]
    evaluate.draw_curves(evaluate.Config(curves=tuple(paths), out=str(config.out)))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C
    main(tyro.cli(Config))
