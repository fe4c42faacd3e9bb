"""Memory Gym's environments, batched: importing this package registers their ids with Gymnasium.

`gym.make(id)` makes one environment, and `gym.make_vec(id, num_envs=N)` N of them in one object. Each id also exists in
a namespace, as memory_gym_envs/MortarMayhem-v0, since the original registers the same bare ids: importing it too
leaves `gym.make` of those to whichever was imported last.
"""

import warnings
from importlib import metadata

from memory_gym_envs.base import MemoryGymVectorEnv
from memory_gym_envs.mortar_mayhem import MortarMayhem
from memory_gym_envs.mystery_path import EASY as EASY_MYSTERY_PATH
from memory_gym_envs.mystery_path import MysteryPath
from memory_gym_envs.options import Option
from memory_gym_envs.searing_spotlights import SearingSpotlights
from memory_gym_envs.single import MemoryGymEnv, MortarMayhemEnv, MysteryPathEnv, SearingSpotlightsEnv, register

__all__ = [
    "EASY_MYSTERY_PATH",
    "IDS",
    "MemoryGymEnv",
    "MemoryGymVectorEnv",
    "MortarMayhem",
    "MysteryPath",
    "Option",
    "SearingSpotlights",
    "register",
]

FAMILIES = (MortarMayhem, MysteryPath, SearingSpotlights)
IDS = tuple(variant for family in FAMILIES for variant in family.variants)

for _environment in (MortarMayhemEnv, MysteryPathEnv, SearingSpotlightsEnv):
    register(_environment)
    register(_environment, namespace="memory_gym_envs")


def warn_of_two_distributions() -> None:
    """Warns if this package is installed twice: one overwrites the other's files, and takes them away again."""
    for name in ("memory-gym-envs", "memory-gym-baselines"):
        try:
            metadata.distribution(name)
        except metadata.PackageNotFoundError:
            return
    remedy = "uninstall both, then install the one that you want"
    warnings.warn(f"memory-gym-envs and memory-gym-baselines both install memory_gym_envs: {remedy}", stacklevel=2)


warn_of_two_distributions()
