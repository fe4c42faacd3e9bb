"""Print docs/options.md: the reset options of every environment, and what its vector observation holds.

Both come from the tables that the environments themselves are made of.

python benchmarks/options_page.py > docs/options.md
"""

import json
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this clone, before an installed one

from memory_gym_envs import FAMILIES, Option
from memory_gym_envs.entries import Entries, vector_slices
from memory_gym_envs.options import LARGEST, LONGEST_LIST
from memory_gym_envs.variant import Variant

OPTIONS = f"""# Options and vectors

## Reset options

`reset(options={{...}})` and `gym.make(id, options={{...}})` take these ([how long they hold](environments.md#options)).
Columns with an id are its defaults: a dash where it does not have the option, "ignored" where the option has no effect,
as in the original. Allowed values include both ends. `ints` is a list of 1 to {LONGEST_LIST} integers, of which a reset
samples one.
"""
VECTORS = """## Vector observations

With `obs_type="vector"`, observations are flat float32 vectors of what the image shows, and no image is drawn. Under
the same options, two states with the same image have the same vector. What is not in sight is 0. A column with ids says
where the entries are in their vector, counted from 0; its length is in brackets. Entries are from 0 to 1, unless a
range stands beside them. Pixels count from the left and from the top of the 84 x 84 screen, x before y. The order of
facings is up, up-left, left, and so on to up-right.

- Where something hides a part of the agent, all facings that would look the same are 1, and the place is the middle of
  all places that would. Agents so large that they hide whole tiles hide their entries, too.
- In Searing Spotlights, what is seen below the bar is counted from every third pixel: a few visible pixels may count as
  none.
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


def options_table(variants: Mapping[str, Variant]) -> str:
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


def cell(row: Entries | None, at: slice) -> str:
    """Return where the entries are, with their range where it is not 0 to 1; a dash if the id has none."""
    if row is None:
        return "-"
    place = f"{at.start}" if row.width == 1 else f"{at.start}-{at.stop - 1}"
    return place if (row.low, row.high) == (0, 1) else f"{place} ({row.low:g} to {row.high:g})"


def vectors_table(variants: Mapping[str, Variant]) -> str:
    """Return a family's table, a column for all ids with the same entries.

    Raises ValueError if entries do not mean the same in all ids.
    """
    ids: dict[tuple[Entries, ...], list[str]] = {}
    meanings: dict[str, str] = {}
    for id_, variant in variants.items():
        ids.setdefault(variant.entries, []).append(id_)
        for row in variant.entries:
            if meanings.setdefault(row.name, row.meaning) != row.meaning:
                raise ValueError(f"{row.name} of {id_} means something else in the ids before")
    heads = [f"{', '.join(same)} ({sum(row.width for row in rows)})" for rows, same in ids.items()]
    lines = [f"| name | meaning | {' | '.join(heads)} |", "|---" * (2 + len(ids)) + "|"]
    for name, meaning in meanings.items():
        cells = [cell({row.name: row for row in rows}.get(name), vector_slices(rows).get(name)) for rows in ids]
        lines.append(f"| `{name}` | {meaning} | {' | '.join(cells)} |")
    return "\n".join(lines)


def part(head: str, table: Callable[[Mapping[str, Variant]], str], title: str) -> str:
    """Return a part of the page as Markdown, with a table for each family."""
    names = [re.sub("(?<=[a-z])(?=[A-Z])", " ", family.__name__) for family in FAMILIES]
    tables = [f"### {title} {name}\n\n{table(each.variants)}\n" for name, each in zip(names, FAMILIES, strict=True)]
    return "\n".join([head, *tables])


if __name__ == "__main__":
    print(part(OPTIONS, options_table, "Options of"), part(VECTORS, vectors_table, "Vectors of"), sep="\n", end="")
