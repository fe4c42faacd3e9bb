"""Search for settings that learn fast and do not fall back, on several small tasks at once, with Optuna.

    python benchmarks/tune.py --script ppo_gru --hours 6
    python benchmarks/tune.py --script ppo_gru --report

The thesis looked for a single setting for all environments with Optuna's tree-structured Parzen estimator (TPE) and
percentile pruner (6.1.1), and so does this program, on the tasks of benchmarks/learning.py. The networks have the
widths of --preset laptop, whose settings are the first trial. The search is kept in FOLDER/SCRIPT.journal: the same
command goes on where it stopped, and several processes on the same file work together. A trial whose process was killed
is tried again first.

A trial trains an agent on every task. Its score is the mean over the tasks of

    (area + low) / 2

where a task's curve has the mean score of the training episodes in each of 24 slices of the training. `area` is the
curve's mean: of two agents that end equally well, the one that learned earlier has the larger one. `low` is the curve's
minimum over the last third: it is high only for an agent that had learned by then and did not fall back. A slice has
hundreds of episodes, so that a minimum over eight slices is not mere noise. Both need no evaluations. Scores are the
tasks' own, from 0 to 1; the endless task has log(1 + commands) / log(21), which does not saturate: going from 5 to 10
commands counts about as much as going from 10 to 20, and beyond 20 there is more to gain.

Pruning: the tasks are trained in turns, slice by slice, so that a trial is always judged by all of them. Training one
task after the other would make bad trials cheaper, but would judge most of them by the first task alone. After each
slice a trial reports what no later slice can take away: half of its areas so far. That only grows, which suits the
pruner, since it compares a trial's best report so far with the other trials' reports at that slice. Half of each
training is warm-up: in Mystery Path little is learned before a quarter of it, and an agent that explores for longer
starts behind, as one with the preset's log barrier does. Half of the trials are kept, where the thesis kept a quarter:
the pruner compares with completed trials only, and these are the better ones.

The tasks take --steps-scale 0.6 of the steps that benchmarks/learning.py gives them, 0.6 to 0.9 million: the aim is to
learn them sooner. Learning rate and entropy bonus decay over these steps, so that the end of a training shows what a
small learning rate does. As in the thesis (6.1.1), a trial is not repeated with other seeds: the tasks are its
repetitions. But the best of many noisy scores is partly luck. This trains the preset and the best five of the search
again with other seeds, for as many steps as benchmarks/learning.py does, and prunes none:

    python benchmarks/tune.py --again tune --folder tune-again --trials 6 --seeds 2 3 4 --steps-scale 1 --keep 100

Shape letter: S slices of a training.
"""

import contextlib
import fcntl
import io
import itertools
import json
import math
import multiprocessing
import os
import shutil
import signal
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np
import torch
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # before other packages that are named evaluate

import ppo_gru
import ppo_trxl
from learning import SMALL, TASKS, Task
from ppo_utils.flags import as_flags, flag
from ppo_utils.runs import close, parse_args

try:
    import optuna
    from matplotlib import color_sequences
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator
    from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, distribution_to_json
    from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances
    from optuna.storages.journal import JournalFileBackend, JournalStorage
    from optuna.trial import FrozenTrial, TrialState
except ImportError as error:
    raise SystemExit(f'benchmarks/tune.py needs {error.name}: pip install -e ".[eval,tune]"') from None


def log_range(low: float, high: float) -> BaseDistribution:
    """Return a range of numbers, sampled on a logarithmic scale."""
    return FloatDistribution(low, high, log=True)


def one_of(*choices: Any) -> BaseDistribution:
    """Return a parameter that takes one of these values."""
    return CategoricalDistribution(choices)


SCRIPTS = {"ppo_gru": ppo_gru, "ppo_trxl": ppo_trxl}


