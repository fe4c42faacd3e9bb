"""Reset options: one table row each, checked before anything changes.

A family lists its options as a tuple of `Option`. `resolve` turns what a caller passed to `reset` into a complete
dictionary of plain Python values, or raises one `ValueError` that says which option is wrong and what would be right.
`options_table` prints the same rows as Markdown.
"""

import difflib
import json
import math
import numbers
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

LONGEST_LIST = 100


@dataclass(frozen=True)
class Option:
    """One reset parameter.

    kind: "bool", "int", "float" or "ints" (a list of integers, one of which is drawn at every reset).
    low, high: the allowed range, both ends included; None: no limit on that side.
    also: single values allowed besides the range.
    empty: whether a list may have no entries.
    """

    name: str
    default: Any
    kind: str
    low: float | None
    high: float | None
    meaning: str
    also: tuple[int, ...] = ()
    empty: bool = False

    @property
    def allowed(self) -> str:
        """The allowed values in words."""
        noun = {"bool": "true or false", "int": "an integer", "float": "a number", "ints": "a list of integers"}
        text = noun[self.kind] + _range_text(self.low, self.high) + (", possibly none" if self.empty else "")
        return " or ".join([*(str(value) for value in self.also), text])

    def parse(self, value: Any) -> Any:
        """Returns the value as plain Python (bool, int, float or tuple of int), or None if it is not allowed."""
        if self.kind == "bool":
            return bool(value) if isinstance(value, (bool, np.bool_)) else None
        if self.kind == "ints":
            shortest = 0 if self.empty else 1
            if not isinstance(value, (list, tuple, np.ndarray)) or not shortest <= len(value) <= LONGEST_LIST:
                return None
            numbers_ = tuple(self._number(item, int) for item in value)
            return None if None in numbers_ else numbers_
        return self._number(value, int if self.kind == "int" else float)

    def _number(self, value: Any, of: type) -> Any:
        abstract = numbers.Integral if of is int else numbers.Real
        if isinstance(value, (bool, np.bool_)) or not isinstance(value, abstract) or not math.isfinite(value):
            return None
        number = of(value)
        inside = (self.low is None or number >= self.low) and (self.high is None or number <= self.high)
        return number if inside or number in self.also else None


def _range_text(low: float | None, high: float | None) -> str:
    if low is None and high is None:
        return ""
    if high is None:
        return f" of at least {low}"
    return f" from {low} to {high}"


def resolve(options: tuple[Option, ...], given: Mapping[str, Any] | None, owner: str) -> dict[str, Any]:
    """Completes the given reset options with the defaults.

    Raises ValueError, in one line, for an unknown name (with the nearest valid one) or a value outside its range.
    `owner` is the id that the message names.
    """
    if given is not None and not isinstance(given, Mapping):
        raise ValueError(f"{owner}: options must be a dictionary or None, not {given!r}")
    table = {option.name: option for option in options}
    values = {name: option.parse(option.default) for name, option in table.items()}
    for name, value in (given or {}).items():
        if name not in table:
            near = table[difflib.get_close_matches(str(name), table, n=1, cutoff=0.0)[0]]
            raise ValueError(f"{owner} has no option {name!r}; the nearest is {near.name!r} ({near.allowed})")
        parsed = table[name].parse(value)
        if parsed is None:
            raise ValueError(f"{owner}: option {name!r} must be {table[name].allowed}, not {value!r}")
        values[name] = parsed
    return values


def options_table(options: tuple[Option, ...]) -> str:
    """The options as a Markdown table: name, default, allowed values, meaning."""
    rows = ["| option | default | allowed | meaning |", "|---|---|---|---|"]
    rows += [f"| `{o.name}` | `{json.dumps(o.default)}` | {o.allowed} | {o.meaning} |" for o in options]
    return "\n".join(rows)
