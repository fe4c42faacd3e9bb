"""benchmarks/claims.py: its verdicts, and one claim from its trainings to its row."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.stats
from tqdm import tqdm

import claims
import learning
import ppo_gru
import suites
import tables
from ppo_utils.run_logs import RunLog

ROOT = Path(__file__).parents[1]


def pair(errors, p_value=0.01):
    return tables.Comparison(errors, p_value, (errors - 2, errors + 2))


@pytest.mark.parametrize(
    ("pairs", "expects_difference", "text", "p_value"),
    [
        ([pair(2.0)], True, "holds", 0.01),
        ([pair(-2.0)], True, "does not hold", 0.01),
        ([pair(3, 0.01), pair(4, 0.002)], True, "holds", 0.01),  # all of them are needed
        ([pair(3), pair(1.9, 0.06)], True, "not decided", 1.0),
        ([pair(3), pair(-2.5, 0.02), pair(-3, 0.01)], True, "does not hold", 0.03),  # one of three is enough
        ([pair(3), pair(-2.1, 0.04)], True, "not decided", 1.0),  # one of two is that low in 8 % of all cases
        ([pair(2.0, 0.06)], True, "not decided", 1.0),
        ([pair(-3), pair(2.1, 0.02)], False, "does not hold", 0.04),
        ([pair(-3), pair(2.1, 0.04)], False, "not decided", 1.0),
        ([pair(3, 0.06)], False, "not decided", 1.0),
    ],
)
def test_verdicts(pairs, expects_difference, text, p_value):
    lower = ("TrXL", "no memory", "16 frames")[: len(pairs)]
    claim = claims.Claim("small-endless", ("GRU",), lower, expects_difference=expects_difference)
    found = claims.verdict(claim, pairs)
    assert (found.text, found.p_value) == (text, pytest.approx(p_value))


def test_a_row_that_is_not_decided_has_the_intervals_of_what_is_open():
    """Of all pairs where no difference is expected; none where a multiple is compared, or of one seed."""
    claim = claims.Claim("small-endless", ("GRU", "TrXL+ --trxl-gate gru", "LSTM"), ("no memory", "16 frames"))
    pairs = [pair(3), pair(1.9, 0.06), pair(-2.1, 0.04), pair(1, 0.2), pair(3), pair(3)]
    found = "not decided; GRU - 16 frames: [-0.1, 3.9]; TrXL+, gate gru - no memory: [-4.1, -0.1]; "
    assert str(claims.verdict(claim, pairs)) == f"{found}TrXL+, gate gru - 16 frames: [-1, 3]"
    none = replace(claim, higher=("GRU",), expects_difference=False)
    found = "not decided; GRU - no memory: [1, 5]; GRU - 16 frames: [1, 5]"
    assert str(claims.verdict(none, [pair(3, 0.04)] * 2)) == found
    single = replace(claim, higher=("GRU",), lower=("LSTM",))
    assert str(claims.verdict(single, [pair(1.9, 0.06)])) == "not decided; A - B: [-0.1, 3.9]"
    assert str(claims.verdict(replace(single, times=12), [pair(1.9, 0.06)])) == "not decided"
    assert str(claims.verdict(single, [tables.Comparison(0.0, 1.0)])) == "not decided", "of one seed"


def test_a_comparison_by_hand():
    """Seeds' means 2 and 4, and 1 and 1: variances 2 and 0. The levels' differences 1 and 3 have one of 2."""
    higher, lower = np.array([[1.0, 3.0], [3.0, 5.0]]), np.array([[1.0, 1.0], [1.0, 1.0]])
    found = tables.Comparison.of(higher, lower)
    assert found.errors == pytest.approx(2 / np.sqrt(2 / 2 + 0 + 2 / 2))
    assert found.p_value == pytest.approx(2 * scipy.stats.t.sf(np.sqrt(2), 2))
    assert found.interval == pytest.approx((2 - 4.302653 * np.sqrt(2), 2 + 4.302653 * np.sqrt(2)))  # of Student's table
    assert tables.Comparison.of(lower, higher).errors == -found.errors
    assert tables.Comparison.of(lower, lower).errors == 0
    assert tables.Comparison.of(np.array([[3.0], [5.0]]), np.array([[1.0], [1.0]])).errors == pytest.approx(3.0)
    assert tables.Comparison.of(lower + 1, lower).interval == (1.0, 1.0)
    assert tables.Comparison.of(lower[:1], lower).interval is None
    assert tables.Comparison.of(higher[:1], lower) == tables.Comparison(0.0, 1.0), "one seed tells nothing"


def test_degrees_of_freedom_are_at_most_those_of_the_seeds():
    """Levels' differences are 0, 1, 0, 1, ..., and all seeds equal: a variance of 1 / 3.96 a level, of 100 levels."""
    levels = np.tile([0.0, 1.0], 50)
    found = tables.Comparison.of(np.tile(levels, (3, 1)), np.zeros((3, 100)))
    errors = 0.5 / np.sqrt(levels.var(ddof=1) / 100)
    assert found.errors == pytest.approx(errors)
    assert found.p_value == pytest.approx(2 * scipy.stats.t.sf(errors, 4))


