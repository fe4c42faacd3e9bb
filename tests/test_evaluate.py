"""Scores and curves of trained agents: the statistics by hand, what is grouped, and the commands end to end."""

import itertools
import json
import os
import shlex
import subprocess
import sys
import xml.etree.ElementTree
from dataclasses import asdict
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

import enjoy
import evaluate
import memory_gym_envs
import ppo_gru
import ppo_trxl
from learning import write_run
from ppo_utils import checkpoints, evaluation
from ppo_utils.checkpoints import Checkpoint, load_weights, read_model, saved_args
from ppo_utils.curves import curve_name, draw_curves, draw_metric, draw_tasks, wall_time
from ppo_utils.environments import envs_for
from ppo_utils.evaluation import make_agent
from ppo_utils.run_logs import POINTS, SECONDS, align, read_run
from ppo_utils.scores import RESAMPLES, agents_of, interval, iqm, own_metric, summary, table, task_of, tasks_of
from tables import standard_error

TASK = {"env_id": "MysteryPath-Grid-v0", "obs_type": "vector", "num_levels": 10, "start_level": 5, "save_model": True}
TASK["env_options"] = '{"max_steps": 40}'
FEW = {"levels": 4, "repeats": 2, "cuda": False}


# ---- statistics ----
@pytest.mark.parametrize(
    ("scores", "middle"),
    [
        ([[1], [2], [6]], 3),  # a quarter of three is not even one
        ([[0], [1], [2], [100]], 1.5),
        ([[0], [1], [2], [3], [100]], 2),
        ([[5, 0], [100, 7]], 6),  # seeds and levels alike
        ([[9, 1, 2, 3], [4, 5, 6, 50]], 4.5),
    ],
)
@pytest.mark.parametrize("shape", [(-1, 1), (1, -1)], ids=["levels", "episodes"])
def test_interquartile_mean(scores, middle, shape):
    assert iqm(np.array(scores, float).reshape(len(scores), *shape)) == middle


def test_interval_by_hand():
    """The IQM of four is the mean of the middle two: 0 if at least three are the worst seed's (5 %)."""
    assert interval(np.array([[[0.0]], [[4.0]], [[8.0]], [[100.0]]])).tolist() == [0, 100]
    # Two seeds, drawn whole: both the bad one (25 %), or both the good one (25 %). Drawn separately for each of the six
    # levels, an IQM of 0 would need at least nine of twelve to be bad (7 %), one of 1 as many good ones.
    assert interval(np.array([[[0.0]] * 6, [[1.0]] * 6])).tolist() == [0, 1]


@pytest.mark.parametrize("scores", [[[0, 2], [4, 10], [5, 6], [1, 9]], [[0], [0], [3], [4], [8]]])
def test_interval_is_that_of_all_resamples(scores):
    def middle(values):
        quarter = len(values) // 4
        return np.mean(sorted(values)[quarter : len(values) - quarter])

    drawn = itertools.product(scores, repeat=len(scores))
    every = [middle([score for seed in seeds for score in seed]) for seeds in drawn]
    low, high = np.quantile(every, [0.025, 0.975])
    assert min(every) < high < max(every), "the case tells the 95 % interval from the whole range"
    assert interval(np.array(scores, float)[..., None]) == pytest.approx([low, high])


def test_standard_error_by_hand():
    """Seeds' means 2 and 4 have a variance of 2, levels' means 1, 3 and 5 one of 4."""
    scores = np.array([[0.0, 2.0, 4.0], [2.0, 4.0, 6.0]])[..., None].repeat(5, axis=-1)  # (2, 3, 5)
    assert standard_error(scores) == pytest.approx(np.sqrt(2 / 2 + 4 / 3))
    assert np.isnan(standard_error(scores[:1]))


def test_standard_error_is_that_of_repeated_experiments():
    """The deviation of the mean over experiments, each with its own seeds and levels."""
    rng = np.random.default_rng(0)
    seeds, levels = rng.normal(0, 2, (4000, 3, 1, 1)), rng.normal(0, 5, (4000, 1, 50, 1))
    experiments = seeds + levels + rng.normal(0, 6, (4000, 3, 50, 1))  # what a seed does on one level alone
    errors = [standard_error(each) ** 2 for each in experiments]
    assert np.mean(errors) == pytest.approx(experiments.mean((1, 2, 3)).var(), rel=0.05)


def test_interval_for_every_point_of_a_curve():
    scores = np.random.default_rng(1).normal(size=(3, 5, 4, 2))
    each = np.stack([interval(point) for point in scores], axis=-1)
    assert np.array_equal(interval(scores), each)
    assert each.shape == (2, 3)


def test_one_seed_has_no_interval():
    assert interval(np.zeros((1, 50, 3))) is None
    agent = summary("gru", {"a": 64}, {"return": np.array([[[0.0, 2.0], [2.0, 2.0]]])})
    assert agent["metrics"]["return"]["interval"] is None
    head, _, row, _, note = table([agent]).splitlines()
    assert head == "| metric | agent | seeds | mean | IQM | IQM of level means |"
    assert row == "| return | gru | 1 | 1.500 ± 0.500 | 2.000 | 1.500 |", "levels' means are 1 and 2"
    assert note == "± of one seed is the standard error over levels; other seeds would differ by more"
    two = summary("trxl", {"a": 64, "b": 64}, {"return": np.array([[[0.0]], [[2.0]]])})
    *_, one_seed, two_seeds, _, _ = table([agent, two]).splitlines()
    assert one_seed == "| return | gru | 1 | 1.500 ± 0.500 | 2.000 |  | 1.500 |  |"
    assert two_seeds == "| return | trxl | 2 | 1.000 | 1.000 | 0.000 to 2.000 | 1.000 | 0.000 to 2.000 |"
    assert "±" not in table([two])
    one_level = table([summary("gru", {"a": 64}, {"return": np.ones((1, 1, 3))})])
    assert one_level.splitlines()[2:] == ["| return | gru | 1 | 1.000 | 1.000 | 1.000 |"], "one level has no error"


def test_iqm_of_episodes_and_of_level_means():
    """Ten levels, ten episodes each, seven of them won: 0.9 of the middle half, and each level's mean is 0.7."""
    won = np.tile([1.0] * 7 + [0.0] * 3, (2, 10, 1))
    told = summary("gru", {"a": 64, "b": 64}, {"success": won})["metrics"]["success"]
    assert (told["mean"], told["iqm"], told["iqm_of_levels"]) == pytest.approx((0.7, 0.9, 0.7))
    assert told["interval"] == pytest.approx([0.9, 0.9])
    assert told["interval_of_levels"] == pytest.approx([0.7, 0.7])


