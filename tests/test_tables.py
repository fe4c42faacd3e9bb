"""benchmarks/tables.py: what is said of agents by what they reached."""

import copy
import json
from pathlib import Path

import numpy as np
import pytest

import learning
import speedrun
import tables
from ppo_utils.run_logs import RunLog
from suites import AGENTS, COLORS, SUITES, TASKS, short

ROOT = Path(__file__).parents[1]


def run_with(*means, metric="eval/coins_collected"):
    """Return a run that has these scores on all four levels, twice each, after 100, 200 and 300 steps."""
    steps = np.array([100, 200, 300])
    scores = np.broadcast_to(np.reshape(means, (3, 1, 1)), (3, 4, 2))
    curves = {metric: (steps, scores), "charts/seconds_iteration": (steps, np.full((3, 1, 1), 60.0))}
    return RunLog("", {"total_timesteps": "300"}, curves, "a laptop")


def test_a_row_of_the_table():
    task, fallen = TASKS["Endless-SearingSpotlights-v0"], run_with(7, 3, 8)  # it fell from 7 to 3
    runs = {"GRU": [run_with(2, 9, 10), fallen], "LSTM": [fallen], "TrXL": [run_with(0, 0, 0)]}
    row = tables.row("GRU", runs, task, best=6.0)
    # The seeds' means, 10 and 8, have a standard error of 1; all levels are equal.
    assert row == "| GRU | 9.00 ± 1.00 | 9.00 | 10.00, 8.00 |  | 4.00 | 1.0 | 2.0 | 3.0 |"
    assert " | 4.00 | 2.0 |  | 3.0 |" in tables.row("GRU", runs, task, best=12.0)
    assert "| 8.00 | 8.00 | 8.00 |" in tables.row("LSTM", runs, task, best=12.0)
    assert "| 0.00 |  |  | 3.0 |" in tables.row("TrXL", runs, task, best=0.0)


def test_test_levels_that_were_trained_on_do_not_score(monkeypatch):
    task = TASKS["MysteryPath-Grid-v0"]
    new = np.array([True, False, True, False])
    monkeypatch.setattr(tables, "read_new_levels", lambda: {(task.env_id, "{}"): new})
    scores = np.arange(4.0)[None, :, None]  # of each level, its number

    def played(**changes):
        args = {"env_id": task.env_id, "env_options": "{}", "start_level": "0", "num_levels": "100000"}
        return [RunLog("", args | changes, {"test/success": ([300], scores), "eval/success": ([300], scores)})]

    assert tables.final_scores("success", played())[0, :, 0].tolist() == [0, 2]
    assert tables.final_scores("success", played(), every_level=True).shape == (1, 4, 1)
    shown = '{"show_origin": true, "show_goal": true}'
    assert tables.final_scores("success", played(env_options=shown)).shape == (1, 2, 1), "the paths are the same"
    assert tables.final_scores("success", played(start_level="7", num_levels="99993")).shape == (1, 2, 1), (
        "some of them"
    )
    for others in ({"num_levels": "0"}, {"start_level": "7"}, {"env_options": '{"max_steps": 64}'}):
        assert tables.final_scores("success", played(**others)).shape == (1, 4, 1), "not known"
    new[:] = False
    assert tables.final_scores("success", played()).shape == (1, 4, 1), "there are no others"


def test_which_test_levels_are_new():
    """As benchmarks/trained_paths.py --count prints it."""
    new = {env_id: each.sum() for (env_id, options), each in tables.read_new_levels().items() if options == "{}"}
    assert new == {
        "MortarMayhem-Grid-v0": 998,
        "MortarMayhemB-Grid-v0": 998,
        "MysteryPath-v0": 133,
        "MysteryPath-Grid-v0": 133,
    }
    assert not tables.read_new_levels()["MortarMayhem-Grid-v0", json.dumps(TASKS["mortar-mayhem"].options)].any()


