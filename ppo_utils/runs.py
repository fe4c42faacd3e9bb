"""A training from its first file to its last line: run folder, logs, progress bar, signals, and the command line.

A script's `setup` calls `prepare`, makes its agent, and ends with `open_run`; its `train` calls `report` after each
iteration; `run_to_end` and `command` call both.
"""

import argparse
import contextlib
import os
import random
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, fields
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import torch
import tyro
from filelock import BaseFileLock, FileLock, Timeout
from torch import nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from ppo_utils.checkpoints import (
    check_resumed,
    checkpoints_in,
    load_checkpoint,
    load_model,
    model_of,
    read_checkpoint,
    save_checkpoint,
    saved_args,
    write_file,
)
from ppo_utils.environments import envs_for
from ppo_utils.evaluation import REPEATS, evaluate, evaluation_levels
from ppo_utils.flags import as_flags, check_args, check_minibatches, flag
from ppo_utils.processes import (
    RunError,
    all_gather,
    combine_logs,
    join_processes,
    leave_processes,
    rank_and_size,
)
from ppo_utils.video import LaneVideo, check_can_film

T = TypeVar("T")  # a script's Args


@dataclass
class Run:
    """All that training needs, made by a script's `setup`."""

    script: str  # the name of the script
    envs: gym.vector.VectorEnv
    agent: nn.Module
    optimizer: torch.optim.Optimizer
    rollout: Any  # a script's Rollout
    folder: Path = Path()  # named by `open_run`
    eval_envs: gym.vector.VectorEnv | None = None
    lock: BaseFileLock | None = None  # tells other processes that the folder is in use
    writer: SummaryWriter | None = None  # in the first process only, as the progress bar
    bar: tqdm | None = None
    iteration: int = 0  # the current one, from 1
    step: int = 0  # so far, of all environments together
    seconds: float = 0.0  # of training, without evaluations
    returns: deque = field(default_factory=lambda: deque(maxlen=100))  # of the last episodes, for the progress bar
    lengths: deque = field(default_factory=lambda: deque(maxlen=100))
    received_signal: int = 0  # SIGTERM or SIGINT, if this process got one
    stop: bool = False  # a process got one: this iteration is the last
    episodes: dict[str, list[float]] = field(default_factory=dict)  # metrics of those that ended in the last iteration
    scores: dict[str, torch.Tensor] = field(default_factory=dict)  # of the last evaluation, see `level_scores`


# ---- setting up ----
def parse_args(kind: type[T], presets: dict[str, dict[str, Any]], argv: list[str]) -> T:
    """Parse a command line into a script's Args; its flags win over --preset, or over what the run of --resume has.

    Raises what `read_checkpoint` raises.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", nargs="?")
    first.add_argument("--resume", nargs="?")
    given = first.parse_known_args(argv)[0]
    default = kind(**presets.get(given.preset, {}))  # tyro reports an unknown one, as all errors
    if given.resume is not None:
        default = saved_args(kind, read_checkpoint(given.resume))
    held = {name: {k: v for k, v in values.items() if k != "preset"} for name, values in presets.items()}
    lines = [f"--preset {name} stands for {as_flags(values)}" for name, values in held.items() if values]
    return tyro.cli(kind, args=argv, default=default, description="\n\n".join([kind.__doc__, *lines]))


def prepare(args: Any, script: str, longest_piece: int) -> tuple[torch.device, dict[str, Any] | None]:
    """Check the arguments, join other processes and seed the generators; return the device and --resume's checkpoint.

    longest_piece: the most steps that a piece of a rollout may have, of which minibatches are made. Raises ValueError,
    OSError or ImportError, each with one line for the user.
    """
    join_processes()
    checkpoint = None if args.resume is None else read_checkpoint(args.resume)
    if checkpoint is not None:
        check_resumed(args, checkpoint, script)
    check_args(args)
    check_minibatches(args, longest_piece)
    if args.capture_video:
        check_can_film(args.env_id)
    seed_generators(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    if not (torch.cuda.is_available() and args.cuda):
        return torch.device("cpu"), checkpoint
    torch.set_float32_matmul_precision("high")  # TF32
    return torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0))), checkpoint


def seed_generators(seed: int) -> None:
    """Seed torch's generator, and NumPy's and Python's, which environments of other packages may use."""
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002
    torch.manual_seed(seed)