def test_seeds_at_different_steps_are_named():
    scores = {"return": np.zeros((3, 1, 1))}
    same, other = (summary("gru", dict.fromkeys("abc", 64) | more, scores) for more in ({}, {"b": 32, "c": None}))
    assert "steps" not in table([same])
    told = "gru: its seeds were trained for different numbers of steps: 64, 32, an unknown number"
    assert table([same, other]).splitlines()[-1] == told


def test_the_interval_is_that_of_all_resamples():
    scores = np.random.default_rng(3).random((4, 10, 3))
    drawn = np.random.default_rng(0).integers(4, size=(RESAMPLES, 4))
    assert interval(scores) == pytest.approx(np.percentile(iqm(scores[drawn]), [2.5, 97.5]))


# ---- agents ----
def arguments(script="ppo_gru", **changes):
    return {"script": script, "exp_name": script, "env_id": "MysteryPath-v0", "env_options": "{}", "seed": 1} | changes


def test_seeds_of_an_agent_are_found():
    runs = {
        "a": arguments(memory="gru"),
        "b": arguments(memory="none"),
        "c": arguments(memory="gru", seed=2, track=True),
        "d": arguments("ppo_trxl", trxl_dim=32),
        "e": arguments("ppo_trxl", trxl_dim=32, seed=5),
    }
    assert agents_of(runs) == {
        "ppo_gru memory=gru": ["a", "c"],
        "ppo_gru memory=none": ["b"],
        "ppo_trxl": ["d", "e"],
    }


def test_own_names_of_agents():
    runs = {"a": arguments(exp_name="mine", gamma=0.9), "b": arguments(exp_name="yours", gamma=0.5)}
    assert set(agents_of(runs)) == {"mine", "yours"}
    runs = {"a": arguments(exp_name="mine"), "b": arguments("ppo_trxl", exp_name="mine")}
    assert set(agents_of(runs)) == {"ppo_gru", "ppo_trxl"}
    runs = {"a": arguments(gamma=0.9), "b": arguments(gamma=0.5, exp_name="new"), "c": arguments(gamma=0.5)}
    assert set(agents_of(runs)) == {"ppo_gru gamma=0.9", "new gamma=0.5", "ppo_gru gamma=0.5"}


def test_an_argument_that_only_one_has_names_it():
    """As of runs of a script from before and after a flag was added."""
    runs = {"a": arguments("ppo_mine"), "b": arguments("ppo_mine", width=3)}
    assert agents_of(runs) == {"ppo_mine": ["a"], "width=3": ["b"]}


def test_the_same_seed_twice_is_refused():
    with pytest.raises(ValueError, match="b is the same agent and seed, 1, as a; leave one of them out"):
        agents_of({"a": arguments(), "b": arguments(cuda=False)})


def test_the_same_seed_at_different_steps_is_told_apart():
    runs = {
        "model-1000": arguments(step=1000, gamma=0.9),
        "model-200": arguments(step=200, gamma=0.9),
        "other": arguments(step=1000, gamma=0.9, seed=2),
        "gamma": arguments(step=300, gamma=0.5),
    }
    assert agents_of(runs) == {
        "gamma=0.9 step=200": ["model-200"],
        "gamma=0.9 step=1000": ["model-1000", "other"],
        "gamma=0.5": ["gamma"],
    }
    del runs["gamma"]
    assert list(agents_of(runs)) == ["step=200", "step=1000"]
    runs["old"] = arguments(gamma=0.9)
    assert list(agents_of(runs)) == ["step=200", "step=1000", "step=unknown"]


def test_seeds_at_different_steps_are_one_agent():
    runs = {"a": arguments(step=100), "b": arguments(step=200, seed=2), "old": arguments(seed=3)}
    assert agents_of(runs) == {"ppo_gru": ["a", "b", "old"]}


def test_the_same_step_twice_is_refused():
    runs = {"a": arguments(step=100), "b": arguments(step=200), "c": arguments(step=200, resume="runs/x")}
    with pytest.raises(ValueError, match="c is the same agent and seed, 1, as b; leave one of them out"):
        agents_of(runs)


@pytest.mark.parametrize(
    "name",
    [
        "preset",
        "cuda",
        "async_envs",
        "track",
        "capture_video",
        "save_model",
        "resume",
        "checkpoint_interval",
        "eval_interval",
        "eval_levels",
        "eval_max_steps",
    ],
)
def test_how_a_run_was_kept_makes_no_other_agent(name):
    runs = {"a": arguments(**{name: "1"}), "b": arguments(seed=2, **{name: "2"})}
    assert agents_of(runs) == {"ppo_gru": ["a", "b"]}


def test_other_tasks_are_apart():
    other = arguments(env_options='{"show_goal": [true]}')
    spelled = arguments(env_options='{ "show_goal":[true] }', seed=2)
    runs = {"a": arguments(), "b": other, "c": arguments(seed=2), "d": spelled}
    assert tasks_of(runs, task_of) == {
        "MysteryPath-v0": {"ppo_gru": ["a", "c"]},
        'MysteryPath-v0 {"show_goal": [true]}': {"ppo_gru": ["b", "d"]},
    }
    runs = {
        "a": arguments(env_id="Maze-v0", env_kwargs='{"size": 9}'),
        "b": arguments(env_id="Maze-v0", env_kwargs='{"size":9}', seed=2),
        "c": arguments(env_id="Maze-v0", env_kwargs='{"size": 17}'),
    }
    assert tasks_of(runs, task_of) == {
        'Maze-v0 {"size": 9}': {"ppo_gru": ["a", "b"]},
        'Maze-v0 {"size": 17}': {"ppo_gru": ["c"]},
    }


@pytest.mark.parametrize("env_id", memory_gym_envs.IDS)
def test_own_metric_is_told_by_the_environment(env_id):
    """6.1.3; every evaluation reports the return."""
    metric = own_metric(env_id)
    envs = gym.make_vec(env_id, num_envs=1)
    envs.reset(seed=0)
    assert metric in envs.summary(np.array([0])) or (metric, env_id) == ("return", "Endless-MysteryPath-v0")


# ---- curves ----
def test_curves_on_common_steps():
    steps, scores = align(
        [
            (np.array([0, 10, 20]), np.array([[[0.0, 5.0]], [[1.0, 5.0]], [[3.0, 5.0]]])),
            (np.array([5, 15]), np.array([[[4.0, 0.0]], [[8.0, 2.0]]])),
        ]
    )
    assert steps.tolist() == [5, 10, 15]
    assert scores.shape == (3, 2, 1, 2)
    assert scores[..., 0, 0].tolist() == [[0, 4], [1, 4], [1, 8]]
    assert scores[..., 0, 1].tolist() == [[5, 0], [5, 0], [5, 2]]


