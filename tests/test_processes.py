"""Several processes that torchrun starts train one agent; here two, on the CPU."""

import copy
import itertools
import os
import random
import re
import signal
from pathlib import Path

import cue_recall
import numpy as np
import programs
import pytest
import torch
from conftest import collect, parse_args
from programs import run_together

import ppo_gru
import ppo_trxl
from ppo_utils import environments, processes, runs
from ppo_utils.checkpoints import read_checkpoint, read_model
from ppo_utils.logs import combine_logs, mean_logs

SCRIPTS = [ppo_gru, ppo_trxl]
GRID = {"env_id": "MortarMayhemB-Grid-v0", "obs_type": "vector"}
WIDTH = {ppo_gru: "--hidden-size 16", ppo_trxl: "--trxl-dim 16 --trxl-memory-length 7"}
ONE_UPDATE = """
import importlib
from dataclasses import replace
import torch
from ppo_utils.logs import mean_logs
from ppo_utils.processes import rank_and_size
from ppo_utils.runs import close
updated = []
for name, args, weights, rollout in torch.load("given.pt", weights_only=False):
    script = importlib.import_module(name)
    run = script.setup(args)
    rank, processes = rank_and_size()
    run.agent.load_state_dict(weights)
    lanes = torch.arange(args.num_envs).chunk(processes)[rank]
    # Two processes, 4 lanes each: lanes are the second axis of a rollout.
    share = {name: part[:, lanes] for name, part in rollout.items() if isinstance(part, torch.Tensor)}
    share["obs"] = {name: part[:, lanes] for name, part in rollout["obs"].items()}
    stored = ("stored",) if script.__name__ == "ppo_gru" else ("hidden", "row_step")
    state = rollout["memory_state"]
    state = replace(state, **{name: getattr(state, name)[:, lanes] for name in stored})
    rollout = script.Rollout(**rollout | share | {"memory_state": state})
    optimizer = torch.optim.SGD(run.agent.parameters(), lr=1.0)
    step_logs, _ = script.update(run.agent, [optimizer], rollout, 0.01, args)
    logs = mean_logs(step_logs, rollout.values, rollout.returns)
    updated.append((run.agent.state_dict(), logs))
torch.save(updated, f"updated{rank}.pt")
close(run)
"""


def train_together(path, *flags):
    """Run a program in two processes that are those of torchrun but for their imports; return what each printed."""
    done = run_together(programs.command(path, *flags))
    for each in done:
        assert each.returncode == 0, each.stderr
    return done


def flags_of(script, **changes):
    flags = {"env-id": GRID["env_id"], "obs-type": "vector", "num-envs": 4, "num-steps": 16, "num-minibatches": 2}
    flags |= {"trunk-size": 16, "total-timesteps": 6 * 64, **changes}
    return [*WIDTH[script].split(), "--no-cuda", *(part for k, v in flags.items() for part in (f"--{k}", str(v)))]


def rollout_to_learn_from(script, args, run):
    """Play two rollouts, with random advantages and returns; return all that another process needs of it."""
    for _ in range(2):
        collect(script, run, args)
    run.rollout.advantages = torch.randn(run.rollout.values.shape)
    run.rollout.returns = run.rollout.values + torch.randn(run.rollout.values.shape)
    given = {**vars(run.rollout), "last_value": None, "first_occurrence": None}
    weights = {name: weight.clone() for name, weight in run.agent.state_dict().items()}
    return script.__name__, args, weights, copy.deepcopy(given)


def test_two_processes_make_the_update_of_one(tiny, opened):
    """Given the same rollouts, each half of the lanes; one gradient step.

    By plain gradient descent: AdamW divides a gradient by its size, also where that is no more than rounding.
    """
    few = {"num_envs": 8, "num_minibatches": 1, "update_epochs": 1, "num_steps": 16, "total_timesteps": 128}
    given, alone = [], []
    for script, obs_type in itertools.product(SCRIPTS, ["vector", "pixels"]):
        args = tiny(script, **GRID | {"obs_type": obs_type}, **few)
        run = opened(script, args)
        given.append(rollout_to_learn_from(script, args, run))
        optimizer = torch.optim.SGD(run.agent.parameters(), lr=1.0)
        step_logs, _ = script.update(run.agent, [optimizer], run.rollout, 0.01, args)
        logs = mean_logs(step_logs, run.rollout.values, run.rollout.returns)
        alone.append((run.agent.state_dict(), logs))
    torch.save(given, "given.pt")

    Path("program.py").write_text(ONE_UPDATE)
    train_together("program.py")
    updated = zip(*(torch.load(f"updated{rank}.pt") for rank in (0, 1)), given, alone, strict=True)
    for (first, logs), (second, _), (_, _, before, _), (wanted, wanted_logs) in updated:
        for name, weight in wanted.items():
            assert first[name].equal(second[name]), "both processes have the same weights"
            torch.testing.assert_close(first[name], weight, rtol=0, atol=1e-6)
        assert any((weight - before[name]).abs().max() > 1e-3 for name, weight in first.items()), "there was a step"
        assert logs["losses/grad_norm"] == pytest.approx(wanted_logs["losses/grad_norm"], rel=1e-5)


