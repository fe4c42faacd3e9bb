"""benchmarks/bounds.py: what random actions and a player that sees the state score."""

import numpy as np
import pytest

import bounds
from suites import TASKS


@pytest.mark.parametrize("name", ["mortar-mayhem", "MortarMayhemB-Grid-v0", "MysteryPath-Grid-v0"])
def test_the_scripted_player_solves_finite_tasks_and_random_actions_do_not(name):
    assert bounds.play(TASKS[name], bounds.scripted_player, levels=5).tolist() == pytest.approx([1.0] * 5)
    assert bounds.play(TASKS[name], bounds.random_player, levels=5).mean() < 0.5


def test_endless_episodes_are_cut_short():
    """Of 0.1 for each tile: one is reached every four steps, by the player that never falls off."""
    task = TASKS["Endless-MysteryPath-v0"]
    short, longer = (bounds.play(task, bounds.scripted_player, levels=8, max_steps=steps) for steps in (40, 80))
    assert (short <= 1.0 + 1e-9).all()
    assert (longer >= short).all()
    assert np.median(longer) > 1.5


def test_the_file(tmp_path):
    bounds.main(tmp_path / "bounds.csv", levels=2, max_steps=5)
    head, *rows = (tmp_path / "bounds.csv").read_text().splitlines()
    assert head == "task,score,random,scripted"
    assert len(rows) == 11
    assert "MysteryPath-Grid-v0,success,0,0" in rows
