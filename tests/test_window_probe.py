"""benchmarks/window_probe.py: the same agent with other windows."""

import numpy as np
import pytest

import evaluate
import ppo_gru
import ppo_trxl
import window_probe
from ppo_utils.checkpoints import Checkpoint

TASK = {"env_id": "MortarMayhemB-Grid-v0", "obs_type": "vector", "save_model": True}


@pytest.fixture(scope="module")
def trained(tiny, tmp_path_factory):
    """The run folders of an agent of each script."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("trained"))
        return {script: script.main(tiny(script, **TASK)).resolve() for script in (ppo_gru, ppo_trxl)}


def test_rows_of_the_windows(trained, monkeypatch, capsys):
    monkeypatch.chdir(trained[ppo_trxl])
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

    played = play(Checkpoint.read("model.pt"), evaluate.Config(levels=3, repeats=2))
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
def test_what_cannot_be_played(trained, script, changes, told):
    with pytest.raises(ValueError, match=told):
        window_probe.main(window_probe.Config(f"{trained[script]}/model.pt", levels=2, repeats=1, **changes))