def test_means_are_interpolated():
    runs = [(np.array([0, 10, 20]), np.array([0.0, 1.0, 3.0])), (np.array([5, 15]), np.array([4.0, 8.0]))]
    steps, scores = align([(x, values[:, None, None]) for x, values in runs])
    assert steps.tolist() == [5, 10, 15]
    assert scores[..., 0, 0].tolist() == [[0.5, 4], [1, 6], [2, 8]]


def test_dense_evaluations_are_left_out():
    steps = np.arange(1, 10 * POINTS + 1)
    won = np.random.default_rng(1).integers(2, size=(len(steps), 2, 3))
    common, scores = align([(steps, won)])
    assert np.array_equal(common, np.arange(10, 10 * POINTS + 1, 10))
    assert np.array_equal(scores[:, 0], won[9::10])


@pytest.mark.parametrize("shape", [(2, 1, 2), (2, 2, 1)])
def test_curves_of_different_levels_or_episodes_are_compared_by_their_means(shape):
    runs = [
        (np.array([1, 2]), np.array([0.0, 4.0, 2.0, 4.0]).reshape(shape)),
        (np.array([1, 2]), np.array([[[1.0]], [[5.0]]])),
    ]
    assert align(runs)[1][..., 0, 0].tolist() == [[2, 1], [3, 5]]


def test_dense_curves_are_averaged():
    steps = np.arange(1, 10 * POINTS + 1)
    common, scores = align([(steps, steps[:, None, None] * 2.0)])
    assert len(common) == POINTS
    assert common[0] == 5.5  # of 1 to 10
    assert np.array_equal(scores[:, 0, 0, 0], common * 2)


def test_curves_without_common_steps():
    with pytest.raises(ValueError, match="do not overlap; leave out the shortest run"):
        align([(np.array([1, 2]), np.zeros((2, 1, 1))), (np.array([3]), np.zeros((1, 1, 1)))])


@pytest.fixture(scope="module")
def agents(tiny, tmp_path_factory):
    """The run folders of two seeds of two agents, trained for two iterations with an evaluation after each."""
    settings = {
        **TASK,
        "num_steps": 64,  # longer than an episode
        "total_timesteps": 512,
        "eval_interval": 1,
        "eval_levels": 2,
    }
    folder = tmp_path_factory.mktemp("agents")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        each = itertools.product((ppo_gru, ppo_trxl), (1, 2))
        return [str(folder / script.main(tiny(script, seed=seed, **settings))) for script, seed in each]


def test_curves_drawn(agents, scalars, capsys):
    evaluate.main(
        evaluate.Config(curves=tuple(map(Path, agents)), metrics=("length", "losses/entropy"), json="ends.json")
    )
    assert Image.open("curves.png").size[0] > 1000
    assert xml.etree.ElementTree.parse("curves.svg").getroot().tag.endswith("svg")
    (task,) = json.loads(Path("ends.json").read_text())
    assert [agent["agent"] for agent in task["agents"]] == ["ppo_gru", "ppo_trxl"]
    ends = [scalars(folder)["eval/length"][-1] for folder in agents[:2]]
    assert task["agents"][0]["metrics"]["eval/length"]["mean"] == pytest.approx(np.mean(ends))
    scores = np.array(task["agents"][0]["metrics"]["eval/length"]["scores"])
    assert scores.shape == (2, 2, 3)
    assert scores.mean((1, 2)) == pytest.approx(ends)
    assert "| eval/length | ppo_gru | 2 |" in capsys.readouterr().out


def test_a_curve_is_the_iqm_with_its_band(agents, scalars):
    runs = {"gru": [read_run(folder) for folder in agents[:2]], "trxl": [read_run(agents[2])]}
    axis = Figure().subplots()
    draw_metric(axis, "losses/entropy", runs, {"gru": {"color": "C0"}, "trxl": {"color": "C1"}})
    curves = np.stack([scalars(folder)["losses/entropy"] for folder in agents])
    gru, trxl = axis.lines
    assert np.allclose(gru.get_ydata(), curves[:2].mean(0))  # a quarter of two seeds is none
    assert np.allclose(trxl.get_ydata(), curves[2])
    assert gru.get_xdata().tolist() == [256, 512]
    assert (gru.get_color(), trxl.get_color()) == ("C0", "C1")
    (band,) = axis.collections  # a single seed has none
    low, high = band.get_paths()[0].get_extents().intervaly
    assert (low, high) == pytest.approx((curves[:2].min(), curves[:2].max()))


def test_hyperparameters_are_those_of_the_run(agents):
    for folder in agents:
        script = ppo_trxl if "trxl" in folder else ppo_gru
        args = saved_args(script.Args, read_model(f"{folder}/model.pt"))
        text = {name: str(value) for name, value in asdict(args).items()}
        assert read_run(folder).args == {"script": script.__name__} | text


def test_evaluations_are_shown_before_training_episodes(agents):
    runs = [read_run(folder) for folder in agents]
    assert curve_name("length", runs) == "eval/length"
    assert curve_name("episode/length", runs[:1]) == "episode/length"
    assert runs[0].curves["eval/length"][1].shape == (2, 2, 3), "two evaluations, two levels, thrice each"
    assert runs[0].curves["episode/length"][1].shape == (2, 1, 1)


def test_the_arguments_of_an_older_run():
    """What it could not say has the default, so that it still counts as a seed of the same agent."""
    with SummaryWriter("old") as writer:
        rows = "|seed|3|\n|num_envs|4|\n|no_longer|1|\n|env_id|A-v0|\n|head_size|7|"
        writer.add_text("hyperparameters", f"|param|value|\n|-|-|\n{rows}")
        writer.add_scalar("eval/return", float("nan"), 5)
        writer.add_scalar("eval/return", 2.0, 10)
    run = read_run("old")
    defaults = {name: str(value) for name, value in asdict(ppo_gru.Args()).items()}
    changed = {"script": "ppo_gru", "seed": "3", "num_envs": "4", "env_id": "A-v0", "trunk_size": "7"}
    changed |= {"value_init_gain": "1.0", "vector_frequencies": "0"}  # which were no flags, and had these values
    assert run.args == defaults | changed
    assert [each.tolist() for each in run.curves["eval/return"]] == [[10], [[[2]]]]


