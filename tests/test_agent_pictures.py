"""benchmarks/pictures.py: an agent at work."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pictures
import ppo_gru

ROOT = Path(__file__).parents[1]


def test_a_frame_for_each_step(tmp_path, capsys):
    pictures.main(pictures.Config(ROOT / "agents/mortar-mayhem-grid-trxl.pt", tmp_path / "agent.gif"))
    steps = int(capsys.readouterr().out.split()[-2])
    with Image.open(tmp_path / "agent.gif") as picture:
        durations = []
        for frame in range(picture.n_frames):
            picture.seek(frame)
            durations.append(picture.info["duration"])
        assert picture.size == (2 * 336 + 8, 336 + 2 * 44)
    # Steps in which nothing moves are one longer frame; the first frame is before the first step.
    assert sum(durations) == (steps + pictures.LAST) * pictures.MILLISECONDS


def test_six_steps(tmp_path, monkeypatch, capsys):
    """At even distances, the first before any action, the last at the episode's end."""
    steps, text = [], pictures.text
    monkeypatch.setattr(pictures, "text", lambda words, *width: steps.append(words) or text(words, *width))
    pictures.main(pictures.Config(ROOT / "agents/mystery-path-grid-trxl.pt", tmp_path / "mystery_path.png", 1_000_003))
    end = int(capsys.readouterr().out.split()[-2])
    assert steps[:6] == [f"step {round(end * part / 5)}" for part in range(6)]
    made, shown = (Image.open(folder / "mystery_path.png").size for folder in (tmp_path, ROOT / "docs"))
    assert made == shown


def test_an_agent_of_another_package(tiny, monkeypatch, tmp_path):
    """Its episodes have no debug view."""
    monkeypatch.chdir(tmp_path)
    ppo_gru.main(tiny(env_id="CartPole-v1", save_model=True))
    with pytest.raises(ValueError, match=r"model\.pt was trained in CartPole-v1; give an agent of a Memory Gym"):
        pictures.main(pictures.Config(next(Path("runs").glob("*/model.pt")), tmp_path / "agent.gif"))


def test_a_strip_of_commands():
    """The first was carried out, the second is due, the third comes later; there is no fourth."""
    picture = np.asarray(pictures.strip(7, {"commands": [3, 0, 4, -1], "carried_out": 1}, 680))
    colors = [{*map(tuple, picture[:, x : x + 45].reshape(-1, 3))} for x in (118, 173, 228, 283)]
    assert [pictures.GREEN in box for box in colors] == [True, False, False, False]
    assert [pictures.ORANGE in box for box in colors] == [False, True, False, False]
    assert [(0, 0, 0) in box for box in colors] == [True, True, True, False], "symbols"


def test_the_readme_s_picture_is_small():
    assert (ROOT / "docs/agent.gif").stat().st_size < 1e6
