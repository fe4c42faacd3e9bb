"""States as plain values, which any file format holds: what has a state says which of its attributes that is.

Plain are dicts with str keys, lists, tuples, str, int, float, bool, None, and NumPy arrays of numbers or bools.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from memory_gym_envs.options import brief

BIT_GENERATORS = ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64")  # NumPy's


class Saved:
    """An environment or a wrapper whose state can be saved, and set in another one that was made like it."""

    # The attributes that later steps and resets depend on: plain values and generators, in lists and dicts too.
    kept: ClassVar[tuple[str, ...]] = ()
    # What it was made with, in plain values, where a state fits no other.
    arguments: Mapping[str, Any] = MappingProxyType({})

    def get_state(self) -> dict[str, Any]:
        """The state in plain values: copies, which later steps do not change."""
        return {name: plain(getattr(self, name)) for name in self.kept}

    def set_state(self, state: dict[str, Any]) -> None:
        """Takes over a copy of what get_state() returned."""
        for name in self.kept:
            setattr(self, name, restored(state[name]))


def plain(value: Any) -> Any:
    """A copy of the value that holds a generator's state in place of each generator."""
    if isinstance(value, np.random.Generator):
        value = value.bit_generator.state
    if isinstance(value, dict):
        return {name: plain(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(map(plain, value))
    if isinstance(value, np.generic):
        return value.item()
    return value.copy() if isinstance(value, np.ndarray) else value


def is_generator(value: Any) -> bool:
    """Whether the value is what plain() makes of a generator."""
    return isinstance(value, dict) and "bit_generator" in value


def restored(value: Any) -> Any:
    """A copy of what plain() returned, with its generators. Raises ValueError for one that is none of NumPy's."""
    if is_generator(value):
        kind = value["bit_generator"]
        if kind not in BIT_GENERATORS:
            raise ValueError(f"the saved state has a generator of an unknown kind, {kind!r}")
        rng = np.random.Generator(getattr(np.random, kind)(0))
        try:
            rng.bit_generator.state = value
        except (IndexError, KeyError, OverflowError, TypeError, ValueError) as error:
            raise ValueError(f"the saved state has a generator that is no {kind}: {brief(error)}") from None
        return rng
    if isinstance(value, dict):
        return {name: restored(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(map(restored, value))
    return value.copy() if isinstance(value, np.ndarray) else value
