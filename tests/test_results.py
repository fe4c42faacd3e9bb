"""What the pages say of the results in the repository is what the commands beside it print."""

import gc
import re
import shlex
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
import tyro
from matplotlib.axes import Axes
from PIL import Image

import claims
import frontier
import learning
import ppo_gru
import ppo_trxl
import seeds
import speedrun
import suites
import tables
import trained_paths
import trials
from memory_gym_envs.players import player
from ppo_utils import environments, evaluation, runs
from ppo_utils.flags import check_args

ROOT = Path(__file__).parents[1]


@pytest.fixture(autouse=True, scope="module")
def no_garbage():
    """Of the million numbers of the results, which are kept once they were read, none is garbage."""
    gc.disable()
    yield
    gc.enable()


def test_every_number_of_the_results_is_printed_by_the_commands_beside_it(tmp_path, monkeypatch, capsys):
    """All tables by those of their section, all scores with a decimal point by any."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(tables, "draw", lambda *args: None)
    page = Path("docs/results.md").read_text()
    fence = re.compile(r"^```\n(.*?)^```\n", re.MULTILINE | re.DOTALL)
    printed, rows = "", 0
    for section in re.split("^##+ ", page, flags=re.MULTILINE):
        if "python benchmarks/attention.py" in section:
            continue  # tests/test_attention.py: not the same to the last digit on other machines
        for line in "".join(fence.findall(section.replace("\\\n", " "))).splitlines():
            if line.startswith("python benchmarks/learning.py"):
                config = tyro.cli(learning.Config, args=shlex.split(line)[2:])
                learning.main(replace(config, report=True, out=tmp_path / "curves.png"))
        if "python benchmarks/seeds.py" in section:
            seeds.main(tmp_path)
        if "python benchmarks/speedrun.py" in section:
            speedrun.main()
        if "python benchmarks/trained_paths.py" in section:
            trained_paths.main(trained_paths.Config(out=tmp_path / "paths.png"))
        here = capsys.readouterr().out
        lines = [line for line in section.splitlines() if line.startswith("|")]
        assert [line for line in lines if line not in here.splitlines()] == []
        printed, rows = printed + here, rows + len(lines)
    assert rows > 30
    text = re.sub("`--[^`]*`", "", fence.sub("", page)).replace("p < 0.05", "")  # without the values of flags
    numbers = set(re.findall(r"(?<![\d.])\d+\.\d+(?![\d.])", text))
    assert numbers <= set(re.findall(r"\d+\.\d+", printed))
    scores = re.findall(r"\d+\.\d+ ± \d+\.\d+", (ROOT / "README.md").read_text())
    assert len(scores) > 10
    assert [score for score in scores if score not in printed] == []
    made, shown = (Image.open(each).size for each in (tmp_path / "paths.png", "docs/trained_paths.png"))
    assert made == shown


def test_the_page_s_numbers_of_parameters():
    counts = []
    for script in (ppo_trxl, ppo_gru):
        args = replace(script.Args(**script.PRESETS["laptop"]), env_id="MortarMayhem-Grid-v0")
        check_args(args)
        envs = environments.envs_for(args, 1)
        agent = evaluation.make_agent(script.Agent, envs, envs.reset()[1], args)
        counts.append(sum(parameter.numel() for parameter in agent.parameters()))
    told = "TrXL+ has one block and {:,} parameters in Mortar Mayhem Grid, the GRU {:,}.".format(*counts)
    assert told in (ROOT / "docs/results.md").read_text()


def test_every_seed_is_a_dot(monkeypatch, tmp_path):
    dots = []
    monkeypatch.setattr(Axes, "plot", lambda self, x, y, style="", **_: dots.append((x, y)) if style == "o" else None)
    seeds.main(tmp_path)
    drawn = [list(zip(x, y, strict=True)) for x, y in dots]
    assert len(drawn) == 100
    assert {len(each) for each in drawn[::2]} == {0, 3}, "some agents are not trained in all tasks"
    assert {len(each) for each in drawn[1::2]} == {0, 2}, "seeds 4 and 5, of some agents"
    assert max(y for _, y in drawn[18]) == pytest.approx(1, abs=0.02), "TrXL+ in Mortar Mayhem Grid"
    for name in ("seeds.png", "endless.png", "commands.png"):
        made, shown = (Image.open(folder / name).size for folder in (tmp_path, ROOT / "docs"))
        assert made == shown


def test_how_many_commands_a_window_of_256_steps_is_enough_for():
    """As docs/memory.md says: the tenth is due at step 250, the eleventh, the first of round 5, at step 278."""
    envs = gym.make_vec("Endless-MortarMayhem-v0", num_envs=2)
    envs.reset(seed=1)
    due = [step for step in range(1, 280) if envs.step(player(envs))[1].all()]
    assert (len(due), *due[-2:]) == (seeds.IN_WINDOW + 1, 250, 278)


def test_how_often_a_test_level_s_path_was_trained_on(tiny):
    """In both tasks, which have the same paths."""
    envs = gym.make_vec("MysteryPath-Grid-v0", num_envs=1000)

    def paths(first):
        envs.reset(seed=first)
        s = envs.unwrapped.state
        return [tuple(cells[1 : 1 + length]) for cells, length in zip(s.path_cell, s.path_length, strict=True)]

    trained_on = paths(0) + paths(1000)
    wanted = [trained_on.count(path) for path in paths(learning.FIRST_TEST_LEVEL)]
    assert len(set(wanted)) > 5
    for env_id in trained_paths.PATH_TASKS:
        times = trained_paths.times_trained_on(tiny(env_id=env_id, num_levels=2000), 1000)
        assert times.tolist() == wanted


def test_every_number_of_the_page_of_tuning_is_printed(tmp_path, monkeypatch, capsys):
    """By its own programs, or by those of the page of results."""
    monkeypatch.setattr(frontier, "draw", lambda *_: None)
    trials.main(trials.Config())
    frontier.main()
    printed = capsys.readouterr().out + (ROOT / "docs/results.md").read_text()
    page = re.sub(r"`[^`]*`", "", (ROOT / "docs/tuning.md").read_text())
    numbers = set(re.findall(r"(?<![\d.])\d+\.\d+(?![\d.])", page))
    assert len(numbers) > 50
    assert numbers <= set(re.findall(r"\d+\.\d+", printed))


def test_the_table_of_fewest_steps_is_printed_by_its_command(capsys):
    speedrun.main()
    assert capsys.readouterr().out in (ROOT / "docs/results.md").read_text()


def test_in_which_tasks_gru_and_transformer_differ():
    """As the page says: in all but two; the seeds that chose nothing have the same one higher, and decide one task."""
    held_out = suites.SEEDS[len(suites.CHOOSING_SEEDS) :]
    every, alone = (
        learning.stored_results(suite="full", agents=("GRU", "TrXL+"), seeds=each) for each in (suites.SEEDS, held_out)
    )
    others = {*suites.FULL} - {*tables.differing(every).partition(" in ")[2].split(", ")}
    assert others == {"MysteryPath-v0", "SearingSpotlights-v0"}
    assert tables.differing(alone).partition(" in ")[2] == "MysteryPath-Grid-v0"
    trained = [task for task in every.keys() - others if all(alone[task].values())]
    assert len(trained) == 7, "not in Mortar Mayhem with free movement"
    assert all(difference(task, alone[task]) * difference(task, every[task]) > 0 for task in trained)
    page = " ".join((ROOT / "docs/results.md").read_text().split())
    assert "differ in all but Mystery Path and Searing Spotlights" in page
    assert "alone decide only Mystery Path Grid" in page


def difference(task, agents):
    """By how much the transformer's mean score is higher than the GRU's."""
    gru, trxl = (tables.final_scores(suites.TASKS[task].score, agents[each]).mean() for each in ("GRU", "TrXL+"))
    return trxl - gru


def test_trials_are_printed_and_added(tiny, tmp_path, monkeypatch, capsys):
    """Scores between evaluations are interpolated; columns that not all seeds came to are empty."""
    trials.main(trials.Config())
    assert capsys.readouterr().out in (ROOT / "docs/tuning.md").read_text()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(trials, "TRIALS", tmp_path / "trials.csv")
    monkeypatch.setattr(trials, "COLUMNS", {"MysteryPath-Grid-v0": ((6.4e-5, 1e-4, 1.28e-4, 2e-4), ())})
    trials.TRIALS.write_text("task,agent,seed,step,score\nMysteryPath-Grid-v0,other,1,100,0.5\n")
    means = (0.25, 0.75, 0.5, 1.0, 0.0, 0.0)
    scores = [dict.fromkeys(("success", "return"), np.full((2, 1), mean)) for mean in means]
    monkeypatch.setattr(runs, "level_scores", lambda *_: {k: torch.tensor(v) for k, v in scores.pop(0).items()})
    args = {"env_id": "MysteryPath-Grid-v0", "obs_type": "vector", "eval_interval": 1}
    for seed in (1, 2):
        trials.main(trials.Config(add=("new", ppo_gru.main(tiny(seed=seed, **args)))))
    with pytest.raises(SystemExit, match="there is a trial of new in MysteryPath-Grid-v0 with seed 2 already"):
        trials.main(trials.Config(add=("new", next((tmp_path / "runs").glob("*__2__*")))))
    with pytest.raises(SystemExit, match="has no evaluations; train with --eval-interval"):
        trials.main(trials.Config(add=("new", ppo_gru.main(tiny(seed=3, env_id="MysteryPath-Grid-v0")))))
    with pytest.raises(SystemExit, match="the tables have MysteryPath-Grid-v0, not MysteryPath-v0"):
        trials.main(trials.Config(add=("new", ppo_gru.main(tiny(env_id="MysteryPath-v0")))))
    other = {**args, "env_options": '{"show_goal": true}'}
    with pytest.raises(SystemExit, match=r'have tasks with default options, not {"show_goal": true}'):
        trials.main(trials.Config(add=("new", ppo_gru.main(tiny(**other)))))
    trials.main(trials.Config())
    assert capsys.readouterr().out.splitlines()[-2:] == [
        "| `other` | 1 |  | 0.50 |  |  |",
        "| `new` | 2 | 0.38 | 0.66 | 0.88 |  |",
    ]


@pytest.mark.parametrize(
    ("millions", "score"), [(1.0, 0.2), (1.5, 0.3), (2.0, 0.4), (2.1, 0.4), (0.9, np.nan), (2.2, np.nan)]
)
def test_scores_between_evaluations(millions, score):
    """Linear, and up to a twentieth after the last one."""
    assert trials.score_at({1_000_000: 0.2, 2_000_000: 0.4}, millions) == pytest.approx(score, nan_ok=True)


def test_the_frontier_is_printed_and_drawn(capsys, tmp_path):
    frontier.main(tmp_path / "frontier.png")
    assert capsys.readouterr().out in (ROOT / "docs/tuning.md").read_text()
    made, shown = (Image.open(folder / "frontier.png").size for folder in (tmp_path, ROOT / "docs"))
    assert made == shown


def test_who_has_learned_a_command():
    """Nine of ten who come to it, and to all before it."""
    steps, episodes = np.array([1e6, 2e6]), np.array([[100, 90, 80, 72], [100, 95, 90, 0]])
    assert [frontier.first_time(steps, episodes, count) for count in (1, 2, 3)] == ["1.00", "2.00", ""]


def test_the_page_has_the_tables_of_the_results_that_are_there(capsys):
    claims.main(claims.Config(seeds=suites.SEEDS, report=True, results=ROOT / "benchmarks/results"))
    counts, tables = capsys.readouterr().out.split("\n\n", 1)
    page = (ROOT / "docs/thesis.md").read_text()
    assert tables in page
    assert " ".join(counts.split()) in " ".join(page.split())
    for claim in claims.CLAIMS.values():  # whose command lines have been parsed by now
        plans = [plan for agent in claim.agents for plan in claim.plans(claims.Config(seeds=(1,)), agent)]
        assert len({tuple(plan.logged_args().items()) for plan in plans}) == len(plans), "no two are the same"


def test_counts_of_levels(monkeypatch, capsys, tmp_path):
    """Of the first hundred: two commands on the grid have few different beginnings."""
    for name, value in {"LEVELS": 100, "TEST_LEVELS": 50}.items():
        monkeypatch.setattr(trained_paths, name, value)
    monkeypatch.setattr(tables, "NEW_LEVELS", tmp_path / "new_levels.csv")
    monkeypatch.setattr(trained_paths, "COUNTED", {name: trained_paths.COUNTED[name] for name in ("quickstart",)})
    trained_paths.main(trained_paths.Config(count=True))
    task = "MortarMayhem-Grid-v0", ppo_gru.QUICKSTART["env_options"]
    seen = set(evaluation.beginnings(*task, 0, 100))
    new = [each for each in evaluation.beginnings(*task, learning.FIRST_TEST_LEVEL, 50) if each not in seen]
    assert 0 < len(new) < 50
    told = capsys.readouterr().out
    assert f"| quickstart | {len(seen)} | {len(new)} |" in told
    assert f"| Endless-MysteryPath-v0, first 8 tiles | {endless_counts(8)} |" in told


def endless_counts(tiles):
    """Of levels 0 to 99: how many differ in the tiles that their paths begin with; of 50, how many begin otherwise."""
    env = gym.make("Endless-MysteryPath-v0").unwrapped

    def path(level):
        env.reset(seed=level)
        return tuple(map(tuple, env.oracle()["path"][1 : tiles + 1].tolist()))

    seen = {path(level) for level in range(100)}
    return f"{len(seen)} | {sum(path(learning.FIRST_TEST_LEVEL + level) not in seen for level in range(50))}"