@pytest.mark.parametrize(
    ("seeds", "level", "both"), [((1, 1), 1, 0.1), ((1, 0.05), 0.5, 0.1), ((0.1, 0.1), 0.5, 1), ((0.02, 0.02), 1, 0.3)]
)
def test_a_comparison_is_no_more_often_wrong_than_it_says(seeds, level, both):
    """Of two equal agents, three seeds each, on levels that are harder for both, whatever differs most."""
    rng = np.random.default_rng(0)
    p_values = []
    for _ in range(1000):
        agents = rng.normal(0, np.reshape(seeds, (2, 1, 1)), (2, 3, 1)) + rng.normal(0, both, (2, 3, 50))
        p_values.append(tables.Comparison.of(*(agents + rng.normal(0, level, 50))).p_value)
    assert 0.02 < np.mean(np.array(p_values) < 0.1) < 0.12
    assert np.mean(np.array(p_values) < 0.01) < 0.02


def test_degrees_of_freedom_of_the_levels():
    """Equal seeds, two levels, whose differences 1 and 3 have a variance of 2: one degree, as of two numbers."""
    found = tables.Comparison.of(np.tile([1.0, 3.0], (3, 1)), np.zeros((3, 2)))
    assert found.errors == pytest.approx(2.0)
    assert found.p_value == pytest.approx(2 * scipy.stats.t.sf(2.0, 1))


def test_where_nobody_is_above_an_agent_without_memory_nothing_was_learned():
    def runs(*means):
        steps = np.array([100])
        curves = [{"eval/carried_out": (steps, np.full((1, 4, 1), mean))} for mean in means]
        return [RunLog("", {}, each) for each in curves]

    claim = claims.CLAIMS["below-gru"]
    low, high = runs(1.0, 1.1, 0.9), runs(2.0, 2.1, 1.9)
    assert claims.is_learned(claim, {"GRU": low, "TrXL": high}, low)
    assert not claims.is_learned(claim, {"GRU": low, "TrXL": low}, low)
    assert not claims.is_learned(claim, {"GRU": low, "TrXL": low}, low[:2]), "two without memory are enough"
    assert not claims.is_learned(claim, {"no memory": high, "TrXL": low}, high)
    assert claims.is_learned(claim, {"GRU": low, "TrXL": low}, []), "not known"
    assert claims.is_learned(claim, {"GRU": low[:1], "TrXL": low[:1]}, low[:1]), "nor with one seed"


@pytest.mark.parametrize(
    ("name", "least"),
    [
        ("samples-MortarMayhem-Grid-v0", 0.25),
        ("score-Endless-MortarMayhem-v0", 4.5),  # of 18
        ("same-score-Endless-MortarMayhem-v0-20M", 4.5),
        ("score-Endless-MysteryPath-v0", 0.505),  # of 2.02
    ],
)
def test_a_task_of_which_little_was_learned(name, least):
    claim = claims.CLAIMS[name]

    def runs(mean):
        curve = np.array([100]), np.full((1, 4, 1), mean)
        return [RunLog("", {}, {f"eval/{claims.TASKS[claim.task].score}": curve})] * 2

    assert claims.is_learned(claim, {"GRU": runs(least + 0.01), "TrXL": runs(0.1)}, [])
    assert not claims.is_learned(claim, {"GRU": runs(least - 0.01), "TrXL": runs(0.1)}, [])