def test_the_levels_of_an_older_run():
    """It kept each level's mean. Where a newer version has gone on with it, both are brought to these."""
    with SummaryWriter("old") as writer:
        writer.add_text("hyperparameters", "|param|value|\n|-|-|\n|seed|3|")
        writer.add_scalar("eval/return", 2.0, 10)
        writer.add_scalar("eval/return", 2.5, 20)
        writer.add_tensor("eval_levels/return", torch.tensor([1.0, 3.0]), 10)
        writer.add_tensor("eval_levels/return", torch.tensor([[1.0, 2.0], [3.0, 4.0]]), 20)
    steps, scores = read_run("old").curves["eval/return"]
    assert (steps.tolist(), scores.tolist()) == ([10, 20], [[[1], [3]], [[1.5], [3.5]]])


def test_what_an_older_run_of_mortar_mayhem_carried_out():
    """It is told by the return, 0.1 for each command, and not by a metric that counts a failed last command."""

    def older(options):
        with SummaryWriter(options) as writer:
            rows = f"|seed|3|\n|env_id|MortarMayhem-Grid-v0|\n|env_options|{options}|"
            writer.add_text("hyperparameters", f"|param|value|\n|-|-|\n{rows}")
            writer.add_scalar("charts/episodic_return", 0.3, 10)
            writer.add_scalar("episode/commands_completed", 1.0, 10)
            writer.add_scalar("eval/return", 0.15, 10)
            writer.add_tensor("eval_levels/return", torch.tensor([[0.1, 0.2], [0.2, 0.1]]), 10)
        return read_run(options).curves

    found = older('{"command_count": [4]}')
    assert found["eval/carried_out"][1] == pytest.approx(np.array([[[0.25, 0.5], [0.5, 0.25]]]))
    assert found["episode/carried_out"][1].item() == pytest.approx(0.75)
    with SummaryWriter("newer") as writer:
        writer.add_text("hyperparameters", "|param|value|\n|-|-|\n|seed|3|\n|env_id|MortarMayhem-v0|")
        for name, value in (("return", 0.3), ("carried_out", 0.4)):  # a wrapper may have changed the rewards
            writer.add_scalar(f"eval/{name}", value, 10)
    assert read_run("newer").curves["eval/carried_out"][1].item() == pytest.approx(0.4)
    assert older("{}")["episode/carried_out"][1].item() == pytest.approx(0.3)
    for unknown in ('{"command_count": [2, 4]}', '{"reward_command_success": 1.0}'):
        assert "eval/carried_out" not in older(unknown)


@pytest.mark.parametrize("module", ["", "memory_gym_envs:"])
def test_an_older_run_of_endless_mortar_mayhem_has_the_same_number_under_another_name(module):
    with SummaryWriter("older") as writer:
        rows = f"|seed|3|\n|env_id|{module}Endless-MortarMayhem-v0|"
        writer.add_text("hyperparameters", f"|param|value|\n|-|-|\n{rows}")
        for name in ("eval/commands_completed", "episode/commands_completed", "eval/return"):
            writer.add_scalar(name, 7.0, 10)
    found = read_run("older").curves
    assert {*found} >= {"eval/carried_out", "episode/carried_out", "eval/return"}
    assert found["eval/carried_out"][1].item() == 7.0
    assert not [name for name in found if "commands_completed" in name]


def test_a_picture_goes_to_a_folder_that_is_not_there_yet():
    with SummaryWriter("run-1") as writer:
        writer.add_text("hyperparameters", "|param|value|\n|-|-|\n|seed|1|\n|env_id|A-v0|\n|exp_name|$_$^|")
        writer.add_scalar("eval/return", 1.0, 10)
        writer.add_tensor("eval_levels/return", torch.tensor([[1.0, 2.0]]), 10)
    evaluate.main(evaluate.Config(curves=("run-1",), out="new/curves"))
    assert os.path.exists("new/curves.png")


def test_a_table_says_whose_episodes_were_not_kept(capsys):
    for seed, scores in ((1, [1.0, 3.0]), (2, [[1.0, 2.0], [3.0, 4.0]])):
        with SummaryWriter(f"run-{seed}") as writer:
            rows = f"|seed|{seed}|\n|env_id|A-v0|"
            writer.add_text("hyperparameters", f"|param|value|\n|-|-|\n{rows}")
            writer.add_scalar("eval/return", np.mean(scores), 10)
            writer.add_tensor("eval_levels/return", torch.tensor(scores), 10)
    draw_curves(("run-2",))
    assert "earlier versions kept" not in capsys.readouterr().out
    (task,) = draw_curves(("run-1", "run-2"))
    assert task["agents"][0]["metrics"]["eval/return"]["scores"] == [[[1], [3]], [[1.5], [3.5]]]
    assert "earlier versions kept the levels' means only" in capsys.readouterr().out


def test_the_arguments_of_a_run_of_another_script():
    with SummaryWriter("other") as writer:
        writer.add_text("hyperparameters", "|param|value|\n|-|-|\n|script|ppo_other|\n|seed|3|")
        writer.add_scalar("eval/return", 2.0, 10)
    assert read_run("other").args == {"script": "ppo_other", "seed": "3"}


def test_a_model_of_another_script():
    for name in ("ppo_other", "ppo_utils"):
        torch.save({"script": name, "args": {}, "weights": {}}, "model.pt")
        for read in (Checkpoint.read, enjoy.load):
            with pytest.raises(ValueError, match=rf"model\.pt was trained by {name}\.py, which is not here; run"):
                read("model.pt")


def test_a_file_names_no_other_module():
    """A file from elsewhere must not have any module imported."""
    torch.save({"script": "antigravity", "args": {}, "weights": {}}, "model.pt")
    with pytest.raises(ValueError, match="was trained by antigravity"):
        Checkpoint.read("model.pt")
    assert "antigravity" not in sys.modules


# ---- curves over time ----
def write_events(folder, seed, seconds, begin=0, purge_step=None, **params):
    """Write an event file of a training: seconds (I, 2) of collecting and updating, an iteration every 100 steps."""
    rows = "\n".join(f"|{name}|{value}|" for name, value in {"seed": seed, "env_id": "A-v0", **params}.items())
    with SummaryWriter(folder, purge_step=purge_step) as writer:
        writer.add_text("hyperparameters", f"|param|value|\n|-|-|\n{rows}")
        for iteration, (collect, update) in enumerate(seconds, 1):
            step = begin + 100 * iteration
            writer.add_scalar("charts/episodic_return", step / 100, step)
            writer.add_scalar("charts/seconds_iteration", collect + update, step)
            writer.add_scalar("charts/seconds_collect", collect, step)
            writer.add_scalar("charts/seconds_update", update, step)
    return folder


