"""Evaluation: other levels, fresh memory, one episode a lane, and nothing of it in the training."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import SCRIPTS

import ppo_gru
import ppo_trxl
from ppo_utils import evaluation
from ppo_utils.environments import envs_for
from ppo_utils.evaluation import evaluate, evaluation_levels


class Numbered(gym.Env):
    """Reports the number of the episode; the first has seed % 5 + 1 steps, and each other one step more."""

    observation_space = gym.spaces.Box(0.0, 1.0, (1,))
    action_space = gym.spaces.Discrete(2)
    number = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.number, self.length = 0, seed % 5
        self.number, self.length, self.t = self.number + 1, self.length + 1, 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        return np.zeros(1, np.float32), 1.0, self.t == self.length, False, {"number": self.number}


gym.register("Numbered-v0", entry_point=Numbered)
EACH_SCRIPT = pytest.mark.parametrize("script", SCRIPTS)
FEW = {"eval_levels": 2, "num_levels": 10, "start_level": 5}


def evaluated(args, run, seed=0, max_steps=10_000, **changes):
    levels = evaluation_levels(args, 3, repeats=2)
    torch.manual_seed(seed)
    return evaluate(run.agent, envs_for(args, len(levels)), levels, max_steps, **changes)


def test_levels_follow_the_training_set(tiny):
    args = tiny(env_id="MysteryPath-Grid-v0", **FEW)
    assert evaluation_levels(args, 3, repeats=2) == [15, 15, 16, 16, 17, 17]
    defaults = ppo_gru.Args()
    levels = evaluation_levels(defaults, defaults.eval_levels)
    assert len(levels) == 150  # 6.1.3: 50 levels, three times each
    assert min(levels) == defaults.start_level + defaults.num_levels == 100_000


def test_levels_that_were_trained_on(tiny):
    """Of levels 5 to 14."""
    args = tiny(env_id="MysteryPath-Grid-v0", **FEW)
    ranges = {(4, 2): True, (3, 2): False, (14, 1): True, (15, 3): False, (0, 30): True}
    assert {each: evaluation.are_trained_on(args, *each) for each in ranges} == ranges


def test_what_levels_begin_with_does_not_depend_on_what_is_observed(tiny):
    """Nor on how it is given; an option of the task changes it."""
    found = evaluation.beginnings("MysteryPath-Grid-v0", "{}", 5, 4)
    assert len(set(found)) > 1
    assert evaluation.beginnings("MysteryPath-Grid-v0", '{"show_goal": true}', 5, 4) == found
    assert evaluation.beginnings("MysteryPath-Grid-v0", '{"cardinal_origin_choice": [0]}', 5, 4) != found


def test_new_levels_begin_as_none_of_the_training_s(tiny):
    args = tiny(env_id="MysteryPath-Grid-v0", num_levels=1500, start_level=1007)
    envs = gym.make_vec(args.env_id, num_envs=1800)
    envs.reset(seed=args.start_level)
    s = envs.unwrapped.state
    paths = [tuple(cells[1 : 1 + length]) for cells, length in zip(s.path_cell, s.path_length, strict=True)]
    wanted = [1007 + at for at in range(1500, 1800) if paths[at] not in set(paths[:1500])]
    assert 50 < len(wanted) < 250
    assert evaluation.count_trained_on(args, 2507, 300) == 300 - len(wanted)
    assert evaluation.new_levels(args, len(wanted), 2507) == wanted
    assert evaluation_levels(args, 2, 3, new=True) == [wanted[0]] * 3 + [wanted[1]] * 3


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"env_id": "CartPole-v1"}, "CartPole-v1 does not tell what a level holds"),
        ({"env_id": "MysteryPath-v0", "num_levels": 0}, "with --num-levels 0, a training may have met any level"),
        (
            {"env_id": "MortarMayhem-Grid-v0", "num_levels": 3000, "env_options": '{"command_count": [1]}'},
            "levels 3000 to 3999 all begin as some of the training do",
        ),
    ],
)
def test_where_no_level_is_new(tiny, changes, words):
    with pytest.raises(ValueError, match=words):
        evaluation_levels(tiny(**changes), 5, new=True)


@EACH_SCRIPT
def test_a_lane_plays_its_level_once(played, script, monkeypatch):
    """The same actions in single environments with the levels' seeds earn the same."""
    args, run, *_ = played(script=script, env_id="MortarMayhemB-Grid-v0", **FEW)
    taken, act = [], run.agent.get_action_and_value
    monkeypatch.setattr(run.agent, "get_action_and_value", lambda *given: (taken.append(act(*given)), taken[-1])[1])
    found = evaluated(args, run)
    assert (found["finished"] == 1).all()
    for lane, level in enumerate(evaluation_levels(args, 3, repeats=2)):
        env = gym.make(args.env_id)
        env.reset(seed=level)
        rewards, ended = [], False
        while not ended:
            _, reward, terminated, truncated, info = env.step(int(taken[len(rewards)][0][lane, 0]))
            rewards.append(reward)
            ended = terminated or truncated
        assert found["return"][lane] == pytest.approx(sum(rewards))
        assert found["length"][lane] == len(rewards)
        assert found["carried_out"][lane] == info["carried_out"]


@EACH_SCRIPT
def test_an_environment_s_own_return(played, script, monkeypatch):
    """What its last info calls so does not replace the sum of the rewards."""
    args, run, *_ = played(script=script, env_id="MortarMayhemB-Grid-v0", **FEW)
    before = evaluated(args, run)
    monkeypatch.setattr(evaluation, "final_numbers", lambda infos, done: {"return": np.full(len(done), -77.0)})
    assert (evaluated(args, run)["return"] == before["return"]).all()


