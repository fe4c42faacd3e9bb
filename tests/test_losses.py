"""Losses and schedules against values worked out by hand."""

import dataclasses
import math

import pytest
import torch
from torch.distributions import Categorical

import ppo_gru
from ppo_gru import anneal, normalize, policy_loss, ppo_loss, value_loss
from ppo_utils import moments
from ppo_utils.logs import explained_variance, mean_logs, policy_metrics


def test_policy_loss_clips_every_branch_by_itself():
    # One step, advantage 2, ratios 1.5 and 0.9 at clip 0.1: min(3, 2.2) and min(1.8, 1.8).
    log_ratio = torch.tensor([[math.log(1.5), math.log(0.9)]])
    assert policy_loss(log_ratio, torch.tensor([2.0]), 0.1).item() == pytest.approx(-(2.2 + 1.8) / 2)
    # A negative advantage takes the pessimistic side: min(-3, -2.2) and min(-1.8, -1.8).
    assert policy_loss(log_ratio, torch.tensor([-2.0]), 0.1).item() == pytest.approx((3.0 + 1.8) / 2)


def test_policy_loss_is_pessimistic_below_the_range_too():
    # Ratio 0.5, advantage -2, clip 0.1: min(0.5 * -2, 0.9 * -2); with advantage 2: min(0.5 * 2, 0.9 * 2).
    log_ratio = torch.tensor([[math.log(0.5)]])
    assert policy_loss(log_ratio, torch.tensor([-2.0]), 0.1).item() == pytest.approx(1.8)
    assert policy_loss(log_ratio, torch.tensor([2.0]), 0.1).item() == pytest.approx(-1.0)


def test_policy_gradient_vanishes_only_in_the_clipped_branch():
    log_ratio = torch.tensor([[math.log(1.5), 0.0]], requires_grad=True)
    policy_loss(log_ratio, torch.tensor([1.0]), 0.1).backward()
    assert log_ratio.grad.tolist() == [[0.0, -0.5]]


def test_value_loss_is_the_larger_of_clipped_and_unclipped():
    values, old, returns = torch.tensor([1.0, 0.0]), torch.tensor([0.0, 0.0]), torch.tensor([2.0, 1.0])
    # The first value moved by 1, clipped to 0.1: max((1 - 2)^2, (0.1 - 2)^2); the second did not move.
    assert value_loss(values, old, returns, 0.1).item() == pytest.approx((1.9**2 + 1.0) / 2)
    assert value_loss(values, old, returns, None).item() == pytest.approx(1.0)


@pytest.fixture
def barrier_loss(played, monkeypatch):
    """The loss and its logs of a policy, of which only the log-barrier's part is not zero."""

    def loss_of(policy, ent_coef=1.0):
        args, run, *_ = played(env_id="CueRecall-v0", vf_coef=0.0, exploration_bonus="log-barrier")
        steps, log_probs = run.rollout.values.numel(), run.rollout.log_probs.flatten(0, 1)
        policy = [Categorical(logits=branch.logits.expand(steps, -1)) for branch in policy]
        recomputed = policy, log_probs, run.rollout.values.flatten(), torch.zeros(steps, 1)
        monkeypatch.setattr(run.agent, "evaluate_actions", lambda *_: recomputed)
        pieces = run.agent.memory.cut(run.rollout.done)
        run.rollout.returns = run.rollout.values
        run.rollout.advantages = torch.zeros_like(run.rollout.values)
        return ppo_loss(run.agent, run.rollout, pieces, ent_coef, args)

    return loss_of


def test_log_barrier_is_a_sum_over_branches_of_means_over_actions(barrier_loss):
    policy = [Categorical(probs=torch.tensor(probs)) for probs in ([0.2, 0.8], [0.1, 0.3, 0.6])]
    expected = math.log(0.2 * 0.8) / 2 + math.log(0.1 * 0.3 * 0.6) / 3
    loss, logs = barrier_loss(policy, ent_coef=5.0)
    assert logs["log_barrier"].item() == pytest.approx(expected)
    assert loss.item() == pytest.approx(-5.0 * expected)


def test_only_the_log_barrier_brings_back_an_action_whose_probability_is_zero(barrier_loss):
    """With logits 40 apart, no gradient of the surrogate or of the entropy is left; the barrier's is 1/3 - p."""
    logits = torch.tensor([40.0, 0.0, 0.0], requires_grad=True)
    policy, taken = Categorical(logits=logits), torch.tensor(0)
    surrogate = policy_loss(policy.log_prob(taken)[None, None], torch.tensor([-1.0]), 0.2)
    for objective in (surrogate, policy.entropy()):
        (gradient,) = torch.autograd.grad(objective, logits, retain_graph=True)
        assert gradient.abs().max() < 1e-15
    (gradient,) = torch.autograd.grad(barrier_loss([policy])[0], logits)
    torch.testing.assert_close(-gradient, torch.tensor([1 / 3 - 1, 1 / 3, 1 / 3]))