# ---- SPACE ----
# A parameter has the name of the script's argument that it is, but for those that `settings` translates.
SPACE = {
    "init_lr": log_range(1e-4, 3e-3),
    "final_lr_fraction": log_range(0.01, 1.0),  # of init_lr
    "exploration_bonus": one_of("entropy", "log-barrier"),
    "init_ent_coef": log_range(1e-5, 3e-2),
    "final_ent_fraction": log_range(0.01, 1.0),  # of init_ent_coef
    # num_envs x num_steps. Fewer environments make a step costly, larger rollouts leave few updates.
    "layout": one_of("32x64", "64x64", "32x128", "64x128", "32x256"),
    "num_minibatches": one_of(2, 4, 8, 16),
    "update_epochs": one_of(2, 3, 4),  # table 6.1; a training's time is nearly proportional to it
    "clip_coef": one_of(0.1, 0.2, 0.3),  # table 6.1
    "max_grad_norm": one_of(0.25, 0.35, 0.5, 1.0),  # table 6.1
    "target_kl": one_of(None, 0.02, 0.05, 0.1),
    "gamma": one_of(0.98, 0.99, 0.995, 0.998),  # looks ahead 50, 100, 200, 500 steps: the tasks' episodes are as long
    "gae_lambda": one_of(0.9, 0.95, 0.98),
    "vf_coef": one_of(0.25, 0.5, 1.0),
    "clip_vloss": one_of(True, False),
    "norm_adv": one_of("minibatch", "none", "batch"),  # table 6.1
}
OWN_SPACE = {
    "ppo_gru": {
        "seq_len": one_of(0, 16, 32, 64),
    },
    "ppo_trxl": {
        "trxl_gate": one_of("none", "gru"),
        # Not the learned encoding of table 6.1: its table has an end, and an endless episode has none.
        "trxl_positional_encoding": one_of("absolute", "relative", "none"),
        "trxl_query_position": one_of(False, True),
        "trxl_segment_length": one_of(16, 32, 64, 128),
        "trxl_memory_gradient": one_of(False, True),
        "trxl_init": one_of("xavier", "orthogonal", "kaiming", "tfixup"),  # table 6.1
    },
}
SLICES = 24  # S
WARM_UP = SLICES // 2  # slices before a trial may be pruned
UNPRUNED_TRIALS = 8  # complete trials before the first may be pruned
COMMANDS = 20  # that count as a score of 1 in the endless task
BEST_SHOWN = 5  # trials
PRESET = "preset"  # the name of the trial with the preset's settings
IMPORTANCES_FROM = 10  # complete trials; from fewer, they would be noise


@dataclass
class Config:
    """What to search, and for how long."""

    script: Literal["ppo_gru", "ppo_trxl"] = "ppo_gru"
    """whose settings"""
    trials: int = 100
    """trials of the search in all, those of earlier calls included"""
    hours: float = math.inf
    """begin no trial after that"""
    jobs: int = 1
    """worker processes, one thread each"""
    tasks: tuple[str, ...] = tuple(SMALL)
    """of those that benchmarks/learning.py knows"""
    steps_scale: float = 0.6
    """share of a task's steps that a trial trains for"""
    seeds: tuple[int, ...] = (1,)
    """a trial trains with each of them on each task"""
    keep: float = 50.0
    """percent of the trials that the pruner keeps"""
    sampler_seed: int = 1
    """seed of what the search draws"""
    folder: Path = Path("tune")
    """where the search is kept"""
    again: Path | None = None
    """folder of another search; its best five are the first trials of a new one, after the preset"""
    report: bool = False
    """search no further, report what was found"""
    out: Path | None = None
    """draw to OUT.png (by default FOLDER/SCRIPT.png)"""


def space_of(script: str) -> dict[str, BaseDistribution]:
    """Return what is searched for a script, by the name of the parameter."""
    return SPACE | OWN_SPACE[script]


def settings(params: dict[str, Any]) -> dict[str, Any]:
    """Return the script's arguments that parameters stand for, numbers rounded to three digits."""
    found = dict(params)
    num_envs, num_steps = found.pop("layout").split("x")
    found["final_lr"] = found["init_lr"] * found.pop("final_lr_fraction")
    found["final_ent_coef"] = found["init_ent_coef"] * found.pop("final_ent_fraction")
    rounded = {name: float(f"{value:.3g}") if isinstance(value, float) else value for name, value in found.items()}
    return {**rounded, "num_envs": int(num_envs), "num_steps": int(num_steps)}