def test_the_memory_is_carried_from_stretch_to_stretch(played, monkeypatch):
    """Episodes longer than a stretch: the window's cache, refreshed, is what it was."""
    args, run, *_ = played(script=ppo_trxl, env_id="MysteryPath-Grid-v0", weights_scale=5.0, **FEW)
    found = []
    for steps in (1000, 3):
        monkeypatch.setattr(evaluation, "MEMORY_STEPS", steps)
        found.append(evaluated(args, run, max_steps=40))
    whole, short = found
    assert whole["length"].max() > 30
    for name, numbers in whole.items():
        assert np.array_equal(numbers, short[name], equal_nan=True), name


@EACH_SCRIPT
def test_an_episode_that_is_cut_short(played, script):
    args, run, *_ = played(script=script, env_id="MysteryPath-Grid-v0", **FEW)
    found = evaluated(args, run, max_steps=7)
    assert set(found["finished"]) <= {0.0, 1.0}
    cut = found["finished"] == 0
    assert cut.any()
    assert (found["length"][cut] == 7).all()


@EACH_SCRIPT
def test_training_goes_on_as_if_there_had_been_none(tiny, curves, script):
    args = tiny(script, env_id="MortarMayhemB-Grid-v0", total_timesteps=4 * 64, **FEW)
    without = curves(script.main(args))
    evaluated = curves(script.main(dataclasses.replace(args, eval_interval=3)))
    assert [step for step, _ in evaluated["eval/carried_out"]] == [192, 256]
    assert [step for step, _ in evaluated["eval/return"]] == [192, 256]
    for name in without:
        assert evaluated[name] == without[name], name


def test_equal_weights_score_the_same_whenever_they_are_evaluated(tiny, curves):
    """Actions are drawn with the run's seed, so that evaluations differ by what was learned alone."""
    args = tiny(env_id="MortarMayhemB-Grid-v0", total_timesteps=192, init_lr=0.0, final_lr=0.0, eval_interval=1, **FEW)
    (_, first), (_, second), (_, third) = curves(ppo_gru.main(args))["eval_levels/length"]
    assert first == second == third
    assert len({length for level in first for length in level}) > 1


def test_an_episode_is_an_environment_s_first(played):
    """Those that follow while others play on count nowhere."""
    args, run, *_ = played(env_id="Numbered-v0", num_levels=0, start_level=0)
    found = evaluate(run.agent, envs_for(args, 5), [0, 1, 2, 3, 4], 100)
    assert found["number"].tolist() == [1, 1, 1, 1, 1]
    assert found["length"].tolist() == found["return"].tolist() == [1, 2, 3, 4, 5]
    found = evaluate(run.agent, envs_for(args, 5), [0, 1, 2, 3, 4], 3)
    assert found["number"].tolist()[:3] == [1, 1, 1]
    assert np.isnan(found["number"][3:]).all()
    assert found["finished"].tolist() == [1, 1, 1, 0, 0]


@pytest.mark.parametrize("amp", [True, False])
def test_an_evaluation_computes_as_the_training_does(played, amp):
    args, run, *_ = played(env_id="CueRecall-v0", amp=amp, eval_levels=1)
    used = []
    run.agent.encoder.register_forward_pre_hook(lambda *_: used.append(torch.is_autocast_enabled("cpu")))
    evaluation.level_scores(args, run.agent, envs_for(args, 3))
    assert {*used} == {amp}


def test_what_is_logged_of_an_evaluation(tiny, curves, monkeypatch):
    """Levels by repeats, and the mean; what some episode did not report is left out."""
    numbers = np.arange(6.0)
    told = {"return": numbers, "steps": numbers, "success": np.where(numbers == 4, np.nan, numbers)}
    monkeypatch.setattr(evaluation, "evaluate", lambda *_, **__: told)
    found = curves(ppo_gru.main(tiny(env_id="CueRecall-v0", eval_interval=2, **FEW)))
    assert found["eval/return"] == [(128, 2.5)]
    assert found["eval_levels/return"] == [(128, [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]])]
    assert {name for name in found if "eval" in name} == {
        "eval/return", "eval/steps", "eval_levels/return", "eval_levels/steps"
    }  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"env_id": "MortarMayhem-Grid-v0", "frame_stack": 4}, {"observation": (84, 84, 4)}),
        ({"env_id": "MortarMayhem-Grid-v0", "obs_type": "vector"}, {"observation": (24,)}),
        (
            {"env_id": "MortarMayhem-Grid-v0", "obs_type": "vector", "frame_stack": 16, "step_encoding": True},
            {"observation": (16 * 24,), "step_encoding": (16,)},
        ),
        (
            {"env_id": "MortarMayhemB-Grid-v0", "step_encoding": True},
            {"visual_observation": (84, 84, 3), "vector_observation": (180,), "step_encoding": (16,)},
        ),
    ],
)
def test_the_minor_baselines_observe_and_train(played, changes, parts):
    """6.2.1, and vectors: what is observed is what the network takes, and what an evaluation shows it."""
    args, run, *_ = played(memory="none", **FEW, **changes)
    assert {name: part.shape for name, part in run.envs.single_observation_space.items()} == parts
    assert {name: tuple(part.shape[2:]) for name, part in run.rollout.obs.items()} == parts
    assert evaluated(args, run, max_steps=3)["length"].tolist() == [3] * 6
