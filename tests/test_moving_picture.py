"""benchmarks/moving_picture.py: an agent at work."""

from pathlib import Path

import numpy as np
from PIL import Image

import moving_picture

ROOT = Path(__file__).parents[1]


def test_a_frame_for_each_step(tmp_path, capsys):
    moving_picture.main(ROOT / "agents/mortar-mayhem-grid-trxl.pt", tmp_path / "agent.gif")
    steps = int(capsys.readouterr().out.split()[-2])
    with Image.open(tmp_path / "agent.gif") as picture:
        durations = []
        for frame in range(picture.n_frames):
            picture.seek(frame)
            durations.append(picture.info["duration"])
        assert picture.size == (2 * 336 + 8, 336 + 2 * 44)
    # Steps in which nothing moves are one longer frame; the first frame is before the first step.
    assert sum(durations) == (steps + moving_picture.LAST) * moving_picture.MILLISECONDS


def test_a_strip_of_commands():
    """The first was carried out, the second is due, the third comes later; there is no fourth."""
    picture = np.asarray(moving_picture.strip(7, {"commands": [3, 0, 4, -1], "carried_out": 1}, 680))
    colors = [{*map(tuple, picture[:, x : x + 45].reshape(-1, 3))} for x in (118, 173, 228, 283)]
    assert [moving_picture.GREEN in box for box in colors] == [True, False, False, False]
    assert [moving_picture.ORANGE in box for box in colors] == [False, True, False, False]
    assert [(0, 0, 0) in box for box in colors] == [True, True, True, False], "symbols"


def test_the_readme_s_picture_is_small():
    assert (ROOT / "docs/agent.gif").stat().st_size < 1e6