def test_scores_are_those_on_test_levels_where_all_runs_have_them():
    task, runs = TASKS["Endless-SearingSpotlights-v0"], [run_with(1, 2, 3), run_with(1, 2, 5)]
    assert tables.final_scores(task.score, runs).mean() == 4
    runs[0].curves["test/coins_collected"] = [300], np.full((1, 7, 1), 2.0)
    assert tables.final_scores(task.score, runs).mean() == 4
    runs[1].curves["test/coins_collected"] = [300], np.full((1, 7, 1), 1.0)
    assert tables.final_scores(task.score, runs).shape == (2, 7, 1)
    row = tables.row("GRU", {"GRU": runs}, task, best=4.0)
    assert row == "| GRU | 1.50 ± 0.50 | 1.50 | 2.00, 1.00 |  | 0.00 | 2.0 | 3.0 | 3.0 |"
    others = [run_with(0, 0, 1), run_with(0, 0, 1.1)]
    *_, note = tables.table(task, {"GRU": runs, "LSTM": others}).splitlines()
    assert note == "On development levels, so not comparable with the others: LSTM"
    assert "On development levels" not in tables.table(task, {"LSTM": others})


def test_agents_of_finite_mortar_mayhem_are_compared_by_what_they_carried_out():
    slow, fast = (run_with(*shares, metric="eval/carried_out") for shares in ((0.25, 0.25, 0.75), (0.25, 1, 1)))
    task = TASKS["mortar-mayhem"]
    table = tables.table(task, {"slow": [slow], "fast": [fast]}).splitlines()
    assert "| slow | 0.75 | 0.75 | 0.75 |  | 0.00 | 3.0 |  | 3.0 |" in table
    assert "| fast | 1.00 | 1.00 | 1.00 |  | 0.00 | 2.0 | 2.0 | 3.0 |" in table
    assert not any("is new" in line for line in table), "development levels are not asked"
    slow.curves["test/carried_out"] = slow.curves["eval/carried_out"]
    told = "No test level is new: each begins as one of the training's, so that all count"
    assert told in tables.table(task, {"slow": [slow]}).splitlines()


def test_a_table_leaves_out_agents_without_runs_and_compares_with_the_best():
    """Of success the best is 1, whoever reaches it; of coins it is the best agent's score."""
    for name, minutes in (("Searing", "| 2.0 |  | 3.0 |"), ("Endless-Searing", "| 2.0 | 2.0 | 3.0 |")):
        task = TASKS[f"{name}Spotlights-v0"]
        ours, theirs = (run_with(0, 0.5, last, metric=f"eval/{task.score}") for last in (0.5, 0.4))
        table = tables.table(task, {"GRU": [ours], "LSTM": [], "TrXL": [theirs, theirs]})
        head, *rows, note = [line for line in table.splitlines() if line]
        assert head == f"{task.score} after 300 steps"
        assert [row.split(" | ")[0] for row in rows[2:]] == ["| GRU", "| TrXL"]
        assert minutes in rows[2]
        assert note == "Runs: 3, together 0.1 hours without evaluations. Machines: a laptop"


def test_an_overview_says_where_seeds_or_agents_are_missing():
    spotlights = run_with(0, 0, 0.25, metric="eval/success")
    commands = run_with(0, 0, 2, metric="eval/carried_out")
    slow = copy.deepcopy(spotlights)
    slow.curves["charts/seconds_iteration"][1][:] = 180
    commands.args["total_timesteps"] = "8192040"
    tasks = {
        "SearingSpotlights-v0": {"GRU": [spotlights] * 3, "LSTM": [slow]},
        "Endless-MortarMayhem-v0": {"GRU": [commands] * 2, "LSTM": []},
    }
    bounds = {"SearingSpotlights-v0": tables.Bounds(0.01, 0.9)}
    thesis = {"Endless-MortarMayhem-v0": {"GRU": "120", "TrXL": "18"}}
    assert tables.overview(tasks, bounds, thesis).splitlines() == [
        "| task, score | steps | random | GRU (3 seeds) | LSTM (1 seed) | scripted | thesis: GRU, TrXL | minutes |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
        "| SearingSpotlights-v0, success | 0.0003 M | 0.01 | 0.25 ± 0.00 | 0.25 | 0.90 |  | 3 to 9 |",
        "| Endless-MortarMayhem-v0, carried_out | 8.192 M |  | 2.00 ± 0.00, 2 seeds |  |  | 120, 18 | 3 |",
    ]
    one = {"SearingSpotlights-v0": {"GRU": [spotlights] * 3, "LSTM": []}}
    assert tables.overview(one, bounds, thesis).startswith("| task, score | steps | random | GRU | LSTM | ")