@pytest.mark.parametrize(("step", "expected"), [(0, 1.0), (50, 0.6), (100, 0.2), (1000, 0.2)])
def test_anneal_decays_linearly_then_stays(step, expected):
    assert anneal(step, 1.0, 0.2, 100) == pytest.approx(expected)


def test_no_anneal_steps_keep_the_initial_value():
    assert anneal(10**9, 1.0, 0.2, 0) == 1.0


def test_explained_variance():
    returns = torch.tensor([0.0, 1.0, 2.0, 3.0])
    assert explained_variance(returns, returns) == 1.0
    assert explained_variance(torch.zeros(4), returns) == pytest.approx(0.0)
    assert math.isnan(explained_variance(returns, torch.ones(4)))


def test_the_total_loss_is_composed_as_in_equation_5_7(played):
    args, run, *_ = played(env_id="CueRecall-v0", vf_coef=3.0)
    rollout, agent = run.rollout, run.agent
    with torch.no_grad():
        for parameter in agent.heads.policy[-1].parameters():
            parameter.zero_()
        rollout.log_probs.fill_(math.log(0.5))  # what this uniform policy would have stored
    pieces = agent.memory.cut(rollout.done)
    rollout.advantages, rollout.returns = rollout.rewards + 1, rollout.rewards
    loss, logs = ppo_loss(agent, rollout, pieces, 5.0, args)
    assert logs["entropy"].item() == pytest.approx(2 * math.log(2)), "the sum over both branches"
    assert logs["log_barrier"].item() == pytest.approx(2 * math.log(0.5)), "the same"
    assert logs["policy_loss"].item() == pytest.approx(-rollout.advantages.mean().item())
    parts = logs["policy_loss"] + 3.0 * logs["value_loss"] - 5.0 * logs["entropy"]
    assert loss.item() == pytest.approx(parts.item())
    barrier = dataclasses.replace(args, exploration_bonus="log-barrier")
    other = ppo_loss(agent, rollout, pieces, 5.0, barrier)[0]
    assert (other - loss).item() == pytest.approx(5.0 * (logs["entropy"] - logs["log_barrier"]).item())
    normalize = dataclasses.replace(args, norm_adv="minibatch")
    normalized = ppo_loss(agent, rollout, pieces, 5.0, normalize)[1]
    assert normalized["policy_loss"].item() == pytest.approx(0.0, abs=1e-5), "advantages of mean zero"


@pytest.mark.parametrize("clip_vloss", [True, False])
def test_values_are_clipped_around_the_rollout_s(played, clip_vloss):
    """All returns are 2 above the rollout's values, and the present values 1: clipped at 0.1, they miss 1.9."""
    args, run, *_ = played(env_id="CueRecall-v0", clip_vloss=clip_vloss, clip_coef=0.1)
    rollout, agent = run.rollout, run.agent
    pieces = agent.memory.cut(rollout.done)
    rollout.values -= 1
    rollout.returns = rollout.values + 2
    logs = ppo_loss(agent, rollout, pieces, 0.0, args)[1]
    assert logs["value_loss"].item() == pytest.approx(1.9**2 if clip_vloss else 1.0, rel=1e-4)


PROBES = {"ground_truth_coef": 100.0, "reconstruction_coef": 100.0, "auxiliary_detach": True}


PARTS = ("estimator", "decoder")


@pytest.mark.parametrize("max_grad_norm", [0.25, 1e9])
def test_a_gradient_step_is_no_longer_than_its_norm_allows(played, max_grad_norm):
    """By plain gradient descent with rate 1, a step is the gradient; that of a detached head is clipped by itself."""
    changes = {"env_id": "MortarMayhem-Grid-v0", "num_minibatches": 1, "update_epochs": 1}
    args, run, *_ = played(**changes, **PROBES, max_grad_norm=max_grad_norm)
    rollout, agent = run.rollout, run.agent
    rollout.returns = rollout.values + 100
    before = {name: weight.clone() for name, weight in agent.state_dict().items()}
    (logs,), _ = ppo_gru.update(agent, [torch.optim.SGD(agent.parameters(), lr=1.0)], rollout, 0.0, args)
    steps = {name: (weight - before[name]).flatten() for name, weight in agent.state_dict().items()}
    for head in ("estimator", "decoder", None):
        own = [step for name, step in steps.items() if head == next((h for h in PARTS if name.startswith(h)), None)]
        step = torch.cat(own).norm()
        assert step > 0.2
        assert (step <= max_grad_norm * 1.001) if max_grad_norm < 1 else (step > 2)
        if head is None:
            assert logs["grad_norm"] > 2, "what is logged is the norm before it is clipped"
            assert step.item() == pytest.approx(min(max_grad_norm, logs["grad_norm"].item()), rel=1e-3)


