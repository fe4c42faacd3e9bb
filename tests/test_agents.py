"""The trained agents in agents/ play as well as their table says, and were trained by the command beside it."""

import re
import shlex
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import tyro

import evaluate
import learning
import tables
from ppo_utils.checkpoints import Checkpoint

AGENTS = Path(__file__).parents[1] / "agents"
RESULTS = Path(__file__).parents[1] / "benchmarks/results"
ROWS = re.findall(r"^\| `(\S+)` \| (\w+) \| ([\d.]+) \| `python benchmarks/learning.py (.+)` \|$",
                  (AGENTS / "README.md").read_text(), re.MULTILINE)  # fmt: skip


def test_the_table_has_all_agents():
    assert [row[0] for row in ROWS] == sorted(path.name for path in AGENTS.glob("*.pt"))
    sizes = [path.stat().st_size for path in AGENTS.glob("*.pt")]
    assert max(sizes) < 2**20
    assert sum(sizes) < 14e6


@pytest.mark.parametrize(("name", "metric", "score", "flags"), ROWS, ids=[row[0] for row in ROWS])
def test_an_agent_plays_as_well_as_published(name, metric, score, flags):
    checkpoint = Checkpoint.read(str(AGENTS / name))
    few = 20 if "endless" in name else 75  # of the 1,000 test levels; endless episodes are long
    levels = evaluate.Config(start_level=learning.FIRST_TEST_LEVEL, levels=few, repeats=1)
    scores = evaluate.play(checkpoint, levels)[metric]  # (M, E)
    # Within four standard errors of fewer levels and, with other roundings, other actions. Where all of them have a
    # score of 1, their own deviation tells nothing.
    published = float(score)
    least = (published * (1 - published)) ** 0.5 if 0.9 < published <= 1 else 0
    error = max(scores.std(), least) / scores.size**0.5
    assert scores.mean() == pytest.approx(published, abs=0.005 + 4 * error)

    (planned,) = learning.plans_of(tyro.cli(learning.Config, args=shlex.split(flags))).values()
    assert learning.settings(asdict(planned.args)) == learning.settings(asdict(checkpoint.args))
    assert planned.args.exp_name == checkpoint.args.exp_name


def test_what_agents_of_mystery_path_have_on_new_levels():
    """As the results of the commands in the table say."""
    found = {}
    for name, metric, _, flags in ROWS:
        if name.startswith("mystery-path"):
            config = replace(tyro.cli(learning.Config, args=shlex.split(flags)), results=RESULTS)
            (agents,) = learning.results_of(config, learning.plans_of(config)).values()
            (runs,) = agents.values()
            found[name.removesuffix(".pt")] = f"{tables.final_scores(metric, runs).mean():.2f}"
    told = (
        "GRU and TrXL+ have {mystery-path-grid-gru} and {mystery-path-grid-trxl} in Mystery Path Grid, with free "
        "movement {mystery-path-gru} and, after four times as many steps, {mystery-path-trxl} "
    )
    assert told.format_map(found) in " ".join((AGENTS / "README.md").read_text().split())
