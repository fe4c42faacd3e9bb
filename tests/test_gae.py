"""Advantages against values worked out by hand: gamma 0.5, lambda 0.5, one lane, three steps."""

from types import SimpleNamespace

import pytest
import torch

from ppo_gru import gae


def advantages(terminated=(), truncated=(), truncation_values=(0, 0, 0), rewards=(1.0, 2.0, 3.0)):
    ends = torch.zeros(2, 3, 1, dtype=torch.bool)
    ends[0, list(terminated)] = True
    ends[1, list(truncated)] = True
    rollout = SimpleNamespace(
        last_value=torch.tensor([10.0]),
        values=torch.tensor([[4.0], [6.0], [8.0]]),
        done=ends[0] | ends[1],
        truncation_values=torch.tensor(truncation_values, dtype=torch.float32)[:, None],
    )
    return gae(torch.tensor(rewards)[:, None], rollout, 0.5, 0.5)[:, 0].tolist()


# Deltas without an end: 1 + 3 - 4 = 0, 2 + 4 - 6 = 0, 3 + 5 - 8 = 0; with an end at step 1: 2 - 6 = -4 there.
def test_no_end():
    assert advantages() == [0.0, 0.0, 0.0]


def test_termination_cuts_value_and_trace():
    assert advantages(terminated=[1]) == pytest.approx([0.25 * -4, -4.0, 0.0])


def test_truncation_counts_as_an_end():
    assert advantages(truncated=[1]) == pytest.approx([0.25 * -4, -4.0, 0.0])


def test_bootstrapped_truncation_values_the_final_observation_and_cuts_the_trace():
    # 2 + 0.5 * 20 - 6 = 6; nothing of the next episode's step 2 flows back.
    found = advantages(truncated=[1], truncation_values=(0, 20, 0), rewards=(1.0, 2.0, 103.0))
    assert found == pytest.approx([0.25 * 6, 6.0, 100.0])


def test_end_at_the_last_step_ignores_the_value_of_what_follows():
    assert advantages(terminated=[2]) == pytest.approx([0.25 * 0.25 * -5, 0.25 * -5, -5.0])


@pytest.mark.parametrize("end", ["terminated", "truncated"])
def test_nothing_after_an_end_flows_back(end):
    """The step after the end earns 100 more than expected: that is its own advantage, and no earlier step's."""
    assert advantages(**{end: [1]}, rewards=(1.0, 2.0, 103.0)) == pytest.approx([0.25 * -4, -4.0, 100.0])
    assert advantages(rewards=(1.0, 2.0, 103.0)) == pytest.approx([0.25 * 0.25 * 100, 0.25 * 100, 100.0])


def test_lanes_do_not_mix():
    zeros, none = torch.zeros(3, 2), torch.zeros(3, 2, dtype=torch.bool)
    values = torch.tensor([[1.0, 0.0]] * 3)
    rollout = SimpleNamespace(values=values, last_value=torch.zeros(2), done=none, truncation_values=zeros)
    result = gae(zeros, rollout, 0.9, 0.9)
    assert (result[:, 0] != 0).all()
    assert (result[:, 1] == 0).all()
