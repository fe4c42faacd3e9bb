"""Does memory matter, and which one? Trains agents on a suite of tasks, and tabulates what they reach.

    python benchmarks/learning.py --tasks endless-mortar-mayhem --agents GRU TrXL TrXL+ --steps 6e6
    python benchmarks/learning.py --suite full --results benchmarks/results
    python benchmarks/learning.py --results benchmarks/results --csv results.csv

The small suite has tasks that take minutes on a core, the full one the ten environments as they are. Agents have
vector observations and small networks, and all see the same vectors, a frame stack the last few. Two sets of levels
are outside of the training set. Evaluations during training (6.1.3) are on the development levels, which follow the
training's: curves are made of them, settings and seeds chosen by them. At the end, the final weights play 1,000
test levels once: that is their score, without the levels that begin as one of the training's.

What a run reached is kept in a file of a few KB, in a folder of --results for its environment; `evaluate.py --curves`
can draw these files too. A run whose file is there is not trained again; one that was stopped goes on from its last
checkpoint in --folder. With --report, nothing is trained.
"""

import contextlib
import csv
import functools
import glob
import gzip
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
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the packages of this repository

import tables
from ppo_utils.checkpoints import read_model
from ppo_utils.evaluation import first_after
from ppo_utils.flags import PositiveInt, check_args, check_bounds, check_minibatches
from ppo_utils.run_logs import SECONDS, NoCurvesError, RunLog, Runs, align, read_run
from ppo_utils.runs import parse_args
from ppo_utils.scores import own_metric
from ppo_utils.terminal import one_line_exit
from suites import AGENTS, SUITES, TASKS, Task, short

ROOT = Path(__file__).parent.parent
COMMON = "--preset laptop --save-model"  # an agent's own flags override these
FIRST_TEST_LEVEL, TEST_LEVELS = 1_000_000, 1000  # that final weights play, each once
# Scalars that tell how an iteration's update went.
UPDATE_CURVES = ("losses/grad_norm", "losses/entropy", "charts/gradient_steps", "charts/learning_rate")


@dataclass
class Training:
    """How agents are trained, and where that goes."""

    steps: PositiveInt | None = None
    """environment steps to train for (default: the task's)"""
    seeds: tuple[int, ...] = (1, 2, 3)
    """a training run each"""
    jobs: PositiveInt = os.cpu_count() or 1
    """runs at the same time, of OMP_NUM_THREADS threads each, else of one, with images of their share of the cores"""
    evaluations: PositiveInt = 20
    """at least so many evaluations of a training, at even distances, and one at its end; at most one an iteration"""
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
    out: Path = Path("learning/curves.png")
    """draw the curves to this file"""
    draw: tuple[str, ...] = ()
    """the agents whose curves to draw, all by default"""
    csv: Path | None = None
    """write the scores of all runs in --results to this file, a line for each evaluation, and do nothing else"""


def file_name(agent: str) -> str:
    """Return an agent's name as part of a file's name."""
    return re.sub(r"\W+", "-", agent.replace("+", "plus"))


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
    try:
        check_bounds(config)
    except ValueError as error:
        raise SystemExit(str(error)) from None
    if not config.seeds or len(set(config.seeds)) < len(config.seeds):
        raise SystemExit(f"--seeds is {' '.join(map(str, config.seeds)) or 'empty'}; give at least one, and each once")


@functools.cache
def parse(script: str, *flags: str) -> Any:
    """Return what a script's flags stand for, checked. That takes a tenth of a second, which seeds and claims share.

    Raises ValueError or OSError for what the script refuses.
    """
    module = importlib.import_module(Path(script).stem)
    args = parse_args(module.Args, module.PRESETS, [*flags])
    check_args(args)
    with torch.device("meta"):  # its weights are not needed, and take longer than all else
        memory = module.Memory(args, module.Memory.input_width(args))
    check_minibatches(args, memory)
    return args


