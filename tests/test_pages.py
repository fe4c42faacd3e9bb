"""The pages that programs make are what the programs make today."""

import json
from pathlib import Path

import pytest
from programs import run_command

from memory_gym_envs import FAMILIES

ROOT = Path(__file__).parents[1]


def test_page():
    made = run_command(ROOT / "benchmarks/options_page.py")
    assert (made.returncode, made.stdout) == (0, (ROOT / "docs/options.md").read_text())


@pytest.mark.parametrize(("env_id", "variant"), [row for family in FAMILIES for row in family.variants.items()])
def test_page_has_every_default(env_id, variant):
    section = next(part for part in (ROOT / "docs/options.md").read_text().split("\n### ") if f"| {env_id} |" in part)
    header, _, *rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("|")]
    shown = {row[0].strip("`"): row[header.index(env_id)].strip("`") for row in rows}
    shown = {name: text for name, text in shown.items() if text != "-"}
    assert shown == {o.name: "ignored" if o.ignored else json.dumps(o.default) for o in variant.options}