def two_tasks(gru, none):
    """Return runs of two agents, their seeds' last scores in each of two tasks, and the tasks' bounds."""
    names = ("SearingSpotlights-v0", "Endless-SearingSpotlights-v0")
    runs = {
        name: {
            agent: [run_with(0, 0, score, metric=f"eval/{TASKS[name].score}") for score in scores[i]]
            for agent, scores in (("GRU", gru), ("no memory", none))
        }
        for i, name in enumerate(names)
    }
    return runs, {names[0]: tables.Bounds(0.2, 1.0), names[1]: tables.Bounds(1.0, 9.0)}


def test_all_tasks_together():
    """Success: 0.2 is random, 1 the best; coins: 1 is random, and the best are the 5 of the GRU."""
    tasks, bounds = two_tasks(gru=((0.6, 0.6), (5, 5)), none=((0.2, 0.6), (1, 1)))
    assert tables.aggregate(tasks, bounds).splitlines() == [
        "| agent | normalized IQM | better than no memory | better than GRU |",
        "|---|---:|---:|---:|",
        "| GRU | 0.75 (0.75 to 0.75) | 0.88 (0.75 to 1.00) |  |",  # 0.5, 0.5, 1, 1; three of four pairs, all four
        "| no memory | 0.00 (0.00 to 0.25) |  | 0.12 (0.00 to 0.25) |",  # 0, 0.5, 0, 0
    ]


def test_holm_by_hand():
    """Of four at 5 %, the smallest has to be below 1.25 %, the next below 1.67 %, then 2.5 % and 5 %."""
    assert tables.holm([0.04, 0.01, 0.03, 0.016]) == [False, True, False, True]
    assert tables.holm([0.04, 0.01, 0.025, 0.016]) == [True] * 4
    assert tables.holm([0.013, 0.9, 0.9, 0.9]) == [False] * 4
    assert tables.holm([]) == []


@pytest.mark.parametrize(
    ("p_values", "differ"),
    [
        ((0.001, 0.03), "SearingSpotlights-v0, Endless-SearingSpotlights-v0"),
        ((0.03, 0.02), "SearingSpotlights-v0, Endless-SearingSpotlights-v0"),
        ((0.03, 0.04), "none"),
        ((0.06, 0.02), "Endless-SearingSpotlights-v0"),
    ],
)
def test_in_which_tasks_agents_differ_with_all_tested_at_once(monkeypatch, p_values, differ):
    """Of two p-values, the lower one has to be at most 0.025, then the other one at most 0.05."""
    tasks, _ = two_tasks(gru=((0.6, 0.6), (5, 5)), none=((0.2, 0.2), (1, 1)))
    found = iter(p_values)
    monkeypatch.setattr(tables.Comparison, "of", lambda *_: tables.Comparison(1.0, next(found)))
    assert tables.differing(tasks) == f"no memory and GRU differ, with 2 tasks tested at once (Holm, 1979), in {differ}"


def test_two_agents_have_one_line(monkeypatch):
    tasks, _ = two_tasks(gru=((0.6, 0.6), (5, 5)), none=((0.2, 0.2), (1, 1)))
    for agents in tasks.values():
        agents["16 frames"] = agents["GRU"]
    lines = tables.differing(tasks).splitlines()
    pairs = ["no memory and GRU", "16 frames and GRU", "no memory and 16 frames"]
    assert [line.partition(" differ, ")[0] for line in lines] == pairs


def test_one_task_needs_no_correction():
    tasks, _ = two_tasks(gru=((0.6, 0.6), (5, 5)), none=((0.2, 0.2), (1, 1)))
    tasks["SearingSpotlights-v0"]["no memory"] = []
    assert tables.differing(tasks) == ""


def test_seeds_are_drawn_for_each_task_by_itself():
    """Both draw the worst of three seeds alone in less than 2.5 % of resamples; with one draw for both, in more."""
    tasks, bounds = two_tasks(gru=((1, 1, 1), (5, 5, 5)), none=((0.2, 0.6, 1), (1, 3, 5)))
    *_, none = tables.aggregate(tasks, bounds).splitlines()
    assert none.startswith("| no memory | 0.50 (")
    assert "(0.00 to" not in none.split(" | ")[1]


@pytest.mark.parametrize("lacking", ["a seed", "bounds", "an agent"])
def test_tasks_that_lack_something_are_not_taken_together(lacking):
    tasks, bounds = two_tasks(gru=((0.6, 0.6), (5, 5)), none=((0.2, 0.6), (1, 1)))
    if lacking == "bounds":
        del bounds["SearingSpotlights-v0"]
    elif lacking == "an agent":
        del tasks["SearingSpotlights-v0"]["GRU"]
    else:
        tasks["SearingSpotlights-v0"]["GRU"].pop()
    assert tables.aggregate(tasks, bounds) == ""


