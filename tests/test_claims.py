"""benchmarks/claims.py: its verdicts, and one claim from its trainings to its row."""

from pathlib import Path

import claims
import learning
import numpy as np
import pytest


@pytest.mark.parametrize(
    ("more", "less", "apart", "verdict"),
    [
        ([[4, 5, 6]], [[1, 2, 3]], True, "holds"),
        ([[1, 2, 3]], [[4, 5, 6]], True, "does not hold"),
        ([[4, 5, 6]], [[1, 2, 4]], True, "not decided"),
        ([[4, 5, 6], [7, 8, 9]], [[1, 2, 3], [2, 2, 3.5]], True, "holds"),
        ([[4, 5, 6], [7, 8, 9]], [[1, 2, 3], [2, 2, 4.5]], True, "not decided"),
        ([[4, 5, 6]], [[1, 2, 3]], False, "contradicted"),
        ([[4, 5, 6]], [[1, 2, 4]], False, "not contradicted"),
    ],
)
def test_verdicts(more, less, apart, verdict):
    claim = claims.Claim("1.1", "more is more", claims.ENDLESS, ("GRU",), ("TrXL",), apart=apart)
    assert claims.verdict(claim, np.array(more), np.array(less)) == verdict


@pytest.mark.parametrize("name", claims.CLAIMS)
def test_every_claim_compares_agents_that_can_be_trained(name):
    claim = claims.CLAIMS[name]
    lines = [
        learning.command(claims.Config(), claim.task, agent, seed)
        for agent in (*claim.more, *claim.less)
        for seed in (1, 2)
    ]
    arguments = [learning.arguments([line[0], Path(line[1]).name, *line[2:]]) for line in lines]
    assert len({tuple(each.items()) for each in arguments}) == len(lines), "no two are the same"


def test_a_claim_from_training_to_its_row(tmp_path, monkeypatch, capsys):
    small = "--num-envs 2 --num-steps 32 --num-minibatches 2 --head-size 8 --eval-levels 2 --eval-repeats 1"
    monkeypatch.setattr(learning, "COMMON", f"{learning.COMMON} {small}")
    names = ("norm-adv", "norm-adv-gradient")
    config = claims.Config(claims=names, steps_scale=128 / 1e6, seeds=(1, 2), evaluations=1, folder=tmp_path / "runs")
    config.results = tmp_path / "results"
    claims.main(config)
    told = capsys.readouterr().out
    assert told.count("trained GRU") == 4, "two agents for both claims"
    runs = [learning.result_of(config, claims.VISIBLE, "GRU --norm-adv minibatch", seed) for seed in (1, 2)]
    norms = [run.curves["losses/grad_norm"][1].mean() for run in runs]
    row = "| 7.2 | gradients are larger with normalized advantages | `norm-adv-gradient` | gradient_norm: "
    figure = f"GRU --norm-adv minibatch {np.mean(norms):.3g} ({min(norms):.3g} to {max(norms):.3g}); GRU "
    assert told.splitlines()[-1].startswith(row + figure)
    claims.main(config)
    assert "trained" not in capsys.readouterr().out


def test_unknown_claim():
    with pytest.raises(SystemExit, match="there is no claim gru; there are memory-mortar-mayhem, "):
        claims.main(claims.Config(claims=("gru",)))