def training_envs(args: Any, checkpoint: dict[str, Any] | None) -> gym.vector.VectorEnv:
    """Make this process's share of the environments to train on. Raises as `make_envs` does."""
    rank, processes = rank_and_size()
    share = args.num_envs // processes
    # Environments that cannot be restored must not repeat the episodes that the run began with.
    seed = args.seed if checkpoint is None or checkpoint["step"] == 0 else [args.seed, checkpoint["step"]]
    mode = "debug_rgb_array" if args.capture_video else None
    return envs_for(args, share, seed=seed, first_lane=rank * share, render_mode=mode)


@contextlib.contextmanager
def report_out_of_memory(args: Any, device: torch.device) -> Iterator[None]:
    """Raise ValueError, naming what is larger than usual, if what is made inside does not fit in the memory."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "allocate" not in str(error):
            raise
        harmless = ("seed", "total_timesteps", "start_level", "num_levels", "anneal_steps", "num_minibatches")
        harmless += ("update_epochs", "checkpoint_interval", "keep_models", "eval_interval", "eval_max_steps")
        sizes = [each for each in fields(args) if type(each.default) is int and each.name not in harmless]
        large = [each.name for each in sizes if getattr(args, each.name) > each.default] or ["num_envs", "num_steps"]
        large = " ".join(f"{flag(name)} {getattr(args, name)}" for name in large)
        raise ValueError(f"this does not fit in the memory of {device}; use less of {large}") from None


def open_run(args: Any, run: Run, checkpoint: dict[str, Any] | None) -> Run:
    """Load what --resume or --load-model names, and open the run's files, the last thing that a setup does.

    run.folder is named here. Raises ValueError, OSError or ImportError, each with one line for the user.
    """
    rank, _ = rank_and_size()
    if args.eval_interval and rank == 0:
        with report_out_of_memory(args, torch.device("cpu")):
            run.eval_envs = envs_for(args, len(evaluation_levels(args, args.eval_levels)))
    if rank > 0:  # all processes began with the same weights, but draw numbers of their own
        seed_generators(int(np.random.SeedSequence([args.seed, rank]).generate_state(1)[0]))
    if args.load_model is not None and checkpoint is None:
        load_model(args, run.agent, run.script)
    if checkpoint is not None:
        run.step = checkpoint["step"]
    if rank == 0:
        open_folder(args, run)
    run.folder = all_gather(run.folder)[0]
    if checkpoint is not None:
        load_checkpoint(run, checkpoint)
    if rank == 0:
        open_logs(args, run)
    return run


def open_folder(args: Any, run: Run) -> None:
    """Make a run folder, or take over the one of --resume, and film if asked to.

    Raises OSError if it cannot be written or is in use, or as `start_tracking` does.
    """
    run.folder = make_folder(args, run.script) if args.resume is None else Path(args.resume)
    if not os.access(run.folder, os.W_OK):
        raise OSError(f"--resume {run.folder}: this folder cannot be written")
    if args.track:
        try:
            start_tracking(args, run.folder.resolve().name)
        except (ValueError, ImportError):
            if args.resume is None:
                os.removedirs(run.folder)
            raise
    run.lock = FileLock(run.folder / ".lock")
    try:
        run.lock.acquire(timeout=0)
    except Timeout:
        raise OSError(f"--resume {run.folder}: another process is training this run") from None
    except NotImplementedError:  # some network file systems have no locks
        run.lock = None
    for part in run.folder.glob("*.part"):
        part.unlink()  # of a process that was killed while it wrote
    if args.capture_video:
        run.envs = LaneVideo(run.envs, str(run.folder / (f"videos-{run.step}" if run.step else "videos")))


def make_folder(args: Any, script: str) -> Path:
    """Make a run folder; runs of the same name that begin in the same second get a number. Raises OSError."""
    env_id = args.env_id.replace("/", "-").replace(":", "-")
    first = Path("runs") / f"{env_id}__{args.exp_name}__{args.seed}__{int(time.time())}"
    for number in count(1):
        folder = first if number == 1 else first.with_name(f"{first.name}-{number}")
        try:
            folder.mkdir(parents=True)
            return folder
        except OSError as error:
            if not folder.is_dir():  # else another run has this name
                where = "run where the folder runs can be written"
                raise OSError(f"cannot make {folder} ({error.strerror}); {where}") from None


def open_logs(args: Any, run: Run) -> None:
    """Open the TensorBoard file, which hides what was logged beyond the run's step, and the progress bar."""
    run.writer = SummaryWriter(str(run.folder), purge_step=run.step + 1 if run.step else None)
    hyperparameters = {"script": run.script, **asdict(args)}
    rows = "\n".join(f"|{key}|{' '.join(str(value).split())}|" for key, value in hyperparameters.items())
    run.writer.add_text("hyperparameters", f"|param|value|\n|-|-|\n{rows}", run.step)
    batch_size = args.num_envs * args.num_steps
    total = args.total_timesteps // batch_size * batch_size
    run.bar = tqdm(total=total, initial=run.step, unit=" steps", unit_scale=True)


