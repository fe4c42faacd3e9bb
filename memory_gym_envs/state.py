"""A family's state: a dataclass whose fields are arrays, each declared with its axes and its type.

An axis is a number of entries, or a letter that stands for one: N is the number of lanes. An array whose last axis has
another letter grows when a level needs more room, along with all others that have this axis.
"""

from dataclasses import field, fields
from typing import Any, TypeVar

import numpy as np

State = TypeVar("State")


def array(*axes: int | str, dtype: Any = np.int64, fill: Any = 0) -> Any:
    """A field of a state: an array with these axes, filled with `fill`, also where it grows."""
    return field(metadata={"axes": axes, "dtype": dtype, "fill": fill})


def empty(kind: type[State], **sizes: int) -> State:
    """A state of this kind. sizes: of the axes that have a letter, by the letter."""
    arrays = {}
    for each in fields(kind):  # type: ignore[arg-type]
        shape = [sizes[axis] if isinstance(axis, str) else axis for axis in each.metadata["axes"]]
        arrays[each.name] = np.full(shape, each.metadata["fill"], each.metadata["dtype"])
    return kind(**arrays)


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
