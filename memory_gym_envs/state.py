"""A family's state: a dataclass whose fields are arrays, each declared with its axes and its type.

An axis is a number of entries, or a letter that stands for one: N is the number of lanes. An array whose last axis has
another letter grows when a level needs more room, along with all others that have this axis.
"""

from collections.abc import Mapping
from dataclasses import field, fields
from typing import Any, TypeVar

import numpy as np

State = TypeVar("State")
Lanes = np.ndarray | slice  # some lanes by their numbers, or all


def array(*axes: int | str, dtype: Any = np.int64, fill: Any = 0, option: str | None = None) -> Any:
    """A field of a state: an array with these axes, filled with `fill`, also where it grows.

    option: the reset option whose value it holds; where an id lacks that, it stays as it is filled.
    """
    return field(metadata={"axes": axes, "dtype": dtype, "fill": fill, "option": option})


def empty(kind: type[State], **sizes: int) -> State:
    """A state of this kind. sizes: of the axes that have a letter, by the letter."""
    arrays = {}
    for each in fields(kind):  # type: ignore[arg-type]
        shape = [sizes[axis] if isinstance(axis, str) else axis for axis in each.metadata["axes"]]
        arrays[each.name] = np.full(shape, each.metadata["fill"], each.metadata["dtype"])
    return kind(**arrays)


def write_options(state: Any, lanes: Lanes, values: Mapping[str, Any]) -> None:
    """Writes the reset options to the arrays that hold them, for these lanes."""
    for each in fields(state):
        if each.metadata.get("option") in values:
            getattr(state, each.name)[lanes] = values[each.metadata["option"]]


def grows(state: Any, name: str) -> bool:
    """Whether this array of the state grows along its last axis."""
    axis = type(state).__dataclass_fields__[name].metadata["axes"][-1]
    return isinstance(axis, str) and axis != "N"


def make_room(state: Any, axis: str, size: int) -> None:
    """Widens the arrays that end with this axis to the given size, where they are narrower."""
    for each in fields(state):
        old = getattr(state, each.name)
        missing = size - old.shape[-1]
        if each.metadata["axes"][-1] == axis and missing > 0:
            more = np.full((*old.shape[:-1], missing), each.metadata["fill"], old.dtype)
            setattr(state, each.name, np.concatenate([old, more], axis=-1))
