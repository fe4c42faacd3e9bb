"""benchmarks/train_sps.py: how fast the scripts train."""

import pytest

import ppo_gru
import ppo_trxl
import train_sps

FEW = "--no-cuda --num-minibatches 2 --update-epochs 1 --trunk-size 8"


@pytest.mark.parametrize(
    ("script", "flags"),
    [(ppo_gru, "--hidden-size 16 --memory lstm"), (ppo_trxl, "--trxl-segment-length 8 --trxl-dim 16 --amp")],
)
def test_a_row_for_each_length_of_rollout(capsys, monkeypatch, script, flags):
    made, setup = [], script.setup
    monkeypatch.setattr(script, "setup", lambda args: made.append(args) or setup(args))
    few = {"num_envs": 4, "num_steps": [8, 16], "rounds": 1, "chunks": [16], "flags": f"{FEW} {flags}"}
    train_sps.main(train_sps.Config(script.__name__, **few))
    _, _, *rows = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines() if line[:1] == "|"]
    assert [row[0] for row in rows] == ["4 x 8", "4 x 16"]
    for _, *numbers in rows:
        rate, distinct, convolutions, share, *_ = map(float, numbers)
        assert 0 < distinct <= 1
        assert share == pytest.approx(rate / convolutions, abs=0.01)
    for args in made:
        assert args.memory == "lstm" if script is ppo_gru else (args.amp and args.trxl_dim == 16)
