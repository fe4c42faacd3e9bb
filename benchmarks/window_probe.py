"""How far back does a trained transformer look? Lets it play with other memory windows than the one it learned with.

    python benchmarks/window_probe.py runs/RUN/model.pt --windows 32 64 128 256

The window is no weight: the same agent plays the same unseen levels with each (as evaluate.py does). Where a narrower
window costs it its score, it looked further back than that; where a wider one brings nothing, its window is not what
ends its episodes.
"""

import sys
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import tyro
from tqdm import tqdm

import evaluate
import ppo_trxl


@dataclass
class Config:
    """Play with a trained transformer and other windows."""

    checkpoint: Annotated[str, tyro.conf.Positional]
    """a file that --save-model wrote"""
    windows: tuple[int, ...] = (16, 32, 64, 128, 256)
    """steps that the agent may look back at"""
    levels: int = 50
    """unseen levels to play"""
    repeats: int = 3
    """how often to play each"""
    max_steps: int = 10_000
    """steps after which an endless episode is cut short"""


def row(checkpoint: evaluate.Checkpoint, window: int) -> str:
    """Return the row of a window: the family's own metric, and how long the episodes are."""
    trained = checkpoint.args.trxl_memory_length
    played = evaluate.play(replace(checkpoint, args=replace(checkpoint.args, trxl_memory_length=window)), seed=1)
    scores, lengths = played[evaluate.own_metric(checkpoint.args.env_id)], played["length"]
    name = f"{window}, as trained" if window == trained else str(window)
    score = f"{scores.mean():.2f} | {evaluate.iqm(scores[None]):.2f}"
    return f"| {name} | {score} | {np.median(lengths):.0f} | {lengths.max():.0f} |"


def main(config: Config) -> None:
    """Print a table, a window a row; raise SystemExit for a checkpoint of another script, and what evaluate raises."""
    settings = evaluate.Config(levels=config.levels, repeats=config.repeats, max_steps=config.max_steps)
    checkpoint = evaluate.Checkpoint.read(config.checkpoint, settings)
    if checkpoint.script is not ppo_trxl:
        script = checkpoint.script.__name__
        raise SystemExit(
            f"{config.checkpoint} was trained by {script}.py; only transformers of ppo_trxl.py have a window"
        )
    metric = evaluate.own_metric(checkpoint.args.env_id)
    rows = [row(checkpoint, window) for window in tqdm(config.windows, unit=" windows")]
    print(f"| window | {metric}, mean | IQM | length of an episode, median | longest |\n|---:|---:|---:|---:|---:|")
    print("\n".join(rows))


if __name__ == "__main__":
    try:
        main(tyro.cli(Config))
    except (ValueError, OSError) as error:
        sys.exit(f"window_probe.py: {' '.join(str(error).split())}")