def write_old_events(folder, seed):
    """Write an event file as versions wrote it that did not measure seconds."""
    with SummaryWriter(folder) as writer:
        writer.add_text("hyperparameters", f"|param|value|\n|-|-|\n|seed|{seed}|\n|env_id|A-v0|")
        writer.add_scalar("charts/episodic_return", 1.0, 100)
        writer.add_scalar("charts/episodic_return", 2.0, 200)
    return folder


def test_hours_of_training():
    run = read_run(write_events("a", 1, [(900, 900), (2700, 900), (0, 1800)]))
    assert run.hours(np.array([50, 100, 150, 200, 300])).tolist() == [0.25, 0.5, 1, 1.5, 2]


@pytest.mark.parametrize("clock", ["0", "9999999999"])
def test_a_resumed_run_counts_its_seconds_once(caplog, clock):
    """It stopped in iteration 5 and goes on after iteration 2, as its second file's first event says.

    Also if the clock of the first machine was ahead, which the file's name tells.
    """
    write_events("a", 1, [(1, 1), (2, 1), (30, 10), (40, 10)], num_steps=64)
    (first,) = Path("a").iterdir()
    first.rename(f"a/events.out.tfevents.{clock}")
    write_events("a", 1, [(50, 10)] * 9, begin=200, purge_step=201)  # killed before its first checkpoint
    (second,) = {*Path("a").iterdir()} - {Path(f"a/events.out.tfevents.{clock}")}
    second.rename("a/events.out.tfevents.8888888888")
    write_events("a", 1, [(3, 1), (4, 1), (5, 1)], begin=200, purge_step=201, num_steps=128)
    run = read_run("a")
    steps, _ = run.curves["charts/seconds_iteration"]
    assert (steps.tolist(), run.seconds("iteration").tolist()) == ([100, 200, 300, 400, 500], [2, 3, 4, 5, 6])
    assert run.hours(np.array([500]))[0] == pytest.approx(20 / 3600)
    assert run.curves["charts/episodic_return"][0].tolist() == [100, 200, 300, 400, 500]
    assert wall_time([run])["hours"] == pytest.approx(20 / 3600)
    assert run.args["num_steps"] == "128", "those that it was resumed with"
    assert not caplog.records, "TensorBoard calls it a crash"


def test_a_resumed_run_forgets_the_evaluations_beyond_its_checkpoint():
    """It evaluated in iterations 2 and 4, crashed, and has played none of what follows iteration 2 again."""
    write_events("a", 1, [(1, 1)] * 4)
    (first,) = Path("a").iterdir()
    first.rename("a/events.out.tfevents.0")
    with SummaryWriter("b") as writer:
        for step in (200, 400):
            writer.add_scalar("eval/return", step, step)
            writer.add_tensor("eval_levels/return", torch.full((2, 3), step / 1.0), step)
    (second,) = Path("b").iterdir()
    second.rename("a/events.out.tfevents.1")
    write_events("a", 1, [], purge_step=201)
    run = read_run("a")
    steps, scores = run.curves["eval/return"]
    assert (steps.tolist(), scores.tolist()) == ([200], [[[200.0] * 3] * 2])
    assert run.last_step == 200


def test_curves_over_time_are_aligned_in_hours():
    fast = read_run(write_events("a", 1, [(1800, 1800)] * 3))  # 1, 2 and 3 hours
    slow = read_run(write_events("b", 2, [(3600, 3600)] * 3))  # 2, 4 and 6 hours
    axis = Figure().subplots()
    styles = {"gru": {"color": "C0"}}
    last = draw_metric(axis, "charts/episodic_return", {"gru": [fast, slow]}, styles, "time")
    (line,) = axis.lines
    assert line.get_xdata().tolist() == [2, 3], "as far as both reach"
    assert line.get_ydata().tolist() == [1.5, 2.25]
    assert last["gru"].tolist() == [[[3]], [[1.5]]]
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("hours of training", "charts/episodic_return")
    assert axis.xaxis.get_major_formatter()(0.025) == "0.025"


def test_wall_times(capsys):
    """Of eight iterations, the IQM leaves out two at each end."""
    runs = (
        write_events("a", 1, [(1, 0), (1, 1), (2, 1), (2, 2)]),
        write_events("b", 2, [(3, 2), (6, 3), (7, 3), (50, 10)]),
        write_events("c", 1, [(3600, 3600)], gamma=0.5),
    )
    evaluate.main(evaluate.Config(curves=runs, json="ends.json"))
    (task,) = json.loads(Path("ends.json").read_text())
    found = {agent["agent"]: agent["wall_time"] for agent in task["agents"]}
    seconds = [1, 2, 3, 4, 5, 9, 10, 60]
    assert found["gamma=0.995"] == pytest.approx(
        {
            "mean": 11.75,
            "std": np.std(seconds),
            "min": 1,
            "median": 4.5,
            "iqm": 5.25,
            "max": 60,
            "collect": 9,
            "update": 22 / 8,
            "hours": 47 / 3600,
        }
    )
    said = capsys.readouterr().out
    assert "A-v0, seconds of an iteration and hours of a training\n\n| agent | seeds | mean | std | min |" in said
    assert "| gamma=0.995 | 2 | 11.750 | 18.478 | 1.000 | 4.500 | 5.250 | 60.000 | 9.000 | 2.750 | 0.013 |" in said
    assert said.endswith(
        "| gamma=0.5 | 1 | 7200.000 | 0.000 |" + 4 * " 7200.000 |" + 2 * " 3600.000 |" + " 2.000 |\n\n"
    )


def test_wall_times_are_left_out_where_runs_have_none(capsys):
    new, old = write_events("a", 1, [(1, 1), (1, 1)]), write_old_events("b", 2)
    (task,) = draw_curves((new, old))
    assert "wall_time" not in task["agents"][0]
    assert "seconds of an iteration" not in capsys.readouterr().out
    other = write_events("c", 1, [(1, 1), (1, 1)], gamma=0.5)
    (task,) = draw_curves((new, old, other))
    assert ["wall_time" in agent for agent in task["agents"]] == [False, True]
    assert "| gamma=0.5 | 1 | 2.000 |" in capsys.readouterr().out.split("hours of a training")[1]