def test_falls_are_compared_of_agents_that_have_learned_the_task():
    """Both, not one of them."""
    claim = claims.CLAIMS["falls-MysteryPath-Grid-v0"]

    def runs(mean):
        return [RunLog("", {}, {"eval/success": (np.array([100]), np.full((1, 4, 1), mean))})] * 2

    assert claims.is_learned(claim, {"GRU": runs(0.91), "TrXL+": runs(0.95)}, [])
    assert not claims.is_learned(claim, {"GRU": runs(0.89), "TrXL+": runs(0.95)}, [])


def test_verdicts_say_how_likely_they_come_by_chance():
    assert str(claims.Verdict("holds", 0.0274)) == "holds, p = 0.027"
    assert str(claims.Verdict("holds", 0.0004)) == "holds, p < 0.001"
    assert str(claims.Verdict("not decided")) == "not decided"


def test_agents_of_a_comparison_of_equals_have_equal_settings():
    """Of those that the preset sets apart, and of those that Mystery Path has for the GRU."""
    names = ("init_lr", "gamma", "vf_coef", "clip_coef", "norm_reward", "exploration_bonus", "init_ent_coef")
    same = [claim for name, claim in claims.CLAIMS.items() if name.startswith("same-")]
    assert len(same) == 15
    for claim in same:
        plans = [claim.plans(claims.Config(seeds=(1,)), agent)[0] for agent in claim.agents]
        assert plans[0].args.__class__ is not plans[1].args.__class__
        assert len({tuple(getattr(plan.args, name) for name in names) for plan in plans}) == 1, claim


def test_test_levels_decide():
    """Of the same agents, on development levels nothing is decided."""
    steps = np.array([100])

    def runs(test):
        levels = {"eval": np.full((1, 4, 1), 6.0), "test": np.full((1, 9, 1), test)}
        return [RunLog("", {}, {f"{name}/carried_out": (steps, each) for name, each in levels.items()})] * 2

    claim = claims.CLAIMS["score-Endless-MortarMayhem-v0"]
    assert claims.judge(claim, {"GRU": runs(7.0), "TrXL+": runs(6.0)}, []).text == "holds"
    assert claims.judge(claim, {"GRU": runs(6.0), "TrXL+": runs(6.0)}, []).text == "not decided"


def test_so_many_times_as_high():
    """Twelve times as high as the other, not eleven, without noise."""
    claim = claims.CLAIMS["normalized-gradients"]

    def runs(norm):
        curves = {"losses/grad_norm": (np.array([100]), np.full((1, 1, 1), norm))}
        return RunLog("", {}, curves | {"eval/success": (np.array([100]), np.full((1, 4, 1), 1.0))})

    for factor, text in ((11, "does not hold"), (13, "holds")):
        found = {
            agent: [runs(norm), runs(1.01 * norm)] for agent, norm in zip(claim.agents, (factor, 1.0), strict=True)
        }
        assert claims.judge(claim, found, []).text == text


def test_short_names():
    assert claims.short("GTrXL+") == "GTrXL+"
    assert claims.short("TrXL") == "TrXL"
    assert claims.short(f"{claims.QUERY_POSITION} --trxl-dim 192") == "query position, dim 192"
    assert claims.short(claims.NORMALIZED) == "GRU, norm adv minibatch"


def test_agents_have_their_claims_flags():
    def agents(claim):
        return [claim.plans(claims.Config(seeds=(1,)), agent)[0].agent for agent in claim.agents]

    assert agents(claims.CLAIMS["query-position"]) == ["TrXL --trxl-query-position", "TrXL"]
    assert agents(claims.CLAIMS["normalized-gradients"]) == [
        "GRU --norm-adv minibatch --target-kl None",
        "GRU --target-kl None",
    ]


