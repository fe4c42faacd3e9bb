"""Does memory matter, and which one? Trains agents on a suite of tasks, and tabulates what they reach.

    python benchmarks/learning.py --out docs/learning
    python benchmarks/learning.py --tasks endless-mortar-mayhem --agents GRU TrXL "TrXL, gradient" --steps-scale 6
    python benchmarks/learning.py --suite full --results benchmarks/results
    python benchmarks/learning.py --results benchmarks/results --csv results.csv

The small suite has tasks that take minutes on a core; the full one has the ten environments as they are. Agents have
vector observations and small networks, and all see the same vectors, a frame stack the last few. Two sets of levels
are outside of the training set. Evaluations during training (6.1.3) are on the development levels, which follow the
training's: curves are made of them, settings and seeds chosen by them. At the end, the final weights play TEST_LEVELS
test levels once: what is published is their score.

What a run reached is kept in a file of a few KB, in a folder of --results for its environment; `evaluate.py --curves`
can draw these files too. A run whose file is there is not trained again; one that was stopped goes on from its last
checkpoint in --folder. With --report, nothing is trained.
"""

import contextlib
import csv
import functools
import glob
import importlib
import json
import math
import os
import platform
import re
import signal
import subprocess
import sys
import threading
import zlib
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # before other packages that are named evaluate

import evaluate
from ppo_utils.flags import check_args, check_minibatches
from ppo_utils.runs import parse_args