def parse(script: str, *flags: str) -> Any:
    """Return the script's Args for these flags."""
    return parse_args(SCRIPTS[script].Args, SCRIPTS[script].PRESETS, [*flags])


def preset_params(script: str) -> dict[str, Any]:
    """Return the parameters that stand for --preset laptop: the inverse of `settings`."""
    args = parse(script, "--preset", "laptop")
    translated = {
        "layout": f"{args.num_envs}x{args.num_steps}",
        "final_lr_fraction": args.final_lr / args.init_lr,
        "final_ent_fraction": args.final_ent_coef / args.init_ent_coef,
    }
    return {name: translated[name] if name in translated else getattr(args, name) for name in space_of(script)}


def arguments(config: Config, task: Task, params: dict[str, Any], seed: int, name: str) -> Any:
    """Return the script's Args to train with on a task. The task's own flags give way to the parameters."""
    total = int(task.total_timesteps * config.steps_scale)
    return replace(
        parse(config.script, "--preset", "laptop", *task.flags.split()),
        **settings(params),
        **{"env_id": task.env_id, "env_options": json.dumps(task.options), "exp_name": name, "seed": seed},
        **{"total_timesteps": total, "anneal_steps": total, "cuda": False, "checkpoint_interval": 0},
    )


# ---- SCORE ----
def normalized(task: Task, scores: list[float]) -> float:
    """Return the mean score of episodes, 0 to 1, in an endless task possibly above."""
    if task.env_id.startswith("Endless"):
        return float(np.log1p(scores).mean() / math.log1p(COMMANDS))
    return float(np.mean(scores))


def area_and_low(curve: np.ndarray) -> tuple[float, float]:
    """Return the mean of a curve (S,) and its minimum over the last third."""
    return float(curve.mean()), float(curve[-math.ceil(len(curve) / 3) :].min())


def score(curves: np.ndarray) -> float:
    """Return a trial's score from the curves (trainings, S) of its trainings."""
    return float(np.mean([area_and_low(curve) for curve in curves]))


def lower_bound(curves: np.ndarray) -> float:
    """Return the score that is certain after the slices so far, (trainings, at most S): as if the others were 0."""
    return float(curves.sum(1).mean() / SLICES / 2)