def test_three_tasks_are_drawn_two_by_two():
    runs = tuple(
        write_events(f"run-{env_id}", 1, [(1, 1), (1, 1)], env_id=env_id) for env_id in ("A-v0", "B-v0", "C-v0")
    )
    report = draw_curves(runs)
    assert [task["task"] for task in report] == ["A-v0", "B-v0", "C-v0"]
    width, height = Image.open("curves.png").size
    assert 1.3 < width / height < 1.5  # four pictures of 5.5 by 4 inches
    titles = [element for element in Path("curves.svg").read_text().split("<!-- ") if element[1:6] == "-v0 -"]
    assert len(titles) == 3


def test_an_agent_has_one_look_in_all_tasks_and_one_place_in_the_legend(monkeypatch):
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    run = read_run(write_events("a", 1, [(1, 1), (1, 1)]))
    others = {f"task {i}": {f"agent {i}": [run]} for i in range(9)}
    tasks = {"first": {"gru": [run, run]}, "second": {"trxl": [run], "gru": [run]}} | others
    last = draw_tasks(tasks, "curves", dict.fromkeys(tasks, ("return",)))
    assert [*last["first"]] == ["gru"]
    figure = figures[0]
    first, second, *_, ninth = figure.axes
    assert first.lines[0].get_color() == second.lines[1].get_color() != second.lines[0].get_color()
    looks = {(line.get_color(), line.get_linestyle()) for axis in figure.axes for line in axis.lines}
    assert len(looks) == 11, "gru, trxl and nine others; there are ten colours"
    (legend,) = figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts[:3] == ["gru, 1 to 2 seeds", "trxl, 1 seed", "agent 0, 1 seed"]
    in_legend = dict(zip(texts, legend.get_lines(), strict=True))["agent 8, 1 seed"]
    assert in_legend.get_color() == ninth.lines[0].get_color()


# ---- scores ----
def test_scores_are_those_of_the_levels(agents, capsys):
    models = tuple(f"{folder}/model.pt" for folder in agents)
    evaluate.main(evaluate.Config(models, json="scores.json", **FEW))
    said = capsys.readouterr().out
    assert said.startswith('MysteryPath-Grid-v0 {"max_steps": 40}, levels 15 to 18, 2 times each\n')
    (task,) = json.loads(Path("scores.json").read_text())
    assert task["finished"] == 1
    gru, trxl = task["agents"]
    assert (gru["agent"], gru["runs"]) == ("ppo_gru", list(models[:2]))
    assert (trxl["agent"], trxl["runs"]) == ("ppo_trxl", list(models[2:]))
    assert list(gru["metrics"]) == ["success", "return", "length", "num_fails"]
    falls = np.array(trxl["metrics"]["num_fails"]["scores"])
    assert falls.shape == (2, 4, 2)
    low, high = trxl["metrics"]["num_fails"]["interval"]
    assert low <= trxl["metrics"]["num_fails"]["iqm"] <= high
    assert f"| num_fails | ppo_trxl | 2 | {falls.mean():.3f} |" in said

    saved = read_model(models[2])
    args = saved_args(ppo_trxl.Args, saved)
    envs = envs_for(args, 8)
    agent = make_agent(ppo_trxl.Agent, envs, {}, args)
    load_weights(agent, saved, models[2])
    torch.manual_seed(1)
    found = evaluation.evaluate(agent, envs, evaluation.evaluation_levels(args, 4, 2), 10_000)["num_fails"]
    assert falls[0].tolist() == [[found[2 * level], found[2 * level + 1]] for level in range(4)]
    assert len({tuple(level) for level in falls[0]}) > 1, "levels that can be told apart"


def scores_of(agents, metric="num_fails", **changes):
    """A metric (M, E) of an agent's episodes, and the title of what it played."""
    evaluate.main(evaluate.Config((Path(agents[0]) / "model.pt",), json=Path("scores.json"), **{**FEW, **changes}))
    (task,) = json.loads(Path("scores.json").read_text())
    return np.array(task["agents"][0]["metrics"][metric]["scores"][0]), task["task"]


def test_the_most_probable_actions(agents):
    """They are the same in each repeat, and no seed changes them."""
    sampled, _ = scores_of(agents, repeats=6)
    assert (sampled != sampled[:, :1]).any()
    chosen, title = scores_of(agents, repeats=6, deterministic=True)
    assert (chosen == chosen[:, :1]).all()
    assert np.array_equal(chosen, scores_of(agents, repeats=6, deterministic=True, seed=9)[0])
    assert title.endswith("levels 15 to 18, 6 times each, most probable actions")


@pytest.mark.parametrize("at_once", [5, 12])
def test_episodes_in_batches(agents, monkeypatch, at_once):
    """Of 24 episodes, the last batch has four, or twelve; the repeats of a level may be in two."""
    wanted, _ = scores_of(agents, levels=12, repeats=2, deterministic=True)
    monkeypatch.setattr(evaluate, "AT_ONCE", at_once)
    assert np.array_equal(scores_of(agents, levels=12, repeats=2, deterministic=True)[0], wanted)


def test_what_one_batch_alone_reports_is_unknown_in_the_others(agents, monkeypatch):
    found = iter([{"return": np.ones(4), "coins": np.ones(4)}, {"return": np.ones(4)}])
    monkeypatch.setattr(evaluate, "evaluate", lambda *_, **__: next(found))
    monkeypatch.setattr(evaluate, "AT_ONCE", 4)
    checkpoint = Checkpoint.read(f"{agents[0]}/model.pt")
    played = evaluate.play(checkpoint, evaluate.Config(levels=4, repeats=2, cuda=False))
    assert np.isnan(played["coins"]).tolist() == [[False] * 2] * 2 + [[True] * 2] * 2
    assert (played["return"] == 1).all()


def test_batches_of_a_level_draw_other_actions(agents, monkeypatch):
    monkeypatch.setattr(evaluate, "AT_ONCE", 8)
    lengths = scores_of(agents, levels=1, repeats=16)[0]
    assert not np.array_equal(lengths[0, :8], lengths[0, 8:])


def test_other_levels(agents):
    usual, _ = scores_of(agents, levels=6, deterministic=True)
    moved, title = scores_of(agents, levels=4, deterministic=True, start_level=17)
    assert np.array_equal(usual[2:], moved)
    assert ", levels 17 to 20, " in title
    assert ", levels 12 to 15 (of its training), " in scores_of(agents, start_level=12)[1]
    assert ", levels 1 to 4, " in scores_of(agents, start_level=1)[1], "below the first level of the training"
    without_levels = arguments(num_levels=0, start_level=100)
    assert ", levels 90 to 139, " in evaluate.title_of(without_levels, evaluate.Config(start_level=90))
    trained = arguments(num_levels=10, start_level=5)
    new = evaluate.title_of(trained, evaluate.Config(start_level=90, levels=4, new_levels=True))
    assert ", 4 levels from 90 on that begin as none of the levels 5 to 14 does, " in new


