"""Reset options: a table row each, by which `complete_options` checks what a caller passes, before anything changes."""

import difflib
import numbers
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

LONGEST_LIST = 100
LARGEST = 10**9  # sums of numbers up to that stay exact enough for rewards, and far from where int64 ends


@dataclass(frozen=True)
class Option:
    """One reset parameter."""

    name: str
    default: Any
    kind: str  # "bool", "int", "float", or "ints": a list of integers, one of which is sampled at every reset
    low: float | None  # the least allowed value; None: -LARGEST
    high: float | None  # the largest; None: LARGEST
    meaning: str
    also: tuple[int, ...] = ()  # single values that are allowed besides
    empty: bool = False  # a list may have no entries
    ignored: bool = False  # accepted without an effect, as in the original

    @property
    def bounds(self) -> tuple[float, float]:
        """The ends of the allowed range, in numbers."""
        return -LARGEST if self.low is None else self.low, LARGEST if self.high is None else self.high

    @property
    def allowed(self) -> str:
        """The allowed values as text."""
        if self.kind == "bool":
            return "true or false"
        least = 0 if self.empty else 1
        noun = {"int": "an integer", "float": "a number", "ints": f"a list of {least} to {LONGEST_LIST} integers"}
        text = "{} from {} to {}".format(noun[self.kind], *self.bounds)
        return " or ".join([*(str(value) for value in self.also), text])

    def parse(self, value: Any) -> Any:
        """The value as bool, int, float or tuple of int; None if it is not allowed. Whole floats are integers, too."""
        if self.kind == "bool":
            return bool(value) if isinstance(value, (bool, np.bool_)) else None
        if self.kind == "ints":
            listed = isinstance(value, (list, tuple, range)) or (isinstance(value, np.ndarray) and value.ndim == 1)
            if not listed or len(value) > LONGEST_LIST or not (len(value) or self.empty):
                return None
            numbers_ = tuple(self._number(item, int) for item in value)
            return None if None in numbers_ else numbers_
        return self._number(value, int if self.kind == "int" else float)

    def _number(self, value: Any, of: type) -> Any:
        if isinstance(value, (bool, np.bool_)) or not isinstance(value, numbers.Real):
            return None
        try:
            number = of(value)
        except (OverflowError, ValueError):  # an integer that no float can hold, or infinity or NaN as an integer
            return None
        if of is int and number != value:
            return None
        low, high = self.bounds
        return number if low <= number <= high or number in self.also else None


def complete_options(
    options: tuple[Option, ...], given: Mapping[str, Any] | None, owner: str, defaults: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Completes the given reset options with the defaults: the options' own, unless other ones are given.

    Raises ValueError, in one line, for an unknown name (with the nearest valid one) or a value outside its range.
    `owner` is the id that the message names.
    """
    if given is not None and not isinstance(given, Mapping):
        raise ValueError(f"{owner}: options must be a dictionary or None, not {brief(given)}")
    table = {option.name: option for option in options}
    values = dict(defaults or {name: option.parse(option.default) for name, option in table.items()})
    for name, value in (given or {}).items():
        if name not in table:
            near = table[difflib.get_close_matches(brief(name), table, n=1, cutoff=0.0)[0]]
            raise ValueError(f"{owner} has no option {brief(name)}; the nearest is {near.name!r} ({near.allowed})")
        parsed = table[name].parse(value)
        if parsed is None:
            raise ValueError(f"{owner}: option {name!r} must be {table[name].allowed}, not {brief(value)}")
        values[name] = parsed
    return values


def brief(value: Any) -> str:
    """The value in at most 80 characters on one line, for an error message."""
    try:
        text = repr(value).replace("\n", "")
    except ValueError:  # Python writes out no integer of more than 4300 digits
        text = "a number too large to be written out"
    return text if len(text) <= 80 else f"{text[:77]}..."
