"""Print docs/options.md, the reset options of every environment, from the tables that the environments check against.

python benchmarks/options_page.py > docs/options.md
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this clone, before an installed one

from memory_gym_envs import FAMILIES, options_table

HEAD = """# Reset options

What `reset(options={...})` and `gym.make(id, options={...})` take, by environment. How long options hold is in
[environments.md](environments.md#options). Of a list, marked *, one entry is sampled at every reset. Made by
`python benchmarks/options_page.py`.
"""


def page() -> str:
    """Return the page as Markdown."""
    tables = [
        f"## {id_}\n\n{options_table(row.options)}" for family in FAMILIES for id_, row in family.variants.items()
    ]
    return "\n".join([HEAD, "\n\n".join(tables)]) + "\n"


if __name__ == "__main__":
    print(page(), end="")
