"""Agents with a memory solve a task that one without cannot."""

import numpy as np
import pytest

import ppo_gru

ITERATIONS = 50
BATCH = {"num_envs": 32, "num_steps": 52, "num_minibatches": 8}
STEPS = ITERATIONS * BATCH["num_envs"] * BATCH["num_steps"]
RATES = {"init_lr": 3e-3, "final_lr": 1e-4, "init_ent_coef": 1e-2, "final_ent_coef": 1e-3, "anneal_steps": STEPS}
SETTINGS = {**BATCH, **RATES, "total_timesteps": STEPS, "gamma": 0.99, "hidden_size": 64, "update_epochs": 3}


@pytest.mark.slow
@pytest.mark.parametrize(("memory", "low", "high"), [("gru", 0.95, 1.0), ("lstm", 0.95, 1.0), ("none", 0.4, 0.6)])
def test_cue_recall(tiny, scalars, memory, low, high):
    """Two cues of two kinds: 1 for remembering both, 0.5 for guessing."""
    curves = scalars(ppo_gru.main(tiny(env_id="CueRecall-v0", memory=memory, **SETTINGS)))
    assert low <= np.mean(curves["charts/episodic_return"][-5:]) <= high
