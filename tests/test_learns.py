"""Agents with a memory solve a task that one without cannot."""

import numpy as np
import pytest

import ppo_gru

STEPS = 30 * 32 * 52  # 30 iterations
BATCH = {"num_envs": 32, "num_steps": 52, "num_minibatches": 4, "update_epochs": 6, "total_timesteps": STEPS}
RATES = {"init_lr": 2e-3, "final_lr": 1e-4, "init_ent_coef": 1e-2, "final_ent_coef": 1e-3, "anneal_steps": STEPS}
LIMITS = {"clip_coef": 0.2, "max_grad_norm": 0.5, "target_kl": 0.02}
SETTINGS = {**BATCH, **RATES, **LIMITS, "gamma": 0.99, "hidden_size": 64}


@pytest.mark.slow
@pytest.mark.parametrize(("memory", "low", "high"), [("gru", 0.95, 1.0), ("lstm", 0.95, 1.0), ("none", 0.4, 0.6)])
def test_cue_recall(tiny, scalars, memory, low, high):
    """1 for remembering the cue, 0.5 for guessing."""
    curves = scalars(ppo_gru.main(tiny(env_id="CueRecall-v0", memory=memory, **SETTINGS)))
    assert low <= np.mean(curves["charts/episodic_return"][-5:]) <= high