def test_a_claim_from_training_to_its_row(tmp_path, monkeypatch, capsys):
    small = "--num-envs 2 --num-steps 32 --num-minibatches 2 --trunk-size 8 --eval-levels 2"
    agents = {name: f"{flags} {small}" for name, flags in suites.AGENTS.items()}
    monkeypatch.setattr(learning, "AGENTS", agents)
    config = claims.Config(
        claims=("normalized-gradients",), steps=64, seeds=(1, 2), jobs=1, evaluations=1, folder=tmp_path / "learning"
    )
    config.results = tmp_path / "results"

    def train(config, plan):  # in this process
        monkeypatch.chdir(config.folder)
        ppo_gru.main(plan.args)
        tqdm.write(f"trained {plan}")

    monkeypatch.setattr(learning, "train", train)
    tested = np.ones((1, 2, 1))
    monkeypatch.setattr(
        learning, "test_scores", lambda config, plan, run: {f"test/{plan.task.score}": ([run.last_step], tested)}
    )
    claims.main(config)
    told = capsys.readouterr().out
    assert told.count("trained GRU") == 4
    cells = []
    for agent in ("GRU", claims.NORMALIZED):
        runs = [learning.result_of(config, each) for each in claims.CLAIMS["normalized-gradients"].plans(config, agent)]
        norms = [run.curves["losses/grad_norm"][1].mean() for run in runs]
        cells.append(tables.mean_and_error(np.reshape(norms, (2, 1, 1))).replace(" ", ""))
    (row,) = (line for line in told.splitlines() if line.endswith(" | `normalized-gradients` (`--target-kl None`) |"))
    start = "| 7.2 Normalized advantages make gradients over 12 times larger | 0.38, 0.02"
    assert row.startswith(f"{start} | GRU, norm adv minibatch: {cells[1]} | GRU: {cells[0]} | ")
    assert "Of 1 rows tested, " in told
    claims.main(config)
    assert "trained" not in capsys.readouterr().out

    claims.main(replace(config, report=True, seeds=(1, 2, 3)))
    told = capsys.readouterr().out
    assert "trained" not in told
    assert f"\n| not tested | thesis | `--claims` |\n|---|---|---|\n{start} | `normalized-gradients` |\n" in told
    assert " 1 more were not tested. " in told.splitlines()[1]


def test_unknown_claim():
    with pytest.raises(SystemExit, match="there is no claim gru; there are memory-MortarMayhem-Grid-v0, "):
        claims.main(claims.Config(claims=("gru",)))


@pytest.mark.parametrize(
    ("claim", "seeds", "counts"),
    [
        ("below-gru", (1, 2, 3), "0 are not decided, 1 not learned. 0 more were not tested."),
        ("below-gru", (1, 2), "0 are not decided, 0 not learned. 1 more were not tested."),
        ("below-gru", (3, 4, 5), "0 are not decided, 1 not learned. 0 more were not tested."),
        ("memory-flat-list", (1, 2, 3), "0 are not decided, 1 not learned. 0 more were not tested."),
        ("normalized-no-memory", (), "1 are not decided, 0 not learned. 0 more were not tested."),
    ],
)
def test_what_is_learned_is_judged_by_all_runs_without_memory(monkeypatch, capsys, claim, seeds, counts):
    """They have the claim's flags, and score higher than all agents; not where a task needs no memory.

    Three of five seeds are enough.
    """

    def result_of(config, plan):
        without = plan.agent == f"no memory {claims.CLAIMS[claim].flags}".strip()
        curve = np.array([100]), np.full((1, 4, 1), 1.0 + 0.1 * plan.seed + without)
        curves = dict.fromkeys(("eval/carried_out", "eval/success", "losses/grad_norm"), curve)
        return RunLog("", plan.logged_args(), curves) if not without or plan.seed in seeds else None

    monkeypatch.setattr(learning, "result_of", result_of)
    claims.main(claims.Config(claims=(claim,), report=True, seeds=(1, 2, 3, 4, 5) if 5 in seeds else (1, 2, 3)))
    assert f" hold and 0 do not (0 of these 0 with a star), {counts}" in capsys.readouterr().out


def test_a_statement_stands_once_above_its_claims():
    """What is said of the first task is said of those that follow; each claim has one statement."""
    names = [name for statement in claims.STATEMENTS for name in statement.claims]
    assert len(set(names)) == len(names) == len(claims.CLAIMS)
    assert all(re.match(r"[67](\.\d)+ [A-Z1]", statement.text) for statement in claims.STATEMENTS)


def test_rows_of_one_statement(monkeypatch, capsys):
    curve = np.array([100]), np.full((1, 4, 1), 0.5)
    run = RunLog("", {"total_timesteps": 3e6}, {"eval/success": curve, "eval/num_fails": curve})
    monkeypatch.setattr(learning, "result_of", lambda config, plan: run)
    names = [f"falls-{task}" for task in ("MysteryPath-Grid-v0", "MysteryPath-v0")]
    claims.main(claims.Config(claims=tuple(names), report=True))
    cells = "GRU: 0.50±0.00 | TrXL+: 0.50±0.00 | 3 | not learned"
    assert capsys.readouterr().out.splitlines()[5:7] == [
        f"| 6.5.2 GRU falls off more often in Mystery Path | 5.65, 4.87 times | {cells} | `{names[0]}` |",
        f"|  |  | {cells} | `{names[1]}` |",
    ]


