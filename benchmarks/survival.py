"""Does a run survive, and what does that cost? Kills and resumes runs, watches a long one, and times checkpoints.

    python benchmarks/survival.py --kills 100 --soak 200

A killed run is resumed until it ends; its scalars, but for those that a clock measures, have to be those of a run that
was never stopped. Kills are SIGKILL, which no program can answer, at moments that are uniform over the seconds of a
process. The processes are forks of this one, so that these seconds are setup, training and writing, not imports.

The soak writes a checkpoint after every iteration. Resident memory, open files and steps per second should be flat.

The cost of checkpoints is measured with the settings of each preset: the seconds of an iteration and of a checkpoint,
and the share of the time that checkpoints take at the default --checkpoint-interval. All is done by one thread.
"""

import importlib
import multiprocessing
import os
import random
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the packages of this repository

from ppo_utils.checkpoints import checkpoints_in, save_checkpoint
from ppo_utils.flags import NonNegativeFloat, NonNegativeInt, PositiveInt, check_bounds
from ppo_utils.run_logs import read_run
from ppo_utils.runs import close, parse_args
from ppo_utils.terminal import one_line_exit

FLAGS = "--preset laptop --env-id MysteryPath-Grid-v0 --num-envs 4 --num-steps 32 --num-minibatches 2 --no-cuda"


@dataclass
class Config:
    """What to try."""

    script: Literal["ppo_gru", "ppo_trxl"] = "ppo_gru"
    """which of the two"""
    kills: NonNegativeInt = 100
    """how often to kill"""
    seconds: NonNegativeFloat = 4.0
    """longest life of a process that is killed"""
    iterations: PositiveInt = 30
    """length of a run that is killed"""
    soak: NonNegativeInt = 200
    """length of the run that is watched, in iterations"""
    cost: bool = True
    """time checkpoints too"""
    seed: int = 1
    """seed of the moments"""


def arguments(iterations: int, name: str) -> list[str]:
    """Return the command line of a run that evaluates now and then, and writes a checkpoint every iteration."""
    often = "--checkpoint-interval 1 --eval-interval 10 --eval-levels 2"
    return [*FLAGS.split(), *often.split(), "--total-timesteps", str(iterations * 4 * 32), "--exp-name", name]


def train(script: str, flags: list[str]) -> None:
    """Train as the command line does, but silently."""
    sys.stderr = open(os.devnull, "w")  # noqa: SIM115 (until the process ends)
    module = importlib.import_module(script)
    module.main(parse_args(module.Args, module.PRESETS, flags))


def comes_to_its_end(script: str, flags: list[str], seconds: float | None) -> bool:
    """Train in a process, which is killed after so many seconds; return whether it ended before.

    Raises RuntimeError if it failed.
    """
    process = multiprocessing.get_context("fork").Process(target=train, args=(script, flags))
    process.start()
    process.join(seconds)
    if process.exitcode is None:
        process.kill()
        process.join()
        return False
    if process.exitcode:
        raise RuntimeError(f"{script}.py {' '.join(flags)} ended with exit code {process.exitcode}")
    return True


def scalars(folder: Path) -> dict[str, list]:
    """Return the curves of a run, of each level where it was evaluated, but for what a clock measures."""
    curves = read_run(str(folder)).curves
    kept = [name for name in curves if not name.startswith(("charts/SPS", "charts/seconds"))]
    return {name: [array.tolist() for array in curves[name]] for name in kept}