def start_tracking(args: Any, name: str) -> None:
    """Mirror the TensorBoard curves to Weights and Biases; its environment variables name the project and the team.

    Raises ValueError if that does not start, ImportError without the extra `track`.
    """
    try:
        import wandb
    except ImportError:
        raise ImportError('--track needs wandb: pip install -e ".[track]"') from None
    try:
        wandb.init(name=name, id=name, resume="allow", sync_tensorboard=True, config=asdict(args), save_code=True)
    except Exception as error:  # whatever wandb raises: no account, no such team, no network
        raise ValueError(f"--track: {error}; log in with `wandb login`, or leave --track out") from None


# ---- while it trains ----
@contextlib.contextmanager
def report_failed_write(folder: Path) -> Iterator[None]:
    """Raise RunError if what is inside cannot write."""
    try:
        yield
    except OSError as error:
        raise RunError(f"cannot write to {error.filename or folder} ({error.strerror})") from error


def report(args: Any, run: Run, logs: dict[str, float], episodes: dict[str, list[float]]) -> None:
    """End an iteration: evaluate, log, and save, each where it is due.

    Raises RunError if a file cannot be written or a process is gone, FloatingPointError if a weight is not finite.
    """
    iterations = args.total_timesteps // (args.num_envs * args.num_steps)
    is_last = run.iteration == iterations
    if evaluates := run.eval_envs is not None and (run.iteration % args.eval_interval == 0 or is_last):
        run.scores = level_scores(args, run)
        logs |= {f"eval/{name}": values.mean().item() for name, values in run.scores.items()}
    run.stop = any(all_gather(run.received_signal))
    logs, episodes = combine_logs(all_gather((logs, episodes)))
    with report_failed_write(run.folder):
        write_logs(args, run, logs, episodes)
        if evaluates:
            for name, values in run.scores.items():
                run.writer.add_tensor(f"eval_levels/{name}", values, run.step)
        if args.checkpoint_interval and (run.iteration % args.checkpoint_interval == 0 or is_last or run.stop):
            save_checkpoint(args, run)


def level_scores(args: Any, run: Run) -> dict[str, torch.Tensor]:
    """Return an evaluation's metrics by name, (--eval-levels, REPEATS) float64: every episode on every level.

    Training goes on as if there had been none, unless an environment of another package takes random numbers from
    NumPy's or Python's global generator. A metric that some episodes lack is left out: one that only an episode's end
    tells is not known of the longest, which --eval-max-steps cut short.
    """
    device = run.rollout.values.device
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(args.seed)
        levels = evaluation_levels(args, args.eval_levels)
        metrics = evaluate(run.agent, run.eval_envs, levels, args.eval_max_steps, args.amp)
    complete = {name: torch.from_numpy(values) for name, values in metrics.items() if not np.isnan(values).any()}
    return {name: values.unflatten(0, (-1, REPEATS)) for name, values in complete.items()}


def write_logs(args: Any, run: Run, logs: dict[str, float], episodes: dict[str, list[float]]) -> None:
    """Write an iteration's numbers to TensorBoard and the progress bar; the first process does."""
    run.seconds += logs["charts/seconds_iteration"]
    run.episodes = episodes
    run.returns.extend(episodes.get("charts/episodic_return", []))
    run.lengths.extend(episodes.get("charts/episodic_length", []))
    if run.writer is None:
        return
    logs |= {name: float(np.mean(values)) for name, values in episodes.items()}
    logs["charts/SPS"] = run.step / run.seconds
    for name, value in logs.items():
        run.writer.add_scalar(name, value, run.step)
    last = {"return": run.returns, "length": run.lengths}
    shown = {name: f"{np.mean(values):.2f}" for name, values in last.items() if values}
    run.bar.set_postfix({**shown, "SPS": f"{logs['charts/SPS']:.0f}"}, refresh=False)
    run.bar.update(args.num_envs * args.num_steps)


