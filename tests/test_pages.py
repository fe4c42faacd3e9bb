"""The pages that programs make are what the programs make today."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", ["options", "vectors"])
def test_page(name):
    program = ROOT / f"benchmarks/{name}_page.py"
    made = subprocess.run([sys.executable, program], capture_output=True, text=True, check=True)
    assert made.stdout == (ROOT / f"docs/{name}.md").read_text()


def test_pictures(tmp_path):
    subprocess.run([sys.executable, ROOT / "benchmarks/pictures.py", tmp_path], check=True)
    for family in ("mortar_mayhem", "mystery_path", "searing_spotlights"):
        made, shown = (np.asarray(Image.open(folder / f"{family}.png")) for folder in (tmp_path, ROOT / "docs"))
        assert np.array_equal(made, shown), family
