"""benchmarks/window_probe.py: the same agent with other windows."""

import numpy as np
import pytest

import evaluate
import ppo_gru
import ppo_trxl
import window_probe

TASK = {"env_id": "MortarMayhemB-Grid-v0", "obs_type": "vector", "save_model": True}


def test_rows_of_the_windows(tiny, monkeypatch, capsys):
    folder = ppo_trxl.main(tiny(ppo_trxl, **TASK))
    capsys.readouterr()
    monkeypatch.chdir(folder)
    play, windows = evaluate.play, []

    def spy(checkpoint, config):
        windows.append(checkpoint.args.trxl_memory_length)
        return play(checkpoint, config)

    monkeypatch.setattr(evaluate, "play", spy)
    window_probe.main(window_probe.Config("model.pt", windows=(3, 7, 100, 200), levels=3, repeats=2))
    assert windows == [3, 7, 100, 200]
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("| window | carried_out, mean | IQM |")
    narrow, trained, wide, wider = (row.strip("| ").split(" | ") for row in told[2:])
    assert (narrow[0], trained[0]) == ("3", "7, as trained")
    assert float(wide[-1]) < 100
    assert wide[1:] == wider[1:], "no episode is longer"

    played = play(evaluate.Checkpoint.read("model.pt"), evaluate.Config(levels=3, repeats=2))
    assert float(trained[1]) == pytest.approx(played["carried_out"].mean(), abs=0.005)
    assert float(trained[4]) == np.max(played["length"])


@pytest.mark.parametrize(
    ("script", "changes", "told"),
    [
        (ppo_gru, {}, r"model\.pt was trained by ppo_gru\.py; only transformers have a window"),
        (ppo_trxl, {"windows": (4, 0)}, "--windows is 4 0; give windows of 1 step or more"),
        (ppo_trxl, {"windows": ()}, "--windows is empty; give windows of 1 step or more"),
        (ppo_trxl, {"windows": (4,), "max_steps": 2}, "with a window of 4, --max-steps 2 cut episodes short"),
    ],
)
def test_what_cannot_be_played(tiny, script, changes, told):
    folder = script.main(tiny(script, **TASK))
    with pytest.raises(ValueError, match=told):
        window_probe.main(window_probe.Config(f"{folder}/model.pt", levels=2, repeats=1, **changes))