@pytest.mark.parametrize("obs_type", ["vector", "pixels"])
def test_gradients_are_means_over_steps(monkeypatch, tiny, opened, obs_type):
    """Of 3 steps here and 1 step there, not of two halves; in memory as the weights, which fused AdamW relies on."""
    run = opened(ppo_gru, tiny(**GRID | {"obs_type": obs_type}))
    for parameter in run.agent.parameters():
        parameter.grad = torch.full_like(parameter, 4.0)
    monkeypatch.setattr(processes.dist, "is_initialized", lambda: True)
    monkeypatch.setattr(processes.dist, "all_reduce", lambda flat: flat.add_(torch.full_like(flat, 8.0).index_fill_(
        0, torch.tensor([len(flat) - 1]), 1.0)))  # fmt: skip
    processes.average_gradients(run.agent, 3)
    monkeypatch.undo()
    for parameter in run.agent.parameters():
        assert (parameter.grad == (3 * 4.0 + 8.0) / 4).all()
        assert parameter.grad.shape == parameter.shape
        assert parameter.grad.stride() == parameter.stride()


def test_no_thread_of_the_group_outlives_the_training():
    """Where one is still there when the interpreter ends, the process may abort."""
    Path("threads.py").write_text("""
import sys
from pathlib import Path
import ppo_gru
from ppo_utils.runs import parse_args
ppo_gru.main(parse_args(ppo_gru.Args, ppo_gru.PRESETS, sys.argv[1:]))
print([name for task in Path("/proc/self/task").iterdir() if "gloo" in (name := (task / "comm").read_text())])
""")
    done = train_together("threads.py", *flags_of(ppo_gru), "--total-timesteps", "128")
    assert [re.findall(r"\[.*?\]", each.stdout) for each in done] == [["[]"], ["[]"]]


def test_processes_play_shares_of_the_lanes_of_one(tiny, monkeypatch):
    args = tiny(env_id="MortarMayhem-v0", num_levels=0)
    alone, seeds = environments.training_envs(args, None), []
    for rank in (0, 1):
        monkeypatch.setattr(environments, "rank_and_size", lambda rank=rank: (rank, 2))
        seeds += environments.training_envs(args, None).np_random_seed
    assert len({*seeds}) == 4
    assert seeds == list(alone.np_random_seed)


def test_processes_have_the_same_weights_and_other_global_generators(tiny, monkeypatch):
    """Also where resets draw as many of torch's numbers as the seed says."""
    reset, drawn = cue_recall.CueRecall.reset, []

    def draw(env, **given):
        results = reset(env, **given)
        torch.rand(int(env.np_random.integers(1, 100)))
        return results

    monkeypatch.setattr(cue_recall.CueRecall, "reset", draw)
    for rank in (0, 1, 2):
        monkeypatch.setattr(runs, "rank_and_size", lambda rank=rank: (rank, 3))
        runs.prepare(tiny(env_id="CueRecall-v0"), "ppo_gru")[0].envs.close()
        drawn.append((torch.rand(1).item(), np.random.rand(), random.random()))  # noqa: NPY002
    assert [len({*each}) for each in zip(*drawn, strict=True)] == [1, 3, 3]


def test_a_maximum_is_the_maximum_of_all_processes():
    logs = [{"losses/ratio_error": 40.0, "losses/loss": 1.0}, {"losses/ratio_error": 100.0, "losses/loss": 2.0}]
    combined, episodes = combine_logs([(logs[0], {"a": [1.0]}), (logs[1], {"a": [2.0], "b": [3.0]})])
    assert combined == {"losses/ratio_error": 100.0, "losses/loss": 1.5}
    assert episodes == {"a": [1.0, 2.0], "b": [3.0]}


