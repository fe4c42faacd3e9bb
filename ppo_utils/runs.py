"""A training from its command line to its end: set-up, run folder, what ends an iteration, signals.

A script's `setup` calls `prepare`, makes its agent, and ends with `open_run`; its `train` calls `end_iteration` after
each iteration. `run_to_end` calls `train`; `command` calls `setup`, then `run_to_end`.
"""

import argparse
import contextlib
import importlib.util
import math
import os
import re
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import filelock
import gymnasium as gym
import numpy as np
import torch
import torch.distributed as dist
import tyro

from ppo_utils.checkpoints import (
    SCRIPT_NAME,
    check_resumed,
    checkpoints_in,
    load_learner,
    load_model,
    load_process,
    model_of,
    read_checkpoint,
    save_checkpoint,
    saved_args,
    write_file,
)
from ppo_utils.environments import envs_for, training_envs
from ppo_utils.errors import LaneError, RunError, report_unusable_policy
from ppo_utils.evaluation import REPEATS, level_scores
from ppo_utils.flags import RunArgs, as_flags, check_args, check_minibatches, flag
from ppo_utils.logs import combine_logs, open_logs, start_tracking, write_logs
from ppo_utils.processes import all_gather, join_processes, leave_processes, rank_and_size, seed_generators
from ppo_utils.run import Run
from ppo_utils.terminal import one_line_exit, open_streams
from ppo_utils.video import LaneVideo, check_can_film, check_draws

T = TypeVar("T")  # a script's Args


# ---- setting up ----
def parse_args(kind: type[T], presets: dict[str, dict[str, Any]], argv: list[str]) -> T:
    """Parse a command line into a script's Args; its flags override --preset, or the run that --resume names.

    Raises what `read_checkpoint` raises.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", nargs="?")
    first.add_argument("--resume", nargs="?")
    given = first.parse_known_args(argv)[0]
    default = kind(**presets.get(given.preset, {}))  # tyro reports an unknown one below, like all other errors
    if given.resume not in (None, "None"):  # as tyro reads it
        default = saved_args(kind, read_checkpoint(given.resume))
    held = {name: {k: v for k, v in values.items() if k != "preset"} for name, values in presets.items()}
    lines = [f"--preset {name} stands for {as_flags(values)}" for name, values in held.items() if values]
    return tyro.cli(kind, args=argv, default=default, description="\n\n".join([kind.__doc__, *lines]))


def prepare(args: RunArgs, script: str) -> tuple[Run, dict[str, np.ndarray], dict[str, Any]]:
    """Check the arguments, join other processes, seed the generators, and make and reset the environments.

    Returns the run, which a script completes, the first observations and infos. Raises ValueError, OSError,
    ImportError, RunError or gymnasium.error.Error, each with one line for the user.
    """
    started_in = Path.cwd()  # environments may change it when they are made, or later
    if not re.fullmatch(SCRIPT_NAME, script):
        raise ValueError(
            f"the script {script}.py must be named ppo_NAME.py, in letters, digits and _, to be found again"
        )
    join_processes()
    checkpoint = None if args.resume is None else read_checkpoint(args.resume)
    if checkpoint is not None:
        check_resumed(args, checkpoint, script)
    check_args(args)
    if args.capture_video:
        check_can_film(args.env_id)
    seed_process(args, checkpoint)
    torch.backends.cudnn.deterministic = True
    # The momentum of idle units fills with numbers below 1e-38, which slow a CPU down several times: they become 0.
    torch.set_flush_denormal(True)  # for this thread, and those that it starts
    device = torch.device("cpu")
    if torch.cuda.is_available() and args.cuda:
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
        if device.index >= (gpus := torch.cuda.device_count()):
            raise ValueError(
                f"there are more processes than GPUs on this machine; start at most {gpus}, or use --no-cuda"
            )
        torch.set_float32_matmul_precision("high")  # TF32
    with report_out_of_memory(args, device):
        envs = training_envs(args, checkpoint)
    with report_out_of_memory(args, device, envs.single_observation_space):
        obs, infos = envs.reset()
    threads = torch.get_num_threads()
    if "OMP_NUM_THREADS" not in os.environ and not any(part.ndim == 4 for part in obs.values()):  # no images
        torch.set_num_threads(1)  # the networks are small: threads would mostly wait for each other
    torch.manual_seed(args.seed)  # of the weights: the same in all processes, whatever the environments drew
    return Run(script, device, checkpoint, envs, started_in, threads), obs, infos


def seed_process(args: RunArgs, checkpoint: dict[str, Any] | None) -> None:
    """Seed the generators of torch, NumPy and Python, for environments of other packages.

    Those of another process, and those of a run that goes on, which begin new episodes, must not repeat the episodes
    that the first process began with.
    """
    seed_generators(args.seed)
    if (rank := rank_and_size()[0]) or checkpoint is not None:
        entropy = [args.seed, rank, 0 if checkpoint is None else checkpoint["step"]]
        seed_generators(int(np.random.SeedSequence(entropy).generate_state(1)[0]))


@contextlib.contextmanager
def report_out_of_memory(
    args: RunArgs, device: torch.device, space: gym.spaces.Dict | None = None, more: str | None = None
) -> Iterator[None]:
    """Raise RunError if what is made inside does not fit in the memory, naming what is large.

    Large are flags above their defaults, and an observation of this space if it takes megabytes. more: a flag of which
    more would help.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, (RunError, LaneError)):  # not an allocator's, whatever the text says
            raise
        if isinstance(error, RuntimeError) and not re.search("allocate|out of memory|overflowed", str(error)):
            raise
        harmless = ("seed", "total_timesteps", "start_level", "num_levels", "anneal_steps", "num_minibatches")
        harmless += ("seq_len", "update_epochs", "checkpoint_interval", "eval_interval", "eval_max_steps", "max_steps")
        sizes = [each for each in fields(args) if type(each.default) is int and each.name not in harmless]
        usual = [each.name for each in sizes if each.name in ("num_envs", "num_steps", "levels", "repeats")]
        large = [each.name for each in sizes if getattr(args, each.name) > each.default] or usual
        large = " ".join(f"{flag(name)} {getattr(args, name)}" for name in large)
        bytes_of = [part.dtype.itemsize * math.prod(part.shape) for part in space.values()] if space else []
        if sum(bytes_of) > 1e6:
            large = f"the observation, {sum(bytes_of) / 1e6:.0f} MB each time; or of {large}"
        large += f"; or more of {flag(more)} {getattr(args, more)}" if more else ""
        raise RunError(f"this does not fit in the memory of {device}; use less of {large}") from None


