"""Print docs/options.md, the reset options of every environment, from the tables that the environments check against.

python benchmarks/options_page.py > docs/options.md
"""

import json
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this clone, before an installed one

from memory_gym_envs import FAMILIES, Option
from memory_gym_envs.options import LARGEST, LONGEST_LIST
from memory_gym_envs.variant import Variant

HEAD = f"""# Reset options

`reset(options={{...}})` and `gym.make(id, options={{...}})` take these options.
[How long they hold](environments.md#options). Columns with an id are its defaults: a dash where it does not have the
option, "ignored" where the option has no effect, as in the original.

Allowed values include both ends. `ints` is a list of 1 to {LONGEST_LIST} integers; one is sampled at every reset.
"""


def number(value: float) -> str:
    """Return a number as short as it can be written."""
    return f"{'-' if value < 0 else ''}1e9" if abs(value) == LARGEST else f"{value:g}"


def allowed(option: Option) -> str:
    """Return the allowed values in a few characters."""
    if option.kind == "bool":
        return "bool"
    text = f"{option.kind} " + "..".join(number(end) for end in option.bounds)
    return " or ".join([*map(str, option.also), text]) + (", or empty" if option.empty else "")


def allowed_in(rows: Mapping[str, Option]) -> str:
    """Return the allowed values of an option, by id; where they differ, those of the first id come first."""
    ids: dict[str, list[str]] = {}
    for id_, option in rows.items():
        ids.setdefault(allowed(option), []).append(id_)
    first, *others = ids
    return "; ".join([first, *(f"{other} in {', '.join(ids[other])}" for other in others)])


def default(option: Option | None) -> str:
    """Return the cell of an id that has the option, or has not."""
    if option is None:
        return "-"
    return "ignored" if option.ignored else f"`{json.dumps(option.default)}`"


def names_in_order(variants: Mapping[str, Variant]) -> list[str]:
    """Return the names of all options. What only a later id has stands before the next option that it shares."""
    names: list[str] = []
    for variant in variants.values():
        at = len(names)
        for option in reversed(variant.options):
            if option.name in names:
                at = names.index(option.name)
            else:
                names.insert(at, option.name)
    return names


def table(variants: Mapping[str, Variant]) -> str:
    """Return a family's table. Raises ValueError if an option does not mean the same in all ids."""
    lines = [f"| option | meaning | allowed | {' | '.join(variants)} |", "|---" * (3 + len(variants)) + "|"]
    for name in names_in_order(variants):
        rows = {id_: option for id_, variant in variants.items() for option in variant.options if option.name == name}
        meaning, *others = {option.meaning for option in rows.values()}
        if others:
            raise ValueError(f"{name} means {meaning!r} in one id, and {others} in others")
        defaults = " | ".join(default(rows.get(id_)) for id_ in variants)
        lines.append(f"| `{name}` | {meaning} | {allowed_in(rows)} | {defaults} |")
    return "\n".join(lines)


def page(head: str, table: Callable[[Mapping[str, Variant]], str]) -> str:
    """Return a page as Markdown, with a table for each family."""
    titles = [re.sub("(?<=[a-z])(?=[A-Z])", " ", family.__name__) for family in FAMILIES]
    tables = [f"## {name}\n\n{table(family.variants)}\n" for name, family in zip(titles, FAMILIES, strict=True)]
    return "\n".join([head, *tables])


if __name__ == "__main__":
    print(page(HEAD, table), end="")
