"""Evaluation: unseen levels, fresh memory, one episode a lane, and nothing of it in the training."""

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
        assert found["commands_completed"][lane] == info["commands_completed"]


@EACH_SCRIPT
def test_an_environment_s_own_return(played, script, monkeypatch):
    """What its last info calls so does not replace the sum of the rewards."""
    args, run, *_ = played(script=script, env_id="MortarMayhemB-Grid-v0", **FEW)
    before = evaluated(args, run)
    monkeypatch.setattr(evaluation, "final_numbers", lambda infos, done: [("return", done, np.full(done.sum(), -77.0))])
    assert (evaluated(args, run)["return"] == before["return"]).all()


def test_the_memory_is_carried_from_stretch_to_stretch(played):
    """Episodes longer than a stretch: the window's cache, refreshed, is what it was."""
    args, run, *_ = played(script=ppo_trxl, env_id="MysteryPath-Grid-v0", weights_scale=5.0, **FEW)
    whole, short = (evaluated(args, run, max_steps=40, memory_steps=steps) for steps in (1000, 3))
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
    assert [step for step, _ in evaluated["eval/commands_completed"]] == [192, 256]
    assert [step for step, _ in evaluated["eval/return"]] == [192, 256]
    for name in without:
        assert evaluated[name] == without[name], name


def test_other_environments_are_evaluated_too(tiny, scalars):
    curves = scalars(ppo_gru.main(tiny(env_id="CueRecall-v0", eval_interval=1, **FEW)))
    assert len(curves["eval/right"]) == 2
    assert all(0 <= share <= 1 for share in curves["eval/right"])


@pytest.mark.parametrize(
    ("changes", "shape"),
    [
        ({"env_id": "MortarMayhem-Grid-v0", "frame_stack": 4}, {"observation": (84, 84, 4)}),
        ({"env_id": "MortarMayhem-Grid-v0", "obs_type": "vector"}, None),
        ({"env_id": "MysteryPath-Grid-v0", "obs_type": "vector", "frame_stack": 16, "step_encoding": True}, None),
        (
            {"env_id": "MortarMayhemB-Grid-v0", "step_encoding": True},
            {"visual_observation": (84, 84, 3), "vector_observation": (180,), "step_encoding": (16,)},
        ),
    ],
)
@EACH_SCRIPT
def test_the_minor_baselines_observe_and_train(tiny, scalars, script, changes, shape):
    """6.2.1, and vectors: what is observed is trained on, evaluated and saved."""
    args = tiny(script, eval_interval=2, **FEW, **changes, eval_max_steps=5)
    envs = envs_for(args, 2)
    parts = {name: part.shape for name, part in envs.single_observation_space.items()}
    assert shape is None or parts == shape
    assert len(scalars(script.main(args))["eval/return"]) == 1