def open_run(args: RunArgs, run: Run) -> Run:
    """Load what --resume or --load-model names, and open the run's files, the last thing that a setup does.

    run.folder is named here. Raises ValueError, OSError, ImportError or RunError, each with one line for the user.
    """
    check_minibatches(args, run.agent.memory)
    rank, checkpoint = rank_and_size()[0], run.checkpoint
    if args.eval_interval and rank == 0:
        with report_out_of_memory(args, torch.device("cpu")):
            run.eval_envs = envs_for(args, args.eval_levels * REPEATS, asynchronous=False)
    if rank > 0:  # all processes began with the same weights, but draw actions of their own
        torch.manual_seed(int(np.random.SeedSequence([args.seed, rank]).generate_state(1)[0]))
    if args.load_model is not None and checkpoint is None:
        path = args.load_model if Path.cwd() == run.started_in else run.started_in / args.load_model
        load_model(replace(args, load_model=path), run.agent, run.script)
    if checkpoint is not None:
        load_learner(run, checkpoint, args.resume)
    if rank == 0:
        open_folder(args, run)
    run.folder = all_gather(run.folder)[0]
    if checkpoint is not None:
        load_process(run, checkpoint)
        run.checkpoint = None  # which holds much that is not needed any more
    if rank == 0:
        open_logs(args, run)
    return run


def open_folder(args: RunArgs, run: Run) -> None:
    """Make a run folder, or take over the one of --resume, and record videos with --capture-video.

    Raises OSError if it cannot be written or is in use, or as `start_tracking` does.
    """
    run.folder = make_folder(args, run.started_in) if args.resume is None else run.started_in / args.resume
    if not os.access(run.folder, os.W_OK):
        raise OSError(f"--resume {run.folder}: this folder cannot be written")
    run.lock = (run.folder / ".lock").open("w")
    try:
        locked = filelock.lock_descriptor(run.lock.fileno(), blocking=False)  # until the file is closed
    except OSError:  # some network file systems have no locks
        locked = True
    if not locked:
        raise OSError(f"--resume {run.folder}: another process is training this run")
    if args.resume is not None and checkpoints_in(run.folder)[-1].stem != f"checkpoint-{run.step}":
        raise OSError(f"--resume {run.folder}: another process has just gone on with this run; start again")
    if args.track:
        try:
            start_tracking(args, run.folder.resolve().name)
        except (ValueError, ImportError):
            if args.resume is None:
                run.lock.close()  # Windows removes no file that is open
                (run.folder / ".lock").unlink()
                run.folder.rmdir()
                with contextlib.suppress(OSError):  # there are other runs
                    run.folder.parent.rmdir()
            raise
    for part in run.folder.glob("*.part"):
        part.unlink()  # of a process that was killed while it wrote
    if args.capture_video:
        run.envs = LaneVideo(run.envs, str(run.folder / (f"videos-{run.step}" if run.step else "videos")))


