"""How far back does a trained transformer look? Lets it play with other memory windows than the one it learned with.

    python benchmarks/window_probe.py runs/RUN/model.pt --windows 32 64 128 256

The window is no weight: the same agent plays the same levels with each (as evaluate.py does). A lower score with
a narrower window suggests that it used what this one does not show. That a wider one brings nothing says little, since
the agent has not learned with it.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import gymnasium as gym
import numpy as np
import tyro
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # before other packages that are named evaluate

import evaluate
from ppo_utils.checkpoints import Checkpoint
from ppo_utils.errors import RunError
from ppo_utils.scores import iqm, own_metric
from ppo_utils.terminal import one_line_exit


@dataclass
class Config:
    """Play with a trained transformer and other windows."""

    checkpoint: Annotated[str, tyro.conf.Positional]
    """a file that --save-model wrote"""
    windows: tuple[int, ...] = (16, 32, 64, 128, 256)
    """steps that the agent may look back at"""
    levels: int = 50
    """levels to play, which follow the training's"""
    repeats: int = 3
    """how often to play each"""
    max_steps: int = 10_000
    """steps after which an endless episode is cut short"""


def row(checkpoint: Checkpoint, window: int, metric: str, settings: evaluate.Config) -> str:
    """Return the row of a window; raise ValueError where an episode was cut short, which has no final score."""
    args = replace(checkpoint.args, trxl_memory_length=window)
    played = evaluate.play(replace(checkpoint, args=args), settings)
    if not played["finished"].all():
        limit = settings.max_steps
        raise ValueError(f"with a window of {window}, --max-steps {limit} cut episodes short; give more steps")
    scores, lengths = played[metric], played["length"]
    name = f"{window}, as trained" if window == checkpoint.args.trxl_memory_length else str(window)
    score = f"{scores.mean():.2f} | {iqm(scores[None]):.2f}"
    return f"| {name} | {score} | {np.median(lengths):.0f} | {lengths.max():.0f} |"


def main(config: Config) -> None:
    """Print a table, a window a row; raise ValueError for what cannot be played, and what evaluate.py raises."""
    if not config.windows or min(config.windows) < 1:
        given = " ".join(map(str, config.windows)) or "empty"
        raise ValueError(f"--windows is {given}; give windows of 1 step or more")
    settings = evaluate.Config(levels=config.levels, repeats=config.repeats, max_steps=config.max_steps)
    evaluate.check_numbers(settings)
    checkpoint = Checkpoint.read(config.checkpoint)
    if not hasattr(checkpoint.args, "trxl_memory_length"):
        script = checkpoint.script.__name__
        raise ValueError(f"{config.checkpoint} was trained by {script}.py; only transformers have a window")
    metric = own_metric(checkpoint.args.env_id)
    rows = [row(checkpoint, window, metric, settings) for window in tqdm(config.windows, unit=" windows")]
    print(f"| window | {metric}, mean | IQM | length of an episode, median | longest |\n|---:|---:|---:|---:|---:|")
    print("\n".join(rows))


if __name__ == "__main__":
    with one_line_exit(ValueError, OSError, ImportError, gym.error.Error, RunError):
        main(tyro.cli(Config))
