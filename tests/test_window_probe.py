"""benchmarks/window_probe.py: the same agent with other windows."""

import numpy as np
import pytest
import window_probe

import evaluate
import ppo_gru
import ppo_trxl

TASK = {"env_id": "MortarMayhemB-Grid-v0", "obs_type": "vector", "save_model": True}


def test_rows_of_the_windows(tiny, monkeypatch, capsys):
    folder = ppo_trxl.main(tiny(ppo_trxl, **TASK))
    monkeypatch.chdir(folder)
    play, windows = evaluate.play, []

    def spy(checkpoint, seed):
        windows.append(checkpoint.args.trxl_memory_length)
        return play(checkpoint, seed)

    monkeypatch.setattr(evaluate, "play", spy)
    window_probe.main(window_probe.Config("model.pt", windows=(3, 7, 100, 200), levels=3, repeats=2))
    assert windows == [3, 7, 100, 200]
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("| window | commands_completed, mean | IQM |")
    narrow, trained, wide, wider = (row.strip("| ").split(" | ") for row in told[2:])
    assert (narrow[0], trained[0]) == ("3", "7, as trained")
    assert float(wide[-1]) < 100
    assert wide[1:] == wider[1:], "no episode is longer"

    played = play(evaluate.Checkpoint.read("model.pt", evaluate.Config(levels=3, repeats=2)), 1)
    assert float(trained[1]) == pytest.approx(played["commands_completed"].mean(), abs=0.005)
    assert float(trained[4]) == np.max(played["length"])


def test_only_a_transformer_has_a_window(tiny):
    folder = ppo_gru.main(tiny(**TASK))
    with pytest.raises(SystemExit, match=r"model\.pt was trained by ppo_gru\.py; only transformers"):
        window_probe.main(window_probe.Config(f"{folder}/model.pt"))
