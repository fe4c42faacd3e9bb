"""The pages that programs make are what the programs make today."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import ppo_gru

ROOT = Path(ppo_gru.__file__).parent


def test_options_page():
    made = subprocess.run(
        [sys.executable, ROOT / "benchmarks/options_page.py"], capture_output=True, text=True, check=True
    )
    assert made.stdout == (ROOT / "docs/options.md").read_text()


def test_pictures(tmp_path):
    subprocess.run([sys.executable, ROOT / "benchmarks/pictures.py", tmp_path], check=True)
    for family in ("mortar_mayhem", "mystery_path", "searing_spotlights"):
        made, shown = (np.asarray(Image.open(folder / f"{family}.png")) for folder in (tmp_path, ROOT / "docs"))
        assert np.array_equal(made, shown), family


def test_readme_names_what_exists():
    readme = (ROOT / "README.md").read_text()
    for path in re.findall(r"\]\(((?:docs|benchmarks)/[^)]+)\)", readme) + re.findall(r"python (\S+\.py)", readme):
        assert (ROOT / path).exists(), path
    flags = {ppo_gru.flag(name) for name in ppo_gru.Args.__dataclass_fields__}
    for line in re.findall(r"python ppo_gru\.py (--.*)", readme):
        assert set(re.findall(r"--[a-z-]+", line)) <= flags | {"--help"}
