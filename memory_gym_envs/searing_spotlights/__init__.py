"""Searing Spotlights: stay out of the light, remember where you are, collect coins and leave (thesis 4.5)."""

from memory_gym_envs.searing_spotlights.environment import SearingSpotlights
from memory_gym_envs.searing_spotlights.options import VARIANTS

__all__ = ["VARIANTS", "SearingSpotlights"]