def make_folder(args: RunArgs, started_in: Path) -> Path:
    """Make a run folder; runs of the same name that begin in the same second get a number. Raises OSError."""
    name = f"{args.env_id}__{args.exp_name}__{args.seed}__{int(time.time())}"
    name = re.sub(r'[<>:"/\\|?*\x00-\x1f]', "-", name)  # what a name may not have in Windows
    first = started_in / "runs" / name
    for number in count(1):
        folder = first if number == 1 else first.with_name(f"{first.name}-{number}")
        try:
            folder.mkdir(parents=True)
            return folder
        except OSError as error:
            if not os.path.isdir(folder):  # else another run has this name
                where = "run where the folder runs can be written"
                raise OSError(f"cannot make {folder} ({error.strerror}); {where}") from None


# ---- while it trains ----
@contextlib.contextmanager
def report_failed_write(run: Run) -> Iterator[None]:
    """Raise RunError if what is inside cannot write."""
    try:
        yield
    except OSError as error:
        path = shown(Path(str(error.filename or run.folder)), run.started_in)
        raise RunError(f"cannot write to {path} ({error.strerror})") from error


def end_iteration(
    args: RunArgs,
    run: Run,
    logs: dict[str, float],
    episodes: dict[str, list[float]],
    times: tuple[float, float, float],
) -> None:
    """End an iteration: evaluate, log, and save, each where it is due.

    times: of time.perf_counter(), before the rollout, after it, and after the update. Raises RunError if a file cannot
    be written or a process is gone, FloatingPointError if a weight is not finite.
    """
    began, collected, updated = times
    logs |= {"charts/seconds_collect": collected - began, "charts/seconds_update": updated - collected}
    logs["charts/seconds_iteration"] = updated - began
    iterations = args.total_timesteps // (args.num_envs * args.num_steps)
    is_last = run.iteration == iterations
    evaluates = run.eval_envs is not None and (run.iteration % args.eval_interval == 0 or is_last)
    run.scores = level_scores(args, run.agent, run.eval_envs) if evaluates else {}
    logs |= {f"eval/{name}": values.mean().item() for name, values in run.scores.items()}
    run.stop = any(all_gather(run.received_signal))
    logs, episodes = combine_logs(all_gather((logs, episodes)))
    with report_failed_write(run):
        write_logs(args, run, logs, episodes)
        for name, values in run.scores.items():
            run.writer.add_tensor(f"eval_levels/{name}", values, run.step)
        if args.checkpoint_interval and (run.iteration % args.checkpoint_interval == 0 or is_last or run.stop):
            save_checkpoint(args, run)


def stop_on_signals(run: Run) -> None:
    """Have SIGINT (Ctrl-C) and SIGTERM end the training after the current iteration, a second Ctrl-C at once.

    A second SIGTERM does not: torchrun passes on the one that a cluster has sent to all processes.
    """
    alone = not dist.is_initialized()

    def stop(number: int, _: Any) -> None:
        if run.received_signal and number == signal.SIGINT and alone:
            raise KeyboardInterrupt
        if not run.received_signal and run.bar is not None:
            hint = "; Ctrl-C stops at once, without a checkpoint" if alone else ""
            with contextlib.suppress(OSError):  # Ctrl-C has ended `tee` too; print might be at work already
                os.write(2, f"\nstopping at the end of this iteration{hint}\n".encode())
        run.received_signal = number

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)


# ---- to the end ----
def run_to_end(args: RunArgs, run: Run, train: Callable[[Any, Run], None]) -> Path:
    """Train until it is done or stopped; return the run folder.

    With --save-model, what was learned is kept, unless the training diverged, it needed too much memory, a file could
    not be written or another process ended. Raises FloatingPointError, RunError and LaneError as `train` does, then
    with the last checkpoint's name, and KeyboardInterrupt after what was learned is kept.
    """
    save_model, interrupt = args.save_model, None
    try:
        with report_out_of_memory(args, run.device, more="num_minibatches"), report_unusable_policy():
            train(args, run)
        if run.writer is not None:
            with report_failed_write(run):
                run.writer.flush()
    except KeyboardInterrupt as error:
        interrupt = error
    except (FloatingPointError, RunError, LaneError) as error:
        save_model = save_model and isinstance(error, LaneError)
        found = checkpoints_in(run.folder)
        last = f"the last checkpoint is {shown(found[-1], run.started_in)}" if found else "there is no checkpoint yet"
        raise type(error)(f"iteration {run.iteration}: {error}; {last}") from error
    finally:
        try:
            if save_model:
                with report_failed_write(run):
                    write_file(model_of(args, run), run.folder / "model.pt")
        finally:
            close(run)
    if run.writer is not None:
        with contextlib.suppress(OSError):  # nobody reads it
            print(summary(args, run))
    if interrupt is not None:
        raise interrupt
    return run.folder


