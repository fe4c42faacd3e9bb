"""--norm-reward: rewards in units of the returns' standard deviation."""

import numpy as np
import pytest
import torch
from conftest import SCRIPTS

from ppo_utils import moments
from ppo_utils.moments import ReturnScale


def test_rewards_are_divided_by_the_deviation_of_returns(monkeypatch):
    """That of the discounted returns of all steps so far, of all processes, each counted from its episode's start."""
    rng, gamma = np.random.default_rng(0), 0.9
    rewards, done = torch.tensor(rng.normal(1, 2, (30, 3))), torch.tensor(rng.random((30, 3)) < 0.2)
    returns, now = np.zeros((30, 3)), np.zeros(3)
    for t in range(30):
        now = returns[t] = now * gamma + rewards[t].numpy()
        now = now * ~done[t].numpy()
    scale = ReturnScale()
    for first in (0, 10, 20):
        now = slice(first, first + 10)
        scaled = scale.scale(rewards[now], done[now], gamma)
        torch.testing.assert_close(scaled, rewards[now] / returns[: first + 10].std())
    assert (scale.count, scale.mean) == (90, pytest.approx(returns.mean()))

    other = rng.normal(5, 1, 40)
    monkeypatch.setattr(moments, "all_gather", lambda mine: [mine, (40, other.mean(), other.var())])
    scaled = ReturnScale().scale(rewards, done, gamma)
    torch.testing.assert_close(scaled, rewards / np.concatenate([returns.ravel(), other]).std())


def test_rewards_without_any_return():
    rewards, done = torch.zeros(5, 2), torch.zeros(5, 2, dtype=torch.bool)
    assert ReturnScale().scale(rewards, done, 0.9).equal(rewards)
    assert ReturnScale().scale(rewards + 3, ~done, 0.9).equal(rewards + 3), "as they are, if all returns are equal"


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_rare_reward_is_clipped_after_scaling(sign):
    """One goal in 1,000 steps: the deviation is 0.03, and the goal would be scaled to 32."""
    rewards = torch.zeros(1000, 1)
    rewards[7] = sign
    rewards[9] = 0.1 * sign
    done = torch.ones(1000, 1, dtype=torch.bool)
    scaled = ReturnScale().scale(rewards, done, 0.9)
    assert scaled[7] == 10 * sign
    assert scaled[9].item() == pytest.approx(0.1 * sign / rewards.std(correction=0).item(), rel=1e-5)
    assert scaled.count_nonzero() == 2


def test_the_scale_goes_on_from_rollout_to_rollout():
    """The discounted sum of an episode that goes on, and begins at zero where it ended."""
    rewards, done = torch.ones(4, 2), torch.tensor([[False, False], [False, True], [False, False], [True, False]])
    whole, halves = ReturnScale(), ReturnScale()
    whole.scale(rewards, done, 0.5)
    for half in (slice(0, 2), slice(2, 4)):
        halves.scale(rewards[half], done[half], 0.5)
    assert halves.discounted.tolist() == whole.discounted.tolist() == [0.0, 1.5]
    assert (halves.count, halves.mean, halves.variance) == pytest.approx((8, whole.mean, whole.variance))


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
def test_after_one_rollout_the_returns_of_the_divided_rewards_have_deviation_one(tiny, opened, script, monkeypatch):
    """With the training's --gamma, and episodes that a time limit ends."""
    changes = {"env_id": "MysteryPath-Grid-v0", "env_options": '{"max_steps": 5, "reward_step": -1.0}', "gamma": 0.5}
    args = tiny(script, obs_type="vector", norm_reward=True, total_timesteps=64, **changes)
    run, seen, gae = opened(script, args), [], script.gae
    monkeypatch.setattr(script, "gae", lambda *given: (seen.extend(given), gae(*given))[1])
    script.train(args, run)
    scaled, rollout, *_ = seen
    assert rollout.done.any()
    returns, now = [], torch.zeros(4)
    for rewards, done in zip(scaled, rollout.done, strict=True):
        returns.append(now * 0.5 + rewards)
        now = returns[-1] * ~done
    assert torch.stack(returns).std(correction=0).item() == pytest.approx(1.0, rel=1e-5)