ROOT = Path(__file__).parent.parent
COMMON = "--preset laptop --save-model"
TEST_LEVELS, FIRST_TEST_LEVEL = 1000, 1_000_000
# What --preset laptop was until Muon, with which the agents of the two suites have been trained.
ADAMW = "--optimizer adamw --no-norm-reward --num-envs 32 --update-epochs 4 --num-minibatches 8"
ADAMW += " --init-lr 1e-3 --final-lr 1e-4 --init-ent-coef 5e-4 --final-ent-coef 5e-5"
GRU, ADAMW_TRXL = f"ppo_gru.py {ADAMW}", f"ppo_trxl.py {ADAMW} --trxl-dim 64 --trxl-memory-length 128"
TRXL = f"{ADAMW_TRXL} --no-trxl-query-position --no-trxl-memory-gradient"  # the thesis', where the preset differs
MEMORIES = {
    "GRU": f"{GRU} --memory gru",
    "LSTM": f"{GRU} --memory lstm",
    "TrXL": TRXL,
    "GTrXL": f"{TRXL} --trxl-gate gru",
}
# The thesis' exploration bonus, with the weights that suit it on these tasks; the preset has the log barrier.
ENTROPY = "--exploration-bonus entropy --init-ent-coef 1e-3 --final-ent-coef 1e-4"
AGENTS = {
    "no memory": f"{GRU} --memory none",
    "stack of 4": f"{GRU} --memory none --frame-stack 4",
    "stack of 16": f"{GRU} --memory none --frame-stack 16",
    "step encoding": f"{GRU} --memory none --step-encoding",
    **MEMORIES,
    "TrXL, preset": ADAMW_TRXL,
    "no memory, Muon": "ppo_gru.py --memory none",  # today's --preset laptop
    "GRU, Muon": "ppo_gru.py",
    "TrXL, Muon": "ppo_trxl.py",
    **{f"{name}, entropy": f"{flags} {ENTROPY}" for name, flags in MEMORIES.items()},
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
    def title(self) -> str:
        """Return the environment's id, and the reset options if they are not the default ones."""
        return f"{self.env_id} {json.dumps(self.options)}" if self.options else self.env_id

    @property
    def metric(self) -> str:
        """Return the name of the family's own metric (6.1.3)."""
        return evaluate.own_metric(self.env_id)

    @property
    def best_return(self) -> float | None:
        """Return what all commands of a finite Mortar Mayhem pay, None for other tasks."""
        return 0.1 * self.options.get("command_count", [10])[0] if self.env_id.startswith("MortarMayhem") else None

    @property
    def best_score(self) -> float | None:
        """Return the best score that is possible, None where there is no bound."""
        return 1.0 if self.score in ("carried_out", "success") else None

    @property
    def score(self) -> str:
        """Return the name of the score by which agents are compared: the metric, or what they carried out.

        That is a finite Mortar Mayhem's share of the commands by the return (`result_of`). Its metric, as the
        original's, counts a last command as completed even if it failed.
        """
        return self.metric if self.best_return is None else "carried_out"


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
FULL = {  # trained for what two cores can do in a day, all agents and seeds together; few agents converge
    # As in the small task, an agent has to tell tiles apart to remember them.
    env_id: Task(env_id, 1_000_000 * millions, flags="--vector-frequencies 4" if "MysteryPath" in env_id else "")
    for env_id, millions in {
        "MortarMayhem-v0": 3,
        "MortarMayhem-Grid-v0": 6,
        "MortarMayhemB-v0": 2,
        "MortarMayhemB-Grid-v0": 1,
        "Endless-MortarMayhem-v0": 6,
        "MysteryPath-v0": 3,
        "MysteryPath-Grid-v0": 3,
        "Endless-MysteryPath-v0": 3,
        "SearingSpotlights-v0": 3,
        "Endless-SearingSpotlights-v0": 3,
    }.items()
}
# A transformer with about as many parameters as the GRU.
WIDE = "--trxl-dim 96 --trxl-memory-length 256 --init-lr 5e-4"
TASKS = SMALL | FULL
SUITES = {  # tasks, and agents by the names that tables and pictures have for them
    "small": (
        SMALL,
        {name: name for name in ("no memory", "stack of 4", "stack of 16", "GRU", "TrXL", "TrXL, preset")},
    ),
    "full": (
        FULL,
        {name: name for name in ("no memory", "stack of 4", "stack of 16", "step encoding", "GRU", "LSTM")}
        | {name: f"{name} {WIDE}" for name in ("TrXL", "GTrXL", "TrXL, preset")},
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
    """runs at the same time; they share the cores, or have OMP_NUM_THREADS threads each if that is set"""
    evaluations: int = 20
    """evaluations of a training, and one more at its end where they do not divide it evenly"""
    folder: Path = Path("learning")
    """where the runs go"""
    results: Path = Path("learning/results")
    """where a file of a few KB goes for every finished run"""
    report: bool = False
    """train nothing, show the results that are there"""


@dataclass
class Config(Training):
    """What to train and to draw."""

    suite: Literal["small", "full"] = "small"
    """tasks that are learned within minutes, or the ten environments with their default options"""
    tasks: tuple[str, ...] = ()
    """other tasks than the suite's, of those that this program knows"""
    agents: tuple[str, ...] = ()
    """other agents than the suite's: those that this program knows, or scripts beside ppo_gru.py, each alone or with
    further flags, e.g. "TrXL --trxl-num-layers 3" ppo_mingru.py"""
    out: Path = Path("learning/curves")
    """draw the curves to OUT.png and OUT.svg"""
    csv: Path | None = None
    """write the scores of all runs in --results to this file, a line for each evaluation, and do nothing else"""


def file_name(agent: str) -> str:
    """Return an agent's name as part of a file's name."""
    return re.sub(r"\W+", "-", agent)


@dataclass(frozen=True)
class Plan:
    """A training run that is wanted, whether it has been done or not."""

    task: Task
    agent: str
    seed: int
    command: tuple[str, ...]
    args: Any  # what the command's flags stand for, the script's Args

    def __str__(self) -> str:
        return f"{self.agent} on {self.task.env_id}, seed {self.seed}"

    def logged_args(self) -> dict[str, str]:
        """Return the arguments as text, as a run that was read has them."""
        texts = {name: " ".join(str(value).split()) for name, value in asdict(self.args).items()}
        return {"script": Path(self.command[1]).stem, **texts}


def check(config: Training) -> None:
    """Raise SystemExit for numbers that no training can have."""
    for name in ("jobs", "evaluations"):
        if getattr(config, name) < 1:
            raise SystemExit(f"--{name} is {getattr(config, name)}; it must be 1 or more")
    if not 0 < config.steps_scale < math.inf:
        raise SystemExit(f"--steps-scale is {config.steps_scale}; it must be a number above 0")
    if not config.seeds or len(set(config.seeds)) < len(config.seeds):
        raise SystemExit(f"--seeds is {' '.join(map(str, config.seeds)) or 'empty'}; give at least one, and each once")


@functools.cache
def parse(script: str, *flags: str) -> Any:
    """Return what a script's flags stand for; tyro takes a tenth of a second, so that seeds and claims share it."""
    module = importlib.import_module(Path(script).stem)
    return parse_args(module.Args, module.PRESETS, [*flags])


def plan(config: Training, task: Task, agent: str, seed: int) -> Plan:
    """Plan a training run; an agent is a name in `AGENTS` or another script, which further flags may follow.

    Raises SystemExit for flags that the script refuses, or that belong to the suite.
    """
    steps = int(task.total_timesteps * config.steps_scale)
    of_the_suite = {
        "env_id": task.env_id,
        "env_options": json.dumps(task.options),
        "total_timesteps": steps,
        "exp_name": file_name(agent),
    }
    name, dashes, further = agent.partition(" --")
    script, *memory = AGENTS.get(name, name).split()
    flags = [*COMMON.split(), *memory, *task.flags.split(), *(task.trxl_flags.split() if "trxl" in script else [])]
    flags += ["--anneal-steps", str(steps)]
    for each, value in of_the_suite.items():
        flags += [f"--{each.replace('_', '-')}", str(value)]
    flags += f"{dashes}{further}".split()
    try:
        module = importlib.import_module(Path(script).stem)
        parsed = parse(script, *flags)
        args = replace(parsed, seed=seed)
        check_args(args)
        check_minibatches(args, module.Memory.longest_piece(args))
    except (ValueError, OSError) as error:
        raise SystemExit(f"{agent}: {error}") from None
    theirs = {each: getattr(args, each) for each in of_the_suite}
    if theirs != of_the_suite or parsed.seed != type(parsed).seed or args.eval_interval or args.resume:
        raise SystemExit(
            f"{agent}: an agent has no task, steps, name, seed or evaluations of its own, and goes on with no other "
            "run; use --tasks, --steps-scale, --seeds and --evaluations"
        )
    iterations = args.total_timesteps // (args.num_envs * args.num_steps)
    args.eval_interval = max(1, iterations // config.evaluations)
    flags += ["--seed", str(seed), "--eval-interval", str(args.eval_interval)]
    return Plan(task, agent, seed, (sys.executable, str(ROOT / script), *flags), args)


def runs_in(place: str, plan: Plan) -> list[evaluate.RunLog]:
    """Return the runs that were planned so among the folders, or the files of results, in a place."""
    wanted = plan.logged_args()
    found = []
    for path in sorted(glob.glob(f"{place}/{plan.task.env_id}__{file_name(plan.agent)}__{plan.seed}__*")):
        with contextlib.suppress(evaluate.NoCurvesError):
            found.append(evaluate.read_run(path))
    return [run for run in found if {**run.args, "resume": "None"} == wanted]


def result_of(config: Training, plan: Plan) -> evaluate.RunLog | None:
    """Return the finished run, if its result is there, with the curve `eval/{plan.task.score}`."""
    run = next(iter(runs_in(f"{config.results}/{plan.task.env_id}", plan)), None)
    if run is not None and plan.task.best_return is not None:
        for levels in ("eval", "test"):
            if f"{levels}/return" in run.curves:
                steps, returns = run.curves[f"{levels}/return"]
                run.curves[f"{levels}/{plan.task.score}"] = steps, returns / plan.task.best_return
    return run


def is_complete(run: evaluate.RunLog) -> bool:
    """Return whether a run has trained for all its steps."""
    total, *batch = (int(run.args[name]) for name in ("total_timesteps", "num_envs", "num_steps"))
    return run.has_seconds() and run.last_step + math.prod(batch) > total


def expected_hours(config: Training, missing: list[Plan]) -> str:
    """Return about how many hours the trainings take, by the results of the same scripts that are there; or nothing."""
    speeds = {}
    for path in config.results.glob("*/*.json.gz"):
        run = evaluate.read_run(str(path))
        if run.has_seconds():
            speeds.setdefault(run.args["script"], []).append(run.last_step / run.seconds("iteration").sum())
    scripts = [Path(plan.command[1]).stem for plan in missing]
    if not {*scripts} <= {*speeds}:
        return ""
    seconds = sum(
        plan.args.total_timesteps / np.median(speeds[name]) for plan, name in zip(missing, scripts, strict=True)
    )
    return f", about {seconds / 3600 / config.jobs:.1f} hours"


RUNNING = set()  # training processes, to be stopped with this one
STOPPING = threading.Event()


def log_of(config: Training, plan: Plan) -> Path:
    """Return the file that a training's output goes to: another one for each command."""
    command_hash = zlib.crc32(json.dumps(plan.command[2:]).encode())
    return config.folder / f"{plan.task.env_id}-{file_name(plan.agent)}-{plan.seed}-{command_hash:08x}.log"


def steps_so_far(config: Training, plan: Plan) -> int:
    """Return how many steps a training has done, by the script's progress bar at the end of its log."""
    log = log_of(config, plan)
    bars = re.findall(r"([\d.]+)([kM]?)/[\d.]+[kM]? \[", log.read_text()[-1000:] if log.exists() else "")
    number, unit = bars[-1] if bars else ("0", "")
    return int(float(number) * {"": 1, "k": 1e3, "M": 1e6}[unit])


def train(config: Training, plan: Plan) -> None:
    """Run a training, or go on with one that was stopped; raise SystemExit that names its log if it fails."""
    line = plan.command
    for run in runs_in(f"{config.folder}/runs", plan):
        if glob.glob(f"{run.path}/checkpoint-*.pt"):
            line = [*line[:2], "--resume", os.path.relpath(run.path, config.folder)]
    threads = str(max(1, (os.cpu_count() or 1) // config.jobs))
    log = log_of(config, plan)
    environment = {"OMP_NUM_THREADS": threads, **os.environ, "TQDM_MININTERVAL": "10"}
    with log.open("a") as output:
        # In a session of its own, Ctrl-C does not reach it: `train_missing` stops it, so that it leaves a checkpoint.
        how = {"cwd": config.folder, "env": environment, "stdout": output, "stderr": output, "start_new_session": True}
        with subprocess.Popen(line, **how) as process:
            RUNNING.add(process)
            if STOPPING.is_set():  # only since this training was about to begin
                process.terminate()
            code = process.wait()
            RUNNING.remove(process)
    if code == 0:
        tqdm.write(f"trained {plan}")
    elif code not in (-signal.SIGTERM, 128 + signal.SIGTERM):  # stopped before its first iteration, or after one
        raise SystemExit(f"{plan}, failed: see {log}")


def write_result(config: Training, plan: Plan) -> None:
    """Train if that has not been done, and write what the run reached.

    Raises SystemExit if it was stopped, or has no score at its end.
    """
    folder = f"{config.folder}/runs"
    if not any(map(is_complete, runs_in(folder, plan))):
        train(config, plan)
    run = next(filter(is_complete, runs_in(folder, plan)), None)
    if run is None:
        raise SystemExit(f"{plan}, was stopped; the same command goes on with it")
    metric = plan.task.metric
    steps, _ = run.curves.get(f"eval/{metric}", ([0], None))
    if steps[-1] != run.last_step:
        raise SystemExit(
            f"{plan}, has no {metric} at its end: an evaluation was cut short; give the agent more steps, as "
            f'"{plan.agent} --eval-max-steps 100000"'
        )
    curves = run.curves | test_scores(plan, run)
    result = config.results / plan.task.env_id / f"{Path(run.path).name}.json.gz"
    result.parent.mkdir(parents=True, exist_ok=True)
    evaluate.write_run(replace(run, curves=curves, machine=machine()), str(result))


def test_scores(plan: Plan, run: evaluate.RunLog) -> dict[str, tuple[list[int], np.ndarray]]:
    """Let the run's final weights play the test levels; return a curve of one point for each metric.

    Raises SystemExit if that fails.
    """
    scores = Path(run.path) / "test_scores.json"
    flags = ["--start-level", FIRST_TEST_LEVEL, "--levels", TEST_LEVELS, "--repeats", 1, "--json", scores]
    command = [sys.executable, ROOT / "evaluate.py", Path(run.path) / "model.pt", *flags]
    done = subprocess.run([str(each) for each in command], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{plan}, could not be scored: {done.stderr.strip()}")
    (task,) = json.loads(scores.read_text())
    metrics = task["agents"][0]["metrics"]
    return {f"test/{name}": ([run.last_step], np.array(each["scores"])) for name, each in metrics.items()}


def machine() -> str:
    """Name this machine's processor and number of cores, and the version of PyTorch."""
    cpuinfo = Path("/proc/cpuinfo")  # of Linux; elsewhere, Python knows the name
    models = re.findall(r"^model name\s*: (.*)", cpuinfo.read_text() if cpuinfo.exists() else "", re.MULTILINE)
    processor = models[0] if models else platform.processor() or platform.machine()
    return f"{processor}, {os.cpu_count()} cores, PyTorch {version('torch')}"


def train_missing(config: Training, wanted: list[Plan]) -> None:
    """Do the trainings that have no result, some at a time, and show how far they are and how long it takes.

    Raises SystemExit, at the end, if some failed.
    """
    for folder in (config.folder, config.results):
        folder.mkdir(parents=True, exist_ok=True)
    missing = [plan for plan in wanted if result_of(config, plan) is None]
    steps = sum(plan.args.total_timesteps for plan in missing)
    if missing:
        tqdm.write(
            f"{len(missing)} runs to train, {steps:,} steps, {config.jobs} at a time{expected_hours(config, missing)}"
        )
    before = sum(steps_so_far(config, plan) for plan in missing)  # of trainings that were stopped
    failed = []
    with (
        ThreadPoolExecutor(config.jobs) as pool,
        tqdm(total=steps, initial=before, unit=" steps", unit_scale=True, smoothing=0, disable=not missing) as bar,
    ):
        trainings = {pool.submit(write_result, config, plan): plan for plan in missing}
        unfinished = set(trainings)
        try:
            while unfinished:
                ended, unfinished = wait(unfinished, timeout=10, return_when=FIRST_COMPLETED)
                for training in [each for each in trainings if each in ended]:  # in the order of the plans
                    try:
                        training.result()
                    except (SystemExit, OSError, ValueError) as error:
                        failed.append(str(error))
                        tqdm.write(failed[-1])
                left = [trainings[each] for each in unfinished]
                bar.n = steps - sum(plan.args.total_timesteps - steps_so_far(config, plan) for plan in left)
                bar.refresh()
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            STOPPING.set()
            for process in RUNNING.copy():
                process.terminate()
            raise SystemExit("stopped; the same command goes on") from None
    if failed:
        raise SystemExit("; ".join(failed))


def row(agent: str, runs: list[evaluate.RunLog], task: Task, best: float) -> str:
    """Return the agent's row: its score, that of each seed, the largest drop, and the minutes to 0.5 and 0.9 of `best`.

    Drops and minutes are those of the curve on development levels. A drop is how far a seed's mean is below an earlier
    one. If the task's score is not its metric, the mean of the metric stands behind the score.
    """
    scores = final_scores(task.score, runs)  # (R, M, E)
    steps, curve = evaluate.align([run.curves[f"eval/{task.score}"] for run in runs])  # (P,), (P, R, M, E)
    minutes = 60 * np.mean([run.hours(steps) for run in runs], 0)  # (P,), without evaluations
    means = curve.mean((-2, -1))  # (P, R)
    drop = (np.maximum.accumulate(means) - means).max()
    cells = [agent, mean_and_error(scores), f"{evaluate.iqm(scores):.2f}"]
    cells.append(", ".join(f"{mean:.2f}" for mean in scores.mean((1, 2))))
    if task.score != task.metric:
        cells.append(f"{final_scores(task.metric, runs).mean():.2f}")
    cells.append(f"{drop:.2f}")
    for share in (0.5, 0.9):
        there = np.flatnonzero(means.mean(1) >= share * best)
        cells.append(f"{minutes[there[0]]:.1f}" if there.size and best else "")
    return f"| {' | '.join(cells)} | {minutes[-1]:.1f} |"


def mean_and_error(scores: np.ndarray) -> str:
    """Return the mean of scores (R, M, E) with its standard error, if there are several seeds."""
    error = evaluate.standard_error(scores)
    return f"{scores.mean():.2f}" + ("" if math.isnan(error) else f" ± {error:.2f}")


def final_scores(name: str, runs: list[evaluate.RunLog]) -> np.ndarray:
    """Return the scores (R, M, E) of the seeds' final weights, by the name of a metric or score.

    They are those on the test levels, or where a run has none, on the development levels.
    """
    levels = "test" if all(f"test/{name}" in run.curves for run in runs) else "eval"
    return evaluate.align([run.curves[f"{levels}/{name}"] for run in runs])[1][-1]


def table(task: Task, agents: evaluate.Runs) -> str:
    """Return a task's table, a row for each agent that has runs, and below it what these took and on which machines.

    The best is the best possible score, or where there is no bound the highest mean of these agents.
    """
    runs_of = {agent: runs for agent, runs in agents.items() if runs}
    best = task.best_score or max(float(final_scores(task.score, runs).mean()) for runs in runs_of.values())
    every_run = [run for runs in runs_of.values() for run in runs]
    hours = sum(run.seconds("iteration").sum() for run in every_run) / 3600
    machines = "; ".join(dict.fromkeys(run.machine for run in every_run))
    metric = () if task.score == task.metric else (task.metric,)
    taken = ("largest drop", "minutes to 0.5 of the best", "minutes to 0.9", "minutes")
    header = ("agent", "mean", "IQM", "each seed", *metric, *taken)
    lines = [
        f"{task.score} after {int(every_run[0].args['total_timesteps']):,} steps\n",
        f"| {' | '.join(header)} |",
        f"|{'|'.join('---' if name in ('agent', 'each seed') else '---:' for name in header)}|",
        *(row(agent, runs, task, best) for agent, runs in runs_of.items()),
        f"\nRuns: {len(every_run)}, together {hours:.1f} hours without evaluations. Machines: {machines}",
    ]
    return "\n".join(lines)


def overview(tasks: dict[str, evaluate.Runs]) -> str:
    """Return a table with a row for each task: the mean score of each agent's final weights, and its standard error.

    Where an agent has fewer seeds than others, it says how many; where it has none, there is no number.
    """
    names = [*dict.fromkeys(agent for agents in tasks.values() for agent in agents)]
    most = max(len(runs) for agents in tasks.values() for runs in agents.values())

    def cell(task: Task, runs: list[evaluate.RunLog]) -> str:
        if not runs:
            return ""
        few = f", {len(runs)} seed{'s' * (len(runs) > 1)}" if len(runs) < most else ""
        return mean_and_error(final_scores(task.score, runs)) + few

    lines = [f"| task, score | {' | '.join(names)} |", f"|---|{'---:|' * len(names)}"]
    for task, agents in tasks.items():
        cells = [cell(TASKS[task], agents.get(name, [])) for name in names]
        lines.append(f"| {task}, {TASKS[task].score} | {' | '.join(cells)} |")
    return "\n".join(lines)


def plans_of(config: Config) -> dict[tuple[str, str, int], Plan]:
    """Return the trainings that are wanted, by task, the agent's name in tables, and seed.

    Raises SystemExit for names that this program does not know, and for what `check` and `plan` refuse.
    """
    check(config)
    suite_tasks, suite_agents = SUITES[config.suite]
    tasks = config.tasks or suite_tasks
    agents = {name: suite_agents.get(name, name) for name in config.agents} or suite_agents
    scripts = {path.name: path for path in ROOT.glob("ppo_*.py")}
    names = [agent.partition(" --")[0] for agent in agents.values()]
    for given, known in ((tasks, TASKS), (names, AGENTS | scripts)):
        if unknown := [name for name in given if name not in known]:
            raise SystemExit(f"there is no {unknown[0]!r}; there are {'; '.join(known)}")
    return {
        (task, name, seed): plan(config, TASKS[task], agent, seed)
        for task in tasks
        for seed in config.seeds
        for name, agent in agents.items()
    }


def results_of(config: Config, plans: dict[tuple[str, str, int], Plan]) -> dict[str, evaluate.Runs]:
    """Return the finished runs by task and agent: a list for each, empty where there is no result."""
    tasks = {task: {} for task, _, _ in plans}
    for (task, agent, _), each in plans.items():
        runs = tasks[task].setdefault(agent, [])
        if (run := result_of(config, each)) is not None:
            runs.append(run)
    return tasks


def write_csv(results: Path, path: Path) -> int:
    """Write the scores of all runs to a table, a line for each evaluation, and return the number of runs."""
    names = ("env_id", "env_options", "exp_name", "script", "seed")
    files = sorted(results.glob("*/*.json.gz"))
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow((*names, "levels", "metric", "step", "hours", "mean", "episodes"))
        for each in files:
            run = evaluate.read_run(str(each))
            for curve, (steps, scores) in run.curves.items():
                levels, _, metric = curve.partition("/")
                if levels in ("eval", "test"):
                    about = [run.args[name] for name in names] + [levels.replace("eval", "development"), metric]
                    hours = run.hours(np.asarray(steps)) if run.has_seconds() else np.full(len(steps), math.nan)
                    for step, hour, score in zip(steps, hours, scores, strict=True):
                        table.writerow((*about, step, f"{hour:.4f}", f"{score.mean():.6g}", score.size))
    return len(files)


def main(config: Config) -> None:
    """Train what is missing, then print the tables and draw the curves.

    Raises SystemExit as `plans_of` does, for trainings that failed, and if there is nothing to show.
    """
    if config.csv is not None:
        print(f"{config.csv}: the scores of {write_csv(config.results, config.csv)} runs")
        return
    plans = plans_of(config)  # all at once: tyro, which parses their command lines, is not made for several threads
    if not config.report:
        train_missing(config, [*plans.values()])
    tasks = results_of(config, plans)
    found = {name: agents for name, agents in tasks.items() if any(agents.values())}
    if not found:
        raise SystemExit(f"{config.results} has no results of these agents; without --report they are trained")
    if len(found) > 1:
        print(f"{overview(found)}\n")
    for name, agents in found.items():
        print(f"## {TASKS[name].title}\n\n{table(TASKS[name], agents)}\n")
    for name, agents in tasks.items():
        lacking = {agent: len(config.seeds) - len(runs) for agent, runs in agents.items()}
        if missing := [f"{count} of {agent}" for agent, count in lacking.items() if count]:
            print(f"{name}: runs without a result: {'; '.join(missing)}")
    by_title = {TASKS[name].title: agents for name, agents in found.items()}
    evaluate.draw_tasks(by_title, str(config.out), {TASKS[name].title: (TASKS[name].score,) for name in found})


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C
    try:
        main(tyro.cli(Config))
    except OSError as error:
        sys.exit(f"learning.py: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
