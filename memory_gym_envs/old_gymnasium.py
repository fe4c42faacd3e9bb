"""What older versions of Gymnasium need: names that they lack, and a warning of their wrong wrappers.

Before 1.1, single environments alone are tested. Before 1.4, vector wrappers are wrong with same-step autoreset, and
whoever uses one is told.
"""

import sys
from enum import Enum
from functools import cache
from types import FrameType
from typing import TYPE_CHECKING

import gymnasium as gym

__all__ = ["AutoresetMode", "VectorEnv", "warn_of_wrappers"]


def version() -> tuple[int, ...]:
    """The first two numbers of Gymnasium's version."""
    return tuple(int(part) for part in gym.__version__.split(".")[:2])


if TYPE_CHECKING or version() >= (1, 1):
    from gymnasium.vector import AutoresetMode, VectorEnv
else:
    if version() >= (1, 0):
        from gymnasium.vector import VectorEnv
    else:
        from gymnasium.experimental.vector import VectorEnv

    class AutoresetMode(Enum):
        """When an ended episode is reset."""

        NEXT_STEP = "NextStep"
        SAME_STEP = "SameStep"
        DISABLED = "Disabled"


MENDED = (1, 4)  # the version of Gymnasium in which they are right
WRONG = {
    "RecordEpisodeStatistics": "leaves out the first step of every episode but a lane's first. Use Gymnasium 1.4 or "
    "later, or gym.make_vec(..., autoreset_mode=gymnasium.vector.AutoresetMode.NEXT_STEP)",
    "NormalizeReward": "adds up rewards beyond the end of an episode. Use Gymnasium 1.4 or later",
}


def warn_of_wrappers() -> None:
    """Warns of those around an environment whose reset() calls this: they are resetting, too, so they are callers."""
    if version() >= MENDED:
        return
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        for kind in type(frame.f_locals.get("self")).__mro__:
            if kind.__module__.startswith("gymnasium.wrappers.vector") and kind.__name__ in WRONG:
                warn_of(kind.__name__)
        frame = frame.f_back


@cache
def warn_of(wrapper: str) -> None:
    """Warns of this wrapper, once in a process."""
    name = f"vector.{wrapper} of Gymnasium {gym.__version__}"
    gym.logger.warn(f"{name} is wrong with same-step autoreset: it {WRONG[wrapper]}")