def stop_on_signals(run: Run) -> None:
    """Have SIGINT (Ctrl-C) and SIGTERM end the training after the current iteration, a second Ctrl-C at once.

    A second SIGTERM does not: torchrun passes on the one that a cluster has sent to all processes.
    """
    alone = rank_and_size()[1] == 1

    def stop(number: int, _: Any) -> None:
        if run.received_signal and number == signal.SIGINT and alone:
            raise KeyboardInterrupt
        if not run.received_signal and run.bar is not None:
            hint = "; Ctrl-C stops at once, without a checkpoint" if alone else ""
            os.write(2, f"\nstopping at the end of this iteration{hint}\n".encode())  # print might be at work already
        run.received_signal = number

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)


# ---- to the end ----
def run_to_end(args: Any, run: Run, train: Callable[[Any, Run], None]) -> Path:
    """Train until it is done or stopped; return the run folder.

    With --save-model, what was learned is kept, unless the training diverged, a file could not be written or another
    process ended. Raises FloatingPointError and RunError as `train` does, with the last checkpoint's name.
    """
    save_model = args.save_model
    try:
        train(args, run)
        if run.writer is not None:
            with report_failed_write(run.folder):
                run.writer.flush()
    except KeyboardInterrupt:
        pass
    except (FloatingPointError, RunError) as error:
        save_model = False
        found = checkpoints_in(run.folder)
        last = f"the last checkpoint is {found[-1]}" if found else "there is no checkpoint yet"
        raise type(error)(f"iteration {run.iteration}: {error}; {last}") from error
    finally:
        try:
            if save_model:
                with report_failed_write(run.folder):
                    write_file(model_of(args, run), run.folder / "model.pt")
        finally:
            close(run)
    if run.writer is not None:
        print(summary(args, run))
    return run.folder


def summary(args: Any, run: Run) -> str:
    """Return the lines that a training ends with: what it reached, and the commands that go on from there."""
    score = "no episode ended"
    if run.scores:
        score = f"return {run.scores['return'].mean():.2f} on {args.eval_levels} unseen levels"
    elif run.returns:
        score = f"return {np.mean(run.returns):.2f}, mean of the last {len(run.returns)} episodes"
    models = [run.folder / "model.pt"] if args.save_model else checkpoints_in(run.folder)[-1:]
    lines = [f"{run.folder}: {run.step:,} steps, {score}"]
    lines += [f"evaluate: python evaluate.py {path}" for path in models]
    lines += [f"watch: python enjoy.py {path} --out page.html" for path in models]
    return "\n".join([*lines, f"plot: tensorboard --logdir {run.folder}"])


def close(run: Run) -> None:
    """Close all files, environments and connections."""
    for each in filter(None, (run.bar, run.envs, run.eval_envs, run.writer)):
        with contextlib.suppress(OSError):  # that a file cannot be written was reported before
            each.close()
    if run.lock is not None:
        run.lock.release()
    leave_processes()


def command(
    kind: type[T], presets: dict[str, dict[str, Any]], setup: Callable[[T], Run], train: Callable[[T, Run], None]
) -> None:
    """Train as the command line says, and exit: with one line for an error that a user can mend."""

    def fail(error: Exception) -> None:
        sys.exit(f"{Path(sys.argv[0]).name}: {' '.join(str(error).split())}")

    try:
        args = parse_args(kind, presets, sys.argv[1:])
        run = setup(args)
    except (ValueError, OSError, ImportError, gym.error.Error, RunError) as error:
        fail(error)
    stop_on_signals(run)
    # If TensorBoard's thread fails to write, the next call to the writer raises here.
    threading.excepthook = lambda it: None if "tensorboard" in repr(type(it.thread)) else threading.__excepthook__(it)
    try:
        run_to_end(args, run, train)
    except (FloatingPointError, RunError) as error:
        fail(error)
    sys.exit(128 + run.received_signal if run.received_signal else 0)
