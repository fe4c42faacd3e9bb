"""Draw the pictures of docs/memory.md: where the gradient of an update flows, and what it takes as it was stored.

    python benchmarks/memory_pictures.py

Steps are counted from the first of the rollout that an update learns from.
"""

import sys
from itertools import pairwise
from pathlib import Path

import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, Patch, Rectangle

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the packages of this repository

from ppo_utils.terminal import one_line_exit

FRESH, STORED, OLD, UNUSED = "#a6cdf0", "#ffdfb0", "#f0a060", "#f2f2f2"
GRADIENT, EDGE = "#1f5fa8", "#888888"
FIRST, ROLLOUT, EPISODE, END = -6, 0, 8, 12  # steps: drawn from, the rollout's first, a new episode's first, drawn to


def box(axis: Axes, center: tuple[float, float], color: str, width: float = 0.6) -> None:
    """Draw a box around a point."""
    corner = center[0] - width / 2, center[1] - 0.25
    axis.add_patch(Rectangle(corner, width, 0.5, facecolor=color, edgecolor=EDGE, zorder=2))


def arrow(axis: Axes, start: tuple, end: tuple, color: str, bend: float = 0.0, width: float = 1.6) -> None:
    """Draw an arrow between two points, bent sideways by a share of its length."""
    style = {"arrowstyle": "-|>", "mutation_scale": 10, "connectionstyle": f"arc3,rad={bend}"}
    axis.add_patch(FancyArrowPatch(start, end, color=color, linewidth=width, shrinkA=0, shrinkB=0, **style))


def timeline(axis: Axes, rows: dict[str, float], cuts: list[int], piece: str) -> None:
    """Draw what all pictures have: steps, rollouts, the end of an episode, and the pieces that begin at `cuts`.

    rows: the height of each row of boxes by its name.
    """
    top = max(rows.values()) + 0.95
    axis.set(xlim=(FIRST - 3, END - 0.3), ylim=(-1.85, top))
    axis.axis("off")
    for name, height in rows.items():
        axis.text(FIRST - 0.6, height, name, ha="right", va="center", fontsize=9)
    for step in range(FIRST, END):
        axis.text(step, -0.55, step, ha="center", va="center", fontsize=8, color=EDGE)
    axis.text(FIRST - 0.6, -0.55, "step of the rollout", ha="right", va="center", fontsize=9)
    for begin, end in pairwise([*cuts, END]):
        axis.plot([begin - 0.42, end - 0.58], [-0.95, -0.95], color="black", linewidth=2.5, solid_capstyle="butt")
        axis.text((begin + end - 1) / 2, -1.25, piece, ha="center", va="center", fontsize=9)
    axis.plot([ROLLOUT - 0.5] * 2, [-1.85, top], color=EDGE, linewidth=1.2)
    axis.text(ROLLOUT - 0.6, -1.7, "earlier rollouts", ha="right", va="center", fontsize=9)
    axis.text(ROLLOUT - 0.4, -1.7, "the rollout that the update learns from", ha="left", va="center", fontsize=9)
    axis.plot([EPISODE - 0.5] * 2, [-1.4, top], color=EDGE, linewidth=1.2, linestyle=":")
    axis.text(EPISODE - 0.4, top, "a new episode", va="top", fontsize=9)


def legend(figure: Figure, gray: str) -> None:
    """Say what the colors stand for; gray: what a gray arrow does."""
    names = {"computed now": FRESH, "stored in this rollout": STORED, "stored before": OLD, "not used": UNUSED}
    handles = [Patch(facecolor=color, edgecolor=EDGE, label=name) for name, color in names.items()]
    handles.append(Line2D([], [], color=GRADIENT, linewidth=2, label="gradient"))
    handles.append(Line2D([], [], color=EDGE, linewidth=2, label=gray))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9, frameon=False)


def recurrent() -> Figure:
    """Draw the sequences of a recurrent memory."""
    figure = Figure(figsize=(11, 2.3), layout="constrained")
    axis, cuts = figure.subplots(), [ROLLOUT, ROLLOUT + 5, EPISODE]
    axis.set_title("GRU and LSTM, here with --seq-len 5", fontsize=11)
    timeline(axis, {"hidden state": 0.4}, cuts, "sequence")
    stored = {ROLLOUT: OLD, ROLLOUT + 5: STORED, EPISODE: "white"}  # what each sequence starts from
    for step in range(FIRST, END):
        box(axis, (step, 0.4), FRESH if step >= ROLLOUT else UNUSED)
        if step in stored:
            box(axis, (step - 0.5, 0.4), stored[step], 0.3)
        elif step > FIRST:
            arrow(axis, (step - 0.7, 0.4), (step - 0.3, 0.4), EDGE, width=1)
            if step > ROLLOUT:
                arrow(axis, (step - 0.1, 0.68), (step - 0.9, 0.68), GRADIENT, 0.5)
    axis.text(EPISODE - 0.5, 0.4, "0", ha="center", va="center", fontsize=9)
    legend(figure, "goes on to the next step")
    return figure


def transformer() -> Figure:
    """Draw what a query of either of two segments sees, and what it teaches with --trxl-memory-gradient."""
    figure = Figure(figsize=(11, 8), layout="constrained")
    cuts, window = [ROLLOUT, ROLLOUT + 6], 5
    for axis, query in zip(figure.subplots(2), (ROLLOUT + 3, ROLLOUT + 7), strict=True):
        segment = max(cut for cut in cuts if cut <= query)
        axis.set_title(
            f"TrXL with --trxl-memory-gradient, two blocks, window of {window}, segments of 6: "
            f"what step {query} looks at, and what it teaches",
            fontsize=11,
        )
        rows = {"input of block 1": 0.4, "input of block 2": 2.0, "output of block 2": 3.6}
        timeline(axis, rows, cuts, "segment")
        for height, above in pairwise(rows.values()):
            for step in range(FIRST, END):
                color = FRESH if step >= segment else STORED if step >= ROLLOUT else OLD
                seen = query - window <= step <= query
                box(axis, (step, height), color if seen else UNUSED)
                if seen:
                    end = (step + 0.15 * (query > step), height + 0.28)
                    arrow(axis, (query, above - 0.28), end, GRADIENT if step >= segment else EDGE)
        box(axis, (query, rows["output of block 2"]), FRESH)
    legend(figure, "looks at, without gradient")
    return figure


def main(folder: Path = Path("docs")) -> None:
    """Draw both to a folder."""
    for name, draw in (("memory_gru", recurrent), ("memory_trxl", transformer)):
        draw().savefig(folder / f"{name}.png", dpi=110)


if __name__ == "__main__":
    with one_line_exit(OSError):
        tyro.cli(main)
