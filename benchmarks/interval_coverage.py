"""How often a 95 % interval over seeds holds the true score, for the two ways to resample seeds and levels.

    python benchmarks/interval_coverage.py

Seeds of an agent succeed on 50 levels with a probability that depends on the seed and on the level; each level is
played three times. The true score is the IQM over the episodes of a great many seeds on the same levels. Prints a
Markdown table.
"""

import sys
from pathlib import Path

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the packages of this repository

from ppo_utils.scores import RESAMPLES, interval, iqm

LEVELS, REPEATS, EXPERIMENTS = 50, 3, 400


def play(rng: np.random.Generator, seeds: int, spread: float, levels: np.ndarray) -> np.ndarray:
    """Return the successes (R, M, E) of fresh seeds, whose skill has the standard deviation spread."""
    chance = 0.6 + levels + rng.normal(0, spread, (seeds, 1))  # (R, M)
    return (rng.random((seeds, LEVELS, REPEATS)) < chance[..., None]).astype(float)


def interval_level_by_level(scores: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the ends (2,) of an interval that draws other seeds for each level, right only if levels share no seed."""
    drawn = rng.integers(len(scores), size=(RESAMPLES, *scores.shape[:2], 1))  # (B, R, M, 1)
    return np.percentile(iqm(np.take_along_axis(scores[None], drawn, axis=1)), [2.5, 97.5])


def coverage(seeds: int, spread: float) -> list[float]:
    """Return how often the two intervals hold the true score, whole seeds first."""
    rng = np.random.default_rng(seeds)
    hits = np.zeros(2)
    for _ in range(EXPERIMENTS):
        levels = rng.normal(0, 0.15, LEVELS)
        truth = iqm(play(rng, 2000, spread, levels))
        scores = play(rng, seeds, spread, levels)
        for way, (low, high) in enumerate((interval(scores), interval_level_by_level(scores, rng))):
            hits[way] += low <= truth <= high
    return (hits / EXPERIMENTS).tolist()


def main() -> None:
    """Print the table."""
    print("| seeds | standard deviation between seeds | seeds drawn whole | drawn for each level |")
    print("|---:|---:|---:|---:|")
    for seeds in (3, 5, 10):
        for spread in (0.0, 0.05, 0.15):
            whole, apart = coverage(seeds, spread)
            print(f"| {seeds} | {spread:.2f} | {100 * whole:.0f} % | {100 * apart:.0f} % |", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