# ---- TRAINING ----
def slices(script: ModuleType, args: Any, task: Task) -> Iterator[float]:
    """Train, and yield each slice's mean score.

    A slice in which no episode ended has the last one's, and after a training has diverged all are 0.
    """
    run = start(script, args)
    last = 0.0
    iterations = np.arange(args.total_timesteps // (args.num_envs * args.num_steps))
    try:
        for part in np.array_split(iterations, SLICES):
            scores = [each for _ in part for each in iteration(script, args, run, task.metric)]
            last = normalized(task, scores) if scores else last
            generator = torch.get_rng_state()
            yield last
            torch.set_rng_state(generator)  # the other trainings drew from it meanwhile
    except FloatingPointError:
        while True:
            yield 0.0
    finally:
        close(run)


def start(script: ModuleType, args: Any) -> Any:
    """Set a training up that leaves no files and draws no progress bar; raise what the script's `setup` raises."""
    with contextlib.redirect_stderr(io.StringIO()):
        run = script.setup(args)
    run.writer.close()
    run.bar.close()
    shutil.rmtree(run.folder)
    run.writer = run.bar = None
    return run


def iteration(script: ModuleType, args: Any, run: Any, metric: str) -> list[float]:
    """Train for an iteration; return the scores of the episodes that ended in it.

    Raises FloatingPointError if the training diverges.
    """
    script.train(replace(args, total_timesteps=run.step + args.num_envs * args.num_steps), run)
    return run.episodes.get("charts/episodic_return" if metric == "return" else f"episode/{metric}", [])


def run_trial(trial: optuna.Trial, config: Config) -> float | None:
    """Train on all tasks in turns, slice by slice; return the trial's score, or None if it was pruned."""
    began = time.monotonic()
    trainings = []
    with contextlib.ExitStack() as stack:
        for task, seed in itertools.product([TASKS[name] for name in config.tasks], config.seeds):
            args = arguments(config, task, trial.params, seed, f"trial-{trial.number}")
            training = slices(SCRIPTS[config.script], args, task)
            trainings.append(stack.enter_context(contextlib.closing(training)))
        curves = np.empty((len(trainings), 0))
        while curves.shape[1] < SLICES:
            curves = np.column_stack([curves, [next(training) for training in trainings]])
            trial.report(lower_bound(curves), curves.shape[1] - 1)
            is_last = curves.shape[1] == SLICES
            if not is_last and trial.should_prune():
                break
            if is_orphan():
                raise SystemExit("the search that started this process has ended")
    trial.set_user_attr("curves", curves.tolist())
    trial.set_user_attr("seconds", time.monotonic() - began)
    return score(curves) if is_last else None


def is_orphan() -> bool:
    """Return whether this is a worker process whose parent was killed."""
    parent = multiprocessing.parent_process()
    return parent is not None and not parent.is_alive()


# ---- SEARCH ----
@contextlib.contextmanager
def locked(path: Path, wait: bool = True) -> Iterator[None]:
    """Hold a lock that ends with the process, however it ends; raise BlockingIOError if it is taken and not waited for.

    That tells a trial that is running from one whose process was killed, which Optuna cannot do with a file.
    """
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield


def lock_path(config: Config, number: int) -> Path:
    """Return the file that is locked while a trial runs."""
    return config.folder / "locks" / f"{config.script}-{number}"


def open_study(config: Config) -> optuna.Study:
    """Open the search, or begin it with the preset; queue what a killed process had begun.

    Raises ValueError if the folder holds a search whose scores do not compare, or as `first_trials` does.
    """
    first = first_trials(config)
    (config.folder / "locks").mkdir(parents=True, exist_ok=True)
    pruner = optuna.pruners.PercentilePruner(config.keep, UNPRUNED_TRIALS, WARM_UP - 1)
    if config.keep == 100:  # that pruner would still prune what is worse than all others
        pruner = optuna.pruners.NopPruner()
    wanted = {
        "--steps-scale": config.steps_scale,
        "--seeds": config.seeds,
        "--tasks": {name: asdict(TASKS[name]) | {"metric": TASKS[name].metric} for name in config.tasks},
        "search space": {name: distribution_to_json(each) for name, each in space_of(config.script).items()},
    }
    wanted = json.loads(json.dumps(wanted))  # as it is read from the file
    with locked(config.folder / "locks" / config.script):
        study = optuna.create_study(
            storage=storage(config), study_name=config.script, direction="maximize", pruner=pruner, load_if_exists=True
        )
        if not study.user_attrs:
            study.set_user_attr("search", wanted)
            for name, params in first.items():
                study.enqueue_trial(params, user_attrs={"name": name})
        found = study.user_attrs["search"]
        if differ := [name for name in wanted if found[name] != wanted[name]]:
            raise ValueError(f"{config.folder} holds a search with another {differ[0]}; use another --folder")
        queue_killed_trials(study, config)
    return study


def first_trials(config: Config) -> dict[str, dict[str, Any]]:
    """Return the preset's parameters by its name, and with --again those of the best trials of another search.

    Raises ValueError if that search has none.
    """
    first = {PRESET: preset_params(config.script)}
    if config.again is not None:
        found = best_trials(load_study(replace(config, folder=config.again)))
        others = [trial for trial in found if name_of(trial) != PRESET][:BEST_SHOWN]
        first |= {f"{name_of(trial)} of {config.again.name}": trial.params for trial in others}
    return first


def journal(config: Config) -> Path:
    """Return the file that the search is kept in."""
    return config.folder / f"{config.script}.journal"


def storage(config: Config) -> JournalStorage:
    """Open the file that the search is kept in, or make it."""
    return JournalStorage(JournalFileBackend(str(journal(config))))


def queue_killed_trials(study: optuna.Study, config: Config) -> None:
    """Mark the trials as failed that no process works on any more, and queue their parameters again."""
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        with contextlib.suppress(BlockingIOError), locked(lock_path(config, trial.number), wait=False):
            study.tell(trial.number, state=TrialState.FAIL)
            study.enqueue_trial(trial.params, user_attrs=trial.user_attrs)


def work(config: Config, until: float) -> None:
    """Run trials until there are enough or until time.time() is `until`; raise what a training raises."""
    torch.set_num_threads(1)
    study = open_study(config)
    before = os.getcwd()
    counted = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.RUNNING)
    os.chdir(config.folder)  # a script makes its run folder in the current one
    try:
        while time.time() < until:
            with contextlib.ExitStack() as stack:
                with locked(config.folder / "locks" / config.script):  # nobody sees a trial before it is locked
                    if len(study.get_trials(deepcopy=False, states=counted)) >= config.trials:
                        break
                    study.sampler = sampler(config, len(study.get_trials(deepcopy=False)))
                    trial = study.ask(space_of(config.script))
                    stack.enter_context(locked(lock_path(config, trial.number)))
                finish(study, trial, config)
    finally:
        os.chdir(before)