def summary(args: RunArgs, run: Run) -> str:
    """Return the lines that a training ends with: what it reached, and the commands to go on with."""
    score = "no episode ended"
    if run.scores:
        score = f"return {run.scores['return'].mean():.2f} on {args.eval_levels} other levels"
    elif run.returns:
        score = f"return {np.mean(run.returns):.2f}, mean of the last {len(run.returns)} episodes"
    folder = shlex.quote(shown(run.folder, run.started_in))
    # A wheel has these modules in this package, and the scripts at top level.
    installed = Path(__file__).with_name("evaluate.py").exists()
    if installed:
        evaluate, enjoy, script = "-m ppo_utils.evaluate", "-m ppo_utils.enjoy", f"-m {run.script}"
    else:
        root = Path(__file__).parents[1]
        beside = [root / name for name in ("evaluate.py", "enjoy.py", f"{run.script}.py")]
        shorter = [shown(path, run.started_in) if path.exists() else path.name for path in beside]
        evaluate, enjoy, script = map(shlex.quote, shorter)
    lacking = not all(map(importlib.util.find_spec, ("PIL", "plotly")))  # which enjoy.py needs
    extra = "memory-gym-baselines[eval]" if installed else f'-e "{shown(root, run.started_in)}[eval]"'
    install = f"pip install {extra} && " if lacking else ""
    lines = [f"{shown(run.folder, run.started_in)}: {run.step:,} steps, {score}"]
    checkpoints = checkpoints_in(run.folder)[-1:]
    if run.stop and checkpoints:
        lines.append(f"resume: python {script} --resume {folder}")
    for path in [run.folder / "model.pt"] if args.save_model else checkpoints:
        model = shlex.quote(shown(path, run.started_in))
        lines.append(f"evaluate: python {evaluate} {model}")
        with contextlib.suppress(ValueError):
            check_draws("enjoy.py", args.env_id)
            lines.append(f"watch: {install}python {enjoy} {model} --out page.html")
    return "\n".join([*lines, f"plot: tensorboard --logdir {folder}"])


def shown(path: Path, started_in: Path) -> str:
    """Return a path with slashes, from the folder that the training was started in if it is below that."""
    path = path.relative_to(started_in) if path.is_relative_to(started_in) else path
    return path.as_posix()  # backslashes would be quoted in Windows


def close(run: Run) -> None:
    """Close all files, environments and connections, the others too if one raises."""
    with contextlib.ExitStack() as stack:  # from the last to the first
        stack.callback(leave_processes)
        if torch.get_num_threads() != run.threads:
            stack.callback(torch.set_num_threads, run.threads)
        stack.enter_context(contextlib.suppress(OSError))  # that a file cannot be written was reported before
        for each in filter(None, (run.lock, run.writer, run.envs, run.eval_envs, run.bar)):
            stack.callback(each.close)


def command(
    kind: type[T], presets: dict[str, dict[str, Any]], setup: Callable[[T], Run], train: Callable[[T, Run], None]
) -> None:
    """Train as the command line says, and exit: with one line for an error that a user can correct."""
    open_streams()
    publish(setup.__globals__)
    with one_line_exit(ValueError, OSError, ImportError, gym.error.Error, RunError):
        args = parse_args(kind, presets, sys.argv[1:])
        run = setup(args)
    stop_on_signals(run)
    # If TensorBoard's thread fails to write, the next call to the writer raises here.
    threading.excepthook = lambda it: None if "tensorboard" in repr(type(it.thread)) else threading.__excepthook__(it)
    with one_line_exit(FloatingPointError, RunError):
        run_to_end(args, run, train)
    sys.exit(128 + run.received_signal if run.received_signal else 0)


def publish(namespace: dict[str, Any]) -> None:
    """Let the names of a script that runs as `__main__` be found there, where its flags' types are looked up.

    What executes a script's text, as `python -m cProfile` does before Python 3.12, has a `__main__` of its own.
    """
    if namespace["__name__"] == "__main__" and vars(sys.modules["__main__"]) is not namespace:
        sys.modules["__main__"] = ModuleType("__main__")
        vars(sys.modules["__main__"]).update(namespace)