def kill(config: Config) -> None:
    """Kill so many times, and print the count. Raises RuntimeError if a run does not resume, or gives other scalars."""
    moments, wanted = random.Random(config.seed), None
    count = {"kills": 0, "before the first checkpoint": 0, "while a file was written": 0, "runs": 0}
    while count["kills"] < config.kills or wanted is None:
        name = f"run-{count['runs']}-{count['kills']}"
        flags, folder = arguments(config.iterations, name), None
        while True:
            # The first run is never killed: the others are compared with it. After the last kill, none is.
            is_killed = wanted is not None and count["kills"] < config.kills
            if comes_to_its_end(config.script, flags, moments.uniform(0, config.seconds) if is_killed else None):
                found = scalars(next(Path("runs").glob(f"*__{name}__*")))
                wanted = wanted or found
                if found != wanted:
                    raise RuntimeError(f"{name} has other scalars than the run that was never stopped")
                count["runs"] += 1
                break
            count["kills"] += 1
            folder = next(Path("runs").glob(f"*__{name}__*"), None)
            if folder is None or not list(folder.glob("checkpoint-*.pt")):
                count["before the first checkpoint"] += 1
                break
            count["while a file was written"] += bool(list(folder.glob("*.part")))
            flags = ["--resume", str(folder)]
            time.sleep(1)  # TensorBoard sorts files by the second they begin in
    print(
        f"{config.script}: {', '.join(f'{value} {name}' for name, value in count.items())}, all with the same scalars"
    )


def soak(config: Config) -> None:
    """Train for so many iterations, a checkpoint after each, and print what they take, a row for each fifth."""
    script = importlib.import_module(config.script)
    args = parse_args(script.Args, script.PRESETS, [*arguments(1, "soak"), "--eval-interval", "0"])
    run = script.setup(args)
    batch_size, rows = args.total_timesteps, []
    for _ in range(config.soak):
        began = time.perf_counter()
        script.train(args, run)
        args.total_timesteps += batch_size
        resident = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
        rows.append((resident, len(os.listdir("/proc/self/fd")), batch_size / (time.perf_counter() - began)))
    close(run)
    print(f"\n{config.script}, a checkpoint after each of {config.soak} iterations\n")
    print("| iterations | resident memory, MiB | open files | steps per second |\n|---|---:|---:|---:|")
    for part in np.array_split(np.arange(config.soak), min(5, config.soak)):
        memory, files, rate = np.array(rows)[part].T
        print(f"| {part[0] + 1} to {part[-1] + 1} | {memory.max():.1f} | {files.max():.0f} | {np.median(rate):.0f} |")


def cost(config: Config) -> None:
    """Print what checkpoints cost with each preset's settings."""
    script = importlib.import_module(config.script)
    print(f"\n{config.script}, checkpoints every {script.Args.checkpoint_interval} iterations\n")
    print("| preset | environments x steps | iteration, s | checkpoint, s | MiB | share |")
    print("|---|---|---:|---:|---:|---:|")
    for preset in script.PRESETS:
        args = parse_args(script.Args, script.PRESETS, ["--preset", preset, "--no-cuda", "--exp-name", preset])
        args.total_timesteps = args.num_envs * args.num_steps
        run = script.setup(args)
        script.train(args, run)
        seconds = []
        for _ in range(5):
            began = time.perf_counter()
            save_checkpoint(args, run)
            seconds.append(time.perf_counter() - began)
        size = checkpoints_in(run.folder)[-1].stat().st_size / 2**20
        close(run)
        taken = float(np.median(seconds))
        share = taken / (args.checkpoint_interval * run.seconds)
        shape = f"{args.num_envs} x {args.num_steps}"
        print(f"| {preset} | {shape} | {run.seconds:.2f} | {taken:.3f} | {size:.1f} | {share:.3%} |", flush=True)


def main(config: Config) -> None:
    """Do all that is asked for, in a temporary folder. Raises ValueError for numbers that cannot work."""
    check_bounds(config)
    torch.set_num_threads(1)  # forks must not inherit threads
    importlib.import_module("torch._dynamo")  # by the optimizer; else every fork spends most of its life on it
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        if config.kills:
            kill(config)
        if config.soak:
            soak(config)
        if config.cost:
            cost(config)


if __name__ == "__main__":
    with one_line_exit(ValueError, RuntimeError, OSError):
        main(tyro.cli(Config))
