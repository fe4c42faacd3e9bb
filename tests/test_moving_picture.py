"""benchmarks/moving_picture.py: an agent at work."""

from pathlib import Path

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
        assert picture.size == (2 * 336 + 8, 336 + 44)
    # Steps in which nothing moves are one longer frame; the first frame is before the first step.
    assert sum(durations) == (steps + moving_picture.LAST) * moving_picture.MILLISECONDS


def test_the_readme_s_picture_is_small():
    assert (ROOT / "docs/agent.gif").stat().st_size < 1e6
