"""What holds on a CPU holds on a GPU: `pytest tests/gpu.py` on a machine that has one."""

import copy
import os
import subprocess
import sys
from dataclasses import fields, is_dataclass, replace

import pytest
import torch
from conftest import SCRIPTS
from test_memory import MEMORIES, each_memory, recompute

import evaluate
import ppo_gru

PIXELS = {"env_id": "MortarMayhemB-Grid-v0", "cuda": True}


@pytest.fixture(autouse=True)
def _all_digits(monkeypatch):
    """Compute in float32 where a training has TF32, which has three decimal digits."""
    assert torch.cuda.is_available(), "these tests need a GPU"
    monkeypatch.setattr(torch, "set_float32_matmul_precision", lambda precision: None)
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)


def moved(value, device):
    """Return a copy of a dataclass, a dict or a tensor on another device; what lies on the CPU by design stays."""
    if isinstance(value, torch.Tensor):
        return value.to(device) if value.is_cuda else value
    if isinstance(value, list):
        return [moved(part, device) for part in value]
    if isinstance(value, dict):
        return {name: moved(part, device) for name, part in value.items()}
    if is_dataclass(value):
        return replace(value, **{each.name: moved(getattr(value, each.name), device) for each in fields(value)})
    return value


def gradient(script, agent, rollout, args):
    """Return the gradient of the loss of a whole rollout, as one vector on the CPU."""
    pieces = agent.memory.cut(rollout.done.cpu())
    agent.zero_grad()
    loss, _ = script.ppo_loss(agent, rollout, pieces, 0.01, args)
    loss.backward()
    return torch.cat([each.grad.flatten().cpu() for each in agent.parameters() if each.grad is not None])


@each_memory(MEMORIES)
def test_ratio_is_one_for_every_sample(played, memory):
    _, run, *_ = played(iterations=3, weights_scale=3.0, **PIXELS, **memory)
    assert run.rollout.values.is_cuda
    _, ratio, _ = recompute(run)
    assert (ratio - 1).abs().max() < 1e-4


@each_memory(MEMORIES)
def test_the_gradient_is_that_of_a_cpu(played, memory):
    changes = {"reconstruction_coef": 0.1, **PIXELS, **memory}
    args, run, *_ = played(iterations=2, weights_scale=3.0, **changes)
    run.rollout.advantages.normal_()
    run.rollout.returns = run.rollout.advantages + run.rollout.values
    script = memory.get("script", ppo_gru)
    ours = gradient(script, run.agent, run.rollout, args)
    agent = copy.deepcopy(run.agent).cpu()
    theirs = gradient(script, agent, moved(run.rollout, "cpu"), args)
    assert theirs.norm() > 1e-3
    assert (ours - theirs).norm() < 1e-4 * theirs.norm()


@pytest.mark.parametrize("amp", [False, True])
@pytest.mark.parametrize("script", SCRIPTS)
def test_training_scoring_and_going_on(tiny, scalars, script, amp):
    env = {"eval_interval": 1, "eval_levels": 2, "save_model": True, "amp": amp, **PIXELS}
    folder = script.main(tiny(script, **env))
    logs = scalars(folder)
    assert len(logs["losses/loss"]) == 2
    assert max(logs["losses/ratio_error"]) < (5e-2 if amp else 1e-4)
    evaluate.main(evaluate.Config(checkpoints=(str(folder / "model.pt"),), levels=2, repeats=1))
    for steps, device in ((256, "0"), (384, ""), (512, "0")):  # GPU, CPU, GPU again
        flags = ["--resume", str(folder), "--total-timesteps", str(steps)]
        environment = os.environ | ({"CUDA_VISIBLE_DEVICES": ""} if not device else {})
        subprocess.run([sys.executable, script.__file__, *flags], env=environment, check=True)
    logs = scalars(folder)
    assert len(logs["losses/loss"]) == 8


@each_memory(MEMORIES)
def test_same_seed_same_curves(tiny, curves, memory):
    args = dict(memory)
    script = args.pop("script", ppo_gru)
    runs = [curves(script.main(tiny(script, **PIXELS, **args, exp_name=name))) for name in "ab"]
    assert runs[0] == runs[1]


def test_too_little_memory_is_one_line(tiny, opened):
    with pytest.raises(Exception, match="does not fit in the memory of cuda") as error:
        opened(ppo_gru, tiny(ppo_gru, **PIXELS, num_envs=64, num_steps=100_000_000, total_timesteps=6_400_000_000))
    assert "--num-steps" in str(error.value)
