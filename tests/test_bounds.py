"""benchmarks/bounds.py: what random actions and a player that sees the state score."""

import numpy as np
import pytest

import bounds
from learning import TASKS


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


def test_the_table(capsys):
    bounds.main(levels=2, max_steps=5)
    head, _, *rows = capsys.readouterr().out.splitlines()
    assert head == "| task, score | random actions | scripted player |"
    assert len(rows) == 10
    assert rows[0].startswith("| MortarMayhem-v0, carried_out | 0.00 ± 0.00 |")
