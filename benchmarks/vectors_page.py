"""Print docs/vectors.md, what the vector observation of every environment holds, from the tables its space is made of.

python benchmarks/vectors_page.py > docs/vectors.md
"""

import sys
from collections.abc import Mapping
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this clone, before an installed one

from memory_gym_envs.entries import Entries, vector_slices
from memory_gym_envs.variant import Variant
from options_page import page

HEAD = """# Vector observations

With `obs_type="vector"`, observations are flat float32 vectors of what the image shows, and no image is drawn. Under
the same options, two states with the same image have the same vector. What is not in sight is 0.

A column with ids says where the entries are in their vector, counted from 0; its length is in brackets. Entries are
from 0 to 1, unless a range stands beside them. Pixels count from the left and from the top of the 84 x 84 screen, x
before y. The order of facings is up, up-left, left, and so on to up-right.

- Where something hides a part of the agent, all facings that would look the same are 1, and the place is the middle of
  all places that would.
- Agents so large that they hide whole tiles hide their entries, too.
- In Searing Spotlights, what is seen below the bar is counted from every third pixel: a few visible pixels may count as
  none.
"""


def cell(row: Entries | None, at: slice) -> str:
    """Return where the entries are, with their range where it is not 0 to 1; a dash if the id has none."""
    if row is None:
        return "-"
    place = f"{at.start}" if row.width == 1 else f"{at.start}-{at.stop - 1}"
    return place if (row.low, row.high) == (0, 1) else f"{place} ({row.low:g} to {row.high:g})"


def table(variants: Mapping[str, Variant]) -> str:
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


if __name__ == "__main__":
    print(page(HEAD, table), end="")
