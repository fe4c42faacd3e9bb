"""benchmarks/bounds.py: what random actions and a player that sees the state score."""

import numpy as np
import pytest

import bounds
from suites import TASKS


@pytest.mark.parametrize("name", ["mortar-mayhem", "MortarMayhemB-Grid-v0", "MysteryPath-Grid-v0"])
def test_the_scripted_player_solves_finite_tasks_and_random_actions_do_not(name):
    assert bounds.play(TASKS[name], bounds.scripted_player, levels=5).tolist() == pytest.approx([1.0] * 5)
    assert bounds.play(TASKS[name], bounds.random_player, levels=5).mean() < 0.5


def test_levels_that_do_not_score_are_not_played_either(monkeypatch, tmp_path):
    """The first and the third level's path was trained on."""
    scores = {bounds.random_player: [0.5, 0.0, 0.5, 0.25], bounds.scripted_player: [0.0, 1.0, 0.0, 0.5]}
    monkeypatch.setattr(bounds, "play", lambda task, player, levels, steps: np.array(scores[player][:levels]))
    new = np.array([False, True, False, True, True])
    monkeypatch.setattr(bounds, "scored_levels", lambda env_id, options: new if "Path-Grid" in env_id else None)
    bounds.main(tmp_path / "bounds.csv", levels=4)
    rows = (tmp_path / "bounds.csv").read_text().splitlines()
    assert "MysteryPath-Grid-v0,0.125,0.75" in rows
    assert "MysteryPath-v0,0.3125,0.375" in rows


def test_endless_episodes_are_cut_short():
    """Of 0.1 for each tile: one is reached every four steps, by the player that never falls off."""
    task = TASKS["Endless-MysteryPath-v0"]
    short, longer = (bounds.play(task, bounds.scripted_player, levels=8, max_steps=steps) for steps in (40, 80))
    assert (short <= 1.0 + 1e-9).all()
    assert (longer >= short).all()
    assert np.median(longer) > 1.5


def test_a_stopped_program_leaves_the_file_as_it_was(monkeypatch, tmp_path):
    def stop(*_):
        raise KeyboardInterrupt

    (tmp_path / "bounds.csv").write_text("before")
    monkeypatch.setattr(bounds, "play", stop)
    with pytest.raises(KeyboardInterrupt):
        bounds.main(tmp_path / "bounds.csv")
    assert (tmp_path / "bounds.csv").read_text() == "before"


def test_the_file(tmp_path):
    bounds.main(tmp_path / "bounds.csv", levels=20, max_steps=5)
    head, *rows = (tmp_path / "bounds.csv").read_text().splitlines()
    assert head == "task,random,scripted"
    assert len(rows) == 11
    assert "MysteryPath-Grid-v0,0,0" in rows