def test_an_agent_is_ahead_if_the_difference_is_decided():
    """9.1 is above 8 by 1.9 standard errors, then by 8.5; all levels are equal."""
    task = TASKS["Endless-SearingSpotlights-v0"]
    runs = {
        "GRU": [run_with(0, 0, last) for last in (9, 9.1, 9.2)],
        "LSTM": [run_with(0, 0, last) for last in (8, 9, 7)],
    }
    gru, lstm = (line.split(" | ") for line in tables.table(task, runs).splitlines()[4:6])
    assert (gru[4], lstm[4]) == ("", "")
    runs["LSTM"] = [run_with(0, 0, last) for last in (8, 8.2, 7.8)]
    gru, lstm = (line.split(" | ") for line in tables.table(task, runs).splitlines()[4:6])
    assert (gru[4], lstm[4]) == ("LSTM", "")


def test_how_probably_a_seed_is_better():
    ours = np.array([[1.0, 2.0], [0.0, 0.0]])  # in the first task 1 of 4 pairs is won and 1 is even, then all are lost
    theirs = np.array([[2.0, 2.0], [1.0, 1.0]])
    assert tables.better(ours, theirs) == pytest.approx(0.125)
    assert tables.better(theirs, ours) == pytest.approx(0.875)


@pytest.mark.parametrize("places", [[0.5], [0.0, 0.0, 0.01], [1.0, 0.99, 0.2, 1.2], [0.3, 0.1, 0.31, 0.1], []])
def test_names_are_apart_and_in_order(places):
    found = tables.spread(places, 0.1)
    assert np.diff(np.sort(found)).min(initial=0.1) >= 0.1 - 1e-9
    assert np.argsort(found, kind="stable").tolist() == np.argsort(places, kind="stable").tolist()
    assert max(found, default=0) <= 1
    assert tables.spread([0.1, 0.5, 0.9], 0.1) == [0.1, 0.5, 0.9], "nothing is in the way"