def plan(config: Training, task: Task, agent: str, seed: int) -> Plan:
    """Plan a training run; an agent is a name in `AGENTS` or another script, which further flags may follow.

    Raises SystemExit for flags that the script refuses, or that belong to the suite.
    """
    steps = config.steps or task.total_timesteps
    of_the_suite = {
        "env_id": task.env_id,
        "env_options": json.dumps(task.options),
        "total_timesteps": steps,
        "exp_name": file_name(agent),
    }
    name, dashes, further = agent.partition(" --")
    script, *memory = AGENTS.get(name, name).split()
    own = "" if "trxl" in script else task.gru_flags
    flags = [*COMMON.split(), *memory, *own.split()]
    flags += ["--anneal-steps", str(steps)]
    for each, value in of_the_suite.items():
        flags += [f"--{each.replace('_', '-')}", str(value)]
    flags += f"{dashes}{further}".split()
    try:
        parsed = parse(script, *flags)
        args = replace(parsed, seed=seed)
        check_args(args)
    except (ValueError, OSError) as error:
        raise SystemExit(f"{agent}: {error}") from None
    theirs = {each: getattr(args, each) for each in of_the_suite}
    if theirs != of_the_suite or parsed.seed != type(parsed).seed or args.eval_interval or args.resume:
        raise SystemExit(
            f"{agent}: an agent has no task, steps, name, seed or evaluations of its own, and goes on with no other "
            "run; use --tasks, --steps, --seeds and --evaluations"
        )
    if not args.save_model:
        raise SystemExit(f"{agent}: --no-save-model leaves no weights to score")
    if first_after(args) + args.eval_levels > FIRST_TEST_LEVEL:
        raise SystemExit(
            f"{agent}: levels below {FIRST_TEST_LEVEL:,} are for training and its evaluations, those from there on for "
            f"the test; it has {args.num_levels:,} from {args.start_level:,} on, and {args.eval_levels} to evaluate"
        )
    iterations = args.total_timesteps // (args.num_envs * args.num_steps)
    args.eval_interval = max(1, iterations // config.evaluations)
    flags += ["--seed", str(seed), "--eval-interval", str(args.eval_interval)]
    return Plan(task, agent, seed, (sys.executable, str(ROOT / script), *flags), args)


def runs_in(place: str, plan: Plan) -> list[RunLog]:
    """Return the runs that were planned so among the folders, or the files of results, in a place."""
    wanted = settings(plan.logged_args())
    found = []
    for path in sorted(glob.glob(f"{glob.escape(place)}/{plan.task.env_id}__*__{plan.seed}__*")):
        with contextlib.suppress(NoCurvesError):
            is_file = os.path.isfile(path)  # a folder changes while it is trained
            found.append(read_file(path, os.stat(path).st_mtime_ns) if is_file else read_run(path))
    return [run for run in found if settings(run.args) == wanted]


@functools.cache
def read_file(path: str, changed: int) -> RunLog:
    """Read a file of results: once, as long as it was `changed` at the same time, in nanoseconds."""
    return read_run(path)


def settings(args: dict[str, str]) -> dict[str, str]:
    """Return the arguments of a run that say how it learned.

    Not its name, nor what it went on from; nor whether it reads lists of commands by attention, where there are none.
    """
    ignored = {"exp_name", "resume"} | (set() if "MortarMayhemB" in args["env_id"] else {"attend_commands"})
    return {name: value for name, value in args.items() if name not in ignored}


def result_of(config: Training, plan: Plan) -> RunLog | None:
    """Return the finished run, if its result is there."""
    return next(iter(runs_in(f"{config.results}/{plan.task.env_id}", plan)), None)


def has_all_steps(run: RunLog) -> bool:
    """Return whether a run has trained for all its steps."""
    total, *batch = (int(run.args[name]) for name in ("total_timesteps", "num_envs", "num_steps"))
    return run.has_seconds() and run.last_step + math.prod(batch) > total


def is_complete(run: RunLog) -> bool:
    """Return whether the run of a folder has all its steps and has written its final weights, not just earlier ones."""
    model = Path(run.path) / "model.pt"
    return has_all_steps(run) and model.is_file() and read_model(model)["step"] == run.last_step


def expected_hours(config: Training, missing: list[Plan]) -> str:
    """Return about how many hours the trainings take, by the results of the same scripts that are there; or nothing."""
    speeds = {}
    for path in config.results.glob("*/*.json.gz"):
        with contextlib.suppress(NoCurvesError):
            run = read_file(str(path), path.stat().st_mtime_ns)
            if run.has_seconds():
                speeds.setdefault(run.args["script"], []).append(run.last_step / run.seconds("iteration").sum())
    scripts = [Path(plan.command[1]).stem for plan in missing]
    if not {*scripts} <= {*speeds}:
        return ""
    seconds = sum(
        plan.args.total_timesteps / np.median(speeds[name]) for plan, name in zip(missing, scripts, strict=True)
    )
    return f", about {seconds / 3600 / min(config.jobs, len(missing)):.1f} hours"


RUNNING = set()  # training processes, to be stopped with this one
STOPPING = threading.Event()


def log_of(config: Training, plan: Plan) -> Path:
    """Return the file that a training's output goes to: another one for each command."""
    command_hash = zlib.crc32(json.dumps(plan.command[2:]).encode())
    return config.folder / f"{plan.task.env_id}-{file_name(plan.agent)}-{plan.seed}-{command_hash:08x}.log"


def steps_so_far(config: Training, plan: Plan) -> int:
    """Return how many steps a training has done, by the script's progress bar at the end of its log."""
    log = log_of(config, plan)
    bars = re.findall(r"([\d.]+)([kMG]?)/[\d.]+[kMG]? \[", log.read_text()[-1000:] if log.exists() else "")
    number, unit = bars[-1] if bars else ("0", "")
    return int(float(number) * {"": 1, "k": 1e3, "M": 1e6, "G": 1e9}[unit])


def environment(config: Training, plan: Plan) -> dict[str, str]:
    """Return the variables for a training or its evaluation: as many threads as `Training.jobs` says."""
    threads = 1 if plan.args.obs_type == "vector" else max(1, (os.cpu_count() or 1) // config.jobs)
    return {"OMP_NUM_THREADS": str(threads), **os.environ, "TQDM_MININTERVAL": "10"}


def train(config: Training, plan: Plan) -> None:
    """Run a training, or go on with one that was stopped; raise SystemExit that names its log if it fails."""
    line = plan.command
    for run in runs_in(f"{config.folder}/runs", plan):
        if glob.glob(f"{glob.escape(run.path)}/checkpoint-*.pt"):
            line = [*line[:2], "--resume", os.path.relpath(run.path, config.folder)]
    log = log_of(config, plan)
    with log.open("a") as output:
        # In a session of its own, Ctrl-C does not reach it: `train_missing` stops it, so that it leaves a checkpoint.
        how = {
            "cwd": config.folder,
            "env": environment(config, plan),
            "stdout": output,
            "stderr": output,
            "start_new_session": True,
        }
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
    metric = plan.task.score
    curves = run.curves | test_scores(config, plan, run)
    ends = [curves.get(f"{levels}/{metric}", ([0], None))[0][-1] for levels in ("eval", "test")]
    if ends != [run.last_step] * 2:
        raise SystemExit(
            f"{plan}, has no {metric} at its end: an evaluation was cut short; give the agent more steps, as "
            f'"{plan.agent} --eval-max-steps 100000"'
        )
    result = config.results / plan.task.env_id / f"{Path(run.path).name}.json.gz"
    result.parent.mkdir(parents=True, exist_ok=True)
    write_run(replace(run, curves=curves, machine=machine()), str(result))


def write_run(run: RunLog, path: str) -> None:
    """Write what tables and pictures need, in a few KB; `read_run` reads it as it reads the run's folder.

    That is the machine, the commit now, the arguments, the evaluations in the family's own metric, return, length and
    falls, those on test levels too, the seconds of each iteration, and the curves UPDATE_CURVES, averaged to POINTS.
    Steps are kept as differences, which compress better.
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
            about = {"machine": run.machine, "commit": commit(), "args": run.args}
            json.dump({**about, "curves": curves}, file, separators=(",", ":"))
        os.replace(part, path)  # a file that is there is complete
    finally:
        part.unlink(missing_ok=True)


def test_scores(config: Training, plan: Plan, run: RunLog) -> dict[str, tuple[list[int], np.ndarray]]:
    """Let the run's final weights play the test levels; return a curve of one point for each metric.

    Raises SystemExit if that fails.
    """
    scores = Path(run.path) / "test_scores.json"
    flags = ["--start-level", FIRST_TEST_LEVEL, "--levels", TEST_LEVELS, "--repeats", 1, "--json", scores]
    flags += ["--max-steps", plan.args.eval_max_steps]
    command = [sys.executable, ROOT / "evaluate.py", Path(run.path) / "model.pt", *flags]
    how = {"env": environment(config, plan), "capture_output": True, "text": True, "check": False}
    done = subprocess.run([str(each) for each in command], **how)
    if done.returncode:
        raise SystemExit(f"{plan}, could not be scored: {done.stderr.strip()}")
    (task,) = json.loads(scores.read_text())
    (agent,) = task["agents"]
    return {f"test/{name}": ([run.last_step], np.array(each["scores"])) for name, each in agent["metrics"].items()}


def machine() -> str:
    """Name this machine's processor, its number of cores, its GPU if there is one, and the version of PyTorch."""
    cpuinfo = Path("/proc/cpuinfo")  # of Linux; elsewhere, Python knows the name
    models = re.findall(r"^model name\s*: (.*)", cpuinfo.read_text() if cpuinfo.exists() else "", re.MULTILINE)
    processor = models[0] if models else platform.processor() or platform.machine()
    gpu = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    return f"{processor}, {os.cpu_count()} cores{gpu}, PyTorch {version('torch')}"


def commit() -> str:
    """Name the commit of the code that writes a result, "-dirty" where that was changed; empty without a repository."""
    line = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(line, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def train_missing(config: Training, wanted: list[Plan]) -> None:
    """Do the trainings that have no result, some at a time, and show how far they are and how long it takes.

    Raises SystemExit, at the end, if some failed.
    """
    for folder in (config.folder, config.results):
        folder.mkdir(parents=True, exist_ok=True)
    missing = [plan for plan in wanted if result_of(config, plan) is None]
    steps = sum(plan.args.total_timesteps for plan in missing)
    if missing:
        runs = "run" if len(missing) == 1 else "runs"
        hours = expected_hours(config, missing)
        tqdm.write(f"{len(missing)} {runs} to train, {steps:,} steps, {config.jobs} at a time{hours}")
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


def plans_of(config: Config) -> dict[tuple[str, str, int], Plan]:
    """Return the trainings that are wanted, by task, the agent's name in tables, and seed.

    Raises SystemExit for names that this program does not know, and for what `check` and `plan` refuse.
    """
    check(config)
    suite_tasks, suite_agents = SUITES[config.suite]
    tasks = config.tasks or suite_tasks
    agents = {short(name): name for name in config.agents or suite_agents}
    if len(agents) < len(config.agents):
        raise SystemExit(f"two of these agents have the same name in tables: {', '.join(map(short, config.agents))}")
    scripts = {path.name: path for path in ROOT.glob("ppo_*.py")}
    names = [agent.partition(" --")[0] for agent in agents.values()]
    for given, known in ((tasks, TASKS), (names, AGENTS | scripts), (config.draw, agents)):
        if unknown := [name for name in given if name not in known]:
            raise SystemExit(f"there is no {unknown[0]!r}; there are {'; '.join(known)}")
    return {
        (task, name, seed): plan(config, TASKS[task], agent, seed)
        for task in tasks
        for seed in config.seeds
        for name, agent in agents.items()
    }


def stored_results(**config: Any) -> dict[str, Runs]:
    """Return the runs in benchmarks/results that a `Config` describes, by task and agent.

    Raises SystemExit if an agent has some of the seeds, but fewer than three and not all.
    """
    stored = Config(results=ROOT / "benchmarks/results", **config)
    tasks = results_of(stored, plans_of(stored))
    for task, agents in tasks.items():
        for agent, runs in agents.items():
            if runs and not are_enough(runs, stored.seeds):
                raise SystemExit(f"{stored.results} has {len(runs)} of {len(stored.seeds)} seeds of {agent} in {task}")
    return tasks


def are_enough(runs: list[RunLog], seeds: tuple[int, ...]) -> bool:
    """Return whether these are all of the seeds, or three: of more, some agents need not have all."""
    return len(runs) >= min(len(seeds), 3)


def results_of(config: Config, plans: dict[tuple[str, str, int], Plan]) -> dict[str, Runs]:
    """Return the finished runs by task and agent: a list for each, empty where there is no result."""
    tasks = {task: {} for task, _, _ in plans}
    for (task, agent, _), each in plans.items():
        runs = tasks[task].setdefault(agent, [])
        if (run := result_of(config, each)) is not None:
            runs.append(run)
    return tasks


def write_csv(results: Path, path: Path) -> int:
    """Write the scores of all runs to a table, a line for each evaluation, and return the number of runs.

    On test levels they are those of the tables: of new levels only, where there are any. Runs with the same `settings`,
    a checksum, are seeds of one agent; exp_name is its name when it was trained.
    """
    names = ("env_id", "env_options", "exp_name", "script", "seed", "total_timesteps")
    files = sorted(results.glob("*/*.json.gz"))
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("run", *names, "settings", "levels", "metric", "step", "hours", "mean", "episodes"))
        for each in files:
            run = read_run(str(each))
            of_agent = sorted(settings(run.args | {"seed": ""}).items())
            checksum = f"{zlib.crc32(json.dumps(of_agent).encode()):08x}"
            for curve, (steps, scores) in run.curves.items():
                levels, _, metric = curve.partition("/")
                if levels in ("eval", "test"):
                    if levels == "test":
                        scores = tables.final_scores(metric, [run])
                    about = [each.name.removesuffix(".json.gz"), *(run.args[name] for name in names)]
                    about += [checksum, levels.replace("eval", "development"), metric]
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
    bounds, thesis = tables.read_bounds(), tables.read_thesis()
    for text in (tables.overview(found, bounds, thesis), tables.differing(found), tables.aggregate(found, bounds)):
        print(f"{text}\n" if text else "")
    for name, agents in found.items():
        print(f"## {TASKS[name].title}\n\n{tables.table(TASKS[name], agents)}\n")
    for name, agents in tasks.items():
        lacking = {agent: len(config.seeds) - len(runs) for agent, runs in agents.items()}
        if missing := [f"{count} of {agent}" for agent, count in lacking.items() if count]:
            print(f"{name}: runs without a result: {'; '.join(missing)}")
    wanted = config.draw or tuple(dict.fromkeys(agent for agents in found.values() for agent in agents))
    drawn = {name: {agent: agents[agent] for agent in wanted if agent in agents} for name, agents in found.items()}
    tables.draw(drawn, config.out)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C
    with one_line_exit(OSError, ValueError):
        main(tyro.cli(Config))
