"""Mystery Path: find a hidden path by trial and remember it; a step off it leads back to the origin (thesis 4.4)."""

from memory_gym_envs.mystery_path.environment import MysteryPath
from memory_gym_envs.mystery_path.options import EASY, VARIANTS

__all__ = ["EASY", "VARIANTS", "MysteryPath"]