@pytest.mark.parametrize(("others", "steps"), [(0.0, 4), (1.0, 1)])
def test_target_kl_is_compared_with_the_mean_of_all_processes(tiny, opened, monkeypatch, others, steps):
    """Here two; what this one has is far below the target."""
    args = tiny(**GRID, target_kl=0.4, init_lr=1e-6, total_timesteps=64)
    run = opened(ppo_gru, args)
    collect(ppo_gru, run, args)
    run.rollout.advantages, run.rollout.returns = torch.zeros(2, *run.rollout.values.shape)
    monkeypatch.setattr(ppo_gru, "all_gather", lambda kl: [kl, others])
    logs, _ = ppo_gru.update(run.agent, run.optimizers, run.rollout, 0.0, args)
    assert sum("grad_norm" in each for each in logs) == steps


def test_a_resumed_run_is_the_unstopped_one(curves):
    script = ppo_trxl
    extra = {"eval-interval": 2, "eval-levels": 2, "target-kl": 5e-6, "checkpoint-interval": 3}
    flags = flags_of(script, **extra)
    train_together(script.__file__, *flags, "--exp-name", "whole")
    half = [*flags, "--total-timesteps", "192", "--exp-name", "half"]
    train_together(script.__file__, *half)
    (whole,), (half,) = (list(Path("runs").glob(f"*{name}*")) for name in ("whole", "half"))
    more = ["--resume", str(half), "--total-timesteps", "384"]
    with pytest.raises(ValueError, match="this run has 2 processes, not 1; start as many"):
        script.setup(parse_args(script, *more))
    train_together(script.__file__, *more)
    before, after = curves(whole), curves(half)
    assert {step for step, _ in before["losses/loss"]} == {64, 128, 192, 256, 320, 384}
    assert 6 * 1 < sum(steps for _, steps in before["charts/gradient_steps"]) < 6 * 2 * 3, "target-kl ended some"
    for name in ("eval/return", "eval_levels/return"):  # where the shorter run ended it was evaluated too
        after[name] = [(step, value) for step, value in after[name] if step != 192]
    assert {name: points for name, points in after.items() if "eval" not in name} == {
        name: points for name, points in before.items() if "eval" not in name
    }
    assert after["eval_levels/return"] == before["eval_levels/return"]
    states = read_model(half / "checkpoint-384.pt")["processes"]
    assert len(states) == 2
    assert not states[0]["torch"].equal(states[1]["torch"]), "they choose other actions"


ENDLESS = [ppo_gru.__file__, *flags_of(ppo_gru, **{"total-timesteps": 10**8, "checkpoint-interval": 1})]


def has_checkpoint():
    """Whether training has begun."""
    return list(Path("runs").glob("*/checkpoint-*.pt"))


def test_a_process_that_dies_ends_the_others():
    with programs.together(programs.command(*ENDLESS)) as (first, second):
        first.wait_until(has_checkpoint)
        os.kill(second.pid, signal.SIGKILL)
        done = first.wait(60)
    assert done.returncode == 1
    (folder,) = Path("runs").iterdir()
    assert read_checkpoint(folder)["step"] > 0
    message = r"ppo_gru\.py: iteration \d+: another process of this run has ended; .*; the last checkpoint is \S+\.pt"
    assert re.search(message, done.stderr), done.stderr


def workers(process):
    """Return the ids of torchrun's processes."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [int(child) for child in children if "ppo_gru" in Path(f"/proc/{child}/cmdline").read_text()]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds the processes in /proc")
def test_a_signal_to_torchrun(curves):
    """As a cluster sends it: to torchrun, which passes it on, and perhaps to all processes too."""
    launch = programs.module("torch.distributed.run", "--standalone", "--nproc-per-node=2", *ENDLESS)
    with programs.Program(launch) as process:
        process.wait_until(has_checkpoint)
        for each in [*workers(process), process.pid]:
            os.kill(each, signal.SIGTERM)
        done = process.wait()
    assert done.returncode == 1, "torchrun's own"
    assert "another process of this run has ended" not in done.stderr
    assert "stopping at the end of this iteration" in done.stderr
    (folder,) = Path("runs").iterdir()
    assert read_checkpoint(folder)["step"] == curves(folder)["losses/loss"][-1][0]


def test_environments_that_cannot_be_split():
    command = [ppo_gru.__file__, *flags_of(ppo_gru, **{"num-envs": 3, "total-timesteps": 480})]
    for done in run_together(programs.command(*command)):
        assert done.returncode == 1
        assert "Traceback" not in done.stderr
        # PyTorch may warn of who has ended first.
        own = [line for line in done.stderr.splitlines() if line.startswith("ppo")]
        assert own == ["ppo_gru.py: --num-envs is 3; it must be a multiple of the 2 processes"]
    assert not Path("runs").exists()