def test_a_picture(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(tables.Figure, "savefig", lambda figure, *args, **flags: drawn.append(figure))
    tasks, _ = two_tasks(gru=((0.6, 0.8), (5, 7)), none=((0.2, 0.6), (1, 1)))
    tables.draw(tasks, tmp_path / "new/curves.png")
    finite, endless = drawn[0].axes
    assert (finite.get_ylim(), endless.get_ylim()) == ((0, 1), (0, 7)), "the best possible, and mean and error of 5, 7"
    assert [text.get_text() for text in finite.texts] == ["GRU", "no memory"]
    gru, none = finite.lines
    assert (gru.get_color(), none.get_color()) == (COLORS["GRU"], COLORS["no memory"])
    assert gru.get_ydata() == pytest.approx([0, 0, 0.7])


def test_agents_that_are_drawn_have_colors():
    assert {short(agent) for _, agents in SUITES.values() for agent in agents} <= set(COLORS) <= set(AGENTS)


def test_bounds_are_those_of_the_ten_tasks():
    bounds = tables.read_bounds()
    assert set(SUITES["full"][0]) <= set(bounds)
    for name, each in bounds.items():
        assert 0 <= each.random < each.scripted
        if TASKS[name].best_score:
            assert each.scripted <= TASKS[name].best_score


def test_what_the_thesis_reports_is_of_the_ten_tasks():
    assert set(tables.read_thesis()) <= set(SUITES["full"][0])
    assert [tables.read_thesis()["MortarMayhem-v0"][agent] for agent in ("GRU", "TrXL")] == ["0.6", "> 0.6"]


def test_the_axis_of_a_single_seed(tmp_path, monkeypatch):
    """It has no standard error: the axis ends at its highest mean."""
    drawn = []
    monkeypatch.setattr(tables.Figure, "savefig", lambda figure, *args, **flags: drawn.append(figure))
    tasks, _ = two_tasks(gru=((0.6,), (7,)), none=((0.2,), (1,)))
    tables.draw(tasks, tmp_path / "curves.png")
    assert [axis.get_ylim() for axis in drawn[0].axes] == [(0, 1), (0, 7)]


ENTRY = 'task,target,agent,steps,date,commit\nSearingSpotlights-v0,0.9,"GRU",6e6,2026-11-29,abc1234\n'


@pytest.fixture
def entry(tmp_path, monkeypatch):
    """Return a function that makes an entry's row, from the mean score of each seed; further lines may follow it."""

    def row(*means, lines=""):
        runs = [run_with(0, 0, mean, metric="test/success") for mean in means]
        results = {"SearingSpotlights-v0": {"GRU": runs}}
        monkeypatch.setattr(learning, "results_of", lambda config, plans: results)
        (tmp_path / "speedrun.csv").write_text(ENTRY + lines)
        monkeypatch.setattr(speedrun, "ENTRIES", tmp_path / "speedrun.csv")
        speedrun.main()

    return row


def test_an_entry_has_its_score(entry, capsys):
    entry(0.95, 0.94, 0.96, 0.95, 0.95)
    row = "| SearingSpotlights-v0 | 0.9 | `GRU` | 0.95 ± 0.00 | 0.0001 | 6 M | 2026-11-29, abc1234 |"
    assert capsys.readouterr().out.splitlines()[-1] == row


@pytest.mark.filterwarnings("ignore:Precision loss")  # five equal scores
@pytest.mark.parametrize(
    ("means", "message"),
    [
        ((), "has 0 of 5 seeds of GRU in SearingSpotlights-v0, 6,000,000 steps"),
        ((0.95, 0.95, 0.95, 0.95), "has 4 of 5 seeds of GRU in SearingSpotlights-v0"),
        ((0.99, 0.99, 0.99, 0.85, 0.89), r"GRU in SearingSpotlights-v0 is not above 0.9: p = 0.1"),
        ((0.9,) * 5, r"is not above 0.9: p = nan"),
    ],
)
def test_what_is_no_entry(entry, means, message):
    with pytest.raises(SystemExit, match=message):
        entry(*means)


@pytest.mark.parametrize(
    ("task", "target", "agent", "broken"),
    [
        ("SearingSpotlights-v0", 0.9, "GRU", []),
        ("SearingSpotlights-v0", 0.8, "GRU", ["aimed at 0.9 of the best score"]),
        ("Endless-MysteryPath-v0", 0.9, "GRU", ["aimed at 0.9 of the best score"]),
        ("mortar-mayhem", 0.9, "GRU", ["on default options"]),
        ("SearingSpotlights-v0", 0.9, "GRU --step-encoding", ["from vectors of what the image shows"]),
        ("SearingSpotlights-v0", 0.9, "GRU --observe-last-action", ["from vectors of what the image shows"]),
        ("SearingSpotlights-v0", 0.9, "GRU --obs-type pixels", ["from vectors of what the image shows"]),
        ("SearingSpotlights-v0", 0.9, "GRU --load-model model.pt", ["trained from the first step on"]),
        ("SearingSpotlights-v0", 0.9, "GRU --num-levels 0", ["on the default levels"]),
    ],
)
def test_rules_of_an_entry(task, target, agent, broken):
    run = run_with(0, 0, 0.95, metric=f"test/{TASKS[task].score}")
    entry = speedrun.Entry(task, target, agent, 1_000_000, "", "")
    assert [rule for rule, holds in speedrun.rules_of(entry, [run]).items() if not holds] == broken


def test_an_entry_is_scored_on_test_levels():
    run = run_with(0, 0, 0.95, metric="eval/success")
    rules = speedrun.rules_of(speedrun.Entry("SearingSpotlights-v0", 0.9, "GRU", 1_000_000, "", ""), [run])
    assert [rule for rule, holds in rules.items() if not holds] == ["scored on test levels"]


@pytest.mark.parametrize("steps", ["6e6", "7e6"])
def test_a_later_entry_needs_fewer_steps(entry, steps):
    """Of one task."""
    lines = f"MortarMayhem-Grid-v0,0.9,GRU,3e6,,\nSearingSpotlights-v0,0.9,TrXL+,{steps},,\n"
    with pytest.raises(SystemExit, match=r"TrXL\+ in SearingSpotlights-v0 has .,000,000 steps; .* than 6,000,000"):
        entry(lines=lines)


def test_a_mean_above_the_target():
    """Here by 5 standard errors, 0.02 / sqrt(4) each: with three degrees of freedom, p is 0.0077."""
    means = 0.95 + 0.02 * np.sqrt(0.75) * np.array([1, 1, -1, -1])
    assert speedrun.probability(means, 0.9) == pytest.approx(0.0077, abs=5e-5)
    assert speedrun.probability(means, 1.0) == pytest.approx(1 - 0.0077, abs=5e-5)
