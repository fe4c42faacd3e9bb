"""The pages that programs make are what the programs make today."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import ppo_gru
import ppo_trxl

ROOT = Path(ppo_gru.__file__).parent


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


def test_readme_names_what_exists():
    readme = (ROOT / "README.md").read_text()
    for path in re.findall(r"\]\(((?:docs|benchmarks)/[^)]+)\)", readme) + re.findall(r"python (\S+\.py)", readme):
        assert (ROOT / path).exists(), path
    for script in (ppo_gru, ppo_trxl):
        flags = {script.flag(name) for name in script.Args.__dataclass_fields__}
        lines = re.findall(rf"python {script.__name__}\.py (--[^`\n]*)", readme)
        assert len(lines) > 5
        for line in lines:
            assert set(re.findall(r"--[a-z-]+", line)) <= flags | {"--help"}, line