OTHERS = "; --new-levels plays only others\n"
MAY = "Some of these levels may begin as levels of the training do"


@pytest.mark.parametrize(
    ("env_id", "num_levels", "asked", "told"),
    [
        ("MysteryPath-Grid-v0", 1000, {}, "Of these 40 levels, 7 begin as levels of the training do" + OTHERS),
        ("MysteryPath-Grid-v0", 3, {}, "Of these 40 levels, 0 begin as levels of the training do\n"),
        ("MysteryPath-Grid-v0", 3, {"start_level": 1}, "Of these 40 levels, 2 begin as levels of the training do"),
        ("MysteryPath-Grid-v0", 999, {"start_level": 9}, "Of these 40 levels, 40 begin as levels of the training do\n"),
        ("MysteryPath-Grid-v0", 1001, {}, MAY + OTHERS),
        ("MysteryPath-Grid-v0", 10, {"env_options": '{"max_steps": 8}'}, f"{MAY}\n"),
        ("MysteryPath-Grid-v0", 0, {}, None),
        ("MysteryPath-Grid-v0", 10, {"new_levels": True}, None),
        ("Endless-MysteryPath-v0", 10, {}, f"{MAY}\n"),
        ("CartPole-v1", 10, {}, None),
    ],
)
def test_how_many_levels_begin_as_those_of_the_training(tiny, capsys, monkeypatch, env_id, num_levels, asked, told):
    monkeypatch.setattr(evaluate, "MOST_COUNTED", 1000)
    folder = ppo_gru.main(tiny(env_id=env_id, num_levels=num_levels, save_model=True, ground_truth_coef=0.0))
    capsys.readouterr()
    evaluate.main(evaluate.Config((f"{folder}/model.pt",), levels=40, repeats=1, max_steps=9, **asked))
    printed = capsys.readouterr().out
    assert (told or "") in printed
    assert ("of the training do" in printed) == (told is not None)


def test_levels_are_counted_for_each_training(tiny, capsys):
    """Two agents, with other training levels, that play the same ones."""
    models = []
    for number, seed in ((3, 1), (1000, 2)):
        args = tiny(env_id="MysteryPath-Grid-v0", num_levels=number, seed=seed, save_model=True)
        models.append(f"{ppo_gru.main(args)}/model.pt")
    capsys.readouterr()
    evaluate.main(evaluate.Config(tuple(models), start_level=1000, levels=40, repeats=1, max_steps=9))
    assert capsys.readouterr().out.splitlines()[-4:] == [
        "Trained on 3 levels from 0 on: Of these 40 levels, 0 begin as levels of the training do",
        "",
        f"Trained on 1000 levels from 0 on: Of these 40 levels, 7 begin as levels of the training do{OTHERS.strip()}",
        "",
    ]


def test_reset_options_over_those_of_the_training(tiny):
    trained = tiny(env_id="MysteryPath-Grid-v0", env_options='{"max_steps": 30, "show_goal": true}', save_model=True)
    agents = [str(ppo_gru.main(trained))]
    few = {"max_steps": 10_000, "levels": 4}
    assert scores_of(agents, "length", **few)[0].max() == 30
    lengths, title = scores_of(agents, "length", env_options='{"max_steps": 20}', **few)
    assert lengths.max() == 20
    assert title.startswith('MysteryPath-Grid-v0 {"max_steps": 20, "show_goal": true}, ')
    for wrong, message in (("[", "--env-options is no JSON"), ('{"max_step": 3}', "max_steps")):
        with pytest.raises(ValueError, match=message):
            scores_of(agents, env_options=wrong)


def test_a_checkpoint_is_read_once(agents, monkeypatch):
    read, read_bytes = [], Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: (read.append(str(path)), read_bytes(path))[1])
    models = tuple(f"{folder}/model.pt" for folder in agents)
    evaluate.main(evaluate.Config(models, max_steps=3, **FEW))
    assert sorted(read) == sorted(models)


def test_several_files_of_a_run(agents, monkeypatch, capsys):
    """Files of two seeds at steps 512 and 1024, and one of the other agent that is at another step."""
    files = {f"{seed}/checkpoint-{step}.pt": (seed, step) for seed, step in itertools.product((0, 1), (1024, 512))}
    files["2/model.pt"] = (2, 2048)

    def read(path):
        run, step = files[path]
        return read_model(f"{agents[run]}/model.pt") | {"step": step, "optimizers": []}

    monkeypatch.setattr(checkpoints, "read_model", read)
    config = evaluate.Config(tuple(files), max_steps=3, json="scores.json", **FEW)
    assert Checkpoint.read("2/model.pt").saved.keys() == {"script", "args", "weights"}
    evaluate.main(config)
    (task,) = json.loads(Path("scores.json").read_text())
    assert {agent["agent"]: agent["runs"] for agent in task["agents"]} == {
        "ppo_gru step=512": ["0/checkpoint-512.pt", "1/checkpoint-512.pt"],
        "ppo_gru step=1024": ["0/checkpoint-1024.pt", "1/checkpoint-1024.pt"],
        "ppo_trxl": ["2/model.pt"],
    }
    assert "| return | ppo_gru step=512 | 2 |" in capsys.readouterr().out


def test_the_share_of_finished_episodes(agents, monkeypatch, capsys):
    played = iter([[1.0, 1.0], [0.0, 1.0]])

    def play(checkpoint, config):
        return {"return": np.zeros((2, 1)), "length": np.ones((2, 1)), "finished": np.array(next(played))[:, None]}

    monkeypatch.setattr(evaluate, "play", play)
    (task,) = evaluate.score_checkpoints(evaluate.Config(tuple(f"{folder}/model.pt" for folder in agents[:2]), **FEW))
    assert task["finished"] == 0.75
    assert "--max-steps cut 25.00% of the episodes;" in capsys.readouterr().out


