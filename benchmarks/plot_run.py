"""Draw the curves of one training run, read from its TensorBoard file.

    python benchmarks/plot_run.py runs/RUN docs/curves.png --names charts/episodic_return episode/commands_completed

Needs matplotlib: pip install -e ".[eval]"
"""

from dataclasses import dataclass
from typing import Annotated

import matplotlib
import tyro
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

matplotlib.use("Agg")
import matplotlib.pyplot as plt


@dataclass
class Config:
    """Draw curves."""

    run: Annotated[str, tyro.conf.Positional]
    """the run folder"""
    out: Annotated[str, tyro.conf.Positional]
    """the picture to write: .png or .svg"""
    names: tuple[str, ...] = ("charts/episodic_return", "charts/episodic_length")
    """the scalars to draw, a panel each"""


def main(config: Config) -> None:
    """Write the picture, and print each curve's first and last value."""
    events = EventAccumulator(config.run, size_guidance={"scalars": 0})
    events.Reload()
    known = events.Tags()["scalars"]
    missing = sorted(set(config.names) - set(known))
    if missing:
        raise SystemExit(f"{config.run} has no {', '.join(missing)}; it has {', '.join(known) or 'no curves'}")
    figure, _ = plt.subplots(1, len(config.names), figsize=(4.2 * len(config.names), 3), layout="constrained")
    for axis, name in zip(figure.axes, config.names, strict=True):
        points = events.Scalars(name)
        axis.plot([point.step for point in points], [point.value for point in points], color="#1d3c6b")
        axis.set(xlabel="steps", title=name)
        axis.grid(alpha=0.3)
        axis.ticklabel_format(axis="x", style="sci", scilimits=(0, 0))
        first, last = points[0], points[-1]
        print(f"{name}: {first.value:.4g} at step {first.step}, {last.value:.4g} at step {last.step}")
    figure.savefig(config.out, dpi=120)


if __name__ == "__main__":
    main(tyro.cli(Config))
