"""Agents with a memory solve a task that one without cannot."""

import numpy as np
import pytest

import ppo_gru
import ppo_trxl

STEPS = 30 * 32 * 52  # 30 iterations
BATCH = {"num_envs": 32, "num_steps": 52, "num_minibatches": 4, "update_epochs": 6, "total_timesteps": STEPS}
RATES = {"init_lr": 2e-3, "final_lr": 1e-4, "init_ent_coef": 1e-2, "final_ent_coef": 1e-3, "anneal_steps": STEPS}
LIMITS = {"clip_coef": 0.2, "max_grad_norm": 0.5, "target_kl": 0.02}
SETTINGS = {**BATCH, **RATES, **LIMITS, "env_id": "CueRecall-v0", "gamma": 0.99}
WINDOW = {"trxl_num_layers": 1, "trxl_memory_length": 16, "trxl_segment_length": 52}


def final_return(scalars, script, args):
    """1 for remembering the cue, 0.5 for guessing."""
    return np.mean(scalars(script.main(args))["charts/episodic_return"][-5:])


@pytest.mark.slow
@pytest.mark.parametrize(("memory", "low", "high"), [("gru", 0.95, 1.0), ("lstm", 0.95, 1.0), ("none", 0.4, 0.6)])
def test_recurrent_memory(tiny, scalars, memory, low, high):
    assert low <= final_return(scalars, ppo_gru, tiny(memory=memory, hidden_size=64, **SETTINGS)) <= high


@pytest.mark.slow
@pytest.mark.parametrize(
    ("encoding", "gate"),
    [("absolute", "none"), ("learned", "none"), ("relative", "none"), ("none", "none"), ("absolute", "gru")],
)
def test_transformer_memory(tiny, scalars, encoding, gate):
    args = tiny(ppo_trxl, trxl_positional_encoding=encoding, trxl_gate=gate, **WINDOW, **SETTINGS)
    assert final_return(scalars, ppo_trxl, args) >= 0.95


@pytest.mark.slow
@pytest.mark.parametrize(("script", "memory"), [(ppo_gru, {"hidden_size": 64}), (ppo_trxl, WINDOW)])
def test_with_bfloat16(tiny, scalars, script, memory):
    # When the task is solved differs from processor to processor: 50 iterations instead of 30.
    steps = STEPS * 5 // 3
    settings = {**SETTINGS, "total_timesteps": steps, "anneal_steps": steps, "amp": True}
    assert final_return(scalars, script, tiny(script, **memory, **settings)) >= 0.95