def test_a_result_has_what_tables_need():
    """The family's metric, return, length and falls, by episode, and the seconds."""
    with SummaryWriter("run") as writer:
        writer.add_text("hyperparameters", "|param|value|\n|-|-|\n|seed|1|\n|env_id|MysteryPath-v0|")
        for name in SECONDS.values():
            writer.add_scalar(name, 1.0, 10)
        for name in ("success", "return", "length", "num_fails", "other"):
            writer.add_scalar(f"eval/{name}", 1.5, 10)
            writer.add_tensor(f"eval_levels/{name}", torch.tensor([[1.0, 2.0]]), 10)
    write_run(read_run("run"), "run.json.gz")
    kept = read_run("run.json.gz").curves
    assert {name for name in kept if "eval" in name} == {
        "eval/success", "eval/return", "eval/length", "eval/num_fails"
    }  # fmt: skip
    assert kept["eval/num_fails"][1].tolist() == [[[1.0, 2.0]]]
    assert kept.keys() >= {*SECONDS.values()}


def test_episodes_cut_short(agents, capsys):
    """What only an episode's end tells is unknown then, and not made up."""
    evaluate.main(evaluate.Config((f"{agents[0]}/model.pt",), max_steps=3, json="scores.json", **FEW))
    (task,) = json.loads(Path("scores.json").read_text())
    assert task["finished"] == 0
    assert list(task["agents"][0]["metrics"]) == ["return", "length"]
    assert "--max-steps cut 100.00% of the episodes" in capsys.readouterr().out


def test_metrics_that_every_episode_reported():
    told = {"return": np.zeros(2), "length": np.ones(2), "finished": np.ones(2), "success": np.zeros(2)}
    assert evaluate.choose_metrics((), "MysteryPath-v0", [told, told]) == ["success", "return", "length"]
    assert evaluate.choose_metrics(("finished",), "MysteryPath-v0", [told]) == ["finished"]
    cut = told | {"success": np.array([0, np.nan])}
    assert evaluate.choose_metrics((), "MysteryPath-v0", [told, cut]) == ["return", "length"]
    with pytest.raises(ValueError, match="not every episode reported success; all reported return, length, finished"):
        evaluate.choose_metrics(("success",), "MysteryPath-v0", [told, cut])


def test_a_metric_that_one_of_two_tasks_has(tiny, capsys):
    """The other one gets a line and its usual metrics; what was played is kept, also if none has it."""
    paths = []
    for env_id in ("MysteryPath-Grid-v0", "MortarMayhemB-Grid-v0"):
        paths.append(str(ppo_gru.main(tiny(env_id=env_id, obs_type="vector", save_model=True)) / "model.pt"))
    few = {"levels": 1, "repeats": 1, "cuda": False}
    evaluate.main(evaluate.Config(tuple(paths), metrics=("carried_out",), json="scores.json", **few))
    other, task = json.loads(Path("scores.json").read_text())
    assert task["task"].startswith("MortarMayhemB-Grid-v0")
    assert list(task["agents"][0]["metrics"]) == ["carried_out"]
    assert list(other["agents"][0]["metrics"])[:2] == ["success", "return"]
    assert "MysteryPath-Grid-v0, levels 100000 to 100000, 1 times each: not every" in capsys.readouterr().err
    with pytest.raises(ValueError, match="no task reports coins"):
        evaluate.main(evaluate.Config(tuple(paths), metrics=("coins",), json="others.json", **few))
    assert len(json.loads(Path("others.json").read_text())) == 2


# ---- bad input ----
BAD = {
    "": "give either checkpoints to play with .* or --curves",
    "a.pt --curves runs": "give either checkpoints",
    "nowhere.pt": "there is no file nowhere.pt",
    "notes.txt": "notes.txt is cut short, or neither a model nor a checkpoint",
    "MODEL --levels 0": "--levels is 0; it must be 1 or more",
    "MODEL --levels 1000000000": "--levels x --repeats is 3000000000; at most 100000 are played",
    "MODEL --new-levels --env-options {}": "--new-levels and --env-options: which levels are new is known for",
    "MODEL --seed 99999999999999999999": r"--seed is 99999999999999999999; it must be below 2 \*\* 63",
    "cut.pt": "cut.pt is cut short, or neither a model nor a checkpoint",
    "MODEL --max-steps 0": "--max-steps is 0",
    "MODEL --json no/where.json": "there is no folder no to write to",
    "MODEL --json empty": "--json empty is a folder; give a file to write to",
    "MODEL --json ''": "--json  is a folder; give a file to write to",
    "MODEL --metrics coins": "no task reports coins",
    "--curves nowhere": "there is no run folder nowhere",
    "--curves empty": "empty holds no curves",
    "--curves results": "results is a folder of results; give the files themselves, as results/\\*.json.gz",
    "--curves RUN --metrics coins": "of MysteryPath-Grid-v0 .* no curve of coins .* all have .*eval/success",
    "--curves RUN --out empty/": "--out empty/ is a folder; give the files' name too, as empty/curves",
    "--curves old --over time": "old has no charts/seconds_iteration, .*; draw it --over steps, or leave it out",
}


def test_bad_input(agents, tmp_path):
    (tmp_path / "notes.txt").write_text("some notes")
    content = Path(f"{agents[0]}/model.pt").read_bytes()
    (tmp_path / "cut.pt").write_bytes(content[: len(content) // 2])  # torch raises an OSError without a file's name
    (tmp_path / "empty").mkdir()
    (tmp_path / "results").mkdir()
    (tmp_path / "results/run.json.gz").touch()
    write_old_events("old", 1)
    for line, fault in BAD.items():
        words = shlex.split(line.replace("MODEL", f"{agents[0]}/model.pt --levels 1").replace("RUN", agents[0]))
        with pytest.raises((ValueError, OSError), match=fault):
            evaluate.main(evaluate.tyro.cli(evaluate.Config, args=words))


def test_drawing_alone_needs_the_extra(agents, monkeypatch, capsys):
    for name in ("matplotlib", "scipy"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "ppo_utils.curves")
    evaluate.main(evaluate.Config((f"{agents[0]}/model.pt",), max_steps=3, **FEW))
    assert "| return | ppo_gru | 1 |" in capsys.readouterr().out
    with pytest.raises(ImportError, match=r'to draw needs matplotlib.*: pip install -e "\.\[eval\]"'):
        evaluate.main(evaluate.Config(curves=(agents[0],)))


def test_the_command_prints_one_line_and_fails():
    """Here without what only drawing needs."""
    hide = "import runpy, sys; sys.modules |= dict.fromkeys(['matplotlib', 'scipy', 'PIL', 'plotly'])"
    code = f"{hide}; runpy.run_path({evaluate.__file__!r}, run_name='__main__')"
    line = [sys.executable, "-c", code, "nowhere.pt"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1
    assert done.stderr == "evaluate.py: there is no file nowhere.pt; --save-model writes model.pt to the run folder\n"
