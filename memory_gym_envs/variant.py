"""What tells one id of a family from another."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeVar

from memory_gym_envs.entries import Entries
from memory_gym_envs.options import Option

Row = TypeVar("Row")


@dataclass(frozen=True)
class Variant:
    """An id. A family whose ids differ in more than that extends it."""

    render_fps: int
    options: tuple[Option, ...]  # that a reset takes
    entries: tuple[Entries, ...]  # of a vector observation
    grid: bool = False  # turn and walk tile by tile, instead of free movement
    endless: bool = False


def applicable(rows: Iterable[tuple[bool, Row]]) -> tuple[Row, ...]:
    """The rows whose condition holds, in their order."""
    return tuple(row for condition, row in rows if condition)


def max_steps(default: int) -> Option:
    """The option that truncates an episode."""
    return Option("max_steps", default, "int", 1, None, "steps until truncation; -1: no limit", also=(-1,))


def agent_scale(ignored: bool = False) -> Option:
    """The option that sets the agent's size."""
    return Option("agent_scale", 0.25, "float", 0.04, 1.0, "size of the agent; 0.25: 12 pixels wide", ignored=ignored)


def agent_speed() -> Option:
    """The option that sets how far the agent walks."""
    return Option("agent_speed", 3.0, "float", 0.0, 84.0, "pixels that the agent walks in a step")
