"""--norm-reward: rewards in units of the returns' standard deviation."""

import numpy as np
import pytest
import torch
from conftest import SCRIPTS

import ppo_gru


@pytest.mark.parametrize("script", SCRIPTS)
def test_rewards_are_divided_by_the_deviation_of_returns(script, monkeypatch):
    """That of the discounted returns of all steps so far, of all processes, each counted from its episode's start."""
    rng, gamma = np.random.default_rng(0), 0.9
    rewards, done = torch.tensor(rng.normal(1, 2, (30, 3))), torch.tensor(rng.random((30, 3)) < 0.2)
    returns, now = np.zeros((30, 3)), np.zeros(3)
    for t in range(30):
        now = returns[t] = now * gamma + rewards[t].numpy()
        now = now * ~done[t].numpy()
    scale = script.ReturnScale(torch.zeros(3, dtype=torch.float64))
    for first in (0, 10, 20):
        found = scale.update(rewards[first : first + 10], done[first : first + 10], gamma)
        assert found == pytest.approx(returns[: first + 10].std())
    assert (scale.count, scale.mean) == (90, pytest.approx(returns.mean()))

    other = rng.normal(5, 1, 40)
    monkeypatch.setattr(script, "all_gather", lambda mine: [mine, (40, other.mean(), other.var())])
    found = script.ReturnScale(torch.zeros(3, dtype=torch.float64)).update(rewards, done, gamma)
    assert found == pytest.approx(np.concatenate([returns.ravel(), other]).std())


def test_rewards_without_any_return():
    scale = ppo_gru.ReturnScale(torch.zeros(2))
    assert scale.update(torch.zeros(5, 2), torch.zeros(5, 2, dtype=torch.bool), 0.9) == 1.0


@pytest.mark.parametrize("script", SCRIPTS)
def test_the_scale_of_rewards_changes_nothing(tiny, curves, script):
    """With --norm-reward, rewards of 0.1 and of 1 are learned from alike; what is logged of episodes is not divided."""
    args = {"env_id": "MortarMayhemB-Grid-v0", "norm_reward": True, "clip_vloss": False}
    small, large = (
        curves(script.main(tiny(script, env_options=f'{{"reward_command_success": {reward}}}', **args)))
        for reward in (0.125, 1.0)  # powers of two: the division rounds nothing away
    )
    for name in ("losses/policy_loss", "losses/value_loss", "losses/grad_norm"):
        assert small[name] == large[name], name
    assert [8 * value for _, value in small["charts/episodic_return"]] == pytest.approx(
        [value for _, value in large["charts/episodic_return"]]
    )


@pytest.mark.parametrize("script", SCRIPTS)
def test_after_one_rollout_the_returns_of_the_divided_rewards_have_deviation_one(tiny, opened, script):
    """With the training's --gamma, and episodes that a time limit ends."""
    changes = {"env_id": "MysteryPath-Grid-v0", "env_options": '{"max_steps": 5, "reward_step": -1.0}', "gamma": 0.5}
    args = tiny(script, obs_type="vector", norm_reward=True, total_timesteps=64, **changes)
    run = opened(script, args)
    script.train(args, run)
    assert run.rollout.truncated.any()
    returns, now = [], torch.zeros(4)
    for rewards, done in zip(run.rollout.rewards, run.rollout.done, strict=True):
        returns.append(now * 0.5 + rewards)
        now = returns[-1] * ~done
    assert torch.stack(returns).std(correction=0).item() == pytest.approx(1.0, rel=1e-5)
