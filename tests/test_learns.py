"""Agents with a memory solve a task that one without cannot."""

import numpy as np
import pytest

import ppo_gru
import ppo_trxl

STEPS = 50 * 16 * 24  # 50 iterations at most: when the task is solved differs from processor to processor
BATCH = {"num_envs": 16, "num_steps": 24, "num_minibatches": 4, "update_epochs": 6, "total_timesteps": STEPS}
RATES = {"init_lr": 4e-3, "final_lr": 1e-4, "init_ent_coef": 1e-3, "final_ent_coef": 1e-3, "anneal_steps": STEPS}
LIMITS = {"value_init_gain": 0.01, "clip_coef": 0.2, "max_grad_norm": 0.5}
SETTINGS = {**BATCH, **RATES, **LIMITS, "env_id": "CueRecall-v0", "env_kwargs": '{"blanks": [4, 7]}', "gamma": 0.99}
RECURRENT = SETTINGS | {"init_lr": 6e-3, "max_grad_norm": 1.0}
WINDOW = {"trxl_num_layers": 1, "trxl_memory_length": 8, "trxl_segment_length": 24}


@pytest.fixture
def trained(monkeypatch):
    """Train until the mean return of five iterations is 0.95, but no longer than a training; return that mean.

    It is 1 for remembering the cue, 0.5 for guessing.
    """

    def train(script, args):
        end_iteration, returns = script.end_iteration, []

        def end_or_stop(args, run, logs, episodes, times):
            returns.append(np.mean(episodes["charts/episodic_return"]))
            end_iteration(args, run, logs, episodes, times)
            run.stop |= len(returns) >= 5 and np.mean(returns[-5:]) >= 0.95

        monkeypatch.setattr(script, "end_iteration", end_or_stop)
        script.main(args)
        return np.mean(returns[-5:])

    return train


@pytest.mark.slow
def test_recurrent_memory(tiny, trained):
    assert trained(ppo_gru, tiny(**RECURRENT)) >= 0.95


@pytest.mark.slow
def test_no_memory(tiny, trained):
    args = tiny(memory="none", **RECURRENT | {"total_timesteps": STEPS // 5})
    assert 0.4 <= trained(ppo_gru, args) <= 0.6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("encoding", "gate"),
    [("absolute", "none"), ("learned", "gru"), ("relative", "none")],
)
def test_transformer_memory(tiny, trained, encoding, gate):
    args = tiny(ppo_trxl, trxl_positional_encoding=encoding, trxl_gate=gate, **WINDOW, **SETTINGS)
    assert trained(ppo_trxl, args) >= 0.95


@pytest.mark.slow
def test_with_bfloat16(tiny, trained):
    """With small heads: products of large matrices take 30 times as long on a processor that has no bfloat16."""
    assert trained(ppo_trxl, tiny(ppo_trxl, **WINDOW, **SETTINGS, amp=True)) >= 0.95