def test_in_how_many_rows_statements_hold(monkeypatch, capsys):
    """Of two rows of each of four statements."""
    curve = np.array([100]), np.full((1, 4, 1), 0.5)
    scores = {f"eval/{name}": curve for name in ("success", "carried_out", "num_fails", "return")}
    run = RunLog("", {"total_timesteps": 3e6}, scores | {"losses/grad_norm": curve})
    monkeypatch.setattr(learning, "result_of", lambda config, plan: run)
    verdicts = {
        "memory-MortarMayhem-Grid-v0": claims.Verdict("holds", 1e-5),
        "memory-MortarMayhem-v0": claims.Verdict("holds", 0.04),
        "memory-MysteryPath-Grid-v0": claims.Verdict("holds", 0.04),
        "memory-MysteryPath-v0": claims.Verdict("does not hold", 0.04),
        "memory-MortarMayhemB-Grid-v0": claims.Verdict("not decided"),
        "memory-flat-list": claims.Verdict("does not hold", 1e-4),
        "falls-MysteryPath-Grid-v0": claims.Verdict("not decided"),
        "falls-MysteryPath-v0": claims.Verdict("not learned"),
    }
    found = {id(claims.CLAIMS[name]): verdict for name, verdict in verdicts.items()}
    monkeypatch.setattr(claims, "judge", lambda claim, *_: found[id(claim)])
    claims.main(claims.Config(claims=tuple(verdicts), report=True))
    assert capsys.readouterr().out.splitlines()[:2] == [
        "Of 4 statements tested, 1 hold in all rows and 1 in some (1 of which do not hold in others); of the "
        "others, 1 do not hold, 1 are not decided or not learned.",
        "Of 8 rows tested, 3 hold and 2 do not (2 of these 5 with a star), 2 are not decided, 1 not learned. 0 more "
        "were not tested. If no agents differed, 0.4 of those tested would be decided on average, at most: any "
        "without a star may be one of them.",
    ]


@pytest.mark.parametrize(
    ("text", "rows", "expected"), [("not decided", 20, 1.0), ("not decided", 30, 1.5), ("not learned", 30, 0.0)]
)
def test_how_many_rows_would_be_decided_by_chance(monkeypatch, capsys, text, rows, expected):
    """A twentieth of those that were learned; not of one about how many times as high a number is."""
    curve = np.array([100]), np.full((1, 4, 1), 0.5)
    scores = {f"eval/{name}": curve for name in ("success", "carried_out", "num_fails", "return", "length")}
    scores |= {"eval/coins_collected": curve, "losses/grad_norm": curve}
    run = RunLog("", {"total_timesteps": 3e6}, scores)
    monkeypatch.setattr(learning, "result_of", lambda config, plan: run)
    monkeypatch.setattr(claims, "judge", lambda *_: claims.Verdict(text))
    names = [name for name, claim in claims.CLAIMS.items() if claim.times == 1][:rows]
    claims.main(claims.Config(claims=(*names, "normalized-gradients"), report=True))
    assert f" If no agents differed, {expected} of those tested " in capsys.readouterr().out


def test_statements_without_runs_have_a_row(monkeypatch, capsys):
    monkeypatch.setattr(learning, "result_of", lambda config, plan: None)
    claims.main(claims.Config(report=True))
    statements, rows_tested, _, head, _, *rows = capsys.readouterr().out.splitlines()
    assert head == "| not tested | thesis | `--claims` |"
    assert len(rows) == len(claims.STATEMENTS)
    assert statements.startswith("Of 0 statements tested, 0 hold in all rows and 0 in some (0 of which ")
    assert rows[0].endswith("|  | `memory-MortarMayhem-Grid-v0`, `memory-MortarMayhem-v0` |")
    assert rows[-1].startswith("| 7.4.1 Vectors usually take less time ")
    count = len(claims.CLAIMS) + sum(not statement.claims for statement in claims.STATEMENTS)
    assert f" {count} more were not tested. " in rows_tested
