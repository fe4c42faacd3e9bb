"""Print docs/vectors.md, what the vector observation of every environment holds, from the tables its space is made of.

python benchmarks/vectors_page.py > docs/vectors.md
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this clone, before an installed one

from memory_gym_envs import FAMILIES
from memory_gym_envs.entries import vector_table

HEAD = """# Vector observations

`gym.make(id, obs_type="vector")`, and `gym.make_vec` likewise, return a flat float32 vector in place of the frame, and
draw none. It holds what the frame shows and nothing that it hides: two states with the same frame have the same vector,
under the same options. What is not in sight is zero. Pixels count from the left and from the top of the screen of
84 x 84. Made by `python benchmarks/vectors_page.py`.

What hides an agent, or a part of it, hides its entries. Behind the screen's edge, a symbol or a cross, several facings
may look the same: then all of them are 1, where usually one is. In a corner of the torus of Endless Mortar Mayhem, even
several places may. Agents so large that they hide whole tiles hide their entries, too. Sizes that only options change
are there as well, so that they mean the same under all options.

In Searing Spotlights, what is seen below the bar is counted from every third pixel, so that a few visible pixels may
count as none.
"""


def page() -> str:
    """Return the page as Markdown, a section for all ids with the same entries."""
    ids: dict[tuple, list[str]] = {}
    for family in FAMILIES:
        for id_, variant in family.variants.items():
            ids.setdefault(variant.entries, []).append(id_)
    tables = [
        f"## {', '.join(same)}\n\n{sum(row.width for row in rows)} entries.\n\n{vector_table(rows)}"
        for rows, same in ids.items()
        if rows
    ]
    return "\n".join([HEAD, "\n\n".join(tables)]) + "\n"


if __name__ == "__main__":
    print(page(), end="")
