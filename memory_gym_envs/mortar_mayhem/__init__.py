"""Mortar Mayhem: memorise a sequence of commands, then carry them out in time (thesis 4.3)."""

from memory_gym_envs.mortar_mayhem.environment import MortarMayhem
from memory_gym_envs.mortar_mayhem.options import VARIANTS

__all__ = ["VARIANTS", "MortarMayhem"]