def sampler(config: Config, trials: int) -> optuna.samplers.BaseSampler:
    """Return a TPE sampler for the next trial, after so many: its seed is another one for each."""
    seed = int(np.random.SeedSequence([config.sampler_seed, trials]).generate_state(1)[0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        # multivariate: a learning rate that suits two epochs need not suit four.
        # constant_liar: what other processes are trying counts as bad, so that not all try the same.
        return optuna.samplers.TPESampler(seed=seed, multivariate=True, constant_liar=True)


def finish(study: optuna.Study, trial: optuna.Trial, config: Config) -> None:
    """Run a trial, print its line and hand its score to the search; raise what a training raises.

    What is no Exception, as Ctrl-C, leaves the trial for the next start, as a kill does.
    """
    try:
        value = run_trial(trial, config)
    except Exception:
        study.tell(trial, state=TrialState.FAIL)
        raise
    study.tell(trial, value, state=TrialState.PRUNED if value is None else TrialState.COMPLETE)
    found = trial.user_attrs
    result = f"pruned after {len(found['curves'][0])} of {SLICES} slices" if value is None else f"score {value:.3f}"
    print(f"trial {trial.number}: {result}, {found['seconds']:.0f} s", flush=True)


def worker_process(config: Config, until: float) -> None:
    """Run trials in a process of its own; Ctrl-C is for the parent, which ends this one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    work(config, until)


def search(config: Config) -> None:
    """Run trials in as many processes as wanted; Ctrl-C ends the search. Raises ValueError as `open_study` does."""
    until = time.time() + 3600 * config.hours
    open_study(config)
    processes = []
    try:
        if config.jobs == 1:
            work(config, until)
            return
        os.environ["OMP_NUM_THREADS"] = "1"
        context = multiprocessing.get_context("spawn")
        processes = [context.Process(target=worker_process, args=(config, until)) for _ in range(config.jobs)]
        for process in processes:
            process.start()
        for process in processes:
            process.join()
        if any(process.exitcode for process in processes):
            raise SystemExit("a worker process failed: see its message above")
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here")
    finally:
        for process in processes:
            process.terminate()


# ---- REPORT ----
def load_study(config: Config) -> optuna.Study:
    """Open a search that was begun earlier; raise ValueError if there is none."""
    if not journal(config).is_file():
        raise ValueError(f"there is no search of {config.script} in {config.folder}")
    return optuna.load_study(study_name=config.script, storage=storage(config))


def best_trials(study: optuna.Study) -> list[FrozenTrial]:
    """Return the complete trials, the best one first; raise ValueError if there are none."""
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if not complete:
        raise ValueError(f"no trial of {study.study_name} is complete yet")
    return sorted(complete, key=lambda trial: -trial.value)


def importances(study: optuna.Study, complete: list[FrozenTrial]) -> dict[str, float]:
    """Return how much each parameter matters for being among the best quarter (PED-ANOVA), the largest first.

    The numbers sum to 1. There are none where complete trials are few.
    """
    if len(complete) < IMPORTANCES_FROM:
        return {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return get_param_importances(study, evaluator=PedAnovaImportanceEvaluator(target_quantile=0.25))


def name_of(trial: FrozenTrial) -> str:
    """Return what a trial is called: its number, unless its settings were given."""
    return trial.user_attrs.get("name", f"trial {trial.number}")


def trials_table(trials: list[FrozenTrial], tasks: list[str]) -> str:
    """Return a Markdown table with a column for each trial: its scores, then its settings."""
    rows = {"score": [f"{trial.value:.3f}" for trial in trials]}
    for i, name in enumerate(tasks):
        cells = [np.array(trial.user_attrs["curves"]).reshape(len(tasks), -1, SLICES)[i] for trial in trials]
        pairs = [np.mean([area_and_low(curve) for curve in curves], axis=0) for curves in cells]
        rows[f"{name}: area, low"] = ["{:.2f}, {:.2f}".format(*pair) for pair in pairs]
    rows["minutes"] = [f"{trial.user_attrs['seconds'] / 60:.1f}" for trial in trials]
    found = [settings(trial.params) for trial in trials]
    rows |= {f"`{flag(name)}`": [f"{each[name]}" for each in found] for name in found[0]}
    lines = [["", *map(name_of, trials)], ["---", *["---:"] * len(trials)]]
    lines += [[name, *cells] for name, cells in rows.items()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def flags_of(params: dict[str, Any]) -> str:
    """Return parameters as flags of the script."""
    return f"--preset laptop {as_flags(settings(params))}"


def report(config: Config) -> None:
    """Print tables and draw the picture. Raises ValueError if there is nothing to report yet."""
    study = load_study(config)
    complete = best_trials(study)
    states = [trial.state for trial in study.get_trials(deepcopy=False)]
    counts = ", ".join(f"{states.count(state)} {state.name.lower()}" for state in dict.fromkeys(states))
    shown = [*complete[:BEST_SHOWN], *(trial for trial in complete[BEST_SHOWN:] if "name" in trial.user_attrs)]
    tasks = list(study.user_attrs["search"]["--tasks"])
    print(f"\n{config.script}, trials: {counts}\n\n{trials_table(shown, tasks)}\n")
    print(f"The best one: `{flags_of(complete[0].params)}`\n")
    found = importances(study, complete)
    if not found:
        print(f"There are importances from {IMPORTANCES_FROM} complete trials on.")
    else:
        print("| parameter | importance |\n|---|---:|")
        print("\n".join(f"| {name} | {value:.2f} |" for name, value in found.items()))
    draw(study, list(found)[:3], config.out or config.folder / config.script)


def draw(study: optuna.Study, names: list[str], out: Path) -> None:
    """Draw the scores in the order of the trials, and against these parameters, to OUT.png."""
    figure = Figure(figsize=(6 + 3 * len(names), 4), layout="constrained")
    order, *others = figure.subplots(1, 1 + len(names), width_ratios=[1.6, *[1] * len(names)], squeeze=False)[0]
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    pruned = study.get_trials(deepcopy=False, states=(TrialState.PRUNED,))
    dot, best, cross, line = color_sequences["petroff10"][:4]
    numbers, values = [trial.number for trial in complete], [trial.value for trial in complete]
    order.plot(numbers, values, "o", color=dot, label="complete")
    order.step(numbers, np.maximum.accumulate(values), color=best, where="post", label="best so far")
    if pruned:
        late = [max(trial.intermediate_values.values()) for trial in pruned]
        order.plot([trial.number for trial in pruned], late, "x", color=cross, label="pruned: lower bound of its score")
    for preset in (trial.value for trial in complete if name_of(trial) == PRESET):
        order.axhline(preset, color=line, linestyle="--", label=PRESET)
    order.set(xlabel="trial", ylabel="score", title=f"{study.study_name}: scores of the trials")
    order.xaxis.set_major_locator(MaxNLocator(integer=True))
    order.legend(fontsize="small")
    for axis, name in zip(others, names, strict=True):
        draw_parameter(axis, name, complete)
    for axis in (order, *others):
        axis.grid(alpha=0.3)
    figure.savefig(f"{out}.png", dpi=100)


def draw_parameter(axis: Axes, name: str, complete: list[FrozenTrial]) -> None:
    """Draw the scores of complete trials against a parameter, later trials darker."""
    kind = complete[0].distributions[name]
    values = [trial.params[name] for trial in complete]
    if isinstance(kind, CategoricalDistribution):
        # Beside each other rather than on top of each other.
        shift = np.random.default_rng(0).uniform(-0.15, 0.15, len(values))
        values = [kind.choices.index(value) for value in values] + shift
        axis.set_xticks(range(len(kind.choices)), [str(choice) for choice in kind.choices])
    else:
        axis.set(xscale="log", xlim=(kind.low / 1.1, kind.high * 1.1))
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 3) if kind.high <= 100 * kind.low else (1,)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_locator(NullLocator())
    numbers, scores = [trial.number for trial in complete], [trial.value for trial in complete]
    axis.scatter(values, scores, c=numbers, cmap="Blues", edgecolors="gray", vmin=-max(numbers))
    axis.set(xlabel=f"{name} (later trials are darker)")


# ---- COMMAND LINE ----
def check(config: Config) -> None:
    """Raise ValueError, naming the flag, for the first value that cannot work."""
    for name in ("trials", "jobs"):
        if getattr(config, name) < 1:
            raise ValueError(f"{flag(name)} is {getattr(config, name)}; it must be 1 or more")
    if not config.hours > 0:
        raise ValueError(f"--hours is {config.hours}; it must be above 0")
    if not 0 < config.steps_scale < math.inf:
        raise ValueError(f"--steps-scale is {config.steps_scale}; it must be a number above 0")
    if not 0 < config.keep <= 100:
        raise ValueError(f"--keep is {config.keep}; it must be above 0, up to 100")
    if min(config.sampler_seed, 0, *config.seeds) < 0:
        raise ValueError("--sampler-seed and --seeds must be 0 or more")
    if unknown := [name for name in config.tasks if name not in TASKS]:
        raise ValueError(f"there is no task {unknown[0]}; there are {', '.join(TASKS)}")
    for name in ("tasks", "seeds"):
        if len(set(getattr(config, name))) < max(1, len(getattr(config, name))):
            raise ValueError(f"{flag(name)} needs one or more, each of them once")
    batch_size = max(math.prod(map(int, layout.split("x"))) for layout in SPACE["layout"].choices)
    fewest = min(TASKS[name].total_timesteps for name in config.tasks)
    if fewest * config.steps_scale < batch_size:
        raise ValueError(f"--steps-scale is {config.steps_scale}; it must be {batch_size / fewest:.3g} or more")
    if config.out is not None and not config.out.absolute().parent.is_dir():
        raise ValueError(f"there is no folder {config.out.parent} to draw to")


def main(config: Config) -> None:
    """Search, unless only a report is wanted, then report. Raises ValueError or OSError, one line for the user."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    check(config)
    tasks = tuple(name for name in TASKS if name in config.tasks)  # in one order, as the curves of a search are
    config = replace(config, folder=config.folder.absolute(), tasks=tasks)
    if not config.report:
        search(config)
    report(config)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C
    try:
        main(tyro.cli(Config))
    except (ValueError, OSError) as error:
        sys.exit(f"tune.py: {' '.join(str(error).split())}")
    except KeyboardInterrupt:
        sys.exit(130)
