"""What tells one id of a family from another."""

from collections.abc import Iterable
from dataclasses import dataclass

from memory_gym_envs.entries import Entries
from memory_gym_envs.options import Option


@dataclass(frozen=True)
class Variant:
    """An id. A family whose ids differ in more than that extends it."""

    render_fps: int
    options: tuple[Option, ...]  # that a reset takes
    entries: tuple[Entries, ...]  # of a vector observation
    grid: bool = False  # turn and walk tile by tile, instead of free movement
    endless: bool = False


def applicable(rows: Iterable[tuple[bool, Option]]) -> tuple[Option, ...]:
    """The options whose condition holds, in their order."""
    return tuple(option for condition, option in rows if condition)


# Options that several families have.
MAX_STEPS = Option("max_steps", -1, "int", 1, None, "steps until truncation; -1: no limit", also=(-1,))
AGENT_SCALE = Option("agent_scale", 0.25, "float", 0.04, 1.0, "size of the agent; 0.25: 12 pixels wide")
AGENT_SPEED = Option("agent_speed", 3.0, "float", 0.0, 84.0, "pixels that the agent walks in a step")