def test_logs_are_means_over_minibatches():
    """Of the last one, --target-kl ended the update before its gradient step."""
    steps = [{"loss": 1.0, "grad_norm": 2.0, "ratio_error": 0.25}, {"loss": 4.0, "grad_norm": 6.0, "ratio_error": 9.0}]
    steps.append({"loss": 10.0, "ratio_error": 1.0})
    steps = [{name: torch.tensor(value) for name, value in step.items()} for step in steps]
    values = torch.tensor([[0.0], [1.0]])
    found = mean_logs(steps, values, values)
    assert found == {
        "losses/loss": 5.0,
        "losses/grad_norm": 4.0,
        "losses/ratio_error": 0.25,  # before the first gradient step
        "losses/explained_variance": 1.0,
        "charts/gradient_steps": 2,
    }


@pytest.mark.parametrize("name", ["loss", "grad_norm"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_one_number_that_is_not_finite_ends_the_training(name, value):
    steps = [{"loss": torch.tensor(1.0), "grad_norm": torch.tensor(1.0), "ratio_error": torch.tensor(0.0)}] * 3
    steps = [*steps, steps[0] | {name: torch.tensor(value)}]
    with pytest.raises(FloatingPointError, match="the loss or its gradient is not finite"):
        mean_logs(steps, torch.zeros(2), torch.zeros(2))


def test_advantages_are_normalized_by_minibatch_or_by_rollout(tiny, opened, monkeypatch):
    """By rollout, its advantages have mean 0 and deviation 1, once; the returns stay."""
    surrogate, update = ppo_gru.policy_loss, ppo_gru.update
    for how in ("batch", "minibatch"):
        seen, learned = [], []
        monkeypatch.setattr(
            ppo_gru, "policy_loss", lambda *given, seen=seen: (seen.append(given[1]), surrogate(*given))[1]
        )
        monkeypatch.setattr(
            ppo_gru, "update", lambda *given, learned=learned: (learned.append(given[2]), update(*given))[1]
        )
        args = tiny(env_id="CueRecall-v0", norm_adv=how, total_timesteps=64)
        run = opened(ppo_gru, args)
        ppo_gru.train(args, run)
        (rollout,) = learned
        advantages = ppo_gru.gae(rollout.rewards, rollout, args.gamma, args.gae_lambda)
        torch.testing.assert_close(rollout.returns, advantages + rollout.values)
        if how == "batch":
            wanted = (advantages - advantages.mean()) / advantages.std(correction=0)
            torch.testing.assert_close(rollout.advantages, wanted)
            whole = torch.cat(seen[: args.num_minibatches]).sort().values
            torch.testing.assert_close(whole, rollout.advantages.flatten().sort().values)
        else:
            assert len(seen) > 1
            for each in seen:
                assert each.mean().item() == pytest.approx(0.0, abs=1e-5)
                assert each.std(correction=0).item() == pytest.approx(1.0, abs=1e-4)


def test_advantages_are_normalized_over_all_processes(monkeypatch):
    ours, theirs = torch.randn(2, 50) * torch.tensor([[1.0], [3.0]]) + torch.tensor([[0.0], [5.0]])
    monkeypatch.setattr(
        moments, "all_gather", lambda mine: [mine, (50, theirs.mean().item(), theirs.var(correction=0).item())]
    )
    both = torch.cat([ours, theirs])
    torch.testing.assert_close(normalize(ours), (ours - both.mean()) / both.std(correction=0))


@pytest.mark.parametrize("log_ratio", [89.0, 1000.0])
@pytest.mark.parametrize("advantage", [0.0, 1.0, -1.0])
def test_a_huge_ratio_gives_a_finite_loss_and_gradient(log_ratio, advantage):
    log_ratio = torch.full((1, 1), log_ratio, requires_grad=True)
    loss = policy_loss(log_ratio, torch.tensor([advantage]), 0.1)
    loss.backward()
    assert loss.isfinite()
    assert log_ratio.grad.isfinite().all()
    if advantage >= 0:
        assert loss.item() == pytest.approx(-1.1 * advantage)


def test_the_clipped_share_is_that_of_ratios():
    """Between exp(-clip) and 1 - clip, the log-ratio is within the range and the ratio is not."""
    for ratio, clipped in ((0.899, 1.0), (0.902, 0.0), (1.098, 0.0), (1.102, 1.0)):
        assert policy_metrics(torch.tensor([[ratio]]).log(), 0.1)["clipfrac"] == clipped
