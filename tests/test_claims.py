"""benchmarks/claims.py: its verdicts, and one claim from its trainings to its row."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import claims
import learning

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("higher", "lower", "expects_difference", "verdict"),
    [
        ([[4, 5, 6]], [[1, 2, 3]], True, "holds"),
        ([[1, 2, 3]], [[4, 5, 6]], True, "does not hold"),
        ([[4, 5, 6]], [[1, 2, 4]], True, "not decided"),
        ([[4, 5, 6], [7, 8, 9]], [[1, 2, 3], [2, 2, 3.5]], True, "holds"),
        ([[4, 5, 6], [7, 8, 9]], [[1, 2, 3], [2, 2, 4.5]], True, "not decided"),
        ([[4, 5, 6], [7, 8, 9]], [[1, 2, 3], [7, 7, 7]], True, "does not hold"),  # one of four comparisons
        ([[4, 5, 6], [1, 2, 3]], [[1, 2, 3]], False, "contradicted"),
        ([[4, 5, 6]], [[1, 2, 4]], False, "not contradicted"),
        ([[1, 2, 3]], [[4, 5, 6]], False, "not contradicted"),
        ([[4, 5]], [[1, 2]], True, "not decided"),  # two seeds are too few
        ([[4, 5]], [[1, 2]], False, "not decided"),
    ],
)
def test_verdicts(higher, lower, expects_difference, verdict):
    claim = claims.Claim("1", "", claims.ENDLESS, ("GRU",), ("TrXL",), expects_difference=expects_difference)
    assert claims.verdict(claim, np.array(higher), np.array(lower)) == verdict


@pytest.mark.parametrize("name", claims.CLAIMS)
def test_every_claim_compares_agents_that_can_be_trained(name):
    claim = claims.CLAIMS[name]
    plans = [learning.plan(claims.Config(), claim.task, agent, 1) for agent in (*claim.higher, *claim.lower)]
    assert len({tuple(plan.logged_args().items()) for plan in plans}) == len(plans), "no two are the same"


def test_a_claim_from_training_to_its_row(tmp_path, monkeypatch, capsys):
    small = "--num-envs 2 --num-steps 32 --num-minibatches 2 --trunk-size 8 --eval-levels 2"
    agents = {name: f"{flags} {small}" for name, flags in learning.AGENTS.items()}
    monkeypatch.setattr(learning, "AGENTS", agents)
    config = claims.Config(
        claims=("normalized-gradients",), steps_scale=64 / 1e6, seeds=(1, 2), evaluations=1, folder=tmp_path / "runs"
    )
    config.results = tmp_path / "results"
    claims.main(config)
    told = capsys.readouterr().out
    assert told.count("trained GRU") == 4
    agents = (claims.NORMALIZED, claims.NOT_NORMALIZED)
    norms = {}
    for agent in agents:
        plans = [learning.plan(config, claims.ALL_IN_VIEW, agent, seed) for seed in (1, 2)]
        norms[agent] = [learning.result_of(config, plan).curves["losses/grad_norm"][1].mean() for plan in plans]
    figures = [f"{agent} {np.mean(x):.3g} ({min(x):.3g} to {max(x):.3g})" for agent, x in norms.items()]
    row = "| 7.2 | normalized advantages make gradients larger | `normalized-gradients` | gradient norm: "
    assert told.splitlines()[-1].startswith(row + "; ".join(figures))
    claims.main(config)
    assert "trained" not in capsys.readouterr().out

    claims.main(replace(config, report=True, seeds=(1, 2, 3)))
    told = capsys.readouterr().out
    assert "trained" not in told
    assert told.count(" | not tested: 2 of 6 runs are missing |") == 1


def test_the_page_has_the_rows_of_the_results_that_are_there(capsys):
    claims.main(claims.Config(report=True, results=ROOT / "benchmarks/results"))
    page = (ROOT / "docs/claims.md").read_text().splitlines()
    assert not [row for row in capsys.readouterr().out.splitlines() if row not in page]


def test_unknown_claim():
    with pytest.raises(SystemExit, match="there is no claim gru; there are memory-mortar-mayhem, "):
        claims.main(claims.Config(claims=("gru",)))
